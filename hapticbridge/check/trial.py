"""Judgement of one version of a scene."""

from __future__ import annotations

from dataclasses import dataclass

from hapticbridge.check.draft import Draft
from hapticbridge.check.felt import FeltError, felt_error
from hapticbridge.check.rehearsal import Rehearsal
from hapticbridge.check.side_by_side import CostMeter
from hapticbridge.device import Motion

LEAST_SAVING = 0.05
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
class Trial:
    """A version of a scene compared with the original.

    Attributes:
        name: Name of the simplification.
        sentence: Description of the edit, or reason of the failure.
        verdict: ``MAY_GO``, or the reason against it: one of the constants of this module.
        loses: Further loss, see ``Simplification``.
        cost: Processor time relative to the original, without unit. It comes from a single run if
            the version is refused for another reason; None if it failed.
        felt: Perceptible difference; None if it failed.
        environment: ``strict``, ``within slack`` or ``active``.
        warnings: Number of MuJoCo's warnings.
        needed_damping: b in N s/m that a device needs at this version's rate.
    """

    name: str
    sentence: str
    verdict: str
    loses: str = ""
    cost: float | None = None
    felt: FeltError | None = None
    environment: str = ""
    warnings: int = 0
    needed_damping: float = 0.0


class Judge:
    """Comparison of versions of one scene in one motion.

    Attributes:
        original: The scene as it was read.
        motion: Motion of the handle.
        budget: Allowed felt error in just noticeable differences.
        device_damping: b of the device in N s/m.
        rehearsal: Rehearsal of the original.
        seconds: Processor time of the original in s per second of motion.
        least_saving: Share of the cost that counts as a saving, without unit.
    """

    def __init__(
        self,
        original: Draft,
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
        self.least_saving = max(LEAST_SAVING, 3.0 * abs(second / first - 1.0))

    def judge(
        self,
        name: str,
        sentence: str,
        draft: Draft,
        base: Draft | None = None,
        share: float = 1.0,
        loses: str = "",
        *,
        is_last_word: bool = False,
    ) -> Trial:
        """Judges if a version may replace the original.

        Args:
            name: Name of the change.
            sentence: Description of the change.
            draft: The version.
            base: Version that it must be cheaper than; None takes the original.
            share: Cost of ``base`` relative to the original, without unit.
            loses: Further loss, see ``Simplification``.
            is_last_word: True measures the cost thoroughly even if a single run shows no saving.

        Raises:
            SceneError: The version does not compile, or a result is not finite.
        """
        done = draft.rehearsed(self.motion)
        felt = felt_error(self.rehearsal.records, done.records)
        needed = draft.setting.needed_damping
        verdict = self._refusal(done, felt, needed)
        cost = done.seconds / (self.seconds * self.motion.duration)
        if not verdict and not is_last_word and cost > CLEARLY_MORE * share:
            verdict = SAVES_NOTHING
        if not verdict:  # a refused version needs no thorough measurement
            before, after = self._cost(base or self.original, draft, self.motion)
            verdict = MAY_GO if after <= (1.0 - self.least_saving) * before else SAVES_NOTHING
            cost = share * after / before
        return Trial(
            name=name,
            sentence=sentence,
            verdict=verdict,
            loses=loses,
            cost=cost,
            felt=felt,
            environment=done.environment,
            warnings=done.warnings,
            needed_damping=needed,
        )

    def _refusal(self, done: Rehearsal, felt: FeltError, needed: float) -> str:
        """Returns the reason against a version regardless of its cost; empty if there is none."""
        ranks = [_ENVIRONMENTS.index(each.environment) for each in (done, self.rehearsal)]
        bearable = max(self.device_damping, self.original.setting.needed_damping)
        if done.warnings > self.rehearsal.warnings:
            return WARNS
        if ranks[0] > ranks[1]:
            return CREATES
        if needed > bearable * (1.0 + _ROUNDING):
            return NOT_BORNE
        return IS_FELT if felt.felt > self.budget else ""
