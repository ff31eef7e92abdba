"""Re-simulation of a recorded run, compared with the recording in every number."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit.agreement import first_contradiction, scene_statements
from hapticbridge.audit.events import AuditedRun
from hapticbridge.audit.recorded_scene import bounds_for, compile_recorded, is_as_recorded
from hapticbridge.audit.structure import first_row
from hapticbridge.confinement import Confined, Unlimited, Worker
from hapticbridge.errors import HapticBridgeError, RecordingError
from hapticbridge.files import read_json
from hapticbridge.kernel.codes import WARNINGS
from hapticbridge.kernel.mujoco_c import quiet, warning_of, without_timers
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.kernel.record import CLOCK_FIELDS, SAMPLE_DTYPE, TICK_DTYPE, TickFlag
from hapticbridge.kernel.state import BoundHands, BoundKernel
from hapticbridge.kernel.tick import simulate_recorded
from hapticbridge.recording import RecordingFile
from hapticbridge.run.commands import CHANGES as COMMANDED
from hapticbridge.run.commands import EventApplier
from hapticbridge.run.description import (
    SOURCE_PREFIX,
    STARTS,
    STATE_ATTACHMENT,
    meta_start,
    method_of,
    processor,
    restore_state,
    start_of,
    versions,
)
from hapticbridge.run.posted_scene import PostedScene, posts_in
from hapticbridge.run.slow_scene import SlowScene
from hapticbridge.run.unpacked import NoRoomError
from hapticbridge.scene import Scene
from hapticbridge.scene.compile import clause

# Attached scene


class ForeignModelError(RecordingError):
    """Another processor compiles the attached sources to another model."""


FOREIGN_TOLERANCE = 1e-9
"""Allowed difference on another processor, relative to a field's largest value; other vector
instructions round differently. A larger tolerance would hide tampering, a smaller one would refuse
honest recordings."""


def attached_scene(recording: RecordingFile) -> Scene:
    """Compiles the attached sources, which must give the recorded model in every bit.

    Raises:
        ForeignModelError: Another processor compiled another model.
        NoRoomError: This machine cannot hold the sources.
        RecordingError: The sources cannot be compiled, or give another model on this processor.
    """
    scene = compile_recorded(recording)
    if is_as_recorded(scene, recording):
        return scene
    reason = "the attached sources do not compile to the recorded model (scene_sha256)"
    if not is_same_processor(recording):
        raise ForeignModelError(f"{reason}: another processor compiled it")
    raise RecordingError(
        f"{reason}: the recording was changed, or a program changed the model after loading"
    )


def check_start(recording: RecordingFile, state: NDArray[np.void]) -> None:
    """Refuses metadata that contradict the start of the attached scene.

    Raises:
        RecordingError: They do.
    """
    for name in STARTS:
        recorded = meta_start(recording.meta, name)
        present = start_of(state, name)
        if not np.allclose(recorded, present, rtol=FOREIGN_TOLERANCE, atol=FOREIGN_TOLERANCE) or (
            is_same_processor(recording) and recorded != present
        ):
            raise RecordingError(
                f"metadata '{name}' is {recorded}, the attached scene starts with {present}"
            )


def is_same_processor(recording: RecordingFile) -> bool:
    """Returns True if the recording's processor model is this one or not stated."""
    try:
        return bool(read_json(recording.meta["host"])["processor"] == processor())
    except (KeyError, TypeError, ValueError):
        return True


# Re-simulation

DECISIVE = ("hapticbridge", "mujoco", "numba")
"""Packages whose versions must match for a repetition to the bit."""

_CHANGES = ("input", "resume", *COMMANDED)
"""Events that change the computation of later ticks."""


class Resimulator:
    """Simulation of a recorded device motion in the attached scene.

    The recording must have no ``obstacle``. Its events are applied when due.

    Args:
        recording: The recording; of several hands, the first hand's.
        parameters: Parameters of the run.
        scene: The attached scene, if it is compiled already.
        others: Recording and parameters of each further hand.

    Attributes:
        scene: The attached scene, at its start.
        model: Its model.
        data: Its state after the last simulated tick.
        binding: The kernel's state bound to both; of several hands, that of the first.
        hands: The states of all hands if there are several; else None.
        done: Number of simulated ticks.
        is_over: True after a tick that was refused; nothing follows.

    Raises:
        RecordingError: The attachments contradict the metadata, so the file was changed.
    """

    def __init__(
        self,
        recording: RecordingFile,
        parameters: RunParameters,
        scene: Scene | None = None,
        others: Sequence[tuple[RecordingFile, RunParameters]] = (),
    ) -> None:
        events = recording.events
        self._changes = deque(event for event in events if event.get("event") in _CHANGES)
        self._resumed: list[Any] = [
            event.get("tick") for event in events if event.get("event") == "resume"
        ]
        self._changed = self._read_ns = 0
        self.done, self.is_over = 0, False
        every = parameters, *(own for _, own in others)
        self.scene = scene or attached_scene(recording)
        self.model = model = self.scene.model
        self.data = data = mujoco.MjData(model)
        # an error inside the C function would end the process; the first step in Python raises
        start = recording.attachments[STATE_ATTACHMENT]
        method = method_of(recording.meta)
        try:
            restore_state(model, data, start)
            method.step(model, data)
            restore_state(model, data, start)
        except mujoco.FatalError as error:
            raise RecordingError(f"MuJoCo stopped in its first step: {clause(error)}") from None
        self.hands = BoundHands(model, data, every) if others else None
        self.binding = self.hands.hands[0] if self.hands else BoundKernel(model, data, parameters)
        self._slow: SlowScene | PostedScene | None = None
        if parameters.credit > 0.0:
            self._slow = PostedScene(self.binding, data, parameters, posts_in(events))
        elif parameters.scene_ticks:
            self._slow = SlowScene(self.binding, model, data, parameters)
        hands = tuple(zip((self.hands or self.binding).hands, every, strict=True))
        self._commands = EventApplier(hands, data, method, start, self._slow)
        check_start(recording, self.binding.state)
        if self.hands is not None:
            for hand, (other, _) in enumerate(others, 1):
                check_start(other, self.hands.state[hand : hand + 1])

    @property
    def slack(self) -> float:
        """Energy that the environment may have created so far, in J."""
        return self.binding.slack

    @without_timers()
    @quiet()
    def add(self, ticks: NDArray[np.void]) -> NDArray[np.void]:
        """Simulates the next ticks.

        Only the external inputs of the records are used.

        Args:
            ticks: Records, (n,); of several hands, (n, m).

        Returns:
            Simulated records; fewer if it ``is_over``.

        Raises:
            RecordingError: An event among them is damaged.
        """
        samples = np.zeros(ticks.shape, SAMPLE_DTYPE)
        samples["position"], samples["quaternion"] = (
            ticks["device_position"],
            ticks["device_quaternion"],
        )
        samples["buttons"] = ticks["buttons"]
        outside = ticks["flags"] & int(TickFlag.STALE_SAMPLE)
        # a view of a record is read-only, for which no machine code is on disk
        scene_steps, reported = ticks["scene_step"].copy(), ticks["wrench_on_device"].copy()
        elapsed = self._elapsed(ticks if self.hands is None else ticks[:, 0])
        rows = np.zeros(ticks.shape, TICK_DTYPE)
        own, done = self.hands or self.binding, 0
        by_hand = len(ticks), own.state.size
        each, found = samples.reshape(by_hand), rows.reshape(by_hand)
        flags, reported = outside.reshape(by_hand), reported.reshape(*by_hand, 6)
        while done < len(ticks) and not self.is_over:
            end = len(ticks)
            if self._changes:
                end = min(self._due(self._changes[0]) - self.done, end)
            part = slice(done, end)
            if self._slow is not None:
                inputs = samples[part], outside[part], elapsed[part]
                count = self._slow.simulate(*inputs, scene_steps[part], rows[part])
            else:
                recorded = flags[part], elapsed[part], reported[part]
                count = simulate_recorded(own.state, each[part], recorded, own.row, found[part])
            self.is_over = count < end - done
            done += count
            if self._changes and done == end < len(ticks):
                self._apply(self._changes.popleft())
        self.done += done
        return rows[:done]

    def finish(self) -> None:
        """Applies the events after the last tick.

        Raises:
            RecordingError: One of them is damaged.
        """
        while self._changes and not self.is_over:
            self._due(self._changes[0])
            self._apply(self._changes.popleft())

    def _elapsed(self, ticks: NDArray[np.void]) -> NDArray[np.float64]:
        """Returns the times in s between two readings, as counted by the live loop."""
        read = ticks["read_ns"]
        before = np.concatenate([[self._read_ns], read[:-1]])
        before[np.isin(ticks["tick"], self._resumed)] = 0
        self._read_ns = int(read[-1])
        return np.asarray(1e-9 * (read - before))

    def _due(self, event: Mapping[str, Any]) -> int:
        tick = event.get("tick")
        if not isinstance(tick, int) or tick < self._changed:
            raise RecordingError(
                f"event '{event['event']}' has tick {tick!r}, which is out of order"
            )
        return tick

    def _apply(self, event: Mapping[str, Any]) -> None:
        self._changed = int(event["tick"])
        if event["event"] == "resume":
            (self.hands or self.binding).resume()
            return
        if event["event"] in COMMANDED:
            self._commands.apply(event)
            return
        try:
            self._commands.write(event.get("writes", []))
        except (HapticBridgeError, TypeError, ValueError) as error:
            raise RecordingError(
                f"event 'input' at tick {event.get('tick')} is damaged: {error}"
            ) from None


def obstacle(recording: RecordingFile) -> str:
    """Returns the reason why a run cannot be simulated again here; empty if it can."""
    try:
        recorded = dict(read_json(recording.meta.get("versions", "")))
    except (ValueError, TypeError):
        return "the metadata name no versions"
    present = versions()
    for name in DECISIVE:
        if recorded.get(name) != present[name]:
            return f"recorded with {name} {recorded.get(name, 'unknown')}, here is {present[name]}"
    if STATE_ATTACHMENT not in recording.attachments:
        return f"the file has no attachment '{STATE_ATTACHMENT}'"
    has_sources = any(name.startswith(SOURCE_PREFIX) for name in recording.attachments)
    return "" if has_sources else f"the file has no attachment '{SOURCE_PREFIX}…'"


# Comparison


class Agreement(StrEnum):
    """Outcome of a re-simulation."""

    EXACT = "bit for bit"
    NEAR = "within 1e-9 (other processor)"
    DISAGREES = "disagrees"
    NOT_RUN = "not re-simulated"


_EXTERNAL = int(TickFlag.OVERRUN | TickFlag.DROPPED_BEFORE | TickFlag.STALE_SAMPLE)
"""Flags set by clock, recorder and device instead of the simulation."""


@dataclass(frozen=True, slots=True)
class ReplayOutcome:
    """Outcome of a re-simulation.

    Attributes:
        agreement: Outcome.
        obstacle: Reason why there was no re-simulation; empty if there was one.
        tick: First tick that disagrees, or None.
        field: First field of that tick that disagrees.
        difference: Size of the disagreement.
        warning: Reason for which MuJoCo's warnings stop the run there; empty without one.
    """

    agreement: Agreement
    obstacle: str = ""
    tick: int | None = None
    field: str = ""
    difference: float = 0.0
    warning: str = ""

    @property
    def disagrees(self) -> bool:
        """True if the scene does not repeat the recording under the recorded motion."""
        return self.tick is not None


@dataclass(frozen=True, slots=True)
class AuditedHand:
    """Records of a hand and the run that their metadata and events describe."""

    recording: RecordingFile
    run: AuditedRun


def blocks_of_hands(hands: Sequence[AuditedHand]) -> Iterator[NDArray[np.void]]:
    """Yields the records in blocks, (n,); of several hands, (n, m)."""
    if len(hands) == 1:
        yield from hands[0].recording.blocks()
        return
    streams = [hand.recording.blocks() for hand in hands]
    for blocks in zip(*streams, strict=True):
        yield np.stack(blocks, axis=1)


@contextmanager
def comparison(
    hands: Sequence[AuditedHand], *, is_trusted: bool = False
) -> Iterator[Callable[[], ReplayOutcome]]:
    """Simulates the recorded device motion again and compares every number except times.

    It is done beside the work in the context, in a child process with limits (``confinement``),
    unless the recording is trusted.

    Yields:
        Function that waits for the outcome.

    Raises:
        ForeignSceneError: By that function: the child process crashed, or exceeded its limits.
        RecordingError: By that function: the attachments contradict the metadata, or an event is
            damaged; the file was changed.
    """
    recording, parameters = hands[0].recording, hands[0].run.parameters
    if reason := obstacle(recording):
        yield lambda: ReplayOutcome(Agreement.NOT_RUN, reason)
        return
    if is_trusted:
        yield lambda: _compared(hands, Unlimited())
        return
    with Confined(
        lambda worker: asdict(_compared(hands, worker)),
        f"the scene of '{recording.path}'",
        **bounds_for(recording, parameters),
    ) as child:
        yield lambda: _received(child.result())


def _received(result: dict[str, Any]) -> ReplayOutcome:
    return ReplayOutcome(**result | {"agreement": Agreement(result["agreement"])})


def _compared(hands: Sequence[AuditedHand], worker: Worker) -> ReplayOutcome:
    recording, parameters = hands[0].recording, hands[0].run.parameters
    others = [(hand.recording, hand.run.parameters) for hand in hands[1:]]
    try:
        scene = attached_scene(recording)
    except (ForeignModelError, NoRoomError) as error:
        return ReplayOutcome(Agreement.NOT_RUN, str(error))
    worker.allow_run()
    run = Resimulator(recording, parameters, scene, others)
    is_exact = is_same_processor(recording)
    stated = scene_statements(run.scene, recording, is_exact=is_exact)
    if fault := first_contradiction(stated):
        raise RecordingError(fault.reason)
    names = [name for name in TICK_DTYPE.names or () if name not in CLOCK_FIELDS]
    off, largest = dict.fromkeys(names, 0.0), dict.fromkeys(names, 0.0)
    first: tuple[int, str, float] | None = None
    for ticks in blocks_of_hands(hands):
        start = run.done
        again = run.add(ticks)
        for name in names if len(again) else ():
            recorded, simulated = ticks[name][: len(again)], again[name]
            if name == "flags":
                recorded, simulated = recorded & ~_EXTERNAL, simulated & ~_EXTERNAL
            largest[name] = max(largest[name], float(np.abs(simulated).max()))
            row = first_row((recorded != simulated).reshape(len(again), -1).any(axis=1))
            if row is None:
                continue
            difference = np.abs(recorded - simulated).reshape(len(again), -1).max(axis=1)
            off[name] = max(off[name], float(difference.max()))
            if first is None or start + row < first[0]:
                first = start + row, name, float(difference[row])
        if run.is_over:
            break
    run.finish()
    if first is None and run.is_over:
        warning = WARNINGS.get(warning_of(run.data), "")
        off_now = run.done, "tool_position", math.nan, warning
        return ReplayOutcome(Agreement.DISAGREES, "", *off_now)
    if first is None:
        return ReplayOutcome(Agreement.EXACT)
    worst = max(off[name] / max(largest[name], 1.0) for name in names)
    if not run.is_over and not is_same_processor(recording) and worst <= FOREIGN_TOLERANCE:
        return ReplayOutcome(Agreement.NEAR)
    return ReplayOutcome(Agreement.DISAGREES, "", *first)
