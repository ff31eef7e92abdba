"""Frames of ``rawhid.md``: 64 bytes in each direction, little-endian, with a CRC."""

from __future__ import annotations

import math
import struct
from binascii import crc_hqx
from collections.abc import Sequence
from enum import IntEnum, IntFlag
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hapticbridge.device.base import AXES
from hapticbridge.device.driver import printable
from hapticbridge.device.own_loop import SURFACES, BoardSetting, LoopReport, LoopState, ShownTool
from hapticbridge.kernel.pose import canonical, quaternion_log

DOCUMENT = Path(__file__).parents[1] / "rawhid.md"
"""Description of the protocol in this installation; the firmware is beside this module."""

FRAME_BYTES = 64
"""Bytes per frame: the limit of a full-speed interrupt transfer and of Teensy's raw HID report."""

MAGIC, VERSION = 0x48, 1
"""First two bytes of every frame."""

MAX_WATCHDOG_MS = 1000
"""Largest watchdog in ms that a device accepts. A hand can still hold against a force for a
second."""

LARGEST = 1e30
"""Largest magnitude of a number in a frame, in its unit. It lies below the end of float32, 3.4e38,
and far above any real value."""


class Kind(IntEnum):
    """Kind of a frame, byte 2.

    Attributes:
        STATE: From the device: its state.
        SHEET: From the device: a requested page of its data sheet.
        LOOP: From the device: its state, while a loop of its own follows a shown tool.
        REPORT: From the device: counters of that loop.
        FORCE: To the device: a wrench.
        ASK: To the device: request for a page of the sheet.
        LOOP_TURN: From the device: the rotation of that state.
        SETTING: To the device: gains of its loop.
        POSE: To the device: a shown tool with its rotation.
        PLANES: To the device: more surfaces for the next shown tool.
        SHOW: To the device: a shown tool.
    """

    STATE = 0x53
    SHEET = 0x44
    LOOP = 0x4C
    REPORT = 0x52
    LOOP_TURN = 0x55
    FORCE = 0x46
    ASK = 0x3F
    SETTING = 0x47
    POSE = 0x54
    PLANES = 0x50
    SHOW = 0x59


class Status(IntFlag):
    """Status of the device, byte 3 of a state frame.

    Attributes:
        ENABLED: The motors follow the newest force frame.
        WATCHDOG: The watchdog has zeroed the wrench since the newest force frame.
        SATURATED: The motors could not apply the whole wrench.
        FAULT: The device has detected a fault (encoder, driver, temperature) and gives no force.
        NOT_READY: The pose is not valid yet: the device must be homed or calibrated first.
        DAMAGED: A frame with a wrong CRC has come since the newest valid one.
        CAUSE: Cause of the fault (``Cause``); 0 if it is not reported.
    """

    ENABLED = 1
    WATCHDOG = 2
    SATURATED = 4
    FAULT = 8
    NOT_READY = 16
    DAMAGED = 32
    CAUSE = 192


class Cause(IntEnum):
    """Cause of a fault, the bits ``Status.CAUSE``.

    Attributes:
        TEMPERATURE: A motor or its driver is too hot.
        ENCODER: An encoder is not read.
        DRIVER: A motor's driver has switched off.
    """

    TEMPERATURE = 64
    ENCODER = 128
    DRIVER = 192


ENABLE = 1
"""Byte 3 of a force frame, or of a shown tool, that enables the motors."""

HAS_VELOCITY, IS_PLACED, PLANE = 2, 4, 16
"""Byte 3 of a shown tool: its velocity is known, it was put there, and the factor of the number of
surfaces."""

SPEED_STEP, TURN_STEP = 1e-3, 1e-3
"""Steps in m/s and rad/s of the velocities of a shown tool with its rotation. They reach 32 m/s and
32 rad/s, finer ones less far. The tool is led for some ms by them."""

NUMBERS_PAGE, NAME_PAGE, GRIP_PAGE = 0, 1, 2
"""Pages of the sheet, byte 3 of a frame that requests or holds one."""

_STATE = struct.Struct("<BBBBHHI12fH")
_FORCE = struct.Struct("<BBBBHH7f26x")
_GRIP = struct.Struct("<BBBBHH7f26x")
_NUMBERS = struct.Struct("<BBBBHH13f2x")
_NAME = struct.Struct("<BBBBHH54s")
_LOOP = struct.Struct("<BBBBHHI9fqfH")
_REPORT = struct.Struct("<BBBBHH2q3I6f2x")
_SETTING = struct.Struct("<BBBBHH5fq3f14x")
_SHOW = struct.Struct("<BBBBHH6fq4f6x")
_POSE = struct.Struct("<BBBBHH6fq9hf")
_LOOP_TURN = struct.Struct("<BBBBHH10f14x")
_PLANES = struct.Struct("<BBBBHH8f22x")
_CRC = struct.Struct("<H")

_PICOJOULES, _MICRONEWTONS = 1e12, 1e6
_LARGEST_SHORT = 32767


class State(NamedTuple):
    """State of the device.

    Attributes:
        status: ``Status`` bits.
        sequence: 0 to 65535, incremented per state frame, then 0 again.
        buttons: 16 bits, one per button.
        time_us: The device's clock when the pose was latched, in µs modulo 2^32 (71.6 min).
        numbers: Position in m, rotation vector in rad, velocity in m/s, angular velocity in rad/s:
            3 each, in the device's frame. With a grip axis the last three are how far it is closed
            in m, its speed in m/s, and 0.
        echo: Sequence of the newest force frame that the device applies.
    """

    status: int
    sequence: int
    buttons: int
    time_us: int
    numbers: tuple[float, ...]
    echo: int

    @property
    def is_finite(self) -> bool:
        """True if all numbers are finite."""
        return all(map(math.isfinite, self.numbers))


def _known(values: dict[str, float]) -> dict[str, float | None]:
    # shortest text of the float32: 0.1 instead of 0.10000000149
    return {
        name: float(str(np.float32(value))) if math.isfinite(value) else None
        for name, value in values.items()
    }


class LoopTurn(NamedTuple):
    """Rotation of the device while its own loop renders it, the second half of a ``LoopState``.

    Attributes:
        sequence: That of the state.
        rotation, angular_velocity, torque: As of ``LoopState``.
    """

    sequence: int
    rotation: tuple[float, ...]
    angular_velocity: tuple[float, ...]
    torque: tuple[float, ...]


class Numbers(NamedTuple):
    """Page 0 of the device's data sheet; NaN for unknown numbers.

    Attributes:
        axes: Bit i is set if it has axis i of ``AXES``, bit 6 if it has a grip axis, bit 7 if its
            own loop renders rotation beside lines.
        rate: Rate of state frames in Hz.
        mass: Mass in kg.
        damping: Damping in N s/m.
        rotational_inertia: Rotational inertia in kg m².
        rotational_damping: Rotational damping in N m s/rad.
        friction: Coulomb friction per axis in N.
        resolution: Step of the position in m.
        force_limit: Largest norm of the force in N.
        torque_limit: Largest norm of the torque in N m.
        speed_limit: Largest speed in m/s.
        delay: Delay of the device itself in s: from latching a pose to sending it, plus from
            receiving a force to the motors.
        loop_rate: Periods per second of a loop of its own; 0 without one.
        loop_delay: Time in s in that loop from reading a position to its force.
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
    loop_rate: float = 0.0
    loop_delay: float = 0.0

    def known(self) -> dict[str, float | None]:
        """Returns the numbers by name, None for NaN and infinity."""
        values = self._asdict()
        del values["axes"]
        return _known(values)

    @property
    def axis_names(self) -> tuple[str, ...]:
        """Axes by name, in the order of ``AXES``."""
        return tuple(name for i, name in enumerate(AXES) if self.axes >> i & 1)

    @property
    def has_grip(self) -> bool:
        """True if it has a grip axis."""
        return bool(self.axes >> len(AXES) & 1)

    @property
    def is_posed(self) -> bool:
        """True if its own loop renders rotation beside lines."""
        return bool(self.axes >> len(AXES) + 1 & 1)


class GripNumbers(NamedTuple):
    """Page 2 of the data sheet, its grip axis; NaN for unknown numbers.

    Attributes:
        mass: Inertia at the fingers in kg.
        damping: Damping in N s/m.
        friction: Coulomb friction in N.
        resolution: Step of the position in m.
        force_limit: Largest force in N.
        speed_limit: Largest speed in m/s.
        reach: How far it closes in m.
    """

    mass: float
    damping: float
    friction: float
    resolution: float
    force_limit: float
    speed_limit: float
    reach: float

    def known(self) -> dict[str, float | None]:
        """Returns the numbers by name, None for NaN and infinity."""
        return _known(self._asdict())


def crc16(data: bytes) -> int:
    """Returns CRC-16/CCITT-FALSE: x^16 + x^12 + x^5 + 1, start 0xFFFF; 0x29B1 of "123456789"."""
    return crc_hqx(data, 0xFFFF)


def force_frame(
    sequence: int, wrench: tuple[float, ...], watchdog_ms: int, *, is_enabled: bool = True
) -> bytes:
    """Returns the frame that commands a wrench: 6 finite numbers in N and N m.

    A seventh is the force that closes the grip, in N. The device ends the force ``watchdog_ms``, 1
    to 1000, after the last frame.
    """
    flags, numbers = ENABLE if is_enabled else 0, (*wrench, 0.0)[:7]
    return _sealed(_FORCE.pack(MAGIC, VERSION, Kind.FORCE, flags, sequence, watchdog_ms, *numbers))


def ask_frame(sequence: int, page: int) -> bytes:
    """Returns the frame that requests a page of the sheet."""
    return _sealed(_FORCE.pack(MAGIC, VERSION, Kind.ASK, page, sequence, 0, *[0.0] * 7))


def show_frames(
    sequence: int, shown: ShownTool, patience_ms: int, *, is_posed: bool = False
) -> tuple[bytes, ...]:
    """Returns the frames that show a tool; the force fades ``patience_ms`` after the last one.

    ``is_posed`` is true for a loop that renders rotation. Its velocities are rounded, and end at 32
    m/s and 32 rad/s.
    """
    option = (
        ENABLE * shown.is_enabled
        + HAS_VELOCITY * (shown.velocity is not None)
        + IS_PLACED * shown.is_placed
        + PLANE * len(shown.surfaces)
    )
    planes = [number for normal, gap in shown.surfaces for number in (*normal, gap)]
    planes += [0.0] * (4 * SURFACES - len(planes))
    velocity = shown.velocity or (0.0,) * 3
    head = MAGIC, VERSION, Kind.POSE if is_posed else Kind.SHOW, option, sequence, patience_ms
    work = round(_PICOJOULES * shown.work)
    if is_posed:
        shorts = [
            *_shorts(velocity, SPEED_STEP),
            *_shorts(shown.angular_velocity, TURN_STEP),
            *_shorts(planes[:3], 1.0 / _LARGEST_SHORT),
        ]
        body = _POSE.pack(*head, *shown.position, *shown.rotation, work, *shorts, planes[3])
    else:
        body = _SHOW.pack(*head, *shown.position, *velocity, work, *planes[:4])
    frame = _sealed(body)
    if len(shown.surfaces) < 2:
        return (frame,)
    others = _PLANES.pack(MAGIC, VERSION, Kind.PLANES, 0, sequence, 0, *planes[4:])
    return _sealed(others), frame


def setting_frame(sequence: int, setting: BoardSetting) -> bytes:
    """Returns the frame with the gains of a loop on the board."""
    head = MAGIC, VERSION, Kind.SETTING, 0, sequence, 0
    credit = round(_PICOJOULES * setting.credit)
    return _sealed(_SETTING.pack(*head, *setting[:5], credit, *setting[6:]))


def _shorts(numbers: Sequence[float], step: float) -> list[int]:
    """Returns numbers in steps, as 16 bits hold them."""
    most = _LARGEST_SHORT
    return [round(max(min(number / step, most), -most)) for number in numbers]


def _sealed(body: bytes) -> bytes:
    return body + _CRC.pack(crc16(body))


def version_of(frame: bytes) -> int | None:
    """Returns the protocol version of a frame, or None if it is damaged or not a frame."""
    if len(frame) != FRAME_BYTES or frame[0] != MAGIC:
        return None
    (crc,) = _CRC.unpack_from(frame, FRAME_BYTES - 2)
    return frame[1] if crc16(frame[:-2]) == crc else None


Answer = State | LoopState | LoopTurn | LoopReport | Numbers | GripNumbers | str
"""Anything that a device sends."""


def decoded(frame: bytes) -> Answer | None:
    """Decodes any bytes from the device: a state, counters, or a page of the sheet.

    None stands for another length, version or kind, or a damaged frame. Numbers may be any float32.
    """
    if version_of(frame) != VERSION:
        return None
    kind = frame[2]
    if kind == Kind.STATE:
        values = _STATE.unpack_from(frame)
        status, sequence, buttons, time_us = values[3:7]
        return State(status, sequence, buttons, time_us, values[7:19], values[19])
    if kind == Kind.LOOP:
        status, sequence, buttons, time_us, *numbers, passed, tank, echo = _LOOP.unpack_from(frame)[
            3:
        ]
        return LoopState(
            status,
            sequence,
            buttons,
            time_us,
            position=tuple(numbers[:3]),
            velocity=tuple(numbers[3:6]),
            force=tuple(numbers[6:]),
            passed=passed / _PICOJOULES,
            tank=tank,
            echo=echo,
        )
    if kind == Kind.LOOP_TURN:
        sequence, _, *numbers = _LOOP_TURN.unpack_from(frame)[4:]
        w, x, y, z = numbers[:4]
        is_rotation = 0.5 < w * w + x * x + y * y + z * z < 2.0
        turn = quaternion_log(canonical((w, x, y, z))) if is_rotation else (math.nan,) * 3
        return LoopTurn(sequence, turn, tuple(numbers[4:7]), tuple(numbers[7:]))
    if kind == Kind.REPORT:
        sequence, _, changes, work, held_back, ticks, missed, share, heat, *tool, limit = (
            _REPORT.unpack_from(frame)[4:]
        )
        return LoopReport(
            sequence,
            changes / _MICRONEWTONS,
            work / _PICOJOULES,
            held_back,
            ticks,
            missed,
            share,
            temperature=heat if math.isfinite(heat) else None,
            temperature_limit=limit if math.isfinite(limit) and limit > 0.0 else None,
            tool=tuple(tool),
        )
    return _page(frame) if kind == Kind.SHEET else None


def _page(frame: bytes) -> Numbers | GripNumbers | str | None:
    page = frame[3]
    if page == NUMBERS_PAGE:
        return Numbers(*_NUMBERS.unpack_from(frame)[5:])
    if page == GRIP_PAGE:
        return GripNumbers(*_GRIP.unpack_from(frame)[6:])
    if page == NAME_PAGE:
        return printable(_NAME.unpack_from(frame)[6].split(b"\0")[0].decode(errors="replace"))
    return None


class FrameReader:
    """Finds frames in the bytes of a serial line, whatever was lost, doubled or damaged.

    A frame begins at a byte ``MAGIC`` and has a valid CRC. If the 64 bytes from there are not
    valid, the search continues one byte later. A fault therefore costs only the frames that it
    touched. 64 random bytes after ``MAGIC`` pass as a frame once in 2^16.

    Attributes:
        dropped: Number of bytes that belonged to no frame.
    """

    def __init__(self) -> None:
        self._rest = bytearray()
        self.dropped = 0

    def take(self, data: bytes) -> list[bytes]:
        """Returns the frames that these bytes complete, oldest first, of any version."""
        rest, frames, place = self._rest, [], 0
        rest += data
        while len(rest) - place >= FRAME_BYTES:
            frame = bytes(rest[place : place + FRAME_BYTES])
            if version_of(frame) is not None:
                frames.append(frame)
                place += FRAME_BYTES
                continue
            start = rest.find(MAGIC, place + 1)
            start = len(rest) if start < 0 else start
            self.dropped += start - place
            place = start
        del rest[:place]
        return frames
