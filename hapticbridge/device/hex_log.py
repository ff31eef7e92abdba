"""A log of every byte between host and device, on demand: kept in memory, written at the end."""

from __future__ import annotations

import os
import time
from collections import deque
from pathlib import Path

from hapticbridge.errors import DeviceError

ENVIRONMENT = "HAPTICBRIDGE_LOG_USB"
"""Environment variable that names the file, for devices opened without the option ``log``."""

LONGEST = 1_000_000
"""Lines that are kept, the newest: about eight minutes of 1 kHz both ways, some 150 MB."""


class HexLog:
    """Lines of time, direction and bytes; nothing is formatted or written before ``save``.

    Args:
        path: The file, replaced by ``save``.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lines: deque[tuple[int, str, bytes]] = deque(maxlen=LONGEST)

    @classmethod
    def asked_for(cls, path: str | None) -> HexLog | None:
        """Returns a log into a file, or into the environment's; None where neither names one.

        Raises:
            DeviceError: The file cannot be written.
        """
        name = path or os.environ.get(ENVIRONMENT, "")
        if not name:
            return None
        try:
            Path(name).write_text("", encoding="ascii")
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise DeviceError(f"log = '{name}': cannot be written ({reason})") from None
        return cls(Path(name))

    def add(self, direction: str, data: bytes) -> None:
        """Notes bytes with the present time; ``direction`` is a word, as 'out' or 'in'."""
        self._lines.append((time.monotonic_ns(), direction, data))

    def save(self) -> None:
        """Writes ``seconds direction hex`` per line, seconds of the monotonic clock; best effort.

        Called while a device is released, where a full disk must not hide what went wrong before.
        """
        text = "".join(
            f"{ns // 10**9}.{ns % 10**9:09d} {direction} {data.hex(' ')}\n"
            for ns, direction, data in self._lines
        )
        try:
            self._path.write_text(text, encoding="ascii")
        except OSError:
            return
