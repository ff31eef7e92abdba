"""Runs of a wall at each period, delay, jitter and share of lost ticks, and what bounds it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.device import Hand, SimulatedDevice
from hapticbridge.passivity import SampledLoop, WorstHand, maximum_stiffness, minimum_damping
from hapticbridge.rendering import METHODS
from hapticbridge.study.closed_loop import PARTS, LoopOutcome, Timing
from hapticbridge.study.maps.bisection import WIDTH, largest_stable
from hapticbridge.study.maps.rigs import STILL, loop_in, set_tool_mass
from hapticbridge.study.maps.stability_map import Point

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

UNEVEN = ("jitter", "drops")
"""Ways in which ticks are uneven."""

HANDS: Mapping[str, Hand | None] = {"no hand": None, "ordinary hand": Hand()}

SEEDS = 3
"""Runs with other random numbers that must all be stable; more find a lower limit, slowly."""

WALL_MASS = 1e6
"""In kg: a tool that moves for no hand (see the map ``coupling``)."""

TICKS = 2000
SWINGS = 8.0
"""Swings of the worst hand that a run must hold at least, a fifth of which is judged. Far above the
limit the hand that needs most damping swings once in 600 ticks and grows slowly: a window shorter
than a swing takes that for decay."""

KNOCK = np.array([1e-4, 0.0, 0.0, 0.0, 0.0, 0.0])
"""Displacement that starts a run, in m."""

SEARCHED = (10.0, 1e6)
"""Ends of every search for K in N/m, at every period alike: what is expected lies between 105 and
20 000, and nothing expected goes into it. A softer wall decays too slowly for a run; a much stiffer
one asks for another kind of hand, and longer runs to show it."""


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
        return {"limit": limit} | unevenness([period])

    timings = [_timing(str(point["what"]), share, seed) for seed in range(SEEDS)]
    name = str(point["hand"])
    limit = largest_stable(
        lambda stiffness: all(finite_hand(name, stiffness, timing).is_stable for timing in timings),
        *SEARCHED,
    ).middle
    intervals = np.concatenate([timing.intervals(TICKS) for timing in timings]) / PARTS
    return {"limit": limit} | unevenness(period * intervals)


def unevenness(intervals: ArrayLike) -> dict[str, float]:
    """Returns what intervals T_k between ticks come to: three periods to put into 2 b/T.

    Args:
        intervals: In s, > 0, shape (n,).

    Returns:
        In s: ``mean``; ``longest``, with which K = 2 b/T suffices for any hand, because a hold of
        T_k leaks at most ½ K δh_k² and the damping takes b δh_k²/T_k at least; and ``balanced``,
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


def worst_hand(stiffness: float, period: float, delay: int) -> LoopOutcome:
    """Runs the worst hand for a wall that is felt whole samples late."""
    coupling = Coupling(stiffness, DAMPING, 0.0, 0.0)
    theory = SampledLoop(coupling, period, delay=delay)
    frequency = theory.worst_frequency()
    felt = complex(theory.response(frequency))
    hand = WorstHand(DEVICE_DAMPING, frequency, period, felt)
    device = SimulatedDevice(damping=DEVICE_DAMPING, hand=hand, delay=delay)
    swing = 2 * np.pi / (frequency * period)
    return _run(device, coupling, period, ticks=max(TICKS, round(SWINGS * swing)))


def finite_hand(hand: str, stiffness: float, timing: Timing) -> LoopOutcome:
    """Runs a spring as wall for a device that is free or in an ordinary hand, at uneven ticks."""
    device = SimulatedDevice(
        damping=DEVICE_DAMPING, hand=HANDS[hand], path=STILL if HANDS[hand] else None
    )
    return _run(device, Coupling(stiffness, 0.0, 0.0, 0.0), UNEVEN_PERIOD, timing=timing)


def _run(
    device: SimulatedDevice,
    coupling: Coupling,
    period: float,
    *,
    ticks: int = TICKS,
    timing: Timing | None = None,
) -> LoopOutcome:
    return loop_in("virtual_wall", "heavy for rate", make_heavy).run(
        device,
        coupling,
        METHODS["implicit"],
        period=period,
        ticks=ticks,
        knock=KNOCK,
        timing=timing,
    )


def make_heavy(model: mujoco.MjModel) -> None:
    """Makes the tool a wall: so heavy that no hand moves it."""
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


def uneven_bound(period: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns K = 2 b/T in N/m of the spring alone, at any of the periods of ``unevenness``."""
    return np.asarray(maximum_stiffness(DEVICE_DAMPING, period))
