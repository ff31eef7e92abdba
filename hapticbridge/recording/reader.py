"""Reader of recordings, whole, cut or damaged."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from hapticbridge.errors import RecordingError, choices
from hapticbridge.files import foreign_kind, import_extra, read_json
from hapticbridge.kernel.record import FLAG_LEGEND, SECONDS, TICK_DTYPE, TableColumns
from hapticbridge.recording import format as layout
from hapticbridge.recording import ros_messages
from hapticbridge.recording.container import MAGIC, Block, Container, DamageError, Fields, FileBytes
from hapticbridge.recording.format import Attachment
from hapticbridge.units import facts_html

# Metadata, attachments, events and ticks of a container

_HEAD_DTYPE = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<u8"),
        ("publish_time", "<u8"),
    ]
)
_RECORD = struct.Struct("<BQ")
_RECORD_HEAD = _RECORD.size
_MESSAGE_HEAD = _HEAD_DTYPE.itemsize
_CDR = int.from_bytes(layout.CDR_HEADER, "little")


Take = Callable[[NDArray[np.void], int], None]

_HANDS = {layout.tick_topic(hand): hand for hand in range(layout.MAX_HANDS)}


@dataclass
class Contents:
    """Contents collected from a container's blocks.

    Attributes:
        problems: Damage, one sentence each; appended to.
        take: Called with each run of records of a hand, in order, and the hand's number.
        events: JSON object of each event.
        attachments: Attachments in order.
        meta: The metadata; None before they are read.
        meta_ahead: The metadata, read before all else to derive the messages for ROS 2.
        refusal: Reason why the records cannot be read; None if they can.
        keeps_events: True to parse events, and to compare the messages for ROS 2.
        has_messages: True if there are such messages.
        other_schemas: Topics of the messages for ROS 2 with another schema, as sentences. In a
            recording this is damage, in a bag of another program it is not.
    """

    problems: list[str]
    take: Take
    events: list[dict[str, Any]] = field(default_factory=list)
    attachments: list[Attachment] = field(default_factory=list)
    meta: dict[str, str] | None = None
    meta_ahead: dict[str, str] | None = None
    refusal: str | None = None
    keeps_events: bool = True
    has_messages: bool = False
    other_schemas: list[str] = field(default_factory=list)
    _written: ros_messages.Checksums = field(default_factory=ros_messages.Checksums)
    _derived: ros_messages.Checksums = field(default_factory=ros_messages.Checksums)
    _messages: ros_messages.Messages | None = None
    _schemas: dict[int, tuple[str, str, bytes]] = field(default_factory=dict)
    _topics: dict[int, str] = field(default_factory=dict)
    _hands: dict[int, int] = field(default_factory=dict)
    _names: set[str] = field(default_factory=set)

    @property
    def has_ticks(self) -> bool:
        """True if there is a channel of records that can be read."""
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

    def add_attachment(self, fields: Fields) -> None:
        """Adds an attachment.

        Raises:
            DamageError: Its name occurs twice, or it is shorter than its fields.
        """
        fields.raw(16)
        name, media_type = fields.text(), fields.text()
        data = fields.raw(fields.number(8))
        if name in self._names:
            raise DamageError(f"there is a second attachment '{name}'")
        self._names.add(name)
        self.attachments.append(Attachment(name, media_type, data))

    def add_block(self, block: Block) -> None:
        """Adds the records of a block."""
        data, position, end = block.data, 0, len(block.data)
        topics, head = self._topics, _RECORD.unpack_from
        while position < end:
            body = position + _RECORD_HEAD
            opcode, size = head(data, position) if body <= end else (0, 0)
            stop = body + size
            if stop > end:
                self.problems.append(f"{block.label} ends inside a record")
                return
            try:
                if opcode == Opcode.MESSAGE:
                    channel = int.from_bytes(data[body : body + 2], "little")
                    topic = topics.get(channel, "")
                    if channel in self._hands:
                        stop = self._add_ticks(data, position, channel)
                    elif topic and self.keeps_events:
                        payload = data[position + _MESSAGE_HEAD : stop]
                        if topic == layout.EVENT_TOPIC:
                            self._add_event(payload)
                        else:
                            time = int.from_bytes(data[body + 6 : body + 14], "little")
                            self._written.add(topic, time, payload)
                elif opcode == Opcode.SCHEMA:
                    self._add_schema(Fields(data, body, stop))
                elif opcode == Opcode.CHANNEL:
                    self._add_channel(Fields(data, body, stop))
                else:
                    # a chunk holds no others; a reader must not walk through millions of them
                    self.problems.append(f"{block.label} holds a record of kind {opcode}")
                    return
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
        name, schema_encoding, text = self._schemas.get(schema_id, ("", "", b""))
        if topic == layout.EVENT_TOPIC and name == layout.EVENT_SCHEMA_NAME:
            self._topics[channel] = topic
        if topic in ros_messages.TOPICS:
            own_name, own_text = ros_messages.TOPICS[topic]
            stored = name, schema_encoding, encoding, layout.without_comments(text)
            own = own_name, layout.TICK_SCHEMA_ENCODING, layout.TICK_ENCODING
            if stored != (*own, layout.without_comments(own_text)):
                words = f"its topic {topic} has another schema than '{own_name}'"
                self.other_schemas.append(words)
                return
            self._topics[channel], self.has_messages = topic, True
        if topic in _HANDS and channel not in self._topics:
            if (name, schema_encoding) != (layout.TICK_SCHEMA_NAME, layout.TICK_SCHEMA_ENCODING):
                self.refusal = (
                    f"its topic {topic} has the schema '{name}', not '{layout.TICK_SCHEMA_NAME}'"
                )
                return
            if not layout.is_tick_schema(text) or encoding != layout.TICK_ENCODING:
                self.refusal = (
                    f"its schema {name} has other fields than this version of hapticbridge reads"
                )
                return
            self._topics[channel] = topic
            self._hands[channel] = _HANDS[topic]

    def _add_ticks(self, data: bytes, position: int, channel: int) -> int:
        """Adds the run of records that starts here; returns its end."""
        message = _message_dtype()
        size, count, hand = message.itemsize, 16, self._hands[channel]
        start = position
        while True:
            count = min(count, (len(data) - position) // size)
            rows = np.frombuffer(data, message, count, position)
            matches = (
                (rows["opcode"] == Opcode.MESSAGE)
                & (rows["length"] == size - _RECORD_HEAD)
                & (rows["channel"] == channel)
                & (rows["payload"]["cdr"].view("<u4") == _CDR)
            )
            run = count if matches.all() else int(matches.argmin())
            self.take(rows["payload"]["record"][:run], hand)
            if hand == 0 and (messages := self._expected()):
                self._derived.add_all(messages.of_ticks(rows["payload"]["record"][:run]))
            position += run * size
            if run < count or count == 0:
                break
            count *= 2  # small windows first: events may sit between every few records
        if position == start:
            raise DamageError(f"a message on {layout.tick_topic(hand)} is not one record")
        return position

    def _add_event(self, message: bytes) -> None:
        try:
            payload = layout.event_of(message)
            event = read_json(payload)
        except ValueError as error:
            raise DamageError("an event is not JSON") from error
        if not isinstance(event, dict):
            raise DamageError("an event is not a JSON object")
        self.events.append(event)
        if messages := self._expected():
            time = event.get("time_ns")
            time = time if isinstance(time, int) else 0
            line = messages.of_event(payload, time, event.get("event"))
            self._derived.add(ros_messages.LOG, *line)

    def _expected(self) -> ros_messages.Messages | None:
        """Returns what derives the messages for ROS 2; None if they are not compared.

        A file without summary may name them behind its ticks and events, so all are derived.
        """
        if not self.keeps_events or self.meta_ahead is None:
            return None
        if self._messages is None:
            axes = ros_messages.axes_of(self.meta_ahead)
            self._messages = ros_messages.Messages(layout.epoch_of(self.meta_ahead), axes)
        return self._messages

    def message_fault(self) -> str:
        """Returns a sentence if the messages for ROS 2 do not follow from the ticks; else empty."""
        if not self.has_messages or self._expected() is None:
            return ""
        if differing := self._written.differing(self._derived):
            return f"what {choices(differing)} say does not follow from the ticks and events"
        return ""


CUT = "the file is cut: its end is missing"
"""Meaning of a file without its end."""

CUTTING_EVENTS = {
    "bridge_died": "the bridge died during the run",
    "recorder_died": "the recorder died during the run; the bridge wrote the file anew",
    "repaired": "the file had lost its end and was repaired",
}
"""Events of a file that lacks the end of its run, with their meaning. No export leaves them out."""


@cache
def _message_dtype() -> np.dtype[np.void]:
    return np.dtype([*_HEAD_DTYPE.descr, ("payload", layout.payload_dtype(TICK_DTYPE))])  # packed


BLOCK = 1 << 14
"""Number of records per block: 16 s at 1 kHz, 6.5 MB. Larger blocks take more memory, smaller ones
more time."""


MAX_KEPT = 1 << 17
"""Largest number of records that an open recording keeps in memory: two minutes at 1 kHz, 53 MB.
The files of longer runs are read once per use."""


class LostMetadata(dict[str, str]):
    """Metadata of a damaged file that lost them: empty, and each entry that is needed is an error.

    Args:
        path: The file.
        problems: Its damage.
    """

    def __init__(self, path: Path, problems: Iterable[str]) -> None:
        super().__init__()
        self._damage = f"{path} is damaged: {'; '.join(problems)}"

    def __missing__(self, name: str) -> str:
        raise RecordingError(self._damage)


@dataclass(frozen=True, kw_only=True)
class RecordingFile:
    """A recording whose ticks are read from the file on request.

    Attributes:
        path: The file.
        count: Number of records.
        last_tick: Number of the last record's tick; -1 without records.
        flags: Union of all records' flags.
        events: Events in order, with ``event`` and ``time_ns`` (since the run's start).
        meta: Metadata as text; ``LostMetadata`` if damaged.
        attachments: Attached files by name.
        is_cut: True if the end of the file is missing because recorder or machine died; everything
            up to the last whole chunk is available.
        problems: Damage, one sentence each; empty for an undamaged file, even a cut one.
        hand: Number of the hand, from 0, whose records and metadata these are.
        hands: Number of hands that held the scene.
        kept: All records if there are at most ``MAX_KEPT``, so that they are read once; else None.
    """

    path: Path
    count: int
    last_tick: int
    flags: int
    events: list[dict[str, Any]] = field(repr=False)
    meta: dict[str, str]
    attachments: dict[str, bytes] = field(repr=False)  # megabytes
    is_cut: bool
    problems: tuple[str, ...] = ()
    hand: int = 0
    hands: int = 1
    kept: NDArray[np.void] | None = field(default=None, repr=False, compare=False)

    @property
    def has_several_hands(self) -> bool:
        """True if several hands hold the scene."""
        return self.hands > 1

    @property
    def period(self) -> float:
        """T in s as the metadata state it; NaN if they are damaged."""
        try:
            return float(self.meta["period_s"])
        except (KeyError, ValueError, RecordingError):
            return math.nan

    @property
    def cut_sentence(self) -> str:
        """Sentence if the run's end is or was missing in the file, else empty."""
        causes = [CUT] if self.is_cut else []
        names = {event.get("event") for event in self.events}
        causes += [words for name, words in CUTTING_EVENTS.items() if name in names]
        return "; ".join(causes)

    @property
    def faults(self) -> str:
        """Damage, and that the run's end is missing, in a line; empty for a whole file."""
        return "; ".join(filter(None, [*self.problems, self.cut_sentence]))

    def blocks(self, size: int | None = None) -> Iterator[NDArray[np.void]]:
        """Yields the records in order, in blocks of equal size (the last: shorter).

        The caller may keep a block, but not write to it. ``size`` is the number of records per
        block, ``BLOCK`` by default.

        Raises:
            RecordingError: The file cannot be read, or has changed since it was opened.
        """
        size = size or BLOCK
        if self.kept is not None:
            yield from (self.kept[start : start + size] for start in range(0, self.count, size))
            return
        runs: list[NDArray[np.void]] = []
        yielded = held = 0

        def take(run: NDArray[np.void], hand: int) -> None:
            nonlocal held
            if hand != self.hand:
                return
            if self.has_several_hands and self.is_cut:  # it may hold more records of one hand
                run = run[: self.count - yielded - held]
            runs.append(run)
            held += run.size  # a sum over all runs in every part would be quadratic

        for _ in _read_parts(self.path, take, keeps_events=False):
            while held >= size:
                block, runs[:] = _split(runs, size)
                yielded, held = yielded + size, held - size
                yield block
        if runs:
            yielded += held
            yield _join(runs)
        if yielded != self.count:
            raise RecordingError(f"the recording {self.path} was changed while it was read")


@dataclass(frozen=True, kw_only=True)
class Recording(RecordingFile):
    """A recording with all ticks in memory.

    Attributes:
        ticks: Records in order, shape (n,).
    """

    ticks: NDArray[np.void]

    def _repr_html_(self) -> str:
        """Returns length, origin and damage as HTML, for a notebook."""
        rows = [(name, self.meta.get(name, "")) for name in ("scene", "grip", "method", "started")]
        rows = [row for row in rows if row[1]]
        period, count = self.period, len(self.ticks)
        time = f"{count * period:.3f} s, " if math.isfinite(period) else ""
        rows.append(("ran", f"{time}{count} ticks"))
        rows.append(("events", str(len(self.events))))
        return facts_html(self.path.name, rows, (*self.problems, self.cut_sentence))

    def to_pandas(self) -> Any:
        """Returns the ticks as a ``pandas.DataFrame`` with the index ``seconds``.

        It has a row per tick and a column per number, as an exported table. ``DataFrame.attrs``
        holds ``units`` by column and ``flags`` by bit.

        Raises:
            RecordingError: pandas is not installed.
        """
        pandas = import_extra("pandas", "a data frame", "tables", RecordingError)
        columns = TableColumns(TICK_DTYPE, self.period)
        values = zip(columns.units, columns.values(self.ticks), strict=True)
        frame = pandas.DataFrame(dict(values)).set_index(SECONDS)
        frame.attrs = {"units": columns.units, "flags": FLAG_LEGEND}
        return frame


def read_recording(path: str | Path, hand: int | None = None) -> Recording:
    """Reads a recording into memory.

    A cut file is read up to its last whole chunk. Damage is listed in ``problems``; readable parts
    around it are kept. Messages of a chunk are read as one structured view, so ten minutes at 1 kHz
    (600 000 records) take about a second.

    Args:
        path: The recording.
        hand: Number of a hand, from 0, whose records are read; None for a run of one hand.

    Raises:
        RecordingError: The file does not exist, cannot be read, is not a recording of this format,
            or is of several hands and none is named.
    """
    return read_with_attachments(Path(path), hand)[0]


def read_hands(path: str | Path) -> tuple[Recording, ...]:
    """Reads a recording once per hand, as ``read_recording`` does; once for a run of one hand.

    Raises:
        RecordingError: As for ``read_recording``.
    """
    first = read_recording(path, 0)
    return first, *(read_recording(path, hand) for hand in range(1, first.hands))


def open_recording(path: str | Path, hand: int | None = None) -> RecordingFile:
    """Opens a recording; its ticks are loaded only if there are few (``MAX_KEPT``).

    The file is read once for its events and damage. Memory use does not grow with the run's length,
    except for its events, which are kept; a run with an input in every tick has one per tick.

    Args:
        path: The recording.
        hand: As for ``read_recording``.

    Raises:
        RecordingError: As for ``read_recording``.
    """
    runs: list[NDArray[np.void]] = []
    facts, _ = _read_through(Path(path), runs, hand, max_kept=MAX_KEPT)
    if facts["count"] > sum(run.size for run in runs):
        return RecordingFile(**facts)
    kept = _join(runs)[: facts["count"]]
    kept.flags.writeable = False
    return RecordingFile(**facts, kept=kept)


def hand_named(path: str | Path, grip: str) -> int:
    """Returns the number of the hand that holds a grip.

    Raises:
        RecordingError: As for ``read_recording``, or no hand holds it.
    """
    grips = [str(each.meta.get("grip")) for each in open_hands(path)]
    if grip not in grips:
        raise RecordingError(f"{path} has no hand at {grip!r:.60}; its hands hold {choices(grips)}")
    return grips.index(grip)


def open_hands(path: str | Path) -> tuple[RecordingFile, ...]:
    """Opens a recording once per hand, as ``open_recording`` does; one file for a run of one hand.

    Raises:
        RecordingError: As for ``read_recording``.
    """
    first = open_recording(path, 0)
    return first, *(open_recording(path, hand) for hand in range(1, first.hands))


def read_with_attachments(
    path: Path, hand: int | None = None
) -> tuple[Recording, list[Attachment]]:
    """Reads a recording, and its attachments in file order."""
    runs: list[NDArray[np.void]] = []
    facts, attachments = _read_through(path, runs, hand)
    ticks = _join(runs)[: facts["count"]]
    return Recording(**facts, ticks=ticks), attachments


def _read_through(
    path: Path, runs: list[NDArray[np.void]], hand: int | None, *, max_kept: float = math.inf
) -> tuple[dict[str, Any], list[Attachment]]:
    """Reads a file; returns the fields of ``RecordingFile``, and the attachments.

    ``runs`` receives the records of the hand unless there are more than ``max_kept``.
    """
    counts, last, flags = [0] * layout.MAX_HANDS, [-1] * layout.MAX_HANDS, 0
    chosen, disorder = hand or 0, ""

    def take(run: NDArray[np.void], hand: int) -> None:
        nonlocal flags, disorder
        counts[hand] += run.size
        numbers = np.concatenate([[last[hand]], run["tick"]])
        if not disorder and (falls := np.flatnonzero(numbers[1:] <= numbers[:-1])).size:
            before, after = numbers[falls[0] : falls[0] + 2]
            disorder = f"its ticks are not in order: tick {before} is followed by tick {after}"
        last[hand] = int(run["tick"][-1]) if run.size else last[hand]
        if hand != chosen:
            return
        flags |= int(np.bitwise_or.reduce(run["flags"]))
        if counts[hand] <= max_kept:
            runs.append(run)
        else:
            runs.clear()

    *_, (container, contents) = _read_parts(path, take)
    if contents.meta is not None:  # before its fields, which another format explains
        layout.refuse_format(path, contents.meta)
    if contents.has_ticks or contents.meta is not None:
        contents.problems.extend(contents.other_schemas)
    if not contents.has_ticks:
        # a file cut inside its first chunk has no schema yet, but has metadata
        if contents.refusal or contents.meta is None or not container.is_cut:
            if contents.meta is not None and contents.problems and not contents.refusal:
                damage = "; ".join(dict.fromkeys(contents.problems))
                raise RecordingError(
                    f"{path} is damaged, and none of its ticks can be read: {damage}"
                )
            lacks = f"it has no topic {layout.TICK_TOPIC}"
            cut = [CUT] if container.is_cut else []
            reason = contents.refusal or "; ".join([lacks, *cut, *contents.problems[:1]])
            raise RecordingError(f"{path} is not a recording that can be read: {reason}")
    elif contents.meta is None:
        contents.problems.append(f"the metadata record '{layout.METADATA_NAME}' is missing")
    meta = contents.meta or {}
    hands = _hands_in(path, meta, hand, contents.problems)
    if any(counts[hands:]) or (not container.is_cut and len(set(counts[:hands])) > 1):
        contents.problems.append("its hands have different numbers of records")
    is_whole = not container.is_cut and not contents.problems
    if is_whole and (fault := contents.message_fault()):
        contents.problems.append(disorder or fault)
    if contents.meta is None and contents.problems:
        meta = LostMetadata(path, dict.fromkeys(contents.problems))
    facts = {
        "path": path,
        "count": min(counts[:hands]),
        "last_tick": min(last[:hands]),
        "flags": flags,
        "events": contents.events,
        "meta": meta | layout.further_hands(meta)[chosen - 1] if chosen else meta,
        "hand": chosen,
        "hands": hands,
        "attachments": {each.name: each.data for each in contents.attachments},
        "is_cut": container.is_cut,
        "problems": tuple(dict.fromkeys(contents.problems)),
    }
    return facts, contents.attachments


def foreign_file(path: Path) -> str:
    """Returns the kind of a bag or packed file, as ``files.foreign_kind``, for who reads runs."""
    kind = foreign_kind(path)
    if kind.startswith("a bag"):
        kind += " as a motion; only what 'hapticbridge run' wrote is a recording"
    return kind


def _hands_in(path: Path, meta: Mapping[str, str], hand: int | None, problems: list[str]) -> int:
    """Returns the number of hands in a file; damaged metadata count as one hand.

    Raises:
        RecordingError: There are several and none is named, or no such hand.
    """
    try:
        others = layout.further_hands(meta)
    except RecordingError as error:
        problems.append(str(error))
        others = []
    count = 1 + len(others)
    if hand is None and others:
        grips = choices([str(each.get("grip")) for each in (meta, *others)])
        raise RecordingError(
            f"{path} is a run of {count} hands ({grips}), and one is needed here: 'hapticbridge "
            "export' takes one with --hand for a table, read_recording(path, hand=0) in Python; "
            "'audit', 'compare', 'view' and 'render' take them together"
        )
    if hand is not None and not 0 <= hand < count:
        raise RecordingError(f"{path} has no hand {hand}; its hands are 0 to {count - 1}")
    return count


def _read_parts(
    path: Path, take: Take, *, keeps_events: bool = True
) -> Iterator[tuple[Container, Contents]]:
    """Reads a file; yields its container and contents after every part."""
    with FileBytes(path) as data:
        if data[: len(MAGIC)] != MAGIC:
            if kind := foreign_file(path):
                raise RecordingError(f"{path} is {kind}")
            what = "it is empty" if not len(data) else "it does not start with the MCAP magic"
            raise RecordingError(f"{path} is not an MCAP file: {what}")
        container = Container(data)
        if reason := container.foreign_compression():
            raise RecordingError(f"{path} cannot be read: {reason}")
        contents = Contents(container.problems, take, keeps_events=keeps_events)
        contents.add_block(container.summary())
        if keeps_events:
            contents.meta_ahead = container.metadata(layout.METADATA_NAME)
        for record in container.records():
            if isinstance(record, Block):
                contents.add_block(record)
            else:
                _add_described(contents, *record)
            yield container, contents
        yield container, contents


def _add_described(contents: Contents, opcode: int, fields: Fields) -> None:
    is_meta = opcode == Opcode.METADATA
    try:
        (contents.add_metadata if is_meta else contents.add_attachment)(fields)
    except DamageError as error:
        kind = "a metadata record" if is_meta else "an attachment"
        contents.problems.append(f"{kind} is damaged: {error}")


def _join(runs: list[NDArray[np.void]]) -> NDArray[np.void]:
    """Joins runs into one array and empties the list, so that memory never holds both."""
    gathered = np.empty(sum(run.size for run in runs), TICK_DTYPE)
    stop = gathered.size
    while runs:
        run = runs.pop()
        gathered[stop - run.size : stop] = run
        stop -= run.size
    return gathered


def _split(
    runs: list[NDArray[np.void]], size: int
) -> tuple[NDArray[np.void], list[NDArray[np.void]]]:
    """Returns the first ``size`` records of runs as one array, and the remaining runs."""
    left, head = size, []
    for index, run in enumerate(runs):
        head.append(run[:left])
        left -= head[-1].size
        if not left:
            rest = [run[head[-1].size :], *runs[index + 1 :]]
            return _join(head), [each for each in rest if each.size]
    raise AssertionError("fewer records than requested")
