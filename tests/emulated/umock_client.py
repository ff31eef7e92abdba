"""A program that has an emulated device's node open under umockdev's preload library."""

from __future__ import annotations

import abc
import errno
import os
import socket
import struct
from pathlib import Path

_WORDS = struct.Struct("@LLL")
_IOCTL, _READ, _WRITE = 1, 7, 8
_DONE, _READ_MEMORY, _WRITE_MEMORY = 3, 5, 6

GONE = -errno.ENODEV
"""What a program is told of a device that was pulled out."""


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
