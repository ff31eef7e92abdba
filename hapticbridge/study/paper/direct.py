"""Equation (1): rendering a tool directly, and why its length decides."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.study.paper.check import Check
from hapticbridge.study.paper.drawing import panels
from hapticbridge.study.paper.section import Curve, Section
from hapticbridge.theory.bounds import maximum_stiffness
from hapticbridge.theory.sampled_loop import SampledLoop, stability_limit
from hapticbridge.theory.spectrum import needed_for_fixed_environment
from hapticbridge.theory.transfer import angles, coupling_transfer

PERIOD = 1e-3
"""T in s."""

CONTACT = 1e4
"""K_c in N/m: a stiff contact, so that a peg of a few centimetres is at the limit."""
DEVICE = 2e-3
"""b_θ in N m s/rad, the simulated device's."""
BEHIND = Coupling(stiffness=2.4, damping=5e-4, rotational_stiffness=0, rotational_damping=0)
"""The coupling that the comparison puts in between, as one axis: 2.4 N m/rad, 5e-4 N m s/rad."""


def _contact_hessian(length: float) -> NDArray[np.float64]:
    """Second differences of the energy of two contact springs, over (x, y, angle)."""

    def energy(pose: NDArray[np.float64]) -> float:
        x, _, angle = pose
        arm = length / 2 * np.sin(angle)
        return float(0.5 * CONTACT * ((x + arm) ** 2 + (x - arm) ** 2))

    step = 1e-4
    unit = step * np.eye(3)
    return np.array(
        [
            [
                (energy(i + j) - energy(i - j) - energy(j - i) + energy(-i - j)) / (4 * step**2)
                for j in unit
            ]
            for i in unit
        ]
    )


def _needed_behind(stiffness: NDArray[np.float64]) -> NDArray[np.float64]:
    """Worst damping over frequency for a massless tool between the coupling and a spring."""
    theta = angles(np.linspace(1e-3, np.pi, 2000) / PERIOD, PERIOD)
    k, b = np.asarray(BEHIND.stiffness), np.asarray(BEHIND.damping)
    coupling = coupling_transfer(k, b, PERIOD, theta, "backward", 0.0)
    spring = stiffness[:, None]
    felt = coupling * spring / (coupling + spring)
    return np.asarray(needed_for_fixed_environment(felt, PERIOD, theta).max(axis=1))


def section() -> Section:
    """Walks through (1), with the erratum."""
    limit = float(2 * np.sqrt(DEVICE / (PERIOD * CONTACT)))
    lengths = np.geomspace(2e-3, 0.3, 200)
    stiffness = 0.5 * CONTACT * lengths**2
    behind = _needed_behind(stiffness)
    bound = BEHIND.stiffness * PERIOD / 2 + BEHIND.damping

    figure, (axes,) = panels(1, height=4.2)
    axes.loglog(1e3 * lengths, stiffness * PERIOD / 2, label="rendered directly, ¼ K_c L² T")
    axes.loglog(1e3 * lengths, behind, label="behind a coupling")
    axes.axhline(bound, color="C1", ls=":", label="K_r T/2 + B_r, the coupling's own bound (6)")
    axes.axhline(DEVICE, color="grey", ls="--", label="this device's b_θ")
    axes.axvline(1e3 * limit, color="C3", lw=1, label="L = 2 √(b_θ/(T K_c))")
    axes.set_xlabel("distance L between the contacts (mm)")
    axes.set_ylabel("rotational damping needed (N m s/rad)")
    axes.legend(fontsize="small")

    hessian = _contact_hessian(limit)
    spring = Coupling(0.5 * CONTACT * limit**2, 0.0, 0.0, 0.0)
    return Section(
        equation="(1)",
        title="Direct rendering: the geometry of the tool decides",
        formulas=(
            "K<sub>peg</sub> = diag( 2K<sub>c</sub>, 0, ½ K<sub>c</sub> L² )",
            "L ≤ 2 √( b<sub>θ</sub> / (T K<sub>c</sub>) )",
        ),
        paragraphs=(
            "A massless rigid peg tracks the handle in a grounded hole. Each of two contacts on "
            "opposite walls has the stiffness K<sub>c</sub>; they lie a distance L apart, with "
            "the handle midway. The rotational entry ½ K<sub>c</sub> L² is that of the paper's "
            "erratum. The first lateral contact alone gives K<sub>c</sub>.",
            "A device with rotational damping b<sub>θ</sub> bears the stiffness 2 "
            f"b<sub>θ</sub>/T, so a contact of {CONTACT:g} N/m at {PERIOD * 1e3:g} ms and "
            f"{DEVICE:g} N m s/rad allows {1e3 * limit:.2f} mm. A longer tool is unstable. Behind "
            "a coupling the need levels off at the coupling's own bound, whatever L is.",
        ),
        curves=(
            Curve(
                "direct_rendering",
                "Damping that a device needs over the distance of the contacts.",
                figure,
            ),
        ),
        checks=(
            Check(
                equation="(1)",
                quantity="lateral stiffness 2K_c",
                route="second difference of the contacts' energy",
                expected=2 * CONTACT,
                got=float(hessian[0, 0]),
                unit="N/m",
                tolerance=1e-6,
            ),
            Check(
                equation="(1)",
                quantity="rotational stiffness ½K_c L² (erratum) at the limit, 2b_θ/T",
                route="second difference of the contacts' energy",
                expected=float(maximum_stiffness(DEVICE, PERIOD)),
                got=float(hessian[2, 2]),
                unit="N m/rad",
                # the second difference of sin² over 1e-4 rad is short by 1e-8 of itself
                tolerance=1e-6,
            ),
            Check(
                equation="(1)",
                quantity=f"b_θ at which L = {1e3 * limit:.2f} mm is stable",
                route="time-domain loop, bisection",
                expected=DEVICE,
                got=stability_limit(SampledLoop(spring, PERIOD)),
                unit="N m s/rad",
                tolerance=1e-3,
            ),
            Check(
                equation="(1)",
                quantity="b_θ needed behind the coupling, largest over L = 2 … 300 mm",
                route="frequency sweep, against the bound (6) of the coupling",
                expected=bound,
                got=float(behind.max()),
                unit="N m s/rad",
                tolerance=1e-9,
                relation="at most",
            ),
        ),
    )
