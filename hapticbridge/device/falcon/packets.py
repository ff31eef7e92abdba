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

from enum import IntFlag

import numpy as np
from numpy.typing import NDArray

from hapticbridge.jit import compiled

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
