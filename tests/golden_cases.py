"""Runs, recordings and printed words whose outcome is frozen in ``tests/golden``.

``scripts/freeze`` writes the outcome anew, ``test_determinism`` holds today's code to it. All that
is used here is public: ``hb.Bridge``, ``hb.audit``, the command line.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import operator
import os
import platform
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import chdir, contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field, fields, is_dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, get_args
from unittest.mock import patch

import numpy as np
from audit_cases import ScriptedDevice, SlowClock
from model_runs import LOOP_SCENES
from numpy.typing import NDArray

import hapticbridge as hb
from hapticbridge.arguments import members, types_of
from hapticbridge.cli import main, terminal
from hapticbridge.device import force_dimension
from hapticbridge.device.touch import servo
from hapticbridge.device.transport import hid, usb
from hapticbridge.device.wheel.evdev import Linux
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.kernel.record import CLOCK_FIELDS, FORMAT, TICK_DTYPE
from hapticbridge.recording import Recording
from hapticbridge.run.commands import Command, Couple, Reset, Switch
from hapticbridge.run.programs import prepare_run
from hapticbridge.run.request import RunRequest

GOLDEN = Path(__file__).parent / "golden"
RUNS, AUDITS, MACHINE = (GOLDEN / f"{name}.json" for name in ("runs", "audits", "machine"))
FORMAT_FIELDS = GOLDEN / f"format_{FORMAT}.txt"
"""Fields that a recording of this format has. The file of a format is written once: other fields
need the next ``FORMAT`` in ``kernel.record``."""

Pose = tuple[float, ...]
Json = dict[str, Any]

DIGITS = 12
"""Hexadecimal digits of a digest: 48 bits. Two of some thousand differing columns collide with a
probability below 1e-8."""

BITS = re.compile(f"[0-9a-f]{{{DIGITS}}}")
"""A digest of floats. ``zero`` is none: another machine has the same fields without a bit."""

COUNTED = ("tick", "buttons", "scene_step", *CLOCK_FIELDS)
"""Fields of a tick that no rounding reaches: their digests are the same on every machine. Where a
contact begins, a solver ends or a flag rises may hang on a last bit, so these are not among them.
"""

ROUNDING = 1e-6
"""Largest relative difference of numbers that another machine computes. Without FMA and AVX the
libraries compute numbers that differ by up to 2e-11; a smaller limit may fail elsewhere."""

WORKSHOP = """
<mujoco model="workshop">
  <option cone="elliptic"/>
  <default><geom solref="0.002 1" solimp="0.9 0.95 0.001"/></default>
  <worldbody>
    <geom type="plane" size="1 1 0.1"/>
    <body name="tool" pos="0 0 0.012" gravcomp="1"><freejoint/>
      <geom type="sphere" size="0.01" mass="0.1"/><site name="grip"/></body>
    <body name="lever" pos="0.03 0 0.02"><joint name="lever" type="hinge" axis="0 1 0"
        stiffness="0.1" damping="0.001"/>
      <geom type="capsule" size="0.004" fromto="0 0 0 0 0 0.05" mass="0.05"/></body>
    <body name="load" pos="-0.1 0 0.05"><freejoint/>
      <geom type="box" size="0.01 0.01 0.01" mass="0.05"/></body>
    <body name="lift" mocap="true" pos="-0.1 0 0.03">
      <geom type="box" size="0.02 0.02 0.008"/></body>
  </worldbody>
  <actuator><position name="servo" joint="lever" kp="0.5" kv="0.01"/></actuator>
  <sensor>
    <framepos objtype="site" objname="grip"/><jointpos joint="lever"/>
    <touch name="touch" site="grip"/>
  </sensor>
</mujoco>"""
"""A tool above a floor, a servo, a spring, and a load on a platform that is moved."""

LIGHT = """
<mujoco model="light">
  <option timestep="0.001" gravity="0 0 0"/>
  <worldbody>
    <body name="tool"><freejoint/>
      <geom type="sphere" size="0.01" mass="0.05"/><site name="grip"/></body>
  </worldbody>
</mujoco>"""
"""A tool of 50 g, which a method that is not passive drives."""


def digest(column: NDArray[Any]) -> str:
    """Returns a digest of every bit of a column, or ``zero`` where no bit is set."""
    content = np.ascontiguousarray(column).tobytes()
    return hashlib.sha256(content).hexdigest()[:DIGITS] if any(content) else "zero"


def machine() -> dict[str, str]:
    """Returns what may change a bit although the code is the same."""
    found = {name: version(name) for name in ("mujoco", "numba", "numpy", "scipy")}
    return found | {
        "python": ".".join(platform.python_version_tuple()[:2]),
        "libc": " ".join(platform.libc_ver()),
        "system": platform.system(),
        "architecture": platform.machine(),
        "processor": _processor(),
    }


def _processor() -> str:
    """Returns a digest of numbers that the mathematical libraries compute on this processor.

    OpenBLAS, NumPy and the C library choose their code by the processor at hand, each by other
    instructions; so equal numbers are asked for, not equal names of instructions.
    """
    rng = np.random.default_rng(0)
    computed: list[Any] = []
    for size in (3, 6, 17, 64, 200):
        matrix, vector = rng.standard_normal((size, size)), rng.standard_normal(size)
        computed += [matrix @ matrix, matrix @ vector, vector @ vector, np.sum(vector)]
        computed += [np.linalg.solve(matrix, vector), *np.linalg.svd(matrix)]
        computed += [np.linalg.eigvals(matrix).view(float), np.linalg.cholesky(matrix @ matrix.T)]
        computed += [each(np.abs(vector)) for each in (np.sin, np.exp, np.log, np.arctan, np.sqrt)]
        computed += [[math.sin(x), math.exp(x), math.atan2(x, 0.3), abs(x) ** 0.7] for x in vector]
    return digest(np.concatenate([np.ravel(each) for each in computed]))


def json_text(content: Json) -> str:
    """Returns a golden file: an entry a line, so that two branches merge line by line."""
    return json.dumps(content, indent=1, ensure_ascii=False) + "\n"


def is_close(one: Any, other: Any) -> bool:
    """Returns True for values that differ in bits alone, which another machine may give."""
    if isinstance(one, float) and isinstance(other, float):
        return math.isclose(one, other, rel_tol=ROUNDING, abs_tol=1e-12)
    return bool(one == other) or all(
        isinstance(value, str) and BITS.fullmatch(value) for value in (one, other)
    )


def difference_lines(
    one: Any, other: Any, where: str = "", is_same: Callable[[Any, Any], bool] = operator.eq
) -> list[str]:
    """Returns the places in which two JSON values differ, with both values."""
    if isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        one, other = dict(enumerate(one)), dict(enumerate(other))
    if isinstance(one, dict) and isinstance(other, dict):
        names = [*one, *(name for name in other if name not in one)]
        return [
            line
            for name in names
            for line in difference_lines(
                one.get(name, "missing"),
                other.get(name, "missing"),
                f"{where} / {name}".lstrip(" /"),
                operator.eq if name in COUNTED else is_same,
            )
        ]
    return [] if is_same(one, other) else [f"{where}: {one!r:.200} -> {other!r:.200}"]


def sway(tick: int) -> Pose:
    """A hand that sways by 10 mm, turns by 0.2 rad and presses down by 12 mm."""
    angle = 0.1 * math.sin(0.02 * tick)
    down = -0.012 * math.sin(0.01 * tick) ** 2
    return (
        0.01 * math.sin(0.03 * tick),
        0.004 * math.sin(0.05 * tick),
        down,
        math.cos(angle),
        0.6 * math.sin(angle),
        0.8 * math.sin(angle),
        0.0,
    )


def leave(tick: int) -> Pose:
    """A hand that goes away at 1.4 m/s."""
    return (8e-4 * tick, 8e-4 * tick, 8e-4 * tick, 1.0, 0.0, 0.0, 0.0)


def turn(tick: int) -> Pose:
    """A hand that turns about y at 12 rad/s."""
    return (0.0, 0.0, 0.0, math.cos(6e-3 * tick), 0.0, math.sin(6e-3 * tick), 0.0)


def jump(tick: int) -> Pose:
    """As ``sway``, with a leap of 60 mm in tick 150: faster than any device."""
    x, *rest = sway(tick)
    return (x + (0.06 if tick >= 150 else 0.0), *rest)


def broken(tick: int) -> Pose:
    """As ``sway``, until a position is not a number."""
    x, *rest = sway(tick)
    return (x if tick < 150 else math.nan, *rest)


def lost(tick: int) -> Pose:
    """As ``sway``, until the device is gone."""
    if tick >= 150:
        raise hb.DeviceError("the device is gone")
    return sway(tick)


class Scripted(ScriptedDevice):
    """A scripted device with the simulated device's data sheet, but for what is changed in it."""

    def __init__(self, pose: Callable[[int], Pose] = sway, **options: Any) -> None:
        functions = {name: options.pop(name) for name in ("buttons", "is_stale") if name in options}
        super().__init__(pose, **functions)
        sheet = hb.open_device("simulated").info
        self.info = replace(sheet, name="scripted", duration=None, buttons=None, **options)


Act = Callable[[hb.Bridge, int], None]


def commands(table: Mapping[int, Command]) -> Act:
    """Returns what gives commands at their ticks."""

    def act(bridge: hb.Bridge, tick: int) -> None:
        bridge.session.commands.now = lambda: 1.0 * tick  # none is too soon
        if tick in table:
            bridge.command(table[tick], by="script")

    return act


def inputs(bridge: hb.Bridge, tick: int) -> None:
    """Moves the workshop's servo, platform, load and lever."""
    if tick % 50 == 10:
        bridge.set_input(ctrl={"servo": 0.3 * math.sin(tick)})
    if 100 <= tick < 200:
        bridge.set_input(mocap={"lift": (-0.1, 0, 0.03 + 2e-5 * (tick - 100))})
    if tick == 250:
        bridge.set_input(body_wrench={"load": (0.01, 0, 0, 0, 0, 1e-5)})
    if tick == 280:
        bridge.set_input(joint_force={"lever": 1e-3})


@dataclass(frozen=True)
class Run:
    """A run of the bridge on a simulated clock.

    Attributes:
        scene: Name, or MJCF as text.
        device: Makes the device; or a specification to whose end the scene's own path is added,
            eight times as fast.
        options: Of the bridge; ``limits`` holds changes to limits that are fit for short runs, and
            ``clock`` makes the clock.
        seconds: How long it runs.
        parts: How many times ``run`` is called for that.
        act: Called before each tick.
    """

    scene: str
    device: Callable[[], Any] | str = "simulated:path="
    options: Mapping[str, Any] = field(default_factory=dict)
    seconds: float = 0.4
    parts: int = 1
    act: Act | None = None

    def open(self, folder: Path, **more: Any) -> hb.Bridge:
        options = {**self.options, **more}
        clock = options.pop("clock", hb.SimulatedClock)
        changes: Mapping[str, float] = options.pop("limits", {})
        limits = hb.Limits(**{"force": 10.0, "torque": 0.5, "ramp": 0.05, **changes})
        scene = self.scene
        if scene.lstrip().startswith("<"):
            path = folder / "scene.xml"
            path.write_text(scene)
            scene = str(path)
        if isinstance(self.device, str):
            device = self.device + str(_hurried(scene, folder))
        else:
            device = self.device()
        return hb.Bridge(scene, device, clock=clock(), limits=limits, **options)

    def go(self, bridge: hb.Bridge) -> NDArray[np.void]:
        """Runs an entered bridge; returns its records."""
        act = self.act
        try:
            for _ in range(self.parts):
                bridge.run(self.seconds / self.parts, act and (lambda tick: act(bridge, tick)))
        except hb.SafetyTrip:
            pass
        return bridge.latest_records(round(self.seconds / bridge.period))

    def digests(self, folder: Path, **more: Any) -> dict[str, str]:
        """Returns a digest per field of the records, and of what the device was sent."""
        with self.open(folder, **more) as bridge:
            rows = self.go(bridge)
            ended = bridge.summary().stopped_by
        found = {"(length and end)": f"{len(rows)} ticks, {ended}"}
        found |= {name: digest(rows[name]) for name in sorted(rows.dtype.names or ())}
        if isinstance(bridge.device, Scripted):
            found["(written to the device)"] = digest(np.array(bridge.device.writes))
        return found


def _hurried(scene: str, folder: Path) -> Path:
    """Writes the path that comes with a scene, eight times as fast."""
    source = hb.load_scene(scene).path.with_suffix(".csv")
    header, *lines = source.read_text(encoding="utf-8").splitlines()
    rows = [line.split(",", 1) for line in lines]
    path = folder / "path.csv"
    path.write_text("\n".join([header, *(f"{float(t) / 8!r},{rest}" for t, rest in rows)]) + "\n")
    return path


METHODS = ("lossless", "implicit", "compensated")
"""Methods for users: every scene is run with each of them."""

COMPARED = (
    "implicitfast",
    "implicitfast:compensated",
    "explicit",
    "explicit:implicitfast",
    "explicit:rk4",
    "weld",
    "direct",
)
"""Methods that exist only to be compared."""

COUPLING = hb.Coupling(2400.0, 0.5, 2.4, 5e-4)

TURNED = ((0.6, -0.224, 0.768), (0.8, 0.168, -0.576), (0.0, 0.96, 0.28))
"""Device axes in the scene of which none lies along one of the scene's: every product counts."""

STIFF = hb.Coupling(8000.0, 0.5, 8.0, 5e-4)
"""Twice what the simulated device bears."""

CHANGES: dict[int, Command] = {
    40: Couple(1000.0, 0.5),
    160: Couple(3000.0, 0.4, 2.0, 4e-4),
    300: Switch(force=False),
    340: Switch(force=True),
    400: Switch(clutch=True),
    440: Switch(clutch=False),
    480: Reset(),
}
"""Every command that changes what a run computes, by tick."""

PEG, WALL, MASS = "peg_in_hole", "virtual_wall", "point_mass"


def _held(first: int, last: int, button: int = 0) -> Callable[[int], int]:
    """Returns buttons of which one is held in the ticks from ``first`` to before ``last``."""
    return lambda tick: (first <= tick < last) << button


def _guard_runs() -> Iterator[tuple[str, Run]]:
    """Yields the cases of the guard and of the bridge's options, by name."""
    yield "force limit", Run(PEG, Scripted, {"limits": {"force": 1.0, "torque": 0.02}})
    yield "long ramp", Run(PEG, Scripted, {"limits": {"ramp": 0.3}})
    yield "no ramp", Run(PEG, Scripted, {"limits": {"ramp": 0.0}})
    yield "clutch", Run(PEG, lambda: Scripted(buttons=_held(100, 200)), {"clutch": 0})
    yield "dead man", Run(PEG, lambda: Scripted(buttons=_held(50, 250, 1)), {"dead_man": 1})
    yield "reach", Run(PEG, Scripted, {"limits": {"reach": 0.012}})
    yield "stale samples", Run(PEG, lambda: Scripted(is_stale=lambda tick: tick % 7 in (2, 3)))
    yield "silence", Run(PEG, lambda: Scripted(is_stale=lambda tick: 100 <= tick < 250))
    yield "leap of the device", Run(PEG, lambda: Scripted(jump))
    yield "trip: stretch", Run(WALL, lambda: Scripted(leave), {"limits": {"stretch": 0.05}})
    yield "trip: angle", Run("drawer", lambda: Scripted(turn), {"limits": {"angle": 1.0}})
    yield (
        "trip: energy",
        Run(
            LIGHT,
            lambda: Scripted(damping=0.1, rotational_damping=1e-4),
            {"method": "implicitfast", "coupling": COUPLING, "limits": {"energy": 1e-3}},
        ),
    )
    yield "trip: not a number", Run(PEG, lambda: Scripted(broken))
    yield "trip: device lost", Run(PEG, lambda: Scripted(lost))
    yield (
        "skipped deadlines",
        Run(PEG, Scripted, {"clock": lambda: SlowClock({60: 1, 120: 3, 200: 80})}),
    )
    for method in METHODS:
        options = {"method": method, "coupling": COUPLING}
        yield f"commands, {method}", Run(PEG, Scripted, options, 0.6, act=commands(CHANGES))
    for controller in ("damper", "environment", "off"):
        yield (
            f"stiff coupling, controller {controller}",
            Run(
                WALL,
                "simulated:damping=0.1,hand_stiffness=1000,path=",
                {"coupling": STIFF, "controller": controller},
            ),
        )
        yield (
            f"active environment, controller {controller}",
            Run(
                LIGHT,
                Scripted,
                {"coupling": COUPLING, "controller": controller, "method": "implicitfast"},
            ),
        )
    for method, substeps in (("implicit", 3), ("compensated", 2), ("explicit", 2)):
        more = {"method": method, "substeps": substeps}
        yield f"{substeps} substeps, {method}", Run(PEG, Scripted, more)
    for method in ("lossless", "implicit", "explicit"):
        yield f"inputs, {method}", Run(WORKSHOP, Scripted, {"method": method}, act=inputs)
    yield "scaled up", Run(PEG, Scripted, {"workspace": hb.Workspace(scale=2.0)})
    workspace = hb.Workspace(scale=1.5, force_scale=0.5)
    yield "force scaled down", Run(PEG, Scripted, {"workspace": workspace})
    yield "turned axes", Run(PEG, Scripted, {"workspace": hb.Workspace(axes=TURNED)})
    yield "absolute poses", Run(MASS, Scripted, {"workspace": hb.Workspace(absolute=True)})
    yield "500 Hz", Run(MASS, Scripted, {"rate": 500.0})
    yield "4 kHz", Run(PEG, Scripted, {"rate": 4000.0})
    yield "three runs of one bridge", Run(PEG, Scripted, seconds=0.45, parts=3)
    yield "device of 3 axes", Run(PEG, lambda: Scripted(axes=("x", "y", "z")))
    yield "device in the plane", Run("planar_peg", lambda: Scripted(axes=("x", "z", "ry")))
    yield (
        "device with friction, steps and delay",
        Run(WALL, "simulated:friction=0.2,resolution=1e-5,delay=2,path="),
    )
    yield "device that no force moves", Run(WALL, "trajectory:")
    yield (
        "direct, contact stiffness",
        Run(PEG, Scripted, {"method": "direct", "contact_stiffness": 1500.0}),
    )


def runs() -> dict[str, Run]:
    """Returns every frozen run by name."""
    found = {
        f"{scene}, {method}": Run(scene, options={"method": method}, seconds=1.0)
        for scene in LOOP_SCENES
        if scene != "pliers"  # in one hand they stay open, and freeze less than bench_pliers
        for method in METHODS
    }
    for method in COMPARED:
        found[f"{PEG}, {method}"] = Run(PEG, Scripted, {"method": method})
    return found | dict(_guard_runs())


VOLATILE = ("versions", "host", "started", "epoch_ns")
"""Metadata of a recording that tell of the machine and the day, not of the run."""

RECORDED = (
    f"{PEG}, lossless",
    f"{PEG}, direct",
    f"{PEG}, weld",
    "2 substeps, compensated",
    "commands, lossless",
    "inputs, implicit",
    "skipped deadlines",
    "device with friction, steps and delay",
    "stiff coupling, controller damper",
    "active environment, controller damper",
    "trip: energy",
)
"""Runs whose recordings are judged."""


def recordings(folder: Path) -> dict[str, Recording]:
    """Records the runs that are judged."""
    table, found = runs(), {}
    for number, name in enumerate(RECORDED):
        path = folder / f"{number}.mcap"
        with table[name].open(folder, recording=path) as bridge:
            table[name].go(bridge)
        found[name] = hb.read_recording(path)
    return found


def description(recording: Recording) -> Json:
    """Returns what a recording says of its run beside its ticks, and how it is judged."""
    meta = {name: text for name, text in sorted(recording.meta.items()) if name not in VOLATILE}
    files = {
        name: f"sha256 {hashlib.sha256(data).hexdigest()[:DIGITS]}"
        for name, data in sorted(recording.attachments.items())
    }
    report = json.loads(hb.audit(recording.path).to_json())
    del report["path"]
    return {"meta": meta, "attachments": files, "events": recording.events, "report": report}


def audits(folder: Path) -> Json:
    """Returns what recordings hold and how they are judged."""
    kept = recordings(folder)
    return {"recordings": {name: description(recording) for name, recording in kept.items()}}


SESSIONS = sorted(path.stem for path in (GOLDEN / "sessions").glob("*.txt"))
"""Names of the golden sessions: commands in order, what they print, and their exit codes."""

_PROMPT = "$ hapticbridge "


def recorded_classes(kind: Any, found: dict[Any, None]) -> None:
    """Adds the dataclasses that a type is made of, itself among them, to ``found``."""
    if kind in found:
        return
    if is_dataclass(kind):
        found[kind] = None
    parts = types_of(kind).values() if kind in found else get_args(kind)
    for part in (member for each in parts for member in members(each)):
        recorded_classes(part, found)


def format_fields() -> str:
    """Returns the fields of request, parameters and tick by name, as a recording has them."""
    found: dict[Any, None] = {}
    recorded_classes(tuple[RunRequest, RunParameters], found)
    names = {each.__name__: sorted(own.name for own in fields(each)) for each in found}
    names["tick"] = [f"{name} {TICK_DTYPE[name]}" for name in TICK_DTYPE.names or ()]
    return "".join("\n    ".join([kind, *own]) + "\n" for kind, own in sorted(names.items()))


def session_file(name: str) -> Path:
    """Returns the file of a session's words."""
    return GOLDEN / "sessions" / f"{name}.txt"


@contextmanager
def consoles_of(width: int) -> Iterator[None]:
    """Gives the consoles a width; they are made once, with the width of that moment."""
    consoles = (terminal.out, terminal.err)
    before = [console.width for console in consoles]
    never = patch.object(terminal, "REPRINT", 1e6)  # a slow machine has no other words
    never.start()
    try:
        for console in consoles:
            console.width = width
        yield
    finally:
        never.stop()
        for console, old in zip(consoles, before, strict=True):
            console.width = old


def session_text(name: str, folder: Path) -> str:
    """Returns what the commands of a session's file print now, paths masked.

    They run in a folder of their own, FOLDER, on a machine without devices, and a terminal of 100
    columns shows them.
    """
    lines = session_file(name).read_text(encoding="utf-8").splitlines()
    commands = [line.removeprefix(_PROMPT) for line in lines if line.startswith(_PROMPT)]
    prepare_run(lambda _: None)  # so that no command tells of it
    plain = {"COLUMNS": "100", "NO_COLOR": "1", "TERM": "dumb"}
    plain |= dict.fromkeys((force_dimension.FILES.variable, servo.FILES.variable), "/no/such.so")
    shown = []
    models = str(Path(hb.__file__).parents[1])
    for command in commands:
        out, err = io.StringIO(), io.StringIO()
        with (
            consoles_of(100),
            chdir(folder),
            patch.dict(os.environ, plain),
            patch.object(usb, "on_the_bus", list),
            patch.object(usb, "libusb", lambda: None),
            patch.object(hid, "hid_api", lambda: None),
            patch.object(Linux, "nodes", lambda _: []),
            redirect_stdout(out),
            redirect_stderr(err),
        ):
            code = main(command.replace("FOLDER", str(folder)).split())
        words = err.getvalue() + out.getvalue()
        words = words.replace(str(folder), "FOLDER").replace(models, "HOME")
        shown += [_PROMPT + command, *map(str.rstrip, words.splitlines()), f"({code})"]
    return "\n".join(shown) + "\n"
