"""What a physics engine is to the study: it opens a task, and the simulation can be stepped."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple, Protocol

from hapticbridge.pose import Quaternion, Vector
from hapticbridge.study.engines.task import Pose, Task, Velocity


class Wrench(NamedTuple):
    """Force in N and torque in N m about the grip, in the world frame."""

    force: Vector
    torque: Vector


class Contacts(NamedTuple):
    """The contacts of one step as the engine tells of them.

    Attributes:
        points: Points (or, where an engine has contact patches, patches) that touch.
        depth: Deepest penetration in m, >= 0; 0 without contact.
    """

    points: int
    depth: float

    @classmethod
    def of(cls, depths: Iterable[float]) -> Contacts:
        """Returns what points of these depths in m, negative where they are apart, come to."""
        touching = [depth for depth in depths if depth >= 0]
        return cls(len(touching), max(touching, default=0.0))


class Setting(NamedTuple):
    """One setting of an engine: what it is set to, and the page of its documentation for it."""

    value: str
    source: str


class Simulation(Protocol):
    """A task in an engine, at some step. Step 0 is the start."""

    def step(self, handle_position: Vector, handle_quaternion: Quaternion) -> None:
        """Goes from step k − 1 to step k, at whose end the handle is at h_k.

        A held coupling acts on the tool during the step with f_{k−1}; f_k is computed at its end.
        """

    def advance(self, force: Vector, torque: Vector) -> None:
        """Sets a force in N and a torque in N m at the centre of mass and steps: what is timed."""

    def pose(self) -> Pose:
        """Returns the pose of the body's frame."""

    def velocity(self) -> Velocity:
        """Returns the velocity of the centre of mass and the angular velocity."""

    def wrench(self) -> Wrench:
        """Returns the coupling's wrench f_k on the tool, about the grip."""

    def contacts(self) -> Contacts:
        """Returns the contacts of the last step."""

    def close(self) -> None:
        """Gives back what the engine holds. Closing twice is allowed."""


class Engine(Protocol):
    """A physics engine, tuned as its own documentation advises."""

    @property
    def name(self) -> str:
        """What ``--engines`` calls it."""

    @property
    def version(self) -> str:
        """Version of the installed library."""

    @property
    def settings(self) -> Mapping[str, Setting]:
        """Every setting that was made, and where its documentation advises it."""

    def open(self, task: Task, timestep: float) -> Simulation:
        """Sets a task up, with steps of ``timestep`` in s.

        Raises:
            StudyError: The engine cannot describe the task, or the timestep is out of range.
        """
