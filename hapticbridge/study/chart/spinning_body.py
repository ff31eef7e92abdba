"""Workload ``spinning_body``: a free body that tumbles, held in its place and free to turn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.check.perception import FORCE_FLOOR, LEVER, tool_angles
from hapticbridge.coupling import Coupling
from hapticbridge.errors import StudyError
from hapticbridge.record import TICK_DTYPE
from hapticbridge.scene import Scene
from hapticbridge.study.chart.engine_run import PeerWork, work_of
from hapticbridge.study.chart.scene_run import Stage, Stages, Take
from hapticbridge.study.chart.score import Score, diverged, score_of
from hapticbridge.study.chart.staged import Staged
from hapticbridge.study.chart.workload import Panel
from hapticbridge.study.engines.task import Velocity
from hapticbridge.study.maps.rigs import free_body, scene_of
from hapticbridge.theory.rigid_body import integrate_rotation

MASS = 0.3
"""In kg."""
INERTIA = (1.5e-3, 3.63e-3, 4.53e-3)
"""Principal moments in kg m², all different: near those of a hand tool with a long handle."""

SPIN = (3.0, 20.0, 3.0)
"""Angular velocity at the start in rad/s, near the middle axis, about which the body tumbles."""

DURATION = 1.0
"""In s: three turns and a flip."""

COUPLING = Coupling(1000.0, 1.0, 0.0, 0.0)
"""Holds the place, in N/m and N s/m, and lets the body turn."""

FELT_STIFFNESS = 1.0
"""K_r in N m/rad, that of the other workloads: what an error of angle would be felt through."""

FINE_STEP = 2e-6
"""T in s of the reference. The midpoint rule errs by some (ωT)²/12 of the angle: some 1e-9 rad."""

PANEL = Panel(
    "torque-free",
    "a body that tumbles without torque",
    f"mechanics' midpoint rule at {1e6 * FINE_STEP:g} µs, checked against SciPy's DOP853; the "
    f"angle counts as the torque that {FELT_STIFFNESS:g} N m/rad would make of it",
)


def spinning_scene() -> Scene:
    """Returns the body as a scene, at rest."""
    return scene_of(free_body(MASS, INERTIA))


def set_spinning(scene: Scene) -> None:
    """Gives the body its angular velocity; its axes are the world's at the start."""
    scene.data.qvel[3:6] = SPIN
    mujoco.mj_forward(scene.model, scene.data)


def still(times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns a handle that stands still."""
    quaternions = np.zeros((times.size, 4))
    quaternions[:, 0] = 1.0
    return np.zeros((times.size, 3)), quaternions


def exact_orientations(grid: float, count: int) -> NDArray[np.float64]:
    """Returns orientations at grid, 2 grid, … in s by the midpoint rule, shape (count, 4), w >= 0.

    Raises:
        StudyError: ``grid`` is no multiple of ``FINE_STEP``.
    """
    every = round(grid / FINE_STEP)
    if abs(every * FINE_STEP / grid - 1) > 1e-9:
        raise StudyError(f"{grid:g} s is no multiple of the reference's {FINE_STEP:g} s")
    motion = integrate_rotation(INERTIA, SPIN, FINE_STEP, every * count, "midpoint")
    found = motion.orientation[every::every]
    return np.where(found[:, :1] < 0, -found, found)


class SpinningBody(Staged):
    """The workload.

    Args:
        coupling: K and B; without K_r and B_r, or there would be a torque.
        grid: Longest period T in s.
        finest: Shortest in s.

    Raises:
        StudyError: The coupling would turn the body.
    """

    name = "spinning_body"
    about = "a body with three moments of inertia tumbles freely, held in its place by the coupling"
    panels: Sequence[Panel] = (PANEL,)
    needs_tool = "lets no tool turn by itself"
    has_contact = False

    def __init__(self, coupling: Coupling, grid: float, finest: float) -> None:
        if coupling.rotational_stiffness or coupling.rotational_damping:
            raise StudyError("the spinning body must be free to turn: K_r and B_r must be 0")
        self._grid = grid
        self._finest = finest
        count = round(DURATION / grid)
        self._reference = np.zeros(count, TICK_DTYPE)
        self._reference["tool_quaternion"] = exact_orientations(grid, count)
        self._energy = 0.5 * float(np.sum(np.array(INERTIA) * np.square(SPIN)))
        super().__init__(
            coupling,
            Stages(
                lambda: Stage(
                    spinning_scene(), still, grid * count, coupling, starts=(set_spinning,)
                )
            ),
        )

    def peer_work(self) -> PeerWork:
        """Describes the body to other engines, with its spin."""
        duration = self._grid * self._reference.size
        work = work_of(spinning_scene(), still, duration, self._finest, self.coupling, self._judge)
        spin = Velocity(angular=SPIN)
        return replace(work, tasks=(replace(work.tasks[0], start_velocity=spin),))

    def _judge(self, takes: Sequence[Take]) -> Mapping[str, Score]:
        (take,) = takes
        if take.has_diverged:
            return {PANEL.key: diverged(take.created, take.ended)}
        records = take.at(self._grid)
        score = score_of(
            self._reference,
            records,
            created=take.created,
            verdict=take.environment,
            energy=float(np.max(np.abs(records["kinetic"] - self._energy))),
        )
        torque = FELT_STIFFNESS * tool_angles(self._reference, records)
        turned = float(np.sqrt(np.mean(torque**2))) / (LEVER * FORCE_FLOOR)
        return {PANEL.key: replace(score, felt=max(score.felt, turned))}
