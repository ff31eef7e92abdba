"""pliers and lock: the task succeeds with the stated forces, and a wrong key does not turn."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from model_runs import (
    MODELS,
    Run,
    moment_about_axis,
    moved_through,
    run_of_own_path,
    scene_with_handle,
    spec_of,
    swung,
)
from random_hands import random_motion, shaken, smooth

import hapticbridge as hb
from hapticbridge.device import Motion
from hapticbridge.lab.closed_loop import ClosedLoop
from hapticbridge.scene import scene_parameters
from hapticbridge.scene.parameters import apply_parameters

FORCE_LIMIT = 10.0  # N, of the default simulated device


def scene_with(name: str, **values: float) -> tuple[Any, Any]:
    """Returns model and data of a scene with parameters, the coupling attached by hand."""

    def edit(spec: Any) -> None:
        apply_parameters(spec, MODELS / name / f"{name}.xml", values)

    return scene_with_handle(name, edit)


@pytest.mark.parametrize("name", ["pliers", "lock"])
def test_task_in_the_bridge_is_audited_passive_and_without_a_warning(
    name: str, tmp_path: Path
) -> None:
    device = f"trajectory:{MODELS / name / f'{name}.csv'}"
    file = tmp_path / "run.mcap"
    with hb.Bridge(name, device, clock=hb.SimulatedClock(), recording=file) as bridge:
        summary = bridge.run()
        assert not any(warning.number for warning in bridge.scene.data.warning)
        # the bridge and the run without the package end alike: what follows is true of both
        joints = bridge.scene.data.qpos
        assert joints == pytest.approx(run_of_own_path(name).joints[-1], abs=1e-4)
    assert summary.environment == "strict"
    assert 2.0 < summary.peak_force < FORCE_LIMIT
    assert hb.audit(file).verdict == "passive"


ENDS = [
    (name, parameter.name, end)
    for name in ("pliers", "lock")
    for parameter in scene_parameters(MODELS / name / f"{name}.xml")
    for end in (parameter.minimum, parameter.maximum)
]
TOWARDS = {"pliers": [0.0, -0.02, 0.0], "lock": [-0.02, 0.0, 0.0]}
"""Where the hand goes while it is random, in m: onto the wire, into the keyway."""


@pytest.mark.parametrize(("name", "parameter", "end"), ENDS)
def test_ends_of_each_parameter_stay_passive_in_a_random_hand_that_uses_the_tool(
    name: str, parameter: str, end: float
) -> None:
    loop = ClosedLoop(hb.load_scene(name, "grip", **{parameter: end}))
    used = 0
    for seed in range(3):
        rows = random_motion(seed).table
        towards = smooth(rows[:, :1]) * np.array(TOWARDS[name])
        outcome = shaken(loop, Motion(rows[:, 0], rows[:, 1:4] + towards, rows[:, 4:]))
        assert outcome.fault is None, f"seed {seed}: {outcome}"
        assert outcome.ticks == 5000
        assert outcome.environment in {"strict", "within slack"}
        assert outcome.peak_force < FORCE_LIMIT
        assert not any(warning.number for warning in loop.scene.data.warning)
        used += int(np.count_nonzero(outcome.records["contacts"] > (3 if name == "lock" else 0)))
    assert used > 500


# --- pliers ---------------------------------------------------------------------------------------

GRIP_DISTANCE = 0.1  # m, from the hinge


def spring_torque(run: Run) -> np.ndarray:
    """Returns what the return spring takes in each tick, in N m."""
    hinge = spec_of("pliers").compile().joint("hinge")
    return np.asarray(hinge.stiffness[0] * (run.joints[:, 1] - hinge.qpos_spring[0]))


def touching_angle(wire: float) -> float:
    """Returns how far the pliers are open when the jaw meets a wire that is so thick, in rad.

    The wire's axis is 20 mm from the hinge and 1 mm from the fixed jaw less what it was crushed by,
    its round 1 mm from its axis: 20 sin a - (wire - 1 mm) cos a = 1 mm.
    """
    angles = np.linspace(0.0, 0.2, 20001)
    gap = 0.02 * np.sin(angles) - (wire - 1e-3) * np.cos(angles) - 1e-3
    return float(angles[np.argmax(gap > 0.0)])


def test_hand_feels_the_return_spring_until_the_wire() -> None:
    run = run_of_own_path("pliers")
    closing = slice(900, 2400)
    assert not run.touched["wire"][closing].any()
    assert -moment_about_axis(run)[closing] == pytest.approx(spring_torque(run)[closing], rel=0.02)
    # 0.6 N hold it open
    assert spring_torque(run)[0] / GRIP_DISTANCE == pytest.approx(0.6, abs=0.01)
    # the first contact is where geometry says: 0.2 rad are closed
    meets = int(np.argmax(run.touched["wire"]))
    assert 0.2 - run.joints[meets, 1] == pytest.approx(touching_angle(2e-3), abs=1e-3)


def test_wire_yields_at_its_force_over_the_lever_and_hardens() -> None:
    model = spec_of("pliers").compile()
    crush = model.joint("crush")
    run = run_of_own_path("pliers")
    lever = GRIP_DISTANCE / -model.body("wire").pos[0]
    assert lever == pytest.approx(5.0)
    at_the_handle = (-moment_about_axis(run) - spring_torque(run)) / GRIP_DISTANCE
    # before it gives by a hair it has held 90 % of that
    yields = int(np.argmax(run.joints[:, 0] > 0.02e-3))
    assert at_the_handle[yields] == pytest.approx(crush.frictionloss[0] / lever, rel=0.1)
    for depth in (0.1e-3, 0.3e-3, 0.5e-3, 0.6e-3):
        tick = int(np.argmax(run.joints[:, 0] > depth))
        expected = (crush.frictionloss[0] + crush.stiffness[0] * depth) / lever
        felt = at_the_handle[tick - 20 : tick + 20].mean()
        assert felt == pytest.approx(expected, rel=0.03), depth


def test_wire_stays_crushed_and_is_met_later_the_second_time() -> None:
    run = run_of_own_path("pliers")
    crushed = run.joints[:, 0]
    assert crushed.max() == pytest.approx(0.72e-3, abs=0.03e-3)
    # it creeps back by 16 µm/s
    assert crushed.max() - crushed[-1] < 0.06e-3
    assert not run.touched["wire"][4800:6200].any()
    assert run.joints[5500, 1] == pytest.approx(0.0, abs=1e-3)
    again = 6200 + int(np.argmax(run.touched["wire"][6200:]))
    expected = touching_angle(2e-3 - crushed[again])
    assert 0.2 - run.joints[again, 1] == pytest.approx(expected, abs=1e-3)
    assert touching_angle(2e-3) - expected > np.radians(1.5)


@pytest.mark.parametrize(("distance", "degrees"), [(0.012, 5.0), (0.02, 8.5), (0.03, 10.0)])
def test_jaw_presses_with_the_handles_force_times_the_lever(
    distance: float, degrees: float
) -> None:
    model, data = scene_with("pliers", wire_distance=distance)
    run = moved_through(model, data, swung(-degrees, -degrees))
    assert data.ncon == 1
    force = np.zeros(6)
    mujoco.mj_contactForce(model, data, 0, force)
    handle = (-moment_about_axis(run)[-1] - spring_torque(run)[-1]) / GRIP_DISTANCE
    assert force[0] > 15.0
    assert force[0] / handle == pytest.approx(GRIP_DISTANCE / distance, rel=0.02)


def test_a_wire_that_is_too_strong_holds() -> None:
    runs = []
    for strength in (16.0, 40.0):
        model, data = scene_with("pliers", yield_force=strength)
        runs.append(moved_through(model, data, swung(-7.5, -7.5)))
    assert runs[0].joints[-1, 0] > 0.15e-3
    # pressed with 26 N, it creeps by 0.04 mm/s
    assert runs[1].joints[-1, 0] < 0.04e-3


# --- lock -----------------------------------------------------------------------------------------

SEATED = -0.0165  # m, of the hand: half a millimetre beyond the key's shoulder
TRIED = 15.0  # degrees that a hand turns to try; the lock lets it or not


def tried(pushed: float = SEATED, **values: float) -> tuple[float, float]:
    """Pushes the key in, turns the hand by 15 degrees; returns plug in degrees, torque in N m."""
    model, data = scene_with("lock", **values)
    still, turned = (0.0, 0.0, 0.0), (-np.radians(TRIED), 0.0, 0.0)
    place = (pushed, 0.0, 0.0)
    run = moved_through(
        model, data, [(1.0, place, still), (0.2, place, still), (0.7, place, turned)]
    )
    assert run.warnings == 0
    return float(np.degrees(run.joints[-1, 0])), float(-run.torque[-1, 0])


def test_key_goes_in_with_three_clicks_each_as_strong_as_the_springs_on_its_flanks() -> None:
    model = spec_of("lock").compile()
    driver, key = model.joint("driver_0"), model.joint("key")
    friction = model.geom("cut_0").friction[0]
    run = run_of_own_path("lock")
    push = -run.force[:2200, 0]
    state = np.where(push > 1.2, 1, np.where(push < 0.0, -1, 0))
    falls = np.flatnonzero(state)
    clicks = falls[1:][(state[falls[1:]] == -1) & (state[falls[:-1]] == 1)]
    assert len(clicks) == 3
    for number, click in enumerate(clicks, start=1):
        # just before, so many pairs climb a flank of 45 degrees
        climbing = click - 100 + int(np.argmax(push[click - 100 : click]))
        lifts = run.joints[climbing, 5 : 5 + number]
        springs = driver.stiffness[0] * np.sum(lifts - driver.qpos_spring[0])
        expected = springs * (1 + friction) / (1 - friction) + key.frictionloss[0]
        assert push[climbing] == pytest.approx(expected, rel=0.1), number


def test_right_key_turns_the_plug_by_ninety_degrees_and_comes_out_again() -> None:
    run = run_of_own_path("lock")
    plug, key = np.degrees(run.joints[:, 0]), run.joints[:, 4]
    assert key[2600:6000] == pytest.approx(0.016, abs=5e-5)
    assert plug[4400:4700] == pytest.approx(90.0, abs=2.0)
    assert np.abs(plug[:2800]).max() < 0.5
    assert np.abs(plug[6200:]).max() < 0.5
    assert abs(key[-1]) < 1e-4
    # the pins are down again; turned, every driver lay on the plug, its foot 6.35 mm from the axis
    assert np.abs(run.joints[-1, [1, 2, 3, 5, 6, 7]]).max() < 1e-4
    feet = [
        run.data.model.body(f"driver_{i}").pos[2] + run.joints[4500, 5 + i] - 0.00635
        for i in range(3)
    ]
    assert feet == pytest.approx([0.0] * 3, abs=0.04e-3)
    # and the hand felt the plug's friction, no more
    stated = spec_of("lock").compile().joint("plug").frictionloss[0]
    assert -run.torque[3300:3900, 0] == pytest.approx(stated, abs=0.3 * stated + 1e-3)


@pytest.mark.parametrize("error", [-0.5e-3, -0.38e-3, 0.38e-3, 0.5e-3])
def test_wrong_key_is_stopped_before_ten_degrees_by_one_pair_of_pins(error: float) -> None:
    plug, torque = tried(bitting_error=error)
    # 13 degrees short of what the hand did, at 2.4 N m/rad
    assert plug < 2.0
    assert torque > 0.5


@pytest.mark.parametrize("error", [-0.1e-3, 0.0, 0.1e-3])
def test_key_within_the_tolerance_turns(error: float) -> None:
    plug, torque = tried(bitting_error=error)
    assert plug == pytest.approx(TRIED, abs=0.5)
    assert torque < 0.02


def test_wider_clearance_forgives_more() -> None:
    wide, _ = tried(bitting_error=0.2e-3, clearance=0.15e-3)
    narrow, _ = tried(bitting_error=0.2e-3, clearance=0.05e-3)
    assert wide == pytest.approx(TRIED, abs=0.5)
    assert narrow < 2.0


@pytest.mark.parametrize("pushed", [0.0, -0.008, -0.0125])
def test_key_that_is_not_all_the_way_in_does_not_turn(pushed: float) -> None:
    plug, torque = tried(pushed)
    assert plug < 2.0
    assert torque > 0.5


def test_turned_key_cannot_be_pulled_out() -> None:
    still, turned = (0.0, 0.0, 0.0), (-np.pi / 2, 0.0, 0.0)
    place, pulled = (SEATED, 0.0, 0.0), (SEATED + 0.004, 0.0, 0.0)
    left = []
    for turn in (still, turned):
        model, data = scene_with_handle("lock")
        poses = [(1.0, place, still), (1.0, place, turn), (0.8, pulled, turn), (0.3, pulled, turn)]
        run = moved_through(model, data, poses)
        left.append(0.016 - run.joints[-1, 4])
        if turn is turned:
            # the key pins press on the bore, and the hand pulls with 6 N
            assert run.force[-1, 0] > 6.0
            assert run.touched["bore_5"][-1]
    assert left[0] > 3e-3
    assert left[1] < 1e-3
