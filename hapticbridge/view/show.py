"""A run that goes on, as the view follows it: from the ring's records, simulated again."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit.rerun import Rerun
from hapticbridge.errors import HapticBridgeError
from hapticbridge.film_process import LEAST_REFERENCE
from hapticbridge.provenance import parameters_of
from hapticbridge.recording import RecordingFile, Ring
from hapticbridge.recording.ring import HEAD
from hapticbridge.tick import TICK_DTYPE
from hapticbridge.view.pursuit import STRAY, Pursuit
from hapticbridge.view.sight import Sight
from hapticbridge.view.tendons import Tendons
from hapticbridge.view.trace import Trace

TRACE = 600
"""Points of a live curve: 20 s at 30 a second."""


class Show:
    """A run from the onlooker's side.

    Args:
        ring: The run's.
        run: What the recording of the run would carry, without ticks.
        lag: How many of the newest records are left for the next look.

    Attributes:
        model: The scene.
        parameters: Of the run.
        reference: The largest force in N so far, or ``LEAST_REFERENCE``.
    """

    def __init__(self, ring: Ring, run: RecordingFile, lag: int = 0) -> None:
        self._ring, self._lag = ring, lag
        self._begin(run)
        self._run.warm_up()  # a compilation of 20 s would be longer than what the ring holds
        self._shown = mujoco.MjData(self.model)
        self._number = self._boundary = 0
        self._gathered = np.zeros(0, TICK_DTYPE)
        self._awaits_first = False
        self.reference = LEAST_REFERENCE

    def _begin(self, run: RecordingFile) -> None:
        self.parameters = parameters_of(run.meta)
        self._run, self._skipped = Rerun(run, self.parameters), ""
        self._pursuit: Pursuit | None = None
        self.model, self._trace = self._run.model, Trace(TRACE)
        self._tendons = Tendons(self.model)

    def note(self, event: dict[str, Any]) -> None:
        """Takes an event of the run; one that began anew is simulated from there on."""
        if event.get("event") != "begin":
            self._run.note(event)
            return
        files = {n: base64.b64decode(data) for n, data in event["attachments"].items()}
        self._begin(facts(event["metadata"], files))
        self._awaits_first, self._boundary = True, int(self._ring.cursors[HEAD])

    def gather(self) -> None:
        """Takes what the ring has.

        What happened before these records must be noted before the next ``look``; news come
        another way, in some milliseconds.
        """
        first, rows = self._ring.since(self._number + len(self._gathered))
        if first != self._number + len(self._gathered):
            self._gathered = rows
            self._number = first
        else:
            self._gathered = np.concatenate([self._gathered, rows])

    def look(self) -> Sight | None:
        """Returns the newest instant that was gathered; None where there is nothing new."""
        rows = self._news()
        if not rows.size:
            return None
        for part in np.split(rows, 1 + np.flatnonzero(np.diff(rows["tick"]) != 1)):
            self._follow(part)
        mujoco.mj_copyData(self._shown, self.model, self._run.data)
        sight = Sight.of(self.model, self._shown, rows[-1:], self._tendons)
        slack = self._run.slack if self._pursuit is None else self._pursuit.slack
        self._trace.add(rows, slack)
        self.reference = max(self.reference, float(np.linalg.norm(sight.force)))
        return sight

    def curves(self) -> tuple[NDArray[np.float64], list[NDArray[np.float64]]] | None:
        """Returns the curves so far; None before there are two points."""
        return self._trace.curves() if len(self._trace) > 1 else None

    @property
    def warning(self) -> str:
        """What is not as it is drawn, or nothing."""
        if self._pursuit is None:
            return ""
        tool = ""
        if self._pursuit.off > STRAY:
            tool = f"; the tool is {1e3 * self._pursuit.off:.0f} mm from where it is drawn"
        return (
            f"the view {self._skipped}: what the tool has moved may stand elsewhere, and the "
            f"passivity margin is that much or more{tool}"
        )

    def _follow(self, rows: NDArray[np.void]) -> None:
        """Simulates records without a gap, to the bit as long as none is missing."""
        first, run = int(rows["tick"][0]), self._run
        missing = first - run.done
        if self._pursuit is None and not missing:
            try:
                if len(run.add(rows)) == len(rows):
                    return
                missing = -1
            except HapticBridgeError:
                missing = -1
        if missing:
            at = f"{1e-9 * float(rows['deadline_ns'][0]):.1f} s"
            self._skipped = f"lost the run at {at}"
            if missing > 0:
                gone = missing * self.parameters.period
                self._skipped = f"fell behind and skipped {gone:.2g} s, last at {at}"
        if self._pursuit is None:
            self._pursuit = Pursuit(run, self.parameters.period)
        self._pursuit.add(rows)

    def _news(self) -> NDArray[np.void]:
        """Returns the records gathered since the last look."""
        number, end = self._number, max(len(self._gathered) - self._lag, 0)
        rows, self._gathered = self._gathered[:end], self._gathered[end:]
        self._number += end
        if self._awaits_first and rows.size:
            first = np.flatnonzero(rows["tick"] == 0)
            # what was written after the news is of the new run, even if its first record is gone
            start = int(first[-1]) if first.size else max(self._boundary - number, 0)
            rows = rows[start:]
            self._awaits_first = not rows.size
        return rows


def facts(metadata: dict[str, str], files: dict[str, bytes]) -> RecordingFile:
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
