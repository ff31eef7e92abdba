"""The coupling as every engine can have it: a wrench that is computed and held for one step."""

from __future__ import annotations

from abc import ABC, abstractmethod

from hapticbridge.jit import compiled
from hapticbridge.pose import (
    ZERO_VECTOR,
    Quaternion,
    Vector,
    add,
    cross,
    product,
    rotated,
    rotation_between,
    scaled,
    subtract,
)
from hapticbridge.study.engines.base import Contacts, Wrench
from hapticbridge.study.engines.task import (
    Pose,
    Shape,
    Task,
    Velocity,
    check_timestep,
    composed,
    inverted,
)

Frame = tuple[Vector, Quaternion]
"""Position in m and orientation, as the compiler takes them."""

_AT_ORIGIN = (ZERO_VECTOR, (1.0, 0.0, 0.0, 0.0))


class HeldSimulation(ABC):
    """A simulation whose coupling is a force and a torque that the engine is given every step.

        f_k = K e_k + (B/T)(e_k − e_{k−1}),    e = h − x
        τ_k = K_r φ_k + (B_r/T)(δφ_h − δφ_x),  φ = log(R_h R_xᵀ)

    with the handle h and the grip x at the end of step k; step k + 1 is done under (f_k, τ_k),
    moved to the centre of mass. This is ``mechanics.drive_mass``'s scheme ``held``. The handle has
    not moved before step 0.

    Engines know a body by its centre of mass: here a child's body is the frame of the principal
    axes of inertia, for which ``_principal`` and ``_shape_pose`` translate. A child sets its engine
    up in ``__init__`` after that of this class, and calls ``_begin`` last.
    """

    def __init__(self, task: Task, timestep: float) -> None:
        """Takes the task.

        Raises:
            StudyError: The timestep is not finite and positive.
        """
        self._timestep = check_timestep(timestep)
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
        self._principal_in_body = task.body.inertia_frame
        self._body_in_principal = inverted(task.body.inertia_frame)
        self._centre = task.body.inertia_frame.position
        self._handle: Frame = _AT_ORIGIN
        self._tool: Frame = _AT_ORIGIN
        self._wrench = self._at_centre = (ZERO_VECTOR, ZERO_VECTOR)

    def _begin(self, task: Task) -> None:
        """Computes the wrench of step 0."""
        handle = task.handle_poses(self._timestep, 1)[0]
        self._handle = (handle.position, handle.quaternion)
        grip = composed(self.pose(), task.grip)
        self._tool = (grip.position, grip.quaternion)
        self._measure(self._handle)

    def _principal(self, body: Pose) -> Pose:
        """Returns the pose of the principal frame for a pose of the body's frame."""
        return composed(body, self._principal_in_body)

    def _shape_pose(self, shape: Shape) -> Pose:
        """Returns the pose of one of the tool's shapes in the principal frame."""
        return composed(self._body_in_principal, shape.pose)

    def step(self, handle_position: Vector, handle_quaternion: Quaternion) -> None:
        """Goes one step under the wrench of the last, and computes the next."""
        self._couple((handle_position, handle_quaternion))
        self._measure((handle_position, handle_quaternion))

    def _couple(self, _handle: Frame) -> None:
        """Does the step; a child whose engine has a spring of its own aims it at the handle."""
        self.advance(*self._at_centre)

    def wrench(self) -> Wrench:
        """Returns the wrench on the tool about the grip."""
        return Wrench(*self._wrench)

    def _measure(self, handle: Frame) -> None:
        if self._gains is None:
            return
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
        """Sets a force in N and a torque in N m at the centre of mass, and steps."""

    @abstractmethod
    def principal_pose(self) -> Pose:
        """Returns the pose of the principal axes of inertia at the centre of mass."""

    def pose(self) -> Pose:
        """Returns the pose of the body's frame."""
        return composed(self.principal_pose(), self._body_in_principal)

    @abstractmethod
    def velocity(self) -> Velocity:
        """Returns the velocity of the centre of mass and the angular velocity."""

    @abstractmethod
    def contacts(self) -> Contacts:
        """Returns the contacts of the last step."""

    @abstractmethod
    def close(self) -> None:
        """Gives back what the engine holds."""


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
        rotation_between(handle_before[1], handle[1]),
        rotation_between(tool_before[1], orientation),
    )
    force = add(scaled(stiffness, subtract(handle[0], position)), scaled(damping, stretched))
    torque = add(
        scaled(rotational_stiffness, rotation_between(orientation, handle[1])),
        scaled(rotational_damping, twisted),
    )
    lever = subtract(position, add(body[0], rotated(body[1], centre)))
    return (position, orientation), (force, torque), (force, add(torque, cross(lever, force)))
