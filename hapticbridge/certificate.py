"""Whether a device bears a coupling, and which coupling it bears by default."""

from __future__ import annotations

import math
from dataclasses import dataclass

from hapticbridge.coupling import Coupling
from hapticbridge.device import DeviceInfo
from hapticbridge.errors import CouplingError
from hapticbridge.passivity import minimum_damping, stiffest_coupling

UNKNOWN_DAMPING, UNKNOWN_ROTATIONAL_DAMPING = 2.0, 2e-3
"""N s/m and N m s/rad from which the default coupling follows where the device's are unknown: those
of the default simulated device. Larger ones would feel stiffer and be safe on fewer devices."""


@dataclass(frozen=True, slots=True)
class Condition:
    """The device condition b >= scale · force_scale · (K T / 2 + B) on one kind of axis.

    Attributes:
        axis: ``translation`` or ``rotation``.
        needed: The right-hand side in N s/m (rotation: N m s/rad).
        available: The device's damping b.
    """

    axis: str
    needed: float
    available: float

    @property
    def holds(self) -> bool:
        """Whether the device has enough damping."""
        return self.available >= self.needed

    def sentence(self) -> str:
        """Says it, with what to change if it does not hold."""
        unit = "N s/m" if self.axis == "translation" else "N m s/rad"
        relation = ">=" if self.holds else "<"
        text = f"{self.axis}: device damping {self.available:g} {relation} {self.needed:g} {unit}"
        return text if self.holds else f"{text}; lower stiffness or damping, or raise the rate"


def device_conditions(
    info: DeviceInfo, coupling: Coupling, period: float, scale: float, force_scale: float
) -> tuple[Condition, ...]:
    """Returns the condition per kind of axis that the device has, if its damping is known.

    A handle that moves ``scale`` times as far and a force that returns ``force_scale`` times as
    large make the coupling scale · force_scale times as stiff for the device; angles are not
    scaled, so torques return by force_scale / scale.

    Args:
        info: The device.
        coupling: K and B.
        period: T in s.
        scale: Handle motion per device motion.
        force_scale: Force on the device per force on the tool.

    References:
        Brown & Colgate 1997, eq. (6); sufficient for any environment that satisfies (14).
    """
    conditions = []
    if info.damping is not None:
        needed = scale * force_scale * minimum_damping(coupling, period)
        conditions.append(Condition("translation", needed, info.damping))
        if info.rotational_damping is not None and info.degrees_of_freedom > 3:
            needed = force_scale / scale * minimum_damping(coupling, period, axis="rotation")
            conditions.append(Condition("rotation", needed, info.rotational_damping))
    return tuple(conditions)


def is_certified(conditions: tuple[Condition, ...]) -> bool | None:
    """Returns whether all conditions hold; None where the device's damping is unknown."""
    return all(condition.holds for condition in conditions) if conditions else None


def default_coupling(
    info: DeviceInfo, period: float, scale: float = 1.0, force_scale: float = 1.0
) -> Coupling:
    """Returns the stiffest coupling that is safe on a device: 80 % of the bound, B = b / 4.

    Args:
        info: The device; where its damping is unknown, ``UNKNOWN_DAMPING`` is assumed.
        period: T in s.
        scale: Handle motion per device motion.
        force_scale: Force on the device per force on the tool.

    Raises:
        CouplingError: A scale is not finite and positive, or so is the period.
    """
    for name, value in (("scale", scale), ("force_scale", force_scale)):
        if not math.isfinite(value) or value <= 0:
            raise CouplingError(f"{name} is {value!r}; it must be finite and > 0")
    rotational = info.rotational_damping or UNKNOWN_ROTATIONAL_DAMPING
    return stiffest_coupling(
        (info.damping or UNKNOWN_DAMPING) / (scale * force_scale),
        rotational * scale / force_scale,
        period,
    )
