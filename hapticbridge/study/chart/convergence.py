"""The order of convergence: the power of the period that a method's error goes with."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from hapticbridge.study.chart.measurement import Measurement
from hapticbridge.study.chart.setting import who

RESOLVED = 1e-5
"""Error in JND below which a reference's own error may count, no unit: no order is taken from it.
Five times what the tumbling body's reference errs by."""

SETTLED = 0.1
"""Difference of the powers over the two smallest halvings up to which an order counts as settled,
no unit. A method of order p whose next term is of order p + 1 is within it when that term is
less than a tenth of the error; larger would call the slope of a knee an order."""

LEVEL = 0.1
"""Settled powers up to this, no unit, are none: the error does not shrink with the step."""


@dataclass(frozen=True, slots=True)
class Order:
    """How the error of a method goes with its period, at its three smallest resolved steps.

        p = log(felt_2/felt_1) / log(T_2/T_1),   T_1 < T_2 < T_3

    Attributes:
        power: p between the two smaller steps, no unit.
        before: p between the two larger ones.
        finest: T_1 in s.
        coarsest: T_3 in s.
    """

    power: float
    before: float
    finest: float
    coarsest: float

    @property
    def is_settled(self) -> bool:
        """Whether both powers agree; if not, the steps are too large to tell an order."""
        return abs(self.power - self.before) <= SETTLED

    @property
    def is_level(self) -> bool:
        """Whether the error stays as it is: it is the model's, not the step's."""
        return self.is_settled and abs(self.power) <= LEVEL

    @property
    def words(self) -> str:
        """The order as a picture has room for it."""
        if self.is_level:
            return "level"
        return f"order {self.power:.1f}" if self.is_settled else "order ?"


def convergence_orders(points: Sequence[Measurement]) -> dict[str, Order]:
    """Returns orders by method or engine, of the points where nothing but the period was chosen.

    A method is left out where fewer than three of its steps have an error that is finite and at
    least ``RESOLVED``.
    """
    series: dict[str, list[tuple[float, float]]] = {}
    for each in points:
        felt = each.score.felt
        if each.is_usual and math.isfinite(felt) and felt >= RESOLVED:
            series.setdefault(who(each.setting), []).append((each.setting.period, felt))
    return {name: _order(sorted(values)[:3]) for name, values in series.items() if len(values) > 2}


def _order(steps: Sequence[tuple[float, float]]) -> Order:
    (finest, first), (middle, second), (coarsest, third) = steps
    return Order(
        power=math.log(second / first) / math.log(middle / finest),
        before=math.log(third / second) / math.log(coarsest / middle),
        finest=finest,
        coarsest=coarsest,
    )
