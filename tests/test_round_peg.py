"""round_peg: the hole is as round and as wide as stated, and the task succeeds passively."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from model_runs import BOTTOMED_HEIGHT, HOME_HEIGHT, MODELS, run_of_own_path
from random_hands import random_motion, shaken

import hapticbridge as hb
from hapticbridge.device import Hand
from hapticbridge.lab.closed_loop import ClosedLoop

FORCE_LIMIT = 10.0  # N, of the default simulated device


def depth_at(scene: hb.Scene, radius: float, angle: float, height: float = 0.0) -> float:
    """Returns how deep an upright peg's deepest contact is, off centre by a radius in m."""
    data = mujoco.MjData(scene.model)
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    data.qpos[:] = [x, y, height, 1, 0, 0, 0]
    mujoco.mj_forward(scene.model, data)
    return max((-float(contact.dist) for contact in data.contact), default=-np.inf)


@pytest.mark.parametrize("clearance", [0.05e-3, 0.2e-3, 1e-3])
def test_play_of_the_peg_is_the_dodecagon_around_the_clearance(clearance: float) -> None:
    scene = hb.load_scene("round_peg", clearance=clearance)
    for angle in np.radians(np.arange(0.0, 360.0, 7.5)):
        from_middle = (angle + np.pi / 12) % (np.pi / 6) - np.pi / 12
        play = clearance / np.cos(from_middle)
        # the ten corners of a sector are written to a micrometre; the walls they make are exact
        assert depth_at(scene, play - 1e-6, angle) < 0
        assert 0 < depth_at(scene, play + 2e-6, angle) < 2.1e-6


def test_chamfer_is_a_millimetre_at_45_degrees() -> None:
    scene = hb.load_scene("round_peg")
    for off in (0.4e-3, 0.7e-3, 1.1e-3):
        # the lower rim of a peg that is off centre by 0.2 mm + s touches the chamfer s above its
        # foot, which lies 1 mm below the mouth; 0.03 m from the rim to the peg's centre
        touching = 0.03 - 0.001 + (off - 0.2e-3)
        assert depth_at(scene, off, 0.0, touching + 3e-6) < 0
        assert depth_at(scene, off, 0.0, touching - 3e-6) > 0


def test_scripted_path_finds_the_hole_over_the_chamfer_and_reaches_the_bottom() -> None:
    run = run_of_own_path("round_peg")
    height, axis = run.tool[:, 2], np.hypot(run.tool[:, 0], run.tool[:, 1])
    on_the_chamfer = slice(1700, 2500)
    touched = np.any([run.touched[f"sector_{i:02d}"] for i in range(12)], axis=0)
    assert touched[on_the_chamfer].mean() > 0.9
    # it came down beside the hole and slid in along the chamfer
    assert axis[1250] > 0.6e-3
    assert height[on_the_chamfer].min() > 0.028
    assert axis[3000] < 0.2e-3
    assert height.min() == pytest.approx(BOTTOMED_HEIGHT, abs=2e-5)
    assert run.touched["hole_bottom"][6400:6700].all()
    # pushed against the east wall with more than 4 N, the peg 0.2 mm off centre and no further
    assert (run.force[5050:5200, 0] > 4.0).all()
    assert run.tool[5050:5200, 0] == pytest.approx(0.2e-3, abs=30e-6)
    for sector in run.touched:  # the wiggle goes all round
        assert run.touched[sector].any() == (
            sector[:6] == "sector" or sector in {"hole_bottom", "peg"}
        )
    assert height[-1] == pytest.approx(HOME_HEIGHT, abs=1e-3)
    assert run.warnings == 0


def test_bridge_calls_the_scripted_path_passive_and_the_peg_reaches_the_bottom() -> None:
    clock, device = hb.SimulatedClock(), f"trajectory:{MODELS / 'round_peg' / 'round_peg.csv'}"
    with hb.Bridge("round_peg", device, clock=clock) as bridge:
        lowest = np.inf

        def look(_tick: int) -> None:
            nonlocal lowest
            lowest = min(lowest, float(bridge.scene.data.qpos[2]))

        summary = bridge.run(on_tick=look)
        assert not any(warning.number for warning in bridge.scene.data.warning)
    assert summary.verdict == "passive"
    assert lowest == pytest.approx(BOTTOMED_HEIGHT, abs=2e-5)
    assert summary.peak_force < FORCE_LIMIT


@pytest.mark.parametrize(
    "values",
    [{"clearance": 0.05e-3}, {"clearance": 1e-3}, {"friction": 0.02}, {"friction": 1.0}],
    ids=str,
)
def test_ends_of_each_parameter_stay_passive_in_a_stiff_random_hand(
    values: dict[str, float],
) -> None:
    loop = ClosedLoop(hb.load_scene("round_peg", "grip", **values))
    strong = Hand(stiffness=1000.0, damping=20.0, rotational_stiffness=3.0)
    strongest = 0.0
    for seed in range(4):
        outcome = shaken(loop, random_motion(seed, first=-0.045), strong)
        assert outcome.fault is None, f"seed {seed}: {outcome}"
        strongest = max(strongest, outcome.peak_force)
    assert strongest > FORCE_LIMIT
