"""Second computation of a run's times and of the energy that its delays may have given.

It is ``kernel.timing`` over whole blocks, from recorded times and poses alone. With τ the time
between two samples, t_d the time from the last sample to its force, d the handle's motion with the
device and N = K T/2 + B', the energy of each kind of axis is

    A_k = max(0, A_{k−1} + 3 (K/2)²/(N/T) (t_d/τ_k) max(d_k², d_{k−1}²) − p_k)

p is what the device's damping burned beyond N, less what it paid for late samples and for a torque
across the motion (``kernel.law.twist_price``). To it comes what
late samples cost and the springs could not pay, C_k = max(0, C_{k−1} + c_k − V_k), up to what the
wrenches gave the hand beyond what b burned; V is the energy of the springs after the sample.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit.events import RunEvents
from hapticbridge.audit.motion import Array, torque_across, turn_between
from hapticbridge.audit.spring import springs
from hapticbridge.audit.wrench_limits import AuditedBlock
from hapticbridge.kernel.codes import Scheme
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.record import TickFlag, has_flag

_DELAY_PRICE = 3.0  # damping in (K T/2)²/N that a delay of a period needs


def _no_energy() -> Array:
    return np.zeros(2)


@dataclass(slots=True)
class TimingTally:
    """Times of a recording and the energy of its delays, collected block by block.

    Attributes:
        parameters: Run parameters.
        ticks: Number of records so far.
        scene_steps: Results of a slower scene so far.
        newest_result: Number of the tick that took over the newest of them.
        longest_silence: Largest number of ticks without a new one so far.
        silence: Longest time in s without a new sample so far.
        silent_tick: Last tick of that time.
        fresh: Number of records with a new sample so far.
        due: Number of deadlines so far.
        overruns: Number of records after skipped deadlines so far.
        skipped: Number of skipped deadlines so far.
        delays: Sum of the times from sample to force in s.
        jitter: Sum of the times in s by which samples came later than the one before, each after
            its own deadline.
        max_uncovered: Largest energy in J that delays may have given to the hand.
        lent: Energies in J that late samples cost and b has not burned yet, by kind of axis.
        uncovered: Energies A in J by kind of axis.
        last_square: Squared motions of the last tick, by kind of axis.
        owed: Energies C in J by kind of axis.
        burned: Energy in J that the device's damping has burned at least.
    """

    parameters: RunParameters
    ticks: int = 0
    scene_steps: int = 0
    newest_result: int = 0
    longest_silence: int = 0
    silence: float = 0.0
    silent_tick: int = 0
    fresh: int = 0
    due: int = 0
    overruns: int = 0
    skipped: int = 0
    delays: float = 0.0
    jitter: float = 0.0
    max_uncovered: float = 0.0
    lent: Array = field(default_factory=_no_energy)
    uncovered: Array = field(default_factory=_no_energy)
    last_square: Array = field(default_factory=_no_energy)
    owed: Array = field(default_factory=_no_energy)
    burned: float = 0.0

    def add(self, block: AuditedBlock, events: RunEvents) -> None:
        """Adds consecutive records, at least one."""
        ticks, parameters = block.ticks, self.parameters
        self.ticks += len(ticks)
        if parameters.scene_ticks:
            self._add_results(ticks)
        is_stale = has_flag(ticks, TickFlag.STALE_SAMPLE)
        self.fresh += int(np.count_nonzero(~is_stale))
        waited = np.where(is_stale, block.interval, 0.0)
        if waited.max() > self.silence:
            self.silence = float(waited.max())
            self.silent_tick = int(ticks["tick"][waited.argmax()])
        self.due = max(round(1e-9 * int(ticks["deadline_ns"][-1]) / parameters.period), self.ticks)
        self.overruns += int(np.count_nonzero(has_flag(ticks, TickFlag.OVERRUN)))
        rows = np.concatenate([block.state.row, ticks])
        steps = 1e-9 * np.diff(rows["deadline_ns"]) / parameters.period
        self.skipped += int(np.sum(np.round(steps) - 1))
        delay = 1e-9 * (rows["write_ns"] - rows["read_ns"])
        self.delays += float(np.sum(delay[1:]))
        lateness = 1e-9 * (rows["read_ns"] - rows["deadline_ns"])
        self.jitter += float(np.sum(np.maximum(np.diff(lateness), 0.0)))
        if not parameters.has_law:
            return
        elapsed = np.maximum(1e-9 * np.diff(rows["read_ns"]), parameters.period)
        scale, force_scale = parameters.scale, parameters.force_scale
        linear, angular = parameters.device_damping, parameters.device_rotational_damping
        motion, total, owed = block.motion, np.zeros(len(ticks)), np.zeros(len(ticks))
        both = springs(events.gains(ticks["tick"]), parameters)
        pulled = motion.pulled(parameters.law_evaluations)
        for kind, steps, b in (
            (0, motion.handle_step, (linear or 0.0) / (force_scale * scale)),
            (1, motion.handle_turn, (angular or 0.0) * scale / force_scale),
        ):
            gains = events.gains(ticks["tick"])[:, 2 * kind : 2 * kind + 2]
            square = np.where(block.is_first, 0.0, np.sum(steps**2, axis=1))
            needed = 0.5 * gains[:, 0] + gains[:, 1] / parameters.period
            across = _price_across(block, events) if kind else 0.0
            late = (
                needed + across - np.maximum(b, needed * parameters.period) / block.interval
            ) * square
            lent = np.concatenate([self.lent[kind : kind + 1], _drained(late, self.lent[kind])])
            half = 0.5 * gains[:, 0]
            price = np.divide(half**2, needed, out=np.zeros_like(half), where=needed > 0)
            last = np.concatenate([self.last_square[kind : kind + 1], square[:-1]])
            cost = _DELAY_PRICE * price * delay[:-1] / elapsed * np.maximum(square, last)
            cost = np.where(block.is_first, 0.0, cost)
            energy = _drained(cost + np.minimum(lent[:-1] + late, 0.0), self.uncovered[kind])
            total += energy
            paid = both[kind].energy(pulled[kind])
            debt = _drained(np.where(gains[:, 0] > 0, late - paid, 0.0), self.owed[kind])
            owed += debt
            self.lent[kind], self.uncovered[kind] = lent[-1], energy[-1]
            self.last_square[kind], self.owed[kind] = square[-1], debt[-1]
        ratio = force_scale / scale
        held = np.minimum(ratio * owed, np.maximum(ticks["device_energy"] - self._burn(block), 0.0))
        self.max_uncovered = max(self.max_uncovered, float(np.max(ratio * total + held)))

    def _burn(self, block: AuditedBlock) -> Array:
        """Returns the energy that the device's damping has burned at least by each tick, (n,)."""
        rows, guarding = np.concatenate([block.state.row, block.ticks]), self.parameters.guarding
        turned = turn_between(rows["device_quaternion"][:-1], rows["device_quaternion"][1:])
        power = guarding.assumed_damping * np.sum(np.diff(rows["device_position"], axis=0) ** 2, 1)
        power += guarding.assumed_rotational_damping * np.sum(turned**2, axis=1)
        burned = self.burned + np.cumsum(np.where(block.is_first, 0.0, power / block.interval))
        self.burned = float(burned[-1])
        return np.asarray(burned)

    def _add_results(self, ticks: NDArray[np.void]) -> None:
        is_new = np.diff(ticks["scene_step"], prepend=self.scene_steps) > 0
        results = ticks["tick"][is_new]
        ends = np.concatenate([[self.newest_result], results, [ticks["tick"][-1] + 1]])
        self.longest_silence = max(self.longest_silence, int(np.diff(ends).max()))
        self.newest_result = int(ends[-2])
        self.scene_steps = int(ticks["scene_step"][-1])


def _price_across(block: AuditedBlock, events: RunEvents) -> Array:
    """Returns the damping b_r/T in N m/rad that a torque across the motion costs, (n,)."""
    ticks, motion, parameters = block.ticks, block.motion, events.parameters
    is_whole = parameters.guarding.twist_damping == np.inf
    if parameters.scheme != Scheme.MIDPOINT or parameters.scene_ticks or is_whole:
        return np.zeros(len(ticks))
    gains = events.gains(ticks["tick"])
    k_r, rate = gains[:, 2], gains[:, 3] / parameters.period
    twist = turn_between(motion.tool_before[:, 3:], motion.handle_before[:, 3:])
    across = np.minimum(
        0.25 * k_r * np.linalg.norm(twist, axis=1), torque_across(gains, parameters)
    )
    sides, whole = np.hypot(k_r + rate, across) + np.hypot(rate, across), k_r + 2 * rate
    price = np.divide(sides**2, 2 * whole, out=np.zeros_like(whole), where=whole > 0) - 0.5 * whole
    return np.where(across > 0, price, 0.0)


def _drained(steps: Array, start: float) -> Array:
    """Returns the running sums max(0, sum + step) from a start >= 0, (n,)."""
    sums = start + np.cumsum(steps)
    return np.asarray(sums - np.minimum(np.minimum.accumulate(sums), 0.0))
