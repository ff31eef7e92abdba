"""Text messages to and from a program on this machine, over a WebSocket: bounded waits."""

from __future__ import annotations

import importlib
import socket
import sys
import time
from typing import Any, Protocol

from hapticbridge.device.transport.hex_log import HexLog
from hapticbridge.device.transport.usb import SWITCH_INTERVAL
from hapticbridge.errors import DeviceError, DeviceLost
from hapticbridge.jsonable import read_json

OPEN_TIMEOUT = 1.0
"""In s: for the connection and for the handshake, each. A program on this machine answers in ms."""

CLOSE_TIMEOUT = 0.2
"""In s, for the other side's goodbye."""

LARGEST_MESSAGE = 1 << 20
"""In bytes. A service with ten devices lists them in some 20 kB."""

EXTRA = "the Python package websockets is not installed: pip install 'hapticbridge[haply]'"


class Link(Protocol):
    """What a device needs of it: ``WebSocketLink``, or what stands for it."""

    def now(self) -> float:
        """Returns the time in s of a clock that only grows."""

    def send(self, message: str) -> None:
        """Sends a message."""

    def take(self) -> list[str]:
        """Returns the messages that have come, without waiting."""

    def wait(self, timeout: float) -> str | None:
        """Returns the next message, or None after ``timeout`` s."""

    def close(self) -> None:
        """Ends the connection."""


def websocket_client() -> Any:
    """Returns websockets' client of threads, or None where it is not installed."""
    try:
        return importlib.import_module("websockets.sync.client")
    except ImportError:
        return None


class WebSocketLink:
    """An open connection. A thread of ``websockets`` reads; what has come is taken from its queue.

    Args:
        connection: Of ``websockets.sync``.
        name: What errors call the other side.
        log: Keeps what goes over the wire.
    """

    def __init__(self, connection: Any, name: str, log: HexLog | None = None) -> None:
        self._connection, self._name = connection, name
        self._log = log or HexLog("")
        self._is_open = True
        # the reader's thread needs the interpreter while the loop spins to its deadline
        self._switch_interval = sys.getswitchinterval()
        sys.setswitchinterval(min(SWITCH_INTERVAL, self._switch_interval))

    @classmethod
    def open(cls, host: str, port: int, name: str, log: HexLog | None = None) -> WebSocketLink:
        """Connects.

        Args:
            host: Name or address.
            port: Of TCP.
            name: What errors call the other side.
            log: Keeps what goes over the wire.

        Raises:
            DeviceError: Nobody answers there, or not as a WebSocket; or websockets is missing.
        """
        client = websocket_client()
        if client is None:
            raise DeviceError(EXTRA)
        try:
            # our own socket, because a proxy that the environment names must not come in between
            own = socket.create_connection((host, port), OPEN_TIMEOUT)
        except (OSError, OverflowError, UnicodeError):
            raise DeviceError(
                f"{name} does not run: nobody answers at {host}:{port}; start it, or say where it "
                "listens with service=HOST:PORT"
            ) from None
        try:
            own.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            opening = client.connect(
                f"ws://{host}:{port}",
                sock=own,
                compression=None,
                open_timeout=OPEN_TIMEOUT,
                close_timeout=CLOSE_TIMEOUT,
                ping_interval=None,  # the loop itself notices silence, a hundred times sooner
                max_size=LARGEST_MESSAGE,
                max_queue=None,
            )
            connection = opening.__enter__()  # what newer versions ask for; close() is the exit
        except Exception as error:  # what answers there may be anything, and so is what it causes
            own.close()
            raise DeviceError(
                f"what answers at {host}:{port} is not {name}: {' '.join(str(error).split())}"
            ) from None
        return cls(connection, name, log)

    def now(self) -> float:
        """Returns the time in s of a clock that only grows."""
        return time.monotonic()

    def send(self, message: str) -> None:
        """Sends a message.

        Raises:
            DeviceLost: The connection has dropped.
        """
        if self._log.is_on:
            self._log.add(">", message.encode())
        try:
            self._connection.send(message)
        except Exception:  # whatever its kind: the loop must command zero, not end in a traceback
            raise self._lost() from None

    def take(self) -> list[str]:
        """Returns the messages that have come, oldest first, without waiting.

        Raises:
            DeviceLost: The connection has dropped, and all that came before was taken.
        """
        messages: list[str] = []
        while (message := self._received(0.0, is_dropped_after=bool(messages))) is not None:
            messages.append(message)
        return messages

    def wait(self, timeout: float) -> str | None:
        """Returns the next message, or None after ``timeout`` s.

        Raises:
            DeviceLost: The connection has dropped.
        """
        return self._received(timeout)

    def close(self) -> None:
        """Ends the connection; may be called more than once."""
        if not self._is_open:
            return
        self._is_open = False
        try:
            self._connection.close()
        finally:
            sys.setswitchinterval(self._switch_interval)
            self._log.close()

    def _received(self, timeout: float, *, is_dropped_after: bool = False) -> str | None:
        if not self._is_open:
            raise self._lost()
        try:
            message = self._connection.recv(timeout=timeout)
        except TimeoutError:
            return None
        except Exception:  # as in ``send``
            if is_dropped_after:
                return None
            raise self._lost() from None
        text: str = message if isinstance(message, str) else message.decode(errors="replace")
        if self._log.is_on:
            self._log.add("<", text.encode())
        return text

    def _lost(self) -> DeviceLost:
        return DeviceLost(f"{self._name} has closed the connection, or was stopped")


def decoded(message: str, name: str) -> dict[str, Any]:
    """Returns the JSON object that a message is.

    Args:
        message: Text.
        name: What errors call who sent it.

    Raises:
        DeviceError: It is none.
    """
    try:
        value = read_json(message)
    except ValueError:
        value = None
    if not isinstance(value, dict):
        raise DeviceError(f"{name} sent what is no JSON object: {message!r:.60}")
    return value
