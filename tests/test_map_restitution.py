"""Map ``restitution``: which law of impact MuJoCo's contact resembles, and when it gains."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hapticbridge.errors import StudyError
from hapticbridge.mechanics import ImpactBody
from hapticbridge.study.maps.falling_rod import (
    APPROACH,
    INERTIA,
    LENGTH,
    MASS,
    TIP,
    drop,
    restitution_of,
)
from hapticbridge.study.maps.restitution import RESTITUTION, RESTITUTION_LAWS, evaluate, points
from hapticbridge.study.maps.stability_map import Point, run_map
from hapticbridge.study.sweep import sweep
from hapticbridge.study.table import Outcome, table_of

GAINING: Point = {
    "setting": "bouncy, implicitfast",
    "friction": 0.75,
    "slide": 0.8,
    "angle": np.pi / 4,
}


def test_upright_without_friction_all_laws_and_mujoco_agree() -> None:
    for setting in ("scenes", "bouncy", "hard spring"):
        found = evaluate({"setting": setting, "friction": 0.0, "slide": 0.0, "angle": np.pi / 2})
        e = restitution_of(setting)
        assert 0 < e < 1
        # a body hit through its centre keeps e² of its energy
        lost = -0.5 * MASS * APPROACH**2 * (1 - e**2)
        for name in ("energy_change", *RESTITUTION_LAWS):
            assert found[name] == pytest.approx(lost, abs=1e-9)


@given(
    angle=st.floats(0.1, 1.5),
    friction=st.floats(0.0, 1.0),
    slide=st.floats(-1.0, 1.0),
)
@settings(max_examples=60, deadline=None)
def test_the_contact_of_the_scenes_never_gains(angle: float, friction: float, slide: float) -> None:
    found = drop("scenes", angle, friction, slide)
    assert found.energy_change < 0
    assert found.first_gain == -1


def test_a_bouncy_contact_gains_where_the_laws_lose_and_its_twin_of_the_scenes_loses() -> None:
    found = evaluate(GAINING)
    assert float(found["energy_change"]) > 0.05
    # the meter names the step: during the rebound, before the contact ends
    assert 3 <= int(found["first_gain"]) < int(found["steps"])
    for law in ("inelastic", *RESTITUTION_LAWS):
        assert float(found[law]) < 0
    twin = evaluate(GAINING | {"setting": "scenes"})
    assert float(twin["energy_change"]) < -0.1
    assert twin["first_gain"] == -1


def test_a_tenth_of_the_step_does_not_mend_the_gain() -> None:
    fine = evaluate(GAINING | {"setting": "bouncy, implicitfast, 0.1 ms"})
    assert float(fine["energy_change"]) > 0.05


def test_mujocos_impulse_explains_the_velocity_it_leaves() -> None:
    angle, slide = 1.0, 0.8
    found = drop("hard spring", angle, 0.0, slide)
    arm = np.array([-LENGTH / 2 * np.cos(angle), -LENGTH / 2 * np.sin(angle) - TIP])
    _, d, g = ImpactBody(MASS, INERTIA, arm).compliance()
    # without friction P_t = 0: Δv_n = D P_n and Δv_t = −G P_n; the rod turns by 1 % meanwhile
    normal = (found.velocity[1] + APPROACH) / d
    assert found.velocity[0] - slide == pytest.approx(-g * normal, rel=0.05)
    change = 0.5 * normal * (-APPROACH + found.velocity[1])
    assert found.energy_change == pytest.approx(float(change), rel=0.05)


def test_mujoco_keeps_the_normal_velocity_as_newton_does() -> None:
    # e of a slanted rod with friction is that of an upright one without: Newton's definition
    found = evaluate(GAINING)
    assert found["own_restitution"] == pytest.approx(found["restitution"], rel=0.03)


def test_newtons_law_is_the_nearest_to_what_rebounds() -> None:
    chosen = [p for p in points(1200) if p["setting"] == "bouncy, implicitfast"]
    with ThreadPoolExecutor(1) as executor:
        table = sweep(evaluate, chosen, executor=executor)
    away = {
        law: float(np.sqrt(np.mean((table["energy_change"] - table[law]) ** 2)))
        for law in ("inelastic", *RESTITUTION_LAWS)
    }
    assert min(away, key=away.__getitem__) == "newton"
    assert away["newton"] < 0.7 * away["stronge"]


def test_an_unknown_setting_is_refused_with_the_choices() -> None:
    with pytest.raises(StudyError, match=r"'rubber'.*hard spring"):
        drop("rubber", 1.0, 0.5, 0.0)


def test_a_law_is_named_only_with_a_lead_and_the_share_that_gained_is_counted() -> None:
    given: list[Point] = []
    done = []
    for setting, newton, first_gain in (("scenes", -0.19, -1), ("hard spring", -0.11, 4)):
        for row in range(4):
            given.append({"setting": setting, "friction": 0.75, "slide": 0.8, "angle": 0.1 + row})
            values = {"inelastic": -0.3, "newton": newton, "poisson": -0.2, "stronge": -0.25}
            done.append(
                Outcome(
                    values
                    | {
                        "energy_change": -0.1,
                        "restitution": 0.5,
                        "own_restitution": 0.6 + 0.01 * row,
                        "first_gain": first_gain if row == 0 else -1,
                    }
                )
            )
    finding = RESTITUTION.read(table_of(given, done))
    found = finding.boundary["settings"]
    assert found["scenes"]["nearest_law"] is None  # 0.09 against 0.10 is no lead
    assert found["hard spring"]["nearest_law"] == "newton"
    assert found["hard spring"]["share_that_gained"] == 0.25
    assert found["scenes"]["share_that_gained"] == 0.0
    assert "nearest by more than 20 % is none in 1, Newton in 1" in finding.paragraph
    assert "largest e of a slanted rod is 0.63" in finding.paragraph
    assert "by -0.11 J at most, with 'hard spring'" in finding.paragraph


def test_the_map_says_what_its_table_holds(tmp_path: Path) -> None:
    with ThreadPoolExecutor(1) as executor:
        files = run_map(RESTITUTION, tmp_path, points=630, executor=executor)
    assert files.failed == 0
    by_setting = files.finding.boundary["settings"]
    assert by_setting["scenes"]["largest_energy_change"] < 0
    assert by_setting["hard spring"]["largest_energy_change"] > 0.1
    assert "'hard spring' up to +" in files.finding.paragraph
    assert files.picture.stat().st_size > 10_000
