"""A workload in another engine: equal motion and judge, its own contacts and solver."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.device import Motion
from hapticbridge.errors import HapticBridgeError, StudyError
from hapticbridge.kernel.ledger import ENERGY_TOLERANCE
from hapticbridge.kernel.pose import conjugate, dot, rotated, rotation_between, subtract
from hapticbridge.kernel.record import TICK_DTYPE
from hapticbridge.lab.chart.scene_run import Path
from hapticbridge.lab.chart.score import Judge, PeerWork, Reading, Score, Take, Verdict
from hapticbridge.lab.chart.setting import Setting
from hapticbridge.lab.engines.base import (
    Engine,
    Pose,
    Simulation,
    Task,
    Velocity,
    Wrench,
    composed,
)
from hapticbridge.lab.engines.from_scene import task_from_scene
from hapticbridge.lab.methods import METHODS
from hapticbridge.scene import Scene

HELD = METHODS["explicit"]
"""Couplings of the engines. By default a force is computed after a step and held in the next.
Engines whose name ends with ``SPRING`` solve it together with the contacts, as their own spring."""

FARTHEST = 10.0
"""Distance in m of the tool beyond which a run counts as diverged."""

_LEFT = ("tool_position", "tool_quaternion", "wrench_on_tool")


def work_of(
    scene: Scene, path: Path, duration: float, finest: float, coupling: Coupling, judge: Judge
) -> PeerWork:
    """Describes a scene that is led along a path to other engines.

    Args:
        scene: A free tool among other free bodies and fixed shapes.
        path: Path of the handle.
        duration: Duration in s.
        finest: Shortest period in s; the handle is exact at its multiples.
        coupling: K and B.
        judge: Judge of the workload.

    Raises:
        StudyError: Other engines cannot represent the scene.
    """
    motion = motion_along(path, duration, finest)
    return PeerWork((task_from_scene(scene, motion, coupling),), duration, judge)


def motion_along(path: Path, duration: float, finest: float) -> Motion:
    """Returns a path as a motion that is exact at the multiples of ``finest`` s."""
    times = finest * np.arange(0.0, round(duration / finest) + 1)
    return Motion(times, *path(times))


class EngineRun:
    """A workload in an engine at one time step, as a chart times and judges it.

    The time covers every step of the run through the engine's Python interface, with the coupling's
    law, because a user pays for both. Compare engines with the engine ``mujoco``, which is called
    the same way, and not with the compiled loop of the bridge.

    Raises:
        StudyError: The setting has substeps.
    """

    def __init__(self, engine: Engine, work: PeerWork, setting: Setting) -> None:
        if setting.substeps != 1:
            raise StudyError("other engines are not divided into substeps; give a smaller step")
        self.engine, self._work, self._setting = engine, work, setting
        ticks = round(work.duration / setting.period)
        self._poses = [task.handle_poses(setting.period, ticks)[1:] for task in work.tasks]
        self._ticks = [ticks] * len(work.tasks)

    @property
    def seconds(self) -> float:
        """Simulated time in s of the timed steps; less for a run that ended early."""
        return max(1, sum(self._ticks)) * self._setting.period

    @property
    def chosen(self) -> Mapping[str, str | int]:
        """Settings of the engine, with the page of its documentation that advises each.

        Method and integrator of the bridge do not apply to other engines.
        """
        text = "; ".join(
            f"{name}: {setting.value} ({setting.source})"
            for name, setting in self.engine.settings.items()
        )
        coupling = self.engine.settings.get("coupling")
        return {
            "method": "held force" if coupling is None else coupling.value,
            "integrator": "",
            "solref": "",
            "solimp": "",
            "cone": "",
            "solver_iterations": "",
            "engine_settings": f"{self.engine.name} {self.engine.version}; {text}",
        }

    def run(self) -> float:
        """Runs it; returns the processor time in s of the steps, nan if none was completed."""
        if not any(self._ticks):
            return float("nan")
        spent = 0.0
        for task, poses, ticks in zip(self._work.tasks, self._poses, self._ticks, strict=True):
            if not ticks:
                break
            try:
                simulation = self.engine.open(task, self._setting.period)
                try:
                    begin = time.thread_time()
                    for pose in poses[:ticks]:
                        simulation.step(pose.position, pose.quaternion)
                    spent += time.thread_time() - begin
                finally:
                    simulation.close()
            except Exception:
                return float("nan")  # a failed round does not count; the others do
        return spent

    def scores(self) -> Mapping[str, Score]:
        """Runs it once more with a record of every tick, and judges it.

        An exception of the engine gives the verdict ``failed``; the score names the exception.

        Raises:
            HapticBridgeError: The engine refuses the task.
        """
        takes, has_failed = self.takes()
        found = self._work.judge(takes)
        if not has_failed:
            return found
        return {key: replace(score, verdict="failed") for key, score in found.items()}

    def takes(self) -> tuple[list[Take], bool]:
        """Runs it with a record and a meter; returns the takes, and True if the engine failed.

        Raises:
            HapticBridgeError: The engine refuses the task.
        """
        takes: list[Take] = []
        has_failed = False
        self._ticks = [0] * len(self._ticks)
        for index, (task, poses) in enumerate(zip(self._work.tasks, self._poses, strict=True)):
            take, has_failed = self._take(task, poses)
            takes.append(take)
            self._ticks[index] = take.records.size
            if take.ended:
                break
        return takes, has_failed

    def _take(self, task: Task, poses: Sequence[Pose]) -> tuple[Take, bool]:
        """Follows a motion; returns the take, and True if the engine raised an error."""
        rows = np.zeros(len(poses), TICK_DTYPE)
        done, ended, has_failed, velocity = 0, "", False, Velocity()
        meters: tuple[Meter, ...] = ()
        try:
            simulation = self.engine.open(task, self._setting.period)
            try:
                meters = tuple(
                    Meter(simulation, task, self._setting.period, each)
                    for each in (simulation.wrench, simulation.applied)
                )
                for pose in poses:
                    simulation.step(pose.position, pose.quaternion)
                    ended = _written(rows[done : done + 1], simulation, task.grip)
                    if ended:
                        break
                    for meter in meters:
                        meter.close_step()
                    rows[done]["environment_energy"] = meters[0].energy
                    done += 1
                velocity = simulation.velocity()
            finally:
                simulation.close()
        except Exception as error:
            # a foreign library may raise anything; one engine's failure must not end the chart
            if isinstance(error, HapticBridgeError) and not done:
                raise
            has_failed = True
            ended = f"raised {type(error).__name__}: {' '.join(str(error).split())}"
        if ended:
            ended += f" after {self._setting.period * done:.4g} s"
        readings = [meter.reading for meter in meters] or [Reading()] * 2
        take = Take(
            setting=self._setting,
            records=rows[:done],
            ended=ended,
            meter=readings[0],
            engine=readings[1],
            velocity=np.array([*velocity.linear, *velocity.angular]),
        )
        return take, has_failed


class Meter:
    """Meter of the energy that an engine creates, from the motion that it reports.

        Σ E_k = S_k − S_0 − Σ (f·δx + τ·δφ),    S = ½ m ‖v‖² + ½ ω·I ω − m g·x

    f and τ are a wrench on the tool in N and N m, δx and δφ the grip's motion in a step in m and
    rad, v and ω a body's velocities, x its centre of mass and g the gravity. S is summed over the
    tool and all other free bodies. This is the balance of ``kernel.ledger``, for free bodies among
    fixed shapes, with its tolerance and the slack of the bridge's own coupling, Σ ½ (K + B/T) ‖δx‖²
    and its rotational counterpart. Energy that contacts store counts as dissipated until they
    return it.

    Args:
        simulation: Simulation at its start.
        task: Its task.
        period: Step T in s.
        wrench: Returns the wrench: that of the coupling's law at the end of a step, as the ledger
            counts it, or that which the engine applied during the step.

    Attributes:
        energy: Σ E_k in J.
    """

    def __init__(
        self, simulation: Simulation, task: Task, period: float, wrench: Callable[[], Wrench]
    ) -> None:
        self._simulation, self._task, self._wrench = simulation, task, wrench
        self._bodies = [free.body for free in task.bodies]
        k = task.coupling or Coupling(1e-30, 0.0, 0.0, 0.0)
        self._gains = (
            0.5 * (k.stiffness + k.damping / period),
            0.5 * (k.rotational_stiffness + k.rotational_damping / period),
        )
        self._grip = composed(simulation.pose(), task.grip)
        self._start = self._stored()
        self._work = self._throughput = self._slack = 0.0
        self.energy = self._created = self._share = 0.0

    @property
    def reading(self) -> Reading:
        """Reading so far; not metered where the wrench was nan."""
        if np.isnan(self.energy):
            return Reading()
        verdict: Verdict = "active" if self._share > 1.0 else "within slack"
        return Reading(verdict if self._share > 0.0 else "strict", self._created, self._share)

    def _stored(self) -> float:
        stored = 0.0
        for number, body in enumerate(self._bodies):
            velocity = self._simulation.velocity(number)
            centre = composed(self._simulation.pose(number), body.inertia_frame)
            spin = rotated(conjugate(centre.quaternion), velocity.angular)
            kinetic = body.mass * dot(velocity.linear, velocity.linear)
            kinetic += sum(i * w * w for i, w in zip(body.inertia, spin, strict=True))
            stored += 0.5 * kinetic - body.mass * dot(self._task.gravity, centre.position)
        return stored

    def close_step(self) -> None:
        """Closes the balance of the step that just ended."""
        wrench, before = self._wrench(), self._grip
        self._grip = grip = composed(self._simulation.pose(), self._task.grip)
        moved = subtract(grip.position, before.position)
        turned = rotation_between(before.quaternion, grip.quaternion)
        work = dot(wrench.force, moved) + dot(wrench.torque, turned)
        self._work += work
        self._throughput += abs(work)
        self._slack += self._gains[0] * dot(moved, moved) + self._gains[1] * dot(turned, turned)
        self.energy = self._stored() - self._start - self._work
        allowed = ENERGY_TOLERANCE * (1.0 + self._throughput)
        if self.energy > allowed:
            self._created = max(self._created, self.energy)
            self._share = max(self._share, self.energy / (self._slack + allowed))


def _written(row: NDArray[np.void], simulation: Simulation, grip: Pose) -> str:
    """Writes one record; returns a description of impossible values in it, empty without any."""
    pose = composed(simulation.pose(), grip)
    wrench = simulation.wrench()
    row["tool_position"] = pose.position
    row["tool_quaternion"] = pose.quaternion
    row["wrench_on_tool"] = (*wrench.force, *wrench.torque)
    # before the contacts: an engine may raise at such a pose
    if not all(np.isfinite(row[name]).all() for name in _LEFT):
        return "a number was not finite"
    if np.abs(row["tool_position"]).max() >= FARTHEST:
        return f"the tool was {FARTHEST:g} m away"
    row["contacts"] = simulation.contacts().points
    return ""


def peer_settings(engines: Sequence[str], periods: Sequence[float]) -> list[Setting]:
    """Returns the points of other engines: every one at every period."""
    return [Setting(HELD, period, engine=name) for name in engines for period in periods]
