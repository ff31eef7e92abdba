"""The lossless coupling beside other forces: a user's, and motors of the scene."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest
from lossless_runs import ARM, T, bound, circling, led, scene_of
from rendering_runs import FREE_MASS

from hapticbridge.coupling import Coupling
from hapticbridge.kernel.codes import OK
from hapticbridge.kernel.state import BoundKernel
from hapticbridge.kernel.tick import after_step, before_step
from hapticbridge.record import SAMPLE_DTYPE, TICK_DTYPE, TickFlag
from hapticbridge.scene import Scene

ASKED = Coupling(2400.0, 3.0, 2.4, 0.003)


def stepped(
    binding: BoundKernel, scene: Scene, ticks: int, user: Callable[[int], None]
) -> np.ndarray:
    """Steps a scene whose handle stands still, tick by tick, with a user's inputs before each."""
    sample, rows = np.zeros(1, SAMPLE_DTYPE), np.zeros(ticks, TICK_DTYPE)
    sample["quaternion"][:, 0] = 1.0
    for k in range(ticks):
        user(k)
        assert before_step(binding.state, sample, binding.row, 0, T) == OK
        mujoco.mj_step(scene.model, scene.data)
        assert after_step(binding.state, binding.row, 0) == OK
        rows[k] = binding.row[0]
    return rows


@pytest.mark.parametrize("on", ["joint", "body"])
def test_work_of_an_applied_force_is_metered_and_balanced(on: str, tmp_path: Path) -> None:
    scene = scene_of(FREE_MASS.format(mass=0.1), tmp_path)
    binding = bound(scene, "lossless", Coupling(1000.0, 5.0, 1.0, 0.005), T)
    data = scene.data
    force = data.qfrc_applied if on == "joint" else data.xfrc_applied[data.body("tool").id]

    def push(k: int) -> None:
        if k in (50, 200):  # set, and set again to another value, as a user's input would
            force[0] = 2.0 if k == 50 else -1.0

    rows = stepped(binding, scene, 1000, push)
    assert np.abs(rows["environment_energy"]).max() < 1e-12
    # at rest the spring holds the force: 1 N at 1000 N/m
    assert rows["tool_position"][-1, 0] == pytest.approx(-1e-3, rel=1e-3)
    assert rows["external_work"][-1] == pytest.approx(2 * 2e-3 + 1.0 * 3e-3, rel=2e-2)


@pytest.mark.parametrize("on", ["joint", "body"])
def test_a_force_that_varies_at_every_tick_creates_nothing(on: str, tmp_path: Path) -> None:
    # taken whole, as MuJoCo does, this one creates more than the slack allows
    scene = scene_of(FREE_MASS.format(mass=0.1), tmp_path)
    binding = bound(scene, "lossless", ASKED, T)
    data, random = scene.data, np.random.default_rng(0)
    force = data.qfrc_applied if on == "joint" else data.xfrc_applied[data.body("tool").id]

    def push(k: int) -> None:
        if k > 0:
            force[:3] = random.normal(size=3) * 5

    rows = stepped(binding, scene, 1000, push)
    assert np.abs(np.diff(rows["environment_energy"])).max() < 1e-12
    assert np.abs(np.diff(rows["external_work"])).max() > 1e-5


@pytest.mark.parametrize("joint", ["shoulder", "elsewhere"])
def test_a_tool_with_a_motor_of_its_own_stays_implicit(joint: str, tmp_path: Path) -> None:
    # lossless, this servo creates 8 mJ in 1 s
    extra = (
        '<body pos="0 0 1"><joint name="elsewhere"/><geom type="sphere" size="0.01"/></body>'
        "</worldbody>"
        f'<actuator><position joint="{joint}" kp="50" kv="0.5"/></actuator>'
    )
    xml = ARM.format(gravity=-9.81, spring=0).replace("</worldbody>", extra)
    xml = xml.replace("<joint axis", '<joint name="shoulder" axis', 1)
    rows, ledger = led(scene_of(xml, tmp_path), "lossless", ASKED, circling(T, 4.0), T)
    assert ledger.environment == "strict"
    is_free = (rows["flags"] & int(TickFlag.MIDPOINT)) != 0
    assert is_free.any() == (joint == "elsewhere")
