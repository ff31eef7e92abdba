"""Second computation of the wrench limits."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hapticbridge.kernel.parameters import RunParameters

Array = NDArray[np.float64]


def _limited(vector: Array, limit: float) -> Array:
    norm = np.linalg.norm(vector, axis=-1, keepdims=True)
    return np.asarray(vector * np.where(norm > limit, limit / np.maximum(norm, 1e-300), 1.0))


def chained(
    vector: Array,
    change: Array,
    limit: float,
    rise: float,
    starts: NDArray[np.bool_],
    first: Array,
) -> Array:
    """Limits norm and change of a vector; the change counts from the row before as sent.

    Args:
        vector: Vectors, (n, 3).
        change: Largest change of each component, (n, 3); inf without a bound.
        limit: Largest norm.
        rise: Largest norm of the change.
        starts: Rows that start from zero.
        first: Vector sent before the first row, (3,).
    """
    sent = _limited(vector, limit)
    before = np.concatenate([first[None], sent[:-1]])
    before[starts] = 0.0
    is_bounded = np.isfinite(change).any(axis=1)
    is_bounded |= np.linalg.norm(sent - before, axis=1) > rise
    done = -1
    for begin in np.flatnonzero(is_bounded).tolist():
        for k in range(max(begin, done + 1), len(sent)):
            last = np.zeros(3) if starts[k] else sent[k - 1] if k else first
            plain = sent[k].copy()
            requested = np.clip(vector[k], last - change[k], last + change[k])
            step = _limited(requested, limit) - last
            length = float(np.linalg.norm(step))
            sent[k] = last + (step if length <= rise else rise / length * step)
            done = k
            if np.array_equal(sent[k], plain):
                break
    return sent


def limits_on_tool(parameters: RunParameters) -> tuple[float, float]:
    """Returns force and torque on the tool at the device's limits, in N and N m."""
    return (
        parameters.force_limit / parameters.force_scale,
        parameters.torque_limit * parameters.scale / parameters.force_scale,
    )


def spring_energy(stiffness: Array, length: Array, limit: float) -> Array:
    """Returns ∫ min(K e, limit) de in J, for each K and length, (n,) each."""
    at_limit = np.divide(limit, stiffness, out=np.full_like(length, np.inf), where=stiffness > 0)
    elastic = np.minimum(length, at_limit)
    return np.asarray(0.5 * stiffness * elastic**2 + limit * (length - elastic))
