"""Rendering methods that exist only to be compared; importing this module registers them.

To add a method that exists only to be compared:

1. Here, add a ``methods.Method`` to ``_COMPARED``. If the theory of a free tool is known, add an
   entry to ``THEORIES``, which the maps ``coupling`` and ``tool_mass`` show.
2. For a new path of the wrench, add a number to ``kernel.codes.Scheme`` with its
   ``SchemeProperties``, and a branch to ``drive_compared`` and ``compared_wrench`` of
   ``kernel.compared_methods``. A test fails while a scheme has no branch.
3. For a coupling law with another wrench, add it to ``audit.motion.wrench_by_law``, by which the
   audit computes every wrench again, and its gains to ``kernel.law.slack_gains`` and
   ``audit.energy``. A path without a law has ``has_law=False`` and needs neither.

``methods`` has the recipe for a method of the product.
"""

from __future__ import annotations

from functools import partial

from hapticbridge.coupling import Coupling
from hapticbridge.demand.methods import METHODS, Method
from hapticbridge.kernel.codes import Scheme
from hapticbridge.kernel.law import Gains, no_gains
from hapticbridge.scene.checks import check_massless_tool
from hapticbridge.scene.handle import check_weldable
from hapticbridge.theory.bounds import IMPLICIT_SHARE

__all__ = ["METHODS", "THEORIES"]

_CREATES = "creates energy in free motion, more the lighter the tool and the stiffer the coupling"
_HELD_ABOUT = (
    "the wrench of the coupling law, computed after each step and applied as a force during the "
    "next tick, held; under MuJoCo's integrator {}"
)
_HELD_HAZARD = (
    f"the wrench acts one tick late: it {_CREATES}, and a light tool diverges whatever the device"
)


def _held_gains(_coupling: Coupling, _timestep: float) -> tuple[Gains, Gains]:
    return (1.0, 0.0, 0.0), (1.0, 0.0, 0.0)


def _gains_with_lag(coupling: Coupling, timestep: float) -> tuple[Gains, Gains]:
    """Returns gains with K h more damping, which makes an implicit velocity one of position too."""
    k, b = coupling.stiffness, coupling.damping
    kr, br = coupling.rotational_stiffness, coupling.rotational_damping
    return (b, k, b + k * timestep), (br, kr, br + kr * timestep)


_COMPARED = (
    Method(
        name="implicitfast",
        about="the same actuators under implicitfast: implicit in velocity, not in position",
        hazard=f"the spring is not solved implicitly: it {_CREATES}",
        scheme=Scheme.IMPLICIT,
        integrator="implicitfast",
    ),
    Method(
        name="implicitfast:compensated",
        about="the same actuators under implicitfast with K T more damping, which away from "
        "contact makes the step equal to that of 'implicit'",
        hazard="contacts are solved without the coupling's stiffness and may create energy",
        scheme=Scheme.IMPLICIT,
        integrator="implicitfast",
        gains=_gains_with_lag,
        added_share=IMPLICIT_SHARE,
    ),
    *(
        Method(
            name="explicit" if integrator == "Euler" else f"explicit:{integrator.lower()}",
            about=_HELD_ABOUT.format(integrator),
            hazard=_HELD_HAZARD,
            scheme=Scheme.ZERO_ORDER_HOLD,
            integrator=integrator,
            gains=_held_gains,
            warns=False,
        )
        for integrator in ("Euler", "implicitfast", "RK4")
    ),
    Method(
        name="weld",
        about="an equality constraint of MuJoCo welds the tool to the handle, under "
        "implicitfast, with K and B as its solref; how stiff it truly is depends on the tool's "
        "mass and on the constraint's impedance",
        hazard="the weld's stiffness is not the requested K but mass times K/(1 - impedance) "
        "as measured, and no coupling law proves what the device needs",
        scheme=Scheme.WELD,
        integrator="implicitfast",
        discretization="none",
        gains=no_gains,
        check=check_weldable,
        warns=False,
    ),
    Method(
        name="direct",
        about="a tool without mass that is where the handle is, pushed back by a spring per "
        "contact; there is no coupling",
        hazard="geometry decides what the device needs: two contacts a distance L apart are "
        "stable only for L <= 2 sqrt(b_theta / (T K_c))",
        scheme=Scheme.MASSLESS,
        integrator="discrete",
        discretization="none",
        gains=no_gains,
        check=partial(check_massless_tool, method="direct"),
        warns=False,
    ),
)

METHODS.update((method.name, method) for method in _COMPARED)

THEORIES = {
    "implicit": "implicit",
    "compensated": "implicit",
    "lossless": "lossless",
    "implicitfast": "implicitfast",
    "implicitfast:compensated": "implicit",
    "explicit": "explicit",
    "explicit:rk4": "explicit:rk4",
    "weld": "implicit",
}
"""Theory of a free tool (``lab.maps.tool_mass``) by method; the map ``coupling`` shows these. The
law of ``weld`` is not that of the coupling; its theory is that of the nominal K and B. On a heavy
tool the weld is stiffer by the mass, so it has no wall without contact."""
