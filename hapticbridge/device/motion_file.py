"""Motions from files: a table in CSV, a recording, a bag of ROS 2."""

from __future__ import annotations

import codecs
import csv
import math
import os
import re
import stat
import struct
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray
from zstandard import ZstdError

from hapticbridge.arguments import number_from
from hapticbridge.device.base import USUAL_SPEED_LIMIT
from hapticbridge.device.trajectory import (
    ORIENTATION,
    PER_SECOND,
    TIME_AND_POSITION,
    Motion,
    first_fault,
)
from hapticbridge.errors import DeviceError, RecordingError, choices
from hapticbridge.files import foreign_kind
from hapticbridge.kernel.record import TickFlag
from hapticbridge.units import format_count, format_number

# Any of them

_MCAP_MAGIC = b"\x89MCAP0\r\n"
"""First and last bytes of an MCAP file, here without loading the package mcap."""


def motion_in(text: str) -> Motion | Path:
    """Reads the motion of a table, or of a bag as ``FILE:/TOPIC`` or as the folder of one file.

    Returns:
        The motion; the path of a recording, which ``read_recorded`` reads.

    Raises:
        DeviceError: There is none, or it is damaged.
    """
    path, topic = _named_topic(text)
    _refuse_part(text, path)
    if not _is_recording(path):
        _refuse_other_bag(path)
        if topic:
            raise DeviceError(f"{path}: a topic, '{topic}', is of a bag in MCAP, which this is not")
        return read_motion(path)
    return read_bag(path, topic) if topic or _is_bag(path) else path


def _named_topic(text: str) -> tuple[Path, str]:
    """Returns file and topic of ``FILE:/TOPIC``, or a folder's one bag; the topic may be empty."""
    file, colon, topic = text.partition(":/")
    try:
        is_named = bool(colon) and not Path(text).exists() and Path(file).exists()
        path = Path(file if is_named else text)
        bags = sorted(path.glob("*.mcap")) if path.is_dir() else []
    except (OSError, ValueError):  # reading it as a motion then reports the reason
        return Path(text), ""
    return bags[0] if len(bags) == 1 else path, f"/{topic}" if is_named else ""


def _refuse_part(text: str, path: Path) -> None:
    """Refuses the one file that is left of a split bag, if its folder was named.

    Raises:
        DeviceError: It is one.
    """
    folder = path.parent
    if path.suffix != ".mcap" or Path(text.partition(":/")[0]) != folder:
        return
    with suppress(OSError, UnicodeDecodeError):
        described = (folder / "metadata.yaml").read_text(encoding="utf-8")
        listed = set(re.findall(r"^\s*-\s+(\S+\.mcap)\b", described, re.MULTILINE))
        if len(listed) > 1:
            raise DeviceError(
                f"{folder}: its metadata.yaml names {len(listed)} files, and only one is there; "
                f"name '{path.name}' itself to take it alone"
            )


def _refuse_other_bag(path: Path) -> None:
    """Refuses a bag of another kind, and a folder of several bags.

    Raises:
        DeviceError: It is one.
    """
    try:
        files = sorted(path.iterdir()) if path.is_dir() else [path]
    except OSError:  # reading it as a motion then reports the reason
        return
    bags = [file.name for file in files if file.suffix == ".mcap"]
    if len(bags) > 1:
        one = f"name one of {choices(bags[:8])}"
        if (path / "metadata.yaml").is_file():
            one += ", or let 'ros2 bag convert' write the whole bag into one"
        elif all(map(_is_bag, map(path.joinpath, bags[:8]))):
            one += ", or let 'ros2 bag reindex' and 'ros2 bag convert' write the whole bag into one"
        raise DeviceError(f"{path}: a folder of {len(bags)} files; {one}")
    if kind := next(filter(None, map(foreign_kind, files)), ""):
        raise DeviceError(f"{path}: {kind}")


def _is_recording(path: Path) -> bool:
    """Recognises a recording by its first bytes, or by its suffix."""
    if path.suffix == ".mcap":
        return True
    try:
        if not path.is_file():
            return False
        with path.open("rb") as file:
            return file.read(len(_MCAP_MAGIC)) == _MCAP_MAGIC
    except (OSError, ValueError):
        return False  # reading it as a motion then reports the reason


# Table in CSV


def read_motion(path: str | os.PathLike[str]) -> Motion:
    """Reads a motion from a CSV file.

    The first line that is neither empty nor a comment (``#``) names the columns, in any order:
    ``t,x,y,z`` in s and m, and either all or none of ``qw,qx,qy,qz``. Every further line is a row
    of numbers. Times must strictly increase; the rate is free. Semicolons, beside which a number
    may have a decimal comma, or tabs may stand in the place of commas. A table that was exported
    from a recording gives the motion of its device.

    Args:
        path: The file, UTF-8.

    Returns:
        The motion, its times counted from the first row.

    Raises:
        DeviceError: The file cannot be read, or a line is not valid; the message names it.

    Warns:
        UserWarning: Times look like those of another unit.
    """
    path = Path(path)
    lines = _read_lines(path)
    numbered = (
        (number, line)
        for number, line in enumerate(lines, start=1)
        if (content := line.lstrip()) and content[0] != "#"
    )
    header = next(numbered, None)
    if header is None:
        raise DeviceError(f"{path}: the file is empty; it needs a header t,x,y,z and two rows")
    separator = next((each for each in ";,\t" if each in header[1]), ",")
    where = f"{path}, line {header[0]}"
    names = _column_names(where, header[1], _fields(where, header[1], separator))
    width = len(names)
    columns = [names.index(name) for name in TIME_AND_POSITION + ORIENTATION if name in names]
    numbers: list[int] = []
    values: list[float] = []
    for number, line in numbered:
        fields = _fields(f"{path}, line {number}", line, separator)
        if len(fields) != width:
            raise DeviceError(
                f"{path}, line {number}: {len(fields)} fields where the header names "
                f"{width} columns"
            )
        try:
            values.extend([number_from(fields[column]) for column in columns])
        except ValueError:
            column = next(i for i in columns if not _is_number(fields[i]))
            held = fields[column].strip()
            is_clock = names[column] == TIME_AND_POSITION[0] and re.search(r"\d[:-]\d", held)
            what = (
                "a time of day or a date; times are in s from any moment on, such as 0.25"
                if is_clock
                else "which is not a number"
            )
            raise DeviceError(
                f"{path}, line {number}: column '{names[column]}' holds {held!r:.40}, {what}"
            ) from None
        numbers.append(number)
    if len(numbers) < 2:
        last = numbers[-1] if numbers else header[0]
        raise DeviceError(
            f"{path}, line {last}: the file ends after {len(numbers)} of at least "
            "two rows of numbers"
        )
    table = np.empty((len(numbers), 8))
    table[:, 4:] = (1.0, 0.0, 0.0, 0.0)
    table[:, : len(columns)] = np.array(values).reshape(len(numbers), len(columns))
    if fault := first_fault(table):
        raise DeviceError(f"{path}, line {numbers[fault[0]]}: {fault[1]}")
    return _plausible(table, path)


def _fields(where: str, line: str, separator: str) -> list[str]:
    """Returns the fields of a line without their quotes, semicolons' with decimal points.

    Raises:
        DeviceError: A field has more characters than the module csv takes.
    """
    try:
        fields = next(csv.reader([line], delimiter=separator, skipinitialspace=True))
    except csv.Error as error:
        raise DeviceError(f"{where}: cannot be read ({error})") from None
    return [field.replace(",", ".") for field in fields] if separator == ";" else fields


def _read_lines(path: Path) -> list[str]:
    """Reads a text file with any line ending; a byte-order mark is dropped."""
    try:
        mode = path.stat().st_mode
        if not stat.S_ISREG(mode):
            kind = "a directory" if stat.S_ISDIR(mode) else "not a regular file"
            raise DeviceError(f"{path}: is {kind}, not a CSV file")
        # a spreadsheet's "Unicode text" is UTF-16, and begins with its byte-order mark
        with path.open("rb") as file:
            is_wide = file.read(2) in {codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE}
        lines = path.read_text(encoding="utf-16" if is_wide else "utf-8-sig").split("\n")
    except FileNotFoundError:
        raise DeviceError(f"{path}: no such file") from None
    except UnicodeDecodeError as error:
        content = path.read_bytes()
        if content.startswith(_MCAP_MAGIC):
            reader = f"'trajectory:{path}' reads it"
            raise DeviceError(f"{path}: is MCAP and not CSV; {reader}") from None
        line = content[: error.start].count(b"\n") + 1
        kind = "-".join(error.encoding.upper().split("-")[:2])
        raise DeviceError(f"{path}, line {line}: not {kind} text, so not a CSV file") from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise DeviceError(f"{path}: cannot be read ({reason})") from None
    if held := next((number for number, line in enumerate(lines, 1) if "\0" in line), 0):
        raise DeviceError(
            f"{path}, line {held}: holds a NUL character, as a damaged file does, UTF-16 without "
            "its byte-order mark and UTF-32; write the table in UTF-8"
        )
    return lines


def _column_names(where: str, line: str, fields: list[str]) -> list[str]:
    """Returns the valid column names of a header."""
    names = [field.strip().strip("\"'").strip().lower() for field in fields]
    needed = "a header with the columns t,x,y,z and optionally qw,qx,qy,qz is needed"
    if all(_is_number(name) for name in names):
        raise DeviceError(f"{where}: numbers where {needed}")
    known = TIME_AND_POSITION + ORIENTATION
    if len(names) == 1 and re.search(r"[\s|]", names[0]):
        raise DeviceError(
            f"{where}: the columns in {line.strip()!r:.40} are not separated by commas, semicolons "
            f"or tabs; {needed}"
        )
    if set(EXPORTED) <= set(names):
        own = dict(zip(EXPORTED, known, strict=True))
        return [own.get(name, "") for name in names]
    if scaled := next(filter(None, (re.search(r"(ms|mm)\W*$", name) for name in names)), None):
        raise DeviceError(
            f"{where}: column {scaled.string!r:.40} looks like {scaled[1]}; times are in s and "
            f"positions in m: divide by 1000, and name the column {scaled.string[0]}"
        )
    if missing := [name for name in TIME_AND_POSITION if name not in names]:
        raise DeviceError(f"{where}: column {', '.join(missing)} is missing; {needed}")
    if unknown := [name for name in names if name not in known]:
        raise DeviceError(f"{where}: unknown column {unknown[0]!r:.40}; {needed}")
    if len(set(names)) < len(names):
        duplicate = next(name for name in names if names.count(name) > 1)
        raise DeviceError(f"{where}: column {duplicate} occurs twice; remove one of them")
    missing = [name for name in ORIENTATION if name not in names]
    if 0 < len(missing) < len(ORIENTATION):
        raise DeviceError(
            f"{where}: column {', '.join(missing)} is missing; an orientation needs all of "
            "qw,qx,qy,qz, or none of them"
        )
    return names


def _is_number(text: str) -> bool:
    try:
        number_from(text)
    except ValueError:
        return False
    return True


EXPORTED = (
    "seconds",
    *(f"device_position_{axis}" for axis in "xyz"),
    *(f"device_quaternion_{part}" for part in "wxyz"),
)
"""Columns of an exported recording that are the device's motion: time, position, orientation."""

MAX_SPAN = 4.0
"""Extent of a motion in m beyond which a fast one is taken for mm. Devices on a desk reach 1 m; a
walk through a tracked room is slow."""

MAX_STEP = 0.5
"""Median time in s between rows above which the times of many rows are taken for ms; a thousand
times this is taken for µs, and more for ns."""

MIN_STEP = 4e-5
"""Mean time in s between rows below which times are taken for µs or ms where ns belong: a
thousandth of the 1/25 s of slow trackers. No loop here is as fast; rows in bursts have a smaller
median."""

MANY_ROWS = 20
"""Number of rows from which on their times are judged. Fewer may be single poses, s apart."""

LONG_GAP, LONG_SHARE = 0.1, 20.0
"""Time in s between two rows, and number of median ones, above which rows are taken for lost. A
tracker that misses a few poses has no gap."""


def _plausible(table: NDArray[np.float64], path: Path) -> Motion:
    """Returns a motion whose times are in s and lengths in m, as far as a hand's motion tells.

    Raises:
        DeviceError: Lengths look like mm, or a clock was set between two rows.

    Warns:
        UserWarning: Times look like ms, µs or ns, or like µs or ms that were taken for ns.
    """
    steps, ways = np.diff(table[:, 0]), np.linalg.norm(np.diff(table[:, 1:4], axis=0), axis=1)
    span = float(np.ptp(table[:, 1:4], axis=0).max())
    step = float(np.median(steps))
    unit = next((unit for unit, count in PER_SECOND.items() if step < MAX_STEP * count), "ns")
    is_slow = len(table) >= MANY_ROWS and step >= MAX_STEP
    speed = float(np.median(ways / steps)) * (PER_SECOND[unit] if is_slow else 1.0)
    if span > MAX_SPAN and speed > USUAL_SPEED_LIMIT:
        also = (
            f", and rows {format_number(step, 3)} s apart, as times in {unit} have"
            if is_slow
            else ""
        )
        unit = ": if these are mm, divide them by 1000" if span <= 1e3 * MAX_SPAN else ""
        raise DeviceError(
            f"{path}: the motion spans {format_number(span, 3)} m at {format_number(speed, 3)} "
            f"m/s{also}; positions are in m and times in s{unit}"
        )
    if is_slow:
        warnings.warn(
            f"{path}: rows are {format_number(step, 3)} s apart, and the motion takes "
            f"{np.ptp(table[:, 0]):.3g} s; times are in s: if these are {unit}, divide by "
            f"{PER_SECOND[unit]:.0f}",
            stacklevel=3,
        )
    elif len(table) >= MANY_ROWS and (mean := float(steps.mean())) < MIN_STEP:
        warnings.warn(
            f"{path}: rows are {format_number(mean, 3)} s apart, and the motion takes "
            f"{np.ptp(table[:, 0]):.3g} s; times are in s, and those of a bag in ns: if a program "
            "wrote µs or ms there, multiply by 1000 or 1000000",
            stacklevel=3,
        )
    elif len(table) >= MANY_ROWS and steps.max() > MAX_SILENCE * 1e-9:
        before, days = int(steps.argmax()) + 1, steps.max() / 86_400
        raise DeviceError(
            f"{path}: the time jumps by {days:.0f} days after {before} of {len(table)} poses, as "
            "where a clock is set; write the motion without those on one side"
        )
    if len(table) >= MANY_ROWS:
        _tell_gaps(table[:, 0], path)
    return Motion(table[:, 0], table[:, 1:4], table[:, 4:])


def _tell_gaps(times: NDArray[np.float64], path: Path) -> None:
    """Warns of the longest time without rows, as where a recorder lost messages.

    Warns:
        UserWarning: There is one. The hand may have rested, which the rows do not tell.
    """
    steps = np.diff(times)
    usual = float(np.median(steps))
    gaps = np.flatnonzero(steps > max(LONG_GAP, LONG_SHARE * usual))
    if not gaps.size:
        return
    longest = gaps[steps[gaps].argmax()]
    begin, end = times[longest : longest + 2] - times[0]
    apart = float(np.median(steps[steps >= MIN_STEP]))  # or, in bursts, these
    also = f" (the longest of {gaps.size} gaps)" if gaps.size > 1 else ""
    warnings.warn(
        f"{path}: no pose from {begin:.2f} to {end:.2f} s{also}, where poses are "
        f"{format_number(apart, 3)} s apart; the motion goes straight from one to the next",
        stacklevel=4,
    )


# Recording


def read_recorded(path: Path) -> tuple[NDArray[np.void], float]:
    """Reads a recording of one hand as a motion: its records, and the period of its loop in s.

    Raises:
        DeviceError: It is damaged, or lacks its period.
        RecordingError: It cannot be read, or is of several hands.

    Warns:
        UserWarning: Its end is missing, or deadlines were skipped between two of its ticks.
    """
    # imported here, because no other device needs it
    from hapticbridge.recording import read_recording  # noqa: PLC0415

    recording = read_recording(path)
    if recording.problems:
        raise DeviceError(f"{path} is damaged: {recording.problems[0]}; so it is no motion")
    if not math.isfinite(period := recording.period):
        raise DeviceError(
            f"{path}: the recording lacks its period (period_s), so it cannot be replayed"
        )
    if recording.cut_sentence:
        warnings.warn(f"{path}: {recording.cut_sentence}; the motion ends there", stacklevel=2)
    ticks = recording.ticks
    is_after = (ticks["flags"][1:] & TickFlag.OVERRUN) != 0
    lost = np.diff(ticks["deadline_ns"])[is_after] * 1e-9 - period
    if (missing := float(lost.sum())) > LONG_GAP:
        warnings.warn(
            f"{path}: its run skipped deadlines, {format_number(missing, 3)} s in all; the motion "
            "is replayed tick by tick, and is that much shorter",
            stacklevel=2,
        )
    return ticks, period


# Bag of ROS 2

POSE, _POSE_OF_ROS_1 = "geometry_msgs/msg/PoseStamped", "geometry_msgs/PoseStamped"

MAX_SILENCE = 86_400 * 10**9
"""Longest time in ns between two stamps of one clock, as of a simulated one after its stamp of 0:
a day. Unix time is beyond it."""

_DAMAGED = ValueError, RuntimeError, EOFError, OverflowError, MemoryError, ZstdError
"""Errors besides its own with which the package mcap meets a damaged file."""


def _is_bag(path: Path) -> bool:
    """Returns True for a whole MCAP file without the topic ``/tick`` of a recording."""
    try:
        return "/tick" not in dict(_topics(path))
    except DeviceError:
        return False


def read_bag(path: Path, topic: str = "") -> Motion:
    """Reads the motion of a topic of poses from a bag of ROS 2 in MCAP.

    The times are those of the messages' stamps, or of the log where they have none. They are
    counted from the first. Messages are read in the order of the file: a log whose clock jumped,
    or in which messages arrived unevenly, would put them into another one.

    Args:
        path: The file.
        topic: The topic; it may be empty if there is only one of ``PoseStamped`` with messages.

    Raises:
        DeviceError: The file cannot be read, a checksum or the number of messages in its index does
            not match, it has no such topic, a message is not valid, the poses are in several
            frames, or some stamps are 0 and others of another clock.

    Warns:
        UserWarning: Times look like those of another unit.
    """
    # imported here, because no other device needs it
    from mcap.exceptions import McapError  # noqa: PLC0415
    from mcap.reader import NonSeekingReader, make_reader  # noqa: PLC0415

    from hapticbridge.recording.container import Container, FileBytes  # noqa: PLC0415

    kinds = dict(_topics(path))
    with FileBytes(path) as data:
        if damage := Container(data).problems:
            raise DeviceError(f"{path}: {damage[0]}")
    poses = [name for name, kind in kinds.items() if kind == POSE]
    if topic and topic not in poses:
        is_there = f"its type is {kinds[topic]}" if topic in kinds else "there is none"
        raise DeviceError(
            f"{path}: topic '{topic}' must be of {POSE}, and {is_there}; topics of that type: "
            f"{choices(poses)}"
        )
    if not poses:
        listed = choices(f"{name} ({kind})" for name, kind in kinds.items())
        older = "; those of ROS 1 are not read" if _POSE_OF_ROS_1 in kinds.values() else ""
        raise DeviceError(f"{path}: has no topic of {POSE}{older}; topics: {listed}")
    rows: dict[str, list[tuple[int, int, str, tuple[float, ...]]]]
    rows = {name: [] for name in ([topic] if topic else poses)}
    topic = topic or poses[0]  # until a message is of another
    with path.open("rb") as file:
        try:
            has_chunks = (index := _index(file)) is not None and index.chunk_indexes
            make = make_reader if has_chunks else NonSeekingReader
            reader = make(file, validate_crcs=True)
            for _, channel, message in reader.iter_messages(rows, log_time_order=False):
                topic = channel.topic
                if (encoding := channel.message_encoding) != _CDR:
                    raise ValueError(f"its encoding is {encoding!r:.40}, not '{_CDR}'")
                stamp, frame, pose = _pose_of(message.data)
                rows[topic].append((stamp, message.log_time, frame, pose))
        except (OSError, McapError, struct.error, LookupError, *_DAMAGED) as error:
            reason = str(error) or type(error).__name__
            raise DeviceError(
                f"{path}: message {len(rows[topic])} of {topic} cannot be read ({reason})"
            ) from None
    for name, count in _counted(index):
        if name in rows and count != len(rows[name]):
            raise DeviceError(
                f"{path} is damaged: its index counts {format_count(count, 'message')} of {name}, "
                f"and {len(rows[name])} can be read"
            )
    if len(filled := [name for name, own in rows.items() if own]) > 1:
        raise DeviceError(
            f"{path}: has several topics of {POSE}; name one, 'trajectory:{path}:{filled[0]}': "
            f"{choices(filled)}"
        )
    topic = filled[0] if filled else topic
    stamps, logged, frames, numbers = zip(*rows[topic], strict=True) if filled else ((),) * 4
    times = np.array(stamps if any(stamps) else logged, dtype=np.int64)
    if len(times) < 2:
        raise DeviceError(f"{path}: {topic} has {len(times)} of at least two messages")
    if len(found := sorted(set(frames))) > 1:
        raise DeviceError(
            f"{path}: the poses of {topic} are in {len(found)} frames, {choices(found)}; write the "
            "bag with those in one of them"
        )
    _refuse_unset(path, topic, times)
    table = np.empty((len(times), 8))
    table[:, 0] = (times - times[0]) * 1e-9
    table[:, 1:] = np.array(numbers)[:, [0, 1, 2, 6, 3, 4, 5]]  # ROS has w last
    if fault := first_fault(table):
        which = "the stamps stand still: " if any(stamps) and len(set(stamps)) == 1 else ""
        raise DeviceError(f"{path}, message {fault[0]} of {topic}: {which}{fault[1]}")
    return _plausible(table, path)


def _counted(index: Any) -> Iterator[tuple[str, int]]:
    """Yields topic and number of messages as the index of an MCAP file states them, if it does."""
    statistics = None if index is None else index.statistics
    counts: Counter[str] = Counter()
    for channel, count in ({} if statistics is None else statistics.channel_message_counts).items():
        if channel in index.channels:
            counts[index.channels[channel].topic] += count
    yield from counts.items()


def _refuse_unset(path: Path, topic: str, times: NDArray[np.int64]) -> None:
    """Refuses stamps in ns of which some are of no clock, and others of one.

    Raises:
        DeviceError: Some are.
    """
    zero, set_at = np.flatnonzero(times == 0), np.flatnonzero(times)
    following = np.append(times[set_at], np.iinfo(np.int64).max)[np.searchsorted(set_at, zero)]
    # a simulated clock begins at 0, may stay there for some messages, and may begin anew
    unset = zero[following > MAX_SILENCE]
    if unset.size:
        raise DeviceError(
            f"{path}: the stamp is 0 in {unset.size} of the {times.size} messages of {topic}, "
            f"first in message {unset[0]}, as before a clock is set; write the bag without them"
        )


def _topics(path: Path) -> Iterator[tuple[str, str]]:
    """Yields topic and type of every channel of a whole MCAP file.

    Raises:
        DeviceError: The file is damaged, or its end is missing.
    """
    from mcap.exceptions import McapError  # noqa: PLC0415
    from mcap.records import Channel, Schema  # noqa: PLC0415
    from mcap.stream_reader import StreamReader  # noqa: PLC0415

    from hapticbridge.recording.container import Container, FileBytes  # noqa: PLC0415

    try:
        # the package mcap takes a compression that it does not know for none
        with FileBytes(path) as data:
            if reason := Container(data).foreign_compression():
                raise DeviceError(f"{path}: cannot be read ({reason})")
        with path.open("rb") as file:
            if index := _index(file):
                channels, schemas = index.channels.values(), index.schemas
            else:
                records = [r for r in StreamReader(file).records if isinstance(r, Schema | Channel)]
                channels = [each for each in records if isinstance(each, Channel)]
                schemas = {each.id: each for each in records if isinstance(each, Schema)}
    except (OSError, RecordingError, McapError, struct.error, *_DAMAGED) as error:
        reason = (str(error) or type(error).__name__) if _ends_whole(path) else _NO_END
        raise DeviceError(f"{path}: cannot be read ({reason})") from None
    for channel in channels:
        schema = schemas.get(channel.schema_id)
        yield channel.topic, schema.name if schema else "no type"


_NO_END = "its end is missing or followed by more; 'mcap recover' writes what is whole"


def _ends_whole(path: Path) -> bool:
    """Returns True for a file that ends as an MCAP file does, or cannot be read at all."""
    try:
        with path.open("rb") as file:
            file.seek(-len(_MCAP_MAGIC), os.SEEK_END)
            return file.read() == _MCAP_MAGIC
    except OSError:
        return True


def _index(file: IO[bytes]) -> Any:
    """Returns the index of an MCAP file, or None if it has none or no channels in it."""
    from mcap.reader import make_reader  # noqa: PLC0415

    summary = make_reader(file).get_summary()
    file.seek(0)
    return summary if summary is not None and summary.channels else None


_ZSTD = b"\x28\xb5\x2f\xfd"
"""Start of what Zstandard compressed, as bags of compression mode ``message`` hold."""


_CDR = "cdr"
"""Encoding of messages in bags of ROS 2, as MCAP names it."""

_ALIGNED_TO = {0x0000: 8, 0x0001: 8, 0x0006: 4, 0x0007: 4}
"""Largest alignment in bytes by the representation of a message: plain CDR of versions 1 and 2."""


def _pose_of(data: bytes) -> tuple[int, str, tuple[float, ...]]:
    """Returns stamp in ns, frame and numbers of a ``PoseStamped``: x, y, z in m, qx, qy, qz, qw.

    It is CDR: two bytes of the representation, whose last bit says little-endian, two of options;
    then the stamp, the length of the frame's name and the name, and the numbers at a multiple of 8
    bytes, or of 4 in version 2 (OMG DDS-XTypes 1.3, 7.4).

    Raises:
        ValueError: The representation is none of these.
    """
    if data.startswith(_ZSTD):
        raise ValueError("the bag compresses each message; 'ros2 bag convert' undoes it")
    (representation,) = struct.unpack_from(">H", data)
    if representation not in _ALIGNED_TO:
        raise ValueError(
            f"its representation is 0x{representation:04x}; of CDR, 0x0000, 0x0001, 0x0006 and "
            "0x0007 are read"
        )
    order, size = "<" if representation & 1 else ">", _ALIGNED_TO[representation]
    seconds, nanoseconds, length = struct.unpack_from(f"{order}iII", data, 4)
    start = 4 + (12 + length + size - 1) // size * size
    frame = data[16 : 16 + length].rstrip(b"\0").decode(errors="replace")
    return seconds * 10**9 + nanoseconds, frame, struct.unpack_from(f"{order}7d", data, start)
