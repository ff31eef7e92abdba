"""What MuJoCo's own viewer draws of a scene and the page does not, in words."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.kernel.names import HANDLE
from hapticbridge.view.props import SHOWN_GROUPS
from hapticbridge.view.terrain import stride_of


def left_out(model: mujoco.MjModel, grip: str) -> list[str]:
    """Returns sentences on what is not drawn, or not as finely as it is; none for nothing.

    Args:
        model: The scene, as the bridge runs it.
        grip: Name of the site on the tool; it and the handle's are where the spring is.
    """
    is_site = _is_shown(model.site_group) & (model.site_rgba[:, 3] > 0)
    is_site[[model.site(name).id for name in (grip, HANDLE)]] = False
    is_beam = model.sensor_type == int(mujoco.mjtSensor.mjSENS_RANGEFINDER)
    kinds = {
        "flexes": _is_shown(model.flex_group),
        "skins": _is_shown(model.skin_group),
        "sites": is_site,
        "the beams of rangefinders": is_beam,
    }
    there = [f"{name} ({np.count_nonzero(each)})" for name, each in kinds.items() if each.any()]
    told = [f"Not drawn here: {', '.join(there)}"] if there else []
    is_field = model.geom_type == int(mujoco.mjtGeom.mjGEOM_HFIELD)
    fields = set(model.geom_dataid[is_field & _is_shown(model.geom_group)].tolist())
    steps = {model.hfield(field).name: stride_of(model, field) for field in sorted(fields)}
    told += [
        f"Height field '{name}' is drawn coarser: one sample of {step} along a side"
        for name, step in steps.items()
        if step > 1
    ]
    return told


def _is_shown(groups: NDArray[np.int32]) -> NDArray[np.bool_]:
    return np.asarray(groups < SHOWN_GROUPS)
