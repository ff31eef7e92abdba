"""Raw HID devices behind the real driver, in virtual time."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from device_benches import PERIOD, paddle, read
from device_benches import opened_rawhid as opened
from emulated.hid_seam import DrivingClock, HidSeam
from emulated.rawhid_model import NAN, Claims, Fingers, RawHid, crc
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import hapticbridge as hb
from hapticbridge.device import Hand, Motion, SimulatedDevice
from hapticbridge.device.base import AXES
from hapticbridge.device.driver import ignore_message
from hapticbridge.device.rawhid.device import RawHidDevice, open_rawhid
from hapticbridge.device.watchdog import SILENCE
from hapticbridge.errors import DeviceError, DeviceLost
from hapticbridge.kernel.record import SAMPLE_DTYPE, TickFlag

STALE = int(TickFlag.STALE_SAMPLE)
PUSH = np.array([1.0, 2.0, 3.0, 0.01, 0.02, 0.03])


def still(claims: Claims | None = None, **options: object) -> tuple[RawHidDevice, RawHid, HidSeam]:
    """Returns a device that reports what the test tells it, started and just about to be read."""
    device, model, seam = opened(RawHid(None, claims), **options)
    device.start(PERIOD)
    return device, model, seam


def test_the_data_sheet_is_what_the_user_and_the_device_say() -> None:
    info = opened(paddle())[0].info
    assert (info.name, info.axes, info.is_real) == ("paddle", ("x",), True)
    assert (info.damping, info.resolution, info.force_limit) == (0.8, 1.5e-5, 4.0)
    assert (info.mass, info.friction, info.rotational_damping, info.delay) == (None,) * 4
    info = opened(paddle(), damping=0.4, mass=0.06)[0].info  # the user goes first
    assert (info.damping, info.mass, info.force_limit) == (0.4, 0.06, 4.0)
    info = opened(RawHid(None, Claims(delay=5e-4)))[0].info
    # what the device adds, a state of one period's age, and 1 ms on the bus each way
    assert info.axes == AXES
    assert info.delay == pytest.approx(5e-4 + 1e-3 + 2e-3)
    # what does not move along a line needs no limit of force
    info = opened(RawHid(None, Claims(axes=0b100000, force_limit=NAN)))[0].info
    assert (info.axes, info.force_limit > 0.0) == (("rz",), True)


@pytest.mark.parametrize(
    ("claims", "words"),
    [
        (Claims(force_limit=NAN), "does not report its force_limit"),
        (Claims(torque_limit=NAN), "does not report its torque_limit"),
        (Claims(speed_limit=NAN), "does not report its speed_limit"),
        (Claims(rate=NAN), "does not report its rate"),
        (Claims(mass=-1.0), "reports an impossible data sheet: mass is -1.0 kg"),
        (Claims(axes=0), "reports an impossible data sheet: axes"),
        (Claims(axes=128), "reports an impossible data sheet: axes"),
    ],
)
def test_a_sheet_without_what_nobody_can_guess_is_refused(claims: Claims, words: str) -> None:
    with pytest.raises(DeviceError, match=words):
        opened(RawHid(None, claims))


def test_one_that_does_not_speak_the_protocol_or_another_version_is_refused() -> None:
    class Mute(RawHid):
        def output(self, report: bytes, now: float) -> None:
            """Takes no notice."""

    with pytest.raises(DeviceError, match=r"does not answer by the protocol .*rawhid\.md"):
        opened(Mute())

    class Newer(RawHid):
        def push(self, report: bytes) -> None:
            body = report[:1] + b"\x02" + report[2:62]
            super().push(body + crc(body).to_bytes(2, "little"))

    with pytest.raises(DeviceError, match="speaks version 2 of the raw HID protocol; version 1 is"):
        opened(Newer())


def test_another_teensy_interface_and_another_serial_are_not_taken_for_it() -> None:
    class Serial(RawHid):
        report_descriptor = bytes.fromhex("06c9ff 0904 a101 c0")

    with pytest.raises(DeviceError, match=r"plugged in .looked for a board of any vendor with the"):
        opened(Serial())
    first, second = RawHid(serial="A"), RawHid(serial="B")
    with pytest.raises(DeviceError, match=r"2 devices 'rawhid' .* one of 'A', 'B'"):
        open_rawhid({}, ignore_message, HidSeam(first, second))
    with pytest.raises(DeviceError, match="no device 'rawhid' has serial 'C'; plugged in: 'A', "):
        open_rawhid({"serial": "C"}, ignore_message, HidSeam(first, second))
    open_rawhid({"serial": "B"}, ignore_message, HidSeam(first, second)).start(PERIOD)
    assert first.commands == 0


def test_the_pose_is_the_devices_and_axes_it_lacks_stay_where_they_are() -> None:
    numbers = (0.01, -0.02, 0.03, 0.4, -0.5, 0.6, *[1.0] * 6)
    for axes in (0b111111, 0b000001, 0b100100, 0b011000):
        device, model, seam = still(Claims(axes=axes))
        model.motion, model.buttons = numbers, 5
        flag, sample = read(device, seam)
        has = np.array([float(axes >> i & 1) for i in range(6)])
        np.testing.assert_allclose(sample["position"], has[:3] * numbers[:3], rtol=1e-7)
        x, y, z, w = Rotation.from_rotvec(has[3:] * numbers[3:6]).as_quat(canonical=True)
        np.testing.assert_allclose(sample["quaternion"], (w, x, y, z), atol=1e-7)
        assert (flag, sample["buttons"]) == (0, 5)
        np.testing.assert_array_equal(device.velocity, has)


def test_a_wrench_arrives_on_the_axes_that_there_are() -> None:
    for axes in (0b111111, 0b000001, 0b110110):
        device, model, _ = still(Claims(axes=axes))
        device.write(PUSH)
        has = np.array([float(axes >> i & 1) for i in range(6)])
        np.testing.assert_allclose(model.wrench, has * PUSH, rtol=1e-7)
        assert model.is_enabled


def test_lost_frames_are_counted_and_the_newest_pose_is_used() -> None:
    device, model, seam = still()
    read(device, seam)
    model.lose = set(range(model.frames + 3, model.frames + 6))
    flags = [read(device, seam)[0] for _ in range(10)]
    assert flags.count(STALE) == 3
    assert device.remark == "3 state frames lost, 0 damaged"


@pytest.mark.parametrize("lost", [0, 1, 2])
def test_losses_are_counted_across_the_sequences_wrap(lost: int) -> None:
    device, model, seam = still()
    read(device, seam)
    model.sequence = 65533
    read(device, seam)  # 65534
    before = device.states.lost
    model.lose = set(range(model.frames + 2, model.frames + 2 + lost))  # 0, 1
    for _ in range(5):
        read(device, seam)
    assert device.states.lost - before == lost


def test_a_frame_with_a_wrong_crc_is_dropped_counted_and_missed() -> None:
    device, model, seam = still()
    read(device, seam)
    model.motion = (0.5,) * 12
    model.damage = {model.frames + 1}
    flag, sample = read(device, seam)
    assert (flag, device.states.damaged) == (STALE, 1)
    assert sample["position"][0] == 0.0
    flag, sample = read(device, seam)
    assert (flag, device.states.lost, sample["position"][0]) == (0, 1, 0.5)


def test_a_repeated_frame_is_nothing_new() -> None:
    device, model, seam = still()
    model.advance(seam.now + PERIOD)
    report = model.take_report() or b""
    model.push(report)
    model.push(report)
    assert device.read(np.zeros(1, SAMPLE_DTYPE)) == 0
    model.push(report)
    assert device.read(np.zeros(1, SAMPLE_DTYPE)) == STALE
    assert device.states.lost == 0


def test_after_a_pause_the_pose_is_a_fresh_one_though_the_queue_is_full_of_old_ones() -> None:
    device, model, seam = still()
    for pause in (0.5, 2.0):  # as long as compiling takes, and a stall in mid-run
        model.motion = (0.1,) * 12
        seam.advance(seam.now + pause)
        model.motion = (0.2,) * 12
        sample = np.zeros(1, SAMPLE_DTYPE)
        before = seam.now
        assert device.read(sample) == 0
        assert sample[0]["position"][0] == np.float32(0.2)
        assert seam.now - before <= 2.1e-3
    # of the stall; the first is no loss
    assert device.states.lost == pytest.approx(2000 - 63, abs=2)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e31])
def test_a_number_that_is_not_finite_ends_the_run(value: float) -> None:
    for place in range(12):
        device, model, seam = still()
        model.motion = tuple(value if i == place else 0.0 for i in range(12))
        with pytest.raises(DeviceError, match="reports a number that is not finite"):
            read(device, seam)


def test_a_fault_and_a_restart_end_the_run_and_a_wrapping_clock_does_not() -> None:
    device, model, seam = opened(RawHid(clock_start_us=2**32 - 20_000))
    device.start(PERIOD)
    for _ in range(100):
        assert read(device, seam)[0] == 0
    model.status = 8
    with pytest.raises(DeviceError, match=r"a fault of its own \(status 0x[0-9a-f][89a-f]\)"):
        read(device, seam)
    device, model, seam = still()
    read(device, seam)
    model.clock_start_us -= round(1e6 * seam.now)
    with pytest.raises(DeviceError, match="has restarted during the run"):
        read(device, seam)


def test_a_device_that_must_be_homed_or_sends_nothing_does_not_start() -> None:
    device, model, _ = opened()
    model.status = 16
    with pytest.raises(DeviceError, match="has no valid pose yet: home or calibrate it"):
        device.start(PERIOD)
    model.status = 8
    with pytest.raises(DeviceError, match="reports a fault of its own"):
        device.start(PERIOD)
    device, model, _ = opened()
    model.is_silent = True
    with pytest.raises(DeviceError, match="sends no state frames"):
        device.start(PERIOD)


def test_silence_is_borne_for_50_ms_and_then_the_device_is_lost() -> None:
    device, model, seam = still()
    for _ in range(2):  # one frame, and all is forgiven
        model.is_silent = False
        assert read(device, seam)[0] == 0
        model.is_silent = True
        for _ in range(round(SILENCE / PERIOD) - 1):
            assert read(device, seam)[0] == STALE
    with pytest.raises(DeviceLost, match="has sent nothing for 51 ms"):
        read(device, seam, 2 * PERIOD)


def test_the_watchdog_of_the_device_lets_go_20_ms_after_the_last_force_frame() -> None:
    device, model, seam = still()
    device.write(PUSH)
    seam.advance(seam.now + 0.0199)
    assert model.wrench.any()
    seam.advance(seam.now + 0.0002)
    assert not model.wrench.any()
    read(device, seam)
    assert device.states.newest is not None
    assert device.states.newest.status & 2


def test_closing_switches_the_motors_off() -> None:
    device, model, _ = still()
    device.write(PUSH)
    device.close()
    assert not model.is_enabled
    assert not model.wrench.any()


def test_the_log_that_the_user_asks_for_holds_every_frame(tmp_path: Path) -> None:
    device, model, seam = opened(log=str(tmp_path / "wire.log"))
    device.start(PERIOD)
    device.write(PUSH)
    read(device, seam)
    device.close()
    lines = (tmp_path / "wire.log").read_text().splitlines()
    sent = [line.split(" > ")[1] for line in lines if " > " in line]
    assert [line[:11] for line in sent] == ["00 48 01 3f"] * 2 + ["00 48 01 46"] * 2
    assert len(lines) - len(sent) == model.frames + 2  # and both pages of the sheet


def test_the_echo_counts_force_frames_on_the_way() -> None:
    device, _, seam = still()
    read(device, seam)
    for _ in range(3):
        device.write(PUSH)
    before = device.on_the_way
    read(device, seam)
    assert (before > 0, device.on_the_way) == (True, 0)


@given(st.tuples(*[st.floats(width=32)] * 12))
def test_arbitrary_numbers_give_a_finite_pose_or_end_the_run(numbers: tuple[float, ...]) -> None:
    device, model, seam = still()
    model.motion = numbers
    try:
        _, sample = read(device, seam)
    except DeviceError:
        assert not all(abs(number) <= 1e30 for number in numbers)
    else:
        assert np.isfinite(sample["position"]).all()
        assert np.linalg.norm(sample["quaternion"]) == pytest.approx(1.0, abs=1e-12)


def test_a_board_of_any_vendor_is_found_by_its_usage_page() -> None:
    model = RawHid(SimulatedDevice())
    model.vendor, model.product, model.product_name = 0x303A, 0x4004, "my board"
    device = open_rawhid({}, ignore_message, HidSeam(model))
    assert device.info.name == "test bench"


# A grip axis


def gripping(path: Motion | None = None, **fingers: float) -> RawHid:
    """Returns a board with six axes that a hand holds still, and a grip that fingers close."""
    still = Motion([0.0, 1.0], np.zeros((2, 3)))
    hand = Hand(mass=0.02, stiffness=1500.0, damping=8.0)
    grip = SimulatedDevice(mass=0.05, damping=2.0, hand=hand, dof=3, path=path or still)
    return RawHid(SimulatedDevice(path=still), grip=grip, fingers=Fingers(**fingers))


def test_a_grip_axis_has_a_sheet_of_its_own_that_the_user_may_correct() -> None:
    grip = opened(gripping())[0].info.grip_axis
    assert grip is not None
    assert (grip.axes, grip.damping, grip.friction) == (("x",), 2.0, None)
    assert (grip.force_limit, grip.speed_limit, grip.reach) == (8.0, 3.0, 0.03)
    changed = opened(gripping(), grip_damping=1.2, grip_force_limit=5.0)[0].info
    assert changed.grip_axis is not None
    assert (changed.grip_axis.damping, changed.grip_axis.force_limit) == (1.2, 5.0)
    assert changed.damping == 2.0
    assert opened()[0].info.grip_axis is None
    with pytest.raises(DeviceError, match="does not report its grip's force_limit"):
        opened(gripping(force_limit=NAN))


def test_fingers_on_a_board_close_the_pliers_and_feel_their_spring() -> None:
    closing = Motion([0.0, 0.2, 0.6], [[0.0] * 3, [0.0] * 3, [0.0105, 0.0, 0.0]])
    board, model, seam = opened(gripping(closing))
    grasp = hb.Grasp("grip", board, grip_axis=hb.GripAxis("hinge"))
    limits = hb.Limits(force=10.0, torque=0.5, ramp=0.0)
    felt = []
    with hb.Bridge("pliers", [grasp], clock=DrivingClock(seam), limits=limits) as bridge:
        summary = bridge.run(1.5, on_tick=lambda _: felt.append(model.grip_force))
        angle = float(bridge.scene.data.joint("hinge").qpos[0])
    assert summary.verdict == "passive"
    assert angle > 0.06
    assert felt[-1] == pytest.approx(-(0.25 / 0.03) * 0.4 * (angle + 0.15), rel=0.03)
    assert model.grip_force == 0.0  # at the end
    assert np.abs(model.wrench).max() == 0.0


def test_the_watchdog_of_a_board_ends_the_force_of_its_grip_too() -> None:
    board, model, seam = opened(gripping())
    board.start(1e-3)
    board.write(np.array([[0.0] * 6, [-2.0, 0, 0, 0, 0, 0]]))
    seam.advance(seam.now + 1e-3)
    assert model.grip_force == -2.0
    seam.advance(seam.now + 0.1)
    assert model.grip_force == 0.0
    with pytest.raises(DeviceError, match="not finite"):
        board.write(np.array([[0.0] * 6, [np.nan, 0, 0, 0, 0, 0]]))
