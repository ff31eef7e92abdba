"""Writer of recordings (format: ``hapticbridge.recording.format``)."""

from __future__ import annotations

import errno
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import BinaryIO, cast

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from hapticbridge.errors import RecordingError
from hapticbridge.recording import format as layout
from hapticbridge.recording.chunk_index import ChunkIndexFile
from hapticbridge.recording.format import Attachment
from hapticbridge.recording.output import Output


class RecordingWriter:
    """Writer of one recording, for the recorder's process and for ``repair``.

    Metadata and attachments are in the file when the constructor returns. Each finished chunk
    reaches the operating system at once, so a kill loses at most the last unfinished chunk.

    Args:
        path: The file; it is overwritten unless ``exclusive``.
        metadata: Names and values; ``epoch_ns`` is added.
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
        meta = {**metadata, layout.EPOCH_KEY: str(self._epoch)}
        check_contents(meta, attachments)
        self._digest = layout.Digest(meta, attachments)
        self._sequence = 0
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
            raise self._failed(error) from error

    def _start(self, meta: Mapping[str, str], attachments: Sequence[Attachment]) -> None:
        self._mcap = Writer(
            cast(BinaryIO, self._output),
            chunk_size=layout.CHUNK_SIZE,
            compression=CompressionType.ZSTD,
            enable_crcs=True,
            enable_data_crcs=True,
        )
        self._index.take_over(self._mcap)
        self._mcap.start(library="hapticbridge")
        self._mcap.add_metadata(layout.METADATA_NAME, dict(meta))
        for item in attachments:
            self._mcap.add_attachment(
                self._epoch, self._epoch, item.name, item.media_type, item.data
            )
        tick_schema = self._mcap.register_schema(
            layout.TICK_SCHEMA_NAME, layout.TICK_SCHEMA_ENCODING, layout.tick_schema()
        )
        event_schema = self._mcap.register_schema(
            layout.EVENT_SCHEMA_NAME, layout.EVENT_SCHEMA_ENCODING, layout.EVENT_SCHEMA
        )
        self._ticks = self._mcap.register_channel(
            layout.TICK_TOPIC, layout.TICK_ENCODING, tick_schema
        )
        self._events = self._mcap.register_channel(
            layout.EVENT_TOPIC, layout.EVENT_ENCODING, event_schema
        )

    @property
    def is_full(self) -> bool:
        """True if the disk is full; the rest goes into the reserve."""
        return self._output.is_full

    def write_ticks(self, rows: NDArray[np.void]) -> None:
        """Appends records, shape (n,), ``TICK_DTYPE``.

        Raises:
            RecordingError: The file cannot be written; it ends with its last whole chunk.
        """
        payloads = np.empty(rows.size, layout.PAYLOAD_DTYPE)
        payloads["cdr"] = np.void(layout.CDR_HEADER)
        payloads["record"] = rows
        packed, size = payloads.tobytes(), layout.PAYLOAD_DTYPE.itemsize
        # an impossible deadline (before 1970, after 2554) must not stop the recorder
        times = (rows["deadline_ns"].astype(np.uint64) + np.uint64(self._epoch % 2**64)).tolist()
        self._digest.add_ticks(rows)
        try:
            for index, time in enumerate(times):
                self._mcap.add_message(
                    self._ticks,
                    time,
                    packed[index * size : (index + 1) * size],
                    time,
                    (self._sequence + index) & 0xFFFFFFFF,
                )
        except OSError as error:
            raise self._failed(error) from error
        self._sequence += len(times)

    def write_event(self, event: Mapping[str, object], time_ns: int) -> None:
        """Appends an event.

        ``event["event"]`` is its name; ``time_ns`` counts from the start of the run.

        Raises:
            RecordingError: The file cannot be written; it ends with its last whole chunk.
        """
        payload = layout.event_payload(event, time_ns)
        time = (self._epoch + int(time_ns)) % 2**64
        self._digest.add_event(payload)
        try:
            self._mcap.add_message(self._events, time, payload, time)
        except OSError as error:
            raise self._failed(error) from error

    def close(self) -> None:
        """Finishes the file with last chunk, digest and index, and syncs it to the disk.

        Raises:
            RecordingError: The file cannot be written; it ends with its last whole chunk.
        """
        if self._is_closed:
            return
        self._is_closed = True
        try:
            self._mcap.flush()  # type: ignore[no-untyped-call]
            digest = {layout.DIGEST_KEY: self._digest.hexdigest()}
            self._mcap.add_metadata(layout.DIGEST_NAME, digest)
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
        reason = error.strerror or str(error)
        if error.errno == errno.ENOENT:
            reason = f"the folder {self.path.parent} does not exist"
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
        try:
            text.encode()
        except UnicodeEncodeError as error:
            raise RecordingError(
                f"metadata of a recording must be valid Unicode, not {text!r}"
            ) from error
    if twice := {name for name in names if names.count(name) > 1}:
        raise RecordingError(f"two attachments are named {sorted(twice)[0]!r}")
