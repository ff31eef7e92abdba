"""The closed loop compiled whole: the same as the live loop, and trusted by the theory."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from random_hands import random_hand

from hapticbridge.coupling import Coupling
from hapticbridge.demand.certificate import conditions_of, default_coupling, is_certified
from hapticbridge.demand.loop_setting import LoopSetting
from hapticbridge.device import Hand, Motion, SimulatedDevice
from hapticbridge.errors import DeviceError
from hapticbridge.lab.closed_loop import PARTS, ClosedLoop, LoopOutcome, Timing
from hapticbridge.lab.methods import METHODS
from hapticbridge.scene import load_scene

T = 1e-3
COUPLING = Coupling(2000, 0.5, 2, 5e-4)
KNOCK = np.array([1e-4, 0, 0, 0, 0, 0])
STILL = Motion([0.0, 1.0], np.zeros((2, 3)))


@pytest.fixture(scope="module")
def point_mass() -> ClosedLoop:
    return ClosedLoop(load_scene("point_mass"))


def test_runs_in_threads_are_the_run_alone() -> None:
    scene = load_scene("peg_in_hole")

    def run(seed: int) -> LoopOutcome:
        hand = Hand(stiffness=100.0 + seed)
        device = SimulatedDevice(hand=hand, path="models/peg_in_hole/peg_in_hole.csv")
        return ClosedLoop(scene).run(
            device, COUPLING, METHODS["implicit"], ticks=600, keep_records=True
        )

    alone = [run(seed) for seed in range(4)]
    with ThreadPoolExecutor(2) as pool:
        together = list(pool.map(run, range(4)))
    for one, other in zip(alone, together, strict=True):
        assert one.records.tobytes() == other.records.tobytes()


def test_one_loop_runs_again_as_if_it_were_new(point_mass: ClosedLoop) -> None:
    def run(loop: ClosedLoop) -> bytes:
        device = SimulatedDevice(damping=3.0)
        outcome = loop.run(device, COUPLING, METHODS["implicit"], ticks=300, keep_records=True)
        return outcome.records.tobytes()

    first = run(point_mass)
    point_mass.run(SimulatedDevice(), Coupling(500, 2, 0, 0), METHODS["explicit"], ticks=50)
    assert run(point_mass) == first == run(ClosedLoop(load_scene("point_mass")))


def test_even_timing_changes_nothing_and_late_ticks_do(point_mass: ClosedLoop) -> None:
    def force(timing: Timing | None) -> LoopOutcome:
        device = SimulatedDevice(path="models/point_mass/point_mass.csv")
        return point_mass.run(
            device, COUPLING, METHODS["implicit"], ticks=400, timing=timing, keep_records=True
        )

    without, even, late = force(None), force(Timing()), force(Timing(jitter=0.5, seed=1))
    assert without.records.tobytes() == even.records.tobytes()
    assert without.records.tobytes() != late.records.tobytes()


def test_device_is_exact_between_uneven_ticks(point_mass: ClosedLoop) -> None:
    # a damped oscillation of device and hand, whenever it is looked at
    mass, damping, stiffness = 0.2, 0.5, 400.0
    timing = Timing(jitter=0.9, drops=0.3, seed=4)
    hand = Hand(
        mass=0,
        damping=0,
        stiffness=stiffness,
        rotational_inertia=0,
        rotational_damping=0,
        rotational_stiffness=0,
    )
    outcome = point_mass.run(
        SimulatedDevice(mass=mass, damping=damping, hand=hand, path=STILL),
        Coupling(1e-9, 0, 0, 0),
        METHODS["implicit"],
        ticks=200,
        timing=timing,
        knock=KNOCK,
        keep_records=True,
    )
    intervals = timing.intervals(200)
    time = np.cumsum(intervals - intervals[0] * (np.arange(200) == 0)) * T / PARTS
    decay = damping / (2 * mass)
    swing = math.sqrt(stiffness / mass - decay**2)
    expected = np.exp(-decay * time) * (np.cos(swing * time) + decay / swing * np.sin(swing * time))
    assert outcome.records["device_position"][:, 0] == pytest.approx(1e-4 * expected, abs=1e-12)


@pytest.mark.parametrize("delay", [0, 1, 5])
def test_a_delay_is_as_long_where_the_device_moves_in_parts(
    point_mass: ClosedLoop, delay: int
) -> None:
    """So few drops that none happens: the device is moved in sixteenths, ticks come on time."""
    outcomes = [
        point_mass.run(
            SimulatedDevice(hand=None, delay=delay),
            Coupling(800, 0.2, 0.5, 1e-4),
            METHODS["implicit"],
            ticks=1500,
            knock=KNOCK,
            timing=timing,
            keep_records=True,
        )
        for timing in (None, Timing(drops=1e-15))
    ]
    even, parts = outcomes
    assert even.is_stable == parts.is_stable == (delay < 5)
    count = min(even.ticks, parts.ticks)
    assert count > 100
    for name in ("device_position", "wrench_on_tool"):
        expected = even.records[name][:count]
        scale = np.abs(expected).max()
        assert parts.records[name][:count] == pytest.approx(expected, abs=1e-6 * scale)


def test_intervals_are_whole_parts_that_add_up_to_the_time() -> None:
    ticks = 50_000
    jittered = Timing(jitter=0.5, seed=2).intervals(ticks)
    assert jittered.min() >= 1
    assert abs(int(jittered.sum()) - PARTS * ticks) <= PARTS
    dropped = Timing(drops=0.25, seed=2).intervals(ticks)
    assert set(np.unique(dropped % PARTS)) == {0}
    # a share p of ticks missed makes the mean interval T/(1 − p)
    assert dropped.mean() == pytest.approx(PARTS / 0.75, rel=0.02)
    assert np.array_equal(Timing(jitter=0.3, seed=7).intervals(50), Timing(0.3, 0, 7).intervals(50))


def test_a_delay_too_long_for_the_parts_of_a_period_is_refused(point_mass: ClosedLoop) -> None:
    with pytest.raises(DeviceError, match="at most 6"):
        point_mass.run(
            SimulatedDevice(delay=7), COUPLING, METHODS["implicit"], timing=Timing(drops=0.1)
        )


@pytest.mark.parametrize(
    ("jitter", "most"), [(0.0, 0), (0.06, 0), (0.0625, 1), (0.13, 2), (0.9, 14)]
)
def test_no_tick_is_later_than_jitter_says(jitter: float, most: int) -> None:
    timing = Timing(jitter=jitter, seed=5)
    late = np.cumsum(timing.intervals(5000) - PARTS)
    assert (late.min(), late.max()) == (0, most)
    assert most <= jitter * PARTS
    assert timing.is_even == (most == 0)
    assert np.bincount(late) == pytest.approx(np.full(most + 1, 5000 / (most + 1)), rel=0.2)


@pytest.mark.parametrize("name", ["implicit", "lossless"])
def test_no_random_passive_hand_turns_a_certified_coupling_unstable_or_active(
    name: str, point_mass: ClosedLoop
) -> None:
    info, method = SimulatedDevice().info, METHODS[name]
    coupling = default_coupling(info, T, method=method)
    law = method.law_coupling(coupling, T)
    assert is_certified(conditions_of(LoopSetting(info=info, law=law, period=T)))
    for seed in range(20):
        outcome = point_mass.run(
            SimulatedDevice(hand=random_hand(seed), path=STILL),
            coupling,
            method,
            ticks=6000,  # its windows hold most of a swing of the slowest hand
            knock=np.array([1e-3, -5e-4, 2e-4, 0.02, 0.01, -0.02]),
        )
        assert outcome.is_stable, seed
        assert outcome.last_force < 1e-3 * outcome.peak_force, seed
        assert (outcome.environment, outcome.fault) == ("strict", None), seed
