"""Tolerant reader of the MCAP container."""

from __future__ import annotations

import struct
import zlib
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeAlias

import zstandard
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from hapticbridge.recording.fields import DamageError, Fields
from hapticbridge.recording.file_bytes import FileBytes

MAGIC = MCAP0_MAGIC
"""First and last bytes of an MCAP file."""

MAX_CHUNK_SIZE = 1 << 28
"""Largest chunk in bytes that is decompressed; a damaged size must not exhaust memory."""

_RECORD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQI")
_FOOTER = struct.Struct("<QQI")
_FOOTER_SIZE = _RECORD.size + _FOOTER.size
_AHEAD = 64
"""Number of chunks decompressed in advance: about 8 MB of records at 128 kB each."""


@dataclass(frozen=True)
class Block:
    """Schema, channel and message records of a chunk, or loose ones.

    Attributes:
        label: Name for messages.
        data: Bytes of the records.
        fault: Description of damage, or empty.
    """

    label: str
    data: bytes
    fault: str = ""


_Item: TypeAlias = Block | tuple[int, Fields]


class Container:
    """An MCAP file with its damage.

    The MCAP library's reader yields single messages (10 µs each) and stops at the first fault. Here
    a chunk is one block of bytes, and a fault becomes a sentence.

    Attributes:
        is_cut: True if the end of the file is missing.
        problems: Damage, one sentence each; complete after ``records`` is exhausted.
    """

    def __init__(self, data: FileBytes) -> None:
        self._data = data
        self.problems: list[str] = []
        self._summary, self._end = 0, len(data)
        footer = len(data) - len(MAGIC) - _FOOTER_SIZE
        self.is_cut = not (
            footer >= len(MAGIC)
            and data[-len(MAGIC) :] == MAGIC
            and _RECORD.unpack(data[footer : footer + _RECORD.size])
            == (Opcode.FOOTER, _FOOTER.size)
        )
        self._chunks: list[int] = []
        if not self.is_cut:
            self._end = footer
            self._read_footer(footer)

    def _read_footer(self, footer: int) -> None:
        start, _, crc = _FOOTER.unpack(self._data[footer + _RECORD.size : footer + _FOOTER_SIZE])
        if start == 0 and crc == 0:
            return
        if not len(MAGIC) <= start <= footer or (
            crc and self._data.checksum(start, self._end + _FOOTER_SIZE - 4) != crc
        ):
            self.problems.append("the index at the end of the file is damaged (checksum)")
        if len(MAGIC) <= start <= footer:
            self._summary = start
            for opcode, body, stop in self._walk(start, footer, []):
                if opcode == Opcode.CHUNK_INDEX and stop - body >= 24:
                    self._chunks.append(int.from_bytes(self._data[body + 16 : body + 24], "little"))
            self._chunks.sort()

    def summary(self) -> Block:
        """Returns the schemas and channels repeated at the end of the file, if any."""
        pieces = [
            self._data[body - _RECORD.size : stop]
            for opcode, body, stop in self._walk(self._summary or self._end, self._end, [])
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL)
        ]
        return Block("the index at the end of the file", b"".join(pieces))

    def records(self) -> Iterator[_Item]:
        """Yields blocks of messages and, as (opcode, fields), metadata and attachments, in order.

        Threads decompress and check chunks ahead of the one that is yielded.
        """
        with ThreadPoolExecutor(2) as pool:
            ahead: deque[_Item | Future[Block]] = deque()
            count = 0
            for opcode, body, stop in self._data_section():
                start = body - _RECORD.size
                if opcode == Opcode.CHUNK:
                    count += 1
                    label = f"chunk {count} (at byte {start})"
                    ahead.append(pool.submit(self._unpack, label, body, stop))
                elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
                    ahead.append(Block(f"the record at byte {start}", self._data[start:stop]))
                elif opcode in (Opcode.METADATA, Opcode.ATTACHMENT):
                    if opcode == Opcode.ATTACHMENT:
                        self._check_attachment(body, stop)
                    ahead.append((opcode, Fields(self._data, body, stop)))
                if len(ahead) > _AHEAD:
                    yield self._finished(ahead.popleft())
            while ahead:
                yield self._finished(ahead.popleft())

    def _check_attachment(self, body: int, stop: int) -> None:
        crc = int.from_bytes(self._data[max(body, stop - 4) : stop], "little")
        if crc and self._data.checksum(body, stop - 4) != crc:
            start = body - _RECORD.size
            self.problems.append(
                f"the attachment at byte {start} is damaged: its checksum does not match"
            )

    def _finished(self, item: _Item | Future[Block]) -> _Item:
        if isinstance(item, Future):
            item = item.result()
        if isinstance(item, Block) and item.fault:
            self.problems.append(f"{item.label} is damaged: {item.fault}")
        return item

    def _unpack(self, label: str, body: int, stop: int) -> Block:
        fields = Fields(self._data, body, stop)
        try:
            _, _, size, crc = _CHUNK.unpack(fields.raw(_CHUNK.size))
            compression = fields.text()
            data = _decompressed(compression, fields.raw(fields.number(8)), size)
        except DamageError as error:
            return Block(label, b"", str(error))
        if len(data) != size or zlib.crc32(data) != crc:
            return Block(label, data, "its checksum does not match")
        return Block(label, data)

    def _data_section(self) -> Iterator[tuple[int, int, int]]:
        for opcode, body, stop in self._walk(len(MAGIC), self._end, self._chunks):
            if opcode == Opcode.DATA_END:
                crc = Fields(self._data, body, stop).number(4) if stop - body >= 4 else 0
                if crc and self._data.checksum(0, body - _RECORD.size) != crc:
                    self.problems.append("the data section's checksum does not match")
                return
            yield opcode, body, stop
        if not self.is_cut:
            self.problems.append("the mark at the end of the data section is missing")

    def _walk(self, start: int, end: int, resume: list[int]) -> Iterator[tuple[int, int, int]]:
        """Yields (opcode, start of body, end of body); after a fault it continues at ``resume``."""
        position = start
        while position < end:
            head = self._data[position : min(position + _RECORD.size, end)]
            stop, opcode = end + 1, head[0]
            if len(head) == _RECORD.size:
                _, length = _RECORD.unpack(head)
                stop = position + _RECORD.size + length
            if stop <= end and opcode >= Opcode.HEADER:
                if Opcode.DATA_END < opcode < 0x80:
                    self.problems.append(
                        f"the record at byte {position} is of unknown kind {opcode}"
                    )
                yield opcode, position + _RECORD.size, stop
                position = stop
                continue
            following = next((offset for offset in resume if position < offset < end), None)
            # after a power failure, zeros may follow the last whole record
            is_cut_here = self.is_cut and (opcode != 0 or self._data.is_zero_from(position))
            if not is_cut_here:
                until = "the file's end" if following is None else f"byte {following}"
                self.problems.append(f"nothing can be read from byte {position} to {until}")
            if following is None:
                return
            position = following


def _decompressed(compression: str, packed: bytes, size: int) -> bytes:
    if size > MAX_CHUNK_SIZE:
        raise DamageError(f"its size of {size} bytes is beyond {MAX_CHUNK_SIZE}")
    if not compression:
        return packed
    if compression != "zstd":
        raise DamageError(f"its compression '{compression}' is not one of 'zstd' and none")
    try:
        # zstandard allocates the size that the frame header claims
        if zstandard.frame_content_size(packed) not in (-1, size):
            raise DamageError("its size does not match")
        return zstandard.ZstdDecompressor().decompress(packed, max_output_size=size)
    except zstandard.ZstdError as error:
        raise DamageError("it does not decompress") from error
