"""Interfaces to other programs: what they need, and what they do without the programs."""

from __future__ import annotations

import importlib
import json
import struct
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from types import ModuleType, SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from test_device_loop import TOKEN, endpoint_of
from test_grip_axis import Fingers
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from hapticbridge.errors import HapticBridgeError
from hapticbridge.program.device_loop import DeviceLoop, Handle
from hapticbridge.program.poses import (
    matrix_of,
    offset_between,
    quaternion_about,
    turn_between,
)
from hapticbridge.program.ros_topics import WRENCH_ON_TOOL, RosTopics
from hapticbridge.recording.ros_messages import LOG, TOPICS

ALONE = """
import importlib, sys
allowed = {"numpy", "hapticbridge", *sys.stdlib_module_names}

class Refusal:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] not in allowed:
            raise ImportError(f"{name} is not there")

sys.meta_path.insert(0, Refusal())
importlib.import_module(sys.argv[1])
import hapticbridge
assert hapticbridge.DeviceLoop.__module__ == "hapticbridge.program.device_loop"
"""


@pytest.mark.parametrize(
    ("module", "code"),
    [
        ("hapticbridge.program.device_loop", 0),
        ("hapticbridge.recording.ros_messages", 0),
        ("hapticbridge.run.endpoint", 1),
    ],
)
def test_the_programs_side_needs_numpy_alone(module: str, code: int) -> None:
    done = subprocess.run(
        [sys.executable, "-c", ALONE, module], capture_output=True, text=True, check=False
    )
    assert done.returncode == code, done.stderr
    assert ("is not there" in done.stderr) == bool(code)


def test_a_quaternion_about_a_vector_turns_by_it() -> None:
    rng, upright = np.random.default_rng(0), np.array([1.0, 0.0, 0.0, 0.0])
    for size in (0.0, 1e-9, 0.3, 3.0):
        vector = rng.standard_normal(3)
        vector *= size / np.linalg.norm(vector)
        assert turn_between(upright, quaternion_about(vector)) == pytest.approx(vector, abs=1e-12)
        expected = np.zeros(4)
        mujoco.mju_axisAngle2Quat(expected, vector / max(size, 1e-300), size)
        assert quaternion_about(vector) == pytest.approx(expected, abs=1e-12)


def test_an_offset_leads_from_one_pose_to_another() -> None:
    rng = np.random.default_rng(1)
    first, second = rng.standard_normal((2, 7))
    for pose in (first, second):
        pose[3:] /= np.linalg.norm(pose[3:])
    offset, reached = offset_between(first, second), np.zeros(4)
    mujoco.mju_mulQuat(reached, quaternion_about(offset[3:]), first[3:])
    assert first[:3] + offset[:3] == pytest.approx(second[:3])
    assert abs(reached @ second[3:]) == pytest.approx(1.0)


# Gymnasium: the wrapper stands on a base class of five lines, and on MuJoCo

SCENE = """<mujoco><worldbody>
  <body name="mass"><joint type="slide" axis="1 0 0" damping="2"/><joint type="slide" axis="0 1 0"/>
    <geom size=".02" mass=".1"/><site name="tip" pos="0 0 .1" euler="0 0 90"/></body>
</worldbody></mujoco>"""


class Space:
    low, high, dtype = np.full(2, -1.0), np.full(2, 1.0), np.dtype(np.float32)


class Environment:
    """A mass that steps by its action, within 0.01 m."""

    action_space = Space()

    def __init__(self) -> None:
        self.model = mujoco.MjModel.from_xml_string(SCENE)
        self.data = mujoco.MjData(self.model)
        self.unwrapped = self

    def reset(self) -> tuple[None, dict[str, Any]]:
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = 0.5, 0.0
        mujoco.mj_forward(self.model, self.data)
        return None, {}

    def step(self, action: Any) -> tuple[None, float, bool, bool, dict[str, Any]]:
        self.data.qvel[:] = 0.01 * np.asarray(action, dtype=np.float64) / 0.02
        self.data.qpos[:] += 0.02 * self.data.qvel
        mujoco.mj_forward(self.model, self.data)
        return None, 0.0, False, False, {}


class Wrapper:
    def __init__(self, env: Any) -> None:
        self.env, self.unwrapped, self.action_space = env, env.unwrapped, env.action_space


@pytest.fixture
def wrapper(monkeypatch: pytest.MonkeyPatch) -> Any:
    package = ModuleType("gymnasium")
    package.Wrapper = Wrapper  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "gymnasium", package)
    monkeypatch.delitem(sys.modules, "hapticbridge.program.gymnasium", raising=False)
    from hapticbridge.program.gymnasium import HapticWrapper

    yield HapticWrapper
    sys.modules.pop("hapticbridge.program.gymnasium")


def action(offset: np.ndarray, handle: Handle) -> np.ndarray:
    assert handle.position.shape == (3,)
    return np.asarray(offset[:2] / 0.01)


def test_a_hand_leads_the_site_of_an_environment(wrapper: Any) -> None:
    with DeviceLoop("simulated", is_simulated=True, scale=4.0) as loop:
        env = wrapper(Environment(), loop, "tip", action)
        for _ in range(2):
            env.reset()
            loop.advance(0.002)
            assert loop.pose().position == pytest.approx([0.5, 0.0, 0.1], abs=2e-3)
            gaps, path = [], []
            for _ in range(50):
                chosen = env.hand_action()
                assert chosen.dtype == np.float32
                assert np.abs(chosen).max() <= 1.0
                env.step(chosen)
                loop.advance(0.02)
                path.append(loop.pose().position[:2])
                gaps.append(env.unwrapped.data.site("tip").xpos[:2] - path[-1])
            assert np.std(gaps) < 0.3 * np.std(path)
    assert loop.summary["verdict"] == "passive"


def test_an_environment_without_the_tool_or_without_mujoco_gets_a_sentence(wrapper: Any) -> None:
    loop = DeviceLoop("simulated")
    wrapper(Environment(), loop, "mass", action)
    with pytest.raises(HapticBridgeError, match="no site and no body 'hand'; its sites are: tip"):
        wrapper(Environment(), loop, "hand", action)
    bare = Environment()
    del bare.model
    with pytest.raises(HapticBridgeError, match="no MuJoCo scene in Environment"):
        wrapper(bare, loop, "tip", action)


# LeRobot and robosuite: their base classes in a few lines, and a device whose buttons are held


def modules(monkeypatch: pytest.MonkeyPatch, own: str, **names: Any) -> Any:
    """Puts modules into the place of a package, and imports our interface to it anew."""
    monkeypatch.delitem(sys.modules, own, raising=False)
    for name, classes in names.items():
        module = ModuleType(name.replace("__", "."))
        vars(module).update(classes)
        monkeypatch.setitem(sys.modules, module.__name__, module)
    interface = importlib.import_module(own)
    monkeypatch.delitem(sys.modules, own)
    return interface


@dataclass(kw_only=True)
class Config:
    id: str | None = None


class Teleoperator:
    def __init__(self, config: Config) -> None:
        self.id = config.id


@pytest.fixture
def lerobot(monkeypatch: pytest.MonkeyPatch) -> Any:
    errors = {name: type(name, (ConnectionError,), {}) for name in CONNECTION_ERRORS}
    return modules(
        monkeypatch,
        "hapticbridge.program.lerobot",
        lerobot__teleoperators__config={"TeleoperatorConfig": Config},
        lerobot__teleoperators__teleoperator={"Teleoperator": Teleoperator},
        lerobot__utils__errors=errors,
    )


CONNECTION_ERRORS = "DeviceAlreadyConnectedError", "DeviceNotConnectedError"
AT = {"ee.x": 0.3, "ee.y": 0.0, "ee.z": 0.2, "ee.wx": 0.0, "ee.wy": 0.0, "ee.wz": 0.5}


def test_a_teleoperator_leads_the_robot_from_where_it_is(
    lerobot: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HAPTICBRIDGE_TOKEN", TOKEN)
    fingers = Fingers()
    with endpoint_of(fingers) as name:
        device = lerobot.HapticDevice(lerobot.HapticDeviceConfig(device=name))
        with pytest.raises(ConnectionError):
            device.get_action()
        device.connect()
        with pytest.raises(ConnectionError):
            device.connect()
        with pytest.raises(HapticBridgeError, match="send feedback before the first action"):
            device.get_action()
        with pytest.raises(HapticBridgeError, match=r"the feedback has no ee\.wy, ee\.wz"):
            device.send_feedback({name: AT[name] for name in list(AT)[:4]})
        assert set(device.feedback_features) == set(AT)
        for buttons, opening in ((0, 100.0), (lerobot.CLOSE, 0.0)):
            fingers.buttons = buttons
            device.send_feedback(AT | {"other": 1.0})
            device.loop.advance(0.02)
            action = device.get_action()
            assert set(action) == set(device.action_features)
            assert action.pop("ee.gripper_pos") == opening
            assert action == pytest.approx(AT, abs=1e-3)
        device.disconnect()
        assert not device.is_connected


def test_a_teleoperator_without_feedback_starts_where_it_is_told(lerobot: Any) -> None:
    with pytest.raises(HapticBridgeError, match="start has 3 numbers"):
        lerobot.HapticDeviceConfig(start=[0.0, 0.0, 0.0])
    start = [*AT.values()]
    device = lerobot.HapticDevice(lerobot.HapticDeviceConfig(is_simulated=True, start=start))
    device.connect()
    device.loop.advance(0.02)
    action = device.get_action()
    device.disconnect()
    assert [action[name] for name in AT] == pytest.approx(start, abs=1e-3)


class Controller:
    """An OSC controller at rest, 0.1 m along x and turned by half a radian about z."""

    name, input_ref_frame, use_ori = "OSC_POSE", "base", True
    kp, kd, output_max = np.full(6, 150.0), np.full(6, 24.0), np.full(6, 0.05)
    ref_pos, ref_pos_vel, ref_ori_vel = np.array([0.1, 0.0, 0.0]), np.zeros(3), np.zeros(3)
    origin_pos, origin_ori = np.zeros(3), np.eye(3)
    ref_ori_mat = matrix_of(quaternion_about(np.array([0.0, 0.0, 0.5])))

    def update(self, *, force: bool) -> None:
        assert force

    def compute_goal_pos(self, delta: np.ndarray) -> Any:
        return self.ref_pos + delta - np.array([0.01, 0.0, 0.0])  # it counts from another place

    def compute_goal_ori(self, delta: np.ndarray) -> Any:
        assert not delta.any()
        return self.ref_ori_mat


class RobosuiteDevice:
    active_robot, active_arm, base_mode = 0, "right", False

    def __init__(self, env: Any) -> None:
        self.env = env

    def _reset_internal_state(self) -> None:
        pass


def test_an_arm_is_led_to_the_handle_and_its_gripper_closed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    robosuite = modules(
        monkeypatch,
        "hapticbridge.program.robosuite",
        robosuite__controllers__parts__arm__osc={"OperationalSpaceController": Controller},
        robosuite__devices={"Device": RobosuiteDevice},
    )
    controller = Controller()
    env = SimpleNamespace(robots=[SimpleNamespace(part_controllers={"right": controller})])
    fingers = Fingers()
    with endpoint_of(fingers) as name, DeviceLoop(name, token=TOKEN) as loop:
        device = robosuite.HapticDevice(env, loop)
        device.start_control()
        for buttons in (0, robosuite.GRASP, robosuite.RESET):
            fingers.buttons = buttons
            loop.advance(0.02)
            state = device.get_controller_state()
            assert state["dpos"] == pytest.approx([0.01, 0.0, 0.0], abs=1e-4)
            assert state["raw_drotation"] == pytest.approx(np.zeros(3), abs=1e-4)
            assert state["rotation"] == pytest.approx(controller.ref_ori_mat, abs=1e-4)
            assert state["grasp"] == (buttons == robosuite.GRASP)
            assert state["reset"] == (buttons == robosuite.RESET)
        controller.name, controller.use_ori = "OSC_POSITION", False
        with pytest.raises(HapticBridgeError, match="arm 'right' is OSC_POSITION; a haptic device"):
            device.get_controller_state()


# Topics of ROS 2: a viewer's side of the WebSocket, and decoders that are not ours


def messages_of(port: int, update: Any, seconds: float = 10.0) -> dict[str, Any]:
    """Subscribes to all topics as a viewer does, and returns the first message of each."""
    with connect(f"ws://127.0.0.1:{port}", subprotocols=[Subprotocol("foxglove.sdk.v1")]) as link:
        channels: list[dict[str, Any]] = []
        while len(channels) < 5:
            told = json.loads(link.recv(10.0))
            channels += told.get("channels", [])
        wanted = [{"id": k, "channelId": channel["id"]} for k, channel in enumerate(channels)]
        link.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
        found: dict[str, Any] = {}
        end = time.monotonic() + seconds
        while len(found) < 5 and time.monotonic() < end:
            update()
            with suppress(TimeoutError):
                data = link.recv(0.02)
                assert isinstance(data, bytes)
                kind, number, _ = struct.unpack_from("<BIQ", data)
                channel = channels[number]
                assert kind == 1
                schema = Schema(
                    id=1,
                    name=channel["schemaName"],
                    encoding=channel["schemaEncoding"],
                    data=channel["schema"].encode(),
                )
                decode = DecoderFactory().decoder_for(channel["encoding"], schema)
                assert decode is not None
                found.setdefault(channel["topic"], decode(data[13:]))
        return found


def test_a_viewer_reads_the_topics_of_a_loop() -> None:
    half = np.sqrt(0.5)
    tool = np.array([0.1, 0.2, 0.3, half, 0.0, 0.0, half])
    with DeviceLoop("simulated", is_simulated=True) as loop:
        for _ in range(25):
            loop.wrench(tool)
            loop.advance(0.02)
        wrench = loop.wrench(tool)
        assert np.abs(wrench[:3]).max() > 1e-3
        with RosTopics(loop, port=0) as topics:
            found = messages_of(topics.port, lambda: topics.update(tool, wrench))
            with pytest.raises(HapticBridgeError, match=f"port {topics.port} of '127.0.0.1'"):
                RosTopics(loop, port=topics.port)
        handle = loop.pose()
    assert set(found) == set(TOPICS) - {LOG}
    pose = found["/handle_pose"].pose.position
    assert [pose.x, pose.y, pose.z] == pytest.approx(handle.position)
    assert found["/tool_pose"].header.frame_id == "world"
    assert [frame.child_frame_id for frame in found["/tf"].transforms] == ["handle", "tool"]
    force = found["/wrench_on_tool"].wrench.force  # the tool stands a quarter turn about z
    assert [force.x, force.y, force.z] == pytest.approx([wrench[1], -wrench[0], wrench[2]])
    hand = found["/wrench_on_hand"].wrench.force
    length = np.linalg.norm([hand.x, hand.y, hand.z])
    assert length == pytest.approx(np.linalg.norm(handle.wrench[:3]))


def test_a_wrench_that_a_program_does_not_tell_is_not_published() -> None:
    with DeviceLoop("simulated", is_simulated=True) as loop:
        loop.show([0.0, 0.0, 0.0])
        with RosTopics(loop, port=0) as topics:
            found = messages_of(topics.port, lambda: topics.update([0.0, 0.0, 0.0]), seconds=1.0)
            with pytest.raises(HapticBridgeError, match="pose has shape"):
                topics.update([0.0])
    assert set(found) == set(TOPICS) - {LOG, WRENCH_ON_TOOL}
