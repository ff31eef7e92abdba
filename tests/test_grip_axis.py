"""Grip axis: the seventh axis of a device, coupled to a joint of the scene."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray
from two_hands import TONGS

import hapticbridge as hb
from hapticbridge.cli.main import main
from hapticbridge.device import GrippingDevice, SimulatedDevice
from hapticbridge.errors import DeviceError, HapticBridgeError
from hapticbridge.kernel.record import SAMPLE_DTYPE
from hapticbridge.testing.device_contract import CONTRACT

JOINT = "joint:hinge"

ASIDE = hb.Workspace(axes=(0, -1, 0, 1, 0, 0, 0, 0, 1))
"""Turns the device's x axis to the scene's y axis."""


class Fingers:
    """Device with a grip axis that moves as told and keeps what it was sent."""

    def __init__(self, speed: float = 0.0, travel: float | None = 0.03, **sheet: Any) -> None:
        axes = ("x", "y", "z", "rx", "ry", "rz")
        usual: dict[str, Any] = {
            "damping": 2.0,
            "rotational_damping": 2e-3,
            "delay": 0.0,
            "is_delay_measured": True,
            "is_real": False,
        }
        own = usual | {"axes": ("x",)} | sheet
        grip = hb.DeviceInfo(name="grip", force_limit=8.0, reach=travel, **own)
        self.info = hb.DeviceInfo(name="hand", axes=axes, force_limit=10.0, grip_axis=grip, **usual)
        self.speed, self.closed, self.buttons, self.period = speed, 0.0, 0, 0.0
        self.sent: list[NDArray[np.float64]] = []

    @property
    def felt(self) -> NDArray[np.float64]:
        """Forces on the fingers so far in N."""
        return np.array([each[1, 0] for each in self.sent])

    def start(self, period: float) -> NDArray[np.void]:
        self.period = period
        samples = np.zeros(2, SAMPLE_DTYPE)
        samples["quaternion"][:, 0] = 1.0
        return samples

    def read(self, sample: NDArray[np.void]) -> int:
        if self.sent:
            self.closed += self.speed * self.period
        sample["position"], sample["quaternion"] = 0.0, (1.0, 0.0, 0.0, 0.0)
        sample["buttons"] = self.buttons
        sample["position"][-1, 0] = self.closed if sample.size > 1 else 0.0
        return 0

    def write(self, wrench: NDArray[np.float64]) -> None:
        self.sent.append(np.array(wrench))

    def close(self) -> None:
        pass


def tongs() -> hb.Scene:
    return hb.load_scene(mujoco.MjSpec.from_string(TONGS), ("left", JOINT))


def bridge_of(device: Any, axis: hb.GripAxis, **options: Any) -> hb.Bridge:
    grasp = hb.Grasp("left", device, grip_axis=axis)
    return hb.Bridge(tongs(), [grasp], clock=hb.SimulatedClock(), **options)


@pytest.mark.parametrize("scale", [None, 10.0, -5.0])
def test_the_fingers_feel_the_spring_through_the_lever(scale: float | None) -> None:
    device = Fingers()
    with bridge_of(device, hb.GripAxis("hinge", scale)) as bridge:
        device.speed = 0.01
        bridge.run(0.8)
        device.speed = 0.0
        bridge.run(1.0)
        angle = float(bridge.scene.data.joint("hinge").qpos[0])
    lever = 0.5 / 0.03 if scale is None else scale
    # K of the coupling, at the device's damping of 2 N s/m: 2400 N/m at the fingers
    stiffness, spring = 2400.0 / lever**2, 0.05
    target = lever * device.closed + spring * 0.1 / stiffness
    expected = (stiffness * target - spring * 0.1) / (stiffness + spring)
    assert angle == pytest.approx(expected, abs=2e-5)
    force = -lever * spring * (angle + 0.1)
    assert device.felt[device.felt != 0.0][-1] == pytest.approx(force, rel=1e-3)
    assert device.sent[-1].tolist() == [[0.0] * 6] * 2  # at the end


WELDED = """<mujoco><option timestep="0.001"/><worldbody><body name="palm"><freejoint/>
<geom size=".03" mass=".2"/><site name="grip"/><body name="finger" pos=".05 0 0">
<joint name="jaw" type="slide" axis="0 1 0" range="0 .04"/><geom size=".01" mass=".02"/></body>
</body><body name="clamp" pos="0 0 1"><freejoint/><geom size=".01"/></body></worldbody>
<equality><weld body1="{}"/></equality></mujoco>"""


@pytest.mark.parametrize("welded", ["clamp", "palm"])
def test_a_grip_axis_in_a_scene_with_a_weld_to_the_world(welded: str) -> None:
    spec = mujoco.MjSpec.from_string(WELDED.format(welded))
    told = pytest.warns(UserWarning, match="the grip is held fast by a weld")
    with told if welded == "palm" else nullcontext():
        scene = hb.load_scene(spec, ("grip", "joint:jaw"))
    device = Fingers(speed=0.01)
    grasp = hb.Grasp("grip", device, grip_axis=hb.GripAxis("jaw", 1.0))
    with hb.Bridge(scene, [grasp], clock=hb.SimulatedClock()) as bridge:
        assert bridge.run(0.5).verdict == "passive"
        # the fingers close by 5 mm, against nothing but the finger's mass
        assert abs(float(bridge.scene.data.joint("jaw").qpos[0])) == pytest.approx(5e-3, abs=1e-3)


def test_a_run_is_passive_repeats_to_the_bit_and_notices_a_change(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    device = GrippingDevice(SimulatedDevice(), SimulatedDevice(dof=3), travel=0.05)
    with bridge_of(device, hb.GripAxis("hinge"), recording=path) as bridge:
        summary = bridge.run(1.5)
    assert [each.grip for each in summary.hands] == ["left", JOINT]
    assert summary.verdict == "passive"
    assert summary.hands[1].peak_force > 0.01
    assert "at the fingers" in str(summary)
    assert "on the fingers" in str(summary)
    report = hb.audit(path, in_process=True)
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")
    assert report.certified
    ticks = hb.read_recording(path, hand=1).ticks
    assert np.ptp(ticks["tool_position"][:, 0]) > 0.01
    assert not ticks["tool_position"][:, 1:].any()


def test_two_devices_may_hold_a_tool_and_its_joint(tmp_path: Path) -> None:
    # the second moves along all six axes, of which the joint takes x
    hands = [hb.Grasp("left"), hb.Grasp(JOINT, workspace=hb.Workspace(scale=10.0))]
    path = tmp_path / "run.mcap"
    with hb.Bridge(tongs(), hands, clock=hb.SimulatedClock(), recording=path) as bridge:
        summary = bridge.run(1.5)
    assert summary.verdict == "passive"
    ticks = hb.read_recording(path, hand=1).ticks
    assert np.ptp(ticks["handle_position"][:, 0]) > 0.01
    assert not ticks["wrench_on_tool"][:, 1:].any()
    assert hb.audit(path, in_process=True).resimulation == "bit for bit"


def test_the_force_of_the_fingers_stops_at_their_limit() -> None:
    device = Fingers(speed=0.05)
    with bridge_of(device, hb.GripAxis("hinge", 10.0)) as bridge:
        bridge.run(1.0)
        summary = bridge.summary()
    # the hinge stops at 0.3 rad, and the fingers go on
    assert np.abs(device.felt).max() == pytest.approx(8.0, rel=1e-6)
    assert summary.hands[1].limits_reached == ("force",)
    assert summary.verdict == "passive"


def test_a_dead_man_button_lets_go_of_both() -> None:
    device = Fingers(speed=0.02)
    grasp = hb.Grasp("left", device, grip_axis=hb.GripAxis("hinge", 10.0), dead_man=0)
    with hb.Bridge(tongs(), [grasp], clock=hb.SimulatedClock()) as bridge:
        device.buttons = 1
        bridge.run(0.5)
        assert np.abs(device.felt).max() > 0.05
        before = len(device.felt)
        device.buttons = 0
        bridge.run(0.5)
        assert not device.felt[before + 100 :].any()  # the force fades within 20 ticks


def test_a_device_whose_grip_axis_is_not_coupled_gets_six_numbers() -> None:
    device = Fingers()
    with hb.Bridge("point_mass", device, clock=hb.SimulatedClock()) as bridge:
        bridge.run(0.1)
    assert {each.shape for each in device.sent} == {(6,)}


@pytest.mark.parametrize("check", CONTRACT, ids=lambda check: check.__name__)
def test_the_simulated_one_fulfils_the_contract(check: Callable[[Any], None]) -> None:
    check(GrippingDevice(SimulatedDevice(), SimulatedDevice(dof=3), travel=0.03))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: bridge_of(Fingers(travel=None), hb.GripAxis("hinge")),
            "name the joint's motion",
        ),
        (lambda: bridge_of("simulated", hb.GripAxis("jaw")), "load it with these"),
        (lambda: bridge_of(SimulatedDevice(), hb.GripAxis("hinge")), "has no grip axis for joint"),
        (lambda: hb.GripAxis(""), "joint is ''; it must be a text that is not empty"),
        (lambda: hb.GripAxis("hinge", 0.0), "must be finite and not 0"),
        (lambda: turned_away(ASIDE), "a joint is moved by that axis"),
        (lambda: loaded("left", "joint:jaw"), "no hinge or slide 'jaw' to hold; .* 'hinge'"),
        (lambda: loaded(JOINT, "left"), "can only be held beside a site or a body"),
        (lambda: Fingers(axes=("y",)), "grip axis is .* must have the axis x"),
    ],
)
def test_what_cannot_be_is_refused(call: Callable[[], Any], message: str) -> None:
    with pytest.raises((HapticBridgeError, TypeError), match=message):
        call()


def turned_away(aside: hb.Workspace) -> hb.Bridge:
    hands = [hb.Grasp("left"), hb.Grasp(JOINT, workspace=aside)]
    return hb.Bridge(tongs(), hands, clock=hb.SimulatedClock())


def loaded(*grips: str) -> hb.Scene:
    return hb.load_scene(mujoco.MjSpec.from_string(TONGS), grips)


def test_the_data_sheet_holds_one_grip_axis_and_no_more() -> None:
    info = Fingers().info
    assert hb.DeviceInfo.from_json(info.to_json()) == info
    assert info.grip_axis is not None
    nested = info.to_json().replace('"grip_axis": null', '"grip_axis": {"grip_axis": {}}')
    with pytest.raises(DeviceError, match="grip_axis"):
        hb.DeviceInfo.from_json(nested)


def test_the_command_couples_the_joint_that_the_scene_names(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene, run = tmp_path / "tongs.xml", ["--fast", "--duration", "0.3", "--grip", "left"]
    text = '<custom><text name="grip_axis" data="hinge"/></custom><worldbody>'
    scene.write_text(TONGS.replace("<worldbody>", text, 1))
    (tmp_path / "tongs_hinge.csv").write_text("t,x,y,z\n0,0,0,0\n0.3,0.01,0,0\n")
    assert main(["run", str(scene), *run]) == 0
    assert "on the fingers" in capsys.readouterr().out
    assert main(["run", str(scene), *run, "--grip-axis", "none"]) == 0
    assert "on the fingers" not in capsys.readouterr().out
    assert main(["run", str(scene), *run, "--hand", "left+hinge=simulated"]) == 2
    capsys.readouterr()
    assert main(["run", str(scene), *run[:3], "--hand", "left+hinge=simulated"]) == 0
    assert "on the fingers" in capsys.readouterr().out
    motion = ["--device", f"trajectory:{tmp_path / 'tongs_hinge.csv'}"]
    assert main(["run", str(scene), *run, *motion]) == 0
    assert "has no grip axis, so joint 'hinge' moves freely" in capsys.readouterr().err
    assert main(["run", str(scene), *run, *motion, "--grip-axis", "hinge"]) == 2
    assert "has no grip axis for joint 'hinge'" in capsys.readouterr().err


# The pliers, as their own fingers close them


class Squeezed(NamedTuple):
    """Run of the pliers: per tick, crush of the wire in m, and the records of both hands."""

    crushed: NDArray[np.float64]
    hand: NDArray[np.void]
    fingers: NDArray[np.void]


LEVER = 0.25 / 0.03
"""Motion of the hinge per motion of the fingers in rad/m: range over travel."""


@pytest.fixture(scope="module")
def squeezed(tmp_path_factory: pytest.TempPathFactory) -> Squeezed:
    path = tmp_path_factory.mktemp("pliers") / "run.mcap"
    grasp = hb.Grasp("grip", grip_axis=hb.GripAxis("hinge"))
    crushed = []
    with hb.Bridge("pliers", [grasp], clock=hb.SimulatedClock(), recording=path) as bridge:
        wire = bridge.scene.data.joint("crush")
        bridge.run(on_tick=lambda _: crushed.append(float(wire.qpos[0])))
    report = hb.audit(path, in_process=True)
    assert (report.verdict, report.environment, report.resimulation) == (
        "passive",
        "strict",
        "bit for bit",
    )
    hand, fingers = (hb.read_recording(path, hand=each).ticks for each in (0, 1))
    return Squeezed(np.array([*crushed[1:], crushed[-1]]), hand, fingers)


def spring(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the torque of the return spring in N m."""
    return 0.4 * (angle + 0.15)


def test_the_fingers_feel_the_return_spring_until_the_wire(squeezed: Squeezed) -> None:
    angle, force = squeezed.fingers["tool_position"][:, 0], squeezed.fingers["wrench_on_device"]
    still = slice(2050, 2350)  # closed to just before the wire
    assert not squeezed.fingers["contacts"][still].any()
    assert -force[still, 0] == pytest.approx(LEVER * spring(angle[still]), rel=0.02)


def test_the_wire_yields_between_the_jaws_and_hardens(squeezed: Squeezed) -> None:
    angle, force = squeezed.fingers["tool_position"][:, 0], squeezed.fingers["wrench_on_device"]
    at_the_wire = (-force[:, 0] / LEVER - spring(angle)) / 0.02
    assert squeezed.crushed.max() > 0.6e-3
    for depth in (0.1e-3, 0.3e-3, 0.5e-3):
        tick = int(np.argmax(squeezed.crushed > depth))
        felt = at_the_wire[tick - 20 : tick + 20].mean()
        assert felt == pytest.approx(16.0 + 16e3 * depth, rel=0.04), depth


def test_the_crushed_wire_is_met_later(squeezed: Squeezed) -> None:
    touched = squeezed.fingers["contacts"] > 0
    angle = squeezed.fingers["tool_position"][:, 0]
    first, again = int(np.argmax(touched)), 5500 + int(np.argmax(touched[5500:]))
    # what the wire gave, 20 mm from the hinge
    later = squeezed.crushed[again - 1] / 0.02
    assert angle[again] - angle[first] == pytest.approx(later, abs=2e-3)


def test_a_squeeze_is_not_felt_by_the_hand_that_holds_the_pliers(squeezed: Squeezed) -> None:
    squeeze = slice(3000, 4300)
    assert np.abs(squeezed.fingers["wrench_on_device"][squeeze, 0]).max() > 5.0
    # 5 N between the fingers are internal; the hand bears the inertia of 0.1 kg
    assert np.abs(squeezed.hand["wrench_on_device"][squeeze, :3]).max() < 0.05


def test_the_command_tells_of_a_grip_axis_that_moves_no_joint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = tmp_path / "tongs.xml"
    scene.write_text(TONGS)
    monkeypatch.setattr("hapticbridge.cli.run.device_for", lambda *_: Fingers())
    run = ["run", str(scene), "--fast", "--duration", "0.05", "--grip", "left"]
    told = "the grip axis of 'hand' moves no joint; --grip-axis names one"
    for chosen, is_told in ([], True), (["--grip-axis", "none"], False):
        assert main([*run, *chosen]) in (0, 1)
        assert (told in capsys.readouterr().err) is is_told
