"""Second computation of the passivity controller."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit.differences import steps, turns
from hapticbridge.audit.watched import Seen
from hapticbridge.kernel.account import BOUND, SWINGS, TANK_START, THRESHOLD, WINDOW
from hapticbridge.kernel.guarding import DAMPER, ENVIRONMENT
from hapticbridge.kernel.parameters import RunParameters

Array = NDArray[np.float64]


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
