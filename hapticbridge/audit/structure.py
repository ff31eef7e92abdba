"""Structure checks of a recording: damage, gaps, numbers, times and flags."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit.events import RunEvents
from hapticbridge.kernel.codes import CLUTCHED, FORCE_OFF
from hapticbridge.kernel.parameters import DAMPER, ENVIRONMENT, RunParameters
from hapticbridge.kernel.record import CLOCK_FIELDS, TickFlag, has_flag
from hapticbridge.kernel.tick_guard import DEVICE_BUTTONS
from hapticbridge.recording import RecordingFile

Flags = NDArray[np.bool_]

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


class Deviation(NamedTuple):
    """Deviation of a recorded field from its second computation.

    Attributes:
        field: Field of the record.
        amount: Size of the deviation in each tick, (n,).
        allowed: Largest deviation by rounding, (n,) or one number.
        unit: Unit of both.
        source: Facts that the second computation is based on.
    """

    field: str
    amount: NDArray[np.float64]
    allowed: NDArray[np.float64] | float
    unit: str
    source: str

    @classmethod
    def between(
        cls,
        field: str,
        recorded: NDArray[np.float64],
        expected: NDArray[np.float64],
        unit: str,
        source: str,
    ) -> Deviation:
        """Returns the largest deviation over the components of vectors (n, m)."""
        amount = np.abs(recorded - expected).max(axis=1)
        allowed = TOLERANCE * (1 + np.abs(expected).max(axis=1))
        return cls(field, amount, allowed, unit, source)

    def fault(self, start: int) -> Fault | None:
        """Returns the first deviation that is not rounding, or None; ``start`` is row 0's tick."""
        row = first_row(~(self.amount <= self.allowed))  # True also for NaN from an overflow
        if row is None:
            return None
        amount = float(self.amount[row])
        return Fault(
            f"{self.field} of tick {start + row} is {amount:.3g} {self.unit} off what "
            f"{self.source} give".replace("  ", " "),
            start + row,
            self.field,
            amount if self.unit == "J" else 0.0,
        )


def first_row(is_wrong: Flags) -> int | None:
    """Returns the first row that is True, or None."""
    return int(np.argmax(is_wrong)) if is_wrong.any() else None


def file_fault(recording: RecordingFile) -> Fault | None:
    """Returns a fault of the file as a whole, or None."""
    if recording.problems:
        return Fault("the file is damaged: " + "; ".join(recording.problems))
    last = recording.last_tick
    # the last rows may be lost although a later event is kept, if that was in an earlier chunk
    may_lack = recording.is_cut or any(e.get("event") == "repaired" for e in recording.events)
    for event in recording.events:
        tick = event.get("tick")
        is_fitting = tick == last + 1 or (may_lack and isinstance(tick, int) and tick > last)
        if event.get("event") == "stop" and not is_fitting:
            held = f"the last record is of {last}" if recording.count else "no tick is recorded"
            return Fault(f"the run stopped before tick {event.get('tick')}, {held}")
    return None


def structure_fault(blocks: Iterable[NDArray[np.void]], events: RunEvents) -> Fault | None:
    """Returns the first fault that makes records implausible, or None.

    Impossible numbers come before times, times before flags, each at its earliest tick. No block
    may be empty.
    """
    earliest: dict[int, Fault] = {}
    before: NDArray[np.void] | None = None
    count = 0
    for ticks in blocks:
        before = ticks[:0] if before is None else before
        for rank, fault in enumerate(_faults(ticks, before, count, events)):
            if fault is not None:
                earliest.setdefault(rank, fault)
        before, count = ticks[-1:], count + len(ticks)
    return earliest[min(earliest)] if earliest else None


def _faults(
    ticks: NDArray[np.void], before: NDArray[np.void], count: int, events: RunEvents
) -> Iterator[Fault | None]:
    """Yields one result per check, in order of rank.

    ``before`` is the record before these, or none; ``count`` is the number of earlier records.
    """
    yield from _number_faults(ticks, count)
    yield _gap(ticks, before, count)
    yield _wrong_deadline(ticks, before, count, events.parameters)
    times = np.stack([ticks[name] for name in CLOCK_FIELDS], axis=1)
    backwards = np.asarray(np.diff(times, axis=1).min(axis=1) < 0)
    yield _first(backwards, count, "times of tick {} run backwards", "wake_ns")
    yield from _flag_faults(ticks, before, count, events)
    wrong = (ticks["buttons"] & ~DEVICE_BUTTONS) != events.buttons(ticks["tick"])
    text = "buttons of tick {} do not show what the events commanded"
    yield _first(wrong, count, text, "buttons")


def _first(is_wrong: Flags, start: int, text: str, port: str) -> Fault | None:
    """Returns the fault of the first wrong record, or None; ``text`` has ``{}`` for the tick."""
    row = first_row(is_wrong)
    return None if row is None else Fault(text.format(start + row), start + row, port)


def _number_faults(ticks: NDArray[np.void], count: int) -> Iterator[Fault | None]:
    for name in ticks.dtype.names or ():
        finite = np.isfinite(ticks[name]).reshape(len(ticks), -1).all(axis=1)
        yield _first(~finite, count, f"{name} of record {{}} is not finite", name)
    for name in ("device_quaternion", "handle_quaternion", "tool_quaternion"):
        off = np.abs(np.linalg.norm(ticks[name], axis=1) - 1) > TOLERANCE
        off |= ticks[name][:, 0] < 0
        yield _first(off, count, f"{name} of tick {{}} is not a unit quaternion", name)


def _gap(ticks: NDArray[np.void], before: NDArray[np.void], count: int) -> Fault | None:
    row = first_row(ticks["tick"] != count + np.arange(len(ticks)))
    if row is None:
        return None
    last = (
        int(np.concatenate([before, ticks])["tick"][row + before.size - 1]) if count + row else -1
    )
    return Fault(
        f"ticks are not contiguous: {last} is followed by {int(ticks['tick'][row])}, so the "
        "energy in between is unknown",
        count + row,
        "tick",
    )


def _wrong_deadline(
    ticks: NDArray[np.void], before: NDArray[np.void], count: int, parameters: RunParameters
) -> Fault | None:
    period_ns = round(min(parameters.period * 1e9, 2.0**62))
    due_before = before["deadline_ns"] if before.size else np.zeros(1, np.int64)
    interval = np.diff(ticks["deadline_ns"], prepend=due_before)
    has_skipped = has_flag(ticks, TickFlag.OVERRUN)
    is_multiple = (interval > period_ns) & (interval % max(period_ns, 1) == 0)
    row = first_row(np.where(has_skipped, ~is_multiple, interval != period_ns))
    if row is None:
        return None
    claim = "an overrun is flagged and " if has_skipped[row] else ""
    return Fault(
        f"{claim}tick {count + row} is due {int(interval[row])} ns after the one before, the "
        f"period is {period_ns} ns",
        count + row,
        "deadline_ns",
    )


def is_clutched(ticks: NDArray[np.void], parameters: RunParameters) -> Flags:
    """Returns True for each record in which the hand has let the handle go."""
    guarding, buttons = parameters.guarding, ticks["buttons"]
    is_released = (buttons & (guarding.clutch | CLUTCHED)) != 0
    if guarding.dead_man:
        is_released |= (buttons & guarding.dead_man) == 0
    is_out = np.linalg.norm(ticks["device_position"], axis=1) > guarding.reach
    return np.asarray(is_released | is_out)


def is_let_go(ticks: NDArray[np.void], parameters: RunParameters) -> Flags:
    """Returns True for each record whose lever falls by a button, a command or the reach."""
    return np.asarray(is_clutched(ticks, parameters) | ((ticks["buttons"] & FORCE_OFF) != 0))


def may_fade(ticks: NDArray[np.void]) -> Flags:
    """Returns True for each record whose lever may fall, also after several old samples."""
    is_off = (ticks["buttons"] & FORCE_OFF) != 0
    return np.asarray(is_off | has_flag(ticks, TickFlag.CLUTCH | TickFlag.STALE_SAMPLE))


def _flag_faults(
    ticks: NDArray[np.void], before: NDArray[np.void], count: int, events: RunEvents
) -> Iterator[Fault | None]:
    """Compares flags with the fields that imply or exclude them."""
    parameters = events.parameters
    guarding = parameters.guarding
    none, every = np.zeros(len(ticks), bool), np.ones(len(ticks), bool)
    is_released, is_touching = is_clutched(ticks, parameters), ticks["contacts"] > 0
    is_partial = ticks["lever"] < 1
    controls = guarding.controller == DAMPER
    controls |= guarding.controller == ENVIRONMENT and parameters.has_law
    for flag, is_due, is_possible in (
        (TickFlag.DROPPED_BEFORE, none, none),  # the ticks are contiguous
        (TickFlag.CONTACT, is_touching, is_touching),
        (TickFlag.CLUTCH, is_released, is_released),
        (TickFlag.RAMPING, is_partial, is_partial),
        (TickFlag.CONTROLLER_ACTIVE, none, every & (controls or math.isfinite(guarding.energy))),
        (TickFlag.SWINGING, none, every & math.isfinite(guarding.swing_energy)),
        (TickFlag.RUNS_AWAY, none, every & math.isfinite(guarding.runaway_speed)),
        (TickFlag.PROBED, none, every & math.isfinite(guarding.runaway_speed)),
    ):
        has = has_flag(ticks, flag)
        name = (flag.name or "").lower()
        text = f"flag '{name}' of tick {{}} contradicts the record"
        yield _first((is_due & ~has) | (has & ~is_possible), count, text, "flags")
    rows = np.concatenate([before, ticks])
    is_stale = has_flag(rows[1:], TickFlag.STALE_SAMPLE)
    for field in ("device_position", "device_quaternion"):
        moved = is_stale & (rows[field][1:] != rows[field][:-1]).any(axis=1)
        text = f"tick {{}} says that the device had nothing new, and its {field} differs"
        yield _first(moved, count + 1 - before.size, text, "flags")
