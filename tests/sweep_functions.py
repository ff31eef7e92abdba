"""Functions that tests sweep; workers import this module, and a test runs it as a program."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from hapticbridge.sweep import Value, grid, sweep

LAST_IS_DONE = threading.Event()
COUNTED = grid(n=range(12), gain=[0.1])


def scratch() -> Path:
    return Path(os.environ["SWEEP_SCRATCH"])


def once(name: str) -> bool:
    """Tells whether a test laid this marker out, and takes it away."""
    try:
        (scratch() / name).unlink()
    except FileNotFoundError:
        return False
    return True


def blas_threads(point: Mapping[str, float]) -> dict[str, Value]:
    """Returns for how many threads OpenBLAS was asked, and how many this process has."""
    a = np.random.default_rng(0).random((300, 300))
    np.linalg.solve(a, a)
    tasks = Path("/proc/self/task")
    threads = len(list(tasks.iterdir())) if tasks.is_dir() else 0
    return {"asked": os.environ.get("OPENBLAS_NUM_THREADS", "none"), "threads": threads}


def bound(point: Mapping[str, float]) -> dict[str, Value]:
    needed = point["stiffness"] * 1e-3 / 2 + point["damping"]
    if point["stiffness"] == 3000.0 and point["damping"] == 0.2:
        raise ValueError(f'no\r\n"bound", at {needed}\udc80')
    return {
        "needed": needed / 3,
        "passive": needed < 1,
        "ticks": int(needed * 1e6),
        "verdict": 'a,"b"\n\r' if needed < 1 else "",
        "limit": float("inf") if needed > 2 else float("nan"),
    }


def last_ends_first(point: Mapping[str, int]) -> dict[str, Value]:
    if point["n"] == 0:
        assert LAST_IS_DONE.wait(20)
    if point["n"] == 7:
        LAST_IS_DONE.set()
    return {"square": point["n"] ** 2}


def counted(point: Mapping[str, float]) -> dict[str, Value]:
    """Leaves a line for each computation; kills, dies or interrupts where a marker says so."""
    with (scratch() / "computed").open("a") as file:
        file.write(f"{point['n']}\n")
    if point["n"] == 7 and once("kill"):
        os.kill(os.getppid(), signal.SIGKILL)
        threading.Event().wait()  # an orphan that nobody ends, unless it ends itself
    if point["n"] == 7 and once("interrupt"):
        os.killpg(os.getpgid(0), signal.SIGINT)
        threading.Event().wait()
    if point["n"] == 7 and once("die"):
        os._exit(9)
    if point["n"] in (3, 4) and (scratch() / "poison").exists():
        os._exit(9)
    if point["n"] == 7 and once("ctrl-c"):
        raise KeyboardInterrupt
    return {"third": point["n"] * point["gain"] / 3}


def oddities(point: Mapping[str, int]) -> object:
    return [
        {"x": 1.5, "extra": True},
        None,
        {"x": [1.0]},
        {"n": 1.0},
        {"x": 2**70},
        {1: 1.0},
        {"x": "\ud800"},
        {"x": 2, "late": "text"},
    ][point["n"]]


def plus(point: Mapping[str, float], more: float) -> dict[str, Value]:
    return {"sum": point["n"] + more}


if __name__ == "__mp_main__" and once("start"):  # a worker that starts imports the program
    os.killpg(os.getpgid(0), signal.SIGINT)
    threading.Event().wait(0.1)  # Python looks at signals now and then

if __name__ == "__main__":
    import sweep_functions

    try:
        sweep(sweep_functions.counted, COUNTED, results=scratch() / "kept", chunk=1)
    except KeyboardInterrupt:
        sys.exit(77)
