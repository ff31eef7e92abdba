"""The kinematic tree that the tool belongs to: all that its grip can move through joints alone."""

from __future__ import annotations

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
            or an adhesion actuator always acts on it.
    """

    dofs: NDArray[np.bool_]
    joints: NDArray[np.bool_]
    geoms: NDArray[np.bool_]
    is_never_free: bool


def tree_of_tool(model: mujoco.MjModel, body: int) -> ToolTree:
    """Returns the tree of the body that carries the grip.

    Args:
        model: The compiled scene.
        body: The grip's body.
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
            or np.any(model.actuator_trntype == mujoco.mjtTrn.mjTRN_BODY)
            or any(_touches(model, equality, bodies) for equality in range(model.neq))
        ),
    )


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
    kind, ids = model.eq_objtype[equality], (model.eq_obj1id[equality], model.eq_obj2id[equality])
    owner = {
        _OBJECTS.mjOBJ_BODY: lambda i: i,
        _OBJECTS.mjOBJ_SITE: lambda i: model.site_bodyid[i],
        _OBJECTS.mjOBJ_JOINT: lambda i: model.jnt_bodyid[i],
    }.get(_OBJECTS(kind))
    return owner is None or any(bool(bodies[owner(i)]) for i in ids if i >= 0)
