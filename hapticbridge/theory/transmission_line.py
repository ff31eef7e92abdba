"""Lossless transmission line in place of the spring and damper.

The waves p = (F + Z v)/2 run to the tool and q = (F − Z v)/2 back to the device. Each needs one
sample from end to end, n = 2 for both ways. The line can be terminated at the device in two ways:

    software    v_k = (h_k − h_{k−1})/T, and F_k = Z v_k + 2 q_k is sent to the device
    device      v_k = (h_{k+1} − h_k)/T, and F_k = 2 q_k: the physical damping b terminates it
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.theory.transfer import angles, checked, one_of, plain, scalar, whole

Termination = Literal["software", "device"]
"""Element that terminates the line at the device."""

LONGEST_TRIP = 1_000_000
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
    delays. As for a delayed coupling, no damping then suffices for every passive environment; the
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
    trip = whole("round trip", round_trip, least=1, most=LONGEST_TRIP)
    z = checked("impedance", impedance, "N s/m", positive=True)
    z = z.reshape(z.shape + (1,) * theta.ndim)
    if terminated_by == "device":
        return np.asarray(z * np.ones_like(theta))
    # at multiples of 2π/n, sin θ / tan(nθ/2) has a pole, or a limit at Nyquist with even n
    phase = trip * theta / 2
    turns = np.rint(phase / np.pi)
    is_pole = np.abs(phase - turns * np.pi) < 1e-12
    with np.errstate(divide="ignore"):
        share = np.sin(theta) / np.tan(phase)
    at_pole = np.where(theta == np.pi, -2 / trip, np.inf)
    return np.asarray(z * np.where(is_pole, at_pole, share))


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
    trip = whole("round trip", round_trip, least=1, most=LONGEST_TRIP)
    impedance = checked("device damping", device_damping, "N s/m", positive=True)
    return plain(np.asarray(2 * impedance / (trip * period)))
