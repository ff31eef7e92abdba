"""Reads a recording, whole, cut or damaged; all at once, or its ticks block by block.

Reading is vectorised: a run of messages on ``/tick`` inside a chunk is one structured view, so
ten minutes at 1 kHz (600 000 records) take about a second.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from hapticbridge.errors import RecordingError
from hapticbridge.recording import format as layout
from hapticbridge.recording.container import MAGIC, Block, Container
from hapticbridge.recording.contents import Contents
from hapticbridge.recording.fields import DamageError, Fields
from hapticbridge.recording.file_bytes import FileBytes
from hapticbridge.recording.format import Attachment
from hapticbridge.tick import TICK_DTYPE

BLOCK = 1 << 14
"""Records that are read at once where a recording is not read whole: 16 s at 1 kHz, 6.5 MB. Larger
blocks take more memory, smaller ones more time."""


@dataclass(frozen=True, kw_only=True)
class RecordingFile:
    """What a recording holds beside its ticks, which are read from the file when asked for.

    Attributes:
        path: The file.
        count: How many records it holds.
        last_tick: Number of the last record's tick; -1 without records.
        flags: All flags that any record has.
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
    count: int
    last_tick: int
    flags: int
    events: list[dict[str, Any]] = field(repr=False)
    meta: dict[str, str]
    attachments: dict[str, bytes] = field(repr=False)  # megabytes
    is_cut: bool
    digest: str | None
    computed_digest: str
    problems: tuple[str, ...]

    def blocks(self, size: int | None = None) -> Iterator[NDArray[np.void]]:
        """Yields the records in order, ``TICK_DTYPE``, in blocks of one size; the last is shorter.

        A block is the caller's to keep.

        Args:
            size: Records, >= 1; ``BLOCK`` by default.

        Raises:
            RecordingError: The file cannot be read, or is not what it was when it was opened.
        """
        size = size or BLOCK
        runs: list[NDArray[np.void]] = []
        found = 0
        for _ in _passes(self.path, runs.append):
            while sum(run.size for run in runs) >= size:
                block, runs[:] = _cut(runs, size)
                found += size
                yield block
        if runs:
            found += sum(run.size for run in runs)
            yield _joined(runs)
        if found != self.count:
            raise RecordingError(f"the recording {self.path} was changed while it was read")


@dataclass(frozen=True, kw_only=True)
class Recording(RecordingFile):
    """What a recording holds, all of it in memory.

    Attributes:
        ticks: Its records in order, shape (n,), ``TICK_DTYPE``.
    """

    ticks: NDArray[np.void]


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


def open_recording(path: str | Path) -> RecordingFile:
    """As ``read_recording``, but for the ticks: memory does not grow with the recording's length.

    The file is read through once, for its digest, its events and what is damaged. Events are kept;
    a run with an input in every tick has as many of them.

    Raises:
        RecordingError: As for ``read_recording``.
    """
    facts, _ = _described(Path(path), [])
    return RecordingFile(**facts)


def read_with_attachments(path: Path) -> tuple[Recording, list[Attachment]]:
    """As ``read_recording``, with the attachments as they stand in the file, in their order."""
    runs: list[NDArray[np.void]] = []
    facts, attachments = _described(path, runs, keeps=True)
    return Recording(**facts, ticks=_joined(runs)), attachments


def _described(
    path: Path, runs: list[NDArray[np.void]], *, keeps: bool = False
) -> tuple[dict[str, Any], list[Attachment]]:
    """Reads a file through; returns the fields of ``RecordingFile``, and the attachments.

    Args:
        path: The file.
        runs: Gets the records, run by run.
        keeps: Whether it does.
    """
    digest = layout.Digest()
    count, last, flags = 0, -1, 0

    def take(run: NDArray[np.void]) -> None:
        nonlocal count, last, flags
        digest.add_ticks(run)
        count += run.size
        last = int(run["tick"][-1]) if run.size else last
        flags |= int(np.bitwise_or.reduce(run["flags"]))
        if keeps:
            runs.append(run)

    *_, (container, contents) = _passes(path, take)
    if not contents.has_ticks:
        # a file that was cut inside its first chunk has no schema yet, but says what it is
        if contents.refusal or contents.meta is None or not container.is_cut:
            reason = contents.refusal or f"it has no topic {layout.TICK_TOPIC}"
            raise RecordingError(f"{path} is not a recording that can be read: {reason}")
    elif contents.meta is None:
        contents.problems.append(f"the metadata record '{layout.METADATA_NAME}' is missing")
    meta = contents.meta or {}
    digest.describe(meta, contents.attachments)
    for payload, _ in contents.events:
        digest.add_event(payload)
    facts = {
        "path": path,
        "count": count,
        "last_tick": last,
        "flags": flags,
        "events": [event for _, event in contents.events],
        "meta": meta,
        "attachments": {item.name: item.data for item in contents.attachments},
        "is_cut": container.is_cut,
        "digest": contents.digest,
        "computed_digest": digest.hexdigest(),
        "problems": tuple(dict.fromkeys(contents.problems)),
    }
    return facts, contents.attachments


def _passes(
    path: Path, take: Callable[[NDArray[np.void]], None]
) -> Iterator[tuple[Container, Contents]]:
    """Reads a file through, and yields the same two after every part of it."""
    with FileBytes(path) as data:
        if data[: len(MAGIC)] != MAGIC:
            what = "it is empty" if not len(data) else "it does not start with the MCAP magic"
            raise RecordingError(f"{path} is not an MCAP file: {what}")
        container = Container(data)
        contents = Contents(container.problems, take)
        contents.add_block(container.summary())
        for item in container.records():
            if isinstance(item, Block):
                contents.add_block(item)
            else:
                _add_described(contents, *item)
            yield container, contents
        yield container, contents


def _add_described(contents: Contents, opcode: int, fields: Fields) -> None:
    is_meta = opcode == Opcode.METADATA
    try:
        (contents.add_metadata if is_meta else contents.add_attachment)(fields)
    except DamageError as error:
        kind = "a metadata record" if is_meta else "an attachment"
        contents.problems.append(f"{kind} is damaged: {error}")


def _joined(runs: list[NDArray[np.void]]) -> NDArray[np.void]:
    """Returns runs as one array; the list is emptied, so that memory never holds both."""
    gathered = np.empty(sum(run.size for run in runs), TICK_DTYPE)
    stop = gathered.size
    while runs:
        run = runs.pop()
        gathered[stop - run.size : stop] = run
        stop -= run.size
    return gathered


def _cut(
    runs: list[NDArray[np.void]], size: int
) -> tuple[NDArray[np.void], list[NDArray[np.void]]]:
    """Returns the first ``size`` records of runs as one array, and the runs that are left."""
    left, head = size, []
    for index, run in enumerate(runs):
        head.append(run[:left])
        left -= head[-1].size
        if not left:
            rest = [run[head[-1].size :], *runs[index + 1 :]]
            return _joined(head), [each for each in rest if each.size]
    raise AssertionError("fewer records than asked for")
