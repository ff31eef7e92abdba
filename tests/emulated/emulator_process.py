"""A device model in a process of its own, which a test moves by remote calls.

It must not be in the process under test: hidapi holds the interpreter lock while it opens and lists
devices, and the system asks the device things meanwhile.
"""

from __future__ import annotations

import abc
import ctypes
import math
import multiprocessing
import select
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

from emulated.usb_device import UsbDevice

_PR_SET_TIMERSLACK = 29

_SHORTEST = 5e-6
"""Shortest time in s. A model that wants to be asked again at once, over and over, would hold
virtual time still, and the host that it waits for too."""


class FrontEnd(abc.ABC):
    """Joins a device model and a system; served by one thread (``emulator_process``)."""

    @abc.abstractmethod
    def files(self) -> list[int]:
        """Returns the files at which the system's next question may arrive."""

    @abc.abstractmethod
    def serve(self, file: int, now: float) -> None:
        """Answers the question that has arrived at a file."""

    @abc.abstractmethod
    def settle(self, now: float) -> float | None:
        """Hands over what the device has to say.

        Returns:
            When to call again at the latest, in s; None: only after the next question.
        """

    @abc.abstractmethod
    def unplug(self) -> None:
        """Pulls the device out; ``files`` then names only those whose clients must be told so."""


class EmulatorProcess:
    """Plugs an emulated device in, from the moment of construction until ``unplug``.

    Args:
        make: Makes the model, in the new process.
        plug: Plugs it in there.
    """

    def __init__(self, make: Callable[[], UsbDevice], plug: Callable[[Any], FrontEnd]) -> None:
        self._connection, end = multiprocessing.Pipe()
        self._process = multiprocessing.get_context("fork").Process(
            target=_serve, args=(end, self._connection, make, plug), daemon=True
        )
        self._process.start()
        end.close()
        self._answer()

    def call(self, name: str, *arguments: object) -> Any:
        """Calls a method of the model and returns what it returns."""
        return self._ask("call", name, arguments)

    def get(self, name: str) -> Any:
        """Returns an attribute of the model."""
        return self._ask("get", name)

    def set(self, name: str, value: object) -> None:
        """Sets an attribute of the model."""
        self._ask("set", name, value)

    def unplug(self, after: float = 0.0) -> None:
        """Pulls the device out.

        Args:
            after: In s from now, >= 0: later, while this process is busy with the device.
        """
        self._ask("unplug", after)

    def close(self) -> None:
        """Pulls the device out if that is still to be done, and ends its process."""
        self._connection.close()
        self._process.join(5.0)
        self._process.kill()

    def __enter__(self) -> EmulatorProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _ask(self, *question: object) -> Any:
        self._connection.send(question)
        return self._answer()

    def _answer(self) -> Any:
        error, answer = self._connection.recv()
        if error:
            raise RuntimeError(f"in the emulated device: {error}")
        return answer


def _serve(
    connection: Connection[Any, Any],
    other_end: Connection[Any, Any],
    make: Callable[[], UsbDevice],
    plug: Callable[[Any], FrontEnd],
) -> None:
    other_end.close()
    # by default the kernel lets a sleeper wake up to 50 µs late; a device's timer does not
    ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)
    device = make()
    front = plug(device)
    connection.send((None, None))
    is_plugged = is_watched = True
    unplug_time = math.inf
    while is_plugged or front.files():
        now = time.monotonic()
        if is_plugged and now >= unplug_time:
            front.unplug()
            is_plugged = False
            continue
        due = min(front.settle(now) or math.inf, unplug_time) if is_plugged else math.inf
        # poll() and epoll() would round the 1 ms of a device's timer up to the next millisecond
        timeout = None if due == math.inf else max(_SHORTEST, due - time.monotonic())
        files = [*front.files(), *([connection.fileno()] if is_watched else [])]
        for file in select.select(files, [], [], timeout)[0]:
            if file != connection.fileno():
                front.serve(file, time.monotonic())
                continue
            try:
                verb, *rest = connection.recv()
            except EOFError:  # the test is over, or has died
                unplug_time = -math.inf
                is_watched = False
                continue
            if verb == "unplug":
                unplug_time = time.monotonic() + rest[0]
                connection.send((None, None))
            else:
                connection.send(_result(device, verb, *rest))


def _result(device: UsbDevice, verb: str, name: str, *values: Any) -> tuple[str | None, object]:
    """Returns (what went wrong or None, the answer)."""
    try:
        if verb == "call":
            return None, getattr(device, name)(*values[0])
        if verb == "set":
            setattr(device, name, values[0])
            return None, None
        return None, getattr(device, name)
    except Exception as error:
        return repr(error), None
