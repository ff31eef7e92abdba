"""A large twist behind a torque that acts late: directed hands gain nothing, by their own ledger.

Each fault is seen, too: with the handle let through half a turn, or with the energy that the spring
of a shown tool loses, whatever its torque does.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path as Files
from typing import Any

import mujoco
import numpy as np
import pytest
from directed_hand import BEGIN, DirectedDevice, Path, most_created, trembles, wobbles
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hapticbridge.audit import audit
from hapticbridge.clock import SimulatedClock
from hapticbridge.coupling import Coupling
from hapticbridge.demand.guard import Limits
from hapticbridge.demand.methods import method_named
from hapticbridge.errors import SafetyTrip
from hapticbridge.kernel.parameters import LARGEST_TWIST
from hapticbridge.kernel.record import POST_DTYPE
from hapticbridge.run.bridge import Bridge
from hapticbridge.run.endpoint import posted_scene, program_options
from hapticbridge.run.options import BridgeOptions
from hapticbridge.scene import load_scene
from hapticbridge.theory.bounds import minimum_damping

T, STIFFNESS, TICKS = 1e-3, 1.0, 700
LIMITS = Limits(energy=math.inf, stretch=math.inf, angle=math.inf)

NOTHING = 1e-6
"""Energy in J from rounding."""

TOOL = """<mujoco>
  <option gravity="0 0 0"/>
  <worldbody>
    <body name="tool">
      <joint type="hinge" axis="0 0 1"/>
      <inertial pos="0 0 0" mass="0.05" diaginertia="{inertia} {inertia} {inertia}"/>
      <site name="grip"/>
    </body>
  </worldbody>
  <keyframe><key name="home" qvel="{speed}"/></keyframe>
</mujoco>"""
"""A tool that turns about the axis of the twists."""

Change = Callable[[NDArray[np.void]], None]


def passes_half_a_turn(state: NDArray[np.void]) -> None:
    """Takes hand and delay from the kernel's sight, so that the handle does not slip."""
    state["guard"]["has_hand"] = state["timing"]["device_delay_ns"] = 0


def held(path: Path, late: float, stated: float, ratio: float = 0.0) -> tuple[Any, Coupling]:
    """Returns a device that bears K_r and B'_r = ``ratio`` K_r T, ``late`` ticks or less."""
    whole = math.ceil(late)
    one = Coupling(1.0, ratio * T, 0.0, 0.0)
    b = STIFFNESS * minimum_damping(one, T, delay=whole)
    device = DirectedDevice(path, b, late, delay=stated * T)
    return device, Coupling(100.0, 0.0, STIFFNESS, ratio * STIFFNESS * T)


def in_scene(
    path: Path,
    late: float,
    *,
    method: str = "implicit",
    change: Change | None = None,
    inertia: float = 1e6,
    speed: float = 0.0,
    scene_ticks: int = 1,
) -> float:
    """Returns the energy in J that came from nowhere in a scene of the bridge's own."""
    device, law = held(path, late, math.ceil(late))
    scene = load_scene(mujoco.MjSpec.from_string(TOOL.format(inertia=inertia, speed=speed)))
    law = method_named(method).requested_coupling(law, T * scene_ticks)
    options: dict[str, Any] = {"scene_rate": 1.0 / (scene_ticks * T)} if scene_ticks > 1 else {}
    options |= {"limits": LIMITS, "controller": "off", "method": method}
    with Bridge(scene, device, law, clock=SimulatedClock(), rate=1.0 / T, **options) as bridge:
        state = bridge.session.kernel.state
        state["guard"]["max_turn_speed"] = math.inf
        if change is not None:
            change(state)
        bridge.run(TICKS * T)
        rows = bridge.latest_records(TICKS)
    stored = rows["kinetic"] + rows["potential"]
    return most_created(device, rows, STIFFNESS, stored)


@pytest.mark.parametrize("scene_ticks", [1, 10])
@pytest.mark.parametrize(("late", "ticks"), [(1.0, 1), (2.0, 2)])
def test_a_hand_that_trembles_across_half_a_turn_gains_nothing(
    late: float, ticks: int, scene_ticks: int
) -> None:
    hand = trembles(math.pi, 0.05, ticks)
    for method in ("implicit", "lossless"):
        how: dict[str, Any] = {"method": method, "scene_ticks": scene_ticks}
        assert in_scene(hand, late, **how) < NOTHING
        assert in_scene(hand, late, **how, change=passes_half_a_turn) > 10.0


def crosses(step: float) -> Path:
    """A hand that goes to and fro from ``LARGEST_TWIST`` on, by ``step`` rad in every tick."""

    def place(tick: NDArray[np.float64]) -> NDArray[np.float64]:
        away = np.where((tick > BEGIN) & ((tick - BEGIN) % 2 == 1.0), step, 0.0)
        return LARGEST_TWIST * np.clip(tick / BEGIN, 0.0, 1.0) + away

    def path(time: NDArray[np.float64]) -> Rotation:
        tick = np.floor(time)
        way = place(tick) + (time - tick) * (place(tick + 1.0) - place(tick))
        return Rotation.from_rotvec(np.outer(way, (0.0, 0.0, 1.0)))

    return path


@pytest.mark.parametrize("scene_ticks", [1, 10])
@pytest.mark.parametrize("step", [0.66, 0.8, 1.15])
def test_a_hand_that_turns_across_half_a_turn_in_a_tick_gains_nothing(
    step: float, scene_ticks: int
) -> None:
    """The guard lets it turn so fast below 470 Hz. It had 112 to 381 J from nowhere."""
    assert in_scene(crosses(step), 1.0, scene_ticks=scene_ticks) < NOTHING


@pytest.mark.parametrize("method", ["lossless", "implicit"])
@pytest.mark.parametrize(("inertia", "speed"), [(1e-2, 50.0), (5e-4, 1000.0), (1e-4, 900.0)])
def test_a_tool_that_spins_gains_nothing_at_half_a_turn(
    method: str, inertia: float, speed: float
) -> None:
    """It is across within a step, before the handle slips; it had 1 to 4 J from nowhere."""
    still = trembles(0.0, 0.0, 1)
    assert in_scene(still, 0.0, method=method, inertia=inertia, speed=speed) < NOTHING


@pytest.mark.parametrize("method", ["lossless", "implicit"])
def test_a_run_with_a_tool_that_spins_across_half_a_turn_is_certified(
    method: str, tmp_path: Files
) -> None:
    """It was told that it had not kept its time, in simulated time."""
    scene = load_scene(mujoco.MjSpec.from_string(TOOL.format(inertia=5e-4, speed=1000.0)))
    law, path = {"rotational_stiffness": STIFFNESS}, tmp_path / "run.mcap"
    options: dict[str, Any] = {"limits": LIMITS, "method": method, "recording": path}
    with Bridge(scene, "simulated:hand=none", law, clock=SimulatedClock(), **options) as bridge:
        bridge.run(0.2)
        rows = bridge.latest_records(200)
    turned = Rotation.from_quat(rows["tool_quaternion"], scalar_first=True).as_rotvec()[:, 2]
    assert np.ptp(np.unwrap(turned)) > 150.0
    report = audit(path, in_process=True)
    assert (report.verdict, report.certified) == ("passive", True), report.reason


def test_the_angle_limit_sees_a_turn_across_half_a_turn() -> None:
    """At 1.2 rad a tick it is 3.6 rad away in the third, and 2.7 rad on the other side."""
    scene = load_scene(mujoco.MjSpec.from_string(TOOL.format(inertia=1.0, speed=1200.0)))
    limits, law = replace(LIMITS, angle=2.8), {"rotational_stiffness": STIFFNESS}
    clock = SimulatedClock()
    with (
        pytest.raises(SafetyTrip, match=r"tick 3: the tool is turned .* more than the angle limit"),
        Bridge(scene, "simulated:hand=none", law, clock=clock, limits=limits) as bridge,
    ):
        bridge.run(0.02)


# A tool that another program shows

CREDIT = 1.0

Program = Callable[[int], tuple[Rotation, NDArray[np.float64]]]
"""Orientation and angular velocity in rad/s of the tool in a tick."""


def before_program(
    path: Path,
    program: Program,
    late: float,
    *,
    stated: float = 0.0,
    ratio: float = 0.0,
    change: Change | None = None,
) -> float:
    """Returns the energy in J that came from nowhere in front of another program."""
    device, law = held(path, late, stated, ratio)
    options = program_options(BridgeOptions(limits=LIMITS, controller="off"))

    def shows(tick: int) -> None:
        post, (tool, velocity) = np.zeros(1, POST_DTYPE), program(tick)
        post["pose"][0, 3:], post["has_velocity"] = tool.as_quat(scalar_first=True), 1
        post["velocity"][0, 3:] = velocity
        assert bridge.session.posted is not None
        bridge.session.posted.post(post)

    clock = SimulatedClock()
    with Bridge(posted_scene(CREDIT), device, law, options, clock=clock) as bridge:
        state = bridge.session.kernel.state
        state["guard"]["max_turn_speed"] = math.inf
        if change is not None:
            change(state)
        bridge.run(TICKS * T, shows)
        rows = bridge.latest_records(TICKS)
    twist = Rotation.from_quat(rows["tool_quaternion"], scalar_first=True).inv()
    twist = twist * Rotation.from_quat(rows["handle_quaternion"], scalar_first=True)
    if change is None:
        assert twist.magnitude().max() <= LARGEST_TWIST + 1e-9
    return most_created(device, rows, STIFFNESS, rows["scene_tank"])


def follows(size: float, speed: float, phase: float) -> Program:
    """A tool on a circle of ``size`` rad, from where it does not turn on by itself."""

    def program(tick: int) -> tuple[Rotation, NDArray[np.float64]]:
        radius = size * min(max((tick - BEGIN) / 100.0, 0.0), 1.0)
        angle = speed * (tick - BEGIN) + phase
        across = radius * math.cos(angle), radius * math.sin(angle), 0.0
        return Rotation.from_rotvec(across), np.zeros(3)

    return program


def gives_what_the_spring_loses(state: NDArray[np.void]) -> None:
    """Counts a tool's motion as in time, and lets the handle turn as far as it likes."""
    state["shown"]["is_posted"] = state["coupling"]["late_ticks"] = 0
    passes_half_a_turn(state)


def comes_at_once(state: NDArray[np.void]) -> None:
    """Lets the springs pay for no torque that another program's tool has turned away from."""
    state["coupling"]["late_ticks"] = 0


JUMPS = [
    (2.8, 0.05, -0.99, 5.58, -0.3, 0.0, gives_what_the_spring_loses),
    (2.823, 0.1416, -1.951, 3.766, -1.812, 0.0, gives_what_the_spring_loses),
    (2.504, 0.0773, -0.83, 2.155, 0.277, 0.0, gives_what_the_spring_loses),
    (2.465, 0.0679, -1.381, 4.677, 2.723, 0.5, comes_at_once),
]
"""Hands and tools that were found to gain: twist in rad, size of the hand's circle in rad, rad of
it in a tick, size of the tool's circle in the hand's, its phase in rad, B'_r/K_r T, and where."""


@pytest.mark.parametrize(("twist", "size", "speed", "more", "phase", "ratio", "change"), JUMPS)
def test_a_hand_and_a_tool_that_wobble_about_a_large_twist_gain_nothing(
    twist: float, size: float, speed: float, more: float, phase: float, ratio: float, change: Change
) -> None:
    """The tool's jumps turn a late torque by more than its spring gives for them."""
    hand, tool = wobbles(twist, size, speed), follows(more * size, speed, phase)
    assert before_program(hand, tool, 0.95, ratio=ratio) < NOTHING
    assert before_program(hand, tool, 1.0, stated=1.0, ratio=ratio) < NOTHING
    assert before_program(hand, tool, 0.95, ratio=ratio, change=change) > 0.1


def test_a_tool_that_jumps_across_half_a_turn_gives_nothing() -> None:
    """It spins by 1.1 rad in a tick and back, and a hand trembles with it."""
    twist = 2.6
    hand = trembles(twist, 0.02, 1)

    def jumps(tick: int) -> tuple[Rotation, NDArray[np.float64]]:
        return Rotation.from_rotvec((0.0, 0.0, (tick % 2) * 2.0 * (twist - math.pi))), np.zeros(3)

    assert before_program(hand, jumps, 0.95) < NOTHING
    assert before_program(hand, jumps, 1.0, stated=1.0) < NOTHING
    assert before_program(hand, jumps, 0.95, change=gives_what_the_spring_loses) > 1.0
