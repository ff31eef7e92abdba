"""A Falcon from power-on to its loss: program, homing, samples, forces."""

from __future__ import annotations

import array
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from device_benches import PERIOD, FalconBench
from emulated.falcon_model import Faults
from numpy.typing import NDArray

from hapticbridge.device import SimulatedDevice
from hapticbridge.device.falcon import protocol as falcon_start
from hapticbridge.device.falcon.device import FalconDevice
from hapticbridge.device.falcon.protocol import read_firmware
from hapticbridge.device.trajectory import Motion
from hapticbridge.errors import DeviceError, DeviceLost
from hapticbridge.kernel.record import SAMPLE_DTYPE, TickFlag

STALE = int(TickFlag.STALE_SAMPLE)


def started(mechanics: SimulatedDevice | None = None) -> tuple[FalconBench, FalconDevice]:
    bench = FalconBench(mechanics)
    device = bench.opened()
    device.start(PERIOD)
    return bench, device


def looped(
    bench: FalconBench, device: FalconDevice, ticks: int,
    force: tuple[float, ...] = (0.0, 0.0, 0.0), drift: float = 0.0,
) -> tuple[NDArray[np.void], NDArray[np.int64], NDArray[np.float64]]:  # fmt: skip
    """Runs a bare loop; returns samples, flags, and where the grip really was at each read."""
    samples, flags = np.zeros(ticks, SAMPLE_DTYPE), np.zeros(ticks, np.int64)
    truth = np.zeros((ticks, 3))
    clock, wrench = bench.clock(drift), np.array([*force, 0.3, 0.2, 0.1])
    for k in range(ticks):
        clock.wait()
        truth[k] = bench.model.handle.pose()[0]
        flags[k] = device.read(samples[k : k + 1])
        device.write(wrench)
    return samples, flags, truth


def test_every_tick_has_a_new_sample_that_is_two_ticks_old_at_most() -> None:
    bench, device = started()
    samples, flags, truth = looped(bench, device, 2000, drift=3e-4)
    # clocks that differ by 3e-4 pass each other once in 3.3 s: a tick finds nothing, or two replies
    assert np.count_nonzero(flags == STALE) <= 2
    # asked in the tick before, or the one before that: between those two places, to encoder steps
    for age in (1, 2):
        late = truth[:-age]
        assert np.abs(samples["position"][age:] - late).max() < 0.2e-3
    assert np.ptp(samples["position"], axis=0).max() > 5e-3


def test_a_force_arrives_with_its_size_and_direction() -> None:
    bench, device = started()
    force = (0.8, -0.5, 0.6)
    looped(bench, device, 100, force)
    np.testing.assert_allclose(bench.model.handle.force[:3], force, atol=5e-3)


def test_a_force_beyond_the_motors_keeps_its_direction() -> None:
    bench, device = started(SimulatedDevice(hand=None, mass=1e3))
    looped(bench, device, 5, (40.0, 10.0, -20.0))
    assert max(abs(units) for units in bench.model.motors) == 4096
    got = bench.model.handle.force[:3]
    size = np.linalg.norm(got)
    np.testing.assert_allclose(got / size, np.array([4, 1, -2]) / np.sqrt(21), atol=2e-3)
    assert 3.0 < size < 20.0


def test_a_force_that_is_not_finite_is_no_force() -> None:
    bench, device = started()
    looped(bench, device, 3, (np.nan, 1.0, 0.0))
    assert bench.model.motors == (0, 0, 0)


@pytest.mark.parametrize("refused", [1, 20, 21])
def test_no_force_is_sent_until_it_is_taken_and_a_force_once(refused: int) -> None:
    bench, device = started()
    device.write(np.array([0.0, 3.0, 0.0, 0.0, 0.0, 0.0]))
    write, left, sent = bench.link.write, refused, 0

    def full(packet: array.array[int], timeout_ms: int = 1) -> bool:
        nonlocal left, sent
        left, sent = left - 1, sent + 1
        return left < 0 and write(packet, timeout_ms)

    bench.link.write = full  # type: ignore[method-assign]
    device.write(np.array([0.0, 2.0, 0.0, 0.0, 0.0, 0.0]))
    assert sent == 1
    left = refused
    if refused <= 20:
        device.write(np.zeros(6))
        bench.time.until(bench.time.now + PERIOD)
        assert bench.model.motors == (0, 0, 0)
    else:
        with pytest.raises(DeviceLost, match="did not accept zero force"):
            device.write(np.zeros(6))


def test_buttons_are_reported_with_the_pose() -> None:
    bench, device = started()
    for buttons in range(16):
        bench.model.buttons = buttons
        assert looped(bench, device, 4)[0]["buttons"][-1] == buttons


def test_closing_takes_the_force_and_the_light_away() -> None:
    bench, device = started()
    looped(bench, device, 10, (1.0, 0.0, 0.0))
    assert any(bench.model.motors)
    assert bench.model.lights == 2
    device.close()
    assert bench.model.motors == (0, 0, 0)
    assert bench.model.lights == 0
    assert bench.link.is_closed


def test_noise_before_every_reply_costs_no_sample() -> None:
    bench, device = started()
    bench.model.faults.noise = b"\x00<AAAA\xff>"
    samples, flags, truth = looped(bench, device, 200)
    assert np.count_nonzero(flags == STALE) <= 2
    assert np.abs(samples["position"][2:] - truth[:-2]).max() < 0.2e-3


def test_replies_that_lack_a_byte_are_left_out_and_the_last_pose_stays() -> None:
    bench, device = started()
    bench.model.faults.is_cut_short = True
    samples, flags, _ = looped(bench, device, 200)
    is_stale = flags == STALE
    assert 90 <= np.count_nonzero(is_stale) <= 110
    again = np.flatnonzero(is_stale[1:]) + 1
    assert (samples["position"][again] == samples["position"][again - 1]).all()


@pytest.mark.parametrize("counts", [9000, 300], ids=["out of reach", "a jump of millimetres"])
def test_a_reply_that_cannot_be_is_not_believed(counts: int) -> None:
    bench, device = started()
    looped(bench, device, 20)
    right = bench.model.encoders

    def wrong() -> tuple[int, ...]:
        first, *others = right()
        return (first + counts, *others)

    bench.model.encoders = wrong  # type: ignore[method-assign]
    samples, flags, _ = looped(bench, device, 20)
    assert (flags[3:] == STALE).all()
    assert (samples["position"][3:] == samples["position"][3]).all()
    bench.model.encoders = right  # type: ignore[method-assign]
    samples, flags, truth = looped(bench, device, 20)
    assert (flags[3:] == 0).all()
    assert np.abs(samples["position"][5:] - truth[3:-2]).max() < 0.2e-3


@pytest.mark.parametrize("fault", ["mute", "wrong"])
def test_a_falcon_without_a_believable_reply_for_50_ms_is_lost(fault: str) -> None:
    bench, device = started()
    looped(bench, device, 20)
    begin = bench.time.now
    if fault == "mute":
        bench.model.faults.is_mute = True
    else:
        bench.model.encoders = lambda: (9000, 9000, 9000)  # type: ignore[method-assign]
    with pytest.raises(DeviceLost, match="gave no usable reply for 50 ms"):
        looped(bench, device, 200)
    assert 0.049 < bench.time.now - begin < 0.055


def test_a_pause_of_the_loop_is_not_the_devices_silence() -> None:
    bench, device = started()
    looped(bench, device, 20)
    bench.time.until(bench.time.now + 5e-3)
    sample = np.zeros(1, SAMPLE_DTYPE)
    device.read(sample)  # the last reply: nothing waits for the loop when it comes back
    bench.time.until(bench.time.now + 1.0)
    _, flags, _ = looped(bench, device, 20)
    assert (flags[3:] == 0).all()


@pytest.mark.parametrize(("stall", "is_asked_anew"), [(0.04, False), (0.2, True)])
def test_after_stall_force_is_gone_and_pose_fresh(stall: float, is_asked_anew: bool) -> None:
    path = Motion([0.0, 5.0], [(-0.02, 0.0, 0.0), (0.18, 0.0, 0.0)])  # 40 mm/s
    bench, device = started(SimulatedDevice(mass=0.4, damping=2.0, path=path))
    looped(bench, device, 300, (-0.5, 0.0, 0.0))
    before = bench.time.now
    bench.time.until(before + stall)
    assert any(bench.model.motors)  # nothing takes it away while the host stands still
    sample = np.zeros(1, SAMPLE_DTYPE)
    assert device.read(sample) == 0
    error = np.linalg.norm(sample["position"][0] - bench.model.handle.pose()[0])
    assert (error < 0.2e-3) == is_asked_anew
    assert (bench.model.motors == (0, 0, 0)) == is_asked_anew
    waited = bench.time.now - before - stall
    assert 0.0 < waited < 5e-3 if is_asked_anew else waited == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("fault", ["unplugged", "halted", "halted in a stall"])
def test_an_unplugged_or_halted_falcon_is_lost_in_the_same_tick(fault: str) -> None:
    bench, device = started()
    looped(bench, device, 20)
    if fault == "unplugged":
        bench.time.is_plugged = False
    else:
        bench.model.halted |= {0x81, 0x02}
    if "stall" in fault:
        bench.time.until(bench.time.now + 0.2)
    begin = bench.time.now
    with pytest.raises(DeviceLost):
        looped(bench, device, 200)
    assert bench.time.now - begin < 2.1e-3
    device.close()


def test_a_rate_below_50_hz_and_encoders_that_no_grip_has_are_refused() -> None:
    bench = FalconBench()
    device = bench.opened()
    with pytest.raises(DeviceError, match="the rate must be at least 50 Hz, not 40 Hz"):
        device.start(0.025)
    device.start(0.02)
    bench.model.encoders = lambda: (9000, 0, 0)  # type: ignore[method-assign]
    with pytest.raises(DeviceError, match=r"encoder counts \[9000, 0, 0\] match no position"):
        device.start(PERIOD)


PROGRAM = bytes(np.random.default_rng(6).integers(0, 256, 7914, np.uint8))
IN_AND_OUT = "t,x,y,z,qw,qx,qy,qz\n0,0,0,0,1,0,0,0\n2,0,-0.03,0,1,0,0,0\n4,0,0.03,0,1,0,0,0\n"


@pytest.fixture(name="program")
def _program(tmp_path: Path) -> str:
    path = tmp_path / "falcon.bin"
    path.write_bytes(PROGRAM)
    return str(path)


def test_a_falcon_with_its_program_is_not_loaded_again(program: str) -> None:
    bench = FalconBench()
    bench.opened(firmware=program).close()
    assert (bench.model.uploaded, bench.told) == (b"", [])


def test_the_program_arrives_byte_for_byte_and_its_progress_is_told(program: str) -> None:
    bench = FalconBench(program=None, valid=PROGRAM)
    device = bench.opened(firmware=program, name="falcon 7")
    assert bench.model.uploaded == PROGRAM
    assert bench.told == [f"falcon 7: firmware {n} % loaded" for n in (25, 50, 75, 100)]
    device.start(1e-3)


def test_without_program_and_file_the_option_is_named() -> None:
    bench = FalconBench(program=None)
    with pytest.raises(DeviceError, match=r"has no firmware .*: falcon:firmware=FILE$"):
        bench.opened()
    assert bench.link.is_closed


ECHO = rf"sent back 0x{PROGRAM[1234] ^ 0x40:02x} for byte 1234 \(0x{PROGRAM[1234]:02x}\) of"


@pytest.mark.parametrize(
    ("fault", "valid", "words"),
    [
        ({"bad_echo_at": 1234}, PROGRAM, ECHO),
        ({}, b"the maker's", r"accepted '.*falcon.bin' but does not answer"),
        ({"is_deaf": True}, PROGRAM, "its loader does not answer; switch its power off"),
    ],
)
def test_bad_program_is_told(program: str, fault: Any, valid: bytes, words: str) -> None:
    bench = FalconBench(program=None, valid=valid)
    bench.model.faults = Faults(**fault)
    with pytest.raises(DeviceError, match=words):
        bench.opened(firmware=program)
    assert bench.time.now < 15.0


def test_a_piece_of_the_program_that_is_slow_to_return_loses_nothing(program: str) -> None:
    bench = FalconBench(program=None, valid=PROGRAM)
    take, held = bench.link.take, [0.5]  # s: a computer that is busy

    def slow() -> list[bytes]:
        if len(bench.model.uploaded) > 3000 and held:
            bench.time.advance(bench.time.now + held.pop())
            return []
        return take()

    bench.link.take = slow  # type: ignore[method-assign]
    bench.opened(firmware=program).close()
    assert (bench.model.uploaded, held) == (PROGRAM, [])


def test_a_file_that_is_no_program_is_refused(tmp_path: Path) -> None:
    empty, large = tmp_path / "empty", tmp_path / "large"
    empty.write_bytes(b"")
    large.write_bytes(bytes(70_000))
    for path, words in (
        (empty, "has no bytes"),
        (large, "has too many bytes; a Falcon's firm"),
        *((path, "cannot be read") for path in (tmp_path / "none", tmp_path, "a\0b")),
    ):
        with pytest.raises(DeviceError, match=words):
            read_firmware(str(path))


def test_an_unhomed_falcon_waits_until_the_grip_has_passed_its_zeros(tmp_path: Path) -> None:
    path = tmp_path / "hand.csv"
    path.write_text(IN_AND_OUT)
    bench = FalconBench(SimulatedDevice(mass=0.4, damping=2.0, path=path), is_homed=False)
    device = bench.opened()
    asked, done = (words.partition(": ")[2] for words in bench.told)
    assert asked == "pull the grip all the way out and push it back in, slowly"
    assert done == "homed"
    sample = device.start(1e-3)
    bench.time.until(bench.time.now)
    # an encoder that kept its offset would be hundreds of counts, some 10 mm, off
    place = bench.model.handle.pose()[0]
    np.testing.assert_allclose(sample["position"][0], place, rtol=0, atol=2e-4)


def test_a_grip_that_nobody_moves_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(falcon_start, "HOMING_TIME", 2.0)
    bench = FalconBench(SimulatedDevice(hand=None), is_homed=False)
    with pytest.raises(DeviceError, match="within 2 s, in which 0 of its 3 encoders passed"):
        bench.opened()
    assert 2.0 < bench.time.now < 2.2
    assert bench.link.is_closed


def test_a_falcon_that_falls_silent_while_it_is_homed_is_lost() -> None:
    bench = FalconBench(is_homed=False)

    def silenced(_: str) -> None:
        bench.model.faults.is_mute = True

    with pytest.raises(DeviceLost, match="gave no usable reply for 50 ms"):
        FalconDevice(bench.link, notify=silenced)


def test_rate_and_delay_are_those_of_the_bridges_timer() -> None:
    info = FalconBench().opened().info
    # one delivery a millisecond; a reply takes 2 x 107 µs on the line, 20 µs to think, and then
    # waits for up to 1 ms
    assert info.rate == pytest.approx(1000.0, rel=1e-3)
    assert info.delay is not None
    assert 1.15e-3 < info.delay < 1.24e-3


def test_a_bridge_that_heeds_the_event_character_is_four_times_as_prompt() -> None:
    info = FalconBench(heeds_events=True).opened().info
    assert info.rate is not None
    assert info.rate > 2500.0
    # twice 107 µs on the line and 20 µs to think
    assert info.delay == pytest.approx(0.234e-3, abs=0.01e-3)


def test_the_data_sheet_says_what_is_known_and_nothing_else() -> None:
    info = FalconBench().opened(damping=1.5).info
    assert (info.axes, info.is_real, info.damping) == (("x", "y", "z"), True, 1.5)
    assert (info.mass, info.friction, info.rotational_damping) == (None, None, None)
    assert info.force_limit == 8.0
    # 0.05 mm per encoder step sideways, by the published constants
    assert info.resolution == pytest.approx(5e-5, rel=0.05)


@pytest.mark.parametrize("lost", [1, 10_000])
def test_one_lost_reply_is_measured_again_and_silence_is_not_borne(lost: int) -> None:
    info = FalconBench().opened().info
    bench = FalconBench()
    write, packets = bench.link.write, 0

    def lossy(packet: array.array[int], timeout_ms: int = 1) -> bool:
        nonlocal packets
        packets += 1
        return 250 <= packets < 250 + lost or write(packet, timeout_ms)

    bench.link.write = lossy  # type: ignore[method-assign]
    if lost == 1:
        found = bench.opened().info
        assert packets > 500  # the second time whole
        assert found.rate == pytest.approx(info.rate, rel=0.02)
        assert found.delay == pytest.approx(info.delay, rel=0.05)
    else:
        with pytest.raises(DeviceLost, match="fell silent while its timing was measured"):
            bench.opened()
        assert bench.link.is_closed
