"""The tick after MuJoCo's step, in two parts: the wrench first, then the books.

What the device waits for is only the grip's new pose. Energies, ledger and record need more of
MuJoCo and can wait until the wrench is out (``kernel.ahead``).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hapticbridge.jit import compiled
from hapticbridge.kernel.ahead import is_sound
from hapticbridge.kernel.codes import BAD_RESULT, CONTACT, LARGEST_CONTROL, MIDPOINT, OK, TRIP
from hapticbridge.kernel.lossless import finish_lossless
from hapticbridge.kernel.meter import add_coupling_work, judge_environment, refresh_energies
from hapticbridge.kernel.native import has_warned, ints
from hapticbridge.kernel.ports import meter_ports
from hapticbridge.kernel.scheme import DIRECT, HELD, LOSSLESS
from hapticbridge.kernel.wrench import render, wrench_of_step
from hapticbridge.pose import (
    add,
    dot,
    norm,
    quaternion_of,
    scaled,
    store_quaternion,
    store_vector,
    vector_of,
)


@compiled
def answer_step(state: NDArray[np.void], row: NDArray[np.void], substep: int) -> int:
    """Computes the wrench of the step that just ended; after the last substep, the device's.

    With several laws a tick the wrench is their mean: the handle moves uniformly within a tick, so
    the mean does on it the work that the single ones did.

    Returns:
        ``OK`` or ``BAD_RESULT``; in the latter case the wrench on the device is zero.
    """
    s = state[0]
    if s.scheme != DIRECT:
        meter_ports(state)
    is_last = substep + 1 == s.substeps
    if s.laws == 1 and not is_last:
        return OK
    force, torque, moved, turned = wrench_of_step(state, substep, is_last)
    s.law_work = dot(force, moved) + dot(torque, turned)
    if s.laws > 1:
        share = 1.0 / s.laws
        force, torque = scaled(share, force), scaled(share, torque)
        if substep > 0:
            w, m = s.wrench_on_tool, s.motion
            force, torque = add(vector_of(w), force), add(vector_of(w[3:6]), torque)
            moved, turned = add(vector_of(m), moved), add(vector_of(m[3:6]), turned)
    store_vector(s.motion[0:3], moved)
    store_vector(s.motion[3:6], turned)
    store_vector(s.wrench_on_tool[0:3], force)
    store_vector(s.wrench_on_tool[3:6], torque)
    if not is_last:
        add_coupling_work(state, s.law_work)
        return OK
    s.flags = MIDPOINT if s.was_midpoint else 0
    s.lossless_ticks += s.was_midpoint
    square = dot(force, force) + dot(torque, torque)
    # MuJoCo ignores a control beyond its limit, so a wrench that is to be applied must stay below
    if (
        not math.isfinite(square)
        or (s.scheme == HELD and square > LARGEST_CONTROL * LARGEST_CONTROL)
        or has_warned(state)
    ):
        return _refuse(state)
    render(state, force, torque)
    if s.scheme != LOSSLESS:  # there a contact may be near without a force
        s.active_contacts = ints(s.ncon, 1)[0]
    if s.active_contacts > 0:
        s.flags |= CONTACT
    row[0].solver_iterations = _solver_iterations(state)
    return OK


@compiled
def close_tick(state: NDArray[np.void], row: NDArray[np.void], has_positions: bool) -> int:
    """Closes the tick's balance and completes its record; the wrench is out by then.

    Args:
        state: The bound state after ``answer_step``.
        row: The bound record.
        has_positions: Whether MuJoCo's position stage has run since the step (``kernel.ahead``).

    Returns:
        ``OK`` or ``BAD_RESULT``; in the latter case zero must be sent.
    """
    s = state[0]
    s.has_positions = has_positions
    if s.scheme != DIRECT:
        refresh_energies(state)
    if s.scheme == LOSSLESS:
        finish_lossless(state)
    add_coupling_work(state, s.law_work)
    judge_environment(state)
    if not math.isfinite(s.environment_energy):
        return _refuse(state)
    s.peak_force = max(s.peak_force, norm(vector_of(s.wrench_on_tool)))
    s.peak_torque = max(s.peak_torque, norm(vector_of(s.wrench_on_tool[3:6])))
    if has_positions and not is_sound(state):
        s.has_positions = 0
    _record(state, row)
    s.tick += 1
    return OK


@compiled
def _refuse(state: NDArray[np.void]) -> int:
    s = state[0]
    s.flags = TRIP
    for i in range(6):
        s.wrench_on_device[i] = 0.0
    return BAD_RESULT


@compiled
def _solver_iterations(state: NDArray[np.void]) -> int:
    s = state[0]
    # without islands MuJoCo counts its iterations as those of island 0
    islands = max(ints(s.nisland, 1)[0], 1)
    total = 0
    for iterations in ints(s.solver_niter, min(islands, 20)):
        total += iterations
    return total


@compiled
def _record(state: NDArray[np.void], row: NDArray[np.void]) -> None:
    """Copies what the tick computed into its record."""
    s, r = state[0], row[0]
    r.flags = s.flags
    r.contacts = s.active_contacts
    store_vector(r.tool_position, vector_of(s.tool_position))
    store_quaternion(r.tool_quaternion, quaternion_of(s.tool_quaternion))
    for i in range(6):
        r.wrench_on_tool[i] = s.wrench_on_tool[i]
        r.wrench_on_device[i] = s.wrench_on_device[i]
    r.kinetic, r.potential = s.kinetic, s.potential
    r.coupling_work, r.actuator_work = s.coupling_work, s.actuator_work
    r.external_work = s.external_work
    r.environment_energy, r.device_energy = s.environment_energy, s.device_energy
    r.injected_damping = s.injected_damping
    r.injected_rotational_damping = s.injected_rotational_damping
