"""Hand that holds a simulated device: inertia, damper and spring."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from hapticbridge.device.base import checked_number


@dataclass(frozen=True, slots=True, kw_only=True)
class Hand:
    """A hand: inertia fixed to the handle, with spring and damper to a moving target.

    The defaults are one measured arm at a handle. The rotational values are estimates of similar
    character (half a swing per second, well damped).

    Attributes:
        mass: Mass in kg, >= 0, fixed to the handle.
        damping: Damping in N s/m, >= 0, relative to the target's velocity.
        stiffness: Stiffness in N/m, >= 0.
        rotational_inertia: Rotational inertia in kg m², >= 0.
        rotational_damping: Rotational damping in N m s/rad, >= 0.
        rotational_stiffness: Rotational stiffness in N m/rad, >= 0.

    Raises:
        DeviceError: A value is not finite or negative.
    """

    mass: float = 0.55
    damping: float = 6.5
    stiffness: float = 135.0
    rotational_inertia: float = 1e-3
    rotational_damping: float = 0.02
    rotational_stiffness: float = 1.0

    def __post_init__(self) -> None:
        units = {
            "mass": "kg",
            "damping": "N s/m",
            "stiffness": "N/m",
            "rotational_inertia": "kg m²",
            "rotational_damping": "N m s/rad",
            "rotational_stiffness": "N m/rad",
        }
        for field in dataclasses.fields(self):
            value = checked_number(
                f"hand {field.name}", getattr(self, field.name), units[field.name]
            )
            object.__setattr__(self, field.name, value)


DEFAULT_HAND = Hand()

NO_HAND = Hand(
    mass=0.0,
    damping=0.0,
    stiffness=0.0,
    rotational_inertia=0.0,
    rotational_damping=0.0,
    rotational_stiffness=0.0,
)
