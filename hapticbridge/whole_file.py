"""Atomic file replacement."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yields a temporary path; after the block the file replaces the target.

    If writing fails or is interrupted, an existing file is left unchanged and no partial file
    remains. A link is followed. An existing path that is not a regular file, such as a pipe or
    /dev/stdout, is written directly.

    Raises:
        OSError: The file cannot replace the target.
    """
    target = path.resolve()
    if path.exists() and not path.is_file():
        yield path
        return
    draft = target.with_name(f".draft-{target.name}")
    try:
        yield draft
        draft.replace(target)
    finally:
        with suppress(OSError):
            draft.unlink(missing_ok=True)
