"""What the guard should have sent, and where the handle should have been, from records alone.

The second computation of what ``kernel.watch``, ``kernel.account`` and ``kernel.wrench`` do tick by
tick, over whole arrays.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit.turns import quaternion_product, steps, turn_between, turns
from hapticbridge.kernel.account import BOUND, SWINGS, TANK_START, THRESHOLD, WINDOW
from hapticbridge.kernel.guarding import DAMPER, TANK
from hapticbridge.kernel.state import RunParameters
from hapticbridge.tick import TickFlag

Array = NDArray[np.float64]


def has_flag(ticks: NDArray[np.void], flag: TickFlag) -> NDArray[np.bool_]:
    """Returns in which records a flag is set."""
    return np.asarray((ticks["flags"] & int(flag)) != 0)


def is_first(ticks: NDArray[np.void], resumed: Array) -> NDArray[np.bool_]:
    """Returns which ticks are the first of a run, after a start or a pause without force."""
    return np.asarray((ticks["tick"] == 0) | np.isin(ticks["tick"], resumed))


def since_start(ticks: NDArray[np.void], resumed: Array) -> Array:
    """Returns how many ticks ago the force began to rise: at the start, or when it did so again."""
    restarts = ticks["tick"][has_flag(ticks, TickFlag.RESEATED)]
    starts = np.unique(np.concatenate([[0.0], resumed, restarts.astype(np.float64)]))
    return np.asarray(ticks["tick"] - starts[np.searchsorted(starts, ticks["tick"], "right") - 1])


def run_lengths(is_on: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Returns for each row how many rows up to it are on without a gap."""
    index = np.arange(1, len(is_on) + 1)
    return np.asarray(index - np.maximum.accumulate(np.where(is_on, 0, index)))


def silence(ticks: NDArray[np.void], parameters: RunParameters) -> NDArray[np.int64]:
    """Returns for how many ticks the wrench has been fading: no new sample, or no handle."""
    is_silent = has_flag(ticks, TickFlag.CLUTCH)
    if parameters.guarding.stale_ticks > 0:
        stale = run_lengths(has_flag(ticks, TickFlag.STALE_SAMPLE))
        is_silent = is_silent | (stale > parameters.guarding.stale_ticks)
    return run_lengths(is_silent)


def since_news(ticks: NDArray[np.void], parameters: RunParameters) -> Array:
    """Returns the time in s that each tick's motion of the device took, (n,).

    That is since the last new sample; T at least between two readings. Where the device had nothing
    new, the time is that which has passed so far.
    """
    elapsed = np.diff(ticks["read_ns"], prepend=0) * 1e-9
    total = np.concatenate([[0.0], np.cumsum(np.maximum(elapsed, parameters.period))])
    stale = run_lengths(has_flag(ticks, TickFlag.STALE_SAMPLE))
    before = np.concatenate([[0], stale[:-1]])
    index = np.arange(len(ticks))
    return np.asarray(total[1:] - total[index - before])


def _ramp_ticks(ticks: NDArray[np.void], parameters: RunParameters, resumed: Array) -> Array:
    """Returns in how many ticks the wrench rises: slowly after a start, soon after a re-seating."""
    first = is_first(ticks, resumed)
    is_soon = has_flag(ticks, TickFlag.RESEATED) & ~first
    index = np.arange(len(ticks))
    last_first = np.maximum.accumulate(np.where(first, index, -1))
    last_soon = np.maximum.accumulate(np.where(is_soon, index, -1))
    return np.where(last_soon > last_first, parameters.guarding.fade_ticks, parameters.ramp_ticks)


def is_ramping(
    ticks: NDArray[np.void], parameters: RunParameters, resumed: Array
) -> NDArray[np.bool_]:
    """Returns in which ticks the wrench still rises."""
    return np.asarray(since_start(ticks, resumed) < _ramp_ticks(ticks, parameters, resumed))


def wrench_share(ticks: NDArray[np.void], parameters: RunParameters, resumed: Array) -> Array:
    """Returns the share of the wrench that the guard lets through while it rises or fades, (n,)."""
    length = _ramp_ticks(ticks, parameters, resumed)
    rising = (since_start(ticks, resumed) + 1.0) / (length + 1.0)
    fading = 1.0 - silence(ticks, parameters) / parameters.guarding.fade_ticks
    return np.asarray(np.minimum(rising, 1.0) * np.maximum(fading, 0.0))


def wrench_sent_before(ticks: NDArray[np.void], resumed: Array) -> Array:
    """Returns the wrench that acted on each tick's motion of the device, (n, 6)."""
    sent = np.concatenate([np.zeros((1, 6)), ticks["wrench_on_device"][:-1]])
    sent[np.isin(ticks["tick"], resumed)] = 0.0
    return sent


def expected_handle(
    ticks: NDArray[np.void],
    parameters: RunParameters,
    handle_start: Array,
    tool_start: Array,
) -> tuple[Array, Array]:
    """Maps the recorded device poses into the scene: h = h_0 + scale · A (p − p_0).

    p_0 and h_0 are those of the last tick in which the coupling was re-seated; while a clutch holds
    it, the handle stays where it was.
    """
    count = len(ticks)
    before = np.concatenate([handle_start[None], _poses(ticks, "handle")[:-1]])
    device = _poses(ticks, "device")
    origin = np.tile(np.array(parameters.device_origin), (count, 1))
    target = np.tile(np.array(parameters.handle_origin), (count, 1))
    seats = np.flatnonzero(has_flag(ticks, TickFlag.RESEATED))
    last = np.searchsorted(seats, np.arange(count), "right") - 1
    is_seated = last >= 0
    if is_seated.any():
        at = seats[last[is_seated]]
        tool = np.concatenate([tool_start[None], _poses(ticks, "tool")[:-1]])
        origin[is_seated], target[is_seated] = device[at], tool[at]
    axes = np.array(parameters.axes).reshape(3, 3)
    moved = (device[:, :3] - origin[:, :3]) @ axes.T
    # a rotation vector turns with the axes: log(A R Aᵀ) = A log(R)
    vector = turn_between(origin[:, 3:], device[:, 3:]) @ axes.T
    angle = np.linalg.norm(vector, axis=1, keepdims=True)
    turn = np.concatenate([np.cos(angle / 2), np.sinc(angle / (2 * np.pi)) / 2 * vector], axis=1)
    position = target[:, :3] + parameters.scale * moved
    orientation = quaternion_product(turn, target[:, 3:])
    is_held = has_flag(ticks, TickFlag.CLUTCH)[:, None]
    return np.where(is_held, before[:, :3], position), np.where(is_held, before[:, 3:], orientation)


def _poses(ticks: NDArray[np.void], body: str) -> Array:
    return np.concatenate([ticks[f"{body}_position"], ticks[f"{body}_quaternion"]], axis=1)


def expected_wrench(
    ticks: NDArray[np.void], parameters: RunParameters, resumed: Array
) -> tuple[Array, Array]:
    """Returns what the guard should have sent, (n, 6), and the damping that it injected, (n,)."""
    axes = np.array(parameters.axes).reshape(3, 3)
    on_tool = ticks["wrench_on_tool"]
    force = -parameters.force_scale * on_tool[:, :3] @ axes
    torque = -parameters.force_scale / parameters.scale * on_tool[:, 3:] @ axes
    wrench = np.concatenate([force, torque], axis=1)
    share = wrench_share(ticks, parameters, resumed)
    control = _controlled(ticks, parameters, resumed, wrench, share)
    guarding = parameters.guarding
    starts = is_first(ticks, resumed) | has_flag(ticks, TickFlag.RESEATED)
    parts = (
        (slice(0, 3), parameters.force_limit, guarding.force_rise),
        (slice(3, 6), parameters.torque_limit, guarding.torque_rise),
    )
    sent = [
        _chained(control.wrench[:, part], control.change[:, part], limit, rise, starts)
        for part, limit, rise in parts
    ]
    return np.concatenate(sent, axis=1) * share[:, None], control.injected


def _limited(vector: Array, limit: float) -> Array:
    """Shortens what is longer than the limit."""
    norm = np.linalg.norm(vector, axis=-1, keepdims=True)
    return np.asarray(vector * np.where(norm > limit, limit / np.maximum(norm, 1e-300), 1.0))


def _chained(
    vector: Array, change: Array, limit: float, rise: float, starts: NDArray[np.bool_]
) -> Array:
    """Limits a vector where its change since the row before, as that was sent, is bounded.

    Args:
        vector: (n, 3).
        change: Most change of each component, (n, 3); inf where there is no bound.
        limit: Largest norm.
        rise: Largest norm of the change.
        starts: Rows before which it was zero.
    """
    sent = _limited(vector, limit)
    before = np.concatenate([np.zeros((1, 3)), sent[:-1]])
    before[starts] = 0.0
    is_bounded = np.isfinite(change).any(axis=1)
    is_bounded |= np.linalg.norm(sent - before, axis=1) > rise
    done = -1
    for first in np.flatnonzero(is_bounded).tolist():
        for k in range(max(first, done + 1), len(sent)):
            last = np.zeros(3) if starts[k] else sent[k - 1]
            plain = sent[k].copy()
            asked = np.clip(vector[k], last - change[k], last + change[k])
            step = _limited(asked, limit) - last
            length = float(np.linalg.norm(step))
            sent[k] = last + (step if length <= rise else rise / length * step)
            done = k
            if np.array_equal(sent[k], plain):
                break
    return sent


def _capped_sum(values: Array, surplus: float) -> Array:
    """Returns x_k = max(x_{k−1} + v_k, −surplus), x_{−1} = 0, along the first axis."""
    total = np.cumsum(values, axis=0)
    return np.asarray(total + np.maximum(np.maximum.accumulate(-surplus - total, axis=0), 0.0))


class _Control(NamedTuple):
    """What the controller makes of the wrench.

    Attributes:
        wrench: With damping or the tank's share, (n, 6).
        change: By how much each component may change from tick to tick, (n, 6); inf: at will.
        injected: The damping added, (n,).
    """

    wrench: Array
    change: Array
    injected: Array


def _controlled(
    ticks: NDArray[np.void],
    parameters: RunParameters,
    resumed: Array,
    wrench: Array,
    share: Array,
) -> _Control:
    guarding = parameters.guarding
    nothing, free = np.zeros(len(ticks)), np.full((len(ticks), 6), np.inf)
    if guarding.controller not in (DAMPER, TANK):
        return _Control(wrench, free, nothing)
    start = np.array(parameters.device_start)
    moved = np.concatenate(
        [
            steps(ticks["device_position"], start[:3]),
            turns(ticks["device_quaternion"], start[3:]),
        ],
        axis=1,
    )
    first = is_first(ticks, resumed)
    rate = np.where(first, 0.0, 1.0 / since_news(ticks, parameters))
    velocity = rate[:, None] * moved
    credit = np.repeat([guarding.credit, guarding.rotational_credit], 3)
    given = (wrench_sent_before(ticks, resumed) - credit * velocity) * moved
    own = ticks["kinetic"] + ticks["potential"] - ticks["actuator_work"] - ticks["external_work"]
    change = np.concatenate([[0.0], np.diff(own)])
    change[0] = own[0] - _start_energy(ticks)
    asked = np.linalg.norm(wrench[:, :3], axis=1)
    sent = np.linalg.norm(ticks["wrench_on_device"][:, :3], axis=1)
    passed = np.minimum(np.divide(sent, asked, out=share.copy(), where=asked > 0), 1.0)
    gained = parameters.force_scale / parameters.scale * passed * change
    total = given.sum(axis=1) + np.concatenate([[0.0], gained[:-1]])
    account = _capped_sum(total, guarding.surplus)
    if guarding.controller == TANK:
        share = _tank_share(parameters, wrench, velocity, account)
        return _Control(wrench * share[:, None], free, nothing)
    debt = (account - THRESHOLD)[:, None]
    owed = np.minimum(debt, _capped_sum(given, guarding.surplus))
    most = np.repeat([guarding.most_damping, guarding.most_rotational_damping], 3)
    square = parameters.period * velocity**2
    damping = np.divide(owed, square, out=np.zeros_like(owed), where=(owed > 0) & (square > 0))
    damping = np.minimum(damping, most)
    reverses = np.diff(np.sign(velocity), axis=0, prepend=np.zeros((1, 6)))
    count = np.cumsum(np.abs(reverses) == 2, axis=0)
    count[WINDOW:] -= count[:-WINDOW].copy()
    swings = count >= SWINGS
    change = np.where((owed > 0) & swings, BOUND * most * np.abs(velocity), np.inf)
    held = wrench - damping * velocity
    # the tank comes last, and only where no axis is bounded
    pays = (debt[:, 0] > 0) & ~swings.any(axis=1)
    share = np.where(pays, _tank_share(parameters, held, velocity, account), 1.0)
    return _Control(held * share[:, None], change, damping[:, :3].max(axis=1))


def _tank_share(parameters: RunParameters, wrench: Array, velocity: Array, account: Array) -> Array:
    """Returns the share of the wrench that the tank pays for, (n,)."""
    work = parameters.period * np.sum(wrench * velocity, axis=1)
    level = np.maximum(TANK_START - account, 0.0)
    return np.where(work > level, level / np.where(work > level, work, 1.0), 1.0)


def _start_energy(ticks: NDArray[np.void]) -> float:
    """Returns S_start from the first record: E_0 = S_0 − S_start − works of the first tick."""
    row = ticks[0]
    works = row["coupling_work"] + row["actuator_work"] + row["external_work"]
    return float(row["kinetic"] + row["potential"] - works - row["environment_energy"])
