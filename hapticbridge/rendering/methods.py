"""Table of rendering methods; those without coupling actuators serve for comparison."""

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
    """Returns the default method: ``lossless`` with one MuJoCo step per tick, else ``implicit``.

    ``lossless`` takes no substeps. It is strict on every shipped scene, in 20 hands each. Away from
    contact it is at least ten times as accurate as ``implicit``; in contact it equals ``implicit``
    with the same B', and so suits the same device.

    ``implicit`` dissipates some energy on the way to a contact and ``lossless`` does not, so energy
    created by contacts uses more slack: at most 7.2 % instead of 7.0 % when tapping on a wall, and
    equal shares with jamming pegs (``scripts/bench_methods --same device``). Near contact
    ``lossless`` adds K T to B', but reports K T/2. When tapping at 6 Hz it is 54 µm RMS off its
    reported effective coupling. ``implicit`` is 26 µm off its own report, B + K T/2, and 116 µm off
    B (``scripts/bench_front``).
    """
    return LOSSLESS_COUPLING if substeps == 1 else IMPLICIT


def method_named(name: str) -> Method:
    """Returns a method by its name.

    Raises:
        SceneError: The name is unknown; the message lists the methods.
    """
    if name not in METHODS:
        raise SceneError(f"no method is called '{name}'; methods: {choices(METHODS)}")
    return METHODS[name]
