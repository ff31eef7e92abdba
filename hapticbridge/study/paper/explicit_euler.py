"""Equations (17) and (18): explicit Euler, beside the other integrators."""

from __future__ import annotations

import numpy as np

from hapticbridge.study.paper.check import Check
from hapticbridge.study.paper.discrete_passivity import (
    COLOURS,
    MASS,
    NAMES,
    PERIOD,
    under_random_force,
)
from hapticbridge.study.paper.drawing import panels
from hapticbridge.study.paper.section import Curve, Section
from hapticbridge.theory.rigid_body import Scheme, integrate_rotation

INERTIA = (1.5e-3, 3.63e-3, 4.53e-3)
"""A box of 15 cm in kg m², turned about its middle axis, which is the unstable one."""


def section() -> Section:
    """Walks through (17) and (18)."""
    motion = under_random_force("explicit")
    v = motion.velocity
    # v_{k+1} of the last sample is not known
    printed = 0.5 * MASS * (v[1:-1] + v[:-2]) ** 2 - MASS * v[:-2] * (v[:-2] + v[2:])
    gains = motion.energy_gain[:-1]
    figure, (particle, body) = panels(1, height=3.8, columns=2)
    time = PERIOD * np.arange(1, len(v))
    for scheme, name in NAMES.items():
        particle.plot(
            time,
            1e3 * np.cumsum(under_random_force(scheme).energy_gain),
            label=name,
            color=COLOURS[scheme],
        )
    particle.set_xlabel("time (s)")
    particle.set_ylabel("Σ E_k under a random force (mJ)")
    particle.set_ylim(bottom=-45)
    particle.legend(fontsize="small", loc="lower left")

    turns = {
        scheme: integrate_rotation(INERTIA, (1e-3, 10.0, 1e-3), PERIOD, 10_000, scheme)
        for scheme in NAMES
    }
    for scheme, turn in turns.items():
        share = turn.kinetic_energy / turn.kinetic_energy[0] - 1
        body.plot(
            PERIOD * np.arange(len(share)),
            100 * share,
            color=COLOURS[scheme],
            label=NAMES[scheme],
            # it lies upon the explicit one
            ls="--" if scheme == "semi_implicit" else "-",
        )
    body.set_xlabel("time (s)")
    body.set_ylabel("energy of a tumbling body, change (%)")
    body.legend(fontsize="small", loc="upper left")

    def drift(scheme: Scheme) -> float:
        energy = turns[scheme].kinetic_energy
        return float(energy[-1] / energy[0] - 1)

    momentum = turns["midpoint"].angular_momentum
    moved = np.linalg.norm(momentum - momentum[0], axis=1).max() / np.linalg.norm(momentum[0])
    middle = under_random_force("midpoint")
    largest = float(np.abs(np.diff(middle.kinetic_energy)).max())
    return Section(
        equation="(17), (18)",
        title="Explicit Euler creates energy",
        formulas=(
            "v<sub>k</sub> = v<sub>k−1</sub> + (T/m) f<sub>k−1</sub>, &ensp; "
            "x<sub>k</sub> = x<sub>k−1</sub> + T v<sub>k−1</sub>&emsp;(17)",
            "E<sub>k</sub> = ½ m (v<sub>k</sub> + v<sub>k−1</sub>)² − m v<sub>k−1</sub> "
            "(v<sub>k−1</sub> + v<sub>k+1</sub>)&emsp;(18)",
        ),
        paragraphs=(
            "The position answers a force after two samples. (18) has no sign: whoever chooses the "
            "force takes energy out. The implicit midpoint rule, which the paper does not have, "
            "neither creates nor loses.",
            "The same four rules on a body that tumbles freely (no force, T = 1 ms, 10 rad/s "
            "about the middle axis): explicit rules gain, implicit Euler loses, midpoint keeps "
            "energy and momentum.",
        ),
        curves=(
            Curve(
                "explicit_euler",
                "Energy created by four integrators: a particle under a random force (left), a "
                "tumbling body (right; explicit and j = 1 fall together).",
                figure,
            ),
        ),
        checks=(
            Check(
                equation="(18)",
                quantity="largest |E_k − (18)| over the largest |E_k|, random forces",
                route="E_k by its definition (11)",
                expected=0.0,
                got=float(np.abs(gains - printed).max() / np.abs(gains).max()),
                tolerance=1e-9,
            ),
            Check(
                equation="(18)",
                quantity="Σ E_k under explicit Euler, random forces of 1 N for 2 s",
                route="time domain",
                expected=0.01,
                got=float(gains.sum()),
                unit="J",
                tolerance=0.0,
                relation="at least",
            ),
            Check(
                equation="midpoint",
                quantity="midpoint: largest |E_k| over the largest change of storage",
                route="E_k by its definition (11)",
                expected=0.0,
                got=float(np.abs(middle.energy_gain).max()) / largest,
                tolerance=1e-9,
            ),
            Check(
                equation="(17)",
                quantity="tumbling body in 10 s, explicit: energy gained, relative",
                route="time domain",
                expected=0.01,
                got=drift("explicit"),
                tolerance=0.0,
                relation="at least",
            ),
            Check(
                equation="(15)",
                quantity="tumbling body in 10 s, implicit: energy change, relative",
                route="time domain",
                expected=-0.01,
                got=drift("implicit"),
                tolerance=0.0,
                relation="at most",
            ),
            Check(
                equation="midpoint",
                quantity="tumbling body in 10 s, midpoint: relative change of energy",
                route="time domain",
                expected=0.0,
                got=drift("midpoint"),
                tolerance=1e-9,
            ),
            Check(
                equation="midpoint",
                quantity="tumbling body in 10 s, midpoint: largest relative change of momentum",
                route="time domain",
                expected=0.0,
                got=float(moved),
                tolerance=1e-9,
            ),
        ),
    )
