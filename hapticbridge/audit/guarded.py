"""What the guard should have sent, and where the handle should have been, from records alone.

The second computation of what ``kernel.watch``, ``kernel.account`` and ``kernel.wrench`` do tick by
tick, over whole arrays, block by block.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit.differences import quaternion_product, steps, turn_between, turns
from hapticbridge.audit.interventions import Interventions
from hapticbridge.audit.law import poses_before
from hapticbridge.audit.watched import Seen, Watch, has_flag
from hapticbridge.kernel.account import BOUND, SWINGS, TANK_START, THRESHOLD, WINDOW
from hapticbridge.kernel.guarding import DAMPER, TANK
from hapticbridge.kernel.state import RunParameters
from hapticbridge.tick import TickFlag

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Expected:
    """What should stand in some records.

    Attributes:
        position: Of the handle, (n, 3) in m.
        orientation: Of the handle, (n, 4).
        wrench: That was sent to the device, (n, 6).
        injected: Damping that the controller added, (n,) in N s/m.
        seen: What the watch saw.
    """

    position: Array
    orientation: Array
    wrench: Array
    injected: Array
    seen: Seen


@dataclass(slots=True)
class Guarded:
    """Where the guard has got to.

    Attributes:
        parameters: The run's.
        watch: Where the watch has got to.
        handle: Handle pose (7,) in the tick before.
        tool: Tool pose (7,) then.
        origin: Device pose that belongs to ``target``.
        target: Handle pose.
        sent: Wrench (6,) that was sent in the tick before.
        own: What the scene stored then, but for what its motors and users put in, in J.
        gained: What the account gets for the tick before, in J.
        account: In J.
        axes: Accounts (6,) of the axes, in J.
        velocity: Of the device in the tick before, (6,).
        reversed: Where the motion of each axis was reversed in the last ticks, (n, 6).
        slewed: The wrench (6,) before ramp and fading.
    """

    parameters: RunParameters
    watch: Watch
    handle: Array
    tool: Array
    origin: Array
    target: Array
    own: float
    sent: Array = field(default_factory=lambda: np.zeros(6))
    gained: float = 0.0
    account: float = 0.0
    axes: Array = field(default_factory=lambda: np.zeros(6))
    velocity: Array = field(default_factory=lambda: np.zeros(6))
    reversed: NDArray[np.bool_] = field(default_factory=lambda: np.zeros((WINDOW, 6), bool))
    slewed: Array = field(default_factory=lambda: np.zeros(6))

    @classmethod
    def at_start(
        cls, parameters: RunParameters, handle: Array, tool: Array, start_energy: float
    ) -> Guarded:
        """Returns what the first tick begins with; see ``Reached.at_start``."""
        origin, target = np.array(parameters.device_origin), np.array(parameters.handle_origin)
        watch = Watch.at_start(parameters)
        return cls(parameters, watch, handle, tool, origin, target, start_energy)

    def after(self, ticks: NDArray[np.void], outside: Interventions) -> tuple[Expected, Guarded]:
        """Says what the next records, ``TICK_DTYPE``, at least one, should hold.

        Args:
            ticks: The records.
            outside: What was done to the run while it went on.
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
        asked = np.concatenate([force, torque], axis=1)
        control = then._control(ticks, asked, seen, device, outside.resumed)
        guarding = parameters.guarding
        starts = seen.first | has_flag(ticks, TickFlag.RESEATED)
        parts = (
            (slice(0, 3), parameters.force_limit, guarding.force_rise),
            (slice(3, 6), parameters.torque_limit, guarding.torque_rise),
        )
        full = np.concatenate(
            [
                _chained(
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

    def _follow(self, ticks: NDArray[np.void], outside: Interventions) -> tuple[Array, Array]:
        """Maps the recorded device poses into the scene: h = h_0 + scale · A (p − p_0).

        p_0 and h_0 are the device's pose and the tool's where the coupling was last re-seated;
        while a clutch holds it, the handle stays where it was.
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

    def _control(
        self,
        ticks: NDArray[np.void],
        wrench: Array,
        seen: Seen,
        device: Array,
        resumed: Array,
    ) -> _Control:
        parameters, guarding = self.parameters, self.parameters.guarding
        nothing, free = np.zeros(len(ticks)), np.full((len(ticks), 6), np.inf)
        if guarding.controller not in (DAMPER, TANK):
            return _Control(wrench, free, nothing)
        position, quaternion = ticks["device_position"], ticks["device_quaternion"]
        moved = np.concatenate([steps(position, device[:3]), turns(quaternion, device[3:])], axis=1)
        velocity = np.where(seen.first, 0.0, 1.0 / seen.interval)[:, None] * moved
        sent = np.concatenate([self.sent[None], ticks["wrench_on_device"][:-1]])
        sent[np.isin(ticks["tick"], resumed)] = 0.0
        credit = np.repeat([guarding.credit, guarding.rotational_credit], 3)
        given = (sent - credit * velocity) * moved
        gained = self._gained(ticks, wrench, seen.share)
        total = given.sum(axis=1) + np.concatenate([[self.gained], gained[:-1]])
        account = _capped_sum(total, guarding.surplus, self.account)
        axes = _capped_sum(given, guarding.surplus, self.axes)
        reverses = np.concatenate([self.velocity[None], velocity[:-1]]) * velocity < 0
        history = np.concatenate([self.reversed, reverses])
        count = np.cumsum(history, axis=0)
        swings = count[WINDOW:] - count[:-WINDOW] >= SWINGS
        self.sent, self.gained = ticks["wrench_on_device"][-1].copy(), float(gained[-1])
        self.account, self.axes = float(account[-1]), axes[-1]
        self.velocity, self.reversed = velocity[-1], history[-WINDOW:]
        if guarding.controller == TANK:
            share = _tank_share(parameters, wrench, velocity, account)
            return _Control(wrench * share[:, None], free, nothing)
        debt = account - THRESHOLD
        owed = np.minimum(debt[:, None], axes)
        most = np.repeat([guarding.most_damping, guarding.most_rotational_damping], 3)
        square, zero = parameters.period * velocity**2, np.zeros_like(owed)
        damping = np.divide(owed, square, out=zero, where=(owed > 0) & (square > 0))
        damping = np.minimum(damping, most)
        change = np.where((owed > 0) & swings, BOUND * most * np.abs(velocity), np.inf)
        held = wrench - damping * velocity
        # the tank comes last, and only where no axis is bounded
        pays = (debt > 0) & ~swings.any(axis=1)
        share = np.where(pays, _tank_share(parameters, held, velocity, account), 1.0)
        return _Control(held * share[:, None], change, damping[:, :3].max(axis=1))

    def _gained(self, ticks: NDArray[np.void], wrench: Array, share: Array) -> Array:
        """Returns what the account gets for each tick: what the scene took up of what was felt."""
        own = ticks["kinetic"] + ticks["potential"] - ticks["actuator_work"]
        own = own - ticks["external_work"]
        change = np.diff(own, prepend=self.own)
        self.own = float(own[-1])
        asked = np.linalg.norm(wrench[:, :3], axis=1)
        sent = np.linalg.norm(ticks["wrench_on_device"][:, :3], axis=1)
        passed = np.minimum(np.divide(sent, asked, out=share.copy(), where=asked > 0), 1.0)
        return np.asarray(self.parameters.force_scale / self.parameters.scale * passed * change)


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


def _poses(ticks: NDArray[np.void], body: str) -> Array:
    return np.concatenate([ticks[f"{body}_position"], ticks[f"{body}_quaternion"]], axis=1)


def _capped_sum(values: Array, surplus: float, before: float | Array = 0.0) -> Array:
    """Returns x_k = max(x_{k−1} + v_k, −surplus), x_{−1} = before, along the first axis."""
    total = before + np.cumsum(values, axis=0)
    return np.asarray(total + np.maximum(np.maximum.accumulate(-surplus - total, axis=0), 0.0))


def _limited(vector: Array, limit: float) -> Array:
    """Shortens what is longer than the limit."""
    norm = np.linalg.norm(vector, axis=-1, keepdims=True)
    return np.asarray(vector * np.where(norm > limit, limit / np.maximum(norm, 1e-300), 1.0))


def _chained(
    vector: Array,
    change: Array,
    limit: float,
    rise: float,
    starts: NDArray[np.bool_],
    first: Array,
) -> Array:
    """Limits a vector where its change since the row before, as that was sent, is bounded.

    Args:
        vector: (n, 3).
        change: Most change of each component, (n, 3); inf where there is no bound.
        limit: Largest norm.
        rise: Largest norm of the change.
        starts: Rows before which it was zero.
        first: What was sent before the first row, (3,).
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
            asked = np.clip(vector[k], last - change[k], last + change[k])
            step = _limited(asked, limit) - last
            length = float(np.linalg.norm(step))
            sent[k] = last + (step if length <= rise else rise / length * step)
            done = k
            if np.array_equal(sent[k], plain):
                break
    return sent


def _tank_share(parameters: RunParameters, wrench: Array, velocity: Array, account: Array) -> Array:
    """Returns the share of the wrench that the tank pays for, (n,)."""
    work = parameters.period * np.sum(wrench * velocity, axis=1)
    level = np.maximum(TANK_START - account, 0.0)
    return np.where(work > level, level / np.where(work > level, work, 1.0), 1.0)
