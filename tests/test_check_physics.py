"""The numbers in what ``check`` says, against MuJoCo at rest and against closed forms."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from check_scenes import CUP_DEPTH, CUP_ROOM, GOOD_OPTION, case_of, cup_obj, written
from outside_scenes import hand_rows, mjcf

from hapticbridge.check.contact_faults import inertia_of
from hapticbridge.check.geometry_faults import dent_of
from hapticbridge.scene import physics, scene_path
from hapticbridge.scene.contacts import settings_among
from hapticbridge.scene.fault import length, number, weight
from hapticbridge.scene.first_faults import friction_faults
from hapticbridge.scene.physics import constraint_stiffness, depth_under, mesh_of

SINKS = [
    ("0.002 1", "0.9 0.95 0.001 0.5 2", 0.1),
    ("0.02 1", "0.9 0.95 0.001 0.5 2", 0.3),
    ("0.0005 8", "0.9 0.95 0.001 0.5 2", 0.05),
    ("0.005 0.7", "0.7 0.95 0.0005 0.5 2", 0.1),
    ("-30000 -400", "0.8 0.9 0.002 0.3 1", 0.2),
    ("-4000000 -6000", "0.5 0.9 0.001 0.5 2", 0.1),  # and this it does not
    ("0.0005 1", "0.9 0.9 0.001 0.5 2", 0.1),  # finer than the step: MuJoCo softens it
]


@pytest.mark.parametrize(("solref", "solimp", "mass"), SINKS)
def test_stiffness_and_depth_are_mujocos_at_rest(solref: str, solimp: str, mass: float) -> None:
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco>{GOOD_OPTION}
        <default><geom condim="1" solref="{solref}" solimp="{solimp}"/></default>
        <worldbody>
          <geom type="plane" size="1 1 1"/>
          <body pos="0 0 0.01"><joint type="slide" axis="0 0 1"/><geom size="0.01" mass="{mass}"/>
          </body>
        </worldbody></mujoco>"""
    )
    data, force = mujoco.MjData(model), 2.0
    data.qfrc_applied[0] = -force
    mujoco.mj_step(model, data, nstep=4000)
    ref, imp = ([float(word) for word in words.split()] for words in (solref, solimp))
    depth = depth_under(force, ref, imp, mass, model.opt.timestep)
    assert depth == pytest.approx(-data.qpos[0], rel=1e-3)
    stiffness = constraint_stiffness(ref, imp, mass, model.opt.timestep, depth)
    assert stiffness == pytest.approx(force / -data.qpos[0], rel=1e-3)


@pytest.mark.parametrize(
    ("cone", "condim", "friction"),
    [("elliptic", 3, 0.4), ("pyramidal", 1, 1), ("pyramidal", 3, 0.4), ("pyramidal", 6, 2)],
)
def test_stiffness_is_of_the_cone(tmp_path: Path, cone: str, condim: int, friction: float) -> None:
    rubs = f'condim="{condim}" friction="{friction} 0.005 0.0001"'
    rails = "".join(f'<joint type="slide" axis="{axis}"/>' for axis in ("1 0 0", "0 1 0", "0 0 1"))
    tool = f"""<body name="tool" pos="0 0 0.0105">{rails}<geom size="0.01" mass="0.1" {rubs}/>
      <site name="grip"/></body>"""
    path = hand_rows([(0.3, (0.0, 0.0, -0.003)), (0.5, (0.0, 0.0, -0.003))])
    option = GOOD_OPTION.replace("elliptic", cone)
    world = f'<geom name="floor" type="plane" size="1 1 1" {rubs}/>'
    scene = written(tmp_path, mjcf(option, body=tool, world=world), path)
    case = case_of(scene, contact="scene")
    assert case.observation is not None
    ((pair, seen),) = case.observation.meetings.items()
    force = float(case.observation.force[-1])  # at rest since 0.5 s
    depth = depth_under(force, (0.02, 1.0), (0.9, 0.95, 0.001, 0.5, 2.0), seen.inertia, 1e-3)
    assert depth == pytest.approx(seen.deepest, rel=0.02)
    # and from masses alone, as where nothing met
    ((_, _, setting),) = settings_among(case.model)
    guessed = inertia_of(replace(case, observation=None), pair, setting)
    assert guessed == pytest.approx(seen.inertia, rel=1e-6)


def test_nothing_that_pushes_back_lets_a_force_sink_for_ever() -> None:
    assert depth_under(1.0, (0.0, 0.0), (0.9, 0.95, 0.001), 1.0, 1e-3) == np.inf


@pytest.mark.parametrize("name", ["virtual_wall", "drawer"])
def test_stiffness_seen_in_a_motion_is_that_of_the_settings(name: str) -> None:
    case = case_of(scene_path(name), contact="scene")
    assert case.observation is not None
    ((pair, seen),) = list(case.observation.meetings.items())[:1]
    model = case.model
    settings = model.geom_solref[pair[0]], model.geom_solimp[pair[0]]
    shallow = constraint_stiffness(*settings, seen.inertia, 1e-3, 0.0)
    assert seen.softest == pytest.approx(shallow, rel=0.02)


def test_inertia_of_joint_and_body_has_their_armature() -> None:
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody>
          <body name="nail"><joint type="slide" axis="0 0 1" armature="0.1"/>
            <geom size="0.01" mass="0.0005"/></body>
          <body name="door" pos="1 0 0"><joint type="hinge" axis="0 0 1" armature="0.2"/>
            <inertial pos="0.5 0 0" mass="2" diaginertia="0.1 0.1 0.1"/></body>
          <body name="ball" pos="2 0 0"><freejoint/><geom size="0.1" mass="3"/></body>
          <body name="post" pos="3 0 0"><geom size="0.1" mass="3"/></body>
        </worldbody></mujoco>"""
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    about_hinge = 0.2 + 0.1 + 2 * 0.5**2
    assert physics.joint_inertia(model, data, 0) == pytest.approx(0.1005)
    assert physics.joint_inertia(model, data, 1) == pytest.approx(about_hinge)
    found = {name: physics.body_inertia(model, data, model.body(name).id) for name in
             ("nail", "door", "ball", "post")}  # fmt: skip
    assert found["nail"] == pytest.approx(0.1005)
    assert found["door"] == pytest.approx(about_hinge / 0.5**2)
    assert found["ball"] == pytest.approx(3.0)
    assert found["post"] == np.inf


@pytest.mark.parametrize("option", [GOOD_OPTION, '<option timestep="0.001" gravity="0 0 0"/>'])
@pytest.mark.parametrize("viscous", [0.0, 3.0, 300.0])
def test_creep_of_dry_friction_is_mujocos(tmp_path: Path, viscous: float, option: str) -> None:
    mass, loss = 0.3, 2.0
    path = tmp_path / "creep.xml"
    path.write_text(
        f"""<mujoco>{option}<worldbody><body>
          <joint type="slide" axis="1 0 0" frictionloss="{loss}" damping="{viscous}"/>
          <geom size="0.01" mass="{mass}"/><site name="grip"/>
        </body></worldbody></mujoco>"""
    )
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    data.qfrc_applied[0] = 0.5 * loss
    mujoco.mj_step(model, data, nstep=10_000)
    (fault,) = friction_faults(case_of(path))
    assert f"creeps by {length(data.qvel[0])}/s under half of it" in fault.sentence


def test_cup_is_as_deep_and_as_empty_as_it_was_made() -> None:
    spec = mujoco.MjSpec.from_string(
        '<mujoco><asset><mesh name="cup" file="cup.obj"/></asset>'
        '<worldbody><geom type="mesh" mesh="cup"/></worldbody></mujoco>'
    )
    spec.assets = {"cup.obj": cup_obj().encode()}
    dent, filled = dent_of(*mesh_of(spec.compile(), 0))
    assert filled == pytest.approx(CUP_ROOM, rel=1e-3)
    assert 0.3 * CUP_DEPTH < dent <= CUP_DEPTH


def test_numbers_are_said_as_people_read_them() -> None:
    assert [number(v) for v in (2500.4, 0.03751, 1e7)] == ["2500", "0.0375", "10000000"]
    assert [length(v) for v in (375e-6, 4.2e-3, 3.1)] == ["375 µm", "4.2 mm", "3.1 m"]
    assert [weight(v) for v in (0.0354, 1.2)] == ["35.4 g", "1.2 kg"]


POINTS = """<mujoco><worldbody><site name="a" pos="0 0 {reach}"/><site name="s" pos=".05 0 0"/>
<geom name="brim" size=".03" pos="{brim} 0 0"/><body><joint type="slide" axis="1 0 0"/>
<geom size=".01"/><site name="b" pos="0 0 .06"/></body></worldbody><tendon><spatial><site site="a"/>
<geom geom="brim" {side}/><site site="b"/></spatial></tendon></mujoco>"""


@pytest.mark.parametrize(
    ("reach", "brim", "side", "arms"),
    [
        (-0.06, 0.0, "", 2.0),  # the arm turns round where the ways are equally long
        (-0.06, 0.0, 'sidesite="s"', 0.0),
        (0.0601, 0.5, "", 0.0),  # the arm turns round in 0.1 mm, and the geom is never met
        (-0.06, 0.03, "", 0.0),  # the way touches the geom, and leaves it
    ],
)
def test_moment_arms_that_jump_are_told_from_those_that_turn_fast(
    reach: float, brim: float, side: str, arms: float
) -> None:
    model = mujoco.MjModel.from_xml_string(POINTS.format(reach=reach, brim=brim, side=side))
    data, watch = mujoco.MjData(model), physics.TendonWatch(model)
    found = []
    for data.qpos[0] in (-0.0007, 0.0005, 0.0017):
        found.append(watch.jumps(data))
    assert [list(each) for each in found] == [[], [0] if arms else [], []]
    if arms:
        assert found[1][0].length == 0.0
        assert found[1][0].arms == pytest.approx(arms, abs=0.05)  # arms differ by 2 % about it
