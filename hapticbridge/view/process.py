"""Process that shows a run while it continues. The loop never waits for it.

It reads the newest positions of the scene (``recording.ring``) and the records of the ring, and
draws them on the page. It ends when its input does.
"""

from __future__ import annotations

import contextlib
import json
import os
import queue
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit.recorded_scene import compile_recorded
from hapticbridge.demand.timekeeping import Alarm
from hapticbridge.errors import HapticBridgeError
from hapticbridge.kernel.record import force_on_hand
from hapticbridge.recording import RecordingFile, Ring
from hapticbridge.recording.format import further_hands
from hapticbridge.recording.recorder_process import listen
from hapticbridge.recording.ring import Picture, Snapshot
from hapticbridge.replay.blow import NewestBlow, newest_blow
from hapticbridge.replay.stage import MIN_REFERENCE, is_held, place_of_blow, tell_apart
from hapticbridge.run.description import parameters_of
from hapticbridge.view.controls import Controls, Outlet, add_hand, allowance_of
from hapticbridge.view.geometry import Scenery, Tendons
from hapticbridge.view.page import Held, Page, Sight, Trace, quoted
from hapticbridge.view.server import serve
from hapticbridge.view.window import Address

FRAME = 1 / 30
"""Time in s between two pictures, equal to that between the bridge's snapshots."""

REPLOT = 0.2
"""Time in s between two drawings of the curves, which cost a browser more than the scene."""

FAREWELL = 0.3
"""Time in s that the process stays after the run, so that the last messages reach the page."""

BEHIND = 19
"""Niceness of this process: all other work comes first."""

TRACE = 600
"""Points of a live curve: 20 s at 30 a second."""


class LiveRun:
    """A running run as the bridge publishes it.

    Args:
        ring: The run's records.
        snapshot: Name of the shared memory with the scene's positions.
        run: Metadata and attachments of the run.

    Attributes:
        model: The scene, this user's own.
        scenery: All of it that the page draws.
        parameters: Parameters of the run.
        hand_reference: Largest force on the hand in N so far, or ``MIN_REFERENCE``.
        tool_reference: Largest force on the tool in N so far, or ``MIN_REFERENCE``.
        flags: Combined flags of the records so far.
        trace: The curves so far.
        blow: Newest blow of the tool so far, where the scene's next picture has the largest contact
            force; None before the first.
    """

    def __init__(self, ring: Ring, snapshot: str, run: RecordingFile) -> None:
        self.parameters = parameters_of(run.meta)
        metas = [run.meta | own for own in further_hands(run.meta)]
        self._hands = self.parameters, *map(parameters_of, metas)
        self.model = compile_recorded(run).model
        tell_apart(self.model, *(own.grip for own in self._hands))
        grips = [own.grip for own in self._hands if not own.is_joint]
        self.scenery = Scenery.from_model(self.model, *grips)
        self._ring, self._snapshot = ring, Snapshot.attach(snapshot, self.model)
        self._data, self._tendons = mujoco.MjData(self.model), Tendons(self.model)
        self._gathered, self._shown = 0, -1
        self._are_held = [is_held(meta) for meta in (run.meta, *metas)]
        self.trace = Trace(TRACE, is_held=self._are_held[0])
        self.hand_reference = self.tool_reference = MIN_REFERENCE
        self.flags = 0
        self.blow: NewestBlow | None = None

    def look(self) -> Sight | None:
        """Returns the newest instant; None if it was returned before."""
        picture = self._snapshot.read()
        if picture is None or picture.number == self._shown:
            return None
        number, rows = self._ring.since(picture.number)
        if number != picture.number or rows.size < len(self._hands):
            return None  # its records are not written yet
        self._shown = number
        self._gather(picture)
        self._data.qpos[:] = picture.qpos
        self._data.mocap_pos[:], self._data.mocap_quat[:] = picture.mocap_pos, picture.mocap_quat
        hands = tuple(self._hands_at(rows))
        sight = Sight.from_scene(
            self.model, self._data, self._tendons, picture.contacts, rows[:1], hands
        )
        sight = replace(sight, blow=self.blow)
        for held in hands:
            size, pull = np.linalg.norm(held.hand_force), np.linalg.norm(held.tool_force)
            self.hand_reference = max(self.hand_reference, float(size))
            self.tool_reference = max(self.tool_reference, float(pull))
        return sight

    def _hands_at(self, rows: NDArray[np.void]) -> Iterator[Held]:
        """Yields the hands at a tick; a joint has no handle in the scene."""
        for hand, own in enumerate(self._hands):
            if not own.is_joint:
                row = rows[hand : hand + 1]
                yield Held.from_record(row, force_on_hand(row, own.axes)[0] * self._are_held[hand])

    def _gather(self, picture: Picture) -> None:
        """Adds the records since the last call to the curves, which are those of the first hand."""
        number, rows = self._ring.since(self._gathered)
        self._gathered = number + len(rows)
        own = rows[-number % len(self._hands) :: len(self._hands)]
        if own.size:
            self.flags |= int(np.bitwise_or.reduce(rows["flags"]))
            self.trace.add(own, picture.slack)
            self.blow = newest_blow(self.blow, own, place_of_blow(picture.contacts, own[-1]))


def run_of(metadata: dict[str, str], files: dict[str, bytes]) -> RecordingFile:
    """Returns metadata and attachments of a running run as a recording without ticks."""
    return RecordingFile(
        path=Path("live"),
        count=0,
        last_tick=-1,
        flags=0,
        events=[],
        meta=metadata,
        attachments=files,
        is_cut=True,
        hands=1 + len(further_hands(metadata)),
    )


def _read_job(stream: IO[bytes]) -> tuple[dict[str, Any], RecordingFile]:
    job = json.loads(stream.readline())
    files = {name: stream.read(size) for name, size in job["attachments"]}
    return job, run_of(job["metadata"], files)


def _calm() -> None:
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            # Idle priority: any other process that wakes on this core preempts it at once. Niceness
            # alone lets a loop without real-time priority wait for the rest of a slice.
            os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    if hasattr(os, "nice"):
        os.nice(BEHIND)


def _ending(event: dict[str, Any]) -> str:
    """Returns the reason of a run's end if an event contains it."""
    if event.get("event") == "trip" or (event.get("event") == "stop" and "overruns" in event):
        return str(event.get("error") or event.get("reason"))
    return ""


def _follow(
    live: LiveRun, page: Page, controls: Controls, inbox: queue.SimpleQueue[dict[str, Any] | None]
) -> str:
    """Shows a run until it is over; returns the reason of its end."""
    plotted, due, over = 0.0, time.monotonic(), ""
    while True:
        while not inbox.empty():
            event = inbox.get_nowait()
            if event is None:
                return over
            over = over or _ending(event)
            controls.note(event)
        sight = live.look()
        if sight is not None:
            page.hand_reference = live.hand_reference
            page.tool_reference = live.tool_reference
            page.show(sight)
            alarm = Alarm.of(live.flags)
            page.status.content = f"**{sight.time:.1f} s**, {page.facts(sight)}" + (
                f"; **{alarm.sentence}**" if alarm else ""
            )
        now = time.monotonic()
        if now - plotted >= REPLOT and len(live.trace) > 1:
            plotted = now
            page.plot(*live.trace.curves())
        # counted from the last due time, so that a late picture does not delay all later ones
        due = max(due + FRAME, now)
        time.sleep(due - now)


def run() -> None:
    """Runs the process."""
    _calm()
    # keeps viser's prints out of the answers to the bridge
    answers, sys.stdout = sys.stdout, sys.stderr
    stream = sys.stdin.buffer
    job, run = _read_job(stream)
    try:
        live = LiveRun(Ring.attach(job["ring"]), job["snapshot"], run)
        address = Address(job["port"], job["token"])
        server = serve(address)
        outlet = Outlet(answers.fileno())
        page = Page(server, live.scenery, live.parameters, dict(run.meta))
        if job["has_hand"]:
            add_hand(server, live.parameters, live.scenery.extent, outlet.drag)
        several = run.has_several_hands
        controls = Controls(server, allowance_of(run.meta), outlet.ask, has_several_hands=several)
        page.add_curves()
    except HapticBridgeError as error:
        print(json.dumps({"error": str(error)}), file=answers, flush=True)
        return
    print(json.dumps({"url": address.url(server.get_port())}), file=answers, flush=True)
    inbox: queue.SimpleQueue[dict[str, Any] | None] = queue.SimpleQueue()
    threading.Thread(target=listen, args=(stream, inbox), daemon=True).start()
    threading.Thread(target=outlet.run, daemon=True).start()
    reason = _follow(live, page, controls, inbox) or "the bridge is gone"
    page.status.content = f"**The run is over** ({quoted(reason)}). This is how it was at the end."
    time.sleep(FAREWELL)
    os._exit(0)  # viser's threads would delay an ordinary exit
