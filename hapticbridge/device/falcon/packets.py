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

from enum import IntFlag

import numpy as np
from numpy.typing import NDArray

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
