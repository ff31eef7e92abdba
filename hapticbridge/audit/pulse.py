"""Second computation of the account that pays for pulses after blows (``kernel.impact_pulse``)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit.events import RunEvents
from hapticbridge.audit.motion import Array
from hapticbridge.audit.structure import TOLERANCE, Deviation
from hapticbridge.audit.wrench_limits import AuditedBlock
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.kernel.record import UNITS, TickFlag, has_flag
from hapticbridge.kernel.restitution import BLOW_SPEED

BLOW = {
    "blow_energy": 0.0,
    "blow_speed": BLOW_SPEED,
    "blow_restitution": 0.0,
    "blow_rebound": 0.0,
}
"""Smallest value of each number of a blow; without a blow all are 0."""


def _most(size: Array, spare: Array, speed: float) -> Array:
    """Returns the largest (‖p‖ − b_s u) u in W for 0 <= u <= v, by the shape of its operands."""
    slow = np.divide(0.5 * size, spare, out=np.full_like(size + spare, np.inf), where=spare > 0)
    u = np.minimum(slow, speed)
    return np.asarray((size - spare * u) * u)


def _held(sizes: Array, is_new: NDArray[np.bool_], before: float) -> Array:
    """Returns the largest pulse in N that the device may hold in each tick, (n,).

    Args:
        sizes: Largest pulse in N of those that are new enough, (n,).
        is_new: True if it holds none that is older.
        before: Value before the first of these ticks.
    """
    held = accumulate(
        zip(sizes, is_new, strict=True),
        lambda held, step: max(0.0 if step[1] else held, step[0]),
        initial=before,
    )
    return np.fromiter(held, float, len(sizes) + 1)[1:]


@dataclass(frozen=True, slots=True)
class PulseBalance:
    """Energies of pulses in some ticks, cumulative from the first tick on.

    Attributes:
        account: What may still pay for pulses, after each tick, (n,) in J.
        work: Σ p·δp until the tick's sample, (n,) in J.
        taken: Energy in J of the scene that blows paid in and the tank of rigid contacts did not
            get, (n,); at the hand it is force_scale / scale times as much.
        short: Charges to come that the account does not cover where a pulse is sent, (n,) in J.
        size: Size of what was added up, (n,) in J.
        spare: b_s, on which pulses count, (n,) in N s/m; 0 from the first change of the coupling.
        held: Largest pulse that the device may hold until each tick, (n,) in N.
    """

    account: Array
    work: Array
    taken: Array
    short: Array
    size: Array
    spare: Array
    held: Array

    @classmethod
    def of(cls, block: AuditedBlock, events: RunEvents, created: Array) -> PulseBalance:
        """Computes the balance of a block; ``created`` is Σ E_k after each tick, (n,) in J."""
        ticks, parameters, state = block.ticks, events.parameters, block.state
        n, ratio = len(ticks), parameters.energy_ratio
        if parameters.impact_pulses == 0.0:
            return cls(*(np.zeros(n) for _ in range(7)))
        before, d = state.sums, parameters.pulse_ticks
        speed, period = parameters.pulse_speed, parameters.period
        spare = np.where(ticks["tick"] < events.first_change, parameters.pulse_damping, 0.0)
        rows = np.concatenate([state.row, ticks])
        moved = np.diff(rows["device_position"], axis=0)
        elapsed = np.maximum(1e-9 * np.diff(rows["read_ns"]), period)
        stale = has_flag(rows, TickFlag.STALE_SAMPLE)
        is_known = ~stale[1:] & ~stale[:-1]
        is_reset = events.is_reset(ticks["tick"])
        is_new = ~stale[:-1] | (rows["lever"][:-1] == 0.0) | block.is_first | is_reset
        # pulses of the d + 1 ticks before each one; a pause makes the device forget them
        pulses = np.concatenate([state.pulses, ticks["pulse"]])
        breaks = np.cumsum(block.is_first)
        era = np.concatenate([np.zeros(d + 1, np.int64), breaks])
        work, sizes, works = np.full(n, -np.inf), list[Array](), list[Array]()
        low, high = np.full((n, 3), np.inf), np.full((n, 3), -np.inf)
        for j in range(d + 1):
            first = d - j
            sent = np.where((era[first : first + n] == breaks)[:, None], pulses[first:][:n], 0.0)
            sizes.append(np.linalg.norm(sent, axis=1))
            works.append(np.sum(sent * moved, axis=1))
            work = np.maximum(work, works[-1])
            low, high = np.minimum(low, sent), np.maximum(high, sent)
        held = _held(np.max(sizes, axis=0), is_new, before["pulse_held"])
        spread = np.sum((high - low) ** 2, axis=1)
        unknown = np.divide(
            elapsed * spread, 16.0 * spare, out=np.full(n, np.inf), where=spare > 0.0
        )
        work = work + np.where(spread > 0.0, unknown, 0.0)
        most = elapsed * _most(held, spare, speed)
        charge = np.where(is_known, np.minimum(work, most), most)
        burned = np.maximum(-np.diff(created, prepend=before["created"]), 0.0)
        taken = parameters.impact_pulses * np.minimum(ticks["blow_energy"], burned)
        earned = ratio * taken
        own = np.linalg.norm(ticks["pulse"], axis=1)
        to_come, covered = (
            period * np.sum([_most(size, spare, speed) for size in accumulate(each, np.maximum)], 0)
            for each in ((np.zeros(n), *sizes[:d]), (own, *sizes[:d]))
        )
        kept = math.exp(-period / parameters.pulse_decay)

        def after(account: float, step: tuple[float, ...]) -> float:
            charge, to_come, earned = step
            free = max(account - charge, 0.0) - to_come
            return free + to_come - max(free, 0.0) * (1.0 - kept) + earned

        steps = zip(charge, to_come, earned, strict=True)
        accounts = accumulate(steps, after, initial=before["pulse_account"])
        account = np.fromiter(accounts, float, n + 1)[1:]
        return cls(
            account=account,
            work=before["pulse_work"] + np.cumsum(works[0]),
            taken=before["pulse_taken"] + np.cumsum(taken),
            short=np.where(own > 0.0, covered - (account - earned), 0.0),
            size=before["pulse_size"] + np.cumsum(np.abs(works[0]) + earned),
            spare=spare,
            held=held,
        )

    @property
    def sums(self) -> dict[str, Array]:
        """Cumulative energies that the next block continues, by the names of ``events.SUMS``."""
        return {
            "pulse_account": self.account,
            "pulse_work": self.work,
            "pulse_taken": self.taken,
            "pulse_size": self.size,
            "pulse_held": self.held,
        }

    def paid(self, before: dict[str, float], run: RunParameters) -> Array:
        """Returns the work that blows had paid for at each tick's sample, (n,) in J."""
        taken = np.concatenate([[before["pulse_taken"]], self.taken[:-1]])
        return np.asarray(np.minimum(self.work, run.force_scale / run.scale * taken))

    def deviations(self, block: AuditedBlock) -> Iterator[Deviation]:
        """Yields the deviations of account, pulses and blows."""
        ticks, allowed = block.ticks, TOLERANCE * (1 + self.size)
        off = np.abs(ticks["pulse_account"] - self.account)
        yield Deviation("pulse_account", off, allowed, "J", "blows, pulses and device poses")
        yield Deviation("pulse", self.short, allowed, "J", "the account of blows")
        has_blow = ticks["blow_energy"] > 0.0
        for name, least in BLOW.items():
            wrong = np.where(has_blow, least - ticks[name], np.abs(ticks[name]))
            yield Deviation(name, wrong, 0.0, UNITS[name], "blows")
