"""Substeps: the mean wrench, its work, and the damping that a device needs behind it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from audit_cases import recorded, rewritten, without_model
from kernel_runs import T, samples_of
from rendering_runs import (
    COUPLING,
    rendered,
    sway,
)
from scipy.spatial.transform import Rotation

from hapticbridge.audit import audit
from hapticbridge.certificate import required_damping
from hapticbridge.coupling import Coupling
from hapticbridge.errors import CouplingError
from hapticbridge.recording import read_recording


@pytest.mark.parametrize("substeps", [2, 4, 8])
def test_mean_over_substeps_does_the_work_of_the_single_wrenches(substeps: int) -> None:
    """So a free mass is strict: Σ E = −Σ ½ m (Δv)², step by step, whatever the substeps."""
    run = rendered("implicit", COUPLING, sway(500), substeps=substeps)
    assert run.ticks["environment_energy"].max() <= 0
    assert run.ledger.environment == "strict"
    handle = run.handle_steps()[:, 0] / substeps
    mass, h = 0.05, T / substeps
    x = v = position = work_on_handle = 0.0
    for k in range(500):
        for _ in range(substeps):
            position += handle[k]
            # m (v⁺ − v)/h = K (p − x − h v⁺) + B (δp/h − v⁺)
            k_, b_ = COUPLING.stiffness, COUPLING.damping
            v = (mass * v / h + k_ * (position - x) + b_ * handle[k] / h) / (mass / h + k_ * h + b_)
            x += h * v
            work_on_handle += (k_ * (position - x) + b_ * (handle[k] / h - v)) * handle[k]
    assert run.ticks["tool_position"][-1, 0] == pytest.approx(x, abs=1e-12)
    sent = np.sum(run.ticks["wrench_on_tool"][:, 0] * run.handle_steps()[:, 0])
    assert sent == pytest.approx(work_on_handle, rel=1e-9)


@pytest.mark.parametrize("substeps", [2, 4])
def test_torque_over_substeps_is_the_mean_of_the_single_laws(substeps: int) -> None:
    """About one axis: J ω̇ = K_r φ + B_r (turn of the handle per time − ω), step by step."""
    count, inertia = 300, 0.4 * 0.05 * 0.01**2
    stiff = Coupling(2000.0, 2.0, 2e-2, 1e-4)
    angle = 0.2 * np.sin(2 * np.pi * 3 * T * np.arange(1, count + 1))
    turning = Rotation.from_rotvec(angle[:, None] * [0, 0, 1])
    run = rendered("implicit", stiff, samples_of(np.zeros((count, 3)), turning), substeps=substeps)
    h, k_, b_ = T / substeps, stiff.rotational_stiffness, stiff.rotational_damping
    step = np.diff(angle, prepend=0.0) / substeps
    x = v = position = 0.0
    for k in range(count):
        mean = 0.0
        for _ in range(substeps):
            position += step[k]
            v = (inertia * v / h + k_ * (position - x) + b_ * step[k] / h) / (
                inertia / h + k_ * h + b_
            )
            x += h * v
            mean += (k_ * (position - x) + b_ * (step[k] / h - v)) / substeps
        assert run.ticks["wrench_on_tool"][k, 5] == pytest.approx(mean, abs=1e-8)


def test_needed_damping_with_one_law_is_that_of_the_theory_and_grows_with_the_delay() -> None:
    assert required_damping(COUPLING, T) == pytest.approx(3.0, rel=1e-12)
    undamped = Coupling(2000.0, 0.0, 2.0, 0.0)
    needed = [required_damping(undamped, T, n) for n in (1, 2, 4, 8)]
    # s = 1/2 of the slack may be used; strictly it would be K T n / 2
    assert needed == pytest.approx([1.0, 2.5, 6.25, 14.125], rel=1e-4)
    damped = Coupling(2000.0, 2.0, 2.0, 2e-3)
    assert [required_damping(damped, T, n) for n in (2, 4, 8)] == pytest.approx(
        [2.6429, 2.4423, 2.3350], abs=1e-4
    )
    assert required_damping(damped, T, 4, "rotation") == pytest.approx(2.4423e-3, abs=1e-7)
    with pytest.raises(CouplingError, match="substeps"):
        required_damping(damped, T, 0)


def test_needed_damping_bounds_random_motions_behind_substeps() -> None:
    """The inequality that defines it holds for motions that return to rest, and fails below."""
    coupling, n = Coupling(2000.0, 1.0, 0.0, 0.0), 4
    needed = required_damping(coupling, T, n)
    rng = np.random.default_rng(3)
    k_, b_ = coupling.stiffness, coupling.damping * n / T
    for _ in range(50):
        ticks = 40
        d = rng.normal(size=ticks) * 1e-3
        d[[0, -1]] = 0.0
        d[-2] -= d.sum()
        h = np.cumsum(np.repeat(d / n, n))
        e = rng.normal(size=ticks * n) * 1e-3 * rng.uniform(0, 2)
        e[: 2 * n], e[-2 * n :] = 0.0, 0.0
        x = h - e
        step_e, step_x = np.diff(e, prepend=0.0), np.diff(x, prepend=0.0)
        f = k_ * e + b_ * step_e
        mean = f.reshape(ticks, n).mean(axis=1)
        sides = np.sum(mean[:-1] * d[1:]) - np.sum(f * step_x)
        sides -= 0.25 * (k_ + b_) * np.sum(step_x**2)
        assert sides + needed / T * np.sum(d**2) > -1e-12


def test_audit_says_what_a_mean_leaves_unchecked(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    recorded(path, "peg_in_hole", "simulated", duration=0.2, substeps=4)
    report = audit(path)
    assert (report.resimulation, report.verdict) == ("bit for bit", "passive")
    assert "re-simulation alone" in report.unchecked
    recorded(path, "peg_in_hole", "simulated", duration=0.2)
    assert audit(path).unchecked == ""


@pytest.mark.parametrize(
    ("method", "substeps", "verdict"),
    [
        ("direct", 1, "invalid"),
        ("weld", 1, "invalid"),
        ("implicit", 4, "invalid"),
        ("implicit", 1, "passive"),
    ],
)
def test_what_only_a_resimulation_confirms_is_not_called_passive_without_one(
    method: str, substeps: int, verdict: str, tmp_path: Path
) -> None:
    path = tmp_path / "run.mcap"
    recorded(path, "point_mass", duration=0.1, method=method, substeps=substeps)
    assert audit(path).verdict == "passive"
    bare = rewritten(without_model(read_recording(path)), tmp_path / "bare.mcap")
    report = audit(bare)
    assert report.verdict == verdict
    assert "not re-simulated" in report.resimulation
    assert verdict == "passive" or "not re-simulated" in report.reason
