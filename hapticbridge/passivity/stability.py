"""The limit of stability, found in the time domain."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

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


def stability_limit(loop: SampledLoop) -> float:
    """Returns the smallest device damping at which the loop with its worst hand is stable.

    Found by bisection on runs in the time domain: a run is stable if the force decays. The
    hand is tuned to ``worst_frequency`` and stays what it is while b varies.

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
    expected = float(loop.damping_spectrum(frequency))
    if expected <= 0:
        return 0.0

    def is_stable(damping: float) -> bool:
        hand = WorstHand(damping, frequency, loop.period, response)
        return decays(loop.simulate(hand, SAMPLES).force, SAMPLES)

    # the bracket is not centred on the bound, so that no midpoint of it is the bound
    lower, upper = expected / 3, 2 * expected
    while is_stable(lower):
        lower, upper = lower / 4, lower
    while not is_stable(upper):
        lower, upper = upper, 4 * upper
    while upper - lower > TOLERANCE * upper:
        middle = (lower + upper) / 2
        lower, upper = (lower, middle) if is_stable(middle) else (middle, upper)
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
