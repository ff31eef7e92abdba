"""Scenes and inputs whose work an integrator hides are refused."""

from __future__ import annotations

import math

import numpy as np
import pytest
from kernel_runs import T, load, samples_of, unlimited
from rendering_runs import (
    COUPLING,
    SERVO,
    Rotor,
)

from hapticbridge.bridge import Bridge
from hapticbridge.clock import SimulatedClock
from hapticbridge.errors import SceneError
from hapticbridge.kernel.codes import OK
from hapticbridge.kernel.state import BoundKernel
from hapticbridge.kernel.tick import after_step, before_step
from hapticbridge.rendering import method_named, prepare


@pytest.mark.parametrize(
    ("method", "actuator", "gravcomp", "message"),
    [
        ("explicit:rk4", '<motor name="m" joint="arm"/>', 0, "'m'"),
        ("explicit:rk4", "", 1, "gravity compensation"),
        ("implicitfast", '<velocity name="v" joint="arm" kv="1"/>', 0, "'v'"),
        ("weld", '<position name="p" joint="arm" kv="1"/>', 0, "'p'"),
    ],
)
def test_scene_whose_ports_cannot_be_metered_is_refused(
    method: str, actuator: str, gravcomp: int, message: str
) -> None:
    scene = load(SERVO.format(gravcomp=gravcomp, mocap="false", actuator=actuator))
    with pytest.raises(SceneError, match=message):
        prepare(scene, COUPLING, T, 1, method_named(method))
    prepare(scene, COUPLING, T, 1)


@pytest.mark.parametrize("method", ["explicit:rk4", "direct"])
def test_inputs_that_cannot_be_metered_are_refused(method: str) -> None:
    with (
        Bridge("peg_in_hole", Rotor(), clock=SimulatedClock(), method=method) as bridge,
        pytest.raises(SceneError, match="cannot meter the work of inputs"),
    ):
        bridge.set_input(body_wrench={"peg": np.zeros(6)})


@pytest.mark.parametrize("method", ["explicit", "explicit:implicitfast", "implicitfast"])
def test_ports_of_a_separate_arm_close_to_its_dissipation(method: str) -> None:
    """A motor and an applied force on an arm apart: Σ E is what the step leaves, −½m(Δv)²."""
    scene = load(SERVO.format(gravcomp=0, mocap="false", actuator='<motor name="m" joint="arm"/>'))
    chosen = method_named(method)
    prepare(scene, COUPLING, T, 1, chosen)
    parameters = unlimited(scene, COUPLING, scheme=chosen.scheme)
    binding = BoundKernel(scene.model, scene.data, parameters)
    still, left, speed = samples_of(np.zeros((1, 3))), 0.0, 0.0
    for k in range(200):
        scene.data.ctrl[0 if scene.model.actuator(0).name == "m" else -1] = 0.0
        scene.data.ctrl[scene.model.actuator_ctrladr[scene.model.actuator("m").id]] = math.sin(k)
        scene.data.qfrc_applied[6] = math.cos(0.1 * k)
        assert before_step(binding.state, still, binding.row, 0, T) == OK
        chosen.step(scene.model, scene.data)
        assert after_step(binding.state, binding.row, 0) == OK
        left -= 0.1 * (scene.data.qvel[6] - speed) ** 2
        speed = float(scene.data.qvel[6])
    assert binding.state["energy"]["environment_energy"][0] == pytest.approx(left, rel=1e-9)
    assert abs(binding.state["energy"]["actuator_work"][0]) > 1e-5
    assert abs(binding.state["energy"]["external_work"][0]) > 1e-5
