"""The map of K against B: the bounds are where loops fail, and the verdicts name what failed."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from audit_cases import recorded
from map_runs import boundary_of

from hapticbridge.audit import audit
from hapticbridge.coupling import Coupling
from hapticbridge.demand.guard import Limits
from hapticbridge.device import SimulatedDevice
from hapticbridge.errors import SafetyTrip
from hapticbridge.lab.maps import coupling
from hapticbridge.lab.maps.base import (
    PERIOD,
    Point,
    free_tool_and_wall,
    limit_by_6,
    needed_by_6,
    used_damping,
)
from hapticbridge.lab.maps.coupling import DEVICE_DAMPING, PATH, evaluate
from hapticbridge.lab.methods import METHODS
from hapticbridge.theory.bounds import maximum_stiffness, minimum_damping

NEVER = 1e9
"""Force in N and torque in N m that no run reaches."""


def cell(method: str, stiffness: float, damping: float) -> Point:
    return {"what": "cell", "method": method, "stiffness": stiffness, "damping": damping}


@pytest.mark.parametrize("damping", [0.0, 0.5, 1.5])
def test_worst_hand_on_a_wall_finds_the_bound_within_a_percent(damping: float) -> None:
    found = evaluate({"what": "limit", "method": "implicit", "stiffness": 0.0, "damping": damping})
    assert found["limit"] == pytest.approx(
        maximum_stiffness(DEVICE_DAMPING, PERIOD, damping), rel=0.01
    )


@pytest.mark.parametrize("method", ["implicit", "compensated", "lossless", "explicit"])
def test_the_bound_of_a_method_is_that_of_the_coupling_it_uses(method: str) -> None:
    for k in (500.0, 1500.0, 6000.0):
        used = METHODS[method].law_coupling(Coupling(k, 1.2, 1.0, 0.0), PERIOD)
        assert used_damping(method, k, 1.2) == pytest.approx(used.damping)
        assert needed_by_6(method, k, 1.2) == pytest.approx(minimum_damping(used, PERIOD))
    limit = limit_by_6(method, DEVICE_DAMPING, 1.2)
    assert needed_by_6(method, limit, 1.2) == pytest.approx(DEVICE_DAMPING)


def test_coupling_that_the_device_cannot_bear_is_unstable_though_the_scene_is_passive() -> None:
    limit = float(maximum_stiffness(DEVICE_DAMPING, PERIOD, 0.5))
    below = evaluate(cell("implicit", 0.95 * limit, 0.5))
    above = evaluate(cell("implicit", 1.05 * limit, 0.5))
    assert below["stable_on_wall"]
    assert below["stable_free"]
    assert below["environment"] == "strict"
    assert not above["stable_on_wall"]
    assert above["environment"] == "strict"


def test_weld_is_judged_by_its_device_port_and_has_no_wall_without_contact() -> None:
    # on a wall the hand is given what neither the scene gave up nor the damping burns
    found = evaluate(cell("weld", 1500.0, 0.6))
    assert "stable_on_wall" not in found
    assert found["fault_port"] == "device"
    assert 0 < int(found["fault_tick"]) < 2000
    assert found["stable_tapping"] is False
    twin = evaluate(cell("implicit", 1500.0, 0.6))
    assert (twin["fault_tick"], twin["fault_port"]) == (-1, "")
    assert twin["stable_tapping"] is True


@pytest.mark.parametrize(
    ("method", "share", "port"),
    [
        ("implicitfast", 1.03, "environment"),
        ("implicitfast", 0.97, ""),
        ("weld", 2.5, "device"),
        ("implicit", 2.5, ""),
    ],
)
def test_the_audit_of_a_bridge_names_the_tick_and_the_port_of_the_map(
    method: str, share: float, port: str, tmp_path: Path
) -> None:
    # implicitfast: E_k = K δx² − ½m(Δv)² against a slack of ½ (K + B/T) δx², equal at K = B/T
    damping = 0.6
    stiffness = share * damping / PERIOD
    mapped = evaluate(cell(method, stiffness, damping))
    device = SimulatedDevice(
        damping=DEVICE_DAMPING, path=PATH, force_limit=NEVER, torque_limit=NEVER
    )
    coupling = Coupling(stiffness, damping, 1.0, 1e-3)
    limits = Limits(force=NEVER, torque=NEVER, ramp=0.0)  # a map shows what happens unguarded
    with suppress(SafetyTrip):
        recorded(
            tmp_path / "run.mcap",
            free_tool_and_wall(),
            device,
            coupling,
            duration=500 * PERIOD,
            rate=1 / PERIOD,
            method=method,
            limits=limits,
            is_guarded=False,
        )
    report = audit(tmp_path / "run.mcap")
    assert report.resimulation == "bit for bit"
    assert (report.verdict, report.port) == ("active" if port else "passive", port)
    assert mapped["fault_port"] == port
    assert (-1 if report.tick is None else report.tick) == mapped["fault_tick"]


def test_the_map_says_what_its_table_holds(tmp_path: Path) -> None:
    boundary = boundary_of(coupling, tmp_path, 24, lambda p: p["method"] == "implicit")
    implicit = boundary["methods"]["implicit"]
    assert implicit["largest_deviation"] < 0.01
    assert implicit["passive_share_below_6"] == 1.0
    assert np.isfinite(implicit["measured_on_wall"]).all()
