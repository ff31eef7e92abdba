"""Restitution of rigid contacts and limits, in closed form and against Routh's path."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from audit_cases import recorded
from kernel_runs import Array, Run, T, at_rest, go_on, load, run_of, samples_of, unlimited
from numpy.typing import NDArray

from hapticbridge.audit import audit
from hapticbridge.coupling import Coupling
from hapticbridge.demand.methods import METHODS, prepare
from hapticbridge.kernel.jit import source_of
from hapticbridge.kernel.record import TICK_DTYPE
from hapticbridge.kernel.restitution import MAX_RESTITUTION, restitution, rigid_restitution
from hapticbridge.kernel.state import BoundKernel
from hapticbridge.kernel.tick import simulate
from hapticbridge.lab.rebounds import damping_of
from hapticbridge.run.bridge import Bridge
from hapticbridge.theory.impact import ImpactBody, Mode, resolve_impact

COUPLING = Coupling(2400.0, 0.5, 2.4, 5e-4)
GRAVITY = 9.81


def e_of(damping: float) -> float:
    """Returns the coefficient of restitution of a damping ratio; MuJoCo's is in another test."""
    return float(source_of(restitution)(0.02, damping))


def scene(bodies: str, damping: float = 1.0, gravity: float = 0.0, friction: float = 0.0) -> str:
    """Returns a scene with a tool far away, if it has none, and one damping ratio of all rows."""
    tool = """<body name="tool" pos="9 0 9"><freejoint/>
      <geom size="0.01" mass="0.1" contype="0" conaffinity="0"/><site name="grip"/></body>"""
    return f"""
<mujoco>
  <compiler angle="radian"/>
  <option gravity="0 0 {-gravity}" cone="elliptic"/>
  <default><geom solref="0.02 {damping!r}" friction="{friction} 0 0"/>
    <joint solreflimit="0.02 {damping!r}"/></default>
  <worldbody>{"" if '"grip"' in bodies else tool}{bodies}</worldbody>
</mujoco>"""


def started(
    xml: str,
    velocity: Mapping[str, float | Array] | None = None,
    method: str = "implicit",
    period: float = T,
    paid: float | None = None,
) -> Run:
    """Returns a run without ticks, whose joints have these velocities in m/s or rad/s.

    ``paid`` replaces the share of its energy that a blow may give back.
    """
    loaded, chosen = load(xml), METHODS[method].with_contact("rigid")
    start = loaded.data.qpos.copy()
    prepare(loaded, COUPLING, period, 1, chosen, warns=False)
    loaded.data.qpos[:] = start
    for name, speed in (velocity or {}).items():
        loaded.data.joint(name).qvel[:] = speed
    mujoco.mj_forward(loaded.model, loaded.data)
    coupling = chosen.law_coupling(COUPLING, period)
    parameters = unlimited(loaded, coupling, period, scheme=chosen.scheme, is_rigid=True)
    run = run_of(loaded, BoundKernel(loaded.model, loaded.data, parameters), parameters)
    if paid is not None:
        run.binding.state["contact"]["paid"] = paid
    return run


def strict(run: Run) -> bool:
    return int(run.binding.state["energy"]["first_unstrict"][0]) < 0


def followed(run: Run, samples: np.ndarray, value: Callable[[mujoco.MjData], float]) -> Array:
    """Runs all samples, and returns a number after each."""
    values: list[float] = []
    go_on(run, samples, after_tick=lambda _, data: values.append(float(value(data))))
    return np.array(values)


def resting(run: Run, time: float, value: Callable[[mujoco.MjData], float]) -> Array:
    return followed(run, at_rest(round(time / run.parameters.period)), value)


# Closed forms

RADIUS = 0.02
BALL = """<geom type="plane" size="5 5 .1"/>
  <body name="ball" pos="0 0 {height}"><freejoint name="ball"/>
    <geom size="0.02" mass="0.05"/></body>"""


def apexes(heights: Array) -> Array:
    """Returns the largest heights of the flights after each blow."""
    inner = heights[1:-1]
    return np.asarray(inner[(inner > heights[:-2]) & (inner >= heights[2:])])


@pytest.mark.parametrize("damping", [0.04, 0.1, 0.2, 0.4])
@pytest.mark.parametrize("period", [1e-3, 2.5e-4])
def test_a_dropped_ball_rises_to_e_squared_of_its_height(damping: float, period: float) -> None:
    e = e_of(damping)
    for drop in np.linspace(0.2, 0.21, 4):  # other phases of the step at which it strikes
        xml = scene(BALL.format(height=drop + RADIUS), damping, GRAVITY)
        run = started(xml, period=period)
        fall = np.sqrt(2 * drop / GRAVITY)
        heights = resting(run, fall * (1 + 2 * e), lambda d: d.body("ball").xpos[2] - RADIUS)
        assert apexes(heights)[0] == pytest.approx(e**2 * drop, rel=1e-3)
        assert heights.min() > -1e-6
        assert strict(run)


def test_a_ball_rebounds_again_and_again_and_comes_to_rest() -> None:
    damping, drop = 0.1, 0.3
    e = e_of(damping)
    run = started(scene(BALL.format(height=drop + RADIUS), damping, GRAVITY))
    heights = resting(run, 4.0, lambda d: d.body("ball").xpos[2] - RADIUS)
    series = np.concatenate([[drop], apexes(heights)])
    series = series[series > 0.005]
    assert series.size > 5
    for before, after in pairwise(series):
        assert after == pytest.approx(e**2 * before, rel=5e-3)
    assert np.abs(np.diff(heights[-500:])).max() < 1e-12
    assert abs(heights[-1]) < 1e-6
    assert strict(run)


@pytest.mark.parametrize("gravity", [50.0, 200.0])
def test_a_pressed_ball_rises_as_high_as_from_the_surface(gravity: float) -> None:
    e, drop = e_of(0.1), 0.1
    run = started(scene(BALL.format(height=drop + RADIUS), 0.1, gravity))
    time = np.sqrt(2 * drop / gravity) * (1 + 2 * e)
    heights = resting(run, time, lambda d: d.body("ball").xpos[2] - RADIUS)
    first = apexes(heights)[0]
    assert first == pytest.approx(e**2 * drop, abs=gravity * T**2 / 8 + 1e-3 * drop)
    speed = np.sqrt(2 * gravity * drop)
    assert T * speed > 0.03 * e**2 * drop  # what a rebound from the gap of the blow may add
    assert strict(run)


@pytest.mark.parametrize(("drop", "speed"), [(0.003, 0.0), (0.02, 0.0), (5e-4, 1.0)])
def test_a_rebound_that_the_blow_pays_for_in_part_loses_little(drop: float, speed: float) -> None:
    e, period = MAX_RESTITUTION, 1e-3
    run = started(
        scene(BALL.format(height=drop + RADIUS), damping_of(e), GRAVITY),
        {"ball": np.array([0.0, 0.0, -speed, 0.0, 0.0, 0.0])},
    )
    whole = drop + speed**2 / (2 * GRAVITY) + 0.5 * period * speed
    time = 2.2 * np.sqrt(2 * whole / GRAVITY)
    heights = resting(run, time, lambda d: d.body("ball").xpos[2] - RADIUS)
    assert 0.97 * e**2 * whole < apexes(heights)[0] < 0.995 * e**2 * whole  # it was lowered
    assert strict(run)


def test_a_ball_that_is_pulled_away_leaves_with_e_of_its_speed() -> None:
    e = e_of(0.1)
    run = started(
        scene(BALL.format(height=RADIUS + 0.0025), 0.1, -80.0),
        {"ball": np.array([0.0, 0.0, -1.0, 0.0, 0.0, 0.0])},
    )
    speeds = resting(run, 0.006, lambda d: d.joint("ball").qvel[2])
    blow = int(np.flatnonzero(np.diff(speeds) > 0.5)[0])
    assert speeds[blow + 1] == pytest.approx(-e * speeds[blow], rel=2e-3)
    assert strict(run)


WALLS = """<geom type="box" size="0.01 0.1 0.1" pos="0.11 0 0"/>
  <geom type="box" size="0.01 0.1 0.1" pos="-0.11 0 0"/>
  <body name="ball"><joint name="ball" type="slide" axis="1 0 0"/>
    <geom size="0.02" mass="0.05"/></body>"""
STOPS = """<body name="arm"><joint name="ball" axis="0 1 0" limited="true" range="-0.1 0.1"/>
    <geom size="0.02" pos="0.1 0 0" mass="0.05" contype="0" conaffinity="0"/></body>"""
SLED = STOPS.replace('axis="0 1 0"', 'type="slide" axis="0 1 0"')


@pytest.mark.parametrize("bodies", [WALLS, STOPS, SLED])
@pytest.mark.parametrize("damping", [0.05, 0.2, 0.5])
def test_each_blow_between_two_walls_or_stops_leaves_e_of_the_speed(
    bodies: str, damping: float
) -> None:
    e = e_of(damping)
    run = started(scene(bodies, damping), {"ball": 2.0})
    speeds = np.abs(resting(run, 1.5, lambda d: d.joint("ball").qvel[0]))
    levels = speeds[np.flatnonzero(np.abs(np.diff(speeds)) > 1e-6) + 1]
    expected = 2.0 * e ** np.arange(1, levels.size + 1)
    is_blow = expected > 0.06
    assert is_blow.sum() >= 2
    assert levels[is_blow] == pytest.approx(expected[is_blow], rel=2e-3)
    assert strict(run)


def test_the_damping_of_two_geoms_is_mixed_as_mujoco_does() -> None:
    mixed = WALLS.replace('mass="0.05"', 'mass="0.05" solref="0.02 0.1" solmix="3"')
    run = started(scene(mixed, 0.5), {"ball": 1.0})
    speeds = resting(run, 0.15, lambda d: d.joint("ball").qvel[0])
    assert speeds[-1] == pytest.approx(-e_of(0.75 * 0.1 + 0.25 * 0.5), rel=2e-3)


def test_a_damped_contact_stops_dead_and_a_springy_one_keeps_a_little() -> None:
    for damping, expected in ((1.0, 0.0), (0.76, 0.0), (1e-6, MAX_RESTITUTION)):
        run = started(scene(WALLS, damping), {"ball": 1.0})
        speeds = resting(run, 0.12, lambda d: d.joint("ball").qvel[0])
        assert -speeds[-1] == pytest.approx(expected, abs=2e-3)
        assert source_of(rigid_restitution)(0.02, damping) == expected


PAIR = """<body name="one" pos="-0.1 0 0"><joint name="one" type="slide" axis="1 0 0"/>
    <geom size="0.02" mass="0.05"/></body>
  <body name="two" pos="0.1 0 0"><joint name="two" type="slide" axis="1 0 0"/>
    <geom size="0.02" mass="0.2"/></body>"""


def test_two_bodies_part_with_e_of_their_approach_and_keep_their_momentum() -> None:
    e, ends = e_of(0.1), np.zeros(2)

    def note(_: int, data: mujoco.MjData) -> None:
        ends[:] = data.joint("one").qvel[0], data.joint("two").qvel[0]

    go_on(started(scene(PAIR, 0.1), {"one": 1.5, "two": -0.5}), at_rest(200), after_tick=note)
    assert ends[1] - ends[0] == pytest.approx(2.0 * e, rel=2e-3)
    assert 0.05 * ends[0] + 0.2 * ends[1] == pytest.approx(0.05 * 1.5 - 0.2 * 0.5)


SKIMMING = """<geom type="plane" size="50 50 .1"/>
  <body name="ball" pos="0 0 0.0213"><freejoint name="ball"/>
    <geom size="0.02" mass="0.05"/></body>"""


@pytest.mark.parametrize("damping", [0.05, 0.5])
@pytest.mark.parametrize(("friction", "slide"), [(0.4, 3.0), (0.6, 3.0), (1.0, 3.0), (1.0, 8.0)])
def test_a_ball_that_skims_the_ground_rebounds_with_its_whole_e(
    friction: float, slide: float, damping: float
) -> None:
    """Friction turns a ball and slows it, and does not lift it."""
    e, inertia = e_of(damping), 0.4
    start = np.array([slide, 0.0, -1.0, 0.0, 0.0, 0.0])
    run = started(scene(SKIMMING, damping, friction=friction), {"ball": start})
    end = followed(run, at_rest(4), lambda d: d.joint("ball").qvel[2])[-1]
    assert end == pytest.approx(e, rel=5e-3)
    stopped = min(friction * (1.0 + e), slide / (1.0 + 1.0 / inertia))  # slides on, or rolls
    assert run.scene.data.joint("ball").qvel[0] == pytest.approx(slide - stopped, abs=0.01)
    assert strict(run)


@pytest.mark.parametrize(("torsion", "spin"), [(0.005, 100.0), (0.01, 10.0), (0.02, 300.0)])
def test_a_ball_that_spins_about_the_normal_rebounds_with_its_whole_e(
    torsion: float, spin: float
) -> None:
    e = e_of(0.2)
    start = np.array([0.0, 0.0, -1.0, 0.0, 0.0, spin])
    wanted = f'friction="0.3 {torsion} 0" condim="4"'
    xml = scene(SKIMMING, 0.2).replace('friction="0.0 0 0"', wanted)
    run = started(xml, {"ball": start})
    end = followed(run, at_rest(4), lambda d: d.joint("ball").qvel[2])[-1]
    assert end == pytest.approx(e, rel=5e-3)
    slowed = torsion * (1.0 + e) / (0.4 * 0.02**2)
    assert run.scene.data.joint("ball").qvel[5] == pytest.approx(max(spin - slowed, 0.0), abs=0.5)
    assert strict(run)


# Energy

ROD = """<geom type="plane" size="5 5 .1"/>
  <body name="rod" pos="0 0 {height}"><joint name="x" type="slide" axis="1 0 0"/>
    <joint name="z" type="slide" axis="0 0 1"/><joint name="turn" axis="0 -1 0"/>
    <inertial pos="0 0 0" mass="1" diaginertia="0.1 {inertia} 0.1"/>
    <geom size="1e-4" pos="{x} 0 {z}"/></body>"""


@dataclass
class RodBlow:
    """Blow of a uniform rod's tip; energies in J, velocities of the tip in m/s."""

    created: float
    tip: Array
    run: Run


def fallen_rod(
    angle: float, velocity: tuple[float, float], damping: float, friction: float, paid: float | None
) -> RodBlow:
    """Lets the tip of a rod of 1 kg and 1 m strike the ground in its second step."""
    arm = -0.5 * np.array([np.cos(angle), np.sin(angle)])
    bodies = ROD.format(
        height=1.5 * T * abs(velocity[1]) - arm[1], inertia=1 / 12, x=arm[0], z=arm[1] + 1e-4
    )
    start = {"x": velocity[0], "z": velocity[1]}
    run = started(scene(bodies, damping, friction=friction), start, paid=paid)
    first = np.array([velocity[0], velocity[1], 0.0])
    ends = []

    def note(_: int, data: mujoco.MjData) -> None:
        # before energy that a step created is taken from the motion
        ends.append(first + T * np.array([data.joint(j).qacc[0] for j in ("x", "z", "turn")]))

    go_on(run, at_rest(2), after_tick=note)
    inertia = np.array([1.0, 1.0, 1 / 12])
    end = ends[-1]
    created = 0.5 * float(inertia @ (end**2 - first**2))
    tip = np.array([end[0] - end[2] * arm[1], end[1] + end[2] * arm[0]])
    return RodBlow(created, tip, run)


def test_newtons_rule_alone_creates_the_known_energy_and_poissons_impulse_takes_some() -> None:
    e = 0.9
    damping = damping_of(e)
    body = ImpactBody(1.0, 1 / 12, np.array([-0.5, -0.5]) * np.sqrt(0.5))
    start = np.array([0.8, -1.0])
    newton, poisson = (resolve_impact(body, start, 0.75, e, law) for law in ("newton", "poisson"))
    alone = fallen_rod(np.pi / 4, (0.8, -1.0), damping, 0.75, np.inf)
    assert alone.created == pytest.approx(float(newton.energy_change), rel=0.01)
    assert alone.created == pytest.approx(0.040625, rel=0.01)
    assert alone.tip == pytest.approx([0.0, e], abs=2e-3)
    blow = fallen_rod(np.pi / 4, (0.8, -1.0), damping, 0.75, None)
    assert blow.created == pytest.approx(-0.144055, rel=2e-3)
    assert blow.tip == pytest.approx(poisson.velocity, abs=1e-3)


def test_random_rods_have_the_smaller_of_newtons_and_poissons_rebound() -> None:
    generator = np.random.default_rng(5)
    alone, created, errors = [], [], []
    for _ in range(60):
        angle, friction = generator.uniform(0.1, np.pi - 0.1), generator.uniform(0.3, 1.0)
        e = generator.uniform(0.7, 0.95)
        velocity = generator.uniform(-2.0, 2.0), -generator.uniform(0.5, 3.0)
        case = angle, velocity, damping_of(e), friction
        alone.append(fallen_rod(*case, np.inf).created)
        blow = fallen_rod(*case, None)
        created.append(blow.created)
        assert strict(blow.run)
        body = ImpactBody(1.0, 1 / 12, -0.5 * np.array([np.cos(angle), np.sin(angle)]))
        newton, poisson = (
            resolve_impact(body, np.array(velocity), friction, e, law)
            for law in ("newton", "poisson")
        )
        smaller = min(newton, poisson, key=lambda law: float(law.impulse[1]))
        if smaller.mode <= Mode.STICKS_IN_COMPRESSION:  # one step has no friction that turns round
            errors.append(np.abs(blow.tip - smaller.velocity).max() / -velocity[1])
    assert max(alone) > 0.01
    assert max(created) < 0.0
    assert len(errors) > 40
    assert max(errors) < 0.02


@pytest.mark.parametrize(
    ("mass", "friction_loss", "e"),
    [(1.0, 300.0, 0.9), (1.0, 300.0, 0.98), (2.0, 300.0, 0.9), (5.0, 50.0, 0.98)],
)
def test_a_joint_with_dry_friction_gains_nothing_in_a_blow(
    mass: float, friction_loss: float, e: float
) -> None:
    """MuJoCo's friction drags a body on that a blow has slowed, by 17 to 130 mJ here."""
    bodies = f"""<body name="one" pos="-0.0205 0 0">
        <joint name="one" type="slide" axis="1 0 0" frictionloss="{friction_loss}"/>
        <geom size="0.02" mass="{mass}"/></body>
      <body name="two" pos="0.02 0 0"><joint name="two" type="slide" axis="1 0 0"/>
        <geom size="0.02" mass="1"/></body>"""
    run = started(scene(bodies, damping_of(e)), {"one": 1.0})
    run.binding.state["contact"]["cap"] = 0.0  # nothing that was burned before pays
    energies = [0.5 * mass]

    def note(_: int, data: mujoco.MjData) -> None:
        one, two = data.joint("one").qvel[0], data.joint("two").qvel[0]
        energies.append(0.5 * (mass * one**2 + two**2))

    go_on(run, at_rest(3), after_tick=note)
    assert run.scene.data.joint("two").qvel[0] > 0.3  # it was struck
    assert np.diff(energies).max() < 0.0


# Behind the coupling

PADDLE = """<body name="tool"><freejoint/>
    <geom type="box" size="0.06 0.06 0.005" mass="0.1"/><site name="grip"/></body>
  <body name="ball" pos="0.01 0 0.08"><joint name="ball" type="slide" axis="0 0 1"/>
    <geom size="0.02" mass="0.05"/></body>
  <geom type="plane" pos="0 0 -0.03" size="1 1 .1"/>"""


def shaken(seed: int, count: int = 2000) -> np.ndarray:
    """Returns samples of a hand that beats up and down and leans the paddle."""
    generator = np.random.default_rng(seed)
    time = T * np.arange(1, count + 1)
    places = np.zeros((count, 3))
    for amplitude, slowest, fastest in ((0.012, 1.5, 3.0), (0.006, 3.0, 7.0)):
        frequency = generator.uniform(slowest, fastest)
        places[:, 2] += amplitude * np.sin(2 * np.pi * frequency * time)
    places[:, 0] = 0.01 * np.sin(2 * np.pi * generator.uniform(0.5, 2.0) * time)
    return samples_of(places)


@pytest.mark.parametrize("method", ["implicit", "lossless"])
def test_a_paddle_under_a_bouncing_ball_is_strict_and_simulated_again_to_the_bit(
    method: str,
) -> None:
    blows = 0
    for seed in range(3):
        xml = scene(PADDLE, 0.05, GRAVITY, friction=0.4)
        live, again = started(xml, method=method), started(xml, method=method)
        speeds = followed(live, shaken(seed), lambda d: d.joint("ball").qvel[0])
        blows += int((np.diff(speeds) > 0.5).sum())
        assert strict(live), seed
        again.ticks = np.zeros(2000, TICK_DTYPE)
        done = simulate(again.binding.state, shaken(seed), again.binding.row, again.ticks)
        assert done == 2000
        assert again.ticks.tobytes() == live.ticks.tobytes()
    assert blows >= 6


@pytest.mark.parametrize("method", ["implicit", "lossless"])
def test_a_recorded_run_with_blows_is_audited_to_the_bit(tmp_path: Path, method: str) -> None:
    path, blows = tmp_path / "paddle.xml", []
    path.write_text(scene(PADDLE, 0.05, GRAVITY, friction=0.4), encoding="utf-8")

    def note(bridge: Bridge, _: int) -> None:
        blows.append(float(bridge.scene.data.joint("ball").qvel[0]))

    recorded(tmp_path / "run.mcap", path, duration=1.0, on_tick=note, method=method)
    assert np.diff(blows).max() > 0.5
    report = audit(tmp_path / "run.mcap")
    assert report.resimulation == "bit for bit"
    assert report.environment == "strict"


STRUCK = """<body name="tool"><freejoint/>
    <geom type="box" size="0.03 0.03 0.005" mass="0.1"/><site name="grip"/></body>
  <body name="ball" pos="0 0 {height}"><joint name="ball" type="slide" axis="0 0 1"/>
    <geom size="0.02" mass="0.05"/></body>"""


@pytest.mark.parametrize(
    ("method", "speed", "is_kept"),
    [
        ("implicit", 1.0, True),
        ("implicit", 8.0, True),
        ("lossless", 1.0, True),
        ("lossless", 3.0, True),
        ("lossless", 8.0, False),
    ],
)
def test_a_tool_is_struck_with_the_rebound_it_can_pay_for(
    method: str, speed: float, is_kept: bool
) -> None:
    e = e_of(0.1)
    for phase in np.linspace(0.0, 1.0, 4, endpoint=False):
        xml = scene(STRUCK.format(height=0.075 + phase * speed * T), 0.1)
        run = started(xml, {"ball": -speed}, method)
        parting = resting(run, 0.06 / speed + 5 * T, lambda d: d.qvel[6] - d.qvel[2]).max()
        assert (parting == pytest.approx(e * speed, rel=2e-3)) == is_kept
        assert 0.5 * e * speed < parting < 1.002 * e * speed
        assert strict(run)


def test_the_record_has_the_restitution_at_the_surface() -> None:
    e, speed = e_of(0.1), 0.3
    for phase in np.linspace(0.0, 1.0, 4, endpoint=False):
        run = started(scene(STRUCK.format(height=0.026 + phase * speed * T), 0.1, 50.0))
        run.scene.data.qvel[6] = -speed
        rows = go_on(run, at_rest(30)).ticks
        first = rows[np.flatnonzero(rows["blow_speed"])[0]]
        assert first["blow_restitution"] == pytest.approx(e)
        assert first["blow_rebound"] == pytest.approx(e, rel=2e-3)


PRESSED = """<body name="tool" pos="0 0 0.01"><freejoint/>
    <geom type="box" size="0.015 0.015 0.01" mass="0.1"/><site name="grip"/></body>
  <geom type="plane" size="1 1 .1"/>"""


@pytest.mark.parametrize("method", ["implicit", "lossless"])
def test_a_pressed_and_pushed_tool_rests_to_the_bit_as_without_a_bounce(method: str) -> None:
    places = np.zeros((1000, 3))
    places[:, 2] = -2e-3 * np.minimum(T * np.arange(1000) / 0.2, 1.0)
    places[:, 0] = 4e-3 * np.clip(T * np.arange(1000) / 0.2 - 2.0, 0.0, 1.0)
    found = []
    for damping in (0.02, 1.0):
        run = started(scene(PRESSED, damping, GRAVITY, friction=0.4), method=method)
        assert bool(run.binding.state["contact"]["bounces"][0]) == (damping < 1.0)
        found.append(go_on(run, samples_of(places)).ticks.tobytes())
    assert found[0] == found[1]


HELD = """<body name="tool"><joint type="slide" axis="0 0 1" limited="true" range="-0.004 1"/>
    <geom size="0.01" mass="0.01"/><site name="grip"/></body>"""


def test_a_tool_that_is_pressed_on_is_seen_before_its_next_blow() -> None:
    places = np.zeros((400, 3))
    places[:, 2] = -np.minimum(0.3 * T * np.arange(400), 0.02)  # 38 N
    passed = []
    for flight in (None, 0.0):
        run = started(scene(HELD, 0.25))
        if flight is not None:
            run.binding.state["contact"]["flight"] = flight
        heights = go_on(run, samples_of(places)).ticks["tool_position"][:, 2]
        assert (np.diff(heights) > 1e-5).any()
        assert strict(run)
        passed.append(-0.004 - heights.min())
    assert passed[0] < 1e-5
    assert passed[1] > 2e-5


PLATE = """<body name="plate" mocap="true" pos="0 0 -0.01">
    <geom type="box" size="0.1 0.1 0.01"/></body>
  <body name="ball" pos="0 0 0.02"><joint name="ball" type="slide" axis="0 0 1"/>
    <geom size="0.02" mass="0.05"/></body>"""


def on_plate(run: Run, heights: NDArray[Any]) -> Array:
    """Returns the ball's velocities on a mocap plate that goes through these heights in m."""
    plate = run.scene.model.body("plate").mocapid[0]
    start, speeds = run.scene.data.mocap_pos[plate].copy(), []

    def move(k: int, data: mujoco.MjData) -> None:
        data.mocap_pos[plate] = start + np.array([0.0, 0.0, heights[k]])

    def note(_: int, data: mujoco.MjData) -> None:
        speeds.append(float(data.joint("ball").qvel[0]))

    go_on(run, at_rest(heights.size), on_tick=move, after_tick=note)
    return np.array(speeds)


def test_a_mocap_plate_strikes_with_its_own_speed_and_pays_for_it() -> None:
    run = started(scene(PLATE, 0.1))
    speeds = on_plate(run, 0.5 * T * np.arange(1, 20))
    assert speeds[-1] == pytest.approx((1 + e_of(0.1)) * 0.5, rel=5e-3)
    assert strict(run)


def test_a_ball_that_rests_on_a_receding_plate_does_not_bounce() -> None:
    time: NDArray[Any] = T * np.arange(1, 300)
    run = started(scene(PLATE, 0.05, GRAVITY))
    speeds = on_plate(run, 0.05 * np.cos(2 * np.pi * time) - 0.05)
    exact = -0.05 * 2 * np.pi * np.sin(2 * np.pi * time)
    assert np.abs(speeds - exact).max() < 0.01
    assert strict(run)
