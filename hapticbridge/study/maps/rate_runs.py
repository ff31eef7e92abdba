"""Runs of a wall at each period, delay, jitter and share of lost ticks, and what bounds it.

Against a wall a method is the law that it uses: K beside B' = B − a K T, at least 0, with a = 0 for
``implicit``, 1 for ``compensated`` and ½ for ``lossless``, which asks for

    b > (K T/2) sin((2d + 1)θ/2)/sin(θ/2) − B' cos((d + 1)θ)  for all θ;      d = 0: K T/2 + B'
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.device import Hand, SimulatedDevice
from hapticbridge.rendering import METHODS
from hapticbridge.study.closed_loop import LoopOutcome
from hapticbridge.study.jitter import PARTS, Timing
from hapticbridge.study.maps.bisection import WIDTH, largest_stable
from hapticbridge.study.maps.rigs import STILL, wall_loop
from hapticbridge.study.maps.stability_map import Point
from hapticbridge.theory.bounds import maximum_stiffness, minimum_damping
from hapticbridge.theory.sampled_loop import SampledLoop, WorstHand

THEORY_WIDTH = WIDTH / 100
"""Relative width of the search for what theory says: far below that of a measurement."""

DEVICE_DAMPING = 2.0
"""b in N s/m, that of the default simulated device."""

DAMPING = 1.0
"""B in N s/m asked for where even ticks are measured: half of b, for then the worst hand behind
``implicit`` is at a frequency above zero at every delay. With less, as where a method takes some
off, it is a mass without bound, which takes longer to show (``SWINGS``)."""

METHODS_SHOWN = ("implicit", "compensated", "lossless")
"""Methods whose limit is searched at even ticks, which the bounds allow on a real device."""

PERIODS = (1e-4, 5e-3)
"""Range of T in s, even in its logarithm."""

DELAYS = 6
"""Delays of 0 to 5 samples."""

UNEVEN_PERIOD = 1e-3
"""T in s for jitter and lost ticks, where the coupling is a spring alone (B = 0): with a damper the
bound at the longest interval, K = 2 (b/T_max − B/T), is gone after the first lost ticks. Of B = 0
no method takes anything off: on a wall all of ``METHODS_SHOWN`` have one law, and one is run."""

JITTER, DROPS = 0.9, 0.5
"""Largest share of a period by which ticks are late, and of ticks that are lost."""

UNEVEN = ("jitter", "drops")
"""Ways in which ticks are uneven."""

HANDS: Mapping[str, Hand | None] = {"no hand": None, "ordinary hand": Hand()}

SEEDS = 3
"""Runs with other random numbers that must all be stable; more find a lower limit, slowly."""

WALL_MASS = 1e6
"""In kg: a tool that moves for no hand (see the map ``coupling``)."""

EVEN_SHARE = 0.65
"""Share of all searches that is at even ticks: 4 periods a line and 10 shares, of 110."""

TICKS = 2000
SWINGS = 16.0
"""Swings of the worst hand that a run must hold at least, a fifth of which is judged. Where B' is
small, or K far above the limit, the hand that needs most damping swings once in 600 ticks and grows
slowly: a window shorter than a swing takes that for decay. With 8 a limit is found up to 3 % too
low, with 16 and with 64 within 0.04 % of theory."""

KNOCK = np.array([1e-4, 0.0, 0.0, 0.0, 0.0, 0.0])
"""Displacement that starts a run, in m."""

SEARCHED = (10.0, 1e6)
"""Ends of every search for K in N/m, at every period alike: what is expected lies between 105 and
20 000, and nothing expected goes into it. A softer wall decays too slowly for a run; a much stiffer
one asks for another kind of hand, and longer runs to show it."""


def points(count: int) -> Sequence[Point]:
    """Returns searches for the largest K: by method, period and delay, and by jitter and drops.

    Even ticks get the smaller part of ``count`` for each line: over T a limit is as good as
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
    return even + uneven


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
    """Searches for the largest K that is stable, and measures how uneven the ticks were."""
    period, delay, share = float(point["period"]), int(point["delay"]), float(point["share"])
    name = str(point["method"])
    if point["what"] == "delay":

        def is_stable(stiffness: float) -> bool:
            return worst_hand(name, stiffness, period, delay).is_stable

        limit = largest_stable(is_stable, *SEARCHED).middle
        return {"limit": limit} | unevenness([period])

    timings = [_timing(str(point["what"]), share, seed) for seed in range(SEEDS)]
    hand = str(point["hand"])

    def is_stable_in_all(stiffness: float) -> bool:
        return all(finite_hand(name, hand, stiffness, timing).is_stable for timing in timings)

    limit = largest_stable(is_stable_in_all, *SEARCHED).middle
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


def worst_hand(name: str, stiffness: float, period: float, delay: int) -> LoopOutcome:
    """Runs the hand that is worst for a method's law on a wall that is felt whole samples late."""
    coupling = Coupling(stiffness, DAMPING, 0.0, 0.0)
    theory = SampledLoop(METHODS[name].used(coupling, period), period, delay=delay)
    frequency = theory.worst_frequency()
    felt = complex(theory.response(frequency))
    hand = WorstHand(DEVICE_DAMPING, frequency, period, felt)
    device = SimulatedDevice(damping=DEVICE_DAMPING, hand=hand, delay=delay)
    swing = 2 * np.pi / (frequency * period)
    return _run(name, device, coupling, period, ticks=max(TICKS, round(SWINGS * swing)))


def finite_hand(name: str, hand: str, stiffness: float, timing: Timing) -> LoopOutcome:
    """Runs a spring as wall for a device that is free or in an ordinary hand, at uneven ticks."""
    device = SimulatedDevice(
        damping=DEVICE_DAMPING, hand=HANDS[hand], path=STILL if HANDS[hand] else None
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
    return wall_loop(WALL_MASS).run(
        device,
        coupling,
        METHODS[name],
        period=period,
        ticks=ticks,
        knock=KNOCK,
        timing=timing,
    )


def wall_limit(name: str, period: float, delay: int) -> float:
    """Returns the largest K in N/m on a wall for any hand: ``minimum_damping`` solved for K.

    Args:
        name: The method, whose law uses B' where ``DAMPING`` is asked for.
        period: T in s, finite and > 0.
        delay: d in whole samples, >= 0.

    Raises:
        CouplingError: An argument is out of range.
    """

    def is_enough(stiffness: float) -> bool:
        coupling = Coupling(stiffness, DAMPING, 0.0, 0.0)
        used = METHODS[name].used(coupling, period)
        return minimum_damping(used, period, delay=delay) < DEVICE_DAMPING

    return largest_stable(is_enough, *SEARCHED, THEORY_WIDTH).middle


def uneven_bound(period: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns K = 2 b/T in N/m of the spring alone, at any of the periods of ``unevenness``."""
    return np.asarray(maximum_stiffness(DEVICE_DAMPING, period))
