"""Repetition of a recorded run through a changed bridge, beside the original."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit import AuditReport, audit
from hapticbridge.clock import Clock, SimulatedClock
from hapticbridge.compare import compare
from hapticbridge.confinement import Work, Worker, in_bounds
from hapticbridge.device import Device
from hapticbridge.device.simulated.device import scene_hand
from hapticbridge.errors import RecordingError
from hapticbridge.files import finite_or_null
from hapticbridge.record import TickFlag
from hapticbridge.recorded_scene import bounds_for, compile_recorded, is_as_recorded
from hapticbridge.recording import Recording, read_recording
from hapticbridge.scene import Scene
from hapticbridge.whatif.recorded import RecordedRun
from hapticbridge.whatif.replayed_hand import (
    IdentifiedDevice,
    RecordedClock,
    RecordedMotion,
    Repetition,
    ResampledMotion,
    load_bridge_code,
    missing_for_closed_loop,
)
from hapticbridge.whatif.settings import UNITS, Settings, Value

# Result of a what-if

RECORDED, PRESCRIBED, CLOSED = "recorded", "prescribed", "closed loop"
"""Names of the runs."""

RUN_WORDS = {
    RECORDED: "the run as it was",
    PRESCRIBED: "the changed run, with the recorded motion whatever the force",
    CLOSED: "the changed run, with a model of the hand that gives way to the force",
}
"""Description of each run."""


@dataclass(frozen=True, slots=True)
class WhatIfRun:
    """One of the runs.

    Attributes:
        name: ``recorded``, ``prescribed`` or ``closed loop``.
        report: The audit's verdict.
        peaks: Largest force and torque on hand and tool in N and N m, and largest distance of
            handle and tool in m, by name. Those on the hand are left out for a prescribed motion.
        trip: Reason of the guard's stop, or empty.
        period: T in s.
        recording: Its recording; that of a changed run exists in memory only.
    """

    name: str
    report: AuditReport
    peaks: dict[str, float]
    trip: str
    period: float
    recording: Recording

    @property
    def ticks(self) -> NDArray[np.void]:
        """Records, ``TICK_DTYPE``."""
        return self.recording.ticks


@dataclass(frozen=True, slots=True)
class WhatIf:
    """A recorded run beside its repetitions through a changed bridge.

    Attributes:
        path: The recording.
        changes: Name, unit, and the value before and after.
        runs: Recorded, prescribed and, for a known device, closed loop.
        hand_error: RMS distance in m of the model hand from the recorded motion with unchanged
            settings: the accuracy of the closed loop. NaN without closed loop.
        notes: Notes on the runs, one sentence each.
    """

    path: Path
    changes: tuple[tuple[str, str, Value | None, Value | None], ...]
    runs: tuple[WhatIfRun, ...]
    hand_error: float
    notes: tuple[str, ...]

    @property
    def exit_code(self) -> int:
        """Largest exit code of the changed runs; a trip counts as 1."""
        return max(max(run.report.exit_code, int(bool(run.trip))) for run in self.runs[1:])

    def to_json(self) -> str:
        """Returns the result as one JSON object, without the ticks."""
        values = {
            "path": str(self.path),
            "changes": [
                dict(zip(("name", "unit", "before", "after"), change, strict=True))
                for change in self.changes
            ],
            "runs": [
                {
                    "name": run.name,
                    "peaks": run.peaks,
                    "trip": run.trip,
                    "report": json.loads(run.report.to_json()) | {"path": str(self.path)},
                }
                for run in self.runs
            ],
            "hand_error": self.hand_error,
            "notes": self.notes,
        }
        return json.dumps(finite_or_null(values), allow_nan=False)


def what_if(
    path: str | Path,
    changes: Mapping[str, Value],
    *,
    strict: bool = False,
    in_process: bool = False,
    progress: Callable[[int, int, str], None] | None = None,
) -> WhatIf:
    """Simulates a recorded run again with a changed bridge.

    There are two simulations. ``prescribed`` follows the recorded motion of the device at any force
    (``again``). The closed loop couples the device, if its mass and damping are known, to a model
    hand with the recorded hand's intent (``hands``). Inputs of the scene, buttons, commands and
    pauses are repeated at their times. One audit judges all runs, and memory holds all of them.

    Args:
        path: The recording, undamaged and unchanged; it carries its scene.
        changes: New values by name: ``settings.UNITS``, or the scene's own parameters. Without
            changes the prescribed run equals the recorded one in every bit.
        strict: As for ``audit``.
        in_process: As for ``audit``.
        progress: Called with the number of runs done, their total, and the name of the next one.

    Raises:
        RecordingError: The recording cannot be judged or simulated, or a change is unknown.
        HapticBridgeError: The changed bridge is refused; the message names the reason.
    """
    progress = progress or (lambda _done, _total, _name: None)
    progress(0, 4, "auditing what was recorded")
    judge = partial(audit, strict=strict, in_process=in_process)
    report = judge(path)
    if report.verdict == "invalid":
        raise RecordingError(f"an invalid recording cannot be simulated again: {report.reason}")
    recording = read_recording(path)
    with TemporaryDirectory(prefix="hapticbridge-") as name:
        folder = Path(name)
        run = RecordedRun.of(recording, folder / "scene")
        if len(run.ticks) < 3:
            raise RecordingError(
                f"'{recording.path}' has {len(run.ticks)} ticks; a what-if needs 3"
            )
        file = folder / "run.mcap"
        return _Experiment(run, report, file, progress, judge, in_process).changed(changes)


START_TIME, MOST_TIMES = 40.0, 100.0
"""Processor time in s for the start of a bridge, which rehearses slow scenes for up to 37 s; and
largest work of a changed run relative to the recorded one."""


@dataclass(slots=True)
class _Experiment:
    """Repetitions of one recorded run, judged in its report, into a file at a path."""

    run: RecordedRun
    report: AuditReport
    path: Path
    progress: Callable[[int, int, str], None]
    judge: Callable[[Path], AuditReport]
    in_process: bool
    concerns: dict[str, None] = field(default_factory=dict)

    def changed(self, changes: Mapping[str, Value]) -> WhatIf:
        """Runs all repetitions and returns the result."""
        run, settings = self.run, self.run.settings
        new = settings.changed(changes)
        is_changed = new != settings
        notes = []
        if not self._is_scene_as_recorded():
            notes.append(
                "the attached scene does not compile to the recorded model: a program changed it "
                "after loading, or it was compiled elsewhere; these runs lack that change"
            )
        peaks = self._peaks(run.ticks)
        recorded = WhatIfRun(RECORDED, self.report, peaks, run.trip, run.period, run.recording)
        runs = [recorded]
        self.progress(1, 4, "the recorded motion")
        runs.append(self._prescribed(new))
        if not is_changed:
            notes.append(self._agreement())
        notes.extend(_missing_parts(run, Repetition(run, new)))
        if runs[0].trip:
            notes.append("the recorded run ends in a trip, so these runs end there too")
        hand_error = math.nan
        if missing := missing_for_closed_loop(run.info):
            notes.append(f"no closed loop: {missing}")
        else:
            self.progress(2, 4, "the model hand, nothing changed")
            same = self._closed(settings)
            count = min(len(same.ticks), len(run.ticks))
            off = same.ticks["device_position"][:count] - run.ticks["device_position"][:count]
            hand_error = float(np.sqrt(np.mean(np.sum(off**2, axis=1))))
            self.progress(3, 4, "the model hand")
            runs.append(self._closed(new) if is_changed else same)
            notes.append(
                f"with nothing changed the model hand is {1e3 * hand_error:.3g} mm off the "
                "recorded motion (root mean square); its response to changed forces is assumed"
            )
        changed_values = tuple(
            (name, UNITS.get(name, ""), settings.value(name), new.value(name)) for name in changes
        )
        return WhatIf(
            run.recording.path, changed_values, tuple(runs), hand_error, (*notes, *self.concerns)
        )

    def _peaks(self, ticks: NDArray[np.void]) -> dict[str, float]:
        return _peaks(ticks, is_held=not self.run.info.is_prescribed)

    def _prescribed(self, settings: Settings) -> WhatIfRun:
        run = self.run
        if settings.rate == run.settings.rate:
            clock = RecordedClock(run.ticks, run.period)
            device = RecordedMotion(run, clock)
            return self._simulated(PRESCRIBED, lambda _: device, clock, settings)
        resampled = ResampledMotion(run)
        return self._simulated(PRESCRIBED, lambda _: resampled, SimulatedClock(), settings)

    def _closed(self, settings: Settings) -> WhatIfRun:
        def device(scene: Scene) -> Device:
            return IdentifiedDevice(self.run, scene_hand(scene.model, scene.path))

        return self._simulated(CLOSED, device, SimulatedClock(), settings)

    def _simulated(
        self, name: str, device_in: Callable[[Scene], Device], clock: Clock, settings: Settings
    ) -> WhatIfRun:
        run, path = self.run, self.path

        def work(worker: Worker) -> object:
            scene = run.scene(settings)
            worker.allow_run()
            repetition = Repetition(run, settings)
            period, trip = repetition.into(path, device_in(scene), clock)
            return period, trip, repetition.warned

        load_bridge_code(
            settings.method.name, settings.method.contact, settings.scene_rate < settings.rate
        )
        old = run.settings
        steps = settings.rate * settings.substeps / (old.rate * old.substeps)
        period, trip, warned = self._in_bounds(work, max(1.0, steps))
        if settings != run.settings:
            self.concerns |= dict.fromkeys(map(str, warned))
        recording = read_recording(path)
        report = self.judge(path)
        return WhatIfRun(
            name, report, self._peaks(recording.ticks), str(trip), float(period), recording
        )

    def _is_scene_as_recorded(self) -> bool:
        recording, parameters = self.run.recording, self.run.parameters
        return bool(
            self._in_bounds(
                lambda _: is_as_recorded(compile_recorded(recording, parameters), recording)
            )
        )

    def _in_bounds(self, work: Work, times: float = 1.0) -> Any:
        """Does work with the run's scene in a child process with limits (``confinement``).

        ``times`` is the work relative to a simulation of the recorded run.
        """
        run = self.run
        bounds = bounds_for(run.recording, run.parameters)
        return in_bounds(
            work,
            f"the scene of '{run.recording.path}'",
            trusted=self.in_process,
            seconds=START_TIME + min(times, MOST_TIMES) * bounds["seconds"],
            reads=bounds["reads"],
            writes=(self.path.parent,),
        )

    def _agreement(self) -> str:
        found = compare(self.run.recording.path, self.path)
        if found.first is None and not any(found.alone):
            return "with nothing changed the prescribed run is the recorded one in every bit"
        if found.first is None:
            return f"with nothing changed the prescribed run has {found.ticks[1]} ticks"
        first = found.first
        return (
            f"with nothing changed the prescribed run differs from the recorded one from tick "
            f"{first.ticks[0]} on, in {first.column}, by {first.size:.3g} {first.unit}"
        )


def _missing_parts(run: RecordedRun, repetition: Repetition) -> Iterator[str]:
    counts = Counter(event.get("event") for event in run.recording.events)
    if counts["coupling"] and not repetition.keeps_couplings:
        yield (
            f"the coupling was changed {counts['coupling']} times in the recorded run; here it is "
            "constant"
        )
    if counts["reset"] and not repetition.keeps_resets:
        yield f"{counts['reset']} resets in the recorded run, none here: there is nothing to reset"
    flags = run.recording.ticks["flags"]
    is_resampled = repetition.settings.rate != run.settings.rate
    if missed := int(np.count_nonzero(flags & int(TickFlag.OVERRUN))):
        here = "none in these runs" if is_resampled else "none in the closed loop"
        yield (
            f"late ticks: {missed} in the recorded run, {here}: the hand's motion meanwhile "
            "falls into one tick there"
        )
    if is_resampled:
        yield (
            "the recorded motion is linear between its samples: at another rate its speed changes "
            "in steps"
        )


def _peaks(ticks: NDArray[np.void], *, is_held: bool) -> dict[str, float]:
    """Returns the largest forces, torques and stretch of a run; zero without ticks.

    ``is_held`` is False for a recorded motion that was prescribed: no hand feels a force.
    """

    def largest(vectors: NDArray[np.float64]) -> float:
        return float(np.linalg.norm(vectors, axis=1).max(initial=0.0))

    tool, hand = ticks["wrench_on_tool"], ticks["wrench_on_device"]
    on_hand = {"force on hand": largest(hand[:, :3]), "torque on hand": largest(hand[:, 3:])}
    return (on_hand if is_held else {}) | {
        "force on tool": largest(tool[:, :3]),
        "torque on tool": largest(tool[:, 3:]),
        "stretch": largest(ticks["handle_position"] - ticks["tool_position"]),
    }
