"""Motions from exported recordings and from bags of ROS 2, and units that people mistake."""

from __future__ import annotations

import struct
from contextlib import nullcontext
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest
import zstandard
from audit_cases import recorded
from cli_cases import Called
from mcap.opcode import Opcode
from mcap.records import Chunk
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter
from recording_cases import random_rows
from recording_cases import write as write_recording
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

import hapticbridge as hb
from hapticbridge.check.case import motion_for
from hapticbridge.device import open_device, read_motion
from hapticbridge.device.motion_file import POSE, read_bag
from hapticbridge.device.trajectory import Motion
from hapticbridge.errors import DeviceError, HapticBridgeError, RecordingError
from hapticbridge.kernel.record import TICK_DTYPE
from hapticbridge.scene import load_scene
from hapticbridge.tools.export import export

TYPES = get_typestore(Stores.ROS2_JAZZY)
TURN = np.array([0.1, -0.2, 0.3, np.sqrt(1 - 0.14)])  # x, y, z, w, as ROS writes them


def pose_message(
    time: int,
    place: float,
    kind: str = "geometry_msgs/msg/PoseStamped",
    frame: str = "world of a long name",
) -> bytes:
    """Returns a message with a stamp in ns and a place on the x axis in m."""
    new = TYPES.types.__getitem__
    stamp = new("builtin_interfaces/msg/Time")(*divmod(time, 10**9))
    header = new("std_msgs/msg/Header")(stamp, frame)
    if kind.endswith("TwistStamped"):
        zero = new("geometry_msgs/msg/Vector3")(0.0, 0.0, 0.0)
        message = new(kind)(header, new("geometry_msgs/msg/Twist")(zero, zero))
    else:
        point = new("geometry_msgs/msg/Point")(place, 0.0, 0.5)
        turn = new("geometry_msgs/msg/Quaternion")(*TURN.tolist())
        message = new(kind)(header, new("geometry_msgs/msg/Pose")(point, turn))
    return bytes(TYPES.serialize_cdr(message, kind))


def bag(
    folder: Path, topics: dict[str, list[tuple[int, bytes]]], kind: str = "PoseStamped"
) -> Path:
    """Writes a bag as ROS 2 does, a folder with a file in it; times of the log in ns."""
    whole = f"geometry_msgs/msg/{kind}"
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for topic, messages in topics.items():
            connection = writer.add_connection(topic, whole, typestore=TYPES)
            for time, message in messages:
                writer.write(connection, time, message)
    return folder


def ramp(count: int = 5, start: int = 10**18, late: int = 7) -> list[tuple[int, bytes]]:
    """Returns messages every 10 ms, 1 mm apart, with stamps; the log is late by some ns."""
    stamps = [start + 10_000_000 * i for i in range(count)]
    return [(at + late, pose_message(at, 1e-3 * i)) for i, at in enumerate(stamps)]


def write_ramp(writer: Any, encoding: str = "cdr", kind: str = POSE) -> None:
    """Writes a whole bag of poses on ``/hand``."""
    writer.start("ros2", "a test")
    schema = writer.register_schema(kind, "ros2msg", b"")
    channel = writer.register_channel("/hand", encoding, schema)
    for time, data in ramp():
        writer.add_message(channel, time, data, time)
    writer.finish()


@pytest.mark.parametrize("is_folder", [False, True])
def test_a_bag_of_poses_is_a_motion(tmp_path: Path, *, is_folder: bool) -> None:
    folder = bag(tmp_path / "walk", {"/hand": ramp()})
    (file,) = folder.glob("*.mcap")
    device = open_device(f"trajectory:{folder if is_folder else file}")
    assert device.info.duration == pytest.approx(0.04, abs=1e-12)
    table = read_bag(file).table
    np.testing.assert_allclose(table[:, 0], 0.01 * np.arange(5), atol=1e-12)
    np.testing.assert_allclose(table[:, 1], 1e-3 * np.arange(5))
    np.testing.assert_allclose(table[:, 3], 0.5)
    np.testing.assert_allclose(table[:, 4:], np.tile(TURN[[3, 0, 1, 2]], (5, 1)))
    moved = motion_for(load_scene("point_mass"), file)
    assert moved is not None
    assert moved.table[0, 1:4].tolist() == [0, 0, 0]
    with hb.Bridge("point_mass", device, clock=hb.SimulatedClock()) as bridge:
        assert bridge.run(duration=0.02).ticks == 20


def test_messages_without_stamps_have_the_times_of_the_log(tmp_path: Path) -> None:
    messages = [(10**18 + 10**7 * i, pose_message(0, 1e-3 * i)) for i in range(3)]
    (file,) = bag(tmp_path / "walk", {"/hand": messages}).glob("*.mcap")
    np.testing.assert_allclose(read_bag(file).table[:, 0], [0, 0.01, 0.02], atol=1e-12)


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("has_chunks", [False, True])
def test_no_changed_bit_of_a_bag_without_checksums_loses_a_message_unseen(
    tmp_path: Path, *, has_chunks: bool
) -> None:
    """A record of an unknown kind is skipped, so one bit may hide a message."""
    path, random, told = tmp_path / "hand.mcap", Random(1), ""
    with path.open("wb") as file:
        write_ramp(
            McapWriter(
                file, use_chunking=has_chunks, compression=CompressionType.NONE, enable_crcs=False
            )
        )
    content = path.read_bytes()
    for place in random.sample(range(len(content)), 500):
        data = bytearray(content)
        data[place] ^= 1 << random.randrange(8)
        path.write_bytes(data)
        try:
            assert len(read_bag(path).table) == len(ramp()), place
        except HapticBridgeError as error:
            told += str(error)
    assert "is damaged: its index counts 5 messages of /hand, and 4 can be read" in told


def test_stamps_that_stand_still_are_told(tmp_path: Path) -> None:
    messages = [(at, pose_message(10**9, 0.0)) for at, _ in ramp()]
    (file,) = bag(tmp_path / "walk", {"/hand": messages}).glob("*.mcap")
    with pytest.raises(DeviceError, match="message 1 of /hand: the stamps stand still: time 0 s a"):
        read_bag(file)


@pytest.mark.parametrize("unset", [[0], [0, 1], [3]])
def test_some_messages_without_stamps_are_told_and_a_simulated_clock_from_0_is_not(
    tmp_path: Path, unset: list[int]
) -> None:
    messages = ramp()
    for k in unset:
        messages[k] = messages[k][0], pose_message(0, 1e-3 * k)
    (file,) = bag(tmp_path / "walk", {"/hand": messages}).glob("*.mcap")
    words = f"is 0 in {len(unset)} of the 5 messages of /hand, first in message {unset[0]},"
    with pytest.raises(DeviceError, match=words):
        read_bag(file)
    (file,) = bag(tmp_path / "simulated", {"/hand": ramp(start=0)}).glob("*.mcap")
    np.testing.assert_allclose(read_bag(file).table[:, 0], 0.01 * np.arange(5), atol=1e-12)
    slow = [(at, pose_message(i // 2 * 10**8, 1e-3 * i)) for i, (at, _) in enumerate(ramp())]
    (file,) = bag(tmp_path / "slow", {"/hand": slow}).glob("*.mcap")
    with pytest.raises(DeviceError, match=r"message 1 of /hand: time 0 s after 0 s; times must"):
        read_bag(file)


def test_a_simulated_clock_that_begins_anew_is_no_clock_that_was_not_set(tmp_path: Path) -> None:
    stamps = [0, 10**7, 2 * 10**7, 0, 10**7]  # as after a reset of the simulator
    messages = [(at, pose_message(k, 0.0)) for (at, _), k in zip(ramp(), stamps, strict=True)]
    (file,) = bag(tmp_path / "walk", {"/hand": messages}).glob("*.mcap")
    with pytest.raises(
        DeviceError, match=r"message 3 of /hand: time 0 s after 0\.02 s; times must"
    ):
        read_bag(file)


@pytest.mark.parametrize("jump", [3 * 10**7, -3600 * 10**9])
def test_a_log_that_jumps_leaves_messages_with_stamps_in_the_order_of_the_file(
    tmp_path: Path, jump: int
) -> None:
    messages = [(at + (jump if i == 2 else 0), data) for i, (at, data) in enumerate(ramp())]
    (file,) = bag(tmp_path / "walk", {"/hand": messages}).glob("*.mcap")
    np.testing.assert_allclose(read_bag(file).table[:, 1], 1e-3 * np.arange(5))


def test_a_clock_that_was_set_back_in_a_bag_is_told(tmp_path: Path) -> None:
    messages = [*ramp(3), *ramp(3, start=10**18 - 3600 * 10**9)]
    (file,) = bag(tmp_path / "walk", {"/hand": messages}).glob("*.mcap")
    with pytest.raises(DeviceError, match=r"message 3 of /hand: time -3600 s after 0\.02 s"):
        read_bag(file)


def test_a_clock_that_was_set_in_a_motion_is_told(tmp_path: Path) -> None:
    """A machine without a clock of its own begins with the time since it was started."""
    messages = [*ramp(1, start=5 * 10**9), *ramp(29)]
    (file,) = bag(tmp_path / "walk", {"/hand": messages}).glob("*.mcap")
    with pytest.raises(DeviceError, match="jumps by 11574 days after 1 of 30 poses"):  # 1e9/86400
        read_bag(file)
    rows = "".join(f"{0.01 * i + (1e9 if i > 12 else 0)},0,0,0\n" for i in range(30))
    (tmp_path / "hand.csv").write_text("t,x,y,z\n" + rows)
    with pytest.raises(DeviceError, match="jumps by 11574 days after 13 of 30 poses"):
        read_motion(tmp_path / "hand.csv")
    (tmp_path / "hand.csv").write_text("t,x,y,z\n" + rows.replace("1000000000.", "80000."))
    with pytest.warns(UserWarning, match="no pose from 0.12 to 80000.13 s"):  # a long pause
        assert read_motion(tmp_path / "hand.csv").duration == pytest.approx(80000.29)


def test_of_several_topics_one_is_named(tmp_path: Path) -> None:
    folder = bag(tmp_path / "two: a, b", {"/hand/left": ramp(), "/hand/right": ramp(9)})
    (file,) = folder.glob("*.mcap")
    with pytest.raises(DeviceError, match=r"several topics .*'trajectory:.*:/hand/left'"):
        open_device(f"trajectory:{file}")
    for path in (file, folder):
        device = open_device(f"trajectory:{path}:/hand/right")
        assert device.info.duration == pytest.approx(0.08, abs=1e-12)
    with pytest.raises(DeviceError, match=r"topic '/foot' must be .* and there is none; topics"):
        open_device(f"trajectory:{file}:/foot")


def test_the_only_topic_with_messages_is_the_motion(tmp_path: Path) -> None:
    (file,) = bag(tmp_path / "one", {"/a": [], "/hand": ramp(9), "/z": []}).glob("*.mcap")
    assert open_device(f"trajectory:{file}").info.duration == pytest.approx(0.08, abs=1e-12)
    with pytest.raises(DeviceError, match="/a has 0 of at least two messages"):
        open_device(f"trajectory:{file}:/a")


def test_a_bag_in_the_place_of_a_table_or_of_ros_1_is_told(tmp_path: Path) -> None:
    (file,) = bag(tmp_path / "bag", {"/hand": ramp()}).glob("*.mcap")
    with pytest.raises(DeviceError, match=f"not CSV; 'trajectory:{file}' reads it"):
        open_device(f"simulated:path={file}")
    file = tmp_path / "older.mcap"
    with file.open("wb") as stream:
        write_ramp(McapWriter(stream), "ros1", "geometry_msgs/PoseStamped")
    with pytest.raises(DeviceError, match="those of ROS 1 are not read"):
        open_device(f"trajectory:{file}")


def test_a_bag_that_is_no_motion_is_refused_with_what_it_holds(tmp_path: Path) -> None:
    twist = [
        (time, pose_message(time, 0.0, "geometry_msgs/msg/TwistStamped")) for time, _ in ramp()
    ]
    (file,) = bag(tmp_path / "twist", {"/speed": twist}, "TwistStamped").glob("*.mcap")
    with pytest.raises(DeviceError, match=r"has no topic of .*PoseStamped; topics: '/speed \(geo"):
        open_device(f"trajectory:{file}")
    (file,) = bag(tmp_path / "one", {"/hand": ramp(1)}).glob("*.mcap")
    with pytest.raises(DeviceError, match="has 1 of at least two messages"):
        open_device(f"trajectory:{file}")
    (file,) = bag(tmp_path / "back", {"/hand": [*ramp(3), (2 * 10**18, ramp()[0][1])]}).glob(
        "*.mcap"
    )
    with pytest.raises(DeviceError, match=r"message 3 of /hand: time 0 s after 0\.02 s"):
        open_device(f"trajectory:{file}")
    for length in (0, 1, 3, 40):
        torn = {"/hand": [(0, ramp()[0][1][:length])]}
        (file,) = bag(tmp_path / f"torn{length}", torn).glob("*.mcap")
        with pytest.raises(DeviceError, match="message 0 of /hand cannot be read"):
            open_device(f"trajectory:{file}")


@pytest.mark.parametrize("has_chunks", [True, False])
@pytest.mark.parametrize("has_statistics", [True, False])
def test_a_bag_without_an_index_or_topics_in_it_is_read(
    has_statistics: bool, has_chunks: bool, tmp_path: Path
) -> None:
    """Its writer may leave out whatever only speeds up reading."""
    path = tmp_path / "hand.mcap"
    with path.open("wb") as file:
        writer: Any = McapWriter(
            file,
            use_chunking=has_chunks,
            use_statistics=has_statistics,
            index_types=IndexType.NONE,
            repeat_channels=False,
            repeat_schemas=False,
            use_summary_offsets=False,
        )
        write_ramp(writer)
    device = open_device(f"trajectory:{path}")
    assert device.info.duration == pytest.approx(0.04)
    with pytest.raises(RecordingError, match=r"it has no topic /tick$"):  # and no damage
        hb.read_recording(path)
    path.write_bytes(path.read_bytes()[:-9])
    with pytest.raises(RecordingError, match="no topic /tick; the file is cut: its end is missing"):
        open_device(f"trajectory:{path}")
    with pytest.raises(DeviceError, match="its end is missing or followed by more"):
        open_device(f"trajectory:{path}:/hand")


@pytest.mark.parametrize(
    ("name", "begin", "words"),
    [
        ("bag_0.db3", b"SQLite format 3\0", "in SQLite; 'ros2 bag convert' writes it in MCAP"),
        ("hand.bag", b"#ROSBAG V2.0\n", "'rosbags-convert --dst-storage mcap'"),
        ("bag_0.mcap.zstd", b"\x28\xb5\x2f\xfd", "what 'zstd -d' makes of it is read"),
        ("hand.csv.gz", b"\x1f\x8b", "what 'gunzip' makes of it is read"),
    ],
)
def test_a_bag_of_another_kind_is_told_with_what_reads_it(
    name: str, begin: bytes, words: str, tmp_path: Path, call: Called
) -> None:
    path = tmp_path / name
    path.write_bytes(begin)
    for place in (path, path.parent):
        with pytest.raises(DeviceError, match=words):
            open_device(f"trajectory:{place}")
    for place in (path, path.parent):
        code, _, told = call("audit", place)
        assert (code, words in told) == (2, True)
    renamed = tmp_path / "run.mcap"
    path.rename(renamed)
    for asked in (("audit",), ("export", "--format", "csv"), ("view",)):
        code, _, told = call(*asked, renamed)
        assert (code, words in told) == (2, True)
    assert ("only what 'hapticbridge run' wrote is a recording" in told) == (
        "a bag of" in words + told
    )


def test_poses_of_two_frames_on_one_topic_are_refused(tmp_path: Path) -> None:
    """Two programs publish there; their poses are no one motion."""
    frames = ["map", "odom"]
    poses = [(at, pose_message(at, 0.0, frame=frames[at % 2])) for at in range(1, 9)]
    with pytest.raises(DeviceError, match=r"/hand are in 2 frames, 'map', 'odom'; write"):
        read_bag(next(bag(tmp_path / "bag", {"/hand": poses}).glob("*.mcap")))


def test_a_bag_that_compresses_each_message_is_told(tmp_path: Path) -> None:
    packed = [(time, zstandard.compress(message)) for time, message in ramp()]
    (file,) = bag(tmp_path / "packed", {"/hand": packed}).glob("*.mcap")
    with pytest.raises(DeviceError, match="the bag compresses each message; 'ros2 bag convert'"):
        open_device(f"trajectory:{file}")


@pytest.mark.parametrize("kind", ["bag", "recording"])
def test_a_compression_that_mcap_lacks_is_told(
    kind: str, tmp_path: Path, call: Called, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The package mcap takes it for none, and its checksum then fails."""

    def packed(*, data: bytes, compression: str, **fields: Any) -> Chunk:
        return Chunk(data=data[::-1], compression=f"brotli{compression[4:]}", **fields)

    path = tmp_path / "run.mcap"
    with monkeypatch.context() as patched:
        patched.setattr("mcap.writer.Chunk", packed)
        if kind == "bag":
            with path.open("wb") as file:
                write_ramp(McapWriter(file))
        else:
            write_recording(path, random_rows(500), events=False)
    told = "its chunks are compressed by 'brotli', and MCAP has 'lz4', 'zstd' and none"
    topic = "/hand" if kind == "bag" else "/tool_pose"
    device = "run", "point_mass", "--fast", "--device", f"trajectory:{path}"
    for asked in (
        ("audit", path),
        ("repair", path, tmp_path / "whole.mcap"),
        ("export", path, "--format", "csv"),
        ("view", path),
        device,
        (*device[:-1], f"{device[-1]}:{topic}"),
    ):
        code, _, words = call(*asked)
        assert (code, words.count(told)) == (2, 1), words


@pytest.mark.parametrize("compression", list(CompressionType))
def test_a_bag_with_a_changed_byte_is_refused_or_gives_the_same_motion(
    tmp_path: Path, compression: CompressionType
) -> None:
    path = tmp_path / "hand.mcap"
    with path.open("wb") as file:
        writer: Any = McapWriter(file, compression=compression)
        write_ramp(writer)
    whole, right = path.read_bytes(), read_bag(path).table
    refused = 0
    for place in range(8, len(whole), 3):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0x10]) + whole[place + 1 :])
        try:
            np.testing.assert_array_equal(read_bag(path).table, right)
        except DeviceError:
            refused += 1
    assert refused > 20


def test_a_bag_whose_index_lost_a_chunk_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "hand.mcap"
    with path.open("wb") as file:
        writer: Any = McapWriter(file, chunk_size=150)
        write_ramp(writer)
    whole, count = bytearray(path.read_bytes()), len(read_bag(path).table)
    head = struct.pack("<BQ", Opcode.CHUNK_INDEX, 78)
    assert 1 < whole.count(head) < count
    whole[whole.rindex(head)] ^= 0x80  # a record of an unknown kind, which readers pass over
    path.write_bytes(whole)
    with pytest.raises(DeviceError, match="the index at the end of the file is damaged"):
        read_bag(path)


def test_times_that_do_not_increase_are_told_apart(tmp_path: Path) -> None:
    (tmp_path / "hand.csv").write_text("t,x,y,z\n1700000000.02,0,0,0\n1700000000.01,0,0,0\n")
    with pytest.raises(DeviceError, match=r"time 1700000000\.01 s after 1700000000\.02 s"):
        read_motion(tmp_path / "hand.csv")


def test_big_endian_poses_are_read(tmp_path: Path) -> None:
    messages = []
    for i in range(3):
        head = struct.pack(">BBHiII", 0, 0, 0, 5, 10**7 * i, 2) + b"w\0" + bytes(2)
        messages.append((i, head + bytes(0) + struct.pack(">7d", i * 1e-3, 0, 0, 0, 0, 0, 1)))
    (file,) = bag(tmp_path / "big", {"/hand": messages}).glob("*.mcap")
    np.testing.assert_allclose(read_bag(file).table[:, 1], [0, 1e-3, 2e-3])


@pytest.mark.parametrize("frame", [b"\0", b"w\0", b"map\0", b"world\0", b"a hand\0"])
@pytest.mark.parametrize("representation", [6, 7])
def test_poses_in_the_second_version_of_cdr_are_read(
    representation: int, frame: bytes, tmp_path: Path
) -> None:
    """There, numbers of 8 bytes lie at a multiple of 4."""
    order, messages = "<" if representation & 1 else ">", []
    for i in range(3):
        head = struct.pack(f"{order}iII", 5, 10**7 * i, len(frame)) + frame
        head += bytes(-len(head) % 4)
        numbers = struct.pack(f"{order}7d", i * 1e-3, 2, 3, 0, 0, 0, 1)
        messages.append((i, bytes([0, representation, 0, 0]) + head + numbers))
    (file,) = bag(tmp_path / "second", {"/hand": messages}).glob("*.mcap")
    right = [[0.01 * i, 1e-3 * i, 2, 3, 1, 0, 0, 0] for i in range(3)]
    np.testing.assert_allclose(read_bag(file).table, right, atol=1e-12)


@pytest.mark.parametrize("representation", [2, 3, 8, 9, 0x107])
def test_another_representation_is_told(representation: int, tmp_path: Path) -> None:
    messages = [(at, struct.pack(">H", representation) + data[2:]) for at, data in ramp()]
    (file,) = bag(tmp_path / "other", {"/hand": messages}).glob("*.mcap")
    with pytest.raises(DeviceError, match=rf"\(its representation is 0x{representation:04x}; of"):
        read_bag(file)


def test_poses_in_another_encoding_than_cdr_are_told(tmp_path: Path) -> None:
    path = tmp_path / "hand.mcap"
    with path.open("wb") as file:
        writer: Any = McapWriter(file)
        write_ramp(writer, "json")
    with pytest.raises(DeviceError, match=r"read \(its encoding is 'json', not 'cdr'\)"):
        read_bag(path)


@pytest.mark.parametrize(
    "text",
    [
        "t x y z\n0 0 0 0\n1 0 0 0\n",
        "t|x|y|z\n0|0|0|0\n1|0|0|0\n",
        "# time x y z\n0.0 0 0 0\n1.0 0 0 0\n",
    ],
)
def test_columns_with_another_separator_are_told(text: str, tmp_path: Path) -> None:
    (tmp_path / "hand.csv").write_text(text)
    with pytest.raises(DeviceError, match="are not separated by commas, semicolons or tabs"):
        read_motion(tmp_path / "hand.csv")
    (tmp_path / "hand.csv").write_text(text.replace("#", "").replace("|", ",").replace(" ", ","))
    with pytest.raises(DeviceError, match="column t") if "#" in text else nullcontext():
        read_motion(tmp_path / "hand.csv")


def test_an_exported_recording_is_the_motion_of_its_device(tmp_path: Path) -> None:
    file = tmp_path / "run.mcap"
    recorded(file, load_scene("point_mass"), duration=0.1)
    export(file, "csv")
    ticks = hb.read_recording(file).ticks
    table = read_motion(file.with_suffix(".csv")).table
    assert table[:, 1:4].tobytes() == ticks["device_position"].tobytes()
    np.testing.assert_allclose(table[:, 4:], ticks["device_quaternion"], atol=1e-15)
    np.testing.assert_allclose(table[:, 0], 1e-3 * np.arange(100), atol=1e-12)


def table(steps: float, lengths: float, count: int = 30) -> str:
    """Returns a motion of 1 cm at 100 rows a second, with times and lengths multiplied."""
    rows = "".join(
        f"{0.01 * steps * i:.6g},{lengths * 0.01 * np.sin(0.3 * i):.6g},0,0\n" for i in range(count)
    )
    return "t,x,y,z\n" + rows


MISTAKEN = [
    (
        "t,x,y,z\n1403636580838555648,0,0,0\n1403636580843555648,0,0,0\n",
        r"line 2: t = 1\.40364e\+18 is beyond ±1e\+12; times are in s, and .* a clock in ns$",
    ),
    ("t,x,y,z\n0,0,0,0\n1764583399000,0,0,0\n", r"line 3: t = .* and this is one of .* in ms$"),
    ("t,x,y,z\n0,0,0,0\n1,1e13,0,0\n", r"line 3: x = 1e\+13 is beyond ±1e\+12$"),
    (table(1, 1e6), "spans 19900 m at .*; positions are in m and times in s$"),
    (table(1, 1e3), "spans 19.9 m .* if these are mm, divide them by 1000"),
    (table(1e3, 1e3), "rows 10 s apart, as times in ms have; .* if these are mm"),
    (table(1e9, 1e3), r"rows 10000000 s apart, as times in ns have; .* if these are mm"),
    ("t_ms,x,y,z\n0,0,0,0\n1,0,0,0\n", "'t_ms' looks like ms; .* name the column t"),
    ("t,x_mm,y_mm,z_mm\n0,0,0,0\n1,0,0,0\n", "'x_mm' looks like mm; .* name the column x"),
    ("t [s],x [mm],y [mm]\n", r"'x \[mm\]' looks like mm; .* name the column x"),
    ("t (ms),x,y,z\n", r"'t \(ms\)' looks like ms; .* name the column t"),
]


@pytest.mark.parametrize(("text", "words"), MISTAKEN)
def test_a_file_in_other_units_is_refused_with_the_unit(
    tmp_path: Path, text: str, words: str
) -> None:
    (tmp_path / "hand.csv").write_text(text)
    with pytest.raises(DeviceError, match=words):
        read_motion(tmp_path / "hand.csv")


@pytest.mark.parametrize(("unit", "count"), [("ms", 1000), ("µs", 1000000), ("ns", 1000000000)])
def test_times_in_smaller_units_are_said_and_run(tmp_path: Path, unit: str, count: int) -> None:
    (tmp_path / "hand.csv").write_text(table(count, 1))
    with pytest.warns(UserWarning, match=f"rows are .* if these are {unit}, divide by {count}$"):
        assert read_motion(tmp_path / "hand.csv").duration == pytest.approx(0.29 * count)


@pytest.mark.parametrize("factor", [1000, 1_000_000])
@pytest.mark.parametrize("is_stamped", [False, True])
def test_times_of_a_bag_in_larger_units_are_said(
    tmp_path: Path, factor: int, *, is_stamped: bool
) -> None:
    true = [10**18 + 40_000_000 * i // 2 for i in range(30)]  # 50 Hz, over 0.58 s
    poses = [
        (at // factor, pose_message(at // factor if is_stamped else 0, 1e-3 * i))
        for i, at in enumerate(true)
    ]
    (file,) = bag(tmp_path / "walk", {"/hand": poses}).glob("*.mcap")
    with pytest.warns(UserWarning, match=r"rows are .* apart, .* wrote µs or ms there, multiply"):
        assert read_bag(file).duration == pytest.approx(0.58 / factor)


def test_a_slow_walk_and_a_few_rows_are_no_mistake(tmp_path: Path) -> None:
    walk = "".join(f"{i},{0.5 * i},0,0\n" for i in range(19))
    (tmp_path / "hand.csv").write_text("t,x,y,z\n" + walk)
    assert read_motion(tmp_path / "hand.csv").duration == 18
    (tmp_path / "hand.csv").write_text(table(1, 1))
    assert read_motion(tmp_path / "hand.csv").duration == pytest.approx(0.29)


@pytest.mark.filterwarnings("error")
def test_poses_in_bursts_are_no_times_in_another_unit(tmp_path: Path) -> None:
    """A receiver stamps what a network held back: three poses within 6 µs, every 60 ms."""
    times = [0.06 * (i // 3) + 3e-6 * (i % 3) for i in range(90)]
    rows = [f"{at:.6f},{1e-3 * i},0,0\n" for i, at in enumerate(times)]
    (tmp_path / "hand.csv").write_text("t,x,y,z\n" + "".join(rows))
    assert read_motion(tmp_path / "hand.csv").duration == pytest.approx(1.740006)
    (tmp_path / "hand.csv").write_text("t,x,y,z\n" + "".join(rows[:30] + rows[45:]))
    with pytest.warns(UserWarning, match=r"from 0\.54 to 0\.90 s, where poses are 0\.06 s apart"):
        read_motion(tmp_path / "hand.csv")


@pytest.mark.parametrize("is_bag", [False, True])
def test_a_gap_between_poses_is_told(tmp_path: Path, *, is_bag: bool) -> None:
    """Poses every 10 ms, of which a recorder lost those of 0.5 s, and once those of 0.25 s too."""

    def read(kept: list[int]) -> Motion:
        if is_bag:
            folder = bag(tmp_path / f"{len(kept)}", {"/hand": [ramp(200)[i] for i in kept]})
            return read_bag(next(folder.glob("*.mcap")))
        rows = "".join(f"{0.01 * i:.2f},{1e-3 * i},0,0\n" for i in kept)
        (tmp_path / "hand.csv").write_text("t,x,y,z\n" + rows)
        return read_motion(tmp_path / "hand.csv")

    once = [i for i in range(200) if not 50 < i < 100]
    twice = [i for i in once if not 120 < i < 145]
    with pytest.warns(UserWarning, match=r"no pose from 0\.50 to 1\.00 s, where poses are 0\.01 s"):
        assert read(once).duration == pytest.approx(1.99)
    with pytest.warns(UserWarning, match=r"no pose from 0\.50 to 1\.00 s \(the longest of 2 gaps"):
        read(twice)
    read(list(range(0, 200, 2)))


@pytest.mark.parametrize("text", ["0_1", "٠.٠١"])
def test_numbers_in_another_notation_are_refused_at_their_line(tmp_path: Path, text: str) -> None:
    path = tmp_path / "motion.csv"
    path.write_text(f"t,x,y,z\n0,0,0,0\n1,{text},0,0\n", encoding="utf-8")
    with pytest.raises(DeviceError, match=r"line 3: column 'x' holds .* not a number"):
        open_device(f"trajectory:{path}")


@pytest.mark.parametrize(
    "time", ["0:00:00.01", "00:00.01", "2024-05-01T12:00:00Z", "05/01/24 12:00:00 PM"]
)
def test_a_time_of_day_is_told_from_seconds(time: str, tmp_path: Path) -> None:
    path = tmp_path / "motion.csv"
    path.write_text(f"t,x,y,z\n{time},0,0,0\n1,0,0,0\n")
    with pytest.raises(DeviceError, match=r"line 2: column 't' holds .* a date; times are in s"):
        read_motion(path)
    path.write_text(f"t,x,y,z\n0,{time},0,0\n1,0,0,0\n")
    with pytest.raises(DeviceError, match=r"column 'x' holds .*, which is not a number"):
        read_motion(path)


def test_check_takes_what_trajectory_takes(tmp_path: Path) -> None:
    folder, scene = bag(tmp_path / "walk", {"/hand": ramp()}), load_scene("point_mass")
    expected = motion_for(scene, next(folder.glob("*.mcap")))
    assert expected is not None
    for place in (folder, f"{folder}:/hand"):
        found = motion_for(scene, place)
        assert found is not None
        assert np.array_equal(found.table, expected.table)


def test_a_split_bag_is_told_with_what_joins_it(tmp_path: Path) -> None:
    folder = bag(tmp_path / "walk", {"/hand": ramp()})
    (file,) = folder.glob("*.mcap")
    (folder / "walk_1.mcap").write_bytes(file.read_bytes())
    for place in (folder, f"{folder}:/hand"):
        with pytest.raises(DeviceError, match="or let 'ros2 bag convert' write the whole bag into"):
            open_device(f"trajectory:{place}")
    listed = (folder / "metadata.yaml").read_text()
    (folder / "metadata.yaml").unlink()  # as a recorder that is killed leaves it
    for number in (2, 10):
        (folder / f"walk_{number}.mcap").write_bytes(file.read_bytes())
    in_order = "'walk_1.mcap', 'walk_2.mcap', 'walk_10.mcap', or let 'ros2 bag reindex'"
    with pytest.raises(DeviceError, match=in_order):
        open_device(f"trajectory:{folder}")
    for number in (1, 2, 10):
        (folder / f"walk_{number}.mcap").unlink()
    assert listed.count(f"- {file.name}\n") == 1
    split = listed.replace(f"- {file.name}\n", f"- {file.name}\n  - walk_1.mcap\n")
    (folder / "metadata.yaml").write_text(split)
    for place in (folder, f"{folder}:/hand"):
        with pytest.raises(DeviceError, match=f"2 files, and only .* '{file.name}' itself to take"):
            open_device(f"trajectory:{place}")
    assert open_device(f"trajectory:{file}").info.duration == pytest.approx(0.04, abs=1e-12)


def test_a_damaged_recording_is_no_motion_and_a_cut_one_says_so(tmp_path: Path) -> None:
    scene, run = load_scene("point_mass"), tmp_path / "run.mcap"
    recorded(run, "point_mass", duration=2.0)
    whole = run.read_bytes()
    run.write_bytes(whole + b"more")
    for read in (lambda: open_device(f"trajectory:{run}"), lambda: motion_for(scene, run)):
        with pytest.raises(DeviceError, match=r"is damaged: its end is fo.*; so it is no motion"):
            read()
    run.write_bytes(whole[: int(0.97 * len(whole))])
    for read in (lambda: open_device(f"trajectory:{run}"), lambda: motion_for(scene, run)):
        with pytest.warns(UserWarning, match="its end is missing.*; the motion ends there"):
            read()


def test_time_that_a_recorded_run_skipped_is_told(tmp_path: Path) -> None:
    rows = np.zeros(1000, TICK_DTYPE)
    rows["tick"], rows["device_quaternion"] = np.arange(1000), (1.0, 0.0, 0.0, 0.0)
    rows["deadline_ns"] = 10**6 * (rows["tick"] + 1 + np.where(rows["tick"] < 400, 0, 300))
    write_recording(tmp_path / "paused.mcap", rows)
    open_device(f"trajectory:{tmp_path / 'paused.mcap'}")  # between two runs
    rows["flags"][400] = hb.TickFlag.OVERRUN
    write_recording(tmp_path / "late.mcap", rows)
    with pytest.warns(UserWarning, match=r"skipped deadlines, 0\.3 s in all; .*that much shorter"):
        open_device(f"trajectory:{tmp_path / 'late.mcap'}")


@pytest.mark.parametrize("ending", [".db3", ".bag", ".zstd", ".gz"])
@pytest.mark.parametrize("begin", [b"", bytes(4096)])
def test_a_file_that_is_not_what_its_ending_says_is_called_so(
    ending: str, begin: bytes, tmp_path: Path
) -> None:
    path = tmp_path / f"hand{ending}"
    with pytest.raises(DeviceError, match="no such file"):
        open_device(f"trajectory:{path}")
    path.write_bytes(begin)
    with pytest.raises(DeviceError, match=f"damaged, empty or misnamed.* the ending {ending}"):
        open_device(f"trajectory:{path}")


def test_a_bag_in_sqlite_and_a_folder_of_several_are_told(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    bag.mkdir()
    (bag / "bag_0.db3").write_bytes(b"SQLite format 3\0")
    for path in (bag, bag / "bag_0.db3", f"{bag}:/pose"):
        with pytest.raises(DeviceError, match="in SQLite; 'ros2 bag convert' writes it in MCAP"):
            open_device(f"trajectory:{path}")
    for name in ("a.mcap", "b.mcap", "notes.gz"):
        (tmp_path / name).touch()
    for path in (tmp_path, f"{tmp_path}:/pose"):
        with pytest.raises(DeviceError, match=r"of 2 files; name one of 'a\.mcap', 'b\.mcap'"):
            open_device(f"trajectory:{path}")
    (tmp_path / "hand.csv").write_text(table(1, 1))
    with pytest.raises(DeviceError, match="'/pose', is of a bag in MCAP, which this is not"):
        open_device(f"trajectory:{tmp_path / 'hand.csv'}:/pose")
