"""The scene's own sensors in tables and data sets, and actions as robomimic wants them."""

from __future__ import annotations

import csv
from pathlib import Path

import h5py
import mujoco
import numpy as np
import pyarrow.parquet
import pytest
from cli_cases import Called

import hapticbridge as hb
from hapticbridge.errors import HapticBridgeError
from hapticbridge.replay.film import Shot
from hapticbridge.tools.dataset import write_dataset
from hapticbridge.tools.export import Part, export

SCENE = """<mujoco model="sensed"><option timestep="0.001" integrator="discrete" cone="elliptic"/>
<worldbody><geom type="plane" size="1 1 .1"/><body pos="0 0 .02"><freejoint/>
<geom type="sphere" size=".02" mass="0.1"/><site name="grip"/></body>
<body pos="1 0 1"><joint name="swing" type="hinge" axis="0 1 0"/>
<geom type="capsule" size=".01" fromto="0 0 0 .2 0 0"/></body></worldbody>
<sensor><framepos name="tip" objtype="site" objname="grip"/><jointpos joint="swing"/>
<jointpos name="coarse, =/" joint="swing" cutoff="0.001"/><jointpos name="tip_0" joint="swing"/>
</sensor></mujoco>"""
NAMES = ["tip_0", "tip_1", "tip_2", "1", "coarse, =_", "tip_0~1"]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sensed")
    (folder / "sensed.xml").write_text(SCENE)
    file = folder / "run.mcap"
    clock = hb.SimulatedClock()
    with hb.Bridge(folder / "sensed.xml", clock=clock, recording=file) as bridge:
        bridge.run(duration=0.3)
    return file


def read_table(file: Path, name: str) -> np.ndarray:
    if file.suffix == ".csv":
        with file.open() as text:
            return np.array([float(row[name]) for row in csv.DictReader(text)])
    if file.suffix == ".h5":
        with h5py.File(file) as data:
            return np.asarray(data["ticks"][name])
    return np.asarray(pyarrow.parquet.read_table(file)[name])


@pytest.mark.parametrize("name", ["run.csv", "run.h5", "run.parquet"])
def test_readings_of_sensors_are_columns_of_tables(run: Path, tmp_path: Path, name: str) -> None:
    form = {".csv": "csv", ".h5": "hdf5", ".parquet": "parquet"}[Path(name).suffix]
    export(run, form, tmp_path / name, part=Part(has_sensors=True))
    ticks = hb.read_recording(run).ticks
    for axis in range(3):  # the reading of a step is that of its start
        read = read_table(tmp_path / name, f"sensor_tip_{axis}")
        np.testing.assert_allclose(read[1:], ticks["tool_position"][:-1, axis], atol=1e-12)
    columns = (read_table(tmp_path / name, f"sensor_{each}") for each in NAMES[3:])
    swing, coarse, second = columns
    assert swing.max() > 0.1
    np.testing.assert_array_equal(second, swing)
    np.testing.assert_array_equal(coarse, np.minimum(swing, 0.001))
    export(run, form, tmp_path / f"cut_{name}", part=Part(span=(0.1, 0.2), has_sensors=True))
    read = read_table(tmp_path / f"cut_{name}", "sensor_1")
    assert read.tobytes() == swing[99:199].tobytes()


def test_sensors_are_asked_for_at_the_command_line(run: Path, tmp_path: Path, call: Called) -> None:
    out = tmp_path / "run.csv"
    assert call("export", run, "--format", "csv", "--sensors", "--out", out)[0] == 0
    assert "sensor_tip_0" in out.read_text().partition("\n")[0]
    code, _, err = call(
        "export", run, "--format", "foxglove", "--sensors", "--out", tmp_path / "x.json"
    )
    assert (code, "sensors are columns of tables" in err) == (2, True)
    bare = tmp_path / "bare.mcap"
    with hb.Bridge("point_mass", clock=hb.SimulatedClock(), recording=bare) as bridge:
        bridge.run(duration=0.05)
    with pytest.raises(HapticBridgeError, match="has no sensors"):
        export(bare, "csv", tmp_path / "bare.csv", part=Part(has_sensors=True))
    assert not (tmp_path / "bare.csv").exists()


def test_robomimic_has_actions_within_one_and_how_to_undo_it(run: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.mcap"
    other.write_bytes(run.read_bytes())
    folder = write_dataset([run, other], "robomimic", tmp_path / "set").folder
    with h5py.File(folder / "demos.hdf5") as file:
        data = file["data"]
        scale, offset = data.attrs["action_scale"], data.attrs["action_offset"]
        assert list(data.attrs["action_names"])[:3] == ["x", "y", "z"]
        actions = np.concatenate([data[f"demo_{number}/actions"] for number in range(2)])
        assert np.abs(actions).max() == pytest.approx(1.0, abs=1e-6)
        assert (np.abs(actions) <= 1.0).all()
        parts = data["demo_0/action_dict"]
        raw = np.hstack(
            [parts[name] for name in ("handle_position", "handle_quaternion", "wrench")]
        )
        np.testing.assert_allclose(data["demo_0/actions"] * scale + offset, raw, atol=1e-5)
        recorded = hb.read_recording(run).ticks["handle_position"]
        assert np.abs(raw[:, :3]).max() <= np.abs(recorded).max()
        assert data["demo_0/obs/sensors"].shape[1] == len(NAMES)


def test_lerobot_has_the_sensors_by_name(run: Path, tmp_path: Path) -> None:
    folder = write_dataset([run], "lerobot", tmp_path / "set").folder
    (file,) = (folder / "data").rglob("*.parquet")
    read = pyarrow.parquet.read_table(file)
    sensed = np.array(read["observation.sensors"].to_pylist())
    state = np.array(read["observation.state"].to_pylist())
    np.testing.assert_allclose(sensed[:, :3], state[:, :3], atol=1e-3)
    assert '"coarse, =_"' in (folder / "meta" / "info.json").read_text()


LIFTED = """<mujoco model="lifted"><option timestep="0.001"/><worldbody>
<body><joint name="lift" type="slide" axis="0 0 1"/><geom size=".02" mass="0.1"/>
<site name="wrist"/><body name="hand"><geom size=".01" mass="0.1" contype="0" conaffinity="0"/>
<site name="grip"/></body></body></worldbody>
<sensor><jointpos name="height" joint="lift"/><force name="at wrist" site="wrist"/>
<jointactuatorfrc name="motor" joint="lift"/></sensor></mujoco>"""
"""A tool of 0.2 kg in the hand, without any motor."""

COUPLED = ["at wrist_0", "at wrist_1", "at wrist_2", "motor"]


def test_readings_that_include_the_coupling_are_told(tmp_path: Path, call: Called) -> None:
    (tmp_path / "lifted.xml").write_text(LIFTED)
    file, table = tmp_path / "run.mcap", tmp_path / "run.csv"
    with hb.Bridge(tmp_path / "lifted.xml", clock=hb.SimulatedClock(), recording=file) as bridge:
        bridge.run(duration=0.2)
    asked = ("--format", "csv", "--sensors", "--out", table)
    _, _, told = call("export", file, *asked)
    words = " ".join(told.split())
    columns = ", ".join(f"'sensor_{name}'" for name in COUPLED)
    assert f"{columns}: these readings include the coupling's pull on the tool" in words
    # the weight of 2 N, which no real sensor would read here; the actuators give half of it
    assert read_table(table, "sensor_at wrist_2")[1] == pytest.approx(0.2 * 9.81, rel=0.02)
    assert read_table(table, "sensor_motor")[1] == pytest.approx(0.1 * 9.81, rel=0.02)
    done = write_dataset([file], "robomimic", tmp_path / "set")
    assert done.odd["coupled"] == COUPLED
    _, _, told = call("export", file, "--format", "lerobot", "--out", tmp_path / "other")
    assert "'motor': these readings include the coupling's pull" in " ".join(told.split())
    _, _, told = call("export", file, "--format", "csv", "--out", tmp_path / "plain.csv")
    assert "readings" not in told


HOVERING = """<mujoco model="hovering"><option timestep="0.001"/><worldbody>
<geom name="floor" type="plane" size="1 1 .1"/><body name="foot" pos="0 0 .0203" gravcomp="1">
<freejoint/><geom name="foot" type="box" size=".02 .02 .02" mass=".1"/><site name="grip"/></body>
</worldbody><sensor><contact name="touches" geom1="foot" geom2="floor" data="found force"
reduce="netforce"/><contact name="push" geom1="foot" geom2="floor" data="force" reduce="netforce"/>
</sensor></mujoco>"""
"""A tool 0.3 mm above the floor, which the file's own contacts do not find."""


def test_readings_of_contacts_that_are_seen_ahead_are_told(tmp_path: Path, call: Called) -> None:
    model = mujoco.MjModel.from_xml_string(HOVERING)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert not data.sensordata.any()
    (tmp_path / "hovering.xml").write_text(HOVERING)
    file, table = tmp_path / "run.mcap", tmp_path / "run.csv"
    place, clock = tmp_path / "hovering.xml", hb.SimulatedClock()
    with hb.Bridge(place, "simulated:hand=none", clock=clock, recording=file) as bridge:
        bridge.run(duration=0.1)
    _, _, told = call("export", file, "--format", "csv", "--sensors", "--out", table)
    columns = ", ".join(f"'sensor_touches_{k}'" for k in range(4))
    assert f"{columns}: these readings find contacts that the run sees ahead" in " ".join(
        told.split()
    )
    assert read_table(table, "sensor_touches_0")[-1] == 4  # a box on a plane
    assert not any(read_table(table, f"sensor_push_{k}").any() for k in range(3))
    done = write_dataset([file], "robomimic", tmp_path / "set", Shot(fps=100))
    assert done.odd == {"coupled": [], "early": [f"touches_{k}" for k in range(4)]}
