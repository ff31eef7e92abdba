"""Runs whose contacts or constraints do not fit into MuJoCo's memory, or in which MuJoCo stops."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from audit_cases import COUPLING, ScriptedDevice, rewritten
from bridge_runs import fast
from cli_cases import Called, one_sentence

import hapticbridge as hb
from hapticbridge.audit import audit
from hapticbridge.audit.events import AuditedRun
from hapticbridge.audit.replay import AuditedHand, comparison
from hapticbridge.confinement import ForeignSceneError
from hapticbridge.demand.methods import METHODS, unguarded_parameters
from hapticbridge.errors import SafetyTrip, SceneError
from hapticbridge.kernel.codes import OK
from hapticbridge.kernel.mujoco_c import model_addresses, warning_of
from hapticbridge.kernel.record import CLOCK_FIELDS
from hapticbridge.kernel.state import BoundKernel
from hapticbridge.recording import read_recording
from hapticbridge.scene import load_scene

PLATE = """<mujoco>
  <size{}/>
  <option timestep="0.001" gravity="0 0 0"/>
  <worldbody>
    <geom type="plane" size="1 1 0.1"/>
    <replicate count="5" offset="0.03 0 0"><replicate count="5" offset="0 0.03 0">
      <body pos="-0.06 -0.06 0.0102">
        <joint type="slide" axis="0 0 1"/><geom type="sphere" size="0.01" mass="0.005"/>
      </body>
    </replicate></replicate>
    <body pos="0 0 0.033">
      <freejoint/><geom type="box" size="0.1 0.1 0.01" mass="0.1"/><site name="grip"/>
    </body>
  </worldbody>
</mujoco>"""
"""A plate above 25 studs; it touches all of them at once."""

NO_CONTACTS, NO_CONSTRAINTS = 24, 44
"""Memory in kB that holds the plate's start, but too few contacts, or no rows."""

TRAY = """<mujoco>
  <size memory="32K"/>
  <worldbody>
    <geom type="plane" size="1 1 0.1"/>
    <body pos="0 0 0.05">
      <freejoint/><geom type="box" size="0.02 0.02 0.02" mass="0.1"/><site name="grip"/>
    </body>
    <replicate count="6" offset="0.06 0 0"><body pos="0.08 0 0.025">
      <freejoint/><geom type="box" size="0.02 0.02 0.02" mass="0.1"/>
    </body></replicate>
  </worldbody>
</mujoco>"""
"""Blocks that fall onto a floor beside the tool."""


def press(tick: int) -> tuple[float, ...]:
    return (0.0, 0.0, -0.004 * min(tick / 100, 1.0), 1.0, 0.0, 0.0, 0.0)


def plate(folder: Path, memory: int | None) -> Path:
    path = folder / "plate.xml"
    path.write_text(PLATE.format("" if memory is None else f' memory="{memory}K"'))
    return path


@pytest.fixture
def file_decides(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Leaves a scene the memory that its file gives; returns the present folder, empty."""
    monkeypatch.setattr("hapticbridge.scene.load.MIN_MEMORY", 0)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(scene: Path | hb.Scene, path: Path | None = None, **options: Any) -> ScriptedDevice:
    """Presses the plate down; returns the device after the run."""
    device = ScriptedDevice(press)
    with fast(scene, device, coupling=COUPLING, recording=path, **options) as bridge:
        bridge.run(0.2)
    return device


def test_a_scene_with_less_memory_than_mujocos_default_gets_the_default(tmp_path: Path) -> None:
    usual, small = tmp_path / "usual.mcap", tmp_path / "small.mcap"
    run(plate(tmp_path, None), usual)
    run(plate(tmp_path, NO_CONTACTS), small)
    ticks = read_recording(small).ticks
    np.testing.assert_array_equal(ticks, read_recording(usual).ticks)
    assert np.abs(ticks["wrench_on_device"][:, 2]).max() > 1.0
    assert audit(small).words == "passive (strict)"
    (change,) = (each for each in load_scene(plate(tmp_path, 24)).changes if "memory" in each)
    assert change.startswith("memory: 24.6 kB → 1")
    written = int(change.partition('(memory="')[2].removesuffix('M")'))
    assert not any("memory" in each for each in load_scene(plate(tmp_path, written << 10)).changes)


def test_more_memory_than_the_default_is_kept(tmp_path: Path) -> None:
    scene = load_scene(plate(tmp_path, 40_000))
    assert scene.model.narena == 40_000 << 10
    assert not any("memory" in change for change in scene.changes)


@pytest.mark.parametrize("size", ['memory="3G"', 'njmax="8000" nconmax="4000"'])
def test_memory_of_gigabytes_is_reduced_and_the_run_can_be_audited(
    tmp_path: Path, size: str
) -> None:
    path, recording = tmp_path / "scene.xml", tmp_path / "run.mcap"
    text = PLATE.format(f" {size}").replace('<site name="grip"/>', "")  # the body is the grip
    path.write_text(text.replace('<body pos="0 0 0.033">', '<body name="grip" pos="0 0 0.033">'))
    run(path, recording)
    scene = load_scene(path)
    assert scene.model.narena == 128 << 20
    (change,) = (each for each in scene.changes if "memory" in each)
    assert change.endswith('→ 134 MB (memory="128M")')
    path.write_text(path.read_text().replace(size, change.partition("(")[2].rstrip(")")))
    assert not any("memory" in each for each in load_scene(path).changes)
    assert audit(recording).words == "passive (strict)"


@pytest.mark.parametrize(
    ("options", "memory", "reason"),
    [
        ({}, NO_CONTACTS, "no more contacts"),
        ({}, NO_CONSTRAINTS, "no more constraints"),
        ({"scene_rate": 500.0}, NO_CONTACTS, "no more contacts"),
        ({"method": "implicit"}, NO_CONSTRAINTS, "no more constraints"),
        ({"method": "explicit", "substeps": 2}, NO_CONSTRAINTS, "no more constraints"),
    ],
)
def test_what_does_not_fit_trips_with_zero_force(
    options: Any,
    memory: int,
    reason: str,
    file_decides: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    scene, path = plate(file_decides, memory), file_decides / "r.mcap"
    device = ScriptedDevice(press)
    with (
        pytest.raises(SafetyTrip, match=reason) as trip,
        fast(scene, device, coupling=COUPLING, recording=path, **options) as bridge,
    ):
        bridge.run(0.2)
    assert not device.writes[-1].any()
    assert "<size memory=" in trip.value.__notes__[0]
    report = audit(path)
    assert (report.resimulation, report.is_cut) == ("bit for bit", False)
    assert reason in report.reason
    assert {each.name for each in file_decides.iterdir()} == {"plate.xml", "r.mcap"}
    assert "arena" not in capfd.readouterr().err


def test_the_command_line_names_limit_and_remedy(file_decides: Path, call: Called) -> None:
    (file_decides / "plate.csv").write_text("t,x,y,z\n0,0,0,0\n0.1,0,0,-0.004\n0.2,0,0,-0.004\n")
    scene = plate(file_decides, NO_CONTACTS)
    code, _, err = call("run", scene, "--fast", "--record", "r.mcap")
    assert code == 3
    assert "no more contacts" in err
    assert '<size memory="100M"/>' in err
    assert "MuJoCo warns" not in err
    code, out, _ = call("audit", "r.mcap")
    assert code == 1  # a run that tripped is not certified
    assert "then the guard stopped the run" in out
    assert '<size memory="100M"/>' in out


def test_what_does_not_fit_ends_a_run_of_two_hands(file_decides: Path) -> None:
    path = plate(file_decides, NO_CONTACTS)
    sites = '<site name="left" pos="-0.1 0 0"/><site name="right" pos="0.1 0 0"/>'
    path.write_text(path.read_text().replace('<site name="grip"/>', sites))
    devices = ScriptedDevice(press), ScriptedDevice(press)
    hands = [hb.Grasp(*each) for each in zip(("left", "right"), devices, strict=True)]
    with (
        pytest.raises(SafetyTrip, match=r"^tick \d+: MuJoCo's memory holds no more"),
        hb.Bridge(path, hands, clock=hb.SimulatedClock()) as bridge,
    ):
        bridge.run(0.3)
    assert not any(device.writes[-1].any() for device in devices)


@pytest.mark.parametrize("height", ["0.0199", "0.025"])
def test_a_start_that_does_not_fit_is_refused(
    height: str, file_decides: Path, call: Called
) -> None:
    path = file_decides / "tray.xml"
    path.write_text(TRAY.replace("0.025", height))
    code, _, err = call("run", path, "--fast", "--duration", 0.1)
    assert code == 2
    assert "<size memory=" in one_sentence(err)
    assert "MuJoCo warns" not in err
    assert [each.name for each in file_decides.iterdir()] == ["tray.xml"]


def test_a_recording_that_hides_a_warning_is_invalid(
    file_decides: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The run is made by a bridge that does not look at MuJoCo's warnings."""
    calm, path = np.zeros(2 * len(mujoco.mjtWarning.__members__), np.int32), file_decides / "r.mcap"

    def blind(model: mujoco.MjModel, data: mujoco.MjData) -> Any:
        values, owned = model_addresses(model, data)
        return values | {"warnings": calm.ctypes.data}, owned

    with monkeypatch.context() as patch:
        patch.setattr("hapticbridge.kernel.state.model_addresses", blind)
        run(plate(file_decides, NO_CONTACTS), path)
    assert len(read_recording(path).ticks) == 200  # the plate went through
    report = audit(path)
    assert report.verdict == "invalid"
    assert "holds no more contacts" in report.reason
    assert report.tick is not None
    assert report.tick < 100


def test_mujocos_stop_in_a_longer_recording_is_named(
    file_decides: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """The forger goes on after the tick in which MuJoCo stopped, and hides the trip."""
    scene, path, forged = (file_decides / name for name in ("row.xml", "r.mcap", "forged.mcap"))
    scene.write_text(ROW.format(' memory="14K"'))
    with pytest.raises(SafetyTrip, match="stack overflow"):
        run(scene, path)
    honest = read_recording(path)
    count = len(honest.ticks)
    more = np.repeat(honest.ticks[-1:], 9)
    more["tick"] += 1 + np.arange(9)
    for name in CLOCK_FIELDS:
        more[name] += 1_000_000 * (1 + np.arange(9))
    for name in ("device_position", "handle_position"):
        more[name][:, 2] -= 4e-5 * (1 + np.arange(9))
    events = [e | {"tick": count + 9} for e in honest.events if e["event"] == "stop"]
    events = [e for e in honest.events if e["event"] not in ("trip", "stop")] + [
        e | {"reason": "duration"} for e in events
    ]
    rewritten(honest, forged, ticks=np.concatenate([honest.ticks, more]), events=events)
    recording = read_recording(forged)
    hand = AuditedHand(recording, AuditedRun.of(recording))
    with (
        comparison([hand]) as outcome,
        pytest.raises(ForeignSceneError, match=r"made MuJoCo fail: mj_stack.*stack overflow"),
    ):
        outcome()
    assert not capfd.readouterr().err
    assert audit(forged).verdict == "invalid"


KINDS = {
    "CONTACTFULL": "no more contacts",
    "CNSTRFULL": "no more constraints",
    "BADQPOS": "no longer finite",
    "BADQVEL": "no longer finite",
    "BADQACC": "no longer finite",
    "BADCTRL": "no longer finite",
}


@pytest.mark.parametrize(
    "kind", [name for name in mujoco.mjtWarning.__members__ if name[7:] in KINDS]
)
def test_every_warning_of_mujoco_trips(kind: str) -> None:
    device = ScriptedDevice(press)
    with fast(device=device, coupling=COUPLING) as bridge:
        number = int(getattr(mujoco.mjtWarning, kind))

        def warn(tick: int) -> None:
            if tick == 20:
                bridge.scene.data.warning[number].number += 1

        with pytest.raises(SafetyTrip, match=rf"tick 20: .*{KINDS[kind.removeprefix('mjWARN_')]}"):
            bridge.run(0.1, warn)
    assert not device.writes[-1].any()


def test_warnings_of_a_trial_do_not_end_the_run_after_it() -> None:
    scene, method = load_scene("point_mass"), METHODS["implicit"]
    parameters = unguarded_parameters(scene, COUPLING, 1e-3, 1, method)
    scene.data.warning[mujoco.mjtWarning.mjWARN_CONTACTFULL].number = 1
    kernel = BoundKernel(scene.model, scene.data, parameters)
    assert warning_of(scene.data) == OK
    kernel.release()


# MuJoCo stops

ROW = PLATE.replace('count="5" offset="0 0', 'count="1" offset="0 0').replace(
    'pos="-0.06 -0.06', 'pos="-0.06 0'
)


def test_mujocos_stop_ends_a_run_with_zero_force(file_decides: Path, call: Called) -> None:
    scene, path = file_decides / "row.xml", file_decides / "r.mcap"
    scene.write_text(ROW.format(' memory="14K"'))
    device = ScriptedDevice(press)
    with (
        pytest.raises(SafetyTrip, match=r"tick \d+: MuJoCo stopped: .*stack overflow.*<size mem"),
        fast(scene, device, coupling=COUPLING, recording=path) as bridge,
    ):
        bridge.run(0.2)
    assert not device.writes[-1].any()
    report = audit(path)
    assert (report.verdict, report.is_cut) == ("unverified", False)
    assert "stack overflow" in report.reason
    (file_decides / "row.csv").write_text("t,x,y,z\n0,0,0,0\n0.1,0,0,-0.004\n0.2,0,0,-0.004\n")
    code, _, err = call("run", scene, "--fast")
    assert code == 3
    assert "MuJoCo stopped: mj_stackAlloc" in err


@pytest.mark.parametrize("command", ["run", "check"])
def test_mujocos_stop_at_the_start_is_a_sentence(
    command: str, file_decides: Path, call: Called
) -> None:
    path = file_decides / "row.xml"
    path.write_text(ROW.format(' memory="4K"'))
    code, _, err = call(command, path)
    assert code == 2
    assert "stack overflow" in one_sentence(err)


@pytest.mark.parametrize("command", ["run", "check", "audit"])
def test_mujocos_stop_anywhere_is_a_sentence(
    command: str, monkeypatch: pytest.MonkeyPatch, call: Called
) -> None:
    def fails(*_: object, **__: object) -> None:
        raise mujoco.FatalError("mj_stackAlloc: out of memory")

    name = command.title()
    monkeypatch.setattr(f"hapticbridge.cli.{command}.{name}.execute", fails)
    code, _, err = call(command, "point_mass")
    assert code == 2
    assert "MuJoCo stopped: mj_stackAlloc: out of memory" in one_sentence(err)


def test_mujocos_stop_while_the_tool_settles_is_a_scene_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fails(*_: object) -> None:
        raise mujoco.FatalError("mj_stackAlloc: out of memory")

    monkeypatch.setattr("hapticbridge.kernel.state.BoundKernel.step", fails)
    with (
        pytest.raises(SceneError, match="while the tool settled: mj_stackAlloc"),
        fast(device=ScriptedDevice(press), coupling=COUPLING),
    ):
        pass
