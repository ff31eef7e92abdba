"""What a hidraw node answers a program that has it open."""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import struct
from collections import deque
from collections.abc import Callable
from pathlib import Path

from emulated.hid_device import FEATURE_REPORT, OUTPUT_REPORT, HidDevice
from emulated.umock_client import GONE, Client
from emulated.usb_device import StallError


class HidrawClient(Client):
    """A program that has a hidraw node open."""

    def __init__(
        self, connection: socket.socket, pipe: Path, device: HidDevice, *, is_alone: bool = True
    ) -> None:
        super().__init__(connection, pipe)
        self._device = device
        self._blank = b"" if device.has_numbered_reports else b"\0"
        self._reports: deque[bytes] = deque()
        self._waiting: tuple[int, int] | None = None
        if is_alone:  # else what is in the pipe is another's
            self._drain()

    def feed(self, report: bytes) -> None:
        """Gives the client an input report; beyond 64 waiting ones the newest are lost."""
        if self._waiting is not None:
            (address, count), self._waiting = self._waiting, None
            self._hand_over(report, address, count)
        elif len(self._reports) < 64:
            self._reports.append(report)
            os.write(self._pipe, b"r")

    def read(self, address: int, count: int) -> None:
        if self._is_gone:
            self._done(-errno.EIO)
        elif self._reports:
            os.read(self._pipe, 1)
            self._hand_over(self._reports.popleft(), address, count)
        else:
            self._waiting = (address, count)

    def write(self, data: bytes, now: float) -> None:
        if self._is_gone:
            self._done(GONE)
            return
        self._device.advance(now)
        self._device.output(data.removeprefix(self._blank) if self._blank else data, now)
        self._done(len(data))

    def ioctl(self, request: int, address: int, now: float) -> None:
        number, size, device = request & 0xFF, request >> 16 & 0x3FFF, self._device
        if self._is_gone:
            self._done(GONE)
        elif number == 1:  # size of the report descriptor
            self._set_memory(address, struct.pack("<I", len(device.report_descriptor)))
            self._done(0)
        elif number == 2:
            count = struct.unpack("<I", self._memory(address, 4))[0]
            self._set_memory(address + 4, device.report_descriptor[:count])
            self._done(0)
        elif number == 3:  # bus, vendor, product
            self._set_memory(address, struct.pack("<IHH", 3, device.vendor, device.product))
            self._done(0)
        elif number in (4, 5, 8):  # name, place, serial
            texts = {4: device.product_name, 5: "usb-emulated/input0", 8: device.serial}
            text = (texts[number].encode() + b"\0")[:size]
            self._set_memory(address, text)
            self._done(len(text))
        elif number in (6, 11):
            kind = FEATURE_REPORT if number == 6 else OUTPUT_REPORT
            self._done(self._set_report(kind, self._memory(address, size), now))
        elif number == 7:
            self._get_report(self._device.feature, address, size, now)
        elif number == 10:
            self._get_report(self._device.input_report, address, size, now)
        else:
            self._done(-errno.ENOTTY)

    def lose_device(self) -> None:
        self._is_gone = True
        if self._waiting is not None:
            self._waiting = None
            self._done(-errno.EIO)
        os.write(self._pipe, b"g")

    def _set_report(self, kind: int, report: bytes, now: float) -> int:
        data = report.removeprefix(self._blank) if self._blank else report
        try:
            take = self._device.output if kind == OUTPUT_REPORT else self._device.set_feature
            take(data, now)
        except StallError:
            return -errno.EPIPE
        return len(report)

    def _get_report(
        self, report: Callable[[int, float], bytes | None], address: int, size: int, now: float
    ) -> None:
        answer = report(self._memory(address, 1)[0], now)
        if answer is None:
            self._done(-errno.EPIPE)
            return
        answer = (self._blank + answer)[:size]
        self._set_memory(address, answer)
        self._done(len(answer))

    def _hand_over(self, report: bytes, address: int, count: int) -> None:
        self._set_memory(address, report[:count])
        self._done(min(count, len(report)))

    def _drain(self) -> None:
        with contextlib.suppress(BlockingIOError):
            os.read(self._pipe, 1 << 16)
