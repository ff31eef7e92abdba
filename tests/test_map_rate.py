"""Claims of the map ``rate``."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from hapticbridge.study.closed_loop import Timing
from hapticbridge.study.maps.rate import (
    DAMPING,
    DEVICE_DAMPING,
    RATE,
    UNEVEN_PERIOD,
    evaluate,
    finite_hand,
    wall_limit,
    worst_hand,
)
from hapticbridge.study.maps.stability_map import run_map


@pytest.mark.parametrize("period", [1e-4, 1e-3, 5e-3])
@pytest.mark.parametrize("delay", [0, 1, 5])
def test_the_worst_hand_is_unstable_above_the_bound_and_stable_below(
    period: float, delay: int
) -> None:
    limit = wall_limit(period, delay)
    failed = worst_hand(1.02 * limit, period, delay)
    assert not failed.is_stable
    # the wall gives nothing: at fault is the port to the device, which is given energy (the meter
    # knows what was sent, so with a delay its sum says nothing)
    assert failed.environment == "strict"
    assert delay > 0 or failed.device_energy > 0
    assert worst_hand(0.98 * limit, period, delay).is_stable


def test_without_delay_the_bound_is_that_of_the_paper_and_doubles_with_the_rate() -> None:
    assert wall_limit(1e-3, 0) == pytest.approx(2 * (DEVICE_DAMPING - DAMPING) / 1e-3, rel=1e-3)
    for delay in (0, 3):
        ratio = wall_limit(5e-4, delay) / wall_limit(1e-3, delay)
        assert ratio == pytest.approx(2, rel=1e-3)


def test_a_delay_costs_stiffness_as_the_spectrum_says() -> None:
    theta = np.linspace(1e-4, np.pi, 20_001)
    for delay in (1, 4):
        kt = wall_limit(1e-3, delay) * 1e-3
        needed = kt / 2 * np.sin((2 * delay + 1) * theta / 2) / np.sin(theta / 2)
        needed -= DAMPING * np.cos((delay + 1) * theta)
        assert needed.max() == pytest.approx(DEVICE_DAMPING, rel=1e-3)


def test_a_search_finds_the_bound() -> None:
    found = evaluate(
        {"what": "delay", "hand": "worst hand", "period": 1e-3, "delay": 2, "share": 0.0}
    )
    assert found["limit"] == pytest.approx(wall_limit(1e-3, 2), rel=0.01)


def test_half_of_all_ticks_lost_costs_a_free_device_two_thirds_of_its_stiffness() -> None:
    # geometric gaps: E[T]/E[T²] = (1 − p)/(1 + p)/T, a third of the even ticks' 1/T
    even, lost = Timing(), Timing(drops=0.5, seed=1)
    full = 2 * DEVICE_DAMPING / UNEVEN_PERIOD
    assert finite_hand("no hand", 0.97 * full, even).is_stable
    assert not finite_hand("no hand", 0.97 * full, lost).is_stable
    assert not finite_hand("no hand", 1.3 * full / 3, lost).is_stable
    assert finite_hand("no hand", 0.75 * full / 3, lost).is_stable
    assert finite_hand("ordinary hand", 0.97 * full, lost).is_stable


@pytest.mark.parametrize("hand", ["no hand", "ordinary hand"])
@pytest.mark.parametrize("timing", [Timing(jitter=0.9, seed=2), Timing(drops=0.3, seed=2)])
def test_below_the_bound_at_the_longest_interval_nothing_fails(hand: str, timing: Timing) -> None:
    longest = timing.intervals(2000).max() / 16 * UNEVEN_PERIOD
    assert finite_hand(hand, 0.98 * 2 * DEVICE_DAMPING / longest, timing).is_stable


def test_the_map_is_drawn_and_says_what_was_found(tmp_path: Path) -> None:
    with ThreadPoolExecutor(2) as executor:
        files = run_map(RATE, tmp_path, points=20, executor=executor)
    assert files.failed == 0
    assert files.picture.stat().st_size > 10_000
    for mine in files.finding.boundary["by_delay"].values():
        assert mine["worst_ratio_error"] < 0.02
        assert mine["slope"] == pytest.approx(-1, abs=0.01)
    free = files.finding.boundary["uneven"]["drops"]["no hand"]
    assert free["at_longest"][-1] < free["measured"][-1] < free["at_mean"][-1]
    assert "within" in files.finding.paragraph
