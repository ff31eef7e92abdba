"""Contacts along whose normal no joint can answer: pucks, drawers, carts, stretched arms."""

from __future__ import annotations

import math
from pathlib import Path

import mujoco
import pytest

import hapticbridge as hb
from hapticbridge.scene.contacts import impedance_at

MASS, DAMPING = 0.05, 0.05
PUCK = """<mujoco><option timestep="0.001" gravity="0 0 0" cone="{cone}"/>
<default><geom friction="{mu}"/></default>
<worldbody><geom name="table" type="plane" size="1 1 0.1"/>
<body name="puck" pos="0 0 {height}">
<joint type="slide" axis="1 0 0" damping="0.05"/><joint type="slide" axis="0 1 0" damping="0.05"/>
<geom type="cylinder" size="0.03 0.02" mass="0.05"/><site name="grip"/></body>
</worldbody></mujoco>"""
DRAWER = """<mujoco><option timestep="0.001"/><default><geom friction="{mu}"/></default><worldbody>
<geom type="box" size=".3 .02 .02" pos="0 {inner} .05"/>
<geom type="box" size=".3 .02 .02" pos="0 -{inner} .05"/>
<body name="drawer" pos="0 0 .05"><joint type="slide" axis="1 0 {tilt}" damping="0.1"/>
<geom type="box" size=".1 .05 .025" mass=".3"/><site name="grip" pos=".1 0 0"/></body>
</worldbody></mujoco>"""
ARM = """<mujoco><option timestep="0.001" gravity="0 0 0"/><worldbody>
<geom name="wall" type="box" size="0.01 0.1 0.1" pos="{wall} 0 0"/>
<body><joint axis="0 0 1" damping="0.01"/>
<geom type="capsule" fromto="0 0 0 0.1 0 0" size="0.01" mass="0.1" contype="0" conaffinity="0"/>
<body pos="0.1 0 0"><joint axis="0 0 1" damping="0.01"/>
<geom name="tip" pos="0.1 0 0" size="0.01" mass="0.1" contype="0" conaffinity="0"/>
<site name="grip" pos="0.1 0 0"/></body></body></worldbody>
<contact><pair geom1="tip" geom2="wall" condim="3" friction="{mu} {mu} .005 .0001 .0001"/></contact>
</mujoco>"""


def scene(folder: Path, xml: str) -> hb.Scene:
    (folder / "scene.xml").write_text(xml)
    return hb.load_scene(folder / "scene.xml")


def pushed(folder: Path, xml: str, force: float, time: float, method: str) -> float:
    """Returns the speed in m/s of the puck after a push in N, in a run that is strict."""
    place = scene(folder, xml)
    hardly = hb.Coupling(1e-6, 0.0, 1e-6, 0.0)
    clock = hb.SimulatedClock()
    with hb.Bridge(
        place, "simulated:hand=none", clock=clock, method=method, coupling=hardly
    ) as bridge:
        bridge.set_input(body_wrench={"puck": (force, 0, 0, 0, 0, 0)})
        assert bridge.run(duration=time).environment == "strict"
    return float(place.data.qvel[0])


def right_speed(mu: float, depth: float, force: float, time: float) -> float:
    """Speed in m/s by Coulomb's law, with the normal force of MuJoCo's law at rest in a depth."""
    model = mujoco.MjModel.from_xml_string(PUCK.format(mu=mu, cone="elliptic", height=0.02 - depth))
    impedance = impedance_at((0.9, 0.95, 0.001, 0.5, 2.0), depth)
    stiffness = 1.0 / (0.95 * 0.02) ** 2
    inverse = model.body_invweight0[1, 0]
    each = stiffness * impedance**2 * depth / ((1.0 - impedance) * inverse)
    net = max(force - mu * 3.0 * each, 0.0)  # a cylinder on a plane has three points
    return float(net / DAMPING * (1.0 - math.exp(-time * DAMPING / MASS)))


@pytest.mark.parametrize("method", ["implicit", "lossless"])
@pytest.mark.parametrize("mu", [0.0, 0.1, 0.4, 1.2])
def test_a_puck_is_rubbed_by_the_force_that_its_depth_gives(
    tmp_path: Path, mu: float, method: str
) -> None:
    for depth, force in ((0.0, 0.5), (1e-5, 0.02), (1e-5, 0.5), (1e-4, 0.5), (5e-4, 10.0)):
        time = 0.02 if force > 1.0 else 0.1
        for cone in ("elliptic", "pyramidal"):
            xml = PUCK.format(mu=mu, cone=cone, height=0.02 - depth)
            speed, right = (
                pushed(tmp_path, xml, force, time, method),
                right_speed(mu, depth, force, time),
            )
            assert speed == pytest.approx(right, rel=0.04, abs=1e-4), (depth, force, cone)


def test_a_puck_that_touches_moves_as_in_mujoco(tmp_path: Path) -> None:
    xml = PUCK.format(mu=0.1, cone="pyramidal", height=0.02)
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    data.qfrc_applied[0] = 10.0
    mujoco.mj_step(model, data, 20)
    assert data.qvel[0] > 3.9
    assert pushed(tmp_path, xml, 10.0, 0.02, "implicit") == pytest.approx(data.qvel[0], rel=1e-3)


@pytest.mark.parametrize("mu", [0.0, 0.3, 1.2])
def test_a_drawer_in_runners_that_touch_follows_the_hand(tmp_path: Path, mu: float) -> None:
    place = scene(tmp_path, DRAWER.format(mu=mu, inner=0.07, tilt=0.0))
    with hb.Bridge(place, "simulated", clock=hb.SimulatedClock()) as bridge:
        assert bridge.run(duration=1.0).environment == "strict"
    assert abs(place.data.qpos[0]) > 4e-3


@pytest.mark.parametrize("tilt", [1e-4, 1e-3, 1e-2, 3e-2])
@pytest.mark.parametrize("overlap", [1e-5, 1e-3])
def test_runners_that_are_nearly_parallel_stay_strict(
    tmp_path: Path, overlap: float, tilt: float
) -> None:
    for mu in (0.0, 0.6):
        place = scene(tmp_path, DRAWER.format(mu=mu, inner=0.07 - overlap, tilt=tilt))
        with hb.Bridge(place, "simulated", clock=hb.SimulatedClock()) as bridge:
            assert bridge.run(duration=1.0).environment == "strict"


@pytest.mark.parametrize("depth", [0.0, 1e-4, 1e-3])
@pytest.mark.parametrize("mu", [0.0, 0.5, 1.2])
def test_a_stretched_arm_that_points_into_a_wall_stays_strict(
    tmp_path: Path, depth: float, mu: float
) -> None:
    for method in ("implicit", "lossless"):
        place = scene(tmp_path, ARM.format(wall=0.22 - depth, mu=mu))
        with hb.Bridge(place, "simulated", clock=hb.SimulatedClock(), method=method) as bridge:
            assert bridge.run(duration=1.0).environment == "strict"
        assert max(map(abs, place.data.qpos)) < 0.5
