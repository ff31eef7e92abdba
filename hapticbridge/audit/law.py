"""The coupling law at recorded poses, and the motion that it speaks of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit.differences import (
    product_conjugate,
    rotate,
    steps,
    turn_between,
    turns,
)
from hapticbridge.coupling import Coupling
from hapticbridge.tick import TickFlag

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Motion:
    """How handle and tool moved, (n, 3) each in m and as rotation vectors in rad.

    Attributes:
        handle_step: h_k − h_{k−1}.
        tool_step: x_k − x_{k−1}.
        handle_turn: The handle's turn in each tick.
        tool_turn: The tool's.
        stretch: h − x.
        twist: The turn that takes the tool to the handle.
        twist_before: The same before the first of these ticks, (3,).
        carried: The tool's turn in each tick as quaternions, (n, 4).
    """

    handle_step: Array
    tool_step: Array
    handle_turn: Array
    tool_turn: Array
    stretch: Array
    twist: Array
    twist_before: Array
    carried: Array

    @classmethod
    def of(cls, ticks: NDArray[np.void], handle: Array, tool: Array) -> Motion:
        """Returns the motion of records.

        Args:
            ticks: ``TICK_DTYPE``.
            handle: Handle pose (7,) before the first of them.
            tool: Tool pose (7,), likewise.
        """
        return cls(
            handle_step=steps(ticks["handle_position"], handle[:3]),
            tool_step=steps(ticks["tool_position"], tool[:3]),
            handle_turn=turns(ticks["handle_quaternion"], handle[3:]),
            tool_turn=turns(ticks["tool_quaternion"], tool[3:]),
            stretch=ticks["handle_position"] - ticks["tool_position"],
            twist=turn_between(ticks["tool_quaternion"], ticks["handle_quaternion"]),
            twist_before=turn_between(tool[3:], handle[3:]),
            carried=product_conjugate(ticks["tool_quaternion"], tool[3:]),
        )

    @property
    def stretched(self) -> tuple[Array, Array]:
        """How the coupling was stretched and twisted in each tick."""
        return self.handle_step - self.tool_step, self.handle_turn - self.tool_turn


def wrench_by_law(
    ticks: NDArray[np.void], coupling: Coupling, period: float, motion: Motion
) -> Array:
    """Returns the wrench on the tool that the coupling gives, (n, 6) in N and N m.

    Args:
        ticks: Records with one law each; their flags say which rule the torque follows.
        coupling: K and B.
        period: T in s.
        motion: Of the records.
    """
    step, turn = motion.stretched
    force = coupling.stiffness * motion.stretch + coupling.damping / period * step
    torque = coupling.rotational_stiffness * motion.twist
    torque = torque + coupling.rotational_damping / period * turn
    is_midpoint = (ticks["flags"] & int(TickFlag.MIDPOINT)) != 0
    if np.any(is_midpoint):
        # the turn that takes the tool from the tick before to this one carries what was then
        carried = motion.carried
        before = np.vstack([motion.twist_before[None], motion.twist[:-1]])
        spring = 0.5 * (motion.twist + rotate(carried, before))
        midway = 0.5 * (motion.handle_turn + rotate(carried, motion.handle_turn)) - motion.tool_turn
        rate = coupling.rotational_damping / period + 0.5 * coupling.rotational_stiffness
        midpoint = coupling.rotational_stiffness * spring + rate * midway
        torque = np.where(is_midpoint[:, None], midpoint, torque)
    return np.concatenate([force, torque], axis=1)
