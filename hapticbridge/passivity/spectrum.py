"""Which device damping a coupling needs at each frequency, for any transfer function.

Notation: θ = ωT, u = 1 − e^{−jθ}. Because u / (1 − cos θ) = 1 + j cot(θ/2), both conditions
below need only the real and imaginary parts of a transfer function and cot(θ/2), and lose no
digits at low frequency.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import signal

from hapticbridge.arguments import LARGEST, shown
from hapticbridge.coupling import Coupling
from hapticbridge.errors import CouplingError
from hapticbridge.passivity.grid import (
    Axis,
    CouplingGrid,
    delayed_by,
    frequencies,
    one_of,
    plain,
    scalar,
    spring_and_damper,
)

Discretization = Literal["backward", "tustin"]
"""How the damper's velocity is taken from sampled positions."""

DISCRETIZATIONS = ("backward", "tustin")

Transfer = Callable[[NDArray[np.complex128]], Any]
"""A transfer function of z, from the handle's position in m to the force in N."""

_NYQUIST_ROUNDING = 1e-12
"""Relative distance from π/T that is taken for rounding, without unit: (π/T)·T may differ from π,
and at Nyquist itself a hand has no reactance."""


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
        discretization: Of the damper and its filter alike.
        filter_time: τ in s of the first-order low-pass behind the damper; 0: none.

    Raises:
        CouplingError: The discretization is unknown.

    References:
        Brown & Colgate 1997, eqs. (4) and (5).
    """
    if one_of("discretization", discretization, DISCRETIZATIONS) == "backward":
        # 2 sin²(θ/2) is 1 − cos θ without its cancellation
        difference = 2 * np.sin(theta / 2) ** 2 + 1j * np.sin(theta)
        step = period
    else:
        difference = 1j * np.tan(theta / 2)
        step = period / 2
    transfer: NDArray[np.complex128] = stiffness + damping * (
        difference / (step + filter_time * difference)
    )
    return transfer


def needed_for_any_environment(
    transfer: NDArray[np.complex128], period: float, theta: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Returns (T/2)(1 − cos θ) / Re{(1 − e^{−jθ})/C}; inf where the real part is not positive.

    Worst hand and worst discrete-time passive environment behind the coupling together.

    References:
        Brown & Colgate 1997, eq. (2).
    """
    power = transfer.real + transfer.imag / np.tan(theta / 2)
    size = np.abs(transfer) ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        needed = period / 2 * size / power
    # a coupling without force asks for nothing
    return np.where(size == 0, 0.0, np.where(power > 0, needed, np.inf))


def needed_for_fixed_environment(
    transfer: NDArray[np.complex128], period: float, theta: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Returns (T/2) Re{(1 − e^{−jθ}) H} / (1 − cos θ) for what the device is known to feel.

    References:
        Colgate & Schenkel 1997, necessary and sufficient for any passive hand.
    """
    needed: NDArray[np.float64] = period / 2 * (transfer.real - transfer.imag / np.tan(theta / 2))
    return needed


class SampledLaw(NamedTuple):
    """What every bound of a coupling is asked about, checked.

    Attributes:
        stiffness: K in N/m, shaped like the coupling.
        damping: B in N s/m, likewise.
        period: T in s.
        delay: d in samples.
        filter_time: τ in s.
        rings: Whether the damper is Tustin's without low-pass: its gain is infinite at Nyquist.
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
        """Checks what a bound was given.

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


def damping_spectrum(
    coupling: Coupling | CouplingGrid,
    period: float,
    frequency: ArrayLike,
    *,
    discretization: Discretization = "backward",
    delay: int = 0,
    filter_time: float = 0.0,
    axis: Axis = "translation",
) -> NDArray[np.float64]:
    """Returns the device damping that a coupling needs at each frequency.

        delay = 0:   b(ω) = (T/2)(1 − cos ωT) / Re{(1 − e^{−jωT}) / C}        any environment
        delay = d:   b(ω) = (T/2) Re{(1 − e^{−jωT}) C e^{−jdωT}} / (1 − cos ωT)        a wall

    ``minimum_damping`` is the supremum over 0 < ω <= π/T. With a delay the environment is a wall
    (the tool does not move): behind a delayed coupling no damping suffices for *every* passive
    environment; ``damping_spectrum_of`` of C z⁻ᵈ shows that as inf. Against a wall the damper can
    help, so values may be negative.

    Args:
        coupling: K and B, shape S.
        period: T in s, finite and > 0.
        frequency: ω in rad/s, 0 < ω <= π/T, shape F.
        discretization: Of the damper.
        delay: d, whole samples from position to force, 0 to 50.
        filter_time: τ in s of a first-order low-pass behind the damper, >= 0.
        axis: Which pair of K and B is asked for.

    Returns:
        b in N s/m (rotation: N m s/rad), shape S + F; inf where none suffices.

    Raises:
        CouplingError: An argument is out of range.

    References:
        Brown & Colgate 1997, eqs. (2), (4), (5); Colgate & Schenkel 1997.
    """
    law = SampledLaw.of(coupling, period, discretization, delay, filter_time, axis)
    period, delay, filter_time = law.period, law.delay, law.filter_time
    theta = angles(frequency, period)
    stiffness, damping = (
        value.reshape(value.shape + (1,) * theta.ndim) for value in (law.stiffness, law.damping)
    )
    transfer = coupling_transfer(stiffness, damping, period, theta, discretization, filter_time)
    if delay:
        return needed_for_fixed_environment(transfer * np.exp(-1j * delay * theta), period, theta)
    needed = needed_for_any_environment(transfer, period, theta)
    if law.rings:
        # tan(π/2) is finite in floating point; the limit at Nyquist is not
        needed = np.where((theta == np.pi) & (damping > 0), np.inf, needed)
    return needed


def damping_spectrum_of(
    transfer: Transfer | signal.dlti, period: float, frequency: ArrayLike
) -> float | NDArray[np.float64]:
    """Returns the device damping that any coupling needs at each frequency.

        b(ω) = (T/2)(1 − cos ωT) / Re{(1 − e^{−jωT}) / C(e^{jωT})}

    for every passive hand and every discrete-time passive environment behind the coupling.

    Args:
        transfer: C, a callable of an array of complex z, or a discrete ``scipy.signal`` system
            (its ``dt`` is the period, or True), from h − x in m to the force on the tool in N.
        period: T in s, finite and > 0.
        frequency: ω in rad/s, 0 < ω <= π/T, any shape.

    Returns:
        b in N s/m, shaped like the frequency; inf where no damping suffices.

    Raises:
        CouplingError: An argument is out of range, the system is continuous or sampled at another
            period, or C is not finite at a frequency.

    References:
        Brown & Colgate 1997, eq. (2).
    """
    period = scalar("period", period, "s", positive=True)
    theta = angles(frequency, period)
    z = np.exp(1j * theta)
    if isinstance(transfer, signal.lti):
        raise CouplingError(
            "the transfer function is continuous in time; discretise it, for example with "
            "scipy.signal.cont2discrete"
        )
    if isinstance(transfer, signal.dlti):
        if transfer.dt is not True and not np.isclose(transfer.dt, period, rtol=1e-9, atol=0):
            raise CouplingError(
                f"the transfer function is sampled every {transfer.dt:g} s, not every {period:g} s"
            )
        rational = transfer.to_tf()
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # a pole is refused
            value = np.polyval(rational.num, z) / np.polyval(rational.den, z)
    elif callable(transfer):
        value = transfer(z)
    else:
        raise CouplingError(
            f"transfer is {shown(transfer)}; it must be a callable of z or a scipy.signal system"
        )
    try:
        given = np.asarray(value)
    except (TypeError, ValueError):  # as rows of different lengths
        given = np.empty(0, dtype=object)
    if given.dtype.kind not in "iufc":
        raise CouplingError(f"transfer returned {shown(value)}; it must return numbers in N/m")
    response: NDArray[np.complex128] = given.astype(np.complex128)
    if response.shape not in {(), theta.shape}:
        raise CouplingError(
            f"transfer returned shape {response.shape} for z of shape {theta.shape}"
        )
    if not (np.abs(response) <= LARGEST**2).all():
        raise CouplingError("the transfer function is not finite at one of the frequencies")
    return plain(needed_for_any_environment(response, period, theta))
