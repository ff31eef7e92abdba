"""Claims of the map ``rate``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from map_runs import boundary_of

from hapticbridge.lab.closed_loop import PARTS, Timing
from hapticbridge.lab.maps import rate
from hapticbridge.lab.maps.base import Point


def point(name: str, period: float, delay: int) -> Point:
    at: Point = {"what": "delay", "method": name, "hand": "worst hand", "period": period}
    return at | {"delay": delay, "share": 0.0}


@pytest.mark.parametrize("name", rate.METHODS_SHOWN)
@pytest.mark.parametrize(("period", "delay"), [(1e-4, 1), (1e-3, 0), (5e-3, 5)])
def test_the_worst_hand_is_unstable_above_the_bound_and_stable_below(
    name: str, period: float, delay: int
) -> None:
    limit = rate.wall_limit(name, period, delay)
    failed = rate.worst_hand(name, 1.02 * limit, period, delay)
    assert not failed.is_stable
    # the wall gives nothing: at fault is the port to the device, which is given energy (the meter
    # knows what was sent, so with a delay its sum says nothing)
    assert failed.environment == "strict"
    assert delay > 0 or failed.device_energy > 0
    assert rate.worst_hand(name, 0.98 * limit, period, delay).is_stable


@pytest.mark.parametrize("delay", [0, rate.DELAYS - 1])
def test_a_wall_far_too_stiff_is_unstable_too(delay: int) -> None:
    # there the worst hand swings once in hundreds of ticks
    for name in rate.METHODS_SHOWN:
        for stiffness in (3 * rate.wall_limit(name, 5e-3, delay), rate.SEARCHED[1]):
            assert not rate.worst_hand(name, stiffness, 5e-3, delay).is_stable


def test_without_delay_the_bound_is_that_of_the_paper_and_doubles_with_the_rate() -> None:
    assert rate.wall_limit("implicit", 1e-3, 0) == pytest.approx(
        2 * (rate.DEVICE_DAMPING - rate.DAMPING) / 1e-3, rel=1e-3
    )
    for name in rate.METHODS_SHOWN:
        for delay in (0, 3):
            ratio = rate.wall_limit(name, 5e-4, delay) / rate.wall_limit(name, 1e-3, delay)
            assert ratio == pytest.approx(2, rel=1e-3)


@pytest.mark.parametrize(
    ("name", "lag"), [("implicit", 0.0), ("compensated", 1), ("lossless", 0.5)]
)
def test_a_delay_costs_stiffness_as_the_spectrum_says(name: str, lag: float) -> None:
    theta = np.linspace(1e-4, np.pi, 20_001)
    for delay in (1, 4):
        kt = rate.wall_limit(name, 1e-3, delay) * 1e-3
        needed = kt / 2 * np.sin((2 * delay + 1) * theta / 2) / np.sin(theta / 2)
        needed -= max(rate.DAMPING - lag * kt, 0.0) * np.cos((delay + 1) * theta)
        assert needed.max() == pytest.approx(rate.DEVICE_DAMPING, rel=1e-3)


def test_a_search_finds_the_bound() -> None:
    for name, delay in (("implicit", 2), ("compensated", 1), ("lossless", 0)):
        found = rate.evaluate(point(name, 1e-3, delay))
        assert found["limit"] == pytest.approx(rate.wall_limit(name, 1e-3, delay), rel=2e-3)


def test_behind_a_fast_loop_a_slow_scene_keeps_the_bound_of_the_loop() -> None:
    full = 2 * rate.DEVICE_DAMPING / rate.UNEVEN_PERIOD
    for ticks in rate.SCENE_TICKS:
        assert not rate.behind_a_loop(1.02 * full, ticks).is_stable
        assert rate.behind_a_loop(0.98 * full, ticks).is_stable
    # the same scene in a loop as slow as itself bears a twentieth
    slow = rate.wall_limit("lossless", 20 * rate.UNEVEN_PERIOD, 0)
    assert slow < 1.01 * full / 20
    assert not rate.worst_hand("lossless", 1.02 * slow, 20 * rate.UNEVEN_PERIOD, 0).is_stable


def test_half_of_all_ticks_lost_costs_a_free_device_two_thirds_of_its_stiffness() -> None:
    # geometric gaps: E[T]/E[T²] = (1 − p)/(1 + p)/T, a third of the even ticks' 1/T
    even, lost = Timing(), Timing(drops=0.5, seed=1)
    full = 2 * rate.DEVICE_DAMPING / rate.UNEVEN_PERIOD
    assert rate.finite_hand("implicit", "no hand", 0.97 * full, even).is_stable
    assert not rate.finite_hand("implicit", "no hand", 0.97 * full, lost).is_stable
    assert not rate.finite_hand("implicit", "no hand", 1.3 * full / 3, lost).is_stable
    assert rate.finite_hand("implicit", "no hand", 0.75 * full / 3, lost).is_stable
    assert rate.finite_hand("implicit", "ordinary hand", 0.97 * full, lost).is_stable


def test_uneven_ticks_are_told_by_three_periods_and_an_ordinary_hand_bears_more() -> None:
    told = rate.unevenness([1e-3, 1e-3, 2e-3])
    assert told == pytest.approx({"mean": 4e-3 / 3, "longest": 2e-3, "balanced": 6e-3 / 4})
    lost: Point = {"what": "drops", "method": "implicit", "hand": "no hand", "share": 0.5}
    found = rate.evaluate(lost | {"period": 1e-3, "delay": 0})
    # geometric gaps: E[T] = T/(1 − p), E[T²]/E[T] = T (1 + p)/(1 − p)
    assert found["mean"] == pytest.approx(2e-3, rel=0.05)
    assert found["balanced"] == pytest.approx(3e-3, rel=0.05)
    held = rate.evaluate(lost | {"period": 1e-3, "delay": 0, "hand": "ordinary hand"})
    assert float(held["limit"]) > 3 * float(
        found["limit"]
    )  # an ordinary hand takes its share of the energy
    longest = max(Timing(drops=0.5, seed=s).intervals(rate.TICKS).max() for s in range(rate.SEEDS))
    assert found["longest"] == pytest.approx(1e-3 * longest / PARTS)


@pytest.mark.parametrize("hand", ["no hand", "ordinary hand"])
@pytest.mark.parametrize("timing", [Timing(jitter=0.9, seed=2), Timing(drops=0.3, seed=2)])
def test_below_the_bound_at_the_longest_interval_nothing_fails(hand: str, timing: Timing) -> None:
    longest = timing.intervals(2000).max() / 16 * rate.UNEVEN_PERIOD
    assert rate.finite_hand(
        "implicit", hand, 0.98 * 2 * rate.DEVICE_DAMPING / longest, timing
    ).is_stable

    # K T/(2b): 0.55 and 1.1, their mean; theory at a delay of 5 is 0.526


def is_kept(each: Point) -> bool:
    """Keeps one method without a delay and with the longest, and free devices that lose ticks."""
    if each["hand"] == "worst hand":
        return each["delay"] in (0, 5) and each["method"] == "lossless"
    return (each["hand"], each["what"]) == ("no hand", "drops")


def test_the_map_says_what_its_table_holds(tmp_path: Path) -> None:
    boundary = boundary_of(rate, tmp_path, 20, is_kept)
    by_delay = boundary["methods"]["lossless"]
    assert set(by_delay) == {"0", "5"}
    for mine in by_delay.values():
        assert mine["worst_ratio_error"] < 2e-3
        assert mine["slope"] == pytest.approx(-1, abs=0.01)
    free = boundary["uneven"]["drops"]["no hand"]
    assert free["at_longest"][-1] < free["measured"][-1] < free["at_mean"][-1]
