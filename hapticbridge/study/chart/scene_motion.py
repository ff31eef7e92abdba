"""Workload of any scene: its own hand path up to the first contacts, against finer steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from hapticbridge.check.case import motion_for
from hapticbridge.coupling import Coupling
from hapticbridge.device import Motion
from hapticbridge.device.trajectory import pose_at
from hapticbridge.errors import StudyError
from hapticbridge.kernel.tick import simulate
from hapticbridge.record import TICK_DTYPE
from hapticbridge.rendering import IMPLICIT
from hapticbridge.scene import load_scene
from hapticbridge.study.chart.engine_run import PeerWork
from hapticbridge.study.chart.own_reference import OwnReferences
from hapticbridge.study.chart.scene_run import Path, Stage, Stages, Take
from hapticbridge.study.chart.score import Score
from hapticbridge.study.chart.setting import Setting
from hapticbridge.study.chart.staged import Staged
from hapticbridge.study.chart.workload import Panel

COUPLING = Coupling(1000.0, 1.0, 1.0, 1e-3)
"""K = 1000 N/m and B = 1 N s/m: what the default simulated device (b = 2 N s/m) certifies at 1 kHz,
and B = K T there, so that a compensated coupling is compensated in full."""

PROBED = 1e-3
"""T in s of the run that finds the first contact."""

AFTER_CONTACT = 0.3
"""How much of the motion after the first contact is simulated, in s."""

SHORTEST, LONGEST = 0.4, 1.2
"""Range of the simulated time in s: enough ticks to compare, and a chart in three minutes. Where
the path touches later, it is played as much faster as it takes."""

REFINEMENT = 8
"""How many times smaller the reference's step is than the smallest of the chart: 64 times smaller
than 1 ms by default. Scenes cost many times what a peg does."""


class SceneMotion(Staged):
    """The workload.

    Args:
        scene: A shipped scene's name or an MJCF file, with ``NAME.csv`` beside it.
        coupling: K and B.
        grid: Longest period T in s.
        finest: Shortest period T in s.
        refinement: How many times smaller the reference's step is than ``finest``.

    Raises:
        HapticBridgeError: The scene cannot be read, or there is no hand path beside it.
    """

    def __init__(
        self,
        scene: str,
        coupling: Coupling,
        grid: float,
        finest: float,
        refinement: int = REFINEMENT,
    ) -> None:
        first = load_scene(scene)
        motion = motion_for(first)
        if motion is None:
            raise StudyError(
                f"scene '{first.name}' has no hand path; put {first.path.stem}.csv "
                "(t,x,y,z[,qw,qx,qy,qz]) beside it"
            )
        self.name = first.name
        touched = _first_contact(Stage(first, path_of(motion), motion.duration, coupling))
        self.has_contact = touched is not None
        needed = motion.duration if touched is None else touched + AFTER_CONTACT
        duration = float(np.clip(needed, SHORTEST, LONGEST))
        self.speed = max(1.0, needed / duration)
        duration = grid * max(1, round(duration / grid))
        stages = Stages(
            lambda: Stage(load_scene(scene), path_of(motion, self.speed), duration, coupling)
        )
        self._limits = OwnReferences(stages, grid, finest, duration, refinement)
        super().__init__(coupling, stages, self._limits)
        told = "" if self.speed == 1 else f", {self.speed:.3g} times as fast"
        self.about = f"the scene's own hand path, {duration:g} s of it{told}"
        self.panels: Sequence[Panel] = (
            Panel(
                "moving",
                f"{self.name} along its hand path{told}",
                f"the same method at a step {refinement} times smaller than the smallest: "
                "convergence, not truth",
                is_truth=False,
            ),
        )

    def peer_work(self) -> PeerWork:
        """Refuses: convergence to a method's own limit means nothing across engines.

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


def path_of(motion: Motion, speed: float = 1.0) -> Path:
    """Returns a motion as the path of a stage, played faster by a factor >= 1."""

    def path(
        times: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        positions, quaternions = np.zeros((times.size, 3)), np.zeros((times.size, 4))
        cursor = 0
        for k, time in enumerate(times):
            start = cursor if k and time >= times[k - 1] else 0
            cursor, positions[k], quaternions[k] = pose_at(motion.table, speed * time, start)
        return positions, quaternions

    return path


def _first_contact(stage: Stage) -> float | None:
    """Returns when the tool first touches in s, None for never.

    Contacts that are there from the start are no event: the first tick with more of them is.
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
