"""Device, hand, coupling and tool in the time domain, as an independent check of the bounds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.arguments import LARGEST, SMALLEST, shown
from hapticbridge.coupling import Coupling
from hapticbridge.errors import CouplingError
from hapticbridge.kernel.jit import compiled
from hapticbridge.theory.spectrum import needed_for_fixed_environment
from hapticbridge.theory.transfer import (
    DISCRETIZATIONS,
    Discretization,
    angles,
    coupling_transfer,
    delayed_by,
    one_of,
    scalar,
    single,
    whole,
)
from hapticbridge.theory.virtual_mass import Integrator, force_delay

# Compiled time-domain run of a sampled loop

KICK = 1e-3
"""First displacement of the handle in m. The loop is linear, so it only scales the motion."""

HUGE = 1e100
"""Force in N at which a run counts as diverged and ends."""


class _Recursion(NamedTuple):
    """Constants of the recursion of ``SampledLoop``.

    Those named c and a belong to the damper, p, q and r to the hand; ``integrator`` is given as
    samples of delay.
    """

    stiffness: float
    c: float
    a: float
    inverse_mass: float
    integrator: int
    delay: int
    period: float
    p: float
    q: float
    r: float


@compiled
def run(recursion: _Recursion, force: _Array, handle: _Array, tool: _Array) -> int:
    """Fills the arrays with f_k, h_k and x_k and returns the number of samples taken.

    A run that diverges in its last sample
    returns one sample fewer, so that a length below the capacity always means divergence.
    """
    stiffness, c, a, inverse_mass, integrator, delay, period, p, q, r = recursion
    h, x, v, stretch, damper, f = KICK, 0.0, 0.0, 0.0, 0.0, 0.0
    held_before, device_velocity = 0.0, 0.0
    step_compliance = period * period * inverse_mass if integrator == 0 else 0.0
    for k in range(force.size):
        if k > 0:
            x += period * v
        if integrator == 2:
            v += period * inverse_mass * f
        f = (stiffness + c) * (h - x) - c * stretch + a * damper
        f /= 1 + (stiffness + c) * step_compliance
        if integrator != 2:
            v += period * inverse_mass * f
        x += step_compliance * f
        stretch = h - x
        damper = f - stiffness * stretch
        force[k], handle[k], tool[k] = f, h, x
        if not abs(f) < HUGE:
            return k + 1 if k + 1 < force.size else k
        held = -force[k - delay] if k >= delay else 0.0
        device_velocity = p * device_velocity + q * held + r * held_before
        held_before = held
        h += period * device_velocity
    return int(force.size)


# Passive hand that makes a sampled loop unstable first


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


_Array = NDArray[np.float64]

GRID_POINTS = 2000
"""Number of angles in each search grid for the worst frequency: one even in θ, one even in log
θ."""

LOWEST_ANGLE = 1e-2
"""Smallest θ in rad of a worst hand. Below it the hand would be a mass of 2 b T/θ². With a share δ
of the damping missing, such a loop grows by only δ θ²/4 per sample. A supremum at θ → 0 is missed
by a share of (d² + d) θ²/6: 0.05 % at a delay of 5 samples."""

FLATNESS = 1e-12
"""Relative difference between spectrum values that counts as rounding, without unit."""


@dataclass(frozen=True, slots=True, eq=False)
class LoopMotion:
    """Motion of a loop at samples 0 … N − 1, or fewer if it diverged.

    Attributes:
        force: f_k on the tool in N.
        handle: h_k in m.
        tool: x_k in m.
    """

    force: _Array
    handle: _Array
    tool: _Array


@dataclass(frozen=True, slots=True)
class SampledLoop:
    """A coupling between a device with its hand and a wall or a point mass.

        f_k = K e_k + g_k,    e_k = h_k − x_k,    g_k = a g_{k−1} + c (e_k − e_{k−1})
        backward:  a = τ/(T + τ),            c = B/(T + τ)
        tustin:    a = (τ − T/2)/(τ + T/2),  c = B/(τ + T/2)

    The device receives −f_{k−d}, held for a period. The mass moves by one of

        implicit        v_k = v_{k−1} + (T/m) f_k       x_k = x_{k−1} + T v_k
        semi_implicit   v_{k+1} = v_k + (T/m) f_k       x_{k+1} = x_k + T v_{k+1}
        explicit        v_k = v_{k−1} + (T/m) f_{k−1}   x_k = x_{k−1} + T v_{k−1}

    Attributes:
        coupling: K and B in translation.
        period: T in s, finite and > 0.
        mass: m in kg, finite and > 0; None for a wall, x = 0.
        integrator: Integration scheme of the mass.
        discretization: Discretization of the damper.
        delay: d, whole samples from the coupling's force to the device, 0 to 50.
        filter_time: τ in s of a first-order low-pass behind the damper, >= 0.

    Raises:
        CouplingError: A value is out of range or unknown.

    References:
        Brown & Colgate 1997, eqs. (4), (5), (15), (17).
    """

    coupling: Coupling
    period: float
    mass: float | None = None
    integrator: Integrator = "implicit"
    discretization: Discretization = "backward"
    delay: int = 0
    filter_time: float = 0.0

    def __post_init__(self) -> None:
        single(self.coupling)
        scalar("period", self.period, "s", positive=True)
        scalar("filter time", self.filter_time, "s")
        if self.mass is not None:
            scalar("mass", self.mass, "kg", positive=True)
        delayed_by(self.delay)
        force_delay(self.integrator)
        one_of("discretization", self.discretization, DISCRETIZATIONS)

    def response(self, frequency: ArrayLike) -> NDArray[np.complex128]:
        """Returns the force response at the device, H = C e^{−jdθ} / (1 − λ C e^{j(1−n)θ}).

        λ = T²/(4 m sin²(θ/2)), 0 for a wall; n = 0, 1, 2 samples from force to position.

        Args:
            frequency: ω in rad/s, 0 < ω <= π/T, any shape.

        Returns:
            Force per displacement of the handle in N/m, shaped like the frequency.

        Raises:
            CouplingError: A frequency is out of range.
        """
        theta = angles(frequency, self.period)
        transfer = coupling_transfer(
            np.asarray(self.coupling.stiffness),
            np.asarray(self.coupling.damping),
            self.period,
            theta,
            self.discretization,
            self.filter_time,
        )
        if self.mass is not None:
            compliance = self.period**2 / (4 * self.mass * np.sin(theta / 2) ** 2)
            lead = np.exp(1j * (1 - force_delay(self.integrator)) * theta)
            transfer = transfer / (1 - compliance * transfer * lead)
        return np.asarray(transfer * np.exp(-1j * self.delay * theta), dtype=np.complex128)

    def damping_spectrum(self, frequency: ArrayLike) -> _Array:
        """Returns the device damping in N s/m required at each frequency ω in rad/s, for any hand.

            b(ω) = (T/2) Re{(1 − e^{−jωT}) H} / (1 − cos ωT),    0 < ω <= π/T

        The loop requires the supremum, provided that the tool is stable behind a fixed handle
        (``minimum_mass``).

        References:
            Colgate & Schenkel 1997.
        """
        theta = angles(frequency, self.period)
        return needed_for_fixed_environment(self.response(frequency), self.period, theta)

    def worst_frequency(self) -> float:
        """Returns ω in rad/s at which ``damping_spectrum`` is largest, >= 0.01/T.

        Of equal maxima, as for a plain spring on a wall, the highest frequency is returned, because
        there a loop grows fastest.
        """
        # The grid of ``wall_supremum`` resolves only the ripples of a delay. A tool on its spring
        # also resonates, at any frequency and the more sharply the lower its damping. This grid
        # is therefore fine throughout.
        even = np.linspace(LOWEST_ANGLE, np.pi, GRID_POINTS)
        theta = np.union1d(even, np.geomspace(LOWEST_ANGLE, np.pi, GRID_POINTS))
        needed = self.damping_spectrum(theta / self.period)
        most = needed.max()
        best = int(np.flatnonzero(needed >= most - FLATNESS * abs(most))[-1])
        if best in {0, theta.size - 1}:
            return float(theta[best] / self.period)
        from scipy import optimize  # noqa: PLC0415 - 0.3 s, for this search alone

        found = optimize.minimize_scalar(
            lambda angle: -float(self.damping_spectrum(angle / self.period)),
            bounds=(theta[best - 1], theta[best + 1]),
            method="bounded",
            options={"xatol": 1e-12},
        )
        return float(found.x / self.period)

    def simulate(self, hand: WorstHand | None, samples: int) -> LoopMotion:
        """Runs the loop from a handle displaced by 1 mm.

        Args:
            hand: Device and hand with the loop's period; None fixes the handle.
            samples: Length of the run in samples, >= 1. A run that exceeds 1e100 N ends early.

        Raises:
            CouplingError: The periods differ, or samples is not a whole number >= 1.
        """
        if hand is not None and not isinstance(hand, WorstHand):
            raise CouplingError(f"hand is {shown(hand)}; it must be a WorstHand or None")
        if hand is not None and hand.period != self.period:
            raise CouplingError(
                f"the hand's period is {hand.period:g} s, the loop's {self.period:g} s; "
                "they must be equal"
            )
        force, handle, tool = np.zeros((3, whole("run", samples, least=1)))
        step = self.period if self.discretization == "backward" else self.period / 2
        recursion = _Recursion(
            self.coupling.stiffness,
            self.coupling.damping / (step + self.filter_time),
            (self.filter_time - (self.period - step)) / (step + self.filter_time),
            0.0 if self.mass is None else 1 / self.mass,
            force_delay(self.integrator),
            self.delay,
            self.period,
            *((0.0, 0.0, 0.0) if hand is None else hand.recursion()),
        )
        done = run(recursion, force, handle, tool)
        return LoopMotion(force[:done], handle[:done], tool[:done])


# Stability limit of a sampled loop from time-domain runs

SAMPLES = 60_000
"""Length of a run in samples over which a stable loop must decay. Two windows of a fifth of it are
compared, which detects growth of 1e-9 per sample. More samples locate the limit more closely and
take longer."""

DECAYED = 1e-9
"""Force relative to its largest value, without unit, below which it counts as decayed. The value
lies above rounding and far below the amplitude of a marginal mode."""

LEAKAGE = 1e-5
"""Relative difference in energy, without unit, between two windows of a steady oscillation under
Hann's window, for 0.03 rad per sample and more. Without this allowance a tool on an undamped spring
would count as stable by chance. Larger values shift limits at low frequency."""

TOLERANCE = 1e-5
"""Relative width at which the bisection ends, without unit: a hundredth of the accuracy to which
the bounds are checked."""

STEP = 10.0
"""Factor between trial values that enclose a threshold, without unit. Powers of ten keep the search
independent of the predicted number that it confirms."""


def stability_limit(loop: SampledLoop) -> float:
    """Returns the smallest device damping at which the loop with its worst hand is stable.

    A run is stable if its force decays. Powers of ten around K T + B enclose the limit, then
    bisection narrows it. The theory supplies only the hand, which is tuned to ``worst_frequency``
    for every b.

    Args:
        loop: Coupling and environment.

    Returns:
        b in N s/m. 0 if the loop requires none. inf if the tool is unstable behind a fixed handle,
        or for an unfiltered Tustin damper against a wall, whose own pole at Nyquist is undamped.
    """
    is_ringing = loop.discretization == "tustin" and loop.filter_time == 0
    if is_ringing and loop.mass is None and loop.coupling.damping > 0:
        return float("inf")
    if loop.mass is not None and not decays(loop.simulate(None, SAMPLES).force, SAMPLES):
        return float("inf")
    frequency = loop.worst_frequency()
    response = complex(loop.response(frequency))

    def is_stable(damping: float) -> bool:
        hand = WorstHand(damping, frequency, loop.period, response)
        return decays(loop.simulate(hand, SAMPLES).force, SAMPLES)

    size = loop.coupling.stiffness * loop.period + loop.coupling.damping
    start = float(np.clip(10.0 ** np.floor(np.log10(size)), SMALLEST, LARGEST))
    return threshold(is_stable, start, TOLERANCE)


def threshold(holds: Callable[[float], bool], start: float, tolerance: float) -> float:
    """Returns the value above which a condition holds.

    Args:
        holds: Condition at a positive value; false below the threshold, true above.
        start: First trial value, > 0; steps by the factor ``STEP`` enclose the threshold.
        tolerance: Relative width at which the bisection ends.

    Returns:
        The middle of the last bracket; 0 if the condition holds down to 1e-30, inf if it fails up
        to 1e30.
    """
    lower = upper = float(start)
    does_hold = holds(start)
    while holds(lower) if does_hold else not holds(upper):
        lower, upper = (lower / STEP, lower) if does_hold else (upper, upper * STEP)
        if lower < SMALLEST:
            return 0.0
        if upper > LARGEST:
            return float("inf")
    while upper - lower > tolerance * upper:
        middle = (lower + upper) / 2
        lower, upper = (lower, middle) if holds(middle) else (middle, upper)
    return (lower + upper) / 2


def decays(force: NDArray[np.float64], samples: int, floor: float = 0.0) -> bool:
    """Returns whether a force, or a signal linear in it, fell from one late window to the next.

    A signal with fewer than the expected ``samples`` counts as diverged; one below ``floor`` in N
    counts as zero.
    """
    if force.size < samples:
        return False
    width = samples // 5
    late, last = force[-2 * width : -width], force[-width:]
    # a decayed force consists of rounding, which neither grows nor falls
    if np.abs(last).max() <= max(DECAYED * np.abs(force).max(), floor):
        return True
    # without Hann's window, a fraction of a cycle at its ends would outweigh a small growth
    weight = np.hanning(width) / np.abs(late).max()
    fallen = np.square(last * weight).sum() / np.square(late * weight).sum()
    return bool(fallen < 1 - LEAKAGE)
