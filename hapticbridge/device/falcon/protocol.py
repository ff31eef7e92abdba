"""The Falcon's run packets: 16 printable bytes each way, found again after anything.

    <  MMMM MMMM MMMM  F  A  >      to the device: three motors, flags
    <  EEEE EEEE EEEE  F  ?  >      from it: three encoders, flags, one byte of unknown use

A number is 16 bits in two's complement, as four nibbles, the lowest first, each 0x41 + nibble; the
flags are one byte, 0x41 + flags. The device speaks only when asked: one reply per request. There
is no checksum. A reply is believed if it begins and ends as it must, 16 bytes apart, with nothing
but nibbles between; what lies before it is dropped. '<' and '>' are no nibbles, so a reply with a
byte lost or put in cannot pass for one.

It reaches the host through an FTDI bridge in USB packets of 64 bytes at most, each of which begins
with two bytes of modem status; one of only these says that there is nothing to say.

References:
    libnifalcon's source (2019). Two of its statements contradict each other: the flag for homing is
    0x01 in the code and 0x10 in a comment, the lights are green 2, blue 4, red 8 in the code and
    red 2, green 4, blue 8 in a comment. The code's values are used here; no device has been asked.
"""

from __future__ import annotations

import array
from enum import IntFlag
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from hapticbridge.device.family import Notify
from hapticbridge.device.watchdog import SILENCE
from hapticbridge.errors import DeviceError, DeviceLost
from hapticbridge.jit import compiled

SIZE = 16
"""Bytes of a packet, either way."""

STATUS = 2
"""Bytes of modem status before the data of each USB packet from an FTDI bridge."""

LARGEST = 32767
"""Largest number, either sign, that a packet carries."""

REPLY_DTYPE = np.dtype([("encoders", "<i8", 3), ("buttons", "<i8"), ("homed", "<i8")])
"""A reply: encoder counts; grip buttons as bits (1 right, 2 forward, 4 centre, 8 left); and a bit
per encoder that has found its zero, true only while homing is on."""

_FIRST, _LAST, _ZERO = ord("<"), ord(">"), 0x41
_ROOM = 4096  # bytes of tail and news together: far more than a USB packet, so nothing is cut


class Request(IntFlag):
    """Flags of a packet to the device.

    Attributes:
        HOMING: Each encoder is set to 0 where it passes its index mark.
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
    """Writes a packet to the device.

    Args:
        motors: Shape (3,), motor units; what a packet cannot carry becomes its nearest.
        flags: ``Request`` bits, 0 to 15.
        packet: Shape (16,), filled in place.
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
    """Decodes the last reply in a stream of bytes, whatever stands around it.

    Args:
        data: The stream, of which the first ``count`` bytes count.
        count: How many.
        replies: Shape (1,), ``REPLY_DTYPE``, filled in place; unchanged where there is no reply.

    Returns:
        How many bytes are done with, how many replies there were, and how many bytes belonged to
        none. The rest may be the beginning of a reply: fewer than 16 bytes.
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
    """Puts USB packets together to replies and keeps the newest.

    Attributes:
        reply: The newest, shape (1,), ``REPLY_DTYPE``.
        dropped: Bytes so far that belonged to no reply.
    """

    def __init__(self) -> None:
        self.reply = np.zeros(1, REPLY_DTYPE)
        self.dropped = 0
        self._data = np.zeros(_ROOM, np.uint8)
        self._count = 0

    def feed(self, packet: bytes) -> int:
        """Takes a USB packet; returns how many replies it completed.

        Args:
            packet: With its status bytes; of any content, and of 4081 bytes at most.
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
        """Forgets the beginning of a reply that was under way."""
        self._count = 0


# How a Falcon is brought to speak: its serial bridge, its loader, and one question at a time.
#
# The Falcon is a signal processor behind an FTDI serial bridge. Without power it forgets its
# program, so the host sends it: at 9600 baud the loader is greeted, at 140000 baud it takes the
# program in pieces and sends each back, which is all the check there is; then both go to 1.5
# Mbaud and packets (``packets``). The program is the maker's and is not shipped here.
#
# Requests of the bridge, all without data (FTDI's names and numbers): 0 reset (value 1 empties
# what came from the device, 2 what goes to it), 1 modem lines, 2 flow control, 3 baud rate, 4
# data format, 6 event character, 9 latency timer in ms.
#
# References: libnifalcon's source (2019) for the sequence. No device has been asked.

READ_FROM, WRITE_TO = 0x81, 0x02
"""Addresses of its bulk endpoints."""

LARGEST_FIRMWARE = 65536
"""In bytes. The four images known have 7324 to 8492; a larger file is another file."""

CHUNK = 62
"""Bytes of the program per piece: what fits beside the status bytes into one packet back."""

GREETINGS = 100
"""How often the loader is greeted, as libnifalcon does, before it is given up: 10 s in all."""

ANSWER_TIME = 0.1
"""In s: how long one answer is waited for. The slowest, a piece of the program at 140000 baud, is
on the line for 9 ms, there and back, and in the bridge for up to 16."""

PROBES = 20
"""Packets that a Falcon is asked with before it counts as not speaking: the first ones after a
change of baud rate may be lost."""

PROBE_TIME = 0.02
"""In s: how long each of them is waited for; a reply is there within 1.3 ms."""

_RESET, _MODEM, _FLOW, _BAUD, _FORMAT, _EVENT, _LATENCY = 0, 1, 2, 3, 4, 6, 9
_EMPTY_INPUT, _EMPTY_OUTPUT = 1, 2
_DTR_LOW, _DTR_HIGH, _RTS_LOW = 0x0100, 0x0101, 0x0200
_BAUD_GREETING, _BAUD_LOADING, _BAUD_RUNNING = 0x4138, 0x0015, 0x0002
_HELLO, _HELLO_ANSWER, _LOAD = b"\x0aC\x0d", b"\x0aD,\x0d", b"A"
_EVENT_AT_END = 0x0100 | ord(">")
_WRITE_MS = 100  # outside the loop a write may take its time
_NO_MOTORS = np.zeros(3, np.int64)


class Link(Protocol):
    """What the codec needs of a USB link; ``UsbLink`` is the real one."""

    def now(self) -> float:
        """Returns the time in s of a clock that only grows."""

    def control(self, request: int, value: int) -> None:
        """Sends a vendor's request without data."""

    def write(self, packet: array.array[int], timeout_ms: int = ...) -> bool:
        """Sends a packet; returns False where the device did not take it in time."""

    def take(self) -> list[bytes]:
        """Returns the packets that came since the last call, without waiting."""

    def wait(self, timeout: float) -> None:
        """Returns as soon as a packet is there, at the latest after ``timeout`` s."""

    def close(self) -> None:
        """Lets the device go."""


def read_firmware(path: str) -> bytes:
    """Reads a program for the Falcon.

    Raises:
        DeviceError: There is no such file, it cannot be read, or it cannot be one.
    """
    try:
        image = Path(path).read_bytes()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise DeviceError(f"firmware = '{path}': cannot be read ({reason})") from None
    if not 0 < len(image) <= LARGEST_FIRMWARE:
        raise DeviceError(
            f"firmware = '{path}': has {len(image)} bytes; a Falcon's program has 1 to "
            f"{LARGEST_FIRMWARE}"
        )
    return image


def enter_run_mode(link: Link) -> None:
    """Sets the bridge to packets: 1.5 Mbaud, and the shortest wait before it passes a reply on.

    That wait, the latency timer, is 1 ms. The event character asks the bridge to pass on at once
    what ends with '>'; whether a Falcon's bridge heeds it is measured, not assumed.
    """
    link.control(_LATENCY, 1)
    link.control(_BAUD, _BAUD_RUNNING)
    link.control(_EVENT, _EVENT_AT_END)
    link.control(_RESET, _EMPTY_INPUT)
    link.control(_RESET, _EMPTY_OUTPUT)


def send_question(link: Link, flags: int = 0) -> None:
    """Sends a packet without force, and waits for nothing; ``flags`` are ``Request`` bits."""
    packet = array.array("B", bytes(SIZE))
    encode(_NO_MOTORS, flags, np.frombuffer(packet, np.uint8))
    link.write(packet, _WRITE_MS)


def ask(link: Link, stream: ReplyStream, flags: int, timeout: float) -> bool:
    """Sends a packet without force and waits for the reply.

    Args:
        link: To the Falcon, in run mode.
        stream: Takes the reply.
        flags: ``Request`` bits.
        timeout: Longest wait in s.

    Returns:
        Whether there was a reply in time.
    """
    send_question(link, flags)
    return answers(link, stream, timeout) > 0


def answers(link: Link, stream: ReplyStream, timeout: float) -> int:
    """Waits until at least one reply is there; returns how many there are, 0 if none comes.

    Args:
        link: To the Falcon, in run mode.
        stream: Takes them.
        timeout: Longest wait in s.
    """
    end = link.now() + timeout
    found = 0
    while not found and (left := end - link.now()) > 0:
        link.wait(left)
        for packet in link.take():
            found += stream.feed(packet)
    return found


def speaks(link: Link, stream: ReplyStream) -> bool:
    """Returns whether a Falcon in run mode answers packets: whether it has its program."""
    return any(ask(link, stream, 0, PROBE_TIME) for _ in range(PROBES))


def upload(link: Link, image: bytes, name: str, tell: Notify) -> None:
    """Gives a Falcon its program.

    Args:
        link: To the Falcon.
        image: The program.
        name: What errors call the device.
        tell: Told how far it is, at every quarter.

    Raises:
        DeviceError: The loader does not answer, or sent back something else than was sent.
        DeviceLost: It is gone.
    """
    _greet(link, name)
    link.control(_MODEM, _DTR_LOW)
    link.control(_BAUD, _BAUD_LOADING)
    if _echo(link, _LOAD) != _LOAD:
        raise DeviceError(f"{name}: its loader does not begin to load; switch its power off and on")
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
            tell(f"{name}: firmware {25 * quarter} % loaded")


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
        # a zero byte may come before the answer, from the line's being switched
        if _echo(link, _HELLO, len(_HELLO_ANSWER)).lstrip(b"\0") == _HELLO_ANSWER:
            return
    raise DeviceError(f"{name}: its loader does not answer; switch its power off and on")


def _echo(link: Link, data: bytes, length: int | None = None) -> bytes:
    """Sends bytes; returns what comes back within ``ANSWER_TIME``, as many by default."""
    wanted = len(data) if length is None else length
    link.write(array.array("B", data), _WRITE_MS)
    end = link.now() + ANSWER_TIME
    answer = b""
    while len(answer.lstrip(b"\0") if length else answer) < wanted:
        if (left := end - link.now()) <= 0:
            break
        link.wait(left)
        answer += b"".join(packet[STATUS:] for packet in link.take())
    return answer


def _difference(sent: bytes, echo: bytes, start: int) -> str:
    for i, (there, back) in enumerate(zip(sent, echo, strict=False)):
        if there != back:
            return f"0x{back:02x} for byte {start + i} (0x{there:02x})"
    return f"{len(echo)} bytes for the {len(sent)} from byte {start} on"


# A Falcon from plugged in to ready: its program, and the zeros of its encoders.
#
# And what is said to it outside the ticks: no force.

LONGEST_PERIOD = 0.02
"""In s. It is asked once a tick; slower, two lost replies would already count as silence."""

ZERO_TRIES = 20
"""How often a packet without force is sent again that was not taken, for 1 ms each: no watchdog of
a Falcon is known, so the force before it would stay."""

HOMING_TIME = 60.0
"""In s: how long the user has to move the grip through its range."""

_ALL = 7  # a bit per encoder


def silent(name: str) -> DeviceLost:
    """Returns the error that a Falcon has fallen silent."""
    return DeviceLost(f"{name}: gave no usable reply for {1e3 * SILENCE:g} ms")


def insist(link: Link, packet: array.array[int], name: str) -> None:
    """Sends a packet without force that was not taken until it is.

    Args:
        link: To the Falcon.
        packet: Of no force.
        name: What errors call it.

    Raises:
        DeviceLost: It is gone, or takes none in ``ZERO_TRIES``.
    """
    if not any(link.write(packet) for _ in range(ZERO_TRIES)):
        raise DeviceLost(f"{name}: does not take that it is to give no force")


def ask_anew(link: Link, stream: ReplyStream, name: str) -> float:
    """Takes the force away and asks where the grip is now, after the loop stood still.

    Nothing takes the force of a Falcon away while its host stands still. The reply that waits is to
    a question from before that; a coupling that is re-seated by it is stretched, as soon as the
    next reply comes, by all that the hand has moved since.

    Args:
        link: To a Falcon that speaks.
        stream: Takes its replies; the newest is then to a question asked here.
        name: What errors call it.

    Returns:
        When it was first asked, in s: the pose is no older.

    Raises:
        DeviceLost: It is gone, or silent.
    """
    asked = link.now()
    for _ in range(2):  # the first reply may be to a question of the loop's
        if not ask(link, stream, Request.GREEN, SILENCE):
            raise silent(name)
    return asked


def bring_up(
    link: Link, stream: ReplyStream, name: str, firmware: str | None, tell: Notify
) -> None:
    """Makes a Falcon speak: asks it first, and sends its program only where it does not answer.

    Args:
        link: To the Falcon.
        stream: Takes its replies.
        name: What errors call it.
        firmware: File with its program, or None.
        tell: Told how far the program is.

    Raises:
        DeviceError: It has no program, and none was named or it does not run.
        DeviceLost: It is gone.
    """
    image = None if firmware is None else read_firmware(firmware)
    enter_run_mode(link)
    if speaks(link, stream):
        return
    if image is None:
        raise DeviceError(
            f"{name}: has no firmware (it forgets it without power); name the file with "
            "the maker's program: falcon:firmware=FILE"
        )
    upload(link, image, name, tell)
    enter_run_mode(link)
    stream.clear()
    if not speaks(link, stream):
        raise DeviceError(
            f"{name}: took '{firmware}', and does not answer; it is no firmware for it"
        )


def home(link: Link, stream: ReplyStream, name: str, tell: Notify) -> None:
    """Waits until every encoder has passed its zero; asks the user to see to it.

    Args:
        link: To a Falcon that speaks.
        stream: Takes its replies.
        name: What errors call it.
        tell: Told what the user has to do.

    Raises:
        DeviceError: Nobody did within ``HOMING_TIME``.
        DeviceLost: It is gone, or fell silent.
    """
    end, is_told = link.now() + HOMING_TIME, False
    heard = link.now()
    while link.now() < end:
        if ask(link, stream, Request.HOMING | Request.RED, SILENCE):
            heard = link.now()
            if stream.reply["homed"][0] == _ALL:
                if is_told:
                    tell(f"{name}: homed")
                return
        elif link.now() - heard > 2 * SILENCE:
            raise silent(name)
        if not is_told:
            is_told = True
            tell(f"{name}: pull the grip all the way out and push it back in, slowly")
    raise DeviceError(
        f"{name}: was not homed within {HOMING_TIME:g} s; open it again and move the "
        "grip all the way out and in"
    )
