"""The Force Dimension driver against a stand-in for the maker's library, in virtual time."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from device_benches import PERIOD, ticks
from emulated.dhd_stub import CALL, OMEGA3, OMEGA6, OMEGA7, SIGMA7, Stub
from emulated.hid_seam import DrivingClock

import hapticbridge as hb
from hapticbridge.device import force_dimension as forcedimension
from hapticbridge.device import open_device
from hapticbridge.device.base import checked_rotation
from hapticbridge.device.driver import FoundDevice
from hapticbridge.device.force_dimension import FILES, MODELS, ForceDimensionDevice
from hapticbridge.device.transport import usb as usb_search
from hapticbridge.errors import DeviceError, DeviceLost
from hapticbridge.kernel.pose import quaternion_log
from hapticbridge.kernel.record import SAMPLE_DTYPE, TickFlag

WRENCH = np.array([1.0, -0.5, 0.3, 0.01, -0.02, 0.005])


def started(kind: int = OMEGA3, **options: object) -> tuple[Stub, ForceDimensionDevice]:
    stub = Stub(kind)
    device = stub.opened(**options)
    device.start(PERIOD)
    return stub, device


def test_an_omega_has_three_axes_and_obeys_forces_on_them() -> None:
    _, device = started(OMEGA6)  # a wrist without motors is left out
    assert (device.info.name, device.info.axes) == ("omega.6", ("x", "y", "z"))
    stub, device = started()
    assert (device.info.name, device.info.axes) == ("omega.3", ("x", "y", "z"))
    assert device.info.serial == "4711"
    assert ticks(device, stub, 20, WRENCH) == [0] * 20
    np.testing.assert_allclose(stub.force(), [1.0, -0.5, 0.3, 0, 0, 0])
    stub.call("buttons", 0b101)
    sample = np.zeros(1, SAMPLE_DTYPE)
    device.read(sample)
    assert sample["buttons"][0] == 0b101
    device.close()
    assert not stub.command().any()
    assert (stub.call("enabled"), stub.call("closed")) == (0, 1)


def test_a_sigma_turns_and_its_orientation_is_that_of_the_matrix() -> None:
    stub, device = started(SIGMA7)
    assert device.info.axes == ("x", "y", "z", "rx", "ry", "rz")
    begin = stub.now + PERIOD + CALL
    ticks(device, stub, 100, np.array([0, 0, 0, 0, 0.01, 0]))
    np.testing.assert_allclose(stub.force(), [0, 0, 0, 0, 0.01, 0])
    sample = np.zeros(1, SAMPLE_DTYPE)
    device.read(sample)
    w, x, y, z = sample["quaternion"][0].tolist()
    turned = quaternion_log((w, x, y, z))
    # J w' = t - c w from rest: the angle after t s
    inertia, damping, now = 2e-4, 4e-3, stub.now - begin
    rate = damping / inertia
    expected = 0.01 / damping * (now - (1 - math.exp(-rate * now)) / rate)
    assert turned[1] == pytest.approx(expected, rel=0.01)
    assert (turned[0], turned[2]) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("kind", "told", "asked", "limits"),
    [
        (OMEGA3, (-1.0, -1.0), None, (12.0, 0.5)),
        (OMEGA3, (9.0, -1.0), None, (9.0, 0.5)),
        (OMEGA3, (9.0, -1.0), 5.0, (5.0, 0.5)),
        (OMEGA3, (9.0, -1.0), 20.0, (9.0, 0.5)),
        (SIGMA7, (-1.0, -1.0), None, (12.0, 0.4)),
        (SIGMA7, (15.0, 0.3), None, (12.0, 0.3)),
        (206, (8.0, -1.0), None, (8.0, 0.5)),
        (7, (8.0, -1.0), None, (8.0, 0.5)),
    ],
)
def test_the_lower_of_known_limits_holds(kind: int, told: Any, asked: Any, limits: Any) -> None:
    stub = Stub(kind)
    stub.call("limits", *told)
    info = stub.opened(numbers={} if asked is None else {"force_limit": asked}).info
    assert (info.force_limit, info.torque_limit) == limits


def test_a_limit_that_nobody_knows_must_be_named() -> None:
    for kind, words in (
        (206, r"largest force of sigma\.3 is unknown; set it with force_lim"),
        (108, r"largest torque of lambda\.7 is unknown; set it with torq"),
    ):
        stub = Stub(kind)
        with pytest.raises(DeviceError, match=words):
            stub.opened()
        assert stub.call("closed") == 1
    assert Stub(206).opened(numbers={"force_limit": 3.0}).info.force_limit == 3.0
    turning = {kind for kind, model in MODELS.items() if model.turns}
    assert turning <= {104, 105, 108, 109}


def test_a_device_that_waits_for_its_calibration_is_refused_with_what_to_do() -> None:
    stub = Stub(SIGMA7)
    stub.call("uncalibrate", 1)
    words = r"sigma\.7 is not calibrated since its power-on: put its end effector to the rest"
    with pytest.raises(DeviceError, match=words):
        stub.opened()
    assert (stub.call("closed"), stub.call("enabled")) == (1, 0)
    stub.call("uncalibrate", 0)
    assert stub.opened().info.name == "sigma.7"


def test_what_was_set_is_said_and_gravity_is_the_users_choice() -> None:
    said: list[str] = []
    stub = Stub()
    device = stub.opened(notify=said.append)
    assert said == ["omega.3: limits 12 N; gravity compensation on, end effector 0.19 kg"]
    assert stub.call("gravity") == 1
    assert device.effector_mass == 0.19
    # what the compensation carries is not the inertia that is felt
    assert device.info.mass is None
    device.close()
    stub.opened(gravity=False, notify=said.append).close()
    assert stub.call("gravity") == 0
    assert "gravity compensation off" in said[1]


def test_rate_and_delay_are_those_of_the_calls() -> None:
    info = Stub().opened().info
    assert info.rate == pytest.approx(1 / (2 * CALL), rel=0.01)
    assert info.delay == pytest.approx(2 * CALL, rel=0.01)


@pytest.mark.parametrize(("period", "steps"), [(1e-3, 160), (2.5e-3, 200), (5e-3, 255)])
def test_watchdog_is_set_and_ends_force_of_loop_that_hangs(period: float, steps: int) -> None:
    stub = Stub()
    device = stub.opened()
    device.start(period)
    assert stub.call("watchdog_steps") == steps
    device.write(WRENCH)
    stub.advance(stub.now + 125e-6 * steps - 2 * CALL)
    assert stub.force().any()
    stub.advance(stub.now + 4 * CALL)
    assert not stub.force().any()


def test_a_loop_slower_than_the_watchdog_bears_is_refused() -> None:
    device = Stub().opened()
    with pytest.raises(DeviceError, match="the rate must be at least 63 Hz, not 50 Hz"):
        device.start(0.02)
    device.start(0.0155)


def test_a_device_without_a_watchdog_says_so_and_runs() -> None:
    said: list[str] = []
    stub = Stub()
    stub.call("watchdog", 0)
    device = stub.opened(notify=said.append)
    device.start(PERIOD)
    assert "has no watchdog (feature not available)" in said[-1]
    assert ticks(device, stub, 3, WRENCH) == [0] * 3


def test_warnings_are_a_repeated_sample_and_a_counted_saturation() -> None:
    stub, device = started()
    ticks(device, stub, 5, WRENCH)
    stub.call("stale", 2)
    stale = int(TickFlag.STALE_SAMPLE)
    before = np.zeros(1, SAMPLE_DTYPE)
    device.read(before)
    again = np.full(1, -7, SAMPLE_DTYPE)
    assert device.read(again) == stale
    assert again.tobytes() == before.tobytes()
    assert ticks(device, stub, 3, WRENCH) == [0] * 3
    assert device.remark == ""
    ticks(device, stub, 4, np.array([30.0, 0, 0, 0, 0, 0]))
    assert device.remark == "the SDK has limited 4 forces"
    assert np.linalg.norm(stub.force()) == pytest.approx(12.0)


def test_no_fresh_sample_for_50_ms_is_a_lost_device_and_not_before() -> None:
    stub, device = started()
    ticks(device, stub, 5, WRENCH)
    stub.call("stale", 10_000)
    ticks(device, stub, 35, WRENCH)
    with pytest.raises(DeviceLost, match="no fresh sample for 50 ms"):
        ticks(device, stub, 20, WRENCH)


def test_an_error_is_a_lost_device_in_the_librarys_words() -> None:
    stub, device = started()
    stub.call("fail", 1)
    with pytest.raises(DeviceLost, match=r"omega\.3 is gone or failed: communication error"):
        device.read(np.zeros(1, SAMPLE_DTYPE))
    with pytest.raises(DeviceLost, match="communication error"):
        device.write(WRENCH)
    device.close()


@pytest.mark.parametrize("kind", [OMEGA3, SIGMA7])
@pytest.mark.parametrize("value", [math.nan, math.inf, 50.0])
def test_a_pose_that_is_none_is_not_reported(kind: int, value: float) -> None:
    stub, device = started(kind)
    stub.call("spoil", value)
    with pytest.raises(DeviceError, match="reports a"):
        device.read(np.zeros(1, SAMPLE_DTYPE))
    # and a mirror is no rotation
    with pytest.raises(DeviceError, match="it reports an orientation that is not a rotation"):
        checked_rotation([1, 0, 0, 0, 1, 0, 0, 0, -1], "it")


def test_what_the_library_does_not_know_comes_from_the_profile_of_its_model() -> None:
    """Shipped profiles are named by model, and once none was ever found."""
    told: list[str] = []
    for kind, resolution in ((OMEGA3, 1e-5), (SIGMA7, 1.5e-6), (203, None)):
        stub = Stub(kind)
        stub.call("limits", 15.0, 0.3)
        device = open_device(f"forcedimension:library={stub.file}", notify=told.append)
        device.close()
        assert device.info.resolution == resolution
        assert device.info.damping is None
    missing = [sentence for sentence in told if "no profile of" in sentence]
    (sentence,) = missing
    assert "no profile of 'lambda.3' exists; profiles: 'delta.3', 'lambda.7'" in sentence


def test_a_spec_names_the_library_the_device_and_its_numbers() -> None:
    stub = Stub()
    spec = f"forcedimension:library={stub.file}"
    device = open_device(f"{spec},gravity=0,damping=1.5,resolution=0")
    assert (device.info.damping, stub.call("gravity")) == (1.5, 0)
    device.close()
    open_device(f"{spec},serial=0").close()
    for count, option, words in (
        (2, "", r"2 devices .*choose one with serial=, one of '0', '1'"),
        (0, "", r"is plugged in \(looked for a device of Force Dimension"),
        (1, ",gravity=2", "gravity is 2"),
        (1, ",mass=0", "mass is 0"),
        (1, ",damping=-1", "d"),
    ):
        stub.call("count", count)
        with pytest.raises(DeviceError, match=words):
            open_device(spec + option)


def test_a_device_of_the_library_is_listed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(FILES.variable, Stub().file)
    (plugged,) = forcedimension.find()
    assert (plugged.path, plugged.problem) == ("0", None)


def test_without_library_device_is_listed_with_its_want(monkeypatch: pytest.MonkeyPatch) -> None:
    plugged = FoundDevice(
        driver="forcedimension", name="omega", serial="", path="/dev/bus/usb/001/002",
        vendor=0x1451, product=0x402, transport="usb", problem=None,
    )  # fmt: skip
    monkeypatch.setenv(FILES.variable, "/no/such.so")
    monkeypatch.setattr(usb_search, "find", lambda family: [plugged])
    (device,) = forcedimension.find()
    assert device.problem is not None
    assert device.problem.startswith("the library '/no/such.so' cannot be loaded")


# The gripper


@pytest.mark.parametrize(("kind", "axes"), [(OMEGA7, 3), (SIGMA7, 6)])
def test_a_gripper_is_the_grip_axis_and_is_pushed_apart(kind: int, axes: int) -> None:
    stub, device = started(kind, numbers={"grip_damping": 2.0, "grip_travel": 0.025})
    grip = device.info.grip_axis
    assert grip is not None
    assert (grip.axes, grip.force_limit, grip.reach, grip.damping) == (("x",), 8.0, 0.025, 2.0)
    assert len(device.info.axes) == axes
    stub.call("squeeze", 0.01)
    ticks(device, stub, 300, np.zeros(6))
    samples = np.zeros(2, SAMPLE_DTYPE)
    device.read(samples)
    assert samples["position"][1].tolist() == pytest.approx([-0.01, 0.0, 0.0], abs=1e-5)
    assert samples["quaternion"][1].tolist() == [1.0, 0.0, 0.0, 0.0]
    wrench = np.zeros((2, 6))
    wrench[0, :3], wrench[1, 0] = (1.0, 0.0, 0.0), -3.0  # against closing
    device.write(wrench)
    assert stub.number("grip_force") == 3.0
    assert stub.force()[0] == 1.0
    device.write(np.zeros(6))  # one wrench alone leaves the grip without force
    assert stub.number("grip_force") == 0.0
    device.write(wrench)
    stub.now += 0.1  # the loop hangs
    assert stub.number("grip_force") == 0.0
    device.write(wrench)
    device.close()
    assert stub.number("grip_force") == 0.0


def test_a_model_without_motor_at_its_gripper_has_no_grip_axis() -> None:
    stub = Stub(OMEGA7)
    stub.call("gripper", 0)
    assert stub.opened().info.grip_axis is None
    assert Stub(OMEGA3).opened().info.grip_axis is None


@pytest.mark.parametrize("gap", [-0.001, 11.0, math.nan])
def test_a_gap_that_is_none_is_not_reported(gap: float) -> None:
    stub, device = started(SIGMA7)
    stub.call("spoil_gap", gap)
    with pytest.raises(DeviceError, match="impossible gap of its gripper"):
        device.read(np.zeros(2, SAMPLE_DTYPE))


def test_fingers_close_the_pliers_through_the_library() -> None:
    """The hand squeezes the gripper of the stand-in, and feels the spring of the scene's hinge."""
    stub = Stub(SIGMA7)
    numbers = {"damping": 1.5, "rotational_damping": 4e-3, "grip_damping": 2.0}
    device = stub.opened(numbers=numbers | {"grip_travel": 0.025})
    grasp = hb.Grasp("grip", device, grip_axis=hb.GripAxis("hinge"))

    def squeeze(tick: int) -> None:
        if tick == 700:  # the force has risen
            stub.call("squeeze", 0.017)

    with hb.Bridge("pliers", [grasp], clock=DrivingClock(stub)) as bridge:
        bridge.run(2.0, on_tick=squeeze)
        angle = float(bridge.scene.data.joint("hinge").qpos[0])
        force = -bridge.latest_records(1)["wrench_on_device"][-1, 0]
    assert stub.number("grip_force") == 0.0
    assert angle > 0.05
    # 10 rad/m; the spring of the pliers, and what holds the jaws apart
    assert force == pytest.approx(10.0 * 0.4 * (angle + 0.15), rel=0.05)
