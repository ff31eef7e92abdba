"""Frames of the raw HID protocol: document, codec, and the reference firmware compiled here."""

from __future__ import annotations

import ctypes
import math
import re
import shutil
import struct
import subprocess
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from emulated.rawhid_model import crc
from firmware_build import COMPILER, FIRMWARE, LIBRARY, built
from hypothesis import given
from hypothesis import strategies as st

from hapticbridge.device.base import AXES
from hapticbridge.device.own_loop import BoardSetting, LoopReport, LoopState, ShownTool
from hapticbridge.device.rawhid import device as driver
from hapticbridge.device.rawhid import protocol

DOCUMENT = Path(driver.__file__).parents[1].joinpath("rawhid.md").read_text(encoding="utf-8")
NAN = math.nan

single = st.floats(-(2.0**99), 2.0**99, width=32)
any_single = st.floats(width=32)
u8, u16 = st.integers(0, 255), st.integers(0, 65535)
states = st.builds(
    protocol.State, u8, u16, u16, st.integers(0, 2**32 - 1), st.tuples(*[single] * 12), u16
)


def sealed(body: bytes) -> bytes:
    return body + struct.pack("<H", crc(body))


def state_frame(state: protocol.State) -> bytes:
    """Returns a device's state frame, by the document."""
    head = 0x48, 1, 0x53, state.status, state.sequence, state.buttons, state.time_us
    return sealed(struct.pack("<BBBBHHI12fH", *head, *state.numbers, state.echo))


def sheet_frames(sequence: int, numbers: protocol.Numbers, name: str) -> tuple[bytes, bytes]:
    """Returns both pages of a device's sheet; the name is truncated to 54 bytes in UTF-8."""
    text = name.encode()[:54].decode(errors="ignore").encode()
    return (
        sealed(struct.pack("<BBBBHH13f2x", 0x48, 1, 0x44, 0, sequence, *numbers)),
        sealed(struct.pack("<BBBBHH54s", 0x48, 1, 0x44, 1, sequence, 0, text)),
    )


MOTION = (0.01, -0.02, 0.03, 0.0, 0.0, 0.5, 0.1, 0.0, 0.0, 0.0, 0.0, -1.0)

STATE = protocol.State(protocol.Status.ENABLED, 258, 1, 1_000_000, MOTION, 7)
SHEET = (1, 990.0, NAN, 0.4, NAN, NAN, 0.05, 1.5e-5, 4.0, NAN, 2.0, 5e-4, 0.0, 0.0)
UNKNOWN = protocol.Numbers(1, *[NAN] * 11)

GRIP = protocol.GripNumbers(0.05, 2.0, NAN, 1e-5, 8.0, 3.0, 0.03)
CLOSED = (0.0,) * 9 + (0.012, -0.1, 0.0)


def grip_frame(sequence: int, numbers: protocol.GripNumbers) -> bytes:
    """Returns page 2 of a device's sheet, by the document."""
    return sealed(struct.pack("<BBBBHH7f26x", 0x48, 1, 0x44, 2, sequence, 0, *numbers))


WRITTEN = {
    "Force 7": protocol.force_frame(7, (1.0, -0.5, 0.0, 0.0, 0.0, 0.01), 20),
    "State 258": state_frame(STATE),
    "Ask 1": protocol.ask_frame(1, 0),
    "Sheet, page 0": sheet_frames(1, protocol.Numbers(*SHEET), "")[0],
    "Sheet, page 1": sheet_frames(2, UNKNOWN, "one-axis capstan paddle")[1],
    "Force 8": protocol.force_frame(8, (0.0,) * 6 + (-3.5,), 20),
    "State 259": state_frame(protocol.State(protocol.Status.ENABLED, 259, 0, 2_000_000, CLOSED, 8)),
    "Sheet, page 2": grip_frame(3, GRIP),
}


def documented() -> dict[str, bytes]:
    """Returns the document's worked frames by the first words of the paragraph before each."""
    section = DOCUMENT.split("## Worked frames")[1]
    pairs = re.findall(r"\n([^\n]+(?:\n[^\n`]+)*)\n\n```text\n([0-9a-f \n]+)```", section)
    return {re.split(r"[:,](?! page)", words)[0]: bytes.fromhex(text) for words, text in pairs}


def test_the_documents_worked_frames_are_what_the_codec_writes() -> None:
    assert documented() == WRITTEN


def test_the_crc_is_the_documents_bit_by_bit_and_has_its_check_value() -> None:
    assert protocol.crc16(b"123456789") == crc(b"123456789") == 0x29B1
    for frame in documented().values():
        assert len(frame) == protocol.FRAME_BYTES
        assert crc(frame[:62]) == struct.unpack("<H", frame[62:])[0]


SIZES = {"u8": ("B", 1), "u16": ("H", 2), "u32": ("I", 4), "i64": ("q", 8), "f32": ("f", 4)}
FIELD = re.compile(r"^\| (\d+)(?:–(\d+))? \| (?:(\d+) × )?([uif]\d+) \| ([^|]*) \|", re.MULTILINE)


def fields(heading: str) -> dict[int, tuple[int, str]]:
    """Returns first byte: (last byte, struct format) of a section's table of bytes."""
    section = DOCUMENT.split(f"\n## {heading}")[1].split("\n## ")[0]
    found = {}
    for first, last, count, kind, _ in FIELD.findall(section):
        letter, size = SIZES[kind]
        end = int(first) + size * int(count or 1) - 1
        assert end == int(last or first), (heading, first)
        found[int(first)] = (end, f"<{count}{letter}")
    return found


LOOP_FRAMES = ["Loop state", "Loop report", "Shown tool", "Planes", "Setting"]


@pytest.mark.parametrize("heading", ["State", "Force", *LOOP_FRAMES])
def test_the_documents_fields_fill_64_bytes_without_a_gap(heading: str) -> None:
    layout = {**fields("The interface"), **fields(heading)}
    place = 0
    for first in sorted(layout):
        assert first == place
        place = layout[first][0] + 1
    assert place == protocol.FRAME_BYTES


def test_the_worked_state_holds_its_numbers_where_the_document_says() -> None:
    frame = documented()["State 258"]
    layout = {**fields("The interface"), **fields("State")}
    expected: dict[int, tuple[float, ...]] = {
        0: (0x48,), 1: (1,), 2: (0x53,), 3: (1,), 4: (258,), 6: (1,), 8: (1_000_000,),
        12: (0.01, -0.02, 0.03), 24: (0, 0, 0.5), 36: (0.1, 0, 0), 48: (0, 0, -1), 60: (7,),
    }  # fmt: skip
    for first, values in expected.items():
        found = struct.unpack_from(layout[first][1], frame, first)
        np.testing.assert_allclose(found, values, rtol=1e-7)


def test_the_worked_sheet_holds_its_numbers_where_the_document_says() -> None:
    frame = documented()["Sheet, page 0"]
    layout = fields("Sheet")
    for first, value in zip(sorted(layout), SHEET, strict=True):
        (stored,) = struct.unpack_from(layout[first][1], frame, first)
        assert stored == pytest.approx(value, rel=1e-7, nan_ok=True)


@given(states)
def test_any_state_survives_a_frame(state: protocol.State) -> None:
    assert protocol.decoded(state_frame(state)) == state


titles = st.text("a-é日🙂 7", max_size=80).map(str.strip)


@given(st.integers(0, 63), st.lists(any_single, min_size=13, max_size=13), titles)
def test_any_sheet_survives_its_frames(axes: int, values: list[float], name: str) -> None:
    frames = sheet_frames(9, protocol.Numbers(axes, *values), name)
    numbers, title = map(protocol.decoded, frames)
    assert isinstance(numbers, protocol.Numbers)
    assert isinstance(title, str)
    known = numbers.known()
    for field, value in zip(protocol.Numbers._fields[1:], values, strict=True):
        # equal as a float32, not as a double: the shortest text that means the same one
        stored = known[field]
        assert (stored is None) == (not math.isfinite(value))
        assert stored is None or np.float32(stored) == np.float32(value)
    assert numbers.axis_names == tuple(AXES[i] for i in range(6) if axes >> i & 1)
    assert name.encode().startswith(title.encode())
    assert len(title.encode()) > 50 or title == name


@given(st.binary(max_size=130))
def test_arbitrary_bytes_are_no_frame(data: bytes) -> None:
    assert protocol.decoded(data) is None


@given(st.binary(min_size=60, max_size=60))
def test_whatever_passes_the_check_is_read_without_a_crash(body: bytes) -> None:
    for kind in range(0x3F, 0x54):
        frame = b"\x48\x01" + bytes([kind]) + body[:59]
        news = protocol.decoded(frame + struct.pack("<H", crc(frame)))
        is_sheet = kind == 0x44 and body[0] <= 2
        assert (news is None) == (kind not in (0x53, 0x4C, 0x52) and not is_sheet)


@given(states, st.integers(0, 64 * 8 - 1), st.integers(0, 64 * 8 - 1))
def test_one_or_two_flipped_bits_never_pass(state: protocol.State, first: int, second: int) -> None:
    frame = bytearray(state_frame(state))
    for bit in {first, second}:
        frame[bit // 8] ^= 1 << bit % 8
    assert protocol.decoded(bytes(frame)) is None


def test_a_frame_of_another_version_is_told_from_noise() -> None:
    body = bytearray(state_frame(protocol.State(0, 0, 0, 0, (0.0,) * 12, 0))[:62])
    body[1] = 2
    frame = bytes(body) + struct.pack("<H", crc(bytes(body)))
    assert (protocol.version_of(frame), protocol.decoded(frame)) == (2, None)
    assert protocol.version_of(frame[:-1] + bytes([frame[-1] ^ 1])) is None


WRENCH = (1.0, -0.5, 0.25, 0.01, -0.02, 0.03)

pytestmark = pytest.mark.skipif(
    COMPILER is None, reason="neither g++ nor clang++ is here to compile the firmware with"
)


@pytest.fixture(scope="module", name="shim")
def _shim(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    return built(tmp_path_factory.mktemp("firmware"))


def wrench_at(shim: ctypes.CDLL, now_us: int) -> tuple[float, ...]:
    numbers = (ctypes.c_float * 6)()
    shim.shim_wrench(now_us, numbers)
    return tuple(numbers)


def state_at(shim: ctypes.CDLL, now_us: int, status: int = 0, *numbers: float) -> protocol.State:
    frame = ctypes.create_string_buffer(64)
    values = (ctypes.c_float * 12)(*(numbers or [0.0] * 12))
    shim.shim_state(values, 0x8001, status, now_us, frame)
    state = protocol.decoded(frame.raw)
    assert isinstance(state, protocol.State)
    return state


@given(st.binary(max_size=100))
def test_both_crcs_agree(shim: ctypes.CDLL, data: bytes) -> None:
    assert shim.shim_crc(data, len(data)) == protocol.crc16(data)


@given(st.tuples(*[st.floats(-(2.0**99), 2.0**99, width=32)] * 12), st.integers(0, 2**32 - 1))
def test_states_are_read_right(shim: ctypes.CDLL, numbers: tuple[float, ...], now_us: int) -> None:
    shim.shim_reset()
    first = state_at(shim, now_us, protocol.Status.SATURATED, *numbers)
    assert first.numbers == numbers
    assert (first.time_us, first.sequence, first.buttons, first.echo) == (now_us, 1, 0x8001, 0)
    assert first.status & protocol.Status.SATURATED
    assert state_at(shim, now_us, 0, *numbers).sequence == 2


@given(st.tuples(*[st.floats(-100.0, 100.0, width=32)] * 6), st.integers(0, 65535))
def test_firmware_obeys_host(shim: ctypes.CDLL, wrench: tuple[float, ...], sequence: int) -> None:
    shim.shim_reset()
    assert shim.shim_receive(protocol.force_frame(sequence, wrench, 20), 1000)
    assert wrench_at(shim, 1001) == wrench
    state = state_at(shim, 1002)
    assert (state.echo, state.status) == (sequence, protocol.Status.ENABLED)


@pytest.mark.parametrize("received_us", [0, 5_000_000, 2**32 - 10_000])
def test_watchdog_zeroes_in_time_across_clocks_wrap(shim: ctypes.CDLL, received_us: int) -> None:
    shim.shim_reset()
    shim.shim_receive(protocol.force_frame(1, WRENCH, 20), received_us)
    assert wrench_at(shim, (received_us + 19_999) % 2**32) == pytest.approx(WRENCH)
    assert state_at(shim, (received_us + 19_999) % 2**32).status == protocol.Status.ENABLED
    assert wrench_at(shim, (received_us + 20_000) % 2**32) == (0.0,) * 6
    assert state_at(shim, (received_us + 20_000) % 2**32).status & protocol.Status.WATCHDOG
    # the clock comes round to where the frame would be young again: it stays expired
    assert wrench_at(shim, received_us) == (0.0,) * 6
    shim.shim_receive(protocol.force_frame(2, WRENCH, 20), received_us)
    assert wrench_at(shim, received_us) == pytest.approx(WRENCH)


def test_no_watchdog_is_longer_than_a_second_and_none_stops_at_once(shim: ctypes.CDLL) -> None:
    shim.shim_reset()
    shim.shim_receive(protocol.force_frame(1, WRENCH, 65535), 0)
    assert wrench_at(shim, 999_999) != (0.0,) * 6
    assert wrench_at(shim, 1_000_000) == (0.0,) * 6
    shim.shim_receive(protocol.force_frame(2, WRENCH, 0), 0)
    assert wrench_at(shim, 0) == (0.0,) * 6


def test_motors_not_enabled_or_device_unfit_give_nothing(shim: ctypes.CDLL) -> None:
    shim.shim_reset()
    assert wrench_at(shim, 5) == (0.0,) * 6
    shim.shim_receive(protocol.force_frame(1, WRENCH, 20, is_enabled=False), 10)
    assert wrench_at(shim, 11) == (0.0,) * 6
    shim.shim_receive(protocol.force_frame(2, WRENCH, 20), 12)
    for status in (protocol.Status.FAULT, protocol.Status.NOT_READY):
        assert state_at(shim, 13, status).status & status
        assert wrench_at(shim, 14) == (0.0,) * 6
        state_at(shim, 15)
        assert wrench_at(shim, 16) == pytest.approx(WRENCH)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_force_not_finite_leaves_old_one_to_its_watchdog(shim: ctypes.CDLL, value: float) -> None:
    shim.shim_reset()
    shim.shim_receive(protocol.force_frame(1, WRENCH, 20), 0)
    for place in range(6):
        wrench = tuple(value if i == place else 0.0 for i in range(6))
        assert not shim.shim_receive(protocol.force_frame(2, wrench, 20), 10_000)
    assert wrench_at(shim, 10_001) == pytest.approx(WRENCH)
    assert wrench_at(shim, 20_000) == (0.0,) * 6


def test_damaged_frames_and_other_versions_and_kinds_change_nothing(shim: ctypes.CDLL) -> None:
    shim.shim_reset()
    shim.shim_receive(protocol.force_frame(1, WRENCH, 20), 0)
    good = protocol.force_frame(2, (0.0,) * 6, 20)
    for place in (0, 1, 2, 9, 62):
        assert not shim.shim_receive(good[:place] + bytes([good[place] ^ 4]) + good[place + 1 :], 1)
    assert state_at(shim, 2).status == protocol.Status.ENABLED | protocol.Status.DAMAGED
    assert wrench_at(shim, 3) == pytest.approx(WRENCH)
    shim.shim_receive(good, 4)
    assert state_at(shim, 5).status == protocol.Status.ENABLED


def test_the_firmware_answers_with_its_sheet_once_per_question(shim: ctypes.CDLL) -> None:
    shim.shim_reset()
    frame = ctypes.create_string_buffer(64)
    assert not shim.shim_answer(frame)
    shim.shim_receive(protocol.ask_frame(1, 0), 0)
    assert shim.shim_answer(frame)
    numbers = protocol.decoded(frame.raw)
    assert isinstance(numbers, protocol.Numbers)
    assert numbers.axis_names == ("x", "rz")
    assert not numbers.has_grip
    sheet = (990.0, None, 0.4, None, 0.01, 0.05, 1.5e-5, 4.0, 0.1, 2.0, 5e-4, 0.0, 0.0)
    assert tuple(numbers.known().values()) == sheet
    shim.shim_receive(protocol.ask_frame(2, 1), 0)
    assert shim.shim_answer(frame)
    assert protocol.decoded(frame.raw) == "shim"
    shim.shim_receive(protocol.ask_frame(3, 2), 0)
    assert not shim.shim_answer(frame)


def test_the_firmware_has_a_grip_axis_where_its_sheet_says_so(shim: ctypes.CDLL) -> None:
    shim.shim_grip_state.argtypes = ctypes.c_float, ctypes.c_float, ctypes.c_char_p
    shim.shim_grip_force.restype = ctypes.c_float
    frame = ctypes.create_string_buffer(64)
    for is_there in (False, True):
        (shim.shim_reset_with_grip if is_there else shim.shim_reset)()
        shim.shim_receive(protocol.ask_frame(1, 2), 0)
        assert bool(shim.shim_answer(frame)) == is_there
        shim.shim_receive(protocol.force_frame(1, (0.0,) * 6 + (-3.5,), 20), 0)
        assert shim.shim_grip_force(10) == -3.5  # a device without a grip has no motor for it
        assert shim.shim_grip_force(20_000) == 0.0  # its watchdog
    numbers = protocol.decoded(frame.raw)
    assert isinstance(numbers, protocol.GripNumbers)
    expected = GRIP.known()
    assert numbers.known() == expected
    shim.shim_grip_state(0.012, -0.1, frame)
    state = protocol.decoded(frame.raw)
    assert isinstance(state, protocol.State)
    assert state.numbers[9:] == pytest.approx((0.012, -0.1, 0.0))
    bad = protocol.force_frame(2, (0.0,) * 6 + (math.inf,), 20)
    assert not shim.shim_receive(bad, 5)


@pytest.fixture(scope="module")
def sketch_files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Libraries of both sketches, by the link that they use."""
    files = {}
    for link in ("rawhid", "serial"):
        folder = tmp_path_factory.mktemp(link)
        (folder / "Encoder.h").write_text(
            "struct Encoder { Encoder(int, int) {} int read() { return encoder_count; } };\n"
        )
        name = FIRMWARE / f"hapticbridge_{link}.ino"
        built(folder, f'-DSKETCH="{name}"', "-DTEENSYDUINO")
        files[link] = folder / LIBRARY
    return files


def switched_on(file: Path, folder: Path) -> ctypes.CDLL:
    """A sketch of the test's own at time 0: a copy of the file has variables of its own."""
    sketch = ctypes.CDLL(str(shutil.copy(file, folder)))
    sketch.sketch_setup()
    return sketch


@pytest.fixture
def sketch(sketch_files: dict[str, Path], tmp_path: Path) -> ctypes.CDLL:
    return switched_on(sketch_files["rawhid"], tmp_path)


def states_of(sketch: ctypes.CDLL) -> list[protocol.State]:
    frame, states = ctypes.create_string_buffer(64), []
    while sketch.sketch_fetch(frame):
        states.append(protocol.decoded(frame.raw))
    return [state for state in states if isinstance(state, protocol.State)]


PWM, DIRECTION = 5, 8


def test_sketch_streams_below_hosts_rate_and_counts_every_frame(sketch: ctypes.CDLL) -> None:
    sketch.sketch_turn(1000)
    sketch.sketch_run(1_010_010, 1)
    states = states_of(sketch)
    assert len(states) == 1000
    assert {b.sequence - a.sequence for a, b in pairwise(states)} == {1}
    # half a turn of 2000 counts on a pulley of 5 mm, sector 75 mm, handle at 70 mm
    assert states[-1].numbers[0] == pytest.approx(math.pi * 0.005 / 0.075 * 0.070, rel=1e-6)


def test_the_sketch_pushes_as_told_and_its_interrupt_lets_go(sketch: ctypes.CDLL) -> None:
    for force, direction in ((2.0, 1), (-2.0, 0)):
        sketch.sketch_send(protocol.force_frame(1, (force, 0.0, 0.0, 0.0, 0.0, 0.0), 20))
        sketch.sketch_run(2_000, 1)
        # F x travel per radian / torque constant x resistance / supply, of 1023 steps
        duty = 2.0 * 0.070 * 0.005 / 0.075 / 0.0136 * 2.5 / 12.0
        assert sketch.sketch_pin(PWM) == pytest.approx(1023 * min(duty, 0.2), abs=1)
        assert sketch.sketch_pin(DIRECTION) == direction
    sketch.sketch_run(17_000, 0)
    assert sketch.sketch_pin(PWM) > 0
    sketch.sketch_run(2_000, 0)
    assert sketch.sketch_pin(PWM) == 0


def turn(sketch: ctypes.CDLL, link: str, steps: int) -> float:
    """Turns the motor from its start; returns the handle's way in m."""
    if link == "rawhid":
        sketch.sketch_turn(steps)
    else:
        sketch.sketch_sense(500 + steps)
    return steps / (2000 if link == "rawhid" else 1960) * 2.0 * math.pi * TRAVEL


def hand_over(sketch: ctypes.CDLL, link: str, frame: bytes) -> None:
    if link == "rawhid":
        sketch.sketch_send(frame)
    else:
        sketch.sketch_line(frame, len(frame))


TRAVEL = 0.070 * 0.005 / 0.075
"""Way of the handle in m per rad of the motor."""


@pytest.mark.parametrize(("link", "whole"), [("rawhid", 1023), ("serial", 255)])
def test_a_sketch_renders_a_wall_by_itself(
    sketch_files: dict[str, Path], tmp_path: Path, link: str, whole: int
) -> None:
    sketch = switched_on(sketch_files[link], tmp_path)
    setting = BoardSetting(5e3, 0.0, 2.0, 0.0, 0.01)
    hand_over(sketch, link, protocol.setting_frame(1, setting))
    wall = (((1.0, 0.0, 0.0), 0.0),)
    for sequence in range(2, 7):
        tool = ShownTool((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0, wall)
        hand_over(sketch, link, protocol.show_frames(sequence, tool, 50)[0])
        sketch.sketch_run(10_000, 1)
        depth = turn(sketch, link, -10 * (sequence > 3))
    duty = -5e3 * depth * TRAVEL / 0.0136 * 2.5 / 12.0
    assert sketch.sketch_pin(PWM) == pytest.approx(whole * duty, abs=1)
    assert sketch.sketch_pin(DIRECTION) == 1
    sketch.sketch_run(35_000, 0)  # loop() hangs: the interrupt renders it until patience ends
    assert sketch.sketch_pin(PWM) == pytest.approx(whole * duty, abs=1)
    sketch.sketch_run(25_000, 0)
    assert sketch.sketch_pin(PWM) == 0


def test_the_serial_sketch_tells_of_its_loop_and_never_waits(
    sketch_files: dict[str, Path], tmp_path: Path
) -> None:
    sketch = switched_on(sketch_files["serial"], tmp_path)
    tool = ShownTool((0.0,) * 3)
    for frame in (protocol.ask_frame(1, 0), protocol.show_frames(2, tool, 50)[0]):
        sketch.sketch_line(frame, 64)
    sketch.sketch_run(101_000, 1)
    data = ctypes.create_string_buffer(1 << 14)
    count = sketch.sketch_take(data, len(data))
    frames = protocol.FrameReader().take(data.raw[:count])
    told = [protocol.decoded(frame) for frame in frames]
    sheet = next(each for each in told if isinstance(each, protocol.Numbers))
    assert (sheet.loop_rate, sheet.loop_delay) == pytest.approx((10e3, 140e-6))
    loops = [each for each in told if isinstance(each, LoopState)]
    reports = [each for each in told if isinstance(each, LoopReport)]
    assert len(loops) + len(reports) >= 95  # a frame in each millisecond, from the second on
    assert reports[-1].ticks > 900
    assert {each.missed for each in reports} == {0}
    assert sketch.sketch_overrun() == 0  # Serial never got a byte that it had no room for


TIMER = "void hb_start_timer(void (*tick)(), uint32_t) { (void)tick; }"


def test_a_board_whose_timer_is_unknown_is_refused_by_the_compiler(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    name = f'-DSKETCH="{FIRMWARE / "hapticbridge_serial.ino"}"'
    with pytest.raises(subprocess.CalledProcessError):
        built(tmp_path, name)
    assert "define HB_OWN_TIMER and hb_start_timer()" in capfd.readouterr().err
    own = tmp_path / "own.ino"
    own.write_text(f'#include "{FIRMWARE / "hapticbridge_serial.ino"}"\n{TIMER}\n')
    assert built(tmp_path, f'-DSKETCH="{own}"', "-DHB_OWN_TIMER")


def test_what_the_sketch_does_with_interrupts_off_keeps_them_off(sketch: ctypes.CDLL) -> None:
    sketch.sketch_send(protocol.force_frame(1, WRENCH, 20))
    sketch.sketch_run(1_010 * 3 + 10, 1)
    assert sketch.sketch_sections() == 10  # a force frame, and three for each of three states
    assert sketch.sketch_broken_sections() == 0


ARM = """#define HB_SKETCH_POSE
#include "hb_sketch.h"

static HbSheet my_sheet() {
  HbSheet sheet = hb_unknown_sheet();
  sheet.name = "arm";
  sheet.axes = HB_X | HB_Y | HB_Z | HB_RX | HB_RY | HB_RZ;
  sheet.rate = 495.0f;
  sheet.force_limit = 5.0f;
  sheet.torque_limit = 0.3f;
  sheet.speed_limit = 2.0f;
  sheet.loop_delay = 1e-5f;
  return sheet;
}

void read_pose(float position[3], float rotation[4]) {
  const float turn[3] = {0.0f, 0.0f, 1e-4f * (float)encoder_count};
  position[0] = 1e-6f * (float)encoder_count;
  hb_turned(turn, rotation, rotation);
}

void write_wrench(const float force[3], const float torque[3]) {
  analogWrite(1, (int)(1e3f * force[0]));
  analogWrite(2, (int)(1e6f * torque[2]));
}

HbSketch device(my_sheet(), 100);

void control_tick() { device.tick(); }

void setup() { device.start(control_tick); }

void loop() {
  uint8_t frame[HB_FRAME_BYTES];
  while (RawHID.recv(frame, 0) > 0) {
    device.receive(frame);
    if (device.answer(frame)) RawHID.send(frame, 100);
  }
  if (device.state(0, 0, frame)) RawHID.send(frame, 0);
  if (device.more(frame)) RawHID.send(frame, 0);
}
"""


def test_the_sketch_of_an_arm_tells_and_renders_its_rotation(tmp_path: Path) -> None:
    (tmp_path / "arm.ino").write_text(ARM)
    built(tmp_path, f'-DSKETCH="{tmp_path / "arm.ino"}"', "-DTEENSYDUINO")
    sketch = switched_on(tmp_path / LIBRARY, tmp_path / "arm.so")
    for count in range(100):  # at 1 rad/s
        sketch.sketch_turn(50 * count)
        sketch.sketch_run(5_000, 1)
    last = states_of(sketch)[-1]
    assert last.numbers[5] == pytest.approx(0.495, rel=1e-5)
    assert last.numbers[0] == pytest.approx(4950e-6, rel=1e-5)
    sketch.sketch_send(protocol.ask_frame(1, 0))
    sketch.sketch_send(protocol.setting_frame(1, BoardSetting(0, 0, 0, 0, 0.01, 1e-3, 5.0, 0, 0.3)))
    for sequence in range(2, 12):
        tool = ShownTool((0.00495, 0.0, 0.0), (0.0,) * 3, rotation=(0.0, 0.0, 0.495))
        sketch.sketch_send(protocol.show_frames(sequence, tool, 50, is_posed=True)[0])
        sketch.sketch_turn(4950 - 10 * (sequence - 2))
        sketch.sketch_run(10_000, 1)
    assert sketch.sketch_pin(2) == pytest.approx(5.0 * 9e-3 * 1e6, rel=0.01)
    assert sketch.sketch_pin(1) == 0
    frame, told = ctypes.create_string_buffer(64), []
    while sketch.sketch_fetch(frame):
        told.append(protocol.decoded(frame.raw))
    (sheet,) = (each for each in told if isinstance(each, protocol.Numbers))
    assert sheet.is_posed
    at = [k for k, each in enumerate(told) if isinstance(each, LoopState)]
    assert all(isinstance(told[k + 1], protocol.LoopTurn) for k in at[:-1])
    assert len(at) > 40
    half = told[at[-2] + 1]
    assert isinstance(half, protocol.LoopTurn)
    assert half.rotation[2] == pytest.approx(0.486, abs=1e-5)
    assert half.torque[2] == pytest.approx(0.045, rel=0.01)
    sketch.sketch_run(100_000, 0)  # loop() hangs: its interrupt lets go after the patience
    assert sketch.sketch_pin(2) == 0
