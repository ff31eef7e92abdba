"""Start of a scene on its own constraints: limits, equalities and contacts that hold in its pose.

A file may start with an elbow beyond its limit, a weld whose parts are apart, or a cup inside a
table. Rigid constraints would hold that violation for the whole run, and soft ones would release
its energy into the hand. The start is therefore moved onto the constraints before there is a force.
"""

from __future__ import annotations

import copy
import math
from collections import defaultdict
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.kernel.mujoco_c import turning_dofs
from hapticbridge.scene.checks import NOTABLE_OVERLAP, Overlap, listed, overlaps
from hapticbridge.scene.compile import reset
from hapticbridge.scene.treatment import SceneChange
from hapticbridge.units import format_count, format_degrees, format_number

VIOLATION = 1e-4
"""Violation in m or rad above which a start is moved. Closed loops in published robots miss by
some µm, which nothing shows. A larger value lets a run start with a constraint off by as much."""

CLOSED = 1e-9
"""Step in m or rad at which a projection ends: the constraints are closed, or cannot be."""

MAX_STEPS = 100
"""Number of steps of a projection. Closed loops take 5 to 20; some that cannot close take all."""

MAX_TURN = 0.5
"""Largest angle in rad by which a step of a projection turns a joint. A larger step leaves the
place where it is linear: a hinge whose contact points away from its turn went round twice."""

MAX_NAMED = 4
"""Number of joints and bodies that are named one by one. More are counted."""

STIFF = 0.9999
"""Impedance of the constraints in a step, without unit, MuJoCo's largest. Each step leaves about
1 − d of a violation."""

_ROWS = {
    int(mujoco.mjtConstraint.mjCNSTR_EQUALITY): "equality",
    int(mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT): "joint",
    int(mujoco.mjtConstraint.mjCNSTR_LIMIT_TENDON): "tendon",
}
_KINDS = {
    int(mujoco.mjtEq.mjEQ_CONNECT): "connect",
    int(mujoco.mjtEq.mjEQ_WELD): "weld",
    int(mujoco.mjtEq.mjEQ_JOINT): "joint equality",
    int(mujoco.mjtEq.mjEQ_TENDON): "tendon equality",
}
_POINTS = int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD)
_HINGES = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_BALL)


class Start(NamedTuple):
    """Start of a scene on its constraints.

    Attributes:
        positions: Generalised positions (nq,), or None if no constraint is violated.
        changes: Differences from the file's start.
        remaining: Clauses on the constraints that stay violated.
    """

    positions: NDArray[np.float64] | None
    changes: tuple[SceneChange, ...]
    remaining: tuple[str, ...]


def start_on_constraints(model: mujoco.MjModel, *, is_moved: bool = True) -> Start:
    """Projects the start of a compiled scene onto its limits, equalities and contacts.

    Hinges and slides go to their limits alone. Each further step solves, by MuJoCo's own Newton
    solver with stiff constraints at rest,

        min ½ Δqᵀ M Δq    with    J Δq = −r for equalities,    J Δq >= −r for violated limits
                                                               and for parts that overlap

    with the inertia matrix M, the constraints' Jacobian J and their violation r. Weight, springs,
    motors and friction give no force. Without them a scene's own soft constraints come to rest at
    r = 0 too. An equality that cannot be closed is left out and described. Contacts come last, and
    only if pairs are by ``NOTABLE_OVERLAP`` closer than their margins then. They are left out if
    with them a limit or an equality stays violated, or no pair comes farther apart, as of a peg
    within the hull of a hole.

    Args:
        model: Compiled scene; it is not changed.
        is_moved: If false, the violations are only described.
    """
    trial, data = _without_forces(model)
    start, first = data.qpos.copy(), _violations(trial, data)
    inside = overlaps(trial, data, NOTABLE_OVERLAP, has_margin=True)
    if not inside and max(first.values(), default=0.0) <= VIOLATION:
        return Start(None, (), ())
    end, last = start, first
    if is_moved:
        end = _projected(trial, data)
        data.eq_active[:] = model.eq_active0
        mujoco.mj_forward(trial, data)
        last = _violations(trial, data)
    still = {row: size for row, size in last.items() if size > VIOLATION}
    remaining = [
        f"{row_name(model, row)} starts {_off(model, row, still[row])}, and stays so"
        for row in still
    ]
    if not is_moved and inside:
        remaining.append(f"{listed(inside)} at the start, and stay so")
    words = [
        f"start of {row_name(model, row)}: {_off(model, row, size)} → closed"
        for row, size in first.items()
        if size > VIOLATION and row not in still and row[0] != "joint"
    ]
    left = {
        each.words for each in overlaps(model, _at(model, end), NOTABLE_OVERLAP, has_margin=True)
    }
    if closed := [each for each in inside if each.words not in left]:
        words.append(f"start where {listed(closed)} → closed")
    limited = {row[1] for row, size in first.items() if row[0] == "joint" and size > VIOLATION}
    words += _moved(model, start, end, limited)
    changes = tuple(SceneChange(each, "start") for each in _at_most(words, "part", " of the scene"))
    return Start(end if words else None, changes, _at_most(remaining, "constraint"))


def _projected(trial: mujoco.MjModel, data: mujoco.MjData) -> NDArray[np.float64]:
    """Moves onto all constraints, then apart; returns the positions.

    Constraints that cannot be closed are left out.
    """
    start, own = data.qpos.copy(), trial.opt.disableflags
    trial.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    for _ in range(3):
        data.qpos[:] = start
        _clamp_joints(trial, data)
        sizes = _approach(trial, data)
        still = [
            number
            for (kind, number), size in sizes.items()
            if kind in ("equality", "turn") and size > VIOLATION
        ]
        if not still:
            break
        data.eq_active[still] = 0
    if not np.isfinite(data.qpos).all():
        data.qpos[:] = start
    closed = np.array(data.qpos)
    trial.opt.disableflags = own
    mujoco.mj_forward(trial, data)
    if before := overlaps(trial, data, NOTABLE_OVERLAP, has_margin=True):
        sizes = _approach(trial, data)
        after = overlaps(trial, data, NOTABLE_OVERLAP, has_margin=True)
        is_closed = max(sizes.values(), default=0.0) <= VIOLATION
        if not is_closed or not _is_farther_apart(after, before):
            data.qpos[:] = closed
    return np.array(data.qpos)


def _approach(trial: mujoco.MjModel, data: mujoco.MjData) -> dict[tuple[str, int], float]:
    """Takes steps onto the active constraints; returns what is left of each violation."""
    turns = turning_dofs(trial) != 0
    for _ in range(MAX_STEPS):
        mujoco.mj_forward(trial, data)
        if not CLOSED < np.abs(data.qacc).max(initial=0.0) < np.inf:
            break
        turn = float(np.abs(data.qacc[turns]).max(initial=0.0))
        mujoco.mj_integratePos(trial, data.qpos, data.qacc, MAX_TURN / max(turn, MAX_TURN))
    return _violations(trial, data)


def _is_farther_apart(after: list[Overlap], before: list[Overlap]) -> bool:
    """Returns True if fewer pairs overlap and none deeper, or as many and less deep."""
    deepest, limit = (max((each.depth for each in some), default=0.0) for some in (after, before))
    return deepest < limit or (len(after) < len(before) and deepest <= limit + CLOSED)


def _at(model: mujoco.MjModel, positions: NDArray[np.float64]) -> mujoco.MjData:
    """Returns the contacts of a scene at positions (nq,)."""
    data = mujoco.MjData(model)
    reset(model, data)
    data.qpos[:] = positions
    mujoco.mj_fwdPosition(model, data)
    return data


def _clamp_joints(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Moves hinges and slides to their limits' margins, where MuJoCo's limits rest, alone."""
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_LIMIT:
        return
    single = (model.jnt_limited != 0) & (model.jnt_type >= int(mujoco.mjtJoint.mjJNT_SLIDE))
    places, (low, high) = model.jnt_qposadr[single], model.jnt_range[single].T
    margin = np.minimum(model.jnt_margin[single], 0.5 * (high - low))
    data.qpos[places] = np.clip(data.qpos[places], low + margin, high - margin)


def _without_forces(model: mujoco.MjModel) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Returns a copy at its start in which stiff constraints give the only forces.

    Its acceleration is the step Δq, as k = 1/s² asks for a = −r.
    """
    trial, disable = copy.copy(model), mujoco.mjtDisableBit
    for flag in ("SPRING", "DAMPER", "GRAVITY", "ACTUATION", "FRICTIONLOSS", "REFSAFE"):
        trial.opt.disableflags |= int(getattr(disable, f"mjDSBL_{flag}"))
    trial.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_DIAGEXACT)  # else a step leaves more
    trial.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
    trial.opt.gravity[:] = trial.opt.wind[:] = 0.0
    trial.opt.tolerance, trial.opt.iterations = 0.0, 100
    trial.geom_condim[:] = trial.pair_dim[:] = trial.flex_condim[:] = 1
    laws = [(trial, name) for name in ("eq_sol{}", "jnt_sol{}", "tendon_sol{}_lim")]
    laws += [(trial, f"{name}_sol{{}}") for name in ("geom", "pair", "flex")]
    for holder, name in (*laws, (trial.opt, "o_sol{}")):
        getattr(holder, name.format("ref"))[:] = -1.0, 0.0
        getattr(holder, name.format("imp"))[:] = STIFF, STIFF, 1.0, 0.5, 2.0
    data = mujoco.MjData(trial)
    reset(trial, data)
    data.qvel[:] = 0.0
    mujoco.mj_forward(trial, data)
    return trial, data


def constraint_name(model: mujoco.MjModel, data: mujoco.MjData, row: int) -> str:
    """Returns the name of the constraint that a row of the data belongs to."""
    kind, number = int(data.efc_type[row]), int(data.efc_id[row])
    if kind in _ROWS:
        limit = "" if _ROWS[kind] == "equality" else "the limit of "
        return limit + row_name(model, (_ROWS[kind], number))
    if kind == int(mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF):
        joint = int(model.dof_jntid[number])
        return f"the friction of joint '{model.joint(joint).name or joint}'"
    if kind == int(mujoco.mjtConstraint.mjCNSTR_FRICTION_TENDON):
        return f"the friction of tendon '{model.tendon(number).name or number}'"
    sides = [model.geom(int(geom)) for geom in data.contact[number].geom if geom >= 0]
    bodies = [int(geom.bodyid[0]) for geom in sides]
    names = [
        f"geom '{geom.name}'" if geom.name else f"body '{model.body(body).name or body}'"
        for geom, body in zip(sides, bodies, strict=True)
    ]
    return f"the contact of {' and '.join(names) or 'a flex'}"


def _violations(model: mujoco.MjModel, data: mujoco.MjData) -> dict[tuple[str, int], float]:
    """Returns the violation in m or rad of each limit and equality constraint.

    A weld has two, ``equality`` in m and ``turn`` in rad: MuJoCo's last three rows of it are s sin
    (θ/2) along the axis of the turn θ, with its torquescale s in m.
    """
    sizes: dict[tuple[str, int], float] = {}
    vectors: defaultdict[int, list[float]] = defaultdict(list)
    distances = data.efc_pos - data.efc_margin
    for kind, number, distance in zip(data.efc_type, data.efc_id, distances, strict=True):
        row = _ROWS.get(int(kind), ""), int(number)
        is_equality = row[0] == "equality"
        if not row[0] or (is_equality and int(model.eq_type[number]) not in _KINDS):
            continue
        if is_equality and int(model.eq_type[number]) in _POINTS:
            vectors[row[1]].append(float(distance))
            continue
        size = abs(float(distance)) if is_equality else max(-float(distance), 0.0)
        sizes[row] = max(sizes.get(row, 0.0), size)
    for number, parts in vectors.items():
        sizes["equality", number] = math.hypot(*parts[:3])
        scale = float(model.eq_data[number, 10])
        if parts[3:] and scale > 0.0:
            sizes["turn", number] = 2.0 * math.asin(min(math.hypot(*parts[3:]) / scale, 1.0))
    return sizes


def row_name(model: mujoco.MjModel, row: tuple[str, int]) -> str:
    """Returns the name of a constraint, given as its kind in ``_ROWS`` and its number."""
    kind, number = row
    if kind not in ("equality", "turn"):
        return f"{kind} '{getattr(model, kind)(number).name or number}'"
    if int(model.eq_type[number]) not in _KINDS:  # of a flex
        return f"equality '{model.equality(number).name or number}'"
    kind = _KINDS[int(model.eq_type[number])]
    of = kind.removesuffix(" equality")
    if of == kind:
        is_site = int(model.eq_objtype[number]) == int(mujoco.mjtObj.mjOBJ_SITE)
        of = "site" if is_site else "body"
    held = (int(model.eq_obj1id[number]), int(model.eq_obj2id[number]))
    sides = [
        f"'{getattr(model, of)(i).name or i}'" for i in held if i > 0 or (i == 0 and of != "body")
    ]
    name = model.equality(number).name
    return (f"{kind} '{name}'" if name else kind) + f" of {of} {' and '.join(sides)}"


def _off(model: mujoco.MjModel, row: tuple[str, int], size: float) -> str:
    (kind, number), eq = row, mujoco.mjtEq
    if kind == "equality":
        of, number = int(model.eq_type[number]), int(model.eq_obj1id[number])
        kind = {int(eq.mjEQ_JOINT): "joint", int(eq.mjEQ_TENDON): "tendon"}.get(of, "")
    if kind == "tendon":  # a fixed one is the sum of its joints
        first = int(model.tendon_adr[number])
        is_fixed = int(model.wrap_type[first]) == int(mujoco.mjtWrap.mjWRAP_JOINT)
        kind, number = ("joint", int(model.wrap_objid[first])) if is_fixed else ("", 0)
    is_angle = kind == "turn" or (kind == "joint" and int(model.jnt_type[number]) in _HINGES)
    beyond = "off" if row[0] in ("equality", "turn") else "beyond its limit"
    return f"{_place(size, is_angle=is_angle)} {beyond}"


def _place(value: float, *, is_angle: bool) -> str:
    value = round(value, 8)  # finer is rounding
    value += 0.0  # without the sign of -0.0
    return format_degrees(value) if is_angle else f"{format_number(1e3 * value, 3)} mm"


def _moved(
    model: mujoco.MjModel,
    start: NDArray[np.float64],
    end: NDArray[np.float64],
    limited: set[int],
) -> list[str]:
    """Returns the joints that start elsewhere, as ``start of joint 'elbow': 0 deg → 20 deg``."""
    words, step = [], np.zeros(model.nv)
    mujoco.mj_differentiatePos(model, step, 1.0, start, end)
    for joint in range(model.njnt):
        kind, first = int(model.jnt_type[joint]), int(model.jnt_dofadr[joint])
        count = {0: 6, 1: 3}.get(kind, 1)
        if np.abs(step[first : first + count]).max() <= VIOLATION:
            continue
        name = f"joint '{model.joint(joint).name or joint}'"
        if count == 1:
            before, after = (float(each[model.jnt_qposadr[joint]]) for each in (start, end))
            is_angle = kind in _HINGES
            change = f"{_place(before, is_angle=is_angle)} → {_place(after, is_angle=is_angle)}"
        else:
            way = step[first : first + count]
            sizes = ((way[:3], False, "moved"), (way[3:], True, "turned"))
            parts = sizes if count == 6 else ((way, True, "turned"),)
            change = ", ".join(
                f"{verb} by {_place(float(np.linalg.norm(part)), is_angle=is_angle)}"
                for part, is_angle, verb in parts
                if np.linalg.norm(part) > VIOLATION
            )
            if count == 6:
                body = int(model.jnt_bodyid[joint])
                name = f"body '{model.body(body).name or body}'"
        words.append(f"start of {name}: {change}{', its limit' if joint in limited else ''}")
    return words


def _at_most(words: list[str], noun: str, of: str = "") -> tuple[str, ...]:
    """Returns the first of many sentences, and the number of the others."""
    more = len(words) - MAX_NAMED
    others = f"start of {format_count(more, f'more {noun}')}{of}: as these"
    return (*words[:MAX_NAMED], *([others] if more > 0 else []))
