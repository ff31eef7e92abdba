"""The README does what it says: its session, its code blocks, its files."""

from __future__ import annotations

import json
import re
import runpy
import shlex
from pathlib import Path
from typing import Any

import pytest

from hapticbridge import Bridge, SimulatedClock, audit
from hapticbridge.cli import main

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    """Returns the README's code blocks in a language."""
    return re.findall(rf"```{language}\n(.*?)```", README, flags=re.DOTALL)


@pytest.fixture
def workplace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder, in which the README's commands find what they need."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_session_prints_what_the_readme_shows(
    workplace: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (session,) = blocks("console")
    for exchange in session.split("$ hapticbridge ")[1:]:
        command, _, shown = exchange.partition("\n")
        assert main(shlex.split(command)) == 0
        shown, _, rest = shown.partition("...\n")  # what follows is left out
        assert not rest
        expected_words = shown.split()
        printed = capsys.readouterr().out.split()[: len(expected_words)]
        for word, expected in zip(printed, expected_words, strict=True):
            number = re.fullmatch(r"\(?(-?[0-9.]+)", expected)
            if number:  # another processor may round the last digit differently
                assert float(word.lstrip("(")) == pytest.approx(float(number[1]), rel=0.02)
            else:
                assert word == expected


def test_tables_of_measurements_are_written_from_what_was_measured() -> None:
    merit = runpy.run_path(str(ROOT / "scripts" / "merit"))
    kept = json.loads(merit["FILE"].read_text(encoding="utf-8"))
    guide = "hapticbridge/guide"
    pages = ("faults", "own_loop", "passivity", "rigid_contact", "slower_scenes")
    files = {"README.md", *(f"{guide}/{page}.md" for page in pages)}
    assert {table.file for table in merit["TABLES"]} == files
    for table in merit["TABLES"]:
        text = (ROOT / table.file).read_text(encoding="utf-8")
        assert table.written(text, kept) == text
        assert len(table.rows(kept)) > 1
    assert set(kept) == {*merit["MEASURED"], "pictures"}
    assert all(each["commit"] and each["machine"] for each in kept.values())
    assert not any(each["commit"].endswith("-dirty") for each in kept.values())


def test_no_hand_got_energy_where_the_conditions_were_kept() -> None:
    merit = runpy.run_path(str(ROOT / "scripts" / "merit"))
    found = json.loads(merit["FILE"].read_text(encoding="utf-8"))["hands"]["found"]
    for kind in ("on time", "late samples", "slower scenes", "two hands"):
        assert found[kind]["hands"] >= 600
        assert found[kind]["over"] == 0
    assert found["slower scenes that nobody pays for"]["over"] > 0


def test_every_fault_and_broken_condition_that_was_tried_is_in_one_row() -> None:
    merit = runpy.run_path(str(ROOT / "scripts" / "merit"))
    kept = json.loads(merit["FILE"].read_text(encoding="utf-8"))
    for rows, tried in (
        (merit["FAULTS"], "faults"),
        (merit["ALL_CONDITIONS"], "broken conditions"),
        (merit["BRIEF_CONDITIONS"], "broken conditions"),
    ):
        names = [name for names in rows.values() for name in names]
        assert sorted(names) == sorted(kept[tried]["found"])


def test_python_blocks_run(workplace: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names: dict[str, object] = {}
    for code in blocks("python"):
        exec(compile(code, "README.md", "exec"), names)
    assert capsys.readouterr().out == "passive\n"
    rail: Any = names["Rail"]
    with Bridge("peg_in_hole", rail(), clock=SimulatedClock()) as bridge:
        assert bridge.run(1.0).is_certified
    report = audit("own.mcap")
    assert (report.verdict, report.agreement) == ("passive", "bit for bit")
    assert report.credit == 0.05
    assert report.ticks >= 1000


def test_shell_commands_are_valid(workplace: Path) -> None:
    for line in "".join(blocks("sh")).splitlines():
        words = shlex.split(line, comments=True)
        if not words:
            continue
        if words[0] == "hapticbridge":
            is_run = words[1] == "run"
            code = main(words[1:] + (["--fast", "--duration", "0.2"] if is_run else []))
            # whether a machine holds the rate is its own affair: 1 says that it does not
            assert code in ((0, 1) if words[1] == "doctor" else (0,)), line
        else:
            script = ROOT / words[0]
            assert script.is_file()
            assert script.stat().st_mode & 0o111


def test_commands_for_a_device_are_valid(workplace: Path) -> None:
    """Run on a simulated device that no hand holds; what needs the administrator is left out."""
    for line in "".join(blocks("bash")).splitlines():
        command = line.replace("NAME", "simulated:hand=none").partition("|")[0]
        words = shlex.split(command, comments=True)
        assert words[0] == "hapticbridge"
        hasty = ["--fast", "--duration", "0.2"] if words[1] == "run" else []
        assert main(words[1:] + hasty) == 0, line


def test_links_and_pictures_exist() -> None:
    for target in re.findall(r"\]\(([^)#]+)\)", README):
        assert (ROOT / target).is_file(), target


def test_readme_is_short() -> None:
    """The rows of tables do not count: a new device adds one."""
    lines = README.splitlines()
    assert sum(not line.startswith("|") for line in lines) <= 90
    assert max(map(len, lines)) <= 110
