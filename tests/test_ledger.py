"""The energy ledger, port by port, each against a balance that does not use the port's formula.

On slide joints implicit Euler obeys, to rounding,

    S_k − S_{k−1} = Σ works − ½‖v_k − v_{k−1}‖²_M − ½‖q_k − q_{k−1}‖²_{springs}

so ``environment_energy`` must be the two last terms, which need nothing but speeds and masses. On
hinges M depends on the pose and the same holds to first order in the period; there a fourth-order
Runge–Kutta integration of the same scene is the reference.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from kernel_runs import (
    FREE_BALL,
    Array,
    Run,
    T,
    at_rest,
    coupling_work,
    fast,
    live,
    load,
    mjcf,
    samples_of,
    sines,
    slack,
    turns,
)
from ledger_scenes import ARM, GRAVITY, MASSES, ROPE, SLIDER, SOLID, Witness
from scipy.spatial.transform import Rotation

from hapticbridge.coupling import Coupling
from hapticbridge.kernel.ledger import ENERGY_TOLERANCE


def test_joint_spring_stores_what_the_coupling_puts_in() -> None:
    stiffness, damping = 300.0, 0.7
    spring = f'stiffness="{stiffness}" damping="{damping}"'
    world = SLIDER.replace('axis="1 0 0"/>', f'axis="1 0 0" {spring}/>')
    witness = Witness()
    run = live(mjcf(world), samples_of(sines(1000)), after_tick=witness)
    x = np.array(witness.qpos)[:, 0]
    assert run.ticks["potential"] == pytest.approx(0.5 * stiffness * x**2, abs=1e-15)
    assert run.ticks["potential"].max() > 1e-3
    moved = witness.changes(witness.qpos)[:, 0]
    lost = 0.5 * stiffness * np.cumsum(moved**2) + damping / T * np.cumsum(moved**2)
    lost += witness.lost(MASSES[:1])
    assert run.ticks["environment_energy"] == pytest.approx(-lost, abs=1e-13)


def test_a_pendulum_loses_what_the_implicit_step_dissipates() -> None:
    world = SLIDER + ARM

    def drift(period: float) -> float:
        # released from the horizontal
        run = live(mjcf(world, option=GRAVITY), at_rest(round(0.5 / period)), period=period)
        assert run.ticks["kinetic"].max() > 0.5
        return float(run.ledger.environment_energy / run.ticks["kinetic"].max())

    coarse, fine = drift(T), drift(T / 4)
    assert abs(coarse) < 0.03
    assert abs(fine) < 0.4 * abs(coarse)


RICH = f"""
    <body name="tool" pos="0 0 0.2"><joint type="slide" axis="1 0 0" stiffness="20"/>
      <joint type="hinge" axis="0 1 0" stiffness="0.3"/>
      <geom type="box" size="0.02 0.03 0.04" mass="0.1" pos="0.02 0 0"/><site name="grip"/>
      <site name="b"/>
    </body>
    <body name="m" mocap="true" pos="0 0.5 0.5"><site name="a"/></body>
    <geom type="plane" size="1 1 0.1" {SOLID}/>
    <body pos="0.4 0 0.1"><freejoint/><geom type="box" size="0.02 0.03 0.04" mass="0.2" {SOLID}/>
    </body>{ARM}"""


@pytest.mark.parametrize("substeps", [1, 3])
def test_recorded_storage_is_that_of_the_state_after_the_step(substeps: int) -> None:
    """By another route: a second MjData at the same state, and all of ``mj_forward``."""
    scene = load(mjcf(RICH, ROPE.format('stiffness="30" springlength="0.1"'), GRAVITY))
    fresh = mujoco.MjData(scene.model)
    expected, before = [], []

    def look(_tick: int, data: Any) -> None:
        fresh.qpos[:], fresh.qvel[:] = data.qpos, data.qvel
        fresh.mocap_pos[:], fresh.mocap_quat[:] = data.mocap_pos, data.mocap_quat
        mujoco.mj_forward(scene.model, fresh)
        expected.append(fresh.energy.copy())

    def look_before(_tick: int, data: Any) -> None:
        before.append(data.energy.copy())

    turning = Rotation.from_rotvec(sines(300, 0.3, 5.0))
    run = live(
        scene,
        samples_of(sines(300, 0.02, 5.0), turning),
        on_tick=look_before,
        after_tick=look,
        substeps=substeps,
    )
    potential, kinetic = np.array(expected).T
    assert run.ticks["potential"] == pytest.approx(potential, rel=1e-12, abs=1e-15)
    assert run.ticks["kinetic"] == pytest.approx(kinetic, rel=1e-12, abs=1e-15)
    # MuJoCo's own numbers after mj_step, taken as they are, belong to the state before it
    assert np.abs(np.array(before)[1:, 0] - potential[1:]).max() > 1e-6


box_sizes = st.tuples(*[st.floats(0.01, 0.04)] * 3)


def _closed(run: Run) -> Array:
    """Σ E_k from the records alone: storage minus the recorded wrench's work."""
    return np.asarray(run.stored() - np.cumsum(coupling_work(run)))


@settings(max_examples=40)
@given(
    size=box_sizes,
    grip=st.tuples(*[st.floats(-0.03, 0.03)] * 3),
    mass=st.floats(0.03, 1),
    stiffness=st.floats(200, 6000),
    damping=st.floats(0, 2),
    rotational_stiffness=st.floats(0.2, 6),
    rotational_damping=st.floats(0, 2e-3),
    amplitude=st.floats(1e-3, 0.02),
    angle=st.floats(0.01, 1.0),
    frequency=st.floats(0.3, 4),
)
def test_random_free_motion_closes_the_balance_and_is_strictly_passive(
    size: tuple[float, float, float],
    grip: tuple[float, float, float],
    mass: float,
    stiffness: float,
    damping: float,
    rotational_stiffness: float,
    rotational_damping: float,
    amplitude: float,
    angle: float,
    frequency: float,
) -> None:
    world = f"""
        <body name="tool"><freejoint/>
          <geom type="box" size="{size[0]} {size[1]} {size[2]}" mass="{mass}"/>
          <site name="grip" pos="{grip[0]} {grip[1]} {grip[2]}" quat="0.6 0 0.8 0"/>
        </body>"""
    coupling = Coupling(stiffness, damping, rotational_stiffness, rotational_damping)
    turning = Rotation.from_rotvec(sines(500, angle, frequency))
    samples = samples_of(sines(500, amplitude, frequency), turning)
    run = fast(mjcf(world), samples, coupling)
    ledger, energy = run.ledger, run.ticks["environment_energy"]
    assert energy == pytest.approx(_closed(run), rel=1e-9, abs=1e-13)
    assert run.ticks["coupling_work"] == pytest.approx(np.cumsum(coupling_work(run)), abs=1e-13)
    assert ledger.slack == pytest.approx(slack(run)[-1], rel=1e-9)
    allowed = ENERGY_TOLERANCE * (1 + np.cumsum(np.abs(coupling_work(run))))
    speeds = np.linalg.norm(run.tool_turns(), axis=1) / T
    assume(speeds.max() < 100)  # the range of the claim; undamped, a tool may resonate beyond
    assert (energy <= allowed).all()
    assert ledger.environment == "strict"
    assert ledger.slack_share == 0.0


@settings(max_examples=20)
@given(
    mass=st.floats(0.01, 1),
    stiffness=st.floats(100, 2e4),
    damping=st.floats(0, 5),
    amplitude=st.floats(1e-3, 0.05),
    frequency=st.floats(0.3, 10),
)
def test_pure_translation_never_creates_energy_in_any_tick(
    mass: float, stiffness: float, damping: float, amplitude: float, frequency: float
) -> None:
    scene = FREE_BALL.replace('mass="0.1"', f'mass="{mass}"')
    samples = samples_of(sines(400, amplitude, frequency))
    run = fast(scene, samples, Coupling(stiffness, damping, 1.0, 1e-4))
    steps = np.diff(run.ticks["environment_energy"], prepend=0.0)
    # differences of sums of the storage's size
    assert steps.max() <= 1e-14 * (1 + run.ticks["kinetic"].max() * 100)


def test_spinning_tool_behind_a_coupling_of_translation_alone_is_seen_to_create_energy() -> None:
    """Gyroscopic and Coriolis terms are explicit under `discrete`; the ledger must not hide it."""
    world = """
        <body name="tool"><freejoint/>
          <geom type="box" size="0.01 0.03 0.04" mass="0.1"/><site name="grip"/>
        </body>"""
    rest = '<keyframe><key name="home" qpos="0 0 0 1 0 0 0" qvel="0 0 0 30 40 5"/></keyframe>'
    run = fast(mjcf(world, rest), samples_of(sines(1000, 0.01, 2.0)), Coupling(2000, 2.0, 0, 0))
    assert run.ledger.environment_energy == pytest.approx(_closed(run)[-1], abs=1e-12)
    assert 0.01 < run.ledger.environment_energy < 0.1  # 0.05 J in 1 s
    assert run.ledger.environment == "active"


BOUNCY = 'contype="1" conaffinity="1" solref="-20000 -50" solimp="0.99 0.99 0.001"'


BOUNCY_WALL = f"""
    <body name="tool"><joint type="slide" axis="1 0 0"/>
      <geom type="sphere" size="0.01" mass="0.05" {BOUNCY}/><site name="grip"/>
    </body>
    <geom type="box" size="0.01 0.1 0.1" pos="0.03 0 0" {BOUNCY}/>"""


def _euler(scene_text: str, coupling: Coupling, samples: Any) -> Run:
    """Prepares as usual, and then makes the integrator one that creates energy."""
    scene = load(scene_text)

    def spoil(_tick: int, _data: Any) -> None:
        scene.model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER

    return live(scene, samples, coupling, on_tick=spoil)


@pytest.mark.filterwarnings("ignore:.*more energy than the coupling's slack:UserWarning")
@pytest.mark.parametrize("kind", ["stiff contact", "wrong integrator"])
def test_an_active_environment_is_named_with_its_first_ticks(kind: str) -> None:
    if kind == "stiff contact":
        motion = np.zeros((1500, 3))
        motion[:, 0] = 0.02 * np.sin(2 * np.pi * 10 * T * np.arange(1500))
        run = fast(mjcf(BOUNCY_WALL), samples_of(motion), Coupling(20000, 0.5, 0, 0))
    else:
        run = _euler(
            FREE_BALL.replace('mass="0.1"', 'mass="0.02"'),
            Coupling(6000, 0, 0, 0),
            samples_of(sines(1500, 0.01, 3.0)),
        )
    work = coupling_work(run)
    allowed = ENERGY_TOLERANCE * (1 + np.cumsum(np.abs(work)))
    energy, room = _closed(run), slack(run)
    is_unstrict, is_active = energy > allowed, energy > room + allowed
    assert is_active.any()
    ledger = run.ledger
    assert ledger.first_unstrict == int(np.argmax(is_unstrict))
    assert ledger.first_active == int(np.argmax(is_active))
    assert ledger.environment == "active"
    share = np.where(is_unstrict, energy / (room + allowed), 0.0)
    assert ledger.slack_share == pytest.approx(share.max(), rel=1e-9)


def test_device_energy_is_the_work_of_the_wrenches_that_were_sent() -> None:
    turning = Rotation.from_rotvec(sines(1500, 0.8, 1.0))
    run = fast(FREE_BALL, samples_of(sines(1500), turning))
    ticks = run.ticks
    sent = np.concatenate([np.zeros((1, 6)), ticks["wrench_on_device"][:-1]])
    moved = np.diff(ticks["device_position"], axis=0, prepend=np.zeros((1, 3)))
    turned = turns(ticks["device_quaternion"], np.array([1.0, 0, 0, 0]))
    work = np.cumsum(np.sum(sent * np.concatenate([moved, turned], axis=1), axis=1))
    assert ticks["device_energy"] == pytest.approx(work, rel=1e-9, abs=1e-15)
    late = np.cumsum(np.sum(ticks["wrench_on_device"][:, :3] * moved, axis=1))
    assert abs(late[-1] - work[-1]) > 1e-4  # with the wrench of the wrong tick it is another number


@pytest.mark.parametrize("scale", [1.0, 3.0])
def test_power_is_equal_on_both_sides_of_workspace_scale_and_axes(scale: float) -> None:
    axes = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix()
    turning = Rotation.from_rotvec(sines(1500, 0.8, 1.0))
    run = fast(
        FREE_BALL,
        samples_of(sines(1500, 0.004), turning),
        scale=scale,
        force_scale=scale,
        axes=tuple(axes.ravel().tolist()),
        handle_origin=(0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0),
    )
    wrench = np.concatenate([np.zeros((1, 6)), run.ticks["wrench_on_tool"][:-1]])
    steps = np.concatenate([run.handle_steps(), run.handle_turns()], axis=1)
    given = -np.cumsum(np.sum(wrench * steps, axis=1))
    assert run.ticks["device_energy"] == pytest.approx(given, rel=1e-9, abs=1e-14)
    assert abs(given[-1]) > 1e-4


def test_device_gets_what_the_coupling_gave_less_what_spring_damper_and_hold_take() -> None:
    """Algebra of spring, damper and hold joins device_energy and coupling_work exactly."""
    run = fast(FREE_BALL, samples_of(sines(1500, 0.01, 3.0)), Coupling(2400.0, 0.5, 0.0, 0.0))
    stiffness, damping = 2400.0, 0.5 / T
    d, dx = run.handle_steps(), run.tool_steps()
    e, de = run.ticks["handle_position"] - run.ticks["tool_position"], d - dx
    last, moved = d[-1], d[:-1]  # N ticks, and the motion that follows them
    de_before = np.concatenate([np.zeros((1, 3)), de[:-2]])

    def squared(weight: float, vectors: Array) -> float:
        return weight * float(np.sum(vectors**2))

    expected = (
        run.ticks["coupling_work"][-2]
        + squared((stiffness + damping) / 2, dx[:-1])
        + squared(damping / 2, de_before + moved)
        - squared(stiffness / 2 + damping, moved)
        + squared(stiffness / 2, e[-2] + last)
        + squared(damping / 2, de[-2] + last)
        - squared((stiffness + damping) / 2, last)
    )
    # the terms are some 1e4 times larger than what is left of them
    assert -run.ticks["device_energy"][-1] == pytest.approx(expected, rel=1e-9)
    assert abs(expected - run.ticks["coupling_work"][-1]) > 1e-4  # the sums do differ


def test_ledger_names_every_port() -> None:
    run = fast(FREE_BALL, at_rest(5))
    assert list(run.ledger.energies()) == [
        "kinetic",
        "potential",
        "coupling_work",
        "actuator_work",
        "external_work",
        "tuning_work",
        "environment_energy",
        "device_energy",
        "slack",
    ]
    for name in run.ledger.energies():
        if name not in ("slack", "tuning_work"):
            assert run.ledger.energies()[name] == run.ticks[name][-1]


@pytest.mark.parametrize(
    ("unstrict", "active", "environment"),
    [(-1, -1, "strict"), (0, -1, "within slack"), (3, 0, "active"), (0, 0, "active")],
)
def test_environment_is_called_by_its_worst_tick(
    unstrict: int, active: int, environment: str
) -> None:
    run = fast(FREE_BALL, at_rest(1))
    energy = run.binding.state["energy"]
    energy["first_unstrict"], energy["first_active"] = unstrict, active
    assert run.ledger.environment == environment
