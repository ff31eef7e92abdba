"""The loop on a device's own board: its law, its account under attack, and its instructions."""

from __future__ import annotations

import ctypes
import math
import re
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from board_attack import built_loop, floats, gained
from board_processors import CORES, MOST, computed_here, computed_on, memory_on, missing
from emulated.board_model import POSE, BoardSheet, Firmware
from firmware_build import COMPILER, FIRMWARE
from numpy.typing import NDArray

from hapticbridge.cli.guide import page
from hapticbridge.coupling import Coupling
from hapticbridge.demand.methods import method_named, unguarded_parameters
from hapticbridge.device.own_loop import (
    SURFACES,
    BoardSetting,
    LoopReport,
    LoopState,
    ShownTool,
)
from hapticbridge.device.rawhid.protocol import (
    LoopTurn,
    Status,
    ask_frame,
    decoded,
    force_frame,
    setting_frame,
    show_frames,
)
from hapticbridge.kernel.parameters import GuardParameters
from hapticbridge.kernel.pose import (
    Quaternion,
    canonical,
    product,
    quaternion_exp,
    quaternion_log,
    rotation_between,
)
from hapticbridge.kernel.record import POST_DTYPE, SAMPLE_DTYPE
from hapticbridge.kernel.state import BoundKernel
from hapticbridge.kernel.tick import posted_tick
from hapticbridge.run.endpoint import posted_scene

HERE = Path(__file__).parent

PERIOD, STIFFNESS, DAMPING, LEVEL, CREDIT = 1e-4, 20e3, 0.5, 5.0, 0.01
ROTATIONAL_STIFFNESS, ROTATIONAL_DAMPING, TORQUE_LEVEL = 10.0, 1e-3, 0.1
UPRIGHT = (1.0, 0.0, 0.0, 0.0)

pytestmark = pytest.mark.skipif(
    COMPILER is None, reason="neither g++ nor clang++ is here to compile the firmware with"
)


@pytest.fixture(scope="module", name="library")
def _library(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    return built_loop(tmp_path_factory.mktemp("board"))


class Loop:
    """The firmware's loop, with rotation if ``turns``.

    Attributes:
        passed, tank: Σ P and D in J.
        share: Share of the gains in force.
        tool: Position of the shown tool in m.
        tool_turn: Its orientation.
    """

    def __init__(self, library: ctypes.CDLL, *, turns: bool = False, **changes: float) -> None:
        self._library, self._turns = library, turns
        self._loop = ctypes.c_void_p(library.loop_new(PERIOD, turns))
        self._setting: dict[str, float] = {
            "stiffness": STIFFNESS,
            "damping": DAMPING,
            "level": LEVEL,
            "credit": CREDIT,
            "passing": 0.0,
            "fade": PERIOD,
            "patience": 1e3,
            "rotational_stiffness": ROTATIONAL_STIFFNESS,
            "rotational_damping": ROTATIONAL_DAMPING,
            "torque_level": TORQUE_LEVEL,
        }
        self._setting |= changes
        self.set()
        self.tool, self.passed, self.tank, self.share = np.zeros(3), 0.0, 0.0, 0.0
        self.tool_turn = np.array(UPRIGHT)

    def set(self, *, is_enabled: bool = True, **changes: float) -> None:
        self._setting |= changes
        self._library.loop_set(self._loop, floats(list(self._setting.values())), int(is_enabled))

    def show(self, position: Any, velocity: Any = None, **others: Any) -> None:
        """Shows the tool; ``surfaces`` are normals and gaps, ``work`` is W in J."""
        numbers = np.zeros(13 + 4 * SURFACES)
        surfaces = others.get("surfaces", ())
        numbers[:3], numbers[3:6] = position, 0.0 if velocity is None else velocity
        numbers[6:10], numbers[10:13] = others.get("turn", UPRIGHT), others.get("turning", 0.0)
        for k, (normal, gap) in enumerate(surfaces):
            numbers[13 + 4 * k : 17 + 4 * k] = *normal, gap
        self._library.loop_show(
            self._loop,
            floats(numbers),
            ctypes.c_double(others.get("work", 0.0)),
            len(surfaces),
            int(velocity is not None),
            int(others.get("is_placed", False)),
        )

    def tick(self, position: Any, turn: Any = UPRIGHT) -> NDArray[np.float64]:
        """Runs one period; returns the force on the device in N, or the wrench if it turns."""
        wrench, works, poses = np.zeros(6, np.float32), np.zeros(5), np.zeros(10, np.float32)
        self._library.loop_tick(self._loop, floats([*position, *turn]), floats(wrench))
        doubles = works.ctypes.data_as(ctypes.POINTER(ctypes.c_double))
        self._library.loop_report(self._loop, doubles, floats(poses))
        self.passed, self.tank, _, _, self.share = works
        self.tool, self.tool_turn = np.split(poses[3:].astype(np.float64), [3])
        return wrench.astype(np.float64)[: 6 if self._turns else 3]


def test_the_constants_are_those_of_the_host() -> None:
    script = HERE.parent / "scripts" / "make_firmware_constants.py"
    subprocess.run([sys.executable, str(script), "--check"], check=True)


# The law is that of the kernel


def kernel(*, turns: bool) -> BoundKernel:
    """The loop of another program's scene, at the board's period and gains."""
    scene, method = posted_scene(CREDIT), method_named("implicit")
    turn = (ROTATIONAL_STIFFNESS, ROTATIONAL_DAMPING) if turns else (1e-6, 0.0)
    coupling = Coupling(STIFFNESS, DAMPING, *turn)
    parameters = replace(
        unguarded_parameters(scene, coupling, PERIOD, 1, method),
        force_limit=LEVEL,
        torque_limit=TORQUE_LEVEL,
        ramp_ticks=1,
        scene_ticks=20,
        credit=CREDIT,
        guarding=GuardParameters(fade_ticks=1),
    )
    return BoundKernel(scene.model, scene.data, parameters)


def shown_at_random(
    rng: np.random.Generator, hand: NDArray[np.float64], turn: NDArray[np.float64], size: float
) -> NDArray[np.void]:
    """Returns a tool near the hand, in numbers of single precision; ``size`` is a twist in rad."""
    post = np.zeros(1, POST_DTYPE)
    count, has_velocity = int(rng.integers(SURFACES + 1)), rng.random() < 0.5
    normals = rng.standard_normal((SURFACES, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    post["pose"][0, :3] = hand + 3e-5 * rng.standard_normal(3)
    post["pose"][0, 3] = 1.0
    if size:
        post["pose"][0, 3:] = turned_by(size * rng.standard_normal(3), turn)
    post["has_velocity"], post["planes"] = has_velocity, count
    post["velocity"][0, :3] = has_velocity * 0.05 * rng.standard_normal(3)
    if size:
        post["velocity"][0, 3:] = has_velocity * 20.0 * size * rng.standard_normal(3)
    post["normals"][0, : 3 * SURFACES] = normals.ravel()
    post["gaps"][0, :SURFACES] = np.abs(1e-5 * rng.standard_normal(SURFACES))
    for name in ("pose", "velocity", "normals", "gaps"):
        post[name] = post[name].astype(np.float32)
    return post


def show(loop: Loop, post: NDArray[np.void]) -> None:
    count, own = int(post["planes"][0]), post[0]
    surfaces = [(own["normals"][3 * k : 3 * k + 3], own["gaps"][k]) for k in range(count)]
    velocity = own["velocity"][:3] if own["has_velocity"] else None
    turn, turning = own["pose"][3:], own["velocity"][3:]
    more = {"surfaces": surfaces, "work": float(own["work"]), "turn": turn, "turning": turning}
    loop.show(own["pose"][:3], velocity, **more)


def turned_by(turn: Any, orientation: Any) -> NDArray[np.float64]:
    """Returns an orientation that is turned by a rotation vector, in single precision."""
    turned = product(quaternion_exp(tuple(turn)), tuple(orientation))
    return np.array(turned, np.float32).astype(np.float64)


def twist_of(first: Any, second: Any) -> float:
    """Returns the angle in rad between two orientations."""
    return float(np.linalg.norm(rotation_between(tuple(first), tuple(second))))


def turn_rounding(turned: float, tool: Any, handle: Any) -> float:
    """Returns by how much in J the P of a tool's turn in rad may differ."""
    if turned**2 + twist_of(tool, handle) ** 2 > 0.26:
        return TORQUE_LEVEL * 2e-6
    # there the board takes a twist for a length
    return TORQUE_LEVEL * 2e-6 + 0.01 * min(ROTATIONAL_STIFFNESS * turned, TORQUE_LEVEL) * turned


@pytest.mark.parametrize(("seed", "twist"), [(0, 0.0), (1, 0.0), (4, 3e-4), (5, 0.1), (6, 2.0)])
def test_each_period_is_that_of_the_kernel(library: ctypes.CDLL, seed: int, twist: float) -> None:
    """Twists of ``twist`` rad: without any, small ones, some of half a radian, and of any size."""
    turns = twist > 0.0
    rng, bound = np.random.default_rng(seed), kernel(turns=turns)
    state, row, sample = bound.state, bound.row, np.zeros(1, SAMPLE_DTYPE)
    sample["quaternion"][0, 0] = 1.0
    loop = Loop(library, turns=turns, passing=float(state["shown"]["passing"][0]))
    hand, velocity, due = np.zeros(3), np.zeros(3), 0
    turn, turning = np.array(UPRIGHT), np.zeros(3)
    kinds, work = np.zeros(2, np.int64), 0.0
    for tick in range(3000):
        post = np.zeros(0, POST_DTYPE)
        if tick > 5:
            velocity += 0.02 * rng.standard_normal(3) - 0.01 * velocity
            hand = (hand + PERIOD * velocity).astype(np.float32).astype(np.float64)
            if turns:
                turning += 30.0 * twist * rng.standard_normal(3) - 0.01 * turning
                turn = turned_by(PERIOD * turning, turn)
            # one period from the same state: where the tank is nearly empty, paths differ by more
            state["pose"]["tool_position"][0], state["shown"]["tank"] = loop.tool, loop.tank
            state["pose"]["tool_quaternion"][0] = canonical(tuple(loop.tool_turn))
        if tick >= due:
            due, post = tick + int(rng.integers(5, 40)), shown_at_random(rng, hand, turn, twist)
            if tick == 0:
                post["pose"][0], post["has_velocity"], post["planes"] = (0.0,) * 3 + UPRIGHT, 0, 0
            work += 1e-6 * rng.random() * (tick > 0)
            post["work"] = work
            show(loop, post)
        sample["position"][0], sample["quaternion"][0] = hand, turn
        held_back, before = int(state["shown"]["held_back"][0]), loop.passed
        assert posted_tick(state, sample, post, row, PERIOD)
        last = loop.tool_turn
        wrench = loop.tick(hand, turn)
        if tick <= 5:
            continue
        is_paid = int(state["shown"]["held_back"][0]) == held_back
        kinds[int(is_paid)] += 1
        given = float(state["shown"]["work"][0])
        if is_paid:
            sent = row["wrench_on_device"][0]
            assert wrench[:3] == pytest.approx(sent[:3], abs=1e-3)
            assert loop.tool == pytest.approx(row["tool_position"][0], abs=5e-8)
            rounding = LEVEL * 2e-8
            if turns:
                rounding += turn_rounding(twist_of(last, loop.tool_turn), loop.tool_turn, turn)
                assert wrench[3:] == pytest.approx(sent[3:], abs=1e-5)
                assert twist_of(row["tool_quaternion"][0], loop.tool_turn) < 1e-6
            assert loop.passed - before == pytest.approx(given, abs=rounding)
        else:  # both search the largest motion that is paid for
            assert loop.tank >= -1e-11 - max(work, 0.0)
    assert kinds.min() > 100


# The account: a hand that may choose every motion, and a host that shows anything


ATTACKS: dict[str, dict[str, Any]] = {
    "lines": {},
    "poses": {"turns": True},
    "turns": {"turns": True, "stays": True},
}
"""Loops that hands attack, by lines, by lines and rotations, and by rotations alone."""


@pytest.mark.parametrize("loop", ATTACKS)
def test_no_hand_gets_more_than_the_credit(library: ctypes.CDLL, loop: str) -> None:
    assert max(gained(library, seed, **ATTACKS[loop]) for seed in range(100)) < 1e-6


@pytest.mark.parametrize("loop", ATTACKS)
@pytest.mark.parametrize("change", [{"trust": 1.0}, {"damping_share": 0.5, "step": 0.0}])
def test_without_tank_or_damping_hands_are_seen_to_gain(
    library: ctypes.CDLL, change: dict[str, Any], loop: str
) -> None:
    assert any(gained(library, seed, **ATTACKS[loop], **change) > 0.01 for seed in range(100))


def wobbling(library: ctypes.CDLL, **changes: float) -> tuple[float, float]:
    """Returns energy that nothing paid for, and speed in the end, of a handle about a twist."""
    numbers = {
        "period": PERIOD,
        "stiffness": 10.0,
        "damping": 0.0,
        "level": 100.0,
        "inertia": 1e-5,
        "share": 1.0,
        "hand": 20.0,
        "twist": 2.0,
        "time": 0.0,
    } | changes
    period, time = numbers["period"], numbers["time"]
    needed = numbers["stiffness"] * (0.5 * period + 1.5 * time) + numbers["damping"]
    values = [each * needed if name == "share" else each for name, each in numbers.items()]
    found = (ctypes.c_double * 2)()
    library.wobble((ctypes.c_double * len(values))(*values), found)
    return found[0], found[1]


@pytest.mark.parametrize("time", [0.0, 3e-5, 9e-5])
@pytest.mark.parametrize("twist", [0.2, 1.0, 2.0, 2.5, 3.0])
def test_a_handle_that_wobbles_about_a_large_twist_gains_nothing(
    library: ctypes.CDLL, twist: float, time: float
) -> None:
    """Its ledger is kept in twentieths of the period; half the damping is seen to give energy."""
    for others in ({}, {"level": 0.1}, {"damping": 1e-4}):
        gained, speed = wobbling(library, twist=twist, time=time, share=1.05, **others)
        assert gained <= 1e-9
        assert speed < 200.0
    if twist <= 2.0:  # beyond, the tool turns with the handle, which ends the wobble
        assert wobbling(library, twist=twist, time=time, share=0.5)[0] > 1.0


def late_gain(loop: Loop, turns: Any, time: float, b: float) -> float:
    """Returns the energy in J that a hand gains from torques that come late.

    ``turns`` has the handle's rotation vector in each period, in the device's frame: before the
    torque comes, ``time`` s after the position, and after it.
    """
    orientation, torque, gained = UPRIGHT, np.zeros(3), 0.0
    for _ in range(10):  # the force begins
        loop.tick((0.0,) * 3, orientation)
    for early, later in turns:
        next_torque = loop.tick((0.0,) * 3, orientation)[3:]
        for turn, applied, lasts in (
            (np.array(early), torque, time),
            (np.array(later), next_torque, PERIOD - time),
        ):
            gained += applied @ turn - b / lasts * turn @ turn
            orientation = product(quaternion_exp(tuple(turn)), orientation)
        torque = next_torque
    return gained


def test_a_hand_that_passes_half_a_turn_and_back_gains_nothing(library: ctypes.CDLL) -> None:
    """Its motion is along the torque that is late, each time across the place where it reverses."""
    loop = Loop(library, turns=True, credit=0.0, rotational_damping=0.0)
    loop.show((0.0,) * 3, turn=UPRIGHT)
    time, jump, near = 0.1 * PERIOD, 3e-4, 1e-5
    b = ROTATIONAL_STIFFNESS * (0.5 * PERIOD + 1.5 * time)
    parts = 1000
    to = [((0.0, 0.0, 0.0), (0.0, 0.0, (np.pi + near) / parts))] * parts
    there, back = (0.0, 0.0, jump), (0.0, 0.0, -jump)
    rest = (0.0, 0.0, jump - 2.0 * near), (0.0, 0.0, 2.0 * near - jump)
    jumps = [(back, rest[0]), (there, rest[1])] * 10_000
    assert late_gain(loop, [*to, *jumps], time, b) < 1e-6


def test_a_hand_and_a_tool_that_wobble_about_a_large_twist_gain_nothing(
    library: ctypes.CDLL,
) -> None:
    """The tool's jumps turn a late torque by more than its spring gives for them."""
    gains = {"rotational_damping": 0.0, "torque_level": 100.0}
    loop = Loop(library, turns=True, credit=1.0, **gains)
    time, size, speed, periods, parts = 0.95 * PERIOD, 0.05, -0.99, 3000, 1000
    b = ROTATIONAL_STIFFNESS * (0.5 * PERIOD + 1.5 * time)
    twist = quaternion_exp((0.0, 0.0, 2.8))
    loop.show((0.0,) * 3, (0.0,) * 3, turn=UPRIGHT)

    def at(period: float) -> Quaternion:
        angle = speed * period
        turn = size * math.cos(angle), size * math.sin(angle), 0.0
        return product(quaternion_exp(turn), twist)

    def turns() -> Any:
        for _ in range(parts):
            yield (0.0,) * 3, (0.0, 0.0, 2.8 / parts)
        yield (0.0,) * 3, rotation_between(twist, at(0.0))
        for period in range(periods):
            angle = speed * period + 0.72
            tool = 5.58 * size * np.array([math.cos(angle), math.sin(angle), 0.0])
            loop.show((0.0,) * 3, (0.0,) * 3, turn=turned_by(tool, UPRIGHT))
            middle, end = at(period + time / PERIOD), at(period + 1.0)
            yield rotation_between(at(period), middle), rotation_between(middle, end)

    assert late_gain(loop, turns(), time, b) < 1.0 + 1e-6


def test_a_tool_that_is_led_through_half_a_turn_gains_nothing(library: ctypes.CDLL) -> None:
    """The torque that reverses there did work, and its spring holds no less."""
    loop = Loop(library, turns=True, credit=1.0, rotational_damping=0.0, passing=10.0)
    level, stiffness, crossed = TORQUE_LEVEL, ROTATIONAL_STIFFNESS, 0
    for angle in (0.0, *np.linspace(3.0, 3.3, 40)):
        loop.show((0.0,) * 3, turn=turned_by((0.0, 0.0, angle), UPRIGHT))
        for _ in range(20):
            torque = loop.tick((0.0,) * 3)[5]
            w, *axis = loop.tool_turn
            twist = 2.0 * np.arctan2(np.linalg.norm(axis), abs(w))
            held = level * max(twist - 0.5 * level / stiffness, 0.0)
            assert loop.passed <= -held + 1e-6
            crossed += torque < -0.99 * level
    assert crossed > 10


# A stiff wall behind a slow link, on a device of 0.1 kg, 2 N s/m, 0.1 N and 10 µm

SETTLED = 1e-5
"""Largest travel in m in the last half second of a hand that rests on a wall: a step."""


def at_wall(library: ctypes.CDLL, stiffness: float, **changes: float) -> NDArray[np.float64]:
    """Returns travel, energy beyond what b burned, depth and force of a tap and a push of 1 N."""
    numbers = {
        "period": PERIOD,
        "stiffness": stiffness,
        "damping": 0.0,
        "level": 10.0,
        "step": 1e-5,
        "mass": 0.1,
        "b": 2.0,
        "friction": 0.1,
        "delay": 2e-3,
        "push": 1.0,
        "is_on_board": 1.0,
    } | changes
    is_on_board = int(numbers.pop("is_on_board"))
    values, found = (ctypes.c_double * len(numbers))(*numbers.values()), (ctypes.c_double * 4)()
    library.wall(values, is_on_board, found)
    return np.array(found)


def test_a_stiff_wall_on_the_board_gives_nothing_and_rests(library: ctypes.CDLL) -> None:
    # b >= KT/2 = 0.75 N s/m, and friction >= K step/2 = 0.075 N
    travel, gained, depth, force = at_wall(library, 15e3)
    assert travel < SETTLED
    assert gained < 1e-9
    assert depth == pytest.approx(1.0 / 15e3, abs=1e-5)
    assert 3.0 < force < 10.0
    travel, *_ = at_wall(library, 15e3, b=0.3, friction=0.0)
    assert travel > 10.0 * SETTLED  # a device that does not meet the condition is seen to swing


def test_the_hosts_own_loop_bears_a_soft_one_behind_the_same_link(library: ctypes.CDLL) -> None:
    travel, gained, depth, _ = at_wall(library, 967.0, is_on_board=0.0)
    assert travel < SETTLED
    assert gained < 1e-9
    assert depth == pytest.approx(1.0 / 967.0, abs=2e-4)
    for stiffness in (2e3, 15e3):
        travel, gained, *_ = at_wall(library, stiffness, is_on_board=0.0)
        assert travel > 1e-3
        assert gained > 0.01


# Rotation


def unit(quaternion: Any) -> Quaternion:
    """Returns a quaternion of length 1."""
    w, x, y, z = map(float, quaternion)
    return canonical((w, x, y, z))


@pytest.mark.parametrize("size", [1e-8, 1e-6, 1e-4, 1e-2, 1.0, 3.0, 3.14])
def test_a_small_turn_is_as_precise_as_a_large_one(library: ctypes.CDLL, size: float) -> None:
    rng = np.random.default_rng(0)
    for _ in range(300):
        first, turn = np.array(unit(rng.standard_normal(4))), rng.standard_normal(3)
        turn *= size / np.linalg.norm(turn)
        begin, end = first.astype(np.float32), turned_by(turn, first).astype(np.float32)
        found, turned = np.zeros(3, np.float32), np.zeros(4, np.float32)
        library.turn_between(floats(begin), floats(end), floats(found))
        exact = rotation_between(unit(begin), unit(end))
        # what rounding has left of a turn that is smaller than the step of the numbers
        assert np.linalg.norm(found - exact) <= 3e-7 * np.linalg.norm(exact) + 1e-15
        library.turn_from(floats(turn), floats(begin), floats(turned))
        assert np.linalg.norm(turned) == pytest.approx(1.0, abs=2e-7)
        assert twist_of(turned_by(turn, begin), unit(turned)) < 6e-7


def twisted(library: ctypes.CDLL, **changes: float) -> Loop:
    """A loop whose hand twists by 5 mrad against a tool that stays."""
    loop = Loop(library, turns=True, **changes)
    loop.show((0.0,) * 3, (0.0,) * 3)
    loop.tick((0.0,) * 3)
    for k in range(200):
        wrench = loop.tick((0.0,) * 3, turned_by((0.0, 0.0, -2.5e-5 * (k + 1)), UPRIGHT))
    stiffness = changes.get("rotational_stiffness", ROTATIONAL_STIFFNESS)
    assert wrench[5] == pytest.approx(5e-3 * stiffness, rel=0.01)
    assert np.all(wrench[:5] == 0.0)
    return loop


TWIST = turned_by((0.0, 0.0, -5e-3), UPRIGHT)


def test_a_rotation_that_is_none_ends_the_force_for_good(library: ctypes.CDLL) -> None:
    rotations = ((np.nan, 0.0, 0.0, 0.0), (0.0,) * 4, (0.5, 0.0, 0.0, 0.0), (1e38, 0.0, 0.0, 0.0))
    for rotation in (*rotations, (1.0, 1.1, 0.0, 0.0), (1.0, 0.0, np.inf, 0.0)):
        loop = twisted(library)
        assert np.all(loop.tick((0.0,) * 3, rotation) == 0.0)
        loop.show((0.0,) * 3, (0.0,) * 3)
        assert np.all(loop.tick((0.0,) * 3, TWIST) == 0.0)
    loop = twisted(library)
    assert loop.tick((0.0,) * 3, -1.1 * TWIST)[5] > 0.04  # the same rotation


def test_raised_rotational_gains_give_the_spring_no_energy(library: ctypes.CDLL) -> None:
    soft = {"rotational_stiffness": ROTATIONAL_STIFFNESS / 4.0, "rotational_damping": 0.0}
    loop = twisted(library, **soft, passing=1e-3, fade=1e-3)
    held = 0.5 * ROTATIONAL_STIFFNESS / 4.0 * 5e-3**2
    loop.set(rotational_stiffness=ROTATIONAL_STIFFNESS)
    for _ in range(20):
        torque = loop.tick((0.0,) * 3, TWIST)[5]
        twist = twist_of(loop.tool_turn, TWIST)
        assert 0.5 * torque * twist <= held + 1e-11 - min(loop.passed, 0.0)
    assert torque > 1.2 * 5e-3 * ROTATIONAL_STIFFNESS / 4.0


def test_a_torque_fades_and_begins_where_the_hand_is(library: ctypes.CDLL) -> None:
    loop = twisted(library, fade=20 * PERIOD)
    loop.set(is_enabled=False)
    torques = [loop.tick((0.0,) * 3, TWIST)[5] for _ in range(30)]
    assert np.all(np.diff(torques) <= 1e-6)
    assert torques[-1] == 0.0
    assert np.count_nonzero(torques) in (18, 19, 20)
    loop.set(is_enabled=True)
    loop.show((0.0,) * 3, (0.0,) * 3)
    assert abs(loop.tick((0.0,) * 3, TWIST)[5]) < 5e-3


# Ends of the force


def pressed(library: ctypes.CDLL, **changes: Any) -> Loop:
    """A loop whose hand presses 0.1 mm into a wall at 0."""
    loop = Loop(library, **changes)
    loop.show(np.zeros(3), np.zeros(3))
    loop.tick(np.zeros(3))
    for k in range(200):
        force = loop.tick([-5e-7 * (k + 1), 0.0, 0.0])
    assert force[0] == pytest.approx(1e-4 * changes.get("stiffness", STIFFNESS), rel=0.01)
    return loop


def test_a_silent_host_and_one_that_ends_the_force_let_it_fade(library: ctypes.CDLL) -> None:
    for is_ended in (False, True):
        loop = pressed(library, fade=20 * PERIOD, patience=200.5 * PERIOD)
        if is_ended:
            loop.set(is_enabled=False)
        forces = [loop.tick([-1e-4, 0.0, 0.0])[0] for _ in range(30)]
        assert np.all(np.diff(forces) <= 1e-6)
        assert forces[-1] == 0.0
        assert np.count_nonzero(forces) in (18, 19, 20)
        if not is_ended:  # a word of the host lets it rise again, from where the hand is
            loop.show(np.zeros(3), np.zeros(3))
            assert abs(loop.tick([-1e-4, 0.0, 0.0])[0]) < 0.2


def test_a_tool_that_was_put_elsewhere_ends_the_force_first(library: ctypes.CDLL) -> None:
    loop = pressed(library, fade=20 * PERIOD)
    loop.show([0.05, 0.0, 0.0], np.zeros(3), is_placed=True)
    shares = []
    for _ in range(45):
        loop.tick([-1e-4, 0.0, 0.0])
        shares.append(loop.share)
    assert min(shares) == 0.0
    assert shares[-1] == 1.0
    assert loop.tank >= 0.0


def test_a_position_that_is_no_place_ends_the_force_for_good(library: ctypes.CDLL) -> None:
    for value in (np.nan, np.inf, -np.inf, 1e38, -2e4):
        loop = pressed(library)
        assert np.all(loop.tick([value, 0.0, 0.0]) == 0.0)
        loop.show(np.zeros(3), np.zeros(3))
        assert np.all(loop.tick([-1e-4, 0.0, 0.0]) == 0.0)
    loop = pressed(library)
    assert loop.tick([1e4, 0.0, 0.0])[0] == -LEVEL  # far, but a place
    assert loop.tick([-1e-4, 0.0, 0.0])[0] > 0.0


@pytest.mark.parametrize(
    ("position", "velocity", "surfaces"),
    [
        ((1e38, 0.0, 0.0), None, ()),
        ((0.0, 0.0, -3e38), (0.0, 0.0, -3e38), ()),
        ((0.0, 0.0, 0.0), (1e38, -1e38, 0.0), ()),
        ((0.0, 0.0, 0.0), None, (((1.0, 0.0, 0.0), -1e38),)),
        ((0.0, 0.0, 0.0), None, (((1e38, 1e38, 0.0), -1.0),)),
    ],
)
def test_a_tool_that_is_shown_at_no_place_stays(
    library: ctypes.CDLL, position: Any, velocity: Any, surfaces: Any
) -> None:
    loop = pressed(library)
    before, passed = loop.tool, loop.passed
    loop.show(position, velocity, surfaces=surfaces)
    for _ in range(30):
        assert loop.tick([-1e-4, 0.0, 0.0])[0] == pytest.approx(2.0, rel=0.01)
    assert np.array_equal(loop.tool, before)
    assert loop.passed == passed


def test_raised_gains_give_the_spring_no_energy(library: ctypes.CDLL) -> None:
    loop = pressed(library, stiffness=STIFFNESS / 4.0, damping=0.0, passing=1e-3, fade=1e-3)
    held = 0.5 * STIFFNESS / 4.0 * 1e-8
    loop.set(stiffness=STIFFNESS)
    for _ in range(20):
        force = loop.tick([-1e-4, 0.0, 0.0])[0]
        stretch = loop.tool[0] + 1e-4
        # what the spring has more was paid: it is the tool that was led back
        assert 0.5 * force * stretch <= held + 1e-12 - min(loop.passed, 0.0)


# A whole board, by its frames


class Board:
    """A board in virtual time, whose handle is where ``position`` and ``turn`` say."""

    def __init__(self, library: ctypes.CDLL, axes: int = 0b111) -> None:
        sheet = BoardSheet(axes=axes, friction=0.0, resolution=0.0, force_limit=5.0)
        self._firmware = Firmware(library, sheet)
        self.turn, self.torque = np.array(UPRIGHT), np.zeros(3)
        self.position, self.force, self.now = np.zeros(3), np.zeros(3), 0.0
        self.status = 0

    @property
    def pose(self) -> NDArray[np.float32]:
        return np.concatenate([self.position, self.turn]).astype(np.float32)

    def send(self, *frames: bytes) -> bool:
        return all(self._firmware.receive(each, self.now) for each in frames)

    def run(self, periods: int, pace_us: int = 100) -> None:
        wrench = np.zeros(6, np.float32)
        for _ in range(periods):
            self.now += 1e-6 * pace_us
            self._firmware.tick(self.pose, self.now, wrench)
        self.force, self.torque = np.split(wrench.astype(np.float64), 2)

    def state(self) -> Any:
        return decoded(self._firmware.state(self.pose, self.status, self.now))

    def more(self) -> Any:
        more = self._firmware.more()
        return None if more is None else decoded(more)

    def numbers(self) -> Any:
        assert self.send(ask_frame(1, 0))
        answer = self._firmware.answer()
        assert answer is not None
        return decoded(answer)


TURNS = ROTATIONAL_STIFFNESS, ROTATIONAL_DAMPING, TORQUE_LEVEL
SETTING = BoardSetting(STIFFNESS, DAMPING, LEVEL, 0.0, 10 * PERIOD, 1e-3, *TURNS)
WALL = (((1.0, 0.0, 0.0), 0.0), ((0.0, 1.0, 0.0), 2e-4), ((0.0, 0.0, 1.0), 0.5))


def at_a_wall(library: ctypes.CDLL) -> Board:
    """A board whose hand presses 50 µm into a wall along x."""
    board = Board(library)
    assert board.send(setting_frame(1, SETTING))
    for sequence in range(2, 22):
        board.position = np.array([-5e-5, 0.0, 0.0]) * (sequence - 2) / 19
        assert board.send(*show_frames(sequence, ShownTool((0.0,) * 3, None, 0.0, WALL), 50))
        board.run(10)
    return board


def test_a_board_says_that_it_has_a_loop_and_renders_a_wall(library: ctypes.CDLL) -> None:
    board = at_a_wall(library)
    assert board.numbers().loop_rate == 10e3
    assert board.force == pytest.approx([1.0, 0.0, 0.0], rel=0.01)
    states = [board.state() for _ in range(40)]
    state, report = states[0], next(each for each in states if isinstance(each, LoopReport))
    assert isinstance(state, LoopState)
    assert state.force == pytest.approx(board.force)
    assert (state.echo, state.status) == (21, Status.ENABLED)
    assert state.tank == pytest.approx(1e-3 + state.passed, abs=1e-8)
    assert report.share == 1.0
    assert (report.ticks, report.missed) == (200, 0)
    # the spring's force rises to 1 N, and the damper's rises and falls in each step of the hand
    assert report.changes == pytest.approx(1.0 + 2.0 * DAMPING / PERIOD * 5e-5, rel=0.05)
    # the second and third surface came in a frame of their own
    tool = ShownTool((0.0,) * 3, (0.0, -1.0, -10.0), 1e-6, WALL)
    board.send(*show_frames(22, tool, 50))
    board.position = np.array([0.0, -2e-3, -2e-3])
    board.run(10)
    counters = next(each for each in (board.state() for _ in range(40)) if hasattr(each, "tool"))
    assert counters.tool == pytest.approx((0.0, -2e-4, -1e-2), abs=1e-6) or counters.held_back
    assert counters.work == pytest.approx(1e-6)


POSED = 0b111111 | POSE


def at_a_stop(library: ctypes.CDLL) -> Board:
    """A six-axis board whose hand twists by 5 mrad about z against a tool that stays."""
    board, begin = Board(library, POSED), (0.3, -0.2, 0.1)
    board.turn = turned_by(begin, UPRIGHT)
    assert board.send(setting_frame(1, SETTING))
    for sequence in range(2, 22):
        twist = (0.0, 0.0, -5e-3 * (sequence - 2) / 19)
        board.turn = turned_by(twist, turned_by(begin, UPRIGHT))
        shown = ShownTool((0.0,) * 3, (0.0,) * 3, rotation=begin)
        assert board.send(*show_frames(sequence, shown, 50, is_posed=True))
        board.run(10)
    return board


def test_a_board_renders_a_twist_and_tells_it_in_two_frames(library: ctypes.CDLL) -> None:
    board = at_a_stop(library)
    assert board.numbers().is_posed
    assert board.torque == pytest.approx([0.0, 0.0, 5e-3 * ROTATIONAL_STIFFNESS], abs=1e-4)
    state = board.state()
    while isinstance(state, LoopReport):
        assert board.more() is None
        state = board.state()
    assert isinstance(state, LoopState)
    half = board.more()
    assert isinstance(half, LoopTurn)
    assert board.more() is None
    assert half.sequence == state.sequence
    assert half.torque == pytest.approx(board.torque)
    x, y, z = half.rotation
    assert twist_of(quaternion_exp((x, y, z)), board.turn) < 1e-6


@pytest.mark.parametrize(("speed", "lag"), [(3.0, (0.0, 5e-3)), (0.0, (0.02, 0.04))])
def test_a_tool_turns_on_as_it_is_shown(
    library: ctypes.CDLL, speed: float, lag: tuple[float, float]
) -> None:
    """The hand turns at 3 rad/s, and the tool with it, or only from show to show."""
    board, torques = at_a_stop(library), []
    for sequence in range(22, 42):
        tool = ShownTool(
            (0.0,) * 3,
            (0.0,) * 3,
            rotation=quaternion_log(canonical(tuple(board.turn))),
            angular_velocity=(0.0, speed, 0.0),
        )
        assert board.send(*show_frames(sequence, tool, 50, is_posed=True))
        for _ in range(10):
            board.turn = turned_by((0.0, 3.0 * PERIOD, 0.0), board.turn)
            board.run(1)
            torques.append(float(np.linalg.norm(board.torque)))
    assert lag[0] < max(torques[50:]) < lag[1]


def test_frames_of_another_loop_and_broken_rotations_are_dropped(library: ctypes.CDLL) -> None:
    tool = ShownTool((0.0,) * 3, (0.0,) * 3, rotation=(0.3, -0.2, 0.1))
    lines, poses = at_a_wall(library), at_a_stop(library)
    assert not lines.send(*show_frames(22, tool, 50, is_posed=True))
    assert not poses.send(*show_frames(22, tool, 50))
    for rotation in ((math.nan, 0.0, 0.0), (0.0, math.inf, 0.0)):
        broken = tool._replace(rotation=rotation)
        assert not poses.send(*show_frames(22, broken, 50, is_posed=True))
    for name in ("rotational_stiffness", "rotational_damping", "torque_level"):
        for number in (math.inf, math.nan, -1e-3, 2e9):
            assert not poses.send(setting_frame(22, SETTING._replace(**{name: number})))
    poses.run(10)
    assert poses.torque[2] == pytest.approx(5e-3 * ROTATIONAL_STIFFNESS, abs=1e-4)
    far = tool._replace(velocity=(1e3, -1e3, 0.0), angular_velocity=(1e3, 0.0, -1e3))
    assert poses.send(*show_frames(22, far, 50, is_posed=True))  # more than 16 bits hold
    # and it follows forces of a host that shows no tool
    assert poses.send(force_frame(23, (0.5, 0.0, 0.0, 0.0, 0.02, 0.0), 20))
    poses.run(1)
    assert (poses.force[0], poses.torque[1]) == pytest.approx((0.5, 0.02))
    poses.run(200)
    assert np.all(poses.force == 0.0)
    assert np.all(poses.torque == 0.0)


def test_an_overtaken_or_damaged_tool_is_dropped(library: ctypes.CDLL) -> None:
    board = at_a_wall(library)
    for sequence in (21, 20, 65000):
        assert not board.send(*show_frames(sequence, ShownTool((0.01, 0.0, 0.0)), 50))
    assert not board.send(*show_frames(22, ShownTool((math.nan, 0.0, 0.0)), 50))
    frame = bytearray(show_frames(22, ShownTool((0.01, 0.0, 0.0)), 50)[0])
    frame[9] ^= 1
    assert not board.send(bytes(frame))
    for name in ("stiffness", "damping", "level", "passing", "fade"):
        for number in (math.inf, math.nan, -1e-3, 2e9):
            assert not board.send(setting_frame(22, SETTING._replace(**{name: number})))
    board.run(10)
    assert board.force == pytest.approx([1.0, 0.0, 0.0], rel=0.01)


def test_a_fault_a_force_frame_and_silence_end_the_loops_force(library: ctypes.CDLL) -> None:
    for status in (Status.FAULT, Status.NOT_READY):
        board = at_a_wall(library)
        board.status = int(status)
        assert board.state().status & status
        board.run(1)
        assert np.all(board.force == 0.0)
        board.status = 0
        board.state()
        board.position = np.array([-0.01, 0.0, 0.0])  # stretched without a force
        board.run(5)
        assert np.all(board.force == 0.0)
        board.send(*show_frames(22, ShownTool((0.0,) * 3), 50))
        board.run(1)
        assert np.linalg.norm(board.force) < 0.6  # and the spring begins where the hand is
    board = at_a_wall(library)
    board.send(force_frame(1, (0.5, 0.0, 0.0, 0.0, 0.0, 0.0), 20))
    board.run(1)
    assert board.force == pytest.approx([0.5, 0.0, 0.0])
    board.run(200)
    assert np.all(board.force == 0.0)
    board = at_a_wall(library)
    board.run(515)
    assert np.all(board.force == 0.0)
    board.run(3, pace_us=400)
    counters = [board.state() for _ in range(40)]
    assert max(each.missed for each in counters if isinstance(each, LoopReport)) == 9


# On the processors of boards


@pytest.mark.skipif(bool(missing()), reason=missing())
@pytest.mark.parametrize("core", CORES)
def test_a_board_computes_the_same_bits_in_time(core: str, tmp_path: Path) -> None:
    emulated = computed_on(core, tmp_path)
    assert emulated | computed_here(tmp_path) == emulated
    for loop, limit in MOST.items():
        mean, most = (emulated[f"{loop}: instructions, {name}"] for name in ("mean", "most"))
        assert 100 < mean < most <= limit
        assert emulated[f"{loop}: held back"] > 100
        flash, memory = memory_on(core, tmp_path, loop)
        assert 4000 < flash < (16_000 if loop == "lines" else 20_000)
        assert 300 < memory < 4000


@pytest.mark.skipif(bool(missing()), reason=missing())
def test_the_guides_command_compiles_the_protocol(tmp_path: Path) -> None:
    (command,) = re.findall(r"^arm-none-eabi-g.*$", page("stiff-device"), re.MULTILINE)
    words = [*shlex.split(command), "-o", str(tmp_path / "protocol.o")]
    subprocess.run(words, check=True, cwd=FIRMWARE)
    assert (tmp_path / "protocol.o").stat().st_size > 1000


def test_the_script_says_what_to_install_where_a_tool_is_missing(tmp_path: Path) -> None:
    script = HERE.parent / "scripts" / "test_firmware"
    empty = {"PATH": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, str(script)], check=False, capture_output=True, text=True, env=empty
    )
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "on Debian: apt install g++ gcc-arm-none-eabi" in done.stderr


def test_a_force_frame_ends_a_setting_too(library: ctypes.CDLL) -> None:
    """A later host's tool has no force until this host has told its own coupling."""
    board = at_a_wall(library)
    assert np.linalg.norm(board.force) > 0.5
    assert board.send(force_frame(22, (0.0,) * 6, 50))
    board.run(1)
    for sequence in range(23, 43):
        board.position -= [1e-5, 0.0, 0.0]
        assert board.send(*show_frames(sequence, ShownTool((0.0,) * 3, None, 0.0, WALL), 50))
        board.run(10)
    assert np.linalg.norm(board.force) == 0.0
    assert board.send(setting_frame(43, SETTING))
    board.run(20)
    board.position -= [5e-5, 0.0, 0.0]
    board.run(20)
    assert np.linalg.norm(board.force) > 0.5


def test_a_position_that_is_no_place_is_told_as_an_encoders_fault(library: ctypes.CDLL) -> None:
    for status in (0, Status.FAULT | 64):
        board = at_a_wall(library)
        board.position, board.status = np.full(3, np.nan), int(status)
        board.run(1)
        told = next(each for each in (board.state(), board.state()) if isinstance(each, LoopState))
        assert told.status & Status.FAULT
        assert told.status & Status.CAUSE == (64 if status else 128)


@pytest.mark.parametrize(("pace_us", "missed"), [(100, 0), (101, 0), (110, 90), (200, 990)])
def test_a_slow_timer_misses_periods(library: ctypes.CDLL, pace_us: int, missed: int) -> None:
    board = at_a_wall(library)
    for _ in range(40):
        board.send(*show_frames(22, ShownTool((0.0,) * 3), 1000))
        board.run(25, pace_us)
        state = board.state()
    found = [each for _ in range(40) if isinstance(each := board.state(), LoopReport)]
    assert state is not None
    assert found[-1].missed == pytest.approx(missed, abs=0.03 * missed + 1)


def test_gains_on_their_way_ask_no_more_of_a_device_than_their_ends(library: ctypes.CDLL) -> None:
    """A hand that swings from period to period feels K T/2 + B of them at once."""
    bound, swing = 1.0, 1e-6
    loop = Loop(library, stiffness=2.0 * bound / PERIOD, damping=0.0, fade=200 * PERIOD)
    loop.show((0.0, 0.0, 0.0))

    def demands(periods: int) -> list[float]:
        found = []
        for tick in range(periods):
            sign = 1.0 if tick % 2 else -1.0
            force = loop.tick(np.array([sign * swing, 0.0, 0.0]))
            found.append(-sign * float(force[0]) * PERIOD / (2.0 * swing))
        return found

    assert demands(1000)[-1] == pytest.approx(bound, rel=1e-3)
    loop.set(stiffness=0.0, damping=bound)
    found = demands(1000)
    assert max(found) < 1.001 * bound
    assert found[-1] == pytest.approx(bound, rel=1e-3)


def test_a_lost_frame_makes_no_energy_of_another_scenes_work(library: ctypes.CDLL) -> None:
    """The scene of the last run took 5 mJ; this one took none, and its first tool was lost."""
    board = Board(library)
    assert board.send(setting_frame(1, SETTING))
    for sequence, work in ((2, 0.0), (3, 5e-3)):
        assert board.send(*show_frames(sequence, ShownTool((0.0,) * 3, None, work), 50))
        board.run(20)
    assert board.send(force_frame(4, (0.0,) * 6, 50))
    board.run(1)
    assert board.send(setting_frame(6, SETTING))
    for sequence in (7, 8):
        assert board.send(*show_frames(sequence, ShownTool((0.0,) * 3), 50))
        board.run(1)
    assert board.state().tank <= 0.0
