"""The entry point: which command, and what an error looks like."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from typing import Annotated, TextIO

import mujoco
import tyro
from rich.markup import escape

from hapticbridge.cli.bound import Bound
from hapticbridge.cli.chart import ChartCommand
from hapticbridge.cli.check import Check
from hapticbridge.cli.data import Compare, Export
from hapticbridge.cli.devices import Devices
from hapticbridge.cli.doctor import Doctor
from hapticbridge.cli.identify import Identify
from hapticbridge.cli.judge import Audit, Repair
from hapticbridge.cli.render import Render
from hapticbridge.cli.run import Run
from hapticbridge.cli.scenes import Scenes
from hapticbridge.cli.stability import Stability
from hapticbridge.cli.terminal import err, out, print_error
from hapticbridge.cli.view import View
from hapticbridge.cli.zwidth import Zwidth
from hapticbridge.errors import HapticBridgeError, SafetyTrip
from hapticbridge.guard import with_remedy

Command = (
    Annotated[Run, tyro.conf.subcommand("run")]
    | Annotated[Audit, tyro.conf.subcommand("audit")]
    | Annotated[Render, tyro.conf.subcommand("render")]
    | Annotated[View, tyro.conf.subcommand("view")]
    | Annotated[Scenes, tyro.conf.subcommand("scenes")]
    | Annotated[Devices, tyro.conf.subcommand("devices")]
    | Annotated[Check, tyro.conf.subcommand("check")]
    | Annotated[Stability, tyro.conf.subcommand("stability")]
    | Annotated[ChartCommand, tyro.conf.subcommand("chart")]
    | Annotated[Doctor, tyro.conf.subcommand("doctor")]
    | Annotated[Export, tyro.conf.subcommand("export")]
    | Annotated[Compare, tyro.conf.subcommand("compare")]
    | Annotated[Repair, tyro.conf.subcommand("repair")]
    | Annotated[Zwidth, tyro.conf.subcommand("zwidth")]
    | Annotated[Bound, tyro.conf.subcommand("bound")]
    | Annotated[Identify, tyro.conf.subcommand("identify")]
)

USAGE_ERROR, SAFETY_TRIP = 2, 3


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs ``hapticbridge``; returns the exit code.

    0 done, 1 done with a negative verdict, 2 bad input or usage, 3 safety trip, 130 interrupted.
    """
    if (sys.argv[1:] if arguments is None else list(arguments)) == ["--version"]:
        out.print(f"hapticbridge {version('hapticbridge')}, MuJoCo {mujoco.mj_versionString()}")
        return 0
    try:
        command = tyro.cli(
            Command,
            prog="hapticbridge",
            description="Feel a MuJoCo scene through a haptic device.",
            args=arguments,
            config=(
                tyro.conf.OmitSubcommandPrefixes,
                tyro.conf.FlagCreatePairsOff,
                tyro.conf.DisallowNone,
            ),
        )
        with _warnings_in_a_sentence():
            return int(command.execute())
    except SafetyTrip as trip:
        err.print(f"[red]safety trip:[/red] {escape(with_remedy(str(trip)))}")
        return SAFETY_TRIP
    except HapticBridgeError as error:
        print_error(error)
        return USAGE_ERROR
    except BrokenPipeError:  # 'hapticbridge --help | head': nobody reads any more
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # what is left goes nowhere
        return 1
    except KeyboardInterrupt:
        err.print("interrupted")
        return 130


@contextmanager
def _warnings_in_a_sentence() -> Iterator[None]:
    """Prints Python's and MuJoCo's warnings; MuJoCo would write MUJOCO_LOG.TXT beside the user."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(_tell)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _show_warning  # type: ignore[assignment] # names differ
            yield
    finally:
        mujoco.set_mju_user_warning(before)


def _tell(message: str) -> None:
    err.print(f"[yellow]MuJoCo warns:[/yellow] {escape(message)}")


def _show_warning(
    message: Warning | str,
    category: type[Warning],
    _filename: str,
    _lineno: int,
    _file: TextIO | None = None,
    _line: str | None = None,
) -> None:
    if issubclass(category, UserWarning):
        err.print(f"[yellow]warning:[/yellow] {escape(str(message))}")
