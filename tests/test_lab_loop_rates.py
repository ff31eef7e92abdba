"""Chart of loops on the computer and on the board: its stiffness, its tap, its picture."""

from __future__ import annotations

import ctypes
import math
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from board_attack import built_loop, floats
from firmware_build import COMPILER

from hapticbridge.coupling import Coupling
from hapticbridge.lab.loop_rates import (
    DEVICE,
    IDEAL,
    LOOPS,
    SPEED,
    STEP,
    Loop,
    draw,
    felt,
    tap,
    wall,
)
from hapticbridge.plotting import write_picture

EXACT = replace(DEVICE, resolution=0.0)
BARE = replace(EXACT, damping=0.0, friction=0.0)
IDEAL_WALL = partial(wall, Coupling(IDEAL, 0.0, 0.0, 0.0), STEP)


def test_a_bare_tap_is_half_a_swing_of_mass_and_spring() -> None:
    force = tap(BARE, IDEAL_WALL(), STEP, 0.0)
    mass = BARE.mass or 0.0
    assert force.max() == pytest.approx(SPEED * math.sqrt(mass * IDEAL), rel=1e-3)
    assert STEP * np.count_nonzero(force) == pytest.approx(
        math.pi * math.sqrt(mass / IDEAL), rel=2e-3
    )
    # it leaves as fast as it came, and slower with damping and friction
    assert STEP * force.sum() == pytest.approx(2.0 * mass * SPEED, rel=1e-3)
    damped = tap(EXACT, IDEAL_WALL(), STEP, 0.0)
    assert damped.max() < 0.97 * force.max()


@pytest.mark.parametrize("loop", [loop for loop in LOOPS if loop.place == "board"])
def test_the_board_gets_85_per_cent_of_what_damping_and_friction_bear(loop: Loop) -> None:
    by_damping = 2.0 / (0.5 / loop.rate + 1.5 * 10e-6)
    by_steps = 2.0 * 0.1 / 10e-6
    assert loop.coupling(EXACT).stiffness == pytest.approx(0.85 * by_damping)
    assert loop.coupling(DEVICE).stiffness == pytest.approx(0.85 * min(by_damping, by_steps))
    assert loop.coupling(DEVICE).damping == 0.0


def test_a_late_or_slow_loop_gives_energy_where_the_certified_one_does_not() -> None:
    mass = EXACT.mass or 0.0
    for loop in LOOPS:
        law, period = loop.coupling(EXACT), 1.0 / loop.rate
        passed = STEP * tap(EXACT, wall(law, period), period, loop.delay).sum()
        assert passed < 2.0 * mass * SPEED
        stiffer = replace(law, stiffness=5.0 * law.stiffness)
        gained = STEP * tap(BARE, wall(stiffer, period), period, loop.delay).sum()
        assert gained > 2.0 * mass * SPEED


@pytest.mark.skipif(COMPILER is None, reason="neither g++ nor clang++ is here")
@pytest.mark.parametrize("rate", [4e3, 20e3])
def test_a_tap_on_the_firmwares_loop_has_the_force_of_the_chart(
    tmp_path: Path, rate: float
) -> None:
    own, period = Loop("board", rate), 1.0 / rate
    law = own.coupling(DEVICE)
    library = built_loop(tmp_path)
    board = ctypes.c_void_p(library.loop_new(ctypes.c_float(period), 0))
    # K, B', level, credit, energy under way, fade, patience, and gains of rotations
    setting = [law.stiffness, 0.0, 20.0, 0.0, 1.0, period, 1.0, 0.0, 0.0, 0.0]
    library.loop_set(board, floats(setting), 1)
    shown = [0.0] * 13 + [1.0, 0.0, 0.0, 0.0] + [0.0] * 8
    library.loop_show(board, floats(shown), ctypes.c_double(0.0), 1, 1, 0)
    force = np.zeros(3, np.float32)

    def rendered(position: float) -> float:
        library.loop_tick(board, floats([position, 0.0, 0.0]), floats(force))
        return max(float(force[0]), 0.0)  # the tool stays at the wall, and no wall pulls

    for _ in range(3):  # the fade
        assert rendered(0.0) == 0.0
    found = tap(DEVICE, rendered, period, own.delay)
    expected = tap(DEVICE, wall(law, period), period, own.delay)
    assert expected.max() > 6.0
    assert found == pytest.approx(expected, abs=1e-3)


def test_a_tap_feels_better_on_the_board_and_steps_limit_it() -> None:
    errors = [felt(DEVICE, loop) for loop in LOOPS]
    exact = [felt(EXACT, loop) for loop in LOOPS]
    assert errors[0] > 14.0
    assert errors[3] < 10.0
    assert errors[4] > 5.0
    assert exact[4] < 1.0
    assert all(after < before + 0.1 for before, after in pairwise(exact))


def test_the_picture_is_small(tmp_path: Path) -> None:
    write_picture(draw(), tmp_path / "loops.png")
    assert 10_000 < (tmp_path / "loops.png").stat().st_size < 300_000
