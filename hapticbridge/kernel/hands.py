"""The tick of several hands in one scene.

Each hand has a state of its own (``state.STATE_DTYPE``): device, handle, coupling, force level,
guard and account. All states are bound to one model and its data; the first one meters the scene,
and has its rigid contacts and their tank. With n hands

    E_k = S_k − S_{k−1} − Σ_i (f_i·δx_i + τ_i·δφ_i) − W_actuators − W_external

and the slack is the sum of the hands' slacks. MuJoCo solves all couplings in one step, so two hands
may hold one body. A hand that reaches its force level changes the step of the others; therefore no
wrench is evaluated before the levels of all hands are settled (``force_level.settle_levels``). For
each device, the other hands are ports of the scene: energy that another hand put in may reach it.

Valid for a coupling that MuJoCo solves whole, with one step per tick (``Scheme.IMPLICIT``). The
stages have the signatures of the stages in ``kernel.tick``, because one loop calls both. The number
of the substep is 0, and no positions are computed ahead.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hapticbridge.jit import compiled, compiled_for_threads
from hapticbridge.kernel.codes import BAD_RESULT, HAND_CODES, OK, RING_FULL
from hapticbridge.kernel.explicit_bias import take_back
from hapticbridge.kernel.force_level import (
    keep_state,
    settle_levels,
    settled_wrench,
    spend_within_tank,
)
from hapticbridge.kernel.handle import place_handle
from hapticbridge.kernel.law import command_handle_velocity, slack_of_step
from hapticbridge.kernel.ledger import (
    add_coupling_work,
    add_slack,
    add_up_hands,
    end_mocap_moves,
    judge_balance,
    meter_ports,
    refresh_energies,
)
from hapticbridge.kernel.rigid_contact import fill_tank, finish_contacts, follow_speed
from hapticbridge.kernel.tick import (
    active_contacts,
    advance,
    end_tick,
    keep_wrench,
    publish,
    refuse_tick,
    send_wrench,
    set_external_flags,
    take_sample,
)
from hapticbridge.kernel.timing import note_delay
from hapticbridge.pose import dot


@compiled
def before_hands(
    states: NDArray[np.void],
    samples: NDArray[np.void],
    rows: NDArray[np.void],
    _substep: int,
    elapsed: float,
) -> int:
    """Moves every handle by its device's sample, and gives MuJoCo the controls of its next step.

    Args:
        states: The bound states, one per hand, in order.
        samples: One device sample per hand.
        rows: The bound records.
        elapsed: Time since the previous samples in s.

    Returns:
        As ``tick.before_step``, for the first hand that is refused, plus ``HAND_CODES`` times its
        number. The run must end then: the hands before it have moved.
    """
    for i in range(states.size):
        code = take_sample(states[i], samples[i : i + 1], rows[i : i + 1], elapsed)
        if code != OK:
            return code + HAND_CODES * i
    for i in range(states.size):
        command_handle_velocity(states[i], place_handle(states[i], 0))
    if states[0].level.is_solved:
        keep_state(states[0])
    return OK


@compiled
def answer_hands(states: NDArray[np.void], rows: NDArray[np.void], _substep: int) -> int:
    """Computes the wrenches of the step that just ended, on all tools and devices.

    Returns:
        As ``tick.answer_step``, with the hand as ``before_hands`` has it. Unless it is ``OK``, the
        wrench on every device is zero.
    """
    scene = states[0]
    spend_within_tank(scene)
    if scene.contact.is_rigid:
        follow_speed(scene)
    meter_ports(scene)
    settle_levels(states)
    for i in range(states.size):
        force, torque, moved, turned = settled_wrench(states[i])
        work = dot(force, moved) + dot(torque, turned)
        keep_wrench(states[i], work, force, torque, moved, turned)
    end_mocap_moves(scene)
    if scene.contact.is_rigid:
        finish_contacts(scene)
    contacts, code = active_contacts(scene), OK
    for i in range(states.size):
        sent = send_wrench(states[i], rows[i : i + 1], contacts)
        if code == OK and sent != OK:
            code = sent + HAND_CODES * i
    if code != OK:
        for i in range(states.size):
            refuse_tick(states[i])
    return code


@compiled
def close_hands(states: NDArray[np.void], rows: NDArray[np.void]) -> int:
    """Closes the balance of all hands and completes their records, after the wrenches were sent.

    Returns:
        ``OK`` or ``BAD_RESULT``; with the latter zero force must be sent to every device.
    """
    refresh_energies(states[0])
    for i in range(states.size):
        add_coupling_work(states[i].energy, states[i].loop.law_work)
        add_slack(states[i].energy, slack_of_step(states[i]))
    add_up_hands(states)
    if take_back(states[0], states[0].mj.qvel, 0.0):
        add_up_hands(states)
    is_finite = True
    for i in range(states.size):
        is_finite = judge_balance(states[i]) and is_finite
    if not is_finite:
        for i in range(states.size):
            refuse_tick(states[i])
        return BAD_RESULT
    fill_tank(states[0])
    for i in range(states.size):
        end_tick(states[i], rows[i : i + 1])
        rows[i].contact_tank = rows[0].contact_tank
    return OK


@compiled
def finish_hands(
    states: NDArray[np.void],
    rows: NDArray[np.void],
    ring: NDArray[np.void],
    cursors: NDArray[np.int64],
    deadline_ns: int,
    wake_ns: int,
    read_ns: int,
    write_ns: int,
    flags: int,
    _has_positions: bool,
) -> int:
    """Runs ``close_hands`` and ``tick.publish`` in one call.

    Returns:
        The result of ``close_hands``, or ``RING_FULL``; with the latter, repeat ``tick.publish``.
    """
    code = close_hands(states, rows)
    if code != OK:
        return code
    for i in range(states.size):
        note_delay(states[i], deadline_ns, read_ns, write_ns)
        rows[i].flags |= states[i].loop.external_flags
    taken = publish(rows, ring, cursors, deadline_ns, wake_ns, read_ns, write_ns, flags)
    return OK if taken else RING_FULL


@compiled
def whole_tick_of_hands(
    states: NDArray[np.void], samples: NDArray[np.void], rows: NDArray[np.void], elapsed: float
) -> bool:
    """Runs one tick of all hands, as ``tick.whole_tick`` does for one.

    Returns:
        False if a sample was refused or a result is not usable.
    """
    if before_hands(states, samples, rows, 0, elapsed) != OK:
        return False
    advance(states[0:1])
    return answer_hands(states, rows, 0) == OK and close_hands(states, rows) == OK


@compiled_for_threads
def simulate_hands(
    states: NDArray[np.void],
    samples: NDArray[np.void],
    external_flags: NDArray[np.int64],
    elapsed: NDArray[np.float64],
    own: NDArray[np.void],
    rows: NDArray[np.void],
) -> int:
    """Runs the ticks of a recorded run of several hands, as ``tick.simulate_recorded`` for one.

    Args:
        states: The bound states.
        samples: Device samples by tick and hand, (n, m).
        external_flags: ``STALE_SAMPLE`` as recorded, (n, m).
        elapsed: Time between two samples in s, one per tick.
        own: The bound records.
        rows: Receives the records, (n, m).

    Returns:
        Count of completed ticks.
    """
    for k in range(samples.shape[0]):
        for i in range(states.size):
            set_external_flags(states[i].loop, external_flags[k, i])
        if not whole_tick_of_hands(states, samples[k], own, elapsed[k]):
            return k
        for i in range(states.size):
            rows[k, i] = own[i]
    return int(samples.shape[0])
