"""Which points a chart has: a selection, not the full product."""

from __future__ import annotations

from collections.abc import Sequence

from hapticbridge.errors import StudyError
from hapticbridge.kernel.codes import DIRECT, LOSSLESS
from hapticbridge.rendering import METHODS, Method, method_named
from hapticbridge.study.chart.setting import CONTACTS, SHIPPED, Setting

PERIODS_MS = (4.0, 2.0, 1.0, 0.5, 0.25, 0.125)
"""T in ms where nobody chooses: 250 Hz to 8 kHz."""

QUICK_PERIODS_MS = (4.0, 1.0, 0.25)
"""Likewise, of a quick chart."""

USUAL_MS = 1.0
"""T in ms at which everything but the time step is varied."""

SUBSTEPS = (2, 4, 8)
ITERATIONS = (1, 2, 5, 20)
"""The most solver iterations; MuJoCo's own limit is 100 and it rarely needs more than ten."""

VARIED = ("implicit", "lossless")
"""Methods whose contacts and solver are varied: the two that are meant for a device. The others
answer to a contact as 'implicit' does, by the same solver."""

LEAST_MS, MOST_MS = 0.02, 20.0
"""Range of T in ms: 50 kHz to 50 Hz. Beyond, nothing haptic runs."""


def chosen_methods(names: Sequence[str] | None) -> list[Method]:
    """Returns methods by name, all of them for None.

    Raises:
        StudyError: No name is given.
        SceneError: A name is none of a method's.
    """
    if names is None:
        return list(METHODS.values())
    if not names:
        raise StudyError("methods is empty; name one or more")
    return [method_named(name) for name in dict.fromkeys(names)]


def chosen_periods(steps_ms: Sequence[float] | None, *, is_quick: bool = False) -> list[float]:
    """Returns the periods T in s, longest first.

    Args:
        steps_ms: In ms; None for ``PERIODS_MS``.
        is_quick: Whether None means ``QUICK_PERIODS_MS``.

    Raises:
        StudyError: One is out of range or does not divide the longest, so that there would be no
            common instants to compare at.
    """
    if steps_ms is None:
        steps_ms = QUICK_PERIODS_MS if is_quick else PERIODS_MS
    steps = sorted({float(step) for step in steps_ms}, reverse=True)
    if not steps:
        raise StudyError("steps is empty; name one or more time steps in ms")
    for step in steps:
        if not LEAST_MS <= step <= MOST_MS:
            raise StudyError(
                f"a step is {step!r} ms; it must be between {LEAST_MS:g} and {MOST_MS:g}"
            )
        if abs(steps[0] / step - round(steps[0] / step)) > 1e-9:
            raise StudyError(
                f"step {step:g} ms does not divide {steps[0]:g} ms; all steps must divide the "
                "longest, or there are no common instants to compare at"
            )
    return [1e-3 * step for step in steps]


def settings_for(
    methods: Sequence[Method], periods: Sequence[float], *, has_contact: bool
) -> list[Setting]:
    """Returns the points of a chart.

    Every method at every period. At 1 ms, or the period nearest to it, also: every method with 2, 4
    and 8 substeps, unless it cannot divide a tick; and where something can touch, the methods of
    ``VARIED`` with every contact setting, and with few solver iterations. The contact settings are
    tried at the next smaller period too: what is right at one step alone is right by luck.

    Args:
        methods: Which.
        periods: T in s.
        has_contact: Whether anything in the scene can touch.
    """
    points = [Setting(method, period) for method in methods for period in periods]
    usual = min(periods, key=lambda period: abs(period - 1e-3 * USUAL_MS))
    points += [
        Setting(method, usual, substeps=count)
        for method in methods
        if method.scheme not in (LOSSLESS, DIRECT)
        for count in SUBSTEPS
    ]
    if has_contact:
        varied = [method for method in methods if method.name in VARIED]
        points += [
            Setting(method, period, contact=contact)
            for method in varied
            for contact in CONTACTS
            if contact != SHIPPED
            for period in _with_neighbour(usual, periods)
        ]
        points += [
            Setting(method, usual, iterations=count) for method in varied for count in ITERATIONS
        ]
    return points


def _with_neighbour(usual: float, periods: Sequence[float]) -> list[float]:
    """Returns a period and the next smaller one; where there is none, the next larger one."""
    others = [period for period in periods if period != usual]
    smaller = [period for period in others if period < usual]
    return [usual, *([max(smaller)] if smaller else [min(others)] if others else [])]
