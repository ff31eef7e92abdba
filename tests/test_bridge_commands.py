"""Commands in a run: what they do to it, what is booked, and that its recording can be judged."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from audit_cases import ScriptedDevice, recorded, rewritten, without_model
from report_runs import ANVIL, LOOSE

from hapticbridge.audit import audit
from hapticbridge.bridge import Bridge
from hapticbridge.clock import SimulatedClock
from hapticbridge.commands import Command, Couple, Mark, Reset, Switch
from hapticbridge.commands.execution import tuning_ticks
from hapticbridge.coupling import Coupling
from hapticbridge.errors import CommandError, DeviceError, RecordingError, SafetyTrip
from hapticbridge.guard import Limits
from hapticbridge.recording import read_recording

T = 1e-3
STEPS = tuning_ticks(T)

FLOOR = """<mujoco model="floor">
  <option timestep="0.001" integrator="discrete" cone="elliptic" gravity="0 0 -1"/>
  <worldbody>
    <geom type="plane" size="0.1 0.1 0.01"/>
    <body name="ball" pos="0 0 0.03">
      <freejoint/>
      <geom type="sphere" size="0.02" mass="0.1"/>
      <site name="grip"/>
    </body>
  </worldbody>
</mujoco>"""


def swaying(tick: int) -> tuple[float, ...]:
    return (0.01 * math.sin(0.01 * tick), 0, max(-1e-4 * tick, -0.012), 1, 0, 0, 0)


class Script:
    """Gives commands at ticks of the run."""

    def __init__(self, commands: Mapping[int, Command]) -> None:
        self.commands, self.done = commands, 0
        self.stiffness: list[float] = []
        self.bound: list[float] = []

    def __call__(self, bridge: Bridge, _: int) -> None:
        bridge.session.commands.now = lambda: self.done * T
        if self.done in self.commands:
            bridge.command(self.commands[self.done], by="test")
        coupling = bridge.session.kernel.bound.state["coupling"][0]
        self.stiffness.append(float(coupling["stiffness"]))
        self.bound.append(float(coupling["stiffness"] * T / 2 + coupling["damping"]))
        self.done += 1


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Callable[..., Any]]:
    def start(
        commands: Mapping[int, Command],
        seconds: float,
        scene: str = FLOOR,
        pose: Callable[[int], tuple[float, ...]] = swaying,
        coupling: Coupling = LOOSE,
        damping: float = 2.0,
        **options: Any,
    ) -> tuple[Any, Path, Script]:
        file, path = tmp_path / "scene.xml", options.pop("path", tmp_path / "run.mcap")
        file.write_text(scene)
        script = Script(commands)
        options.setdefault("on_tick", script)
        device = ScriptedDevice(pose, damping=damping)
        summary = recorded(path, str(file), device, coupling, duration=seconds, **options)
        return summary, path, script

    yield start


EVERYTHING: dict[int, Command] = {
    60: Couple(1000.0, 0.5),
    300: Couple(3000.0, 0.4),  # before the change before it is over
    900: Switch(force=False),
    960: Switch(force=True),
    1020: Switch(clutch=True),
    1080: Switch(clutch=False),
    1140: Reset(),
}


@pytest.mark.parametrize("method", ["lossless", "implicit", "compensated", "explicit"])
@pytest.mark.parametrize("pipelined", [False, True])
def test_a_run_with_commands_is_repeated_bit_for_bit_and_passive(
    run: Callable[..., Any], method: str, pipelined: bool
) -> None:
    summary, path, script = run(EVERYTHING, 1.4, method=method, pipelined=pipelined)
    report = audit(path)
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")
    assert report.certified is True
    assert "changed the coupling 2 times, last to K = 3000 N/m" in report.coupling_sentences[-1]
    assert (summary.verdict, summary.is_certified) == ("passive", True)
    # on the way no tick asks more of the device than both ends do
    assert max(script.bound) <= 2.0 * (1 + 1e-12)
    assert script.stiffness[-1] == 3000.0


def test_each_command_lands_in_an_event_with_its_tick(run: Callable[..., Any]) -> None:
    _, path, _ = run(EVERYTHING, 1.4)
    recording = read_recording(path)
    told = [(e["event"], e["tick"]) for e in recording.events]
    assert told == [
        ("start", 0),
        ("coupling", 60),
        ("coupling", 300),
        ("switch", 900),
        ("switch", 960),
        ("switch", 1020),
        ("switch", 1080),
        ("switch", 1140),  # the force fades
        ("reset", 1161),
        ("switch", 1161),
        ("stop", 1400),
    ]
    assert {e["by"] for e in recording.events if "by" in e} == {"test"}
    # whoever shows the switches must not take a reset for a force that was turned off
    assert [e["tick"] for e in recording.events if e.get("fading")] == [1140]


def stretched(tick: int) -> tuple[float, ...]:
    """Pulled 2 mm aside within 0.2 s, held, and let back between 0.9 and 1.1 s."""
    way = 2e-3 * (min(tick / 200, 1.0) if tick < 900 else max(1 - (tick - 900) / 200, 0.0))
    return (way, 0, 0, 1, 0, 0, 0)


def grown(path: Path, change: float) -> float:
    """Returns by how much springs that grow by a part of K in each tick of a change grow."""
    ticks = read_recording(path).ticks
    stretch = ticks["handle_position"][1:] - ticks["tool_position"][:-1]
    squares = np.sum(stretch[249 : 249 + STEPS] ** 2, axis=1)
    return float(np.sum(0.5 * change / STEPS * squares))


@pytest.mark.parametrize("stiffness", [1000.0, 3000.0])
def test_a_change_of_stiffness_gives_the_spring_half_of_it_times_its_stretch_squared(
    run: Callable[..., Any], stiffness: float
) -> None:
    change = stiffness - 2000.0
    summary, path, script = run({250: Couple(stiffness, 1.1)}, 0.85, ANVIL, stretched)
    # 2 mm, while the anvil of 20 t gives way by 0.05 mm
    assert summary.energies["tuning_work"] == pytest.approx(0.5 * change * 2e-3**2, rel=0.05)
    assert summary.energies["tuning_work"] == pytest.approx(grown(path, change), rel=1e-9)
    # the audit says so too, from its own sum
    assert (
        f"which gave the coupling {grown(path, change):.3g} J" in audit(path).coupling_sentences[-1]
    )
    climb = np.diff(script.stiffness)[250 : 250 + STEPS]
    np.testing.assert_allclose(climb, change / STEPS, rtol=1e-9)
    assert summary.energies["environment_energy"] <= 1e-9


def turned(tick: int) -> tuple[float, ...]:
    """Turned by 0.1 rad within 0.2 s and held."""
    half = 0.05 * min(tick / 200, 1.0)
    return (0, 0, 0, math.cos(half), 0, math.sin(half), 0)


@pytest.mark.parametrize("method", ["lossless", "implicit", "explicit"])
def test_a_change_of_turning_stiffness_gives_half_of_it_times_the_angle_squared(
    run: Callable[..., Any], method: str
) -> None:
    commands = {250: Couple(2000.0, 0.8, 3.0, 4e-4)}
    summary, path, _ = run(commands, 0.85, ANVIL, turned, method=method)
    ticks = read_recording(path).ticks
    both = ticks["handle_quaternion"][1:], ticks["tool_quaternion"][:-1]
    angle = 2 * np.arccos(np.sum(both[0] * both[1], axis=1))[249 : 249 + STEPS]
    assert 0.09 < angle.mean() < 0.1  # the anvil gives way by some milliradians
    # from 2 to 3 N m/rad in equal steps, while nothing is stretched
    grown_by = float(np.sum(0.5 / STEPS * angle**2))
    assert summary.energies["tuning_work"] == pytest.approx(grown_by, rel=1e-6)
    event = next(e for e in read_recording(path).events if e["event"] == "coupling")
    assert event["rotational_stiffness"] == 3.0
    report = audit(path)
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")
    assert "K_r = 3 N m/rad" in report.coupling_sentences[-1]
    # the torque in the end is that of the new spring
    last = 2 * np.arccos(np.sum(both[0][-1] * both[1][-1]))
    assert ticks["wrench_on_tool"][-1, 4] == pytest.approx(3.0 * last, rel=0.02)


def test_a_change_of_the_one_kind_of_gains_leaves_the_other(run: Callable[..., Any]) -> None:
    commands = {60: Couple(1000.0, 1.0, 1.0, 1e-3), 620: Couple(1500.0, 1.0)}
    _, path, _ = run(commands, 1.3)
    told = [e for e in read_recording(path).events if e["event"] == "coupling"]
    assert [e["rotational_stiffness"] for e in told] == [1.0, 1.0]
    assert told[0]["rotational_damping"] == told[1]["rotational_damping"]
    assert audit(path).resimulation == "bit for bit"


def test_what_a_command_gave_to_the_device_is_not_called_activity(run: Callable[..., Any]) -> None:
    # a device without the damping that the coupling needs, so that its port is watched
    soft = Coupling(1000.0, 0.1, 2.0, 1e-3)
    options = {"method": "implicit", "pose": stretched, "scene": ANVIL, "damping": 0.55}
    _, path, _ = run({}, 1.2, coupling=replace(soft, damping=0.2), **options)
    assert audit(path).certified is False
    energy = read_recording(path).ticks["device_energy"][-1]
    assert energy < 0  # what was put in came out, but for the dampers' share
    _, path, _ = run(
        {300: Couple(1050.0, 0.0)}, 1.2, coupling=replace(soft, damping=0.2), **options
    )
    recording, report = read_recording(path), audit(path)
    assert report.certified is False
    assert recording.ticks["device_energy"][-1] > energy + 0.5 * 0.5 * 50.0 * 2e-3**2
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")


GUARDED = Limits(force=10.0, torque=0.5, ramp=0.05)


def rubbed_and_pressed(tick: int) -> tuple[float, ...]:
    """Moved to and fro against the coupling's damper until 2 s, then 40 mm aside and back."""
    if tick < 2000:
        swing = min(max((tick - 100) / 200, 0.0), (2000 - tick) / 200, 1.0)
        way = 0.04 * swing * math.sin(0.02 * tick)
    else:
        way = 0.04 * min(max((tick - 2500) / 400, 0.0), 1.0, max((3800 - tick) / 400, 0.0))
    return (way, 0, 0, 1, 0, 0, 0)


def rubbed_and_turned(tick: int) -> tuple[float, ...]:
    """Turned to and fro until 2 s, then by half a radian and back."""
    if tick < 2000:
        swing = min(max((tick - 100) / 200, 0.0), (2000 - tick) / 200, 1.0)
        angle = 0.3 * swing * math.sin(0.04 * tick)
    else:
        angle = 0.5 * min(max((tick - 2500) / 400, 0.0), 1.0, max((3800 - tick) / 400, 0.0))
    return (0, 0, 0, math.cos(angle / 2), 0, math.sin(angle / 2), 0)


SPRING = """<mujoco>
  <option timestep="0.001" integrator="discrete" gravity="0 0 0"/>
  <worldbody>
    <body name="tool">
      <joint name="rail" type="slide" axis="1 0 0" stiffness="250"/>
      <geom size="0.01" mass="0.05"/>
      <site name="grip"/>
    </body>
  </worldbody>
</mujoco>"""


def rubbed_and_pushed(tick: int) -> tuple[float, ...]:
    """Moved to and fro until 2 s, then 40 mm into the spring and back."""
    if tick < 2000:
        swing = min(max((tick - 100) / 200, 0.0), (2000 - tick) / 200, 1.0)
        way = 0.02 * swing * math.sin(0.04 * tick)
    else:
        way = 0.04 * min(max((tick - 2200) / 300, 0.0), 1.0, max((3800 - tick) / 600, 0.0))
    return (way, 0, 0, 1, 0, 0, 0)


OF_A_SPRING: dict[str, Any] = {"scene": SPRING, "pose": rubbed_and_pushed}
OF_AN_ANVIL: dict[str, Any] = {
    "scene": ANVIL,
    "pose": rubbed_and_pressed,
    "method": "implicit",
    "coupling": Coupling(2000.0, 0.9, 2.0, 5e-4),
}
TURNED = {"pose": rubbed_and_turned, "coupling": Coupling(2000.0, 0.5, 2.0, 9e-4)}
COMMANDED: tuple[tuple[dict[str, Any], dict[int, Command], str], ...] = (
    # pressed in at 200 N/m, let out at 3000 N/m: 0.2 J from whoever turns the gains
    (OF_AN_ANVIL, {1900: Couple(200.0, 0.0), 2900: Couple(3000.0, 0.0)}, "tick 36"),
    # turned in at 0.2 N m/rad, let out at 3 N m/rad and 0.5 N m at most: 0.18 J
    (
        OF_AN_ANVIL | TURNED,
        {1900: Couple(2000.0, 0.5, 0.2, 0.0), 2900: Couple(2000.0, 0.5, 3.0, 0.0)},
        "tick 3[4-7]",
    ),
    # ½ 250 (40 mm)² = 0.2 J go in while nothing is felt, and would come out with up to 10 N; what
    # is rubbed away meanwhile does not pay for it
    (OF_A_SPRING, {1000: Switch(force=False), 2700: Switch(force=True)}, "tick"),
    # what a hand put into the scene comes back
    (OF_A_SPRING, {2600: Switch(force=False), 2700: Switch(force=True)}, ""),
    # 40 mm at 2000 N/m and 10 N: 0.375 J go in and come out
    (OF_AN_ANVIL, {2950: Couple(1990.0, 0.9)}, ""),
)


@pytest.mark.parametrize(("options", "commands", "trip"), COMMANDED)
def test_a_command_gives_a_hand_no_more_than_it_put_in_and_takes_none_of_it(
    run: Callable[..., Any], options: dict[str, Any], commands: dict[int, Command], trip: str
) -> None:
    more = {"limits": GUARDED, "controller": None}
    if trip:
        with pytest.raises(SafetyTrip, match=f"{trip}.*more energy beyond what the hand put in"):
            run(commands, 5.0, **options, **more)
        return
    summary, path, _ = run(commands, 4.0, **options, **more)
    assert summary.stopped_by == "duration"
    report = audit(path)
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")
    # but for what damper and pause took away
    work = read_recording(path).ticks["device_energy"]
    assert work[-1] - work[2720] > 0.1


def test_what_a_hand_rubbed_away_would_pay_if_it_were_not_forgotten(
    run: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    options, commands, _ = COMMANDED[1]
    monkeypatch.setattr("hapticbridge.kernel.state.cap_dissipation", lambda _state: None)
    summary, *_ = run(commands, 4.0, **options, limits=GUARDED, controller=None)
    assert summary.stopped_by == "duration"


def test_a_stretch_that_was_not_felt_saves_nothing(run: Callable[..., Any]) -> None:
    script = Script({1000: Switch(force=False), 2900: Switch(force=True)})
    given: list[float] = []

    def on_tick(bridge: Bridge, tick: int) -> None:
        script(bridge, tick)
        given.append(float(bridge.session.kernel.bound.state["observer"]["net_device_energy"][0]))

    run({}, 3.0, ANVIL, rubbed_and_pressed, on_tick=on_tick, limits=GUARDED)
    # 40 mm at 2000 N/m and 10 N would be 0.375 J, but the coupling is re-seated
    assert given[2900] < -0.5
    assert given[2901] == pytest.approx(-0.05, abs=0.01)


def test_force_off_sends_none_and_the_tool_still_follows(run: Callable[..., Any]) -> None:
    _, path, _ = run({600: Switch(force=False)}, 1.0)
    ticks = read_recording(path).ticks
    assert not ticks["wrench_on_device"][621:].any()
    assert np.abs(ticks["wrench_on_device"][:600]).max() > 0.1
    aside = ticks["tool_position"][:, 0]
    assert np.ptp(aside[650:]) > 5e-3
    assert audit(path).verdict == "passive"


def test_a_clutch_by_command_is_one_by_button(run: Callable[..., Any]) -> None:
    _, path, _ = run({600: Switch(clutch=True), 800: Switch(clutch=False)}, 1.0)
    ticks = read_recording(path).ticks
    handle = ticks["handle_position"]
    np.testing.assert_array_equal(handle[600:800], np.tile(handle[599], (200, 1)))
    np.testing.assert_allclose(handle[800], ticks["tool_position"][799], atol=1e-15)
    assert np.abs(np.diff(ticks["device_position"][600:800], axis=0)).max() > 0


def test_a_reset_puts_the_scene_back_and_books_what_that_takes(run: Callable[..., Any]) -> None:
    _, path, _ = run({600: Reset()}, 0.8)
    ticks = read_recording(path).ticks
    # 20 ms to fade, then the jump; within a tick the ball falls by 1e-6 m
    np.testing.assert_allclose(ticks["tool_position"][621], [0, 0, 0.03], atol=1e-5)
    assert np.linalg.norm(ticks["tool_position"][620] - [0, 0, 0.03]) > 5e-3
    assert not ticks["wrench_on_device"][620].any()
    stored = ticks["kinetic"] + ticks["potential"]
    jump = ticks["external_work"][621] - ticks["external_work"][620]
    assert jump == pytest.approx(stored[621] - stored[620], abs=1e-6)
    np.testing.assert_allclose(np.abs(ticks["external_work"][:621]).max(), 0, atol=1e-15)
    # the hand goes on from where it was without a blow
    change = np.linalg.norm(np.diff(ticks["wrench_on_device"][620:700, :3], axis=0), axis=1)
    assert change.max() < 0.5
    assert audit(path).verdict == "passive"


@pytest.mark.parametrize("is_blind", [False, True])
@pytest.mark.parametrize(
    ("event", "change"),
    [
        ("coupling", {"tick": 61}),
        ("coupling", {"stiffness": 1001.0}),
        ("coupling", {"ticks": 1}),
        ("coupling", {"damping": -1.0}),
        ("switch", {"force": True}),
        ("switch", {"tick": 901}),
        ("switch", {"clutch": 1}),
        ("reset", {"event": "nothing"}),
        ("reset", {"tick": 1162}),
        ("reset", {"tick": "x"}),
    ],
)
def test_an_event_that_was_changed_is_found(
    run: Callable[..., Any], event: str, change: dict[str, Any], is_blind: bool
) -> None:
    _, path, _ = run(EVERYTHING, 1.2)
    recording = read_recording(path)
    if is_blind:  # without a re-simulation, from records and events alone
        recording = without_model(recording)
    events = [dict(e) for e in recording.events]
    first = next(e for e in events if e["event"] == event)
    first |= change
    assert audit(rewritten(recording, path.with_name("changed.mcap"), events=events)).verdict == (
        "invalid"
    )


def test_a_run_refuses_what_its_device_does_not_bear(run: Callable[..., Any]) -> None:
    with pytest.raises(CommandError, match="and this one has 2"):
        run({10: Couple(4100.0, 0.0)}, 0.1)


def test_a_mark_is_an_event_and_changes_nothing_else(run: Callable[..., Any]) -> None:
    _, path, _ = run({}, 0.2)
    before = read_recording(path).ticks
    _, path, _ = run({70: Mark()}, 0.2)
    recording = read_recording(path)
    [mark] = [event for event in recording.events if event["event"] == "mark"]
    assert (mark["tick"], mark["by"], mark["time_ns"]) == (70, "test", 71_000_000)
    assert recording.ticks.tobytes() == before.tobytes()
    assert audit(path).resimulation == "bit for bit"


def pressed(tick: int) -> int:
    """Button 2 before the first tick, and in ticks 30 to 39 and 50; button 0 all the time."""
    return 0b1 | (tick < 5 or 30 <= tick < 40 or tick == 50) << 2


def test_each_press_of_the_button_marks_the_recording_once(tmp_path: Path) -> None:
    file, path = tmp_path / "scene.xml", tmp_path / "run.mcap"
    file.write_text(FLOOR)
    device = ScriptedDevice(swaying, buttons=pressed)
    recorded(path, str(file), device, LOOSE, duration=0.1, mark=2)
    recording = read_recording(path)
    marks = [event for event in recording.events if event["event"] == "mark"]
    assert [(event["tick"], event["by"]) for event in marks] == [(30, "button"), (50, "button")]
    assert recording.ticks["buttons"][30] == 0b101
    report = audit(path)
    assert report.events["mark"] == 2
    assert report.resimulation == "bit for bit"


def test_a_run_that_is_not_recorded_cannot_be_marked(tmp_path: Path) -> None:
    file = tmp_path / "scene.xml"
    file.write_text(FLOOR)
    with Bridge(str(file), ScriptedDevice(swaying), LOOSE, clock=SimulatedClock()) as bridge:
        with pytest.raises(CommandError, match="not recorded"):
            bridge.command(Mark())
        bridge.command(Switch(force=False))
        assert bridge.run(0.05).ticks == 50
    with pytest.raises(RecordingError, match="button 2 is to mark"):
        Bridge(str(file), ScriptedDevice(swaying), LOOSE, mark=2)
    with pytest.raises(DeviceError, match="mark button is 99"):
        Bridge(str(file), ScriptedDevice(swaying), LOOSE, mark=99)
