"""Input devices of Linux: events, axes, and force-feedback effects of a node ``/dev/input/event*``.

Layouts and numbers follow the kernel's ``linux/input.h`` and ``linux/input-event-codes.h``, in the
byte order and alignment of this machine. Requests are numbered as by ``asm-generic/ioctl.h``, which
holds on x86, ARM and RISC-V.
"""

from __future__ import annotations

import errno
import os
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Protocol

from hapticbridge.device.base import calling_on_error
from hapticbridge.device.transport.trace import HexLog
from hapticbridge.errors import DeviceError, DeviceLost

EV_SYN, EV_KEY, EV_ABS, EV_FF = 0x00, 0x01, 0x03, 0x15
SYN_DROPPED, ABS_X = 0x03, 0x00
FF_RUMBLE, FF_CONSTANT, FF_GAIN, FF_AUTOCENTER = 0x50, 0x52, 0x60, 0x61
"""Types and codes of events. The first rotation of a wheel and of a stick is ``ABS_X``. The kernel
reports ``SYN_DROPPED`` if its queue was full and events were lost."""

FIRST_BUTTON, LAST_BUTTON = 0x100, 0x2FF
"""Codes of keys that are buttons of a device and not of a keyboard."""

FULL = 0x7FFF
"""Largest level of a constant force, without unit."""

TO_THE_RIGHT = 0xC000
"""Direction of the effect: 16 bits are a full turn, 0 is towards the user, 0x4000 to the left."""

_EVENT = struct.Struct("@llHHi")
_ABSINFO = struct.Struct("@6i")
_ID = struct.Struct("@4H")
_HEAD = struct.Struct("@HhHHHHH0P")
_CONSTANT = struct.Struct("@h4H")
_EFFECT_SIZE = _HEAD.size + struct.calcsize("@HHhhHHHHHIP0P")
"""``struct ff_effect``: a head (type, id, direction, trigger, replay), and a union whose largest
member is the periodic effect."""

_WRITE, _READ = 1, 2


def _request(direction: int, number: int, size: int) -> int:
    return direction << 30 | size << 16 | ord("E") << 8 | number


_GET_ID = _request(_READ, 0x02, _ID.size)
_UPLOAD = _request(_WRITE, 0x80, _EFFECT_SIZE)
_ERASE = _request(_WRITE, 0x81, 4)
_TEXT = 256
_GET_NAME, _GET_SERIAL = _request(_READ, 0x06, _TEXT), _request(_READ, 0x08, _TEXT)
_BITS = 96
_GET_KEYS_DOWN = _request(_READ, 0x18, _BITS)

_BATCH = 64
"""Events read at once."""

INPUT = Path("/sys/class/input")
_INTERVAL = re.compile(r"(\d+)(us|ms)")
_UNITS = {"us": 1e-6, "ms": 1e-3}


class Kernel(Protocol):
    """Calls of the operating system on input devices, so that a test can stand in for them."""

    def nodes(self) -> list[str]:
        """Returns the paths of all nodes."""

    def open(self, path: str) -> int:
        """Opens a node for reading and writing without waiting; raises OSError."""

    def ioctl(self, file: int, request: int, argument: bytearray | int) -> None:
        """Sends a request, which may change its argument; raises OSError."""

    def read(self, file: int, size: int) -> bytes:
        """Returns waiting bytes; raises BlockingIOError without any, OSError on failure."""

    def write(self, file: int, data: bytes) -> None:
        """Writes events; raises OSError."""

    def close(self, file: int) -> None:
        """Closes the node; the kernel then removes its effects."""


class Linux:
    """The kernel of this machine."""

    def nodes(self) -> list[str]:
        """Implements ``Kernel.nodes``."""
        found = Path("/dev/input").glob("event*")
        return sorted(map(str, found), key=lambda path: (len(path), path))

    def open(self, path: str) -> int:
        """Implements ``Kernel.open``."""
        return os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)

    def ioctl(self, file: int, request: int, argument: bytearray | int) -> None:
        """Implements ``Kernel.ioctl``."""
        import_module("fcntl").ioctl(file, request, argument)

    def read(self, file: int, size: int) -> bytes:
        """Implements ``Kernel.read``."""
        return os.read(file, size)

    def write(self, file: int, data: bytes) -> None:
        """Implements ``Kernel.write``."""
        os.write(file, data)

    def close(self, file: int) -> None:
        """Implements ``Kernel.close``."""
        os.close(file)


@dataclass(frozen=True, slots=True)
class Axis:
    """Range of an axis in counts.

    Attributes:
        value: Newest count.
        least: Smallest count.
        most: Largest count, > ``least``.
    """

    value: int
    least: int
    most: int


class InputNode:
    """An open input device.

    Args:
        kernel: Calls of the operating system.
        path: Its node.
        log: Log of the transferred events and effects.

    Attributes:
        name: Name that the device reports.
        serial: Its serial number; empty if it has none.
        vendor: USB vendor id.
        product: USB product id.

    Raises:
        OSError: The node cannot be opened.
        DeviceLost: The device is gone.
    """

    def __init__(self, kernel: Kernel, path: str, log: HexLog | None = None) -> None:
        self.path, self._kernel, self._log = path, kernel, log
        self._file = kernel.open(path)
        self._is_open = True
        with calling_on_error(self.close):
            _, self.vendor, self.product, _ = _ID.unpack(self._asked(_GET_ID, _ID.size))
            self.name = _text(self._asked(_GET_NAME, _TEXT))
        try:
            self.serial = _text(self._asked(_GET_SERIAL, _TEXT))
        except DeviceLost:  # a device without one answers with an error
            self.serial = ""

    def codes(self, kind: int) -> set[int]:
        """Returns the codes of a type of event that the device has."""
        return set(_set_bits(self._asked(_request(_READ, 0x20 + kind, _BITS), _BITS)))

    def axis(self, code: int) -> Axis:
        """Returns the range of an axis, and its newest count."""
        answer = self._asked(_request(_READ, 0x40 + code, _ABSINFO.size), _ABSINFO.size)
        value, least, most, *_ = _ABSINFO.unpack(answer)
        return Axis(value, least, most)

    def buttons_down(self) -> set[int]:
        """Returns the codes of the buttons that are pressed."""
        return set(_set_bits(self._asked(_GET_KEYS_DOWN, _BITS)))

    def events(self) -> list[tuple[int, int, int]]:
        """Returns the waiting events as type, code and value, without waiting for one.

        Raises:
            DeviceLost: The device is gone.
        """
        events: list[tuple[int, int, int]] = []
        while True:
            try:
                data = self._kernel.read(self._file, _BATCH * _EVENT.size)
            except BlockingIOError:
                return events
            except OSError as error:
                raise self._lost(error) from None
            self._note("<", data)
            events += [(kind, code, value) for _, _, kind, code, value in _EVENT.iter_unpack(data)]
            if len(data) < _BATCH * _EVENT.size:
                return events

    def upload(self, level: int, length_ms: int, effect: int = -1) -> int:
        """Creates or changes an effect of a constant force; returns its number.

        Args:
            level: −``FULL`` to ``FULL``.
            length_ms: Time in ms after which it ends by itself.
            effect: Number of the effect to change; −1 creates one.
        """
        head = _HEAD.pack(FF_CONSTANT, effect, TO_THE_RIGHT, 0, 0, length_ms, 0)
        data = bytearray(_EFFECT_SIZE)
        data[: len(head)] = head
        _CONSTANT.pack_into(data, _HEAD.size, level, 0, 0, 0, 0)
        self._note(">", data)
        self._ask(_UPLOAD, data)
        return int(_HEAD.unpack_from(data)[1])

    def set(self, code: int, value: int) -> None:
        """Writes an event of force feedback: plays an effect, or sets the gain or autocentre."""
        data = event(code, value)
        self._note(">", data)
        try:
            self._kernel.write(self._file, data)
        except OSError as error:
            raise self._lost(error) from None

    def erase(self, effect: int) -> None:
        """Removes an effect, which ends its force."""
        self._ask(_ERASE, effect)

    def close(self) -> None:
        """Closes the node; may be called more than once."""
        if self._is_open:
            self._is_open = False
            self._kernel.close(self._file)
            if self._log is not None:
                self._log.close()

    def _asked(self, request: int, size: int) -> bytes:
        answer = bytearray(size)
        self._ask(request, answer)
        return bytes(answer)

    def _ask(self, request: int, argument: bytearray | int) -> None:
        try:
            self._kernel.ioctl(self._file, request, argument)
        except OSError as error:
            raise self._lost(error) from None

    def _lost(self, error: OSError) -> DeviceLost:
        if error.errno in (errno.ENODEV, errno.EBADF):
            return DeviceLost(f"{self.path} is gone: the device was unplugged, or switched off")
        return DeviceLost(f"{self.path} fails: {error.strerror or error}")

    def _note(self, direction: str, data: bytes | bytearray) -> None:
        if self._log is not None and self._log.is_on:
            self._log.add(direction, bytes(data))


def event(code: int, value: int) -> bytes:
    """Returns an event of force feedback as written to a node."""
    return _EVENT.pack(0, 0, EV_FF, code, value)


def interval_of(path: str) -> float | None:
    """Returns the longer of a node's USB polling intervals in s; None if unknown."""
    found = []
    try:
        for endpoint in (INPUT / Path(path).name / "device/device/..").glob("ep_*"):
            match = _INTERVAL.fullmatch((endpoint / "interval").read_text().strip())
            if match is not None and int(match[1]):
                found.append(int(match[1]) * _UNITS[match[2]])
    except OSError:
        pass  # the device was just unplugged
    return max(found, default=None)


def range_of(path: str) -> float | None:
    """Returns the rotation in degrees from stop to stop that a kernel driver states; else None."""
    try:
        text = (INPUT / Path(path).name / "device/device/range").read_text().strip()
    except OSError:
        return None
    return float(text) if text.isdecimal() and int(text) else None


def open_node(kernel: Kernel, path: str, log: HexLog | None = None) -> InputNode:
    """Opens a node.

    Raises:
        DeviceError: It cannot be opened; the message names the remedy.
    """
    try:
        return InputNode(kernel, path, log)
    except OSError as error:
        raise DeviceError(f"cannot open {path}: {error.strerror or error}") from None


def _text(data: bytes) -> str:
    return data.partition(b"\0")[0].decode(errors="replace")


def _set_bits(data: bytes) -> Iterator[int]:
    for place, byte in enumerate(data):
        for bit in range(8):
            if byte >> bit & 1:
                yield 8 * place + bit
