"""Device types of Force Dimension's library."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from hapticbridge.device.data_sheet import USUAL_TORQUE_LIMIT
from hapticbridge.errors import DeviceError
from hapticbridge.pose import Quaternion, canonical

ROTATION_ERROR = 1e-3
"""Largest deviation of R Rᵀ from the identity, without unit. A larger one is not due to
rounding."""


@dataclass(frozen=True, slots=True)
class Model:
    """Properties of a device type.

    Attributes:
        name: The maker's name.
        turns: True if its wrist has motors.
        force: Largest force in N if the library sets no limit; None if unknown.
        torque: Largest torque in N m if the library sets no limit; None if unknown.
    """

    name: str
    turns: bool = False
    force: float | None = None
    torque: float | None = None


MODELS = {
    33: Model("omega.3", force=12.0),
    34: Model("omega.6", force=12.0),
    36: Model("omega.6 left", force=12.0),
    35: Model("omega.7", force=12.0),
    37: Model("omega.7 left", force=12.0),
    60: Model("Novint Falcon", force=8.0),
    63: Model("delta.3", force=20.0),
    104: Model("sigma.7", turns=True, force=12.0, torque=0.4),
    105: Model("sigma.7 left", turns=True, force=12.0, torque=0.4),
    108: Model("lambda.7", turns=True, force=12.0),
    109: Model("lambda.7 left", turns=True, force=12.0),
    203: Model("lambda.3"),
    206: Model("sigma.3"),
}
"""Device types by ``dhdGetSystemType``, numbered as in the SDK's header. Forces and torques are
those that CHAI3D allows; the maker's own figures are equal or larger."""


def limits_of(
    model: Model, library_limits: Sequence[float], requested: Mapping[str, float]
) -> tuple[float, float]:
    """Returns the largest force in N and torque in N m that may be commanded.

    Each is the lower of the library's limit and the user's or the model's value.

    Args:
        model: Type of the device.
        library_limits: The library's limits of force and torque; negative if it sets no limit.
        requested: Numbers of the data sheet set by the user.

    Raises:
        DeviceError: No source states a limit.
    """
    limits = {"force": 0.0, "torque": USUAL_TORQUE_LIMIT}
    usual = {"force": model.force, "torque": model.torque}
    for name, library_limit in zip(limits, library_limits, strict=True):
        if name == "torque" and not model.turns:
            continue
        candidates = [
            requested.get(f"{name}_limit", usual[name]),
            library_limit if library_limit > 0.0 else None,
        ]
        known = [end for end in candidates if end is not None]
        if not known:
            raise DeviceError(
                f"the largest {name} of {model.name} is unknown; set it with {name}_limit="
            )
        limits[name] = min(known)
    return limits["force"], limits["torque"]


def quaternion_of(frame: Sequence[float], name: str) -> Quaternion:
    """Returns the unit quaternion (w, x, y, z) of a rotation matrix.

    Args:
        frame: Nine numbers, row by row.
        name: Name of the device in messages.

    Raises:
        DeviceError: The matrix is not a rotation, or a number in it is not finite.
    """
    flat = np.array(frame)
    matrix = flat.reshape(3, 3)
    is_finite = bool(np.isfinite(matrix).all())
    if not is_finite or not (
        np.abs(matrix @ matrix.T - np.eye(3)).max() < ROTATION_ERROR and np.linalg.det(matrix) > 0
    ):
        raise DeviceError(
            f"{name} reports an orientation that is not a rotation; check its cable and restart it"
        )
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, flat)
    w, x, y, z = (quaternion / np.linalg.norm(quaternion)).tolist()
    return canonical((w, x, y, z))
