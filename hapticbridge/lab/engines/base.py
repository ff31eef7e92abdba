"""Interface of a physics engine: it opens a task, and the simulation is stepped."""

from __future__ import annotations

import ctypes
import os
import sys
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from typing import BinaryIO, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.device.trajectory import Motion, pose_at
from hapticbridge.errors import StudyError, choices
from hapticbridge.files import install_command
from hapticbridge.kernel.jit import compiled
from hapticbridge.kernel.pose import (
    ZERO_VECTOR,
    Quaternion,
    Vector,
    add,
    canonical,
    conjugate,
    cross,
    product,
    rotated,
    rotation_between,
    scaled,
    subtract,
)

_STDOUT = 1
"""File descriptor that C code prints to, whatever Python's ``sys.stdout`` is."""


@contextmanager
def caught_prints(notify: Callable[[str], None]) -> Iterator[None]:
    """Captures all that is printed on stdout inside, from C too, and reports it afterwards.

    PyBullet prints two lines whenever a world is opened, which would break JSON on stdout. Each
    line is reported once, however often it was printed.

    Args:
        notify: Called with each different line, in the order of first appearance.
    """
    try:
        kept = os.dup(_STDOUT)
    except OSError:  # a process without stdout has none to keep clean
        yield
        return
    with tempfile.TemporaryFile() as file:
        try:
            _flush()
            os.dup2(file.fileno(), _STDOUT)
            try:
                yield
            finally:
                # C keeps lines in memory where stdout is no terminal; they belong to this file
                _flush()
                os.dup2(kept, _STDOUT)
        finally:
            os.close(kept)
            for line in _lines(file):
                notify(line)


def _flush() -> None:
    if sys.stdout is not None:
        sys.stdout.flush()
    ctypes.CDLL(None).fflush(None)


def _lines(file: BinaryIO) -> list[str]:
    file.seek(0)
    lines = file.read().decode("utf-8", "replace").splitlines()
    return list(dict.fromkeys(line.strip() for line in lines if line.strip()))


Kind = Literal["box", "sphere", "capsule", "mesh"]
SIZES = {"box": 3, "sphere": 1, "capsule": 2, "mesh": 0}
"""Count of numbers in a shape's size, by kind."""


class Pose(NamedTuple):
    """A position in m and an orientation, a unit quaternion (w, x, y, z)."""

    position: Vector = (0.0, 0.0, 0.0)
    quaternion: Quaternion = (1.0, 0.0, 0.0, 0.0)


class Velocity(NamedTuple):
    """Velocity of a centre of mass in m/s and angular velocity in rad/s, world frame."""

    linear: Vector = (0.0, 0.0, 0.0)
    angular: Vector = (0.0, 0.0, 0.0)


ORIGIN = Pose()
AT_REST = Velocity()


def composed(outer: Pose, inner: Pose) -> Pose:
    """Returns in the world frame the pose ``inner``, which is given in the frame ``outer``."""
    position = add(outer.position, rotated(outer.quaternion, inner.position))
    return Pose(position, canonical(product(outer.quaternion, inner.quaternion)))


def inverted(pose: Pose) -> Pose:
    """Returns the pose of the world in the frame ``pose``."""
    back = conjugate(pose.quaternion)
    return Pose(rotated(back, scaled(-1.0, pose.position)), canonical(back))


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """A convex shape, in the frame of its body (of the world, where it is fixed).

    Attributes:
        kind: ``box``, ``sphere``, ``capsule`` or ``mesh``.
        size: Half edges of a box; radius of a sphere; radius and half length of a capsule's
            cylinder, which lies along its z axis; all in m. Empty for a mesh.
        position: Position of its centre, in m.
        quaternion: Orientation of its axes.
        vertices: Vertices of a mesh in its own frame, in m, shape (n, 3), n >= 4. The shape is
            their convex hull.
    """

    kind: Kind
    size: tuple[float, ...]
    position: Vector = (0.0, 0.0, 0.0)
    quaternion: Quaternion = (1.0, 0.0, 0.0, 0.0)
    vertices: NDArray[np.float64] | None = None

    @property
    def pose(self) -> Pose:
        """Position and orientation as a pose."""
        return Pose(self.position, self.quaternion)


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """A rigid body, free in space: the tool, or what it meets.

    Attributes:
        mass: Mass in kg, > 0.
        inertia: Principal moments in kg m², > 0, none larger than the sum of the other two.
        inertia_frame: Centre of mass and principal axes in the body's frame.
        shapes: Shapes in the body's frame; may be empty.
        friction: Coulomb's coefficient of every contact, without unit, >= 0.
    """

    mass: float
    inertia: Vector
    inertia_frame: Pose = ORIGIN
    shapes: tuple[Shape, ...] = ()
    friction: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class FreeBody:
    """A rigid body at its start.

    Attributes:
        body: Mass, inertia and shapes.
        start: Pose of the body's frame at the start.
    """

    body: Body
    start: Pose = ORIGIN

    @property
    def principal(self) -> Pose:
        """Pose of the principal axes of inertia at the centre of mass, at the start."""
        return composed(self.start, self.body.inertia_frame)

    @property
    def shapes(self) -> list[tuple[Shape, Pose]]:
        """Shapes with their poses in the frame of the principal axes."""
        frame = inverted(self.body.inertia_frame)
        return [(shape, composed(frame, shape.pose)) for shape in self.body.shapes]


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """A task for an engine: a free tool among other bodies and fixed shapes, moved by the coupling.

    Attributes:
        name: Name in tables and messages.
        body: The tool.
        fixed: The fixed shapes, in the world frame.
        gravity: Gravity in m/s².
        coupling: Coupling between handle and grip; None leaves the tool alone.
        grip: Pose of the grip in the body's frame.
        start: Pose of the body's frame at the start.
        start_velocity: Velocity of its centre of mass and angular velocity at the start.
        handle: Poses of the handle in the world frame over time. None keeps it at the grip's pose
            at the start.
        others: Other free bodies, at rest at the start, with the friction of the tool.
    """

    name: str
    body: Body
    fixed: tuple[Shape, ...] = ()
    gravity: Vector = (0.0, 0.0, 0.0)
    coupling: Coupling | None = None
    grip: Pose = ORIGIN
    start: Pose = ORIGIN
    start_velocity: Velocity = AT_REST
    handle: Motion | None = None
    others: tuple[FreeBody, ...] = ()

    @property
    def bodies(self) -> tuple[FreeBody, ...]:
        """Free bodies at their start, the tool first."""
        return FreeBody(self.body, self.start), *self.others

    def handle_poses(self, timestep: float, steps: int) -> list[Pose]:
        """Returns the handle's poses h_0 … h_N at the times 0, T, … N T.

        Args:
            timestep: T in s.
            steps: N.
        """
        if self.handle is None:
            return [composed(self.start, self.grip)] * (steps + 1)
        found, cursor = [], 0
        for k in range(steps + 1):
            cursor, position, quaternion = pose_at(self.handle.table, k * timestep, cursor)
            found.append(Pose(position, quaternion))
        return found


class Wrench(NamedTuple):
    """Force in N and torque in N m about the grip, in the world frame."""

    force: Vector
    torque: Vector


class Contacts(NamedTuple):
    """Contacts of one step as the engine reports them.

    Attributes:
        points: Number of touching points, or of patches in an engine with contact patches.
        depth: Deepest penetration in m, >= 0; 0 without contact.
    """

    points: int
    depth: float

    @classmethod
    def from_depths(cls, depths: Iterable[float]) -> Contacts:
        """Returns the contacts with these depths in m; a negative depth is a gap."""
        touching = [depth for depth in depths if depth >= 0]
        return cls(len(touching), max(touching, default=0.0))


class Advised(NamedTuple):
    """One setting of an engine: its value, and the page of its documentation that advises it."""

    value: str
    source: str


Frame = tuple[Vector, Quaternion]
"""Position in m and orientation, as the compiler stores them."""

_AT_ORIGIN = (ZERO_VECTOR, (1.0, 0.0, 0.0, 0.0))


class Simulation(ABC):
    """A task in an engine, at some step, with a coupling that the engine holds for a step.

    Step 0 is the start. Body 0 is the tool; the others follow in the task's order. The coupling is
    a force and a torque, applied to the engine every step:

        f_k = K e_k + (B/T)(e_k − e_{k−1}),    e = h − x
        τ_k = K_r φ_k + (B_r/T)(δφ_h − δφ_x),  φ = log(R_h R_xᵀ)

    with the handle h and the grip x at the end of step k; step k + 1 runs under (f_k, τ_k), moved
    to the centre of mass. This is ``theory.drive_mass``'s scheme ``held``. The handle has not moved
    before step 0.

    Engines describe a body by its centre of mass. A child's body is therefore the frame of the
    principal axes of inertia; ``FreeBody`` converts to it. A child opens its engine in
    ``__init__`` after that of this class, and calls ``_begin`` last.
    """

    def __init__(self, task: Task, timestep: float) -> None:
        self._timestep = timestep
        coupling = task.coupling
        self._gains = (
            None
            if coupling is None
            else (
                coupling.stiffness,
                coupling.damping / timestep,
                coupling.rotational_stiffness,
                coupling.rotational_damping / timestep,
            )
        )
        self._grip = (task.grip.position, task.grip.quaternion)
        self._frames = [free.body.inertia_frame for free in task.bodies]
        self._body_in_principal = [inverted(frame) for frame in self._frames]
        self._centre = task.body.inertia_frame.position
        self._handle: Frame = _AT_ORIGIN
        self._tool: Frame = _AT_ORIGIN
        self._wrench = self._at_centre = self._held = (ZERO_VECTOR, ZERO_VECTOR)

    def _begin(self, task: Task) -> None:
        """Computes the wrench of step 0."""
        handle = task.handle_poses(self._timestep, 1)[0]
        self._handle = (handle.position, handle.quaternion)
        grip = composed(self.pose(), task.grip)
        self._tool = (grip.position, grip.quaternion)
        self._measure(self._handle)

    def step(self, handle_position: Vector, handle_quaternion: Quaternion) -> None:
        """Advances to step k, at whose end the handle is at h_k, under f_{k−1}; computes f_k."""
        self._couple((handle_position, handle_quaternion))
        self._measure((handle_position, handle_quaternion))

    def _couple(self, _handle: Frame) -> None:
        """Advances the engine; a child whose engine has its own spring aims it at the handle."""
        self.advance(*self._at_centre)

    def wrench(self) -> Wrench:
        """Returns the coupling's wrench f_k on the tool, about the grip."""
        return Wrench(*self._wrench)

    def applied(self) -> Wrench:
        """Returns the coupling's wrench on the tool during the last step, about the grip.

        A held coupling applies f_{k−1}, a spring of the engine's own f_k. It is nan where the
        engine does not tell its spring's force.
        """
        return Wrench(*self._held)

    def _measure(self, handle: Frame) -> None:
        if self._gains is None:
            return
        self._held = self._wrench
        pose = self.pose()
        self._tool, self._wrench, self._at_centre = _law(
            self._gains,
            (pose.position, pose.quaternion),
            self._grip,
            self._centre,
            self._handle,
            handle,
            self._tool,
        )
        self._handle = handle

    @abstractmethod
    def advance(self, force: Vector, torque: Vector) -> None:
        """Sets a force in N and a torque in N m at the centre of mass and steps; this is timed."""

    @abstractmethod
    def principal_pose(self, body: int = 0) -> Pose:
        """Returns the pose of the principal axes of inertia at a body's centre of mass."""

    def pose(self, body: int = 0) -> Pose:
        """Returns the pose of a body's frame."""
        return composed(self.principal_pose(body), self._body_in_principal[body])

    @abstractmethod
    def velocity(self, body: int = 0) -> Velocity:
        """Returns the velocity of a body's centre of mass and its angular velocity."""

    @abstractmethod
    def contacts(self) -> Contacts:
        """Returns the contacts of the last step."""

    @abstractmethod
    def close(self) -> None:
        """Releases the resources of the engine. Closing twice is allowed."""


@compiled
def _law(
    gains: tuple[float, float, float, float],
    body: Frame,
    grip: Frame,
    centre: Vector,
    handle_before: Frame,
    handle: Frame,
    tool_before: Frame,
) -> tuple[Frame, tuple[Vector, Vector], tuple[Vector, Vector]]:
    """Returns the grip's pose, the wrench about it, and the same wrench at the centre of mass."""
    stiffness, damping, rotational_stiffness, rotational_damping = gains
    position = add(body[0], rotated(body[1], grip[0]))
    orientation = product(body[1], grip[1])
    stretched = subtract(subtract(handle[0], handle_before[0]), subtract(position, tool_before[0]))
    twisted = subtract(
        rotation_between(handle_before[1], handle[1]), rotation_between(tool_before[1], orientation)
    )
    force = add(scaled(stiffness, subtract(handle[0], position)), scaled(damping, stretched))
    torque = add(
        scaled(rotational_stiffness, rotation_between(orientation, handle[1])),
        scaled(rotational_damping, twisted),
    )
    lever = subtract(position, add(body[0], rotated(body[1], centre)))
    return (position, orientation), (force, torque), (force, add(torque, cross(lever, force)))


@dataclass(frozen=True, slots=True, eq=False)
class Engine:
    """A physics engine, tuned as its own documentation advises.

    Attributes:
        name: Name for ``--engines``.
        version: Version of the installed library.
        settings: Settings with the pages of the documentation that advise them.
        open: Opens a task with steps of a length in s; raises StudyError where the engine cannot
            describe the task.
    """

    name: str
    version: str
    settings: Mapping[str, Advised]
    open: Callable[[Task, float], Simulation]


_PACKAGE = "hapticbridge.lab.engines"

ENGINES = {
    "mujoco": "mujoco",
    "mujoco_warp": "mujoco_warp",
    "newton_xpbd": "newton",
    "newton_steel": "newton",
    "ode": "ode",
    "ode_spring": "ode",
    "physx": "physx",
    "physx_spring": "physx",
    "rapier": "rapier",
    "pybullet": "bullet",
    "pybullet_dantzig": "bullet",
    "drake_point": "drake",
    "drake_hydroelastic": "drake",
}
"""Module of each engine. It has ``engines()``; where its library is not installed, the import fails
or ``engines()`` raises StudyError."""


class Engines(NamedTuple):
    """Engines of this installation.

    Attributes:
        available: Engines by name.
        missing: By name, a sentence that names the missing library and the way to install it.
    """

    available: Mapping[str, Engine]
    missing: Mapping[str, str]


def available_engines() -> Engines:
    """Imports every engine and returns those that are available and missing."""
    available: dict[str, Engine] = {}
    missing: dict[str, str] = {}
    for name in ENGINES:
        try:
            available[name] = open_engine(name)
        except StudyError as error:
            missing[name] = str(error)
    return Engines(available, missing)


def open_engine(name: str) -> Engine:
    """Imports one engine.

    Raises:
        StudyError: The name is unknown, or its library is not installed; the message tells how to
            install it.
    """
    if name not in ENGINES:
        raise StudyError(f"no engine '{name}'; engines: {choices(ENGINES)}")
    try:
        module = import_module(f"{_PACKAGE}.{ENGINES[name]}")
    except ImportError as error:
        # a system library (such as libGL) may be missing although the package is installed
        raise StudyError(
            f"engine '{name}' is not installed ({error}): {install_command('peers')}"
        ) from None
    engines_of_module: tuple[Engine, ...] = module.engines()
    return next(engine for engine in engines_of_module if engine.name == name)
