"""Workload ``rod_impact``: a rod falls on the floor, against the laws of impact."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import mujoco
import numpy as np

from hapticbridge.check.perception import WEBER
from hapticbridge.coupling import Coupling
from hapticbridge.pose import quaternion_exp
from hapticbridge.scene import Scene
from hapticbridge.study.chart.engine_run import PeerWork
from hapticbridge.study.chart.scene_run import Stage, Stages, Take
from hapticbridge.study.chart.score import Score, Verdict, diverged
from hapticbridge.study.chart.spinning_body import still
from hapticbridge.study.chart.staged import Staged
from hapticbridge.study.chart.workload import Panel
from hapticbridge.study.engines.task import Body, Pose, Shape, Task, Velocity
from hapticbridge.study.maps.rigs import scene_of
from hapticbridge.theory.impact import Impact, ImpactBody, resolve_impact

MASS, LENGTH = 0.1, 0.2
"""Of a uniform rod, in kg and m: a light tool."""
INERTIA = MASS * LENGTH**2 / 12
"""About its centre of mass in kg m²."""
THIN = 1e-6
"""About its axis in kg m²: a rod 9 mm thick. Nothing turns it about that axis."""
TIP = 1e-3
"""Radius in m of the sphere at the lower end, all that can touch."""

APPROACH, SLIDE = 0.3, 0.2
"""Speed in m/s at which the rod falls and slides, without turning; a brisk tap."""

FRICTION = 0.3
"""Coulomb's μ, without unit."""

ANGLES = (0.5, 0.8, 1.1, 1.4)
"""Of the rod above the floor in rad, a fall each."""

HEIGHT = 0.6e-3
"""How far the tip is above the floor at the start, in m: 2 ms of falling."""

DURATION = 0.024
"""In s of each fall. A contact as soft as those of the shipped scenes ends within 20 ms; in that
time the rod turns by 3 degrees at most, and a rigid impact takes none."""

COUPLING = Coupling(1e-9, 0.0, 0.0, 0.0)
"""The rod falls alone: a coupling must have a stiffness, and 1e-9 N/m over 10 mm is nothing."""

PANEL = Panel(
    "impact",
    "a rod that taps the floor at four angles",
    "impulse of a rigid impact without rebound by Routh's path (mechanics.resolve_impact, e = 0, "
    "where the laws of Newton, Poisson and Stronge agree)",
)

_ROD = f"""
<mujoco model="rod_impact">
  <option gravity="0 0 0" cone="elliptic"><flag diagexact="enable"/></option>
  <default>
    <geom solref="0.002 1" solimp="0.9 0.95 0.001 0.5 2" friction="{FRICTION!r} 0 0" condim="3"/>
  </default>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 1"/>
    <body name="rod" pos="0 0 1">
      <joint type="slide" axis="1 0 0"/>
      <joint type="slide" axis="0 0 1"/>
      <joint type="hinge" axis="0 1 0"/>
      <inertial pos="0 0 0" mass="{MASS!r}" diaginertia="{THIN!r} {INERTIA!r} {INERTIA!r}"/>
      <geom name="tip" type="sphere" size="{TIP!r}" pos="{-LENGTH / 2!r} 0 0" mass="0"/>
      <site name="grip"/>
    </body>
  </worldbody>
</mujoco>"""


def rod_scene() -> Scene:
    """Returns rod and floor as a scene, the rod far above."""
    return scene_of(_ROD)


def falls_at(angle: float) -> Callable[[Scene], None]:
    """Returns what puts the rod just above the floor, falling and sliding."""

    def put(scene: Scene) -> None:
        data = scene.data
        data.qpos[:3] = 0.0, LENGTH / 2 * np.sin(angle) + TIP + HEIGHT - 1.0, -angle
        data.qvel[:3] = SLIDE, -APPROACH, 0.0
        mujoco.mj_forward(scene.model, data)

    return put


def free_fall(angle: float) -> Task:
    """Returns the same fall of a rod that is free in space, for other engines.

    The floor's surface is at z = 0. The tip's sphere is all that can touch, and it touches in the
    plane of motion, so that no impulse turns the rod out of it.
    """
    tip = Shape("sphere", (TIP,), (-LENGTH / 2, 0.0, 0.0))
    rod = Body(MASS, (THIN, INERTIA, INERTIA), shapes=(tip,), friction=FRICTION)
    height = LENGTH / 2 * math.sin(angle) + TIP + HEIGHT
    return Task(
        "rod_impact",
        rod,
        (Shape("box", (1.0, 1.0, 0.1), (0.0, 0.0, -0.1)),),
        start=Pose((0.0, 0.0, height), quaternion_exp((0.0, -angle, 0.0))),
        start_velocity=Velocity((SLIDE, 0.0, -APPROACH)),
    )


def _in_the_plane(take: Take) -> Take:
    """Returns a take with the velocities of the plane alone: along x, along z, about y."""
    return replace(take, velocity=take.velocity[[0, 2, 4]])


def rigid_impacts() -> Impact:
    """Returns the four impacts of a rigid rod that does not rebound, by mechanics."""
    angle = np.array(ANGLES)
    arm = np.stack([-LENGTH / 2 * np.cos(angle), -LENGTH / 2 * np.sin(angle) - TIP], axis=-1)
    rod = ImpactBody(np.full(angle.size, MASS), np.full(angle.size, INERTIA), arm)
    return resolve_impact(rod, [SLIDE, -APPROACH], FRICTION, 0.0)


class RodImpact(Staged):
    """The workload.

    Args:
        coupling: Ignored but for its name in tables: none acts.
        grid: Longest period T in s; the falls last a multiple of it.
    """

    name = "rod_impact"
    about = "a rod taps the floor at four angles, with friction"
    panels: Sequence[Panel] = (PANEL,)
    needs_tool = "lets no tool fall by itself"
    has_contact = True

    def __init__(self, coupling: Coupling, grid: float) -> None:
        self._rigid = rigid_impacts()
        self._duration = duration = grid * max(1, round(DURATION / grid))
        starts = [falls_at(angle) for angle in ANGLES]
        super().__init__(
            coupling, Stages(lambda: Stage(rod_scene(), still, duration, coupling, starts=starts))
        )

    def peer_work(self) -> PeerWork:
        """Describes the falls to other engines: of a free rod, which stays in its plane."""
        return PeerWork(
            tuple(free_fall(angle) for angle in ANGLES),
            self._duration,
            lambda takes: self._judge([_in_the_plane(take) for take in takes]),
        )

    def _judge(self, takes: Sequence[Take]) -> Mapping[str, Score]:
        created = max(take.created for take in takes)
        if ended := next((take.ended for take in takes if take.has_diverged), ""):
            return {PANEL.key: diverged(created, ended)}
        velocities = np.array([take.velocity[:3] for take in takes])
        impulses = MASS * (velocities[:, :2] - (SLIDE, -APPROACH))
        error = np.linalg.norm(impulses - self._rigid.impulse, axis=1)
        exact = np.linalg.norm(self._rigid.impulse, axis=1)
        kinetic = 0.5 * (
            MASS * np.sum(velocities[:, :2] ** 2, axis=1) + INERTIA * velocities[:, 2] ** 2
        )
        before = 0.5 * MASS * (SLIDE**2 + APPROACH**2)
        has_touched = all(np.any(take.records["contacts"] > 0) for take in takes)
        return {
            PANEL.key: Score(
                felt=float(np.sqrt(np.mean((error / (WEBER * exact)) ** 2))),
                energy=float(np.max(np.abs(kinetic - before - self._rigid.energy_change))),
                created=created,
                verdict=_worst(takes) if has_touched else "lost contact",
            )
        }


def _worst(takes: Sequence[Take]) -> Verdict:
    order: tuple[Verdict, ...] = ("not metered", "strict", "within slack", "active")
    return max((take.environment for take in takes), key=order.index)
