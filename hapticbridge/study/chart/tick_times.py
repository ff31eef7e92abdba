"""Times of single ticks of a scene, as a bridge or MuJoCo alone steps it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.check.cost import WARM_UP
from hapticbridge.check.observe import rehearsal_parameters
from hapticbridge.jit import direct
from hapticbridge.kernel.state import BoundKernel
from hapticbridge.kernel.tick import after_step, before_step
from hapticbridge.record import SAMPLE_DTYPE
from hapticbridge.scene import Scene
from hapticbridge.study.chart.scene_motion import COUPLING

PERIOD = 1e-3
"""T in s."""

TICKS = 300
"""Ticks of a run, with the first ``WARM_UP`` not counted."""

LONGEST = 2.0
"""Time in s after which a run ends early: scenes that cannot be simulated at 1 kHz by far."""

SHAKE = 1e-3
"""How far the handle goes down in m, at 5 Hz: a tool on the floor is pressed, and never sleeps."""


@dataclass(frozen=True, slots=True)
class Variant:
    """How a scene is stepped.

    Attributes:
        name: In tables.
        has_islands: Whether MuJoCo divides the scene into islands that it solves by themselves.
        is_bare: Whether MuJoCo's step is run alone, without the bridge's arithmetic.
        sleeps: Whether MuJoCo lets bodies at rest sleep. The bridge refuses that (a sleeping tool
            would not feel its coupling), so it is measured with the bare step.
    """

    name: str
    has_islands: bool = True
    is_bare: bool = False
    sleeps: bool = False


USUAL = Variant("bridge")
VARIANTS = (
    USUAL,
    Variant("bridge, islands off", has_islands=False),
    Variant("MuJoCo's step alone", is_bare=True),
    Variant("MuJoCo's step alone, with sleep", is_bare=True, sleeps=True),
)


def tick_times(scene: Scene, variant: Variant, clock: Callable[[], int]) -> NDArray[np.float64]:
    """Returns the time of each tick in s, whole ticks as the live loop has them.

    Args:
        scene: Reset first.
        variant: How it is stepped.
        clock: Time in ns.

    Raises:
        SceneError: The scene cannot be rendered.
    """
    model, data = scene.model, scene.data
    with _flags(model, variant):
        parameters = rehearsal_parameters(scene, COUPLING, PERIOD)
        binding = BoundKernel(model, data, parameters)
        state, row = binding.state, binding.row
        samples = np.zeros(TICKS, SAMPLE_DTYPE)
        phase = 2 * np.pi * 5.0 * PERIOD * np.arange(1.0, TICKS + 1)
        samples["position"][:, 2] = -SHAKE / 2 * (1 - np.cos(phase))
        samples["quaternion"][:, 0] = 1.0
        before = direct(before_step, state, samples[:1], row, 0, PERIOD)
        after = direct(after_step, state, row, 0)
        step, times = mujoco.mj_step, np.zeros(TICKS)
        started, done = clock(), 0
        for k in range(TICKS):
            sample = samples[k : k + 1]
            if variant.is_bare:
                before(state, sample, row, 0, PERIOD)
                begin = clock()
                step(model, data)
                times[k] = clock() - begin
            else:
                begin = clock()
                before(state, sample, row, 0, PERIOD)
                step(model, data)
                after(state, row, 0)
                times[k] = clock() - begin
            done = k + 1
            if clock() - started > 1e9 * LONGEST and done > 2 * WARM_UP:
                break
    return 1e-9 * times[WARM_UP:done]


@contextmanager
def _flags(model: mujoco.MjModel, variant: Variant) -> Iterator[None]:
    before = int(model.opt.disableflags), int(model.opt.enableflags)
    if not variant.has_islands:
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ISLAND)
    if variant.sleeps:
        model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    try:
        yield
    finally:
        model.opt.disableflags, model.opt.enableflags = before
