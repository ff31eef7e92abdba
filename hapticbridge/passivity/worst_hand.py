"""Passive hand that makes a sampled loop unstable first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hapticbridge.arguments import LARGEST, shown
from hapticbridge.errors import CouplingError
from hapticbridge.passivity.grid import scalar
from hapticbridge.passivity.transfer import angles


@dataclass(frozen=True, slots=True)
class WorstHand:
    """Device and worst passive hand: a damper b beside a lossless line tuned to one frequency.

    A hand that absorbs no power can still turn the phase of the loop. The worst hand turns it until
    the loop closes on itself at θ0 = ω T. Device mass and hand together are then one of

        Z tanh(sT/2)   at θ:  +j Z tan(θ/2)   (like a mass)
        Z coth(sT/2)   at θ:  −j Z cot(θ/2)   (like a spring)

    Let H be the response at the device, force per displacement at θ0. The loop is marginal at θ0
    for

        b = (T/2)(Re H − cot(θ0/2) Im H)
        X = (T/2)(Im H + cot(θ0/2) Re H),    Z = X cot(θ0/2) if X >= 0, else Z = −X tan(θ0/2)

    The first line is the bound of Colgate & Schenkel at θ0. For a real H, as of a spring, Z = b
    cot²(θ0/2). At Nyquist Z = 0 and the damper alone is the worst hand.

    Under a zero-order hold the recursion is exact, σ = 1 for tanh and −1 for coth:

        (b + Z) v_k + σ (b − Z) v_{k−1} = F_k + σ F_{k−1},    h_{k+1} = h_k + T v_k

    F_k is the force held on the device from t_k on, v_k its velocity until t_{k+1}.

    Attributes:
        damping: b of the device in N s/m, finite and > 0.
        frequency: ω in rad/s to which the hand is tuned, 0 < ω <= π/T.
        period: T in s, finite and > 0.
        response: H(e^{jθ0}) in N/m; None for the line of a real H, Z = b cot²(θ0/2).

    Raises:
        CouplingError: A value is not finite or out of range.

    References:
        Colgate & Schenkel 1997 (the bound); Brown & Colgate 1997, eq. (2).
    """

    damping: float
    frequency: float
    period: float
    response: complex | None = None

    def __post_init__(self) -> None:
        scalar("device damping", self.damping, "N s/m", positive=True)
        scalar("period", self.period, "s", positive=True)
        if angles(self.frequency, self.period).ndim:
            raise CouplingError(f"frequency is {shown(self.frequency)}; it must be one number")
        if self.response is not None:
            if not isinstance(self.response, complex | float | int | np.number):
                raise CouplingError(f"response is {shown(self.response)}; it must be a number")
            if not abs(self.response) <= LARGEST**3:
                raise CouplingError(f"response is {self.response!r} N/m; it must be finite")

    @property
    def reactance(self) -> float:
        """Reactance X in N s/m at θ0: > 0 like a mass, < 0 like a spring."""
        theta = float(angles(self.frequency, self.period))
        # at Nyquist 1/tan(π/2) is 6e-17 instead of 0, which must not create a line
        cotangent = 0.0 if theta == np.pi else 1 / np.tan(theta / 2)
        if self.response is None:
            return float(self.damping * cotangent)
        imaginary = 0.0 if theta == np.pi else self.response.imag
        return float(self.period / 2 * (imaginary + cotangent * self.response.real))

    @property
    def impedance(self) -> float:
        """Characteristic impedance Z of the line in N s/m, >= 0."""
        theta = float(angles(self.frequency, self.period))
        if theta == np.pi:
            return 0.0
        slope = float(np.tan(theta / 2))
        return self.reactance / slope if self.reactance >= 0 else -self.reactance * slope

    def recursion(self) -> tuple[float, float, float]:
        """Returns (p, q, r) of v_k = p v_{k−1} + q F_k + r F_{k−1}, in 1 and m/(N s)."""
        b, z = self.damping, self.impedance
        if z == 0:
            return 0.0, 1 / b, 0.0  # the line's own pole at −1 cancels
        sign = 1.0 if self.reactance >= 0 else -1.0
        return sign * (z - b) / (b + z), 1 / (b + z), sign / (b + z)
