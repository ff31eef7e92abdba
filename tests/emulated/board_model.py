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

STATE_PERIOD = 1.01e-3
"""Time in s between two state frames: a little more than a full-speed host polls in."""


@dataclass(frozen=True, kw_only=True)
class BoardSheet:
    """Data sheet of a board: axes as bits, and numbers in SI units."""

    axes: int = 0b111  # beyond 0b111 damping, friction, step and limit are those of rotation
    period: float = 1e-4
    damping: float = 2.0
    friction: float = 0.1
    resolution: float = 1e-5
    force_limit: float = 10.0
    speed_limit: float = 5.0
    mass: float = 0.1
    loop_delay: float = 1e-5


class LoopBoard(HidDevice):
    """Runs the firmware's board in virtual time, with a handle in a hand behind it.

    Args:
        library: ``board_attack.built_loop``.
        mechanics: Handle and hand, not yet started.
        sheet: What the board says.
        link: Further delay of the link in s, in each direction.

    Attributes:
        force: Force on the handle in N, (3,).
        work: Energy in J that the motors have given the handle.
        burned: Energy in J that the stated damping has burned meanwhile.
        skip_every: Number of periods of which one is missed; 0 for none.
        has_counters: False for a board that never sends the counters of its loop.
        is_cut: True while nothing from the host arrives.
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
        self.sheet, self._library, self._link = sheet or BoardSheet(), library, link
        own = self.sheet
        self._turns = own.axes & 0b111 == 0
        numbers = [own.damping, own.friction, own.resolution]
        numbers += [own.force_limit, own.speed_limit, own.mass, own.loop_delay]
        new = library.board_new(own.axes, ctypes.c_float(own.period), floats(numbers))
        self._board = ctypes.c_void_p(new)
        self._mechanics, self._sample = mechanics, mechanics.start(own.period)
        mechanics.read(self._sample)
        self.force, self._sent = np.zeros(3, np.float32), np.zeros(6)
        self._start: float | None = None
        self._ticks, self._states = 0, 0
        self._to_host: deque[tuple[float, bytes]] = deque()
        self._to_board: deque[tuple[float, bytes]] = deque()
        self.work = self.burned = 0.0
        self.status = self.skip_every = 0
        self.has_counters, self.is_cut = True, False

    def heat(self, temperature: float, limit: float) -> None:
        """Sets the temperature of the motors and its limit in °C."""
        numbers = ctypes.c_float(temperature), ctypes.c_float(limit)
        self._library.board_heat(self._board, *numbers)

    def advance(self, now: float) -> None:
        if self._start is None:
            self._start = now
        while (due := self._start + (self._ticks + 1) * self.sheet.period) <= now + 1e-9:
            self._ticks += 1
            while self._to_board and self._to_board[0][0] <= due:
                self._library.board_receive(self._board, self._to_board.popleft()[1], _us(due))
            self._tick(due)
            if due - self._start >= (self._states + 1) * STATE_PERIOD:
                self._states += 1
                state = self._state(due)
                if self.has_counters or not isinstance(decoded(state), LoopReport):
                    self._to_host.append((due + self._link, state))
            frame = ctypes.create_string_buffer(64)
            if self._library.board_answer(self._board, frame):
                self._to_host.append((due + self._link, frame.raw))
        while self._to_host and self._to_host[0][0] <= now:
            self.push(self._to_host.popleft()[1])

    def next_time(self, now: float) -> float | None:
        return now if self._start is None else self._start + (self._ticks + 1) * self.sheet.period

    def output(self, report: bytes, now: float) -> None:
        if not self.is_cut:
            self._to_board.append((now + self._link, report))

    def _read(self) -> NDArray[np.float32]:
        position, step = self._place(), self.sheet.resolution
        read = step * np.round(position / step) if step else position
        return np.asarray(read, np.float32)

    def _place(self) -> NDArray[np.float64]:
        """Returns the position in m, or the rotation vector in rad of a device that only turns."""
        if not self._turns:
            return np.array(self._sample["position"][0])
        w, *axis = self._sample["quaternion"][0]
        size = float(np.linalg.norm(axis))
        return np.array(axis) * (2.0 * np.arctan2(size, w) / size if size else 2.0)

    def _tick(self, due: float) -> None:
        before = self._place()
        if not self.skip_every or self._ticks % self.skip_every:
            own = self._board, floats(self._read()), _us(due), floats(self.force)
            self._library.board_tick(*own)
        self._sent[3 * self._turns : 3 + 3 * self._turns] = self.force
        self._mechanics.write(self._sent)
        self._mechanics.read(self._sample)
        moved = self._place() - before
        self.work += float(self.force @ moved)
        self.burned += self.sheet.damping / self.sheet.period * float(moved @ moved)

    def _state(self, due: float) -> bytes:
        frame = ctypes.create_string_buffer(64)
        own = self._board, floats(self._read()), self.status, _us(due), frame
        self._library.board_state(*own)
        return frame.raw


def _us(time: float) -> int:
    return round(1e6 * time) & 0xFFFFFFFF
