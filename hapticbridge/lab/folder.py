"""Folder for the files of a study, proven writable before anything is computed."""

from __future__ import annotations

import tempfile
from collections.abc import Collection
from pathlib import Path

from hapticbridge.errors import StudyError


def prepared_folder(folder: Path, names: Collection[str] = ()) -> Path:
    """Makes a folder, if there is none, and proves that it and its files can be written.

    Args:
        folder: Folder to write into.
        names: Files in it that will be written; existing ones stay unchanged. Without names, any
            new file must be possible.

    Raises:
        StudyError: The path is a file, or the folder or a file in it cannot be made or written.
    """
    path = folder
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not names:
            tempfile.TemporaryFile(dir=folder).close()
        for path in (folder / name for name in names):
            is_new = not path.exists()
            with path.open("ab"):
                pass
            if is_new:
                path.unlink()
    except FileExistsError:
        raise StudyError(f"'{folder}' is a file; name a folder to write into") from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise StudyError(f"cannot write '{path}': {reason}") from None
    return folder
