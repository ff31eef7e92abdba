"""Workloads with a contact whose rest is known: a stack that is leaned on, a key in its socket."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.errors import StudyError
from hapticbridge.kernel.pose import quaternion_exp
from hapticbridge.kernel.record import TICK_DTYPE
from hapticbridge.lab.chart.engine_run import work_of
from hapticbridge.lab.chart.peg import RAMP, STAY, led, score_at_rest
from hapticbridge.lab.chart.scene_run import Prepared, Stages, Workload
from hapticbridge.lab.chart.score import Panel, PeerWork, Score, Take
from hapticbridge.lab.maps.base import scene_of
from hapticbridge.run.options import Workspace
from hapticbridge.scene import Scene

GRAVITY = 9.81
"""Gravity in m/s²."""

# The stack

BOXES = 5
"""Number of boxes; the top one is the tool, held at its centre."""
BOX_MASS, BOX_FRICTION = 0.1, 0.5
"""Mass of a box in kg, and Coulomb's coefficient of every contact."""
HALF_WIDTH, HALF_HEIGHT = 0.03, 0.01
"""Half edges of a box in m, along the floor and upwards."""

PRESS, SIDEWAYS = 5e-3, 1.5e-3
"""Way of the handle downwards and sideways in m: 5 N and 1.5 N. Both the friction under the top box
and the weight that keeps the stack from tipping would bear twice as much."""
PRESSING, SWAYING, SWAYS = 0.2, 1.0, 2
"""Times in s in which the handle goes down, and then sways to one side and back; number of sways.
One side, so that a creep shows."""
STACK_DURATION = PRESSING + SWAYING

SAFETY = 0.8
"""Largest share of what friction and weight bear, without unit. The closed form needs rest."""

STACK_PANEL = Panel(
    "leaning",
    f"a stack of {BOXES} boxes that a hand leans on",
    "closed form: below the breakaway a rigid stack rests, and the force is K h + B h'",
)

_SOFT = 'solref="0.002 1" solimp="0.9 0.95 0.001 0.5 2"'


TOP = (2 * BOXES - 1) * HALF_HEIGHT
"""Height of the top box's centre in m. At the start the boxes touch without a gap."""


def _box(number: int) -> str:
    height = (2 * number + 1) * HALF_HEIGHT
    flat = BOX_MASS * (HALF_WIDTH**2 + HALF_HEIGHT**2) / 3
    upright = BOX_MASS * 2 * HALF_WIDTH**2 / 3
    grip = '<site name="grip"/>' if number == BOXES - 1 else ""
    return f"""
    <body name="box_{number}" pos="0 0 {height!r}"><freejoint/>
      <inertial pos="0 0 0" mass="{BOX_MASS!r}" diaginertia="{flat!r} {flat!r} {upright!r}"/>
      <geom type="box" size="{HALF_WIDTH!r} {HALF_WIDTH!r} {HALF_HEIGHT!r}"/>{grip}
    </body>"""


def stack_scene() -> Scene:
    """Returns the boxes on their floor as a scene."""
    return scene_of(f"""
<mujoco model="stack">
  <option gravity="0 0 {-GRAVITY!r}" cone="elliptic" impratio="10">
    <flag diagexact="enable"/>
  </option>
  <default><geom {_SOFT} friction="{BOX_FRICTION!r} 0 0" condim="3" mass="0"/></default>
  <worldbody>
    <geom name="floor" type="box" size="1 1 0.1" pos="0 0 -0.1"/>{"".join(map(_box, range(BOXES)))}
  </worldbody>
</mujoco>""")


def _leaning(
    times: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the handle's way from its start in m and its velocity in m/s, both (n, 3)."""
    share = np.clip(times / PRESSING, 0.0, 1.0)
    omega = 2 * np.pi * SWAYS / SWAYING
    phase = omega * np.clip(times - PRESSING, 0.0, SWAYING)
    way, velocity = np.zeros((times.size, 3)), np.zeros((times.size, 3))
    way[:, 0] = SIDEWAYS * (1 - np.cos(phase)) / 2
    velocity[:, 0] = SIDEWAYS * omega * np.sin(phase) / 2
    way[:, 2] = -PRESS * share**3 * (10 - 15 * share + 6 * share**2)
    velocity[:, 2] = -PRESS * 30 * share**2 * (1 - share) ** 2 / PRESSING
    return way, velocity


def leaned(times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the path of the handle from its start: down, and then to one side and back."""
    quaternions = np.zeros((times.size, 4))
    quaternions[:, 0] = 1.0
    return _leaning(times)[0], quaternions


def leaned_in_scene(
    times: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the path of the handle in the scene, from the grip's place at the start."""
    places, quaternions = leaned(times)
    places[:, 2] += TOP
    return places, quaternions


def borne(down: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the force sideways in N up to which the stack rests under a force downwards in N.

    At each joint, with the weight W of the boxes above and the hand's height H above it, the force
    F sideways and N downwards obey F <= μ (N + W) and F H <= (N + W) HALF_WIDTH.
    """
    joints = np.arange(BOXES)
    load = down[..., None] + (joints + 1) * BOX_MASS * GRAVITY
    needed = np.minimum(BOX_FRICTION, HALF_WIDTH / ((2 * joints + 1) * HALF_HEIGHT))
    return np.asarray((load * needed).min(axis=-1))


def leaning_force(coupling: Coupling, times: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the force of the coupling on the top box in N, K h + B h', while the stack rests.

    Raises:
        StudyError: The force sideways exceeds ``SAFETY`` of what the stack bears.
    """
    way, velocity = _leaning(times)
    force = coupling.stiffness * way + coupling.damping * velocity
    side, most = np.abs(force[:, 0]), borne(-force[:, 2])
    if np.any(side > SAFETY * most):
        raise StudyError(
            f"with K = {coupling.stiffness:g} N/m the hand leans with {side.max():.3g} N on a "
            f"stack that bears {most[np.argmax(side)]:.3g} N: it would not rest"
        )
    return force


class Stack(Workload):
    """The stack as a workload.

    Args:
        coupling: K and B; nothing turns.
        grid: Longest period T in s.
        finest: Shortest in s.

    Raises:
        StudyError: The stack would not rest under the coupling.
    """

    name = "stack"
    about = f"a hand leans on a stack of {BOXES} boxes, below its breakaway"
    panels: Sequence[Panel] = (STACK_PANEL,)
    needs_tool = "leans by no spring of known stiffness"
    has_contact = True

    def __init__(self, coupling: Coupling, grid: float, finest: float) -> None:
        self._grid, self._finest = grid, finest
        count = round(STACK_DURATION / grid)
        self._reference = np.zeros(count, TICK_DTYPE)
        self._reference["tool_position"][:, 2] = TOP
        self._reference["tool_quaternion"][:, 0] = 1.0
        self._reference["wrench_on_tool"][:, :3] = leaning_force(
            coupling, grid * np.arange(1.0, count + 1)
        )

        def stage() -> Prepared:
            path, duration = leaned_in_scene, grid * count
            return Prepared(
                stack_scene(), path, duration, coupling, workspace=Workspace(absolute=True)
            )

        super().__init__(coupling, Stages(stage))

    def peer_work(self) -> PeerWork:
        """Describes the stack to other engines."""
        duration = self._grid * self._reference.size
        return work_of(stack_scene(), leaned, duration, self._finest, self.coupling, self._judge)


# The key

APOTHEM, CLEARANCE = 5e-3, 0.05e-3
"""Half of the key's width across flats, and its gap to each wall with the key in the middle, in m:
key and socket of ``models/hex_key``."""
KEY_LENGTH, SOCKET_LENGTH = 6e-3, 10e-3
"""Half lengths in m of the part of the key that is in the socket, and of the socket's walls."""
WALL = (2e-3, 4e-3)
"""Half thickness of a wall in m, and half its width; two walls may overlap behind a corner."""
KEY_MASS, KEY_MOMENT = 0.1, 1e-4
"""Mass in kg and moments of inertia in kg m² of the whole key with its long arm."""

TURNS: tuple[tuple[float, float, float], ...] = (
    (0.3, 1e-3, 0.0),
    (-0.3, 1e-3, 0.5e-3),
    (0.4, 0.0, -2e-3),
)
"""Poses of the handle: turn in rad about the socket's axis, and way across it in m."""

KEY_COUPLING = Coupling(1000.0, 3.0, 1.0, 5e-3)
"""Default coupling, with which the key is at rest at the end of each hold."""

KEY_PANEL = Panel(
    "turned",
    "a hexagonal key at rest, turned against its socket",
    "closed form: without friction a rigid key rests in the middle, turned by its play, and the "
    "wrench is K h and K_r (turn - play)",
)

_KEY_PATH = np.array([(0.0,) * 6, *((x, y, 0.0, 0.0, 0.0, turn) for turn, x, y in TURNS)])


def play(apothem: float = APOTHEM, clearance: float = CLEARANCE) -> float:
    """Returns the angle in rad by which a hexagon can turn in a hexagonal socket.

        θ = 30° − acos((a + c)/R),    R = 2 a/√3

    At this angle all six corners, R away from the middle, touch. The hexagon's width across any two
    opposite walls is then that of the socket, so it is in the middle, and cannot turn further
    anywhere else.

    Args:
        apothem: a, half of the hexagon's width across flats, in m.
        clearance: c, gap to each wall in m with the hexagon in the middle; at most R − a, beyond
            which it turns freely.

    Raises:
        StudyError: The hexagon turns freely.
    """
    cosine = (apothem + clearance) * math.sqrt(3) / (2 * apothem)
    if not cosine < 1:
        raise StudyError(f"a hexagon with a gap of {clearance:g} m a side turns freely")
    return math.pi / 6 - math.acos(cosine)


def turned_key(coupling: Coupling) -> NDArray[np.void]:
    """Returns pose and wrench of the key at rest, ``TICK_DTYPE``, one row per pose of the handle.

    With t = K_r (turn − play) / (R sin(30° − play)), the sum of the walls' forces, a push of the
    handle across the axis leaves the key in the middle if two walls' shares of it, at most
    2/√3 K h together, are no more than t.

    Raises:
        StudyError: A pose lets the key leave the middle, or does not press it against the walls.
    """
    angle, rows = play(), np.zeros(len(TURNS), TICK_DTYPE)
    arm = 2 * APOTHEM / math.sqrt(3) * math.sin(math.pi / 6 - angle)
    for row, (turn, *across) in zip(rows, TURNS, strict=True):
        reached = math.copysign(angle, turn)
        torque = coupling.rotational_stiffness * (turn - reached)
        push = coupling.stiffness * math.hypot(*across)
        if abs(turn) <= angle or not 2 / math.sqrt(3) * push <= abs(torque) / arm:
            raise StudyError(
                f"a torque of {abs(torque):.3g} N m does not keep the key in the middle of its "
                f"socket against a push of {push:.3g} N"
            )
        row["tool_quaternion"] = quaternion_exp((0.0, 0.0, reached))
        row["wrench_on_tool"][:2] = coupling.stiffness * np.array(across)
        row["wrench_on_tool"][5] = torque
    return rows


def hex_scene() -> Scene:
    """Returns key and socket as a scene; three boxes crosswise are a hexagonal prism."""
    corner = APOTHEM / math.sqrt(3)
    thick, wide = WALL
    away = APOTHEM + CLEARANCE + thick
    key, socket = "", ""
    for number in range(6):
        angle = number * math.pi / 3
        w, _, _, z = quaternion_exp((0.0, 0.0, angle))
        turn = f'quat="{w!r} 0 0 {z!r}"'
        if number < 3:
            key += f'<geom type="box" size="{APOTHEM!r} {corner!r} {KEY_LENGTH!r}" {turn}/>\n'
        place = f"{away * math.cos(angle)!r} {away * math.sin(angle)!r} 0"
        socket += (
            f'<geom type="box" size="{thick!r} {wide!r} {SOCKET_LENGTH!r}" pos="{place}" {turn}/>\n'
        )
    return scene_of(f"""
<mujoco model="hex_socket">
  <option gravity="0 0 0" cone="elliptic"><flag diagexact="enable"/></option>
  <default><geom {_SOFT} condim="1" mass="0"/></default>
  <worldbody>
    {socket}
    <body name="key"><freejoint/>
      <inertial pos="0 0 0" mass="{KEY_MASS!r}"
        diaginertia="{KEY_MOMENT!r} {KEY_MOMENT!r} {KEY_MOMENT!r}"/>
      {key}<site name="grip"/>
    </body>
  </worldbody>
</mujoco>""")


def turning(times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the path of the handle."""
    return led(_KEY_PATH, times)


class HexSocket(Workload):
    """The key in its socket as a workload.

    Args:
        coupling: K and B, K_r > 0.
        grid: Longest period T in s.
        finest: Shortest in s.

    Raises:
        StudyError: The closed form does not hold for the coupling.
    """

    name = "hex_socket"
    about = "a frictionless hexagonal key is turned against its socket and pushed across it"
    panels: Sequence[Panel] = (KEY_PANEL,)
    needs_tool = "turns by no spring of known stiffness"
    has_contact = True

    def __init__(self, coupling: Coupling, grid: float, finest: float) -> None:
        self._reference, self._finest = turned_key(coupling), finest
        self._duration = grid * math.ceil(len(TURNS) * (RAMP + STAY) / grid)
        super().__init__(
            coupling, Stages(lambda: Prepared(hex_scene(), turning, self._duration, coupling))
        )

    def peer_work(self) -> PeerWork:
        """Describes key and socket to other engines."""
        return work_of(
            hex_scene(), turning, self._duration, self._finest, self.coupling, self._judge
        )

    def _judge(self, takes: Sequence[Take]) -> Mapping[str, Score]:
        (take,) = takes
        return {KEY_PANEL.key: score_at_rest(self._reference, range(len(TURNS)), take)}
