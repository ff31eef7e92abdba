"""How wrong a point is, in what a person feels, and whether it stayed passive."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hapticbridge.check.perception import felt_error

Verdict = Literal[
    "strict", "within slack", "active", "lost contact", "diverged", "failed", "not metered"
]
"""Of the environment (``Ledger.environment``), or what else became of the run. ``failed``: another
engine raised an error on the way. ``not metered``: another engine, whose energy nobody counted."""

PASSIVE = ("strict", "within slack")

NAN, INF = float("nan"), float("inf")


@dataclass(frozen=True, slots=True)
class Score:
    """Errors of one run against a reference; nan where a number has no meaning for it.

    Attributes:
        felt: The chart's error in just noticeable differences, no unit; inf where it diverged.
        force_rms: RMS of the force's error in N.
        force_peak: Largest, in N.
        torque_rms: In N m.
        position_peak: Largest distance from the reference in m.
        angle_peak: Largest angle from it in rad.
        stiffness: Relative error of the static stiffness that a displaced handle feels, no unit.
        energy: Error of the energy in J, where the reference knows it.
        created: Largest Σ E_k in J: > 0 where the simulation created energy.
        verdict: What became of it.
        reason: Why it ended early, in words; empty where it did not.
    """

    felt: float
    force_rms: float = NAN
    force_peak: float = NAN
    torque_rms: float = NAN
    position_peak: float = NAN
    angle_peak: float = NAN
    stiffness: float = NAN
    energy: float = NAN
    created: float = NAN
    verdict: Verdict = "not metered"
    reason: str = ""


def score_of(
    reference: NDArray[np.void],
    records: NDArray[np.void],
    *,
    created: float,
    verdict: Verdict,
    stiffness: float = NAN,
    energy: float = NAN,
) -> Score:
    """Compares records at the same instants, tick by tick.

    Args:
        reference: ``TICK_DTYPE``; its forces set the thresholds (``check.felt``).
        records: ``TICK_DTYPE``, as many.
        created: In J.
        verdict: What became of the run.
        stiffness: Relative error of the static stiffness.
        energy: In J.

    Raises:
        SceneError: The numbers of records differ.
    """
    error = felt_error(reference, records)
    return Score(
        felt=error.felt,
        force_rms=error.force_rms,
        force_peak=error.force_peak,
        torque_rms=error.torque_rms,
        position_peak=error.position_peak,
        angle_peak=error.angle_peak,
        stiffness=stiffness,
        energy=energy,
        created=created,
        verdict=verdict,
    )


def diverged(created: float = INF, reason: str = "") -> Score:
    """Returns the score of a run that left all bounds."""
    return Score(felt=INF, created=created, verdict="diverged", reason=reason)
