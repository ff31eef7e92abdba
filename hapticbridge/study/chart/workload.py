"""What is simulated at every point of a chart, and what it is compared with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from hapticbridge.coupling import Coupling
from hapticbridge.study.chart.engine_run import PeerWork
from hapticbridge.study.chart.score import Score
from hapticbridge.study.chart.setting import Setting


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
