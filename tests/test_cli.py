"""The commands as a user calls them: what they print, their exit codes, what they leave behind."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from audit_cases import recorded, rewritten
from cli_cases import Called

from hapticbridge import bridge as bridge_module
from hapticbridge.audit import audit
from hapticbridge.cli import main
from hapticbridge.errors import SafetyTrip
from hapticbridge.record import TICK_DTYPE
from hapticbridge.recording import read_recording, repair
from hapticbridge.scene import scene_names
from hapticbridge.scene.load import scene_path

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


@pytest.fixture(scope="module")
def cut_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    whole = tmp_path_factory.mktemp("cut") / "long.mcap"
    recorded(whole, "virtual_wall", duration=1.5)
    cut = whole.with_name("a [b] cut.mcap")
    cut.write_bytes(whole.read_bytes()[: int(0.95 * whole.stat().st_size)])
    return cut


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


def test_default_stiffness_changes_with_what_the_user_gives_only(
    call: Called, tmp_path: Path
) -> None:
    path = tmp_path / "run.mcap"
    call("run", "point_mass", "--fast", "--duration", 0.01, "--stiffness", 900, "--record", path)
    meta = read_recording(path).meta
    assert float(meta["stiffness"]) == 900
    assert float(meta["damping"]) == pytest.approx(1.7 - 0.45)  # 1.7 N s/m are felt as before
    assert float(meta["rotational_stiffness"]) == pytest.approx(2.4)


def test_trip_is_exit_code_3(call: Called, monkeypatch: pytest.MonkeyPatch) -> None:
    def trip(*_: Any, **__: Any) -> None:
        raise SafetyTrip("tick 7: [/b] the device's pose is not finite", np.zeros(0, TICK_DTYPE))

    monkeypatch.setattr(bridge_module.Bridge, "run", trip)
    code, _, err = call("run", "point_mass", "--fast")
    assert code == 3
    assert "safety trip: tick 7: [/b]" in err


def test_trip_is_told_with_what_to_do_about_it(call: Called, tmp_path: Path) -> None:
    path = tmp_path / "millimetres.csv"
    path.write_text("t,x,y,z\n0,0,0,0\n0.1,50,0,0\n")
    code, _, err = call("run", "point_mass", "--fast", "--device", f"trajectory:{path}")
    assert code == 3
    assert "than the stretch limit; check the motion's unit (m)" in err


@pytest.mark.parametrize("where", ["tyro.cli", "hapticbridge.cli.stability.run_map"])
def test_ctrl_c_is_one_word_and_exit_code_130(
    where: str, call: Called, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_arguments: object, **_named: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(where, interrupted)
    code, out, err = call("stability", "rate")
    assert (code, out, err.strip()) == (130, "", "interrupted")


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

    def judged(path: Path, *, strict: bool) -> Any:
        seen.append(strict)
        return audit(path, strict=strict)

    monkeypatch.setattr("hapticbridge.cli.audit.audit", judged)
    call("audit", run_file, "--strict")
    call("audit", run_file)
    assert seen == [True, False]


def test_one_unreadable_file_does_not_hide_the_verdict_of_the_others(
    call: Called, run_file: Path, tmp_path: Path
) -> None:
    code, out, _ = call("audit", tmp_path / "missing.mcap", run_file)
    assert code == 2
    assert re.search(rf"passive \(\w+( slack)?\) +0.2\d* +{run_file}", out)
    assert out.count("missing.mcap: No such file") == 1
    code, out, err = call("audit", tmp_path / "missing.mcap", run_file, "--json")
    assert code == 2
    assert err.count("error:") == 1
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


def test_the_next_command_of_a_scene_runs(call: Called) -> None:
    _, out, _ = call("scenes", "planar_peg")
    command = out.splitlines()[-1].removeprefix("next: hapticbridge ")
    assert call(*command.split(), "--fast", "--duration", "0.1")[0] == 0


def test_a_scene_of_one_s_own_is_shown_whatever_its_grip_is_called(
    call: Called, tmp_path: Path
) -> None:
    """Nobody holds it here, so no grip is needed; what cannot be compiled is refused as ever."""
    path = tmp_path / "chisel.xml"
    text = "<mujoco><worldbody><body><freejoint/><geom size='.01'{}/>{}</body></worldbody></mujoco>"
    for site in ("<site name='hand'/>", ""):
        path.write_text(text.format("", site))
        code, out, err = call("scenes", path)
        assert (code, err) == (0, "")
        assert "1 moving body, 6 degrees of freedom" in out
    path.write_text(text.format(" mass='0'", ""))
    code, _, err = call("scenes", path)
    assert code == 2
    assert "error: cannot compile scene" in err


def test_calling_the_command_line_leaves_warnings_as_they_were(call: Called) -> None:
    import warnings

    before = warnings.showwarning
    call("scenes")
    assert warnings.showwarning is before


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
