"""Every scene in random hands of 3 cm and 45 degrees, and in the hand that it asks for."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from model_runs import BOTTOMED_HEIGHT, HOME_HEIGHT, MODELS, Array
from random_hands import T, random_motion, shaken, smooth

import hapticbridge as hb
from hapticbridge.device import DEFAULT_HAND, Hand, Motion, SimulatedDevice, device_for, scene_hand
from hapticbridge.errors import SceneError
from hapticbridge.lab.closed_loop import ClosedLoop, LoopOutcome
from hapticbridge.record import TickFlag
from hapticbridge.scene import (
    Parameter,
    plain_model,
    read_scene,
    scene_names,
    scene_parameters,
    scene_path,
)

FORCE_LIMIT, TORQUE_LIMIT = 10.0, 0.5  # N and N m, of the default simulated device

HANDS: list[tuple[str, dict[str, float], float, int]] = [
    ("point_mass", {}, 0.0, 0),
    ("virtual_wall", {}, 0.0, 800),
    ("planar_peg", {}, 0.0, 800),
    ("planar_peg", {}, -0.045, 12000),
    ("planar_peg", {"length": 0.04}, -0.025, 12000),
    ("planar_peg", {"length": 0.2}, -0.185, 12000),
    ("peg_in_hole", {}, 0.0, 800),
    ("peg_in_hole", {}, -0.045, 12000),
    ("round_peg", {}, 0.0, 800),
    ("round_peg", {}, -0.045, 12000),
    ("drawer", {}, 0.0, 200),  # its friction holds it most times
    ("hammer", {}, 0.0, 400),
    ("open_wrench", {}, 0.0, 12000),
    ("ratchet", {}, 0.0, 12000),
    ("pliers", {}, 0.0, 800),
    ("lock", {}, 0.0, 800),
    ("screwdriver", {}, -0.002, 12000),
    ("hex_key", {}, -0.002, 12000),
]
"""Scene, parameters, by how much the hand goes up in m before it is random (into the hole, or to
press a tool that starts seated), and how many ticks of the eight runs there is a contact at least:
otherwise nothing was tried."""


FIRST = {"round_peg": -0.045, "screwdriver": -1e-3, "hex_key": -1e-3}
"""By how much a hand goes up in m before it is random, in scenes that a strong hand shakes."""

TOWARDS = {"pliers": [0.0, -0.02, 0.0], "lock": [-0.02, 0.0, 0.0]}
"""Where the hand goes while it is random, in m: onto the wire, into the keyway."""

SEED = {"drawer": 8}
"""First of the eight random hands; most hands are too weak for the drawer's friction."""

STRONG = Hand(stiffness=1000.0, damping=20.0, rotational_stiffness=3.0)

PARAMETERS = [
    (name, parameter)
    for name in sorted({hand[0] for hand in HANDS})
    for parameter in scene_parameters(scene_path(name))
]


def run_of(loop: ClosedLoop, seed: int, first: float) -> LoopOutcome:
    """Shakes a scene and checks what holds for every scene in every hand."""
    outcome = shaken(loop, random_motion(seed, first=first))
    assert outcome.ticks == 5000
    assert outcome.environment in {"strict", "within slack"}, f"seed {seed}: {outcome}"
    assert outcome.fault is None, f"seed {seed}: {outcome}"
    assert outcome.peak_force < FORCE_LIMIT
    for field, limit in (("wrench_on_tool", 1e3), ("tool_position", 1.0)):
        assert np.abs(outcome.records[field]).max() < limit
    assert not any(warning.number for warning in loop.scene.data.warning)
    return outcome


def norms(wrenches: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the norms of the forces and of the torques."""
    return np.linalg.norm(wrenches[:, :3], axis=1), np.linalg.norm(wrenches[:, 3:], axis=1)


@pytest.mark.parametrize(("name", "values", "first", "least"), HANDS, ids=str)
def test_hands_leave_it_whole(
    name: str, values: dict[str, float], first: float, least: int
) -> None:
    loop = ClosedLoop(hb.load_scene(name, "grip", **values))
    contacts, strongest, worst = 0, -1.0, 0
    begin = SEED.get(name, 0)
    for seed in range(begin, begin + 8):
        records = run_of(loop, seed, first).records
        contacts += int(np.count_nonzero(records["flags"] & TickFlag.CONTACT))
        twist = float(norms(records["wrench_on_tool"])[1].max())
        if twist > strongest:
            strongest, worst = twist, seed
    assert contacts >= least
    # a hand that turns by 45 degrees twists some grips by more than the device can: it saturates
    sent, flags = within_limits(name, values, random_motion(worst, first=first))
    is_saturated = bool((flags & TickFlag.FORCE_LIMITED).any())
    assert is_saturated == (strongest > 1.02 * TORQUE_LIMIT), strongest
    if is_saturated:
        assert norms(sent)[1].max() == pytest.approx(TORQUE_LIMIT, rel=1e-9)


def within_limits(
    name: str, values: dict[str, float], motion: Motion
) -> tuple[np.ndarray, np.ndarray]:
    """Runs the bridge as its user does; returns what it sent, shape (n, 6), and its flags."""
    device = SimulatedDevice(path=motion)
    with hb.Bridge(
        hb.load_scene(name, "grip", **values), device, clock=hb.SimulatedClock()
    ) as bridge:
        summary = bridge.run(duration=motion.duration)
        rows = bridge.latest_records(round(motion.duration / T))
    assert summary.verdict == "passive"
    sent, flags = rows["wrench_on_device"], rows["flags"]
    force, torque = norms(sent)
    assert force.max() <= FORCE_LIMIT * (1 + 1e-12)
    assert torque.max() <= TORQUE_LIMIT * (1 + 1e-12)
    # the flag is up where, and only where, the coupling asked for more
    asked = norms(rows["wrench_on_tool"])
    is_beyond = (asked[0] > FORCE_LIMIT) | (asked[1] > TORQUE_LIMIT)
    assert np.array_equal((flags & TickFlag.FORCE_LIMITED) != 0, is_beyond)
    # and where it did not, after the ramp, the device got what the coupling said
    is_whole = ~is_beyond & ((flags & TickFlag.RAMPING) == 0)
    assert np.array_equal(sent[is_whole], -rows["wrench_on_tool"][is_whole])
    return sent, flags


@pytest.mark.parametrize(
    ("name", "parameter"), PARAMETERS, ids=[f"{name} {p.name}" for name, p in PARAMETERS]
)
def test_both_ends_of_a_parameter_are_passive_in_any_hand(name: str, parameter: Parameter) -> None:
    used = 0
    for value in (parameter.minimum, parameter.maximum):
        loop = ClosedLoop(hb.load_scene(name, "grip", **{parameter.name: value}))
        for seed in (0, 7):
            rows = random_motion(seed, first=FIRST.get(name, 0.0)).table
            towards = smooth(rows[:, :1]) * np.array(TOWARDS.get(name, [0.0, 0.0, 0.0]))
            motion = Motion(rows[:, 0], rows[:, 1:4] + towards, rows[:, 4:])
            outcome = shaken(loop, motion, STRONG if name in FIRST else None)
            assert (outcome.fault, outcome.ticks) == (None, 5000), f"seed {seed}: {outcome}"
            assert outcome.environment in {"strict", "within slack"}
            assert outcome.peak_force < FORCE_LIMIT or name in FIRST
            assert not any(warning.number for warning in loop.scene.data.warning)
            used += int(
                np.count_nonzero(outcome.records["contacts"] > (3 if name == "lock" else 0))
            )
    assert used > (300 if name in {*FIRST, *TOWARDS} else -1)


@dataclass(frozen=True)
class Done:
    """What a scene did on its own path: its joints and contacts tick by tick, and how it ended."""

    joints: Array
    contacts: Array
    sent: Array
    summary: hb.Summary
    warnings: int


@functools.cache
def default_run(name: str) -> Done:
    joints: list[Array] = []
    contacts: list[int] = []

    def look(_tick: int) -> None:
        joints.append(bridge.scene.data.qpos.copy())
        contacts.append(bridge.scene.data.ncon)

    with hb.Bridge(name, "simulated", clock=hb.SimulatedClock()) as bridge:
        summary = bridge.run(on_tick=look)
        sent = bridge.latest_records(summary.ticks)["wrench_on_device"]
        warnings = sum(warning.number for warning in bridge.scene.data.warning)
    return Done(np.array(joints), np.array(contacts), sent, summary, warnings)


@pytest.mark.parametrize("name", scene_names())
def test_default_run_is_passive_and_sends_what_the_device_can(name: str) -> None:
    done = default_run(name)
    assert done.summary.ticks == len(done.joints) == 8001
    assert done.summary.environment == "strict"
    assert done.summary.is_certified
    assert done.warnings == 0
    assert np.linalg.norm(done.sent[:, :3], axis=1).max() < FORCE_LIMIT
    # 0.5 N m is where the device is saturated: none is, on its own path
    assert np.linalg.norm(done.sent[:, 3:], axis=1).max() < 0.9 * TORQUE_LIMIT


def point_mass(done: Done) -> None:
    assert np.ptp(done.joints[:, :2], axis=0) == pytest.approx([0.08, 0.04], abs=0.01)
    assert 2 * np.degrees(np.arccos(done.joints[:, 3].min())) > 35.0


def virtual_wall(done: Done) -> None:
    assert (done.contacts[2400:3300] == 1).all()
    away = done.joints[4200:7000, 0] < 0.009
    assert np.count_nonzero(~away[1:] & away[:-1]) == 3
    assert done.contacts[4200:7000].any()


def peg_in_hole(done: Done) -> None:
    height = done.joints[:, 2]
    assert height.min() == pytest.approx(BOTTOMED_HEIGHT, abs=5e-5)
    assert height[6480:6600] == pytest.approx(BOTTOMED_HEIGHT, abs=0.3e-3)
    assert height[-1] == pytest.approx(HOME_HEIGHT, abs=1e-3)


def planar_peg(done: Done) -> None:
    assert done.joints[:, 1].min() == pytest.approx(BOTTOMED_HEIGHT - HOME_HEIGHT, abs=5e-5)
    assert done.joints[-1] == pytest.approx([0.0, 0.0, 0.0], abs=1e-3)


def drawer(done: Done) -> None:
    opening = done.joints[:, 0]
    assert opening[3800:4300] == pytest.approx(0.2, abs=1e-4)
    assert (done.contacts[3900:4400] > 0).all()
    assert opening[-1] == pytest.approx(-0.001, abs=1e-4)
    assert (done.contacts[6600:6800] > 0).all()


def hammer(done: Done) -> None:
    depth = -done.joints[:, 0]
    assert depth[-1] == pytest.approx(7.2e-3, abs=0.4e-3)
    # seven blows, half a second or more apart, each takes it on by 0.5 mm or more
    assert np.count_nonzero(np.diff(depth[200::800]) > 0.5e-3) == 7


def open_wrench(done: Done) -> None:
    nut, _, x, y, angle = done.joints.T
    assert np.degrees(nut[-1]) == pytest.approx(60.0, abs=2.0)
    assert (np.hypot(x, y)[3700:5200] > 0.02).all()
    assert (np.hypot(x, y)[-1], angle[-1]) == pytest.approx((0.0, 0.0), abs=2e-4)


def ratchet(done: Done) -> None:
    gear, _, pawl = done.joints.T
    assert np.count_nonzero((pawl[1:] < 0.06) & (pawl[:-1] >= 0.06)) == 6
    assert np.degrees(gear[0] - gear[-1]) == pytest.approx(88.0, abs=2.0)


def pliers(done: Done) -> None:
    crushed = done.joints[:, 0]
    assert crushed.max() == pytest.approx(0.34e-3, abs=0.03e-3)
    assert crushed[-1] == pytest.approx(crushed.max(), abs=0.06e-3)
    assert done.joints[-1, 1] == pytest.approx(0.0, abs=2e-3)


def lock(done: Done) -> None:
    plug, key = np.degrees(done.joints[:, 0]), done.joints[:, 4]
    assert key[2800:5800] == pytest.approx(0.016, abs=1e-4)
    assert plug[4400:4700] == pytest.approx(90.0, abs=2.0)
    assert abs(plug[-1]) < 0.5
    assert key[-1] == pytest.approx(0.0, abs=0.5e-3)


def screw(done: Done, turn: float) -> None:
    assert np.degrees(done.joints[-1, 1]) == pytest.approx(turn, abs=2.0)
    # the tool is seated again, and was out
    height = done.joints[:, 6] - done.joints[:, 0]
    assert height[-1] == pytest.approx(0.0, abs=0.1e-3)
    assert height.max() > 4e-3


TASKS: dict[str, Callable[[Done], None]] = {
    "point_mass": point_mass,
    "virtual_wall": virtual_wall,
    "planar_peg": planar_peg,
    "peg_in_hole": peg_in_hole,
    "round_peg": peg_in_hole,
    "drawer": drawer,
    "hammer": hammer,
    "open_wrench": open_wrench,
    "ratchet": ratchet,
    "pliers": pliers,
    "lock": lock,
    "screwdriver": functools.partial(screw, turn=180.0),
    "hex_key": functools.partial(screw, turn=120.0),
}


@pytest.mark.parametrize("name", scene_names())
def test_default_run_does_the_task(name: str) -> None:
    TASKS[name](default_run(name))


# --- which hand it is -----------------------------------------------------------------------------


def scene_with_hand(folder: Path, numbers: str | None) -> hb.Scene:
    """Loads a drawer whose file asks for another hand."""
    text = (MODELS / "drawer" / "drawer.xml").read_text(encoding="utf-8")
    asks = '<numeric name="simulated_hand" data="2000 40"/>'
    assert text.count(asks) == 1
    wanted = "" if numbers is None else f'<numeric name="simulated_hand" data="{numbers}"/>'
    file = folder / "drawer.xml"
    file.write_text(text.replace(asks, wanted), encoding="utf-8")
    return hb.load_scene(file)


def hand_of(scene: hb.Scene, spec: str = "simulated") -> object:
    device = device_for(scene, spec)
    assert isinstance(device, SimulatedDevice)
    return device.hand


def test_a_scene_that_asks_for_none_gets_the_default_hand(tmp_path: Path) -> None:
    assert hand_of(scene_with_hand(tmp_path, None)) == DEFAULT_HAND


def test_two_numbers_are_of_translation_and_four_of_both(tmp_path: Path) -> None:
    hand = hand_of(scene_with_hand(tmp_path, "700 12"))
    assert hand == type(DEFAULT_HAND)(stiffness=700.0, damping=12.0)
    hand = hand_of(scene_with_hand(tmp_path, "700 12 3 0.05"))
    assert hand == type(DEFAULT_HAND)(
        stiffness=700.0, damping=12.0, rotational_stiffness=3.0, rotational_damping=0.05
    )


def test_options_go_before_what_the_scene_asks_for(tmp_path: Path) -> None:
    scene = scene_with_hand(tmp_path, "700 12")
    changed = hand_of(scene, "simulated:hand_stiffness=50,friction=0.1")
    assert changed == type(DEFAULT_HAND)(stiffness=50.0, damping=12.0)
    assert hand_of(scene, "simulated:hand=none") is None


@pytest.mark.parametrize(
    ("numbers", "says"),
    [
        *((numbers, "must be stiffness in N/m and damping")
          for numbers in ("1000", "1000 30 3", "1000 30 3 0.05 1")),
        ("-1 30", "hand stiffness = -1"),
        ("1000 nan", "hand damping = nan"),
        ("1000 30 inf 0.05", "hand rotational_stiffness = inf"),
    ],
)  # fmt: skip
def test_numbers_that_are_no_hand_are_refused(numbers: str, says: str, tmp_path: Path) -> None:
    scene = scene_with_hand(tmp_path, numbers)
    with pytest.raises(SceneError, match=says) as refused:
        device_for(scene, "simulated")
    assert "simulated_hand" in str(refused.value)
    # somebody who brings a hand, or no simulated device at all, is not concerned
    assert hand_of(scene, "simulated:hand=none") is None
    device_for(scene, f"trajectory:{MODELS / 'drawer' / 'drawer.csv'}")


def own_hand(name: str) -> Hand:
    return scene_hand(plain_model(read_scene(name)), scene_path(name))


@pytest.mark.parametrize("name", [n for n in scene_names() if own_hand(n) != DEFAULT_HAND])
def test_a_scene_is_passive_in_its_own_hand_at_random(name: str) -> None:
    scene = hb.load_scene(name)
    loop = ClosedLoop(scene)
    for seed in range(4):
        outcome = shaken(loop, random_motion(seed), own_hand(name))
        assert outcome.ticks == 5000
        assert outcome.fault is None, f"seed {seed}: {outcome}"
        assert outcome.environment in {"strict", "within slack"}
