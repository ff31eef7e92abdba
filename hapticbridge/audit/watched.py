"""Second computation of the watch on device samples."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit.differences import steps, turn_between, turns
from hapticbridge.audit.interventions import Interventions
from hapticbridge.audit.limited import limits_on_tool, spring_energy
from hapticbridge.kernel.codes import CLUTCHED, FORCE_OFF
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.kernel.watch import STILL, STILL_TURN
from hapticbridge.tick import TickFlag

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

_ROUNDING = 1e-6
"""Largest rounding difference of two sums, in ticks of a ramp."""


def has_flag(ticks: NDArray[np.void], flag: TickFlag) -> Flags:
    """Returns True for each record with a flag."""
    return np.asarray((ticks["flags"] & int(flag)) != 0)


def run_lengths(is_on: Flags, before: int) -> NDArray[np.int64]:
    """Returns the length of the uninterrupted run of True values up to each row.

    ``before`` is the length of the run before the first row.
    """
    index = np.arange(1, len(is_on) + 1)
    return np.asarray(index - np.maximum.accumulate(np.where(is_on, -before, index)))


@dataclass(frozen=True, slots=True)
class Seen:
    """Result of the watch for some ticks.

    Attributes:
        first: True for the first tick after a start or a pause without force.
        interval: Time in s since the device's last new sample, at least T between two readings.
        since_start: Ticks since the wrench began to rise.
        ramp: Length of the rise in ticks: long after a start, short after a re-anchoring.
        silence: Number of ticks for which the wrench has been fading.
        flags: Expected values of redundant flags.
        share: Share of the wrench transmitted by ramp and fading.
    """

    first: Flags
    interval: Array
    since_start: Array
    ramp: Array
    silence: NDArray[np.int64]
    flags: dict[TickFlag, Flags]
    share: Array


@dataclass(slots=True)
class Watch:
    """State of the watch after the previous tick.

    Attributes:
        parameters: Run parameters.
        device: Device pose (7,).
        read_ns: Time of the device reading.
        stale: Number of consecutive ticks without a new sample.
        silent: Number of ticks for which the wrench has been fading.
        since_news: Time in s without a new sample.
        is_released: True if the handle did not follow the device.
        start: Tick at which the wrench began to rise.
        is_soon: True if that rise was a short one.
        risen: Progress of the rise, in ticks of a ramp.
    """

    parameters: RunParameters
    device: Array
    read_ns: int = 0
    stale: int = 0
    silent: int = 0
    since_news: float = 0.0
    is_released: bool = False
    start: int = 0
    is_soon: bool = False
    risen: float = 0.0

    @classmethod
    def at_start(cls, parameters: RunParameters) -> Watch:
        """Returns the state before the first tick."""
        is_released = parameters.guarding.dead_man != 0
        return cls(parameters, np.array(parameters.device_start), is_released=is_released)

    def after(self, ticks: NDArray[np.void], outside: Interventions) -> tuple[Seen, Watch]:
        """Evaluates the next records, ``TICK_DTYPE``, at least one."""
        guarding, period = self.parameters.guarding, self.parameters.period
        index = np.arange(len(ticks))
        first = (ticks["tick"] == 0) | np.isin(ticks["tick"], outside.resumed)
        raw = np.diff(ticks["read_ns"], prepend=self.read_ns) * 1e-9
        elapsed = np.maximum(raw, period)
        is_stale = has_flag(ticks, TickFlag.STALE_SAMPLE)
        stale = run_lengths(is_stale, self.stale)
        interval = elapsed.copy()
        interval[0] += self.since_news
        # added one by one, so that the sums do not depend on the blocks
        for k in (1 + np.flatnonzero(is_stale[:-1])).tolist():
            interval[k] += interval[k - 1]

        is_released = (ticks["buttons"] & (guarding.clutch | CLUTCHED)) != 0
        if guarding.dead_man:
            is_released |= (ticks["buttons"] & guarding.dead_man) == 0
        is_released |= np.linalg.norm(ticks["device_position"], axis=1) > guarding.reach
        is_silent = is_released | ((ticks["buttons"] & FORCE_OFF) != 0)
        if guarding.stale_ticks > 0:
            is_silent |= stale > guarding.stale_ticks
        silence = run_lengths(is_silent, self.silent)

        was_released = np.concatenate([[self.is_released], is_released[:-1]])
        has_news = np.concatenate([[self.silent > 0], is_silent[:-1]]) & ~is_silent
        has_stalled = ~first & (raw > guarding.longest_stall)
        moved = np.linalg.norm(steps(ticks["device_position"], self.device[:3]), axis=1)
        turned = np.linalg.norm(turns(ticks["device_quaternion"], self.device[3:]), axis=1)
        has_strayed = first & guarding.reseats & ((moved > STILL) | (turned > STILL_TURN))
        is_reset = outside.is_reset(ticks["tick"])
        is_seated = ~is_released & (was_released | has_news | has_stalled | has_strayed | is_reset)

        begins = first | is_seated
        pace = self._ramp_pace(ticks, outside, begins)
        last = np.maximum.accumulate(np.where(begins, index, -1))
        start = np.where(last >= 0, ticks["tick"][last], self.start)
        is_soon = np.where(last >= 0, (is_seated & ~first)[last], self.is_soon)
        since_start = (ticks["tick"] - start).astype(np.float64)
        ramp = np.where(is_soon, guarding.fade_ticks, self.parameters.ramp_ticks)
        risen = self._ramp_progress(pace, last, ramp + 1.0)
        rising = risen / (ramp + 1.0)
        fading = np.maximum(1.0 - silence / guarding.fade_ticks, 0.0)
        flags = {
            TickFlag.CLUTCH: is_released,
            TickFlag.RESEATED: is_seated,
            TickFlag.RAMPING: _expected_ramping(ticks, risen, ramp + 1.0),
        }
        seen = Seen(first, interval, since_start, ramp, silence, flags, rising * fading)
        then = copy.copy(self)
        row = ticks[-1]
        then.device = np.concatenate([row["device_position"], row["device_quaternion"]])
        then.read_ns = int(row["read_ns"])
        then.stale, then.silent = int(stale[-1]), int(silence[-1])
        then.since_news = float(interval[-1]) if is_stale[-1] else 0.0
        then.is_released = bool(is_released[-1])
        then.risen = float(risen[-1])
        then.start, then.is_soon = int(start[-1]), bool(is_soon[-1])
        return seen, then

    def _ramp_progress(self, pace: Array, last: NDArray[np.int64], full: Array) -> Array:
        """Returns the progress of the rise, in ticks of a ramp.

        ``pace`` is the largest progress in each tick. The rise began in row ``last``, −1 before
        these rows, and ends at ``full``.
        """
        gone = np.cumsum(pace)
        before = np.where(last >= 0, gone[last] - pace[last], -self.risen)
        return np.minimum(gone - before, full)

    def _ramp_pace(self, ticks: NDArray[np.void], outside: Interventions, begins: Flags) -> Array:
        """Returns the largest progress in each tick, in ticks of a ramp, (n,).

        It is min(1, V_0/V) for the energy V stored in the coupling at the recorded poses.
        """
        parameters, pace = self.parameters, np.ones(len(ticks))
        most = parameters.guarding.ramp_energy
        full = (parameters.guarding.fade_ticks if self.is_soon else parameters.ramp_ticks) + 1.0
        has_risen = self.risen >= full and not begins.any()
        if not parameters.has_law or not np.isfinite(most) or has_risen:
            return pace
        gains = outside.laws(ticks["tick"])
        stretch = ticks["handle_position"] - ticks["tool_position"]
        twist = turn_between(ticks["tool_quaternion"], ticks["handle_quaternion"])
        held = np.zeros(len(ticks))
        for column, limit, e in zip(
            (0, 2), limits_on_tool(parameters), (stretch, twist), strict=True
        ):
            held += spring_energy(gains[:, column], np.linalg.norm(e, axis=1), limit)
        held *= parameters.force_scale / parameters.scale
        return np.divide(most, held, out=pace, where=held > most)


def _expected_ramping(ticks: NDArray[np.void], risen: Array, full: Array) -> Flags:
    """Returns the expected flag; where rounding decides, the recorded one."""
    is_close = (np.abs(risen - full) < _ROUNDING) & (risen != np.rint(risen))
    return np.where(is_close, has_flag(ticks, TickFlag.RAMPING), risen < full)
