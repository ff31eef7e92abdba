"""Commands in a run: what they do to it, what is booked, and that its recording can be judged."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from audit_cases import ScriptedDevice, recorded
from report_runs import ANVIL, LOOSE

from hapticbridge.audit import audit
from hapticbridge.clock import SimulatedClock
from hapticbridge.coupling import Coupling
from hapticbridge.demand.guard import Limits
from hapticbridge.errors import CommandError
from hapticbridge.recording import read_recording
from hapticbridge.run.bridge import Bridge
from hapticbridge.run.commands import Command, Couple, Mark, Reset, Switch, tuning_ticks

T = 1e-3
STEPS = tuning_ticks(T)

FLOOR = """<mujoco model="floor">
  <option timestep="0.001" integrator="discrete" cone="elliptic" gravity="0 0 -1"/>
  <worldbody>
    <geom type="plane" size="0.1 0.1 0.01"/>
    <body name="ball" pos="0 0 0.03">
      <freejoint/>
      <geom type="sphere" size="0.02" mass="0.1"/>
      <site name="grip"/>
    </body>
  </worldbody>
</mujoco>"""


def swaying(tick: int) -> tuple[float, ...]:
    return (0.01 * math.sin(0.01 * tick), 0, max(-1e-4 * tick, -0.012), 1, 0, 0, 0)


class Script:
    """Gives commands at ticks of the run."""

    def __init__(self, commands: Mapping[int, Command], is_refused: bool = False) -> None:
        self.commands, self.done, self.is_refused = commands, 0, is_refused
        self.stiffness: list[float] = []
        self.bound: list[float] = []

    def __call__(self, bridge: Bridge, _: int) -> None:
        bridge.session.commands.now = lambda: self.done * T
        if self.done in self.commands:
            with suppress(*[CommandError] * self.is_refused):
                bridge.command(self.commands[self.done], by="test")
        coupling = bridge.session.kernel.bound.state["coupling"][0]
        self.stiffness.append(float(coupling["stiffness"]))
        self.bound.append(float(coupling["stiffness"] * T / 2 + coupling["damping"]))
        self.done += 1


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Callable[..., Any]]:
    def start(
        commands: Mapping[int, Command],
        seconds: float,
        scene: str = FLOOR,
        pose: Callable[[int], tuple[float, ...]] = swaying,
        coupling: Coupling = LOOSE,
        damping: float = 2.0,
        **options: Any,
    ) -> tuple[Any, Path, Script]:
        file, path = tmp_path / "scene.xml", options.pop("path", tmp_path / "run.mcap")
        file.write_text(scene)
        script = Script(commands)
        options.setdefault("on_tick", script)
        device = ScriptedDevice(pose, damping=damping)
        summary = recorded(path, str(file), device, coupling, duration=seconds, **options)
        return summary, path, script

    yield start


EVERYTHING: dict[int, Command] = {
    60: Couple(1000.0, 0.5),
    300: Couple(3000.0, 0.4),  # before the change before it is over
    900: Switch(force=False),
    960: Switch(force=True),
    1020: Switch(clutch=True),
    1080: Switch(clutch=False),
    1140: Reset(),
}


@pytest.mark.parametrize("method", ["lossless", "implicit", "compensated", "explicit"])
@pytest.mark.parametrize("pipelined", [False, True])
def test_a_run_with_commands_is_repeated_bit_for_bit_and_passive(
    run: Callable[..., Any], method: str, pipelined: bool
) -> None:
    summary, path, script = run(EVERYTHING, 1.4, method=method, pipelined=pipelined)
    report = audit(path)
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")
    assert report.certified is True
    assert "changed the coupling 2 times, last to K = 3000 N/m" in report.coupling_sentences[-1]
    assert (summary.verdict, summary.is_certified) == ("passive", True)
    # on the way no tick asks more of the device than both ends do
    assert max(script.bound) <= 2.0 * (1 + 1e-12)
    assert script.stiffness[-1] == 3000.0


def test_each_command_lands_in_an_event_with_its_tick(run: Callable[..., Any]) -> None:
    _, path, _ = run(EVERYTHING, 1.4)
    recording = read_recording(path)
    told = [(e["event"], e["tick"]) for e in recording.events]
    assert told == [
        ("start", 0),
        ("coupling", 60),
        ("coupling", 300),
        ("switch", 900),
        ("switch", 960),
        ("switch", 1020),
        ("switch", 1080),
        ("switch", 1140),  # the force fades
        ("reset", 1161),
        ("switch", 1161),
        ("stop", 1400),
    ]
    assert {e["by"] for e in recording.events if "by" in e} == {"test"}
    # whoever shows the switches must not take a reset for a force that was turned off
    assert [e["tick"] for e in recording.events if e.get("fading")] == [1140]


def stretched(tick: int) -> tuple[float, ...]:
    """Pulled 2 mm aside within 0.2 s, held, and let back between 0.9 and 1.1 s."""
    way = 2e-3 * (min(tick / 200, 1.0) if tick < 900 else max(1 - (tick - 900) / 200, 0.0))
    return (way, 0, 0, 1, 0, 0, 0)


NOTHING = 1e-6
"""Energy in J that a hand may be given from nothing; it is the error of the limited law."""


def most_given(path: Path, damping: float = 2.0, rotational: float = 2e-3) -> float:
    """Returns the most energy in J that the hand had received beyond what the damping burned."""
    ticks = read_recording(path).ticks
    sent, q = ticks["wrench_on_device"][:-1], ticks["device_quaternion"]
    moved, angle = np.diff(ticks["device_position"], axis=0), 2 * np.arctan2(q[:, 2], q[:, 0])
    turn = np.diff(angle)  # about y alone
    given = np.sum((sent[:, :3] - damping / T * moved) * moved, axis=1)
    given += (sent[:, 4] - rotational / T * turn) * turn
    return float(np.cumsum(given).max())


@pytest.mark.parametrize("stiffness", [1000.0, 3000.0])
def test_a_raised_stiffness_lets_the_handle_slip_and_gives_no_energy(
    run: Callable[..., Any], stiffness: float
) -> None:
    summary, path, script = run({250: Couple(stiffness, 1.1)}, 1.2, ANVIL, stretched)
    ticks = read_recording(path).ticks
    stretch = np.linalg.norm(ticks["handle_position"] - ticks["tool_position"], axis=1)
    before, after = stretch[[249, 249 + STEPS]]
    slipped = min(math.sqrt(2000.0 / stiffness), 1.0)  # the spring holds as much as before
    assert after == pytest.approx(slipped * before, rel=0.03)  # the anvil of 20 t gives way
    assert most_given(path) <= NOTHING
    climb = np.diff(script.stiffness)[250 : 250 + STEPS]
    np.testing.assert_allclose(climb, (stiffness - 2000.0) / STEPS, rtol=1e-9)
    assert summary.energies["environment_energy"] <= 1e-9
    assert audit(path).resimulation == "bit for bit"


def turned(tick: int) -> tuple[float, ...]:
    """Turned by 0.1 rad within 0.2 s and held."""
    half = 0.05 * min(tick / 200, 1.0)
    return (0, 0, 0, math.cos(half), 0, math.sin(half), 0)


@pytest.mark.parametrize("method", ["lossless", "implicit", "explicit"])
def test_a_raised_turning_stiffness_lets_the_handle_slip(
    run: Callable[..., Any], method: str
) -> None:
    commands = {250: Couple(2000.0, 0.8, 3.0, 4e-4)}
    _, path, _ = run(commands, 0.85, ANVIL, turned, method=method)
    recording = read_recording(path)
    both = recording.ticks["handle_quaternion"], recording.ticks["tool_quaternion"]
    angle = 2 * np.arccos(np.minimum(np.sum(both[0] * both[1], axis=1), 1.0))
    # from 2 to 3 N m/rad in equal steps, in which the spring never gains energy
    stiffness = 2.0 + np.arange(STEPS + 1) / STEPS
    assert np.diff(0.5 * stiffness * angle[249 : 250 + STEPS] ** 2).max() <= 1e-9
    assert most_given(path) <= NOTHING
    event = next(e for e in recording.events if e["event"] == "coupling")
    assert event["rotational_stiffness"] == 3.0
    report = audit(path)
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")
    assert "K_r = 3 N m/rad" in report.coupling_sentences[-1]
    # the torque in the end is that of the new spring
    assert recording.ticks["wrench_on_tool"][-1, 4] == pytest.approx(3.0 * angle[-1], rel=0.02)


def test_a_change_of_the_one_kind_of_gains_leaves_the_other(run: Callable[..., Any]) -> None:
    commands = {60: Couple(1000.0, 1.0, 1.0, 1e-3), 620: Couple(1500.0, 1.0)}
    _, path, _ = run(commands, 1.3)
    told = [e for e in read_recording(path).events if e["event"] == "coupling"]
    assert [e["rotational_stiffness"] for e in told] == [1.0, 1.0]
    assert told[0]["rotational_damping"] == told[1]["rotational_damping"]
    assert audit(path).resimulation == "bit for bit"


FREE = Limits(force=10.0, torque=0.5, ramp=0.05, energy=math.inf)


def rubbed_and(
    tick: int, rub: tuple[float, float], then: tuple[float, float, float, float]
) -> float:
    """A swing of a size and a rate until 2 s, then a size from a tick on, that rises and falls.

    No speed jumps: a hand that is stronger than any force, as this one, does not answer the force,
    and fast motion without such an answer is what a late device shows.
    """
    if tick < 2000:
        swing = smooth(min((tick - 100) / 200, (2000 - tick) / 200))
        return rub[0] * swing * math.sin(rub[1] * tick)
    size, begin, rise, fall = then
    return size * smooth(min((tick - begin) / rise, (3800 - tick) / fall))


def smooth(share: float) -> float:
    """Returns a step from 0 to 1 that begins and ends without a jump of the acceleration."""
    x = min(max(share, 0.0), 1.0)
    return x**3 * (10.0 - 15.0 * x + 6.0 * x * x)


def rubbed_and_pressed(tick: int) -> tuple[float, ...]:
    """Moved to and fro against the coupling's damper until 2 s, then 40 mm aside and back."""
    return (rubbed_and(tick, (0.04, 0.02), (0.04, 2500, 400, 400)), 0, 0, 1, 0, 0, 0)


def pressed_in(tick: int) -> tuple[float, ...]:
    """Moved 40 mm aside at 2.5 s and back."""
    return (rubbed_and(tick, (0.0, 0.0), (0.04, 2500, 400, 400)), 0, 0, 1, 0, 0, 0)


def rubbed_and_turned(tick: int) -> tuple[float, ...]:
    """Turned to and fro until 2 s, then by half a radian and back."""
    angle = rubbed_and(tick, (0.3, 0.04), (0.5, 2500, 400, 400))
    return (0, 0, 0, math.cos(angle / 2), 0, math.sin(angle / 2), 0)


def rubbed_and_pushed(tick: int) -> tuple[float, ...]:
    """Moved to and fro until 2 s, then 40 mm into the spring and back."""
    return (rubbed_and(tick, (0.02, 0.04), (0.04, 2200, 300, 600)), 0, 0, 1, 0, 0, 0)


SPRING = """<mujoco>
  <option timestep="0.001" integrator="discrete" gravity="0 0 0"/>
  <worldbody>
    <body name="tool">
      <joint name="rail" type="slide" axis="1 0 0" stiffness="250"/>
      <geom size="0.01" mass="0.05"/>
      <site name="grip"/>
    </body>
  </worldbody>
</mujoco>"""


OF_A_SPRING: dict[str, Any] = {"scene": SPRING, "pose": rubbed_and_pushed}
OF_AN_ANVIL: dict[str, Any] = {
    "scene": ANVIL,
    "pose": rubbed_and_pressed,
    "method": "implicit",
    "coupling": Coupling(2000.0, 0.9, 2.0, 5e-4),
}
TURNED = {"pose": rubbed_and_turned, "coupling": Coupling(2000.0, 0.5, 2.0, 9e-4)}
COMMANDED: tuple[tuple[dict[str, Any], dict[int, Command]], ...] = (
    # pressed in at 200 N/m, let out at 3000 N/m
    (OF_AN_ANVIL, {1900: Couple(200.0, 0.0), 2900: Couple(3000.0, 0.0)}),
    # turned in at 0.2 N m/rad, let out at 3 N m/rad
    (
        OF_AN_ANVIL | TURNED,
        {1900: Couple(2000.0, 0.5, 0.2, 0.0), 2900: Couple(2000.0, 0.5, 3.0, 0.0)},
    ),
    # a spring of the scene pushed in while nothing is felt
    (OF_A_SPRING, {1000: Switch(force=False), 2700: Switch(force=True)}),
    (OF_A_SPRING, {2600: Switch(force=False), 2700: Switch(force=True)}),
    # 40 mm at 2000 N/m and 10 N: 0.375 J go in and come out
    (OF_AN_ANVIL | {"pose": pressed_in}, {2950: Couple(1990.0, 0.9)}),
)


@pytest.mark.parametrize(("options", "commands"), COMMANDED)
def test_a_command_gives_a_hand_no_energy(
    run: Callable[..., Any], options: dict[str, Any], commands: dict[int, Command]
) -> None:
    _, path, _ = run(commands, 4.0, **options, limits=FREE, controller=None)
    assert most_given(path) <= NOTHING
    report = audit(path)
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")
    if 2950 in commands:
        work = read_recording(path).ticks["device_energy"]
        assert work[-1] - work[2950] == pytest.approx(0.375, rel=0.02)


@pytest.mark.parametrize(
    "commands",
    [
        {600: Switch(force=False), 800: Switch(force=True)},
        {600: Switch(clutch=True), 800: Switch(clutch=False)},
    ],
)
def test_a_hand_that_lets_go_by_command_moves_no_handle_and_feels_nothing(
    run: Callable[..., Any], commands: dict[int, Command]
) -> None:
    _, path, _ = run(commands, 1.0)
    ticks = read_recording(path).ticks
    assert np.abs(ticks["wrench_on_device"][:600]).max() > 0.1
    assert not ticks["wrench_on_device"][621:800].any()
    assert np.ptp(ticks["handle_position"][650:800], axis=0).max() < 1e-4
    assert np.ptp(ticks["device_position"][600:800], axis=0).max() > 5e-3
    assert (ticks["lever"][821:] == 1.0).all()
    assert audit(path).verdict == "passive"


def test_a_reset_puts_the_scene_back_and_books_what_that_takes(run: Callable[..., Any]) -> None:
    _, path, _ = run({600: Reset()}, 0.8)
    ticks = read_recording(path).ticks
    # 20 ms to fade, then the jump; within a tick the ball falls by 1e-6 m
    np.testing.assert_allclose(ticks["tool_position"][621], [0, 0, 0.03], atol=1e-5)
    assert np.linalg.norm(ticks["tool_position"][620] - [0, 0, 0.03]) > 5e-3
    assert not ticks["wrench_on_device"][620].any()
    stored = ticks["kinetic"] + ticks["potential"]
    jump = ticks["external_work"][621] - ticks["external_work"][620]
    assert jump == pytest.approx(stored[621] - stored[620], abs=1e-6)
    np.testing.assert_allclose(np.abs(ticks["external_work"][:621]).max(), 0, atol=1e-15)
    # the hand goes on from where it was without a blow
    change = np.linalg.norm(np.diff(ticks["wrench_on_device"][620:700, :3], axis=0), axis=1)
    assert change.max() < 0.5
    assert audit(path).verdict == "passive"


def test_a_run_refuses_what_its_device_does_not_bear(run: Callable[..., Any]) -> None:
    with pytest.raises(CommandError, match="and this one has 2"):
        run({10: Couple(4100.0, 0.0)}, 0.1)


def test_a_mark_is_an_event_and_changes_nothing_else(run: Callable[..., Any]) -> None:
    _, path, _ = run({}, 0.2)
    before = read_recording(path).ticks
    _, path, _ = run({70: Mark()}, 0.2)
    recording = read_recording(path)
    [mark] = [event for event in recording.events if event["event"] == "mark"]
    assert (mark["tick"], mark["by"], mark["time_ns"]) == (70, "test", 71_000_000)
    assert recording.ticks.tobytes() == before.tobytes()
    assert audit(path).resimulation == "bit for bit"


def pressed(tick: int) -> int:
    """Button 2 before the first tick, and in ticks 30 to 39 and 50; button 0 all the time."""
    return 0b1 | (tick < 5 or 30 <= tick < 40 or tick == 50) << 2


def test_each_press_of_the_button_marks_the_recording_once(tmp_path: Path) -> None:
    file, path = tmp_path / "scene.xml", tmp_path / "run.mcap"
    file.write_text(FLOOR)
    device = ScriptedDevice(swaying, buttons=pressed)
    recorded(path, str(file), device, LOOSE, duration=0.1, mark=2)
    recording = read_recording(path)
    marks = [event for event in recording.events if event["event"] == "mark"]
    assert [(event["tick"], event["by"]) for event in marks] == [(30, "button"), (50, "button")]
    assert recording.ticks["buttons"][30] == 0b101
    report = audit(path)
    assert report.events["mark"] == 2
    assert report.resimulation == "bit for bit"


def test_a_run_that_is_not_recorded_cannot_be_marked(tmp_path: Path) -> None:
    file = tmp_path / "scene.xml"
    file.write_text(FLOOR)
    with Bridge(str(file), ScriptedDevice(swaying), LOOSE, clock=SimulatedClock()) as bridge:
        with pytest.raises(CommandError, match="not recorded"):
            bridge.command(Mark())
        bridge.command(Switch(force=False))
        assert bridge.run(0.05).ticks == 50


def random_commands(rng: random.Random) -> dict[int, Command]:
    """Returns commands at random ticks of a run of 0.9 s."""
    kinds: tuple[Callable[[], Command], ...] = (
        Reset,
        Reset,
        lambda: Couple(rng.uniform(300.0, 3000.0), rng.uniform(0.1, 1.0)),
        lambda: Switch(force=rng.random() < 0.5),
        lambda: Switch(clutch=rng.random() < 0.5),
    )
    return {rng.randint(1, 800): rng.choice(kinds)() for _ in range(rng.randint(1, 8))}


@pytest.mark.parametrize("seed", range(16))
def test_commands_at_random_are_repeated_bit_for_bit(run: Callable[..., Any], seed: int) -> None:
    # of 150 seeds 14 were invalid while a reset left the handle's origin where it was: with the
    # hand at rest the handle jumped back once the force had risen
    rng = random.Random(seed)
    rests_from = rng.choice([0, 100, 300, 900])
    options = {
        "method": rng.choice(["lossless", "implicit", "compensated"]),
        "pipelined": rng.random() < 0.3,
    }
    if rng.random() < 0.3:
        options["scene_rate"] = 250.0
    script = Script(random_commands(rng), is_refused=True)
    _, path, _ = run({}, 0.9, pose=lambda k: swaying(min(k, rests_from)), on_tick=script, **options)
    report = audit(path)
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")


def test_a_reset_under_a_hand_at_rest_does_not_throw_it(run: Callable[..., Any]) -> None:
    _, path, _ = run({200: Reset()}, 0.9, pose=lambda k: swaying(min(k, 100)))
    ticks = read_recording(path).ticks
    (reset,) = (e["tick"] for e in read_recording(path).events if e["event"] == "reset")
    assert not np.ptp(ticks["handle_position"][reset:], axis=0).any()
    assert ticks["lever"][-1] == 1.0


GIVEN: dict[int, tuple[Command, bool]] = {
    10: (Switch(force=False), True),
    59: (Switch(force=True), False),
    61: (Reset(), True),
    120: (Switch(force=True), True),
    1060: (Reset(), False),
    1062: (Reset(), True),
}
"""Commands by tick of 1 ms, and whether they are taken: 50 ms after any, 1 s after a reset."""


def test_commands_are_limited_by_the_clock_of_the_run() -> None:
    """A fast run refuses and takes the same commands every time, however fast it goes."""
    answers: dict[int, bool] = {}
    with Bridge("point_mass", clock=SimulatedClock()) as bridge:

        def give(tick: int) -> None:
            if tick in GIVEN:
                try:
                    bridge.command(GIVEN[tick][0])
                    answers[tick] = True
                except CommandError as error:
                    assert "too recent" in str(error)
                    answers[tick] = False

        bridge.run(duration=1.2, on_tick=give)
    assert answers == {tick: is_taken for tick, (_, is_taken) in GIVEN.items()}
