"""Coupling law at recorded poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit.events import RunEvents
from hapticbridge.record import TickFlag

# Steps, turns and sums over whole arrays.


def quaternion_product(a: Array, b: Array) -> Array:
    """Returns a ⊗ b over arrays (…, 4), scalar first."""
    scalar = a[..., :1] * b[..., :1] - np.sum(a[..., 1:] * b[..., 1:], axis=-1, keepdims=True)
    vector = a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:] + np.cross(a[..., 1:], b[..., 1:])
    return np.concatenate([scalar, vector], axis=-1)


def conjugate(q: Array) -> Array:
    """Returns the inverse of unit quaternions (…, 4)."""
    return np.asarray(q * np.array([1.0, -1.0, -1.0, -1.0]))


def turn_between(a: Array, b: Array) -> Array:
    """Returns the rotation vectors (…, 3) in the world frame from a to b, in rad."""
    q = quaternion_product(b, conjugate(a))
    q = np.where(q[..., :1] < 0, -q, q)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, q[..., :1])
    with np.errstate(invalid="ignore", divide="ignore"):
        factor = np.where(sine > 0, angle / sine, 2.0)
    return np.asarray(factor * q[..., 1:])


def steps(values: Array, before: Array) -> Array:
    """Returns v_k − v_{k−1} over rows, with v_{−1} = before."""
    return np.diff(values, axis=0, prepend=before[None])


def turns(values: Array, before: Array) -> Array:
    """Returns the rotation vector from each orientation's predecessor to it."""
    return turn_between(np.concatenate([before[None], values[:-1]]), values)


def summed(values: Array, before: float) -> Array:
    """Returns cumulative sums that start from an earlier sum.

    Values are added one by one, so that sums over blocks equal those over the whole to the bit.
    """
    return np.cumsum(np.concatenate([[before], values]))[1:]


def rotate(q: Array, v: Array) -> Array:
    """Returns R(q) v over rows, q (n, 4) and v (n, 3)."""
    pure = np.concatenate([np.zeros((len(v), 1)), v], axis=1)
    return quaternion_product(quaternion_product(q, pure), conjugate(q))[:, 1:]


Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Motion:
    """Motion of handle and tool, (n, 3) each, in m and as rotation vectors in rad.

    Attributes:
        handle_step: h_k − h_{k−1}.
        tool_step: x_k − x_{k−1}.
        handle_turn: Rotation of the handle in each tick.
        tool_turn: Rotation of the tool in each tick.
        stretch: h − x.
        twist: Rotation from the tool to the handle.
        twist_before: Rotation from the tool to the handle in the previous tick.
        pulled: h_k − x_{k−1}, the stretch after the handle's step and before the tool's.
        turned: Rotation from the previous tick's tool to the handle.
        carried: Rotation of the tool in each tick as quaternions, (n, 4).
    """

    handle_step: Array
    tool_step: Array
    handle_turn: Array
    tool_turn: Array
    stretch: Array
    twist: Array
    twist_before: Array
    pulled: Array
    turned: Array
    carried: Array

    @classmethod
    def of(cls, ticks: NDArray[np.void], handle: Array, tool: Array, outside: RunEvents) -> Motion:
        """Computes the motion of consecutive records.

        ``handle`` and ``tool`` are the poses (7,) before the first record. The jump of a reset is
        no motion.
        """
        handle_before = poses_before(ticks, "handle", handle, outside)
        tool_before = poses_before(ticks, "tool", tool, outside)
        handles, tools = ticks["handle_quaternion"], ticks["tool_quaternion"]
        return cls(
            handle_step=ticks["handle_position"] - handle_before[:, :3],
            tool_step=ticks["tool_position"] - tool_before[:, :3],
            handle_turn=turn_between(handle_before[:, 3:], handles),
            tool_turn=turn_between(tool_before[:, 3:], tools),
            stretch=ticks["handle_position"] - ticks["tool_position"],
            twist=turn_between(tools, handles),
            twist_before=turn_between(tool_before[:, 3:], handle_before[:, 3:]),
            pulled=ticks["handle_position"] - tool_before[:, :3],
            turned=turn_between(tool_before[:, 3:], handles),
            carried=quaternion_product(tools, conjugate(tool_before[:, 3:])),
        )

    @property
    def stretched(self) -> tuple[Array, Array]:
        """Change of stretch and twist in each tick."""
        return self.handle_step - self.tool_step, self.handle_turn - self.tool_turn


def wrench_by_law(ticks: NDArray[np.void], gains: Array, period: float, motion: Motion) -> Array:
    """Returns the coupling's wrench on the tool, (n, 6) in N and N m.

    Each record has one law; its flags select the rule of the torque. ``gains`` holds K, B', K_r and
    B'_r, (n, 4).
    """
    step, turn = motion.stretched
    k, b, k_r, b_r = (gains[:, column, None] for column in range(4))
    force = k * motion.stretch + b / period * step
    torque = k_r * motion.twist + b_r / period * turn
    is_midpoint = (ticks["flags"] & int(TickFlag.MIDPOINT)) != 0
    if np.any(is_midpoint):
        # quantities of the previous tick are rotated with the tool's turn
        carried = motion.carried
        spring = 0.5 * (motion.twist + rotate(carried, motion.twist_before))
        midway = 0.5 * (motion.handle_turn + rotate(carried, motion.handle_turn)) - motion.tool_turn
        midpoint = k_r * spring + (b_r / period + 0.5 * k_r) * midway
        torque = np.where(is_midpoint[:, None], midpoint, torque)
    return np.concatenate([force, torque], axis=1)


def poses_before(ticks: NDArray[np.void], body: str, before: Array, outside: RunEvents) -> Array:
    """Returns the pose before each tick, (n, 7).

    ``before`` is the pose (7,) of the body (``handle`` or ``tool``) before the first record.
    """
    poses = np.concatenate([ticks[f"{body}_position"], ticks[f"{body}_quaternion"]], axis=1)
    poses = np.concatenate([before[None], poses[:-1]])
    return np.where(outside.is_reset(ticks["tick"])[:, None], outside.home, poses)
