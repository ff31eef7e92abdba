"""Adds the handle and its coupling to a scene's specification.

The coupling is expressed in MuJoCo: six site actuators from the handle's site to the grip,
force = −K l − B l̇ + B u, where l is the grip's pose in the handle's frame and u, the control, the
handle's velocity in that frame. Under ``integrator="discrete"`` it is implicit in position and
velocity and solved together with the contacts.
"""

from __future__ import annotations

import mujoco
import numpy as np

from hapticbridge.errors import SceneError, choices
from hapticbridge.kernel.names import COUPLING_ACTUATORS, HANDLE, WELD_NAME

_PREFIX = "hapticbridge_"
"""Keeps the default class that comes along with the handle apart from the scene's classes."""


def attach_handle(spec: mujoco.MjSpec, grip: str) -> None:
    """Adds the mocap body ``handle`` with its site, and the six coupling actuators.

    Args:
        spec: The user's scene; changed in place.
        grip: Name of the site on the tool.

    Raises:
        SceneError: There is no such site, or a name that the bridge needs is taken.
    """
    sites = [site.name for site in spec.sites if site.name]
    if grip not in sites:
        remedy = (
            "name one of them (--grip, or grip= in Python)"
            if sites
            else f'put <site name="{grip or "grip"}"/> into the tool\'s body'
        )
        raise SceneError(
            f"the scene has no site '{grip}' to grip the tool by; sites: {choices(sites)}; {remedy}"
        )
    _refuse_taken("body", HANDLE, [body.name for body in spec.bodies])
    _refuse_taken("site", HANDLE, sites)
    for name in COUPLING_ACTUATORS:
        _refuse_taken("actuator", name, [actuator.name for actuator in spec.actuators])
    # a weld comes later, if at all, and is then known by its name alone
    _refuse_taken("equality constraint", WELD_NAME, [each.name for each in spec.equalities])

    # made apart: a <default> of the scene would turn its site, boundmass would give it weight
    apart = mujoco.MjSpec()
    made = apart.worldbody.add_body(name=HANDLE, mocap=True)
    made.add_site(name=HANDLE)
    body = spec.worldbody.add_frame().attach_body(made, _PREFIX, "")
    body.name = body.sites[0].name = HANDLE
    for axis, name in enumerate(COUPLING_ACTUATORS):
        _add_coupling_actuator(spec, name, axis, grip)


def _refuse_taken(kind: str, name: str, taken: list[str]) -> None:
    if name in taken:
        raise SceneError(
            f"the scene already has {kind} '{name}', a name that the bridge adds; rename yours"
        )


def _add_coupling_actuator(spec: mujoco.MjSpec, name: str, axis: int, grip: str) -> None:
    """Sets every field: a user's ``<default><general …>`` would reach what is left unset."""
    actuator = spec.add_actuator(name=name)
    gear = np.zeros(6)
    gear[axis] = 1.0
    actuator.trntype = mujoco.mjtTrn.mjTRN_SITE
    actuator.target, actuator.refsite, actuator.slidersite = grip, HANDLE, ""
    actuator.gear = gear
    actuator.gaintype, actuator.gainprm = mujoco.mjtGain.mjGAIN_FIXED, np.zeros(10)
    actuator.biastype, actuator.biasprm = mujoco.mjtBias.mjBIAS_AFFINE, np.zeros(10)
    actuator.dyntype, actuator.dynprm = mujoco.mjtDyn.mjDYN_NONE, np.eye(10)[0]
    actuator.actdim, actuator.actearly = -1, False
    for field in ("actlimited", "ctrllimited", "forcelimited"):
        setattr(actuator, field, mujoco.mjtLimited.mjLIMITED_FALSE)
    for field in ("actrange", "ctrlrange", "forcerange", "lengthrange", "velrange", "ffrange"):
        setattr(actuator, field, np.zeros(2))
    for field in ("cranklength", "inheritrange", "delay", "armature"):
        setattr(actuator, field, 0.0)
    for field in ("nsample", "interp", "group", "ctrlspec"):
        setattr(actuator, field, 0)
    actuator.damping = np.zeros(3)


def set_options(spec: mujoco.MjSpec) -> None:
    """Sets the options under which the coupling is implicit and every step's energy is known."""
    option = spec.option
    option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY | mujoco.mjtEnableBit.mjENBL_DIAGEXACT
    # a reset in mid-run would jump the tool without a word; the guard trips on what is not finite
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
