"""Preparation of a scene for a method."""

from __future__ import annotations

import math
from dataclasses import fields

import mujoco

from hapticbridge.arguments import Arguments
from hapticbridge.coupling import Coupling
from hapticbridge.errors import SceneError
from hapticbridge.kernel.names import WELD_NAME
from hapticbridge.kernel.nearness import REACH
from hapticbridge.kernel.parameters import RunParameters, checked_substeps
from hapticbridge.kernel.scheme import COUPLED, DIRECT, LOSSLESS, WELD
from hapticbridge.rendering.method import Method
from hapticbridge.rendering.methods import IMPLICIT
from hapticbridge.scene import Scene
from hapticbridge.scene.contact_check import warn_of_contacts
from hapticbridge.scene.methods import check_massless_tool, check_metered
from hapticbridge.scene.weld import check_weldable, measured_weld

_INTEGRATORS = {
    "Euler": mujoco.mjtIntegrator.mjINT_EULER,
    "RK4": mujoco.mjtIntegrator.mjINT_RK4,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    "discrete": mujoco.mjtIntegrator.mjINT_DISCRETE,
}

_ARGUMENTS = Arguments(SceneError)

MEASURED_AGAIN = 1e-6
"""Relative difference, without unit, above which a second measurement of a weld disagrees. Probing
by 1e-6 m leaves rounding of 1e-10, on another processor hardly more."""


def contact_stiffness_of(
    method: Method, coupling: Coupling, contact_stiffness: float | None
) -> float:
    """Returns K_c in N/m: the requested one, or the coupling's K; 0 for methods with a coupling.

    Raises:
        SceneError: It is not finite, not > 0 or outside 1e-30 to 1e30, or the method has no contact
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
    """Refuses a scene that a method cannot render or meter.

    Raises:
        SceneError: The message names the obstacle in the scene.
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
    """Sets a scene's integrator, gains and time step for a method, and resets it.

    Args:
        scene: Changed in place. For a weld its model and data are replaced; changes to the old
            model are carried over.
        coupling: The requested coupling.
        period: T in s.
        substeps: MuJoCo steps per tick.
        method: The rendering method.
        warns: True to warn of contacts that may create energy at this time step.

    Returns:
        The measured effective coupling of a weld, for ``RunParameters.felt``; None for other
        methods.

    Raises:
        SceneError: Period, substeps or a gain is out of range (1e-30 to 1e30), or the scene does
            not suit the method.
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
    """Refuses a model that differs from the result of ``prepare`` for these parameters.

    Raises:
        SceneError: The message names the first difference.
    """
    check_scene(model, parameters.grip, method)
    if model.opt.integrator != _INTEGRATORS[method.integrator]:
        raise SceneError(f"method '{method.name}' requires the integrator {method.integrator}")
    has_weld = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_EQUALITY, WELD_NAME) >= 0
    if has_weld != (method.scheme == WELD):
        raise SceneError(
            f"method '{method.name}' requires {'a' if method.scheme == WELD else 'no'} "
            "weld to the handle"
        )
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
