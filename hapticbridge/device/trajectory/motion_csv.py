"""Motion from a CSV file."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import numpy as np

from hapticbridge.device.trajectory.motion import (
    ORIENTATION,
    TIME_AND_POSITION,
    Motion,
    first_fault,
)
from hapticbridge.errors import DeviceError


def read_motion(path: str | os.PathLike[str]) -> Motion:
    """Reads a motion from a CSV file.

    The first line that is neither empty nor a comment (``#``) names the columns, in any order:
    ``t,x,y,z`` in s and m, and either all or none of ``qw,qx,qy,qz``. Every further line is a row
    of numbers. Times must strictly increase; the rate is free.

    Args:
        path: The file, UTF-8.

    Returns:
        The motion, its times counted from the first row.

    Raises:
        DeviceError: The file cannot be read, or a line is not valid; the message names it.
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
    names = _column_names(f"{path}, line {header[0]}", header[1])
    width = len(names)
    numbers: list[int] = []
    values: list[float] = []
    for number, line in numbered:
        fields = line.split(",")
        if len(fields) != width:
            raise DeviceError(
                f"{path}, line {number}: {len(fields)} fields where the header names "
                f"{width} columns"
            )
        try:
            values.extend(map(float, fields))
        except ValueError:
            column = next(i for i, field in enumerate(fields) if not _is_number(field))
            raise DeviceError(
                f"{path}, line {number}: column '{names[column]}' holds "
                f"{fields[column].strip()!r:.40}, which is not a number"
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
    data = np.array(values).reshape(len(numbers), width)
    for column, name in enumerate(TIME_AND_POSITION + ORIENTATION):
        if name in names:
            table[:, column] = data[:, names.index(name)]
    if fault := first_fault(table):
        raise DeviceError(f"{path}, line {numbers[fault[0]]}: {fault[1]}")
    return Motion(table[:, 0], table[:, 1:4], table[:, 4:])


def _read_lines(path: Path) -> list[str]:
    """Reads a text file with any line ending; a byte-order mark is dropped."""
    try:
        mode = path.stat().st_mode
        if not stat.S_ISREG(mode):
            kind = "a directory" if stat.S_ISDIR(mode) else "not a regular file"
            raise DeviceError(f"{path}: is {kind}, not a CSV file")
        return path.read_text(encoding="utf-8-sig").split("\n")
    except FileNotFoundError:
        raise DeviceError(f"{path}: no such file") from None
    except UnicodeDecodeError as error:
        line = path.read_bytes()[: error.start].count(b"\n") + 1
        raise DeviceError(f"{path}, line {line}: not UTF-8 text, so not a CSV file") from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise DeviceError(f"{path}: cannot be read ({reason})") from None


def _column_names(where: str, line: str) -> list[str]:
    """Returns the valid column names of a header."""
    # some programs quote column names, but not numbers
    names = [field.strip().strip("\"'").strip().lower() for field in line.split(",")]
    needed = "a header with the columns t,x,y,z and optionally qw,qx,qy,qz is needed"
    if all(_is_number(name) for name in names):
        raise DeviceError(f"{where}: numbers where {needed}")
    known = TIME_AND_POSITION + ORIENTATION
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
        float(text)
    except ValueError:
        return False
    return True
