"""The virtual coupling: its law, the energy of its springs, and changes of its gains.

With e = h − x and φ the rotation vector from tool to handle, the wrench on the tool is

    f = g(‖u‖) u/‖u‖,    u = K e + (B'/T) (δh − δx),    g(‖u‖) = min(‖u‖, F)
    τ alike,             u = K_r φ + (B'_r/T) (δφ_h − δφ_x)

K in N/m, B' in N s/m, K_r in N m/rad, B'_r in N m s/rad; F is the force level in N, or N m; h and
x are the positions of handle and tool in m, δ their steps within the time T in s. The six actuators
of the scene evaluate this law inside MuJoCo's step; ``law_wrench`` evaluates it afterwards, at the
poses that resulted. The two agree because the actuators are implicit: MuJoCo solves them at the end
of the step.

In five cases the handle's end of the spring moves without the device: it slips. These are changed
gains, a late sample or wrench, an axis without motor, a hand that is let go, and a large twist
(``slip``). With
gains that change from tick to tick, the identity behind Brown & Colgate's (6) has the term −Σ W_k
with W_k = V_k(p_k) − V_{k−1}(p_k), p_k = h_k − x_{k−1} and V the energy of the spring. A raised
gain would hand W_k to the device, so the handle slips toward the tool until V_k(p'_k) =
V_{k−1}(p_k); a lowered gain loses energy. The gains move in a straight line over ``tuning_ticks``
ticks; the damping that a device needs is convex in K and B, so no coupling on the line needs more
than the larger end.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.kernel.codes import Part, Scheme, State
from hapticbridge.kernel.handle import (
    UPRIGHT,
    device_from_scene,
    scene_from_device,
    slip_handle,
)
from hapticbridge.kernel.jit import compiled
from hapticbridge.kernel.ledger import SLACK_SHARE, moment_dot
from hapticbridge.kernel.mujoco_c import floats
from hapticbridge.kernel.parameters import (
    ALL_MOTORS,
    LARGEST_TWIST,
    SENT,
    STOPPED_TWIST,
    RunParameters,
    whole_ticks,
)
from hapticbridge.kernel.pose import (
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

_LAW = ("stiffness", "damping", "rotational_stiffness", "rotational_damping")
_SLACK = ("slack_stiffness", "slack_rotational_stiffness")
TUNED = (*_LAW, *_SLACK)
"""Numbers of the state that depend on the coupling, besides the gains of its actuators."""

_TUNED_DTYPE = np.dtype([*((name, "<f8") for name in TUNED), ("gains", "<f8", 6)])

COUPLING_DTYPE = np.dtype(
    [
        *((name, "<f8") for name in TUNED),
        ("gains", "<f8", 6),  # of the actuators: three for forces, three for torques
        ("tuning_goal", _TUNED_DTYPE),
        ("tuning_ticks", "<i8"),  # ticks left until the goal is reached
        ("lacks_motors", "<i8"),
        ("lacks_motor", "<f8", 6),  # 1 for an axis of the device without motor
        ("owed", "<f8", 2),  # energy in J that late samples and wrenches gave to the springs
        ("tool_then", "<f8", 7),  # tool's pose after the tick of the device's last new sample
        ("late_ticks", "<i8"),  # d, ticks from a sample to its force, within which it acts
        ("sent", "<f8", (SENT, 10)),  # lever, wrench on the tool and turn of the last ticks
        ("hold", "<f8", 2),
        ("idle", "<f8", 2),
        ("twist_damping", "<f8"),
    ]
)
"""Sub-record ``coupling``, written by this module alone. ``hold`` is the most force in N and torque
in N m along axes without motor, ``idle`` those while the hand is let go. ``twist_damping`` in
N m s/rad, seen at the tool, is the damping that pays for a torque across the motion."""

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
    tool without mass) both gains are 0, because the proof of a slack needs a law; also for a tool
    that is shown between the steps of a slower scene, whose account is exact. With one
    evaluation of the law per tick g = K + B'/T.

    With n > 1 evaluations g = ½ (K/n + B'/T), which is the ``SLACK_SHARE`` of each evaluation's
    slack ½ (K + nB'/T) ‖δx_i‖² (``loop_setting.required_damping``). A record holds only δx_k, the
    sum of all δx_i. For a given sum the slack is least if all δx_i are equal, so that g bounds it
    from below.
    """
    if not parameters.has_law or parameters.scene_ticks:
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
    law = (getattr(coupling, name) for name in _LAW)
    return (*law, *slack_gains(parameters))


def bind_coupling(coupling: Part, parameters: RunParameters, gains: tuple[float, ...]) -> None:
    """Fills in the coupling that a run starts with."""
    for name, value in zip(TUNED, tuned_values(parameters), strict=True):
        coupling[name] = value
    coupling["gains"] = gains
    guarding = parameters.guarding
    coupling["lacks_motor"] = [1.0 - (guarding.motors >> i & 1) for i in range(6)]
    coupling["lacks_motors"] = guarding.motors != ALL_MOTORS
    coupling["hold"] = guarding.hold_force, guarding.hold_torque
    coupling["idle"] = guarding.idle_force, guarding.idle_torque
    coupling["twist_damping"] = guarding.twist_damping * parameters.scale / parameters.force_scale
    late = whole_ticks(guarding.stated_delay, parameters.period)
    # another program's tool may jump before a wrench acts that is sent in time
    late = max(late, int(parameters.credit > 0.0))
    coupling["late_ticks"] = min(late, SENT - 1)


def set_tuning_goal(
    coupling: Part, parameters: RunParameters, gains: tuple[Gains, Gains], ticks: int
) -> None:
    """Sets the coupling of ``parameters`` as the goal of the next ``ticks`` ticks."""
    coupling["tuning_goal"] = (*tuned_values(parameters), (*gains[0], *gains[1]))
    coupling["tuning_ticks"] = ticks


# One spring of the coupling, of its forces or of its torques
#
# The wrench on the tool is g(‖u‖) u/‖u‖ with u = K e + (B'/T) δe, on the tool and on the device
# alike. g is the curve of the spring, here min(‖u‖, F). Any curve whose slope is from 0 to 1 keeps
# the device condition (``force_level``), and c = g(‖u‖)/‖u‖ must stay above 0, because the step's
# solution is divided by it. Another law changes the functions of this section, and their twin in
# ``audit.spring``.


class Spring(NamedTuple):
    """Spring of the coupling with a limited force, g(K e) = min(K e, F).

    Attributes:
        stiffness: K, its largest slope in N/m or N m/rad, at least 0.
        level: F in N or N m.
    """

    stiffness: float
    level: float


@compiled
def springs(s: State) -> tuple[Spring, Spring]:
    """Returns the coupling's springs for translation and for rotation, with the present gains."""
    k, level = s.coupling, s.level.level
    return Spring(k.stiffness, level[0]), Spring(k.rotational_stiffness, level[1])


@compiled
def is_beyond_level(spring: Spring, size: float) -> bool:
    """Returns True if the linear law asks for more than the level, so that the record tells it."""
    return size > spring.level


@compiled
def is_bent(spring: Spring, size: float) -> bool:
    """Returns True if the curve changes a force of the linear law, g(‖u‖) < ‖u‖."""
    return is_beyond_level(spring, size)


@compiled
def is_straight(spring: Spring, size: float, change: float) -> bool:
    """Returns True if the curve has its largest slope wherever the force changes by less."""
    return size + change <= spring.level


@compiled
def limited(spring: Spring, u: Vector) -> Vector:
    """Returns the force g(‖u‖) u/‖u‖ of the linear law's u; one that is not finite stays."""
    size = norm(u)
    return scaled(spring.level / size, u) if spring.level < size < np.inf else u


@compiled
def next_gain_ratio(spring: Spring, size: float, ratio: float, compliance: float) -> float:
    """Returns c with c ‖u‖ = g(‖u‖) for ‖u‖ = A/(1 + c σ), at most 1.

    Args:
        spring: The spring.
        size: Force c ‖u‖ of the last solution.
        ratio: Its c, above 0.
        compliance: σ, without unit.
    """
    a = size / ratio * (1.0 + ratio * compliance)
    if a <= spring.level * (1.0 + compliance):
        return 1.0
    return spring.level / (a - spring.level * compliance)


@compiled
def secant_stiffness(spring: Spring, _force: float) -> float:
    """Returns force over length in N/m or N m/rad at a force up to the level; K without a force."""
    return spring.stiffness


@compiled
def length_at(spring: Spring, force: float) -> float:
    """Returns the length at which a spring of a stiffness above 0 has a force up to its level."""
    return force / secant_stiffness(spring, force)


@compiled
def energy_at_level(spring: Spring) -> float:
    """Returns the energy of a spring that has just reached its level, F²/2K, or 0 without K."""
    stiffness, level = spring
    return 0.5 * level * level / stiffness if stiffness > 0.0 else 0.0


@compiled
def spring_energy(spring: Spring, length: float) -> float:
    """Returns ∫ g(K e) de from 0 to a length."""
    stiffness, level = spring
    elastic = min(length, level / stiffness) if stiffness > 0.0 else 0.0
    return 0.5 * stiffness * elastic * elastic + min(stiffness * length, level) * (length - elastic)


@compiled
def spring_length(spring: Spring, energy: float) -> float:
    """Returns the length at which a spring holds an energy, 0 without stiffness."""
    stiffness, level = spring
    if stiffness <= 0.0:
        return 0.0
    elastic = energy_at_level(spring)
    if energy <= elastic:
        return math.sqrt(2.0 * energy / stiffness)
    return level / stiffness + (energy - elastic) / level


@compiled
def held_energy(s: State, stretch: Vector, twist: Vector) -> float:
    """Returns the energy that both springs hold at a stretch in m and a twist in rad."""
    linear, angular = springs(s)
    return spring_energy(linear, norm(stretch)) + spring_energy(angular, norm(twist))


@compiled
def slack_of_step(s: State) -> tuple[float, float]:
    """Returns the slack in J of the tick's translation and of its rotation.

        slack_k = ½ g ‖δx_k‖²,    ½ g_r ‖δφ_k‖²

    g in N/m and g_r in N m/rad are those of ``slack_gains``. The tool's step takes the law from
    u + g δx to u. Between them the potential is quadratic, and this much is left over, only if the
    curve is straight there. At the force level nothing is left.
    """
    loop, k = s.loop, s.coupling
    linear, angular = springs(s)
    return (
        _slack(s, linear, k.slack_stiffness, loop.motion, loop.wrench_on_tool),
        _slack(
            s, angular, k.slack_rotational_stiffness, loop.motion[3:6], loop.wrench_on_tool[3:6]
        ),
    )


@compiled
def _slack(
    s: State,
    spring: Spring,
    gain: float,
    motion: NDArray[np.float64],
    wrench: NDArray[np.float64],
) -> float:
    moved, u = vector_of(motion), vector_of(wrench)
    square = dot(moved, moved)
    change = gain * math.sqrt(square)
    if s.run.law_evaluations > 1:  # ``gain`` is SLACK_SHARE times that of one evaluation
        change *= 1.0 / SLACK_SHARE
    return 0.5 * gain * square if is_straight(spring, math.sqrt(dot(u, u)), change) else 0.0


@compiled
def law_wrench(
    s: State, stretch: Vector, twist: Vector, moved: Vector, turned: Vector
) -> tuple[Vector, Vector]:
    """Returns the coupling's force and torque on the tool, for one evaluation of the law.

    Args:
        s: The bound state.
        stretch: From the tool to the handle in m, at the end of the step.
        twist: The same in rad.
        moved: Motion of the tool in m since the previous evaluation.
        turned: Its rotation vector in rad.
    """
    k, count = s.coupling, s.run.law_evaluations
    share, rate = 1.0 / count, count / s.run.period
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


# A torque across the motion
#
# About a twist φ the midpoint form of the rotational spring differs from the law by a part across
# the motion δφ_h − δφ_x, of a = K_r φ/4 in N m/rad. ``theory.bounds.midpoint_damping`` has what it
# costs; here it is solved for the a that the device's damping pays for.


@compiled
def twist_price(s: State, twist: float) -> float:
    """Returns the damping b_r/T in N m/rad that a twist in rad costs beyond K_r/2 + B'_r/T."""
    k, rate = s.coupling.rotational_stiffness, s.coupling.rotational_damping / s.run.period
    across = min(0.25 * k * twist, torque_across(s))
    if across <= 0.0 or s.coupling.twist_damping == np.inf:
        return 0.0
    far = math.sqrt((k + rate) ** 2 + across**2) + math.sqrt(rate**2 + across**2)
    return float(far * far / (2.0 * (k + 2.0 * rate)) - (0.5 * k + rate))


@compiled
def torque_across(s: State) -> float:
    """Returns the largest a in N m/rad for which the device's damping pays."""
    k, rate = s.coupling.rotational_stiffness, s.coupling.rotational_damping / s.run.period
    b = s.coupling.twist_damping / s.run.period
    if k <= 0.0 or b == np.inf:
        return np.inf
    whole = k + 2.0 * rate
    if b <= 0.5 * whole:
        return 0.0
    root = math.sqrt(2.0 * whole * b)  # p + q
    near = 0.5 * (root - k * whole / root)  # q
    return math.sqrt(max(near * near - rate * rate, 0.0))


@compiled
def command_handle_velocity(s: State, orientation: Quaternion) -> None:
    """Writes the handle's velocity in its own axes, R_hᵀ δh/T and R_hᵀ δφ_h/T, as control.

    The actuators need it because a mocap body has no velocity of its own. The actuator of a joint
    gets the handle's position too, as its bias (``set_gains``).
    """
    if s.mj.held_qpos != 0:
        set_gains(s, 1.0)
        return
    to_handle = conjugate(orientation)
    ctrl = floats(s.mj.ctrl + 8 * s.mj.coupling_ctrl_adr, 6)
    rate = 1.0 / s.run.period
    store_vector(ctrl[0:3], scaled(rate, rotated(to_handle, vector_of(s.pose.handle_step))))
    store_vector(ctrl[3:6], scaled(rate, rotated(to_handle, vector_of(s.pose.handle_turn))))


@compiled
def set_gains(s: State, share: float) -> None:
    """Gives the coupling's actuators a share of their gains.

    The actuator of a joint has no handle to refer to; its bias is c (K h + B' δh/T) instead.
    """
    mj = s.mj
    if mj.held_qpos != 0:
        part = share * s.level.gain_ratio[0]
        bias = floats(mj.biasprm + 8 * _GAINS * mj.coupling_actuator_id, 3)
        stiffness, damping = s.coupling.gains[1], s.coupling.gains[2]
        speed = s.pose.handle_step[0] / s.run.period
        bias[0] = part * (stiffness * s.pose.handle_position[0] + damping * speed)
        bias[1], bias[2] = -part * stiffness, -part * damping
        return
    for axis in range(6):
        first = 0 if axis < 3 else 3
        part = share * s.level.gain_ratio[0 if axis < 3 else 1]
        actuator = mj.coupling_actuator_id + axis
        floats(mj.gainprm + 8 * _GAINS * actuator, 1)[0] = part * s.coupling.gains[first]
        bias = floats(mj.biasprm + 8 * _GAINS * actuator, 3)
        bias[1] = -part * s.coupling.gains[first + 1]
        bias[2] = -part * s.coupling.gains[first + 2]


@compiled
def applied_wrench(s: State, share: float) -> tuple[Vector, Vector]:
    """Returns the mean wrench that the coupling's actuators applied to the tool in the step.

    In the handle's axes. ``actuator_force`` is their force at the step's start; two terms of
    MuJoCo's effective metric take it to the end (``ledger._actuator_work``).

    Args:
        s: The bound state after a step of the integrator ``discrete``.
        share: Share of the gains, as given to ``set_gains``.
    """
    if s.mj.held_qpos != 0:
        return (_applied(s, 0, share), 0.0, 0.0), (0.0, 0.0, 0.0)
    force = (_applied(s, 0, share), _applied(s, 1, share), _applied(s, 2, share))
    torque = (_applied(s, 3, share), _applied(s, 4, share), _applied(s, 5, share))
    return force, torque


@compiled
def _applied(s: State, axis: int, share: float) -> float:
    mj, h = s.mj, s.run.timestep
    actuator, row = mj.coupling_output_adr + axis, 0 if axis < 3 else 3
    part = share * s.level.gain_ratio[0 if axis < 3 else 1]
    stiffness, damping = s.coupling.gains[row + 1], s.coupling.gains[row + 2]
    end = moment_dot(s, actuator, mj.qvel)
    change = moment_dot(s, actuator, mj.qacc)
    in_position, in_velocity = part * h * stiffness, part * h * (h * stiffness + damping)
    force = floats(mj.actuator_force, actuator + 1)[actuator]
    return float(force - in_position * (end - h * change) - in_velocity * change)


@compiled
def pulled(s: State) -> tuple[Vector, Vector]:
    """Returns stretch in m and twist in rad between the handle's new and the tool's old pose.

    With n evaluations of the law per tick, after the first of the handle's n steps.
    """
    pose = s.pose
    ahead = 1.0 - 1.0 / s.run.law_evaluations
    stretch = subtract(vector_of(pose.handle_position), scaled(ahead, vector_of(pose.handle_step)))
    stretch = subtract(stretch, vector_of(pose.tool_position))
    back = quaternion_exp(scaled(-ahead, vector_of(pose.handle_turn)))
    orientation = product(back, quaternion_of(pose.handle_quaternion))
    return stretch, rotation_between(quaternion_of(pose.tool_quaternion), orientation)


@compiled
def within(v: Vector, length: float) -> Vector:
    """Returns a vector, shortened to a largest length >= 0."""
    size = norm(v)
    return scaled(length / size, v) if size > length else v


@compiled
def _held(s: State, v: Vector, first: int, length: float) -> Vector:
    """Returns a vector whose part along the axes without motor is shortened to a length."""
    axes = s.run.axes
    x, y, z = device_from_scene(axes, v)
    k = s.coupling.lacks_motor
    part = scene_from_device(axes, (x * k[first], y * k[first + 1], z * k[first + 2]))
    return add(v, subtract(within(part, length), part))


@compiled
def _lateness(s: State, kind: int, interval: float, ticks: int) -> float:
    """Returns the energy D of ``charge_lateness`` in J, of translation (0) or rotation (1).

    Args:
        s: The bound state, with the handle's new step d.
        kind: 0 or 1.
        interval: Time t since the last new sample in s.
        ticks: m, ticks in this time.
    """
    k, run, pose = s.coupling, s.run, s.pose
    stiffness, damping, across = k.stiffness, k.damping, 0.0
    b = (run.device_damping - s.impact.spare) / (run.force_scale * run.scale)
    d = vector_of(pose.handle_step)
    if kind == 1:
        stiffness, damping = k.rotational_stiffness, k.rotational_damping
        b = run.device_rotational_damping * run.scale / run.force_scale
        d = vector_of(pose.handle_turn)
        if run.scheme == Scheme.MIDPOINT:
            across = twist_price(s, norm(vector_of(s.lossless.twist)))
    b = max(b, 0.5 * stiffness * run.period + damping)
    needed = 0.5 * stiffness + damping / run.period
    late = (needed + across - b / interval) * dot(d, d)
    if ticks > 1:
        then, pulled_on = (
            k.tool_then,
            subtract(vector_of(k.tool_then), vector_of(pose.tool_position)),
        )
        if kind == 1:
            turn = (then[3], then[4], then[5], then[6])
            pulled_on = rotation_between(quaternion_of(pose.tool_quaternion), turn)
        paid = needed * dot(pulled_on, pulled_on) / (ticks - 1)
        late += max(stiffness * dot(pulled_on, d) - paid, 0.0)
    return float(late)


@compiled
def note_tool(s: State) -> None:
    """Notes the tool's pose after the tick of a new sample."""
    then, pose = s.coupling.tool_then, s.pose
    for i in range(3):
        then[i] = pose.tool_position[i]
    for i in range(4):
        then[3 + i] = pose.tool_quaternion[i]


@compiled
def charge_lateness(s: State, interval: float, ticks: int) -> None:
    """Charges the springs with the energy that a late sample may have put in.

        D = (K/2 + B'/T + c − b/t) ‖d‖² + max(K σ·d − (K/2 + B'/T) ‖σ‖²/(m − 1), 0)

    with b >= K T/2 + B' + c T. c is what a torque across the motion costs. In the m ticks since the
    last sample the tool has stretched the spring by σ, and the hand may have felt the force of the
    first alone. The second part is at most (m − 1) K²/(2 (K + 2B'/T)) ‖d‖², what
    ``theory.bounds.minimum_damping`` takes for any scene. d is the handle's
    step in m, t the time in s since the last sample, T the period. The hand has felt a held force
    while the spring was stretched by d; the device burned b ‖d‖²/t. D is below zero for a sample in
    time; a late one pays later, because the handle slips until the springs hold less by D. b in
    N s/m is the device's damping seen at the handle, at least what the condition needs, and without
    that which pulses count on (``kernel.impact_pulse``).
    """
    if ticks == 1:
        note_tool(s)
    for kind in range(2):
        late = _lateness(s, kind, interval, ticks)
        s.coupling.owed[kind] = max(s.coupling.owed[kind] + late, 0.0)


@compiled
def note_sent(s: State) -> None:
    """Notes lever and wrench on the tool of the present tick, and the mean turn of both ends."""
    sent, loop = s.coupling.sent[s.loop.tick % SENT], s.loop
    sent[0] = s.guard.lever
    for i in range(6):
        sent[1 + i] = loop.wrench_on_tool[i]
    for i in range(3):
        sent[7 + i] = 0.5 * (s.pose.handle_turn[i] + loop.motion[3 + i])


def forget_sent(coupling: Part) -> None:
    """Forgets the wrenches on their way to the device: it holds none, or the springs are empty."""
    coupling["sent"] = 0.0


@compiled
def owe(s: State, energy: float) -> None:
    """Charges the springs with an energy in J that something else gave the hand too early."""
    s.coupling.owed[0] += energy


@compiled
def charge_lag(s: State, lever: float, ticks: int, moved: Vector, turned: Vector) -> None:
    """Charges the springs with what a late wrench gives beside the law's own delay.

        Z_k = max_j (r_{k−1} − r_{k−1−j}) f_{k−1−j}·scale A δp_k,    j = 0 … d
        Z_k = max_j (r_{k−1} Q_j − r_{k−1−j}) τ_{k−1−j}·A δφ_k

    The handle moves by r_{k−1} times the device's motion δp in m and δφ in rad. The device still
    holds the wrench of j ticks before, with the lever r of that time, and a torque in the direction
    of that time. d counts the ticks of its delay, and those in which a slow device gave no sample.
    Q_j is the mean turn of handle and tool since then, with which the torque of a coupling turns.
    Otherwise a hand gets (T/4b) (Δr F)² a tick for nothing while the force fades, and a hand that
    wobbles about a twist, with a tool that follows, up to τ Σ_j sin(jθ) ‖δφ‖².

    Args:
        s: The bound state.
        lever: r_{k−1}.
        ticks: Ticks since the last new sample.
        moved: δp in the device's frame.
        turned: δφ in the device's frame.
    """
    k = s.coupling
    way = scaled(s.run.scale, scene_from_device(s.run.axes, moved))
    turn = scene_from_device(s.run.axes, turned)
    most = most_r = 0.0
    since, late = (0.0, 0.0, 0.0), k.late_ticks
    if ticks <= s.guard.stale_ticks:  # after a longer silence the force has faded
        late = min(late + ticks - 1, SENT - 1)
    for j in range(1, late + 1):
        since = add(since, vector_of(k.sent[(s.loop.tick - j) % SENT][7:10]))
        sent = k.sent[(s.loop.tick - 1 - j) % SENT]
        most = max(most, (lever - sent[0]) * dot(vector_of(sent[1:4]), way))
        torque = vector_of(sent[4:7])
        carried = scaled(lever, rotated(quaternion_exp(since), torque))
        most_r = max(most_r, dot(subtract(carried, scaled(sent[0], torque)), turn))
    k.owed[0] += most
    k.owed[1] += most_r


@compiled
def _paid(spring: Spring, length: float, owed: float) -> tuple[float, float]:
    """Returns the length at which a spring has paid what it owes, and what is left to pay."""
    energy = spring_energy(spring, length)
    if spring.stiffness <= 0.0 or owed <= 0.0:
        return np.inf, 0.0
    return spring_length(spring, max(energy - owed, 0.0)), max(owed - energy, 0.0)


@compiled
def felt(s: State, force: Vector, torque: Vector) -> tuple[Vector, Vector]:
    """Returns the parts of a wrench on the device along the axes that have a motor."""
    if not s.coupling.lacks_motors:
        return force, torque
    k = s.coupling.lacks_motor
    return (
        (force[0] * (1.0 - k[0]), force[1] * (1.0 - k[1]), force[2] * (1.0 - k[2])),
        (torque[0] * (1.0 - k[3]), torque[1] * (1.0 - k[4]), torque[2] * (1.0 - k[5])),
    )


@compiled
def turned_on(before: Vector, twist: Vector) -> Vector:
    """Returns a twist in rad that goes on beyond half a turn if it came from the other side.

    Args:
        before: The twist in rad a tick or step before.
        twist: The present twist in rad, at most half a turn.
    """
    size = norm(twist)
    if size <= LARGEST_TWIST or dot(before, twist) >= 0.0:
        return twist
    return scaled(1.0 - 2.0 * math.pi / size, twist)


@compiled
def pulled_after_step(
    s: State, handle: tuple[Vector, Quaternion], tool: tuple[Vector, Quaternion]
) -> tuple[Vector, Vector]:
    """Returns stretch in m and twist in rad at the end of a step, before the tool is noted.

    The twist goes on beyond half a turn, as in MuJoCo's step, which is linear in the turn.
    """
    before = rotation_between(quaternion_of(s.pose.tool_quaternion), handle[1])
    twist = turned_on(before, rotation_between(tool[1], handle[1]))
    return subtract(handle[0], tool[0]), twist


@compiled
def unwound(s: State, twist: Vector) -> Vector:
    """Returns a twist in rad that goes on beyond half a turn, where handle or tool turned across.

    Otherwise the handle would slip to ``LARGEST_TWIST`` on the other side, where the torque is
    reversed: a hand that goes to and fro by δ behind a torque a tick late gets 2.5 K_r δ − b_r δ²/T
    each time, for δ from 0.64 rad on.
    """
    if norm(twist) <= LARGEST_TWIST:
        return twist
    back = quaternion_exp(scaled(-1.0 / s.run.law_evaluations, vector_of(s.pose.handle_turn)))
    turned = quaternion_exp(vector_of(s.pose.tool_turn))
    before = product(product(back, quaternion_exp(twist)), turned)
    return turned_on(rotation_between(UPRIGHT, before), twist)


@compiled
def slip(s: State, max_stretch: float, max_twist: float) -> bool:
    """Slips the handle toward the tool, where the spring holds more than it may.

    Five things make it slip. A late sample or wrench is charged (``charge_lateness``,
    ``charge_lag``). A raised gain must not raise the spring's energy. Along an axis without motor
    the coupling holds up to ``hold`` and then slips. While the hand is let go it relaxes to
    ``idle``. A twist ends at ``LARGEST_TWIST`` where no limit stops the run, and behind a late
    device. Each only shortens the spring, so energy is lost and none is gained.

    **Derivation of the last.** Up to half a turn V(φ) = ½ K_r ‖φ‖² is convex along every turn, and
    its torque changes by at most K_r ‖δφ‖ beside the turn of its direction, which ``charge_lag``
    pays. At φ = π the torque K_r φ becomes −K_r φ at once, while V stays. A hand that comes across
    by δ and back, with the torque of a time t before, gets 2 K_r π δ − b_r δ²/t each way: at most
    (K_r π)² t/b_r, a power of (K_r π)²/b_r for every t > 0. So no damping bears it, behind any
    device whose torque does not act at the instant of its sample, of known delay or not. A tool
    that comes across by δ gets K_r π δ from the midpoint form, in time too. A missing sample alone
    is borne: the torque that is held is of before, and the hand pays it. In time, a limit of the
    angle of at most ``STOPPED_TWIST`` stops a run before.

    Args:
        s: The bound state, with the handle's new and the tool's old pose.
        max_stretch: Largest stretch in m.
        max_twist: Largest twist in rad.

    Returns:
        True if it slipped.
    """
    k = s.coupling
    linear, angular = springs(s)
    stretch, twist = pulled(s)
    if s.guard.has_hand and (k.late_ticks > 0 or s.guard.max_angle > STOPPED_TWIST):
        max_twist, twist = min(max_twist, LARGEST_TWIST), unwound(s, twist)
    if k.owed[0] > 0.0 or k.owed[1] > 0.0:
        length, k.owed[0] = _paid(linear, norm(stretch), k.owed[0])
        angle, k.owed[1] = _paid(angular, norm(twist), k.owed[1])
        max_stretch, max_twist = min(max_stretch, length), min(max_twist, angle)
    new, new_twist = within(stretch, max_stretch), within(twist, max_twist)
    if k.lacks_motors:
        new = _held(s, new, 0, length_at(linear, k.hold[0]))
        if angular.stiffness > 0.0:
            new_twist = _held(s, new_twist, 3, length_at(angular, k.hold[1]))
    if s.guard.lever == 0.0:
        new = within(new, length_at(linear, k.idle[0]))
        if angular.stiffness > 0.0:
            new_twist = within(new_twist, length_at(angular, k.idle[1]))
    if new == stretch and new_twist == twist:
        return False
    slip_handle(s.pose, subtract(new, stretch), subtract(new_twist, twist))
    return True


@compiled
def retune(s: State) -> tuple[float, float]:
    """Moves the gains one tick nearer to their goal.

    Returns:
        Largest stretch in m and twist in rad with which the spring's energy does not rise.
    """
    k, goal, left = s.coupling, s.coupling.tuning_goal, s.coupling.tuning_ticks
    stretch, twist = pulled(s)
    linear, angular = springs(s)
    energy, energy_r = spring_energy(linear, norm(stretch)), spring_energy(angular, norm(twist))
    share = 1.0 / left
    k.stiffness += share * (goal.stiffness - k.stiffness)
    k.damping += share * (goal.damping - k.damping)
    k.rotational_stiffness += share * (goal.rotational_stiffness - k.rotational_stiffness)
    k.rotational_damping += share * (goal.rotational_damping - k.rotational_damping)
    k.slack_stiffness += share * (goal.slack_stiffness - k.slack_stiffness)
    k.slack_rotational_stiffness += share * (
        goal.slack_rotational_stiffness - k.slack_rotational_stiffness
    )
    for i in range(6):
        k.gains[i] += share * (goal.gains[i] - k.gains[i])
    if left == 1:  # without the error of rounding
        k.stiffness, k.damping = goal.stiffness, goal.damping
        k.rotational_stiffness = goal.rotational_stiffness
        k.rotational_damping = goal.rotational_damping
        k.slack_stiffness = goal.slack_stiffness
        k.slack_rotational_stiffness = goal.slack_rotational_stiffness
        for i in range(6):
            k.gains[i] = goal.gains[i]
    k.tuning_ticks = left - 1
    if s.run.scheme != Scheme.SHOWN:  # then the scene's own loop does it, in its own time
        set_gains(s, 0.5 if s.lossless.is_midpoint else 1.0)

    length = angle = np.inf
    tuned, tuned_r = springs(s)
    if tuned.stiffness > linear.stiffness:
        length = spring_length(tuned, energy)
    if tuned_r.stiffness > angular.stiffness:
        angle = spring_length(tuned_r, energy_r)
    return length, angle
