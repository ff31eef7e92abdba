from __future__ import annotations

import math
import re
import struct
from pathlib import Path

import numpy as np
import pytest
from emulated.rawhid_model import crc
from hypothesis import given
from hypothesis import strategies as st

from hapticbridge.device.base import AXES
from hapticbridge.device.rawhid import device as driver
from hapticbridge.device.rawhid.protocol import (
    FRAME_BYTES,
    Numbers,
    State,
    Status,
    ask_frame,
    crc16,
    decoded,
    force_frame,
    sheet_frames,
    state_frame,
    version_of,
)

DOCUMENT = Path(driver.__file__).parents[1].joinpath("rawhid.md").read_text(encoding="utf-8")
NAN = math.nan

single = st.floats(-(2.0**99), 2.0**99, width=32)
any_single = st.floats(width=32)
u8, u16 = st.integers(0, 255), st.integers(0, 65535)
states = st.builds(State, u8, u16, u16, st.integers(0, 2**32 - 1), st.tuples(*[single] * 12), u16)

WRITTEN = {
    "Force 7": force_frame(7, (1.0, -0.5, 0.0, 0.0, 0.0, 0.01), 20),
    "State 258": state_frame(
        State(
            Status.ENABLED,
            258,
            1,
            1_000_000,
            (0.01, -0.02, 0.03, 0.0, 0.0, 0.5, 0.1, 0.0, 0.0, 0.0, 0.0, -1.0),
            7,
        )
    ),
    "Ask 1": ask_frame(1, 0),
    "Sheet, page 0": sheet_frames(
        1, Numbers(1, 990.0, NAN, 0.4, NAN, NAN, 0.05, 1.5e-5, 4.0, NAN, 2.0, 5e-4), ""
    )[0],
    "Sheet, page 1": sheet_frames(2, Numbers(1, *[NAN] * 11), "one-axis capstan paddle")[1],
}


def documented() -> dict[str, bytes]:
    """Returns the document's worked frames by the first words of the paragraph before each."""
    section = DOCUMENT.split("## Worked frames")[1]
    pairs = re.findall(r"\n([^\n]+(?:\n[^\n`]+)*)\n\n```text\n([0-9a-f \n]+)```", section)
    return {re.split(r"[:,](?! page)", words)[0]: bytes.fromhex(text) for words, text in pairs}


def test_the_documents_worked_frames_are_what_the_codec_writes() -> None:
    assert documented() == WRITTEN


def test_the_crc_is_the_documents_bit_by_bit_and_has_its_check_value() -> None:
    assert crc16(b"123456789") == crc(b"123456789") == 0x29B1
    for frame in documented().values():
        assert len(frame) == FRAME_BYTES
        assert crc(frame[:62]) == struct.unpack("<H", frame[62:])[0]


SIZES = {"u8": ("B", 1), "u16": ("H", 2), "u32": ("I", 4), "f32": ("f", 4)}
FIELD = re.compile(r"^\| (\d+)(?:–(\d+))? \| (?:(\d+) × )?([uf]\d+) \| ([^|]*) \|", re.MULTILINE)


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


@pytest.mark.parametrize("heading", ["State", "Force"])
def test_the_documents_fields_fill_64_bytes_without_a_gap(heading: str) -> None:
    layout = {**fields("The interface"), **fields(heading)}
    place = 0
    for first in sorted(layout):
        assert first == place
        place = layout[first][0] + 1
    assert place == FRAME_BYTES


def test_the_worked_state_holds_its_numbers_where_the_document_says() -> None:
    frame = documented()["State 258"]
    layout = {**fields("The interface"), **fields("State")}
    expected: dict[int, tuple[float, ...]] = {
        0: (0x48,), 1: (1,), 2: (0x53,), 3: (1,), 4: (258,), 6: (1,), 8: (1_000_000,),
        12: (0.01, -0.02, 0.03), 24: (0, 0, 0.5), 36: (0.1, 0, 0), 48: (0, 0, -1), 60: (7,),
    }  # fmt: skip
    for first, values in expected.items():
        np.testing.assert_allclose(
            struct.unpack_from(layout[first][1], frame, first), values, rtol=1e-7
        )


def test_the_worked_sheet_holds_its_numbers_where_the_document_says() -> None:
    frame = documented()["Sheet, page 0"]
    expected = (1, 990, NAN, 0.4, NAN, NAN, 0.05, 1.5e-5, 4, NAN, 2, 5e-4)
    layout = fields("Sheet")
    assert len(layout) == len(expected)
    for first, value in zip(sorted(layout), expected, strict=True):
        (stored,) = struct.unpack_from(layout[first][1], frame, first)
        assert stored == pytest.approx(value, rel=1e-7, nan_ok=True)


@given(states)
def test_any_state_survives_a_frame(state: State) -> None:
    assert decoded(state_frame(state)) == state


@given(
    st.integers(0, 63),
    st.lists(any_single, min_size=11, max_size=11),
    st.text("a-é日🙂 7", max_size=80).map(str.strip),
)
def test_any_sheet_survives_its_frames(axes: int, values: list[float], name: str) -> None:
    numbers, title = (decoded(frame) for frame in sheet_frames(9, Numbers(axes, *values), name))
    assert isinstance(numbers, Numbers)
    assert isinstance(title, str)
    known = numbers.known()
    for field, value in zip(Numbers._fields[1:], values, strict=True):
        # equal as a float32, not as a double: the shortest text that means the same one
        stored = known[field]
        assert (stored is None) == (not math.isfinite(value))
        assert stored is None or np.float32(stored) == np.float32(value)
    assert numbers.axis_names == tuple(AXES[i] for i in range(6) if axes >> i & 1)
    assert name.encode().startswith(title.encode())
    assert len(title.encode()) > 50 or title == name


@given(st.binary(max_size=130))
def test_arbitrary_bytes_are_no_frame(data: bytes) -> None:
    assert decoded(data) is None


@given(st.binary(min_size=60, max_size=60))
def test_whatever_passes_the_check_is_read_without_a_crash(body: bytes) -> None:
    for kind in range(0x3F, 0x54):
        frame = b"\x48\x01" + bytes([kind]) + body[:59]
        news = decoded(frame + struct.pack("<H", crc(frame)))
        assert (news is None) == (kind not in (0x53, 0x44) or (kind == 0x44 and body[0] > 1))


@given(states, st.integers(0, 64 * 8 - 1), st.integers(0, 64 * 8 - 1))
def test_one_or_two_flipped_bits_never_pass(state: State, first: int, second: int) -> None:
    frame = bytearray(state_frame(state))
    for bit in {first, second}:
        frame[bit // 8] ^= 1 << bit % 8
    assert decoded(bytes(frame)) is None


def test_a_frame_of_another_version_is_told_from_noise() -> None:
    body = bytearray(state_frame(State(0, 0, 0, 0, (0.0,) * 12, 0))[:62])
    body[1] = 2
    frame = bytes(body) + struct.pack("<H", crc(bytes(body)))
    assert (version_of(frame), decoded(frame)) == (2, None)
    assert version_of(frame[:-1] + bytes([frame[-1] ^ 1])) is None


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_state_that_is_not_finite_says_so(value: float) -> None:
    for place in range(12):
        numbers = tuple(value if i == place else 0.0 for i in range(12))
        state = decoded(state_frame(State(0, 0, 0, 0, numbers, 0)))
        assert isinstance(state, State)
        assert not state.is_finite
