"""Another program's side of the loop: what it is told, what it may say, and a network between."""

from __future__ import annotations

import json
import os
import random
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from test_grip_axis import Fingers
from waiting import until

from hapticbridge import (
    Bridge,
    BridgeOptions,
    DeviceLoop,
    SimulatedClock,
    audit,
    read_recording,
)
from hapticbridge.audit.batch import audit_all
from hapticbridge.errors import DeviceLost, HapticBridgeError
from hapticbridge.program import poses
from hapticbridge.program.device_loop import Handle, Surface
from hapticbridge.program.loop_process import PROGRAM_VARIABLE
from hapticbridge.program.messages import (
    CALL_DTYPE,
    STATE_DTYPE,
    VERSION,
    Call,
    packed,
    unpacked,
)
from hapticbridge.run.commands import MAX_WAITING, Repeat, Switch
from hapticbridge.run.endpoint import Endpoint, GrantedClock, posted_scene, program_options

TOKEN = "a token of the tests"
START = np.array([0.1, 0.0, 0.2, 1.0, 0.0, 0.0, 0.0])


def followed(device: DeviceLoop, seconds: float, pose: Any = START) -> tuple[Any, list[Handle]]:
    """Runs a program of 50 Hz whose tool follows the handle in part; returns its last pose."""
    pose, handles = np.array(pose), []
    device.show(pose)
    for _ in range(round(seconds * 50)):
        handles.append(device.pose())
        pose[:3] += 0.3 * (handles[-1].position - pose[:3])
        device.show(pose)
        device.advance(0.02)
    return pose, handles


# A loop in simulated time


def test_a_program_of_its_own_is_felt_recorded_and_repeated(tmp_path: Path) -> None:
    paths, runs = [tmp_path / "a.mcap", tmp_path / "b.mcap"], []
    for path in paths:
        with DeviceLoop("simulated", recording=path, is_simulated=True, stiffness=400.0) as device:
            runs.append(followed(device, 2.0))
            credit = device.credit
        assert device.summary["verdict"] == "passive"
        assert device.summary["is_certified"]
        assert device.summary["coupling"]["requested"]["stiffness"] == 400.0
    (pose, handles), (other, _) = runs
    assert np.array_equal(pose, other)
    first, second = (read_recording(path).ticks for path in paths)
    for name in first.dtype.names or ():
        assert np.array_equal(first[name], second[name]), name
    report = audit(paths[0])
    assert (report.verdict, report.agreement) == ("passive", "bit for bit")
    assert handles[0].position == pytest.approx(START[:3])
    assert np.ptp([handle.position for handle in handles], axis=0).max() > 1e-3
    assert max(np.linalg.norm(handle.wrench[:3]) for handle in handles) > 0.05
    assert all(handle.is_held for handle in handles[20:])
    assert 0.0 < credit < 1.0


@pytest.mark.filterwarnings("ignore:the tool is shown at")
def test_a_tool_far_from_the_origin_leaves_a_sound_recording(tmp_path: Path) -> None:
    """At 1e8 m numbers are 1.5e-8 m apart, which was taken for a changed recording."""
    path, far = tmp_path / "run.mcap", [1e8, 0.0, 0.0]
    with DeviceLoop("simulated", recording=path, is_simulated=True) as device:
        followed(device, 0.5, pose=[*far, 1.0, 0.0, 0.0, 0.0])
    report = audit(path)
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")


def test_the_wrench_makes_the_work_known_to_the_last_digit() -> None:
    """A ledger of its own sums force times motion of a mass that the program moves."""
    mass, x, v, work = 0.5, START.copy(), np.zeros(3), 0.0
    with DeviceLoop("simulated", is_simulated=True, scene_rate=500.0) as device:
        for _ in range(500):
            force = device.wrench(x, v)[:3]
            v = v + 0.002 * (force - 2.0 * v) / mass
            work += float(force @ (0.002 * v))
            x[:3] += 0.002 * v
            device.advance(0.002)
        device.wrench(x, v)
        stated = device.work
        gap = np.linalg.norm(device.pose().position - x[:3])
        credit = device.credit
    assert abs(work) > 1e-6
    assert stated == pytest.approx(work, rel=1e-9)
    assert gap < 2e-3
    assert credit > 0.04


BALL = """<mujoco><worldbody><body gravcomp="1"><freejoint/>
  <geom size=".02" mass=".2"/><site name="tip"/></body></worldbody></mujoco>"""


@pytest.mark.parametrize("is_renewed", [True, False])
def test_a_wrench_at_the_pose_of_the_step_before_is_told(is_renewed: bool) -> None:
    model = mujoco.MjModel.from_xml_string(BALL)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    tip, forces = data.site("tip").xpos, []
    with (
        DeviceLoop("simulated", is_simulated=True, scene_rate=500.0) as device,
        nullcontext() if is_renewed else pytest.warns(UserWarning, match="mj_kinematics before"),
    ):
        device.show(tip)
        for _ in range(3000):
            if is_renewed:
                mujoco.mj_kinematics(model, data)
            data.xfrc_applied[1] = device.wrench(tip, data.qvel[:3])
            forces.append(float(np.linalg.norm(data.xfrc_applied[1, :3])))
            mujoco.mj_step(model, data)
            device.advance(model.opt.timestep)
    assert (max(forces) < 0.5) == is_renewed
    assert device.summary["verdict"] == "passive"


def test_a_wrench_along_the_tools_axes_is_told_with_its_cause() -> None:
    model = mujoco.MjModel.from_xml_string(BALL.replace("<body", '<body quat="1 0 0 1"'))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    tip = data.site("tip").xpos
    with (
        DeviceLoop("simulated", is_simulated=True, scene_rate=500.0) as device,
        pytest.warns(UserWarning, match="the wrench may act along other axes, with another sign"),
    ):
        device.show(tip)
        for _ in range(1000):
            force = device.wrench(tip, data.qvel[:3])[:3]
            data.xfrc_applied[1, :3] = data.xmat[1].reshape(3, 3).T @ force
            mujoco.mj_step(model, data)
            mujoco.mj_kinematics(model, data)
            device.advance(model.opt.timestep)
    assert device.summary["verdict"] == "passive"


def test_a_loop_whose_tool_is_a_million_times_as_strong_is_judged(tmp_path: Path) -> None:
    # K + B/T = 2e8 N/m: a pose rounded in its last digit, 0.1 m × 2.2e-16, is 5e-9 N
    path = tmp_path / "strong.mcap"
    with DeviceLoop(
        "simulated", recording=path, is_simulated=True, scale=2.5, force_scale=1e-6
    ) as device:
        followed(device, 0.2)
    report = audit(path)
    assert report.verdict == "passive", report.reason


def test_a_handle_is_put_where_the_tool_is_put() -> None:
    with DeviceLoop("simulated", is_simulated=True) as device:
        followed(device, 1.0)
        device.show([0.0, 0.5, 0.0], is_placed=True)
        device.advance(0.002)
        assert device.pose().position == pytest.approx([0.0, 0.5, 0.0], abs=1e-3)
        assert device.pose().matrix[:3, 3] == pytest.approx([0.0, 0.5, 0.0], abs=1e-3)


@pytest.mark.parametrize("is_simulated", [True, False])
def test_a_tool_that_moves_at_once_is_placed_where_it_was_put(
    tmp_path: Path, *, is_simulated: bool
) -> None:
    """It moves before a tick has passed; the handle stays where the tool was put."""
    path, tops = tmp_path / "run.mcap", [0.1, 0.3]
    with DeviceLoop("simulated", recording=path, is_simulated=is_simulated) as device:
        for top in tops:
            device.show([0.0, 0.0, top], is_placed=True)
            device.show([0.0, 0.0, top - 0.005])
            # in real time the hand has felt the tool by now
            assert device.pose().position[2] == pytest.approx(
                top, abs=0.0 if is_simulated else 6e-3
            )
            device.advance(0.02) if is_simulated else time.sleep(0.1)
    events = read_recording(path).events
    assert [event["pose"][2] for event in events if event["event"] == "reset"] == tops
    # of a program's scene nothing is known, in a table either
    assert audit_all([path]).texts("environment").tolist() == ["toward the hand"]
    assert json.loads(audit(path).to_json())["environment"] == "toward the hand"


# What a program may say


def test_each_mistake_of_a_program_gets_a_sentence() -> None:
    idle = DeviceLoop("simulated")
    with pytest.raises(HapticBridgeError, match="loop is not open"):
        idle.pose()
    with DeviceLoop("simulated", is_simulated=True) as device:
        with pytest.raises(HapticBridgeError, match="show the tool's pose once before"):
            device.pose()
        for pose, words in (
            ([0.0, 0.0], r"pose has shape \(2,\)"),
            ([0.0, np.nan, 0.0], "must be finite"),
            ([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], r"norm 0; it must be 1, in the order \(w, x"),
            ("here", "must be numbers"),
            (np.diag([2.0, 1.0, 1.0, 1.0]), "is no rotation"),
            (np.eye(4) + np.eye(4)[[3, 0, 1, 2]] * 0.1, "last row of the pose's matrix is"),
            (np.diag([-1.0, 1.0, 1.0, 1.0]), "is no rotation"),
        ):
            with pytest.raises(HapticBridgeError, match=words):
                device.show(pose)
        with pytest.raises(HapticBridgeError, match=r"velocity has shape \(2,\)"):
            device.show(START, [1.0, 2.0])
        with pytest.raises(HapticBridgeError, match="normal of a surface"):
            device.show(START, None, [Surface((0, 0, 0), (0, 0, 0))])
        strange: Any
        for strange in (Surface((0, 0, 0), (0, 0, 1)), [((0, 0, 0), (0, 0, 1))], None, 5, "no"):
            with pytest.raises(HapticBridgeError, match="must be a list of Surface"):
                device.show(START, None, strange)
        for wrong in (Surface((0, 0), (0, 0, 1)), Surface((0, 0, 0), (0, 0, 1), -0.1)):
            with pytest.raises(HapticBridgeError, match="a point of 3 numbers, and a gap"):
                device.show(START, None, [wrong])
        for strange, words in ((np.nan, "finite"), (-1.0, "must be 0 to"), ("x", "numbers")):
            with pytest.raises(HapticBridgeError, match=words):
                device.advance(strange)
        with pytest.raises(HapticBridgeError, match="17 surfaces are shown; 16 are the most"):
            device.show(START, None, [Surface((0, 0, 0), (0, 0, 1))] * 17)
        device.show(START)
        device.advance(0.0)


@pytest.mark.parametrize(("step", "count"), [(1 / 30, 30), (1 / 240, 60), (0.0004, 100)])
def test_steps_that_are_no_whole_ticks_add_up_to_their_time(
    tmp_path: Path, step: float, count: int
) -> None:
    path = tmp_path / "run.mcap"
    with DeviceLoop("simulated", recording=path, is_simulated=True) as device:
        device.show(START)
        for _ in range(count):
            device.advance(step)
    assert len(read_recording(path).ticks) == pytest.approx(1000 * step * count, abs=1)


@pytest.mark.parametrize(
    ("device", "options", "words"),
    [
        ("no such device", {}, "no such device"),
        ("simulated", {"stifness": 3.0}, "stifness"),
        ("simulated", {"credit": 0.0}, "credit"),
        ("simulated", {"python": "/no/python"}, "/no/python"),
        ("remote:here", {}, "remote:HOST:PORT"),
        ("remote:here:1", {"scale": 2.0}, "are those of 'hapticbridge serve' there"),
        ("remote:here:1", {}, "a remote loop needs its token"),
        ("remote:no-such-host.invalid:1", {"token": "t"}, "there is no host 'no-such-host.inv"),
        ("remote:127.0.0.1:1", {"token": "t"}, "no device loop answers at 127.0.0.1:1"),
        (5, {}, "device is 5; it must be a name"),
        ("simulated", {"recording": ""}, "recording is ''; it must be the name of a file"),
        ("simulated", {"tool_weight": False}, "tool-weight is for a scene that hapticbridge"),
        ("simulated", {"ramp": 0.2}, "the force begins at zero and rises within 20 ms"),
        ("simulated", {"probe": True, "is_simulated": True}, "probe takes a second before"),
    ],
)
def test_a_loop_that_cannot_start_says_why(device: str, options: Any, words: str) -> None:
    with pytest.raises(HapticBridgeError, match=words), DeviceLoop(device, **options):
        pass


def test_a_python_without_the_loop_gets_advice(tmp_path: Path) -> None:
    bare = tmp_path / "python"
    bare.write_text("#!/bin/sh\necho \"No module named 'rich'\" >&2\nexit 1\n")
    bare.chmod(0o755)
    words = "named 'rich' .*python= or HAPTICBRIDGE_PYTHON names a Python"
    with pytest.raises(HapticBridgeError, match=words), DeviceLoop("simulated", python=bare):
        pass
    with pytest.raises(HapticBridgeError) as its_own, DeviceLoop("no such device"):
        pass
    assert "HAPTICBRIDGE_PYTHON" not in str(its_own.value)


def test_a_loop_that_was_left_leaves_no_thread() -> None:
    before = set(threading.enumerate())
    for _ in range(2):
        with DeviceLoop(is_simulated=True) as device:
            followed(device, 0.04)
    assert set(threading.enumerate()) <= before


def test_a_loop_that_dies_is_lost_and_not_waited_for() -> None:
    with DeviceLoop("simulated", is_simulated=True) as device:
        device.show(START)
        assert device.pid is not None
        os.kill(device.pid, signal.SIGKILL)
        with pytest.raises(DeviceLost, match="the device loop ended"):
            for _ in range(500):
                device.pose()
                time.sleep(0.01)


def test_a_loop_that_was_killed_leaves_a_recording_to_audit(tmp_path: Path) -> None:
    for k in range(3):
        path = tmp_path / f"{k}.mcap"
        with DeviceLoop("simulated", recording=path) as device:
            pose = START.copy()
            with suppress(DeviceLost):
                for step in range(400):
                    device.show(pose)
                    pose[0] += 1e-5
                    time.sleep(0.0005)
                    if step == 300 + 7 * k:
                        assert device.pid is not None
                        os.kill(device.pid, signal.SIGKILL)
        until(lambda: read_recording(path).events[-1]["event"] == "bridge_died", 0.2)  # noqa: B023
        report = audit(path)
        assert (report.verdict, report.agreement) == ("passive", "bit for bit")
        assert "the bridge died" in str(report)


def test_a_loop_says_what_its_device_does_not_bear(capfd: pytest.CaptureFixture[str]) -> None:
    with DeviceLoop("simulated", is_simulated=True, stiffness=1e5, scene_rate=1000.0) as device:
        device.show(START)  # a rate at which the scene would step in every tick
        device.advance(0.1)
    assert "device damping 2 < 50" in capfd.readouterr().err


def test_a_loop_ends_with_the_program_that_was_killed(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    script = f"""
import hapticbridge, time
with hapticbridge.DeviceLoop("simulated", recording={str(path)!r}) as device:
    device.show([0.0, 0.0, 0.1])
    time.sleep(0.5)
    print("shown", flush=True)
    time.sleep(60.0)
"""
    program = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    assert program.stdout is not None
    assert program.stdout.readline() == "shown\n"
    program.kill()
    program.communicate()
    until(lambda: not read_recording(path).is_cut, 0.2)
    last = read_recording(path).events[-1]
    assert (last["event"], last["reason"]) == ("stop", "program that was killed")


def test_a_loop_ends_with_the_program_that_was_killed_while_the_loop_started() -> None:
    script = """
import os
from hapticbridge.cli.main import main
from hapticbridge.run.endpoint import Endpoint
parents, own = [4242], Endpoint.open
os.getppid = lambda: parents[-1]
Endpoint.open = lambda *arguments: (parents.append(1), own(*arguments))[1]
main(["serve", "simulated", "--json"])
"""
    told = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=True
    )
    assert "program that was killed" in told.stdout


def test_a_loop_ends_whose_program_was_killed_before_it_looked() -> None:
    """A process that another one has taken over does not see that its parent has gone."""
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    told = subprocess.run(
        [sys.executable, "-m", "hapticbridge", "serve", "simulated", "--json", "--port", "0"],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,  # it may end before its first tick
        env={**os.environ, PROGRAM_VARIABLE: str(gone.pid)},
    )
    assert "program that was killed" in told.stdout


def test_the_recording_tells_how_the_program_left(tmp_path: Path) -> None:
    for error, reason in ((None, "program"), (KeyError("its own"), "program that failed")):
        path = tmp_path / "run.mcap"
        with suppress(KeyError), DeviceLoop("simulated", recording=path) as device:
            device.show(START)
            if error is not None:
                raise error
        assert read_recording(path).events[-1]["reason"] == reason


def test_a_loop_is_opened_once() -> None:
    device = DeviceLoop("simulated", is_simulated=True).open()
    for _ in range(2):
        with pytest.raises(HapticBridgeError, match="opened once; make another one"):
            device.open()
        device.close()


def test_simulated_time_goes_on_while_another_thread_shows_without_end() -> None:
    with DeviceLoop("simulated", is_simulated=True) as device:
        device.show(START)
        is_over = threading.Event()

        def shows() -> None:
            while not is_over.is_set():
                device.show(START)
                device.pose()

        thread = threading.Thread(target=shows)
        thread.start()
        try:
            for _ in range(20):
                device.advance(0.01)
        finally:
            is_over.set()
            thread.join()


def test_a_tool_that_was_surely_put_elsewhere_is_doubted_once() -> None:
    with DeviceLoop("simulated", is_simulated=True) as device:
        device.show(START)
        device.show(START + np.eye(7)[0] * 0.1)
        device.show(-START, is_placed=True)
        with pytest.warns(UserWarning, match=r"0\.447 m from the pose before: .*is_placed=True"):
            device.show(START)
        device.show(-START)
    with (
        DeviceLoop("simulated", is_simulated=True) as device,
        pytest.warns(UserWarning, match=r"at \[0\.0, 0\.0, 100\.0\] m: positions are in m$"),
    ):
        device.show([0.0, 0.0, 100.0])
    assert device.credit == pytest.approx(0.05)


@pytest.mark.parametrize(("rate", "is_told"), [(50.0, False), (500.0, True)])
def test_another_rate_than_the_stated_one_is_told(
    rate: float, is_told: bool, capfd: pytest.CaptureFixture[str]
) -> None:
    with DeviceLoop("simulated", is_simulated=True, scene_rate=rate) as device:
        followed(device, 2.5)
    assert ("shows its tool 50" in capfd.readouterr().err) == is_told


# Frames


def test_rotations_are_those_of_mujoco() -> None:
    rng = np.random.default_rng(1)
    for _ in range(50):
        first, second = rng.standard_normal((2, 4))
        first, second = first / np.linalg.norm(first), second / np.linalg.norm(second)
        matrix, body, world, back = np.zeros(9), np.zeros(3), np.zeros(3), np.zeros(4)
        mujoco.mju_quat2Mat(matrix, first)
        assert poses.matrix_of(first) == pytest.approx(matrix.reshape(3, 3))
        again = poses.quaternion_of(matrix.reshape(3, 3))
        assert again == pytest.approx(first if first[0] >= 0 else -first)
        mujoco.mju_subQuat(body, second, first)
        mujoco.mju_rotVecQuat(world, body, first)
        assert poses.turn_between(first, second) == pytest.approx(world, abs=1e-9)
        mujoco.mju_negQuat(back, first)
    pose = np.eye(4)
    pose[:3, 3] = 1.0, 2.0, 3.0
    assert poses.pose_of(pose, np.zeros(4)).tolist() == [1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0]


# A network between


def test_a_datagram_without_the_token_or_of_another_kind_is_dropped() -> None:
    call = np.zeros(1, CALL_DTYPE)
    call["version"], call["call"] = VERSION, Call.SHOW
    data = packed(call, b"right")
    assert unpacked(data, CALL_DTYPE, b"right") == call[0]
    assert unpacked(data, CALL_DTYPE, b"wrong") is None
    assert unpacked(data, STATE_DTYPE, b"right") is None
    for damaged in (b"", data[:-1], data + b"\0", bytes([data[0] ^ 1]) + data[1:]):
        assert unpacked(damaged, CALL_DTYPE, b"right") is None
    call["version"] = VERSION + 1
    assert unpacked(packed(call, b"right"), CALL_DTYPE, b"right") is None


@contextmanager
def endpoint_of(device: Any, news: list[object] | None = None) -> Iterator[str]:
    """Runs a loop in simulated time in this process, and yields its remote name.

    ``news`` gets True for each program that takes the loop over and False for any other one, and
    the reason of each that leaves.
    """
    news = [] if news is None else news
    clock = GrantedClock()
    options = program_options(BridgeOptions())
    with Bridge(posted_scene(0.05), device, None, options, clock=clock) as bridge:
        endpoint = Endpoint("127.0.0.1", 0, TOKEN.encode(), news.append, news.append)
        endpoint.open(bridge)
        run = threading.Thread(target=bridge.run)
        run.start()
        try:
            yield f"remote:127.0.0.1:{endpoint.address[1]}"
        finally:
            bridge.stop("test")
            run.join()
            endpoint.close()


def test_a_program_that_starts_anew_has_the_loop_and_the_other_is_told() -> None:
    news: list[object] = []
    with (
        endpoint_of("simulated", news) as name,
        DeviceLoop(name, token=TOKEN) as first,
        DeviceLoop(name, token=TOKEN) as second,
    ):
        first.show(START)
        end = time.monotonic() + 10.0
        with pytest.raises(DeviceLost, match="another program has taken over"):
            while time.monotonic() < end:
                first.show(START)
        second.show(START)
        second.advance(0.1)
        with DeviceLoop(name, token=TOKEN) as last:
            last.show([0.3, 0.0, 0.0])
            last.advance(0.01)
            assert last.pose().position == pytest.approx([0.3, 0.0, 0.0], abs=1e-3)
            first.close()  # a farewell of a program without the loop ends nothing
            last.advance(0.01)
        until(lambda: len(news) >= 4)
        assert news == [False, True, True, "program"]


def test_a_grip_axis_is_read_and_gets_no_force() -> None:
    fingers = Fingers(speed=0.01)
    with endpoint_of(fingers) as name, DeviceLoop(name, token=TOKEN) as device:
        device.show(START)
        device.advance(0.2)
        assert device.pose().grip == pytest.approx(0.002, abs=1e-4)
    assert {each.shape for each in fingers.sent} == {(6,)}
    with DeviceLoop("simulated", is_simulated=True) as device:
        device.show(START)
        device.advance(0.5)
        handle = device.pose()
        assert np.isnan(handle.grip)
        assert (handle.is_held, handle.buttons) == (False, 0)  # the force is off: no pose for long


def test_a_flood_of_places_pushes_no_command_of_a_user_out() -> None:
    options = program_options(BridgeOptions())
    with Bridge(posted_scene(0.05), "simulated", None, options, clock=SimulatedClock()) as bridge:
        waiting = bridge.session.commands.waiting
        bridge.command(Switch(force=False))
        endpoint = Endpoint("127.0.0.1", 0, TOKEN.encode())
        endpoint.open(bridge)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as program:
            program.settimeout(10.0)
            program.connect(endpoint.address)
            call = np.zeros(1, CALL_DTYPE)
            call["version"], call["call"], call["post"]["pose"] = VERSION, Call.SHOW, START
            call["place"] = START
            for sequence in range(1, 31):
                call["sequence"] = call["placed"] = sequence
                program.send(packed(call, TOKEN.encode()))
            end = time.monotonic() + 10.0
            while len(waiting) < MAX_WAITING and time.monotonic() < end:
                program.recv(4096)
        endpoint.close()
        assert len(waiting) == MAX_WAITING
        assert waiting[0][0] == Switch(force=False)
        assert all(isinstance(command, Repeat) for command, _ in list(waiting)[1:])


class Network:
    """Network between a program and a loop, which delays, loses and reorders datagrams."""

    def __init__(self, port: int) -> None:
        self.delay = self.jitter = self.loss = 0.0
        self.is_cut = False
        self._near = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._near.bind(("127.0.0.1", 0))
        self._far = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._far.connect(("127.0.0.1", port))
        self._peer: Any = None
        self.port = int(self._near.getsockname()[1])
        for work in (self._there, self._back):
            threading.Thread(target=work, daemon=True).start()

    def _pass(self, send: Any) -> None:
        if self.is_cut or random.random() < self.loss:
            return
        wait = self.delay + self.jitter * random.random()
        threading.Timer(wait, send).start() if wait else send()

    def _there(self) -> None:
        while True:
            data, self._peer = self._near.recvfrom(4096)
            self._pass(lambda data=data: self._far.send(data))

    def _back(self) -> None:
        while True:
            data = self._far.recv(4096)
            self._pass(lambda data=data: self._near.sendto(data, self._peer))


@contextmanager
def served(path: Path, *options: str) -> Iterator[int]:
    """Runs ``hapticbridge serve`` and yields its port."""
    command = [sys.executable, "-m", "hapticbridge", "serve", "simulated", "--port", "0"]
    process = subprocess.Popen(
        [*command, "--record", str(path), *options],
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "HAPTICBRIDGE_TOKEN": TOKEN},
    )
    assert process.stderr is not None
    for line in process.stderr:
        if found := re.search(r"remote:127\.0\.0\.1:(\d+)", line):
            break
    else:
        raise AssertionError("no address was printed")
    try:
        yield int(found[1])
    finally:
        process.send_signal(signal.SIGINT)
        out, _ = process.communicate(timeout=60.0)
        assert "another program stepped the scene" in out


def test_a_late_and_lossy_network_moves_nothing_but_the_time(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with served(path) as port:
        network = Network(port)
        with DeviceLoop(f"remote:127.0.0.1:{network.port}", token=TOKEN) as device:
            pose = START.copy()
            device.show(pose)
            with pytest.raises(HapticBridgeError, match="real time goes on by itself"):
                device.advance(0.1)
            for delay, jitter, loss in ((0.0, 0.0, 0.0), (0.02, 0.05, 0.2), (0.2, 0.0, 0.1)):
                network.delay, network.jitter, network.loss = delay, jitter, loss
                for _ in range(40):
                    pose[:3] += 0.3 * (device.pose().position - pose[:3])
                    device.show(pose)
                    time.sleep(0.02)
            assert device.pose().is_held
            network.is_cut = True
            time.sleep(2.5)
            with pytest.raises(DeviceLost, match="was not heard"):
                device.pose()
    ticks = read_recording(path).ticks
    assert ticks["lever"].max() == 1.0
    assert ticks["lever"][-1] == 0.0  # the cable was pulled
    assert np.all(ticks["wrench_on_device"][-1000:] == 0.0)
    assert 60 < ticks["scene_step"][-1] <= 122
    report = audit(path)
    assert (report.verdict, report.agreement) == ("passive", "bit for bit")


def test_simulated_time_that_no_program_moves_ends_with_ctrl_c(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with served(path, "--fast") as port:  # which interrupts it at the end
        for _ in range(2):
            with DeviceLoop(f"remote:127.0.0.1:{port}", token=TOKEN) as device:
                device.show(START)
                device.advance(0.1)
    ticks = read_recording(path).ticks
    assert 200 <= len(ticks) <= 201
    assert audit(path).verdict == "passive"


def test_a_wrong_token_is_told_at_once(tmp_path: Path) -> None:
    with (
        served(tmp_path / "run.mcap") as port,
        pytest.raises(HapticBridgeError, match="has another token or another version"),
        DeviceLoop(f"remote:127.0.0.1:{port}", token="another"),
    ):
        pass
