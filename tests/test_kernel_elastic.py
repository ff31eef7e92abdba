"""The elastic energy of flexes, against the energy density of the continuum."""

from __future__ import annotations

import warnings
from pathlib import Path

import mujoco
import numpy as np
import pytest
from audit_cases import recorded
from check_scenes import faults_of
from kernel_runs import Array, at_rest, bind, live, load, mjcf

import hapticbridge as hb
from hapticbridge.audit import audit
from hapticbridge.audit.replay import Agreement
from hapticbridge.recording import read_recording
from hapticbridge.report.evidence import Evidence
from hapticbridge.report.search import likely_cause
from hapticbridge.run.commands import Reset
from hapticbridge.scene.physics import gradientless_flexes, storing_flex, unstored_words

TOOL = """<body name="tool" pos="0 0 -1"><freejoint/><geom size=".015" mass=".1"/>
  <site name="grip"/></body>"""
YOUNG, POISSON = 2e4, 0.3
CORNERS = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]])
TETRAHEDRON = f"""<flexcomp name="f" type="direct" dim="3" mass=".1" radius=".001"
  point="{" ".join(map(str, CORNERS.ravel()))}" element="0 1 2 3">
  <contact selfcollide="none" contype="0" conaffinity="0"/>
  <elasticity young="{YOUNG}" poisson="{POISSON}" damping="1e-9"/></flexcomp>"""


def stretched(moved: Array) -> str:
    """Returns a scene that starts with the corners moved by (4, 3) in m."""
    qpos = "0 0 -1 1 0 0 0 " + " ".join(map(str, moved.ravel()))
    return mjcf(TOOL + TETRAHEDRON, f'<keyframe><key name="home" qpos="{qpos}"/></keyframe>')


def energy_of(corners: Array) -> float:
    """Returns μ tr(ε²) + λ/2 (tr ε)² times the volume, with Green's strain ε of a tetrahedron."""
    shear = YOUNG / (2 * (1 + POISSON))
    lame = YOUNG * POISSON / ((1 + POISSON) * (1 - 2 * POISSON))
    edges, rest = (corners[1:] - corners[0]).T, (CORNERS[1:] - CORNERS[0]).T
    gradient = edges @ np.linalg.inv(rest)
    strain = 0.5 * (gradient.T @ gradient - np.eye(3))
    density = shear * np.trace(strain @ strain) + 0.5 * lame * np.trace(strain) ** 2
    return float(density * np.linalg.det(rest) / 6)


def test_a_start_stores_what_the_continuum_stores() -> None:
    for seed in range(5):
        moved = np.random.default_rng(seed).normal(0, 0.02, (4, 3))
        binding, _ = bind(load(stretched(moved)))
        found = float(binding.state["elastic"]["stored"][0])
        assert found == pytest.approx(energy_of(CORNERS + moved), rel=1e-9)


def test_stored_and_kinetic_energy_of_a_flex_do_not_grow_and_are_exchanged() -> None:
    """A tetrahedron that springs back: its kinetic energy comes out of the elastic one."""
    stored = energy_of(1.1 * CORNERS)
    assert stored > 1e-2
    corners = []
    run = live(
        stretched(0.1 * CORNERS),  # every length is by a tenth too large
        at_rest(100),
        after_tick=lambda _, data: corners.append(data.flexvert_xpos.copy()),
    )
    potential = run.ticks["potential"]
    assert potential == pytest.approx([energy_of(each) for each in corners], abs=1e-6)
    assert potential.min() < 0.2 * stored < run.ticks["kinetic"].max()
    # implicit Euler loses energy in each step, and never gains any
    assert np.diff(run.ticks["environment_energy"], prepend=0.0).max() < 1e-12


def test_a_flex_that_springs_back_is_no_energy_from_nowhere(tmp_path: Path) -> None:
    """Also after a reset, which stretches it again; the audit repeats all of it bit for bit."""
    path = tmp_path / "scene.xml"
    path.write_text(stretched(0.1 * CORNERS))

    def on_tick(bridge: hb.Bridge, tick: int) -> None:
        if tick == 60:
            bridge.command(Reset())

    run = tmp_path / "run.mcap"
    recorded(run, path, duration=0.15, on_tick=on_tick)
    report = audit(run)
    assert report.verdict == "passive", report
    assert report.agreement is Agreement.EXACT
    potential = read_recording(run).ticks["potential"]
    (again,) = np.flatnonzero(np.isclose(potential[1:], potential[0], rtol=1e-9)) + 1
    assert again >= 60
    assert potential[again - 1] < 0.9 * potential[0]


ROD = """<flexcomp name="f" type="direct" dim="1" mass=".1" radius=".005"
  point="0 0 0 .1 0 0 .2 0 0" element="0 1 1 2">
  <contact selfcollide="none" contype="0" conaffinity="0"/>
  <elasticity young="1e5" poisson=".3" damping="1e-6"/></flexcomp>"""


@pytest.mark.parametrize("angle", [0.5, 2.0, 3.08])
def test_a_rod_that_starts_folded_stores_the_energy_of_its_curvature(angle: float) -> None:
    """½ E I κ²/l with κ = 2 tan(angle/2), of two edges of length l = 0.1 m."""
    end = 0.1 * np.array([np.cos(angle) - 1.0, np.sin(angle), 0.0])
    moved = " ".join(map(str, [0, 0, -1, 1, 0, 0, 0, *np.zeros(6), *end]))
    scene = mjcf(TOOL + ROD, f'<keyframe><key name="home" qpos="{moved}"/></keyframe>')
    binding, _ = bind(load(scene))
    stiffness = 1e5 * np.pi * 0.005**4 / 4
    energy = 0.5 * stiffness * (2 * np.tan(angle / 2)) ** 2 / 0.1
    assert float(binding.state["elastic"]["stored"][0]) == pytest.approx(energy, rel=1e-7)


PLATE = """<flexcomp name="f" type="grid" dim="2" count="4 4 1" spacing=".05 .05 .05" mass=".1"
  radius=".005"><contact selfcollide="none" contype="0" conaffinity="0"/>
  <elasticity young="1e5" poisson=".3" thickness="5e-3" elastic2d="both" yield="0.005"
  damping="1e-6"/></flexcomp>"""


@pytest.mark.parametrize(("substeps", "spread"), [(1, 0.004), (4, 0.004), (4, 0.03)])
def test_a_flex_that_yields_creates_no_energy(substeps: int, spread: float) -> None:
    """The force of a step has the strains from before it, and so has its work."""
    moved = np.random.default_rng(3).normal(0, spread, 48)
    qpos = "0 0 -1 1 0 0 0 " + " ".join(map(str, moved))
    scene = mjcf(TOOL + PLATE, f'<keyframe><key name="home" qpos="{qpos}"/></keyframe>')
    run = live(scene, at_rest(20), substeps=substeps)
    assert np.abs(run.scene.data.plastic).max() > 1e-3
    assert run.ticks["environment_energy"].max() < 1e-12


JELLY = """<flexcomp name="jelly" type="grid" dim="3" count="3 3 3" spacing=".05 .05 .05" mass=".2"
  radius=".005" dof="{}"><contact selfcollide="none"/>
  <elasticity young="{}" poisson=".3" damping="1e-9"/></flexcomp>"""


@pytest.mark.parametrize("dof", ["full", "trilinear", "quadratic"])
def test_a_flex_whose_force_has_no_energy_is_told_by_run_and_check(
    tmp_path: Path, dof: str
) -> None:
    path = tmp_path / "scene.xml"
    path.write_text(mjcf(TOOL + JELLY.format(dof, "2e4")))
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        scene = hb.load_scene(path)
    words = f"flex 'jelly' has dof=\"{dof}\", and MuJoCo's force is there no gradient of an energy"
    assert any(words in str(each.message) for each in warned) == (dof != "full")
    if dof != "full":
        gave = unstored_words(scene.model, 0.01)
        assert gave.startswith("the elasticity of flex 'jelly' gave 10 mJ that it never stored: ")
        assert "bending" not in gave
        assert storing_flex(scene.model, 1e-3).startswith('write dof="full"')
    found = [fault for fault in faults_of(path) if fault.kind == "flex without energy"]
    assert len(found) == (dof != "full")
    assert all(words in fault.sentence for fault in found)
    path.write_text(mjcf(TOOL + JELLY.format(dof, "0")))  # without elasticity nothing is stored
    assert gradientless_flexes(mujoco.MjModel.from_xml_path(str(path))) == ""


BASKET = """<flexcomp name="basket" type="box" dim="2" count="3 3 3" spacing=".1 .1 .1" mass=".02"
  radius=".01"><contact selfcollide="none" contype="0" conaffinity="0"/>
  <edge equality="true" solref="{}"/>
  <elasticity young="6e6" poisson=".2" thickness="8e-3" elastic2d="bend"
  damping="1e-5"/></flexcomp>"""


def test_bending_whose_edges_give_way_is_the_cause_and_firm_edges_help(tmp_path: Path) -> None:
    path, run = tmp_path / "scene.xml", tmp_path / "run.mcap"
    path.write_text(mjcf(TOOL + BASKET.format("0.02 1")))
    recorded(run, path, duration=0.12)
    report, recording = audit(run), read_recording(run)
    assert report.verdict == "active"
    evidence = Evidence.of(recording)
    assert evidence is not None
    cause = likely_cause(evidence, report)
    assert cause is not None
    assert cause.kind == "bottomless flex"
    assert "flex 'basket' gave" in cause.evidence
    assert 'solref="0.002 1"' in cause.remedy
    path.write_text(mjcf(TOOL + BASKET.format("0.002 1")))
    run.unlink()
    recorded(run, path, duration=0.2)
    assert read_recording(run).ticks["kinetic"].max() < 1.0
