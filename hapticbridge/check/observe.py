"""Observation of a scene's contacts, constraint rows and energies during a motion."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.demand.methods import RIGID
from hapticbridge.demand.rehearsal import RunPoint, rehearsal_parameters
from hapticbridge.errors import SceneError
from hapticbridge.kernel.codes import OK, WARNINGS, warning_words
from hapticbridge.kernel.elastic import unstored_energy
from hapticbridge.kernel.jit import direct
from hapticbridge.kernel.mujoco_c import warning_of
from hapticbridge.kernel.record import TICK_DTYPE
from hapticbridge.kernel.rigid_contact import DEPENETRATION, SOFTNESS
from hapticbridge.kernel.state import BoundKernel
from hapticbridge.kernel.tick import after_step, before_step, simulate
from hapticbridge.run.summary import Ledger
from hapticbridge.scene import Scene
from hapticbridge.scene.physics import (
    TendonWatch,
    WayJump,
    jump_behind,
    storing_flex,
    unstored_words,
)

# Clearance of the tool between opposite walls

FARTHEST = 2e-3
"""Distance in m beyond which two geoms do not form a clearance. Fits are tenths of it; anything
farther away belongs to another part of the scene."""

OPPOSITE = -0.95
"""Cosine between the directions to two walls below which they count as opposite; 18 degrees from
straight."""

WITHOUT_DISTANCE = (mujoco.mjtGeom.mjGEOM_HFIELD, mujoco.mjtGeom.mjGEOM_SDF)
"""Geom types without a distance function in MuJoCo."""

_NO_DIRECTION = 1e-9  # m; two points nearer than this have no direction between them


def clearances(
    model: mujoco.MjModel,
    pairs: list[tuple[int, int]],
    is_tool: NDArray[np.bool_],
    postures: NDArray[np.float64],
) -> dict[tuple[int, int], float]:
    """Returns the clearance per side between the tool and the geoms around it, in m.

    Between two geoms in opposite directions the tool can move by the sum of its distances from
    them; the clearance per side is half of it. Each pair of walls counts with its largest sum over
    all postures, because a tilted tool has less room. Each geom counts with its smallest clearance.

    Args:
        model: The compiled scene.
        pairs: Geoms that may collide; at least one of each pair belongs to the tool.
        is_tool: True for each geom of the tool.
        postures: ``qpos`` of each posture, shape (n, nq).

    Returns:
        Clearance by pair; pairs that form no clearance are absent.
    """
    data, segment = mujoco.MjData(model), np.zeros(6)
    known = ~np.isin(model.geom_type, WITHOUT_DISTANCE)
    candidates = np.array([p for p in pairs if known[list(p)].all()], np.int64).reshape(-1, 2)
    rooms: dict[tuple[tuple[int, int], tuple[int, int]], float] = {}
    for posture in postures:
        data.qpos[:] = posture
        mujoco.mj_kinematics(model, data)
        near: list[tuple[tuple[int, int], float, NDArray[np.float64]]] = []
        for first, second in candidates[may_be_near(data, candidates, FARTHEST)].tolist():
            distance = mujoco.mj_geomDistance(model, data, first, second, FARTHEST, segment)
            direction = segment[3:] - segment[:3]
            length = float(np.linalg.norm(direction))
            if distance >= FARTHEST or length < _NO_DIRECTION:
                continue
            away = direction / length * np.sign(distance) * (1 if is_tool[first] else -1)
            near.append(((first, second), distance, away))
        for k, (pair, distance, away) in enumerate(near):
            for other, there, towards in near[:k]:
                if float(away @ towards) < OPPOSITE:
                    both = (pair, other)
                    rooms[both] = max(rooms.get(both, 0.0), 0.5 * (distance + there))
    room_of: dict[tuple[int, int], float] = {}
    for both, room in rooms.items():
        for pair in both:
            if room > 0.0:
                room_of[pair] = min(room_of.get(pair, np.inf), room)
    return room_of


def may_be_near(
    data: mujoco.MjData, pairs: NDArray[np.int64], distance: float
) -> NDArray[np.bool_]:
    """Returns True for each pair of geoms with bounding spheres nearer than a distance in m."""
    first, second = pairs.T
    radius = data.model.geom_rbound
    reach = np.where(radius > 0.0, radius, np.inf)  # planes and height fields have no sphere
    apart = np.linalg.norm(data.geom_xpos[first] - data.geom_xpos[second], axis=1)
    return np.asarray(apart <= reach[first] + reach[second] + distance, dtype=bool)


# RunPoint of a scene under a motion

NOTABLE = 1.0
"""Energy in J from which on a flex that never stored it is the cause of a scene that diverges. A
hand puts in less in a motion of a check."""


@dataclass(frozen=True, slots=True, eq=False)
class Playback:
    """Result of a scene under a motion.

    Attributes:
        records: One per tick, ``TICK_DTYPE``; ``wrench_on_tool`` is the wrench that the hand would
            feel.
        environment: ``strict``, ``within slack`` or ``active``.
        slack_share: Largest share of the slack that was used, without unit.
        fault: Tick and port of the first fault, or None.
        warnings: Number of MuJoCo's warnings.
        seconds: Processor time of the run in s: MuJoCo's step and the bridge's arithmetic.
    """

    records: NDArray[np.void]
    environment: str
    slack_share: float
    fault: tuple[int, str] | None
    warnings: int
    seconds: float


def rehearse(scene: Scene, samples: NDArray[np.void], setting: RunPoint) -> Playback:
    """Runs the scene from its start as the bridge would, one tick per sample.

    The hand does not yield: the handle follows the motion at any force. Two versions of a scene can
    therefore be compared tick by tick.

    Args:
        scene: Changed in place: reset, with the coupling's gains and the time step set.
        samples: Poses relative to the first, ``SAMPLE_DTYPE``, from ``samples_of``.
        setting: Coupling and rate.

    Raises:
        SceneError: A value is out of range, or a result is not finite; the message names the tick.
    """
    binding = BoundKernel(scene.model, scene.data, rehearsal_parameters(scene, setting))
    rows = np.zeros(samples.size, TICK_DTYPE)
    start = time.thread_time()
    done = simulate(binding.state, samples, binding.row, rows)
    seconds = time.thread_time() - start
    if done < samples.size:
        raise not_finite(scene, done, samples.size)
    ledger = Ledger.from_state(binding.state)
    return Playback(
        records=rows,
        environment=ledger.environment,
        slack_share=ledger.slack_share,
        fault=ledger.fault,
        warnings=sum(int(warning.number) for warning in scene.data.warning),
        seconds=seconds,
    )


def not_finite(
    scene: Scene, tick: int, ticks: int, state: NDArray[np.void] | None = None
) -> SceneError:
    """Returns the error for a motion with a result that is not usable at a tick.

    With the bound state, it names a flex that gave energy which it never stored.
    """
    code = warning_of(scene.data)
    if code in WARNINGS:
        return SceneError(
            f"scene '{scene.name}', tick {tick} of {ticks} of the motion: {warning_words(code)}"
        )
    words = f"scene '{scene.name}' is not finite after tick {tick} of {ticks} of the motion"
    if state is not None and (given := unstored_energy(state[0])) > NOTABLE:
        change = storing_flex(scene.model, scene.model.opt.timestep)
        words += f"; {unstored_words(scene.model, given)}; {change}"
    return SceneError(words)


_TYPE = mujoco.mjtConstraint
ROW_KINDS: dict[str, tuple[int, ...]] = {
    "contact": (
        int(_TYPE.mjCNSTR_CONTACT_FRICTIONLESS),
        int(_TYPE.mjCNSTR_CONTACT_PYRAMIDAL),
        int(_TYPE.mjCNSTR_CONTACT_ELLIPTIC),
    ),
    "friction loss": (int(_TYPE.mjCNSTR_FRICTION_DOF), int(_TYPE.mjCNSTR_FRICTION_TENDON)),
    "limit": (int(_TYPE.mjCNSTR_LIMIT_JOINT), int(_TYPE.mjCNSTR_LIMIT_TENDON)),
    "equality": (int(_TYPE.mjCNSTR_EQUALITY),),
}
"""Kinds of constraint rows in the words of MJCF, and MuJoCo's types."""

_PYRAMIDAL = int(_TYPE.mjCNSTR_CONTACT_PYRAMIDAL)

MIN_FORCE = 0.05
"""Normal force in N above which a contact's stiffness is kept; a smaller force is not felt."""

POSTURES = 100
"""Approximate number of postures kept; a motion of 8 s passes a hole in more than two of them."""

MAX_WORK, MIN_TICKS = 2e6, 500
"""Largest work of an observation in degrees of freedom and constraint rows, summed over its ticks,
and the ticks that it always takes. A unit costs 3 to 7 µs. A scene of 400 is observed for 5 s, a
heavier one for less."""

PROGRESS_EVERY = 500
"""Ticks between two calls of ``progress``."""


@dataclass(slots=True)
class Meeting:
    """Contacts of two geoms over a motion.

    Attributes:
        ticks: Number of ticks in contact.
        deepest: Largest penetration in m; negative if they never overlapped.
        force: Largest normal force in N of one contact.
        inertia: Smallest effective inertia in kg at a contact, with the coupling's share h B' + h²
            K; inf if no contact carried ``MIN_FORCE``.
        softest: Smallest stiffness in N/m of such a contact; inf without one.
        stiffest: Largest stiffness in N/m of such a contact; 0 without one.
    """

    ticks: int = 0
    deepest: float = -np.inf
    force: float = 0.0
    inertia: float = np.inf
    softest: float = np.inf
    stiffest: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """Result of a motion.

    Attributes:
        meetings: Contacts by the ids of two geoms, the smaller first.
        postures: ``qpos`` at times spread over the motion, shape (n, nq).
        ticks_between_postures: Number of ticks from one of them to the next.
        rows: Number of constraint rows in each tick, by kind.
        force: Norm of the force on the tool in each tick, in N.
        full_ticks: Number of ticks in which the solver stopped at its iteration limit.
        warnings: Number of MuJoCo's warnings by text.
        environment: ``strict``, ``within slack`` or ``active``.
        slack_share: Largest share of the slack that was used, without unit.
        jump: Tendon whose jumps brought most of the energy created, by id, and its largest jump;
            None without one.
    """

    meetings: dict[tuple[int, int], Meeting]
    postures: NDArray[np.float64]
    ticks_between_postures: int
    rows: dict[str, NDArray[np.int64]]
    force: NDArray[np.float64]
    full_ticks: int
    warnings: dict[str, int] = field(default_factory=dict)
    environment: str = "strict"
    slack_share: float = 0.0
    jump: tuple[int, WayJump] | None = None


def observe(
    scene: Scene,
    samples: NDArray[np.void],
    setting: RunPoint,
    progress: Callable[[int, int], None] | None = None,
) -> Observation:
    """Leads a scene through a motion, as ``rehearse`` does, and inspects every step.

    Of a heavy scene it sees only the beginning (``MAX_WORK``). Arguments are those of ``rehearse``;
    ``progress`` is called with the number of ticks done and the total.

    Raises:
        SceneError: A value is out of range, or a result is not finite; the message names the tick.
    """
    period = setting.period
    binding = BoundKernel(scene.model, scene.data, rehearsal_parameters(scene, setting))
    model, data, state, row = scene.model, scene.data, binding.state, binding.row
    before = direct(before_step, state, samples[:1], row, 0, period)
    after, step = direct(after_step, state, row, 0), binding.step
    meetings: dict[tuple[int, int], Meeting] = {}
    types = np.zeros((samples.size, len(_TYPE.__members__)), np.int64)
    postures, every = [], max(samples.size // POSTURES, 1)
    force, full, work, done = np.zeros(samples.size), 0, 0, samples.size
    jumps, watch = list[dict[int, WayJump]](), TendonWatch(model)
    created, energy = np.zeros(samples.size + 1), state[0]["energy"]
    for k in range(samples.size):
        if work > MAX_WORK and k >= MIN_TICKS:
            done = k
            break
        if before(state, samples[k : k + 1], row, 0, period) != OK:
            raise not_finite(scene, k, samples.size, state)
        step(model, data)
        if after(state, row, 0) != OK:
            raise not_finite(scene, k, samples.size, state)
        work += model.nv + data.nefc
        if data.nefc:
            counted = np.bincount(data.efc_type)
            types[k, : counted.size] = counted
        if data.ncon:
            _note_contacts(data, model.opt.timestep, meetings, setting.contact == RIGID)
        jumps.append(watch.jumps(data))
        created[k + 1] = energy["environment_energy"]
        iterations = data.solver_niter[: max(data.nisland, 1)]
        full += bool(data.nefc) and bool(iterations.max(initial=0) >= model.opt.iterations)
        force[k] = float(np.linalg.norm(row["wrench_on_tool"][0, :3]))
        if k % every == 0:
            postures.append(data.qpos.copy())
        if progress is not None and k % PROGRESS_EVERY == 0:
            progress(k, samples.size)
    ledger = Ledger.from_state(state)
    found = jump_behind(jumps, np.diff(created[: done + 1]).clip(min=0.0))
    return Observation(
        meetings=meetings,
        postures=np.array(postures),
        ticks_between_postures=every,
        rows={kind: types[:done, list(those)].sum(axis=1) for kind, those in ROW_KINDS.items()},
        force=force[:done],
        full_ticks=full,
        warnings=_warnings(data),
        environment=ledger.environment,
        slack_share=ledger.slack_share,
        jump=found and (found[0], found[2]),
    )


def _note_contacts(
    data: mujoco.MjData,
    step: float,
    meetings: dict[tuple[int, int], Meeting],
    is_rigid: bool,
) -> None:
    """Adds the contacts of one step.

    A row's force at rest is a_ref/R. Under ``discrete`` both are divided by one number, which makes
    the row's own spring and damper implicit in the step h:

        a_ref = −(b v + k d r)/(1 + h b + h² k d),    R = (1 − d)/d A/(1 + h b + h² k d),

    with depth −r, velocity v, MuJoCo's k and b of the row, its impedance d at that depth, and the
    contact's true inertia 1/A. Its stiffness is therefore f/r = k d/(R (1 + h b + h² k d)). With a
    pyramidal cone, 2 (dim − 1) rows share the normal force; together they are as stiff as one row
    with that many times the inertia. A rigid contact of mass m has 2 m β/(h² SOFTNESS)
    (``kernel.rigid_contact``), and exists before it touches.
    """
    contacts, rows = data.contact, data.efc_type
    addresses, dims, depths = contacts.efc_address.tolist(), contacts.dim, (-contacts.dist).tolist()
    seen = set()
    for k, (one, other) in enumerate(contacts.geom.tolist()):
        adr = addresses[k]
        if min(one, other) < 0 or adr < 0:  # a flex, or outside the active distance
            continue
        pair = min(one, other), max(one, other)
        count = 2 * (int(dims[k]) - 1) if rows[adr] == _PYRAMIDAL else 1
        normal = float(data.efc_force[adr : adr + count].sum())
        if is_rigid and depths[k] < 0.0 and normal == 0.0:
            continue
        meeting = meetings.setdefault(pair, Meeting())
        if pair not in seen:
            seen.add(pair)
            meeting.ticks += 1
        meeting.deepest = max(meeting.deepest, depths[k])
        meeting.force = max(meeting.force, normal)
        if normal >= MIN_FORCE:
            spring, damper, impedance, _ = data.efc_KBIP[adr].tolist()
            spring *= impedance
            regular = float(data.efc_R[adr]) * (1.0 + step * damper + step**2 * spring)
            stiffness = count * spring / regular
            inertia = count * (1.0 - impedance) / (impedance * regular)
            if is_rigid:
                stiffness = 2.0 * inertia * DEPENETRATION / (SOFTNESS * step**2)
            meeting.inertia = min(meeting.inertia, inertia)
            meeting.softest = min(meeting.softest, stiffness)
            meeting.stiffest = max(meeting.stiffest, stiffness)


def _warnings(data: mujoco.MjData) -> dict[str, int]:
    return {
        str(mujoco.mju_warningText(kind, warning.lastinfo)): int(warning.number)
        for kind, warning in enumerate(data.warning)
        if warning.number
    }
