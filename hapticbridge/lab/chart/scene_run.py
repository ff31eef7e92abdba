"""A scene led along a prescribed motion at one setting, in the compiled loop of the bridge."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.check.case import motion_for
from hapticbridge.check.perception import felt_error
from hapticbridge.coupling import Coupling
from hapticbridge.demand.methods import (
    IMPLICIT,
    LOSSLESS_COUPLING,
    Method,
    prepare,
    resolve_contact_stiffness,
)
from hapticbridge.device import Motion
from hapticbridge.device.trajectory import pose_at
from hapticbridge.errors import HapticBridgeError, StudyError
from hapticbridge.kernel.mujoco_c import without_timers
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.kernel.record import SAMPLE_DTYPE, TICK_DTYPE
from hapticbridge.kernel.state import BoundKernel
from hapticbridge.kernel.tick import simulate
from hapticbridge.lab.chart.score import (
    NAN,
    Judge,
    Panel,
    PeerWork,
    Reading,
    Run,
    Score,
    Take,
    diverged,
    score_of,
)
from hapticbridge.lab.chart.setting import (
    OWN,
    SCENE_TICKS,
    USUAL_MS,
    Setting,
    ShippedOptions,
)
from hapticbridge.lab.methods import METHODS
from hapticbridge.run.options import (
    PRESCRIBED_MOTION,
    SAME_FRAME,
    RunSetup,
    Workspace,
    steady_stiffness,
)
from hapticbridge.run.slow_scene import SlowScene
from hapticbridge.run.summary import Ledger
from hapticbridge.scene import Scene, load_scene

Runner = Callable[[NDArray[np.void], NDArray[np.void]], int]
"""Function that runs one tick per sample, writes the records, and returns the completed ticks."""

Path = Callable[[NDArray[np.float64]], tuple[NDArray[np.float64], NDArray[np.float64]]]
"""Motion of the handle: maps times in s, shape (n,), to positions in m, (n, 3), and quaternions (n,
4), both relative to the handle's start. At time 0 the handle is there, at rest."""

Start = Callable[[Scene], None]
"""Changes the scene's state before the first tick, for example to a body that already spins."""

_BAD = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
)
"""MuJoCo warnings after which MuJoCo has reset the scene, so that the rest is another run."""


class Prepared:
    """A scene with its motion, prepared anew for every setting; one for all points of a chart.

    Args:
        scene: Loaded scene; its model is changed.
        path: Path of the handle.
        duration: Duration in s.
        coupling: Requested K and B.
        starts: Start of each take; one take by default.
        workspace: Map from the path to the scene. By default the path is relative to the handle's
            start, where the bridge lets the handle carry what the tool does not rest on.
    """

    def __init__(
        self,
        scene: Scene,
        path: Path,
        duration: float,
        coupling: Coupling,
        starts: Sequence[Start | None] = (None,),
        workspace: Workspace = SAME_FRAME,
    ) -> None:
        self._scene = scene
        self._shipped = ShippedOptions.from_model(scene.model)
        self._path = path
        self.duration = duration
        self.coupling = coupling
        self._starts, self._workspace = starts, workspace
        self._samples: dict[float, NDArray[np.void]] = {}
        # a thousand runs share the memory of the longest
        self._rows = np.zeros(0, TICK_DTYPE)

    @property
    def shipped(self) -> ShippedOptions:
        """Contacts and solver of the scene's file."""
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
            setting: Setting of the simulation.
            judge: Receives each take before the next one overwrites its records.

        Raises:
            HapticBridgeError: The method cannot render the scene.
        """
        samples, seconds = self.samples(setting.period), 0.0
        if self._rows.size < samples.size:
            self._rows = np.zeros(samples.size, TICK_DTYPE)
        rows = self._rows[: samples.size]
        for start in self._starts:
            binding, run = self._opened(setting, start)
            with without_timers():
                begin = time.thread_time()
                done = run(samples, rows)
                ended = time.thread_time()
            # the time of a diverged run is extrapolated to its full length
            seconds += (ended - begin) * samples.size / max(done, 1)
            if judge is not None:
                judge(self._take(setting, binding, rows[:done], samples.size))
        return seconds

    def bound(self, setting: Setting, start: Start | None = None) -> BoundKernel:
        """Resets the scene to its start, and binds it for the compiled loop.

        Raises:
            HapticBridgeError: The method cannot render the scene.
        """
        scene = self._scene
        return BoundKernel(scene.model, scene.data, self._parameters(setting, start))

    def _opened(self, setting: Setting, start: Start | None) -> tuple[BoundKernel, Runner]:
        """Returns the bound loop, and the function that runs its ticks."""
        scene, parameters = self._scene, self._parameters(setting, start)
        binding = BoundKernel(scene.model, scene.data, parameters)
        if not setting.scene_ticks:
            return binding, lambda samples, rows: simulate(
                binding.state, samples, binding.row, rows
            )
        slow = SlowScene(binding, scene.model, scene.data, parameters)

        def run(samples: NDArray[np.void], rows: NDArray[np.void]) -> int:
            flags = np.zeros(samples.size, np.int64)
            results = 1 + np.arange(samples.size) // setting.scene_ticks
            return slow.simulate(
                samples, flags, np.full(samples.size, setting.period), results, rows
            )

        return binding, run

    def _parameters(self, setting: Setting, start: Start | None) -> RunParameters:
        scene, method = self._scene, setting.method
        scene.set_contact(is_rigid=False)  # or it would restore what is applied now
        self._shipped.apply(scene, setting)
        effective = prepare(
            scene, self.coupling, setting.scene_period, setting.substeps, method, warns=False
        )
        # an error inside the C symbol would end the process, so the first step runs in Python
        mujoco.mj_step(scene.model, scene.data)
        scene.reset()
        if start is not None:
            start(scene)
        setup = RunSetup(
            scene=scene,
            coupling=self.coupling,
            method=method,
            period=setting.period,
            substeps=setting.substeps,
            scene_ticks=setting.scene_ticks,
            contact_stiffness=resolve_contact_stiffness(method, self.coupling, None),
            workspace=self._workspace,
        )
        return setup.parameters(self.samples_at(np.zeros(1)), effective)

    def _take(
        self, setting: Setting, binding: BoundKernel, rows: NDArray[np.void], ticks: int
    ) -> Take:
        warnings, ledger = self._scene.data.warning, Ledger.from_state(binding.state)
        ended = ""
        if rows.size < ticks:
            ended = f"a number was not finite after {setting.period * rows.size:.4g} s"
        elif bad := [kind for kind in _BAD if warnings[int(kind)].number > 0]:
            ended = f"MuJoCo gave its state up ({bad[0].name.removeprefix('mjWARN_')})"
        created = float(rows["environment_energy"].max(initial=0.0))
        meter = Reading(ledger.environment, created, ledger.slack_share)
        return Take(
            setting=setting,
            records=rows,
            ended=ended,
            meter=meter,
            engine=Reading() if setting.method.scheme.properties.holds_wrench else meter,
            velocity=self._scene.data.qvel.copy(),
        )


class SceneRun:
    """A stage at one setting, as a chart times and judges it."""

    def __init__(self, stage: Prepared, setting: Setting, judge: Judge) -> None:
        self._stage, self._setting, self._judge = stage, setting, judge
        self.seconds = stage.seconds

    @property
    def chosen(self) -> Mapping[str, str | int]:
        """Contacts and solver of this point, for a table."""
        return self._stage.shipped.chosen(self._setting)

    def run(self) -> float:
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
    """Stages of a workload. A scene with a weld cannot serve the other methods."""

    def __init__(self, make: Callable[[], Prepared]) -> None:
        self._make = make
        self._stages: dict[bool, Prepared] = {}

    def for_method(self, setting: Setting) -> Prepared:
        """Returns the stage that a setting runs on."""
        is_weld = setting.method.is_weld
        if is_weld not in self._stages:
            self._stages[is_weld] = self._make()
        return self._stages[is_weld]


REFERENCE_REFINEMENT = 32
"""Ratio of the chart's smallest step to the reference's step."""

TOUCHING = 0.5
"""Share of the reference's instants in contact that a run must share; below it, contact counts as
lost."""


@dataclass(frozen=True, slots=True)
class OwnReference:
    """A method's own limit at small steps.

    Attributes:
        records: ``TICK_DTYPE`` at whole multiples of the chart's longest period.
        period: Period of the reference in s.
    """

    records: NDArray[np.void]
    period: float


class OwnReferences:
    """References of the methods, each computed on first use.

    Args:
        stages: Stages to run on.
        grid: Longest period of the chart in s.
        finest: Shortest period of the chart in s.
        duration: Duration in s of the compared part of the motion.
        refinement: Ratio of ``finest`` to the reference's step.
    """

    def __init__(
        self,
        stages: Stages,
        grid: float,
        finest: float,
        duration: float,
        refinement: int = REFERENCE_REFINEMENT,
    ) -> None:
        self._stages, self._grid = stages, grid
        self._period, self._count = finest / refinement, round(duration / grid)
        self._references: dict[str, OwnReference | None] = {}

    def reference_of(self, method: Method) -> OwnReference | None:
        """Returns a method's reference; None if it diverges even at this step."""
        if method.name not in self._references:
            setting = Setting(method, self._period)
            stage = self._stages.for_method(setting)
            records = fine_records(stage, setting, self._grid, self._count)
            self._references[method.name] = (
                None if records is None else OwnReference(records, self._period)
            )
        return self._references[method.name]

    def score(self, take: Take) -> Score:
        """Compares the first part of a take with its method's reference."""
        if take.setting.engine != OWN:
            return Score(jnd=NAN)  # the method is not on the chart
        reference = self.reference_of(take.setting.method)
        if take.has_diverged:
            return diverged(take.created, take.ended)
        if reference is None:
            return Score(jnd=NAN, created=take.created, verdict=take.environment)
        records = take.records_at(self._grid)[: self._count]
        touches = reference.records["contacts"] > 0
        has_lost = touches.any() and np.mean(records["contacts"][touches] > 0) < TOUCHING
        return score_of(
            reference.records,
            records,
            created=take.created,
            verdict="lost contact" if has_lost else take.environment,
        )

    def disagreement(self) -> dict[str, float]:
        """Returns the distance in JND of each method's limit from the central one.

        The central limit has the least median distance to all, among the methods with rigid
        contacts and a coupling's law, if there are any, or with a law. Scenes model rigid bodies:
        where contacts of MuJoCo converge to another motion, their limit is that of its springs.
        """
        found = {name: each.records for name, each in self._references.items() if each is not None}
        laws = [name for name in found if METHODS[name].has_law]
        centers = [name for name in laws if METHODS[name].is_rigid] or laws or list(found)
        apart = [
            {name: felt_error(found[center], each).jnd for name, each in found.items()}
            for center in centers
        ]
        return min(apart, key=lambda row: float(np.median(list(row.values()))), default={})


def fine_records(
    stage: Prepared, setting: Setting, grid: float, count: int
) -> NDArray[np.void] | None:
    """Runs a stage and keeps one record per ``grid`` s; None if it diverges.

    The memory of a million ticks is not needed: the run advances from one instant to the next.

    Raises:
        StudyError: The method cannot render the scene, or ``grid`` is no multiple of the period.
    """
    every = round(grid / setting.period)
    if abs(every * setting.period / grid - 1) > 1e-9:
        raise StudyError(f"{grid:g} s is no whole number of periods of {setting.period:g} s")
    try:
        binding = stage.bound(setting)
    except HapticBridgeError as error:
        raise StudyError(f"no reference for '{setting.method.name}': {error}") from None
    kept, rows = np.zeros(count, TICK_DTYPE), np.zeros(every, TICK_DTYPE)
    for k in range(count):
        times = setting.period * np.arange(k * every + 1.0, (k + 1) * every + 1)
        if simulate(binding.state, stage.samples_at(times), binding.row, rows) < every:
            return None
        kept[k] = rows[-1]
    return kept


class Workload(ABC):
    """A workload of a chart: one stage at different settings.

    Args:
        coupling: Requested K and B.
        stages: Stages to run on.
        references: The methods' own limits, if a panel compares with them.

    Attributes:
        name: Name at the command line.
        about: One sentence.
        panels: At least one; the recommendation depends on the first.
        has_contact: True if bodies can touch.
        needs_tool: Text after "method 'weld' …" for a method without the tool's own dynamics; empty
            if the workload suits it.
    """

    name: str
    about: str
    panels: Sequence[Panel]
    has_contact: bool
    needs_tool: ClassVar[str] = ""
    # of a workload that is judged by one reference: its rows, and the time between them in s
    _reference: NDArray[np.void]
    _grid: float

    def __init__(
        self, coupling: Coupling, stages: Stages, references: OwnReferences | None = None
    ) -> None:
        self.coupling = coupling
        self.references = references
        self._stages = stages

    def run(self, setting: Setting) -> Run:
        """Prepares a point.

        Raises:
            StudyError: The method omits the tool's own dynamics, which the workload judges.
        """
        method = setting.method
        if self.needs_tool and (method.is_weld or not method.has_coupling):
            raise StudyError(f"method '{method.name}' {self.needs_tool}")
        return SceneRun(self._stages.for_method(setting), setting, self._judge)

    @abstractmethod
    def peer_work(self) -> PeerWork:
        """Returns the workload for other engines.

        Raises:
            StudyError: Other engines cannot represent it.
        """

    def _judge(self, takes: Sequence[Take]) -> Mapping[str, Score]:
        """Returns the scores of a point's takes by ``Panel.key``: one take against the reference.

        The tool of a workload with contact must touch, or it is not the workload's motion.
        """
        (take,), (panel,) = takes, self.panels
        if take.has_diverged:
            return {panel.key: diverged(take.created, take.ended)}
        records = take.records_at(self._grid)
        is_lost = self.has_contact and not np.any(records["contacts"] > 0)
        score = score_of(
            self._reference,
            records,
            created=take.created,
            verdict="lost contact" if is_lost else take.environment,
        )
        return {panel.key: score}


COUPLING = Coupling(1000.0, 1.0, 1.0, 1e-3)
"""Default coupling, K = 1000 N/m and B = 1 N s/m. The default simulated device (b = 2 N s/m)
certifies it at 1 kHz. There B = K T, so that a compensated coupling is compensated in full."""

PROBED = 1e-3
"""Period T in s of the run that finds the first contact."""

AFTER_CONTACT = 0.3
"""Simulated time in s of the motion after the first contact."""

SHORTEST, LONGEST = 0.4, 1.2
"""Range of the simulated time in s: enough ticks to compare, and a chart in three minutes. A path
that touches later is played faster in proportion."""

REFINEMENT = 8
"""Ratio of the chart's smallest step to the reference's step: 64 times smaller than 1 ms by
default. Scenes cost many times as much as a peg."""


class SceneMotion(Workload):
    """A shipped or user's scene with its hand path as a workload.

    Args:
        scene: A shipped scene's name or an MJCF file, with ``NAME.csv`` beside it.
        coupling: K and B.
        grid: Longest period T in s.
        finest: Shortest period T in s.

    Raises:
        HapticBridgeError: The scene cannot be read, or there is no hand path beside it.
    """

    def __init__(
        self,
        scene: str,
        coupling: Coupling,
        grid: float,
        finest: float,
    ) -> None:
        first = load_scene(scene)
        motion = motion_for(first)
        if motion is None:
            raise StudyError(
                f"scene '{first.name}' has no hand path; put {first.path.stem}.csv "
                "(t,x,y,z[,qw,qx,qy,qz]) beside it"
            )
        self.name = first.name
        touched = _first_contact(Prepared(first, path_of(motion), motion.duration, coupling))
        self.has_contact = touched is not None
        needed = motion.duration if touched is None else touched + AFTER_CONTACT
        duration = float(np.clip(needed, SHORTEST, LONGEST))
        self.speed = max(1.0, needed / duration)
        duration = grid * max(1, round(duration / grid))
        stages = Stages(
            lambda: Prepared(load_scene(scene), path_of(motion, self.speed), duration, coupling)
        )
        self._limits = OwnReferences(stages, grid, finest, duration, REFINEMENT)
        super().__init__(coupling, stages, self._limits)
        pace = "" if self.speed == 1 else f", {self.speed:.3g} times as fast"
        self.about = f"the scene's own hand path, {duration:g} s of it{pace}"
        self.panels: Sequence[Panel] = (
            Panel(
                "moving",
                f"{self.name} along its hand path{pace}",
                f"the same method at a step {REFINEMENT} times smaller than the smallest: "
                "convergence, not truth",
                is_truth=False,
            ),
        )

    def peer_work(self) -> PeerWork:
        """Refuses other engines, because a method's own limit has no meaning across engines.

        Raises:
            StudyError: Always.
        """
        raise StudyError(
            f"scene '{self.name}' has no reference that is true for every engine; charts with "
            "other engines: 'point_mass', 'peg_in_hole', 'spinning_body'"
        )

    def _judge(self, takes: Sequence[Take]) -> Mapping[str, Score]:
        (take,) = takes
        return {self.panels[0].key: self._limits.score(take)}


class SceneRates(SceneMotion):
    """A scene that steps less often than a loop of 1 kHz, or in a loop that is as slow as it.

    All points have one coupling, the stiffest that is steady at the slowest rate of the scene.

    Args:
        scene: As for ``SceneMotion``.
        name: Name of the files.

    Raises:
        HapticBridgeError: The scene cannot be read, or there is no hand path beside it.
    """

    has_contact = False  # its contacts are not varied

    def __init__(self, scene: str, name: str) -> None:
        grid = 1e-3 * USUAL_MS * max(SCENE_TICKS)
        most = steady_stiffness(load_scene(scene), PRESCRIBED_MOTION, grid, 1.0, 1.0)
        share = min(1.0, most / COUPLING.stiffness)
        coupling = replace(
            COUPLING,
            stiffness=share * COUPLING.stiffness,
            rotational_stiffness=share * COUPLING.rotational_stiffness,
        )
        super().__init__(scene, coupling, grid, grid)
        (panel,) = self.panels
        self.panels = (
            replace(panel, key="rates", reference="the scene stepped in every tick of 1 kHz"),
        )
        self.references = None
        kept: list[Take] = []
        usual = Setting(LOSSLESS_COUPLING, 1e-3 * USUAL_MS)
        self._stages.for_method(usual).play(usual, kept.append)
        self._reference = kept[0].records.copy()
        self.about, self.name = f"{self.name}: {self.about}", name

    def _judge(self, takes: Sequence[Take]) -> Mapping[str, Score]:
        (take,) = takes
        if take.has_diverged:
            return {"rates": diverged(take.created, take.ended)}
        # a slower loop holds its force until its next tick
        ticks = round(take.setting.period / (1e-3 * USUAL_MS))
        ends = np.arange(ticks, self._reference.size + 1)
        score = score_of(
            self._reference[ends - 1],
            take.records[ends // ticks - 1],
            created=take.created,
            verdict=take.environment,
        )
        return {"rates": score}


def path_of(motion: Motion, speed: float = 1.0) -> Path:
    """Returns a motion as the path of a stage, played faster by a factor >= 1."""

    def path(times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        positions, quaternions = np.zeros((times.size, 3)), np.zeros((times.size, 4))
        cursor = 0
        for k, now in enumerate(times):
            start = cursor if k and now >= times[k - 1] else 0
            cursor, positions[k], quaternions[k] = pose_at(motion.table, speed * now, start)
        return positions, quaternions

    return path


def _first_contact(stage: Prepared) -> float | None:
    """Returns the time in s of the tool's first touch, None for never.

    Contacts at the start do not count: the first tick with more of them does.
    """
    samples = stage.samples(PROBED)
    rows = np.zeros(samples.size, TICK_DTYPE)
    binding = stage.bound(Setting(IMPLICIT, PROBED))
    done = simulate(binding.state, samples, binding.row, rows)
    if not done:
        return None
    contacts = rows["contacts"][:done]
    more = np.flatnonzero(contacts > contacts[0])
    if more.size:
        return float(PROBED * more[0])
    return 0.0 if contacts[0] else None
