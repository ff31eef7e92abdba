"""A recorded run, simulated again: the whole scene at every tick, not only what was recorded."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit.attached_scene import attached_model, check_start
from hapticbridge.commands import CHANGES as COMMANDED
from hapticbridge.commands import Repeater
from hapticbridge.errors import HapticBridgeError, RecordingError
from hapticbridge.inputs import apply_writes
from hapticbridge.jsonable import read_json
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.kernel.simulation import simulate_recorded
from hapticbridge.kernel.state import Binding
from hapticbridge.provenance import MODEL_ATTACHMENT, STATE_ATTACHMENT, restore_state, versions
from hapticbridge.recording import RecordingFile
from hapticbridge.rendering import method_named
from hapticbridge.tick import SAMPLE_DTYPE, TICK_DTYPE, TickFlag

DECISIVE = ("hapticbridge", "mujoco", "numba")
"""Packages whose versions must match for a run to be repeated to the bit."""

_CHANGES = ("input", "resume", *COMMANDED)
"""Events that change what the next ticks compute."""


class Rerun:
    """Simulates a recorded device motion again, through what the recording carries.

    Args:
        recording: What is simulated again, without an ``obstacle``. Its events are taken as they
            fall due; more may be told with ``note``.
        parameters: Of the recorded run.

    Attributes:
        model: The attached scene.
        data: Its state after the last tick that was simulated.
        binding: The kernel's state bound to both.
        done: How many ticks that are.
        is_over: Whether a sample or a result was not finite, so that nothing follows.

    Raises:
        RecordingError: The attachments contradict the metadata, so the file was changed.
    """

    def __init__(self, recording: RecordingFile, parameters: RunParameters) -> None:
        self._changes: deque[Mapping[str, Any]] = deque()
        self._resumed: list[Any] = []
        for event in recording.events:
            self.note(event)
        self._changed = self._read_ns = 0
        self.done, self.is_over = 0, False
        self.model = model = attached_model(recording, parameters)
        self.data = data = mujoco.MjData(model)
        # an error inside the C symbol would end the process, so MuJoCo takes its first step in
        # Python
        self._start = start = recording.attachments[STATE_ATTACHMENT]
        method = method_named(recording.meta.get("method", ""))
        restore_state(model, data, start)
        method.step(model, data)
        restore_state(model, data, start)
        self.binding = Binding(model, data, parameters)
        self._commands = Repeater(self.binding, model, data, method, parameters, start)
        check_start(recording, self.binding.state)

    def warm_up(self) -> None:
        """Compiles what ``add`` needs, so that the first call takes no longer than others."""
        binding = self.binding
        simulate_recorded(
            binding.state,
            np.zeros(0, SAMPLE_DTYPE),
            np.zeros(0, TICK_DTYPE)["flags"],
            np.zeros(0),
            binding.row,
            np.zeros(0, TICK_DTYPE),
        )

    @property
    def slack(self) -> float:
        """What the environment may have created by now, in J."""
        return float(self.binding.state["slack"][0])

    def note(self, event: Mapping[str, Any]) -> None:
        """Takes an event of a run that still goes on; those that change nothing are passed over."""
        if event.get("event") in _CHANGES:
            self._changes.append(event)
        if event.get("event") == "resume":
            self._resumed.append(event.get("tick"))

    def add(self, ticks: NDArray[np.void]) -> NDArray[np.void]:
        """Simulates the next ticks.

        Args:
            ticks: Their records, ``TICK_DTYPE``, at least one; only what came from outside is used.

        Returns:
            Records as simulated; fewer where it ``is_over``.

        Raises:
            RecordingError: An event among them is damaged.
        """
        samples = np.zeros(len(ticks), SAMPLE_DTYPE)
        samples["position"], samples["quaternion"] = (
            ticks["device_position"],
            ticks["device_quaternion"],
        )
        samples["buttons"] = ticks["buttons"]
        outside = ticks["flags"] & int(TickFlag.STALE_SAMPLE | TickFlag.RESEATED)
        elapsed = self._elapsed(ticks)
        rows = np.zeros(len(ticks), TICK_DTYPE)
        done = 0
        while done < len(ticks) and not self.is_over:
            end = len(ticks)
            if self._changes:
                end = min(self._due(self._changes[0]) - self.done, end)
            if end < done:  # in a run that goes on, news may be slower than records
                raise RecordingError(f"an event before tick {self.done + done} came after it")
            state, row, part = self.binding.state, self.binding.row, slice(done, end)
            count = simulate_recorded(
                state, samples[part], outside[part], elapsed[part], row, rows[part]
            )
            self.is_over = count < end - done
            done += count
            if self._changes and done == end < len(ticks):
                self._apply(self._changes.popleft())
        self.done += done
        return rows[:done]

    def jump(self, tick: int, ahead: int = 0) -> None:
        """Goes on from another tick, without those between; what was changed by then is changed.

        The time of the next reading counts from 0.

        Args:
            tick: By which changes are applied.
            ahead: How many ticks before it the next one to be simulated counts as.

        Raises:
            RecordingError: An event by then is damaged; it is left out.
        """
        self.done, self._read_ns, self.is_over = tick - ahead, 0, False
        while self._changes:
            event = self._changes.popleft()  # a damaged one is complained of once
            if self._due(event) > tick:
                self._changes.appendleft(event)
                break
            self._apply(event)

    def restart(self) -> None:
        """Puts the scene back to where the recording began, whatever became of it."""
        restore_state(self.model, self.data, self._start)
        self.binding.take_reset()
        self.is_over = False

    def finish(self) -> None:
        """Applies the events after the last tick.

        Raises:
            RecordingError: One of them is damaged.
        """
        while self._changes and not self.is_over:
            self._due(self._changes[0])
            self._apply(self._changes.popleft())

    def _elapsed(self, ticks: NDArray[np.void]) -> NDArray[np.float64]:
        """Returns the times between two readings in s, as the live loop counted them."""
        read = ticks["read_ns"]
        before = np.concatenate([[self._read_ns], read[:-1]])
        before[np.isin(ticks["tick"], self._resumed)] = 0
        self._read_ns = int(read[-1])
        return np.asarray(1e-9 * (read - before))

    def _due(self, event: Mapping[str, Any]) -> int:
        tick = event.get("tick")
        if not isinstance(tick, int) or tick < self._changed:
            raise RecordingError(f"event '{event['event']}' names tick {tick!r}, out of order")
        return tick

    def _apply(self, event: Mapping[str, Any]) -> None:
        self._changed = int(event["tick"])
        if event["event"] == "resume":
            self.binding.resume()
            return
        if event["event"] in COMMANDED:
            self._commands.apply(event)
            return
        try:
            apply_writes(self.data, event.get("writes", []))
        except (HapticBridgeError, TypeError, ValueError) as error:
            raise RecordingError(
                f"event 'input' at tick {event.get('tick')} is damaged: {error}"
            ) from None


def obstacle(recording: RecordingFile) -> str:
    """Returns why a run cannot be simulated again here, or nothing."""
    try:
        recorded = dict(read_json(recording.meta.get("versions", "")))
    except (ValueError, TypeError):
        return "the metadata name no versions"
    present = versions()
    for name in DECISIVE:
        if recorded.get(name) != present[name]:
            return f"recorded with {name} {recorded.get(name, 'unknown')}, here is {present[name]}"
    missing = [n for n in (MODEL_ATTACHMENT, STATE_ATTACHMENT) if n not in recording.attachments]
    return f"the file has no attachment '{missing[0]}'" if missing else ""
