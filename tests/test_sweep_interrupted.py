"""A sweep gives the same table after any interruption, and leaves nothing behind."""

from __future__ import annotations

import functools
import json
import os
import signal
import subprocess
import sys
import threading
from collections import Counter, deque
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Future
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sweep_functions as functions
from sweep_runs import computed, parts, serial

from hapticbridge.signals import holding_interrupts
from hapticbridge.sweep.points import Point, grid, point_key
from hapticbridge.sweep.results import Interrupted, Outcome
from hapticbridge.sweep.sweep import WORKER_DIED, Chunk, InThisProcess, Workers, _Shift, sweep


class Dead(BaseException):
    """What ends a worker."""


class Fragile(Workers):
    """A pool that breaks, with all that is in flight, when a task raises Dead."""

    def __init__(self) -> None:
        super().__init__(InThisProcess(), depth=4)
        self.restarts = 0
        self.broken = False
        self.flying: list[tuple[Future[Any], Callable[..., Any], tuple[object, ...]]] = []

    def submit(self, task: Callable[..., Any], *arguments: object) -> Future[Any]:
        if self.broken:
            raise BrokenExecutor
        future: Future[Any] = Future()
        self.flying.append((future, task, arguments))
        last: list[Point] = arguments[2]  # type: ignore[assignment]
        if len(self.flying) < self.depth and self.restarts == 0 and last[-1]["n"] != 11:
            return future
        for flying, work, given_ones in self.flying:
            try:
                flying.set_result(work(*given_ones))
            except Dead:
                self.broken = True
                break
        for flying, _, _ in self.flying:
            if not flying.done():
                flying.set_exception(BrokenExecutor())
        self.flying.clear()
        return future

    def restart(self) -> None:
        self.restarts += 1
        self.broken = False


DEATHS: Counter[object] = Counter()


def deadly(point: Point) -> dict[str, float]:
    # 8 ends its worker in company and once alone, as a process that was short of memory would
    if point["n"] in (3, 4) or (point["n"] == 8 and DEATHS[8] < 2):
        DEATHS[point["n"]] += 1
        raise Dead
    return {"x": float(point["n"])}


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
@pytest.mark.parametrize(("marker", "code"), [("kill", -9), ("interrupt", 77)])
def test_a_sweep_that_was_killed_goes_on_and_computes_nothing_twice(
    scratch: Path, marker: str, code: int
) -> None:
    (scratch / marker).touch()
    program = [sys.executable, functions.__file__]
    # the pipe ends only when the last worker is gone, so this also sees that no orphan stays
    killed = subprocess.run(
        program, capture_output=True, timeout=60, start_new_session=True, check=False
    )
    assert killed.returncode == code, killed.stderr
    assert marker == "kill" or not killed.stderr
    folder = scratch / "parts"
    kept = len(parts(folder))
    assert 0 < kept < len(functions.COUNTED)
    name = json.loads((folder / "sweep.json").read_text())["function"]
    assert name == "sweep_functions.counted"
    resumed = sweep(
        functions.counted, functions.COUNTED, folder=folder, executor=InThisProcess(), chunk=1
    )
    often = computed(scratch)
    # what was in flight is computed again, at most two tasks a worker; what was kept is not
    assert sum(often.values()) - len(functions.COUNTED) <= len(functions.COUNTED) - kept
    assert sum(count > 1 for count in often.values()) <= 2 * (os.cpu_count() or 1)
    assert resumed.equals(serial(functions.counted, functions.COUNTED))


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
def test_ctrl_c_while_workers_start_ends_them_without_a_word(scratch: Path) -> None:
    (scratch / "start").touch()
    program = [sys.executable, functions.__file__]
    stopped = subprocess.run(
        program, capture_output=True, timeout=60, start_new_session=True, check=False
    )
    assert not (scratch / "start").exists()
    assert (stopped.returncode, stopped.stdout, stopped.stderr) == (77, b"", b"")
    assert parts(scratch / "parts") == []


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
def test_interrupts_are_held_for_a_while_and_then_arrive() -> None:
    def is_held() -> bool:
        return signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ())

    def interrupt() -> None:
        gate.wait()
        signal.raise_signal(signal.SIGINT)  # this thread takes what the main thread holds back

    done, gate = [], threading.Event()
    other = threading.Thread(target=interrupt)
    other.start()
    with pytest.raises(KeyboardInterrupt), holding_interrupts():
        assert is_held()
        with holding_interrupts():
            gate.set()
            other.join()
        done.append("all of it")
    assert done
    assert not is_held()


def test_a_worker_that_is_killed_once_costs_nothing(scratch: Path) -> None:
    (scratch / "die").touch()
    table = sweep(functions.counted, functions.COUNTED, chunk=4)
    assert not (scratch / "die").exists()
    assert not table.failed.any()
    assert table.equals(serial(functions.counted, functions.COUNTED))


def test_points_that_end_their_worker_are_found_and_recorded() -> None:
    points = grid(n=range(12))
    keyed = {point_key(point): point for point in points}
    chunks: deque[Chunk] = deque(
        {key: keyed[key] for key in list(keyed)[start : start + 3]} for start in range(0, 12, 3)
    )
    done: dict[str, Outcome] = {}
    DEATHS.clear()
    workers = Fragile()
    shift = _Shift(
        workers, deadly, False, lambda chunk, out: done.update(zip(chunk, out, strict=True))
    )
    shift.work(chunks)
    assert DEATHS[8] == 2
    assert workers.restarts == DEATHS.total()
    for key, point in keyed.items():
        dead = point["n"] in (3, 4)
        assert done[key] == Outcome({} if dead else {"x": point["n"]}, WORKER_DIED if dead else "")


def test_ctrl_c_keeps_what_is_done(scratch: Path) -> None:
    (scratch / "ctrl-c").touch()
    folder = scratch / "parts"
    again = functools.partial(
        sweep,
        functions.counted,
        functions.COUNTED,
        folder=folder,
        executor=InThisProcess(),
        chunk=2,
    )
    with pytest.raises(Interrupted) as stop:
        again()
    assert len(parts(folder)) == 3
    whole = serial(functions.counted, functions.COUNTED)
    assert stop.value.table.equals(whole.select(np.arange(6)))
    assert again().equals(whole)
    assert computed(scratch)[5] == 2  # once in the folder, once in the serial run


def test_parts_that_were_cut_changed_or_come_from_elsewhere_are_computed_again(
    scratch: Path,
) -> None:
    folder, other = scratch / "mine", scratch / "other"
    again = functools.partial(sweep, executor=InThisProcess(), chunk=1)
    expected = again(functions.counted, functions.COUNTED, folder=folder)
    cut, changed, gone, *_ = parts(folder)
    cut.write_bytes(cut.read_bytes()[:-9])
    changed.write_bytes(changed.read_bytes().replace(b"0.1,", b"0.2,"))
    lost = [int(path.read_text().splitlines()[1].split(",")[1]) for path in (changed, gone)]
    again(functools.partial(functions.plus, more=1), functions.COUNTED, folder=other)
    gone.unlink()
    for path in parts(other):
        (folder / path.name).write_bytes(path.read_bytes())
    (folder / ("part-" + "0" * 32 + ".csv")).write_text("point,kinds,error\n")
    before = computed(scratch)
    assert again(functions.counted, functions.COUNTED, folder=folder).equals(expected)
    fresh = computed(scratch) - before
    assert sum(fresh.values()) == 3
    assert set(lost) <= set(fresh)


def test_what_a_killed_sweep_was_writing_is_removed_and_nothing_else(scratch: Path) -> None:
    folder = scratch / "parts"
    again = functools.partial(
        sweep,
        functions.counted,
        functions.COUNTED,
        folder=folder,
        executor=InThisProcess(),
        chunk=4,
    )
    again()
    kept = sorted(folder.iterdir())
    (folder / f".draft-4711-{kept[0].name}").write_bytes(b"poi")
    (folder / ".draft-4711-sweep.json").touch()
    (folder / "my.draft-notes").touch()
    again()
    assert sorted(folder.iterdir()) == sorted([*kept, folder / "my.draft-notes"])
