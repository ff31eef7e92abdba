"""Scene of another program, in front of the bridge's loop: it posts the tool's pose at any time.

    bridge's loop, every T                        another program, at its own rate
    before_step: the handle moves
    exchange: the newest post is taken        ◀── post: pose, velocity, surfaces, work
    answer_step: the shown tool's wrench

Neither waits for the other. Every post that was taken over is an event of the recording, and the
record's ``scene_step`` counts them, so a re-simulation repeats the order.
"""

from __future__ import annotations

import base64
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.errors import RecordingError
from hapticbridge.kernel.jit import direct
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.kernel.record import PLANES, POST_DTYPE
from hapticbridge.kernel.shown_tool import take_posted
from hapticbridge.kernel.state import BoundKernel
from hapticbridge.kernel.tick import simulate_posted
from hapticbridge.recording.format import SHOWN_EVENT

PATIENCE, PATIENT_PERIODS = 0.25, 5.0
"""Time in s without a post after which the force fades, and in periods of a slow program. A hand
then feels a tool that stands still; a shorter time lets go whenever a program collects garbage."""


class PostedScene:
    """Scene that another program steps, with the calls of ``SlowScene``.

    Args:
        front: The bridge's bound kernel, which shows the tool.
        data: Data of the scene, in which the tool is moved for pictures alone.
        parameters: Parameters of the run, with a ``credit``.
        posts: All posts of a recorded run; none for a live one.

    Attributes:
        bound: The same kernel; the scene has none of its own.
        is_idle: True; the loop never waits.
        is_running: False; there is no thread.
        patience: Time in s without a post after which the force fades.
    """

    is_idle, is_running = True, False

    def __init__(
        self,
        front: BoundKernel,
        data: mujoco.MjData,
        parameters: RunParameters,
        posts: NDArray[np.void] | None = None,
    ) -> None:
        self.bound = self._front = front
        self._data = data
        self._posts = np.zeros(0, POST_DTYPE) if posts is None else posts
        self._waiting: deque[NDArray[np.void]] = deque(maxlen=1)
        self._taken: list[NDArray[np.void]] = []
        self._slot = np.zeros(1, POST_DTYPE)
        self._take = direct(take_posted, front.state, self._slot)
        shown = front.state["shown"]
        self._silence, self._step = shown["silence"], shown["scene_step"]
        self._loop_period = parameters.period
        self.patience = max(PATIENCE, PATIENT_PERIODS * parameters.scene_period)

    def post(self, post: NDArray[np.void]) -> None:
        """Shows the tool, from any thread; ``post`` is ``POST_DTYPE``, (1,), and kept.

        It takes the place of one that the loop has not taken over.
        """
        self._waiting.append(post)

    @property
    def is_missing(self) -> bool:
        """True if the program has posted nothing yet, or nothing for too long."""
        return not self._step[0] or self._silence[0] * self._loop_period > self.patience

    @property
    def missing_words(self) -> str:
        """Sentence for a user once the force is off for it; empty before the first post."""
        if not self._step[0]:
            return ""
        return f"the program shows no pose for {self.patience:g} s: the force is off until it does"

    def exchange(self, _model: mujoco.MjModel, _data: mujoco.MjData) -> None:
        """Takes over a waiting post; it stands where other scenes have MuJoCo's step."""
        if self._waiting:
            post = self._waiting.popleft()
            self._slot[0] = post[0]
            self._take(self._front.state, self._slot)
            self._taken.append(post)

    def take_notes(self) -> dict[str, Any] | None:
        """Returns the details of an event on what was taken over since the last call, or None."""
        if not self._taken:
            return None
        taken, self._taken = self._taken, []
        data = np.concatenate(taken).tobytes()
        return {"count": len(taken), "posts": base64.b64encode(data).decode()}

    def queue_change(self, _apply: Callable[[], None]) -> None:
        """Does nothing: a change of the coupling is the loop's alone."""

    def note_picture(self, publish: Callable[[BoundKernel], None]) -> None:
        """Publishes the tool for an observer."""
        self._draw()
        publish(self._front)

    def _draw(self) -> None:
        pose = self._front.state["pose"][0]
        if self._data.qpos.size < 7:  # a recorded scene that this package did not make
            return
        self._data.qpos[:3], self._data.qpos[3:7] = pose["tool_position"], pose["tool_quaternion"]

    def settle(self) -> None:
        """Does nothing: no step is under way."""

    def close(self) -> None:
        """Does nothing: nothing is held."""

    def simulate(
        self,
        samples: NDArray[np.void],
        external_flags: NDArray[np.int64],
        elapsed: NDArray[np.float64],
        scene_steps: NDArray[np.int64],
        rows: NDArray[np.void],
    ) -> int:
        """Runs the ticks of a recorded run; arguments and result as for ``simulate_posted``."""
        state, row = self._front.state, self._front.row
        recorded = external_flags, elapsed, scene_steps
        done = simulate_posted(state, samples, recorded, self._posts, row, rows)
        self._draw()
        return done


def posts_in(events: Sequence[Mapping[str, Any]]) -> NDArray[np.void]:
    """Returns all posts of a recorded run, in order.

    Raises:
        RecordingError: An event is damaged.
    """
    return np.concatenate([np.zeros(0, POST_DTYPE), *_decoded(events)])


def _decoded(events: Sequence[Mapping[str, Any]]) -> Iterator[NDArray[np.void]]:
    for event in events:
        if event.get("event") != SHOWN_EVENT:
            continue
        try:
            data = base64.b64decode(str(event.get("posts", "")), validate=True)
            posts = np.frombuffer(data, POST_DTYPE)
        except ValueError:
            posts = np.zeros(0, POST_DTYPE)
        if len(posts) != event.get("count") or not all(map(is_post, posts)):
            raise RecordingError(f"event '{SHOWN_EVENT}' at tick {event.get('tick')!r} is damaged")
        yield posts


def is_post(post: np.void) -> bool:
    """Returns True if the numbers of a post are finite and in range, as the loop needs them.

    Its quaternion and the normals of its surfaces have the length 1.
    """
    names = [name for name in POST_DTYPE.names or () if POST_DTYPE[name].base == np.float64]
    if not 0 <= post["planes"] <= PLANES:
        return False
    if not all(bool(np.all(np.abs(post[name]) < 1e9)) for name in names):
        return False
    normals = post["normals"].reshape(PLANES, 3)[: post["planes"]]
    norms = np.append(np.linalg.norm(normals, axis=1), np.linalg.norm(post["pose"][3:]))
    return bool(np.all(np.abs(norms - 1.0) < 1e-9))
