"""Faults planted in a scene, each named with its line and a change that mends it."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np
import pytest
from check_scenes import (
    GOOD_CONTACT,
    GOOD_OPTION,
    KEY,
    LEAPING,
    PLANTS,
    TWO_SIDED,
    Plant,
    bench,
    case_of,
    faults_of,
    kinds,
    line_of,
    peg_with,
    shipped_case,
    written,
)
from cli_cases import Called
from outside_scenes import hand_rows, mjcf
from report_runs import HARD_FLOOR

import hapticbridge as hb
from hapticbridge.check import lean
from hapticbridge.check.case import IntendedUse, open_case, samples_of
from hapticbridge.check.contact_faults import shape_faults
from hapticbridge.check.findings import find_faults
from hapticbridge.check.inventory import take_inventory
from hapticbridge.check.lean import MAY_GO
from hapticbridge.check.run_faults import run_faults
from hapticbridge.check.simplify import OTHER_MOTIONS, Simplification
from hapticbridge.check.version import SceneVariant, name_everything, witness
from hapticbridge.clock import SimulatedClock
from hapticbridge.coupling import Coupling
from hapticbridge.demand.rehearsal import RunPoint
from hapticbridge.device import Motion, SimulatedDevice
from hapticbridge.errors import DeviceError, SceneError
from hapticbridge.run.bridge import Bridge
from hapticbridge.run.description import model_digest
from hapticbridge.scene import compile_scene, read_scene, scene_names, scene_path
from hapticbridge.scene.fault import Fault, length, number, weight
from hapticbridge.scene.first_faults import DROPPED, worst_faults
from hapticbridge.scene.physics import depth_under
from hapticbridge.scene.source_map import Place

CREATED = {"energy created", "energy in the slack"}

CONSEQUENCES = CREATED | {"MuJoCo warning", "solver iterations", "own motion"}
"""Faults in the motion to which a planted one may lead."""

CURED = {
    *("solver iterations", "pyramidal cone", "default contact", "not passive"),
    *("soft limit", "soft equality"),
}
"""Faults of a scene's own constraints that a run with rigid contacts cures."""

SHAPES = {"box edges", "mesh faces"}
"""Faults of the bench's shapes under MuJoCo's own contact."""

FLOOR = '<geom name="floor" type="plane" size="1 1 1"/>'

OWN_CONTACTS = IntendedUse(contact="scene")


def faults_in(folder: Path, text: str, motion: str = "", **options: Any) -> tuple[Fault, ...]:
    return faults_of(written(folder, text, motion), **options)


def one_of(kind: str, faults: tuple[Fault, ...]) -> Fault:
    (fault,) = (fault for fault in faults if fault.kind == kind)
    return fault


RUBS = """<mujoco><option timestep="0.001"/><worldbody><body name="sledge">
<joint name="x" type="slide" axis="1 0 0" frictionloss="3" {attributes}/>
<geom type="box" size=".02 .02 .02" mass="{mass}"/><site name="grip"/></body></worldbody>
</mujoco>"""


@pytest.mark.parametrize("mass", [0.2, 0.01, 1e-4])
@pytest.mark.parametrize(
    "attributes", ["", 'solreffriction="0.002 1" solimpfriction="0.999 0.999 0.001"']
)
def test_what_is_written_against_creep_ends_it(
    tmp_path: Path, mass: float, attributes: str
) -> None:
    def creeps(written_there: str) -> list[Fault]:
        found = faults_in(tmp_path, RUBS.format(mass=mass, attributes=written_there))
        return [fault for fault in found if fault.kind == "creeping friction"]

    for fault in creeps(attributes):
        assert not creeps(fault.change.partition(" (")[0])
    assert bool(creeps(attributes)) is (not attributes or mass < 0.1)


@pytest.mark.parametrize("flag", ["frictionloss", "constraint", "limit"])
def test_dry_friction_that_a_flag_disables_does_not_creep(tmp_path: Path, flag: str) -> None:
    option = '<option timestep="0.001"'
    text = RUBS.format(mass=0.2, attributes="").replace(f"{option}/>", f"{option}>{{}}</option>")
    found = faults_in(tmp_path, text.format(f'<flag {flag}="disable"/>'))
    assert any(each.kind == "creeping friction" for each in found) is (flag == "limit")


def test_mended_scene_has_no_fault(tmp_path: Path) -> None:
    assert faults_of(bench(tmp_path / "scene")) == ()


@pytest.mark.parametrize("plant", PLANTS, ids=lambda plant: plant.kind)
def test_planted_fault_alone_is_named_with_file_and_line(tmp_path: Path, plant: Plant) -> None:
    scene = bench(tmp_path / "scene", plant)
    faults, others = faults_of(scene), CONSEQUENCES
    if plant.kind in CURED:
        assert kinds(faults) <= {"changed"}  # what cures it is told
        faults, others = faults_of(scene, contact="scene"), CONSEQUENCES | SHAPES
    assert kinds(faults) - others <= {plant.kind}
    fault = one_of(plant.kind, faults)
    assert (fault.place.file, fault.place.line) == line_of(plant, scene)
    assert fault.sentence
    assert fault.change


def test_an_impossible_inertia_is_told_with_its_stand_in(tmp_path: Path) -> None:
    box = 'size="0.01 0.01 0.01" mass="0.1"/>'
    inertial = '<inertial pos="0 0 0" mass="0.1" diaginertia="1 1 9"/>'
    plant = Plant("impossible inertia", box, box + inertial, file="parts.xml")
    found = faults_of(bench(tmp_path / "scene", plant))
    fault = one_of(plant.kind, found)
    assert "judged with 0.01 kg and 1e-06 kg m²" in fault.sentence
    assert 'balanceinertia="true"' in fault.change


def test_a_stand_in_that_no_fault_can_tell_gives_way_to_mujocos_message(tmp_path: Path) -> None:
    """Grips would be listed with the mass of the stand-in."""
    body = """<body name="tool"><joint type="slide"/><geom size=".01" mass=".1"/><site name="grip"/>
        <body name="tip"><inertial pos="0 0 0" mass=".1" diaginertia="1 1 9"/></body></body>"""
    path = written(tmp_path, mjcf(GOOD_OPTION, body=body))
    with pytest.raises(SceneError, match=r"inertia must satisfy .*\(element 'tip'"):
        open_case(read_scene(path), "handle")


@pytest.mark.parametrize(("flag", "names"), [("", ["'plate'", "'ball'"]), ("enable", [])])
def test_margins_at_which_a_ball_bounces_are_named(
    tmp_path: Path, flag: str, names: list[str]
) -> None:
    """Such a ball comes to rest 6.000 mm above the plate, whatever the gaps are."""
    option = f'<option><flag override="{flag}"/></option>' if flag else ""
    plate = 'name="plate" type="box" size=".1 .1 .01" pos="0 0 -.1" margin=".004" gap=".002"'
    ball = '<geom name="ball" size=".02" mass=".02" margin=".002"/>'
    text = f"""<mujoco>{option}<default><geom solref=".02 .1"/></default><worldbody>
    <geom {plate}/><body pos=".1 0 0"><freejoint/>{ball}</body>
    <body gravcomp="1"><freejoint/><geom size=".02" mass=".5"/><site name="grip"/></body>
    </worldbody></mujoco>"""
    found = [each for each in faults_in(tmp_path, text) if each.kind == "margin"]
    assert [each.place.element for each in found] == [f"geom {name}" for name in names]
    assert all("rest, and bounce, that far" in each.sentence for each in found)


def test_all_planted_faults_are_named_together(tmp_path: Path) -> None:
    scene = bench(tmp_path / "scene", *PLANTS)
    planted = {(plant.kind, *line_of(plant, scene)) for plant in PLANTS}
    for contact, cured in (("scene", set()), ("rigid", CURED)):
        faults = faults_of(scene, contact=contact)
        found = {(fault.kind, fault.place.file, fault.place.line) for fault in faults}
        assert {each for each in planted if each[0] not in cured} <= found
        assert not kinds(faults) & cured
    assert len(PLANTS) >= 12


@pytest.mark.parametrize("name", scene_names(1))
def test_shipped_scene_has_no_fault(name: str, tmp_path: Path) -> None:
    if name == "beads":  # 10 ms a tick
        lines = scene_path(name).with_suffix(".csv").read_text(encoding="utf-8").splitlines()
        motion = tmp_path / "beads.csv"
        motion.write_text("\n".join(lines[:52]), encoding="utf-8")  # until 0.5 s
        assert faults_of(scene_path(name), motion=motion) == ()
    else:
        assert find_faults(shipped_case(name)) == ()


def test_boxes_are_named_unless_the_run_keeps_their_points() -> None:
    case = shipped_case("planar_peg")
    assert not tuple(shape_faults(case))
    (fault,) = shape_faults(replace(case, contact="scene"))
    assert fault.kind == "box edges"
    assert "and 2 more" in fault.sentence
    assert "--contact rigid" in fault.change


@pytest.mark.parametrize(
    ("corners", "contact", "is_named"),
    [(8, "scene", True), (8, "rigid", False), (200, "rigid", True)],
)
def test_meshes_are_named_unless_the_run_corrects_their_normals(
    tmp_path: Path, corners: int, contact: Literal["rigid", "scene"], is_named: bool
) -> None:
    angles = np.arange(corners // 2) * 4 * np.pi / corners
    ring = [(np.cos(a), np.sin(a), z) for a in angles for z in (-3.0, 3.0)]
    vertices = " ".join(f"{0.01 * value:.9g}" for corner in ring for value in corner)
    text = scene_path("planar_peg").read_text(encoding="utf-8")
    text = text.replace('size="0.01 0.01 0.03" mass', 'type="mesh" mesh="prism" mass')
    text = text.replace("<asset>", f'<asset><mesh name="prism" vertex="{vertices}"/>', 1)
    scene = tmp_path / "prism.xml"
    scene.write_text(text, encoding="utf-8")
    case = replace(case_of(scene), contact=contact)
    found = {fault.kind: fault.change for fault in shape_faults(case)}
    assert ("mesh faces" in found) == is_named
    if is_named:
        now = f"at most 128 corners and as many faces (now {corners} and {corners // 2 + 2})"
        assert found["mesh faces"].partition(now)[2] == (
            "" if contact == "rigid" else " and --contact rigid for the run"
        )


def test_peg_sinks_deeper_than_its_clearance_with_mujocos_default(tmp_path: Path) -> None:
    case = case_of(peg_with(tmp_path, "0.02 1"), contact="scene")
    assert case.observation
    assert not find_faults(replace(case, contact="rigid"))
    fault = one_of("default contact", find_faults(case))
    assert "into a clearance of 200 µm" in fault.sentence
    assert 'solref="0.002 1"' in fault.change
    depth = float(fault.sentence.split("sink in by ")[1].split(" mm")[0]) * 1e-3
    assert depth > 375e-6
    # the same as MuJoCo's own at rest, as the depth test says, at the least inertia that was seen
    least = min(m.inertia for m in case.observation.meetings.values())
    push = min(float(case.observation.force.max()), case.info.force_limit)
    settings = case.model.geom_solref[0] * 0 + [0.02, 1], (0.9, 0.95, 0.001)
    assert depth == pytest.approx(depth_under(push, *settings, least, 1e-3), rel=0.01)


@pytest.mark.parametrize(
    ("solref", "clearance", "is_told"),
    [
        ("0.005 1", 0.8e-3, False),
        ("0.005 1", 0.2e-3, True),
        ("0.002 1", 0.05e-3, False),  # too narrow, but no stiffer contact is passive
    ],
)
def test_needless_softness_is(tmp_path: Path, solref: str, clearance: float, is_told: bool) -> None:
    source = read_scene(peg_with(tmp_path, solref), clearance=clearance)
    faults = find_faults(open_case(source, use=OWN_CONTACTS))
    told = [fault.sentence for fault in faults if fault.kind == "soft contact"]
    assert bool(told) == is_told
    for sentence in told:  # of postures, none quite straight
        room = float(sentence.split("into a clearance of ")[1].split(" µm")[0])
        assert room == pytest.approx(1e6 * clearance, rel=0.05)


@pytest.mark.parametrize(
    ("floor", "tool", "place"),
    [
        ('solref="0.002 1"', 'solref="0.03 1"', "geom 'ball'"),
        ('solref="0.03 1"', 'solref="0.002 1"', "geom 'floor'"),
        ('solref="0.03 1"', 'solref="0.03 1"', "geom 'ball'"),
        ('solref="0.03 1" priority="1"', 'solref="0.03 1"', "geom 'floor'"),
        ('solref="0.002 1"', 'solref="-400000 -1000"', "geom 'ball'"),  # the stiffer is at fault
        ('solref="-400000 -1000"', 'solref="0.002 1"', "geom 'floor'"),
    ],
)
def test_spoiling_geom_is_named(tmp_path: Path, floor: str, tool: str, place: str) -> None:
    body = BALL.replace('mass="0.1"', f'mass="0.1" {tool}')
    text = mjcf(GOOD_OPTION, body=body, world=FLOOR.replace("/>", f" {floor}/>"))
    faults = faults_in(tmp_path, text, contact="scene")
    found = [f for f in faults if f.place.element.startswith("geom")]
    assert [fault.place.element for fault in found] == [place]
    assert ("geom 'floor'" in found[0].change) == (floor == tool)


def test_explicit_pair_is_named_instead_of_its_geoms(tmp_path: Path) -> None:
    pair = '<contact><pair name="rest" geom1="floor" geom2="ball" solref="0.03 1"/></contact>'
    text = mjcf(GOOD_OPTION, GOOD_CONTACT, pair, body=BALL, world=FLOOR)
    assert not faults_in(tmp_path, text)
    (fault,) = faults_in(tmp_path, text, contact="scene")
    assert (fault.kind, fault.place.element) == ("soft contact", "pair 'rest'")


def free(geom: str, grip: str = "") -> str:
    """Returns a free tool of one geom."""
    return f'<body name="tool"><freejoint/><geom {geom}/><site name="grip" {grip}/></body>'


SAG = free('size="0.01" mass="{}"', 'pos="0.005 0 0"')
LINKS = """<body name="link"><joint/><geom size="0.01" mass="0.001"/><body pos="0.1 0 0">
  <joint/><geom size="0.02" mass="{}"/><site name="grip"/></body></body>"""
ON_A_BASE = """<body name="base"><joint type="slide" damping="1e9"/>
  <geom type="box" size=".1 .1 .1" mass="{base}"/><body pos="0 0 .5"><joint axis="0 0 1"/>
  <geom pos=".3 0 0" size=".05" mass="{arm}"/><site name="grip" pos=".3 0 0"/></body></body>"""
HEAVY = GOOD_OPTION.replace('"0 0 0"', '"0 0 -9.81"')


@pytest.mark.parametrize(
    ("kind", "option", "body", "words"),
    [
        ("heavy tool", HEAVY, SAG.format(0.24), None),
        ("heavy tool", HEAVY, SAG.format(0.25), f"by {length(0.25 * 9.81 / 2400)} at rest"),
        ("mass ratio", GOOD_OPTION, LINKS.format(0.9), None),
        ("mass ratio", GOOD_OPTION, LINKS.format(1.1), ""),
        ("units", GOOD_OPTION, free('size="1.0" mass="40"'), None),
        ("units", GOOD_OPTION, free('size="1.6" mass="40"'), f"{length(3.2)} long"),
        ("units", GOOD_OPTION, free('size="1.0" mass="60"'), f"weighs {weight(60)}"),
        ("units", GOOD_OPTION, ON_A_BASE.format(base=80, arm=40), None),
        ("units", GOOD_OPTION, ON_A_BASE.format(base=40, arm=60), f"weighs {weight(60)}"),
    ],
)
def test_a_tool_beyond_the_line_is_told_and_none_below(
    tmp_path: Path, kind: str, option: str, body: str, words: str | None
) -> None:
    coupling = Coupling(stiffness=2400, damping=1, rotational_stiffness=1e6, rotational_damping=1)
    faults = faults_in(tmp_path, mjcf(option, GOOD_CONTACT, body=body), coupling=coupling)
    told = [fault for fault in faults if fault.kind == kind]
    assert len(told) == (words is not None)
    assert all(str(words) in fault.sentence for fault in told)


@pytest.mark.parametrize(
    ("workspace", "scale", "is_told"),
    [(0.21, 1.0, False), (0.19, 1.0, True), (0.19, 1.1, False), (0.11, 1.9, False)],
)
def test_far_motion_is_told(tmp_path: Path, workspace: float, scale: float, is_told: bool) -> None:
    text, room = mjcf(GOOD_OPTION, GOOD_CONTACT), {"workspace": workspace, "scale": scale}
    faults = faults_in(tmp_path, text, hand_rows([(0.5, (0.1, 0, 0)), (0.5, (-0.1, 0, 0))]), **room)
    assert ("workspace" in kinds(faults)) == is_told


def test_time_step_is_no_fault_where_the_rate_was_asked_for(tmp_path: Path) -> None:
    assert "time step" not in kinds(faults_of(bench(tmp_path / "scene"), period=0.5e-3))


def test_contact_that_created_energy_is_named_with_a_setting_that_does_not(tmp_path: Path) -> None:
    source = read_scene("peg_in_hole", clearance=1e-3)
    assert find_faults(open_case(source)) == ()
    fault = one_of("energy in the slack", find_faults(open_case(source, use=OWN_CONTACTS)))
    assert "% of the coupling's slack, which covers it" in fault.sentence
    change = fault.change.split(" there")[0]
    assert change == 'solref="0.0005 8"'
    mended = read_scene(peg_with(tmp_path, "0.0005 8"), clearance=1e-3)
    assert not CREATED & kinds(find_faults(open_case(mended, use=OWN_CONTACTS)))


def test_motion_that_does_not_end_is_a_fault_and_no_error(tmp_path: Path) -> None:
    wild = """<body><joint name="wild" type="slide"/><geom size="0.01" mass="0.1" contype="0"/>
      </body>"""
    motor = '<general joint="wild" biastype="affine" biasprm="1 1e8 0"/>'
    text = mjcf(f"<actuator>{motor}</actuator>", GOOD_OPTION, GOOD_CONTACT, world=wild)
    case = case_of(written(tmp_path, text))
    assert case.observation is None
    assert "not finite after tick" in one_of("motion not finished", find_faults(case)).sentence


def test_a_keyframe_of_an_attached_model_is_not_renamed_but_replaced(tmp_path: Path) -> None:
    part = """<mujoco model="part"><worldbody><body name="arm"><joint name="j" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 .1 0 0" size=".01"/></body>
        </worldbody><keyframe><key name="home" qpos=".3"/></keyframe></mujoco>"""
    (tmp_path / "part.xml").write_text(part)
    (tmp_path / "whole.xml").write_text(
        '<mujoco><asset><model name="part" file="part.xml"/></asset><worldbody><frame>'
        '<attach model="part" body="arm" prefix="p_"/></frame><body name="grip" pos="0 1 0">'
        '<freejoint/><geom size=".02" mass=".1"/></body></worldbody></mujoco>'
    )
    fault = one_of("keyframe", faults_of(tmp_path / "whole.xml"))
    assert '<key name="home" qpos="…"/> in a <keyframe> of whole.xml' in fault.change


@pytest.mark.parametrize(
    ("option", "kinds_told"),
    [("", {"c-arm": 7}), ('<default><geom density="1000"/></default>', {})],
)
def test_a_geom_of_an_attached_model_is_named_in_its_file_and_not_of_water_by_its_density(
    tmp_path: Path, option: str, kinds_told: dict[str, int]
) -> None:
    (tmp_path / "part.xml").write_text(f"""<mujoco model="part">
  {option}
  <worldbody>
    <body name="arm">
      <joint name="j" axis="0 1 0"/>
      <geom size=".01" density="1000"/>
      <geom size=".02"/>
      <site name="grip"/>
    </body>
  </worldbody>
</mujoco>""")
    whole = """<mujoco><asset><model name="part" file="part.xml"/></asset>
      <worldbody><attach model="part" body="arm" prefix="c-"/></worldbody></mujoco>"""
    (tmp_path / "whole.xml").write_text(whole)
    case = open_case(read_scene(tmp_path / "whole.xml"), "c-grip")
    told = [fault for fault in find_faults(case) if fault.kind == "density of water"]
    assert [(fault.place.file, fault.place.line) for fault in told] == [
        ("part.xml", line) for line in kinds_told.values()
    ]
    assert case.places.find("body", 1) == Place("part.xml", 4, "body 'c-arm'")
    for fault in told:  # the other geom weighs, too
        assert fault.change == 'mass="…", what it really weighs'


def test_start_beyond_all_numbers_is_named_at_its_keyframe(tmp_path: Path) -> None:
    plant = Plant("start not finite", "<!-- keys -->", f"<keyframe>{KEY}</keyframe>")
    assert "start not finite" not in kinds(faults_of(bench(tmp_path / "near", plant)))
    far = Plant(plant.kind, plant.old, plant.new.replace("0 0 0.03", "0 0 1e12"))
    scene = bench(tmp_path / "far", far)
    fault = one_of(far.kind, faults_of(scene))
    assert (fault.place.file, fault.place.line) == line_of(far, scene)


@pytest.mark.parametrize("medium", ["", 'density="1e-9"', 'density="1000" viscosity="0.9"'])
def test_unmetered_work_is_named_where_it_is_written(medium: str, tmp_path: Path) -> None:
    """Wind in water moves the tool; wind of a medium without mass gives no force."""
    option = GOOD_OPTION.replace("gravity", f'wind="1 0 0" {medium} gravity')
    found = faults_in(tmp_path, mjcf("\n", option, GOOD_CONTACT))
    told = [(fault.kind, fault.place.line) for fault in found]
    assert told == [("unmetered work", 2)] * bool(medium)


@pytest.mark.parametrize("workspace", [0.0, -1.0, np.nan, np.inf])
def test_workspace_must_be_a_length(workspace: float) -> None:
    with pytest.raises(DeviceError, match="workspace"):
        case_of(scene_path("point_mass"), workspace=workspace)


Capsys = pytest.CaptureFixture[str]

STILL = "t,x,y,z\n0,0,0,0\n0.1,0,0,0\n"
BALL = """<body name="tool" pos="0 0 0.05"><freejoint/><geom name="ball" size="0.01" mass="0.1"/>
  <site name="grip"/></body>"""
BRICKS = "".join(
    f'<geom name="brick_{k}" type="box" size="0.01 0.01 0.01" pos="{0.05 * k} 0 -0.01"/>'
    for k in range(3)
)


@pytest.mark.parametrize("words", ['<geom pos="0 nan 0"/>', '<geom solref="NaN 1"/>'])
def test_nan_is_refused_with_its_line(tmp_path: Path, words: str, capfd: Capsys) -> None:
    scene = written(tmp_path, mjcf("\n", "\n", body=BALL, world=words))
    with pytest.raises(SceneError, match=r"scene.xml, line 4: .* of <geom> is '.*'; write a n"):
        read_scene(scene)
    capfd.readouterr()  # MuJoCo's own warning


def test_time_step_is_written_where_it_is_missing_and_options_set_at_load_are_no_fault(
    tmp_path: Path,
) -> None:
    faults = faults_in(tmp_path, mjcf(body=BALL), STILL)
    change = one_of("time step", faults).change.split(" in <mujoco>")[0]
    assert change == '<option timestep="0.001"/>'
    assert not kinds(faults) & {"integrator", "solver", "diagexact"}
    # MuJoCo takes several options
    mended = faults_in(tmp_path, mjcf('<option solver="CG"/>', change, body=BALL), STILL)
    assert not kinds(mended) & {"integrator", "solver", "diagexact", "time step"}


def test_one_line_mends_the_default_contact_of_many_geoms(tmp_path: Path) -> None:
    text = mjcf(GOOD_OPTION, body=BALL, world=BRICKS)
    fault = one_of("default contact", faults_in(tmp_path, text, STILL, contact="scene"))
    line = fault.change.split("at once: ")[1].removesuffix(" in <default>")
    mended = mjcf(GOOD_OPTION, f"<default>{line}</default>", body=BALL, world=BRICKS)
    assert "default contact" not in kinds(faults_in(tmp_path, mended, STILL, contact="scene"))


def test_floor_under_a_flex_is_not_called_idle(tmp_path: Path) -> None:
    cloth = """<geom name="floor" type="plane" size="1 1 1"/><flexcomp name="cloth" type="grid"
      count="3 3 1" spacing="0.02 0.02 0.02" pos="0 0 0.002" mass="0.1" radius="0.003" dim="2">
      <edge equality="true"/></flexcomp>"""
    scene = written(tmp_path, mjcf(GOOD_OPTION, body=BALL, world=cloth), STILL)
    case = case_of(scene)
    inventory = take_inventory(case.model, "grip", case.places, case.observation)
    assert inventory.flexes == 1
    assert not inventory.idle
    draft = SceneVariant(case.source, "grip", RunPoint(case.coupling))
    assert "floor" in witness(draft, case.motion).near_geoms


@pytest.mark.parametrize(("mass", "is_told"), [(0.05, True), (20.0, False)])
def test_limit_that_hardly_gives_is_not_soft(tmp_path: Path, mass: float, is_told: bool) -> None:
    arm = f"""<body name="tool" gravcomp="1"><joint axis="0 0 1" range="-1 1"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="{mass}"/>
      <site name="grip" pos="0.3 0 0"/></body>"""
    text = mjcf('<compiler angle="radian"/>', GOOD_OPTION, GOOD_CONTACT, body=arm)
    faults = faults_in(tmp_path, text, STILL, contact="scene")
    assert ("soft limit" in kinds(faults)) == is_told


def test_bare_lever_creates_nothing(tmp_path: Path) -> None:
    # joint friction, however little, keeps a tool from being rendered losslessly
    lever = """<body name="tool" pos="0 0 0.1"><joint name="h" axis="0 1 0" frictionloss="1e-9"/>
      <geom type="capsule" fromto="0 0 0 0.1 0 0" size="0.01" mass="0.0356"/>
      <site name="grip" pos="0.1 0 0"/></body>"""
    text = mjcf(GOOD_OPTION, GOOD_CONTACT, body=lever)
    assert not CREATED & kinds(faults_in(tmp_path, text))


def test_what_has_no_name_is_called_after_its_body() -> None:
    spec = mujoco.MjSpec.from_string(
        '<mujoco><worldbody><geom size="1"/><body name="cup"><freejoint/><geom size="1"/>'
        '<geom size="1"/><geom name="cup_geom" size="1"/></body></worldbody></mujoco>'
    )
    name_everything(spec)
    assert [joint.name for joint in spec.joints] == ["cup_joint"]
    names = [geom.name for geom in spec.geoms]
    assert names == ["world_geom", "cup_geom_2", "cup_geom_3", "cup_geom"]


def lean_by(
    costs: list[float], taken: list[Simplification], folder: Path, patch: pytest.MonkeyPatch
) -> lean.Lean:
    """Searches a ball for what may go, at told costs: against itself, alone, then together."""
    patch.setattr(lean, "all_simplifications", lambda *_: taken)
    told, still = iter(costs), Motion([0.0, 0.1], [(0, 0, 0)] * 2)
    source = read_scene(written(folder, mjcf(GOOD_OPTION, GOOD_CONTACT, body=BALL)))
    setting = RunPoint(Coupling(2400.0, 0.5, 2.4, 5e-4))
    cost = lambda *_: (1.0, next(told, costs[-1]))  # noqa: E731
    return lean.find_lean(SceneVariant(source, "grip", setting), still, cost=cost)


def relax(draft: SceneVariant) -> bool:
    draft.spec.option.tolerance *= 100.0
    return True


@pytest.mark.parametrize(("again", "is_taken"), [(1.0, False), (0.5, True)])
def test_saving_that_is_gone_when_measured_again_is_noise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, again: float, is_taken: bool
) -> None:
    only = Simplification("tolerance", "the solver stops earlier", relax)
    found = lean_by([1.0, 0.5, 0.5, again], [only], tmp_path, monkeypatch)
    assert [trial.verdict for trial in found.alone] == [MAY_GO]
    assert bool(found.together) == is_taken
    assert found.result.cost == pytest.approx(again)
    assert found.draft.spec.option.tolerance == pytest.approx(1e-6 if is_taken else 1e-8)


def test_risky_change_is_taken_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    risky = Simplification("risky", "saves most", relax, loses=OTHER_MOTIONS)
    plain = [Simplification(name, "loses nothing", relax) for name in ("some", "more")]
    found = lean_by([1.0, 0.3, 0.8, 0.6, 0.5], [risky, *plain], tmp_path, monkeypatch)
    assert [trial.name for trial in found.together] == ["more", "some", "risky"]


HINGE = """<body name="tool"><joint name="turn" axis="0 1 0" range="{}"/>
  <geom size="0.01" pos="0.05 0 0" mass="0.1"/><site name="grip" pos="0.05 0 0"/></body>"""


@pytest.mark.parametrize(
    ("unit", "limits", "words"),
    [
        ("degree", "-0.78 0.78", "turns from -0.78 to 0.78 degrees; are these radians?"),
        ("degree", "-45 45", None),
        ("degree", "-2 2", None),
        (
            "radian",
            "-45 45",
            "turns from -45 to 45 radians, which is 7.16 turns; are these degrees?",
        ),
        ("radian", "-0.78 0.78", None),
        ("radian", "-0.01 0.01", None),
        ("radian", "-12.6 12.6", None),
    ],
)
def test_an_angle_in_the_wrong_unit_is_told(
    tmp_path: Path, unit: str, limits: str, words: str | None
) -> None:
    compiler = f'<compiler angle="{unit}"/>'
    text = mjcf(compiler, GOOD_OPTION, GOOD_CONTACT, body=HINGE.format(limits))
    told = [fault for fault in faults_in(tmp_path, text) if fault.kind == "angle unit"]
    assert [fault.sentence for fault in told] == ([f"joint 'turn' {words}"] if words else [])


@pytest.mark.parametrize(("gain", "is_told"), [(0.0, True), (1.0, True), (100.0, False)])
def test_what_a_servo_carries_the_hand_does_not(tmp_path: Path, gain: float, is_told: bool) -> None:
    servo = f'<actuator><position joint="turn" kp="{gain}"/></actuator>' if gain else ""
    body = HINGE.format("-90 90").replace('mass="0.1"', 'mass="0.8"')
    text = mjcf(HEAVY, GOOD_CONTACT, servo, body=body)
    told = [fault for fault in faults_in(tmp_path, text) if fault.kind == "heavy tool"]
    assert bool(told) == is_told
    if told:  # the moment about the hinge: m g r = (K r² + K_r + k) sag / r
        sag = 0.8 * 9.81 * 0.05**2 / (2400 * 0.05**2 + 2.4 + gain)
        assert _carried(told[0].sentence) == pytest.approx(2400 * sag, rel=5e-3)


def _carried(sentence: str) -> float:
    """Returns the force in N that a hand carries, as a sentence on a heavy tool says it."""
    return float(sentence.partition("the hand carries ")[2].partition(" N")[0])


TILTED = """<geom name="wall" type="box" size=".05 .2 .2" pos=".245 0 .03"/>
<body name="tool" euler="0 {} 0"><joint name="turn" axis="0 1 0"/><geom name="arm" type="capsule"
  fromto="0 0 0 .2 0 0" size=".02" mass="1.5"/><site name="grip" pos=".15 0 0"/></body>"""


@pytest.mark.parametrize("angle", [0.0, 70.0])
def test_a_weight_is_that_which_a_run_names_also_from_a_moved_start(
    tmp_path: Path, angle: float
) -> None:
    """At 0 deg the arm begins in the wall and is moved out; at 70 deg it begins free."""
    text = mjcf(HEAVY, GOOD_CONTACT, body=TILTED.format(angle))
    found = faults_in(tmp_path, text)
    assert any("start of joint 'turn'" in each.sentence for each in found) == (angle == 0.0)
    [told] = [fault.sentence for fault in found if fault.kind == "heavy tool"]
    coupling = Coupling(2400.0, 1.7, 2.4, 0.0017)
    device = SimulatedDevice()
    with Bridge(tmp_path / "scene.xml", device, coupling, clock=SimulatedClock()) as bridge:
        load, _ = bridge.setups[0].load_at_rest(bridge.session.parameters)
    assert _carried(told) == pytest.approx(load, rel=2e-3)  # it has three digits


@pytest.mark.parametrize("spring", [0.0, 100.0, 1000.0])
@pytest.mark.parametrize("holder", ["a tendon", "a servo of a tendon", "a servo of a site"])
def test_what_a_spring_beside_the_joints_carries_the_hand_does_not(
    tmp_path: Path, holder: str, spring: float
) -> None:
    is_tendon = holder == "a tendon"
    rope = f'<tendon><spatial name="rope" stiffness="{spring if is_tendon else 0}">'
    rope += '<site site="top"/><site site="grip"/></spatial></tendon>'
    where = (
        'tendon="rope"' if "tendon" in holder else 'site="grip" refsite="top" gear="0 0 1 0 0 0"'
    )
    start = 0.5 if "tendon" in holder else -0.5  # the servo is at its target
    servo = f'<actuator><position {where} kp="{spring}"/></actuator>'
    servo += f'<keyframe><key name="home" qpos="0" ctrl="{start}"/></keyframe>'
    body = """<body name="tool"><joint type="slide" axis="0 0 1"/><geom size="0.01" mass="0.3"/>
      <site name="grip"/></body>"""
    text = mjcf(HEAVY, GOOD_CONTACT, rope, "" if is_tendon or not spring else servo, body=body,
                world='<site name="top" pos="0 0 .5"/>')  # fmt: skip
    told = [fault.sentence for fault in faults_in(tmp_path, text) if fault.kind == "heavy tool"]
    sag = 0.3 * 9.81 / (2400.0 + spring)  # springs beside each other
    assert len(told) == (sag > 1e-3)
    for sentence in told:
        assert number(2400.0 * sag) in sentence and f"by {length(sag)} at rest" in sentence


@pytest.mark.parametrize(("mass", "is_told"), [(0.03, False), (0.1, True)])
def test_a_head_held_off_its_centre_is_told_by_its_torque(
    tmp_path: Path, mass: float, *, is_told: bool
) -> None:
    body = free(f'type="box" pos="0.3 0 0" size="0.015 0.015 0.04" mass="{mass}"')
    found = faults_in(tmp_path, mjcf(HEAVY, GOOD_CONTACT, body=body))
    told = [fault.sentence for fault in found if fault.kind == "heavy tool"]
    assert bool(told) == is_told
    if told:
        torque = 0.0
        for _ in range(20):  # K_r φ = m g r cos φ
            torque = mass * 9.81 * 0.3 * math.cos(torque / 2.4)
        droop = f"{math.degrees(torque / 2.4):.2g} deg"
        assert f"carries {number(torque)} N m about the grip, which turns the coupling" in told[0]
        assert f"of 2.4 N m/rad by {droop} at rest" in told[0]


@pytest.mark.parametrize(("active", "mass"), [("true", 0.55), ("false", None)])
@pytest.mark.parametrize("tie", ['<weld body1="tool" body2="load" {}/>',
    '<connect body1="tool" body2="load" anchor="0 0 -.05" {}/>'])  # fmt: skip
def test_what_is_tied_to_the_tool_hangs_in_the_hand(
    tmp_path: Path, tie: str, active: str, mass: float | None
) -> None:
    body = """<body name="tool"><joint type="slide" axis="0 0 1"/><geom size="0.01" mass="0.05"/>
      <site name="grip"/></body><body name="load" pos="0 0 -.1"><freejoint/>
      <geom size="0.01" mass="0.5"/></body>"""
    tied = "<equality>" + tie.format(f'active="{active}"') + "</equality>"
    found = faults_in(tmp_path, mjcf(HEAVY, GOOD_CONTACT, tied, body=body))
    told = [fault.sentence for fault in found if fault.kind == "heavy tool"]
    assert len(told) == (mass is not None)
    if mass is not None:
        assert weight(mass) in told[0]
        assert _carried(told[0]) == pytest.approx(mass * 9.81, rel=2e-3)
        assert length(mass * 9.81 / 2400) in told[0]


FOUR_BAR = """<body name="crank"><joint/><geom type="capsule" size=".02" fromto="0 0 0 0 .2 0"
  mass=".2"/><body name="coupler" pos="0 .2 0"><joint/><geom type="capsule" size=".02"
  fromto="0 0 0 .4 0 0" mass=".3"/><body name="rocker" pos=".4 0 0"><joint/><geom type="capsule"
  size=".02" fromto="0 0 0 0 -.2 0" mass=".2"/><site name="grip" pos="0 -.1 0"/></body></body>
  </body>"""
"""A parallelogram in the plane of x and y; its weight along y is borne where it is closed."""


@pytest.mark.parametrize("active", ["true", "false"])
def test_the_weight_of_a_linkage_that_its_closed_loop_bears_is_not_the_hands(
    tmp_path: Path, active: str
) -> None:
    option = GOOD_OPTION.replace('"0 0 0"', '"0 -9.81 0"')
    loop = f'<equality><connect body1="rocker" anchor="0 -.2 0" active="{active}"/></equality>'
    found = faults_in(tmp_path, mjcf(option, GOOD_CONTACT, loop, body=FOUR_BAR))
    told = [fault.sentence for fault in found if fault.kind == "heavy tool"]
    assert bool(told) == (active == "false")
    if told:  # the rocker, and the coupler's end
        assert f"carries {number((0.2 + 0.3 / 2) * 9.81)} N" in told[0]


TWO_KINDS = """<geom name="wall" type="box" size="0.01 0.1 0.1" pos="0.06 0 0" {wall}/>
<body name="tool"><freejoint/><site name="grip"/>
  <geom name="shell" type="box" size="0.02 0.02 0.02" mass="0.05" {shell}/>
  <geom name="tip" size="0.01" pos="0.025 0 0" {tip}/></body>"""


def test_what_is_advised_for_a_geom_does_not_contradict_itself(tmp_path: Path) -> None:
    settings = {"floor": "", "wall": 'solref="-1e5 -10"', "shell": "", "tip": 'solref="0.05 1"'}
    for folder in ("before", "after"):
        (tmp_path / folder).mkdir()
        floor = FLOOR.replace("/>", ' pos="0 0 -0.03" {floor}/>')
        body = (floor + TWO_KINDS).format(**settings)
        faults = faults_in(tmp_path / folder, mjcf(GOOD_OPTION, body=body), contact="scene")
        told = [fault for fault in faults if "solref=" in fault.change]
        if folder == "before":
            assert {"soft contact", "not passive"} <= {fault.kind for fault in told}
            (advised,) = {fault.change.split('"')[1] for fault in told}
            better = f'solref="{advised}" solimp="0.9 0.95 0.001"'
            settings = dict.fromkeys(settings, better)
    assert told == [], "what is advised mends the scene"


@pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass'")
def test_a_geom_is_not_of_water_where_the_file_states_the_mass_of_all(tmp_path: Path) -> None:
    body = '<body name="ball"><freejoint/><geom size="0.02"/><site name="grip"/></body>'
    for stated, is_told in (('<compiler settotalmass="14"/>', False), ("<compiler/>", True)):
        (tmp_path / f"{is_told}").mkdir()
        faults = faults_in(tmp_path / f"{is_told}", mjcf(stated, body=body))
        assert ("density of water" in kinds(faults)) == is_told


def test_mass_is_taken_from_what_is_only_seen_and_not_from_what_collides(tmp_path: Path) -> None:
    body = TWO_KINDS.format(wall="", shell='contype="0" conaffinity="0"', tip="")
    faults = faults_in(tmp_path, mjcf(GOOD_OPTION, body=body.replace('mass="0.05" ', "")))
    told = {fault.kind: fault for fault in faults if "water" in fault.sentence}
    seen, solid = told["visual geom with mass"], told["density of water"]
    assert (seen.place.element, seen.change) == ("geom 'shell'", 'mass="0"')
    assert solid.place.element == "geom 'tip'"
    assert solid.change.startswith('mass="…"')


@pytest.mark.parametrize(("mass", "expected"), [("0", "missing inertia"), ("0.1", "far grip")])
def test_a_tool_whose_inertia_is_refused_has_no_centre_that_the_grip_is_far_from(
    tmp_path: Path, mass: str, expected: str
) -> None:
    body = f"""<body name="tool" pos="0 0.7 0"><freejoint/>
        <geom size="0.01" mass="{mass}"/><site name="grip" pos="0 0 0.2"/></body>"""
    found = kinds(faults_in(tmp_path, mjcf(GOOD_OPTION, body=body), STILL))
    assert found & {"missing inertia", "far grip"} == {expected}


def test_a_tool_without_geoms_has_no_size_that_its_grip_is_far_from(tmp_path: Path) -> None:
    body = """<body name="tool" pos="0 0.7 0"><freejoint/>
        <inertial mass="0.1" pos="0 0 0" diaginertia="1e-4 1e-4 1e-4"/>
        <site name="grip" pos="0 0 0.05"/></body>"""
    assert "far grip" not in kinds(faults_in(tmp_path, mjcf(GOOD_OPTION, body=body), STILL))


@pytest.mark.parametrize(
    ("joints", "is_told"),
    [
        ("<freejoint/>", True),
        ("<joint axis='1 0 0'/>", False),
        ("<joint type='slide' axis='0 1 0'/><joint axis='1 0 0'/>", True),
        ("<joint type='slide'/>", False),
        ("<joint type='slide' axis='1 0 0'/><joint axis='0 0 1' pos='0 0 0.2'/>", False),
    ],
)
def test_a_far_grip_is_told_only_of_a_tool_that_pushes_turn_and_no_hinge_holds(
    joints: str, is_told: bool, tmp_path: Path
) -> None:
    body = f"""<body name="tool" pos="0 0.7 0">{joints}
        <geom size="0.01" mass="0.1"/><site name="grip" pos="0 0 0.2"/></body>"""
    found = kinds(faults_in(tmp_path, mjcf(GOOD_OPTION, body=body), STILL))
    assert ("far grip" in found) is is_told


@pytest.mark.parametrize(("floor", "is_told"), [("", True), (FLOOR, False)])
def test_a_body_that_falls_for_ever_is_told(tmp_path: Path, floor: str, is_told: bool) -> None:
    ball = '<body name="ball" pos="0.2 0 0.1"><freejoint/><geom size="0.02" mass="0.1"/></body>'
    text = mjcf(HEAVY, GOOD_CONTACT, body=floor + ball + HINGE.format("-90 90"))
    told = [fault for fault in faults_in(tmp_path, text) if fault.kind == "falling body"]
    assert [fault.place.element for fault in told] == (["body 'ball'"] if is_told else [])
    for fault in told:  # by half of g t² in the s of the hand's motion
        fallen = float(fault.sentence.split(" by ")[1].split(" m ")[0])
        seconds = case_of(written(tmp_path, text)).motion.duration
        assert fallen == pytest.approx(4.905 * seconds**2, rel=0.05)


LOWERED = "t,x,y,z\n" + "".join(f"{0.01 * k:.2f},0,0,{-0.006 * k:.3f}\n" for k in range(21))
"""A hand that goes down by 0.12 m in 0.2 s, in which a body falls by 0.196 m."""

TRAY = """<body name="tray">{}<geom type="box" size=".05 .05 .01" mass="1"/><site name="grip"/>
  </body><body name="ball" pos="0 0 0.03"><freejoint/><geom size="0.02" mass="0.01"/></body>"""


@pytest.mark.parametrize("joint", ['<joint type="slide" axis="0 0 1"/>', "<freejoint/>"])
def test_a_body_that_is_led_down_does_not_fall(joint: str, tmp_path: Path) -> None:
    """The hand holds the tray, and a ball rides on it."""
    scene = written(tmp_path, mjcf(HEAVY, GOOD_CONTACT, body=TRAY.format(joint)), LOWERED)
    assert "falling body" not in kinds(faults_of(scene, scene.with_suffix(".csv")))


ROPE = """<mujoco><worldbody><body name="tool"><joint name="up" type="slide" axis="0 0 1"/>
<geom size=".02" mass="{}" contype="0" conaffinity="0"/><site name="grip"/></body>
<body name="load" pos="1 0 0"><joint name="down" type="slide" axis="0 0 1"/>
<geom size=".05" mass="{}" contype="0" conaffinity="0"/></body></worldbody>
<tendon><fixed name="rope"><joint joint="up" coef="1"/><joint joint="down" coef="-1"/></fixed>
</tendon><equality><tendon tendon1="rope"/></equality></mujoco>"""


@pytest.mark.parametrize(("tool", "load", "is_load"), [(0.02, 1.0, True), (1.0, 0.02, False)])
def test_a_load_on_a_rope_is_told_apart_from_the_weight_of_the_tool(
    tool: float, load: float, tmp_path: Path, *, is_load: bool
) -> None:
    found = faults_in(tmp_path, ROPE.format(tool, load))
    (fault,) = [each for each in found if each.kind == "heavy tool"]
    assert ("most of it from bodies that hang on the tool" in fault.sentence) == is_load
    assert ("in those that hang on it" in fault.change) == is_load


def test_what_a_run_changes_by_itself_and_a_motor_that_pushes_are_notes(tmp_path: Path) -> None:
    joint = '<joint name="rail" axis="1 0 0" type="slide"/>'
    slide = f'<body name="tool">{joint}<geom size="0.01" mass="1"/>'
    motors = (
        '<actuator><{} joint="rail"/></actuator><keyframe><key name="home" ctrl="{}"/></keyframe>'
    )
    for motor, control, told in (
        ('motor gear="3"', 1.0, ["pushes joint 'rail' with 3 N"]),
        ('motor gear="3"', 0.0, []),
        ('position kp="300"', 0.01, ["pushes joint 'rail' with 3 N"]),  # 10 mm from its target
        ('position kp="300"', 0.0, []),
        ('position kp="300" forcerange="-0.05 0.05"', 0.01, []),
    ):
        text = mjcf(motors.format(motor, control), body=slide + '<site name="grip"/></body>')
        faults = faults_in(tmp_path, text, STILL)
        notes = [fault for fault in faults if fault.is_note]
        assert "time step" in {note.kind for note in notes}
        sentences = [fault.sentence for fault in notes if fault.kind == "motor"]
        rest = [fault.change.split(" in")[0] for fault in notes if fault.kind == "motor"]
        assert rest == ['ctrl="0"'] * len(told)
        assert [
            told_part in sentence for told_part, sentence in zip(told, sentences, strict=True)
        ] == ([True] * len(told))


@pytest.mark.parametrize(
    ("joint", "gear", "told"),
    [
        ("free", "0 2 0 0 0 0", "6 N"),
        ("free", "0 0 0 0 0 2", "6 N m"),
        ("ball", "0 2 0", "6 N m"),
        ("hinge", "2", "6 N m"),
        ("slide", "2", "6 N"),
    ],
)
def test_the_unit_of_a_motor_is_that_of_what_it_drives(
    joint: str, gear: str, told: str, tmp_path: Path
) -> None:
    """A control of 3 times a gear of 2."""
    body = f'<body name="tool"><joint name="j" type="{joint}"/><geom size="0.01" mass="0.1"/>'
    motor = (
        f'<actuator><motor name="m" joint="j" gear="{gear}"/></actuator>'
        '<keyframe><key name="home" ctrl="3"/></keyframe>'
    )
    text = mjcf(motor, body=body + '<site name="grip"/></body>')
    notes = [fault.sentence for fault in faults_in(tmp_path, text, STILL) if fault.kind == "motor"]
    assert notes and f"pushes joint 'j' with {told} from" in notes[0]


def test_what_a_motor_holds_against_gravity_is_not_told_but_what_it_pushes_beyond_is(
    tmp_path: Path,
) -> None:
    lift = '<body name="tool"><joint name="lift" type="slide"/><geom size="0.01" mass="1"/>'
    motor = (
        '<actuator><general name="hoist" {} gainprm="2" gear="3"/></actuator><tendon><fixed '
        'name="rope"><joint joint="lift" coef="1"/></fixed></tendon>'
        '<keyframe><key name="home" ctrl="{}"/></keyframe>'
    )
    for driven in ('joint="lift"', 'tendon="rope"'):
        for force, is_told in ((9.0, False), (9.81, False), (10.5, True), (-1.0, True)):
            text = mjcf(motor.format(driven, force / 6), body=lift + '<site name="grip"/></body>')
            found = [f for f in faults_in(tmp_path, text, STILL) if f.kind == "motor"]
            assert [fault.place.element for fault in found] == ["actuator 'hoist'"] * is_told
            assert all(f" with {abs(force):g} N from" in fault.sentence for fault in found)


@pytest.mark.parametrize(
    ("kind", "told"),
    [
        ('damper kv="4" ctrlrange="0 2"', []),  # takes 4 N s/m at control 1
        ('velocity kv="4"', ["pushes joint 'rail' with 12 N"]),  # brakes to 1 m/s, and drives there
        ('motor gear="-4"', ["pushes joint 'rail' with 4 N"]),
    ],
)
def test_an_actuator_that_only_brakes_is_no_motor(
    tmp_path: Path, kind: str, told: list[str]
) -> None:
    joint = '<joint name="rail" axis="1 0 0" type="slide"/>'
    slide = f'<body name="tool">{joint}<geom size="0.01" mass="1"/><site name="grip"/></body>'
    moving = f"""<actuator><{kind} joint="rail"/></actuator>
        <keyframe><key name="home" qvel="4" ctrl="1"/></keyframe>"""
    faults = [f for f in faults_in(tmp_path, mjcf(moving, body=slide), STILL) if f.kind == "motor"]
    assert [words in fault.sentence for words, fault in zip(told, faults, strict=True)] == (
        [True] * len(told)
    )


@pytest.mark.parametrize("seconds", [1.5, 0.2])
def test_a_long_motion_is_seen_as_far_as_the_work_goes_and_this_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seconds: float
) -> None:
    for module in ("case", "observe"):
        monkeypatch.setattr(f"hapticbridge.check.{module}.MAX_WORK", 6000)  # of 6 per tick
    (tmp_path / "far.csv").write_text(f"t,x,y,z\n0,0,0,0\n{seconds},0.001,0,0\n")
    case = case_of(scene_path("point_mass"), tmp_path / "far.csv")
    is_cut = case.motion_name.endswith("far.csv; the first 1 s of it alone")
    assert (is_cut, case.motion_name.endswith("far.csv")) == (seconds > 1, seconds < 1)
    endless = Motion(np.array([0.0, 1e12]), np.zeros((2, 3)), np.array([[1.0, 0, 0, 0]] * 2))
    assert samples_of(endless, 1e-3).size == 6001, "more than any memory holds"


def test_a_solver_at_its_limit_in_one_tick_of_thousands_is_no_fault() -> None:
    case = open_case(read_scene(scene_path("point_mass")))
    assert case.observation is not None
    ticks = case.samples.size
    for full, is_told in ((1, False), (ticks // 1000, False), (ticks // 1000 + 1, True)):
        seen = replace(case, observation=replace(case.observation, full_ticks=full))
        found = [fault for fault in run_faults(seen) if fault.kind == "solver iterations"]
        assert len(found) == is_told


def test_wrong_units_come_alone_because_all_else_follows_from_them(tmp_path: Path) -> None:
    (fault,) = faults_in(
        tmp_path, mjcf(HEAVY, GOOD_CONTACT, body=free('size="5 40" type="capsule"'))
    )
    assert fault.kind == "units"
    assert "more findings wait until this is mended" in fault.sentence


DRIVEN = """<mujoco><option timestep="0.001"/><worldbody>
<body><joint name="x" type="slide" axis="1 0 0" damping="{damping}"/>
<joint name="y" type="slide" axis="0 1 0" damping="2"/>
<geom size="0.02" mass="0.5"/><site name="grip"/></body></worldbody>
<tendon><fixed name="cable" damping="1"><joint joint="x" coef="2"/></fixed></tendon>
<actuator><general name="motor" {attributes} biastype="{biastype}" biasprm="0 0 {bias}"/></actuator>
</mujoco>"""


@pytest.mark.parametrize(
    ("driven", "limit"),
    [
        ('joint="x"', 8.0),
        ('joint="x" gear="2"', 2.0),
        ('tendon="cable"', 1.0 + 8.0 / 2**2),
        ('site="grip" gear="1 0 0 0 0 0"', 8.0),
        ('site="grip" gear="1 1 0 0 0 0"', 1 / (1 / 8.0 + 1 / 2.0)),
        ('joint="x" damping="3"', 8.0 + 3.0),
    ],
)
def test_a_motor_that_pushes_with_its_own_velocity_is_a_pump(
    tmp_path: Path, driven: str, limit: float
) -> None:
    def found(name: str, **numbers: object) -> list[Fault]:
        settings = {"damping": 8, "biastype": "affine", **numbers}
        scene = tmp_path / f"{name}.xml"
        scene.write_text(DRIVEN.format(attributes=driven, **settings))
        source = read_scene(scene)
        return [f for f in worst_faults(source, compile_scene(source)) if f.kind == "pump"]

    assert not found("borne", bias=0.99 * limit)
    (fault,) = found("faster", bias=1.01 * limit)
    assert fault.place.element == "actuator 'motor'"
    assert fault.place.line == 6
    assert "pushes" in fault.sentence and "harder the faster it moves" in fault.sentence
    assert not found("unused", bias=1.01 * limit, biastype="none")


GAINING = """<mujoco><option timestep="0.001"/><worldbody><body>
<joint name="x" type="slide" damping="3"/><geom size="0.02" mass="0.5"/><site name="grip"/></body>
</worldbody><actuator>{}</actuator></mujoco>"""
THREE = 'pid input="pos vel ff" kp="3" kv="0.1" joint="x"'
"""An actuator of three controls, so that those of the next one are not at its own number."""


@pytest.mark.parametrize(
    ("actuator", "told"),
    [
        ('general gaintype="affine" gainprm="0 0 2"', "velocity gain 2 at controls above 1.5"),
        ('general gaintype="affine" gainprm="0 0 -2"', "velocity gain -2 at controls below -1.5"),
        ('general gaintype="affine" gainprm="0 0 2" ctrlrange="-9 1.4"', ""),
        ('general gaintype="affine" gainprm="0 0 2" ctrlrange="-9 1.6"', "above 1.5"),
        ('damper kv="2" ctrlrange="0 9"', ""),
        ('general gaintype="affine" gainprm="3 4 0"', ""),
        (f'{THREE}/><general gaintype="affine" gainprm="0 0 2" ctrlrange="-9 1.4"', ""),
        (f'{THREE}/><general gaintype="affine" gainprm="0 0 2" ctrlrange="-9 1.6"', "above 1.5"),
    ],
)
def test_a_motor_whose_gain_grows_with_its_velocity_is_a_pump_under_some_control(
    tmp_path: Path, actuator: str, told: str
) -> None:
    found = faults_in(tmp_path, GAINING.format(f'<{actuator} joint="x"/>'))
    assert [told in f.sentence for f in found if f.kind == "pump"] == [True] * bool(told)


CHANGED_AT = [
    ('actuatorfrcrange="-1 1"', "", "scene.xml:3, joint 'turn'"),  # the only one
    ('actuatorfrcrange="-1 1" ref="1"', "", "scene.xml:3, joint 'turn'"),
    ('range="20 90" limited="true"', "", "scene.xml, key 'home'"),  # it starts beyond its limit
    (
        'range="20 90"',
        '<keyframe><key name="home" qpos="0.1"/></keyframe>',
        "scene.xml:5, key 'home'",
    ),
    ("", '<option><flag sleep="enable"/></option>', "scene.xml:5, <flag>"),
]


@pytest.mark.parametrize(("joint", "more", "place"), CHANGED_AT)
def test_a_change_is_told_at_its_element_and_not_at_the_option(
    tmp_path: Path, joint: str, more: str, place: str
) -> None:
    text = f"""<mujoco><option timestep="0.001" integrator="discrete" cone="elliptic"/>
    <worldbody><body name="tool">
    <joint name="turn" axis="0 1 0" {joint}/><geom size="0.01" pos="0.05 0 0" mass="0.1"/>
    <site name="grip" pos="0.05 0 0"/></body></worldbody>
    {more}</mujoco>"""
    found = [fault for fault in faults_in(tmp_path, text) if fault.kind == "changed"]
    assert place in {str(fault.place) for fault in found}
    assert "<option>" not in {fault.place.element for fault in found}


SPRINGS = """<mujoco><option timestep="0.001" integrator="discrete" {option}/><worldbody>
<body name="tool"><joint name="turn" type="slide" {joint}/><geom name="g" size="0.01" mass="0.1"
{geom}/><site name="grip"/></body></worldbody></mujoco>"""

BY_CONTACTS = [
    ({"option": 'tolerance="1e-4"'}, "tolerance: 0.0001 → 1e-08"),
    ({"option": 'iterations="7"'}, "iterations: 7 → 100"),
    ({"option": 'impratio="3"'}, "impratio: 3 → 1000"),
    ({}, "cone: pyramidal → elliptic"),
    # ω = √(d k/(1 − d)) at d = 0.9 and k = 100/s² is 30/s
    ({"geom": 'solref="-100 -20" solimp="0.9 0.9"'}, "geom 'g': a spring of 4.8 Hz → rigid"),
    ({"joint": 'range="-1 1" solreflimit="-100 -20" solimplimit="0.9 0.9"'}, "limit of joint"),
]


@pytest.mark.parametrize(("written_there", "words"), BY_CONTACTS)
def test_check_tells_what_the_contacts_of_a_run_change_as_the_run_does(
    tmp_path: Path, written_there: dict[str, str], words: str
) -> None:
    text = SPRINGS.format(**{"option": "", "joint": "", "geom": ""} | written_there)
    changed = [one for one in faults_in(tmp_path, text) if one.kind == "changed"]
    assert any(words in one.sentence for one in changed)
    assert all(one.is_note and "--contact scene" in one.change for one in changed)
    kept = [one for one in faults_in(tmp_path, text, contact="scene") if one.kind == "changed"]
    assert not kept


HANGS = """<mujoco><option timestep="0.001" integrator="discrete" cone="elliptic"/><worldbody>
<body><freejoint/><geom size=".02" mass="{mass}"/><site name="grip"/></body></worldbody></mujoco>"""


@pytest.mark.parametrize(("mass", "is_carried"), [(1.0, False), (1.1, True)])
def test_check_tells_that_a_run_carries_a_tool_in_its_words(
    tmp_path: Path, mass: float, is_carried: bool
) -> None:
    """The simulated device holds 10 N, and 1.1 kg weigh 10.8 N."""
    text = HANGS.format(mass=mass)
    changed = [one.sentence for one in faults_in(tmp_path, text) if one.kind == "changed"]
    with hb.Bridge(tmp_path / "scene.xml", clock=hb.SimulatedClock()) as bridge:
        told = [each for each in bridge.scene.changes if each.startswith("weight of the tool")]
    assert [each in changed[0] for each in told] == [True] * is_carried == [True] * len(changed)


def test_a_tool_that_starts_in_a_height_field_is_told_to_start_outside(tmp_path: Path) -> None:
    """The advice, followed, ends the finding."""
    text = """<mujoco><option timestep="0.001" integrator="discrete" cone="elliptic"/><asset>
    <hfield name="h" nrow="3" ncol="3" size="1 1 .02 .03" elevation="0 0 0 0 1 0 0 0 0"/></asset>
    <worldbody><geom type="hfield" hfield="h"/><body pos="0 0 {}"><freejoint/>
    <geom size=".02" mass="0.1"/><site name="grip"/></body></worldbody></mujoco>"""
    inside = faults_in(tmp_path, text.format(0.02))
    told = [fault for fault in inside if "start of" in fault.sentence]
    assert [(fault.kind, "parts apart" in fault.change) for fault in told] == [("changed", True)]
    outside = faults_in(tmp_path, text.format(0.06))
    assert not any("start" in fault.sentence for fault in outside)


def test_links_that_start_inside_each_other_are_told_to_be_excluded(tmp_path: Path) -> None:
    """The advice, followed, ends the finding."""
    text = """<mujoco><option timestep="0.001" integrator="discrete" cone="elliptic"/>
    <worldbody><body name="a"><joint axis="0 1 0"/><geom size=".02" mass="0.1"/>
    <body name="b" pos="0 0 .03"><joint axis="0 1 0"/><geom size=".001" mass="0.1"/>
    <body name="c"><joint axis="0 1 0"/><geom size=".02" mass="0.1"/><site name="grip"/></body>
    </body></body></worldbody>{}</mujoco>"""
    found = faults_in(tmp_path, text.format(""))
    told = [fault for fault in found if "<exclude>" in fault.change]
    assert [fault.kind for fault in told] == ["changed"]
    added = '<contact><exclude body1="a" body2="c"/></contact>'
    assert not any(
        "on → off" in fault.sentence for fault in faults_in(tmp_path, text.format(added))
    )


def test_a_size_for_too_many_rows_is_told_to_go_for_the_memory(tmp_path: Path) -> None:
    """The advice, followed, ends the finding; MuJoCo refuses the memory beside ``njmax``."""
    text = """<mujoco><size {}/><option timestep="0.001" integrator="discrete" cone="elliptic"/>
    <worldbody><body><freejoint/><geom size=".02" mass="0.1"/><site name="grip"/></body>
    </worldbody></mujoco>"""
    (fault,) = faults_in(tmp_path, text.format('njmax="5000" nconmax="5000"'))
    assert '(memory="128M")' in fault.sentence
    assert fault.change == "that memory in <size>, in place of njmax, nconmax and nstack"
    assert not faults_in(tmp_path, text.format('memory="128M"'))


def test_convex_pieces_open_the_hole_that_a_hull_fills(tmp_path: Path) -> None:
    """A square tube; the peg enters it once the advice is followed, and not before."""

    def corners(half: float) -> list[tuple[float, float, float]]:
        around = ((-half, -half), (half, -half), (half, half), (-half, half))
        return [(x, y, z) for z in (0.0, 0.05) for x, y in around]

    faces = []
    for i, j in ((0, 1), (1, 2), (2, 3), (3, 0)):
        for a, b, c, d in (
            (i, j, 4 + j, 4 + i),
            (8 + j, 8 + i, 12 + i, 12 + j),
            (4 + i, 4 + j, 12 + j, 12 + i),
            (j, i, 8 + i, 8 + j),
        ):
            faces += [a, b, c, a, c, d]
    vertices = " ".join(f"{v:g}" for point in corners(0.05) + corners(0.025) for v in point)
    walls = [("0.0125 .05 .025", f"{x} 0 .025") for x in (0.0375, -0.0375)]
    walls += [(".025 .0125 .025", f"0 {y} .025") for y in (0.0375, -0.0375)]
    boxes = "".join(f'<geom type="box" size="{size}" pos="{pos}"/>' for size, pos in walls)
    text = f"""<mujoco><option timestep="0.001"/><asset>
    <mesh name="tube" vertex="{vertices}" face="{" ".join(map(str, faces))}"/></asset><worldbody>
    <geom name="tube" type="mesh" mesh="tube" {{}}<body pos="0 0 .12"><freejoint/>
    <geom type="box" size=".015 .015 .04" mass="0.1"/><site name="grip"/></body></worldbody>
    </mujoco>"""
    down = "t,x,y,z\n0,0,0,0\n2,0,0,-0.07\n"
    fault = one_of("mesh not convex", faults_in(tmp_path, text.format("/>"), down))
    open_to_air = 'contype="0" conaffinity="0"'
    assert open_to_air in fault.change
    # the middle of a wall's edge is 25 mm from the hull's faces, the centres of triangles less
    assert "deep or deeper" in fault.sentence
    scene, motion = tmp_path / "tube.xml", tmp_path / "down.csv"
    motion.write_text(down)
    depths = []
    for words in ("/>", f"{open_to_air}/>{boxes}"):
        scene.write_text(text.format(words))
        device, clock = f"trajectory:{motion}", SimulatedClock()
        with Bridge(scene, device, clock=clock, tool_weight=False) as bridge:
            bridge.run()
            depths.append(bridge.scene.grip_pose()[2])
    assert depths[0] > 0.085
    assert depths[1] < 0.055
    mended = faults_in(tmp_path, text.format(f"{open_to_air}/>{boxes}"), down)
    assert "mesh not convex" not in kinds(mended)


BRIM = '<geom geom="brim"/>'


@pytest.mark.parametrize(
    ("body", "rest", "geom", "jumps"),
    [
        (LEAPING, "", BRIM, "the length"),
        (LEAPING, "", "", ""),
        (TWO_SIDED, 'springlength=".2"', BRIM, "the moment arms"),
        (TWO_SIDED, 'springlength=".2"', '<geom geom="brim" sidesite="side"/>', ""),
    ],
)
def test_energy_of_a_tendon_that_jumps_is_put_down_to_the_tendon(
    tmp_path: Path, body: str, rest: str, geom: str, jumps: str
) -> None:
    path = f'<site site="a"/>{geom}<site site="b"/>'
    cord = f'<tendon><spatial name="cord" stiffness="100" {rest}>{path}</spatial></tendon>'
    found = faults_in(tmp_path, mjcf(GOOD_OPTION, cord, body=body))
    told = [fault for fault in found if fault.kind in CREATED]
    assert bool(told) == bool(jumps)
    for fault in told:
        assert fault.sentence.startswith(jumps)
        assert (fault.place.element, "damping" in fault.change) == ("tendon 'cord'", False)


SLACK_CORD = """<site name="a" pos="0 0 -.16"/><geom name="brim" size=".03" pos="0 0 -.1"
  contype="0" conaffinity="0"/>"""
CORD_OVER_BRIM = (
    '<tendon><spatial name="cord"><site site="a"/><geom geom="brim"/><site site="grip"/></spatial>'
)


def test_a_tendon_that_pulls_at_nothing_creates_no_energy_as_it_jumps(tmp_path: Path) -> None:
    """A ball that slides to and fro as it taps on the hard floor swings its cord round a brim."""
    text = HARD_FLOOR.replace("<worldbody>", f"<worldbody>{SLACK_CORD}")
    text = text.replace("</mujoco>", f"{CORD_OVER_BRIM}</tendon></mujoco>")
    times = np.arange(0.0, 1.0, 1e-3)
    places = 0.003 * np.sin(20 * times), -0.004 * (1 - np.cos(40 * times))
    rows = "".join(f"{t:.4f},{x:.6f},0,{z:.6f}\n" for t, x, z in zip(times, *places, strict=True))
    scene = written(tmp_path, text, f"t,x,y,z\n{rows}")
    found = faults_of(scene, scene.with_suffix(".csv"), contact="scene")
    (told,) = [fault for fault in found if fault.kind in CREATED]
    assert "was between geom 1 of the world and geom 2 of body 'ball'" in told.sentence
    assert "cord" not in told.sentence


ARM_WITH_SENSORS = """<body name="arm"><joint name="lift" type="slide" axis="0 0 1"/>
  <site name="wrist"/>
  <geom size="0.01" mass="0.05" {off}/><body name="hand" pos="0 0 -.1"><site name="grip"/>
    <geom size="0.01" mass="0.02" {off}/></body>
  <body name="finger" pos=".1 0 0"><joint name="bend" axis="0 1 0" damping="1"/><site name="pad"/>
    <geom size="0.01" mass="0.02" {off}/></body></body>"""


def test_sensor_that_carries_the_grip_is_told_to_read_the_coupling(tmp_path: Path) -> None:
    sensors = """<sensor><force name="at wrist" site="wrist"/><torque name="too" site="wrist"/>
      <force name="at pad" site="pad"/><framepos objtype="site" objname="wrist"/>
      <jointactuatorfrc name="of lift" joint="lift"/>
      <jointactuatorfrc name="of finger" joint="bend"/></sensor>"""
    body = ARM_WITH_SENSORS.format(off='contype="0" conaffinity="0"')
    text = mjcf(GOOD_OPTION, GOOD_CONTACT, sensors, body=body)
    told = [fault for fault in faults_in(tmp_path, text) if fault.kind == "force sensor"]
    assert [fault.place.element for fault in told] == [
        "force 'at wrist'",
        "torque 'too'",
        "jointactuatorfrc 'of lift'",
    ]
    assert "'of lift' is of a joint that moves the grip" in told[2].sentence


def test_a_contact_sensor_that_finds_contacts_ahead_is_told(tmp_path: Path) -> None:
    sensors = """<sensor><contact name="touches" geom1="tip" data="found force" reduce="netforce"/>
      <contact name="first" geom1="tip" data="force"/><touch site="grip"/>
      <contact name="push" geom1="tip" data="force torque" reduce="netforce"/></sensor>"""
    body = """<body name="tool"><freejoint/><geom name="tip" size="0.01" mass="0.05"/>
      <site name="grip"/></body>"""
    found = faults_in(tmp_path, mjcf(GOOD_OPTION, GOOD_CONTACT, sensors, body=body))
    told = [fault.place.element for fault in found if fault.kind == "contact sensor"]
    assert told == ["contact 'touches'", "contact 'first'"]


BLOCK = """<robot name="block">
<link name="world"><collision><geometry><box size="1 1 .1"/></geometry></collision></link>
<joint name="free" type="floating"><origin xyz="0 0 .2"/><parent link="world"/>
<child link="block"/></joint>
<link name="block"><inertial><mass value="0.2"/>
<inertia ixx="2e-4" ixy="0" ixz="0" iyy="2e-4" iyz="0" izz="2e-4"/></inertial>
<collision><geometry><box size=".085 .085 .085"/></geometry></collision>
{}</link></robot>"""


@pytest.mark.parametrize("tag", DROPPED)
def test_what_mujoco_does_not_read_in_a_urdf_is_told(
    call: Called, tmp_path: Path, tag: str
) -> None:
    plain, told = tmp_path / "plain.urdf", tmp_path / "told.urdf"
    plain.write_text(BLOCK.format(""))
    told.write_text(BLOCK.format(f'<{tag}><lateral_friction value="20"/><mu1 value="20"/></{tag}>'))
    models = [mujoco.MjModel.from_xml_path(str(path)) for path in (plain, told)]
    assert model_digest(models[0]) == model_digest(models[1])
    words = f"MuJoCo does not read <{tag}> of a URDF"
    for path in (plain, told):
        for command in ("check", "run"):
            more = ("--fast", "--duration", 0.02) if command == "run" else ()
            code, out, err = call(command, path, "--grip", "block", *more)
            assert code == 0
            assert (words in " ".join((out + err).split())) == (path == told)
