"""Newest blow of the tool at an instant of a run, as pictures and pages show it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hapticbridge.units import format_energy, format_si

SHOWN = 0.5
"""Time in s from a blow on for which its place is marked. A longer one crowds a tool that taps."""


@dataclass(frozen=True, slots=True)
class NewestBlow:
    """Blow of the tool: ticks in a row in which a contact of it closes fast.

    Attributes:
        time: Due time of its first tick in s.
        last_tick: Number of its last tick so far.
        energy: Energy W in J that it took from the bodies so far.
        pulse: Largest pulse on the device in N since then; 0 without pulses.
        place: Position of its contact in m, (3,); of the grip if the contact is not known.
    """

    time: float
    last_tick: int
    energy: float
    pulse: float
    place: NDArray[np.float64]

    def parts(self) -> list[float]:
        """Returns numbers from which ``from_parts`` makes an equal one."""
        return [self.time, self.last_tick, self.energy, self.pulse, *self.place.tolist()]

    @classmethod
    def from_parts(cls, parts: NDArray[np.float64]) -> NewestBlow:
        """Returns the blow of seven finite numbers."""
        time, last_tick, energy, pulse = parts[:4].tolist()
        return cls(time, int(last_tick), energy, pulse, parts[4:])

    def is_marked(self, time: float) -> bool:
        """Returns True if its place is marked at a time in s."""
        return self.time <= time < self.time + SHOWN

    @property
    def words(self) -> str:
        """When it was, its energy and its pulse."""
        pulse = f", pulse {format_si(self.pulse, 'N')}" if self.pulse else ""
        return f"blow at {self.time:.3f} s: {format_energy(self.energy)}{pulse}"


def newest_blow(
    before: NewestBlow | None, rows: NDArray[np.void], place: NDArray[np.float64]
) -> NewestBlow | None:
    """Returns the newest blow after some more records.

    Args:
        before: The newest blow before them.
        rows: The records, ``TICK_DTYPE``, (n,), in order.
        place: Position in m of a blow that begins in them, (3,).
    """
    newest, pulses = before, np.linalg.norm(rows["pulse"], axis=1)
    for k in np.flatnonzero((rows["blow_energy"] > 0.0) | (pulses > 0.0)):
        tick, energy = int(rows["tick"][k]), float(rows["blow_energy"][k])
        if energy > 0.0 and (newest is None or tick != newest.last_tick + 1):
            newest = NewestBlow(1e-9 * float(rows["deadline_ns"][k]), tick, energy, 0.0, place)
        elif newest is not None:
            newest = replace(
                newest,
                last_tick=tick if energy > 0.0 else newest.last_tick,
                energy=newest.energy + energy,
                pulse=max(newest.pulse, float(pulses[k])),
            )
    return newest
