"""Requirements on a scene before it may be felt."""

from __future__ import annotations

import codecs
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np

from hapticbridge.errors import SceneError, choices
from hapticbridge.kernel.codes import COUPLING_ACTUATORS, added_actuators, held_body, held_joint
from hapticbridge.scene.source import REPLACED, SourceFile, read_elements
from hapticbridge.units import format_count

# Requirements of the rendering methods for comparison on a scene

AXES_TOLERANCE = 1e-9
"""Largest deviation from orthogonality of the joint axes of a planar tool, without unit. It admits
rounding of axes with 16 digits in MJCF, far below a noticeable motion of the grip off the
handle."""


def check_massless_tool(model: mujoco.MjModel, grip: str, method: str) -> None:
    """Raises SceneError for a scene in which anything moves besides one rigid tool."""
    body_id = int(model.site(grip).bodyid[0])
    first, count = int(model.body_jntadr[body_id]), int(model.body_jntnum[body_id])
    kinds = model.jnt_type[first : first + count].tolist() if count else []
    slide, hinge = int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE)
    is_free = kinds == [int(mujoco.mjtJoint.mjJNT_FREE)]
    is_planar = kinds == [slide, slide, hinge] and model.body_parentid[body_id] == 0
    if is_planar:
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        axes = data.xaxis[first : first + 3]
        is_planar = bool(np.abs(axes @ axes.T - np.eye(3)).max() < AXES_TOLERANCE)
    if not is_free and not is_planar:
        raise SceneError(
            f"method '{method}' needs a tool with a free joint, or a planar one (two slides and "
            f"then a hinge, at right angles, on a child of the world); body "
            f"'{model.body(body_id).name or body_id}' of grip '{grip}' has neither"
        )
    others = {
        "other joints": model.nv > (6 if is_free else 3),
        "actuators": model.nactuator > len(COUPLING_ACTUATORS),
        "equality constraints": model.neq > 0,
        "tendons": model.ntendon > 0,
        "flexes": model.nflex > 0,
        "mocap bodies": model.nmocap > 1,
    }
    found = [name for name, is_there in others.items() if is_there]
    if found:
        raise SceneError(
            f"method '{method}' renders one tool and nothing else that moves; the scene has "
            f"{' and '.join(found)}; remove them or choose another method"
        )


def check_metered(model: mujoco.MjModel, integrator: str, method: str) -> None:
    """Raises SceneError for forces of the scene that cannot be metered under an integrator.

    The work of a port in a step is h Q·v⁺, with the force Q that the step used. ``Euler`` uses the
    force at the start of the step. ``implicitfast`` does so too for forces that do not depend on
    velocity. RK4 uses four forces and keeps none.
    """
    names = [model.actuator(i).name or str(i) for i in range(model.nactuator)]
    added = added_actuators(model)
    own = [i for i in range(model.nactuator) if i not in added]
    if integrator == "implicitfast":
        own = [i for i in own if _depends_on_velocity(model, i)]
    elif integrator != "RK4":
        return
    if own:
        kind = "actuator forces that depend on velocity" if integrator != "RK4" else "actuators"
        raise SceneError(
            f"method '{method}' cannot meter {kind} ({choices(names[i] for i in own)}) under "
            f"{integrator}; use 'implicit' or 'explicit'"
        )
    if integrator == "RK4" and (np.any(model.body_gravcomp) or np.any(model.jnt_actgravcomp)):
        raise SceneError(
            f"method '{method}' cannot meter gravity compensation under RK4; use 'explicit'"
        )


def _depends_on_velocity(model: mujoco.MjModel, actuator_id: int) -> bool:
    gain, bias = model.actuator_gaintype[actuator_id], model.actuator_biastype[actuator_id]
    is_plain = gain == mujoco.mjtGain.mjGAIN_FIXED or (
        gain == mujoco.mjtGain.mjGAIN_AFFINE and model.actuator_gainprm[actuator_id, 2] == 0
    )
    is_unbiased = bias == mujoco.mjtBias.mjBIAS_NONE or (
        bias == mujoco.mjtBias.mjBIAS_AFFINE and model.actuator_biasprm[actuator_id, 2] == 0
    )
    return not (is_plain and is_unbiased)


# Parts that push with their own velocity


@dataclass(frozen=True, slots=True)
class Pump:
    """Joint or actuator that pushes harder the faster it moves.

    Attributes:
        kind: ``joint`` or ``actuator``.
        number: Its id.
        words: Description with its numbers.
        change: Text to write in the MJCF.
    """

    kind: Literal["joint", "actuator"]
    number: int
    words: str
    change: str


def pumps(model: mujoco.MjModel, data: mujoco.MjData) -> list[Pump]:
    """Returns the joints and actuators that put energy into what moves already.

    An actuator with the velocity bias g_0 and the velocity gain g_1 under its control u pushes with
    the power g (m·v)², g = g_0 + g_1 u, joints with the damping d take Σ d_i v_i². At some velocity
    v the first is larger exactly if

        g > d_a + d_t/m_t² + 1/Σ (m_i²/d_i)

    with the actuator's own damping d_a and moment arms m, and of its tendon the damping d_t and arm
    m_t. A negative damping counts as none.

    Args:
        model: Compiled scene.
        data: The scene after ``mj_forward``: moment arms are those of its positions.
    """
    found = []
    for joint in range(model.njnt):
        damping = float(model.dof_damping[model.jnt_dofadr[joint]])
        if damping < 0.0:
            name = _joint_name(model, joint)
            words = f"{name} has a damping of {damping:.3g}: it pushes what moves already"
            found.append(Pump("joint", joint, words, 'damping="0" or more'))
    for actuator in range(model.nactuator):
        if pushes := _pushes(model, data, actuator):
            cause, array = pushes
            words = (
                f"actuator '{model.actuator(actuator).name or actuator}' pushes "
                f"{driven_name(model, actuator)} harder the faster it moves ({cause})"
            )
            most = "at most 0" if array == "biasprm" else "0"
            change = f"a third number of {most} in its {array}"
            found.append(Pump("actuator", actuator, words, change))
    return found


def _pushes(model: mujoco.MjModel, data: mujoco.MjData, actuator: int) -> tuple[str, str] | None:
    """Returns by what an actuator pumps, and the attribute that says so; None if it does not."""
    bias = gain = most = 0.0
    if model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_AFFINE:
        bias = float(model.actuator_biasprm[actuator, 2])
    if model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_AFFINE:
        gain = float(model.actuator_gainprm[actuator, 2])
    if gain != 0.0:
        control = model.actuator_ctrladr[actuator]
        is_limited = bool(model.actuator_ctrllimited[control])
        controls = model.actuator_ctrlrange[control] if is_limited else (-math.inf, math.inf)
        most = max(gain * float(control) for control in controls)
    if bias + most <= 0.0:
        return None
    offset = _offset_bias(model, data, actuator)
    if bias > offset:
        return f"velocity bias {bias:.3g}; damping there offsets {offset:.3g}", "biasprm"
    if bias + most > offset:
        where = f"controls {'above' if gain > 0.0 else 'below'} {(offset - bias) / gain:.3g}"
        return f"velocity gain {gain:.3g} at {where}", "gainprm"
    return None


def first_pump(model: mujoco.MjModel) -> Pump | None:
    """Returns the first joint or actuator that pushes what moves already; None without one."""
    return next(iter(_pumps_at_start(model)), None)


def _pumps_at_start(model: mujoco.MjModel) -> list[Pump]:
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return pumps(model, data)


PUMPING = 5e-3
"""Power in W above which a pump is at work: 1 mJ in 0.2 s, which no hand feels. A pump that rests
gives none."""


def pump_powers(model: mujoco.MjModel) -> Callable[[mujoco.MjData], dict[Pump, float]]:
    """Returns a function of a scene's state, for the power in W of each pump."""
    found = _pumps_at_start(model)
    return lambda data: {pump: _power_of(pump, data) for pump in found}


def working_pump(data: mujoco.MjData, grips: Sequence[str]) -> Pump | None:
    """Returns the pump with the largest power at a state; None if none is at work.

    Only those count that may move the tools of ``grips``; all of them if it is empty.
    """
    met = data.contact.geom.tolist()
    powers = {
        pump: power
        for pump, power in pump_powers(data.model)(data).items()
        if may_move(pump, data, grips, met)
    }
    pump = max(powers, key=lambda each: powers[each], default=None)
    return None if pump is None or powers[pump] <= PUMPING else pump


def may_move(
    pump: Pump, data: mujoco.MjData, grips: Sequence[str], met: Iterable[Iterable[int]]
) -> bool:
    """Returns True if a pump's bodies are joined to the tool of a grip, or if there is no grip.

    ``met`` holds pairs of ids of geoms that touched.
    """
    model = data.model
    if pump.kind == "joint":
        dofs = np.flatnonzero(model.dof_jntid == pump.number)
    else:
        output = int(model.actuator_outadr[pump.number])
        first = int(data.moment_rowadr[output])
        dofs = data.moment_colind.ravel()[first : first + int(data.moment_rownnz[output])]
    own, pairs = set(model.dof_treeid[dofs].tolist()), [*map(set, met)]
    tools = (int(model.body_treeid[held_body(model, grip)]) for grip in grips)
    return not grips or any(own & reached_trees(model, tool, pairs) for tool in tools)


def _power_of(pump: Pump, data: mujoco.MjData) -> float:
    """Returns the power in W that a pump gives to what moves; inf at a motion beyond all numbers.

    A joint gives −d v² along its axes, an actuator its force times its velocity.
    """
    model = data.model
    if pump.kind == "joint":
        dofs = model.dof_jntid == pump.number
        power = -float(model.dof_damping[dofs] @ np.square(data.qvel[dofs]))
    else:
        output = int(model.actuator_outadr[pump.number])
        power = float(data.actuator_force[output] * data.actuator_velocity[output])
    return power if math.isfinite(power) else math.inf


def strongest_actuator(model: mujoco.MjModel, data: mujoco.MjData) -> str:
    """Returns the name of the scene's own actuator with the largest force on joints; or empty.

    In N or N m; none is named if all forces are zero or a force is not finite.
    """
    sizes = {
        actuator: abs(float(data.actuator_force[output])) * _largest_arm(data, output)
        for actuator, output in enumerate(model.actuator_outadr.tolist())
        if actuator not in added_actuators(model)
    }
    best = max(sizes, key=lambda actuator: sizes[actuator], default=-1)
    if best < 0 or not 0.0 < sizes[best] < math.inf:
        return ""
    return str(model.actuator(best).name or best)


def _largest_arm(data: mujoco.MjData, output: int) -> float:
    first = int(data.moment_rowadr[output])
    row = slice(first, first + int(data.moment_rownnz[output]))
    return float(np.abs(data.actuator_moment.ravel()[row]).max(initial=0.0))


MIN_ARM = 1e-9
"""Moment arm relative to an actuator's largest below which it is rounding, without unit."""


def _offset_bias(model: mujoco.MjModel, data: mujoco.MjData, actuator: int) -> float:
    """Returns the largest velocity bias at which damping takes all that an actuator gives."""
    first = int(data.moment_rowadr[actuator])
    row = slice(first, first + int(data.moment_rownnz[actuator]))
    arms, dofs = data.actuator_moment.ravel()[row], data.moment_colind.ravel()[row]
    acts = np.abs(arms) > MIN_ARM * np.abs(arms).max(initial=0.0)
    if not acts.any():
        return math.inf
    damping = np.maximum(model.dof_damping[dofs[acts]], 0.0)
    offset = 0.0 if np.any(damping == 0.0) else 1.0 / float(np.sum(arms[acts] ** 2 / damping))
    if model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_TENDON:
        of_tendon = float(model.tendon_damping[model.actuator_trnid[actuator, 0]])
        offset += max(of_tendon, 0.0) / float(model.actuator_gear[actuator, 0]) ** 2
    return offset + max(float(model.actuator_damping[actuator]), 0.0)


def _joint_name(model: mujoco.MjModel, joint: int) -> str:
    name = model.joint(joint).name
    return f"joint '{name}'" if name else f"joint {joint}"


def driven_name(model: mujoco.MjModel, actuator: int) -> str:
    """Returns the name of what an actuator drives: a joint, a tendon, a site."""
    kind, driven = int(model.actuator_trntype[actuator]), int(model.actuator_trnid[actuator, 0])
    if kind in OF_A_JOINT:
        return _joint_name(model, driven)
    if kind == mujoco.mjtTrn.mjTRN_TENDON:
        return f"tendon '{model.tendon(driven).name or driven}'"
    if kind == mujoco.mjtTrn.mjTRN_SITE:
        return f"site '{model.site(driven).name or driven}'"
    return "what it drives"


OF_A_JOINT = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
"""Transmissions of an actuator that acts on a joint."""


# Kinematic trees joined to the tool


def reached_trees(model: mujoco.MjModel, tool: int, met: Iterable[Iterable[int]]) -> set[int]:
    """Returns the kinematic trees that can influence the tool's tree, including it.

    Contacts, equality constraints and tendons join trees. In a scene with flexes all trees count.
    ``met`` holds pairs of geom ids.
    """
    if model.nflex:  # contacts of a flex are not listed by geom
        return set(range(model.ntree))
    tree = model.body_treeid
    links = [{int(tree[model.geom_bodyid[geom]]) for geom in pair} for pair in met]
    links += [
        _trees_of_equality(model, equality)
        for equality in range(model.neq)
        if model.eq_active0[equality]
    ]
    links += [_trees_of_tendon(model, tendon) for tendon in range(model.ntendon)]
    links = [link - {-1} for link in links]
    reached = {tool}
    while new := {t for link in links if link & reached for t in link} - reached:
        reached |= new
    return reached


def _trees_of_equality(model: mujoco.MjModel, equality: int) -> set[int]:
    kind, objects = mujoco.mjtEq, (model.eq_obj1id[equality], model.eq_obj2id[equality])
    form, tree = int(model.eq_type[equality]), model.body_treeid
    ids = [int(each) for each in objects if each >= 0]
    if form == kind.mjEQ_JOINT:
        return {int(tree[model.jnt_bodyid[each]]) for each in ids}
    if form == kind.mjEQ_TENDON:
        return {t for each in ids for t in _trees_of_tendon(model, each)}
    if form not in (kind.mjEQ_CONNECT, kind.mjEQ_WELD):  # a flex has many bodies
        return set(range(model.ntree))
    if model.eq_objtype[equality] == mujoco.mjtObj.mjOBJ_SITE:
        ids = [int(model.site_bodyid[each]) for each in ids]
    return {int(tree[each]) for each in ids}


def _trees_of_tendon(model: mujoco.MjModel, tendon: int) -> set[int]:
    wrap, tree = mujoco.mjtWrap, model.body_treeid
    bodies = {
        wrap.mjWRAP_JOINT: model.jnt_bodyid,
        wrap.mjWRAP_SITE: model.site_bodyid,
        wrap.mjWRAP_SPHERE: model.geom_bodyid,
        wrap.mjWRAP_CYLINDER: model.geom_bodyid,
    }
    start = int(model.tendon_adr[tendon])
    parts = range(start, start + int(model.tendon_num[tendon]))
    return {
        int(tree[bodies[kind][model.wrap_objid[part]]])
        for part in parts
        if (kind := mujoco.mjtWrap(int(model.wrap_type[part]))) in bodies
    }


MAXIMUM_START_PENETRATION = 1e-4
"""Largest penetration of the tool at the start, in m, for contacts of the scene. Their penetration
releases energy that no port meters: 26 mJ within 15 ms were measured. A larger value allows a
larger push at the start."""

REFUSED_PENETRATION = MAXIMUM_START_PENETRATION + 5e-7
"""Penetration of the tool at the start, in m, beyond which it is refused: the largest allowed one
rounded to 1 um, as messages print it. A start at the limit itself computes to either side of it."""

NOTABLE_OVERLAP = 1e-3
"""Overlap in m at the start above which a scene is changed, or a sentence says that it begins so.
MuJoCo's own contacts rest 0.1 mm deep, and soft ones deeper; rigid contacts hold these silently."""


def check_options(spec: mujoco.MjSpec) -> None:
    """Refuses options that are incompatible with the coupling.

    Raises:
        SceneError: An option has state that is not saved (ipc), or is not finite.
    """
    option = spec.option
    for name in ("timestep", "gravity", "wind", "magnetic", "density", "viscosity"):
        if not np.all(np.isfinite(getattr(option, name))):
            raise SceneError(f"{name} in <option> is not finite; write a number")
    if option.enableflags & mujoco.mjtEnableBit.mjENBL_IPC:
        raise SceneError(
            "the scene enables flag ipc, whose state cannot be saved and simulated again; "
            "disable it"
        )


_CALLBACKS = ("act_bias", "act_dyn", "act_gain", "contactfilter", "control", "passive")


def refuse_callbacks() -> None:
    """Refuses MuJoCo's callbacks into Python.

    Raises:
        SceneError: Names one that is set.
    """
    for name in _CALLBACKS:
        if getattr(mujoco, f"get_mjcb_{name}")() is not None:
            raise SceneError(
                f"this program set MuJoCo's callback mjcb_{name}, which a loop without Python "
                f"cannot call and an audit does not know; mujoco.set_mjcb_{name}(None) removes it, "
                "and Bridge.set_input applies forces and controls of a program"
            )


MAY_BE_ACTIVE = "; the audit may report the environment as active"
"""Clause on what follows from unmetered work, for a sentence before the run."""


def unmetered_work(model: mujoco.MjModel) -> dict[str, str]:
    """Returns what does work on a compiled scene that no port meters.

    Returns:
        A clause for each attribute or element that does it, by its name.
    """
    found = dict[str, str]()
    if np.any(model.opt.wind) and max(model.opt.density, model.opt.viscosity) > 0.0:
        found["wind"] = "wind does work on the scene that no port meters"
    if np.any(model.geom_adhesion) or np.any(model.pair_adhesion):
        found["adhesion"] = (
            "adhesion that pulls across a gap does work on the scene that no port meters"
        )
    if np.any(model.body_plugin >= 0):
        found["plugin"] = "the plugin of a body may do work on the scene that no port meters"
    return found


_MASSES = ("mass", "density", "diaginertia", "fullinertia")
_FREE_TEXT = ("text", "numeric")  # <custom> elements, which MuJoCo does not compute with


def check_text(sources: Iterable[SourceFile]) -> None:
    """Refuses XML that is not in UTF-8, but for comments: MuJoCo copies its bytes into names.

    Raises:
        SceneError: Names the file, the line and the attribute.
    """
    for source in sources:
        if not source.name.lower().endswith((".xml", ".urdf")):
            continue
        if source.data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
            raise SceneError(f"{source.name} is in UTF-16; save it in UTF-8")
        try:
            source.data.decode()
        except UnicodeDecodeError:
            _refuse_other_bytes(source)


def _refuse_other_bytes(source: SourceFile) -> None:
    for element in read_elements(source.data):
        for attribute, value in element.attributes.items():
            if REPLACED in value:
                raise SceneError(
                    f"{source.name}, line {element.line}: {attribute} of <{element.tag}> is not in "
                    "UTF-8; save the file in UTF-8"
                )


def check_numbers(sources: Iterable[SourceFile]) -> None:
    """Refuses nan in any attribute, and masses and inertias that are not finite.

    MuJoCo treats ``mass="nan"`` as a missing mass and computes one. Elsewhere it only warns, and a
    nan stops parts of the scene or ends the run.

    Raises:
        SceneError: Names the file, the line, the element and the value.
    """
    files = [
        (source.name, list(read_elements(source.data)))
        for source in sources
        if source.name.lower().endswith(".xml")
    ]
    names = {
        element.attributes.get(key)
        for _, elements in files
        for element in elements
        for key in ("name", "class")
    }
    for file, elements in files:
        for element in elements:
            for attribute, value in element.attributes.items():
                numbers = [_number(word) for word in value.split()]
                if attribute in _MASSES and not all(map(math.isfinite, numbers)):
                    must = "masses and inertias must be finite"
                elif (
                    any(map(math.isnan, numbers))
                    and value not in names
                    and element.tag not in _FREE_TEXT
                ):
                    must = "write a number"
                else:
                    continue
                raise SceneError(
                    f"{file}, line {element.line}: {attribute} of <{element.tag}> is '{value}'; "
                    f"{must}"
                )


def check_finite(model: mujoco.MjModel) -> None:
    """Refuses a number of a compiled specification that is not finite.

    MuJoCo writes such a number as 0 or leaves it out, so the scene of the file would be another.

    Raises:
        SceneError: Names the field of MjModel and the place in it.
    """
    names = sorted(dir(model), key=lambda name: name.endswith("0") and name != "qpos0")
    for name in names:  # what derives from others, as dof_M0, is last
        values = getattr(model, name, None)
        if not isinstance(values, np.ndarray) or values.dtype.kind != "f":
            continue
        if np.isfinite(values).all():
            continue
        place = tuple(int(axis) for axis in np.argwhere(~np.isfinite(values))[0])
        raise SceneError(
            f"{name}[{', '.join(map(str, place))}] of the specification is {values[place]}, which "
            "no MJCF file can hold; write a number"
        )


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        return 0.0  # not a number; MuJoCo's own message is more specific


def check_model(model: mujoco.MjModel, grip: str) -> None:
    """Refuses a compiled model that cannot be coupled.

    Raises:
        SceneError: Masses or inertias are not finite, the grip cannot move, or a default of the
            scene changed a coupling actuator.
    """
    for body_id in range(model.nbody):
        mass, inertia = model.body_mass[body_id], model.body_inertia[body_id]
        if not np.isfinite(mass) or not np.all(np.isfinite(inertia)):
            raise SceneError(
                f"{_body_name(model, body_id)} has mass {mass:g} kg and inertia "
                f"{inertia.tolist()} kg m²; all must be finite"
            )
    chain = ancestors(model, held_body(model, grip))
    if not any(model.body_dofnum[body_id] for body_id in chain):
        is_mocap = any(model.body_mocapid[body_id] >= 0 for body_id in chain)
        where = "in the place of mocap" if is_mocap else "or at the end of joints"
        raise SceneError(
            f"grip '{grip}' sits on {_body_name(model, chain[0])}, which cannot move; put it on a "
            f"body with a free joint {where}"
        )
    for name in COUPLING_ACTUATORS:
        _check_coupling_actuator(model, name)


def ancestors(model: mujoco.MjModel, body_id: int) -> list[int]:
    """Returns the bodies from a body to the world, both included."""
    chain = [body_id]
    while chain[-1] != 0:
        chain.append(int(model.body_parentid[chain[-1]]))
    return chain


def coupled_sensors(model: mujoco.MjModel, *grips: str) -> list[int]:
    """Returns the sensors whose readings include the coupling's pull on the tool.

    MuJoCo counts actuators, of which the coupling is made, as motors of the joints between the grip
    and the world. It reads their forces in the joints, and what passes from body to body.
    """
    links, joints = set[int](), set[int]()
    for grip in grips:
        chain, joint = ancestors(model, held_body(model, grip)), held_joint(model, grip)
        links.update(chain)
        joints.update([joint] if joint >= 0 else np.flatnonzero(np.isin(model.jnt_bodyid, chain)))
    passing = (mujoco.mjtSensor.mjSENS_FORCE, mujoco.mjtSensor.mjSENS_TORQUE)
    return [
        sensor
        for sensor, (kind, place) in enumerate(
            zip(model.sensor_type.tolist(), model.sensor_objid.tolist(), strict=True)
        )
        if (kind in passing and int(model.site_bodyid[place]) in links)
        or (kind == mujoco.mjtSensor.mjSENS_JOINTACTFRC and place in joints)
    ]


def early_sensors(model: mujoco.MjModel) -> list[int]:
    """Returns the sensors that find contacts which a run sees ahead, before the parts touch.

    Such a contact carries no force. A sensor that reads forces alone, and not of the contacts that
    happen to be the first (``reduce="none"``), leaves it out.
    """
    kinds = mujoco.mjtConDataField.mjCONDATA_FORCE, mujoco.mjtConDataField.mjCONDATA_TORQUE
    forces = sum(1 << int(kind) for kind in kinds)
    return [
        sensor
        for sensor, (kind, (data, reduction, *_)) in enumerate(
            zip(model.sensor_type.tolist(), model.sensor_intprm.tolist(), strict=True)
        )
        if kind == mujoco.mjtSensor.mjSENS_CONTACT and (data & ~forces or reduction == 0)
    ]


def _check_coupling_actuator(model: mujoco.MjModel, name: str) -> None:
    actuator_id = model.actuator(name).id
    is_as_set = (
        model.actuator_forcelimited[actuator_id] == 0
        and model.actuator_ctrllimited[model.actuator_ctrladr[actuator_id]] == 0
        and model.actuator_actlimited[actuator_id] == 0
        and model.actuator_dyntype[actuator_id] == mujoco.mjtDyn.mjDYN_NONE
        and model.actuator_delay[actuator_id] == 0
        and model.actuator_damping[actuator_id] == 0
        and model.actuator_armature[actuator_id] == 0
        and model.actuator_plugin[actuator_id] == -1
        and model.actuator_actnum[actuator_id] == 0
        and np.sum(np.abs(model.actuator_gear[model.actuator_outadr[actuator_id]])) == 1
    )
    if not is_as_set:
        raise SceneError(
            f"a <default> of the scene changed the coupling's actuator '{name}'; move that default "
            "into a named class"
        )


FARTHEST = 1e3
"""Largest distance in m of the tool from the origin. At 10 km and 8000 N/m rounding puts wrenches
off by more than the 1e-9 N that the audit takes for tampering."""


def check_start(data: mujoco.MjData, grip: str) -> None:
    """Raises SceneError for a start that is not finite, or a tool beyond ``FARTHEST``.

    ``data`` must be at the start, after ``mj_forward``.
    """
    for name in ("qpos", "qvel", "act", "ctrl", "mocap_pos", "mocap_quat", "qacc"):
        if not np.all(np.abs(getattr(data, name)) <= mujoco.mjMAXVAL):
            raise SceneError(
                f"the scene's start is not finite, or beyond {mujoco.mjMAXVAL:g}, in {name}; check "
                "keyframe 'home' and qpos0"
            )
    distance = float(np.linalg.norm(data.site(grip).xpos))
    if distance > FARTHEST:
        raise SceneError(
            f"the tool starts {distance:.4g} m from the origin; beyond {FARTHEST:g} m positions "
            "round too coarsely to be audited; move the scene to the origin"
        )


@dataclass(frozen=True, slots=True)
class Overlap:
    """A contact in penetration.

    Attributes:
        depth: Depth in m, > 0.
        words: Names of both sides.
        bodies: Ids of both bodies; -1 for a flex.
        is_explicit: True for a ``<pair>`` of the file, which no exclusion of bodies switches off.
        margin: Distance in m at which the contact rests, if the depth is measured from there.
    """

    depth: float
    words: str
    bodies: tuple[int, int]
    is_explicit: bool = False
    margin: float = 0.0

    def __str__(self) -> str:
        margin, inside = self.margin, self.depth - self.margin
        if margin == 0.0:
            return f"{self.words} overlap by {1e3 * self.depth:.3g} mm"
        if inside < NOTABLE_OVERLAP:
            size = f"{1e3 * self.depth:.3g} mm"
            return f"{self.words} are {size} closer than their margin of {1e3 * margin:.3g} mm"
        beside = f"with a margin of {1e3 * margin:.3g} mm"
        return f"{self.words} overlap by {1e3 * inside:.3g} mm, {beside}"


def overlaps(
    model: mujoco.MjModel, data: mujoco.MjData, depth: float, *, has_margin: bool = False
) -> list[Overlap]:
    """Returns the pairs that overlap by more than a depth in m, the deepest first.

    ``data`` must be after MuJoCo's position stage. Each pair of geoms or flexes is listed once.
    With ``has_margin`` depths are measured from the margin, where MuJoCo's contacts rest; not from
    ``o_margin``, which rigid contacts set to 0.
    """
    by_words: dict[str, Overlap] = {}
    pairs = {frozenset(pair) for pair in zip(model.pair_geom1, model.pair_geom2, strict=True)}
    has_margin &= not model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_OVERRIDE
    margins = [float(each.includemargin) if has_margin else 0.0 for each in data.contact]
    found = [(m - float(each.dist), m, each) for m, each in zip(margins, data.contact, strict=True)]
    for size, margin, contact in sorted(found, key=lambda each: -each[0]):
        if size <= depth:
            break
        sides = list(zip(contact.geom.tolist(), contact.flex.tolist(), strict=True))
        words = " and ".join(_side_name(model, geom, flex) for geom, flex in sides)
        first, second = (int(model.geom_bodyid[geom]) if geom >= 0 else -1 for geom, _ in sides)
        is_explicit = frozenset(geom for geom, _ in sides) in pairs
        overlap = Overlap(size, words, (first, second), is_explicit, margin)
        by_words.setdefault(words, overlap)
    return list(by_words.values())


def listed(overlapping: list[Overlap]) -> str:
    """Returns the deepest of some overlaps, and the number of the others."""
    count = len(overlapping) - 1
    return str(overlapping[0]) + (f" (and {format_count(count, 'more pair')})" if count else "")


def refuse_overlap(model: mujoco.MjModel, data: mujoco.MjData, grip: str) -> None:
    """Refuses a start in which the tool penetrates a body, for contacts that would push it out.

    Raises:
        SceneError: Names the deepest pair.
    """
    root = model.body_rootid[model.site(grip).bodyid[0]]
    for overlap in overlaps(model, data, REFUSED_PENETRATION):
        if root in [model.body_rootid[body] for body in overlap.bodies if body >= 0]:
            raise SceneError(
                f"the tool starts in penetration: {overlap}; contacts of the scene allow at most "
                f"{MAXIMUM_START_PENETRATION * 1e3:g} mm; move the tool's start, or let rigid "
                "contacts hold it (--contact rigid, without --as-is)"
            )


def is_nested(model: mujoco.MjModel, first: int, second: int) -> bool:
    """Returns True if one of two bodies of a tree carries the other one, in any number of joints.

    Bodies without joints between them count as one.
    """
    if min(first, second) <= 0 or model.body_rootid[first] != model.body_rootid[second]:
        return False
    groups = [model.body_weldid[ancestors(model, body)[:-1]].tolist() for body in (first, second)]
    return groups[0][0] in groups[1] or groups[1][0] in groups[0]


def _side_name(model: mujoco.MjModel, geom_id: int, flex_id: int) -> str:
    if geom_id < 0:
        return f"flex '{mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_FLEX, flex_id) or flex_id}'"
    name = model.geom(geom_id).name
    if name:
        return f"geom '{name}'"
    return f"geom {geom_id} of {_body_name(model, int(model.geom_bodyid[geom_id]))}"


def _body_name(model: mujoco.MjModel, body_id: int) -> str:
    return f"body '{model.body(body_id).name or body_id}'" if body_id else "the world"
