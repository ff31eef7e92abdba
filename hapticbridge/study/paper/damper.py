"""Equations (6) and (7): what the two discretisations ask of the device."""

from __future__ import annotations

import numpy as np

from hapticbridge.coupling import Coupling
from hapticbridge.study.paper.check import Check
from hapticbridge.study.paper.coupling import (
    COUPLING,
    HERTZ,
    NYQUIST_HZ,
    PERIOD,
    THETA,
    B,
    K,
    spring_with,
)
from hapticbridge.study.paper.drawing import panels
from hapticbridge.study.paper.energy_identity import identity_residual
from hapticbridge.study.paper.in_mujoco import wall_limit
from hapticbridge.study.paper.section import Curve, Section, Table
from hapticbridge.theory.bounds import maximum_stiffness
from hapticbridge.theory.sampled_loop import SampledLoop, stability_limit
from hapticbridge.theory.spectrum import damping_spectrum

SHORT = 1e-3
"""How far before Nyquist (7) is looked at, in rad."""

STIFF, LIGHT = Coupling(4000.0, 0.5, 0.0, 0.0), 0.05
"""A coupling and a mass in kg with which Tustin's damper needs far more than (6)."""


def backward_difference() -> Section:
    """Walks through (6)."""
    omega = THETA / PERIOD
    figure, (spectrum, largest) = panels(1, height=4.0, columns=2)
    for damping in (0.0, 0.5, 1.0, 2.0):
        curve = damping_spectrum(spring_with(damping), PERIOD, omega)
        spectrum.plot(HERTZ, curve, label=f"B = {damping:g} N s/m")
        spectrum.plot(NYQUIST_HZ, K * PERIOD / 2 + damping, "ko", ms=4)
    spectrum.plot([], [], "ko", ms=4, label="KT/2 + B")
    spectrum.set_xlabel("frequency (Hz)")
    spectrum.set_ylabel("device damping needed (N s/m)")
    spectrum.legend(fontsize="small", loc="upper left")
    device = np.geomspace(0.5, 20, 50)
    for rate in (500, 1000, 2000, 4000):
        largest.loglog(device, maximum_stiffness(device, 1 / rate), label=f"{rate} Hz")
    largest.set_xlabel("device damping b (N s/m)")
    largest.set_ylabel("largest K for B = 0 (N/m)")
    largest.legend(fontsize="small")

    bound = K * PERIOD / 2 + B
    loops = [
        Check(
            equation="(6)",
            quantity=f"wall, T = {period * 1e3:g} ms: b at the limit of stability",
            route="time-domain loop with the worst hand, bisection",
            expected=K * period / 2 + B,
            got=stability_limit(SampledLoop(COUPLING, period)),
            unit="N s/m",
            tolerance=1e-3,
        )
        for period in (5e-4, 1e-3, 2e-3)
    ]
    dampings = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0)
    return Section(
        equation="(6)",
        title="Backward difference: b > KT/2 + B",
        formulas=(
            "b > (T/2) [K² + 2(1 − cos ωT)(B/T)(K + B/T)] / (K + 2B/T)"
            " &emsp;⟹&emsp; b > KT/2 + B&emsp;(6)",
        ),
        paragraphs=(
            "Put (4) into (2): the need rises with frequency and is largest at Nyquist. The worst "
            "hand there holds nothing: the device's own damper alone must keep the loop stable.",
            "(6) is not only necessary. An exact identity of the sampled energies shows that it "
            "is sufficient for any passive hand, also a nonlinear one, and in several dimensions "
            "as the matrix inequality b ⪰ KT/2 + B. The identity is evaluated here on random "
            "motion in three dimensions.",
            "With MuJoCo in the loop the same hand holds a heavy free body through the coupling "
            "actuators under the <code>discrete</code> integrator: the limit is the paper's.",
        ),
        curves=(
            Curve(
                "backward_difference",
                f"Left: the need over frequency, K = {K:g} N/m, T = 1 ms. Right: what a device "
                "allows; doubling the rate doubles K.",
                figure,
            ),
        ),
        checks=(
            Check(
                equation="(6)",
                quantity="b = KT/2 + B",
                route="frequency sweep of (2)",
                expected=bound,
                got=float(np.max(damping_spectrum(COUPLING, PERIOD, omega))),
                unit="N s/m",
                tolerance=1e-9,
            ),
            *loops,
            Check(
                equation="(6)",
                quantity="sufficiency: residual of the energy identity",
                route="random motion, K, B and b in three dimensions",
                expected=0.0,
                got=identity_residual(PERIOD),
                tolerance=1e-12,
            ),
            Check(
                equation="(6)",
                quantity="heavy tool, b at the limit of stability",
                route="MuJoCo in the loop, bisection",
                expected=bound,
                got=wall_limit(COUPLING, PERIOD),
                unit="N s/m",
                tolerance=2e-3,
            ),
        ),
        table=Table(
            ("device damping b (N s/m)", *(f"{value:g}" for value in dampings)),
            (
                (
                    "largest K at 1 kHz, B = 0 (N/m)",
                    *(f"{float(maximum_stiffness(value, PERIOD)):g}" for value in dampings),
                ),
            ),
        ),
    )


def tustin() -> Section:
    """Walks through (7)."""
    omega = THETA / PERIOD
    figure, (axes,) = panels(1, height=4.0)
    for damping in (0.0, 0.5, 1.0, 2.0):
        curve = damping_spectrum(spring_with(damping), PERIOD, omega, discretization="tustin")
        axes.semilogy(HERTZ, np.where(np.isfinite(curve), curve, np.nan), label=f"B = {damping:g}")
    axes.axhline(K * PERIOD / 2 + B, color="grey", ls=":", label="(6) for B = 2 N s/m")
    axes.set_ylim(0.05, 100)
    axes.set_xlabel("frequency (Hz)")
    axes.set_ylabel("device damping needed (N s/m)")
    axes.legend(fontsize="small", loc="upper left")

    own = K * PERIOD / 2 + B
    gamma = (K * PERIOD - 2 * B) / (K * PERIOD + 2 * B)
    theta = THETA[:-1]
    closed = own * (1 + 2 * gamma * np.cos(theta) + gamma**2) / (2 * (1 + np.cos(theta)))
    swept = damping_spectrum(COUPLING, PERIOD, theta / PERIOD, discretization="tustin")
    return Section(
        equation="(7)",
        title="Tustin: no device damping is enough",
        formulas=("b > [ (KT)² + 4B² tan²(ωT/2) ] / [ 2(KT + 2B) ]&emsp;(7)",),
        paragraphs=(
            "Put (5) into (2). At low frequency the need is small, (KT)²/(2(KT + 2B)); towards "
            "Nyquist it grows without limit as soon as B is not 0. So Tustin's damper is not used, "
            "although it looks like the better approximation.",
        ),
        curves=(
            Curve(
                "tustin", f"The need over frequency, K = {K:g} N/m, T = 1 ms; B in N s/m.", figure
            ),
        ),
        checks=(
            Check(
                equation="(7)",
                quantity="largest difference from the closed form in γ, relative",
                route="frequency sweep of (2) with (5)",
                expected=0.0,
                got=float(np.max(np.abs(swept / closed - 1))),
                tolerance=1e-6,
            ),
            Check(
                equation="(7)",
                quantity="b at ω → 0, (KT)²/(2(KT + 2B))",
                route="frequency sweep at 0.016 Hz",
                expected=(K * PERIOD) ** 2 / (2 * (K * PERIOD + 2 * B)),
                got=float(damping_spectrum(COUPLING, PERIOD, 0.1, discretization="tustin")),
                unit="N s/m",
                tolerance=1e-6,
            ),
            Check(
                equation="(7)",
                quantity=f"b at {SHORT:g} rad before Nyquist, 8B²/((KT + 2B)(π − ωT)²)",
                route="frequency sweep, against the growth of (7) without limit",
                expected=8 * B**2 / ((K * PERIOD + 2 * B) * SHORT**2),
                got=float(
                    damping_spectrum(
                        COUPLING, PERIOD, (np.pi - SHORT) / PERIOD, discretization="tustin"
                    )
                ),
                unit="N s/m",
                # the next term of tan² is 1/6 of SHORT², the spring's share 1/64
                tolerance=1e-6,
            ),
            Check(
                equation="(7)",
                quantity=f"mass of {LIGHT:g} kg behind it: b at the limit, ten times (6) and more",
                route="time-domain loop with the worst hand, bisection",
                expected=10 * (STIFF.stiffness * PERIOD / 2 + STIFF.damping),
                got=stability_limit(
                    SampledLoop(STIFF, PERIOD, mass=LIGHT, discretization="tustin")
                ),
                unit="N s/m",
                tolerance=0.0,
                relation="at least",
            ),
            Check(
                equation="(7)",
                quantity="B = 0: b = KT/2, as for (6)",
                route="time-domain loop, bisection",
                expected=K * PERIOD / 2,
                got=stability_limit(SampledLoop(spring_with(0.0), PERIOD, discretization="tustin")),
                unit="N s/m",
                tolerance=1e-3,
            ),
        ),
    )
