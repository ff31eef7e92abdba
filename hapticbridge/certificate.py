"""Whether a device bears a coupling, and which coupling it bears by default."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np

from hapticbridge.coupling import Coupling
from hapticbridge.device import DeviceInfo
from hapticbridge.device.lateness import damping_for_delay, delay_ticks, felt_period
from hapticbridge.errors import CouplingError
from hapticbridge.kernel.parameters import SLACK_SHARE, RunParameters, checked_substeps
from hapticbridge.passivity import minimum_damping, stiffest_coupling
from hapticbridge.rendering import Method, default_method

UNKNOWN_DAMPING, UNKNOWN_ROTATIONAL_DAMPING = 2.0, 2e-3
"""N s/m and N m s/rad from which the default coupling follows where the device's are unknown: those
of the default simulated device. Larger ones would feel stiffer and be safe on fewer devices."""

UNKNOWN_REAL_DAMPING, UNKNOWN_REAL_ROTATIONAL_DAMPING = 0.2, 2e-4
"""The same for a device that moves a motor: a tenth, the low end of what desktop devices are
believed to have, because almost no maker publishes it."""


LOWEST_FREQUENCY, FREQUENCIES = 3e-3, 60
"""Where the search for the damping that substeps need begins, in rad per tick, and how many
frequencies it looks at. In all cases tried the largest value lies at one end: at Nyquist, or at the
limit towards rest, which 3e-3 reaches to 1e-5."""


NEEDED_SHARE = 0.85
"""Share of the device's damping that the default coupling needs, without unit: K T/2 + B of 80 % of
the bound with B = b/4 is 0.6 b + 0.25 b. More is stiffer and leaves less for an error in b."""


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


@cache
def needed_damping(
    coupling: Coupling,
    period: float,
    laws: int = 1,
    axis: Literal["translation", "rotation"] = "translation",
) -> float:
    """Returns the damping b that a device needs behind a coupling, in N s/m or N m s/rad.

    K and B are those of the law: B is what a method uses (``Method.used``), not what is felt. With
    one law a tick it is K T/2 + B. With n, over each of which the handle moves by the n-th
    part of its step, and whose mean is sent, there is no such formula: b is the least for which

        Σ_k f̄_k·δh_{k+1} + (b/T) ‖δh_k‖² − Σ_i f_i·δx_i − ½ s ‖δx_i‖²_{K + nB/T} >= 0,
        f_i = K e_i + (nB/T) δe_i,   e = h − x

    for every motion, where the share s = ``SLACK_SHARE`` = ½ of the slack may be used; with one law
    it is the whole slack. It is found frequency by frequency, as the smallest value of a quadratic
    form over the n deflections e_i; where B = 0 it grows with n (strictly K T n/2: the mean comes
    late), where B > K T it falls towards B.

    The form is sufficient for any environment within its share of the slack. Environments that are
    strict need less: at n = 2, 4, 8 of the default coupling (K = 2400 N/m, B = 0.5 N s/m, 1 kHz)
    the form says 1.63, 1.90, 2.42 N s/m, a wall needs 1.30, 1.60, 1.75, and the worst free tool of
    1 to 0.01 kg 1.29, 1.65, 2.03.

    Args:
        coupling: K and B of the law.
        period: T in s, of the device.
        laws: n, 1 to ``MOST_SUBSTEPS``.
        axis: Which gains to take.

    Raises:
        CouplingError: n or the period is out of range.

    References:
        Brown & Colgate 1997, eq. (6), for n = 1.
    """
    if checked_substeps(laws, CouplingError) == 1:
        return float(minimum_damping(coupling, period, axis=axis))
    is_linear = axis == "translation"
    k = coupling.stiffness if is_linear else coupling.rotational_stiffness
    b = (coupling.damping if is_linear else coupling.rotational_damping) * laws / period
    if k == 0.0:
        return float(b * period / laws)
    identity, ones = np.eye(laws), np.full(laws, 1.0 / laws)
    most = 0.0
    for theta in np.geomspace(LOWEST_FREQUENCY, np.pi, FREQUENCIES):
        z = np.exp(1j * theta)
        difference = identity - np.eye(laws, k=-1) + 0j
        difference[0, -1] -= 1 / z  # the last deflection of the tick before
        law = k * identity + b * difference
        form = law.conj().T @ difference
        slack = 0.5 * SLACK_SHARE * (k + b)
        form = 0.5 * (form + form.conj().T) - slack * difference.conj().T @ difference
        linear = 0.5 * law.conj().T @ ((z - 1) * ones) + slack * difference.conj().T @ ones
        gained = np.vdot(linear, np.linalg.solve(form, linear)).real + slack / laws
        most = max(most, float(gained))
    return most * period


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
        needed = scale * force_scale * _needed_on(info, coupling, period, laws)
        remedy = _remedy(method, coupling.damping)
        conditions.append(Condition("translation", needed, info.damping, remedy, delay))
        if info.turns:
            needed = force_scale / scale * _needed_on(info, coupling, period, laws, "rotation")
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


def _needed_on(
    info: DeviceInfo,
    coupling: Coupling,
    period: float,
    laws: int,
    axis: Literal["translation", "rotation"] = "translation",
) -> float:
    """Returns the damping needed by a device that has a rate and a delay of its own."""
    needed = needed_damping(coupling, felt_period(info, period), laws, axis)
    return needed + damping_for_delay(info, coupling, period, axis)


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


def assumed_damping(info: DeviceInfo) -> tuple[float, float]:
    """Returns the damping in N s/m and N m s/rad that a device has, or is taken to have.

    Unknown, or zero, it is ``UNKNOWN_DAMPING``, of a real device ``UNKNOWN_REAL_DAMPING``.
    """
    linear = info.damping or (UNKNOWN_REAL_DAMPING if info.is_real else UNKNOWN_DAMPING)
    angular = info.rotational_damping or (
        UNKNOWN_REAL_ROTATIONAL_DAMPING
        if info.is_real and info.turns
        else UNKNOWN_ROTATIONAL_DAMPING
    )
    return linear, angular


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


def default_coupling(
    info: DeviceInfo,
    period: float,
    scale: float = 1.0,
    force_scale: float = 1.0,
    laws: int = 1,
    method: Method | None = None,
) -> Coupling:
    """Returns the stiffest coupling that is safe on a device: 80 % of the bound, B' = b / 4.

    It is what is to be felt: K and B = B' + what the method adds by itself, so that the method uses
    B' without clipping. It needs 85 % of b. Where several laws a tick or a delay need more, K and
    B' are lowered together until they need no more than that, each kind of axis by itself:
    ``needed_damping`` is linear in the two.

    Args:
        info: The device; where its damping is unknown, ``UNKNOWN_DAMPING`` is assumed, of a real
            one ``UNKNOWN_REAL_DAMPING``.
        period: T in s.
        scale: Handle motion per device motion.
        force_scale: Force on the device per force on the tool.
        laws: How often per tick the wrench is computed (substeps).
        method: How the tool is rendered; None takes ``rendering.default_method``.

    Raises:
        CouplingError: The number of laws is out of range, or a scale is not finite and positive, or
            so is the period.
    """
    for name, value in (("scale", scale), ("force_scale", force_scale)):
        if not math.isfinite(value) or value <= 0:
            raise CouplingError(f"{name} is {value!r}; it must be finite and > 0")
    damping, rotational = assumed_damping(info)
    damping /= scale * force_scale
    rotational *= scale / force_scale
    coupling = stiffest_coupling(damping, rotational, felt_period(info, period))
    checked_substeps(laws, CouplingError)
    method = default_method(laws) if method is None else method
    if laws == 1 and not delay_ticks(info, period):
        return method.rendered(coupling, period)
    shrink = min(1.0, NEEDED_SHARE * damping / _needed_on(info, coupling, period, laws))
    needed = needed_damping(coupling, period, laws, "rotation")
    if info.turns:
        needed = _needed_on(info, coupling, period, laws, "rotation")
    shrink_rotation = min(1.0, NEEDED_SHARE * rotational / needed)
    shrunk = Coupling(
        stiffness=shrink * coupling.stiffness,
        damping=shrink * coupling.damping,
        rotational_stiffness=shrink_rotation * coupling.rotational_stiffness,
        rotational_damping=shrink_rotation * coupling.rotational_damping,
    )
    return method.rendered(shrunk, period / laws)
