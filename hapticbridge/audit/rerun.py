"""Re-simulation of a recorded run with its whole scene."""

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
"""Packages whose versions must match for a repetition to the bit."""

_CHANGES = ("input", "resume", *COMMANDED)
"""Events that change the computation of later ticks."""


class Rerun:
    """Simulation of a recorded device motion in the attached scene.

    The recording must have no ``obstacle``. Its events are applied when due; ``note`` adds more.

    Attributes:
        model: The attached scene.
        data: Its state after the last simulated tick.
        binding: The kernel's state bound to both.
        done: Number of simulated ticks.
        is_over: True after a sample or result that is not finite; nothing follows.

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
        # an error inside the C function would end the process; the first step in Python raises
        self._start = start = recording.attachments[STATE_ATTACHMENT]
        method = method_named(recording.meta.get("method", ""))
        restore_state(model, data, start)
        method.step(model, data)
        restore_state(model, data, start)
        self.binding = Binding(model, data, parameters)
        self._commands = Repeater(self.binding, model, data, method, parameters, start)
        check_start(recording, self.binding.state)

    @property
    def slack(self) -> float:
        """Energy that the environment may have created so far, in J."""
        return float(self.binding.state["slack"][0])

    def note(self, event: Mapping[str, Any]) -> None:
        """Adds an event of a running run; events without effect on the simulation are ignored."""
        if event.get("event") in _CHANGES:
            self._changes.append(event)
        if event.get("event") == "resume":
            self._resumed.append(event.get("tick"))

    def add(self, ticks: NDArray[np.void]) -> NDArray[np.void]:
        """Simulates the next ticks.

        Only the external inputs of the records are used.

        Returns:
            Simulated records; fewer if it ``is_over``.

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
            if end < done:  # during a live run, events may arrive after records
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
    """Returns the reason why a run cannot be simulated again here; empty if it can."""
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
