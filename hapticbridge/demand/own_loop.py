"""Account of a loop of the device's own, from what it reports in a run."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticbridge.arguments import is_number
from hapticbridge.demand.timekeeping import RunTimes
from hapticbridge.errors import RecordingError
from hapticbridge.units import format_energy, format_si

EVENT = "own_loop"
"""Event with what the loop has reported since the last one."""

REPORT_DTYPE = np.dtype([("tick", "<i8"), ("work", "<f8"), ("passed", "<f8"), ("tank", "<f8")])
"""Report of a device's own loop at a sample: tick of the run, W of the newest tool that it had been
shown, Σ P and D, all in J."""

COUNTERS = ("changes", "ticks", "missed")
"""Counters of the loop that are recorded, since it began (``device.own_loop.LoopReport``)."""

TEMPERATURES = ("temperature", "temperature_limit")
"""Temperature of the motors and its limit in °C; each is recorded where the device reports it."""

HOT = 10.0
"""Temperature in °C below its limit from which motors count as hot. A winding rises by about a
degree per second at full force; a larger value warns of motors that would have stayed below."""

ROUNDING = 1e-6
"""Energy in J by which Σ P may pass its bound: the loop adds in single precision."""

UNCOUNTED = 1.0
"""Time in s at the ends of a run that counters of the loop may lack: they come about 30 times per
second, and a link may lose some. A larger one certifies longer runs without any."""

_COUNTED = 2**32
"""Periods after which a counter of the board begins anew."""


@dataclass(frozen=True, slots=True)
class OwnLoopAccount:
    """Account of a loop of the device's own: the hand got no more than the scene had released.

        Σ P >= min W

    W is what the scene has taken through the coupling, and P what the loop's coupling has given to
    the tool that it was shown, in J. On a device that meets its condition the hand has put in at
    least Σ P and what the spring holds.

    Attributes:
        period: T_b in s.
        resolution: Step of its encoder in m; 0 if exact or unknown.
        passed: Σ P at the end in J.
        work: W that the loop knew at the end in J.
        released: Largest −W that it knew in J, >= 0.
        excess: Largest −Σ P beyond the largest −W until then, in J.
        excess_tick: Tick of the first excess over ``ROUNDING``; −1 without one.
        periods: Periods of the loop in the run.
        missed: Periods that came too late.
        changes: Σ |w_k − w_{k−1}| over periods and axes in N.
        temperature: Highest temperature of the motors in °C; None if unknown.
        temperature_limit: Temperature in °C at which the device switches them off; None if unknown.
    """

    period: float
    resolution: float
    passed: float = 0.0
    work: float = 0.0
    released: float = 0.0
    excess: float = 0.0
    excess_tick: int = -1
    periods: int = 0
    missed: int = 0
    changes: float = 0.0
    temperature: float | None = None
    temperature_limit: float | None = None

    def times(self, times: RunTimes, period: float) -> RunTimes:
        """Returns the times of a run as those of the loop: it reads in time or misses a period.

        Periods that its counters lack are missed ones. ``period`` is T of the run in s.
        """
        periods = max(self.periods, 1)
        least = (times.due * period - UNCOUNTED) / self.period
        return replace(
            times,
            ticks=periods,
            due=max(periods + self.missed, int(least)),
            fresh=1.0,
            new_samples=periods,
            mean_delay=0.0,
            mean_jitter=0.0,
            delay_energy=0.0,
        )

    @property
    def first_excess(self) -> tuple[int, float] | None:
        """First tick in which the hand got more than the scene had released, and the most in J."""
        return None if self.excess_tick < 0 else (self.excess_tick, self.excess)

    @property
    def fault(self) -> str:
        """Clause on energy that the loop's own account does not allow; or empty."""
        if self.excess_tick < 0:
            return ""
        return (
            f"the device's loop reports that the hand got {format_energy(self.excess)} more than "
            "the scene had released: its firmware does not keep its account"
        )

    @property
    def words(self) -> str:
        """Clause on the loop: rate, missed periods, and energies."""
        missed = f"{self.missed} of {self.periods + self.missed}" if self.missed else "none"
        told = (
            f"{format_si(1.0 / self.period, 'Hz')} on the device, {missed} of its periods missed; "
            f"the hand gave {format_energy(self.passed)}, the scene took {format_energy(self.work)}"
        )
        if self.resolution:
            blur = format_energy(0.5 * self.resolution * self.changes)
            told += f" (steps of the encoder blur this by {blur})"
        return f"{told}; {self.heat}" if self.heat else told

    @property
    def heat(self) -> str:
        """Clause on the highest temperature of the motors; empty if unknown."""
        if self.temperature is None:
            return ""
        most = f"its motors reached {self.temperature:.0f} °C"
        if self.temperature_limit is None:
            return most
        return f"{most}, and are switched off at {self.temperature_limit:.0f} °C"

    @property
    def is_hot(self) -> bool:
        """True if the motors came near the temperature at which they are switched off."""
        temperature, limit = self.temperature, self.temperature_limit
        return temperature is not None and limit is not None and temperature > limit - HOT


@dataclass(slots=True)
class OwnLoopTally:
    """Collects reports in the order of a run.

    Attributes:
        account: The account so far.
    """

    account: OwnLoopAccount
    _first: Mapping[str, float] | None = None
    _before: float | None = None  # what the loop had passed on before the run

    @classmethod
    def begin(cls, period: float, resolution: float) -> OwnLoopTally:
        """Returns a tally without a report; arguments as for ``OwnLoopAccount``."""
        return cls(OwnLoopAccount(period, resolution))

    def add(self, reports: NDArray[np.void], counters: Mapping[str, float]) -> None:
        """Adds reports, and counters and temperatures of the loop if they are known."""
        own = self.account
        if reports.size:
            if self._before is None:
                self._before = float(reports["passed"][0])
            passed = reports["passed"] - self._before
            released = np.maximum(np.maximum.accumulate(-reports["work"]), own.released)
            over = -passed - released
            beyond = np.flatnonzero(over > ROUNDING)
            tick = own.excess_tick
            if tick < 0 and beyond.size:
                tick = int(reports["tick"][beyond[0]])
            own = replace(
                own,
                passed=float(passed[-1]),
                work=float(reports["work"][-1]),
                released=float(released[-1]),
                excess=max(own.excess, float(over.max())),
                excess_tick=tick,
            )
        if (heat := counters.get("temperature")) is not None:
            warmest = heat if own.temperature is None else max(heat, own.temperature)
            limit = counters.get("temperature_limit", own.temperature_limit)
            own = replace(own, temperature=warmest, temperature_limit=limit)
        if "ticks" in counters:
            self._first = first = self._first or counters
            own = replace(
                own,
                periods=int(counters["ticks"] - first["ticks"]) % _COUNTED,
                missed=int(counters["missed"] - first["missed"]) % _COUNTED,
                changes=counters["changes"] - first["changes"],
            )
        self.account = own

    def of_events(self, events: Iterable[Mapping[str, Any]]) -> OwnLoopAccount:
        """Adds recorded events; returns the account.

        Raises:
            RecordingError: One of them is damaged.
        """
        for event in events:
            self.add(*_read(event))
        return self.account


def _read(event: Mapping[str, Any]) -> tuple[NDArray[np.void], dict[str, float]]:
    try:
        reports = np.frombuffer(base64.b64decode(event["reports"], validate=True), REPORT_DTYPE)
        counters = {name: event[name] for name in (*COUNTERS, *TEMPERATURES) if name in event}
        known = sum(name in event for name in COUNTERS)
        is_whole = known in (0, len(COUNTERS)) and all(map(is_number, counters.values()))
        numbers = [reports[name] for name in REPORT_DTYPE.names or ()]
        is_sound = all(np.isfinite(each).all() for each in numbers)
    except (KeyError, TypeError, ValueError):
        is_whole = is_sound = False
    if not (is_whole and is_sound):
        raise RecordingError(f"event '{EVENT}' at tick {event.get('tick')!r} is damaged")
    return reports, counters
