"""Time and memory of the audit of a recording, and the time of the audit of many.

A run of the peg, and one ten times as long, are audited in processes of their own, which gives
their peaks of memory. Copies of the first are audited as ``hapticbridge audit FOLDER`` does.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import shutil
import tempfile
import time
from functools import partial
from pathlib import Path

import numpy as np
from argument_types import positive, whole
from measuring import in_turn

from hapticbridge import Bridge, SimulatedClock, audit
from hapticbridge.audit.batch import audit_all


def peak_of(path: Path) -> tuple[float, float]:
    """Audits one recording; returns the time it took in s and the process's peak in MB."""
    start = time.perf_counter()
    audit(path)
    took = time.perf_counter() - start
    return took, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def alone(path: Path) -> tuple[float, float]:
    """Audits one recording in a fresh process."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(peak_of, (path,))


def add_options(parser: argparse.ArgumentParser) -> None:
    """Adds numbers and lengths of the recordings."""
    parser.add_argument("--count", type=whole, default=20, help="recordings that are audited")
    parser.add_argument("--duration", type=positive, default=60.0, help="of each, in s")
    parser.add_argument("--jobs", type=whole, default=2, help="processes")
    parser.add_argument("--passes", type=whole, default=3, help="audits of each length")


def measure(options: argparse.Namespace) -> dict[str, float]:
    """Prints times and peaks; returns the times in s."""
    lengths = (options.duration, 10 * options.duration)
    with tempfile.TemporaryDirectory() as name:
        paths = {length: Path(name) / f"{length:g}.mcap" for length in lengths}
        for length, path in paths.items():
            with Bridge(
                "peg_in_hole", "simulated", clock=SimulatedClock(), recording=path
            ) as bridge:
                bridge.run(length)
        found = in_turn(
            {length: partial(alone, path) for length, path in paths.items()}, options.passes
        )
        files = [Path(name) / f"{index}.mcap" for index in range(options.count)]
        for copy in files:
            shutil.copyfile(paths[lengths[0]], copy)
        start = time.perf_counter()
        audit_all(files, workers=options.jobs)
        many = time.perf_counter() - start
    medians = {f"{length:g} s": np.median(each, axis=0) for length, each in found.items()}
    for length, (took, peak) in medians.items():
        print(f"a recording of {length}: {took:.2f} s, peak of memory {peak:.0f} MB")
    print(f"{options.count} of the shorter on {options.jobs} processes: {many:.1f} s")
    return {"many": many} | {length: float(took) for length, (took, _) in medians.items()}
