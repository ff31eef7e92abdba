"""Observation of a scene's contacts, constraint rows and energies during a motion."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.check.rehearsal import not_finite, rehearsal_parameters
from hapticbridge.coupling import Coupling
from hapticbridge.jit import direct
from hapticbridge.kernel.codes import OK
from hapticbridge.kernel.state import Binding
from hapticbridge.kernel.step import after_step, before_step
from hapticbridge.ledger import Ledger
from hapticbridge.scene import Scene

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

LEAST_FORCE = 0.05
"""Normal force in N above which a contact's stiffness is kept; a smaller force is not felt."""

POSTURES = 100
"""Approximate number of postures kept; a motion of 8 s passes a hole in more than two of them."""

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
            K; inf if no contact carried ``LEAST_FORCE``.
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
        rows: Number of constraint rows in each tick, by kind.
        force: Norm of the force on the tool in each tick, in N.
        full_ticks: Number of ticks in which the solver stopped at its iteration limit.
        warnings: Number of MuJoCo's warnings by text.
        environment: ``strict``, ``within slack`` or ``active``.
        slack_share: Largest share of the slack that was used, without unit.
    """

    meetings: dict[tuple[int, int], Meeting]
    postures: NDArray[np.float64]
    rows: dict[str, NDArray[np.int64]]
    force: NDArray[np.float64]
    full_ticks: int
    warnings: dict[str, int] = field(default_factory=dict)
    environment: str = "strict"
    slack_share: float = 0.0


def observe(
    scene: Scene,
    samples: NDArray[np.void],
    coupling: Coupling,
    period: float,
    progress: Callable[[int, int], None] | None = None,
) -> Observation:
    """Leads a scene through a motion, as ``rehearse`` does, and inspects every step.

    Arguments are those of ``rehearse``; ``progress`` is called with the number of ticks done and
    the total.

    Raises:
        SceneError: A value is out of range, or a result is not finite; the message names the tick.
    """
    binding = Binding(scene.model, scene.data, rehearsal_parameters(scene, coupling, period))
    model, data, state, row = scene.model, scene.data, binding.state, binding.row
    before = direct(before_step, state, samples[:1], row, 0, period)
    after = direct(after_step, state, row, 0)
    meetings: dict[tuple[int, int], Meeting] = {}
    types = np.zeros((samples.size, len(_TYPE.__members__)), np.int64)
    postures, every = [], max(samples.size // POSTURES, 1)
    force, full = np.zeros(samples.size), 0
    for k in range(samples.size):
        if before(state, samples[k : k + 1], row, 0, period) != OK:
            raise not_finite(scene, k, samples.size)
        mujoco.mj_step(model, data)
        if after(state, row, 0) != OK:
            raise not_finite(scene, k, samples.size)
        if data.nefc:
            counted = np.bincount(data.efc_type)
            types[k, : counted.size] = counted
        if data.ncon:
            _note_contacts(data, model.opt.timestep, meetings)
        iterations = data.solver_niter[: max(data.nisland, 1)]
        full += bool(data.nefc) and bool(iterations.max(initial=0) >= model.opt.iterations)
        force[k] = float(np.linalg.norm(row["wrench_on_tool"][0, :3]))
        if k % every == 0:
            postures.append(data.qpos.copy())
        if progress is not None and k % PROGRESS_EVERY == 0:
            progress(k, samples.size)
    ledger = Ledger.of(state)
    return Observation(
        meetings=meetings,
        postures=np.array(postures),
        rows={kind: types[:, list(those)].sum(axis=1) for kind, those in ROW_KINDS.items()},
        force=force,
        full_ticks=full,
        warnings=_warnings(data),
        environment=ledger.environment,
        slack_share=ledger.slack_share,
    )


@contextmanager
def quiet() -> Iterator[None]:
    """Suppresses MuJoCo's printed warnings and its file MUJOCO_LOG.TXT; counters still count."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda _message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


def _note_contacts(
    data: mujoco.MjData, step: float, meetings: dict[tuple[int, int], Meeting]
) -> None:
    """Adds the contacts of one step.

    A row's force at rest is a_ref/R. Under ``discrete`` both are divided by one number, which makes
    the row's own spring and damper implicit in the step h:

        a_ref = −(b v + k d r)/(1 + h b + h² k d),    R = (1 − d)/d A/(1 + h b + h² k d),

    with depth −r, velocity v, MuJoCo's k and b of the row, its impedance d at that depth, and the
    contact's true inertia 1/A. Its stiffness is therefore f/r = k d/(R (1 + h b + h² k d)). With a
    pyramidal cone, 2 (dim − 1) rows share the normal force; together they are as stiff as one row
    with that many times the inertia.
    """
    contacts, rows = data.contact, data.efc_type
    addresses, dims, depths = contacts.efc_address.tolist(), contacts.dim, (-contacts.dist).tolist()
    seen = set()
    for k, (one, other) in enumerate(contacts.geom.tolist()):
        adr = addresses[k]
        if min(one, other) < 0 or adr < 0:  # a flex, or outside the active distance
            continue
        pair = min(one, other), max(one, other)
        meeting = meetings.setdefault(pair, Meeting())
        if pair not in seen:
            seen.add(pair)
            meeting.ticks += 1
        count = 2 * (int(dims[k]) - 1) if rows[adr] == _PYRAMIDAL else 1
        normal = float(data.efc_force[adr : adr + count].sum())
        meeting.deepest = max(meeting.deepest, depths[k])
        meeting.force = max(meeting.force, normal)
        if normal >= LEAST_FORCE:
            spring, damper, impedance, _ = data.efc_KBIP[adr].tolist()
            spring *= impedance
            regular = float(data.efc_R[adr]) * (1.0 + step * damper + step**2 * spring)
            stiffness = count * spring / regular
            inertia = count * (1.0 - impedance) / (impedance * regular)
            meeting.inertia = min(meeting.inertia, inertia)
            meeting.softest = min(meeting.softest, stiffness)
            meeting.stiffest = max(meeting.stiffest, stiffness)


def _warnings(data: mujoco.MjData) -> dict[str, int]:
    return {
        str(mujoco.mju_warningText(kind, warning.lastinfo)): int(warning.number)
        for kind, warning in enumerate(data.warning)
        if warning.number
    }
