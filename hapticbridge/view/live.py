"""The process that shows a run while it goes on; the loop never waits for it, nor knows of it.

It reads the newest records from the ring and simulates them again, so that it has the whole scene
and its contacts where a record has the tool alone. It ends when its input does.
"""

from __future__ import annotations

import base64
import contextlib
import json
import os
import queue
import sys
import threading
import time
from pathlib import Path
from typing import IO, Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit.rerun import Rerun
from hapticbridge.errors import HapticBridgeError
from hapticbridge.film.stage import LEAST_REFERENCE
from hapticbridge.provenance import parameters_of
from hapticbridge.recording import RecordingFile, Ring
from hapticbridge.recording.ring import HEAD
from hapticbridge.view.address import Address
from hapticbridge.view.controls import SHARED, Controls, Outlet, allowance_of
from hapticbridge.view.page import Page
from hapticbridge.view.server import serve
from hapticbridge.view.sight import Sight
from hapticbridge.view.trace import Trace

FRAME = 1 / 30
"""Seconds between two pictures; eyes and the page's own drawing see no more."""

REPLOT = 0.2
"""Seconds between two drawings of the curves, which cost the browser more than the scene."""

LAG = 0.03
"""In s: how old a record is when it is shown. What changed the run in that tick comes another way,
in some milliseconds, and must be known before the tick is simulated; nobody sees 30 ms."""

TRACE = 600
"""Points of a live curve: 20 s at 30 a second."""

BEHIND = 19
"""Niceness of this process: whatever else there is to do comes first."""


class Show:
    """A run from the onlooker's side.

    Args:
        ring: The run's.
        run: What the recording of the run would carry, without ticks.
        lag: How many of the newest records are left for the next look.
    """

    def __init__(self, ring: Ring, run: RecordingFile, lag: int = 0) -> None:
        self._ring, self._lag = ring, lag
        self.parameters = parameters_of(run.meta)
        self._run = Rerun(run, self.parameters)
        self._run.warm_up()  # a compilation of 20 s would be longer than what the ring holds
        self.model = self._run.model
        self._shown = mujoco.MjData(self.model)
        self._trace = Trace(TRACE)
        self._seen = 0
        self.is_lost = self._awaits_first = False
        self.reference = LEAST_REFERENCE

    def note(self, event: dict[str, Any]) -> None:
        """Takes an event of the run; one that began anew is simulated from there on."""
        if event.get("event") != "begin":
            self._run.note(event)
            return
        files = {n: base64.b64decode(data) for n, data in event["attachments"].items()}
        run = _facts(event["metadata"], files)
        self._run, self.is_lost = Rerun(run, parameters_of(run.meta)), False
        self.model, self._trace, self._awaits_first = self._run.model, Trace(TRACE), True

    def look(self) -> Sight | None:
        """Returns the newest instant; None where there is nothing new."""
        rows = self._news()
        if not rows.size:
            return None
        if not self.is_lost:
            try:
                self.is_lost = len(self._run.add(rows)) < len(rows)
            except HapticBridgeError:
                self.is_lost = True
        mujoco.mj_copyData(self._shown, self.model, self._run.data)
        sight = Sight.of(self.model, self._shown, rows[-1:], self.parameters.period)
        slack = float("nan") if self.is_lost else self._run.slack
        self._trace.add(rows, slack, self.parameters.period)
        self.reference = max(self.reference, float(np.linalg.norm(sight.force)))
        return sight

    def curves(self) -> tuple[NDArray[np.float64], list[NDArray[np.float64]]] | None:
        """Returns the curves so far; None before there are two points."""
        return self._trace.curves() if len(self._trace) > 1 else None

    def _news(self) -> NDArray[np.void]:
        """Returns the records since the last look; without the oldest where they were too many."""
        head = int(self._ring.cursors[HEAD])
        # the oldest place of a full ring is the one that is written next
        rows = self._ring.latest(min(head - self._seen, self._ring.capacity - 1))
        rows = rows[: max(len(rows) - self._lag, 0)]
        self._seen = max(head - self._lag, self._seen)
        if self._awaits_first:
            first = np.flatnonzero(rows["tick"] == 0)
            rows = rows[first[-1] :] if first.size else rows[:0]
            self._awaits_first = not first.size
        if rows.size and rows["tick"][0] != self._run.done:
            after = rows["tick"] >= self._run.done
            rows = rows[after]
            self.is_lost |= bool(rows.size and rows["tick"][0] != self._run.done)
        return rows


def _listen(stream: IO[bytes], inbox: queue.SimpleQueue[dict[str, Any] | None]) -> None:
    for line in stream:
        if line.endswith(b"\n"):
            inbox.put(json.loads(line))
    inbox.put(None)


def _facts(metadata: dict[str, str], files: dict[str, bytes]) -> RecordingFile:
    """Returns what a recording of a run that goes on would carry, without ticks."""
    return RecordingFile(
        path=Path("live"),
        count=0,
        last_tick=-1,
        flags=0,
        events=[],
        meta=metadata,
        attachments=files,
        is_cut=True,
        digest=None,
        computed_digest="",
        problems=(),
    )


def _told(stream: IO[bytes]) -> tuple[dict[str, Any], RecordingFile]:
    job = json.loads(stream.readline())
    files = {name: stream.read(size) for name, size in job["attachments"]}
    run = _facts(job["metadata"], files)
    return job, run


def _calm() -> None:
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            # idle: whoever else wakes on this core takes it at once; niceness alone lets a loop
            # without real-time priority wait for the rest of a slice
            os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    if hasattr(os, "nice"):
        os.nice(BEHIND)


def _follow(
    show: Show, page: Page, controls: Controls, inbox: queue.SimpleQueue[dict[str, Any] | None]
) -> None:
    plotted, due = 0.0, time.monotonic()
    while True:
        began = time.monotonic()
        # from the last due time on, so that a late picture does not make all later ones late
        due = max(due + FRAME, began)
        # events first: one that changes a tick must be known before that tick is simulated
        while not inbox.empty():
            event = inbox.get()
            if event is None:
                return
            show.note(event)
            controls.note(event)
        sight = show.look()
        if sight is not None:
            page.reference = show.reference
            page.show(sight)
            lost = (
                "; the view fell behind: bodies stand still, the curves go on"
                if show.is_lost
                else ""
            )
            force = float(np.linalg.norm(sight.force))
            page.status.content = f"**{sight.time:.1f} s**, {force:.2f} N{lost}"
        curves = show.curves()
        if curves is not None and began - plotted >= REPLOT:
            plotted = began
            page.plot(*curves)
        time.sleep(max(0.0, due - time.monotonic()))


def run() -> None:
    """Runs the process."""
    _calm()
    # what viser prints is no answer to the bridge
    answers, sys.stdout = sys.stdout, sys.stderr
    stream = sys.stdin.buffer
    job, facts = _told(stream)
    try:
        lag = round(LAG / parameters_of(facts.meta).period)
        show = Show(Ring.attach(job["ring"]), facts, lag)
        address = Address(job["host"], job["port"], job["token"])
        server = serve(address)
        page = Page(server, show.model, show.parameters, dict(facts.meta), show.reference)
    except HapticBridgeError as error:
        print(json.dumps({"error": str(error)}), file=answers, flush=True)
        return
    outlet = Outlet(answers.fileno())
    controls = Controls(server, allowance_of(facts.meta), outlet.ask)
    if not address.is_loopback:
        server.gui.add_markdown(SHARED)
    print(json.dumps({"url": address.url(server.get_port())}), file=answers, flush=True)
    inbox: queue.SimpleQueue[dict[str, Any] | None] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(stream, inbox), daemon=True).start()
    threading.Thread(target=outlet.run, daemon=True).start()
    _follow(show, page, controls, inbox)
    os._exit(0)  # viser's threads would hold an ordinary exit up
