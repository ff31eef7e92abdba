"""Each blow's account in the report: speed, e asked and had, energies, and what pulses got."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from audit_cases import ScriptedDevice, recorded
from tapping import DAMPING as B
from tapping import wall
from view_cases import tap

from hapticbridge.audit import audit
from hapticbridge.coupling import Coupling
from hapticbridge.demand.guard import Limits
from hapticbridge.demand.pulse import balance_words
from hapticbridge.device.simulated.device import SimulatedDevice
from hapticbridge.kernel.jit import source_of
from hapticbridge.kernel.record import TickFlag
from hapticbridge.kernel.restitution import restitution
from hapticbridge.recording import Recording, read_recording
from hapticbridge.report import write_report
from hapticbridge.report.evidence import Blow, Evidence, blows_of
from hapticbridge.report.page import MAX_BLOWS, blow_row
from hapticbridge.run.summary import Summary
from hapticbridge.units import format_energy

DROP, BALL, PADDLE, DAMPING = 0.1, 0.02, 0.5, 0.1
"""Way of the fall in m, masses in kg, damping ratio of the contact."""

E = float(source_of(restitution)(0.02, DAMPING))

SCENE = f"""
<mujoco>
  <option gravity="0 0 -9.81"/>
  <default><geom solref="0.02 {DAMPING}" friction="0"/></default>
  <worldbody>
    <body name="paddle" gravcomp="1"><freejoint/>
      <geom type="box" size="0.1 0.1 0.01" mass="{PADDLE}"/><site name="grip"/></body>
    <body name="ball" pos="0 0 {DROP + 0.03}"><freejoint/>
      <geom size="0.02" mass="{BALL}"/></body>
  </worldbody>
</mujoco>"""


@pytest.fixture(scope="module")
def summary(tmp_path_factory: pytest.TempPathFactory) -> Summary:
    folder = tmp_path_factory.mktemp("ball")
    scene, path, motion = folder / "ball.xml", folder / "ball.mcap", folder / "rest.csv"
    scene.write_text(SCENE)
    motion.write_text("t,x,y,z,qw,qx,qy,qz\n0,0,0,0,1,0,0,0\n2,0,0,0,1,0,0,0\n")
    return recorded(
        path,
        scene,
        SimulatedDevice(damping=4.0, path=str(motion)),
        duration=0.8,
        impact_pulses=0.5,
        method="implicit",
        controller=None,
        limits=Limits(force=8.0, torque=0.5),
    )


@pytest.fixture(scope="module")
def run(summary: Summary) -> Recording:
    assert summary.recording is not None
    return read_recording(summary.recording)


@pytest.fixture(scope="module")
def blows(run: Recording) -> list[Blow]:
    evidence = Evidence.of(run)
    assert evidence is not None
    return blows_of(evidence)


def test_a_ball_on_a_held_paddle_is_strict_and_bounces_as_asked(
    run: Recording, blows: list[Blow]
) -> None:
    report = audit(run.path)
    assert (report.verdict, report.environment, report.certified) == ("passive", "strict", True)
    assert report.resimulation == "bit for bit"
    first = blows[0]
    assert first.speed == pytest.approx(math.sqrt(2 * 9.81 * DROP), rel=0.02)
    assert first.asked == pytest.approx(E, rel=1e-9)
    assert first.had == pytest.approx(E, rel=0.02)
    # the next blow comes after a flight of 2 e v/g, while the paddle is nearly at rest
    flight = 2 * E * first.speed / 9.81
    assert blows[1].time - first.time == pytest.approx(flight, rel=0.1)


def test_the_summary_has_what_blows_paid_and_what_pulses_did(
    summary: Summary, blows: list[Blow]
) -> None:
    assert summary.pulses is not None
    paid, worked, ended_by = summary.pulses
    assert ended_by == 0
    assert not any(blow.ended_by for blow in blows)
    assert paid == pytest.approx(sum(blow.paid for blow in blows), rel=1e-6)
    assert worked == pytest.approx(sum(blow.worked for blow in blows), abs=1e-6)
    gave = f"blows gave them {format_energy(paid)}, the hand gave them {format_energy(-worked)}"
    assert gave in str(summary)
    assert balance_words(2.0, 1.0, 0).endswith("gave them 2 J, they gave the hand 1 J")


def test_a_blow_of_two_ticks_has_the_e_of_the_faster_one(run: Recording) -> None:
    evidence = Evidence.of(run)
    assert evidence is not None
    ticks = evidence.ticks.copy()
    ticks["blow_energy"] = 0.0
    for tick, speed, rebound in ((30, 0.08, 0.0), (31, 0.14, 0.8)):
        ticks["blow_energy"][tick], ticks["blow_restitution"][tick] = 1e-3, 0.8
        ticks["blow_speed"][tick], ticks["blow_rebound"][tick] = speed, rebound
    (blow,) = blows_of(replace(evidence, recording=replace(run, ticks=ticks)))
    assert (blow.speed, blow.had) == pytest.approx((0.14, 0.8))
    assert blow.returned == pytest.approx(2e-3 * 0.64 / 0.36)


def test_a_pulse_that_ends_early_is_told_with_its_cause(tmp_path: Path) -> None:
    device = ScriptedDevice(tap, damping=B, is_stale=lambda tick: tick < 200 and tick % 7 < 1)
    scene = tmp_path / "wall.xml"
    scene.write_text(wall())
    summary = recorded(
        tmp_path / "run.mcap",
        scene,
        device,
        Coupling(1000.0, 0.5, 1.0, 5e-4),
        duration=0.6,
        impact_pulses=1.0,
        limits=Limits(force=8.0, torque=0.5),
    )
    assert summary.pulses is not None
    assert summary.pulses[2] == TickFlag.STALE_SAMPLE
    assert "; cut short by a missing sample" in str(summary)
    run = read_recording(tmp_path / "run.mcap")
    evidence, page = Evidence.of(run), tmp_path / "page.html"
    assert evidence is not None
    first, last = blows_of(evidence)
    assert (first.ended_by, last.ended_by) == (TickFlag.STALE_SAMPLE, 0)
    write_report(run, audit(run.path), page)
    assert page.read_text().count("<td>a missing sample</td>") == 1


def test_the_energies_of_a_blow_are_those_of_two_bodies(blows: list[Blow]) -> None:
    first, mass = blows[0], BALL * PADDLE / (BALL + PADDLE)
    lost = 0.5 * mass * first.speed**2 * (1 - E**2)
    assert first.burned == pytest.approx(lost, rel=0.05)
    assert first.returned == pytest.approx(lost * E**2 / (1 - E**2), rel=0.1)
    assert first.paid == pytest.approx(0.5 * first.burned, rel=0.05)


def test_the_works_of_all_pulses_are_those_of_the_records(
    run: Recording, blows: list[Blow]
) -> None:
    moved = np.diff(run.ticks["device_position"], axis=0)
    whole = float(np.sum(run.ticks["pulse"][:-1] * moved))
    assert sum(blow.worked for blow in blows) == pytest.approx(whole, rel=1e-9)
    assert whole != 0.0


def test_the_page_lists_the_blows(run: Recording, blows: list[Blow], tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    write_report(run, audit(run.path), page)
    text = page.read_text()
    assert "Blows of the tool" in text
    for each in blows[:MAX_BLOWS]:
        for word in blow_row(each):
            assert f"<td>{word}</td>" in text


def test_a_run_without_a_blow_has_no_such_table(tmp_path: Path) -> None:
    path, page = tmp_path / "run.mcap", tmp_path / "page.html"
    recorded(path, "point_mass", duration=0.02)
    evidence = Evidence.of(read_recording(path))
    assert evidence is not None
    assert blows_of(evidence) == []
    write_report(read_recording(path), audit(path), page)
    assert "Blows of the tool" not in page.read_text()
