"""What an audit found, in one object."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

from hapticbridge.files import finite_or_null


@dataclass(frozen=True, slots=True)
class AuditReport:
    """What an audit found.

    Attributes:
        path: The recording.
        verdict: ``passive``, ``active`` or ``invalid``.
        environment: ``strict`` (BC97 (14) held), ``within slack`` or ``active``; None if invalid.
        certified: Whether the recorded device bears the coupling; None where its damping is
            unknown or its motion is prescribed.
        reason: The verdict in a sentence.
        tick: First tick at fault, or None.
        port: The port at fault, ``environment`` or ``device``, or the field.
        joules: Energy at fault: created beyond what is allowed, or the mismatch.
        slack_share: Largest share of the slack that was used, 0 if strict.
        resimulation: ``bit for bit``, ``within 1e-9 (other processor)``, ``disagrees`` or ``not
            re-simulated: …``.
        is_cut: The file lacks its end; the verdict is on what it holds.
        ticks: Number of records.
        duration: Time of the run's clock at the last of them in s, missed deadlines among it; where
            their times cannot be, their number times the period.
        conditions: The device condition per kind of axis, as sentences.
        rendered: What was felt away from contact, or everywhere if the tool was never let go, and
            what was used, as sentences.
        unchecked: What records alone do not tell and only the re-simulation confirms, or nothing;
            without a re-simulation such a recording is not called passive but invalid.
        damping_margin: Least share of the device's damping that the coupling leaves, 1 − needed / b
            over the kinds of axis; below 0 where it needs more than there is, None where b is
            unknown or the motion prescribed.
        energies: Energies at the end, in J.
        events: How many events of each kind.
    """

    path: Path
    verdict: Literal["passive", "active", "invalid"]
    environment: Literal["strict", "within slack", "active"] | None
    certified: bool | None
    reason: str
    tick: int | None = None
    port: str = ""
    joules: float = 0.0
    slack_share: float = 0.0
    resimulation: str = ""
    is_cut: bool = False
    ticks: int = 0
    duration: float = 0.0
    conditions: tuple[str, ...] = ()
    rendered: tuple[str, ...] = ()
    unchecked: str = ""
    damping_margin: float | None = None
    energies: dict[str, float] = field(default_factory=dict)
    events: dict[str, int] = field(default_factory=dict)

    @property
    def words(self) -> str:
        """The verdict in a few words; see ``verdict_words``."""
        return verdict_words(self.verdict, self.environment or "", self.port)

    def to_json(self) -> str:
        """Returns the report as one JSON object; a number that is not finite becomes null."""
        values = asdict(self) | {"path": str(self.path), "margin": self.margin}
        return json.dumps(finite_or_null(values), indent=2, allow_nan=False)

    @property
    def exit_code(self) -> int:
        """0 if passive and certified or the device is unknown, else 1."""
        return 0 if self.verdict == "passive" and self.certified is not False else 1

    @property
    def margin(self) -> float:
        """How far the run was from a negative verdict: the least share that was left of anything.

        Of the slack that the coupling affords (1 − ``slack_share``) and of the device's damping
        (``damping_margin``, where it is known): 1 where nothing was used, 0 at the limit, negative
        beyond. Never above 0 where the verdict is active, NaN where it is invalid.
        """
        if self.verdict == "invalid":
            return math.nan
        parts = [1.0 - self.slack_share]
        if self.damping_margin is not None:
            parts.append(self.damping_margin)
        if self.verdict == "active":
            parts.append(0.0)
        return min(parts)


def verdict_words(verdict: str, environment: str, port: str) -> str:
    """Returns a verdict with what goes beside it: how passive a run was, or where it was active.

    Args:
        verdict: As ``AuditReport`` has it; so are the others.
        environment: Nothing where it is not known.
        port: Likewise.
    """
    beside = {"passive": environment, "active": port}.get(verdict)
    return f"{verdict} ({beside})" if beside else verdict
