"""Work of forces from outside: applied ones and gravity compensation."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from kernel_runs import (
    DEFAULT,
    Array,
    T,
    at_rest,
    fast,
    live,
    mjcf,
    samples_of,
)
from ledger_scenes import ARM, GRAVITY, SLIDER, G, Witness, smooth


def test_constant_force_and_torque_on_a_free_ball_do_force_times_distance() -> None:
    world = """<body name="other" pos="0 0.3 0"><freejoint/>
                 <geom type="sphere" size="0.03" mass="0.4"/></body>"""
    force, torque = np.array([0.3, -0.2, 0.5]), np.array([0.0, 0.0, 2e-3])
    witness = Witness()

    def push(_tick: int, data: Any) -> None:
        data.xfrc_applied[2, :3], data.xfrc_applied[2, 3:] = force, torque

    run = live(mjcf(SLIDER + world), at_rest(800), on_tick=push, after_tick=witness)
    assert run.scene.model.body("other").id == 2
    moved = np.array(witness.qpos)[-1, 1:4] - [0, 0.3, 0]
    # about an axis that stays: the angle is the sum of T times the angular speed
    angle = T * np.sum(np.array(witness.qvel)[:, 6])
    assert angle > 1
    expected = force @ moved + torque[2] * angle
    assert run.ledger.external_work == pytest.approx(expected, rel=1e-12)
    inertia = 0.4 * 0.4 * 0.03**2
    masses = np.array([0.1, 0.4, 0.4, 0.4, inertia, inertia, inertia])
    assert run.ledger.environment_energy == pytest.approx(-witness.lost(masses)[-1], rel=1e-9)


def test_generalised_force_on_a_hinge_does_torque_times_angle() -> None:
    witness = Witness()

    def push(_tick: int, data: Any) -> None:
        data.qfrc_applied[1:] = (0.4, -0.1)

    run = live(mjcf(SLIDER + ARM), at_rest(500), on_tick=push, after_tick=witness)
    _, shoulder, elbow = np.array(witness.qpos)[-1]
    assert abs(shoulder) > 0.3
    assert run.ledger.external_work == pytest.approx(0.4 * shoulder - 0.1 * elbow, rel=1e-12)


def test_force_on_the_link_of_an_arm_does_force_times_path_to_first_order() -> None:
    force = np.array([0.3, 0.0, 0.8])

    def error(period: float) -> float:
        where: list[Array] = []

        def push(_tick: int, data: Any) -> None:
            data.xfrc_applied[3, :3] = force

        run = live(
            mjcf(SLIDER + ARM),
            at_rest(round(0.5 / period)),
            period=period,
            on_tick=push,
            after_tick=lambda _k, d: where.append(d.body("lower").xipos.copy()),
        )
        assert run.scene.model.body("lower").id == 3
        work = force @ (where[-1] - np.array([0.45, 1.0, 0.0]))
        assert work > 0.1
        return float(abs(run.ledger.external_work - work) / work)

    assert error(T) < 1e-2
    assert error(T / 4) < 0.4 * error(T)


@pytest.mark.parametrize("share", [1.0, 0.5])
def test_gravity_compensation_is_work_from_outside(share: float) -> None:
    world = f"""
        <body name="tool" gravcomp="{share}"><freejoint/>
          <geom type="sphere" size="0.015" mass="0.1"/><site name="grip"/>
        </body>"""
    lift = samples_of(np.array([[0, 0, smooth(k, 1000, 0.2)] for k in range(1500)]))
    run = fast(mjcf(world, option=GRAVITY), lift)
    height = run.ticks["tool_position"][-1, 2]
    # the coupling's spring carries the rest of the weight, and sags
    assert height == pytest.approx(0.2 - (1 - share) * 0.1 * G / DEFAULT.stiffness, abs=1e-6)
    assert run.ledger.potential == pytest.approx(0.1 * G * height, rel=1e-9)
    assert run.ledger.external_work == pytest.approx(share * 0.1 * G * height, rel=1e-9)
    assert run.ledger.coupling_work == pytest.approx((1 - share) * 0.1 * G * height, abs=2e-3)
    assert run.ledger.environment == "strict"


def test_gravity_compensation_by_the_joints_actuators_is_their_work() -> None:
    world = """
        <body name="tool" gravcomp="1">
          <joint type="slide" axis="0 0 1" actuatorgravcomp="true"/>
          <geom type="sphere" size="0.015" mass="0.1"/><site name="grip"/>
        </body>"""
    lift = samples_of(np.array([[0, 0, smooth(k, 1000, 0.2)] for k in range(1500)]))
    run = fast(mjcf(world, option=GRAVITY), lift)
    assert run.ledger.actuator_work == pytest.approx(
        0.1 * G * run.ticks["tool_position"][-1, 2], rel=1e-9
    )
    assert run.ledger.external_work == 0.0
    assert run.ledger.environment == "strict"
