"""Map ``restitution``: which law of impact MuJoCo's contact resembles, and when it gains."""

from __future__ import annotations

import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from map_runs import NEVER, recorded_and_audited
from map_tables import Row, written

from hapticbridge.coupling import Coupling
from hapticbridge.device import Motion, TrajectoryDevice
from hapticbridge.errors import StudyError
from hapticbridge.lab.maps.base import Point, run_map, scene_of
from hapticbridge.lab.maps.restitution import (
    APPROACH,
    INERTIA,
    LENGTH,
    MASS,
    RESTITUTION,
    RESTITUTION_LAWS,
    ROD,
    SETTINGS,
    TIP,
    drop,
    evaluate,
    points,
    restitution_of,
)
from hapticbridge.scene import Scene
from hapticbridge.sweep.sweep import sweep
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


@given(
    angle=st.floats(0.1, 1.5),
    friction=st.floats(0.0, 1.0),
    slide=st.floats(-1.0, 1.0),
)
@settings(max_examples=60)
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


def falling_rod(setting: str, angle: float) -> Scene:
    """Loads the rod of the map just above the floor, sliding and falling, with a grip."""
    chosen = SETTINGS[setting]
    height = float(LENGTH / 2 * np.sin(angle) + TIP + APPROACH * chosen.timestep / 2)
    solref, impedance = (" ".join(map(repr, pair)) for pair in (chosen.solref, chosen.impedance))
    contact = f'<geom solref="{solref}" solimp="{impedance} 0.001" friction="0.75 0 0"/>'
    start = f'qpos="0 {height!r} {-angle!r}" qvel="0.8 {-APPROACH!r} 0"'
    text = ROD.replace("<worldbody>", f"<default>{contact}</default><worldbody>")
    text = text.replace("</body>", '<site name="grip"/></body>')
    return scene_of(
        text.replace("</mujoco>", f'<keyframe><key name="home" {start}/></keyframe></mujoco>')
    )


@pytest.mark.parametrize(
    ("setting", "angle", "verdict"),
    [
        ("hard spring", 1.2, "active"),
        ("hard spring", 1.3, "passive"),
        ("bouncy, implicitfast", 1.1, "active"),
        ("bouncy, implicitfast", 1.2, "passive"),
        ("scenes", 1.2, "passive"),
    ],
)
def test_the_audit_of_a_bridge_names_the_step_at_which_the_contact_gains(
    setting: str, angle: float, verdict: str, tmp_path: Path
) -> None:
    still = Motion([0.0, 1.0], np.zeros((2, 3)))
    device = TrajectoryDevice(still, force_limit=NEVER, torque_limit=NEVER, speed_limit=NEVER)
    weak = Coupling(1e-3, 0.0, 1e-3, 0.0)  # a hand that hardly holds: next to no slack
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*the contact of geom 'tip'")
        report = recorded_and_audited(
            falling_rod(setting, angle),
            device,
            weak,
            SETTINGS[setting].integrator.replace("discrete", "implicit"),
            SETTINGS[setting].timestep,
            100,
            tmp_path,
        )
    mapped = drop(setting, angle, 0.75, 0.8)
    assert report.resimulation == "bit for bit"
    assert report.verdict == verdict
    assert (mapped.energy_change > 0) == (verdict == "active")
    if verdict == "active":
        # steps are counted from 1, ticks from 0
        assert (report.tick, report.port) == (mapped.first_gain - 1, "environment")
    else:
        assert mapped.first_gain == -1


def dropped(setting: str, angle: float, **got: float) -> Row:
    """Returns a row in which MuJoCo is a little nearer to Newton than to the others."""
    point: Point = {"setting": setting, "friction": 0.75, "slide": 0.8, "angle": angle}
    usual: dict[str, float] = {
        "inelastic": -0.3,
        "newton": -0.19,
        "poisson": -0.2,
        "stronge": -0.25,
        "energy_change": -0.1,
        "restitution": 0.5,
        "own_restitution": 0.6,
        "first_gain": -1,
    }
    return point, usual | got


def test_a_law_is_named_only_with_a_lead_and_the_share_that_gained_is_counted() -> None:
    rows = [dropped("scenes", 0.1 + i, own_restitution=0.6 + 0.01 * i) for i in range(4)]
    rows += [dropped("hard spring", 0.1 + i, newton=-0.11) for i in range(3)]
    rows += [dropped("hard spring", 3.1, newton=-0.11, energy_change=-0.02, first_gain=4)]
    rows += [dropped("soft", 0.1, energy_change=-0.31), dropped("soft", 0.2, energy_change=0.04)]
    finding = RESTITUTION.read(written(rows))
    found = finding.boundary["settings"]
    assert found["scenes"]["nearest_law"] is None  # 0.09 against 0.10 is no lead
    assert found["scenes"]["restitution"] == 0.5
    assert found["scenes"]["largest_energy_change"] == -0.1
    assert found["scenes"]["largest_by_newton"] == -0.19
    assert found["scenes"]["rms_distance_to_law"] == pytest.approx(
        {"inelastic": 0.2, "newton": 0.09, "poisson": 0.1, "stronge": 0.15}
    )
    assert found["hard spring"]["nearest_law"] == "newton"
    assert found["hard spring"]["share_that_gained"] == 0.25
    assert found["scenes"]["share_that_gained"] == 0.0
    # √((0.01² + 0.34²)/2): the root of the mean of squares, not the mean of distances
    soft = found["soft"]
    assert soft["rms_distance_to_law"]["inelastic"] == pytest.approx(0.24052, rel=1e-4)
    assert "'hard spring' a rod that falls upright comes back with e = 0.5" in finding.paragraph
    assert soft["at_the_largest"] == {"angle": 0.2, "friction": 0.75, "slide": 0.8}


def test_the_map_says_what_its_table_holds(tmp_path: Path) -> None:
    with ThreadPoolExecutor(1) as executor:
        files = run_map(RESTITUTION, tmp_path, points=630, executor=executor)
    assert files.failed == 0
    by_setting = files.finding.boundary["settings"]
    assert by_setting["scenes"]["largest_energy_change"] < 0
    assert by_setting["hard spring"]["largest_energy_change"] > 0.1
    assert files.picture.stat().st_size > 10_000
