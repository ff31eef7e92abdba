"""The loop on a device's own board: its law, its account under attack, and its instructions."""

from __future__ import annotations

import ctypes
import math
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from board_attack import built_loop, floats, gained
from board_processors import CORES, MOST, computed_here, computed_on, memory_on, missing
from firmware_build import COMPILER, FIRMWARE
from numpy.typing import NDArray

from hapticbridge.cli.guide import page
from hapticbridge.coupling import Coupling
from hapticbridge.demand.methods import method_named, prepare
from hapticbridge.device.own_loop import (
    SURFACES,
    BoardSetting,
    LoopReport,
    LoopState,
    ShownTool,
)
from hapticbridge.device.rawhid.protocol import (
    Status,
    ask_frame,
    decoded,
    force_frame,
    setting_frame,
    show_frames,
)
from hapticbridge.kernel.parameters import GuardParameters, RunParameters
from hapticbridge.kernel.record import POST_DTYPE, SAMPLE_DTYPE
from hapticbridge.kernel.state import BoundKernel
from hapticbridge.kernel.tick import posted_tick
from hapticbridge.run.endpoint import posted_scene

HERE = Path(__file__).parent

PERIOD, STIFFNESS, DAMPING, LEVEL, CREDIT = 1e-4, 20e3, 0.5, 5.0, 0.01

pytestmark = pytest.mark.skipif(
    COMPILER is None, reason="neither g++ nor clang++ is here to compile the firmware with"
)


@pytest.fixture(scope="module", name="library")
def _library(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    return built_loop(tmp_path_factory.mktemp("board"))


class Loop:
    """The firmware's loop.

    Attributes:
        passed, tank: Σ P and D in J.
        share: Share of the gains in force.
        tool: Position of the shown tool in m.
    """

    def __init__(self, library: ctypes.CDLL, period: float = PERIOD, **changes: float) -> None:
        self._library = library
        self._loop = ctypes.c_void_p(library.loop_new(period))
        self._setting: dict[str, float] = {
            "stiffness": STIFFNESS,
            "damping": DAMPING,
            "level": LEVEL,
            "credit": CREDIT,
            "passing": 0.0,
            "fade": period,
            "patience": 1e3,
        }
        self._setting |= changes
        self.set()
        self.tool, self.passed, self.tank, self.share = np.zeros(3), 0.0, 0.0, 0.0

    def set(self, *, is_enabled: bool = True, **changes: float) -> None:
        self._setting |= changes
        self._library.loop_set(self._loop, floats(list(self._setting.values())), int(is_enabled))

    def show(self, position: Any, velocity: Any = None, **others: Any) -> None:
        """Shows the tool; ``surfaces`` are normals and gaps, ``work`` is W in J."""
        numbers = np.zeros(6 + 4 * SURFACES)
        surfaces = others.get("surfaces", ())
        numbers[:3], numbers[3:6] = position, 0.0 if velocity is None else velocity
        for k, (normal, gap) in enumerate(surfaces):
            numbers[6 + 4 * k : 10 + 4 * k] = *normal, gap
        self._library.loop_show(
            self._loop,
            floats(numbers),
            ctypes.c_double(others.get("work", 0.0)),
            len(surfaces),
            int(velocity is not None),
            int(others.get("is_placed", False)),
        )

    def tick(self, position: Any) -> NDArray[np.float64]:
        """Runs one period; returns the force on the device in N."""
        force, works, poses = np.zeros(3, np.float32), np.zeros(5), np.zeros(6, np.float32)
        self._library.loop_tick(self._loop, floats(position), floats(force))
        doubles = works.ctypes.data_as(ctypes.POINTER(ctypes.c_double))
        self._library.loop_report(self._loop, doubles, floats(poses))
        self.passed, self.tank, _, _, self.share = works
        self.tool = poses[3:].astype(np.float64)
        return force.astype(np.float64)


def test_the_constants_are_those_of_the_host() -> None:
    script = HERE.parent / "scripts" / "make_firmware_constants.py"
    subprocess.run([sys.executable, str(script), "--check"], check=True)


# The law is that of the kernel


def kernel() -> BoundKernel:
    """The loop of another program's scene, at the board's period and gains."""
    scene, method = posted_scene(CREDIT), method_named("implicit")
    coupling = Coupling(STIFFNESS, DAMPING, 1e-6, 0.0)
    prepare(scene, coupling, PERIOD, 1, method, warns=False)
    start = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    return BoundKernel(
        scene.model,
        scene.data,
        RunParameters(
            grip=scene.grip,
            period=PERIOD,
            substeps=1,
            coupling=method.law_coupling(coupling, PERIOD),
            force_limit=LEVEL,
            torque_limit=1.0,
            ramp_ticks=1,
            device_origin=start,
            handle_origin=scene.grip_pose(),
            device_start=start,
            scheme=method.scheme,
            scene_ticks=20,
            credit=CREDIT,
            guarding=GuardParameters(fade_ticks=1),
        ),
    )


def shown_at_random(rng: np.random.Generator, hand: NDArray[np.float64]) -> NDArray[np.void]:
    """Returns a tool near the hand, in numbers of single precision."""
    post = np.zeros(1, POST_DTYPE)
    count, has_velocity = int(rng.integers(SURFACES + 1)), rng.random() < 0.5
    normals = rng.standard_normal((SURFACES, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    post["pose"][0, :3], post["pose"][0, 3] = hand + 3e-5 * rng.standard_normal(3), 1.0
    post["has_velocity"], post["planes"] = has_velocity, count
    post["velocity"][0, :3] = has_velocity * 0.05 * rng.standard_normal(3)
    post["normals"][0, : 3 * SURFACES] = normals.ravel()
    post["gaps"][0, :SURFACES] = np.abs(1e-5 * rng.standard_normal(SURFACES))
    for name in ("pose", "velocity", "normals", "gaps"):
        post[name] = post[name].astype(np.float32)
    return post


def show(loop: Loop, post: NDArray[np.void]) -> None:
    count, own = int(post["planes"][0]), post[0]
    surfaces = [(own["normals"][3 * k : 3 * k + 3], own["gaps"][k]) for k in range(count)]
    velocity = own["velocity"][:3] if own["has_velocity"] else None
    loop.show(own["pose"][:3], velocity, surfaces=surfaces, work=float(own["work"]))


@pytest.mark.parametrize("seed", range(4))
def test_each_period_is_that_of_the_kernel(library: ctypes.CDLL, seed: int) -> None:
    rng, bound = np.random.default_rng(seed), kernel()
    state, row, sample = bound.state, bound.row, np.zeros(1, SAMPLE_DTYPE)
    sample["quaternion"][0, 0] = 1.0
    loop = Loop(library, passing=float(state["shown"]["passing"][0]))
    hand, velocity, due = np.zeros(3), np.zeros(3), 0
    kinds, work = np.zeros(2, np.int64), 0.0
    for tick in range(3000):
        post = np.zeros(0, POST_DTYPE)
        if tick > 5:
            velocity += 0.02 * rng.standard_normal(3) - 0.01 * velocity
            hand = (hand + PERIOD * velocity).astype(np.float32).astype(np.float64)
            # one period from the same state: where the tank is nearly empty, paths differ by more
            state["pose"]["tool_position"][0], state["shown"]["tank"] = loop.tool, loop.tank
        if tick >= due:
            due, post = tick + int(rng.integers(5, 40)), shown_at_random(rng, hand)
            if tick == 0:
                post["pose"][0, :3], post["has_velocity"], post["planes"] = 0.0, 0, 0
            work += 1e-6 * rng.random() * (tick > 0)
            post["work"] = work
            show(loop, post)
        sample["position"][0] = hand
        held_back, before = int(state["shown"]["held_back"][0]), loop.passed
        assert posted_tick(state, sample, post, row, PERIOD)
        force = loop.tick(hand)
        if tick <= 5:
            continue
        is_paid = int(state["shown"]["held_back"][0]) == held_back
        kinds[int(is_paid)] += 1
        given = float(state["shown"]["work"][0])
        if is_paid:
            assert force == pytest.approx(row["wrench_on_device"][0, :3], abs=1e-3)
            assert loop.tool == pytest.approx(row["tool_position"][0], abs=5e-8)
            assert loop.passed - before == pytest.approx(given, abs=LEVEL * 2e-8)
        else:  # both search the largest motion that is paid for
            assert loop.tank >= -1e-11 - max(work, 0.0)
    assert kinds.min() > 100


# The account: a hand that may choose every motion, and a host that shows anything


def test_no_hand_gets_more_than_the_credit(library: ctypes.CDLL) -> None:
    assert max(gained(library, seed) for seed in range(100)) < 1e-6


@pytest.mark.parametrize("change", [{"trust": 1.0}, {"damping_share": 0.5, "step": 0.0}])
def test_without_tank_or_damping_hands_are_seen_to_gain(
    library: ctypes.CDLL, change: dict[str, float]
) -> None:
    assert max(gained(library, seed, **change) for seed in range(100)) > 0.01


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


# Ends of the force


def pressed(library: ctypes.CDLL, **changes: float) -> Loop:
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
    """A board in virtual time, whose handle is where ``position`` says."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self._library, numbers = library, floats([2.0, 0.0, 0.0, 5.0, 5.0, 0.1, 1e-5])
        self._board = ctypes.c_void_p(library.board_new(0b111, ctypes.c_float(PERIOD), numbers))
        self.position, self.force, self.now = np.zeros(3), np.zeros(3), 0
        self.status = 0

    def send(self, *frames: bytes) -> bool:
        return all(self._library.board_receive(self._board, each, self.now) for each in frames)

    def run(self, periods: int, pace_us: int = 100) -> None:
        force = np.zeros(3, np.float32)
        for _ in range(periods):
            self.now += pace_us
            self._library.board_tick(self._board, floats(self.position), self.now, floats(force))
        self.force = force.astype(np.float64)

    def state(self) -> Any:
        frame = ctypes.create_string_buffer(64)
        own = self._board, floats(self.position), self.status, self.now, frame
        self._library.board_state(*own)
        return decoded(frame.raw)

    def numbers(self) -> Any:
        frame = ctypes.create_string_buffer(64)
        assert self.send(ask_frame(1, 0))
        assert self._library.board_answer(self._board, frame)
        return decoded(frame.raw)


SETTING = BoardSetting(STIFFNESS, DAMPING, LEVEL, 0.0, 10 * PERIOD, 1e-3)
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
    assert 100 < emulated["instructions, mean"] < emulated["instructions, most"] <= MOST
    flash, memory = memory_on(core, tmp_path)
    assert 4000 < flash < 16_000
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
