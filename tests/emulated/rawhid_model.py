"""A home-made device that speaks raw HID: a handle in a hand behind frames of 64 bytes.

Written from hapticbridge/device/rawhid.md; it shares no code with the driver's codec.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from emulated.handle import Handle
from emulated.hid_device import HidDevice
from hapticbridge.device import SimulatedDevice

NAN = math.nan


@dataclass(frozen=True, kw_only=True)
class Claims:
    """The data sheet that a model claims, in the frame's order."""

    axes: int = 0b111111
    rate: float = 1000.0
    mass: float = 0.1
    damping: float = 2.0
    rotational_inertia: float = 1e-4
    rotational_damping: float = 2e-3
    friction: float = 0.0
    resolution: float = 0.0
    force_limit: float = 10.0
    torque_limit: float = 0.5
    speed_limit: float = 5.0
    delay: float = 0.0


GRIP = 64
"""Bit of the sheet's axes for a grip axis."""


@dataclass(frozen=True, kw_only=True)
class Fingers:
    """Grip axis that a model claims, in the page's order, and that its fingers have."""

    mass: float = 0.05
    damping: float = 2.0
    friction: float = NAN
    resolution: float = 0.0
    force_limit: float = 8.0
    speed_limit: float = 3.0
    travel: float = 0.03


def crc(data: bytes) -> int:
    """CRC-16/CCITT-FALSE, bit by bit, as the document gives it."""
    register = 0xFFFF
    for byte in data:
        register ^= byte << 8
        for _ in range(8):
            register = (register << 1) ^ (0x1021 if register & 0x8000 else 0)
        register &= 0xFFFF
    return register


class RawHid(HidDevice):
    """Streams a state frame per period and obeys the newest force frame, as the document asks.

    Args:
        mechanics: What is behind it; it then reports that pose, rounded to the claimed resolution.
        grip: What is behind its grip axis, along x; without one it has none.
        fingers: The page of the sheet for it.
        claims: Its data sheet.
        title: Its name in the sheet.

    Attributes:
        wrench: What the motors give, shape (6,).
        is_enabled: Whether they are on.
        status: Further bits of the status that the test wants reported.
        frames: How many state frames it has made.
        lose: Numbers of state frames to lose; ``damage``: to send with one bit flipped.
        motion: 12 numbers to report in the place of the handle's, None for those.
    """

    vendor, product = 0x16C0, 0x0486
    manufacturer, product_name = "Teensyduino", "Teensyduino RawHID"
    # vendor page FFAB, usage 0200: 64 bytes in, 64 bytes out, no report numbers
    report_descriptor = bytes.fromhex(
        "06abff 0a0002 a101 7508 1500 26ff00 9540 0901 8102 9540 0902 9102 c0"
    )

    def __init__(
        self,
        mechanics: SimulatedDevice | None = None,
        claims: Claims | None = None,
        *,
        title: str = "test bench",
        serial: str = "12345",
        clock_start_us: int = 0,
        grip: SimulatedDevice | None = None,
        fingers: Fingers | None = None,
    ) -> None:
        super().__init__()
        self._grip = None if grip is None else Handle(grip)
        self._fingers = fingers or Fingers()
        self.grip_force = 0.0
        self.serial = serial
        self.claims = claims or Claims()
        self.wrench: NDArray[np.float64] = np.zeros(6)
        self.is_enabled, self.status, self.frames, self.buttons = False, 0, 0, 0
        self.lose: set[int] = set()
        self.damage: set[int] = set()
        self.motion: tuple[float, ...] | None = None
        self.commands = 0
        self.is_silent = False
        self._title = title
        self._handle = None if mechanics is None else Handle(mechanics)
        self.clock_start_us = clock_start_us
        self._echo, self.sequence = 0, 0
        self._start: float | None = None
        self._sent = 0
        self._expires: float | None = None
        self._has_expired = False

    # -- time ------------------------------------------------------------------------------------

    def advance(self, now: float) -> None:
        if self._start is None:
            self._start = now
        period = 1.0 / self.claims.rate
        while (due := self._start + (self._sent + 1) * period) <= now + 1e-9:
            self._move(due)
            self._send_state(due)
            self._sent += 1
        self._move(now)

    def next_time(self, now: float) -> float | None:
        if self._start is None:
            return now
        return self._start + (self._sent + 1) / self.claims.rate

    def _move(self, now: float) -> None:
        """Moves the handle up to a time, with the watchdog striking on the way."""
        if self._expires is not None and now >= self._expires:
            self._push_with(self._expires)
            self.wrench, self._expires, self._has_expired = np.zeros(6), None, True
            self.grip_force = 0.0
        self._push_with(now)

    def _push_with(self, now: float) -> None:
        if self._handle is not None:
            self._handle.force[:] = 0.0 if self.status & (8 | 16) else self.wrench
            self._handle.advance(now)
        if self._grip is not None:
            self._grip.force[0] = 0.0 if self.status & (8 | 16) else self.grip_force
            self._grip.advance(now)

    # -- frames ----------------------------------------------------------------------------------

    def _send_state(self, when: float) -> None:
        self.frames += 1
        self.sequence = (self.sequence + 1) & 0xFFFF
        if self.is_silent or self.frames in self.lose:
            return
        status = self.status | self.is_enabled | self._has_expired << 1
        time_us = (self.clock_start_us + round(1e6 * when)) & 0xFFFFFFFF
        head = (0x48, 1, 0x53, status, self.sequence, self.buttons, time_us)
        body = struct.pack("<BBBBHHI", *head) + struct.pack("<12f", *self._motion_now())
        body += struct.pack("<H", self._echo)
        frame = bytearray(body + struct.pack("<H", crc(body)))
        if self.frames in self.damage:
            frame[20] ^= 0x10
        self.push(bytes(frame))

    def _motion_now(self) -> tuple[float, ...]:
        if self.motion is not None or self._handle is None:
            return self.motion or (0.0,) * 12
        position, quaternion = self._handle.pose()
        if step := self.claims.resolution:
            position = step * np.round(position / step)
        w, x, y, z = quaternion
        turned = Rotation.from_quat([x, y, z, w]).as_rotvec()
        velocity = self._handle.velocity()
        if self._grip is not None:
            velocity[3:] = self._grip.pose()[0][0], self._grip.velocity()[0], 0.0
        return (*position, *turned, *velocity)

    def output(self, report: bytes, now: float) -> None:
        good = len(report) == 64 and report[:2] == b"\x48\x01"
        if not good or struct.unpack_from("<H", report, 62)[0] != crc(report[:62]):
            self.status |= 32
            return
        self.status &= ~32
        kind, option, sequence, watchdog_ms = struct.unpack_from("<BBHH", report, 2)
        if kind == 0x3F:
            self._send_sheet(option, sequence)
        elif kind == 0x46:
            wrench = np.array(struct.unpack_from("<6f", report, 8))
            (grip,) = struct.unpack_from("<f", report, 32)
            if not np.isfinite([*wrench, grip]).all():
                return
            self.commands += 1
            self.is_enabled = bool(option & 1)
            self.wrench = wrench if self.is_enabled else np.zeros(6)
            self.grip_force = grip if self.is_enabled else 0.0
            self._echo = sequence
            self._expires, self._has_expired = now + 1e-3 * min(watchdog_ms, 1000), False

    def _send_sheet(self, page: int, sequence: int) -> None:
        head = struct.pack("<BBBBH", 0x48, 1, 0x44, page, sequence)
        c = self.claims
        numbers = (
            c.rate, c.mass, c.damping, c.rotational_inertia, c.rotational_damping, c.friction,
            c.resolution, c.force_limit, c.torque_limit, c.speed_limit, c.delay,
        )  # fmt: skip
        if page == 0:
            axes = c.axes | (GRIP if self._grip is not None else 0)
            body = head + struct.pack("<H11f10x", axes, *numbers)
        elif page == 2:
            f = self._fingers
            own = f.mass, f.damping, f.friction, f.resolution, f.force_limit, f.speed_limit
            body = head + struct.pack("<H7f26x", 0, *own, f.travel)
        else:
            body = head + bytes(2) + self._title.encode()[:54].ljust(54, b"\0")
        self.push(body + struct.pack("<H", crc(body)))
