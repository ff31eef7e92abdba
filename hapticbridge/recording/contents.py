"""Metadata, attachments, events and ticks of a container."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from hapticbridge.jsonable import read_json
from hapticbridge.recording import format as layout
from hapticbridge.recording.container import Block
from hapticbridge.recording.fields import DamageError, Fields
from hapticbridge.recording.format import Attachment

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


@dataclass
class Contents:
    """Contents collected from a container's blocks.

    Attributes:
        problems: Damage, one sentence each; appended to.
        take: Called with each run of records, ``TICK_DTYPE``, in order.
        events: Payload and JSON object of each event.
        attachments: Attachments in order.
        meta: The metadata; None before they are read.
        digest: Digest stored in the file.
        refusal: Reason why the records are not of this version; None if they are.
    """

    problems: list[str]
    take: Callable[[NDArray[np.void]], None]
    events: list[tuple[bytes, dict[str, Any]]] = field(default_factory=list)
    attachments: list[Attachment] = field(default_factory=list)
    meta: dict[str, str] | None = None
    digest: str | None = None
    refusal: str | None = None
    _schemas: dict[int, tuple[str, str, bytes]] = field(default_factory=dict)
    _topics: dict[int, str] = field(default_factory=dict)

    @property
    def has_ticks(self) -> bool:
        """True if there is a channel of records of this version."""
        return layout.TICK_TOPIC in self._topics.values()

    def add_metadata(self, fields: Fields) -> None:
        """Adds a metadata record.

        Raises:
            DamageError: Its name occurs twice, or it is shorter than its fields.
        """
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
        """Adds an attachment.

        Raises:
            DamageError: Its name occurs twice, or it is shorter than its fields.
        """
        fields.raw(16)
        name, media_type = fields.text(), fields.text()
        data = fields.raw(fields.number(8))
        if any(name == attachment.name for attachment in self.attachments):
            raise DamageError(f"there is a second attachment '{name}'")
        self.attachments.append(Attachment(name, media_type, data))

    def add_block(self, block: Block) -> None:
        """Adds the records of a block."""
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
                    topic = self._topics.get(channel)
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
        self._schemas[schema_id] = (name, encoding, fields.raw(fields.number(4)))

    def _add_channel(self, fields: Fields) -> None:
        channel, schema_id = fields.number(2), fields.number(2)
        topic, encoding = fields.text(), fields.text()
        if topic == layout.EVENT_TOPIC and encoding == layout.EVENT_ENCODING:
            self._topics[channel] = topic
        if topic == layout.TICK_TOPIC and channel not in self._topics:
            name, schema_encoding, text = self._schemas.get(schema_id, ("", "", b""))
            if (name, schema_encoding) != (layout.TICK_SCHEMA_NAME, layout.TICK_SCHEMA_ENCODING):
                self.refusal = (
                    f"its topic {topic} has the schema '{name}', not '{layout.TICK_SCHEMA_NAME}'"
                )
            elif text != layout.tick_schema() or encoding != layout.TICK_ENCODING:
                self.refusal = (
                    f"its schema {name} has other fields than this version of hapticbridge writes"
                )
            else:
                self._topics[channel] = topic

    def _add_ticks(self, data: bytes, position: int, channel: int) -> int:
        """Adds the run of records that starts here; returns its end."""
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
            self.take(rows["payload"]["record"][:run])
            position += run * size
            if run < count or count == 0:
                break
            count *= 2  # small windows first: events may sit between every few records
        if position == start:
            raise DamageError(f"a message on {layout.TICK_TOPIC} is not one record")
        return position

    def _add_event(self, payload: bytes) -> None:
        try:
            event = read_json(payload)
        except ValueError as error:
            raise DamageError("an event is not JSON") from error
        if not isinstance(event, dict):
            raise DamageError("an event is not a JSON object")
        self.events.append((payload, event))
