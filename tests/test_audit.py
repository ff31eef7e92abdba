"""The audit: verdicts on honest runs, its own balance, the certificate, and what it may import."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from audit_cases import ScriptedDevice, balance_of, recorded
from numpy.typing import NDArray
from report_runs import LOOSE, circling
from scipy.spatial.transform import Rotation

from hapticbridge.audit import audit
from hapticbridge.audit.energy import energy_deviations
from hapticbridge.audit.events import RunEvents
from hapticbridge.audit.motion import turn_between
from hapticbridge.audit.wrench_limits import wrench_deviations
from hapticbridge.coupling import Coupling
from hapticbridge.demand.guard import Limits
from hapticbridge.lab.methods import METHODS
from hapticbridge.recording import Recording, read_recording
from hapticbridge.run.description import parameters_of
from hapticbridge.run.options import Workspace
from hapticbridge.scene.load import scene_path


def energy_by_hand(recording: Recording) -> tuple[NDArray[Any], NDArray[Any]]:
    """Created energy and slack from the records alone, rotations by SciPy."""
    ticks, meta = recording.ticks, recording.meta
    start = json.loads(meta["tool_start"])
    path = np.vstack([start[:3], ticks["tool_position"]])
    turned = Rotation.from_quat(np.vstack([start[3:], ticks["tool_quaternion"]]), scalar_first=True)
    moved, turn = np.diff(path, axis=0), (turned[1:] * turned[:-1].inv()).as_rotvec()
    f = ticks["wrench_on_tool"]
    work = np.cumsum((f[:, :3] * moved).sum(1) + (f[:, 3:] * turn).sum(1))
    stored = ticks["kinetic"] + ticks["potential"]
    stored = stored - float(meta["start_kinetic"]) - float(meta["start_potential"])
    period = float(meta["period_s"])
    linear = float(meta["stiffness"]) + float(meta["damping"]) / period
    angular = float(meta["rotational_stiffness"]) + float(meta["rotational_damping"]) / period
    slack = np.cumsum(linear * (moved**2).sum(1) / 2 + angular * (turn**2).sum(1) / 2)
    return stored - work - ticks["actuator_work"] - ticks["external_work"], slack


def test_balance_agrees_with_the_kernel_and_with_a_sum_by_hand(held: Recording) -> None:
    ticks, parameters = held.ticks, parameters_of(held.meta)
    block, balance = balance_of(held, parameters)
    # rounding of 200 summed works of 1e-3 J
    for name in ("coupling_work", "device_energy", "environment_energy"):
        np.testing.assert_allclose(getattr(balance, name), ticks[name], rtol=0, atol=1e-14)
    events = RunEvents.from_recording(held, parameters)
    found = [*wrench_deviations(block, events), *energy_deviations(block, balance)]
    off = {deviation.field: deviation.amount.max() for deviation in found}
    assert off["wrench_on_tool"] < 1e-11
    assert off["wrench_on_device"] < 1e-13
    assert off["lever"] < 1e-15
    assert off["handle_position"] < 1e-16
    assert off["handle_quaternion"] < 1e-15
    created, slack = energy_by_hand(held)
    np.testing.assert_allclose(balance.environment_energy, created, rtol=0, atol=1e-13)
    np.testing.assert_allclose(balance.slack, slack, rtol=1e-9, atol=1e-15)
    assert np.ptp(ticks["environment_energy"]) > 1e-4  # there was something to agree on


def test_rotation_vectors_are_those_of_scipy() -> None:
    rng = np.random.default_rng(3)
    a, b = Rotation.random(200, rng=rng), Rotation.random(200, rng=rng)
    ours = turn_between(
        a.as_quat(canonical=True, scalar_first=True), b.as_quat(canonical=True, scalar_first=True)
    )
    np.testing.assert_allclose(ours, (b * a.inv()).as_rotvec(), rtol=0, atol=1e-12)


def test_energy_that_an_integrator_creates_is_active(tmp_path: Path) -> None:
    path = tmp_path / "fast.mcap"
    device = ScriptedDevice(circling)
    summary = recorded(path, "point_mass", device, LOOSE, duration=0.3, method="implicitfast")
    report = audit(path)
    assert report.resimulation == "bit for bit"  # an honest file of a bad run
    created, slack = energy_by_hand(read_recording(path))
    first = int(np.argmax(created > slack + 1e-9))
    assert (report.verdict, report.environment, report.exit_code) == ("active", "active", 1)
    assert (report.tick, report.port) == (first, "environment")
    assert report.joules == pytest.approx(created[first] - slack[first], rel=1e-6)
    assert f"tick {first}" in report.reason
    assert (summary.verdict, summary.environment) == ("active", "active")
    assert report.slack_share == pytest.approx(summary.slack_share, rel=1e-9)


def test_same_motion_under_the_default_integrator_is_strict(tmp_path: Path) -> None:
    path = tmp_path / "discrete.mcap"
    recorded(path, "point_mass", ScriptedDevice(circling), LOOSE, duration=0.3)
    report = audit(path, strict=True)
    assert (report.verdict, report.environment) == ("passive", "strict")


def test_whole_numbers_and_limits_far_away_are_audited_as_any_others(tmp_path: Path) -> None:
    path = tmp_path / "whole.mcap"
    limits = Limits(force=1e12, torque=1e10)
    device, gains = ScriptedDevice(circling, strength=1e12), Coupling(200, 0, 0, 0)
    recorded(path, "point_mass", device, gains, duration=0.1, limits=limits, method="implicit")
    report = audit(path)
    assert (report.verdict, report.reason.split()[0]) == ("passive", "the")


@pytest.mark.filterwarnings("ignore:.*more energy than the coupling's slack:UserWarning")
def test_stiff_contact_on_a_light_tool_is_active(tmp_path: Path) -> None:
    scene = tmp_path / "wall.xml"
    text = scene_path("virtual_wall").read_text()
    text = text.replace(
        'solref="0.002 1" solimp="0.9 0.95', 'solref="-1000000 -500" solimp="0.99 0.99'
    )
    scene.write_text(text.replace('mass="0.05"', 'mass="0.01"'))
    coupling = Coupling(2e4, 0.5, 2.4, 5e-4)

    def press(tick: int) -> tuple[float, ...]:
        since = max(tick - 60, 0)  # the force has risen
        x = 0.0115 * min(since / 100, 1) + 1e-3 * np.sin(2 * np.pi * 0.02 * since)
        return (x, 0, 0, 1, 0, 0, 0)

    path = tmp_path / "wall.mcap"
    device = ScriptedDevice(press, strength=100.0, damping=20.0)
    limits = Limits(force=100.0, torque=5.0, ramp=0.05, energy=math.inf)
    recorded(path, scene, device, coupling, duration=0.3, limits=limits, contact="scene")
    report = audit(path)
    assert (report.verdict, report.exit_code) == ("active", 1)
    assert report.tick is not None and 160 < report.tick < 200
    assert read_recording(path).ticks["contacts"][report.tick - 10 : report.tick].any()


def test_strict_refuses_what_the_slack_allows(tmp_path: Path) -> None:
    path = tmp_path / "slack.mcap"
    # more damping in the coupling: the same creation stays below the slack
    coupling = Coupling(2000, 2, 2, 5e-4)
    device = ScriptedDevice(circling, damping=4.0)  # it needs 3 N s/m; with less there is no slack
    recorded(path, "point_mass", device, coupling, duration=0.3, method="implicitfast")
    loose, strict = audit(path), audit(path, strict=True)
    created, slack = energy_by_hand(read_recording(path))
    assert (loose.verdict, loose.environment) == ("passive", "within slack")
    share = float(np.max(np.where(created > 1e-9, created / (slack + 1e-9), 0)))
    assert 0.5 < share < 1
    assert loose.slack_share == pytest.approx(share, rel=1e-3)
    assert f"{loose.slack_share:.0%}" in loose.reason
    assert (strict.verdict, strict.environment, strict.exit_code) == ("active", "within slack", 1)
    first = int(np.argmax(created > 1e-9))
    assert strict.tick == first
    assert strict.joules == pytest.approx(created[first], rel=1e-6)


@pytest.mark.parametrize(
    ("stiffness", "rotational_stiffness", "certified"),
    [(2999.0, 2.99, True), (3001.0, 2.99, False), (2999.0, 3.01, False)],
)
@pytest.mark.parametrize("method", ["implicit", "lossless", "compensated"])
def test_certificate_is_the_device_condition_with_what_is_used(
    tmp_path: Path, method: str, stiffness: float, rotational_stiffness: float, certified: bool
) -> None:
    path = tmp_path / "run.mcap"
    # b = 2 N s/m and 2e-3 N m s/rad at 1 ms: K < 2 (2 − 0.5) / 1e-3 and the thousandth of it
    used = Coupling(stiffness, 0.5, rotational_stiffness, 5e-4)
    felt = METHODS[method].requested_coupling(used, 1e-3)
    recorded(path, "point_mass", "simulated", felt, duration=0.05, method=method)
    assert float(read_recording(path).meta["damping"]) == pytest.approx(0.5)  # the law's
    report = audit(path)
    assert report.verdict == "passive"
    assert report.certified is certified
    assert "B_law = 0.5" in report.coupling_sentences[0]
    assert report.coupling is not None
    assert report.coupling.requested == felt
    assert report.coupling.law is not None
    assert report.coupling.law.damping == pytest.approx(0.5)
    assert report.exit_code == (0 if certified else 1)
    assert any("<" in sentence for sentence in report.conditions) is not certified


def test_scales_enter_the_device_condition(tmp_path: Path) -> None:
    path, coupling = tmp_path / "run.mcap", Coupling(2000, 1.5, 2, 1.5e-3)
    # 1.44 · 1.5 N s/m > 2, and 1.2 · 1.5 N s/m < 2
    for force_scale, is_certified in ((None, False), (1.0, True)):
        workspace = Workspace(scale=1.2, force_scale=force_scale)
        recorded(path, "point_mass", "simulated", coupling, duration=0.05, workspace=workspace)
        assert audit(path).certified is is_certified
