"""Boards on a serial port: framing, recognition, delay, errors, and the compiled Hapkit sketch."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import importlib
import itertools
import os
import pty
import threading
import time
import tty
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from device_benches import mechanics
from emulated.hid_seam import DrivingClock
from emulated.rawhid_model import NAN, Claims, RawHid
from emulated.serial_seam import SerialSeam, VirtualPort
from firmware_build import COMPILER, FIRMWARE, built
from hypothesis import given
from hypothesis import strategies as st
from waiting import until

from hapticbridge.device import SimulatedDevice, open_device
from hapticbridge.device.driver import ignore_message
from hapticbridge.device.own_loop import BoardSetting, ShownTool
from hapticbridge.device.rawhid import protocol
from hapticbridge.device.rawhid.device import RawHidDevice
from hapticbridge.device.rawhid.serial import BAUDS, SystemPorts, open_serial
from hapticbridge.errors import DeviceError, DeviceLost, IdentificationError
from hapticbridge.identify import identify
from hapticbridge.kernel.record import SAMPLE_DTYPE, TickFlag

# Framing

faults = st.lists(
    st.tuples(st.sampled_from(["lose", "double", "flip"]), st.integers(0, 63), st.integers(1, 255)),
    max_size=3,
)
wrenches = st.tuples(*[st.floats(-100.0, 100.0, width=32)] * 6)
lines = st.lists(st.tuples(wrenches, faults), min_size=1, max_size=8)


def frames_of(line: list[tuple[tuple[float, ...], Any]]) -> tuple[list[bytes], bytes, list[bytes]]:
    """Returns the frames as sent, the bytes that arrive, and the frames without a fault."""
    sent, arriving, whole = [], b"", []
    for number, (wrench, hits) in enumerate(line):
        frame = protocol.force_frame(number, wrench, 20)
        data = bytearray(frame)
        for kind, place, bits in hits:
            at = place % len(data)
            if kind == "lose":
                del data[at]
            elif kind == "double":
                data.insert(at, data[at])
            else:
                data[at] ^= bits
        sent.append(frame)
        arriving += bytes(data)
        if not hits:
            whole.append(frame)
    return sent, arriving, whole


LAST = [protocol.force_frame(1000 + n, (1.0,) + (0.0,) * 5, 20) for n in range(3)]


def is_part(some: list[bytes], of: list[bytes]) -> bool:
    rest = iter(of)
    return all(any(frame == other for other in rest) for frame in some)


@given(lines, st.binary(max_size=40), st.lists(st.integers(1, 100), max_size=30))
def test_a_fault_on_the_line_costs_only_the_frames_that_it_touched(
    line: list[Any], noise: bytes, cuts: list[int]
) -> None:
    sent, arriving, whole = frames_of(line)
    data = noise + arriving + b"".join(LAST)
    reader, found, place = protocol.FrameReader(), [], 0
    for size in (*cuts, len(data)):  # as it comes, in pieces
        found += reader.take(data[place : place + size])
        place += size
    assert is_part([*whole, *LAST[:2]], found)
    assert is_part(found, [*sent, *LAST])
    if not noise and len(whole) == len(sent):
        assert (found, reader.dropped) == ([*sent, *LAST], 0)
    else:
        assert 0 <= reader.dropped <= len(data) - 64 * len(found)


@pytest.fixture(scope="module", name="shim")
def _shim(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    return built(tmp_path_factory.mktemp("firmware"))


needs_compiler = pytest.mark.skipif(COMPILER is None, reason="neither g++ nor clang++ is here")


@needs_compiler
@given(lines, st.binary(max_size=40))
def test_the_firmware_finds_its_way_back_too(
    shim: ctypes.CDLL, line: list[Any], noise: bytes
) -> None:
    shim.shim_reset()
    sent, arriving, whole = frames_of(line)
    data = noise + arriving
    count = shim.shim_line(data, len(data), 0)
    count += shim.shim_line(b"".join(LAST), 192, 1)
    assert len(whole) + 2 <= count <= len(sent) + 3
    frame = ctypes.create_string_buffer(64)
    shim.shim_state((ctypes.c_float * 12)(), 0, 0, 2, frame)
    state = protocol.decoded(frame.raw)
    assert isinstance(state, protocol.State)
    assert state.echo in (1001, 1002)
    if not noise and len(whole) == len(sent):
        assert (count, state.echo) == (len(sent) + 3, 1002)
        assert not state.status & protocol.Status.DAMAGED


# A board in virtual time


def hapkit(rate: float = 500.0, **numbers: float) -> RawHid:
    """Returns a board of one axis with a quantised encoder, which nobody holds."""
    claims = Claims(
        axes=0b1, rate=rate, mass=NAN, damping=NAN, rotational_inertia=NAN, rotational_damping=NAN,
        friction=NAN, resolution=1.5e-5, force_limit=4.0, torque_limit=NAN, speed_limit=2.0,
        delay=5e-4,
    )  # fmt: skip
    return RawHid(SimulatedDevice(hand=None, **numbers), claims, title="Hapkit")  # type: ignore[arg-type]


def opened(seam: SerialSeam, **options: object) -> RawHidDevice:
    return open_serial(options, ignore_message, seam)


@pytest.mark.parametrize(("seed", "rate"), [(0, 500.0), (1, 501.0)])
def test_identify_is_right_within_its_intervals_on_a_hapkit_with_2_ms_of_latency(
    seed: int, rate: float
) -> None:
    true = mechanics(seed)
    seam = SerialSeam(hapkit(rate, **true), latency=1e-3)
    device = opened(seam)
    clock = DrivingClock(VirtualPort(seam))
    try:
        fit = identify(device, clock, period=2e-3, axes=("x",), duration=12.0).fits["x"]
    finally:
        device.close()
    for name, value in true.items():
        estimate = getattr(fit, name)
        assert estimate.least <= value <= estimate.most, name
        assert estimate.value == pytest.approx(value, rel=0.08), name
    assert device.info.delay is not None
    assert fit.delay.least <= device.info.delay  # the sheet promises no less than there is


def test_a_line_that_stalls_for_a_moment_is_no_jump_of_the_pose() -> None:
    seam = SerialSeam(hapkit(**mechanics(0)), latency=1e-3)
    device = opened(seam, speed_limit=0.5)
    clock = DrivingClock(Stalling(seam))
    try:
        run = identify(device, clock, period=2e-3, axes=("x",), duration=6.0)
    finally:
        device.close()
    assert run.fits["x"].mass.value == pytest.approx(mechanics(0)["mass"], rel=0.1)


class Stalling(VirtualPort):
    """A line that delivers nothing for 40 ms of every second."""

    def advance(self, now: float) -> None:
        self._seam.is_mute = now % 1.0 < 0.04
        super().advance(now)

    now = property(lambda self: self._seam.time, advance)


def test_a_loop_twice_as_fast_as_the_board_is_told_to_be_slower() -> None:
    seam = SerialSeam(hapkit(**mechanics(0)))
    device, clock = opened(seam), DrivingClock(VirtualPort(seam))
    with pytest.raises(IdentificationError, match=r"50% of the ticks brought no new sample; choo"):
        identify(device, clock, period=1e-3, axes=("x",), duration=2.0)


def test_the_delay_of_the_data_sheet_is_the_measured_one() -> None:
    told: list[str] = []
    seam = SerialSeam(hapkit(), latency=1e-3)
    device = open_serial({}, told.append, seam)
    # both ways, the wait for the next state (2 ms at most), and 0.5 ms that the board reports
    assert 2.5e-3 <= (device.info.delay or 0.0) <= 5e-3
    assert "at 1000000 baud: a force is confirmed within" in told[-1]
    slow = opened(SerialSeam(hapkit(), latency=4e-3))
    assert (slow.info.delay or 0.0) - (device.info.delay or 0.0) == pytest.approx(6e-3, abs=1e-3)


@pytest.mark.parametrize("baud", BAUDS)
def test_the_baud_rate_is_found_and_a_wrong_one_is_named(baud: int) -> None:
    told: list[str] = []
    device = open_serial({}, told.append, SerialSeam(hapkit(), baud=baud))
    assert f"at {baud} baud" in told[-1]
    assert (device.info.name, device.info.serial) == ("Hapkit", "H1")
    with pytest.raises(DeviceError, match=r"sends bytes, but no frames .* at 9600 baud; set its"):
        opened(SerialSeam(hapkit(), baud=baud), baud=9600)


def test_a_silent_board_and_one_that_confirms_nothing_are_refused() -> None:
    seam = SerialSeam(hapkit())
    seam.board.is_silent = True
    seam.board.output = lambda report, now: None  # type: ignore[method-assign]
    with pytest.raises(DeviceError, match=r"Hapkit .* is silent at 1000000 or 500000 or .* baud"):
        opened(seam)
    seam.board.is_silent = False
    with pytest.raises(DeviceError, match="confirms no force frame"):
        opened(seam)
    assert seam.opened is not None
    assert not seam.opened.is_open  # a port that is refused is released


def test_a_board_of_another_version_is_told_so() -> None:
    seam = SerialSeam(hapkit())
    take = seam.board.take_report

    def newer() -> bytes | None:
        if (report := take()) is None:
            return None
        body = report[:1] + b"\2" + report[2:62]
        return body + protocol.crc16(body).to_bytes(2, "little")

    seam.board.take_report = newer  # type: ignore[method-assign]
    with pytest.raises(DeviceError, match="speaks version 2 of the raw HID protocol; version 1 is"):
        opened(seam)


def test_an_unplugged_or_silent_board_ends_the_run_and_closing_switches_it_off() -> None:
    seam = SerialSeam(hapkit())
    device, sample = opened(seam), np.zeros(1, SAMPLE_DTYPE)
    device.start(2e-3)
    for _ in range(5):
        seam.advance(seam.time + 2e-3)
        assert device.read(sample) == 0
        device.write(np.array([1.0, 0, 0, 0, 0, 0]))
    assert seam.board.is_enabled
    assert seam.board.wrench[0] == pytest.approx(1.0)
    seam.advance(seam.time + 0.03)  # nothing is written: the board's watchdog
    assert not seam.board.wrench.any()
    device.read(sample)
    device.write(np.array([1.0, 0, 0, 0, 0, 0]))
    device.close()
    seam.advance(seam.time + 2e-3)
    assert not seam.board.is_enabled

    for fault in ("is_silent", "is_there"):
        seam = SerialSeam(hapkit())
        device = opened(seam)
        device.start(2e-3)
        device.read(sample)
        seam.board.is_silent = fault == "is_silent"
        seam.is_there = fault != "is_there"
        words = "sent nothing for" if seam.is_there else "is gone: unplugged"
        with pytest.raises(DeviceLost, match=words):
            for _ in range(40):
                seam.advance(seam.time + 2e-3)
                device.read(sample)
        device.close()


def started() -> tuple[SerialSeam, RawHidDevice, Any]:
    seam = SerialSeam(hapkit())
    device = opened(seam)
    device.start(2e-3)
    return seam, device, seam.opened


def test_a_frame_waits_for_the_one_before_and_only_the_newest_is_sent() -> None:
    seam, device, port = started()
    port.out_waiting = 64
    for force in (1.0, 2.0):
        device.write(np.array([force, 0, 0, 0, 0, 0]))
    assert not seam.to_board
    port.out_waiting = 0
    device.write(np.array([3.0, 0, 0, 0, 0, 0]))
    assert len(seam.to_board) == 1
    seam.advance(seam.time + 2e-3)
    assert seam.board.wrench[0] == pytest.approx(3.0)
    device.close()


def test_a_port_that_takes_no_bytes_ends_the_run_and_is_released() -> None:
    seam, device, port = started()
    port.out_waiting = 64
    device.write(np.ones(6))
    seam.advance(seam.time + 0.06)
    with pytest.raises(DeviceLost, match="accepts no bytes any more; unplug it and plug it in"):
        device.write(np.ones(6))
    device.close()
    assert (port.discarded, port.is_open) == (64, False)
    _, device, port = started()
    port.taken = 10
    with pytest.raises(DeviceLost, match="accepts no bytes any more"):
        device.write(np.ones(6))
    device.close()


def test_after_a_long_pause_the_pose_is_of_now_and_not_of_a_full_queue() -> None:
    seam, device, _ = started()
    seam.advance(seam.time + 0.3)
    device.read(np.zeros(1, SAMPLE_DTYPE))
    assert device.states.newest is not None
    assert device.states.newest.time_us == pytest.approx(1e6 * seam.time, abs=5e3)


# Ports of this machine, through pyserial


def test_a_port_that_cannot_be_opened_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(DeviceError, match=r"there is no serial port /dev/ttyNONE; "):
        open_device("serial:/dev/ttyNONE,baud=115200")
    with pytest.raises(DeviceError, match=r"no serial port of serial 'H7' is plugged in on USB"):
        open_device("serial:serial=H7")
    with pytest.raises(DeviceError, match=r"baud is -1 bit/s; it must be finite and > 0"):
        open_device("serial:/dev/ttyNONE,baud=-1")
    serial: Any = importlib.import_module("serial")

    def refused(*_: object, **__: object) -> None:
        raise serial.SerialException(errno.EACCES, "no")

    monkeypatch.setattr(serial, "Serial", refused)
    with pytest.raises(DeviceError, match=r"no permission to open /dev/null; .* usermod -aG \w+ "):
        open_device("serial:/dev/null")


def test_ports_on_usb_are_listed_without_opening_them(monkeypatch: pytest.MonkeyPatch) -> None:
    listing = importlib.import_module("serial.tools.list_ports")
    common = importlib.import_module("serial.tools.list_ports_common")
    board, old = common.ListPortInfo("/dev/ttyACM7"), common.ListPortInfo("/dev/ttyS0")
    board.vid, board.pid, board.serial_number, board.product = 0x2341, 0x43, "A1", "Arduino Uno"
    monkeypatch.setattr(listing, "comports", lambda: [board, old])
    (found,) = SystemPorts().found()
    assert (found.path, str(found)) == ("/dev/ttyACM7", "Arduino Uno (2341:0043, serial A1)")
    assert "no node /dev/ttyACM7" in (found.problem or "")


# The sketch, compiled, behind a pseudo-terminal and real pyserial

PWM, DIRECTION = 5, 8


class Board:
    """The compiled sketch in real time, with its serial line on a pseudo-terminal.

    Attributes:
        path: The port.
    """

    def __init__(self, sketch: ctypes.CDLL) -> None:
        self.sketch = sketch
        self._master, slave = pty.openpty()
        tty.setraw(slave)
        os.set_blocking(self._master, False)
        self.path, self._slave = os.ttyname(slave), slave
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        data, before = ctypes.create_string_buffer(4096), time.monotonic_ns()
        while not self._ended.wait(0.5e-3):
            with contextlib.suppress(OSError):  # nothing came
                received = os.read(self._master, 4096)
                self.sketch.sketch_line(received, len(received))
            now = time.monotonic_ns()
            steps = min((now - before) // 10_000, 5000)
            before += 10_000 * steps
            self.sketch.sketch_run(int(10 * steps), 1)
            count = self.sketch.sketch_take(data, 4096)
            if count:
                with contextlib.suppress(OSError):  # nobody reads
                    os.write(self._master, data.raw[:count])

    def unplug(self) -> None:
        if not self._ended.is_set():
            self._ended.set()
            self._thread.join(10.0)
            os.close(self._slave)
            os.close(self._master)


def switched_on(folder: Path, option: str) -> Iterator[Board]:
    """The sketch for a processor of Arduino's or a Teensy's name."""
    if COMPILER is None:
        pytest.skip("neither g++ nor clang++ is here to compile the firmware with")
    (folder / "avr").mkdir()
    (folder / "avr/wdt.h").write_text(
        "enum { WDTO_15MS };\nstatic int fed = 0;\n"
        "static void wdt_enable(int) { fed = 1; }\nstatic void wdt_reset() { fed++; }\n"
        'extern "C" int sketch_fed() { return fed; }\n'
    )
    name = FIRMWARE / "hapticbridge_serial.ino"
    sketch = built(folder, f'-DSKETCH="{name}"', option)
    sketch.sketch_setup()
    board = Board(sketch)
    yield board
    board.unplug()


@pytest.fixture(name="board")
def _board(tmp_path: Path) -> Iterator[Board]:
    yield from switched_on(tmp_path, "-D__AVR__")


@pytest.fixture(name="fast_board")
def _fast_board(tmp_path: Path) -> Iterator[Board]:
    yield from switched_on(tmp_path, "-DTEENSYDUINO")


class SlowClock(SystemPorts):
    """Real ports in a time that a busy machine keeps: its stalls are no silence of the board."""

    def now(self) -> float:
        return super().now() / 5.0


def test_the_hapkit_sketch_runs_behind_pyserial_and_lets_go_by_itself(board: Board) -> None:
    told: list[str] = []
    device = open_serial({"port": board.path}, told.append, SlowClock())
    info, sample = device.info, np.zeros(1, SAMPLE_DTYPE)
    assert (info.name, info.axes, info.rate) == ("Hapkit", ("x",), 500.0)
    assert "at 1000000 baud" in told[-1]
    assert info.delay is not None
    assert info.delay >= 0.5e-3 + 2 * 0.64e-3 / 5.0  # the board's own, and a frame each way
    device.start(2e-3)

    def read() -> float:
        end = time.monotonic() + 20.0
        while device.read(sample) == TickFlag.STALE_SAMPLE and time.monotonic() < end:
            time.sleep(0.2e-3)
        return float(sample["position"][0, 0])

    assert read() == 0.0
    board.sketch.sketch_sense(600)
    # 100 of 1960 steps a turn, on a pulley of 5 mm, sector of 75 mm, handle at 70 mm
    moved = 100 / 1960 * 2 * np.pi * 0.070 * 0.005 / 0.075
    until(lambda: read() == pytest.approx(moved, rel=1e-5))

    def pushed(force: float) -> int:
        device.write(np.array([force, 0, 0, 0, 0, 0]))
        read()
        return int(board.sketch.sketch_pin(PWM))

    # F x travel per radian / torque constant x resistance / supply, of 255 steps
    duty = round(255 * 0.5 * 0.070 * 0.005 / 0.075 / 0.0136 * 2.5 / 12.0)
    until(lambda: pushed(-0.5) == duty)
    assert board.sketch.sketch_pin(DIRECTION) == 0
    assert board.sketch.sketch_fed() > 1
    until(lambda: board.sketch.sketch_pin(PWM) == 0)  # nothing is written: its watchdog
    device.close()


def test_a_board_with_a_loop_renders_a_wall_behind_pyserial(fast_board: Board) -> None:
    device = open_serial({"port": fast_board.path}, ignore_message, SlowClock())
    sample = np.zeros(1, SAMPLE_DTYPE)
    assert device.info.loop_period == pytest.approx(1e-4)
    assert device.info.loop_delay == pytest.approx(140e-6)
    device.start(1e-3)
    wall = ShownTool((0.0,) * 3, (0.0,) * 3, 0.0, (((1.0, 0.0, 0.0), 0.0),))
    calls = itertools.count()

    def felt() -> float:
        device.show(wall)
        if next(calls) % 5 == 0:
            device.set_loop(BoardSetting(5e3, 0.0, 2.0, 0.0, 0.01))
        device.read(sample)
        return 0.0 if device.loop_state is None else device.loop_state.force[0]

    until(lambda: felt() == 0.0 and device.loop_report and device.loop_report.share == 1.0)
    depth = 10 / 1960 * 2 * np.pi * 0.070 * 0.005 / 0.075

    def is_stopped() -> bool:
        # by 10 of 1960 steps a turn; a hand that was in the wall when this process stalled, and the
        # force had faded, comes anew from outside
        fast_board.sketch.sketch_sense(500 if next(calls) % 100 < 20 else 490)
        is_felt = felt() == pytest.approx(5e3 * depth, rel=1e-3)
        return is_felt and fast_board.sketch.sketch_pin(PWM) > 0

    until(is_stopped)
    assert fast_board.sketch.sketch_pin(DIRECTION) == 1
    until(lambda: fast_board.sketch.sketch_pin(PWM) == 0)  # nothing is shown: its patience ends
    device.close()


def test_a_port_named_by_a_link_has_a_guardian_too(board: Board, tmp_path: Path) -> None:
    link = tmp_path / "usb-Arduino_Uno-if00"
    link.symlink_to(board.path)
    device = open_device(f"serial:{link}")
    assert isinstance(device, RawHidDevice)
    assert device.last_word is not None
    device.close()


def test_a_port_in_use_is_refused_and_an_unplugged_one_ends_the_run(board: Board) -> None:
    device, sample = open_device(f"serial:{board.path}"), np.zeros(1, SAMPLE_DTYPE)
    assert isinstance(device, RawHidDevice)
    assert device.last_word is not None  # a second process ends the force of a bridge that dies
    with pytest.raises(DeviceError, match=rf"{board.path} is in use by another program"):
        open_device(f"serial:{board.path}")
    device.start(2e-3)
    board.unplug()
    with pytest.raises(DeviceLost, match="is gone: unplugged, or switched off"):
        for _ in range(1000):
            device.read(sample)
            time.sleep(1e-3)
    device.close()
