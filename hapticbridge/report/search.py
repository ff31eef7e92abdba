"""Search for the likely cause of an active run, and for a pump behind a trip."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace

import mujoco
import numpy as np

from hapticbridge.audit import AuditReport
from hapticbridge.audit.events import AuditedRun
from hapticbridge.audit.recorded_scene import bounds_for, compile_recorded
from hapticbridge.confinement import Worker, in_bounds
from hapticbridge.errors import HapticBridgeError
from hapticbridge.recording import Recording
from hapticbridge.report.cause import WINDOW, Cause, Kind
from hapticbridge.report.device_cause import cause_at_device
from hapticbridge.report.evidence import Evidence
from hapticbridge.report.scene_cause import REPEATED, RepeatedRun, cause_in_environment, pump_cause
from hapticbridge.scene.checks import PUMPING


def window_before(evidence: Evidence, report: AuditReport) -> slice | None:
    """Returns the last ``WINDOW`` seconds before the fault; None if the run is not active."""
    if report.verdict != "active" or report.tick is None or report.tick >= len(evidence.ticks):
        return None
    begin = report.tick + 1 - round(WINDOW / evidence.parameters.period)
    return slice(max(0, begin), report.tick + 1)


MUCH_MORE = 10.0
"""Growth of the excess in a window, relative to that before the fault, from which on the window is
searched for a larger cause; no unit."""

MEASURED: tuple[Kind, ...] = (
    *("contact setting", "pump", "inputs", "unmetered work"),
    *("jumping tendon", "bottomless flex", "constraint", "solver"),
)
"""Causes that are named by what they did, and that a fling by another one cannot pretend."""


def _cause_of_most(evidence: Evidence, report: AuditReport, window: slice) -> Cause:
    """Returns the cause of the fault, or of a window that brought much more, if it is another."""
    first = cause_in_environment(evidence, report, window)
    energy, allowed = evidence.judged(report)
    excess = np.concatenate([np.zeros(1), energy - allowed])
    begins = np.maximum(np.arange(len(excess)) - round(WINDOW / evidence.parameters.period), 0)
    growths = excess - excess[begins]
    end = int(np.argmax(growths))
    if end <= window.stop or growths[end] < MUCH_MORE * growths[window.stop]:
        return first
    larger = cause_in_environment(evidence, report, slice(int(begins[end]), end))
    if larger.kind not in MEASURED or (larger.kind, larger.remedy) == (first.kind, first.remedy):
        return first
    when = f"most came in the {WINDOW:g} s before {evidence.time[end - 1]:.3f} s"
    return replace(larger, evidence=f"{when}: {larger.evidence}")


@dataclass(frozen=True, slots=True)
class Excess:
    """Energy of an active run beyond its bound.

    Attributes:
        time: Time in s from which on it is above zero.
        worst: Its largest value in J.
        worst_tick: Tick of the largest value.
        worst_time: Time in s of that tick.
        cause: Likely cause of it.
    """

    time: float
    worst: float
    worst_tick: int
    worst_time: float
    cause: Cause


def excess_of(
    evidence: Evidence, report: AuditReport, *, in_process: bool = False
) -> Excess | None:
    """Returns the excess of an active run; None for any other run, and for one of several hands.

    ``in_process`` is as for ``likely_cause``.
    """
    if evidence.recording.has_several_hands:
        return None
    cause = likely_cause(evidence, report, in_process=in_process)
    if cause is None or report.tick is None:
        return None
    energy, allowed = evidence.judged(report)
    worst = int(np.argmax(energy - allowed))
    return Excess(
        time=float(evidence.time[report.tick]),
        worst=float((energy - allowed)[worst]),
        worst_tick=int(evidence.ticks["tick"][worst]),
        worst_time=float(evidence.time[worst]),
        cause=cause,
    )


def likely_cause(
    evidence: Evidence, report: AuditReport, *, in_process: bool = False
) -> Cause | None:
    """Returns the likely cause of an active run; None for any other run.

    The scene is compiled and simulated in a child process (``confinement``), unless ``in_process``.
    """
    window = window_before(evidence, report)
    if window is None:
        return None
    if report.port == "device":
        return cause_at_device(evidence, window)
    try:
        return _cause_in_scene(
            evidence.recording,
            lambda model: _cause_of_most(replace(evidence, model=model), report, window),
            in_process,
        )
    except HapticBridgeError:
        return cause_in_environment(evidence, report, window)


def pump_behind_trip(
    recording: Recording, report: AuditReport, *, in_process: bool = False
) -> Cause | None:
    """Returns a part of the scene that pumped before a trip as its likely cause; None without one.

    An active run has a cause of its own (``likely_cause``). A run of several hands has none, nor a
    trip for a fault of the device. ``in_process`` is as for ``likely_cause``.
    """
    trip = None if report.verdict == "active" else report.trip
    if trip is None or not trip.may_be_pumped or recording.hands > 1:
        return None
    if report.agreement not in REPEATED:
        return None
    parameters, end = AuditedRun.of(recording).parameters, recording.count
    window = slice(max(0, end - round(WINDOW / parameters.period)), end)
    grips = () if trip.is_unsound else (parameters.grip,)

    def found(model: mujoco.MjModel) -> Cause | None:
        pump, work = RepeatedRun(recording, model, window).hardest_pump(grips)
        if pump is None or work <= PUMPING * WINDOW:
            return None
        return pump_cause(pump, work, trip.words)

    try:
        return _cause_in_scene(recording, found, in_process)
    except HapticBridgeError:
        return None


def _cause_in_scene(
    recording: Recording, found: Callable[[mujoco.MjModel], Cause | None], in_process: bool
) -> Cause | None:
    """Returns the cause that a function finds in the recorded scene, in a child process.

    Raises:
        HapticBridgeError: The scene cannot be compiled, or not within its limits.
    """
    parameters = AuditedRun.of(recording).parameters

    def work(worker: Worker) -> object:
        model = compile_recorded(recording).model
        worker.allow_run()
        cause = found(model)
        return cause and asdict(cause)

    what = f"the scene of '{recording.path}'"
    told = in_bounds(work, what, trusted=in_process, **bounds_for(recording, parameters))
    return Cause(**told) if told else None
