"""Stiffness limits from position resolution and Coulomb friction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

from hapticbridge.coupling import Coupling
from hapticbridge.errors import CouplingError
from hapticbridge.passivity.grid import scalar, single

Region = Literal["passive", "locally stable", "bounded limit cycle", "unstable"]
"""Regions of (β, σ) after Diolaiti et al. 2006."""


class Mechanism(Protocol):
    """Mechanics and encoder of one device axis, as the quantization limit requires them."""

    @property
    def damping(self) -> float | None:
        """Physical damping b in N s/m."""

    @property
    def friction(self) -> float | None:
        """Coulomb friction f_c in N."""

    @property
    def resolution(self) -> float | None:
        """Position quantum Δ in m."""


@dataclass(frozen=True, slots=True)
class QuantizationLimit:
    """Limits of a coupling on a device that quantises its position.

    Attributes:
        stiffness: Largest K in N/m that damping and friction both allow; 0 if the damper alone
            exceeds them. Always finite, because the damping bounds it.
        limited_by: The line that limits it: ``damping`` or ``friction``.
        beta: β = b / (K T), without unit.
        sigma: σ = f_c / (K Δ), without unit; inf for Δ = 0.
        region: ``passive`` (β and σ above ½), ``locally stable`` (only σ), ``bounded limit cycle``
            (only β), ``unstable`` (neither). Defined for a coupling without damper.
        friction_needed: K Δ/2 + B Δ/T in N.
    """

    stiffness: float
    limited_by: Literal["damping", "friction"]
    beta: float
    sigma: float
    region: Region
    friction_needed: float


def quantization_limit(device: Mechanism, coupling: Coupling, period: float) -> QuantizationLimit:
    """Returns the stiffness that friction and resolution allow, and the region of a coupling.

        K <= min( 2(b − B)/T,  2(f_c/Δ − B/T) ),      f_c >= K Δ/2 + B Δ/T

    Friction sets a line of its own, because motion over one quantum may be arbitrarily slow.

    Args:
        device: Damping, friction and resolution of one axis, none of them None.
        coupling: K and B in translation.
        period: T in s, finite and > 0.

    Raises:
        CouplingError: A value is unknown, not finite or out of range.

    References:
        Abbott & Okamura 2005 (friction and damping bounds); Diolaiti et al. 2006 (regions).
    """
    period = scalar("period", period, "s", positive=True)
    values = []
    for name, value, unit in (
        ("damping", getattr(device, "damping", None), "N s/m"),
        ("friction", getattr(device, "friction", None), "N"),
        ("resolution", getattr(device, "resolution", None), "m"),
    ):
        if value is None:
            raise CouplingError(f"device {name} is not known; give it in {unit}")
        values.append(scalar(f"device {name}", value, unit))
    b, friction, quantum = values
    k, damping = single(coupling)
    by_damping = 2 * (b - damping) / period
    by_friction = 2 * (friction / quantum - damping / period) if quantum else float("inf")
    beta = b / (k * period)
    sigma = friction / (k * quantum) if quantum else float("inf")
    region: Region
    if beta > 0.5:
        region = "passive" if sigma > 0.5 else "bounded limit cycle"
    else:
        region = "locally stable" if sigma > 0.5 else "unstable"
    return QuantizationLimit(
        stiffness=max(0.0, min(by_damping, by_friction)),
        limited_by="damping" if by_damping <= by_friction else "friction",
        beta=beta,
        sigma=sigma,
        region=region,
        friction_needed=k * quantum / 2 + damping * quantum / period,
    )
