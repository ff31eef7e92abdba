"""A free tool behind the coupling, by rendering method: what theory says of its mass.

The methods differ in the samples from force to position: none (implicit), a half (lossless, the
trapezoidal rule), one (explicit), one and a half (RK4, which holds the force exactly); the
actuators of implicitfast have the spring at the old place and the damper at the new velocity. K and
B are those of the law: of a method that takes some damping off (``Method.used``), what is left.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.errors import StudyError, choices
from hapticbridge.theory.spectrum import needed_for_fixed_environment

NAMES = ("implicit", "lossless", "implicitfast", "explicit", "explicit:rk4")
"""Methods that have a theory here."""

ANGLES = np.union1d(np.linspace(0.01, np.pi, 2000), np.geomspace(0.01, np.pi, 1000))
"""θ in rad at which theory is evaluated, even in θ and in log θ; to be finer than resonances of a
heavy tool, which are B/m wide."""


def least_mass(method: str, stiffness: float, damping: float, period: float) -> float:
    """Returns the mass that a free tool must exceed to be stable behind a handle held still.

        implicit        0
        lossless        0
        implicitfast    (T/2)(K T/2 − B), at least 0
        explicit        (T/2)(K T/2 + B)
        explicit:rk4    (B T/2)(2B + K T)/(2B − K T);  inf for B <= K T/2

    From Jury's test of the loop z-transformed: the actuators of implicitfast have the spring at the
    old place and the damper at the new velocity; RK4 holds the force exactly.

    Args:
        method: One of ``NAMES``.
        stiffness: K in N/m, > 0.
        damping: B in N s/m, >= 0.
        period: T in s, > 0.

    Returns:
        m in kg.

    Raises:
        StudyError: The method is none of these, or a value is out of range.

    References:
        Brown & Colgate 1997, conditions that belong to eq. (19), for the semi-implicit step; the
        other two are derived here alike.
    """
    _check(method, stiffness, damping, period)
    kt, b = stiffness * period, damping
    if method in ("implicit", "lossless"):
        return 0.0
    if method == "implicitfast":
        return max(0.0, period / 2 * (kt / 2 - b))
    if method == "explicit":
        return period / 2 * (kt / 2 + b)
    return b * period / 2 * (2 * b + kt) / (2 * b - kt) if 2 * b > kt else float("inf")


def felt(
    method: str, stiffness: float, damping: float, mass: float, period: float, angle: ArrayLike
) -> NDArray[np.complex128]:
    """Returns what the device feels of a free tool, force per displacement of the handle.

        H = C / (1 + C P),    C = K + B D/T,    D = 1 − z⁻¹,    P = (T²/m) n / D²
        n = 1 (implicit),  (1 + z⁻¹)/2 (lossless),  z⁻¹ (explicit),
        z⁻¹(1 + z⁻¹)/2 (explicit:rk4, the exact hold)
        H = C (m D²/T² − K D) / (m D²/T² + K z⁻¹ + B D/T)          (implicitfast)

    Args:
        method: One of ``NAMES``.
        stiffness: K in N/m, > 0.
        damping: B in N s/m, >= 0.
        mass: m in kg, > 0.
        period: T in s, > 0.
        angle: θ = ωT in rad, 0 < θ <= π, any shape.

    Returns:
        H in N/m, shaped like the angle.

    Raises:
        StudyError: The method is none of these, or a value is out of range.
    """
    _check(method, stiffness, damping, period, mass)
    back = np.exp(-1j * np.asarray(angle, dtype=np.float64))
    change = 1 - back
    coupling = stiffness + damping / period * change
    inertia = mass * change**2 / period**2
    if method == "implicitfast":
        rest = inertia + stiffness * back + damping / period * change
        return np.asarray(coupling * (inertia - stiffness * change) / rest)
    late = {
        "implicit": 1 + 0 * back,
        "lossless": (1 + back) / 2,
        "explicit": back,
        "explicit:rk4": back * (1 + back) / 2,
    }
    return np.asarray(coupling / (1 + coupling * late[method] / inertia))


def worst_angle(
    method: str, stiffness: float, damping: float, mass: float, period: float
) -> tuple[float, float]:
    """Returns θ in rad at which a free tool needs most device damping, and that b in N s/m.

    The damping is what any passive hand may ask for, provided that the tool is stable behind a
    handle held still (``least_mass``); else inf.

    Raises:
        StudyError: The method is none of ``NAMES``, or a value is out of range.

    References:
        Colgate & Schenkel 1997.
    """
    response = felt(method, stiffness, damping, mass, period, ANGLES)
    needed = needed_for_fixed_environment(response, period, ANGLES)
    place = int(np.flatnonzero(needed >= needed.max() - 1e-12 * abs(needed.max()))[-1])
    is_stable = mass > least_mass(method, stiffness, damping, period)
    return float(ANGLES[place]), float(needed[place]) if is_stable else float("inf")


def _check(method: str, stiffness: float, damping: float, period: float, mass: float = 1.0) -> None:
    if method not in NAMES:
        raise StudyError(f"no theory for method '{method}' here; choose {choices(NAMES)}")
    for name, value, unit in (
        ("stiffness", stiffness, "N/m"),
        ("period", period, "s"),
        ("mass", mass, "kg"),
    ):
        if not (np.isfinite(value) and value > 0):
            raise StudyError(f"{name} is {value!r} {unit}; it must be finite and > 0")
    if not (np.isfinite(damping) and damping >= 0):
        raise StudyError(f"damping is {damping!r} N s/m; it must be finite and >= 0")
