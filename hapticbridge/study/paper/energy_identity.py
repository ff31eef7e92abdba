"""The identity of sampled energies that makes (6) sufficient, evaluated on random motion."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def identity_residual(period: float) -> float:
    """Returns the device side minus the right-hand side, relative, for random motion.

    Args:
        period: T in s, > 0.
    """
    rng = np.random.default_rng(6)
    count, size = 200, 3
    h, x = rng.normal(size=(2, count + 2, size))
    x[0] = x[1] - rng.normal(size=size)

    def symmetric() -> NDArray[np.float64]:
        root = rng.normal(size=(size, size))
        return np.asarray(root @ root.T, dtype=np.float64)

    k, b, device = symmetric() * 1e3, symmetric(), symmetric() * 2

    def square(v: NDArray[np.float64], matrix: NDArray[np.float64]) -> float:
        return float(np.sum((v @ matrix) * v))

    d, moved = np.diff(h, axis=0, prepend=0.0), np.diff(x, axis=0, prepend=0.0)
    e, change = h - x, d - moved
    force = e @ k + change @ b / period
    n = count
    inner = slice(1, n + 1)
    left = float(np.sum(force[1 : n + 1] * d[2 : n + 2])) + square(d[1 : n + 2], device / period)
    right = (
        float(np.sum(force[inner] * moved[inner]))
        + 0.5 * square(moved[inner], k + b / period)
        + 0.5 * square(change[0:n] + d[inner], b / period)
        + square(d[inner], (device - b) / period - k / 2)
        + 0.5 * square(e[n] + d[n + 1], k)
        + 0.5 * square(change[n] + d[n + 1], b / period)
        + square(d[n + 1], device / period - k / 2 - b / (2 * period))
        - 0.5 * square(e[0], k)
        - float(force[0] @ d[1])
        - 0.5 * square(change[0], b / period)
    )
    return abs(left - right) / abs(left)
