"""Facts that a recording states more than once, or that follow from others in it.

A recording is written by anyone who has it, with all its checksums. What one part states and the
others determine must therefore agree.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import PurePosixPath
from typing import Any, NamedTuple

import numpy as np

from hapticbridge.audit.structure import Fault
from hapticbridge.audit.timing import TimingTally
from hapticbridge.demand.trip import BY_TRIP
from hapticbridge.files import read_json
from hapticbridge.kernel.parameters import GuardParameters
from hapticbridge.recording import RecordingFile
from hapticbridge.run.description import (
    CARRIED,
    FELT,
    SOURCE_PREFIX,
    STATE_ATTACHMENT,
    metas_of,
    parameters_of,
    sample_at,
    start_state,
)
from hapticbridge.run.request import refused_request, request_of, setups_of
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


# Metadata against the request


def metadata_statements(recordings: Sequence[RecordingFile]) -> Iterator[Statement]:
    """Yields what the request determines of each hand's metadata without the scene."""
    meta, source = recordings[0].meta, "request and start"
    request = request_of(meta)
    main = next((n for n in recordings[0].attachments if n.startswith(SOURCE_PREFIX)), None)
    if main is not None:
        name = PurePosixPath(main).name
        yield Statement("the requested scene", request.scene, name, "the sources")
    # with the option at its default the device decides, and the compiled scene tells
    words = (FELT, CARRIED) if request.options.tool_weight else (CARRIED,)
    stated = meta.get("tool_weight")
    expected = stated if stated in words else words[0]
    yield Statement("metadata 'tool_weight'", stated, expected, source)
    for setup, own in zip(setups_of(meta), metas_of(meta), strict=True):
        stored = parameters_of(own)
        with refused_request():
            rebuilt = setup.unloaded(sample_at(stored.device_start), stored.effective)
        rebuilt = replace(rebuilt, guarding=_loaded(rebuilt.guarding, stored.guarding))
        if not setup.workspace.absolute:
            rebuilt = replace(rebuilt, handle_origin=stored.handle_origin)
        if not setup.method.is_weld:
            rebuilt = replace(rebuilt, effective=None)
        yield from _differences(own, request.description(setup, rebuilt), source)


def _loaded(guard: GuardParameters, stored: GuardParameters) -> GuardParameters:
    """Returns guard parameters with the load of the tool that stored ones have.

    The scene determines it; without the scene it must be one load >= 0 in all of them.
    """
    changes: dict[str, Any] = {}
    for kind in ("force", "torque"):
        idle, hold = f"idle_{kind}", f"hold_{kind}"
        load = getattr(stored, idle) - getattr(guard, idle)
        if load >= 0:
            held, own = getattr(guard, hold) + load, getattr(stored, hold)
            changes |= {idle: getattr(stored, idle)}
            changes |= {hold: own if _agrees(own, held, is_exact=False) else held}
    return replace(guard, **changes)


def _differences(
    meta: Mapping[str, str], derived: Mapping[str, str], source: str, *, is_exact: bool = True
) -> Iterator[Statement]:
    """Yields the texts, and fields of data sheet and guard, beside those that are derived."""
    for name, text in derived.items():
        stated_text = meta.get(name)
        pairs = [(f"metadata '{name}'", stated_text, text)]
        if name in _KINDS and stated_text != text:
            own, fields = _json(meta, name), _json(derived, name)
            pairs = [(f"{_KINDS[name]} '{each}'", own.get(each), fields[each]) for each in fields]
        for field, stated, expected in pairs:
            if is_exact or not _are_near(stated, expected):
                yield Statement(field, stated, expected, source)


_KINDS = {"guard": "guard parameter", "device": "data of the device:"}
"""Metadata that are a JSON object, and the kind of their fields in words."""


# Events against records


def event_statements(recording: RecordingFile, timing: TimingTally) -> Iterator[Statement]:
    """Yields what the records determine of the events."""
    events, count = recording.events, recording.count
    names = Counter(str(event.get("event")) for event in events)
    yield Statement("number of events 'start'", names["start"], 1, "the events of a run")
    yield Statement("first event", events[0].get("event"), "start", "the events of a run")
    if recording.cut_sentence:  # records may be missing
        return
    yield Statement("number of events 'stop'", names["stop"], 1, "the events of a run")
    stop = events[-1]
    yield Statement("last event", stop.get("event"), "stop", "the events of a run")
    for event in events:
        tick = event.get("tick")
        if type(tick) is not int or not 0 <= tick <= count:
            name = f"tick of the event '{event.get('event')}'"
            yield Statement(name, tick, f"0 to {count}", "the records")
    has_tripped = stop.get("reason") == BY_TRIP
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
    scene: Scene, recording: RecordingFile, *, is_exact: bool
) -> Iterator[Statement]:
    """Yields what the scene determines; ``is_exact`` is False for another processor's.

    Whether a tool is carried is a fact of the start, which the compiled model holds: its rehearsal
    may take longer than the audit.

    Raises:
        RecordingError: The request is refused in this scene.
    """
    meta, source = recording.meta, "the attached sources"
    values, changes = _json(meta, "scene_parameters"), _json(meta, "scene_changes")
    yield Statement("metadata 'scene_parameters'", values, scene.parameters, source)
    stated, derived = _determined(changes, scene), _determined(list(scene.changes), scene)
    yield Statement("metadata 'scene_changes'", stated, derived, source)
    state = recording.attachments.get(STATE_ATTACHMENT, b"")
    start = start_state(scene.model, scene.data)
    stated = np.frombuffer(state, "<f8") if len(state) == start.nbytes else np.zeros(0)
    agrees = stated.size == start.size and _agrees(stated, start, is_exact=is_exact)
    yield Statement(f"attachment '{STATE_ATTACHMENT}'", agrees or "another", True, source)
    request, source = request_of(meta), "request and attached sources"
    for setup, own in zip(setups_of(meta, scene), metas_of(meta), strict=True):
        parameters = parameters_of(own)
        sample = sample_at(parameters.device_start)
        with refused_request():
            applied = setup.parameters(sample, parameters.effective)
        derived = request.description(setup, applied)
        yield from _differences(own, derived, source, is_exact=is_exact)


def _determined(changes: Any, scene: Scene) -> Any:
    """Returns the changes that the scene alone determines.

    The weight of a tool is carried for a reason of the run, and recorded as ``tool_weight`` too.
    """
    if not isinstance(changes, list) or len(changes) != len(scene.differences):
        return changes
    own = zip(changes, scene.differences, strict=True)
    return [words for words, difference in own if not difference.reason]


def _agrees(stated: Any, derived: Any, *, is_exact: bool) -> bool:
    if is_exact:
        return bool(np.array_equal(stated, derived))
    return bool(np.allclose(stated, derived, rtol=_TOLERANCE, atol=_TOLERANCE))


def _are_near(stated: Any, derived: Any) -> bool:
    """Returns True for numbers, or texts of them, that another processor may have rounded."""
    try:
        numbers = [
            np.asarray(read_json(each) if isinstance(each, str) else each, float)
            for each in (stated, derived)
        ]
    except (ValueError, TypeError):
        return False
    return numbers[0].shape == numbers[1].shape and _agrees(*numbers, is_exact=False)


def _json(meta: Mapping[str, str], name: str) -> Any:
    try:
        return read_json(meta.get(name, "null"))
    except ValueError:
        return None
