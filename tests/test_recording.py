"""Recordings: what survives the file, what MCAP's own library reads, repair and refusals."""

from __future__ import annotations

import errno
import io
import json
import resource
import shutil
import sys
import tempfile
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader, SeekingReader
from mcap.writer import Writer
from mcap_ros2.decoder import DecoderFactory
from recording_cases import EPOCH, FILES, META, chunk_ends, random_rows, same, write

from hapticbridge.errors import RecordingError
from hapticbridge.record import TICK_DTYPE
from hapticbridge.recording import Attachment, RecordingWriter, read_recording, repair
from hapticbridge.recording import format as layout
from hapticbridge.recording.reader import _join
from hapticbridge.recording.writer import RESERVE


@given(
    records=st.lists(
        st.binary(min_size=TICK_DTYPE.itemsize, max_size=TICK_DTYPE.itemsize), max_size=5
    ),
    meta=st.dictionaries(
        st.text(st.characters(codec="utf-8")), st.text(st.characters(codec="utf-8")), max_size=3
    ),
    data=st.binary(max_size=50),
)
@settings(max_examples=60)
def test_any_record_metadata_and_attachment_survive_the_file(
    records: list[bytes], meta: dict[str, str], data: bytes
) -> None:
    rows = np.frombuffer(b"".join(records), TICK_DTYPE)
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "run.mcap"
        writer = RecordingWriter(path, meta, [Attachment("file", "type", data)], EPOCH)
        writer.write_ticks(rows)
        writer.close()
        recording = read_recording(path)
    assert same(recording.ticks, rows)
    assert recording.meta == {**meta, "epoch_ns": str(EPOCH)}
    assert recording.attachments == {"file": data}
    assert recording.digest == recording.computed_digest
    assert not recording.is_cut
    assert recording.problems == ()


@pytest.mark.parametrize("batch", [1, 7, 300, 5000])
def test_events_between_records_change_neither(tmp_path: Path, batch: int) -> None:
    rows = random_rows(900)
    write(tmp_path / "run.mcap", rows, batch=batch)
    recording = read_recording(tmp_path / "run.mcap")
    assert same(recording.ticks, rows)
    assert recording.events[0] == {"event": "start", "time_ns": 0}
    assert [event["after"] for event in recording.events[1:]] == list(range(0, 900, batch))
    assert recording.digest == recording.computed_digest


def test_library_decodes_the_same_numbers_with_valid_checksums(whole: Path) -> None:
    rows = random_rows(1500)
    with whole.open("rb") as stream:
        reader = NonSeekingReader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        decoded = [
            (message, record)
            for _, _, message, record in reader.iter_decoded_messages(topics=["/tick"])
        ]
    assert len(decoded) == 1500
    for row, (message, record) in zip(rows, decoded, strict=True):
        assert message.log_time == EPOCH + row["deadline_ns"]
        for name in TICK_DTYPE.names or ():
            np.testing.assert_array_equal(getattr(record, name), row[name])


def test_library_reads_events_metadata_and_attachments_in_time_order(whole: Path) -> None:
    with whole.open("rb") as stream:
        reader = SeekingReader(stream, validate_crcs=True)
        times = [message.log_time for _, _, message in reader.iter_messages()]
        events = [json.loads(m.data) for _, _, m in reader.iter_messages(topics=["/event"])]
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
        attachments = {item.name: item.data for item in reader.iter_attachments()}
    assert times == sorted(times)
    assert events == read_recording(whole).events
    assert metadata["hapticbridge"]["µ"] == "ü"
    assert metadata["hapticbridge.digest"]["sha256"] == read_recording(whole).computed_digest
    assert attachments == {item.name: item.data for item in FILES}


def test_schema_lists_every_field_with_its_type() -> None:
    lines = layout.tick_schema().decode().splitlines()
    assert lines[0] == "int64 tick"
    assert "float64[3] device_position" in lines
    assert "float64[6] wrench_on_device" in lines
    assert "float64 share" in lines
    assert len(lines) == len(TICK_DTYPE.names or ())


def test_event_of_a_trip_is_written_whatever_it_holds() -> None:
    event = {
        "event": "trip",
        "force": float("nan"),
        "pose": np.array([1.0, np.inf]),
        "count": np.int64(3),
        "is_hard": np.bool_(True),
        "deep": {"tuple": (1, None)},
        "object": Path("a"),
    }
    assert json.loads(layout.event_payload(event, 5)) == {
        "event": "trip",
        "force": "nan",
        "pose": [1.0, "inf"],
        "count": 3,
        "is_hard": True,
        "deep": {"tuple": [1, None]},
        "object": "a",
        "time_ns": 5,
    }


def test_repair_keeps_all_that_is_left_and_makes_it_whole(whole: Path, tmp_path: Path) -> None:
    cut, mended = tmp_path / "cut.mcap", tmp_path / "mended.mcap"
    cut.write_bytes(whole.read_bytes()[: chunk_ends(whole)[2][0] + 100])
    before = read_recording(cut)
    after = repair(cut, mended)
    assert not after.is_cut
    assert after.problems == ()
    assert after.digest == after.computed_digest
    assert same(after.ticks, before.ticks)
    assert after.meta == before.meta
    assert after.attachments == before.attachments
    assert after.events[:-1] == before.events
    assert after.events[-1]["event"] == "repaired"
    assert after.events[-1]["ticks"] == before.ticks.size
    with mended.open("rb") as stream:
        attachments = list(SeekingReader(stream, validate_crcs=True).iter_attachments())
    assert [item.media_type for item in attachments] == [item.media_type for item in FILES]


def test_repair_refuses_what_is_whole_and_what_exists(whole: Path, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="is not cut"):
        repair(whole, tmp_path / "new.mcap")
    assert not (tmp_path / "new.mcap").exists()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[:-20])
    before = cut.read_bytes()
    with pytest.raises(RecordingError, match="exists"):
        repair(cut, cut)
    assert cut.read_bytes() == before


def test_whole_chunks_reach_the_file_before_it_is_closed(tmp_path: Path) -> None:
    path, copy = tmp_path / "run.mcap", tmp_path / "copy.mcap"
    writer = write(path, random_rows(1000), batch=1000, events=False, close=False)
    shutil.copy(path, copy)
    writer.close()
    recording = read_recording(copy)
    assert recording.is_cut
    lost = 1000 - recording.ticks.size
    size = 35 + TICK_DTYPE.itemsize  # heads of message and payload, and the record
    assert 0 <= lost * size <= layout.CHUNK_SIZE + size
    assert read_recording(path).ticks.size == 1000


def test_runs_of_records_are_let_go_as_they_are_joined() -> None:
    """A file read into memory would be there twice at the end: 0.5 GB of ten minutes at 1 kHz."""
    rows = random_rows(10)
    runs = [rows[:3], rows[3:3], rows[3:]]
    assert _join(runs).tobytes() == rows.tobytes()
    assert runs == []


def test_memory_of_the_writer_does_not_grow_with_the_length_of_a_run(tmp_path: Path) -> None:
    """Its index of chunks waits on disk; as the library keeps it, 44 chunks take 40 kB."""
    rows, path = random_rows(3000), tmp_path / "run.mcap"
    writer = RecordingWriter(path, META, FILES, EPOCH)
    held = []
    # what else runs in this process, such as the tests' own messages, is not the writer's
    ours = [tracemalloc.Filter(True, f"*/{name}/*") for name in ("mcap", "hapticbridge")]
    tracemalloc.start()
    try:
        for start in range(0, 5 * rows.size, rows.size):
            rows["deadline_ns"] = (np.arange(start, start + rows.size) + 1) * 1_000_000
            for first in range(0, rows.size, 100):
                writer.write_ticks(rows[first : first + 100])
            writer._mcap.flush()  # type: ignore[no-untyped-call]
            taken = tracemalloc.take_snapshot().filter_traces(ours)
            held.append(sum(trace.size for trace in taken.traces))
    finally:
        tracemalloc.stop()
    writer.close()
    assert held[-1] - held[0] < 1024
    assert list(tmp_path.iterdir()) == [path]
    ends = chunk_ends(path)
    assert len(ends) == 55
    assert path.read_bytes()[ends[-1][0]] == Opcode.MESSAGE_INDEX


def test_an_index_that_finds_no_room_ends_the_recording_in_a_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = Path("/dev/full")
    monkeypatch.setattr(tempfile, "TemporaryFile", lambda **_: full.open("wb", buffering=0))
    writer = RecordingWriter(tmp_path / "run.mcap", META, FILES, EPOCH)
    with pytest.raises(RecordingError, match=r"cannot write the recording .*No space left"):
        writer.write_ticks(random_rows(1000))
    recording = read_recording(tmp_path / "run.mcap")
    assert recording.is_cut
    assert recording.ticks.size > 0


def test_a_folder_that_takes_no_other_file_still_takes_a_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make = tempfile.TemporaryFile

    def elsewhere(dir: Path | None = None, **options: Any) -> Any:  # noqa: A002
        if dir == tmp_path:
            raise PermissionError(errno.EACCES, "Permission denied")
        return make(**options)

    monkeypatch.setattr(tempfile, "TemporaryFile", elsewhere)
    assert same(
        read_recording(write(tmp_path / "run.mcap", random_rows(900)).path).ticks, random_rows(900)
    )


def test_recording_without_a_tick_is_whole(tmp_path: Path) -> None:
    write(tmp_path / "run.mcap", random_rows(0), events=False)
    recording = read_recording(tmp_path / "run.mcap")
    assert recording.ticks.size == 0
    assert not recording.is_cut
    assert recording.digest == recording.computed_digest


def mcap_with(topic: str, schema: str, text: bytes) -> bytes:
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start()
    channel = writer.register_channel(topic, "cdr", writer.register_schema(schema, "ros2msg", text))
    writer.add_message(channel, 0, b"\x00\x01\x00\x00", 0)
    writer.finish()  # type: ignore[no-untyped-call]
    return stream.getvalue()


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "is empty"),
        (b"t,x,y,z\n0,0,0,0\n", "not an MCAP file"),
        (mcap_with("/imu", "sensor_msgs/msg/Imu", b"int64 a"), "no topic /tick"),
        (mcap_with("/tick", "other/msg/Tick", b"int64 a"), "has the schema 'other/msg/Tick'"),
        (mcap_with("/tick", "hapticbridge/msg/Tick", b"int64 tick"), "has other fields"),
    ],
)
def test_file_that_is_no_recording_is_refused_in_one_sentence(
    tmp_path: Path, content: bytes, reason: str
) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=reason) as refusal:
        read_recording(path)
    assert str(path) in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_path_that_cannot_be_read_is_refused(tmp_path: Path) -> None:
    for path, reason in (
        (tmp_path / "none.mcap", "No such file"),
        (tmp_path, "it is a folder"),
        (Path("/dev/null"), "not a regular file"),
        (tmp_path / "a\0b", "null"),
    ):
        with pytest.raises(RecordingError, match=reason):
            read_recording(path)


def test_writer_refuses_what_it_cannot_write(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"the folder .* does not exist"):
        RecordingWriter(tmp_path / "none" / "run.mcap", META, (), EPOCH)
    with pytest.raises(RecordingError, match="Is a directory"):
        RecordingWriter(tmp_path, META, (), EPOCH)
    with pytest.raises(RecordingError, match="No space left"):
        RecordingWriter("/dev/full", META, (), EPOCH)
    with pytest.raises(RecordingError, match="two attachments are named 'empty'"):
        RecordingWriter(tmp_path / "run.mcap", META, (*FILES, FILES[2]), EPOCH)
    with pytest.raises(RecordingError, match="valid Unicode"):
        RecordingWriter(tmp_path / "run.mcap", {"a": "\udc80"}, (), EPOCH)
    with pytest.raises(RecordingError, match="must be text, not 3"):
        RecordingWriter(tmp_path / "run.mcap", {"a": 3}, (), EPOCH)  # type: ignore[dict-item]
    assert not (tmp_path / "run.mcap").exists()


@pytest.mark.skipif(sys.platform != "linux", reason="room can be claimed on Linux alone")
def test_room_for_the_end_is_claimed_ahead_and_given_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "run.mcap"
    writer = RecordingWriter(path, META, FILES, EPOCH)
    writer.write_ticks(np.zeros(1000, TICK_DTYPE))
    assert path.stat().st_blocks * 512 > RESERVE > 20 * path.stat().st_size
    assert not writer.is_full
    # from here on the file may not grow by more than it has claimed, as on a full disk
    monkeypatch.setattr(writer._output, "_allocate", lambda *_: errno.ENOSPC)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + RESERVE, limits[1]))
    try:
        writer.write_ticks(random_rows(2000))
        assert writer.is_full
        writer.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    # what is not used is given back: on ext4 by the length alone, elsewhere as a hole
    assert path.stat().st_blocks * 512 < path.stat().st_size + 2**16
    recording = read_recording(path)
    assert (len(recording.ticks), recording.is_cut) == (3000, False)


def test_a_file_that_is_being_recorded_to_is_not_taken_over(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    writer = RecordingWriter(path, {}, (), 0)
    writer.write_ticks(np.zeros(5, TICK_DTYPE))
    with pytest.raises(RecordingError, match="another bridge is recording to it"):
        RecordingWriter(path, {}, (), 0)
    writer.close()
    assert len(read_recording(path).ticks) == 5
    RecordingWriter(path, {}, (), 0).close()
    assert len(read_recording(path).ticks) == 0
