"""Emulated USB devices: descriptors, a control pipe and endpoints.

A model never looks at a clock: whoever calls it (a front end) says what time it is, in seconds of
any clock that only grows. The same model then stands behind a library call in this process, a fake
device node, or a real kernel, on the wall clock or in virtual time.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar

FULL_SPEED = 2
BULK, INTERRUPT = 2, 3

TO_HOST = 0x80
_STANDARD_TO_ENDPOINT = 0x02
_CLEAR_FEATURE, _GET_DESCRIPTOR = 1, 6
_DEVICE, _CONFIGURATION, _STRING = 1, 2, 3


class StallError(Exception):
    """The device refuses a request or has halted an endpoint."""


@dataclass(frozen=True)
class Setup:
    """The eight bytes with which a host opens a control transfer."""

    request_type: int
    request: int
    value: int
    index: int
    length: int

    @property
    def is_to_host(self) -> bool:
        return bool(self.request_type & TO_HOST)

    @property
    def is_standard(self) -> bool:
        return not self.request_type & 0x60


@dataclass(frozen=True)
class Endpoint:
    """Address (0x80 set: towards the host), kind, bytes per packet, polling interval in frames."""

    address: int
    kind: int
    size: int = 64
    interval: int = 0

    def descriptor(self) -> bytes:
        return struct.pack("<BBBBHB", 7, 5, self.address, self.kind, self.size, self.interval)


Completion = Callable[[bytes | None], None]
"""Takes what the device had to say, or None where the endpoint is halted."""


class UsbDevice:
    """A USB device with one configuration and one interface.

    A front end calls ``control``, ``write`` and ``submit_read``, and ``poll`` whenever the time
    that it last returned has come.
    """

    vendor: int
    product: int
    release: ClassVar[int] = 0x0100
    speed: ClassVar[int] = FULL_SPEED
    interface_class: ClassVar[tuple[int, int, int]] = (255, 255, 255)
    endpoints: tuple[Endpoint, ...] = ()
    control_size: ClassVar[int] = 64
    manufacturer: str = ""
    product_name: str = ""
    serial: str = ""

    def __init__(self) -> None:
        self.halted: set[int] = set()
        self._pending: dict[int, tuple[int, int, Completion]] = {}
        self._tokens = 0

    # -- what a model adds -----------------------------------------------------------------------

    def interface_extra(self) -> bytes:
        """Returns class descriptors that stand between interface and endpoints."""
        return b""

    def class_descriptor(self, kind: int) -> bytes | None:
        """Returns an interface's descriptor of a kind that only its class knows."""
        return None

    def request(self, setup: Setup, data: bytes, now: float) -> bytes:
        """Answers a class or vendor request; the answer is empty unless it goes to the host."""
        raise StallError

    def accept(self, endpoint: int, data: bytes, now: float) -> None:
        """Takes bytes that the host wrote."""
        raise StallError

    def take(self, endpoint: int, length: int, now: float) -> bytes | None:
        """Returns at most ``length`` bytes for the host, None while there is nothing to say."""
        return None

    def advance(self, now: float) -> None:
        """Brings what moves by itself up to a time."""

    def next_time(self, now: float) -> float | None:
        """Returns when something will happen without the host's doing, None: never."""
        return None

    # -- what a front end calls ------------------------------------------------------------------

    def control(self, setup: Setup, data: bytes, now: float) -> bytes:
        """Serves a control transfer.

        Args:
            setup: The request.
            data: What the host sent with it, empty where the answer goes to the host.
            now: In s.

        Raises:
            StallError: The device refuses it.
        """
        self.advance(now)
        if not setup.is_standard:
            return self.request(setup, data, now)[: setup.length if setup.is_to_host else 0]
        if setup.is_to_host:
            return self._standard_answer(setup)[: setup.length]
        if setup.request == _CLEAR_FEATURE and setup.request_type == _STANDARD_TO_ENDPOINT:
            self.halted.discard(setup.index)
        return b""

    def write(self, endpoint: int, data: bytes, now: float) -> None:
        """Gives the device what the host wrote to an endpoint.

        Raises:
            StallError: The endpoint is halted, or there is none of this address.
        """
        self.advance(now)
        if endpoint in self.halted:
            raise StallError
        self.accept(endpoint, data, now)

    def submit_read(self, endpoint: int, length: int, done: Completion) -> int:
        """Asks for up to ``length`` bytes; ``done`` is called from a later ``poll``.

        Returns:
            A token for ``cancel``.
        """
        self._tokens += 1
        self._pending[self._tokens] = (endpoint, length, done)
        return self._tokens

    def cancel(self, token: int) -> bool:
        """Takes a read back; False where it is complete already."""
        return self._pending.pop(token, None) is not None

    def is_read_pending(self, endpoint: int) -> bool:
        """Tells whether the host waits for bytes of an endpoint."""
        return any(pending[0] == endpoint for pending in self._pending.values())

    def poll(self, now: float) -> float | None:
        """Brings the device to a time and completes the reads that can be.

        Returns:
            When to call again at the latest, in s; None: only after the host did something.
        """
        self.advance(now)
        for token, (endpoint, length, done) in list(self._pending.items()):
            answer = None if endpoint in self.halted else self.take(endpoint, length, now)
            if answer is not None or endpoint in self.halted:
                del self._pending[token]
                done(answer)
        return self.next_time(now)

    # -- descriptors -----------------------------------------------------------------------------

    def device_descriptor(self) -> bytes:
        """Returns the 18 bytes by which a host knows the device."""
        texts = self._texts()
        ids = (self.vendor, self.product, self.release)
        named = (index if index in texts else 0 for index in (1, 2, 3))
        head = (18, _DEVICE, 0x0200, 0, 0, 0, self.control_size)
        return struct.pack("<2BH4B3H4B", *head, *ids, *named, 1)

    def configuration_descriptor(self) -> bytes:
        """Returns configuration, interface and endpoint descriptors in one."""
        interface = struct.pack("<9B", 9, 4, 0, 0, len(self.endpoints), *self.interface_class, 0)
        endpoints = b"".join(endpoint.descriptor() for endpoint in self.endpoints)
        body = interface + self.interface_extra() + endpoints
        # powered by the bus, 50 x 2 mA
        return struct.pack("<BBHBBBBB", 9, _CONFIGURATION, 9 + len(body), 1, 1, 0, 0x80, 50) + body

    def _texts(self) -> Mapping[int, str]:
        texts = {1: self.manufacturer, 2: self.product_name, 3: self.serial}
        return {index: text for index, text in texts.items() if text}

    def _standard_answer(self, setup: Setup) -> bytes:
        if setup.request != _GET_DESCRIPTOR:
            # get status, configuration or interface: all zero but the configuration's number
            return b"\x01" if setup.request == 8 else b"\x00\x00"
        kind, index = setup.value >> 8, setup.value & 0xFF
        answer: bytes | None
        if kind == _DEVICE:
            answer = self.device_descriptor()
        elif kind == _CONFIGURATION:
            answer = self.configuration_descriptor()
        elif kind == _STRING:
            answer = self._string_descriptor(index)
        else:
            answer = self.class_descriptor(kind)
        if answer is None:
            raise StallError
        return answer

    def _string_descriptor(self, index: int) -> bytes | None:
        if index == 0:
            return bytes([4, _STRING, 0x09, 0x04])  # one language: US English
        text = self._texts().get(index)
        if text is None:
            return None
        encoded = text.encode("utf-16-le")
        return bytes([2 + len(encoded), _STRING]) + encoded
