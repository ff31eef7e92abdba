"""Whole ticks without the interpreter: what the live loop does, for re-simulation and sweeps.

An error inside MuJoCo ends the process here, so one step must have succeeded through Python before,
and no device may be attached.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hapticbridge.jit import compiled, compiled_for_threads
from hapticbridge.kernel.codes import OK
from hapticbridge.kernel.step import advance, after_step, before_step


@compiled
def _tick(
    state: NDArray[np.void], sample: NDArray[np.void], row: NDArray[np.void], elapsed: float
) -> bool:
    """Runs one tick; returns whether sample and result were finite."""
    for substep in range(state[0].substeps):
        if before_step(state, sample, row, substep, elapsed) != OK:
            return False
        advance(state)
        if after_step(state, row, substep) != OK:
            return False
    return True


@compiled_for_threads
def simulate(
    state: NDArray[np.void],
    samples: NDArray[np.void],
    row: NDArray[np.void],
    rows: NDArray[np.void],
) -> int:
    """Runs one tick per sample.

    Args:
        state: The bound state.
        samples: Device samples, one per tick.
        row: The bound record.
        rows: Receives the records; as long as ``samples``.

    Returns:
        How many ticks were completed; fewer than asked where a sample or a result was not finite.
    """
    for k in range(samples.size):
        if not _tick(state, samples[k : k + 1], row, state[0].period):
            return k
        rows[k] = row[0]
    return int(samples.size)


@compiled_for_threads
def simulate_recorded(
    state: NDArray[np.void],
    samples: NDArray[np.void],
    outside: NDArray[np.int64],
    elapsed: NDArray[np.float64],
    row: NDArray[np.void],
    rows: NDArray[np.void],
) -> int:
    """As ``simulate``, of a run that was recorded: with what came from outside the scene.

    Args:
        state: The bound state.
        samples: Device samples, one per tick.
        outside: ``STALE_SAMPLE`` and ``RESEATED`` as the live loop had them, per tick.
        elapsed: Time between two samples in s, per tick.
        row: The bound record.
        rows: Receives the records; as long as ``samples``.
    """
    for k in range(samples.size):
        state[0].outside = outside[k]
        if not _tick(state, samples[k : k + 1], row, elapsed[k]):
            return k
        rows[k] = row[0]
    return int(samples.size)
