"""Force level of the coupling: one limit of the wrench, on the tool and on the device alike.

With P_F(u) = u min(1, F/‖u‖), the force on the tool is

    f = P_F(u),    u = K e + (B'/T) δe

and the torque has a level of its own. F in N is the device's force limit divided by
``force_scale``. f is the gradient of a convex potential, quadratic up to F/K and linear beyond, and
a monotone damper. Its slopes are at most K and B', so the device condition b >= K T/2 + B' stays as
it is. A limit on the device alone breaks the guarantee: a hand that stretches the coupling far
beyond the limit and then yields receives energy that it never supplied.

MuJoCo solves the coupling implicitly, with the gains c K and c B'. The ratio c = F/‖u‖ depends on
u at the end of the step, which is not known before. So the step is repeated with other gains until
they fit. Positions, contacts and velocities at its start stay valid; only the forces are solved
again. Within a step
u answers to the force nearly as ‖u‖ = A/(1 + c σ); σ is learnt from the last two solutions, and c
for the next tick is extrapolated, so most saturated ticks need one repetition. The ratio is 1 and
nothing is repeated while the coupling is below its level.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.kernel.codes import FORCE_LIMITED, Part, State
from hapticbridge.kernel.handle import (
    handle_of_step,
    note_tool,
    tool_motion,
)
from hapticbridge.kernel.jit import compiled
from hapticbridge.kernel.law import (
    applied_wrench,
    is_bent,
    is_beyond_level,
    law_wrench,
    limited,
    next_gain_ratio,
    pulled_after_step,
    set_gains,
    springs,
)
from hapticbridge.kernel.ledger import has_loaded_body, meter_ports_again
from hapticbridge.kernel.mujoco_c import floats, mj_kinematics, mj_step2
from hapticbridge.kernel.pose import Quaternion, Vector, norm
from hapticbridge.kernel.rigid_contact import aim_again

TOLERANCE = 1e-6
"""Largest error of the wrench within a saturated step, as a share of the level; no unit. The error
is energy of the environment's port and metered there. A smaller value repeats more steps."""

REPETITIONS = 12
"""Largest number of repetitions of a step. Two are usual where a contact opens or closes."""

LEVEL_DTYPE = np.dtype(
    [
        ("level", "<f8", 2),
        ("gain_ratio", "<f8", 2),
        ("previous", "<f8", 2),
        ("compliance", "<f8", 2),
        ("tried", "<f8", 2),
        ("length", "<f8", 2),
        ("wanted", "<f8", 2),
        ("new_length", "<f8", 2),
        ("is_solved", "<i8"),
        ("reads_poses", "<i8"),
        ("repetitions", "<i8"),
        ("state_before", "<i8"),
        ("flags", "<i8"),
    ]
)
"""Sub-record ``level``, written by this module alone. Pairs are force and torque: ``level`` F on
the tool in N and N m, ``gain_ratio`` c of the present gains, ``previous`` c of the previous tick,
``compliance`` σ; ``tried`` c of the previous repetition in the step and ``length`` its ‖u‖;
``wanted`` c of the next repetition and ``new_length`` the present ‖u‖.
``is_solved`` is 1 if steps are repeated, and ``reads_poses`` if sensors or plugins read the bodies'
poses then; ``repetitions`` counts repetitions since the start; ``state_before`` is the
address of MuJoCo's state before the step."""


def bind_level(
    level: Part, model: mujoco.MjModel, levels: tuple[float, float], *, is_solved: bool
) -> dict[str, NDArray[np.generic]]:
    """Fills in the levels; returns the arrays that must outlive the state.

    Args:
        level: The sub-record.
        model: The prepared scene.
        levels: F in N and F_r in N m on the tool.
        is_solved: True if the wrench is solved inside MuJoCo's step.
    """
    level["level"] = levels
    level["gain_ratio"] = level["previous"] = 1.0
    level["is_solved"] = is_solved
    level["reads_poses"] = model.nsensor > 0 or model.nplugin > 0
    before = np.zeros(model.nq + model.nv + model.na + model.nhistory + 1)
    level["state_before"] = before.ctypes.data
    return {"state_before": before}


@compiled
def _copy_state(s: State, is_kept: bool) -> None:
    """Copies MuJoCo's state to where it is kept, or back."""
    mj = s.mj
    kept = floats(s.level.state_before, mj.nq + mj.nv + mj.na + mj.nhistory + 1)
    end = 0
    for address, count in (
        (mj.qpos, mj.nq),
        (mj.qvel, mj.nv),
        (mj.act, mj.na),
        (mj.history, mj.nhistory),
        (mj.time, 1),
    ):
        values = floats(address, count)
        for i in range(count):
            if is_kept:
                kept[end + i] = values[i]
            else:
                values[i] = kept[end + i]
        end += count


@compiled
def keep_state(s: State) -> None:
    """Keeps MuJoCo's state before a step, for a repetition of the step."""
    _copy_state(s, True)


@compiled
def _repeat_step(s: State) -> None:
    """Repeats MuJoCo's step from the state before it; its positions must be those of the start."""
    _copy_state(s, False)
    mj_step2(s.mj.model, s.mj.data)


@compiled
def spend_within_tank(s: State) -> None:
    """Repeats the step that just ended until its contacts spend no more than the tank allows."""
    while aim_again(s):
        _repeat_step(s)


@compiled
def _is_bent(s: State, force: Vector, torque: Vector) -> bool:
    linear, angular = springs(s)
    return is_bent(linear, norm(force)) or is_bent(angular, norm(torque))


@compiled
def limited_wrench(s: State, force: Vector, torque: Vector) -> tuple[Vector, Vector]:
    """Returns P_F of a force and a torque on the tool, and notes if one was limited.

    Numbers that are not finite stay, because they stop the run.
    """
    linear, angular = springs(s)
    new, new_torque = limited(linear, force), limited(angular, torque)
    is_limited = is_beyond_level(linear, norm(force)) or is_beyond_level(angular, norm(torque))
    s.level.flags = FORCE_LIMITED if is_limited else 0
    return new, new_torque


@compiled
def _is_at_level(s: State, count: int) -> bool:
    """Returns True if the wrench is at its level or below; else notes the ratios to try.

    ``count`` is the number of repetitions of the step so far.
    """
    level = s.level
    force, torque = applied_wrench(s, 1.0)
    sizes, both = (norm(force), norm(torque)), springs(s)
    is_done = True
    for ch in range(2):
        c, size = level.gain_ratio[ch], sizes[ch]
        u = level.new_length[ch] = size / c
        if count > 0 and c != level.tried[ch]:
            u_last = level.length[ch]
            change = level.tried[ch] * u_last - size
            if abs(change) > 1e-12 * level.level[ch]:
                level.compliance[ch] = max((u - u_last) / change, 0.0)
        new = next_gain_ratio(both[ch], size, c, level.compliance[ch])
        if count > REPETITIONS // 2:
            new = 0.5 * (c + new)
        if abs(new - c) * u > TOLERANCE * level.level[ch]:
            is_done = False
        level.wanted[ch] = new
    return is_done


@compiled
def _can_try(level: Part) -> bool:
    """Returns True if the ratios to try are numbers."""
    return math.isfinite(level.wanted[0] + level.wanted[1])


@compiled
def _try_ratios(s: State) -> None:
    """Sets the ratios of the step's repetition."""
    level = s.level
    for ch in range(2):
        level.length[ch] = level.new_length[ch]
        level.tried[ch], level.gain_ratio[ch] = level.gain_ratio[ch], level.wanted[ch]
    set_gains(s, 1.0)


@compiled
def _start_again(s: State, count: int) -> None:
    """Repeats the step that just ended, after ``count`` repetitions, within the tank."""
    if count == 0:
        _copy_state(s, False)
        if s.level.reads_poses or has_loaded_body(s):  # which act at the start's positions
            mj_kinematics(s.mj.model, s.mj.data)
    _repeat_step(s)
    spend_within_tank(s)


@compiled
def _solve_levels(states: NDArray[np.void]) -> bool:
    """Repeats the step that just ended until every hand's wrench is at its level or below.

    A repetition changes the wrench of every hand. The first state is that of the scene.

    Returns:
        True if the step was repeated; kinematics must then be refreshed again.
    """
    count, first = 0, states[0]
    for _ in range(REPETITIONS * states.size):
        is_done, can_try = True, True
        for i in range(states.size):
            is_done = _is_at_level(states[i], count) and is_done
            can_try = _can_try(states[i].level) and can_try
        if is_done or not can_try:
            break
        for i in range(states.size):
            _try_ratios(states[i])
        _start_again(first, count)
        count += 1
    first.level.repetitions += count
    if count > 0:
        meter_ports_again(first)
    return count > 0


@compiled
def _foresee_ratios(s: State) -> None:
    """Sets the gains of the next tick: 1/c goes on as in the last two ticks."""
    level = s.level
    is_changed = False
    for ch in range(2):
        c = level.gain_ratio[ch]
        reach = 2.0 / c - 1.0 / level.previous[ch]
        level.previous[ch] = c
        new = 1.0 / reach if c < 1.0 and reach > 1.0 else 1.0
        is_changed = is_changed or new != c
        level.gain_ratio[ch] = new
    if is_changed:
        set_gains(s, 1.0)


@compiled
def _law_after_step(
    s: State, is_last: bool
) -> tuple[Vector, Vector, tuple[Vector, Quaternion, Vector, Vector]]:
    """Returns force and torque of the linear law, and the tool's pose and motion."""
    motion = tool_motion(s)
    position, orientation, moved, turned = motion
    handle = handle_of_step(s, is_last)
    stretch, twist = pulled_after_step(s, handle, (position, orientation))
    force, torque = law_wrench(s, stretch, twist, moved, turned)
    return force, torque, motion


@compiled
def _is_another_bent(states: NDArray[np.void], is_last: bool) -> bool:
    """Returns True if the law of a hand beside the first is bent."""
    for i in range(1, states.size):
        force, torque, _ = _law_after_step(states[i], is_last)
        if _is_bent(states[i], force, torque):
            return True
    return False


@compiled
def limited_wrench_after_step(
    states: NDArray[np.void], is_last: bool
) -> tuple[Vector, Vector, Vector, Vector]:
    """Settles the levels of all hands after a step of MuJoCo, and evaluates the first one's law.

    The bodies' poses are those of the step's end then, and the tool's new pose is noted.

    Args:
        states: The bound states of all hands; the first one meters the scene.
        is_last: True for the last substep of the tick.

    Returns:
        Force, torque, and the tool's motion and rotation vector since the previous evaluation.
    """
    s = states[0]
    is_reduced = False
    for i in range(states.size):
        ratio = states[i].level.gain_ratio
        is_reduced = is_reduced or ratio[0] < 1.0 or ratio[1] < 1.0
    if is_reduced:  # the wrench of the step itself decides, without poses
        _solve_levels(states)
    mj_kinematics(s.mj.model, s.mj.data)
    force, torque, motion = _law_after_step(s, is_last)
    if is_reduced or _is_bent(s, force, torque) or _is_another_bent(states, is_last):
        if s.level.is_solved:
            if not is_reduced and _solve_levels(states):
                mj_kinematics(s.mj.model, s.mj.data)
                force, torque, motion = _law_after_step(s, is_last)
            for i in range(states.size):
                _foresee_ratios(states[i])
        force, torque = limited_wrench(s, force, torque)
    else:
        s.level.flags = 0
    position, orientation, moved, turned = motion
    note_tool(s.pose, position, orientation, turned)
    return force, torque, moved, turned


@compiled
def settled_wrench(s: State, is_last: bool) -> tuple[Vector, Vector, Vector, Vector]:
    """Evaluates another hand's law, after the levels were settled with the first one's."""
    force, torque, motion = _law_after_step(s, is_last)
    force, torque = limited_wrench(s, force, torque)
    position, orientation, moved, turned = motion
    note_tool(s.pose, position, orientation, turned)
    return force, torque, moved, turned
