"""Processor time that commands take to start, relative to that of the libraries.

One line per command: the median of user and system time, child processes included, over that of a
process that imports numpy, mujoco, numba and rich. Byte code goes to a folder of its own; the
first start on a machine compiles for longer.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from functools import partial
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
    """Adds the number of passes."""
    parser.add_argument("--passes", type=whole, default=7, help="runs of each command")


def measure(options: argparse.Namespace) -> dict[str, float]:
    """Prints the time of each command; returns the times in s."""
    with TemporaryDirectory() as folder:
        environment = os.environ | {"PYTHONPYCACHEPREFIX": folder}
        environment.pop("PYTHONDONTWRITEBYTECODE", None)
        ways = {name: partial(processor_time, each, environment) for name, each in COMMANDS.items()}
        times = in_turn(ways, options.passes)
    medians = {name: float(np.median(values)) for name, values in times.items()}
    for name, own in medians.items():
        print(f"{name} {own / medians[REFERENCE]:.2f} ({own:.2f} s)")
    return medians
