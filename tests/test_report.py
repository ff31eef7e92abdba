"""The page of a run: its verdict and cause, its size, and how a browser takes it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import report_runs
from audit_cases import rewritten
from chromium import browser

from hapticbridge.audit import AuditReport, audit
from hapticbridge.recording import Recording, read_recording
from hapticbridge.report import write_report
from hapticbridge.report.cause import likely_cause
from hapticbridge.report.evidence import Evidence
from hapticbridge.report.panels import ACTIVITIES, BINS, draw_energies, draw_motion, draw_timing
from hapticbridge.tick import TickFlag

pytestmark = pytest.mark.filterwarnings("ignore:scene '.*floor.xml'")

Made = Callable[[Callable[[Path], Path]], tuple[Recording, AuditReport]]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """Makes a golden recording once, and judges it."""
    folder, kept = tmp_path_factory.mktemp("golden"), {}

    def make(run: Callable[[Path], Path]) -> tuple[Recording, AuditReport]:
        if run not in kept:
            path = run(folder)
            kept[run] = read_recording(path), audit(path)
        return kept[run]

    return make


@pytest.mark.parametrize(
    ("run", "port", "kind", "told"),
    [
        (report_runs.active_by_method, "environment", "method", "implicitfast"),
        (report_runs.active_by_contact, "environment", "contact setting", 'solref "-20000 -50"'),
        (report_runs.active_by_rate, "device", "rate", "at 2500 Hz translation would hold"),
        (report_runs.active_by_delay, "device", "delay", "2 ticks old"),
        (report_runs.active_by_quantisation, "device", "quantisation", "0.45 N"),
    ],
)
def test_a_run_is_active_for_the_cause_that_it_was_made_for(
    run: Callable[[Path], Path], port: str, kind: str, told: str, made: Made, tmp_path: Path
) -> None:
    recording, report = made(run)
    assert (report.verdict, report.port) == ("active", port)
    evidence = Evidence.of(recording)
    assert evidence is not None
    cause = likely_cause(evidence, report)
    assert cause is not None
    assert cause.kind == kind
    assert told in cause.evidence
    page = tmp_path / "page.html"
    write_report(recording, report, page)
    text = page.read_text(encoding="utf-8")
    assert f"Likely cause: <strong>{kind}</strong>" in text
    assert f"<td>{report.tick}, at {report.tick * 1e-3:.3f} s</td>" in text  # type: ignore[operator]
    assert f"{1e3 * report.joules:.3g} mJ" in text


def test_the_same_run_without_its_cause_is_given_another_one(made: Made, tmp_path: Path) -> None:
    # the device of the coarse encoder, with enough friction to hold still between its steps
    recording, report = made(report_runs.active_by_quantisation)
    sheet = recording.meta["device"].replace('"friction": 0.0', '"friction": 0.5')
    assert sheet != recording.meta["device"]
    changed = rewritten(recording, tmp_path / "rubbed.mcap", meta={"device": sheet})
    evidence = Evidence.of(read_recording(changed))
    assert evidence is not None
    cause = likely_cause(evidence, report)
    assert cause is not None
    assert cause.kind == "rate"


def test_a_passive_run_has_no_moment_and_no_cause(run_file: Path, tmp_path: Path) -> None:
    recording, report = read_recording(run_file), audit(run_file)
    evidence = Evidence.of(recording)
    assert evidence is not None
    assert likely_cause(evidence, report) is None
    page = tmp_path / "page.html"
    write_report(recording, report, page)
    assert "The moment" not in page.read_text(encoding="utf-8")


def test_the_bound_is_drawn_beside_what_was_created(made: Made) -> None:
    recording, report = made(report_runs.active_by_method)
    evidence = Evidence.of(recording)
    assert evidence is not None
    lines = {line.get_label(): line for line in draw_energies(evidence).axes[1].get_lines()}
    created = np.asarray(lines["created by the environment"].get_ydata())
    allowed = np.asarray(lines["allowed at most"].get_ydata())
    above = int(np.argmax(created > allowed + 1e-6))
    assert above == report.tick
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
    evidence = Evidence.of(recording)
    assert evidence is not None
    line = draw_motion(evidence).axes[0].get_lines()[0]
    assert len(np.asarray(line.get_ydata())) <= 2 * BINS + 1
    assert np.asarray(line.get_ydata()).max() == 77.0
    write_report(recording, audit(run_file), page)
    assert 100_000 < page.stat().st_size < 1_000_000  # curves are of constant length


def test_what_was_at_work_is_drawn_when_it_was(run_file: Path) -> None:
    recording = read_recording(run_file)
    ticks = recording.ticks.copy()
    ticks["flags"] = 0
    ticks["flags"][40:60] = int(TickFlag.FORCE_LIMITED)
    evidence = Evidence.of(Recording(**{**vars(recording), "ticks": ticks}))
    assert evidence is not None
    row = [flag for flag, _ in ACTIVITIES].index(TickFlag.FORCE_LIMITED)
    bars = [b.get_paths() for b in draw_timing(evidence).axes[1].collections]
    assert [len(paths) for paths in bars] == [int(i == row) for i in range(len(ACTIVITIES))]
    extent = bars[row][0].get_extents()
    assert (extent.x0, extent.x1) == pytest.approx((0.040, 0.060), abs=1e-9)


def test_a_browser_shows_the_page_without_a_request_or_a_complaint(
    made: Made, tmp_path: Path
) -> None:
    page = tmp_path / "page.html"
    write_report(*made(report_runs.active_by_contact), page)
    with browser(tmp_path) as tab:
        shown = tab()
        shown.open(page.as_uri())
        assert shown.value("document.querySelector('h1').innerText").endswith("active (active)")
        assert shown.value("document.querySelectorAll('svg').length") == 4
        assert shown.value("document.documentElement.scrollWidth <= innerWidth")
        assert shown.requests == [page.as_uri()]
        assert shown.complaints == []
