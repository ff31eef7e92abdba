"""The tick's arithmetic: before MuJoCo's step, and after it.

The live loop calls ``before_step``, MuJoCo through its Python bindings, ``after.answer_step``, and
once the wrench is out ``after.close_tick`` and ``publish.publish``. Compiled loops inline the same
functions around ``advance``, MuJoCo by its C symbol (``kernel.simulation``).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hapticbridge.jit import compiled
from hapticbridge.kernel.account import keep_account
from hapticbridge.kernel.after import answer_step, close_tick
from hapticbridge.kernel.ahead import take_handle_in
from hapticbridge.kernel.codes import BAD_SAMPLE, HALF_DONE, OK
from hapticbridge.kernel.direct import place_tool
from hapticbridge.kernel.handle import handle_pose
from hapticbridge.kernel.lossless import apply_carried
from hapticbridge.kernel.mocap import note_moved_mocap_bodies
from hapticbridge.kernel.native import floats, mj_fwd_position, mj_step
from hapticbridge.kernel.scheme import DIRECT, HELD, LOSSLESS
from hapticbridge.kernel.tuning import retune
from hapticbridge.kernel.watch import DEVICE_BUTTONS, follow, refused
from hapticbridge.pose import (
    canonical,
    conjugate,
    dot,
    product,
    quaternion_exp,
    quaternion_of,
    rotated,
    rotation_between,
    scaled,
    store_quaternion,
    store_vector,
    subtract,
    vector_of,
)


@compiled
def _show_handle(state: NDArray[np.void], substep: int) -> None:
    """Puts the handle where it is in this substep, and gives the actuators their control."""
    s = state[0]
    position = vector_of(s.handle_position)
    orientation = quaternion_of(s.handle_quaternion)
    remaining = (s.substeps - 1 - substep) / s.substeps
    if remaining > 0.0:
        position = subtract(position, scaled(remaining, vector_of(s.handle_step)))
        back = quaternion_exp(scaled(-remaining, vector_of(s.handle_turn)))
        orientation = product(back, orientation)
    m = s.handle_mocap_id
    store_vector(floats(s.mocap_pos + 24 * m, 3), position)
    store_quaternion(floats(s.mocap_quat + 32 * m, 4), orientation)
    if s.scheme == DIRECT:
        place_tool(state)
        return
    to_handle = conjugate(orientation)
    ctrl = floats(s.ctrl + 8 * s.coupling_ctrl_adr, 6)
    if s.scheme == HELD:
        w = s.wrench_on_tool  # of the tick before: held, as a zero-order hold would
        store_vector(ctrl[0:3], rotated(to_handle, vector_of(w)))
        store_vector(ctrl[3:6], rotated(to_handle, vector_of(w[3:6])))
        return
    if s.scheme == LOSSLESS:
        apply_carried(state)
    rate = 1.0 / s.period
    store_vector(ctrl[0:3], scaled(rate, rotated(to_handle, vector_of(s.handle_step))))
    store_vector(ctrl[3:6], scaled(rate, rotated(to_handle, vector_of(s.handle_turn))))


@compiled
def before_step(
    state: NDArray[np.void],
    sample: NDArray[np.void],
    row: NDArray[np.void],
    substep: int,
    elapsed: float,
) -> int:
    """Takes a device sample into the scene: the handle's pose, and its velocity as ``ctrl``.

    Over substeps the handle moves uniformly from its previous pose to the new one, which it
    reaches in the last. The control of the coupling's actuators is the handle's velocity in the
    handle's own axes, R_hᵀ δh/T and R_hᵀ δφ_h/T: a mocap body has no velocity of its own. Where
    the wrench is applied and held, the control is the wrench of the tick before, in those axes.

    Over a time t, the device's damper burns ∫ b v² >= b ‖δp‖²/t for every motion that ends δp away.
    Where deadlines were missed t is longer than T, and T would count more than was burnt.

    Args:
        state: The bound state.
        sample: One device sample.
        row: The bound record.
        substep: Which of the tick's.
        elapsed: Time since the sample before it in s. One below T counts as T: that counts less
            than was burnt, and an uneven time stamp must not count more.

    Returns:
        ``OK``, ``HALF_DONE`` where MuJoCo's step needs only its second half, ``BAD_SAMPLE`` or why
        ``watch.refused`` it; in these cases nothing was changed.
    """
    s, r = state[0], row[0]
    if substep == 0:
        position = vector_of(sample[0].position)
        given = quaternion_of(sample[0].quaternion)
        square = 0.0
        for i in range(4):
            square += given[i] * given[i]
        if not math.isfinite(dot(position, position) + square) or square <= 0.25:
            return BAD_SAMPLE
        quaternion = canonical(given)

        moved = subtract(position, vector_of(s.device_position))
        # exactly none where it did not turn: rounding would be a speed that the controller damps
        turned, last = (0.0, 0.0, 0.0), quaternion_of(s.device_quaternion)
        if quaternion != last:
            turned = rotation_between(last, quaternion)
        code = refused(state, moved, turned, elapsed)
        if code != OK:
            return code
        # old samples hide how the device moved: it took all the time since the last new one
        interval = max(elapsed, s.period) + s.since_news
        keep_account(state, moved, turned, interval)
        w = s.wrench_on_device
        s.device_energy += dot(vector_of(w), moved) + dot(vector_of(w[3:6]), turned)
        if s.tick > s.ramp_start:
            # before the first tick and in a pause nobody knows how long the device took to move
            s.device_burnt += s.device_damping / interval * dot(moved, moved)
            s.device_burnt += s.device_rotational_damping / interval * dot(turned, turned)
        store_vector(s.device_position, position)
        store_quaternion(s.device_quaternion, quaternion)

        handle, orientation = vector_of(s.handle_position), quaternion_of(s.handle_quaternion)
        buttons = (sample[0].buttons & DEVICE_BUTTONS) | s.commanded
        if follow(state, position, quaternion, moved, turned, buttons, elapsed):
            handle, orientation = handle_pose(state, position, quaternion)
        store_vector(s.handle_step, subtract(handle, vector_of(s.handle_position)))
        store_vector(
            s.handle_turn, rotation_between(quaternion_of(s.handle_quaternion), orientation)
        )
        store_vector(s.handle_position, handle)
        store_quaternion(s.handle_quaternion, orientation)
        if s.nmocap > 1:
            note_moved_mocap_bodies(state)
        if s.tuning_ticks > 0:
            retune(state)

        r.tick = s.tick
        r.buttons = buttons
        store_vector(r.device_position, position)
        store_quaternion(r.device_quaternion, quaternion)
        store_vector(r.handle_position, handle)
        store_quaternion(r.handle_quaternion, orientation)

    _show_handle(state, substep)
    if s.has_positions:
        s.has_positions = 0
        if not s.mocap_has_moved:
            take_handle_in(state)
            return HALF_DONE
    return OK


@compiled
def advance(state: NDArray[np.void]) -> None:
    """MuJoCo's part of a substep, by C symbol: what ``Method.step`` is in Python.

    A massless tool has no dynamics: for it only positions and contacts are computed.
    """
    s = state[0]
    if s.scheme == DIRECT:
        mj_fwd_position(s.model, s.data)
    else:
        mj_step(s.model, s.data)


@compiled
def after_step(state: NDArray[np.void], row: NDArray[np.void], substep: int) -> int:
    """Meters the step that just ended; after the last substep, computes and records the wrench.

    Returns:
        ``OK`` or ``BAD_RESULT``; in the latter case the wrench on the device is zero.
    """
    code = answer_step(state, row, substep)
    if code != OK or substep + 1 != state[0].substeps:
        return code
    return close_tick(state, row, False)
