"""The Touch driver against a stand-in for OpenHaptics, in virtual time and in a real thread."""

from __future__ import annotations

import ctypes.util
import math
import sys
from typing import Any

import numpy as np
import pytest
from device_benches import PERIOD, read, ticks
from emulated.hd_stub import HdStub, Virtual

from hapticbridge.device import open_device
from hapticbridge.device.driver import FoundDevice, ignore_message
from hapticbridge.device.touch import device as touch
from hapticbridge.device.touch.device import RealWaiting, TouchDevice, open_touch
from hapticbridge.device.touch.servo import FILES, Hd, Servo
from hapticbridge.device.transport import usb as usb_search
from hapticbridge.errors import DeviceError, DeviceLost
from hapticbridge.kernel.record import SAMPLE_DTYPE, TickFlag

WRENCH = np.array([1.0, -0.5, 0.3, 0.01, -0.02, 0.005])

OK, NEEDS_UPDATE, NEEDS_HAND = 0x5000, 0x5001, 0x5002
RESET, AUTO, INKWELL = 1, 2, 4


def started(**options: object) -> tuple[HdStub, TouchDevice]:
    stub = HdStub()
    device = stub.opened(**options)
    device.start(PERIOD)
    return stub, device


def test_a_touch_senses_six_axes_and_obeys_forces_on_three() -> None:
    stub, device = started()
    info = device.info
    assert (info.name, info.serial, info.force_limit) == ("Touch", "S4711", 3.3)
    assert (info.axes, info.sensed) == (("x", "y", "z"), ("rx", "ry", "rz"))
    assert info.rate == pytest.approx(1000.0)
    assert info.delay == pytest.approx(2e-3)
    assert info.reach == pytest.approx(math.sqrt(3) * 0.2)
    assert (info.mass, info.damping, info.friction) == (None, None, None)
    assert ticks(device, stub, 20, WRENCH) == [0] * 20
    np.testing.assert_allclose(stub.force(), WRENCH[:3])
    stub.call("buttons", 0b10)
    _, sample = read(device, stub)
    assert sample["buttons"] == 0b10
    device.close()
    device.close()
    assert not stub.force().any()
    assert (stub.call("enabled"), stub.call("closed")) == (0, 1)


class Watched(Hd):
    """The library, with the names of its functions in the order in which they are called."""

    def __init__(self, stub: HdStub) -> None:
        super().__init__(stub.file)
        self.stub, self.names, self.force_at_disable = stub, [""], -1.0

    def __getitem__(self, name: str) -> Any:
        self.names.append(name)
        if name == "hdDisable":
            self.force_at_disable = float(np.abs(self.stub.force()).max())
        return super().__getitem__(name)


def test_motors_are_clamped_at_the_start_and_off_before_the_memory_goes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    at_exit: list[object] = []
    monkeypatch.setattr("atexit.register", at_exit.append)
    stub = HdStub()
    stub.hd = hd = Watched(stub)
    device = stub.opened()
    assert at_exit == [device.close]  # a program that ends without closing it stops the thread
    device.start(PERIOD)
    assert stub.call("enabled") == 0b11  # force output and its clamping
    ticks(device, stub, 20, WRENCH)
    assert stub.force().any()
    hd.names.clear()
    device.close()
    assert hd.force_at_disable == 0.0
    assert hd.names == ["hdDisable", "hdStopScheduler", "hdUnschedule", "hdDisableDevice"]


def test_position_and_orientation_are_those_of_the_library_in_axes_with_z_up() -> None:
    stub, device = started()
    stub.call("place", 0.01, 0.02, 0.03)  # right, up, towards the user
    # a turn by 0.3 rad about the library's y, which is up: about z here
    c, s = math.cos(0.3), math.sin(0.3)
    for i, value in enumerate([c, 0.0, s, 0.0, 1.0, 0.0, -s, 0.0, c]):
        stub.call("matrix", i, value)
    _, sample = read(device, stub, 2e-3)
    np.testing.assert_allclose(sample["position"], [0.01, -0.03, 0.02], atol=1e-12)
    np.testing.assert_allclose(
        sample["quaternion"], [math.cos(0.15), 0, 0, math.sin(0.15)], atol=1e-12
    )


def test_a_stylus_that_shall_not_turn_is_left_out() -> None:
    stub, device = started(turns=False)
    assert device.info.sensed == ()
    stub.call("matrix", 0, -1.0)
    stub.call("matrix", 4, -1.0)
    _, sample = read(device, stub, 2e-3)
    assert sample["quaternion"].tolist() == [1.0, 0.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("library", "asked", "limit"),
    [(3.3, None, 3.3), (3.3, 2.0, 2.0), (3.3, 9.0, 3.3), (-1.0, 2.5, 2.5), (-1.0, None, None)],
)
def test_the_lower_of_known_limits_holds(library: float, asked: Any, limit: Any) -> None:
    stub = HdStub()
    stub.call("limits", library, -1.0)
    numbers = {} if asked is None else {"force_limit": asked}
    if limit is None:
        with pytest.raises(DeviceError, match="the largest force of Touch is unknown to its libr"):
            stub.opened(numbers=numbers)
        assert stub.call("closed") == 1
        return
    device = stub.opened(numbers=numbers)
    device.start(PERIOD)
    assert device.info.force_limit == limit
    ticks(device, stub, 5, np.array([0.0, 30.0, 40.0, 0, 0, 0]))
    np.testing.assert_allclose(stub.force(), [0.0, 0.6 * limit, 0.8 * limit])
    device.close()


@pytest.mark.parametrize(("period", "full", "end"), [(1e-3, 5, 20), (4e-3, 10, 40)])
def test_a_force_that_is_not_renewed_fades_to_zero(period: float, full: int, end: int) -> None:
    stub = HdStub()
    device = stub.opened()
    device.start(period)
    device.write(WRENCH)
    shares = []
    for _ in range(end + 6):
        stub.advance(stub.now + 1e-3)
        shares.append(float(stub.force()[0]))
    age = np.arange(end + 6)
    np.testing.assert_allclose(shares, np.clip(1 - (age - full) / (end - full), 0, 1), atol=1e-12)
    assert device.faded == end + 5 - full
    device.write(WRENCH)  # and a loop that is back has its force again
    stub.advance(stub.now + 1e-3)
    assert stub.force()[0] == 1.0
    device.close()


def test_the_servo_thread_needs_neither_the_lock_nor_the_loop() -> None:
    """A loop that never lets go of Python's lock must not hold up the fading of its force."""
    stub = HdStub()
    stub.call("thread", 1)
    device = TouchDevice(stub.hd, waiting=RealWaiting())
    device.start(PERIOD)
    device.write(WRENCH)
    interval = sys.getswitchinterval()
    sys.setswitchinterval(100.0)  # no other thread of Python gets the lock
    try:
        before = stub.call("frames")
        hold_lock = ctypes.PyDLL(None).usleep  # a call of PyDLL keeps it
        hold_lock(200_000)
        after = ctypes.PyDLL(stub.file).stub_frames()
        force = device.servo.memory["force"][0].copy()
    finally:
        sys.setswitchinterval(interval)
    device.close()
    assert after - before > 40  # a callback in Python would have had none
    assert not force.any()
    assert device.faded > 0


def test_a_sample_is_of_one_servo_tick_while_the_servo_thread_goes_on() -> None:
    stub = HdStub()
    stub.call("thread", 1)
    device = TouchDevice(stub.hd, waiting=RealWaiting())
    device.start(PERIOD)
    seen = set()
    for _ in range(3000):
        device.write(np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]))  # it moves
        sample = device.servo.newest()
        assert (sample.position == sample.transform[12:15]).all()
        seen.add(sample.ticks)
    device.close()
    assert seen


def test_a_force_that_is_no_number_does_not_reach_the_motors_past_the_driver_either() -> None:
    stub, device = started()
    servo: Servo = device.servo
    servo.send((math.nan, 0.0, 1.0))  # past the driver's own check
    stub.advance(stub.now + 2e-3)
    assert stub.force().tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (0x0200, "its motors are too warm: let it cool down"),
        (0x0203, "it moved faster than its library allows"),
        (0x0302, "its library lost the connection: check its cable"),
        (0x0500, "Invalid priority"),
        (0x0999, "error 0x0999 of its library"),
    ],
)
def test_an_error_ends_the_force_at_once_and_the_run_with_its_cause(code: int, words: str) -> None:
    stub, device = started()
    ticks(device, stub, 5, WRENCH)
    assert stub.force().any()
    stub.call("error", code)
    stub.call("error", 0x0304)  # the queue is taken newest first; the first one seen counts
    stub.call("error", code)
    stub.advance(stub.now + 2e-3)
    assert not stub.force().any()
    with pytest.raises(DeviceLost, match=f"Touch has ended its force: {words}"):
        device.read(np.zeros(1, SAMPLE_DTYPE))
    device.start(PERIOD)  # which forgets it
    assert ticks(device, stub, 5, WRENCH) == [0] * 5
    device.close()


def test_a_servo_thread_that_stands_still_is_a_lost_device_and_not_before() -> None:
    stub, device = started()
    ticks(device, stub, 5, WRENCH)
    stub.call("freeze", 1)
    assert set(ticks(device, stub, 40, WRENCH)) == {int(TickFlag.STALE_SAMPLE)}
    with pytest.raises(DeviceLost, match="has given no sample for 50 ms"):
        ticks(device, stub, 20, WRENCH)
    device.close()
    stub = HdStub()
    stub.call("freeze", 1)
    with pytest.raises(DeviceLost, match="servo thread does not run"):
        stub.opened()
    assert stub.call("closed") == 1


@pytest.mark.parametrize(
    ("state", "styles", "words"),
    [
        (NEEDS_UPDATE, INKWELL, None),
        (NEEDS_UPDATE, AUTO | INKWELL, None),
        (NEEDS_HAND, INKWELL, "put the stylus into its inkwell and start again"),
        (NEEDS_HAND, RESET, "hold the arm in its reset position"),
        (NEEDS_HAND, AUTO, "move the arm through its whole workspace"),
        (NEEDS_UPDATE, 0, "move the arm through its whole workspace"),
    ],
)
def test_a_device_calibrates_itself_or_says_what_the_hand_has_to_do(
    state: int, styles: int, words: str | None
) -> None:
    stub = HdStub()
    stub.call("calibration", state, styles)
    if words is not None:
        with pytest.raises(DeviceError, match=f"Touch is not calibrated: {words}"):
            stub.opened()
        assert (stub.call("closed"), stub.call("enabled")) == (1, 0)
        return
    device = stub.opened()
    assert stub.call("updates") == 1
    device.start(PERIOD)
    assert ticks(device, stub, 5, WRENCH) == [0] * 5
    stub.call("calibration", NEEDS_UPDATE, styles)
    stub.advance(stub.now + 2e-3)
    assert not stub.force().any()
    with pytest.raises(DeviceLost, match="Touch has lost its calibration; start again"):
        ticks(device, stub, 1, WRENCH)
    device.close()


@pytest.mark.parametrize("value", [math.nan, math.inf, 5e4])
def test_a_pose_that_is_none_is_not_reported(value: float) -> None:
    stub, device = started()
    stub.call("spoil", value)
    with pytest.raises(DeviceError, match="Touch reports an impossible position"):
        read(device, stub, 2e-3)
    stub.call("spoil", 0.0)
    stub.call("matrix", 0, -1.0)  # a mirror
    with pytest.raises(DeviceError, match="reports an orientation that is not a rotation"):
        read(device, stub, 2e-3)


def test_what_was_found_is_said() -> None:
    said: list[str] = []
    HdStub().opened(notify=said.append).close()
    HdStub().opened(notify=said.append, turns=False).close()
    assert said == [
        "Touch: limit 3.3 N, 0.88 N of it for long; calibrated; its stylus turns the tool without "
        "torque on the hand",
        "Touch: limit 3.3 N, 0.88 N of it for long; calibrated; its stylus does not turn the tool",
    ]


@pytest.fixture(name="virtual")
def _virtual(monkeypatch: pytest.MonkeyPatch) -> HdStub:
    stub = HdStub()
    monkeypatch.setattr(touch, "RealWaiting", lambda: Virtual(stub))
    return stub


def test_a_spec_names_library_device_and_numbers(virtual: HdStub) -> None:
    spec = f"touch:library={virtual.file}"
    device = open_device(f"{spec},turn=0,damping=0.4")
    assert (device.info.damping, device.info.sensed) == (0.4, ())
    # of the model's profile, because the library does not say it
    assert device.info.resolution == 5.5e-5
    device.close()
    open_device(f"{spec},config=Right Device").close()
    for option, words in (
        (",config=Left Device", r"the device 'Left Device' of OpenHaptics cannot be opened: its "
         r"connection is not set up: run the maker's Touch Setup"),
        (",turn=2", r"turn is 2\.0; it must be 1"),
        (",damping=-1", "damping is -1"),
    ):  # fmt: skip
        with pytest.raises(DeviceError, match=words):
            open_device(spec + option)
    virtual.call("count", 0)
    with pytest.raises(DeviceError, match="the device 'default' of OpenHaptics cannot be opened"):
        open_device(spec)
    virtual.call("count", 1)
    device = open_touch({"library": virtual.file}, ignore_message, Virtual(virtual))
    with pytest.raises(DeviceError, match="another program has it, or it was not released"):
        open_device(spec)
    device.close()


def test_a_device_on_usb_is_listed_with_what_it_lacks(
    virtual: HdStub, monkeypatch: pytest.MonkeyPatch
) -> None:
    plugged = FoundDevice(
        driver="touch", name="Touch", serial="", path="/dev/bus/usb/001/002",
        vendor=0x2988, product=0x302, transport="usb", problem="libusb cannot be loaded",
    )  # fmt: skip
    monkeypatch.setattr(usb_search, "find", lambda driver: [plugged])
    monkeypatch.setenv(FILES.variable, "/no/such.so")
    (device,) = touch.find()
    assert device.problem is not None
    assert device.problem.startswith("the library '/no/such.so' cannot be loaded")
    monkeypatch.setenv(FILES.variable, virtual.file)
    (device,) = touch.find()
    assert device.problem is None
