"""What is simulated at every point of a chart, and what it is compared with."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from hapticbridge.check.perception import felt_error
from hapticbridge.coupling import Coupling
from hapticbridge.lab.chart.setting import Setting
from hapticbridge.lab.engines.base import Task

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


@dataclass(frozen=True, slots=True, eq=False)
class Take:
    """One pass along the motion.

    Attributes:
        setting: How.
        records: ``TICK_DTYPE``, one per tick that was completed.
        ended: Why it diverged, in words: it ended early, or MuJoCo gave its state up; empty where
            it did not.
        environment: ``strict``, ``within slack`` or ``active``.
        created: Largest Σ E_k in J.
        velocity: ``qvel`` at the end.
    """

    setting: Setting
    records: NDArray[np.void]
    ended: str
    environment: Verdict
    created: float
    velocity: NDArray[np.float64]

    @property
    def has_diverged(self) -> bool:
        """Whether it ended early, or MuJoCo gave its state up."""
        return bool(self.ended)

    def at(self, grid: float) -> NDArray[np.void]:
        """Returns the records at whole multiples of a time in s, the first excluded."""
        every = round(grid / self.setting.period)
        return self.records[every - 1 :: every]


Judge = Callable[[Sequence[Take]], Mapping[str, Score]]
"""What a point's takes say, by ``Panel.key``; the takes' records are copies."""


@dataclass(frozen=True, slots=True)
class PeerWork:
    """A workload as other engines are given it.

    Attributes:
        tasks: What is simulated, one after the other; a take each.
        duration: Of each in s.
        judge: What the takes say, the same as for the bridge's own runs.
    """

    tasks: tuple[Task, ...]
    duration: float
    judge: Judge


@dataclass(frozen=True, slots=True)
class Panel:
    """One comparison of a workload: a picture of its own.

    Attributes:
        key: In tables.
        title: What is compared, in a few words.
        reference: What the error is counted from, in a sentence.
        is_truth: Whether the reference is independent of the simulation. If not, an error says
            how far a method has converged, and not how far it is from the truth.
    """

    key: str
    title: str
    reference: str
    is_truth: bool = True


class Run(Protocol):
    """A workload at one setting, which can be run again and again."""

    @property
    def seconds(self) -> float:
        """Simulated time in s."""

    @property
    def chosen(self) -> Mapping[str, str | int]:
        """Contacts and solver as the engine got them: the same columns for every point."""

    def go(self) -> float:
        """Runs it from the start; returns the processor time in s of the simulation alone."""

    def scores(self) -> Mapping[str, Score]:
        """Judges the last run, by ``Panel.key``."""


class References(Protocol):
    """What each method converges to."""

    def disagreement(self) -> dict[str, float]:
        """Returns how far each limit lies from the one that most agree on in JND, by method."""


class Workload(Protocol):
    """What is simulated.

    Attributes:
        name: What the command line calls it.
        about: One sentence.
        panels: At least one; the first is what the recommendation goes by.
        coupling: K and B asked for.
        has_contact: Whether anything can touch.
        references: The methods' own limits, where a panel compares with them.
    """

    name: str
    about: str
    panels: Sequence[Panel]
    coupling: Coupling
    has_contact: bool
    references: References | None

    def run(self, setting: Setting) -> Run:
        """Prepares a point.

        Raises:
            HapticBridgeError: The method cannot render this.
        """

    def peer_work(self) -> PeerWork:
        """Returns the same work for other engines.

        Raises:
            StudyError: It cannot be described to them.
        """
