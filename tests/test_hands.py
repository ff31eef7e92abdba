"""Bridges with several hands: two devices, one scene, one balance; recorded and audited."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from audit_cases import ScriptedDevice
from device_benches import opened_rawhid
from emulated.hid_seam import DrivingClock, HidSeam, Timed
from emulated.spacemouse_model import SpaceMouse
from numpy.typing import NDArray
from two_hands import BAR, PEG_AND_BLOCK, SCENES, two_handed

import hapticbridge as hb
from hapticbridge.cli.main import main
from hapticbridge.device import device_for
from hapticbridge.device.driver import ignore_message
from hapticbridge.device.spacemouse import open_spacemouse
from hapticbridge.errors import DeviceLost, HapticBridgeError
from hapticbridge.kernel.record import TickFlag, has_flag
from hapticbridge.recording import Recording
from hapticbridge.recording import format as layout
from hapticbridge.recording.format import MAX_HANDS
from hapticbridge.recording.reader import read_hands, read_with_attachments
from hapticbridge.recording.writer import rewrite
from hapticbridge.run.commands import Command, Couple, Reset, Switch
from hapticbridge.run.hands import DeviceGroup
from hapticbridge.whatif import what_if

SHARED = ("tick", "deadline_ns", "read_ns", "kinetic", "potential")


def clocked() -> hb.SimulatedClock:
    return hb.SimulatedClock()


def recorded(path: Path, scene: str = "bar", seconds: float = 1.0) -> hb.Summary:
    """Records two simulated hands of different damping."""
    hands = [hb.Grasp("left"), hb.Grasp("right", "simulated:damping=3")]
    loaded = two_handed(SCENES[scene])
    with hb.Bridge(loaded, hands, clock=clocked(), recording=path) as bridge:
        return bridge.run(seconds)


class Scripted(ScriptedDevice):
    """Device that moves as told and keeps what it was sent."""

    def __init__(self, name: str, speed: float, **sheet: Any) -> None:
        self.speed, self.every, self.last_tick, self.remark = speed, 1, 1 << 30, ""
        super().__init__(
            lambda tick: (1e-3 * self.speed * tick, 0, 0, 1, 0, 0, 0),
            is_stale=lambda tick: tick % self.every != 0,
            name=name,
            **sheet,
        )

    def read(self, sample: NDArray[np.void]) -> int:
        if self.tick >= self.last_tick:
            raise DeviceLost(f"the device '{self.info.name}' is gone")
        return super().read(sample)


@pytest.mark.parametrize("scene", ["bar", "peg_and_block"])
def test_a_run_of_two_hands_is_passive_and_repeats_to_the_bit(scene: str, tmp_path: Path) -> None:
    summary = recorded(tmp_path / "run.mcap", scene)
    assert [each.grip for each in summary.hands] == ["left", "right"]
    assert (summary.verdict, summary.is_certified, summary.ticks) == ("passive", True, 1000)
    assert "hands together get no more than they put in or the scene had stored" in summary.headline
    report = hb.audit(tmp_path / "run.mcap", in_process=True)
    assert (report.verdict, report.certified, report.hands) == ("passive", True, ("left", "right"))
    assert report.resimulation == "bit for bit"
    assert [text.partition(":")[0] for text in report.conditions] == ["left"] * 2 + ["right"] * 2
    # the device with the least reserve counts: both kinds keep 15 %
    assert report.damping_margin == pytest.approx(0.15)


def test_each_hand_has_its_records_and_metadata(tmp_path: Path) -> None:
    recorded(tmp_path / "run.mcap")
    left, right = (hb.read_recording(tmp_path / "run.mcap", hand=hand) for hand in (0, 1))
    for name in SHARED:
        assert np.array_equal(left.ticks[name], right.ticks[name]), name
    assert (left.meta["grip"], right.meta["grip"]) == ("left", "right")
    assert [json.loads(each.meta["device"])["damping"] for each in (left, right)] == [2.0, 3.0]
    assert right.meta["scene_sha256"] == left.meta["scene_sha256"]
    work = left.ticks["coupling_work"] + right.ticks["coupling_work"]
    stored = left.ticks["kinetic"] + left.ticks["potential"]
    assert left.ticks["environment_energy"] == pytest.approx(stored - work, abs=1e-12)


def test_scales_and_limits_are_each_hands_own() -> None:
    still, moving = Scripted("still", 0.0), Scripted("moving", 2e-2)
    coupling = hb.Coupling(800.0, 0.5, 0.5, 1e-4)
    scaled = hb.Workspace(scale=0.5)
    hands = [
        hb.Grasp("left", still, coupling=coupling, limits=hb.Limits(force=1.0, torque=0.1)),
        hb.Grasp("right", moving, coupling=coupling, workspace=scaled),
    ]
    with hb.Bridge(two_handed(BAR), hands, clock=clocked()) as bridge:
        bridge.run(1.0)
    assert max(abs(sent[0]) for sent in still.writes) <= 1.0 + 1e-9
    # the bar rests under 1 N from the left, so the right holds 1 N, and its device half of it
    assert moving.writes[-3][0] == pytest.approx(-0.5, abs=0.01)


def test_a_device_with_a_grip_axis_gets_a_row_for_each_of_its_hands_at_zero_force_too() -> None:
    one, gripper = Scripted("one", 0.0), Scripted("gripper", 0.0)
    group = DeviceGroup([one, gripper], [1, 2])
    zero, wrenches = np.zeros(6), np.arange(18.0).reshape(3, 6)
    group.write(zero)
    group.write(wrenches)
    zero_sent, sent = zip(one.writes, gripper.writes, strict=True)
    assert [each.shape for each in (*zero_sent, *sent)] == [(6,), (2, 6)] * 2
    assert np.array_equal(sent[1], wrenches[1:])


def test_the_summary_says_what_a_driver_lost_with_the_hand_that_it_is_of() -> None:
    left, right = Scripted("left", 0.0), Scripted("right", 0.0)
    right.remark = "3 state frames lost, 0 damaged"
    hands = [hb.Grasp("left", left), hb.Grasp("right", right)]
    with hb.Bridge(two_handed(BAR), hands, clock=clocked()) as bridge:
        both = bridge.run(0.05)
    assert [each.driver for each in both.hands] == ["", right.remark]
    assert str(both).count(right.remark) == 1
    with hb.Bridge("point_mass", right, clock=clocked()) as bridge:
        assert f"driver              {right.remark}" in str(bridge.run(0.05))


def test_a_device_without_news_is_flagged_alone(tmp_path: Path) -> None:
    slow = Scripted("slow", 1e-3, rate=100.0)
    slow.every = 10
    hands = [hb.Grasp("left", Scripted("fast", 0.0)), hb.Grasp("right", slow)]
    path = tmp_path / "run.mcap"
    with hb.Bridge(two_handed(BAR), hands, clock=clocked(), recording=path) as bridge:
        bridge.run(0.5)
    shares = [
        has_flag(hb.read_recording(path, hand=hand).ticks, TickFlag.STALE_SAMPLE).mean()
        for hand in (0, 1)
    ]
    assert shares == pytest.approx([0.0, 0.9])
    assert hb.audit(path, in_process=True).resimulation == "bit for bit"


def test_a_simulated_hand_waits_until_a_real_device_is_still(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    hands = [
        hb.Grasp("left", Scripted("real", 0.0, is_real=True)),
        hb.Grasp("right", Scripted("not real", 0.05)),
    ]
    with hb.Bridge(two_handed(BAR), hands, recording=path) as bridge:
        bridge.run(0.05)
    moved = hb.read_recording(path, hand=1).ticks["device_position"][:, 0]
    assert moved[:3] == pytest.approx([0.0, 5e-5, 1e-4])


def test_either_device_stops_the_run_and_both_get_zero_force() -> None:
    left, right = Scripted("left one", 0.0), Scripted("right one", 1e-2)
    right.last_tick = 200
    hands = [hb.Grasp("left", left), hb.Grasp("right", right)]
    with (
        pytest.raises(hb.SafetyTrip, match="tick 200: the device 'right one' is gone"),
        hb.Bridge(two_handed(BAR), hands, clock=clocked()) as bridge,
    ):
        bridge.run(1.0)
    for device in (left, right):
        assert device.is_closed
        assert device.writes[-1].tolist() == [0.0] * 6
        assert device.writes[-3][0] != 0.0 or device is left


def test_a_trip_names_the_hand() -> None:
    left, right = Scripted("a", 0.0), Scripted("b", 0.0)
    hands = [hb.Grasp("left", left), hb.Grasp("right", right)]

    def jump(tick: int) -> None:
        right.speed = 0.0 if tick < 100 else 2.0

    with (
        pytest.raises(hb.SafetyTrip, match="hand at 'right': the device's pose jumped") as caught,
        hb.Bridge(two_handed(BAR), hands, clock=clocked()) as bridge,
    ):
        bridge.run(1.0, on_tick=jump)
    # the last second, a record per hand and tick, in order
    records = caught.value.records
    assert np.array_equal(records["tick"][::2], records["tick"][1::2])
    assert left.writes[-1].tolist() == right.writes[-1].tolist() == [0.0] * 6


def test_a_tool_that_is_too_heavy_for_both_hands_is_carried() -> None:
    heavy = BAR.replace('gravity="0 0 0"', 'gravity="0 0 -9.81"').replace('"0.2"', '"3"')
    with hb.Bridge(
        two_handed(heavy), [hb.Grasp("left"), hb.Grasp("right")], clock=clocked()
    ) as bridge:
        assert bridge.scene.is_carried
        summary = bridge.run(0.5)
    assert summary.verdict == "passive"
    assert max(each.peak_force for each in summary.hands) < 5.0


def test_the_weight_of_a_bar_is_shared(tmp_path: Path) -> None:
    light = BAR.replace('gravity="0 0 0"', 'gravity="0 0 -9.81"')
    path = tmp_path / "run.mcap"
    hands = [hb.Grasp("left", Scripted("a", 0.0)), hb.Grasp("right", Scripted("b", 0.0))]
    with hb.Bridge(two_handed(light), hands, clock=clocked(), recording=path) as bridge:
        bridge.run(0.5)
    for hand in (0, 1):
        ticks = hb.read_recording(path, hand=hand).ticks
        assert ticks["wrench_on_tool"][-1, 2] == pytest.approx(0.5 * 0.2 * 9.81, rel=1e-3)
        assert np.abs(ticks["tool_position"] - ticks["tool_position"][0]).max() < 1e-5
    assert hb.audit(path, in_process=True).verdict == "passive"


TWO = (hb.Grasp("left"), hb.Grasp("right"))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: bridge_of(TWO, method="lossless"), "method 'lossless' has one hand; several need"),
        (lambda: bridge_of(TWO, substeps=2), "several hands take one substep, not 2"),
        (lambda: bridge_of(TWO, scene_rate=100.0), "the scene steps in every tick for several"),
        (lambda: bridge_of(TWO, pipelined=True), "several hands have no pipelined tick"),
        (lambda: bridge_of(TWO, clutch=0), "name clutch and dead_man in its Grasp"),
        (lambda: bridge_of(TWO, mark=1, recording="x"), "several hands have no mark button"),
        (lambda: bridge_of(TWO[:1]), "there must be 2 to 8 different grips"),
        (lambda: bridge_of((TWO[0], TWO[0])), "there must be 2 to 8 different grips"),
        (lambda: bridge_of(TWO[::-1]), "load it with these, in this order"),
        (lambda: bridge_of(("left", "right")), "several hands are named by a Grasp each"),
        (lambda: bridge_of(TWO, {"damping": 1.0}), "has a coupling of its own"),
        (lambda: bridge_of("simulated"), "was loaded with 2 grips, and one device holds one"),
        (lambda: hb.Grasp(""), "grip is ''; it must be a text that is not empty"),
        (lambda: bridge_of(twice(Scripted("one", 0.0))), "two hands have one device"),
    ],
)
def test_what_several_hands_cannot_have_is_refused(call: Callable[[], Any], message: str) -> None:
    with pytest.raises(HapticBridgeError, match=message):
        call()


def bridge_of(device: Any, *arguments: Any, **options: Any) -> hb.Bridge:
    return hb.Bridge(two_handed(BAR), device, *arguments, clock=clocked(), **options)


def twice(device: Scripted) -> tuple[hb.Grasp, hb.Grasp]:
    return hb.Grasp("left", device), hb.Grasp("right", device)


RESET = 1100
COMMANDS: dict[int, Command] = {
    100: Couple(400.0, 0.3, grip="right"),
    700: Switch(force=False, grip="left"),
    900: Switch(force=True, grip="left"),
    RESET: Reset(),
    1800: Switch(clutch=True),
}


def commanded(path: Path, commands: dict[int, Command]) -> dict[str, NDArray[np.float64]]:
    """Records two moving hands and commands; returns the gains of both in each tick."""
    devices = Scripted("a", 2e-3), Scripted("b", -1e-3, damping=3.0)
    hands = [hb.Grasp(grip, each) for grip, each in zip(("left", "right"), devices, strict=True)]
    stiffness = np.zeros((2000, 2))
    with bridge_of(hands, recording=path) as bridge:

        def act(tick: int) -> None:
            bridge.session.commands.now = lambda: tick * 1e-3
            if tick in commands:
                bridge.command(commands[tick], "test")
            assert bridge.session.kernel.hands is not None
            stiffness[tick] = bridge.session.kernel.hands.state["coupling"]["stiffness"]

        bridge.run(2.0, on_tick=act)
    return {"stiffness": stiffness}


def test_a_command_is_for_its_hand_and_repeats_to_the_bit(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    stiffness = commanded(path, COMMANDS)["stiffness"]
    assert np.all(stiffness[:, 0] == stiffness[0, 0])
    assert stiffness[0, 1] != 400.0
    assert np.all(stiffness[700:, 1] == 400.0)
    left, right = (hb.read_recording(path, hand=hand) for hand in (0, 1))
    force = [np.linalg.norm(each.ticks["wrench_on_device"], axis=1) for each in (left, right)]
    assert np.all(force[0][850:900] == 0.0)
    assert np.all(force[1][850:900] > 0.0)
    for each in (left, right):  # both let go before the scene is reset, and hold it again
        [reset] = [event["tick"] for event in each.events if event["event"] == "reset"]
        assert np.all(each.ticks["wrench_on_device"][reset - 1] == 0.0)
        home = each.ticks["tool_position"][0]
        assert each.ticks["tool_position"][reset] == pytest.approx(home, abs=1e-5)
        assert np.linalg.norm(each.ticks["wrench_on_device"][1700]) > 0.0
        assert np.all(has_flag(each.ticks[1801:], TickFlag.CLUTCH))
    report = hb.audit(path, in_process=True)
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")


@pytest.mark.parametrize("grip", ["left", "elsewhere"])
def test_a_command_that_is_given_to_another_hand_is_noticed(grip: str, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    commanded(path, {100: COMMANDS[100]})

    forged = tmp_path / "forged.mcap"
    forge(path, forged, grip="right")
    assert hb.audit(forged, in_process=True).verdict == "passive"
    forge(path, forged, grip=grip)
    assert hb.audit(forged, in_process=True).verdict == "invalid"


def test_a_what_if_repeats_the_commands_of_each_hand(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    commanded(path, COMMANDS)
    again = what_if(path, {"rate": 500}).runs[1].recording
    changes, before = (
        [event for event in each.events if event["event"] in ("coupling", "switch")]
        for each in (again, hb.read_recording(path, hand=0))
    )
    assert [(each["tick"], each["grip"]) for each in changes] == [
        (math.ceil(each["tick"] / 2), each["grip"]) for each in before
    ]
    softer = what_if(path, {"right:stiffness": 300.0}).runs[1].recording
    assert not [event for event in softer.events if event["event"] == "coupling"]
    assert len([event for event in softer.events if event["event"] == "switch"]) == len(before) - 1


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (Couple(400.0, 0.3), "the command names no grip; it must be one of 'left', 'right'"),
        (Couple(400.0, 0.3, grip="middle"), "the command has grip 'middle'; it must be one of"),
        (Switch(force=False, grip="middle"), "the command has grip 'middle'; it must be one of"),
        (Couple(5e4, 0.3, grip="right"), "needs a device of"),
    ],
)
def test_a_command_for_no_hand_is_refused(command: Command, message: str) -> None:
    with bridge_of(TWO) as bridge, pytest.raises(HapticBridgeError, match=message):
        bridge.command(command)


def test_a_run_of_two_hands_resumes_after_a_pause(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with bridge_of(TWO, recording=path) as bridge:
        bridge.run(0.2)
        summary = bridge.run(0.2)
    assert summary.ticks == 400
    assert hb.audit(path, in_process=True).resimulation == "bit for bit"


def test_inputs_of_the_scene_are_repeated_by_the_audit(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"

    def push(tick: int) -> None:
        if tick == 100:
            bridge.set_input(body_wrench={"bar": [0.0, 1.0, 0.0, 0.0, 0.0, 0.0]})

    with bridge_of(TWO, recording=path) as bridge:
        bridge.run(0.4, on_tick=push)
    report = hb.audit(path, in_process=True)
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")
    assert report.energies["external_work"] > 1e-5


# Recordings


def test_readers_of_one_hand_refuse_a_recording_of_two(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    recorded(path, seconds=0.1)
    table = str(tmp_path / "x.csv")
    for command in (
        ["export", str(path), "--format", "csv", "--out", table],
        ["export", str(path), "--format", "lerobot", "--out", table],
    ):
        assert main(command) == 2, command
    with pytest.raises(hb.RecordingError, match=r"is a run of 2 hands \('left', 'right'\)"):
        hb.read_recording(path)
    with pytest.raises(hb.RecordingError, match="has no hand 2; its hands are 0 to 1"):
        hb.read_recording(path, hand=2)


CHANGES: tuple[tuple[str, int, Any], ...] = (
    ("wrench_on_tool", 0, 1e-3),
    ("wrench_on_tool", 1, 1e-3),
    ("coupling_work", 1, 1e-6),
    ("device_position", 1, 1e-5),
    ("wrench_on_device", 1, 1e-3),
    ("kinetic", 1, 1e-6),
    ("environment_energy", 1, 1e-6),
    ("contact_tank", 1, 1e-6),
)


@pytest.mark.parametrize(("field", "hand", "change"), CHANGES)
def test_a_changed_record_of_either_hand_is_noticed(
    field: str, hand: int, change: float, tmp_path: Path
) -> None:
    path, forged = tmp_path / "run.mcap", tmp_path / "forged.mcap"
    recorded(path, seconds=0.3)
    forge(path, forged)
    assert hb.audit(forged, in_process=True).verdict == "passive"

    def edit(ticks: list[NDArray[np.void]]) -> None:
        value = ticks[hand][field]
        value.reshape(len(value), -1)[150, 0] += change

    forge(path, forged, edit)
    report = hb.audit(forged, in_process=True)
    assert report.verdict == "invalid"
    assert report.tick is None or abs(report.tick - 150) <= 1


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("[3]", "metadata 'hands' are not texts by name"),
        (json.dumps([{}] * MAX_HANDS), "metadata 'hands' are not texts by name"),
        ("[]", "its hands have different numbers of records"),
        ('[{"grip": "right"}, {"grip": "left"}]', "its hands have different numbers of records"),
        ('[{"grip": "right", "period_s": "0.002"}]', "data of the device: 'damping' is 2.0"),
    ],
)
def test_changed_metadata_of_hands_are_noticed(value: str, message: str, tmp_path: Path) -> None:
    path, forged = tmp_path / "run.mcap", tmp_path / "forged.mcap"
    recorded(path, seconds=0.1)
    forge(path, forged, hands=value)
    report = hb.audit(forged, in_process=True)
    assert report.verdict == "invalid"
    assert message in report.reason


def test_a_recording_of_hands_with_different_ratios_of_scales_is_refused(tmp_path: Path) -> None:
    path, forged = tmp_path / "run.mcap", tmp_path / "forged.mcap"
    recorded(path, seconds=0.1)
    request = json.loads(hb.read_recording(path, hand=0).meta["request"])
    request["grasps"][1]["workspace"] = {
        **request["options"]["workspace"],
        "scale": 0.2,
        "force_scale": 1.0,
    }
    forge(path, forged, request=json.dumps(request))
    report = hb.audit(forged, in_process=True)
    assert (report.verdict, report.certified) == ("invalid", None)
    assert "is 1 for the hand at 'left' and 5 for that at 'right'" in report.reason


def forge(
    path: Path,
    forged: Path,
    edit: Callable[[list[NDArray[np.void]]], object] = lambda ticks: None,
    *,
    grip: str = "",
    **meta: str,
) -> None:
    """Writes a recording of two hands again, changed, with its checksums made anew.

    Changes of a coupling are given to the hand at ``grip``.
    """
    recording, files = read_with_attachments(path, 0)
    ticks = [hand.ticks.copy() for hand in read_hands(path)]
    edit(ticks)
    events = [
        {**event, "grip": grip} if event["event"] == "coupling" else event
        for event in recording.events
    ]
    changed = Recording(**{**vars(recording), "meta": recording.meta | meta})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(layout, "further_hands", lambda _: [{}])  # two, whatever the metadata are
        rewrite(changed, files, forged, ticks, events)


@pytest.mark.parametrize("most", [0, 1 << 17], ids=["from the file", "in memory"])
def test_a_cut_recording_of_two_hands_is_judged_up_to_the_cut(
    most: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from hapticbridge.recording import reader

    monkeypatch.setattr(reader, "MAX_KEPT", most)
    path, cut = tmp_path / "run.mcap", tmp_path / "cut.mcap"
    recorded(path, seconds=2.0)
    data = path.read_bytes()
    cut.write_bytes(data[: len(data) // 2])
    report = hb.audit(cut, in_process=True)
    assert report.is_cut
    assert 300 < report.ticks < 1900
    assert report.verdict == "passive"


# Command line


def test_the_command_runs_records_and_audits_two_hands(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene, path = tmp_path / "bar.xml", tmp_path / "run.mcap"
    scene.write_text(PEG_AND_BLOCK)
    hands = ["--hand", "left=simulated", "--hand", "right=simulated:damping=4"]
    run = ["run", str(scene), *hands, "--fast", "--duration", "0.5", "--record", str(path)]
    assert main(run) == 0
    printed = capsys.readouterr()
    assert "hand at 'left' on simulated:" in printed.out
    assert "hand at 'right' on simulated:" in printed.out
    assert "at 'right' on simulated, 1000 Hz, method implicit" in printed.err
    assert main(["audit", str(path)]) == 0
    assert "right: translation: device damping 4 >= 3.4 N s/m" in capsys.readouterr().out
    assert main([*run, "--overwrite", "--json"]) == 0
    values = json.loads(capsys.readouterr().out)
    assert [each["grip"] for each in values["hands"]] == ["left", "right"]


def test_one_hand_that_is_named_is_as_today(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = tmp_path / "bar.xml"
    scene.write_text(BAR)
    said = []
    for words in (("--hand", "left=simulated"), ("--grip", "left", "--device", "simulated")):
        assert main(["run", str(scene), "--fast", "--duration", "0.2", *words]) == 0
        said.append(capsys.readouterr())
    assert said[0] == said[1]
    assert "K = 2400 N/m" in said[0].out


@pytest.mark.parametrize(
    "name",
    ["left/pinch", "a=b", "a=simulated", "a+b", "a@1,2", "größe 1", "--help", "..", "x" * 300],
)
def test_any_name_of_a_scene_can_be_a_hand_of_two(tmp_path: Path, name: str) -> None:
    ball = '<body pos="{} 0 0.1"><freejoint/><geom size="0.02" mass="0.1"/><site name="{}"/></body>'
    balls = ball.format(0, name) + ball.format(0.2, f"{name}2")
    scene = tmp_path / "balls.xml"
    option = '<option gravity="0 0 0"/>'
    scene.write_text(f"<mujoco>{option}<worldbody>{balls}</worldbody></mujoco>", encoding="utf-8")
    record = tmp_path / "run.mcap"
    hands = (f"--hand={each}=simulated:damping=3" for each in (name, f"{name}2"))
    arguments = ["run", str(scene), *hands, "--fast", "--duration", "0.1", "--record", str(record)]
    assert main(arguments) == 0
    assert hb.audit(record).hands == (name, f"{name}2")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--hand", "left"), "--hand is 'left'; it must be GRIP=DEVICE"),
        (("--hand", "a=simulated", "--device", "mouse"), "takes the place of --grip and --device"),
        (("--hand", "a=simulated", "--hand", "b=mouse"), "the device 'mouse' moves in real time"),
        (
            ("--hand", "left=simulated", "--hand", "right=simulated", "--dead-man", "0"),
            "--clutch and --dead-man are buttons of a real device, and no hand has one",
        ),
        (
            ("--hand", "left=simulated", "--hand", "right=simulated", "--grip-axis", "jaw"),
            "--grip-axis is for one hand; several name it as in --hand left+jaw=simulated",
        ),
        (
            ("--hand", "left=simulated", "--hand", "right=simulated", "--grip-scale", "3"),
            "--grip-scale without a grip axis has no effect",
        ),
        (("--grip", "left", "--grip-scale", "3"), "--grip-scale without a grip axis"),
        (
            ("--hand", "left=simulated", "--hand", "right=simulated", "--absolute"),
            "hand at 'left': the device's absolute pose puts the handle 100 mm from the grip",
        ),
    ],
)
def test_the_command_refuses_in_one_sentence(
    arguments: tuple[str, ...],
    message: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    scene = tmp_path / "bar.xml"
    scene.write_text(BAR)
    assert main(["run", str(scene), "--fast", *arguments]) == 2
    assert message in " ".join(capsys.readouterr().err.split())


def test_the_command_gives_each_real_device_its_buttons(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = tmp_path / "bar.xml"
    scene.write_text(BAR)
    real = Scripted("real", 0.0, is_real=True)
    real.info = replace(real.info, buttons=1)
    monkeypatch.setattr(
        "hapticbridge.cli.run.device_for",
        lambda scene, name, *rest: real if name == "falcon" else device_for(scene, name, *rest),
    )
    hands = ["--hand", "left=falcon", "--hand", "right=simulated"]
    path = tmp_path / "run.mcap"
    run = ["run", str(scene), *hands, "--duration", "0.3", "--record", str(path)]
    assert main([*run, "--dead-man", "0"]) in (0, 1)  # 1 where a busy machine misses the rate
    capsys.readouterr()
    assert not np.any(real.writes)  # the button was never pressed
    clutched = [
        has_flag(hb.read_recording(path, hand=hand).ticks, TickFlag.CLUTCH).all() for hand in (0, 1)
    ]
    assert clutched == [True, False]


def test_a_simulated_hand_follows_the_path_of_its_grip(tmp_path: Path) -> None:
    scene = tmp_path / "bar.xml"
    scene.write_text(BAR)
    (tmp_path / "bar_right.csv").write_text("t,x,y,z\n0,0,0,0\n0.5,0,0.02,0\n")
    with hb.Bridge(scene, TWO, clock=clocked()) as bridge:
        bridge.run(0.5)
        ends = [bridge.scene.data.site(name).xpos[1] for name in ("left", "right")]
    assert ends[1] - ends[0] > 5e-3


# Emulated devices behind their drivers


class Together:
    """Several emulated buses at one time."""

    def __init__(self, *buses: Timed) -> None:
        self._buses, self.now = buses, max(bus.now for bus in buses)

    def advance(self, now: float) -> None:
        for bus in self._buses:
            bus.advance(now)
        self.now = max(self.now, now)


def test_a_board_and_a_spacemouse_hold_one_scene(tmp_path: Path) -> None:
    board, model, board_bus = opened_rawhid()
    mouse_bus = HidSeam(SpaceMouse(lambda when: (0.3 if when < 0.5 else 0.0, *[0.0] * 5)))
    mouse = open_spacemouse({}, ignore_message, mouse_bus)
    clock = DrivingClock(Together(board_bus, mouse_bus))
    hands, path = [hb.Grasp("left", board), hb.Grasp("right", mouse)], tmp_path / "run.mcap"
    felt = []
    with hb.Bridge(two_handed(BAR), hands, clock=clock, recording=path) as bridge:
        summary = bridge.run(1.0, on_tick=lambda _: felt.append(np.abs(model.wrench).max()))
    assert summary.verdict == "passive"
    # the puck pulls the bar away from the hand that holds the board
    assert max(felt) > 0.5
    assert np.abs(model.wrench).max() == 0.0
    report = hb.audit(path, in_process=True)
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")


def test_a_tool_too_heavy_for_a_hand_that_holds_a_joint_is_carried(tmp_path: Path) -> None:
    """The trial of a carried tool looked for a site of the joint's name, and there was none."""
    path = tmp_path / "lever.xml"
    path.write_text(
        """<mujoco><worldbody><body gravcomp="1"><freejoint/><geom size=".02" mass=".1"/>
        <site name="a"/></body><body pos="0 1 0"><joint name="jaw" axis="0 1 0"/>
        <geom pos=".2 0 0" size=".02" mass="8"/></body></worldbody></mujoco>"""
    )
    grasps = [hb.Grasp("a"), hb.Grasp("joint:jaw")]
    with hb.Bridge(path, grasps, clock=hb.SimulatedClock()) as bridge:
        assert bridge.scene.is_carried
        bridge.run(0.05)
    assert bridge.summary().verdict == "passive"
