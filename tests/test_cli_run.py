"""``hapticbridge run``: options, trips, signals, and files that it leaves behind."""

from __future__ import annotations

import html
import itertools
import json
import math
import os
import pkgutil
import re
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from audit_cases import ScriptedDevice
from bridge_runs import still, sway
from cli_cases import Called, one_sentence
from faults.catalogue import SPECTATOR
from faults.processes import STOPS, children
from waiting import PATIENCE, is_alive, until

from hapticbridge.audit import audit
from hapticbridge.cli import main
from hapticbridge.recording import read_recording


def test_run_prints_the_summary_as_json(call: Called, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    command = ("run", "virtual_wall", "--fast", "--duration", 0.1, "--json", "--record", path)
    code, out, err = call(*command)
    assert (code, err) == (0, "")
    summary = json.loads(out)
    assert (summary["ticks"], summary["verdict"]) == (100, "passive")
    assert summary["recording"] == str(path)


def test_json_of_a_run_has_what_was_told_of_its_scene(call: Called, tmp_path: Path) -> None:
    """A program that reads the summary learns of changes and faults as a reader of the text."""
    path = tmp_path / "arm.xml"
    path.write_text(FELT_WRONG.format(turn='range="-0.78 0.78"', reach=0.15, width=0.01))
    command = ("run", path, "--fast", "--duration", 0.01)
    told = call(*command)[2]
    summary = json.loads(call(*command, "--json")[1])
    assert [line for line in summary["scene_changes"] if line not in told] == []
    assert len(summary["scene_changes"]) == told.count("changed in the scene: ") > 1
    assert len(summary["scene_findings"]) == told.count("warning: joint 'turn'") == 1


@pytest.mark.parametrize("named", [("--ramp", 0.2), ("--probe",)])
@pytest.mark.parametrize("hands", [1, 2])
def test_what_only_a_hand_gives_an_effect_is_refused_without_one(
    call: Called, tmp_path: Path, named: tuple[object, ...], hands: int
) -> None:
    """A motion that is prescribed would be the same with it."""
    motion = tmp_path / "hand.csv"
    motion.write_text("t,x,y,z\n0,0,0,0\n1,0.001,0,0\n")
    led: tuple[object, ...] = ("peg_in_hole", "--device", f"trajectory:{motion}")
    if hands == 2:
        each = (("--hand", f"{grip}=trajectory:{motion}") for grip in ("bolt", "wrench"))
        led = ("nut_and_wrench", *itertools.chain(*each))
    command = ("run", *led, "--fast", "--duration", 0.01)
    code, _, err = call(*command, *named)
    assert (code, f"{named[0]} has no effect on the device" in err) == (2, True)
    assert call(*command)[0] == 0


def test_a_motion_of_a_file_has_no_button_to_hold(call: Called, tmp_path: Path) -> None:
    """The tool would wait for ever for its dead-man button."""
    motion = tmp_path / "hand.csv"
    motion.write_text("t,x,y,z\n0,0,0,0\n1,0.001,0,0\n")
    command = ("run", "peg_in_hole", "--device", f"trajectory:{motion}", "--fast")
    code, _, err = call(*command, "--dead-man", 0)
    assert code == 2
    assert "dead-man is button 0, and the device 'trajectory' has none" in " ".join(err.split())


FELT_WRONG = """<mujoco>
  <compiler angle="degree"/>
  <worldbody>
    <body name="arm">
      <joint name="turn" axis="0 1 0" {turn}/>
      <geom type="capsule" fromto="0 0 0 {reach} 0 0" size="{width}" mass="0.2"/>
      <site name="grip" pos="{reach} 0 0"/>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.mark.parametrize(
    ("turn", "reach", "words"),
    [
        ('damping="0.01"', 0.15, []),
        ('damping="0.01"', 150.0, ["are these millimetres"]),
        ('range="-0.78 0.78" damping="0.01"', 0.15, ["are these radians?"]),
        ('frictionloss="0.5"', 0.15, ["creeps by"]),
        ('frictionloss="0.5" range="-0.7 0.7"', 150.0, ["millimetres", "radians"]),  # not a third
    ],
)
def test_a_run_repeats_the_worst_faults_of_its_scene(
    call: Called, tmp_path: Path, turn: str, reach: float, words: list[str]
) -> None:
    scene = tmp_path / "arm.xml"
    scene.write_text(FELT_WRONG.format(turn=turn, reach=reach, width=reach / 15))
    _, _, err = call("run", str(scene), "--fast", "--duration", "0.01")
    told = [line for line in err.splitlines() if "'hapticbridge check' says what to" in line]
    assert len(told) == len(words)
    assert all(word in line for word, line in zip(words, told, strict=True))
    assert all("arm.xml:" in line for line in told)


@pytest.mark.usefixtures("undrawn")
def test_warnings_of_a_run_are_in_its_audit_and_on_its_page(call: Called, tmp_path: Path) -> None:
    scene, record, page = (tmp_path / name for name in ("arm.xml", "arm.mcap", "arm.html"))
    scene.write_text(FELT_WRONG.format(turn='frictionloss="0.5"', reach=0.15, width=0.01))
    _, _, err = call("run", scene, "--fast", "--duration", 0.01, "--record", record)
    warning = next(line for line in err.splitlines() if "creeps by" in line)
    sentence = warning.removeprefix("warning: ")
    _, out, _ = call("audit", record, "--report", page, "--in-process")
    assert f"the run warned: {sentence}" in out
    assert f"The run warned: {sentence}." in html.unescape(page.read_text("utf-8"))


RESTING = """<mujoco><worldbody><geom type="plane" size="1 1 0.1"/>
<body name="block" pos="0 0 0.03">
<freejoint/><geom type="box" size="0.02 0.02 0.03" mass="0.2"/><site name="grip"/></body>
</worldbody></mujoco>"""


def test_one_damping_is_printed_before_the_run_after_it_and_by_the_audit(
    call: Called, tmp_path: Path
) -> None:
    """A tool that is always near a contact meets B_law + K T instead; that is said beside it."""
    scene, record = tmp_path / "block.xml", tmp_path / "block.mcap"
    scene.write_text(RESTING)
    _, out, err = call("run", scene, "--fast", "--duration", 0.1, "--record", record)
    usual = "K = 2400 N/m, B = 1.7 N s/m (B_law = 0.5"
    assert f"{usual})\n" in err
    held = f"{usual}, near contact or held, as here: B = 2.9)\n"
    assert held in out
    assert held in call("audit", record)[1]


def test_the_advice_of_a_run_that_is_not_certified_is_followed_with_success(
    call: Called, tmp_path: Path
) -> None:
    command = ("run", "point_mass", "--fast", "--duration", 0.01)
    path = tmp_path / "stiff.mcap"
    code, out, err = call(*command, "--stiffness", 5000, "--record", path)
    advice = "lower the stiffness to 3400 N/m, or raise the rate to 1480 Hz, with a damping of at"
    texts = (out, err, call("audit", path)[1])
    assert code == 1
    assert all(advice in " ".join(text.split()) for text in texts)
    assert not any("counts what the hand got" in text for text in texts)
    assert call(*command, "--stiffness", 3400)[0] == 0
    assert call(*command, "--stiffness", 5000, "--rate", 1480)[0] == 0


LIFTED = RESTING.replace("0 0 0.03", "0 0 {height}")


def test_the_potential_is_told_as_its_change_since_the_start(call: Called, tmp_path: Path) -> None:
    """Its zero is arbitrary: a scene that is built a metre higher has the same words."""
    told = []
    for height in (0.2, 1.2):
        scene, record = tmp_path / f"{height}.xml", tmp_path / f"{height}.mcap"
        scene.write_text(LIFTED.format(height=height))
        hand = tmp_path / "hand.csv"
        hand.write_text("t,x,y,z\n0,0,0,0\n0.2,0,0,0.01\n0.4,0,0,0.01\n")
        asked = ("--device", f"trajectory:{hand}", "--record", record)
        _, out, _ = call("run", scene, "--fast", *asked)
        rows = [line.split()[-2:] for line in out.splitlines() if line.startswith("potential ch")]
        told += rows
        assert f"potential change {' '.join(rows[0])}" in call("audit", record)[1]
    assert told[0] == told[1]
    millijoules, unit = told[0]
    assert unit == "mJ"
    # m g h of 1 cm; the bridge carries the weight, so the tool does not sag
    assert float(millijoules) == pytest.approx(1e3 * 0.2 * 9.81 * 0.01, rel=0.01)


def test_trip_is_told_with_what_to_do_about_it(call: Called, tmp_path: Path) -> None:
    path = tmp_path / "millimetres.csv"
    path.write_text("t,x,y,z\n0,0,0,0\n0.01,0.5,0,0\n")
    code, _, err = call("run", "point_mass", "--fast", "--device", f"trajectory:{path}")
    assert code == 3
    assert "than the stretch limit; check the motion's unit (m)" in err


LADEN = """<mujoco><option timestep="0.001"/><worldbody>
<body name="tray"><freejoint/><geom type="box" size=".1 .1 .01" mass=".3"/>
<site name="grip"/></body>
<body name="brick" pos="0 0 {0}"><freejoint/><geom type="box" size=".05 .05 .02" mass=".4"/></body>
</worldbody></mujoco>"""


@pytest.mark.parametrize("is_carried", [False, True])
@pytest.mark.parametrize("height", [0.03, 0.031])
def test_carrying_the_tool_is_advised_with_what_it_leaves_and_only_where_it_is_not_done(
    call: Called, tmp_path: Path, height: float, *, is_carried: bool
) -> None:
    scene = tmp_path / "laden.xml"
    scene.write_text(LADEN.format(height))
    options = ("--no-tool-weight",) if is_carried else ()
    _, _, err = call("run", scene, "--fast", "--duration", 0.05, *options)
    words = " ".join(err.split())
    advice = "--no-tool-weight carries the tool alone (tried: the hand then bears 3.9"
    cause = "what hangs or lies on the tool weighs most of the 6.87 N"
    assert (advice in words, cause in words) == (not is_carried, not is_carried)
    assert "this tool weighs" not in words
    assert ("from what hangs or lies on the tool, whose weight is carried" in words) == is_carried


def test_carrying_a_tool_that_the_file_carries_is_not_advised(call: Called, tmp_path: Path) -> None:
    scene = tmp_path / "laden.xml"
    scene.write_text(LADEN.format(0.03).replace('name="tray"', 'name="tray" gravcomp="1"'))
    _, _, err = call("run", scene, "--fast", "--duration", 0.05)
    words = " ".join(err.split())
    assert "what hangs or lies on the tool weighs most of the 3.9" in words
    assert 'gravcomp="1" in these bodies carries them' in words
    assert "--no-tool-weight" not in words


HAMMER = """<mujoco><option timestep="0.001"/><worldbody><body pos="0 0 0.2"><freejoint/>
<geom type="box" pos="0.3 0 0" size="0.015 0.015 0.04" mass="{}"/><site name="grip"/></body>
</worldbody></mujoco>"""


@pytest.mark.parametrize(("mass", "is_told"), [(0.03, False), (0.1, True)])
def test_a_head_held_off_its_centre_is_told_by_its_torque(
    call: Called, tmp_path: Path, mass: float, *, is_told: bool
) -> None:
    """m g l is 0.0883 and 0.294 N m, the limit 0.5 N m, K_r 2.4 N m/rad."""
    scene = tmp_path / "hammer.xml"
    scene.write_text(HAMMER.format(mass))
    _, _, err = call("run", scene, "--fast", "--duration", 0.05)
    found = re.search(
        r"this tool turns the hand with (\d+) mN m, which holds it ([\d.]+) deg beside the handle; "
        r"--no-tool-weight carries the tool alone \(tried: the hand then bears 0 N m\)",
        " ".join(err.split()),
    )
    assert bool(found) == is_told
    if found:
        torque, degrees = map(float, found.groups())
        assert 1e-3 * torque == pytest.approx(mass * 9.81 * 0.3, rel=0.02)
        assert degrees == pytest.approx(math.degrees(mass * 9.81 * 0.3 / 2.4), rel=0.02)


DRIVEN = """<mujoco><option timestep="0.001"/><worldbody><body name="sledge">
<joint name="x" type="slide" axis="1 0 0"/><geom type="box" size=".02 .02 .02" mass="0.1"/>
<site name="grip"/></body></worldbody>
<actuator><position name="puller" joint="x" kp="2000" kv="20"/></actuator>
<keyframe><key name="home" ctrl="0.1"/></keyframe></mujoco>"""
"""A motor that pulls the tool out of the hand from the first tick on."""


def test_a_motor_that_pulls_the_tool_is_told_as_the_load_and_as_the_reason_of_the_trip(
    call: Called, tmp_path: Path
) -> None:
    scene, record = tmp_path / "driven.xml", tmp_path / "driven.mcap"
    scene.write_text(DRIVEN)
    code, out, err = call("run", scene, "--fast", "--duration", 0.2, "--record", record)
    summary = out
    assert code == 3
    assert "most of it from motors, springs or parts of the scene" in err
    assert "this tool weighs" not in err
    assert "than the energy limit; the scene's motors did " in err
    assert "until then ('puller' pushes most)" in err
    assert "actuator 'puller' pushes joint 'x' with 200 N from the start on" in err
    assert "lower --stiffness" not in err
    assert "passive (strict), then the guard stopped the run" in out
    assert "mJ at most, beyond what it put in: the scene's motors gave or took " in out
    assert f"next: hapticbridge audit {record}" in out
    _, out, _ = call("audit", record)
    assert "and only --energy-limit bounds what they give the hand" in out
    for energy in ("kinetic", "actuator work", "coupling work", "device energy"):
        row = next(line for line in summary.splitlines() if line.startswith(energy))
        assert f"{energy} {row.removeprefix(energy).strip()}" in out
    assert "the tick that tripped is not among them" in out
    assert "what to change: the scene's motors did " in out
    scene.write_text(DRIVEN.replace('ctrl="0.1"', 'ctrl="0"'))  # as the remedy says
    assert call("run", scene, "--fast", "--duration", 0.2)[0] == 0


@pytest.mark.usefixtures("undrawn")
def test_a_certificate_names_its_limit_where_motors_pushed(call: Called, tmp_path: Path) -> None:
    scene, record, page = (tmp_path / name for name in ("weak.xml", "weak.mcap", "weak.html"))
    pushed = "but motors of the scene pushed: only --energy-limit bounds what they give the hand"
    for control, told in (("0.002", True), ("0", False)):
        scene.write_text(DRIVEN.replace('ctrl="0.1"', f'ctrl="{control}"'))
        limit = ("--energy-limit", 1, "--record", record, "--overwrite")
        code, out, _ = call("run", scene, "--fast", "--duration", 0.5, *limit)
        assert (code, pushed in out, "device certified" in out) == (0, told, True)
        code, out, _ = call("audit", record, "--report", page, "--in-process")
        assert (code, f"device certified: b >= KT/2 + B_law, {pushed}" in out) == (0, told)
        assert (pushed in page.read_text("utf-8")) == told
        out = call("audit", record, "--json", "--in-process")[1]
        assert ("and only --energy-limit bounds what they" in out) == told
        _, out, _ = call("audit", record, "--what-if", "stiffness=900", "--in-process")
        assert ("net to the hand" in out) == told


PUMPED = """<mujoco><option timestep="0.001"/><worldbody><body name="drawer">
<joint name="slide" type="slide" axis="1 0 0" range="-0.1 0.1" damping="{damping}"/>
<geom type="box" size="0.1 0.1 0.03" mass="0.5"/><site name="grip" pos="-0.11 0 0"/></body>
</worldbody><actuator><general name="pump" joint="slide" gainprm="0" biastype="affine"
biasprm="0 -50 {bias}"/></actuator></mujoco>"""
"""A drawer whose joint or motor pushes it the harder the faster it moves."""


@pytest.mark.parametrize(
    ("damping", "bias", "told", "remedy"),
    [
        (-6, 0, "joint 'slide' has a damping of -6", 'write damping="0" or more'),
        (1, 9, "actuator 'pump' pushes joint 'slide' harder", "write a third number of at most 0"),
        (1, -9, "", ""),
        (1, 0.5, "", ""),
    ],
)
def test_what_pumps_is_named_before_it_trips(
    call: Called, tmp_path: Path, damping: float, bias: float, told: str, remedy: str
) -> None:
    scene = tmp_path / "drawer.xml"
    scene.write_text(PUMPED.format(damping=damping, bias=bias))
    sway = "".join(f"{0.05 * k},{0.03 * math.sin(0.3 * k)},0,0\n" for k in range(61))
    scene.with_suffix(".csv").write_text(f"t,x,y,z\n{sway}")
    code, _, err = call("run", scene, "--fast")
    assert code == (3 if told else 0)
    assert "without a hand" not in err
    trip = next((line for line in err.splitlines() if line.startswith("safety trip")), "")
    assert told in trip
    assert remedy in trip
    assert ("harder" in err or "has a damping" in err) == bool(told)
    assert "lower --stiffness" not in err


def test_a_hand_without_an_end_of_its_motion_runs_for_five_simulated_seconds(
    call: Called, tmp_path: Path
) -> None:
    scene = tmp_path / "slide.xml"
    scene.write_text(DRIVEN.replace('ctrl="0.1"', 'ctrl="0"'))
    code, out, err = call("run", scene, "--fast")
    assert (code, "ran                 5.000 s" in out) == (0, True)
    assert "has no end: this run takes 5 s of simulated time (--duration takes another)" in err


def test_a_diverging_scene_trips_and_leaves_no_log_beside_the_user(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("wild.xml").write_text(
        """<mujoco>
          <worldbody>
            <body><freejoint/><geom size=".02" mass=".05"/><site name="grip"/></body>
            <body pos="1 0 0"><joint name="j" type="slide"/><geom size=".01" mass="1"/></body>
          </worldbody>
          <actuator>
            <general joint="j" biastype="affine" gainprm="0" biasprm="1 1e8 0"/>
          </actuator>
        </mujoco>""",
        encoding="utf-8",
    )
    assert main(["run", "wild.xml", "--fast", "--duration", "0.1"]) == 3
    told = capsys.readouterr().err
    assert "safety trip" in told
    assert not list(tmp_path.glob("*LOG*"))


SIGNALS = pytest.mark.parametrize("name", STOPS)


@pytest.fixture
def unheeded() -> Iterator[list[int]]:
    """Signals that Python's own handler would have got; that would end the tests with this one."""
    got: list[int] = []
    numbers = [signal.Signals[name] for name in STOPS]
    before = {each: signal.signal(each, lambda number, _: got.append(number)) for each in numbers}
    yield got
    for each, handler in before.items():
        signal.signal(each, handler)


@SIGNALS
@pytest.mark.parametrize(
    "moment",
    [
        "run.session.prepare",
        "signals.Interrupts.hand_over",
        "run.bridge.Bridge.run",
        "run.bridge.Bridge.__exit__",
    ],
)
def test_a_signal_before_and_after_the_loop_ends_the_run_cleanly(
    name: str,
    moment: str,
    call: Called,
    unheeded: list[int],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    path, device = tmp_path / "run.mcap", ScriptedDevice(still)
    monkeypatch.setattr("hapticbridge.cli.run.device_for", lambda *_: device)
    usual = pkgutil.resolve_name(f"hapticbridge.{moment}")

    def signalled(*arguments: Any, **options: Any) -> Any:
        os.kill(os.getpid(), getattr(signal, name))
        return usual(*arguments, **options)

    monkeypatch.setattr(f"hapticbridge.{moment}", signalled)
    code, out, err = call("run", "point_mass", "--fast", "--duration", 0.01, "--record", path)
    assert device.is_closed and not np.any(device.writes) and not unheeded
    if not moment.endswith("__exit__"):  # before the first tick
        ending = *STOPS[name], ""
        assert (code, err.splitlines()[-1], out) == ending
        assert not path.exists()
        return
    assert (code, "10 ticks (duration)" in out) == (0, True)
    recording = read_recording(path)
    assert not recording.is_cut and len(recording.ticks) == 10 and device.writes
    assert recording.events[-1]["reason"] == "duration"


MOMENTS = 8


def test_a_signal_at_any_moment_of_start_up_leaves_neither_file_nor_process(
    call: Called, unheeded: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hapticbridge.view.window.check_view", lambda: None)
    ends = SPECTATOR.replace("while True:", "while sys.stdin.buffer.readline():")
    monkeypatch.setattr("hapticbridge.view.window._BOOTSTRAP", ends)
    run = ("run", "point_mass", "--fast", "--overwrite", "--view", "--port", 0)
    monkeypatch.setattr("hapticbridge.cli.run.device_for", lambda *_: ScriptedDevice(still))
    for _ in range(2):  # the first one compiles
        began = time.monotonic()
        assert call(*run, "--record", tmp_path / "first.mcap", "--duration", 0.01)[0] == 0
        usual = time.monotonic() - began
    generator = np.random.default_rng(8)
    early, before = 0, children(os.getpid())
    for number, moment in enumerate(generator.uniform(0.0, 1.1 * usual, MOMENTS)):
        path, device = tmp_path / f"{number}.mcap", ScriptedDevice(still)
        opened: list[ScriptedDevice] = []

        def open_it(*_: Any, opened: Any = opened, device: Any = device) -> Any:
            opened.append(device)
            return device

        monkeypatch.setattr("hapticbridge.cli.run.device_for", open_it)
        name, is_over = list(STOPS)[number % 3], threading.Event()

        def strike(seconds: float, name: str = name, is_over: Any = is_over) -> None:
            # again only where it came before the command listened: a release that a busy machine
            # stretches must not meet a second one
            while not is_over.wait(seconds):
                unheeded.clear()
                os.kill(os.getpid(), signal.Signals[name])
                while not (unheeded or is_over.wait(1e-3)):
                    pass
                seconds = 0.1

        thread = threading.Thread(target=strike, args=(moment,))
        thread.start()
        code, _, err = call(*run, "--record", path)
        is_over.set()
        thread.join(PATIENCE)
        until(lambda: not set(filter(is_alive, children(os.getpid()))) - set(before))
        assert not any(map(np.any, device.writes))
        if code in {0, 1}:  # it ran
            assert len(read_recording(path).ticks) > 0 and device.is_closed
            continue
        early += 1
        assert (code, err.splitlines()[-1]) == STOPS[name]
        assert not path.exists() and "Traceback" not in err
        assert device.is_closed == bool(opened)
    assert early


@pytest.mark.parametrize(
    ("name", "module", "arguments"),
    [
        ("SIGINT", "identify", ("identify", "scripted")),
        ("SIGTERM", "zwidth", ("zwidth", "--measure", "scripted")),
    ],
)
def test_a_signal_while_a_device_is_measured_leaves_no_force(
    name: str,
    module: str,
    arguments: tuple[str, ...],
    call: Called,
    unheeded: list[int],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It comes in the first tick that has a force."""

    def strike(count: int) -> None:
        if count and device.writes[-1].any() and not struck:
            struck.append(count)
            os.kill(os.getpid(), getattr(signal, name))

    struck: list[int] = []
    device = ScriptedDevice(sway, on_write=strike)
    monkeypatch.setattr(f"hapticbridge.cli.{module}.open_device", lambda *_, **__: device)
    code, _, err = call(*arguments)
    assert (code, err.splitlines()[-1]) == STOPS[name]
    assert struck
    assert not device.writes[-1].any() and device.is_closed
    assert not unheeded


def test_existing_recording_is_kept_unless_overwriting_is_asked_for(
    call: Called, tmp_path: Path
) -> None:
    path = tmp_path / "run.mcap"
    precious = b"\x89MCAP0\r\nprecious"
    path.write_bytes(precious)
    command = ("run", "point_mass", "--fast", "--duration", 0.01, "--record", path)
    code, _, err = call(*command)
    assert code == 2
    assert "--overwrite" in one_sentence(err)
    assert path.read_bytes() == precious
    assert call(*command, "--duration", "nan", "--overwrite")[0] == 2
    assert path.read_bytes() == precious
    assert call(*command, "--overwrite")[0] == 0
    assert audit(path).verdict == "passive"


def test_a_device_that_does_not_turn_has_no_rotational_coupling_in_the_text(call: Called) -> None:
    for dof, is_told in ((3, False), (6, True)):
        device = f"simulated:dof={dof}"
        _, _, err = call("run", "point_mass", "--device", device, "--fast", "--duration", 0.05)
        assert ("K_r = " in err) == is_told


@pytest.mark.parametrize(
    ("name", "device"), [("scene.xml", "simulated"), ("motion.csv", "trajectory:{}")]
)
def test_a_file_that_is_no_recording_is_never_replaced_by_one(
    call: Called, tmp_path: Path, name: str, device: str
) -> None:
    path = tmp_path / name
    content = "t,x,y,z\n0,0,0,0\n1,0,0,0\n" if name.endswith("csv") else "<mujoco/>"
    path.write_text(content)
    options = ("--fast", "--duration", "0.1", "--device", device.format(path))
    code, _, err = call("run", "point_mass", *options, "--record", path, "--overwrite")
    assert code == 2
    assert "choose another file" in err
    assert path.read_text() == content


def test_a_recording_is_replaced_but_not_by_a_run_that_follows_it(
    call: Called, tmp_path: Path
) -> None:
    path = tmp_path / "run.mcap"
    options = ("run", "point_mass", "--fast", "--duration", "0.1", "--record", path, "--overwrite")
    assert call(*options)[0] == 0
    before = path.read_bytes()
    code, _, err = call(*options, "--device", f"trajectory:{path}")
    assert code == 2
    assert "is the motion of the run" in err
    assert path.read_bytes() == before
    assert call(*options)[0] == 0


HOISTED = """<mujoco><worldbody><body><joint name="rail" type="slide" axis="0 0 1"/>
<geom size=".02" mass="1"/><site name="grip"/></body></worldbody>
<actuator><motor joint="rail"/></actuator>
<keyframe><key name="home" ctrl="{}"/></keyframe></mujoco>"""
"""A tool of 1 kg (9.81 N) on a rail, which a motor lifts."""


@pytest.mark.parametrize(("lift", "bears"), [(5.7, "4.11 N"), (13.9, "4.09 N")])
def test_a_motor_that_carries_a_part_of_the_weight_is_not_the_load(
    call: Called, tmp_path: Path, lift: float, bears: str
) -> None:
    scene = tmp_path / "lifted.xml"
    scene.write_text(HOISTED.format(lift))
    _, _, err = call("run", scene, "--fast", "--duration", 0.01)
    words = " ".join(err.split())
    assert ("most of it from motors" in words) == (lift > 9.81)
    assert (f"this tool weighs {bears} in the hand" in words) == (lift < 9.81)
    assert bears in words
    assert "--no-tool-weight" not in words  # which would leave the whole force of the motor


@pytest.mark.parametrize("duration", ["1e306", "1e12"])
def test_a_duration_without_end_is_refused(call: Called, duration: str) -> None:
    code, _, err = call("run", "point_mass", "--fast", "--duration", duration)
    assert code == 2
    assert "at most 1e+09" in err


def test_a_tool_that_its_load_pulls_away_is_told_with_the_load(
    call: Called, tmp_path: Path
) -> None:
    """A weight of 1.2 kg pulls a sliding block by a rope, and the device holds 10 N."""
    scene = tmp_path / "rope.xml"
    scene.write_text(
        """<mujoco><worldbody><site name="ring" pos="0 0 1"/>
          <body pos="0 0 .5"><joint type="slide"/><geom size=".05" mass="1.2"/><site name="hook"/>
          </body>
          <body pos="0 .5 1"><joint type="slide" axis="0 1 0"/><geom size=".05" mass="1"/>
            <site name="grip"/></body></worldbody>
          <tendon><spatial range="0 1"><site site="hook"/><site site="ring"/><site site="grip"/>
          </spatial></tendon></mujoco>"""
    )
    code, _, err = call("run", scene, "--fast", "--duration", 2)
    assert code == 3
    words = " ".join(err.split())
    assert "farther from the handle than the stretch limit" in words
    assert "and of what hangs or lies on it" in words


def test_a_load_is_told_as_that_of_the_bodies_that_give_it(call: Called, tmp_path: Path) -> None:
    """A brick of 1 kg falls on a tray of 0.1 kg, and a chain of 0.3 kg hangs from one."""
    scene = tmp_path / "laden.xml"
    laden = LADEN.format(0.06).replace('".4"', '"1"').replace('".3"', '"{}"')
    of_brick = "N of it at rest from what hangs or lies on the tool"
    for mass, is_of_brick in (("0.1", True), ("1.2", False)):
        scene.write_text(laden.format(mass))
        _, _, err = call("run", scene, "--fast", "--duration", 0.01)
        words = " ".join(err.split())
        assert "weight of the tool: felt → carried (within 1 s it pulls with up to" in words
        assert (of_brick in words) == is_of_brick
    links = ""
    for _ in range(3):
        ball = '<joint type="ball"/><geom pos="0 0 -.05" size=".01" mass="0.1"/>'
        links = f'<body pos="0 0 -.05">{ball}{links}</body>'
    chain = """<mujoco><worldbody><body><freejoint/><site name="grip"/>
    <geom size=".02" mass="0.1"/>{}</body></worldbody></mujoco>"""
    for hanging, is_chain in ((links, True), ('<geom size=".03" mass="0.3"/>', False)):
        scene.write_text(chain.format(hanging))
        _, _, err = call("run", scene, "--fast", "--duration", 0.01)
        words = " ".join(err.split())
        assert "--no-tool-weight carries the tool alone (tried: the hand then bears 0 N)" in words
        assert ("this tool with its links (" in words) == is_chain
        assert ("this tool weighs" in words) != is_chain
