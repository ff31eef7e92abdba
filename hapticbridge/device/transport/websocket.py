"""Text messages over a WebSocket to a local program, with bounded waits."""

from __future__ import annotations

import importlib
import socket
import sys
import time
from typing import Any, Protocol

from hapticbridge.device.transport.trace import HexLog
from hapticbridge.device.transport.usb import SWITCH_INTERVAL
from hapticbridge.errors import DeviceError, DeviceLost
from hapticbridge.files import install_command, read_json

OPEN_TIMEOUT = 1.0
"""Longest time in s for the connection and for the handshake, each. A local program answers in
ms."""

CLOSE_TIMEOUT = 0.2
"""Longest wait in s for the peer's closing frame."""

MAX_MESSAGE = 1 << 20
"""Largest message in bytes. A service with ten devices lists them in some 20 kB."""

MISSING = "the Python package websockets is not installed"


class Link(Protocol):
    """Message transport of a device; ``WebSocketLink`` is the real one."""

    def now(self) -> float:
        """Returns the time of a monotonic clock in s."""

    def send(self, message: str) -> None:
        """Sends a message."""

    def take(self) -> list[str]:
        """Returns the received messages without waiting."""

    def wait(self, timeout: float) -> str | None:
        """Returns the next message, or None after ``timeout`` s."""

    def close(self) -> None:
        """Closes the connection."""


def websocket_client() -> Any:
    """Returns websockets' threaded client, or None if it is not installed."""
    try:
        return importlib.import_module("websockets.sync.client")
    except ImportError:
        return None


class WebSocketLink:
    """An open connection; a thread of ``websockets`` reads into a queue.

    Args:
        connection: Connection of ``websockets.sync``.
        name: Name of the peer in messages.
        log: Log of the transferred bytes.
    """

    def __init__(self, connection: Any, name: str, log: HexLog | None = None) -> None:
        self._connection, self._name = connection, name
        self._log = log or HexLog("")
        self._is_open = True
        # lets the reader's thread run while the loop spins to its deadline
        self._switch_interval = sys.getswitchinterval()
        sys.setswitchinterval(min(SWITCH_INTERVAL, self._switch_interval))

    @classmethod
    def open(cls, host: str, port: int, name: str, log: HexLog | None = None) -> WebSocketLink:
        """Connects to a local program.

        Raises:
            DeviceError: No program answers there, its answer is not a WebSocket handshake, or
                websockets is missing.
        """
        client = websocket_client()
        if client is None:
            raise DeviceError(f"{MISSING}: {install_command('haply')}")
        try:
            # a socket of our own, so that a proxy of the environment is not used
            local_socket = socket.create_connection((host, port), OPEN_TIMEOUT)
        except (socket.gaierror, UnicodeError):
            raise DeviceError(f"there is no host '{host}' for {name}") from None
        except (OSError, OverflowError) as error:
            is_there = isinstance(error, ConnectionRefusedError)
            state = "does not run" if is_there else "cannot be reached"
            reason = "no answer" if is_there else getattr(error, "strerror", None) or error
            raise DeviceError(
                f"{name} {state}: {reason} at {host}:{port}; start it, or name its address with "
                "service=HOST:PORT"
            ) from None
        try:
            local_socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            local_socket.settimeout(None)  # or the reader's thread ends after a second of silence
            opening = client.connect(
                f"ws://{host}:{port}",
                sock=local_socket,
                compression=None,
                open_timeout=OPEN_TIMEOUT,
                close_timeout=CLOSE_TIMEOUT,
                ping_interval=None,  # the loop itself detects silence, a hundred times sooner
                max_size=MAX_MESSAGE,
                max_queue=None,
            )
            connection = opening.__enter__()  # required by newer versions; close() is the exit
        except Exception as error:  # an unknown program may answer and cause any error
            local_socket.close()
            raise DeviceError(
                f"the program at {host}:{port} is not {name}: {' '.join(str(error).split())}"
            ) from None
        return cls(connection, name, log)

    def now(self) -> float:
        """Returns the time of a monotonic clock in s."""
        return time.monotonic()

    def send(self, message: str) -> None:
        """Sends a message; raises DeviceLost if the connection was lost."""
        if self._log.is_on:
            self._log.add(">", message.encode())
        try:
            self._connection.send(message)
        except Exception:  # of any kind: the loop must command zero, not end in a traceback
            raise self._lost() from None

    def take(self) -> list[str]:
        """Returns the received messages, oldest first, without waiting.

        Messages from before a lost connection are returned before DeviceLost is raised.
        """
        messages: list[str] = []
        while (message := self._received(0.0, is_dropped_after=bool(messages))) is not None:
            messages.append(message)
        return messages

    def wait(self, timeout: float) -> str | None:
        """Returns the next message, or None after ``timeout`` s; raises DeviceLost."""
        return self._received(timeout)

    def close(self) -> None:
        """Closes the connection; may be called more than once."""
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
        return DeviceLost(f"{self._name} has closed the connection, or was stopped; restart it")


def decoded(message: str, name: str) -> dict[str, Any]:
    """Returns a message as a JSON object; raises DeviceError if it is not one."""
    try:
        value = read_json(message)
    except ValueError:
        value = None
    if not isinstance(value, dict):
        raise DeviceError(f"{name} sent a message that is not a JSON object: {message!r:.60}")
    return value
