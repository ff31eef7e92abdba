"""Writer of recordings (``recording.format``), and repair of a recording that was cut."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import math
import os
import shutil
import stat
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, BinaryIO, cast

import numpy as np
from mcap.data_stream import RecordBuilder
from mcap.records import ChunkIndex
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from hapticbridge.errors import RecordingError
from hapticbridge.files import is_unicode, reason_of
from hapticbridge.kernel.record import FORMAT, TICK_DTYPE
from hapticbridge.recording import format as layout
from hapticbridge.recording import ros_messages
from hapticbridge.recording.format import Attachment
from hapticbridge.recording.reader import Recording, read_hands, read_with_attachments
from hapticbridge.units import format_si

# Chunk index on disk


class ChunkIndexFile:
    """Replacement of the MCAP library's chunk index that uses disk instead of memory.

    An MCAP file ends with the position of each chunk, for access by time. The library keeps these
    entries as objects until the file is closed: 0.9 kB per chunk, 10 MB per hour at 1 kHz. Here an
    entry takes about 100 bytes in an unnamed temporary file, beside the recording if possible. The
    file vanishes when it is closed or its process dies. Entries that a full disk refuses stay in
    memory; the run ends soon after.

    Raises:
        OSError: No file can be created, there or in the temporary folder.
    """

    def __init__(self, folder: Path) -> None:
        self._file = _nameless_file(folder)
        self._size, self._rest = 0, b""

    def take_over(self, writer: Writer) -> None:
        """Replaces the library's private list; this is the only place that names it."""
        writer._Writer__chunk_indices = self  # type: ignore[attr-defined]

    def append(self, entry: ChunkIndex) -> None:
        """Adds the entry of a finished chunk."""
        builder = RecordBuilder()
        entry.write(builder)
        data: bytes = builder.end()  # type: ignore[no-untyped-call]
        with contextlib.suppress(OSError):
            if not self._rest and self._file.write(data) == len(data):
                self._size += len(data)
                return
        self._rest += data

    def __iter__(self) -> Iterator[_Entries]:
        """Yields all entries as one object, which the library writes into the summary."""
        self._file.seek(0)
        yield _Entries(self._file.read()[: self._size] + self._rest)

    def close(self) -> None:
        """Deletes the file."""
        self._file.close()


def _nameless_file(folder: Path) -> IO[bytes]:
    try:
        return tempfile.TemporaryFile(dir=folder, buffering=0)
    except OSError:  # the recording's folder may not allow new files
        return tempfile.TemporaryFile(buffering=0)


class _Entries:
    def __init__(self, data: bytes) -> None:
        self._data = data

    def write(self, stream: RecordBuilder) -> None:
        stream.write(self._data)


# Locked output file with reserved space

if sys.platform != "win32":
    import fcntl
    import resource


def is_being_recorded(path: Path) -> bool:
    """Returns whether a bridge is recording to a file."""
    if sys.platform == "win32" or not path.is_file():
        return False
    try:
        with path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False


RESERVE = 4 << 20
"""Space in bytes reserved beyond the file's end. Records at 1 kHz take 0.4 MB/s before compression,
and the loop checks its recorder ten times a second. It suffices for 10 kHz and for the index of
hours."""

_FULL = errno.ENOSPC, errno.EDQUOT, errno.EFBIG

_KEEP_SIZE, _PUNCH_HOLE = 1, 2  # FALLOC_FL_* of Linux


class Output:
    """Unbuffered file with a lock and reserved space.

    The MCAP library writes a finished chunk in one call; a buffer would hold its end back, and a
    kill would lose it. A full disk has no space for the index that closes the file, so space is
    reserved in advance. When no more can be reserved, the reserve takes the remaining data until
    the run has ended. The content of an existing file is lost; ``is_new`` refuses it.

    Attributes:
        is_full: True if no more space could be reserved; at most ``RESERVE`` bytes are then left.
            Always False on a file system without reservation.

    Raises:
        OSError: It cannot be opened, or another bridge is recording to it.
    """

    def __init__(self, path: Path, *, is_new: bool) -> None:
        # lock before truncating: another bridge may be recording to this file
        flags = os.O_WRONLY | os.O_CREAT | getattr(os, "O_BINARY", 0)
        flags |= os.O_EXCL if is_new else 0
        flags |= getattr(os, "O_NONBLOCK", 0)  # a pipe without a reader is an error at once
        self._file = os.fdopen(os.open(path, flags, 0o666), "wb", buffering=0)
        try:
            if hasattr(os, "O_NONBLOCK"):
                os.set_blocking(self._file.fileno(), True)
            if sys.platform != "win32":
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._is_regular = stat.S_ISREG(os.fstat(self._file.fileno()).st_mode)
            if self._is_regular:
                self._file.truncate(0)
        except BlockingIOError as error:
            self._file.close()
            raise OSError(errno.EBUSY, "another bridge is recording to it") from error
        self._position = self._claimed = 0
        self._claims = self._is_regular and sys.platform == "linux"
        self._fallocate = _fallocate() if self._claims else None
        self.is_full, self._limit = False, _file_limit()
        if self._claims:
            self._claim()

    def write(self, data: bytes) -> int:
        """Writes all data, then extends the reserve; about three calls per second."""
        view = memoryview(data)
        while view:
            written = self._file.write(view)
            view = view[written:]
        self._position += len(data)
        if self._claims and data:  # a reservation of zero bytes is an error
            self._claim()
        return len(data)

    def tell(self) -> int:
        """Returns the number of bytes written."""
        return self._position

    def flush(self) -> None:
        """Does nothing; writes are unbuffered."""

    def sync(self) -> None:
        """Waits until all data is on the disk."""
        if self._is_regular:
            os.fsync(self._file.fileno())

    def close(self) -> None:
        """Releases the unused reserve and closes the file."""
        if self._claimed > self._position and not self._file.closed:
            rest = self._claimed - self._position
            self._allocate(_KEEP_SIZE | _PUNCH_HOLE, self._position, rest)
            self._file.truncate(self._position)  # ext4 releases space beyond the end only this way
        self._file.close()

    def remove(self, path: Path) -> None:
        """Removes the closed file, if it is one."""
        if self._is_regular:
            with contextlib.suppress(OSError):
                path.unlink()

    def _claim(self) -> None:
        wanted = self._position + RESERVE
        number = errno.EFBIG  # a reservation beyond the file's end does not look at the limit
        if wanted <= self._limit:
            number = self._allocate(_KEEP_SIZE, self._claimed, wanted - self._claimed)
        if number == 0:
            self._claimed = wanted
        elif number in _FULL:
            self.is_full, self._claims = True, False
        elif number != errno.EINTR:
            self._claims = False

    def _allocate(self, mode: int, start: int, size: int) -> int:
        """Calls Linux's fallocate; returns the error number, or 0."""
        first, length = ctypes.c_int64(start), ctypes.c_int64(size)
        if self._fallocate is None:
            return errno.EOPNOTSUPP
        if self._fallocate(self._file.fileno(), mode, first, length) == 0:
            return 0
        return ctypes.get_errno()


def _file_limit() -> float:
    """Returns the largest size of a file in bytes that the system allows this process."""
    if sys.platform == "win32":
        return math.inf
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)[0]
    return math.inf if limit == resource.RLIM_INFINITY else float(limit)


def _fallocate() -> Callable[..., int] | None:
    """Returns Linux's 64-bit fallocate, which Python's os module lacks; None if unavailable."""
    libc = ctypes.CDLL(None, use_errno=True)
    for name in ("fallocate64", "fallocate"):  # not every C library has both
        if hasattr(libc, name):
            function: Callable[..., int] = getattr(libc, name)
            return function
    return None


class RecordingWriter:
    """Writer of one recording, for the recorder's process and for ``repair``.

    Metadata and attachments are in the file when the constructor returns. Each finished chunk
    reaches the operating system at once, so a kill loses at most the last unfinished chunk.

    Args:
        path: The file; it is overwritten unless ``exclusive``.
        metadata: Names and values; ``format`` and ``epoch_ns`` are added.
        attachments: Files to carry, with different names.
        epoch_ns: Unix time of the run's start in ns.
        exclusive: True refuses an existing file.

    Raises:
        RecordingError: The file cannot be written, or metadata or attachments are not valid.
    """

    def __init__(
        self,
        path: str | Path,
        metadata: Mapping[str, str],
        attachments: Sequence[Attachment],
        epoch_ns: int,
        *,
        exclusive: bool = False,
    ) -> None:
        self.path = Path(path)
        self._epoch = int(epoch_ns)
        meta = {
            layout.FORMAT_KEY: FORMAT,
            **metadata,
            layout.EPOCH_KEY: str(self._epoch),
        }
        check_contents(meta, attachments)
        self._messages = ros_messages.Messages(self._epoch, ros_messages.axes_of(meta))
        self._sequences = [0] * (1 + len(layout.further_hands(meta)))
        self._is_closed = False
        try:
            self._output = Output(self.path, is_new=exclusive)
        except OSError as error:
            raise self._refusal(error) from error
        try:
            self._index = ChunkIndexFile(self.path.parent)
        except OSError as error:
            self._output.close()
            raise self._refusal(error) from error
        try:
            self._start(meta, attachments)
        except OSError as error:
            if error.errno in _FULL:
                raise self._too_small(meta, attachments) from None
            raise self._failed(error) from error
        if self._output.is_full:  # the reserve may not hold what closes the file
            raise self._too_small(meta, attachments)

    def _too_small(
        self, meta: Mapping[str, str], attachments: Sequence[Attachment]
    ) -> RecordingError:
        """Ends the recording before its first record, and removes what was written."""
        texts = sum(len(text.encode()) for entry in meta.items() for text in entry)
        needed = RESERVE + texts + sum(len(attachment.data) for attachment in attachments)
        self._is_closed = True
        self._release()
        self._output.remove(self.path)
        free: float = shutil.disk_usage(self.path.parent).free
        owner = "its disk has {} free"
        if (limit := _file_limit()) < free:
            free, owner = limit, "'ulimit -f' allows {}"
        if free > needed:  # a device, or space that was freed since
            return self._refusal(OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)))
        return RecordingError(
            f"cannot write the recording {self.path}: it needs {format_si(needed, 'B')} from the "
            f"start, and {owner.format(format_si(free, 'B'))}"
        )

    def _start(self, meta: Mapping[str, str], attachments: Sequence[Attachment]) -> None:
        self._mcap = Writer(
            cast(BinaryIO, self._output),
            chunk_size=layout.CHUNK_SIZE,
            compression=CompressionType.ZSTD,
            enable_crcs=True,
            enable_data_crcs=True,
        )
        self._index.take_over(self._mcap)
        self._mcap.start(profile=layout.PROFILE, library="hapticbridge")
        self._mcap.add_metadata(layout.METADATA_NAME, dict(meta))
        for attachment in attachments:
            self._mcap.add_attachment(
                self._epoch, self._epoch, attachment.name, attachment.media_type, attachment.data
            )
        tick_schema = self._mcap.register_schema(
            layout.TICK_SCHEMA_NAME, layout.TICK_SCHEMA_ENCODING, layout.tick_schema()
        )
        first, *others = map(layout.tick_topic, range(len(self._sequences)))
        self._ticks = [self._mcap.register_channel(first, layout.TICK_ENCODING, tick_schema)]
        event_schema = self._mcap.register_schema(
            layout.EVENT_SCHEMA_NAME, layout.TICK_SCHEMA_ENCODING, layout.EVENT_SCHEMA
        )
        self._events = self._mcap.register_channel(
            layout.EVENT_TOPIC, layout.TICK_ENCODING, event_schema
        )
        schemas = {
            name: self._mcap.register_schema(name, layout.TICK_SCHEMA_ENCODING, text)
            for name, text in dict(ros_messages.TOPICS.values()).items()
        }
        self._channels = {
            topic: self._mcap.register_channel(topic, layout.TICK_ENCODING, schemas[name])
            for topic, (name, _) in ros_messages.TOPICS.items()
        }
        self._ticks += [
            self._mcap.register_channel(topic, layout.TICK_ENCODING, tick_schema)
            for topic in others
        ]

    @property
    def is_full(self) -> bool:
        """True if the disk is full; the rest goes into the reserve."""
        return self._output.is_full

    def write_ticks(self, rows: NDArray[np.void], hand: int = 0) -> None:
        """Appends records of a hand, shape (n,), with the fields that the writer was given.

        The messages for ROS 2 follow from the records of the first hand.

        Raises:
            RecordingError: The file cannot be written; it ends with its last whole chunk.
        """
        payloads = np.empty(rows.size, layout.payload_dtype(TICK_DTYPE))
        payloads["cdr"] = np.void(layout.CDR_HEADER)
        payloads["record"] = rows
        packed, size = payloads.tobytes(), payloads.itemsize
        # an impossible deadline (before 1970, after 2554) must not stop the recorder
        times = (rows["deadline_ns"].astype(np.uint64) + np.uint64(self._epoch % 2**64)).tolist()
        sequence = self._sequences[hand]
        try:
            for index, time in enumerate(times):
                self._mcap.add_message(
                    self._ticks[hand],
                    time,
                    packed[index * size : (index + 1) * size],
                    time,
                    (sequence + index) & 0xFFFFFFFF,
                )
            derived = {} if hand else self._messages.of_ticks(rows)
            for topic, messages in derived.items():
                for time, payload in messages.tolist():
                    self._mcap.add_message(self._channels[topic], time, payload, time)
        except OSError as error:
            raise self._failed(error) from error
        self._sequences[hand] += len(times)

    def write_event(self, event: Mapping[str, object], time_ns: int) -> None:
        """Appends an event.

        ``event["event"]`` is its name; ``time_ns`` counts from the start of the run.

        Raises:
            RecordingError: The file cannot be written; it ends with its last whole chunk.
        """
        payload = layout.event_payload(event, time_ns)
        time = (self._epoch + int(time_ns)) % 2**64
        try:
            self._mcap.add_message(self._events, time, layout.cdr_text(payload), time)
            time, line = self._messages.of_event(payload, int(time_ns), event.get("event"))
            self._mcap.add_message(self._channels[ros_messages.LOG], time, line, time)
        except OSError as error:
            raise self._failed(error) from error

    def close(self) -> None:
        """Finishes the file with last chunk and index, and syncs it to the disk.

        Raises:
            RecordingError: The file cannot be written; it ends with its last whole chunk.
        """
        if self._is_closed:
            return
        self._is_closed = True
        try:
            self._mcap.finish()  # type: ignore[no-untyped-call]
            self._output.sync()
        except OSError as error:
            raise self._refusal(error) from error
        finally:
            self._release()

    def _failed(self, error: OSError) -> RecordingError:
        # nothing may follow a half-written chunk; the file then counts as cut there
        self._is_closed = True
        self._release()
        return self._refusal(error)

    def _release(self) -> None:
        self._output.close()
        self._index.close()

    def _refusal(self, error: OSError) -> RecordingError:
        reason = reason_of(error, self.path)
        return RecordingError(f"cannot write the recording {self.path}: {reason}")


def check_contents(metadata: Mapping[str, str], attachments: Sequence[Attachment]) -> None:
    """Checks metadata and attachments of a recording.

    Raises:
        RecordingError: A name or value is not Unicode text, or two attachments have one name.
    """
    texts = [text for entry in metadata.items() for text in entry]
    names = [attachment.name for attachment in attachments]
    texts += names + [attachment.media_type for attachment in attachments]
    for text in texts:
        if not isinstance(text, str):
            raise RecordingError(f"metadata of a recording must be text, not {text!r}")
        if not is_unicode(text):
            raise RecordingError(f"metadata of a recording must be valid Unicode, not {text!r}")
    if twice := {name for name in names if names.count(name) > 1}:
        raise RecordingError(f"two attachments are named {sorted(twice)[0]!r}")


# Repair of a cut recording

_BATCH = 4096
"""Records written at once. A larger batch takes more memory, a smaller one more time."""


def repair(path: str | Path, output: str | Path) -> Recording:
    """Writes a cut recording again as a whole one.

    Metadata, attachments, and all whole records and events are kept. An event ``repaired``
    describes the repair.

    Returns:
        The new recording, as read back; of several hands, that of the first.

    Raises:
        RecordingError: The recording cannot be read or is not cut, or the output exists or cannot
            be written.
    """
    path, output = Path(path), Path(output)
    recording, attachments = read_with_attachments(path, 0)
    if not recording.is_cut:
        damage = f", only damaged: {recording.problems[0]}" if recording.problems else ""
        raise RecordingError(f"{path} is not cut{damage}, so there is nothing to repair")
    deadlines = recording.ticks["deadline_ns"][-1:].tolist()
    made = {
        "event": "repaired",
        "source": path.name,
        "ticks": int(recording.ticks.size),
        "problems": list(recording.problems),
        "time_ns": max([*deadlines, *map(_time, recording.events)], default=0),
    }
    events = [*recording.events, made]
    ticks = [recording.ticks, *(hand.ticks for hand in read_hands(path)[1:])]
    rewrite(recording, attachments, output, ticks, events, exclusive=True)
    return read_hands(output)[0]


def rewrite(
    recording: Recording,
    attachments: Sequence[Attachment],
    output: Path,
    ticks: Sequence[NDArray[np.void]],
    events: Sequence[Mapping[str, object]],
    *,
    exclusive: bool = False,
) -> None:
    """Writes a recording's metadata and attachments again, with these records and events.

    ``ticks`` are the records of each hand, equally many.

    Raises:
        RecordingError: The file cannot be written, or exists and the access is ``exclusive``.
    """
    writer = RecordingWriter(
        output,
        recording.meta,
        attachments,
        layout.epoch_of(recording.meta),
        exclusive=exclusive,
    )
    written = 0

    def write_until(stop: int) -> None:
        nonlocal written
        for start in range(written, stop, _BATCH):
            for hand, own in enumerate(ticks):
                writer.write_ticks(own[start : min(start + _BATCH, stop)], hand)
        written = max(written, stop)

    try:
        for event in events:  # each where it happened, so that a later cut does not lose them all
            time = _time(event)
            write_until(int(np.searchsorted(ticks[0]["deadline_ns"], time, side="right")))
            writer.write_event(event, time)
        write_until(ticks[0].size)
        writer.close()
    except RecordingError:
        output.unlink(missing_ok=True)
        raise


def _time(event: Mapping[str, object]) -> int:
    time = event.get("time_ns")
    return time if isinstance(time, int) and abs(time) < 2**63 else 0
