"""Costs of two versions measured side by side."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from hapticbridge.check.draft import Draft
from hapticbridge.check.rehearsal import rehearsal_parameters
from hapticbridge.device import Motion
from hapticbridge.errors import SceneError
from hapticbridge.kernel.simulation import simulate
from hapticbridge.kernel.state import Binding
from hapticbridge.tick import TICK_DTYPE

CHUNKS = 40
"""Number of stretches into which a motion is cut. The two versions take turns after each, so that a
disturbance of the machine slows both. More stretches cost 20 µs each."""

REPEATS = 5
"""Largest number of passes. The work is equal in each and disturbances only add time, so each
stretch counts with its smallest time. Beside six other processes on two cores, a scene measured
against itself came out within 1 %; the median scattered twice as much."""

PATIENCE = 0.6
"""Processor time in s after which a comparison stops with fewer passes."""

CostMeter: TypeAlias = Callable[[Draft, Draft, Motion], tuple[float, float]]
"""Returns the processor time in s of each of two versions per second of motion."""


def processor_costs(first: Draft, second: Draft, motion: Motion) -> tuple[float, float]:
    """Measures the processor time of two versions in s per second of motion.

    It covers MuJoCo's step and the bridge's arithmetic, by the thread's own clock. The first pass
    is a warm-up and is dropped if there are at least three.

    Raises:
        SceneError: A version does not compile, or a result is not finite.
    """
    stages = [Stage(draft, motion) for draft in (first, second)]
    passes: list[NDArray[np.float64]] = []
    start = time.thread_time()
    while len(passes) <= REPEATS:
        passes.append(one_pass(stages))
        if (time.thread_time() - start) * (1 + 1 / len(passes)) > PATIENCE:
            break
    kept = passes[1:] if len(passes) > 2 else passes
    seconds = np.min(kept, axis=0).sum(axis=1)
    return float(seconds[0] / motion.duration), float(seconds[1] / motion.duration)


class Stage:
    """A version of a scene that runs through a motion in stretches.

    Attributes:
        rows: Records of the run, ``TICK_DTYPE``.
    """

    def __init__(self, draft: Draft, motion: Motion) -> None:
        """Compiles the scene; call ``reset`` before the first stretch."""
        self._scene = draft.compiled()
        self._setting = draft.setting
        self._samples = draft.samples(motion)
        self.rows = np.zeros(self._samples.size, TICK_DTYPE)
        self._edges = np.linspace(0, self._samples.size, CHUNKS + 1).astype(int)

    def reset(self) -> None:
        """Resets the scene."""
        setting = self._setting
        parameters = rehearsal_parameters(
            self._scene, setting.coupling, setting.period, setting.substeps
        )
        self._binding = Binding(self._scene.model, self._scene.data, parameters)

    def run(self, chunk: int) -> float:
        """Runs one stretch; returns its processor time in s.

        Raises:
            SceneError: A result is not finite.
        """
        binding, part = self._binding, slice(self._edges[chunk], self._edges[chunk + 1])
        rows = self.rows[part]
        start = time.thread_time()
        done = simulate(binding.state, self._samples[part], binding.row, rows)
        seconds = time.thread_time() - start
        if done < rows.size:
            raise SceneError(f"scene '{self._scene.name}' is not finite within the motion")
        return seconds


def one_pass(stages: list[Stage]) -> NDArray[np.float64]:
    """Runs all versions through the whole motion in turns; returns s by version and stretch."""
    for stage in stages:
        stage.reset()
    return np.array([[stage.run(chunk) for stage in stages] for chunk in range(CHUNKS)]).T
