"""What each integrator creates in free motion, as the theory says, and who notices."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from audit_cases import ScriptedDevice, recorded
from kernel_runs import T
from rendering_runs import (
    COUPLING,
    FREE,
    FREE_MASS,
    rendered,
    sway,
)

from hapticbridge.audit import audit
from hapticbridge.coupling import Coupling


def test_created_energies_of_one_free_mass_are_those_of_the_theory() -> None:
    """K = 2000, B = 2, 50 g, 3 Hz for 2 s: none, 0.29 J for actuators that miss the position."""
    samples = sway()
    for name in ("implicit", "implicitfast:compensated"):
        run = rendered(name, COUPLING, samples)
        assert run.ticks["environment_energy"].max() <= 0
        assert run.ledger.environment == "strict"
    run = rendered("implicitfast", COUPLING, samples)
    assert run.ticks["environment_energy"].max() == pytest.approx(0.29, abs=0.005)
    assert run.ledger.environment != "strict"


@pytest.mark.parametrize("substeps", [1, 4])
def test_compensated_implicitfast_is_implicit_away_from_contact(substeps: int) -> None:
    samples = sway(500)
    implicit = rendered("implicit", COUPLING, samples, substeps=substeps)
    compensated = rendered("implicitfast:compensated", COUPLING, samples, substeps=substeps)
    plain = rendered("implicitfast", COUPLING, samples, substeps=substeps)
    expected = implicit.ticks["tool_position"]
    assert compensated.ticks["tool_position"] == pytest.approx(expected, abs=1e-14)
    assert np.abs(plain.ticks["tool_position"] - expected).max() > 1e-5


@pytest.mark.parametrize("mass", [0.02, 0.05, 1.0])
def test_held_force_creates_half_m_dv_squared_a_step(mass: float) -> None:
    """Σ E_k = Σ_{i<k} T² f_i²/(2 m) − f_k·δx_k: the last wrench has not acted yet."""
    run = rendered("explicit", COUPLING, sway(500), FREE_MASS.format(mass=mass))
    force = run.ticks["wrench_on_tool"][:, 0]
    created = np.concatenate([[0.0], np.cumsum((T * force) ** 2 / (2 * mass))[:-1]])
    expected = created - force * run.tool_steps()[:, 0]
    assert run.ticks["environment_energy"] == pytest.approx(
        expected, abs=1e-12 * np.abs(expected).max() + 1e-13
    )
    velocity = run.tool_steps()[:, 0] / T
    assert mass * np.diff(velocity) == pytest.approx(T * force[:-1], abs=1e-11)


def test_held_force_under_rk4_is_the_exact_hold() -> None:
    run = rendered("explicit:rk4", COUPLING, sway(500))
    force, steps = run.ticks["wrench_on_tool"][:, 0], run.tool_steps()[:, 0]
    # x_{k+1} − 2 x_k + x_{k−1} = T² (f_k + f_{k−1}) / (2 m)
    expected = T**2 * (force[1:-1] + force[:-2]) / (2 * 0.05)
    assert np.diff(steps)[1:] == pytest.approx(expected, abs=1e-14)


@pytest.mark.parametrize("name", ["explicit", "explicit:implicitfast", "explicit:rk4"])
def test_held_force_diverges_on_a_light_tool_where_implicit_is_strict(name: str) -> None:
    """Under Euler below m = (T/2)(KT/2 + B) = 1.5 g."""
    light = FREE_MASS.format(mass=0.001)
    failed = rendered(name, COUPLING, sway(300), light)
    assert len(failed.ticks) < 300  # stopped as no longer finite
    fault = failed.ledger.fault
    assert fault is not None
    assert fault[1] == "environment"
    safe = rendered("implicit", COUPLING, sway(300), light)
    assert safe.ledger.environment == "strict"


@pytest.mark.parametrize(("mass", "is_bounded"), [(0.00140, False), (0.00165, True)])
def test_held_force_needs_the_mass_that_the_theory_says(mass: float, is_bounded: bool) -> None:
    run = rendered("explicit", COUPLING, sway(2000), FREE_MASS.format(mass=mass))
    assert (len(run.ticks) == 2000) == is_bounded


@pytest.mark.parametrize(
    ("name", "mass"),
    [
        ("implicitfast", 0.002),
        ("explicit", 0.0006),
        ("explicit:implicitfast", 0.0006),
        ("explicit:rk4", 0.004),
    ],
)
def test_meter_and_audit_name_the_tick_at_which_energy_was_created(
    name: str, mass: float, tmp_path: Path
) -> None:
    loose = Coupling(2000.0, 0.0, 2.0, 0.0)

    def swing(tick: int) -> tuple[float, ...]:
        return (0.02 * math.sin(0.02 * tick), 0, 0, 1, 0, 0, 0)

    scene = tmp_path / "light.xml"
    scene.write_text(FREE_MASS.format(mass=mass))
    reports = {}
    for method in (name, "implicit"):
        path = tmp_path / f"{method.replace(':', '_')}.mcap"
        device = ScriptedDevice(swing, strength=200.0)
        summary = recorded(path, scene, device, loose, duration=0.15, method=method, limits=FREE)
        reports[method] = audit(path)
        found = (reports[method].tick, reports[method].port)
        assert found == (summary.fault or (None, ""))
        assert reports[method].resimulation == "bit for bit"
    assert reports[name].verdict == "active"
    assert reports[name].port == "environment"
    assert f"tick {reports[name].tick}" in reports[name].reason
    assert (reports["implicit"].verdict, reports["implicit"].environment) == ("passive", "strict")
