"""Virtual coupling: a spring and a damper between the handle and the tool."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Literal

from hapticbridge.arguments import check_fields, is_number, option, rule, unit_of
from hapticbridge.errors import CouplingError, choices

SQUARED_LEVER = 1e-3
"""Squared lever arm ℓ² in m² from translational to rotational gains: ℓ = 32 mm, about half the
width of a hand, as in the default simulated device (0.002 N m s/rad over 2 N s/m). A longer lever
holds the tool's orientation more stiffly and needs more rotational damping of the device."""

_DERIVED = float("nan")
# compared by identity, so that any other NaN is refused

Axis = Literal["translation", "rotation"]


@dataclass(frozen=True, slots=True)
class Coupling:
    """Spring and damper that join the handle to the tool, in translation and in rotation.

    The wrench on the tool at the end of tick k is

        f_k = K (h_k − x_k) + (B / T) ((h_k − h_{k−1}) − (x_k − x_{k−1}))
        τ_k = K_r φ_k + (B_r / T) (δφ_h − δφ_x),    φ_k = log(R_h R_xᵀ)

    and the device receives −f_k, −τ_k. All quantities are in the world frame: pose h of the handle
    and x of the grip, their orientations R, their rotation vectors δφ since the previous tick. T is
    the period in s. The rotational spring is convex for −π < φ < π; beyond, it jumps.

    Attributes:
        stiffness: Stiffness K of the coupling in N/m. A run without it takes the stiffest that
            leaves 15 % of the device's damping unused.
        damping: Damping B of the coupling in N s/m, as requested. The law uses B - KT/2 with
            'lossless', B - KT with 'compensated', at least 0; B with all others. The device needs
            b >= KT/2 + B_law.
        rotational_stiffness: Rotational stiffness K_r in N m/rad; by default that of the coupling's
            springs at a distance of 32 mm around the grip.
        rotational_damping: Rotational damping B_r in N m s/rad; by default that of its dampers at
            this distance.

    The defaults are those of the translational springs and dampers at a distance ℓ around the grip
    (``SQUARED_LEVER``). On a device without torque they are never sent: they only hold the tool at
    the handle's orientation, where 0 would leave it to fall about the grip as in a ball joint. On
    a device with torque the condition for rotation holds them against its rotational damping.

    Raises:
        CouplingError: A value is not finite or out of range.

    References:
        Brown & Colgate 1997, eq. (4) (backward difference).
    """

    stiffness: float = field(metadata=rule(unit="N/m", least=0.0, is_open=True))
    damping: float = field(metadata=rule(unit="N s/m", least=0.0))
    rotational_stiffness: float = option(_DERIVED, unit="N m/rad", least=0.0)
    rotational_damping: float = option(_DERIVED, unit="N m s/rad", least=0.0)

    def __post_init__(self) -> None:
        for name in ("rotational_stiffness", "rotational_damping"):
            if getattr(self, name) is _DERIVED:
                own = getattr(self, name.removeprefix("rotational_"))
                derived = SQUARED_LEVER * own if is_number(own) else 0.0
                object.__setattr__(self, name, derived)
        # as floats, because MuJoCo gets −B, and −0 is another bit pattern than −0.0
        check_fields(self, CouplingError, "coupling ")

    def gains(self, axis: Axis) -> tuple[float, float]:
        """Returns K and B of translation, or K_r and B_r."""
        if axis == "translation":
            return self.stiffness, self.damping
        return self.rotational_stiffness, self.rotational_damping

    def with_axis(self, axis: Axis, stiffness: float, damping: float) -> Coupling:
        """Returns the coupling with other stiffness and damping along one kind of axis."""
        if axis == "translation":
            return replace(self, stiffness=stiffness, damping=damping)
        return replace(self, rotational_stiffness=stiffness, rotational_damping=damping)

    def with_gains(self, gains: Mapping[str, float]) -> Coupling:
        """Returns the coupling with other gains by name.

        Raises:
            CouplingError: A name is no gain, or a value out of range.
        """
        names = [each.name for each in fields(self)]
        if unknown := gains.keys() - names:
            raise CouplingError(
                f"a coupling has no gain {choices(unknown)}; its gains: {choices(names)}"
            )
        return replace(self, **gains)


SYMBOLS: dict[Axis, tuple[str, str]] = {"translation": ("K", "B"), "rotation": ("K_r", "B_r")}
"""Symbols of stiffness and damping by kind of axis."""

UNITS: dict[Axis, tuple[str, str]] = {
    "translation": (unit_of(Coupling, "stiffness"), unit_of(Coupling, "damping")),
    "rotation": (
        unit_of(Coupling, "rotational_stiffness"),
        unit_of(Coupling, "rotational_damping"),
    ),
}
"""Units of stiffness and damping by kind of axis."""

PREFIX: dict[Axis, str] = {"translation": "", "rotation": "rotational "}
"""Word before stiffness and damping by kind of axis."""
