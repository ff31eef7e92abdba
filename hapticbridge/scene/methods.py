"""Requirements of the rendering methods for comparison on a scene."""

from __future__ import annotations

import mujoco
import numpy as np

from hapticbridge.errors import SceneError, choices
from hapticbridge.kernel.names import COUPLING_ACTUATORS

AXES_TOLERANCE = 1e-9
"""Largest deviation from orthogonality of the joint axes of a planar tool, without unit. It admits
rounding of axes with 16 digits in MJCF, far below a noticeable motion of the grip off the
handle."""


def check_massless_tool(model: mujoco.MjModel, grip: str, method: str) -> None:
    """Raises SceneError for a scene in which anything moves besides one rigid tool."""
    body_id = int(model.site(grip).bodyid[0])
    first, count = int(model.body_jntadr[body_id]), int(model.body_jntnum[body_id])
    kinds = model.jnt_type[first : first + count].tolist() if count else []
    slide, hinge = int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE)
    is_free = kinds == [int(mujoco.mjtJoint.mjJNT_FREE)]
    is_planar = kinds == [slide, slide, hinge] and model.body_parentid[body_id] == 0
    if is_planar:
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        axes = data.xaxis[first : first + 3]
        is_planar = bool(np.abs(axes @ axes.T - np.eye(3)).max() < AXES_TOLERANCE)
    if not is_free and not is_planar:
        raise SceneError(
            f"method '{method}' needs a tool with a free joint, or a planar one (two slides and "
            f"then a hinge, at right angles, on a child of the world); body "
            f"'{model.body(body_id).name or body_id}' of grip '{grip}' has neither"
        )
    others = {
        "other joints": model.nv > (6 if is_free else 3),
        "actuators": model.nactuator > len(COUPLING_ACTUATORS),
        "equality constraints": model.neq > 0,
        "tendons": model.ntendon > 0,
        "flexes": model.nflex > 0,
        "mocap bodies": model.nmocap > 1,
    }
    found = [name for name, is_there in others.items() if is_there]
    if found:
        raise SceneError(
            f"method '{method}' renders one tool and nothing else that moves; the scene has "
            f"{' and '.join(found)}; remove them or choose another method"
        )


def check_metered(model: mujoco.MjModel, integrator: str, method: str) -> None:
    """Raises SceneError for forces of the scene that cannot be metered under an integrator.

    The work of a port in a step is h Q·v⁺, with the force Q that the step used. ``Euler`` uses the
    force at the start of the step. ``implicitfast`` does so too for forces that do not depend on
    velocity. RK4 uses four forces and keeps none.
    """
    names = [model.actuator(i).name or str(i) for i in range(model.nactuator)]
    own = [i for i, name in enumerate(names) if name not in COUPLING_ACTUATORS]
    if integrator == "implicitfast":
        own = [i for i in own if _depends_on_velocity(model, i)]
    elif integrator != "RK4":
        return
    if own:
        kind = "actuator forces that depend on velocity" if integrator != "RK4" else "actuators"
        raise SceneError(
            f"method '{method}' cannot meter {kind} ({choices(names[i] for i in own)}) under "
            f"{integrator}; use 'implicit' or 'explicit'"
        )
    if integrator == "RK4" and (np.any(model.body_gravcomp) or np.any(model.jnt_actgravcomp)):
        raise SceneError(
            f"method '{method}' cannot meter gravity compensation under RK4; use 'explicit'"
        )


def _depends_on_velocity(model: mujoco.MjModel, actuator_id: int) -> bool:
    gain, bias = model.actuator_gaintype[actuator_id], model.actuator_biastype[actuator_id]
    is_plain = gain == mujoco.mjtGain.mjGAIN_FIXED or (
        gain == mujoco.mjtGain.mjGAIN_AFFINE and model.actuator_gainprm[actuator_id, 2] == 0
    )
    is_unbiased = bias == mujoco.mjtBias.mjBIAS_NONE or (
        bias == mujoco.mjtBias.mjBIAS_AFFINE and model.actuator_biasprm[actuator_id, 2] == 0
    )
    return not (is_plain and is_unbiased)
