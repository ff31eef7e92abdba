"""Second computation of the guard, from records alone.

It repeats over whole arrays, block by block, what ``kernel.watch``, ``kernel.account`` and
``kernel.wrench`` do tick by tick.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit.events import RunEvents
from hapticbridge.audit.motion import poses_before, quaternion_product, steps, turn_between, turns
from hapticbridge.kernel.codes import CLUTCHED, FORCE_OFF
from hapticbridge.kernel.guard import STILL, STILL_TURN
from hapticbridge.kernel.parameters import DAMPER, ENVIRONMENT, RunParameters
from hapticbridge.kernel.passivity_controller import BOUND, SWINGS, TANK_START, THRESHOLD, WINDOW
from hapticbridge.record import TickFlag

# Second computation of the wrench limits.


def _limited(vector: Array, limit: float) -> Array:
    norm = np.linalg.norm(vector, axis=-1, keepdims=True)
    return np.asarray(vector * np.where(norm > limit, limit / np.maximum(norm, 1e-300), 1.0))


def chained(
    vector: Array,
    change: Array,
    limit: float,
    rise: float,
    starts: NDArray[np.bool_],
    first: Array,
) -> Array:
    """Limits norm and change of a vector; the change counts from the row before as sent.

    Args:
        vector: Vectors, (n, 3).
        change: Largest change of each component, (n, 3); inf without a bound.
        limit: Largest norm.
        rise: Largest norm of the change.
        starts: Rows that start from zero.
        first: Vector sent before the first row, (3,).
    """
    sent = _limited(vector, limit)
    before = np.concatenate([first[None], sent[:-1]])
    before[starts] = 0.0
    is_bounded = np.isfinite(change).any(axis=1)
    is_bounded |= np.linalg.norm(sent - before, axis=1) > rise
    done = -1
    for begin in np.flatnonzero(is_bounded).tolist():
        for k in range(max(begin, done + 1), len(sent)):
            last = np.zeros(3) if starts[k] else sent[k - 1] if k else first
            plain = sent[k].copy()
            requested = np.clip(vector[k], last - change[k], last + change[k])
            step = _limited(requested, limit) - last
            length = float(np.linalg.norm(step))
            sent[k] = last + (step if length <= rise else rise / length * step)
            done = k
            if np.array_equal(sent[k], plain):
                break
    return sent


def limits_on_tool(parameters: RunParameters) -> tuple[float, float]:
    """Returns force and torque on the tool at the device's limits, in N and N m."""
    return (
        parameters.force_limit / parameters.force_scale,
        parameters.torque_limit * parameters.scale / parameters.force_scale,
    )


def spring_energy(stiffness: Array, length: Array, limit: float) -> Array:
    """Returns ∫ min(K e, limit) de in J, for each K and length, (n,) each."""
    at_limit = np.divide(limit, stiffness, out=np.full_like(length, np.inf), where=stiffness > 0)
    elastic = np.minimum(length, at_limit)
    return np.asarray(0.5 * stiffness * elastic**2 + limit * (length - elastic))


# Second computation of the watch on device samples.

Flags = NDArray[np.bool_]

_ROUNDING = 1e-6
"""Largest rounding difference of two sums, in ticks of a ramp."""


def has_flag(ticks: NDArray[np.void], flag: TickFlag) -> Flags:
    """Returns True for each record with a flag."""
    return np.asarray((ticks["flags"] & int(flag)) != 0)


def run_lengths(is_on: Flags, before: int) -> NDArray[np.int64]:
    """Returns the length of the uninterrupted run of True values up to each row.

    ``before`` is the length of the run before the first row.
    """
    index = np.arange(1, len(is_on) + 1)
    return np.asarray(index - np.maximum.accumulate(np.where(is_on, -before, index)))


@dataclass(frozen=True, slots=True)
class Seen:
    """Result of the watch for some ticks.

    Attributes:
        first: True for the first tick after a start or a pause without force.
        interval: Time in s since the device's last new sample, at least T between two readings.
        since_start: Ticks since the wrench began to rise.
        ramp: Length of the rise in ticks: long after a start, short after a re-anchoring.
        silence: Number of ticks for which the wrench has been fading.
        flags: Expected values of redundant flags.
        share: Share of the wrench transmitted by ramp and fading.
    """

    first: Flags
    interval: Array
    since_start: Array
    ramp: Array
    silence: NDArray[np.int64]
    flags: dict[TickFlag, Flags]
    share: Array


@dataclass(slots=True)
class Watch:
    """State of the watch after the previous tick.

    Attributes:
        parameters: Run parameters.
        device: Device pose (7,).
        read_ns: Time of the device reading.
        stale: Number of consecutive ticks without a new sample.
        silent: Number of ticks for which the wrench has been fading.
        since_news: Time in s without a new sample.
        is_released: True if the handle did not follow the device.
        start: Tick at which the wrench began to rise.
        is_soon: True if that rise was a short one.
        risen: Progress of the rise, in ticks of a ramp.
    """

    parameters: RunParameters
    device: Array
    read_ns: int = 0
    stale: int = 0
    silent: int = 0
    since_news: float = 0.0
    is_released: bool = False
    start: int = 0
    is_soon: bool = False
    risen: float = 0.0

    @classmethod
    def at_start(cls, parameters: RunParameters) -> Watch:
        """Returns the state before the first tick."""
        is_released = parameters.guarding.dead_man != 0
        return cls(parameters, np.array(parameters.device_start), is_released=is_released)

    def after(self, ticks: NDArray[np.void], outside: RunEvents) -> tuple[Seen, Watch]:
        """Evaluates the next records, ``TICK_DTYPE``, at least one."""
        guarding, period = self.parameters.guarding, self.parameters.period
        index = np.arange(len(ticks))
        first = (ticks["tick"] == 0) | np.isin(ticks["tick"], outside.resumed)
        raw = np.diff(ticks["read_ns"], prepend=self.read_ns) * 1e-9
        elapsed = np.maximum(raw, period)
        is_stale = has_flag(ticks, TickFlag.STALE_SAMPLE)
        stale = run_lengths(is_stale, self.stale)
        interval = elapsed.copy()
        interval[0] += self.since_news
        # added one by one, so that the sums do not depend on the blocks
        for k in (1 + np.flatnonzero(is_stale[:-1])).tolist():
            interval[k] += interval[k - 1]

        is_released = (ticks["buttons"] & (guarding.clutch | CLUTCHED)) != 0
        if guarding.dead_man:
            is_released |= (ticks["buttons"] & guarding.dead_man) == 0
        is_released |= np.linalg.norm(ticks["device_position"], axis=1) > guarding.reach
        is_silent = is_released | ((ticks["buttons"] & FORCE_OFF) != 0)
        if guarding.stale_ticks > 0:
            is_silent |= stale > guarding.stale_ticks
        silence = run_lengths(is_silent, self.silent)

        was_released = np.concatenate([[self.is_released], is_released[:-1]])
        has_news = np.concatenate([[self.silent > 0], is_silent[:-1]]) & ~is_silent
        has_stalled = ~first & (raw > guarding.longest_stall)
        moved = np.linalg.norm(steps(ticks["device_position"], self.device[:3]), axis=1)
        turned = np.linalg.norm(turns(ticks["device_quaternion"], self.device[3:]), axis=1)
        has_strayed = first & guarding.reseats & ((moved > STILL) | (turned > STILL_TURN))
        is_reset = outside.is_reset(ticks["tick"])
        is_seated = ~is_released & (was_released | has_news | has_stalled | has_strayed | is_reset)

        begins = first | is_seated
        pace = self._ramp_pace(ticks, outside, begins)
        last = np.maximum.accumulate(np.where(begins, index, -1))
        start = np.where(last >= 0, ticks["tick"][last], self.start)
        is_soon = np.where(last >= 0, (is_seated & ~first)[last], self.is_soon)
        since_start = (ticks["tick"] - start).astype(np.float64)
        ramp = np.where(is_soon, guarding.fade_ticks, self.parameters.ramp_ticks)
        risen = self._ramp_progress(pace, last, ramp + 1.0)
        rising = risen / (ramp + 1.0)
        fading = np.maximum(1.0 - silence / guarding.fade_ticks, 0.0)
        flags = {
            TickFlag.CLUTCH: is_released,
            TickFlag.RESEATED: is_seated,
            TickFlag.RAMPING: _expected_ramping(ticks, risen, ramp + 1.0),
        }
        seen = Seen(first, interval, since_start, ramp, silence, flags, rising * fading)
        then = copy.copy(self)
        row = ticks[-1]
        then.device = np.concatenate([row["device_position"], row["device_quaternion"]])
        then.read_ns = int(row["read_ns"])
        then.stale, then.silent = int(stale[-1]), int(silence[-1])
        then.since_news = float(interval[-1]) if is_stale[-1] else 0.0
        then.is_released = bool(is_released[-1])
        then.risen = float(risen[-1])
        then.start, then.is_soon = int(start[-1]), bool(is_soon[-1])
        return seen, then

    def _ramp_progress(self, pace: Array, last: NDArray[np.int64], full: Array) -> Array:
        """Returns the progress of the rise, in ticks of a ramp.

        ``pace`` is the largest progress in each tick. The rise began in row ``last``, −1 before
        these rows, and ends at ``full``.
        """
        gone = np.cumsum(pace)
        before = np.where(last >= 0, gone[last] - pace[last], -self.risen)
        return np.minimum(gone - before, full)

    def _ramp_pace(self, ticks: NDArray[np.void], outside: RunEvents, begins: Flags) -> Array:
        """Returns the largest progress in each tick, in ticks of a ramp, (n,).

        It is min(1, V_0/V) for the energy V stored in the coupling at the recorded poses.
        """
        parameters, pace = self.parameters, np.ones(len(ticks))
        most = parameters.guarding.ramp_energy
        full = (parameters.guarding.fade_ticks if self.is_soon else parameters.ramp_ticks) + 1.0
        has_risen = self.risen >= full and not begins.any()
        if not parameters.has_law or not np.isfinite(most) or has_risen:
            return pace
        gains = outside.laws(ticks["tick"])
        stretch = ticks["handle_position"] - ticks["tool_position"]
        twist = turn_between(ticks["tool_quaternion"], ticks["handle_quaternion"])
        held = np.zeros(len(ticks))
        for column, limit, e in zip(
            (0, 2), limits_on_tool(parameters), (stretch, twist), strict=True
        ):
            held += spring_energy(gains[:, column], np.linalg.norm(e, axis=1), limit)
        held *= parameters.force_scale / parameters.scale
        return np.divide(most, held, out=pace, where=held > most)


def _expected_ramping(ticks: NDArray[np.void], risen: Array, full: Array) -> Flags:
    """Returns the expected flag; where rounding decides, the recorded one."""
    is_close = (np.abs(risen - full) < _ROUNDING) & (risen != np.rint(risen))
    return np.where(is_close, has_flag(ticks, TickFlag.RAMPING), risen < full)


# Second computation of the passivity controller.


class Controlled(NamedTuple):
    """Wrench after the passivity controller.

    Attributes:
        wrench: Wrench with damping or the tank's share, (n, 6).
        change: Largest change of each component from tick to tick, (n, 6); inf without a bound.
        injected: Largest damping added on an axis of translation and of rotation, (n, 2) in N s/m
            and N m s/rad.
    """

    wrench: Array
    change: Array
    injected: Array


@dataclass(slots=True)
class Account:
    """State of the passivity observer.

    Attributes:
        parameters: Run parameters.
        own: Energy stored in the scene after the previous tick without the work of motors and
            users, in J.
        sent: Wrench (6,) sent in the previous tick.
        gained: Contribution of the scene to the account in the previous tick, in J.
        account: Observed energy in J.
        axes: Observed energies (6,) of the axes, in J.
        velocity: Device velocity (6,) in the previous tick.
        over: Energy created by the environment beyond the slack so far, in J.
        excess: That energy with savings capped at the credit limit, in J.
        reversed: Reversals of the motion of each axis in the last ticks, (n, 6).
    """

    parameters: RunParameters
    own: float
    sent: Array = field(default_factory=lambda: np.zeros(6))
    gained: float = 0.0
    account: float = 0.0
    axes: Array = field(default_factory=lambda: np.zeros(6))
    velocity: Array = field(default_factory=lambda: np.zeros(6))
    over: float = 0.0
    excess: float = 0.0
    reversed: NDArray[np.bool_] = field(default_factory=lambda: np.zeros((WINDOW, 6), bool))

    def after(
        self,
        ticks: NDArray[np.void],
        wrench: Array,
        seen: Seen,
        device: Array,
        resumed: Array,
        excess: Array,
    ) -> tuple[Controlled, Account]:
        """Computes the controller's effect on the wrenches of the next records, at least one.

        Args:
            ticks: The records, ``TICK_DTYPE``.
            wrench: Wrench requested by the coupling, (n, 6).
            seen: Result of the watch.
            device: Device pose (7,) in the previous tick.
            resumed: Ticks at which the run resumed after a pause without force.
            excess: Energy created by the environment beyond the slack, (n,) in J.
        """
        then = copy.copy(self)
        parameters, guarding = self.parameters, self.parameters.guarding
        nothing, free = np.zeros((len(ticks), 2)), np.full((len(ticks), 6), np.inf)
        acts = guarding.controller == DAMPER
        acts |= guarding.controller == ENVIRONMENT and parameters.has_law
        if not acts:
            return Controlled(wrench, free, nothing), then
        position, quaternion = ticks["device_position"], ticks["device_quaternion"]
        moved = np.concatenate([steps(position, device[:3]), turns(quaternion, device[3:])], axis=1)
        velocity = np.where(seen.first, 0.0, 1.0 / seen.interval)[:, None] * moved
        sent = np.concatenate([self.sent[None], ticks["wrench_on_device"][:-1]])
        sent[np.isin(ticks["tick"], resumed)] = 0.0
        credit = np.repeat([guarding.credit, guarding.rotational_credit], 3)
        given = (sent - credit * velocity) * moved
        gained = then._scene_contribution(ticks, wrench, seen.share)
        total = given.sum(axis=1) + np.concatenate([[self.gained], gained[:-1]])
        account = capped_sum(total, guarding.surplus, self.account)
        axes = capped_sum(given, guarding.surplus, self.axes)
        reverses = np.concatenate([self.velocity[None], velocity[:-1]]) * velocity < 0
        history = np.concatenate([self.reversed, reverses])
        count = np.cumsum(history, axis=0)
        swings = count[WINDOW:] - count[:-WINDOW] >= SWINGS
        then.sent, then.gained = ticks["wrench_on_device"][-1].copy(), float(gained[-1])
        then.account, then.axes = float(account[-1]), axes[-1]
        then.velocity, then.reversed = velocity[-1], history[-WINDOW:]
        debt = account - THRESHOLD
        if guarding.controller == ENVIRONMENT:
            created = np.diff(excess, prepend=self.over)
            owed = capped_sum(created, guarding.surplus, self.excess)
            debt = np.concatenate([[self.excess], owed[:-1]]) - THRESHOLD
            then.over, then.excess = float(excess[-1]), float(owed[-1])
        owed = np.minimum(debt[:, None], axes)
        most = np.repeat([guarding.most_damping, guarding.most_rotational_damping], 3)
        square, zero = parameters.period * velocity**2, np.zeros_like(owed)
        damping = np.divide(owed, square, out=zero, where=(owed > 0) & (square > 0))
        damping = np.minimum(damping, most)
        change = np.where((owed > 0) & swings, BOUND * most * np.abs(velocity), np.inf)
        held = wrench - damping * velocity
        if guarding.controller == ENVIRONMENT:
            return Controlled(held, change, _largest(damping)), then
        # the tank comes last, and only if no axis is bounded
        pays = (debt > 0) & ~swings.any(axis=1)
        share = np.where(pays, _tank_share(parameters, held, velocity, account), 1.0)
        return Controlled(held * share[:, None], change, _largest(damping)), then

    def _scene_contribution(self, ticks: NDArray[np.void], wrench: Array, share: Array) -> Array:
        """Returns the scene's contribution per tick: stored energy times transmitted share."""
        own = ticks["kinetic"] + ticks["potential"] - ticks["actuator_work"]
        own = own - ticks["external_work"]
        change = np.diff(own, prepend=self.own)
        self.own = float(own[-1])
        requested = np.linalg.norm(wrench[:, :3], axis=1)
        sent = np.linalg.norm(ticks["wrench_on_device"][:, :3], axis=1)
        passed = np.minimum(np.divide(sent, requested, out=share.copy(), where=requested > 0), 1.0)
        return np.asarray(self.parameters.force_scale / self.parameters.scale * passed * change)


def capped_sum(values: Array, surplus: float, before: float | Array = 0.0) -> Array:
    """Returns x_k = max(x_{k−1} + v_k, −surplus), x_{−1} = before, along the first axis."""
    total = before + np.cumsum(values, axis=0)
    return np.asarray(total + np.maximum(np.maximum.accumulate(-surplus - total, axis=0), 0.0))


def _largest(damping: Array) -> Array:
    """Returns the largest of three axes of each kind, (n, 2)."""
    return np.asarray(damping.reshape(-1, 2, 3).max(axis=2))


def _tank_share(parameters: RunParameters, wrench: Array, velocity: Array, account: Array) -> Array:
    work = parameters.period * np.sum(wrench * velocity, axis=1)
    level = np.maximum(TANK_START - account, 0.0)
    return np.where(work > level, level / np.where(work > level, work, 1.0), 1.0)


Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Expected:
    """Expected content of some records.

    Attributes:
        position: Handle position, (n, 3) in m.
        orientation: Handle orientation, (n, 4).
        wrench: Wrench sent to the device, (n, 6).
        injected: Largest damping that the controller added on an axis of translation and of
            rotation, (n, 2) in N s/m and N m s/rad.
        seen: Result of the watch.
    """

    position: Array
    orientation: Array
    wrench: Array
    injected: Array
    seen: Seen


@dataclass(slots=True)
class Guarded:
    """State of the guard after the previous tick.

    Attributes:
        parameters: Run parameters.
        watch: State of the watch.
        handle: Handle pose (7,).
        tool: Tool pose (7,).
        origin: Device pose at the last anchoring.
        target: Handle pose at the last anchoring.
        account: State of the passivity observer.
        slewed: Wrench (6,) before ramp and fading.
    """

    parameters: RunParameters
    watch: Watch
    handle: Array
    tool: Array
    origin: Array
    target: Array
    account: Account
    slewed: Array = field(default_factory=lambda: np.zeros(6))

    @classmethod
    def at_start(
        cls, parameters: RunParameters, handle: Array, tool: Array, start_energy: float
    ) -> Guarded:
        """Returns the state before the first tick; see ``Reached.at_start``."""
        origin, target = np.array(parameters.device_origin), np.array(parameters.handle_origin)
        watch = Watch.at_start(parameters)
        account = Account(parameters, start_energy)
        return cls(parameters, watch, handle, tool, origin, target, account)

    def after(
        self, ticks: NDArray[np.void], outside: RunEvents, excess: Array
    ) -> tuple[Expected, Guarded]:
        """Computes the expected content of the next records, ``TICK_DTYPE``, at least one.

        ``excess`` is the energy created by the environment beyond the slack, (n,) in J.
        """
        then = copy.copy(self)
        seen, then.watch = self.watch.after(ticks, outside)
        device = self.watch.device
        position, orientation = then._follow(ticks, outside)
        parameters = self.parameters
        axes = np.array(parameters.axes).reshape(3, 3)
        on_tool = ticks["wrench_on_tool"]
        force = -parameters.force_scale * on_tool[:, :3] @ axes
        torque = -parameters.force_scale / parameters.scale * on_tool[:, 3:] @ axes
        requested = np.concatenate([force, torque], axis=1)
        control, then.account = self.account.after(
            ticks, requested, seen, device, outside.resumed, excess
        )
        guarding = parameters.guarding
        starts = seen.first | has_flag(ticks, TickFlag.RESEATED)
        parts = (
            (slice(0, 3), parameters.force_limit, guarding.force_rise),
            (slice(3, 6), parameters.torque_limit, guarding.torque_rise),
        )
        full = np.concatenate(
            [
                chained(
                    control.wrench[:, part],
                    control.change[:, part],
                    limit,
                    rise,
                    starts,
                    self.slewed[part],
                )
                for part, limit, rise in parts
            ],
            axis=1,
        )
        then.slewed = full[-1]
        wrench = full * seen.share[:, None]
        return Expected(position, orientation, wrench, control.injected, seen), then

    def _follow(self, ticks: NDArray[np.void], outside: RunEvents) -> tuple[Array, Array]:
        """Maps the recorded device poses into the scene: h = h_0 + scale · A (p − p_0).

        p_0 and h_0 are the device's and the tool's pose at the last anchoring. During a clutch the
        handle keeps its pose.
        """
        parameters, count = self.parameters, len(ticks)
        handle, tool, device = (_poses(ticks, name) for name in ("handle", "tool", "device"))
        before = poses_before(ticks, "handle", self.handle, outside)
        tool_before = poses_before(ticks, "tool", self.tool, outside)
        is_seated = has_flag(ticks, TickFlag.RESEATED)
        at = np.maximum.accumulate(np.where(is_seated, np.arange(count), -1))
        origin = np.where(at[:, None] >= 0, device[at], self.origin)
        target = np.where(at[:, None] >= 0, tool_before[at], self.target)
        axes = np.array(parameters.axes).reshape(3, 3)
        moved = (device[:, :3] - origin[:, :3]) @ axes.T
        # a rotation vector turns with the axes: log(A R Aᵀ) = A log(R)
        vector = turn_between(origin[:, 3:], device[:, 3:]) @ axes.T
        angle = np.linalg.norm(vector, axis=1, keepdims=True)
        sine = np.sinc(angle / (2 * np.pi)) / 2 * vector
        turn = np.concatenate([np.cos(angle / 2), sine], axis=1)
        position = target[:, :3] + parameters.scale * moved
        orientation = quaternion_product(turn, target[:, 3:])
        is_held = has_flag(ticks, TickFlag.CLUTCH)[:, None]
        self.handle, self.tool = handle[-1], tool[-1]
        self.origin, self.target = origin[-1], target[-1]
        return (
            np.where(is_held, before[:, :3], position),
            np.where(is_held, before[:, 3:], orientation),
        )


def _poses(ticks: NDArray[np.void], body: str) -> Array:
    return np.concatenate([ticks[f"{body}_position"], ticks[f"{body}_quaternion"]], axis=1)
