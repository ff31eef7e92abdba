"""Rigid contact at the level of velocities, whose depenetration is paid from a tank of energy.

Each contact has a wanted normal velocity at the end of the step, in m/s,

    ŵ = w − max(0, μ|v_t| − μ² max(0, w − v_n)),
    w = σ β p/h    in the penetration p > 0,        w = −gap/h    in a gap

h is the time step in s, v the relative velocity at the start, μ|v_t| = sqrt(Σ (μ_j v_j)²) over the
rows of friction and σ the share of the depenetration. The convex cone lifts a contact by μ times
its sliding, which is subtracted; the impulse that stops the normal velocity v_n slows the sliding
first. To *aim* a contact is to write its ŵ into its rows. A point may still sink by more than
``SUNK``, for example the corner of a box that stops more than it slides. It is aimed again, with
the sliding that is left at the end of the step. The wanted velocities of the friction rows are 0.
MuJoCo's convex problem, with the regularisation R of each row, then gives impulses h λ with

    C = h λᵀ J v⁺ = h λᵀ ŵ − h² λᵀ R λ   <=   Σ_{p>0} (σ β p/h)² / (4 R)

C is the energy in J that the contacts give in the step. It is at most 0 for σ = 0: the contact
holds, opens freely and never pushes out. A step is therefore solved with σ = 1 first. If C exceeds
``SPENDABLE`` of the tank, the step is repeated with a smaller σ, at last 0. The tank holds what the
environment has dissipated,

    D_k = min(cap, D_{k−1} − E_k) <= −Σ E_k,    D_0 = 0

so that Σ E_k <= 0 for any geometry, friction and collider: E_k = −½‖Δv‖²_M + C + r, and the
remainder r of the integration (inertia that turns, explicit forces) is in E_k and paid next. A
moved mocap body pays for its own push: its work belongs to the external port and is subtracted from
C. If it recedes by δ, ŵ is smaller by δ/h: a body that rests on it follows, and gives its energy to
that port. All this holds for any ŵ <= 0 in a gap. A contact therefore only has to be known before
it closes: margins follow the speed (``kernel.contact_margins``).

A contact is *blocked* if no joint can answer along its normal, J M⁻¹ Jᵀ of its normal row being at
most ``BLOCKED`` of that of its friction: a puck on two slides, a drawer on its runners. The law
above would hold it with any force, and its cone with it. Its normal force N is that of the scene's
own ``solref`` and ``solimp`` at the depth p at rest,

    N = K d² p/((1 − d) A),    ŵ = h R N − μ|v_t⁺|,    R = 4 n μ² J_t M⁻¹ J_tᵀ

A is MuJoCo's approximate inverse inertia (``body_invweight0``), K and d are its stiffness and
impedance, n is the number of such contacts. One that only touches gives no force. None does work
along its normal, and friction takes energy; where the tank says otherwise the step is repeated
with the law of other contacts. The exact inverse inertia of such a row is 0, so a step
with one uses the approximate ones for all.

A contact that closes in a *blow* is first aimed at 0 and then at its rebound
(``kernel.restitution``). Such a step may give what the blow itself dissipates, too; beyond it, the
rebound is lowered.

Limits of joints and tendons are rows like those of a contact without friction; they hold a joint
at the scene's own margin from the end of its range, as MuJoCo's do. An equality
constraint has ŵ = −σ β p/h − (1 − σ) δp/h for an error p of either sign; δp is the part of p that a
moved mocap body added. All these rows share the tank, so the tank also pays for an error that
exists at the start. MuJoCo subtracts h J̇v from ŵ of ``connect`` and ``weld``; a repeated step does
not. Equality constraints of a flex stay MuJoCo's.

MuJoCo computes R and the reference acceleration of a row again in ``mj_step2``, from the contact's
parameters and the row's position. These are therefore written between the halves of its step. With
an impedance d and under ``integrator="discrete"``, R is (1 − d)/(2 d) of the row's inverse inertia,

    solref = (−ε d², −d/h),  position = −(2ŵ − v)/(ε h d)    →    J v⁺ = ŵ − h R λ
    solreffriction = (0, −d/(ε h))                           →    ŵ_t = 0 to ε

References:
    Anitescu & Potra 1997 (velocity-level contact); Franken et al. 2011 (energy tank).
"""

from __future__ import annotations

import math
from ctypes import sizeof

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.kernel.codes import EQUALITY, LIMIT_JOINT, LIMIT_TENDON, Part, State
from hapticbridge.kernel.jit import compiled
from hapticbridge.kernel.ledger import mocap_work, opened_by_mocap
from hapticbridge.kernel.mujoco_c import floats, ints, mj_mul_jac, pointer_at, struct_of
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.kernel.restitution import (
    BLOW_SPEED,
    NOTABLE_BOUNCE,
    PAID,
    PRESSING,
    has_bounce,
    kinetic_loss,
    rebound_speed,
    rigid_restitution,
    square_at_surface,
)

SOFTNESS = 1e-3
"""Regularisation R over the inverse inertia of a contact, without unit. A steady force F on a mass
m sinks in by h² F SOFTNESS/(2 m DEPENETRATION), 0.08 µm at 3 N on 0.1 kg and 1 ms. A smaller value
is more rigid and slower to solve."""

DEPENETRATION = 0.2
"""Share β of a penetration that a contact removes in one step, without unit. A larger share removes
penetrations sooner and costs more energy at once."""

IMPRATIO = 1000.0
"""Ratio of the regularisations of normal and friction, MuJoCo's ``impratio``; no unit. A larger one
creeps less below the limit of friction: 3 nm/s at half of it where 100 creeps by 31 nm/s (3 N on
0.1 kg)."""

MARGIN = 5e-5
"""Margin of a geom at rest in m. Two geoms take part in the step from the sum of their margins on,
before they touch. It covers the speed that a body gains within a step. A larger one costs time for
contacts without force."""

MAX_MARGIN = 5e-3
"""Largest margin in m that a geom's speed adds in steps of up to 1 ms, that of 5 m/s at 1 ms. A
faster geom may be first seen in penetration, which the tank then pays for."""


def largest_margin(time: float) -> float:
    """Returns the largest margin in m for steps, or periods of a scene beside the loop, in s."""
    return max(MAX_MARGIN, 1e3 * MAX_MARGIN * time)


RESULTS_AHEAD = 3
"""Periods of a scene beside the loop for which its contacts are seen ahead. Its tool is shown for
two of them after the newest result, and contacts are those of the start of its last one."""

SUNK = 5e-6
"""Depth in m by which a sliding contact may sink in a step before the step is repeated. A smaller
value repeats more steps, and looks for sinks at slower sliding: from 12 mm/s on at μ = 0.4."""

MAX_CORRECTIONS = 3
"""Largest number of such repetitions of a step."""

MAX_ROWS = 1024
"""Largest number of constraint rows with which sinks are looked for and blows bounce; 340 contacts
with friction."""

SPENDABLE = 0.9
"""Largest share of the tank that one tick spends, without unit. The rest covers the remainder of
the integration."""

RESERVE = 1e-7
"""Energy in J of the tank that is never spent; it covers rounding and the remainder of the
integration."""

BLOCKED = 1e-6
"""Largest mobility along the normal of a blocked contact over that along the surface, without unit:
a normal that a joint's motion meets at 1 mrad from a right angle. More would let the force of such
a contact do work, and the step be solved twice."""

FORCE_ERROR = 0.02
"""Largest error of a blocked contact's normal force, without unit, before the step is repeated."""

OPEN = -1e3
"""Wanted velocity in m/s of a blocked contact without force. No sliding closes it."""

MAX_CUT = 0.99
"""Largest ρ after a first step that gives too much energy, without unit. After each other one it is
at most ``MAX_CUT`` ρ², so eight end any rebound. A larger one keeps more of the rebound and repeats
more steps."""

REBOUND_ERROR = 0.01
"""Largest error of a rebound's normal velocity, without unit, before the step is repeated."""

COMPRESSION, RESTITUTION = 1, 2
"""Stages of a step with a blow."""

NO_REBOUND = -1.0
"""Instead of a rebound's velocity in m/s, where a row is no blow."""

_EXACT = 1e-9
"""ε of the module's equations, without unit: the spring that is left in the row of a contact, and
the velocity that is left in the rows of friction."""

_IMPEDANCE = 1.0 / (1.0 + SOFTNESS)

LAST_TURNING = int(mujoco.mjtEq.mjEQ_WELD)
"""Last kind of equality constraint whose rows turn with the bodies: ``connect``, ``weld``."""

LAST_RIGID = int(mujoco.mjtEq.mjEQ_TENDON)
"""Last kind of equality constraint that is rigid; the later ones are those of a flex."""

STALLED = 1.0
"""Gradient in m/s², as MuJoCo scales it, above which a solution has not converged. Ordinary steps
end below 0.1, those that give energy above 100."""

_SOLVER = struct_of("mjModel").opt.offset + struct_of("mjOption").solver.offset

_GRADIENT, _STATISTIC = struct_of("mjSolverStat").gradient.offset, sizeof(struct_of("mjSolverStat"))

_EXACT_DIAGONAL = int(mujoco.mjtEnableBit.mjENBL_DIAGEXACT)

_SLIGHT = 1e-6
"""Mobility along the normal over that of the body, and over ``BLOCKED``, below which a contact
without friction is blocked; no unit."""

_MAX_KEPT = int(mujoco.mjNSOLVER)

_NEWTON, _CG = int(mujoco.mjtSolver.mjSOL_NEWTON), int(mujoco.mjtSolver.mjSOL_CG)

WRITTEN = (
    *("eq_solref", "eq_solimp", "jnt_solref", "jnt_solimp"),
    *("tendon_solref_lim", "tendon_solimp_lim", "geom_margin", "pair_margin"),
    *("jnt_margin", "tendon_margin"),
)
"""Arrays of the model that a run writes to, and puts back."""

_OF_MODEL = (
    *("geom_rbound", "pair_geom1", "pair_geom2", "jnt_type", "jnt_dofadr"),
    *("body_parentid", "body_rootid", "body_dofadr", "body_dofnum"),
    *("body_invweight0", "dof_invweight0"),
)
_OF_DATA = ("geom_xpos", "subtree_com", "cdof", "ten_velocity", "qacc_smooth")
_OF_BLOWS = (
    "restitutions",
    "approaches",
    "gaps",
    "pressings",
    "impulses",
    "returnable",
    "rebounds",
)
_OWNED = (
    *(f"own_{name}" for name in WRITTEN),
    *("eq_type", "row_positions", "row_shifts", "end_velocity", "moving_geoms", "body_velocity"),
    *("leashes", "blocked", "geom_rest", "pair_rest"),
    *("velocity_change", "momentum_change", *_OF_BLOWS),
)

RIGID_DTYPE = np.dtype(
    [
        ("is_rigid", "<i8"),
        ("repetitions", "<i8"),
        ("active_contacts", "<i8"),
        ("is_aimed", "<i8"),
        ("corrections", "<i8"),
        ("is_shifted", "<i8"),
        ("pressing", "<i8"),
        ("is_sparse", "<i8"),
        ("leads", "<i8"),
        ("has_margins", "<i8"),
        ("solver", "<i8"),
        ("own_solver", "<i8"),
        ("bounces", "<i8"),
        ("blow_stage", "<i8"),
        ("cuts", "<i8"),
        ("statistics", "<i8"),
        ("warmstart", "<i8"),
        ("row_capacity", "<i8"),
        *((name, "<i8") for name in (*WRITTEN, *_OF_MODEL, *_OF_DATA, *_OWNED)),
        ("moving_count", "<i8"),
        ("pair_count", "<i8"),
        ("push_ratio", "<f8"),
        ("rebound_ratio", "<f8"),
        ("tank", "<f8"),
        ("cap", "<f8"),
        ("last_energy", "<f8"),
        ("lift", "<f8"),
        ("ahead", "<f8"),
        ("flight", "<f8"),
        ("largest_margin", "<f8"),
        ("stalled", "<f8"),
        ("paid", "<f8"),
    ]
)
"""Sub-record ``contact``, written by this module alone. ``is_rigid`` is 1 if contacts are rigid;
``repetitions`` counts repeated steps since the start, ``active_contacts`` the contacts with a
force; ``push_ratio`` σ of the last step; ``tank`` D and ``cap`` in J; ``last_energy`` Σ E_k in J at
the last tick. ``is_aimed`` is 1 from the edit to the end of the step, ``corrections`` counts its
repetitions for sliding, and ``lift`` is the largest velocity in m/s subtracted for it; ``ahead``
the time in s for which margins reach ahead, ``flight`` what they add in m where there are bounces,
and ``largest_margin`` their largest in m. ``leads`` is
1 if the tool's margins follow the handle's speed, too. ``geom_rest`` and ``pair_rest`` are the
file's own margins in m, at which contacts rest, and ``has_margins`` is 1 if there are any.
``is_shifted`` is 1 if the step was repeated
without −h J̇v. ``pressing`` counts the blocked contacts in penetration, and ``blocked`` is the
address of h R N of each row in m/s, −1 where it is none; ``is_sparse`` is 1 if MuJoCo's Jacobian
is. ``solver`` is the address of MuJoCo's choice, ``own_solver`` that of the scene; ``stalled`` is
``STALLED``, ``paid`` ``PAID``, and beyond 1 Newton's rule alone. ``bounces`` is 1 if a contact or
limit may bounce. ``blow_stage`` is ``COMPRESSION`` or ``RESTITUTION`` in a step with a blow, or 0;
``rebound_ratio`` is ρ in restitution, else 0, and ``cuts`` counts the repetitions for impulses. Of
each row that is a blow: e, −v_n in m/s, gap in m, a in m/s², P_c and e Q_c in N s, and w in m/s,
which is ``NO_REBOUND`` where it is none. Two buffers have a number per degree of freedom. Of limits
and equality constraints: largest count of rows (0 if there are none), and addresses of the model's
parameters, of copies, of the rows' own positions, of the velocities taken from ŵ and of J v⁺. Of
margins: addresses and counts of the geoms that move, of pairs, and of the bodies' velocities;
``leashes`` is 1 for spatial tendons of no least length."""


def bind_contact(
    contact: Part, model: mujoco.MjModel, data: mujoco.MjData, parameters: RunParameters
) -> dict[str, NDArray[np.generic]]:
    """Fills in the sub-record, with an empty tank; returns arrays that must outlive the state."""
    timestep = float(model.opt.timestep)
    contact["is_rigid"] = parameters.is_rigid
    contact["cap"] = parameters.tank_cap
    contact["leads"] = parameters.is_beside
    step, steps = (parameters.period, RESULTS_AHEAD) if parameters.is_beside else (timestep, 1)
    contact["ahead"], contact["largest_margin"] = steps * step, largest_margin(step)
    contact["solver"], contact["own_solver"] = model._address + _SOLVER, model.opt.solver
    contact["statistics"] = data._address + struct_of("mjData").solver.offset
    contact["warmstart"] = data.qacc_warmstart.ctypes.data
    contact["stalled"], contact["paid"] = STALLED, PAID
    contact["is_sparse"] = mujoco.mj_isSparse(model)
    is_rigid = model.eq_type <= LAST_RIGID
    if np.any(is_rigid) or np.any(model.jnt_limited) or np.any(model.tendon_limited):
        flex_rows = data.ne if np.any(~is_rigid) else 0
        contact["row_capacity"] = (
            max(6 * model.neq, flex_rows) + model.nv + 2 * model.njnt + 3 * model.ntendon
        )
    owned: dict[str, NDArray[np.generic]] = {
        f"own_{name}": getattr(model, name).copy() for name in WRITTEN
    }
    for name in ("geom", "pair"):
        owned[f"{name}_rest"] = own_margins(model, name)
        contact["has_margins"] |= np.any(owned[f"{name}_rest"])
    owned["eq_type"] = np.ascontiguousarray(model.eq_type, dtype=np.int32)
    for name in ("row_positions", "row_shifts"):
        owned[name] = np.zeros(max(int(contact["row_capacity"]), 1))
    is_spatial = model.wrap_type[model.tendon_adr] != mujoco.mjtWrap.mjWRAP_JOINT
    owned["leashes"] = (is_spatial & (model.tendon_range[:, 0] <= 0.0)).astype(np.int32)
    for name in ("end_velocity", "blocked", *_OF_BLOWS):
        owned[name] = np.zeros(MAX_ROWS)
    for name in ("velocity_change", "momentum_change"):
        owned[name] = np.zeros(max(model.nv, 1))
    contact["bounces"] = has_bounce(model)
    contact["flight"] = contact["bounces"] * PRESSING * step**2
    meets = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    meets[model.pair_geom1] = meets[model.pair_geom2] = True
    is_moving = model.body_weldid[model.geom_bodyid] > 0
    owned["moving_geoms"] = np.flatnonzero(meets & is_moving).astype(np.int32)
    owned["body_velocity"] = np.zeros((model.nbody, 6))
    contact["moving_count"], contact["pair_count"] = owned["moving_geoms"].size, model.npair
    for name in (*WRITTEN, *_OF_MODEL):
        contact[name] = getattr(model, name).ctypes.data
    for name in _OF_DATA:
        contact[name] = getattr(data, name).ctypes.data
    for name, array in owned.items():
        contact[name] = array.ctypes.data
    return owned


def own_margins(model: mujoco.MjModel, kind: str) -> NDArray[np.float64]:
    """Returns the file's margins in m of a model whose contacts are rigid.

    Args:
        model: A model with the margins of ``rigid_margins``.
        kind: ``geom`` or ``pair``.
    """
    margins = getattr(model, f"{kind}_margin") - MARGIN
    is_overridden = model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_OVERRIDE
    return np.where((margins > _ROUNDING) & (not is_overridden), margins, 0.0)


_ROUNDING = 1e-9
"""Margin in m below which a file has none."""


def rigid_margins(margins: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the margins in m with which rigid contacts are seen before they close.

    Args:
        margins: Those of the file in m, at which its contacts rest.
    """
    return np.where(margins > 0.0, margins + MARGIN, MARGIN)


def restore_model(model: mujoco.MjModel, owned: dict[str, NDArray[np.generic]]) -> None:
    """Puts back what a run writes to the model, from the arrays of ``bind_contact``."""
    for name in WRITTEN:
        getattr(model, name)[...] = owned[f"own_{name}"]


@compiled
def opening(s: State, contact: int) -> float:
    """Returns the distance in m of a contact's geoms from where it rests, at the file's margins."""
    distance = float(floats(contact + s.mj.contact_distance, 1)[0])
    geoms = ints(contact + s.mj.contact_geoms, 2)
    if not s.contact.has_margins or min(geoms[0], geoms[1]) < 0:
        return distance
    firsts = ints(s.contact.pair_geom1, s.contact.pair_count)
    seconds = ints(s.contact.pair_geom2, s.contact.pair_count)
    for i in range(s.contact.pair_count):
        is_pair = firsts[i] == geoms[0] and seconds[i] == geoms[1]
        if is_pair or (firsts[i] == geoms[1] and seconds[i] == geoms[0]):
            return distance - float(floats(s.contact.pair_rest, i + 1)[i])
    rest = floats(s.contact.geom_rest, s.mj.ngeom)
    return distance - float(rest[geoms[0]] + rest[geoms[1]])


@compiled
def _aim(s: State) -> None:
    """Writes parameters and positions for ``mj_step2``, for the present share."""
    if s.contact.row_capacity > 0:
        _aim_rows(s)
    mj, h, push = s.mj, s.run.timestep, s.contact.push_ratio * DEPENETRATION
    count = ints(mj.nefc, 1)[0]
    velocities = floats(pointer_at(mj.efc_vel), count)
    positions = floats(pointer_at(mj.efc_pos), count)
    margins = floats(pointer_at(mj.efc_margin), count)
    ends = floats(s.contact.end_velocity, MAX_ROWS)
    blocked = floats(s.contact.blocked, MAX_ROWS)
    contacts = pointer_at(mj.contact)
    has_ends = s.contact.corrections > 0 or s.contact.blow_stage == RESTITUTION
    s.contact.lift = 0.0
    for c in range(ints(mj.ncon, 1)[0]):
        contact = contacts + c * mj.contact_size
        row = ints(contact + mj.contact_row, 1)[0]
        if row < 0:
            continue
        friction = floats(contact + mj.contact_friction, 5)
        slide, rest, along = _slides(s, contact, has_ends)
        distance = opening(s, contact)
        wanted = (-push if distance < 0.0 else -1.0) * distance / h
        opened = opened_by_mocap(s, contact) if s.energy.mocap_has_moved else 0.0
        wanted -= max(max(opened, 0.0) - max(distance, 0.0), 0.0) / h
        rebound = _rebound(s, row)
        if rebound >= 0.0:
            wanted = max(wanted, _softened(rebound - opened / h, velocities[row]))
        stop = max(wanted - velocities[row], 0.0)
        lift = max(math.sqrt(slide) - friction[0] ** 2 * stop, 0.0)
        if rebound >= 0.0 and has_ends:
            change = rebound - opened / h - velocities[row], ends[row] - velocities[row]
            lift = _slide_left(slide, rest, along, change)
        elif s.contact.corrections > 0:
            lift = min(lift, math.sqrt(rest))
        solimp, d = floats(contact + mj.contact_solimp, 2), _IMPEDANCE
        if row < MAX_ROWS and blocked[row] >= 0.0:
            slip = math.sqrt(rest if s.contact.corrections > 0 else slide)
            wanted = blocked[row] - slip if blocked[row] > 0.0 else OPEN
            d = solimp[0]
        else:
            s.contact.lift = max(s.contact.lift, lift)
            wanted -= lift
        positions[row] = -(2.0 * wanted - velocities[row]) / (_EXACT * h * d)
        margins[row] = 0.0
        solref = floats(contact + mj.contact_solref, 2)
        solref[0], solref[1] = -_EXACT * d * d, -d / h
        solref = floats(contact + mj.contact_solreffriction, 2)
        solref[0], solref[1] = 0.0, -d / (_EXACT * h)
        solimp[0] = solimp[1] = d


@compiled
def _slides(s: State, contact: int, has_ends: bool) -> tuple[float, float, float]:
    """Returns (μ|v_t|)² and, of the last solution, (μ|v_t⁺|)² and μ² v_t·v_t⁺, in m²/s²."""
    row, dim = ints(contact + s.mj.contact_row, 1)[0], ints(contact + s.mj.contact_dim, 1)[0]
    velocities = floats(pointer_at(s.mj.efc_vel), row + dim)
    ends = floats(s.contact.end_velocity, MAX_ROWS)
    friction = floats(contact + s.mj.contact_friction, 5)
    start = end = along = 0.0
    for j in range(1, dim):
        start += (friction[j - 1] * velocities[row + j]) ** 2
        if has_ends:
            end += (friction[j - 1] * ends[row + j]) ** 2
            along += friction[j - 1] ** 2 * velocities[row + j] * ends[row + j]
    return start, end, along


@compiled
def _slide_left(start: float, end: float, along: float, change: tuple[float, float]) -> float:
    """Returns the μ|v_t⁺| in m/s that a blow leaves, by the friction of its last solution.

    The impulse that changes v_n slows the sliding in proportion, while it goes on in its direction.
    Otherwise each repetition would keep κ/(1 + κ) of the error, κ = μ² J_t M⁻¹ J_tᵀ/(J_n M⁻¹ J_nᵀ):
    0.78 of a ball's at μ = 1.

    Args:
        start: (μ|v_t|)² in m²/s², as of ``_slides``.
        end: (μ|v_t⁺|)² of the last solution.
        along: μ² v_t·v_t⁺ of the last solution.
        change: Change of v_n in m/s that is wanted, and that of the last solution.
    """
    left = math.sqrt(end)
    if along <= 0.0 or change[1] <= 0.0:
        return left
    return max(left - max(math.sqrt(start) - left, 0.0) * (change[0] / change[1] - 1.0), 0.0)


@compiled
def _mobility(s: State, row: int) -> float:
    """Returns about J M⁻¹ Jᵀ of a row, with MuJoCo's ``dof_invweight0`` for M⁻¹."""
    mj, total = s.mj, 0.0
    weights = floats(s.contact.dof_invweight0, mj.nv)
    if s.contact.is_sparse:
        first = ints(pointer_at(mj.efc_J_rowadr), row + 1)[row]
        count = ints(pointer_at(mj.efc_J_rownnz), row + 1)[row]
        values = floats(pointer_at(mj.efc_J) + 8 * first, count)
        for k, dof in enumerate(ints(pointer_at(mj.efc_J_colind) + 4 * first, count)):
            total += values[k] ** 2 * weights[dof]
    else:
        for dof, value in enumerate(floats(pointer_at(mj.efc_J) + 8 * row * mj.nv, mj.nv)):
            total += value**2 * weights[dof]
    return total


@compiled
def _stiffness_over_inertia(s: State, contact: int, depth: float) -> float:
    """Returns K d²/(1 − d) in 1/s² of a contact's own ``solref`` and ``solimp`` at a depth in m."""
    solref = floats(contact + s.mj.contact_solref, 2)
    solimp = floats(contact + s.mj.contact_solimp, 5)
    start, last = min(max(solimp[0], 1e-4), 0.9999), min(max(solimp[1], 1e-4), 0.9999)
    middle, power = min(max(solimp[3], 1e-4), 0.9999), max(solimp[4], 1.0)
    part = min(depth / solimp[2], 1.0) if solimp[2] > 0.0 else 1.0
    if part <= middle:
        rise = part**power / middle ** (power - 1.0)
    else:
        rise = 1.0 - (1.0 - part) ** power / (1.0 - middle) ** (power - 1.0)
    d = start + rise * (last - start)
    stiffness = -solref[0] / last**2
    if solref[0] > 0.0:
        stiffness = 1.0 / (last * max(solref[0], 2.0 * s.run.timestep) * solref[1]) ** 2
    return float(stiffness * d**2 / (1.0 - d))


@compiled
def _blocked_mobility(s: State, contact: int) -> float:
    """Returns J_t M⁻¹ J_tᵀ of a blocked contact in penetration, 0 of one in a gap, −1 of others."""
    mj = s.mj
    weights, bodies = (
        floats(s.contact.body_invweight0, 2 * mj.nbody),
        ints(mj.geom_bodyid, mj.ngeom),
    )
    row, geoms = ints(contact + mj.contact_row, 1)[0], ints(contact + mj.contact_geoms, 2)
    if min(geoms[0], geoms[1]) < 0:  # of a flex
        return -1.0
    # without friction a contact may be slippery, not blocked
    sideways = _SLIGHT * (weights[2 * bodies[geoms[0]]] + weights[2 * bodies[geoms[1]]])
    for j in range(1, min(ints(contact + mj.contact_dim, 1)[0], 3)):  # those that slide
        sideways = max(sideways, _mobility(s, row + j))
    if _mobility(s, row) > BLOCKED * sideways:
        return -1.0
    return sideways if opening(s, contact) < 0.0 else 0.0


@compiled
def _note_blocked(s: State) -> None:
    """Notes the contacts along whose normal no joint can answer, and their h R N in m/s."""
    mj, h, contacts = s.mj, s.run.timestep, pointer_at(s.mj.contact)
    blocked = floats(s.contact.blocked, MAX_ROWS)
    weights, bodies = (
        floats(s.contact.body_invweight0, 2 * mj.nbody),
        ints(mj.geom_bodyid, mj.ngeom),
    )
    s.contact.pressing = 0
    for c in range(ints(mj.ncon, 1)[0]):
        contact = contacts + c * mj.contact_size
        row = ints(contact + mj.contact_row, 1)[0]
        if 0 <= row < MAX_ROWS:
            blocked[row] = _blocked_mobility(s, contact)
            s.contact.pressing += blocked[row] > 0.0
    for c in range(ints(mj.ncon, 1)[0] if s.contact.pressing else 0):
        contact = contacts + c * mj.contact_size
        row, geoms = ints(contact + mj.contact_row, 1)[0], ints(contact + mj.contact_geoms, 2)
        if 0 <= row < MAX_ROWS and blocked[row] > 0.0:
            approximate = weights[2 * bodies[geoms[0]]] + weights[2 * bodies[geoms[1]]]
            depth = -opening(s, contact)
            squared = max(floats(contact + mj.contact_friction, 1)[0] ** 2, SOFTNESS)
            regularisation = 4.0 * s.contact.pressing * squared * blocked[row]
            force = _stiffness_over_inertia(s, contact, depth) * depth / approximate
            blocked[row] = h * regularisation * force
            solimp = floats(contact + mj.contact_solimp, 1)
            solimp[0] = approximate / (approximate + 2.0 * regularisation)


@compiled
def _parameters_of(s: State, kind: int) -> tuple[int, int, int, int]:
    """Returns the addresses of ``solref`` and ``solimp`` of a kind of row, and of their copies."""
    contact = s.contact
    if kind == EQUALITY:
        return contact.eq_solref, contact.eq_solimp, contact.own_eq_solref, contact.own_eq_solimp
    if kind == LIMIT_JOINT:
        own = contact.own_jnt_solref, contact.own_jnt_solimp
        return contact.jnt_solref, contact.jnt_solimp, own[0], own[1]
    own = contact.own_tendon_solref_lim, contact.own_tendon_solimp_lim
    return contact.tendon_solref_lim, contact.tendon_solimp_lim, own[0], own[1]


@compiled
def _is_held(s: State, kind: int, i: int) -> bool:
    """Returns True for a row of a limit or of an equality constraint that is rigid."""
    if kind == EQUALITY:
        return bool(ints(s.contact.eq_type, i + 1)[i] <= LAST_RIGID)
    return bool(kind in (LIMIT_JOINT, LIMIT_TENDON))


@compiled
def _limit_margin(s: State, kind: int, i: int) -> float:
    """Returns the scene's own margin of a limit in m or rad, at which MuJoCo's limits rest."""
    if kind == LIMIT_JOINT:
        return float(floats(s.contact.own_jnt_margin, i + 1)[i])
    if kind == LIMIT_TENDON:
        return float(floats(s.contact.own_tendon_margin, i + 1)[i])
    return 0.0


@compiled
def _aim_rows(s: State) -> None:
    """Does for limits and equality constraints what ``_aim`` does for contacts.

    Their parameters are the model's, which has its own values again after the step.
    """
    mj, contact, h = s.mj, s.contact, s.run.timestep
    push, d = contact.push_ratio * DEPENETRATION, _IMPEDANCE
    count = min(ints(mj.nefc, 1)[0], contact.row_capacity)
    kinds, ids = ints(pointer_at(mj.efc_type), count), ints(pointer_at(mj.efc_id), count)
    velocities = floats(pointer_at(mj.efc_vel), count)
    positions = floats(pointer_at(mj.efc_pos), count)
    margins = floats(pointer_at(mj.efc_margin), count)
    own, shifts = floats(contact.row_positions, count), floats(contact.row_shifts, count)
    before = floats(mj.equality_before, s.energy.equality_rows)
    has_moved = s.energy.mocap_has_moved and ints(mj.ne, 1)[0] == s.energy.equality_rows
    if not contact.is_aimed:
        for row in range(count):
            own[row], shifts[row] = positions[row], 0.0
    for row in range(count):
        kind, i = kinds[row], ids[row]
        if not _is_held(s, kind, i):
            continue
        distance = own[row] - _limit_margin(s, kind, i)
        is_in_error = distance < 0.0 or kind == EQUALITY
        wanted = (-push if is_in_error else -1.0) * distance / h
        if kind == EQUALITY and has_moved:
            wanted -= (1.0 - contact.push_ratio) * (own[row] - before[row]) / h
        wanted -= shifts[row]
        rebound = _rebound(s, row) if kind != EQUALITY else NO_REBOUND
        if rebound >= 0.0:
            wanted = max(wanted, _softened(rebound, velocities[row]))
        positions[row] = -(2.0 * wanted - velocities[row]) / (_EXACT * h * d)
        margins[row] = 0.0
        place, impedances, _, _ = _parameters_of(s, kind)
        solref, solimp = floats(place + 16 * i, 2), floats(impedances + 40 * i, 2)
        solref[0], solref[1] = -_EXACT * d * d, -d / h
        solimp[0] = solimp[1] = d


@compiled
def _shift_rows(s: State) -> bool:
    """Notes the velocity beyond ŵ that MuJoCo aimed at in the step that just ended.

    MuJoCo wants −J̇v of the rows of ``connect`` and ``weld``, which then end at ŵ − h J̇v.

    Returns:
        True if there are such rows, and none of them was shifted before.
    """
    mj, contact, h = s.mj, s.contact, s.run.timestep
    count = min(ints(mj.nefc, 1)[0], contact.row_capacity)
    if contact.is_shifted or count == 0:
        return False
    kinds, ids = ints(pointer_at(mj.efc_type), count), ints(pointer_at(mj.efc_id), count)
    velocities = floats(pointer_at(mj.efc_vel), count)
    positions = floats(pointer_at(mj.efc_pos), count)
    reference = floats(pointer_at(mj.efc_aref), count)
    shifts, is_any_shifted = floats(contact.row_shifts, count), False
    for row in range(count):
        if kinds[row] == EQUALITY and ints(contact.eq_type, ids[row] + 1)[ids[row]] <= LAST_TURNING:
            wanted = 0.5 * (velocities[row] - positions[row] * _EXACT * h * _IMPEDANCE)
            shifts[row] = velocities[row] + h * reference[row] - wanted
            is_any_shifted = True
    contact.is_shifted = is_any_shifted
    return is_any_shifted


@compiled
def _restore_rows(s: State) -> None:
    mj, contact = s.mj, s.contact
    count = min(ints(mj.nefc, 1)[0], contact.row_capacity)
    kinds, ids = ints(pointer_at(mj.efc_type), count), ints(pointer_at(mj.efc_id), count)
    positions = floats(pointer_at(mj.efc_pos), count)
    own = floats(contact.row_positions, count)
    for row in range(count):
        kind, i = kinds[row], ids[row]
        if _is_held(s, kind, i):
            positions[row] = own[row]
            place, impedances, own_place, own_impedances = _parameters_of(s, kind)
            for target, source in (
                (floats(place + 16 * i, 2), floats(own_place + 16 * i, 2)),
                (floats(impedances + 40 * i, 2), floats(own_impedances + 40 * i, 2)),
            ):
                target[0], target[1] = source[0], source[1]


@compiled
def _unblock(s: State) -> bool:
    """Gives blocked contacts the law of the others; returns True if there were any with a force."""
    contact = s.contact
    if not contact.pressing:
        return False
    blocked = floats(contact.blocked, MAX_ROWS)
    blocked[:] = -1.0
    contact.pressing = 0
    ints(s.mj.enableflags, 1)[0] |= _EXACT_DIAGONAL
    return True


@compiled
def _may_blow(s: State) -> bool:
    """Returns True if a row may be a blow: one that closes fast, in a step of few enough rows."""
    count, is_any = ints(s.mj.nefc, 1)[0], s.energy.mocap_has_moved
    if count > MAX_ROWS:
        return False
    for velocity in floats(pointer_at(s.mj.efc_vel), count):
        is_any |= velocity < -BLOW_SPEED
    return bool(is_any)


@compiled
def _note_blows(s: State) -> None:
    """Notes the contacts and limits that close in a blow, and begins with their compression.

    What presses in the step is not known before its forces are; that of the last step will do.
    """
    mj, contact, h = s.mj, s.contact, s.run.timestep
    count, contacts = ints(mj.nefc, 1)[0], pointer_at(mj.contact)
    restitutions, blocked = floats(contact.restitutions, count), floats(contact.blocked, count)
    velocities, positions = floats(pointer_at(mj.efc_vel), count), pointer_at(mj.efc_pos)
    kinds, ids = ints(pointer_at(mj.efc_type), count), ints(pointer_at(mj.efc_id), count)
    rebounds, free = floats(contact.rebounds, count), floats(contact.pressings, count)
    mj_mul_jac(mj.model, mj.data, contact.pressings, contact.qacc_smooth)
    for row in range(count):
        kind, i, restitutions[row], rebounds[row] = kinds[row], ids[row], 0.0, NO_REBOUND
        if kind in (LIMIT_JOINT, LIMIT_TENDON) and row < contact.row_capacity:
            gap = floats(positions, count)[row] - _limit_margin(s, kind, i)
            if gap + h * (velocities[row] + h * min(free[row], 0.0)) <= 0.0:
                solref = _parameters_of(s, kind)[2] + 16 * i
                _note_blow(contact, row, gap, velocities[row], solref)
    for c in range(ints(mj.ncon, 1)[0]):
        one = contacts + c * mj.contact_size
        row = ints(one + mj.contact_row, 1)[0]
        if 0 <= row < count and blocked[row] < 0.0:
            gap = opening(s, one)
            moved = opened_by_mocap(s, one) if s.energy.mocap_has_moved else 0.0
            if gap + h * (velocities[row] + h * min(free[row], 0.0)) <= 0.0:
                solref = one + mj.contact_solref
                _note_blow(contact, row, gap - moved, velocities[row] + moved / h, solref)


@compiled
def _note_blow(contact: Part, row: int, gap: float, velocity: float, solref: int) -> None:
    """Notes e, −v_n and the gap at the start of a row that closes, if it is a blow."""
    numbers = floats(solref, 2)
    e = rigid_restitution(numbers[0], numbers[1]) if velocity < -BLOW_SPEED else 0.0
    floats(contact.restitutions, row + 1)[row] = e
    if e > 0.0:
        floats(contact.approaches, row + 1)[row] = -velocity
        floats(contact.gaps, row + 1)[row] = max(gap, 0.0)
        floats(contact.rebounds, row + 1)[row] = 0.0
        contact.blow_stage = COMPRESSION


@compiled
def _begin_restitution(s: State) -> None:
    """Notes the impulses of the compression that just ended, and aims at the rebounds."""
    mj, contact, h = s.mj, s.contact, s.run.timestep
    count = ints(mj.nefc, 1)[0]
    impulses, allowed = floats(contact.impulses, count), floats(contact.returnable, count)
    gaps, pressings = floats(contact.gaps, count), floats(contact.pressings, count)
    restitutions, rebounds = floats(contact.restitutions, count), floats(contact.rebounds, count)
    approaches, force = (
        floats(contact.approaches, count),
        floats(pointer_at(mj.efc_force), count),
    )
    note_ends(s)
    mj_mul_jac(mj.model, mj.data, contact.pressings, contact.qacc_smooth)
    contact.blow_stage = contact.corrections = contact.cuts = 0
    for row in range(count):
        if rebounds[row] < 0.0:
            continue
        e, speed, free = restitutions[row], approaches[row], pressings[row]
        impulses[row], pressings[row] = h * force[row], max(-free, 0.0)
        allowed[row] = e * impulses[row] * speed / max(speed - h * free, BLOW_SPEED)
        way = rebound_speed(e, speed, gaps[row], pressings[row], h)
        rebounds[row] = way if way > 0.0 else NO_REBOUND
        if way > 0.0:
            contact.blow_stage, contact.rebound_ratio = RESTITUTION, 1.0


@compiled
def _cut_rebounds(s: State) -> bool:
    """Lowers rebounds with an impulse beyond Poisson's; returns True if there were any.

    The impulse is P_c at ŵ = 0, and grows in proportion to ŵ while friction stays as it is.
    """
    contact, h, is_any = s.contact, s.run.timestep, False
    if contact.cuts >= MAX_CORRECTIONS or contact.paid > 1.0:
        return False
    count = ints(s.mj.nefc, 1)[0]
    impulses, allowed = floats(contact.impulses, count), floats(contact.returnable, count)
    rebounds, force = floats(contact.rebounds, count), floats(pointer_at(s.mj.efc_force), count)
    for row in range(count):
        beyond = h * force[row] - impulses[row]
        if rebounds[row] > 0.0 and beyond > (1.0 + REBOUND_ERROR) * allowed[row]:
            rebounds[row] *= allowed[row] / beyond
            is_any = True
    contact.cuts += is_any
    return is_any


@compiled
def _rebound(s: State, row: int) -> float:
    """Returns the normal velocity in m/s at which a blow's row is aimed, negative if it is none."""
    if s.contact.blow_stage == 0:
        return NO_REBOUND
    rebound = float(floats(s.contact.rebounds, row + 1)[row])
    return s.contact.rebound_ratio * rebound if rebound > 0.0 else rebound


@compiled
def _softened(end: float, start: float) -> float:
    """Returns the ŵ in m/s with which a row ends at a velocity in spite of its regularisation."""
    return end + 0.5 * SOFTNESS * (end - start)


@compiled
def _lower_rebound(contact: Part, allowed: float, returned: float) -> None:
    """Lowers ρ of a step that returned more energy than is allowed, in J.

    The energy that one blow with e returns over ½‖v⁺ − v‖²_M is 2e/(1 + e). Below
    ``NOTABLE_BOUNCE`` the rebound ends.
    """
    ratio = contact.rebound_ratio
    part = max(allowed, 0.0) / returned * 2.0 * ratio / (1.0 + ratio)
    ratio = min(part / (2.0 - part), MAX_CUT * ratio**2)
    contact.rebound_ratio = ratio if ratio >= NOTABLE_BOUNCE else 0.0
    if contact.rebound_ratio == 0.0:
        contact.corrections = contact.blow_stage = 0


@compiled
def aim_contacts(s: State) -> None:
    """Makes contacts, limits and equality constraints of the coming ``mj_step2`` rigid.

    Needs the velocity stage.
    """
    contact = s.contact
    if contact.is_rigid and ints(s.mj.nefc, 1)[0] > 0:
        has_energy = _spendable(s) > 0.0 or s.energy.mocap_has_moved
        contact.push_ratio = 1.0 if has_energy else 0.0
        contact.corrections = contact.is_shifted = contact.is_aimed = 0
        contact.rebound_ratio, contact.blow_stage = 0.0, 0
        ints(contact.solver, 1)[0] = contact.own_solver
        _note_blocked(s)
        if contact.pressing:
            ints(s.mj.enableflags, 1)[0] &= ~_EXACT_DIAGONAL
        if contact.bounces and _may_blow(s):
            _note_blows(s)
        _aim(s)
        contact.is_aimed = 1


@compiled
def _change_solver(s: State) -> bool:
    """Chooses the other solver, from a cold start, if the step that just ended did not converge.

    In a jam at a friction of 1 and more, Newton's method may stop early or go round in circles with
    forces of 1e8 N, where conjugate gradients converge in 50 iterations.

    Returns:
        True if it did, at most once in a step.
    """
    mj, contact, solver = s.mj, s.contact, ints(s.contact.solver, 1)
    if solver[0] != contact.own_solver:
        return False
    worst, islands = 0.0, max(ints(mj.nisland, 1)[0], 1)
    for island, iterations in enumerate(ints(mj.solver_niter, min(islands, 20))):
        if iterations > 0:
            last = island * _MAX_KEPT + min(iterations, _MAX_KEPT) - 1
            worst = max(worst, floats(contact.statistics + last * _STATISTIC + _GRADIENT, 1)[0])
    if worst <= contact.stalled:
        return False
    solver[0] = _CG if solver[0] == _NEWTON else _NEWTON
    start = floats(contact.warmstart, mj.nv)
    for i in range(mj.nv):
        start[i] = 0.0
    return True


@compiled
def _spendable(s: State) -> float:
    return float(SPENDABLE * (s.contact.tank - RESERVE) / s.run.substeps)


@compiled
def returned_energy(s: State) -> float:
    """Returns C, the energy in J that rigid constraints gave in the step that just ended.

    In a blow, what friction losses of joints and tendons gave counts, too: MuJoCo aims them at a
    share of the velocity at the start, which the blow has reversed or slowed.
    """
    mj, h = s.mj, s.run.timestep
    count = ints(mj.nefc, 1)[0]
    force = floats(pointer_at(mj.efc_force), count)
    velocities = floats(pointer_at(mj.efc_vel), count)
    reference = floats(pointer_at(mj.efc_aref), count)
    regularisation = floats(pointer_at(mj.efc_R), count)
    kinds, ids = ints(pointer_at(mj.efc_type), count), ints(pointer_at(mj.efc_id), count)
    total = 0.0
    for i in range(count):
        if kinds[i] > LIMIT_TENDON or _is_held(s, kinds[i], ids[i]):
            end = velocities[i] + h * (reference[i] - regularisation[i] * force[i])
            total += h * force[i] * end
        elif s.contact.blow_stage == RESTITUTION and kinds[i] != EQUALITY:
            end = velocities[i] + h * (reference[i] - regularisation[i] * force[i])
            total += max(h * force[i] * end, 0.0)
    return total


@compiled
def note_ends(s: State) -> None:
    """Notes each row's velocity at the end of the step, J v⁺, against surfaces that move."""
    mj = s.mj
    mj_mul_jac(mj.model, mj.data, s.contact.end_velocity, mj.qvel)
    if not mj.has_belts:
        return
    ends, contacts = floats(s.contact.end_velocity, MAX_ROWS), pointer_at(mj.contact)
    for c in range(ints(mj.ncon, 1)[0]):
        one = contacts + c * mj.contact_size
        row = ints(one + mj.contact_row, 1)[0]
        velocity = floats(one + mj.contact_surface_velocity, 3)
        for j in range(min(ints(one + mj.contact_dim, 1)[0] - 1, 3) if row >= 0 else 0):
            ends[row + 1 + j] += velocity[j]


@compiled
def restitution_of(s: State, row: int, speed: float, end: float) -> tuple[float, float]:
    """Returns e that a contact asks for in a blow, and the e that it had at the surface.

    Its velocities are ``speed``, −v_n > 0 at the start of the step, and v_n at its ``end``, in m/s.
    """
    contact, h = s.contact, s.run.timestep
    asked = float(floats(contact.restitutions, row + 1)[row]) if contact.bounces else 0.0
    if asked == 0.0 or end <= 0.0:
        return asked, max(end / speed, 0.0)
    gap, pressing = floats(contact.gaps, row + 1)[row], floats(contact.pressings, row + 1)[row]
    before = square_at_surface(speed, gap, pressing, h)
    return asked, math.sqrt(square_at_surface(end, gap, pressing, h) / before)


@compiled
def _has_sunk(s: State) -> bool:
    """Returns True if a contact sank in the step because it slid less than at the start.

    A blow must end with its rebound, whose lift is not known before either.
    """
    mj, h, contact = s.mj, s.run.timestep, s.contact
    count = ints(mj.nefc, 1)[0]
    is_smooth = h * contact.lift <= SUNK and contact.blow_stage == 0
    if is_smooth or count > MAX_ROWS:
        return False
    note_ends(s)
    ends, contacts = floats(contact.end_velocity, count), pointer_at(mj.contact)
    force = floats(pointer_at(mj.efc_force), count)
    approaches, e = floats(contact.approaches, count), floats(contact.restitutions, count)
    for c in range(ints(mj.ncon, 1)[0]):
        one = contacts + c * mj.contact_size
        row = ints(one + mj.contact_row, 1)[0]
        if row < 0 or ints(one + mj.contact_dim, 1)[0] == 1:
            continue
        rebound = _rebound(s, row)
        if rebound >= 0.0:
            speed = rebound
            if rebound == 0.0:  # the impulse of the compression bounds the rebound to come
                speed = e[row] * approaches[row]
            if s.energy.mocap_has_moved:
                rebound -= opened_by_mocap(s, one) / h
            error = abs(ends[row] - rebound) if force[row] > 0.0 else rebound - ends[row]
            if error > REBOUND_ERROR * speed:
                return True
            continue
        gap = max(opening(s, one), 0.0)
        if gap + h * ends[row] < -SUNK:
            return True
    return False


@compiled
def _misses_force(s: State) -> bool:
    """Returns True if a blocked contact pressed with another force than its N in the step."""
    mj, h, contact = s.mj, s.run.timestep, s.contact
    count = ints(mj.nefc, 1)[0]
    if not contact.pressing or count > MAX_ROWS:
        return False
    note_ends(s)
    ends, contacts = floats(contact.end_velocity, count), pointer_at(mj.contact)
    blocked, positions = floats(contact.blocked, MAX_ROWS), floats(pointer_at(mj.efc_pos), count)
    velocities = floats(pointer_at(mj.efc_vel), count)
    for c in range(ints(mj.ncon, 1)[0]):
        one = contacts + c * mj.contact_size
        row = ints(one + mj.contact_row, 1)[0]
        if row < 0 or blocked[row] <= 0.0:
            continue
        friction, slip = floats(one + mj.contact_friction, 5), 0.0
        for j in range(1, ints(one + mj.contact_dim, 1)[0]):
            slip += (friction[j - 1] * ends[row + j]) ** 2
        d = floats(one + mj.contact_solimp, 1)[0]
        wanted = 0.5 * (velocities[row] - positions[row] * _EXACT * h * d)
        if abs(wanted + math.sqrt(slip) - blocked[row]) > FORCE_ERROR * blocked[row]:
            return True
    return False


@compiled
def _corrects(s: State) -> bool:
    """Returns True if a contact sank or pressed otherwise than it should, or a blow goes on."""
    contact = s.contact
    if contact.corrections < MAX_CORRECTIONS and (_has_sunk(s) or _misses_force(s)):
        contact.corrections += 1
        return True
    if contact.blow_stage == COMPRESSION:
        _begin_restitution(s)
        return True
    return bool(contact.blow_stage == RESTITUTION and _cut_rebounds(s))


@compiled
def aim_again(s: State) -> bool:
    """Corrects the step that just ended: a solution that converges, less sinking, or less push.

    Contacts that sank aim higher. If the step spent more than the tank allows, the share is lower.

    Returns:
        True if it did; the step must then be repeated.
    """
    contact = s.contact
    if not contact.is_aimed:
        return False
    if _change_solver(s):
        contact.repetitions += 1
        return True
    if _corrects(s):
        contact.repetitions += 1
        _aim(s)
        return True
    allowed, returned = max(_spendable(s), 0.0), returned_energy(s)
    if s.energy.mocap_has_moved:
        allowed += mocap_work(s)  # the external port pays for it
    is_blow = contact.blow_stage == RESTITUTION
    if is_blow:
        allowed += contact.paid * kinetic_loss(s)
    if returned <= allowed or not (
        _unblock(s) or _shift_rows(s) or contact.push_ratio > 0.0 or is_blow
    ):
        return False
    if is_blow and contact.push_ratio == 0.0:
        _lower_rebound(contact, allowed, returned)
    # C is nearly proportional to the share while the forces stay; a second excess ends it
    is_first = contact.push_ratio == 1.0 and allowed > 0.0 and not is_blow
    contact.push_ratio = SPENDABLE * allowed / returned if is_first else 0.0
    contact.repetitions += 1
    _aim(s)
    return True


@compiled
def finish_contacts(s: State) -> None:
    """Counts the contacts with a force, and restores positions and the model's parameters."""
    mj = s.mj
    if s.contact.is_aimed and s.contact.row_capacity > 0:
        _restore_rows(s)
    if s.contact.is_aimed and s.contact.pressing:
        ints(mj.enableflags, 1)[0] |= _EXACT_DIAGONAL
    s.contact.is_aimed = 0
    ints(s.contact.solver, 1)[0] = s.contact.own_solver
    count = ints(mj.nefc, 1)[0]
    positions = floats(pointer_at(mj.efc_pos), count)
    force = floats(pointer_at(mj.efc_force), count)
    s.contact.active_contacts = 0
    contacts = pointer_at(mj.contact)
    for c in range(ints(mj.ncon, 1)[0]):
        contact = contacts + c * mj.contact_size
        row = ints(contact + mj.contact_row, 1)[0]
        if row >= 0:
            positions[row] = floats(contact + mj.contact_distance, 1)[0]
            s.contact.active_contacts += force[row] > 0.0


@compiled
def fill_tank(s: State, taken: float) -> None:
    """Adds the energy that the environment dissipated in the tick; takes what it created.

    ``taken`` is energy in J of the tick that pays for something else (``kernel.impact_pulse``).
    """
    contact, created = s.contact, s.energy.environment_energy
    if not contact.is_rigid:
        return
    contact.tank = min(contact.tank - (created - contact.last_energy) - taken, contact.cap)
    contact.last_energy = created
