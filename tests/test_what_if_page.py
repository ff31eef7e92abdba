"""The page of a what-if: recorded and changed runs side by side, in one small file."""

from __future__ import annotations

import base64
import io
import re
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import report_runs
from audit_cases import ScriptedDevice, recorded
from chromium import browser
from cli_cases import Called
from PIL import Image
from report_runs import Made

from hapticbridge.errors import RecordingError
from hapticbridge.record import TICK_DTYPE
from hapticbridge.whatif import WhatIf, what_if, write_what_if


@pytest.fixture(scope="module")
def made_active(tmp_path_factory: pytest.TempPathFactory) -> WhatIf:
    """A passive run that another method makes active, prescribed and in a hand."""
    folder = tmp_path_factory.mktemp("page")
    path = folder / "run.mcap"
    device = ScriptedDevice(report_runs.circling)
    recorded(path, "point_mass", device, report_runs.LOOSE, duration=0.3)
    return what_if(path, {"method": "implicitfast", "stiffness": 2500})


def text_of(page: Path) -> str:
    return re.sub(r"<svg.*?</svg>", "[svg]", page.read_text(encoding="utf-8"), flags=re.DOTALL)


def test_the_page_shows_both_verdicts_and_why(made_active: WhatIf, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    write_what_if(made_active, page)
    text = text_of(page)
    assert [run.report.verdict for run in made_active.runs] == ["passive", "active", "active"]
    assert "what if method were implicitfast, stiffness were 2500 N/m" in text
    recorded_row = r"<td>stiffness</td><td><strong>2000 N/m</strong></td>"
    assert re.search(recorded_row + r"(<td><strong>2500 N/m</strong></td>){2}", text)
    for run in made_active.runs[1:]:
        assert f"<h2>The moment ({run.name})</h2>" in text
        assert str(run.report.tick) in text
    assert "<h2>The moment (recorded)</h2>" not in text
    assert text.count("Likely cause: <strong>method</strong>") == 2
    assert text.count("[svg]") == 3
    for note in made_active.notes:
        assert note[1:40] in text


@pytest.mark.filterwarnings("ignore:scene '.*fan.xml'")
def test_a_fault_of_a_changed_run_is_laid_to_the_geoms_that_touched_in_it(
    made: Made, tmp_path: Path
) -> None:
    """A body that is moved far away is the cause only where nobody knows what touched."""
    recording, _ = made(report_runs.active_beside_a_fan)
    with warnings.catch_warnings():  # of the scene the user was warned when it was recorded
        warnings.simplefilter("error")
        found = what_if(recording.path, {"stiffness": 2100})
    page = tmp_path / "page.html"
    write_what_if(found, page, scene=b"a picture")
    text = text_of(page)
    assert [run.report.verdict for run in found.runs] == ["active"] * 3
    assert text.count("Likely cause: <strong>contact setting</strong>") == 3
    assert text.count("while geom 0 touched geom") == 3
    assert "As recorded, at the moment of the fault" in text


def test_a_long_what_if_has_a_page_of_less_than_a_megabyte(
    made_active: WhatIf, tmp_path: Path
) -> None:
    """Noise is the worst to decimate; with 25 times as many ticks as points, more add nothing."""
    noise = np.random.default_rng(1)
    ticks = np.zeros(20_000, TICK_DTYPE)
    ticks["tick"] = np.arange(len(ticks))
    for name in ("handle_position", "wrench_on_device", "environment_energy", "device_energy"):
        ticks[name] = noise.normal(size=ticks[name].shape)
    runs = tuple(replace(r, recording=replace(r.recording, ticks=ticks)) for r in made_active.runs)
    page = tmp_path / "page.html"
    write_what_if(replace(made_active, runs=runs), page, scene=b"x" * 100_000)
    assert page.stat().st_size < 1_000_000
    assert "Side by side" in text_of(page)


def test_numbers_that_cannot_be_drawn_leave_the_table(made_active: WhatIf, tmp_path: Path) -> None:
    run = made_active.runs[2]
    ticks = run.ticks.copy()
    ticks["environment_energy"][5] = 1e12
    broken = replace(run, recording=replace(run.recording, ticks=ticks))
    page = tmp_path / "page.html"
    write_what_if(replace(made_active, runs=(*made_active.runs[:2], broken)), page)
    text = text_of(page)
    assert "Side by side" not in text
    assert "<td>verdict</td><td>passive (strict)</td><td>active (environment)</td>" in text


def test_a_page_goes_under_the_name_of_a_page_alone(made_active: WhatIf, tmp_path: Path) -> None:
    before = made_active.path.read_bytes()
    with pytest.raises(RecordingError, match="must end in"):
        write_what_if(made_active, made_active.path)
    assert made_active.path.read_bytes() == before
    (tmp_path / "folder.html").mkdir()
    with pytest.raises(RecordingError, match="cannot write"):
        write_what_if(made_active, tmp_path / "folder.html")


def test_a_browser_shows_it_without_a_request_or_a_complaint(
    made_active: WhatIf, tmp_path: Path
) -> None:
    page, picture = tmp_path / "page.html", io.BytesIO()
    Image.new("RGB", (64, 40)).save(picture, "png")
    write_what_if(made_active, page, picture.getvalue())
    with browser(tmp_path) as tab:
        shown = tab()
        shown.open(page.as_uri())
        assert "what if method were implicitfast" in shown.value("document.title") + shown.value(
            "document.querySelector('h1').innerText"
        )
        assert shown.value("document.documentElement.scrollWidth <= innerWidth")
        assert shown.value("document.querySelector('img').naturalWidth") == 64
        assert [each for each in shown.requests if not each.startswith("data:")] == [page.as_uri()]
        assert shown.complaints == []


def test_the_command_writes_the_page_and_judges_strictly(
    made_active: WhatIf, tmp_path: Path, call: Called, monkeypatch: pytest.MonkeyPatch
) -> None:
    # drawn for pages of one run, too, and tested there
    monkeypatch.setattr("hapticbridge.cli.audit.still", lambda *_: b"a picture")
    page = tmp_path / "page.html"
    change = ("--what-if", "method=explicit", "--what-if", "stiffness=9000")
    code, out, err = call("audit", made_active.path, *change, "--report", page, "--strict")
    assert code == 1
    assert "active" in out.split("peak")[0]  # within the slack, if it were not for --strict
    assert f"wrote {page}" in " ".join(err.split())
    text = text_of(page)
    assert "The device does not bear the changed coupling" in text
    assert f"data:image/png;base64,{base64.b64encode(b'a picture').decode()}" in text
    assert "As recorded, when the force was largest" in text
