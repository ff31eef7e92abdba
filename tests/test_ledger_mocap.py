"""Work of mocap bodies that are moved, against weight times height."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from kernel_runs import (
    Array,
    OnTick,
    Run,
    T,
    at_rest,
    live,
    mjcf,
    rotation,
)
from ledger_scenes import GRAVITY, ROPE, SLIDER, SOLID, G, smooth
from scipy.spatial.transform import Rotation


def _moving_mocap(
    move: Callable[[int], tuple[tuple[float, float, float], tuple[float, float, float]]],
) -> OnTick:
    """Moves the first mocap body of the scene by a displacement and a rotation vector."""
    start: dict[str, Array] = {}

    def on_tick(tick: int, data: Any) -> None:
        start.setdefault("position", data.mocap_pos[0].copy())
        start.setdefault("quaternion", data.mocap_quat[0].copy())
        displacement, turn = move(tick)
        data.mocap_pos[0] = start["position"] + displacement
        turned = Rotation.from_rotvec(turn) * rotation(start["quaternion"])
        data.mocap_quat[0] = turned.as_quat(scalar_first=True)

    return on_tick


NO_TURN = (0.0, 0.0, 0.0)


LIFT, LIFT_TICKS = 0.1, 1000


def _lift(tick: int) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    return (0.0, 0.0, smooth(tick, LIFT_TICKS, LIFT)), NO_TURN


BLOCK_MASS = 0.5


BLOCK = f"""
    <body name="block" pos="0 0 0.0299"><freejoint/>
      <geom type="box" size="0.02 0.02 0.02" mass="{BLOCK_MASS}" {SOLID}/>
    </body>"""


TABLE = f'<geom type="box" size="0.1 0.1 0.01" mass="0" {SOLID}/>'


HUNG = f"""
    <body name="block" pos="0 0 -0.1"><freejoint/>
      <geom type="box" size="0.02 0.03 0.04" mass="{BLOCK_MASS}"/><site name="b"/>
    </body>"""


WELD = '<equality><weld body1="m" body2="block" solref="0.004 1"/></equality>'


LIFTERS = {
    "contact": f'<body name="m" mocap="true">{TABLE}</body>{BLOCK}',
    "contact of a body fixed to it": (
        f'<body name="m" mocap="true"><body>{TABLE}</body></body>{BLOCK}'
    ),
    "contact of a body sprung to it": f"""
        <body name="m" mocap="true">
          <body><joint type="slide" axis="0 0 1" stiffness="50000" damping="20"/>
            <geom type="box" size="0.1 0.1 0.01" mass="0.05" {SOLID}/>
          </body>
        </body>{BLOCK}""",
}


HANGERS = {
    "weld": ("", WELD),
    "connect": (
        "",
        '<equality><connect body1="m" body2="block" anchor="0 0 0" solref="0.004 1"/></equality>',
    ),
    "connect, named the other way": (
        "",
        '<equality><connect body1="block" body2="m" anchor="0 0 0.1" solref="0.004 1"/></equality>',
    ),
    "rope at its length": (
        '<site name="a"/>',
        ROPE.format('range="0 0.1" solreflimit="0.004 1"'),
    ),
    "tendon of fixed length": (
        '<site name="a"/>',
        ROPE.format('springlength="0.1"')
        + '<equality><tendon tendon1="t" solref="0.004 1"/></equality>',
    ),
    "tendon spring": ('<site name="a"/>', ROPE.format('stiffness="3000" springlength="0.1"')),
}


def _lifted(world: str, rest: str = "", substeps: int = 1, on_tick: OnTick | None = None) -> Run:
    scene = mjcf(SLIDER + world, rest, GRAVITY)
    return live(
        scene, at_rest(LIFT_TICKS + 300), on_tick=on_tick or _moving_mocap(_lift), substeps=substeps
    )


# a lift of 0.1 m in 1 s dissipates some mJ in constraint dampers and in the implicit step; a start
# in contact settles by 0.1 mm, 0.5 mJ
LIFT_TOLERANCE = 0.004


@pytest.mark.parametrize("name", LIFTERS)
def test_mocap_body_that_lifts_a_block_by_contact_does_the_work_of_its_weight(name: str) -> None:
    run = _lifted(LIFTERS[name])
    assert run.ticks["contacts"].max() >= 4
    weight = BLOCK_MASS + (0.05 if "sprung" in name else 0.0)
    assert run.ledger.external_work == pytest.approx(weight * G * LIFT, abs=LIFT_TOLERANCE)
    assert run.ledger.environment_energy == pytest.approx(0, abs=LIFT_TOLERANCE)


def test_pyramidal_contact_is_metered_like_an_elliptic_one() -> None:
    scene = mjcf(SLIDER + LIFTERS["contact"], "", GRAVITY).replace('"elliptic"', '"pyramidal"')
    run = live(scene, at_rest(LIFT_TICKS + 300), on_tick=_moving_mocap(_lift))
    assert run.ledger.external_work == pytest.approx(BLOCK_MASS * G * LIFT, abs=LIFT_TOLERANCE)


@pytest.mark.parametrize("name", HANGERS)
def test_mocap_body_that_lifts_a_block_hung_on_it_does_the_work_of_its_weight(name: str) -> None:
    site, rest = HANGERS[name]
    run = _lifted(f'<body name="m" mocap="true">{site}</body>{HUNG}', rest)
    # a mocap body moves in jumps: each stretches a spring of 3000 N/m by up to 0.19 mm at once, and
    # the implicit step burns ½kδ² of it
    tolerance = 0.03 if "spring" in name else LIFT_TOLERANCE
    assert run.ledger.external_work == pytest.approx(BLOCK_MASS * G * LIFT, abs=tolerance)
    assert -tolerance < run.ledger.environment_energy < 1e-9


def test_wrench_that_a_user_applies_to_a_mocap_body_does_no_work() -> None:
    # it moves nothing: MuJoCo gives a mocap body no dynamics
    move = _moving_mocap(_lift)

    def on_tick(tick: int, data: Any) -> None:
        move(tick, data)
        data.xfrc_applied[2] = (0, 0, -30, 0, 0, 0)

    run = _lifted(LIFTERS["contact"], on_tick=on_tick)
    assert run.scene.model.body("m").id == 2
    assert run.ledger.external_work == pytest.approx(BLOCK_MASS * G * LIFT, abs=LIFT_TOLERANCE)


@pytest.mark.parametrize("substeps", [1, 4])
def test_tendon_spring_between_mocap_body_and_world_takes_exactly_its_potential(
    substeps: int,
) -> None:
    world = '<body name="m" mocap="true" pos="0 0 0.1"><site name="a"/></body><site name="b"/>'
    spring = ROPE.format('stiffness="1000" springlength="0"')
    run = _lifted(world, spring, substeps)
    assert run.ledger.external_work == pytest.approx(500 * (0.2**2 - 0.1**2), rel=1e-12)
    assert np.abs(run.ticks["environment_energy"]).max() < 1e-12


def test_pendulum_carried_by_a_mocap_body_gains_its_weight_times_the_height() -> None:
    world = """
        <body name="m" mocap="true">
          <body><joint axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02"
                mass="0.5"/></body>
        </body>"""
    run = _lifted(world)
    assert run.ledger.external_work == pytest.approx(0.5 * G * LIFT, rel=1e-12)
    assert np.abs(run.ticks["environment_energy"]).max() < 1e-12


def test_mocap_body_that_turns_a_welded_block_does_the_work_of_its_weight() -> None:
    def turn(tick: int) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        return (0.0, 0.0, 0.0), (0.0, smooth(tick, LIFT_TICKS, 2.0), 0.0)

    run = _lifted('<body name="m" mocap="true"/>' + HUNG, WELD, on_tick=_moving_mocap(turn))
    assert run.ledger.external_work == pytest.approx(
        BLOCK_MASS * G * 0.1 * (1 - np.cos(2.0)), abs=2 * LIFT_TOLERANCE
    )


def test_mocap_table_that_tilts_under_a_block_does_the_work_of_its_weight() -> None:
    def tilt(tick: int) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        return (0.0, 0.0, 0.0), (0.0, -smooth(tick, LIFT_TICKS, 0.2), 0.0)

    block = BLOCK.replace('pos="0 0', 'pos="0.05 0')
    run = _lifted(f'<body name="m" mocap="true">{TABLE}</body>{block}', on_tick=_moving_mocap(tilt))
    risen = run.stored()[-1] / (BLOCK_MASS * G)
    assert risen == pytest.approx(0.05 * np.sin(0.2), rel=0.05)  # it stays where it was put
    assert run.ledger.external_work == pytest.approx(run.stored()[-1], abs=1e-3)


@pytest.mark.parametrize("direction", [-1.0, 1.0])
def test_table_that_slides_under_a_block_takes_no_part_in_its_friction(direction: float) -> None:
    """To MuJoCo a mocap body has no velocity: a sliding block feels the same friction on it."""

    def scene_run(speed: float) -> Run:
        def slide(tick: int) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
            return (speed * (tick + 1) * T, 0.0, 0.0), NO_TURN

        move = _moving_mocap(slide)

        def on_tick(tick: int, data: Any) -> None:
            move(tick, data)
            data.xfrc_applied[3, 0] = 8.0

        table = TABLE.replace("0.1 0.1 0.01", "3 0.1 0.01")
        world = SLIDER + f'<body name="m" mocap="true">{table}</body>{BLOCK}'
        return live(mjcf(world, "", GRAVITY), at_rest(300), on_tick=on_tick)

    still, sliding = scene_run(0.0), scene_run(direction * 0.1)
    assert still.ledger.external_work > 1.0
    assert sliding.ledger.external_work == pytest.approx(still.ledger.external_work, rel=1e-6)
    assert sliding.ledger.environment_energy == pytest.approx(
        still.ledger.environment_energy, rel=1e-6
    )
