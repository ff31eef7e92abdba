"""Counts of what a scene models, against MuJoCo's own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from check_scenes import GOOD_CONTACT, GOOD_OPTION, bench, case_of, shipped_case, written
from outside_scenes import mjcf

from hapticbridge.check import inventory
from hapticbridge.check.case import SceneUnderCheck
from hapticbridge.check.inventory import Inventory, take_inventory
from hapticbridge.scene import load_scene, read_scene, scene_names, scene_path
from hapticbridge.scene.contacts import meeting_pairs
from hapticbridge.scene.source_map import Places


def inventory_of(scene: Path, **options: Any) -> Inventory:
    return inventory_in(case_of(scene, **options))


def inventory_in(case: SceneUnderCheck) -> Inventory:
    return take_inventory(case.model, case.scene.grip, case.places, case.observation)


@pytest.mark.parametrize("name", scene_names(1))
def test_counts_are_those_of_the_model_without_the_bridge(name: str) -> None:
    path = scene_path(name)
    plain = mujoco.MjModel.from_xml_path(str(path))
    scene = load_scene(path)
    counted = take_inventory(scene.model, scene.grip, Places(read_scene(path), scene.model))
    assert (counted.bodies, counted.degrees_of_freedom) == (plain.nbody - 1, plain.nv)
    assert (sum(counted.geoms.values()), counted.actuators) == (plain.ngeom, plain.nactuator)
    assert (counted.equalities, counted.tendons) == (plain.neq, plain.ntendon)
    is_visual = (plain.geom_contype | plain.geom_conaffinity) == 0
    assert counted.geoms[inventory.VISUAL] == np.count_nonzero(is_visual)


def heap(seed: int) -> str:
    """Geoms of random masks in one place, on bodies in and below each other, some excluded."""
    random = np.random.default_rng(seed)
    bodies = []
    for k in range(4):
        joint = '<joint type="slide"/>' if random.random() < 0.7 else ""
        geoms = "".join(
            f'<geom size="0.1" mass="1" contype="{random.integers(4)}" '
            f'conaffinity="{random.integers(4)}"/>'
            for _ in range(2)
        )
        bodies.append(f'<body name="b{k}">{joint}{geoms}{{}}</body>')
    nested = bodies[0].format(bodies[1].format(""))
    return f"""<mujoco>
      <default><geom condim="1"/></default>
      <worldbody>
        <geom name="w0" size="0.1"/><geom name="w1" size="0.1"/>
        {nested}{bodies[2].format(bodies[3].format(""))}
        <body name="p"><joint type="slide"/>
          <geom name="p" size="0.1" mass="1" contype="0" conaffinity="0"/></body>
      </worldbody>
      <contact><exclude body1="b0" body2="b2"/><pair geom1="p" geom2="w0"/></contact>
    </mujoco>"""


@pytest.mark.parametrize("seed", range(8))
def test_pairs_that_can_meet_are_those_that_mujoco_lets_meet(seed: int) -> None:
    model = mujoco.MjModel.from_xml_string(heap(seed))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    found = {tuple(sorted(pair)) for pair in data.contact.geom.tolist()}
    pairs = [tuple(sorted(pair[:2])) for pair in meeting_pairs(model)]
    assert len(pairs) == len(set(pairs))
    assert set(pairs) == found
    assert found


def test_disabled_contacts_cannot_meet() -> None:
    model = mujoco.MjModel.from_xml_string(heap(0))
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    assert list(meeting_pairs(model)) == []


HAND = "t,x,y,z\n0,0,0,0\n0.1,0,0,-0.002\n0.5,0,0,-0.002\n"
ROWS = mjcf(
    GOOD_OPTION,
    GOOD_CONTACT,
    body='<body name="tool" pos="0 0 0.0101"><freejoint/><geom size="0.01" mass="0.1"/>'
    '<site name="grip"/></body>',
    world="""<geom name="floor" type="plane" size="1 1 1"/>
    <body name="held" pos="1 0 1"><joint type="hinge" frictionloss="1"/><geom size="0.01" mass="1"/>
      <body pos="0.1 0 0"><joint name="bent" type="hinge" limited="true" range="10 20"
        stiffness="10"/>
        <geom size="0.01" mass="1"/></body></body>
    <body name="pinned" pos="2 0 1"><freejoint/><geom size="0.01" mass="1"/></body>""",
).replace("</mujoco>", '<equality><connect body1="pinned" anchor="0 0 0"/></equality></mujoco>')


def test_constraint_rows_are_counted_by_kind(tmp_path: Path) -> None:
    rows = inventory_of(written(tmp_path, ROWS, HAND), contact="scene").rows
    assert rows is not None
    assert rows["contact"] == (3, 3.0)  # one contact of three dimensions, elliptic
    assert rows["friction loss"] == (1, 1.0)
    assert rows["limit"] == (1, 1.0)  # zero is below its range
    assert rows["equality"] == (3, 3.0)
    pyramid = written(tmp_path, ROWS.replace("elliptic", "pyramidal"), HAND)
    assert (inventory_of(pyramid, contact="scene").rows or {})["contact"] == (4, 4.0)


@pytest.mark.parametrize("contact", ["rigid", "scene"])
@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
@pytest.mark.parametrize("condim", [1, 3, 4])
def test_stiffness_seen_is_force_over_depth_at_rest(
    tmp_path: Path, cone: str, condim: int, contact: str
) -> None:
    text = ROWS.replace("elliptic", cone).replace("<geom solref", f'<geom condim="{condim}" solref')
    if contact == "rigid":  # or the limit, which starts far beyond, takes all energy of the tank
        text = text.replace('limited="true"', 'limited="false"')
    case = case_of(written(tmp_path, text, HAND), contact=contact)
    assert case.observation is not None
    (meeting,) = case.observation.meetings.values()
    data, force = case.scene.data, np.zeros(6)
    mujoco.mj_contactForce(case.model, data, 0, force)
    assert force[0] == pytest.approx(4.5, rel=0.1)  # 1.9 mm of the coupling
    # impedance grows by 0.1 % over this depth
    assert meeting.softest <= 1.001 * force[0] / -data.contact[0].dist
    assert meeting.stiffest == pytest.approx(force[0] / -data.contact[0].dist, rel=2e-3)
    counted = take_inventory(case.model, "grip", case.places, case.observation)
    assert counted.stiffness == (meeting.softest, meeting.stiffest)
    assert counted.deepest == meeting.deepest


def test_geoms_are_sorted_by_what_they_met(tmp_path: Path) -> None:
    counted = inventory_of(bench(tmp_path / "scene"))
    # shaft; floor and button; block; slider; stop; cap
    once = (
        inventory.TOOL,
        inventory.MEETS_OTHER,
        inventory.MOVING,
        inventory.FIXED,
        inventory.VISUAL,
    )
    assert counted.geoms == {**dict.fromkeys(once, 1), inventory.MEETS_TOOL: 2}
    assert counted.met_pairs == 3
    # of five things four move: all meet all but themselves, the cap nothing
    assert counted.possible_pairs == 4 * 2 + 6
    assert counted.triangles == 8
    assert counted.moving_bodies == counted.bodies == 4
    assert counted.tool_degrees_of_freedom == 6
    assert counted.tool_mass == pytest.approx(0.5)


def test_what_cannot_influence_the_grip_is_named(tmp_path: Path) -> None:
    scene = bench(tmp_path / "scene")
    idle = {each.place.element: each for each in inventory_of(scene).idle}
    assert set(idle) == {"body 'slider'", "body 'block'", "geom 'cap'", "geom 'stop'"}
    assert "never touches the tool" in idle["body 'block'"].reason
    assert idle["geom 'cap'"].reason == inventory.VISUAL
    assert idle["geom 'stop'"].reason == (
        "fixed, and never met by the tool, nor by what moves it in the motion"
    )
    assert idle["body 'block'"].place.file == "parts.xml"


WELD = '<weld body1="tool" body2="a"/>'
CORD = '<spatial><site site="grip"/><site site="sa"/></spatial>'
MIX = '<fixed><joint joint="ja" coef="1"/><joint joint="jb" coef="1"/></fixed>'


@pytest.mark.parametrize(
    ("joints", "reached"),
    [
        ("", set()),
        ('<equality><connect body1="a" body2="b" anchor="0 0 0"/></equality>', set()),
        (f"<equality>{WELD}</equality>", {"a"}),
        (f"<equality>{WELD}<joint joint1='ja' joint2='jb'/></equality>", {"a", "b"}),
        ('<equality><connect site1="grip" site2="sa"/></equality>', {"a"}),
        (f"<tendon>{CORD}</tendon>", {"a"}),
        (f"<tendon>{CORD}{MIX}</tendon>", {"a", "b"}),
    ],
)
def test_tendons_and_equalities_influence(tmp_path: Path, joints: str, reached: set[str]) -> None:
    others = "".join(
        f'<body name="{name}" pos="{x} 0 0"><joint name="j{name}" type="slide"/>'
        f'<geom name="{name}" size="0.01" mass="0.1" contype="0" conaffinity="0"/>'
        f'<site name="s{name}"/></body>'
        for name, x in (("a", 0.5), ("b", 1.0))
    )
    text = mjcf(GOOD_OPTION, world=others).replace("</mujoco>", f"{joints}</mujoco>")
    idle = inventory_of(written(tmp_path, text)).idle
    named = {each.place.element for each in idle if each.place.element.startswith("body")}
    assert named == {f"body '{name}'" for name in ("a", "b") if name not in reached}


def test_without_a_motion_what_can_meet_counts_as_met(tmp_path: Path) -> None:
    case = case_of(bench(tmp_path / "scene"))
    counted = take_inventory(case.model, "grip", case.places)
    assert counted.rows is None
    assert counted.met_pairs is None
    assert [each.place.element for each in counted.idle] == ["geom 'cap'"]


def test_geoms_without_a_name_in_an_included_file_are_told_apart(tmp_path: Path) -> None:
    parts = """<mujoco><default><geom condim="3"/></default><worldbody>
      <geom size="0.01" pos="1 0 0"/>
      <geom name="named" size="0.01"/>
      <geom size="0.01" pos="2 0 0"/></worldbody></mujoco>"""
    (tmp_path / "parts.xml").write_text(parts, encoding="utf-8")
    case = case_of(written(tmp_path, mjcf('<include file="parts.xml"/>', GOOD_OPTION)))
    model = case.model
    found = {float(model.geom_pos[g, 0]): case.places.find("geom", g) for g in range(3)}
    places = [(found[x].file, found[x].line) for x in (1.0, 2.0)]
    assert places == [("parts.xml", 2), ("parts.xml", 4)]


@pytest.mark.parametrize("is_fused", [False, True])
def test_an_unnamed_element_behind_a_fusion_has_no_line_of_another(
    is_fused: bool, tmp_path: Path
) -> None:
    """MuJoCo moves the bodies of a fused one behind the others, so that their numbers change."""
    block = "<joint/><geom size='.1'/></body>"
    base = f"<body>\n<body pos='7 0 0'>\n{block}</body>\n<body pos='9 0 0'>\n{block}"
    fuse = f"<compiler fusestatic='{str(is_fused).lower()}'/>"
    case = case_of(written(tmp_path, mjcf(fuse, GOOD_OPTION, world=base)))
    at = int(np.flatnonzero(case.model.body_pos[:, 0] == 9.0)[0])
    text = case.source.path.read_text().splitlines()
    line = case.places.find("body", at).line
    assert (line == 0) if is_fused else ("<body pos='9 0 0'>" in text[line - 1])


def test_places_of_a_repeated_element_are_the_line_that_repeats_it() -> None:
    source = read_scene("round_peg")
    places = Places(source, shipped_case("round_peg").model)
    text = source.path.read_text(encoding="utf-8").splitlines()
    assert '<geom name="sector"' in text[places.find("geom", 5).line - 1]
    assert places.find("geom", 5).element.startswith("geom 'sector_")
