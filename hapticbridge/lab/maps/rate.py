"""Map ``rate``: largest stiffness of a wall against period, delay, jitter, lost ticks, slow scenes.

At even ticks ``implicit``, ``compensated`` and ``lossless`` run with an equal requested B, each
against the bound for the B' that its law uses. A scene that steps in every n-th tick runs behind a
loop of ``UNEVEN_PERIOD``, whose bound it keeps, beside the bound of a loop as slow as the scene.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from numpy.typing import ArrayLike, NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.device import Hand, SimulatedDevice
from hapticbridge.lab.closed_loop import PARTS, LoopOutcome, Timing
from hapticbridge.lab.maps import base
from hapticbridge.lab.maps.base import Point, Sentences
from hapticbridge.lab.maps.twins import NO_LIMITS, UNGUARDED_OPTIONS, Run, Twins
from hapticbridge.lab.methods import METHODS
from hapticbridge.plotting import new_figure
from hapticbridge.sweep import Table
from hapticbridge.theory.bounds import maximum_stiffness, wall_damping
from hapticbridge.theory.sampled_loop import SampledLoop, WorstHand

THEORY_WIDTH = base.WIDTH / 100
"""Relative width of the search for the theoretical limit, far below that of a measurement."""

DEVICE_DAMPING = 2.0
"""Device damping b in N s/m, that of the default simulated device."""

DAMPING = 1.0
"""Requested B in N s/m at even ticks: half of b. The worst hand behind ``implicit`` is then at a
frequency above zero at every delay. With less, as in a method that reduces B, it is an unlimited
mass, which takes longer to show (``SWINGS``)."""

METHODS_SHOWN = ("implicit", "compensated", "lossless")
"""Methods whose limit is searched at even ticks; the bounds allow them on a real device."""

PERIODS = (1e-4, 5e-3)
"""Range of T in s, even in its logarithm."""

DELAYS = 6
"""Delays of 0 to 5 samples."""

UNEVEN_PERIOD = 1e-3
"""Period T in s for jitter and lost ticks. The coupling is a spring alone there (B = 0). With a
damper the bound at the longest interval, K = 2 (b/T_max − B/T), vanishes after the first lost
ticks. At B = 0 no method reduces the damping: on a wall all of ``METHODS_SHOWN`` have one law, and
one is run."""

JITTER, DROPS = 0.9, 0.5
"""Largest lateness as a share of the period, and largest share of lost ticks."""

UNEVEN = ("jitter", "drops")
"""Kinds of uneven ticks."""

SCENE_TICKS = (2, 5, 10, 20)
"""Ticks between two results of a slower scene."""

SLOW_METHOD = "lossless"
"""Method of a slower scene. With a spring alone its law is that of the others."""

HANDS: Mapping[str, Hand | None] = {"no hand": None, "ordinary hand": Hand()}

SEEDS = 3
"""Number of runs with different random numbers that must all be stable. More find a lower limit and
take longer."""

WALL_MASS = 1e6
"""Mass in kg of a tool that no hand moves (see the map ``coupling``)."""

EVEN_SHARE = 0.65
"""Share of the searches at even ticks: 4 periods per line and 10 shares, of 110."""

TICKS = 2000
SWINGS = 16.0
"""Smallest number of swings of the worst hand in a run, a fifth of which is judged. Where B' is
small, or K far above the limit, the critical hand swings once in 600 ticks and grows slowly. A
window shorter than a swing mistakes that for decay. With 8 a limit is found up to 3 % too low, with
16 and with 64 within 0.04 % of theory."""

KNOCK = np.array([1e-4, 0.0, 0.0, 0.0, 0.0, 0.0])
"""Displacement that starts a run, in m."""

SEARCHED = (10.0, 1e6)
"""Range of every search for K in N/m, equal at all periods. Expected limits lie between 105 and 20
000, and do not enter the search. A softer wall decays too slowly for a run. A much stiffer one
needs another kind of hand, and longer runs to show it."""


DEFAULT_POINTS = 110
"""Approximate number of points by default."""


def points(count: int) -> Sequence[Point]:
    """Returns searches for the largest K: by method, period and delay; jitter and drops; scene.

    Even ticks get the smaller part of ``count`` for each line, because a limit over T is almost
    straight.
    """
    steps = max(2, round(EVEN_SHARE * count / (len(METHODS_SHOWN) * DELAYS)))
    shares = max(2, round((1 - EVEN_SHARE) * count / (len(UNEVEN) * len(HANDS))))
    even: list[Point] = [
        _point("delay", name, "worst hand", float(t), d, 0.0)
        for name in METHODS_SHOWN
        for d in range(DELAYS)
        for t in np.geomspace(*PERIODS, steps)
    ]
    uneven: list[Point] = [
        _point(what, METHODS_SHOWN[0], hand, UNEVEN_PERIOD, 0, float(share))
        for what, most in (("jitter", JITTER), ("drops", DROPS))
        for hand in HANDS
        for share in np.linspace(0.0, most, shares)
    ]
    slow = [
        _point("scene", SLOW_METHOD, "worst hand", UNEVEN_PERIOD, 0, float(n)) for n in SCENE_TICKS
    ]
    return even + uneven + slow


def _point(what: str, method: str, hand: str, period: float, delay: int, share: float) -> Point:
    return {
        "what": what,
        "method": method,
        "hand": hand,
        "period": period,
        "delay": delay,
        "share": share,
    }


def evaluate(point: Point) -> Mapping[str, float | str | bool]:
    """Searches for the largest stable K, and measures the unevenness of the ticks."""
    period, delay, share = float(point["period"]), int(point["delay"]), float(point["share"])
    name = str(point["method"])
    if point["what"] == "delay":

        def is_stable(stiffness: float) -> bool:
            return worst_hand(name, stiffness, period, delay).is_stable

        limit = base.largest_stable(is_stable, *SEARCHED).middle
        return {"limit": limit} | unevenness([period])

    if point["what"] == "scene":

        def is_stable_behind(stiffness: float) -> bool:
            return behind_a_loop(stiffness, round(share)).is_stable

        limit = base.largest_stable(is_stable_behind, *SEARCHED).middle
        return {"limit": limit} | unevenness([share * period])

    timings = [_timing(str(point["what"]), share, seed) for seed in range(SEEDS)]
    hand = str(point["hand"])

    def is_stable_in_all(stiffness: float) -> bool:
        return all(finite_hand(name, hand, stiffness, timing).is_stable for timing in timings)

    limit = base.largest_stable(is_stable_in_all, *SEARCHED).middle
    intervals = np.concatenate([timing.intervals(TICKS) for timing in timings]) / PARTS
    return {"limit": limit} | unevenness(period * intervals)


def unevenness(intervals: ArrayLike) -> dict[str, float]:
    """Returns characteristic periods of intervals T_k between ticks, for use in 2 b/T.

    Args:
        intervals: Intervals in s, > 0, shape (n,).

    Returns:
        Periods in s. ``mean``. ``longest``, with which K = 2 b/T suffices for any hand: a hold of
        T_k
        leaks at most ½ K δh_k², and the damping absorbs at least b δh_k²/T_k. ``balanced``,
        ΣT_k²/ΣT_k, with which a device that moves evenly over many ticks loses its balance.
    """
    each = np.asarray(intervals, dtype=np.float64)
    return {
        "mean": float(each.mean()),
        "longest": float(each.max()),
        "balanced": float(np.square(each).sum() / each.sum()),
    }


def _timing(what: str, share: float, seed: int) -> Timing:
    return Timing(**{what: share}, seed=seed)


def worst_hand(name: str, stiffness: float, period: float, delay: int) -> LoopOutcome:
    """Runs the worst hand of a method's law on a wall whose force arrives whole samples late."""
    coupling = Coupling(stiffness, DAMPING, 0.0, 0.0)
    theory = SampledLoop(METHODS[name].law_coupling(coupling, period), period, delay=delay)
    frequency = theory.worst_frequency()
    response = complex(theory.response(frequency))
    hand = WorstHand(DEVICE_DAMPING, frequency, period, response)
    device = SimulatedDevice(damping=DEVICE_DAMPING, hand=hand, delay=delay)
    swing = 2 * np.pi / (frequency * period)
    return _run(name, device, coupling, period, ticks=max(TICKS, round(SWINGS * swing)))


def behind_a_loop(stiffness: float, scene_ticks: int) -> LoopOutcome:
    """Runs the worst hand of a spring as wall in a scene that steps once in some ticks."""
    spring = Coupling(stiffness, 0.0, 0.0, 0.0)
    theory = SampledLoop(spring, UNEVEN_PERIOD)
    frequency = theory.worst_frequency()
    response = complex(theory.response(frequency))
    hand = WorstHand(DEVICE_DAMPING, frequency, UNEVEN_PERIOD, response)
    device = SimulatedDevice(damping=DEVICE_DAMPING, hand=hand)
    return base.wall_loop(WALL_MASS).run(
        device,
        spring,
        METHODS[SLOW_METHOD],
        period=UNEVEN_PERIOD,
        ticks=TICKS,
        scene_ticks=scene_ticks,
        knock=KNOCK,
    )


def finite_hand(name: str, hand: str, stiffness: float, timing: Timing) -> LoopOutcome:
    """Runs a spring as wall for a device that is free or in an ordinary hand, at uneven ticks."""
    device = SimulatedDevice(
        damping=DEVICE_DAMPING, hand=HANDS[hand], path=base.STILL if HANDS[hand] else None
    )
    spring = Coupling(stiffness, 0.0, 0.0, 0.0)
    return _run(name, device, spring, UNEVEN_PERIOD, timing=timing)


def _run(
    name: str,
    device: SimulatedDevice,
    coupling: Coupling,
    period: float,
    *,
    ticks: int = TICKS,
    timing: Timing | None = None,
) -> LoopOutcome:
    return base.wall_loop(WALL_MASS).run(
        device, coupling, METHODS[name], period=period, ticks=ticks, knock=KNOCK, timing=timing
    )


def wall_limit(name: str, period: float, delay: int) -> float:
    """Returns the largest K in N/m on a wall for any hand: ``wall_damping`` solved for K.

    Args:
        name: The method, whose law uses B' where ``DAMPING`` is requested.
        period: T in s, finite and > 0.
        delay: d in whole samples, >= 0.

    Raises:
        CouplingError: An argument is out of range.
    """

    def is_enough(stiffness: float) -> bool:
        coupling = Coupling(stiffness, DAMPING, 0.0, 0.0)
        used = METHODS[name].law_coupling(coupling, period)
        return bool(wall_damping(used, period, delay=delay) < DEVICE_DAMPING)

    return base.largest_stable(is_enough, *SEARCHED, THEORY_WIDTH).middle


def uneven_bound(period: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns K = 2 b/T in N/m of the spring alone, at any of the periods of ``unevenness``."""
    return np.asarray(maximum_stiffness(DEVICE_DAMPING, period))


STYLES = {
    "at_mean": ("K = 2b/T, T the mean interval", ":"),
    "at_balanced": ("K = 2b ΣT/ΣT²: balance of energy", "--"),
    "at_longest": ("K = 2b/T, T the longest: enough for any hand", "-"),
}
"""Label and line of each bound at uneven ticks."""

AXES = {"jitter": "ticks late by up to (share of T)", "drops": "ticks lost (share of all)"}

MARKERS = dict(zip(HANDS, "os", strict=True))

SHOWN = (15.0, 7e4)
"""Range of K in N/m at even ticks: all bounds at b, and room for the names below them."""


def draw(_table: Table, boundary: Mapping[str, Any]) -> Figure:
    """Draws the numbers of ``summarize``."""
    figure = new_figure(8, 8.4)
    grid = figure.add_gridspec(2, 6, height_ratios=(1.25, 1))
    above: list[Axes] = []
    for place, (name, by_delay) in enumerate(boundary["methods"].items()):
        where = grid[0, 2 * place : 2 * place + 2]
        axes = figure.add_subplot(where, sharey=above[0] if above else None)
        _draw_delays(axes, name, by_delay)
        axes.tick_params(labelleft=not above)
        above.append(axes)
    above[0].set_ylabel("largest stable K (N/m)")
    first = figure.add_subplot(grid[1, :2])
    panels = (first, figure.add_subplot(grid[1, 2:4], sharey=first))
    _draw_slow(figure.add_subplot(grid[1, 4:], sharey=first), boundary["scene"])
    for axes, (what, words) in zip(panels, AXES.items(), strict=True):
        _draw_uneven(axes, boundary["uneven"][what], words)
    first.set_ylabel("largest stable K (N/m)")
    handles = [
        first.plot([], [], marker, color="black", mfc="white", label=f"measured: {name}")[0]
        for name, marker in MARKERS.items()
    ]
    handles += [
        first.plot([], [], style, color=base.THEORY_COLOUR, label=label)[0]
        for label, style in STYLES.values()
    ]
    handles += [
        first.plot([], [], "D", color="black", mfc="white", label="measured: slower scene")[0]
    ]
    figure.suptitle(
        f"Largest stable K on a wall: behind the coupling is a tool of {1e-3 * WALL_MASS:g} t, "
        f"device damping b = {DEVICE_DAMPING:g} N s/m\n"
        f"above: even ticks, B = {DAMPING:g} N s/m requested, the law uses B′ (0 at least);\n"
        "circles: measured with the worst hand",
        fontsize="medium",
    )
    names = ", ".join(METHODS_SHOWN)
    figure.legend(
        handles=handles,
        title=f"below: T = {1e3 * UNEVEN_PERIOD:g} ms, B = 0, for which {names} have one law",
        title_fontsize="small",
        loc="outside lower center",
        ncols=2,
        fontsize="small",
        frameon=False,
    )
    return figure


def _draw_delays(axes: Axes, name: str, by_delay: Mapping[str, Any]) -> None:
    # one hue, lighter with delay: a delay is a quantity, and verdicts have the other colours
    shade = matplotlib.colormaps["Blues_r"]
    axes.set(xscale="log", yscale="log")
    for delay, selected in by_delay.items():
        colour, period = shade(0.65 * int(delay) / (DELAYS - 1)), 1e3 * np.array(selected["period"])
        axes.plot(period, selected["predicted"], color=colour, label=delay)
        axes.plot(period, _drawable(selected["measured"]), "o", color=colour, mfc="white", ms=5)
    if by_delay:
        axes.legend(
            title="bound, delay in samples",
            title_fontsize="small",
            fontsize="small",
            ncols=3,
            loc="lower left",
            handlelength=1.2,
            columnspacing=1.0,
        )
    else:
        base.say_missing(axes)
    axes.set_ylim(*SHOWN)
    axes.set_title(f"{name}, {base.law_in_words(name)}", fontsize="medium")
    axes.set_xlabel("period T (ms)")
    ticks = (0.1, 0.3, 1, 3)
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.grid(visible=True, which="both", alpha=0.25)


def _draw_slow(axes: Axes, curves: Mapping[str, Any]) -> None:
    axes.set(xscale="log", yscale="log")
    if curves:
        period = 1e3 * np.array(curves["period"])
        axes.plot(period, _drawable(curves["measured"]), "D", color="black", mfc="white", ms=5)
        axes.plot(period, curves["at_loop"], "-", color=base.THEORY_COLOUR)
        axes.plot(period, curves["at_scene"], ":", color=base.THEORY_COLOUR)
    else:
        base.say_missing(axes)
    axes.set_xlabel("scene's period (ms)")
    axes.set_xticks([2, 5, 10, 20], ["2", "5", "10", "20"])
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.grid(visible=True, which="both", alpha=0.25)


def _draw_uneven(axes: Axes, curves: Mapping[str, Any], words: str) -> None:
    axes.set_yscale("log")
    for name, selected in curves.items():
        axes.plot(
            selected["share"],
            _drawable(selected["measured"]),
            MARKERS[name],
            color="black",
            mfc="white",
            ms=5,
        )
    if curves:
        lines = next(iter(curves.values()))  # the ticks were equal for every hand
        for key, (_, style) in STYLES.items():
            axes.plot(lines["share"], lines[key], style, color=base.THEORY_COLOUR)
    else:
        base.say_missing(axes)
    axes.set_xlabel(words)
    axes.grid(visible=True, which="both", alpha=0.25)


def _drawable(values: list[float]) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Returns values for a logarithmic axis, which cannot show 0 and infinity."""
    numbers = np.array(values, dtype=np.float64)
    return np.where(np.isfinite(numbers) & (numbers > 0), numbers, np.nan)


LINES = ("mean", "balanced", "longest")
"""Periods of ``unevenness`` with which the measurement at uneven ticks is compared."""


def summarize(table: Table) -> dict[str, Any]:
    """Compares the largest K with theory: by method, period and delay; at uneven ticks."""
    return {
        "device_damping": DEVICE_DAMPING,
        "damping": DAMPING,
        "methods": {name: _by_delay(name, table) for name in METHODS_SHOWN},
        "uneven": {what: _uneven(table.select(table["what"] == what)) for what in UNEVEN},
        "scene": _slow(table.select(table["what"] == "scene")),
    }


def _by_delay(name: str, table: Table) -> dict[str, Any]:
    rows = base.of_method(table, "delay", name)
    curves: dict[str, Any] = {}
    for delay in np.unique(rows["delay"]):
        selected = rows.select(rows["delay"] == delay)
        period, limit = selected["period"], selected.numbers("limit")
        predicted = np.array([wall_limit(name, float(t), int(delay)) for t in period])
        curves[str(int(delay))] = {
            "period": period.tolist(),
            "measured": limit.tolist(),
            "predicted": predicted.tolist(),
            "worst_ratio_error": base.agreement(limit, predicted),
            "slope": _slope(period, limit),
        }
    return curves


def _slope(period: NDArray[np.float64], limit: NDArray[np.float64]) -> float | None:
    """Returns the exponent of T in K; None where fewer than two K are known."""
    is_known = np.isfinite(limit) & (limit > 0)
    if is_known.sum() < 2:
        return None
    return float(np.polyfit(np.log(period[is_known]), np.log(limit[is_known]), 1)[0])


def _uneven(rows: Table) -> dict[str, Any]:
    curves: dict[str, Any] = {}
    for name in HANDS:
        selected = rows.select(rows["hand"] == name)
        if len(selected):
            curves[name] = {
                "share": selected["share"].tolist(),
                "measured": selected.numbers("limit").tolist(),
                **{f"at_{line}": uneven_bound(selected.numbers(line)).tolist() for line in LINES},
            }
    return curves


def _slow(rows: Table) -> dict[str, Any]:
    if not len(rows):
        return {}
    limit, period = rows.numbers("limit"), rows.numbers("mean")
    at_loop = uneven_bound(np.full(len(rows), UNEVEN_PERIOD))
    return {
        "period": period.tolist(),
        "measured": limit.tolist(),
        "at_loop": at_loop.tolist(),
        "at_scene": uneven_bound(period).tolist(),
        "worst_ratio_error": base.agreement(limit, at_loop),
    }


def sentences(boundary: Mapping[str, Any]) -> Sentences:
    """States the agreement with the bounds at even ticks, and the limits at uneven ones."""
    for name, by_delay in boundary["methods"].items():
        errors = [selected["worst_ratio_error"] for selected in by_delay.values()]
        yield (
            "'{name}': the worst hand turns the wall unstable within {error:.2%} of the bound for "
            "its delay",
            {"name": name, "error": max(filter(None, errors), default=None)},
        )
        yield (
            "'{name}': without a delay K goes with T to the power {slope:.3f}",
            by_delay.get("0", {}) | {"name": name},
        )
    if slow := boundary["scene"]:
        yield (
            "a scene of {period:.0f} ms a step behind a loop of 1 ms: the worst hand turns the "
            "wall unstable within {error:.2%} of the loop's 2b/T, {at_loop:.0f} N/m; a loop of its "
            "own period bears {at_scene:.0f} N/m",
            {
                "period": 1e3 * slow["period"][-1],
                "error": slow["worst_ratio_error"],
                "at_loop": slow["at_loop"][-1],
                "at_scene": slow["at_scene"][-1],
            },
        )
    for what, by_hand in boundary["uneven"].items():
        for hand, selected in by_hand.items():
            yield (
                "{axis}, {share:g}: with {hand} the wall is stable up to {measured:.0f} N/m; "
                "2b ΣT/ΣT² by the balance of energy is {at_balanced:.0f} N/m, 2b/T at the mean "
                "interval {at_mean:.0f} and at the longest {at_longest:.0f}, enough for any hand",
                {key: values[-1] for key, values in selected.items()}
                | {"axis": AXES[what].capitalize(), "hand": hand},
            )


TWIN_COUPLING = Coupling(1500.0, 0.0, 0.0, 0.0)
"""Coupling of the twins: a spring with K = 2b/T at 375 Hz."""

TWIN_FORCE = 1.0
"""Force in N with which the twins' hand presses."""


def twins() -> Twins:
    """Returns a hand that presses on a wall, at a rate below K T/2 = b and at one above."""
    device = partial(
        SimulatedDevice,
        damping=DEVICE_DAMPING,
        hand=base.STEADY_HAND,
        path=base.pressing((0.02, TWIN_FORCE)),
        **NO_LIMITS,
    )
    return Twins(
        shared=f"A hand presses on a wall with {TWIN_FORCE:g} N, K = {TWIN_COUPLING.stiffness:g} "
        f"N/m, device damping b = {DEVICE_DAMPING:g} N s/m",
        name="rate",
        unit="Hz",
        values=(200.0, 1000.0),
        run=lambda rate: Run(
            scene=partial(base.free_wall, WALL_MASS),
            device=device,
            coupling=TWIN_COUPLING,
            options=replace(UNGUARDED_OPTIONS, method=METHODS_SHOWN[0], rate=rate),
            duration=0.5,
        ),
    )
