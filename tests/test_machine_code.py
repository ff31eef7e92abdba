"""Machine code on disk: it computes what Python does; a bad file or folder costs only time."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from hapticbridge import jit, machine_code
from hapticbridge.jit import compiled, direct

PAIR = np.dtype([("first", "<f8"), ("second", "<i8")])


def weighted(
    table: NDArray[np.float64],
    pairs: NDArray[np.void],
    pair: Any,
    factor: float,
    shift: int,
    negates: bool,
) -> float:
    total = factor * table[1, 2] + table[-1, -1] + pairs[1]["first"] + pair["first"] + table.size
    table[0, 0] = total + shift + pair["second"]
    return float(-total if negates else total)


def is_above(pair: Any, limit: float) -> bool:
    return bool(pair["first"] > limit)


def rows_of(table: NDArray[np.float64]) -> int:
    return int(table.shape[0] + 10 * table.shape[1])


def clear(table: NDArray[np.float64]) -> None:
    for row in table:
        for i in range(row.size):
            row[i] = 0.0


def allocating(table: NDArray[np.float64]) -> float:
    return float(np.cumsum(table[0])[-1])


def raising(table: NDArray[np.float64]) -> int:
    if table[0, 0] > 0.0:
        raise ValueError("positive")
    return 1


def arguments_of_weighted() -> tuple[Any, ...]:
    pairs = np.array([(1.5, 2), (2.5, 3)], PAIR)
    return np.arange(12.0).reshape(3, 4), pairs, pairs[0], 0.1, 7, True


CASES: dict[str, tuple[Callable[..., Any], Callable[[], tuple[Any, ...]]]] = {
    "every kind of argument": (weighted, arguments_of_weighted),
    "truth": (is_above, lambda: (np.ones(1, PAIR)[0], 0.5)),
    "integer": (rows_of, lambda: (np.zeros((3, 4)),)),
    "no result": (clear, lambda: (np.ones((3, 4)),)),
    "allocation": (allocating, lambda: (np.ones((3, 4)),)),
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A cache of its own."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    jit.cache_folder.cache_clear()
    yield Path(jit.cache_folder())
    jit.cache_folder.cache_clear()


@pytest.mark.parametrize("name", CASES)
def test_machine_code_from_disk_does_what_python_does(name: str, folder: Path) -> None:
    function, arguments = CASES[name]
    expected = arguments()
    result = function(*expected)
    for _ in range(2):  # compiled, then from disk
        given = arguments()
        answer = direct(compiled(function), *given)(*given)
        assert answer == result
        assert isinstance(answer, type(result)) or isinstance(result, type(answer))
        for one, other in zip(given, expected, strict=True):
            assert np.array_equal(one, other)
    (path,) = folder.glob("*.o")
    assert bool(machine_code.read(path)) == (name != "allocation")


def test_an_exception_is_raised_although_machine_code_cannot(folder: Path) -> None:
    function = direct(compiled(raising), np.zeros((1, 1)))
    assert function(np.zeros((1, 1))) == 1
    with pytest.raises(ValueError, match="positive"):
        function(np.ones((1, 1)))
    (path,) = folder.glob("*.o")
    assert machine_code.read(path) == b""


@pytest.mark.parametrize(
    "spoil",
    [
        lambda path: path.write_bytes(path.read_bytes()[:-1]),
        lambda path: path.write_bytes(b""),
        lambda path: path.write_bytes(hashlib.sha256(b"no code").digest() + b"no code"),
        lambda path: path.chmod(0o666),
    ],
    ids=["cut off", "empty", "no object file", "writable by others"],
)
def test_a_file_that_cannot_be_trusted_costs_only_time(
    spoil: Callable[[Path], Any], folder: Path
) -> None:
    table = np.zeros((3, 4))
    direct(compiled(rows_of), table)
    (path,) = folder.glob("*.o")
    spoil(path)
    assert direct(compiled(rows_of), table)(table) == 43
    assert machine_code.read(path)  # written again, except for the code with a right digest


def test_a_file_that_others_can_write_is_not_loaded(folder: Path) -> None:
    machine_code.write(folder / "a.o", b"code")
    assert machine_code.read(folder / "a.o") == b"code"
    (folder / "a.o").chmod(0o620)
    assert machine_code.read(folder / "a.o") is None


def test_a_folder_that_cannot_be_written_costs_only_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file" / "cache"))
    jit.cache_folder.cache_clear()
    try:
        table = np.zeros((3, 4))
        assert direct(compiled(rows_of), table)(table) == 43
        assert direct(compiled(allocating), table)(table) == 0.0
        assert compiled(rows_of)(table) == 43
    finally:
        jit.cache_folder.cache_clear()
    assert list(tmp_path.iterdir()) == [tmp_path / "file"]


def test_types_of_one_size_have_code_of_their_own(folder: Path) -> None:
    turned = np.dtype([("second", "<i8"), ("first", "<f8")])
    function = compiled(is_above)
    for dtype in (PAIR, turned):
        record = np.zeros(1, dtype)
        record["second"], record["first"] = 5, 0.25
        assert not direct(function, record[0], 0.0)(record[0], 0.5)
        assert direct(function, record[0], 0.0)(record[0], 0.2)
    assert len(list(folder.glob("*.o"))) == 2


RUN = """
import itertools, sys
import hapticbridge as hb
from hapticbridge.commands import Couple, Reset, Switch
with hb.Bridge("point_mass", "simulated", clock=hb.SimulatedClock()) as bridge:
    bridge.session.commands.now = itertools.count(1.0).__next__
    bridge.run(0.02)
    for command in (Couple(500.0, 1.0), Switch(force=False), Switch(force=True), Reset()):
        bridge.command(command)
        bridge.run(0.5)
print("numba" in sys.modules)
"""


def test_a_run_with_commands_needs_no_numba_once_its_code_is_on_disk() -> None:
    for _ in range(2):
        process = subprocess.run(
            [sys.executable, "-c", RUN], capture_output=True, text=True, check=True
        )
    assert process.stdout == "False\n"
