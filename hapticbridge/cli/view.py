"""``hapticbridge view``."""

from __future__ import annotations

import contextlib
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from hapticbridge.cli.terminal import err, plain, progress
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
    host: str = "127.0.0.1"
    """Address to serve the page on; another than this machine's own needs the token that is
    printed."""
    port: int = 8080
    """Port to serve it on; 0: any that is free."""

    def execute(self) -> int:
        """Serves the page; returns the exit code."""
        check_view()
        address = Address(self.host, self.port)
        from hapticbridge.view.replay import Replay, Theatre  # noqa: PLC0415 - of an extra

        with progress("simulating again") as show:
            replay = Replay(self.file, show)
        theatre = Theatre(replay, address)
        tell_address(address, theatre.url, "watch the recording")
        with contextlib.suppress(KeyboardInterrupt):
            theatre.play(threading.Event())
        theatre.close()
        return 0


def tell_address(address: Address, url: str, power: str) -> None:
    """Prints what to open in a browser, and what whoever has the address can do."""
    err.print(f"view: {plain(url)}")
    if not address.is_loopback:
        err.print(f"[yellow]warning:[/yellow] anyone with this address can {power}")
