"""Twins of a map: a recorded run that fails, and one that differs in one value and holds."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from signal import Signals
from typing import Any

from hapticbridge.audit import AuditReport, audit
from hapticbridge.clock import SimulatedClock
from hapticbridge.coupling import Coupling
from hapticbridge.demand.guard import UNLIMITED
from hapticbridge.device import Device
from hapticbridge.files import atomic_write
from hapticbridge.recording import read_recording
from hapticbridge.report.evidence import Evidence
from hapticbridge.report.search import excess_of
from hapticbridge.run.bridge import Bridge
from hapticbridge.run.options import BridgeOptions
from hapticbridge.scene import Scene
from hapticbridge.signals import StopSignal
from hapticbridge.units import format_energy

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
                bridge.run(self.duration)
        if name := bridge.session.signal:  # it ended the run, and must end the map
            raise StopSignal(Signals[name])


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
            with atomic_write(path) as beside:
                self.run(value).record(beside)
            reports.append(audit(path, in_process=True))
        fails, safe = reports
        evidence = Evidence.of(read_recording(fails.path, 0))
        excess = evidence and excess_of(evidence, fails, in_process=True)
        return RecordedTwins(self, (fails, safe), excess.worst if excess else math.nan)

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
        excess: Largest energy in J of the run that fails beyond its bound.
    """

    twins: Twins
    reports: tuple[AuditReport, AuditReport]
    excess: float

    @property
    def sentence(self) -> str:
        """Values and verdicts of both runs in a sentence, without a full stop."""
        (fails, safe), names = self.reports, [*map(self.twins.named, self.twins.values)]
        return (
            f"{self.twins.shared}, {names[0]}: {fails.words}, up to {format_energy(self.excess)} "
            f"beyond the bound; safe twin: {names[1]}, all else equal: {safe.words}"
        )

    @property
    def facts(self) -> dict[str, Any]:
        """File, value and verdict of each run, the sentence and the excess, for JSON."""
        each = {
            ending.partition(".")[0]: {
                "file": report.path.name,
                "value": value,
                "verdict": report.words,
                "tick": report.tick,
            }
            for ending, value, report in zip(ENDINGS, self.twins.values, self.reports, strict=True)
        }
        return {
            "sentence": self.sentence,
            "name": self.twins.name,
            "excess_j": self.excess,
            **each,
        }
