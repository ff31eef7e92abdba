"""The part of MuJoCo's step that needs no new sample, done ahead while the loop waits for one.

MuJoCo's step is a chain of stages: positions (kinematics, inertia, collisions, constraints),
velocities, forces, solver, integration. Of the first, only the handle's own pose and the six
actuators' moments depend on the device: the handle has no mass and no geom. So the live loop can
run that stage on the new state as soon as the wrench is out. When the sample comes, the handle is
put to its place, moments and velocities are computed, and MuJoCo's second half (``mj_step2``) does
the rest. Every number is the one that a whole step would have computed, to the bit.

A whole step is done instead where more depends on the sample, or on who had the scene meanwhile:
at the first tick, after a pause, after a mocap body of the scene was moved, and where a position or
velocity is so large that MuJoCo's own check at the start of a step would reset the scene. Methods
and scenes for which it does not hold at all: ``can_split``.
"""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.jit import compiled
from hapticbridge.kernel.codes import LARGEST_CONTROL
from hapticbridge.kernel.native import (
    floats,
    mj_fwd_velocity,
    mj_kinematics,
    mj_sensor_pos,
    mj_sensor_vel,
    mj_transmission,
)
from hapticbridge.kernel.scheme import COUPLED, HELD, LOSSLESS


def can_split(model: mujoco.MjModel, scheme: int) -> bool:
    """Tells whether the position stage may run ahead of the sample.

    Not with a weld to the handle, whose constraint rows change with its pose; not where the tool is
    where the handle is; not under RK4, which evaluates all stages four times; and not with a
    plugin or a callback for the controls, which may look at anything.

    Args:
        model: The prepared scene.
        scheme: How the wrench reaches the tool (``kernel.scheme``).
    """
    return (
        scheme in (COUPLED, HELD, LOSSLESS)
        and model.opt.integrator != mujoco.mjtIntegrator.mjINT_RK4
        and model.nplugin == 0
        and mujoco.get_mjcb_control() is None
    )


@compiled
def take_handle_in(state: NDArray[np.void]) -> None:
    """Redoes what depends on the handle's pose in the position stage, and the velocity stage.

    None of these can fail where the position stage has just succeeded through Python.
    """
    s = state[0]
    mj_kinematics(s.model, s.data)
    if s.nsensor > 0:
        mj_sensor_pos(s.model, s.data)
    mj_transmission(s.model, s.data)
    mj_fwd_velocity(s.model, s.data)
    if s.nsensor > 0:
        mj_sensor_vel(s.model, s.data)


@compiled
def is_sound(state: NDArray[np.void]) -> bool:
    """Tells whether MuJoCo's check at the start of a step would find nothing to reset."""
    s = state[0]
    for values in (floats(s.qpos, s.nq), floats(s.qvel, s.nv)):
        for value in values:
            if not abs(value) < LARGEST_CONTROL:  # not a number is not less either
                return False
    return True
