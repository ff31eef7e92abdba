"""``hapticbridge view`` and ``hapticbridge render``."""

from __future__ import annotations

import contextlib
import threading
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated

import tyro

from hapticbridge.cli.terminal import err, notify, out, plain, progress
from hapticbridge.errors import RecordingError
from hapticbridge.files import atomic_write
from hapticbridge.film import Shot, draw
from hapticbridge.recording import read_recording
from hapticbridge.view import Address
from hapticbridge.view.window import check_view


@dataclass(frozen=True, slots=True)
class View:
    """Show a recorded run in a browser.

    The page has the scene, the coupling, curves and a slider for the time. It is there until
    Ctrl-C. Needs the extra 'view'. With --save it is written to one file that plays the run in any
    browser, to send to others.

    Examples:
        hapticbridge view run.mcap
        hapticbridge view run.mcap --save run.html
    """

    file: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE")]
    """The recording (.mcap)."""
    port: int = 8080
    """Port on this machine, where only the printed address gets in; 0: any that is free. From
    another machine: ssh -L 8080:localhost:8080 MACHINE, then open the printed address there."""
    save: Path | None = None
    """Write the scene in motion to this page (.html) and end; it needs no server and no network."""
    overwrite: bool = False
    """Replace the page of --save if the file exists."""

    in_process: bool = False
    """Simulate in this process, for a recording of a known origin: without the child process whose
    memory and time are limited."""

    def execute(self) -> int:
        """Serves the page; returns the exit code."""
        check_view()
        if self.save is not None:
            self._check_page(self.save)
        address = Address(0 if self.save is not None else self.port)
        from hapticbridge.view.replay import Replay, Theatre  # noqa: PLC0415 - of an extra

        with progress("simulating again") as show:
            replay = Replay(self.file, show, in_process=self.in_process)
        theatre = Theatre(replay, address)
        if self.save is not None:
            with err.status("writing …"), atomic_write(self.save) as draft:
                draft.write_text(theatre.page(), encoding="utf-8")
            theatre.close()
            out.print(f"wrote {plain(str(self.save))}")
            return 0
        notify(f"view: {theatre.url}")
        with contextlib.suppress(KeyboardInterrupt):
            theatre.play(threading.Event())
        theatre.close()
        return 0

    def _check_page(self, path: Path) -> None:
        if path.suffix.lower() != ".html":
            raise RecordingError(f"--save is '{path}'; the page must end in .html")
        if path.exists() and not self.overwrite:
            raise RecordingError(f"'{path}' exists; choose another file or add --overwrite")
        if not path.absolute().parent.is_dir():
            raise RecordingError(f"'{path}' cannot be written: its folder does not exist")


@dataclass(frozen=True, slots=True)
class Render:
    """Draw a recorded run: a picture, or a film of it.

    No display is needed: EGL or OSMesa draws, and MUJOCO_GL chooses between them. The handle is a
    ghost, the coupling a line that turns red with the force on the tool. The orange arrow is the
    force on the hand, turquoise ones are contact forces.

    Examples:
        hapticbridge render run.mcap run.png --at 2.5
        hapticbridge render run.mcap run.mp4
        hapticbridge render run.mcap slow.mp4 --start 2 --stop 3 --speed 0.1
    """

    file: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE")]
    """The recording (.mcap)."""
    output: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUTPUT")]
    """The picture (.png), or the film (.mp4, extra 'view')."""
    at: float | None = None
    """Time of a picture in s from the start of the run; by default that of the largest force."""
    start: float = 0.0
    """Start of a film in s of the run."""
    stop: float | None = None
    """End of a film in s of the run; by default the run's end."""
    speed: float = 1.0
    """Speed of a film: 0.1 shows a second of the run in ten."""
    camera: str | None = None
    """A camera of the scene, by name; by default the free one, as the scene's file sets it."""
    width: int = 800
    """Width in pixels, even."""
    height: int = 600
    """Height in pixels, even."""
    fps: int = 30
    """Frames per second of a film."""
    overwrite: bool = False
    """Replace the picture or film if the file exists."""

    in_process: bool = False
    """Simulate without limits on memory and time, for a recording of a known origin."""

    def execute(self) -> int:
        """Draws; returns the exit code."""
        if self.output.exists() and not self.overwrite:
            raise RecordingError(f"'{self.output}' exists; choose another file or add --overwrite")
        shot = Shot(**{field.name: getattr(self, field.name) for field in fields(Shot)})
        if self.at is None and self.output.suffix.lower() == ".png":
            from hapticbridge.report import telling_time  # noqa: PLC0415 - imports matplotlib

            shot = replace(shot, at=telling_time(read_recording(self.file, 0)))
        with progress("drawing") as show:
            renderer = draw(self.file, self.output, shot, show, in_process=self.in_process)
        out.print(f"wrote {plain(str(self.output))} (drawn with {renderer})")
        return 0
