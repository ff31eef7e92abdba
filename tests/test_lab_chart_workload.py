"""Workloads of the charts: references by another route, and how errors go with the time step."""

from __future__ import annotations

from functools import lru_cache

import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import linprog, minimize, nnls
from scipy.spatial.transform import Rotation

from hapticbridge.coupling import Coupling
from hapticbridge.errors import StudyError
from hapticbridge.kernel.record import TICK_DTYPE
from hapticbridge.lab.chart import contact_bodies, free_bodies, peg, resting_bodies
from hapticbridge.lab.chart.chart import Extent, measure_chart, open_workload
from hapticbridge.lab.chart.scene_run import COUPLING, OwnReferences, SceneRates, Workload
from hapticbridge.lab.chart.score import Score
from hapticbridge.lab.chart.setting import Setting, rate_settings
from hapticbridge.lab.methods import METHODS
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
        least = float(peg.gaps(place, turn).min())
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
    wall = peg.resting_peg(stiff, (2e-3, 0.0, 0.01))
    np.testing.assert_allclose(wall.position, [peg.CLEARANCE, 0.0, 0.01], atol=1e-7)
    assert wall.wrench[0] == pytest.approx(1000 * (2e-3 - peg.CLEARANCE), rel=1e-3)
    bottom = peg.resting_peg(stiff, (0.0, 0.0, -0.012))
    np.testing.assert_allclose(bottom.position, [0.0, 0.0, -0.01], atol=1e-8)
    free = peg.resting_peg(stiff, (1e-4, 0.0, 0.01))
    np.testing.assert_allclose(free.position, [1e-4, 0.0, 0.01], atol=1e-8)


@pytest.mark.parametrize("index", peg.JUDGED)
def test_resting_peg_is_held_by_pushes_of_the_walls_that_it_touches(index: int) -> None:
    found = peg.resting_peg(peg.COUPLING, *peg.POSES[index])
    turned = Rotation.from_rotvec(found.rotation)

    def moved(twist: np.ndarray) -> np.ndarray:
        rotation = (Rotation.from_rotvec(twist[3:]) * turned).as_rotvec()
        return peg.gaps(found.position + twist[:3], rotation)

    touching = np.flatnonzero(found.gaps < 1e-7)
    step = 1e-7 * np.eye(6)
    pushes = np.array([(moved(row) - moved(-row))[touching] / 2e-7 for row in step])
    # forces in N and torques about the centre, the latter weighed like a lever of 30 mm
    weight = np.array([1, 1, 1, 30, 30, 30])
    sizes, left = nnls(pushes * weight[:, None], -found.wrench * weight)
    assert left < 1e-8 * np.linalg.norm(found.wrench[:3])
    assert sizes.sum() > 0.5


def test_resting_peg_wants_a_coupling_that_holds_it() -> None:
    with pytest.raises(StudyError, match="must hold the peg's place and turning"):
        peg.resting_peg(Coupling(1000.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.01))


def test_path_of_the_peg_starts_at_home_and_rests_at_every_pose() -> None:
    places, turns = peg.peg_path(np.array([0.0]))
    np.testing.assert_allclose(places[0], 0.0, atol=1e-15)
    for index, (place, turn) in enumerate(peg.POSES):
        end = peg.end_of_pose(index) - 1e-6
        places, turns = peg.peg_path(np.array([end - 0.3, end]))
        np.testing.assert_allclose(places + peg.HOME, [place, place], atol=1e-12)
        rotated = Rotation.from_quat(turns[-1, [1, 2, 3, 0]]).as_rotvec()
        np.testing.assert_allclose(rotated, turn, atol=1e-12)
    assert len(peg.POSES) * peg.RAMP < peg.DURATION


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


def can_rest(side: float, down: float) -> bool:
    """Finds forces at both edges of every joint of the stack that balance each box, by a program.

    The unknowns of a joint are the normal and tangential forces at its left and right edge.
    """
    boxes, wide, high = resting_bodies.BOXES, resting_bodies.HALF_WIDTH, resting_bodies.HALF_HEIGHT
    balance, sums = np.zeros((3 * boxes, 4 * boxes)), np.zeros(3 * boxes)
    for box in range(boxes):
        for joint, sign, lever in ((box, 1.0, -high), (box + 1, -1.0, high)):
            if joint == boxes:
                continue
            for edge, place in enumerate((-wide, wide)):
                column = 4 * joint + 2 * edge
                balance[3 * box + 1, column] = sign
                balance[3 * box + 2, column] = -sign * place
                balance[3 * box, column + 1] = sign
                balance[3 * box + 2, column + 1] = sign * lever
        sums[3 * box + 1] = resting_bodies.BOX_MASS * resting_bodies.GRAVITY
    sums[3 * (boxes - 1)] -= side
    sums[3 * (boxes - 1) + 1] += down
    cone = np.zeros((4 * boxes, 4 * boxes))
    for edge in range(2 * boxes):
        for row, sign in enumerate((1.0, -1.0)):
            cone[2 * edge + row, 2 * edge] = -resting_bodies.BOX_FRICTION
            cone[2 * edge + row, 2 * edge + 1] = sign
    bounds = [(0, None), (None, None)] * (2 * boxes)
    nothing = np.zeros(4 * boxes)
    return bool(linprog(nothing, cone, nothing, balance, sums, bounds).success)


def test_stack_rests_up_to_the_force_at_which_edges_and_friction_can_bear_it() -> None:
    for down in (0.0, 1.0, 5.0, 20.0):
        most = float(resting_bodies.borne(np.array(down)))
        assert can_rest(0.99 * most, down)
        assert not can_rest(1.01 * most, down)
    times = 4e-3 * np.arange(1.0, 301.0)
    force = resting_bodies.leaning_force(free_bodies.COUPLING, times)
    assert all(can_rest(-x, -z) for x, _, z in force[::25])
    # a spring against a box that rests
    ways = resting_bodies.leaned(times)[0]
    rates = np.gradient(ways, times, axis=0, edge_order=2)
    law = free_bodies.COUPLING.stiffness * ways + free_bodies.COUPLING.damping * rates
    np.testing.assert_allclose(force, law, atol=2e-4)
    assert np.abs(force).max(axis=0) == pytest.approx([1.5, 0.0, 5.0], rel=0.01)
    with pytest.raises(StudyError, match="it would not rest"):
        resting_bodies.Stack(Coupling(1e5, 1.0, 0.0, 0.0), GRID, GRID)


def test_leaning_on_a_stack_is_judged_by_the_ways_of_its_top(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    held = open_workload("stack", Extent(GRID, 1e-3))
    rigid, soft = (
        held.run(Setting(METHODS["lossless"].with_contact(contact), 1e-3)).scores()["leaning"]
        for contact in ("rigid", "scene")
    )
    assert rigid.verdict == "strict"
    assert rigid.position_peak < 5e-6
    assert rigid.jnd < 0.05
    assert soft.jnd > 10 * rigid.jnd  # MuJoCo's friction creeps
    with pytest.raises(Exception, match="leans by no spring"):
        held.run(Setting(METHODS["weld"], 1e-3))
    # 1.5 N on boxes that hold each other with 0.1 (5 N + 1 N)
    sliding = open_workload("stack", Extent(GRID, 1e-3))
    monkeypatch.setattr(resting_bodies, "BOX_FRICTION", 0.1)
    assert score(sliding, "lossless", 1e-3).jnd > 1.0


def corners_in_socket(place: np.ndarray) -> np.ndarray:
    """Returns the gaps of six corners to six walls in mm, at x and y in mm and an angle."""
    apothem = 1e3 * resting_bodies.APOTHEM
    sixths = np.pi / 3 * np.arange(6)
    corner = np.pi / 6 + sixths + place[2]
    radius = 2 * apothem / np.sqrt(3)
    points = place[:2] + radius * np.column_stack([np.cos(corner), np.sin(corner)])
    normals = np.column_stack([np.cos(sixths), np.sin(sixths)])
    return np.asarray(apothem + 1e3 * resting_bodies.CLEARANCE - points @ normals.T).ravel()


def test_key_rests_where_the_energy_of_the_coupling_is_least() -> None:
    coupling = resting_bodies.KEY_COUPLING
    for (turn, *across), row in zip(
        resting_bodies.TURNS, resting_bodies.turned_key(coupling), strict=True
    ):

        def energy(
            place: np.ndarray, turn: float = turn, across: tuple[float, ...] = tuple(across)
        ) -> float:
            stretch = np.array(across) - 1e-3 * place[:2]
            twist = turn - place[2]
            spring = coupling.stiffness * stretch @ stretch
            return float(1e3 * (spring + coupling.rotational_stiffness * twist**2))

        found = minimize(
            energy,
            [0.01, -0.01, 0.0],
            method="SLSQP",
            constraints={"type": "ineq", "fun": corners_in_socket},
            options={"ftol": 1e-14},
        )
        assert found.x == pytest.approx([0.0, 0.0, np.sign(turn) * resting_bodies.play()], abs=1e-6)
        force = coupling.stiffness * (np.array(across) - 1e-3 * found.x[:2])
        assert row["wrench_on_tool"][:2] == pytest.approx(force, abs=1e-5)
        torque = coupling.rotational_stiffness * (turn - found.x[2])
        assert row["wrench_on_tool"][5] == pytest.approx(torque, abs=1e-6)
        turned = Rotation.from_quat(row["tool_quaternion"], scalar_first=True).as_rotvec()
        assert turned == pytest.approx([0.0, 0.0, found.x[2]], abs=1e-6)


def test_key_that_turns_freely_or_leaves_the_middle_is_refused() -> None:
    with pytest.raises(StudyError, match="turns freely"):
        resting_bodies.play(5e-3, 0.8e-3)
    for weak in (Coupling(1000.0, 1.0, 1e-3, 0.0), Coupling(1e6, 1.0, 1.0, 0.0)):
        with pytest.raises(StudyError, match="does not keep the key in the middle"):
            resting_bodies.HexSocket(weak, GRID, GRID)


def test_turned_key_is_judged_by_its_play(monkeypatch: pytest.MonkeyPatch) -> None:
    rigid = score(open_workload("hex_socket", Extent(GRID, 1e-3)), "lossless", 1e-3)
    assert rigid.verdict == "strict"
    assert rigid.angle_peak < 1e-4
    assert rigid.jnd < 0.01
    wider = open_workload("hex_socket", Extent(GRID, 1e-3))
    monkeypatch.setattr(resting_bodies, "CLEARANCE", 0.1e-3)
    assert score(wider, "lossless", 1e-3).jnd > 0.5


FINE = (5e-4, 2.5e-4, 1.25e-4)


@lru_cache
def driven() -> Workload:
    """Returns the driven mass, made once."""
    return open_workload("point_mass", Extent(GRID, FINE[-1]))


@lru_cache
def spinning() -> Workload:
    """Returns the spinning body, made once."""
    return open_workload("spinning_body", Extent(GRID, FINE[-1]))


def score(workload: Workload, method: str, period: float) -> Score:
    """Returns the score in the first panel."""
    run = workload.run(Setting(METHODS[method], period))
    return run.scores()[workload.panels[0].key]


def order(errors: list[float], periods: tuple[float, ...] = FINE) -> float:
    """Returns the power of the period that the errors go with."""
    return float(np.polyfit(np.log(periods), np.log(errors), 1)[0])


def test_rk4_turns_a_free_body_with_fourth_order_and_euler_with_first() -> None:
    periods = (4e-3, 2e-3, 1e-3)
    # the energy of a step is one order better than the motion; five is what rk4 leaves of four
    rk4 = [score(spinning(), "explicit:rk4", period).energy for period in periods]
    assert 3.8 < order(rk4, periods) < 5.2
    # the motion itself, above what the reference errs by
    periods = (8e-3, 4e-3, 2e-3)
    workload = open_workload("spinning_body", Extent(periods[0], periods[-1]))
    found = [score(workload, "explicit:rk4", period) for period in periods]
    assert order([each.angle_peak for each in found], periods) == pytest.approx(4, abs=0.3)
    assert order([each.jnd for each in found], periods) == pytest.approx(4, abs=0.3)
    euler = [score(spinning(), "explicit", period).angle_peak for period in FINE]
    assert order(euler) == pytest.approx(1, abs=0.05)
    lossless = [score(spinning(), "lossless", period).angle_peak for period in FINE]
    assert order(lossless) == pytest.approx(2, abs=0.05)


def test_energy_alone_would_not_tell_a_wrong_spin() -> None:
    # implicitfast loses energy and Euler creates it, the error of the angle is the same
    lossy, active = (score(spinning(), name, 1e-3) for name in ("implicitfast", "explicit"))
    assert lossy.verdict == "strict"
    assert active.verdict == "active"
    assert lossy.jnd == pytest.approx(active.jnd, rel=0.02)


def test_coupling_that_would_turn_the_spinning_body_is_refused() -> None:
    with pytest.raises(Exception, match="free to turn"):
        free_bodies.SpinningBody(COUPLING, GRID, FINE[-1])


def test_methods_without_dynamics_of_the_tool_can_neither_spin_nor_fall() -> None:
    falling = contact_bodies.RodImpact(contact_bodies.ROD_COUPLING, GRID)
    for name in ("weld", "direct"):
        with pytest.raises(Exception, match="lets no tool turn"):
            spinning().run(Setting(METHODS[name], 1e-3))
        with pytest.raises(Exception, match="lets no tool fall"):
            falling.run(Setting(METHODS[name], 1e-3))


OF_THE_SCENE = METHODS["implicit"].with_contact("scene")


def test_rod_that_meets_a_damped_or_rigid_contact_is_nearer_to_an_impact_without_rebound() -> None:
    workload = contact_bodies.RodImpact(contact_bodies.ROD_COUPLING, GRID)
    key = workload.panels[0].key
    shipped = workload.run(Setting(OF_THE_SCENE, 1e-3)).scores()[key]
    damped = workload.run(Setting(OF_THE_SCENE, 1e-3, contact="damped")).scores()[key]
    rigid = workload.run(Setting(METHODS["implicit"], 1e-3)).scores()[key]
    assert damped.jnd < shipped.jnd / 2
    # a step solves for the velocities at its end, Routh's impulse follows the way there
    assert rigid.jnd < min(damped.jnd, 1.0)


@lru_cache
def quick_peg() -> peg.PegInHole:
    """Returns the peg, with a reference that is quick rather than fine."""
    return peg.PegInHole(peg.COUPLING, GRID, 1e-3, refinement=4)


def test_settled_peg_is_nearer_to_the_rigid_one_the_stiffer_its_contacts() -> None:
    stiff, soft = (
        quick_peg().run(Setting(OF_THE_SCENE, 1e-3, contact=contact)).scores()["settled"]
        for contact in ("2 steps", "soft")
    )
    rigid = quick_peg().run(Setting(METHODS["implicit"], 1e-3)).scores()["settled"]
    assert rigid.position_peak < 2e-7
    assert stiff.position_peak < 2e-5
    assert stiff.jnd < 0.2
    assert abs(stiff.stiffness) < 0.02
    assert soft.position_peak > 10 * stiff.position_peak
    assert soft.jnd > 1


def test_jammed_peg_gains_energy_from_the_contacts_of_the_scene_and_none_from_rigid_ones() -> None:
    jam = peg.JammedPeg(mass=0.03, friction=0.0, stiffness=6000.0, hand=1)
    rigid, stock = (
        jam.take(Setting(METHODS["implicit"].with_contact(contact), 1e-3))
        for contact in ("rigid", "scene")
    )
    assert (rigid.environment, rigid.created) == ("strict", 0.0)
    assert stock.environment == "active"
    assert stock.created > 0.01
    assert peg.penetrations(rigid.records).max() < 3e-5
    assert peg.penetrations(stock.records).max() > 5e-4


def test_penetration_of_a_peg_is_that_of_its_deepest_corner() -> None:
    records = np.zeros(3, TICK_DTYPE)
    records["tool_quaternion"][:, 0] = 1.0
    records["tool_position"][1] = (peg.CLEARANCE + 1e-5, 0.0, 0.0)
    # turned about its upright axis, a corner moves out by w (cos a + sin a − 1)
    angle = 0.1
    records["tool_quaternion"][2] = (np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2))
    turned = peg.HALF_WIDTH * (np.cos(angle) + np.sin(angle) - 1) - peg.CLEARANCE
    assert peg.penetrations(records) == pytest.approx([0.0, 1e-5, turned], abs=1e-12)


def test_peg_that_never_reaches_its_hole_has_lost_contact() -> None:
    run = quick_peg().run(Setting(METHODS["explicit:implicitfast"], 4e-3))
    assert run.scores()["settled"].verdict in ("lost contact", "diverged")


def test_methods_agree_on_where_the_moving_peg_goes_in_the_limit() -> None:
    for name in ("implicit", "explicit", "weld"):
        quick_peg().run(Setting(METHODS[name], 2e-3)).scores()
    references = quick_peg().references
    assert isinstance(references, OwnReferences)
    apart = references.disagreement()
    assert apart["explicit"] < 0.3
    assert apart["implicit"] == 0.0  # the one with rigid contacts
    assert apart["weld"] > 3  # another stiffness than was asked for: converged, and not to the same


def test_measured_points_carry_how_far_the_limit_of_their_method_lies() -> None:
    workload = peg.PegInHole(peg.COUPLING, GRID, GRID, refinement=2)
    settings = [Setting(METHODS[name], GRID) for name in ("implicit", "weld")]
    found = measure_chart(workload, settings, repeats=1)
    apart = {
        (each.panel, each.setting.method.name): each.limit_apart for each in found.measurements
    }
    assert apart["moving", "implicit"] == 0.0
    assert apart["moving", "weld"] > 3
    # the settled peg is compared with one truth
    assert apart["settled", "weld"] == apart["settled", "implicit"] == 0.0
    assert "implicit, in JND: weld" in found.notes[0]


@pytest.mark.parametrize("method", ["implicit", "compensated", "implicitfast", "explicit"])
def test_sliding_block_converges_to_the_closed_form(method: str) -> None:
    workload = open_workload("sliding_block", Extent(GRID, FINE[-1]))
    coarse, fine = (score(workload, method, period) for period in (1e-3, 2.5e-4))
    assert fine.jnd < coarse.jnd / 2
    assert fine.position_peak < 3e-5
    assert fine.verdict == "strict"


def test_reference_of_a_scene_is_said_to_be_no_truth() -> None:
    workload = open_workload("virtual_wall", Extent(GRID, 1e-3))
    assert not workload.panels[0].is_truth
    found = [score(workload, "implicit", period).jnd for period in (4e-3, 1e-3)]
    assert found[1] < found[0]
    with pytest.raises(Exception, match="no reference that is true for every engine"):
        workload.peer_work()


def test_arm_without_damping_of_its_own_swings_as_its_small_angles_do(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(free_bodies, "ARM_DAMPING", 0.0)
    monkeypatch.setattr(free_bodies, "AMPLITUDE", 1e-6)
    coupling = Coupling(1000.0, 0.0, 0.0, 0.0)
    found = free_bodies.exact_arm(coupling, 1e-3, 300)["tool_position"][:, 1]
    length, omega = free_bodies.ARM_LENGTH, 2 * np.pi * free_bodies.FREQUENCY
    own = (free_bodies.ARM_STIFFNESS + 1000 * length**2) / free_bodies.ARM_INERTIA
    drive = 1000 * length * 1e-6 / free_bodies.ARM_INERTIA
    # q'' + own q = drive (1 - cos wt), from rest
    time = 1e-3 * np.arange(1.0, 301.0)
    forced = drive / own - drive / (own - omega**2) * np.cos(omega * time)
    free = (drive / (own - omega**2) - drive / own) * np.cos(np.sqrt(own) * time)
    np.testing.assert_allclose(found, length * (forced + free), atol=1e-11)


def test_taps_obey_newton_away_from_the_wall_and_never_enter_it() -> None:
    coupling, step = free_bodies.COUPLING, 1e-5
    times = step * np.arange(1.0, 1e5 + 1)
    place, force = contact_bodies.exact_taps(coupling, times)
    assert place.max() == pytest.approx(contact_bodies.GAP, abs=1e-12)
    acceleration = (place[2:] - 2 * place[1:-1] + place[:-2]) / step**2
    is_free = place < contact_bodies.GAP - 1e-6
    inner = is_free[2:] & is_free[1:-1] & is_free[:-2]
    error = contact_bodies.TAP_MASS * acceleration[inner] - force[1:-1][inner]
    assert np.abs(error).max() < 2e-4
    # the wall is left where the coupling pulls, and only there
    resting = np.abs(place - contact_bodies.GAP) < 1e-12
    assert force[resting].min() > -1e-3
    assert np.count_nonzero(np.diff(resting.astype(int)) == 1) >= 3


@pytest.mark.parametrize("name", ["spring_arm", "tap"])
def test_errors_of_the_default_fall_with_the_step_towards_the_closed_form(name: str) -> None:
    workload = open_workload(name, Extent(GRID, 2.5e-4))
    (panel,) = workload.panels
    found = [
        workload.run(Setting(METHODS["lossless"], period)).scores()[panel.key]
        for period in (4e-3, 1e-3, 2.5e-4)
    ]
    assert {score.verdict for score in found} == {"strict"}
    assert found[1].jnd < 0.4 * found[0].jnd
    assert found[2].jnd < 0.4 * found[1].jnd < 0.2


def test_jam_is_as_wrong_as_the_peg_is_deep_inside_the_walls() -> None:
    workload = open_workload("jam", Extent(GRID, 1e-3))
    (panel,) = workload.panels
    rigid, soft = (
        workload.run(
            Setting(METHODS["lossless"].with_contact(contact), 1e-3, contact=solref)
        ).scores()[panel.key]
        for contact, solref in (("rigid", "as shipped"), ("scene", "soft"))
    )
    assert rigid.verdict == "strict"
    assert rigid.position_peak < 5e-6
    assert rigid.jnd < 0.01
    assert soft.position_peak > 1e-4
    assert soft.jnd > 0.1


def test_scene_that_steps_less_often_is_compared_with_one_that_steps_in_every_tick() -> None:
    workload = SceneRates("virtual_wall", "wall_rates")
    found = {
        setting.label: workload.run(setting).scores()["rates"]
        for setting in rate_settings()
        if setting.method.name == "lossless"
    }
    assert found["lossless, 1 ms"].jnd == 0.0
    fast, slow, slowest = (found[f"lossless, 1 ms, scene at {hz} Hz"].jnd for hz in (500, 100, 50))
    assert 0.0 < fast < slow < slowest
    # a loop as slow as the scene, which holds its force, is worse than one of 1 kHz beside it
    assert found["lossless, 10 ms"].jnd > 1.5 * slow
    assert {score.verdict for score in found.values()} == {"strict"}
