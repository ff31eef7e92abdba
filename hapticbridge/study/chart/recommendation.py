"""What to use: the cheapest point that is fast enough, right enough and sound, in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hapticbridge.study.chart.measurement import Measurement

RATE = 1000.0
"""Hz that is asked for."""

JND = 1.0
"""Error in just noticeable differences that is allowed."""

SHARE = 0.5
"""Share of a core that the simulation may take; the rest is for the device and for waking up."""

ALIKE = 0.05
"""Relative difference of two errors that decides nothing, no unit: where they differ by more, so do
the two digits that are said of them."""

ALONE = " No other time step bears this out, so it may be luck."

TOLERANCE = 1e-9
"""Relative: 1/(1 ms) is 1000 Hz but for rounding."""


def recommended(points: Sequence[Measurement]) -> Measurement | None:
    """Returns the point to use, None where there is none.

    Of the points at ``RATE`` or above, with an error below ``JND`` here and at every smaller step,
    a passive environment, a solver that runs to its tolerance, at most ``SHARE`` of a core, an
    error that can be compared with others' (``Measurement.is_comparable``) and no hazard on a real
    device (``Method.hazard``): those that a second step bears out, if there are any; of them the
    cheapest; of those whose spread of cost meets its own, the most accurate; and where errors are
    the same within ``ALIKE``, one with the usual contacts.
    """
    fit = [each for each in points if _is_fast(each) and not _objections(each, points)]
    if not fit:
        return None
    fit = [each for each in fit if is_borne_out(each, points)] or fit
    cheapest = min(fit, key=lambda each: each.cost.median)
    alike = [each for each in fit if each.cost.low <= cheapest.cost.high]
    least = min(each.score.felt for each in alike)
    best = [each for each in alike if each.score.felt <= (1 + ALIKE) * least]
    return min(best, key=lambda each: (not each.is_usual, each.score.felt, each.cost.median))


def recommendation(points: Sequence[Measurement], machine: str, *, is_truth: bool = True) -> str:
    """Says what to use and why nothing better, or which point is nearest and what is wrong with it.

    Args:
        points: Of one panel.
        machine: In words.
        is_truth: Whether errors are counted from the truth (``Panel.is_truth``); if not, it says
            that they are only the distance from each method's own limit.
    """
    best = recommended(points)
    goal = f"For {RATE / 1000:g} kHz on this machine ({machine}) and an error below one JND"
    if not is_truth:
        goal += " (counted from the method's own limit at small steps, not from the truth)"
    if best is not None:
        alone = "" if is_borne_out(best, points) else ALONE
        return (
            f"{goal}, use {best.setting.label}: {_numbers(best)}.{alone}"
            f"{_passed_over(best, points)}"
        )
    fast = [each for each in points if _is_fast(each) and np.isfinite(each.score.felt)]
    if not fast:
        return f"{goal}, nothing was tried that runs at this rate."
    nearest = min(fast, key=lambda each: (len(_objections(each, points)), each.score.felt))
    return (
        f"{goal}, no point does it all. Nearest is {nearest.setting.label}: {_numbers(nearest)}; "
        f"but {' and '.join(_objections(nearest, points))}."
    )


def is_borne_out(each: Measurement, points: Sequence[Measurement]) -> bool:
    """Returns whether another time step, all else alike, has an error below ``JND`` as well.

    What was tried at one step alone may be right by luck.
    """

    def settings_but_steps(point: Measurement) -> tuple[object, ...]:
        setting = point.setting
        return setting.method.name, setting.engine, setting.contact, setting.iterations

    return any(
        other.score.felt < JND
        and other.setting.timestep != each.setting.timestep
        and settings_but_steps(other) == settings_but_steps(each)
        for other in points
    )


def _is_fast(each: Measurement) -> bool:
    return each.setting.period * RATE <= 1 + TOLERANCE


def steady_error(each: Measurement, points: Sequence[Measurement]) -> float:
    """Returns the largest error in JND at this and at every smaller step, all else alike.

    An error that grows again when the step shrinks was small by luck.
    """
    setting = each.setting
    alike = [
        other.score.felt
        for other in points
        if (other is each or other.setting.period < setting.period)
        and replace(other.setting, period=setting.period) == setting
    ]
    return max(alike, default=each.score.felt)


def _objections(each: Measurement, points: Sequence[Measurement]) -> list[str]:
    """Returns what speaks against a point, in words."""
    found = []
    steady = steady_error(each, points)
    if not each.score.felt < JND:
        found.append(f"its error is {each.score.felt:.2g} JND")
    elif not steady < JND:
        found.append(f"its error grows to {steady:.2g} JND at a smaller step, so it is luck")
    if not each.is_comparable:
        found.append(
            f"its own limit lies {each.limit_apart:.2g} JND from what most methods converge to"
        )
    if each.setting.iterations is not None:
        found.append("its solver is cut short")
    if not each.is_sound:
        created = each.score.created
        more = f" ({created:.2g} J created)" if created > 0 and np.isfinite(created) else ""
        found.append(f"its environment is {each.score.verdict}{more}")
    if each.cost.median > SHARE:
        found.append(f"it takes {100 * each.cost.median:.0f} % of a core")
    if each.setting.method.hazard:
        found.append("it may kick on a real device")
    return found


def _passed_over(best: Measurement, points: Sequence[Measurement]) -> str:
    """Says why the most accurate of the points that cost no more and err less was not taken.

    As on the front, a weld and a tool that is where the handle is are left out: they render another
    coupling, and a small distance from their own limit would be no merit.
    """
    better = [
        each
        for each in points
        if _is_fast(each)
        and each.setting.method.has_law
        and each.cost.median <= best.cost.median
        and (1 + ALIKE) * each.score.felt < best.score.felt
        and _objections(each, points)
    ]
    if not better:
        return ""
    other = min(better, key=lambda each: each.score.felt)
    return (
        f" {other.setting.label} would cost no more and err less ({other.score.felt:.2g} JND), but "
        f"{' and '.join(_objections(other, points))}."
    )


def _numbers(each: Measurement) -> str:
    tick = 1e6 * each.cost.median * each.setting.period
    return (
        f"an error of {each.score.felt:.2g} JND at {tick:.3g} µs a tick, "
        f"{100 * each.cost.median:.2g} % of a core"
    )
