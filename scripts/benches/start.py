"""Processor time that commands take to start, relative to that of the libraries.

One line per command: the median of user and system time, child processes included, over that of a
process that imports numpy, mujoco, numba and rich. Byte code goes to a folder of its own.

``--cold`` measures the first start on a machine instead, with an empty folder of machine code: what
``scripts/setup`` compiles, then the first run and its audit. Each line has the time of processor
and clock, and the files of machine code after it.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from argument_types import whole
from measuring import in_turn

REFERENCE = "reference"
COMMANDS = {
    REFERENCE: ["-c", "import numpy, mujoco, numba, rich"],
    "version": ["-m", "hapticbridge", "--version"],
    "help": ["-m", "hapticbridge", "--help"],
    "run_help": ["-m", "hapticbridge", "run", "--help"],
    "run": ["-m", "hapticbridge", "run", "point_mass", "--fast", "--duration", "0.1"],
}


def processor_time(arguments: list[str], environment: dict[str, str]) -> float:
    """Returns user and system time in s of a Python process and the processes it waited for."""
    process = subprocess.Popen(
        [sys.executable, *arguments],
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"'{' '.join(arguments)}' failed with exit code {process.returncode}")
    return usage.ru_utime + usage.ru_stime


def add_options(parser: argparse.ArgumentParser) -> None:
    """Adds the number of passes, and the choice of the first start."""
    parser.add_argument("--passes", type=whole, default=7, help="runs of each command")
    parser.add_argument("--cold", action="store_true", help="the first start on a machine instead")


def measure_cold() -> dict[str, float]:
    """Prints the first start on a machine, step by step; returns processor times in s."""
    found: dict[str, float] = {}
    with TemporaryDirectory() as folder:
        environment = os.environ | {"NUMBA_CACHE_DIR": folder}
        recording = str(Path(folder, "run.mcap"))
        steps = {
            "setup": ["-m", "hapticbridge.run.programs"],
            "first_run": [*COMMANDS["run"], "--record", recording],
            "first_audit": ["-m", "hapticbridge", "audit", recording],
        }
        for name, arguments in steps.items():
            start = time.monotonic()
            found[name] = processor_time(arguments, environment)
            passed = time.monotonic() - start
            sizes = [path.stat().st_size for path in Path(folder, "machine_code").rglob("*.*")]
            size = f"{len(sizes)} files, {sum(sizes) / 1e6:.2f} MB"
            print(f"{name} {found[name]:.1f} s, by the clock {passed:.1f} s; {size}")
    return found


def measure(options: argparse.Namespace) -> dict[str, float]:
    """Prints the time of each command; returns the times in s."""
    if options.cold:
        return measure_cold()
    with TemporaryDirectory() as folder:
        environment = os.environ | {"PYTHONPYCACHEPREFIX": folder}
        environment.pop("PYTHONDONTWRITEBYTECODE", None)
        ways = {name: partial(processor_time, each, environment) for name, each in COMMANDS.items()}
        times = in_turn(ways, options.passes)
    medians = {name: float(np.median(values)) for name, values in times.items()}
    for name, own in medians.items():
        print(f"{name} {own / medians[REFERENCE]:.2f} ({own:.2f} s)")
    return medians
