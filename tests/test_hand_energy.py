"""Claims about the energy that a hand gets, and about what a certificate says of it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from audit_cases import ScriptedDevice, SlowClock, recorded
from bridge_runs import fast, sway
from random_hands import random_motion
from two_hands import BAR

from hapticbridge.audit import AuditReport, audit
from hapticbridge.demand.certification import Standing, worst_certification
from hapticbridge.demand.guard import DEVICE_LIMITS
from hapticbridge.demand.trip import Trip, TripCode
from hapticbridge.device import Motion, SimulatedDevice
from hapticbridge.errors import SafetyTrip
from hapticbridge.kernel.hand_energy import INSTANT, HandEnergy
from hapticbridge.recording import read_recording
from hapticbridge.run.bridge import Bridge
from hapticbridge.run.hands import Grasp
from hapticbridge.run.options import Workspace
from hapticbridge.run.summary import Summary
from hapticbridge.units import format_energy

SPHERE = """<mujoco><option timestep="0.001" gravity="0 0 {gravity}"/><worldbody>
<body name="tool"><freejoint/><geom size=".02" mass="{mass}"/><site name="grip"/></body>
</worldbody></mujoco>"""

SLEDGE = """<mujoco><option timestep="0.001"/><worldbody><body name="sledge">
<joint name="x" type="slide" axis="1 0 0" damping="{damping}"/>
<geom type="box" size=".02 .02 .02" mass="0.3"/><site name="grip"/></body></worldbody>{motor}
</mujoco>"""

DRIVEN = SLEDGE.format(damping=0, motor='<actuator><motor name="puller" joint="x"/></actuator>')
BESIDE = """<mujoco><option timestep="0.001"/><worldbody><geom type="plane" size="2 2 .1"/>
<body name="sledge" pos="0 0 .5"><joint name="x" type="slide" axis="1 0 0"/>
<geom type="box" size=".02 .02 .02" mass="0.3"/><site name="grip"/></body>
<body name="beside" pos="1 0 .3"><freejoint/><geom type="box" size=".05 .05 .05" mass="{mass}"/>
</body></worldbody><actuator><motor name="puller" joint="x"/></actuator></mujoco>"""
"""A sledge on a motor, and a block that falls beside it: 2.45 J for 1 kg, burned by the floor."""

LOSING = """<mujoco><option timestep="0.001"/><worldbody><body name="sledge">
<joint name="x" type="slide" axis="1 0 0"/><geom type="box" size=".02 .02 .02" mass="0.3"/>
<site name="grip"/></body><body pos="1 0 2"><joint name="z" type="slide" axis="0 0 1"
damping="{sinks}"/><geom type="box" size=".05 .05 .05" mass="1"/></body></worldbody>
<actuator><motor name="puller" joint="x"/>{lift}</actuator></mujoco>"""
"""A sledge on a motor, and 1 kg that sinks beside it at 9.8 N / ``sinks``, or on a hoist."""

SINKING = LOSING.format(sinks=20, lift="")
HOISTED = LOSING.format(sinks=0, lift='<velocity name="hoist" joint="z" kv="50"/>')

CARRIAGE = """<mujoco><option timestep="0.001"/><worldbody>
<body gravcomp="1"><joint name="z" type="slide" axis="0 0 1" actuatorgravcomp="{by_actuator}"/>
<geom size=".03" mass="1"/><body name="tool" pos="0.05 0 0"><geom size=".02" mass="0.3"/>
<site name="grip"/></body></body></worldbody>{motor}</mujoco>"""
"""A carriage of 1 kg that carries itself, and 0.3 kg on it that the hand holds."""

DROPPED = """<mujoco><option timestep="0.001"/><worldbody><body name="tool">
<joint name="z" type="slide" axis="0 0 1"/><geom size=".02" mass="0.5"/><site name="grip"/></body>
</worldbody><actuator><motor name="puller" joint="z"/></actuator></mujoco>"""

PUMP, BRAKE = (SLEDGE.format(damping=damping, motor="") for damping in (-10, 10))
"""A sledge with negative damping, which creates energy, and one that takes it."""


RELAXED = "simulated:hand_stiffness=135,hand_damping=6.5"
"""A hand that yields to a heavy tool, where the default one would be firm enough to lift it."""


def ran(
    folder: Path, text: str, device: Any = RELAXED, duration: float = 1.5, **options: Any
) -> tuple[Summary, AuditReport]:
    """Runs a scene with all defaults; returns what the run says and what its audit says."""
    scene, path = folder / "scene.xml", folder / "run.mcap"
    scene.write_text(text)
    options = {"limits": DEVICE_LIMITS, "controller": None} | options
    summary = recorded(path, scene, device, duration=duration, **options)
    return summary, audit(path)


def push(bridge: Bridge, tick: int) -> None:
    """A program that pushes the sphere to and fro with up to 1 N, at 50 Hz."""
    if tick % 20 == 0:
        force = math.sin(0.005 * tick)
        bridge.set_input(body_wrench={"tool": (force, 0, 0, 0, 0, 0)})


def drive(bridge: Bridge, tick: int) -> None:
    """A motor that pulls for half a second."""
    if tick in (100, 600):
        bridge.set_input(ctrl={"puller": 1.0 if tick == 100 else 0.0})


def start_twice_more(bridge: Bridge, tick: int) -> None:
    if tick in (500, 1000):
        bridge.repeat_commands([{"event": "reset", "tick": tick}])


def pull_through_a_start(bridge: Bridge, tick: int) -> None:
    """A motor that pulls down at 2 N, and a reset while it does."""
    if tick == 200:
        bridge.repeat_commands([{"event": "reset", "tick": tick}])
    if tick in (50, 201):
        bridge.set_input(ctrl={"puller": -2.0})


def rock(bridge: Bridge, tick: int) -> None:
    """A motor that pushes to and fro with 4 N, and a hoist, if there is one, that lets down."""
    if tick >= 500 and tick % 10 == 0:
        bridge.set_input(ctrl={"puller": 4.0 * math.sin(0.0094 * tick)})
    if tick == 10 and bridge.scene.model.nactuator > 7:
        bridge.set_input(ctrl={"hoist": -0.3})


WEIGHT = SPHERE.format(gravity=-9.81, mass=0.9)
FLOATING = SPHERE.format(gravity=0, mass=0.3)


@pytest.mark.parametrize(
    ("text", "options"),
    [
        (WEIGHT, {}),
        (WEIGHT, {"workspace": Workspace(force_scale=0.5)}),
        (WEIGHT, {"scene_rate": 250.0}),
        (WEIGHT, {"substeps": 2}),
        (WEIGHT, {"on_tick": start_twice_more}),
        (WEIGHT, {"clock": SlowClock({200: 4}, dict.fromkeys(range(300, 900, 7), 0.3))}),
        (FLOATING, {"on_tick": push}),
        (DRIVEN, {"on_tick": drive}),
        (DRIVEN, {"on_tick": drive, "device": "simulated:resolution=1e-5"}),
        (BESIDE.format(mass=1.0), {"on_tick": drive}),
        (PUMP, {"duration": 2.0, "controller": "off"}),
    ],
)
def test_run_and_audit_meter_one_energy_and_print_one_line(
    text: str, options: dict[str, Any], tmp_path: Path
) -> None:
    summary, report = ran(tmp_path, text, **options)
    ours, theirs = summary.hand_energy, report.hand_energy
    for field in fields(HandEnergy):
        expected = pytest.approx(getattr(ours, field.name), rel=1e-9, abs=1e-10)
        assert getattr(theirs, field.name) == expected, field.name
    assert ours.net > INSTANT
    assert f"net to the hand     {ours.sentence}" in str(summary)
    assert f"; net to the hand {ours.sentence}" in report.reason
    assert f'"net": {theirs.net!r}' in report.to_json()
    assert summary.is_certified is report.certified


@pytest.mark.parametrize("options", [{}, {"substeps": 2}, {"scene_rate": 250.0}])
def test_run_and_audit_agree_after_a_reset_which_is_no_push(
    options: dict[str, Any], tmp_path: Path
) -> None:
    limits = replace(DEVICE_LIMITS, energy=1.0)
    options = options | {"on_tick": pull_through_a_start, "limits": limits}
    summary, report = ran(tmp_path, DROPPED, **options)
    ours, theirs = summary.hand_energy, report.hand_energy
    assert asdict(ours) == pytest.approx(asdict(theirs), rel=1e-9, abs=1e-10)
    assert summary.energies["external_work"] > 0.05
    assert ours.inputs == pytest.approx(0.0, abs=1e-12)
    assert ours.limit.startswith("motors of the scene pushed")


def test_a_hand_that_got_what_nothing_released_holds_no_certified_device(tmp_path: Path) -> None:
    for text, certified in ((PUMP, False), (BRAKE, True)):
        summary, report = ran(tmp_path, text, duration=2.0, controller="off")
        assert all("2 >= 1.7 N s/m" in line for line in summary.conditions[:1])
        assert report.damping_margin == pytest.approx(0.15)
        assert (summary.is_certified, report.certified) == (certified, certified)
        assert (report.exit_code == 0) == certified
        assert summary.verdict == report.verdict == ("passive" if certified else "active")
        assert (summary.fault or (None, "")) == (report.tick, report.port)
        assert (summary.hand_energy.unpaid > INSTANT) is not certified
        got = f"the hand got {format_energy(summary.hand_energy.unpaid)} beyond what it put in"
        assert (f"device not certified: {got}" in str(summary)) is not certified
        assert (got in report.reason) is not certified
        for origin in ("by the scene", "by the coupling's springs", "by motors", "by inputs"):
            assert (f"{origin} 0 J" in report.reason) is not certified


def test_the_sentence_names_what_the_scene_released_and_what_nothing_paid() -> None:
    plain = HandEnergy(net=5e-3)
    assert plain.sentence == (
        "5 mJ at most, beyond what it put in and what the device's damping burned"
    )
    falling = replace(plain, scene=0.2)
    released = "what it put in, what the scene released (200 mJ at the end) and what"
    assert released in falling.sentence
    # the largest work may be of another instant than the largest net energy
    assert "the scene's motors gave or took up to 3 mJ" in replace(plain, motors=-3e-3).sentence
    created = replace(falling, unpaid=4e-3)
    assert created.sentence == (
        "5 mJ at most, beyond what it put in and what the scene released (200 mJ at the end): "
        "nothing paid for 4 mJ of it"
    )


def test_springs_that_paid_do_not_hide_the_motors_that_may_have_loaded_them() -> None:
    """As of two arms whose servos push them into each other: 73 mJ in springs, 222 J by servos."""
    springs = "the coupling's springs held 72.9 mJ at the start or after resets"
    energy = HandEnergy(net=0.038, gross=0.038, springs=0.0729)
    assert energy.sentence.endswith(springs)
    pushed = replace(energy, motors=222.0, inputs=0.5 * INSTANT)
    loaded = ", and the scene's motors, which may have loaded them, gave or took up to 222 J"
    assert pushed.sentence.endswith(springs + loaded)
    assert not pushed.limit  # the springs paid
    unpaid = replace(pushed, net=0.1, gross=0.1)
    assert unpaid.sentence.endswith(springs) and unpaid.limit


def test_created_energy_that_stays_in_the_scene_is_not_at_the_hand(tmp_path: Path) -> None:
    summary, report = ran(tmp_path, PUMP, duration=2.0, controller="off")
    created = summary.energies["environment_energy"]
    assert created > 2.0 * report.hand_energy.unpaid
    assert report.hand_energy.unpaid == pytest.approx(report.hand_energy.net, rel=1e-9)


def test_springs_that_hold_a_weight_at_the_start_may_give_it_back(tmp_path: Path) -> None:
    summary, report = ran(tmp_path, WEIGHT)
    held = (0.9 * 9.81) ** 2 / (2 * 2400.0)  # m²g²/2K
    assert summary.hand_energy.springs == pytest.approx(held, rel=1e-6)
    assert 0.9 * held < summary.hand_energy.net < held
    assert summary.hand_energy.unpaid == 0.0
    assert (summary.is_certified, report.certified, report.exit_code) == (True, True, 0)
    assert "device certified: b >= KT/2 + B_law\n" in str(summary)  # without a limit
    assert "the coupling's springs held 16.2 mJ" in str(summary)


@pytest.mark.parametrize(
    ("text", "on_tick", "name"),
    [(FLOATING, push, "inputs"), (DRIVEN, drive, "motors")],
)
def test_what_pushed_limits_the_certificate(
    text: str, on_tick: Callable[[Bridge, int], None], name: str, tmp_path: Path
) -> None:
    summary, report = ran(tmp_path, text, on_tick=on_tick)
    limit = (
        f"{name} of the scene pushed: only --energy-limit bounds what they give the hand, and what "
        "bodies lose beside the tool comes on top"
    )
    assert f"device certified: b >= KT/2 + B_law, but {limit}" in str(summary)
    assert report.hand_energy.limit == limit
    assert f"the scene's {name} gave or took up to " in report.reason
    assert (report.certified, report.exit_code) == (True, 0)
    assert report.hand_energy.unpaid <= 1e-12


@pytest.mark.parametrize("mass", [1e-3, 1.0])
def test_what_a_body_beside_the_tool_loses_hides_no_motor(mass: float, tmp_path: Path) -> None:
    """2.45 J that the floor burned paid for whatever the motor gave the hand, up to 2.3 J."""

    def drive_hard(bridge: Bridge, tick: int) -> None:
        if tick == 700:
            bridge.set_input(ctrl={"puller": 8.0})

    limits = replace(DEVICE_LIMITS, energy=0.04)
    with pytest.raises(SafetyTrip, match="the scene's motors did"):
        ran(tmp_path, BESIDE.format(mass=mass), on_tick=drive_hard, limits=limits)
    report = audit(tmp_path / "run.mcap")
    assert 0.03 < report.hand_energy.net < 0.06
    assert report.hand_energy.scene < 1e-3


@pytest.mark.parametrize("text", [SINKING, HOISTED])
def test_a_motor_that_a_lost_weight_hides_limits_the_certificate(text: str, tmp_path: Path) -> None:
    """The scene loses more than the motor gives: no net energy shows it, its own work does."""
    summary, report = ran(tmp_path, text, on_tick=rock, duration=2.0)
    assert summary.energies["device_energy"] > 0.1
    assert summary.hand_energy.net <= INSTANT
    assert "b >= KT/2 + B_law, but motors of the scene pushed: only --energy-limit" in str(summary)
    assert summary.hand_energy.limit == report.hand_energy.limit
    assert (summary.is_certified, report.certified) == (True, True)


def test_work_that_cannot_have_reached_the_hand_is_no_limit() -> None:
    falling = HandEnergy(gross=0.2, scene=0.2)
    assert not falling.limit
    assert not replace(falling, motors=0.5 * INSTANT, inputs=-0.5 * INSTANT).limit
    assert not replace(falling, springs=0.2, motors=0.1).limit
    assert not HandEnergy(gross=0.5 * INSTANT, motors=0.1).limit
    assert replace(falling, motors=-0.1).limit.startswith("motors of the scene pushed")
    assert "motors gave or took up to 100 mJ, and" in replace(falling, motors=-0.1).sentence


@pytest.mark.parametrize("by_actuator", ["false", "true"])
def test_what_a_carried_weight_took_on_the_way_down_pays_for_its_way_up(
    by_actuator: str, tmp_path: Path
) -> None:
    """It counted as a push of 0.2 J, and a tool that nothing drove tripped the run."""
    times = np.array([0.0, 0.5, 1.5, 2.0, 2.6, 3.0])
    position, at_rest = np.zeros((6, 3)), np.tile([1.0, 0, 0, 0], (6, 1))
    position[:, 2] = [0.0, 0.0, -0.06, -0.06, -0.04, -0.04]
    device = SimulatedDevice(path=Motion(times, position, at_rest))
    text = CARRIAGE.format(by_actuator=by_actuator, motor="")
    summary, report = ran(tmp_path, text, device, duration=3.0)
    height = read_recording(tmp_path / "run.mcap").ticks["tool_position"][:, 2]
    assert height[-1] - height.min() > 0.015
    assert report.hand_energy.scene == pytest.approx(-0.3 * 9.81 * height[-1], rel=0.02)
    assert report.hand_energy.motors == pytest.approx(0.0, abs=1e-12)
    assert report.hand_energy.inputs == 0.0
    assert (summary.is_certified, report.certified) == (True, True)
    assert not report.hand_energy.limit


def test_a_motor_beside_gravity_compensation_is_bounded(tmp_path: Path) -> None:
    def lift(bridge: Bridge, tick: int) -> None:
        if tick == 700:
            bridge.set_input(ctrl={"puller": 8.0})

    motor = '<actuator><motor name="puller" joint="z"/></actuator>'
    text = CARRIAGE.format(by_actuator="false", motor=motor)
    with pytest.raises(SafetyTrip, match="energy limit"):
        ran(tmp_path, text, on_tick=lift)
    assert audit(tmp_path / "run.mcap").hand_energy.net < 0.05


def test_motors_that_took_their_work_back_still_pushed() -> None:
    energy = HandEnergy(net=5e-3, motors=1e-5)
    assert energy.limit.startswith("motors of the scene pushed")
    assert not HandEnergy(net=5e-3, springs=4.5e-3, motors=1e-5).limit
    assert not HandEnergy(net=5e-3, unpaid=4.5e-3, motors=1e-5).limit
    assert HandEnergy(net=5e-3, motors=0.01, inputs=0.02).limit.startswith("motors and inputs of")
    assert HandEnergy(net=5e-3, motors=0.01, inputs=1e-5).limit.startswith("motors of")


@pytest.mark.parametrize("resolution", [0.0, 5e-5, 1e-3])
@pytest.mark.parametrize("seed", [1, 2])
def test_no_honest_hand_is_accused_of_encoder_steps(
    resolution: float, seed: int, tmp_path: Path
) -> None:
    device = SimulatedDevice(resolution=resolution, path=random_motion(seed, 1.5))
    summary = recorded(tmp_path / "run.mcap", "peg_in_hole", device, duration=1.5)
    report = audit(tmp_path / "run.mcap")
    assert summary.hand_energy.unpaid <= 1e-12
    assert report.hand_energy.unpaid <= 1e-12
    assert abs(summary.energies["device_energy"]) > 1e-4  # and it was at work


def test_energy_from_another_hand_is_paid(tmp_path: Path) -> None:
    scene, path = tmp_path / "bar.xml", tmp_path / "run.mcap"
    scene.write_text(BAR)
    hands: Any = [
        Grasp("left", SimulatedDevice(path=random_motion(4, 1.5))),
        Grasp("right", SimulatedDevice(hand=None)),
    ]
    summary = recorded(path, scene, hands, duration=1.5, limits=DEVICE_LIMITS, controller=None)
    report = audit(path)
    got = [each.energies["device_energy"] for each in summary.hands]
    assert got[1] > 1e-3  # moved by the other hand
    for ours, theirs in zip(summary.hands, report.hand_energies, strict=True):
        assert ours.hand_energy.unpaid <= 1e-12
        assert theirs.unpaid == pytest.approx(ours.hand_energy.unpaid, abs=1e-12)
        assert theirs.net == pytest.approx(ours.hand_energy.net, rel=1e-9, abs=1e-10)
    assert (summary.is_certified, report.certified, report.verdict) == (True, True, "passive")


def test_the_worst_hand_is_the_one_with_unpaid_energy() -> None:
    pushed, kicked = HandEnergy(net=0.03, motors=0.05), HandEnergy(net=2e-3, unpaid=2e-3)
    with fast("point_mass", ScriptedDevice(sway)) as bridge:
        found = bridge.run(0.05).certification
    each = [replace(found, energy=own) for own in (pushed, kicked)]
    assert worst_certification(each).energy is kicked
    mild = replace(found, energy=HandEnergy(net=0.1, springs=0.1))
    assert worst_certification([mild, each[0]]).energy is pushed
    weak = replace(mild, standing=Standing.DAMPING)
    assert worst_certification([*each, weak]) is weak


def test_a_trip_by_inputs_names_them_and_not_the_stiffness(tmp_path: Path) -> None:
    def shove(bridge: Bridge, tick: int) -> None:
        if tick == 200:
            bridge.set_input(body_wrench={"tool": (5, 0, 0, 0, 0, 0)})

    with pytest.raises(SafetyTrip) as trip:
        ran(tmp_path, FLOATING, on_tick=shove)
    (note,) = trip.value.__notes__
    assert note.startswith("the scene's inputs (applied forces, moved mocap bodies")
    assert "--stiffness" not in note


def test_a_run_that_tripped_and_its_audit_name_the_tick_by_which_they_differ(
    tmp_path: Path,
) -> None:
    """The refused tick has no record, so an audit cannot know what its sample adds."""
    path, scene = tmp_path / "run.mcap", tmp_path / "scene.xml"
    scene.write_text(FLOATING)
    with fast(scene, recording=path, limits=DEVICE_LIMITS) as bridge:
        bridge.set_input(body_wrench={"tool": (0.5, 0, 0, 0, 0, 0)})
        assert "with the tick that tripped" not in str(bridge.run(duration=0.05))
        bridge.set_input(body_wrench={"tool": (5, 0, 0, 0, 0, 0)})
        with pytest.raises(SafetyTrip):
            bridge.run(duration=1.0)
        summary = bridge.summary()
    assert f"with the tick that tripped, {summary.hand_energy.sentence}" in str(summary)
    report = audit(path)
    assert INSTANT < report.hand_energy.net < summary.hand_energy.net
    words = f"net to the hand, before the tick that tripped, {report.hand_energy.sentence}"
    assert words in report.reason


def test_a_trip_by_motors_that_took_more_than_they_gave_names_them(tmp_path: Path) -> None:
    """The hoist took more than the other motor gave, so the work of all motors was negative."""

    def push_beside_a_hoist(bridge: Bridge, tick: int) -> None:
        if tick % 10 == 0:
            force = 9.0 * math.sin(0.0126 * tick) if tick >= 500 else 0.0
            bridge.set_input(ctrl={"hoist": -0.1, "puller": force})

    with pytest.raises(SafetyTrip) as trip:
        ran(tmp_path, HOISTED, on_tick=push_beside_a_hoist, duration=2.0)
    (note,) = trip.value.__notes__
    assert note.startswith("the scene's motors took ")
    report = audit(tmp_path / "run.mcap")
    assert report.trip is not None
    assert report.trip.remedy(report.hand_energy).startswith("the scene's motors took ")


@pytest.mark.parametrize(
    ("energy", "words"),
    [
        (HandEnergy(net=4e-3, motors=3e-3), "the scene's motors did 3 mJ of work"),
        (HandEnergy(net=4e-3, inputs=-3e-3), "moved mocap bodies, belts) took 3 mJ until then"),
        (HandEnergy(net=0.04, motors=0.01, inputs=0.01), "lower --stiffness"),
        (HandEnergy(net=0.0, motors=0.5 * INSTANT), "lower --stiffness"),
        (HandEnergy(net=0.04, springs=0.05), "springs held 50 mJ at the start or after resets, by"),
        (HandEnergy(net=0.04, springs=0.01), "lower --stiffness"),
    ],
)
def test_a_trip_names_what_gave_at_least_half_of_the_net(energy: HandEnergy, words: str) -> None:
    assert words in Trip(TripCode.GAVE_ENERGY, 5).remedy(energy)
