"""Device damping required by a coupling."""

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
"""Lowest frequency in rad per tick, and number of frequencies, of the search for the damping that
substeps need. In all cases tried the maximum lies at one end: at Nyquist, or at the limit towards
rest, which 3e-3 approximates to 1e-5."""


@cache
def needed_damping(
    coupling: Coupling,
    period: float,
    laws: int = 1,
    axis: Literal["translation", "rotation"] = "translation",
) -> float:
    """Returns the damping b that a device needs behind a coupling, in N s/m or N m s/rad.

    K and B are those of the law (``Method.used``), not the effective ones. With one law per tick b
    = K T/2 + B. With n laws per tick the handle moves by an n-th of its step for each, and the mean
    wrench is sent. There is no closed form; b is the smallest value for which

        Σ_k f̄_k·δh_{k+1} + (b/T) ‖δh_k‖² − Σ_i f_i·δx_i − ½ s ‖δx_i‖²_{K + nB/T} >= 0,
        f_i = K e_i + (nB/T) δe_i,   e = h − x

    for every motion. The share s = ``SLACK_SHARE`` = ½ of the slack may be used; with one law it is
    the whole slack. The search finds b frequency by frequency as the smallest value of a quadratic
    form over the n deflections e_i. For B = 0, b grows with n (for strict environments it is K T
    n/2, because the mean comes late); for B > K T it falls towards B.

    The form is sufficient for any environment within its share of the slack; strict environments
    need less. Example: default coupling (K = 2400 N/m, B = 0.5 N s/m, 1 kHz) at n = 2, 4, 8. The
    form gives 1.63, 1.90, 2.42 N s/m; a wall needs 1.30, 1.60, 1.75; the worst free tool of 1 to
    0.01 kg needs 1.29, 1.65, 2.03.

    Args:
        coupling: K and B of the law.
        period: T of the device in s.
        laws: n, 1 to ``MOST_SUBSTEPS``.
        axis: Kind of axis.

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
        difference[0, -1] -= 1 / z  # last deflection of the previous tick
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
    """Returns the damping needed by a device with its own rate and delay."""
    needed = needed_damping(coupling, felt_period(info, period), laws, axis)
    return needed + damping_for_delay(info, coupling, period, axis)
