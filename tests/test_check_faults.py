from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from check_scenes import (
    GOOD_CONTACT,
    GOOD_OPTION,
    KEY,
    PLANTS,
    Plant,
    bench,
    case_of,
    faults_of,
    kinds,
    line_of,
    peg_with,
    written,
)
from outside_scenes import hand_rows, mjcf

from hapticbridge.check.case import open_case
from hapticbridge.check.fault import Fault, length, weight
from hapticbridge.check.physics import depth_under
from hapticbridge.check.run_faults import find_faults
from hapticbridge.coupling import Coupling
from hapticbridge.errors import DeviceError, SceneError
from hapticbridge.scene import read_scene, scene_names, scene_path

CONSEQUENCES = {"energy created", "MuJoCo warning", "solver iterations"}
"""What a planted fault may lead to in the motion."""


@pytest.fixture(scope="module")
def mended(tmp_path_factory: pytest.TempPathFactory) -> tuple[Fault, ...]:
    return faults_of(bench(tmp_path_factory.mktemp("mended") / "scene"))


def test_mended_scene_has_no_fault(mended: tuple[Fault, ...]) -> None:
    assert mended == ()


@pytest.mark.parametrize("plant", PLANTS, ids=lambda plant: plant.kind)
def test_planted_fault_alone_is_named_with_file_and_line(tmp_path: Path, plant: Plant) -> None:
    scene = bench(tmp_path / "scene", plant)
    faults = faults_of(scene)
    assert kinds(faults) - CONSEQUENCES <= {plant.kind}
    (fault,) = (fault for fault in faults if fault.kind == plant.kind)
    assert (fault.place.file, fault.place.line) == line_of(plant, scene)
    assert fault.sentence
    assert fault.change


def test_an_inertia_that_no_body_has_is_not_called_missing_and_its_stand_in_is_told(
    tmp_path: Path,
) -> None:
    box = 'size="0.01 0.01 0.01" mass="0.1"/>'
    inertial = '<inertial pos="0 0 0" mass="0.1" diaginertia="1 1 9"/>'
    plant = Plant("impossible inertia", box, box + inertial, file="parts.xml")
    found = faults_of(bench(tmp_path / "scene", plant))
    (fault,) = (each for each in found if "inertia" in each.kind)
    assert fault.kind == plant.kind
    assert "judged with 0.01 kg and 1e-06 kg m²" in fault.sentence
    assert 'balanceinertia="true"' in fault.change


def test_all_planted_faults_are_named_together(tmp_path: Path) -> None:
    scene = bench(tmp_path / "scene", *PLANTS)
    found = {(fault.kind, fault.place.file, fault.place.line) for fault in faults_of(scene)}
    assert {(plant.kind, *line_of(plant, scene)) for plant in PLANTS} <= found
    assert len(PLANTS) >= 12


@pytest.mark.parametrize("name", scene_names())
def test_shipped_scene_has_no_fault(name: str) -> None:
    assert faults_of(scene_path(name)) == ()


def test_peg_sinks_deeper_than_its_clearance_with_mujocos_default(tmp_path: Path) -> None:
    case = case_of(peg_with(tmp_path, "0.02 1"))
    assert case.observation is not None
    (fault,) = (fault for fault in find_faults(case) if fault.kind == "default contact")
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
def test_contact_softer_than_it_need_be_is_told_in_a_narrow_clearance(
    tmp_path: Path, solref: str, clearance: float, is_told: bool
) -> None:
    source = read_scene(peg_with(tmp_path, solref), clearance=clearance)
    faults = find_faults(open_case(source))
    assert ("soft contact" in kinds(faults)) == is_told
    if is_told:
        told = next(f.sentence for f in faults if f.kind == "soft contact")
        room = float(told.split("into a clearance of ")[1].split(" µm")[0])
        assert room == pytest.approx(1e6 * clearance, rel=0.05)  # of postures, none quite straight


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
def test_geom_whose_setting_spoils_the_mean_is_named(
    tmp_path: Path, floor: str, tool: str, place: str
) -> None:
    text = mjcf(
        GOOD_OPTION,
        body=f'<body name="tool" pos="0 0 0.05"><freejoint/><geom name="ball" size="0.01" '
        f'mass="0.1" {tool}/><site name="grip"/></body>',
        world=f'<geom name="floor" type="plane" size="1 1 1" {floor}/>',
    )
    found = [f for f in faults_of(written(tmp_path, text)) if f.place.element.startswith("geom")]
    assert [fault.place.element for fault in found] == [place]
    assert ("geom 'floor'" in found[0].change) == (floor == tool)


def test_explicit_pair_is_named_instead_of_its_geoms(tmp_path: Path) -> None:
    text = mjcf(
        GOOD_OPTION,
        GOOD_CONTACT,
        '<contact><pair name="rest" geom1="floor" geom2="ball" solref="0.03 1"/></contact>',
        body='<body name="tool" pos="0 0 0.05"><freejoint/><geom name="ball" size="0.01" '
        'mass="0.1"/><site name="grip"/></body>',
        world='<geom name="floor" type="plane" size="1 1 1"/>',
    )
    (fault,) = faults_of(written(tmp_path, text))
    assert (fault.kind, fault.place.element) == ("soft contact", "pair 'rest'")


@pytest.mark.parametrize(("mass", "is_told"), [(0.24, False), (0.25, True)])
def test_tool_that_sags_by_more_than_a_millimetre_is_heavy(
    tmp_path: Path, mass: float, is_told: bool
) -> None:
    text = mjcf(
        GOOD_OPTION.replace('"0 0 0"', '"0 0 -9.81"'),
        GOOD_CONTACT,
        body=f'<body name="tool"><freejoint/><geom size="0.01" mass="{mass}"/>'
        '<site name="grip" pos="0.005 0 0"/></body>',
    )
    coupling = Coupling(stiffness=2400, damping=1, rotational_stiffness=1e6, rotational_damping=1)
    case = case_of(written(tmp_path, text), coupling=coupling)
    found = [fault for fault in find_faults(case) if fault.kind == "heavy tool"]
    assert len(found) == is_told
    if found:
        assert f"by {length(mass * 9.81 / 2400)} at rest" in found[0].sentence


@pytest.mark.parametrize(("load", "is_told"), [(0.9, False), (1.1, True)])
def test_load_a_thousand_times_its_carrier_is_told(
    tmp_path: Path, load: float, is_told: bool
) -> None:
    text = mjcf(
        GOOD_OPTION,
        body='<body name="link"><joint/><geom size="0.01" mass="0.001"/>'
        f'<body name="load" pos="0.1 0 0"><joint/><geom size="0.02" mass="{load}"/>'
        '<site name="grip"/></body></body>',
    )
    faults = faults_of(written(tmp_path, text))
    assert ("mass ratio" in kinds(faults)) == is_told


@pytest.mark.parametrize(
    ("size", "mass", "is_told"), [(1.0, 40, False), (1.6, 40, True), (1.0, 60, True)]
)
def test_tool_that_no_hand_holds_has_other_units(
    tmp_path: Path, size: float, mass: float, is_told: bool
) -> None:
    text = mjcf(
        GOOD_OPTION,
        GOOD_CONTACT,
        body=f'<body name="tool"><freejoint/><geom size="{size}" mass="{mass}"/>'
        '<site name="grip"/></body>',
    )
    found = [f for f in faults_of(written(tmp_path, text)) if f.kind == "units"]
    assert len(found) == is_told
    if found:
        assert (f"{length(2 * size)} long" in found[0].sentence) == (size > 1.5)
        assert (f"weighs {weight(mass)}" in found[0].sentence) == (mass > 50)


@pytest.mark.parametrize(
    ("workspace", "scale", "is_told"),
    [(0.21, 1.0, False), (0.19, 1.0, True), (0.19, 1.1, False), (0.11, 1.9, False)],
)
def test_motion_that_the_device_cannot_make_is_told(
    tmp_path: Path, workspace: float, scale: float, is_told: bool
) -> None:
    text = mjcf(GOOD_OPTION, GOOD_CONTACT)
    motion = hand_rows([(0.5, (0.1, 0, 0)), (0.5, (-0.1, 0, 0))])
    faults = faults_of(written(tmp_path, text, motion), workspace=workspace, scale=scale)
    assert ("workspace" in kinds(faults)) == is_told


def test_time_step_is_no_fault_where_the_rate_was_asked_for(tmp_path: Path) -> None:
    assert "time step" not in kinds(faults_of(bench(tmp_path / "scene"), period=0.5e-3))


def test_contact_that_created_energy_is_named_with_a_setting_that_does_not(tmp_path: Path) -> None:
    source = read_scene("peg_in_hole", clearance=1e-3)
    (fault,) = find_faults(open_case(source))
    assert fault.kind == "energy created"
    assert "% of the coupling's slack, which covers it" in fault.sentence
    change = fault.change.split(" there")[0]
    assert change == 'solref="0.0005 8"'
    mended = read_scene(peg_with(tmp_path, "0.0005 8"), clearance=1e-3)
    assert find_faults(open_case(mended)) == ()


def test_motion_that_does_not_end_is_a_fault_and_no_error(tmp_path: Path) -> None:
    text = mjcf(
        GOOD_OPTION,
        GOOD_CONTACT,
        world='<body name="wild"><joint name="wild" type="slide"/><geom size="0.01" mass="0.1" '
        'contype="0"/></body>',
    ).replace(
        "</mujoco>",
        '<actuator><general joint="wild" biastype="affine" biasprm="1 1e8 0"/></actuator></mujoco>',
    )
    case = case_of(written(tmp_path, text))
    assert case.observation is None
    (fault,) = (fault for fault in find_faults(case) if fault.kind == "motion not finished")
    assert "not finite after tick" in fault.sentence


def test_start_beyond_all_numbers_is_named_at_its_keyframe(tmp_path: Path) -> None:
    plant = Plant("start not finite", "<!-- keys -->", f"<keyframe>{KEY}</keyframe>")
    assert "start not finite" not in kinds(faults_of(bench(tmp_path / "near", plant)))
    far = Plant(plant.kind, plant.old, plant.new.replace("0 0 0.03", "0 0 1e12"))
    scene = bench(tmp_path / "far", far)
    (fault,) = (fault for fault in faults_of(scene) if fault.kind == far.kind)
    assert (fault.place.file, fault.place.line) == line_of(far, scene)


def test_unmetered_work_is_named_where_it_is_written(tmp_path: Path) -> None:
    option = GOOD_OPTION.replace("gravity", 'wind="1 0 0" gravity')
    (fault,) = faults_of(written(tmp_path, mjcf("\n", option, GOOD_CONTACT)))
    assert (fault.kind, fault.place.line) == ("unmetered work", 2)


@pytest.mark.parametrize("workspace", [0.0, -1.0, np.nan, np.inf])
def test_workspace_must_be_a_length(workspace: float) -> None:
    with pytest.raises(DeviceError, match="workspace"):
        case_of(scene_path("point_mass"), workspace=workspace)


def test_what_is_no_inertia_is_an_error_of_the_scene(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="nowhere"):
        case_of(bench(tmp_path / "scene"), grip="nowhere")
