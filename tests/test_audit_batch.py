"""Many recordings: found in folders, judged in parallel, one table, the worst first."""

from __future__ import annotations

import csv
import importlib
import json
import os
import re
import sys
from pathlib import Path
from shutil import copyfile
from typing import Any

import numpy as np
import pytest
from audit_cases import recorded, rewritten, tapped
from cli_cases import Called

from hapticbridge.audit import AuditReport, audit
from hapticbridge.audit.batch import (
    audit_all,
    check_table_name,
    find_recordings,
    reports_of,
    worst_exit_code,
)
from hapticbridge.coupling import Coupling
from hapticbridge.errors import RecordingError, StudyError
from hapticbridge.files import install_command
from hapticbridge.recording import read_recording

# their packages hold functions of these names
batch = importlib.import_module("hapticbridge.audit.batch")
WEAK = Coupling(1000, 0.9, 1, 9e-4)
STIFF = Coupling(6000, 0.5, 1, 9e-4)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tree of recordings of every kind: certified or not, cut, changed, foreign."""
    folder = tmp_path_factory.mktemp("runs")
    deep = folder / "a" / "b"
    deep.mkdir(parents=True)
    recorded(deep / "weak.mcap", "point_mass", coupling=WEAK, duration=1.5)
    recorded(folder / "stiff.mcap", "point_mass", coupling=STIFF, duration=0.1)
    tapped(folder / "a", "tap.mcap")
    recording = read_recording(folder / "a" / "tap.mcap")
    rows = recording.ticks.copy()
    rows["kinetic"][50] *= 1.1
    rewritten(recording, folder / "a" / "changed.mcap", ticks=rows)
    whole = (deep / "weak.mcap").read_bytes()
    (folder / "cut.mcap").write_bytes(whole[: int(0.9 * len(whole))])
    (folder / "foreign.mcap").write_bytes(b"\x89MCAP0\r\n" + b"nothing")
    (folder / "notes.txt").write_text("not looked at")
    return folder


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such names")
def test_a_name_that_is_no_utf_8_is_named_as_what_no_table_takes(runs: Path) -> None:
    named = Path(os.fsdecode(b"gr\xf6\xdfe.mcap"))
    with pytest.raises(RecordingError, match=r"in no table: a table needs a name in UTF-8"):
        audit_all([runs / "stiff.mcap", named])


def test_a_folder_is_searched_through_and_patterns_are_understood(runs: Path) -> None:
    names = [path.relative_to(runs).as_posix() for path in find_recordings([runs])]
    assert names == [
        "a/b/weak.mcap",
        "a/changed.mcap",
        "a/tap.mcap",
        "cut.mcap",
        "foreign.mcap",
        "stiff.mcap",
    ]
    pattern = find_recordings([f"{runs}/**/t*.mcap"])
    assert [path.name for path in pattern] == ["tap.mcap"]
    assert find_recordings([runs / "stiff.mcap", runs]) == find_recordings(
        [runs / "stiff.mcap", *find_recordings([runs])[:5]]
    )  # each once
    missing = runs / "missing.mcap"
    assert find_recordings([missing]) == [missing]  # the audit says that it is not there


def test_a_word_that_names_no_recording_is_refused(runs: Path, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"no recording .* in the folder"):
        find_recordings([tmp_path])
    with pytest.raises(RecordingError, match="no recording matches"):
        find_recordings([f"{runs}/x*.mcap"])
    with pytest.raises(RecordingError, match=r"/\*\*x' is not a valid pattern"):
        find_recordings([f"{runs}/**x"])


def test_links_lead_to_files_and_in_no_circle(runs: Path, tmp_path: Path) -> None:
    for name in ("one", "two"):  # two circles: 2^40 ways for who follows them
        (tmp_path / name).symlink_to(tmp_path, target_is_directory=True)
    (tmp_path / "day 1").mkdir()
    for name in ("day 1/b.mcap", "day 1/C.MCAP"):
        copyfile(runs / "stiff.mcap", tmp_path / name)
    (tmp_path / "a.mcap").symlink_to(tmp_path / "day 1" / "b.mcap")
    (tmp_path / "gone.mcap").symlink_to(tmp_path / "nowhere")
    (tmp_path / "folder.mcap").mkdir()
    names = [path.relative_to(tmp_path).as_posix() for path in find_recordings([tmp_path])]
    assert names == ["day 1/C.MCAP", "day 1/b.mcap", "gone.mcap"]
    assert find_recordings([f"{tmp_path}/**/b*"]) == [tmp_path / "day 1" / "b.mcap"]
    # a folder that fits a pattern stands for what is in it
    names = [path.name for path in find_recordings([f"{tmp_path}/day*"])]
    assert names == ["C.MCAP", "b.mcap"]
    table = audit_all(find_recordings([tmp_path]), workers=1)
    assert table.texts("verdict")[0] == "unreadable"
    assert "gone.mcap: No such file" in table.texts("reason")[0]


def test_the_margin_is_the_least_share_left() -> None:
    report = AuditReport(Path("a"), "passive", "within slack", "", slack_share=0.25)
    assert report.margin == 0.75
    for margin, verdict, expected in (
        (0.9, "passive", 0.75),
        (0.15, "passive", 0.15),
        (-0.5, "passive", -0.5),  # a device that lacks damping
        (0.15, "active", 0.0),  # never above, whatever is left
        (-0.5, "active", -0.5),
    ):
        values: dict[str, Any] = {"damping_margin": margin, "verdict": verdict}
        assert AuditReport(**{**vars_of(report), **values}).margin == pytest.approx(expected)
    assert np.isnan(AuditReport(Path("a"), "invalid", None, "").margin)


def vars_of(report: AuditReport) -> dict[str, Any]:
    return {name: getattr(report, name) for name in AuditReport.__dataclass_fields__}


def test_the_damping_margin_is_that_of_the_condition(runs: Path) -> None:
    # lossless adds K T/2 to what is used, so B' = 0.9 − 0.5: 1 − (0.5 + 0.4)/2
    assert audit(runs / "a/b/weak.mcap").margin == pytest.approx(0.55)
    # B' = 0 of 0.5 − 3: 1 − 3/2
    assert audit(runs / "stiff.mcap").margin == pytest.approx(-0.5)


def test_the_table_is_sorted_by_margin_and_hides_nothing(runs: Path) -> None:
    table = audit_all(find_recordings([runs]), workers=1)
    names = [Path(file).name for file in table.texts("file")]
    assert names[:3] == ["foreign.mcap", "changed.mcap", "stiff.mcap"]
    assert sorted(names[3:]) == ["cut.mcap", "tap.mcap", "weak.mcap"]
    margins = table.numbers("margin")[2:]
    assert (np.diff(margins) >= 0).all()
    assert list(table.texts("verdict")[:3]) == ["unreadable", "invalid", "passive"]
    assert list(table.numbers("exit_code")[:4]) == [2, 1, 1, 0]
    assert worst_exit_code(table) == 2
    assert table.numbers("is_cut")[names.index("cut.mcap")] == 1
    assert "is not a recording" in table.texts("reason")[0] or "MCAP" in table.texts("reason")[0]
    for report in reports_of(table):
        alone = json.loads(audit(str(report["path"])).to_json())
        assert report == alone


def test_a_worker_that_fails_is_a_row_and_no_end(
    runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(path: str, **options: Any) -> AuditReport:
        if "tap" in path:
            raise MemoryError("too large")
        return audit(path, **options)

    monkeypatch.setattr(batch, "audit", broken)
    table = audit_all([runs / "a" / "tap.mcap", runs / "stiff.mcap"], workers=1)
    assert list(table.texts("verdict")) == ["unreadable", "passive"]
    assert "too large" in table.texts("reason")[0]
    assert worst_exit_code(table) == 2


def test_the_command_prints_a_line_each_and_the_worst_exit_code(
    runs: Path, call: Called, tmp_path: Path
) -> None:
    target = tmp_path / "all.csv"
    code, out, err = call("audit", runs, "--table", target)
    assert (code, f"wrote {target}" in err) == (2, True)
    assert "(cut)" in next(line for line in out.splitlines() if "cut.mcap" in line)
    assert "6 recordings: 4 passive, 1 invalid, 1 unreadable" in out
    with target.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 6
    assert rows[2]["verdict"] == "passive"
    assert float(rows[2]["margin"]) == pytest.approx(-0.5)
    code, out, err = call("audit", runs, "--json", "--jobs", 1)
    assert (code, len(json.loads(out)), err.count("error:")) == (2, 5, 1)


def test_a_table_that_cannot_be_written_is_refused_before_anything_is_audited(
    runs: Path, call: Called, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*_: object, **__: object) -> None:
        raise AssertionError("audited")

    monkeypatch.setattr("hapticbridge.cli.audit.audit_all", never)
    for name in ("table.xls", "no/table.csv"):
        code, _, err = call("audit", runs, "--table", runs / name)
        assert (code, err.count("error:")) == (2, 1)
    found = importlib.import_module

    def without(name: str) -> Any:
        if name == "pyarrow":
            raise ImportError(name)
        return found(name)

    monkeypatch.setattr(importlib, "import_module", without)
    with pytest.raises(StudyError, match=re.escape(install_command("tables"))):
        check_table_name(runs / "table.parquet")
    check_table_name(runs / "table.json")
