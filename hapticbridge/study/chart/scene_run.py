"""A scene led along a prescribed motion at one setting, compiled, as a bridge would run it."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.kernel.codes import WELD
from hapticbridge.kernel.state import BoundKernel
from hapticbridge.kernel.tick import simulate
from hapticbridge.options import run_parameters
from hapticbridge.record import SAMPLE_DTYPE, TICK_DTYPE
from hapticbridge.rendering import prepare
from hapticbridge.scene import Scene
from hapticbridge.study.chart.score import Score, Verdict
from hapticbridge.study.chart.setting import Setting, ShippedOptions
from hapticbridge.summary import Ledger

Path = Callable[[NDArray[np.float64]], tuple[NDArray[np.float64], NDArray[np.float64]]]
"""The handle's motion: times in s, shape (n,), to positions in m, (n, 3), and quaternions (n, 4),
both counted from the handle's start; at time 0 it is there, at rest."""

Start = Callable[[Scene], None]
"""Changes the scene's state before the first tick: a body that already spins."""

_BAD = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
)
"""After these MuJoCo has reset the scene, and what follows is another run."""


@dataclass(frozen=True, slots=True, eq=False)
class Take:
    """One pass along the motion.

    Attributes:
        setting: How.
        records: ``TICK_DTYPE``, one per tick that was completed.
        ended: Why it diverged, in words: it ended early, or MuJoCo gave its state up; empty where
            it did not.
        environment: ``strict``, ``within slack`` or ``active``.
        created: Largest Σ E_k in J.
        velocity: ``qvel`` at the end.
    """

    setting: Setting
    records: NDArray[np.void]
    ended: str
    environment: Verdict
    created: float
    velocity: NDArray[np.float64]

    @property
    def has_diverged(self) -> bool:
        """Whether it ended early, or MuJoCo gave its state up."""
        return bool(self.ended)

    def at(self, grid: float) -> NDArray[np.void]:
        """Returns the records at whole multiples of a time in s, the first excluded."""
        every = round(grid / self.setting.period)
        return self.records[every - 1 :: every]


class Stage:
    """A scene with its motion, set up anew for every setting; one for all points of a chart.

    Args:
        scene: Loaded; its model is changed.
        path: Of the handle.
        duration: In s.
        coupling: K and B asked for.
        starts: How each take begins; one take by default.
    """

    def __init__(
        self,
        scene: Scene,
        path: Path,
        duration: float,
        coupling: Coupling,
        starts: Sequence[Start | None] = (None,),
    ) -> None:
        self._scene = scene
        self._shipped = ShippedOptions.of(scene.model)
        self._path = path
        self.duration = duration
        self.coupling = coupling
        self._starts = starts
        self._samples: dict[float, NDArray[np.void]] = {}
        # a thousand runs share the memory of the longest
        self._rows = np.zeros(0, TICK_DTYPE)

    @property
    def shipped(self) -> ShippedOptions:
        """Contacts and solver as the scene's file says them."""
        return self._shipped

    @property
    def seconds(self) -> float:
        """Simulated time of all takes in s."""
        return self.duration * len(self._starts)

    def samples(self, period: float) -> NDArray[np.void]:
        """Returns the handle's poses at T, 2T, … as ``SAMPLE_DTYPE``."""
        if period not in self._samples:
            ticks = round(self.duration / period)
            self._samples[period] = self.samples_at(period * np.arange(1.0, ticks + 1))
        return self._samples[period]

    def samples_at(self, times: NDArray[np.float64]) -> NDArray[np.void]:
        """Returns the handle's poses at times in s as ``SAMPLE_DTYPE``."""
        samples = np.zeros(times.size, SAMPLE_DTYPE)
        samples["position"], samples["quaternion"] = self._path(times)
        return samples

    def play(self, setting: Setting, judge: Callable[[Take], None] | None = None) -> float:
        """Runs every take; returns the processor time of the ticks alone in s.

        Args:
            setting: How.
            judge: Sees each take before the next one overwrites its records.

        Raises:
            HapticBridgeError: The method cannot render the scene.
        """
        samples, seconds = self.samples(setting.period), 0.0
        if self._rows.size < samples.size:
            self._rows = np.zeros(samples.size, TICK_DTYPE)
        rows = self._rows[: samples.size]
        for start in self._starts:
            binding = self.bound(setting, start)
            begin = time.thread_time()
            done = simulate(binding.state, samples, binding.row, rows)
            # what diverged counts as if it had gone on
            seconds += (time.thread_time() - begin) * samples.size / max(done, 1)
            if judge is not None:
                judge(self._take(setting, binding, rows[:done], samples.size))
        return seconds

    def bound(self, setting: Setting, start: Start | None = None) -> BoundKernel:
        """Puts the scene to its start, and binds it for the compiled loop.

        Raises:
            HapticBridgeError: The method cannot render the scene.
        """
        scene, period, method = self._scene, setting.period, setting.method
        self._shipped.apply(scene, setting)
        felt = prepare(scene, self.coupling, period, setting.substeps, method, warns=False)
        # an error inside the C symbol would end the process, so the first step is Python's
        mujoco.mj_step(scene.model, scene.data)
        scene.reset()
        if start is not None:
            start(scene)
        first = np.zeros(1, SAMPLE_DTYPE)
        first["quaternion"][0, 0] = 1.0
        parameters = run_parameters(
            scene, self.coupling, method, first, period=period, felt=felt, substeps=setting.substeps
        )
        return BoundKernel(scene.model, scene.data, parameters)

    def _take(
        self, setting: Setting, binding: BoundKernel, rows: NDArray[np.void], ticks: int
    ) -> Take:
        warnings = self._scene.data.warning
        ended = ""
        if rows.size < ticks:
            ended = f"a number was not finite after {setting.period * rows.size:.4g} s"
        elif bad := [kind for kind in _BAD if warnings[int(kind)].number > 0]:
            ended = f"MuJoCo gave its state up ({bad[0].name.removeprefix('mjWARN_')})"
        return Take(
            setting=setting,
            records=rows,
            ended=ended,
            environment=Ledger.of(binding.state).environment,
            created=float(rows["environment_energy"].max(initial=0.0)),
            velocity=self._scene.data.qvel.copy(),
        )


Judge = Callable[[Sequence[Take]], Mapping[str, Score]]
"""What a point's takes say, by ``Panel.key``; the takes' records are copies."""


class SceneRun:
    """A stage at one setting, as a chart times and judges it."""

    def __init__(self, stage: Stage, setting: Setting, judge: Judge) -> None:
        self._stage, self._setting, self._judge = stage, setting, judge
        self.seconds = stage.seconds

    @property
    def chosen(self) -> Mapping[str, str | int]:
        """Contacts and solver of this point, for a table."""
        return self._stage.shipped.chosen(self._setting)

    def go(self) -> float:
        """Runs it; returns the processor time in s."""
        return self._stage.play(self._setting)

    def scores(self) -> Mapping[str, Score]:
        """Runs it once more, and judges it."""
        takes: list[Take] = []

        def keep(take: Take) -> None:
            takes.append(replace(take, records=take.records.copy()))

        self._stage.play(self._setting, keep)
        return self._judge(takes)


class Stages:
    """The stages of a workload: a scene with a weld in it cannot serve the other methods."""

    def __init__(self, make: Callable[[], Stage]) -> None:
        self._make = make
        self._stages: dict[bool, Stage] = {}

    def for_method(self, setting: Setting) -> Stage:
        """Returns the stage that a setting runs on."""
        is_weld = setting.method.scheme == WELD
        if is_weld not in self._stages:
            self._stages[is_weld] = self._make()
        return self._stages[is_weld]
