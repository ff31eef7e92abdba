"""Handle and coupling, added to a scene's specification.

The coupling consists of six MuJoCo site actuators from the handle's site to the grip,

    force = −K l − B l̇ + B u

l is the grip's pose in the handle's frame; the control u is the handle's velocity in that frame.
Under ``integrator="discrete"`` the coupling is implicit in position and velocity and is solved
together with the contacts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.errors import SceneError
from hapticbridge.kernel.codes import (
    COUPLING_ACTUATORS,
    HANDLE,
    PREFIX,
    WELD_NAME,
    Grip,
    added_actuators,
    held_body,
    held_joint,
    name_of_hand,
)
from hapticbridge.kernel.mujoco_c import quiet
from hapticbridge.scene.checks import (
    NOTABLE_OVERLAP,
    Overlap,
    ancestors,
    is_nested,
    listed,
    overlaps,
)
from hapticbridge.scene.compile import go_to_start, reset
from hapticbridge.scene.treatment import SceneChange

# Weld between grip and handle (MuJoCo's equality constraint)

IMPEDANCE = 0.95
"""Impedance d of the weld, without unit, equal at every displacement (MuJoCo's default reaches 0.95
at 1 mm). The true stiffness is mass times K/(1 − d), so a value nearer to 1 makes the weld
stiffer."""

PROBE = 1e-6
"""Displacement in m, angle in rad and velocity in m/s and rad/s with which the weld is measured.
The constraint is linear in them as long as sin φ ≈ φ."""

_FLAGS = {
    "constraint": mujoco.mjtDisableBit.mjDSBL_CONSTRAINT,
    "equality": mujoco.mjtDisableBit.mjDSBL_EQUALITY,
}

_NOT_CARRIED = ("name", "text", "tuple", "paths", "actuator_history", "sensor_history")


def add_weld(spec: mujoco.MjSpec, grip: str) -> None:
    """Adds the equality constraint between the sites of grip and handle."""
    equality = spec.add_equality(name=WELD_NAME)
    equality.type = mujoco.mjtEq.mjEQ_WELD
    equality.objtype = mujoco.mjtObj.mjOBJ_SITE
    equality.name1, equality.name2 = grip, HANDLE
    equality.active = True
    data = np.zeros(len(equality.data))
    data[6] = data[10] = 1.0  # no rotation between the sites, torque scale 1
    equality.data = data


def set_weld_gains(model: mujoco.MjModel, coupling: Coupling) -> None:
    """Sets K and B of the weld as its direct ``solref``, one pair for all six axes."""
    weld_id = model.equality(WELD_NAME).id
    model.eq_solref[weld_id] = -coupling.stiffness, -coupling.damping
    model.eq_solimp[weld_id] = IMPEDANCE, IMPEDANCE, 1e-3, 0.5, 2.0


def check_weldable(model: mujoco.MjModel, grip: str) -> None:
    """Refuses disabled equality constraints and a tool that cannot move about all axes.

    If the joints block the axis of a row of the weld, the row has no inertia to yield. MuJoCo makes
    it rigid (1e18 N/m), and the hand would feel a force that moves nothing.

    Raises:
        SceneError: Names the disabled flag, or the number of directions that the joints leave free.
    """
    for flag, bit in _FLAGS.items():
        if model.opt.disableflags & bit:
            raise SceneError(
                f"the scene disables flag {flag}, and a weld is an equality constraint; enable it, "
                "or choose another method"
            )
    data = mujoco.MjData(model)
    go_to_start(model, data, grip)
    jacobian = np.zeros((6, model.nv))
    mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], model.site(grip).id)
    free = np.linalg.matrix_rank(jacobian)
    if free < 6:
        raise SceneError(
            "a weld needs a tool that can move along and about all three axes; the joints of grip "
            f"'{grip}' leave it {free} of 6, and the weld would be rigid along the others"
        )


def carry_over(old: mujoco.MjModel, new: mujoco.MjModel) -> None:
    """Copies all values between models that differ only by equality constraints.

    A compilation would lose changes made after loading (masses, contact parameters, gains of the
    scene's own equality constraints). The weld is the last equality row, so the rows before it
    correspond.
    """
    for name in dir(old):
        if name.startswith(("_", *_NOT_CARRIED)):
            continue
        value = getattr(old, name)
        if not isinstance(value, np.ndarray):
            continue
        target = getattr(new, name)
        if name.startswith("eq_"):
            count = min(old.neq, new.neq)
            target[:count] = value[:count]
        elif value.shape == target.shape:
            target[...] = value
    for part in ("opt", "stat"):
        copy_values(getattr(old, part), getattr(new, part))


def set_step(spec: mujoco.MjSpec, step: float) -> None:
    """Sets a time step in s, and the samples of each delay so that they span the same time.

    MuJoCo stores n samples after each step, or each interval of a sensor that has a longer one, and
    returns the oldest where a delay is longer. They span n − 1 intervals and one step.
    """
    own = spec.option.timestep
    for element in (*spec.actuators, *spec.sensors):
        interval = float(element.interval[0]) if isinstance(element, mujoco.MjsSensor) else 0.0
        if element.nsample > 0:
            spanned = (element.nsample - 1) * max(interval, own) + own
            more = (spanned - step) / max(interval, step)
            element.nsample = 1 + max(math.ceil(more - 1e-9), 0)
    spec.option.timestep = step


def copy_values(old: object, new: object) -> None:
    """Copies all values of a part of a model, such as its options, to that of another model."""
    for name in dir(old):
        if name.startswith("_"):
            continue
        value = getattr(old, name)
        if isinstance(value, np.ndarray):
            getattr(new, name)[...] = value
        elif not callable(value):
            setattr(new, name, value)


def measured_weld(model: mujoco.MjModel, grip: str) -> Coupling:
    """Returns the true stiffness and damping of a weld at the scene's start, from MuJoCo.

    With a fixed tool the constraint's force is λ = D a_ref, where D = d/((1 − d) A). A is the
    inverse inertia of the row, and a_ref = −b v − k r with the direct solref k = K/d, b = B/d. This
    gives the static stiffness m K/(1 − d) and damping m B/(1 − d) with m = 1/A. m is the mass for
    translation through the centre of mass and the inertia for rotation; it is less for a grip off
    centre. If axes differ, the largest value is returned, because the device must bear it.

    Args:
        model: A scene that passes ``check_weldable``, with the weld and its gains set.
        grip: Name of the site on the tool.

    References:
        MuJoCo documentation, "Computation", section "Constraint model".
    """
    data = mujoco.MjData(model)
    stiffness, damping = np.zeros(6), np.zeros(6)
    handle = model.body_mocapid[model.body(HANDLE).id]
    for axis in range(6):
        go_to_start(model, data, grip)
        jacobian = np.zeros((6, model.nv))
        site_id = model.site(grip).id
        mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], site_id)
        unit = np.eye(6)[axis]
        data.qvel[:] = PROBE * np.linalg.pinv(jacobian) @ unit
        damping[axis] = _static_force(model, data, axis) / PROBE
        data.qvel[:] = 0.0
        data.mocap_pos[handle] -= PROBE * unit[:3]
        turned = np.zeros(4)
        mujoco.mju_axisAngle2Quat(turned, unit[3:], -PROBE if axis >= 3 else 0.0)
        orientation = data.mocap_quat[handle].copy()
        mujoco.mju_mulQuat(data.mocap_quat[handle], turned, orientation)
        stiffness[axis] = _static_force(model, data, axis) / PROBE
    return Coupling(
        stiffness=float(stiffness[:3].max()),
        damping=max(float(damping[:3].max()), 0.0),
        rotational_stiffness=max(float(stiffness[3:].max()), 0.0),
        rotational_damping=max(float(damping[3:].max()), 0.0),
    )


def _static_force(model: mujoco.MjModel, data: mujoco.MjData, axis: int) -> float:
    """Returns the weld's force for a displacement or velocity along an axis, with a fixed tool."""
    mujoco.mj_forward(model, data)
    weld_id = model.equality(WELD_NAME).id
    is_weld = (data.efc_type[: data.ne] == mujoco.mjtConstraint.mjCNSTR_EQUALITY) & (
        data.efc_id[: data.ne] == weld_id
    )
    rows: NDArray[np.intp] = np.flatnonzero(is_weld)
    force = -(data.efc_D[rows] * data.efc_aref[rows])[axis]
    # a rotational row uses half the angle, for force and displacement
    return float(0.5 * force if axis >= 3 else force)


def attach_handles(spec: mujoco.MjSpec, grips: Sequence[str]) -> None:
    """Adds a mocap body, the handle, with its site, and six coupling actuators for every hand.

    A hand that holds a joint has no handle in the scene, and one actuator.

    Args:
        spec: The user's scene; changed in place.
        grips: Site or joint that each hand holds; two hands may hold one tool.

    Raises:
        SceneError: The scene has a name that starts with ``PREFIX``, or the first hand holds a
            joint.
    """
    elements = (*spec.bodies, *spec.sites, *spec.actuators, *spec.equalities)
    if taken := [each.name for each in elements if each.name.startswith(PREFIX)]:
        raise SceneError(
            f"the scene has the name '{taken[0]}', and names that start with '{PREFIX}' are those "
            "that the bridge adds; rename it"
        )
    for hand, grip in enumerate(grips):
        held = Grip.from_text(grip)
        if held.is_joint:
            if hand == 0:
                raise SceneError(
                    f"'{grip}' can only be held beside a site or a body; name that grip first"
                )
            actuator = _bare_actuator(spec, name_of_hand(COUPLING_ACTUATORS[0], hand), 0)
            actuator.trntype, actuator.target = mujoco.mjtTrn.mjTRN_JOINT, held.name
            actuator.refsite = actuator.slidersite = ""
            continue
        _attach_handle(spec, name_of_hand(HANDLE, hand))
        for axis, name in enumerate(COUPLING_ACTUATORS):
            actuator = _bare_actuator(spec, name_of_hand(name, hand), axis)
            actuator.trntype, actuator.slidersite = mujoco.mjtTrn.mjTRN_SITE, ""
            actuator.target, actuator.refsite = grip, name_of_hand(HANDLE, hand)


def _attach_handle(spec: mujoco.MjSpec, name: str) -> None:
    # in a specification of its own: a <default> of the scene could rotate the handle's site, and
    # boundmass could give it mass
    handle_spec = mujoco.MjSpec()
    handle = handle_spec.worldbody.add_body(name=name, mocap=True)
    handle.add_site(name=name)
    body = spec.worldbody.add_frame().attach_body(handle, PREFIX, "")
    body.name = body.sites[0].name = name


GROUPS = 31
"""Actuator groups that a scene can disable, from 0; those of higher groups always act."""


def _bare_actuator(spec: mujoco.MjSpec, name: str, axis: int) -> mujoco.MjsActuator:
    """Adds an actuator with every field set, so that no <default> of the scene applies.

    Its transmission is left to the caller.
    """
    actuator = spec.add_actuator(name=name)
    actuator.gear = np.eye(6)[axis]
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
    for field in ("nsample", "interp", "ctrlspec"):
        setattr(actuator, field, 0)
    disabled = int(spec.option.disableactuator)
    actuator.group = next(g for g in range(GROUPS + 1) if not disabled >> g & 1)
    actuator.damping = np.zeros(3)
    return actuator


_INTEGRATORS = "Euler", "RK4", "implicit", "implicitfast", "discrete"
_SOLVERS = "PGS", "CG", "Newton"


def set_options(spec: mujoco.MjSpec, *, as_is: bool = False) -> tuple[SceneChange, ...]:
    """Sets the options for an implicit coupling and a known energy of every step.

    Solver PGS and ``noslip_iterations`` leave the coupling out of the implicit step, and the
    coupling does not move a tool that sleeps.

    Args:
        spec: The user's scene; changed in place.
        as_is: If true, a scene with one of these three is refused.

    Returns:
        The options of the scene that were changed, each as ``name: old → new``.

    Raises:
        SceneError: A change is needed that ``as_is`` forbids.
    """
    option, enable = spec.option, mujoco.mjtEnableBit
    needed, changes = list[SceneChange](), list[SceneChange]()
    if (solver := int(option.solver)) != mujoco.mjtSolver.mjSOL_NEWTON:
        changes.append(SceneChange(f"solver: {_SOLVERS[solver]} → Newton", "solver"))
        needed += changes if solver == mujoco.mjtSolver.mjSOL_PGS else []
    if option.noslip_iterations > 0:
        needed.append(SceneChange(f"noslip_iterations: {option.noslip_iterations} → 0", "noslip"))
    if option.enableflags & enable.mjENBL_SLEEP:
        needed.append(SceneChange("flag sleep: enable → disable", "sleep"))
    needed += _constrain_flexes(spec, as_is=as_is)
    if needed and as_is:
        raise SceneError(
            f"the scene needs other options to be coupled ({', '.join(map(str, needed))}); "
            "set them, or let them be changed (without --as-is)"
        )
    if (integrator := int(option.integrator)) != mujoco.mjtIntegrator.mjINT_DISCRETE:
        words = f"integrator: {_INTEGRATORS[integrator]} → the method's"
        changes.append(SceneChange(words, "integrator"))
    if option.disableflags & mujoco.mjtDisableBit.mjDSBL_ACTUATION:
        # the coupling is made of actuators: the scene's own are disabled by their groups instead
        option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
        option.disableactuator = (1 << GROUPS) - 1
        for each in spec.actuators:
            each.group = min(each.group, GROUPS - 1)
    if spec.compiler.LRopt.mode == mujoco.mjtLRMode.mjLRMODE_ALL:
        # the coupling has no range of lengths, and only muscles and plugins compute with theirs
        spec.compiler.LRopt.mode = mujoco.mjtLRMode.mjLRMODE_MUSCLEUSER
    option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.noslip_iterations = 0
    option.enableflags &= ~int(enable.mjENBL_SLEEP)
    option.enableflags |= enable.mjENBL_ENERGY
    # a reset during a run would move the tool unnoticed; the guard trips on non-finite values
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    return tuple(dict.fromkeys((*changes, *needed)))


def _constrain_flexes(spec: mujoco.MjSpec, *, as_is: bool) -> list[SceneChange]:
    """Replaces passive forces of a flex by constraints: of its edges, and of its contacts.

    The integrator ``discrete`` lacks springs and dampers on edges, and no account has the energy of
    passive contacts.

    Returns:
        The changes, as ``name: old → new``, which are not made if ``as_is`` forbids them.
    """
    constrained = {each.name1 for each in spec.equalities if each.type == mujoco.mjtEq.mjEQ_FLEX}
    changes = []
    for flex in spec.flexes:
        if flex.passive:
            words = f"contacts of flex '{flex.name}': passive → constraints"
            changes.append(SceneChange(words, "passive contacts"))
        if flex.edgestiffness > 0 or flex.edgedamping > 0:
            words = f"damping {flex.edgedamping:g} → 0"
            if flex.edgestiffness > 0:
                words = "springs → constraints of constant length"
            changes.append(SceneChange(f"edges of flex '{flex.name}': {words}", "edges"))
        if as_is:
            continue
        if flex.edgestiffness > 0 and flex.name not in constrained:
            equality = spec.add_equality(name1=flex.name)
            equality.type, equality.active = mujoco.mjtEq.mjEQ_FLEX, True
        flex.edgestiffness = flex.edgedamping = flex.passive = 0
    return changes


SAME_ARM = 1e-9
"""Difference of two moment arms, in m or without unit, up to which they are one. Rounding leaves
less; a larger value would call the arm of a small crank constant."""


def limit_motors_alone(
    model: mujoco.MjModel, data: mujoco.MjData, grip: str, *, as_is: bool = False
) -> tuple[SceneChange, ...]:
    """Moves force limits from the joints that carry the grip to the actuators of these joints.

    MuJoCo's ``actuatorfrcrange`` limits the sum of all actuator forces on a joint, and the coupling
    is made of actuators. An actuator that alone drives a joint with moment arm g pushes within
    [a, b] on it if its own force is within [a, b]/g. Several actuators of one joint are limited
    each by itself; gravity compensation is not limited. Where g changes with the pose, as for a
    site or a spatial tendon, the limit is that of the start.

    Args:
        model: The compiled scene; changed in place.
        data: Its state at the start, after ``mj_forward``.
        grip: Name of the site on the tool.
        as_is: If true, a scene with such a joint is refused.

    Returns:
        The change, as ``name: old → new``; nothing if no such joint has a limit.

    Raises:
        SceneError: A change is needed that ``as_is`` forbids.
    """
    chain = np.isin(model.jnt_bodyid, ancestors(model, held_body(model, grip)))
    joints = np.flatnonzero(chain & (model.jnt_actfrclimited != 0)).tolist()
    if not joints:
        return ()
    name = model.joint(joints[0]).name or str(joints[0])
    more = f" and {len(joints) - 1} more" if len(joints) > 1 else ""
    if as_is:
        raise SceneError(
            f"joint '{name}'{more} limits actuator forces (actuatorfrcrange), which would cap the "
            "coupling; limit the actuator's own forcerange, or let it be done (without --as-is)"
        )
    moved = mujoco.MjData(model)
    mujoco.mj_copyData(moved, model, data)
    mujoco.mj_integratePos(model, moved.qpos, np.linspace(0.1, 0.2, model.nv), 1.0)
    mujoco.mj_fwdKinematics(model, moved)
    mujoco.mj_transmission(model, moved)
    moments, others, own = (
        _moments(model, data),
        _moments(model, moved),
        np.ones(model.nactuator, bool),
    )
    own[list(added_actuators(model))] = False
    most, is_fixed = 0, True
    for joint in joints:
        model.jnt_actfrclimited[joint] = 0
        column = model.actuator_outadr, model.jnt_dofadr[joint]
        arms, later = moments[column] * own, others[column] * own
        is_fixed &= np.allclose(arms, later, atol=SAME_ARM)
        drivers = np.flatnonzero(arms).tolist()
        most = max(most, len(drivers))
        for actuator in drivers:
            low, high = sorted(model.jnt_actfrcrange[joint] / arms[actuator])
            if model.actuator_forcelimited[actuator]:
                low = max(low, model.actuator_forcerange[actuator, 0])
                high = min(high, model.actuator_forcerange[actuator, 1])
            model.actuator_forcelimited[actuator] = 1
            model.actuator_forcerange[actuator] = low, high
    places = ("none, as the scene has no actuator there", "on its actuator")
    place = places[most] if most < len(places) else "on each of its actuators"
    if not is_fixed:
        place = "on each of its actuators, for the moment arms of the start alone"
    words = f"force limit of joint '{name}'{more}: on all actuators together → {place}"
    return (SceneChange(words, "joint's force limit"),)


def _moments(model: mujoco.MjModel, data: mujoco.MjData) -> NDArray[np.float64]:
    """Returns the moment arms of all outputs of actuators, (nout, nv)."""
    moments = np.zeros((model.nout, model.nv))
    mujoco.mju_sparse2dense(
        moments,
        data.actuator_moment,
        data.moment_rownnz,
        data.moment_rowadr,
        data.moment_colind,
    )
    return moments


def announce_gravity_compensation(model: mujoco.MjModel) -> tuple[SceneChange, ...]:
    """Returns the change for joints whose actuators compensate gravity without there being any.

    MuJoCo gives ``actuatorgravcomp`` in the stage of actuators, which it leaves out for a scene
    without one and where the flag disables them; the coupling brings the stage back.
    """
    joints = np.flatnonzero(model.jnt_actgravcomp).tolist() if model.ngravcomp else []
    is_off = model.opt.disableactuator == (1 << GROUPS) - 1  # for the flag, ``set_options``
    if not joints or not (is_off or model.nactuator == len(added_actuators(model))):
        return ()
    name = model.joint(joints[0]).name or str(joints[0])
    more = f" and {len(joints) - 1} more" if len(joints) > 1 else ""
    words = f"gravity compensation of joint '{name}'{more}: none without an actuator → given"
    return (SceneChange(words, "joint's gravity compensation"),)


HELD = 1e-6
"""Way of a grip in a motion of unit size, in m, below which constraints hold it. Rounding leaves
1e-12 of way; a softer hinge of the tool moves by its lever, of a mm or more."""

LET_GO = 'active="false" at its weld or connect'
"""Change by which a held grip can move."""

_HOLDING = int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD)


def take_over_mocap(
    spec: mujoco.MjSpec, model: mujoco.MjModel, grip: str, *, as_is: bool = False
) -> tuple[tuple[SceneChange, ...], list[str]]:
    """Switches off the constraints by which mocap bodies of the scene hold the grip in place.

    Scenes made for teleoperation move their tool by a weld to a mocap body. The hand replaces this
    body, and the coupling replaces the weld. Where the grip can still move along two
    axes, such as a finger of a held palm, the constraint stays.

    Args:
        spec: The scene with its handle; changed in place.
        model: The model that it compiles to; changed in place.
        grip: Grip of one hand.
        as_is: If true, such a scene is refused.

    Returns:
        The change, as ``name: old → new``, and clauses on constraints that leave the grip a part of
        its motion, or by which the fixed world leaves it none.

    Raises:
        SceneError: A change is needed that ``as_is`` forbids.
    """
    active = np.flatnonzero(model.eq_active0).tolist()
    held = [i for i in active if mocap_of(model, i)]
    # a body without a tree is fixed, or a mocap body
    fixed = [i for i in active if -1 in model.body_treeid[list(_tied_bodies(model, i))]]
    if not fixed:
        return (), []
    data = mujoco.MjData(model)
    reset(model, data)
    with quiet():
        mujoco.mj_forward(model, data)
    if not held:
        free, kept = (_motions(model, data, grip, without) for without in (fixed, []))
        is_fast = _rank(free) > _rank(kept) == 0
        return (), ["the grip is held fast by a weld or connect to the world"] * is_fast
    free, kept = (_motions(model, data, grip, without) for without in (held, []))
    is_held = _rank(kept[:3]) < min(2, _rank(free[:3]))
    for i in held.copy():  # the fewest that must go
        others = [j for j in held if j != i]
        if _rank(_motions(model, data, grip, others)) == _rank(free):
            held = others
    if not held:
        return (), []
    more = f" and {len(held) - 1} more" if len(held) > 1 else ""
    name = mocap_of(model, held[0])
    if not is_held:
        part = f"{_rank(kept)} of {_rank(free)} of its motions"
        return (), [f"mocap body '{name}'{more} holds the tool and leaves the grip {part}"]
    if as_is:
        raise SceneError(
            f"grip '{grip}' is held in place by mocap body '{name}'{more}; write {LET_GO}, or let "
            "the hand replace that body (without --as-is)"
        )
    for i in held:
        model.eq_active0[i] = 0
        next(equality for equality in spec.equalities if equality.id == i).active = False
    words = f"grip held by mocap body '{name}'{more} → by the hand alone"
    return (SceneChange(words, "mocap weld"),), []


def tied_trees(model: mujoco.MjModel, tree: int) -> list[int]:
    """Returns a kinematic tree and those that active welds and connects tie to it."""
    pairs = [
        {int(model.body_treeid[body]) for body in _tied_bodies(model, i)} - {-1}
        for i in np.flatnonzero(model.eq_active0).tolist()
    ]
    tied: set[int] = set()
    more = {tree}
    while more - tied:
        tied |= more
        more = set().union(*(pair for pair in pairs if pair & tied))
    return sorted(tied)


WEIGHTLESS = 1e-6
"""Generalised force of gravity in N or N m below which a weight pulls at nothing: rounding."""


def hanging_loads(data: mujoco.MjData, trees: Sequence[int]) -> list[str]:
    """Returns the bodies by which the weight of other trees may pull at some trees through tendons.

    The tendons have a spring or a limit. What gravity does not move, such as a carriage on a level
    rail, has no weight that pulls.

    Args:
        data: The scene at its start, after ``mj_forward``.
        trees: Trees whose weight is carried.
    """
    model, names = data.model, dict[str, None]()
    fall = np.abs(data.qfrc_bias - data.qfrc_gravcomp)
    still = [t for t in range(model.ntree) if not np.any(fall[model.dof_treeid == t] > WEIGHTLESS)]
    for tendon in range(model.ntendon):
        pulls = model.tendon_limited[tendon] or np.any(model.tendon_stiffness[tendon])
        wraps = np.arange(model.tendon_num[tendon]) + model.tendon_adr[tendon]
        sites = wraps[model.wrap_type[wraps] == int(mujoco.mjtWrap.mjWRAP_SITE)]
        bodies = model.site_bodyid[model.wrap_objid[sites]]
        at = model.body_treeid[bodies]
        if pulls and np.isin(at, trees).any():
            loads = bodies[~np.isin(at, [*trees, *still, -1])].tolist()
            names |= {model.body(i).name or str(i): None for i in loads}
    return list(names)


def _tied_bodies(model: mujoco.MjModel, equality: int) -> tuple[int, ...]:
    """Returns both bodies of a weld or connect; nothing for another equality constraint."""
    if int(model.eq_type[equality]) not in _HOLDING:
        return ()
    sides = np.array([model.eq_obj1id[equality], model.eq_obj2id[equality]])
    if model.eq_objtype[equality] == int(mujoco.mjtObj.mjOBJ_SITE):
        sides = model.site_bodyid[sides]
    return tuple(sides.tolist())


def mocap_of(model: mujoco.MjModel, equality: int) -> str:
    """Returns the mocap body, or its number, that a weld or connect ties to; empty without one."""
    roots = (int(model.body_rootid[body]) for body in _tied_bodies(model, equality))
    names = (model.body(i).name or str(i) for i in roots if model.body_mocapid[i] >= 0)
    return str(next(names, ""))


def constraint_rows(data: mujoco.MjData) -> NDArray[np.float64]:
    """Returns the rows of all active constraints, (nefc, nv)."""
    rows = np.zeros((data.nefc, data.model.nv))
    if mujoco.mj_isSparse(data.model):
        mujoco.mju_sparse2dense(
            rows, data.efc_J, data.efc_J_rownnz, data.efc_J_rowadr, data.efc_J_colind
        )
    else:
        rows[:] = data.efc_J.reshape(rows.shape)
    return rows


def _motions(
    model: mujoco.MjModel, data: mujoco.MjData, grip: str, without: list[int]
) -> NDArray[np.float64]:
    """Returns a grip's small motions (6, n) that equality constraints allow, some left out."""
    left_out = [*without, *np.flatnonzero(model.eq_type > int(mujoco.mjtEq.mjEQ_TENDON))]
    is_row = data.efc_type == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)
    is_row &= ~np.isin(data.efc_id, left_out)
    _, sizes, axes = np.linalg.svd(constraint_rows(data)[is_row])
    count = np.count_nonzero(sizes > HELD * sizes.max(initial=0.0))
    jacobian = np.zeros((6, model.nv))
    if (joint := held_joint(model, grip)) >= 0:
        jacobian[0, model.jnt_dofadr[joint]] = 1.0
    else:
        mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], model.site(grip).id)
    motions = jacobian @ axes[count:].T
    motions[np.abs(motions) < HELD] = 0.0
    return np.asarray(motions)


def _rank(motions: NDArray[np.float64]) -> int:
    return int(np.linalg.matrix_rank(motions, tol=HELD)) if motions.size else 0


def exclude_nested(
    spec: mujoco.MjSpec, model: mujoco.MjModel, grip: str
) -> tuple[SceneChange, ...]:
    """Excludes contacts between parts of a robot that begin inside each other, for good.

    A link whose hull encloses part of the link that carries it is inside it in every pose. A
    contact between them would only jam the joint. An explicit ``<pair>`` stays: MuJoCo does not
    exclude it.

    Args:
        spec: The scene with its handle; changed in place.
        model: The model that it compiles to.
        grip: Name of the site on the tool.

    Returns:
        The change, as ``name: old → new``; nothing if no exclusion was added, and the model is
        that of the specification.
    """
    data = mujoco.MjData(model)
    go_to_start(model, data, grip)
    pairs: dict[tuple[int, int], Overlap] = {}
    for overlap in overlaps(model, data, NOTABLE_OVERLAP):
        if is_nested(model, *overlap.bodies) and not overlap.is_explicit:
            pairs.setdefault(overlap.bodies, overlap)
    bodies = list(spec.bodies)
    if len(bodies) != model.nbody or not pairs:
        return ()  # MuJoCo fused bodies, so that their numbers differ
    for first, second in pairs:
        for body_id in (first, second):
            bodies[body_id].name = bodies[body_id].name or f"{PREFIX}body_{body_id}"
        spec.add_exclude(bodyname1=bodies[first].name, bodyname2=bodies[second].name)
    where = listed(list(pairs.values()))
    return (SceneChange(f"contact where {where} at the start: on → off", "nested parts"),)


def announce_overlaps(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[SceneChange, ...]:
    """Returns the change in the treatment of what overlaps at the start."""
    if overlapping := overlaps(model, data, NOTABLE_OVERLAP, has_margin=True):
        words = (
            f"start where {listed(overlapping)}: pushed out at once → held, and eased out as far "
            "as joints and the energy that the scene has dissipated allow"
        )
        return (SceneChange(words, "overlap"),)
    return ()
