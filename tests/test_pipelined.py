"""What runs ahead of the sample changes no bit: the pipelined tick against the plain one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from audit_cases import TAP, ScriptedDevice
from bridge_runs import REST, fast, sway
from kernel_runs import FREE_BALL, at_rest
from kernel_runs import fast as fast_run

from hapticbridge.bridge import Bridge
from hapticbridge.errors import SafetyTrip
from hapticbridge.guard import Limits
from hapticbridge.kernel.codes import Scheme
from hapticbridge.kernel.tick import can_split, is_sound
from hapticbridge.lab.methods import METHODS
from hapticbridge.record import TICK_DTYPE

TICKS = 400

WORKSHOP = """
<mujoco>
  <option cone="elliptic"/>
  <default><geom solref="0.002 1" solimp="0.9 0.95 0.001"/></default>
  <worldbody>
    <geom type="plane" size="1 1 0.1"/>
    <body name="tool" pos="0 0 0.012" gravcomp="1"><freejoint/>
      <geom type="sphere" size="0.01" mass="0.1"/><site name="grip"/></body>
    <body name="lever" pos="0.03 0 0.02"><joint name="lever" type="hinge" axis="0 1 0"
        stiffness="0.1" damping="0.001"/>
      <geom type="capsule" size="0.004" fromto="0 0 0 0 0 0.05" mass="0.05"/></body>
    <body name="load" pos="-0.1 0 0.05"><freejoint/>
      <geom type="box" size="0.01 0.01 0.01" mass="0.05"/></body>
    <body name="lift" mocap="true" pos="-0.1 0 0.03">
      <geom type="box" size="0.02 0.02 0.008"/></body>
  </worldbody>
  <actuator><position name="servo" joint="lever" kp="0.5" kv="0.01"/></actuator>
  <sensor>
    <framepos objtype="site" objname="grip"/><framelinvel objtype="site" objname="grip"/>
    <jointpos joint="lever"/><touch name="touch" site="grip"/>
  </sensor>
</mujoco>"""
"""A tool, a servo, a spring, sensors, and a load on a platform that is moved."""

Rows = tuple[Any, ...]


def numbers_of(bridge: Bridge) -> Rows:
    data = bridge.scene.data
    kept = data.qpos.copy(), data.qvel.copy(), data.sensordata.copy(), data.time
    return (bridge.latest_records(TICKS), *kept)


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of MuJoCo's functions in the order in which they are called."""
    seen: list[str] = []

    def noted(name: str, function: Callable[..., None]) -> Callable[..., None]:
        def call(*arguments: Any) -> None:
            seen.append(name)
            function(*arguments)

        return call

    for name in ("mj_step", "mj_step2", "mj_fwdPosition"):
        monkeypatch.setattr(mujoco, name, noted(name, getattr(mujoco, name)))
    return seen


def run(scene: Any, *, pipelined: bool, on_tick: Any = None, **options: Any) -> Rows:
    device = options.pop("device", None) or ScriptedDevice(sway)
    with fast(scene, device, pipelined=pipelined, **options) as bridge:
        bridge.run(TICKS * bridge.period, on_tick and (lambda tick: on_tick(bridge, tick)))
        return numbers_of(bridge)


def check_equal(plain: Rows, ahead: Rows) -> None:
    for name in TICK_DTYPE.names or ():
        np.testing.assert_array_equal(plain[0][name], ahead[0][name], err_msg=name)
    for one, other in zip(plain[1:], ahead[1:], strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(
    ("method", "substeps"), [*((method, 1) for method in METHODS), ("implicit", 3), ("explicit", 2)]
)
def test_a_pipelined_run_is_the_plain_one_to_the_bit(
    tmp_path: Path, method: str, substeps: int
) -> None:
    (tmp_path / "tap.csv").write_text(TAP)
    plain, ahead = (
        run(
            "peg_in_hole",
            device=f"trajectory:{tmp_path / 'tap.csv'}",
            pipelined=pipelined,
            method=method,
            substeps=substeps,
        )
        for pipelined in (False, True)
    )
    assert plain[0]["contacts"].max() > 0
    check_equal(plain, ahead)


@pytest.mark.parametrize("method", ["lossless", "implicit", "explicit"])
def test_motors_springs_sensors_and_moved_bodies_change_no_bit(
    tmp_path: Path, calls: list[str], method: str
) -> None:
    path = tmp_path / "workshop.xml"
    path.write_text(WORKSHOP)

    def act(bridge: Bridge, tick: int) -> None:
        if tick % 50 == 10:
            bridge.set_input(ctrl={"servo": 0.3 * np.sin(tick)})
        if 100 <= tick < 200:
            height = 0.03 + 2e-5 * (tick - 100)
            bridge.set_input(mocap={"lift": (-0.1, 0, height)})
        if tick == 250:
            bridge.set_input(body_wrench={"load": (0.01, 0, 0, 0, 0, 1e-5)})

    plain = run(path, pipelined=False, method=method, on_tick=act)
    calls.clear()
    ahead = run(path, pipelined=True, method=method, on_tick=act)
    assert calls.count("mj_step") == 100  # the first, and 99 in which a body was moved
    assert plain[0]["external_work"][-1] != 0.0
    assert plain[0]["actuator_work"][-1] != 0.0
    check_equal(plain, ahead)


def test_only_the_first_tick_is_a_whole_step_and_the_wrench_goes_out_first(
    tmp_path: Path, calls: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    device = ScriptedDevice(sway)
    write = device.write

    def noted(wrench: Any) -> None:
        calls.append("write")
        write(wrench)

    monkeypatch.setattr(device, "write", noted)
    run("point_mass", pipelined=True, device=device)
    # the last words are zero force, at the end of run and bridge
    ticks = ["mj_step", "write", "mj_fwdPosition"]
    ticks += ["mj_step2", "write", "mj_fwdPosition"] * (TICKS - 1)
    assert calls == [*ticks, "write", "write"]


@pytest.mark.parametrize("method", ["weld", "explicit:rk4"])
def test_methods_whose_constraints_or_stages_need_the_sample_take_whole_steps(
    calls: list[str], method: str
) -> None:
    # a held torque makes the light tool spin, which the guard would stop
    limits = Limits(force=10.0, torque=0.5, angle=np.inf)
    run("point_mass", pipelined=True, method=method, limits=limits)
    assert set(calls) == {"mj_step"}


def test_a_scene_changed_between_two_runs_is_taken_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "workshop.xml"
    path.write_text(WORKSHOP)
    ends = []
    for pipelined in (False, True):
        with fast(path, ScriptedDevice(lambda _tick: REST), pipelined=pipelined) as bridge:
            bridge.run(0.01)
            model, data = bridge.scene.model, bridge.scene.data
            joint = model.body_jntadr[model.body("load").id]
            # a millimetre into the platform, from a millimetre above it: contacts must be found
            data.qpos[model.jnt_qposadr[joint] + 2] = 0.047
            bridge.run(0.01)
            ends.append(numbers_of(bridge))
    contacts = ends[0][0]["contacts"]
    assert contacts[9] < contacts[10]
    check_equal(*ends)


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


def test_a_control_callback_is_called_once_a_tick(calls: list[str]) -> None:
    """MuJoCo calls it between the halves of a whole step; ``mj_step2`` alone would leave it out."""
    seen: list[Any] = []
    with fast("point_mass", ScriptedDevice(sway), pipelined=True) as bridge:
        mujoco.set_mjcb_control(lambda model, _data: seen.append(model))
        try:
            bridge.run(0.1)
        finally:
            mujoco.set_mjcb_control(None)
    assert len(seen) == calls.count("mj_step") == 100
