"""Kinds of forgery of a recording, all checksums written anew, and what becomes of it.

Each is judged twice: simulated again, and as if recorded with another MuJoCo, from its records
alone. For a few, no part of the file depends on what is changed; the table says why.
``test_audit_chunks`` has the forgeries of the container.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import report_runs
from audit_cases import (
    ScriptedDevice,
    SlowClock,
    other_request,
    recorded,
    verdict_of,
)
from audit_cases import other_sheet as requested_sheet

from hapticbridge.audit import AuditReport, audit
from hapticbridge.coupling import Coupling
from hapticbridge.demand.guard import IDLE_FORCE, IDLE_TORQUE, Limits, guard_parameters_for
from hapticbridge.device import DeviceInfo, SimulatedDevice
from hapticbridge.errors import SafetyTrip
from hapticbridge.kernel.parameters import UNGUARDED
from hapticbridge.kernel.record import CLOCK_FIELDS, TickFlag
from hapticbridge.recording import Recording, read_recording
from hapticbridge.run.bridge import Bridge
from hapticbridge.run.commands import Couple, Reset
from hapticbridge.run.description import SOURCE_PREFIX, STATE_ATTACHMENT, processor, versions
from hapticbridge.scene.rehearsal import start_handle

SCENE = f"{SOURCE_PREFIX}peg_in_hole.xml"
SHEET = SCENE.replace(".xml", ".toml")

MOTION = "t,x,y,z,qw,qx,qy,qz\n0,0,0,0,1,0,0,0\n0.1,0.0006,0.0001,-0.0125,0.9998,0.0141,0.0141,0\n"

Parts = dict[str, Any]
Change = Callable[[Recording], Parts]


# Honest recordings


def hand(folder: Path) -> Path:
    """A hand taps with a peg; the guard has its usual limits."""
    path, motion = folder / "hand.mcap", folder / "hand.csv"
    motion.write_text(MOTION)
    limits = Limits(force=10.0, torque=0.5, ramp=0.05)
    recorded(path, device=f"simulated:path={motion}", duration=0.2, limits=limits, controller=None)
    return path


def carried(folder: Path) -> Path:
    """The scene carries the weight of a tool that falls."""
    path = folder / "carried.mcap"
    recorded(path, duration=0.05, tool_weight=False)
    return path


def busy(folder: Path) -> Path:
    """Commands, inputs, a mark and missed deadlines."""
    path = folder / "busy.mcap"

    def act(bridge: Bridge, tick: int) -> None:
        bridge.session.commands.now = lambda: 1e-3 * tick
        if tick == 100:
            bridge.command(Couple(1000.0, 0.5))
        elif tick in (240, 260):
            bridge.set_input(body_wrench={"tool": (0.01, 0.0, 0.0, 0.0, 0.0, 0.0)})
        elif tick == 420:
            bridge.command(Reset())

    device = ScriptedDevice(lambda tick: (1e-4 * tick, 0, 0, 1, 0, 0, 0))
    clock = SlowClock({180: 2, 200: 1})
    recorded(
        path, "point_mass", device, Coupling(800.0, 0.5), duration=0.6, on_tick=act, clock=clock
    )
    return path


def tripped(folder: Path) -> Path:
    """The tool is left behind."""
    path = folder / "tripped.mcap"
    device = ScriptedDevice(lambda tick: (0.001 * max(tick - 50, 0), 0, 0, 1, 0, 0, 0))
    limits = Limits(force=10.0, torque=0.5, stretch=0.005)
    with suppress(SafetyTrip):
        recorded(path, "point_mass", device, duration=0.3, limits=limits)
    return path


def swung(folder: Path) -> Path:
    """The run is active."""
    return report_runs.swung(folder / "swung.mcap", duration=1.0)


def weighed(folder: Path) -> Path:
    """A hand carries a tool of 0.5 N."""
    scene = report_runs.ANVIL.replace('mass="20000"', 'mass="0.05"')
    scene = scene.replace('gravity="0 0 0"', 'gravity="0 0 -9.81"')
    device = SimulatedDevice(mass=0.2, damping=2.0, hand=report_runs.LIGHT_HAND)
    coupling = Coupling(1000.0, 0.5, 0.1, 1e-4)
    return report_runs.made_in(folder / "weighed.mcap", scene, device, coupling, duration=0.1)


@pytest.fixture(scope="module")
def honest(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Any], Recording]:
    folder, kept = tmp_path_factory.mktemp("honest"), dict[Any, Recording]()

    def of(run: Callable[[Path], Path]) -> Recording:
        if run not in kept:
            kept[run] = read_recording(run(folder))
        return kept[run]

    return of


# Changes


def meta(name: str, change: Callable[[Any], Any]) -> Change:
    """Changes a JSON value of the metadata."""

    def parts(recording: Recording) -> Parts:
        return {"meta": {name: json.dumps(change(json.loads(recording.meta[name])))}}

    return parts


def text(**values: str) -> Change:
    return lambda _: {"meta": values}


def times(name: str, factor: float = 1.01) -> Change:
    return meta(name, lambda value: value * factor if value else factor)


def component(name: str, index: int) -> Change:
    return meta(name, lambda values: [v + 1e-4 * (i == index) for i, v in enumerate(values)])


def entry(field: str, **values: Any) -> Change:
    return meta(field, lambda old: old | values)


def guard(name: str, factor: float) -> Change:
    def change(old: dict[str, Any]) -> dict[str, Any]:
        value = old[name]
        if isinstance(value, int):
            return old | {name: int(value + factor)}
        return old | {name: 1.0 if value == "inf" else value * factor}

    return meta("guard", change)


def sheet(**values: Any) -> Change:
    """Changes the data sheet where it stands and in the request."""
    return lambda recording: {"meta": requested_sheet(recording, **values)}


def limit(name: str) -> Change:
    """Changes a limit in the request, and the guard parameter that follows from it."""

    def parts(recording: Recording) -> Parts:
        asked, guard = (json.loads(recording.meta[key]) for key in ("request", "guard"))
        old = asked["options"]["limits"][name]
        load = guard[f"idle_{name.removeprefix('hold_')}"] if name.startswith("hold_") else 0.0
        assert load in (0.0, IDLE_FORCE, IDLE_TORQUE)  # the tool weighs nothing
        asked["options"]["limits"][name] = guard[name] = 1.1 * old
        return {"meta": {"request": json.dumps(asked), "guard": json.dumps(guard)}}

    return parts


def ticks(name: str, change: Callable[[Any], Any]) -> Change:
    def parts(recording: Recording) -> Parts:
        rows = recording.ticks.copy()
        rows[name] = change(rows[name])
        return {"ticks": rows}

    return parts


def rows(change: Callable[[Any], Any]) -> Change:
    return lambda recording: {"ticks": change(recording.ticks.copy())}


def without(name: str) -> Change:
    return lambda r: {"events": [e for e in r.events if e["event"] != name]}


def event(kind: str, **values: Any) -> Change:
    def parts(recording: Recording) -> Parts:
        first = next(e for e in recording.events if e["event"] == kind)
        return {"events": [e | values if e is first else e for e in recording.events]}

    return parts


def attached(name: str, change: Callable[[bytes], bytes]) -> Change:
    return lambda recording: {"attachments": {name: change(recording.attachments[name])}}


def dropped(prefix: str) -> Change:
    """Leaves attachments out."""
    return lambda _: {"without": prefix}


def shortened(recording: Recording) -> Parts:
    """Cuts the tail off, and ends the run there."""
    count = len(recording.ticks) // 2
    kept = [e | {"tick": min(e["tick"], count)} for e in recording.events]
    return {"ticks": recording.ticks[:count], "events": kept}


def on_time(recording: Recording) -> Parts:
    """Hides the missed deadlines everywhere."""
    late = recording.ticks.copy()
    late["flags"] &= ~int(TickFlag.OVERRUN)
    for name in CLOCK_FIELDS:
        late[name] = 1_000_000 * (1 + late["tick"])
    clean = {"overruns": 0, "skipped": 0}
    return {
        "ticks": late,
        "events": [e | clean if "overruns" in e else e for e in recording.events],
    }


def other_law(recording: Recording) -> Parts:
    """Doubles the stiffness in request and law."""
    stiffness = 2 * float(recording.meta["stiffness"])
    requested = json.loads(recording.meta["requested"])
    changed = {"stiffness": repr(stiffness), "requested": json.dumps([stiffness, *requested[1:]])}
    return {"meta": changed}


def other_sheet(recording: Recording, **values: Any) -> Parts:
    """Changes the data sheet, and all guard parameters that follow from it."""
    changed = requested_sheet(recording, **values)
    info = DeviceInfo.from_json(changed["device"])
    old = json.loads(recording.meta["guard"])
    limits = Limits(force=10.0, torque=0.5)
    new = guard_parameters_for(info, limits, float(recording.meta["period_s"]), controller="off")
    names = ("assumed_damping", "assumed_rotational_damping", "max_damping", "twist_damping")
    own = {name: getattr(new, name) for name in (*names, "max_rotational_damping")}
    return {"meta": changed | {"guard": json.dumps(old | own)}}


def other_reason(recording: Recording) -> Parts:
    """Replaces the sentence on the carried weight."""
    *changes, _ = json.loads(recording.meta["scene_changes"])
    return {"meta": {"scene_changes": json.dumps([*changes, "the tool is a feather"])}}


def no_trip(recording: Recording) -> Parts:
    """Removes the trip, and lets the run end by itself."""
    kept = [e for e in recording.events if e["event"] != "trip"]
    return {"events": [e | {"reason": "duration"} if e["event"] == "stop" else e for e in kept]}


def doubled(recording: Recording) -> Parts:
    return {"events": [recording.events[0], *recording.events]}


def added(place: int, event: dict[str, Any]) -> Change:
    """Adds an event at a place of the list."""

    def parts(recording: Recording) -> Parts:
        time = recording.events[min(place, len(recording.events) - 1)]["time_ns"]
        events = [*recording.events]
        events.insert(place, event | {"time_ns": time})
        return {"events": events}

    return parts


@dataclass(frozen=True)
class Forgery:
    """A kind of forgery.

    Attributes:
        run: Honest recording that is forged.
        change: Parts that are changed.
        seen: Verdict where the run can be simulated again.
        blind: Verdict from the records alone.
        why: Reason why nothing in the file shows it; empty if it is seen.
    """

    run: Callable[[Path], Path]
    change: Change
    seen: str = "invalid"
    blind: str = "invalid"
    why: str = ""


def seen(run: Callable[[Path], Path], change: Change) -> Forgery:
    """Returns a forgery that the records alone give away."""
    return Forgery(run, change)


def again(run: Callable[[Path], Path], change: Change) -> Forgery:
    """Returns a forgery that only the simulation gives away."""
    return Forgery(run, change, blind="unverified")


def hidden(run: Callable[[Path], Path], change: Change, why: str) -> Forgery:
    """Returns a forgery that nothing in the file gives away."""
    return Forgery(run, change, "passive", "unverified", why)


UNREACHED = "a limit that the run never reached: an honest run with it has the same records"
OWN_WORD = "a statement of the user or the machine, that nothing else in the file depends on"
LESS = "it claims less: an uncertified device, or a run without a guard"
PUNCTUAL = "an honest run that met all its deadlines has these records"
FOR_READERS = "a sentence for readers; the compiled model holds what it tells"
SHORTER = "an honest run that ended earlier has these records"

NO_WRITES: tuple[Any, ...] = (
    [["qpos", 0, [1.0]]], [["ctrl", 0, 1.0]], [["ctrl", 10**6, [1.0]]], {"a": 1}, None,
)  # fmt: skip
FORGERIES: dict[str, Forgery] = {
    # coupling and method
    "stiffness": seen(hand, times("stiffness")),
    "law damping": seen(hand, times("damping")),
    "rotational stiffness": seen(hand, times("rotational_stiffness")),
    "requested coupling": seen(hand, component("requested", 0)),
    "requested coupling and law": seen(hand, other_law),
    "effective coupling": seen(hand, text(effective="[1, 1, 1, 1]")),
    "method": seen(hand, text(method="implicit")),
    "contact": seen(hand, text(contact="scene")),
    "contact stiffness": seen(hand, text(contact_stiffness="1000.0")),
    "grip": seen(hand, text(grip="elsewhere")),
    "request": seen(hand, lambda r: {"meta": other_request(r, lambda q: q.update(clock="real"))}),
    "no request": seen(hand, text(request="")),
    # workspace and time
    "period": seen(hand, times("period_s")),
    "substeps": seen(hand, text(substeps="2")),
    "scale": seen(hand, times("scale")),
    "force scale": seen(hand, times("force_scale")),
    "axes": seen(hand, component("axes", 0)),
    "ramp": seen(hand, times("ramp_ticks", 2)),
    "device origin": seen(hand, component("device_origin", 0)),
    "handle origin": again(hand, component("handle_origin", 0)),
    "device start": seen(hand, component("device_start", 0)),
    "handle start": seen(hand, component("handle_start", 1)),
    "tool start": seen(hand, component("tool_start", 2)),
    "start kinetic": seen(hand, times("start_kinetic")),
    "start potential": seen(hand, times("start_potential")),
    "clock": seen(hand, text(clock="sundial")),
    "started": hidden(hand, text(started="2001-01-01T00:00:00+00:00"), OWN_WORD),
    # device
    "device damping": seen(hand, entry("device", damping=50.0)),
    "damping of an active run": seen(swung, entry("device", damping=50.0)),
    "rotational damping": seen(hand, entry("device", rotational_damping=1.0)),
    "device mass": seen(hand, entry("device", mass=5e-4)),
    "device rate": seen(hand, entry("device", rate=100.0)),
    "speed limit": seen(hand, entry("device", speed_limit=0.9)),
    "axes of the device": seen(hand, entry("device", axes=["x", "y", "z"])),
    "real device": hidden(hand, sheet(is_real=True), OWN_WORD),
    "prescribed motion": seen(hand, entry("device", is_prescribed=True)),
    "unknown damping": hidden(hand, sheet(damping=None), LESS),
    "device name": hidden(hand, sheet(name="other"), OWN_WORD),
    "device name beside the request": seen(hand, entry("device", name="other")),
    "damping and all that follows from it": hidden(
        swung, partial(other_sheet, damping=50.0, rotational_damping=1.0), OWN_WORD
    ),
    "force limit above the device's": seen(hand, text(force_limit="1000.0")),
    "force limit below the force": seen(hand, text(force_limit="0.01")),
    # guard
    **{
        f"guard: {name}": seen(hand, guard(name, 2.0))
        for name in (
            *("controller", "assumed_damping", "assumed_rotational_damping", "max_damping"),
            *("max_rotational_damping", "energy_credit_limit", "stale_ticks", "fade_ticks"),
            *("has_hand", "dead_man", "speed", "turn_speed", "full_speed", "motors"),
            *("swing_energy", "runaway_speed", "twist_damping"),
        )
    },
    "guard: delay margin": seen(hand, entry("guard", delay_margin=1.0)),
    "guard: a delay and no margin": seen(
        hand, entry("guard", stated_delay=0.05, delay_margin="inf")
    ),
    "guard: resolution": seen(hand, entry("guard", resolution=5e-5)),
    "guard: no margin": seen(hand, entry("guard", delay_margin="inf")),
    "guard: stated delay": seen(hand, entry("guard", stated_delay=0.05)),
    "guard: idle force": seen(hand, guard("idle_force", 2.0)),
    "guard: idle torque": seen(hand, guard("idle_torque", 2.0)),
    "guard: hold force out of range": seen(hand, guard("hold_force", -1.0)),
    "guard: hold force below the load": seen(weighed, guard("hold_force", 0.2)),
    **{
        f"guard: {name}": seen(hand, guard(name, 1.1))
        for name in ("stretch", "angle", "energy", "hold_force", "hold_torque")
    },
    **{
        f"requested limit and guard: {name}": hidden(hand, limit(name), UNREACHED)
        for name in ("stretch", "angle", "energy", "hold_force", "hold_torque")
    },
    "guard: all off": hidden(hand, text(guard=UNGUARDED.to_json()), LESS),
    "guard: out of range": seen(hand, guard("angle", 1.5)),
    # scene
    "comment in the scene": hidden(
        hand, attached(SCENE, lambda data: data + b"<!-- kind -->"), OWN_WORD
    ),
    "scene says hello": again(hand, attached(SCENE, lambda _: b"hello")),
    "scene is empty": again(hand, attached(SCENE, lambda _: b"<mujoco/>")),
    "heavier peg": again(
        hand, attached(SCENE, lambda data: data.replace(b"mass=", b"mass='9' m="))
    ),
    "no wall": again(hand, attached(SCENE, lambda data: data.replace(b"hole_east", b"hole_feast"))),
    "no parameter file": again(hand, attached(SHEET, lambda _: b"")),
    "scene parameters": again(hand, entry("scene_parameters", mass=0.12)),
    "lacking scene parameter": again(hand, text(scene_parameters="{}")),
    "scene name": seen(hand, text(scene="harmless")),
    "scene file": seen(hand, text(scene_file="harmless.xml")),
    "scene changes": again(hand, text(scene_changes='["none"]')),
    "weight of the tool": again(hand, text(tool_weight="carried")),
    "weight that was asked to be carried": seen(carried, text(tool_weight="felt")),
    "reason why a weight is carried": hidden(carried, other_reason, FOR_READERS),
    "weight of the tool in another word": seen(hand, text(tool_weight="light")),
    "scene hash": again(hand, text(scene_sha256="0" * 64)),
    "start state": again(hand, attached(STATE_ATTACHMENT, lambda data: data[:-8] + b"\1" * 8)),
    "no start state": Forgery(hand, dropped(STATE_ATTACHMENT), "unverified", "unverified"),
    "no scene": Forgery(hand, dropped(SOURCE_PREFIX), "unverified", "unverified"),
    # machine
    "no versions": Forgery(hand, text(versions="{}"), "unverified", "unverified"),
    "another version": Forgery(hand, entry("versions", numba="0.1"), "unverified", "unverified"),
    "another processor": hidden(hand, entry("host", processor="abacus"), OWN_WORD),
    # events
    "no start": seen(hand, without("start")),
    "two starts": seen(hand, doubled),
    "no stop": seen(hand, without("stop")),
    "stop elsewhere": seen(hand, event("stop", tick=100)),
    "overruns of the stop": seen(busy, event("stop", overruns=0)),
    "skipped of the stop": seen(busy, event("stop", skipped=0)),
    "dropped of the stop": seen(busy, event("stop", dropped=7)),
    "reason of the stop": hidden(hand, event("stop", reason="caller"), OWN_WORD),
    "two stops": seen(hand, lambda r: {"events": [*r.events, r.events[-1]]}),
    "event before the start": seen(hand, added(0, {"event": "mark", "tick": 0})),
    "event after the stop": seen(hand, added(2, {"event": "mark", "tick": 200})),
    "event after the end": seen(busy, event("input", tick=100_000)),
    "event without a tick": seen(busy, event("input", tick=None)),
    "no input": again(busy, without("input")),
    "another input": again(busy, event("input", writes=[])),
    "an input of other numbers": again(
        busy, event("input", writes=[["xfrc_applied", 6, [0.01, 0, 0, 0, 0, 1e-6]]])
    ),
    **{
        f"an input that is none: {writes!r}": again(busy, event("input", writes=writes))
        for writes in NO_WRITES
    },
    "an input before the run": seen(busy, event("input", tick=-1)),
    "input earlier": again(busy, event("input", tick=230)),
    "no change of the coupling": seen(busy, without("coupling")),
    **{
        f"another change of the coupling: {change}": seen(busy, event("coupling", **change))
        for change in ({"stiffness": 999.0}, {"tick": 101}, {"ticks": 1}, {"damping": -1.0})
    },
    **{
        f"another switch: {change}": seen(busy, event("switch", **change))
        for change in ({"force": True}, {"tick": 421}, {"clutch": 1})
    },
    **{
        f"another reset: {change}": seen(busy, event("reset", **change))
        for change in ({"event": "nothing"}, {"tick": 442}, {"tick": "x"})
    },
    "no reset": seen(busy, without("reset")),
    "no trip": seen(tripped, without("trip")),
    "no trip, another end": hidden(tripped, no_trip, SHORTER),
    # records
    "tail cut off": hidden(hand, shortened, SHORTER),
    "tail cut off, stop kept": seen(hand, rows(lambda r: r[:-10])),
    "head cut off": seen(hand, rows(lambda r: r[10:])),
    "row missing": seen(hand, rows(lambda r: np.delete(r, 50))),
    "row twice": seen(hand, rows(lambda r: np.insert(r, 50, r[50]))),
    "rows exchanged": seen(hand, rows(lambda r: r[[*range(50), 51, 50, *range(52, len(r))]])),
    "wrench on the device": seen(hand, ticks("wrench_on_device", lambda v: 0.9 * v)),
    "wrench on the tool": seen(hand, ticks("wrench_on_tool", lambda v: 0.9 * v)),
    "tank": seen(hand, ticks("contact_tank", lambda v: 0.9 * v)),
    "work of the coupling": seen(hand, ticks("coupling_work", lambda v: 0.9 * v)),
    "kinetic energy": seen(hand, ticks("kinetic", lambda v: 0.9 * v)),
    "environment energy": seen(hand, ticks("environment_energy", lambda v: v - 1e-3)),
    "device energy": seen(hand, ticks("device_energy", lambda v: v - 1e-3)),
    "tool position": seen(hand, ticks("tool_position", lambda v: v + 1e-6)),
    "contacts": seen(hand, ticks("contacts", lambda v: 0 * v)),
    "buttons": seen(hand, ticks("buttons", lambda v: v | 1 << 40)),
    "no flags": seen(hand, ticks("flags", lambda v: 0 * v)),
    "missed deadlines": seen(busy, ticks("flags", lambda v: v & ~int(TickFlag.OVERRUN))),
    "missed deadlines and their times": hidden(busy, on_time, PUNCTUAL),
    "late forces": seen(hand, ticks("write_ns", lambda v: v - 2_000_000)),
}


def judged(forgery: Forgery, recording: Recording, folder: Path, *, is_blind: bool) -> AuditReport:
    parts = forgery.change(recording)
    if (prefix := parts.pop("without", None)) is not None:
        kept = {n: d for n, d in recording.attachments.items() if not n.startswith(prefix)}
        recording = Recording(**{**vars(recording), "attachments": kept})
    if is_blind:
        other = {"versions": json.dumps(versions() | {"mujoco": "3.0"})}
        parts["meta"] = {**other, **parts.get("meta", {})}
    return verdict_of(recording, folder, **parts)


@pytest.mark.parametrize("name", FORGERIES)
def test_a_forgery_is_not_called_passive(
    name: str, honest: Callable[[Any], Recording], tmp_path: Path
) -> None:
    forgery = FORGERIES[name]
    recording = honest(forgery.run)
    report = judged(forgery, recording, tmp_path, is_blind=False)
    assert report.verdict == forgery.seen, report.reason
    assert (report.exit_code == 0) == bool(forgery.why), "only a forgery with a reason may pass"
    blind = judged(forgery, recording, tmp_path, is_blind=True)
    assert blind.verdict == forgery.blind, blind.reason
    assert blind.exit_code == 1


def test_a_run_whose_handle_started_away_from_the_grip_is_invalid(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Simulated again it agrees with itself; only the scene tells where the handle belongs."""

    def elsewhere(*arguments: Any) -> tuple[float, ...]:
        x, *rest = start_handle(*arguments)
        return (x + 1e-3, *rest)

    with monkeypatch.context() as patch:
        patch.setattr("hapticbridge.run.options.start_handle", elsewhere)
        path = hand(tmp_path)
    report = audit(path)
    assert (report.verdict, "'handle_origin'" in report.reason) == ("invalid", True), report.reason


def test_the_honest_recordings_are_what_the_forgeries_hide(
    honest: Callable[[Any], Recording],
) -> None:
    expected = {hand: "passive", busy: "passive", tripped: "passive"}
    expected |= {swung: "active", weighed: "passive", carried: "passive"}
    for run, verdict in expected.items():
        report = audit(honest(run).path)
        assert (report.verdict, report.resimulation) == (verdict, "bit for bit"), report.reason
    assert audit(honest(hand).path).certified is True
    assert len(FORGERIES) >= 60
    assert math.isfinite(audit(honest(swung).path).joules)
    assert processor()
