"""The rule for contact settings: its numbers, its grades, its sentences, and the shipped scenes."""

from __future__ import annotations

import math
import warnings
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hapticbridge.errors import SceneError
from hapticbridge.scene import load_scene, scene_names
from hapticbridge.scene.contact_check import check_contacts
from hapticbridge.scene.contact_rule import (
    SUGGESTED,
    contact_concerns,
    contact_numbers,
    suggested_solref,
)

H = 1e-3
SOLIMP = (0.9, 0.95, 0.001)
GRADES = ("active", "within slack", "strict")

SCENE = """
<mujoco>
  <option timestep="0.001" integrator="discrete" cone="{cone}" gravity="0 0 0">
    <flag diagexact="enable"/>
  </option>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 0.1" pos="0 0 -0.1" {floor}/>
    <body name="tool">
      <freejoint/>
      <geom name="tip" type="sphere" size="0.01" mass="0.1" {tip}/>
      <site name="grip"/>
    </body>
  </worldbody>
  {more}
</mujoco>
"""
GOOD = 'solref="0.002 1"'
HARD = 'solref="-1000000 -500"'


def scene(folder: Path, *, floor: str, tip: str, more: str = "", cone: str = "elliptic") -> Path:
    path = folder / "scene.xml"
    path.write_text(SCENE.format(floor=floor, tip=tip, more=more, cone=cone))
    return path


def test_shipped_setting_relaxes_within_four_steps_and_is_within_the_slack() -> None:
    numbers = contact_numbers((0.002, 1.0), SOLIMP, H)
    assert numbers.relaxation == pytest.approx(4)
    assert numbers.resolved == pytest.approx(2)
    assert numbers.stiffness == pytest.approx(9 / 4)
    assert numbers.grade == "within slack"
    assert contact_concerns((0.002, 1.0), SOLIMP, H) == []


@given(st.floats(1e-5, 0.1), st.floats(0.05, 100), st.floats(1e-4, 1e-2), st.floats(0.01, 0.999))
def test_both_formats_of_one_spring_and_damper_have_the_same_numbers(
    timeconst: float, ratio: float, timestep: float, impedance: float
) -> None:
    direct = (-1 / (timeconst * ratio) ** 2, -2 / timeconst)
    one = contact_numbers((timeconst, ratio), (impedance,), timestep)
    other = contact_numbers(direct, (impedance,), timestep)
    assert other.relaxation == pytest.approx(one.relaxation, rel=1e-9)
    assert other.resolved == pytest.approx(one.resolved, rel=1e-9)
    assert other.stiffness == pytest.approx(one.stiffness, rel=1e-9)


@given(st.floats(1e-4, 0.1), st.floats(0.05, 100), st.floats(1, 10), st.floats(1, 10))
def test_softer_and_more_damped_is_never_graded_worse(
    timeconst: float, ratio: float, longer: float, more: float
) -> None:
    before = contact_numbers((timeconst, ratio), SOLIMP, H).grade
    after = contact_numbers((timeconst * longer, ratio * more), SOLIMP, H).grade
    assert GRADES.index(after) >= GRADES.index(before)


@given(st.floats(1e-5, 1e-1))
def test_suggestion_is_strict_and_silent_at_every_time_step(timestep: float) -> None:
    first, second = SUGGESTED[0] * timestep, SUGGESTED[1]
    assert contact_numbers((first, second), SOLIMP, timestep).grade == "strict"
    assert contact_concerns((first, second), SOLIMP, timestep, diagexact=False) == []
    words = suggested_solref(timestep).split('"')[1].split()
    assert [float(word) for word in words] == pytest.approx([first, second], rel=1e-5)


@pytest.mark.parametrize("solref", [(-20_000.0, -50.0), (-1e6, -500.0), (0.001, 1.0), (0.02, 0.1)])
def test_what_the_map_saw_active_is_called_active(solref: tuple[float, float]) -> None:
    assert contact_numbers(solref, SOLIMP, H).grade == "active"
    (said,) = contact_concerns(solref, SOLIMP, H)[:1]
    assert "more energy than the coupling's slack" in said
    assert 'write solref="0.0005 8"' in said


def test_mujocos_default_is_soft_and_nothing_worse() -> None:
    assert contact_numbers((0.02, 1.0), SOLIMP, H).grade != "active"
    (said,) = contact_concerns((0.02, 1.0), SOLIMP, H)
    assert said.startswith("is soft: a steady force sinks in 100 times as deep")


def test_pyramids_are_named_only_where_friction_is_low_but_not_left_out() -> None:
    (said,) = contact_concerns((0.0005, 8.0), SOLIMP, H, cone="pyramidal", friction=0.1)
    assert 'write cone="elliptic"' in said
    rough = contact_concerns((0.0005, 8.0), SOLIMP, H, cone="pyramidal", friction=0.42)
    without = contact_concerns((0.0005, 8.0), SOLIMP, H, cone="pyramidal", condim=1, friction=0.0)
    assert rough == without == []


def test_approximate_diagonal_is_named_unless_the_contact_is_strict_anyway() -> None:
    (said,) = contact_concerns((0.002, 1.0), SOLIMP, H, diagexact=False)
    assert 'write <flag diagexact="enable"/>' in said


def test_contact_without_a_spring_stores_nothing_and_sinks_for_ever() -> None:
    numbers = contact_numbers((0.0, -100.0), SOLIMP, H)
    assert numbers.grade == "strict"
    assert math.isinf(numbers.softness)


@pytest.mark.parametrize(
    ("solref", "solimp", "timestep"),
    [((math.nan, 1.0), SOLIMP, H), ((0.002,), SOLIMP, H), ((0.002, 1.0), (), H),
     ((0.002, 1.0), SOLIMP, 0.0), ((0.002, 1.0), SOLIMP, math.inf)],
)  # fmt: skip
def test_bad_numbers_are_refused_in_a_sentence(
    solref: tuple[float, ...], solimp: tuple[float, ...], timestep: float
) -> None:
    with pytest.raises(SceneError, match="a contact needs two numbers"):
        contact_numbers(solref, solimp, timestep)


@pytest.mark.parametrize("name", scene_names())
def test_shipped_scenes_obey_the_whole_rule(name: str) -> None:
    loaded = load_scene(name)
    assert check_contacts(loaded.model, loaded.grip, is_thorough=True) == []


def concerns_of(path: Path, *, is_thorough: bool = False) -> list[str]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        loaded = load_scene(path)
    return check_contacts(loaded.model, loaded.grip, is_thorough=is_thorough)


def test_an_active_contact_is_named_by_its_geom_and_setting(tmp_path: Path) -> None:
    (said,) = concerns_of(scene(tmp_path, floor=GOOD, tip=HARD))
    assert "geom 'tip'" in said
    assert 'solref "-1e+06 -500"' in said
    assert 'write solref="0.0005 8"' in said


def test_a_geom_that_yields_to_every_partner_has_no_say(tmp_path: Path) -> None:
    assert concerns_of(scene(tmp_path, floor=GOOD + ' priority="1"', tip=HARD)) == []


def test_a_pair_is_named_by_both_geoms(tmp_path: Path) -> None:
    pair = f'<contact><pair geom1="tip" geom2="floor" {HARD}/></contact>'
    (said,) = concerns_of(scene(tmp_path, floor=GOOD, tip=GOOD, more=pair))
    assert "pair geom 'floor' and geom 'tip'" in said


def test_defaults_that_nobody_chose_are_mentioned_only_when_asked(tmp_path: Path) -> None:
    path = scene(tmp_path, floor="", tip="", cone="pyramidal")
    assert concerns_of(path) == []
    said = " ".join(concerns_of(path, is_thorough=True))
    assert "is soft" in said
    assert "geom 'tip' and 1 more" in said


def test_the_global_override_is_what_counts(tmp_path: Path) -> None:
    more = '<option o_solref="-1000000 -500"><flag override="enable"/></option>'
    (said,) = concerns_of(scene(tmp_path, floor=GOOD, tip=GOOD, more=more))
    assert 'solref "-1e+06 -500"' in said


def test_a_slippery_pyramid_is_named_unless_its_partner_is_rough(tmp_path: Path) -> None:
    slippery = GOOD + ' friction="0.05"'
    (said,) = concerns_of(scene(tmp_path, floor=slippery, tip=slippery, cone="pyramidal"))
    assert "geom 'tip' and 1 more" in said
    assert "friction of 0.05" in said
    rough = GOOD + ' friction="0.8"'
    assert concerns_of(scene(tmp_path, floor=rough, tip=slippery, cone="pyramidal")) == []


def test_time_step_that_the_file_does_not_set_is_taken_as_the_bridges(tmp_path: Path) -> None:
    path = scene(tmp_path, floor=GOOD, tip=GOOD)
    path.write_text(path.read_text().replace('timestep="0.001" ', ""))
    assert concerns_of(path) == []
    path.write_text(path.read_text().replace(GOOD, 'solref="0.0005 1"'))
    (said,) = concerns_of(path)
    assert "time step 0.001 s" in said


def test_loading_warns_of_an_active_contact_and_of_no_other(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="geom 'tip'.*more energy than the coupling's slack"):
        load_scene(scene(tmp_path, floor=GOOD, tip=HARD))
    load_scene(scene(tmp_path, floor=GOOD, tip=GOOD))
