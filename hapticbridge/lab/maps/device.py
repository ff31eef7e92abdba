"""Map ``device``: effect of encoder steps and dry friction of a device on a wall.

Diolaiti's regions are those of a spring alone, B = 0, where no method reduces the damping. The law
is then equal for ``implicit``, ``compensated`` and ``lossless``, and one of them is run. With a
damper they differ by their B', and each is measured.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.device import Hand, Motion, SimulatedDevice
from hapticbridge.lab.closed_loop import LoopOutcome
from hapticbridge.lab.maps import base
from hapticbridge.lab.maps.base import PERIOD, Point, Sentences
from hapticbridge.lab.maps.twins import NO_LIMITS, UNGUARDED_OPTIONS, Run, Twins
from hapticbridge.lab.methods import METHODS
from hapticbridge.plotting import new_figure
from hapticbridge.sweep import Table
from hapticbridge.theory.z_width import quantization_limit

RANGE = (0.1, 2.0)
"""Ranges of β and of σ, even in their logarithms."""

METHODS_SHOWN = ("implicit", "compensated", "lossless")
"""Methods whose required friction is measured; the bounds allow them on a real device."""

DAMPERS = (0.0, 3.0)
"""Range of requested B in N s/m for the friction that a coupling's damper needs. K T/2 and K T,
below which ``lossless`` and ``compensated`` use none, are 1 and 2."""

REGIONS = ("passive", "locally stable", "bounded limit cycle", "unstable")

STIFFNESS = 2000.0
"""Stiffness K in N/m. Results depend on β = b/(K T) and σ = f_c/(K Δ), and slightly on the mass."""

RESOLUTION = 1e-5
"""Resolution Δ in m: an encoder of 10 µm at the handle."""

QUANTUM = STIFFNESS * RESOLUTION
"""Step K Δ of the force in N."""

DEVICE_MASS = 0.1
"""Mass m_d in kg of the default simulated device."""

PRESSED = 5.5
"""Force of the hand in steps of K Δ. The half matters: the wall can answer with five or six steps,
each wrong by half a step. Friction of half a step then holds the device."""

LARGE = 3000.0
"""Knock of the second run in steps of the encoder: 3 cm. Friction takes 4 σ steps per swing from
any motion. It alone can stop a smaller knock even where the damping does not suffice."""

WALL_MASS = 1e9
"""Mass in kg of a tool that the hand's press moves by 2e-9 m in a run, a five thousandth of a
step."""

TICKS = 6000
"""Ticks of a knocked run; a run that is only pressed has settled after half of them."""

CHANGED = 0.02
"""Share by which the range of motion must rise or fall between the last two sixths of a run,
without unit. A smaller share would count the beat of a cycle with the samples."""

NOTHING = 2.0
"""Range in steps of the encoder up to which motion counts as the cycle across one border, neither
rising nor falling."""

DIVERGED = 3.0
"""Multiple of the knock beyond which motion counts as diverged, without unit. A free device
overshoots at most to its start."""

FRICTION = (0.01, 10.0)
"""Range of the search for the σ at which a pressed device rests."""

DAMPED = 5.0
"""Device damping b in N s/m while B is varied, above K T/2 + B throughout."""

SHAKEN = 0.05
"""Stroke of the shaken hand in steps of the encoder. It is small, so that the device's own damping
absorbs nothing and does not help friction."""


def region_of(small: str, large: str) -> str:
    """Returns the region that two runs show.

    Args:
        small: Outcome for a device that was only pressed, as ``settle`` names it.
        large: Outcome for a device that was knocked as well. If it ``falls`` until the end,
            ``small`` gives the state that it falls to.
    """
    if "diverges" in {small, large}:
        return "locally stable" if small == "rest" else "unstable"
    is_passive = small == "rest" and large in {"rest", "falls"}
    return "passive" if is_passive else "bounded limit cycle"


def settle(
    beta: float, sigma: float, knock: float, damping: float = 0.0, name: str = "implicit"
) -> tuple[str, float, LoopOutcome]:
    """Runs a device that a hand presses on a wall, after a knock.

    Args:
        beta: b/(K T), without unit, >= 0.
        sigma: f_c/(K Δ), without unit, >= 0.
        knock: Displacement at the start in steps of the encoder.
        damping: Requested B in N s/m, >= 0. At 0 all of ``METHODS_SHOWN`` have one law.
        name: The method.

    Returns:
        ``rest``, ``cycle`` (motion that neither ends nor grows), ``falls`` (motion still decreases)
        or ``diverges``; the range of the reported position in the last sixth in steps of the
        encoder; and the run.
    """
    device = pressed_device(beta, sigma)
    start = np.array([knock * RESOLUTION, 0.0, 0.0, 0.0, 0.0, 0.0])
    ticks = TICKS if knock else TICKS // 2
    run = _wall(name, device, damping, ticks, start)
    steps = run.records["device_position"][:, 0] / RESOLUTION
    width = ticks // 6
    if run.ticks < ticks or np.abs(steps).max() > DIVERGED * max(knock, 2 * PRESSED):
        return "diverges", float(np.ptp(steps[-width:])), run
    before, last = float(np.ptp(steps[-2 * width : -width])), float(np.ptp(steps[-width:]))
    if last == 0:
        return "rest", last, run
    if last > NOTHING and last > before * (1 + CHANGED):
        return "diverges", last, run
    if last > NOTHING and last < before * (1 - CHANGED):
        return "falls", last, run
    return "cycle", last, run


def pressed_device(beta: float, sigma: float) -> SimulatedDevice:
    """Returns a device with friction and encoder steps whose hand presses it on the wall.

    Args:
        beta: b/(K T), without unit, >= 0.
        sigma: f_c/(K Δ), without unit, >= 0.
    """
    return SimulatedDevice(
        mass=DEVICE_MASS,
        damping=beta * STIFFNESS * PERIOD,
        friction=sigma * QUANTUM,
        resolution=RESOLUTION,
        hand=base.STEADY_HAND,
        path=base.pressing((0.02, PRESSED * QUANTUM)),
        force_limit=10.0,
        torque_limit=10.0,
    )


def _wall(
    name: str, device: SimulatedDevice, damping: float, ticks: int, knock: NDArray[np.float64]
) -> LoopOutcome:
    return base.wall_loop(WALL_MASS).run(
        device,
        Coupling(STIFFNESS, damping, 0.0, 0.0),
        METHODS[name],
        period=PERIOD,
        ticks=ticks,
        knock=knock,
        keep_records=True,
    )


def friction_needed(name: str, damping: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the σ that theory requires, ½ + B'/(K T): f_c = K Δ/2 + B' Δ/T.

    Args:
        name: The method, whose law uses B'.
        damping: Requested B in N s/m, >= 0.

    References:
        Abbott & Okamura 2005.
    """
    return 0.5 + base.used_damping(name, STIFFNESS, damping) / (PERIOD * STIFFNESS)


def friction_to_rest(name: str, damping: float) -> float:
    """Returns a σ at which a pressed device begins to come to rest.

    The result is 0 if the device rests at the smallest σ tried, and inf if it never rests. With a
    damper, rest and cycle alternate between K Δ/2 and slightly above; one of the changes is found.

    Args:
        name: The method.
        damping: Requested B in N s/m, >= 0.
    """
    beta = DAMPED / (STIFFNESS * PERIOD)
    return base.largest_stable(
        lambda sigma: settle(beta, sigma, 0.0, damping, name)[0] != "rest", *FRICTION
    ).middle


def shaken(name: str, damping: float) -> float:
    """Returns the σ that absorbs the motor's work on a hand that shakes it across one step.

    The hand is stiff and moves the device to and fro across a border between two encoder steps,
    once a tick; the motor's work on it, over the way, is the friction that would take it.

    Args:
        name: The method.
        damping: Requested B in N s/m, >= 0.
    """
    ticks = 400
    side = np.where(np.arange(ticks + 2) % 2 == 0, -0.5, 0.5) * SHAKEN
    side[0] = 0.0
    # a border lies half a step from the device's start, and the hand goes there first
    way = np.concatenate([[0.0, 0.0], np.full(50, 0.5), 0.5 + side]) * RESOLUTION
    path = np.zeros((way.size, 3))
    path[:, 0] = way
    device = SimulatedDevice(
        mass=1e-3,
        damping=DAMPED,
        resolution=RESOLUTION,
        hand=Hand(mass=0.0, damping=1e6, stiffness=1e9),
        path=Motion(PERIOD * np.arange(way.size), path),
    )
    run = _wall(name, device, damping, way.size - 1, np.zeros(6))
    first = way.size - 300
    force = run.records["wrench_on_device"][first:-1, 0]
    moved = np.diff(way)[first : first + force.size]
    return float((force * moved).sum() / np.abs(moved).sum() / QUANTUM)


COLOURS = (base.COLOURS[0], "#8fb8de", base.COLOURS[1], base.COLOURS[3])
"""Colours of the regions: those of the verdicts from strict to unstable, and a separate one where
the outcome depends on the knock."""

MARKERS = {"shaken": "o", "pressed": "s"}

WORDS = {"shaken": "shaken across a step", "pressed": "pressed, comes to rest"}
"""Meaning of each marker."""

SIZES = (7.0, 5.5, 3.5)
"""Sizes of the methods' markers in points, and three times their lines' widths. ``compensated`` and
``lossless`` coincide where they use no damper, and all must be visible."""


def draw(table: Table, boundary: Mapping[str, Any]) -> Figure:
    """Draws the regions, and beside them the required friction at each damper."""
    figure = new_figure(8, 5.4)
    left, right = figure.subplots(1, 2, width_ratios=(1.1, 1))
    _draw_regions(left, table.select(table["what"] == "cell"))
    _draw_friction(right, boundary["friction"])
    figure.suptitle(
        f"Encoder steps of Δ = {1e6 * RESOLUTION:g} µm against dry friction f_c: a device of\n"
        f"{1e3 * DEVICE_MASS:g} g pressed on a wall, K = {STIFFNESS:g} N/m, {1 / PERIOD:g} Hz",
        fontsize="medium",
    )
    figure.legend(
        handles=[
            *(Patch(facecolor=c, label=r) for r, c in zip(REGIONS, COLOURS, strict=True)),
            Line2D([], [], color="black", label="β = ½, σ = ½ (Diolaiti)"),
        ],
        title="measured (colours) and predicted (lines)",
        title_fontsize="small",
        fontsize="small",
        loc="outside lower center",
        ncols=5,
        columnspacing=1.2,
        frameon=False,
    )
    return figure


def _draw_regions(axes: Axes, cells: Table) -> None:
    axes.set(xscale="log", yscale="log")
    if len(cells):
        number = np.array([REGIONS.index(name) for name in cells["region"]])
        beta, sigma = np.unique(cells["beta"]), np.unique(cells["sigma"])
        grid = np.full((sigma.size, beta.size), np.nan)
        grid[np.searchsorted(sigma, cells["sigma"]), np.searchsorted(beta, cells["beta"])] = number
        axes.pcolormesh(
            beta, sigma, grid, cmap=ListedColormap(COLOURS), vmin=-0.5, vmax=3.5, shading="nearest"
        )
        for place, name in {
            (1.0, 1.0): REGIONS[0],
            (0.22, 1.0): REGIONS[1],
            (1.0, 0.22): REGIONS[2],
            (0.22, 0.22): REGIONS[3],
        }.items():
            axes.text(*place, f"theory:\n{name}", ha="center", va="center", fontsize="small")
    else:
        base.say_missing(axes)
    axes.axvline(0.5, color="black", lw=1.8)
    axes.axhline(0.5, color="black", lw=1.8)
    axes.set(xlim=RANGE, ylim=RANGE)
    ticks = (0.1, 0.2, 0.5, 1.0, 2.0)
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    axes.set(
        xlabel="damping of the device, β = b/(K T)", ylabel="friction of the device, σ = f_c/(K Δ)"
    )
    axes.set_title("B = 0: pressed, and knocked; one law", fontsize="medium")


def _draw_friction(axes: Axes, tables: Mapping[str, Any]) -> None:
    axes.set(xlabel="requested coupling damping B (N s/m)", ylabel="friction needed, f_c/(K Δ)")
    axes.set_title(f"with a damper, b = {DAMPED:g} N s/m", fontsize="medium")
    if not tables:
        base.say_missing(axes)
        return
    for name, size in zip(METHODS_SHOWN, SIZES, strict=True):
        if name in tables:
            selected, colour = tables[name], base.METHOD_COLOURS[name]
            style: dict[str, Any] = {"color": colour, "mfc": "white", "ls": "", "ms": size}
            axes.plot(
                selected["damping"],
                selected["predicted"],
                color=colour,
                lw=size / 3,
                label=f"{name}: {base.law_in_words(name)}",
            )
            for what, marker in MARKERS.items():
                axes.plot(selected["damping"], selected[what], marker, **style)
    for what, marker in MARKERS.items():
        axes.plot([], [], marker, color="black", mfc="white", label=f"measured: {WORDS[what]}")
    # room above for the names
    axes.set_ylim(0, 1.75 * max(max(selected["predicted"]) for selected in tables.values()))
    lines = Line2D([], [], ls="", label="lines: f_c = K Δ/2 + B′ Δ/T")
    axes.legend(
        handles=[lines, *axes.get_legend_handles_labels()[0]], fontsize="small", loc="upper left"
    )


DEFAULT_POINTS = 400
"""Approximate number of points by default."""


def points(count: int) -> Sequence[Point]:
    """Returns a grid of β and σ, and dampers by method at which the friction needed is measured."""
    side = max(3, round(count**0.5))
    values = np.geomspace(*RANGE, side)
    cells: list[Point] = [
        _point("cell", METHODS_SHOWN[0], float(beta), float(sigma), 0.0)
        for beta in values
        for sigma in values
    ]
    dampers: list[Point] = [
        _point("friction", name, 0.0, 0.0, float(damping))
        for name in METHODS_SHOWN
        for damping in np.linspace(*DAMPERS, max(3, side // 3))
    ]
    return cells + dampers


def _point(what: str, method: str, beta: float, sigma: float, damping: float) -> Point:
    return {"what": what, "method": method, "beta": beta, "sigma": sigma, "damping": damping}


def evaluate(point: Point) -> Mapping[str, float | str | bool]:
    """Lets a pressed device settle from rest and from a large knock, and names the outcome.

    A point with a damper measures the friction that absorbs its energy instead.
    """
    if point["what"] == "friction":
        law = str(point["method"]), float(point["damping"])
        return {"needed_at_rest": friction_to_rest(*law), "needed_shaken": shaken(*law)}
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


def summarize(table: Table) -> dict[str, Any]:
    """Compares regions over β and σ, and the friction that a damper needs, with theory."""
    cells = table.select(table["what"] == "cell")
    dampers = {name: base.of_method(table, "friction", name) for name in METHODS_SHOWN}
    return {
        "period": PERIOD,
        "stiffness": STIFFNESS,
        "resolution": RESOLUTION,
        "regions": _regions(cells) if len(cells) else {},
        "friction": {
            name: _friction(name, selected) for name, selected in dampers.items() if len(selected)
        },
    }


def _regions(cells: Table) -> dict[str, Any]:
    cycle = cells.numbers("cycle")[cells["region"] == "bounded limit cycle"]
    return {
        "points": {name: int((cells["region"] == name).sum()) for name in REGIONS},
        "agreement": float(np.mean(cells["region"] == predicted_regions(cells))),
        "measured_edges": _edges(cells),
        "predicted_edges": {"beta": 0.5, "sigma": 0.5},
        "largest_cycle_steps": float(cycle.max()) if cycle.size else None,
        "median_cycle_steps": float(np.median(cycle)) if cycle.size else None,
    }


def _friction(name: str, dampers: Table) -> dict[str, Any]:
    """Returns σ that a method needs at each B, measured twice and by theory."""
    predicted = friction_needed(name, dampers["damping"])
    shaken_needs = dampers.numbers("needed_shaken")
    return {
        "damping": dampers["damping"].tolist(),
        "predicted": predicted.tolist(),
        "shaken": shaken_needs.tolist(),
        "pressed": dampers.numbers("needed_at_rest").tolist(),
        "worst_ratio_error": float(np.abs(shaken_needs / predicted - 1).max()),
    }


def sentences(boundary: Mapping[str, Any]) -> Sentences:
    """States the agreement with Diolaiti's regions, and the friction that each damper needs."""
    regions = boundary["regions"]
    yield "The runs agree with Diolaiti's regions at {agreement:.0%} of the points", regions
    edges = regions.get("measured_edges", {})
    yield "Divergence ends at β = {last:.2f} to {first:.2f} (theory: ½)", edges.get("beta")
    yield (
        "A press comes to rest from σ = {last:.2f} to {first:.2f} on (theory: ½)",
        edges.get("sigma"),
    )
    yield (
        "The largest bounded limit cycle spans {largest_cycle_steps:.0f} encoder steps, the median "
        "one {median_cycle_steps:.0f}",
        regions,
    )
    for name, selected in boundary["friction"].items():
        yield (
            "Shaken across one encoder step, '{name}' needs f_c = K Δ/2 + B′ Δ/T within "
            "{worst_ratio_error:.2%}",
            selected | {"name": name},
        )


def _edges(cells: Table) -> dict[str, Any]:
    """Returns brackets: β where divergence ends, σ where motion from a press ends.

    None if no run was bad, or the largest value had a bad one.
    """
    return {
        "beta": _edge(cells["beta"], cells["large"] == "diverges"),
        "sigma": _edge(cells["sigma"], cells["small"] != "rest"),
    }


def _edge(values: NDArray[np.float64], is_bad: NDArray[np.bool_]) -> dict[str, float] | None:
    """Returns the ``last`` value with a bad run, and the ``first`` value from which none is bad."""
    if not is_bad.any() or not (values > values[is_bad].max()).any():
        return None
    last = float(values[is_bad].max())
    return {"last": last, "first": float(values[values > last].min())}


def predicted_regions(cells: Table) -> NDArray[np.object_]:
    """Returns Diolaiti's region at each row, from its β and σ."""
    coupling = Coupling(STIFFNESS, 0.0, 0.0, 0.0)
    return np.array(
        [
            quantization_limit(
                float(b) * STIFFNESS * PERIOD,
                float(s) * QUANTUM,
                RESOLUTION,
                coupling,
                PERIOD,
            ).region
            for b, s in zip(cells["beta"], cells["sigma"], strict=True)
        ],
        dtype=object,
    )


TWIN_FORCE = 6.0
"""Force in N with which the twins' hand presses before it lets go: it leaves a swing of 3 mm, which
friction alone stops only if it is small."""

TWIN_SIGMA = 0.6
"""Friction of the twins' device as σ, above the ½ at which a pressed device rests."""

TWIN_BETAS = (0.4, 0.6)
"""Dampings of the twins' devices as β, on both sides of ½."""


def twins() -> Twins:
    """Returns a hand that lets go of a wall, with less device damping than K T/2 and with more."""
    path = base.pressing((0.02, TWIN_FORCE), (0.1, TWIN_FORCE), (0.101, PRESSED * QUANTUM))

    def run(damping: float) -> Run:
        return Run(
            scene=partial(base.free_wall, WALL_MASS),
            device=partial(
                SimulatedDevice,
                mass=DEVICE_MASS,
                damping=damping,
                friction=TWIN_SIGMA * QUANTUM,
                resolution=RESOLUTION,
                hand=base.STEADY_HAND,
                path=path,
                **NO_LIMITS,
            ),
            coupling=Coupling(STIFFNESS, 0.0, 0.0, 0.0),
            options=replace(UNGUARDED_OPTIONS, method=METHODS_SHOWN[0], rate=1 / PERIOD),
            duration=2.0,
        )

    fails, safe = (beta * STIFFNESS * PERIOD for beta in TWIN_BETAS)
    return Twins(
        shared=f"A hand lets go of a wall after pressing with {TWIN_FORCE:g} N, "
        f"K = {STIFFNESS:g} N/m, friction {1e3 * TWIN_SIGMA * QUANTUM:g} mN, encoder steps of "
        f"{1e6 * RESOLUTION:g} µm",
        name="device damping",
        unit="N s/m",
        values=(fails, safe),
        run=run,
    )
