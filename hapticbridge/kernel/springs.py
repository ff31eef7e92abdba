"""Springs and dampers of the tool's tree at the midpoint, beside a lossless coupling.

MuJoCo takes the forces of joints and tendons at the end of the step, which is of first order. The
implicit midpoint rule takes

    F_k = ½ (S_{k−1} + S_k) + D_k

with S the springs' force at the positions q, and D the dampers' at the step's velocity
u_k = (q_k − q_{k−1})/T. As with the coupling, half of F_k acts in step k, the rest in step k + 1:

    step k        ¼ S_{k−1} + Q_k,    Q_k ≈ ¼ S_k + ½ D_k
    step k + 1    R_k = F_k − ¼ S_{k−1} − Q_k

MuJoCo solves Q_k if the model has a quarter of the stiffness and half of the damping. Its lever
arms are those of the step's start; R_k makes up for it. The model has these shares from the start
of a lossless step until its energy is taken, and the scene's own values at all other times.
"""

from __future__ import annotations

from collections.abc import Mapping

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.kernel.codes import Part, State
from hapticbridge.kernel.jit import compiled
from hapticbridge.kernel.mujoco_c import (
    field_address,
    floats,
    ints,
    mj_fwd_velocity,
    mj_passive,
    pointer_at,
)

STIFFNESS_SHARE, DAMPING_SHARE = 0.25, 0.5
"""Shares of the scene's stiffness and damping that MuJoCo solves in a lossless step; no unit."""

_FIELDS = (
    ("jnt_stiffness", STIFFNESS_SHARE),
    ("jnt_stiffnesspoly", STIFFNESS_SHARE),
    ("tendon_stiffness", STIFFNESS_SHARE),
    ("tendon_stiffnesspoly", STIFFNESS_SHARE),
    ("dof_damping", DAMPING_SHARE),
    ("dof_dampingpoly", DAMPING_SHARE),
    ("tendon_damping", DAMPING_SHARE),
    ("tendon_dampingpoly", DAMPING_SHARE),
)
"""Fields of the model, and the share that a lossless step leaves in them."""

_DATA_FIELDS = ("efm_active", "efm_c", "efm_diag", "nefmT", "efm_tid", "efm_ts")
_TENDON_ARRAYS = ("ten_J", "ten_J_rownnz", "ten_J_rowadr", "ten_J_colind")

SPRINGS_DTYPE = np.dtype(
    [
        ("count", "<i8"),
        ("is_shared", "<i8"),
        ("has_tendon_dampers", "<i8"),
        ("qfrc_spring", "<i8"),
        ("qfrc_damper", "<i8"),
        ("spring_addresses", "<i8"),
        ("spring_shares", "<i8"),
        ("spring_values", "<i8"),
        ("spring_before", "<i8"),
        ("solved", "<i8"),
        ("rest", "<i8"),
        ("damper_at_start", "<i8"),
        *((name, "<i8") for name in _DATA_FIELDS + _TENDON_ARRAYS),
    ]
)
"""Sub-record ``springs``, written by this module alone. ``count`` numbers of the model describe the
tree's springs and dampers, 0 without any; ``is_shared`` is 1 while the model has their shares. Then
addresses: of MuJoCo's forces, of each number's address, share and own value, and of S_{k−1}."""


def bind_springs(
    springs: Part,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    chosen: Mapping[str, NDArray[np.bool_]],
) -> dict[str, NDArray[np.generic]]:
    """Fills in the springs and dampers; returns the arrays that must outlive the state.

    Args:
        springs: The sub-record.
        model: The prepared scene.
        data: Its data.
        chosen: True for each joint, degree of freedom and tendon of the tool's tree, under
            ``jnt``, ``dof`` and ``tendon``.
    """
    places, shares, are_used = [], [], False
    for name, share in _FIELDS:
        array = getattr(model, name)
        for index in np.flatnonzero(chosen[name.split("_")[0]]):
            row = array[index : index + 1]
            places += [row.ctypes.data + 8 * i for i in range(row.size)]
            shares += [share] * row.size
            are_used = are_used or bool(np.any(row))
    count = len(places) if are_used else 0
    owned: dict[str, NDArray[np.generic]] = {
        "spring_addresses": np.array(places, np.int64),
        "spring_shares": np.array(shares, np.float64),
        "spring_values": np.zeros(len(places)),
        "spring_before": np.zeros(max(model.nv, 1)),
        "solved": np.zeros(max(model.nv, 1)),
        "rest": np.zeros(max(model.nv, 1)),
        "damper_at_start": np.zeros(max(model.nv, 1)),
    }
    for name, array in owned.items():
        springs[name] = array.ctypes.data
    springs["count"] = count
    damped = np.column_stack([model.tendon_damping, model.tendon_dampingpoly])[chosen["tendon"]]
    springs["has_tendon_dampers"] = bool(np.any(damped))
    springs["qfrc_spring"] = data.qfrc_spring.ctypes.data
    springs["qfrc_damper"] = data.qfrc_damper.ctypes.data
    for name in _DATA_FIELDS:
        springs[name] = field_address(data, name)
    springs["ten_J"] = data.ten_J.ctypes.data
    for name in _TENDON_ARRAYS[1:]:
        springs[name] = getattr(model, name).ctypes.data
    return owned


@compiled
def apply_shares(s: State) -> None:
    """Leaves their shares in the model, before the position stage of a lossless step."""
    springs = s.springs
    if springs.count == 0 or springs.is_shared:
        return
    springs.is_shared = 1
    shares, values = (
        floats(springs.spring_shares, springs.count),
        floats(springs.spring_values, springs.count),
    )
    for i in range(springs.count):
        number = floats(pointer_at(springs.spring_addresses + 8 * i), 1)
        values[i] = number[0]
        number[0] *= shares[i]


@compiled
def restore_springs(s: State) -> None:
    """Puts the scene's own values back into the model."""
    springs = s.springs
    if not springs.is_shared:
        return
    springs.is_shared = 0
    values = floats(springs.spring_values, springs.count)
    for i in range(springs.count):
        floats(pointer_at(springs.spring_addresses + 8 * i), 1)[0] = values[i]


@compiled
def note_solved(s: State) -> None:
    """Notes Q_k, the force that MuJoCo's step has solved; must run before anything is refreshed.

    MuJoCo keeps the corrections from the step's start to its end as terms of its effective inertia:
    ``efm_diag`` of joints, ``efm_ts`` of tendons, and ``efm_c`` for the velocity at the start.
    """
    mj, springs = s.mj, s.springs
    if springs.count == 0:
        return
    nv = mj.nv
    solved = floats(springs.solved, nv)
    spring, damper = floats(springs.qfrc_spring, nv), floats(springs.qfrc_damper, nv)
    for i in range(nv):
        solved[i] = spring[i] + damper[i]
    _add_corrections(s)
    if springs.has_tendon_dampers:
        mj_fwd_velocity(mj.model, mj.data)
        at_start = floats(springs.damper_at_start, nv)
        for i in range(nv):
            at_start[i] = damper[i] / DAMPING_SHARE


@compiled
def _add_corrections(s: State) -> None:
    """Adds to Q_k the change of the forces from the start of MuJoCo's step to its end."""
    springs, nv = s.springs, s.mj.nv
    if ints(springs.efm_active, 1)[0] == 0:
        return
    solved, qacc = floats(springs.solved, nv), floats(s.mj.qacc, nv)
    shift, diagonal = (
        floats(pointer_at(springs.efm_c), nv),
        floats(pointer_at(springs.efm_diag), nv),
    )
    for i in range(nv):
        solved[i] += shift[i] - diagonal[i] * qacc[i]
    count = ints(springs.nefmT, 1)[0]
    ids, scales = ints(pointer_at(springs.efm_tid), count), pointer_at(springs.efm_ts)
    for tendon in ids:
        start = ints(springs.ten_J_rowadr, tendon + 1)[tendon]
        end = start + ints(springs.ten_J_rownnz, tendon + 1)[tendon]
        columns, arms = ints(springs.ten_J_colind, end), floats(springs.ten_J, end)
        stretched = 0.0
        for i in range(start, end):
            stretched += arms[i] * qacc[columns[i]]
        stretched *= floats(scales + 8 * tendon, 1)[0]
        for i in range(start, end):
            solved[columns[i]] -= arms[i] * stretched


@compiled
def evaluate_passive(s: State) -> None:
    """Evaluates all passive forces at the state after the step."""
    mj = s.mj
    if s.springs.has_tendon_dampers:  # MuJoCo has the tendons' velocities at the step's start
        mj_fwd_velocity(mj.model, mj.data)
    else:
        mj_passive(mj.model, mj.data)


@compiled
def begin_springs(s: State) -> None:
    """Takes the present forces as those of the midpoint, before the first lossless step."""
    springs, nv = s.springs, s.mj.nv
    if springs.count == 0:
        return
    spring, damper = floats(springs.qfrc_spring, nv), floats(springs.qfrc_damper, nv)
    rest = floats(springs.rest, nv)
    for i in range(nv):
        rest[i] = 0.5 * (spring[i] + damper[i])


@compiled
def note_rest(s: State) -> None:
    """Notes R_k; needs the passive forces at the state after the step."""
    springs, nv = s.springs, s.mj.nv
    if springs.count == 0:
        return
    spring, before = floats(springs.qfrc_spring, nv), floats(springs.spring_before, nv)
    damper, rest = floats(springs.qfrc_damper, nv), floats(springs.rest, nv)
    solved, at_start = floats(springs.solved, nv), floats(springs.damper_at_start, nv)
    for i in range(nv):
        mean = 0.5 * (damper[i] + at_start[i]) if springs.has_tendon_dampers else damper[i]
        rest[i] = 0.5 * spring[i] + 0.25 * before[i] + mean - solved[i]


@compiled
def add_rest(s: State, force: NDArray[np.float64]) -> None:
    """Turns S_k + D_k in a sum of forces into 2 R_k."""
    springs, nv = s.springs, s.mj.nv
    if springs.count == 0:
        return
    spring, damper = floats(springs.qfrc_spring, nv), floats(springs.qfrc_damper, nv)
    rest = floats(springs.rest, nv)
    for i in range(nv):
        force[i] += 2.0 * rest[i] - spring[i] - damper[i]


@compiled
def carry_springs(s: State, force: NDArray[np.float64], in_tree: NDArray[np.int32]) -> None:
    """Adds R_k + ¼ S_k, which acts in the next step beside the shares in the model."""
    springs, nv = s.springs, s.mj.nv
    if springs.count == 0:
        return
    spring, before = floats(springs.qfrc_spring, nv), floats(springs.spring_before, nv)
    rest = floats(springs.rest, nv)
    for i in range(nv):
        force[i] += in_tree[i] * (rest[i] + 0.25 * spring[i])
        before[i] = spring[i]
