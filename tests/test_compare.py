"""Two recorded runs: alike in every bit, or where they part, by how much and perhaps why."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from audit_cases import recorded, rewritten, tapped
from cli_cases import Called
from numpy.typing import NDArray

from hapticbridge.errors import RecordingError
from hapticbridge.kernel.record import TickFlag
from hapticbridge.recording import read_recording, reader
from hapticbridge.tools.compare import compare


@pytest.fixture(scope="module")
def tap(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tapped(tmp_path_factory.mktemp("compare"))


Change = Callable[[NDArray[np.void]], None]


def changed(path: Path, folder: Path, change: Change, **parts: Any) -> Path:
    recording = read_recording(path)
    rows = recording.ticks.copy()
    change(rows)
    return rewritten(recording, folder / "changed.mcap", ticks=rows, **parts)


def test_a_run_that_is_repeated_is_the_same_run(tap: Path, tmp_path: Path, call: Called) -> None:
    again = tapped(tmp_path, "again.mcap")
    found = compare(tap, again)
    assert (found.is_same, found.compared) == (True, len(read_recording(tap).ticks))
    code, out, _ = call("compare", tap, again)
    assert (code, "equal in every bit" in out) == (0, True)


def test_a_quaternion_and_its_opposite_are_one_orientation(tap: Path, tmp_path: Path) -> None:
    def change(rows: NDArray[np.void]) -> None:
        rows["tool_quaternion"][20:40] *= -1.0
        rows["tool_quaternion"][30, 1] += 1e-3

    found = compare(tap, changed(tap, tmp_path, change))
    assert found.first is not None
    assert (found.first.column, found.first.ticks) == ("tool_quaternion_x", (30, 30))
    assert [(each.column, round(each.size, 9)) for each in found.largest] == [
        ("tool_quaternion_x", 1e-3)
    ]


@pytest.mark.parametrize("block", [16, 1000])
def test_first_and_largest_difference_are_told(
    block: int, tap: Path, tmp_path: Path, call: Called, monkeypatch: pytest.MonkeyPatch
) -> None:
    def change(rows: NDArray[np.void]) -> None:
        rows["tool_position"][50, 1] += 2.5e-6
        rows["tool_position"][60:70, 1] -= 3e-3
        rows["kinetic"][55] += 0.5

    monkeypatch.setattr(reader, "BLOCK", block)
    other = changed(tap, tmp_path, change)
    found = compare(tap, other)
    assert found.first is not None
    assert (found.first.column, found.first.ticks) == ("tool_position_y", (50, 50))
    assert found.first.size == pytest.approx(2.5e-6, rel=1e-6)
    largest = {each.column: (each.size, each.ticks[0]) for each in found.largest}
    assert largest.keys() == {"tool_position_y", "kinetic"}
    assert largest["kinetic"][0] == pytest.approx(0.5)
    assert largest["kinetic"][1] == 55
    assert largest["tool_position_y"][0] == pytest.approx(3e-3)
    assert 60 <= largest["tool_position_y"][1] < 70
    code, out, _ = call("compare", tap, other)
    assert code == 1
    assert "part at tick 50 (0.05 s) in tool_position_y, by 2.5 µm" in out
    assert "500 mJ at tick 55" in out


def test_clock_and_recorder_make_no_difference(tap: Path, tmp_path: Path) -> None:
    def change(rows: NDArray[np.void]) -> None:
        rows["wake_ns"] += 17
        rows["flags"][5] |= int(TickFlag.OVERRUN)

    assert compare(tap, changed(tap, tmp_path, change)).is_same

    def stale(rows: NDArray[np.void]) -> None:
        rows["flags"][5] |= int(TickFlag.STALE_SAMPLE)

    assert not compare(tap, changed(tap, tmp_path, stale)).is_same


def test_bits_are_compared_by_name_and_counts_as_counts(
    tap: Path, tmp_path: Path, call: Called
) -> None:
    """As numbers, one high bit would outweigh several low ones."""

    def change(rows: NDArray[np.void]) -> None:
        rows["flags"][5] ^= int(TickFlag.REANCHORED)
        rows["flags"][6] ^= int(TickFlag.CLUTCH | TickFlag.FORCE_LIMITED)
        rows["buttons"][7] ^= 1 << 3
        rows["scene_step"][8] += 123456

    other = changed(tap, tmp_path, change)
    sizes = {each.column: each.size for each in compare(tap, other).largest}
    assert sizes == {"flags": 2.0, "buttons": 1.0, "scene_step": 123456.0}
    _, out, _ = call("compare", tap, other)
    assert "in flags, by REANCHORED: " in out
    assert "FORCE_LIMITED, CLUTCH at tick 6" in out
    assert "bit 3 at tick 7" in out and "123456 at tick 8" in out


def test_ticks_out_of_order_are_refused(tap: Path, tmp_path: Path) -> None:
    """Matched by number alone, a run written backwards would be the same run."""

    def backwards(rows: NDArray[np.void]) -> None:
        rows[:] = rows[::-1].copy()

    def twice(rows: NDArray[np.void]) -> None:
        rows["tick"][100:] = rows["tick"][99:-1].copy()

    last = len(read_recording(tap).ticks) - 1
    with pytest.raises(RecordingError, match=rf"tick {last} is followed by tick {last - 1};"):
        compare(tap, changed(tap, tmp_path, backwards))
    with pytest.raises(RecordingError, match=r"tick 99 is followed by tick 99; ticks out of"):
        compare(changed(tap, tmp_path, twice), tap)


def test_input_that_says_otherwise_is_another_run(tap: Path, tmp_path: Path, call: Called) -> None:
    recording = read_recording(tap)
    paths: list[Path] = []
    for share in (1.0, 2.0, 1.0):
        push = {"event": "input", "tick": 5, "time_ns": len(paths), "writes": [["ctrl", 0, share]]}
        events = [recording.events[0], push, *recording.events[1:]]
        paths.append(rewritten(recording, tmp_path / f"{len(paths)}.mcap", events=events))
    assert compare(paths[0], paths[2]).is_same  # at another time of the clock
    found = compare(*paths[:2])
    assert (found.events, found.is_same) == ({"input": (1, 1)}, False)
    assert "events 'input': 1 and 1, which say other things" in call("compare", *paths[:2])[1]


@pytest.mark.parametrize(
    ("value", "told"),
    [
        (np.nan, "no number"),
        (np.inf, "infinitely"),
        (-0.0, "the sign of zero"),
        (5e-324, "4.9e-324"),
    ],
)
def test_a_size_that_is_none_or_the_last_bit_is_told(
    value: float, told: str, tap: Path, tmp_path: Path, call: Called
) -> None:
    def change(rows: NDArray[np.void]) -> None:
        rows["actuator_work"][9] = value

    other = changed(tap, tmp_path, change)
    first = json.loads(compare(tap, other).to_json())["first"]
    assert (first["column"], first["size"] is None) == ("actuator_work", not np.isfinite(value))
    assert f"in actuator_work, by {told}" in call("compare", tap, other)[1]


def test_longer_run_is_another(tap: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reader, "BLOCK", 32)
    recording = read_recording(tap)
    short = rewritten(recording, tmp_path / "short.mcap", ticks=recording.ticks[:-70])
    found, common = compare(tap, short), len(recording.ticks) - 70
    assert (found.first, found.alone, found.compared) == (None, (70, 0), common)
    gap = np.delete(recording.ticks, slice(40, 45))  # it shifts nothing
    found = compare(tap, rewritten(recording, tmp_path / "gap.mcap", ticks=gap))
    assert (found.first, found.alone, found.is_same) == (None, (5, 0), False)


def test_runs_at_two_rates_are_compared_at_common_ticks(tmp_path: Path, call: Called) -> None:
    """A hand at rest: both runs are at rest too, and part in nothing but the rate."""
    paths = [tmp_path / f"{rate}.mcap" for rate in (1000, 400)]
    for path, rate in zip(paths, (1000, 400), strict=True):
        hand = tmp_path / "still.csv"
        hand.write_text("t,x,y,z\n0,0,0,0\n0.1,0,0,0\n")
        recorded(path, "point_mass", f"trajectory:{hand}", duration=0.1, rate=rate)
    found = compare(*paths)
    # 1 ms and 2.5 ms: every 5 ms
    assert (found.ticks, found.compared, found.alone) == ((100, 40), 20, (0, 0))
    assert "period_s" in found.decisive
    names = {each.column for each in found.largest}
    assert "tick" in names  # numbered differently
    assert "handle_position_x" not in names
    code, out, _ = call("compare", *paths)
    assert code == 1
    assert "rates 1000 Hz and 400 Hz: compared at their 20 common ticks" in out


def test_what_decided_run_is_told_where_it_differs(tap: Path, tmp_path: Path, call: Called) -> None:
    meta = {"stiffness": "17.0", "contact": "a", "started": "1970-01-01", "versions": "{}"}
    other = changed(tap, tmp_path, lambda rows: None, meta=meta)
    found = compare(tap, other)
    assert set(found.decisive) == {"stiffness", "contact"}
    assert set(found.beside) == {"versions"}
    assert not found.is_same
    code, out, _ = call("compare", tap, other, "--json")
    told = json.loads(out)
    assert code == 1
    assert told["decisive"]["stiffness"][1] == "17.0"
    assert (told["first"], told["is_same"]) == (None, False)
    versions = {"versions": "{}", "started": "1970-01-01"}
    other = changed(tap, tmp_path, lambda rows: None, meta=versions)
    assert compare(tap, other).is_same  # they may explain a difference, and are none


def test_damage_is_told_and_no_recording_refused(tap: Path, tmp_path: Path, call: Called) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(tap.read_bytes()[:-100])
    code, _, err = call("compare", tap, cut)
    assert "the file is cut: its end is missing" in err
    assert code == 0  # every tick is there
    (tmp_path / "foreign.mcap").write_bytes(b"nothing")
    code, _, err = call("compare", tap, tmp_path / "foreign.mcap")
    assert (code, "not an MCAP file" in err) == (2, True)
    recording = read_recording(tap)
    for period in ("0", "nan", "1e9"):
        other = rewritten(recording, tmp_path / "period.mcap", meta={"period_s": period})
        with pytest.raises(RecordingError, match="period_s"):
            compare(tap, other)
