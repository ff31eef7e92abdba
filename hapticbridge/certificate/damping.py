"""How much damping a coupling asks of a device, with substeps, a rate and a delay of its own."""

from __future__ import annotations

from functools import cache
from typing import Literal

import numpy as np

from hapticbridge.coupling import Coupling
from hapticbridge.device import DeviceInfo
from hapticbridge.device.lateness import damping_for_delay, felt_period
from hapticbridge.errors import CouplingError
from hapticbridge.kernel.parameters import SLACK_SHARE, checked_substeps
from hapticbridge.passivity import minimum_damping

LOWEST_FREQUENCY, FREQUENCIES = 3e-3, 60
"""Where the search for the damping that substeps need begins, in rad per tick, and how many
frequencies it looks at. In all cases tried the largest value lies at one end: at Nyquist, or at the
limit towards rest, which 3e-3 reaches to 1e-5."""


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


def needed_by(
    info: DeviceInfo,
    coupling: Coupling,
    period: float,
    laws: int,
    axis: Literal["translation", "rotation"] = "translation",
) -> float:
    """Returns the damping needed by a device that has a rate and a delay of its own."""
    needed = needed_damping(coupling, felt_period(info, period), laws, axis)
    return needed + damping_for_delay(info, coupling, period, axis)
