"""Map ``rotation``: spinning tools, and the cut at π."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from map_runs import boundary_of

from hapticbridge.lab.maps import rotation
from hapticbridge.lab.maps.base import Point

SOFT = 2.0


def cell(method: str, speed: float, angle: float = 0.5) -> Point:
    """Returns a point of the grid."""
    return {
        "what": "cell",
        "method": method,
        "rotational_stiffness": SOFT,
        "speed": speed,
        "angle": angle,
    }


def test_slow_tools_are_strict_under_implicit_and_active_under_implicitfast() -> None:
    safe = rotation.evaluate(cell("implicit", 20.0))
    assert safe["environment"] == "strict"
    assert safe["first_active"] == -1
    active = rotation.evaluate(cell("implicitfast", 20.0))
    assert active["environment"] == "active"
    assert float(active["created"]) > 0.1
    assert 0 <= int(active["first_active"]) < rotation.TICKS


@pytest.mark.parametrize("method", ["implicit", "lossless"])
@pytest.mark.parametrize("stiffness", [0.0, SOFT, 10 * SOFT])
def test_tools_are_strict_below_and_beyond_the_gyroscopic_speed(
    method: str, stiffness: float
) -> None:
    # |ω × Iω| = π K_r at √(2π K_r/(I_z − I_x)) = 64.4 rad/s
    assert rotation.gyroscopic_speed(SOFT) == pytest.approx(64.40, abs=0.01)
    for speed in (0.85 * rotation.gyroscopic_speed(SOFT), 1.25 * rotation.gyroscopic_speed(SOFT)):
        found = rotation.spin(method, rotation.coupling_of(stiffness), speed, angle=1.5)
        assert (found.ticks, found.environment) == (rotation.TICKS, "strict")


def test_a_very_fast_tool_diverges_uncorrected_before_mujoco_gives_up() -> None:
    coupling = rotation.coupling_of(SOFT)
    found = rotation.spin(rotation.UNCORRECTED, coupling, 200.0, angle=1.0)
    assert found.ticks < rotation.TICKS
    assert 100 < found.created < 1e5  # ended by the loop, not by numbers that are not finite
    kept = rotation.spin("implicit", coupling, 200.0, angle=1.0)
    assert (kept.ticks, kept.environment) == (rotation.TICKS, "strict")


def test_with_the_translation_alone_the_gyroscopic_term_creates_what_theory_says() -> None:
    for speed in (2.0, 10.0, 20.0):
        found = rotation.spin(rotation.UNCORRECTED, rotation.coupling_of(0.0), speed)
        assert found.created == pytest.approx(rotation.free_creation(speed), rel=0.03)


def test_a_sudden_turn_passes_the_cut_at_the_predicted_speed() -> None:
    # π √(K_r/I_y) = 73.74 rad/s without damping; B_r and the numerical damping oppose by < 2 %
    assert rotation.cut_speed(SOFT) == pytest.approx(73.74, abs=0.01)
    assert rotation.speed_of_cut("implicit", SOFT) == pytest.approx(
        rotation.cut_speed(SOFT), rel=0.02
    )


def test_at_the_cut_the_torque_flips_by_twice_pi_stiffness_in_one_tick() -> None:
    passed = rotation.sudden("implicit", SOFT, 1.1 * rotation.cut_speed(SOFT))
    assert passed.crossed > 0
    assert passed.torque_jump == pytest.approx(2 * np.pi * SOFT, rel=0.03)
    short = rotation.sudden("implicit", SOFT, 0.9 * rotation.cut_speed(SOFT))
    assert short.crossed == -1
    assert short.torque_jump < 0.02 * passed.torque_jump
    # within the tick the tool follows by ω T = 0.066 rad: so much less than the spring was wound to
    assert short.largest_angle == pytest.approx(0.9 * np.pi, abs=0.08)
    assert short.largest_angle < 0.9 * np.pi


def test_the_map_says_what_its_table_holds(tmp_path: Path) -> None:
    boundary = boundary_of(rotation, tmp_path, 20)
    assert boundary["fastest_passive"]["implicit"] > 0
    assert boundary["fastest_passive"]["explicit"] is None
    assert boundary["cut"]["speed_measured"] == pytest.approx(rotation.cut_speed(SOFT), rel=0.02)
