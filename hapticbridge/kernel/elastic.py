"""Elastic energy of flexes, which MuJoCo's own potential energy lacks.

    U(q) = −∫ Q·dq,    V_U = max(U, 0)

Q is the generalised force of the flexes' elasticity at rest, from a second model without any other
spring; q are the positions, from those of the model, where U = 0. The way of a step is straight,
and two points of Gauss's quadrature take its integral: it is exact where Q is a cubic polynomial,
as for stretched elements whose vertices slide. Yielded strains and the frames of twisted rods
(MuJoCo's ``plastic``) are those of the step's start, which its force has. What yielding burns stays
in U.

U depends on the end of the way alone, except with ``dof="trilinear"`` or ``"quadratic"``: there
MuJoCo's force is not the gradient of an energy. Round a closed way such a flex takes energy, or
gives it.

What a flex gives below U = 0 it never stored, and it counts as created. The bending of a curved
flex is such a force: its energy has no lower bound once the edges give way.
"""

from __future__ import annotations

import copy

import mujoco
import numpy as np

from hapticbridge.kernel.codes import Part, State
from hapticbridge.kernel.jit import compiled
from hapticbridge.kernel.mujoco_c import (
    addresses,
    floats,
    mj_differentiate_pos,
    mj_fwd_kinematics,
    mj_integrate_pos,
    mj_passive,
)

ELASTIC_DTYPE = np.dtype(
    [
        ("model", "<i8"),
        ("data", "<i8"),
        ("rest", "<i8"),
        ("last", "<i8"),
        ("way", "<i8"),
        ("trial", "<i8"),
        ("force", "<i8"),
        ("plastic", "<i8"),
        ("stored", "<f8"),
    ]
)
"""Sub-record ``elastic``: U in J, and addresses: the second model and its data, its positions, its
elastic force and plastic state, the model's positions, those up to which U is known, and the way
from there. ``model`` is 0 without an elastic flex."""

_GAUSS = (0.5 - 0.5 / 3.0**0.5, 0.5 + 0.5 / 3.0**0.5)

PARTS = 256
"""Parts of the way from the model's positions to those of a start. That of a step is one part. The
bending of a rod that starts folded by 170 degrees is then right to 1e-8 of it; fewer parts could
give it the wrong sign."""


def has_elastic_flex(model: mujoco.MjModel) -> bool:
    """Returns True if the elasticity of a flex does work."""
    is_off = model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_SPRING
    return not is_off and bool(np.any(model.flex_stiffness) or np.any(model.flex_bending))


def bind_elastic(elastic: Part, model: mujoco.MjModel) -> tuple[object, ...]:
    """Writes the addresses, if a flex is elastic; returns what must outlive the state."""
    if not has_elastic_flex(model):
        return ()
    alone = copy.copy(model)
    for springs in (alone.jnt_stiffness, alone.tendon_stiffness):
        springs[:] = 0.0
    for springs in (alone.jnt_stiffnesspoly, alone.tendon_stiffnesspoly):
        springs[:] = 0.0
    trial = mujoco.MjData(alone)
    arrays = {
        "rest": alone.qpos0,
        "last": np.zeros(model.nq),
        "way": np.zeros(model.nv),
        "trial": trial.qpos,
        "force": trial.qfrc_spring,
        "plastic": trial.plastic,
    }
    elastic["model"], elastic["data"] = addresses(alone, trial)
    for name, array in arrays.items():
        elastic[name] = array.ctypes.data
    return alone, trial, arrays


@compiled
def start_elastic(s: State) -> None:
    """Computes U at the present positions, without a way from others."""
    if s.elastic.model:
        _copy(s.elastic.rest, s.elastic.last, s.mj.nq)
        _copy(s.mj.plastic, s.elastic.plastic, s.mj.nplastic)
        s.elastic.stored = 0.0
        _add_way(s, PARTS)


@compiled
def follow_elastic(s: State) -> None:
    """Adds to U what the way to the present positions did, which must be short."""
    if s.elastic.model:
        _add_way(s, 1)


@compiled
def elastic_energy(s: State) -> float:
    """Returns V_U in J, the part of U that was stored."""
    return float(max(s.elastic.stored, 0.0))


def unstored_energy(s: State) -> float:
    """Returns the energy in J that the flexes gave without having stored it, max(−U, 0)."""
    return max(-float(s["elastic"]["stored"]), 0.0)


@compiled
def _add_way(s: State, parts: int) -> None:
    """Adds −∫ Q·dq to U, from the positions up to which it is known to the present ones."""
    mj, elastic = s.mj, s.elastic
    mj_differentiate_pos(mj.model, elastic.way, 1.0, elastic.last, mj.qpos)
    way, force = floats(elastic.way, mj.nv), floats(elastic.force, mj.nv)
    work = 0.0
    for part in range(parts):
        for share in _GAUSS:
            _copy(elastic.last, elastic.trial, mj.nq)
            mj_integrate_pos(mj.model, elastic.trial, elastic.way, (part + share) / parts)
            mj_fwd_kinematics(elastic.model, elastic.data)
            mj_passive(elastic.model, elastic.data)
            for i in range(mj.nv):
                work += force[i] * way[i]
    elastic.stored -= 0.5 * work / parts
    _copy(mj.qpos, elastic.last, mj.nq)
    _copy(mj.plastic, elastic.plastic, mj.nplastic)


@compiled
def _copy(source: int, target: int, count: int) -> None:
    values, copied = floats(source, count), floats(target, count)
    for i in range(count):
        copied[i] = values[i]
