"""The reference firmware, compiled for this machine: its protocol, and the sketch around it."""

from __future__ import annotations

import ctypes
import math
import shutil
import subprocess
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hapticbridge.device.rawhid import device as driver
from hapticbridge.device.rawhid.protocol import (
    Numbers,
    State,
    Status,
    ask_frame,
    crc16,
    decoded,
    force_frame,
)

FIRMWARE = Path(driver.__file__).with_name("firmware")
SHIM = Path(__file__).with_name("rawhid_firmware_shim.cpp")
COMPILER = shutil.which("g++") or shutil.which("clang++")
WRENCH = (1.0, -0.5, 0.25, 0.01, -0.02, 0.03)

pytestmark = pytest.mark.skipif(
    COMPILER is None, reason="neither g++ nor clang++ is here to compile the firmware with"
)


def built(folder: Path, *options: str) -> ctypes.CDLL:
    library = folder / "firmware.so"
    subprocess.run(
        [str(COMPILER), "-std=c++11", "-Wall", "-Wextra", "-Werror", "-O1", "-shared", "-fPIC",
         f"-I{FIRMWARE}", f"-I{folder}", *options, "-o", str(library),
         str(SHIM), str(FIRMWARE / "hb_protocol.cpp")],
        check=True,
    )  # fmt: skip
    return ctypes.CDLL(str(library))


@pytest.fixture(scope="module", name="shim")
def _shim(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    return built(tmp_path_factory.mktemp("firmware"))


def wrench_at(shim: ctypes.CDLL, now_us: int) -> tuple[float, ...]:
    numbers = (ctypes.c_float * 6)()
    shim.shim_wrench(now_us, numbers)
    return tuple(numbers)


def state_at(shim: ctypes.CDLL, now_us: int, status: int = 0, *numbers: float) -> State:
    frame = ctypes.create_string_buffer(64)
    values = (ctypes.c_float * 12)(*(numbers or [0.0] * 12))
    shim.shim_state(values, 0x8001, status, now_us, frame)
    state = decoded(frame.raw)
    assert isinstance(state, State)
    return state


@given(st.binary(max_size=100))
def test_both_crcs_agree(shim: ctypes.CDLL, data: bytes) -> None:
    assert shim.shim_crc(data, len(data)) == crc16(data)


@given(
    st.tuples(*[st.floats(-(2.0**99), 2.0**99, width=32)] * 12),
    st.integers(0, 2**32 - 1),
)
def test_the_host_reads_the_state_that_the_firmware_writes(
    shim: ctypes.CDLL, numbers: tuple[float, ...], now_us: int
) -> None:
    shim.shim_reset()
    first = state_at(shim, now_us, Status.SATURATED, *numbers)
    assert first.numbers == numbers
    assert (first.time_us, first.sequence, first.buttons, first.echo) == (now_us, 1, 0x8001, 0)
    assert first.status & Status.SATURATED
    assert state_at(shim, now_us, 0, *numbers).sequence == 2


@given(st.tuples(*[st.floats(-100.0, 100.0, width=32)] * 6), st.integers(0, 65535))
def test_the_firmware_obeys_the_force_that_the_host_writes(
    shim: ctypes.CDLL, wrench: tuple[float, ...], sequence: int
) -> None:
    shim.shim_reset()
    assert shim.shim_receive(force_frame(sequence, wrench, 20), 1000)
    assert wrench_at(shim, 1001) == wrench
    state = state_at(shim, 1002)
    assert (state.echo, state.status) == (sequence, Status.ENABLED)


@pytest.mark.parametrize("received_us", [0, 5_000_000, 2**32 - 10_000])
def test_the_watchdog_zeroes_the_wrench_in_time_across_the_clocks_wrap(
    shim: ctypes.CDLL, received_us: int
) -> None:
    shim.shim_reset()
    shim.shim_receive(force_frame(1, WRENCH, 20), received_us)
    assert wrench_at(shim, (received_us + 19_999) % 2**32) == pytest.approx(WRENCH)
    assert state_at(shim, (received_us + 19_999) % 2**32).status == Status.ENABLED
    assert wrench_at(shim, (received_us + 20_000) % 2**32) == (0.0,) * 6
    assert state_at(shim, (received_us + 20_000) % 2**32).status & Status.WATCHDOG
    # the clock comes round to where the frame would be young again: it stays expired
    assert wrench_at(shim, received_us) == (0.0,) * 6
    shim.shim_receive(force_frame(2, WRENCH, 20), received_us)
    assert wrench_at(shim, received_us) == pytest.approx(WRENCH)


def test_no_watchdog_is_longer_than_a_second_and_none_stops_at_once(shim: ctypes.CDLL) -> None:
    shim.shim_reset()
    shim.shim_receive(force_frame(1, WRENCH, 65535), 0)
    assert wrench_at(shim, 999_999) != (0.0,) * 6
    assert wrench_at(shim, 1_000_000) == (0.0,) * 6
    shim.shim_receive(force_frame(2, WRENCH, 0), 0)
    assert wrench_at(shim, 0) == (0.0,) * 6


def test_motors_that_are_not_enabled_or_a_device_that_is_unfit_give_nothing(
    shim: ctypes.CDLL,
) -> None:
    shim.shim_reset()
    assert wrench_at(shim, 5) == (0.0,) * 6
    shim.shim_receive(force_frame(1, WRENCH, 20, is_enabled=False), 10)
    assert wrench_at(shim, 11) == (0.0,) * 6
    shim.shim_receive(force_frame(2, WRENCH, 20), 12)
    for status in (Status.FAULT, Status.NOT_READY):
        assert state_at(shim, 13, status).status & status
        assert wrench_at(shim, 14) == (0.0,) * 6
        state_at(shim, 15)
        assert wrench_at(shim, 16) == pytest.approx(WRENCH)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_force_that_is_not_finite_leaves_the_old_one_to_its_watchdog(
    shim: ctypes.CDLL, value: float
) -> None:
    shim.shim_reset()
    shim.shim_receive(force_frame(1, WRENCH, 20), 0)
    for place in range(6):
        wrench = tuple(value if i == place else 0.0 for i in range(6))
        assert not shim.shim_receive(force_frame(2, wrench, 20), 10_000)
    assert wrench_at(shim, 10_001) == pytest.approx(WRENCH)
    assert wrench_at(shim, 20_000) == (0.0,) * 6


def test_damaged_frames_and_other_versions_and_kinds_change_nothing(shim: ctypes.CDLL) -> None:
    shim.shim_reset()
    shim.shim_receive(force_frame(1, WRENCH, 20), 0)
    good = force_frame(2, (0.0,) * 6, 20)
    for place in (0, 1, 2, 9, 62):
        assert not shim.shim_receive(good[:place] + bytes([good[place] ^ 4]) + good[place + 1 :], 1)
    assert state_at(shim, 2).status == Status.ENABLED | Status.DAMAGED
    assert wrench_at(shim, 3) == pytest.approx(WRENCH)
    shim.shim_receive(good, 4)
    assert state_at(shim, 5).status == Status.ENABLED


def test_the_firmware_answers_with_its_sheet_once_per_question(shim: ctypes.CDLL) -> None:
    shim.shim_reset()
    frame = ctypes.create_string_buffer(64)
    assert not shim.shim_answer(frame)
    shim.shim_receive(ask_frame(1, 0), 0)
    assert shim.shim_answer(frame)
    numbers = decoded(frame.raw)
    assert isinstance(numbers, Numbers)
    assert numbers.axis_names == ("x", "rz")
    assert numbers.known() == {
        "rate": 990.0,
        "mass": None,
        "damping": 0.4,
        "rotational_inertia": None,
        "rotational_damping": 0.01,
        "friction": 0.05,
        "resolution": 1.5e-5,
        "force_limit": 4.0,
        "torque_limit": 0.1,
        "speed_limit": 2.0,
        "delay": 5e-4,
    }
    shim.shim_receive(ask_frame(2, 1), 0)
    assert shim.shim_answer(frame)
    assert decoded(frame.raw) == "shim"
    shim.shim_receive(ask_frame(3, 2), 0)
    assert not shim.shim_answer(frame)


@pytest.fixture(scope="module", name="sketch")
def _sketch(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    folder = tmp_path_factory.mktemp("sketch")
    (folder / "Encoder.h").write_text(
        "struct Encoder { Encoder(int, int) {} void write(int) {}\n"
        "                 int read() { return encoder_count; } };\n"
    )
    sketch = built(folder, f'-DSKETCH="{FIRMWARE / "hapticbridge_rawhid.ino"}"')
    sketch.sketch_setup()
    return sketch


def states_of(sketch: ctypes.CDLL) -> list[State]:
    frame, states = ctypes.create_string_buffer(64), []
    while sketch.sketch_fetch(frame):
        states.append(decoded(frame.raw))
    return [state for state in states if isinstance(state, State)]


PWM, DIRECTION = 5, 8


def test_the_sketch_streams_below_the_hosts_rate_and_counts_every_frame(
    sketch: ctypes.CDLL,
) -> None:
    states_of(sketch)
    sketch.sketch_turn(1000)
    sketch.sketch_run(1_010_010, 1)
    states = states_of(sketch)
    assert len(states) == 1000
    assert {b.sequence - a.sequence for a, b in pairwise(states)} == {1}
    # half a turn of 2000 counts on a pulley of 5 mm, sector 75 mm, handle at 70 mm
    assert states[-1].numbers[0] == pytest.approx(math.pi * 0.005 / 0.075 * 0.070, rel=1e-6)


def test_the_sketch_pushes_the_way_it_is_told_and_its_interrupt_lets_go_if_the_loop_hangs(
    sketch: ctypes.CDLL,
) -> None:
    for force, direction in ((2.0, 1), (-2.0, 0)):
        sketch.sketch_send(force_frame(1, (force, 0.0, 0.0, 0.0, 0.0, 0.0), 20))
        sketch.sketch_run(2_000, 1)
        # F x travel per radian / torque constant x resistance / supply, of 1023 steps
        duty = 2.0 * 0.070 * 0.005 / 0.075 / 0.0136 * 2.5 / 12.0
        assert sketch.sketch_pin(PWM) == pytest.approx(1023 * min(duty, 0.2), abs=1)
        assert sketch.sketch_pin(DIRECTION) == direction
    sketch.sketch_run(17_000, 0)
    assert sketch.sketch_pin(PWM) > 0
    sketch.sketch_run(2_000, 0)
    assert sketch.sketch_pin(PWM) == 0


def test_what_the_sketch_does_with_interrupts_off_keeps_them_off(sketch: ctypes.CDLL) -> None:
    before = sketch.sketch_sections()
    sketch.sketch_send(force_frame(1, WRENCH, 20))
    sketch.sketch_run(1_010 * 3, 1)
    assert sketch.sketch_sections() >= before + 4  # a force frame, three states
    assert sketch.sketch_broken_sections() == 0
