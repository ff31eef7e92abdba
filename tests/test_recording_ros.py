"""ROS 2 messages of a recording: other programs read them, and they follow from the ticks."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import SeekingReader, make_reader
from mcap.writer import IndexType, Writer
from mcap_ros2.decoder import DecoderFactory
from recording_cases import EPOCH, META, random_rows, write
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

import hapticbridge as hb
from hapticbridge.audit import audit
from hapticbridge.recording import RecordingWriter, read_recording
from hapticbridge.recording.ros_messages import RATE, TOPICS, Messages
from hapticbridge.recording.writer import repair

TURN = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
"""Rotation from the device's frame to the scene's: its x is the scene's y."""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("run") / "run.mcap"
    options = hb.BridgeOptions(workspace=hb.Workspace(axes=tuple(np.ravel(TURN))))
    with hb.Bridge(
        "open_wrench", "simulated", options=options, clock=hb.SimulatedClock(), recording=path
    ) as bridge:
        bridge.run(duration=1.5)
    return path


def decoded(path: Path) -> dict[str, list[tuple[int, Any]]]:
    found: dict[str, list[tuple[int, Any]]] = {topic: [] for topic in TOPICS}
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        for _, channel, message, value in reader.iter_decoded_messages(topics=list(TOPICS)):
            found[channel.topic].append((message.log_time, value))
    return found


def numbers(value: Any, names: str) -> list[float]:
    return [getattr(value, name) for name in names]


def test_poses_and_wrenches_are_those_of_the_ticks(run: Path) -> None:
    recording, found = read_recording(run), decoded(run)
    epoch = int(recording.meta["epoch_ns"])
    rows = {epoch + int(row["deadline_ns"]): row for row in recording.ticks}
    for topic in TOPICS.keys() - {"/rosout"}:
        assert len(found[topic]) == pytest.approx(RATE * 1.5, abs=1)
        for time, value in found[topic]:
            stamped = value.transforms[0] if topic == "/tf" else value
            stamp = stamped.header.stamp
            assert stamp.sec * 10**9 + stamp.nanosec == time
            assert time in rows
    for frame in ("handle", "tool"):
        for time, value in found[f"/{frame}_pose"]:
            row, pose = rows[time], value.pose
            assert value.header.frame_id == "world"
            assert numbers(pose.position, "xyz") == row[f"{frame}_position"].tolist()
            assert numbers(pose.orientation, "wxyz") == row[f"{frame}_quaternion"].tolist()
    for time, value in found["/tf"]:
        for transform, frame in zip(value.transforms, ("handle", "tool"), strict=True):
            row, moved = rows[time], transform.transform
            assert (transform.header.frame_id, transform.child_frame_id) == ("world", frame)
            assert numbers(moved.translation, "xyz") == row[f"{frame}_position"].tolist()
            assert numbers(moved.rotation, "wxyz") == row[f"{frame}_quaternion"].tolist()
    for side, frame, field, axes in (
        ("hand", "handle", "wrench_on_device", np.array(TURN)),
        ("tool", "tool", "wrench_on_tool", np.eye(3)),
    ):
        largest = 0.0
        for time, value in found[f"/wrench_on_{side}"]:
            row = rows[time]
            quaternion = row[f"{frame}_quaternion"]
            back = Rotation.from_quat(np.roll(quaternion, -1)).inv()
            for start, part in ((0, value.wrench.force), (3, value.wrench.torque)):
                expected = back.apply(axes @ row[field][start : start + 3])
                np.testing.assert_allclose(numbers(part, "xyz"), expected, atol=1e-12)
                largest = max(largest, float(np.abs(expected).max()))
            assert value.header.frame_id == frame
        assert largest > 0.1, "the hand felt something"


def test_events_are_lines_of_the_log(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    writer = RecordingWriter(path, META, (), EPOCH)
    writer.write_event({"event": "start"}, 0)
    writer.write_event({"event": "trip", "why": "too far, µ"}, 1_500_000_000)
    writer.close()
    lines = [value for _, value in decoded(path)["/rosout"]]
    assert [(line.level, line.name) for line in lines] == [
        (20, "hapticbridge"),
        (40, "hapticbridge"),
    ]
    assert json.loads(lines[1].msg)["why"] == "too far, µ"
    assert lines[1].stamp.sec * 10**9 + lines[1].stamp.nanosec == EPOCH + 1_500_000_000


def test_rosbags_reads_every_topic(run: Path) -> None:
    seen: dict[str, int] = {}
    texts = []
    with AnyReader([run]) as reader:
        types = {each.topic: each.msgtype for each in reader.connections}
        for connection, _, raw in reader.messages():
            seen[connection.topic] = seen.get(connection.topic, 0) + 1
            message: Any = reader.deserialize(raw, connection.msgtype)
            if connection.topic == "/event":
                texts.append(json.loads(message.data))
    assert {topic: types[topic] for topic in TOPICS} == {
        topic: name for topic, (name, _) in TOPICS.items()
    }
    assert seen["/tick"] == 1500
    assert seen["/rosout"] == seen["/event"] > 0
    assert texts == read_recording(run).events


def test_units_stand_in_the_schemas(run: Path) -> None:
    with run.open("rb") as stream:
        summary = SeekingReader(stream).get_summary()
    assert summary is not None
    texts = {schema.name: schema.data.decode() for schema in summary.schemas.values()}
    assert "force # N\n" in texts["geometry_msgs/msg/WrenchStamped"]
    assert "position # m\n" in texts["geometry_msgs/msg/PoseStamped"]
    assert "float64 kinetic # J\n" in texts["hapticbridge/msg/Tick"]


@pytest.mark.parametrize("batch", [1, 7, 5000])
def test_batches_do_not_matter_whatever_the_numbers(tmp_path: Path, batch: int) -> None:
    write(tmp_path / "run.mcap", random_rows(2000), batch=batch)
    assert read_recording(tmp_path / "run.mcap").problems == ()


def test_a_recording_without_them_is_read_as_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hapticbridge.recording.ros_messages.TOPICS", {})
    monkeypatch.setattr(Messages, "of_ticks", lambda *_: {})
    monkeypatch.setattr(RecordingWriter, "write_event", lambda *_: None)
    write(tmp_path / "run.mcap", random_rows(500))
    monkeypatch.undo()
    assert read_recording(tmp_path / "run.mcap").problems == ()


@pytest.mark.parametrize("topic", ["/tf", "/wrench_on_hand", "/rosout"])
def test_messages_that_say_something_else_are_found_in_a_file_with_right_checksums(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, topic: str
) -> None:
    """A forger can write all checksums anew; the messages contradict the ticks."""
    true_ticks, true_event = Messages.of_ticks, Messages.of_event

    def other_ticks(self: Messages, rows: np.ndarray) -> dict[str, np.ndarray]:
        found = true_ticks(self, rows)
        if topic in found:
            changed = bytearray(found[topic]["payload"][0].tobytes())
            changed[-2] ^= 1
            found[topic]["payload"][0] = np.void(bytes(changed))
        return found

    def other_event(self: Messages, payload: bytes, *rest: Any) -> tuple[int, bytes]:
        said = payload.replace(b"start", b"sturt") if topic == "/rosout" else payload
        return true_event(self, said, *rest)

    cut = tmp_path / "cut.mcap"
    cut.write_bytes(run.read_bytes()[:-30])  # 'repair' writes whole files anew
    forged, honest = tmp_path / "forged.mcap", tmp_path / "honest.mcap"
    with monkeypatch.context() as change:
        change.setattr(Messages, "of_ticks", other_ticks)
        change.setattr(Messages, "of_event", other_event)
        repair(cut, forged)
    repair(cut, honest)
    assert read_recording(honest).problems == ()
    (problem,) = read_recording(forged).problems
    assert problem == f"what '{topic}' say does not follow from the ticks and events"
    report = audit(forged)
    assert report.verdict != "passive"
    assert problem in report.reason


def test_a_schema_that_names_other_numbers_is_found(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The bytes are those of the ticks, but a reader would take x for y."""
    cut, forged = tmp_path / "cut.mcap", tmp_path / "forged.mcap"
    cut.write_bytes(run.read_bytes()[:-30])
    name, text = TOPICS["/tool_pose"]
    swapped = text.replace(b"Point\nfloat64 x\nfloat64 y", b"Point\nfloat64 y\nfloat64 x")
    assert swapped != text
    with monkeypatch.context() as change:
        change.setitem(TOPICS, "/tool_pose", (name, swapped))
        repair(cut, forged)
    problems = read_recording(forged).problems
    assert any("/tool_pose has another schema" in problem for problem in problems)
    assert audit(forged).verdict != "passive"


WITHOUT_SUMMARY: dict[str, Any] = {
    "index_types": IndexType.NONE,
    "repeat_channels": False,
    "repeat_schemas": False,
    "use_statistics": False,
    "use_summary_offsets": False,
}


def written_anew(
    path: Path,
    output: Path,
    *,
    is_forged: bool = False,
    step: int = 1,
    first: tuple[str, ...] = (),
    **options: Any,
) -> None:
    """Writes a recording with the library: topic after topic, and the metadata at the end."""
    with path.open("rb") as source, output.open("wb") as target:
        reader, writer = SeekingReader(source), Writer(target, **options)
        writer.start(profile="ros2")
        ids: dict[str, int] = {}

        def place(message: Any) -> tuple[bool, str]:
            return message[1].topic not in first, message[1].topic

        messages = list(reader.iter_messages(log_time_order=False))
        for schema, channel, message in sorted(messages, key=place)[::step]:
            assert schema is not None
            if channel.topic not in ids:
                known = writer.register_schema(schema.name, schema.encoding, schema.data)
                ids[channel.topic] = writer.register_channel(channel.topic, "cdr", known)
            data = bytearray(message.data)
            data[-2] ^= is_forged and channel.topic == "/tf"
            writer.add_message(ids[channel.topic], message.log_time, bytes(data), message.log_time)
        for metadata in reader.iter_metadata():
            writer.add_metadata(metadata.name, metadata.metadata)
        for item in reader.iter_attachments():
            writer.add_attachment(0, 0, item.name, item.media_type, item.data)
        writer.finish()  # type: ignore[no-untyped-call]


def test_order_of_topics_and_metadata_is_no_damage_but_what_they_say_and_ticks_backwards_are(
    run: Path, tmp_path: Path
) -> None:
    path = tmp_path / "anew.mcap"
    written_anew(run, path, is_forged=False)
    recording = read_recording(path)
    assert (recording.problems, recording.meta) == ((), read_recording(run).meta)
    assert audit(path).verdict == "passive"
    written_anew(run, path, is_forged=True)
    assert read_recording(path).problems == (
        "what '/tf' say does not follow from the ticks and events",
    )
    written_anew(run, path, is_forged=False, step=-1)
    assert read_recording(path).problems == (
        "its ticks are not in order: tick 1499 is followed by tick 1498",
    )


@pytest.mark.parametrize("topics", [("/tick",), ("/event",), ("/tick", "/event"), ("/rosout",)])
def test_a_file_without_summary_may_name_the_topics_of_ros_after_the_ticks(
    run: Path, tmp_path: Path, topics: tuple[str, ...]
) -> None:
    path = tmp_path / "anew.mcap"
    written_anew(run, path, first=topics, **WITHOUT_SUMMARY)
    recording = read_recording(path)
    assert recording.problems == ()
    assert recording.ticks.tobytes() == read_recording(run).ticks.tobytes()
    assert audit(path).verdict == "passive"
    written_anew(run, path, is_forged=True, first=topics, **WITHOUT_SUMMARY)
    (problem,) = read_recording(path).problems
    assert problem == "what '/tf' say does not follow from the ticks and events"


def test_stamps_keep_their_last_second_in_2038_and_log_times_go_on(tmp_path: Path) -> None:
    """The seconds of a stamp are a signed number of 32 bits, whose last is 2^31 - 1."""
    path, begin = tmp_path / "late.mcap", 2**31 * 10**9 - 100_000_000
    writer = RecordingWriter(path, META, (), begin)
    writer.write_event({"event": "start"}, 0)
    writer.write_ticks(random_rows(300))
    writer.write_event({"event": "mark"}, 300_000_000)
    writer.close()
    found = decoded(path)
    last = (2**31 - 1, 999_999_999)
    for topic in ("/tool_pose", "/rosout"):
        stamps = [
            (stamp.sec, stamp.nanosec)
            for _, value in found[topic]
            for stamp in [value.stamp if topic == "/rosout" else value.header.stamp]
        ]
        times = [time for time, _ in found[topic]]
        assert max(times) > 2**31 * 10**9
        assert stamps == [min(divmod(time, 10**9), last) for time in times]
    assert read_recording(path).problems == ()
