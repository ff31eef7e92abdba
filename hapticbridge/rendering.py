"""The methods that render a rigid tool, behind one interface.

A method decides how the coupling's wrench reaches the tool: which integrator MuJoCo uses, which
gains its actuators get, whether a weld replaces them, or whether there is a coupling at all. The
tick's arithmetic is the kernel's in every method, and so are ledger, records and audit.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import mujoco

from hapticbridge.arguments import Arguments
from hapticbridge.coupling import Coupling
from hapticbridge.errors import DeviceError, SceneError, choices
from hapticbridge.kernel.nearness import REACH
from hapticbridge.kernel.parameters import RunParameters, checked_substeps
from hapticbridge.kernel.scheme import COUPLED, DIRECT, HELD, LOSSLESS, WELD
from hapticbridge.kernel.state import WELD_NAME
from hapticbridge.passivity.compensation import (
    IMPLICIT_LAG,
    MIDPOINT_LAG,
    felt_damping,
    law_damping,
)
from hapticbridge.scene import Scene
from hapticbridge.scene.contact_check import warn_of_contacts
from hapticbridge.scene.methods import check_massless_tool, check_metered
from hapticbridge.scene.weld import check_weldable, measured_weld

Gains = tuple[float, float, float]
"""Of a coupling actuator: factor of its control, stiffness in N/m, damping in N s/m (rotation: N m,
N m/rad and N m s/rad per unit of control)."""


@dataclass(frozen=True, slots=True)
class Method:
    """A way to render.

    Attributes:
        name: What ``--method`` and the recording's metadata call it.
        about: What it is, in one sentence.
        hazard: What it may do on a real device, in one sentence; empty where nothing more than the
            device condition is to be said.
        scheme: How the wrench reaches the tool, as the kernel counts (``kernel.scheme.COUPLED`` …).
        integrator: MuJoCo's, by the name that MJCF gives it.
        discretization: How the coupling's damper is discretised, as the bounds call it; ``none``
            where no coupling law gives the wrench.
        compensated: Whether the actuators get the extra K h of damping, h the time step, that makes
            the implicit integration of velocity alone one of position too.
        lag: Share of K h that is taken off the damping asked for, because the integration adds it;
            no unit.
        adds: Share of K h that the integration adds to the damping, whether it is taken off or
            not; None where it adds another amount, or takes some away.
    """

    name: str
    about: str
    hazard: str
    scheme: int
    integrator: str
    discretization: str = "backward"
    compensated: bool = False
    lag: float = 0.0
    adds: float | None = None

    @property
    def step(self) -> Callable[[Any, Any], None]:
        """MuJoCo's part of a substep, through the Python bindings, on model and data.

        ``kernel.step.advance`` is the same by C symbol, to the bit.
        """
        step: Callable[[Any, Any], None] = (
            mujoco.mj_step if self.has_coupling else mujoco.mj_fwdPosition
        )
        return step

    def laws(self, substeps: int) -> int:
        """Returns how often per tick the wrench on the tool is computed."""
        return 1 if self.scheme == HELD else substeps

    @property
    def has_law(self) -> bool:
        """Whether the coupling law gives the wrench, so that the device condition proves safety."""
        return self.scheme in (COUPLED, HELD, LOSSLESS)

    @property
    def meters_inputs(self) -> bool:
        """Whether the work of applied forces and moved mocap bodies is known."""
        return self.integrator != "RK4" and self.scheme != DIRECT

    @property
    def has_coupling(self) -> bool:
        """Whether anything elastic lies between handle and tool."""
        return self.scheme != DIRECT

    def gains(self, coupling: Coupling, timestep: float) -> tuple[Gains, Gains]:
        """Returns the gains of the coupling's actuators, for forces and for torques."""
        if self.scheme == HELD:
            return (1.0, 0.0, 0.0), (1.0, 0.0, 0.0)
        if self.scheme not in (COUPLED, LOSSLESS):
            return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        more = timestep if self.compensated else 0.0
        k, b = coupling.stiffness, coupling.damping
        kr, br = coupling.rotational_stiffness, coupling.rotational_damping
        return (b, k, b + k * more), (br, kr, br + kr * more)

    def used(self, coupling: Coupling, timestep: float) -> Coupling:
        """Returns the coupling whose law and gains make a tool feel like the one asked for.

        B' = max(B − lag K h, 0), and B_r alike: the integration adds lag K h again. The device
        needs b >= K T/2 + B', so what is taken off is also gained in stiffness.

        Args:
            coupling: What should be felt.
            timestep: h in s, MuJoCo's.

        Raises:
            CouplingError: The time step is not finite and > 0.

        References:
            ``passivity.compensation``.
        """
        return self._with_damping(coupling, timestep, law_damping)

    def rendered(self, used: Coupling, timestep: float) -> Coupling:
        """Returns what must be asked for where ``used`` is the law: B = B' + lag K h.

        It is what is felt, but for methods that take nothing off what they add (``adds``).
        """
        return self._with_damping(used, timestep, felt_damping)

    def _with_damping(
        self, coupling: Coupling, timestep: float, damping: Callable[..., float]
    ) -> Coupling:
        if self.lag == 0.0:
            return coupling
        k, b = coupling.stiffness, coupling.damping
        kr, br = coupling.rotational_stiffness, coupling.rotational_damping
        return replace(
            coupling,
            damping=damping(k, b, timestep, self.lag),
            rotational_damping=damping(kr, br, timestep, self.lag),
        )


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

_INTEGRATORS = {
    "Euler": mujoco.mjtIntegrator.mjINT_EULER,
    "RK4": mujoco.mjtIntegrator.mjINT_RK4,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    "discrete": mujoco.mjtIntegrator.mjINT_DISCRETE,
}


_ARGUMENTS = Arguments(SceneError)

MEASURED_AGAIN = 1e-6
"""Relative difference at which a weld measured again is another one; no unit. Probing by 1e-6 m
leaves 1e-10 of rounding, another processor hardly more."""


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


def refuse_unknowing(method: Method, *, is_real: bool, i_know: bool) -> None:
    """Refuses a method that may kick on a device with a motor, unless the user knows.

    Raises:
        DeviceError: Says what the method may do, and how to go on.
    """
    if is_real and method.hazard and not i_know:
        raise DeviceError(
            f"method '{method.name}' on a real device: {method.hazard}; use 'implicit', or say "
            "--i-know (Bridge(i_know=True))"
        )


def contact_stiffness_of(
    method: Method, coupling: Coupling, contact_stiffness: float | None
) -> float:
    """Returns K_c in N/m for ``RunParameters``: as asked, or the coupling's K; 0 for others.

    Raises:
        SceneError: It is not finite, not > 0 or beyond 1e-30 to 1e30, or the method has no contact
            springs of its own.
    """
    if method.has_coupling:
        if contact_stiffness is not None:
            raise SceneError(
                f"contact stiffness is {contact_stiffness!r} N/m, but method '{method.name}' "
                "leaves contacts to MuJoCo; only 'direct' takes it"
            )
        return 0.0
    stiffness = coupling.stiffness if contact_stiffness is None else contact_stiffness
    return _ARGUMENTS.number("contact stiffness", stiffness, "N/m", least=0.0, is_open=True)


def check_scene(model: mujoco.MjModel, grip: str, method: Method) -> None:
    """Refuses a scene that a method cannot render, or whose ports could not be metered under it.

    Args:
        model: The compiled scene.
        grip: Name of the site on the tool.
        method: How it will be rendered.

    Raises:
        SceneError: Says what in the scene is the obstacle.
    """
    if method.scheme == DIRECT:
        check_massless_tool(model, grip, method.name)
    if method.scheme == WELD:
        check_weldable(model, grip)
    check_metered(model, method.integrator, method.name)


def prepare(
    scene: Scene,
    coupling: Coupling,
    period: float,
    substeps: int,
    method: Method = IMPLICIT,
    warns: bool = True,
) -> Coupling | None:
    """Makes a scene render a coupling by a method: integrator, gains, timestep, and a reset.

    Args:
        scene: Changed in place; for a weld its model and data become new ones, with everything that
            was changed in the old model carried over.
        coupling: What the user should feel.
        period: T in s.
        substeps: MuJoCo steps per tick.
        method: How.
        warns: Whether to warn of contacts that may create energy at this time step.

    Returns:
        The coupling that the tool is really held by, where it is not the one asked for (a weld);
        for ``RunParameters.felt``.

    Raises:
        SceneError: Period, substeps or a magnitude of the coupling are out of range (1e-30 to
            1e30), or the scene does not suit the method.
    """
    checked_substeps(substeps, SceneError)
    for item in fields(Coupling):
        _ARGUMENTS.number(f"coupling {item.name.replace('_', ' ')}", getattr(coupling, item.name))
    check_scene(scene.model, scene.grip, method)
    scene.set_weld(coupling if method.scheme == WELD else None)
    scene.set_timestep(period, substeps)
    scene.model.opt.integrator = _INTEGRATORS[method.integrator]
    scene.set_reach(REACH if method.scheme == LOSSLESS else 0.0)
    if warns and method.scheme in (COUPLED, LOSSLESS):
        warn_of_contacts(scene.model, scene.grip, scene.path)
    step = period / substeps
    scene.set_gains(*method.gains(method.used(coupling, step), step))
    felt = measured_weld(scene.model, scene.grip) if method.scheme == WELD else None
    scene.reset()
    return felt


def check_prepared(model: mujoco.MjModel, parameters: RunParameters, method: Method) -> None:
    """Refuses a model that ``prepare`` would not have left for these parameters.

    Raises:
        SceneError: Names the first difference.
    """
    check_scene(model, parameters.grip, method)
    if model.opt.integrator != _INTEGRATORS[method.integrator]:
        raise SceneError(f"the integrator is not {method.integrator}, that of '{method.name}'")
    has_weld = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_EQUALITY, WELD_NAME) >= 0
    if has_weld != (method.scheme == WELD):
        raise SceneError(f"a weld to the handle is not as '{method.name}' wants it")
    if has_weld:
        gains = -model.eq_solref[model.equality(WELD_NAME).id]
        coupling = parameters.coupling
        if gains.tolist() != [coupling.stiffness, coupling.damping]:
            raise SceneError(
                f"the weld has K = {gains[0]!r}, B = {gains[1]!r}, the metadata say "
                f"{coupling.stiffness!r}, {coupling.damping!r}"
            )
        felt, measured = parameters.felt or coupling, measured_weld(model, parameters.grip)
        for item in fields(Coupling):
            claimed, true = getattr(felt, item.name), getattr(measured, item.name)
            if not math.isclose(claimed, true, rel_tol=MEASURED_AGAIN):
                raise SceneError(
                    f"{item.name.replace('_', ' ')} of the weld is {true:.6g} in SI units, the "
                    f"metadata say {claimed:.6g}"
                )
