"""Equations (2) and (4) to (7): what a coupling asks of the device."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from hapticbridge.coupling import Coupling
from hapticbridge.study.paper.check import Check
from hapticbridge.study.paper.drawing import panels
from hapticbridge.study.paper.section import Curve, Section
from hapticbridge.theory.bounds import minimum_damping
from hapticbridge.theory.sampled_loop import SampledLoop, stability_limit
from hapticbridge.theory.spectrum import damping_spectrum_of
from hapticbridge.theory.transfer import coupling_transfer

PERIOD = 1e-3
"""T in s."""

COUPLING = Coupling(stiffness=1000.0, damping=2.0, rotational_stiffness=0.0, rotational_damping=0.0)
K, B = COUPLING.stiffness, COUPLING.damping
TAU = 2e-3
"""Time constant of the low-pass in s: two samples, as a velocity filter may have."""

THETA = np.linspace(1e-3, np.pi, 4000)
NYQUIST_HZ = 0.5 / PERIOD
HERTZ = THETA / np.pi * NYQUIST_HZ

_Complex = NDArray[np.complex128]


def spring_with(damping: float) -> Coupling:
    """Returns the walk's spring with another damper, B in N s/m."""
    return Coupling(K, damping, 0.0, 0.0)


def low_passed(z: _Complex) -> _Complex:
    """C of a spring and a low-passed damper, written in z."""
    return np.asarray(K + B * (1 - 1 / z) / (PERIOD + TAU * (1 - 1 / z)))


def delayed(z: _Complex) -> _Complex:
    """C of the spring and damper, one sample late."""
    return np.asarray((K + B / PERIOD * (1 - 1 / z)) / z)


def any_coupling() -> Section:
    """Walks through (2)."""
    omega = THETA / PERIOD
    digital = signal.dlti([K + B / PERIOD, -B / PERIOD], [1, 0], dt=PERIOD)
    curves = {
        "spring": damping_spectrum_of(lambda z: np.full_like(z, K), PERIOD, omega),
        "spring and damper (4)": damping_spectrum_of(digital, PERIOD, omega),
        f"the same, damper low-passed with τ = {TAU * 1e3:g} ms": damping_spectrum_of(
            low_passed, PERIOD, omega
        ),
    }
    late = np.asarray(damping_spectrum_of(delayed, PERIOD, omega))
    figure, (axes,) = panels(1, height=4.2)
    for name, curve in curves.items():
        axes.plot(HERTZ, curve, label=name)
    axes.plot(HERTZ, np.where(np.isfinite(late), late, np.nan), label="(4) delayed by one sample")
    first = HERTZ[np.isinf(late)].min()
    axes.axvspan(first, NYQUIST_HZ, color="C3", alpha=0.12, label="delayed: none suffices")
    axes.set_ylim(0, 8)
    axes.set_xlabel("frequency (Hz)")
    axes.set_ylabel("device damping needed (N s/m)")
    axes.legend(fontsize="small", loc="upper left")

    filtered = minimum_damping(COUPLING, PERIOD, filter_time=TAU)
    return Section(
        equation="(2)",
        title="The condition, for any coupling",
        formulas=(
            "b > (T/2)(1 − cos ωT) / Re{ (1 − e<sup>−jωT</sup>) / C(e<sup>jωT</sup>) }"
            "&emsp;for 0 &lt; ω ≤ π/T",
        ),
        paragraphs=(
            "C is the transfer function from the distance of handle and tool to the force. The "
            "real part must be positive. The condition holds for every passive hand and every "
            "discrete-time passive environment, so nothing of the scene enters.",
            "It takes any C. A low-pass behind the damper lowers the need at high frequency. One "
            "sample of delay makes the real part negative above some frequency: no device damping "
            "is then enough for <em>every</em> environment.",
        ),
        curves=(
            Curve(
                "any_coupling",
                f"Condition (2) for four couplings, K = {K:g} N/m, B = {B:g} N s/m, T = 1 ms.",
                figure,
            ),
        ),
        checks=(
            Check(
                equation="(2)",
                quantity="spring alone, b = KT/2",
                route="frequency sweep",
                expected=K * PERIOD / 2,
                got=float(np.max(curves["spring"])),
                unit="N s/m",
                tolerance=1e-9,
            ),
            Check(
                equation="(2)",
                quantity="low-passed damper, b = KT/2 + B T/(T + 2τ)",
                route="frequency sweep of C as a callable of z",
                expected=K * PERIOD / 2 + B * PERIOD / (PERIOD + 2 * TAU),
                got=float(np.max(damping_spectrum_of(low_passed, PERIOD, omega))),
                unit="N s/m",
                tolerance=1e-9,
            ),
            Check(
                equation="(2)",
                quantity="low-passed damper against a wall, b at the limit of stability",
                route="time-domain loop, bisection",
                expected=float(filtered),
                got=stability_limit(SampledLoop(COUPLING, PERIOD, filter_time=TAU)),
                unit="N s/m",
                tolerance=1e-3,
            ),
            Check(
                equation="(2)",
                quantity="one sample late, b for every environment",
                route="frequency sweep",
                expected=np.inf,
                got=float(late.max()),
                unit="N s/m",
                tolerance=0.0,
            ),
        ),
    )


def discretizations() -> Section:
    """Walks through (4) and (5)."""
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
        inner = slice(None, -1)  # (5) has no value at Nyquist
        size.semilogy(HERTZ[inner], np.abs(transfer[inner]), color=colour, label=name)
        phase.plot(HERTZ[inner], np.degrees(np.angle(transfer[inner])), color=colour)
    size.set_ylim(500, 1e5)
    size.set_ylabel("|C| (N/m)")
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
        paragraphs=(
            "The backward difference (4) stays finite, K + 2B/T at Nyquist. Tustin's rule (5) "
            "keeps the phase of a spring and damper up to Nyquist, where it has a pole.",
        ),
        curves=(Curve("discretisations", "Size and phase of the two couplings.", figure),),
        checks=(
            Check(
                equation="(4)",
                quantity=f"|C| at {HERTZ[middle]:.0f} Hz",
                route="difference equation in time, fitted",
                expected=float(abs(backward[middle])),
                got=float(np.hypot(*fit)),
                unit="N/m",
                tolerance=1e-9,
            ),
            Check(
                equation="(4)",
                quantity="|C| at Nyquist, K + 2B/T",
                route="scipy.signal.dfreqresp",
                expected=K + 2 * B / PERIOD,
                got=float(abs(signal.dfreqresp(system, w=[np.pi])[1][0])),
                unit="N/m",
                tolerance=1e-9,
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
