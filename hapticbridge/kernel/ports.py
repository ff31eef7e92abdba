"""Work that enters the environment in one MuJoCo step through ports other than the coupling.

MuJoCo's ``discrete`` step solves M (v⁺ − v)/h = f(q, v) − … in the positions and Jacobians of its
start, and moves by h v⁺. The work of a generalised force Q in that step is therefore h Q · v⁺, with
the Q that the step really used: for a stiff servo that is its force at the end of the step, not
``actuator_force``, which is the one at the start.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hapticbridge.jit import compiled
from hapticbridge.kernel.mocap import mocap_work
from hapticbridge.kernel.native import floats, ints, mj_apply_ft, pointer_at


@compiled
def moment_dot(state: NDArray[np.void], output: int, vector_address: int) -> float:
    """Returns one row of the actuator moment times a vector over the degrees of freedom."""
    s = state[0]
    nnz = ints(s.moment_rownnz, output + 1)[output]
    adr = ints(s.moment_rowadr, output + 1)[output]
    columns = ints(s.moment_colind, adr + nnz)
    moment = floats(s.actuator_moment, adr + nnz)
    vector = floats(vector_address, s.nv)
    total = 0.0
    for i in range(adr, adr + nnz):
        total += moment[i] * vector[columns[i]]
    return total


@compiled
def _actuator_work(state: NDArray[np.void]) -> float:
    """Work of the scene's own actuators: h Σ (F − k h m·v − (h²k_p + h k_v) m·a) m·v⁺.

    F is the force at the start, m the moment, a = (v⁺ − v)/h. The two corrections take F to the
    end of the step; MuJoCo keeps them in ``efm_ak`` = h k_p and ``efm_as`` = h² k_p + h k_v for the
    actuators in its effective metric. ``qfrc_actuator`` is used for the sum because it has the
    limits of joints applied; the coupling's share is taken out again.
    """
    s = state[0]
    h = s.timestep
    qvel, force = floats(s.qvel, s.nv), floats(s.qfrc_actuator, s.nv)
    power = 0.0
    for i in range(s.nv):
        power += force[i] * qvel[i]
    first = s.coupling_output_adr
    forces = floats(s.actuator_force, first + 6)
    for output in range(first, first + 6):
        power -= forces[output] * moment_dot(state, output, s.qvel)
    count = ints(s.nefmA, 1)[0]
    if count > 0:
        ids = ints(pointer_at(s.efm_aid), count)
        scales = floats(pointer_at(s.efm_as), count)
        stiffnesses = floats(pointer_at(s.efm_ak), count)
        for k in range(count):
            actuator = ids[k]
            if s.coupling_actuator_id <= actuator < s.coupling_actuator_id + 6:
                continue
            adr = ints(s.outadr, actuator + 1)[actuator]
            num = ints(s.outnum, actuator + 1)[actuator]
            for output in range(adr, adr + num):
                end = moment_dot(state, output, s.qvel)
                change = moment_dot(state, output, s.qacc)
                power -= (stiffnesses[k] * (end - h * change) + scales[k] * change) * end
    return float(h * power)


@compiled
def add_body_wrenches(state: NDArray[np.void], result: int, clears: bool = False) -> bool:
    """Adds ``xfrc_applied``, as generalised forces at the positions as they are, to an address.

    Args:
        state: The bound state.
        result: Address of a number per degree of freedom.
        clears: Whether to clear these first, where a body is loaded.

    Returns:
        Whether a body is loaded; else nothing was written.
    """
    s = state[0]
    wrenches = floats(s.xfrc_applied, 6 * s.nbody)
    found = False
    for body in range(1, s.nbody):
        is_loaded = False
        for i in range(6 * body, 6 * body + 6):
            is_loaded = is_loaded or wrenches[i] != 0.0
        if is_loaded:
            if clears and not found:
                floats(result, s.nv)[:] = 0.0
            found = True
            force = s.xfrc_applied + 48 * body
            mj_apply_ft(
                s.model, s.data, force, force + 24, s.xipos + 24 * body, np.int32(body), result
            )
    return found


@compiled
def _applied_work(state: NDArray[np.void]) -> float:
    """Work of ``qfrc_applied``, ``xfrc_applied`` and passive gravity compensation."""
    s = state[0]
    nv = s.nv
    qvel, applied = floats(s.qvel, nv), floats(s.qfrc_applied, nv)
    power = 0.0
    for i in range(nv):
        power += applied[i] * qvel[i]
    if s.has_gravity_compensation:
        compensation, is_passive = (
            floats(s.qfrc_gravcomp, nv),
            floats(s.passive_gravcomp_dofs, nv),
        )
        for i in range(nv):
            power += compensation[i] * is_passive[i] * qvel[i]
    # positions are still those of the step's start, where MuJoCo applied the wrenches
    if add_body_wrenches(state, s.scratch, clears=True):
        generalised = floats(s.scratch, nv)
        for i in range(nv):
            power += generalised[i] * qvel[i]
    return float(s.timestep * power)


@compiled
def meter_ports(state: NDArray[np.void]) -> None:
    """Adds the work of the step that just ended to the actuator and the external port.

    Must run before kinematics are refreshed: moments, Jacobians and points of attack are those of
    the step's start, as the step used them.
    """
    s = state[0]
    if s.has_actuators:
        s.actuator_work += _actuator_work(state)
    s.external_work += _applied_work(state)
    if s.mocap_has_moved:
        s.external_work += mocap_work(state)
        s.mocap_has_moved = 0
