"""The hand that is dragged in the view: smoothing, limits, the wire, and the page itself."""

from __future__ import annotations

import json
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_cases import Called
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from view_cases import FLOOR

from hapticbridge.audit import audit
from hapticbridge.device.mouse import (
    REST,
    Drag,
    MouseDevice,
    Pose,
    drag_of_line,
    line_of_drag,
)
from hapticbridge.errors import DeviceError, HapticBridgeError
from hapticbridge.kernel.record import SAMPLE_DTYPE
from hapticbridge.recording import read_recording
from hapticbridge.run.bridge import Bridge

pytest.importorskip("viser", reason="needs the extra 'view'")

from page_client import hand
from waiting import PATIENCE, until

from hapticbridge.view.controls import device_pose
from hapticbridge.view.window import Address, Window

PERIOD = 1e-3


def moved(device: MouseDevice, ticks: int) -> np.ndarray:
    samples = np.zeros(ticks, SAMPLE_DTYPE)
    for k in range(ticks):
        assert device.read(samples[k : k + 1]) == 0
    return samples


def test_the_hand_goes_smoothly_where_it_is_dragged_and_no_faster_than_its_sheet() -> None:
    device = MouseDevice(speed=0.3)
    device.start(PERIOD)
    quarter = Rotation.from_rotvec([0.0, 0.0, np.pi / 2]).as_quat(scalar_first=True)
    device.aim((0.05, -0.02, 0.1, *quarter))
    samples = moved(device, 3000)
    assert not samples["position"][0].any()  # the first sample is the pose at the start
    np.testing.assert_allclose(samples["position"][-1], [0.05, -0.02, 0.1], atol=1e-9)
    np.testing.assert_allclose(samples["quaternion"][-1], quarter, atol=1e-9)
    velocity = np.diff(samples["position"], axis=0) / PERIOD
    speed = np.linalg.norm(velocity, axis=1)
    assert speed.max() == pytest.approx(0.3, rel=1e-9)
    assert device.info.speed_limit == 0.3
    assert np.abs(np.diff(speed)).max() < 0.1  # no step of the velocity at the drag
    device.aim(REST, 2)
    samples = moved(device, 3000)
    assert np.linalg.norm(samples["position"][-1]) < 1e-9
    assert np.all(samples["buttons"] == 2)


def test_a_speed_that_is_none_is_refused() -> None:
    with pytest.raises(DeviceError, match=r"speed is 0.0 m/s; it must be finite and > 0"):
        MouseDevice(speed=0.0)


coordinate = st.floats(-9.0, 9.0)


@given(st.tuples(coordinate, coordinate, coordinate), st.integers(0, 2**31))
def test_a_pose_survives_the_wire(position: tuple[float, float, float], seed: int) -> None:
    quaternion = Rotation.random(rng=np.random.default_rng(seed)).as_quat(scalar_first=True)
    pose: Any = (*position, *quaternion.tolist())
    for buttons in range(4):
        read: Any = drag_of_line(line_of_drag(Drag(pose, buttons)))
        np.testing.assert_allclose(read.pose, pose, rtol=1e-8, atol=1e-8)
        assert read.buttons == buttons
    for wrong in (-1, 4, "1", None, 1e300):
        line = json.dumps({"hand": pose, "buttons": wrong}).encode()
        assert drag_of_line(line) is None


@pytest.mark.parametrize(
    "values",
    [
        [0.0] * 7, [0, 0, 0, 1, 0, 0], [0, 0, 11, 1, 0, 0, 0], [0, 0, 0, 9, 0, 0, 0],
        [0, 0, 0, "1", 0, 0, 0], [0, 0, True, 1, 0, 0, 0], [10**400, 0, 0, 1, 0, 0, 0],
        [float("nan"), 0, 0, 1, 0, 0, 0], None, {"x": 1},
    ],
)  # fmt: skip
def test_a_line_that_is_no_pose_moves_nothing(values: object) -> None:
    assert drag_of_line(json.dumps({"hand": values, "buttons": 0}).encode()) is None


@pytest.mark.parametrize("line", [b"", b"[]", b"7", b"\xff", b'{"command": "stop"}', b"[" * 9999])
def test_another_line_is_no_pose(line: bytes) -> None:
    assert drag_of_line(line) is None


def test_the_command_shows_the_view_by_itself(
    call: Called, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(_: int | None) -> None:
        raise HapticBridgeError("the view")

    monkeypatch.setattr("hapticbridge.cli.run.open_window", refused)
    for options in ((), ("--port", "0")):
        code, _, err = call("run", "point_mass", "--device", "mouse", *options)
        assert (code, err) == (2, "error: the view\n")
    code, _, err = call("run", "point_mass", "--port", "0")
    assert (code, err) == (2, "error: --port without --view has no effect\n")


# The page


def test_the_arrows_are_where_the_handle_goes_in_any_frame_and_scale(tmp_path: Path) -> None:
    path = tmp_path / "floor.xml"
    path.write_text(FLOOR)
    with Bridge(str(path), MouseDevice()) as bridge:
        plain = bridge.session.parameters
    rng = np.random.default_rng(3)
    axes, first, start, turn = (Rotation.random(rng=rng) for _ in range(4))
    origin, wanted, begin = rng.normal(size=(3, 3))
    parameters = replace(
        plain,
        scale=2.5,
        force_scale=2.5,
        axes=tuple(axes.as_matrix().ravel()),
        device_origin=(*origin, *first.as_quat(canonical=True, scalar_first=True)),
        handle_origin=(*begin, *start.as_quat(canonical=True, scalar_first=True)),
    )
    pose = np.array(device_pose(parameters, wanted, turn.as_quat(scalar_first=True)))
    reached = begin + 2.5 * axes.apply(pose[:3] - origin)
    np.testing.assert_allclose(reached, wanted, atol=1e-12)
    device = Rotation.from_quat(pose[3:], scalar_first=True)
    handle = axes * device * first.inv() * axes.inv() * start
    assert (handle * turn.inv()).magnitude() < 1e-9


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_dragging_on_the_page_moves_the_tool_and_the_recording_is_passive(tmp_path: Path) -> None:
    scene, path = tmp_path / "floor.xml", tmp_path / "run.mcap"
    scene.write_text(FLOOR)
    device, window = MouseDevice(), Window(Address(0))
    poses: list[Pose] = []

    def aim(pose: Pose, buttons: int) -> None:
        poses.append(pose)
        device.aim(pose, buttons)

    window.on_hand = aim
    with Bridge(str(scene), device, recording=path, observer=window) as bridge:
        thread = threading.Thread(target=bridge.run, args=(2 * PATIENCE,))
        thread.start()
        try:
            with hand(window.url) as page:
                known, end = "", time.monotonic() + PATIENCE
                while "/hand" not in known:
                    assert time.monotonic() < end
                    known += " ".join(str(each.get("name")) for each in page.read(0.2))
                turned = {"wxyz": (1.0, 0.0, 0.0, 0.0), "name": "/hand", "owner": ""}
                for position in ((0.01,), "here", (float("nan"), 0.0, 0.0), (0.02, 0.0, 0.05)):
                    page.say(type="TransformControlsUpdateMessage", position=position, **turned)
                state = bridge.session.kernel.bound.state["pose"]
                until(lambda: abs(state["tool_position"][0][0] - 0.02) <= 1e-3)
                page.send("hold button 0", value=True)
                until(lambda: bridge.latest_records(1)["buttons"][0] == 1)
        finally:
            bridge.stop("test")
            thread.join(PATIENCE)
    # the ball starts at 0.03 m; what was no pose has moved nothing
    assert {tuple(np.round(pose, 6)) for pose in poses} == {(0.02, 0.0, 0.02, 1.0, 0.0, 0.0, 0.0)}
    ticks = read_recording(path).ticks
    assert ticks["device_position"][-1] == pytest.approx([0.02, 0.0, 0.02], abs=1e-3)
    assert audit(path).verdict == "passive"
