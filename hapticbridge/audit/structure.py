"""Structure checks of a recording: damage, digest, gaps, numbers, times and flags."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit.events import RunEvents
from hapticbridge.audit.guard import Seen, Watch
from hapticbridge.kernel.guard import DEVICE_BUTTONS
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.record import CLOCK_FIELDS, TICK_DTYPE, TickFlag
from hapticbridge.recording import RecordingFile

TOLERANCE = 1e-9
"""Tolerance between a recorded number and its second computation: relative, and absolute in SI
units. Rounding of 10⁵ summed works stays below it; a relevant changed digit does not. It is also
the tolerance of (14) itself."""


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault of a recording.

    Attributes:
        reason: Description in a sentence.
        tick: First tick at fault, or None.
        port: Field or port at fault.
        joules: Energy at fault, in J.
    """

    reason: str
    tick: int | None = None
    port: str = ""
    joules: float = 0.0


def file_fault(recording: RecordingFile) -> Fault | None:
    """Returns a fault of the file as a whole, or None."""
    if recording.problems:
        return Fault("the file is damaged: " + "; ".join(recording.problems))
    if not recording.is_cut:
        if recording.digest is None:
            return Fault("the file has no digest although it is not cut")
        if recording.digest != recording.computed_digest:
            return Fault("the file's content does not match its digest: it was changed")
    if not recording.count:
        return Fault("the recording holds no tick")
    last = recording.last_tick
    # the last rows may be lost although a later event is kept, if that was in an earlier chunk
    may_lack = recording.is_cut or any(e.get("event") == "repaired" for e in recording.events)
    for event in recording.events:
        tick = event.get("tick")
        is_fitting = tick == last + 1 or (may_lack and isinstance(tick, int) and tick > last)
        if event.get("event") == "stop" and not is_fitting:
            return Fault(
                f"the run stopped before tick {event.get('tick')}, the last record is of {last}"
            )
    return None


def structure_fault(
    blocks: Iterable[NDArray[np.void]], parameters: RunParameters, outside: RunEvents
) -> Fault | None:
    """Returns the first fault that makes records implausible, or None.

    Impossible numbers come before times, times before flags, each at its earliest tick. No block
    may be empty.
    """
    found: dict[int, Fault] = {}
    before: NDArray[np.void] = np.zeros(0, TICK_DTYPE)
    count, watch = 0, Watch.at_start(parameters)
    for ticks in blocks:
        seen, watch = watch.after(ticks, outside)
        checks = chain(
            _number_faults(ticks, count),
            _time_faults(ticks, before, count, parameters),
            _flag_faults(ticks, before, count, seen),
            _command_faults(ticks, count, outside),
        )
        for rank, fault in enumerate(checks):
            if fault is not None:
                found.setdefault(rank, fault)
        before, count = ticks[-1:], count + len(ticks)
    return found[min(found)] if found else None


def _first(is_wrong: NDArray[np.bool_], start: int, text: str, port: str) -> Fault | None:
    """Returns the fault of the first wrong record, or None.

    ``text`` has ``{}`` for the tick.
    """
    if not is_wrong.any():
        return None
    tick = start + int(np.argmax(is_wrong))
    return Fault(text.format(tick), tick, port)


def _command_faults(
    ticks: NDArray[np.void], count: int, outside: RunEvents
) -> Iterator[Fault | None]:
    wrong = (ticks["buttons"] & ~DEVICE_BUTTONS) != outside.buttons(ticks["tick"])
    text = "buttons of tick {} do not show what the events commanded"
    yield _first(wrong, count, text, "buttons")


def _number_faults(ticks: NDArray[np.void], count: int) -> Iterator[Fault | None]:
    for name in TICK_DTYPE.names or ():
        finite = np.isfinite(ticks[name]).reshape(len(ticks), -1).all(axis=1)
        yield _first(~finite, count, f"{name} of record {{}} is not finite", name)
    for name in ("device_quaternion", "handle_quaternion", "tool_quaternion"):
        off = np.abs(np.linalg.norm(ticks[name], axis=1) - 1) > TOLERANCE
        off |= ticks[name][:, 0] < 0
        yield _first(off, count, f"{name} of tick {{}} is not a unit quaternion", name)


def _time_faults(
    ticks: NDArray[np.void], before: NDArray[np.void], count: int, parameters: RunParameters
) -> Iterator[Fault | None]:
    yield _gap(ticks, before, count)
    yield _wrong_deadline(ticks, before, count, parameters)
    times = np.stack([ticks[name] for name in CLOCK_FIELDS], axis=1)
    backwards = np.asarray(np.diff(times, axis=1).min(axis=1) < 0)
    yield _first(backwards, count, "times of tick {} run backwards", "wake_ns")


def _gap(ticks: NDArray[np.void], before: NDArray[np.void], count: int) -> Fault | None:
    gap = np.flatnonzero(ticks["tick"] != count + np.arange(len(ticks)))
    if not gap.size:
        return None
    at = int(gap[0])
    last = int(np.concatenate([before, ticks])["tick"][at + before.size - 1]) if count + at else -1
    return Fault(
        f"ticks are not contiguous: {last} is followed by {int(ticks['tick'][at])}, so the "
        "energy in between is unknown",
        count + at,
        "tick",
    )


def _wrong_deadline(
    ticks: NDArray[np.void], before: NDArray[np.void], count: int, parameters: RunParameters
) -> Fault | None:
    period_ns = round(min(parameters.period * 1e9, 2.0**62))
    due_before = before["deadline_ns"] if before.size else np.zeros(1, np.int64)
    interval = np.diff(ticks["deadline_ns"], prepend=due_before)
    has_skipped = (ticks["flags"] & int(TickFlag.OVERRUN)) != 0
    is_multiple = (interval > period_ns) & (interval % max(period_ns, 1) == 0)
    wrong = np.where(has_skipped, ~is_multiple, interval != period_ns)
    if not wrong.any():
        return None
    at = int(np.argmax(wrong))
    claim = "an overrun is flagged and " if has_skipped[at] else ""
    return Fault(
        f"{claim}tick {count + at} is due {int(interval[at])} ns after the one before, the period "
        f"is {period_ns} ns",
        count + at,
        "deadline_ns",
    )


def _flag_faults(
    ticks: NDArray[np.void], before: NDArray[np.void], count: int, seen: Seen
) -> Iterator[Fault | None]:
    """Compares flags with the fields that imply them."""
    expected = {
        TickFlag.DROPPED_BEFORE: np.zeros(len(ticks), bool),  # the ticks are contiguous
        TickFlag.CONTACT: ticks["contacts"] > 0,
        **seen.flags,
    }
    for flag, is_due in expected.items():
        wrong = ((ticks["flags"] & int(flag)) != 0) != is_due
        name = (flag.name or "").lower()
        text = f"flag '{name}' of tick {{}} contradicts the record"
        yield _first(wrong, count, text, "flags")
    rows = np.concatenate([before, ticks])
    is_stale = (rows["flags"][1:] & int(TickFlag.STALE_SAMPLE)) != 0
    for field in ("device_position", "device_quaternion"):
        moved = is_stale & (rows[field][1:] != rows[field][:-1]).any(axis=1)
        text = f"tick {{}} says that the device had nothing new, and its {field} differs"
        yield _first(moved, count + 1 - before.size, text, "flags")
