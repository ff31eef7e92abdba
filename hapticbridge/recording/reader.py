"""Reads a recording, whole, cut or damaged.

Reading is vectorised: a run of messages on ``/tick`` inside a chunk is one structured view, so
ten minutes at 1 kHz (600 000 records) take about a second.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from hapticbridge.errors import RecordingError
from hapticbridge.recording import format as layout
from hapticbridge.recording.container import MAGIC, Block, Container, DamageError, Fields
from hapticbridge.recording.format import Attachment
from hapticbridge.tick import TICK_DTYPE

_MESSAGE_DTYPE = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<u8"),
        ("publish_time", "<u8"),
        ("payload", layout.PAYLOAD_DTYPE),
    ]
)
_RECORD_HEAD = 9
_MESSAGE_HEAD = _MESSAGE_DTYPE.fields["payload"][1]  # type: ignore[index]
_TICK_LENGTH = _MESSAGE_DTYPE.itemsize - _RECORD_HEAD
_CDR = int.from_bytes(layout.CDR_HEADER, "little")


@dataclass(frozen=True)
class Recording:
    """What a recording holds.

    Attributes:
        path: The file.
        ticks: Its records in order, shape (n,), ``TICK_DTYPE``.
        events: Its events in order; each has ``event`` and ``time_ns`` (since the run's start).
        meta: Metadata as text; empty if it was damaged.
        attachments: Attached files by name.
        is_cut: The end of the file is missing (recorder or machine died); everything up to the
            last whole chunk is here.
        digest: The SHA-256 that was written at the end, or None.
        computed_digest: The same, computed from what was read.
        problems: What is damaged, one sentence each; empty for an undamaged file, also a cut one.
            The comparison of the two digests is left to the reader's user.
    """

    path: Path
    ticks: NDArray[np.void]
    events: list[dict[str, Any]]
    meta: dict[str, str]
    attachments: dict[str, bytes]
    is_cut: bool
    digest: str | None
    computed_digest: str
    problems: tuple[str, ...]


@dataclass
class _Contents:
    """Gathers what the blocks hold."""

    problems: list[str]
    runs: list[NDArray[np.void]] = field(default_factory=list)
    events: list[tuple[bytes, dict[str, Any]]] = field(default_factory=list)
    attachments: list[Attachment] = field(default_factory=list)
    meta: dict[str, str] | None = None
    digest: str | None = None
    schemas: dict[int, tuple[str, str, bytes]] = field(default_factory=dict)
    topics: dict[int, str] = field(default_factory=dict)
    refusal: str | None = None

    def add_metadata(self, fields: Fields) -> None:
        name, entries = fields.text(), fields.mapping()
        if name == layout.METADATA_NAME:
            if self.meta is not None:
                raise DamageError(f"there is a second metadata record '{name}'")
            self.meta = entries
        elif name == layout.DIGEST_NAME:
            if self.digest is not None:
                raise DamageError(f"there is a second metadata record '{name}'")
            self.digest = entries.get(layout.DIGEST_KEY, "")

    def add_attachment(self, fields: Fields) -> None:
        fields.raw(16)
        name, media_type = fields.text(), fields.text()
        data = fields.raw(fields.number(8))
        if any(name == attachment.name for attachment in self.attachments):
            raise DamageError(f"there is a second attachment '{name}'")
        self.attachments.append(Attachment(name, media_type, data))

    def add_block(self, block: Block) -> None:
        data, position = block.data, 0
        while position < len(data):
            body = position + _RECORD_HEAD
            stop = body + int.from_bytes(data[position + 1 : body], "little")
            if stop > len(data) or body > len(data):
                self.problems.append(f"{block.label} ends inside a record")
                return
            fields = Fields(data, body, stop)
            try:
                if data[position] == Opcode.MESSAGE:
                    channel = fields.number(2)
                    topic = self.topics.get(channel)
                    if topic == layout.TICK_TOPIC:
                        stop = self._add_ticks(data, position, channel)
                    elif topic == layout.EVENT_TOPIC:
                        fields.raw(20)
                        self._add_event(data[position + _MESSAGE_HEAD : stop])
                elif data[position] == Opcode.SCHEMA:
                    self._add_schema(fields)
                elif data[position] == Opcode.CHANNEL:
                    self._add_channel(fields)
            except DamageError as error:
                self.problems.append(f"{block.label} holds a damaged record: {error}")
            position = stop

    def _add_schema(self, fields: Fields) -> None:
        schema_id = fields.number(2)
        name, encoding = fields.text(), fields.text()
        self.schemas[schema_id] = (name, encoding, fields.raw(fields.number(4)))

    def _add_channel(self, fields: Fields) -> None:
        channel, schema_id = fields.number(2), fields.number(2)
        topic, encoding = fields.text(), fields.text()
        if topic == layout.EVENT_TOPIC and encoding == layout.EVENT_ENCODING:
            self.topics[channel] = topic
        if topic == layout.TICK_TOPIC and channel not in self.topics:
            name, schema_encoding, text = self.schemas.get(schema_id, ("", "", b""))
            if (name, schema_encoding) != (layout.TICK_SCHEMA_NAME, layout.TICK_SCHEMA_ENCODING):
                self.refusal = (
                    f"its topic {topic} has the schema '{name}', not '{layout.TICK_SCHEMA_NAME}'"
                )
            elif text != layout.tick_schema() or encoding != layout.TICK_ENCODING:
                self.refusal = (
                    f"its schema {name} has other fields than this version of hapticbridge writes"
                )
            else:
                self.topics[channel] = topic

    def _add_ticks(self, data: bytes, position: int, channel: int) -> int:
        """Adds the run of records that starts here; returns where it ends."""
        size, count = _MESSAGE_DTYPE.itemsize, 16
        start = position
        while True:
            count = min(count, (len(data) - position) // size)
            rows = np.frombuffer(data, _MESSAGE_DTYPE, count, position)
            matches = (
                (rows["opcode"] == Opcode.MESSAGE)
                & (rows["length"] == _TICK_LENGTH)
                & (rows["channel"] == channel)
                & (rows["payload"]["cdr"].view("<u4") == _CDR)
            )
            run = count if matches.all() else int(matches.argmin())
            self.runs.append(rows["payload"]["record"][:run])
            position += run * size
            if run < count or count == 0:
                break
            count *= 2  # small windows first: events may sit between every few records
        if position == start:
            raise DamageError(f"a message on {layout.TICK_TOPIC} is not one record")
        return position

    def _add_event(self, payload: bytes) -> None:
        try:
            event = json.loads(payload)
        except (ValueError, RecursionError) as error:
            raise DamageError("an event is not JSON") from error
        if not isinstance(event, dict):
            raise DamageError("an event is not a JSON object")
        self.events.append((payload, event))

    def ticks(self) -> NDArray[np.void]:
        gathered = np.empty(sum(run.size for run in self.runs), TICK_DTYPE)
        position = 0
        for run in self.runs:
            gathered[position : position + run.size] = run
            position += run.size
        return gathered


def read_recording(path: str | Path) -> Recording:
    """Reads a recording.

    A file that was cut is read up to its last whole chunk. Damage is reported in ``problems``,
    and what can be read around it is kept.

    Args:
        path: The file.

    Returns:
        What it holds.

    Raises:
        RecordingError: There is no such file, it cannot be read, or it is not a recording of
            this version.
    """
    return read_with_attachments(Path(path))[0]


def read_with_attachments(path: Path) -> tuple[Recording, list[Attachment]]:
    """As ``read_recording``, with the attachments as they stand in the file, in their order."""
    container = Container(_load(path))
    contents = _Contents(container.problems)
    contents.add_block(container.summary())
    for item in container.records():
        if isinstance(item, Block):
            contents.add_block(item)
            continue
        opcode, fields = item
        add = contents.add_metadata if opcode == Opcode.METADATA else contents.add_attachment
        try:
            add(fields)
        except DamageError as error:
            kind = "a metadata record" if opcode == Opcode.METADATA else "an attachment"
            contents.problems.append(f"{kind} is damaged: {error}")
    if layout.TICK_TOPIC not in contents.topics.values():
        # a file that was cut inside its first chunk has no schema yet, but says what it is
        if contents.refusal or contents.meta is None or not container.is_cut:
            reason = contents.refusal or f"it has no topic {layout.TICK_TOPIC}"
            raise RecordingError(f"{path} is not a recording that can be read: {reason}")
    elif contents.meta is None:
        contents.problems.append(f"the metadata record '{layout.METADATA_NAME}' is missing")
    meta, ticks = contents.meta or {}, contents.ticks()
    digest = layout.Digest(meta, contents.attachments)
    digest.add_ticks(ticks)
    for payload, _ in contents.events:
        digest.add_event(payload)
    recording = Recording(
        path=path,
        ticks=ticks,
        events=[event for _, event in contents.events],
        meta=meta,
        attachments={item.name: item.data for item in contents.attachments},
        is_cut=container.is_cut,
        digest=contents.digest,
        computed_digest=digest.hexdigest(),
        problems=tuple(dict.fromkeys(contents.problems)),
    )
    return recording, contents.attachments


def _load(path: Path) -> bytes:
    try:
        if path.exists() and not path.is_file():
            kind = "a folder" if path.is_dir() else "not a regular file"
            raise RecordingError(f"cannot read the recording {path}: it is {kind}")
        data = path.read_bytes()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise RecordingError(f"cannot read the recording {path}: {reason}") from error
    if not data.startswith(MAGIC):
        what = "it is empty" if not data else "it does not start with the MCAP magic"
        raise RecordingError(f"{path} is not an MCAP file: {what}")
    return data
