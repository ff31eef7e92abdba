"""Work done ahead of the sample changes no bit: the pipelined tick against the plain one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from audit_cases import ScriptedDevice
from bridge_runs import fast, still, sway
from golden_cases import WORKSHOP, Act, runs
from kernel_runs import FREE_BALL, at_rest
from kernel_runs import fast as fast_run

from hapticbridge import audit
from hapticbridge.clock import SimulatedClock
from hapticbridge.demand.guard import Limits
from hapticbridge.errors import SafetyTrip
from hapticbridge.kernel.codes import Scheme
from hapticbridge.kernel.handle import take_actuator_velocities, take_handle_frames
from hapticbridge.kernel.jit import direct
from hapticbridge.kernel.tick import can_split, is_sound
from hapticbridge.run.bridge import Bridge

TICKS = 400

RUNS = {
    name: run
    for name, run in runs().items()
    if name.startswith(("peg_in_hole", "commands", "2 substeps", "3 substeps", "inputs"))
}
"""Runs with each method, and with all that may change what is done ahead."""


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of MuJoCo's functions in the order in which they are called."""
    seen: list[str] = []

    def noted(name: str, function: Callable[..., None]) -> Callable[..., None]:
        def call(*arguments: Any) -> None:
            seen.append(name)
            function(*arguments)

        return call

    for name in ("mj_step", "mj_step1", "mj_step2", "mj_fwdPosition"):
        monkeypatch.setattr(mujoco, name, noted(name, getattr(mujoco, name)))
    return seen


class ActingClock(SimulatedClock):
    """Clock that acts between two ticks, as another thread of a program does.

    Args:
        act: What is done, with the bridge and the number of the next tick.

    Attributes:
        bridge: The bridge, once it is open.
    """

    bridge: Bridge

    def __init__(self, act: Act | None) -> None:
        super().__init__()
        self._act = act

    def wait(self) -> tuple[int, int, int]:
        if self._act is not None:
            self._act(self.bridge, self.bridge.session.tick)
        return super().wait()


def ended(bridge: Bridge, rows: Any) -> list[bytes]:
    """Returns every bit of the records, and of the scene after them."""
    data = bridge.scene.data
    found = (rows, data.qpos, data.qvel, data.sensordata, np.array(data.time))
    return [each.tobytes() for each in found]


@pytest.mark.parametrize("name", RUNS)
def test_a_pipelined_run_is_the_plain_one_to_the_bit(
    name: str, tmp_path: Path, calls: list[str]
) -> None:
    """Also where motors, springs, and sensors of motion are in the scene, and bodies are moved."""
    run, found = RUNS[name], []
    # a sensor of velocity, too
    speed = '<framelinvel objtype="site" objname="grip"/><jointpos '
    scene = run.scene.replace("<jointpos ", speed)
    for is_ahead in (False, True):
        clock = ActingClock(run.act)
        quiet = replace(run, scene=scene, act=None)
        with quiet.open(tmp_path, pipelined=is_ahead, clock=lambda own=clock: own) as clock.bridge:
            calls.clear()  # of the start's rehearsal
            found.append(ended(clock.bridge, quiet.go(clock.bridge)))
    assert found[0] == found[1]
    if name == "inputs, implicit":  # the first, and 99 in which a body was moved
        assert calls.count("mj_step1") == 100


def test_only_the_first_tick_is_a_whole_step_and_the_wrench_goes_out_first(
    tmp_path: Path, calls: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    device = ScriptedDevice(sway)
    write = device.write

    def noted(wrench: Any) -> None:
        calls.append("write")
        write(wrench)

    monkeypatch.setattr(device, "write", noted)
    with fast("point_mass", device, pipelined=True) as bridge:
        calls.clear()
        bridge.run(1e-3 * TICKS)
    # the last words are zero force, at the end of run and bridge
    ticks = ["mj_step1", "mj_step2", "write", "mj_fwdPosition"]
    ticks += ["mj_step2", "write", "mj_fwdPosition"] * (TICKS - 1)
    assert calls == [*ticks, "write", "write"]


OF_THE_HANDLE = ("xpos", "xquat", "xmat", "xipos", "ximat", "site_xpos", "site_xquat", "site_xmat")
"""Frames that MuJoCo's kinematics writes."""


@pytest.mark.parametrize("name", ["point_mass", "hex_key", "drawer", "pliers"])
def test_what_depends_on_the_handle_is_what_mujoco_computes_to_the_bit(name: str) -> None:
    """Against MuJoCo's stages of the whole scene, at random poses and velocities."""
    rng = np.random.default_rng(7)
    with fast(name, ScriptedDevice(still)) as bridge:
        state, model, data = bridge.session.kernel.state[0], bridge.scene.model, bridge.scene.data
        assert state["mj"]["is_handle_alone"]
        handle, take = int(state["mj"]["handle_mocap_id"]), direct(take_handle_frames, state)
        take_velocities = direct(take_actuator_velocities, state["mj"])
        for k in range(300):
            data.qpos[:] = model.qpos0 + 0.3 * rng.normal(size=model.nq) * (k > 0)
            mujoco.mj_normalizeQuat(model, data.qpos)
            data.qvel[:] = rng.normal(size=model.nv)
            mujoco.mj_fwdPosition(model, data)
            mujoco.mj_fwdVelocity(model, data)
            data.mocap_pos[handle] = rng.normal(size=3)
            turn = rng.normal(size=4) if k % 3 else np.eye(4)[0]
            data.mocap_quat[handle] = turn / (np.linalg.norm(turn) if k % 2 else 1.0)
            take(state)
            take_velocities(state["mj"])
            found = _of_the_handle(data)
            mujoco.mj_kinematics(model, data)
            mujoco.mj_transmission(model, data)
            mujoco.mj_fwdVelocity(model, data)
            assert found == _of_the_handle(data)


def _of_the_handle(data: mujoco.MjData) -> list[list[float]]:
    """Returns all frames, the actuators' numbers, and what the velocity stage computes besides."""
    end = data.moment_rowadr[-1] + data.moment_rownnz[-1]
    parts = [getattr(data, name) for name in OF_THE_HANDLE]
    parts += [data.actuator_length, data.moment_rownnz, data.moment_rowadr]
    parts += [data.moment_colind[:end], data.actuator_moment[:end], data.actuator_velocity]
    parts += [data.cvel, data.qfrc_passive, data.qfrc_bias, data.efc_vel]
    return [part.ravel().tolist() for part in parts]


@pytest.mark.parametrize("method", ["weld", "explicit:rk4"])
def test_methods_whose_constraints_or_stages_need_the_sample_take_whole_steps(
    calls: list[str], method: str
) -> None:
    # a held torque makes the light tool spin, which the guard would stop
    limits = Limits(force=10.0, torque=0.5, angle=np.inf)
    device = ScriptedDevice(sway)
    with fast("point_mass", device, pipelined=True, method=method, limits=limits) as bridge:
        calls.clear()
        bridge.run(0.4)
    assert set(calls) == {"mj_step"}


def test_a_scene_changed_between_two_runs_is_taken_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "workshop.xml"
    path.write_text(WORKSHOP)
    ends = []
    for pipelined in (False, True):
        with fast(path, ScriptedDevice(still), pipelined=pipelined) as bridge:
            bridge.run(0.01)
            model, data = bridge.scene.model, bridge.scene.data
            joint = model.body_jntadr[model.body("load").id]
            # a millimetre into the platform, from a millimetre above it: contacts must be found
            data.qpos[model.jnt_qposadr[joint] + 2] = 0.047
            bridge.run(0.01)
            rows = bridge.latest_records(20)
            assert rows["contacts"][9] < rows["contacts"][10]
            ends.append(ended(bridge, rows))
    assert ends[0] == ends[1]


READS: dict[str, Callable[[mujoco.MjModel, mujoco.MjData], None]] = {
    "forward": mujoco.mj_forward,
    "inverse": mujoco.mj_inverse,
    "collision": mujoco.mj_collision,
}
"""Functions of MuJoCo that a program calls to look at a scene."""


@pytest.mark.parametrize("pipelined", [False, True])
@pytest.mark.parametrize("name", READS)
def test_a_program_may_look_at_the_scene_between_ticks(
    tmp_path: Path, name: str, pipelined: bool
) -> None:
    """MuJoCo overwrote what had been computed ahead, and an honest recording was invalid."""
    path, run = tmp_path / "run.mcap", RUNS["peg_in_hole, lossless"]
    with run.open(tmp_path, pipelined=pipelined, recording=path) as bridge:
        model, data = bridge.scene.model, bridge.scene.data
        bridge.run(0.4, lambda _: READS[name](model, data))
    assert audit(path).resimulation == "bit for bit"


@pytest.mark.parametrize("pipelined", [False, True])
def test_energies_that_are_not_finite_end_in_zero_force(tmp_path: Path, pipelined: bool) -> None:
    device = ScriptedDevice(sway)
    limits = Limits(force=10.0, torque=0.5, ramp=0.0)
    with (
        pytest.raises(SafetyTrip, match="no longer finite"),
        fast("point_mass", device, pipelined=pipelined, limits=limits) as bridge,
    ):

        def spoil(tick: int) -> None:
            if tick == 20:
                bridge.session.kernel.bound.state["energy"]["start_energy"] = np.nan

        bridge.run(0.1, spoil)
    writes = np.array(device.writes)
    assert np.all(np.isfinite(writes))
    assert np.any(writes[19] != 0.0)
    assert np.all(writes[-1] == 0.0)
    assert bridge.latest_records(100)["tick"][-1] == 19


def test_what_mujoco_cannot_split_or_would_reset_is_a_whole_step() -> None:
    rig = fast_run(FREE_BALL, at_rest(1))
    model, data, state = rig.scene.model, rig.scene.data, rig.binding.state[0]
    schemes = (Scheme.IMPLICIT, Scheme.WELD, Scheme.MASSLESS)
    assert [can_split(model, scheme) for scheme in schemes] == [True, False, False]
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    assert not can_split(model, Scheme.IMPLICIT)
    for value in (1e10, -1e11, np.inf, np.nan):
        for numbers in (data.qvel, data.qpos):
            assert is_sound(state)
            before, numbers[1] = numbers[1], value
            assert not is_sound(state)
            numbers[1] = before
    data.qvel[1] = 0.99e10
    assert is_sound(state)
