"""Which command, and what an error looks like."""

from __future__ import annotations

import errno
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
from hapticbridge.cli.main import USAGE_ERROR
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

SAFETY_TRIP = 3

_FULL = (errno.ENOSPC, errno.EFBIG, errno.EDQUOT)
"""What the system says where no more can be written."""


def dispatch(arguments: Sequence[str] | None) -> int:
    """Runs a command; returns the exit code, as ``main`` documents it."""
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
        _forget_output()
        return 1
    except OSError as error:  # a name that is too long, a full disk: the system says it best
        if error.filename is None and error.errno not in _FULL:
            raise
        if error.filename is None:
            _forget_output()
        where = "cannot write" if error.filename is None else f"'{error.filename}'"
        print_error(HapticBridgeError(f"{where}: {error.strerror}"))
        return USAGE_ERROR


def _forget_output() -> None:
    """Lets what is left to print go nowhere; Python would try again at its end, and fail."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


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
