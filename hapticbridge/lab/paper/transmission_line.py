"""The transmission line that the paper names as future work, beside the spring and damper."""

from __future__ import annotations

import numpy as np

from hapticbridge.coupling import Coupling
from hapticbridge.lab.paper.section import Check, Section, Table, explained, panels
from hapticbridge.theory.bounds import maximum_stiffness
from hapticbridge.theory.sampled_loop import SampledLoop, WorstHand, stability_limit, threshold
from hapticbridge.theory.spectrum import damping_spectrum
from hapticbridge.theory.transfer import (
    transmission_line_spectrum,
    transmission_line_stiffness,
)

PERIOD = 1e-3
"""Period T in s."""

IMPEDANCE = 2.0
"""Impedance Z in N s/m, equal to the simulated device's damping."""
BESIDE = 0.5
"""Damping B in N s/m of the spring and damper that are drawn beside the line."""
ROUND_TRIPS = (1, 2, 4)
"""Numbers of samples that a wave takes there and back."""
THETA = np.linspace(1e-3, np.pi, 2000)
SAMPLES = 6000
"""Ticks of a run, 6 s: growth shows between its last two thirds."""

DIVERGED = 1e6
"""Force in N at which a run counts as growing: a billion times the initial force."""
TURN = 2.0
"""Angle in rad at which the loop is tried; the requirement is equal at all angles."""


def _rings(damping: float, trip: int) -> bool:
    """Returns True if a line before a wall, held by the worst hand at TURN, grows."""
    turn = np.exp(1j * TURN)
    response = 2 * IMPEDANCE / PERIOD * (1 - 1 / turn) * turn ** (1 - trip) / (1 - turn**-trip)
    hand = WorstHand(damping, TURN / PERIOD, PERIOD, complex(response))
    carried, now, before = hand.recursion()
    sent = np.zeros(SAMPLES + trip)  # the wave towards the tool; the wall turns it back
    force = np.zeros(SAMPLES)
    velocity, last = 1e-3, 0.0
    sent[trip - 1] = IMPEDANCE * velocity
    for k in range(SAMPLES):
        returned = sent[k]
        force[k] = 2 * returned
        if abs(force[k]) > DIVERGED:
            return True
        velocity = carried * velocity - now * force[k] + before * last
        last = -force[k]
        sent[k + trip] = returned + IMPEDANCE * velocity
    third = SAMPLES // 3
    return bool(np.abs(force[-third:]).max() > np.abs(force[-2 * third : -third]).max())


def _limit(trip: int) -> float:
    # from 1 N s/m on by powers of ten
    return threshold(lambda damping: not _rings(damping, trip), 1.0, 1e-4)


def _samples(count: int) -> str:
    return f"{count} sample{'s' * (count > 1)}"


def _static(trip: int) -> float:
    """Returns the mean force per displacement of a handle pushed once, over whole round trips."""
    push = 1e-3
    sent = np.zeros(20 * trip)
    sent[0] = IMPEDANCE * push / PERIOD
    force = np.zeros(20 * trip)
    for k in range(trip, 20 * trip):
        force[k] = 2 * sent[k - trip]
        sent[k] = sent[k - trip]
    return float(force[10 * trip :].mean() / push)


def _spring_per_damping() -> float:
    """Returns the stiffness of a spring over the damping at which it is stable, in 1/s."""
    stiffness = 1000.0
    return stiffness / stability_limit(SampledLoop(Coupling(stiffness, 0, 0, 0), PERIOD))


def _stiffest(trip: int) -> float:
    return float(transmission_line_stiffness(IMPEDANCE, PERIOD, round_trip=trip))


def section() -> Section:
    """Shows whether the line buys stiffness.

    A line that carries waves replaces the spring and damper. Ended by the device's own damping
    it is passive for b ≥ Z, for any hand and any discrete-time passive environment, at every
    frequency alike.

    But with one sample each way its static stiffness is b/T, half of a spring's 2b/T: {line:g}
    N/m instead of {spring:g} N/m for b = {impedance:g} N s/m at 1 kHz. Only a line that returns
    within one sample, which is a plain spring, reaches as much.
    """
    omega = THETA / PERIOD
    hertz = THETA / np.pi * 0.5 / PERIOD
    figure, (spectrum, stiffness) = panels(1, height=4.0, columns=2)
    equal = transmission_line_stiffness(IMPEDANCE, PERIOD)
    device = transmission_line_spectrum(IMPEDANCE, PERIOD, omega)
    software = transmission_line_spectrum(IMPEDANCE, PERIOD, omega, terminated_by="software")
    spectrum.plot(hertz, device, label="line ended by the device's damping")
    spectrum.plot(hertz, software, label="line ended in software (wall only)")
    spectrum.axhline(
        float(equal) * PERIOD / 2, color="k", ls=":", label="spring of the same static stiffness"
    )
    spectrum.plot(
        hertz,
        damping_spectrum(Coupling(float(equal), BESIDE, 0, 0), PERIOD, omega),
        color="C2",
        label=f"the same and a damper, B = {BESIDE:g} N s/m (4)",
    )
    spectrum.set_xlabel("frequency (Hz)")
    spectrum.set_ylim(-4.5, 2.3)  # room for the names
    spectrum.set_ylabel("device damping needed (N s/m)")
    spectrum.legend(fontsize="x-small", loc="lower left")
    damping = np.linspace(0.5, 10, 50)
    stiffness.plot(damping, 1e-3 * np.asarray(maximum_stiffness(damping, PERIOD)), "k:", lw=2)
    stiffness.plot([], [], "k:", lw=2, label="spring, 2b/T")
    for trip in ROUND_TRIPS:
        line = np.asarray(transmission_line_stiffness(damping, PERIOD, round_trip=trip))
        stiffness.plot(damping, 1e-3 * line, label=f"line, {_samples(trip)} there and back")
    stiffness.set(xlabel="device damping b (N s/m)", ylabel="largest static stiffness (N/mm)")
    stiffness.legend(fontsize="x-small", loc="upper left")

    checks = []
    for trip in ROUND_TRIPS:
        checks.append(
            Check(
                quantity=f"line, {_samples(trip)} there and back: b at the limit",
                route=f"time-domain loop with the worst hand at θ = {TURN:g} rad",
                expected=float(
                    transmission_line_spectrum(
                        IMPEDANCE, PERIOD, TURN / PERIOD, round_trip=trip
                    ).max()
                ),
                got=_limit(trip),
                unit="N s/m",
                tolerance=2e-3,
            )
        )
        checks.append(
            Check(
                quantity=f"line, {_samples(trip)}: static stiffness of the stiffest, 2b/(nT)",
                route="handle pushed once, mean force",
                expected=_stiffest(trip),
                got=_static(trip),
                unit="N/m",
            )
        )
    best = float(maximum_stiffness(IMPEDANCE, PERIOD))
    checks.append(
        Check(
            quantity="stiffness of the line with one sample each way, over the spring's: ½",
            route="static push and time-domain limits of both",
            expected=0.5,
            got=_static(2) / _limit(2) / _spring_per_damping(),
            tolerance=1e-3,
        )
    )
    return Section(
        equation="future work",
        title="A transmission line as coupling: it buys no stiffness",
        formulas=(
            "ended by the device:&ensp;b(θ) = Z&emsp;&emsp;ended in software, one sample each way:"
            "&ensp;b(θ) = Z cos θ",
            "K = 2Z/(nT), n samples there and back",
        ),
        paragraphs=explained(section.__doc__, line=float(equal), spring=best, impedance=IMPEDANCE),
        name="transmission_line",
        caption=f"Left: damping needed over frequency, Z = {IMPEDANCE:g} N s/m. Right: what a "
        "device allows.",
        figure=figure,
        checks=checks,
        table=Table(
            ("coupling", "largest static stiffness at b = 2 N s/m, 1 kHz (N/m)"),
            (
                ("spring, B = 0", f"{best:g}"),
                *((f"line, n = {trip}", f"{_stiffest(trip):g}") for trip in ROUND_TRIPS),
            ),
        ),
    )
