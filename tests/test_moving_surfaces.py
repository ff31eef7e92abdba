"""Work of surfaces that move by themselves, such as belts and turntables."""

from __future__ import annotations

from pathlib import Path

import pytest
from outside_scenes import scene_file

import hapticbridge as hb

SCENE = """<mujoco><option timestep="0.001" cone="{cone}"/><worldbody>
<body name="tool" pos="{tool}" gravcomp="1"><freejoint/><geom size=".02" mass=".1"/>
<site name="grip"/></body>
<geom name="surface" type="box" size="1 .3 .05" surfacevel="{velocity}"/>
<body name="block" pos="0 0 .07"><freejoint/>
<geom type="box" size=".03 .03 .02" mass=".3" condim="{condim}"/></body>
</worldbody></mujoco>"""
MASS, SIDE, SPEED, RATE = 0.3, 0.06, 0.3, 5.0
SURFACES = {
    f"{SPEED} 0 0 0 0 0": MASS * SPEED**2,
    f"0 0 0 0 0 {RATE}": MASS * SIDE**2 / 6.0 * RATE**2,
}
"""Velocities of the surface, and its work in J on a block at rest until this moves along: friction
has the impulse m v, or the angular impulse I ω, at the constant speed of the surface. The block
keeps half of the work."""


@pytest.mark.parametrize("velocity", SURFACES)
@pytest.mark.parametrize("condim", [3, 4, 6])
@pytest.mark.parametrize(
    ("cone", "contact"), [("elliptic", "rigid"), ("elliptic", "scene"), ("pyramidal", "scene")]
)
def test_surface_does_the_work_of_its_speed_times_the_impulse_of_friction(
    tmp_path: Path, velocity: str, condim: int, cone: str, contact: str
) -> None:
    text = SCENE.format(cone=cone, tool="0 1 1", velocity=velocity, condim=condim)
    scene = hb.load_scene(scene_file(tmp_path, text))
    with hb.Bridge(scene, "simulated", clock=hb.SimulatedClock(), contact=contact) as bridge:
        energies = bridge.run(1.0).energies
    work = SURFACES[velocity]
    assert energies["external_work"] == pytest.approx(work, rel=3e-4)
    assert energies["kinetic"] == pytest.approx(0.5 * work, rel=0.01)
    lost = 0.501 * work + 3.5e-4 * (contact == "scene")  # soft contacts also settle
    assert -lost <= energies["environment_energy"] <= -0.49 * work


def test_belt_that_drags_the_tool_is_an_input_and_not_energy_from_nowhere(tmp_path: Path) -> None:
    text = SCENE.format(cone="elliptic", tool="0 .2 .07", velocity="0.1 0 0 0 0 0", condim=3)
    scene = hb.load_scene(scene_file(tmp_path, text.replace(' gravcomp="1"', "")))
    recording = tmp_path / "run.mcap"
    with hb.Bridge(scene, "simulated", clock=hb.SimulatedClock(), recording=recording) as bridge:
        summary = bridge.run(1.0)
    assert summary.environment == "strict"
    report = hb.audit(recording)
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")
    assert "inputs gave or took up to" in str(summary)


@pytest.mark.parametrize("velocity", ["0.3 0 0 0 0 0", "0 0 0 0 0 3", "0.3 0 0 0 0 3"])
def test_a_plate_that_drives_itself_does_not_hop(tmp_path: Path, velocity: str) -> None:
    """Its contacts slide, though it rests; a step that took it for still threw it at 0.2 m/s."""
    plate = """<mujoco><option timestep="0.001"/><worldbody>
    <body name="tool" pos="0 1 1" gravcomp="1"><freejoint/><geom size=".02" mass=".1"/>
    <site name="grip"/></body><geom type="plane" size="2 2 .1"/>
    <body name="plate" pos="0 0 .02"><freejoint/>
    <geom type="box" size=".2 .2 .02" mass="5" surfacevel="{0}"/></body></worldbody></mujoco>"""
    scene, speeds = hb.load_scene(scene_file(tmp_path, plate.format(velocity))), []
    with hb.Bridge(scene, "simulated", clock=hb.SimulatedClock()) as bridge:
        bridge.run(0.3, lambda _: speeds.append(float(bridge.scene.data.qvel[8])))
    assert max(map(abs, speeds)) < 0.02
