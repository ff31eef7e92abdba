"""Workload ``peg_in_hole``, a peg pushed against its hole, and the same peg jammed by a hand."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import nnls
from scipy.spatial.transform import Rotation

from hapticbridge.check.perception import WEBER
from hapticbridge.coupling import Coupling
from hapticbridge.demand.pulse import FORCE_FLOOR
from hapticbridge.device import Motion
from hapticbridge.device.motion_file import read_motion
from hapticbridge.errors import StudyError
from hapticbridge.kernel.record import TICK_DTYPE
from hapticbridge.lab.chart.engine_run import EngineRun, work_of
from hapticbridge.lab.chart.scene_run import (
    REFERENCE_REFINEMENT,
    OwnReferences,
    Prepared,
    Stages,
    Workload,
    path_of,
)
from hapticbridge.lab.chart.score import (
    Judge,
    Panel,
    PeerWork,
    Score,
    Take,
    diverged,
    score_of,
)
from hapticbridge.lab.chart.setting import OWN, Setting
from hapticbridge.lab.engines.base import open_engine
from hapticbridge.lab.maps.contact_rigs import ROTATION
from hapticbridge.scene import Scene, load_scene, scene_path

HOME = np.array([0.0, 0.0, 0.04])
"""Start of the peg's centre in m, 10 mm above the mouth."""

POSES: tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...] = (
    ((0.0, 0.0, 0.012), (0.0, 0.0, 0.0)),
    ((2e-3, 0.5e-3, 0.012), (0.0, 0.0, 0.02)),
    ((-1e-3, 1.5e-3, 0.010), (0.03, 0.06, 0.0)),
    ((0.5e-3, 0.0, -0.012), (0.0, -0.05, 0.0)),
)
"""Poses of the handle, in m and as a rotation vector in rad: in, against a wall, tilted against two
edges, onto the bottom. The last three are judged."""

RAMP, STAY = 0.2, 0.4
"""Times in s of a ramp and of a hold. The minimum-jerk ramp leaves little ringing. After the hold,
with the damping of the chart, e⁻⁶ of it is left."""

DURATION = len(POSES) * (RAMP + STAY)

JUDGED = tuple(range(1, len(POSES)))


def peg_path(times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns positions and quaternions of the handle relative to ``HOME``."""
    stops = [(*HOME, 0.0, 0.0, 0.0), *((*place, *turn) for place, turn in POSES)]
    return led(np.array(stops), times)


def led(
    stops: NDArray[np.float64], times: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Leads a handle from pose to pose; returns its places from the first, and quaternions.

    Args:
        stops: Positions in m and rotation vectors in rad, shape (n, 6). The first is the start.
        times: Times in s.
    """
    stage = np.minimum((times / (RAMP + STAY)).astype(int), len(stops) - 2)
    share = np.clip((times - stage * (RAMP + STAY)) / RAMP, 0.0, 1.0)
    smooth = share**3 * (10 - 15 * share + 6 * share**2)
    poses = stops[stage] + smooth[:, None] * (stops[stage + 1] - stops[stage])
    turns = Rotation.from_rotvec(poses[:, 3:]).as_quat(canonical=True)[:, [3, 0, 1, 2]]
    return poses[:, :3] - stops[0, :3], turns


def end_of_pose(index: int) -> float:
    """Returns the time in s at which the handle leaves a pose."""
    return (index + 1) * (RAMP + STAY)


HALF_WIDTH, HALF_LENGTH = 0.01, 0.03
"""Half edges in m of the peg of ``models/peg_in_hole``."""

CLEARANCE, DEPTH = 0.2e-3, 0.04
"""Gap per side with the peg in the middle, and depth of the hole, in m."""

LOWEST = HALF_LENGTH - DEPTH + 1e-3
"""Lowest place in m of the centre at which the search begins, 1 mm above the bottom."""

PROBE, CONVERGED = 1e-6, 1e-11
"""Steps in √J of the search: that by which it finds slopes, and the largest at its end. At 1 kN/m
and 1 N m/rad they are 30 nm and 1 µrad, and 0.3 pm and 10 prad."""

MAX_LINEAR = 300
"""Largest number of linear steps of the search. A peg at two edges takes 150, in a corner 5."""

ROUNDING = 1e-12
"""Depth in m, and distance without unit, that count as none."""

_SIGNS = np.array([(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)])


@dataclass(frozen=True, slots=True, eq=False)
class RestingPeg:
    """A peg at rest.

    Attributes:
        position: Position of its centre in m, with the hole's mouth at z = 0, shape (3,).
        rotation: Rotation vector in rad, shape (3,).
        wrench: Wrench of the coupling on the peg, force in N and torque in N m, shape (6,).
        gaps: Remaining distances in m to the walls, all >= 0 but for rounding.
    """

    position: NDArray[np.float64]
    rotation: NDArray[np.float64]
    wrench: NDArray[np.float64]
    gaps: NDArray[np.float64]


def gaps(
    position: NDArray[np.float64], rotation: NDArray[np.float64], clearance: float = CLEARANCE
) -> NDArray[np.float64]:
    """Returns a peg's distance from each wall and the bottom in m; < 0 inside a wall.

    The part of the peg below the mouth is a convex body. Its extreme points are the four lower
    corners, and the points where the long edges pass the plane of the mouth. Valid while exactly
    those four edges pass it: an inserted peg that is not turned by more than some 30 degrees.

    Args:
        position: Position of the centre in m, shape (3,).
        rotation: Rotation vector, shape (3,).
        clearance: Gap per side in m.

    Returns:
        Shape (36,): eight points by four walls, then the corners above the bottom.
    """
    axes = Rotation.from_rotvec(rotation).as_matrix()
    across = HALF_WIDTH * _SIGNS @ axes[:, :2].T
    lower = position + across - HALF_LENGTH * axes[:, 2]
    upper = position + across + HALF_LENGTH * axes[:, 2]
    share = lower[:, 2:] / (lower[:, 2:] - upper[:, 2:])
    points = np.vstack([lower, lower + share * (upper - lower)])[:, :2]
    wall = HALF_WIDTH + clearance
    return np.concatenate([(wall - points).ravel(), (wall + points).ravel(), lower[:, 2] + DEPTH])


def resting_peg(
    coupling: Coupling,
    position: ArrayLike,
    rotation: ArrayLike = (0.0, 0.0, 0.0),
    clearance: float = CLEARANCE,
) -> RestingPeg:
    """Finds the pose of a rigid peg that a coupling pulls towards a handle at rest.

        minimise  ½ K ‖h − p‖² + ½ K_r ‖log(R_h Rᵀ)‖²    subject to  gaps(p, R) >= 0

    Without friction any mechanics that loses energy ends in this pose. In the coupling's own
    stretch the energy is half of a squared length. Each step therefore finds the shortest stretch
    that satisfies the gaps, linear at the step before.

    Args:
        coupling: K and K_r, both > 0; the dampings have no effect.
        position: Position h of the handle in m.
        rotation: Rotation vector of the handle in rad.
        clearance: Gap per side in m.

    Raises:
        StudyError: The optimiser found no minimum, or a stiffness is not > 0.
    """
    if not (coupling.stiffness > 0 and coupling.rotational_stiffness > 0):
        raise StudyError("the coupling must hold the peg's place and turning: K > 0 and K_r > 0")
    handle, turn = np.asarray(position, float), Rotation.from_rotvec(np.asarray(rotation, float))
    roots = np.sqrt(np.repeat([coupling.stiffness, coupling.rotational_stiffness], 3))

    def pose(stretch: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        way = stretch / roots
        return handle + way[:3], (Rotation.from_rotvec(way[3:]) * turn).as_rotvec()

    def millimetres(stretch: NDArray[np.float64]) -> NDArray[np.float64]:
        return 1e3 * gaps(*pose(stretch), clearance)

    stretch = np.zeros(6)
    stretch[:3] = roots[:3] * (np.array([0.0, 0.0, max(handle[2], LOWEST)]) - handle)
    stretch[3:] = roots[3:] * turn.inv().as_rotvec()
    for _ in range(MAX_LINEAR):
        slopes = np.stack(
            [millimetres(stretch + d) - millimetres(stretch - d) for d in PROBE * np.eye(6)], axis=1
        ) / (2.0 * PROBE)
        needed = slopes @ stretch - millimetres(stretch)
        before, stretch = stretch, shortest(slopes, needed)
        if np.abs(stretch - before).max() < CONVERGED:
            break
    else:
        raise StudyError(f"no resting pose of the peg was found in {MAX_LINEAR} steps")
    place, rotated = pose(stretch)
    left = gaps(place, rotated, clearance)
    if left.min() < -ROUNDING:
        raise StudyError(f"no resting pose of the peg was found: it is {-left.min():.1g} m deep")
    return RestingPeg(place, rotated, -roots * stretch, left)


def shortest(slopes: NDArray[np.float64], needed: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the shortest x with A x >= b, exact but for rounding.

    Lawson & Hanson (1974), "Solving Least Squares Problems", chapter 23: least distance
    programming by non-negative least squares.

    Args:
        slopes: A, shape (m, n).
        needed: b, shape (m,).

    Raises:
        StudyError: No x satisfies all rows.
    """
    rows = np.vstack([slopes.T, needed])
    goal = np.zeros(len(rows))
    goal[-1] = 1.0
    weights, distance = nnls(rows, goal)
    if distance < ROUNDING:
        raise StudyError("no resting pose of the peg was found: the walls leave it no place")
    residual = rows @ weights - goal
    return np.asarray(-residual[:-1] / residual[-1])


SETTLED = Panel(
    "settled",
    "a peg at rest, pushed against its hole",
    "pose of least energy of a rigid peg in a rigid hole, by linear steps, in three pushes",
)
MOVING = Panel(
    "moving",
    "the same peg while it goes in and meets the wall",
    f"the same method at a step {REFERENCE_REFINEMENT} times smaller than the smallest: "
    "convergence, not truth",
    is_truth=False,
)

COUPLING = Coupling(1000.0, 3.0, 1.0, 2e-3)
"""Default coupling: that of the other workloads with three times the damping, so that the peg is at
rest at the end of each hold. Its resting place does not depend on it."""

MOVING_TIME = 0.9
"""Duration in s of the judged motion: into the hole, and 0.1 s into the hold against the wall."""


def _scene() -> Scene:
    return load_scene("peg_in_hole", friction=0.0)


class PegInHole(Workload):
    """The peg in its hole as a workload.

    Args:
        coupling: K and B, K > 0 and K_r > 0.
        grid: Longest period T in s.
        finest: Shortest period T in s.
        refinement: Ratio of ``finest`` to the step of the moving peg's reference.

    Raises:
        StudyError: The coupling holds no peg.
    """

    name = "peg_in_hole"
    about = "a frictionless peg goes into its hole and is pushed against walls, edges and bottom"
    panels: Sequence[Panel] = (SETTLED, MOVING)
    has_contact = True

    def __init__(
        self, coupling: Coupling, grid: float, finest: float, refinement: int = REFERENCE_REFINEMENT
    ) -> None:
        resting = [resting_peg(coupling, *POSES[index]) for index in JUDGED]
        self._reference = np.zeros(len(JUDGED), TICK_DTYPE)
        self._reference["tool_position"] = [each.position for each in resting]
        turned = Rotation.from_rotvec([each.rotation for each in resting])
        self._reference["tool_quaternion"] = turned.as_quat(canonical=True)[:, [3, 0, 1, 2]]
        self._reference["wrench_on_tool"] = [each.wrench for each in resting]
        self._finest = finest
        self._duration = grid * round(DURATION / grid)
        stages = Stages(lambda: Prepared(_scene(), peg_path, self._duration, coupling))
        self._limits = OwnReferences(stages, grid, finest, MOVING_TIME, refinement)
        super().__init__(coupling, stages, self._limits)

    def peer_work(self) -> PeerWork:
        """Describes the peg to other engines."""
        return work_of(_scene(), peg_path, self._duration, self._finest, self.coupling, self._judge)

    def _judge(self, takes: Sequence[Take]) -> Mapping[str, Score]:
        (take,) = takes
        return {SETTLED.key: self.settled(take), MOVING.key: self._limits.score(take)}

    def settled(self, take: Take) -> Score:
        """Compares the peg's pose at the end of each hold with the rigid optimum."""
        return score_at_rest(self._reference, JUDGED, take)


def score_at_rest(reference: NDArray[np.void], holds: Sequence[int], take: Take) -> Score:
    """Compares a take at the end of its holds with poses at rest under a force.

    Args:
        reference: ``TICK_DTYPE``, one row per judged hold.
        holds: Numbers of the judged holds.
        take: The run.
    """
    if take.has_diverged:
        return diverged(take.created, take.ended)
    ends = [round(end_of_pose(index) / take.setting.period) - 1 for index in holds]
    records = take.records[np.minimum(ends, take.records.size - 1)]
    force, exact = (
        np.linalg.norm(each["wrench_on_tool"][:, :3], axis=1) for each in (records, reference)
    )
    is_touching = bool(np.all(records["contacts"] > 0))
    return score_of(
        reference,
        records,
        stiffness=float(np.max(np.abs(force / exact - 1))),
        created=take.created,
        verdict=take.environment if is_touching else "lost contact",
    )


JAM_DAMPING = 0.5
"""Damping B in N s/m; low, so that the coupling hides little of the created energy."""

JAM_START = 0.005
"""Height of the peg's centre at the start in m: 25 mm of the 60 mm peg stand in the hole."""

RECORDED = (3.5, 6.0)
"""Part of the recorded hand in s: into the hole, to the bottom, and pressing to the sides."""


def jamming_path(hand: int) -> Motion:
    """Returns the path of a hand in the hole: 0 is the recorded one, others are seeds.

    A random hand moves by up to 8 mm and 0.15 rad, at 0.5 to 3 Hz, for 2 s.
    """
    if hand == 0:
        table = read_motion(scene_path("peg_in_hole").with_suffix(".csv")).table
        rows = table[(table[:, 0] >= RECORDED[0]) & (table[:, 0] <= RECORDED[1])]
        return Motion(rows[:, 0], rows[:, 1:4], rows[:, 4:]).relative()
    random, time = np.random.default_rng(hand), np.linspace(0.0, 2.0, 81)

    def smooth(size: float) -> NDArray[np.float64]:
        frequency, phase = random.uniform(0.5, 3.0, 5), random.uniform(0, 2 * np.pi, 5)
        angle = 2 * np.pi * frequency[:, None] * time + phase[:, None]
        waves = random.normal(size=5) @ (np.sin(angle) - np.sin(phase)[:, None])
        return np.asarray(size * waves / np.abs(waves).max())

    place = np.column_stack([smooth(8e-3) for _ in range(3)])
    turn = Rotation.from_rotvec(np.column_stack([smooth(0.15), smooth(0.15), smooth(0.1)]))
    return Motion(time, place, turn.as_quat(canonical=True, scalar_first=True))


@dataclass(frozen=True, slots=True)
class JammedPeg:
    """A peg that a hand jams in its hole, for the bridge and for other engines.

    The handle follows a prescribed path, so that every engine is led alike. The coupling pulls with
    up to 50 N.

    Attributes:
        mass: Mass of the peg in kg.
        friction: Coulomb's coefficient, without unit.
        stiffness: K in N/m; the rotation's gains are those of the map ``contact``.
        hand: 0 for the recorded hand, otherwise the seed of a random one.
    """

    mass: float
    friction: float
    stiffness: float
    hand: int

    @property
    def motion(self) -> Motion:
        """Path of the handle."""
        return jamming_path(self.hand)

    @property
    def coupling(self) -> Coupling:
        """K and B; the rotation's gains are those of the map ``contact``."""
        return Coupling(self.stiffness, JAM_DAMPING, ROTATION[0] * self.stiffness, ROTATION[1])

    def scene(self) -> Scene:
        """Loads the peg, 25 mm of it in its hole."""
        scene = load_scene("peg_in_hole", mass=self.mass, friction=self.friction)
        scene.model.key_qpos[0, 2] = JAM_START
        return scene

    def work(self, duration: float, finest: float, judge: Judge) -> PeerWork:
        """Describes the peg to other engines."""
        path = path_of(self.motion)
        return work_of(self.scene(), path, duration, finest, self.coupling, judge)

    def take(self, setting: Setting) -> Take:
        """Runs the bridge or another engine with a meter of its energy.

        Raises:
            HapticBridgeError: The method cannot render the scene, or the engine is not installed.
        """
        duration = round(self.motion.duration / setting.period) * setting.period
        if setting.engine != OWN:
            work = self.work(duration, setting.period, lambda _: {})
            return EngineRun(open_engine(setting.engine), work, setting).takes()[0][0]
        takes: list[Take] = []
        stage = Prepared(self.scene(), path_of(self.motion), duration, self.coupling)
        stage.play(setting, lambda take: takes.append(replace(take, records=take.records.copy())))
        return takes[0]


JAM = JammedPeg(0.1, 0.42, 1000.0, 0)
"""Jammed peg of the chart: that of ``models/peg_in_hole`` in the recorded hand."""

LEFT = 0.05
"""Distance in m of the peg's centre from the hole's at which it has left the hole."""

JAM_PANEL = Panel(
    "jamming",
    "the peg jammed by a recorded hand, with friction",
    "a rigid peg by exact geometry: K times the depth to which it is inside the walls, beside the "
    "force's threshold",
)


class Jam(Workload):
    """The jammed peg as a workload.

    A jam with friction has no motion that is true for every mechanics, but no rigid peg is inside a
    wall. Depth d takes K d from the force, which is the error.

    Args:
        grid: Longest period T in s.
    """

    name = "jam"
    about = "a peg with friction is jammed in its hole by a recorded hand"
    panels: Sequence[Panel] = (JAM_PANEL,)
    needs_tool = "jams no tool behind a coupling"
    has_contact = True

    def __init__(self, grid: float) -> None:
        self._grid = grid
        self._duration = grid * math.floor(JAM.motion.duration / grid)
        super().__init__(
            JAM.coupling,
            Stages(
                lambda: Prepared(JAM.scene(), path_of(JAM.motion), self._duration, JAM.coupling)
            ),
        )

    def peer_work(self) -> PeerWork:
        """Describes the peg to other engines."""
        return JAM.work(self._duration, self._grid, self._judge)

    def _judge(self, takes: Sequence[Take]) -> Mapping[str, Score]:
        (take,) = takes
        if take.has_diverged:
            return {JAM_PANEL.key: diverged(take.created, take.ended)}
        records = take.records_at(self._grid)
        has_left = bool(np.abs(records["tool_position"]).max() > LEFT)
        depth = np.zeros(1) if has_left else penetrations(records)
        force = np.linalg.norm(records["wrench_on_tool"][:, :3], axis=1)
        threshold = max(WEBER * float(np.sqrt(np.mean(force**2))), FORCE_FLOOR)
        missing = self.coupling.stiffness * float(np.sqrt(np.mean(depth**2)))
        score = Score(
            jnd=math.inf if has_left else missing / threshold,
            force_rms=missing,
            position_peak=float(depth.max()),
            created=take.created,
            verdict="lost contact" if has_left else take.environment,
        )
        return {JAM_PANEL.key: score}


def penetrations(records: NDArray[np.void]) -> NDArray[np.float64]:
    """Returns the deepest penetration of peg and hole at each tick in m, by ``gaps``, 0 without.

    No engine's own contacts enter. The peg must be in its hole (``gaps``).
    """
    turns = Rotation.from_quat(records["tool_quaternion"], scalar_first=True).as_rotvec()
    places = records["tool_position"]
    depths = [-gaps(place, turn).min() for place, turn in zip(places, turns, strict=True)]
    return np.maximum(depths, 0.0)
