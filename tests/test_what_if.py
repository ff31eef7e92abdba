"""A recorded hand through a changed bridge: the same run where nothing is changed, and what a model
hand does that wants what the recorded one wanted."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import report_runs
from audit_cases import TAP, ScriptedDevice, SlowClock, other_sheet, recorded, rewritten
from cli_cases import Called
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hapticbridge.coupling import Coupling
from hapticbridge.demand.guard import Limits
from hapticbridge.device import DeviceInfo, Hand, Motion, SimulatedDevice
from hapticbridge.errors import RecordingError, SafetyTrip
from hapticbridge.kernel.record import TICK_DTYPE, TickFlag
from hapticbridge.recording import read_recording
from hapticbridge.run.bridge import Bridge
from hapticbridge.run.commands import Command, Couple, Reset, Switch
from hapticbridge.run.description import SOURCE_PREFIX
from hapticbridge.run.options import Workspace
from hapticbridge.scene import load_scene
from hapticbridge.units import format_si
from hapticbridge.whatif import WhatIf, WhatIfRun, changes_from, write_what_if
from hapticbridge.whatif import what_if as confined_what_if
from hapticbridge.whatif.page import rows
from hapticbridge.whatif.recorded import RecordedRun
from hapticbridge.whatif.replayed_hand import Repetition, intended

DURATION = 0.4

what_if = partial(confined_what_if, in_process=True)
"""The child process is tested in ``test_recorded_scene``."""


@pytest.fixture(scope="module")
def wall(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A hand that presses a wall and is pressed back."""
    path = tmp_path_factory.mktemp("what_if") / "wall.mcap"
    motion = path.with_name("hand.csv")
    motion.write_text("t,x,y,z\n0,0,0,0\n0.05,0,0,0\n0.2,0.02,0,0\n0.4,0.02,0.003,0\n")
    recorded(path, "virtual_wall", f"simulated:path={motion}", duration=DURATION)
    return path


@pytest.fixture(scope="module")
def softer(wall: Path) -> WhatIf:
    return what_if(wall, {"stiffness": 600, "damping": 0.6})


def run_of(found: WhatIf, name: str) -> WhatIfRun:
    return next(run for run in found.runs if run.name == name)


def same_in_every_bit(one: WhatIfRun, other: WhatIfRun) -> None:
    assert len(one.ticks) == len(other.ticks)
    for name in TICK_DTYPE.names or ():
        assert one.ticks[name].tobytes() == other.ticks[name].tobytes(), name


def test_another_digit_in_the_last_place_is_told(wall: Path, tmp_path: Path) -> None:
    """The agreement is compared, not claimed: what was recorded elsewhere may differ."""
    recording = read_recording(wall)
    meta = json.loads(recording.meta["host"])
    rows = recording.ticks.copy()
    rows["kinetic"][150] *= 1 + 1e-12
    elsewhere = {"host": json.dumps(meta | {"processor": "another"})}
    found = what_if(rewritten(recording, tmp_path / "a.mcap", ticks=rows, meta=elsewhere), {})
    assert any(
        "differs from the recorded one from tick 150 on, in kinetic" in n for n in found.notes
    )


def commanded(bridge: Bridge, tick: int) -> None:
    """A push, force off and on, another coupling, a reset."""
    if tick in (10, 20):
        bridge.set_input(body_wrench={"peg": [0.05, 0, 0, 0, 0, 0]})
    asked: dict[int, Command] = {
        30: Switch(force=False),
        60: Switch(force=True),
        100: Couple(stiffness=1500.0, damping=1.0),
        150: Reset(),
    }
    if tick in asked:
        bridge.command(asked[tick])


def test_commands_are_done_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("INTERVAL", "RESET_INTERVAL"):  # no time passes between them
        monkeypatch.setattr(f"hapticbridge.run.commands.{name}", 0.0)
    path, motion = tmp_path / "run.mcap", tmp_path / "tap.csv"
    motion.write_text(TAP)
    device = f"simulated:path={motion}"
    recorded(path, "peg_in_hole", device, duration=0.22, on_tick=commanded)
    found = what_if(path, {})
    same_in_every_bit(found.runs[1], found.runs[0])
    assert found.runs[1].report.events["input"] == 2
    names = [event["event"] for event in found.runs[2].recording.events]
    assert (names.count("switch"), names.count("coupling"), names.count("reset")) == (4, 1, 1)
    stiff = what_if(path, {"stiffness": 2000})
    assert "coupling" not in stiff.runs[1].report.events
    assert stiff.runs[1].report.events["reset"] == 1
    assert any("here it is constant" in note for note in stiff.notes)
    # at half the rate at half the ticks, and felt as it was: B' = 1 − K T/2 at T = 2 ms
    slow = what_if(path, {"rate": 500}).runs[1].recording.events
    changes = [e for e in slow if e["event"] == "coupling"]
    assert [(e["tick"], e["ticks"]) for e in changes] == [(50, 250)]
    assert changes[0]["damping"] == pytest.approx(max(1.0 - 1500 * 0.002 / 2, 0.0))
    [run] = RecordedRun.from_hands([read_recording(path)], tmp_path / "scene")
    for method, kept in (("direct", False), ("weld", True)):
        again = Repetition([run], [run.settings.changed({"method": method})])
        assert (again.keeps_resets, again.keeps_coupling({})) == (kept, False)


def test_a_prescribed_motion_is_the_recorded_one(softer: WhatIf) -> None:
    prescribed, before = run_of(softer, "prescribed"), softer.runs[0]
    np.testing.assert_array_equal(
        prescribed.ticks["device_position"], before.ticks["device_position"]
    )
    # pressed in as far, a quarter as stiff; K e is nearly all of the force
    ratio = prescribed.peaks["force on hand"] / before.peaks["force on hand"]
    assert ratio == pytest.approx(0.25, abs=0.03)
    assert prescribed.report.certified is True  # judged as the recorded device, not as nobody


def test_the_model_hand_gives_way_as_a_spring_against_a_spring_does(softer: WhatIf) -> None:
    """At the end all but rests: the scene's hand, 1000 N/m towards 20 mm, and a wall at 10 mm."""
    closed, before = run_of(softer, "closed loop"), softer.runs[0]
    deep = [float(run.ticks["device_position"][-1, 0]) for run in (before, closed)]
    force = [float(run.ticks["wrench_on_tool"][-1, 0]) for run in (before, closed)]
    for run, stiffness in zip((0, 1), (2400.0, 600.0), strict=True):
        # k_h (p − x) = K (x − wall)
        assert deep[run] == pytest.approx(
            (1000 * 0.02 + stiffness * 0.01) / (1000 + stiffness), rel=0.02
        )
        assert force[run] == pytest.approx(1000 * (0.02 - deep[run]), rel=0.05)
    assert deep[1] - deep[0] > 1e-3


@pytest.mark.parametrize(
    ("changes", "live"),
    [
        ({"stiffness": 600, "damping": 0.6}, {"coupling": (600.0, 0.6)}),
        ({"distance": 0.012, "mass": 0.1}, {"scene": {"distance": 0.012, "mass": 0.1}}),
    ],
)
def test_the_closed_loop_is_what_a_live_run_with_that_setting_does(
    changes: dict[str, Any], live: dict[str, Any], wall: Path, softer: WhatIf, tmp_path: Path
) -> None:
    """The same simulated hand, asked directly; the what-if knows only what it did elsewhere."""
    scene = load_scene("virtual_wall", **live.get("scene", {}))
    stiffness, damping = live.get("coupling", (2400.0, 1.7))
    coupling = Coupling(stiffness, damping, 2.4, 1.7e-3)
    path, hand = tmp_path / "live.mcap", wall.with_name("hand.csv")
    rate, specification = live.get("rate", 1000), f"simulated:path={hand}"
    recorded(path, scene, specification, coupling, duration=DURATION, rate=rate)
    truth, before = read_recording(path).ticks, softer.runs[0].ticks
    found = softer if "stiffness" in changes else what_if(wall, changes)
    guess = run_of(found, "closed loop").ticks
    assert len(guess) == len(truth)
    off = np.abs(guess["device_position"] - truth["device_position"]).max()
    assert off < 0.15e-3  # of 20 mm
    forces = [np.linalg.norm(t["wrench_on_tool"][:, :3], axis=1) for t in (guess, truth, before)]
    assert np.abs(forces[0] - forces[1]).max() < 0.05 * forces[1].max()
    if "rate" not in changes:  # and it is not what was recorded
        assert np.abs(forces[2] - forces[1]).max() > 0.2 * forces[1].max()


class TurnedDevice(SimulatedDevice):
    """A simulated device whose handle is turned at the start, in its own coordinates."""

    FIRST = Rotation.from_rotvec([0.4, -0.9, 0.2])

    def start(self, period: float, parts: int = 1) -> NDArray[np.void]:
        sample = super().start(period, parts)
        self.turn(sample)
        return sample

    def read(self, sample: NDArray[np.void]) -> int:
        flags = super().read(sample)
        self.turn(sample)
        return flags

    def turn(self, sample: NDArray[np.void]) -> None:
        moved = Rotation.from_quat(sample["quaternion"][0], scalar_first=True)
        sample["quaternion"][0] = (moved * self.FIRST).as_quat(canonical=True, scalar_first=True)


def test_a_device_that_starts_turned_turns_as_recorded(tmp_path: Path) -> None:
    share = np.linspace(0.0, 1.0, 11)
    turns = Rotation.from_rotvec(share[:, None] * [0.3, 0.2, -0.3]).as_quat(scalar_first=True)
    path = Motion(0.4 * share, np.zeros((11, 3)), turns.tolist())
    recorded(tmp_path / "turned.mcap", "point_mass", TurnedDevice(path=path), duration=0.4)
    found = what_if(tmp_path / "turned.mcap", {})
    before, after = (
        Rotation.from_quat(run.recording.ticks["device_quaternion"], scalar_first=True)
        for run in (found.runs[0], run_of(found, "closed loop"))
    )
    assert (before[-1] * before[0].inv()).magnitude() > 0.2
    assert (after * before.inv()).magnitude().max() < 0.01


def test_what_the_hand_wanted_is_found_where_it_is_known() -> None:
    """A device of 0.1 kg and 2 N s/m in a hand, in closed form: x = sin ωt gives p and w = 0."""
    period, omega, size = 1e-3, 2 * np.pi * 1.0, 0.01
    time = period * np.arange(2000)
    ticks = np.zeros(len(time), TICK_DTYPE)
    ticks["device_position"][:, 0] = size * (1 - np.cos(omega * time))
    ticks["device_quaternion"][:, 0] = 1.0
    info = DeviceInfo(
        name="d", axes=("x", "y", "z"), force_limit=10, mass=0.1, damping=2.0, delay=0.0
    )
    hand = Hand()
    table = intended(info, hand, ticks, period, (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0))
    # b_h p' + k_h p = (m + m_h) x'' + (b + b_h) x' + k_h x, solved for one frequency
    s = 1j * omega
    law = (0.65 * s**2 + 8.5 * s + 135.0) / (6.5 * s + 135.0)
    expected = size * (1 - np.real(law * np.exp(s * time)))
    settled = slice(400, 1900)  # the filter starts at rest, and smoothing ends at the edges
    np.testing.assert_allclose(table[settled, 1], expected[settled], atol=0.01 * size)
    assert np.abs(table[:, 2:4]).max() == 0.0


def test_without_a_device_that_answers_there_is_no_closed_loop(wall: Path, tmp_path: Path) -> None:
    recording = read_recording(wall)
    unknown = other_sheet(recording, mass=None)
    found = what_if(rewritten(recording, tmp_path / "a.mcap", meta=unknown), {"rate": 2000})
    assert [run.name for run in found.runs] == ["recorded", "prescribed"]
    assert any("no closed loop: unknown mass of the device" in note for note in found.notes)
    assert np.isnan(found.hand_error)
    assert json.loads(found.to_json())["hand_error"] is None


def test_a_recording_that_is_not_what_it_says_is_not_simulated(wall: Path, tmp_path: Path) -> None:
    recording = read_recording(wall)
    rows = recording.ticks.copy()
    rows["kinetic"][50] += 1.0
    with pytest.raises(RecordingError, match="an invalid recording cannot be simulated again"):
        what_if(rewritten(recording, tmp_path / "a.mcap", ticks=rows), {})
    bare = {n: d for n, d in recording.attachments.items() if not n.startswith(SOURCE_PREFIX)}
    alone = replace(recording, attachments=bare)
    with pytest.raises(RecordingError, match="carries no scene"):
        what_if(rewritten(alone, tmp_path / "b.mcap"), {})
    evil = {f"{SOURCE_PREFIX}../../evil.xml": b"<mujoco/>"}
    with pytest.raises(RecordingError, match="outside the scene's folder"):
        what_if(rewritten(recording, tmp_path / "c.mcap", attachments=evil), {})


@pytest.mark.usefixtures("undrawn")
def test_the_command_shows_runs_side_by_side_and_draws_them(
    wall: Path, tmp_path: Path, call: Called
) -> None:
    picture, page = tmp_path / "what_if.png", tmp_path / "page.html"
    command = ("audit", wall, "--what-if", "stiffness=5000", "--plot", picture, "--report", page)
    code, out, err = call(*command)
    text = text_of(page)
    assert "The device does not bear the changed coupling" in text
    assert f"data:image/png;base64,{base64.b64encode(b'a picture').decode()}" in text
    assert code == 1  # 2 N s/m do not bear it
    assert "stiffness: 2400 N/m -> 5000 N/m" in out
    assert out.index("recorded") < out.index("prescribed") < out.index("closed loop")
    assert "off the recorded motion" in err
    assert picture.stat().st_size > 10_000
    code, out, _ = call("audit", wall, "--what-if", "stiffness=1000", "--json")
    told = json.loads(out)
    assert code == 0
    assert [run["name"] for run in told["runs"]] == ["recorded", "prescribed", "closed loop"]
    assert told["changes"] == [
        {"name": "stiffness", "unit": "N/m", "before": 2400.0, "after": 1000.0}
    ]


def test_motions_are_told_apart_by_rate(wall: Path) -> None:
    """At twice the rate every second sample is a recorded one, and those between are midway."""
    found = what_if(wall, {"rate": 2000})
    before, after = (run.ticks["device_position"] for run in found.runs[:2])
    np.testing.assert_allclose(after[::2], before, rtol=0, atol=1e-15)
    middle = 0.5 * (before[1:] + before[:-1])
    np.testing.assert_allclose(after[1:-1:2], middle, rtol=0, atol=1e-12)


@pytest.mark.parametrize("button", ["clutch", "dead_man"])
def test_a_button_does_again_what_it_did(button: str, tmp_path: Path) -> None:
    path = tmp_path / "pressed.mcap"
    options: dict[str, Any] = {button: 0}
    device = ScriptedDevice(drift(1e-4), buttons=lambda tick: int(100 <= tick < 200))
    recorded(path, "point_mass", device, duration=0.3, **options)
    same, slower = what_if(path, {}), what_if(path, {"rate": 500})
    before, after = same.runs[0].ticks, same.runs[1].ticks
    # else the handle would be 10 mm further on, or the wrench there all the time
    np.testing.assert_allclose(after["handle_position"], before["handle_position"], atol=1e-9)
    np.testing.assert_allclose(after["wrench_on_device"], before["wrench_on_device"], atol=1e-6)
    for run in (*same.runs, *slower.runs[1:]):
        released = (run.ticks["flags"] & int(TickFlag.CLUTCH)) != 0
        times = run.period * np.flatnonzero(released)
        pressed = (times >= 0.1) & (times < 0.2)
        assert pressed.all() == (button == "clutch")
        assert released.sum() * run.period == pytest.approx(0.1 if button == "clutch" else 0.2)


class Moved(ScriptedDevice):
    """A device that somebody moved by 20 mm between its start and its first sample."""

    def start(self, period: float) -> NDArray[np.void]:
        sample = super().start(period)
        sample["position"][0, 0] -= 0.02
        return sample


def drift(step: float) -> Callable[[int], tuple[float, ...]]:
    return lambda tick: (step * tick, 0, 0, 1, 0, 0, 0)


REPEATED: dict[str, tuple[ScriptedDevice, dict[str, Any], TickFlag]] = {
    "limits": (
        ScriptedDevice(lambda tick: (0.004 * (tick > 60), 0, 0, 1, 0, 0, 0)),
        {"limits": Limits(force=3.0, torque=0.2, ramp=0.02), "workspace": Workspace(scale=2.0)},
        TickFlag.FORCE_LIMITED,
    ),
    "the edge of the reach": (
        ScriptedDevice(drift(1e-4)),
        {"limits": Limits(force=10.0, torque=0.5, reach=0.005)},
        TickFlag.CLUTCH,
    ),
    "old samples": (
        ScriptedDevice(drift(1e-4), is_stale=lambda tick: tick >= 20),
        {},
        TickFlag.STALE_SAMPLE,
    ),
    "a device moved before the first tick": (Moved(drift(1e-5)), {}, TickFlag.REANCHORED),
    "a stall": (ScriptedDevice(drift(2e-5)), {"clock": SlowClock({20: 80})}, TickFlag.REANCHORED),
}


@pytest.mark.parametrize("name", REPEATED)
def test_what_the_guard_did_comes_back_in_every_bit(name: str, tmp_path: Path) -> None:
    (device, options, flag), path = REPEATED[name], tmp_path / "run.mcap"
    recorded(path, "point_mass", device, duration=0.1, **options)
    found = what_if(path, {})
    before, after = (run.ticks for run in found.runs[:2])
    assert (before["flags"] & int(flag)).any()
    assert before.tobytes() == after.tobytes()
    if name == "old samples":
        slower = what_if(path, {"rate": 700}).runs[1]
        for ticks in (before, slower.ticks):  # it has faded
            assert np.abs(ticks["wrench_on_device"][-1]).max() == 0.0
        assert slower.report.verdict == "passive"  # no tick is called old that has moved
    elif name == "a stall":
        [told] = [note for note in found.notes if note.startswith("late ticks: 1")]
        assert "none in the closed loop" in told


def test_a_model_hand_feels_the_controller_that_is_asked_for(tmp_path: Path) -> None:
    path = report_runs.swung(tmp_path / "run.mcap", duration=1.4)
    ticks = {}
    for name in ("off", "damper"):
        found = what_if(path, {"controller": name})
        assert found.changes == (("controller", "", "off", name),)
        ticks[name] = found.runs[2].ticks
    at_work = {n: (t["flags"] & int(TickFlag.CONTROLLER_ACTIVE)) != 0 for n, t in ticks.items()}
    assert not at_work["off"].any()
    assert at_work["damper"].any()


def test_a_trip_is_shown_beside_what_does_not_trip(tmp_path: Path) -> None:
    path, scene = tmp_path / "trip.mcap", "point_mass"
    device = ScriptedDevice(lambda tick: (0.001 * max(tick - 50, 0), 0, 0, 1, 0, 0, 0))
    with pytest.raises(SafetyTrip):
        recorded(
            path, scene, device, duration=0.3, limits=Limits(force=10.0, torque=0.5, stretch=0.005)
        )
    same = what_if(path, {}).runs
    assert same[1].report.trip == same[0].report.trip
    assert len(same[1].ticks) == len(same[0].ticks)
    found = what_if(path, {"stiffness": 100, "damping": 0.2})
    assert "stretch limit" in str(found.runs[0].report.trip)
    assert "stretch limit" in str(found.runs[1].report.trip)
    assert found.exit_code == 1
    tripped = len(found.runs[0].ticks)
    # a softer spring is as long sooner
    assert len(found.runs[1].ticks) < tripped
    stiffer = what_if(path, {"stiffness": 5000}).runs[1]  # goes on where the recorded run stopped
    assert stiffer.report.verdict != "invalid"
    assert len(stiffer.ticks) == tripped + 1


def text_of(page: Path) -> str:
    return re.sub(r"<svg.*?</svg>", "[svg]", page.read_text(encoding="utf-8"), flags=re.DOTALL)


def test_the_page_of_a_run_made_active_has_a_likely_cause_for_each(tmp_path: Path) -> None:
    path, page = tmp_path / "run.mcap", tmp_path / "page.html"
    device = ScriptedDevice(report_runs.circling)
    recorded(path, "point_mass", device, report_runs.LOOSE, duration=0.3)
    found = what_if(path, {"method": "implicitfast", "stiffness": 2500})
    write_what_if(found, page)
    assert [run.report.verdict for run in found.runs] == ["passive", "active", "active"]
    text = text_of(page)
    assert text.count("Likely cause: <strong>method</strong>") == 2
    for run in found.runs:
        is_active = run.report.verdict == "active"
        assert (f"<h2>The moment ({run.name})</h2>" in text) is is_active


def test_a_setting_may_have_the_dashes_of_its_flag() -> None:
    words = "rotational-stiffness=2", "left-grip:force-scale=0.5", "peg-mass=1", "rate=500"
    assert changes_from(words) == [
        {
            "rotational_stiffness": "2",
            "left-grip:force_scale": "0.5",
            "peg-mass": "1",
            "rate": "500",
        }
    ]


def test_a_pulse_of_numbers_is_one_value() -> None:
    assert changes_from(["pulse=200,20"]) == [{"pulse": "200,20"}]
    assert changes_from(["pulse=200,20,90,8"]) == [{"pulse": "200,20"}, {"pulse": "90,8"}]
    assert changes_from(["pulse=steel,wood"]) == [{"pulse": "steel"}, {"pulse": "wood"}]


def test_several_values_of_a_setting_stand_side_by_side(wall: Path, call: Called) -> None:
    asked = ("audit", wall, "--in-process", "--what-if", "stiffness=500,900")
    code, out, _ = call(*asked, "--what-if", "damping=0.7")
    assert code == 0
    assert "stiffness 500" in out
    assert "stiffness 900" in out
    alone = [what_if(wall, {"stiffness": k, "damping": 0.7}).runs[-1] for k in (500, 900)]
    for run in alone:
        assert format_si(run.peaks["force on tool"], "N") in out
    code, _, err = call("audit", wall, "--what-if", "stiffness=5,9", "--what-if", "damping=1,2")
    assert (code, "one setting at a time" in err) == (2, True)
    code, _, err = call(
        "audit", wall, "--what-if", "stiffness=5,9", "--plot", wall.with_name("a.png")
    )
    assert (code, "show one change" in err) == (2, True)


def test_a_weight_that_is_carried_in_the_changed_run_alone_is_said(
    tmp_path: Path, call: Called
) -> None:
    heavy = """<mujoco><option timestep="0.001"/><worldbody><body name="tool"><freejoint/>
        <geom size=".02" mass="0.5"/><site name="grip"/></body></worldbody></mujoco>"""
    (tmp_path / "heavy.xml").write_text(heavy)
    recorded(tmp_path / "run.mcap", str(tmp_path / "heavy.xml"), duration=0.1)
    for change, is_said in (("force_limit=3", True), ("force_limit=9", False)):
        _, out, _ = call("audit", tmp_path / "run.mcap", "--what-if", change)
        assert bool(re.search("weight of the tool +felt +carried +carried", out)) == is_said


def test_a_motion_that_answers_no_force_is_not_called_a_device_that_answers_late(
    tmp_path: Path,
) -> None:
    """Softer, the tool lags more behind the recorded tapping, as a force behind a late device."""
    path, motion = tmp_path / "taps.mcap", tmp_path / "hand.csv"
    points = [f"{0.1 * i},0,0,{-0.03 if i % 2 else 0.02}" for i in range(21)]
    motion.write_text("\n".join(["t,x,y,z", *points]))
    recorded(path, "virtual_wall", f"simulated:path={motion}", duration=1.5)
    found = what_if(path, {"stiffness": 600})
    alarms = int(TickFlag.SWINGING | TickFlag.RUNS_AWAY)
    acted = {run.name: bool((run.ticks["flags"] & alarms).any()) for run in found.runs}
    assert (acted["recorded"], acted["prescribed"]) == (False, True)
    (note,) = (each for each in found.notes if "does not answer" in each)
    assert "the device is not judged" in note
    assert [run.report.certified for run in found.runs[:2]] == [True, None]
    table = dict(rows(found))
    for name in ("peak force on hand", "peak stretch", "device energy", "slack used"):
        recorded_one, lowered, *_ = table[name]  # a force that was lowered is not the change's
        assert (recorded_one == "–", lowered) == (False, "–"), name
    assert table["ran"][1] == "1.500 s"
    are_lowered = [run["is_lowered"] for run in json.loads(found.to_json())["runs"]]
    assert are_lowered[:2] == [False, True]
    assert not any("does not answer" in each for each in what_if(path, {}).notes)
