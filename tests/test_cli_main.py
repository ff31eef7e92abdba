"""The command line: imports of a command, its entry in the table, refusals, and its end."""

from __future__ import annotations

import contextlib
import importlib
import inspect
import os
import re
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import mujoco
import pytest
from cli_cases import Called, one_sentence

from hapticbridge.cli import main, terminal
from hapticbridge.cli.flags import flags_of
from hapticbridge.cli.main import COMMANDS, command_class
from hapticbridge.signals import StopSignal, interrupting_on_signals, leaving_on_signals

HEAVY = frozenset({"numpy", "mujoco", "numba", "llvmlite", "scipy", "matplotlib", "rich", "mcap"})
"""Packages that neither the version nor the top-level help needs."""

NOT_FOR_A_RUN = frozenset(
    [
        "numba",
        "matplotlib",
        "scipy.signal",
        "scipy.spatial",
        "scipy.stats",
        "scipy.optimize",
        "jinja2",
        "PIL",
        "viser",
        "websockets",
        "usb",
        "hid",
        "dask",
        "pyarrow",
        "h5py",
        "http.cookies",
        "hapticbridge.device.discovery",
        "hapticbridge.device.falcon",
        "hapticbridge.device.force_dimension",
        "hapticbridge.device.haply",
        "hapticbridge.device.pid",
        "hapticbridge.device.rawhid",
        "hapticbridge.device.spacemouse",
        "hapticbridge.device.touch",
        "hapticbridge.device.transport",
        "hapticbridge.device.wheel",
        "hapticbridge.audit.verdict",
        "hapticbridge.check.lean",
        "hapticbridge.check.cost",
        "hapticbridge.realtime.doctor",
        "hapticbridge.replay.film",
        "glfw",
        "hapticbridge.identify",
        "hapticbridge.demand.plots",
        "hapticbridge.plotting",
        "hapticbridge.report",
        "hapticbridge.lab",
        "hapticbridge.view",
        "hapticbridge.whatif",
    ]
)
"""Packages and modules that a run with the simulated device, without view, does not need."""

LOADED = """
import sys
from hapticbridge.cli import main
try:
    code = main(sys.argv[1:])
finally:
    print("loaded:", *sys.modules, file=sys.stderr)
sys.exit(code)
"""
"""Runs a command and lists the modules that are imported by its end."""

INTERRUPTED = """
import builtins, os, signal, sys

from hapticbridge.cli import main

usual = builtins.__import__


def interrupting(name, *rest, **named):
    if name == "mujoco":
        os.kill(os.getpid(), int(sys.argv[1]))
    return usual(name, *rest, **named)


builtins.__import__ = interrupting
sys.exit(main(["scenes"]))
"""
"""A signal in the middle of the imports."""


def loaded_by(*arguments: str) -> set[str]:
    """Returns the modules that a command imports."""
    command = [sys.executable, "-c", LOADED, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return set(done.stderr.split("loaded:")[1].split())


@pytest.mark.parametrize("flag", ["--version", "--help"])
def test_version_and_help_import_nothing_heavy(flag: str) -> None:
    assert not HEAVY & loaded_by(flag)


def test_a_run_imports_nothing_that_it_does_not_use() -> None:
    for _ in range(2):  # the first run on a machine compiles
        loaded = loaded_by("run", "point_mass", "--fast", "--duration", "0.01")
    assert "hapticbridge.run.bridge" in loaded
    assert not NOT_FOR_A_RUN & loaded


@pytest.mark.parametrize("name", sorted(NOT_FOR_A_RUN - {"viser", "dask", "hid"}))
def test_what_a_run_must_not_import_exists(name: str) -> None:
    """A module that was renamed would no longer be watched."""
    assert importlib.util.find_spec(name) is not None


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_has_the_summary_of_the_table_and_a_dozen_first_options(name: str) -> None:
    documentation = inspect.getdoc(command_class(name))
    assert documentation is not None
    assert documentation.splitlines()[0] == COMMANDS[name]
    flags = flags_of(command_class(name))
    names = {flag.rule.flag or flag.path[-1] for flag in flags}
    first = getattr(command_class(name), "FIRST_OPTIONS", names)
    assert set(first) <= names
    assert len(first) <= 12 or first is names


def test_the_top_level_help_fits_one_screen(call: Called) -> None:
    code, out, _ = call("--help")
    lines = out.splitlines()
    assert code == 0
    assert len(lines) < 24  # the prompt has the last line
    assert max(map(len, lines)) < 80
    for name, summary in COMMANDS.items():
        assert re.search(rf"^  {name} +{re.escape(summary)}$", out, flags=re.MULTILINE)


@pytest.mark.parametrize("value", ["nonsense", "[red]\n"])
def test_a_renderer_that_mujoco_does_not_know_is_one_sentence(value: str) -> None:
    command = [sys.executable, "-m", "hapticbridge", "scenes"]
    environment = os.environ | {"MUJOCO_GL": value}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"error: the environment variable MUJOCO_GL is {value!r}")
    assert "'disable'" in line


WORDS = {
    "SIGINT": (130, "interrupted\n"),
    "SIGTERM": (143, "stopped by SIGTERM\n"),
    "SIGHUP": (129, "stopped by SIGHUP\n"),
}


@pytest.mark.parametrize("name", WORDS)
def test_a_signal_while_it_imports_is_one_sentence_and_its_exit_code(name: str) -> None:
    command = [sys.executable, "-c", INTERRUPTED, str(int(signal.Signals[name]))]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (WORDS[name][0], "", WORDS[name][1])


@pytest.mark.parametrize(
    ("number", "usual"),
    [(signal.SIGINT, signal.default_int_handler), (signal.SIGTERM, signal.SIG_DFL)],
)
def test_a_handler_that_is_not_pythons_own_is_kept(number: int, usual: Any) -> None:
    def kept(_number: int, _frame: object) -> None: ...

    before = signal.signal(number, kept)
    try:
        with leaving_on_signals():
            assert signal.getsignal(number) is kept
        signal.signal(number, usual)
        with leaving_on_signals():
            assert signal.getsignal(number) is not usual
        assert signal.getsignal(number) is usual
    finally:
        signal.signal(number, before)


@pytest.mark.parametrize(
    "where", ["hapticbridge.cli.flags.values_of", "hapticbridge.cli.chart.run_map"]
)
def test_ctrl_c_is_one_word_and_exit_code_130(
    where: str, call: Called, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_arguments: object, **_named: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(where, interrupted)
    code, out, err = call("stability", "rate")
    assert (code, out, err.strip()) == (130, "", "interrupted")


def test_calling_the_command_line_leaves_warnings_as_they_were(call: Called) -> None:
    import warnings

    before = warnings.showwarning
    call("scenes")
    assert warnings.showwarning is before


def test_version_names_the_package_and_mujoco(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert f"MuJoCo {mujoco.mj_versionString()}" in capsys.readouterr().out


def test_a_name_that_is_too_long_for_the_system_is_refused(call: Called) -> None:
    for command in (("run", "point_mass", "--fast", "--record"), ("repair", "x.mcap")):
        code, _, err = call(*command, "x" * 300 + ".mcap")
        assert code == 2
        one_sentence(err)


def test_results_that_nobody_has_room_for_are_one_sentence() -> None:
    command = [sys.executable, "-m", "hapticbridge", "bound", "--stiffness", "100"]
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 2
    assert one_sentence(done.stderr) == "error: cannot write: No space left on device"


@pytest.mark.skipif(sys.platform == "win32", reason="no shell that closes a stream")
def test_a_closed_stream_changes_no_result(tmp_path: Path) -> None:
    """As of a service, or of a program without a terminal."""
    run = ("run", "point_mass", "--fast", "--duration", "0.02", "--overwrite", "--record")
    for words in ((*run, str(tmp_path / "a.mcap")), ("audit", str(tmp_path / "a.mcap"))):
        for closed in ("1", "2", "0", "0,1,2"):
            closing = " ".join(f"{number}>&-" for number in closed.split(","))
            command = ["sh", "-c", f'exec "$@" {closing}', "sh", sys.executable, "-m"]
            done = subprocess.run(
                [*command, "hapticbridge", *words], capture_output=True, text=True, check=False
            )
            assert done.returncode == 0, (words, closed, done.stderr)
            assert bool(done.stdout) == ("1" not in closed)
            assert "Traceback" not in done.stderr


PRINTED = {
    "PYTHONIOENCODING=ascii": "2 \\xb5m wide",
    "PYTHONIOENCODING=latin-1": "2 µm wide",
    "COLUMNS=0": "2 µm wide",
    "COLUMNS=10": "2 µm wide",
}
"""Words on stdout, by the encoding or width that the terminal states."""


@pytest.mark.parametrize("setting", PRINTED)
def test_results_are_printed_whatever_the_terminal_states(setting: str, tmp_path: Path) -> None:
    about = "<custom><text name='about' data='2 µm wide'/></custom>"
    body = "<worldbody><body><freejoint/><geom size='1'/></body></worldbody>"
    (tmp_path / "a.xml").write_text(f"<mujoco>{about}{body}</mujoco>", encoding="utf-8")
    command = [sys.executable, "-m", "hapticbridge", "scenes", str(tmp_path / "a.xml")]
    name, _, value = setting.partition("=")
    environment = os.environ | {"PYTHONIOENCODING": "utf-8"} | {name: value}
    done = subprocess.run(command, env=environment, capture_output=True, check=False)
    encoding = "utf-8" if name == "COLUMNS" else value
    assert (done.returncode, done.stderr) == (0, b"")
    assert PRINTED[setting] in done.stdout.decode(encoding)


@pytest.mark.parametrize("setting", ["backend: nonsense", "text.usetex: True", "MPLBACKEND"])
def test_pictures_are_drawn_with_the_users_settings_or_what_fails_is_told(
    setting: str, tmp_path: Path
) -> None:
    (tmp_path / "rc").write_text("" if setting == "MPLBACKEND" else setting)
    picture = tmp_path / "a.png"
    words = ["zwidth", "--damping", "2", "--plot", str(picture)]
    environment = os.environ | {"MATPLOTLIBRC": str(tmp_path / "rc"), "PATH": ""}
    environment |= {"MPLBACKEND": "nonsense"} if setting == "MPLBACKEND" else {}
    command = [sys.executable, "-m", "hapticbridge", *words]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert "Traceback" not in done.stderr
    if setting == "text.usetex: True":
        assert (done.returncode, picture.exists()) == (2, False)
        sentence = f"set text.usetex: False in '{tmp_path / 'rc'}'"
        assert one_sentence(done.stderr).endswith(sentence)
    else:
        assert (done.returncode, picture.exists()) == (0, True)


@pytest.mark.parametrize("command", ["bound", "run"])
def test_help_does_not_need_the_docstrings_that_python_drops(command: str, call: Called) -> None:
    words = [sys.executable, "-OO", "-m", "hapticbridge", command, "--help-all"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == call(command, "--help-all")[1]


@pytest.mark.parametrize(
    "words",
    ["run point_mass --fast --duration 0.01 --record a.mcap", "new-scene mine", "serve --port 0"],
)
def test_a_current_folder_that_was_removed_is_the_reason(tmp_path: Path, words: str) -> None:
    script = f"import os; os.chdir({str(tmp_path)!r}); os.rmdir(os.getcwd()); " + LOADED
    command = [sys.executable, "-P", "-c", script, *words.split()]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert one_sentence(done.stderr.partition("loaded:")[0]).endswith(
        ": the current folder was removed; change to another one"
    )


@pytest.mark.parametrize("content", [None, b"", b"hello"])
def test_what_is_no_recording_is_refused_in_one_sentence(
    content: bytes | None, call: Called, tmp_path: Path
) -> None:
    path = tmp_path / "[red]what.mcap"
    if content is not None:
        path.write_bytes(content)
    for command in (("audit", path), ("repair", path, tmp_path / "out.mcap")):
        code, out, err = call(*command)
        assert (code, out) == (2, "")
        assert "[red]what.mcap" in one_sentence(err)


@pytest.mark.parametrize(
    "arguments",
    [(), ("frobnicate",), ("run",), ("run", "point_mass", "--bogus"), ("audit", "x", "--bogus")],
)
def test_wrong_usage_is_exit_code_2_without_a_traceback(
    arguments: tuple[str, ...], call: Called
) -> None:
    code, out, err = call(*arguments)
    assert (code, out) == (2, "")
    assert err and "Traceback" not in err


def test_help_into_a_reader_that_went_away_ends_without_a_traceback() -> None:
    command = [sys.executable, "-m", "hapticbridge", "--help"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdout is not None
    process.stdout.close()
    _, told = process.communicate(timeout=120)
    assert process.returncode == 1
    assert told == b""


def test_a_second_signal_does_not_interrupt_the_release_that_the_first_one_began() -> None:
    released = False
    with pytest.raises(StopSignal), interrupting_on_signals():
        try:
            signal.raise_signal(signal.SIGTERM)
        finally:
            signal.raise_signal(signal.SIGINT)
            released = True
    assert released


def test_a_release_that_a_busy_machine_stretches_is_not_interrupted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("hapticbridge.signals.RELEASE_TIME", 0.1)
    released, known = 0, set(threading.enumerate())
    with pytest.raises(StopSignal), interrupting_on_signals():
        try:
            signal.raise_signal(signal.SIGTERM)
        finally:
            with contextlib.suppress(OSError):
                raise OSError  # another error of the release hides the signal's
            begun = set(threading.enumerate()) - known  # a test before may have left timers
            timers = [each for each in begun if isinstance(each, threading.Timer)]
            for each in timers:
                each.join(60.0)
            released = sum(not each.is_alive() for each in timers)
    assert released == 1


def test_a_signal_that_a_library_swallowed_comes_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hapticbridge.signals.RELEASE_TIME", 0.1)
    with pytest.raises(StopSignal), interrupting_on_signals():
        with contextlib.suppress(StopSignal):
            signal.raise_signal(signal.SIGTERM)
        threading.Event().wait(60.0)


def test_long_work_is_named_once_where_nothing_is_animated(monkeypatch: pytest.MonkeyPatch) -> None:
    lines, has_told = list[str](), threading.Event()

    def note(words: str = "") -> None:
        if words:  # older versions of rich end a bar that was off with an empty line
            lines.append(words)
            has_told.set()

    monkeypatch.setattr(terminal.err, "print", note)
    monkeypatch.setattr(terminal, "REPRINT", 0.0)
    with terminal.working("drawing"):
        assert has_told.wait(60.0)
    assert lines == ["drawing …"]
    with terminal.progress("judging") as show:
        show(1, 4, "one run")
        monkeypatch.setattr(terminal, "REPRINT", 1e6)
        show(2, 4, "another")  # too soon for another line
    assert lines == ["drawing …", "judging: one run  25 %"]
