"""Equations (11), (13) and (14): passivity of a simulation, and its integrators."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.lab.paper.in_mujoco import AppliedForceMass, ImplicitMass, drive, limit_of
from hapticbridge.lab.paper.section import Check, Relation, Section, Table, explained, panels
from hapticbridge.theory.rigid_body import (
    ParticleMotion,
    Rotation,
    StepRule,
    integrate_particle,
    integrate_rotation,
)
from hapticbridge.theory.sampled_loop import SampledLoop, WorstHand, stability_limit, threshold
from hapticbridge.theory.transfer import CouplingGrid
from hapticbridge.theory.virtual_mass import Integrator, environment_minimum_damping, minimum_mass

PERIOD = 1e-3
"""Period T in s."""

MASS = 0.05
"""Mass of the particle in kg."""

NAMES: dict[StepRule, str] = {
    "explicit": "explicit Euler (17), j = 2",
    "semi_implicit": "force before the step, j = 1",
    "implicit": "implicit Euler (15), j = 0",
    "midpoint": "implicit midpoint",
}
COLOURS: dict[StepRule, str] = {
    "explicit": "C3",
    "semi_implicit": "C1",
    "implicit": "C0",
    "midpoint": "C2",
}

_Array = NDArray[np.float64]


def _swinging(rule: StepRule) -> ParticleMotion:
    """Inputs of a mass that a sinusoidal force stops and turns 20 times; it starts with 0.3 m/s."""
    turn = 2 * np.pi * 20 * PERIOD
    k = np.arange(round(1 / PERIOD) + 1)
    force = -MASS * 0.3 * turn / PERIOD * np.sin(turn * k)
    return integrate_particle(MASS, force, PERIOD, rule, velocity=0.3)


def under_random_force(rule: StepRule) -> ParticleMotion:
    """Moves the particle for 2 s under forces of 1 N; every rule gets equal forces."""
    force = np.random.default_rng(16).normal(size=2001)
    return integrate_particle(MASS, force, PERIOD, rule, velocity=0.2)


def _taken_out(motion: ParticleMotion) -> _Array:
    """Returns −Σ f_i·(x_i − x_{i−1}) up to every sample."""
    return np.asarray(-np.cumsum(motion.force[1:] * np.diff(motion.position)))


def discrete_passivity_section() -> Section:
    """Walks through (11), (13) and (14).

    E_k is the energy that a step creates: storage gained beyond the work through the port. A
    discrete-time passive simulation never gives out more than it held at the start.

    Here a mass of {mass:g} kg with 0.3 m/s is stopped and turned 20 times a second by a
    sinusoidal force, so that its whole kinetic energy is asked for again and again.
    """
    start = 0.5 * MASS * 0.3**2
    figure, (axes,) = panels(1, height=4.0)
    time = PERIOD * np.arange(1, round(1 / PERIOD) + 1)
    motions = {rule: _swinging(rule) for rule in NAMES}
    for rule, motion in motions.items():
        axes.plot(time, 1e3 * _taken_out(motion), label=NAMES[rule], color=COLOURS[rule], lw=1)
    axes.axhline(1e3 * start, color="k", ls=":", label="S_0, all there was")
    axes.set(
        xlabel="time (s)", ylabel="energy taken out, −Σ f Δx (mJ)", xlim=(0, 0.4), ylim=(-12, 14)
    )
    axes.legend(fontsize="small", loc="lower left")

    bounds: tuple[tuple[StepRule, str, Relation], ...] = (
        ("implicit", "implicit Euler, against S_0", "at most"),
        ("midpoint", "implicit midpoint, against S_0", "at most"),
        ("explicit", "explicit Euler: more than S_0", "at least"),
    )
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
        paragraphs=explained(discrete_passivity_section.__doc__, mass=MASS),
        name="discrete_passivity",
        caption="Energy taken out of a mass. Only what stays below S_0 is passive.",
        figure=figure,
        checks=(
            Check(
                equation="(11)",
                quantity="Σ E_k over one second, explicit Euler",
                route="sum of single steps, against S_N − S_0 − Σ f Δx",
                expected=balance,
                got=float(explicit.energy_gain.sum()),
                unit="J",
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
            *(
                Check(
                    equation="(14)",
                    quantity=f"most energy taken out, {quantity}",
                    route="time domain",
                    expected=start,
                    got=float(_taken_out(motions[rule]).max()),
                    unit="J",
                    tolerance=0.0 if rule == "explicit" else 1e-12,
                    relation=relation,
                )
                for rule, quantity, relation in bounds
            ),
        ),
    )


INERTIA = (1.5e-3, 3.63e-3, 4.53e-3)
"""Inertia of a box of 15 cm in kg m²; it turns about its middle axis, which is unstable."""


def explicit_euler_section() -> Section:
    """Walks through (17) and (18).

    The position responds to a force after two samples. (18) has no definite sign: a suitable force
    extracts energy. The implicit midpoint rule, which the paper does not have, neither creates nor
    loses.

    The same four rules on a body that tumbles freely (no force, T = 1 ms, 10 rad/s about the
    middle axis): explicit rules gain, implicit Euler loses, midpoint keeps energy and momentum.
    """
    motion = under_random_force("explicit")
    v = motion.velocity
    # v_{k+1} of the last sample is unknown
    printed = 0.5 * MASS * (v[1:-1] + v[:-2]) ** 2 - MASS * v[:-2] * (v[:-2] + v[2:])
    gains = motion.energy_gain[:-1]
    turns = {
        rule: integrate_rotation(INERTIA, (1e-3, 10.0, 1e-3), PERIOD, 10_000, rule)
        for rule in NAMES
    }

    def drift(rule: StepRule) -> float:
        energy = turns[rule].kinetic_energy
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
        paragraphs=explained(explicit_euler_section.__doc__),
        name="explicit_euler",
        caption="Energy created by four integrators: a particle under a random force (left), a "
        "tumbling body (right; explicit and j = 1 fall together).",
        figure=_gains_of_four_rules(turns),
        checks=(
            Check(
                equation="(18)",
                quantity="largest |E_k − (18)| over the largest |E_k|, random forces",
                route="E_k by its definition (11)",
                expected=0.0,
                got=float(np.abs(gains - printed).max() / np.abs(gains).max()),
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
            ),
            Check(
                equation="midpoint",
                quantity="tumbling body in 10 s, midpoint: largest relative change of momentum",
                route="time domain",
                expected=0.0,
                got=float(moved),
            ),
        ),
    )


def _gains_of_four_rules(turns: Mapping[StepRule, Rotation]) -> Figure:
    """Draws the energy that a particle and a tumbling body gain under each rule."""
    figure, (particle, body) = panels(1, height=3.8, columns=2)
    for rule, name in NAMES.items():
        gain = under_random_force(rule).energy_gain
        time = PERIOD * np.arange(1, len(gain) + 1)
        particle.plot(time, 1e3 * np.cumsum(gain), label=name, color=COLOURS[rule])
    particle.set(xlabel="time (s)", ylabel="Σ E_k under a random force (mJ)")
    particle.set_ylim(bottom=-45)
    particle.legend(fontsize="small", loc="lower left")
    for rule, turn in turns.items():
        change = turn.kinetic_energy / turn.kinetic_energy[0] - 1
        body.plot(
            PERIOD * np.arange(len(change)),
            100 * change,
            color=COLOURS[rule],
            label=NAMES[rule],
            # it lies upon the explicit one
            ls="--" if rule == "semi_implicit" else "-",
        )
    body.set(xlabel="time (s)", ylabel="energy of a tumbling body, change (%)")
    body.legend(fontsize="small", loc="upper left")
    return figure


IMPLICIT_COUPLING = Coupling(2000.0, 2.0, 0.0, 0.0)
"""Coupling K and B of the runs with MuJoCo."""

SECONDS = 2.0
"""Duration in s of the handle's motion."""


def implicit_euler_section() -> Section:
    """Walks through (15) and (16).

    The force belongs to the position at the end of the step, so it must be solved for. In
    MuJoCo the coupling is six actuators, and the integrator ``discrete`` solves them together
    with the rest: it is (15), step by step.

    A force that is written before the step (``xfrc_applied`` under ``Euler``) arrives one
    sample late, j = 1. It creates exactly what (15) loses. Here a handle moves 1 cm at 3 Hz, K
    = {stiffness:g} N/m, B = {damping:g} N s/m, m = {mass:g} kg, T = 1 ms.
    """
    motion = under_random_force("implicit")
    squared = PERIOD**2 * motion.force[1:] ** 2 / (2 * MASS)

    ticks = round(SECONDS / PERIOD)
    handle = 0.01 * np.sin(2 * np.pi * 3 * PERIOD * np.arange(1, ticks + 1))
    rows = drive(ImplicitMass(IMPLICIT_COUPLING, PERIOD, MASS), handle)
    force = rows["wrench_on_tool"][:, 0]
    gains = np.diff(rows["environment_energy"], prepend=0.0)
    expected = -(PERIOD**2) * force**2 / (2 * MASS)
    applied, applied_gains, predicted = _applied_force_gains(handle)

    figure, (energy, ratio) = panels(1, height=3.8, columns=2)
    time = PERIOD * np.arange(1, ticks + 1)
    energy.plot(time, 1e3 * np.cumsum(gains), color="C0", label="coupling actuators, discrete")
    energy.plot(time, 1e3 * np.cumsum(expected), "k:", label="−Σ T²f²/(2m), (16)")
    energy.plot(time, 1e3 * np.cumsum(applied_gains), color="C1", label="applied force, Euler")
    energy.plot(time, 1e3 * np.cumsum(predicted), "k--", lw=1, label="+Σ T²f²/(2m)")
    energy.set(xlabel="time (s)", ylabel="Σ E_k (mJ)")
    energy.legend(fontsize="small")
    ratio.plot(1e3 * squared, 1e3 * motion.energy_gain, ".", ms=3, label="random forces, (15)")
    end = 1e3 * float(squared.max())
    ratio.plot([0, end], [0, -end], "k", lw=0.8, label="(16)")
    ratio.set(xlabel="T²f²/(2m) (mJ)", ylabel="E_k of a step (mJ)")
    ratio.legend(fontsize="small")

    scale = float(np.abs(motion.energy_gain).max())
    return Section(
        equation="(15), (16)",
        title="Implicit Euler loses energy in every step",
        formulas=(
            "v<sub>k</sub> = v<sub>k−1</sub> + (T/m) f<sub>k</sub>, &ensp; "
            "x<sub>k</sub> = x<sub>k−1</sub> + T v<sub>k</sub>&emsp;(15)",
            "E<sub>k</sub> = −½ m (v<sub>k</sub> − v<sub>k−1</sub>)² = −T² f<sub>k</sub>²/(2m) ≤ 0"
            "&emsp;(16)",
        ),
        paragraphs=explained(
            implicit_euler_section.__doc__,
            stiffness=IMPLICIT_COUPLING.stiffness,
            damping=IMPLICIT_COUPLING.damping,
            mass=MASS,
        ),
        name="implicit_euler",
        caption="Left: energy created (+) or lost (−) in MuJoCo. Right: single steps of (15).",
        figure=figure,
        checks=(
            Check(
                equation="(16)",
                quantity="largest |E_k + T²f²/(2m)| over the largest |E_k|, 2000 random forces",
                route="E_k by its definition (11)",
                expected=0.0,
                got=float(np.abs(motion.energy_gain + squared).max()) / scale,
            ),
            Check(
                equation="(16)",
                quantity="largest E_k of a step",
                route="MuJoCo in the loop, discrete",
                expected=0.0,
                got=float(gains.max()),
                unit="J",
                # the ledger's sums of millijoules round at 1e-18
                tolerance=1e-15,
                relation="at most",
            ),
            Check(
                equation="(16)",
                quantity=f"Σ E_k in {SECONDS:g} s, −Σ T²f²/(2m)",
                route="MuJoCo in the loop, discrete",
                expected=float(expected.sum()),
                got=float(gains.sum()),
                unit="J",
            ),
            Check(
                equation="(16)",
                quantity="applied force, j = 1: Σ E_k, +Σ T²f²/(2m)",
                route="MuJoCo, Euler; storage after the force has acted",
                expected=float(predicted.sum()),
                got=float(applied_gains.sum()),
                unit="J",
            ),
            Check(
                equation="(14)",
                quantity="applied force, j = 1: Σ E_k by (11) itself, the same but for ½mv²",
                route="MuJoCo, Euler",
                expected=float(predicted.sum()),
                got=applied,
                unit="J",
                # the storages differ by one step, at the end by 6 nJ here
                tolerance=1e-4,
            ),
        ),
    )


def _applied_force_gains(handle: _Array) -> tuple[float, _Array, _Array]:
    """Runs the mass under an applied force; returns Σ E_k of (11) and E_k with j = 1.

    The storage for j = 1 includes T²f²/(2m).
    """
    mass = AppliedForceMass(IMPLICIT_COUPLING, PERIOD, MASS)
    # position and velocity at the samples, force at the sample of its computation
    x, v, f = np.zeros((3, len(handle) + 1))
    for k, target in enumerate(handle, start=1):
        x[k], v[k] = mass.motion
        f[k] = mass.force(float(target))
    stored = 0.5 * MASS * np.append(v, mass.motion[1]) ** 2
    work = f[1:] * np.diff(x)
    by_definition = float(np.sum(np.diff(stored[:-1]) - work))
    return by_definition, np.diff(stored)[1:] - work, PERIOD**2 * f[1:] ** 2 / (2 * MASS)


MASS_NAMES: dict[Integrator, str] = {
    "implicit": "implicit Euler, j = 0",
    "semi_implicit": "force before the step, j = 1",
    "explicit": "explicit Euler, j = 2: (19)",
}


def draw_least_mass(axes: Axes, stiffness: float, period: float) -> None:
    """Draws the mass that a tool must exceed, over the damper.

    Args:
        axes: Axes to draw into.
        stiffness: K in N/m.
        period: T in s.
    """
    own = stiffness * period
    dampings = own * np.linspace(1e-3, 5, 1000)
    grid = CouplingGrid(stiffness, dampings)
    colours: dict[Integrator, str] = {"semi_implicit": "C1", "explicit": "C3"}
    for integrator, colour in colours.items():
        least = 1e3 * np.asarray(minimum_mass(grid, period, integrator))
        axes.plot(
            dampings,
            np.where(np.isfinite(least), least, np.nan),
            color=colour,
            ls="--" if integrator == "explicit" else "-",
            label=MASS_NAMES[integrator],
        )
    axes.axvspan(0, own, color="C3", alpha=0.12, label="j = 2, B ≤ KT: no mass suffices")
    axes.plot(
        2 * own, 4e3 * stiffness * period**2, "o", color="C3", ms=5, label="j = 2: 4KT² at B = 2KT"
    )
    axes.set(
        xlabel="coupling damping B (N s/m)",
        ylabel="least stable mass (g)",
        xlim=(0, 5 * own),
        ylim=(0, 14),
    )
    axes.legend(fontsize="x-small", loc="upper right")


def min_stable_mass(coupling: Coupling, period: float, integrator: Integrator) -> float:
    """Finds the mass in kg above which the loop decays while the handle is held still."""
    samples = 20_000

    def does_decay(mass: float) -> bool:
        loop = SampledLoop(coupling, period, mass=mass, integrator=integrator)
        force = np.abs(loop.simulate(None, samples).force)
        third = samples // 3
        is_whole = force.size == samples
        return is_whole and bool(force[-third:].max() <= force[-2 * third : -third].max())

    # from 10 g on by powers of ten
    return threshold(does_decay, 1e-2, 1e-5)


MASS_COUPLING = Coupling(1000.0, 2.0, 0.0, 0.0)
K, B = MASS_COUPLING.stiffness, MASS_COUPLING.damping

SHOWN: tuple[Integrator, ...] = ("implicit", "semi_implicit", "explicit")
KEPT: dict[float, tuple[float, float, float]] = {
    0.002: (1.5385, 6.6667, np.inf),
    0.005: (2.0, 3.3333, 2.0),
    0.01: (2.2222, 2.8571, 2.2222),
    0.05: (2.4390, 2.5641, 2.4390),
}
"""Required damping in N s/m for j = 0, 1, 2 by mass in kg, kept to four decimals. A change of the
closed form shows even if the loop changed with it."""

_FOUR_DECIMALS = 4e-5
"""Relative tolerance: slightly above the rounding to four decimals of the smallest, 5e-5 of
1.5385."""


def _swept(mass: float, delay: int) -> float:
    """Evaluates the printed inequality at 20 000 angles."""
    theta = np.linspace(1e-3, np.pi, 20_000)
    sine = np.sin(theta / 2)
    transfer = K + B / PERIOD * (1 - np.exp(-1j * theta))
    compliance = PERIOD**2 / (4 * mass * sine**2)
    sign = (-np.sin(1.5 * theta) / sine, -1.0, 1.0)[delay]
    own = K * PERIOD / 2 - B * np.cos(theta)
    top = own + sign * PERIOD / 2 * compliance * np.abs(transfer) ** 2
    turned = 1 - compliance * transfer * np.exp(1j * (1 - delay) * theta)
    return float(np.max(top / np.abs(turned) ** 2))


def smallest_mass_in_mujoco(mass: float, integrator: Integrator) -> float:
    """Returns the least device damping in N s/m of a mass in kg behind MuJoCo's integrator."""
    loop = SampledLoop(MASS_COUPLING, PERIOD, mass=mass, integrator=integrator)
    frequency = loop.worst_frequency()
    response = complex(loop.response(frequency))

    def hand(damping: float) -> WorstHand:
        return WorstHand(damping, frequency, PERIOD, response)

    def make_environment() -> Callable[[float], float]:
        kind = ImplicitMass if integrator == "implicit" else AppliedForceMass
        return kind(MASS_COUPLING, PERIOD, mass).force

    return limit_of(make_environment, hand)


def _checks() -> tuple[list[Check], list[tuple[str, ...]]]:
    checks, rows = [], []
    for mass, kept in KEPT.items():
        cells = [f"{mass:g}"]
        for delay, (integrator, expected) in enumerate(zip(SHOWN, kept, strict=True)):
            what = f"m = {mass:g} kg, j = {delay}: "
            closed = float(environment_minimum_damping(MASS_COUPLING, PERIOD, mass, integrator))
            loop = SampledLoop(MASS_COUPLING, PERIOD, mass=mass, integrator=integrator)
            in_time = stability_limit(loop)
            checks.append(
                Check(
                    quantity=f"{what}b needed, to four decimals",
                    route="closed form, against the value kept here",
                    expected=expected,
                    got=closed,
                    unit="N s/m",
                    tolerance=_FOUR_DECIMALS,
                )
            )
            checks.append(
                Check(
                    quantity=f"{what}b at the limit of stability",
                    route="time-domain loop with the worst hand, bisection",
                    expected=closed,
                    got=in_time,
                    unit="N s/m",
                    tolerance=1e-3,
                )
            )
            if np.isfinite(closed):
                checks.append(
                    Check(
                        quantity=f"{what}b needed",
                        route="the inequality above, swept over frequency",
                        expected=closed,
                        got=_swept(mass, delay),
                        unit="N s/m",
                        tolerance=1e-6,
                    )
                )
            cell = f"{closed:.4f} / {in_time:.4f}" if np.isfinite(closed) else "unstable"
            if integrator != "explicit":
                measured = smallest_mass_in_mujoco(mass, integrator)
                checks.append(
                    Check(
                        quantity=f"{what}b at the limit of stability",
                        route="MuJoCo in the loop, bisection",
                        expected=closed,
                        got=measured,
                        unit="N s/m",
                        tolerance=2e-3,
                    )
                )
                cell += f" / {measured:.4f}"
            cells.append(cell)
        rows.append(tuple(cells))
    return checks, rows


def virtual_mass_section() -> Section:
    """Walks through (19) and its neighbours.

    The page with (19) is lost in the copy that this walk follows; the equation is reconstructed
    from (17), the coupling (4) and the condition for a known environment. j counts the samples
    from the force to the position of the mass.

    An implicit mass may be as light as one likes. With a force before the step the need grows
    without limit as the mass falls to (T/2)(KT/2 + B). With explicit Euler the mass must exceed
    B² T/(B − KT), and for B ≤ KT no mass is heavy enough.
    """
    # finer where the explicit mass is about to be unstable
    masses = np.union1d(np.geomspace(1e-3, 1, 400), np.linspace(4e-3, 4.4e-3, 100))
    figure, (axes, damper) = panels(1, height=4.4, columns=2)
    for integrator, colour in zip(SHOWN, ("C0", "C1", "C3"), strict=True):
        needed = np.asarray(environment_minimum_damping(MASS_COUPLING, PERIOD, masses, integrator))
        shown = np.where(np.isfinite(needed), needed, np.nan)
        axes.semilogx(
            1e3 * masses,
            shown,
            color=colour,
            label=MASS_NAMES[integrator],
            ls="--" if integrator == "explicit" else "-",
        )
        min_mass = 1e3 * float(minimum_mass(MASS_COUPLING, PERIOD, integrator))
        if min_mass > 0:
            delay = SHOWN.index(integrator)
            name = f"least stable mass, j = {delay}: {min_mass:g} g"
            axes.axvline(min_mass, color=colour, ls=(":", (0, (1, 3)))[delay - 1], label=name)
    axes.axhline(K * PERIOD / 2 + B, color="k", lw=0.8, ls="-.", label="KT/2 + B, (6)")
    axes.set(xlabel="virtual mass (g)", ylabel="device damping needed (N s/m)", ylim=(0, 8))
    axes.legend(fontsize="x-small", loc="upper right")
    draw_least_mass(damper, K, PERIOD)

    checks, rows = _checks()
    least: dict[Integrator, float] = {
        "semi_implicit": PERIOD / 2 * (K * PERIOD / 2 + B),
        "explicit": B**2 * PERIOD / (B - K * PERIOD),
    }
    for integrator, expected in least.items():
        checks.append(
            Check(
                quantity=f"least stable mass, {MASS_NAMES[integrator]}",
                route="time-domain loop, handle held still, bisection",
                expected=expected,
                got=min_stable_mass(MASS_COUPLING, PERIOD, integrator),
                unit="kg",
                tolerance=1e-3,
            )
        )
    return Section(
        equation="(19)",
        title="A mass behind the coupling (the lost page)",
        formulas=(
            "b > [ b<sub>0</sub>′ + (T/2) λ A ] / |1 − λ C e<sup>−jθ</sup>|²&emsp;(19), j = 2",
            "j = 1:&ensp;b > [ b<sub>0</sub>′ − (T/2) λ A ] / |1 − λ C|²&emsp;&emsp;"
            "j = 0:&ensp;b > [ b<sub>0</sub>′ − (T/2) λ A sin(3θ/2)/sin(θ/2) ] / "
            "|1 − λ C e<sup>jθ</sup>|²",
            "λ = T²/(4 m sin²(θ/2)), &ensp; A = |C|², &ensp; b<sub>0</sub>′ = KT/2 − B cos θ; "
            "&ensp;for all θ, and the mass must be stable behind a handle held still",
        ),
        paragraphs=explained(virtual_mass_section.__doc__),
        name="virtual_mass",
        caption=f"Left: damping needed over the mass, K = {K:g} N/m, B = {B:g} N s/m, T = 1 ms. "
        "Where the blue and the red curve both exist they fall together, but for the last "
        "percents before the explicit mass is unstable by itself. Right: the mass above "
        "which the tool is stable by itself; under explicit Euler there is none for B ≤ "
        "KT.",
        figure=figure,
        checks=checks,
        table=Table(
            (
                "mass (kg)",
                "j = 0: closed form / loop / MuJoCo",
                "j = 1: closed form / loop / MuJoCo",
                "j = 2: closed form / loop (N s/m)",
            ),
            tuple(rows),
        ),
    )
