"""The device condition (6) by method: some use less damping than is asked for."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.rendering import METHODS
from hapticbridge.theory.bounds import maximum_stiffness


def used_damping(
    name: str, stiffness: ArrayLike, damping: ArrayLike, period: float
) -> NDArray[np.float64]:
    """Returns B' in N s/m, the damping of a method's law: max(B − a K T, 0).

    It is ``Method.used`` over arrays; the method's integration adds a K T again.

    Args:
        name: The method; a is its ``lag``.
        stiffness: K in N/m.
        damping: B in N s/m as asked for; broadcasts with K.
        period: T in s.
    """
    taken = METHODS[name].lag * period * np.asarray(stiffness, dtype=np.float64)
    return np.asarray(np.maximum(np.asarray(damping, dtype=np.float64) - taken, 0.0))


def law_in_words(name: str, subscript: str = "") -> str:
    """Returns which damping a method's law uses, as titles and legends say it.

    Args:
        name: The method.
        subscript: Of K and B: empty, or ``_r`` in rotation.
    """
    lag = METHODS[name].lag
    taken = {0.0: "", 0.5: f" − K{subscript} T/2"}.get(lag, f" − K{subscript} T")
    return f"B{subscript}′ = B{subscript}{taken}"


def needed_by_6(
    name: str, stiffness: ArrayLike, damping: ArrayLike, period: float
) -> NDArray[np.float64]:
    """Returns the device damping in N s/m that (6) asks for, K T/2 + B'."""
    spring = np.asarray(stiffness, dtype=np.float64) * period / 2
    return np.asarray(spring + used_damping(name, stiffness, damping, period))


def limit_by_6(
    name: str, device_damping: float, period: float, damping: ArrayLike
) -> NDArray[np.float64]:
    """Returns the K in N/m at which K T/2 + B' = b, for B < b.

    That is 2 (b − B)/T without a lag. With a lag of ½ or 1 it is 2b/T: there B' is 0, and below it
    K T/2 + B' stays below b.
    """
    spent = np.asarray(damping, dtype=np.float64) * (METHODS[name].lag == 0.0)
    return np.asarray(maximum_stiffness(device_damping, period, spent))
