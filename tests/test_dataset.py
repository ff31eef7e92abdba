"""Recordings as a data set to learn from: LeRobot's and robomimic's formats."""

from __future__ import annotations

import importlib
import io
import json
import os
import sys
from pathlib import Path
from typing import Any

import h5py
import mujoco
import numpy as np
import pytest
from audit_cases import SlowClock, recorded
from cli_cases import Called, one_sentence
from PIL import Image

import hapticbridge as hb
from hapticbridge.errors import HapticBridgeError, RecordingError
from hapticbridge.recording import read_recording
from hapticbridge.replay.film import Shot
from hapticbridge.tools.dataset import Episode, RobomimicWriter, continued, write_dataset

pq: Any = importlib.import_module("pyarrow.parquet")

LENGTHS = (1.0, 0.6)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder, found = tmp_path_factory.mktemp("runs"), []
    for number, seconds in enumerate(LENGTHS):
        found.append(folder / f"{number}.mcap")
        with hb.Bridge("ratchet", clock=hb.SimulatedClock(), recording=found[-1]) as bridge:
            bridge.run(duration=seconds)
    return found


def lerobot(folder: Path, episode: int) -> dict[str, Any]:
    info = json.loads((folder / "meta" / "info.json").read_text())
    file = info["data_path"].format(chunk_index=0, file_index=episode)
    table = pq.read_table(folder / file)
    return {name: table[name].to_pylist() for name in table.column_names}


def test_a_frame_is_what_the_run_was_at_its_time(runs: list[Path], tmp_path: Path) -> None:
    done = write_dataset(runs, "lerobot", tmp_path / "set", Shot(fps=20))
    assert done.episodes == (19, 11)  # the last frame is the last action alone
    scene = hb.load_scene("ratchet")
    data, site = mujoco.MjData(scene.model), scene.model.site("grip").id
    pose = np.zeros(4)
    for number, path in enumerate(runs):
        ticks, table = read_recording(path).ticks, lerobot(done.folder, number)
        for frame in range(done.episodes[number]):
            now, later = (ticks[round((frame + k) * 50) - (frame + k > 0)] for k in (0, 1))
            state = table["observation.state"][frame]
            np.testing.assert_allclose(state[:3], now["tool_position"], rtol=1e-6, atol=1e-7)
            np.testing.assert_allclose(
                table["action"][frame][:7],
                [*later["handle_position"], *later["handle_quaternion"]],
                rtol=1e-6,
                atol=1e-7,
            )
            np.testing.assert_allclose(
                table["action"][frame][7:], later["wrench_on_tool"], rtol=1e-6, atol=1e-7
            )
            np.testing.assert_allclose(
                table["observation.wrench"][frame], now["wrench_on_device"], rtol=1e-6, atol=1e-7
            )
            # the joints' positions put the grip where the record says
            data.qpos[:] = table["observation.qpos"][frame]
            mujoco.mj_kinematics(scene.model, data)
            np.testing.assert_allclose(data.site_xpos[site], state[:3], atol=1e-6)
            mujoco.mju_mat2Quat(pose, data.site_xmat[site])
            assert abs(pose @ np.array(state[3:])) == pytest.approx(1.0, abs=1e-6)
        assert table["timestamp"] == pytest.approx(np.arange(len(table["timestamp"])) / 20)
    assert "observation.ctrl" not in table, "the coupling's own actuators are none of the scene's"


SEVERAL_CONTROLS = """<mujoco><option timestep="0.001" gravity="0 0 0"/><worldbody>
<body name="tool"><freejoint/><geom size=".02" mass=".1"/></body>
<body pos="1 0 0"><joint name="j" type="slide"/><geom size=".02" mass="1"/></body></worldbody>
<actuator><pid name="servo" joint="j" input="pos vel ff" kp="3" kv="2"/>
<motor name="motor" joint="j"/><motor joint="j"/></actuator>
<keyframe><key name="home" ctrl=".1 .2 .3 .5 .6"/></keyframe></mujoco>"""


def test_each_control_of_an_actuator_is_in_a_frame(tmp_path: Path) -> None:
    (tmp_path / "scene.xml").write_text(SEVERAL_CONTROLS)
    scene = hb.load_scene(tmp_path / "scene.xml", grip="tool")
    with hb.Bridge(scene, clock=hb.SimulatedClock(), recording=tmp_path / "run.mcap") as bridge:
        bridge.run(duration=0.2)
    write_dataset([tmp_path / "run.mcap"], "lerobot", tmp_path / "set", Shot(fps=20))
    found = lerobot(tmp_path / "set", 0)["observation.ctrl"][0]
    assert found == pytest.approx([0.1, 0.2, 0.3, 0.5, 0.6])
    info = json.loads((tmp_path / "set" / "meta" / "info.json").read_text())
    names = info["features"]["observation.ctrl"]["names"]
    assert names == ["servo_0", "servo_1", "servo_2", "motor", "2"]


def test_pictures_show_the_scene_without_arrows(runs: list[Path], tmp_path: Path) -> None:
    shot = Shot(fps=10, camera="free", width=64, height=48)
    folder = write_dataset(runs[:1], "lerobot", tmp_path / "set", shot).folder
    pictures = lerobot(folder, 0)["observation.images.free"]
    assert len(pictures) == 9
    for each in pictures:
        picture = np.asarray(Image.open(io.BytesIO(each["bytes"])))
        assert picture.shape == (48, 64, 3)
        assert picture.std() > 5.0
    write_dataset(runs[:1], "robomimic", tmp_path / "other", shot)
    with h5py.File(tmp_path / "other" / "demos.hdf5") as file:
        np.testing.assert_array_equal(file["data/demo_0/obs/free_image"][-1], picture)


def test_a_camera_of_an_attached_part_has_a_name_that_learners_take(tmp_path: Path) -> None:
    """LeRobot refuses a feature with '/', and HDF5 makes a group of it."""
    camera = "<camera name='arm/hand' pos='0 0 1'/>"
    body = "<body><freejoint/><geom size='.02'/><site name='grip'/></body>"
    scene = tmp_path / "a.xml"
    scene.write_text(f"<mujoco><worldbody>{camera}{body}</worldbody></mujoco>")
    recorded(tmp_path / "run.mcap", scene, duration=0.3)
    shot = Shot(fps=10, camera="arm/hand", width=32, height=32)
    folder = write_dataset([tmp_path / "run.mcap"], "lerobot", tmp_path / "set", shot).folder
    assert len(lerobot(folder, 0)["observation.images.arm_hand"]) == 2
    info = json.loads((folder / "meta" / "info.json").read_text())
    assert "observation.images.arm_hand" in info["features"]
    assert not any("/" in name for name in info["features"])
    frames = lerobot(folder, 0)["observation.images.arm_hand"]
    pixels = np.array([Image.open(io.BytesIO(frame["bytes"])) for frame in frames]) / 255.0
    pixels = pixels.reshape(-1, 3)
    found = json.loads((folder / "meta" / "stats.json").read_text())["observation.images.arm_hand"]
    right = {name: getattr(pixels, name)(0) for name in ("min", "max", "mean", "std")}
    for name, share in (("q01", 0.01), ("q10", 0.1), ("q50", 0.5), ("q90", 0.9), ("q99", 0.99)):
        right[name] = np.quantile(pixels, share, axis=0)
    assert found.pop("count") == [2]
    assert {name: np.shape(value) for name, value in found.items()} == dict.fromkeys(
        right, (3, 1, 1)
    )
    for name, values in right.items():
        np.testing.assert_allclose(np.ravel(found[name]), values, atol=1e-12, err_msg=name)
    write_dataset([tmp_path / "run.mcap"], "robomimic", tmp_path / "other", shot)
    with h5py.File(tmp_path / "other" / "demos.hdf5") as file:
        assert all(isinstance(each, h5py.Dataset) for each in file["data/demo_0/obs"].values())
        assert file["data/demo_0/obs/arm_hand_image"].shape == (2, 32, 32, 3)


def test_lerobot_finds_what_its_description_says(runs: list[Path], tmp_path: Path) -> None:
    folder = write_dataset(runs, "lerobot", tmp_path / "set", task="turn it").folder
    info = json.loads((folder / "meta" / "info.json").read_text())
    stats = json.loads((folder / "meta" / "stats.json").read_text())
    tables = [lerobot(folder, number) for number in range(2)]
    assert (info["total_episodes"], info["codebase_version"]) == (2, "v3.0")
    assert info["total_frames"] == sum(len(table["index"]) for table in tables)
    joined = {name: tables[0][name] + tables[1][name] for name in tables[0]}
    assert joined["index"] == list(range(info["total_frames"]))
    assert set(info["features"]) == set(joined) == set(stats)
    for name, feature in info["features"].items():
        values = np.array(joined[name], dtype=np.float64).reshape(info["total_frames"], -1)
        assert [values.shape[1]] == feature["shape"]
        assert feature["names"] is None or len(feature["names"]) == values.shape[1]
        assert stats[name]["mean"] == pytest.approx(values.mean(0), abs=1e-9)
        assert stats[name]["std"] == pytest.approx(values.std(0), abs=1e-9)
    episodes = pq.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [each["dataset_from_index"] for each in episodes] == [0, len(tables[0]["index"])]
    assert episodes[1]["tasks"] == ["turn it"]
    assert episodes[1]["stats/action/max"] == pytest.approx(np.max(tables[1]["action"], axis=0))


def test_lerobot_loads_it(runs: list[Path], tmp_path: Path) -> None:
    package = pytest.importorskip("lerobot.datasets.lerobot_dataset")
    folder = write_dataset(runs, "lerobot", tmp_path / "set").folder
    loaded = package.LeRobotDataset("local/ratchet", root=folder)
    assert (loaded.num_episodes, loaded[0]["task"]) == (2, "ratchet")


def test_robomimic_has_its_groups(runs: list[Path], tmp_path: Path) -> None:
    folder = write_dataset(runs, "robomimic", tmp_path / "set").folder
    with h5py.File(folder / "demos.hdf5") as file:
        demos = [file["data"][name.decode()] for name in file["mask/train"]]
        assert file["data"].attrs["total"] == sum(demo.attrs["num_samples"] for demo in demos)
        assert json.loads(file["data"].attrs["env_args"])["env_name"] == "ratchet"
        assert [demo.attrs["recording"] for demo in demos] == [run.name for run in runs]
        for demo in demos:
            count = demo.attrs["num_samples"]
            for name in ("actions", "states", "rewards", "dones", "obs/qpos", "next_obs/qpos"):
                assert len(demo[name]) == count
            np.testing.assert_array_equal(demo["next_obs/qpos"][:-1], demo["obs/qpos"][1:])
            assert demo["dones"][-1] == 1
            assert demo["dones"][:-1].sum() == 0


def test_the_quaternion_of_a_turning_tool_does_not_jump_in_a_data_set(tmp_path: Path) -> None:
    half = np.linspace(0.0, 2.5 * np.pi, 61)  # half of the angle: two turns and a half
    smooth = np.stack([np.cos(half), np.sin(half), 0.0 * half, 0.0 * half], axis=1)
    stored = smooth * np.where(smooth[:, :1] < 0.0, -1.0, 1.0)
    assert np.abs(np.diff(stored, axis=0)).max() > 1.9
    assert np.allclose(continued(stored), smooth)
    motion, run = tmp_path / "turn.csv", tmp_path / "run.mcap"
    times = np.linspace(0.0, 2.0, 61)
    turns = 0.3 * half  # half of 270 deg
    rows = [(t, 0, 0, 0, np.cos(a), 0, 0, np.sin(a)) for t, a in zip(times, turns, strict=True)]
    header = "t,x,y,z,qw,qx,qy,qz\n"
    motion.write_text(header + "\n".join(",".join(map(str, row)) for row in rows))
    recorded(run, "point_mass", f"trajectory:{motion}")
    folder = write_dataset([run], "robomimic", tmp_path / "set").folder
    with h5py.File(folder / "demos.hdf5") as file:
        turned = np.asarray(file["data/demo_0/obs/tool_pose"])[:, 3:]
    assert np.abs(np.diff(read_recording(run).ticks["tool_quaternion"], axis=0)).max() > 1.9
    assert np.abs(np.diff(turned, axis=0)).max() < 0.2
    assert turned[-1, 0] == pytest.approx(np.cos(turns[-1]), abs=0.05)  # and not its opposite


def test_the_last_next_observation_of_robomimic_is_one_frame_later(
    runs: list[Path], tmp_path: Path
) -> None:
    """The run has 1000 ticks per second, and the set 25 frames: 40 ticks lie between two."""
    folder = write_dataset(runs[:1], "robomimic", tmp_path / "set", Shot(fps=25)).folder
    ticks = read_recording(runs[0]).ticks
    with h5py.File(folder / "demos.hdf5") as file:
        demo = file["data/demo_0"]
        ways = demo["next_obs/tool_pose"][-1, :3] - demo["obs/tool_pose"][-1, :3]
        last = 40 * (demo.attrs["num_samples"] - 1)
    expected = ticks["tool_position"][last + 40] - ticks["tool_position"][last]
    assert np.linalg.norm(expected) > 1e-4
    assert ways == pytest.approx(expected, abs=0.05 * float(np.linalg.norm(expected)))


def test_robomimic_gets_the_names_of_all_scenes(tmp_path: Path) -> None:
    """As of three episodes in two scenes of one build; robomimic reads one name for all."""
    values = dict.fromkeys(("action", "observation.state"), np.zeros((5, 13), np.float32))
    writer = RobomimicWriter(tmp_path, Shot(), "push")
    scenes = ["light", "heavy", "light"]
    for number, scene in enumerate(scenes):
        writer.add(Episode(f"{number}.mcap", scene, values, values, {}, np.zeros((5, 2)), ()))
    writer.finish()
    writer.close()
    with h5py.File(tmp_path / "demos.hdf5") as file:
        about = json.loads(file["data"].attrs["env_args"])
        assert about == {"env_name": "light, heavy", "type": 2, "env_kwargs": {"fps": 30}}
        assert [file[f"data/demo_{i}"].attrs["scene"] for i in range(3)] == scenes


def test_an_episode_that_the_guard_ended_is_told(call: Called, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    code, _, _ = call("run", "point_mass", "--fast", "--stretch-limit", 1e-6, "--record", path)
    assert code == 3
    code, _, err = call("export", path, "--format", "robomimic", "--out", tmp_path / "set")
    assert code == 0
    told = " ".join(err.split())
    assert f"{path.name}: the guard tripped at tick " in told
    assert "look at its episode" in told


@pytest.mark.parametrize(("size", "spread"), [(1e-11, 1e-11), (1e-5, 2.0)])
def test_rounding_is_no_motion_to_learn(tmp_path: Path, size: float, spread: float) -> None:
    actions = np.linspace(-1.0, 1.0, 13 * 5, dtype=np.float32).reshape(5, 13)
    actions[:, 1] = np.linspace(0.0, size, 5)
    values = {"action": actions, "observation.state": actions}
    writer = RobomimicWriter(tmp_path, Shot(), "push")
    writer.add(Episode("run", "scene", values, values, {}, np.zeros((5, 2)), ()))
    writer.finish()
    writer.close()
    with h5py.File(tmp_path / "demos.hdf5") as file:
        found = np.ptp(file["data/demo_0/actions"], axis=0)
    assert found.tolist() == pytest.approx([2.0, spread] + [2.0] * 11)


def test_what_cannot_be_learned_from_is_refused_and_leaves_nothing(
    runs: list[Path], tmp_path: Path
) -> None:
    cut, other = tmp_path / "cut.mcap", tmp_path / "other.mcap"
    cut.write_bytes(runs[0].read_bytes()[:-30])
    with hb.Bridge("point_mass", clock=hb.SimulatedClock(), recording=other) as bridge:
        bridge.run(duration=0.3)
    target = tmp_path / "set"
    cases: list[tuple[list[Path], str, Shot, str]] = [
        ([], "lerobot", Shot(), "a recording at least"),
        ([cut], "lerobot", Shot(), "its end is missing"),
        ([*runs, runs[0]], "lerobot", Shot(), f"'{runs[0].name}' is named more than once"),
        ([runs[0], other], "lerobot", Shot(), f"other joints, .* than '{runs[0].name}'; the epis"),
        ([other], "robomimic", Shot(fps=1), "shorter than two frames"),
        ([other, runs[0]], "lerobot", Shot(), "the scenes 'point_mass', 'ratchet', and one's name"),
        (runs, "lerobot", Shot(camera="nowhere"), "no camera 'nowhere'"),
        (runs, "csv", Shot(), "the formats are 'lerobot', 'robomimic'"),
    ]
    for paths, form, shot, words in cases:
        with pytest.raises(HapticBridgeError, match=words):
            task = "push" if "other joints" in words else None
            write_dataset(paths, form, target, shot, task=task)
    with pytest.raises(RecordingError, match="does not exist"):
        write_dataset(runs, "lerobot", tmp_path / "no" / "set")
    target.mkdir()
    with pytest.raises(RecordingError, match="exists"):
        write_dataset(runs, "lerobot", target)
    assert sorted(each.name for each in tmp_path.iterdir()) == ["cut.mcap", "other.mcap", "set"]


GAUGE = """
<mujoco><worldbody>
  <body name="tool"><freejoint/><geom size="0.01"/><site name="grip"/></body>
  <body pos="0.1 0 0"><joint name="lever" type="{joint}"/><geom size="0.01"/></body>
</worldbody><actuator><{actuator} joint="lever" name="drive"/></actuator>
<sensor><{sensor} name="gauge" joint="lever"/></sensor></mujoco>"""


@pytest.mark.parametrize(
    "other",
    [
        ("slide", "motor", "jointpos"),
        ("hinge", "position", "jointpos"),
        ("hinge", "motor", "jointvel"),
    ],
)
def test_numbers_of_one_name_with_two_meanings_are_no_data_set(
    other: tuple[str, ...], tmp_path: Path
) -> None:
    files = []
    for name, kinds in [("a", ("hinge", "motor", "jointpos")), ("b", other)]:
        scene = tmp_path / f"{name}.xml"
        scene.write_text(
            GAUGE.format(**dict(zip(("joint", "actuator", "sensor"), kinds, strict=True)))
        )
        files.append(scene.with_suffix(".mcap"))
        with hb.Bridge(scene, clock=hb.SimulatedClock(), recording=files[-1]) as bridge:
            bridge.run(duration=0.1)
    with pytest.raises(RecordingError, match=r"b\.mcap' has other joints, actuators or"):
        write_dataset(files, "lerobot", tmp_path / "set", task="pull")
    assert write_dataset(files[:1], "lerobot", tmp_path / "set", task="pull").episodes


@pytest.mark.parametrize("form", ["lerobot", "robomimic"])
def test_recordings_of_two_grips_are_no_data_set(form: str, tmp_path: Path) -> None:
    """The state would be the bolt's pose in one episode, and the wrench's in the other."""
    files = [tmp_path / f"{grip}.mcap" for grip in ("bolt", "wrench")]
    for file in files:
        scene = hb.load_scene("nut_and_wrench", grip=file.stem)
        with hb.Bridge(scene, clock=hb.SimulatedClock(), recording=file) as bridge:
            bridge.run(duration=0.1)
    with pytest.raises(RecordingError, match="are of the grips 'bolt', 'wrench'; the poses"):
        write_dataset(files, form, tmp_path / "set")
    assert not (tmp_path / "set").exists()


@pytest.mark.parametrize(
    ("options", "fps", "most"),
    [({"rate": 25.0}, 26, 25), ({"scene_rate": 20.0}, 30, 20), ({"rate": 60.0}, 61, 60)],
)
def test_frames_that_would_repeat_are_refused_with_the_most(
    tmp_path: Path, options: dict[str, Any], fps: int, most: int
) -> None:
    run = tmp_path / "run.mcap"
    clock = hb.SimulatedClock()
    with hb.Bridge("point_mass", clock=clock, recording=run, i_know=True, **options) as bridge:
        bridge.run(duration=1.0)
    with pytest.raises(RecordingError, match=rf"some of {fps} frames .* --fps {most} or fewer"):
        write_dataset([run], "lerobot", tmp_path / "no", Shot(fps=fps))
    done = write_dataset([run], "lerobot", tmp_path / "set", Shot(fps=most), task="")
    state = np.array(lerobot(done.folder, 0)["observation.state"])
    assert (np.abs(np.diff(state[2:], axis=0)).max(axis=1) > 0.0).all()  # it starts at rest
    assert pq.read_table(done.folder / "meta" / "tasks.parquet").to_pandas().index[0] == ""


def test_frames_that_repeat_because_deadlines_were_skipped_are_counted(
    call: Called, tmp_path: Path
) -> None:
    """Ticks at 200 ms and 281 ms: of the frames at 201, 211 … 271, 281 ms seven repeat another."""
    paths = tmp_path / "late.mcap", tmp_path / "whole.mcap"
    for path, stalls in zip(paths, ({200: 80}, {}), strict=True):
        recorded(path, "point_mass", duration=0.6, clock=SlowClock(stalls))
    folder = tmp_path / "set"
    code, _, err = call("export", *paths, "--format", "lerobot", "--fps", "100", "--out", folder)
    assert code == 0
    (told,) = [line for line in " ".join(err.split()).split("warning: ") if "repeat" in line]
    assert "late.mcap: 7 of its frames repeat the one before" in told
    state = np.array(lerobot(folder, 0)["observation.state"])
    assert sum((state[1:] == state[:-1]).all(axis=1)) == 7


def test_a_programs_run_has_its_tool_and_says_where_it_was_placed_anew(
    call: Called, tmp_path: Path
) -> None:
    path = tmp_path / "own.mcap"
    with hb.DeviceLoop("simulated", recording=path, is_simulated=True) as device:
        device.advance(0.1)  # the loop runs before a tool is shown
        for place in (0.02, 0.05):
            device.show([place, 0.0, 0.0], is_placed=True)
            for _ in range(10):
                device.advance(0.02)
                device.show([place, 0.0, 0.0])
    events = hb.audit(path, in_process=True).events
    assert (events["placed"] == 2, "reset" in events) == (True, False)
    assert 20 <= events["shown"] <= 22
    folder = tmp_path / "set"
    code, _, err = call("export", path, "--format", "lerobot", "--out", folder)
    assert code == 0
    assert "was reset" in err and "look at its episode" not in err
    jumps = write_dataset([path], "lerobot", tmp_path / "again").resets[0]
    assert [pytest.approx(time, abs=2e-3) for time in jumps] == [0.3]
    assert f"was reset at {jumps[0]:.3f} s: its episode jumps there" in " ".join(err.split())
    columns = lerobot(folder, 0)
    assert "observation.qpos" not in columns
    state = np.array(columns["observation.state"])
    assert state[0, 0] == pytest.approx(0.02)
    assert 10 <= len(state) <= 12  # of 0.4 s
    assert state[-1, 0] == pytest.approx(0.05)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--format", "csv", "--fps", "3"], "--fps goes with"),
        (["--format", "lerobot", "--from", "1"], "whole recordings"),
        (["--format", "lerobot", "--fps", "0"], "fps"),
        (["--format", "lerobot", "--camera", "free", "--size", "3", "3"], "width"),
        (["--format", "robomimic", "--size", "32", "32"], "--size without --camera"),
    ],
)
def test_options_that_do_not_go_together_are_a_sentence(
    call: Called, runs: list[Path], words: list[str], said: str
) -> None:
    code, out, err = call("export", str(runs[0]), *words)
    assert (code, out) == (2, "")
    assert said in one_sentence(err)


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such names")
@pytest.mark.parametrize("form", ["lerobot", "robomimic"])
def test_names_and_a_task_that_are_no_utf_8(
    form: str, runs: list[Path], tmp_path: Path, call: Called
) -> None:
    word = os.fsdecode(b"gr\xf6\xdfe")
    named = tmp_path / f"{word}.mcap"
    named.write_bytes(runs[1].read_bytes())
    write_dataset([named], form, tmp_path / word)
    write_dataset([named], form, tmp_path / ("L" * 255))
    words = "export", named, "--format", form, "--out", tmp_path / "set"
    sentence = one_sentence(call(*words, "--task", word)[2])
    assert "the task 'gr\\udcf6\\udcdfe' is not in UTF-8" in sentence
    assert sorted(tmp_path.iterdir()) == sorted([named, tmp_path / word, tmp_path / ("L" * 255)])


def test_several_recordings_are_no_table(call: Called, runs: list[Path]) -> None:
    code, _, err = call("export", *map(str, runs), "--format", "csv")
    assert code == 2
    assert "writes one recording, not 2" in one_sentence(err)
