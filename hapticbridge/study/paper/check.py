"""One comparison of two numbers that should agree."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

Relation = Literal["equals", "at most", "at least"]
"""How the number that was got must stand to the expected one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """A number of the paper, got by two routes.

    The routes share as little as can be, and ``route`` says what was done. A closed form and its
    sweep over frequency have only the coupling in common. A time-domain loop takes its worst hand
    from the theory, and finds the limit itself. Where only a kept value stands against the code,
    ``route`` says that too.

    Attributes:
        equation: Which equation it belongs to, as the paper numbers it: ``(6)``.
        quantity: What the number is.
        route: How ``got`` was found, against how ``expected`` was.
        expected: What the equation says.
        got: What the other route says.
        tolerance: Largest deviation that passes, relative to ``expected``, or in the number's own
            unit where ``expected`` is 0.
        unit: Of both numbers.
        relation: ``equals``, or which bound ``expected`` is for ``got``.
    """

    equation: str
    quantity: str
    route: str
    expected: float
    got: float
    tolerance: float
    unit: str = ""
    relation: Relation = "equals"

    @property
    def deviation(self) -> float:
        """How far ``got`` is on the wrong side, relative unless ``expected`` is 0; nan is kept."""
        if self.got == self.expected:  # two infinities have no difference
            return 0.0
        difference = self.got - self.expected
        if self.relation == "equals":
            difference = abs(difference)
        elif self.relation == "at least":
            difference = -difference
        if math.isfinite(self.expected) and self.expected != 0:
            difference /= abs(self.expected)
        return difference if not difference < 0 else 0.0

    @property
    def has_passed(self) -> bool:
        """Whether the deviation is within the tolerance; never for nan."""
        return self.deviation <= self.tolerance
