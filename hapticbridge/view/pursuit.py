"""A run that was lost from sight, led on along what is seen of it again.

Whoever misses records of a run cannot know its scene any more: a record has the poses of handle and
tool, and of no other body. So the scene goes on from where it was last known. Its handle is led to
where the records have it and along them, by the same kernel and coupling, and the tool follows; one
that is free is put where they say. What the tool moved meanwhile stands where it was left.
"""

from __future__ import annotations

import contextlib
import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit.rerun import Rerun
from hapticbridge.errors import HapticBridgeError
from hapticbridge.pose import IDENTITY_POSE, quaternion_exp, rotation_between, scaled
from hapticbridge.tick import TICK_DTYPE

LEAD_SPEED, LEAD_TURN_SPEED = 0.5, 5.0
"""In m/s and rad/s: how fast the handle is led to where it is seen again. Faster, the tool would
throw what it meets; slower, more ticks are simulated before anything is shown."""

LONGEST_LEAD = 1.0
"""In s: a handle that is farther than that is led faster."""

STRAY = 1e-3
"""In m: a free tool that is farther from where the record has it is put there. Less is not seen."""

Array = NDArray[np.float64]

_WITHOUT_END = (
    "most_speed",
    "most_turn_speed",
    "most_stretch",
    "most_angle",
    "most_energy",
    "reach",
    "longest_stall",
)
_OFF = (
    "reseats",
    "clutch",
    "dead_man",
    "stale_ticks",
    "commanded",
    "is_released",
    "silent_ticks",
    "is_seated_anew",
    "since_news",
)


class Pursuit:
    """Leads a scene along records that do not follow on what is known of it.

    Args:
        run: What was known of the run; not to be used for anything else from here on.
        period: T in s.

    Attributes:
        off: How far the tool is from where the last record has it, in m.
    """

    def __init__(self, run: Rerun, period: float) -> None:
        self._run, self._period = run, period
        self._slack = run.slack
        self._mark: float | None = None
        state = run.binding.state
        grip = int(state["grip_site_id"][0])
        self._grip, self._root = grip, _free_body(run.model, int(run.model.site_bodyid[grip]))
        self.off = 0.0

    @property
    def slack(self) -> float:
        """What the environment may have created at least by now, in J.

        It only grows; what it grew by while nobody saw the run is not in it.
        """
        return self._slack + (0.0 if self._mark is None else self._run.slack - self._mark)

    def add(self, rows: NDArray[np.void]) -> None:
        """Goes on along records.

        Args:
            rows: ``TICK_DTYPE``, without a gap, at least one.
        """
        run, first = self._run, rows[0]
        tick = int(first["tick"])
        has_gap = run.done != tick
        self._jump(tick)
        if has_gap:  # what changes slowly has changed meanwhile
            ticks = run.binding.state["tuning_ticks"]
            ticks[0] = min(ticks[0], 1)
        self._put_tool(first)
        self._free()
        lead = self._lead(first)
        if len(lead):
            self._jump(tick, len(lead))
            self._follow(lead)
        self._jump(tick)
        self._follow(rows)
        self._jump(tick + len(rows))
        state = run.binding.state[0]
        self.off = float(np.linalg.norm(state["tool_position"] - rows[-1]["tool_position"]))
        if self._mark is None or len(lead):
            self._slack, self._mark = self.slack, run.slack

    def _jump(self, tick: int, ahead: int = 0) -> None:
        # a change that cannot be made is left out: what is drawn is a guess by now
        with contextlib.suppress(HapticBridgeError):
            self._run.jump(tick, ahead)

    def _follow(self, rows: NDArray[np.void]) -> None:
        """Simulates along the handle's poses, which the kernel takes for a device's."""
        taken = np.zeros(len(rows), TICK_DTYPE)
        taken["tick"] = rows["tick"]
        taken["device_position"] = rows["handle_position"]
        taken["device_quaternion"] = rows["handle_quaternion"]
        step = round(self._period * 1e9)
        taken["read_ns"] = step * np.arange(1, len(rows) + 1)
        with contextlib.suppress(HapticBridgeError):
            self._run.add(taken)
        if self._run.is_over:  # no number is left of it
            self._run.restart()

    def _put_tool(self, row: np.void) -> None:
        """Puts a free tool where a record has it, if it is elsewhere."""
        run, state = self._run, self._run.binding.state[0]
        off = np.linalg.norm(state["tool_position"] - row["tool_position"])
        if self._root < 0 or off <= STRAY:
            return
        model, data = run.model, run.data
        mujoco.mj_kinematics(model, data)
        joint = int(model.body_jntadr[self._root])
        body, grip = data.xquat[self._root], np.zeros(4)
        mujoco.mju_mat2Quat(grip, data.site_xmat[self._grip])
        turn, back, wanted = np.zeros(4), np.zeros(4), np.zeros(4)
        mujoco.mju_negQuat(back, grip)
        mujoco.mju_mulQuat(turn, row["tool_quaternion"].copy(), back)  # from the grip now to then
        mujoco.mju_mulQuat(wanted, turn, body)
        arm = np.zeros(3)
        mujoco.mju_rotVecQuat(arm, data.xpos[self._root] - data.site_xpos[self._grip], turn)
        place, first = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
        data.qpos[place : place + 3] = row["tool_position"] + arm
        data.qpos[place + 3 : place + 7] = wanted
        data.qvel[first : first + 6] = 0.0
        run.binding.take_reset()

    def _free(self) -> None:
        """Lets the kernel take any motion, and a device's pose for the handle's."""
        state = self._run.binding.state
        for name in _WITHOUT_END:
            state[name] = math.inf
        for name in _OFF:
            state[name] = 0
        state["scale"] = state["force_scale"] = 1.0
        state["axes"], state["axes_quaternion"] = np.eye(3).ravel(), (1.0, 0.0, 0.0, 0.0)
        for name in ("device", "handle"):
            state[f"{name}_origin"] = IDENTITY_POSE
        state["device_position"] = state["handle_position"]
        state["device_quaternion"] = state["handle_quaternion"]

    def _lead(self, row: np.void) -> NDArray[np.void]:
        """Returns records that lead the handle from where it is to where one has it."""
        state = self._run.binding.state[0]
        way = row["handle_position"] - state["handle_position"]
        start = tuple(state["handle_quaternion"].tolist())
        turn = rotation_between(start, tuple(row["handle_quaternion"].tolist()))
        far, wide = float(np.linalg.norm(way)), float(np.linalg.norm(turn))
        time = max(far / LEAD_SPEED, wide / LEAD_TURN_SPEED)
        # one tick is what a hand does between two records, too
        count = math.ceil(min(time, LONGEST_LEAD) / self._period - 1.0)
        rows = np.zeros(max(count, 0), TICK_DTYPE)
        for index, share in enumerate(np.linspace(0.0, 1.0, len(rows) + 2)[1:-1].tolist()):
            rows[index]["handle_position"] = state["handle_position"] + share * way
            step = np.zeros(4)
            mujoco.mju_mulQuat(step, np.array(quaternion_exp(scaled(share, turn))), np.array(start))
            rows[index]["handle_quaternion"] = step
        rows["tick"] = int(row["tick"]) - np.arange(len(rows), 0, -1)
        return rows


def _free_body(model: mujoco.MjModel, body: int) -> int:
    """Returns the body with a free joint that a body is fixed to, or −1."""
    root = int(model.body_weldid[body])
    joint = int(model.body_jntadr[root])
    is_free = joint >= 0 and model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE
    return root if is_free else -1
