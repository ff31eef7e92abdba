"""Re-simulation of a recorded run, compared in every number."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit.attached_scene import FOREIGN_TOLERANCE, is_same_processor
from hapticbridge.audit.rerun import Rerun, obstacle
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.recording import RecordingFile
from hapticbridge.tick import CLOCK_FIELDS, TICK_DTYPE, TickFlag

NOT_RUN = "not re-simulated"

_OUTSIDE = int(TickFlag.OVERRUN | TickFlag.DROPPED_BEFORE | TickFlag.STALE_SAMPLE)
"""Flags set by clock, recorder and device instead of the simulation."""

_COMPARED = tuple(name for name in TICK_DTYPE.names or () if name not in CLOCK_FIELDS)


@dataclass(frozen=True, slots=True)
class Replay:
    """Outcome of a re-simulation.

    Attributes:
        agreement: ``bit for bit``, ``within 1e-9 (other processor)``, ``disagrees``, or ``not
            re-simulated: …`` with the reason.
        tick: First tick that disagrees, or None.
        field: First field of that tick that disagrees.
        difference: Size of the disagreement.
    """

    agreement: str
    tick: int | None = None
    field: str = ""
    difference: float = 0.0

    @property
    def has_run(self) -> bool:
        """True if there was a re-simulation."""
        return not self.agreement.startswith(NOT_RUN)

    @property
    def disagrees(self) -> bool:
        """True if the scene does not repeat the recording under the recorded motion."""
        return self.tick is not None


class Resimulation:
    """Re-simulation of the recorded device motion, block by block.

    All fields except the clock's are compared; ``outcome`` returns the result.

    Raises:
        RecordingError: The attachments contradict the metadata, so the file was changed.
    """

    def __init__(self, recording: RecordingFile, parameters: RunParameters) -> None:
        self._is_same_processor = is_same_processor(recording)
        self._first: tuple[int, str, float] | None = None
        self._off = dict.fromkeys(_COMPARED, 0.0)
        self._largest = dict.fromkeys(_COMPARED, 0.0)
        self._obstacle = obstacle(recording)
        if not self._obstacle:
            self._run = Rerun(recording, parameters)

    def add(self, ticks: NDArray[np.void]) -> None:
        """Simulates the next records, ``TICK_DTYPE``, at least one.

        Raises:
            RecordingError: An event among them is damaged.
        """
        if self._obstacle or self._run.is_over:
            return
        start = self._run.done
        again = self._run.add(ticks)
        self._compare(ticks[: len(again)], again, start)

    def outcome(self) -> Replay:
        """Returns the agreement after the last record.

        Raises:
            RecordingError: An event after the last record is damaged.
        """
        if self._obstacle:
            return Replay(f"{NOT_RUN}: {self._obstacle}")
        self._run.finish()
        off = max(self._off[name] / max(self._largest[name], 1.0) for name in _COMPARED)
        if self._run.is_over and self._first is None:
            return Replay("disagrees", self._run.done, "tool_position", float("nan"))
        if self._first is None:
            return Replay("bit for bit")
        if not self._run.is_over and not self._is_same_processor and off <= FOREIGN_TOLERANCE:
            return Replay("within 1e-9 (other processor)")
        return Replay("disagrees", *self._first)

    def _compare(
        self, recorded_rows: NDArray[np.void], again: NDArray[np.void], start: int
    ) -> None:
        if not len(again):
            return
        first: tuple[int, str, float] | None = None
        for name in _COMPARED:
            recorded, simulated = recorded_rows[name], again[name]
            if name == "flags":
                recorded, simulated = recorded & ~_OUTSIDE, simulated & ~_OUTSIDE
            self._largest[name] = max(self._largest[name], float(np.abs(simulated).max()))
            unequal = (recorded != simulated).reshape(len(again), -1).any(axis=1)
            if not unequal.any():
                continue
            difference = np.abs(recorded - simulated).reshape(len(again), -1).max(axis=1)
            self._off[name] = max(self._off[name], float(difference.max()))
            at = int(np.argmax(unequal))
            if first is None or at < first[0]:
                first = (at, name, float(difference[at]))
        if first is not None and self._first is None:
            self._first = (start + first[0], *first[1:])
