"""Claims of the map ``device``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from map_runs import boundary_of

from hapticbridge.lab.maps import device
from hapticbridge.lab.maps.base import PERIOD
from hapticbridge.lab.maps.device import (
    DAMPERS,
    LARGE,
    METHODS_SHOWN,
    QUANTUM,
    RESOLUTION,
    STIFFNESS,
    friction_to_rest,
    region_of,
    settle,
    shaken,
)

REGIONS = {
    (0.6, 0.6): "passive",
    (0.4, 0.6): "locally stable",
    (0.6, 0.4): "bounded limit cycle",
    (0.4, 0.4): "unstable",
}
"""Regions of the theory by (β, σ)."""


@pytest.mark.parametrize(("beta", "sigma"), REGIONS)
def test_what_a_device_does_is_named_as_theory_names_its_region_by_every_method(
    beta: float, sigma: float
) -> None:
    done = []
    for knock in (0.0, LARGE):  # without a damper all methods have one law
        one, *others = (settle(beta, sigma, knock, 0.0, name) for name in METHODS_SHOWN)
        for other in others:
            assert other[0] == one[0]
            assert other[1] == pytest.approx(one[1], rel=1e-6)
        done.append(one[0])
    assert region_of(*done) == REGIONS[beta, sigma]


def test_a_knock_that_grows_slowly_diverges() -> None:
    what, last, run = settle(0.49, 0.3, LARGE)
    assert what == "diverges"
    # it grew by less than a factor of two in its last third
    steps = run.records["device_position"][-2000:-1000, 0] / RESOLUTION
    assert 1.02 * np.ptp(steps) < last < 2 * np.ptp(steps)


def test_a_bounded_cycle_goes_to_and_fro_across_one_encoder_step() -> None:
    what, size, run = settle(1.0, 0.3, 0.0)
    assert (what, size) == ("cycle", 1.0)
    force = run.records["wrench_on_tool"][-1000:, 0]
    assert np.ptp(force) == pytest.approx(QUANTUM, rel=1e-3)  # the wall gives way a little
    assert settle(1.0, 0.6, 0.0)[:2] == ("rest", 0.0)


@pytest.mark.parametrize("damping", [0.4, 2.6])
@pytest.mark.parametrize(
    ("name", "lag"), [("implicit", 0.0), ("compensated", 1), ("lossless", 0.5)]
)
def test_a_shaken_device_needs_the_friction_of_abbott_and_okamura(
    name: str, lag: float, damping: float
) -> None:
    used = max(damping - lag * STIFFNESS * PERIOD, 0.0)
    needed = (STIFFNESS * RESOLUTION / 2 + used * RESOLUTION / PERIOD) / QUANTUM
    assert shaken(name, damping) == pytest.approx(needed, rel=1e-6)


@pytest.mark.parametrize("name", METHODS_SHOWN)
def test_a_pressed_device_rests_from_half_a_step_of_force_on(name: str) -> None:
    assert settle(1.0, 0.48, 0.0, 0.0, name)[0] == "cycle"
    assert settle(1.0, 0.52, 0.0, 0.0, name)[0] == "rest"


def test_a_search_finds_half_a_step_of_force() -> None:
    assert friction_to_rest("lossless", 0.0) == pytest.approx(0.5, abs=0.02)


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


def test_the_map_says_what_its_table_holds(tmp_path: Path) -> None:
    # the grid and one damper of each method
    said = boundary_of(
        device,
        tmp_path,
        9,
        lambda p: p["what"] == "cell" or (p["what"], p.get("damping")) == ("friction", DAMPERS[1]),
    )
    assert said["regions"]["agreement"] >= 0.9
    for name in ("beta", "sigma"):
        edge = said["regions"]["measured_edges"][name]
        assert edge["last"] < 0.5 < edge["first"]
    # B = 3 is asked for, 2 and 1 are left; K T = 2
    for name, needed in (("implicit", 2.0), ("compensated", 1.0), ("lossless", 1.5)):
        assert said["friction"][name]["shaken"] == pytest.approx([needed], rel=1e-6)
