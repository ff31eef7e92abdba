"""The virtual coupling: its law, the energy of its springs, and changes of its gains.

With e = h − x and φ the rotation vector from tool to handle, the wrench on the tool is

    f = K e + (B'/T) (δh − δx),    τ = K_r φ + (B'_r/T) (δφ_h − δφ_x)

K in N/m, B' in N s/m, K_r in N m/rad, B'_r in N m s/rad; h and x are the positions of handle and
tool in m, δ their steps within the time T in s. The six actuators of the scene evaluate this law
inside MuJoCo's step; the functions here evaluate it afterwards, at the poses that resulted.

A change of the gains during a run does work. With gains that change from tick to tick, the identity
behind eq. (6) of Brown & Colgate (1997) becomes

    Σ f_k·d_{k+1} + Σ (b/T) ‖d_k‖² = Σ f_k·δx_k + Σ (terms >= 0) + ½ K_N ‖p_{N+1}‖²
                                     − ½ K_1 ‖p_1‖² − Σ W_k,
    W_k = ½ (K_k − K_{k−1}) ‖p_k‖²,    p_k = h_k − x_{k−1} = e_{k−1} + d_k

with d the steps of the handle. It holds if b >= K_k T/2 + B_k in every tick. W_k is the energy by
which the spring grows between the steps of handle and tool. The command gives it to the device;
softening the coupling takes it away. A change of B does no work, and the environment's balance (14)
does not contain the gains. W is booked as ``energy.tuning_work``.

Two facts bound W. The gains move in a straight line over ``tuning_ticks`` ticks, so W_k is at most
½ (K_goal − K)/n ‖p‖² per tick; the damping that a device needs is convex in K and B, so no coupling
on the line needs more than the larger end. The guard's energy limit counts W, because it counts all
energy that the device received beyond the hand's.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from hapticbridge.coupling import Coupling
from hapticbridge.jit import compiled
from hapticbridge.kernel.codes import Part, State
from hapticbridge.kernel.handle import handle_of_step, note_tool, tool_after_step
from hapticbridge.kernel.ledger import add_tuning_work
from hapticbridge.kernel.mujoco_c import floats
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.pose import (
    Quaternion,
    Vector,
    add,
    conjugate,
    dot,
    norm,
    product,
    quaternion_exp,
    quaternion_of,
    rotated,
    rotation_between,
    scaled,
    store_vector,
    subtract,
    vector_of,
)

Gains = tuple[float, float, float]
"""Gains of a coupling actuator: factor of its control, stiffness in N/m, damping in N s/m. For
rotation: factor, N m/rad, N m s/rad."""

GainRule: TypeAlias = Callable[[Coupling, float], tuple[Gains, Gains]]
"""Gains of the coupling's actuators, for forces and for torques, by the law's coupling and MuJoCo's
time step in s."""

SLACK_SHARE = 0.5
"""Share of ½ (K + nB/T) ‖δx_i‖² that counts as slack with n > 1 evaluations of the law per tick; no
unit. A larger share needs more device damping (infinite at 1 and B = 0); with a smaller share an
environment counts as active sooner."""

TUNED = (
    "stiffness",
    "damping",
    "rotational_stiffness",
    "rotational_damping",
    "slack_stiffness",
    "slack_rotational_stiffness",
)
"""Numbers of the state that depend on the coupling, besides the gains of its actuators."""

COUPLING_DTYPE = np.dtype(
    [
        *((name, "<f8") for name in TUNED),
        ("gains", "<f8", 6),  # of the actuators: three for forces, three for torques
        ("tuning_goal", "<f8", 12),  # TUNED, then gains
        ("tuning_ticks", "<i8"),  # ticks left until the goal is reached
    ]
)
"""Sub-record ``coupling``, written by this module alone."""

_GAINS = 10  # numbers per actuator in actuator_gainprm and actuator_biasprm (mjNGAIN, mjNBIAS)


def implicit_gains(coupling: Coupling, _timestep: float) -> tuple[Gains, Gains]:
    """Returns the gains of actuators that evaluate the whole law inside MuJoCo's step."""
    k, b = coupling.stiffness, coupling.damping
    kr, br = coupling.rotational_stiffness, coupling.rotational_damping
    return (b, k, b), (br, kr, br)


def no_gains(_coupling: Coupling, _timestep: float) -> tuple[Gains, Gains]:
    """Returns the gains of actuators without effect."""
    return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)


def slack_gains(parameters: RunParameters) -> tuple[float, float]:
    """Returns the gains g in N/m and g_r in N m/rad of slack = Σ ½ g ‖δx_k‖² + ½ g_r ‖δφ_k‖².

    δx_k and δφ_k are the tool's motion in tick k, in m and rad. Without a coupling law (a weld, a
    tool without mass) both gains are 0, because the proof of a slack needs a law. With one
    evaluation of the law per tick g = K + B/T.

    With n > 1 evaluations g = ½ (K/n + B/T). The whole slack ½ (K + nB/T) ‖δx_i‖² of each
    evaluation i would require infinite device damping at B = 0; half of it does not
    (``certificate.required_damping``). A record holds only δx_k, the sum of all δx_i. For a given
    sum the slack is least if all δx_i are equal, so that g bounds it from below.
    """
    if not parameters.has_law:
        return 0.0, 0.0
    coupling = parameters.coupling
    share = 1.0 if parameters.law_evaluations == 1 else SLACK_SHARE
    return (
        share
        * (coupling.stiffness / parameters.law_evaluations + coupling.damping / parameters.period),
        share
        * (
            coupling.rotational_stiffness / parameters.law_evaluations
            + coupling.rotational_damping / parameters.period
        ),
    )


def tuned_values(parameters: RunParameters) -> tuple[float, ...]:
    """Returns the numbers of ``TUNED`` for a coupling; all are linear in it."""
    coupling = parameters.coupling
    law = (getattr(coupling, name) for name in TUNED[:4])
    return (*law, *slack_gains(parameters))


def bind_coupling(coupling: Part, parameters: RunParameters, gains: tuple[float, ...]) -> None:
    """Fills in the coupling that a run starts with."""
    for name, value in zip(TUNED, tuned_values(parameters), strict=True):
        coupling[name] = value
    coupling["gains"] = gains


def set_tuning_goal(
    coupling: Part, parameters: RunParameters, gains: tuple[Gains, Gains], ticks: int
) -> None:
    """Sets the coupling of ``parameters`` as the goal of the next ``ticks`` ticks."""
    coupling["tuning_goal"] = (*tuned_values(parameters), *gains[0], *gains[1])
    coupling["tuning_ticks"] = ticks


@compiled
def law_wrench(
    s: State,
    handle: tuple[Vector, Quaternion],
    tool: tuple[Vector, Quaternion],
    moved: Vector,
    turned: Vector,
) -> tuple[Vector, Vector]:
    """Returns the coupling's force and torque on the tool, for one evaluation of the law.

    Args:
        s: The bound state.
        handle: Position in m and orientation at the end of the step.
        tool: Position in m and orientation at the end of the step.
        moved: Motion of the tool in m since the previous evaluation.
        turned: Its rotation vector in rad.
    """
    k, count = s.coupling, s.run.law_evaluations
    share, rate = 1.0 / count, count / s.run.period
    stretch = subtract(handle[0], tool[0])
    twist = rotation_between(tool[1], handle[1])
    handle_step = scaled(share, vector_of(s.pose.handle_step))
    handle_turn = scaled(share, vector_of(s.pose.handle_turn))
    force = add(
        scaled(k.stiffness, stretch), scaled(k.damping * rate, subtract(handle_step, moved))
    )
    torque = add(
        scaled(k.rotational_stiffness, twist),
        scaled(k.rotational_damping * rate, subtract(handle_turn, turned)),
    )
    return force, torque


@compiled
def wrench_after_step(s: State, is_last: bool) -> tuple[Vector, Vector, Vector, Vector]:
    """Evaluates the law after a step of MuJoCo, and notes the tool's new pose.

    Args:
        s: The bound state.
        is_last: True for the last substep of the tick.

    Returns:
        Force, torque, and the tool's motion and rotation vector since the previous evaluation.
    """
    position, orientation, moved, turned = tool_after_step(s)
    handle = handle_of_step(s, is_last)
    force, torque = law_wrench(s, handle, (position, orientation), moved, turned)
    note_tool(s.pose, position, orientation)
    return force, torque, moved, turned


@compiled
def command_handle_velocity(s: State, orientation: Quaternion) -> None:
    """Writes the handle's velocity in its own axes, R_hᵀ δh/T and R_hᵀ δφ_h/T, as control.

    The actuators need it because a mocap body has no velocity of its own.
    """
    to_handle = conjugate(orientation)
    ctrl = floats(s.mj.ctrl + 8 * s.mj.coupling_ctrl_adr, 6)
    rate = 1.0 / s.run.period
    store_vector(ctrl[0:3], scaled(rate, rotated(to_handle, vector_of(s.pose.handle_step))))
    store_vector(ctrl[3:6], scaled(rate, rotated(to_handle, vector_of(s.pose.handle_turn))))


@compiled
def _spring_energy(stiffness: float, length: float, limit: float) -> float:
    """Returns ∫ min(K e, F) de, the energy of a spring whose force is limited to F."""
    elastic = min(length, limit / stiffness) if stiffness > 0.0 else 0.0
    return 0.5 * stiffness * elastic * elastic + min(stiffness * length, limit) * (length - elastic)


@compiled
def releasable_energy(s: State) -> float:
    """Returns r V(e) + r V(φ) in J, the energy that the springs can release to the device.

    r = force_scale / scale; V is limited by the largest force and torque on the device.
    """
    pose, run = s.pose, s.run
    ratio = run.force_scale / run.scale
    stretch = norm(subtract(vector_of(pose.handle_position), vector_of(pose.tool_position)))
    tool, handle = quaternion_of(pose.tool_quaternion), quaternion_of(pose.handle_quaternion)
    twist = norm(rotation_between(tool, handle))
    linear = _spring_energy(s.coupling.stiffness, stretch, run.force_limit / run.force_scale)
    angular = _spring_energy(s.coupling.rotational_stiffness, twist, run.torque_limit / ratio)
    return float(ratio * (linear + angular))


@compiled
def set_gains(s: State, share: float) -> None:
    """Gives the coupling's actuators a share of their gains."""
    mj = s.mj
    for axis in range(6):
        first = 0 if axis < 3 else 3
        actuator = mj.coupling_actuator_id + axis
        floats(mj.gainprm + 8 * _GAINS * actuator, 1)[0] = share * s.coupling.gains[first]
        bias = floats(mj.biasprm + 8 * _GAINS * actuator, 3)
        bias[1] = -share * s.coupling.gains[first + 1]
        bias[2] = -share * s.coupling.gains[first + 2]


@compiled
def retune(s: State) -> None:
    """Moves the gains one tick nearer to their goal, and books the work on the spring.

    Needs the handle's new pose and the tool's old one. With n evaluations of the law per tick the
    handle has made the first of its n steps by then.
    """
    k, goal, left = s.coupling, s.coupling.tuning_goal, s.coupling.tuning_ticks
    stiffness, rotational = k.stiffness, k.rotational_stiffness
    share = 1.0 / left
    k.stiffness += share * (goal[0] - k.stiffness)
    k.damping += share * (goal[1] - k.damping)
    k.rotational_stiffness += share * (goal[2] - k.rotational_stiffness)
    k.rotational_damping += share * (goal[3] - k.rotational_damping)
    k.slack_stiffness += share * (goal[4] - k.slack_stiffness)
    k.slack_rotational_stiffness += share * (goal[5] - k.slack_rotational_stiffness)
    for i in range(6):
        k.gains[i] += share * (goal[6 + i] - k.gains[i])
    if left == 1:  # without the error of rounding
        k.stiffness, k.damping = goal[0], goal[1]
        k.rotational_stiffness, k.rotational_damping = goal[2], goal[3]
        k.slack_stiffness, k.slack_rotational_stiffness = goal[4], goal[5]
        for i in range(6):
            k.gains[i] = goal[6 + i]
    k.tuning_ticks = left - 1
    set_gains(s, 0.5 if s.lossless.is_midpoint else 1.0)

    pose = s.pose
    ahead = 1.0 - 1.0 / s.run.law_evaluations
    stretch = subtract(vector_of(pose.handle_position), scaled(ahead, vector_of(pose.handle_step)))
    stretch = subtract(stretch, vector_of(pose.tool_position))
    back = quaternion_exp(scaled(-ahead, vector_of(pose.handle_turn)))
    orientation = product(back, quaternion_of(pose.handle_quaternion))
    twist = rotation_between(quaternion_of(pose.tool_quaternion), orientation)
    add_tuning_work(s.energy, 0.5 * (k.stiffness - stiffness) * dot(stretch, stretch))
    add_tuning_work(s.energy, 0.5 * (k.rotational_stiffness - rotational) * dot(twist, twist))
