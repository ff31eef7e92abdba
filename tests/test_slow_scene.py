"""A scene that steps in a loop of its own: the run, its recording, changes, faults and the end."""

from __future__ import annotations

import gc
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from audit_cases import COUPLING, ScriptedDevice, SlowClock, recorded, verdict_of
from bridge_runs import fast, still, sway
from cli_cases import Called
from random_hands import random_motion

import hapticbridge as hb
from hapticbridge.audit import audit
from hapticbridge.clock import Clock
from hapticbridge.demand.methods import METHODS
from hapticbridge.device import SimulatedDevice
from hapticbridge.errors import HapticBridgeError, SafetyTrip
from hapticbridge.kernel import jit
from hapticbridge.realtime import busy_step_time
from hapticbridge.recording import read_recording
from hapticbridge.run.bridge import Bridge
from hapticbridge.run.commands import Couple, Reset
from hapticbridge.run.options import RunSetup, steady_stiffness
from hapticbridge.scene import load_scene
from hapticbridge.units import format_number
from hapticbridge.whatif import what_if
from hapticbridge.whatif.replayed_hand import load_bridge_code


def stroke(tick: int) -> tuple[float, ...]:
    """Presses the wall at 1 cm again and again."""
    return (0.008 - 0.008 * np.cos(0.012 * tick), 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


def audited(path: Path) -> Any:
    report = audit(path)
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit"), report
    assert report.environment == "strict"
    return report


@pytest.fixture(scope="module")
def pressed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("slow") / "pressed.mcap"
    recorded(path, "virtual_wall", ScriptedDevice(stroke), COUPLING, scene_rate=200.0, duration=0.6)
    return path


def test_a_slower_scene_runs_and_is_audited(pressed: Path) -> None:
    report = audited(pressed)
    ticks = read_recording(pressed).ticks
    assert ticks["scene_step"].tolist() == [tick // 5 for tick in range(600)]
    assert np.abs(ticks["wrench_on_device"][:, 0]).max() > 1.0
    assert report.timekeeping.scene_rate == pytest.approx(200.0)
    assert report.timekeeping.scene_speed == 1.0


BEADS: list[tuple[float, dict[str, float]]] = [
    (80.0, {"mass": 0.0005, "drag": 0.002}),
    (50.0, {"mass": 0.01, "drag": 0.2}),
]
"""Rate of the scene in Hz, and its parameters: light beads, and heavy ones with more drag."""


@pytest.mark.filterwarnings("ignore:without a hand")  # beads that roll off each other are chaotic
@pytest.mark.parametrize(("rate", "values"), BEADS, ids=str)
def test_a_bowl_of_beads_is_stirred_beside_the_loop(
    tmp_path: Path, rate: float, values: dict[str, float]
) -> None:
    path, device = tmp_path / "run.mcap", SimulatedDevice(path=random_motion(0, first=-0.045))
    scene = load_scene("beads", "grip", as_is=False, **values)
    summary = recorded(path, scene, device, scene_rate=rate, duration=1.2)
    assert summary.peak_force > 0.2  # the beads bear against the stick
    assert read_recording(path).ticks["contacts"].max() > 300
    audited(path)


@pytest.mark.filterwarnings("ignore:.*time step 0.01 s")
@pytest.mark.parametrize("options", [{"method": "implicit", "substeps": 4}, {"contact": "scene"}])
def test_the_scene_keeps_method_substeps_and_contact(
    tmp_path: Path, options: dict[str, Any]
) -> None:
    path = tmp_path / "run.mcap"
    device = ScriptedDevice(stroke)
    summary = recorded(
        path, "peg_in_hole", device, COUPLING, scene_rate=100.0, duration=0.4, **options
    )
    assert summary.environment in ("strict", "within slack")
    report = audit(path)
    assert (report.verdict, report.resimulation) == (summary.verdict, "bit for bit")


def test_late_results_are_recorded_and_repeated(tmp_path: Path) -> None:
    def delay(bridge: Bridge, tick: int) -> None:
        time.sleep(1e-4)  # a tick; the scene has two, and takes ten
        slow = bridge.session.slow
        assert slow is not None
        if tick == 0:
            step = slow.step

            def slowly(*scene: Any) -> None:
                time.sleep(1e-3)
                step(*scene)

            slow.step = slowly

    path = tmp_path / "late.mcap"
    device, clock = ScriptedDevice(sway), SlowClock({})
    summary = recorded(
        path,
        "point_mass",
        device,
        COUPLING,
        clock=clock,
        scene_rate=500.0,
        duration=0.5,
        on_tick=delay,
    )
    kept = summary.timekeeping
    assert kept.scene_speed < 0.95
    assert "slow motion: a lower --scene-rate" in kept.hint
    report = audited(path)
    assert report.timekeeping.scene_speed == kept.scene_speed
    assert "the scene at 500 Hz and" in report.timekeeping.remark
    gaps = np.diff(np.flatnonzero(np.diff(read_recording(path).ticks["scene_step"])))
    assert gaps.min() >= 2
    assert gaps.max() > 2


def test_a_program_that_changes_an_input_in_every_tick_is_audited(tmp_path: Path) -> None:
    """The audit then simulates tick by tick, in a child that may not compile."""
    body = load_scene("virtual_wall").model.body(1).name

    def push(bridge: Bridge, tick: int) -> None:
        bridge.set_input(body_wrench={body: (1e-3 * tick, 0, 0, 0, 0, 0)})

    path, device = tmp_path / "run.mcap", ScriptedDevice(stroke)
    recorded(path, "virtual_wall", device, scene_rate=200.0, duration=0.05, on_tick=push)
    assert audit(path).resimulation == "bit for bit"


def test_a_run_against_the_wall_clock_ends_with_its_thread(tmp_path: Path) -> None:
    path = tmp_path / "real.mcap"
    before = threading.active_count()
    with Bridge(
        "peg_in_hole", ScriptedDevice(stroke), COUPLING, recording=path, scene_rate=100.0
    ) as bridge:
        summary = bridge.run(0.3)
        again = bridge.run(0.2)
        assert threading.active_count() > before
    assert summary.verdict == again.verdict == "passive"
    assert threading.active_count() == before
    audited(path)


def test_changes_wait_for_the_step_under_way(tmp_path: Path) -> None:
    scene = tmp_path / "arm.xml"
    scene.write_text(ARM)
    path = tmp_path / "changed.mcap"

    def act(bridge: Bridge, tick: int) -> None:
        if tick == 33:
            bridge.set_input(ctrl={"lift": 1.0}, body_wrench={"arm": [0, 0, 0.3, 0, 0, 0]})
        if tick == 57:
            bridge.set_input(mocap={"plate": [0.2, 0, -0.03]})
        if tick == 101:
            bridge.command(Couple(800.0, 4.0))
        if tick == 903:
            bridge.session.commands.now = lambda: 1e9  # no command is too soon
            bridge.command(Reset())

    recorded(
        path, scene, ScriptedDevice(sway), COUPLING, scene_rate=100.0, duration=1.5, on_tick=act
    )
    report = audited(path)
    assert report.events["reset"] == report.events["coupling"] == 1
    assert report.events["input"] == 2
    ticks = read_recording(path).ticks
    assert np.ptp(ticks["actuator_work"][100:900]) > 1e-6  # the lift has moved the arm


ARM = """<mujoco>
  <worldbody>
    <body name="tool"><freejoint/><geom size="0.01" mass="0.1"/><site name="grip"/></body>
    <body name="arm" pos="0.2 0 0">
      <joint name="arm" type="slide" axis="0 0 1" stiffness="50" damping="0.5"/>
      <geom size="0.01" mass="0.2"/>
    </body>
    <body name="plate" mocap="true" pos="0.2 0 -0.1"><geom type="box" size="0.05 0.05 0.01"/></body>
  </worldbody>
  <actuator><motor name="lift" joint="arm"/></actuator>
</mujoco>"""


# Faults


def broken(bridge: Bridge, step: Callable[..., None]) -> None:
    """Replaces MuJoCo's step in the scene's loop."""
    slow = bridge.session.slow
    assert slow is not None
    slow.step = step


@pytest.mark.parametrize("clock", [hb.SimulatedClock, hb.RealClock])
def test_an_error_of_the_scene_ends_the_run_with_zero_force(clock: type) -> None:
    device = ScriptedDevice(sway)
    bridge = Bridge("point_mass", device, COUPLING, clock=clock(), scene_rate=100.0)

    def fails(*_: object) -> None:
        raise ArithmeticError("as told")

    with pytest.raises(ArithmeticError, match="as told"), bridge:
        bridge.run(0.1)
        broken(bridge, fails)
        bridge.run(1.0)
    assert device.is_closed
    assert not device.writes[-1].any()


def test_a_result_that_is_not_finite_trips() -> None:
    device = ScriptedDevice(sway)
    bridge = fast("point_mass", device, coupling=COUPLING, scene_rate=100.0)

    def spoils(_: object, data: Any) -> None:
        data.qvel[:] = np.nan

    with pytest.raises(SafetyTrip, match=r"not finite|unstable|diverge"), bridge:
        broken(bridge, spoils)
        bridge.run(1.0)
    assert not device.writes[-1].any()


@pytest.mark.filterwarnings("ignore:a step of scene .point_mass.")
def test_a_step_that_stands_still_keeps_no_device(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hapticbridge.run.slow_scene.MAX_WAIT", 0.1)
    device, release = ScriptedDevice(still), threading.Event()
    bridge = Bridge("point_mass", device, COUPLING, scene_rate=100.0)
    began = time.monotonic()
    try:
        with bridge:
            broken(bridge, lambda *_: print(release.wait(60.0)))
            summary = bridge.run(0.3)
        assert device.is_closed
        assert time.monotonic() - began < 30.0
        assert summary.ticks > 100  # the loop did not wait
        assert summary.timekeeping.scene_speed == 0.0
    finally:
        release.set()


class Held:
    """A step of MuJoCo that begins and does not end before it is told to."""

    def __init__(self, step: Callable[..., None]) -> None:
        self._step, self.has_begun, self.may_end = step, threading.Event(), threading.Event()

    def __call__(self, *scene: Any) -> None:
        self.has_begun.set()
        self.may_end.wait(60.0)
        self._step(*scene)


def holding(bridge: Bridge) -> Held:
    """Lets the scene's next step begin and not end."""
    slow = bridge.session.slow
    assert slow is not None
    slow.step = Held(slow.step)
    return slow.step


def test_a_scene_is_left_alone_while_a_step_of_it_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hapticbridge.run.slow_scene.MAX_WAIT", 0.1)
    scene, left = load_scene("peg_in_hole"), []
    bridge = Bridge(scene, ScriptedDevice(still), COUPLING, scene_rate=100.0)
    with pytest.warns(UserWarning, match="a step of scene 'peg_in_hole' still runs"), bridge:
        held, slow = holding(bridge), bridge.session.slow
        assert slow is not None
        monkeypatch.setattr(slow.bound, "release", lambda: left.append(held.may_end.is_set()))
        bridge.run(0.1)
        assert held.has_begun.is_set()
    assert not left  # nothing was put back into the model below the step
    with pytest.raises(HapticBridgeError, match="in use by another bridge; load it again"):
        scene.claim()
    held.may_end.set()


def test_a_step_that_does_not_end_lets_the_force_go_until_it_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hapticbridge.run.slow_scene.MAX_WAIT", 0.3)
    steps: list[Held] = []

    def act(bridge: Bridge, tick: int) -> None:
        time.sleep(1e-4)
        if tick == 203:
            steps.append(holding(bridge))
        if tick == 1000:
            steps[0].may_end.set()

    path = tmp_path / "held.mcap"
    with pytest.warns(UserWarning, match="the force is off until it ends"):
        summary = recorded(
            path,
            "virtual_wall",
            ScriptedDevice(stroke),
            COUPLING,
            clock=SlowClock({}),
            scene_rate=100.0,
            duration=1.6,
            on_tick=act,
        )
    report = audited(path)
    ticks, events = read_recording(path).ticks, read_recording(path).events
    switched = [(e["tick"], e["force"]) for e in events if e["event"] == "switch"]
    (off, is_on), (on, is_on_again) = switched
    assert (is_on, is_on_again) == (False, True)
    assert 203 + 310 <= off <= 203 + 450
    assert 1000 <= on <= 1250
    assert not ticks["wrench_on_device"][off + 100 : on].any()
    assert np.abs(ticks["wrench_on_device"][on + 100 :]).max() > 1.0
    for kept in (summary.timekeeping, report.timekeeping):
        assert "once without a result for" in kept.words
        assert kept.scene_silence == summary.timekeeping.scene_silence > 0.78


def test_a_reset_waits_for_the_step_under_way_and_the_loop_does_not(tmp_path: Path) -> None:
    steps: list[Held] = []

    def act(bridge: Bridge, tick: int) -> None:
        time.sleep(1e-4)
        if tick == 300:
            steps.append(holding(bridge))
        if tick == 320:
            assert steps[0].has_begun.wait(10.0)
            bridge.command(Reset())
        if tick == 500:
            steps[0].may_end.set()

    path, began = tmp_path / "reset.mcap", time.monotonic()
    options: dict[str, Any] = {"clock": SlowClock({}), "scene_rate": 100.0}
    recorded(
        path, "virtual_wall", ScriptedDevice(stroke), COUPLING, duration=1.0, on_tick=act, **options
    )
    assert time.monotonic() - began < 2.0 + 30.0
    (reset,) = [e["tick"] for e in read_recording(path).events if e["event"] == "reset"]
    assert 500 <= reset < 1000
    assert audited(path).timekeeping.scene_silence > 0.15


def test_a_step_that_diverged_before_a_reset_trips_as_its_result_would() -> None:
    device = ScriptedDevice(sway)
    bridge = fast("point_mass", device, coupling=COUPLING, scene_rate=100.0)

    def spoils(_: object, data: Any) -> None:
        data.qvel[:] = np.nan

    def act(tick: int) -> None:
        slow = bridge.session.slow
        assert slow is not None
        if tick == 95:
            usual, slow.step = slow.step, spoils
            slow.queue_change(lambda: setattr(slow, "step", usual))  # after the step under way
            bridge.session.executor.later.append((tick, "test"))

    with pytest.raises(SafetyTrip, match=r"not finite|unstable|diverge"), bridge:
        bridge.run(1.0, act)
    assert bridge.session.tick == 95
    assert not device.writes[-1].any()


@pytest.mark.parametrize("scene", ["peg_in_hole", "hammer"])
def test_a_tool_at_rest_stays_so_at_the_start_and_after_a_reset(tmp_path: Path, scene: str) -> None:
    """The scene's handle starts where the loop's does, which is not the world's origin."""

    def act(bridge: Bridge, tick: int) -> None:
        if tick == 203:
            bridge.command(Reset())

    path, coupling = tmp_path / "rest.mcap", hb.Coupling(800.0, 9.0, 0.8, 9e-3)
    recorded(
        path,
        scene,
        ScriptedDevice(still),
        coupling,
        scene_rate=100.0,
        duration=0.6,
        on_tick=act,
    )
    ticks = read_recording(path).ticks
    assert ticks["scene_step"][-1] > 50
    still_at = ticks["tool_position"][0]
    assert np.abs(ticks["tool_position"] - still_at).max() < 1e-4
    assert ticks["kinetic"].max() < 1e-6
    audited(path)


# Options


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"scene_rate": 3000.0}, "scene rate is 3000.0 Hz; it must be 'auto', or 1 to 1000"),
        ({"scene_rate": 0.5}, "it must be 'auto', or 1 to 1000"),
        ({"scene_rate": "fast"}, "scene rate is 'fast'; it must be finite, or 'auto'"),
        (
            {"scene_rate": 100.0, "method": "weld"},
            "'weld' has no scene slower than",
        ),
        ({"scene_rate": 100.0, "substeps": 2, "method": "lossless"}, "so it must be 1"),
    ],
)
def test_rates_that_no_scene_can_have_are_refused(options: dict[str, Any], words: str) -> None:
    with pytest.raises(HapticBridgeError, match=words):
        fast("point_mass", ScriptedDevice(still), **options)


def test_a_scene_that_cannot_keep_the_rate_steps_beside_the_loop(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def ticks_of(step: float, clock: Clock, **options: Any) -> int:
        monkeypatch.setattr("hapticbridge.run.options.busy_step_time", lambda *_: step)
        return Bridge("point_mass", ScriptedDevice(still), clock=clock, **options).setup.scene_ticks

    assert ticks_of(8e-3, hb.RealClock()) == 10  # a fifth of its time is to spare
    assert ticks_of(0.9e-3, hb.RealClock()) == 2
    assert ticks_of(0.7e-3, hb.RealClock()) == 0
    assert ticks_of(8e-3, hb.SimulatedClock()) == 0
    assert ticks_of(8e-3, hb.RealClock(), method="weld") == 0
    assert ticks_of(8e-3, hb.RealClock(), scene_rate=1000.0) == 0


def test_a_scene_of_doubtful_cost_is_stirred_and_left_as_it_was(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scene, method = load_scene("virtual_wall"), METHODS["lossless"]
    start = scene.data.qpos.copy()
    for at_start, is_stirred in ((0.05e-3, False), (0.2e-3, True)):
        monkeypatch.setattr("hapticbridge.realtime.realtime.step_time", lambda *_, s=at_start: s)
        found = busy_step_time(scene, method, 1e-3)
        assert (found != at_start) == is_stirred
        assert 1e-6 < found < 1e-3
        assert np.array_equal(scene.data.qpos, start)
        assert scene.data.time == 0.0


def test_the_usual_coupling_to_a_slower_scene_does_not_shake() -> None:
    def setup(rate: float) -> RunSetup:
        return fast("point_mass", ScriptedDevice(still), scene_rate=rate).setup

    usual, slower = setup(1000.0), setup(50.0)
    most = steady_stiffness(slower.scene, slower.info, 0.02, 1.0, 1.0)
    # K = 0.8/(T_s² (1/m_tool + 1/m_hand))
    hand = 0.55 + (slower.info.mass or 0.0)
    assert most == pytest.approx(0.8 / (0.02**2 * (1.0 / 0.1 + 1.0 / hand)), rel=1e-6)
    assert slower.law.stiffness == pytest.approx(most)
    assert slower.law.damping == pytest.approx(usual.law.damping)
    ratio = slower.law.rotational_stiffness / usual.law.rotational_stiffness
    assert ratio == pytest.approx(most / usual.law.stiffness)
    chosen = fast("point_mass", ScriptedDevice(still), coupling={"damping": 9.0}, scene_rate=50.0)
    assert chosen.setup.coupling.damping == 9.0
    assert chosen.setup.coupling.stiffness == slower.coupling.stiffness
    assert load_scene("point_mass").model.body_mass.sum() == pytest.approx(0.1)


# Recordings


@pytest.mark.parametrize("field", ["scene_tank", "scene_step"])
def test_a_changed_tank_or_step_is_seen(pressed: Path, tmp_path: Path, field: str) -> None:
    recording = read_recording(pressed)
    for first, change in ((301, 1), (305, 1), (305, -1)):
        ticks = recording.ticks.copy()
        ticks[field][first:] += change if field == "scene_step" else change * 1e-4
        report = verdict_of(recording, tmp_path, ticks=ticks)
        assert report.exit_code != 0, (field, first, change)


@pytest.mark.parametrize("is_resimulated", [True, False])
@pytest.mark.parametrize("ticks", ["0", "4", "6", "1", "-5", "x"])
def test_another_rate_of_the_scene_is_seen(
    pressed: Path, tmp_path: Path, ticks: str, is_resimulated: bool
) -> None:
    recording = read_recording(pressed)
    meta = {"scene_ticks": ticks} | ({} if is_resimulated else {"versions": "{}"})
    assert verdict_of(recording, tmp_path, meta=meta).exit_code != 0


def test_a_tool_that_nobody_paid_for_is_seen_without_simulation(
    pressed: Path, tmp_path: Path
) -> None:
    recording = read_recording(pressed)
    ticks = recording.ticks.copy()
    ticks["tool_position"][311:, 0] -= 2e-3  # toward the hand that pulls back
    report = verdict_of(recording, tmp_path, ticks=ticks, meta={"versions": "{}"})
    assert report.verdict == "invalid"


def test_what_if_repeats_it_to_the_bit(pressed: Path) -> None:
    result = what_if(pressed, {})
    assert any("the recorded one in every bit" in note for note in result.notes)


def test_the_command_line_names_the_rate(call: Called, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    code, out, err = call(
        *("run", "peg_in_hole", "--fast", "--duration", 0.3, "--record", path),
        *("--scene-rate", 100, "--stiffness", 3000),
    )
    assert code == 0
    assert "the scene steps at 100 Hz beside the loop" in err
    assert "the tool may shake above about" in err
    assert "N m/rad" not in err.split("shake above", 1)[1]
    assert "the scene at 100 Hz and 100 % of its speed" in " ".join(out.split())
    code, out, _ = call("audit", path)
    assert code == 0
    assert "the scene at 100 Hz and 100 % of its speed" in out


def test_the_usual_coupling_is_that_of_the_start_whatever_was_tried_or_stepped_before(
    call: Called, tmp_path: Path
) -> None:
    # a link of 20 g on a slide: that much is in the hand
    text = """<mujoco><option gravity="0 0 -3"/><worldbody><body><freejoint/>
      <geom size=".03" mass=".3"/><body pos=".05 0 0"><joint type="slide" axis="1 0 1"/>
      <geom size=".01" mass=".02"/><site name="grip"/></body></body></worldbody></mujoco>"""
    path, run = tmp_path / "scene.xml", tmp_path / "run.mcap"
    path.write_text(text)
    words = ("--fast", "--duration", 0.1, "--scene-rate", 250, "--json")
    assert call("run", path, *words, "--record", run)[0] == 0
    assert call("audit", run)[0] == 0
    scene = hb.load_scene(path)
    for _ in range(200):
        mujoco.mj_step(scene.model, scene.data)
    with hb.Bridge(scene, scene_rate=250.0, clock=hb.SimulatedClock()) as bridge:
        stepped = bridge.setups[0].coupling.stiffness
    assert float(read_recording(run).meta["stiffness"]) == stepped
    hand = 0.55 + (SimulatedDevice().info.mass or 0.0)
    assert stepped == pytest.approx(0.8 / (0.004**2 * (1.0 / 0.02 + 1.0 / hand)), rel=1e-3)


def test_the_command_line_warns_above_twice_the_steady_stiffness(call: Called) -> None:
    setup = fast("peg_in_hole", ScriptedDevice(still), scene_rate=100.0).setup
    limit = 2.0 * steady_stiffness(setup.scene, setup.info, 0.01, 1.0, 1.0)
    run = ("run", "peg_in_hole", "--fast", "--duration", 0.1, "--scene-rate", 100)
    for share, warns in ((0.98, False), (1.02, True)):
        code, _, err = call(*run, "--stiffness", share * limit)
        assert code == 0
        assert (
            f"may shake above about {format_number(limit, 2)} N/m" in " ".join(err.split())
        ) == warns


def test_the_command_line_warns_of_a_stiffness_that_lets_the_tool_shake_in_turns(
    call: Called,
) -> None:
    run = ("run", "peg_in_hole", "--fast", "--duration", 0.1, "--rotational-stiffness", 2.4)
    for rate, warns in ((50, True), (100, False)):
        code, _, err = call(*run, "--scene-rate", rate)
        assert code == 0
        assert ("may shake above about 2.2 N m/rad" in " ".join(err.split())) == warns


def test_a_scene_beside_the_loop_that_is_still_too_slow_is_warned_of(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("hapticbridge.realtime.realtime.step_time", lambda *_: 12e-3)
    device = ScriptedDevice(still)
    with (
        pytest.warns(UserWarning, match=r"12 ms for 10 ms .* slow motion; .* --scene-rate 67"),
        Bridge("point_mass", device, COUPLING, scene_rate=100.0),
    ):
        pass


def test_a_bridge_in_a_child_finds_its_machine_code_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    every = [each for each in gc.get_objects() if type(each) is jit.Compiled]
    for each in every:
        monkeypatch.setattr(each, "_direct", {})
    load_bridge_code.cache_clear()
    load_bridge_code("lossless", "rigid", True, False)

    def missing(self: Any, *_: object) -> bytes:
        raise AssertionError(f"{self.source.__name__} is not loaded")

    monkeypatch.setattr(jit.Compiled, "_object_code", missing)
    with fast("peg_in_hole", coupling=COUPLING, scene_rate=200.0) as bridge:
        assert bridge.run(0.01).ticks == 10
