"""The frames of ``rawhid.md``: 64 bytes each way, little-endian, checked by a CRC."""

from __future__ import annotations

import math
import struct
from binascii import crc_hqx
from enum import IntEnum, IntFlag
from typing import NamedTuple

import numpy as np

from hapticbridge.device.base import AXES
from hapticbridge.device.family import printable

FRAME_BYTES = 64
"""What a full-speed interrupt transfer carries, and Teensy's raw HID report holds."""

MAGIC, VERSION = 0x48, 1
"""First two bytes of every frame."""

LONGEST_WATCHDOG_MS = 1000
"""A device obeys no longer time: a second is what a hand can still hold against."""

LARGEST = 1e30
"""Of any number in a frame: float32 ends at 3.4e38, and nothing that is felt is near this."""


class Kind(IntEnum):
    """Byte 2 of a frame.

    Attributes:
        STATE: From the device: where it is.
        SHEET: From the device: what it is, page by page, when it was asked.
        FORCE: To the device.
        ASK: To the device: send a page of the sheet.
    """

    STATE = 0x53
    SHEET = 0x44
    FORCE = 0x46
    ASK = 0x3F


class Status(IntFlag):
    """Byte 3 of a state frame.

    Attributes:
        ENABLED: The motors follow the newest force frame.
        WATCHDOG: The watchdog has zeroed the wrench since the newest force frame.
        SATURATED: The motors could not give all of it.
        FAULT: The device found itself broken (encoder, driver, temperature) and gives no force.
        NOT_READY: The pose is not valid yet: it must be homed or calibrated first.
        DAMAGED: A frame with a wrong CRC has come since the newest good one.
    """

    ENABLED = 1
    WATCHDOG = 2
    SATURATED = 4
    FAULT = 8
    NOT_READY = 16
    DAMAGED = 32


ENABLE = 1
"""Byte 3 of a force frame: the motors may act."""

NUMBERS_PAGE, NAME_PAGE = 0, 1
"""Pages of the sheet, byte 3 of a frame that asks for one or holds one."""

NAME_BYTES = 54

_STATE = struct.Struct("<BBBBHHI12fH")
_FORCE = struct.Struct("<BBBBHH6f30x")
_NUMBERS = struct.Struct("<BBBBHH11f10x")
_NAME = struct.Struct("<BBBBHH54s")
_CRC = struct.Struct("<H")


class State(NamedTuple):
    """Where the device is.

    Attributes:
        status: ``Status`` bits.
        sequence: 0 to 65535, one more per state frame, then 0 again.
        buttons: One bit each, 16.
        time_us: The device's clock when the pose was latched, in µs modulo 2^32 (71.6 min).
        numbers: Position in m, rotation vector in rad, velocity in m/s, angular velocity in rad/s:
            3 each, in the device's frame.
        echo: Sequence of the newest force frame that the device obeys.
    """

    status: int
    sequence: int
    buttons: int
    time_us: int
    numbers: tuple[float, ...]
    echo: int

    @property
    def is_finite(self) -> bool:
        """Whether every number is one."""
        return all(map(math.isfinite, self.numbers))


class Numbers(NamedTuple):
    """What the device says of itself, page 0: NaN where it does not know.

    Attributes:
        axes: Bit i set: it has axis i of ``device.AXES``.
        rate: State frames per second.
        mass: In kg.
        damping: In N s/m.
        rotational_inertia: In kg m².
        rotational_damping: In N m s/rad.
        friction: In N, per axis.
        resolution: In m.
        force_limit: In N, by norm.
        torque_limit: In N m, by norm.
        speed_limit: In m/s.
        delay: In s, what the device itself adds: from latching a pose to sending it, plus from
            receiving a force to the motors.
    """

    axes: int
    rate: float
    mass: float
    damping: float
    rotational_inertia: float
    rotational_damping: float
    friction: float
    resolution: float
    force_limit: float
    torque_limit: float
    speed_limit: float
    delay: float

    def known(self) -> dict[str, float | None]:
        """Returns the numbers by name, None for what is not a number."""
        values = self._asdict()
        del values["axes"]
        # as short as a float32 allows: 0.1 and not 0.10000000149, which nobody typed
        return {
            name: float(str(np.float32(value))) if math.isfinite(value) else None
            for name, value in values.items()
        }

    @property
    def axis_names(self) -> tuple[str, ...]:
        """The axes by name, in the order of ``device.AXES``."""
        return tuple(name for i, name in enumerate(AXES) if self.axes >> i & 1)


def crc16(data: bytes) -> int:
    """Returns CRC-16/CCITT-FALSE: x^16 + x^12 + x^5 + 1, start 0xFFFF; 0x29B1 of "123456789"."""
    return crc_hqx(data, 0xFFFF)


def force_frame(
    sequence: int, wrench: tuple[float, ...], watchdog_ms: int, *, is_enabled: bool = True
) -> bytes:
    """Returns the frame that commands a wrench.

    Args:
        sequence: 0 to 65535.
        wrench: Force in N and torque in N m on the device, in its frame; 6 finite numbers.
        watchdog_ms: After how many ms without a force frame the device gives none, 1 to 1000.
        is_enabled: Whether the motors may act at all.
    """
    flags = ENABLE if is_enabled else 0
    return _sealed(_FORCE.pack(MAGIC, VERSION, Kind.FORCE, flags, sequence, watchdog_ms, *wrench))


def ask_frame(sequence: int, page: int) -> bytes:
    """Returns the frame that asks for a page of the sheet."""
    return _sealed(_FORCE.pack(MAGIC, VERSION, Kind.ASK, page, sequence, 0, *[0.0] * 6))


def state_frame(state: State) -> bytes:
    """Returns a state frame, as a device sends it."""
    return _sealed(
        _STATE.pack(
            MAGIC,
            VERSION,
            Kind.STATE,
            state.status,
            state.sequence,
            state.buttons,
            state.time_us,
            *state.numbers,
            state.echo,
        )
    )


def sheet_frames(sequence: int, numbers: Numbers, name: str) -> tuple[bytes, bytes]:
    """Returns both pages of a sheet, as a device sends them.

    Args:
        sequence: Of the frame that asked.
        numbers: Page 0.
        name: Page 1, at most 54 bytes in UTF-8; what is longer is cut.
    """
    head = MAGIC, VERSION, Kind.SHEET
    text = name.encode()[:NAME_BYTES].decode(errors="ignore").encode()
    return (
        _sealed(_NUMBERS.pack(*head, NUMBERS_PAGE, sequence, *numbers)),
        _sealed(_NAME.pack(*head, NAME_PAGE, sequence, 0, text)),
    )


def _sealed(body: bytes) -> bytes:
    return body + _CRC.pack(crc16(body))


def version_of(frame: bytes) -> int | None:
    """Returns the protocol's version that a frame is of, or None if it is no undamaged frame."""
    if len(frame) != FRAME_BYTES or frame[0] != MAGIC:
        return None
    (crc,) = _CRC.unpack_from(frame, FRAME_BYTES - 2)
    return frame[1] if crc16(frame[:-2]) == crc else None


def decoded(frame: bytes) -> State | Numbers | str | None:
    """Reads what a device sent.

    Args:
        frame: Any bytes.

    Returns:
        A state, page 0 of the sheet, the name of page 1; None for everything else: of another
        length, version or kind, or damaged. Numbers may be anything that a float32 holds.
    """
    if version_of(frame) != VERSION:
        return None
    kind, page = frame[2], frame[3]
    if kind == Kind.STATE:
        values = _STATE.unpack_from(frame)
        status, sequence, buttons, time_us = values[3:7]
        return State(status, sequence, buttons, time_us, values[7:19], values[19])
    if kind == Kind.SHEET and page == NUMBERS_PAGE:
        return Numbers(*_NUMBERS.unpack_from(frame)[5:])
    if kind == Kind.SHEET and page == NAME_PAGE:
        return printable(_NAME.unpack_from(frame)[6].split(b"\0")[0].decode(errors="replace"))
    return None
