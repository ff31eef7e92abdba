"""The page of a run: its verdict and cause, its size, and how a browser takes it."""

from __future__ import annotations

import html
import io
import sys
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import report_runs
from audit_cases import ScriptedDevice, SlowClock, recorded
from chromium import browser
from cli_cases import Called
from PIL import Image
from report_runs import Made

from hapticbridge.audit import audit
from hapticbridge.errors import HapticBridgeError, RecordingError
from hapticbridge.kernel.parameters import DAMPER, GuardParameters
from hapticbridge.record import TickFlag
from hapticbridge.recording import Recording, read_recording
from hapticbridge.report import plot_recording, write_report
from hapticbridge.report.cause import likely_cause
from hapticbridge.report.evidence import Evidence, decimated
from hapticbridge.report.facts import (
    MOST_EVENTS,
    MOST_INPUTS,
    event_rows,
    guard_facts,
    head_facts,
)
from hapticbridge.report.page import is_warned, notes
from hapticbridge.report.plots import (
    BINS,
    LEAST_SPAN,
    activities,
    draw_energies,
    draw_motion,
    draw_timing,
    energy_unit,
)
from hapticbridge.units import format_si

pytestmark = pytest.mark.filterwarnings("ignore:scene '.*floor.xml'")


def evidence_of(recording: Recording) -> Evidence:
    evidence = Evidence.of(recording)
    assert evidence is not None
    return evidence


def test_asked_for_strictly_the_slack_is_not_allowed(made: Made) -> None:
    recording, report = made(report_runs.active_by_contact)
    evidence = evidence_of(recording)
    assert evidence.judged(report)[1].any()
    assert not evidence.judged(replace(report, environment="within slack"))[1].any()


def test_a_passive_run_has_no_moment_and_no_cause(run_file: Path, tmp_path: Path) -> None:
    recording, report = read_recording(run_file), audit(run_file)
    evidence = evidence_of(recording)
    assert likely_cause(evidence, report) is None
    page = tmp_path / "page.html"
    write_report(recording, report, page)
    assert "The moment" not in page.read_text(encoding="utf-8")


def test_the_bound_is_drawn_beside_what_was_created(made: Made) -> None:
    recording, report = made(report_runs.active_by_method)
    evidence = evidence_of(recording)
    lines = {line.get_label(): line for line in draw_energies(evidence).axes[1].get_lines()}
    created = np.asarray(lines["created by the environment"].get_ydata())
    allowed = np.asarray(lines["allowed at most"].get_ydata())
    above = int(np.argmax(created > allowed + 1e-6))
    assert above == report.tick
    assert draw_energies(evidence).axes[1].get_ylabel() == "energy (mJ)"
    assert created[above] - allowed[above] == pytest.approx(1e3 * report.joules, rel=1e-5)


def long_and_wild(run_file: Path) -> Recording:
    """Noise in every number that is drawn: the longest curves that there can be."""
    recording = read_recording(run_file)
    generator, count = np.random.default_rng(2), 30_000
    ticks = np.repeat(recording.ticks[-1:], count)
    ticks["tick"] = np.arange(count)
    for name in ("wrench_on_tool", "tool_position", "handle_position", "kinetic", "device_energy"):
        ticks[name] = generator.normal(size=ticks[name].shape)
    ticks["deadline_ns"] = 1_000_000 * (1 + ticks["tick"])
    ticks["wake_ns"] = ticks["deadline_ns"] + generator.integers(0, 2_000_000, count)
    ticks["flags"] = generator.integers(0, 1024, count)
    ticks["wrench_on_tool"][12_345, 0] = 77.0
    return Recording(**{**vars(recording), "ticks": ticks})


def test_a_long_page_stays_small_and_keeps_its_peaks(run_file: Path, tmp_path: Path) -> None:
    recording, page = long_and_wild(run_file), tmp_path / "page.html"
    evidence = evidence_of(recording)
    line = draw_motion(evidence).axes[0].get_lines()[0]
    assert len(np.asarray(line.get_ydata())) <= 2 * BINS + 1
    assert np.asarray(line.get_ydata()).max() == 77.0
    write_report(recording, audit(run_file), page)
    assert 100_000 < page.stat().st_size < 1_000_000  # curves are of constant length


def test_no_peak_of_a_curve_is_lost_wherever_it_stands() -> None:
    bins = 30
    for count in (100, 103, 899, 900, 901):
        time = np.arange(count, dtype=np.float64)
        for at in range(count):
            values = np.zeros(count)
            values[at] = -1.0 if at % 2 else 1.0
            drawn_at, drawn = decimated(time, values, bins)
            assert len(drawn) <= 2 * bins + 1
            assert (np.diff(drawn_at) >= 0).all()
            assert set(drawn_at[drawn != 0.0]) == {float(at)}


def test_what_was_at_work_is_drawn_when_it_was(run_file: Path) -> None:
    recording = read_recording(run_file)
    ticks = recording.ticks.copy()
    ticks["flags"] = 0
    ticks["flags"][40:60] = int(TickFlag.FORCE_LIMITED)
    evidence = evidence_of(Recording(**{**vars(recording), "ticks": ticks}))
    names = [name for name, _ in activities(evidence)]
    row = names.index("force limited")
    bars = [b.get_paths() for b in draw_timing(evidence).axes[-1].collections]
    assert [len(paths) for paths in bars] == [int(i == row) for i in range(len(names))]
    extent = bars[row][0].get_extents()
    assert (extent.x0, extent.x1) == pytest.approx((0.041, 0.061), abs=1e-9)


def test_what_the_guard_did_is_drawn_and_told(run_file: Path, tmp_path: Path) -> None:
    """Samples that stay away, a controller, a re-seating and a trip, made up in a quiet run."""
    recording = read_recording(run_file)
    guard = replace(evidence_of(recording).parameters.guarding, controller=DAMPER, stale_ticks=10)
    ticks = recording.ticks.copy()
    ticks["flags"] = 0
    ticks["flags"][20:50] = int(TickFlag.STALE_SAMPLE)
    ticks["flags"][50] = int(TickFlag.RESEATED)
    ticks["flags"][60:70] = int(TickFlag.CONTROLLER_ACTIVE)
    ticks["injected_damping"][60:70] = 1.5
    events = [*recording.events, {"event": "trip", "tick": len(ticks), "reason": "it jumped"}]
    changed = Recording(
        **{
            **vars(recording),
            "ticks": ticks,
            "events": events,
            "meta": recording.meta | {"guard": guard.to_json()},
        }
    )
    evidence = evidence_of(changed)
    shown = dict(activities(evidence))
    assert np.flatnonzero(shown["faded: no samples"]).tolist() == list(range(30, 50))
    assert np.flatnonzero(shown["re-seated"]).tolist() == [50]
    assert np.flatnonzero(shown["tripped"]).tolist() == [len(ticks) - 1]
    damped = draw_timing(evidence).axes[-1].get_lines()[0]
    assert np.asarray(damped.get_ydata()).max() == 1.5
    assert ("controller", "damper") in guard_facts(evidence)
    page = tmp_path / "page.html"
    write_report(changed, audit(run_file), page)
    text = page.read_text(encoding="utf-8")
    assert "damper, at work in" in text
    assert "up to 1.5 N s/m injected" in text
    assert "reason it jumped" in text


def test_the_page_tells_everything_that_the_guard_was_set_to(run_file: Path) -> None:
    evidence = evidence_of(read_recording(run_file))
    names = [field.name for field in fields(GuardParameters)]
    guarding = GuardParameters(**dict.fromkeys(names, 1))  # type: ignore[arg-type] # any number will do
    told = guard_facts(
        replace(evidence, parameters=replace(evidence.parameters, guarding=guarding))
    )
    said = {name.replace(" ", "_") for name, _ in told}
    assert said == set(names) - {"reseats"}  # which is what every run of a device does


def test_a_run_in_real_time_shows_how_late_its_ticks_were(run_file: Path) -> None:
    recording = read_recording(run_file)
    assert "lateness" not in draw_timing(evidence_of(recording)).axes[0].get_xlabel()
    ticks = recording.ticks.copy()
    ticks["wake_ns"] = ticks["deadline_ns"] + 1000 * np.arange(len(ticks))
    late = Recording(**{**vars(recording), "ticks": ticks})
    histogram = draw_timing(evidence_of(late)).axes[0]
    counts = [bar.get_height() for bar in histogram.patches]  # type: ignore[attr-defined]
    assert sum(counts) == len(ticks)
    assert histogram.get_xlim()[1] > len(ticks) - 2


def test_a_page_says_how_many_deadlines_were_missed(run_file: Path, tmp_path: Path) -> None:
    path, device = tmp_path / "late.mcap", ScriptedDevice(report_runs.circling)
    recorded(path, "point_mass", device, duration=0.05, clock=SlowClock({20: 3, 30: 1}))
    for file, told in (
        (path, "0.050 s, 46 ticks, deadlines missed: 4, at 2 of them"),
        (run_file, "0.201 s, 201 ticks, in simulated time"),
    ):
        recording, report = read_recording(file), audit(file)
        assert dict(head_facts(report, evidence_of(recording)))["ran"] == told
        live = replace(recording, meta=recording.meta | {"clock": "monotonic"})
        ran = dict(head_facts(report, evidence_of(live)))["ran"]
        assert ("no deadline missed" in ran) is (file == run_file)


def test_what_stopped_a_run_is_listed_after_any_number_of_inputs() -> None:
    inputs = [{"event": "input", "tick": i, "time_ns": i} for i in range(2 * MOST_INPUTS)]
    trip = {"event": "trip", "tick": 400, "time_ns": 400_000_000, "reason": "it jumped"}
    rows = event_rows([{"event": "start", "tick": 0, "time_ns": 0}, *inputs, trip])
    assert [row[0] for row in rows] == ["start", *["input"] * MOST_INPUTS, "trip"]
    assert rows[-1] == ("trip", "400", "0.400 s", "reason it jumped")
    others = [{"event": "resume", "tick": i} for i in range(2 * MOST_EVENTS)]
    assert len(event_rows([*inputs, *others])) == MOST_EVENTS


@pytest.mark.parametrize(
    ("run", "port", "lead"),
    [
        (report_runs.active_by_method, "environment", "Not safe: the scene gave out up to "),
        (report_runs.active_by_rate, "device", "Not safe: the device was given up to "),
    ],
)
def test_the_page_says_first_how_much_when_where_why_and_what_to_change(
    run: Callable[[Path], Path], port: str, lead: str, made: Made, tmp_path: Path
) -> None:
    recording, report = made(run)
    evidence, page = evidence_of(recording), tmp_path / "page.html"
    energy, allowed = evidence.judged(report)
    worst = int(np.argmax(energy - allowed))
    cause = likely_cause(evidence, report)
    write_report(recording, report, page)
    text = html.unescape(page.read_text(encoding="utf-8"))
    first = text[text.index("<section") : text.index("</section>")]
    most = format_si(float((energy - allowed)[worst]), "J")
    assert cause is not None
    assert report.tick is not None
    for told in (
        f"{lead}{most} ",
        f"from {1e-3 * (report.tick + 1):.3f} s on (tick {report.tick})",
        f"most at {1e-3 * (worst + 1):.3f} s (tick {worst})",
        f"<td>{port}: ",
        f"{format_si(report.joules, 'J')} at first, {most} at most",
        f"<strong>{cause.kind}</strong>. ",
        cause.evidence[1:],
        cause.remedy[1:],
    ):
        assert told in first


def test_an_energy_is_drawn_in_the_unit_of_its_size(made: Made) -> None:
    for joules, unit in ((2.0, "J"), (-0.3, "mJ"), (4e-6, "µJ"), (5e-9, "nJ"), (1e-20, "nJ")):
        size, name = energy_unit(np.array([0.0, joules]), np.zeros(2))
        assert name == unit
        assert abs(joules / size) < 1000
    recording, _ = made(report_runs.active_by_rate)
    evidence = evidence_of(recording)
    tiny = replace(evidence, created=1e-20 * evidence.created, allowed=0 * evidence.allowed)
    low, high = draw_energies(tiny).axes[1].get_ylim()
    assert high - low >= LEAST_SPAN  # rounding does not fill the panel


@pytest.mark.parametrize("name", ["page.mcap", "page.pdf", "page", "nowhere/page.html"])
def test_a_page_replaces_no_recording_and_no_picture(
    name: str, call: Called, run_file: Path, tmp_path: Path
) -> None:
    target = tmp_path / name
    if target.parent.exists():
        target.write_bytes(b"what was there")
    code, out, err = call("audit", run_file, "--report", target)
    assert (code, out) == (2, "")  # before anything is computed
    assert str(target) in err
    with pytest.raises(RecordingError, match="page"):
        write_report(read_recording(run_file), audit(run_file), target)
    assert not target.exists() or target.read_bytes() == b"what was there"


@pytest.mark.skipif(sys.platform == "win32", reason="needs a limit on a file's size")
def test_a_page_and_a_picture_that_the_disk_does_not_take_leave_what_was_there(
    run_file: Path, tmp_path: Path
) -> None:
    import resource

    page, picture = tmp_path / "page.html", tmp_path / "run.svg"
    link = tmp_path / "link.html"
    link.symlink_to(page)
    for target in (page, picture):
        target.write_bytes(b"what was there")
    recording, report = read_recording(run_file), audit(run_file)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
    try:
        with pytest.raises(RecordingError, match="cannot write"):
            write_report(recording, report, link)
        with pytest.raises(HapticBridgeError, match="cannot write"):
            plot_recording(recording, picture)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert {page.read_bytes(), picture.read_bytes()} == {b"what was there"}
    assert sorted(tmp_path.iterdir()) == sorted((page, picture, link))
    write_report(recording, report, link)
    assert link.is_symlink()
    assert "verdict" in page.read_text(encoding="utf-8")


def test_a_passive_page_says_whether_the_device_bears_the_coupling(
    run_file: Path, tmp_path: Path
) -> None:
    page, report = tmp_path / "page.html", audit(run_file)
    told = {
        True: "The device bears this coupling, in any hand.",
        False: "The device does not bear this coupling",
        None: "It is not known if the device bears this coupling in any hand.",
    }
    for certified, words in told.items():
        judged = replace(report, certified=certified)
        assert words in notes(judged)[-1]
        assert is_warned(judged) is (certified is False)
    assert not notes(replace(report, verdict="active"))
    write_report(read_recording(run_file), replace(report, certified=False), page)
    assert told[False] in page.read_text(encoding="utf-8")


def test_a_passive_run_that_the_guard_stopped_does_not_look_like_any_other(
    run_file: Path, tmp_path: Path
) -> None:
    page, report = tmp_path / "page.html", audit(run_file)
    stopped = replace(report, reason=f"{report.reason}; the guard tripped", events={"trip": 1})
    for judged, look in ((report, "passive"), (stopped, "warned")):
        write_report(read_recording(run_file), judged, page)
        text = page.read_text(encoding="utf-8")
        assert f'<section class="verdict {look}">' in text
        assert ("<p>The guard tripped.</p>" in text) is (judged is stopped)


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
