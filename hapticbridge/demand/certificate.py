"""Device conditions, their verdict, and the default coupling that meets them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

from hapticbridge.coupling import PREFIX, UNITS, Axis, Coupling
from hapticbridge.demand.loop_setting import (
    IN_TIME,
    LoopSetting,
    assumed_lag,
    device_period,
    pulling_loop,
    required_damping,
)
from hapticbridge.demand.methods import Method, default_method
from hapticbridge.device.base import DeviceInfo
from hapticbridge.errors import CouplingError
from hapticbridge.kernel.codes import Scheme
from hapticbridge.kernel.parameters import RunParameters, checked_substeps
from hapticbridge.theory.bounds import (
    NEEDED_SHARE,
    midpoint_damping,
    stiffest_coupling,
    stiffest_late_coupling,
)
from hapticbridge.units import format_si

# Default coupling of a device

UNKNOWN_DAMPING, UNKNOWN_ROTATIONAL_DAMPING = 2.0, 2e-3
"""Damping in N s/m and N m s/rad assumed for a device of unknown damping: that of the default
simulated device. Larger values give a stiffer default coupling that is safe on fewer devices."""

UNKNOWN_REAL_DAMPING, UNKNOWN_REAL_ROTATIONAL_DAMPING = 0.2, 2e-4
"""Damping in N s/m and N m s/rad assumed for a device with motors of unknown damping. It is a tenth
of ``UNKNOWN_DAMPING``: the low end of estimates for desktop devices, because almost no maker
publishes it."""


def assumed_damping(info: DeviceInfo) -> tuple[float, float]:
    """Returns the device's damping in N s/m and N m s/rad, or the assumed values.

    Unknown or zero damping becomes ``UNKNOWN_DAMPING``, or ``UNKNOWN_REAL_DAMPING`` with motors.
    """
    linear = info.damping or (UNKNOWN_REAL_DAMPING if info.is_real else UNKNOWN_DAMPING)
    angular = info.rotational_damping or (
        UNKNOWN_REAL_ROTATIONAL_DAMPING
        if info.is_real and info.turns
        else UNKNOWN_ROTATIONAL_DAMPING
    )
    return linear, angular


def default_coupling(
    info: DeviceInfo,
    period: float,
    scale: float = 1.0,
    force_scale: float = 1.0,
    law_evaluations: int = 1,
    method: Method | None = None,
) -> Coupling:
    """Returns the stiffest coupling that is safe on a device: 80 % of the bound, B' = b / 4.

    The result is the requested coupling: K and B = B' + the method's own damping, so that the law
    uses B' without clipping. It needs 85 % of b. Behind a device that is late the ratio B'/K is the
    one with the largest K (``theory.bounds.stiffest_late_coupling``), for the ``assumed_lag``. If
    several evaluations per tick need more, or friction does not hold the encoder's steps, K and B'
    are lowered together; both conditions are linear in both. Without any friction no coupling is
    free of swings by steps, so damping alone decides, and the condition says so. A loop of the
    device's own gets a spring alone: B'Δ/T would take the friction that the steps need.

    Args:
        info: The device; unknown damping is replaced as in ``assumed_damping``.
        period: T in s.
        scale: Handle motion per device motion.
        force_scale: Force on the device per force on the tool.
        law_evaluations: Evaluations of the wrench per tick (substeps).
        method: Rendering method; None takes ``methods.default_method``.

    Raises:
        CouplingError: The number of evaluations, a scale or the period is out of range.
    """
    for name, value in (("scale", scale), ("force_scale", force_scale)):
        if not math.isfinite(value) or value <= 0:
            raise CouplingError(f"{name} is {value!r}; it must be finite and > 0")
    damping, rotational = assumed_damping(info)
    damping /= scale * force_scale
    rotational *= scale / force_scale
    coupling = stiffest_coupling(damping, rotational, period)
    checked_substeps(law_evaluations, CouplingError)
    method = default_method(law_evaluations) if method is None else method
    own, own_period = pulling_loop(info, period)
    lag = assumed_lag(own, own_period)
    if info.loop_period is not None:
        share = NEEDED_SHARE / required_damping(Coupling(1.0, 0.0), own_period, lag=lag)
        if info.moves:
            coupling = coupling.with_axis("translation", share * damping, 0.0)
        if info.turns:
            coupling = coupling.with_axis("rotation", share * rotational, 0.0)
    elif lag != IN_TIME:
        gains = stiffest_late_coupling(damping, period, lag.delay, lag.ticks_per_sample)
        coupling = coupling.with_axis("translation", *gains)
        if info.turns:
            gains = stiffest_late_coupling(rotational, period, lag.delay, lag.ticks_per_sample)
            coupling = coupling.with_axis("rotation", *gains)
    shrink = turn = 1.0
    if law_evaluations > 1 and info.loop_period is None:
        needed = required_damping(coupling, period, law_evaluations, lag=lag)
        shrink = min(1.0, NEEDED_SHARE * damping / needed)
        felt = lag if info.turns else IN_TIME
        needed = required_damping(coupling, period, law_evaluations, "rotation", felt)
        turn = min(1.0, NEEDED_SHARE * rotational / needed)
    loop = LoopSetting(
        info=own, law=coupling, period=own_period, scale=scale, force_scale=force_scale
    )
    steps = StepCondition.of(loop)
    if steps is not None and steps.available and steps.needed:
        shrink = min(shrink, NEEDED_SHARE * steps.available / steps.needed)
    if min(shrink, turn) < 1.0:
        coupling = Coupling(
            stiffness=shrink * coupling.stiffness,
            damping=shrink * coupling.damping,
            rotational_stiffness=turn * coupling.rotational_stiffness,
            rotational_damping=turn * coupling.rotational_damping,
        )
    return method.requested_coupling(coupling, period / law_evaluations)


@dataclass(frozen=True, slots=True)
class StepCondition:
    """The condition f_c >= s (K Δ/2 + B' Δ/T) on a device that reports its position in steps.

    Without that friction the encoder's steps keep a hand swinging, and give it energy that no meter
    of positions sees. s = scale · force_scale. It is sufficient at a wall, at any delay and for any
    number of ticks per sample: the law is linear, so an error of Δ/2 in each position changes the
    force by at most s (K Δ/2 + B' Δ/T) at any time, and friction burns that times the way. Behind a
    tool that moves by itself, steps may give up to ``HandEnergy.hidden`` more.

    Attributes:
        needed: Right-hand side in N; None if the step Δ is unknown.
        available: Coulomb friction f_c in N; None if unknown.
        resolution: Step Δ of the position in m; None if unknown.
        remedy: Changes with which it holds with 15 % in reserve; empty if it holds.

    References:
        Abbott & Okamura 2005.
    """

    needed: float | None
    available: float | None
    resolution: float | None
    remedy: str = ""

    @classmethod
    def of(cls, loop: LoopSetting) -> StepCondition | None:
        """Returns the condition; None if the device has no steps."""
        info, law = loop.info, loop.law
        step = info.resolution
        if step == 0.0:
            return None
        if step is None:
            return cls(None, info.friction, None)
        needed = loop.ratio("translation") * step
        needed *= 0.5 * law.stiffness + law.damping / loop.period
        return cls(needed, info.friction, step)

    @property
    def holds(self) -> bool | None:
        """True if friction holds the steps; None if it is unknown."""
        if self.needed is None or self.available is None:
            return None
        return self.available >= self.needed

    @property
    def margin(self) -> float:
        """Share of the friction that is left, 1 − needed/f_c; 1 if unknown."""
        if self.holds is None:
            return 1.0
        return 1.0 - (self.needed or 0.0) / self.available if self.available else -math.inf

    @property
    def word(self) -> str:
        """Judgement without numbers: ``unknown`` without a resolution, else ``not judged``."""
        return "unknown" if self.resolution is None else "not judged"

    def sentence(self) -> str:
        """Describes the condition in a clause, with the remedy if it fails."""
        if self.resolution is None:
            return "its encoder's steps are unknown ('hapticbridge identify' measures them)"
        steps = f"steps of {format_si(self.resolution, 'm')}"
        if self.available is None:
            return (
                f"its {steps} are not judged: its friction is unknown ('hapticbridge identify' "
                f"measures it), {format_si(self.needed or 0.0, 'N')} needed"
            )
        relation = ">=" if self.holds else "<"
        text = (
            f"friction {format_si(self.available, 'N')} {relation} "
            f"{format_si(self.needed or 0.0, 'N')} for its {steps}"
        )
        return text if self.holds else f"{text}; {self.remedy}"


IF_AT_ONCE = "if its forces come at once"
"""Limit of a certificate for a delay of 0 that the device states and no measurement confirms."""


@dataclass(frozen=True, slots=True)
class DampingCondition:
    """The device condition on one kind of axis: b >= scale · force_scale · (K T/2 + B'), in time.

    Attributes:
        axis: ``translation`` or ``rotation``; if it is not felt, the names of the axes.
        needed: Right-hand side in N s/m (rotation: N m s/rad).
        available: The device's damping b; None if unknown.
        remedy: Changes with which it holds with 15 % in reserve (``NEEDED_SHARE``); empty if it
            holds.
        delay: Time in s from a sample to the wrench that answers it, in whole ticks, rounded up; 0
            at best, None if unknown.
        ticks_per_sample: Ticks for which one force is held, 1 at best.
        steps: Condition on the encoder's steps along this kind of axis; None without one.
        unconfirmed_delay: Largest constant delay in s that the damping bears, of the stated one and
            one tick more; None if a measurement confirms the delay.
        loop_period: Period in s of a loop of the device's own; None for the bridge's.
        is_felt: False for axes that are sensed without a motor. The hand puts energy into the scene
            there without work of its own, so no damping bounds what it gets back along the axes
            with a motor (Barbagli & Salisbury 2003).
    """

    axis: str
    needed: float
    available: float | None
    remedy: str = ""
    delay: float | None = 0.0
    ticks_per_sample: int = 1
    steps: StepCondition | None = None
    unconfirmed_delay: float | None = None
    loop_period: float | None = None
    is_felt: bool = True

    @property
    def is_damped(self) -> bool | None:
        """True if the device has enough damping; None if that is unknown."""
        return None if self.available is None else self.available >= self.needed

    @property
    def holds(self) -> bool | None:
        """True if damping and friction suffice; None if the damping is unknown."""
        has_steps = self.steps is not None and self.steps.holds is False
        return False if self.is_damped and has_steps else self.is_damped

    @property
    def margin(self) -> float:
        """Smallest share of damping and friction that is left, 1 − needed/available."""
        left = 1.0 - self.needed / self.available if self.available else -math.inf
        return left if self.steps is None else min(left, self.steps.margin)

    @property
    def unit(self) -> str:
        """Unit of the damping."""
        return UNITS["rotation" if self.axis == "rotation" else "translation"][1]

    @property
    def clause(self) -> str:
        """Limit of a certificate for a delay that no measurement confirms; or empty."""
        if self.unconfirmed_delay is None:
            return ""
        if not self.unconfirmed_delay:
            return f", {IF_AT_ONCE}"
        most = format_si(self.unconfirmed_delay, "s")
        return f", if its forces come equally late, by at most {most}"

    def lack(self, bound: str) -> str:
        """Returns a clause on what is missing; ``bound`` names the damping that is needed."""
        if self.is_damped:
            return "friction < K Δ/2 + B_law Δ/T, so encoder steps shake it"
        where = " in rotation" if self.axis == "rotation" else ""
        return f"b < {bound}{where}: {self.available or 0.0:.4g} < {self.needed:.4g} {self.unit}"

    def sentence(self) -> str:
        """Describes the condition, with the remedy if it fails."""
        if not self.is_felt:
            return (
                f"{self.axis}: sensed without a motor, so the hand may get back along the other "
                "axes what it put in there without effort; only --energy-limit bounds it"
            )
        unit = self.unit
        if self.available is None:
            return (
                f"{self.axis}: device damping unknown, {self.needed:g} {unit} needed; "
                "'hapticbridge identify' measures it"
            )
        relation = ">=" if self.is_damped else "<"
        text = f"{self.axis}: device damping {self.available:g} {relation} {self.needed:g} {unit}"
        if self.ticks_per_sample > 1:
            text = f"{text} with one sample in {self.ticks_per_sample} ticks"
        if not self.is_damped:
            return f"{text}; {self.remedy}"
        if self.loop_period is not None:
            period = format_si(self.loop_period, "s")
            text = f"{text} in its own loop of {period}, with {format_si(self.delay or 0.0, 's')} "
            text += "from a position to its force"
        elif self.delay is None:
            text = text.replace(": ", ": its delay is unknown; without one, ", 1)
        elif self.delay:
            text = f"{text} with its delay of {format_si(self.delay, 's')}"
        text += self.clause
        return text if self.steps is None else f"{text}; {self.steps.sentence()}"


def conditions_of(loop: LoopSetting) -> tuple[DampingCondition, ...]:
    """Returns the condition for each kind of axis of a device with known translational damping.

    A device that only turns needs no translational damping. One more condition, of unknown outcome,
    is for axes that it senses without a motor.

    References:
        Brown & Colgate 1997, eq. (6); sufficient for any environment that satisfies (14).
    """
    info, conditions = loop.info, []
    if info.moves and info.damping is not None:
        conditions.append(_condition(loop, "translation", info.damping))
    if info.turns and loop.is_judged:
        conditions.append(_condition(loop, "rotation", info.rotational_damping))
    if info.sensed and loop.is_judged:
        conditions.append(DampingCondition(", ".join(info.sensed), 0.0, None, is_felt=False))
    return tuple(conditions)


def _condition(loop: LoopSetting, axis: Axis, available: float | None) -> DampingCondition:
    """Returns the condition along one kind of axis, with the changes that would meet it."""
    needed, remedy = loop.needed(axis), ""
    if available is not None and available < needed:
        remedy = _remedy(loop, axis, available)
    unconfirmed, lag = None, assumed_lag(loop.info, loop.period)
    if lag != loop.lag and loop.info.delay is not None:
        bears = available is not None and available >= loop.needed(axis, lag)
        unconfirmed = lag.delay if bears else loop.lag.delay
    return DampingCondition(
        axis,
        needed,
        available,
        remedy,
        None if loop.info.delay is None else loop.lag.delay,
        loop.lag.ticks_per_sample,
        _steps(loop) if axis == "translation" else None,
        unconfirmed,
        loop.info.loop_period,
    )


# Changes that a device would bear

HALVINGS = 24
"""Number of bisections of a limit; the printed three digits need half of them."""

FASTEST = 20_000.0
"""Largest rate in Hz that is proposed; loops of this package reach no higher one."""

_ROUNDING = 1e-6  # relative; keeps a limit found by bisection from losing a digit

_Part = Literal["stiffness", "damping", "period"]


def _steps(loop: LoopSetting) -> StepCondition | None:
    """Returns the condition on encoder steps, with the changes that would meet it."""
    condition = StepCondition.of(loop)
    if condition is None or condition.holds is not False:
        return condition
    finer = "take a device with finer steps or more friction"
    if not condition.available:
        told = f"without friction no coupling is free of swings by steps: {finer}"
        return replace(condition, remedy=told)
    less = NEEDED_SHARE * condition.available / (condition.needed or math.inf)
    told = _both_lowered(loop, "translation", less)
    return replace(condition, remedy=f"{told}, or {finer}")


def _both_lowered(loop: LoopSetting, axis: Axis, share: float) -> str:
    """Returns the words for a share of the law's stiffness and damping, as requested."""
    prefix, (spring, damper) = PREFIX[axis], UNITS[axis]
    gains = (share * gain for gain in loop.requested(loop.law).gains(axis))
    k, b = (_three_digits(gain) for gain in gains)
    both = f" and the damping to {b} {damper}" if loop.law.gains(axis)[1] > 0.0 else ""
    return f"lower the {prefix}stiffness to {k} {spring}{both}"


def _remedy(loop: LoopSetting, axis: Axis, available: float) -> str:
    """Returns changes with which the device has damping in reserve (``NEEDED_SHARE``).

    Stiffness and damping are the requested ones. Each quantity is changed alone; if none suffices
    alone, stiffness and damping are lowered together.
    """
    if not loop.method.has_law:
        return "lower stiffness or damping, or raise the rate"
    if available <= 0.0:
        return "a device without damping bears no coupling"
    is_own = loop.info.loop_period is not None
    if loop.law_evaluations == 1 and loop.lag != IN_TIME and not is_own:
        return _late_remedy(loop, axis, available)
    prefix, (spring, damper) = PREFIX[axis], UNITS[axis]
    parts: tuple[_Part, ...] = ("stiffness", "damping")
    # a faster loop shortens all that a device in time waits for
    is_rate_free = math.isclose(loop.h * loop.law_evaluations, loop.period)
    parts += ("period",) if is_rate_free and loop.lag == IN_TIME else ()
    share = {part: _largest(partial(_bears, loop, axis, available, part)) for part in parts}
    stiffness, damping = loop.least_requested.gains(axis)
    remedies = []
    if share["stiffness"]:
        limit = _three_digits(share["stiffness"] * stiffness)
        remedies.append(f"lower the {prefix}stiffness to {limit} {spring}")
    if share["damping"]:
        limit = _three_digits(share["damping"] * damping)
        remedies.append(f"lower the {prefix}damping to {limit} {damper}")
    if share.get("period", 0.0) * FASTEST * loop.period > 1:
        limit = _three_digits(1 / (share["period"] * loop.period), math.ceil)
        remedies.append(f"raise the rate to {limit} Hz")
    if not remedies:
        return _both_lowered(loop, axis, NEEDED_SHARE * available / loop.needed(axis))
    told = ", or ".join(remedies)
    if loop.is_hidden(axis):
        added = loop.method.compensated_share * share["stiffness"] * stiffness * loop.h
        at_most = _three_digits(added)
        told += f", with a {prefix}damping of at most {at_most} {damper}"
    return told


def _late_remedy(loop: LoopSetting, axis: Axis, available: float) -> str:
    """Returns the stiffest coupling that a late device bears, no stiffer than the requested."""
    prefix, (spring, damper) = PREFIX[axis], UNITS[axis]
    lag, slower = loop.lag, device_period(loop.info, loop.period)
    stiffness, damping = stiffest_late_coupling(
        available / loop.ratio(axis), loop.period, lag.delay, lag.ticks_per_sample
    )
    softer = min(1.0, loop.law.gains(axis)[0] / stiffness)
    law = loop.law.with_axis(axis, softer * stiffness, softer * damping)
    k, b = loop.requested(law).gains(axis)
    told = (
        f"set the {prefix}stiffness to {_three_digits(k)} {spring} and the {prefix}damping to "
        f"{_three_digits(b)} {damper}"
    )
    if _bears(loop, axis, available, "period", slower / loop.period):
        told += f", or lower the rate to {_three_digits(1 / slower)} Hz"
    return told


def _bears(loop: LoopSetting, axis: Axis, available: float, part: _Part, share: float) -> bool:
    """Returns True if the device has reserve after one quantity is reduced to a share."""
    requested, faster = loop.least_requested, 1.0
    if part == "period":
        faster = share
    else:
        k, b = requested.gains(axis)
        gains = (share * k, b) if part == "stiffness" else (k, share * b)
        requested = requested.with_axis(axis, *gains)
    needed = loop.requesting(requested, faster).needed(axis)
    return needed <= NEEDED_SHARE * available * (1 + _ROUNDING)


def _largest(holds: Callable[[float], bool]) -> float:
    """Returns a largest share in (0, 1) at which a condition holds; 0 if none does."""
    low, high = 0.0, 1.0
    if not holds(1e-3):
        return 0.0
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low


def _three_digits(value: float, rounded: Callable[[float], int] = math.floor) -> str:
    """Formats a limit, rounded down or up."""
    if value <= 0.0:
        return "0"
    digit = 10.0 ** (math.floor(math.log10(value)) - 2)
    slack = _ROUNDING if rounded is math.floor else -_ROUNDING
    return f"{rounded(value / digit * (1.0 + slack)) * digit:.6g}"


def run_conditions(
    info: DeviceInfo, parameters: RunParameters, method: Method
) -> tuple[DampingCondition, ...]:
    """Returns the device conditions of a run; none for a prescribed motion or without a coupling.

    A weld is judged by its measured stiffness and damping.
    """
    if info.is_prescribed or not method.has_coupling:
        return ()
    conditions = conditions_of(LoopSetting.of_run(info, parameters, method))
    guard, ratio = parameters.guarding, parameters.energy_ratio
    is_beside = parameters.scene_ticks > 0 or parameters.is_apart
    is_whole = method.scheme == Scheme.MIDPOINT and guard.has_hand and not is_beside
    if not (is_whole and info.turns and guard.twist_damping == math.inf):
        return conditions
    law, period, twist = parameters.coupling, parameters.period, min(guard.angle, math.pi)
    needed = ratio * midpoint_damping(
        law.rotational_stiffness, law.rotational_damping, period, twist
    )
    return tuple(
        replace(each, needed=max(needed, each.needed), remedy=each.remedy or _EARLIER)
        if each.axis == "rotation"
        else each
        for each in conditions
    )


_EARLIER = "an earlier version had a lossless torque at any twist: record the run again"
"""Remedy for a recording whose lossless coupling did not yield to a large twist."""


def condition_sentences(
    info: DeviceInfo, parameters: RunParameters, method: Method
) -> tuple[str, ...]:
    """Returns sentences on the device conditions, or on geometry for a method without a coupling.

    Without a coupling, two contacts of stiffness K_c on opposite sides of a tool, L apart, act as a
    rotational spring of ½ K_c L² about the middle. They are stable only for L <= 2 √(b_θ/(T K_c)).

    References:
        Brown & Colgate 1997, eq. (1).
    """
    sentences = [condition.sentence() for condition in run_conditions(info, parameters, method)]
    if method.has_coupling or info.is_prescribed:
        return tuple(sentences)
    if info.rotational_damping is None or not info.turns:
        return ("geometry decides: no coupling bounds what contacts do to the device",)
    damping = info.rotational_damping * parameters.scale / parameters.force_scale
    length = 2.0 * math.sqrt(damping / (parameters.period * parameters.contact_stiffness))
    return (
        f"geometry decides: two contacts of {parameters.contact_stiffness:g} N/m on opposite sides "
        f"of the tool need L <= 2 sqrt(b_theta/(T K_c)) = {length:.3g} m between them",
    )


def is_run_certified(conditions: tuple[DampingCondition, ...], method: Method) -> bool | None:
    """Returns ``is_certified``, but None instead of True for a method without a coupling law.

    For a weld b >= KT/2 + B' with its measured K and B is necessary, but not proven sufficient.
    """
    verdict = is_certified(conditions)
    return None if verdict and not method.has_law else verdict


def is_certified(conditions: tuple[DampingCondition, ...]) -> bool | None:
    """Returns True if all conditions hold; None if the outcome of one, or a delay, is unknown."""
    verdict = worst_verdict([condition.holds for condition in conditions])
    return None if verdict and any(each.delay is None for each in conditions) else verdict


def worst_verdict(verdicts: Sequence[bool | None]) -> bool | None:
    """Returns the worst of verdicts: False, then None for an unknown one, then True.

    Without any verdict the result is None: nothing was proven.
    """
    if False in verdicts:
        return False
    return None if None in verdicts or not verdicts else True


def damping_margin(conditions: tuple[DampingCondition, ...]) -> float | None:
    """Returns the smallest share of the device's damping or friction that is left, 1 − needed / b.

    It is negative if more is needed than available; None if no damping is known.
    """
    left = [condition.margin for condition in conditions if condition.available is not None]
    return min(left, default=None)
