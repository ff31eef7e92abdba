"""Twins of a map: a recorded run that fails, and one that differs in one value and holds."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hapticbridge.audit import AuditReport, audit
from hapticbridge.bridge import Bridge
from hapticbridge.clock import SimulatedClock
from hapticbridge.coupling import Coupling
from hapticbridge.device import Device
from hapticbridge.guard import UNLIMITED
from hapticbridge.options import BridgeOptions
from hapticbridge.scene import Scene

ENDINGS = ("fails.mcap", "safe.mcap")
"""Endings of the files of both twins, the one that fails first."""

NEVER = 1e6
"""Force in N and torque in N m that no twin reaches."""

UNGUARDED_OPTIONS = BridgeOptions(
    limits=replace(UNLIMITED, force=NEVER, torque=NEVER), controller="off"
)
"""Options of a bridge whose guard changes nothing. By default it stops or damps a run before its
fault shows."""

NO_LIMITS: Mapping[str, Any] = {
    "force_limit": NEVER,
    "torque_limit": NEVER,
    "speed_limit": 0.0,
}
"""Limits in the data sheet of a device for ``UNGUARDED_OPTIONS``; a speed limit of 0 is unknown."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """A run that the ordinary bridge records in simulated time.

    Attributes:
        scene: Loads the scene.
        device: Returns the device with its hand.
        coupling: Requested K and B.
        options: Rate, method and contact, beside those of ``UNGUARDED_OPTIONS``.
        duration: Duration in s.
    """

    scene: Callable[[], Scene]
    device: Callable[[], Device]
    coupling: Coupling
    options: BridgeOptions
    duration: float

    def record(self, path: Path) -> None:
        """Records the run into a file, which is replaced if it exists.

        Raises:
            HapticBridgeError: The file cannot be written, or the run trips the guard.
        """
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # they tell of the fault that the run is to show
            bridge = Bridge(
                self.scene(),
                self.device(),
                self.coupling,
                self.options,
                clock=SimulatedClock(),
                recording=path,
            )
            with bridge:
                summary = bridge.run(self.duration)
        if summary.stopped_by == "signal":
            raise KeyboardInterrupt  # the bridge ended the run, and the map must end too


@dataclass(frozen=True, slots=True, kw_only=True)
class Twins:
    """Two runs that differ in one value: with the first it fails, with the second it holds.

    Attributes:
        shared: Clause on what both runs share, with its numbers.
        name: Name of the value.
        unit: Unit in which the value is printed; empty for a word.
        factor: That number in one SI unit: 1e3 for a mass in g.
        values: The value that fails and the one that holds.
        run: Returns the run at a value.
    """

    shared: str
    name: str
    unit: str = ""
    factor: float = 1.0
    values: tuple[Any, Any]
    run: Callable[[Any], Run]

    def record(self, paths: tuple[Path, Path]) -> RecordedTwins:
        """Records and audits both runs, the one that fails first."""
        reports = []
        for path, value in zip(paths, self.values, strict=True):
            self.run(value).record(path)
            reports.append(audit(path, in_process=True))
        return RecordedTwins(self, (reports[0], reports[1]))

    def named(self, value: Any) -> str:
        """Returns the name with a value, such as ``rate 200 Hz``."""
        if isinstance(value, str):
            return f"{self.name} '{value}'"
        return f"{self.name} {value * self.factor:g} {self.unit}".rstrip()


@dataclass(frozen=True, slots=True)
class RecordedTwins:
    """The recordings of both twins.

    Attributes:
        twins: The runs.
        reports: Audit of each recording, of the one that fails first.
    """

    twins: Twins
    reports: tuple[AuditReport, AuditReport]

    @property
    def sentence(self) -> str:
        """Values and verdicts of both runs in a sentence, without a full stop."""
        (fails, safe), names = self.reports, [*map(self.twins.named, self.twins.values)]
        return (
            f"{self.twins.shared}, {names[0]}: {_verdict(fails)}; safe twin: {names[1]}, all else "
            f"equal: {_verdict(safe)}"
        )

    @property
    def facts(self) -> dict[str, Any]:
        """File, value and verdict of each run, and the sentence, for JSON."""
        each = {
            ending.partition(".")[0]: {
                "file": report.path.name,
                self.twins.name: value,
                "verdict": report.words,
                "tick": report.tick,
            }
            for ending, value, report in zip(ENDINGS, self.twins.values, self.reports, strict=True)
        }
        return {"sentence": self.sentence, **each}


def _verdict(report: AuditReport) -> str:
    return report.words if report.tick is None else f"{report.words} from tick {report.tick}"
