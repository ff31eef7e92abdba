"""An engine in Python that stands in for those that are not installed, with faults to plant."""

from __future__ import annotations

from collections.abc import Mapping

from hapticbridge.lab.engines.base import (
    Contacts,
    Pose,
    Setting,
    Task,
    Velocity,
)
from hapticbridge.lab.engines.from_scene import HeldSimulation
from hapticbridge.pose import Vector, add, canonical, product, quaternion_exp, scaled


class StandIn:
    """Semi-implicit Euler of a free tool with equal moments; it knows no contacts.

    Args:
        mass: Factor that its mass is wrong by.
        fails_at: Step in which it raises, 0 when it is opened; never, if None.
        fails_below: Only at timesteps below this, in s.
        error: What it raises.
    """

    name = "stand_in"
    version = "1.0"
    settings: Mapping[str, Setting] = {"coupling": Setting("held force", "its own head")}

    def __init__(
        self,
        mass: float = 1.0,
        *,
        fails_at: int | None = None,
        fails_below: float = float("inf"),
        error: type[Exception] = RuntimeError,
    ) -> None:
        self._mass, self._fails_at = mass, fails_at
        self._fails_below, self._error = fails_below, error

    def open(self, task: Task, timestep: float) -> StandInSimulation:
        """Sets a task up."""
        is_bad = timestep < self._fails_below
        simulation = StandInSimulation(task, timestep, self._mass)
        if is_bad and self._fails_at is not None:
            simulation.fails = self._fails_at, self._error("no\nconvergence")
            if self._fails_at == 0:
                raise simulation.fails[1]
        return simulation


class StandInSimulation(HeldSimulation):
    """A task in the stand-in."""

    fails: tuple[int, Exception] | None = None

    def __init__(self, task: Task, timestep: float, factor: float) -> None:
        super().__init__(task, timestep)
        self._mass, self._moment = factor * task.body.mass, task.body.inertia[0]
        self._pull = scaled(self._mass, task.gravity)
        self._pose = self._principal(task.start)
        self._moving, self._turning = task.start_velocity
        self._steps = 0
        self._begin(task)

    def advance(self, force: Vector, torque: Vector) -> None:
        """Steps."""
        self._steps += 1
        if self.fails is not None and self._steps == self.fails[0]:
            raise self.fails[1]
        step = self._timestep
        self._moving = add(self._moving, scaled(step / self._mass, add(force, self._pull)))
        self._turning = add(self._turning, scaled(step / self._moment, torque))
        turned = product(quaternion_exp(scaled(step, self._turning)), self._pose.quaternion)
        position = add(self._pose.position, scaled(step, self._moving))
        self._pose = Pose(position, canonical(turned))

    def principal_pose(self) -> Pose:
        """Returns the pose of the principal axes."""
        return self._pose

    def velocity(self) -> Velocity:
        """Returns the velocities."""
        return Velocity(self._moving, self._turning)

    def contacts(self) -> Contacts:
        """Returns none."""
        return Contacts(0, 0.0)

    def close(self) -> None:
        """Nothing is held."""
