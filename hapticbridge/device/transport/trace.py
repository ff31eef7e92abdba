"""What went over the wire, in hexadecimal, for whoever looks for a fault."""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from hapticbridge.errors import DeviceError

VARIABLE = "HAPTICBRIDGE_LOG_USB"
"""Environment variable that names the log's file where the device's option ``log`` does not."""

MOST_LINES = 200_000
"""Transfers that are kept. At 1 kHz both ways that is the last 100 s, in some 40 MB."""


class HexLog:
    """Transfers with their time, kept in memory and written when it is closed.

    The loop must not wait for a disk, so nothing is written while it runs. A line is
    ``SECONDS < HEX`` (from the device) or ``SECONDS > HEX`` (to it), seconds of a monotonic clock
    from the log's beginning.

    Args:
        path: File to write; None takes ``HAPTICBRIDGE_LOG_USB``, and keeps nothing without it.

    Raises:
        DeviceError: The file cannot be written; said before the device is opened, not after a run.
    """

    def __init__(self, path: str | Path | None = None) -> None:
        named = path or os.environ.get(VARIABLE, "")
        self._path = Path(named) if named else None
        self._lines: deque[tuple[int, str, bytes]] = deque(maxlen=MOST_LINES)
        self._count = 0
        self._origin = time.monotonic_ns()
        if self._path is not None:
            with _appending(self._path):
                pass

    @classmethod
    def asked(cls, options: Mapping[str, object]) -> HexLog:
        """Returns the log that a device's option ``log`` names, or else the variable.

        Raises:
            DeviceError: The file cannot be written.
        """
        named = options.get("log")
        return cls(None if named is None else str(named))

    @property
    def is_on(self) -> bool:
        """Whether it keeps anything."""
        return self._path is not None

    def add(self, direction: str, data: bytes) -> None:
        """Keeps one transfer.

        Args:
            direction: ``<`` from the device, ``>`` to it.
            data: What went over.
        """
        if self._path is not None:
            self._lines.append((time.monotonic_ns(), direction, data))
            self._count += 1

    def close(self) -> None:
        """Writes the file, appending; a second call writes nothing more.

        Raises:
            DeviceError: It cannot be written.
        """
        if self._path is None:
            return
        path, self._path = self._path, None
        dropped = self._count - len(self._lines)
        try:
            with _appending(path) as file:
                if dropped:
                    file.write(f"# {dropped} transfers before these were not kept\n")
                for when, direction, data in self._lines:
                    file.write(f"{1e-9 * (when - self._origin):.6f} {direction} {data.hex(' ')}\n")
        finally:
            self._lines.clear()


@contextmanager
def _appending(path: Path) -> Iterator[TextIO]:
    try:
        with path.open("a", encoding="ascii") as file:
            yield file
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise DeviceError(f"the log '{path}' cannot be written: {reason}") from None
