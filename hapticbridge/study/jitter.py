"""When the ticks of a run in simulated time come: late by a random share, or missed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hapticbridge.arguments import Arguments
from hapticbridge.errors import StudyError

PARTS = 16
"""Parts of a period in which jitter is counted. The device is exact between any two of them; more
parts resolve jitter finer and cost a device step each."""

_ARGUMENTS = Arguments(StudyError)


@dataclass(frozen=True, slots=True)
class Timing:
    """When ticks happen, as a share of the period and without unit.

    Attributes:
        jitter: Every tick is late by a random share in [0, jitter] of the period, 0 <= jitter < 1,
            in whole sixteenths, of which every one up to jitter is equally likely; below 1/16 no
            tick is late.
        drops: Share of ticks that are missed, 0 <= drops < 1: the wrench is held on.
        seed: Of the random numbers.

    Raises:
        StudyError: A value is no number or out of range.
    """

    jitter: float = 0.0
    drops: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("jitter", "drops"):
            value = _ARGUMENTS.number(name, getattr(self, name), least=0.0)
            if not value < 1:
                raise StudyError(f"{name} is {value!r}; it must be a share, 0 <= {name} < 1")
            object.__setattr__(self, name, value)
        _ARGUMENTS.whole("seed", self.seed, least=0, most=2**63 - 1)

    @property
    def is_even(self) -> bool:
        """Whether every tick comes on time."""
        return self.jitter < 1 / PARTS and self.drops == 0

    def intervals(self, ticks: int) -> NDArray[np.int64]:
        """Returns the time before each tick in sixteenths of the period, shape (ticks,)."""
        generator = np.random.default_rng(self.seed)
        late = generator.integers(0, int(self.jitter * PARTS) + 1, ticks)
        missed = generator.geometric(1 - self.drops, ticks) - 1 if self.drops else 0
        return np.asarray(PARTS * (1 + missed) + np.diff(late, prepend=0), dtype=np.int64)
