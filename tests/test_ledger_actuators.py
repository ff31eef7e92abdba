"""Work of the scene's own actuators, against their laws and against continuous time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import pytest
from kernel_runs import (
    Array,
    Run,
    T,
    at_rest,
    live,
    mjcf,
    samples_of,
    sines,
)
from ledger_scenes import ARM, GRAVITY, MASSES, SLIDER, SOLID, Witness


def cart(name: str, mass: float, y: float, attributes: str = "") -> str:
    return f"""
    <body name="{name}" pos="0 {y} 0"><joint name="{name}" type="slide" axis="1 0 0" {attributes}/>
      <geom type="sphere" size="0.02" mass="{mass}"/>
    </body>"""


def carts(attributes: str = "") -> str:
    return SLIDER + cart("cart", 0.3, 0.2, attributes) + cart("other", 0.2, 0.4)


TENDON = """
    <tendon><fixed name="t" {}>
      <joint joint="cart" coef="1"/><joint joint="other" coef="-2"/>
    </fixed></tendon>"""


SERVO = '<position joint="cart" kp="10000" kv="10"/>'


TENDON_SERVO = '<position tendon="t" kp="10000" kv="10" {}/>'


# actuators, attributes of the cart's joint, other elements, control over time in s
SERVOS: dict[str, tuple[str, str, str, Callable[[float], float]]] = {
    "servo": (SERVO, "", "", lambda _: 0.05),
    "very stiff servo": (
        '<position joint="cart" kp="1e6" kv="100"/>',
        "",
        "",
        lambda _: 0.05,
    ),
    "servo at its force range": (
        '<position joint="cart" kp="10000" kv="10" forcerange="-20 20"/>',
        "",
        "",
        lambda _: 0.05,
    ),
    "servo at its joint's limit": (SERVO, 'actuatorfrcrange="-20 20"', "", lambda _: 0.05),
    "two servos at their joint's limit": (
        SERVO + '<velocity joint="cart" kv="100"/>',
        'actuatorfrcrange="-20 20"',
        "",
        lambda _: 0.05,
    ),
    "tendon servo": (TENDON_SERVO.format(""), "", TENDON.format(""), lambda _: 0.05),
    "tendon servo at its force range": (
        TENDON_SERVO.format('forcerange="-10 10"'),
        "",
        TENDON.format(""),
        lambda _: 0.05,
    ),
    "tendon servo at the tendon's limit": (
        TENDON_SERVO.format(""),
        "",
        TENDON.format('actuatorfrcrange="-10 10"'),
        lambda _: 0.05,
    ),
    "motor": ('<motor joint="cart" gear="3"/>', "", "", lambda t: np.sin(30 * t)),
    "velocity servo": ('<velocity joint="cart" kv="100"/>', "", "", lambda t: np.sin(30 * t)),
    "integrated velocity": (
        '<intvelocity joint="cart" kp="5000" kv="3" actrange="-1 1"/>',
        "",
        "",
        lambda t: np.sin(30 * t),
    ),
    "filtered servo": (
        '<general joint="cart" dyntype="filterexact" dynprm="0.02" gainprm="1000" '
        'biastype="affine" biasprm="0 -1000 -5"/>',
        "",
        "",
        lambda _: 0.05,
    ),
    "damper that the control opens": (
        '<general joint="cart" gaintype="affine" gainprm="100 -200 -10"/>',
        "",
        "",
        lambda _: 0.05,
    ),
    "destabilising servo": (
        '<general joint="cart" gainprm="1" biastype="affine" biasprm="0 100 1"/>',
        "",
        "",
        lambda _: 0.05,
    ),
    "servo on the tool itself": (
        '<position joint="tool" kp="1000" kv="10"/>',
        "",
        "",
        lambda _: 0.05,
    ),
}


def _driven(name: str, ticks: int = 400) -> tuple[Run, Witness]:
    actuators, attributes, rest, control = SERVOS[name]
    witness = Witness()

    def drive(tick: int, data: Any) -> None:
        data.ctrl[:-6] = control(tick * T)

    run = live(
        mjcf(carts(attributes), f"<actuator>{actuators}</actuator>{rest}"),
        samples_of(sines(ticks)),
        on_tick=drive,
        after_tick=witness,
    )
    return run, witness


@pytest.mark.parametrize("name", SERVOS)
def test_actuators_of_the_scene_are_metered_with_the_force_that_the_step_used(name: str) -> None:
    run, witness = _driven(name)
    energy, scale = run.ticks["environment_energy"], np.abs(run.ticks["actuator_work"]).max()
    assert scale > 1e-3
    # the sum of some hundred works, each rounded relative to the largest
    assert energy == pytest.approx(-witness.lost(MASSES), abs=1e-13 * max(scale, 1.0) * 10)


@pytest.mark.parametrize("name", ["servo", "very stiff servo", "tendon servo"])
def test_the_force_at_the_start_of_the_step_would_meter_a_stiff_servo_wrongly(name: str) -> None:
    run, witness = _driven(name)
    naive, metered = T * np.sum(witness.start_of_step_power), run.ticks["actuator_work"][-1]
    # 9.5 J for 3.0 J, 1989 J for 284 J, 1.4 J for 2.7 J
    assert abs(naive - metered) > 0.4 * metered


def test_servo_work_is_its_law_at_the_end_of_the_step_times_the_motion() -> None:
    run, witness = _driven("servo")
    q, v = np.array(witness.qpos)[:, 1], np.array(witness.qvel)[:, 1]
    force = 1e4 * (0.05 - q) - 10 * v
    work = np.cumsum(force * witness.changes(witness.qpos)[:, 1])
    assert run.ticks["actuator_work"] == pytest.approx(work, rel=1e-11, abs=1e-12)


def test_inertia_of_a_motor_counts_as_kinetic_energy() -> None:
    scene = mjcf(carts(), '<actuator><position joint="cart" kp="1e4" armature="0.1"/></actuator>')
    witness = Witness()
    run = live(scene, at_rest(200), on_tick=lambda _, d: d.ctrl.put(0, 0.05), after_tick=witness)
    masses = MASSES + np.array([0, 0.1, 0])
    assert run.ticks["environment_energy"] == pytest.approx(-witness.lost(masses), abs=1e-11)
    speeds = np.array(witness.qvel)
    assert run.ticks["kinetic"] == pytest.approx(0.5 * (speeds**2) @ masses, abs=1e-12)


def test_servo_work_under_substeps_is_that_of_as_many_ticks() -> None:
    scene = mjcf(carts(), f"<actuator>{SERVO}</actuator>")

    def drive(_tick: int, data: Any) -> None:
        data.ctrl[0] = 0.05

    coarse = live(scene, at_rest(100), on_tick=drive, substeps=4)
    fine = live(scene, at_rest(400), on_tick=drive, period=T / 4)
    assert coarse.ticks["actuator_work"] == pytest.approx(
        fine.ticks["actuator_work"][3::4], rel=1e-12
    )


BALL = """
    <body name="b" pos="0 1 0"><joint name="b" type="ball"/>
      <geom type="box" size="0.05 0.08 0.1" mass="0.5" pos="0.1 0 0"/>
    </body>"""


FREE = """
    <body name="b" pos="0 1 0"><freejoint name="b"/>
      <geom type="box" size="0.05 0.08 0.1" mass="0.5" pos="0.1 0 0"/><site name="s"/>
    </body><site name="w" pos="0 1 0"/>"""


# body, actuators, control (scaled by sin² 4t), gravity
MECHANISMS: dict[str, tuple[str, str, tuple[float, ...], str]] = {
    "arm": (
        ARM,
        '<position joint="shoulder" kp="500" kv="2"/><position joint="elbow" kp="500" kv="2"/>',
        (1.0, -1.0),
        GRAVITY,
    ),
    "orientation servo": (
        BALL,
        '<orientation joint="b" kp="200" kv="0.5"/>',
        (0.4, 0.3, 0.2),
        GRAVITY,
    ),
    "ball joint about one axis": (
        BALL,
        '<position joint="b" gear="0 0 1" kp="200" kv="0.5"/>',
        (0.5,),
        'gravity="0 0 0"',
    ),
    "orientation servo of a free body": (
        FREE,
        '<orientation site="s" refsite="w" kp="200" kv="0.5"/>',
        (0.4, 0.3, 0.2),
        'gravity="0 0 0"',
    ),
    "site servos of a free body": (
        FREE,
        '<position site="s" refsite="w" gear="1 0 0 0 0 0" kp="2000" kv="5"/>'
        '<position site="s" refsite="w" gear="0 0 0 0 0 1" kp="200" kv="0.05"/>',
        (0.05, 0.3),
        'gravity="0 0 0"',
    ),
}


def _control(values: tuple[float, ...], time: float) -> Array:
    return np.asarray(np.array(values) * np.sin(4 * time) ** 2)


def _runge_kutta_work(scene: str, values: tuple[float, ...], duration: float) -> float:
    """Integrates the scene in continuous time, and the actuators' power with it."""
    model = mujoco.MjModel.from_xml_string(scene)
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER  # its qacc is that of continuous time
    data = mujoco.MjData(model)
    step, work = 1e-3, 0.0
    q, v = data.qpos.copy(), data.qvel.copy()

    def rates(time: float, dq: Array, dv: Array, h: float) -> tuple[Array, Array, float]:
        data.qpos[:] = q
        mujoco.mj_integratePos(model, data.qpos, dq, h)
        data.qvel[:] = v + h * dv
        data.ctrl[:] = _control(values, time)
        mujoco.mj_forward(model, data)
        return data.qvel.copy(), data.qacc.copy(), float(data.qfrc_actuator @ data.qvel)

    nothing = np.zeros(model.nv)
    for k in range(round(duration / step)):
        time = k * step
        a = rates(time, nothing, nothing, 0.0)
        b = rates(time + step / 2, a[0], a[1], step / 2)
        c = rates(time + step / 2, b[0], b[1], step / 2)
        d = rates(time + step, c[0], c[1], step)
        mean = [(a[i] + 2 * b[i] + 2 * c[i] + d[i]) / 6 for i in range(3)]
        mujoco.mj_integratePos(model, q, mean[0], step)
        v = v + step * mean[1]
        work += step * float(mean[2])
    return work


@pytest.mark.parametrize("name", MECHANISMS)
def test_work_on_turning_mechanisms_converges_to_that_of_continuous_time(name: str) -> None:
    body, actuators, values, option = MECHANISMS[name]
    rest = f"<actuator>{actuators}</actuator>"
    duration = 0.4
    reference = _runge_kutta_work(mjcf(body, rest, option), values, duration)

    def metered(period: float) -> tuple[float, float, float]:
        witness = Witness()
        run = live(
            mjcf(SLIDER + body, rest, option),
            at_rest(round(duration / period)),
            period=period,
            on_tick=lambda k, d: d.ctrl.__setitem__(slice(None, -6), _control(values, k * period)),
            after_tick=witness,
        )
        naive = period * float(np.sum(witness.start_of_step_power))
        return float(run.ticks["actuator_work"][-1]), naive, run.ledger.environment_energy

    coarse, naive, created = metered(T)
    fine, _, created_fine = metered(T / 4)
    # first order: a quarter of the period leaves about a quarter of the error
    assert abs(fine - reference) < 0.4 * abs(coarse - reference)
    assert abs(coarse - reference) < 0.1 * abs(naive - reference)
    assert created < 0
    assert abs(created_fine) < 0.4 * abs(created)


def test_adhesion_that_is_switched_on_at_a_resting_contact_does_no_work() -> None:
    world = (
        SLIDER
        + f"""<geom type="plane" size="1 1 0.1" {SOLID}/>
        <body name="foot" pos="0 0 0.02"><freejoint/>
          <geom type="sphere" size="0.02" mass="0.2" {SOLID}/>
        </body>"""
    )
    adhesion = '<actuator><adhesion body="foot" gain="20" ctrlrange="0 1"/></actuator>'
    run = live(mjcf(world, adhesion, GRAVITY), at_rest(300), on_tick=lambda _, d: d.ctrl.put(0, 1))
    # 20 N press the foot some 10 µm deeper into its contact's spring
    assert 0 < run.ledger.actuator_work < 20 * 5e-5
    assert run.ledger.environment_energy <= 1e-9
