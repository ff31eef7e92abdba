"""Recording format: names, schemas and payloads.

A recording is an MCAP file (https://mcap.dev/spec), zstd, chunks of 128 kB:

- The metadata record ``hapticbridge`` and the attachments come before any chunk, so that a cut file
still has them.
- Topic ``/tick``, encoding ``cdr``, schema ``hapticbridge/msg/Tick`` (``ros2msg``): 4 header bytes
and one packed ``TICK_DTYPE`` record. Every field is 8 bytes wide, so CDR adds no padding.
- Topics ``/tick_2``, ``/tick_3`` … with equal schema: the records of further hands, if several hold
the scene. The metadata ``hands`` hold what differs from the first hand's (``further_hands``).
- Topic ``/event``, encoding ``cdr``, schema ``std_msgs/msg/String``: one JSON object per event,
with ``event`` (its name) and ``time_ns`` (since the start of the run).
- Topics with types of ROS 2 for other programs, which follow from the above (``ros_messages``).

The log time of a message is ``epoch_ns`` (in the metadata: Unix time of the run's start) plus the
tick's ``deadline_ns`` or the event's ``time_ns``.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hapticbridge.errors import RecordingError
from hapticbridge.files import read_json
from hapticbridge.kernel.record import FORMAT, TICK_DTYPE, columns_of

TICK_TOPIC = "/tick"
EVENT_TOPIC = "/event"
SHOWN_EVENT = "shown"  # the poses that another program has shown since the last one
TICK_ENCODING = "cdr"
EVENT_SCHEMA_NAME = "std_msgs/msg/String"
EVENT_SCHEMA = b"string data # the event and what belongs to it, as JSON\n"
TICK_SCHEMA_NAME = "hapticbridge/msg/Tick"
TICK_SCHEMA_ENCODING = "ros2msg"
PROFILE = "ros2"
"""Profile of the file, by which readers of ROS 2 know it."""

METADATA_NAME = "hapticbridge"
EPOCH_KEY = "epoch_ns"


def epoch_of(meta: Mapping[str, str]) -> int:
    """Returns the Unix time of a run's start in ns; 0 if the metadata lack or spoil it."""
    text = meta.get(EPOCH_KEY, "")
    return int(text) if text.isascii() and text.isdigit() and len(text) < 20 else 0


FORMAT_KEY = "format"


def refuse_format(path: Path, meta: Mapping[str, str]) -> None:
    """Refuses a recording of another format.

    Raises:
        RecordingError: The metadata name another format, or none.
    """
    version = meta.get(FORMAT_KEY, "unknown")
    if version != FORMAT:
        raise RecordingError(
            f"{path} has the recording format {version!r:.20}; this version of hapticbridge reads "
            f"format '{FORMAT}': record the run again"
        )


HANDS_KEY = "hands"

MAX_HANDS = 8
"""Largest number of hands in one scene. A larger one would let a foreign file name any number of
topics."""


def further_hands(meta: Mapping[str, str]) -> list[dict[str, str]]:
    """Returns the metadata of each hand beyond the first that differ from the first one's.

    Raises:
        RecordingError: They are not a list of texts by name, or of too many hands.
    """
    try:
        hands = read_json(meta.get(HANDS_KEY, "[]"))
    except ValueError:
        hands = None
    is_list = isinstance(hands, list) and len(hands) < MAX_HANDS
    if not is_list or not all(
        isinstance(each, dict) and all(isinstance(value, str) for value in each.values())
        for each in hands
    ):
        raise RecordingError(
            f"metadata '{HANDS_KEY}' are not texts by name for at most {MAX_HANDS} hands"
        )
    return list(hands)


def tick_topic(hand: int) -> str:
    """Returns the topic with the records of a hand, from 0."""
    return TICK_TOPIC if hand == 0 else f"{TICK_TOPIC}_{hand + 1}"


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


def tick_schema() -> bytes:
    """Returns the ROS 2 message definition of a record: a field per line, its unit as a comment."""
    units: dict[str, list[str]] = {}
    for column in columns_of(TICK_DTYPE):
        units.setdefault(column.field, []).append(column.unit)
    lines = []
    for name in TICK_DTYPE.names or ():
        field = TICK_DTYPE[name]
        suffix = f"[{field.shape[0]}]" if field.shape else ""
        unit = ", ".join(dict.fromkeys(units[name]))
        comment = f" # {unit}" if unit != "1" else ""
        lines.append(f"{_ROS_TYPES[field.base.str]}{suffix} {name}{comment}\n")
    return "".join(lines).encode()


def is_tick_schema(schema: bytes) -> bool:
    """Returns True if a schema describes ``TICK_DTYPE``."""
    return without_comments(schema) == without_comments(tick_schema())


def without_comments(schema: bytes) -> list[str]:
    """Returns the lines of a schema without units, which other programs may leave out."""
    lines = schema.decode(errors="replace").splitlines()
    return [line.partition("#")[0].rstrip() for line in lines]


def event_payload(event: Mapping[str, object], time_ns: int) -> bytes:
    """Returns the JSON of an event.

    Values that JSON cannot hold become text (``"nan"``, ``"inf"``, the ``str`` of an unknown
    object) instead of an error. The event of a trip is about such a number and must arrive.
    ``time_ns`` counts from the start of the run.
    """
    plain = _plain({**event, "time_ns": int(time_ns)})
    return json.dumps(plain, separators=(",", ":"), allow_nan=False).encode()


def cdr_text(payload: bytes) -> bytes:
    """Returns a ``std_msgs/String`` in CDR: its length with the final zero, then its bytes."""
    return CDR_HEADER + (len(payload) + 1).to_bytes(4, "little") + payload + b"\0"


def event_of(data: bytes) -> bytes:
    """Returns the JSON in a message on ``/event``; inverse of ``cdr_text``.

    Raises:
        ValueError: It is no such message.
    """
    payload = data[len(CDR_HEADER) + 4 : -1]
    if data != cdr_text(payload):
        raise ValueError("not one text in CDR")
    return payload


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
