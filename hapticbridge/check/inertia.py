"""The inertia that a push on a joint or on a body meets, armature included.

MuJoCo's own ``dof_invweight0`` and ``body_invweight0`` leave the armature out where a body is
simple (alone in its tree, without rotation between its frames), as seen in MuJoCo 4.0: a slide of
0.5 g with 0.1 kg of armature has 1/0.0005.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np


def joint_inertia(model: mujoco.MjModel, data: mujoco.MjData, dof: int) -> float:
    """Returns what a force along one degree of freedom meets: 1/(M⁻¹)_ii.

    Args:
        model: The compiled scene.
        data: Its state, after ``mj_forward``.
        dof: The degree of freedom.

    Returns:
        In kg, of a hinge in kg m²; the other degrees of freedom give way.
    """
    unit, answer = np.zeros((2, 1, model.nv))
    unit[0, dof] = 1.0
    mujoco.mj_solveM(model, data, answer, unit)
    return float(1.0 / answer[0, dof])


def body_inertia(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> float:
    """Returns what a push at a body's centre of mass meets in the direction that gives way most.

    1/m is the largest eigenvalue of J M⁻¹ Jᵀ, with the Jacobian J of the centre of mass.

    Args:
        model: The compiled scene.
        data: Its state, after ``mj_forward``.
        body: The body.

    Returns:
        m in kg; infinite where the body cannot move.
    """
    if model.nv == 0 or model.body_treeid[body] < 0:
        return math.inf
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_jacBodyCom(model, data, jacobian, None, body)
    answer = np.zeros_like(jacobian)
    mujoco.mj_solveM(model, data, answer, jacobian)
    weight = float(np.linalg.eigvalsh(jacobian @ answer.T)[-1])
    return 1.0 / weight if weight > 0 else math.inf
