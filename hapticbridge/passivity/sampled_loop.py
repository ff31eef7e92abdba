"""Device, hand, coupling and tool in the time domain, as an independent check of the bounds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.arguments import shown
from hapticbridge.coupling import Coupling
from hapticbridge.errors import CouplingError
from hapticbridge.passivity.grid import delayed_by, one_of, scalar, single, whole
from hapticbridge.passivity.recursion import run
from hapticbridge.passivity.spectrum import needed_for_fixed_environment
from hapticbridge.passivity.transfer import (
    DISCRETIZATIONS,
    Discretization,
    angles,
    coupling_transfer,
)
from hapticbridge.passivity.virtual_mass import Integrator, force_delay
from hapticbridge.passivity.worst_hand import WorstHand

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
            share = self.period**2 / (4 * self.mass * np.sin(theta / 2) ** 2)
            lead = np.exp(1j * (1 - force_delay(self.integrator)) * theta)
            transfer = transfer / (1 - share * transfer * lead)
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
        done = run(
            self.coupling.stiffness,
            self.coupling.damping / (step + self.filter_time),
            (self.filter_time - (self.period - step)) / (step + self.filter_time),
            0.0 if self.mass is None else 1 / self.mass,
            force_delay(self.integrator),
            self.delay,
            self.period,
            *((0.0, 0.0, 0.0) if hand is None else hand.recursion()),
            force,
            handle,
            tool,
        )
        return LoopMotion(force[:done], handle[:done], tool[:done])
