"""Map ``restitution``: which law of impact MuJoCo's contact resembles, and when it gains."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from map_runs import boundary_of

from hapticbridge.lab.maps import restitution
from hapticbridge.lab.maps.base import Point
from hapticbridge.lab.maps.restitution import (
    APPROACH,
    INERTIA,
    LENGTH,
    MASS,
    RESTITUTION_LAWS,
    TIP,
    drop,
    evaluate,
    points,
    restitution_of,
)
from hapticbridge.sweep import sweep
from hapticbridge.theory.impact import ImpactBody

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


@given(angle=st.floats(0.1, 1.5), friction=st.floats(0.0, 1.0), slide=st.floats(-1.0, 1.0))
@settings(max_examples=60)
def test_the_contact_of_the_scenes_never_gains(angle: float, friction: float, slide: float) -> None:
    found = drop("scenes", angle, friction, slide)
    assert found.energy_change < 0
    assert found.first_gain == -1


def test_a_bouncy_contact_gains_where_the_laws_lose() -> None:
    found = evaluate(GAINING)
    assert float(found["energy_change"]) > 0.05
    # the meter names the step: during the rebound, before the contact ends
    assert 3 <= int(found["first_gain"]) < int(found["steps"])
    for law in ("inelastic", *RESTITUTION_LAWS):
        assert float(found[law]) < 0


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
        table = sweep(evaluate, chosen, workers=executor)
    away = {
        law: float(np.sqrt(np.mean((table["energy_change"] - table[law]) ** 2)))
        for law in ("inelastic", *RESTITUTION_LAWS)
    }
    assert min(away, key=away.__getitem__) == "newton"
    assert away["newton"] < 0.7 * away["stronge"]


def test_the_map_says_what_its_table_holds(tmp_path: Path) -> None:
    boundary = boundary_of(restitution, tmp_path, 630)
    by_setting = boundary["settings"]
    assert by_setting["scenes"]["largest_energy_change"] < 0
    assert by_setting["hard spring"]["largest_energy_change"] > 0.1
