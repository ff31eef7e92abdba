"""How light a tool may be by itself, by integrator: what belongs to (19)."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from hapticbridge.coupling import Coupling
from hapticbridge.theory.sampled_loop import SampledLoop, threshold
from hapticbridge.theory.transfer import CouplingGrid
from hapticbridge.theory.virtual_mass import Integrator, minimum_mass

NAMES: dict[Integrator, str] = {
    "implicit": "implicit Euler, j = 0",
    "semi_implicit": "force before the step, j = 1",
    "explicit": "explicit Euler, j = 2: (19)",
}


def draw_least_mass(axes: Axes, stiffness: float, period: float) -> None:
    """Draws the mass that a tool must exceed, over the damper.

    Args:
        axes: Where.
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
            label=NAMES[integrator],
        )
    axes.axvspan(0, own, color="C3", alpha=0.12, label="j = 2, B ≤ KT: no mass suffices")
    axes.plot(
        2 * own, 4e3 * stiffness * period**2, "o", color="C3", ms=5, label="j = 2: 4KT² at B = 2KT"
    )
    axes.set_xlim(0, 5 * own)
    axes.set_ylim(0, 14)
    axes.set_xlabel("coupling damping B (N s/m)")
    axes.set_ylabel("least stable mass (g)")
    axes.legend(fontsize="x-small", loc="upper right")


def least_stable_mass(coupling: Coupling, period: float, integrator: Integrator) -> float:
    """Finds the mass in kg at which the loop with the handle held still begins to decay."""
    samples = 20_000

    def does_decay(mass: float) -> bool:
        loop = SampledLoop(coupling, period, mass=mass, integrator=integrator)
        force = np.abs(loop.simulate(None, samples).force)
        third = samples // 3
        is_whole = force.size == samples
        return is_whole and bool(force[-third:].max() <= force[-2 * third : -third].max())

    # from 10 g on by powers of ten
    return threshold(does_decay, 1e-2, 1e-5)
