"""What a usbfs node answers a program that has it open: libusb."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import socket
import struct
from collections import deque
from collections.abc import Callable
from pathlib import Path

from emulated.umock_client import GONE, Client
from emulated.usb_device import TO_HOST, Setup, StallError, UsbDevice

_PIPE_SIZE = 4096


class UsbfsClient(Client):
    """A program that has a USB device's node open: libusb."""

    _URB_SIZE, _URB_STATUS, _URB_ACTUAL = 56, 4, 28
    _CONTROL_URB = 2

    def __init__(self, connection: socket.socket, pipe: Path, device: UsbDevice) -> None:
        super().__init__(connection, pipe)
        self._device = device
        self._tokens: dict[int, int] = {}
        # per finished transfer: its address, status, bytes, where they go, and how many
        self._finished: deque[tuple[int, int, bytes, int, int]] = deque()
        self._waiting: int | None = None
        fcntl.fcntl(self._pipe, fcntl.F_SETPIPE_SZ, _PIPE_SIZE)
        self._is_full = False
        self._signal()
        self._ioctls: dict[int, Callable[[int, float], int]] = {
            0x00: self._control,
            0x08: lambda *_: -errno.ENODATA,  # which driver: none
            0x0A: self._submit,
            0x0B: self._discard,
            0x12: lambda *_: -errno.ENODATA,  # take the driver off: there is none
            0x15: self._clear_halt,
            0x1A: self._capabilities,
            0x1F: lambda *_: device.speed,
        }
        # release and set what needs no doing: endpoint, interface, configuration, claim, reset
        for number in (0x03, 0x04, 0x05, 0x0F, 0x10, 0x11, 0x14, 0x1B):
            self._ioctls[number] = lambda *_: 0

    def close(self) -> None:
        for token in self._tokens.values():
            self._device.cancel(token)
        super().close()

    def read(self, address: int, count: int) -> None:
        self._done(-errno.EINVAL)

    def write(self, data: bytes, now: float) -> None:
        self._done(-errno.EINVAL)

    def ioctl(self, request: int, address: int, now: float) -> None:
        number = request & 0xFF
        if number in (0x0C, 0x0D):
            self._reap(address, may_wait=number == 0x0C)
        elif self._is_gone and number != 0x0B:
            self._done(GONE)
        else:
            unknown: Callable[[int, float], int] = lambda *_: -errno.ENOTTY  # noqa: E731
            self._done(self._ioctls.get(number, unknown)(address, now))

    def lose_device(self) -> None:
        self._is_gone = True
        for urb, token in list(self._tokens.items()):
            self._device.cancel(token)
            self._finish(urb, GONE, b"", 0, 0)

    def _submit(self, urb: int, now: float) -> int:
        raw = self._memory(urb, self._URB_SIZE)
        kind, endpoint, _, _, buffer, length = struct.unpack_from("<BB2xiI4xQi", raw)
        try:
            if kind == self._CONTROL_URB:
                setup = Setup(*struct.unpack("<BBHHH", self._memory(buffer, 8)))
                data = b"" if setup.is_to_host else self._memory(buffer + 8, setup.length)
                answer = self._device.control(setup, data, now)
                count = len(answer) if setup.is_to_host else setup.length
                self._finish(urb, 0, answer, buffer + 8, count)
            elif endpoint & TO_HOST:

                def done(answer: bytes | None) -> None:
                    data = answer or b""
                    status = -errno.EPIPE if answer is None else 0
                    self._finish(urb, status, data, buffer, len(data))

                self._tokens[urb] = self._device.submit_read(endpoint, length, done)
            else:
                self._device.write(endpoint, self._memory(buffer, length), now)
                self._finish(urb, 0, b"", 0, length)
        except StallError:
            self._finish(urb, -errno.EPIPE, b"", 0, 0)
        return 0

    def _discard(self, urb: int, now: float) -> int:
        token = self._tokens.get(urb)
        if token is None or not self._device.cancel(token):
            return -errno.EINVAL
        self._finish(urb, -errno.ENOENT, b"", 0, 0)
        return 0

    def _control(self, address: int, now: float) -> int:
        *fields, data_address = struct.unpack("<BBHHH8xQ", self._memory(address, 24))
        setup = Setup(*fields)
        data = b"" if setup.is_to_host else self._memory(data_address, setup.length)
        try:
            answer = self._device.control(setup, data, now)
        except StallError:
            return -errno.EPIPE
        self._set_memory(data_address, answer)
        return len(answer) if setup.is_to_host else setup.length

    def _clear_halt(self, address: int, now: float) -> int:
        self._device.halted.discard(struct.unpack("<I", self._memory(address, 4))[0])
        return 0

    def _capabilities(self, address: int, now: float) -> int:
        # zero packets, transfers of any size
        self._set_memory(address, struct.pack("<I", 0x01 | 0x04))
        return 0

    def _reap(self, address: int, *, may_wait: bool) -> None:
        if self._finished:
            self._hand_over(address)
        elif self._is_gone:
            self._done(GONE)
        elif may_wait:
            self._waiting = address
        else:
            self._done(-errno.EAGAIN)

    def _finish(self, urb: int, status: int, data: bytes, buffer: int, count: int) -> None:
        self._tokens.pop(urb, None)
        self._finished.append((urb, status, data, buffer, count))
        if self._waiting is not None:
            address, self._waiting = self._waiting, None
            self._hand_over(address)
        self._signal()

    def _hand_over(self, address: int) -> None:
        urb, status, data, buffer, count = self._finished.popleft()
        self._set_memory(buffer, data)
        self._set_memory(urb + self._URB_STATUS, struct.pack("<i", status))
        self._set_memory(urb + self._URB_ACTUAL, struct.pack("<i", count))
        self._set_memory(address, struct.pack("<Q", urb))
        self._signal()
        self._done(0)

    def _signal(self) -> None:
        """Makes the node writable while a finished transfer waits to be reaped."""
        if self._finished and self._is_full:
            os.read(self._pipe, _PIPE_SIZE)
            self._is_full = False
        elif not self._finished and not self._is_full:
            with contextlib.suppress(BlockingIOError):
                os.write(self._pipe, b"x" * _PIPE_SIZE)
            self._is_full = True
