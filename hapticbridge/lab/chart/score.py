"""Panels, takes and scores of a chart: what is compared, and how far it is off."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from hapticbridge.check.perception import felt_error
from hapticbridge.lab.chart.setting import Setting
from hapticbridge.lab.engines.base import Task

Verdict = Literal[
    "strict", "within slack", "active", "lost contact", "diverged", "failed", "not metered"
]
"""Verdict on the environment (``Ledger.environment``), or another outcome of the run. ``failed``:
another engine raised an error on the way. ``not metered``: it did not begin, or its own spring does
not tell its force."""

PASSIVE = ("strict", "within slack")

NAN, INF = float("nan"), float("inf")


@dataclass(frozen=True, slots=True)
class Score:
    """Errors of one run against a reference; nan where a number has no meaning for it.

    Attributes:
        jnd: The chart's error in just noticeable differences, no unit; inf where it diverged.
        force_rms: RMS of the force's error in N.
        force_peak: Largest error of the force in N.
        torque_rms: RMS of the torque's error in N m.
        position_peak: Largest distance from the reference in m.
        angle_peak: Largest angle from it in rad.
        stiffness: Relative error of the static stiffness that a displaced handle feels, no unit.
        energy: Error of the energy in J, if the reference has it.
        created: Largest Σ E_k in J: > 0 where the simulation created energy.
        verdict: Outcome of the run.
        reason: Reason of an early end, in words; else empty.
    """

    jnd: float
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
    """Compares records at equal instants, tick by tick.

    Args:
        reference: ``TICK_DTYPE``; its forces set the thresholds (``check.perception``).
        records: ``TICK_DTYPE``, as many as in the reference.
        created: Created energy in J.
        verdict: Outcome of the run.
        stiffness: Relative error of the static stiffness.
        energy: Error of the energy in J.

    Raises:
        SceneError: The numbers of records differ.
    """
    error = felt_error(reference, records)
    return Score(
        jnd=error.jnd,
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
    """Returns the score of a run that diverged."""
    return Score(jnd=INF, created=created, verdict="diverged", reason=reason)


class Reading(NamedTuple):
    """Reading of a meter of energy at the end of a run.

    Attributes:
        verdict: ``strict``, ``within slack``, ``active`` or ``not metered``.
        created: Largest Σ E_k in J.
        slack_share: Largest share of the slack that was used, without unit.
    """

    verdict: Verdict = "not metered"
    created: float = NAN
    slack_share: float = NAN


@dataclass(frozen=True, slots=True, eq=False)
class Take:
    """One pass along the motion.

    Attributes:
        setting: Setting of the simulation.
        records: ``TICK_DTYPE``, one per completed tick.
        ended: Reason of the divergence, in words: an early end, or a state that MuJoCo rejected;
            else empty.
        meter: Energy that the environment created, behind the law of the coupling.
        engine: Energy that the engine created with the wrench that it applied. It is less than
            ``meter`` by the energy that a held wrench creates.
        velocity: ``qvel`` at the end.
    """

    setting: Setting
    records: NDArray[np.void]
    ended: str
    meter: Reading
    engine: Reading
    velocity: NDArray[np.float64]

    @property
    def environment(self) -> Verdict:
        """Verdict on the environment."""
        return self.meter.verdict

    @property
    def created(self) -> float:
        """Largest Σ E_k in J."""
        return self.meter.created

    @property
    def has_diverged(self) -> bool:
        """True if it ended early, or MuJoCo rejected its state."""
        return bool(self.ended)

    def records_at(self, grid: float) -> NDArray[np.void]:
        """Returns the records at whole multiples of a time in s, the first excluded."""
        every = round(grid / self.setting.period)
        return self.records[every - 1 :: every]


Judge = Callable[[Sequence[Take]], Mapping[str, Score]]
"""Function from a point's takes to its scores by ``Panel.key``; the takes' records are copies."""


@dataclass(frozen=True, slots=True)
class PeerWork:
    """A workload for other engines.

    Attributes:
        tasks: Tasks in their order, one take each.
        duration: Duration of each in s.
        judge: Judge of the takes, shared with the bridge's own runs.
    """

    tasks: tuple[Task, ...]
    duration: float
    judge: Judge


@dataclass(frozen=True, slots=True)
class Panel:
    """One comparison of a workload, with its own picture.

    Attributes:
        key: Key in tables.
        title: Subject of the comparison, in a few words.
        reference: Reference of the error, in a sentence.
        is_truth: True if the reference is independent of the simulation. If not, an error measures
            the convergence of a method, and not its distance from the truth.
    """

    key: str
    title: str
    reference: str
    is_truth: bool = True


class Run(Protocol):
    """A workload at one setting, for repeated runs."""

    @property
    def seconds(self) -> float:
        """Simulated time in s."""

    @property
    def chosen(self) -> Mapping[str, str | int]:
        """Contacts and solver as the engine received them: equal columns for every point."""

    def run(self) -> float:
        """Runs it from the start; returns the processor time in s of the simulation alone."""

    def scores(self) -> Mapping[str, Score]:
        """Judges the last run, by ``Panel.key``."""
