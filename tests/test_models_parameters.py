"""Parameters of the scenes: at both ends of its range each does what the physics says.

Measured in runs without the package, but for the numbers that it writes into the scene.
"""

from __future__ import annotations

import functools

import mujoco
import numpy as np
import pytest
from model_runs import (
    K,
    Run,
    T,
    moment_about_axis,
    moved_through,
    run_along_own_path,
    scene_set_to,
)

STILL = (0.0, 0.0, 0.0)


@functools.cache
def own_path_with(name: str, parameter: str, value: float) -> Run:
    return run_along_own_path(name, *scene_set_to(name, **{parameter: value}))


# --- mass: force is mass times acceleration -------------------------------------------------------

MOVES = {
    "point_mass": (0.02, 0.0, 0.01),
    "virtual_wall": (-0.02, 0.0, 0.0),
    "planar_peg": (0.01, 0.0, 0.02),
    "peg_in_hole": (0.01, -0.01, 0.02),
    "round_peg": (0.01, -0.01, 0.02),
    "drawer": (0.05, 0.0, 0.0),
    "hammer": (0.0, 0.0, 0.03),
}
"""Goal of the hand in m, away from everything, in half a second."""


@pytest.mark.parametrize("name", MOVES)
@pytest.mark.parametrize("end", ["minimum", "maximum"])
def test_force_of_a_free_tool_is_the_mass_that_was_set_times_acceleration(
    name: str, end: str
) -> None:
    parameter = "head_mass" if name == "hammer" else "mass"
    low, high = {
        "point_mass": (0.01, 1.0),
        "virtual_wall": (0.01, 0.5),
        "drawer": (0.9, 6.0),
        "hammer": (0.15, 0.3),
    }.get(name, (0.03, 0.3))
    value = low if end == "minimum" else high
    values = {parameter: value} | ({"friction": 0.0} if name == "drawer" else {})
    model, data = scene_set_to(name, **values)
    body = int(model.site("grip").bodyid[0])
    centre = data.xipos[body] - data.site("grip").xpos
    run = moved_through(model, data, [(0.5, MOVES[name], STILL), (0.2, MOVES[name], STILL)])
    position = run.tool + run.rotation.apply(centre)
    acceleration = np.diff(position, n=2, axis=0, prepend=position[:1]) / T**2
    along = np.array(MOVES[name]) / np.linalg.norm(MOVES[name])
    pull, change = run.force[1:] @ along, acceleration @ along
    felt = (pull @ change) / (change @ change)
    expected = value + 0.04 if name == "hammer" else value
    assert felt == pytest.approx(expected, rel=0.02)


# --- virtual wall ---------------------------------------------------------------------------------


@pytest.mark.parametrize("mass", [0.01, 0.5])
def test_wall_is_as_stiff_as_the_tool_is_heavy(mass: float) -> None:
    model, data = scene_set_to("virtual_wall", mass=mass)
    run = moved_through(model, data, [(0.6, (0.011, 0, 0), STILL), (0.3, (0.011, 0, 0), STILL)])
    stiffness = run.force[-1, 0] / run.deepest[-1]
    # d² / ((1 - d) dmax² timeconst²) at d = 0.9, times the tool and 3 g of the coupling
    assert stiffness == pytest.approx(2.2e6 * (mass + 0.003), rel=0.1)


@pytest.mark.parametrize("distance", [0.002, 0.02])
def test_wall_stands_where_it_was_set(distance: float) -> None:
    model, data = scene_set_to("virtual_wall", distance=distance)
    pressed = (distance + 0.001, 0.0, 0.0)
    run = moved_through(model, data, [(0.6, pressed, STILL), (0.3, pressed, STILL)])
    assert run.tool[-1, 0] - run.deepest[-1] == pytest.approx(distance, abs=1e-9)


# --- drawer ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("friction", [0.0, 6.0])
def test_drawer_slides_against_the_friction_that_was_set(friction: float) -> None:
    model, data = scene_set_to("drawer", friction=friction)
    run = moved_through(model, data, [(2.0, (0.1, 0, 0), STILL)])
    # force and inertia's part of it cancel over a movement from rest to rest, but for the end
    sliding = slice(500, 1500)
    speed = np.diff(run.joints[:, 0], prepend=0.0) / T
    inertia = 1.2 * (speed[1499] - speed[499]) / 1.0
    assert run.force[sliding, 0].mean() - inertia == pytest.approx(friction, rel=0.01, abs=0.01)


@pytest.mark.parametrize("travel", [0.05, 0.21])
def test_drawer_stops_at_the_travel_that_was_set(travel: float) -> None:
    model, data = scene_set_to("drawer", travel=travel)
    beyond = (travel + 0.002, 0.0, 0.0)
    run = moved_through(model, data, [(1.5, beyond, STILL), (0.3, beyond, STILL)])
    assert run.touched["open_stop"][-1]
    assert run.joints[-1, 0] == pytest.approx(travel - 0.001, abs=2e-5)
    assert run.force[-1, 0] == pytest.approx(K * 0.003, rel=0.05)


# --- hammer ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("friction", [12.0, 25.0])
def test_nail_moves_at_the_friction_that_was_set_and_not_below(friction: float) -> None:
    model, data = scene_set_to("hammer", nail_friction=friction)
    load = 0.0
    while data.joint("nail").qpos[0] > -0.4e-3:
        load += 0.05
        assert load < 1.1 * friction
        data.joint("nail").qfrc_applied[0] = -load
        mujoco.mj_step(model, data)
        if load < 0.9 * friction:  # it creeps below, by 0.05 mm/s under 25 N
            assert data.joint("nail").qpos[0] > -0.1e-3


def first_blow(parameter: str, value: float) -> tuple[float, float]:
    """Speed of the first blow in m/s, and by how much it drives the nail in m."""
    run = own_path_with("hammer", parameter, value)
    meets = int(np.argmax(run.touched["nail"]))
    speed = (run.joints[meets - 2, 3] - run.joints[meets - 1, 3]) / T
    return speed, -run.joints[1900, 0]  # before the second


def test_nail_goes_in_by_the_work_of_a_blow_over_its_friction() -> None:
    speeds, depths = zip(*(first_blow("nail_friction", f) for f in (12.0, 25.0)), strict=True)
    assert speeds[0] == pytest.approx(speeds[1], rel=1e-6)
    # the same blow; a contact that gives wastes more of it on the harder nail
    assert 25 / 12 < depths[0] / depths[1] < 1.2 * 25 / 12


def test_heavier_head_drives_the_nail_further() -> None:
    depths = []
    for mass in (0.15, 0.3):
        speed, depth = first_blow("head_mass", mass)
        hammer, driven = mass + 0.04, 0.051
        left = 0.5 * hammer * speed**2 * hammer / (hammer + driven)
        # what the inelastic impact leaves goes into friction, less what the implicit step takes of
        # a blow that lasts a few ms
        assert 0.5 * left < 16.6 * depth < 0.85 * left
        depths.append(depth)
    assert depths[0] < depths[1]


# --- ratchet --------------------------------------------------------------------------------------


@pytest.mark.parametrize("torque", [0.05, 0.4])
def test_ratchet_drives_against_the_bolt_that_was_set(torque: float) -> None:
    run = own_path_with("ratchet", "bolt_torque", torque)
    gear = run.joints[:, 0]
    assert -moment_about_axis(run)[6500:6800] == pytest.approx(torque, rel=0.1)
    assert gear[7800] - gear[5700] == pytest.approx(-np.pi / 4, abs=np.radians(3.0))


def free_way(parameter: str, value: float) -> float:
    """Mean moment in N m with which the handle goes back over three teeth."""
    return float(moment_about_axis(own_path_with("ratchet", parameter, value))[700:1600].mean())


def test_pawl_resists_the_free_way_as_its_spring_presses_and_as_it_rubs() -> None:
    light, strong = (free_way("pawl_force", force) for force in (0.25, 3.0))
    assert strong / light == pytest.approx(12.0, rel=0.15)
    slippery, dry = (free_way("friction", value) for value in (0.05, 0.4))
    assert slippery < 0.75 * dry


# --- open wrench ----------------------------------------------------------------------------------


@pytest.mark.parametrize("torque", [0.12, 0.5])
def test_nut_breaks_away_at_the_torque_that_was_set(torque: float) -> None:
    run = own_path_with("open_wrench", "breakaway", torque)
    nut, moment = run.joints[:, 0], moment_about_axis(run)
    breaks = int(np.argmax(nut > np.radians(0.3)))
    assert moment[breaks] == pytest.approx(torque, rel=0.1)
    assert np.degrees(nut[-1]) == pytest.approx(60.0, abs=2.0)


@pytest.mark.parametrize("torque", [0.01, 0.1])
def test_slackened_nut_runs_with_the_torque_that_was_set_and_breaks_away_as_before(
    torque: float,
) -> None:
    run = own_path_with("open_wrench", "running", torque)
    nut, moment = run.joints[:, 0], moment_about_axis(run)
    breaks = int(np.argmax(nut > np.radians(0.3)))
    assert moment[breaks] == pytest.approx(0.30, rel=0.1)
    tick = int(np.argmax(nut > np.radians(55)))
    expected = torque + (0.30 - torque) * (1 - 55 / 65) ** 3
    assert moment[tick - 20 : tick + 20].mean() == pytest.approx(expected, rel=0.1, abs=2e-3)


@pytest.mark.parametrize("clearance", [0.025e-3, 0.5e-3])
def test_play_of_the_wrench_is_that_of_a_hexagon_between_two_flats(clearance: float) -> None:
    model, data = scene_set_to("open_wrench", clearance=clearance)
    # a rounded corner, 0.4 mm, on a circle of 8.776 mm, 30 degrees beside the flat's middle
    play = np.pi / 6 - np.arccos((0.0076 + clearance) / 0.008776)

    def depth(angle: float) -> float:
        data.joint("hinge").qpos[0] = angle
        mujoco.mj_forward(model, data)
        corners = [c for c in data.contact if "corner" in model.geom(c.geom1).name]
        return max((-float(contact.dist) for contact in corners), default=-np.inf)

    for side in (1, -1):
        assert depth(side * (play - 2e-4)) < 0
        assert 0 < depth(side * (play + 2e-4)) < 3e-6


@pytest.mark.parametrize("friction", [0.05, 0.4])
@pytest.mark.parametrize("name", ["open_wrench", "ratchet"])
def test_friction_that_was_set_is_that_of_every_contact(name: str, friction: float) -> None:
    model, data = scene_set_to(name, friction=friction)
    if name == "open_wrench":
        data.joint("hinge").qpos[0] = np.radians(2.0)
    else:
        data.joint("arm").qpos[0] = -0.03 - np.radians(1.0)
    mujoco.mj_forward(model, data)
    assert data.ncon > 0
    assert all(contact.friction[0] == pytest.approx(friction) for contact in data.contact)
