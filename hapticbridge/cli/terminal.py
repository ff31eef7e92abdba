"""Consoles of the command line: one for results, one for everything else."""

from __future__ import annotations

import json
import os
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.markup import escape

from hapticbridge.errors import SceneError
from hapticbridge.files import finite_or_null, printable

if TYPE_CHECKING:
    from matplotlib.figure import Figure

out = Console(highlight=False, soft_wrap=True)
"""Results, on stdout."""

err = Console(stderr=True, highlight=False, soft_wrap=True)
"""Progress, warnings and errors, on stderr, so that a pipe gets results alone."""


REPRINT = 2.0
"""Time in s between two plain lines of progress."""


def plain(text: str) -> str:
    """Returns text from a file or a user as it can be printed.

    What it holds is taken neither as the console's markup nor as control codes of the terminal.
    """
    return escape(printable(text))


def notify(sentence: str) -> None:
    """Prints what the user should know or do while a device is opened, on stderr."""
    err.print(plain(sentence))


def print_error(error: object, what: str = "error") -> None:
    """Prints what went wrong on stderr, in one line that begins with ``what``."""
    err.print(f"[red]{what}:[/red] {plain(' '.join(str(error).splitlines()))}")


@contextmanager
def compiling(scene: str) -> Iterator[None]:
    """Bounds memory and time while a scene is read and compiled; ends the program beyond them."""
    from hapticbridge.confinement import bounded_here  # noqa: PLC0415 - for scenes alone

    def end(clause: str) -> None:
        print_error(f"scene '{scene}' {clause}")
        os._exit(2)

    with bounded_here(end):
        yield


@contextmanager
def warnings_in_a_sentence() -> Iterator[None]:
    """Prints Python's and MuJoCo's warnings; MuJoCo would write MUJOCO_LOG.TXT beside the user.

    Raises:
        SceneError: MuJoCo stopped, for example because its stack is full.
    """
    import mujoco  # noqa: PLC0415 - messages of the command line itself need none

    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(_print_mujoco_warning)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _show_warning  # type: ignore[assignment] # names differ
            yield
    except mujoco.FatalError as error:
        raise SceneError(f"MuJoCo stopped: {' '.join(str(error).split())}") from None
    finally:
        mujoco.set_mju_user_warning(before)


def _print_mujoco_warning(message: str) -> None:
    err.print(f"[yellow]MuJoCo warns:[/yellow] {plain(' '.join(message.splitlines()))}")


def _show_warning(message: Warning | str, category: type[Warning], *_: object) -> None:
    if issubclass(category, UserWarning):
        err.print(f"[yellow]warning:[/yellow] {escape(str(message))}")


@contextmanager
def working(words: str) -> Iterator[None]:
    """Names work while it is done, on stderr: at once on a terminal, else once if it takes long.

    Args:
        words: Description of the work, as the console's markup.
    """
    if err.is_terminal:
        with err.status(f"{words} …"):
            yield
        return
    timer = threading.Timer(REPRINT, err.print, (f"{words} …",))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


@contextmanager
def progress(words: str, *, is_counted: bool = False) -> Iterator[Callable[..., None]]:
    """Shows a bar on stderr; yields a function of the work done, the whole work and a name.

    Without a terminal there is no bar but a plain line every ``REPRINT`` seconds, as in a run.

    Args:
        words: Description of the work.
        is_counted: True shows the work done and the whole work as numbers, too.
    """
    from rich.progress import (  # noqa: PLC0415 - a run shows none
        BarColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    count = [TextColumn("{task.completed}/{task.total}")] if is_counted else []
    columns = TextColumn("{task.description}"), BarColumn(), *count, TimeRemainingColumn()
    with Progress(*columns, console=err, transient=True, disable=not err.is_terminal) as bar:
        task, printed = bar.add_task(words, total=None), time.monotonic()

        def show(done: int, total: int, name: str = "") -> None:
            description = f"{words}: {plain(name)}" if name else words
            bar.update(task, completed=done, total=total, description=description)
            nonlocal printed
            if not err.is_terminal and time.monotonic() - printed >= REPRINT:
                printed = time.monotonic()
                err.print(f"{description}  {100 * done / total:.0f} %")

        yield show


def write_figure(figure: Figure, path: Path) -> None:
    """Writes a picture and says so on stderr."""
    from hapticbridge.plotting import write_picture  # noqa: PLC0415 - imports matplotlib

    with working("drawing"):
        write_picture(figure, path)
    print_written(path)


def print_written(*paths: Path | None) -> None:
    """Names files that were written, on stderr; None is left out."""
    for path in filter(None, paths):
        err.print(f"wrote {plain(str(path))}")


def print_json(facts: object) -> None:
    """Prints facts as JSON on stdout, with null in place of numbers that JSON does not have."""
    out.print_json(json.dumps(finite_or_null(facts), allow_nan=False))
