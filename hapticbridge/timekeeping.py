"""Time that a run really kept, and what the device condition makes of it.

The device condition b >= N, N = K T/2 + B', is computed for ticks each T and a force that acts at
once. A run certifies its device only if it kept its time, which means two things.

1. At the time between ticks that the run had on average, T/s with s the share of the deadlines that
   it kept, and at its mean time t_d from sample to force, the condition still holds:

       b >= N/s + 3 κ t_d/T,    κ = (K T/2)²/N

2. Single delays gave the hand at most ``INSTANT`` in energy beyond what b burned
   (``kernel.timing``, and again ``audit.timing``).

It is safe, because a late sample gives nothing by itself: the handle slips until the springs hold
less by what it may have put in (``kernel.law.charge_lateness``). The first part is therefore more
than safety needs; it keeps a run at a fifth of its rate from being called certified for the whole
rate. The second bounds what a delay gave, for any hand.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from hapticbridge.certificate import DampingCondition
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.kernel.timing import DELAY_PRICE
from hapticbridge.units import format_si

INSTANT = 1e-3
"""Energy in J that delays may give to the hand: 1 N over 1 mm, less than a key of a keyboard takes,
and a fortieth of the guard's usual energy limit. A smaller value fails runs for one late force; a
larger one can be felt."""

NOT_KEPT = "the run did not keep its time"
"""Words that name this fault."""


@dataclass(frozen=True, slots=True)
class RunTimes:
    """Times of a run, from the loop's counters or from a recording.

    Attributes:
        ticks: Number of ticks.
        due: Number of deadlines, with the skipped ones.
        mean_delay: Mean time in s from a sample to its force.
        delay_energy: Largest energy in J that delays may have given to the hand.
        is_realtime: True if real time was requested from the system.
    """

    ticks: int
    due: int
    mean_delay: float
    delay_energy: float
    is_realtime: bool


@dataclass(frozen=True, slots=True)
class Timekeeping:
    """Time that a run kept, and the device condition at this time.

    Attributes:
        rate: Ticks per second that really happened.
        share: Share of the deadlines that were kept, 0 to 1.
        mean_delay: Mean time in s from a sample to its force.
        delay_energy: Largest energy in J that delays may have given to the hand.
        conditions: Device conditions at these times.
        is_kept: True if all conditions hold and the energy is at most ``INSTANT``; None if no
            condition holds even for a run in time.
        is_realtime: True if real time was requested from the system.
    """

    rate: float
    share: float
    mean_delay: float
    delay_energy: float
    conditions: tuple[DampingCondition, ...]
    is_kept: bool | None
    is_realtime: bool

    @classmethod
    def of(
        cls, times: RunTimes, parameters: RunParameters, conditions: Sequence[DampingCondition]
    ) -> Timekeeping:
        """Judges the times of a run by its device conditions; none for a run without a law."""
        share = times.ticks / times.due if times.due > times.ticks else 1.0
        late = tuple(_at_times(each, parameters, share, times.mean_delay) for each in conditions)
        held = [each.holds for each in late if each.available is not None]
        is_borne = bool(held) and all(each.holds is not False for each in conditions)
        return cls(
            rate=share / parameters.period if times.ticks else 0.0,
            share=share,
            mean_delay=times.mean_delay,
            delay_energy=times.delay_energy,
            conditions=late,
            is_kept=all(held) and times.delay_energy <= INSTANT if is_borne else None,
            is_realtime=times.is_realtime,
        )

    def certified(self, verdict: bool | None) -> bool | None:
        """Returns a verdict on the device, False if the run did not keep its time."""
        return False if self.is_kept is False else verdict

    @property
    def words(self) -> str:
        """Effective rate and share of the deadlines: ``914 Hz, 91.4 % of the deadlines kept``."""
        return f"{self.rate:.4g} Hz, {self._percent} of the deadlines kept"

    @property
    def clause(self) -> str:
        """Clause on time after "device certified"; empty if no deadline was missed."""
        return f" while the run kept its time ({self._percent} of it)" if self.share < 1.0 else ""

    @property
    def _percent(self) -> str:
        return f"{min(100.0 * self.share, 99.9):.1f} %" if self.share < 1.0 else "100 %"

    @property
    def remedy(self) -> str:
        """Changes that help a run to keep its time."""
        request = "" if self.is_realtime else "--realtime, "
        return f"{request}less stiffness, or a --rate that 'hapticbridge check' finds possible"

    @property
    def hint(self) -> str:
        """Sentence that suggests ``--realtime`` after missed deadlines; empty if not needed."""
        if self.share == 1.0 or self.is_realtime or self.is_kept is False:
            return ""
        return "deadlines were missed: --realtime requests the processor for the loop"

    @property
    def fault(self) -> str:
        """Sentence on the time that was not kept, with the remedy; empty if it was."""
        if self.is_kept is not False:
            return ""
        late = f" and {format_si(self.mean_delay, 's')} from sample to force"
        at_times = f"at {self.rate:.4g} Hz{late if self.mean_delay else ''} it needs"
        failed = [each for each in self.conditions if each.holds is False]
        if failed:
            unit = "N s/m" if failed[0].axis == "translation" else "N m s/rad"
            found = (
                f"{at_times} {failed[0].needed:.3g} {unit} of damping in {failed[0].axis} and has "
                f"{failed[0].available:.3g}"
            )
        else:
            found = (
                f"forces sent late may have given the hand {format_si(self.delay_energy, 'J')}, "
                f"more than {format_si(INSTANT, 'J')}"
            )
        return f"{NOT_KEPT}: {found}; try {self.remedy}"


def _at_times(
    condition: DampingCondition, parameters: RunParameters, share: float, delay: float
) -> DampingCondition:
    """Returns a device condition at a run's share of deadlines kept and mean delay in s."""
    coupling = parameters.effective or parameters.coupling
    stiffness = parameters.scale * parameters.force_scale * coupling.stiffness
    if condition.axis == "rotation":
        ratio = parameters.force_scale / parameters.scale
        stiffness = ratio * coupling.rotational_stiffness
    needed = condition.needed / share
    if stiffness > 0.0:
        half = 0.5 * stiffness * parameters.period
        needed += DELAY_PRICE * half * half / condition.needed * delay / parameters.period
    return DampingCondition(
        condition.axis, needed, condition.available, condition.remedy, condition.delay
    )
