"""The coupling: its parameters, its law at the recorded poses, and that the scene obeys it."""

from __future__ import annotations

import itertools
from dataclasses import fields, replace
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from kernel_runs import (
    FREE_BALL,
    PLAIN,
    Array,
    Run,
    T,
    bind,
    coupling_work,
    fast,
    live,
    load,
    mjcf,
    run_of,
    samples_of,
    sines,
    turns,
    wrench_law,
)
from scipy.spatial.transform import Rotation

from hapticbridge.audit import spring as audit_spring
from hapticbridge.coupling import Coupling
from hapticbridge.errors import CouplingError
from hapticbridge.kernel.jit import compiled
from hapticbridge.kernel.law import (
    Spring,
    energy_at_level,
    is_bent,
    is_beyond_level,
    is_straight,
    length_at,
    limited,
    next_gain_ratio,
    secant_stiffness,
    spring_energy,
    spring_length,
)
from hapticbridge.kernel.record import TICK_DTYPE
from hapticbridge.kernel.tick import after_step, before_step
from hapticbridge.scene import rehearsal

MASS = 0.1
STIFF = Coupling(2000.0, 2.0, 2.0, 2e-3)

TILTED_BOX = mjcf("""
    <body name="tool" pos="0.1 0.2 0.3" quat="0.8 0.6 0 0"><freejoint/>
      <geom type="box" size="0.02 0.03 0.04" mass="0.2"/>
      <site name="grip" pos="0.02 -0.01 0.03" quat="0.6 0 0.8 0"/>
    </body>""")


def _by_substep(scene: str, samples: np.ndarray, coupling: Coupling, substeps: int) -> Run:
    """Steps a scene; returns a run with a row of poses per substep, and the records as ``sent``."""
    loaded = load(scene)
    binding, parameters = bind(loaded, coupling, substeps=substeps)
    run = run_of(loaded, binding, parameters)
    run.parameters = replace(parameters, period=T / substeps, substeps=1)
    run.ticks = np.zeros(substeps * len(samples), TICK_DTYPE)
    model, data = loaded.model, loaded.data
    grip = model.site("grip").id
    for k in range(len(run.ticks)):
        tick, substep = divmod(k, substeps)
        before_step(binding.state, samples[tick : tick + 1], binding.row, substep, T)
        mujoco.mj_step(model, data)
        after_step(binding.state, binding.row, substep)
        row = run.ticks[k]
        row["handle_position"], row["handle_quaternion"] = data.mocap_pos[0], data.mocap_quat[0]
        row["tool_position"], row["tool_quaternion"] = data.site_xpos[grip], data.site_xquat[grip]
        row["wrench_on_tool"] = binding.row["wrench_on_tool"][0]
    return run


@settings(max_examples=30)
@given(
    st.floats(10, 2e4),
    st.floats(0, 10),
    st.floats(0, 10),
    st.floats(0, 0.01),
    st.floats(0.1, 1.4),
    st.sampled_from([1, 2, 5]),
)
def test_wrench_law_holds_for_any_coupling(
    stiffness: float,
    damping: float,
    rotational_stiffness: float,
    rotational_damping: float,
    angle: float,
    substeps: int,
) -> None:
    coupling = Coupling(stiffness, damping, rotational_stiffness, rotational_damping)
    turning = Rotation.from_rotvec(sines(60, angle, 4.0))
    samples = samples_of(sines(60, 0.01, 10.0), turning)
    run = _by_substep(TILTED_BOX, samples, coupling, substeps)
    laws = wrench_law(run)
    mean = laws.reshape(60, substeps, 6).mean(axis=1)
    sent = run.ticks["wrench_on_tool"][substeps - 1 :: substeps]
    assert sent == pytest.approx(mean, rel=1e-9, abs=1e-10)
    run.ticks["wrench_on_tool"] = laws
    assert run.ledger.coupling_work == pytest.approx(coupling_work(run).sum(), rel=1e-8, abs=1e-13)


def test_mujoco_applies_the_recorded_force_also_where_the_handle_is_turned() -> None:
    """Newton's law is the witness: m (v_k − v_{k−1})/T is what the step really applied."""
    angle = np.minimum(np.arange(2000) / 500, 1.0)  # to 1 rad, and held
    turning = Rotation.from_rotvec(angle[:, None] * np.array([[0.0, 0.0, 1.0]]))
    samples = samples_of(sines(2000, 0.02, 3.0), turning)
    run = fast(FREE_BALL, samples, STIFF)
    speeds = run.tool_steps() / T
    applied = MASS * np.diff(speeds, axis=0, prepend=np.zeros((1, 3))) / T
    # positions to 1e-17 m, differenced twice over T = 1 ms, times 0.1 kg
    assert run.ticks["wrench_on_tool"][:, :3] == pytest.approx(applied, abs=1e-11)


def test_applied_torque_is_the_recorded_one_to_first_order_in_the_period() -> None:
    inertia = 0.4 * MASS * 0.015**2

    def mismatch(period: float) -> float:
        count = round(0.5 / period)
        turning = Rotation.from_rotvec(sines(count, 0.5, 2.0, period))
        speeds: list[Array] = []
        run = live(
            FREE_BALL,
            samples_of(np.zeros((count, 3)), turning),
            period=period,
            after_tick=lambda _k, data: speeds.append(
                Rotation.from_quat(data.qpos[3:7], scalar_first=True).apply(data.qvel[3:6])
            ),
        )
        change = np.diff(np.array(speeds), axis=0, prepend=np.zeros((1, 3)))
        torque = run.ticks["wrench_on_tool"][:, 3:]
        return float(np.abs(inertia * change / period - torque).max() / np.abs(torque).max())

    coarse, fine = mismatch(1e-3), mismatch(0.25e-3)
    assert coarse < 0.01
    assert fine < coarse / 2


@pytest.mark.parametrize("substeps", [1, 4])
def test_timestep_is_the_period_over_the_substeps(substeps: int) -> None:
    run = live(FREE_BALL, samples_of(sines(10)), substeps=substeps)
    assert run.scene.model.opt.timestep == T / substeps
    assert run.scene.data.time == pytest.approx(10 * T, rel=1e-12)


def test_handle_moves_uniformly_over_the_substeps_and_arrives_in_the_last() -> None:
    scene = load(FREE_BALL)
    binding, parameters = bind(scene, substeps=4)
    run = run_of(scene, binding, parameters)
    turn = Rotation.from_rotvec([[0.0, 0.4, 0.0]])
    samples = samples_of(np.array([[0.004, 0.0, 0.0]]), turn)
    positions, quaternions = [run.handle_start[:3]], [run.handle_start[3:]]
    for substep in range(4):
        before_step(binding.state, samples, binding.row, substep, T)
        positions.append(scene.data.mocap_pos[0].copy())
        quaternions.append(scene.data.mocap_quat[0].copy())
    steps = np.diff(positions, axis=0)
    assert steps == pytest.approx(np.tile([0.001, 0.0, 0.0], (4, 1)), abs=1e-15)
    vectors = turns(np.array(quaternions[1:]), np.array(quaternions[0]))
    assert vectors == pytest.approx(np.tile([0.0, 0.1, 0.0], (4, 1)), abs=1e-15)


def test_a_turning_free_tool_is_strict_under_substeps() -> None:
    turning = Rotation.from_rotvec(sines(1500, 1.0, 1.0))
    run = fast(FREE_BALL, samples_of(sines(1500), turning), substeps=4)
    assert run.ledger.environment == "strict"


GAINS = [field.name for field in fields(Coupling)]
NO_GAIN: tuple[Any, ...] = (float("nan"), float("inf"), -1.0, "1", None)


@pytest.mark.parametrize(
    ("name", "value"), [*itertools.product(GAINS, NO_GAIN), ("stiffness", 0.0)]
)
def test_invalid_gains_are_refused_by_name_and_only_the_stiffness_must_not_be_zero(
    name: str, value: Any
) -> None:
    values = dict.fromkeys(GAINS, 0.0) | {"stiffness": 1.0}
    Coupling(**values)
    with pytest.raises(CouplingError, match=f"coupling {name.replace('_', ' ')} is"):
        Coupling(**{**values, name: value})


SPRING = Spring(stiffness=2000.0, level=3.0)
"""A spring that reaches its level at 1.5 mm."""

LENGTHS = np.array([0.0, 0.4e-3, 1.5e-3, 1.6e-3, 4e-3])


def _force(length: float) -> float:
    return limited(SPRING, (0.0, SPRING.stiffness * length, 0.0))[1]


def test_energy_and_length_of_a_spring_follow_from_its_force() -> None:
    for length in LENGTHS:
        edges = np.linspace(0.0, length, 401)  # the level is reached at one of them
        middles = 0.5 * (edges[1:] + edges[:-1])
        energy = sum(map(_force, middles)) * (edges[1] - edges[0])
        assert spring_energy(SPRING, length) == pytest.approx(energy, rel=1e-6, abs=1e-15)
        assert spring_length(SPRING, spring_energy(SPRING, length)) == pytest.approx(length)
    assert _force(length_at(SPRING, 1.7)) == pytest.approx(1.7)
    assert secant_stiffness(SPRING, 1.7) * length_at(SPRING, 1.7) == pytest.approx(1.7)
    at_level = spring_energy(SPRING, length_at(SPRING, SPRING.level))
    assert energy_at_level(SPRING) == pytest.approx(at_level)


def test_a_spring_is_beyond_its_level_where_the_linear_law_asks_for_more() -> None:
    sizes = SPRING.stiffness * LENGTHS
    assert [is_beyond_level(SPRING, size) for size in sizes] == list(sizes > SPRING.level)


def test_a_spring_is_bent_where_its_force_is_not_that_of_the_linear_law() -> None:
    for size in SPRING.stiffness * LENGTHS:
        force = _force(size / SPRING.stiffness)
        assert is_bent(SPRING, size) == (force != size)
        for change in (0.5, 2.0):
            rises = _force((size + change) / SPRING.stiffness) - force
            assert is_straight(SPRING, size, change) == (rises == pytest.approx(change))


@pytest.mark.parametrize("compliance", [0.0, 0.3, 5.0])
@pytest.mark.parametrize("answer", [0.5, 3.0, 4.0, 60.0])
def test_a_share_of_the_gains_gives_the_springs_force(answer: float, compliance: float) -> None:
    last = 0.7  # any share that was tried before
    share = next_gain_ratio(SPRING, last * answer / (1 + last * compliance), last, compliance)
    u = answer / (1 + share * compliance)
    assert share * u == pytest.approx(_force(u / SPRING.stiffness))


def test_the_audits_spring_is_the_kernels() -> None:
    twin = audit_spring.Spring(np.full(len(LENGTHS), SPRING.stiffness), SPRING.level)
    stretch = LENGTHS[:, None] * np.array([0.48, -0.6, 0.64])
    kernel = [spring_energy(SPRING, length) for length in LENGTHS]
    np.testing.assert_allclose(twin.energy(stretch), kernel, rtol=1e-12)
    u = SPRING.stiffness * stretch
    forces = [limited(SPRING, tuple(each)) for each in u]
    np.testing.assert_allclose(twin.limited(u), forces, rtol=1e-12)
    np.testing.assert_allclose(twin.force(stretch), forces, rtol=1e-12)
    sizes = np.linalg.norm(u, axis=1)
    straight = [is_straight(SPRING, size, 0.5) for size in sizes]
    assert twin.is_straight(sizes, np.full(len(sizes), 0.5)).tolist() == straight


SCALED = replace(
    PLAIN, coupling=STIFF, scale=1.5, force_scale=0.7, force_limit=4.0, torque_limit=0.3
)
"""Parameters of a run whose device feels a part of the tool's forces."""


def test_the_levels_on_the_tool_are_the_devices_limits_and_those_of_the_audit() -> None:
    force, torque = SCALED.levels_on_tool
    assert 0.7 * force == pytest.approx(4.0)
    assert 0.7 / 1.5 * torque == pytest.approx(0.3)
    assert audit_spring.levels_on_tool(SCALED) == SCALED.levels_on_tool


@compiled
def softened(spring: Spring, force: float) -> float:
    return spring.stiffness / (1.0 + force)


def test_the_handle_starts_where_the_law_carries_the_load(monkeypatch: pytest.MonkeyPatch) -> None:
    tool = (0.1, 0.2, 0.3, 0.8, 0.6, 0.0, 0.0)
    load = np.array([1.0, -2.0, 3.0, 0.1, 0.05, -0.1])

    def stretch_and_twist() -> tuple[Array, Array]:
        handle = rehearsal.loaded_handle(tool, load, SCALED)
        turn = Rotation.from_quat(handle[3:], scalar_first=True)
        turn *= Rotation.from_quat(tool[3:], scalar_first=True).inv()
        return np.subtract([handle[:3]], tool[:3]), turn.as_rotvec()[None]

    gains = np.array([[STIFF.stiffness, 0.0, STIFF.rotational_stiffness, 0.0]])
    stretch, twist = stretch_and_twist()
    linear, angular = audit_spring.springs(gains, SCALED)
    assert linear.force(stretch)[0] == pytest.approx(load[:3])
    assert angular.force(twist)[0] == pytest.approx(load[3:])
    monkeypatch.setattr(rehearsal, "secant_stiffness", softened)
    softer, more = stretch_and_twist()
    assert softer == pytest.approx((1.0 + np.linalg.norm(load[:3])) * stretch)
    assert more == pytest.approx((1.0 + np.linalg.norm(load[3:])) * twist)
