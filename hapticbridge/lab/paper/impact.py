"""Section 4 of the paper: energy that impact laws create."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hapticbridge.lab.paper.section import Check, Section, Table, explained, panels
from hapticbridge.theory.impact import Impact, ImpactBody, Law, resolve_impact

ROD = ImpactBody(1.0, 1 / 12, np.array([-0.5, -0.5]) / np.sqrt(2))
"""Uniform rod of 1 kg and 1 m at 45°, hit at its lower tip."""
VELOCITY = np.array([0.8, -1.0])
"""Velocity of the tip before the impact, tangential and normal, in m/s."""
FRICTION, RESTITUTION = 0.75, 0.9
"""Coefficients of friction μ and of restitution e, without unit."""

KNOWN: dict[Law, tuple[float, float, float]] = {
    "newton": (0.8875, 0.2125, 0.040625),
    "poisson": (0.6175, 0.0505, -0.144055),
    "stronge": (0.703360, 0.102016, -0.097975),
}
"""Impulses P_n and P_t in N s, and change of kinetic energy in J."""

IMPACTS = 200_000
"""Number of random rods that are drawn and judged per law."""
GAINING = 0.01088
"""Share of random rods that gain energy under Newton's law, from 5 million rods with 25 other
seeds."""
COLOURS: dict[Law, str] = {"newton": "C3", "poisson": "C0", "stronge": "C2"}

_Array = NDArray[np.float64]


def _stepped(law: Law) -> float:
    """Integrates Coulomb's law in small steps of P_n; returns the energy change in J."""
    a, d, g = (float(value) for value in ROD.compliance())
    v_t, v_n = VELOCITY
    impulse = compression = work = taken = energy = 0.0
    step = 1.0 / 20_000
    while True:
        # the friction that would stop the slip within this step, bounded by Coulomb's cone
        tangential = float(np.clip((g * step - v_t) / a, -FRICTION * step, FRICTION * step))
        next_t = v_t + a * tangential - g * step
        next_n = v_n + d * step - g * tangential
        part = 0.5 * (v_n + next_n) * step
        energy += part + 0.5 * (v_t + next_t) * tangential
        work += part
        impulse += step
        v_t, v_n = next_t, next_n
        if v_n < 0:
            compression, taken = impulse, work
        elif (
            (law == "newton" and v_n >= -RESTITUTION * VELOCITY[1])
            or (law == "poisson" and impulse >= (1 + RESTITUTION) * compression)
            or (law == "stronge" and work - taken >= -(RESTITUTION**2) * taken)
        ):
            return float(energy)


def _path() -> tuple[_Array, _Array]:
    """Returns Routh's path of the rod in the plane of impulses, by the printed rules."""
    a, _, g = (float(value) for value in ROD.compliance())
    normal = np.linspace(0, 1, 200)
    corner = VELOCITY[0] / (FRICTION * a + g)
    sliding = np.minimum(normal, corner)
    return normal, -FRICTION * sliding + g / a * (normal - sliding)


def _random_gains() -> dict[Law, _Array]:
    """Returns the energy change over the kinetic energy at the contact, for random rods."""
    rng = np.random.default_rng(4)
    angle = rng.uniform(0, np.pi / 2, IMPACTS)
    arm = -0.5 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    rods = ImpactBody(np.ones(IMPACTS), np.full(IMPACTS, 1 / 12), arm)
    velocity = np.stack([rng.uniform(-3, 3, IMPACTS), -rng.uniform(1e-3, 3, IMPACTS)], axis=-1)
    friction, restitution = rng.uniform(0, 1, (2, IMPACTS))
    scale = 0.5 * np.sum(velocity**2, axis=-1)
    return {
        law: resolve_impact(rods, velocity, friction, restitution, law).energy_change / scale
        for law in KNOWN
    }


def _drawn(impacts: dict[Law, Impact], gains: dict[Law, _Array], share: dict[Law, float]) -> Figure:
    """Draws the rod's impulses by law, and the energy gain of random rods."""
    figure, (path, histogram) = panels(1, height=4.2, columns=2)
    normal, tangential = _path()
    path.plot(normal, tangential, color="k", lw=1, label="Routh's path")
    path.plot(normal, -FRICTION * normal, color="grey", ls=":", lw=1, label="cone, P_t = −μ P_n")
    for law, impact in impacts.items():
        label = f"{law}, {float(impact.energy_change):+.4f} J"
        path.plot(*impact.impulse[::-1], "o", color=COLOURS[law], label=label)
        histogram.hist(
            100 * gains[law],
            bins=[float(edge) for edge in range(-100, 41, 4)],
            weights=np.full(IMPACTS, 100 / IMPACTS),
            histtype="step",
            color=COLOURS[law],
            label=f"{law}: gains in {100 * share[law]:.2g} %",
        )
    path.axvline(0.325, color="grey", lw=0.8, ls="--", label="end of compression")
    path.set(xlabel="normal impulse P_n (N s)", ylabel="tangential impulse P_t (N s)")
    path.legend(fontsize="x-small", loc="upper left")
    path.set_ylim(-0.45, 0.55)
    histogram.axvline(0, color="k", lw=0.8)
    histogram.set(
        yscale="log",
        xlabel="change of energy over ½ m v² (%)",
        ylabel="share of random impacts (%)",
    )
    histogram.legend(fontsize="x-small", loc="upper left")
    return figure


def _checks_of_rod(law: Law, impact: Impact, stepped: float) -> list[Check]:
    """Compares a law's impact of the rod with kept numbers, small steps (J) and velocities."""
    got = float(impact.energy_change)
    is_rational = law != "stronge"
    names = ("P_n", "N s"), ("P_t", "N s"), ("change of kinetic energy", "J")
    found = float(impact.impulse[1]), float(impact.impulse[0]), got
    kept = [
        Check(
            quantity=f"rod, {law}: {quantity}",
            route="closed form, against "
            + ("the exact decimals" if is_rational else "six decimals"),
            expected=expected,
            got=value,
            unit=unit,
            tolerance=1e-12 if is_rational else 1e-5,
        )
        for (quantity, unit), expected, value in zip(names, KNOWN[law], found, strict=True)
    ]
    routes = (
        ("Coulomb's law in 20 000 steps of impulse", stepped, 2e-3),
        ("velocities of the body before and after", _by_velocities(impact.impulse), 1e-9),
    )
    return kept + [
        Check(
            quantity=f"rod, {law}: change of kinetic energy",
            route=route,
            expected=got,
            got=value,
            unit="J",
            tolerance=tolerance,
        )
        for route, value, tolerance in routes
    ]


def _checks_of_random_rods(share: dict[Law, float]) -> list[Check]:
    """Compares the shares of rods that gain energy with 0, and Newton's with its kept value."""
    checks = [
        Check(
            quantity=f"random rods, {law}: share that gains energy",
            route=f"{IMPACTS // 1000} 000 impacts",
            expected=0.0,
            got=share[law],
            tolerance=0.0,
        )
        for law in KNOWN
        if law != "newton"
    ]
    checks.append(
        Check(
            quantity="random rods, newton: share that gains energy",
            route=f"{IMPACTS // 1000} 000 impacts, against 5 million others kept here",
            expected=GAINING,
            got=share["newton"],
            # five standard deviations of a binomial share
            tolerance=5 * float(np.sqrt((1 - GAINING) / GAINING / IMPACTS)),
        )
    )
    return checks


def section() -> Section:
    """Walks through the impact argument.

    A uniform rod of 1 kg and 1 m, tilted by 45°, hits the ground with its lower tip; μ = 0.75,
    e = 0.9, (v_t, v_n) = (0.8, −1) m/s. The tip slides, then sticks while the impact still
    lasts, and from then on friction turns tangential motion into normal motion. Newton's law
    asks for a normal velocity that does not know of this, and the rod leaves with more energy
    than it had.

    Routh's path with Poisson's or Stronge's end never gains. An impact is part of the
    environment, so its law must be as passive as the integrator. MuJoCo has no law of
    restitution (its contact is soft). Rigid contacts take Newton's, as far as the blow pays for it
    (``kernel.restitution``).
    """
    gains = _random_gains()
    # rounding of two joules that cancel
    share = {law: float(np.mean(gain > 1e-12)) for law, gain in gains.items()}
    impacts = {law: resolve_impact(ROD, VELOCITY, FRICTION, RESTITUTION, law) for law in KNOWN}
    stepped = {law: _stepped(law) for law in KNOWN}
    checks = [
        check for law in KNOWN for check in _checks_of_rod(law, impacts[law], stepped[law])
    ] + _checks_of_random_rods(share)
    return Section(
        equation="§4",
        title="Impact: Newton's restitution can create energy",
        formulas=(
            "Newton:&ensp;v<sub>n</sub>⁺ = −e v<sub>n</sub>⁻&emsp;&emsp;"
            "Poisson:&ensp;P<sub>n</sub> = (1 + e) P<sub>c</sub>&emsp;&emsp;"
            "Stronge:&ensp;W<sub>r</sub> = −e² W<sub>c</sub>",
            "ΔKE = ½ P·(v⁻ + v⁺)",
        ),
        paragraphs=explained(section.__doc__),
        name="impact",
        caption="Left: the rod's impulses and where each law ends. Right: change of energy of "
        f"{IMPACTS // 1000} 000 random rods; v is the velocity of the tip.",
        figure=_drawn(impacts, gains, share),
        checks=checks,
        table=Table(
            (
                "law",
                "P_n (N s)",
                "P_t (N s)",
                "change of kinetic energy (J)",
                "the same in small steps (J)",
            ),
            tuple(
                (
                    law,
                    f"{impact.impulse[1]:.6f}",
                    f"{impact.impulse[0]:.6f}",
                    f"{float(impact.energy_change):+.6f}",
                    f"{stepped[law]:+.6f}",
                )
                for law, impact in impacts.items()
            ),
        ),
    )


def _by_velocities(impulse: _Array) -> float:
    """Returns the change of the rod's kinetic energy if the rod does not turn before the impact."""
    before = np.array([*VELOCITY, 0.0])
    after = before + ROD.velocity_change(impulse)
    inertia = np.array([1.0, 1.0, 1 / 12])
    return float(0.5 * np.sum(inertia * (after**2 - before**2)))
