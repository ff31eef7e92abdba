"""Runs, audits and help texts are what they were, to the bit (``scripts/freeze`` froze them)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import golden_cases as golden
import pytest

RUNS = golden.runs()

PRINTING = ("tyro", "rich", "python")
"""Versions that decide the layout of a help text. Tyro and rich decide nothing else."""


def hold(frozen: Any, found: Any, *, is_text: bool = False) -> None:
    """Fails where the two differ; skips where another machine or version may be the reason."""
    found = json.loads(json.dumps(found))
    differing = golden.difference_lines(frozen, found)
    if not differing:
        return
    then, now = json.loads(golden.MACHINE.read_text(encoding="utf-8")), golden.machine()
    names = PRINTING if is_text else [name for name in now if name not in PRINTING[:2]]
    other = [
        f"{name} {then.get(name)}, here {now[name]}"
        for name in names
        if then.get(name) != now[name]
    ]
    told = "\n".join(differing)
    if other:
        pytest.skip(
            f"{len(differing)} entries differ, and they were frozen with {'; '.join(other)}. Run "
            f"'scripts/freeze' on the commit before your change, then this test:\n{told}"
        )
    pytest.fail(
        "this differs from what 'scripts/freeze' froze; a change that is meant to change it runs "
        f"that again and says why:\n{told}",
        pytrace=False,
    )


def frozen(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", RUNS)
def test_a_run_gives_the_records_that_were_frozen(name: str, tmp_path: Path) -> None:
    hold(frozen(golden.RUNS)[name], RUNS[name].digests(tmp_path))


def test_every_frozen_run_is_still_run() -> None:
    assert list(frozen(golden.RUNS)) == list(RUNS)


def test_recordings_and_their_verdicts_are_the_frozen_ones(tmp_path: Path) -> None:
    hold(frozen(golden.AUDITS), golden.audits(tmp_path))


@pytest.mark.parametrize("name", golden.COMMANDS)
def test_a_command_prints_the_help_that_was_frozen(name: str) -> None:
    text = golden.help_file(name).read_text(encoding="utf-8")
    hold(text.splitlines(), golden.help_text(name).splitlines(), is_text=True)


@pytest.mark.parametrize("name", golden.SESSIONS)
def test_commands_print_what_was_frozen(name: str, tmp_path: Path) -> None:
    text = golden.session_file(name).read_text(encoding="utf-8")
    found = golden.session_text(name, tmp_path)
    if name == "refused":
        for told in found.split("$ ")[2:]:  # after the run that is asked of
            assert "Traceback" not in told
            assert (told.count("\nerror: "), told[-5:]) == (1, "\n(2)\n"), told
        assert [path.name for path in tmp_path.iterdir()] == ["run.mcap"]
    hold(text.splitlines(), found.splitlines())


def test_every_command_has_its_help_frozen() -> None:
    files = {path.name for path in (golden.GOLDEN / "help").iterdir()}
    assert files == {golden.help_file(name).name for name in golden.COMMANDS}


def test_a_difference_fails_here_and_is_skipped_with_a_reason_on_another_machine(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    machine = frozen(golden.MACHINE)
    monkeypatch.setattr(golden, "machine", lambda: machine)
    hold({"tick": "a"}, {"tick": "a"})
    with pytest.raises(pytest.fail.Exception, match="tick: 'a' -> 'b'"):
        hold({"tick": "a"}, {"tick": "b"})
    monkeypatch.setattr(golden, "machine", lambda: machine | {"mujoco": "5.0"})
    hold({"tick": "a"}, {"tick": "a"})
    with pytest.raises(pytest.skip.Exception, match=r"mujoco .*, here 5\.0"):
        hold({"tick": "a"}, {"tick": "b"})
