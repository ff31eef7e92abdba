"""What came of a what-if: runs side by side."""

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
"""The runs: as recorded; the recorded motion, and a model hand, through the changed bridge."""


@dataclass(frozen=True, slots=True)
class WhatIfRun:
    """One of the runs.

    Attributes:
        name: ``recorded``, ``prescribed`` or ``closed loop``.
        report: What the audit says of it.
        peaks: Largest force and torque on tool and device in N and N m, and largest distance of
            handle and tool in m, by name.
        trip: Why the guard stopped it, or nothing.
        period: T in s.
        recording: Of it; that of a changed run is in memory alone.
    """

    name: str
    report: AuditReport
    peaks: dict[str, float]
    trip: str
    period: float
    recording: Recording

    @property
    def ticks(self) -> NDArray[np.void]:
        """Its records, ``TICK_DTYPE``."""
        return self.recording.ticks


@dataclass(frozen=True, slots=True)
class WhatIf:
    """A recorded run, and the same hand through a changed bridge.

    Attributes:
        path: The recording.
        changes: Name, unit, and the value before and after.
        runs: As recorded, prescribed, and, where the device is known, closed loop.
        hand_error: How far the model hand is off the recorded motion where nothing is changed, root
            of the mean square in m; NaN without closed loop. It is what the closed loop is worth.
        notes: What to know of these runs, a sentence each.
    """

    path: Path
    changes: tuple[tuple[str, str, Value | None, Value | None], ...]
    runs: tuple[WhatIfRun, ...]
    hand_error: float
    notes: tuple[str, ...]

    @property
    def exit_code(self) -> int:
        """The worst of the changed runs: 0 if all are passive, untripped and not uncertified."""
        return max(max(run.report.exit_code, int(bool(run.trip))) for run in self.runs[1:])

    def to_json(self) -> str:
        """Returns it as one JSON object, without the ticks."""
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
