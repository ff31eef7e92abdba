"""Verdicts on a device after a run, each by what decides it."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from audit_cases import ScriptedDevice, recorded
from bridge_runs import sway
from cli_cases import Called

from hapticbridge import Coupling
from hapticbridge.audit import audit
from hapticbridge.audit.batch import audit_all
from hapticbridge.audit.events import AuditedRun
from hapticbridge.cli import zwidth
from hapticbridge.demand.certification import Standing
from hapticbridge.device import SimulatedDevice
from hapticbridge.device.profile import Profile, Quantity
from hapticbridge.recording import read_recording
from hapticbridge.theory.bounds import minimum_damping
from hapticbridge.theory.transfer import CouplingGrid

WEAK = Coupling(5000.0, 0.5, 2.0, 1e-3)
SHEETS: dict[Standing, tuple[dict[str, Any], Coupling | None, str]] = {
    Standing.CERTIFIED: ({}, None, ""),
    Standing.DAMPING: ({}, WEAK, "b < KT/2 + B_law: 2 < 2.5 N s/m"),
    Standing.FRICTION: (
        {"resolution": 5e-5, "friction": 0.0},
        None,
        "friction < K Δ/2 + B_law Δ/T, so encoder steps shake it",
    ),
    Standing.DAMPING_UNKNOWN: ({"damping": None, "rotational_damping": None}, None, ""),
    Standing.DELAY_UNKNOWN: ({"delay": None}, None, ""),
    Standing.NO_HAND: ({"is_prescribed": True}, None, ""),
}


@pytest.mark.parametrize("standing", SHEETS)
def test_run_and_audit_reach_one_verdict_with_one_reason(
    standing: Standing, tmp_path: Path
) -> None:
    (sheet, coupling, reason), path = SHEETS[standing], tmp_path / "run.mcap"
    device = ScriptedDevice(sway, **sheet)
    summary = recorded(path, "point_mass", device, coupling, duration=0.1)
    report = audit(path)
    assert report.certification is not None
    assert summary.certification.standing is report.certification.standing is standing
    assert summary.certification.words == report.certification.words
    assert reason in report.reason
    assert summary.verdict == report.verdict == "passive"
    assert report.exit_code == (standing.verdict is False)
    assert (report.answer == "nothing to certify") == (standing is Standing.NO_HAND)


def test_a_late_device_that_has_the_damping_is_certified_for_its_delay(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    summary = recorded(
        path,
        "point_mass",
        ScriptedDevice(sway, delay=1.5e-3, is_delay_measured=False),
        duration=0.1,
    )
    words = "b >= what its delay needs, if its forces come equally late, by at most 3 ms"
    for found in (summary.certification, audit(path).certification):
        assert found is not None
        assert found.standing is Standing.CERTIFIED
        assert found.words == f"device certified: {words}; its encoder's steps are unknown"


def test_a_late_device_that_lacks_damping_is_told_the_number_of_its_own_bound(
    tmp_path: Path,
) -> None:
    path = tmp_path / "run.mcap"
    device = ScriptedDevice(sway, delay=1e-3)
    recorded(path, "point_mass", device, Coupling(2400.0, 1.7, 2.0, 1e-3), duration=0.1)
    report = audit(path)
    assert report.certified is False
    assert "b < what its delay needs: 2 < " in report.reason
    assert "KT/2" not in report.reason


@pytest.mark.parametrize("is_measured", [False, True])
def test_a_certificate_names_a_delay_that_is_stated_and_was_not_measured(
    is_measured: bool, tmp_path: Path, call: Called, monkeypatch: pytest.MonkeyPatch
) -> None:
    profile = Profile(
        name="own",
        device="own",
        serial="",
        axes=None,
        about="",
        quantities={"delay": Quantity(0.0, "a test", (0.0, 1e-5) if is_measured else None)},
    )
    unknown = replace(SimulatedDevice().info, delay=None, is_delay_measured=False)
    sheet, path = profile.fill(unknown), tmp_path / "run.mcap"
    assert sheet.delay == 0.0
    device = ScriptedDevice(sway, is_delay_measured=sheet.is_delay_measured)
    summary, clause = recorded(path, "point_mass", device, duration=0.1), ", if its forces come"
    report = audit(path)
    assert report.certification is not None
    for found in (summary.certification, report.certification):
        assert found.standing is Standing.CERTIFIED
        said = [clause in text for text in (found.words, found.fact, found.note)]
        assert said == [not is_measured] * 3
        assert found.answer == ("yes" if is_measured else "if timely")
    assert list(audit_all([path]).texts("certified")) == [report.answer]
    opened = SimulatedDevice()
    opened.info = sheet
    monkeypatch.setattr(zwidth, "open_device", lambda _spec, notify: opened)
    told = call("bound", "--stiffness", 2400, "--damping", 1.7, "--device", "simulated")
    assert (told[0], clause in told[1]) == (0, not is_measured)


def test_the_most_demanding_coupling_of_a_run_counts_its_friction_too(tmp_path: Path) -> None:
    """Four laws per tick need more damping of a spring; steps need friction of a damper too."""
    path, step = tmp_path / "run.mcap", 2e-5
    device = ScriptedDevice(sway, resolution=step, friction=1.75 * step / 1e-3)
    law = Coupling(2400.0, 0.5, 2.0, 1e-3)
    recorded(path, "point_mass", device, law, duration=0.1, method="implicit", substeps=4)
    run = AuditedRun.of(read_recording(path))
    spring, damper = law, Coupling(100.0, 1.75, 2.0, 1e-3)
    for couplings in ((spring, damper), (damper, spring)):
        worst = replace(run, events=replace(run.events, couplings=couplings)).worst.coupling
        assert (worst.stiffness, worst.damping) == (damper.stiffness, damper.damping)
    strong = replace(run, info=replace(run.info, friction=1.0))
    found = replace(strong, events=replace(run.events, couplings=(damper, spring))).worst
    assert found.coupling.stiffness == spring.stiffness


def test_the_search_of_a_late_devices_coupling_takes_little_memory() -> None:
    ratios = 1e-3 * np.linspace(0.0, 50.0, 400)
    tracemalloc.start()
    needed = np.asarray(minimum_damping(CouplingGrid(1.0, ratios), 1e-3, delay=50))
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 10e6
    alone = [minimum_damping(CouplingGrid(1.0, r), 1e-3, delay=50) for r in ratios[::100]]
    assert needed[::100] == pytest.approx(alone, rel=1e-12)


def test_a_run_on_a_slow_device_says_what_its_own_rate_would_allow(
    call: Called, monkeypatch: pytest.MonkeyPatch
) -> None:
    command, opened = "run point_mass --fast --duration 0.05 --rate 1000", SimulatedDevice()
    monkeypatch.setattr("hapticbridge.cli.run.device_for", lambda *_: opened)
    assert "new samples per second" not in call(*command.split())[2]
    opened = SimulatedDevice()
    opened.info = replace(opened.info, rate=250.0)
    told = " ".join(call(*command.split())[2].split())
    assert "the device gives 250 new samples per second, and each force is held:" in told
    assert "--rate 250 would allow " in told
    told = " ".join(call("run", "point_mass", "--fast", "--duration", 0.05)[2].split())
    assert told.count("the loop runs at 250 Hz, as often as the device has a new sample") == 1
    assert "point_mass on simulated, 250 Hz, method lossless" in told
    assert "would allow" not in told
