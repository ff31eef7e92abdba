"""Hand of a scene."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mujoco

from hapticbridge.device.simulated.hand import DEFAULT_HAND, Hand
from hapticbridge.errors import DeviceError, SceneError
from hapticbridge.scene import custom_numbers

SCENE_HAND = "simulated_hand"
"""Name of the custom numbers in a scene's file."""

_FIELDS = ("stiffness", "damping", "rotational_stiffness", "rotational_damping")


def scene_hand(model: mujoco.MjModel, path: Path) -> Hand:
    """Returns the hand that follows a scene's path; ``DEFAULT_HAND`` without custom numbers.

    A relaxed arm (135 N/m) follows a path only against little resistance; driving a nail or turning
    a key requires a firmer grip. A scene specifies it in its file,

        <custom><numeric name="simulated_hand" data="1000 30"/></custom>

    as stiffness in N/m and damping in N s/m, optionally followed by rotational stiffness in N m/rad
    and rotational damping in N m s/rad. All other values, including the inertia, are those of the
    default hand.

    Raises:
        SceneError: The numbers are not two or four, or one is not finite or negative.
    """
    numbers = custom_numbers(model, SCENE_HAND)
    if not numbers:
        return DEFAULT_HAND
    words = " ".join(f"{number:g}" for number in numbers)
    where = f"scene '{path}': its custom numbers '{SCENE_HAND}' are '{words}'"
    if len(numbers) not in (2, 4):
        raise SceneError(
            f"{where}; they must be stiffness in N/m and damping in N s/m of the hand, optionally "
            "followed by its rotational stiffness in N m/rad and damping in N m s/rad"
        )
    try:
        return replace(DEFAULT_HAND, **dict(zip(_FIELDS, numbers, strict=False)))
    except DeviceError as error:
        raise SceneError(f"{where}; {error}") from None
