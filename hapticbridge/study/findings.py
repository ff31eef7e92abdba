"""Which recordings files, folders and patterns name."""

from __future__ import annotations

import glob
import os
from collections.abc import Iterable
from pathlib import Path

from hapticbridge.errors import RecordingError

ENDING = ".mcap"
"""What recordings in a folder are known by, in small or capital letters."""


def find_recordings(words: Iterable[str | Path]) -> list[Path]:
    """Returns the recordings that files, folders and patterns name, each once.

    A folder stands for all files below it that end in ``.mcap``, in the order of their names. A
    word that is no file and holds ``*``, ``?`` or ``[`` is a pattern, in which ``**`` stands for
    any folders. Links to files are followed, links to folders below a folder are not: they may lead
    in a circle. What does not exist, and a folder below that cannot be read, are kept: the audit
    says so.

    Raises:
        RecordingError: There is no recording in a folder, none that fits a pattern, or the pattern
            is none.
    """
    found: dict[Path, Path] = {}
    for word in words:
        path = Path(word)
        files = [path]
        if path.is_dir():
            files = _below(path)
            if not files:
                raise RecordingError(f"there is no recording (*{ENDING}) in the folder '{path}'")
        elif glob.has_magic(str(path)) and not path.exists():
            files = _fitting(path)
            if not files:
                raise RecordingError(f"no recording fits '{path}'")
        for file in files:
            found.setdefault(file.resolve(), file)
    return list(found.values())


def _below(folder: Path) -> list[Path]:
    """Returns the recordings in and below a folder, and what of it cannot be read."""
    refused: list[Path] = []

    def refuse(error: OSError) -> None:
        refused.append(Path(error.filename))

    files = [
        Path(place) / name
        for place, _, names in os.walk(folder, onerror=refuse)
        for name in names
        if name.lower().endswith(ENDING)
    ]
    # a link after what it may lead to, which is then the one that is named
    return sorted([*files, *refused], key=lambda file: (file.is_symlink(), file))


def _fitting(pattern: Path) -> list[Path]:
    """Returns the files that fit a pattern, and those below the folders that do."""
    parts = pattern.parts
    first = next(index for index, part in enumerate(parts) if glob.has_magic(part))
    rest = str(Path(*parts[first:]))
    try:
        found = sorted(Path(*parts[:first]).glob(rest))
    except ValueError as error:
        raise RecordingError(f"'{pattern}' is no pattern: {error}") from None
    return [file for path in found for file in (_below(path) if path.is_dir() else [path])]
