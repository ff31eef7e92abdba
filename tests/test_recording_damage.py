"""Any change is told by the digest; damage and cuts lose no more than they must."""

from __future__ import annotations

import struct
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import SeekingReader
from mcap.writer import Writer
from recording_cases import EPOCH, FILES, chunk_ends, random_rows, same

from hapticbridge.errors import RecordingError
from hapticbridge.record import TICK_DTYPE
from hapticbridge.recording import read_recording
from hapticbridge.recording.container import DamageError, Fields


def rewritten(path: Path, output: Path, change: Callable[[str, Any], Any]) -> None:
    """Copies a recording with the library, changed, checksums anew, the old digest kept."""
    with path.open("rb") as source, output.open("wb") as target:
        reader = SeekingReader(source)
        summary = reader.get_summary()
        assert summary is not None
        writer = Writer(target)
        writer.start()
        for metadata in reader.iter_metadata():
            if metadata.name == "hapticbridge":
                writer.add_metadata(metadata.name, change("metadata", dict(metadata.metadata)))
            else:
                writer.add_metadata(metadata.name, metadata.metadata)
        for item in reader.iter_attachments():
            name, media_type, data = change(
                "attachment", (item.name, item.media_type, bytearray(item.data))
            )
            writer.add_attachment(0, 0, name, media_type, bytes(data))
        ids = {
            channel.topic: writer.register_channel(
                channel.topic,
                channel.message_encoding,
                writer.register_schema(
                    summary.schemas[channel.schema_id].name,
                    summary.schemas[channel.schema_id].encoding,
                    summary.schemas[channel.schema_id].data,
                ),
            )
            for channel in summary.channels.values()
        }
        ids["/foreign"] = writer.register_channel("/foreign", "json", 0)
        for _, channel, message in reader.iter_messages(log_time_order=False):
            data = change(channel.topic, bytearray(message.data))
            writer.add_message(ids[channel.topic], message.log_time, bytes(data), message.log_time)
            writer.add_message(ids["/foreign"], message.log_time, b"{}", message.log_time)
        writer.finish()  # type: ignore[no-untyped-call]


def test_rewriting_with_foreign_channels_keeps_the_digest(whole: Path, tmp_path: Path) -> None:
    rewritten(whole, tmp_path / "run.mcap", lambda kind, content: content)
    recording = read_recording(tmp_path / "run.mcap")
    assert same(recording.ticks, random_rows(1500))
    assert recording.digest == recording.computed_digest == read_recording(whole).digest
    assert recording.problems == ()


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


@pytest.mark.parametrize(
    ("kind", "edit"),
    [
        ("metadata", lambda meta: {**meta, "period_s": "0.0010"}),
        ("metadata", lambda meta: {**meta, "extra": ""}),
        ("metadata", lambda meta: {k: v for k, v in meta.items() if k != "method"}),
        ("metadata", lambda meta: {**meta, "method": meta["µ"], "µ": meta["method"]}),
        ("attachment", lambda item: (item[0], item[1], item[2] + b" ")),
        ("attachment", lambda item: (item[0] + "l", item[1], item[2])),
        ("attachment", lambda item: (item[0], item[1] + "l", item[2])),
        ("/event", lambda data: data.replace(b"start", b"stop!")),
        *(("/tick", flipped(position)) for position in (4, 11, 77, 200, 403)),
    ],
)
def test_digest_tells_any_change_although_all_checksums_are_right(
    whole: Path, tmp_path: Path, kind: str, edit: Callable[[Any], Any]
) -> None:
    rewritten(whole, tmp_path / "run.mcap", first_call(kind, edit))
    recording = read_recording(tmp_path / "run.mcap")
    assert recording.problems == ()
    assert recording.digest == read_recording(whole).digest
    assert recording.digest != recording.computed_digest


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
    ends = chunk_ends(whole)
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
        # what the whole chunks hold, but for their events, schemas and the records' heads
        held = sum(size for end, size in ends if end <= offset) // (TICK_DTYPE.itemsize + 35)
        assert held - 20 <= recording.ticks.size <= held
    path.write_bytes(data)
    assert not read_recording(path).is_cut


def test_cut_before_the_first_chunk_keeps_metadata_or_is_refused(
    whole: Path, tmp_path: Path
) -> None:
    data = whole.read_bytes()
    path = tmp_path / "cut.mcap"
    kept = 0
    for offset in (*range(0, 4000, 41), *range(4000, chunk_ends(whole)[0][0], 5003)):
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


def test_zeros_behind_the_last_whole_record_are_a_cut_and_no_damage(
    whole: Path, tmp_path: Path
) -> None:
    path = tmp_path / "cut.mcap"
    data = whole.read_bytes()
    with whole.open("rb") as stream:
        summary = SeekingReader(stream).get_summary()
    assert summary is not None
    third = sorted(index.chunk_start_offset for index in summary.chunk_indexes)[2]
    path.write_bytes(data[:third] + bytes(5000))
    recording = read_recording(path)
    assert recording.is_cut
    assert recording.problems == ()
    path.write_bytes(data[:third] + bytes(50) + b"x" + bytes(50))
    assert "nothing can be read from byte" in read_recording(path).problems[0]


@given(data=st.data())
@settings(max_examples=150)
def test_no_damage_gives_anything_but_a_recording_or_its_error(
    whole: Path, data: st.DataObject
) -> None:
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
    assert recording.is_cut or recording.problems or recording.digest != recording.computed_digest


@given(content=st.binary(max_size=300))
def test_arbitrary_bytes_behind_the_magic_never_crash(content: bytes) -> None:
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "run.mcap"
        path.write_bytes(b"\x89MCAP0\r\n" + content)
        with pytest.raises(RecordingError):
            read_recording(path)


def test_damaged_chunk_is_named_and_the_others_are_kept(whole: Path, tmp_path: Path) -> None:
    data = bytearray(whole.read_bytes())
    end, _ = chunk_ends(whole)[1]
    data[end - 5000] ^= 0x10
    path = tmp_path / "run.mcap"
    path.write_bytes(data)
    recording = read_recording(path)
    assert not recording.is_cut
    assert any("chunk 2 (at byte " in problem for problem in recording.problems)
    assert recording.ticks["tick"][-1] == 1499
    assert recording.ticks["tick"][0] == 0
    assert recording.digest != recording.computed_digest


def test_damaged_length_loses_no_later_chunk(whole: Path, tmp_path: Path) -> None:
    with whole.open("rb") as stream:
        summary = SeekingReader(stream).get_summary()
    assert summary is not None
    second = sorted(index.chunk_start_offset for index in summary.chunk_indexes)[1]
    data = bytearray(whole.read_bytes())
    data[second + 7] ^= 0x40
    path = tmp_path / "run.mcap"
    path.write_bytes(data)
    recording = read_recording(path)
    ticks = recording.ticks["tick"]
    assert f"nothing can be read from byte {second} to byte" in recording.problems[0]
    assert (np.diff(ticks) == 1).sum() == ticks.size - 2
    assert 1000 < ticks.size < 1300


def test_chunk_that_claims_exabytes_is_refused_without_allocating(
    whole: Path, tmp_path: Path
) -> None:
    with whole.open("rb") as stream:
        summary = SeekingReader(stream).get_summary()
    assert summary is not None
    first = min(index.chunk_start_offset for index in summary.chunk_indexes)
    data = bytearray(whole.read_bytes())
    struct.pack_into("<Q", data, first + 9 + 16, 1 << 60)
    path = tmp_path / "run.mcap"
    path.write_bytes(data)
    assert any("beyond" in problem for problem in read_recording(path).problems)
