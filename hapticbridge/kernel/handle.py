"""Where a device's pose puts the handle, and vectors between the axes of device and scene."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hapticbridge.jit import compiled
from hapticbridge.kernel.codes import FORCE_OFF, LOSSLESS
from hapticbridge.kernel.guard import held_energy
from hapticbridge.kernel.mujoco_c import floats
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.pose import (
    Quaternion,
    Vector,
    add,
    canonical,
    conjugate,
    dot,
    product,
    quaternion_exp,
    quaternion_of,
    rotation_between,
    scaled,
    subtract,
    vector_of,
)

# A coupling that is changed while the run goes on, and the work that the change does.
#
# The spring K e belongs to nobody's storage but the coupling's own. With gains that change from
# tick to tick, f_k = K_k e_k + (B_k/T) (d_k − δx_k), the identity behind BC97 (6) becomes
#
# Σ f_k·d_{k+1} + Σ ‖d_k‖²_{b/T} = Σ f_k·δx_k + Σ (what was >= 0 before) + ½‖p_{N+1}‖²_{K_N} −
# ½‖p_1‖²_{K_1} − Σ W_k, W_k = ½‖p_k‖²_{K_k − K_{k−1}}, p_k = h_k − x_{k−1} = e_{k−1} + d_k
#
# (d handle steps, δx tool steps, e = h − x), provided that b ⪰ K_k T/2 + B_k holds in every
# tick. So W_k, the energy by which the spring grows between the handle's step and the tool's, is
# what whoever turns the gains gives to the device (softening takes it away), and it is all: a
# change of B does no work, and the environment's own balance (14) does not see the gains. W is
# booked as the command's, ``tuning_work``, and neither as the environment's nor as the device's.
#
# Two things bound it. Gains move in a straight line over ``tuning_ticks`` ticks, so W_k per tick
# is at most ½ (K_goal − K)/n ‖p‖²; and every coupling in between needs no more damping than one
# of the ends, because the need is convex in K and B. And the guard's energy limit counts all
# that the device was given beyond what the hand put in: W is in it. So that an hour of
# dissipation does not pay for what a command does, each command caps what the hand has saved up
# by then (``forget_dissipation``).

Gains = tuple[float, float, float]
"""Of a coupling actuator: factor of its control, stiffness in N/m, damping in N s/m (rotation: N m,
N m/rad and N m s/rad per unit of control)."""

TUNED = (
    "stiffness",
    "damping",
    "rotational_stiffness",
    "rotational_damping",
    "slack_stiffness",
    "slack_rotational_stiffness",
)
"""What of the state a change of the coupling changes, beside the gains of its actuators."""

_GAINS = 10  # doubles that an actuator has for its gain, and for its bias (mjNGAIN, mjNBIAS)


def tuned_values(parameters: RunParameters) -> tuple[float, ...]:
    """Returns the numbers of ``TUNED`` for a coupling; all are linear in it."""
    coupling = parameters.coupling
    law = (getattr(coupling, name) for name in TUNED[:4])
    return (*law, *parameters.slack_gains())


def forget_dissipation(state: NDArray[np.void]) -> None:
    """Caps what the hand may have put in before a command, for the guard's energy limit.

        given ← max(given, −(surplus + r V + r max(S − S_0 − U, 0))),   r = force_scale/scale

    V is the energy of coupling springs whose wrench stops growing at the limits, S − S_0 what the
    scene has taken up: both may come back to the hand. Not so U, what the scene took up while the
    force was off by command, nor V then, for the coupling is re-seated before it is felt again.
    What is gone for good may not either: else a hand that has rubbed away 1 J could be given as
    much by a slider that is moved, or a force that is turned off and on, at the right moments.

    Args:
        state: The bound state, between two ticks.
    """
    s = state[0]
    ratio = float(s["force_scale"] / s["scale"])
    kept = max(float(s["kinetic"] + s["potential"] - s["start_energy"] - s["unfelt"]), 0.0)
    held = 0.0 if s["commanded"] & FORCE_OFF else held_energy(state)
    s["given"] = max(float(s["given"]), -(float(s["surplus"]) + held + ratio * kept))


@compiled
def set_gains(state: NDArray[np.void], share: float) -> None:
    """Gives the coupling's actuators a share of their gains."""
    s = state[0]
    for axis in range(6):
        first = 0 if axis < 3 else 3
        actuator = s.coupling_actuator_id + axis
        floats(s.gainprm + 8 * _GAINS * actuator, 1)[0] = share * s.gains[first]
        bias = floats(s.biasprm + 8 * _GAINS * actuator, 3)
        bias[1], bias[2] = -share * s.gains[first + 1], -share * s.gains[first + 2]


@compiled
def retune(state: NDArray[np.void]) -> None:
    """Takes the gains one tick nearer to their goal, and books what that does to the spring.

    Needs the handle's new pose and the tool's old one. Over several laws a tick the handle has made
    the first of its steps by then.
    """
    s = state[0]
    left = s.tuning_ticks
    goal = s.tuning_goal
    stiffness, rotational = s.stiffness, s.rotational_stiffness
    share = 1.0 / left
    s.stiffness += share * (goal[0] - s.stiffness)
    s.damping += share * (goal[1] - s.damping)
    s.rotational_stiffness += share * (goal[2] - s.rotational_stiffness)
    s.rotational_damping += share * (goal[3] - s.rotational_damping)
    s.slack_stiffness += share * (goal[4] - s.slack_stiffness)
    s.slack_rotational_stiffness += share * (goal[5] - s.slack_rotational_stiffness)
    for i in range(6):
        s.gains[i] += share * (goal[6 + i] - s.gains[i])
    if left == 1:  # rounding must not keep it off its goal
        s.stiffness, s.damping = goal[0], goal[1]
        s.rotational_stiffness, s.rotational_damping = goal[2], goal[3]
        s.slack_stiffness, s.slack_rotational_stiffness = goal[4], goal[5]
        for i in range(6):
            s.gains[i] = goal[6 + i]
    s.tuning_ticks = left - 1
    set_gains(state, 0.5 if s.scheme == LOSSLESS and s.is_midpoint else 1.0)
    s.has_positions = 0  # what was computed ahead knew the old gains

    ahead = 1.0 - 1.0 / s.laws
    stretch = subtract(vector_of(s.handle_position), scaled(ahead, vector_of(s.handle_step)))
    stretch = subtract(stretch, vector_of(s.tool_position))
    back = quaternion_exp(scaled(-ahead, vector_of(s.handle_turn)))
    orientation = product(back, quaternion_of(s.handle_quaternion))
    twist = rotation_between(quaternion_of(s.tool_quaternion), orientation)
    s.tuning_work += 0.5 * (s.stiffness - stiffness) * dot(stretch, stretch)
    s.tuning_work += 0.5 * (s.rotational_stiffness - rotational) * dot(twist, twist)


@compiled
def scene_from_device(axes: NDArray[np.float64], v: Vector) -> Vector:
    """Returns A v, A row by row."""
    return (
        axes[0] * v[0] + axes[1] * v[1] + axes[2] * v[2],
        axes[3] * v[0] + axes[4] * v[1] + axes[5] * v[2],
        axes[6] * v[0] + axes[7] * v[1] + axes[8] * v[2],
    )


@compiled
def device_from_scene(axes: NDArray[np.float64], v: Vector) -> Vector:
    """Returns Aᵀ v, A row by row."""
    return (
        axes[0] * v[0] + axes[3] * v[1] + axes[6] * v[2],
        axes[1] * v[0] + axes[4] * v[1] + axes[7] * v[2],
        axes[2] * v[0] + axes[5] * v[1] + axes[8] * v[2],
    )


@compiled
def handle_pose(
    state: NDArray[np.void], position: Vector, quaternion: Quaternion
) -> tuple[Vector, Quaternion]:
    """Maps a device pose into the scene.

        h = h_0 + scale · A (p − p_0),    R_h = A (R R_0ᵀ) Aᵀ R_h0

    A is the rotation from the device's axes to the scene's, subscript 0 the pose at the start.
    """
    s = state[0]
    offset = subtract(position, vector_of(s.device_origin))
    moved = scaled(s.scale, scene_from_device(s.axes, offset))
    origin = s.handle_origin
    start = quaternion_of(s.device_origin[3:7])
    axes = quaternion_of(s.axes_quaternion)
    turn = product(product(axes, product(quaternion, conjugate(start))), conjugate(axes))
    return add(vector_of(origin), moved), canonical(product(turn, quaternion_of(origin[3:7])))
