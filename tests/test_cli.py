from __future__ import annotations

import json
import os
import re
import xml.etree.ElementTree as ET
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from audit_cases import TAP, recorded, rewritten, tapped

from hapticbridge import bridge as bridge_module
from hapticbridge.audit import audit
from hapticbridge.cli import main
from hapticbridge.errors import SafetyTrip
from hapticbridge.recording import Recording, read_recording, repair
from hapticbridge.report import draw_recording
from hapticbridge.scene import scene_names
from hapticbridge.scene.library import scene_path
from hapticbridge.tick import TICK_DTYPE

COMMANDS = ("run", "audit", "scenes", "check", "repair")

HINGED = """<mujoco>
  <option integrator="discrete" cone="elliptic"><flag diagexact="enable"/></option>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 0.1" solref="0.002 1" solimp="0.9 0.95 0.001"/>
    <body name="arm" pos="0 0 0.1">
      <joint name="shoulder" type="ball" damping="0.001"/>
      <geom type="capsule" fromto="0 0 0 0.1 0 0" size="0.01" mass="0.1" contype="0"/>
      <body name="finger" pos="0.1 0 0">
        <joint name="knuckle" axis="0 1 0" damping="0.001"/>
        <geom type="capsule" fromto="0 0 0 0.05 0 0" size="0.008" mass="0.05"/>
        <site name="tip" pos="0.05 0 0"/>
      </body>
    </body>
  </worldbody>
</mujoco>"""

PIN = """<mujoco>
  <option integrator="discrete" cone="elliptic"><flag diagexact="enable"/></option>
  <default><geom solref="0.002 1" solimp="0.9 0.95 0.001" friction="0.3"/></default>
  <worldbody>
    <body name="block" pos="0 0 -0.05">
      <geom type="box" size="0.05 0.05 0.02"/>
      <body name="pin" pos="0 0 0.03">
        <joint name="pin" type="slide" axis="0 0 1" stiffness="200" damping="0.5"/>
        <geom type="cylinder" size="0.005 0.01" mass="0.02" contype="2" conaffinity="2"/>
      </body>
    </body>
    <body name="tool" pos="0 0 0.0">
      <freejoint/>
      <geom type="sphere" size="0.008" mass="0.1" contype="3" conaffinity="3"/>
      <site name="held"/>
    </body>
  </worldbody>
</mujoco>"""

DRAWER = """<mujoco>
  <option integrator="discrete" cone="elliptic"><flag diagexact="enable"/></option>
  <worldbody>
    <body name="drawer">
      <joint name="rail" type="slide" axis="1 0 0" range="-0.005 0.3" limited="true"
        damping="2" solreflimit="0.002 1" solimplimit="0.9 0.95 0.001"/>
      <geom type="box" size="0.1 0.15 0.05" mass="1.5"/>
      <site name="knob" pos="0.12 0.05 0"/>
    </body>
  </worldbody>
</mujoco>"""


@pytest.fixture
def motion(tmp_path: Path) -> Path:
    path = tmp_path / "hand.csv"
    path.write_text(TAP)
    return path


@pytest.fixture(scope="module")
def run_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tapped(tmp_path_factory.mktemp("cli"), "run.mcap")


@pytest.fixture(scope="module")
def cut_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    whole = tmp_path_factory.mktemp("cut") / "long.mcap"
    recorded(whole, "virtual_wall", duration=1.5)
    cut = whole.with_name("a [b] cut.mcap")
    cut.write_bytes(whole.read_bytes()[: int(0.9 * whole.stat().st_size)])
    return cut


Called = Callable[..., tuple[int, str, str]]


@pytest.fixture
def call(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Called:
    """Calls the command line in this process; returns exit code, stdout and stderr."""
    monkeypatch.setenv("COLUMNS", "200")

    def called(*arguments: object) -> tuple[int, str, str]:
        capsys.readouterr()
        try:
            code = main([str(argument) for argument in arguments])
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 0
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return called


# --- the main job


@pytest.mark.parametrize("scene", scene_names())
def test_run_and_audit_of_a_shipped_scene_are_passive(
    scene: str, call: Called, tmp_path: Path
) -> None:
    path = tmp_path / "out.mcap"
    hand = scene_path(scene).with_suffix(".csv")
    command = ("run", scene, "--device", f"trajectory:{hand}", "--fast", "--duration", 8)
    code, out, err = call(*command, "--record", path)
    assert code == 0, err
    assert f"hapticbridge audit {path}" in out  # the next command to type
    code, out, _ = call("audit", path)
    assert code == 0
    contacts = read_recording(path).ticks["contacts"]
    assert (contacts > 0).any() == (scene != "point_mass")
    allowed = r"strict" if scene == "point_mass" else r"strict|within slack"
    assert re.search(rf"passive \(({allowed})\)", out)
    assert "bit for bit" in out


@pytest.mark.parametrize(
    ("text", "grip", "axis"), [(HINGED, "tip", 2), (PIN, "held", 2), (DRAWER, "knob", 0)]
)
def test_scenes_from_elsewhere_are_passive_too(
    text: str, grip: str, axis: int, call: Called, tmp_path: Path
) -> None:
    scene, hand, path = (tmp_path / name for name in ("scene.xml", "hand.csv", "out.mcap"))
    scene.write_text(text)
    rows = ["t,x,y,z"]
    for k in range(101):
        t = 0.02 * k
        position = [0.002 * np.sin(5 * t), 0.001 * np.sin(7 * t), 0.0]
        position[axis] = -0.012 * (1 - np.cos(np.pi * t)) / 2
        rows.append(",".join(f"{value:.9f}" for value in (t, *position)))
    hand.write_text("\n".join(rows))
    command = ("run", scene, "--grip", grip, "--device", f"trajectory:{hand}", "--fast")
    code, _, err = call(*command, "--record", path)
    assert code == 0, err
    report = audit(path)
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")
    assert np.ptp(read_recording(path).ticks["tool_position"][:, axis]) > 1e-3


def test_run_prints_the_summary_as_json(call: Called, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    command = ("run", "virtual_wall", "--fast", "--duration", 0.1, "--json", "--record", path)
    code, out, err = call(*command)
    assert (code, err) == (0, "")
    summary = json.loads(out)
    assert (summary["ticks"], summary["verdict"]) == (100, "passive")
    assert summary["recording"] == str(path)
    _, out, _ = call("run", "virtual_wall", "--fast", "--duration", 0.1, "--json")
    assert json.loads(out)["recording"] is None


def test_options_of_a_run_reach_the_recording(call: Called, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    options = {
        "--rate": 500,
        "--substeps": 2,
        "--stiffness": 700,
        "--damping": 0.25,
        "--rotational-stiffness": 0.7,
        "--rotational-damping": 0.0003,
        "--scale": 1.5,
        "--force-scale": 0.5,
        "--force-limit": 3,
        "--torque-limit": 0.2,
        "--ramp": 0.01,
    }
    flat = [part for pair in options.items() for part in pair]
    axes = ("--axes", 0, -1, 0, 1, 0, 0, 0, 0, 1)
    command = ("run", "point_mass", "--fast", "--duration", 0.1, *flat, *axes, "--record", path)
    code, _, err = call(*command)
    assert code == 0, err
    meta = read_recording(path).meta
    assert float(meta["period_s"]) == 0.002
    assert (meta["substeps"], meta["ramp_ticks"]) == ("2", "5")
    for name, value in options.items():
        key = name[2:].replace("-", "_")
        if key in meta and key != "ramp":
            assert float(meta[key]) == value
    assert json.loads(meta["axes"]) == [0, -1, 0, 1, 0, 0, 0, 0, 1]


def test_run_says_what_a_method_is_and_may_do(call: Called) -> None:
    command = ("run", "peg_in_hole", "--fast", "--duration", 0.1)
    code, out, err = call(*command, "--method", "direct", "--contact-stiffness", 5000)
    assert code == 0, err
    assert "a tool without mass" in out
    assert "geometry decides" in out
    assert "5000 N/m" in out
    assert "L <= 2 sqrt(b_theta / (T K_c))" in " ".join(err.split())
    assert "geometry decides" in " ".join(err.split()).split("warning:")[-1]  # before the run
    code, out, err = call(*command)
    assert code == 0, err
    assert "method" not in out + err


def test_run_tells_how_stiff_a_weld_truly_is(call: Called) -> None:
    command = ("run", "point_mass", "--fast", "--duration", 0.1, "--stiffness", 1000)
    _, out, err = call(*command, "--method", "weld")
    told = " ".join(out.split())
    assert "the weld is 2000 N/m" in " ".join(err.split())  # told before there is force
    assert "device damping" in " ".join(err.split())
    assert "the weld is 2000 N/m" in told, err  # 0.1 kg · 1000 / (1 − 0.95)
    assert "asked for: 1000" in told


def test_default_stiffness_changes_with_what_the_user_gives_only(
    call: Called, tmp_path: Path
) -> None:
    path = tmp_path / "run.mcap"
    call("run", "point_mass", "--fast", "--duration", 0.01, "--stiffness", 900, "--record", path)
    meta = read_recording(path).meta
    assert float(meta["stiffness"]) == 900
    assert float(meta["damping"]) == pytest.approx(0.5)
    assert float(meta["rotational_stiffness"]) == pytest.approx(2.4)


# --- exit codes


def test_coupling_above_the_device_bound_is_exit_code_1_with_a_warning(
    call: Called, tmp_path: Path
) -> None:
    path = tmp_path / "run.mcap"
    command = ("run", "point_mass", "--fast", "--duration", 0.05, "--stiffness", 5000)
    code, out, err = call(*command, "--record", path)
    assert code == 1
    assert "warning" in err and "3 N s/m" in err
    assert "not certified" in out
    code, out, _ = call("audit", path)
    assert code == 1
    assert "passive" in out and "2 < 3 N s/m" in out


def test_trip_is_exit_code_3(call: Called, monkeypatch: pytest.MonkeyPatch) -> None:
    def trip(*_: Any, **__: Any) -> None:
        raise SafetyTrip("tick 7: [/b] the device's pose is not finite", np.zeros(0, TICK_DTYPE))

    monkeypatch.setattr(bridge_module.Bridge, "run", trip)
    code, _, err = call("run", "point_mass", "--fast")
    assert code == 3
    assert "safety trip: tick 7: [/b]" in err


def test_active_and_invalid_recordings_are_exit_code_1(
    call: Called, run_file: Path, tmp_path: Path
) -> None:
    recording = read_recording(run_file)
    ticks = recording.ticks.copy()
    ticks["kinetic"][50] *= 1.1
    other = rewritten(recording, tmp_path / "other.mcap", ticks=ticks)
    code, out, _ = call("audit", other)
    assert code == 1
    assert "invalid" in out and "tick 50" in out
    code, out, _ = call("audit", run_file, other, "--json")
    assert code == 1
    reports = json.loads(out)
    assert [report["verdict"] for report in reports] == ["passive", "invalid"]
    assert reports[1]["tick"] == 50


def test_strict_is_passed_on(call: Called, run_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []

    def judged(path: Path, *, strict: bool) -> Any:
        seen.append(strict)
        return audit(path, strict=strict)

    monkeypatch.setattr("hapticbridge.cli.judge.audit", judged)
    call("audit", run_file, "--strict")
    call("audit", run_file)
    assert seen == [True, False]


def test_one_unreadable_file_does_not_hide_the_verdict_of_the_others(
    call: Called, run_file: Path, tmp_path: Path
) -> None:
    code, out, err = call("audit", tmp_path / "missing.mcap", run_file)
    assert code == 2
    assert f"{run_file}: passive" in out
    assert err.count("error:") == 1
    code, out, _ = call("audit", tmp_path / "missing.mcap", run_file, "--json")
    assert code == 2
    assert [report["verdict"] for report in json.loads(out)] == ["passive"]


def test_cut_file_is_called_cut_and_repaired(
    call: Called, run_file: Path, cut_file: Path, tmp_path: Path
) -> None:
    cut, mended = cut_file, tmp_path / "mended.mcap"
    code, out, _ = call("audit", cut)
    assert code == 0
    assert "the file is cut" in out
    assert f"hapticbridge repair '{cut}' OUTPUT" in out
    assert call("repair", cut, mended)[0] == 0
    code, out, _ = call("audit", mended)
    assert code == 0
    assert "repaired (1)" in out
    code, _, err = call("repair", cut, mended)
    assert code == 2
    assert "mended.mcap" in err
    code, _, err = call("repair", run_file, tmp_path / "new.mcap")
    assert code == 2
    assert "not cut" in err


# --- bad input

BAD_RUNS: list[tuple[tuple[object, ...], str]] = [
    (("nowhere",), "'peg_in_hole'"),
    (("point_mass", "--device", "nothing"), "'simulated'"),
    (("point_mass", "--device", "trajectory:missing.csv"), "missing.csv"),
    (("point_mass", "--device", "simulated:frction=1"), "'friction'"),
    (("point_mass", "--method", "magic"), "'implicit'"),
    (("point_mass", "--grip", "handle_of_door"), "'grip'"),
    (("point_mass", "--rate", 0), "rate"),
    (("point_mass", "--rate", "nan"), "rate"),
    (("point_mass", "--rate", -5), "rate"),
    (("point_mass", "--rate", "inf"), "rate"),
    (("point_mass", "--rate", 1e300), "rate"),
    (("point_mass", "--rate", 1e-12), "rate"),
    (("point_mass", "--duration", "nan"), "duration"),
    (("point_mass", "--duration", 0), "duration"),
    (("point_mass", "--duration", -1), "duration"),
    (("point_mass", "--stiffness", -5), "stiffness"),
    (("point_mass", "--stiffness", 0), "stiffness"),
    (("point_mass", "--stiffness", "nan"), "stiffness"),
    (("point_mass", "--damping", -1), "damping"),
    (("point_mass", "--rotational-stiffness", -1), "rotational_stiffness"),
    (("point_mass", "--axes", 1, 0, 0, 0, 1, 0, 0, 0, 2), "axes"),
    (("point_mass", "--axes", 1, 0, 0, 0, 1, 0, 0, 0, -1), "axes"),
    (("point_mass", "--force-limit", 0), "force limit"),
    (("point_mass", "--torque-limit", "nan"), "torque limit"),
    (("point_mass", "--substeps", 0), "substeps"),
    (("point_mass", "--scale", 0), "scale"),
    (("point_mass", "--scale", -1), "scale"),
    (("point_mass", "--force-scale", 0), "force_scale"),
    (("point_mass", "--ramp", -1), "ramp"),
    (("point_mass", "--ramp", 1e300), "ramp"),
    (("point_mass", "--record", "no/such/folder/run.mcap"), "folder"),
]


def one_sentence(err: str) -> str:
    """Returns the error's line, after holding it against what an error may look like."""
    assert "Traceback" not in err
    lines = [line for line in err.splitlines() if line.startswith("error:")]
    assert len(lines) == 1, err
    return lines[0]


@pytest.mark.parametrize(("arguments", "message"), BAD_RUNS)
def test_bad_run_is_refused_in_one_sentence(
    arguments: tuple[object, ...],
    message: str,
    call: Called,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    duration = () if "--duration" in arguments else ("--duration", 0.01)
    code, out, err = call("run", *arguments, "--fast", *duration)
    assert (code, out) == (2, "")
    assert message in one_sentence(err)
    assert not list(tmp_path.iterdir())


def test_existing_recording_is_kept_unless_overwriting_is_asked_for(
    call: Called, tmp_path: Path
) -> None:
    path = tmp_path / "run.mcap"
    path.write_text("precious")
    command = ("run", "point_mass", "--fast", "--duration", 0.01, "--record", path)
    code, _, err = call(*command)
    assert code == 2
    assert "--overwrite" in one_sentence(err)
    assert path.read_text() == "precious"
    assert call(*command, "--duration", "nan", "--overwrite")[0] == 2
    assert path.read_text() == "precious"
    assert call(*command, "--overwrite")[0] == 0
    assert audit(path).verdict == "passive"


@pytest.mark.parametrize("kind", ["folder", "empty", "text", "missing"])
def test_what_is_no_recording_is_refused_in_one_sentence(
    kind: str, call: Called, tmp_path: Path
) -> None:
    path = tmp_path / "[red]what.mcap"
    if kind == "folder":
        path.mkdir()
    elif kind != "missing":
        path.write_text("" if kind == "empty" else "hello")
    for command in (("audit", path), ("repair", path, tmp_path / "out.mcap")):
        code, out, err = call(*command)
        assert (code, out) == (2, "")
        assert "[red]what.mcap" in one_sentence(err)


def test_file_without_permission_is_refused(
    call: Called, run_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(self: Path) -> bytes:
        raise PermissionError(13, os.strerror(13))

    monkeypatch.setattr(Path, "read_bytes", refuse)  # root may read everything
    code, _, err = call("audit", run_file)
    assert code == 2
    assert "Permission denied" in one_sentence(err)


@pytest.mark.parametrize("name", ["x.foo", "x", "no/x.png", "folder", "x.png/"])
def test_picture_with_a_bad_name_is_refused(
    name: str, call: Called, run_file: Path, tmp_path: Path
) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "x.png").mkdir()
    code, _, err = call("audit", run_file, "--plot", f"{tmp_path}/{name}")
    assert code == 2
    one_sentence(err)


def test_report_into_a_missing_folder_is_refused(
    call: Called, run_file: Path, tmp_path: Path
) -> None:
    code, _, err = call("audit", run_file, "--report", tmp_path / "no" / "x.html")
    assert code == 2
    assert "x.html" in one_sentence(err)


def test_picture_of_several_recordings_is_refused(call: Called, run_file: Path) -> None:
    code, _, err = call("audit", run_file, run_file, "--plot", "x.png")
    assert code == 2
    assert "one recording" in one_sentence(err)


@pytest.mark.parametrize(
    "arguments",
    [(), ("frobnicate",), ("run",), ("run", "point_mass", "--bogus"), ("audit", "x", "--bogus")],
)
def test_wrong_usage_is_exit_code_2_without_a_traceback(
    arguments: tuple[str, ...], call: Called
) -> None:
    code, out, err = call(*arguments)
    assert (code, out) == (2, "")
    assert err and "Traceback" not in err


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_with_an_example(command: str, call: Called) -> None:
    code, out, _ = call(command, "--help")
    assert code == 0
    assert f"hapticbridge {command}" in out.split("usage:")[1].partition("\n")[2]
    assert "{None}" not in out


def test_scenes_are_listed_with_what_they_are(call: Called) -> None:
    code, out, _ = call("scenes")
    assert code == 0
    for name in scene_names():
        assert re.search(rf"{name} +[1-9] +\d+ +\S", out)


def test_calling_the_command_line_leaves_warnings_as_they_were(call: Called) -> None:
    import warnings

    before = warnings.showwarning
    call("scenes")
    assert warnings.showwarning is before


# --- hostile text, pictures and pages

HOSTILE = "--><script>alert('x')</script>[/b] ${y} $\\frac$ & \x1b[31m"


@pytest.fixture
def hostile(tmp_path: Path, run_file: Path) -> Recording:
    recording = read_recording(run_file)
    meta = dict.fromkeys(("scene", "started", "clock"), HOSTILE)
    meta["versions"] = json.dumps({"mujoco": HOSTILE})
    event = {"event": HOSTILE, "reason": HOSTILE, "tick": HOSTILE, "time_ns": 0}
    path = rewritten(
        recording, tmp_path / "hostile.mcap", meta=meta, events=[*recording.events, event]
    )
    return read_recording(path)


class Page(HTMLParser):
    """Gathers what a page would run or fetch, and whether its tags match."""

    VOID = ("meta", "br", "hr", "img", "link", "input")

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.scripts = 0
        self.fetched: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in self.VOID:
            self.open.append(tag)
        self.note(tag, attrs)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.note(tag, attrs)

    def note(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.scripts += tag in ("script", "iframe", "object", "embed")
        for name, value in attrs:
            self.scripts += name.startswith("on")
            if name in ("src", "href", "xlink:href", "data") and not (value or "").startswith("#"):
                self.fetched.append(value or "")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def test_page_is_whole_fetches_nothing_and_runs_nothing(
    hostile: Recording, call: Called, tmp_path: Path
) -> None:
    target = tmp_path / "page.html"
    picture_file = tmp_path / "picture.svg"
    code, out, _ = call("audit", hostile.path, "--report", target, "--plot", picture_file)
    assert code == 0
    assert "<script>alert('x')</script>[/b] ${y}" in out  # printed, not taken as markup
    assert "\x1b" not in out
    text = target.read_text(encoding="utf-8")
    page = Page()
    page.feed(text)
    page.close()
    assert not page.open
    assert not page.scripts
    assert not page.fetched
    assert "url(http" not in text and "@import" not in text
    assert "alert('x')" in page.text
    for told in ("passive", "2400.0 N/m", "unknown", "not re-simulated"):
        assert told in page.text
    picture = text[text.index("<svg") : text.index("</svg>") + 6]
    ET.fromstring(picture)
    assert "purl.org" not in picture  # matplotlib's own metadata


@pytest.mark.parametrize("ending", ["PNG", "svg", "pdf"])
def test_picture_is_written_in_the_format_of_its_ending(
    ending: str, call: Called, run_file: Path, tmp_path: Path
) -> None:
    target = tmp_path / f"picture.{ending}"
    code, _, err = call("audit", run_file, "--plot", target)
    assert code == 0
    assert f"wrote {target}" in err
    magic = {"png": b"\x89PNG", "svg": b"<?xml", "pdf": b"%PDF"}[ending.lower()]
    assert target.read_bytes().startswith(magic)


def test_curves_keep_every_peak_of_a_long_run(run_file: Path) -> None:
    recording = read_recording(run_file)
    count = 20_000
    ticks = np.zeros(count, recording.ticks.dtype)
    ticks["tick"] = np.arange(count)
    ticks["wrench_on_tool"][12_345, 0] = 7.0
    ticks["wrench_on_tool"][777, 0] = -3.0
    figure = draw_recording(Recording(**{**vars(recording), "ticks": ticks}))
    force, position, energy = figure.axes
    line = force.get_lines()[0]
    values = np.asarray(line.get_ydata())
    assert len(values) < 5000
    assert (values.max(), values.min()) == (7.0, -3.0)
    assert np.asarray(line.get_xdata())[values.argmax()] == pytest.approx(12.345)
    for axes, unit in ((force, "(N)"), (position, "(mm)"), (energy, "(mJ)")):
        assert unit in axes.get_ylabel()


@pytest.mark.parametrize("change", ["nothing", "no tick", "no period", "huge", "bad device"])
def test_page_of_an_invalid_recording_is_written_all_the_same(
    change: str, call: Called, run_file: Path, tmp_path: Path
) -> None:
    recording = read_recording(run_file)
    ticks, meta = recording.ticks.copy(), {}
    if change == "no tick":
        ticks = ticks[:0]
    elif change == "no period":
        meta = {"period_s": "0"}
    elif change == "huge":
        ticks["kinetic"][5] = 1e300
    elif change == "bad device":
        meta = {"device": "[1, 2", "versions": "3"}
    path = rewritten(recording, tmp_path / "bad.mcap", ticks=ticks, meta=meta)
    target = tmp_path / "page.html"
    code, _, err = call("audit", path, "--report", target)
    assert code == (0 if change == "nothing" else 1), err
    text = target.read_text(encoding="utf-8")
    assert ("passive" if change == "nothing" else "invalid") in text
    assert ("<svg" in text) == (change in ("nothing", "bad device"))


def test_repair_is_what_the_library_does(cut_file: Path, tmp_path: Path) -> None:
    assert main(["repair", str(cut_file), str(tmp_path / "a.mcap")]) == 0
    repair(cut_file, tmp_path / "b.mcap")
    a, b = (read_recording(tmp_path / name).computed_digest for name in ("a.mcap", "b.mcap"))
    assert a == b


def test_a_diverging_scene_trips_and_leaves_no_log_beside_the_user(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("wild.xml").write_text(
        """<mujoco>
          <worldbody>
            <body><freejoint/><geom size=".02" mass=".05"/><site name="grip"/></body>
            <body pos="1 0 0"><joint name="j" type="slide"/><geom size=".01" mass="1"/></body>
          </worldbody>
          <actuator>
            <general joint="j" biastype="affine" gainprm="0" biasprm="1 1e8 0"/>
          </actuator>
        </mujoco>""",
        encoding="utf-8",
    )
    assert main(["run", "wild.xml", "--fast", "--duration", "0.1"]) == 3
    told = capsys.readouterr().err
    assert "safety trip" in told
    assert not list(tmp_path.glob("*LOG*"))


def test_version_names_the_package_and_mujoco(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert f"MuJoCo {mujoco.mj_versionString()}" in capsys.readouterr().out
