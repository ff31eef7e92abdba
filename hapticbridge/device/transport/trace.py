"""Hexadecimal log of transferred bytes."""

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
"""Environment variable with the log's file, used without the device's option ``log``."""

MAX_LINES = 200_000
"""Largest number of transfers kept: the last 100 s at 1 kHz in both directions, in some 40 MB."""


class HexLog:
    """Transfers with their time, kept in memory and written on closing.

    Nothing is written during a run, because the loop must not wait for a disk. A line is ``SECONDS
    < HEX`` (from the device) or ``SECONDS > HEX`` (to it), in seconds of a monotonic clock from the
    log's beginning.

    Args:
        path: File to write; None selects ``HAPTICBRIDGE_LOG_USB``, without which nothing is kept.

    Raises:
        DeviceError: The file cannot be written; raised before the device is opened.
    """

    def __init__(self, path: str | Path | None = None) -> None:
        named = path or os.environ.get(VARIABLE, "")
        self._path = Path(named) if named else None
        self._lines: deque[tuple[int, str, bytes]] = deque(maxlen=MAX_LINES)
        self._count = 0
        self._origin = time.monotonic_ns()
        if self._path is not None:
            with _appending(self._path):
                pass

    @classmethod
    def from_options(cls, options: Mapping[str, object]) -> HexLog:
        """Returns the log named by a device's option ``log``, or else by the variable."""
        named = options.get("log")
        return cls(None if named is None else str(named))

    @property
    def is_on(self) -> bool:
        """True if transfers are kept."""
        return self._path is not None

    def add(self, direction: str, data: bytes) -> None:
        """Keeps one transfer; the direction is ``<`` from the device or ``>`` to it."""
        if self._path is not None:
            self._lines.append((time.monotonic_ns(), direction, data))
            self._count += 1

    def close(self) -> None:
        """Appends the transfers to the file; a second call writes nothing."""
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
