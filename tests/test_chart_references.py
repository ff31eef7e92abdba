"""The references of the charts, each against another route to the same numbers."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import nnls
from scipy.spatial.transform import Rotation

from hapticbridge.coupling import Coupling
from hapticbridge.errors import StudyError
from hapticbridge.lab.chart import contact_bodies, free_bodies
from hapticbridge.lab.chart.peg import (
    CLEARANCE,
    DURATION,
    HOME,
    JUDGED,
    POSES,
    RAMP,
    end_of_hold,
    gaps,
    peg_path,
    resting_peg,
)
from hapticbridge.lab.chart.peg import COUPLING as PEG_COUPLING
from hapticbridge.scene import load_scene
from hapticbridge.theory.impact import ImpactBody, resolve_impact

GRID = 4e-3


@pytest.mark.parametrize(
    ("stiffness", "damping", "mass"), [(1000.0, 1.0, 0.1), (1.0, 1e-3, 9e-6), (1000.0, 20.0, 0.1)]
)
def test_driven_mass_in_closed_form_is_what_dop853_integrates(
    stiffness: float, damping: float, mass: float
) -> None:
    omega = 2 * np.pi * free_bodies.FREQUENCY

    def rate(time: float, state: np.ndarray) -> list[float]:
        stretch = 1 - np.cos(omega * time) - state[0]
        return [
            state[1],
            (stiffness * stretch + damping * (omega * np.sin(omega * time) - state[1])) / mass,
        ]

    count = 60
    times = GRID * np.arange(1, count + 1)
    found = solve_ivp(
        rate, (0.0, times[-1]), [0.0, 0.0], "DOP853", t_eval=times, rtol=1e-11, atol=1e-13
    ).y
    position, force = free_bodies.exact_response(stiffness, damping, mass, GRID, count)
    np.testing.assert_allclose(position, found[0], atol=1e-9)
    stretch = 1 - np.cos(omega * times) - found[0]
    law = stiffness * stretch + damping * (omega * np.sin(omega * times) - found[1])
    np.testing.assert_allclose(force, law, atol=1e-7 * stiffness)


def test_driven_mass_is_that_of_the_scene() -> None:
    model = load_scene("point_mass").model
    tool = model.body("tool")
    assert float(tool.mass[0]) == pytest.approx(free_bodies.DRIVEN_MASS)
    np.testing.assert_allclose(tool.inertia, free_bodies.DRIVEN_INERTIA, rtol=1e-6)


def test_midpoint_rule_at_a_tiny_step_is_what_dop853_integrates() -> None:
    by_midpoint = free_bodies.exact_orientations(GRID, 50)
    moments = np.array(free_bodies.SPINNING_INERTIA)

    def rate(_time: float, state: np.ndarray) -> np.ndarray:
        # Euler's equations and q' = ½ q ⊗ ω
        w, u, omega = state[0], state[1:4], state[4:]
        turning = -np.cross(omega, moments * omega) / moments
        return np.concatenate([[-0.5 * u @ omega], 0.5 * (w * omega + np.cross(u, omega)), turning])

    times = GRID * np.arange(1, 51)
    start = [1.0, 0.0, 0.0, 0.0, *free_bodies.SPIN]
    found = solve_ivp(
        rate, (0.0, times[-1]), start, "DOP853", t_eval=times, rtol=1e-12, atol=1e-13
    ).y[:4]
    by_dop853 = np.where(found[0] < 0, -found, found).T
    assert np.abs(by_midpoint - by_dop853).max() < 1e-9
    # the two would agree on a body that stands still, too
    assert np.abs(np.diff(by_midpoint, axis=0)).max() > 0.01


def test_reference_of_the_spin_wants_a_grid_that_it_meets() -> None:
    with pytest.raises(StudyError, match="is no multiple of the reference's"):
        free_bodies.exact_orientations(GRID / 3001, 2)


def test_impulses_of_the_falling_rod_are_those_of_every_law() -> None:
    angle = np.array(contact_bodies.ANGLES)
    arm = np.stack(
        [
            -contact_bodies.LENGTH / 2 * np.cos(angle),
            -contact_bodies.LENGTH / 2 * np.sin(angle) - contact_bodies.TIP,
        ],
        axis=-1,
    )
    rod = ImpactBody(contact_bodies.ROD_MASS, contact_bodies.INERTIA, arm)
    for law in ("newton", "poisson", "stronge"):
        found = resolve_impact(
            rod,
            [contact_bodies.SLIDE, -contact_bodies.APPROACH],
            contact_bodies.ROD_FRICTION,
            0.0,
            law,
        )
        np.testing.assert_allclose(
            found.impulse, contact_bodies.rigid_impacts().impulse, atol=1e-15
        )
    # a tip that does not rebound: what its impulses leave has no normal velocity
    np.testing.assert_allclose(contact_bodies.rigid_impacts().velocity[:, 1], 0.0, atol=1e-12)
    assert (contact_bodies.rigid_impacts().energy_change < 0).all()


def test_gaps_of_the_peg_are_negative_exactly_where_mujoco_finds_it_inside() -> None:
    scene = load_scene("peg_in_hole", friction=0.0)
    model, data = scene.model, scene.data
    generator = np.random.default_rng(3)
    inside = 0
    for _ in range(300):
        place = generator.uniform((-2e-4, -2e-4, -0.008), (2e-4, 2e-4, 0.02))
        turn = generator.uniform(-0.005, 0.005, 3)
        least = float(gaps(place, turn).min())
        if abs(least) < 2e-6:
            continue  # edge against edge, where MuJoCo's boxes touch a micrometre early or late
        q = Rotation.from_rotvec(turn).as_quat()[[3, 0, 1, 2]]
        data.qpos[:7] = *place, *q
        mujoco.mj_forward(model, data)
        inside += least < 0
        assert (data.ncon > 0) == (least < 0), (place, turn, least)
    assert 50 < inside < 250


def test_resting_peg_has_the_closed_form_where_it_touches_one_wall_or_the_bottom() -> None:
    stiff = Coupling(1000.0, 0.0, 1e5, 0.0)  # hardly turns
    wall = resting_peg(stiff, (2e-3, 0.0, 0.01))
    np.testing.assert_allclose(wall.position, [CLEARANCE, 0.0, 0.01], atol=1e-7)
    assert wall.wrench[0] == pytest.approx(1000 * (2e-3 - CLEARANCE), rel=1e-3)
    bottom = resting_peg(stiff, (0.0, 0.0, -0.012))
    np.testing.assert_allclose(bottom.position, [0.0, 0.0, -0.01], atol=1e-8)
    free = resting_peg(stiff, (1e-4, 0.0, 0.01))
    np.testing.assert_allclose(free.position, [1e-4, 0.0, 0.01], atol=1e-8)


@pytest.mark.parametrize("index", JUDGED)
def test_resting_peg_is_held_by_pushes_of_the_walls_that_it_touches(index: int) -> None:
    found = resting_peg(PEG_COUPLING, *POSES[index])
    turned = Rotation.from_rotvec(found.rotation)

    def moved(twist: np.ndarray) -> np.ndarray:
        rotation = (Rotation.from_rotvec(twist[3:]) * turned).as_rotvec()
        return gaps(found.position + twist[:3], rotation)

    touching = np.flatnonzero(found.gaps < 1e-7)
    step = 1e-7 * np.eye(6)
    pushes = np.array([(moved(row) - moved(-row))[touching] / 2e-7 for row in step])
    # forces in N and torques about the centre, the latter weighed like a lever of 30 mm
    weight = np.array([1, 1, 1, 30, 30, 30])
    sizes, left = nnls(pushes * weight[:, None], -found.wrench * weight)
    assert left < 1e-3 * np.linalg.norm(found.wrench[:3])
    assert sizes.sum() > 0.5


def test_resting_peg_wants_a_coupling_that_holds_it() -> None:
    with pytest.raises(StudyError, match="must hold the peg's place and turning"):
        resting_peg(Coupling(1000.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.01))


def test_path_of_the_peg_starts_at_home_and_rests_at_every_pose() -> None:
    places, turns = peg_path(np.array([0.0]))
    np.testing.assert_allclose(places[0], 0.0, atol=1e-15)
    for index, (place, turn) in enumerate(POSES):
        end = end_of_hold(index) - 1e-6
        places, turns = peg_path(np.array([end - 0.3, end]))
        np.testing.assert_allclose(places + HOME, [place, place], atol=1e-12)
        rotated = Rotation.from_quat(turns[-1, [1, 2, 3, 0]]).as_rotvec()
        np.testing.assert_allclose(rotated, turn, atol=1e-12)
    assert len(POSES) * RAMP < DURATION


def test_sliding_block_in_closed_form_is_what_a_solver_with_an_event_finds() -> None:
    coupling, mass = contact_bodies.BLOCK_COUPLING, contact_bodies.BLOCK_MASS
    limit = contact_bodies.BLOCK_FRICTION * mass * contact_bodies.GRAVITY

    def place_and_speed(time: float) -> tuple[float, float]:
        place = float(contact_bodies.handle_place(np.array([time]))[0])
        return place, contact_bodies.SPEED * min(time / contact_bodies.EASE, 1.0)

    # Coulomb's friction regularised far below what is compared, and solved stiffly
    def rate(time: float, state: np.ndarray) -> list[float]:
        place, speed = place_and_speed(time)
        pull = coupling.stiffness * (place - state[0]) + coupling.damping * (speed - state[1])
        return [state[1], (pull - limit * np.tanh(state[1] / 1e-7)) / mass]

    times = 2e-3 * np.arange(1.0, 101.0)
    found = solve_ivp(
        rate, (0.0, times[-1]), [0.0, 0.0], "Radau", t_eval=times, rtol=1e-8, atol=1e-12
    ).y
    place, force = contact_bodies.exact_sliding(coupling, times)
    np.testing.assert_allclose(place, found[0], atol=2e-8)
    handle = np.array([place_and_speed(time) for time in times])
    law = coupling.stiffness * (handle[:, 0] - found[0])
    law += coupling.damping * (handle[:, 1] - found[1])
    np.testing.assert_allclose(force, law, atol=5e-5)
    before = times < contact_bodies.breakaway(coupling)
    assert force[before].max() < limit < force[~before][:3].max()


def test_block_that_would_break_away_too_early_or_never_is_refused() -> None:
    for stiffness in (1e5, 10.0):
        with pytest.raises(StudyError, match="the block breaks away at"):
            contact_bodies.SlidingBlock(Coupling(stiffness, 1.0, 0.0, 0.0), GRID, GRID)
