"""Recording format: names, schemas and payloads.

A recording is an MCAP file (https://mcap.dev/spec), zstd, chunks of 128 kB:

- The metadata record ``hapticbridge`` and the attachments come before any chunk, so that a cut file
still has them.
- Topic ``/tick``, encoding ``cdr``, schema ``hapticbridge/msg/Tick`` (``ros2msg``): 4 header bytes
and one packed ``TICK_DTYPE`` record. Every field is 8 bytes wide, so CDR adds no padding. Files of
earlier versions may lack ``LATER_FIELDS``.
- Topic ``/event``, encoding ``json``: one object per event, with ``event`` (its name) and
``time_ns`` (since the start of the run).
- The metadata record ``hapticbridge.digest`` comes last (see ``seal``).

The log time of a message is ``epoch_ns`` (in the metadata: Unix time of the run's start) plus the
tick's ``deadline_ns`` or the event's ``time_ns``.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hapticbridge.record import LATER_FIELDS, TICK_DTYPE

TICK_TOPIC = "/tick"
EVENT_TOPIC = "/event"
TICK_ENCODING = "cdr"
EVENT_ENCODING = "json"
TICK_SCHEMA_NAME = "hapticbridge/msg/Tick"
TICK_SCHEMA_ENCODING = "ros2msg"
EVENT_SCHEMA_NAME = "hapticbridge.Event"
EVENT_SCHEMA_ENCODING = "jsonschema"
EVENT_SCHEMA = (
    b'{"type": "object", "properties": {"event": {"type": "string"}, '
    b'"time_ns": {"type": "integer"}}, "required": ["event", "time_ns"]}'
)

METADATA_NAME = "hapticbridge"
DIGEST_NAME = "hapticbridge.digest"
EPOCH_KEY = "epoch_ns"

CHUNK_SIZE = 128 * 1024
"""Uncompressed size in bytes at which a chunk is finished: 0.3 s of ticks at 1 kHz. It is the
largest loss if the recorder is killed."""

CDR_HEADER = b"\x00\x01\x00\x00"
"""Header of little-endian CDR without options; the record after it starts at alignment 0."""

_ROS_TYPES = {"<i8": "int64", "<f8": "float64"}


@dataclass(frozen=True)
class Attachment:
    """A file carried inside the recording.

    Attributes:
        name: Name, unique in the recording.
        media_type: MIME type.
        data: Content.
    """

    name: str
    media_type: str
    data: bytes


def payload_dtype(record: np.dtype[np.void]) -> np.dtype[np.void]:
    """Returns the payload of a message on ``/tick`` that holds one record."""
    return np.dtype([("cdr", "V4"), ("record", record)])


def tick_schema(record: np.dtype[np.void] = TICK_DTYPE) -> bytes:
    """Returns the ROS 2 message definition of a record, one field per line."""
    lines = []
    for name in record.names or ():
        field = record[name]
        suffix = f"[{field.shape[0]}]" if field.shape else ""
        lines.append(f"{_ROS_TYPES[field.base.str]}{suffix} {name}\n")
    return "".join(lines).encode()


def record_dtype(schema: bytes) -> np.dtype[np.void] | None:
    """Returns the record that a schema of this or an earlier version describes, or None."""
    lines = schema.decode(errors="replace").splitlines()
    described = {line.rpartition(" ")[2] for line in lines}
    lacking = [name for name in LATER_FIELDS if name not in described]
    names = [name for name in TICK_DTYPE.names or () if name not in lacking]
    record = np.dtype([(name, TICK_DTYPE[name]) for name in names])
    return record if tick_schema(record) == schema else None


def event_payload(event: Mapping[str, object], time_ns: int) -> bytes:
    """Returns the JSON of an event.

    Values that JSON cannot hold become text (``"nan"``, ``"inf"``, the ``str`` of an unknown
    object) instead of an error. The event of a trip is about such a number and must arrive.
    ``time_ns`` counts from the start of the run.
    """
    plain = _plain({**event, "time_ns": int(time_ns)})
    return json.dumps(plain, separators=(",", ":"), allow_nan=False).encode()


def _plain(value: object) -> object:
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else str(value)
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    return str(value)
