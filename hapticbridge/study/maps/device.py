"""Map ``device``: what encoder steps and dry friction of a device make of a wall."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.patches import Patch
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.device import SimulatedDevice
from hapticbridge.passivity import quantization_limit
from hapticbridge.picture import new_figure
from hapticbridge.study.maps.device_runs import (
    DAMPED,
    DEVICE_MASS,
    LARGE,
    PERIOD,
    QUANTUM,
    RESOLUTION,
    STIFFNESS,
    friction_to_rest,
    region_of,
    settle,
    shaken,
)
from hapticbridge.study.maps.stability_map import Finding, Point, StabilityMap
from hapticbridge.study.table import Table

RANGE = (0.1, 2.0)
"""Of β and of σ, even in their logarithms."""

DAMPERS = (0.0, 1.5)
"""Range of B in N s/m for the friction that a coupling's damper needs."""

REGIONS = ("passive", "locally stable", "bounded limit cycle", "unstable")
COLOURS = ("#a8d5ba", "#8fb8de", "#f4e3a1", "#c0504d")


def points(count: int) -> Sequence[Point]:
    """Returns a grid of β and σ, and some dampers at which the friction needed is measured."""
    side = max(3, round(count**0.5))
    values = np.geomspace(*RANGE, side)
    cells: list[Point] = [
        {"what": "cell", "beta": float(beta), "sigma": float(sigma), "damping": 0.0}
        for beta in values
        for sigma in values
    ]
    dampers: list[Point] = [
        {"what": "friction", "beta": 0.0, "sigma": 0.0, "damping": float(damping)}
        for damping in np.linspace(*DAMPERS, max(3, side // 3))
    ]
    return cells + dampers


def evaluate(point: Point) -> Mapping[str, float | str | bool]:
    """Lets a pressed device settle from where it is and from a large knock, and says what it did.

    Or measures the friction that pays for a coupling's damper.
    """
    if point["what"] == "friction":
        damping = float(point["damping"])
        return {"needed_at_rest": friction_to_rest(damping), "needed_shaken": shaken(damping)}
    beta, sigma = float(point["beta"]), float(point["sigma"])
    small, small_range, _ = settle(beta, sigma, 0.0)
    large, large_range, run = settle(beta, sigma, LARGE)
    return {
        "small": small,
        "large": large,
        "region": region_of(small, large),
        "cycle": small_range if small == "cycle" else large_range if large == "cycle" else 0.0,
        "last_range": large_range,
        "ticks": run.ticks,
        "device_energy": run.device_energy,
    }


def read(table: Table) -> Finding:
    """Draws the regions over β and σ, the cycles' size, and the friction that a damper needs."""
    cells = table.select(table["what"] == "cell")
    dampers = table.select(table["what"] == "friction")
    figure = new_figure(10, 5.4)
    left, right = figure.subplots(1, 2, width_ratios=(1.35, 1))
    agreed = _draw_regions(left, cells)
    predicted = 0.5 + dampers["damping"] / (PERIOD * STIFFNESS)
    right.plot(dampers["damping"], predicted, color="black", label="f_c = KΔ/2 + BΔ/T")
    for name, marker, label in (
        ("needed_shaken", "o", "measured: hand shakes it across a step"),
        ("needed_at_rest", "s", "measured: pressed device rests"),
    ):
        right.plot(
            dampers["damping"], dampers[name], marker, color="black", mfc="white", label=label
        )
    right.set_xlabel("coupling damping B (N s/m)")
    right.set_ylabel("friction needed, f_c/(K Δ)")
    right.set_ylim(0, 1.15 * float(predicted.max()))
    right.set_title(f"friction against the damper, b = {DAMPED:g} N s/m", fontsize="medium")
    right.legend(fontsize="small")
    figure.suptitle(
        f"Encoder steps of Δ = {1e6 * RESOLUTION:g} µm against friction f_c: device of "
        f"{1e3 * DEVICE_MASS:g} g pressed on a wall, K = {STIFFNESS:g} N/m, {1 / PERIOD:g} Hz",
        fontsize="medium",
    )
    figure.legend(
        handles=[
            *(Patch(facecolor=c, label=r) for r, c in zip(REGIONS, COLOURS, strict=True)),
            left.plot([], [], color="black", label="β = ½, σ = ½ (Diolaiti)")[0],
        ],
        loc="outside lower center",
        ncols=5,
        frameon=False,
    )
    edges = _edges(cells)
    cycle = cells["cycle"][cells["region"] == "bounded limit cycle"]
    largest = f"{cycle.max():.0f}, median {np.median(cycle):.0f}" if cycle.size else "none"
    error = float(np.abs(dampers["needed_shaken"] / predicted - 1).max())
    return Finding(
        figure,
        f"What the runs did agrees with Diolaiti's regions at {100 * agreed:.0f} % of the points: "
        + ", ".join(f"{name} {int((cells['region'] == name).sum())}" for name in REGIONS)
        + f". Divergence ends at β = {_said(edges['beta'])}, and the pressed device comes to rest "
        f"from σ = {_said(edges['sigma'])} on (theory: both ½). Largest bounded limit cycle "
        f"in encoder steps, peak to peak: {largest}. With a damper, a hand that shakes the device "
        f"across one encoder step "
        f"needs f_c = K Δ/2 + B Δ/T within {100 * error:.2g} %, while one that only presses lets "
        f"it rest from {dampers['needed_at_rest'].min():.3g} to "
        f"{dampers['needed_at_rest'].max():.3g} K Δ on, depending on B.",
        {
            "period": PERIOD,
            "stiffness": STIFFNESS,
            "resolution": RESOLUTION,
            "agreement": agreed,
            "measured_edges": edges,
            "predicted_edges": {"beta": 0.5, "sigma": 0.5},
            "largest_cycle_steps": float(cycle.max(initial=0.0)),
            "friction": {
                "damping": dampers["damping"].tolist(),
                "predicted": predicted.tolist(),
                "shaken": dampers["needed_shaken"].tolist(),
                "pressed": dampers["needed_at_rest"].tolist(),
            },
        },
    )


def _said(edge: Mapping[str, float] | None) -> str:
    return "no value here" if edge is None else f"{edge['last']:.2f} to {edge['first']:.2f}"


def _edges(cells: Table) -> dict[str, Any]:
    """Returns between which β divergence ends, and between which σ motion from a press ends."""
    return {
        "beta": _edge(cells["beta"], cells["large"] == "diverges"),
        "sigma": _edge(cells["sigma"], cells["small"] != "rest"),
    }


def _edge(values: NDArray[np.float64], is_bad: NDArray[np.bool_]) -> dict[str, float] | None:
    """Returns the ``last`` value with a bad run, and the ``first`` one from which none is bad."""
    if not is_bad.any() or not (values > values[is_bad].max()).any():
        return None
    last = float(values[is_bad].max())
    return {"last": last, "first": float(values[values > last].min())}


def _draw_regions(axes: Axes, cells: Table) -> float:
    """Colours the regions and returns the share that theory names alike."""
    number = np.array([REGIONS.index(name) for name in cells["region"]])
    beta, sigma = np.unique(cells["beta"]), np.unique(cells["sigma"])
    grid = np.full((sigma.size, beta.size), np.nan)
    grid[np.searchsorted(sigma, cells["sigma"]), np.searchsorted(beta, cells["beta"])] = number
    axes.pcolormesh(
        beta, sigma, grid, cmap=ListedColormap(COLOURS), vmin=-0.5, vmax=3.5, shading="nearest"
    )
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.axvline(0.5, color="black", lw=1.8)
    axes.axhline(0.5, color="black", lw=1.8)
    axes.set_xlim(*RANGE)
    axes.set_ylim(*RANGE)
    for place, name in {
        (1.0, 1.0): REGIONS[0],
        (0.22, 1.0): REGIONS[1],
        (1.0, 0.22): REGIONS[2],
        (0.22, 0.22): REGIONS[3],
    }.items():
        axes.text(*place, f"theory:\n{name}", ha="center", va="center", fontsize="small")
    ticks = (0.1, 0.2, 0.5, 1.0, 2.0)
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    axes.set_xlabel("β = b/(K T)")
    axes.set_ylabel("σ = f_c/(K Δ)")
    axes.set_title("what a pressed, and a knocked, device did (colours)", fontsize="medium")
    return float(np.mean(cells["region"] == predicted_regions(cells)))


def predicted_regions(cells: Table) -> NDArray[np.object_]:
    """Returns Diolaiti's region at each row, from its β and σ."""
    coupling = Coupling(STIFFNESS, 0.0, 0.0, 0.0)
    return np.array(
        [
            quantization_limit(
                SimulatedDevice(
                    damping=float(b) * STIFFNESS * PERIOD,
                    friction=float(s) * QUANTUM,
                    resolution=RESOLUTION,
                ).info,
                coupling,
                PERIOD,
            ).region
            for b, s in zip(cells["beta"], cells["sigma"], strict=True)
        ],
        dtype=object,
    )


DEVICE = StabilityMap(
    name="device",
    about="encoder steps against Coulomb friction of the device: Diolaiti's four regions, measured",
    default_points=400,
    points=points,
    evaluate=evaluate,
    read=read,
)
