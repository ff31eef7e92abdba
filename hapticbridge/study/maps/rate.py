"""Map ``rate``: how stiff a wall may be at each period, delay, jitter and share of lost ticks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.device import Hand, SimulatedDevice
from hapticbridge.passivity import SampledLoop, WorstHand, maximum_stiffness, minimum_damping
from hapticbridge.picture import new_figure
from hapticbridge.rendering import METHODS
from hapticbridge.study.closed_loop import PARTS, LoopOutcome, Timing
from hapticbridge.study.maps.bisection import WIDTH, agreement, largest_stable
from hapticbridge.study.maps.rigs import STILL, loop_in, set_tool_mass
from hapticbridge.study.maps.stability_map import Finding, Point, StabilityMap
from hapticbridge.study.table import Table

THEORY_WIDTH = WIDTH / 100
"""Relative width of the search for what theory says: far below that of a measurement."""

DEVICE_DAMPING = 2.0
"""b in N s/m, that of the default simulated device."""

DAMPING = 1.0
"""B in N s/m where even ticks are measured: half of b, for then the worst hand is at a frequency
above zero at every delay. With less it is a mass without bound, and takes as long to show."""

PERIODS = (1e-4, 5e-3)
"""Range of T in s, even in its logarithm."""

DELAYS = 6
"""Delays of 0 to 5 samples."""

UNEVEN_PERIOD = 1e-3
"""T in s for jitter and lost ticks, where the coupling is a spring alone (B = 0): with a damper the
bound at the longest interval, K = 2 (b/T_max − B/T), is gone after the first lost ticks."""

JITTER, DROPS = 0.9, 0.5
"""Largest share of a period by which ticks are late, and of ticks that are lost."""

HANDS: Mapping[str, Hand | None] = {"no hand": None, "ordinary hand": Hand()}

SEEDS = 3
"""Runs with other random numbers that must all be stable; more find a lower limit, slowly."""

WALL_MASS = 1e6
"""In kg: a tool that moves for no hand (see the map ``coupling``)."""

TICKS = 2000
KNOCK = np.array([1e-4, 0.0, 0.0, 0.0, 0.0, 0.0])
"""Displacement that starts a run, in m."""

SEARCHED = (10.0, 1e5)
"""Ends of every search for K in N/m, at every period alike: what is expected lies between 100 and
20 000, and nothing expected goes into it. A softer wall decays too slowly for a run, and at a much
stiffer one the worst hand is tuned to another failure than the first."""


def points(count: int) -> Sequence[Point]:
    """Returns searches for the largest K: by period and delay, and by jitter and lost ticks."""
    steps = max(2, round(count / (DELAYS + 2 * len(HANDS))))
    even: list[Point] = [
        {"what": "delay", "hand": "worst hand", "period": float(t), "delay": d, "share": 0.0}
        for d in range(DELAYS)
        for t in np.geomspace(*PERIODS, steps)
    ]
    uneven: list[Point] = [
        {"what": what, "hand": hand, "period": UNEVEN_PERIOD, "delay": 0, "share": float(share)}
        for what, most in (("jitter", JITTER), ("drops", DROPS))
        for hand in HANDS
        for share in np.linspace(0.0, most, steps)
    ]
    return even + uneven


def evaluate(point: Point) -> Mapping[str, float | str | bool]:
    """Searches for the largest K that is stable, and measures how uneven the ticks were."""
    period, delay, share = float(point["period"]), int(point["delay"]), float(point["share"])
    if point["what"] == "delay":

        def is_stable(stiffness: float) -> bool:
            return worst_hand(stiffness, period, delay).is_stable

        limit = largest_stable(is_stable, *SEARCHED).middle
        return {"limit": limit, "mean": period, "longest": period, "balance": 1.0}

    timings = [_timing(str(point["what"]), share, seed) for seed in range(SEEDS)]
    intervals = np.concatenate([timing.intervals(TICKS) for timing in timings]) / PARTS
    name = str(point["hand"])
    return {
        "limit": largest_stable(
            lambda stiffness: all(
                finite_hand(name, stiffness, timing).is_stable for timing in timings
            ),
            *SEARCHED,
        ).middle,
        "mean": float(period * intervals.mean()),
        "longest": float(period * intervals.max()),
        "balance": float(intervals.sum() / np.square(intervals).sum()),
    }


def _timing(what: str, share: float, seed: int) -> Timing:
    return Timing(**{what: share}, seed=seed)


def worst_hand(stiffness: float, period: float, delay: int) -> LoopOutcome:
    """Runs the worst hand for a wall that is felt whole samples late."""
    coupling = Coupling(stiffness, DAMPING, 0.0, 0.0)
    theory = SampledLoop(coupling, period, delay=delay)
    frequency = theory.worst_frequency()
    felt = complex(theory.response(frequency))
    hand = WorstHand(DEVICE_DAMPING, frequency, period, felt)
    return _run(SimulatedDevice(hand=hand, delay=delay), coupling, period, None)


def finite_hand(hand: str, stiffness: float, timing: Timing) -> LoopOutcome:
    """Runs a spring as wall for a device that is free or in an ordinary hand, at uneven ticks."""
    device = SimulatedDevice(
        damping=DEVICE_DAMPING, hand=HANDS[hand], path=STILL if HANDS[hand] else None
    )
    return _run(device, Coupling(stiffness, 0.0, 0.0, 0.0), UNEVEN_PERIOD, timing)


def _run(
    device: SimulatedDevice, coupling: Coupling, period: float, timing: Timing | None
) -> LoopOutcome:
    return loop_in("virtual_wall", "heavy for rate", _make_heavy).run(
        device,
        coupling,
        METHODS["implicit"],
        period=period,
        ticks=TICKS,
        knock=KNOCK,
        timing=timing,
    )


def _make_heavy(model: mujoco.MjModel) -> None:
    set_tool_mass(model, "tool", WALL_MASS)


def wall_limit(period: float, delay: int) -> float:
    """Returns the largest K in N/m on a wall for any hand: ``minimum_damping`` solved for K.

    Args:
        period: T in s, finite and > 0.
        delay: d in whole samples, >= 0.

    Raises:
        CouplingError: An argument is out of range.
    """

    def is_enough(stiffness: float) -> bool:
        coupling = Coupling(stiffness, DAMPING, 0.0, 0.0)
        return minimum_damping(coupling, period, delay=delay) < DEVICE_DAMPING

    return largest_stable(is_enough, *SEARCHED, THEORY_WIDTH).middle


def read(table: Table) -> Finding:
    """Draws the largest K against period and delay, against jitter, and against lost ticks."""
    figure = new_figure(9, 7.5)
    grid = figure.add_gridspec(2, 2, height_ratios=(1.25, 1))
    by_delay = _draw_delays(figure.add_subplot(grid[0, :]), table.select(table["what"] == "delay"))
    uneven = {
        what: _draw_uneven(
            figure.add_subplot(grid[1, place]), table.select(table["what"] == what), label
        )
        for place, (what, label) in enumerate(
            (("jitter", "jitter: late by up to (share of T)"), ("drops", "share of ticks lost"))
        )
    }
    figure.suptitle(
        f"Largest stable K on a wall, method 'implicit', device damping b = {DEVICE_DAMPING:g} N "
        "s/m",
        fontsize="medium",
    )
    worst = max(mine["worst_ratio_error"] for mine in by_delay.values())
    slope = by_delay["0"]["slope"]
    said = []
    for what, mine in uneven.items():
        end = {key: values[-1] for key, values in mine["no hand"].items()}
        said.append(
            f"At the largest {what} ({end['share']:g}) a free device keeps "
            f"{100 * end['measured'] / mine['no hand']['measured'][0]:.0f} % of its stiffness "
            f"({end['measured']:.0f} N/m); the bound at the longest interval is "
            f"{end['at_longest']:.0f}, at the mean {end['at_mean']:.0f}, and the energy balance "
            f"K = 2b ΣT/ΣT² says {end['balance']:.0f} N/m; an ordinary hand is stable up to "
            f"{mine['ordinary hand']['measured'][-1]:.0f} N/m"
        )
    return Finding(
        figure,
        f"At even ticks the worst hand turns the wall unstable within {100 * worst:.2g} % of the "
        f"bound for that delay, at every period and all {len(by_delay)} delays; without a delay "
        f"K goes with the rate to the power {-slope:.3f}. " + ". ".join(said) + ".",
        {
            "device_damping": DEVICE_DAMPING,
            "damping": DAMPING,
            "by_delay": by_delay,
            "uneven": uneven,
        },
    )


def _draw_delays(axes: Axes, rows: Table) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for delay in np.unique(rows["delay"]):
        mine = rows.select(rows["delay"] == delay)
        period, colour = mine["period"], f"C{delay}"
        predicted = np.array([wall_limit(float(t), int(delay)) for t in period])
        axes.loglog(1e3 * period, predicted, color=colour, label=f"theory, delay {delay} samples")
        axes.plot(1e3 * period, mine["limit"], "o", color=colour, mfc="white", ms=5)
        found[str(delay)] = {
            "period": period.tolist(),
            "measured": mine["limit"].tolist(),
            "predicted": predicted.tolist(),
            "worst_ratio_error": agreement(mine["limit"], predicted),
            "slope": float(np.polyfit(np.log(period), np.log(mine["limit"]), 1)[0]),
        }
    axes.plot([], [], "o", color="black", mfc="white", label="measured, worst hand")
    axes.set_xlabel("period T (ms)")
    axes.set_ylabel("largest stable K (N/m)")
    axes.set_title(f"even ticks, B = {DAMPING:g} N s/m", fontsize="medium")
    axes.grid(visible=True, which="both", alpha=0.25)
    axes.legend(fontsize="small")
    return found


def _draw_uneven(axes: Axes, rows: Table, label: str) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, marker in zip(HANDS, "os", strict=True):
        mine = rows.select(rows["hand"] == name)
        axes.semilogy(mine["share"], mine["limit"], marker, color="black", mfc="white", ms=5)
        axes.plot([], [], marker, color="black", mfc="white", label=f"measured, {name}")
        lines = {
            "at_mean": _bound(mine["mean"]),
            "balance": _bound(UNEVEN_PERIOD / mine["balance"]),
            "at_longest": _bound(mine["longest"]),
        }
        found[name] = {
            "share": mine["share"].tolist(),
            "measured": mine["limit"].tolist(),
            **{key: values.tolist() for key, values in lines.items()},
        }
    for (text, style), values in zip(_LINES, lines.values(), strict=True):
        axes.plot(mine["share"], values, style, color="#1a5fb4", label=text)
    axes.set_xlabel(label)
    axes.set_ylabel("largest stable K (N/m)")
    axes.set_ylim(bottom=100)
    axes.set_title(f"T = {1e3 * UNEVEN_PERIOD:g} ms, B = 0", fontsize="medium")
    axes.grid(visible=True, which="both", alpha=0.25)
    if "lost" in label:
        axes.legend(fontsize="x-small", loc="lower left")
    return found


_LINES = (
    ("2b/T at the mean interval", ":"),
    ("2b ΣT/ΣT² (energy balance)", "--"),
    ("2b/T at the longest interval: sufficient", "-"),
)
"""What the measurement at uneven ticks is compared with. A hold of length T_k leaks at most
½ K δh_k², and the damping takes b δh_k²/T_k at least: K <= 2 b/T_max suffices for any hand. A
device that moves evenly over many ticks loses its balance only at K = 2 b ΣT_k/ΣT_k²."""


def _bound(period: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(maximum_stiffness(DEVICE_DAMPING, period))


RATE = StabilityMap(
    name="rate",
    about="largest stiffness of a wall against period and delay, and against jitter and lost ticks",
    default_points=100,
    points=points,
    evaluate=evaluate,
    read=read,
)
