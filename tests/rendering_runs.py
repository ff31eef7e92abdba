"""Rigs that show what a rendering method does: one free mass, a light rotor between walls."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from kernel_runs import Array, Run, T, load, run_of, samples_of, sines, unlimited
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hapticbridge.coupling import Coupling
from hapticbridge.demand.guard import Limits
from hapticbridge.demand.methods import method_named, prepare, resolve_contact_stiffness
from hapticbridge.device import SimulatedDevice
from hapticbridge.kernel.record import TICK_DTYPE
from hapticbridge.kernel.state import BoundKernel
from hapticbridge.kernel.tick import simulate
from hapticbridge.scene import Scene

FREE_MASS = """
<mujoco>
  <option gravity="0 0 0"/>
  <worldbody>
    <body name="tool"><freejoint/>
      <geom type="sphere" size="0.01" mass="{mass}" contype="0" conaffinity="0"/>
      <site name="grip"/>
    </body>
  </worldbody>
</mujoco>"""

FIFTY_GRAMS = FREE_MASS.format(mass=0.05)

SLOT = """
<mujoco>
  <compiler angle="radian"/>
  <option gravity="0 0 0" cone="elliptic"/>
  <default><geom solref="0.002 1" solimp="0.9 0.95 0.001" friction="0 0 0"/></default>
  <worldbody>
    <geom name="east" type="box" size="0.01 0.05 0.6" pos="0.015 0 0"/>
    <geom name="west" type="box" size="0.01 0.05 0.6" pos="-0.015 0 0"/>
    <body name="bar">
      <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>
      <joint type="hinge" axis="0 1 0"/>
      <geom type="sphere" size="0.005" pos="0 0 {half}" mass="0.05"/>
      <geom type="sphere" size="0.005" pos="0 0 -{half}" mass="0.05"/>
      <site name="grip"/>
    </body>
  </worldbody>
</mujoco>"""
"""A planar bar whose two ends just touch both walls: turned either way, each end presses on one."""


def rendered(
    method: str,
    coupling: Coupling,
    samples: NDArray[np.void],
    scene: Scene | str = FIFTY_GRAMS,
    *,
    contact_stiffness: float | None = None,
    substeps: int = 1,
    **changes: Any,
) -> Run:
    """Runs a method inside the compiled kernel, without force limits."""
    scene = load(scene) if isinstance(scene, str) else scene
    chosen = method_named(method)
    felt = prepare(scene, coupling, T, substeps, chosen)
    parameters = unlimited(
        scene,
        coupling,
        substeps=substeps,
        scheme=chosen.scheme,
        is_rigid=chosen.is_rigid,
        effective=felt,
        contact_stiffness=resolve_contact_stiffness(chosen, coupling, contact_stiffness),
        **changes,
    )
    binding = BoundKernel(scene.model, scene.data, parameters)
    run = run_of(scene, binding, parameters)
    rows = np.zeros(len(samples), TICK_DTYPE)
    done = simulate(binding.state, samples, binding.row, rows)
    run.ticks = rows[:done]
    return run


def sway(count: int = 2000, amplitude: float = 0.02, frequency: float = 3.0) -> NDArray[np.void]:
    """Returns samples of a hand that moves along x alone."""
    motion: Array = np.zeros((count, 3))
    motion[:, 0] = amplitude * np.sin(2 * np.pi * frequency * T * np.arange(1, count + 1))
    return samples_of(motion)


class Rotor(SimulatedDevice):
    """A free device, turned by 1 µrad about y at its start; light, so that damping limits alone.

    Args:
        damping: b in N m s/rad.
        is_real: What its data sheet claims.
    """

    def __init__(self, damping: float = 2e-3, *, is_real: bool = False) -> None:
        super().__init__(
            damping=50.0,
            rotational_inertia=1e-7,
            rotational_damping=damping,
            hand=None,
            force_limit=100.0,
            torque_limit=10.0,
        )
        self.info = replace(self.info, is_real=is_real)

    def start(self, period: float, parts: int = 1) -> NDArray[np.void]:
        sample = super().start(period, parts)
        self.displace(np.array([0, 0, 0, 0, 1e-6, 0]))
        return sample


COUPLING = Coupling(2000.0, 2.0, 2.0, 2e-3)


FREE = Limits(force=100.0, torque=10.0, ramp=0.0, stretch=np.inf, angle=np.inf, energy=np.inf)


TURNED_TOOL = """
<mujoco>
  <option gravity="0 0 0"/>
  <worldbody>
    <body name="tool" euler="10 20 30"><freejoint/>
      <geom type="box" size="0.01 0.02 0.03" mass="0.1" contype="0" conaffinity="0"/>
      <site name="grip" pos="0.02 0.01 0" euler="40 0 10"/>
    </body>
  </worldbody>
</mujoco>"""


SERVO = """
<mujoco>
  <option gravity="0 0 0"/>
  <worldbody>
    <body name="tool"><freejoint/><geom size="0.01" mass="0.1"/><site name="grip"/></body>
    <body name="arm" pos="0.2 0 0" gravcomp="{gravcomp}"><joint name="arm" type="slide"/>
      <geom size="0.01" mass="0.2"/></body>
    <body name="plate" mocap="{mocap}" pos="0 0 1"/>
  </worldbody>
  <actuator>{actuator}</actuator>
</mujoco>"""

WALL = """
<mujoco>
  <option gravity="0 0 0"/>
  <worldbody>
    <geom type="box" size="0.01 0.1 0.1" pos="0.07 0 0"/>
    <body name="tool"><freejoint/><geom type="sphere" size="0.01" mass="0.1"/>
      <site name="grip"/></body>
  </worldbody>
</mujoco>"""
"""A wall 5 cm before a ball."""


def waved(count: int = 300) -> Any:
    """A hand that moves and turns about all axes."""
    return samples_of(sines(count, 0.02, 3.0), Rotation.from_rotvec(sines(count, 0.3, 2.0)))
