"""A recording as a table: every double comes back to the bit, with units, metadata and events."""

from __future__ import annotations

import csv
import importlib
import json
import math
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from audit_cases import SlowClock
from cli_cases import Called
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from recording_cases import EPOCH, META, random_rows, write

from hapticbridge.clock import SimulatedClock
from hapticbridge.errors import RecordingError
from hapticbridge.files import install_command
from hapticbridge.kernel.record import FORMAT, TICK_DTYPE, TickFlag
from hapticbridge.recording import read_recording, reader
from hapticbridge.run.bridge import Bridge
from hapticbridge.run.hands import Grasp
from hapticbridge.tools.export import ENERGIES, Part, export, sidecar_of
from hapticbridge.tools.export import FORMATS as WRITERS

h5py: Any = importlib.import_module("h5py")
pq: Any = importlib.import_module("pyarrow.parquet")

COUNT = 150

UNITS = {
    "tick": "1",
    "deadline_ns": "ns",
    "device_position_x": "m",
    "tool_quaternion_w": "1",
    "wrench_on_tool_fz": "N",
    "wrench_on_device_tx": "N m",
    "device_energy": "J",
    "injected_damping": "N s/m",
    "injected_rotational_damping": "N m s/rad",
}
"""Written down once more, by hand."""

Columns = dict[str, np.ndarray]


def from_parquet(path: Path) -> tuple[Columns, dict[str, str], dict[str, str], list[Any]]:
    table = pq.read_table(path)
    units = {field.name: field.metadata[b"unit"].decode() for field in table.schema}
    about = {key.decode(): value for key, value in table.schema.metadata.items()}
    meta, events = (json.loads(about[f"hapticbridge.{name}"]) for name in ("meta", "events"))
    return {name: table[name].to_numpy() for name in table.column_names}, units, meta, events


def from_csv(path: Path) -> tuple[Columns, dict[str, str], dict[str, str], list[Any]]:
    about = json.loads(sidecar_of(path).read_text(encoding="utf-8"))
    with path.open(newline="") as file:
        header, *rows = csv.reader(file)
    columns = {
        name: np.array([int(v) if v.lstrip("-").isdigit() else float(v) for v in values])
        for name, values in zip(header, zip(*rows, strict=True), strict=True)
    }
    return columns, about["units"], about["meta"], about["events"]


def from_hdf5(path: Path) -> tuple[Columns, dict[str, str], dict[str, str], list[Any]]:
    with h5py.File(path) as file:
        ticks, meta = file["ticks"], file["meta"]
        return (
            {name: ticks[name][:] for name in ticks},
            {name: ticks[name].attrs["unit"] for name in ticks},
            {key: meta[key].asstr()[()] for key in meta},
            [json.loads(text) for text in file["events"].asstr()[:]],
        )


FORMATS = [("parquet", from_parquet), ("csv", from_csv), ("hdf5", from_hdf5)]


def rows_to_keep() -> np.ndarray:
    """Arbitrary bits; in one column two NaNs that differ in their payload, and both zeros."""
    rows = random_rows(COUNT)
    bits = [0x7FF8000000000001, 0x7FF8000000000002, -(2**63), 0]
    rows["kinetic"][:4] = np.array(bits, dtype=np.int64).view(np.float64)
    return rows


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    write(tmp_path / "run.mcap", rows_to_keep())
    return tmp_path / "run.mcap"


@pytest.mark.parametrize(("form", "read"), FORMATS)
def test_every_number_comes_back_to_the_bit(
    form: str,
    read: Callable[[Path], tuple[Columns, dict[str, str], dict[str, str], list[Any]]],
    recording: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(reader, "BLOCK", 64)  # in three parts
    done = export(recording, form)
    columns, units, meta, events = read(done.files[0])
    assert not done.recording.problems
    assert columns.pop("seconds").shape == (COUNT,)
    rows, position = rows_to_keep(), 0
    names = list(columns)
    if form == "hdf5":  # in the order of the alphabet
        names = list(from_parquet(export(recording, "parquet").files[0])[0])
        names.remove("seconds")
    for field in TICK_DTYPE.names or ():
        values = rows[field].reshape(COUNT, -1)
        for index in range(values.shape[1]):
            name, got = names[position], columns[names[position]]
            assert name.startswith(field)
            assert got.dtype == values.dtype
            expected = values[:, index]
            if form == "csv":  # text knows one NaN
                got, expected = (np.where(np.isnan(v), np.nan, v) for v in (got, expected))
            np.testing.assert_array_equal(got.view(np.int64), expected.view(np.int64))
            position += 1
    assert position == len(columns) == TICK_DTYPE.itemsize // 8
    assert {name: units[name] for name in UNITS} == UNITS
    assert meta == META | {"format": FORMAT, "epoch_ns": str(EPOCH)}
    assert [event["event"] for event in events] == ["start", "mark", "mark"]


@pytest.mark.parametrize(
    ("form", "module", "extra"), [("parquet", "pyarrow", "tables"), ("hdf5", "h5py", "hdf5")]
)
def test_missing_package_is_told(
    form: str,
    module: str,
    extra: str,
    recording: Path,
    call: Called,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    code, out, err = call("export", recording, "--format", form)
    assert (code, out) == (2, "")
    assert install_command(extra) in " ".join(err.split())
    assert [path.name for path in recording.parent.iterdir()] == ["run.mcap"]  # no half file


def test_file_that_exists_is_kept_unless_it_may_be_replaced(recording: Path, call: Called) -> None:
    target = recording.with_name("out.csv")
    sidecar_of(target).write_text("mine")
    code, _, err = call("export", recording, "--format", "csv", "--out", target)
    assert code == 2
    assert "exists" in err
    assert sidecar_of(target).read_text() == "mine"
    assert not target.exists()
    code, out, _ = call("export", recording, "--format", "csv", "--out", target, "--overwrite")
    assert code == 0
    assert f"{COUNT} ticks, 3 events" in out
    assert len(target.read_text().splitlines()) == COUNT + 1


def test_a_link_is_followed_and_a_pipe_is_not_replaced(recording: Path, call: Called) -> None:
    folder = recording.with_name("elsewhere")
    folder.mkdir()
    real, link = folder / "real.csv", recording.with_name("link.csv")
    real.write_text("old")
    link.symlink_to(real)
    assert call("export", recording, "--format", "csv", "--out", link, "--overwrite")[0] == 0
    assert link.is_symlink()
    assert len(real.read_text().splitlines()) == COUNT + 1
    pipe = recording.with_name("pipe.csv")
    os.mkfifo(pipe)
    code, _, err = call("export", recording, "--format", "csv", "--out", pipe, "--overwrite")
    assert (code, "it exists and is not a file" in " ".join(err.split())) == (2, True)
    assert pipe.is_fifo()


def test_hdf5_keeps_no_more_chunks_than_it_writes(
    recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its own cache of 8 MB a column takes half a gigabyte before memory stays constant."""
    caches: list[int] = []

    class File(h5py.File):  # type: ignore[misc] # h5py has no types
        def close(self) -> None:
            columns = self["ticks"].values() if self else ()
            caches.extend(data.id.get_access_plist().get_chunk_cache()[1] for data in columns)
            super().close()

    monkeypatch.setattr(h5py, "File", File)
    export(recording, "hdf5")
    assert len(caches) == TICK_DTYPE.itemsize // 8 + 1  # and the seconds
    assert sum(caches) < 10e6


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such names")
@pytest.mark.parametrize("form", WRITERS)
def test_a_name_that_is_no_utf_8_or_as_long_as_a_name_may_be_is_written(
    form: str, run_file: Path, tmp_path: Path, call: Called
) -> None:
    ending = WRITERS[form][1][0]
    folder = tmp_path / os.fsdecode(b"l\xe4nge")
    folder.mkdir()
    for name in (os.fsdecode(b"gr\xf6\xdfe"), "L" * (250 - len(ending))):
        target = (tmp_path if form == "rerun" else folder) / f"{name}{ending}"
        assert call("export", run_file, "--format", form, "--out", target)[0] == 0
        assert target.stat().st_size > 0
    assert not [each for each in folder.iterdir() if each.name.startswith(".")]
    if form == "rerun":  # its library takes names in UTF-8 alone, of the folder too
        code, _, err = call("export", run_file, "--format", form, "--out", folder / "a.rrd")
        assert (code, err.count("\n")) == (2, 1)
        assert "rerun needs a name in UTF-8" in err


def test_a_folder_that_takes_no_file_is_the_reason_in_each_format(
    run_file: Path, call: Called
) -> None:
    for form, (_, (ending, *_)) in WRITERS.items():
        code, _, err = call("export", run_file, "--format", form, "--out", f"/proc/x{ending}")
        assert code == 2
        assert err.endswith(f"cannot write '/proc/x{ending}': the folder /proc takes no new file\n")


@pytest.mark.parametrize(
    "words",
    [
        "run point_mass --fast --duration 0.01 --record FOLDER",
        "export FILE --format csv --out FOLDER.csv",
        "view FILE --save FOLDER.html",
        "render FILE FOLDER.png",
    ],
)
def test_a_folder_in_the_place_of_a_file_is_told_and_not_offered_to_be_replaced(
    run_file: Path, tmp_path: Path, call: Called, words: str
) -> None:
    target = tmp_path / words.rpartition("FOLDER")[2].join(("folder", ""))
    target.mkdir()
    command = words.replace("FILE", str(run_file)).replace("FOLDER", str(tmp_path / "folder"))
    code, _, err = call(*command.split())
    assert code == 2
    assert f"error: cannot write '{target}': it " in err
    assert "--overwrite" not in err


def test_a_pipe_in_the_place_of_a_recording_is_told_and_not_waited_for(
    tmp_path: Path, call: Called
) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    command = "run", "point_mass", "--fast", "--duration", "0.01", "--record", str(pipe)
    for words in ((), ("--overwrite",)):
        code, _, err = call(*command, *words)
        assert code == 2
        assert err.endswith(f"error: cannot write '{pipe}': it exists and is not a file\n")


def test_a_recording_is_never_replaced_by_its_export(recording: Path) -> None:
    before = recording.read_bytes()
    # whatever it is called, and whichever way leads to it
    odd, link = recording.with_name("odd.CSV"), recording.with_name("link.h5")
    odd.write_bytes(before)
    link.symlink_to(odd)
    for form, target in (("csv", odd), ("hdf5", link)):
        with pytest.raises(RecordingError, match="is the recording itself"):
            export(odd, form, target, overwrite=True)
    beside = recording.with_name("run.csv.json")
    beside.write_bytes(before)
    with pytest.raises(RecordingError, match="is the recording itself"):
        export(beside, "csv", recording.with_name("run.csv"), overwrite=True)
    assert recording.read_bytes() == odd.read_bytes() == beside.read_bytes() == before
    assert export(recording, "parquet", recording.with_name("run.pq")).files[0].exists()


def test_a_cut_recording_is_exported_as_far_as_it_goes(tmp_path: Path, call: Called) -> None:
    path = tmp_path / "cut.mcap"
    write(path, random_rows(1000))
    data = path.read_bytes()
    path.write_bytes(data[: int(0.7 * len(data))])
    code, out, err = call("export", path, "--format", "parquet", "--json")
    assert code == 0
    assert "cut" in err
    told = json.loads(out)
    assert (told["is_cut"], told["damage"]) == (True, [])
    columns = from_parquet(Path(told["files"][0]))[0]
    assert 0 < len(columns["tick"]) == told["ticks"] < 1000


def test_a_changed_recording_is_exported_with_a_warning(recording: Path, call: Called) -> None:
    data = bytearray(recording.read_bytes())
    data[len(data) // 2] ^= 0xFF
    recording.write_bytes(data)
    code, _, err = call("export", recording, "--format", "csv")
    assert code == 1
    assert "damaged" in err


@pytest.mark.parametrize(("form", "read"), FORMATS)
def test_a_piece_has_the_ticks_and_events_of_its_time(
    form: str, read: Callable[[Path], Any], recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reader, "BLOCK", 64)
    # tick k is due at (k + 1) ms; the end is excluded, so that two pieces share no tick
    for name, span, cut, ticks, times in (
        ("first", (0.03, 0.1), [0.03, 0.1], np.arange(29, 99), []),
        ("rest", (0.1, math.inf), [0.1, None], np.arange(99, COUNT), [100_000_000]),
    ):
        suffix = export(recording, form, overwrite=True).files[0].suffix
        done = export(recording, form, recording.with_name(name + suffix), part=Part(span=span))
        columns, _, meta, events = read(done.files[0])
        np.testing.assert_array_equal(columns["tick"], ticks)
        assert (done.ticks, json.loads(meta["cut"])) == (len(ticks), cut)
        assert [event["time_ns"] for event in events] == times


def test_a_piece_is_cut_where_deadlines_were_not_where_ticks_are_counted(tmp_path: Path) -> None:
    rows = random_rows(100)
    rows["deadline_ns"][40:] += 500_000_000  # the machine stood still for half a second
    write(tmp_path / "late.mcap", rows)
    done = export(tmp_path / "late.mcap", "csv", part=Part(span=(0.3, 0.56)))
    assert from_csv(done.files[0])[0]["tick"].tolist() == list(range(40, 59))


@pytest.fixture(scope="module")
def wall(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that meets a wall, with two missed deadlines."""
    path = tmp_path_factory.mktemp("wall") / "run.mcap"
    clock = SlowClock({100: 2})
    with Bridge("virtual_wall", recording=path, clock=clock) as bridge:
        bridge.run(duration=0.5)
    return path


@pytest.mark.parametrize(("form", "read"), FORMATS)
def test_seconds_are_due_times_and_the_bits_of_the_flags_have_names(
    form: str, read: Callable[[Path], tuple[Columns, Any, Any, Any]], wall: Path, tmp_path: Path
) -> None:
    target = export(wall, form, tmp_path / f"out.{form if form != 'hdf5' else 'h5'}").files[0]
    columns, units, _, _ = read(target)
    ticks = read_recording(wall).ticks
    assert np.array_equal(columns["seconds"], 1e-9 * ticks["deadline_ns"])
    assert units["seconds"] == "s"
    if form == "csv":
        legend = json.loads(sidecar_of(target).read_text(encoding="utf-8"))["flags"]
    elif form == "hdf5":
        with h5py.File(target) as file:
            legend = json.loads(file["ticks/flags"].attrs["bits"])
    else:
        legend = json.loads(pq.read_schema(target).metadata[b"hapticbridge.flags"])
    assert legend["64"] == "CONTACT"
    assert all(TickFlag[name].value == int(bit) for bit, name in legend.items())


def test_a_data_frame_has_the_columns_of_the_table(wall: Path) -> None:
    recording = read_recording(wall)
    frame = recording.to_pandas()
    assert frame.index.name == "seconds"
    assert np.array_equal(frame.index, 1e-9 * recording.ticks["deadline_ns"])
    assert np.array_equal(frame["wrench_on_device_fz"], recording.ticks["wrench_on_device"][:, 2])
    assert frame.attrs["units"]["wrench_on_device_fz"] == "N"
    assert frame.attrs["flags"]["64"] == "CONTACT"


def test_without_pandas_a_sentence_says_how_to_get_it(
    wall: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(RecordingError, match=re.escape(install_command("tables"))):
        read_recording(wall).to_pandas()


def test_every_path_of_the_layout_is_in_the_recording(run_file: Path, tmp_path: Path) -> None:
    export(run_file, "foxglove", tmp_path / "layout.json")
    layout = json.loads((tmp_path / "layout.json").read_text())
    panels = layout["configById"]
    with run_file.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        assert summary is not None
        topics = {channel.topic for channel in summary.channels.values()}
        first = {
            channel.topic: value
            for _, channel, _, value in reader.iter_decoded_messages(
                topics=["/tick", "/wrench_on_hand"]
            )
        }
    paths = [each["value"] for panel in panels.values() for each in panel.get("paths", [])]
    assert len(paths) == 3 + len(ENERGIES)
    for path in paths:
        topic, *fields = path.split(".")
        value = first[topic]
        for field in fields:
            value = getattr(value, field)
        assert isinstance(value, float)
    assert set(panels["3D!scene"]["topics"]) <= topics
    assert panels["RosOut!events"]["topicToRender"] in topics

    def shown(part: object) -> list[str]:
        if isinstance(part, str):
            return [part]
        assert isinstance(part, dict)
        return shown(part["first"]) + shown(part["second"])

    assert sorted(shown(layout["layout"])) == sorted(panels)


@pytest.mark.parametrize(
    "named", [("--from", 0.01), ("--to", 0.02), ("--hand", "grip"), ("--hand", "another")]
)
def test_a_layout_takes_no_part_of_a_recording(
    run_file: Path, tmp_path: Path, named: tuple[str, object], call: Called
) -> None:
    """It would show the whole, and say that it wrote a part."""
    target = tmp_path / "layout.json"
    code, _, err = call("export", run_file, "--format", "foxglove", *named, "--out", target)
    assert code == 2
    assert "have no effect on foxglove" in err
    assert not target.exists()


def test_a_layout_does_not_say_that_it_holds_ticks(
    run_file: Path, tmp_path: Path, call: Called
) -> None:
    command = "export", run_file, "--format", "foxglove", "--overwrite", "--out"
    out = call(*command, tmp_path / "layout.json")[1]
    assert "ticks" not in out
    assert "a layout to import where" in out
    assert json.loads(call(*command, tmp_path / "layout.json", "--json")[1])["ticks"] == 0


def test_a_layout_of_two_hands_needs_none_named(tmp_path: Path) -> None:
    run, target = tmp_path / "two.mcap", tmp_path / "layout.json"
    grasps = Grasp("bolt", "simulated"), Grasp("wrench", "simulated")
    with Bridge("nut_and_wrench", grasps, clock=SimulatedClock(), recording=run) as bridge:
        bridge.run(duration=0.02)
    export(run, "foxglove", target)
    with run.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    topics = json.loads(target.read_text())["configById"]["3D!scene"]["topics"]
    assert set(topics) <= {channel.topic for channel in summary.channels.values()}


def test_rerun_reads_its_file(run_file: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    target = tmp_path / "run.rrd"
    done = export(run_file, "rerun", target)
    assert done.ticks == len(read_recording(run_file).ticks)

    home = os.environ | {"HOME": str(tmp_path)}  # where it writes its settings

    def rerun(*words: str) -> str:
        command = [sys.executable, "-m", "rerun", "rrd", *words, str(target)]
        found = subprocess.run(
            command, capture_output=True, text=True, timeout=60, check=True, env=home
        )
        return found.stdout + found.stderr

    assert "without error" in rerun("verify")
    counts = rerun("stats")
    for entity in ("scene/handle", "scene/tool", "scene/force_on_hand", "force/on_hand", "events"):
        assert f"/{entity}: " in counts
    assert "/view/" in counts, "the panels' arrangement"
