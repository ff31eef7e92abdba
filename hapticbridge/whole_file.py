"""Files that appear whole or not at all."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yields a name to write under; the file takes its place once the block is over.

    What the disk did not take all of, or was interrupted, then neither stands there nor replaces
    what did.

    Args:
        path: Where the file is to stand; where it is a link, what it leads to. What is there and no
            file, like a pipe or /dev/stdout, is written to at once.

    Raises:
        OSError: The file cannot take its place.
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
