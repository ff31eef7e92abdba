"""Claims of the map ``device``."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from hapticbridge.study.closed_loop import LoopOutcome
from hapticbridge.study.maps.device import DEVICE
from hapticbridge.study.maps.device_runs import (
    LARGE,
    PERIOD,
    QUANTUM,
    RESOLUTION,
    STIFFNESS,
    friction_to_rest,
    region_of,
    settle,
    shaken,
)
from hapticbridge.study.maps.stability_map import run_map


@pytest.mark.parametrize(
    ("beta", "sigma", "region"),
    [
        (0.6, 0.6, "passive"),
        (0.4, 0.6, "locally stable"),
        (0.6, 0.4, "bounded limit cycle"),
        (0.4, 0.4, "unstable"),
    ],
)
def test_what_a_device_does_is_named_as_theory_names_its_region(
    beta: float, sigma: float, region: str
) -> None:
    assert region_of(settle(beta, sigma, 0.0)[0], settle(beta, sigma, LARGE)[0]) == region


def test_a_bounded_cycle_goes_to_and_fro_across_one_encoder_step() -> None:
    what, size, run = settle(1.0, 0.3, 0.0)
    assert (what, size) == ("cycle", 1.0)
    force = run.records["wrench_on_tool"][-1000:, 0]
    assert np.ptp(force) == pytest.approx(QUANTUM, rel=1e-3)  # the wall gives way a little
    assert settle(1.0, 0.6, 0.0)[:2] == ("rest", 0.0)


def first_excess(beta: float, run: LoopOutcome) -> int:
    """Returns the tick at which the device had got more than its damper burnt, −1 for none.

    The knock's own energy, in the spring at the start, is the device's to have.
    """
    records = run.records
    moved = np.diff(records["device_position"][:, 0], prepend=LARGE * RESOLUTION)
    burnt = beta * STIFFNESS * np.cumsum(np.square(moved))
    stored = 0.5 * STIFFNESS * (LARGE * RESOLUTION) ** 2
    excess = np.flatnonzero(records["device_energy"] - burnt > 1.02 * stored)
    return int(excess[0]) if excess.size else -1


def test_divergence_gives_energy_to_the_device_and_not_to_the_environment() -> None:
    what, _, failed = settle(0.3, 0.7, LARGE)
    assert what == "diverges"
    # the port at fault is the device's: the wall behind the coupling gives nothing
    assert failed.environment == "strict"
    assert 0 < first_excess(0.3, failed) < 200
    what, _, twin = settle(0.7, 0.7, LARGE)
    assert what in {"rest", "falls"}
    assert first_excess(0.7, twin) == -1


@pytest.mark.parametrize("damping", [0.0, 0.4, 1.5])
def test_a_shaken_device_needs_the_friction_of_abbott_and_okamura(damping: float) -> None:
    needed = (STIFFNESS * RESOLUTION / 2 + damping * RESOLUTION / PERIOD) / QUANTUM
    assert shaken(damping) == pytest.approx(needed, rel=1e-6)


def test_a_pressed_device_rests_from_half_a_step_of_force_on() -> None:
    assert friction_to_rest(0.0) == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize(
    ("small", "large", "region"),
    [
        ("rest", "rest", "passive"),
        ("rest", "falls", "passive"),
        ("cycle", "falls", "bounded limit cycle"),
        ("rest", "cycle", "bounded limit cycle"),
        ("rest", "diverges", "locally stable"),
        ("cycle", "diverges", "unstable"),
        ("diverges", "diverges", "unstable"),
    ],
)
def test_regions_follow_from_what_the_runs_did(small: str, large: str, region: str) -> None:
    assert region_of(small, large) == region


def test_the_map_is_drawn_and_says_what_was_found(tmp_path: Path) -> None:
    with ThreadPoolExecutor(2) as executor:
        files = run_map(DEVICE, tmp_path, points=16, executor=executor)
    assert files.failed == 0
    assert files.picture.stat().st_size > 10_000
    said = files.finding.boundary
    assert said["agreement"] >= 0.9
    for name in ("beta", "sigma"):
        edge = said["measured_edges"][name]
        assert edge["last"] < 0.5 < edge["first"]
    assert said["friction"]["shaken"] == pytest.approx(said["friction"]["predicted"], rel=1e-6)
    assert "at 100 % of the points" in files.finding.paragraph
