"""Repetition of a recorded run through a changed bridge, beside the original."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit import AuditReport, audit
from hapticbridge.audit.recorded_scene import bounds_for, compile_recorded, is_as_recorded
from hapticbridge.clock import Clock, SimulatedClock
from hapticbridge.confinement import Work, Worker, in_bounds
from hapticbridge.device import Device
from hapticbridge.device.registry import FINGERS_HAND
from hapticbridge.device.simulated.device import hand_for
from hapticbridge.errors import RecordingError
from hapticbridge.files import finite_or_null
from hapticbridge.kernel.record import TickFlag
from hapticbridge.recording import Recording
from hapticbridge.recording.reader import read_hands
from hapticbridge.scene import Scene
from hapticbridge.tools.compare import compare
from hapticbridge.units import format_si
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
from hapticbridge.whatif.settings import Change, Settings, Value, changed_of_hands

# Result of a what-if

NO_ANSWER = (
    "the watch for a late or reversed force acted in the prescribed run, because a recorded motion "
    "does not answer the changed force: the force is lowered there, so its numbers say nothing of "
    "the change (–), and the device is not judged"
)
"""Note on a prescribed run whose force was lowered for a motion that no force can change."""

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
        period: T in s.
        recordings: Its recording, once per hand; that of a changed run exists in memory only.
        is_lowered: True if its force was lowered for a motion that no force can change
            (``NO_ANSWER``): its numbers are not those of the change.
    """

    name: str
    report: AuditReport
    peaks: dict[str, float]
    period: float
    recordings: tuple[Recording, ...]
    is_lowered: bool = False

    @property
    def recording(self) -> Recording:
        """The recording; of several hands, the first's."""
        return self.recordings[0]

    @property
    def ticks(self) -> NDArray[np.void]:
        """Records, ``TICK_DTYPE``; of several hands, the first's."""
        return self.recording.ticks


@dataclass(frozen=True, slots=True)
class WhatIf:
    """A recorded run beside its repetitions through a changed bridge.

    Attributes:
        path: The recording.
        changes: Name, unit, and the value before and after.
        runs: Recorded, prescribed and, for a known device, closed loop.
        hand_error: RMS distance in m of the model hand from the recorded motion with unchanged
            settings: the accuracy of the closed loop; of several hands, the largest. NaN without
            closed loop.
        notes: Notes on the runs, one sentence each.
    """

    path: Path
    changes: tuple[Change, ...]
    runs: tuple[WhatIfRun, ...]
    hand_error: float
    notes: tuple[str, ...]

    @property
    def exit_code(self) -> int:
        """Largest exit code of the changed runs; a trip counts as 1."""
        reports = [run.report for run in self.runs[1:]]
        return max(max(each.exit_code, int(each.trip is not None)) for each in reports)

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
                    "is_lowered": run.is_lowered,
                    "peaks": run.peaks,
                    "trip": run.report.trip and run.report.trip.sentence,
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
        changes: New values by name: ``settings.CHANGEABLE``, or the scene's own parameters. Without
            changes the prescribed run equals the recorded one in every bit.
        strict: As for ``audit``.
        in_process: As for ``audit``.
        progress: Called with the number of runs done, their total, and the name of the next one.

    Raises:
        RecordingError: The recording cannot be judged or simulated, or a change is unknown.
        HapticBridgeError: The changed bridge is refused; the message names the reason.
    """
    (answer,) = what_ifs(path, (changes,), strict=strict, in_process=in_process, progress=progress)
    return answer


def what_ifs(
    path: str | Path,
    alternatives: Sequence[Mapping[str, Value]],
    *,
    strict: bool = False,
    in_process: bool = False,
    progress: Callable[[int, int, str], None] | None = None,
) -> list[WhatIf]:
    """Simulates a recorded run with each of several changes, and once with nothing changed.

    Arguments and errors are those of ``what_if``, with a mapping for each change.
    """
    steps = _Steps(progress or (lambda _done, _total, _name: None), 2 + 2 * len(alternatives))
    steps.begin("auditing what was recorded")
    judge = partial(audit, strict=strict, in_process=in_process)
    report = judge(path)
    if report.verdict == "invalid":
        raise RecordingError(f"an invalid recording cannot be simulated again: {report.reason}")
    if report.credit:
        raise RecordingError(
            f"another program stepped the scene of '{report.path}': what it would have shown under "
            "other settings is not known"
        )
    if report.certification is not None and report.certification.own_loop is not None:
        raise RecordingError(
            f"a loop of the device's own pushed the hand of '{report.path}': what it would have "
            "done under other settings is not known"
        )
    recordings = read_hands(path)
    with TemporaryDirectory(prefix="hapticbridge-") as name:
        folder = Path(name)
        hands = RecordedRun.from_hands(recordings, folder / "scene")
        if len(hands[0].ticks) < 3:
            raise RecordingError(
                f"'{recordings[0].path}' has {len(hands[0].ticks)} ticks; a what-if needs 3"
            )
        file = folder / "run.mcap"
        experiment = _Experiment(hands, report, file, steps, judge, in_process)
        for changes in alternatives:  # refuses a bad value before anything is simulated
            experiment.settings_with(changes)
        return [experiment.changed(changes) for changes in alternatives]


@dataclass(slots=True)
class _Steps:
    """Count of the steps of an experiment that have begun."""

    show: Callable[[int, int, str], None]
    total: int
    begun: int = 0

    def begin(self, name: str) -> None:
        """Shows the next step."""
        self.show(self.begun, self.total, name)
        self.begun += 1


START_TIME, MAX_TIMES = 40.0, 100.0
"""Processor time in s for the start of a bridge, which rehearses slow scenes for up to 37 s; and
largest work of a changed run relative to the recorded one."""


@dataclass(slots=True)
class _Experiment:
    """Repetitions of one recorded run, judged in its report, into a file at a path."""

    hands: tuple[RecordedRun, ...]
    report: AuditReport
    path: Path
    steps: _Steps
    judge: Callable[[Path], AuditReport]
    in_process: bool
    concerns: dict[str, None] = field(default_factory=dict)
    unchanged: WhatIfRun | None = None
    as_recorded: bool | None = None

    @property
    def run(self) -> RecordedRun:
        """The recorded run; of several hands, the first's."""
        return self.hands[0]

    @property
    def has_several_hands(self) -> bool:
        """True if several hands hold the scene."""
        return len(self.hands) > 1

    def settings_with(
        self, changes: Mapping[str, Value]
    ) -> tuple[list[Settings], tuple[Change, ...]]:
        """Returns the changed settings of each hand, and the changes as ``WhatIf`` has them."""
        by_grip = {hand.parameters.grip: hand.settings for hand in self.hands}
        new, changed_values = changed_of_hands(by_grip, changes)
        return list(new.values()), changed_values

    def changed(self, changes: Mapping[str, Value]) -> WhatIf:
        """Runs all repetitions and returns the result."""
        self.concerns = {}
        run, settings = self.run, [hand.settings for hand in self.hands]
        new, changed_values = self.settings_with(changes)
        is_changed = new != settings
        notes = []
        if not self._is_scene_as_recorded():
            notes.append(
                "the attached scene does not compile to the recorded model: a program changed it "
                "after loading, or it was compiled elsewhere; these runs lack that change"
            )
        recordings = tuple(hand.recording for hand in self.hands)
        peaks = self._peaks(recordings)
        recorded = WhatIfRun(RECORDED, self.report, peaks, run.period, recordings)
        runs = [recorded]
        self.steps.begin("the recorded motion")
        runs.append(self._prescribed(new))
        if not is_changed:
            notes.append(self._agreement())
        elif _alarms(runs[-1]) & ~_alarms(recorded):
            unjudged = replace(runs[-1].report, certification=None)
            runs[-1] = replace(runs[-1], report=unjudged, is_lowered=True)
            notes.append(NO_ANSWER)
        notes.extend(_missing_parts(run, Repetition(self.hands, new)))
        if run.trip:
            notes.append("the recorded run ends in a trip, so these runs end there too")
        hand_error = math.nan
        if missing := self._missing_for_closed_loop():
            notes.append(f"no closed loop: {missing}")
        else:
            same = self._same(settings)
            hand_error = max(map(_distance, same.recordings, recordings))
            self.steps.begin("the model hand")
            runs.append(self._closed(new) if is_changed else same)
            notes.append(
                f"with nothing changed the model hand is {format_si(hand_error, 'm')} off the "
                "recorded motion (root mean square); its response to changed forces is assumed"
            )
        return WhatIf(
            run.recording.path, changed_values, tuple(runs), hand_error, (*notes, *self.concerns)
        )

    def _missing_for_closed_loop(self) -> str:
        for hand in self.hands:
            if missing := missing_for_closed_loop(hand.info):
                return f"{missing} (hand{self._at(hand)})" if self._at(hand) else missing
        return ""

    def _at(self, hand: RecordedRun) -> str:
        return f" at '{hand.parameters.grip}'" if self.has_several_hands else ""

    def _peaks(self, recordings: Sequence[Recording]) -> dict[str, float]:
        return {
            name + self._at(hand): peak
            for hand, recording in zip(self.hands, recordings, strict=True)
            for name, peak in _peaks(recording.ticks, is_held=not hand.info.is_prescribed).items()
        }

    def _prescribed(self, settings: Sequence[Settings]) -> WhatIfRun:
        run = self.run
        if settings[0].options.loop_rate == run.settings.options.loop_rate:
            clock = RecordedClock(run.ticks, run.period)
            devices: list[Device] = [RecordedMotion(hand, clock) for hand in self.hands]
            return self._simulated(PRESCRIBED, lambda _: devices, clock, settings)
        resampled = [ResampledMotion(hand) for hand in self.hands]
        return self._simulated(PRESCRIBED, lambda _: resampled, SimulatedClock(), settings)

    def _closed(self, settings: Sequence[Settings]) -> WhatIfRun:
        def devices(scene: Scene) -> list[Device]:
            hand = hand_for(scene)
            return [
                IdentifiedDevice(run, FINGERS_HAND if run.parameters.is_joint else hand)
                for run in self.hands
            ]

        return self._simulated(CLOSED, devices, SimulatedClock(), settings)

    def _same(self, settings: Sequence[Settings]) -> WhatIfRun:
        """Returns the closed loop of the recorded settings; it is simulated once."""
        if self.unchanged is None:
            self.steps.begin("the model hand, nothing changed")
            self.unchanged = self._closed(settings)
        return self.unchanged

    def _simulated(
        self,
        name: str,
        devices_in: Callable[[Scene], Sequence[Device]],
        clock: Clock,
        settings: Sequence[Settings],
    ) -> WhatIfRun:
        run, path, new = self.run, self.path, settings[0]

        def work(worker: Worker) -> object:
            repetition = Repetition(self.hands, settings)
            scene = repetition.scene()
            worker.allow_run()
            return repetition.into(path, devices_in(scene), clock), repetition.warned

        method, is_slow = new.method, new.options.scene_ticks > 0
        load_bridge_code(method.name, method.contact, is_slow, self.has_several_hands)
        steps = new.steps_per_second / run.settings.steps_per_second
        period, warned = self._in_bounds(work, max(1.0, steps))
        if any(own != hand.settings for own, hand in zip(settings, self.hands, strict=True)):
            self.concerns |= dict.fromkeys(map(str, warned))
        recordings = read_hands(path)
        report = self.judge(path)
        return WhatIfRun(name, report, self._peaks(recordings), float(period), recordings)

    def _is_scene_as_recorded(self) -> bool:
        recording = self.run.recording
        if self.as_recorded is None:
            self.as_recorded = bool(
                self._in_bounds(lambda _: is_as_recorded(compile_recorded(recording), recording))
            )
        return self.as_recorded

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
            seconds=START_TIME + min(times, MAX_TIMES) * bounds["seconds"],
            reads=bounds["reads"],
            writes=(self.path.parent,),
        )

    def _agreement(self) -> str:
        comparison = compare(self.run.recording.path, self.path)
        if comparison.first is None and not any(comparison.alone):
            return "with nothing changed the prescribed run is the recorded one in every bit"
        if comparison.first is None:
            return f"with nothing changed the prescribed run has {comparison.ticks[1]} ticks"
        first = comparison.first
        return (
            f"with nothing changed the prescribed run differs from the recorded one from tick "
            f"{first.ticks[0]} on, in {first.column}, by {first.size:.3g} {first.unit}"
        )


def _alarms(run: WhatIfRun) -> int:
    """Returns the findings of the watch for a late or reversed force, as flags."""
    every = [np.bitwise_or.reduce(each.ticks["flags"], initial=0) for each in run.recordings]
    return int(np.bitwise_or.reduce(every)) & int(TickFlag.SWINGING | TickFlag.RUNS_AWAY)


def _missing_parts(run: RecordedRun, repetition: Repetition) -> Iterator[str]:
    counts = Counter(event.get("event") for event in run.recording.events)
    changes = (event for event in run.recording.events if event.get("event") == "coupling")
    if lost := sum(not repetition.keeps_coupling(event) for event in changes):
        yield f"the coupling was changed {lost} times in the recorded run; here it is constant"
    if counts["reset"] and not repetition.keeps_resets:
        yield f"{counts['reset']} resets in the recorded run, none here: there is nothing to reset"
    flags = run.recording.ticks["flags"]
    is_resampled = repetition.settings.options.loop_rate != run.settings.options.loop_rate
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


def _distance(recording: Recording, other: Recording) -> float:
    """Returns the RMS distance in m of two motions of a device, over the ticks of both."""
    count = min(len(recording.ticks), len(other.ticks))
    off = recording.ticks["device_position"][:count] - other.ticks["device_position"][:count]
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))


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
