"""Energy that MuJoCo's explicit bias creates, taken back from the motion before a tick is metered.

MuJoCo takes the bias c (Coriolis and gyroscopic forces in N, N m) at the positions q and the
velocity u of the step's start. With v⁺, q⁺, M⁺ = M(q⁺) at its end and h its time step,

    E_k = [½ v⁺ᵀ (M⁺ − M) v⁺ − h v⁺ᵀc(q, u)] − ½ ‖v⁺ − u‖²_M + C + r

C is what contacts give (``kernel.rigid_contact``), r that of positions which change in the step.
The true bias does no work, vᵀ(Ṁv/2 − c) = 0, but the bracket is of the order h² v⁴. A free body
has v⁺ = u − h M⁻¹c and uᵀc = 0, so that E_k = ½ h² cᵀM⁻¹c > 0 in each step. If Σ E_k exceeds half
of the verdict's tolerance, the velocity is corrected before the storage is metered:

1. The bias acts at the mean of both velocities in each tree on which no constraint acts,

       v = v⁺ + (h/2) M⁺⁻¹ [c(q⁺, u) − c(q⁺, v⁺)]

   which makes a free turn of second order. With substeps, a tick that needed it lets the next one
   do so in every substep.
2. What is still too much is taken from the motion relative to the centre of mass of a tree that
   begins with a free joint, v ← v̄ + s (v − v̄), and from the whole motion of any other, v ← s v.
   The linear momentum of a free tree stays. Trees share the loss by the weight
   (kinetic energy)·(sum of joint speeds)², in proportion to h² v⁴.

The second alone would keep the energy and falsify the turn: 0.37 of the angular velocity after
0.3 s at 50 rad/s, which errs by 0.10 without a correction and by 0.001 with both. A run that
creates nothing stays as it is to the bit.

References:
    Simo & Wong 1991 (midpoint rule for rotations).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hapticbridge.kernel.codes import State
from hapticbridge.kernel.jit import compiled
from hapticbridge.kernel.ledger import (
    allowed_energy,
    created_energy,
    note_excess,
    refresh_inertia,
    set_kinetic_energy,
)
from hapticbridge.kernel.mujoco_c import (
    floats,
    ints,
    mj_com_vel,
    mj_factor_m,
    mj_mul_m,
    mj_rne,
    mj_solve_m,
)
from hapticbridge.kernel.pose import dot, vector_of

MAX_SHARE = 0.99
"""Largest share of a tree's kinetic energy that one tick takes, without unit. The rest waits for
the next tick. With 0.5, an arm that flails at 1000 rad/s gains more than it loses."""


@compiled
def write_bias(s: State, velocity: int, result: int) -> None:
    """Writes c(q_k, v) for a velocity at an address; MuJoCo's own velocity is left unchanged."""
    mj = s.mj
    qvel, other, saved = (
        floats(mj.qvel, mj.nv),
        floats(velocity, mj.nv),
        floats(mj.scratch, mj.nv),
    )
    for i in range(mj.nv):
        saved[i] = qvel[i]
        qvel[i] = other[i]
    mj_com_vel(mj.model, mj.data)
    mj_rne(mj.model, mj.data, np.int32(0), result)
    for i in range(mj.nv):
        qvel[i] = saved[i]


@compiled
def _excess(s: State, pending: float) -> float:
    """Returns the energy in J to be taken back; a contact of the scene's own is left alone.

    Such a contact stores energy that MuJoCo does not report, and may create some. Beside it, only
    energy of this tick is taken back, and none while it acts.
    """
    energy = s.energy
    created = created_energy(energy) + s.impact.taken - pending
    excess = created - 0.5 * allowed_energy(energy)
    if energy.is_constrained:
        return 0.0
    if not s.contact.is_rigid:
        excess = min(excess, created - energy.environment_energy)
    return float(excess)


@compiled
def take_back(s: State, velocity: int, pending: float) -> bool:
    """Takes back the energy that the step which just ended created without a contact.

    Needs inertia matrix and energies of the end of the step.

    Args:
        s: The bound state.
        velocity: Address of the velocity of the kinetic energy. MuJoCo's own changes by as much.
        pending: The coupling's work in this step in J, if it is not in its sum yet.

    Returns:
        True if the velocity was changed.
    """
    mj = s.mj
    if not mj.is_discrete:
        return False
    excess = _excess(s, pending)
    note_excess(s.energy, excess > 0.0)
    if not excess > 0.0:
        return False
    if velocity == mj.qvel:
        _take_mean_bias(s)
        set_kinetic_energy(s.energy, _kinetic(s))
        excess = _excess(s, pending)
        if not excess > 0.0:
            return True
    _slow_down(s, velocity, excess)
    return True


@compiled
def _take_mean_bias(s: State) -> None:
    """Lets the bias act at its mean over the step, in trees on which no constraint acts."""
    mj, nv = s.mj, s.mj.nv
    if not s.loop.has_positions:
        mj_factor_m(mj.model, mj.data)
    start = mj.scratch + 8 * nv
    at_start, at_end = start + 8 * nv, start + 16 * nv
    velocities, accelerations = floats(mj.qvel, nv), floats(mj.qacc, nv)
    before = floats(start, nv)
    for i in range(nv):
        before[i] = velocities[i] - s.run.timestep * accelerations[i]
    write_bias(s, start, at_start)
    write_bias(s, mj.qvel, at_end)
    early, late = floats(at_start, nv), floats(at_end, nv)
    for i in range(nv):
        early[i] -= late[i]
    mj_solve_m(mj.model, mj.data, start, at_start, np.int32(1))
    change, constraint = floats(start, nv), floats(mj.qfrc_constraint, nv)
    firsts, counts = ints(mj.tree_dofadr, mj.ntree), ints(mj.tree_dofnum, mj.ntree)
    for tree in range(mj.ntree):
        end, is_held = firsts[tree] + counts[tree], False
        for i in range(firsts[tree], end):
            is_held = is_held or constraint[i] != 0.0
        if not is_held:
            for i in range(firsts[tree], end):
                velocities[i] += 0.5 * s.run.timestep * change[i]


@compiled
def _kinetic(s: State) -> float:
    mj, total = s.mj, 0.0
    mj_mul_m(mj.model, mj.data, mj.scratch, mj.qvel)
    velocities, momentum = floats(mj.qvel, mj.nv), floats(mj.scratch, mj.nv)
    for i in range(mj.nv):
        total += 0.5 * velocities[i] * momentum[i]
    return float(total)


@compiled
def take_mean_bias_in_substep(s: State) -> None:
    """Does the first correction after a substep, if the last tick needed one."""
    if s.energy.has_excess:
        refresh_inertia(s)
        _take_mean_bias(s)


@compiled
def _energy_of_turning(s: State, tree: int, speeds: NDArray[np.float64]) -> tuple[float, float]:
    """Returns a tree's kinetic energy in J that may be taken, and the sum of its joint speeds.

    Needs the momentum in the scratch.
    """
    mj = s.mj
    momentum, turns = floats(mj.scratch, mj.nv), ints(mj.dof_turns, mj.nv)
    first = ints(mj.tree_dofadr, mj.ntree)[tree]
    kinetic, turning = 0.0, 0.0
    for i in range(first, first + ints(mj.tree_dofnum, mj.ntree)[tree]):
        kinetic += 0.5 * momentum[i] * speeds[i]
        turning += abs(speeds[i]) * turns[i]
    mass = floats(mj.tree_mass, mj.ntree)[tree]
    if mass > 0.0:
        linear = vector_of(momentum[first : first + 3])
        kinetic -= 0.5 * dot(linear, linear) / mass
    return max(kinetic, 0.0), turning


@compiled
def _slow_down(s: State, velocity: int, excess: float) -> None:
    """Takes energy in J from the trees, and notes what could be taken."""
    mj, nv = s.mj, s.mj.nv
    mj_mul_m(mj.model, mj.data, mj.scratch, velocity)
    speeds, own, momentum = floats(velocity, nv), floats(mj.qvel, nv), floats(mj.scratch, nv)
    masses, firsts = floats(mj.tree_mass, mj.ntree), ints(mj.tree_dofadr, mj.ntree)
    total = 0.0
    for tree in range(mj.ntree):
        kinetic, turning = _energy_of_turning(s, tree, speeds)
        total += kinetic * turning * turning
    for tree in range(mj.ntree):
        kinetic, turning = _energy_of_turning(s, tree, speeds)
        weight = kinetic * turning * turning
        if not weight > 0.0:
            continue
        taken = min(excess * weight / total, MAX_SHARE * kinetic)
        loss = 1.0 - math.sqrt(1.0 - taken / kinetic)
        first = firsts[tree]
        for i in range(first, first + ints(mj.tree_dofnum, mj.ntree)[tree]):
            mean = momentum[i] / masses[tree] if i < first + 3 and masses[tree] > 0.0 else 0.0
            change = loss * (speeds[i] - mean)
            speeds[i] -= change
            if velocity != mj.qvel:
                own[i] -= change
        set_kinetic_energy(s.energy, s.energy.kinetic - taken)
