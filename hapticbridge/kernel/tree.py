"""The kinematic tree that the tool belongs to: all that its grip can move through joints alone."""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

_OBJECTS = mujoco.mjtObj


@dataclass(frozen=True, slots=True, eq=False)
class ToolTree:
    """What belongs to the tool's tree.

    Attributes:
        dofs: Per degree of freedom of the model.
        joints: Per joint.
        geoms: Per geom.
        is_never_free: Whether friction in a joint, an equality constraint, a tendon with friction
            or an actuator other than the coupling's always acts on it.
    """

    dofs: NDArray[np.bool_]
    joints: NDArray[np.bool_]
    geoms: NDArray[np.bool_]
    is_never_free: bool


def tree_of_tool(model: mujoco.MjModel, body: int, own: Container[int] = ()) -> ToolTree:
    """Returns the tree of the body that carries the grip.

    Args:
        model: The compiled scene.
        body: The grip's body.
        own: The coupling's actuators, by id.
    """
    tree = model.body_treeid[body]
    bodies = model.body_treeid == tree
    dofs = model.dof_treeid == tree
    return ToolTree(
        dofs=np.asarray(dofs),
        joints=np.asarray(bodies[model.jnt_bodyid]),
        geoms=np.asarray(bodies[model.geom_bodyid]),
        is_never_free=bool(
            np.any(model.dof_frictionloss[dofs])
            or np.any(model.tendon_frictionloss)
            or _is_driven(model, bodies, own)
            or any(_touches(model, equality, bodies) for equality in range(model.neq))
        ),
    )


def _is_driven(model: mujoco.MjModel, bodies: NDArray[np.bool_], own: Container[int]) -> bool:
    """Tells whether an actuator of the scene acts on the tree; what cannot be told counts as yes.

    MuJoCo takes the whole of its force in a step where half would be due, and a servo's implicitly:
    beside a lossless coupling that creates energy (8 mJ in 1 s in a measured case).
    """
    transmission = mujoco.mjtTrn
    owner = {
        transmission.mjTRN_JOINT: model.jnt_bodyid,
        transmission.mjTRN_JOINTINPARENT: model.jnt_bodyid,
        transmission.mjTRN_SITE: model.site_bodyid,
    }
    for actuator, (kind, targets) in enumerate(
        zip(model.actuator_trntype, model.actuator_trnid, strict=True)
    ):
        owners = owner.get(transmission(kind))
        if actuator in own:
            continue
        if owners is None or any(bodies[owners[target]] for target in targets if target >= 0):
            return True
    return False


def has_passive_forces(model: mujoco.MjModel) -> bool:
    """Tells whether springs, dampers, gravity compensation or a fluid act anywhere."""
    return bool(
        np.any(model.jnt_stiffness)
        or np.any(model.dof_damping)
        or np.any(model.body_gravcomp)
        or model.ntendon
        or model.nflex
        or model.opt.density
        or model.opt.viscosity
    )


def _touches(model: mujoco.MjModel, equality: int, bodies: NDArray[np.bool_]) -> bool:
    """Tells whether an equality constraint holds the tree; what cannot be told counts as yes."""
    ids = np.array([model.eq_obj1id[equality], model.eq_obj2id[equality]])
    ids = ids[ids >= 0]
    if model.eq_type[equality] == mujoco.mjtEq.mjEQ_JOINT:  # of joints the object's type says none
        return bool(bodies[model.jnt_bodyid[ids]].any())
    if model.eq_objtype[equality] == _OBJECTS.mjOBJ_BODY:
        return bool(bodies[ids].any())
    if model.eq_objtype[equality] == _OBJECTS.mjOBJ_SITE:
        return bool(bodies[model.site_bodyid[ids]].any())
    return True
