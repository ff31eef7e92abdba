"""The lost equation (19): a mass behind the coupling, and what its integrator costs."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hapticbridge.coupling import Coupling
from hapticbridge.study.paper.check import Check
from hapticbridge.study.paper.drawing import panels
from hapticbridge.study.paper.in_mujoco import AppliedForceMass, ImplicitMass, limit_of
from hapticbridge.study.paper.least_mass import NAMES, draw_least_mass, least_stable_mass
from hapticbridge.study.paper.section import Curve, Section, Table
from hapticbridge.theory.sampled_loop import SampledLoop, WorstHand, stability_limit
from hapticbridge.theory.virtual_mass import Integrator, environment_minimum_damping, minimum_mass

PERIOD = 1e-3
"""T in s."""

COUPLING = Coupling(1000.0, 2.0, 0.0, 0.0)
K, B = COUPLING.stiffness, COUPLING.damping

SCHEMES: tuple[Integrator, ...] = ("implicit", "semi_implicit", "explicit")
KEPT: dict[float, tuple[float, float, float]] = {
    0.002: (1.5385, 6.6667, np.inf),
    0.005: (2.0, 3.3333, 2.0),
    0.01: (2.2222, 2.8571, 2.2222),
    0.05: (2.4390, 2.5641, 2.4390),
}
"""Damping needed in N s/m for j = 0, 1, 2 by mass in kg, kept to four decimals: a change of the
closed form shows even if the loop changed with it."""

_FOUR_DECIMALS = 4e-5
"""Relative: what rounding to four decimals leaves of the smallest, 5e-5 of 1.5385, and a little
more."""


def _swept(mass: float, delay: int) -> float:
    """The inequality as it stands on the page, at 20 000 angles."""
    theta = np.linspace(1e-3, np.pi, 20_000)
    sine = np.sin(theta / 2)
    transfer = K + B / PERIOD * (1 - np.exp(-1j * theta))
    share = PERIOD**2 / (4 * mass * sine**2)
    sign = (-np.sin(1.5 * theta) / sine, -1.0, 1.0)[delay]
    own = K * PERIOD / 2 - B * np.cos(theta)
    top = own + sign * PERIOD / 2 * share * np.abs(transfer) ** 2
    turned = 1 - share * transfer * np.exp(1j * (1 - delay) * theta)
    return float(np.max(top / np.abs(turned) ** 2))


def _in_mujoco(mass: float, integrator: Integrator) -> float:
    loop = SampledLoop(COUPLING, PERIOD, mass=mass, integrator=integrator)
    frequency = loop.worst_frequency()
    response = complex(loop.response(frequency))

    def hand(damping: float) -> WorstHand:
        return WorstHand(damping, frequency, PERIOD, response)

    def felt() -> Callable[[float], float]:
        kind = ImplicitMass if integrator == "implicit" else AppliedForceMass
        return kind(COUPLING, PERIOD, mass).force

    return limit_of(felt, hand)


def _checks() -> tuple[list[Check], list[tuple[str, ...]]]:
    checks, rows = [], []
    for mass, kept in KEPT.items():
        cells = [f"{mass:g}"]
        for delay, (integrator, expected) in enumerate(zip(SCHEMES, kept, strict=True)):
            what = f"m = {mass:g} kg, j = {delay}: "
            closed = float(environment_minimum_damping(COUPLING, PERIOD, mass, integrator))
            loop = SampledLoop(COUPLING, PERIOD, mass=mass, integrator=integrator)
            in_time = stability_limit(loop)
            checks.append(
                Check(
                    equation="(19)",
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
                    equation="(19)",
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
                        equation="(19)",
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
                measured = _in_mujoco(mass, integrator)
                checks.append(
                    Check(
                        equation="(19)",
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


def section() -> Section:
    """Walks through (19) and its neighbours."""
    # finer where the explicit mass is about to be unstable
    masses = np.union1d(np.geomspace(1e-3, 1, 400), np.linspace(4e-3, 4.4e-3, 100))
    figure, (axes, damper) = panels(1, height=4.4, columns=2)
    for integrator, colour in zip(SCHEMES, ("C0", "C1", "C3"), strict=True):
        needed = np.asarray(environment_minimum_damping(COUPLING, PERIOD, masses, integrator))
        shown = np.where(np.isfinite(needed), needed, np.nan)
        axes.semilogx(
            1e3 * masses,
            shown,
            color=colour,
            label=NAMES[integrator],
            ls="--" if integrator == "explicit" else "-",
        )
        least_mass = 1e3 * float(minimum_mass(COUPLING, PERIOD, integrator))
        if least_mass > 0:
            delay = SCHEMES.index(integrator)
            name = f"least stable mass, j = {delay}: {least_mass:g} g"
            axes.axvline(least_mass, color=colour, ls=(":", (0, (1, 3)))[delay - 1], label=name)
    axes.axhline(K * PERIOD / 2 + B, color="k", lw=0.8, ls="-.", label="KT/2 + B, (6)")
    axes.set_ylim(0, 8)
    axes.set_xlabel("virtual mass (g)")
    axes.set_ylabel("device damping needed (N s/m)")
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
                equation="(19)",
                quantity=f"least stable mass, {NAMES[integrator]}",
                route="time-domain loop, handle held still, bisection",
                expected=expected,
                got=least_stable_mass(COUPLING, PERIOD, integrator),
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
        paragraphs=(
            "The page with (19) is lost in the copy that this walk follows; the equation is "
            "reconstructed from (17), the coupling (4) and the condition for a known environment. "
            "j counts the samples from the force to the position of the mass.",
            "An implicit mass may be as light as one likes. With a force before the step the need "
            "grows without limit as the mass falls to (T/2)(KT/2 + B). With explicit Euler the "
            "mass must exceed B² T/(B − KT), and for B ≤ KT no mass is heavy enough.",
        ),
        curves=(
            Curve(
                "virtual_mass",
                f"Left: damping needed over the mass, K = {K:g} N/m, B = {B:g} N s/m, T = 1 ms. "
                "Where the blue and the red curve both exist they fall together, but for the last "
                "percents before the explicit mass is unstable by itself. Right: the mass above "
                "which the tool is stable by itself; under explicit Euler there is none for B ≤ "
                "KT.",
                figure,
            ),
        ),
        checks=tuple(checks),
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
