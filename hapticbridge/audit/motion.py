"""Motion and coupling wrench, from recorded poses alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit.events import AuditState, RunEvents
from hapticbridge.kernel.parameters import LARGEST_TWIST, RunParameters
from hapticbridge.kernel.record import TickFlag, has_flag

Array = NDArray[np.float64]


# Steps and rotations over rows


def quaternion_product(a: Array, b: Array) -> Array:
    """Returns a ⊗ b over arrays (…, 4), scalar first."""
    scalar = a[..., :1] * b[..., :1] - np.sum(a[..., 1:] * b[..., 1:], axis=-1, keepdims=True)
    vector = a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:] + np.cross(a[..., 1:], b[..., 1:])
    return np.concatenate([scalar, vector], axis=-1)


def quaternion_of(turn: Array) -> Array:
    """Returns the quaternions (n, 4) of rotation vectors (n, 3)."""
    half = 0.5 * np.linalg.norm(turn, axis=1, keepdims=True)
    return np.concatenate([np.cos(half), 0.5 * np.sinc(half / np.pi) * turn], axis=1)


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


def rotate(q: Array, v: Array) -> Array:
    """Returns R(q) v over rows, q (n, 4) and v (n, 3)."""
    pure = np.concatenate([np.zeros((len(v), 1)), v], axis=1)
    return quaternion_product(quaternion_product(q, pure), conjugate(q))[:, 1:]


def pose_of(ticks: NDArray[np.void], body: str) -> Array:
    """Returns the poses of ``device``, ``handle`` or ``tool``, (n, 7)."""
    return np.concatenate([ticks[f"{body}_position"], ticks[f"{body}_quaternion"]], axis=1)


@dataclass(frozen=True, slots=True)
class Motion:
    """Motion of handle and tool in each tick, in m and as rotation vectors in rad.

    Arrays are (n, 3) unless stated. The jump of a reset is no motion.

    Attributes:
        handle_step: d, the handle's motion with the device: r_{k−1} scale A δp; without slip.
        handle_turn: Its rotation with the device, r_{k−1} A δφ.
        tool_step: x_k − x_{k−1}.
        tool_turn: Rotation of the tool.
        stretch: e = h − x.
        twist: Rotation from the tool to the handle.
        twist_before: Rotation from the tool to the handle in the previous tick; a slip is in it.
        carried: Rotation of the tool in each tick as quaternions, (n, 4).
        handle_before: Handle pose in the previous tick, (n, 7).
        tool_before: Tool pose in the previous tick, (n, 7).
    """

    handle_step: Array
    handle_turn: Array
    tool_step: Array
    tool_turn: Array
    stretch: Array
    twist: Array
    twist_before: Array
    carried: Array
    handle_before: Array
    tool_before: Array

    @classmethod
    def from_records(
        cls, ticks: NDArray[np.void], state: AuditState, events: RunEvents, lever: Array
    ) -> Motion:
        """Computes the motion of consecutive records; ``lever`` is r_{k−1}, (n,)."""
        rows = np.concatenate([state.row, ticks])
        is_reset = events.is_reset(ticks["tick"])[:, None]
        handle, tool = pose_of(rows, "handle"), pose_of(rows, "tool")
        handle_home, tool_home = events.homes(ticks["tick"])
        handle_before = np.where(is_reset, handle_home, handle[:-1])
        tool_before = np.where(is_reset, tool_home, tool[:-1])
        handle, tool = handle[1:], tool[1:]
        parameters, device = events.parameters, pose_of(rows, "device")
        axes = np.array(parameters.axes).reshape(3, 3)
        moved = parameters.scale * np.diff(device[:, :3], axis=0) @ axes.T
        # a rotation vector turns with the axes: log(A R Aᵀ) = A log(R)
        turned = turn_between(device[:-1, 3:], device[1:, 3:]) @ axes.T
        handle_turn = lever[:, None] * turned
        turned_back = quaternion_product(quaternion_of(-handle_turn), handle[:, 3:])
        return cls(
            handle_step=lever[:, None] * moved,
            handle_turn=handle_turn,
            tool_step=tool[:, :3] - tool_before[:, :3],
            tool_turn=turn_between(tool_before[:, 3:], tool[:, 3:]),
            stretch=handle[:, :3] - tool[:, :3],
            twist=turn_between(tool[:, 3:], handle[:, 3:]),
            twist_before=turn_between(tool_before[:, 3:], turned_back),
            carried=quaternion_product(tool[:, 3:], conjugate(tool_before[:, 3:])),
            handle_before=handle_before,
            tool_before=tool_before,
        )

    @property
    def stretched(self) -> tuple[Array, Array]:
        """Change of stretch and twist in each tick."""
        return self.handle_step - self.tool_step, self.handle_turn - self.tool_turn

    def pulled(self, evaluations: int) -> tuple[Array, Array]:
        """Returns stretch and twist between the handle before a slip and the tool before its step.

        With several evaluations of the law per tick, after the first of the handle's steps.
        """
        share = 1.0 / evaluations
        position = self.handle_before[:, :3] + share * self.handle_step
        turn = quaternion_of(share * self.handle_turn)
        orientation = quaternion_product(turn, self.handle_before[:, 3:])
        tool = self.tool_before
        return position - tool[:, :3], turn_between(tool[:, 3:], orientation)


def torque_across(gains: Array, parameters: RunParameters) -> Array:
    """Returns the largest torque across the motion that b_r pays for, (n,) in N m/rad.

    With w = K_r + 2 B'_r/T, the a of which |K_r + B'_r/T + ja| + |B'_r/T + ja| = √(2 w b_r/T).
    ``gains`` holds K, B', K_r and B'_r, (n, 4).
    """
    k_r, rate = gains[:, 2], gains[:, 3] / parameters.period
    b = parameters.guarding.twist_damping * parameters.scale / parameters.force_scale
    if b == np.inf:
        return np.full(len(gains), np.inf)
    whole = k_r + 2 * rate
    square = np.maximum(2 * whole * b / parameters.period, whole**2)
    near = (square - k_r * whole) / (2 * np.sqrt(np.maximum(square, 1e-300)))
    return np.where(k_r > 0, np.sqrt(np.maximum(near**2 - rate**2, 0.0)), np.inf)


def _turned_on(before: Array, twist: Array) -> Array:
    """Returns twists that go on beyond half a turn where they came from the other side, (n, 3)."""
    size = np.linalg.norm(twist, axis=1)
    is_across = (size > LARGEST_TWIST) & (np.sum(before * twist, axis=1) < 0)
    return np.where(is_across[:, None], twist * (1 - 2 * np.pi / np.fmax(size, 1))[:, None], twist)


def wrench_by_law(
    ticks: NDArray[np.void], gains: Array, parameters: RunParameters, motion: Motion
) -> Array:
    """Returns the coupling's wrench on the tool, (n, 6) in N and N m.

    Each record has one law; its flags select the rule of the torque. ``gains`` holds K, B', K_r and
    B'_r, (n, 4).
    """
    (step, turn), period = motion.stretched, parameters.period
    k, b, k_r, b_r = (gains[:, column, None] for column in range(4))
    force = k * motion.stretch + b / period * step
    twist = motion.twist
    if not parameters.scene_ticks:  # a tool that is only shown takes no step across half a turn
        handle = ticks["handle_quaternion"]
        twist = _turned_on(turn_between(motion.tool_before[:, 3:], handle), twist)
    torque = k_r * twist + b_r / period * turn
    is_midpoint = has_flag(ticks, TickFlag.MIDPOINT)
    if np.any(is_midpoint):
        # quantities of the previous tick are rotated with the tool's turn
        carried = motion.carried
        spring = 0.5 * (twist + rotate(carried, motion.twist_before))
        midway = 0.5 * (motion.handle_turn + rotate(carried, motion.handle_turn)) - motion.tool_turn
        midpoint = k_r * spring + (b_r / period + 0.5 * k_r) * midway
        twists = np.stack([twist, motion.twist_before])
        across = 0.25 * gains[:, 2] * np.linalg.norm(twists, axis=2).max(axis=0)
        most = torque_across(gains, parameters)
        share = np.divide(most, across, out=np.ones_like(across), where=across > most)
        torque = np.where(
            is_midpoint[:, None], torque + share[:, None] * (midpoint - torque), torque
        )
    return np.concatenate([force, torque], axis=1)
