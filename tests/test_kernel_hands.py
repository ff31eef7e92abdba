"""Two hands in one scene: one balance for both, the same body held twice, two bodies in contact."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from two_hands import (
    BAR,
    PEG_AND_BLOCK,
    SCENES,
    UNPAID,
    attacked,
    bound_hands,
    two_handed,
    unmoved,
)

from hapticbridge.coupling import Coupling
from hapticbridge.demand.methods import method_named
from hapticbridge.errors import HapticBridgeError, SceneError
from hapticbridge.kernel.tick import whole_tick
from hapticbridge.scene import load_scene

PERIOD = 1e-3
COUPLING = Coupling(800.0, 1.0, 0.5, 1e-3)
IMPLICIT = method_named("implicit").with_contact(None)


def test_a_bar_in_two_hands_carries_the_force_from_one_to_the_other() -> None:
    scene = two_handed(BAR)
    bound = bound_hands(scene, (COUPLING, COUPLING), PERIOD, IMPLICIT)
    samples = unmoved()
    samples["position"][1, 0] = 0.01
    for _ in range(3000):
        assert whole_tick(bound.state, samples, bound.row, PERIOD)
    pull = bound.row["wrench_on_tool"][:, 0]
    # two springs in series, 10 mm long together: 800/2 N/m · 10 mm
    assert pull == pytest.approx([-4.0, 4.0], abs=1e-6)
    assert bound.row["wrench_on_device"][:, 0] == pytest.approx([4.0, -4.0], abs=1e-6)


def test_both_accounts_judge_one_environment_whose_work_adds_up() -> None:
    scene = two_handed(PEG_AND_BLOCK)
    bound = bound_hands(scene, (COUPLING, COUPLING), PERIOD, IMPLICIT)
    samples, work = unmoved(), np.zeros(2)
    data, before = scene.data, bound.row["tool_position"].copy()
    turned = np.zeros(3)
    for hand in range(2):
        before[hand] = data.site(scene.of_hand(hand).grip).xpos
    orientation = np.array([data.site_xquat[scene.model.site(g).id] for g in ("left", "right")])
    for k in range(1500):
        samples["position"][0, 2] = -1e-5 * min(k, 1000)
        samples["position"][1, 0] = 2e-3 * np.sin(0.01 * k)
        assert whole_tick(bound.state, samples, bound.row, PERIOD)
        for hand, row in enumerate(bound.row):
            mujoco.mju_subQuat(turned, row["tool_quaternion"], orientation[hand])
            mujoco.mju_rotVecQuat(turned, turned.copy(), orientation[hand])
            wrench = row["wrench_on_tool"]
            work[hand] += wrench[:3] @ (row["tool_position"] - before[hand]) + wrench[3:] @ turned
            before[hand], orientation[hand] = row["tool_position"], row["tool_quaternion"]
    assert np.any(bound.row["contacts"] > 0)
    assert bound.row["coupling_work"] == pytest.approx(work, abs=1e-12)
    mujoco.mj_forward(scene.model, data)
    stored = data.energy.sum()  # at rest at the start, without weight
    expected = stored - work.sum()
    assert bound.row["environment_energy"] == pytest.approx([expected, expected], abs=1e-12)
    assert expected < -1e-6


def test_a_device_may_receive_what_the_other_hand_puts_in() -> None:
    scene = two_handed(BAR)
    bound = bound_hands(scene, (COUPLING, COUPLING), PERIOD, IMPLICIT)
    samples = unmoved()
    for k in range(2000):  # the left hand drags the right one along, against a pull
        samples["position"][:, 0] = -5e-5 * k, -5e-5 * max(k - 100, 0)
        assert whole_tick(bound.state, samples, bound.row, PERIOD)
    left, right = bound.state["energy"]["device_energy"]
    assert left < -0.05
    assert right > 0.05
    assert bound.state["observer"]["guarded_energy"].max() < 1e-3


@pytest.mark.parametrize("scene", SCENES)
def test_no_two_hands_get_energy_out_of_a_scene(scene: str) -> None:
    outcomes = [attacked(seed, scene) for seed in range(20)]
    assert all(outcome.ticks == 1500 for outcome in outcomes)
    assert max(outcome.most for outcome in outcomes) <= UNPAID
    assert max(outcome.created for outcome in outcomes) <= UNPAID
    assert sum(outcome.repetitions > 0 for outcome in outcomes) > 10


def test_levels_settled_one_after_the_other_create_energy() -> None:
    outcomes = [attacked(seed, "bar", is_joint=False) for seed in range(20)]
    # the greater part is taken back from the turn of the bar
    assert max(outcome.created for outcome in outcomes) > 10 * UNPAID


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"substeps": 2}, "several hands need a method that MuJoCo solves whole, one substep"),
        ({"scheme": 4}, "several hands need a method that MuJoCo solves whole"),
    ],
)
def test_what_several_hands_cannot_have_is_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(HapticBridgeError, match=message):
        bound_hands(two_handed(BAR), (COUPLING, COUPLING), PERIOD, IMPLICIT, **change)


def test_each_hand_has_its_handle_at_its_own_grip() -> None:
    scene = two_handed(BAR)
    handles = scene.data.mocap_pos[-2:]
    assert handles[:, 0] == pytest.approx([-0.1, 0.1])
    with pytest.raises(SceneError, match="no grip is named"):
        load_scene("point_mass", ())
