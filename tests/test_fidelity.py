"""Motion of a scene without a hand, against the one that its file describes."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from cli_cases import Called
from outside_scenes import scene_file

from hapticbridge import Coupling
from hapticbridge.check.case import open_case
from hapticbridge.check.findings import own_motion_faults
from hapticbridge.demand.rehearsal import RunPoint
from hapticbridge.kernel.ledger import ENERGY_TOLERANCE
from hapticbridge.run.fidelity import (
    NO_HAND,
    Cause,
    Deviation,
    Fidelity,
    fidelity,
    own_substeps,
)
from hapticbridge.scene import SceneSource, compile_scene, read_scene
from hapticbridge.scene.checks import first_pump

PERIOD = 1e-3
SWING = """<mujoco><option timestep="{step}" integrator="{integrator}" gravity="0 0 0"/><worldbody>
<body name="swing"><joint name="slide" type="slide" axis="1 0 0" stiffness="400" damping="0"/>
<geom size=".02" mass="0.1"/></body><body pos="0 1 0"><joint type="slide"/><geom size=".02"/>
<site name="grip"/></body></worldbody>
<keyframe><key name="home" qpos="0.02 0"/></keyframe></mujoco>"""
"""A mass on a spring of 10 Hz without damping, beside a tool."""
FILTER = """<mujoco><option timestep="0.0001"/><worldbody>
<body name="cart"><joint name="slide" type="slide" axis="1 0 0" damping="1"/>
<geom size=".02" mass="0.1"/><site name="grip"/></body></worldbody>
<actuator><general joint="slide" dyntype="filter" dynprm="0.0003"/></actuator>
<keyframe><key name="home" ctrl="0.1"/></keyframe></mujoco>"""
"""A motor behind a filter of 0.3 ms, which Euler's steps of more than 0.6 ms let diverge."""
ARM = """<mujoco><option timestep="0.002"/><worldbody>
<body pos="0 0 1"><joint name="shoulder" axis="0 1 0" damping="5"/>
<geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass="1"/>
<body pos=".3 0 0"><joint name="elbow" axis="0 1 0" damping="2"/>
<geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass="0.5"/><site name="grip" pos=".3 0 0"/>
</body></body></worldbody><actuator><position joint="shoulder" kp="500"/>
<position joint="elbow" kp="200"/></actuator></mujoco>"""


def scene(folder: Path, text: str) -> SceneSource:
    path = folder / "scene.xml"
    path.write_text(text)
    return read_scene(path)


def moved(source: SceneSource, substeps: int = 1) -> Fidelity:
    found = fidelity(source, compile_scene(source), RunPoint(NO_HAND, PERIOD, substeps))
    assert found is not None
    return found


def test_an_arm_with_position_servos_holds_its_pose(tmp_path: Path) -> None:
    found = moved(scene(tmp_path, ARM))
    assert (found.bodies, found.deviations, found.incomparable) == (2, (), ())


def test_a_swing_that_the_file_damps_by_its_own_step_is_not_determined_by_it(
    tmp_path: Path,
) -> None:
    # implicit steps of 10 ms let a swing of 63 rad/s decay as exp(-2 t), half of them as exp(-t)
    found = moved(scene(tmp_path, SWING.format(step=0.01, integrator="implicitfast")))
    assert (found.deviations, found.incomparable) == ((), ("swing",))
    assert "depends on the file's time step of 10 ms" in found.doubt
    assert (str(found), found.advice(RunPoint(NO_HAND, PERIOD))) == ("", "")
    # the file's own steps keep the swing, those of the bridge let it decay as exp(-2 t)
    found = moved(scene(tmp_path, SWING.format(step=0.0002, integrator="RK4")))
    (swing,) = found.deviations
    assert (swing.apart > 0.01, found.incomparable, found.doubt) == (True, (), "")
    assert set(found.causes) <= {Cause.OPTIONS, Cause.TIME_STEP}


@pytest.mark.filterwarnings("ignore:flex 'soft' is not rigid")  # it has no damping, as meant
def test_energy_that_a_fast_swing_loses_is_told(tmp_path: Path) -> None:
    """A spring of 5 N m/rad swings at 38 Hz about 1 rad, from 0.3 rad: 0.5 · 5 · 0.7² J."""
    swing = """<mujoco><option timestep="0.001" gravity="0 0 0"/><worldbody>
      <body name="tool"><freejoint/><geom size=".02" mass=".1"/><site name="grip"/></body>
      <body name="swing" pos=".2 0 0"><joint axis="0 1 0" stiffness="5" springref="57.296"
      ref="17.189"/><geom type="box" size=".05 .01 .01" mass="0.1"/></body>
      </worldbody></mujoco>"""
    found = moved(scene(tmp_path, swing))
    assert (found.deviations, found.incomparable) == ((), ("swing",))
    assert found.lost == pytest.approx(0.5 * 5 * 0.7**2, rel=0.15)  # Euler's own ripple is 12 %
    assert f"then has {found.lost:.2f} J less than with either: fast swings" in found.doubt
    damped = moved(scene(tmp_path, swing.replace('stiffness="5"', 'stiffness="5" damping="0.01"')))
    assert damped.lost == 0.0
    soft = """<flexcomp name="soft" type="grid" count="3 3 3" spacing=".1 .1 .1" pos="1 0 0" dim="3"
      mass=".1"><elasticity young="1e3"/></flexcomp>"""
    beside = moved(scene(tmp_path, swing.replace("</worldbody>", soft + "</worldbody>")))
    assert beside.incomparable and beside.lost == 0.0  # MuJoCo's energy lacks that of a flex


def test_contacts_are_named_where_they_are_the_cause_and_undone_where_that_mends_it(
    tmp_path: Path,
) -> None:
    found = moved(scene(tmp_path, SINKING))
    (ball,) = found.deviations
    assert (ball.body, Cause.CONTACT in found.causes) == ("ball", True)
    assert ball.apart == pytest.approx(ball.moved, rel=0.1) and ball.moved > 1e-3
    assert found.remedy == RunPoint(NO_HAND, PERIOD, contact="scene")
    nameless = str(moved(scene(tmp_path, SINKING.replace(' name="ball"', ""))))
    assert "the contact of body 'world' and body '1'" in nameless
    assert "--contact scene (tried: " in found.advice(RunPoint(NO_HAND, PERIOD))
    assert "rigid contacts, limits and equalities in place of the file's own" in str(found)


SERVO = """<mujoco><option timestep="0.001"/><worldbody>
<body><joint name="a" axis="0 0 1"/><geom type="box" size=".05 .05 .01" mass=".2"/>
<site name="grip"/></body>
<body name="wheel" pos="1 0 0"><joint name="b" axis="0 0 1"/>
<geom type="cylinder" size=".05 .01" mass=".2"/></body></worldbody>
<equality><joint joint1="b" joint2="a" polycoef="0 -1 0 0 0"/></equality>
<actuator><velocity joint="b" kv="0.5"/></actuator>
<keyframe><key name="home" ctrl="1"/></keyframe></mujoco>"""
"""A motor that stretches a soft constraint, by less the more of its damping is in the step."""


def test_two_causes_of_which_neither_makes_half_are_both_named(tmp_path: Path) -> None:
    found = moved(scene(tmp_path, SERVO))
    assert set(found.causes) == {Cause.OPTIONS, Cause.CONTACT}
    assert (
        "rigid contacts, limits and equalities in place of the file's own, here of joint equality"
        in str(found)
    )
    # in MuJoCo the options alone leave more than a quarter of the angle, and less than all of it
    ends = []
    for integrator in ("Euler", "discrete"):
        text = SERVO.replace('timestep="0.001"', f'timestep="0.001" integrator="{integrator}"')
        model = mujoco.MjModel.from_xml_string(text)
        model.dof_armature[0] = model.dof_M0[0] = 1e6  # held, as by a hand at rest
        data = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, data, 0)
        mujoco.mj_step(model, data, 1000)
        ends.append(float(data.qpos[1]))
    assert 0.25 * ends[0] < ends[1] < 0.75 * ends[0]


SOFT_BLOCK = """<mujoco><worldbody><body name="base" pos="0 0 .3"><flexcomp name="soft" dim="3"
type="grid" count="3 3 3" spacing=".03 .03 .03" mass=".3" radius=".002"><edge equality="true"/>
<contact selfcollide="none"/><pin id="0 1 2 3 4 5 6 7 8"/></flexcomp></body>
<body pos="1 0 1"><joint/><geom size=".01" pos="0 0 -.1"/><site name="grip"/></body>
</worldbody></mujoco>"""
"""A block whose edges are the equality constraint of a flex, which hangs in its own softness."""


def test_the_softness_that_a_run_leaves_to_mujoco_is_not_called_rigid(tmp_path: Path) -> None:
    source = scene(tmp_path, SOFT_BLOCK)
    found = moved(source)
    assert found.causes == (Cause.DIAGONAL,)
    assert "flag diagexact, which rigid contacts need, here of equality '0'" in str(found)
    bridged = compile_scene(source)
    bridged.set_contact(is_rigid=True)
    assert any("flag diagexact: disable → enable" in each for each in bridged.changes)
    # this flag alone moves it as far in MuJoCo
    ends = []
    for flags in (0, int(mujoco.mjtEnableBit.mjENBL_DIAGEXACT)):
        model = source.spec.compile()
        model.opt.enableflags |= flags
        data = mujoco.MjData(model)
        mujoco.mj_step(model, data, round(found.seconds / model.opt.timestep))
        ends.append(data.body(found.deviations[0].body).xpos.copy())
    apart = float(np.linalg.norm(np.subtract(*ends)))
    assert apart > 1e-3
    assert found.deviations[0].apart == pytest.approx(apart, rel=0.02)


EDGES = """<mujoco><option timestep="0.001"/><worldbody>
<flexcomp name="rope" type="grid" count="8 1 1" spacing=".03 .03 .03" pos="0 0 1" radius=".003"
mass=".05" dim="1"><pin id="0"/><edge stiffness="20" damping=".1"/></flexcomp>
<body pos="1 0 1"><joint/><geom size=".01" pos="0 0 -.1"/><site name="grip"/></body>
</worldbody></mujoco>"""
"""A rope of springs, whose length is constant once it is loaded."""


def test_a_change_of_the_scene_at_load_is_told_from_options_of_the_run(tmp_path: Path) -> None:
    found = moved(scene(tmp_path, EDGES))
    assert found.deviations
    assert (found.causes, found.remedy) == ((Cause.LOAD,), None)


MARGIN = """<mujoco><option timestep="0.001" gravity="0 0 0"/><worldbody>
<body name="finger"><joint name="knuckle" axis="0 1 0" range="0 90" margin="0.02" damping=".01"/>
<geom type="capsule" fromto="0 0 0 .05 0 0" size=".005" mass=".5"/></body>
<body pos="0 1 0"><joint axis="0 0 1"/><geom size=".01"/><site name="grip" pos=".1 0 0"/></body>
</worldbody><actuator><position joint="knuckle" kp=".01" ctrllimited="false"/></actuator>
<keyframe><key name="home" ctrl="-0.5"/></keyframe></mujoco>"""
"""A servo that presses a finger onto its limit, which begins 0.02 rad before the range ends."""


def test_a_limit_with_a_margin_holds_where_its_file_lets_it(tmp_path: Path) -> None:
    source = scene(tmp_path, MARGIN)
    bridged = compile_scene(source)
    assert [change.words for change in bridged.differences[1:]] == [
        "start of joint 'knuckle': 0 deg → 1.15 deg, its limit"
    ]
    found = fidelity(source, bridged, RunPoint(NO_HAND, PERIOD))
    assert found is not None
    assert (found.bodies, found.deviations, found.incomparable) == (2, (), ())
    assert bridged.data.qpos[0] == pytest.approx(0.02, abs=5e-5)
    assert found.created <= ENERGY_TOLERANCE
    # without the margin in the scene it would rest at the end of the range
    bare = scene(tmp_path, MARGIN.replace('margin="0.02"', ""))
    bridged = compile_scene(bare)
    fidelity(bare, bridged, RunPoint(NO_HAND, PERIOD))
    assert bridged.data.qpos[0] == pytest.approx(0.0, abs=5e-5)


def test_a_remedy_that_lets_the_hand_bear_more_is_none(tmp_path: Path) -> None:
    tool = '<body pos="1 0 1"><joint/><geom size=".01" pos="0 0 -.1"/><site name="grip"/></body>'
    on_ground = """<body pos="1 0 .02"><joint type="slide" axis="0 0 1"/><site name="grip"/>
        <geom size=".02" mass="{}" solref="-500 -50" solimp=".9 .9 .001"/></body>"""
    assert tool in SINKING
    setting = RunPoint(Coupling(2000.0, 2.0), PERIOD)
    for mass, is_remedy in ((0.01, True), (1.0, False)):
        source = scene(tmp_path, SINKING.replace(tool, on_ground.format(mass)))
        found = fidelity(source, compile_scene(source), setting)
        assert found is not None
        assert found.deviations
        assert (found.remedy is not None, bool(found.advice(setting))) == (is_remedy, is_remedy)
        assert 0.0 <= found.more < 0.2  # twice the weight of 10 g, as it swings


def test_beside_a_pump_only_the_pump_is_told(tmp_path: Path) -> None:
    pump = '<body pos="1 0 0"><joint type="slide" damping="{}"/><geom size=".02" mass="1"/></body>'
    for damping, kinds in ((0.5, {"own motion"}), (-0.5, set())):
        text = SINKING.replace("</worldbody>", pump.format(damping) + "</worldbody>")
        case = open_case(scene(tmp_path, text))
        assert {fault.kind for fault in own_motion_faults(case)} == kinds
        assert (first_pump(case.model) is None) == bool(kinds)


SINKING = """<mujoco><option timestep="0.001"/><worldbody>
<geom type="plane" size="1 1 .1" solref="-500 -50" solimp=".9 .9 .001"/>
<body name="ball" pos="0 0 .02"><joint type="slide" axis="0 0 1"/>
<geom size=".02" mass="0.1" solref="-500 -50" solimp=".9 .9 .001"/></body>
<body pos="1 0 1"><joint/><geom size=".01" pos="0 0 -.1"/><site name="grip"/></body>
</worldbody></mujoco>"""
"""A ball that sinks by 2 mm into soft ground, which a rigid contact does not let it."""

STICK = """<mujoco><option timestep="0.002"/><worldbody><geom type="plane" size="1 1 .1"/>
<body name="stick" pos="0 0 .11" euler="10 0 0">
{joint}<geom type="box" size=".02 .02 .1" mass="0.2"/><site name="grip"/>
</body></worldbody></mujoco>"""
"""A stick on its edge, which falls otherwise on soft contacts than on rigid ones."""


def test_a_tool_that_would_fall_over_without_a_hand_is_held(tmp_path: Path) -> None:
    assert moved(scene(tmp_path, STICK.format(joint="<freejoint/>"))).deviations == ()
    other = STICK.format(joint="<freejoint/>").replace(
        "</worldbody>",
        '<body name="tool" pos="1 0 1"><joint/><geom size=".01"/>'
        '<site name="held"/></body></worldbody>',
    )
    source = scene(tmp_path, other)
    found = fidelity(source, compile_scene(source, "held"), RunPoint(NO_HAND, PERIOD))
    assert found is not None
    assert [each.body for each in found.deviations] == ["stick"]


PENDULUMS = """<mujoco><option timestep="0.002" integrator="implicit"/><worldbody>
<body name="far" pos="0 1 0"><joint axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .2 0 0"
size=".01"/><body name="end" pos=".2 0 0"><joint axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 .2 0 0" size=".01"/></body></body>
<body name="tool"><joint/><geom size=".01"/><site name="grip" pos=".1 0 0"/></body>
</worldbody><keyframe><key name="home" qpos="3.1 0.01 0" qvel="40 -99 0"/></keyframe></mujoco>"""
"""A double pendulum that swings fast, so that its places depend on the time step."""


def test_a_place_that_the_file_does_not_determine_is_counted_apart(tmp_path: Path) -> None:
    found = moved(scene(tmp_path, PENDULUMS))
    assert found.deviations == ()
    assert set(found.incomparable) == {"far", "end"}


def test_a_short_step_is_kept_where_the_scene_needs_it(tmp_path: Path) -> None:
    needs = scene(tmp_path, FILTER)
    alone = moved(needs)
    assert (alone.causes, alone.remedy) == ((Cause.TIME_STEP,), RunPoint(NO_HAND, PERIOD, 10))
    substeps, found = own_substeps(needs, compile_scene(needs), RunPoint(NO_HAND, PERIOD))
    assert substeps == 10
    assert found is not None
    assert found.deviations == ()
    does_not = scene(tmp_path, ARM.replace("0.002", "0.0002"))
    assert own_substeps(does_not, compile_scene(does_not), RunPoint(NO_HAND, PERIOD))[0] == 1


def test_a_scene_that_diverges_in_the_bridge_alone_fails(tmp_path: Path) -> None:
    (fault,) = own_motion_faults(open_case(scene(tmp_path, FILTER)))
    assert (fault.kind, fault.is_note) == ("divergence", False)
    assert "--substeps 10 (tried: " in fault.change


def test_a_scene_that_diverges_by_itself_has_nothing_to_respect(tmp_path: Path) -> None:
    text = FILTER.replace('"0.0001"', '"0.002"')
    diverges = scene(tmp_path, text)
    assert fidelity(diverges, compile_scene(diverges), RunPoint(NO_HAND, PERIOD)) is None


TIGHT = """<mujoco><option timestep=".002"/><worldbody>
<body pos=".3 0 .3"><freejoint/><geom size=".01" mass=".05"/><site name="grip"/></body>
<body pos="0 0 .3"><joint name="j" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 .1 0 0" size=".008" mass=".05"/></body></worldbody>
<actuator><velocity joint="j" kv="{}"/></actuator></mujoco>"""


def test_that_a_file_gives_nothing_to_compare_with_is_said(call: Called, tmp_path: Path) -> None:
    """A servo of a gain that MuJoCo's Euler step cannot hold, beside the tool."""
    text = TIGHT.format(10)
    assert [each.kind for each in own_motion_faults(open_case(scene(tmp_path, text)))] == [
        "time step matters"
    ]
    command = ("--fast", "--duration", 0.02)
    code, _, err = call("run", scene(tmp_path, text).path, *command)
    assert (code, "is compared with nothing" in " ".join(err.split())) == (0, True)
    code, _, err = call("run", scene(tmp_path, TIGHT.format(0.001)).path, *command)
    assert (code, "is compared with nothing" in " ".join(err.split())) == (0, False)


def test_run_keeps_the_short_step(call: Called, tmp_path: Path) -> None:
    path = scene(tmp_path, FILTER).path
    command = ("run", path, "--fast", "--duration", 0.2)
    code, _, err = call(*command)
    assert (code, "10 MuJoCo steps per tick" in err) == (0, True)
    code, _, err = call(*command, "--substeps", 1)
    assert (code, "stretch limit" in err) == (3, True)


SECOND = '<body pos="1 .5 1"><joint/><geom size=".01" pos="0 0 -.1"/><site name="left"/></body>'


@pytest.mark.parametrize(
    ("text", "words", "code"),
    [(SINKING, "the cause is rigid contacts", 0), (FILTER, "the scene diverges here", 3)],
)
def test_run_of_several_hands_says_what_moves_otherwise(
    call: Called, tmp_path: Path, text: str, words: str, code: int
) -> None:
    path = scene(tmp_path, text.replace("</worldbody>", SECOND + "</worldbody>")).path
    hands = ("--hand", "grip=simulated", "--hand", "left=simulated")
    found, _, err = call("run", path, *hands, "--fast", "--duration", 0.2)
    assert (found, words in " ".join(err.split()), "--substeps" in err) == (code, True, False)


SPINNING = """<mujoco><option gravity="0 0 0"/><worldbody>
<body><joint axis="0 0 1"/><geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass="1"/>
<body pos=".3 0 0"><joint axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 .2 0 .1" size=".02" mass=".5"/></body></body>
<body name="t" pos="0 1 0"><freejoint/><geom size=".02" mass=".1"/><site name="grip"/></body>
</worldbody><keyframe><key name="home" qpos="0 0 0 1 0 1 0 0 0" qvel="{0} {1} 0 0 0 0 0 0"/>
</keyframe></mujoco>"""
"""An arm of two joints without friction beside the tool."""


def test_fast_joints_create_no_energy(tmp_path: Path) -> None:
    for substeps in (1, 2, 4):
        found = moved(scene(tmp_path, SPINNING.format(8, 20)), substeps)
        assert found.created <= ENERGY_TOLERANCE


def test_the_comparison_starts_where_the_bridge_starts_and_without_the_mocap_body_it_replaces(
    tmp_path: Path,
) -> None:
    """The arm would hang on its mocap body for ever, and the lever would be pushed out."""
    text = """<mujoco><option timestep=".001"/><worldbody>
      <body name="m" mocap="true" pos=".2 0 .5"/>
      <body name="arm" pos="0 0 .5"><joint axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 .2 0 0" size=".01"/>
        <site name="grip" pos=".2 0 0"/></body>
      <body name="lever" pos="0 1 .5"><joint axis="0 0 1" range="90 120"/>
        <geom type="capsule" fromto="0 0 0 .2 0 0" size=".01"/></body></worldbody>
      <equality><connect body1="m" body2="arm" anchor="0 0 0"/></equality></mujoco>"""
    source = read_scene(scene_file(tmp_path, text))
    scene = compile_scene(source)
    assert [change.words for change in scene.differences[1:]] == [
        "grip held by mocap body 'm' → by the hand alone",
        "start of joint '1': 0 deg → 90 deg, its limit",
    ]
    found = fidelity(source, scene, RunPoint(NO_HAND, PERIOD))
    assert found is not None
    assert found.deviations == ()


@pytest.mark.parametrize(
    ("count", "ends"), [(1, "1 ms)"), (2, "1 more body deviates"), (3, "2 more bodies deviate")]
)
def test_the_other_bodies_are_counted_in_words(count: int, ends: str) -> None:
    apart = tuple(Deviation(f"b{k}", 0.1, 0.0, 0.2, k) for k in range(count))
    found = Fidelity(apart, ("x", *"yz"[: count - 1]), 3, 1e-3, 1.0, 0.0)
    assert str(found).partition(";")[0].endswith(ends)
    assert (f"and of {count - 1} more bod" in found.doubt) is (count > 1)
