"""A scene slower than the loop: a tap on a wall, the loop's times, the scene's throughput.

The first table is deterministic: the tool of ``virtual_wall``, 50 g, runs against its wall at
0.2 m/s, and the handle stops 5 mm behind it. K is 800 N/m, and the 0.8 m/T_s² up to which a tool is
shown steadily. The rise time is that from the
handle's passing the wall to 90 % of the force at rest, the penetration the farthest that the shown
tool was beyond its place at rest.
The rest is of this machine: runs in turn, on the simulated device and on one that only reports a
pose, and the time of the scene's ticks over that of MuJoCo's steps in them. A tick is timed twice,
from the sample to the wrench: in real time, with ``realtime=True``, where the processor has slept
before and its caches are cold, and in a loop without a pause.
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from argument_types import positive, whole
from kernel_runs import T
from measuring import in_turn
from numpy.typing import NDArray
from test_kernel_shown_tool import Loop
from tick_blocks import UnpacedClock

from hapticbridge import SAMPLE_DTYPE, Coupling, DeviceInfo
from hapticbridge.clock import SimulatedClock
from hapticbridge.recording import read_recording
from hapticbridge.run.bridge import Bridge

SPEED, WALL, DEPTH, MASS = 0.2, 0.01, 0.005, 0.05
"""Speed in m/s, way to the wall in m, way of the handle beyond it in m, mass of the tool in kg."""


def tap(ticks: int, stiffness: float, *, has_planes: bool = True) -> dict[str, float]:
    """Returns a tap's forces in N, rise in ms, penetration in mm, and if the peak came too early.

    ``is_early`` is 1 where the largest force came before the handle had passed the wall. The depth
    of a shown tool that came to rest without force is that inside the wall.
    """
    motion = np.zeros((600, 3))
    motion[:, 0] = np.minimum(SPEED * T * np.arange(len(motion)), WALL + DEPTH)
    law = Coupling(stiffness, 0.5, 0.8, 5e-4)
    loop = Loop("virtual_wall", ticks, law)
    if not has_planes:  # no geom is the tool's
        nothing = np.zeros(loop.scene.model.ngeom, np.int32)
        loop.fast.state["mj"]["geom_is_tool"] = nothing.ctypes.data
        loop.slow.state["mj"]["geom_is_tool"] = nothing.ctypes.data
    rows = loop.run(motion)
    force, place = rows["wrench_on_tool"][:, 0], rows["tool_position"][:, 0]
    rest, resting = float(np.mean(force[-100:])), float(place[-100:].mean())
    met = int(np.argmax(motion[:, 0] > WALL))
    risen = int(np.argmax(force[met:] >= 0.9 * rest))
    from_wall = WALL if rest < EMPTY else resting
    return {
        "peak_n": float(force.max()),
        "rest_n": rest,
        "rise_ms": 1e3 * risen * T,
        "penetration_mm": 1e3 * float(place.max() - from_wall),
        "is_early": float(np.argmax(force) < met),
    }


EMPTY = 1e-3
"""Force at rest in N below which a spring counts as empty: the tool is shown inside the wall."""


def taps() -> list[dict[str, Any]]:
    """Returns the rows of the table of taps: stiffness, scene, planes and what ``tap`` found."""
    cases = [(800.0, n, planes) for n in (0, 5, 10) for planes in (True, False)[: n or 1]]
    for n in (10, 20):
        steady = 0.8 * MASS / (n * T) ** 2
        cases += [(steady, 0, True), (steady, n, True), (steady, n, False)]
    return [
        {"stiffness": stiffness, "ticks": ticks, "planes": planes}
        | tap(ticks, stiffness, has_planes=planes)
        for stiffness, ticks, planes in cases
    ]


def print_taps(rows: list[dict[str, Any]]) -> None:
    """Prints the table of taps."""
    print("K in N/m | scene | planes | peak in N | at rest in N | 90 % in ms | beyond rest in mm")
    for row in rows:
        name = f"{1.0 / (max(row['ticks'], 1) * T):g} Hz"
        used = ("yes" if row["planes"] else "no") if row["ticks"] else "-"
        numbers = (
            f"{row['peak_n']:.2f} | {row['rest_n']:.2f} | {row['rise_ms']:.0f} | "
            f"{row['penetration_mm']:.2f}"
        )
        print(f"{row['stiffness']:g} | {name} | {used} | {numbers}")


SPAN = 0.25
"""Duration in s of a part of a run without a pause; its records fit the ring."""


class Reporter:
    """Device whose handle moves by 1 mm at 1 rad/s, and which costs nearly nothing."""

    info = DeviceInfo(name="reporter", axes=("x", "y", "z"), force_limit=10.0, is_real=False)

    def start(self, period: float) -> NDArray[np.void]:
        """Returns the pose at the start."""
        self.period, self.tick = period, 0
        return np.array([((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0)], SAMPLE_DTYPE)

    def read(self, sample: NDArray[np.void]) -> int:
        """Reports the pose."""
        self.tick += 1
        sample["position"][0, 0] = 1e-3 * math.sin(self.tick * self.period)
        return 0

    def write(self, wrench: NDArray[np.float64]) -> None:
        """Drops the force."""

    def close(self) -> None:
        """Has nothing to release."""


def tick_time(scene: str, rate: float, device: str | Reporter, seconds: float) -> float:
    """Returns the median time of a tick in s in a loop without a pause."""
    times = []
    clock = UnpacedClock()
    with Bridge(scene, device, clock=clock, scene_rate=rate) as bridge:
        for _ in range(round(seconds / SPAN)):
            bridge.run(SPAN)
            ticks = bridge.latest_records(round(SPAN / bridge.period))
            times.append(ticks["write_ns"] - ticks["read_ns"])
    return 1e-9 * float(np.median(np.concatenate(times)))


def loop_times(
    scene: str, rate: float, device: str | Reporter, seconds: float
) -> tuple[float, float]:
    """Returns median time of a tick and 99th percentile of its lateness in s, in real time."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.mcap"
        with Bridge(scene, device, recording=path, scene_rate=rate, realtime=True) as bridge:
            bridge.run(seconds)
        ticks = read_recording(path).ticks
    busy = ticks["write_ns"] - ticks["read_ns"]
    late = ticks["wake_ns"] - ticks["deadline_ns"]
    return 1e-9 * float(np.median(busy)), 1e-9 * float(np.quantile(late, 0.99))


def throughput(scene: str, rate: float, steps: int) -> float:
    """Returns the time of the scene's ticks over that of MuJoCo's steps in them."""
    inside = [0.0]
    with Bridge(scene, "simulated", clock=SimulatedClock(), scene_rate=rate) as bridge:
        slow = bridge.session.slow
        assert slow is not None
        step, do_step, whole = slow.step, slow._do_step, [0.0]

        def timed_step(*arguments: Any) -> None:
            began = time.thread_time()
            step(*arguments)
            inside[0] += time.thread_time() - began

        def timed_tick() -> int:
            began = time.thread_time()
            code = do_step()
            whole[0] += time.thread_time() - began
            return code

        slow.step, slow._do_step = timed_step, timed_tick  # type: ignore[method-assign]
        bridge.run(steps / rate)
    return whole[0] / inside[0]


def add_options(parser: argparse.ArgumentParser) -> None:
    """Adds durations and numbers of runs."""
    parser.add_argument("--seconds", type=positive, default=8.0, help="of each run in real time")
    parser.add_argument("--passes", type=whole, default=3, help="runs of each in real time")


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """Prints the table and the times; returns both."""
    print_taps(made := taps())
    cases: dict[str, tuple[str, float, str | Reporter, float]] = {
        f"{scene}, {name}": (scene, rate, device, options.seconds)
        for scene, rate in (("beads", 80.0), ("point_mass", 1000.0))
        for name, device in (("simulated", "simulated"), ("device that reports", Reporter()))
    }
    ways = {name: partial(loop_times, *case) for name, case in cases.items()}
    loops = {}
    for name, times in in_turn(ways, options.passes, warms=False).items():
        tick, late = 1e6 * np.median(times, axis=0)
        busy = 1e6 * tick_time(*cases[name])
        loops[name] = {"tick_us": busy, "realtime_us": float(tick), "late_us": float(late)}
        print(
            f"{name}: tick {busy:.2f} µs in the median without a pause, {tick:.2f} µs in real "
            f"time, {late:.1f} µs late (p99)"
        )
    ratio = throughput("beads", 80.0, 200)
    print(f"beads: the scene's ticks take {ratio:.3f} of the time of MuJoCo's steps in them")
    return {"loops": loops, "taps": made}
