"""Sampled and discretised coupling as a transfer function of z."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.errors import CouplingError
from hapticbridge.passivity.grid import (
    Axis,
    CouplingGrid,
    delayed_by,
    frequencies,
    one_of,
    scalar,
    spring_and_damper,
)

Discretization = Literal["backward", "tustin"]
"""Rule that takes the damper's velocity from sampled positions."""

DISCRETIZATIONS = ("backward", "tustin")

_NYQUIST_ROUNDING = 1e-12
"""Relative distance from π/T that counts as rounding, without unit. (π/T)·T may differ from π, and
a hand has no reactance exactly at Nyquist."""


def angles(frequency: ArrayLike, period: float) -> NDArray[np.float64]:
    """Returns θ = ωT for frequencies in 0 < ω <= π/T.

    Raises:
        CouplingError: A frequency is not finite, not positive, or above Nyquist's.
    """
    theta = frequencies(frequency) * period
    if theta.max() > np.pi * (1 + _NYQUIST_ROUNDING):
        raise CouplingError(
            f"frequency {theta.max() / period:g} rad/s is above {np.pi / period:g} rad/s, "
            "half the sampling rate; choose 0 < frequency <= pi / period"
        )
    return np.where(theta > np.pi * (1 - _NYQUIST_ROUNDING), np.pi, theta)


def coupling_transfer(
    stiffness: NDArray[np.float64],
    damping: NDArray[np.float64],
    period: float,
    theta: NDArray[np.float64],
    discretization: Discretization,
    filter_time: float,
) -> NDArray[np.complex128]:
    """Returns C(e^{jθ}) of a spring and a low-passed damper, without delay.

        backward:  C = K + B w / (T + τ w),      w = 1 − z⁻¹
        tustin:    C = K + B w / (T/2 + τ w),    w = (1 − z⁻¹)/(1 + z⁻¹) = j tan(θ/2)

    Args:
        stiffness: K in N/m, broadcast against θ.
        damping: B in N s/m.
        period: T in s.
        theta: θ in rad.
        discretization: Rule for the damper and its filter.
        filter_time: τ in s of the first-order low-pass behind the damper; 0: none.

    Raises:
        CouplingError: The discretization is unknown.

    References:
        Brown & Colgate 1997, eqs. (4) and (5).
    """
    if one_of("discretization", discretization, DISCRETIZATIONS) == "backward":
        # 2 sin²(θ/2) equals 1 − cos θ without cancellation
        difference = 2 * np.sin(theta / 2) ** 2 + 1j * np.sin(theta)
        step = period
    else:
        difference = 1j * np.tan(theta / 2)
        step = period / 2
    transfer: NDArray[np.complex128] = stiffness + damping * (
        difference / (step + filter_time * difference)
    )
    return transfer


class SampledLaw(NamedTuple):
    """Validated arguments of a bound.

    Attributes:
        stiffness: K in N/m, shaped like the coupling.
        damping: B in N s/m, shaped like the coupling.
        period: T in s.
        delay: d in samples.
        filter_time: τ in s.
        rings: True for Tustin's damper without low-pass, whose gain is infinite at Nyquist.
    """

    stiffness: NDArray[np.float64]
    damping: NDArray[np.float64]
    period: float
    delay: int
    filter_time: float
    rings: bool

    @classmethod
    def of(
        cls,
        coupling: Coupling | CouplingGrid,
        period: float,
        discretization: Discretization,
        delay: int,
        filter_time: float,
        axis: Axis,
    ) -> SampledLaw:
        """Validates the arguments of a bound.

        Raises:
            CouplingError: An argument is out of range, or the axis or discretization is unknown.
        """
        period = scalar("period", period, "s", positive=True)
        filter_time = scalar("filter time", filter_time, "s")
        delay = delayed_by(delay)
        stiffness, damping = spring_and_damper(coupling, axis)
        one_of("discretization", discretization, DISCRETIZATIONS)
        rings = discretization == "tustin" and filter_time == 0
        return cls(stiffness, damping, period, delay, filter_time, rings)
