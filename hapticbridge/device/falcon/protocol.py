"""Packet format of the Falcon: 16 printable bytes in each direction.

    <  MMMM MMMM MMMM  F  A  >      to the device: three motors, flags
    <  EEEE EEEE EEEE  F  ?  >      from it: three encoders, flags, one byte of unknown use

A number has 16 bits in two's complement, sent as four nibbles, the lowest first, each as 0x41 +
nibble. The flags are one byte, 0x41 + flags. The device sends one reply per request, without a
checksum. A reply is valid if '<' and '>' are 16 bytes apart with only nibbles between; bytes before
it are dropped. Because '<' and '>' are not nibbles, a reply with a lost or inserted byte is never
valid.

Replies arrive through an FTDI bridge in USB packets of at most 64 bytes. Each begins with two bytes
of modem status; a packet of only these carries no data.

References:
    libnifalcon's source (2019). It contradicts itself twice: the flag for homing is 0x01 in the
    code and 0x10 in a comment; the lights are green 2, blue 4, red 8 in the code and red 2, green
    4, blue 8 in a comment. The code's values are used here; not verified on hardware.
"""

from __future__ import annotations

import array
from enum import IntFlag
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from hapticbridge.device.driver import Notify
from hapticbridge.device.watchdog import SILENCE
from hapticbridge.errors import DeviceError, DeviceLost
from hapticbridge.kernel.jit import compiled

SIZE = 16
"""Bytes per packet, in each direction."""

STATUS = 2
"""Bytes of modem status before the data of each USB packet from an FTDI bridge."""

LARGEST = 32767
"""Largest magnitude of a number in a packet."""

REPLY_DTYPE = np.dtype([("encoders", "<i8", 3), ("buttons", "<i8"), ("homed", "<i8")])
"""Reply: encoder counts; grip buttons as bits (1 right, 2 forward, 4 centre, 8 left); and a bit per
encoder that has found its zero, valid only while homing is on."""

_FIRST, _LAST, _ZERO = ord("<"), ord(">"), 0x41
_ROOM = 4096  # bytes of buffer: far more than a USB packet, so nothing is cut


class Request(IntFlag):
    """Flags of a packet to the device.

    Attributes:
        HOMING: Each encoder is set to 0 at its index mark.
        GREEN: The green light.
        BLUE: The blue light.
        RED: The red light.
    """

    HOMING = 1
    GREEN = 2
    BLUE = 4
    RED = 8


@compiled
def encode(motors: NDArray[np.int64], flags: int, packet: NDArray[np.uint8]) -> None:
    """Encodes a packet, shape (16,), with ``Request`` bits as flags.

    Motor units, shape (3,), are clamped to the range of a packet.
    """
    packet[0], packet[14], packet[15] = _FIRST, _ZERO, _LAST
    packet[13] = _ZERO + (flags & 15)
    for i in range(3):
        number = min(max(motors[i], -LARGEST), LARGEST) & 0xFFFF
        for j in range(4):
            packet[1 + 4 * i + j] = _ZERO + ((number >> (4 * j)) & 15)


@compiled
def _is_reply(data: NDArray[np.uint8], at: int) -> bool:
    if data[at] != _FIRST or data[at + SIZE - 1] != _LAST:
        return False
    for i in range(at + 1, at + 13):
        if not _ZERO <= data[i] < _ZERO + 16:
            return False
    return bool(_ZERO <= data[at + 13] < _ZERO + 128)


@compiled
def newest_reply(
    data: NDArray[np.uint8], count: int, replies: NDArray[np.void]
) -> tuple[int, int, int]:
    """Decodes the last reply in a stream of bytes.

    Args:
        data: The stream.
        count: Number of valid bytes in ``data``.
        replies: Output, shape (1,), ``REPLY_DTYPE``; unchanged without a reply.

    Returns:
        Number of consumed bytes, of replies, and of bytes that belonged to no reply. The remaining
        bytes may be the beginning of a reply: fewer than 16.
    """
    at, found, dropped, last = 0, 0, 0, -1
    while at + SIZE <= count:
        if _is_reply(data, at):
            last = at
            found += 1
            at += SIZE
        else:
            at += 1
            dropped += 1
    while at < count and data[at] != _FIRST:
        at += 1
        dropped += 1
    if found:
        reply = replies[0]
        for i in range(3):
            number = 0
            for j in range(4):
                number |= (int(data[last + 1 + 4 * i + j]) - _ZERO) << (4 * j)
            reply.encoders[i] = number - 65536 if number & 0x8000 else number
        flags = int(data[last + 13]) - _ZERO
        reply.buttons, reply.homed = flags & 15, (flags >> 4) & 7
    return at, found, dropped


class ReplyStream:
    """Assembles replies from USB packets and keeps the newest.

    Attributes:
        reply: Newest reply, shape (1,), ``REPLY_DTYPE``.
        dropped: Number of bytes so far that belonged to no reply.
    """

    def __init__(self) -> None:
        self.reply = np.zeros(1, REPLY_DTYPE)
        self.dropped = 0
        self._data = np.zeros(_ROOM, np.uint8)
        self._count = 0

    def feed(self, packet: bytes) -> int:
        """Consumes a USB packet; returns the number of replies that it completed.

        Args:
            packet: Packet with its status bytes, of any content, at most 4081 bytes.
        """
        news = len(packet) - STATUS
        if news <= 0:
            return 0
        data, count = self._data, self._count
        data[count : count + news] = np.frombuffer(packet, np.uint8, news, STATUS)
        count += news
        done, found, dropped = newest_reply(data, count, self.reply)
        self.dropped += dropped
        self._count = count - done
        data[: self._count] = data[done:count]
        return found

    def clear(self) -> None:
        """Discards the beginning of an incomplete reply."""
        self._count = 0


# Boot protocol of a Falcon: serial bridge and loader

READ_FROM, WRITE_TO = 0x81, 0x02
"""Addresses of its bulk endpoints."""

MAX_FIRMWARE = 65536
"""Largest firmware file in bytes. The four known images have 7324 to 8492 bytes; a larger file is
not firmware."""

CHUNK = 62
"""Bytes of firmware per piece. The returned piece fits into one packet together with the status
bytes."""

GREETINGS = 100
"""Number of greetings to the loader, as in libnifalcon, before the boot fails: 10 s in all."""

GREETING_TIME = 0.1
"""Longest wait for the answer to a greeting in s; a greeting without an answer is sent again."""

PIECE_TIME = 2.0
"""Longest wait for a piece of firmware to come back in s. At 140000 baud it takes 9 ms on the line
in both directions and up to 16 ms in the bridge. The rest is for a computer that is busy: a piece
that is given up loses the whole load."""

PROBES = 20
"""Number of packets without a reply after which a Falcon counts as not running. The first packets
after a change of baud rate may be lost."""

PROBE_TIME = 0.02
"""Longest wait for the reply to a probe in s; a reply takes up to 1.3 ms."""

_RESET, _MODEM, _FLOW, _BAUD, _FORMAT, _EVENT, _LATENCY = 0, 1, 2, 3, 4, 6, 9
_EMPTY_INPUT, _EMPTY_OUTPUT = 1, 2
_DTR_LOW, _DTR_HIGH, _RTS_LOW = 0x0100, 0x0101, 0x0200
_BAUD_GREETING, _BAUD_LOADING, _BAUD_RUNNING = 0x4138, 0x0015, 0x0002
_HELLO, _HELLO_ANSWER, _LOAD = b"\x0aC\x0d", b"\x0aD,\x0d", b"A"
_EVENT_AT_END = 0x0100 | ord(">")
_WRITE_MS = 100  # writes outside the loop are not urgent
_NO_MOTORS = np.zeros(3, np.int64)


class Link(Protocol):
    """USB link of a Falcon; ``UsbLink`` is the real one."""

    def now(self) -> float:
        """Returns the time of a monotonic clock in s."""

    def control(self, request: int, value: int) -> None:
        """Sends a vendor request without data.

        The serial bridge is an FTDI chip; its requests have FTDI's numbers. 0 is reset, with value
        1 for the data from the device and 2 for the data to it. 1 sets modem lines, 2 flow control,
        3 the baud rate, 4 the data format, 6 the event character, 9 the latency timer in ms.
        """

    def write(self, packet: array.array[int], timeout_ms: int = ...) -> bool:
        """Sends a packet; returns False if the device did not accept it in time."""

    def take(self) -> list[bytes]:
        """Returns the packets received since the last call, without waiting."""

    def wait(self, timeout: float) -> None:
        """Returns as soon as a packet is available, at the latest after ``timeout`` s."""

    def close(self) -> None:
        """Releases the device."""


def read_firmware(path: str) -> bytes:
    """Reads a firmware file for the Falcon. The firmware belongs to the maker and is not shipped.

    Raises:
        DeviceError: The file does not exist, cannot be read, or has an impossible size.
    """
    try:
        with Path(path).open("rb") as file:
            image = file.read(MAX_FIRMWARE + 1)  # a device gives bytes without end
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise DeviceError(f"firmware = '{path}': cannot be read ({reason})") from None
    if not 0 < len(image) <= MAX_FIRMWARE:
        raise DeviceError(
            f"firmware = '{path}': has {'no' if not image else 'too many'} bytes; a Falcon's "
            f"firmware has 1 to {MAX_FIRMWARE}"
        )
    return image


def enter_run_mode(link: Link) -> None:
    """Sets the bridge to packets at 1.5 Mbaud with the shortest latency.

    The latency timer is set to 1 ms. The event character requests immediate delivery of data that
    ends with '>'. Whether a Falcon's bridge obeys it is measured (``measured_timing``).
    """
    link.control(_LATENCY, 1)
    link.control(_BAUD, _BAUD_RUNNING)
    link.control(_EVENT, _EVENT_AT_END)
    link.control(_RESET, _EMPTY_INPUT)
    link.control(_RESET, _EMPTY_OUTPUT)


def send_question(link: Link, flags: int = 0) -> None:
    """Sends a packet without force and returns at once; ``flags`` are ``Request`` bits."""
    packet = array.array("B", bytes(SIZE))
    encode(_NO_MOTORS, flags, np.frombuffer(packet, np.uint8))
    link.write(packet, _WRITE_MS)


def ask(link: Link, stream: ReplyStream, flags: int, timeout: float) -> bool:
    """Sends a packet without force and returns whether a reply came within ``timeout`` s."""
    send_question(link, flags)
    return answers(link, stream, timeout) > 0


def answers(link: Link, stream: ReplyStream, timeout: float) -> int:
    """Waits up to ``timeout`` s for at least one reply, and returns the number of replies."""
    end = link.now() + timeout
    replies = 0
    while not replies and (left := end - link.now()) > 0:
        link.wait(left)
        for packet in link.take():
            replies += stream.feed(packet)
    return replies


def speaks(link: Link, stream: ReplyStream) -> bool:
    """Returns whether a Falcon in run mode answers packets, that is whether it has its firmware."""
    return any(ask(link, stream, 0, PROBE_TIME) for _ in range(PROBES))


def upload(link: Link, image: bytes, name: str, notify: Notify) -> None:
    """Loads the firmware into a Falcon, which loses it without power.

    At 9600 baud the loader is greeted. At 140000 baud it receives the firmware in pieces and
    returns each, which is the only check. ``notify`` receives the progress at every quarter.

    Raises:
        DeviceError: The loader does not answer, or returned other bytes than it received.

    References:
        libnifalcon's source (2019) for the sequence; not verified on hardware.
    """
    _greet(link, name)
    link.control(_MODEM, _DTR_LOW)
    link.control(_BAUD, _BAUD_LOADING)
    if _echo(link, _LOAD) != _LOAD:
        raise DeviceError(f"{name}: its loader does not start to load; switch its power off and on")
    quarter = 0
    for start in range(0, len(image), CHUNK):
        piece = image[start : start + CHUNK]
        if (echo := _echo(link, piece)) != piece:
            raise DeviceError(
                f"{name}: sent back {_difference(piece, echo, start)} of its firmware; switch its "
                "power off and on, and try again"
            )
        done = 4 * (start + len(piece)) // len(image)
        if done > quarter:
            quarter = done
            notify(f"{name}: firmware {25 * quarter} % loaded")


def _greet(link: Link, name: str) -> None:
    for request, value in (
        (_RESET, _EMPTY_INPUT),
        (_RESET, _EMPTY_OUTPUT),
        (_LATENCY, 16),
        (_BAUD, _BAUD_GREETING),
        (_FORMAT, 8),
        (_FLOW, 0),
        (_MODEM, _RTS_LOW),
        (_MODEM, _DTR_LOW),
        (_MODEM, _DTR_HIGH),
    ):
        link.control(request, value)
    link.take()
    for _ in range(GREETINGS):
        # switching the line may insert a zero byte before the answer
        if _echo(link, _HELLO, len(_HELLO_ANSWER)).lstrip(b"\0") == _HELLO_ANSWER:
            return
    raise DeviceError(f"{name}: its loader does not answer; switch its power off and on")


def _echo(link: Link, data: bytes, greeting: int = 0) -> bytes:
    """Sends bytes and returns what comes back: as many, or the ``greeting`` bytes of an answer."""
    wanted, timeout = (greeting, GREETING_TIME) if greeting else (len(data), PIECE_TIME)
    link.write(array.array("B", data), _WRITE_MS)
    end = link.now() + timeout
    answer = b""
    while len(answer.lstrip(b"\0") if greeting else answer) < wanted:
        if (left := end - link.now()) <= 0:
            break
        link.wait(left)
        answer += b"".join(packet[STATUS:] for packet in link.take())
    return answer


def _difference(sent: bytes, echo: bytes, start: int) -> str:
    for i, (sent_byte, returned_byte) in enumerate(zip(sent, echo, strict=False)):
        if sent_byte != returned_byte:
            return f"0x{returned_byte:02x} for byte {start + i} (0x{sent_byte:02x})"
    return f"{len(echo)} bytes for the {len(sent)} from byte {start} on"


# Start of a Falcon: firmware and homing

MAX_PERIOD = 0.02
"""Longest period of the loop in s. The device is polled once per tick; at a longer period two lost
replies would already count as silence."""

ZERO_TRIES = 20
"""Number of attempts, of 1 ms each, to send a zero force that was not accepted. No watchdog of a
Falcon is known, so the previous force would remain."""

HOMING_TIME = 60.0
"""Time in s in which the user must move the grip through its range."""

_ALL = 7  # a bit per encoder


def silent(name: str) -> DeviceLost:
    """Returns the error of a Falcon that stopped replying."""
    return DeviceLost(
        f"{name}: gave no usable reply for {1e3 * SILENCE:g} ms; check its cable and its power"
    )


def insist(link: Link, packet: array.array[int], name: str) -> None:
    """Repeats a zero-force packet until it is accepted.

    Raises:
        DeviceLost: The device is gone, or refused ``ZERO_TRIES`` attempts.
    """
    if not any(link.write(packet) for _ in range(ZERO_TRIES)):
        raise DeviceLost(
            f"{name}: did not accept zero force in {ZERO_TRIES} attempts; switch its power off"
        )


def ask_anew(link: Link, stream: ReplyStream, name: str) -> float:
    """Commands zero force and reads the pose again, after a pause of the loop.

    A Falcon keeps its last force while the host pauses, and the waiting reply holds an outdated
    pose. If the handle were re-anchored there, the next reply would stretch the coupling by the
    hand's motion in the meantime.

    Returns:
        Time of the first request in s; the pose is not older.

    Raises:
        DeviceLost: The device is gone or silent.
    """
    requested_at = link.now()
    for _ in range(2):  # the first reply may answer a request of the loop
        if not ask(link, stream, Request.GREEN, SILENCE):
            raise silent(name)
    return requested_at


def bring_up(
    link: Link, stream: ReplyStream, name: str, firmware: str | None, notify: Notify
) -> None:
    """Brings a Falcon into run mode, and loads its firmware if it does not answer.

    Raises:
        DeviceError: The device has no firmware, and no file was named or the file does not run.
        DeviceLost: The device is gone.
    """
    image = None if firmware is None else read_firmware(firmware)
    enter_run_mode(link)
    if speaks(link, stream):
        return
    if image is None:
        raise DeviceError(
            f"{name}: has no firmware (it loses it without power); name the maker's firmware "
            "file: falcon:firmware=FILE"
        )
    upload(link, image, name, notify)
    enter_run_mode(link)
    stream.clear()
    if not speaks(link, stream):
        raise DeviceError(
            f"{name}: accepted '{firmware}' but does not answer; name a file with its firmware"
        )


def home(link: Link, stream: ReplyStream, name: str, notify: Notify) -> None:
    """Waits until the user, instructed by ``notify``, has moved every encoder through its zero.

    Raises:
        DeviceError: The grip was not moved within ``HOMING_TIME``.
        DeviceLost: The device is gone or silent.
    """
    end, is_prompted = link.now() + HOMING_TIME, False
    last_reply = link.now()
    while link.now() < end:
        if ask(link, stream, Request.HOMING | Request.RED, SILENCE):
            last_reply = link.now()
            if stream.reply["homed"][0] == _ALL:
                if is_prompted:
                    notify(f"{name}: homed")
                return
        elif link.now() - last_reply > 2 * SILENCE:
            raise silent(name)
        if not is_prompted:
            is_prompted = True
            notify(f"{name}: pull the grip all the way out and push it back in, slowly")
    passed = int(stream.reply["homed"][0]).bit_count()
    raise DeviceError(
        f"{name}: was not homed within {HOMING_TIME:g} s, in which {passed} of its 3 encoders "
        "passed their zero; open it again and move the grip all the way out and in"
    )
