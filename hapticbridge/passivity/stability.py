"""Stability limit of a sampled loop from time-domain runs."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from hapticbridge.arguments import LARGEST, SMALLEST
from hapticbridge.passivity.sampled_loop import SampledLoop
from hapticbridge.passivity.worst_hand import WorstHand

SAMPLES = 60_000
"""Length of a run in samples over which a stable loop must decay. Two windows of a fifth of it are
compared, which detects growth of 1e-9 per sample. More samples locate the limit more closely and
take longer."""

DECAYED = 1e-9
"""Force relative to its largest value, without unit, below which it counts as decayed. The value
lies above rounding and far below the amplitude of a marginal mode."""

LEAKAGE = 1e-5
"""Relative difference in energy, without unit, between two windows of a steady oscillation under
Hann's window, for 0.03 rad per sample and more. Without this allowance a tool on an undamped spring
would count as stable by chance. Larger values shift limits at low frequency."""

TOLERANCE = 1e-5
"""Relative width at which the bisection ends, without unit: a hundredth of the accuracy to which
the bounds are checked."""

STEP = 10.0
"""Factor between trial values that enclose a threshold, without unit. Powers of ten keep the search
independent of the predicted number that it confirms."""


def stability_limit(loop: SampledLoop) -> float:
    """Returns the smallest device damping at which the loop with its worst hand is stable.

    A run is stable if its force decays. Powers of ten around K T + B enclose the limit, then
    bisection narrows it. The theory supplies only the hand, which is tuned to ``worst_frequency``
    for every b.

    Args:
        loop: Coupling and environment.

    Returns:
        b in N s/m. 0 if the loop requires none. inf if the tool is unstable behind a fixed handle,
        or for an unfiltered Tustin damper against a wall, whose own pole at Nyquist is undamped.
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
    """Returns the value above which a condition holds.

    Args:
        holds: Condition at a positive value; false below the threshold, true above.
        start: First trial value, > 0; steps by the factor ``STEP`` enclose the threshold.
        tolerance: Relative width at which the bisection ends.

    Returns:
        The middle of the last bracket; 0 if the condition holds down to 1e-30, inf if it fails up
        to 1e30.
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
    """Returns whether a force, or a signal linear in it, fell from one late window to the next.

    A signal with fewer than the expected ``samples`` counts as diverged; one below ``floor`` in N
    counts as zero.
    """
    if force.size < samples:
        return False
    width = samples // 5
    late, last = force[-2 * width : -width], force[-width:]
    # a decayed force consists of rounding, which neither grows nor falls
    if np.abs(last).max() <= max(DECAYED * np.abs(force).max(), floor):
        return True
    # without Hann's window, a fraction of a cycle at its ends would outweigh a small growth
    weight = np.hanning(width) / np.abs(late).max()
    fallen = np.square(last * weight).sum() / np.square(late * weight).sum()
    return bool(fallen < 1 - LEAKAGE)
