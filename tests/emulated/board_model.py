"""A home-made device whose board runs ``hb_loop``: its firmware, compiled, behind raw HID."""

from __future__ import annotations

import ctypes
from collections import deque
from dataclasses import dataclass

import numpy as np
from board_attack import floats
from numpy.typing import NDArray

from emulated.hid_device import HidDevice
from emulated.rawhid_model import RawHid
from hapticbridge.device import SimulatedDevice
from hapticbridge.device.own_loop import LoopReport
from hapticbridge.device.rawhid.protocol import decoded
from hapticbridge.kernel.pose import quaternion_log, rotation_between

POSE = 0b10000000
"""Axis bit of a board whose loop renders lines and rotations."""

STATE_PERIOD = 1.01e-3
"""Time in s between two state frames: a little more than a full-speed host polls in."""


@dataclass(frozen=True, kw_only=True)
class BoardSheet:
    """Data sheet of a board: axes as bits, and numbers in SI units."""

    axes: int = 0b111
    period: float = 1e-4
    damping: float = 2.0
    friction: float = 0.1
    resolution: float = 1e-5
    force_limit: float = 10.0
    speed_limit: float = 5.0
    mass: float = 0.1
    loop_delay: float = 1e-5
    rotational_damping: float = 2e-3
    rotational_inertia: float = 1e-4
    torque_limit: float = 0.3


class Firmware:
    """The firmware's board, compiled; poses are position and quaternion, and times are in s.

    Args:
        library: ``board_attack.built_loop``.
        sheet: What the board says.
    """

    def __init__(self, library: ctypes.CDLL, sheet: BoardSheet) -> None:
        own, self._library = sheet, library
        numbers = [own.damping, own.friction, own.resolution]
        numbers += [own.force_limit, own.speed_limit, own.mass, own.loop_delay]
        numbers += [own.rotational_damping, own.rotational_inertia, own.torque_limit]
        new = library.board_new(own.axes, ctypes.c_float(own.period), floats(numbers))
        self._board = ctypes.c_void_p(new)

    def receive(self, frame: bytes, now: float) -> bool:
        """Returns True if a frame from the host was taken."""
        return bool(self._library.board_receive(self._board, frame, _us(now)))

    def tick(self, pose: NDArray[np.float32], now: float, wrench: NDArray[np.float32]) -> None:
        """Runs a period; ``wrench`` receives force and torque."""
        self._library.board_tick(self._board, floats(pose), _us(now), floats(wrench))

    def state(self, pose: NDArray[np.float32], status: int, now: float) -> bytes:
        """Returns the next state frame."""
        frame = ctypes.create_string_buffer(64)
        self._library.board_state(self._board, floats(pose), status, _us(now), frame)
        return frame.raw

    def more(self) -> bytes | None:
        """Returns the second frame of the last state; None without one."""
        frame = ctypes.create_string_buffer(64)
        return frame.raw if self._library.board_more(self._board, frame) else None

    def answer(self) -> bytes | None:
        """Returns the requested page of the sheet; None without a request."""
        frame = ctypes.create_string_buffer(64)
        return frame.raw if self._library.board_answer(self._board, frame) else None

    def heat(self, temperature: float, limit: float) -> None:
        """Sets the temperature of the motors and its limit in °C."""
        numbers = ctypes.c_float(temperature), ctypes.c_float(limit)
        self._library.board_heat(self._board, *numbers)


class LoopBoard(HidDevice):
    """Runs the firmware's board in virtual time, with a handle in a hand behind it.

    Args:
        library: ``board_attack.built_loop``.
        mechanics: Handle and hand, not yet started.
        sheet: What the board says.
        link: Further delay of the link in s, in each direction.

    Attributes:
        firmware: The firmware.
        force: Force on the handle in N, or torque in N m of a device that only turns, (3,).
        torque: Torque on the handle in N m, where a loop renders lines and rotations, (3,).
        work: Energy in J that the motors have given the handle.
        burned: Energy in J that the stated damping has burned meanwhile.
        skip_every: Number of periods of which one is missed; 0 for none.
        has_counters: False for a board that never sends the counters of its loop.
        is_cut: True while nothing from the host arrives.
        loses_turns: True while the second frame of a state is lost.
    """

    vendor, product, serial = RawHid.vendor, RawHid.product, "7"
    manufacturer, product_name = RawHid.manufacturer, RawHid.product_name
    report_descriptor = RawHid.report_descriptor

    def __init__(
        self,
        library: ctypes.CDLL,
        mechanics: SimulatedDevice,
        sheet: BoardSheet | None = None,
        link: float = 0.0,
    ) -> None:
        super().__init__()
        self.sheet, self._link = sheet or BoardSheet(), link
        own = self.sheet
        self.firmware = Firmware(library, own)
        self._is_knob = own.axes & (0b111 | POSE) == 0
        self._mechanics, self._sample = mechanics, mechanics.start(own.period)
        mechanics.read(self._sample)
        self._wrench, self._sent = np.zeros(6, np.float32), np.zeros(6)
        self.force, self.torque = self._wrench[:3], self._wrench[3:]
        self._start: float | None = None
        self._ticks, self._states = 0, 0
        self._to_host: deque[tuple[float, bytes]] = deque()
        self._to_board: deque[tuple[float, bytes]] = deque()
        self.work = self.burned = 0.0
        self.status = self.skip_every = 0
        self.has_counters, self.is_cut, self.loses_turns = True, False, False

    def advance(self, now: float) -> None:
        if self._start is None:
            self._start = now
        while (due := self._start + (self._ticks + 1) * self.sheet.period) <= now + 1e-9:
            self._ticks += 1
            while self._to_board and self._to_board[0][0] <= due:
                self.firmware.receive(self._to_board.popleft()[1], due)
            self._tick(due)
            if due - self._start >= (self._states + 1) * STATE_PERIOD:
                self._states += 1
                state = self.firmware.state(self._read(), self.status, due)
                if self.has_counters or not isinstance(decoded(state), LoopReport):
                    self._to_host.append((due + self._link, state))
                if (more := self.firmware.more()) is not None and not self.loses_turns:
                    self._to_host.append((due + self._link, more))
            if (answer := self.firmware.answer()) is not None:
                self._to_host.append((due + self._link, answer))
        while self._to_host and self._to_host[0][0] <= now:
            self.push(self._to_host.popleft()[1])

    def next_time(self, now: float) -> float | None:
        return now if self._start is None else self._start + (self._ticks + 1) * self.sheet.period

    def output(self, report: bytes, now: float) -> None:
        if not self.is_cut:
            self._to_board.append((now + self._link, report))

    def _read(self) -> NDArray[np.float32]:
        """Returns position and quaternion as the encoders give them; of a knob its angle."""
        pose, step = self._sample[0], self.sheet.resolution
        place = _turn_of(pose["quaternion"]) if self._is_knob else pose["position"]
        read = step * np.round(place / step) if step else place
        return np.concatenate([read, pose["quaternion"]]).astype(np.float32)

    def _tick(self, due: float) -> None:
        own, before = self.sheet, self._sample[0].copy()
        if not self.skip_every or self._ticks % self.skip_every:
            self.firmware.tick(self._read(), due, self._wrench)
        self._sent[:] = np.roll(self._wrench, 3) if self._is_knob else self._wrench
        self._mechanics.write(self._sent)
        self._mechanics.read(self._sample)
        moved = self._sample["position"][0] - before["position"]
        last, now = (tuple(each["quaternion"].tolist()) for each in (before, self._sample[0]))
        turned = np.array(rotation_between(last, now))
        self.work += float(self._sent @ np.concatenate([moved, turned]))
        self.burned += own.rotational_damping / own.period * float(turned @ turned)
        if own.axes & 0b111:
            self.burned += own.damping / own.period * float(moved @ moved)


def _turn_of(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    w, x, y, z = quaternion.tolist()
    return np.array(quaternion_log((w, x, y, z)))


def _us(time: float) -> int:
    return round(1e6 * time) & 0xFFFFFFFF
