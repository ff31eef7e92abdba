"""Virtual coupling: a spring and a damper between the handle and the tool."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace

from hapticbridge.arguments import is_number, shown
from hapticbridge.errors import CouplingError, choices

SQUARED_LEVER = 1e-3
"""Squared lever arm ℓ² in m² from translational to rotational gains: ℓ = 32 mm, about half the
width of a hand, as in the default simulated device (0.002 N m s/rad over 2 N s/m). A longer lever
holds the tool's orientation more stiffly and needs more rotational damping of the device."""

_DERIVED = float("nan")
# compared by identity, so that any other NaN is refused


@dataclass(frozen=True, slots=True)
class Coupling:
    """Spring and damper that join the handle to the tool, in translation and in rotation.

    The wrench on the tool at the end of tick k is

        f_k = K (h_k − x_k) + (B / T) ((h_k − h_{k−1}) − (x_k − x_{k−1}))
        τ_k = K_r φ_k + (B_r / T) (δφ_h − δφ_x),    φ_k = log(R_h R_xᵀ)

    and the device receives −f_k, −τ_k. All quantities are in the world frame: pose h of the handle
    and x of the grip, their orientations R, their rotation vectors δφ since the previous tick. T is
    the period in s. The rotational spring is convex for |φ| < π; beyond, it jumps.

    Attributes:
        stiffness: K in N/m, finite and > 0.
        damping: B in N s/m, finite and >= 0.
        rotational_stiffness: K_r in N m/rad, finite and >= 0; by default ℓ² K.
        rotational_damping: B_r in N m s/rad, finite and >= 0; by default ℓ² B.

    The defaults are those of the translational springs and dampers at a distance ℓ around the grip
    (``SQUARED_LEVER``). On a device without torque they are never sent: they only hold the tool at
    the handle's orientation, where 0 would leave it to fall about the grip as in a ball joint. On
    a device with torque the condition for rotation holds them against its rotational damping.

    Raises:
        CouplingError: A value is not finite or out of range.

    References:
        Brown & Colgate 1997, eq. (4) (backward difference).
    """

    stiffness: float
    damping: float
    rotational_stiffness: float = _DERIVED
    rotational_damping: float = _DERIVED

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if value is _DERIVED:
                translational = getattr(self, field.name.removeprefix("rotational_"))
                object.__setattr__(self, field.name, SQUARED_LEVER * translational)
                continue
            name = field.name.replace("_", " ")
            if not is_number(value) or not math.isfinite(value):
                raise CouplingError(
                    f"coupling {name} is {shown(value)}; it must be a finite number"
                )
            if value < 0:
                raise CouplingError(f"coupling {name} is {value:g}; it must be >= 0")
            # as a recording stores it: MuJoCo gets −B, and −0 is another bit pattern than −0.0
            object.__setattr__(self, field.name, float(value))
        if self.stiffness == 0:
            raise CouplingError("coupling stiffness is 0 N/m; it must be > 0")

    def with_gains(self, gains: Mapping[str, float]) -> Coupling:
        """Returns the coupling with other gains by name.

        Raises:
            CouplingError: A name is no gain, or a value out of range.
        """
        names = [field.name for field in fields(self)]
        if unknown := gains.keys() - names:
            raise CouplingError(
                f"a coupling has no gain {choices(unknown)}; its gains: {choices(names)}"
            )
        return replace(self, **gains)
