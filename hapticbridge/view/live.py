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
from typing import IO, Any

import numpy as np

from hapticbridge.errors import HapticBridgeError
from hapticbridge.provenance import parameters_of
from hapticbridge.recording import RecordingFile, Ring
from hapticbridge.view.address import Address
from hapticbridge.view.controls import SHARED, Controls, Outlet, allowance_of
from hapticbridge.view.page import Page
from hapticbridge.view.server import serve
from hapticbridge.view.show import Show, facts

FRAME = 1 / 30
"""Seconds between two pictures; eyes and the page's own drawing see no more."""

REPLOT = 0.2
"""Seconds between two drawings of the curves, which cost the browser more than the scene."""

BREATH = 0.005
"""In s, least time between taking records and simulating them; meanwhile the thread that listens
hears what happened before them, however busy the machine is."""

FAREWELL = 0.3
"""In s: how long the process stays once the run is over, so that the last words reach the page."""

LAG = 0.03
"""In s: how old a record is when it is shown. What changed the run in that tick comes another way,
in some milliseconds, and must be known before the tick is simulated; nobody sees 30 ms."""

BEHIND = 19
"""Niceness of this process: whatever else there is to do comes first."""


def _listen(stream: IO[bytes], inbox: queue.SimpleQueue[dict[str, Any] | None]) -> None:
    for line in stream:
        if line.endswith(b"\n"):
            inbox.put(json.loads(line))
    inbox.put(None)


def _told(stream: IO[bytes]) -> tuple[dict[str, Any], RecordingFile]:
    job = json.loads(stream.readline())
    files = {name: stream.read(size) for name, size in job["attachments"]}
    run = facts(job["metadata"], files)
    return job, run


def _calm() -> None:
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            # idle: whoever else wakes on this core takes it at once; niceness alone lets a loop
            # without real-time priority wait for the rest of a slice
            os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    if hasattr(os, "nice"):
        os.nice(BEHIND)


def _ending(event: dict[str, Any]) -> str:
    """Returns why a run ended, if that is what an event says."""
    if event.get("event") == "trip" or (event.get("event") == "stop" and "overruns" in event):
        return str(event.get("reason"))
    return ""


def _follow(
    show: Show, page: Page, controls: Controls, inbox: queue.SimpleQueue[dict[str, Any] | None]
) -> str:
    """Shows a run until it is over; returns why it is."""
    plotted, due, over = 0.0, time.monotonic(), ""
    while True:
        began = time.monotonic()
        # from the last due time on, so that a late picture does not make all later ones late
        due = max(due + FRAME, began + BREATH)
        show.gather()
        time.sleep(due - began)
        # events first: one that changes a tick must be known before that tick is simulated
        while not inbox.empty():
            event = inbox.get()
            if event is None:
                return over
            over = over or _ending(event)
            show.note(event)
            controls.note(event)
        sight = show.look()
        if sight is not None:
            page.reference = show.reference
            page.show(sight)
            warning = f"  \n**{show.warning}**" if show.warning else ""
            force = float(np.linalg.norm(sight.force))
            page.status.content = f"**{sight.time:.1f} s**, {force:.2f} N{warning}"
        if began - plotted >= REPLOT:
            curves = show.curves()
            if curves is not None:
                plotted = began
                page.plot(*curves)


def run() -> None:
    """Runs the process."""
    _calm()
    # what viser prints is no answer to the bridge
    answers, sys.stdout = sys.stdout, sys.stderr
    stream = sys.stdin.buffer
    job, told = _told(stream)
    try:
        lag = round(LAG / parameters_of(told.meta).period)
        show = Show(Ring.attach(job["ring"]), told, lag)
        address = Address(job["host"], job["port"], job["token"])
        server = serve(address)
        outlet = Outlet(answers.fileno())
        if not address.is_loopback:
            server.gui.add_markdown(SHARED)
        page = Page(server, show.model, show.parameters, dict(told.meta), show.reference)
        controls = Controls(server, allowance_of(told.meta), outlet.ask)
        page.add_curves()
    except HapticBridgeError as error:
        print(json.dumps({"error": str(error)}), file=answers, flush=True)
        return
    print(json.dumps({"url": address.url(server.get_port())}), file=answers, flush=True)
    inbox: queue.SimpleQueue[dict[str, Any] | None] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(stream, inbox), daemon=True).start()
    threading.Thread(target=outlet.run, daemon=True).start()
    reason = _follow(show, page, controls, inbox) or "the bridge is gone"
    page.status.content = f"**The run is over** ({reason}). This is how it was at the end."
    time.sleep(FAREWELL)
    os._exit(0)  # viser's threads would hold an ordinary exit up
