"""Tolerant reader of the MCAP container."""

from __future__ import annotations

import os
import struct
import threading
import zlib
from bisect import bisect_right
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import lz4.frame
import zstandard
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from hapticbridge.errors import RecordingError, choices
from hapticbridge.units import format_count

# Random access to a file's bytes

WINDOW = 1 << 20
"""Bytes per read of a long stretch. A larger window takes more memory, a smaller one more calls."""


class FileBytes:
    """A file as a sequence of bytes that is never in memory as a whole.

    It is not memory-mapped: a bridge that overwrites the file would truncate it, and access to a
    mapped page beyond the end kills the process. Slices may be read from several threads.

    Raises:
        RecordingError: It cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = threading.Lock()
        try:
            if path.exists() and not path.is_file():
                kind = "a folder" if path.is_dir() else "not a regular file"
                if path.is_dir() and not os.access(path, os.R_OK | os.X_OK):
                    kind = "a folder that cannot be read"
                raise RecordingError(f"cannot read the recording {path}: it is {kind}")
            self._size = path.stat().st_size
            self._file = path.open("rb", buffering=0)
        except (OSError, ValueError) as error:
            raise self._refusal(error) from error

    def __enter__(self) -> FileBytes:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def __len__(self) -> int:
        return self._size

    def __getitem__(self, places: slice) -> bytes:
        """Returns the bytes of a slice without a step.

        Raises:
            RecordingError: They cannot be read, or the file has become shorter.
        """
        start, stop, _ = places.indices(self._size)
        wanted = max(stop - start, 0)
        pieces = bytearray()
        try:
            with self._lock:
                self._file.seek(start)
                piece = self._file.read(wanted)
                if len(piece) == wanted:
                    return piece
                # a read may return fewer bytes than requested
                while piece and len(pieces) < wanted:
                    pieces += piece
                    piece = self._file.read(wanted - len(pieces))
        except OSError as error:
            raise self._refusal(error) from error
        if len(pieces) < wanted:
            raise RecordingError(f"the recording {self._path} became shorter while it was read")
        return bytes(pieces)

    def checksum(self, start: int, stop: int) -> int:
        """Returns the CRC-32 of a stretch."""
        crc = 0
        for at in range(start, stop, WINDOW):
            crc = zlib.crc32(self[at : min(at + WINDOW, stop)], crc)
        return crc

    def is_zero_from(self, start: int) -> bool:
        """Returns True if all bytes from a position on are zero."""
        return not any(any(self[at : at + WINDOW]) for at in range(start, self._size, WINDOW))

    def _refusal(self, error: Exception) -> RecordingError:
        reason = getattr(error, "strerror", None) or error
        return RecordingError(f"cannot read the recording {self._path}: {reason}")


# Fields of one MCAP record


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


MAGIC = MCAP0_MAGIC
"""First and last bytes of an MCAP file."""


def refuse_replacing(path: Path) -> None:
    """Refuses to replace a file that has content and is no MCAP file, such as a scene.

    Raises:
        RecordingError: Names the file.
    """
    if not path.is_file():
        return
    with path.open("rb") as file:
        if file.read(len(MAGIC)) not in (b"", MAGIC):
            raise RecordingError(
                f"'{path}' exists and is no recording, so it is not replaced; choose another file"
            )


MAX_CHUNK_SIZE = 1 << 25
"""Largest chunk in bytes that is decompressed; a damaged size must not exhaust memory. The recorder
writes 128 kB; other programs close a chunk when it has passed 4 MiB, such as ``mcap filter``."""

MAX_RATIO, FREE_SIZE = 100, 1 << 25
"""Bytes that all chunks may hold per byte of the file, without unit, and the bytes that they may
hold beyond it. A recorded run compresses to a third, one at rest to a thirtieth; a small file that
claims to hold much more would take a reader's time."""

_RECORD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQI")
_FOOTER = struct.Struct("<QQI")
_FOOTER_SIZE = _RECORD.size + _FOOTER.size
_AHEAD, _USUAL_SIZE = 1 << 23, 1 << 17
"""Bytes of chunks that are decompressed in advance, and bytes that each is taken for at least: 64
chunks of the recorder."""


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


_Record: TypeAlias = Block | tuple[int, Fields]


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
        self._summary, self._end, self.is_cut = 0, len(data), True
        self._chunks: list[int] = []
        footer = len(data) - len(MAGIC) - _FOOTER_SIZE
        if self._is_end(footer):
            self._read_footer(footer)
        if self.is_cut or self.problems:
            self._look_behind(footer)

    def _is_end(self, footer: int) -> bool:
        """Returns True if a footer is here, and the magic behind it."""
        head = self._data[max(footer, 0) : footer + _RECORD.size]
        after = footer + _FOOTER_SIZE
        return (
            footer >= len(MAGIC)
            and head == _RECORD.pack(Opcode.FOOTER, _FOOTER.size)
            and self._data[after : after + len(MAGIC)] == MAGIC
        )

    def _look_behind(self, last: int) -> None:
        """Takes a whole file's end for the end if there are bytes behind it."""
        found, self.problems = self.problems, []
        bodies = (body for _, body, _ in self._walk(len(MAGIC), len(self._data), []))
        first = next(filter(self._is_end, (body - _RECORD.size for body in bodies)), last)
        self.problems = found
        if first == last:
            return
        self.problems, self._chunks = [], []
        self._read_footer(first)
        end = first + _FOOTER_SIZE + len(MAGIC)
        more = len(self._data) - end
        self.problems.append(
            f"its end is followed by {format_count(more, 'more byte')} ('truncate -s {end}' takes "
            "them away)"
        )

    def _read_footer(self, footer: int) -> None:
        self._end, self.is_cut = footer, False
        start, _, crc = _FOOTER.unpack(self._data[footer + _RECORD.size : footer + _FOOTER_SIZE])
        start = start or footer  # without an index the checksum is that of the footer
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

    def metadata(self, name: str) -> dict[str, str] | None:
        """Returns the first metadata record of a name, wherever it stands; None without one.

        A program that writes a file anew may write it behind the messages. Damage is reported by
        ``records``.
        """
        found, self.problems = self.problems, []
        try:
            for opcode, body, stop in self._walk(len(MAGIC), self._end, self._chunks):
                fields = Fields(self._data, body, stop)
                if opcode == Opcode.METADATA and fields.text() == name:
                    return fields.mapping()
        except DamageError:
            pass
        finally:
            self.problems = found
        return None

    def foreign_compression(self) -> str:
        """Returns a sentence if all chunks have a compression that is none of MCAP; else empty.

        A single chunk of that kind is damage, which ``records`` reports.
        """
        names, found, self.problems = set[str](), self.problems, []
        try:
            for opcode, body, stop in self._walk(len(MAGIC), self._end, self._chunks):
                if opcode == Opcode.CHUNK:
                    fields = Fields(self._data, body, stop)
                    fields.raw(_CHUNK.size)
                    names.add(fields.text())
                    if names & COMPRESSIONS:
                        return ""
        except DamageError:
            return ""
        finally:
            self.problems = found
        if not names:
            return ""
        return (
            f"its chunks are compressed by {choices(names)}, and MCAP has 'lz4', 'zstd' and none; "
            "let the program that wrote it take one of these"
        )

    def records(self) -> Iterator[_Record]:
        """Yields blocks of messages and, as (opcode, fields), metadata and attachments, in order.

        Threads decompress and check chunks ahead of the one that is yielded.
        """
        with ThreadPoolExecutor(2) as pool:
            ahead: deque[_Record | Future[Block]] = deque()
            count, room, largest = 0, FREE_SIZE + MAX_RATIO * len(self._data), _USUAL_SIZE
            for opcode, body, stop in self._data_section():
                start = body - _RECORD.size
                if opcode == Opcode.CHUNK:
                    count += 1
                    size = self._claimed_size(body, stop)
                    label = f"chunk {count} (at byte {start})"
                    if size > min(room, MAX_CHUNK_SIZE):
                        limit = (
                            f"more than {MAX_CHUNK_SIZE}"
                            if size > MAX_CHUNK_SIZE
                            else f"and all chunks more than {MAX_RATIO} times the file"
                        )
                        self.problems.append(
                            f"{label} is not read: it claims {size} bytes, {limit}"
                        )
                        continue
                    room, largest = room - size, max(largest, size)
                    ahead.append(pool.submit(self._unpack, label, start, stop))
                elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
                    ahead.append(Block(f"the record at byte {start}", self._data[start:stop]))
                elif opcode in (Opcode.METADATA, Opcode.ATTACHMENT):
                    if opcode == Opcode.ATTACHMENT:
                        self._check_attachment(body, stop)
                    ahead.append((opcode, Fields(self._data, body, stop)))
                while len(ahead) * largest > _AHEAD:
                    yield self._finished(ahead.popleft())
            while ahead:
                yield self._finished(ahead.popleft())

    def _claimed_size(self, body: int, stop: int) -> int:
        head = self._data[body : min(body + _CHUNK.size, stop)]
        return int(_CHUNK.unpack(head)[2]) if len(head) == _CHUNK.size else 0

    def _check_attachment(self, body: int, stop: int) -> None:
        crc = int.from_bytes(self._data[max(body, stop - 4) : stop], "little")
        if crc and self._data.checksum(body, stop - 4) != crc:
            start = body - _RECORD.size
            self.problems.append(
                f"the attachment at byte {start} is damaged: its checksum does not match"
            )

    def _finished(self, record: _Record | Future[Block]) -> _Record:
        if isinstance(record, Future):
            record = record.result()
        if isinstance(record, Block) and record.fault:
            self.problems.append(f"{record.label} is damaged: {record.fault}")
        return record

    def _unpack(self, label: str, start: int, stop: int) -> Block:
        block = self._chunk(label, start, stop)
        # after a power failure, zeros may stand for the rest of the last chunk
        is_cut_here = block.fault and self.is_cut and self._data.is_zero_from(stop - 1)
        return Block(label, b"") if is_cut_here else block

    def _chunk(self, label: str, start: int, stop: int) -> Block:
        record = self._data[start:stop]
        fields = Fields(record, _RECORD.size, len(record))
        try:
            _, _, size, crc = _CHUNK.unpack(fields.raw(_CHUNK.size))
            compression = fields.text()
            data = _decompressed(compression, fields.raw(fields.number(8)), size)
        except DamageError as error:
            return Block(label, b"", str(error))
        if len(data) != size:
            return Block(label, data, f"it has {len(data):,} bytes and states {size:,}")
        if crc and zlib.crc32(data) != crc:  # 0: none was computed
            return Block(label, data, "its checksum does not match")
        return Block(label, data)

    def _data_section(self) -> Iterator[tuple[int, int, int]]:
        for opcode, body, stop in self._walk(len(MAGIC), self._end, self._chunks):
            if opcode == Opcode.DATA_END:
                crc = Fields(self._data, body, stop).number(4) if stop - body >= 4 else 0
                if crc and self._data.checksum(0, body - _RECORD.size) != crc:
                    self.problems.append("the data section's checksum does not match")
                if not self.is_cut and stop != (self._summary or self._end):
                    self.problems.append("the index does not follow the data section")
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
            place = bisect_right(resume, position)  # sorted
            following = resume[place] if place < len(resume) and resume[place] < end else None
            # after a power failure, zeros may follow the last whole record
            is_cut_here = self.is_cut and (opcode != 0 or self._data.is_zero_from(position))
            if not is_cut_here:
                until = "the file's end" if following is None else f"byte {following}"
                self.problems.append(f"nothing can be read from byte {position} to {until}")
            if following is None:
                return
            position = following


COMPRESSIONS = {"", "lz4", "zstd"}
"""Compressions of chunks that MCAP defines; an empty name for none."""


def _decompressed(compression: str, packed: bytes, size: int) -> bytes:
    if not compression:
        return packed
    if compression not in COMPRESSIONS:
        raise DamageError(f"its compression '{compression}' is not one of 'lz4', 'zstd' and none")
    try:
        if compression == "lz4":
            return bytes(lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size))
        # zstandard allocates the size that the frame header claims
        if zstandard.frame_content_size(packed) not in (-1, size):
            raise DamageError("its size does not match")
        # 0 would mean the size in the frame header, which may be left out
        return zstandard.ZstdDecompressor().decompress(packed, max_output_size=max(size, 1))
    except (zstandard.ZstdError, RuntimeError) as error:  # of lz4
        raise DamageError("it does not decompress") from error
