"""Effective inertia of joints and bodies."""

from __future__ import annotations

import math

import mujoco
import numpy as np


def joint_inertia(model: mujoco.MjModel, data: mujoco.MjData, dof: int) -> float:
    """Returns the inertia in kg (hinge: kg m²) along a degree of freedom: 1/(M⁻¹)_ii.

    The other degrees of freedom move freely; ``data`` must be current (``mj_forward``). Armature is
    included. MuJoCo's ``dof_invweight0`` and ``body_invweight0`` omit it for simple bodies (alone
    in their tree, without rotation between their frames). Seen in MuJoCo 4.0: a slide of 0.5 g with
    0.1 kg of armature has 1/0.0005.
    """
    unit, answer = np.zeros((2, 1, model.nv))
    unit[0, dof] = 1.0
    mujoco.mj_solveM(model, data, answer, unit)
    return float(1.0 / answer[0, dof])


def body_inertia(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> float:
    """Returns a body's inertia in kg at its centre of mass, in the most compliant direction.

    1/m is the largest eigenvalue of J M⁻¹ Jᵀ, with the Jacobian J of the centre of mass. Armature
    is included; ``data`` must be current (``mj_forward``). A body that cannot move has infinite
    inertia.
    """
    if model.nv == 0 or model.body_treeid[body] < 0:
        return math.inf
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_jacBodyCom(model, data, jacobian, None, body)
    answer = np.zeros_like(jacobian)
    mujoco.mj_solveM(model, data, answer, jacobian)
    weight = float(np.linalg.eigvalsh(jacobian @ answer.T)[-1])
    return 1.0 / weight if weight > 0 else math.inf
