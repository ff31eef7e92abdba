"""Workloads with a contact whose motion is known: a sliding block, a falling rod, a tap."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq

from hapticbridge.check.perception import WEBER
from hapticbridge.coupling import Coupling
from hapticbridge.device import Motion
from hapticbridge.errors import StudyError
from hapticbridge.kernel.pose import quaternion_exp
from hapticbridge.kernel.record import TICK_DTYPE
from hapticbridge.lab.chart.engine_run import motion_along
from hapticbridge.lab.chart.free_bodies import still
from hapticbridge.lab.chart.scene_run import Prepared, Stages, Workload
from hapticbridge.lab.chart.score import (
    Panel,
    PeerWork,
    Score,
    Take,
    Verdict,
    diverged,
    score_of,
)
from hapticbridge.lab.engines.base import Body, Pose, Shape, Task, Velocity
from hapticbridge.lab.maps.base import scene_of
from hapticbridge.scene import Scene, load_scene
from hapticbridge.theory.impact import Impact, ImpactBody, resolve_impact

BLOCK_MASS = 0.2
"""Mass in kg."""
BLOCK_FRICTION = 0.5
"""Friction coefficient of block and floor; the block breaks away at 0.98 N."""
GRAVITY = 9.81
"""Gravity in m/s²."""
SPEED = 0.02
"""Speed of the handle along the floor in m/s, after a start from rest within ``EASE``."""
EASE = 0.02
"""Time in s over which the handle's speed rises evenly, while the block sticks."""
BLOCK_DURATION = 0.5
"""Duration in s. The block breaks away after some 0.06 s, and then swings about the handle's
speed."""

BLOCK_COUPLING = Coupling(1000.0, 1.0, 1.0, 1e-3)
"""Default coupling, that of the other workloads; the block does not turn."""

BLOCK_PANEL = Panel(
    "sliding",
    "a block that is pulled: it sticks, breaks away and slides",
    "closed form with Coulomb's friction: stuck until K e + B e' = μ m g, then a driven "
    "oscillator with a constant force",
)

WIDTH, BLOCK_HEIGHT = 0.02, 0.01
"""Half edges in m, along the floor and upwards, of the free box for other engines."""

TOUCHING = 0.25
"""Share of the ticks in which the block must touch the floor. It is below 1, because MuJoCo's
friction lifts a sliding body by some T μ v (10 µm at 1 ms), and contacts come and go."""

_BLOCK = f"""
<mujoco model="sliding_block">
  <option gravity="0 0 {-GRAVITY!r}" cone="elliptic" impratio="10">
    <flag diagexact="enable"/>
  </option>
  <default>
    <geom solref="0.002 1" solimp="0.9 0.95 0.001 0.5 2"
      friction="{BLOCK_FRICTION!r} 0 0" condim="3"/>
  </default>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 1"/>
    <body name="block" pos="0 0 0.01">
      <joint type="slide" axis="1 0 0"/>
      <joint type="slide" axis="0 0 1"/>
      <inertial pos="0 0 0" mass="{BLOCK_MASS!r}" diaginertia="1e-4 1e-4 1e-4"/>
      <geom name="block" type="sphere" size="0.01" mass="0"/>
      <site name="grip"/>
    </body>
  </worldbody>
</mujoco>"""


def handle_place(times: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the position of the handle along the floor in m."""
    eased = np.minimum(times, EASE)
    return SPEED * (eased**2 / (2 * EASE) + np.maximum(times - EASE, 0.0))


def pulled(times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the path of the handle."""
    positions, quaternions = np.zeros((times.size, 3)), np.zeros((times.size, 4))
    positions[:, 0], quaternions[:, 0] = handle_place(times), 1.0
    return positions, quaternions


def free_block(coupling: Coupling, path: Motion) -> Task:
    """Returns the block as a box that is free in space, for other engines.

    It is held and pulled at its centre. Friction acts HEIGHT below it, a torque of μ m g HEIGHT
    that the weight on a base of half a side WIDTH bears: the box slides as it does on rails, and
    does not tip while μ HEIGHT < WIDTH.

    Args:
        coupling: K and B.
        path: Path of the handle relative to its first pose.
    """
    box = Shape("box", (WIDTH, WIDTH, BLOCK_HEIGHT))
    across = BLOCK_MASS * (WIDTH**2 + BLOCK_HEIGHT**2) / 3
    body = Body(
        BLOCK_MASS,
        (across, across, BLOCK_MASS * 2 * WIDTH**2 / 3),
        shapes=(box,),
        friction=BLOCK_FRICTION,
    )
    centre = (0.0, 0.0, BLOCK_HEIGHT)
    places = path.table[:, 1:4] + np.array(centre)
    return Task(
        "sliding_block",
        body,
        (Shape("box", (1.0, 1.0, 0.1), (0.0, 0.0, -0.1)),),
        (0.0, 0.0, -GRAVITY),
        coupling,
        start=Pose(centre),
        handle=Motion(path.table[:, 0], places, path.table[:, 4:]),
    )


def breakaway(coupling: Coupling) -> float:
    """Returns the time in s of the breakaway: K h + B V = μ m g, with h = V (t − EASE/2).

    Raises:
        StudyError: The block breaks away while the handle still accelerates, or not in time.
    """
    limit = BLOCK_FRICTION * BLOCK_MASS * GRAVITY
    time = (limit - coupling.damping * SPEED) / (coupling.stiffness * SPEED) + EASE / 2
    if not EASE < time < BLOCK_DURATION:
        raise StudyError(
            f"with K = {coupling.stiffness:g} N/m and B = {coupling.damping:g} N s/m the block "
            f"breaks away at {time:.3g} s; the closed form wants {EASE:g} to {BLOCK_DURATION:g} s"
        )
    return time


def exact_sliding(
    coupling: Coupling, times: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the block's position in m and the force of the coupling in N at times in s.

    After the breakaway at t_0 the stretch e = h − x obeys m e'' + B e' + K e = μ m g from
    e(t_0) = h(t_0), e'(t_0) = V. It slides on as long as e' < V, which is checked.

    Raises:
        StudyError: The block would stick again, or breaks away out of range.
    """
    start, k, b = breakaway(coupling), coupling.stiffness, coupling.damping
    limit = BLOCK_FRICTION * BLOCK_MASS * GRAVITY
    dynamics = np.array([[0.0, 1.0], [-k / BLOCK_MASS, -b / BLOCK_MASS]])
    begin = np.array([float(handle_place(np.array([start]))[0]) - limit / k, SPEED])
    stretch = handle_place(times)
    rate = np.where(times < EASE, SPEED * times / EASE, SPEED)
    for i in np.flatnonzero(times > start):
        state = np.asarray(expm((times[i] - start) * dynamics)) @ begin
        stretch[i], rate[i] = state[0] + limit / k, state[1]
        if rate[i] > SPEED * (1 + 1e-9):
            raise StudyError("the block would stick again: the closed form is that of one slide")
    return handle_place(times) - stretch, k * stretch + b * rate


class SlidingBlock(Workload):
    """The sliding block as a workload.

    Args:
        coupling: K and B.
        grid: Longest period T in s.
        finest: Shortest in s.

    Raises:
        StudyError: The closed form does not hold for the coupling.
    """

    name = "sliding_block"
    about = "a block on the floor is pulled at a constant speed: stick, breakaway, slide"
    panels: Sequence[Panel] = (BLOCK_PANEL,)
    needs_tool = "pulls by no spring of known stiffness"
    has_contact = True

    def __init__(self, coupling: Coupling, grid: float, finest: float) -> None:
        self._grid = grid
        self._finest = finest
        count = round(BLOCK_DURATION / grid)
        place, force = exact_sliding(coupling, grid * np.arange(1.0, count + 1))
        self._reference = np.zeros(count, TICK_DTYPE)
        self._reference["tool_quaternion"][:, 0] = 1.0
        self._reference["wrench_on_tool"][:, 0] = force
        self._place = place
        super().__init__(
            coupling, Stages(lambda: Prepared(block_scene(), pulled, grid * count, coupling))
        )

    def peer_work(self) -> PeerWork:
        """Describes the block to other engines: a free box, which the coupling keeps upright."""
        duration = self._grid * self._place.size
        task = free_block(self.coupling, motion_along(pulled, duration, self._finest))
        return PeerWork((task,), duration, self._judge)

    def _judge(self, takes: Sequence[Take]) -> Mapping[str, Score]:
        (take,) = takes
        if take.has_diverged:
            return {BLOCK_PANEL.key: diverged(take.created, take.ended)}
        records = take.records_at(self._grid).copy()
        # the weight rests on a compliant contact, and the handle carries a share of it, so only the
        # motion along the floor is judged
        records["wrench_on_tool"][:, 1:] = 0.0
        self._reference["tool_position"][:] = records["tool_position"]
        self._reference["tool_position"][:, 0] = self._place
        is_touching = bool(np.mean(records["contacts"] > 0) > TOUCHING)
        return {
            BLOCK_PANEL.key: score_of(
                self._reference,
                records,
                created=take.created,
                verdict=take.environment if is_touching else "lost contact",
            )
        }


def block_scene() -> Scene:
    """Returns block and floor as a scene."""
    return scene_of(_BLOCK)


ROD_MASS, LENGTH = 0.1, 0.2
"""Mass in kg and length in m of a uniform rod: a light tool."""
INERTIA = ROD_MASS * LENGTH**2 / 12
"""Moment of inertia about its centre of mass in kg m²."""
THIN = 1e-6
"""Moment of inertia about its axis in kg m²: a rod 9 mm thick. No torque acts about that axis."""
TIP = 1e-3
"""Radius in m of the sphere at the lower end, the only part that can touch."""

APPROACH, SLIDE = 0.3, 0.2
"""Speed in m/s at which the rod falls and slides, without turning; a brisk tap."""

ROD_FRICTION = 0.3
"""Coulomb's μ, without unit."""

ANGLES = (0.5, 0.8, 1.1, 1.4)
"""Angles of the rod above the floor in rad, one per fall."""

ROD_HEIGHT = 0.6e-3
"""Height of the tip above the floor at the start, in m: 2 ms of falling."""

ROD_DURATION = 0.024
"""Duration in s of each fall. A contact as soft as those of the shipped scenes ends within 20 ms.
In that time the rod turns by 3 degrees at most; a rigid impact takes no time."""

ROD_COUPLING = Coupling(1e-9, 0.0, 0.0, 0.0)
"""Negligible coupling: the rod falls alone. A stiffness is required, and 1e-9 N/m over 10 mm is no
force."""

ROD_PANEL = Panel(
    "impact",
    "a rod that taps the floor at four angles",
    "impulse of a rigid impact without rebound by Routh's path (mechanics.resolve_impact, e = 0, "
    "where the laws of Newton, Poisson and Stronge agree)",
)

_ROD = f"""
<mujoco model="rod_impact">
  <option gravity="0 0 0" cone="elliptic"><flag diagexact="enable"/></option>
  <default>
    <geom solref="0.002 1" solimp="0.9 0.95 0.001 0.5 2"
      friction="{ROD_FRICTION!r} 0 0" condim="3"/>
  </default>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 1"/>
    <body name="rod" pos="0 0 1">
      <joint type="slide" axis="1 0 0"/>
      <joint type="slide" axis="0 0 1"/>
      <joint type="hinge" axis="0 1 0"/>
      <inertial pos="0 0 0" mass="{ROD_MASS!r}" diaginertia="{THIN!r} {INERTIA!r} {INERTIA!r}"/>
      <geom name="tip" type="sphere" size="{TIP!r}" pos="{-LENGTH / 2!r} 0 0" mass="0"/>
      <site name="grip"/>
    </body>
  </worldbody>
</mujoco>"""


def rod_scene() -> Scene:
    """Returns rod and floor as a scene, the rod far above."""
    return scene_of(_ROD)


def falls_at(angle: float) -> Callable[[Scene], None]:
    """Returns the function that puts the rod just above the floor, falling and sliding."""

    def put(scene: Scene) -> None:
        data = scene.data
        data.qpos[:3] = 0.0, LENGTH / 2 * np.sin(angle) + TIP + ROD_HEIGHT - 1.0, -angle
        data.qvel[:3] = SLIDE, -APPROACH, 0.0
        mujoco.mj_forward(scene.model, data)

    return put


def free_fall(angle: float) -> Task:
    """Returns the fall of a rod that is free in space, for other engines.

    The floor's surface is at z = 0. Only the tip's sphere can touch. It touches in the plane of
    motion, so that no impulse turns the rod out of it.
    """
    tip = Shape("sphere", (TIP,), (-LENGTH / 2, 0.0, 0.0))
    rod = Body(ROD_MASS, (THIN, INERTIA, INERTIA), shapes=(tip,), friction=ROD_FRICTION)
    height = LENGTH / 2 * math.sin(angle) + TIP + ROD_HEIGHT
    return Task(
        "rod_impact",
        rod,
        (Shape("box", (1.0, 1.0, 0.1), (0.0, 0.0, -0.1)),),
        start=Pose((0.0, 0.0, height), quaternion_exp((0.0, -angle, 0.0))),
        start_velocity=Velocity((SLIDE, 0.0, -APPROACH)),
    )


def _in_the_plane(take: Take) -> Take:
    """Returns a take with the planar velocities alone: along x, along z, about y."""
    return replace(take, velocity=take.velocity[[0, 2, 4]])


def rigid_impacts() -> Impact:
    """Returns the rigid impacts of the four falls without rebound, by mechanics."""
    angle = np.array(ANGLES)
    arm = np.stack([-LENGTH / 2 * np.cos(angle), -LENGTH / 2 * np.sin(angle) - TIP], axis=-1)
    rod = ImpactBody(np.full(angle.size, ROD_MASS), np.full(angle.size, INERTIA), arm)
    return resolve_impact(rod, [SLIDE, -APPROACH], ROD_FRICTION, 0.0)


class RodImpact(Workload):
    """The falling rod as a workload.

    Args:
        coupling: Only its name appears in tables; no coupling acts.
        grid: Longest period T in s; the falls last a multiple of it.
    """

    name = "rod_impact"
    about = "a rod taps the floor at four angles, with friction"
    panels: Sequence[Panel] = (ROD_PANEL,)
    needs_tool = "lets no tool fall by itself"
    has_contact = True

    def __init__(self, coupling: Coupling, grid: float) -> None:
        self._rigid = rigid_impacts()
        self._duration = duration = grid * max(1, round(ROD_DURATION / grid))
        starts = [falls_at(angle) for angle in ANGLES]
        super().__init__(
            coupling,
            Stages(lambda: Prepared(rod_scene(), still, duration, coupling, starts=starts)),
        )

    def peer_work(self) -> PeerWork:
        """Describes the falls to other engines, with a free rod that stays in its plane."""
        return PeerWork(
            tuple(free_fall(angle) for angle in ANGLES),
            self._duration,
            lambda takes: self._judge([_in_the_plane(take) for take in takes]),
        )

    def _judge(self, takes: Sequence[Take]) -> Mapping[str, Score]:
        created = max(take.created for take in takes)
        if ended := next((take.ended for take in takes if take.has_diverged), ""):
            return {ROD_PANEL.key: diverged(created, ended)}
        velocities = np.array([take.velocity[:3] for take in takes])
        impulses = ROD_MASS * (velocities[:, :2] - (SLIDE, -APPROACH))
        error = np.linalg.norm(impulses - self._rigid.impulse, axis=1)
        exact = np.linalg.norm(self._rigid.impulse, axis=1)
        kinetic = 0.5 * (
            ROD_MASS * np.sum(velocities[:, :2] ** 2, axis=1) + INERTIA * velocities[:, 2] ** 2
        )
        before = 0.5 * ROD_MASS * (SLIDE**2 + APPROACH**2)
        has_touched = all(np.any(take.records["contacts"] > 0) for take in takes)
        return {
            ROD_PANEL.key: Score(
                jnd=float(np.sqrt(np.mean((error / (WEBER * exact)) ** 2))),
                energy=float(np.max(np.abs(kinetic - before - self._rigid.energy_change))),
                created=created,
                verdict=_worst(takes) if has_touched else "lost contact",
            )
        }


def _worst(takes: Sequence[Take]) -> Verdict:
    order: tuple[Verdict, ...] = ("not metered", "strict", "within slack", "active")
    return max((take.environment for take in takes), key=order.index)


TAP_MASS, BALL, GAP = 0.05, 0.01, 0.01
"""Mass in kg, radius in m, and way to the wall in m, of the tool of ``models/virtual_wall``."""

TAP_SIZE, TAP_FREQUENCY, TAP_DURATION = 8e-3, 3.0, 1.0
"""Amplitude in m, frequency in Hz and duration in s: three taps, 6 mm behind the wall's face."""

CLEAR = 1e-9
"""Distance in m from the wall at which a ball that leaves it starts: leaving is no impact."""

TAP_PANEL = Panel(
    "tapping",
    "a ball on a rail that taps a wall",
    "closed form between rigid impacts without rebound, by SciPy's DOP853 and Brent's method",
)


def tapping(times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns a handle that moves along x, A (1 − cos ωt)."""
    positions, quaternions = still(times)
    positions[:, 0] = TAP_SIZE * (1 - np.cos(2 * np.pi * TAP_FREQUENCY * times))
    return positions, quaternions


def exact_taps(
    coupling: Coupling, times: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the ball's position in m and the force of the coupling in N at increasing times in s.

    The ball is free until it meets the wall, where its velocity becomes 0. It rests there until the
    coupling pulls it away, K (h − gap) + B h' < 0.
    """
    k, b, omega = coupling.stiffness, coupling.damping, 2 * np.pi * TAP_FREQUENCY
    end = float(times[-1])

    def force(time: Any, place: Any, speed: Any) -> Any:
        stretch = TAP_SIZE * (1 - np.cos(omega * time)) - place
        return k * stretch + b * (TAP_SIZE * omega * np.sin(omega * time) - speed)

    def meets(_time: float, state: NDArray[np.float64]) -> float:
        return float(state[0]) - GAP

    meets.terminal, meets.direction = True, 1.0  # type: ignore[attr-defined]
    place, speed = np.full(times.size, GAP), np.zeros(times.size)
    now, state = 0.0, [0.0, 0.0]
    while now < end:
        free = solve_ivp(
            lambda t, y: [y[1], force(t, y[0], y[1]) / TAP_MASS],
            (now, end),
            state,
            "DOP853",
            events=meets,
            rtol=1e-10,
            atol=1e-13,
            dense_output=True,
        )
        met = float(free.t[-1])
        during = (times > now) & (times <= met)
        if during.any():
            place[during], speed[during] = free.sol(times[during])
        if free.status == 0:
            break
        # the handle turns back within half a period
        later = np.linspace(met, met + 0.5 / TAP_FREQUENCY, 2000)
        pulls = np.flatnonzero(force(later, GAP, 0.0) < 0)
        first = int(pulls[0])
        now = met if not first else brentq(force, later[first - 1], later[first], (GAP, 0.0))
        state = [GAP - CLEAR, 0.0]
    return place, force(times, place, speed)


class Tap(Workload):
    """Tapping on a wall as a workload.

    Args:
        coupling: K and B; nothing turns.
        grid: Longest period T in s.
        finest: Shortest in s.
    """

    name = "tap"
    about = "a ball on a rail taps a wall three times"
    panels: Sequence[Panel] = (TAP_PANEL,)
    needs_tool = "pulls by no spring of known stiffness"
    has_contact = True

    def __init__(self, coupling: Coupling, grid: float, finest: float) -> None:
        self._grid, self._finest = grid, finest
        count = round(TAP_DURATION / grid)
        self._reference = np.zeros(count, TICK_DTYPE)
        self._reference["tool_quaternion"][:, 0] = 1.0
        place, force = exact_taps(coupling, grid * np.arange(1.0, count + 1))
        self._reference["tool_position"][:, 0] = place
        self._reference["wrench_on_tool"][:, 0] = force
        super().__init__(
            coupling,
            Stages(lambda: Prepared(load_scene("virtual_wall"), tapping, grid * count, coupling)),
        )

    def peer_work(self) -> PeerWork:
        """Describes the ball to other engines: free, and pressed at its centre alone."""
        duration = self._grid * self._reference.size
        moment = 0.4 * TAP_MASS * BALL**2
        task = Task(
            self.name,
            Body(TAP_MASS, (moment,) * 3, shapes=(Shape("sphere", (BALL,)),)),
            (Shape("box", (0.01, 0.03, 0.03), (0.01 + BALL + GAP, 0.0, 0.0)),),
            coupling=self.coupling,
            handle=motion_along(tapping, duration, self._finest),
        )
        return PeerWork((task,), duration, self._judge)
