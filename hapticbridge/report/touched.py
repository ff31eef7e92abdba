"""Geoms that touched while energy was created."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit import AuditReport
from hapticbridge.audit.rerun import Rerun
from hapticbridge.errors import RecordingError
from hapticbridge.recording.reader import BLOCK
from hapticbridge.report.evidence import Evidence

Pairs = dict[frozenset[int], float]
"""Share of the energy created while two geoms touched, by pair."""


def touched_pairs(
    evidence: Evidence, report: AuditReport, window: slice, gained: NDArray[np.float64]
) -> Pairs | None:
    """Returns the geoms that touched, those with most energy first; None if unknown.

    A record counts contacts without naming them, so the run is simulated again up to the window.
    ``gained`` is the energy created in each tick of the window, (n,) in J.
    """
    if not report.resimulation or report.resimulation.startswith(("not", "disagrees")):
        return None
    ticks, total = evidence.ticks, float(gained.sum())
    found: defaultdict[frozenset[int], float] = defaultdict(float)
    try:
        run = Rerun(evidence.recording, evidence.parameters)
        for begin in range(0, window.start, BLOCK):
            run.add(ticks[begin : min(begin + BLOCK, window.start)])
        for tick, energy in zip(range(window.start, window.stop), gained.tolist(), strict=True):
            run.add(ticks[tick : tick + 1])
            contact = run.data.contact
            touching = contact.geom[contact.efc_address >= 0].tolist()
            for pair in {frozenset(geoms) for geoms in touching}:
                found[pair] += energy / total if total > 0 else 0.0
    except RecordingError:
        return None
    return dict(sorted(found.items(), key=lambda item: -item[1]))
