"""The guide does what it says: every command, program, link and picture in it."""

from __future__ import annotations

import importlib
import importlib.util
import re
import shlex
import sys
from pathlib import Path

import pytest
from cli_cases import Called

from hapticbridge.cli import main
from hapticbridge.cli.guide import FOLDER, TOPICS, page
from hapticbridge.kernel.record import TICK_DTYPE, TickFlag

ROOT = Path(__file__).parents[1]

ALL = [topic for topics in TOPICS.values() for topic in topics]

BLOCK = re.compile(r"^```(\w+)\n(.*?)^```", flags=re.DOTALL | re.MULTILINE)
"""A code block and its language: ``sh`` and ``python`` are executed, ``bash`` on a simulated
device, ``console`` is executed and compared; ``xml``, ``toml`` and ``text`` are shown alone."""

OTHERS = {"ssh", "sudo"}
"""Programs in the guide that are not ours. Those that make files for later commands are run."""


@pytest.fixture
def workplace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").mkdir()
    (tmp_path / "study").mkdir()
    return tmp_path


def expected_codes(line: str) -> tuple[int, ...]:
    """Returns the exit codes that a line's comment allows, such as ``# exit 0 or 1``."""
    comment = re.search(r"# exit ([0-9]+)(?: or ([0-9]+))?$", line)
    return tuple(int(code) for code in comment.groups() if code) if comment else (0,)


def check_command(line: str, *, device: str | None = None) -> None:
    """Runs a line of a shell block and compares its exit code."""
    if device is not None:
        line = line.replace("NAME", device).partition("|")[0]
    words = shlex.split(line, comments=True)
    if not words or words[0] in OTHERS:
        return
    assert words[0] == "hapticbridge", line
    if words[1] == "run" and "--fast" not in words:
        words += ["--fast", "--duration", "0.2"]
    assert main(words[1:]) in expected_codes(line), line


def check_session(session: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Runs the commands of a session and compares what they print, numbers within 2 %."""
    capsys.readouterr()
    for exchange in session.split("$ ")[1:]:
        command, _, shown = exchange.partition("\n")
        check_command(command)
        printed = capsys.readouterr().out.split()
        for word, expected in zip(printed, shown.split(), strict=True):
            number = re.fullmatch(r"\(?(-?[0-9.]+)", expected)
            if number:  # another processor may round the last digit differently
                assert float(word.lstrip("(")) == pytest.approx(float(number[1]), rel=0.02)
            else:
                assert word == expected


@pytest.mark.parametrize("topic", ALL)
def test_every_command_and_program_of_a_page_works(
    topic: str,
    workplace: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.syspath_prepend(workplace)
    for count, (language, block) in enumerate(BLOCK.findall(page(topic))):
        if language == "console":
            check_session(block, capsys)
        elif language == "python":
            name = f"page_{topic.replace('-', '_')}_{count}"
            Path(f"{name}.py").write_text(block, encoding="utf-8")
            monkeypatch.setitem(sys.modules, name, None)  # is taken out again
            del sys.modules[name]
            importlib.import_module(name)
        elif language in ("sh", "bash"):
            device = "simulated:hand=none" if language == "bash" else None
            for line in block.splitlines():
                check_command(line, device=device)
        elif language == "xml":
            (name,) = re.findall(r'<mujoco model="(\w+)">', block)
            Path(f"{name}.xml").write_text(block, encoding="utf-8")
        else:
            assert language in ("text", "toml"), language


def test_every_page_has_a_topic() -> None:
    assert {path.stem.replace("_", "-") for path in FOLDER.glob("*.md")} == set(ALL)


@pytest.mark.parametrize("topic", ALL)
def test_a_page_points_to_topics_files_and_modules_that_exist(topic: str) -> None:
    text = page(topic)
    assert text.startswith("# ")
    for named in re.findall(r"hapticbridge guide\s+([a-z][a-z-]*)", text):
        assert named in ALL, named
    for named in re.findall(r"`((?:scripts|tests)/[a-z_./]+)", text):
        assert (ROOT / named).exists(), named


def test_the_reference_lists_every_field_and_flag() -> None:
    text = page("recording-format")
    for name in TICK_DTYPE.names or ():
        assert f"`{name}`" in text, name
    for flag in TickFlag:
        assert f"| {flag.value} | {flag.name} |" in text, flag


def test_the_glossary_is_sorted() -> None:
    words = re.findall(
        r"^\| ([^|]+?) \|", page("glossary").partition("## ")[0], flags=re.MULTILINE
    )[1:]
    assert words == sorted(words, key=str.lower)
    assert len(words) > 20


def test_the_command_lists_topics_and_prints_a_page(call: Called) -> None:
    code, out, _ = call("guide")
    assert code == 0
    assert all(topic in out for topic in ALL)
    code, out, _ = call("guide", "first-run")
    assert (code, out) == (0, page("first-run"))


@pytest.mark.parametrize(
    ("topic", "advice"),
    [
        ("passiv", "did you mean 'passivity'"),
        ("tank", "the word is explained in 'glossary'"),
        ("motor", "the word is explained in 'active-verdict'"),
        ("../../etc", "choose one of 'active-verdict', "),
    ],
)
def test_a_wrong_topic_is_one_sentence(call: Called, topic: str, advice: str) -> None:
    code, out, err = call("guide", topic)
    assert (code, out) == (2, "")
    assert advice in err


def test_the_reference_of_the_site_names_classes_and_functions_that_exist() -> None:
    script = ROOT / "scripts" / "build_docs.py"
    spec = importlib.util.spec_from_file_location("build_docs", script)
    assert spec is not None and spec.loader is not None
    builder = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(builder)
    for names in builder.INTERFACE.values():
        for name in names:
            module, _, member = f"hapticbridge.{name}".rpartition(".")
            assert getattr(importlib.import_module(module), member).__doc__, name
