"""Fields of one MCAP record."""

from __future__ import annotations

from hapticbridge.recording.file_bytes import FileBytes


class DamageError(Exception):
    """A record contradicts its declared size or kind; internal to this package."""


class Fields:
    """Sequential reader of one record's fields."""

    def __init__(self, data: bytes | FileBytes, start: int, stop: int) -> None:
        self._data, self._position, self._stop = data, start, stop

    @property
    def is_at_end(self) -> bool:
        """True if no bytes are left."""
        return self._position >= self._stop

    def raw(self, size: int) -> bytes:
        """Returns the next bytes.

        Raises:
            DamageError: The record is shorter; all other readers raise it too.
        """
        start = self._position
        if size > self._stop - start:
            raise DamageError("it is shorter than its fields")
        self._position = start + size
        return self._data[start : start + size]

    def number(self, size: int) -> int:
        """Returns the next unsigned number of 2, 4 or 8 bytes."""
        return int.from_bytes(self.raw(size), "little")

    def text(self) -> str:
        """Returns the next text.

        Raises:
            DamageError: It is cut or not UTF-8.
        """
        try:
            return self.raw(self.number(4)).decode()
        except UnicodeDecodeError as error:
            raise DamageError("its text is not UTF-8") from error

    def mapping(self) -> dict[str, str]:
        """Returns the next map of texts.

        Raises:
            DamageError: A key occurs twice, a text is not UTF-8, or the map is cut.
        """
        size = self.number(4)
        inner = Fields(self._data, self._position, self._position + size)
        self.raw(size)
        entries: dict[str, str] = {}
        while not inner.is_at_end:
            key = inner.text()
            if key in entries:
                raise DamageError(f"it holds '{key}' twice")
            entries[key] = inner.text()
        return entries
