"""Default coupling of a device."""

from __future__ import annotations

import math

from hapticbridge.certificate.damping import needed_by, needed_damping
from hapticbridge.coupling import Coupling
from hapticbridge.device import DeviceInfo
from hapticbridge.device.lateness import delay_ticks, felt_period
from hapticbridge.errors import CouplingError
from hapticbridge.kernel.parameters import checked_substeps
from hapticbridge.passivity import stiffest_coupling
from hapticbridge.rendering import Method, default_method

UNKNOWN_DAMPING, UNKNOWN_ROTATIONAL_DAMPING = 2.0, 2e-3
"""Damping in N s/m and N m s/rad assumed for a device of unknown damping: that of the default
simulated device. Larger values give a stiffer default coupling that is safe on fewer devices."""

UNKNOWN_REAL_DAMPING, UNKNOWN_REAL_ROTATIONAL_DAMPING = 0.2, 2e-4
"""Damping in N s/m and N m s/rad assumed for a device with motors of unknown damping. It is a tenth
of ``UNKNOWN_DAMPING``: the low end of estimates for desktop devices, because almost no maker
publishes it."""

NEEDED_SHARE = 0.85
"""Share of the device's damping that the default coupling needs, without unit. K T/2 + B at 80 % of
the bound with B = b/4 is 0.6 b + 0.25 b. A larger share is stiffer and leaves less for an error in
b."""


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
    laws: int = 1,
    method: Method | None = None,
) -> Coupling:
    """Returns the stiffest coupling that is safe on a device: 80 % of the bound, B' = b / 4.

    The result is the requested coupling: K and B = B' + the method's own damping, so that the law
    uses B' without clipping. It needs 85 % of b. If several laws per tick or a delay need more, K
    and B' are lowered together to meet it, separately for each kind of axis; ``needed_damping`` is
    linear in both.

    Args:
        info: The device; unknown damping is replaced as in ``assumed_damping``.
        period: T in s.
        scale: Handle motion per device motion.
        force_scale: Force on the device per force on the tool.
        laws: Evaluations of the wrench per tick (substeps).
        method: Rendering method; None takes ``rendering.default_method``.

    Raises:
        CouplingError: The number of laws, a scale or the period is out of range.
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
    shrink = min(1.0, NEEDED_SHARE * damping / needed_by(info, coupling, period, laws))
    needed = needed_damping(coupling, period, laws, "rotation")
    if info.turns:
        needed = needed_by(info, coupling, period, laws, "rotation")
    shrink_rotation = min(1.0, NEEDED_SHARE * rotational / needed)
    shrunk = Coupling(
        stiffness=shrink * coupling.stiffness,
        damping=shrink * coupling.damping,
        rotational_stiffness=shrink_rotation * coupling.rotational_stiffness,
        rotational_damping=shrink_rotation * coupling.rotational_damping,
    )
    return method.rendered(shrunk, period / laws)
