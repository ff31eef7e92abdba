"""Runs, audits and printed words are what they were when ``scripts/freeze`` froze them.

Fields, words, verdicts and numbers are held to on every machine. Bits are held to where they were
frozen. Elsewhere the audit finds the bits of the live loop again, and so does the compiled sweep
(``test_lab_closed_loop``).
"""

from __future__ import annotations

import json
import operator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import golden_cases as golden
import pytest

RUNS = golden.runs()


def hold(frozen: Any, found: Any) -> None:
    """Fails where fields, words, verdicts or numbers differ, on a machine of the kind bits too."""
    then, now = json.loads(golden.MACHINE.read_text(encoding="utf-8")), golden.machine()
    is_same = operator.eq if then == now else golden.is_close
    differing = golden.difference_lines(frozen, json.loads(json.dumps(found)), is_same=is_same)
    if differing:
        other = golden.difference_lines(then, now, "machine")
        pytest.fail(
            "this differs from what 'scripts/freeze' froze; a change that is meant to change it "
            "runs that again and says why:\n" + "\n".join([*differing, *other]),
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


FROZEN = {"tick": "0123456789ab", "work": [1.0], "verdict": "passive", "buttons": "zero"}
"""Kinds of frozen values: a digest, a number, a word, and a field without a bit."""


@pytest.mark.parametrize(
    ("change", "is_of_bits"),
    [
        ({"tick": "ba9876543210"}, True),
        ({"work": [1.0 + 1e-9]}, True),
        ({"tick": "zero"}, False),
        ({"work": [1.0 + 1e-5]}, False),
        ({"work": [1.0, 1.0]}, False),
        ({"verdict": "active"}, False),
        ({"buttons": "0123456789ab"}, False),
        ({"sample_rate": 0.0}, False),
    ],
)
def test_bits_count_on_the_frozen_kind_of_machine_and_all_else_on_every_one(
    monkeypatch: pytest.MonkeyPatch, change: dict[str, Any], is_of_bits: bool
) -> None:
    kind, (name,) = frozen(golden.MACHINE), change
    for machine in (kind, kind | {"processor": "fma"}):
        monkeypatch.setattr(golden, "machine", lambda machine=machine: machine)
        hold(FROZEN, FROZEN)
        passes = is_of_bits and machine != kind
        with nullcontext() if passes else pytest.raises(pytest.fail.Exception, match=name):
            hold(FROZEN, FROZEN | change)
