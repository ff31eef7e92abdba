"""Closed-form conditions between a coupling, the sampling period and the device's damping."""

from __future__ import annotations

import math
from typing import Literal

from hapticbridge.coupling import Coupling
from hapticbridge.errors import CouplingError

STIFFNESS_MARGIN = 0.8
"""Share of the largest passive stiffness that a default coupling uses, without unit. The rest pays
for what is not known of a device: its real damping, friction, timing. Nearer to 1 feels stiffer and
leaves less."""

DAMPING_SHARE = 0.25
"""Share of the device's damping that a default coupling spends on its own damper, without unit.
More damps the tool better against the handle and leaves less stiffness: K ∝ b − B."""


def _positive(name: str, value: float, unit: str) -> float:
    if not math.isfinite(value) or value <= 0:
        raise CouplingError(f"{name} is {value!r} {unit}; it must be finite and > 0")
    return value


def minimum_damping(
    coupling: Coupling,
    period: float,
    *,
    axis: Literal["translation", "rotation"] = "translation",
) -> float:
    """Returns the damping that a device needs so that this coupling is passive on it.

        b > K T / 2 + B

    Necessary, and sufficient for any passive hand and any environment that is discrete-time
    passive (14), whatever it consists of.

    Args:
        coupling: K, B and their rotational counterparts.
        period: T in s, finite and > 0: how long the device holds a wrench.
        axis: Which pair of K and B is asked for.

    Returns:
        The bound on b in N s/m (rotation: N m s/rad).

    Raises:
        CouplingError: The period is not finite or not positive, or the axis is unknown.

    References:
        Brown & Colgate 1997, eq. (6).
    """
    _positive("period", period, "s")
    if axis == "translation":
        return coupling.stiffness * period / 2 + coupling.damping
    if axis == "rotation":
        return coupling.rotational_stiffness * period / 2 + coupling.rotational_damping
    raise CouplingError(f"axis is {axis!r}; choose 'translation' or 'rotation'")


def maximum_stiffness(device_damping: float, period: float, damping: float = 0.0) -> float:
    """Returns the largest passive stiffness, K = 2 (b − B) / T.

    Args:
        device_damping: b in N s/m, finite and > 0.
        period: T in s, finite and > 0.
        damping: B in N s/m, finite, 0 <= B < b.

    Returns:
        K in N/m; a coupling must stay below it.

    Raises:
        CouplingError: An argument is out of range; B >= b leaves no stiffness at all.

    References:
        Brown & Colgate 1997, eq. (6) solved for K.
    """
    _positive("device damping", device_damping, "N s/m")
    _positive("period", period, "s")
    if not math.isfinite(damping) or damping < 0:
        raise CouplingError(f"coupling damping is {damping!r} N s/m; it must be finite and >= 0")
    if damping >= device_damping:
        raise CouplingError(
            f"coupling damping {damping:g} N s/m is not below the device's {device_damping:g} "
            "N s/m, so no stiffness is passive"
        )
    return 2 * (device_damping - damping) / period


def stiffest_coupling(damping: float, rotational_damping: float, period: float) -> Coupling:
    """Returns the default coupling of a device: 80 % of the bound, with B a quarter of b.

        B = b / 4,    K = 0.8 · 2 (b − B) / T        (rotation likewise)

    Args:
        damping: b in N s/m as seen in the scene (divided by scale · force scale), > 0.
        rotational_damping: Likewise in N m s/rad, > 0.
        period: T in s, finite and > 0.

    Raises:
        CouplingError: An argument is not finite or not positive.
    """
    translation = DAMPING_SHARE * _positive("device damping", damping, "N s/m")
    rotation = DAMPING_SHARE * _positive("device damping", rotational_damping, "N m s/rad")
    return Coupling(
        stiffness=STIFFNESS_MARGIN * maximum_stiffness(damping, period, translation),
        damping=translation,
        rotational_stiffness=STIFFNESS_MARGIN
        * maximum_stiffness(rotational_damping, period, rotation),
        rotational_damping=rotation,
    )
