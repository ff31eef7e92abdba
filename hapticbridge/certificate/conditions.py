"""Whether a device bears a coupling, kind of axis by kind of axis, in words and as a verdict."""

from __future__ import annotations

import math
from dataclasses import dataclass

from hapticbridge.certificate.damping import needed_by
from hapticbridge.coupling import Coupling
from hapticbridge.device import DeviceInfo
from hapticbridge.device.lateness import delay_ticks
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.rendering import Method


@dataclass(frozen=True, slots=True)
class Condition:
    """The device condition b >= scale · force_scale · (K T / 2 + B') on one kind of axis.

    Attributes:
        axis: ``translation`` or ``rotation``.
        needed: The right-hand side in N s/m (rotation: N m s/rad).
        available: The device's damping b; None where unknown.
        remedy: What to change if it does not hold.
        delay: After how many ticks a wrench answers a sample, 0 at best; None where unknown.
    """

    axis: str
    needed: float
    available: float | None
    remedy: str = "lower stiffness or damping, or raise the rate"
    delay: int | None = 0

    @property
    def holds(self) -> bool | None:
        """Whether the device has enough damping; None where that is unknown."""
        return None if self.available is None else self.available >= self.needed

    def sentence(self) -> str:
        """Says it, with what to change if it does not hold."""
        unit = "N s/m" if self.axis == "translation" else "N m s/rad"
        if self.available is None:
            return (
                f"{self.axis}: device damping unknown, {self.needed:g} {unit} needed; "
                "'hapticbridge identify' measures it"
            )
        relation = ">=" if self.holds else "<"
        text = f"{self.axis}: device damping {self.available:g} {relation} {self.needed:g} {unit}"
        if not self.holds:
            return f"{text}; {self.remedy}"
        if self.delay is None:
            return f"{text}, if it answers without delay, which is unknown"
        late = f", for a wall behind a delay of {self.delay} ticks: no bound holds for any scene"
        return f"{text}{late}" if self.delay else text


def device_conditions(
    info: DeviceInfo,
    coupling: Coupling,
    period: float,
    scale: float,
    force_scale: float,
    laws: int = 1,
    method: Method | None = None,
) -> tuple[Condition, ...]:
    """Returns the condition per kind of axis that the device has, if b of translation is known.

    A handle that moves ``scale`` times as far and a force that returns ``force_scale`` times as
    large make the coupling scale · force_scale times as stiff for the device; angles are not
    scaled, so torques return by force_scale / scale. A device's own rate and delay count
    (``device.lateness``).

    Args:
        info: The device.
        coupling: K and B' of the law: what is used, not what is felt.
        period: T in s.
        scale: Handle motion per device motion.
        force_scale: Force on the device per force on the tool.
        laws: How often per tick the wrench is computed (substeps).
        method: How the tool is rendered, which decides what helps where the damping is too low;
            None: one that uses the damping as asked.

    References:
        Brown & Colgate 1997, eq. (6); sufficient for any environment that satisfies (14).
    """
    conditions = []
    if info.damping is not None:
        delay = delay_ticks(info, period)
        needed = scale * force_scale * needed_by(info, coupling, period, laws)
        remedy = _remedy(method, coupling.damping)
        conditions.append(Condition("translation", needed, info.damping, remedy, delay))
        if info.turns:
            needed = force_scale / scale * needed_by(info, coupling, period, laws, "rotation")
            remedy = _remedy(method, coupling.rotational_damping)
            conditions.append(Condition("rotation", needed, info.rotational_damping, remedy, delay))
    return tuple(conditions)


def needed_on_axes(
    info: DeviceInfo,
    coupling: Coupling,
    period: float,
    scale: float,
    force_scale: float,
    laws: int,
    method: Method,
) -> tuple[float, float]:
    """Returns the damping that a coupling needs in N s/m and N m s/rad; 0 where nothing asks.

    See ``device_conditions`` for the arguments.
    """
    if not method.has_coupling:
        return 0.0, 0.0
    conditions = device_conditions(info, coupling, period, scale, force_scale, laws, method)
    needed = {condition.axis: condition.needed for condition in conditions}
    return needed.get("translation", 0.0), needed.get("rotation", 0.0)


def _remedy(method: Method | None, used: float) -> str:
    """Returns what lowers the damping needed.

    A method that takes its own damping off what is felt spends on B' what a softer spring or a
    shorter period saves, or more, as long as there is some B': until then only B counts.
    """
    if method is None or method.lag == 0.0:
        return "lower stiffness or damping, or raise the rate"
    return "lower the damping" if used > 0 else "lower the stiffness, or raise the rate"


def run_conditions(
    info: DeviceInfo, parameters: RunParameters, method: Method
) -> tuple[Condition, ...]:
    """Returns the device conditions of a run; none for a prescribed motion or without a coupling.

    A weld is judged by the stiffness and damping that it truly has.
    """
    if info.is_prescribed or not method.has_coupling:
        return ()
    return device_conditions(
        info,
        parameters.felt or parameters.coupling,
        parameters.period,
        parameters.scale,
        parameters.force_scale,
        parameters.laws,
        method,
    )


def condition_sentences(
    info: DeviceInfo, parameters: RunParameters, method: Method
) -> tuple[str, ...]:
    """Returns what is to be said of device and method, one sentence each.

    Without a coupling geometry decides: two contacts of stiffness K_c on opposite sides of a tool,
    L apart, are a rotational spring of ½ K_c L² about the middle, and stable only for
    L <= 2 √(b_θ/(T K_c)).

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


def is_run_certified(conditions: tuple[Condition, ...], method: Method) -> bool | None:
    """As ``is_certified``; None also where the conditions hold, but no coupling law makes them do.

    For a weld b >= KT/2 + B' is necessary with what it truly is, but nothing proves it enough.
    """
    verdict = is_certified(conditions)
    return None if verdict and not method.has_law else verdict


def is_certified(conditions: tuple[Condition, ...]) -> bool | None:
    """Returns whether all conditions hold; None where unknown, or where a delay forbids a proof."""
    held = {condition.holds for condition in conditions}
    is_late = any(condition.delay != 0 for condition in conditions)
    return False if False in held else None if None in held or not held or is_late else True


def damping_margin(conditions: tuple[Condition, ...]) -> float | None:
    """Returns the least share of the device's damping that is left, 1 − needed / b.

    Negative where more is needed than there is; None where no damping is known.
    """
    shares = [
        1.0 - condition.needed / condition.available if condition.available else -math.inf
        for condition in conditions
        if condition.available is not None
    ]
    return min(shares, default=None)
