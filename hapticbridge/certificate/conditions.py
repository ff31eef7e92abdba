"""Device conditions and their verdict."""

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
        needed: Right-hand side in N s/m (rotation: N m s/rad).
        available: The device's damping b; None if unknown.
        remedy: Change that helps if the condition fails.
        delay: Ticks from a sample to the wrench that answers it, 0 at best; None if unknown.
    """

    axis: str
    needed: float
    available: float | None
    remedy: str = "lower stiffness or damping, or raise the rate"
    delay: int | None = 0

    @property
    def holds(self) -> bool | None:
        """True if the device has enough damping; None if that is unknown."""
        return None if self.available is None else self.available >= self.needed

    def sentence(self) -> str:
        """Describes the condition, with the remedy if it fails."""
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
    """Returns the condition for each kind of axis of a device with known translational damping.

    For the device, the coupling is scale · force_scale times as stiff in translation. Angles are
    not scaled, so the factor for rotation is force_scale / scale. The device's own rate and delay
    count (``device.lateness``).

    Args:
        info: The device.
        coupling: K and B' of the law, not the effective coupling.
        period: T in s.
        scale: Handle motion per device motion.
        force_scale: Force on the device per force on the tool.
        laws: Evaluations of the wrench per tick (substeps).
        method: Rendering method, which decides the remedy; None for one that uses the damping as
            requested.

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
    """Returns the damping that a coupling needs, in N s/m and N m s/rad; 0 without a condition.

    Arguments are those of ``device_conditions``.
    """
    if not method.has_coupling:
        return 0.0, 0.0
    conditions = device_conditions(info, coupling, period, scale, force_scale, laws, method)
    needed = {condition.axis: condition.needed for condition in conditions}
    return needed.get("translation", 0.0), needed.get("rotation", 0.0)


def _remedy(method: Method | None, used: float) -> str:
    """Returns the change that lowers the required damping.

    For a method that subtracts its own damping, a softer spring or a shorter period raises B' by as
    much as it saves, or more. While B' > 0, only a lower B helps.
    """
    if method is None or method.lag == 0.0:
        return "lower stiffness or damping, or raise the rate"
    return "lower the damping" if used > 0 else "lower the stiffness, or raise the rate"


def run_conditions(
    info: DeviceInfo, parameters: RunParameters, method: Method
) -> tuple[Condition, ...]:
    """Returns the device conditions of a run; none for a prescribed motion or without a coupling.

    A weld is judged by its measured stiffness and damping.
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


def is_run_certified(conditions: tuple[Condition, ...], method: Method) -> bool | None:
    """Returns ``is_certified``, but None instead of True for a method without a coupling law.

    For a weld b >= KT/2 + B' with its measured K and B is necessary, but not proven sufficient.
    """
    verdict = is_certified(conditions)
    return None if verdict and not method.has_law else verdict


def is_certified(conditions: tuple[Condition, ...]) -> bool | None:
    """Returns True if all conditions hold; None if one is unknown or a delay forbids a proof."""
    held = {condition.holds for condition in conditions}
    is_late = any(condition.delay != 0 for condition in conditions)
    return False if False in held else None if None in held or not held or is_late else True


def damping_margin(conditions: tuple[Condition, ...]) -> float | None:
    """Returns the smallest share of the device's damping that is left, 1 − needed / b.

    It is negative if more is needed than available; None if no damping is known.
    """
    shares = [
        1.0 - condition.needed / condition.available if condition.available else -math.inf
        for condition in conditions
        if condition.available is not None
    ]
    return min(shares, default=None)
