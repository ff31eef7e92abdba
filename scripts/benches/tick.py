"""One tick of the bridge against bare ``mj_step`` on the same scene, state and motion.

One line per scene, "NAME 1.23 x ...": the ratio of the medians of a whole tick of the bridge's own
loop (clock, device, step, wrench, ledger, guard, record into the ring) to ``mj_step`` alone. The
guard is whole: limits, energy account and passivity controller. The two run
interleaved in one process: a block of ticks through the bridge, then the same ticks, from the same
state and with the same inputs, on a second copy of the scene, where the parts of a plain tick are
timed one by one. Bare ``mj_step`` runs on a third copy, from the state of every tick, with the
contacts of the scene and with the timers of MuJoCo's stages, as its package has them; a run turns
them off.

The bridge runs as it does by default, pipelined, and once more plain. "sample to wrench 0.80 x" is
the time that the device waits over bare ``mj_step``; what the pipeline leaves of it stands behind.

``--against CHECKOUT`` compares this checkout with another one instead: "NAME tick 1.01 x" is what a
tick costs here over what it costs there. In each pass either has a fresh process of its own, its
own ``.venv`` if it has one and its own ``scripts/tick_blocks.py`` if it has that; both are pinned
to one core and run the same blocks of ticks in turn. The ratio of a pass is the median over its
blocks; "0.99 to 1.02" is the range of the passes' ratios, which holds the true median with the
probability printed beside it.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from argument_types import whole
from measuring import in_turn, interval
from numpy.typing import NDArray
from tick_blocks import BLOCK, UnpacedClock

from hapticbridge import Bridge, load_scene
from hapticbridge.demand.methods import prepare
from hapticbridge.kernel.jit import direct
from hapticbridge.kernel.record import SAMPLE_DTYPE
from hapticbridge.kernel.state import BoundKernel
from hapticbridge.kernel.tick import after_step, before_step

SCENES = {"point_mass": False, "peg_in_hole": True, "hex_key": True, "drawer": False}
"""Scenes, each with True if only ticks in contact count."""

METHODS = ("implicit", "compensated", "lossless")
"""The methods with a guarantee, the first as the measure of the others."""

COPIED = ("qpos", "qvel", "act", "qacc_warmstart", "qfrc_applied")
"""Parts of the state that bare ``mj_step`` starts from, besides the inputs of the tick."""

PARTS = ("tick", "sample to wrench", "before_step", "step", "after_step", "mj_step")
"""Timed parts: of the bridge's tick the first two, the others on copies of the scene."""

MOTION = 8.0
HERE = Path(__file__).resolve().parents[2]
Times = NDArray[np.float64]


def times_of(name: str, method: str, *, pipelined: bool) -> dict[str, Times]:
    """Runs a scene along its hand path once; returns the times in ns of the counted ticks."""
    scene, shadow, bare = (load_scene(name) for _ in range(3))
    kept: dict[str, list[Times]] = {part: [] for part in PARTS}
    now, mj_step = time.perf_counter_ns, mujoco.mj_step
    sample = np.zeros(1, SAMPLE_DTYPE)
    clock = UnpacedClock()
    with Bridge(
        scene, "simulated", method=method, clock=clock, pipelined=pipelined, controller="damper"
    ) as bridge:
        prepare(shadow, bridge.setup.coupling, bridge.period, 1, bridge.setup.method)
        stock = bridge.setup.method.with_contact("scene")
        prepare(bare, bridge.setup.coupling, bridge.period, 1, stock, warns=False)
        binding = BoundKernel(shadow.model, shadow.data, bridge.session.parameters)
        step, stepped_alone = binding.step, bare.data
        state, row, model, data = binding.state, binding.row, shadow.model, shadow.data
        before, after = (
            direct(before_step, state, sample, row, 0, 0.0),
            direct(after_step, state, row, 0),
        )
        last = 0
        for _ in range(round(MOTION / bridge.period) // BLOCK):
            bridge.run(BLOCK * bridge.period)
            rows = bridge.latest_records(BLOCK)
            parts = np.zeros((BLOCK, 6), dtype=np.int64)
            if last:
                binding.resume()
            elapsed = np.diff(rows["read_ns"], prepend=last)
            last = rows["read_ns"][-1]
            for k in range(BLOCK):
                sample["position"] = rows["device_position"][k]
                sample["quaternion"] = rows["device_quaternion"][k]
                binding.external_flags[0] = rows["flags"][k]
                for field in COPIED:
                    getattr(stepped_alone, field)[:] = getattr(data, field)
                begin = now()
                before(state, sample, row, 0, 1e-9 * float(elapsed[k]))
                stepping = now()
                step(model, data)
                stepped = now()
                after(state, row, 0)
                ended = now()
                for field in ("mocap_pos", "mocap_quat", "ctrl"):
                    getattr(stepped_alone, field)[:] = getattr(data, field)
                alone = now()
                mj_step(bare.model, stepped_alone)
                parts[k] = begin, stepping, stepped, ended, alone, now()
            if not np.array_equal(data.qpos, scene.data.qpos):
                raise SystemExit(f"{name}: the bare steps went another way than the bridge")
            counted = (rows["contacts"][:-1] > 0) | (not SCENES[name])
            times = {
                "tick": np.diff(rows["wake_ns"]),
                "sample to wrench": (rows["write_ns"] - rows["read_ns"])[:-1],
                "before_step": (parts[:, 1] - parts[:, 0])[:-1],
                "step": (parts[:, 2] - parts[:, 1])[:-1],
                "after_step": (parts[:, 3] - parts[:, 2])[:-1],
                "mj_step": (parts[:, 5] - parts[:, 4])[:-1],
            }
            for part, values in times.items():
                kept[part].append(values[counted].astype(np.float64))
    return {part: np.concatenate(values) for part, values in kept.items()}


def clock_cost() -> float:
    """Returns the median time between two readings of the clock, in ns."""
    now = time.perf_counter_ns
    return float(np.median([-(now() - now()) for _ in range(20000)]))


Passes = Mapping[tuple[str, bool], list[dict[str, Times]]]
"""Results of ``times_of`` per method, pipelined and plain."""


def ratio(passes: Passes, method: str, over: str, part: str, reading: float) -> str:
    """Returns the tick of a method over a part of another's, pass by pass."""
    pairs = zip(passes[method, True], passes[over, True], strict=True)
    return interval(
        [
            float((np.median(mine["tick"]) - reading) / (np.median(other[part]) - reading))
            for mine, other in pairs
        ]
    )


def report(name: str, method: str, passes: Passes, reading: float) -> dict[str, float]:
    """Prints ratio and parts of the time; returns the medians in µs, pipelined and plain."""
    joined = [
        {part: np.concatenate([one[part] for one in passes[method, pipelined]]) for part in PARTS}
        for pipelined in (True, False)
    ]
    (ahead, before), (late, plain_late) = (
        [
            {part: float(of(values) - reading) * 1e-3 for part, values in each.items()}
            for each in joined
        ]
        for of in (np.median, lambda values: np.percentile(values, 99))
    )
    print(
        f"{name} {method} {ratio(passes, method, method, 'mj_step', reading)}: tick "
        f"{ahead['tick']:.2f} µs, bare mj_step {ahead['mj_step']:.2f} µs; p99 {late['tick']:.2f} "
        f"and {late['mj_step']:.2f} µs; {joined[0]['tick'].size} ticks counted"
    )
    answer = "sample to wrench"
    print(
        f"  {answer} {ahead[answer]:.2f} µs (p99 {late[answer]:.2f} µs); plain "
        f"{before[answer]:.2f} µs (p99 {plain_late[answer]:.2f} µs) of {before['tick']:.2f} µs"
    )
    # parts are timed on a copy of their own, and medians do not add up
    rest = before["tick"] - sum(before[part] for part in ("before_step", "step", "after_step"))
    print(
        f"  of the plain tick: before_step {before['before_step']:.2f}, step {before['step']:.2f}, "
        f"after_step {before['after_step']:.2f}, device, record, clock and loop {rest:.2f} µs"
    )
    if method != METHODS[0]:
        words = ratio(passes, method, METHODS[0], "tick", reading)
        print(f"  {words} the tick of {METHODS[0]}")
    return ahead | {f"plain {part}": value for part, value in before.items()}


@contextmanager
def worker(checkout: Path, core: int) -> Iterator[subprocess.Popen[str]]:
    """Starts the process that times blocks of a checkout, on one core."""
    python, script = checkout / ".venv/bin/python", checkout / "scripts/tick_blocks.py"
    process = subprocess.Popen(
        [
            python if python.is_file() else sys.executable,
            script if script.is_file() else HERE / "scripts/tick_blocks.py",
        ],
        env={**os.environ, "PYTHONPATH": str(checkout)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    with process:
        os.sched_setaffinity(process.pid, {core})
        yield process


def answer(process: subprocess.Popen[str], **asked: object) -> dict[str, float | None]:
    """Sends a request to a worker and waits for the answer."""
    if process.stdin is None or process.stdout is None:
        raise SystemExit("the process that times blocks has no pipes")
    print(json.dumps(asked), file=process.stdin, flush=True)
    line = process.stdout.readline()
    if not line:
        raise SystemExit("the process that times blocks ended; its error stands above")
    return dict(json.loads(line))


def ratios_of_a_pass(pair: list[subprocess.Popen[str]], name: str, method: str) -> dict[str, float]:
    """Runs a scene along its hand path in both, block by block; returns the median ratios."""
    for process in pair:
        answer(process, scene=name, method=method, in_contact=SCENES[name])
    kept: dict[str, list[float]] = {}
    for k in range(round(MOTION * 1000) // BLOCK):
        order = pair if k % 2 else pair[::-1]
        times = {process.pid: answer(process) for process in order}
        here, there = (times[process.pid] for process in pair)
        for part in here:
            mine, other = here[part], there[part]
            if mine is not None and other is not None:
                kept.setdefault(part, []).append(mine / other)
    return {part: float(np.median(values)) for part, values in kept.items()}


def compare_checkouts(other: Path, passes: int, scenes: Sequence[str]) -> dict[str, list[float]]:
    """Prints the cost of a tick in this checkout relative to another one; returns the ratios."""
    if other == HERE or not (other / "hapticbridge").is_dir():
        raise SystemExit(f"'{other}' is no other checkout of hapticbridge")
    core = max(os.sched_getaffinity(0))
    kept: dict[tuple[str, str, str], list[float]] = {}
    for k in range(passes):
        with ExitStack() as stack:
            order = (HERE, other) if k % 2 else (other, HERE)
            started = {at: stack.enter_context(worker(at, core)) for at in order}
            pair = [started[HERE], started[other]]
            for name, method in product(scenes, METHODS):
                for part, one in ratios_of_a_pass(pair, name, method).items():
                    kept.setdefault((name, method, part), []).append(one)
    print(f"this checkout over {other}, {passes} passes on core {core}")
    for key, values in kept.items():
        print(f"{' '.join(key)} {interval(values)}")
    for part in ("tick", "sample to wrench"):
        rows = [values for key, values in kept.items() if key[-1] == part]
        print(f"all {part} {interval(np.median(rows, axis=0).tolist())}")
    return {" ".join(key): values for key, values in kept.items()}


def add_options(parser: argparse.ArgumentParser) -> None:
    """Adds the number of passes, the scenes and the checkout to compare with."""
    parser.add_argument("--passes", type=whole, default=6, help="passes over each hand path")
    parser.add_argument("--against", type=Path, help="checkout to compare this one with")
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=[*SCENES], help="only these")


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """Prints the costs; returns them."""
    if options.against is not None:
        return compare_checkouts(options.against.resolve(), options.passes, options.scenes)
    reading, found = clock_cost(), {}
    for name in options.scenes:
        ways = {
            (method, pipelined): partial(times_of, name, method, pipelined=pipelined)
            for method in METHODS
            for pipelined in (True, False)
        }
        passes = in_turn(ways, options.passes)
        for method in METHODS:
            found[f"{name} {method}"] = report(name, method, passes, reading)
    return found
