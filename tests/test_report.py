"""The report of a run: its page, and why a run became active."""

from __future__ import annotations

import html
import io
import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import report_runs
from audit_cases import ScriptedDevice, recorded
from bridge_runs import still
from check_scenes import GOOD_OPTION, LEAPING, TWO_SIDED
from chromium import browser
from outside_scenes import mjcf
from PIL import Image
from report_runs import Made

import hapticbridge as hb
from hapticbridge.audit import AuditReport, audit
from hapticbridge.audit.replay import Agreement
from hapticbridge.clock import SimulatedClock
from hapticbridge.coupling import Coupling
from hapticbridge.demand.certificate import run_conditions
from hapticbridge.demand.certification import Standing
from hapticbridge.demand.methods import method_named
from hapticbridge.demand.trip import Trip, TripCode
from hapticbridge.kernel.parameters import DAMPER
from hapticbridge.kernel.record import TickFlag
from hapticbridge.recording import Recording, read_recording
from hapticbridge.report import write_report
from hapticbridge.report.cause import Cause
from hapticbridge.report.evidence import Evidence
from hapticbridge.report.page import (
    MAX_EVENTS,
    MAX_INPUTS,
    event_rows,
    guard_facts,
    is_warned,
    notes,
)
from hapticbridge.report.plots import (
    PAGE_BINS,
    activities,
    decimated,
    draw_motion,
    draw_recording,
    draw_timing,
)
from hapticbridge.report.search import likely_cause, pump_behind_trip
from hapticbridge.run.bridge import Bridge
from hapticbridge.units import format_si

pytestmark = pytest.mark.filterwarnings("ignore:scene '.*(floor|fan).xml'")


def evidence_of(recording: Recording) -> Evidence:
    evidence = Evidence.of(recording)
    assert evidence is not None
    return evidence


def changed(recording: Recording, **parts: Any) -> Recording:
    return Recording(**{**vars(recording), **parts})


def cause_by(evidence: Evidence, report: AuditReport) -> Cause:
    cause = likely_cause(evidence, report)
    assert cause is not None
    return cause


def cause_of(recording: Recording, report: AuditReport, **parts: Any) -> Cause:
    return cause_by(evidence_of(changed(recording, **parts)), report)


def test_a_long_page_stays_small_and_keeps_its_peaks(run_file: Path, tmp_path: Path) -> None:
    """Noise in every number that is drawn: the longest curves that there can be."""
    generator, count, quiet = np.random.default_rng(2), 30_000, read_recording(run_file)
    ticks = np.repeat(quiet.ticks[-1:], count)
    ticks["tick"] = np.arange(count)
    for name in ("wrench_on_tool", "tool_position", "handle_position", "kinetic", "device_energy"):
        ticks[name] = generator.normal(size=ticks[name].shape)
    ticks["deadline_ns"] = 1_000_000 * (1 + ticks["tick"])
    ticks["wake_ns"] = ticks["deadline_ns"] + generator.integers(0, 2_000_000, count)
    ticks["flags"] = generator.integers(0, 1024, count)
    ticks["wrench_on_tool"][12_345, 0] = 77.0
    recording, page = changed(quiet, ticks=ticks), tmp_path / "page.html"
    line = draw_motion(evidence_of(recording)).axes[0].get_lines()[0]
    assert len(np.asarray(line.get_ydata())) <= 2 * PAGE_BINS + 1
    assert np.asarray(line.get_ydata()).max() == 77.0
    write_report(recording, audit(run_file), page)
    assert 100_000 < page.stat().st_size < 1_000_000  # curves are of constant length


def test_a_page_leads_with_its_verdict_and_shows_a_moment_only_of_a_fault(
    run_file: Path, made: Made, tmp_path: Path
) -> None:
    passive, page = audit(run_file), tmp_path / "page.html"
    sentences = {
        True: "The device bears this coupling, in any hand.",
        False: "The device does not bear this coupling",
        None: "It is not known if the device bears this coupling in any hand.",
    }
    found = passive.certification
    assert found is not None
    standings = {
        True: Standing.CERTIFIED,
        False: Standing.DAMPING,
        None: Standing.DAMPING_UNKNOWN,
    }
    for certified, words in sentences.items():
        judged = replace(passive, certification=replace(found, standing=standings[certified]))
        assert words in notes(judged)[-1]
        assert is_warned(judged) is (certified is False)
    assert not notes(replace(passive, verdict="active"))
    trip = Trip(TripCode.JUMPED, 3)
    stopped = replace(passive, remarks=(*passive.remarks, "the guard tripped"), trip=trip)
    write_report(read_recording(run_file), stopped, page)
    text = page.read_text(encoding="utf-8")
    assert '<section class="verdict warned">' in text
    assert "<p>The guard tripped.</p>" in text
    assert "The moment" not in text
    recording, active = made(report_runs.active_by_method)
    energy, allowed = evidence_of(recording).judged(active)
    cause = cause_of(recording, active)
    write_report(recording, active, page)
    text = html.unescape(page.read_text(encoding="utf-8"))
    first = text[text.index("<section") : text.index("</section>")]
    most = format_si(float((energy - allowed).max()), "J")
    where = f"(tick {active.tick})", f"(tick {int(np.argmax(energy - allowed))})"
    for told in (*where, most, f"<strong>{cause.kind}</strong>. ", cause.remedy[1:]):
        assert told in first
    assert "The moment" in text


def test_the_energies_that_are_drawn_balance(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"  # gravity, and springs in the joints of a ratchet
    with Bridge("ratchet", clock=SimulatedClock(), recording=path) as bridge:
        bridge.run(duration=1.0)
    energies = draw_recording(read_recording(path)).axes[-1]
    grids, sums = np.linspace(0.0, 0.999, 400), {"-": 0.0, "--": 0.0}
    for line in energies.get_lines():
        if line.get_label() != "given to the device":
            drawn = np.interp(grids, *np.asarray(line.get_data(), dtype=float))
            sums[str(line.get_linestyle())] += drawn
    stored, worked = sums["--"], sums["-"]  # the curves are decimated: equal but for peaks
    largest = np.abs(stored).max()
    assert largest > 1.0  # mJ
    apart = stored - worked  # the first tick's change is not drawn
    assert np.median(np.abs(apart - np.median(apart))) < 0.002 * largest
    assert abs(np.median(apart)) < 0.02 * largest


def test_no_peak_of_a_curve_is_lost_wherever_it_stands() -> None:
    bins = 30
    for count in (100, 103, 899, 901):
        time = np.arange(count, dtype=np.float64)
        for at in range(count):
            values = np.zeros(count)
            values[at] = -1.0 if at % 2 else 1.0
            drawn_at, drawn = decimated(time, values, bins)
            assert len(drawn) <= 2 * bins + 1
            assert (np.diff(drawn_at) >= 0).all()
            assert set(drawn_at[drawn != 0.0]) == {float(at)}


def test_lateness_is_drawn_by_its_powers_of_ten(run_file: Path) -> None:
    recording = read_recording(run_file)
    ticks = recording.ticks.copy()
    late = 10.0 ** np.linspace(2.0, 7.0, len(ticks))  # ns: 0.1 µs to 10 ms
    ticks["wake_ns"] = ticks["deadline_ns"] + late.astype(np.int64)
    axes = draw_timing(evidence_of(changed(recording, ticks=ticks))).axes[0]
    counts = [bar.get_height() for bar in axes.containers[0]]
    assert axes.get_xscale() == "log"
    assert sum(counts) == len(ticks)
    # evenly spread over powers of ten, but for what is below 1 µs
    assert max(counts[1:]) < 2 * np.median(counts[1:]) + 2
    assert counts[0] >= 0.19 * len(ticks)


def test_what_the_guard_did_is_drawn_and_told(run_file: Path, tmp_path: Path) -> None:
    """Samples that stay away, a controller, a re-seating and a trip, made up in a quiet run."""
    recording = read_recording(run_file)
    guard = replace(evidence_of(recording).parameters.guarding, controller=DAMPER, stale_ticks=10)
    ticks = recording.ticks.copy()
    ticks["flags"] = 0
    ticks["flags"][20:50] = int(TickFlag.STALE_SAMPLE)
    ticks["flags"][50] = int(TickFlag.REANCHORED)
    ticks["flags"][60:70] = int(TickFlag.CONTROLLER_ACTIVE)
    ticks["injected_damping"][60:70] = 1.5
    events = [*recording.events, {"event": "trip", "tick": len(ticks), "reason": "it jumped"}]
    meta = recording.meta | {"guard": guard.to_json()}
    guarded = changed(recording, ticks=ticks, events=events, meta=meta)
    evidence = evidence_of(guarded)
    shown = dict(activities(evidence))
    assert np.flatnonzero(shown["faded: no samples"]).tolist() == list(range(30, 50))
    assert np.flatnonzero(shown["re-anchored"]).tolist() == [50]
    assert np.flatnonzero(shown["tripped"]).tolist() == [len(ticks) - 1]
    damped = draw_timing(evidence).axes[-1].get_lines()[0]
    assert np.asarray(damped.get_ydata()).max() == 1.5
    assert ("controller", "damper") in guard_facts(evidence)
    page = tmp_path / "page.html"
    write_report(guarded, audit(run_file), page)
    for told in ("damper, at work in", "up to 1.5 N s/m injected", "reason it jumped"):
        assert told in page.read_text(encoding="utf-8")


@pytest.mark.parametrize("name", ["input", "shown", "own_loop"])
def test_what_stopped_a_run_is_listed_after_any_number_of_inputs(name: str) -> None:
    inputs = [{"event": name, "tick": i, "time_ns": i} for i in range(2 * MAX_INPUTS)]
    trip = {"event": "trip", "tick": 400, "time_ns": 400_000_000, "reason": "it jumped"}
    rows = event_rows([{"event": "start", "tick": 0, "time_ns": 0}, *inputs, trip])
    assert [row[0] for row in rows] == ["start", *[name] * MAX_INPUTS, "trip"]
    assert rows[-1] == ("trip", "400", "0.400 s", "reason it jumped")
    others = [{"event": "resume", "tick": i} for i in range(2 * MAX_EVENTS)]
    assert len(event_rows([*inputs, *others])) == MAX_EVENTS


def test_the_bytes_of_what_a_program_showed_are_not_listed() -> None:
    (row,) = event_rows([{"event": "shown", "tick": 3, "count": 2, "posts": "AAAA"}])
    assert row == ("shown", "3", "–", "count 2")


def test_a_browser_shows_the_page_without_a_request_or_a_complaint(
    made: Made, tmp_path: Path
) -> None:
    page = tmp_path / "page.html"
    picture = io.BytesIO()
    Image.new("RGB", (64, 40)).save(picture, "png")
    write_report(*made(report_runs.active_by_contact), page, picture.getvalue())
    with browser(tmp_path) as tab:
        shown = tab()
        shown.open(page.as_uri())
        assert shown.value("document.querySelector('h1').innerText").endswith(": active")
        assert (
            shown.value("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
        )
        assert shown.value("document.querySelectorAll('svg').length") == 4
        assert shown.value("document.documentElement.scrollWidth <= innerWidth")
        assert shown.value("document.querySelector('img').naturalWidth") == 64
        assert [each for each in shown.requests if not each.startswith("data:")] == [page.as_uri()]
        assert shown.complaints == []
        shown.open(page.as_uri(), width=360)  # a telephone: nothing is cut, curves can be pushed
        assert shown.value("document.documentElement.scrollWidth") <= 360
        assert shown.value("document.querySelector('svg').getBoundingClientRect().width") > 600


@pytest.mark.parametrize(
    ("run", "port", "kind", "told"),
    [
        (report_runs.active_by_method, "environment", "method", "implicitfast"),
        (report_runs.active_by_contact, "environment", "contact setting", 'solref "-20000 -50"'),
        (report_runs.active_by_rate, "device", "rate", "the coupling needs 5"),
        (report_runs.active_by_delay, "device", "delay", "2 ticks old"),
        # steps of its encoder too, but it has less damping than the coupling needs
        (
            report_runs.active_by_quantisation,
            "device",
            "rate",
            "is 2 N s/m, the coupling needs 2.25",
        ),
        (report_runs.active_by_mocap, "environment", "inputs", "'pusher' touched geom 'ball'"),
        (report_runs.active_beside_a_fan, "environment", "contact setting", "while geom 0 touched"),
        (report_runs.active_by_rotation, "device", "rate", "rotation: the device's damping"),
        (report_runs.active_by_repeated_samples, "device", "delay", "75% of the samples"),
    ],
)
def test_a_run_is_active_for_the_cause_that_it_was_made_for(
    run: Callable[[Path], Path], port: str, kind: str, told: str, made: Made
) -> None:
    recording, report = made(run)
    assert (report.verdict, report.port) == ("active", port)
    evidence = evidence_of(recording)
    cause = cause_by(evidence, report)
    assert cause.kind == kind
    assert told in cause.evidence
    energy, allowed = evidence.judged(report)
    assert energy[report.tick] - allowed[report.tick] == pytest.approx(report.joules)


@pytest.mark.parametrize(
    ("run", "had", "has", "kind"),
    [
        # swings over many steps of a fine one
        (report_runs.active_by_rate, '"resolution": 0.0', '"resolution": 1e-9', "rate"),
        (report_runs.active_by_rate, '"damping": 2.0', '"damping": 20.0', "unknown"),
    ],
)
def test_another_device_has_another_cause(
    run: Callable[[Path], Path], had: str, has: str, kind: str, made: Made
) -> None:
    recording, report = made(run)
    assert had in recording.meta["device"]
    meta = recording.meta | {"device": recording.meta["device"].replace(had, has)}
    assert cause_of(recording, report, meta=meta).kind == kind


def test_steps_of_the_encoder_are_the_cause_where_the_damping_suffices(made: Made) -> None:
    recording, report = made(report_runs.active_by_quantisation)
    evidence = evidence_of(recording)
    borne = replace(evidence.worst.coupling, stiffness=3900.0)
    evidence = replace(evidence, worst=replace(evidence.worst, coupling=borne))
    cause = cause_by(evidence, report)
    assert cause.kind == "quantisation"
    assert "takes a friction of K D/2 + B_law D/T = 0.39 N" in cause.evidence
    # friction enough to hold still between the steps of a coarse encoder
    held = replace(evidence, info=replace(evidence.info, friction=0.5))
    assert cause_by(held, report).kind == "unknown"


def test_the_scene_is_the_cause_by_what_touched_and_what_was_moved(made: Made) -> None:
    recording, report = made(report_runs.active_by_contact)
    assert "touched" in cause_of(recording, report).evidence
    gains = ("stiffness", "damping", "rotational_stiffness", "rotational_damping")
    law = json.dumps([float(recording.meta[name]) for name in gains])
    hazardous = recording.meta | {"method": "implicitfast", "requested": law}
    assert cause_of(recording, report, meta=hazardous).kind == "contact setting"
    foreign = replace(report, agreement=Agreement.NOT_RUN, obstacle="recorded with mujoco 3.0.0")
    cause = cause_of(recording, foreign)
    assert (cause.kind, "touched" in cause.evidence) == ("contact setting", False)
    recording, report = made(report_runs.active_by_mocap)
    still = [event for event in recording.events if event["event"] != "input"]
    assert cause_of(recording, report).kind == "inputs"
    assert cause_of(recording, report, events=still).kind == "unknown"


TIED = """<mujoco><option iterations="1"/><worldbody><geom type="plane" size="2 2 .1"/>
  <body name="arm" pos="0 1 1"><joint axis="0 1 0"/><site name="end" pos=".1 0 0"/>
  <geom type="capsule" fromto="0 0 0 .1 0 0" size=".005"/></body>
  <site name="post" pos="0 1.02 1.15"/>
  <body pos="1 0 .0199"><freejoint/><geom size=".02" mass=".1"/></body>
  <body pos="0 0 .5"><freejoint/><geom size=".02" mass=".3"/><site name="grip"/></body></worldbody>
  <equality><connect name="tie" site1="end" site2="post"/></equality></mujoco>"""
"""An arm that is pulled to a point 0.15 m away, beside a ball on a floor; the solver has one
iteration, which is too few in every tick."""


@pytest.mark.filterwarnings("ignore:scene '.*chain.xml'")
def test_what_happened_in_the_same_ticks_is_no_cause(tmp_path: Path) -> None:
    path, scene = tmp_path / "run.mcap", tmp_path / "chain.xml"
    scene.write_text(TIED)
    recorded(path, scene, contact="scene", duration=0.1)
    recording, report = read_recording(path), audit(path)
    assert report.verdict == "active"
    first = recording.ticks[: (report.tick or 0) + 1]
    assert (first["solver_iterations"] >= 1).all()
    assert (first["contacts"] > 0).all()
    cause = cause_of(recording, report)
    assert (cause.kind, "connect 'tie'" in cause.evidence) == ("constraint", True)


FALLS = """<mujoco><option iterations="{}" cone="elliptic"/><worldbody>
  <geom type="plane" size="1 1 .1" pos="0 0 -.29"/>
  <body pos=".012 .0057 .002" euler="42 32 44"><freejoint/><geom type="capsule" size=".015 .026"
  mass=".035" euler="140 82 86" solref=".0005 8"/><body pos=".072 .017 -.039">
  <joint type="slide" frictionloss=".18"/><joint type="slide" axis=".65 .2 .32"/>
  <geom type="ellipsoid" size=".0064 .016 .015" mass=".47" contype="0" conaffinity="0"/></body>
  </body><body pos=".063 -.0077 -.0087" euler="35 48 17"><joint stiffness="46" armature=".041"/>
  <geom type="cylinder" size=".027 .015" mass=".22" euler="19 40 39" margin=".01"
  solref=".0005 8"/><body pos=".066 -.077 .041"><joint/><geom type="cylinder" size=".015 .008"
  mass=".16"/><body gravcomp="1"><joint type="slide"/><geom type="ellipsoid"
  size=".0073 .019 .023" mass=".092"/><site name="grip"/></body></body></body>
</worldbody></mujoco>"""
"""A light capsule with a heavy slider in it falls past an arm, onto a floor."""


def test_a_solver_that_stops_early_is_the_cause_where_more_iterations_help(tmp_path: Path) -> None:
    scene, remedy = tmp_path / "floor.xml", 'write <option iterations="10">'
    for iterations, verdict in ((1, "active"), (10, "passive")):
        path = tmp_path / f"{iterations}.mcap"
        scene.write_text(FALLS.format(iterations))
        coupling = Coupling(200.0, 0.4, 0.16, 5e-4)
        device = ScriptedDevice(report_runs.circling)
        recorded(path, scene, device, coupling, contact="scene", duration=0.4)
        report = audit(path)
        assert report.verdict == verdict
        if verdict == "active":
            cause = cause_of(read_recording(path), report)
            assert (cause.kind, cause.remedy) == ("solver", remedy)
            assert "limit of 1 iteration:" in cause.evidence


@pytest.mark.parametrize("contact", ["scene", "rigid"])
def test_a_contact_that_lies_beside_is_no_cause(contact: str, tmp_path: Path) -> None:
    """A spring throws a light link, while a ball lies on a floor as hard as in ``HARD_FLOOR``."""
    path, scene = tmp_path / "run.mcap", tmp_path / "floor.xml"
    ball = f"<body pos='1 1 .02'><freejoint/><geom name='ball' size='.02' mass='.1' {HARD}/></body>"
    apart = '<default><geom contype="0" conaffinity="0"/></default><worldbody>'
    ball = ball.replace("<geom", '<geom contype="1" conaffinity="1"')
    floor = f'<geom name="floor" {PLATE} contype="1" conaffinity="1"/>'
    text = THROWN.replace('<flag contact="disable"/>', "").replace('gravity="0 0 0"', "")
    scene.write_text(text.replace("<worldbody>", f"{apart}{floor}{ball}"))
    recorded(path, scene, coupling=hb.Coupling(177.0, 3.1), duration=0.03, contact=contact)
    report = audit(path)
    assert report.verdict == "active"
    cause = cause_of(read_recording(path), report)
    assert "ticks with contact, 100% while geom 'floor' touched geom 'ball'" in cause.evidence
    assert (cause.kind, "body 'base' turned" in cause.evidence) == ("rate", True)


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_the_contact_that_is_the_cause_is_named_before_those_that_touched_as_long(
    tmp_path: Path,
) -> None:
    path, device = tmp_path / "run.mcap", ScriptedDevice(report_runs.tapping)
    soft = 'size=".02" mass="1" priority="1" solref=".0005 8"'
    beside = "".join(
        f'<body pos="{x} 1 .0199"><freejoint/><geom name="{name}" {soft}/></body>'
        for x, name in ((1, "one"), (2, "two"))
    )
    scene = report_runs.HARD_FLOOR.replace("<worldbody>", f"<worldbody>{beside}")
    scene = scene.replace('<geom type="plane"', '<geom name="floor" type="plane"')
    scene = scene.replace('<geom type="sphere"', '<geom name="ball" type="sphere"')
    options = {"duration": 0.1, "contact": "scene"}
    report_runs.made_in(path, scene, device, report_runs.LOOSE, **options)
    cause = cause_of(read_recording(path), audit(path))
    assert cause.kind == "contact setting"
    touched = re.search(r"while (geom \S+) touched (geom [^ ,;]+)", cause.evidence)
    assert touched
    assert touched.groups() == ("geom 'floor'", "geom 'ball'")
    assert "the contact of geom 'floor' with geom 'ball' (" in cause.evidence


def test_a_body_that_was_moved_slowly_beside_is_no_cause(tmp_path: Path) -> None:
    path, scene = tmp_path / "run.mcap", tmp_path / "fan.xml"
    scene.write_text(
        """<mujoco><option timestep="0.001" wind="0 0 9" density="1.2"/><worldbody>
        <body name="lift" mocap="true" pos="2 0 -.05"><geom type="box" size=".2 .2 .05"/></body>
        <body pos="2 0 .05"><freejoint/><geom type="box" size=".05 .05 .05" mass="20"/></body>
        <body pos="0 3 3"><freejoint/><geom type="box" size=".1 .1 .01" mass=".05"/></body>
        <body pos="0 0 .5"><freejoint/><geom size=".02" mass=".3"/><site name="grip"/></body>
        </worldbody></mujoco>"""
    )

    def lift(bridge: Bridge, tick: int) -> None:  # 10 mm/s under 200 N
        bridge.set_input(mocap={"lift": (2, 0, 1e-5 * tick - 0.05, 1, 0, 0, 0)})

    recorded(path, scene, contact="scene", duration=0.2, on_tick=lift)
    report = audit(path)
    assert report.verdict == "active"
    cause = cause_of(read_recording(path), report)
    assert (cause.kind, cause.remedy) == ("unmetered work", "remove wind, or make it weaker")


def test_a_joint_that_pumps_is_named_as_the_cause(tmp_path: Path) -> None:
    path, scene = tmp_path / "run.mcap", tmp_path / "drawer.xml"
    scene.write_text(
        """<mujoco><worldbody><body><joint name="rail" type="slide" axis="1 0 0" damping="-30"/>
        <geom size="0.02" mass="0.5"/><site name="grip"/></body></worldbody></mujoco>"""
    )
    device = ScriptedDevice(lambda tick: (1e-4 * min(tick, 20), 0, 0, 1, 0, 0, 0))
    limits = hb.Limits(force=10.0, torque=0.5, energy=np.inf, stretch=np.inf)
    recorded(path, str(scene), device, duration=0.1, limits=limits)
    cause = cause_of(read_recording(path), audit(path))
    assert cause.kind == "pump"
    assert "joint 'rail' has a damping of -30" in cause.evidence


def test_the_cause_of_the_most_is_told_where_another_was_earlier(tmp_path: Path) -> None:
    """A breath of wind in the first tick, and a joint that pumps as the hand sets off."""
    path, scene = tmp_path / "run.mcap", tmp_path / "fan.xml"
    scene.write_text(
        """<mujoco><option wind="0 0 .2" density="1.2" gravity="0 0 0"/><worldbody>
        <body><joint name="rail" type="slide" axis="1 0 0" damping="-2"/>
        <geom size="0.02" mass="0.5"/><site name="grip"/></body>
        <body pos="0 3 3"><freejoint/><geom type="box" size=".1 .1 .01" mass=".05"/></body>
        </worldbody></mujoco>"""
    )
    device = ScriptedDevice(lambda tick: (5e-4 * min(max(tick - 250, 0), 60), 0, 0, 1, 0, 0, 0))
    recorded(path, scene, device, duration=0.4)
    recording, report = read_recording(path), audit(path)
    assert report.tick is not None
    assert report.tick < 50
    cause = cause_of(recording, report)
    assert (cause.kind, cause.remedy) == ("pump", 'write damping="0" or more')
    assert cause.evidence.startswith("most came in the 0.2 s before 0.")


SHELF = '<body name="shelf" mocap="true" pos="0 0 -.05"><geom type="box" size="1 1 .05" {}/></body>'
PLATE = 'type="plane" size="1 1 0.1"'
HARD = 'solref="-20000 -50" solimp="0.9 0.95 0.001"'


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize(
    ("old", "new"),
    [
        (
            "<worldbody>",
            '<worldbody><body pos="1 0 1"><joint damping="-.1"/><geom size=".1"/></body>',
        ),
        ('cone="elliptic"', 'cone="elliptic" wind="1 0 0"'),
        ('cone="elliptic"', 'cone="elliptic" wind="1 0 0" density="1e-9"'),
        (
            "<worldbody>",
            '<worldbody><body pos="1 0 1"><freejoint/><geom size=".1" adhesion="1"/></body>',
        ),
        (f"<geom {PLATE} {HARD}/>", SHELF.format(HARD)),
    ],
    ids=["joint at rest", "no medium", "thin medium", "nothing sticks", "creeping shelf"],
)
def test_what_did_no_work_is_no_cause(old: str, new: str, tmp_path: Path) -> None:
    """The hard floor creates the energy; a shelf in its place creeps by 0.1 pm a tick."""
    path, device = tmp_path / "run.mcap", ScriptedDevice(report_runs.tapping)
    assert old in report_runs.HARD_FLOOR

    def creep(bridge: Bridge, tick: int) -> None:
        if "shelf" in new:
            bridge.set_input(mocap={"shelf": (0, 0, 1e-13 * tick - 0.05, 1, 0, 0, 0)})

    scene = report_runs.HARD_FLOOR.replace(old, new)
    options = {"duration": 0.1, "contact": "scene", "on_tick": creep}
    report_runs.made_in(path, scene, device, report_runs.LOOSE, **options)
    cause = cause_of(read_recording(path), audit(path))
    assert (cause.kind, "bounces (e = 0.61)" in cause.evidence) == ("contact setting", True)


TOWED = f"""<mujoco><option timestep="0.001"/><worldbody><geom {PLATE} {HARD}/>
<body pos="0 0.5 0.025"><freejoint/><geom type="box" size=".025 .025 .025" mass="0.1"/></body>
<body pos="-0.06 0 0.1"><freejoint/><geom size="0.02" mass="0.1"/><site name="grip"/></body>
<body name="towed" pos="0.06 0 0.1"><freejoint/><geom size="0.02" mass="0.1"/></body>
<body name="tug" mocap="true" pos="0.06 0 0.1"/></worldbody>
<equality><weld body1="tug" body2="towed" solref="0.02 1"/></equality></mujoco>"""
"""A body that is welded to a moved one, and a box that lies on a hard floor beside them."""


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_box_at_rest_is_not_blamed_for_a_weld_that_was_moved(tmp_path: Path) -> None:
    """Tug and towed body touch nothing; without the moves the run is passive."""

    def towed(ticks: set[int]) -> AuditReport:
        def tow(bridge: Bridge, tick: int) -> None:
            if tick in ticks:
                way = 1e-4 * tick
                bridge.set_input(mocap={"tug": (0.06 - way, 0.0, 0.1 - way, 1, 0, 0, 0)})

        path, device = tmp_path / f"{len(ticks)}.mcap", ScriptedDevice(report_runs.resting)
        options = {"duration": 0.05, "contact": "scene", "on_tick": tow}
        report_runs.made_in(path, TOWED, device, report_runs.LOOSE, **options)
        return audit(path)

    report = towed({10, 20})
    cause = cause_of(read_recording(report.path), report)
    assert (towed(set()).verdict, cause.kind) == ("passive", "inputs"), cause


FAST_HAND = """<mujoco><option gravity="0 0 0"/><worldbody>
<body><joint name="rail" type="slide" axis="{}"/><geom size="0.02" mass="2"/>
<site name="grip"/></body>
<body pos="1 0 0"><joint name="spin" type="slide" axis="{}"/><geom size="0.02" mass="1"/></body>
</worldbody><actuator><general name="fan" joint="{}" biastype="affine" biasprm="0 0 {}"/></actuator>
<keyframe><key name="home" qpos="0 0" qvel="0 1"/></keyframe></mujoco>"""
"""A tool that a fast hand leaves behind, beside a body that flies at 1 m/s."""

ALONG, ACROSS, PUMPED = "1 0 0", '0 1 0" damping="-1', '1 0 0" damping="-1'


@pytest.mark.parametrize(
    ("rail", "spin", "driven", "bias", "told"),
    [
        (ALONG, PUMPED, "spin", 0, ""),  # joined to no hand
        (ALONG, ALONG, "spin", 1, ""),
        (ACROSS, ALONG, "spin", 0, ""),  # at rest
        (PUMPED, ALONG, "spin", 0, "joint 'rail' has a damping of -1: it pushes what moves"),
        (ALONG, ALONG, "rail", 1, "actuator 'fan' pushes joint 'rail' harder the faster it moves"),
    ],
)
def test_a_pump_is_behind_a_trip_if_it_moves_and_can_move_the_tool(
    rail: str, spin: str, driven: str, bias: float, told: str, tmp_path: Path
) -> None:
    path, scene = tmp_path / "run.mcap", tmp_path / "hand.xml"
    scene.write_text(FAST_HAND.format(rail, spin, driven, bias))
    device = ScriptedDevice(lambda tick: (1.5e-3 * tick, 0, 0, 1, 0, 0, 0))
    limits = hb.Limits(force=1.0, torque=0.1)
    with pytest.raises(hb.SafetyTrip) as trip:
        recorded(path, str(scene), device, report_runs.LOOSE, duration=0.5, limits=limits)
    cause = pump_behind_trip(read_recording(path), audit(path), in_process=True)
    assert (cause is None) == (not told)
    note = " ".join(trip.value.__notes__)
    assert ("check the motion's unit (m) and speed" in note) == (not told)
    if cause is not None:
        assert told in cause.evidence
        assert "mJ of work in the 0.2 s before" in cause.evidence
        assert told.partition(":")[0] in note


def test_a_connect_that_begins_open_is_the_cause_and_rigid_contacts_hold_it(tmp_path: Path) -> None:
    # an arm of 0.1 m whose end is tied to a point 0.15 m away
    text = """<mujoco><worldbody><body name="arm"><joint axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 .1 0 0" size=".005"/><site name="end" pos=".1 0 0"/></body>
      <site name="post" pos="0 .02 .15"/><body pos=".5 0 0"><freejoint/><site name="grip"/>
      <geom size=".02" mass=".1"/></body></worldbody><equality>
      <connect name="tie" site1="end" site2="post"/></equality></mujoco>"""
    scene, path = tmp_path / "scene.xml", tmp_path / "run.mcap"
    scene.write_text(text)
    for method, contact, remedy in (
        ("lossless", "scene", "leave out --contact scene: rigid contacts"),
        ("implicitfast", None, "use method 'lossless' or 'implicit': rigid contacts"),
        ("lossless", "rigid", ""),
    ):
        verdict = "active" if remedy else "passive"
        with pytest.warns(UserWarning, match="connect 'tie' .* starts .* off"):
            recorded(path, scene, duration=0.2, method=method, contact=contact)
        report = audit(path)
        assert report.verdict == verdict
        if verdict == "active":
            cause = cause_by(evidence_of(read_recording(path)), report)
            assert cause.kind == "constraint"
            assert cause.evidence.startswith("connect 'tie' of site 'end' and 'post' did")
            assert cause.remedy.startswith(remedy)
        path.unlink()


def test_a_tendon_whose_length_jumps_is_named_as_the_cause(tmp_path: Path) -> None:
    path, scene = tmp_path / "run.mcap", tmp_path / "cord.xml"
    way = '<site site="a"/><geom geom="brim"/><site site="b"/>'
    cord = f'<tendon><spatial name="cord" stiffness="100">{way}</spatial></tendon>'
    scene.write_text(mjcf(GOOD_OPTION, cord, body=LEAPING))
    lengths = []
    with Bridge(str(scene), clock=SimulatedClock(), recording=path) as bridge:
        bridge.run(
            duration=1.2, on_tick=lambda _: lengths.append(float(bridge.scene.data.ten_length[0]))
        )
    cause = cause_of(read_recording(path), audit(path))
    assert cause.kind == "jumping tendon"
    assert "sidesite" in cause.remedy
    told = re.search(r"tendon 'cord' jumped, by up to ([\d.]+) mm", cause.evidence)
    assert told
    # but for what its speed of 0.1 m/s explains
    assert float(told[1]) == pytest.approx(1e3 * np.abs(np.diff(lengths)).max(), abs=0.2)


def test_a_tendon_whose_way_changes_its_side_is_named_as_the_cause(tmp_path: Path) -> None:
    """The length is steady at the kink; the spring pushes the tool towards it from both sides."""
    path, scene = tmp_path / "run.mcap", tmp_path / "cord.xml"
    cord = '<tendon><spatial name="cord" stiffness="500" springlength=".2"><site site="a"/>'
    cord += '<geom geom="brim"{}/><site site="b"/></spatial></tendon>'
    verdicts = []
    for side in ("", ' sidesite="side"'):
        scene.write_text(mjcf(GOOD_OPTION, cord.format(side), body=TWO_SIDED))
        with Bridge(str(scene), clock=SimulatedClock(), recording=path) as bridge:
            bridge.run(duration=0.5)
        verdicts.append(audit(path))
        if not side:
            cause = cause_of(read_recording(path), verdicts[0])
    assert [report.verdict for report in verdicts] == ["active", "passive"]
    assert (cause.kind, "sidesite" in cause.remedy) == ("jumping tendon", True)
    told = re.search(r"the moment arms of tendon 'cord' jumped, by up to (\d+)%", cause.evidence)
    assert told
    assert int(told[1]) == pytest.approx(200, abs=3)  # they turn round


def test_missed_deadlines_are_the_cause_of_the_energy_beside_them(made: Made) -> None:
    recording, report = made(report_runs.active_by_rate)
    assert report.tick is not None
    window = slice(report.tick - 199, report.tick + 1)
    quiet = evidence_of(recording)
    borne = replace(quiet.worst, coupling=replace(quiet.worst.coupling, stiffness=3000.0))
    most = window.start + np.argsort(np.diff(quiet.excess, prepend=0.0)[window])[-70:]

    def cause_with(*late: Any) -> Cause:  # of a device that bears the coupling
        ticks = recording.ticks.copy()
        ticks["flags"][np.hstack(late)] |= int(TickFlag.OVERRUN)
        evidence = evidence_of(changed(recording, ticks=ticks))
        return cause_by(replace(evidence, worst=borne), report)

    assert cause_with(report.tick - 500, report.tick + 1).kind == "unknown"  # not before it
    # before it, but the energy came in other ticks
    assert cause_with(np.arange(report.tick - 100, report.tick - 97)).kind == "unknown"
    cause = cause_with(most)
    assert cause.kind == "rate"
    held = r"of the energy came beside ticks that were late by a period or more \(70 in the 0.2 s "
    assert re.search(held + r"before\), in each of which the wrench was held", cause.evidence)
    assert "than the coupling allows" not in cause.evidence


def test_a_fast_turn_without_contact_is_suspected_and_a_slow_one_is_not(made: Made) -> None:
    recording, report = made(report_runs.active_by_method)
    meta = recording.meta | {"method": "implicit"}
    assert cause_of(recording, report, meta=meta).kind == "unknown"
    ticks = recording.ticks.copy()
    half = 0.5 * 0.03 * ticks["tick"]
    ticks["tool_quaternion"] = np.stack([np.cos(half), np.sin(half), 0 * half, 0 * half], axis=1)
    cause = cause_of(recording, report, meta=meta, ticks=ticks)
    assert (cause.kind, "0.03 rad a tick (30 rad/s)" in cause.evidence) == ("rate", True)


def test_a_link_that_turns_faster_than_the_tool_is_named(tmp_path: Path) -> None:
    path, scene = tmp_path / "run.mcap", tmp_path / "leg.xml"
    scene.write_text(
        """<mujoco><worldbody><geom type="plane" size="5 5 .1"/><body pos="0 0 .35"><freejoint/>
        <geom type="capsule" fromto="-.2 0 0 .2 0 0" size=".05" mass="5"/><site name="grip"/>
        <body pos=".2 0 0"><joint name="hip" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.15" size=".02" mass=".2"/>
        <body name="foot" pos="0 0 -.15"><joint name="ankle" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.1" size=".01" mass=".01"/></body></body></body>
        </worldbody><actuator><motor name="hip" joint="hip" gear="500"/>
        <motor name="ankle" joint="ankle" gear="200"/></actuator></mujoco>"""
    )
    with (
        Bridge(str(scene), clock=SimulatedClock(), recording=path) as bridge,
        pytest.raises(hb.SafetyTrip),
    ):
        bridge.set_input(ctrl={"hip": 0.274, "ankle": -0.460})
        bridge.run(duration=0.1)
    cause = cause_of(read_recording(path), audit(path))
    assert cause.kind == "rate"
    assert "body 'foot' turned by up to" in cause.evidence
    assert cause.remedy == "raise the rate, or turn body 'foot' slower"


THROWN = """<mujoco><option gravity="0 0 0"><flag contact="disable"/></option><worldbody>
<body name="base"><freejoint/><geom size=".0075" mass="2e-4" pos="-.006 0 .002"/>
<body name="link" pos="0 -.004 .013" euler="24 64 83"><joint type="slide" axis=".98 .48 .16"
  pos=".009 .009 -.009" stiffness="42" springref="-.1" armature=".007" range="-.0034 .03"/>
<joint type="ball" pos="-.005 -.008 .003"/><geom type="box" size=".025 .026 .007" pos="0 .01
  .006" mass=".014" euler="133 155 70"/>
<body pos=".018 -.059 .072" euler="3 30 60"><joint type="slide" axis=".5 .65 .32" pos="-.01
  -.009 -.006" frictionloss=".07"/><geom size=".02" mass=".15" pos="0 .009 .01"/><site
  name="grip" pos="-.003 -.012 .018"/>
<body euler="67 42 59"><joint type="ball" pos="0 .002 -.003"/><geom type="capsule" size=".023
  .01" mass=".43" pos=".009 .001 .008"/></body></body></body></body>
</worldbody></mujoco>"""


def test_a_link_that_turns_fast_beside_a_tool_that_does_not_is_named(tmp_path: Path) -> None:
    # a bent spring throws a light link, which turns on a ball joint, within the first ticks
    path, scene = tmp_path / "run.mcap", tmp_path / "chain.xml"
    scene.write_text(THROWN)
    recorded(path, scene, coupling=hb.Coupling(177.0, 3.1), duration=0.03)
    report = audit(path)
    assert report.verdict == "active"
    cause = cause_of(read_recording(path), report)
    assert (cause.kind, cause.remedy) == ("rate", "raise the rate, or turn body 'base' slower")


@pytest.mark.parametrize(
    ("run", "told"),
    [
        # with b = 85 % of 2 N s/m and B' = 0: K <= 2 b/T; with K = 10000 T <= 2 b/K
        (report_runs.active_by_rate, "lower the stiffness to 3400 N/m, or raise the rate to 2950"),
        # K_r <= 2 b_r/T with 85 % of 0.002 N m s/rad
        (report_runs.active_by_rotation, "lower the rotational stiffness to 3.4 N m/rad, or raise"),
        # the stiffest behind two ticks; a faster loop does not shorten a delay
        (report_runs.active_by_delay, "set the stiffness to 821 N/m and the damping to 1.05 N s/m"),
    ],
)
def test_the_remedy_is_what_the_device_condition_asks_for(
    run: Callable[[Path], Path], told: str, made: Made
) -> None:
    recording, report = made(run)
    cause = cause_of(recording, report)
    assert told in cause.remedy
    assert ("raise the rate" in cause.remedy) == (cause.kind == "rate")
    if run is report_runs.active_by_rate:  # no rate of the loop helps a device with its own
        sheet = recording.meta["device"].replace('"rate": null', '"rate": 500.0')
        slow = evidence_of(changed(recording, meta=recording.meta | {"device": sheet}))
        assert remedy_of(slow).startswith("set the stiffness to 747 N/m and the damping to 0.627")


def test_a_damper_beyond_the_device_is_called_so_and_no_rate_is_asked_for(made: Made) -> None:
    recording, report = made(report_runs.active_by_rate)
    evidence = evidence_of(recording)
    for method, damping, kind, remedy in (
        # with b = 85 % of 2 N s/m
        ("implicit", 1.6, "rate", "raise the rate to 10000 Hz"),  # T <= 2 (b - B)/K
        ("implicit", 1.9, "damping", "lower the damping to 0.7 N s/m"),  # b - K T/2
        ("lossless", 1.9, "damping", "lower the damping to 1.7 N s/m"),  # B = B' + K T/2 <= b
    ):
        coupling = replace(evidence.worst.coupling, stiffness=2000.0, damping=damping)
        worst = replace(evidence.worst, coupling=coupling)
        cause = cause_by(replace(evidence, worst=worst, method=method_named(method)), report)
        assert cause.kind == kind
        assert remedy in cause.remedy
        assert ("raise the rate" in cause.remedy) == (kind == "rate")


def remedy_of(evidence: Evidence) -> str:
    """Returns the changes that the condition on translation names."""
    return run_conditions(evidence.info, evidence.worst, evidence.method)[0].remedy


def test_remedies_start_from_the_stiffest_coupling_that_commands_selected(tmp_path: Path) -> None:
    stiff = {"stiffness": 4000.0, "damping": 0.0}
    turned = {"rotational_stiffness": 0.5, "rotational_damping": 0.0}
    event = {"event": "coupling", "ticks": 500, "by": "another run", **stiff, **turned}

    def act(bridge: Bridge, tick: int) -> None:
        if tick == 20:
            bridge.repeat_commands([event])

    path = tmp_path / "run.mcap"
    weak, soft = ScriptedDevice(still, damping=1.0), Coupling(500.0, 0.0, 0.5, 0.0)
    recorded(path, "point_mass", weak, soft, method="implicit", duration=0.6, on_tick=act)
    evidence = Evidence.of(read_recording(path))
    assert evidence is not None
    # b = 1 N s/m bears K T/2 up to 2000 N/m, and has borne the coupling at the start
    assert remedy_of(evidence) == (  # with 15 % in reserve
        "lower the stiffness to 1700 N/m, or raise the rate to 2360 Hz"
    )
