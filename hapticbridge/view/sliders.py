"""Two sliders for one kind of axis: stiffness and damping, each as far as the other lets it go."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import viser

from hapticbridge.commands.allowed import UNITS, AxisCouplingLimits

FINENESS = 1e-3
"""Least step of a slider as a share of its largest value, rounded down to a power of ten: finer is
not felt, coarser is."""

_ROUNDING = 1.0 + 1e-9  # a bound of 2 that was found as 1.9999999999 is one of 2

SYMBOLS = {"translation": ("K", "B"), "rotation": ("K_r", "B_r")}
_WORDS = {
    "translation": ("stiffness", "damping"),
    "rotation": ("turning stiffness", "turning damping"),
}


class Sliders:
    """Stiffness and damping along one kind of axis.

    Args:
        gui: Where.
        span: What the device allows.
        want: Called when a hand has moved one of them.

    Attributes:
        span: Likewise.
    """

    def __init__(
        self, gui: viser.GuiApi, span: AxisCouplingLimits, want: Callable[[], None]
    ) -> None:
        self.span = span
        stiffness, damping = span.gains(span.start)
        self._steps = (
            _step(max(span.most_stiffness(0.0), stiffness)),
            _step(max(span.most_damping(span.least_stiffness), damping)),
        )
        least = _up(span.least_stiffness, self._steps[0])
        most = self._ends(stiffness, damping, least)
        labels = [
            f"{word} {symbol} ({unit})"
            for word, symbol, unit in zip(
                _WORDS[span.axis], SYMBOLS[span.axis], UNITS[span.axis], strict=True
            )
        ]
        shown = self._shown(stiffness, damping, (least, 0.0), most)
        self._stiffness = gui.add_slider(labels[0], least, most[0], self._steps[0], shown[0])
        self._damping = gui.add_slider(labels[1], 0.0, most[1], self._steps[1], shown[1])
        self._stiffness.on_update(by_hand(want))
        self._damping.on_update(by_hand(want))

    @property
    def value(self) -> tuple[float, float]:
        """What they show; whatever a browser has sent."""
        return self._stiffness.value, self._damping.value

    def show(self, stiffness: float, damping: float) -> None:
        """Puts them to a stiffness and damping."""
        self.bound(stiffness, damping)
        most = self._stiffness.max, self._damping.max
        shown = self._shown(stiffness, damping, (self._stiffness.min, 0.0), most)
        self._stiffness.value, self._damping.value = shown

    def bound(self, stiffness: float, damping: float) -> None:
        """Puts the end of each to where the other one lets it go."""
        self._stiffness.max, self._damping.max = self._ends(stiffness, damping, self._stiffness.min)

    def ends(self) -> str:
        """Says where they end."""
        symbols, units = SYMBOLS[self.span.axis], UNITS[self.span.axis]
        return (
            f"{symbols[0]} ends at {self._stiffness.max:g} {units[0]}, "
            f"{symbols[1]} at {self._damping.max:g} {units[1]}"
        )

    def _shown(
        self,
        stiffness: float,
        damping: float,
        least: tuple[float, float],
        most: tuple[float, float],
    ) -> tuple[float, float]:
        near = (_near(v, step) for v, step in zip((stiffness, damping), self._steps, strict=True))
        first, second = (min(max(*pair), end) for *pair, end in zip(near, least, most, strict=True))
        return first, second

    def _ends(self, stiffness: float, damping: float, least: float) -> tuple[float, float]:
        steps, span = self._steps, self.span
        return (
            max(_down(span.most_stiffness(damping), steps[0]), least + steps[0]),
            max(_down(span.most_damping(stiffness), steps[1]), steps[1]),
        )


def by_hand(act: Callable[[], None]) -> Callable[[viser.GuiEvent[Any]], None]:
    """Returns a callback that acts on what a browser changed, and not on what this process did.

    viser tells of both; what a run was given by others would come back to it as a wish.
    """

    def acts(event: viser.GuiEvent[Any]) -> None:
        if event.client_id is not None:
            act()

    return acts


def _step(most: float) -> float:
    return float(f"1e{math.floor(math.log10(FINENESS * most)):d}")


def _near(value: float, step: float) -> float:
    return float(f"{round(value / step) * step:.12g}")


def _up(value: float, step: float) -> float:
    return float(f"{math.ceil(value / step / _ROUNDING) * step:.12g}")


def _down(value: float, step: float) -> float:
    return float(f"{math.floor(value * _ROUNDING / step) * step:.12g}")
