"""Search for the leanest version of a scene that feels the same.

Each simplification is tried alone. Those that pass are then combined, the largest saving first;
those that only this motion does not need come last. Every combination is judged against the scene
as it was read: the felt error of all changes together must stay below the budget.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from hapticbridge.arguments import Arguments
from hapticbridge.certificate import UNKNOWN_DAMPING
from hapticbridge.check.draft import Draft, Setting, name_everything
from hapticbridge.check.freedoms import freedom_simplifications
from hapticbridge.check.observation import quiet
from hapticbridge.check.shapes import shape_simplifications
from hapticbridge.check.side_by_side import CostMeter, processor_costs
from hapticbridge.check.simplifications import (
    OTHER_MOTIONS,
    Simplification,
    contact_simplifications,
    rate_simplifications,
    solver_simplifications,
)
from hapticbridge.check.trial import FAILS, MAY_GO, SAVES_NOTHING, Judge, Trial
from hapticbridge.check.witness import witness
from hapticbridge.device import Motion
from hapticbridge.errors import HapticBridgeError, SceneError
from hapticbridge.scene import SceneSource

Progress = Callable[[int, int, str], None]
"""Called with the steps done, the largest possible number of steps, and the name of the present
one."""

_ARGUMENTS = Arguments(SceneError)


def checked_budget(budget: float) -> float:
    """Returns the allowed felt error in just noticeable differences.

    Raises:
        SceneError: It is not finite and > 0.
    """
    return _ARGUMENTS.number("budget", budget, "JND", least=0.0, is_open=True)


@dataclass(frozen=True, slots=True, eq=False)
class Lean:
    """Result of the search.

    Attributes:
        judge: The original scene, the motion, and the limits.
        draft: The leanest version; equal to the original if no simplification passed.
        alone: Each simplification tried alone.
        together: The simplifications that were combined, in order; each trial includes all before
            it.
        result: The leanest version against the original.
    """

    judge: Judge
    draft: Draft
    alone: tuple[Trial, ...]
    together: tuple[Trial, ...]
    result: Trial

    @property
    def removable(self) -> tuple[Trial, ...]:
        """Simplifications that pass alone and lose nothing else; a lean scene has none."""
        return tuple(trial for trial in self.alone if trial.verdict == MAY_GO and not trial.loses)


def find_lean(
    source: SceneSource,
    grip: str,
    motion: Motion,
    setting: Setting,
    *,
    budget: float = 1.0,
    device_damping: float = UNKNOWN_DAMPING,
    cost: CostMeter = processor_costs,
    progress: Progress | None = None,
) -> Lean:
    """Finds the leanest version of a scene that feels the same in a motion.

    Args:
        source: The scene; it is not changed.
        grip: Name of the site on the tool.
        motion: Motion of the handle, relative to its first pose.
        setting: Coupling and rate.
        budget: Allowed felt error in just noticeable differences, > 0.
        device_damping: b of the device in N s/m. A rate whose coupling needs more than b, and more
            than the original needs, is refused.
        cost: Measures the cost of two versions side by side.
        progress: Receives the name of each trial.

    Raises:
        SceneError: The scene cannot be run, the motion is shorter than a tick, or a number is out
            of range.
    """
    budget = checked_budget(budget)
    damping = _ARGUMENTS.number("device damping", device_damping, "N s/m", least=0.0)
    if motion.duration < setting.period:
        raise SceneError(
            f"the motion lasts {motion.duration:g} s, less than one tick of {setting.period:g} s"
        )
    spec = source.spec.copy()
    name_everything(spec)
    original = Draft(replace(source, spec=spec), grip, setting)
    with quiet():
        judge = Judge(original, motion, budget, damping, cost)
        return _search(judge, _simplifications(original, motion), progress)


def _simplifications(original: Draft, motion: Motion) -> list[Simplification]:
    seen = witness(original, motion)
    return [
        *contact_simplifications(seen),
        *solver_simplifications(seen),
        *shape_simplifications(),
        *freedom_simplifications(original, seen),
        *rate_simplifications(original),
    ]


def _search(judge: Judge, simpler: list[Simplification], progress: Progress | None) -> Lean:
    total, alone = 2 * len(simpler), []
    for k, each in enumerate(simpler):
        if progress is not None:
            progress(k, total, each.name)
        if (found := _apply(judge, each, judge.original)) is not None:
            alone.append((each, found[1]))
    # a small saving of the whole may be a large share of the rest
    order = [pair for pair in alone if pair[1].verdict in (MAY_GO, SAVES_NOTHING)]
    order = [pair for pair in order if (pair[1].cost or 0.0) < 1.0 + judge.least_saving]
    # simplifications for this motion alone go last; they may turn out not to be needed
    order.sort(key=lambda pair: (pair[0].loses == OTHER_MOTIONS, pair[1].cost or 0.0))
    best, share, together = judge.original, 1.0, []
    for k, (each, _) in enumerate(order):
        if progress is not None:
            progress(len(simpler) + k, total, each.name)
        found = _apply(judge, each, best, share)
        if found is not None and found[1].verdict == MAY_GO:
            best, share = found[0], found[1].cost or share
            together.append(found[1])
    result = judge.judge("lean", "all that was taken", best, is_last_word=True)
    if together and result.verdict != MAY_GO:  # the steps' savings were timing noise
        best, together = judge.original, []
        result = judge.judge("lean", "all that was taken", best)
    if not together:
        result = replace(result, cost=1.0)  # not measured against itself
    if progress is not None:
        progress(total, total, "")
    return Lean(judge, best, tuple(trial for _, trial in alone), tuple(together), result)


def _apply(
    judge: Judge, each: Simplification, base: Draft, share: float = 1.0
) -> tuple[Draft, Trial] | None:
    """Applies a simplification to a version; returns None if there is nothing to change."""
    draft = base.copy()
    try:
        if not each.edit(draft):
            return None
        return draft, judge.judge(each.name, each.sentence, draft, base, share, each.loses)
    except (HapticBridgeError, ValueError) as error:  # MuJoCo raises ValueError
        reason = " ".join(str(error).split())
        return draft, Trial(each.name, reason, FAILS, each.loses)
