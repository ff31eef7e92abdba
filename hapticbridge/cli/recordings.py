"""``hapticbridge view``, ``render``, ``export`` and ``compare``."""

from __future__ import annotations

import contextlib
import math
import threading
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

from hapticbridge.arguments import option, shared
from hapticbridge.cli.terminal import err, notify, out, plain, print_json, progress
from hapticbridge.errors import RecordingError, choices
from hapticbridge.files import atomic_write, check_target, refuse_existing
from hapticbridge.recording import RecordingFile, open_recording, read_recording
from hapticbridge.replay.film import USUAL_SHOT, Shot, draw
from hapticbridge.tools.compare import Comparison, Difference, compare
from hapticbridge.tools.dataset import DATASETS, write_dataset
from hapticbridge.tools.export import EVERYTHING, LAYOUT, Part, export, time_of
from hapticbridge.units import format_count, format_si
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

    file: Path = option(metavar="FILE", is_positional=True)
    """The recording (.mcap)."""
    port: int = shared(Address, "port")
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
        _tell_faults(open_recording(self.file, 0))
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
        check_target(path, RecordingError)
        refuse_existing(path, RecordingError, overwrite=self.overwrite)


@dataclass(frozen=True, slots=True)
class Render:
    """Draw a recorded run: a picture, or a film of it.

    No display is needed: EGL or OSMesa draws, and MUJOCO_GL chooses between them. The handle is a
    ghost, the coupling a line that turns red with the force on the tool. The orange arrow is the
    force on the hand, turquoise ones are contact forces.

    Examples:
        hapticbridge render run.mcap run.png --at 2.5
        hapticbridge render run.mcap run.mp4
        hapticbridge render run.mcap run.gif --fps 10 --width 480 --height 360
        hapticbridge render run.mcap slow.mp4 --start 2 --stop 3 --speed 0.1
    """

    file: Path = option(metavar="FILE", is_positional=True)
    """The recording (.mcap)."""
    output: Path = option(metavar="OUTPUT", is_positional=True)
    """The picture (.png), or the film (.mp4, extra 'view'; or .gif)."""
    shot: Shot = USUAL_SHOT
    overwrite: bool = False
    """Replace the picture or film if the file exists."""

    in_process: bool = False
    """Simulate without limits on memory and time, for a recording of a known origin."""

    def execute(self) -> int:
        """Draws; returns the exit code."""
        check_target(self.output, RecordingError)
        refuse_existing(self.output, RecordingError, overwrite=self.overwrite)
        shot = self.shot
        if shot.at is None and self.output.suffix.lower() == ".png":
            from hapticbridge.report import telling_time  # noqa: PLC0415 - imports matplotlib

            shot = replace(shot, at=telling_time(read_recording(self.file, 0)))
        with progress("drawing") as show:
            renderer = draw(self.file, self.output, shot, show, in_process=self.in_process)
        _tell_faults(open_recording(self.file, 0))
        out.print(f"wrote {plain(str(self.output))} (drawn with {renderer})")
        return 0


@dataclass(frozen=True, slots=True)
class Export:
    """Write a recording as a table, for a viewer or to learn from.

    'parquet', 'csv' and 'hdf5' have a row per tick, with units, metadata and events. 'rerun' is a
    file for the viewer of that name, 'foxglove' a layout for Foxglove, which opens the recording
    itself. 'lerobot' and 'robomimic' write a folder with an episode for each recording, simulated
    again. --from and --to cut a piece out of a run, for tables and rerun; the times of its marks
    are printed. Of a damaged recording tables are written as far as it can be read, with exit code
    1; a data set refuses it and a cut one.

    Example:
        hapticbridge export run.mcap --format csv --from 12.5 --to 20 --out grasp.csv
    """

    files: tuple[Path, ...] = option(metavar="FILE", is_positional=True)
    """The recording; several for 'lerobot' and 'robomimic'."""
    form: Literal["parquet", "csv", "hdf5", "rerun", "foxglove", "lerobot", "robomimic"] = option(
        flag="format"
    )
    """The format. 'parquet' and 'lerobot' need the extra 'tables', 'hdf5' and 'robomimic' the extra
    'hdf5', 'rerun' the extra 'rerun'."""
    start: float = option(-math.inf, flag="from", metavar="S", is_finite=False)
    """First time to write, in s of the run; by default its start."""
    end: float = option(math.inf, flag="to", metavar="S", is_finite=False)
    """Time in s of the run before which the last tick lies; by default its end."""
    out: Path | None = None
    """File to write; by default the recording's name with the format's ending. A folder that does
    not exist for 'lerobot' and 'robomimic', by default the format's name."""
    overwrite: bool = False
    """Replace the file if it exists."""
    hand: str | None = option(None, metavar="GRIP")
    """Grip of the hand to write, of a run of several; a table has one hand."""
    sensors: bool = False
    """Add the readings of the scene's own sensors to a table: the run is simulated again. A data
    set always holds them."""
    fps: int | None = None
    """Frames per second of a data set, by default 30; at most the states of the run per second."""
    camera: str | None = None
    """Camera of the scene whose pictures a data set holds, or 'free'; by default none. A '/' of its
    name becomes '_' there."""
    size: tuple[int, int] | None = option(None, metavar="W H")
    """Width and height of the pictures in pixels, both even; by default 320 240."""
    task: str | None = None
    """Text of a data set on its task, which policies may be given; by default the name of the one
    scene, which says nothing for a program's own."""
    as_json: bool = option(False, flag="json")
    """Print what was written as JSON."""

    def execute(self) -> int:
        """Exports; returns the exit code."""
        if self.form in DATASETS:
            return self._write_dataset()
        of_datasets = {"fps": self.fps, "camera": self.camera, "size": self.size, "task": self.task}
        for name, value in of_datasets.items():
            if value is not None:
                raise RecordingError(f"--{name} goes with --format {' or '.join(DATASETS)}")
        if len(self.files) != 1:
            raise RecordingError(
                f"--format {self.form} writes one recording, not {len(self.files)}; several go "
                f"with {' or '.join(DATASETS)}"
            )
        with err.status(f"exporting {plain(str(self.files[0]))} …"):
            part = Part((self.start, self.end), self.hand, self.sensors)
            done = export(self.files[0], self.form, self.out, part=part, overwrite=self.overwrite)
        recording = done.recording
        marks = [time_of(event) for event in recording.events if event.get("event") == "mark"]
        if self.as_json:
            facts = {"files": [str(file) for file in done.files], "ticks": done.ticks}
            facts |= {"marks": marks, "is_cut": bool(recording.cut_sentence)}
            facts |= {"cut": recording.cut_sentence, "damage": recording.problems}
            facts |= {why: done.odd.get(why, []) for why in _ODD}
            print_json(facts)
        else:
            names = ", ".join(plain(str(file)) for file in done.files)
            held = f"{done.ticks} ticks, {len(done.events)} events"
            if self.form == LAYOUT:
                held = f"a layout to import where {plain(str(self.files[0]))} is open"
            out.print(f"wrote {names}: {held}")
            if marks:
                out.print(f"marks at {', '.join(f'{time:.3f} s' for time in marks)}")
        _tell_odd(done.odd)
        if recording.cut_sentence:
            err.print(f"[yellow]warning:[/yellow] {recording.cut_sentence}; this is what it holds")
        if recording.problems:
            damage = plain("; ".join(recording.problems))
            err.print(f"[yellow]warning:[/yellow] the recording is damaged: {damage}")
        return 1 if recording.problems else 0

    def _write_dataset(self) -> int:
        """Writes a data set; returns the exit code."""
        if (self.start, self.end) != EVERYTHING or self.overwrite or self.hand is not None:
            raise RecordingError(
                "--from, --to, --overwrite and --hand go with tables; a data set has whole "
                "recordings, in a new folder"
            )
        if self.size is not None and self.camera is None:
            raise RecordingError(
                "--size without --camera has no effect: the data set has no pictures; name a "
                "camera of the scene, or 'free'"
            )
        width, height = self.size or (320, 240)
        shot = Shot(
            fps=30 if self.fps is None else self.fps, camera=self.camera, width=width, height=height
        )
        with progress("simulating again") as show:
            done = write_dataset(
                self.files, self.form, self.out or self.form, shot, task=self.task, progress=show
            )
        if self.as_json:
            facts = asdict(done) | {"folder": str(done.folder)}
            del facts["odd"]
            print_json(facts | done.odd)
        else:
            frames = f"{format_count(sum(done.episodes), 'frame')} at {shot.fps} Hz"
            episodes = format_count(len(done.episodes), "episode")
            out.print(f"wrote {plain(str(done.folder))}: {episodes}, {frames}")
        _tell_odd(done.odd)
        each = zip(self.files, done.resets, done.ends, done.repeats, strict=True)
        for file, resets, end, repeats in each:
            if repeats:
                err.print(
                    f"[yellow]warning:[/yellow] {plain(str(file))}: {repeats} of its frames repeat "
                    "the one before, because the run skipped deadlines there"
                )
            if end:
                told = plain(f"{file}: {end}; look at its episode")
                err.print(f"[yellow]warning:[/yellow] {told}")
            if resets:
                times = ", ".join(f"{time:.3f} s" for time in resets)
                err.print(
                    f"[yellow]warning:[/yellow] the scene of {plain(str(file))} was reset at "
                    f"{times}: its episode jumps there; an episode needs a recording of its own"
                )
        return 0


def _tell_faults(recording: RecordingFile) -> None:
    """Prints that a recording that is shown is damaged or cut."""
    if recording.faults:
        told = plain(f"{recording.path}: {recording.faults}; this is what it holds")
        err.print(f"[yellow]warning:[/yellow] {told}")


_ODD = {
    "coupled": (
        "these readings include the coupling's pull on the tool, which MuJoCo takes for a motor's, "
        "and a real sensor there would not; 'hapticbridge check' says what to subtract"
    ),
    "early": (
        "these readings find contacts that the run sees ahead, some mm before the parts touch; "
        "such a contact carries no force, by which it is told from one that touches"
    ),
}
"""Sentences on readings that the file alone would not give, by the reason."""


def _tell_odd(readings: Mapping[str, list[str]]) -> None:
    """Prints which readings of sensors the file alone would not give, and why."""
    for why, names in readings.items():
        if names:
            err.print(f"[yellow]warning:[/yellow] {plain(choices(names))}: {_ODD[why]}")


@dataclass(frozen=True, slots=True)
class Compare:
    """Find the first tick and field where two runs differ.

    Ticks are compared bit by bit, without the times of the clock; runs at different rates where
    their ticks coincide. Exit code 0 if both are the same run, 1 if not.

    Example:
        hapticbridge compare before.mcap after.mcap
    """

    first: Path = option(metavar="A", is_positional=True)
    """A recording."""
    second: Path = option(metavar="B", is_positional=True)
    """Another one."""
    as_json: bool = option(False, flag="json")
    """Print the comparison as JSON."""

    def execute(self) -> int:
        """Compares; returns the exit code."""
        with err.status("comparing …"):
            comparison = compare(self.first, self.second)
        if self.as_json:
            out.print_json(comparison.to_json())
        else:
            _print(comparison)
        for note in comparison.notes:
            err.print(f"[yellow]warning:[/yellow] {plain(note)}")
        return 0 if comparison.is_same else 1


def _print(comparison: Comparison) -> None:
    if comparison.is_same:
        out.print(f"the same run: {comparison.compared} ticks are equal in every bit")
    elif comparison.first is None:
        out.print(f"{comparison.compared} common ticks are equal in every bit")
    else:
        first = comparison.first
        out.print(
            f"they part at tick {_ticks(first)} ({first.time:.6g} s) in {first.column}, by "
            f"{_size(first)}: {first.values[0]!r} and {first.values[1]!r}"
        )
    if comparison.periods[0] != comparison.periods[1]:
        rates = " and ".join(f"{1 / period:g} Hz" for period in comparison.periods)
        out.print(f"rates {rates}: compared at their {comparison.compared} common ticks")
    if comparison.ticks[0] != comparison.ticks[1]:
        out.print(f"{comparison.ticks[0]} and {comparison.ticks[1]} ticks long")
    if any(comparison.alone):
        out.print(
            f"ticks without a partner: {comparison.alone[0]} of the first, "
            f"{comparison.alone[1]} of the second"
        )
    for name, pair in comparison.decisive.items():
        out.print(f"  {name}: {_shortened(pair[0])} and {_shortened(pair[1])}")
    for name, counts in comparison.events.items():
        other = ", which say other things" if counts[0] == counts[1] else ""
        out.print(f"  events '{plain(name)}': {counts[0]} and {counts[1]}{other}")
    if comparison.largest:
        out.print("largest difference per field:")
        for each in comparison.largest:
            out.print(f"  {each.column:24} {_size(each):>12} at tick {_ticks(each)}")
        for name, pair in comparison.beside.items():
            out.print(f"  may explain it: {name} {_shortened(pair[0])} and {_shortened(pair[1])}")


def _ticks(difference: Difference) -> str:
    first, second = difference.ticks
    return str(first) if first == second else f"{first} (of the other: {second})"


def _size(difference: Difference) -> str:
    if difference.bits:
        return ", ".join(difference.bits)
    if difference.size == 0.0:
        return "the sign of zero"
    if not math.isfinite(difference.size):
        return "no number" if any(map(math.isnan, difference.values)) else "infinitely much"
    if difference.unit == "1":
        is_count = all(isinstance(value, int) for value in difference.values)
        return f"{difference.size:.0f}" if is_count else f"{difference.size:.3g}"
    if difference.unit == "ns":
        return format_si(1e-9 * difference.size, "s")
    return format_si(difference.size, difference.unit)


def _shortened(text: str | None) -> str:
    """Returns metadata as a line has room for it."""
    if text is None:
        return "nothing"
    return plain(text if len(text) <= 100 else f"{text[:99]}…")
