"""Which geoms touched while the environment created energy: the run is simulated again for it."""

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
"""Pairs of geoms, and the share of the energy that came in ticks in which they touched."""


def touched_pairs(
    evidence: Evidence, report: AuditReport, window: slice, gained: NDArray[np.float64]
) -> Pairs | None:
    """Returns which geoms touched, those of most energy first; None where nobody can tell.

    A record counts contacts and does not name them, so the run is simulated again up to there.

    Args:
        evidence: Of the run.
        report: The audit's verdict on it, which says whether it can be simulated again.
        window: Ticks to look at.
        gained: What the environment created in each of them, (n,) in J.
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
