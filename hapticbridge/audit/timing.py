"""Second computation of a run's times and of the energy that its delays may have given.

It is ``kernel.timing`` over whole blocks, from recorded times and poses alone. The wrenches are a
function of time that is constant between their arrivals, and its integrals between two samples are
sums over the parts that arrivals and samples cut.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import accumulate, islice, pairwise

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit.energy import EnergyBalance
from hapticbridge.audit.motion import Array, turn_between
from hapticbridge.audit.wrench_limits import (
    AuditedBlock,
    axes_with_motor,
    whole_wrench,
    without_pulse,
)
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.kernel.record import TickFlag, has_flag

_LATE = 1.5  # time between two samples in T, above which the later one is late


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
        uncovered: Energy A in J.
        stored: q (W_c + V − V_0) after the tick of the last new sample, in J.
        since: Time of that sample in ns.
        arrivals: Times in ns from which the device holds a wrench: the newest that it holds, and
            all that are on their way.
        wrenches: These wrenches in N and N m, (n, 6).
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
    uncovered: float = 0.0
    stored: float = 0.0
    since: int = 0
    arrivals: NDArray[np.int64] = field(default_factory=lambda: np.zeros(1, np.int64))
    wrenches: Array = field(default_factory=lambda: np.zeros((1, 6)))

    def add(self, block: AuditedBlock, balance: EnergyBalance) -> None:
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
            self._add_account(block, balance)

    def _add_account(self, block: AuditedBlock, balance: EnergyBalance) -> None:
        """Adds what late samples and forces may have given."""
        ticks, parameters, stored = block.ticks, self.parameters, balance.coupling_account
        is_new = ~has_flag(ticks, TickFlag.STALE_SAMPLE) | block.is_first
        edges = np.unique([0, *np.flatnonzero(block.is_first), len(ticks)])
        rows = np.concatenate([block.state.row, ticks])
        steps = np.zeros(len(ticks))
        for first, end in pairwise(edges):
            part = ticks[first:end]
            if block.is_first[first]:  # the device held no force
                self.arrivals, self.wrenches = part["read_ns"][:1], np.zeros((1, 6))
                self.since, self.stored = int(part["read_ns"][0]), float(stored[first])
            chosen = np.flatnonzero(is_new[first:end])
            sent = part[chosen]
            delay = round(1e9 * parameters.device_delay)
            self.arrivals = np.concatenate([self.arrivals, sent["write_ns"] + delay])
            self.wrenches = np.concatenate([self.wrenches, without_pulse(sent)])
            times = np.concatenate([[self.since], sent["read_ns"]])
            lever = block.lever_before[first:end][chosen]
            spare = balance.pulses.spare[first:end][chosen]
            change = np.diff(np.concatenate([[self.stored], stored[first:end][chosen]]))
            energy = self._energy(times, (rows[first + chosen], sent), lever, spare)
            steps[first + chosen] = change + energy
            if len(chosen):
                self.since, self.stored = int(times[-1]), float(stored[first + chosen[-1]])
            last = max(int(np.searchsorted(self.arrivals, self.since, "right")) - 1, 0)
            self.arrivals, self.wrenches = self.arrivals[last:], self.wrenches[last:]
        steps[block.is_first] = 0.0
        is_behind = parameters.device_delay > 0.0
        credit = parameters.guarding.energy_credit_limit if is_behind else 0.0
        # one by one, so that no end of a block changes a bit
        sums = accumulate(steps, lambda a, step: max(a + step, -credit), initial=self.uncovered)
        uncovered = np.fromiter(islice(sums, 1, None), float, len(steps))
        self.uncovered = float(uncovered[-1])
        if is_behind:
            ratio = parameters.energy_ratio
            created = ticks["environment_energy"] + balance.pulses.taken
            uncovered = uncovered + ratio * np.maximum(created, 0.0)
        self.max_uncovered = max(self.max_uncovered, float(np.max(uncovered)))

    def _energy(
        self,
        times: NDArray[np.int64],
        records: tuple[NDArray[np.void], NDArray[np.void]],
        lever: Array,
        spare: Array,
    ) -> Array:
        """Returns E_k + u'_k·δp_k of ``kernel.timing``, (n,) in J.

        Args:
            times: Times of the samples, and of the one before them, in ns.
            records: Records before each sample, and its own.
            lever: r_{k−1}, (n,).
            spare: Damping in N s/m that pulses count on, (n,).
        """
        before, samples = records
        parameters, guarding = self.parameters, self.parameters.guarding
        time = 1e-9 * np.diff(times)[:, None]
        is_late = (time > _LATE * parameters.period) | (parameters.credit > 0.0)
        time = np.where(time > 0, time, np.inf)
        points = np.unique(np.concatenate([self.arrivals, times]))
        points = points[(points >= times[0]) & (points <= times[-1])]
        held = np.maximum(np.searchsorted(self.arrivals, points[:-1], "right") - 1, 0)
        parts = 1e-9 * np.diff(points)[:, None]
        begins = np.minimum(np.searchsorted(points, times[:-1]), max(len(parts) - 1, 0))
        if len(parts) == 0:
            return np.zeros(len(samples))
        impulse, square = (
            np.add.reduceat(parts * values[held], begins, axis=0)
            for values in (self.wrenches, self.wrenches**2)
        )
        moved = samples["device_position"] - before["device_position"]
        turned = turn_between(before["device_quaternion"], samples["device_quaternion"])
        motion = np.concatenate([moved, turned], axis=1)
        whole = samples["lever"]
        ratio = np.divide(lever, whole, out=np.zeros_like(whole), where=whole > 0)[:, None]
        sent = ratio * without_pulse(samples)
        linear = guarding.assumed_damping - spare
        angular = np.full_like(spare, guarding.assumed_rotational_damping)
        b = np.repeat(np.stack([linear, angular], axis=1), 3, axis=1)
        middle = np.where(is_late, impulse / time, sent)
        unfelt = ratio * whole_wrench(samples, parameters)
        unfelt = unfelt * (1.0 - axes_with_motor(parameters))
        spread = np.maximum(square - 2 * middle * impulse + time * middle**2, 0.0)
        work = (middle + unfelt) * motion - np.where(is_late, b * motion**2 / time, 0.0)
        work += np.divide(spread, 4.0 * b, out=np.zeros_like(spread), where=b > 0)
        return np.where(np.isfinite(time[:, 0]), np.sum(work, axis=1), 0.0)

    def _add_results(self, ticks: NDArray[np.void]) -> None:
        is_new = np.diff(ticks["scene_step"], prepend=self.scene_steps) > 0
        results = ticks["tick"][is_new]
        ends = np.concatenate([[self.newest_result], results, [ticks["tick"][-1] + 1]])
        self.longest_silence = max(self.longest_silence, int(np.diff(ends).max()))
        self.newest_result = int(ends[-2])
        self.scene_steps = int(ticks["scene_step"][-1])
