"""Facts that a recording states more than once, or that follow from others in it.

A recording is written by anyone who has it, with all its checksums. What one part states and the
others determine must therefore agree.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, replace
from pathlib import PurePosixPath
from typing import Any, NamedTuple

import numpy as np

from hapticbridge.audit.events import AuditedRun
from hapticbridge.audit.structure import Fault
from hapticbridge.audit.timing import TimingTally
from hapticbridge.clock import RealClock, SimulatedClock
from hapticbridge.errors import DeviceError, RecordingError
from hapticbridge.guard import CONTROLLERS, IDLE_FORCE, IDLE_TORQUE, Limits, guard_parameters_for
from hapticbridge.kernel.parameters import UNGUARDED, WITHOUT_DELAY
from hapticbridge.loop_setting import LoopSetting
from hapticbridge.pose import IDENTITY_POSE
from hapticbridge.recording import RecordingFile
from hapticbridge.rehearsal import start_handle, static_load
from hapticbridge.run_description import SOURCE_PREFIX, STATE_ATTACHMENT, start_state
from hapticbridge.scene import Scene

_TOLERANCE = 1e-9  # relative and absolute in SI units, for numbers of another processor


class Statement(NamedTuple):
    """A stated value, and the one that other parts of the recording give.

    Attributes:
        field: Name of the field.
        stated: Value of the field.
        derived: Value that follows from the others; None if these exclude any value.
        source: The others.
    """

    field: str
    stated: Any
    derived: Any
    source: str

    def fault(self) -> Fault | None:
        """Returns a fault if the values differ."""
        if self.stated == self.derived:
            return None
        return Fault(
            f"{self.field} is {self.stated!r:.80}, but {self.source} give {self.derived!r:.80}",
            port=self.field,
        )


def first_contradiction(statements: Iterable[Statement]) -> Fault | None:
    """Returns the first statement that others contradict as a fault, or None."""
    return next((fault for each in statements if (fault := each.fault())), None)


# Metadata against each other


def metadata_statements(recording: RecordingFile, run: AuditedRun) -> Iterator[Statement]:
    """Yields what device, coupling and method determine of the metadata."""
    meta, parameters = recording.meta, run.parameters
    yield from _guard_statements(run)
    if not run.method.is_weld:
        stated = meta.get("effective")
        yield Statement("metadata 'effective'", stated, "null", "methods other than 'weld'")
    clocks = (RealClock.name, SimulatedClock.name)
    if meta.get("clock") not in clocks:
        yield Statement("metadata 'clock'", meta.get("clock"), " or ".join(clocks), "its two kinds")
    origins = parameters.device_origin, parameters.handle_origin
    if IDENTITY_POSE not in origins:
        start = parameters.device_start
        yield Statement("metadata 'device_origin'", origins[0], start, "relative poses")
    main = next((n for n in recording.attachments if n.startswith(SOURCE_PREFIX)), None)
    if main is not None:
        file = PurePosixPath(main)
        yield Statement("metadata 'scene_file'", meta.get("scene_file"), file.name, "the sources")
        yield Statement("metadata 'scene'", meta.get("scene"), file.stem, "the sources")


def _guard_statements(run: AuditedRun) -> Iterator[Statement]:
    parameters, info = run.parameters, run.info
    guard = parameters.guarding
    if guard == UNGUARDED:  # a study runs without
        return
    needed = LoopSetting.of_run(info, replace(parameters, effective=None), run.method).needs()
    try:
        limits = Limits(
            force=parameters.force_limit,
            torque=parameters.torque_limit,
            angle=guard.angle,
            energy=guard.energy,
            reach=guard.reach,
        )
    except DeviceError as error:
        raise RecordingError(f"metadata 'guard' is out of range: {error}") from None
    names = {code: name for name, code in CONTROLLERS.items()}
    derived = guard_parameters_for(
        info,
        limits,
        parameters.period,
        needed=needed,
        scale=parameters.scale,
        controller=None if info.is_prescribed else names[guard.controller],
    )
    source = "data sheet, coupling and limits"
    knows_delays = (guard.stated_delay, guard.delay_margin) != (0.0, math.inf)
    chosen = _CHOSEN if knows_delays else (*_CHOSEN, *WITHOUT_DELAY)
    if guard.twist_damping == math.inf:  # of an earlier version, which the certificate counts
        chosen = (*chosen, "twist_damping")
    free = {name: getattr(guard, name) for name in chosen}
    for name, value in asdict(replace(derived, **free)).items():
        yield Statement(f"guard parameter '{name}'", getattr(guard, name), value, source)
    load = guard.idle_force - IDLE_FORCE, guard.idle_torque - IDLE_TORQUE
    for name, weight in zip(("hold_force", "hold_torque"), load, strict=True):
        held = getattr(guard, name)
        if not held > weight >= 0:
            yield Statement(f"guard parameter '{name}'", held, None, "the tool's weight")


_CHOSEN = (
    *("stretch", "clutch", "dead_man"),
    *("hold_force", "hold_torque", "idle_force", "idle_torque"),
)
"""Guard parameters that the user chooses, or that follow from the scene."""


# Events against records


def event_statements(recording: RecordingFile, timing: TimingTally) -> Iterator[Statement]:
    """Yields what the records determine of the events."""
    events, count = recording.events, recording.count
    names = Counter(str(event.get("event")) for event in events)
    yield Statement("number of events 'start'", names["start"], 1, "one run")
    yield Statement("first event", events[0].get("event"), "start", "one run")
    if recording.cut_sentence:  # records may be missing
        return
    yield Statement("number of events 'stop'", names["stop"], 1, "one run")
    stop = events[-1]
    yield Statement("last event", stop.get("event"), "stop", "one run")
    for event in events:
        tick = event.get("tick")
        if type(tick) is not int or not 0 <= tick <= count:
            name = f"tick of the event '{event.get('event')}'"
            yield Statement(name, tick, f"0 to {count}", "the records")
    has_tripped = str(stop.get("reason")).startswith(("SafetyTrip: ", "trip"))
    if has_tripped:
        yield Statement("event 'trip'", names["trip"] > 0, True, "reason of the event 'stop'")
    for name, counted in (
        ("overruns", timing.overruns),
        ("skipped", timing.skipped),
        ("dropped", 0),  # the records are contiguous
    ):
        stated = stop.get(name)
        # a tick that was refused is counted, but has no record
        is_refused = has_tripped and isinstance(stated, int) and stated > counted
        if not is_refused:
            yield Statement(f"'{name}' of the event 'stop'", stated, counted, "the records")


# Metadata against the compiled scene


def scene_statements(
    scene: Scene, recording: RecordingFile, run: AuditedRun, *, is_exact: bool
) -> Iterator[Statement]:
    """Yields what the scene determines; ``is_exact`` is False for another processor's."""
    meta, source = recording.meta, "the attached sources"
    values, changes = _json(meta, "scene_parameters"), _json(meta, "scene_changes")
    yield Statement("metadata 'scene_parameters'", values, scene.parameters, source)
    yield Statement(
        "metadata 'scene_changes'", _reasoned(changes), _reasoned(scene.changes), source
    )
    parameters = run.parameters
    state = recording.attachments.get(STATE_ATTACHMENT, b"")
    start = start_state(scene.model, scene.data)
    stated = np.frombuffer(state, "<f8") if len(state) == start.nbytes else np.zeros(0)
    agrees = stated.size == start.size and _agrees(stated, start, is_exact=is_exact)
    yield Statement(f"attachment '{STATE_ATTACHMENT}'", agrees or "another", True, source)
    if not run.method.has_law:
        return
    is_absolute = parameters.handle_origin == IDENTITY_POSE
    grip = IDENTITY_POSE if is_absolute else scene.grip_pose()
    unloaded, guard = replace(parameters, handle_origin=grip), parameters.guarding
    load = static_load(scene, unloaded)
    weights = float(np.linalg.norm(load[:3])), float(np.linalg.norm(load[3:]))
    idle = IDLE_FORCE + weights[0], IDLE_TORQUE + weights[1]
    pairs: list[tuple[str, object, object]]
    pairs = [("idle_force", guard.idle_force, idle[0]), ("idle_torque", guard.idle_torque, idle[1])]
    if guard == UNGUARDED:
        pairs = []
    if not is_absolute:
        origin = start_handle(scene, unloaded, load)
        pairs.append(("handle_origin", parameters.handle_origin, origin))
    for name, given, expected in pairs:
        if not _agrees(given, expected, is_exact=is_exact):
            yield Statement(f"metadata '{name}'", given, expected, source)


def _reasoned(changes: Any) -> Any:
    """Returns changes of a scene without the reason in brackets, which may be the user's wish."""
    if not isinstance(changes, (list, tuple)):
        return changes
    return [str(change).partition(" (")[0] for change in changes]


def _agrees(stated: Any, derived: Any, *, is_exact: bool) -> bool:
    if is_exact:
        return bool(np.array_equal(stated, derived))
    return bool(np.allclose(stated, derived, rtol=_TOLERANCE, atol=_TOLERANCE))


def _json(meta: Mapping[str, str], name: str) -> Any:
    try:
        return json.loads(meta.get(name, "null"))
    except (ValueError, RecursionError):
        return None
