"""An emulated device under umockdev's preload library: hidapi, libusb and libudev are real.

The library sends every read, write and ioctl at a device node to a socket, as three machine words
(what, and two arguments); the answer is the result, before which the client's memory may be read
and written. It does not catch ``poll``, so the nodes are pipes: a hidraw node holds one byte per
report that waits (readable), a usbfs node is full until a transfer can be reaped (writable).

References:
    umockdev 0.17, src/ioctl_tree.c and src/libumockdev-preload.c.
"""

from __future__ import annotations

import abc
import contextlib
import errno
import fcntl
import os
import socket
import struct
from collections import deque
from collections.abc import Callable
from pathlib import Path

from emulated.emulator_process import FrontEnd
from emulated.hid_device import FEATURE_REPORT, OUTPUT_REPORT, HidDevice
from emulated.umock_sysfs import add, remove
from emulated.usb_device import TO_HOST, Setup, StallError, UsbDevice

_WORDS = struct.Struct("@LLL")
_IOCTL, _READ, _WRITE = 1, 7, 8
_DONE, _READ_MEMORY, _WRITE_MEMORY = 3, 5, 6

GONE = -errno.ENODEV
"""Error that a program gets from a device that was pulled out."""


class Client(abc.ABC):
    """One opening of a device node.

    Args:
        connection: Where the preload library asks.
        pipe: What stands in the node's place.
    """

    def __init__(self, connection: socket.socket, pipe: Path) -> None:
        self._connection = connection
        self._pipe = os.open(pipe, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
        self._is_gone = False

    def serve(self, now: float) -> bool:
        """Answers one question; False where the client has closed the node."""
        try:
            kind, first, second = _WORDS.unpack(self._received(_WORDS.size))
            if kind == _IOCTL:
                self.ioctl(first & 0xFFFFFFFF, second, now)
            elif kind == _READ:
                self.read(first, second)
            elif kind == _WRITE:
                self.write(self._memory(first, second), now)
        except (EOFError, OSError):
            return False
        return True

    def close(self) -> None:
        """Ends what the client began."""
        os.close(self._pipe)
        self._connection.close()

    @abc.abstractmethod
    def ioctl(self, request: int, address: int, now: float) -> None: ...

    @abc.abstractmethod
    def read(self, address: int, count: int) -> None: ...

    @abc.abstractmethod
    def write(self, data: bytes, now: float) -> None: ...

    @abc.abstractmethod
    def lose_device(self) -> None:
        """Wakes whoever waits for the device, to be told that it is gone."""

    def _received(self, count: int) -> bytes:
        parts = bytearray()
        while len(parts) < count:
            part = self._connection.recv(count - len(parts))
            if not part:
                raise EOFError
            parts += part
        return bytes(parts)

    def _memory(self, address: int, count: int) -> bytes:
        if not count:
            return b""
        self._connection.sendall(_WORDS.pack(_READ_MEMORY, address, count))
        return self._received(count)

    def _set_memory(self, address: int, data: bytes) -> None:
        if data:
            self._connection.sendall(_WORDS.pack(_WRITE_MEMORY, address, len(data)) + data)

    def _done(self, result: int) -> None:
        """Ends a question: a result, or a negative error number."""
        value, error = (result, 0) if result >= 0 else (2**64 - 1, -result)
        self._connection.sendall(_WORDS.pack(_DONE, value, error))


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


class Umock(FrontEnd):
    """A device plugged into the test bed that ``UMOCKDEV_DIR`` names.

    Args:
        device: The model.
    """

    def __init__(self, device: UsbDevice) -> None:
        self._root = Path(os.environ["UMOCKDEV_DIR"])
        self._device = device
        self._nodes = add(self._root, device)
        self._listeners: dict[int, tuple[socket.socket, str]] = {}
        self._clients: dict[int, Client] = {}
        for node in self._nodes.all():
            path = self._root / "ioctl" / node
            path.parent.mkdir(parents=True, exist_ok=True)
            listener = socket.socket(socket.AF_UNIX)
            listener.bind(str(path))
            listener.listen(8)
            self._listeners[listener.fileno()] = (listener, node)

    def files(self) -> list[int]:
        return [*self._listeners, *self._clients]

    def serve(self, file: int, now: float) -> None:
        if file in self._listeners:
            listener, node = self._listeners[file]
            connection, _ = listener.accept()
            pipe = self._root / node
            client: Client
            if node == self._nodes.usb:
                client = UsbfsClient(connection, pipe, self._device)
            else:
                assert isinstance(self._device, HidDevice)
                is_alone = not any(isinstance(one, HidrawClient) for one in self._clients.values())
                client = HidrawClient(connection, pipe, self._device, is_alone=is_alone)
            self._clients[connection.fileno()] = client
        elif not self._clients[file].serve(now):
            self._clients.pop(file).close()

    def settle(self, now: float) -> float | None:
        due = self._device.poll(now)
        readers = [one for one in self._clients.values() if isinstance(one, HidrawClient)]
        if readers and isinstance(self._device, HidDevice):
            while (report := self._device.take_report()) is not None:
                # one pipe stands for the node, so one program reads: who else opened it only writes
                readers[0].feed(report)
        return due

    def unplug(self) -> None:
        """Takes the nodes away; who has one open is told that the device is gone.

        The connections stay until the clients close them: the library would abort a client that is
        not answered.
        """
        for listener, _ in self._listeners.values():
            listener.close()
        self._listeners = {}
        remove(self._root, self._nodes)
        for client in self._clients.values():
            client.lose_device()
