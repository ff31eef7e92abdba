"""The limit of stability, found in the time domain."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from hapticbridge.arguments import LARGEST, SMALLEST
from hapticbridge.passivity.sampled_loop import SampledLoop
from hapticbridge.passivity.worst_hand import WorstHand

SAMPLES = 60_000
"""Samples over which a loop must decay to count as stable. Two windows of a fifth of that are
compared: growth of 1e-9 a sample is seen. More samples find the limit closer, in more time."""

DECAYED = 1e-9
"""Share of its largest value below which a force has decayed beyond doubt, without unit: above
rounding, and far below what a marginal mode keeps."""

LEAKAGE = 1e-5
"""Relative difference in energy between two windows of a steady oscillation, without unit, that
Hann's window leaves from 0.03 rad upwards. Without it a tool on a spring without any damping would
count as stable by chance; larger ones shift limits at low frequency."""

TOLERANCE = 1e-5
"""Relative width at which the bisection ends, a hundredth of what the bounds are checked to."""

STEP = 10.0
"""Factor by which a threshold is enclosed before it is bisected, without unit. Any would do; ten
makes a search plainly independent of the number that it is to confirm."""


def stability_limit(loop: SampledLoop) -> float:
    """Returns the smallest device damping at which the loop with its worst hand is stable.

    Found by runs in the time domain, which are stable if the force decays: powers of ten around
    K T + B enclose the limit, and bisection closes in. Of the theory only the hand is used, tuned
    to ``worst_frequency`` and the same for every b.

    Args:
        loop: What the device feels.

    Returns:
        b in N s/m; 0 where the loop needs none, inf where the tool is not even stable behind a
        handle held still, or an unfiltered Tustin damper rings against a wall: its own pole at
        Nyquist is undamped.
    """
    is_ringing = loop.discretization == "tustin" and loop.filter_time == 0
    if is_ringing and loop.mass is None and loop.coupling.damping > 0:
        return float("inf")
    if loop.mass is not None and not decays(loop.simulate(None, SAMPLES).force, SAMPLES):
        return float("inf")
    frequency = loop.worst_frequency()
    response = complex(loop.response(frequency))

    def is_stable(damping: float) -> bool:
        hand = WorstHand(damping, frequency, loop.period, response)
        return decays(loop.simulate(hand, SAMPLES).force, SAMPLES)

    size = loop.coupling.stiffness * loop.period + loop.coupling.damping
    start = float(np.clip(10.0 ** np.floor(np.log10(size)), SMALLEST, LARGEST))
    return threshold(is_stable, start, TOLERANCE)


def threshold(holds: Callable[[float], bool], start: float, tolerance: float) -> float:
    """Returns the value above which something holds, knowing only where to begin.

    Args:
        holds: Whether it holds at a positive value; false below the threshold, true above.
        start: First value that is tried, > 0; steps by ``STEP`` lead from it to both sides of the
            threshold.
        tolerance: Relative width at which the bisection ends.

    Returns:
        The middle of the last bracket; 0 where it holds everywhere down to 1e-30, inf where
        nowhere up to 1e30.
    """
    lower = upper = float(start)
    does_hold = holds(start)
    while holds(lower) if does_hold else not holds(upper):
        lower, upper = (lower / STEP, lower) if does_hold else (upper, upper * STEP)
        if lower < SMALLEST:
            return 0.0
        if upper > LARGEST:
            return float("inf")
    while upper - lower > tolerance * upper:
        middle = (lower + upper) / 2
        lower, upper = (lower, middle) if holds(middle) else (middle, upper)
    return (lower + upper) / 2


def decays(force: NDArray[np.float64], samples: int, floor: float = 0.0) -> bool:
    """Returns whether a force fell from one late window to the next.

    Args:
        force: f_k in N, or any signal that is linear in it; shorter than asked if the run ended
            early, which counts as divergence.
        samples: How many were asked for.
        floor: What cannot be told from zero, in N.
    """
    if force.size < samples:
        return False
    width = samples // 5
    late, last = force[-2 * width : -width], force[-width:]
    # what is left of a force that has decayed is rounding, which neither grows nor falls
    if np.abs(last).max() <= max(DECAYED * np.abs(force).max(), floor):
        return True
    # Hann's window, or the fraction of a cycle that a window holds would outweigh a small growth
    weight = np.hanning(width) / np.abs(late).max()
    fallen = np.square(last * weight).sum() / np.square(late * weight).sum()
    return bool(fallen < 1 - LEAKAGE)
