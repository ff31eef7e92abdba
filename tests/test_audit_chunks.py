"""Forgeries of a recording's container, with checksums and index made anew, and lost ends.

A chunk that is removed, doubled or moved breaks the count of ticks. The index, and attachments or
metadata that nothing refers to, change no verdict. ``test_audit_forgeries`` has the forgeries of
the contents.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import lz4.frame
import pytest
import zstandard
from audit_cases import recorded
from cli_cases import Called
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC

from hapticbridge.audit import audit
from hapticbridge.errors import RecordingError
from hapticbridge.recording import read_recording, repair
from hapticbridge.tools.export import Part, export


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("honest") / "run.mcap"
    recorded(path, "virtual_wall", duration=1.5)
    return path


# Records of a file, changed and written with new checksums and a new index


@dataclass
class Parts:
    """Records of a file in order, with chunks kept packed.

    Attributes:
        before: Header, metadata and attachments.
        chunks: Each chunk with its message indexes.
        hides: Number of a chunk that the index leaves out; None for none.
    """

    before: list[Any]
    chunks: list[list[Any]]
    hides: int | None = None

    @classmethod
    def of(cls, path: Path) -> Parts:
        parts = cls([], [])
        with path.open("rb") as stream:
            for each in StreamReader(stream, emit_chunks=True).records:
                if isinstance(each, records.DataEnd):
                    break
                if isinstance(each, records.Chunk):
                    parts.chunks.append([each])
                elif isinstance(each, records.MessageIndex):
                    parts.chunks[-1].append(each)
                else:
                    parts.before.append(each)
        return parts

    def write(self, path: Path) -> Path:
        """Writes the file with checksums and index made anew."""
        out, index = BytesIO(), []
        out.write(MCAP0_MAGIC)

        def add(record: Any) -> tuple[int, int]:
            start, builder = out.tell(), RecordBuilder()
            record.write(builder)
            out.write(builder.end())  # type: ignore[no-untyped-call]
            return start, out.tell() - start

        for each in self.before:
            add(each)
        for number, (chunk, *messages) in enumerate(self.chunks):
            place = add(chunk)
            offsets = {each.channel_id: add(each)[0] for each in messages}
            span = chunk.message_start_time, chunk.message_end_time
            sizes = len(chunk.data), chunk.uncompressed_size
            length = out.tell() - sum(place)
            entry = (place[1], place[0], chunk.compression, *sizes)
            made = records.ChunkIndex(
                chunk_length=entry[0],
                chunk_start_offset=entry[1],
                compression=entry[2],
                compressed_size=entry[3],
                message_end_time=span[1],
                message_index_length=length,
                message_index_offsets=offsets,
                message_start_time=span[0],
                uncompressed_size=entry[4],
            )
            if number != self.hides:
                index.append(made)
        add(records.DataEnd(data_section_crc=zlib.crc32(out.getvalue())))
        start = out.tell()
        for made in index:
            add(made)
        footer = records.Footer(
            summary_start=start if index else 0, summary_offset_start=0, summary_crc=0
        )
        builder = RecordBuilder()
        footer.write(builder)
        tail = builder.end()  # type: ignore[no-untyped-call]
        crc = zlib.crc32(out.getvalue()[start:] + tail[:-4])
        path.write_bytes(out.getvalue() + tail[:-4] + crc.to_bytes(4, "little") + MCAP0_MAGIC)
        return path


def exchanged(parts: Parts) -> None:
    parts.chunks[1], parts.chunks[2] = parts.chunks[2], parts.chunks[1]


def hidden_chunk(parts: Parts) -> None:
    parts.hides = 1


def foreign(parts: Parts) -> None:
    parts.before.append(records.Metadata(name="foreign", metadata={"note": "kind"}))


def attachment(parts: Parts) -> None:
    note = records.Attachment(
        create_time=0, log_time=0, name="note", media_type="", data=b"proof of everything"
    )
    parts.before.append(note)


FORGERIES: dict[str, tuple[Callable[[Parts], object], str]] = {
    "nothing": (lambda parts: None, "passive"),
    "tail cut off": (lambda parts: parts.chunks.pop(), "invalid"),
    "chunk removed": (lambda parts: parts.chunks.pop(2), "invalid"),
    "chunk doubled": (lambda parts: parts.chunks.insert(2, parts.chunks[2]), "invalid"),
    "chunks exchanged": (exchanged, "invalid"),
    "chunk left out of the index": (hidden_chunk, "passive"),  # the audit reads every chunk
    "metadata added": (foreign, "passive"),
    "attachment added": (attachment, "passive"),
}


@pytest.mark.parametrize("name", FORGERIES)
def test_a_chunk_that_is_lost_doubled_or_moved_is_found(
    name: str, run: Path, tmp_path: Path
) -> None:
    (change, verdict), parts = FORGERIES[name], Parts.of(run)
    assert len(parts.chunks) >= 5
    change(parts)
    path = parts.write(tmp_path / "forged.mcap")
    assert not any("checksum" in problem for problem in read_recording(path).problems)
    report = audit(path)
    assert report.verdict == verdict, report.reason


# Chunks that another program packed


def repacked(run: Path, path: Path, pack: Callable[[bytes], bytes], compression: str) -> Path:
    """Writes a recording with its chunks packed anew, as ``mcap compress`` does."""
    parts = Parts.of(run)
    for chunk, *_ in parts.chunks:
        unpacked = zstandard.ZstdDecompressor().decompress(chunk.data, chunk.uncompressed_size)
        chunk.data, chunk.compression = pack(unpacked), compression
    return parts.write(path)


@pytest.mark.parametrize(("compression", "pack"), [("lz4", lz4.frame.compress), ("", bytes)])
def test_chunks_in_each_compression_of_mcap_are_read(
    run: Path, tmp_path: Path, compression: str, pack: Callable[[bytes], bytes]
) -> None:
    path = repacked(run, tmp_path / "repacked.mcap", pack, compression)
    assert read_recording(path).problems == ()
    assert (read_recording(path).ticks == read_recording(run).ticks).all()
    assert audit(path).verdict == "passive"


def test_chunks_as_large_as_other_programs_write_them_are_read(run: Path, tmp_path: Path) -> None:
    parts, unpacked = Parts.of(run), b""
    for chunk, *_ in parts.chunks:
        unpacked += zstandard.ZstdDecompressor().decompress(chunk.data, chunk.uncompressed_size)
    # 'mcap filter' closes a chunk with the message that leads it beyond 4 MiB
    builder = RecordBuilder()
    records.Schema(id=99, name="unused", encoding="ros2msg", data=bytes(1 << 22)).write(builder)
    unpacked += builder.end()  # type: ignore[no-untyped-call]
    first, last = parts.chunks[0][0], parts.chunks[-1][0]
    first.data, first.message_end_time = zstandard.compress(unpacked), last.message_end_time
    first.uncompressed_size, first.uncompressed_crc = len(unpacked), zlib.crc32(unpacked)
    parts.chunks = [[first]]
    path = parts.write(tmp_path / "one.mcap")
    assert read_recording(path).problems == ()
    assert (read_recording(path).ticks == read_recording(run).ticks).all()
    assert audit(path).verdict == "passive"


DAMAGED: dict[str, tuple[Callable[[bytes], bytes], str, str]] = {
    "cut": (lambda data: lz4.frame.compress(data)[:-40], "lz4", "bytes and states"),
    "torn": (lambda data: lz4.frame.compress(data)[9:], "lz4", "it does not decompress"),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_a_chunk_that_does_not_unpack_is_named(name: str, run: Path, tmp_path: Path) -> None:
    pack, compression, words = DAMAGED[name]
    path = repacked(run, tmp_path / "damaged.mcap", pack, compression)
    if name == "cut":  # what was unpacked is kept
        assert any(words in problem for problem in read_recording(path).problems)
        return
    with pytest.raises(RecordingError, match=rf"none of its ticks can .*chunk 1 \(at .*{words}"):
        read_recording(path)


def test_a_compression_that_mcap_lacks_is_named(run: Path, tmp_path: Path) -> None:
    path = repacked(run, tmp_path / "packed.mcap", bytes, "br")
    with pytest.raises(RecordingError, match=r"compressed by 'br', and MCAP has 'lz4', 'zstd' and"):
        read_recording(path)


# Recordings that lost their end


@pytest.mark.usefixtures("undrawn")
def test_a_file_that_lost_its_end_says_so_through_repairs_and_exports(
    run: Path, tmp_path: Path, call: Called
) -> None:
    first, again, twice = (tmp_path / f"{name}.mcap" for name in ("first", "again", "twice"))
    (tmp_path / "cut.mcap").write_bytes(run.read_bytes()[:-60])
    repair(tmp_path / "cut.mcap", first)
    data = first.read_bytes()
    again.write_bytes(data[: int(0.8 * len(data))])  # the event of the repair is lost, too
    assert "repaired" not in [event["event"] for event in read_recording(again).events]
    repair(again, twice)
    for path in (tmp_path / "cut.mcap", first, again, twice):
        report = audit(path)
        assert (report.verdict, report.is_cut) == ("passive", True), (path, report.reason)
        assert "its end" in report.cut
        values = json.loads(report.to_json())
        assert (values["is_cut"], values["cut"]) == (True, report.cut)
        # a piece from the middle has no event of the repair in its span
        out = tmp_path / "piece.csv"
        export(path, "csv", out, part=Part(span=(0.2, 0.4)), overwrite=True)
        piece = json.loads(out.with_name("piece.csv.json").read_text())
        assert piece["meta"]["incomplete"] == report.cut
        assert ("repaired" in [event["event"] for event in piece["events"]]) == (
            path in (first, twice)
        )
        export(path, "csv", out, overwrite=True)
        whole = json.loads(out.with_name("piece.csv.json").read_text())
        assert whole["meta"]["incomplete"] == report.cut
    page = tmp_path / "page.html"
    code, printed, _ = call("audit", first, "--report", page)
    assert code == 0
    assert audit(first).cut in " ".join(printed.split())
    assert "had lost its end and was repaired" in page.read_text()
    export(run, "csv", tmp_path / "piece.csv", overwrite=True)
    assert "incomplete" not in (tmp_path / "piece.csv.json").read_text()


def test_damage_that_takes_the_metadata_along_is_the_reason(
    run: Path, call: Called, tmp_path: Path
) -> None:
    data, path = bytearray(run.read_bytes()), tmp_path / "torn.mcap"
    length = slice(len(MCAP0_MAGIC) + 1, len(MCAP0_MAGIC) + 9)  # of the first record
    data[length] = (1 << 63).to_bytes(8, "little")
    path.write_bytes(data)
    report = audit(path)
    assert (report.verdict, report.duration) == ("invalid", 0.0)
    assert report.reason.startswith("the file is damaged: nothing can be read from byte 8 to byte")
    assert report.reason.endswith("the metadata record 'hapticbridge' is missing")
    _, printed, _ = call("audit", path)
    assert printed.splitlines()[-1] == f"  {report.ticks} ticks"  # its period is unknown
    scene = "virtual_wall"
    for words in (
        ("render", path, tmp_path / "x.png"),
        ("render", path, tmp_path / "x.gif"),
        ("compare", path, run),
        ("compare", run, path),
        ("view", path),
        ("export", path, "--format", "csv", "--from", "0.1", "--out", tmp_path / "x.csv"),
        ("run", scene, "--fast", "--device", f"trajectory:{path}"),
        ("check", scene, "--motion", path),
    ):
        code, _, err = call(*map(str, words))
        assert (code, err.count("\n")) == (2, 1), words
        assert f"{path} is damaged: nothing can be read from byte 8" in err, words
