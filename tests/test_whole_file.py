"""A file is there whole or not at all."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import pytest

from hapticbridge.files import atomic_write


@pytest.mark.parametrize("error", [OSError, KeyboardInterrupt])
def test_what_was_not_finished_replaces_nothing(tmp_path: Path, error: type[BaseException]) -> None:
    path = tmp_path / "page.html"
    path.write_text("old")
    with pytest.raises(error), atomic_write(path) as draft:
        draft.write_text("ne")
        raise error
    assert path.read_text() == "old"
    assert [path] == list(tmp_path.iterdir())


def test_what_was_finished_stands_alone_and_where_a_link_leads(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    path = tmp_path / "page.html"
    path.symlink_to(tmp_path / "there" / "true.html")
    with atomic_write(path) as draft:
        draft.write_text("new")
    assert path.is_symlink()
    assert [path.resolve()] == list((tmp_path / "there").iterdir())
    assert path.read_text() == "new"


def test_a_pipe_is_written_to_and_stays_one(tmp_path: Path) -> None:
    path = tmp_path / "pipe.csv"
    os.mkfifo(path)
    heard: list[str] = []
    reader = threading.Thread(target=lambda: heard.append(path.read_text()))
    reader.start()
    with atomic_write(path) as draft:
        draft.write_text("new")
    reader.join()
    assert heard == ["new"]
    assert path.is_fifo()
