"""Files that are there whole or not at all, and JSON of finite numbers."""

from __future__ import annotations

import json
import math
import os
import sys
import tempfile
import threading
from pathlib import Path

import pytest

from hapticbridge.errors import RecordingError, StudyError
from hapticbridge.files import (
    atomic_write,
    check_target,
    finite_or_null,
    folder_words,
    install_command,
    prepared_folder,
    read_json,
    reason_of,
)


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


def test_a_link_planted_beside_a_file_leads_nothing_elsewhere(tmp_path: Path) -> None:
    path, other, names = tmp_path / "page.html", tmp_path / "other", set[str]()
    other.write_text("mine")
    for _ in range(2):
        with atomic_write(path) as draft:
            names.add(draft.name)
            draft.write_text("new")
        (tmp_path / min(names)).unlink(missing_ok=True)
        (tmp_path / min(names)).symlink_to(other)  # under the name that the first draft had
    assert (len(names), path.read_text(), other.read_text()) == (2, "new", "mine")
    assert {Path(name).suffix for name in names} == {".html"}  # tells matplotlib the format


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


def test_numbers_that_are_not_finite_become_null_as_deep_as_they_lie() -> None:
    facts = {"a": math.nan, "b": [1.5, -math.inf, (math.inf, "x")], "c": {"d": {"e": math.nan}}}
    told = json.dumps(finite_or_null(facts), allow_nan=False)
    assert json.loads(told) == {"a": None, "b": [1.5, None, [None, "x"]], "c": {"d": {"e": None}}}


def test_everything_else_stays_as_it_is() -> None:
    facts = {"n": 3, "t": True, "s": "nan", "x": 0.0, "none": None, "l": []}
    assert finite_or_null(facts) == facts


@pytest.mark.parametrize("text", ["", "nan?", "{", "1" * 5000, "[" * 100_000, b"\xff"])
def test_what_is_no_json_is_one_kind_of_error(text: str | bytes) -> None:
    with pytest.raises(ValueError):
        read_json(text)


def test_json_is_read_as_it_was_written() -> None:
    assert read_json(b'{"a": [1, 2.5, null]}') == read_json('{"a": [1, 2.5, null]}')
    assert read_json("[1]") == [1]


@pytest.mark.parametrize(
    ("is_checkout", "is_here", "has_pip", "expected"),
    [
        (True, True, True, "pip install -e '.[view]'"),
        (True, False, True, "pip install -e '{checkout}[view]'"),
        (True, True, False, "{python} -m pip install -e '.[view]'"),
        (False, False, True, "pip install 'hapticbridge[view]'"),
    ],
)
def test_the_command_for_an_extra_fits_the_place_of_the_program(
    is_checkout: bool,
    is_here: bool,
    has_pip: bool,
    expected: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    checkout, elsewhere = tmp_path / "checkout", tmp_path / "elsewhere"
    checkout.mkdir()
    elsewhere.mkdir()
    if is_checkout:
        (checkout / "pyproject.toml").touch()
    pip = Path(sys.executable).parent / "pip" if has_pip else Path("/usr/bin/pip")
    monkeypatch.setattr("shutil.which", lambda _: str(pip))
    monkeypatch.setattr("hapticbridge.files.CHECKOUT", checkout)
    monkeypatch.chdir(checkout if is_here else elsewhere)
    assert install_command("view") == expected.format(checkout=checkout, python=sys.executable)


@pytest.mark.skipif(sys.platform != "linux", reason="/proc is Linux's")
@pytest.mark.parametrize(
    ("folder", "reason"),
    [
        ("/proc", "the folder /proc takes no new file"),
        ("/dev/full", "/dev/full is not a folder"),
        ("{}/no", "the folder {}/no does not exist"),
    ],
)
def test_why_a_file_cannot_be_made_is_true(tmp_path: Path, folder: str, reason: str) -> None:
    path, words = Path(folder.format(tmp_path)) / "x.png", reason.format(tmp_path)
    with pytest.raises(RecordingError, match=f"cannot write '{path}': {words}$"):
        check_target(path, RecordingError)


def test_a_folder_is_no_file_to_write_and_a_file_to_replace_stays(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"it is a folder$"):
        check_target(tmp_path, RecordingError)
    (tmp_path / "mine").write_text("mine")
    for name in ("mine", "new"):
        check_target(tmp_path / name, RecordingError)
    assert [(each.name, each.read_text()) for each in tmp_path.iterdir()] == [("mine", "mine")]


@pytest.mark.skipif(sys.platform != "linux", reason="/proc is Linux's")
def test_a_folder_that_cannot_be_made_is_told(tmp_path: Path) -> None:
    with pytest.raises(StudyError, match=r"'/proc/x': the folder /proc takes no new file$"):
        prepared_folder(Path("/proc/x"))
    assert prepared_folder(tmp_path / "new" / "more").is_dir()


def test_without_room_for_temporary_files_that_is_the_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", None)
    monkeypatch.setattr(tempfile, "_candidate_tempdir_list", lambda: [str(tmp_path / "no")])
    with pytest.raises(OSError, match="No usable temporary directory") as found:
        tempfile.gettempdir()
    assert reason_of(found.value, tmp_path / "x").startswith("No usable temporary directory found")
    assert "set TMPDIR" in folder_words(found.value)
    assert folder_words(FileNotFoundError(2, "No such file", "x")) == ""
