"""Result of an audit."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

from hapticbridge.files import finite_or_null
from hapticbridge.rendering import RunCoupling
from hapticbridge.timekeeping import Timekeeping

Verdict = Literal["passive", "unverified", "active", "invalid"]


@dataclass(frozen=True, slots=True)
class AuditReport:
    """Result of an audit.

    Attributes:
        path: The recording.
        verdict: ``passive``, ``active`` or ``invalid``; ``unverified`` if the records alone are
            passive, but the run was not simulated again or no trusted key signed the file.
        environment: ``strict`` (Σ E_k <= 0 held), ``within slack`` or ``active``; None if invalid.
        certified: True if the recorded device bears the coupling and the run kept its time; None if
            its damping is unknown or its motion is prescribed.
        reason: The verdict in a sentence.
        tick: First tick at fault, or None.
        port: Port at fault, ``environment`` or ``device``, or the field.
        joules: Energy at fault in J: created beyond the bound, or the mismatch.
        slack_share: Largest share of the slack that was used; 0 if strict.
        resimulation: ``bit for bit``, ``within 1e-9 (other processor)``, ``disagrees`` or ``not
            re-simulated: …``.
        is_cut: True if the file lacks the end of its run, or did before a repair; the verdict is on
            the rest.
        cut: Reasons for that, as a sentence; else empty.
        signature: Result of the signature's check, as a sentence; without a key, what only a key
            would prove.
        is_trusted: True if a trusted key signed exactly this file, False if not; such a run is
            never passive. None if no trusted key was named.
        ticks: Number of records.
        duration: Time of the run's clock at the last record in s, with missed deadlines. If the
            recorded times are impossible, the number of records times the period.
        conditions: Device condition per kind of axis, as sentences.
        coupling: Requested, law and effective coupling at the start; None if invalid.
        coupling_sentences: Sentences on them, and on changes by commands. They hold away from
            contact, or everywhere if the tool was never released.
        unchecked: Parts that only the re-simulation confirms; empty if there are none. Without a
            re-simulation it names the changes that would pass: those of ``wrench_on_device`` and
            ``share`` that fit each other.
        timekeeping: Time that the run kept, and the device conditions at this time; None where the
            records could not be read.
        damping_margin: Smallest share of the device's damping that the coupling leaves at the time
            that the run kept, 1 − needed / b over the kinds of axis. It is negative if more is
            needed than available; None if b is unknown or the motion prescribed.
        energies: Energies at the end, in J.
        start_potential: Potential energy before the first tick in J; its zero is arbitrary.
        max_net_energy: Largest energy in J that the hand had got beyond what it put in and what
            the device's damping burned; of several hands that of the one with most.
        events: Number of events of each kind.
        findings: Faults of the scene of which the run warned, as sentences.
        accepts_unverified: True if ``unverified`` counts as a success in ``exit_code``.
        hands: Name of each hand's grip, if several hold the scene; else empty. The environment is
            judged over all of them, and each device by itself; ``certified`` is False if one lacks
            damping. Conditions and couplings name their hand, ``energies`` are sums over all hands.
    """

    path: Path
    verdict: Verdict
    environment: Literal["strict", "within slack", "active"] | None
    certified: bool | None
    reason: str
    tick: int | None = None
    port: str = ""
    joules: float = 0.0
    slack_share: float = 0.0
    resimulation: str = ""
    is_cut: bool = False
    cut: str = ""
    signature: str = ""
    is_trusted: bool | None = None
    ticks: int = 0
    duration: float = 0.0
    conditions: tuple[str, ...] = ()
    coupling: RunCoupling | None = None
    coupling_sentences: tuple[str, ...] = ()
    unchecked: str = ""
    timekeeping: Timekeeping | None = None
    damping_margin: float | None = None
    energies: dict[str, float] = field(default_factory=dict)
    start_potential: float = 0.0
    max_net_energy: float = 0.0
    events: dict[str, int] = field(default_factory=dict)
    findings: tuple[str, ...] = ()
    accepts_unverified: bool = False
    hands: tuple[str, ...] = ()

    @property
    def words(self) -> str:
        """The verdict in a few words; see ``verdict_words``."""
        return verdict_words(self.verdict, self.environment or "", self.port)

    def to_json(self) -> str:
        """Returns the report as one JSON object; a number that is not finite becomes null."""
        values = asdict(self) | {"path": str(self.path), "margin": self.margin}
        if not self.hands:
            del values["hands"]
        return json.dumps(finite_or_null(values), indent=2, allow_nan=False)

    @property
    def exit_code(self) -> int:
        """0 if passive (or unverified, if accepted) and not known to lack damping, else 1."""
        is_accepted = self.accepts_unverified and self.is_trusted is not False
        accepted = ("passive", "unverified")[: 1 + is_accepted]
        return 0 if self.verdict in accepted and self.certified is not False else 1

    @property
    def margin(self) -> float:
        """Smallest unused share of the slack (1 − ``slack_share``) and of the device's damping.

        1 means nothing was used, 0 is the limit, negative values are beyond it. The device's share
        is ``damping_margin``, if known. The margin is never above 0 for an active verdict, and NaN
        for an invalid one.
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
    """Returns a verdict with its environment or port, as ``passive (strict)``.

    An unknown environment or port is empty.
    """
    beside = {"passive": environment, "unverified": environment, "active": port}.get(verdict)
    return f"{verdict} ({beside})" if beside else verdict
