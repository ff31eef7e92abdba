"""Second computation of a run's times and of the energy that its delays may have given.

It is ``kernel.timing`` over whole blocks, from recorded times and poses alone. With τ the time
between two samples, t_d the time from the last sample to its force, d the handle's motion with the
device and N = K T/2 + B', the energy of each kind of axis is

    A_k = max(0, A_{k−1} + 3 m (K/2)²/(N/T) (t_d/τ_k) max(d_k², d_{k−1}²) − p_k)

with k over samples and m ticks since the last one. p is what the device's damping burned beyond
N, less what it paid for late samples (``kernel.law.charge_lateness``) and for a torque across the
motion (``kernel.law.twist_price``). To it comes what late samples cost and springs could not pay,
C_k = max(0, C_{k−1} + c_k − V_k), up to what the wrenches gave the hand beyond what b burned; V is
the energy of the springs after the sample.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit.events import RunEvents
from hapticbridge.audit.motion import Array, torque_across, turn_between
from hapticbridge.audit.spring import springs
from hapticbridge.audit.wrench_limits import AuditedBlock, newest
from hapticbridge.kernel.codes import Scheme
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.kernel.record import TickFlag, has_flag

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
        last_square: Squared motions of the last sample, by kind of axis.
        owed: Energies C in J by kind of axis.
        burned: Energy in J that the device's damping has burned at least.
        tool_then: Pose of the tool after the tick of the last new sample, (1, 7).
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
    tool_then: Array = field(default_factory=lambda: np.zeros((1, 7)))

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
        if parameters.has_law:
            self._add_energies(block, events, delay)

    def _add_energies(self, block: AuditedBlock, events: RunEvents, delay: Array) -> None:
        """Adds what late samples and forces may have given; ``delay`` begins with the last tick."""
        ticks, parameters = block.ticks, self.parameters
        is_stale = has_flag(ticks, TickFlag.STALE_SAMPLE)
        is_new = np.concatenate([[True], ~is_stale | block.is_first])
        waited, stretched = block.sample_ticks - 1, self._stretched(block)
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
            half = 0.5 * gains[:, 0]
            price = np.divide(half**2, needed, out=np.zeros_like(half), where=needed > 0)
            burnt = np.maximum(b, needed * parameters.period) / block.interval
            late = (needed + across - burnt) * square
            more = gains[:, 0] * np.sum(stretched[kind] * steps, axis=1)
            more -= needed * np.sum(stretched[kind] ** 2, axis=1) / np.maximum(waited, 1)
            late += np.where((waited > 0) & ~block.is_first, np.maximum(more, 0.0), 0.0)
            lent = np.concatenate([self.lent[kind : kind + 1], _drained(late, self.lent[kind])])
            squares = np.concatenate([self.last_square[kind : kind + 1], square])
            at = np.maximum.accumulate(np.where(is_new, np.arange(len(squares)), 0))
            last = squares[at[:-1]]
            cost = _DELAY_PRICE * block.sample_ticks * price * delay[:-1] / block.interval
            cost = np.where(is_stale | block.is_first, 0.0, cost * np.maximum(square, last))
            energy = _drained(cost + np.minimum(lent[:-1] + late, 0.0), self.uncovered[kind])
            total += energy
            paid = both[kind].energy(pulled[kind])
            debt = _drained(np.where(gains[:, 0] > 0, late - paid, 0.0), self.owed[kind])
            owed += debt
            self.lent[kind], self.uncovered[kind] = lent[-1], energy[-1]
            self.last_square[kind], self.owed[kind] = squares[at[-1]], debt[-1]
        ratio = force_scale / scale
        held = np.minimum(ratio * owed, np.maximum(ticks["device_energy"] - self._burn(block), 0.0))
        self.max_uncovered = max(self.max_uncovered, float(np.max(ratio * total + held)))

    def _stretched(self, block: AuditedBlock) -> tuple[Array, Array]:
        """Returns how far the tool moved off since the last new sample, (n, 3) in m and rad."""
        poses = np.concatenate([self.tool_then, block.motion.tool_before])
        rows, begun = np.arange(len(block.ticks) + 1), np.append(newest(block.is_first), -1)
        begun[-1] = begun[-2]
        stale = has_flag(block.ticks[-1:], TickFlag.STALE_SAMPLE)[0]
        count = np.append(block.sample_ticks, 1 + block.sample_ticks[-1] * stale)
        then = poses[np.clip(np.maximum(rows - count + 1, begun) + 1, 0, len(poses) - 1)]
        self.tool_then, then = then[-1:], then[:-1]
        now = block.motion.tool_before
        return then[:, :3] - now[:, :3], turn_between(now[:, 3:], then[:, 3:])

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
