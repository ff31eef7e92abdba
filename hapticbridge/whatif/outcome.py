"""Result of a what-if."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit import AuditReport
from hapticbridge.jsonable import jsonable
from hapticbridge.recording import Recording
from hapticbridge.whatif.changes import Value

RECORDED, PRESCRIBED, CLOSED = "recorded", "prescribed", "closed loop"
"""Names of the runs: the recorded one; the recorded motion, and a model hand, through the changed
bridge."""


@dataclass(frozen=True, slots=True)
class WhatIfRun:
    """One of the runs.

    Attributes:
        name: ``recorded``, ``prescribed`` or ``closed loop``.
        report: The audit's verdict.
        peaks: Largest force and torque on tool and device in N and N m, and largest distance of
            handle and tool in m, by name.
        trip: Reason of the guard's stop, or empty.
        period: T in s.
        recording: Its recording; that of a changed run exists in memory only.
    """

    name: str
    report: AuditReport
    peaks: dict[str, float]
    trip: str
    period: float
    recording: Recording

    @property
    def ticks(self) -> NDArray[np.void]:
        """Records, ``TICK_DTYPE``."""
        return self.recording.ticks


@dataclass(frozen=True, slots=True)
class WhatIf:
    """A recorded run beside its repetitions through a changed bridge.

    Attributes:
        path: The recording.
        changes: Name, unit, and the value before and after.
        runs: Recorded, prescribed and, for a known device, closed loop.
        hand_error: RMS distance in m of the model hand from the recorded motion with unchanged
            settings: the accuracy of the closed loop. NaN without closed loop.
        notes: Notes on the runs, one sentence each.
    """

    path: Path
    changes: tuple[tuple[str, str, Value | None, Value | None], ...]
    runs: tuple[WhatIfRun, ...]
    hand_error: float
    notes: tuple[str, ...]

    @property
    def exit_code(self) -> int:
        """Largest exit code of the changed runs; a trip counts as 1."""
        return max(max(run.report.exit_code, int(bool(run.trip))) for run in self.runs[1:])

    def to_json(self) -> str:
        """Returns the result as one JSON object, without the ticks."""
        values = {
            "path": str(self.path),
            "changes": [
                dict(zip(("name", "unit", "before", "after"), change, strict=True))
                for change in self.changes
            ],
            "runs": [
                {
                    "name": run.name,
                    "peaks": run.peaks,
                    "trip": run.trip,
                    "report": json.loads(run.report.to_json()) | {"path": str(self.path)},
                }
                for run in self.runs
            ],
            "hand_error": self.hand_error,
            "notes": self.notes,
        }
        return json.dumps(jsonable(values), allow_nan=False)
