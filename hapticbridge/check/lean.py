"""Search for the leanest version of a scene that feels the same.

Each simplification is tried alone. Those that pass are then combined, the largest saving first;
those that only this motion does not need come last. Every combination is judged against the scene
as it was read: the felt error of all changes together must stay below the budget.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

from hapticbridge.arguments import Arguments
from hapticbridge.check.cost import CostMeter, processor_costs
from hapticbridge.check.observe import Playback
from hapticbridge.check.perception import FeltError, felt_error
from hapticbridge.check.simplify import (
    OTHER_MOTIONS,
    Simplification,
    contact_simplifications,
    freedom_simplifications,
    rate_simplifications,
    shape_simplifications,
    solver_simplifications,
)
from hapticbridge.check.version import SceneVariant, name_everything, witness
from hapticbridge.demand.certificate import UNKNOWN_DAMPING
from hapticbridge.device import Motion
from hapticbridge.errors import HapticBridgeError, SceneError
from hapticbridge.kernel.mujoco_c import quiet

# Judgement of one version of a scene

MIN_SAVING = 0.05
"""Share of the cost that a simplification must save, without unit. On a busy machine a scene
measured against itself differs by at most 1 %; where it differs by more, three times that
difference counts. A larger share keeps more of the scene."""

CLEARLY_MORE = 1.2
"""Cost relative to the version to beat, without unit, above which a single run decides."""

_ROUNDING = 1e-9  # relative, of a sum of products

_ENVIRONMENTS = ("strict", "within slack", "active")

MAY_GO, IS_FELT, SAVES_NOTHING = "may go", "is felt", "saves nothing"
CREATES, WARNS, NOT_BORNE, FAILS = "creates energy", "MuJoCo warns", "device too weak", "fails"


@dataclass(frozen=True, slots=True)
class VariantVerdict:
    """A version of a scene compared with the original.

    Attributes:
        name: Name of the simplification.
        sentence: Description of the edit, or reason of the failure.
        verdict: ``MAY_GO``, or the reason against it: one of the constants of this module.
        loses: Further loss, see ``Simplification``.
        cost: Processor time relative to the original, without unit. It comes from a single run if
            the version is refused for another reason; None if it failed.
        error: Perceptible difference; None if it failed.
        environment: ``strict``, ``within slack`` or ``active``.
        warnings: Number of MuJoCo's warnings.
        needed_damping: b in N s/m that a device needs at this version's rate.
    """

    name: str
    sentence: str
    verdict: str
    loses: str = ""
    cost: float | None = None
    error: FeltError | None = None
    environment: str = ""
    warnings: int = 0
    needed_damping: float = 0.0

    @property
    def jnd(self) -> float:
        """Felt error in just noticeable differences; 0 if it failed."""
        return 0.0 if self.error is None else self.error.jnd

    @property
    def percent(self) -> float:
        """Cost in percent of the original; 100 if it failed."""
        return 100.0 * (self.cost or 1.0)


class CheaperVariant(NamedTuple):
    """A version, and its cost relative to the original, without unit."""

    draft: SceneVariant
    share: float = 1.0


class Judge:
    """Comparison of versions of one scene in one motion.

    Attributes:
        original: The scene as it was read.
        motion: Motion of the handle.
        budget: Allowed felt error in just noticeable differences.
        device_damping: b of the device in N s/m.
        rehearsal: Rehearsal of the original.
        seconds: Processor time of the original in s per second of motion.
        min_saving: Share of the cost that counts as a saving, without unit.
    """

    def __init__(
        self,
        original: SceneVariant,
        motion: Motion,
        budget: float,
        device_damping: float,
        cost: CostMeter,
    ) -> None:
        """Rehearses the original and measures its cost against itself.

        Raises:
            SceneError: It does not compile, or a result is not finite.
        """
        self.original, self.motion = original, motion
        self.budget, self.device_damping = budget, device_damping
        self._cost = cost
        self.rehearsal = original.rehearsed(motion)
        first, second = cost(original, original.copy(), motion)
        self.seconds = 0.5 * (first + second)
        self.min_saving = max(MIN_SAVING, 3.0 * abs(second / first - 1.0))

    def judge(
        self,
        name: str,
        sentence: str,
        draft: SceneVariant,
        base: CheaperVariant | None = None,
        loses: str = "",
        *,
        is_last_word: bool = False,
    ) -> VariantVerdict:
        """Judges if a version may replace the original.

        Args:
            name: Name of the change.
            sentence: Description of the change.
            draft: The version.
            base: Version that it must be cheaper than; None takes the original.
            loses: Further loss, see ``Simplification``.
            is_last_word: True measures the cost thoroughly even if a single run shows no saving.

        Raises:
            SceneError: The version does not compile, or a result is not finite.
        """
        rival, share = base or CheaperVariant(self.original)
        done = draft.rehearsed(self.motion)
        error = felt_error(self.rehearsal.records, done.records)
        needed = draft.setting.needed_damping
        verdict = self._refusal(done, error, needed)
        cost = done.seconds / (self.seconds * self.motion.duration)
        if not verdict and not is_last_word and cost > CLEARLY_MORE * share:
            verdict = SAVES_NOTHING
        if not verdict:  # a refused version needs no thorough measurement
            before, after = self._cost(rival, draft, self.motion)
            verdict = MAY_GO if after <= (1.0 - self.min_saving) * before else SAVES_NOTHING
            cost = share * after / before
        return VariantVerdict(
            name=name,
            sentence=sentence,
            verdict=verdict,
            loses=loses,
            cost=cost,
            error=error,
            environment=done.environment,
            warnings=done.warnings,
            needed_damping=needed,
        )

    def _refusal(self, done: Playback, error: FeltError, needed: float) -> str:
        """Returns the reason against a version regardless of its cost; empty if there is none."""
        ranks = [_ENVIRONMENTS.index(each.environment) for each in (done, self.rehearsal)]
        bearable = max(self.device_damping, self.original.setting.needed_damping)
        if done.warnings > self.rehearsal.warnings:
            return WARNS
        if ranks[0] > ranks[1]:
            return CREATES
        if needed > bearable * (1.0 + _ROUNDING):
            return NOT_BORNE
        return IS_FELT if error.jnd > self.budget else ""


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
    draft: SceneVariant
    alone: tuple[VariantVerdict, ...]
    together: tuple[VariantVerdict, ...]
    result: VariantVerdict

    @property
    def removable(self) -> tuple[VariantVerdict, ...]:
        """Simplifications that pass alone and lose nothing else; a lean scene has none."""
        return tuple(trial for trial in self.alone if trial.verdict == MAY_GO and not trial.loses)


def find_lean(
    original: SceneVariant,
    motion: Motion,
    *,
    budget: float = 1.0,
    device_damping: float = UNKNOWN_DAMPING,
    cost: CostMeter = processor_costs,
    progress: Progress | None = None,
) -> Lean:
    """Finds the leanest version of a scene that feels the same in a motion.

    Args:
        original: The scene with grip, coupling and rate; it is not changed.
        motion: Motion of the handle, relative to its first pose.
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
    period = original.setting.period
    if motion.duration < period:
        raise SceneError(
            f"the motion lasts {motion.duration:g} s, less than one tick of {period:g} s"
        )
    original = original.copy()
    name_everything(original.source.spec)
    with quiet():
        judge = Judge(original, motion, budget, damping, cost)
        return _search(judge, all_simplifications(original, motion), progress)


def all_simplifications(original: SceneVariant, motion: Motion) -> list[Simplification]:
    """Returns the simplifications that are worth trying on a scene under a motion."""
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
    progress = progress or (lambda _done, _total, _name: None)
    for k, each in enumerate(simpler):
        progress(k, total, each.name)
        if (found := _apply(judge, each, CheaperVariant(judge.original))) is not None:
            alone.append((each, found[1]))
    # a small saving of the whole may be a large share of the rest
    order = [pair for pair in alone if pair[1].verdict in (MAY_GO, SAVES_NOTHING)]
    order = [pair for pair in order if (pair[1].cost or 0.0) < 1.0 + judge.min_saving]
    # simplifications for this motion alone go last; they may turn out not to be needed
    order.sort(key=lambda pair: (pair[0].loses == OTHER_MOTIONS, pair[1].cost or 0.0))
    best, together = CheaperVariant(judge.original), []
    for k, (each, _) in enumerate(order):
        progress(len(simpler) + k, total, each.name)
        found = _apply(judge, each, best)
        if found is not None and found[1].verdict == MAY_GO:
            best = CheaperVariant(found[0], found[1].cost or best.share)
            together.append(found[1])
    result = judge.judge("lean", "all that was taken", best.draft, is_last_word=True)
    if together and result.verdict != MAY_GO:  # the steps' savings were timing noise
        best, together = CheaperVariant(judge.original), []
        result = judge.judge("lean", "all that was taken", best.draft)
    if not together:
        result = replace(result, cost=1.0)  # not measured against itself
    progress(total, total, "")
    return Lean(judge, best.draft, tuple(trial for _, trial in alone), tuple(together), result)


def _apply(
    judge: Judge, each: Simplification, base: CheaperVariant
) -> tuple[SceneVariant, VariantVerdict] | None:
    """Applies a simplification to a version; returns None if there is nothing to change."""
    draft = base.draft.copy()
    try:
        if not each.edit(draft):
            return None
        return draft, judge.judge(each.name, each.sentence, draft, base, each.loses)
    except (HapticBridgeError, ValueError) as error:  # MuJoCo raises ValueError
        reason = " ".join(str(error).split())
        return draft, VariantVerdict(each.name, reason, FAILS, each.loses)
