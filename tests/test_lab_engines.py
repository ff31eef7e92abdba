"""Every installed engine against what is known in closed form; the others are skipped by name."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from engine_tasks import (
    AMPLITUDE,
    COUPLING,
    EDGE,
    FLOOR,
    GRAVITY,
    HERE,
    MASS,
    RESTING,
    driven_error,
    driven_mass,
    driven_path,
    opened,
)
from scipy.spatial.transform import Rotation

from hapticbridge.coupling import Coupling
from hapticbridge.device.trajectory import Motion
from hapticbridge.errors import StudyError
from hapticbridge.kernel.pose import quaternion_exp
from hapticbridge.lab.engines.base import (
    ENGINES,
    Body,
    Contacts,
    Engine,
    FreeBody,
    Pose,
    Shape,
    Simulation,
    Task,
    Velocity,
    composed,
)
from hapticbridge.theory.rigid_body import CoupledStepRule, drive_mass, integrate_rotation

NOTHING = (0.0, 0.0, 0.0)
FRAME = Pose((0.01, -0.02, 0.03), quaternion_exp((0.3, -0.5, 0.7)))
START = Pose((0.1, 0.2, 0.3), quaternion_exp((-0.4, 0.2, 0.9)))
SINGLE_PRECISION = {"mujoco_warp", "newton_xpbd", "newton_steel", "physx", "physx_spring", "rapier"}
PARTS = {"rapier": 8}
"""Parts into which an engine divides a step under a held force, where more than one."""
SPRINGS = {"ode_spring", "physx_spring"}
"""Engines whose coupling is a spring of their own, solved with the contacts."""


@pytest.fixture(params=HERE.available)
def engine(request: pytest.FixtureRequest) -> Engine:
    return HERE.available[request.param]


@pytest.mark.parametrize("name", ENGINES)
def test_engine_is_installed_under_its_name(name: str) -> None:
    if name in HERE.missing:
        pytest.skip(HERE.missing[name])
    assert HERE.available[name].name == name


def turn(quaternion: tuple[float, ...]) -> Rotation:
    return Rotation.from_quat(quaternion, scalar_first=True)


def coast(simulation: Simulation, steps: int) -> None:
    for _ in range(steps):
        simulation.advance(NOTHING, NOTHING)


def test_a_tool_falls_as_half_g_t_squared_to_first_order(engine: Engine) -> None:
    task = Task("fall", Body(0.3, (1e-3, 2e-3, 2.5e-3)), gravity=(0.0, 0.0, -GRAVITY))
    errors = []
    for timestep in (2e-3, 1e-3):
        with opened(engine, task, timestep) as simulation:
            coast(simulation, round(0.2 / timestep))
            errors.append(simulation.pose().position[2] + 0.5 * GRAVITY * 0.2**2)
            rounding = 5e-5 if engine.name in PARTS else 1e-5
            assert simulation.velocity().linear[2] == pytest.approx(-GRAVITY * 0.2, rel=rounding)
    # a step that takes the new velocity is ahead by half a step's fall
    # (single precision rounds by 2 µm in 0.2 s)
    ahead = 0.5 * GRAVITY * 0.2 / PARTS.get(engine.name, 1)
    assert errors == pytest.approx([-ahead * t for t in (2e-3, 1e-3)], rel=0.02)


def test_a_driven_mass_follows_its_scheme_and_the_closed_form(engine: Engine) -> None:
    handle = driven_mass(1e-3)[1]
    scheme: CoupledStepRule = "implicit" if engine.name in SPRINGS else "held"
    expected = drive_mass(COUPLING, MASS, handle, 1e-3, scheme).position
    # PhysX solves its spring in parts of a step, so it lies between the two schemes; Rapier every
    # force, so that it is nearer to an exact hold
    apart = dict.fromkeys(SINGLE_PRECISION, 1e-5) | {"physx_spring": 0.05, "rapier": 0.02}
    allowed = apart.get(engine.name, 1e-12) * AMPLITUDE
    assert np.abs(driven_path(engine, 1e-3) - expected).max() < allowed
    coarse, fine = driven_error(engine, 2e-3), driven_error(engine, 1e-3)
    is_divided = engine.name in SPRINGS or engine.name in PARTS
    assert fine < (0.02 if is_divided else 0.002)
    # first order; PhysX divides a step into as many parts whatever its length
    assert coarse / fine == pytest.approx(2, rel=0.25 if engine.name in SPRINGS else 0.1)


@pytest.mark.parametrize("name", sorted(SPRINGS & HERE.available.keys()))
def test_a_spring_of_the_engines_own_turns_the_tool_as_the_implicit_scheme(name: str) -> None:
    engine, moment = HERE.available[name], 1e-3
    coupling = replace(COUPLING, rotational_damping=0.05)
    times = np.arange(201) * 1e-3
    angles = 0.2 * np.sin(4 * np.pi * times)
    turns = [quaternion_exp((0.0, 0.0, angle)) for angle in angles]
    motion = Motion(times, np.zeros((201, 3)), turns)
    task = Task("turn", Body(1.0, (moment,) * 3), coupling=coupling, handle=motion)
    reached = [0.0]
    with opened(engine, task, 1e-3) as simulation:
        for pose in task.handle_poses(1e-3, 200)[1:]:
            simulation.step(*pose)
            reached.append(float(turn(simulation.pose().quaternion).as_rotvec()[2]))
    about = Coupling(coupling.rotational_stiffness, coupling.rotational_damping, 0.0, 0.0)
    expected = drive_mass(about, moment, angles, 1e-3, "implicit").position
    apart = 0.02 if name in SINGLE_PRECISION else 1e-9
    assert np.abs(np.array(reached) - expected).max() < apart * 0.2


def test_a_wrong_mass_shows_as_a_worse_error(engine: Engine) -> None:
    # a spring's own damping hides more of it
    times = 1.3 if engine.name in SPRINGS else 5
    assert driven_error(engine, 1e-3, mass=1.1 * MASS) > times * driven_error(engine, 1e-3)


GAINS = {
    "mujoco": (-0.2, 0.0),
    "mujoco_warp": (-0.2, 0.0),
    "newton_xpbd": (0.0, 0.25),
    "newton_steel": (-0.2, 0.0),
    "ode": (-0.2, 0.0),
    "ode_spring": (-0.2, 0.0),
    "physx": (0.0, 0.02),
    "physx_spring": (0.0, 0.02),
    "rapier": (0.0, 0.25),
    "pybullet": (0.0, 0.25),
    "pybullet_dantzig": (0.0, 0.25),
    "drake_point": (0.0, 0.25),
    "drake_hydroelastic": (0.0, 0.25),
}
"""Relative gain of energy in a second at 50 rad/s: explicit Euler gains, ODE's gyroscopic term is
implicit and loses, PhysX's is iterated."""


def test_a_spinning_tool_turns_as_euler_says_to_its_engines_order(engine: Engine) -> None:
    inertia = (1e-4, 2e-4, 2.5e-4)
    rate = 50 * np.array([0.5, 0.7, 0.5]) / np.linalg.norm([0.5, 0.7, 0.5])
    task = Task("spin", Body(0.1, inertia), start_velocity=Velocity(NOTHING, tuple(rate)))
    exact = integrate_rotation(inertia, rate, 1e-4, 1000, "midpoint")
    truth = turn(tuple(exact.orientation[-1]))
    errors = []
    for timestep in (1e-3, 5e-4):
        with opened(engine, task, timestep) as simulation:
            coast(simulation, round(0.1 / timestep))
            errors.append((truth.inv() * turn(simulation.pose().quaternion)).magnitude())
    assert errors[0] < 0.2
    assert errors[0] / errors[1] == pytest.approx(2, rel=0.2)
    with opened(engine, task, 1e-3) as simulation:
        coast(simulation, 1000)
        local = turn(simulation.pose().quaternion).inv().apply(simulation.velocity().angular)
    gain = np.sum(inertia * local**2) / np.sum(inertia * rate**2) - 1
    least, most = GAINS[engine.name]
    assert least < gain < most


def test_force_and_torque_act_at_the_centre_of_mass_in_the_world_frame(engine: Engine) -> None:
    moments, mass = (1e-4, 2e-4, 2.5e-4), 0.2
    task = Task("push", Body(mass, moments, FRAME), start=START)
    force, torque = np.array([0.3, -0.2, 0.1]), np.array([1e-3, 2e-3, -3e-3])
    with opened(engine, task, 1e-3) as simulation:
        assert simulation.pose().position == pytest.approx(START.position, abs=1e-7)
        assert simulation.pose().quaternion == pytest.approx(START.quaternion, abs=1e-6)
        simulation.advance(tuple(force), tuple(torque))
        velocity = simulation.velocity()
    axes = (turn(START.quaternion) * turn(FRAME.quaternion)).as_matrix()
    spin = axes @ (axes.T @ torque / moments) * 1e-3
    # single precision, and in MuJoCo the centre's lever that turns within the step
    assert np.array(velocity.linear) == pytest.approx(force / mass * 1e-3, rel=1e-4)
    assert np.array(velocity.angular) == pytest.approx(spin, rel=1e-4)


def test_a_moving_tool_starts_with_the_velocity_of_its_centre(engine: Engine) -> None:
    velocity = Velocity((0.1, -0.2, 0.3), (1.0, 2.0, -3.0))
    task = Task("move", Body(0.2, (2e-4,) * 3, FRAME), start=START, start_velocity=velocity)
    with opened(engine, task, 1e-4) as simulation:
        assert simulation.velocity().linear == pytest.approx(velocity.linear, rel=1e-6)
        assert simulation.velocity().angular == pytest.approx(velocity.angular, rel=1e-6)
        coast(simulation, 100)
        pose = simulation.pose()
    before = START.position + turn(START.quaternion).apply(FRAME.position)
    after = pose.position + turn(pose.quaternion).apply(FRAME.position)
    # in single precision each part of a step rounds the position by up to 15 nm
    rounding = 1e-5 if engine.name in PARTS else 2e-6
    assert after - before == pytest.approx(0.01 * np.array(velocity.linear), abs=rounding)


@pytest.mark.parametrize("kind", RESTING)
def test_a_shape_rests_on_the_floor(engine: Engine, kind: str) -> None:
    shape, height = RESTING[kind]
    # the body's frame and the principal axes are not the shape's: only the shape may matter
    frame = Pose((0.0, 0.0, 0.002), quaternion_exp((0.0, 0.0, 0.4)))
    body = Body(0.1, (2e-5, 2.5e-5, 3e-5), frame, (shape,), friction=0.5)
    start = Pose((0.0, 0.0, height + 1e-5))
    task = Task("rest", body, (FLOOR,), (0.0, 0.0, -GRAVITY), start=start)
    if kind == "mesh" and engine.name.startswith("ode"):
        with pytest.raises(StudyError, match="has a mesh"):
            engine.open(task, 1e-3)
        return
    with opened(engine, task, 1e-3) as simulation:
        coast(simulation, 200)
        contacts = simulation.contacts()
        # 1 N sinks into the softest engine's contact by 60 µm; a wrong axis or margin is 1 mm
        assert simulation.pose().position[2] == pytest.approx(height, abs=1e-4)
    assert contacts.points >= 1
    assert 0 <= contacts.depth < 1e-4


def test_a_box_rests_on_another_body_and_on_the_floor_beside_it(engine: Engine) -> None:
    def box(mass: float) -> Body:
        frame = Pose((0.0, 0.0, 0.002), quaternion_exp((0.0, 0.0, 0.4)))
        shapes = (Shape("box", (0.03, 0.025, EDGE)),)
        return Body(mass, (2e-5, 2.5e-5, 3e-5), frame, shapes, friction=0.5)

    below, beside = Pose((0.0, 0.0, EDGE)), Pose((0.1, 0.0, EDGE), quaternion_exp((0.0, 0.0, 0.3)))
    start = Pose((0.005, 0.0, 3 * EDGE))
    others = (FreeBody(box(0.3), below), FreeBody(box(0.1), beside))
    task = Task("pile", box(0.1), (FLOOR,), (0.0, 0.0, -GRAVITY), start=start, others=others)
    with opened(engine, task, 1e-3) as simulation:
        for number, pose in enumerate((start, below, beside)):
            assert simulation.pose(number).position == pytest.approx(pose.position, abs=1e-7)
        coast(simulation, 200)
        is_rocking = engine.name == "drake_point"  # on its one point under a box
        assert is_rocking or simulation.contacts().points >= 3
        for number, pose in enumerate((start, below, beside)):
            if is_rocking and number == 0:
                continue
            found = simulation.pose(number)
            assert found.position == pytest.approx(pose.position, abs=3e-4)
            assert abs(np.dot(found.quaternion, pose.quaternion)) == pytest.approx(1, abs=1e-4)
            assert simulation.velocity(number).linear == pytest.approx(NOTHING, abs=5e-3)


def test_other_bodies_fall_beside_the_tool(engine: Engine) -> None:
    other = FreeBody(Body(0.5, (1e-3, 2e-3, 2.5e-3), FRAME), START)
    gravity = (0.0, 0.0, -GRAVITY)
    task = Task("fall", Body(0.3, (1e-3, 2e-3, 2.5e-3)), gravity=gravity, others=(other,))
    push = (0.3 * 5.0, 0.0, 0.0)
    with opened(engine, task, 1e-3) as simulation:
        assert simulation.pose(1).quaternion == pytest.approx(START.quaternion, abs=1e-6)
        for _ in range(100):
            simulation.advance(push, NOTHING)
        assert simulation.velocity().linear == pytest.approx((0.5, 0, -0.1 * GRAVITY), rel=1e-4)
        # the push is the tool's alone
        assert simulation.velocity(1).linear == pytest.approx((0, 0, -0.1 * GRAVITY), rel=1e-4)
        fallen = START.position[2] - simulation.pose(1).position[2]
        assert fallen == pytest.approx(-simulation.pose().position[2], abs=1e-5)


def test_a_block_slides_beyond_its_friction_and_not_below(engine: Engine) -> None:
    friction, mass = 0.4, 0.1
    body = Body(mass, (5e-5,) * 3, shapes=(Shape("box", (0.03, 0.03, EDGE)),), friction=friction)
    start = Pose((0.0, 0.0, EDGE))
    task = Task("slide", body, (FLOOR,), (0.0, 0.0, -GRAVITY), start=start)
    for share, speed in ((0.7, 0.0), (1.5, 0.5 * friction * GRAVITY * 0.1)):
        push = (share * friction * mass * GRAVITY, 0.0, 0.0)
        with opened(engine, task, 1e-3) as simulation:
            for _ in range(100):
                simulation.advance(push, (0.0, EDGE * push[0] * -1, 0.0))
            reached = simulation.velocity().linear[0]
        # who regularises sticking creeps; on Drake's one point under a box it rocks
        creep = 0.03 if engine.name == "drake_point" else 5e-3
        assert reached == pytest.approx(speed, rel=0.1, abs=creep)


def test_the_wrench_is_the_couplings(engine: Engine) -> None:
    grip = Pose((0.01, 0.02, -0.03), quaternion_exp((0.1, 0.2, -0.3)))
    task = Task("hold", Body(0.2, (2e-4,) * 3), coupling=COUPLING, grip=grip, start=START)
    handle = Pose((0.12, 0.19, 0.28), quaternion_exp((-0.1, 0.3, 0.5)))

    def grip_of(pose: Pose) -> tuple[np.ndarray, Rotation]:
        body = turn(pose.quaternion)
        return pose.position + body.apply(grip.position), body * turn(grip.quaternion)

    with opened(engine, task, 1e-3) as simulation:
        before = grip_of(simulation.pose())
        assert np.abs(simulation.wrench()).max() < 1e-3  # the handle rests at the grip
        simulation.step(*handle)
        after = grip_of(simulation.pose())
        wrench = simulation.wrench()
    h_before, h_after = before[1], turn(handle.quaternion)
    moved = (np.array(handle.position) - before[0]) - (after[0] - before[0])
    force = COUPLING.stiffness * (handle.position - after[0]) + COUPLING.damping / 1e-3 * moved
    turned = (h_after * h_before.inv()).as_rotvec() - (after[1] * before[1].inv()).as_rotvec()
    torque = COUPLING.rotational_stiffness * (h_after * after[1].inv()).as_rotvec()
    torque += COUPLING.rotational_damping / 1e-3 * turned
    assert wrench.force == pytest.approx(force, rel=1e-5, abs=1e-3)
    assert wrench.torque == pytest.approx(torque, rel=1e-5, abs=1e-3)


def test_a_pull_off_the_centre_turns_the_tool(engine: Engine) -> None:
    mass, moment = 0.2, 2e-3
    frame, grip = Pose((0.01, 0.0, 0.0)), Pose((0.0, 0.05, 0.02))
    body = Body(mass, (moment,) * 3, frame)
    task = Task("pull", body, coupling=COUPLING, grip=grip, start=START)
    away = tuple(np.add(composed(START, grip).position, (1e-3, 0.0, 2e-3)))
    handle = away, composed(START, grip).quaternion
    with opened(engine, task, 1e-4) as simulation:
        simulation.step(*handle)
        wrench = simulation.wrench()
        if engine.name not in SPRINGS:  # what is held acts in the next step
            simulation.step(*handle)
        velocity, pose = simulation.velocity(), simulation.pose()
    lever = composed(pose, grip).position - np.array(composed(pose, frame).position)
    torque = wrench.torque + np.cross(lever, wrench.force)
    # an engine's own spring takes part of its force back within the step
    share = 0.1 if engine.name in SPRINGS else 1e-3
    speed, spin = np.array(wrench.force) / mass * 1e-4, torque / moment * 1e-4
    assert np.linalg.norm(velocity.linear - speed) < share * np.linalg.norm(speed)
    assert np.linalg.norm(velocity.angular - spin) < share * np.linalg.norm(spin)


def test_a_task_can_be_closed_twice(engine: Engine) -> None:
    task = Task("free", Body(1.0, (1.0,) * 3))
    simulation = engine.open(task, 1e-3)
    simulation.close()
    simulation.close()


def test_two_simulations_of_one_engine_do_not_meet(engine: Engine) -> None:
    task = Task("free", Body(1.0, (1.0,) * 3), gravity=(0.0, 0.0, -GRAVITY))
    with (
        opened(engine, task, 1e-3) as first,
        opened(engine, replace(task, gravity=NOTHING), 2e-3) as second,
    ):
        for simulation in (first, second, first):
            simulation.advance(NOTHING, NOTHING)
        assert first.velocity().linear[2] == pytest.approx(-2e-3 * GRAVITY, rel=1e-5)
        assert second.velocity().linear[2] == 0


def test_contacts_count_what_touches() -> None:
    assert Contacts.from_depths([]) == (0, 0.0)
    assert Contacts.from_depths([-1e-3, 0.0, 2e-6]) == (2, 2e-6)


@pytest.mark.parametrize("name", {"drake_point"} & HERE.available.keys())
def test_drake_says_nan_where_it_refuses_to_go_on(name: str) -> None:
    engine = HERE.available[name]
    with opened(engine, Task("free", Body(1.0, (1.0,) * 3)), 1e-3) as simulation:
        simulation.advance((float("inf"), 0.0, 0.0), NOTHING)
        simulation.advance(NOTHING, NOTHING)
        assert np.isnan(simulation.pose().position).all()
        assert np.isnan(simulation.velocity().linear).all()
        assert simulation.contacts().points == 0
