"""Processor cost of a scene: time of a tick, its stages, and its growth with contacts."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.check.growth import Growth, Spread, growth_of
from hapticbridge.check.rehearsal import not_finite, rehearsal_parameters
from hapticbridge.coupling import Coupling
from hapticbridge.jit import direct
from hapticbridge.kernel.codes import OK
from hapticbridge.kernel.publish import publish
from hapticbridge.kernel.state import Binding
from hapticbridge.kernel.step import after_step, before_step
from hapticbridge.recording import TAIL, Ring
from hapticbridge.recording.stream import NOBODY_READS
from hapticbridge.scene import Scene

_TIMER = mujoco.mjtTimer
STAGES: dict[str, int] = {
    "kinematics": int(_TIMER.mjTIMER_POS_KINEMATICS),
    "inertia": int(_TIMER.mjTIMER_POS_INERTIA),
    "collision": int(_TIMER.mjTIMER_POS_COLLISION),
    "constraint rows": int(_TIMER.mjTIMER_POS_MAKE),
    "projection": int(_TIMER.mjTIMER_POS_PROJECT),
    "velocity": int(_TIMER.mjTIMER_VELOCITY),
    "actuation": int(_TIMER.mjTIMER_ACTUATION),
    "solver": int(_TIMER.mjTIMER_CONSTRAINT),
    "integration": int(_TIMER.mjTIMER_ADVANCE),
}
"""Stages of MuJoCo's step and the ids of its built-in timers; no stage contains another."""

REST, BRIDGE = "rest of the step", "bridge"
"""Step time that no timer covers; and time outside the step: coupling, energies, guard and
record."""

WARM_UP = 50
"""Number of ticks at the start that are not counted, because the caches are cold."""

PASSES = 2
"""Number of times that the motion is timed; the ticks of all passes count."""

TICK_SHARE = 0.5
"""Share of a period that the tick's 99th percentile may fill, without unit. The rest is left for
the device's transfer and for late wake-ups, which cannot be measured here."""

_RING = 1 << 12  # records; without a reader the newest stay


@dataclass(frozen=True, slots=True)
class Cost:
    """Tick times of a scene on this machine, in s.

    Attributes:
        free: Whole ticks out of contact.
        contact: Whole ticks in contact.
        all_ticks: All whole ticks.
        stages: Median time of each stage, out of contact and in contact; nan if there was no such
            tick.
        highest_rate: Rate in Hz at which the 99th percentile of all ticks fills ``TICK_SHARE`` of a
            period.
        by_contacts: Growth with the number of contacts.
        by_rows: Growth with the number of constraint rows.
    """

    free: Spread
    contact: Spread
    all_ticks: Spread
    stages: dict[str, tuple[float, float]]
    highest_rate: float
    by_contacts: Growth
    by_rows: Growth


def measure_cost(
    scene: Scene,
    samples: NDArray[np.void],
    coupling: Coupling,
    period: float,
    *,
    clock: Callable[[], int] = time.perf_counter_ns,
    progress: Callable[[int, int], None] | None = None,
) -> Cost:
    """Times a scene under its motion: whole ticks as in the live loop, then the stages.

    A tick is the bridge's arithmetic before and after MuJoCo's step, the step, and the hand-over of
    the record. Device and recorder are left out. Arguments are those of ``rehearse``. ``clock``
    returns the time in ns; ``progress`` is called with the number of ticks done and the total.

    Raises:
        SceneError: A value is out of range, or a result is not finite.
    """
    total = (PASSES + 1) * samples.size

    def report_progress(number: int) -> None:
        if progress is not None:
            progress(number * samples.size, total)

    ticks, contacts, rows = [], [], []
    for k in range(PASSES):
        report_progress(k)
        times, touching, counted = _time_ticks(scene, samples, coupling, period, clock)
        ticks.append(times[WARM_UP:])
        contacts.append(touching[WARM_UP:])
        rows.append(counted[WARM_UP:])
    report_progress(PASSES)
    stages, touching = _time_stages(scene, samples, coupling, period)
    report_progress(PASSES + 1)
    time_of, contacts_of = np.concatenate(ticks), np.concatenate(contacts)
    is_free = contacts_of == 0
    free, contact = Spread.of(time_of[is_free]), Spread.of(time_of[~is_free])
    all_ticks = Spread.of(time_of)
    medians = {
        name: (_median(times[touching == 0]), _median(times[touching > 0]))
        for name, times in stages.items()
    }
    whole = [sum(each[k] for each in medians.values()) for k in (0, 1)]
    medians[BRIDGE] = (max(free.median - whole[0], 0.0), max(contact.median - whole[1], 0.0))
    return Cost(
        free=free,
        contact=contact,
        all_ticks=all_ticks,
        stages=medians,
        highest_rate=float(np.divide(TICK_SHARE, all_ticks.p99)),
        by_contacts=growth_of(contacts_of, time_of),
        by_rows=growth_of(np.concatenate(rows), time_of),
    )


def _time_ticks(
    scene: Scene,
    samples: NDArray[np.void],
    coupling: Coupling,
    period: float,
    clock: Callable[[], int],
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Returns time in s, contacts and constraint rows of every tick."""
    binding = Binding(scene.model, scene.data, rehearsal_parameters(scene, coupling, period))
    state, row, ring = binding.state, binding.row, Ring.local(_RING)
    ring.cursors[TAIL] = NOBODY_READS
    before = direct(before_step, state, samples[:1], row, 0, period)
    after = direct(after_step, state, row, 0)
    hand_over = direct(publish, row, ring.rows, ring.cursors, 0, 0, 0, 0, 0)
    step, model, data = mujoco.mj_step, scene.model, scene.data
    records, cursors = ring.rows, ring.cursors
    times = np.zeros(samples.size)
    contacts, rows = np.zeros((2, samples.size), np.int64)
    singles = [samples[k : k + 1] for k in range(samples.size)]
    for k, sample in enumerate(singles):
        begin = clock()
        code = before(state, sample, row, 0, period)
        step(model, data)
        code = max(code, after(state, row, 0))
        hand_over(row, records, cursors, begin, begin, begin, begin, 0)
        times[k] = clock() - begin
        if code != OK:
            raise not_finite(scene, k, samples.size)
        contacts[k], rows[k] = (
            int(row["contacts"][0]),
            data.nefc,
        )  # without near misses
    ring.close()
    return 1e-9 * times, contacts, rows


def _time_stages(
    scene: Scene, samples: NDArray[np.void], coupling: Coupling, period: float
) -> tuple[dict[str, NDArray[np.float64]], NDArray[np.int64]]:
    """Returns the time in s of every stage of every step by MuJoCo's timers, and the contacts."""
    binding = Binding(scene.model, scene.data, rehearsal_parameters(scene, coupling, period))
    state, row, model, data = binding.state, binding.row, scene.model, scene.data
    spent = np.zeros((samples.size, int(_TIMER.mjNTIMER)))
    contacts = np.zeros(samples.size, np.int64)
    durations = data.timer.duration
    for k in range(samples.size):
        before_step(state, samples[k : k + 1], row, 0, period)
        earlier = durations.copy()  # energies are refreshed after the step, by stages with timers
        mujoco.mj_step(model, data)
        spent[k] = durations - earlier
        after_step(state, row, 0)
        contacts[k] = int(row["contacts"][0])
    stages = {name: spent[WARM_UP:, timer] for name, timer in STAGES.items()}
    whole = spent[WARM_UP:, int(_TIMER.mjTIMER_STEP)]
    stages[REST] = np.maximum(whole - sum(stages.values()), 0.0)
    return stages, contacts[WARM_UP:]


def _median(times: NDArray[np.float64]) -> float:
    return float(np.median(times)) if times.size else float("nan")
