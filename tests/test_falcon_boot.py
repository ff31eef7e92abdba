"""From power-on to the first pose: program, homing, timing, and what can go wrong on the way."""

from __future__ import annotations

import array
from pathlib import Path

import numpy as np
import pytest
from falcon_cases import Bench

from hapticbridge.device import SimulatedDevice
from hapticbridge.device.falcon import protocol as falcon_start
from hapticbridge.device.falcon.device import FalconDevice
from hapticbridge.device.falcon.protocol import read_firmware
from hapticbridge.errors import DeviceError, DeviceLost

PROGRAM = bytes(np.random.default_rng(6).integers(0, 256, 7914, np.uint8))
IN_AND_OUT = "t,x,y,z,qw,qx,qy,qz\n0,0,0,0,1,0,0,0\n2,0,-0.03,0,1,0,0,0\n4,0,0.03,0,1,0,0,0\n"


@pytest.fixture(name="program")
def _program(tmp_path: Path) -> str:
    path = tmp_path / "falcon.bin"
    path.write_bytes(PROGRAM)
    return str(path)


def test_a_falcon_with_its_program_is_not_loaded_again(program: str) -> None:
    bench = Bench()
    bench.opened(firmware=program).close()
    assert bench.model.uploaded == b""
    assert bench.told == []


def test_the_program_arrives_byte_for_byte_and_its_progress_is_told(program: str) -> None:
    bench = Bench(program=None, valid=PROGRAM)
    device = bench.opened(firmware=program, name="falcon 7")
    assert bench.model.uploaded == PROGRAM
    assert bench.told == [f"falcon 7: firmware {n} % loaded" for n in (25, 50, 75, 100)]
    device.start(1e-3)


def test_without_program_and_file_the_option_is_named() -> None:
    bench = Bench(program=None)
    with pytest.raises(DeviceError, match=r"has no firmware .*: falcon:firmware=FILE$"):
        bench.opened()
    assert bench.link.is_closed


def test_an_echo_that_differs_is_named_by_its_byte(program: str) -> None:
    bench = Bench(program=None)
    bench.model.faults.bad_echo_at = 1234
    there, back = PROGRAM[1234], PROGRAM[1234] ^ 0x40
    words = rf"sent back 0x{back:02x} for byte 1234 \(0x{there:02x}\) of its firmware; switch"
    with pytest.raises(DeviceError, match=words):
        bench.opened(firmware=program)


def test_a_program_that_does_not_run_is_no_firmware(program: str) -> None:
    bench = Bench(program=None, valid=b"the maker's")
    with pytest.raises(DeviceError, match=r"accepted '.*falcon.bin' but does not answer"):
        bench.opened(firmware=program)


def test_a_loader_that_stays_silent_is_given_up(program: str) -> None:
    bench = Bench(program=None)
    bench.model.faults.is_deaf = True
    with pytest.raises(DeviceError, match="its loader does not answer; switch its power off"):
        bench.opened(firmware=program)
    assert bench.time.now < 15.0


@pytest.mark.parametrize(
    ("size", "words"),
    [
        (None, "cannot be read"),
        (0, "has 0 bytes"),
        (70_000, "has 70000 bytes; a Falcon's firmware"),
    ],
)
def test_a_file_that_can_be_no_program_is_refused(
    tmp_path: Path, size: int | None, words: str
) -> None:
    path = tmp_path / "image"
    if size is not None:
        path.write_bytes(bytes(size))
    with pytest.raises(DeviceError, match=words):
        read_firmware(str(path))
    with pytest.raises(DeviceError, match="cannot be read"):
        read_firmware(str(tmp_path))
    with pytest.raises(DeviceError, match="cannot be read"):
        read_firmware("a\0b")


def test_an_unhomed_falcon_waits_until_the_grip_has_passed_its_zeros(tmp_path: Path) -> None:
    path = tmp_path / "hand.csv"
    path.write_text(IN_AND_OUT)
    bench = Bench(SimulatedDevice(mass=0.4, damping=2.0, path=path), is_homed=False)
    device = bench.opened()
    assert [words.partition(": ")[2] for words in bench.told] == [
        "pull the grip all the way out and push it back in, slowly",
        "homed",
    ]
    sample = device.start(1e-3)
    bench.time.until(bench.time.now)
    # an encoder that kept its offset would be hundreds of counts, some 10 mm, off
    np.testing.assert_allclose(
        sample["position"][0], bench.model.handle.pose()[0], rtol=0, atol=2e-4
    )


def test_a_grip_that_nobody_moves_is_not_waited_for_without_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(falcon_start, "HOMING_TIME", 2.0)
    bench = Bench(SimulatedDevice(hand=None), is_homed=False)
    with pytest.raises(DeviceError, match="was not homed within 2 s"):
        bench.opened()
    assert 2.0 < bench.time.now < 2.2
    assert bench.link.is_closed


def test_a_falcon_that_falls_silent_while_it_is_homed_is_lost() -> None:
    bench = Bench(is_homed=False)

    def silenced(_: str) -> None:
        bench.model.faults.is_mute = True

    with pytest.raises(DeviceLost, match="gave no usable reply for 50 ms"):
        FalconDevice(bench.link, tell=silenced)


def test_rate_and_delay_are_those_of_the_bridges_timer() -> None:
    info = Bench().opened().info
    # one delivery a millisecond; a reply takes 2 x 107 µs on the line, 20 µs to think, and then
    # waits for up to 1 ms
    assert info.rate == pytest.approx(1000.0, rel=1e-3)
    assert info.delay is not None
    assert 1.15e-3 < info.delay < 1.24e-3


def test_a_bridge_that_heeds_the_event_character_is_four_times_as_prompt() -> None:
    info = Bench(heeds_events=True).opened().info
    assert info.rate is not None
    assert info.rate > 2500.0
    # twice 107 µs on the line and 20 µs to think
    assert info.delay == pytest.approx(0.234e-3, abs=0.01e-3)


def test_the_data_sheet_says_what_is_known_and_nothing_else() -> None:
    info = Bench().opened(damping=1.5).info
    assert (info.axes, info.is_real, info.damping) == (("x", "y", "z"), True, 1.5)
    assert (info.mass, info.friction, info.rotational_damping) == (None, None, None)
    assert info.force_limit == 8.0
    # 0.05 mm per encoder step sideways, by the published constants
    assert info.resolution == pytest.approx(5e-5, rel=0.05)


@pytest.mark.parametrize("lost", [1, 10_000])
def test_one_lost_reply_is_measured_again_and_silence_is_not_borne(lost: int) -> None:
    info = Bench().opened().info
    bench = Bench()
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
