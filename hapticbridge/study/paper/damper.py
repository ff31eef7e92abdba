"""Equations (6) and (7): what the two discretisations ask of the device."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hapticbridge.passivity import (
    SampledLoop,
    damping_spectrum,
    maximum_stiffness,
    minimum_damping,
    stability_limit,
)
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
from hapticbridge.study.paper.in_mujoco import wall_limit
from hapticbridge.study.paper.section import Curve, Section, Table


def _identity_residual() -> float:
    """Energy of the device side minus that of the right-hand side, relative, for random motion."""
    rng = np.random.default_rng(6)
    count, size = 200, 3
    h, x = rng.normal(size=(2, count + 2, size))
    x[0] = x[1] - rng.normal(size=size)

    def symmetric() -> NDArray[np.float64]:
        root = rng.normal(size=(size, size))
        return np.asarray(root @ root.T, dtype=np.float64)

    k, b, device = symmetric() * 1e3, symmetric(), symmetric() * 2
    period = PERIOD

    def square(v: NDArray[np.float64], matrix: NDArray[np.float64]) -> float:
        return float(np.sum((v @ matrix) * v))

    d, moved = np.diff(h, axis=0, prepend=0.0), np.diff(x, axis=0, prepend=0.0)
    e, change = h - x, d - moved
    force = e @ k + change @ b / period
    n = count
    inner = slice(1, n + 1)
    left = float(np.sum(force[1 : n + 1] * d[2 : n + 2])) + square(d[1 : n + 2], device / period)
    right = (
        float(np.sum(force[inner] * moved[inner]))
        + 0.5 * square(moved[inner], k + b / period)
        + 0.5 * square(change[0:n] + d[inner], b / period)
        + square(d[inner], (device - b) / period - k / 2)
        + 0.5 * square(e[n] + d[n + 1], k)
        + 0.5 * square(change[n] + d[n + 1], b / period)
        + square(d[n + 1], device / period - k / 2 - b / (2 * period))
        - 0.5 * square(e[0], k)
        - float(force[0] @ d[1])
        - 0.5 * square(change[0], b / period)
    )
    return abs(left - right) / abs(left)


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
            "(6) is not only necessary. An exact identity of the sampled energies shows that it is "
            "sufficient for any passive hand, also a nonlinear one, and in several dimensions as "
            "the "
            "matrix inequality b ⪰ KT/2 + B. The identity is evaluated here on random motion in "
            "three dimensions.",
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
            Check(
                equation="(6)",
                quantity="b at 250 Hz",
                route="the closed form above, against (2)",
                expected=float(_backward_at(np.pi / 2)),
                got=float(damping_spectrum(COUPLING, PERIOD, np.pi / 2 / PERIOD)),
                unit="N s/m",
                tolerance=1e-9,
            ),
            *loops,
            Check(
                equation="(6)",
                quantity="sufficiency: residual of the energy identity",
                route="random motion, K, B and b in three dimensions",
                expected=0.0,
                got=_identity_residual(),
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


def _backward_at(theta: float) -> float:
    rate = B / PERIOD
    top = K**2 + 2 * (1 - np.cos(theta)) * rate * (K + rate)
    return float(PERIOD / 2 * top / (K + 2 * rate))


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
                quantity="b at Nyquist",
                route="minimum_damping",
                expected=np.inf,
                got=float(minimum_damping(COUPLING, PERIOD, discretization="tustin")),
                unit="N s/m",
                tolerance=0.0,
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
