"""The methods there are, by name; all but those with the coupling as actuators stand to compare."""

from __future__ import annotations

from dataclasses import replace

from hapticbridge.errors import SceneError, choices
from hapticbridge.kernel.scheme import COUPLED, DIRECT, HELD, LOSSLESS, WELD
from hapticbridge.passivity.compensation import IMPLICIT_LAG, MIDPOINT_LAG
from hapticbridge.rendering.method import Method

_CREATES = "creates energy in free motion, more the lighter the tool and the stiffer the coupling"
_HELD_ABOUT = (
    "the wrench of the coupling law, computed after each step and applied as a force during the "
    "next tick, held; under MuJoCo's integrator {}"
)
_HELD_HAZARD = (
    f"the wrench acts one tick late: it {_CREATES}, and a light tool diverges whatever the device"
)

IMPLICIT = Method(
    name="implicit",
    about="the coupling as actuators under MuJoCo's discrete integrator: implicit in position and "
    "velocity, solved together with the contacts, passive behind the coupling",
    hazard="",
    scheme=COUPLED,
    integrator="discrete",
    adds=IMPLICIT_LAG,
)

COMPENSATED = replace(
    IMPLICIT,
    name="compensated",
    about="implicit, with the damping K T that its integration adds taken off the coupling's",
    lag=IMPLICIT_LAG,
)

LOSSLESS_COUPLING = Method(
    name="lossless",
    about="half of the coupling inside MuJoCo's implicit step, half carried over from the last: a "
    "free tool keeps its energy and is followed to second order; near contacts it is 'implicit'",
    hazard="",
    scheme=LOSSLESS,
    integrator="discrete",
    lag=MIDPOINT_LAG,
    adds=MIDPOINT_LAG,
)

METHODS = {
    method.name: method
    for method in (
        IMPLICIT,
        COMPENSATED,
        LOSSLESS_COUPLING,
        Method(
            name="implicitfast",
            about="the same actuators under implicitfast: implicit in velocity, not in position",
            hazard=f"the spring is not solved implicitly: it {_CREATES}",
            scheme=COUPLED,
            integrator="implicitfast",
        ),
        Method(
            name="implicitfast:compensated",
            about="the same actuators under implicitfast with K T more damping, which away from "
            "contact makes the step equal to that of 'implicit'",
            hazard="contacts are solved without the coupling's stiffness and may create energy",
            scheme=COUPLED,
            integrator="implicitfast",
            compensated=True,
            adds=IMPLICIT_LAG,
        ),
        *(
            Method(
                name="explicit" if integrator == "Euler" else f"explicit:{integrator.lower()}",
                about=_HELD_ABOUT.format(integrator),
                hazard=_HELD_HAZARD,
                scheme=HELD,
                integrator=integrator,
            )
            for integrator in ("Euler", "implicitfast", "RK4")
        ),
        Method(
            name="weld",
            about="an equality constraint of MuJoCo welds the tool to the handle, under "
            "implicitfast, with K and B as its solref; how stiff it truly is depends on the tool's "
            "mass and on the constraint's impedance",
            hazard="the weld's stiffness is not the one asked for but mass times K/(1 - impedance) "
            "as measured, and no coupling law proves what the device needs",
            scheme=WELD,
            integrator="implicitfast",
            discretization="none",
        ),
        Method(
            name="direct",
            about="a tool without mass that is where the handle is, pushed back by a spring per "
            "contact; there is no coupling",
            hazard="geometry decides what the device needs: two contacts a distance L apart are "
            "stable only for L <= 2 sqrt(b_theta / (T K_c))",
            scheme=DIRECT,
            integrator="discrete",
            discretization="none",
        ),
    )
}


def default_method(substeps: int = 1) -> Method:
    """Returns the method that is taken where none is asked for.

    ``lossless`` where a tick is one MuJoCo step: on every shipped scene, in 20 hands each, it is
    strict; away from contact it is ten times and more as accurate as ``implicit``, and in contact
    it is that, with the same B' and so for the same device. It takes no substeps; with them,
    ``implicit``.

    Where a contact creates energy, ``implicit`` with the same B' has burned some on the way there,
    and ``lossless`` has not: tapping on a wall it uses 7.2 % of the slack instead of 7.0 % at most,
    on jamming pegs the same (``scripts/bench_methods --same device``). Near contact it adds K T to
    B', and says K T/2: tapping at 6 Hz it is 54 µm RMS away from what it says is felt, ``implicit``
    26 µm from what that says, B + K T/2, and 116 µm from B (``scripts/bench_front``).
    """
    return LOSSLESS_COUPLING if substeps == 1 else IMPLICIT


def method_named(name: str) -> Method:
    """Returns a method by its name.

    Raises:
        SceneError: There is no such method; lists those that exist.
    """
    if name not in METHODS:
        raise SceneError(f"no method is called '{name}'; methods: {choices(METHODS)}")
    return METHODS[name]
