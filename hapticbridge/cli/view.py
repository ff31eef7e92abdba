"""``hapticbridge view``."""

from __future__ import annotations

import contextlib
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from hapticbridge.cli.terminal import notify, progress
from hapticbridge.view import Address
from hapticbridge.view.window import check_view


@dataclass(frozen=True, slots=True)
class View:
    """Show a recorded run in a browser.

    The page has the scene, the coupling, curves and a slider for the time. It is there until
    Ctrl-C. Needs the extra 'view'.

    Example:
        hapticbridge view run.mcap
    """

    file: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE")]
    """The recording (.mcap)."""
    port: int = 8080
    """Port on this machine, where only the printed address gets in; 0: any that is free. From
    another machine: ssh -L 8080:localhost:8080 MACHINE, then open the printed address there."""

    in_process: bool = False
    """Simulate in this process, for a recording of a known origin: without the child process whose
    memory and time are limited."""

    def execute(self) -> int:
        """Serves the page; returns the exit code."""
        check_view()
        address = Address(self.port)
        from hapticbridge.view.replay import Replay, Theatre  # noqa: PLC0415 - of an extra

        with progress("simulating again") as show:
            replay = Replay(self.file, show, in_process=self.in_process)
        theatre = Theatre(replay, address)
        notify(f"view: {theatre.url}")
        with contextlib.suppress(KeyboardInterrupt):
            theatre.play(threading.Event())
        theatre.close()
        return 0
