"""A serial port in this process and in virtual time, with an emulated board behind it."""

from __future__ import annotations

import struct
from collections import deque

from emulated.rawhid_model import RawHid, crc
from hapticbridge.device.driver import FoundDevice
from hapticbridge.device.rawhid.serial import SerialPort, SystemPorts

QUEUE = 4095
"""Bytes that a terminal of Linux keeps."""

STEP = 250e-6
"""Time in s between two looks at the board; its frames are late by less."""


class SerialSeam(SystemPorts):
    """The port of one board, and the time that it is at.

    Bytes take ``latency`` each way. Only at the board's own baud rate does it understand anything.

    Args:
        board: The board, whose reports are the frames.
        latency: In s, each way.
        baud: Of the board, in bit/s.

    Attributes:
        now: In s.
        is_there: False once it was unplugged.
        is_mute: True while the line delivers nothing, as in a stall of USB.
    """

    def __init__(self, board: RawHid, latency: float = 1e-3, baud: int = 1_000_000) -> None:
        self.board, self.latency, self.baud = board, latency, baud
        self.time, self.is_there, self.is_mute = 0.0, True, False
        self.to_host: deque[tuple[float, bytes]] = deque()
        self.to_board: deque[tuple[float, bytes]] = deque()
        self.opened: _Port | None = None

    # -- what a test drives ----------------------------------------------------------------------

    def advance(self, now: float) -> None:
        """Brings board and line to a time in s; a time before the newest one changes nothing."""
        while self.time < now - 1e-12:
            self.time = min(self.time + STEP, now)
            while self.to_board and self.to_board[0][0] <= self.time:
                when, frame = self.to_board.popleft()
                self.board.poll(when)
                self.board.output(frame, when)
            self.board.poll(self.time)
            while (report := self.board.take_report()) is not None:
                self.to_host.append((self.time + self.latency, report))

    def arrived(self) -> bytes:
        """Returns what the host has received since the last call; a full queue loses the rest."""
        found = b""
        while not self.is_mute and self.to_host and self.to_host[0][0] <= self.time:
            found += self.to_host.popleft()[1]
        return found[:QUEUE]

    # -- the ports of a machine ------------------------------------------------------------------

    def found(self) -> list[FoundDevice]:
        return [
            FoundDevice(
                driver="serial", name="Hapkit", serial="H1", path="/dev/ttyACM0", vendor=0x2341,
                product=0x0043, transport="serial",
            )
        ]  # fmt: skip

    def open(self, path: str, baud: int) -> SerialPort:
        self.opened = _Port(self, baud)
        return self.opened

    def now(self) -> float:
        return self.time

    def sleep(self, duration: float) -> None:
        self.advance(self.time + duration)


class VirtualPort:
    """The time of a seam, as the benches take it."""

    def __init__(self, seam: SerialSeam) -> None:
        self._seam = seam

    @property
    def now(self) -> float:
        return self._seam.time

    @now.setter
    def now(self, now: float) -> None:
        self._seam.advance(now)

    def advance(self, now: float) -> None:
        self._seam.advance(now)


class _Port:
    """The open port, as pyserial gives it."""

    def __init__(self, seam: SerialSeam, baud: int) -> None:
        self._seam, self.baudrate = seam, baud
        self._received, self.is_open = b"", True
        self.out_waiting, self.taken, self.discarded = 0, 64, 0

    @property
    def in_waiting(self) -> int:
        if not self._seam.is_there:
            raise OSError("gone")
        data = self._seam.arrived()
        if self.baudrate != self._seam.baud:
            data = bytes(byte & 0x55 for byte in data)  # as a line sampled at the wrong times
        self._received += data
        return len(self._received)

    def read(self, size: int) -> bytes:
        data, self._received = self._received[:size], self._received[size:]
        return data

    def write(self, data: bytes) -> int:
        if not self._seam.is_there:
            raise OSError("gone")
        frame = bytes(data)
        assert struct.unpack_from("<H", frame, 62)[0] == crc(frame[:62])
        if self.baudrate == self._seam.baud:
            self._seam.to_board.append((self._seam.time + self._seam.latency, frame))
        return min(len(data), self.taken)

    def reset_input_buffer(self) -> None:
        self._seam.arrived()
        self._received = b""

    def reset_output_buffer(self) -> None:
        self.discarded += self.out_waiting

    def close(self) -> None:
        self.is_open = False
