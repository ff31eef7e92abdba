"""Clocks: deadlines are multiples of the period, whatever happens in between."""

from __future__ import annotations

import time

import pytest

from hapticbridge import clock as clock_module
from hapticbridge.clock import RealClock, SimulatedClock, running_ns, slept_ns
from hapticbridge.run.session import SUSPENDED_NS

PERIOD = 1_000_000


class Wall:
    """A wall clock that the test moves; sleeping moves it too."""

    def __init__(self) -> None:
        self.ns = 5_000_000_000
        self.slept: list[float] = []

    def running_ns(self) -> int:
        self.ns += 100  # reading takes time, so that a spin ends
        return self.ns

    def sleep(self, seconds: float) -> None:
        self.slept.append(seconds)
        self.ns += round(seconds * 1e9)


@pytest.fixture
def wall(monkeypatch: pytest.MonkeyPatch) -> Wall:
    clock = Wall()
    monkeypatch.setattr(clock_module, "running_ns", clock.running_ns)
    monkeypatch.setattr(time, "sleep", clock.sleep)
    return clock


def test_simulated_time_is_the_number_of_ticks() -> None:
    clock = SimulatedClock()
    clock.start(PERIOD)
    assert [clock.wait() for _ in range(3)] == [(k * PERIOD, k * PERIOD, 0) for k in (1, 2, 3)]
    clock.start(PERIOD)
    assert clock.wait()[0] == 4 * PERIOD


def test_real_deadlines_do_not_drift_when_each_tick_takes_time(wall: Wall) -> None:
    clock = RealClock()
    clock.start(PERIOD)
    for k in range(1, 1000):
        deadline, wake, skipped = clock.wait()
        assert (deadline, skipped) == (k * PERIOD, 0)
        assert deadline <= wake < deadline + 1000
        wall.ns += 700_000


@pytest.mark.parametrize(("period", "slept"), [(PERIOD, 850e-6), (100_000, 25e-6)])
def test_a_wait_sleeps_and_spins_at_its_end_for_three_quarters_of_a_short_period_at_most(
    wall: Wall, period: int, slept: float
) -> None:
    """Else a real-time thread never sleeps, and the kernel stops it for 50 ms in each second."""
    clock = RealClock()
    clock.start(period)
    for _ in range(3):
        clock.wait()
    assert wall.slept == [pytest.approx(slept, abs=1e-6)] * 3


@pytest.mark.parametrize("missed", [0, 4])
def test_missed_deadlines_are_skipped_and_counted_not_caught_up(wall: Wall, missed: int) -> None:
    clock = RealClock()
    clock.start(PERIOD)
    clock.wait()
    wall.ns += (1 + missed) * PERIOD + 300_000
    deadline, wake, skipped = clock.wait()
    assert (deadline, skipped) == ((2 + missed) * PERIOD, missed)
    assert wake - deadline == pytest.approx(300_000, abs=2000)
    assert clock.wait()[0] == (3 + missed) * PERIOD


def test_time_begins_with_the_first_start(wall: Wall) -> None:
    """Events before the start are at 0, not at the hours that the machine has run."""
    clock = RealClock()
    wall.ns += 10_000_000_000
    assert clock.now() == 0
    clock.start(PERIOD)
    assert 0 < clock.now() < PERIOD


def test_time_stands_still_between_runs(wall: Wall) -> None:
    clock = RealClock()
    clock.start(PERIOD)
    clock.wait()
    wall.ns += 10_000_000_000
    clock.start(PERIOD)
    assert clock.wait()[0] == 2 * PERIOD


@pytest.mark.skipif(not hasattr(time, "CLOCK_BOOTTIME"), reason="only Linux tells")
def test_real_time_passes_while_the_machine_is_suspended(monkeypatch: pytest.MonkeyPatch) -> None:
    suspended = 7_000_000_000

    def told(which: int) -> int:
        return suspended if which == time.CLOCK_BOOTTIME else 0

    monkeypatch.setattr(time, "clock_gettime_ns", told)
    monkeypatch.setattr(time, "monotonic_ns", lambda: 0)
    assert running_ns() == slept_ns() == suspended


@pytest.mark.skipif(not hasattr(time, "CLOCK_BOOTTIME"), reason="only Linux tells")
def test_a_machine_that_is_awake_does_not_sleep() -> None:
    before = slept_ns()
    assert abs(slept_ns() - before) < SUSPENDED_NS
