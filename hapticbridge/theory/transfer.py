"""Sampled and discretised coupling as a transfer function of z, and a transmission line."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.arguments import LARGEST, SMALLEST, Arguments, shown
from hapticbridge.coupling import Coupling
from hapticbridge.errors import CouplingError

# Arrays of couplings, and argument checks shared by all bounds

MAX_DELAY = 50
"""Largest delay in samples: 50 ms at 1 kHz, where a coupling is too soft to be useful. The time to
compute a bound grows with its square."""

MAX_SAMPLES = 10**8
"""Largest length of a run or series in samples: a day at 1 kHz, which still fits into memory."""

ROUNDING = 1e-9
"""Rounding of a delay in ticks, without unit: delays in s are divided by periods in s. A delay that
falls short of a whole number by less counts as it."""

_ARGUMENTS = Arguments(CouplingError)
# a frequency is an angle divided by a period, so its range is squared
_FREQUENCIES = Arguments(CouplingError, SMALLEST**2, LARGEST**2)


def checked(
    name: str, value: ArrayLike, unit: str = "", *, positive: bool = False
) -> NDArray[np.float64]:
    """Returns an array of finite numbers >= 0 (> 0 if positive), or raises CouplingError."""
    return _ARGUMENTS.numbers(name, value, unit, least=0, is_open=positive)


def scalar(name: str, value: float, unit: str = "", *, positive: bool = False) -> float:
    """Returns one number, finite and >= 0 (> 0 if positive), or raises CouplingError."""
    return _ARGUMENTS.number(name, value, unit, least=0, is_open=positive)


def frequencies(value: ArrayLike) -> NDArray[np.float64]:
    """Returns frequencies in rad/s as an array, all finite and > 0, or raises CouplingError."""
    return _FREQUENCIES.numbers("frequency", value, "rad/s", least=0, is_open=True)


def whole(name: str, value: int, least: int = 0, most: int = MAX_SAMPLES) -> int:
    """Returns a whole number of samples in [least, most], or raises CouplingError."""
    return _ARGUMENTS.whole(name, value, "samples", least=least, most=most)


def delayed_by(value: int) -> int:
    """Returns a delay of 0 to ``MAX_DELAY`` whole samples, or raises CouplingError."""
    return whole("delay", value, most=MAX_DELAY)


def late_by(value: float, count: int = 1) -> float:
    """Returns a delay of 0 to ``MAX_DELAY`` times n (``count``) ticks, or raises CouplingError."""
    most = MAX_DELAY * count * (1 + ROUNDING)
    return _ARGUMENTS.number("delay", value, "ticks", least=0, most=most)


def one_of(name: str, value: str, valid: Iterable[str]) -> str:
    """Returns the value if it is one of the valid names, or raises CouplingError."""
    return _ARGUMENTS.one_of(name, value, valid)


def together(**arrays: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Broadcasts arrays to one shape, or raises CouplingError."""
    shape = _ARGUMENTS.shape(**arrays)
    return [np.broadcast_to(array, shape) for array in arrays.values()]


def plain(array: NDArray[np.float64]) -> float | NDArray[np.float64]:
    """Returns a float for an array without dimensions, and any other array unchanged."""
    return array if array.ndim else float(array)


@dataclass(frozen=True, slots=True, eq=False)
class CouplingGrid:
    """Couplings in translation as arrays, for maps over thousands; the fields broadcast.

    The bounds of this package accept it in place of a ``Coupling``; a bridge does not. The fields
    are kept as read-only arrays.

    Attributes:
        stiffness: K in N/m, finite and > 0.
        damping: B in N s/m, finite and >= 0.

    Raises:
        CouplingError: A value is not finite or out of range, or the shapes do not broadcast.
    """

    stiffness: ArrayLike
    damping: ArrayLike = 0.0

    def __post_init__(self) -> None:
        arrays = {}
        for field in fields(self):
            name = f"coupling {field.name}"
            value = getattr(self, field.name)
            array = checked(name, value, positive=field.name == "stiffness").copy()
            array.flags.writeable = False
            object.__setattr__(self, field.name, array)
            arrays[field.name] = array
        together(**arrays)


def spring_and_damper(
    coupling: Coupling | CouplingGrid,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns K and B in translation, or of a grid, broadcast to one shape.

    Raises:
        CouplingError: The coupling has a wrong type, or a value is out of range.
    """
    if isinstance(coupling, CouplingGrid):
        arrays = {field.name: getattr(coupling, field.name) for field in fields(coupling)}
        stiffness, damping = together(**arrays)
        return stiffness, damping
    if not isinstance(coupling, Coupling):
        raise CouplingError(
            f"coupling is {shown(coupling)}; it must be a Coupling or a CouplingGrid"
        )
    # Coupling has no upper limit and accepts fractions.Fraction, so convert and check here
    return (
        checked("coupling stiffness", float(coupling.stiffness), positive=True),
        checked("coupling damping", float(coupling.damping)),
    )


def single(coupling: Coupling) -> tuple[float, float]:
    """Returns K and B in translation of one coupling.

    Raises:
        CouplingError: The argument is not a ``Coupling``, or a value is out of range.
    """
    if not isinstance(coupling, Coupling):
        raise CouplingError(f"coupling is {shown(coupling)}; it must be one Coupling")
    stiffness, damping = spring_and_damper(coupling)
    return float(stiffness), float(damping)


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
        delay: d in ticks.
        filter_time: τ in s.
        discretization: Rule for the damper and its filter.
    """

    stiffness: NDArray[np.float64]
    damping: NDArray[np.float64]
    period: float
    delay: float
    filter_time: float
    discretization: Discretization

    @classmethod
    def validated(
        cls,
        coupling: Coupling | CouplingGrid,
        period: float,
        discretization: Discretization,
        delay: float,
        filter_time: float,
        count: int = 1,
    ) -> SampledLaw:
        """Validates the arguments of a bound for n (``count``) ticks per sample.

        Raises:
            CouplingError: An argument is out of range, or the discretization is unknown.
        """
        period = scalar("period", period, "s", positive=True)
        filter_time = scalar("filter time", filter_time, "s")
        delay = late_by(delay, count)
        stiffness, damping = spring_and_damper(coupling)
        one_of("discretization", discretization, DISCRETIZATIONS)
        return cls(stiffness, damping, period, delay, filter_time, discretization)

    @property
    def rings(self) -> bool:
        """True for Tustin's damper without low-pass, whose gain is infinite at Nyquist."""
        return self.discretization == "tustin" and self.filter_time == 0

    @property
    def finite(self) -> SampledLaw:
        """The law by the backward difference if it rings: equal for B = 0, finite for B > 0."""
        return self._replace(discretization="backward") if self.rings else self

    def transfer(self, theta: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Returns C at angles θ in rad, whose axes are those of the coupling and further ones."""
        more = (1,) * (theta.ndim - self.stiffness.ndim)
        k, b = (value.reshape(value.shape + more) for value in (self.stiffness, self.damping))
        return coupling_transfer(k, b, self.period, theta, self.discretization, self.filter_time)


# Lossless transmission line in place of the spring and damper.
#
# The waves p = (F + Z v)/2 run to the tool and q = (F − Z v)/2 back to the device. Each needs one
# sample from end to end, n = 2 for both ways. The line can be terminated at the device in two ways:
#
#     software    v_k = (h_k − h_{k−1})/T, and F_k = Z v_k + 2 q_k is sent to the device
#     device      v_k = (h_{k+1} − h_k)/T, and F_k = 2 q_k: the physical damping b terminates it

Termination = Literal["software", "device"]
"""Element that terminates the line at the device."""

MAX_TRIP = 1_000_000
"""Largest round trip in samples. Beyond it rounding no longer separates nθ/2 from a pole."""


def transmission_line_spectrum(
    impedance: ArrayLike,
    period: float,
    frequency: ArrayLike,
    *,
    terminated_by: Termination = "device",
    round_trip: int = 2,
) -> NDArray[np.float64]:
    """Returns the device damping that a line in front of a wall requires at each frequency.

        software    H = (Z/T)(1 − z⁻¹)(1 + z⁻ⁿ)/(1 − z⁻ⁿ)     b(θ) = Z sin θ cot(nθ/2)
        device      H = (2Z/T)(1 − z⁻¹) z^{1−n}/(1 − z⁻ⁿ)     b(θ) = Z

    For n = 2 the software termination gives b(θ) = Z cos θ.

    Terminated by the device, the line is a wave port that counts the hand's work exactly. The
    reason is that the force is held and v is the mean velocity of the hold. With b >= Z it is
    passive for any hand and any discrete-time passive environment. Terminated in software, the line
    delays the force on both sides. No damping then suffices for every passive environment; the
    spectrum is that of a wall.

    Args:
        impedance: Z in N s/m, finite and > 0, shape S.
        period: T in s, finite and > 0.
        frequency: ω in rad/s, 0 < ω <= π/T, shape F.
        terminated_by: Element that terminates the line at the device.
        round_trip: n, whole samples there and back, >= 1; 2 for one sample each way. In software
            the supremum is 2 Z for n = 1, Z for n = 2, and infinite for larger n.

    Returns:
        b in N s/m, shape S + F; may be negative in software.

    Raises:
        CouplingError: An argument is out of range or unknown.

    References:
        Brown & Colgate 1997, section 6 (named as future work); Niemeyer & Slotine 1991 (waves);
        Colgate & Schenkel 1997 (the bound).
    """
    period = scalar("period", period, "s", positive=True)
    theta = angles(frequency, period)
    one_of("termination", terminated_by, ("software", "device"))
    trip = whole("round trip", round_trip, least=1, most=MAX_TRIP)
    z = checked("impedance", impedance, "N s/m", positive=True)
    z = z.reshape(z.shape + (1,) * theta.ndim)
    if terminated_by == "device":
        return np.asarray(z * np.ones_like(theta))
    # at multiples of 2π/n, sin θ / tan(nθ/2) has a pole, or a limit at Nyquist with even n
    phase = trip * theta / 2
    turns = np.rint(phase / np.pi)
    is_pole = np.abs(phase - turns * np.pi) < 1e-12
    with np.errstate(divide="ignore"):
        ratio = np.sin(theta) / np.tan(phase)
    at_pole = np.where(theta == np.pi, -2 / trip, np.inf)
    return np.asarray(z * np.where(is_pole, at_pole, ratio))


def transmission_line_stiffness(
    device_damping: ArrayLike, period: float, *, round_trip: int = 2
) -> float | NDArray[np.float64]:
    """Returns the largest static stiffness in N/m of a passive line that the device terminates.

        K = 2 b/(n T),  in front of a wall

    With one sample each way K is b/T, **half** of the 2 b/T of a spring and damper. Only a line
    that returns within one sample, which is a plain spring, reaches 2 b/T. A line gains no
    stiffness. Arguments and errors are those of ``transmission_line_spectrum``, with b in N s/m in
    place of Z.

    References:
        Brown & Colgate 1997, section 6 (future work).
    """
    period = scalar("period", period, "s", positive=True)
    trip = whole("round trip", round_trip, least=1, most=MAX_TRIP)
    impedance = checked("device damping", device_damping, "N s/m", positive=True)
    return plain(np.asarray(2 * impedance / (trip * period)))
