"""Datagrams between a program and the device's loop: fixed records, and a tag under a token.

Each datagram tells the newest state, so one that is lost or overtaken needs no repetition: the
receiver drops what is older than what it has. Both sides hold the token; the tag is HMAC-SHA256 of
the record under it. A datagram without the right tag, of another size or version, or older than the
newest one of the same program is dropped. A loop serves the program that greeted it last. What is
told is not secret: across a network that others read, use a tunnel.
"""

from __future__ import annotations

import hmac
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from hapticbridge.kernel.record import POST_DTYPE

VERSION = 3
"""Version of the datagrams; both sides must have the same one."""

TAG = 16
"""Bytes of a tag; 2^128 guesses would be needed."""

STRANGER = b"hapticbridge: another token or version"
"""Answer to a datagram that is not taken. It has no tag, because the token may be missing."""

WORDS = 300
"""Bytes of a sentence in a datagram."""


class Call(IntEnum):
    """Kind of a call from a program to the loop.

    Attributes:
        GREET: It is there, and has nothing to show yet.
        SHOW: Its tool has moved, or was put somewhere, where the handle belongs, too.
        ADVANCE: Simulated time may go on by a number of ticks.
        LEAVE: It ends.
    """

    GREET = 0
    SHOW = 1
    ADVANCE = 2
    LEAVE = 3


CALL_DTYPE = np.dtype(
    [
        ("version", "<i8"),
        ("program", "<i8"),
        ("sequence", "<i8"),
        ("call", "<i8"),
        ("ticks", "<i8"),
        ("placed", "<i8"),
        ("place", "<f8", 7),
        ("post", POST_DTYPE),
    ]
)
"""From the program to the loop: a random number that stands for the program, number of its call,
what it is (``Call``), ticks of simulated time (of LEAVE, 1 if an exception ends it), number of the
newest call that put the tool somewhere, the pose there, and the tool as shown last."""

STATE_DTYPE = np.dtype(
    [
        ("version", "<i8"),
        ("program", "<i8"),
        ("sequence", "<i8"),
        ("answered", "<i8"),
        ("placed", "<i8"),
        ("is_over", "<i8"),
        ("is_simulated", "<i8"),
        ("tick", "<i8"),
        ("buttons", "<i8"),
        ("lever", "<f8"),
        ("period", "<f8"),
        ("credit", "<f8"),
        ("grip", "<f8"),
        ("handle", "<f8", 7),
        ("velocity", "<f8", 6),
        ("wrench", "<f8", 6),
        ("gains", "<f8", 4),
        ("levels", "<f8", 2),
        ("words", f"S{WORDS}"),
    ]
)
"""From the loop to the program: the program that is meant, number of the message, of the newest
ADVANCE and of the call that put the tool somewhere that are done, 1 at the end of the run and 2 at
one by the guard, 1 if the time is simulated, tick, bits of the buttons, share of the wrench that is
sent (0 while the handle does not follow), T in s, what the tank has for the hand in J, how far the
device's grip axis is closed in m (NaN without one), the handle's pose and velocity in the program's
frame, the wrench on the device in N and N m, the requested K, B, K_r, B_r, the coupling's levels on
the tool in N and N m, and why the run ended."""


def packed(record: NDArray[np.void], token: bytes) -> bytes:
    """Returns the datagram of a record, (1,)."""
    data = record.tobytes()
    return data + hmac.digest(token, data, "sha256")[:TAG]


def unpacked(data: bytes, kind: np.dtype[np.void], token: bytes) -> np.void | None:
    """Returns the record of a datagram; None if it is of another kind, or its tag is wrong."""
    body, tag = data[:-TAG], data[-TAG:]
    if len(body) != kind.itemsize:
        return None
    if not hmac.compare_digest(tag, hmac.digest(token, body, "sha256")[:TAG]):
        return None
    record: np.void = np.frombuffer(body, kind)[0]
    return record if record["version"] == VERSION else None
