"""The rule for contact settings: its numbers, its grades, its sentences, and the shipped scenes."""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from typing import Any

import mujoco
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from outside_scenes import scene_file

from hapticbridge.coupling import Coupling
from hapticbridge.demand.methods import prepare
from hapticbridge.errors import SceneError, SceneWarning
from hapticbridge.kernel.jit import source_of
from hapticbridge.kernel.restitution import restitution
from hapticbridge.lab.methods import METHODS
from hapticbridge.scene import contacts, load_scene, scene_names
from hapticbridge.scene.contacts import (
    ContactSetting,
    check_contacts,
    contact_concerns,
    contact_numbers,
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


def test_shipped_setting_relaxes_within_3_8_steps_and_is_within_the_slack() -> None:
    numbers = contact_numbers((0.002, 1.0), SOLIMP, H)
    assert numbers.relaxation == pytest.approx(3.8)
    assert numbers.resolved == pytest.approx(2)
    assert numbers.stiffness == pytest.approx(9 / 4, rel=0.02)
    assert numbers.impedance == pytest.approx(0.901)
    assert numbers.grade == "within slack"
    assert contact_concerns(ContactSetting((0.002, 1.0), SOLIMP), H) == []


@given(st.floats(1e-5, 0.1), st.floats(0.05, 100), st.floats(1e-4, 1e-2), st.floats(0.01, 0.999))
def test_both_formats_agree(time: float, ratio: float, timestep: float, impedance: float) -> None:
    direct = (-1 / (time * ratio) ** 2, -2 / time)
    one = contact_numbers((time, ratio), (impedance,), timestep)
    other = contact_numbers(direct, (impedance,), timestep)
    for name in ("relaxation", "resolved", "stiffness"):
        assert getattr(other, name) == pytest.approx(getattr(one, name), rel=1e-9)


@given(st.floats(1e-4, 0.1), st.floats(0.05, 100), st.floats(1, 10), st.floats(1, 10))
def test_softer_is_never_worse(timeconst: float, ratio: float, longer: float, more: float) -> None:
    before = contact_numbers((timeconst, ratio), SOLIMP, H).grade
    after = contact_numbers((timeconst * longer, ratio * more), SOLIMP, H).grade
    assert GRADES.index(after) >= GRADES.index(before)


@given(st.floats(1e-5, 1e-1))
def test_suggestion_is_strict_and_silent_at_every_time_step(timestep: float) -> None:
    first, second = contacts.SUGGESTED[0] * timestep, contacts.SUGGESTED[1]
    assert contact_numbers((first, second), SOLIMP, timestep).grade == "strict"
    assert contact_concerns(ContactSetting((first, second), SOLIMP), timestep) == []
    words = contacts.suggested_solref(timestep).split('"')[1].split()
    assert [float(word) for word in words] == pytest.approx([first, second], rel=1e-5)


NOT_MET = f'<geom name="lamp" size="0.01" pos="3 3 3" contype="4" conaffinity="4" {GOOD}/>'


@pytest.mark.parametrize(
    ("solref", "solimp", "words"),
    [
        *((solref, SOLIMP, ("more energy than the coupling's slack", 'write solref="0.0005 8"'))
          for solref in ((-1e6, -1200.0), (0.001, 1.0))),
        ((-1000.0, 0.0), SOLIMP, ("bounces (e = 1): as MuJoCo's spring it may rise higher than it",
          "nothing, if it is to bounce: rigid contacts (without --contact scene) do so")),
        # exp(-zeta/root * acos(2 zeta^2 - 1)) of a spring that is let go where its force is zero
        ((0.02, 0.1), SOLIMP, ("bounces (e = 0.74)", 'for no bounce solref="0.0005 8"')),
        ((0.004, 2.0), (0.99, 0.99, 0.001),
         ("larger impedance (0.99, at most 0.91)",
          'write solref="0.0005 8" and solimp="0.9 0.95 0.001"')),
    ],
)  # fmt: skip
def test_what_to_write_is_told(solref: Any, solimp: Any, words: tuple[str, ...]) -> None:
    (said,) = contact_concerns(ContactSetting(solref, solimp), H)
    assert all(word in str(said) for word in words)
    assert contact_numbers(solref, solimp, H).grade == "active"


@pytest.mark.parametrize(
    ("solref", "solimp", "timestep"),
    [((math.nan, 1.0), SOLIMP, H), ((0.002,), SOLIMP, H), ((0.002, 1.0), (), H),
     ((0.002, 1.0), SOLIMP, 0.0), ((0.002, 1.0), SOLIMP, math.inf)],
)  # fmt: skip
def test_bad_numbers_are_refused(solref: Any, solimp: Any, timestep: float) -> None:
    with pytest.raises(SceneError, match="a contact needs two numbers"):
        contact_numbers(solref, solimp, timestep)


def test_pyramids_are_named_only_where_friction_is_low_but_not_left_out() -> None:
    (said,) = contact_concerns(
        ContactSetting((0.0005, 8.0), SOLIMP, friction=0.1), H, cone="pyramidal"
    )
    assert 'write cone="elliptic"' in str(said)
    rough = contact_concerns(
        ContactSetting((0.0005, 8.0), SOLIMP, friction=0.42), H, cone="pyramidal"
    )
    without = contact_concerns(
        ContactSetting((0.0005, 8.0), SOLIMP, condim=1, friction=0.0), H, cone="pyramidal"
    )
    assert rough == without == []


def test_contact_without_a_spring_stores_nothing_and_sinks_for_ever() -> None:
    numbers = contact_numbers((0.0, -100.0), SOLIMP, H)
    assert numbers.grade == "strict"
    assert math.isinf(numbers.softness)


@pytest.mark.parametrize("name", scene_names(1))
def test_shipped_scenes_obey_the_rule(name: str) -> None:
    loaded = load_scene(name)
    assert check_contacts(loaded.model, loaded.grip) == []


def concerns_of(path: Path) -> list[str]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        loaded = load_scene(path)
    return [*map(str, check_contacts(loaded.model, loaded.grip))]


PAIR = f'<contact><pair geom1="tip" geom2="floor" {HARD}/></contact>'
OVERRIDE = '<option o_solref="-1000000 -500"><flag override="enable"/></option>'
SLIPPERY, ROUGH = GOOD + ' friction="0.05"', GOOD + ' friction="0.8"'
PLAIN = "geom 'tip' with geom 'floor'"


@pytest.mark.parametrize(
    ("floor", "tip", "more", "cone", "words"),
    [
        (GOOD, HARD, "", "elliptic", (PLAIN, 'solref "-1e+06 -500"', 'write solref="0.0005 8"')),
        (GOOD, GOOD, PAIR, "elliptic", ("geom 'floor' with geom 'tip'",)),
        (GOOD, GOOD, OVERRIDE, "elliptic", ('solref "-1e+06 -500"',)),
        (SLIPPERY, SLIPPERY, "", "pyramidal", (PLAIN, "friction of 0.05")),
        (SLIPPERY + ' priority="1"', GOOD, "", "pyramidal", ("friction of 0.05",)),
        (GOOD, SLIPPERY + ' priority="1"', "", "pyramidal", ("friction of 0.05",)),
        (ROUGH, SLIPPERY, "", "pyramidal", None),
        ("", "", "", "pyramidal", None),  # defaults that nobody chose
    ],
)
def test_a_contact_at_fault_is_named_by_its_geoms_and_setting(
    tmp_path: Path, floor: str, tip: str, more: str, cone: str, words: tuple[str, ...] | None
) -> None:
    told = concerns_of(scene(tmp_path, floor=floor, tip=tip, more=more, cone=cone))
    assert len(told) == (words is not None)
    assert all(word in told[0] for word in words or ())


def prepared(
    path: Path, rate: float, substeps: int = 1, method: str = "implicit", contact: str = "scene"
) -> list[str]:
    """Returns the warnings of loading a scene and preparing it for a rate in Hz."""
    chosen = METHODS[method].with_contact(contact)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        loaded = load_scene(path)
        prepare(loaded, Coupling(1000.0, 0.5, 1.0, 5e-4), 1 / rate, substeps, chosen)
    return [str(one.message) for one in caught]


def test_contacts_are_judged_once_at_the_step_that_the_bridge_runs_at(tmp_path: Path) -> None:
    path = scene(tmp_path, floor=GOOD, tip=GOOD)
    path.write_text(path.read_text().replace('timestep="0.001"', 'timestep="0.005"'))
    (said,) = prepared(path, 200)
    assert "time step 0.005 s" in said
    assert "more energy than the coupling's slack" in said
    assert prepared(path, 1000) == prepared(path, 200, substeps=5) == []


def test_a_method_that_solves_contacts_in_its_own_way_is_not_judged(tmp_path: Path) -> None:
    path = scene(tmp_path, floor=GOOD, tip=HARD)
    assert prepared(path, 1000) != []
    assert prepared(path, 1000, method="explicit") == []
    assert prepared(path, 1000, contact="rigid") == []


@pytest.mark.parametrize(
    ("solref", "solimp", "grade", "light"),
    [
        # as shipped, more damped, damped and stiff, strict
        ((0.002, 1.0), SOLIMP, "within slack", "active"),
        ((0.0019, 1.0), SOLIMP, "active", "active"),
        ((0.00025, 8.0), SOLIMP, "within slack", "within slack"),
        ((0.00025, 7.8), SOLIMP, "within slack", "active"),
        ((0.0005, 8.0), SOLIMP, "strict", "strict"),
        ((0.0005, 7.8), SOLIMP, "within slack", "within slack"),
        ((0.00002, 100.0), SOLIMP, "strict", "strict"),
        # κ = 2.28 needs more than 60 steps: 228
        ((0.00004, 50.0), SOLIMP, "within slack", "within slack"),
        # κ = 3.8 and 4.2 at τ = 1000 h
        ((1.55e-6, 1000.0), SOLIMP, "strict", "strict"),
        ((1.47e-6, 1000.0), SOLIMP, "active", "active"),
        # impedance
        ((0.004, 2.1), (0.905, 0.905, 0.001), "within slack", "within slack"),
        ((0.002, 2.0), (0.95, 0.95, 0.001), "active", "active"),
        ((0.004, 8.0), (0.99, 0.99, 0.001), "strict", "strict"),
        ((0.004, 2.0), (0.99, 0.99, 0.001), "active", "active"),
        ((0.0005, 8.0), (0.0001, 0.99, 0.00001), "active", "active"),
        ((0.002, 2.0), (0.9, 0.99, 0.001), "within slack", "active"),
        ((0.002, 1.0), (0.5, 0.5, 0.001), "active", "active"),
        ((0.002, 1.4), (0.5, 0.5, 0.001), "within slack", "active"),
    ],
)
def test_grades_beside_every_line(solref: Any, solimp: Any, grade: str, light: str) -> None:
    numbers = contact_numbers(solref, solimp, H)
    assert (numbers.grade, numbers.light_grade) == (grade, light)


def test_refsafe_raises_what_the_step_cannot_resolve() -> None:
    safe = contact_numbers((0.0001, 2.0), SOLIMP, H)
    unsafe = contact_numbers((0.0001, 2.0), SOLIMP, H, refsafe=False)
    assert safe.resolved == 1
    assert unsafe.resolved == pytest.approx(0.2)
    assert unsafe.relaxation == pytest.approx(safe.relaxation / 5)


@given(
    st.lists(st.floats(0.01, 0.99), min_size=2, max_size=2),
    st.floats(2e-5, 1e-3), st.floats(0.1, 0.9), st.floats(1, 4),
)  # fmt: skip
@settings(max_examples=25)
def test_impedance_is_the_one_that_mujoco_gives_a_contact_0_1_mm_deep(
    impedances: list[float], width: float, midpoint: float, power: float
) -> None:
    solimp = (*impedances, width, midpoint, power)
    words = " ".join(map(str, solimp))
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><worldbody><geom type="plane" size="1 1 1" solimp="{words}"/>
        <body pos="0 0 0.0099"><freejoint/><geom size="0.01" solimp="{words}"/></body>
        </worldbody></mujoco>"""
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert data.contact.dist[0] == pytest.approx(-1e-4)
    found = contact_numbers((0.02, 1.0), solimp, H).impedance
    assert found == pytest.approx(data.efc_KBIP[0, 2], rel=1e-6)
    # MuJoCo's own stiffness and damping, in its second and first place
    relaxation = data.efc_KBIP[0, 1] / data.efc_KBIP[0, 0]
    assert contact_numbers((0.02, 1.0), solimp, H).relaxation * H == pytest.approx(relaxation)


@pytest.mark.parametrize(
    ("floor", "tip", "more", "flag"),
    [
        (GOOD + ' contype="2" conaffinity="2"', HARD, "", ""),
        (GOOD, HARD, '<contact><exclude body1="tool" body2="world"/></contact>', ""),
        (GOOD, HARD, "", 'contact="disable"'),
        (GOOD, HARD, "", 'constraint="disable"'),
        (HARD, HARD, f'<contact><pair geom1="tip" geom2="floor" {GOOD}/></contact>', ""),
        ('solref="0.002 1"', 'solref="0.0005 1" solmix="0"', "", ""),
        (GOOD + ' priority="1"', HARD, f"<worldbody>{NOT_MET}</worldbody>", ""),
    ],
    ids=["masks", "exclude", "no contacts", "no constraints", "pair", "solmix", "yields"],
)
def test_settings_unmet_untold(tmp_path: Path, floor: str, tip: str, more: str, flag: str) -> None:
    path = scene(tmp_path, floor=floor, tip=tip, more=more)
    path.write_text(path.read_text().replace("<flag ", f"<flag {flag} "))
    assert concerns_of(path) == []


def test_without_refsafe_a_setting_is_judged_as_written(tmp_path: Path) -> None:
    hard = 'solref="0.0001 2"'
    (said,) = concerns_of(scene(tmp_path, floor=hard, tip=hard))
    assert "a larger stiffness (9.1 " in said
    path = scene(tmp_path, floor=hard, tip=hard)
    path.write_text(path.read_text().replace("<flag ", '<flag refsafe="disable" '))
    (said,) = concerns_of(path)
    assert "a larger stiffness (228 " in said


@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
@pytest.mark.parametrize("solimp", ["", 'solimp="0.9 0.99 0.001"', 'solimp="0.9 1 0.022"'])
def test_ordinary_scenes_are_not_called_active(tmp_path: Path, cone: str, solimp: str) -> None:
    assert concerns_of(scene(tmp_path, floor=solimp, tip=solimp, cone=cone)) == []


GEOM = st.fixed_dictionaries(
    {
        "priority": st.integers(0, 1),
        "solmix": st.sampled_from([0.0, 0.3, 1.0, 5.0]),
        "solref": st.sampled_from(["0.002 1", "0.02 0.5", "-1000 -10", "-3000 -5"]),
        "solimp": st.sampled_from(["0.9 0.95 0.001", "0.5 0.6 0.01 0.3 1"]),
        "condim": st.sampled_from([1, 3, 4, 6]),
        "friction": st.floats(0.01, 2),
        "contype": st.integers(0, 3),
        "conaffinity": st.integers(0, 3),
    }
)


@given(st.lists(GEOM, min_size=4, max_size=4), st.sampled_from(["", 'filterparent="disable"']),
       st.sampled_from(["", '<exclude body1="link" body2="world"/>',
                        '<exclude body1="tool" body2="box"/>', '<pair geom1="a" geom2="d"/>']),
)  # fmt: skip
@settings(max_examples=60)
def test_settings_are_mujocos(geoms: list[dict[str, object]], flag: str, more: str) -> None:
    a, b, c, d = (" ".join(f'{k}="{v}"' for k, v in one.items()) for one in geoms)
    # all four overlap, so that MuJoCo makes every contact that it may
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option><flag {flag}/></option><worldbody>
        <geom name="d" size="0.1" {d}/>
        <body name="box" pos="0.05 0 0"><freejoint/><geom name="c" size="0.1" {c}/></body>
        <body name="tool" pos="0 0.05 0"><freejoint/><geom name="a" size="0.1" {a}/>
          <site name="grip"/>
          <body name="link" pos="0 0 0.05"><joint/><geom name="b" size="0.1" {b}/></body>
        </body></worldbody><contact>{more}</contact></mujoco>"""
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    tool = {model.geom("a").id, model.geom("b").id}
    expected = {
        frozenset(c.geom.tolist()): (*c.solref, *c.solimp, c.dim, c.friction[0])
        for c in data.contact
        if tool & set(c.geom.tolist())
    }
    found = {
        frozenset((first, second)): (*one.solref, *one.solimp, one.condim, one.friction)
        for first, second, one in contacts.contact_settings(model, "grip")
    }
    assert found.keys() == expected.keys()
    for key, values in expected.items():
        assert found[key] == pytest.approx(values)


BOUNCER = """<mujoco><option timestep="1e-4" gravity="0 0 0"/><worldbody>
<geom name="floor" type="plane" size="1 1 .1" solmix="0"/>
<body name="tool" pos="0 0 0.011"><freejoint/>
<geom name="ball" size="0.01" mass="0.1" {}/><site name="grip"/></body></worldbody></mujoco>"""
BOUNCE = "of a spring → of an impact, e at most"


@pytest.mark.parametrize(
    ("solref", "expected"),
    [
        ((-4000.0, -10.0), 0.79),
        ((0.01, 0.1), 0.74),
        ((0.02, 1.0), 0.135),
        ((0.02, 0.0), 0.135),
        ((0.02, -10.0), 0.135),
        ((-4000.0, 0.0), 1.0),
        ((-1000.0, -100.0), 0.064),
    ],
)
def test_restitution_is_what_mujoco_gives_a_ball(
    tmp_path: Path, solref: tuple[float, float], expected: float
) -> None:
    setting = f'solref="{solref[0]} {solref[1]}" solimp="0.9999 0.9999 0.001"'
    model = mujoco.MjModel.from_xml_string(BOUNCER.format(setting))
    data = mujoco.MjData(model)
    data.qvel[2] = -0.2
    mujoco.mj_step(model, data, 4000)
    e = source_of(restitution)(*solref)
    assert e == pytest.approx(expected, abs=0.01)
    assert data.qvel[2] / 0.2 == pytest.approx(e, abs=0.02)


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ('solref="-4000 -10"', f"bounce of geom 'ball': {BOUNCE} 0.79"),
        ('solref="-4000 0"', f"bounce of geom 'ball': {BOUNCE} 0.98"),
        ('margin="0.005" solref="0.005 1"', ""),
        ('solref="-4000 -10" contype="0" conaffinity="0"', ""),
    ],
)
def test_a_bounce_is_said_with_its_coefficient(tmp_path: Path, setting: str, said: str) -> None:
    scene = load_scene(scene_file(tmp_path, BOUNCER.format(setting)))
    before = scene.changes
    scene.set_contact(is_rigid=True)
    more = [each for each in scene.changes if each.startswith("bounce")]
    assert more == ([f"{said} (--contact scene keeps it)"] if said else [])
    scene.set_contact(is_rigid=False)
    assert scene.changes == before


@pytest.mark.parametrize("mixed", ["0.02 0", "0.02 -10", "-5000 1", "0 1"])
def test_a_solref_of_two_forms_counts_as_mujocos_default_and_is_told(
    tmp_path: Path, mixed: str
) -> None:
    first, second = map(float, mixed.split())
    solimp = contacts.MUJOCO_SOLIMP
    of_default = contacts.contact_numbers(contacts.MUJOCO_SOLREF, solimp, 1e-3)
    assert contacts.contact_numbers((first, second), solimp, 1e-3) == of_default
    path = tmp_path / "mixed.xml"
    path.write_text(BOUNCER.format(f'solref="{mixed}"'))
    with pytest.warns(
        SceneWarning, match=f"solref {mixed} of geom 'ball' mixes MuJoCo's two forms"
    ):
        load_scene(path)
