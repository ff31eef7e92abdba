"""The same work in another engine: the same motion, the same judge, its own contacts and solver."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.device import Motion
from hapticbridge.errors import HapticBridgeError, StudyError
from hapticbridge.rendering import METHODS
from hapticbridge.scene import Scene
from hapticbridge.study.chart.scene_run import Judge, Path, Take
from hapticbridge.study.chart.score import Score
from hapticbridge.study.chart.setting import Setting
from hapticbridge.study.engines.base import Engine, Simulation
from hapticbridge.study.engines.from_scene import task_from_scene
from hapticbridge.study.engines.task import Pose, Task, composed
from hapticbridge.tick import TICK_DTYPE

HELD = METHODS["explicit"]
"""How every engine gets the coupling: a force that is computed after a step and held in the next.
Only MuJoCo can solve it together with the contacts."""

FARTHEST = 10.0
"""Distance in m of the tool at which a run has diverged beyond doubt."""


@dataclass(frozen=True, slots=True)
class PeerWork:
    """A workload as other engines are given it.

    Attributes:
        task: What is simulated.
        duration: In s.
        judge: What a take says, the same as for the bridge's own runs.
    """

    task: Task
    duration: float
    judge: Judge


def work_of(
    scene: Scene, path: Path, duration: float, finest: float, coupling: Coupling, judge: Judge
) -> PeerWork:
    """Describes a scene that is led along a path to other engines.

    Args:
        scene: One free tool among fixed shapes.
        path: Of the handle.
        duration: In s.
        finest: Shortest period in s: the handle is exact at its multiples.
        coupling: K and B.
        judge: Of the workload.

    Raises:
        StudyError: The scene cannot be given to other engines.
    """
    times = finest * np.arange(0.0, round(duration / finest) + 1)
    motion = Motion(times, *path(times))
    return PeerWork(task_from_scene(scene, motion, coupling), duration, judge)


class EngineRun:
    """A workload in an engine at one time step, as a chart times and judges it.

    What is timed is every step of the run through the engine's Python interface, with the
    coupling's law: a user pays that too. Compare engines with the engine ``mujoco``, which is
    called the same way, and not with the compiled loop of the bridge.
    """

    def __init__(self, engine: Engine, work: PeerWork, setting: Setting) -> None:
        if setting.substeps != 1:
            raise StudyError("other engines are not divided into substeps; give a smaller step")
        self._engine, self._work, self._setting = engine, work, setting
        self._ticks = round(work.duration / setting.period)
        self._poses = work.task.handle_poses(setting.period, self._ticks)[1:]
        self.seconds = work.duration

    @property
    def chosen(self) -> Mapping[str, str | int]:
        """What the engine was set to, and which page of its documentation advises it."""
        told = "; ".join(
            f"{name}: {setting.value} ({setting.source})"
            for name, setting in self._engine.settings.items()
        )
        return {
            "solref": "",
            "solimp": "",
            "cone": "",
            "solver_iterations": "",
            "engine_settings": f"{self._engine.name} {self._engine.version}; {told}",
        }

    def go(self) -> float:
        """Runs it; returns the processor time in s of the steps."""
        simulation = self._engine.open(self._work.task, self._setting.period)
        try:
            begin = time.thread_time()
            for pose in self._poses[: self._ticks]:
                simulation.step(pose.position, pose.quaternion)
            return time.thread_time() - begin
        finally:
            simulation.close()

    def scores(self) -> Mapping[str, Score]:
        """Runs it once more with every tick written down, and judges it.

        Raises:
            HapticBridgeError: The engine refuses the task, or fails.
        """
        try:
            simulation = self._engine.open(self._work.task, self._setting.period)
            try:
                take = self._take(simulation)
            finally:
                simulation.close()
        except HapticBridgeError:
            raise
        except Exception as error:
            # a foreign library raises what it likes; one engine's failure must not end the chart
            raise StudyError(
                f"engine '{self._engine.name}' failed at {1e3 * self._setting.period:g} ms: "
                f"{type(error).__name__}: {error}"
            ) from error
        # a run that diverged is timed as far as it came
        self._ticks = max(1, take.records.size)
        self.seconds = self._ticks * self._setting.period
        return self._work.judge([take])

    def _take(self, simulation: Simulation) -> Take:
        rows = np.zeros(len(self._poses), TICK_DTYPE)
        done = 0
        for pose in self._poses:
            simulation.step(pose.position, pose.quaternion)
            if not _write(rows[done : done + 1], simulation, self._work.task.grip):
                break
            done += 1
        velocity = simulation.velocity()
        return Take(
            setting=self._setting,
            records=rows[:done],
            has_diverged=done < rows.size,
            environment="not metered",
            created=float("nan"),
            velocity=np.array([*velocity.linear, *velocity.angular]),
        )


def _write(row: NDArray[np.void], simulation: Simulation, grip: Pose) -> bool:
    """Writes one record; returns whether its numbers are still of this world."""
    pose = composed(simulation.pose(), grip)
    wrench = simulation.wrench()
    row["tool_position"] = pose.position
    row["tool_quaternion"] = pose.quaternion
    row["wrench_on_tool"] = (*wrench.force, *wrench.torque)
    values = np.concatenate([row["tool_position"][0], row["wrench_on_tool"][0]])
    if not (np.isfinite(values).all() and np.abs(row["tool_position"]).max() < FARTHEST):
        return False  # an engine asked for contacts of such a pose may raise
    row["contacts"] = simulation.contacts().points
    return True


def peer_settings(engines: Sequence[str], periods: Sequence[float]) -> list[Setting]:
    """Returns the points of other engines: every one at every period."""
    return [Setting(HELD, period, engine=name) for name in engines for period in periods]
