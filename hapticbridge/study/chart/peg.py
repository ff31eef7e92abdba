"""Workload ``peg_in_hole``: a peg without friction, pushed against its hole in several ways."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from hapticbridge.coupling import Coupling
from hapticbridge.record import TICK_DTYPE
from hapticbridge.scene import Scene, load_scene
from hapticbridge.study.chart.engine_run import PeerWork, work_of
from hapticbridge.study.chart.own_reference import REFINEMENT, OwnReferences
from hapticbridge.study.chart.peg_path import DURATION, JUDGED, POSES, end_of_hold, peg_path
from hapticbridge.study.chart.rigid_peg import resting_peg
from hapticbridge.study.chart.scene_run import Stage, Stages, Take
from hapticbridge.study.chart.score import Score, diverged, score_of
from hapticbridge.study.chart.staged import Staged
from hapticbridge.study.chart.workload import Panel

SETTLED = Panel(
    "settled",
    "a peg at rest, pushed against its hole",
    "pose of least energy of a rigid peg in a rigid hole, by SciPy's SLSQP, in three pushes",
)
MOVING = Panel(
    "moving",
    "the same peg while it goes in and meets the wall",
    f"the same method at a step {REFINEMENT} times smaller than the smallest: convergence, "
    "not truth",
    is_truth=False,
)

COUPLING = Coupling(1000.0, 3.0, 1.0, 2e-3)
"""As the other workloads', with three times the damping, so that the peg is at rest at the end of
each hold. Where it rests does not depend on it."""

MOVING_TIME = 0.9
"""In s: into the hole, and 0.1 s into the hold against the wall."""


def _scene() -> Scene:
    return load_scene("peg_in_hole", friction=0.0)


class PegInHole(Staged):
    """The workload.

    Args:
        coupling: K and B, K > 0 and K_r > 0.
        grid: Longest period T in s.
        finest: Shortest period T in s.
        refinement: How many times smaller the step of the moving peg's reference is.

    Raises:
        StudyError: The coupling holds no peg.
    """

    name = "peg_in_hole"
    about = "a frictionless peg goes into its hole and is pushed against walls, edges and bottom"
    panels: Sequence[Panel] = (SETTLED, MOVING)
    has_contact = True

    def __init__(
        self, coupling: Coupling, grid: float, finest: float, refinement: int = REFINEMENT
    ) -> None:
        resting = [resting_peg(coupling, *POSES[index]) for index in JUDGED]
        self._reference = np.zeros(len(JUDGED), TICK_DTYPE)
        self._reference["tool_position"] = [each.position for each in resting]
        turned = Rotation.from_rotvec([each.rotation for each in resting])
        self._reference["tool_quaternion"] = turned.as_quat(canonical=True)[:, [3, 0, 1, 2]]
        self._reference["wrench_on_tool"] = [each.wrench for each in resting]
        self._finest = finest
        self._duration = grid * round(DURATION / grid)
        stages = Stages(lambda: Stage(_scene(), peg_path, self._duration, coupling))
        self._limits = OwnReferences(stages, grid, finest, MOVING_TIME, refinement)
        super().__init__(coupling, stages, self._limits)

    def peer_work(self) -> PeerWork:
        """Describes the peg to other engines."""
        return work_of(_scene(), peg_path, self._duration, self._finest, self.coupling, self._judge)

    def _judge(self, takes: Sequence[Take]) -> Mapping[str, Score]:
        (take,) = takes
        return {SETTLED.key: self.settled(take), MOVING.key: self._limits.score(take)}

    def settled(self, take: Take) -> Score:
        """Compares where the peg rests at the end of each hold with the rigid optimum."""
        if take.has_diverged:
            return diverged(take.created, take.ended)
        ends = [round(end_of_hold(index) / take.setting.period) - 1 for index in JUDGED]
        records = take.records[np.minimum(ends, take.records.size - 1)]
        force, exact = (
            np.linalg.norm(each["wrench_on_tool"][:, :3], axis=1)
            for each in (records, self._reference)
        )
        is_touching = bool(np.all(records["contacts"] > 0))
        return score_of(
            self._reference,
            records,
            stiffness=float(np.max(np.abs(force / exact - 1))),
            created=take.created,
            verdict=take.environment if is_touching else "lost contact",
        )
