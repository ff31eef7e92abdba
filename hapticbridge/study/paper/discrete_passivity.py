"""Equations (11), (13) and (14): what it means that a simulation is passive."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hapticbridge.study.paper.check import Check
from hapticbridge.study.paper.drawing import panels
from hapticbridge.study.paper.section import Curve, Section
from hapticbridge.theory.rigid_body import ParticleMotion, Scheme, integrate_particle

PERIOD = 1e-3
"""T in s."""

MASS = 0.05
"""Of the particle in kg."""

NAMES: dict[Scheme, str] = {
    "explicit": "explicit Euler (17), j = 2",
    "semi_implicit": "force before the step, j = 1",
    "implicit": "implicit Euler (15), j = 0",
    "midpoint": "implicit midpoint",
}
COLOURS: dict[Scheme, str] = {
    "explicit": "C3",
    "semi_implicit": "C1",
    "implicit": "C0",
    "midpoint": "C2",
}

_Array = NDArray[np.float64]


def _swinging(scheme: Scheme) -> ParticleMotion:
    """A mass that a sinusoidal force stops and turns 20 times; it starts with 0.3 m/s."""
    turn = 2 * np.pi * 20 * PERIOD
    k = np.arange(round(1 / PERIOD) + 1)
    force = -MASS * 0.3 * turn / PERIOD * np.sin(turn * k)
    return integrate_particle(MASS, force, PERIOD, scheme, velocity=0.3)


def under_random_force(scheme: Scheme) -> ParticleMotion:
    """Moves the particle for 2 s under forces of 1 N, one and the same row for every scheme."""
    force = np.random.default_rng(16).normal(size=2001)
    return integrate_particle(MASS, force, PERIOD, scheme, velocity=0.2)


def _taken_out(motion: ParticleMotion) -> _Array:
    """−Σ f_i·(x_i − x_{i−1}) up to every sample."""
    return np.asarray(-np.cumsum(motion.force[1:] * np.diff(motion.position)))


def section() -> Section:
    """Walks through (11), (13) and (14)."""
    start = 0.5 * MASS * 0.3**2
    figure, (axes,) = panels(1, height=4.0)
    time = PERIOD * np.arange(1, round(1 / PERIOD) + 1)
    motions = {scheme: _swinging(scheme) for scheme in NAMES}
    for scheme, motion in motions.items():
        axes.plot(time, 1e3 * _taken_out(motion), label=NAMES[scheme], color=COLOURS[scheme], lw=1)
    axes.axhline(1e3 * start, color="k", ls=":", label="S_0, all there was")
    axes.set_xlabel("time (s)")
    axes.set_ylabel("energy taken out, −Σ f Δx (mJ)")
    axes.set_xlim(0, 0.4)
    axes.set_ylim(-12, 14)
    axes.legend(fontsize="small", loc="lower left")

    def most(scheme: Scheme) -> float:
        return float(_taken_out(motions[scheme]).max())

    explicit = motions["explicit"]
    balance = float(explicit.kinetic_energy[-1]) - start + float(_taken_out(explicit)[-1])
    return Section(
        equation="(11), (13), (14)",
        title="What it means that a simulation is passive",
        formulas=(
            "E<sub>k</sub> = S<sub>k</sub> − S<sub>k−1</sub> − f<sub>k</sub>·(x<sub>k</sub> − "
            "x<sub>k−1</sub>)&emsp;(11)",
            "Σ E<sub>i</sub> ≤ 0 for every k&emsp;(13)",
            "−Σ f<sub>i</sub>·(x<sub>i</sub> − x<sub>i−1</sub>) ≤ S<sub>0</sub>&emsp;(14)",
        ),
        paragraphs=(
            "E<sub>k</sub> is what a step creates: storage gained beyond the work that the port "
            "put in. A discrete-time passive simulation never gives out more than it held at the "
            "start.",
            f"Here a mass of {MASS:g} kg with 0.3 m/s is stopped and turned 20 times a second by a "
            "sinusoidal force, so that its whole kinetic energy is asked for again and again.",
        ),
        curves=(
            Curve(
                "discrete_passivity",
                "Energy taken out of a mass. Only what stays below S_0 is passive.",
                figure,
            ),
        ),
        checks=(
            Check(
                equation="(11)",
                quantity="Σ E_k over one second, explicit Euler",
                route="sum of single steps, against S_N − S_0 − Σ f Δx",
                expected=balance,
                got=float(explicit.energy_gain.sum()),
                unit="J",
                tolerance=1e-9,
            ),
            Check(
                equation="(13)",
                quantity="largest Σ E_i, implicit Euler",
                route="time domain",
                expected=0.0,
                got=float(np.cumsum(motions["implicit"].energy_gain).max()),
                unit="J",
                tolerance=1e-15,
                relation="at most",
            ),
            Check(
                equation="(14)",
                quantity="most energy taken out, implicit Euler, against S_0",
                route="time domain",
                expected=start,
                got=most("implicit"),
                unit="J",
                tolerance=1e-12,
                relation="at most",
            ),
            Check(
                equation="(14)",
                quantity="most energy taken out, implicit midpoint, against S_0",
                route="time domain",
                expected=start,
                got=most("midpoint"),
                unit="J",
                tolerance=1e-12,
                relation="at most",
            ),
            Check(
                equation="(14)",
                quantity="most energy taken out, explicit Euler: more than S_0",
                route="time domain",
                expected=start,
                got=most("explicit"),
                unit="J",
                tolerance=0.0,
                relation="at least",
            ),
        ),
    )
