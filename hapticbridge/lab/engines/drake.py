"""Drake's discrete MultibodyPlant with the SAP solver: point contact, and hydroelastic contact.

References:
    Drake, https://drake.mit.edu/doxygen_cxx
"""

from __future__ import annotations

from functools import partial
from importlib.metadata import version
from itertools import count
from typing import Any

import numpy as np
from pydrake.common.eigen_geometry import Quaternion as Turn
from pydrake.geometry import (
    AddCompliantHydroelasticProperties,
    AddContactMaterial,
    AddRigidHydroelasticProperties,
    Box,
    Capsule,
    Convex,
    ProximityProperties,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialVelocity
from pydrake.multibody.plant import AddMultibodyPlant, CoulombFriction, MultibodyPlantConfig
from pydrake.multibody.tree import SpatialInertia, UnitInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from hapticbridge.kernel.pose import Vector
from hapticbridge.lab.engines import base

POINT_STIFFNESS = 1e7
"""Stiffness of a point contact in N/m. The remaining error stems from Drake's single point for two
boxes. 1e6 is worse by a fifth, 1e8 no better."""

MODULUS = 1e9
"""Hydroelastic modulus of the free bodies in Pa, that of a hard plastic. A settled peg is wrong by
0.06 to 27 µm. At 1e10 the error is smaller, but with friction the peg flew out of the hole."""

RESOLUTION = 0.1
"""Edge of the tessellation of round shapes as a share of their radius, without unit."""

_PLANT = "Drake, MultibodyPlant"
_PROPERTIES = "Drake, geometry::DefaultProximityProperties"
_USER_GUIDE = "Drake, Hydroelastic Contact User Guide"
_SHARED = {
    "coupling": base.Advised("held force, applied_generalized_force", f"{_PLANT}: input ports"),
    "discrete_contact_approximation": base.Advised(
        "sap", f"{_PLANT}: DiscreteContactApproximation"
    ),
    "sap_near_rigid_threshold": base.Advised("0", f"{_PLANT}: set_sap_near_rigid_threshold"),
    "use_sampled_output_ports": base.Advised("False", f"{_PLANT}: SetUseSampledOutputPorts"),
}


class DrakeSimulation(base.Simulation):
    """A task in Drake.

    Drake refuses to continue from a state that is not finite; from then on the pose is nan.
    """

    def __init__(self, task: base.Task, timestep: float, contact_model: str) -> None:
        super().__init__(task, timestep)
        config = MultibodyPlantConfig(
            time_step=self._timestep,
            contact_model=contact_model,
            discrete_contact_approximation="sap",
            sap_near_rigid_threshold=0.0,
            use_sampled_output_ports=False,
        )
        builder = DiagramBuilder()
        plant, _ = AddMultibodyPlant(config, builder)
        plant.mutable_gravity_field().set_gravity_vector(np.array(task.gravity))
        is_point = contact_model == "point"

        def register(body: Any, shape: base.Shape, pose: base.Pose, *, is_fixed: bool) -> None:
            material = _material(task, 0.0 if is_point else self._timestep)
            if is_fixed and not is_point:
                AddRigidHydroelasticProperties(_hint(shape), material)
            elif not is_point:
                AddCompliantHydroelasticProperties(_hint(shape), MODULUS, material)
            name = f"shape_{next(numbers)}"
            place = _transform(pose)
            plant.RegisterCollisionGeometry(body, place, _geometry(shape), name, material)

        numbers, bodies = count(), []
        for i, free in enumerate(task.bodies):
            mass = free.body.mass
            unit = UnitInertia(*(moment / mass for moment in free.body.inertia))
            bodies.append(plant.AddRigidBody(f"body_{i}", SpatialInertia(mass, np.zeros(3), unit)))
            for shape, pose in free.shapes:
                register(bodies[-1], shape, pose, is_fixed=False)
        for shape in task.fixed:
            register(plant.world_body(), shape, shape.pose, is_fixed=True)
        plant.Finalize()
        self._simulator = Simulator(builder.Build())
        self._plant = plant
        root = self._simulator.get_mutable_context()
        self._context = context = plant.GetMyMutableContextFromRoot(root)
        port = plant.get_applied_generalized_force_input_port()
        self._forces = np.zeros(plant.num_velocities())
        self._input = port.FixValue(context, self._forces)
        for body, free in zip(bodies, task.bodies, strict=True):
            plant.SetFreeBodyPose(context, body, _transform(free.principal))
        self._positions = [body.floating_positions_start() for body in bodies]
        self._velocities = [body.floating_velocities_start_in_v() for body in bodies]
        velocity = task.start_velocity
        plant.SetFreeBodySpatialVelocity(
            context,
            bodies[0],
            SpatialVelocity(np.array(velocity.angular), np.array(velocity.linear)),
        )
        self._simulator.Initialize()
        self._steps = 0
        self._is_finite = True
        self._begin(task)

    def advance(self, force: Vector, torque: Vector) -> None:
        """Sets a force in N and a torque in N m at the centre of mass, and steps."""
        if not self._is_finite:
            return
        start = self._velocities[0]
        self._forces[start : start + 6] = (*torque, *force)
        self._input.GetMutableData().get_mutable_value().SetFromVector(self._forces)
        # the plant steps at 0, T, 2T, …; a target half way between is safe from rounding
        try:
            self._simulator.AdvanceTo((self._steps + 0.5) * self._timestep)
        except RuntimeError:
            self._is_finite = False
        self._steps += 1

    def principal_pose(self, body: int = 0) -> base.Pose:
        """Returns the pose of the principal axes of inertia at a body's centre of mass."""
        if not self._is_finite:
            return base.Pose((np.nan,) * 3, (np.nan,) * 4)
        start = self._positions[body]
        pose = self._plant.GetPositions(self._context)[start : start + 7]
        w, i, j, k, x, y, z = pose.tolist()
        return base.Pose((x, y, z), (w, i, j, k))

    def velocity(self, body: int = 0) -> base.Velocity:
        """Returns the velocity of a body's centre of mass and its angular velocity."""
        if not self._is_finite:
            return base.Velocity((np.nan,) * 3, (np.nan,) * 3)
        start = self._velocities[body]
        velocity = self._plant.GetVelocities(self._context)[start : start + 6]
        a, b, c, x, y, z = velocity.tolist()
        return base.Velocity((x, y, z), (a, b, c))

    def contacts(self) -> base.Contacts:
        """Returns the contacts at the present pose; a hydroelastic patch has no depth."""
        if not self._is_finite:
            return base.Contacts(0, 0.0)
        found = self._plant.get_contact_results_output_port().Eval(self._context)
        pairs = range(found.num_point_pair_contacts())
        points = base.Contacts.from_depths(
            found.point_pair_contact_info(i).point_pair().depth for i in pairs
        )
        return points._replace(points=points.points + found.num_hydroelastic_contacts())

    def close(self) -> None:
        """Does nothing: Drake holds no resources."""


def _material(task: base.Task, relaxation_time: float) -> Any:
    material = ProximityProperties()
    friction = CoulombFriction(task.body.friction, task.body.friction)
    AddContactMaterial(material, point_stiffness=POINT_STIFFNESS, friction=friction)
    material.AddProperty("material", "relaxation_time", relaxation_time)
    return material


def _hint(shape: base.Shape) -> float:
    """Returns Drake's ``resolution_hint`` in m; it is not used for boxes and meshes."""
    return RESOLUTION * (shape.size[0] if shape.size else 1.0)


def _geometry(shape: base.Shape) -> Any:
    if shape.kind == "box":
        return Box(*(2 * half for half in shape.size))
    if shape.kind == "sphere":
        return Sphere(*shape.size)
    if shape.kind == "capsule":
        return Capsule(shape.size[0], 2 * shape.size[1])
    return Convex(np.asarray(shape.vertices).T, "mesh")


def _transform(pose: base.Pose) -> Any:
    quaternion = np.array(pose.quaternion)
    # Drake refuses a quaternion whose norm is wrong in its last digits
    turn = Turn(quaternion / np.linalg.norm(quaternion))
    return RigidTransform(turn, np.array(pose.position))


def engines() -> tuple[base.Engine, ...]:
    """Returns the engines of this module."""
    stiffness = base.Advised(f"{POINT_STIFFNESS:g} N/m", f"{_PROPERTIES}: point_stiffness")
    point = {
        "point_contact_stiffness": stiffness,
        "relaxation_time": base.Advised("0", f"{_PROPERTIES}: relaxation_time"),
    }
    hydroelastic = {
        "compliance": base.Advised("free bodies compliant, fixed shapes rigid", _USER_GUIDE),
        "hydroelastic_modulus": base.Advised(
            f"{MODULUS:g} Pa", f"{_PROPERTIES}: hydroelastic_modulus"
        ),
        "resolution_hint": base.Advised(
            f"{RESOLUTION:g} of the radius", f"{_PROPERTIES}: resolution_hint"
        ),
        "relaxation_time": base.Advised("1 timestep", f"{_PROPERTIES}: relaxation_time"),
    }
    return tuple(
        base.Engine(
            f"drake_{model}",
            version("drake"),
            {**_SHARED, **settings},
            partial(DrakeSimulation, contact_model=model),
        )
        for model, settings in (("point", point), ("hydroelastic", hydroelastic))
    )
