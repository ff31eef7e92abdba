"""A Falcon as a program: FTDI bridge, loader, signal processor, three legs and a grip in a hand.

Written from the description of the protocol and the lengths of the legs; it shares no code with the
driver. Where the sources leave something open, the model is one of the possible devices.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emulated.handle import Handle
from emulated.usb_device import BULK, Endpoint, Setup, StallError, UsbDevice

BAUD = {0x4138: 9600.0, 0x0015: 142857.0, 0x0002: 1.5e6}
BITS = 10  # a byte on the line, with start and stop bit
THINKING = 20e-6  # s from the last byte of a packet to the first of its answer
PACKET = 64

# metres and degrees, as the legs are described: thigh, shin, plate, link + link, lean, hip
A, B, C, DE, F, R, S = 0.060, 0.1025, 0.01443, 0.0225, -0.025, 0.0400, -0.02309
PHI = tuple(math.radians(90.0 - 120.0 * i + 15.0) for i in range(3))
DEGREES_PER_COUNT = 0.036434
MIDDLE = 0.125


def leg_angles(x: float, y: float, z: float) -> tuple[float, ...]:
    """Thigh angles in rad, by intersecting the knee's circle with the shin's."""
    angles = []
    for phi in PHI:
        u = math.cos(phi) * x + math.sin(phi) * y - R + C
        v = -math.sin(phi) * x + math.cos(phi) * y - S + F
        shin = B * math.sin(math.acos(v / B)) + DE
        far = math.hypot(u, z)
        # the triangle of thigh, shin and the line from hip to plate
        at_hip = math.acos((A * A + far * far - shin * shin) / (2 * A * far))
        angles.append(math.atan2(z, u) - at_hip)
    return tuple(angles)


def maker_frame(p: NDArray[np.float64]) -> tuple[float, float, float]:
    """From right, away, up to the machine's own right, up, towards the user."""
    return float(p[0]), float(p[2]), MIDDLE - float(p[1])


@dataclass
class Faults:
    """Faults of the emulated device, for tests."""

    is_mute: bool = False  # takes packets, answers none
    is_deaf: bool = False  # the loader hears nothing
    noise: bytes = b""  # before every answer
    bad_echo_at: int = -1  # byte of the program that is echoed wrongly
    is_cut_short: bool = False  # leaves out a byte of every second answer


class FalconModel(UsbDevice):
    """The device.

    Args:
        handle: What the hand holds: positions from the middle of the workspace.
        serial: Its serial number.
        program: The program it runs, None: only its loader runs.
        is_homed: Whether its encoders have passed their zeros.
        heeds_events: Whether its bridge passes an answer on at the event character.
        valid: The only program that would run; None: any.
    """

    vendor, product, release = 0x0403, 0xCB48, 0x0400
    control_size = 8
    endpoints = (Endpoint(0x81, BULK), Endpoint(0x02, BULK))
    manufacturer, product_name = "FTDI", "FALCON HAPTIC"

    def __init__(
        self,
        handle: Handle,
        *,
        serial: str = "FT000001",
        program: bytes | None = b"resident",
        is_homed: bool = True,
        heeds_events: bool = False,
        valid: bytes | None = None,
    ) -> None:
        super().__init__()
        self.serial = serial
        self.handle, self.faults = handle, Faults()
        self.program, self.valid = program, valid
        self.buttons, self.lights, self.is_homing = 0, 0, False
        self.motors = (0, 0, 0)
        self.requests = 0
        self.uploaded = b""
        self._offsets = [0, 0, 0] if is_homed else [311, -270, 95]
        self._homed = [is_homed] * 3
        self._before: tuple[int, ...] | None = None
        self._heeds_events = heeds_events
        self._event: int | None = None
        self._latency, self._baud = 16e-3, 9600.0
        self._dtr = False
        self._is_loading = False
        self._inbox: deque[tuple[float, int]] = deque()  # bytes on their way to the device
        self._line_out = self._line_in = 0.0
        self._outbox: deque[tuple[float, int]] = deque()  # bytes on their way to the host
        self._text = bytearray()
        self._last_sent = 0.0

    # -- the bridge ------------------------------------------------------------------------------

    def request(self, setup: Setup, data: bytes, now: float) -> bytes:
        if setup.request_type != 0x40:
            raise StallError
        value = setup.value
        if setup.request == 0:
            if value in (0, 1):
                self._outbox.clear()
            if value in (0, 2):
                self._inbox.clear()
                self._text.clear()
        elif setup.request == 1:
            self._set_line(value)
        elif setup.request == 3:
            self._set_baud(value)
        elif setup.request == 6:
            self._event = value & 0xFF if value & 0x0100 and self._heeds_events else None
        elif setup.request == 9:
            self._latency = 1e-3 * value
        elif setup.request not in (2, 4):
            raise StallError
        return b""

    def _set_line(self, value: int) -> None:
        if value & 0x0100:
            if value & 1 and not self._dtr:  # the rising line restarts the processor
                self.program, self._is_loading, self.uploaded = None, False, b""
            self._dtr = bool(value & 1)

    def _set_baud(self, value: int) -> None:
        self._baud = BAUD.get(value, 300.0)
        if self._baud > 1e6 and self._is_loading:
            self._is_loading = False
            if self.valid is None or self.uploaded == self.valid:
                self.program = self.uploaded

    def accept(self, endpoint: int, data: bytes, now: float) -> None:
        if endpoint != 0x02:
            raise StallError
        when = max(now, self._line_out)
        for byte in data:
            when += BITS / self._baud
            self._inbox.append((when, byte))
        self._line_out = when

    def take(self, endpoint: int, length: int, now: float) -> bytes | None:
        if endpoint != 0x81:
            raise StallError
        room = min(length, PACKET) - 2
        ready = 0
        is_event = False
        for when, byte in self._outbox:
            if when > now or ready == room:
                break
            ready += 1
            is_event |= byte == self._event
        if ready < room and not is_event and now < self._last_sent + self._latency:
            return None
        self._last_sent = now
        return b"\x01\x60" + bytes(self._outbox.popleft()[1] for _ in range(ready))

    def next_time(self, now: float) -> float | None:
        times = [self._inbox[-1][0]] if self._inbox else []
        if self.is_read_pending(0x81):  # else its timer fires unheard
            times.append(self._last_sent + self._latency)
            if self._event is not None and self._outbox:
                times.append(self._outbox[-1][0])
        return max(min(times), now) if times else None

    def advance(self, now: float) -> None:
        while self._inbox and self._inbox[0][0] <= now:
            when, byte = self._inbox.popleft()
            self._receive(byte, when)
        self.handle.advance(now)

    # -- the processor ---------------------------------------------------------------------------

    def _answer(self, data: bytes, when: float) -> None:
        when = max(when, self._line_in)
        for byte in data:
            when += BITS / self._baud
            self._outbox.append((when, byte))
        self._line_in = when

    def _receive(self, byte: int, when: float) -> None:
        if self.program is None:
            self._load(byte, when)
            return
        if self._baud < 1e6:
            return  # noise to a program that listens at 1.5 Mbaud
        self._text.append(byte)
        del self._text[:-16]
        if len(self._text) == 16 and self._text[0] == 0x3C and self._text[15] == 0x3E:
            self._packet(bytes(self._text), when)
            self._text.clear()

    def _load(self, byte: int, when: float) -> None:
        if self._is_loading:
            wrong = len(self.uploaded) == self.faults.bad_echo_at
            self.uploaded += bytes([byte])
            self._answer(bytes([byte ^ 0x40 if wrong else byte]), when)
            return
        if self.faults.is_deaf:
            return
        self._text.append(byte)
        del self._text[:-3]
        if self._baud < 1e4 and bytes(self._text) == b"\x0aC\x0d" and self._dtr:
            self._answer(b"\x00\x0aD,\x0d", when)
        elif 1e4 < self._baud < 1e6 and byte == 0x41 and not self._dtr:
            self._is_loading = True
            self._answer(b"A", when)

    def _packet(self, packet: bytes, when: float) -> None:
        self.handle.advance(when)
        self.requests += 1
        words = [packet[1 + 4 * i : 5 + 4 * i] for i in range(3)]
        numbers = [sum((c - 0x41) << 4 * j for j, c in enumerate(word)) for word in words]
        self.motors = tuple(n - 0x10000 if n >= 0x8000 else n for n in numbers)  # type: ignore[assignment]
        flags = packet[13] - 0x41
        self.is_homing, self.lights = bool(flags & 1), flags & 0xE
        self._push()
        if self.faults.is_mute:
            return
        body = b"".join(
            bytes(0x41 + (count >> 4 * j & 15) for j in range(4)) for count in self.encoders()
        )
        homed = sum(1 << i for i in range(3) if self._homed[i]) if self.is_homing else 0
        answer = b"<" + body + bytes([0x41 + (self.buttons & 15 | homed << 4)]) + b"A>"
        if self.faults.is_cut_short and self.requests % 2:
            answer = answer[:7] + answer[8:]
        self._answer(self.faults.noise + answer, when + THINKING)

    def encoders(self) -> tuple[int, ...]:
        """Counts as the processor has them."""
        angles = leg_angles(*maker_frame(self.handle.pose()[0]))
        counts = tuple(round((math.degrees(t) - 35.0) / DEGREES_PER_COUNT) for t in angles)
        before, self._before = self._before or counts, counts
        if self.is_homing:
            for i in range(3):
                if before[i] * counts[i] <= 0:
                    self._homed[i], self._offsets[i] = True, 0
        return tuple(c + o for c, o in zip(counts, self._offsets, strict=True))

    def _push(self) -> None:
        """Turns motor units into a force on the grip: work per way, each way tried."""
        point, step = self.handle.pose()[0], 1e-6
        torques = [-1e-4 * units for units in self.motors]
        for axis in range(3):
            ahead, behind = point.copy(), point.copy()
            ahead[axis] += step
            behind[axis] -= step
            turned = zip(
                leg_angles(*maker_frame(ahead)), leg_angles(*maker_frame(behind)), strict=True
            )
            work = sum(t * (a - b) for t, (a, b) in zip(torques, turned, strict=True))
            self.handle.force[axis] = work / (2 * step)
