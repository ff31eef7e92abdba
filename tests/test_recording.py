"""Recordings: contents, MCAP's own library, repair, refusals; changes, damage and cuts."""

from __future__ import annotations

import ctypes
import errno
import io
import json
import os
import resource
import shutil
import struct
import sys
import tempfile
import tracemalloc
import zlib
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import IO, Any

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader, SeekingReader
from mcap.writer import Writer
from mcap_ros2.decoder import DecoderFactory
from recording_cases import EPOCH, FILES, META, chunks, random_rows, same, write

from hapticbridge.errors import RecordingError
from hapticbridge.kernel.record import FORMAT, TICK_DTYPE
from hapticbridge.recording import (
    Attachment,
    Recorder,
    Recording,
    RecordingWriter,
    Ring,
    read_recording,
    repair,
)
from hapticbridge.recording import format as layout
from hapticbridge.recording.container import MAGIC, Block, Container, DamageError, Fields, FileBytes
from hapticbridge.recording.writer import RESERVE, ChunkIndexFile


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
def test_any_content_survives(records: list[bytes], meta: dict[str, str], data: bytes) -> None:
    rows = np.frombuffer(b"".join(records), TICK_DTYPE)
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "run.mcap"
        writer = RecordingWriter(path, meta, [Attachment("file", "type", data)], EPOCH)
        writer.write_ticks(rows)
        writer.close()
        recording = read_recording(path)
    assert same(recording.ticks, rows)
    assert recording.meta == {"format": FORMAT, **meta, "epoch_ns": str(EPOCH)}
    assert recording.attachments == {"file": data}
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
        messages = [m.data for _, _, m in reader.iter_messages(topics=["/event"])]
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
        attachments = {item.name: item.data for item in reader.iter_attachments()}
    assert times == sorted(times)
    assert [json.loads(layout.event_of(each)) for each in messages] == read_recording(whole).events
    assert metadata["hapticbridge"]["µ"] == "ü"
    assert attachments == {item.name: item.data for item in FILES}


def test_schema_lists_every_field_with_its_type() -> None:
    lines = layout.tick_schema().decode().splitlines()
    assert lines[0] == "int64 tick"
    assert "float64[3] device_position # m" in lines
    assert "float64[6] wrench_on_device # N, N m" in lines
    assert "float64 lever" in lines
    assert len(lines) == len(TICK_DTYPE.names or ())


def test_event_of_a_trip_is_written_whatever_it_holds() -> None:
    held = {
        "force": (float("nan"), "nan"),
        "pose": (np.array([1.0, np.inf]), [1.0, "inf"]),
        "count": (np.int64(3), 3),
        "is_hard": (np.bool_(True), True),
        "deep": ({"tuple": (1, None)}, {"tuple": [1, None]}),
        "object": (Path("a"), "a"),
    }
    event = {"event": "trip", **{name: given for name, (given, _) in held.items()}}
    written = {"event": "trip", **{name: read for name, (_, read) in held.items()}, "time_ns": 5}
    assert json.loads(layout.event_payload(event, 5)) == written


def test_repair_keeps_all_that_is_left_and_makes_it_whole(whole: Path, tmp_path: Path) -> None:
    cut, mended = tmp_path / "cut.mcap", tmp_path / "mended.mcap"
    cut.write_bytes(whole.read_bytes()[: chunks(whole)[2][1] + 100])
    before = read_recording(cut)
    after = repair(cut, mended)
    assert not after.is_cut
    assert after.problems == ()
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
    damaged, content = tmp_path / "damaged.mcap", bytearray(whole.read_bytes())
    content[content.index(b"application/") + 20] ^= 1
    damaged.write_bytes(content)
    with pytest.raises(RecordingError, match=r"is not cut, only damaged: the .* is damaged"):
        repair(damaged, tmp_path / "new.mcap")
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


def test_the_index_of_chunks_waits_on_disk(tmp_path: Path) -> None:
    """As the library keeps it, 44 chunks take 40 kB of memory."""
    write(tmp_path / "run.mcap", random_rows(900))
    with (tmp_path / "run.mcap").open("rb") as stream:
        summary = SeekingReader(stream).get_summary()
    assert summary is not None
    index = ChunkIndexFile(tmp_path)
    # what else runs in this process, such as the tests' own messages, is not the writer's
    ours = [tracemalloc.Filter(True, f"*/{name}/*") for name in ("mcap", "hapticbridge")]
    held = []
    tracemalloc.start()
    try:
        for _ in range(100):
            index.append(summary.chunk_indexes[0])
            taken = tracemalloc.take_snapshot().filter_traces(ours)
            held.append(sum(trace.size for trace in taken.traces))
    finally:
        tracemalloc.stop()
        index.close()
    assert held[-1] - held[1] < 1024
    assert list(tmp_path.iterdir()) == [tmp_path / "run.mcap"]


@pytest.mark.parametrize("room", [0, 100, 500])
def test_an_index_without_room_on_disk_is_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, room: int
) -> None:
    made = tempfile.TemporaryFile

    def small(**options: Any) -> IO[bytes]:
        file: IO[bytes] = made(**options)
        write, places = file.write, [room]

        def limited(data: bytes) -> int:
            if places[0] == 0:
                places[0] = 10**6  # room was made since
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            places[0] -= (written := write(data[: places[0]]))
            return written

        file.write = limited  # type: ignore[assignment, method-assign]
        return file

    monkeypatch.setattr(tempfile, "TemporaryFile", small)
    writer = RecordingWriter(tmp_path / "run.mcap", META, FILES, EPOCH)
    rows = random_rows(1000)
    writer.write_ticks(rows)
    writer.close()
    recording = read_recording(tmp_path / "run.mcap")
    assert not recording.is_cut
    assert recording.ticks.tobytes() == rows.tobytes()
    with (tmp_path / "run.mcap").open("rb") as stream:
        summary = SeekingReader(stream).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert len(summary.chunk_indexes) == summary.statistics.chunk_count > 3


def test_folder_for_one_file_suffices(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
    assert recording.problems == ()


def mcap_with(topic: str, schema: str, text: bytes, **meta: str) -> bytes:
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start()
    if meta:
        writer.add_metadata("hapticbridge", meta)
    channel = writer.register_channel(topic, "cdr", writer.register_schema(schema, "ros2msg", text))
    writer.add_message(channel, 0, b"\x00\x01\x00\x00", 0)
    writer.finish()  # type: ignore[no-untyped-call]
    return stream.getvalue()


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "is empty"),
        (b"t,x,y,z\n0,0,0,0\n", "not an MCAP file"),
        (mcap_with("/imu", "sensor_msgs/msg/Imu", b"int64 a"), "no topic /tick$"),
        (mcap_with("/tf", "tf/tfMessage", b"int64 a"), "no topic /tick$"),  # and no damage
        (mcap_with("/tick", "other/msg/Tick", b"int64 a"), "has the schema 'other/msg/Tick'"),
        (mcap_with("/tick", "hapticbridge/msg/Tick", b"int64 tick"), "has other fields"),
        (mcap_with("/tick", "hapticbridge/msg/Tick", b"int64 tick", format="0"), "format '0'"),
    ],
)
def test_file_no_recording_is_refused(tmp_path: Path, content: bytes, reason: str) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=reason) as refusal:
        read_recording(path)
    assert str(path) in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_writer_refuses_what_it_cannot_write(tmp_path: Path) -> None:
    path, meta, files = tmp_path / "run.mcap", META, FILES
    wrong: Any = {"a": 3}
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for place, about, attached, words in (
        (tmp_path / "none" / "run.mcap", meta, files, r"the folder .* does not exist"),
        (tmp_path, meta, files, "Is a directory"),
        (Path("/dev/full"), meta, files, "No space left"),
        (pipe, meta, files, "No such device or address"),
        (path, meta, (*files, files[2]), "two attachments are named 'empty'"),
        (path, {"a": "\udc80"}, files, "valid Unicode"),
        (path, wrong, files, "must be text, not 3"),
    ):
        with pytest.raises(RecordingError, match=words):
            RecordingWriter(place, about, attached, EPOCH)
    assert not path.exists()
    for place, words in (
        (tmp_path / "none.mcap", "No such file"),
        (tmp_path, "it is a folder"),
        (Path("/dev/null"), "not a regular file"),
        (tmp_path / "a\0b", "null"),
    ):
        with pytest.raises(RecordingError, match=words):
            read_recording(place)


class Disk:
    """The C library's fallocate, for a disk that may be full."""

    def __init__(self) -> None:
        self.library, self.is_full = ctypes.CDLL(None, use_errno=True), False

    def fallocate64(self, *claim: Any) -> int:
        if self.is_full:
            ctypes.set_errno(errno.ENOSPC)
            return -1
        return int(self.library.fallocate64(*claim))


@pytest.mark.skipif(sys.platform != "linux", reason="room can be claimed on Linux alone")
def test_room_for_the_end_is_claimed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "run.mcap"
    disk = Disk()
    monkeypatch.setattr(ctypes, "CDLL", lambda *_, **__: disk)
    writer = RecordingWriter(path, META, FILES, EPOCH)
    writer.write_ticks(np.zeros(1000, TICK_DTYPE))
    assert path.stat().st_blocks * 512 > RESERVE > 20 * path.stat().st_size
    assert not writer.is_full
    # from here on the file may not grow by more than it has claimed, as on a full disk
    disk.is_full = True
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


def test_a_disk_found_full_before_the_start_is_reported_after_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(RecordingWriter, "is_full", True)
    with closing(Ring.shared(64)) as ring:
        recorder = Recorder(ring, tmp_path / "run.mcap", META, ())
        recorder.start()
        recorder.wait_until_ready()
        ring.append(random_rows(8))
        while ring.pending():  # then it has looked at the disk, or is about to
            assert recorder.is_alive()
        recorder.event({"event": "start"}, 0)
        while not recorder.is_disk_full:
            assert recorder.is_alive()
        recorder.close()
    names = [event["event"] for event in read_recording(tmp_path / "run.mcap").events]
    assert names == ["start", "disk_full"]


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


def rewritten(path: Path, output: Path, change: Callable[[str, Any], Any]) -> None:
    """Copies a recording with the library, with messages changed and all checksums anew."""
    with path.open("rb") as source, output.open("wb") as target:
        reader, writer = SeekingReader(source), Writer(target)
        summary = reader.get_summary()
        assert summary is not None
        writer.start()
        for metadata in reader.iter_metadata():
            writer.add_metadata(metadata.name, metadata.metadata)
        for item in reader.iter_attachments():
            writer.add_attachment(0, 0, item.name, item.media_type, item.data)
        ids = {"/foreign": writer.register_channel("/foreign", "json", 0)}
        for channel in summary.channels.values():
            known = 0
            if schema := summary.schemas.get(channel.schema_id):
                known = writer.register_schema(schema.name, schema.encoding, schema.data)
            ids[channel.topic] = writer.register_channel(
                channel.topic, channel.message_encoding, known
            )
        for _, channel, message in reader.iter_messages(log_time_order=False):
            data = change(channel.topic, bytearray(message.data))
            writer.add_message(ids[channel.topic], message.log_time, bytes(data), message.log_time)
            writer.add_message(ids["/foreign"], message.log_time, b"{}", message.log_time)
        writer.finish()  # type: ignore[no-untyped-call]


def test_a_file_that_another_program_wrote_with_its_channels_is_whole(
    whole: Path, tmp_path: Path
) -> None:
    rewritten(whole, tmp_path / "run.mcap", lambda topic, data: data)
    recording, original = read_recording(tmp_path / "run.mcap"), read_recording(whole)
    assert same(recording.ticks, random_rows(1500))
    for name in ("meta", "attachments", "events"):
        assert getattr(recording, name) == getattr(original, name)
    assert (recording.is_cut, recording.problems) == (False, ())


def first_call(kind: str, edit: Callable[[Any], Any]) -> Callable[[str, Any], Any]:
    remaining = [True]

    def change(found: str, content: Any) -> Any:
        if found == kind and remaining:
            remaining.clear()
            return edit(content)
        return content

    return change


def flipped(position: int) -> Callable[[Any], Any]:
    def edit(data: bytearray) -> bytearray:
        data[position] ^= 1
        return data

    return edit


def test_a_map_that_holds_a_key_twice_is_damaged() -> None:
    def text(word: bytes) -> bytes:
        return len(word).to_bytes(4, "little") + word

    def read(entries: bytes) -> dict[str, str]:
        data = text(entries)
        return Fields(data, 0, len(data)).mapping()

    entry = text(b"key") + text(b"value")
    assert read(entry) == {"key": "value"}
    with pytest.raises(DamageError, match="'key' twice"):
        read(entry + text(b"key") + text(b"other"))


def test_record_that_is_not_one_is_a_problem(whole: Path, tmp_path: Path) -> None:
    for edit in (lambda data: data + b"x", flipped(1)):
        rewritten(whole, tmp_path / "run.mcap", first_call("/tick", edit))
        recording = read_recording(tmp_path / "run.mcap")
        assert len(recording.problems) == 1
        assert "a message on /tick is not one record" in recording.problems[0]
        assert same(recording.ticks, random_rows(1500)[1:])


def test_cut_anywhere_reads_to_the_last_whole_chunk(whole: Path, tmp_path: Path) -> None:
    data, rows = whole.read_bytes(), random_rows(1500)
    ends = [(end, size) for _, end, size in chunks(whole)]
    assert len(ends) >= 4
    path = tmp_path / "cut.mcap"
    edges = [edge + step for edge, _ in ends for step in (-1, 0, 1)]
    offsets = {*edges, *range(ends[0][0], len(data), 9973), *range(len(data) - 40, len(data))}
    for offset in sorted(offset for offset in offsets if ends[0][0] <= offset < len(data)):
        path.write_bytes(data[:offset])
        recording = read_recording(path)
        assert recording.is_cut
        assert recording.problems == ()
        assert recording.meta["method"] == "implicit"
        assert recording.attachments["model.mjb"] == FILES[1].data
        assert same(recording.ticks, rows[: recording.ticks.size])
        # what the whole chunks hold, but for their events, schemas and the records' heads, and a
        # tenth for the messages of ROS
        held = sum(size for end, size in ends if end <= offset) // (TICK_DTYPE.itemsize + 35)
        assert 0.88 * held - 20 <= recording.ticks.size <= held
    path.write_bytes(data)
    assert not read_recording(path).is_cut


def test_cut_before_first_chunk_keeps_metadata_or_is_refused(whole: Path, tmp_path: Path) -> None:
    data = whole.read_bytes()
    path = tmp_path / "cut.mcap"
    kept = 0
    for offset in (*range(0, 4000, 41), *range(4000, chunks(whole)[0][1], 5003)):
        path.write_bytes(data[:offset])
        try:
            recording = read_recording(path)
        except RecordingError:
            assert kept == 0
            continue
        kept += 1
        assert recording.is_cut
        assert recording.ticks.size == 0
        assert recording.meta["epoch_ns"] == str(EPOCH)
    assert kept


def changed(path: Path, data: bytes | bytearray) -> Recording:
    path.write_bytes(data)
    return read_recording(path)


def test_zeros_behind_the_last_record_are_a_cut(whole: Path, tmp_path: Path) -> None:
    path, kept = tmp_path / "cut.mcap", whole.read_bytes()[: chunks(whole)[2][0]]
    recording = changed(path, kept + bytes(5000))
    assert (recording.is_cut, recording.problems) == (True, ())
    (problem, *_) = changed(path, kept + bytes(50) + b"x" + bytes(50)).problems
    assert "nothing can be read from byte" in problem


def test_zeros_for_the_rest_of_the_last_chunk_are_a_cut(whole: Path, tmp_path: Path) -> None:
    """A file system that lost power knows a file's length, and not all that was written."""
    content, (start, end, _) = whole.read_bytes(), chunks(whole)[2]
    before = changed(tmp_path / "kept.mcap", content[:start]).ticks
    for first in (*range(start + 1, start + 60), (start + end) // 2, end - 2):
        zeros = bytes(end - first + 5000)
        recording = changed(tmp_path / "cut.mcap", content[:first] + zeros)
        assert (recording.is_cut, recording.problems) == (True, ()), first - start
        assert recording.ticks.tobytes() == before.tobytes()


@pytest.mark.parametrize("copies", [0, 1])
def test_bytes_behind_a_whole_file_are_damage_and_no_cut(
    copies: int, whole: Path, tmp_path: Path
) -> None:
    """The file itself may stand behind it, as after an appending copy: its end is then an end."""
    path, content = tmp_path / "run.mcap", whole.read_bytes()
    more = content * copies or bytes(3)
    recording = changed(path, content + more)
    mend = f"('truncate -s {len(content)}' takes them away)"
    words = f"its end is followed by {len(more)} more bytes {mend}"
    assert (recording.is_cut, recording.problems) == (False, (words,))
    assert recording.ticks.tobytes() == read_recording(whole).ticks.tobytes()
    recording = changed(path, path.read_bytes()[: len(content)])
    assert (recording.is_cut, recording.problems) == (False, ())


@given(data=st.data())
@settings(max_examples=150)
def test_no_damage_gives_more_than_a_recording_or_error(whole: Path, data: st.DataObject) -> None:
    content = bytearray(whole.read_bytes())
    size = len(content)
    # the structure sits at both ends, so damage is drawn there as often as in the chunks
    near = st.one_of(
        st.integers(8, 4000), st.integers(size - 2500, size - 1), st.integers(8, size - 1)
    )
    for position in data.draw(st.lists(near, min_size=1, max_size=4, unique=True)):
        content[position] ^= data.draw(st.integers(1, 255))
    if data.draw(st.booleans()):
        del content[data.draw(st.integers(9, size)) :]
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "run.mcap"
        path.write_bytes(content)
        try:
            recording = read_recording(path)
        except RecordingError:
            return
    assert recording.is_cut or recording.problems


def test_no_byte_of_the_marks_at_the_end_changes_unseen(whole: Path, tmp_path: Path) -> None:
    content = whole.read_bytes()
    mark = content.rindex(b"\x0f" + struct.pack("<Q", 4))  # the end of the data section
    for position in (*range(mark, mark + 13), *range(len(content) - 37, len(content))):
        for bit in (1, 128):
            damaged = bytearray(content)
            damaged[position] ^= bit
            recording = changed(tmp_path / "run.mcap", damaged)
            assert recording.is_cut or recording.problems, (position - mark, bit)


@given(content=st.binary(max_size=300))
def test_arbitrary_bytes_behind_the_magic_never_crash(content: bytes) -> None:
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "run.mcap"
        path.write_bytes(b"\x89MCAP0\r\n" + content)
        with pytest.raises(RecordingError):
            read_recording(path)


def test_damaged_chunk_is_named_and_the_others_are_kept(whole: Path, tmp_path: Path) -> None:
    data = bytearray(whole.read_bytes())
    data[chunks(whole)[1][1] - 5000] ^= 0x10
    recording = changed(tmp_path / "run.mcap", data)
    assert not recording.is_cut
    assert any("chunk 2 (at byte " in problem for problem in recording.problems)
    assert recording.ticks["tick"][[0, -1]].tolist() == [0, 1499]


def test_damaged_length_loses_no_later_chunk(whole: Path, tmp_path: Path) -> None:
    data, second = bytearray(whole.read_bytes()), chunks(whole)[1][0]
    data[second + 7] ^= 0x40
    recording = changed(tmp_path / "run.mcap", data)
    ticks = recording.ticks["tick"]
    assert f"nothing can be read from byte {second} to byte" in recording.problems[0]
    assert (np.diff(ticks) == 1).sum() == ticks.size - 2
    assert 1000 < ticks.size < 1300


def test_damage_that_leaves_no_tick_is_the_reason_and_no_foreign_file(
    whole: Path, tmp_path: Path
) -> None:
    data, first = bytearray(whole.read_bytes()), chunks(whole)[0][0]
    del data[first + 500 : first + 1012]  # all that follows stands elsewhere
    with pytest.raises(RecordingError) as refusal:
        changed(tmp_path / "run.mcap", data)
    told = str(refusal.value).removeprefix(f"{tmp_path / 'run.mcap'} ")
    assert told.startswith("is damaged, and none of its ticks can be read: the index at the end")
    assert "nothing can be read from byte" in told
    assert "no topic" not in told


def test_chunk_that_claims_exabytes_is_not_allocated(whole: Path, tmp_path: Path) -> None:
    data = bytearray(whole.read_bytes())
    struct.pack_into("<Q", data, chunks(whole)[0][0] + 9 + 16, 1 << 60)
    assert any("is not read" in problem for problem in changed(tmp_path / "a.mcap", data).problems)


def read_back(path: Path, chunk: bytes) -> tuple[Block, list[str]]:
    """Returns the only block of a file with one chunk, and what is wrong with the file."""
    end = struct.pack("<BQI", Opcode.DATA_END, 4, 0)
    end += struct.pack("<BQQQI", Opcode.FOOTER, 20, 0, 0, 0)
    path.write_bytes(MAGIC + struct.pack("<BQ", Opcode.CHUNK, len(chunk)) + chunk + end + MAGIC)
    with FileBytes(path) as data:
        container = Container(data)
        (block,) = container.records()
    assert isinstance(block, Block)
    return block, container.problems


@pytest.mark.parametrize("states_size", [True, False])
def test_an_empty_chunk_is_no_damage(tmp_path: Path, *, states_size: bool) -> None:
    """A frame of Zstandard may leave out the size of its content."""
    packed = zstandard.ZstdCompressor(write_content_size=states_size).compress(b"")
    chunk = struct.pack("<QQQII4sQ", 0, 0, 0, 0, 4, b"zstd", len(packed)) + packed
    block, problems = read_back(tmp_path / "empty.mcap", chunk)
    assert (problems, block.data) == ([], b"")


@pytest.mark.parametrize(
    ("size", "crc", "fault"),
    [
        (4, zlib.crc32(b"tick"), ""),
        (4, 0, ""),
        (4, 1, "its checksum does not match"),
        (5, 0, "it has 4 bytes and states 5"),
    ],
)
def test_a_chunk_without_a_checksum_is_no_damage(
    tmp_path: Path, size: int, crc: int, fault: str
) -> None:
    """MCAP writes 0 where none was computed."""
    chunk = struct.pack("<QQQII0sQ", 0, 0, size, crc, 0, b"", 4) + b"tick"
    block, _ = read_back(tmp_path / "chunk.mcap", chunk)
    assert (block.fault, block.data) == (fault, b"tick")
