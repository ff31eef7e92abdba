"""The Falcon's packets as the protocol describes them, whole and damaged."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from hapticbridge.device.falcon.protocol import ReplyStream, Request, encode

STATUS = b"\x01\x60"

numbers = st.integers(-32768, 32767)


def digits(number: int) -> str:
    """A number as the protocol writes it, by way of its hexadecimal text."""
    return "".join(chr(ord("A") + int(d, 16)) for d in f"{number & 0xFFFF:04x}"[::-1])


def reply(encoders: tuple[int, int, int], buttons: int = 0, homed: int = 0) -> bytes:
    body = "".join(digits(e) for e in encoders)
    return f"<{body}".encode() + bytes([0x41 + buttons + 16 * homed, 0x41]) + b">"


def fed(stream: ReplyStream, data: bytes, size: int = 62) -> int:
    """Feeds a stream of bytes in USB packets of this many data bytes."""
    cuts = range(0, len(data), size)
    return sum(stream.feed(STATUS + data[at : at + size]) for at in cuts)


def newest(stream: ReplyStream) -> tuple[list[int], int, int]:
    last = stream.reply[0]
    return last["encoders"].tolist(), int(last["buttons"]), int(last["homed"])


def test_the_number_of_the_description_is_read_as_described() -> None:
    stream = ReplyStream()
    assert stream.feed(STATUS + b"<HKFAAAAAPPPPAA>") == 1
    assert newest(stream) == ([1447, 0, -1], 0, 0)


@given(st.tuples(numbers, numbers, numbers), st.integers(0, 15))
def test_packet_to_device_is_written_as_described(motors: tuple[int, int, int], flags: int) -> None:
    packet = np.zeros(16, np.uint8)
    encode(np.array(motors), flags, packet)
    kept = [max(n, -32767) for n in motors]
    expected = "<" + "".join(digits(n) for n in kept) + chr(0x41 + flags) + "A>"
    assert packet.tobytes() == expected.encode()


def test_a_number_too_large_for_a_packet_becomes_the_largest_of_its_sign() -> None:
    packet = np.zeros(16, np.uint8)
    encode(np.array([10**6, -(10**6), 0]), Request.HOMING | Request.RED, packet)
    assert packet.tobytes() == f"<{digits(32767)}{digits(-32767)}AAAA{chr(0x41 + 9)}A>".encode()


@given(st.tuples(numbers, numbers, numbers), st.integers(0, 15), st.integers(0, 7))
def test_every_reply_is_read_back(encoders: tuple[int, int, int], buttons: int, homed: int) -> None:
    stream = ReplyStream()
    assert fed(stream, reply(encoders, buttons, homed)) == 1
    assert newest(stream) == (list(encoders), buttons, homed)
    assert stream.dropped == 0


@given(st.lists(st.tuples(numbers, numbers, numbers), min_size=1), st.integers(1, 62))
def test_packets_of_any_size_change_nothing(counts: list[tuple[int, int, int]], size: int) -> None:
    stream = ReplyStream()
    assert fed(stream, b"".join(reply(c) for c in counts), size) == len(counts)
    assert newest(stream)[0] == list(counts[-1])


@given(st.lists(st.binary(max_size=80), max_size=20))
def test_any_bytes_are_taken_and_a_reply_after_them_is_found(packets: list[bytes]) -> None:
    stream = ReplyStream()
    for packet in packets:
        stream.feed(packet)
        assert np.isin(stream.reply["buttons"], np.arange(16)).all()
        assert (np.abs(stream.reply["encoders"]) <= 32768).all()
    # a '<' among the noise may swallow the first reply's beginning, never the second
    fed(stream, reply((1, 2, 3)) + reply((7, -8, 9), 5))
    assert newest(stream) == ([7, -8, 9], 5, 0)


@given(
    st.lists(
        st.one_of(st.tuples(numbers, numbers, numbers), st.binary(max_size=15).map(bytes)),
        min_size=1,
    ),
    st.integers(1, 62),
)
def test_garbage_costs_no_reply(parts: list[tuple[int, int, int] | bytes], size: int) -> None:
    # garbage without a '<' cannot begin a reply
    pieces = [p.replace(b"<", b"") if isinstance(p, bytes) else reply(p) for p in parts]
    wanted = [p for p in parts if not isinstance(p, bytes)]
    stream = ReplyStream()
    assert fed(stream, b"".join(pieces), size) == len(wanted)
    if wanted:
        assert newest(stream)[0] == list(wanted[-1])
    garbage = sum(len(p) for p in pieces) - 16 * len(wanted)
    assert stream.dropped == garbage


@given(st.tuples(numbers, numbers, numbers), st.integers(0, 15), st.integers(0, 255))
def test_damaged_reply_is_not_believed(encoders: tuple[int, int, int], at: int, extra: int) -> None:
    whole = reply(encoders)
    for damaged in (
        whole[:at] + whole[at + 1 :],
        whole[: at + 1] + bytes([extra]) + whole[at + 1 :],
    ):
        # at either end nothing is damaged: the extra byte stands before or behind the reply
        if damaged.startswith(whole) or damaged.endswith(whole):
            continue
        # byte 14 has no known meaning and is not checked, so what it stood for may be another
        if damaged[:16].endswith(b">") and len(damaged) == 17 and at >= 12:
            continue
        stream = ReplyStream()
        assert fed(stream, damaged) == 0
        assert fed(stream, reply((5, 6, 7))) == 1
        assert newest(stream)[0] == [5, 6, 7]


def test_a_packet_of_status_bytes_alone_says_nothing() -> None:
    stream = ReplyStream()
    assert [stream.feed(packet) for packet in (b"", b"\x01", STATUS)] == [0, 0, 0]


def test_what_was_under_way_before_a_clear_is_forgotten() -> None:
    stream = ReplyStream()
    whole = reply((1, 2, 3))
    assert fed(stream, whole[:9]) == 0
    stream.clear()
    assert fed(stream, whole[9:]) == 0
