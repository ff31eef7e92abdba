"""Coefficient of restitution that a rigid contact asks for and has, and the energy of its blow.

The tip of a uniform rod of 1 kg and 1 m strikes the ground at 1 m/s: upright and without friction,
and at 45° while it slides. Beside it stands Newton's rule on Routh's path (``theory.impact``),
which always has the e that was asked for, and creates energy where it slides back.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.demand.methods import prepare
from hapticbridge.kernel.jit import source_of
from hapticbridge.kernel.restitution import MAX_RESTITUTION, NOTABLE_BOUNCE, restitution
from hapticbridge.kernel.state import BoundKernel
from hapticbridge.kernel.tick import whole_tick
from hapticbridge.plotting import new_figure
from hapticbridge.run.description import sample_at
from hapticbridge.run.options import BridgeOptions, RunSetup
from hapticbridge.scene import load_scene
from hapticbridge.theory.impact import ImpactBody, resolve_impact

ROD = """
<mujoco>
  <compiler angle="radian"/>
  <option gravity="0 0 0" cone="elliptic"/>
  <default><geom solref="0.02 {damping!r}" friction="{friction} 0 0"/></default>
  <worldbody>
    <geom type="plane" size="5 5 .1"/>
    <body name="rod" pos="0 0 {height!r}">
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="z" type="slide" axis="0 0 1"/>
      <joint name="turn" axis="0 -1 0"/>
      <inertial pos="0 0 0" mass="1" diaginertia="0.1 {inertia!r} 0.1"/>
      <geom size="1e-4" pos="{x!r} 0 {z!r}"/>
    </body>
    <body pos="9 0 9"><freejoint/>
      <geom size="0.01" mass="0.1" contype="0" conaffinity="0"/><site name="grip"/></body>
  </worldbody>
</mujoco>"""
"""The rod, and far away a tool, which every run has."""

INERTIA = 1.0 / 12.0
"""Moment of inertia of the rod about its centre in kg m²."""

PERIOD = 1e-3
"""T in s."""

COUPLING = Coupling(100.0, 0.0, 0.1, 0.0)
"""Coupling of the tool far away."""


@dataclass(frozen=True, slots=True)
class Blow:
    """A way in which the rod's tip strikes.

    Attributes:
        label: Words for it.
        angle: Angle of the rod above the ground in rad.
        slide: Speed of the tip along the ground in m/s; it falls at 1 m/s.
        friction: Coefficient of friction.
    """

    label: str
    angle: float
    slide: float
    friction: float

    @property
    def arm(self) -> NDArray[np.float64]:
        """Way from the rod's centre to its tip in m."""
        return np.array([-0.5 * math.cos(self.angle), -0.5 * math.sin(self.angle)])


BLOWS = (
    Blow("upright, no friction", 0.5 * math.pi, 0.0, 0.0),
    Blow("at 45°, sliding, μ = 0.75", 0.25 * math.pi, 0.8, 0.75),
)

ASKED = np.linspace(0.1, 0.98, 23)
"""Coefficients of restitution that are asked for."""


def damping_of(e: float) -> float:
    """Returns the damping ratio of a ``solref`` with a coefficient of restitution, by bisection."""
    low, high, law = 0.0, 4.0, source_of(restitution)
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if law(0.02, middle) > e else (low, middle)
    return low


def rendered(blow: Blow, e: float) -> tuple[float, float]:
    """Returns the coefficient of restitution that a blow had, and the energy that it created in J.

    The tip strikes in the second tick; without a bounce it rests from the third one on.
    """
    x, z = blow.arm.tolist()
    xml = ROD.format(
        damping=damping_of(e),
        friction=blow.friction,
        height=1.5 * PERIOD - z,
        inertia=INERTIA,
        x=x,
        z=z + 1e-4,
    )
    scene = load_scene(mujoco.MjSpec.from_string(xml))
    method = BridgeOptions(method="implicit").rendering_method
    setup = RunSetup(scene=scene, coupling=COUPLING, method=method, period=PERIOD)
    effective = prepare(scene, setup.coupling, PERIOD, 1, setup.method, warns=False)
    start = sample_at((0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0))
    parameters = setup.parameters(start, effective)
    scene.data.joint("x").qvel[0], scene.data.joint("z").qvel[0] = blow.slide, -1.0
    mujoco.mj_forward(scene.model, scene.data)
    kernel = BoundKernel(scene.model, scene.data, parameters)
    for _ in range(3):
        whole_tick(kernel.state, start, kernel.row, PERIOD)
    turn = float(scene.data.joint("turn").qvel[0])
    end = float(scene.data.joint("z").qvel[0]) + turn * x
    return end, float(kernel.row[0]["environment_energy"])


def by_newton(blow: Blow, e: float) -> float:
    """Returns the energy in J that Newton's rule creates; negative if it takes some."""
    body = ImpactBody(1.0, INERTIA, blow.arm)
    return float(
        resolve_impact(body, np.array([blow.slide, -1.0]), blow.friction, e, "newton").energy_change
    )


def draw() -> Figure:
    """Draws e asked against e rendered, and the energies of both rules."""
    figure = new_figure(8.0, 3.4)
    rebound, energy = figure.subplots(1, 2)
    rebound.plot([0.0, 1.0], [0.0, 1.0], color="0.7", lw=0.9, label="as asked")
    for place, blow in enumerate(BLOWS):
        found = np.array([rendered(blow, float(e)) for e in ASKED])
        colour = f"C{place}"
        rebound.plot(ASKED, found[:, 0], "o-", ms=3, color=colour, label=blow.label)
        energy.plot(ASKED, 1e3 * found[:, 1], "o-", ms=3, color=colour, label=blow.label)
        newton = [1e3 * by_newton(blow, float(e)) for e in ASKED]
        energy.plot(ASKED, newton, ls="--", color=colour, label="by Newton's rule")
    rebound.axvline(NOTABLE_BOUNCE, color="0.7", ls=":", lw=0.9)
    rebound.set(xlabel="e asked", ylabel="e rendered", xlim=(0.0, 1.0), ylim=(-0.03, 1.0))
    energy.axhline(0.0, color="black", lw=0.9)
    energy.set(xlabel="e asked", ylabel="energy created (mJ)", xlim=(0.0, MAX_RESTITUTION + 0.02))
    for axes in (rebound, energy):
        axes.legend(fontsize=7)
        axes.spines[["top", "right"]].set_visible(False)
    return figure
