"""Loop of a scene that is slower than the bridge's, beside it.

    bridge's loop, every T                        scene's loop, every n T
    before_step: the handle moves
    exchange: the last result is taken over,  ──▶ one tick of MuJoCo with this handle,
              the handle is handed over           in a thread of its own
    answer_step: the shown tool's wrench      ◀── its result, taken over when it is due

The bridge's loop never waits for the scene: a result that is late is taken over when it is there,
and the tool is shown meanwhile as it was foreseen (``kernel.shown_tool``). The record's
``scene_step`` tells in which tick a result was taken over, so a re-simulation repeats the order.
In simulated time every result is in time.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.errors import HapticBridgeError
from hapticbridge.kernel.codes import BAD_RESULT, OK
from hapticbridge.kernel.jit import direct
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.kernel.record import SAMPLE_DTYPE
from hapticbridge.kernel.shown_tool import fail_scene
from hapticbridge.kernel.state import BoundKernel
from hapticbridge.kernel.tick import (
    after_step,
    before_step,
    end_scene_step,
    simulate_shown,
    take_result,
)

MAX_WAIT = 2.0
"""Time in s that the end of a run waits for a step of the scene, and after which a result that is
due counts as missing. A shorter one lets the force go in scenes that are merely slow."""


class SlowScene:
    """Loop of a scene that steps once in n ticks of the bridge.

    Args:
        front: The bridge's bound kernel, which shows the tool.
        model: The prepared scene.
        data: Its data, at the start.
        parameters: Parameters of the run, with ``scene_ticks`` n >= 2.

    Attributes:
        bound: The scene's own bound kernel.
    """

    def __init__(
        self,
        front: BoundKernel,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        parameters: RunParameters,
    ) -> None:
        self.bound = BoundKernel(model, data, parameters.of_scene, front)
        self._front, self._model, self._data = front, model, data
        self._scene_ticks, self._substeps = parameters.scene_ticks, range(parameters.substeps)
        self._scene_period, self._loop_period = parameters.of_scene.period, parameters.period
        self._sample = np.zeros(1, SAMPLE_DTYPE)
        self._changes: deque[Callable[[], None]] = deque()
        self._publish: Callable[[BoundKernel], None] | None = None
        shown = front.state["shown"]
        self._age, self._waits = shown["age"], shown["waits"]
        state, row = self.bound.state, self.bound.row
        self._take_result = direct(take_result, front.state, state, self._sample)
        self._before = direct(before_step, state, self._sample, row, 0, 0.0)
        self._end = direct(after_step, state, row, 0)
        self.step = self.bound.step
        self._thread: threading.Thread | None = None
        self._wake, self._done = threading.Semaphore(0), threading.Event()
        self._is_closed, self._code = False, OK
        self._error: Exception | None = None

    def queue_change(self, apply: Callable[[], None]) -> None:
        """Applies a change of the scene before its next step, when no step is under way."""
        self._changes.append(apply)

    def settle(self) -> None:
        """Ends the step under way without taking it over, and applies the waiting changes.

        The bridge's loop waits for it unless it ``is_idle``. If the step diverged, the next tick
        trips, as it would have with its result.

        Raises:
            HapticBridgeError: The step takes longer than ``MAX_WAIT``.
        """
        if self._waits[0]:
            self._finish_step()
            fail_scene(self._front.state["shown"], self._code)
        self._apply_changes()

    @property
    def is_idle(self) -> bool:
        """True if no step is under way that the loop would have to wait for."""
        return self._thread is None or not self._waits[0] or self._done.is_set()

    @property
    def is_missing(self) -> bool:
        """True if a result is overdue by more than ``MAX_WAIT``."""
        return not self.is_idle and self._age[0] * self._loop_period > self._scene_period + MAX_WAIT

    @property
    def missing_words(self) -> str:
        """Sentence for a user once the force is off for it."""
        return (
            f"a step of the scene takes more than {MAX_WAIT:g} s: the force is off until it ends; "
            "'hapticbridge check' finds what is slow"
        )

    @property
    def is_running(self) -> bool:
        """True if the thread is alive; after ``close``, if a step did not end."""
        return self._thread is not None and self._thread.is_alive()

    def _apply_changes(self) -> None:
        while self._changes:
            self._changes.popleft()()

    def note_picture(self, publish: Callable[[BoundKernel], None]) -> None:
        """Publishes the scene's positions when the next result is taken over."""
        self._publish = publish

    # In the live loop

    def start(self) -> None:
        """Starts the thread; without it every step is done when its result is due."""
        # a long step must not hold the interpreter lock, which the loop needs
        self._end = direct(end_scene_step, self.bound.state, self.bound.row, 0)
        self._thread = threading.Thread(target=self._work, name="scene", daemon=True)
        self._thread.start()

    def exchange(self, _model: mujoco.MjModel, _data: mujoco.MjData) -> None:
        """Takes over the scene's result if it is due and there, and hands over the handle.

        It stands where the loop of another scene has MuJoCo's step.

        Raises:
            Exception: MuJoCo's, from the scene's step.
        """
        if self._waits[0]:
            if self._age[0] < self._scene_ticks:
                return
            if not self.is_idle:  # late; the shown pose stays
                return
            self._finish_step()
            if self._code != OK:
                fail_scene(self._front.state["shown"], self._code)
                return
        self._take_result(self._front.state, self.bound.state, self._sample)
        self._apply_changes()
        if self._publish is not None:
            self._publish(self.bound)
            self._publish = None
        if self._thread is not None:
            self._done.clear()
            self._wake.release()

    def _finish_step(self) -> None:
        if self._thread is None:
            self._code = self._do_step()
        elif not self._done.wait(MAX_WAIT):
            raise HapticBridgeError(f"a step of the scene takes more than {MAX_WAIT:g} s")
        if self._error is not None:
            raise self._error

    def _work(self) -> None:
        while not self._is_closed:
            if not self._wake.acquire(timeout=MAX_WAIT):
                continue
            if self._is_closed:
                return
            try:
                self._code = self._do_step()
            except Exception as error:  # raised again in the bridge's loop
                self._error = error
            self._done.set()

    def _do_step(self) -> int:
        """Runs one tick of the scene; returns ``OK``, or why its result is not usable."""
        state, row, period = self.bound.state, self.bound.row, self._scene_period
        for substep in self._substeps:
            if self._before(state, self._sample, row, substep, period) != OK:
                return BAD_RESULT
            self.step(self._model, self._data)
            code = self._end(state, row, substep)
            if code != OK:
                return code
        return OK

    def close(self) -> None:
        """Ends the thread after its present step, which is waited for ``MAX_WAIT`` s.

        A longer step goes on and ``is_running``; model and data then stay as they are, because it
        works on them.
        """
        self._is_closed = True
        self._wake.release()
        if self._thread is not None:
            self._thread.join(MAX_WAIT)
        if not self.is_running:
            self.bound.release()

    # Whole ticks in compiled code

    def simulate(
        self,
        samples: NDArray[np.void],
        external_flags: NDArray[np.int64],
        elapsed: NDArray[np.float64],
        scene_steps: NDArray[np.int64],
        rows: NDArray[np.void],
    ) -> int:
        """Runs the ticks of a recorded run; arguments and result as for ``simulate_shown``.

        Changes are applied after the next result, as in the live loop.
        """
        states = self._front.state, self.bound.state
        own = self._front.row, self.bound.row, self._sample
        step, done = self._front.state["shown"]["scene_step"], 0
        while done < len(samples):
            end, is_taken = len(samples), False
            if self._changes:  # up to the tick that takes over the next result
                risen = scene_steps[done:] > step[0] if self._waits[0] else np.ones(1, np.bool_)
                if is_taken := bool(risen.any()):
                    end = done + int(np.argmax(risen)) + 1
            part = slice(done, end)
            count = simulate_shown(
                states,
                samples[part],
                (external_flags[part], elapsed[part], scene_steps[part]),
                own,
                rows[part],
            )
            done += count
            if done < end:
                break
            if is_taken:
                self._apply_changes()
        return done
