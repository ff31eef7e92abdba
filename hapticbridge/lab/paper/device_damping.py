"""Equations (2) and (4) to (7): device damping that a coupling requires."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray
from scipy import signal

from hapticbridge.coupling import Coupling
from hapticbridge.lab.paper.in_mujoco import (
    HEAVY,
    ImplicitMass,
    decays,
    hold,
    limit_of,
    wall_limit,
)
from hapticbridge.lab.paper.section import Check, Section, Table, explained, panels
from hapticbridge.theory.bounds import (
    maximum_stiffness,
    minimum_damping,
    wall_damping,
    worst_frequency,
)
from hapticbridge.theory.sampled_loop import SampledLoop, WorstHand, stability_limit
from hapticbridge.theory.spectrum import (
    damping_spectrum,
    damping_spectrum_of,
    needed_for_fixed_environment,
)
from hapticbridge.theory.transfer import angles, coupling_transfer

PERIOD = 1e-3
"""Period T in s."""

COUPLING = Coupling(stiffness=1000.0, damping=2.0, rotational_stiffness=0.0, rotational_damping=0.0)
K, B = COUPLING.stiffness, COUPLING.damping
TAU = 2e-3
"""Time constant of the low-pass in s: two samples, as a velocity filter may have."""

THETA = np.linspace(1e-3, np.pi, 4000)
NYQUIST_HZ = 0.5 / PERIOD
HERTZ = THETA / np.pi * NYQUIST_HZ

_Complex = NDArray[np.complex128]
_Real = NDArray[np.float64]


def spring_with(damping: float) -> Coupling:
    """Returns the walk's spring with another damper, B in N s/m."""
    return Coupling(K, damping, 0.0, 0.0)


def low_passed(z: _Complex) -> _Complex:
    """Transfer function C of a spring and a low-passed damper, in z."""
    return np.asarray(K + B * (1 - 1 / z) / (PERIOD + TAU * (1 - 1 / z)))


def spring_and_damper(z: _Complex) -> _Complex:
    """Transfer function C of the spring and damper (4), in z."""
    return np.asarray(K + B / PERIOD * (1 - 1 / z))


def at_limit(quantity: str, expected: float, loop: SampledLoop, *, route: str = "") -> Check:
    """Compares a damping in N s/m with that at which a sampled loop is at its limit."""
    return Check(
        quantity=quantity,
        route=f"time-domain loop{route}, bisection",
        expected=expected,
        got=stability_limit(loop),
        unit="N s/m",
        tolerance=1e-3,
    )


def any_coupling() -> Section:
    """Walks through (2).

    C is the transfer function from the distance of handle and tool to the force. The real part
    must be positive. The condition holds for every passive hand and every discrete-time passive
    environment, so nothing of the scene enters.

    It takes any C. A low-pass behind the damper lowers the need at high frequency. A device that
    gets its force a tick late, while the environment gets it at once, needs (1 − cos 2ωT) in place
    of (1 − cos ωT): four times as much for a spring.
    """
    omega = THETA / PERIOD
    curves = {
        "spring": damping_spectrum_of(lambda z: np.full_like(z, K), PERIOD, omega),
        "spring and damper (4)": damping_spectrum_of(spring_and_damper, PERIOD, omega),
        f"the same, damper low-passed with τ = {TAU * 1e3:g} ms": damping_spectrum_of(
            low_passed, PERIOD, omega
        ),
    }
    figure, (axes,) = panels(1, height=4.2)
    for name, curve in curves.items():
        axes.plot(HERTZ, curve, label=name)
    late = damping_spectrum_of(spring_and_damper, PERIOD, omega, delay=1)
    axes.plot(HERTZ, late, label="(4), the device one tick late")
    axes.set(xlabel="frequency (Hz)", ylabel="device damping needed (N s/m)", ylim=(0, 8))
    axes.legend(fontsize="small", loc="upper left")

    filtered = minimum_damping(COUPLING, PERIOD, filter_time=TAU)
    return Section(
        equation="(2)",
        title="The condition, for any coupling",
        formulas=(
            "b > (T/2)(1 − cos ωT) / Re{ (1 − e<sup>−jωT</sup>) / C(e<sup>jωT</sup>) }"
            "&emsp;for 0 &lt; ω ≤ π/T",
        ),
        paragraphs=explained(any_coupling.__doc__),
        name="any_coupling",
        caption=f"Condition (2) for four couplings, K = {K:g} N/m, B = {B:g} N s/m, T = 1 ms.",
        figure=figure,
        checks=(
            Check(
                quantity="spring alone, b = KT/2",
                route="frequency sweep",
                expected=K * PERIOD / 2,
                got=float(np.max(curves["spring"])),
                unit="N s/m",
            ),
            Check(
                quantity="low-passed damper, b = KT/2 + B T/(T + 2τ)",
                route="frequency sweep of C as a callable of z",
                expected=K * PERIOD / 2 + B * PERIOD / (PERIOD + 2 * TAU),
                got=float(np.max(damping_spectrum_of(low_passed, PERIOD, omega))),
                unit="N s/m",
            ),
            at_limit(
                "low-passed damper against a wall, b at the limit of stability",
                float(filtered),
                SampledLoop(COUPLING, PERIOD, filter_time=TAU),
            ),
            Check(
                quantity="spring, the device one tick late, b = 2KT for every environment",
                route="frequency sweep",
                expected=2 * K * PERIOD,
                got=float(
                    np.max(
                        damping_spectrum_of(lambda z: np.full_like(z, K), PERIOD, omega, delay=1)
                    )
                ),
                unit="N s/m",
                tolerance=1e-4,
            ),
            Check(
                quantity="spring and damper, the device one tick late, for every environment",
                route="frequency sweep, against T y³/(2 (y² − K²)), y = K + 2B/T",
                expected=PERIOD
                * (K + 2 * B / PERIOD) ** 3
                / (2 * ((K + 2 * B / PERIOD) ** 2 - K**2)),
                got=float(np.max(late)),
                unit="N s/m",
                tolerance=1e-4,
            ),
        ),
    )


def discretizations() -> Section:
    """Walks through (4) and (5).

    The backward difference (4) stays finite, K + 2B/T at Nyquist. Tustin's rule (5) keeps the
    phase of a spring and damper up to Nyquist, where it has a pole.
    """
    k, b = np.asarray(K), np.asarray(B)
    backward = coupling_transfer(k, b, PERIOD, THETA, "backward", 0.0)
    tustin = coupling_transfer(k, b, PERIOD, THETA, "tustin", 0.0)
    continuous = K + 1j * THETA / PERIOD * B
    figure, (size, phase) = panels(1, height=3.8, columns=2)
    named = (
        ("K + jωB, not sampled", continuous, "grey"),
        ("(4) backward difference", backward, "C0"),
        ("(5) Tustin", tustin, "C3"),
    )
    for name, transfer, colour in named:
        inner = slice(None, -1)  # (5) is undefined at Nyquist
        size.semilogy(HERTZ[inner], np.abs(transfer[inner]), color=colour, label=name)
        phase.plot(HERTZ[inner], np.degrees(np.angle(transfer[inner])), color=colour)
    size.set(ylabel="|C| (N/m)", ylim=(500, 1e5))
    size.legend(fontsize="small", loc="upper left")
    phase.set_ylabel("phase of C (degrees)")
    for axes in (size, phase):
        axes.set_xlabel("frequency (Hz)")

    middle = len(THETA) // 3
    turn = float(THETA[middle])
    samples = np.arange(400)
    handle = np.cos(turn * samples)
    # the last force of a long run of the difference equations, projected on the motion
    difference = B / PERIOD * np.diff(handle, prepend=0)
    by_tustin = np.zeros(len(handle))
    for i in range(1, len(handle)):
        by_tustin[i] = 2 * B / PERIOD * (handle[i] - handle[i - 1]) - by_tustin[i - 1]
    # the alternating answer to the start never decays: (5) has a pole at −1; averaging removes it
    smooth = (by_tustin[1:-1] + 0.5 * (by_tustin[:-2] + by_tustin[2:])) / (1 + np.cos(turn))
    base = np.stack([np.cos(turn * samples), -np.sin(turn * samples)], axis=1)
    fit, *_ = np.linalg.lstsq(base[1:], (K * handle + difference)[1:], rcond=None)
    fit_tustin, *_ = np.linalg.lstsq(base[2:-1], (K * handle[1:-1] + smooth)[1:], rcond=None)
    system = signal.dlti([K + B / PERIOD, -B / PERIOD], [1, 0], dt=PERIOD)
    return Section(
        equation="(4), (5)",
        title="Two ways to discretise the damper",
        formulas=(
            "C(z) = K + (B/T)(1 − z<sup>−1</sup>)&emsp;(4)",
            "C(z) = K + (2B/T)(1 − z<sup>−1</sup>)/(1 + z<sup>−1</sup>)&emsp;(5)",
        ),
        paragraphs=explained(discretizations.__doc__),
        name="discretisations",
        caption="Size and phase of the two couplings.",
        figure=figure,
        checks=(
            Check(
                equation="(4)",
                quantity=f"|C| at {HERTZ[middle]:.0f} Hz",
                route="difference equation in time, fitted",
                expected=float(abs(backward[middle])),
                got=float(np.hypot(*fit)),
                unit="N/m",
            ),
            Check(
                equation="(4)",
                quantity="|C| at Nyquist, K + 2B/T",
                route="scipy.signal.dfreqresp",
                expected=K + 2 * B / PERIOD,
                got=float(abs(signal.dfreqresp(system, w=[np.pi])[1][0])),
                unit="N/m",
            ),
            Check(
                equation="(5)",
                quantity=f"|C| at {HERTZ[middle]:.0f} Hz",
                route="difference equation in time, fitted",
                expected=float(abs(tustin[middle])),
                got=float(np.hypot(*fit_tustin)),
                unit="N/m",
                tolerance=1e-6,
            ),
        ),
    )


CONTACT = 1e4
"""Contact stiffness K_c in N/m: so stiff that a peg of a few centimetres is at the limit."""
DEVICE = 2e-3
"""Rotational damping b_θ of the simulated device in N m s/rad."""
BEHIND = Coupling(stiffness=2.4, damping=5e-4, rotational_stiffness=0, rotational_damping=0)
"""Coupling inserted by the comparison, as one axis: 2.4 N m/rad and 5e-4 N m s/rad."""


def _contact_hessian(length: float) -> NDArray[np.float64]:
    """Returns second differences of the energy of two contact springs, over (x, y, angle)."""

    def energy(pose: NDArray[np.float64]) -> float:
        x, _, angle = pose
        arm = length / 2 * np.sin(angle)
        return float(0.5 * CONTACT * ((x + arm) ** 2 + (x - arm) ** 2))

    step = 1e-4
    unit = step * np.eye(3)
    return np.array(
        [
            [
                (energy(i + j) - energy(i - j) - energy(j - i) + energy(-i - j)) / (4 * step**2)
                for j in unit
            ]
            for i in unit
        ]
    )


def _needed_behind(stiffness: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the largest required damping for a massless tool between coupling and spring."""
    theta = angles(np.linspace(1e-3, np.pi, 2000) / PERIOD, PERIOD)
    k, b = np.asarray(BEHIND.stiffness), np.asarray(BEHIND.damping)
    coupling = coupling_transfer(k, b, PERIOD, theta, "backward", 0.0)
    spring = stiffness[:, None]
    in_series = coupling * spring / (coupling + spring)
    return np.asarray(needed_for_fixed_environment(in_series, PERIOD, theta).max(axis=1))


def direct_section() -> Section:
    """Walks through (1), with the erratum.

    A massless rigid peg tracks the handle in a grounded hole. Each of two contacts on opposite
    walls has the stiffness K_c; they lie a distance L apart, with the handle midway. The
    rotational entry ½ K_c L² is that of the paper's erratum. The first lateral contact alone
    gives K_c.

    A device with rotational damping b_θ bears the stiffness 2 b_θ/T, so a contact of
    {contact:g} N/m at {period:g} ms and {device:g} N m s/rad allows {limit:.2f} mm. A longer
    tool is unstable. Behind a coupling the need levels off at the coupling's own bound,
    whatever L is.
    """
    limit = float(2 * np.sqrt(DEVICE / (PERIOD * CONTACT)))
    lengths = np.geomspace(2e-3, 0.3, 200)
    stiffness = 0.5 * CONTACT * lengths**2
    behind = _needed_behind(stiffness)
    bound = BEHIND.stiffness * PERIOD / 2 + BEHIND.damping

    figure, (axes,) = panels(1, height=4.2)
    axes.loglog(1e3 * lengths, stiffness * PERIOD / 2, label="rendered directly, ¼ K_c L² T")
    axes.loglog(1e3 * lengths, behind, label="behind a coupling")
    axes.axhline(bound, color="C1", ls=":", label="K_r T/2 + B_r, the coupling's own bound (6)")
    axes.axhline(DEVICE, color="grey", ls="--", label="this device's b_θ")
    axes.axvline(1e3 * limit, color="C3", lw=1, label="L = 2 √(b_θ/(T K_c))")
    axes.set(
        xlabel="distance L between the contacts (mm)",
        ylabel="rotational damping needed (N m s/rad)",
    )
    axes.legend(fontsize="small")

    hessian = _contact_hessian(limit)
    spring = Coupling(0.5 * CONTACT * limit**2, 0.0, 0.0, 0.0)
    return Section(
        equation="(1)",
        title="Direct rendering: the geometry of the tool decides",
        formulas=(
            "K<sub>peg</sub> = diag( 2K<sub>c</sub>, 0, ½ K<sub>c</sub> L² )",
            "L ≤ 2 √( b<sub>θ</sub> / (T K<sub>c</sub>) )",
        ),
        paragraphs=explained(
            direct_section.__doc__,
            contact=CONTACT,
            period=1e3 * PERIOD,
            device=DEVICE,
            limit=1e3 * limit,
        ),
        name="direct_rendering",
        caption="Damping that a device needs over the distance of the contacts.",
        figure=figure,
        checks=(
            Check(
                quantity="lateral stiffness 2K_c",
                route="second difference of the contacts' energy",
                expected=2 * CONTACT,
                got=float(hessian[0, 0]),
                unit="N/m",
                tolerance=1e-6,
            ),
            Check(
                quantity="rotational stiffness ½K_c L² (erratum) at the limit, 2b_θ/T",
                route="second difference of the contacts' energy",
                expected=float(maximum_stiffness(DEVICE, PERIOD)),
                got=float(hessian[2, 2]),
                unit="N m/rad",
                # the second difference of sin² over 1e-4 rad is short by 1e-8 of itself
                tolerance=1e-6,
            ),
            Check(
                quantity=f"b_θ at which L = {1e3 * limit:.2f} mm is stable",
                route="time-domain loop, bisection",
                expected=DEVICE,
                got=stability_limit(SampledLoop(spring, PERIOD)),
                unit="N m s/rad",
                tolerance=1e-3,
            ),
            Check(
                quantity="b_θ needed behind the coupling, largest over L = 2 … 300 mm",
                route="frequency sweep, against the bound (6) of the coupling",
                expected=bound,
                got=float(behind.max()),
                unit="N m s/rad",
                relation="at most",
            ),
        ),
    )


def identity_residual(period: float) -> float:
    """Returns the device side minus the right-hand side, relative, for random motion.

    Args:
        period: T in s, > 0.
    """
    rng = np.random.default_rng(6)
    count, size = 200, 3
    h, x = rng.normal(size=(2, count + 2, size))
    x[0] = x[1] - rng.normal(size=size)

    def symmetric() -> NDArray[np.float64]:
        root = rng.normal(size=(size, size))
        return np.asarray(root @ root.T, dtype=np.float64)

    k, b, device = symmetric() * 1e3, symmetric(), symmetric() * 2

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


SHORT = 1e-3
"""Distance in rad below Nyquist at which (7) is evaluated."""

STIFF, LIGHT = Coupling(4000.0, 0.5, 0.0, 0.0), 0.05
"""Coupling and mass in kg for which Tustin's damper needs far more than (6)."""


def backward_difference() -> Section:
    """Walks through (6).

    Put (4) into (2): the need rises with frequency and is largest at Nyquist. The worst hand
    there holds nothing: the device's own damper alone must keep the loop stable.

    (6) is not only necessary. An exact identity of the sampled energies shows that it is
    sufficient for any passive hand, also a nonlinear one, and in several dimensions as the
    matrix inequality b ⪰ KT/2 + B. The identity is evaluated here on random motion in three
    dimensions.

    With MuJoCo in the loop the same hand holds a heavy free body through the coupling actuators
    under the ``discrete`` integrator: the limit is the paper's.
    """
    omega = THETA / PERIOD
    figure, (spectrum, largest) = panels(1, height=4.0, columns=2)
    for damping in (0.0, 0.5, 1.0, 2.0):
        curve = damping_spectrum(spring_with(damping), PERIOD, omega)
        spectrum.plot(HERTZ, curve, label=f"B = {damping:g} N s/m")
        spectrum.plot(NYQUIST_HZ, K * PERIOD / 2 + damping, "ko", ms=4)
    spectrum.plot([], [], "ko", ms=4, label="KT/2 + B")
    spectrum.set(xlabel="frequency (Hz)", ylabel="device damping needed (N s/m)")
    spectrum.legend(fontsize="small", loc="upper left")
    device = np.geomspace(0.5, 20, 50)
    for rate in (500, 1000, 2000, 4000):
        largest.loglog(device, maximum_stiffness(device, 1 / rate), label=f"{rate} Hz")
    largest.set(xlabel="device damping b (N s/m)", ylabel="largest K for B = 0 (N/m)")
    largest.legend(fontsize="small")

    bound = K * PERIOD / 2 + B
    loops = [
        at_limit(
            f"wall, T = {period * 1e3:g} ms: b at the limit of stability",
            K * period / 2 + B,
            SampledLoop(COUPLING, period),
            route=" with the worst hand",
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
        paragraphs=explained(backward_difference.__doc__),
        name="backward_difference",
        caption=f"Left: the need over frequency, K = {K:g} N/m, T = 1 ms. Right: what a device "
        "allows; doubling the rate doubles K.",
        figure=figure,
        checks=(
            Check(
                quantity="b = KT/2 + B",
                route="frequency sweep of (2)",
                expected=bound,
                got=float(np.max(damping_spectrum(COUPLING, PERIOD, omega))),
                unit="N s/m",
            ),
            *loops,
            Check(
                quantity="sufficiency: residual of the energy identity",
                route="random motion, K, B and b in three dimensions",
                expected=0.0,
                got=identity_residual(PERIOD),
                tolerance=1e-12,
            ),
            Check(
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
    """Walks through (7).

    Put (5) into (2). At low frequency the need is small, (KT)²/(2(KT + 2B)); towards Nyquist it
    grows without limit as soon as B is not 0. So Tustin's damper is not used, although it looks
    like the better approximation.
    """
    omega = THETA / PERIOD
    figure, (axes,) = panels(1, height=4.0)
    for damping in (0.0, 0.5, 1.0, 2.0):
        curve = damping_spectrum(spring_with(damping), PERIOD, omega, discretization="tustin")
        axes.semilogy(HERTZ, np.where(np.isfinite(curve), curve, np.nan), label=f"B = {damping:g}")
    axes.axhline(K * PERIOD / 2 + B, color="grey", ls=":", label="(6) for B = 2 N s/m")
    axes.set(xlabel="frequency (Hz)", ylabel="device damping needed (N s/m)", ylim=(0.05, 100))
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
        paragraphs=explained(tustin.__doc__),
        name="tustin",
        caption=f"The need over frequency, K = {K:g} N/m, T = 1 ms; B in N s/m.",
        figure=figure,
        checks=(
            Check(
                quantity="largest difference from the closed form in γ, relative",
                route="frequency sweep of (2) with (5)",
                expected=0.0,
                got=float(np.max(np.abs(swept / closed - 1))),
                tolerance=1e-6,
            ),
            Check(
                quantity="b at ω → 0, (KT)²/(2(KT + 2B))",
                route="frequency sweep at 0.016 Hz",
                expected=(K * PERIOD) ** 2 / (2 * (K * PERIOD + 2 * B)),
                got=float(damping_spectrum(COUPLING, PERIOD, 0.1, discretization="tustin")),
                unit="N s/m",
                tolerance=1e-6,
            ),
            Check(
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
            at_limit(
                "B = 0: b = KT/2, as for (6)",
                K * PERIOD / 2,
                SampledLoop(spring_with(0.0), PERIOD, discretization="tustin"),
            ),
        ),
    )


PERIODS = (5e-4, 1e-3, 2e-3)
DELAYS = (0, 1)
FILTER_TIMES = (0.0, 2e-3)
"""Grid of the checks: T in s, samples of delay, time constant of the low-pass in s."""

TICKS = 3000
"""Ticks of a run with MuJoCo in the loop: 3 s, in which a force that decays vanishes."""


def _in_mujoco(ratio: float) -> NDArray[np.float64]:
    bound = COUPLING.stiffness * PERIOD / 2 + COUPLING.damping
    hand = WorstHand(ratio * bound, np.pi / PERIOD, PERIOD)
    return hold(ImplicitMass(COUPLING, PERIOD, HEAVY).force, hand, TICKS)


LATE = spring_with(0.5)
"""Coupling of the device that is a tick late: a tool of 3 g is the worst behind it."""


def worst_tool() -> tuple[float, float, complex]:
    """Returns the mass in kg of the worst lossless tool a tick late, ω in rad/s, and H in N/m.

    A closed loop swings for ever at equality of the condition if its tool adds the imaginary part
    that u/C and the worst hand leave over: T²/(2m tan(θ/2)) = Im(u/C) − (T/2b) sin 2θ.
    """
    omega = float(worst_frequency(LATE, PERIOD, delay=1))
    theta, late = omega * PERIOD, np.exp(-1j * omega * PERIOD)
    c = complex(LATE.stiffness + LATE.damping / PERIOD * (1 - late))
    b = minimum_damping(LATE, PERIOD, delay=1)
    left = ((1 - late) / c).imag - PERIOD / (2 * b) * np.sin(2 * theta)
    mass = float(PERIOD**2 / (2 * np.tan(theta / 2) * left))
    tool = PERIOD**2 / (2 * mass) * (1 + late) / (1 - late) ** 2
    return mass, omega, complex(late * c / (1 + c * tool))


def behind_a_tick(mass: float) -> Callable[[float], float]:
    """Returns the force on a device a tick late, over the handle's position, of a lossless tool."""
    k, rate, give = LATE.stiffness, LATE.damping / PERIOD, PERIOD**2 / (2 * mass)
    position = velocity = stretch = sent = 0.0

    def respond(handle: float) -> float:
        nonlocal position, velocity, stretch, sent
        free = position + PERIOD * velocity
        force = ((k + rate) * (handle - free) - rate * stretch) / (1 + (k + rate) * give)
        position, velocity = free + give * force, velocity + PERIOD / mass * force
        stretch, late, sent = handle - position, sent, force
        return late

    return respond


def worst_hand_section() -> Section:
    """Shows that the bounds are reached.

    The paper's conditions hold for every passive hand. They are tight: device mass and hand
    together may be a lossless line, Z_0 tanh(sT/2), which takes no power and turns the phase
    until the loop is marginal. Its recursion under a held force is exact. With it a time-domain
    loop loses stability where the bound over frequency says.

    At Nyquist Z_0 = 0 and the device's damper alone is the worst hand. With the delay of one sample
    the bound of the picture is that against a wall. A tool that moves needs more: the bound for
    every scene is reached by a hand and a lossless tool together.
    """
    figure, (delayed, simulated) = panels(1, height=4.0, columns=2)
    loop = SampledLoop(COUPLING, PERIOD, delay=1)
    frequency = loop.worst_frequency()
    response = complex(loop.response(frequency))
    bound = float(loop.damping_spectrum(frequency))
    for ratio, colour in ((0.98, "C3"), (1.02, "C0")):
        hand = WorstHand(ratio * bound, frequency, PERIOD, response)
        _draw_envelope(delayed, np.abs(loop.simulate(hand, 1500).force), ratio, colour)
        _draw_envelope(simulated, np.abs(_in_mujoco(ratio))[:300], ratio, colour)
    delayed.set_title(
        f"one sample of delay, wall; worst at {frequency / 2 / np.pi:.0f} Hz", fontsize="small"
    )
    simulated.set_title("MuJoCo in the loop, worst at Nyquist", fontsize="small")

    checks = []
    for period, delay, filter_time in product(PERIODS, DELAYS, FILTER_TIMES):
        case = SampledLoop(COUPLING, period, delay=delay, filter_time=filter_time)
        expected = float(wall_damping(COUPLING, period, delay=delay, filter_time=filter_time))
        case_name = f"wall, T = {1e3 * period:g} ms, delay {delay}, τ = {1e3 * filter_time:g} ms"
        found = at_limit(f"{case_name}: b at the limit", expected, case)
        checks.append(replace(found, route=f"{found.route}, against the bound over frequency"))
    mass, omega, response = worst_tool()
    y = LATE.stiffness + 2 * LATE.damping / PERIOD
    checks.append(
        Check(
            quantity=f"any scene, device one tick late, tool of {1e3 * mass:.1f} g: b at the limit",
            route="time-domain loop, bisection, against T y³/(2 (y² − K²)), y = K + 2B/T",
            expected=PERIOD * y**3 / (2 * (y**2 - K**2)),
            got=limit_of(
                lambda: behind_a_tick(mass), lambda b: WorstHand(b, omega, PERIOD, response)
            ),
            unit="N s/m",
            tolerance=1e-3,
        )
    )
    checks.extend(
        Check(
            quantity=f"heavy tool, b = {ratio:g} of (6): 1 if the force decays",
            route="MuJoCo in the loop",
            expected=expected,
            got=float(decays(_in_mujoco(ratio), TICKS)),
            tolerance=0.0,
        )
        for ratio, expected in ((0.98, 0.0), (1.02, 1.0))
    )
    return Section(
        equation="worst hand",
        title="The hand that reaches the bound",
        formulas=(
            "(b + Z<sub>0</sub>) v<sub>k</sub> + (b − Z<sub>0</sub>) v<sub>k−1</sub> = "
            "F<sub>k</sub> + F<sub>k−1</sub>, &ensp; h<sub>k+1</sub> = h<sub>k</sub> + T "
            "v<sub>k</sub>",
            "Z<sub>0</sub> tuned so that the loop closes on itself at θ<sub>0</sub>; "
            "Z<sub>0</sub> = b cot²(θ<sub>0</sub>/2) for a spring",
        ),
        paragraphs=explained(worst_hand_section.__doc__),
        name="worst_hand",
        caption="Force at 0.98 and 1.02 of the damping needed, in the plain loop and with MuJoCo.",
        figure=figure,
        checks=checks,
    )


def _draw_envelope(axes: Axes, force: NDArray[np.float64], ratio: float, colour: str) -> None:
    """Draws the largest force of every 20 ticks, relative to the first."""
    blocks = force[: len(force) // 20 * 20].reshape(-1, 20).max(axis=1)
    time = 20e3 * PERIOD * np.arange(len(blocks))
    axes.semilogy(time, blocks / blocks[0], color=colour, label=f"b = {ratio:g} of the bound")
    axes.set(xlabel="time (ms)", ylabel="largest force, over the first")
    axes.legend(fontsize="small", loc="upper left")
