"""Check that a scene's step fits into the period."""

from __future__ import annotations

import copy
import time
import warnings

import numpy as np

from hapticbridge.errors import SceneError
from hapticbridge.rendering import Method
from hapticbridge.scene import Scene

STEPS, LONGEST = 50, 0.1
"""Largest number of timed steps, and time in s after which no further one starts. One interruption
does not move the median of so many, and the wait is not noticed."""

BESIDE_THE_STEP = 5e-6
"""Time in s of a tick outside MuJoCo's step. Device, wrench, ledger, guard and record take 3 to 4
µs on a 3 GHz core. A smaller value promises a rate that cannot be held."""

SPARE = 0.8
"""Share of the period that a tick may fill, without unit. Contacts cost more than the start does,
and a tick that fills its period misses the next deadline."""


def check_pace(
    scene: Scene, method: Method, period: float, substeps: int, *, is_real: bool
) -> None:
    """Refuses a scene that cannot hold the rate on a real device; warns on others.

    A missed deadline prolongs the hold, and the condition b > KT/2 + B' then needs more damping.
    The scene must be prepared; it is not changed.

    Raises:
        SceneError: The steps of a tick take longer than the period; the message names a possible
            rate.
    """
    needed = substeps * step_time(scene, method)
    if needed <= period:
        return
    held = float(f"{rate_for(needed):.2g}")  # two digits, and no exponent
    message = (
        f"scene '{scene.name}' needs {needed * 1e3:.3g} ms of MuJoCo a tick at its start, the "
        f"period is {period * 1e3:.3g} ms; it could hold about {held:g} Hz: lower the "
        "rate, or find the cause with 'hapticbridge check'"
    )
    if is_real:
        raise SceneError(message)
    warnings.warn(message, stacklevel=2)


def rate_for(needed: float) -> float:
    """Returns the rate in Hz that ticks hold whose steps take ``needed`` s, > 0 and finite."""
    return SPARE / (needed + BESIDE_THE_STEP)


def step_time(scene: Scene, method: Method) -> float:
    """Returns the median time in s of MuJoCo's step from the scene's state, measured on a copy."""
    data, step, now = copy.copy(scene.data), method.step, time.perf_counter_ns
    step(scene.model, data)  # not counted, because caches are cold
    times: list[int] = []
    begin = now()
    while len(times) < STEPS and (not times or now() - begin < LONGEST * 1e9):
        started = now()
        step(scene.model, data)
        times.append(now() - started)
    return float(np.median(times)) * 1e-9
