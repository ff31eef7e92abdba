"""Felt error against closed forms."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from outside_scenes import scene_file
from scipy.spatial.transform import Rotation

from hapticbridge.check.lean import find_lean
from hapticbridge.check.perception import LEVER, WEBER, felt_error
from hapticbridge.check.version import SceneVariant
from hapticbridge.coupling import Coupling
from hapticbridge.demand.pulse import FORCE_FLOOR
from hapticbridge.demand.rehearsal import RunPoint
from hapticbridge.device import Motion
from hapticbridge.errors import HapticBridgeError, SceneError
from hapticbridge.kernel.record import TICK_DTYPE
from hapticbridge.scene import read_scene

Array = NDArray[np.float64]


def records(force: Array, torque: Array | None = None) -> NDArray[np.void]:
    rows = np.zeros(len(force), TICK_DTYPE)
    rows["wrench_on_tool"][:, :3] = force
    rows["wrench_on_tool"][:, 3:] = 0.0 if torque is None else torque
    rows["tool_quaternion"][:, 0] = 1.0
    return rows


FORCES = np.random.default_rng(1).normal(0.0, 2.0, (500, 3))


def test_force_seven_percent_larger_is_one_just_noticeable_difference() -> None:
    felt = felt_error(records(FORCES), records(1.07 * FORCES))
    assert felt.jnd == pytest.approx(1.0, abs=1e-12)
    assert felt.force_rms == pytest.approx(0.07 * np.sqrt((FORCES**2).sum(axis=1).mean()))
    assert felt.force_peak == pytest.approx(0.07 * np.linalg.norm(FORCES, axis=1).max())


def test_spring_seven_percent_stiffer_is_one_just_noticeable_difference(tmp_path: Path) -> None:
    """Slowly, spring k behind coupling K is one of k K/(k + K): 7 % more of that is one JND."""
    coupling = Coupling(2400.0, 0.5, 2.4, 5e-4)
    series = 100.0 * 2400.0 / (100.0 + 2400.0)
    stiffer = WEBER * series + series
    stiffer = stiffer * 2400.0 / (2400.0 - stiffer)
    time = np.linspace(0.0, 3.0, 301)
    path = np.zeros((time.size, 3))
    path[:, 0] = 0.02 * (1 - np.cos(2 * np.pi * time / 3.0))
    done = []
    for stiffness in (100.0, stiffer):
        text = f"""<mujoco><option gravity="0 0 0"/><worldbody><body>
          <joint type="slide" axis="1 0 0" stiffness="{stiffness!r}"/>
          <geom size="0.01" mass="0.01"/><site name="grip"/></body></worldbody></mujoco>"""
        source = read_scene(scene_file(tmp_path, text))
        done.append(SceneVariant(source, "grip", RunPoint(coupling)).rehearsed(Motion(time, path)))
    felt = felt_error(done[0].records, done[1].records)
    # 10 g swing with 0.05 N at most beside 3.8 N, and damping adds as little
    assert felt.jnd == pytest.approx(1.0, abs=0.01)


def test_difference_below_the_absolute_threshold_is_not_felt_however_small_the_force() -> None:
    faint = np.full((100, 3), [1e-3, 0.0, 0.0])
    felt = felt_error(records(faint), records(faint + np.array([FORCE_FLOOR / 2, 0, 0])))
    assert felt.jnd == pytest.approx(0.5)
    assert felt.force_threshold == FORCE_FLOOR


def test_torque_counts_as_a_force_on_a_lever_until_it_is_large_itself() -> None:
    push = np.full((100, 3), [2.0, 0.0, 0.0])
    twist = np.array([0.0, 0.0, 1.0])
    arm = LEVER * WEBER * 2.0
    small = felt_error(records(push), records(push, np.full((100, 3), arm * twist)))
    assert small.jnd == small.torque == pytest.approx(1.0)
    assert small.force == 0.0
    before = np.full((100, 3), 0.5 * twist)
    large = felt_error(records(push, before), records(push, (1 + WEBER) * before))
    assert large.jnd == pytest.approx(1.0)
    assert large.torque_threshold == pytest.approx(WEBER * 0.5)


def test_pose_error_is_the_largest_distance_and_angle() -> None:
    first, second = records(FORCES), records(FORCES)
    second["tool_position"][7] = [3e-6, 0.0, 4e-6]
    turn = Rotation.from_rotvec([0.0, 2e-7, 0.0])
    start = Rotation.from_rotvec([0.3, 1.0, -0.5])
    first["tool_quaternion"] = start.as_quat(scalar_first=True)
    second["tool_quaternion"] = (turn * start).as_quat(scalar_first=True)
    second["tool_quaternion"][3] *= -1.0  # the same orientation
    felt = felt_error(first, second)
    assert felt.position_peak == pytest.approx(5e-6)
    assert felt.angle_peak == pytest.approx(2e-7, rel=1e-6)
    assert felt.jnd == 0.0


@pytest.mark.parametrize("count", [500, 501])
def test_half_the_rate_is_compared_at_common_times(count: int) -> None:
    forces = np.resize(FORCES, (count, 3))
    felt = felt_error(records(forces), records(forces[::2]))
    assert felt.force_peak == 0.0
    shifted = felt_error(records(forces), records(np.roll(forces, 1, axis=0)[::2]))
    assert shifted.force_peak > 0.0


def test_what_is_not_one_motion_and_bad_budgets_are_refused() -> None:
    rows = records(FORCES)
    for ticks, words in ((0, "nothing to compare"), (400, "500 and 400 ticks are not of the same")):
        with pytest.raises(SceneError, match=words):
            felt_error(rows, rows[:ticks])
    source, setting = read_scene("virtual_wall"), RunPoint(Coupling(2400.0, 0.5, 2.4, 5e-4))
    short, motion = (Motion(np.array([0.0, end]), np.zeros((2, 3))) for end in (1e-4, 1.0))
    with pytest.raises(SceneError, match="less than one tick"):
        find_lean(SceneVariant(source, "grip", setting), short)
    for budget in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(SceneError, match="budget"):
            find_lean(SceneVariant(source, "grip", setting), motion, budget=budget)
    with pytest.raises(HapticBridgeError, match="period"):
        find_lean(SceneVariant(source, "grip", replace(setting, period=-1.0)), motion)
