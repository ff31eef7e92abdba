"""Contact of the bridge and of other physics engines, on a peg in its hole.

Ours is measured with rigid contact and with the contacts of the scene, the others as their own
documentation advises (the settings are printed), or with ``--defaults`` at their own defaults.

All of it at every step T of ``--steps``:

- settled: error in µm of a frictionless peg at rest, against the rigid optimum by SciPy. It is
  pushed against its hole in three ways, from the upright ("led") and from the optimum ("put"). The
  smallest and the largest of the three.
- time: processor time of a step of the same peg, as it leans on the hole's edge and free. For
  another engine, to set a force and to step, through its Python interface; for ours, the whole
  compiled tick: coupling, contact, energy meter and guards. Turns of 100 steps, side by side in one
  process on one core, the first round not counted; the median over the rounds.
- jam: the same peg jammed by a recorded and by seeded hands, 30 and 100 g, K = 1000 and 6000 N/m,
  with and without friction. Every engine is led along equal paths behind our coupling, ours with
  the coupling in its step, the others with a force held during the step or (``_spring``) their own
  spring. Energy created by the engine with the force that it applied: verdicts on the runs, the
  largest energy in J, and as a share of our coupling's slack; then "with coupling", as our meter
  counts it for the device, which a held force makes larger. Penetration in µm by exact geometry,
  none of the engine's: median over the ticks in contact, median of the runs' peaks, and the worst.
  A run whose peg left the hole counts by its verdict alone.
- tasks: error in just noticeable differences, energy created and cost of the charts' workloads
  with a known truth: a tap, a falling rod, a sliding block, a stack that is leaned on, a jam, a
  hexagonal key in its socket.

``--fetch`` installs the engines that come as wheels, and this checkout, into an environment of
their own in the cache folder, and measures there: none of them is a dependency of a release.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
import venv
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from argument_types import positive, whole
from measuring import in_turn
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

from hapticbridge import load_scene
from hapticbridge.device import Motion
from hapticbridge.kernel.record import TICK_DTYPE
from hapticbridge.kernel.tick import simulate
from hapticbridge.lab.chart.chart import (
    Extent,
    machine,
    measure_chart,
    one_core,
    open_workload,
)
from hapticbridge.lab.chart.engine_run import peer_settings
from hapticbridge.lab.chart.peg import (
    COUPLING,
    JUDGED,
    LEFT,
    POSES,
    JammedPeg,
    RestingPeg,
    penetrations,
    resting_peg,
)
from hapticbridge.lab.chart.scene_run import Prepared, path_of
from hapticbridge.lab.chart.score import PASSIVE, Take
from hapticbridge.lab.chart.setting import SPRING, Setting, chosen_periods
from hapticbridge.lab.engines import base
from hapticbridge.lab.engines.base import (
    ENGINES,
    Engine,
    Pose,
    Task,
    available_engines,
    caught_prints,
    open_engine,
)
from hapticbridge.lab.methods import METHODS

RAMP, HOLD = 0.2, 1.2
"""Times in s to go to a push, and to stay: the damping leaves e⁻¹⁸ of the ringing."""
TURN = 100
"""Timed steps of one subject per turn: in 0.1 s a peg hardly leaves its resting place."""
NOTHING = (0.0, 0.0, 0.0)

OWN = {
    "ours, rigid": METHODS["implicit"].with_contact("rigid"),
    "ours, rigid, lossless": METHODS["lossless"].with_contact("rigid"),
    "ours, scene": METHODS["implicit"].with_contact("scene"),
}
JAMS = tuple(product((0.03, 0.1), (0.0, 0.42), (1000.0, 6000.0)))
"""Mass in kg, friction and K in N/m."""

TASKS = ("tap", "rod_impact", "sliding_block", "stack", "jam", "hex_socket")
"""Workloads of the charts that every engine does at every step."""

STEPS_MS = (4.0, 2.0, 1.0, 0.5, 0.25)
"""Steps T in ms."""

DEFAULTS: Mapping[str, Mapping[str, object]] = {
    "mujoco": {"STIFFNESS_TIME": 20.0, "IMPEDANCE": (0.9, 0.95, 0.001, 0.5, 2.0)},
    "mujoco_warp": {},
    "newton": {"GAP": 0.1, "XPBD_ITERATIONS": 2, "STEEL_ITERATIONS": 12},
    "ode": {"LAYER": 0.0, "CFM": 1e-10},
    "physx": {"LENGTH": 1.0, "POSITION_ITERATIONS": 4, "CONTACT_OFFSET": 0.02},
    "rapier": {"LENGTH": 1.0, "ALLOWED": 0.005, "STIFFNESS": 0.0, "ITERATIONS": 4},
    "bullet": {"SLOP": 1e-5, "ITERATIONS": 50},
    "drake": {"POINT_STIFFNESS": 1e6, "MODULUS": 1e7},
}
"""The libraries' own values of the constants that a module of ``lab.engines`` sets."""

Results = list[dict[str, object]]
"""Numbers of each engine at each step: errors in µm, times in µs, energies in J."""


def quaternion(
    rotation: Sequence[float] | NDArray[np.float64],
) -> tuple[float, float, float, float]:
    """Returns a rotation vector in rad as a quaternion."""
    w, x, y, z = Rotation.from_rotvec(rotation).as_quat(canonical=True, scalar_first=True).tolist()
    return w, x, y, z


def ramp(first: NDArray[np.float64], index: int) -> Motion:
    """Returns a handle that moves from a pose to a push and stays."""
    share = np.linspace(0.0, 1.0, 201)
    smooth = share**3 * (10 - 15 * share + 6 * share**2)
    last = np.ravel(POSES[index])
    rows = np.vstack([first + smooth[:, None] * (last - first), last])
    times = np.append(RAMP * share, RAMP + HOLD)
    return Motion(times, rows[:, :3], [quaternion(row) for row in rows[:, 3:]])


def starts(rest: RestingPeg) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the two poses that a peg starts from: upright in its hole, and at its optimum."""
    return np.ravel(POSES[0]), np.concatenate([rest.position, rest.rotation])


def started(task: Task, first: NDArray[np.float64], index: int) -> Task:
    """Returns the task of a peg that starts at a pose and is led to a push."""
    x, y, z = first[:3].tolist()
    return replace(task, start=Pose((x, y, z), quaternion(first[3:])), handle=ramp(first, index))


@dataclass(frozen=True)
class Pegs:
    """The pegs at one step, with the task of the settled one and its optima.

    Attributes:
        period: T in s.
        task: A frictionless peg in its hole, for another engine.
        resting: The optimum under each judged push.
    """

    period: float
    task: Task
    resting: Sequence[RestingPeg]

    def simulated(self, engine: Engine, task: Task) -> base.Simulation:
        """Runs a task to its end; the simulation is left open."""
        simulation = engine.open(task, self.period)
        for pose in task.handle_poses(self.period, round((RAMP + HOLD) / self.period))[1:]:
            simulation.step(pose.position, pose.quaternion)
        return simulation

    def own_stage(
        self, first: NDArray[np.float64], index: int, *, is_free: bool = False
    ) -> Prepared:
        """Returns a stage of the bridge whose peg starts at a pose and is led to a push."""
        scene = load_scene("peg_in_hole", friction=0.0)
        scene.model.key_qpos[0] = (*first[:3], *quaternion(first[3:]))
        if is_free:
            scene.model.geom_contype[:] = scene.model.geom_conaffinity[:] = 0
        path = path_of(ramp(first, index).relative())
        return Prepared(scene, path, RAMP + HOLD + TURN * self.period, COUPLING)

    def settled_place(self, name: str, first: NDArray[np.float64], index: int) -> object:
        """Returns the place in m of a peg that was led to a push; inf for a failure."""
        if name in OWN:
            places: list[object] = []
            self.own_stage(first, index).play(
                Setting(OWN[name], self.period),
                lambda take: places.append(take.records["tool_position"][-1].copy()),
            )
            return places[0]
        try:
            simulation = self.simulated(open_engine(name), started(self.task, first, index))
            place = simulation.pose().position
            simulation.close()
        except Exception as error:  # a foreign library may raise anything
            print(f"{name}: {type(error).__name__}: {error}", file=sys.stderr)
            return (np.inf,) * 3
        return place

    def settled_errors(self, name: str) -> list[list[float]]:
        """Returns the errors in µm of the three pushes, led there and put there."""
        errors: list[list[float]] = [[], []]
        for index, rest in zip(JUDGED, self.resting, strict=True):
            for found, first in zip(errors, starts(rest), strict=True):
                place = self.settled_place(name, first, index)
                found.append(1e6 * float(np.linalg.norm(np.asarray(place) - rest.position)))
        return errors

    def engine_time(self, name: str, is_leaning: bool) -> float:
        """Returns the time in s of a step of an engine, under the wrench that holds the peg.

        A held wrench does not restore the pose, so every turn restarts.
        """
        task = started(self.task, np.ravel(POSES[0]), JUDGED[0])
        task = task if is_leaning else replace(task, fixed=())
        simulation = self.simulated(open_engine(name), task)
        # an engine's own spring pulls by itself
        force, torque = (NOTHING, NOTHING) if name.endswith(SPRING) else simulation.wrench()
        begin = time.thread_time()
        for _ in range(TURN):
            simulation.advance(force, torque)
        spent = (time.thread_time() - begin) / TURN
        simulation.close()
        return spent

    def own_time(self, name: str, is_leaning: bool) -> float:
        """Returns the processor time in s of a tick of ours."""
        stage = self.own_stage(np.ravel(POSES[0]), JUDGED[0], is_free=not is_leaning)
        binding = stage.bound(Setting(OWN[name], self.period))
        samples = stage.samples(self.period)
        rows = np.zeros(samples.size, TICK_DTYPE)
        simulate(binding.state, samples[:-TURN], binding.row, rows)
        begin = time.thread_time()
        simulate(binding.state, samples[-TURN:], binding.row, rows)
        return (time.thread_time() - begin) / TURN

    def step_times(self, names: Sequence[str], rounds: int) -> dict[str, NDArray[np.float64]]:
        """Returns the median time in s of a step by name: leaning on an edge, and free."""
        ways = {
            (name, kind): partial(
                self.own_time if name in OWN else self.engine_time, name, not kind
            )
            for name in names
            for kind in range(2)
        }
        times = in_turn(ways, rounds)
        return {name: np.median([times[name, 0], times[name, 1]], axis=1) for name in names}

    def jammed(self, name: str, hands: int) -> dict[str, object]:
        """Jams the peg in one engine; returns verdicts, energies in J and penetrations in µm."""
        setting = (
            Setting(OWN[name], self.period)
            if name in OWN
            else Setting(METHODS["explicit"], self.period, engine=name)
        )
        takes: list[Take] = [
            JammedPeg(mass, friction, stiffness, hand).take(setting)
            for mass, friction, stiffness in JAMS
            for hand in range(hands)
        ]
        inside = [
            take
            for take in takes
            if not take.ended and np.abs(take.records["tool_position"]).max() < LEFT
        ]
        verdicts: Counter[str] = Counter(take.engine.verdict for take in inside)
        verdicts["left the hole"] = len(takes) - len(inside)
        found: dict[str, object] = {
            "runs": {key: count for key, count in verdicts.items() if count}
        }
        if not inside:
            return found
        for kind in ("engine", "meter"):
            readings = [getattr(take, kind) for take in inside]
            found[f"{kind} created"] = max(each.created for each in readings)
            found[f"{kind} of slack"] = max(each.slack_share for each in readings)
        depths = [1e6 * penetrations(take.records) for take in inside]
        touching = [
            each[take.records["contacts"] > 0] for each, take in zip(depths, inside, strict=True)
        ]
        peaks = [each.max() for each in depths]
        found["median depth"] = float(np.median(np.concatenate(touching)))
        found["median peak"], found["deepest"] = float(np.median(peaks)), float(np.max(peaks))
        return found

    def rows(self, names: Sequence[str], rounds: int, hands: int) -> Results:
        """Returns all numbers of each engine at this step."""
        print(f"times at {1e3 * self.period:g} ms", file=sys.stderr, flush=True)
        times = self.step_times(names, rounds)
        results: Results = []
        for name in names:
            print(f"pegs at {1e3 * self.period:g} ms: {name}", file=sys.stderr, flush=True)
            led, put = self.settled_errors(name)
            leaning, free = (1e6 * float(each) for each in times[name])
            row = {"engine": name, "period": self.period, "led": led, "put": put}
            results.append(row | {"leaning": leaning, "free": free} | self.jammed(name, hands))
        return results


JAM_COLUMNS = ("engine created", "engine of slack", "meter created", "meter of slack")
DEPTHS = ("median depth", "median peak", "deepest")


def jam_row(name: str, found: Mapping[str, object]) -> list[str]:
    """Returns the row of the table of a result of ``jammed``."""
    runs = found["runs"]
    assert isinstance(runs, dict)
    words = ", ".join(f"{count} {verdict}" for verdict, count in runs.items())
    columns = [(key, "{:.2g}") for key in JAM_COLUMNS] + [(key, "{:.3g}") for key in DEPTHS]
    return [
        name,
        words,
        *(form.format(found[key]) if key in found else "" for key, form in columns),
    ]


def measure_elsewhere(arguments: Sequence[str]) -> None:
    """Replaces this process by the script in an environment that has the engines."""
    root = Path(__file__).resolve().parents[2]
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "hapticbridge"
    python = cache / "engines" / "bin" / "python"
    if not python.exists():
        venv.create(cache / "engines", with_pip=True)
    print(f"installing into {cache / 'engines'} …", file=sys.stderr, flush=True)
    install = [str(python), "-m", "pip", "install", "--quiet", "-c", str(root / "constraints.txt")]
    subprocess.run([*install, "-e", f"{root}[peers]"], check=True)
    os.execv(python, [str(python), sys.argv[0], *arguments])


def peg_rows(names: Sequence[str], steps_ms: Sequence[float], rounds: int, hands: int) -> Results:
    """Returns the numbers of settled and jammed pegs in each engine at each step."""
    results: Results = []
    with caught_prints(lambda line: print(line, file=sys.stderr)), one_core():
        resting = [resting_peg(COUPLING, *POSES[index]) for index in JUDGED]
        for period in chosen_periods(steps_ms):
            # the finest step may be the coarsest here: the handle's poses are computed anew
            (task,) = open_workload("peg_in_hole", Extent(period, period)).peer_work().tasks
            results += Pegs(period, task, resting).rows(names, rounds, hands)
    return results


def task_rows(
    tasks: Sequence[str], names: Sequence[str], steps_ms: Sequence[float], rounds: int
) -> Results:
    """Does every task at every step; returns error in JND, energy in J and time of a step in s."""
    periods = chosen_periods(steps_ms)
    settings = [Setting(method, period) for method in OWN.values() for period in periods]
    settings += peer_settings(names, periods)
    rows: Results = []
    for task in tasks:
        print(f"task {task}", file=sys.stderr, flush=True)
        workload = open_workload(task, Extent(periods[0], periods[-1]))
        chart = measure_chart(workload, settings, repeats=rounds)
        for each in chart.measurements:
            setting, score = each.setting, each.score
            own = next((key for key, method in OWN.items() if method is setting.method), "")
            rows.append(
                {
                    "task": task,
                    "engine": own or setting.engine,
                    "period": setting.period,
                    "jnd": score.jnd,
                    "created": score.created,
                    "verdict": score.verdict,
                    "step": each.cost.median * setting.period,
                }
            )
    return rows


def show_tasks(console: Console, rows: Sequence[Mapping[str, Any]]) -> None:
    """Prints a table per task: error, energy and time of each engine at each step."""
    for task in dict.fromkeys(row["task"] for row in rows):
        mine = [row for row in rows if row["task"] == task]
        periods = sorted({row["period"] for row in mine}, reverse=True)
        table = Table("engine", *(f"{1e3 * each:g} ms" for each in periods))
        table.title = f"{task}: JND, J created, µs a step (! not passive)"
        cells: dict[str, list[str]] = {}
        for row in mine:
            mark = "" if row["verdict"] in PASSIVE else "!"
            cells.setdefault(row["engine"], []).append(
                f"{mark}{row['jnd']:.2g}, {max(row['created'], 0):.1g}, {1e6 * row['step']:.3g}"
            )
        for engine, words in cells.items():
            table.add_row(engine, *words)
        console.print(table)


def show_pegs(console: Console, results: Sequence[Mapping[str, Any]], runs: int) -> None:
    """Prints two tables for each step: settled pegs, and jammed ones."""
    for period in dict.fromkeys(row["period"] for row in results):
        step = f"{1e3 * period:g} ms"
        rest = Table(
            "engine", "led µm", "put µm", "leaning µs", "free µs", title=f"settled peg, {step}"
        )
        jam = Table("engine", "runs", "created J", "of slack", "with coupling J", "of slack")
        for heading in ("median µm", "median peak µm", "worst µm"):
            jam.add_column(heading)
        jam.title = f"jammed peg, {runs} runs of 2 to 2.5 s, {step}"
        for found in results:
            if found["period"] == period:
                ranges = [
                    f"{min(found[key]):.3g} to {max(found[key]):.3g}" for key in ("led", "put")
                ]
                times = (f"{found[key]:.1f}" for key in ("leaning", "free"))
                rest.add_row(found["engine"], *ranges, *times)
                jam.add_row(*jam_row(found["engine"], found))
        console.print(rest)
        console.print(jam)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Adds the choice of engines, tasks and steps."""
    parser.add_argument("--rounds", type=whole, default=5, help="rounds of timing")
    parser.add_argument("--hands", type=whole, default=3, help="of the jam, the first recorded")
    for name, words in (("engines", "only these, and ours"), ("without", "all but these")):
        parser.add_argument(f"--{name}", nargs="*", choices=ENGINES, metavar="ENGINE", help=words)
    parser.add_argument("--defaults", action="store_true", help="engines at their own defaults")
    parser.add_argument("--steps", type=positive, nargs="+", default=STEPS_MS, help="in ms")
    parser.add_argument("--tasks", nargs="*", choices=TASKS, default=TASKS, help="only these")
    parser.add_argument("--tasks-only", action="store_true", help="without settled and jammed pegs")
    parser.add_argument("--fetch", action="store_true", help="install the engines, and measure")


def measure(options: argparse.Namespace) -> dict[str, object]:
    """Prints the tables; returns their numbers."""
    if options.fetch:
        measure_elsewhere([word for word in sys.argv[1:] if word != "--fetch"])
    console = Console(width=150, highlight=False)
    found = available_engines()
    for reason in dict.fromkeys(found.missing.values()):
        console.print(f"skipped: {reason}", markup=False)
    wanted = {*(found.available if options.engines is None else options.engines)}
    wanted -= {*(options.without or ())}
    engines = {name: each for name, each in found.available.items() if name in wanted}
    if options.defaults:
        for module in {ENGINES[name] for name in engines}:
            for constant, value in DEFAULTS[module].items():
                setattr(import_module(f"{base.__package__}.{module}"), constant, value)
    rounds, hands = options.rounds, options.hands
    pegs: Results = []
    if not options.tasks_only:
        pegs = peg_rows([*OWN, *engines], options.steps, rounds, hands)
    tasks = task_rows(options.tasks, list(engines), options.steps, rounds)
    with one_core() as core:
        where = machine(core)
    console.print(where)
    show_pegs(console, pegs, len(JAMS) * hands)
    show_tasks(console, tasks)
    for name, engine in engines.items():
        console.print(f"\n{name}: {engine.version}")
        if options.defaults:
            console.print(f"  own defaults: {dict(DEFAULTS[ENGINES[name]])}", markup=False)
            continue
        for key, setting in engine.settings.items():
            console.print(f"  {key}: {setting.value}  [{setting.source}]", markup=False)
    return {"machine": where, "pegs": pegs, "tasks": tasks}
