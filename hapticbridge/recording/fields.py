"""The fields of one MCAP record, read in order; a record that lies about its size is damaged."""

from __future__ import annotations

from hapticbridge.recording.file_bytes import FileBytes


class DamageError(Exception):
    """A record does not hold what its kind holds; never leaves this package."""


class Fields:
    """Reads the fields of one record in order.

    Args:
        data: The bytes that hold the record's body.
        start: Where the body starts.
        stop: Where it ends.
    """

    def __init__(self, data: bytes | FileBytes, start: int, stop: int) -> None:
        self._data, self._position, self._stop = data, start, stop

    @property
    def is_at_end(self) -> bool:
        """Whether nothing is left."""
        return self._position >= self._stop

    def raw(self, size: int) -> bytes:
        """Returns the next bytes.

        Raises:
            DamageError: The record is shorter. So it is with all that is read of it.
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
            DamageError: It is not UTF-8, or cut.
        """
        try:
            return self.raw(self.number(4)).decode()
        except UnicodeDecodeError as error:
            raise DamageError("its text is not UTF-8") from error

    def mapping(self) -> dict[str, str]:
        """Returns the next map of texts.

        Raises:
            DamageError: A key is there twice, a text is not UTF-8, or it is cut.
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
