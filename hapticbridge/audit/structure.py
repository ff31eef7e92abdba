"""Is a recording whole: damage, digest, gaps, numbers that cannot be, times and flags."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit.guarded import is_first, is_ramping, silence
from hapticbridge.audit.turns import steps, turns
from hapticbridge.kernel.state import RunParameters
from hapticbridge.kernel.watch import STILL, STILL_TURN
from hapticbridge.recording import Recording
from hapticbridge.tick import CLOCK_FIELDS, TICK_DTYPE, TickFlag

TOLERANCE = 1e-9
"""Relative difference, and absolute one in SI units, between a recorded number and its second
computation in NumPy. Rounding of 10⁵ summed works stays below it; a changed digit that matters does
not. It is also the tolerance of (14) itself."""


@dataclass(frozen=True, slots=True)
class Fault:
    """What is wrong with a recording.

    Attributes:
        reason: A sentence.
        tick: The first tick at fault, or None.
        port: The field or port at fault.
        joules: Energy at fault, in J.
    """

    reason: str
    tick: int | None = None
    port: str = ""
    joules: float = 0.0


def structure_fault(
    recording: Recording, parameters: RunParameters, resumed: NDArray[np.float64]
) -> Fault | None:
    """Returns the first thing that makes the file no whole, plausible record of a run.

    Args:
        recording: What was read.
        parameters: Of the recorded run.
        resumed: Ticks at which the run went on after a pause without force.
    """
    return (
        _file_fault(recording)
        or _number_fault(recording.ticks)
        or _time_fault(recording.ticks, parameters)
        or _flag_fault(recording.ticks, parameters, resumed)
    )


def _file_fault(recording: Recording) -> Fault | None:
    if recording.problems:
        return Fault("the file is damaged: " + "; ".join(recording.problems))
    if not recording.is_cut:
        if recording.digest is None:
            return Fault("the file has no digest although it is not cut")
        if recording.digest != recording.computed_digest:
            return Fault("the file's content does not match its digest: it was changed")
    if not len(recording.ticks):
        return Fault("the recording holds no tick")
    last = int(recording.ticks["tick"][-1])
    for event in recording.events:
        if event.get("event") == "stop" and event.get("tick") != last + 1:
            return Fault(
                f"the run stopped before tick {event.get('tick')}, the last record is of {last}"
            )
    return None


def _number_fault(ticks: NDArray[np.void]) -> Fault | None:
    for name in TICK_DTYPE.names or ():
        finite = np.isfinite(ticks[name]).reshape(len(ticks), -1).all(axis=1)
        if not finite.all():
            tick = int(np.argmin(finite))
            return Fault(f"{name} of record {tick} is not finite", tick, name)
    for name in ("device_quaternion", "handle_quaternion", "tool_quaternion"):
        off = np.abs(np.linalg.norm(ticks[name], axis=1) - 1) > TOLERANCE
        off |= ticks[name][:, 0] < 0
        if off.any():
            tick = int(np.argmax(off))
            return Fault(f"{name} of tick {tick} is not a unit quaternion", tick, name)
    return None


def _time_fault(ticks: NDArray[np.void], parameters: RunParameters) -> Fault | None:
    gap = np.flatnonzero(ticks["tick"] != np.arange(len(ticks)))
    if gap.size:
        at = int(gap[0])
        before = int(ticks["tick"][at - 1]) if at else -1
        return Fault(
            f"ticks are not contiguous: {before} is followed by {int(ticks['tick'][at])}, so the "
            "energy in between is unknown",
            at,
            "tick",
        )
    period_ns = round(min(parameters.period * 1e9, 2.0**62))
    interval = np.diff(ticks["deadline_ns"], prepend=0)
    has_skipped = (ticks["flags"] & int(TickFlag.OVERRUN)) != 0
    is_multiple = (interval > period_ns) & (interval % max(period_ns, 1) == 0)
    wrong = np.where(has_skipped, ~is_multiple, interval != period_ns)
    if wrong.any():
        tick = int(np.argmax(wrong))
        claim = "an overrun is flagged and " if has_skipped[tick] else ""
        return Fault(
            f"{claim}tick {tick} is due {int(interval[tick])} ns after the one before, the period "
            f"is {period_ns} ns",
            tick,
            "deadline_ns",
        )
    times = np.stack([ticks[name] for name in CLOCK_FIELDS], axis=1)
    backwards = (np.diff(times, axis=1) < 0).any(axis=1)
    if backwards.any():
        tick = int(np.argmax(backwards))
        return Fault(f"times of tick {tick} run backwards", tick, "wake_ns")
    return None


def _flag_fault(
    ticks: NDArray[np.void], parameters: RunParameters, resumed: NDArray[np.float64]
) -> Fault | None:
    """Holds those flags that other fields repeat against them."""
    expected = {
        TickFlag.DROPPED_BEFORE: np.zeros(len(ticks), bool),  # the ticks are contiguous
        TickFlag.RAMPING: is_ramping(ticks, parameters, resumed),
        TickFlag.CONTACT: ticks["contacts"] > 0,
        **_watch_flags(ticks, parameters, resumed),
    }
    for flag, is_due in expected.items():
        wrong = ((ticks["flags"] & int(flag)) != 0) != is_due
        if wrong.any():
            tick = int(np.argmax(wrong))
            name = (flag.name or "").lower()
            return Fault(f"flag '{name}' of tick {tick} contradicts the record", tick, "flags")
    is_stale = (ticks["flags"][1:] & int(TickFlag.STALE_SAMPLE)) != 0
    for field in ("device_position", "device_quaternion"):
        moved = is_stale & (ticks[field][1:] != ticks[field][:-1]).any(axis=1)
        if moved.any():
            tick = 1 + int(np.argmax(moved))
            text = f"tick {tick} says that the device had nothing new, and its {field} differs"
            return Fault(text, tick, "flags")
    return None


def _watch_flags(
    ticks: NDArray[np.void], parameters: RunParameters, resumed: NDArray[np.float64]
) -> dict[TickFlag, NDArray[np.bool_]]:
    """Says where the handle must not have followed, and where the coupling was re-seated."""
    guarding, buttons = parameters.guarding, ticks["buttons"]
    is_released = (buttons & guarding.clutch) != 0
    if guarding.dead_man:
        is_released |= (buttons & guarding.dead_man) == 0
    was_released = np.concatenate([[guarding.dead_man != 0], is_released[:-1]])
    first = is_first(ticks, resumed)
    elapsed = np.diff(ticks["read_ns"], prepend=0) * 1e-9
    has_stalled = ~first & (elapsed > guarding.longest_stall)
    start = np.array(parameters.device_start)
    moved = np.linalg.norm(steps(ticks["device_position"], start[:3]), axis=1)
    turned = np.linalg.norm(turns(ticks["device_quaternion"], start[3:]), axis=1)
    has_strayed = first & guarding.reseats & ((moved > STILL) | (turned > STILL_TURN))
    is_silent = silence(ticks, parameters) > 0
    has_news = np.concatenate([[False], is_silent[:-1]]) & ~is_silent
    is_reseated = ~is_released & (was_released | has_news | has_stalled | has_strayed)
    return {
        TickFlag.CLUTCH: is_released,
        TickFlag.RESEATED: is_reseated,
    }
