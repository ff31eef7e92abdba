"""``hapticbridge audit`` and ``repair``: exit codes, pictures, pages, hostile text, cut files."""

from __future__ import annotations

import json
import os
import xml.etree.ElementTree as ET
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from audit_cases import ScriptedDevice, recorded, rewritten
from cli_cases import Called, one_sentence

import hapticbridge as hb
from hapticbridge.audit import audit
from hapticbridge.recording import Recording, read_recording
from hapticbridge.report.evidence import Evidence
from hapticbridge.units import format_energy


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
    assert [report["verdict"] for report in reports] == ["invalid", "passive"]  # worst first
    assert reports[0]["tick"] == 50


def test_strict_is_passed_on(call: Called, run_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []

    def judged(path: Path, *, strict: bool, **options: Any) -> Any:
        seen.append(strict)
        return audit(path, strict=strict, **options)

    monkeypatch.setattr("hapticbridge.cli.audit.audit", judged)
    call("audit", run_file, "--strict")
    call("audit", run_file)
    assert seen == [True, False]


def test_file_without_permission_is_refused(
    call: Called, run_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(self: Path, *_mode: object, **_options: object) -> bytes:
        raise PermissionError(13, os.strerror(13))

    monkeypatch.setattr(Path, "open", refuse)  # root may read everything
    code, _, err = call("audit", run_file)
    assert code == 2
    assert "Permission denied" in one_sentence(err)


def test_jobs_for_one_recording_are_said_to_have_no_effect(call: Called, run_file: Path) -> None:
    """Not refused: a pattern that the shell resolves may fit one file today, and many tomorrow."""
    code, out, err = call("audit", run_file, "--jobs", 2)
    assert (code, "passive" in out) == (0, True)
    assert "--jobs and --scheduler are for several recordings" in err
    assert "--jobs" not in call("audit", run_file)[2]


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
        self.open += [tag] * (tag not in self.VOID)
        self.scripts += tag in ("script", "iframe", "object", "embed")
        for name, value in attrs:
            self.scripts += name.startswith("on")
            if name in ("src", "href", "xlink:href", "data") and not (value or "").startswith("#"):
                self.fetched.append(value or "")

    def handle_endtag(self, tag: str) -> None:
        assert tag in self.VOID or self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def test_page_is_whole_fetches_nothing_and_runs_nothing(
    hostile: Recording, call: Called, tmp_path: Path
) -> None:
    target = tmp_path / "page.html"
    picture_file = tmp_path / "picture.svg"
    code, out, _ = call("audit", hostile.path, "--report", target, "--plot", picture_file)
    assert code == 1  # no run has such a clock
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
    for told in ("invalid", "2400 N/m", "unknown", "metadata 'scene'"):
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


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    ("count", "kinetic", "meta"),
    [
        (201, 0.0, {}),
        (0, 0.0, {}),
        (201, 0.0, {"period_s": "0"}),
        (201, 1e300, {}),
        (201, 0.0, {"device": "[1, 2", "versions": "3"}),
    ],
)
def test_page_of_an_invalid_recording_is_written_all_the_same(
    count: int,
    kinetic: float,
    meta: dict[str, str],
    call: Called,
    run_file: Path,
    tmp_path: Path,
) -> None:
    recording, page = read_recording(run_file), tmp_path / "page.html"
    ticks = recording.ticks[: count and None].copy()
    ticks["kinetic"][5:6] += kinetic
    path = rewritten(recording, tmp_path / "bad.mcap", ticks=ticks, meta=meta)
    is_honest = (count, kinetic, meta) == (201, 0.0, {})
    code, _, err = call("audit", path, "--report", page)
    assert code == (0 if is_honest else 1), err
    text = page.read_text(encoding="utf-8")
    assert ("passive" if is_honest else "invalid") in text
    assert ("<svg" in text) == (is_honest or "device" in meta)


@pytest.fixture(scope="module")
def cut_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    whole = tmp_path_factory.mktemp("cut") / "long.mcap"
    recorded(whole, "virtual_wall", duration=1.5)
    cut = whole.with_name("a [b] cut.mcap")
    cut.write_bytes(whole.read_bytes()[: int(0.95 * whole.stat().st_size)])
    return cut


def test_a_file_cut_before_its_first_tick_does_not_speak_of_the_run(
    call: Called, cut_file: Path, tmp_path: Path
) -> None:
    early = tmp_path / "early.mcap"
    early.write_bytes(cut_file.read_bytes()[:5000])
    code, out, _ = call("audit", early)
    assert code == 1
    assert "empty\n  the recording holds no tick, so there is nothing to judge\n" in out
    assert "the file is cut: its end is missing" in out
    code, _, err = call("render", early, tmp_path / "early.png")
    assert code == 2
    assert "it holds no tick" in err


def test_a_run_that_ended_before_its_first_tick_is_nothing_to_judge(
    call: Called, tmp_path: Path
) -> None:
    path, page = tmp_path / "none.mcap", tmp_path / "none.html"
    with hb.Bridge(
        "virtual_wall", "simulated", clock=hb.SimulatedClock(), recording=path
    ) as bridge:
        bridge.stop()
        assert bridge.run(0.1).verdict == "empty"
    code, out, _ = call("audit", path, "--report", page)
    nothing = "the recording holds no tick, so there is nothing to judge"
    assert code == 1
    assert f"empty\n  {nothing}; the run was stopped before its first tick\n" in out
    assert f"{nothing[1:]}.</p>" in page.read_text(encoding="utf-8")
    [report] = json.loads(call("audit", path, "--json")[1])
    assert (report["verdict"], report["environment"]) == ("empty", None)
    assert "1 empty" in call("audit", path, "--table", tmp_path / "a.csv")[1]


def test_cut_file_is_called_cut_and_repaired(call: Called, cut_file: Path, tmp_path: Path) -> None:
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


@pytest.mark.usefixtures("undrawn")
def test_a_run_that_was_not_simulated_again_is_unverified_everywhere(
    call: Called, run_file: Path, tmp_path: Path
) -> None:
    recording, page = read_recording(run_file), tmp_path / "page.html"
    other = {"versions": json.dumps(json.loads(recording.meta["versions"]) | {"mujoco": "3.0"})}
    path = rewritten(recording, tmp_path / "old.mcap", meta=other)
    code, out, _ = call("audit", path, "--report", page)
    assert code == 1
    assert "old.mcap: environment unverified (strict)" in out
    assert "recorded with mujoco 3.0" in out
    assert call("audit", path, "--accept-unverified")[0] == 0
    text = page.read_text()
    assert '<span class="word">unverified</span> (strict)' in text
    assert "recorded with mujoco 3.0" in text
    code, out, _ = call("audit", path, "--json")
    assert (code, json.loads(out)[0]["verdict"]) == (1, "unverified")
    code, out, _ = call("audit", tmp_path, run_file)
    assert code == 1
    assert "2 recordings: 1 passive, 1 unverified" in out
    assert call("audit", tmp_path, run_file, "--accept-unverified")[0] == 0


def test_an_active_run_is_printed_with_its_worst_moment_cause_and_remedy(
    call: Called, tmp_path: Path
) -> None:
    path = tmp_path / "kick.mcap"
    code, _, _ = call(
        *("run", "virtual_wall", "--method", "implicitfast", "--stiffness", 4000, "--damping", 0),
        *("--i-know", "--duration", 1.5, "--fast", "--record", path),
    )
    assert code == 1
    code, out, _ = call("audit", path)
    assert code == 1
    report = audit(path)
    assert report.tick is not None
    evidence = Evidence.of(read_recording(path))
    assert evidence is not None
    energy, allowed = evidence.judged(report)
    worst = int((energy - allowed).argmax())
    assert worst > report.tick
    assert f"most at tick {worst} " in out
    assert f"{format_energy(float((energy - allowed)[worst]))} beyond the bound" in out
    assert "likely cause: method. " in out
    assert "what to change: use method 'lossless' or 'implicit'" in out


def test_a_tripped_run_is_not_called_passive_alone(call: Called, tmp_path: Path) -> None:
    path = tmp_path / "trip.mcap"
    run = ("run", "virtual_wall", "--fast", "--stretch-limit", 0.0005, "--record", path)
    assert call(*run)[0] == 3
    code, out, _ = call("audit", path)
    assert code == 1
    assert out.splitlines()[0].endswith("passive (strict), then the guard stopped the run")
    assert "likely cause" not in out
    assert "what to change: check the motion's unit (m) and speed" in out
    assert out.splitlines()[-1] == "next: hapticbridge guide faults"


RUNAWAY = """<mujoco><option timestep="0.001" gravity="0 0 0"/><worldbody>
<body><freejoint/><geom size="0.02" mass="0.2"/><site name="grip"/></body>
<body pos="0 0 0.3"><joint name="spin"/><geom type="capsule" size="0.01 0.1" euler="0 90 0"/></body>
</worldbody><actuator><general name="fan" {driven} biastype="affine" biasprm="0 0 {bias}"/>
</actuator><keyframe><key name="home" qpos="0 0 0 1 0 0 0 0" qvel="0 0 0 0 0 0 0.1"/></keyframe>
</mujoco>"""
"""A tool beside a fan, and a motor that drives one of them."""


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    ("driven", "bias", "reason"),
    [
        ('joint="spin"', 0.5, "the simulation is no longer finite"),
        (
            'site="grip" gear="1 0 0 0 0 0"',
            50,
            "more than it put in and the scene released, by more than the energy limit",
        ),
    ],
)
def test_a_motor_that_runs_away_is_named_as_the_cause_of_a_trip(
    call: Called, tmp_path: Path, driven: str, bias: float, reason: str
) -> None:
    scene, path, page = (tmp_path / name for name in ("fan.xml", "trip.mcap", "trip.html"))
    scene.write_text(RUNAWAY.format(driven=driven, bias=bias))
    assert call("run", scene, "--fast", "--duration", 5, "--record", path)[0] == 3
    code, out, _ = call("audit", path, "--report", page, "--in-process")
    assert code == 1
    assert reason in out
    cause = "pump. actuator 'fan' pushes "
    assert f"likely cause: {cause}" in out
    assert "harder the faster it moves (velocity bias " in out
    assert "J of work in the 0.2 s before" in out
    assert "what to change: write a third number of at most 0 in its biasprm" in out
    assert "Likely cause: pump. actuator &#39;fan&#39;" in page.read_text(encoding="utf-8")
    # the sign of the velocity bias alone is at fault
    scene.write_text(RUNAWAY.format(driven=driven, bias=-bias))
    assert call("run", scene, "--fast", "--duration", 0.2)[0] == 0


def test_a_device_without_a_condition_is_told_why(call: Called, tmp_path: Path) -> None:
    path, motion = tmp_path / "run.mcap", tmp_path / "hand.csv"
    motion.write_text("t,x,y,z\n0,0,0,0\n0.1,0.001,0,0\n")
    run = ("run", "point_mass", "--fast", "--device", f"trajectory:{motion}", "--record", path)
    assert call(*run)[0] == 0
    out = call("audit", path)[1]
    prescribed = "the device feels no force, as its motion is prescribed: there is nothing to cert"
    unknown = "device not judged: its damping is unknown; 'hapticbridge identi"
    assert prescribed in out and unknown not in out
    other = tmp_path / "other.mcap"
    device = ScriptedDevice(lambda _: (0, 0, 0, 1, 0, 0, 0), damping=None)
    summary = recorded(other, "point_mass", device, duration=0.02)
    unjudged = "device not judged: its damping is unknown; 'hapticbridge identify' measures it"
    assert unjudged in str(summary)
    out = call("audit", other)[1]
    assert unknown in out and prescribed not in out
    recording = read_recording(path)
    ticks = recording.ticks.copy()
    ticks["kinetic"][50] += 1.0
    out = call("audit", rewritten(recording, tmp_path / "bad.mcap", ticks=ticks))[1]
    assert "invalid" in out and prescribed not in out and unknown not in out


def test_a_link_to_itself_is_told_as_a_file_that_cannot_be_read(
    call: Called, tmp_path: Path
) -> None:
    (tmp_path / "loop.mcap").symlink_to(tmp_path / "loop.mcap")
    code, _, err = call("audit", tmp_path / "loop.mcap")
    assert code == 2
    assert "cannot read the recording" in err


@pytest.mark.filterwarnings("ignore:.*wind")
def test_wind_is_the_cause_that_an_audit_names(call: Called, tmp_path: Path) -> None:
    scene, recording = tmp_path / "windy.xml", tmp_path / "run.mcap"
    scene.write_text(
        '<mujoco><option wind="3 0 0" density="1000" gravity="0 0 0"/><worldbody><body name="t">'
        '<freejoint/><geom size=".02" mass=".1"/><site name="grip"/></body></worldbody></mujoco>'
    )
    assert call("run", scene, "--fast", "--duration", 0.5, "--record", recording)[0] == 1
    _, out, _ = call("audit", recording)
    words = " ".join(out.split())
    assert "likely cause: unmetered work. wind does work on the scene" in words
    assert "what to change: remove wind, or make it weaker" in words
