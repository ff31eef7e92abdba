"""Every scene in random hands of 3 cm and 45 degrees, and in the hand that it asks for."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from model_runs import BOTTOMED_HEIGHT, HOME_HEIGHT, LOOP_SCENES, MODELS, Array
from random_hands import T, random_motion, shaken, smooth

import hapticbridge as hb
from hapticbridge import scene as scenes
from hapticbridge.demand.certificate import default_coupling
from hapticbridge.demand.methods import default_method
from hapticbridge.device import DEFAULT_HAND, Hand, Motion, SimulatedDevice, device_for, scene_hand
from hapticbridge.errors import SceneError
from hapticbridge.kernel.record import TickFlag
from hapticbridge.lab.closed_loop import ClosedLoop, LoopOutcome
from hapticbridge.scene import scene_names, scene_path

FORCE_LIMIT, TORQUE_LIMIT = 10.0, 0.5  # N and N m, of the default simulated device

Values = dict[str, float]

HANDS: list[tuple[str, Values, float, int]] = [
    ("point_mass", {}, 0.0, 0),
    ("virtual_wall", {}, 0.0, 800),
    ("planar_peg", {}, 0.0, 400),
    ("planar_peg", {}, -0.045, 7000),
    ("planar_peg", {"length": 0.04}, -0.025, 7000),
    ("planar_peg", {"length": 0.2}, -0.185, 7000),
    ("peg_in_hole", {}, 0.0, 800),
    ("peg_in_hole", {}, -0.045, 7000),
    ("round_peg", {}, 0.0, 800),
    ("round_peg", {}, -0.045, 7000),
    ("drawer", {}, 0.0, 200),  # its friction holds it most times
    ("hammer", {}, 0.0, 400),
    ("open_wrench", {}, 0.0, 6000),
    ("ratchet", {}, 0.0, 7000),
    ("bench_pliers", {}, 0.0, 400),
    ("lock", {}, 0.0, 800),
    ("screwdriver", {}, -0.002, 4000),
    ("hex_key", {}, -0.002, 7000),
]
"""Scene, parameters, by how much the hand goes up in m before it is random (into the hole, or to
press a tool that starts seated), and how many ticks of the two runs there is a contact at least:
otherwise nothing was tried."""


FIRST = {"round_peg": -0.045, "screwdriver": -1e-3, "hex_key": -1e-3}
"""By how much a hand goes up in m before it is random, in scenes that a strong hand shakes."""

TOWARDS = {"bench_pliers": [0.0, -0.02, 0.0], "lock": [-0.02, 0.0, 0.0]}
"""Goal of a random hand in m: onto the wire, into the keyway."""

SEED = {"drawer": 10, "hammer": 0, "bench_pliers": 0}
"""First of the two random hands, else 2: they touch more than others in a scene that starts free,
and are strong enough for the drawer's friction."""

OWN_TICKS = 8001
"""Ticks of the path that a scene brings."""

STRONG = Hand(stiffness=1000.0, damping=20.0, rotational_stiffness=3.0)

PARAMETERS = [
    (name, parameter)
    for name in sorted({hand[0] for hand in HANDS})
    for parameter in scenes.scene_parameters(scene_path(name))
]


def run_of(loop: ClosedLoop, seed: int, first: float) -> LoopOutcome:
    """Shakes a scene and checks what holds for every scene in every hand."""
    outcome = shaken(loop, random_motion(seed, first=first))
    assert outcome.ticks == 5000
    assert outcome.environment == "strict", f"seed {seed}: {outcome}"
    assert outcome.peak_force < FORCE_LIMIT
    for field, limit in (("wrench_on_tool", 1e3), ("tool_position", 1.0)):
        assert np.abs(outcome.records[field]).max() < limit
    assert not any(warning.number for warning in loop.scene.data.warning)
    return outcome


def norms(wrenches: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the norms of the forces and of the torques."""
    return np.linalg.norm(wrenches[:, :3], axis=1), np.linalg.norm(wrenches[:, 3:], axis=1)


@pytest.mark.parametrize(("name", "values", "first", "least"), HANDS, ids=str)
def test_hands_leave_it_whole(name: str, values: Values, first: float, least: int) -> None:
    loop = ClosedLoop(hb.load_scene(name, "grip", as_is=False, **values))
    contacts, strongest, worst = 0, -1.0, 0
    begin = SEED.get(name, 2)
    for seed in range(begin, begin + 2):
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


def within_limits(name: str, values: Values, motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """Runs the bridge as its user does; returns what it sent, shape (n, 6), and its flags."""
    device = SimulatedDevice(path=motion)
    scene = hb.load_scene(name, "grip", as_is=False, **values)
    with hb.Bridge(scene, device, clock=hb.SimulatedClock()) as bridge:
        summary = bridge.run(duration=motion.duration)
        rows = bridge.latest_records(round(motion.duration / T))
    assert summary.verdict == "passive"
    sent, flags = rows["wrench_on_device"], rows["flags"]
    force, torque = norms(sent)
    assert force.max() <= FORCE_LIMIT * (1 + 1e-12)
    assert torque.max() <= TORQUE_LIMIT * (1 + 1e-12)
    # tool and device get the same, and the flag is up where that is the limit
    assert np.array_equal(sent, -rows["wrench_on_tool"])
    share = np.maximum(force / FORCE_LIMIT, torque / TORQUE_LIMIT)
    assert share[(flags & TickFlag.FORCE_LIMITED) != 0].min(initial=1.0) > 1 - 1e-9
    return sent, flags


@pytest.mark.parametrize(
    ("name", "parameter"), PARAMETERS, ids=[f"{name} {p.name}" for name, p in PARAMETERS]
)
def test_both_ends_of_a_parameter_are_strict_in_any_hand(
    name: str, parameter: scenes.Parameter
) -> None:
    used = 0
    for value, seed in ((parameter.minimum, 0), (parameter.maximum, 7)):
        loop = ClosedLoop(hb.load_scene(name, "grip", as_is=False, **{parameter.name: value}))
        rows = random_motion(seed, first=FIRST.get(name, 0.0)).table
        towards = smooth(rows[:, :1]) * np.array(TOWARDS.get(name, [0.0, 0.0, 0.0]))
        motion = Motion(rows[:, 0], rows[:, 1:4] + towards, rows[:, 4:])
        outcome = shaken(loop, motion, STRONG if name in FIRST else None)
        assert (outcome.environment, outcome.ticks) == ("strict", 5000), f"seed {seed}: {outcome}"
        assert outcome.peak_force < FORCE_LIMIT or name in FIRST
        assert not any(warning.number for warning in loop.scene.data.warning)
        touching = outcome.records["contacts"] > (3 if name == "lock" else 0)
        used += int(np.count_nonzero(touching))
        own = device_for(loop.scene, "simulated")
        assert isinstance(own, SimulatedDevice)
        coupling = default_coupling(own.info, T, 1.0, 1.0)
        outcome = loop.run(own, coupling, default_method(), ticks=OWN_TICKS)
        assert (outcome.environment, outcome.ticks) == ("strict", OWN_TICKS)
    assert used > (300 if name in {*FIRST, *TOWARDS} else -1)


@dataclass(frozen=True)
class Done:
    """Run of a scene on its own path: joints and deepest contact by ticks, and its end."""

    joints: Array
    deepest: Array
    recording: Path
    summary: hb.Summary
    warnings: int


Runs = Callable[..., Done]
"""The fixture ``default_run``: it runs a scene on its own path, once for all tests."""


@pytest.fixture(scope="module")
def default_run(tmp_path_factory: pytest.TempPathFactory) -> Runs:
    folder = tmp_path_factory.mktemp("default")

    @functools.cache
    def run(name: str, **values: float) -> Done:
        joints: list[Array] = []
        deepest: list[float] = []
        path = folder / f"{name} {values}.mcap"
        scene = hb.load_scene(name, "grip", as_is=False, **values)
        with hb.Bridge(scene, "simulated", clock=hb.SimulatedClock(), recording=path) as bridge:

            def observe(_: object) -> None:
                joints.append(scene.data.qpos.copy())
                deepest.append(-float(scene.data.contact.dist.min(initial=0.0)))

            summary = bridge.run(on_tick=observe)
            warnings = sum(warning.number for warning in scene.data.warning)
        return Done(np.array(joints), np.array(deepest), path, summary, warnings)

    return run


@pytest.mark.parametrize("name", LOOP_SCENES)
def test_default_run_is_passive_and_sends_what_the_device_can(default_run: Runs, name: str) -> None:
    done = default_run(name)
    assert done.summary.ticks == len(done.joints) == 8001
    assert done.summary.environment == "strict"
    assert done.summary.is_certified
    assert done.warnings == 0
    ticks = hb.read_recording(done.recording).ticks
    sent = ticks["wrench_on_device"]
    assert np.linalg.norm(sent[:, :3], axis=1).max() < FORCE_LIMIT
    pressed = done.deepest[done.deepest > 0]
    assert np.median(pressed if pressed.size else 0.0) < 1e-6
    assert done.deepest.max() < 20e-6
    # 0.5 N m is where the device is saturated: none is, on its own path
    assert np.linalg.norm(sent[:, 3:], axis=1).max() < 0.9 * TORQUE_LIMIT
    # pliers without a grip axis stay open
    assert ticks["contacts"].any() == (name not in ("point_mass", "pliers"))


END, BOTTOM = slice(-1, None), slice(6480, 6600)
SHOWN: list[tuple[str, slice, int, float, float]] = [
    ("virtual_wall", slice(2400, 3300), 0, 0.01, 0.1e-3),
    ("virtual_wall", END, 0, 0.0, 1e-3),
    ("planar_peg", BOTTOM, 1, BOTTOMED_HEIGHT - HOME_HEIGHT, 0.3e-3),
    ("planar_peg", END, 1, 0.0, 1e-3),
    ("peg_in_hole", BOTTOM, 2, BOTTOMED_HEIGHT, 0.3e-3),
    ("peg_in_hole", END, 2, HOME_HEIGHT, 1e-3),
    ("round_peg", BOTTOM, 2, BOTTOMED_HEIGHT, 0.3e-3),
    ("round_peg", END, 2, HOME_HEIGHT, 1e-3),
    ("drawer", slice(3800, 4300), 0, 0.2, 1e-4),
    ("drawer", END, 0, -0.001, 1e-4),
    ("hammer", END, 0, -6.5e-3, 0.4e-3),
    ("open_wrench", END, 0, math.radians(60.0), math.radians(2.0)),
    *(("open_wrench", END, joint, 0.0, 2e-4) for joint in (2, 3, 4)),
    ("ratchet", END, 0, math.radians(-88.0), math.radians(2.0)),
    ("bench_pliers", END, 0, 0.38e-3, 0.06e-3),
    ("bench_pliers", END, 1, 0.0, 2e-3),
    ("lock", slice(2800, 5800), 4, 0.016, 1e-4),
    ("lock", slice(4400, 4700), 0, math.radians(90.0), math.radians(2.0)),
    ("lock", END, 0, 0.0, math.radians(0.5)),
    ("lock", END, 4, 0.0, 0.5e-3),
    ("screwdriver", END, 1, math.radians(180.0), math.radians(2.0)),
    ("hex_key", END, 1, math.radians(120.0), math.radians(2.0)),
]
"""Scene, ticks, joint, where that must stand, tolerance; in m and rad, from the start."""


@pytest.mark.parametrize(("name", "ticks", "joint", "expected", "tolerance"), SHOWN)
def test_default_run_does_the_task(
    default_run: Runs, name: str, ticks: slice, joint: int, expected: float, tolerance: float
) -> None:
    assert default_run(name).joints[ticks, joint] == pytest.approx(expected, abs=tolerance)


@pytest.mark.parametrize(
    ("name", "clearance", "ticks", "joint", "expected", "tolerance"),
    [
        ("planar_peg", 5e-6, BOTTOM, 1, BOTTOMED_HEIGHT - HOME_HEIGHT, 0.3e-3),
        ("peg_in_hole", 5e-6, BOTTOM, 2, BOTTOMED_HEIGHT, 0.3e-3),
        ("round_peg", 5e-6, BOTTOM, 2, BOTTOMED_HEIGHT, 0.3e-3),
        ("lock", 20e-6, slice(4400, 4700), 0, math.radians(90.0), math.radians(2.0)),
    ],
)
def test_default_run_does_the_task_in_the_tightest_fit(
    default_run: Runs,
    name: str,
    clearance: float,
    ticks: slice,
    joint: int,
    expected: float,
    tolerance: float,
) -> None:
    done = default_run(name, clearance=clearance)
    assert done.joints[ticks, joint] == pytest.approx(expected, abs=tolerance)
    assert done.summary.environment == "strict"


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


ROTATION = {"rotational_stiffness": 3.0, "rotational_damping": 0.05}
FIRM = Hand(stiffness=700.0, damping=12.0, **ROTATION)


@pytest.mark.parametrize(
    ("numbers", "spec", "expected"),
    [
        (None, "simulated", DEFAULT_HAND),
        ("700 12", "simulated", Hand(stiffness=700.0, damping=12.0)),
        ("700 12 3 0.05", "simulated", FIRM),
        ("700 12", "simulated:hand_stiffness=50,friction=0.1", Hand(stiffness=50.0, damping=12.0)),
        ("700 12", "simulated:hand=none", None),
    ],
)
def test_the_hand_is_the_options_then_the_scenes_then_the_default(
    numbers: str | None, spec: str, expected: Hand | None, tmp_path: Path
) -> None:
    assert hand_of(scene_with_hand(tmp_path, numbers), spec) == expected


@pytest.mark.parametrize(
    ("numbers", "says"),
    [
        *((numbers, "must be stiffness in N/m and damping")
          for numbers in ("1000", "1000 30 3", "1000 30 3 0.05 1")),
        ("-1 30", "hand stiffness is -1.0 N/m"),
        ("1000 nan", "hand damping is nan N s/m"),
        ("1000 30 inf 0.05", "hand rotational stiffness is inf N m/rad"),
    ],
)  # fmt: skip
@pytest.mark.filterwarnings("ignore:MuJoCo. XML contains a 'NaN'")
def test_numbers_that_are_no_hand_are_refused(numbers: str, says: str, tmp_path: Path) -> None:
    scene = scene_with_hand(tmp_path, numbers)
    with pytest.raises(SceneError, match=says) as refused:
        device_for(scene, "simulated")
    assert "simulated_hand" in str(refused.value)
    # somebody who brings a hand, or no simulated device at all, is not concerned
    assert hand_of(scene, "simulated:hand=none") is None
    device_for(scene, f"trajectory:{MODELS / 'drawer' / 'drawer.csv'}")


def own_hand(name: str) -> Hand:
    return scene_hand(scenes.plain_model(scenes.read_scene(name)), scene_path(name))


@pytest.mark.parametrize("name", [n for n in scene_names(1) if own_hand(n) != DEFAULT_HAND])
def test_a_scene_is_strict_in_its_own_hand_at_random(name: str) -> None:
    scene = hb.load_scene(name)
    loop = ClosedLoop(scene)
    for seed in range(4):
        outcome = shaken(loop, random_motion(seed), own_hand(name))
        assert (outcome.environment, outcome.ticks) == ("strict", 5000), f"seed {seed}: {outcome}"


@pytest.mark.parametrize("name", LOOP_SCENES)
@pytest.mark.filterwarnings("ignore:.*stiffer than any:UserWarning")  # these rates are not its own
def test_the_start_of_every_scene_creates_no_energy_at_any_rate(name: str) -> None:
    for rate in (250.0, 500.0, 1000.0):
        with hb.Bridge(name, "simulated", clock=hb.SimulatedClock(), rate=rate) as bridge:
            summary = bridge.run(duration=0.5)
        assert (rate, summary.environment, summary.slack_share) == (rate, "strict", 0.0)
