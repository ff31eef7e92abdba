"""The process that shows a run while it goes on; the loop never waits for it, nor knows of it.

It reads the newest records from the ring and simulates them again, so that it has the whole scene
and its contacts where a record has the tool alone. It ends when its input does.
"""

from __future__ import annotations

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
import viser
from numpy.typing import NDArray

from hapticbridge.audit.rerun import Rerun
from hapticbridge.errors import HapticBridgeError
from hapticbridge.film.stage import LEAST_REFERENCE
from hapticbridge.provenance import parameters_of
from hapticbridge.recording import RecordingFile, Ring
from hapticbridge.recording.ring import HEAD
from hapticbridge.view.address import Address
from hapticbridge.view.page import Page
from hapticbridge.view.server import serve
from hapticbridge.view.sight import Sight
from hapticbridge.view.trace import Trace
from hapticbridge.view.window import STOP

FRAME = 1 / 30
"""Seconds between two pictures; eyes and the page's own drawing see no more."""

REPLOT = 0.2
"""Seconds between two drawings of the curves, which cost the browser more than the scene."""

TRACE = 600
"""Points of a live curve: 20 s at 30 a second."""

BEHIND = 19
"""Niceness of this process: whatever else there is to do comes first."""


class Show:
    """A run from the onlooker's side.

    Args:
        ring: The run's.
        run: What the recording of the run would carry, without ticks.
    """

    def __init__(self, ring: Ring, run: RecordingFile) -> None:
        self._ring = ring
        self.parameters = parameters_of(run.meta)
        self._run = Rerun(run, self.parameters)
        self._run.warm_up()  # a compilation of 20 s would be longer than what the ring holds
        self.model = self._run.model
        self._shown = mujoco.MjData(self.model)
        self._trace = Trace(TRACE)
        self._seen = 0
        self.is_lost = False
        self.reference = LEAST_REFERENCE

    def note(self, event: dict[str, Any]) -> None:
        """Takes an event of the run."""
        self._run.note(event)

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
        if rows.size and rows["tick"][0] != self._run.done:
            after = rows["tick"] >= self._run.done
            rows = rows[after]
            self.is_lost |= bool(rows.size and rows["tick"][0] != self._run.done)
        self._seen = head
        return rows


def _listen(stream: IO[bytes], inbox: queue.SimpleQueue[dict[str, Any] | None]) -> None:
    for line in stream:
        if line.endswith(b"\n"):
            inbox.put(json.loads(line))
    inbox.put(None)


def _told(stream: IO[bytes]) -> tuple[dict[str, Any], RecordingFile]:
    job = json.loads(stream.readline())
    files = {name: stream.read(size) for name, size in job["attachments"]}
    run = RecordingFile(
        path=Path("live"),
        count=0,
        last_tick=-1,
        flags=0,
        events=[],
        meta=job["metadata"],
        attachments=files,
        is_cut=True,
        digest=None,
        computed_digest="",
        problems=(),
    )
    return job, run


def _calm() -> None:
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            # idle: whoever else wakes on this core takes it at once; niceness alone lets a loop
            # without real-time priority wait for the rest of a slice
            os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    if hasattr(os, "nice"):
        os.nice(BEHIND)


def _follow(show: Show, page: Page, inbox: queue.SimpleQueue[dict[str, Any] | None]) -> None:
    plotted = 0.0
    while True:
        began = time.monotonic()
        # events first: one that changes a tick must be known before that tick is simulated
        while not inbox.empty():
            event = inbox.get()
            if event is None:
                return
            show.note(event)
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
        time.sleep(max(0.0, FRAME - (time.monotonic() - began)))


def _add_stop_button(server: viser.ViserServer, answers: int, *, is_shared: bool) -> None:
    button = server.gui.add_button("stop the run", color="red")
    if is_shared:
        server.gui.add_markdown("Anyone with this address can watch this run, and stop it.")

    def press(_: object) -> None:
        button.disabled = True
        with contextlib.suppress(OSError):
            os.write(answers, STOP)

    button.on_click(press)


def run() -> None:
    """Runs the process."""
    _calm()
    # what viser prints is no answer to the bridge
    answers, sys.stdout = sys.stdout, sys.stderr
    stream = sys.stdin.buffer
    job, facts = _told(stream)
    try:
        show = Show(Ring.attach(job["ring"]), facts)
        address = Address(job["host"], job["port"], job["token"])
        server = serve(address)
        page = Page(server, show.model, show.parameters, dict(facts.meta), show.reference)
    except HapticBridgeError as error:
        print(json.dumps({"error": str(error)}), file=answers, flush=True)
        return
    _add_stop_button(server, answers.fileno(), is_shared=not address.is_loopback)
    print(json.dumps({"url": address.url(server.get_port())}), file=answers, flush=True)
    inbox: queue.SimpleQueue[dict[str, Any] | None] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(stream, inbox), daemon=True).start()
    _follow(show, page, inbox)
    os._exit(0)  # viser's threads would hold an ordinary exit up
