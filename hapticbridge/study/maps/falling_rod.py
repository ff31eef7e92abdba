"""A rig: a rod that falls on MuJoCo's floor, with one point that can touch it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import mujoco
import numpy as np

from hapticbridge.errors import StudyError, choices

MASS, LENGTH = 1.0, 1.0
"""Of the uniform rod, in kg and m."""
INERTIA = MASS * LENGTH**2 / 12
"""About its centre of mass, in kg m²."""

TIP = 1e-3
"""Radius in m of the sphere that is the rod's lower end: a point, next to 1 m."""

APPROACH = 1.0
"""Speed in m/s at which the rod falls, without turning. Gravity is off: only the contact acts."""

LONGEST = 0.2
"""Time in s after which a contact that has not ended is read as it is: four times the longest."""

ROD = f"""
<mujoco>
  <compiler angle="radian"/>
  <option gravity="0 0 0" cone="elliptic"><flag diagexact="enable"/></option>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 1"/>
    <body name="rod">
      <joint type="slide" axis="1 0 0"/>
      <joint type="slide" axis="0 0 1"/>
      <joint type="hinge" axis="0 1 0"/>
      <inertial pos="0 0 0" mass="{MASS!r}" diaginertia="{INERTIA!r} {INERTIA!r} 0.001"/>
      <geom name="tip" type="sphere" size="{TIP!r}" pos="{-LENGTH / 2!r} 0 0"/>
    </body>
  </worldbody>
</mujoco>"""
"""A rod that moves in a plane and whose lower end alone can touch the floor."""


@dataclass(frozen=True, slots=True)
class ContactSetting:
    """How MuJoCo is asked to make the contact.

    Attributes:
        solref: Time constant in s and damping ratio, or minus stiffness and damping.
        impedance: ``dmin`` and ``dmax``, without unit.
        integrator: By its name in MJCF.
        timestep: In s.
    """

    solref: tuple[float, float]
    impedance: tuple[float, float]
    integrator: str
    timestep: float = 1e-3


SETTINGS: Mapping[str, ContactSetting] = {
    "scenes": ContactSetting((0.002, 1.0), (0.9, 0.95), "discrete"),
    "scenes, implicitfast": ContactSetting((0.002, 1.0), (0.9, 0.95), "implicitfast"),
    "soft": ContactSetting((0.02, 1.0), (0.9, 0.95), "discrete"),
    "bouncy": ContactSetting((0.02, 0.1), (0.9, 0.95), "discrete"),
    "bouncy, implicitfast": ContactSetting((0.02, 0.1), (0.9, 0.95), "implicitfast"),
    "bouncy, implicitfast, 0.1 ms": ContactSetting((0.02, 0.1), (0.9, 0.95), "implicitfast", 1e-4),
    "hard spring": ContactSetting((-1e5, -5.0), (0.99, 0.99), "discrete"),
}
"""``scenes`` is that of the scenes that come with hapticbridge, ``soft`` has MuJoCo's default
``solref``; the others show what rebounds."""

_INTEGRATORS = {
    "discrete": mujoco.mjtIntegrator.mjINT_DISCRETE,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
}


@dataclass(frozen=True, slots=True)
class Rebound:
    """What one contact did to the rod.

    Attributes:
        velocity: Of the tip along t and n afterwards in m/s.
        energy_change: Kinetic energy after minus before in J.
        first_gain: First step after which the rod had more than at the start, −1 for none.
        steps: How many the contact took.
    """

    velocity: tuple[float, float]
    energy_change: float
    first_gain: int
    steps: int


@lru_cache
def restitution_of(setting: str) -> float:
    """Returns e of a contact setting, from a rod that falls upright without friction.

    Held in [0, 1], as the laws want it.
    """
    return min(1.0, max(0.0, drop(setting, np.pi / 2, 0.0, 0.0).velocity[1] / APPROACH))


def drop(setting: str, angle: float, friction: float, slide: float) -> Rebound:
    """Lets MuJoCo's contact act on a rod until it ends.

    The tip starts half a step's fall above the floor. The contact has ended when its force is 0
    again.

    Args:
        setting: One of ``SETTINGS``.
        angle: Of the rod above the floor in rad; π/2 stands upright.
        friction: μ, >= 0, without unit.
        slide: Speed along the floor in m/s, > 0 towards the rod's upper end.

    Raises:
        StudyError: There is no such setting.
    """
    if setting not in SETTINGS:
        raise StudyError(f"no contact setting is called '{setting}'; it has {choices(SETTINGS)}")
    chosen = SETTINGS[setting]
    model, data = _rod()
    model.opt.timestep = chosen.timestep
    model.opt.integrator = _INTEGRATORS[chosen.integrator]
    model.geom_solref[:] = chosen.solref
    model.geom_solimp[:] = (*chosen.impedance, 0.001, 0.5, 2)
    model.geom_friction[:, 0] = max(friction, 1e-9)  # MuJoCo refuses 0 with a cone
    mujoco.mj_resetData(model, data)
    height = LENGTH / 2 * np.sin(angle) + TIP + APPROACH * chosen.timestep / 2
    data.qpos[:] = 0.0, height, -angle
    data.qvel[:] = slide, -APPROACH, 0.0
    start = 0.5 * MASS * (slide**2 + APPROACH**2)
    touched, first_gain, kinetic, step = False, -1, start, 0
    for step in range(1, round(LONGEST / chosen.timestep) + 1):
        mujoco.mj_step(model, data)
        v_x, v_z, spin = (float(value) for value in data.qvel)
        kinetic = 0.5 * (MASS * (v_x**2 + v_z**2) + INERTIA * spin**2)
        if kinetic > start + 1e-9 and first_gain < 0:
            first_gain = step
        pushes = data.nefc > 0 and data.efc_force[0] > 0
        if touched and not pushes:
            break
        touched = touched or pushes
    tilt = -float(data.qpos[2])
    arm = -LENGTH / 2 * np.cos(tilt), -LENGTH / 2 * np.sin(tilt) - TIP
    velocity = float(v_x + spin * arm[1]), float(v_z - spin * arm[0])
    return Rebound(velocity, kinetic - start, first_gain, step)


@lru_cache
def _rod() -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = mujoco.MjModel.from_xml_string(ROD)
    return model, mujoco.MjData(model)
