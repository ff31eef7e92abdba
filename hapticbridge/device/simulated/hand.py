"""Hand that holds a simulated device: inertia, damper and spring."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from hapticbridge.arguments import Arguments
from hapticbridge.device.base import checked_number
from hapticbridge.errors import DeviceError


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

HAND_RANGES = {
    "mass": (0.05, 2.0),
    "damping": (0.5, 50.0),
    "stiffness": (10.0, 2000.0),
    "rotational_inertia": (1e-4, 1e-2),
    "rotational_damping": (2e-3, 0.2),
    "rotational_stiffness": (0.1, 10.0),
}
"""Ranges of random hands in the units of ``Hand``: from two fingers that hardly hold to an arm that
grips hard, around the measured arm of the defaults. Every hand in them is passive."""


def random_hand(seed: int) -> Hand:
    """Returns a random passive hand that depends only on the seed, a whole number >= 0.

    Every value is drawn independently, evenly in its logarithm, from its ``HAND_RANGES``.
    """
    Arguments(DeviceError).whole("seed", seed, least=0, most=2**63 - 1)
    generator = np.random.default_rng(seed)
    return Hand(
        **{
            name: float(np.exp(generator.uniform(np.log(least), np.log(most))))
            for name, (least, most) in HAND_RANGES.items()
        }
    )


NO_HAND = Hand(
    mass=0.0,
    damping=0.0,
    stiffness=0.0,
    rotational_inertia=0.0,
    rotational_damping=0.0,
    rotational_stiffness=0.0,
)
