"""Entry point of the command line: table of commands, their help, exit codes and error messages.

Commands import seconds' worth of libraries. ``main`` therefore imports a command's module when that
command is called, and none for ``--version`` and ``--help``.
"""

from __future__ import annotations

import errno
import importlib
import io
import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hapticbridge.errors import HapticBridgeError, SafetyTrip, nearest
from hapticbridge.signals import (
    ENDING_SIGNALS,
    interrupting_on_signals,
    leaving_on_signals,
    stop_words,
)

DONE, READER_GONE, USAGE_ERROR, SAFETY_TRIP = 0, 1, 2, 3


COMMANDS = {
    "guide": "Read how to do something, and why it works.",
    "run": "Put a scene behind a haptic device and feel it.",
    "serve": "Run a device's loop for another program, which steps the scene.",
    "scenes": "List the scenes, or the parameters of one.",
    "new-scene": "Write a commented scene to start from.",
    "check": "Find what is wrong with a scene, and what a tick of it costs.",
    "audit": "Judge recorded runs offline: passive, active, unverified, and why.",
    "view": "Show a recorded run in a browser.",
    "render": "Draw a recorded run: a picture, or a film of it.",
    "compare": "Find the first tick and field where two runs differ.",
    "export": "Write a recording as a table, for a viewer or to learn from.",
    "repair": "Make a whole file of a recording that a crash cut.",
    "devices": "List the haptic devices plugged in and supported.",
    "identify": "Measure a device's mass, damping, friction, resolution and delay.",
    "doctor": "Measure whether this machine holds the loop's rate.",
    "bound": "Compute the device damping that a coupling needs.",
    "zwidth": "Compute the stiffness and damping that a device can show.",
    "stability": "Map where ways to render a tool lose passivity or stability.",
    "chart": "Chart the cost of ways to simulate a scene against their error.",
}
"""Summary of each command, in the order of the top-level help: the first line of the command's
class, without importing it. The class has the command's name, each word with a capital."""

_HEADINGS = {"run": "Scenes", "audit": "Recordings", "devices": "Devices and theory"}
"""Headings of the top-level help, by the command below."""

_MODULES = {
    "new-scene": "scenes",
    "compare": "recordings",
    "export": "recordings",
    "repair": "audit",
    "view": "recordings",
    "render": "recordings",
    "doctor": "devices",
    "bound": "zwidth",
    "stability": "chart",
}
"""Modules of commands that share one; any other command has a module of its name."""

_FULL = (errno.ENOSPC, errno.EFBIG, errno.EDQUOT)
"""Errors of a full disk, a file over its limit, a user over quota. They name no file."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs ``hapticbridge``; returns the exit code.

    0 done, 1 done with a negative verdict, 2 bad input or usage, 3 safety trip, 130 interrupted,
    143 and 129 stopped by SIGTERM and SIGHUP.

    Args:
        arguments: Words after the program's name; None takes those of the process.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    _prepare_output()
    try:
        if words[:1] == ["--version"]:
            code = _print_version()
        elif not words or words[0] in {"-h", "--help", "--help-all"}:
            print(_top_level_help(), file=sys.stdout if words else sys.stderr, flush=True)
            code = DONE if words else USAGE_ERROR
        elif words[0] not in COMMANDS:
            code = _refuse(words[0])
        else:
            _check_limits()
            code = _execute(words[0], words[1:])
    except KeyboardInterrupt as interrupt:
        sentence, code = stop_words(getattr(interrupt, "number", signal.SIGINT))
        print(sentence, file=sys.stderr)
    except SafetyTrip as trip:
        parts = str(trip), *getattr(trip, "__notes__", ())
        code = _say("safety trip", "; ".join(parts), SAFETY_TRIP)
    except HapticBridgeError as error:
        code = _say("error", error)
    except BrokenPipeError:  # as in 'hapticbridge --help | head'
        _discard_output()
        code = READER_GONE
    except (MemoryError, ImportError, OSError, RuntimeError) as error:
        code = _system_fault(error)
    return code


def _prepare_output() -> None:
    """Lets texts be printed and pictures be drawn, whatever terminal the environment states.

    Python escapes on stderr what an encoding lacks, such as the µ of a unit, and fails on stdout.
    A width of 0 is that of a terminal whose width is not known; rich would print nothing.
    Pictures need no window: matplotlib would refuse to be imported for one that it does not know.
    A stream that is closed reads or writes nothing, and no other file takes its number.
    """
    os.environ["MPLBACKEND"] = "agg"
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, Path(os.devnull).open(mode))  # noqa: SIM115 - it stays
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")
    for name in ("COLUMNS", "LINES"):
        if set(os.environ.get(name, "")) == {"0"}:
            del os.environ[name]


MIN_MEMORY, MEMORY_PER_PROCESSOR = 1 << 30, 1 << 27
"""Least address space in bytes of a command, and what each processor adds to it: a run takes 835 MB
on two. With less, OpenBLAS tries for ever to get the memory of its threads (seen at 700 MB)."""


MANY_PROCESSES = 1 << 12
"""Limit of a user's processes from which on it is not tried whether enough of them can start."""


def _check_limits() -> None:
    """Refuses an address space or a number of threads with which a command cannot run.

    OpenBLAS interrupts the program where it cannot start a thread for each processor.

    Raises:
        HapticBridgeError: 'ulimit -v' or 'ulimit -u' allows too little.
    """
    if sys.platform == "win32":
        return
    import resource  # noqa: PLC0415 - for limits alone

    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    needed = MIN_MEMORY + MEMORY_PER_PROCESSOR * (os.cpu_count() or 1)
    if limit != resource.RLIM_INFINITY and limit < needed:
        raise HapticBridgeError(
            f"'ulimit -v' allows {limit / 1e6:.0f} MB of memory, and at least {needed / 1e6:.0f} "
            f"MB are needed here: 'ulimit -v {needed // 1024}' or more"
        )
    if 0 <= resource.getrlimit(resource.RLIMIT_NPROC)[0] < MANY_PROCESSES:
        _try_threads(8 + 3 * (os.cpu_count() or 1))  # numpy's, scipy's, the recorder's and ours


def _try_threads(count: int) -> None:
    ended = threading.Event()
    threads = [threading.Thread(target=ended.wait) for _ in range(count)]
    started = []
    try:
        for each in threads:
            each.start()
            started.append(each)
    finally:
        ended.set()
        for each in started:
            each.join(1.0)


_NO_THREAD = "can't start new thread"  # Python's own words


def _system_fault(error: MemoryError | ImportError | OSError | RuntimeError) -> int:
    """Says what the system refused; raises what is no fault of the system's again."""
    number = error.errno if isinstance(error, OSError) else None
    if isinstance(error, ModuleNotFoundError) and not str(error.name).startswith("hapticbridge"):
        print(  # the consoles are a package, too
            f"error: the package '{error.name}' is not in the environment of {sys.executable}. "
            "Commands need all that hapticbridge depends on; a program's side of a device loop "
            "needs NumPy alone (HAPTICBRIDGE_PYTHON names the Python with the rest)",
            file=sys.stderr,
        )
        return USAGE_ERROR
    if isinstance(error, RuntimeError):
        if str(error) != _NO_THREAD:
            raise error
        number = errno.EAGAIN
    from hapticbridge.files import folder_words, limit_words  # noqa: PLC0415 - for an error alone

    words = limit_words(number)
    if words := words or (folder_words(error) if isinstance(error, OSError) else ""):
        return _say("error", words)
    is_full = not isinstance(error, OSError) or error.errno in (None, errno.ENOMEM)
    if is_full and _is_memory_limited():
        words = " ".join(str(error).split())[:200] or "no memory"
        return _say("error", f"not enough memory, which 'ulimit -v' limits ({words})")
    if not isinstance(error, OSError) or (error.filename is None and error.errno not in _FULL):
        raise error
    if error.filename is None:
        _discard_output()
    where = "cannot write" if error.filename is None else f"'{error.filename}'"
    return _say("error", f"{where}: {error.strerror}")


def _is_memory_limited() -> bool:
    if sys.platform == "win32":
        return False
    import resource  # noqa: PLC0415 - for an error alone

    return resource.getrlimit(resource.RLIMIT_AS)[0] != resource.RLIM_INFINITY


def _execute(name: str, words: list[str]) -> int:
    kind = command_class(name)
    with interrupting_on_signals(ENDING_SIGNALS):
        command = _parsed(kind, name, words)
        if command is None:
            return DONE
        from hapticbridge.cli.terminal import warnings_in_a_sentence  # noqa: PLC0415 - rich

        with warnings_in_a_sentence():
            return int(command.execute())


def command_class(name: str) -> type[Any]:
    """Imports the command's module and returns its class."""
    try:
        with leaving_on_signals(), _without_glfw():
            module = importlib.import_module(f"hapticbridge.cli.{_MODULES.get(name, name)}")
    except RuntimeError as error:
        if "MUJOCO_GL" not in str(error):
            raise
        raise HapticBridgeError(
            f"the environment variable MUJOCO_GL is {os.environ.get('MUJOCO_GL')!r}, which MuJoCo "
            "does not know; unset it, or set it to 'egl', 'osmesa', 'glfw' or 'disable'"
        ) from None
    command: type[Any] = getattr(module, name.title().replace("-", ""))
    return command


@contextmanager
def _without_glfw() -> Iterator[None]:
    """Imports MuJoCo without GLFW, unless the user chose a renderer.

    Pictures are drawn in processes of their own. GLFW's import takes 0.1 s, in a child that asks
    for its version, and that child prints a traceback if a signal ends this process meanwhile.
    """
    is_ours = not os.environ.get("MUJOCO_GL")
    if is_ours:
        os.environ["MUJOCO_GL"] = "disable"
    try:
        yield
    finally:
        if is_ours:
            del os.environ["MUJOCO_GL"]


def _parsed(command: type[Any], name: str, words: list[str]) -> Any:
    """Returns the command with its options, or None after printing its help."""
    from hapticbridge.arguments import check_fields  # noqa: PLC0415 - not for --version
    from hapticbridge.cli import flags  # noqa: PLC0415

    if asked := {"-h", "--help", "--help-all"} & set(words):
        print(flags.help_page(command, name, is_whole="--help-all" in asked), flush=True)
        return None
    made = flags.built(command, flags.values_of(command, name, words))
    check_fields(made)
    return made


def _print_version() -> int:
    from importlib.metadata import version  # noqa: PLC0415 - for --version alone

    print(f"hapticbridge {version('hapticbridge')}, MuJoCo {version('mujoco')}", flush=True)
    return DONE


def _top_level_help() -> str:
    lines = ["Feel a MuJoCo scene through a haptic device: hapticbridge COMMAND [--help]"]
    for name, summary in COMMANDS.items():
        if name in _HEADINGS:
            lines.append(_HEADINGS[name])
        lines.append(f"  {name:<11}{summary}")
    return "\n".join(lines)


def _refuse(word: str) -> int:
    kind = "option" if word.startswith("-") else "command"
    advice = nearest(word, COMMANDS).rstrip() or "'hapticbridge --help' lists the commands"
    return _say("error", f"there is no {kind} '{word}'; {advice}")


def _say(what: str, words: object, code: int = USAGE_ERROR) -> int:
    """Prints what ended the command on stderr, in one line; returns the exit code."""
    from hapticbridge.cli.terminal import print_error  # noqa: PLC0415 - imports rich

    print_error(words, what)
    return code


def _discard_output() -> None:
    """Sends what is left of stdout nowhere; else Python would write it again at exit, and fail."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
