"""Handle and coupling, added to a scene's specification.

The coupling consists of six MuJoCo site actuators from the handle's site to the grip,

    force = −K l − B l̇ + B u

l is the grip's pose in the handle's frame; the control u is the handle's velocity in that frame.
Under ``integrator="discrete"`` the coupling is implicit in position and velocity and is solved
together with the contacts.
"""

from __future__ import annotations

import mujoco
import numpy as np

from hapticbridge.errors import SceneError, choices
from hapticbridge.kernel.names import COUPLING_ACTUATORS, HANDLE, WELD_NAME

_PREFIX = "hapticbridge_"
"""Prefix that separates the handle's default class from the scene's classes."""


def attach_handle(spec: mujoco.MjSpec, grip: str) -> None:
    """Adds the mocap body ``handle`` with its site, and the six coupling actuators.

    Args:
        spec: The user's scene; changed in place.
        grip: Name of the site on the tool.

    Raises:
        SceneError: The site does not exist, or the scene uses a name that the bridge adds.
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
    # a weld is added later and identified by its name only
    _refuse_taken("equality constraint", WELD_NAME, [each.name for each in spec.equalities])

    # in a specification of its own: a <default> of the scene could rotate the handle's site, and
    # boundmass could give it mass
    handle_spec = mujoco.MjSpec()
    handle = handle_spec.worldbody.add_body(name=HANDLE, mocap=True)
    handle.add_site(name=HANDLE)
    body = spec.worldbody.add_frame().attach_body(handle, _PREFIX, "")
    body.name = body.sites[0].name = HANDLE
    for axis, name in enumerate(COUPLING_ACTUATORS):
        _add_coupling_actuator(spec, name, axis, grip)


def _refuse_taken(kind: str, name: str, taken: list[str]) -> None:
    if name in taken:
        raise SceneError(
            f"the scene already has {kind} '{name}', a name that the bridge adds; rename it"
        )


def _add_coupling_actuator(spec: mujoco.MjSpec, name: str, axis: int, grip: str) -> None:
    """Adds an actuator with every field set, so that no <default> of the scene applies."""
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
    """Sets the options for an implicit coupling and a known energy of every step."""
    option = spec.option
    option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY | mujoco.mjtEnableBit.mjENBL_DIAGEXACT
    # a reset during a run would move the tool unnoticed; the guard trips on non-finite values
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
