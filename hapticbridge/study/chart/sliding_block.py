"""Workload ``sliding_block``: a block that sticks, breaks away and slides, in closed form."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from hapticbridge.coupling import Coupling
from hapticbridge.device import Motion
from hapticbridge.errors import StudyError
from hapticbridge.record import TICK_DTYPE
from hapticbridge.scene import Scene
from hapticbridge.study.chart.engine_run import PeerWork, motion_along
from hapticbridge.study.chart.scene_run import Stage, Stages, Take
from hapticbridge.study.chart.score import Score, diverged, score_of
from hapticbridge.study.chart.staged import Staged
from hapticbridge.study.chart.workload import Panel
from hapticbridge.study.engines.task import Body, Pose, Shape, Task
from hapticbridge.study.maps.rigs import scene_of

MASS = 0.2
"""In kg."""
FRICTION = 0.5
"""Of block and floor: it breaks away at 0.98 N."""
GRAVITY = 9.81
"""In m/s²."""
SPEED = 0.02
"""Of the handle along the floor in m/s, after a start from rest within ``EASE``."""
EASE = 0.02
"""In s: the handle's speed rises evenly over this time, while the block sticks."""
DURATION = 0.5
"""In s. The block breaks away after some 0.06 s, and then swings about the handle's speed."""

COUPLING = Coupling(1000.0, 1.0, 1.0, 1e-3)
"""As the other workloads'; the block does not turn."""

PANEL = Panel(
    "sliding",
    "a block that is pulled: it sticks, breaks away and slides",
    "closed form with Coulomb's friction: stuck until K e + B e' = μ m g, then a driven "
    "oscillator with a constant force",
)

WIDTH, HEIGHT = 0.02, 0.01
"""Half edges in m of the free box that other engines are given, along the floor and upwards."""

TOUCHING = 0.25
"""Share of the ticks in which the block must touch the floor. Not all: MuJoCo's friction lifts what
slides by some T μ v (10 µm at 1 ms), and contacts come and go."""

_BLOCK = f"""
<mujoco model="sliding_block">
  <option gravity="0 0 {-GRAVITY!r}" cone="elliptic" impratio="10">
    <flag diagexact="enable"/>
  </option>
  <default>
    <geom solref="0.002 1" solimp="0.9 0.95 0.001 0.5 2" friction="{FRICTION!r} 0 0" condim="3"/>
  </default>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 1"/>
    <body name="block" pos="0 0 0.01">
      <joint type="slide" axis="1 0 0"/>
      <joint type="slide" axis="0 0 1"/>
      <inertial pos="0 0 0" mass="{MASS!r}" diaginertia="1e-4 1e-4 1e-4"/>
      <geom name="block" type="sphere" size="0.01" mass="0"/>
      <site name="grip"/>
    </body>
  </worldbody>
</mujoco>"""


def handle_place(times: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns how far the handle is along the floor in m."""
    eased = np.minimum(times, EASE)
    return SPEED * (eased**2 / (2 * EASE) + np.maximum(times - EASE, 0.0))


def pulled(times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the path of the handle."""
    positions, quaternions = np.zeros((times.size, 3)), np.zeros((times.size, 4))
    positions[:, 0], quaternions[:, 0] = handle_place(times), 1.0
    return positions, quaternions


def free_block(coupling: Coupling, path: Motion) -> Task:
    """Returns the same block as a box that is free in space, for other engines.

    It is held and pulled at its centre. Friction acts HEIGHT below it, a torque of μ m g HEIGHT
    that the weight on a base of half a side WIDTH bears: the box slides as it does on rails, and
    does not tip while μ HEIGHT < WIDTH.

    Args:
        coupling: K and B.
        path: Of the handle, counted from its first pose.
    """
    box = Shape("box", (WIDTH, WIDTH, HEIGHT))
    across = MASS * (WIDTH**2 + HEIGHT**2) / 3
    body = Body(MASS, (across, across, MASS * 2 * WIDTH**2 / 3), shapes=(box,), friction=FRICTION)
    centre = (0.0, 0.0, HEIGHT)
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
    """Returns when the block breaks away in s: K h + B V = μ m g, with h = V (t − EASE/2).

    Raises:
        StudyError: It breaks away while the handle still gathers speed, or not in time.
    """
    limit = FRICTION * MASS * GRAVITY
    time = (limit - coupling.damping * SPEED) / (coupling.stiffness * SPEED) + EASE / 2
    if not EASE < time < DURATION:
        raise StudyError(
            f"with K = {coupling.stiffness:g} N/m and B = {coupling.damping:g} N s/m the block "
            f"breaks away at {time:.3g} s; the closed form wants {EASE:g} to {DURATION:g} s"
        )
    return time


def exact_sliding(
    coupling: Coupling, times: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the block's place in m and the force of the coupling in N at times in s.

    After the breakaway at t_0 the stretch e = h − x obeys m e'' + B e' + K e = μ m g from
    e(t_0) = h(t_0), e'(t_0) = V. It slides on as long as e' < V, which is checked.

    Raises:
        StudyError: The block would stick again, or breaks away out of range.
    """
    start, k, b = breakaway(coupling), coupling.stiffness, coupling.damping
    limit = FRICTION * MASS * GRAVITY
    dynamics = np.array([[0.0, 1.0], [-k / MASS, -b / MASS]])
    begin = np.array([float(handle_place(np.array([start]))[0]) - limit / k, SPEED])
    stretch = handle_place(times)
    rate = np.where(times < EASE, SPEED * times / EASE, SPEED)
    for i in np.flatnonzero(times > start):
        state = np.asarray(expm((times[i] - start) * dynamics)) @ begin
        stretch[i], rate[i] = state[0] + limit / k, state[1]
        if rate[i] > SPEED * (1 + 1e-9):
            raise StudyError("the block would stick again: the closed form is that of one slide")
    return handle_place(times) - stretch, k * stretch + b * rate


class SlidingBlock(Staged):
    """The workload.

    Args:
        coupling: K and B.
        grid: Longest period T in s.
        finest: Shortest in s.

    Raises:
        StudyError: The closed form does not hold for the coupling.
    """

    name = "sliding_block"
    about = "a block on the floor is pulled at a constant speed: stick, breakaway, slide"
    panels: Sequence[Panel] = (PANEL,)
    needs_tool = "pulls by no spring of known stiffness"
    has_contact = True

    def __init__(self, coupling: Coupling, grid: float, finest: float) -> None:
        self._grid = grid
        self._finest = finest
        count = round(DURATION / grid)
        place, force = exact_sliding(coupling, grid * np.arange(1.0, count + 1))
        self._reference = np.zeros(count, TICK_DTYPE)
        self._reference["tool_quaternion"][:, 0] = 1.0
        self._reference["wrench_on_tool"][:, 0] = force
        self._place = place
        super().__init__(
            coupling, Stages(lambda: Stage(block_scene(), pulled, grid * count, coupling))
        )

    def peer_work(self) -> PeerWork:
        """Describes the block to other engines: a free box, which the coupling keeps upright."""
        duration = self._grid * self._place.size
        task = free_block(self.coupling, motion_along(pulled, duration, self._finest))
        return PeerWork((task,), duration, self._judge)

    def _judge(self, takes: Sequence[Take]) -> Mapping[str, Score]:
        (take,) = takes
        if take.has_diverged:
            return {PANEL.key: diverged(take.created, take.ended)}
        records = take.at(self._grid).copy()
        # the weight rests on a contact that gives way, and the handle holds a share of it: judged
        # is what happens along the floor
        records["wrench_on_tool"][:, 1:] = 0.0
        self._reference["tool_position"][:] = records["tool_position"]
        self._reference["tool_position"][:, 0] = self._place
        is_touching = bool(np.mean(records["contacts"] > 0) > TOUCHING)
        return {
            PANEL.key: score_of(
                self._reference,
                records,
                created=take.created,
                verdict=take.environment if is_touching else "lost contact",
            )
        }


def block_scene() -> Scene:
    """Returns block and floor as a scene."""
    return scene_of(_BLOCK)
