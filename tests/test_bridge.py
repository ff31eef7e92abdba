from __future__ import annotations

import json
import os
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from audit_cases import TAP, ScriptedDevice, SlowClock, recorded
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hapticbridge.audit import audit
from hapticbridge.bridge import Bridge
from hapticbridge.clock import SimulatedClock
from hapticbridge.coupling import Coupling
from hapticbridge.device import open_device
from hapticbridge.errors import DeviceError, HapticBridgeError, SafetyTrip, SceneError
from hapticbridge.guard import Limits
from hapticbridge.recording import Recorder, Ring, read_recording
from hapticbridge.recording import stream as stream_module
from hapticbridge.scene import Scene, load_scene
from hapticbridge.tick import CLOCK_FIELDS, TICK_DTYPE, TickFlag

PATIENCE = 30.0
REST = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)

INPUTS = """<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.001" integrator="discrete"/>
  <worldbody>
    <body name="tool">
      <freejoint name="tool"/>
      <geom size="0.01" mass="0.1"/>
      <site name="grip"/>
    </body>
    <body name="arm" pos="0.2 0 0">
      <joint name="arm" type="slide" axis="0 0 1" stiffness="50" damping="0.5"/>
      <geom size="0.01" mass="0.2"/>
    </body>
    <body name="plate" mocap="true" pos="0.2 0 -0.05">
      <geom type="box" size="0.05 0.05 0.01" solref="0.002 1"/>
    </body>
  </worldbody>
  <actuator><motor name="lift" joint="arm"/></actuator>
</mujoco>
"""


def still(_tick: int) -> tuple[float, ...]:
    return REST


def sway(tick: int) -> tuple[float, ...]:
    x, y, z, w = Rotation.from_rotvec([0, 0.2 * np.sin(0.01 * tick), 0]).as_quat()
    return (0.01 * np.sin(0.02 * tick), 0.004 * np.sin(0.03 * tick), 0, w, x, y, z)


def fast(
    scene: str | Path | Scene = "point_mass", device: Any = "simulated", **options: Any
) -> Bridge:
    return Bridge(scene, device, options.pop("coupling", None), clock=SimulatedClock(), **options)


def payloads(path: Path) -> NDArray[np.void]:
    """The records of a file without what belongs to the clock."""
    ticks = read_recording(path).ticks
    for name in CLOCK_FIELDS:
        ticks[name] = 0
    return ticks


@pytest.fixture
def motion(tmp_path: Path) -> str:
    path = tmp_path / "hand.csv"
    path.write_text(TAP)
    return f"trajectory:{path}"


# --- repeatability


@pytest.mark.parametrize(
    "options", ["friction=0.01,resolution=2e-5,rotational_resolution=1e-4,delay=2,path=", None]
)
def test_two_fast_runs_of_one_input_have_identical_payloads(
    options: str | None, motion: str, tmp_path: Path
) -> None:
    device = options and f"simulated:{options}{motion.partition(':')[2]}"
    first, second = tmp_path / "a.mcap", tmp_path / "b.mcap"
    for path in (first, second):
        recorded(path, "peg_in_hole", device or motion, duration=0.25)
    a, b = payloads(first), payloads(second)
    assert len(a) == 250
    assert a.tobytes() == b.tobytes()
    assert np.ptp(a["tool_position"], axis=0).max() > 1e-6


def test_recording_leaves_the_run_as_it_is(tmp_path: Path, motion: str) -> None:
    recorded(tmp_path / "run.mcap", "peg_in_hole", motion)
    limits = Limits(force=10, torque=0.5, ramp=0.05)
    with fast("peg_in_hole", motion, limits=limits) as bridge:
        bridge.run()
        rows = bridge.latest_records(10_000)
    for name in CLOCK_FIELDS:
        rows[name] = 0
    assert rows.tobytes() == payloads(tmp_path / "run.mcap").tobytes()


def test_replayed_recording_gives_the_same_run_bit_for_bit(tmp_path: Path, motion: str) -> None:
    first, second = tmp_path / "a.mcap", tmp_path / "b.mcap"
    recorded(first, "peg_in_hole", motion)
    recorded(second, "peg_in_hole", f"trajectory:{first}")
    assert payloads(first).tobytes() == payloads(second).tobytes()


def test_replay_of_a_held_device_repeats_its_motion_and_the_tools(tmp_path: Path) -> None:
    first, second = tmp_path / "a.mcap", tmp_path / "b.mcap"
    recorded(first, "virtual_wall", "simulated", duration=0.4)
    recorded(second, "virtual_wall", f"trajectory:{first}")
    a, b = payloads(first), payloads(second)
    for name in ("device_position", "device_quaternion", "tool_position", "wrench_on_tool"):
        assert (a[name] == b[name]).all()


# --- the device's motion in the scene


def test_relative_poses_start_at_the_grip_and_absolute_ones_are_the_handle() -> None:
    shift = np.array([0.1, -0.2, 0.3])
    device = ScriptedDevice(lambda k: (*(shift + sway(k)[:3]), *sway(k)[3:]))
    with fast("peg_in_hole", device) as bridge:
        bridge.run(0.1)
        relative = bridge.latest_records(100)
    np.testing.assert_allclose(
        relative["handle_position"], relative["device_position"] - shift + [0, 0, 0.04], atol=1e-16
    )
    device = ScriptedDevice(lambda k: (*(np.array([0, 0, 0.04]) + sway(k)[:3]), *sway(k)[3:]))
    with fast("peg_in_hole", device, absolute=True) as bridge:
        bridge.run(0.1)
        absolute = bridge.latest_records(100)
    assert (absolute["handle_position"] == absolute["device_position"]).all()
    np.testing.assert_allclose(
        absolute["handle_quaternion"], absolute["device_quaternion"], atol=1e-15
    )


def test_scales_and_axes_map_motion_in_and_wrench_out() -> None:
    turn = Rotation.from_rotvec([0.3, -0.5, 1.1])
    limits = Limits(force=1e3, torque=50, ramp=0.0)
    scale, force_scale = 2.5, 0.4
    with fast(
        "point_mass",
        ScriptedDevice(sway, strength=1e3),
        scale=scale,
        force_scale=force_scale,
        axes=turn.as_matrix(),
        limits=limits,
    ) as bridge:
        bridge.run(0.2)
        rows = bridge.latest_records(200)
    np.testing.assert_allclose(
        rows["handle_position"], scale * turn.apply(rows["device_position"]), atol=1e-15
    )
    device = Rotation.from_quat(rows["device_quaternion"], scalar_first=True)
    handle = Rotation.from_quat(rows["handle_quaternion"], scalar_first=True)
    assert ((turn * device * turn.inv()).inv() * handle).magnitude().max() < 1e-14
    on_tool, on_device = rows["wrench_on_tool"], rows["wrench_on_device"]
    np.testing.assert_allclose(
        on_device[:, :3], -force_scale * turn.inv().apply(on_tool[:, :3]), atol=1e-13
    )
    np.testing.assert_allclose(
        on_device[:, 3:], -force_scale / scale * turn.inv().apply(on_tool[:, 3:]), atol=1e-13
    )
    assert np.linalg.norm(on_tool[:, :3], axis=1).max() > 0.1


def test_equal_scales_keep_power_equal_on_both_sides() -> None:
    limits = Limits(force=1e3, torque=50, ramp=0.0)
    with fast("point_mass", ScriptedDevice(sway, strength=1e3), scale=3.0, limits=limits) as bridge:
        bridge.run(0.2)
        rows = bridge.latest_records(200)
    sent, held = rows["wrench_on_device"], rows["wrench_on_tool"]
    for side, scene in (("device", "handle"),):
        moved = np.diff(rows[f"{side}_position"], axis=0)
        in_scene = np.diff(rows[f"{scene}_position"], axis=0)
        np.testing.assert_allclose(
            (sent[:-1, :3] * moved).sum(1), -(held[:-1, :3] * in_scene).sum(1), atol=1e-15
        )


# --- the length of a run


def test_end_of_the_motion_ends_the_run_and_a_longer_duration_holds_the_last_pose(
    motion: str,
) -> None:
    with fast("point_mass", motion) as bridge:
        summary = bridge.run()
        assert summary.ticks == 201  # 0.2 s, its first and its last pose
        last = bridge.latest_records(1)["device_position"]
    np.testing.assert_allclose(last, [[0.0014, 0.0003, -0.0130]], atol=1e-15)
    with fast("point_mass", motion) as bridge:
        assert bridge.run(0.3).ticks == 300
        held = bridge.latest_records(100)["device_position"]
    assert (held == held[0]).all()
    with fast("point_mass", motion) as bridge:
        assert bridge.run(0.1).ticks == 100


def test_second_run_goes_on_where_the_first_ended(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    whole = tmp_path / "whole.mcap"
    with fast("virtual_wall", recording=path) as bridge:
        assert bridge.run(0.1).ticks == 100
        summary = bridge.run(0.15)
        assert summary.ticks == 250
        assert summary.duration == pytest.approx(0.25)
    with fast("virtual_wall", recording=whole) as bridge:
        bridge.run(0.25)
    a, b = read_recording(path).ticks, read_recording(whole).ticks
    assert a["deadline_ns"].tolist() == b["deadline_ns"].tolist()
    # the wrench is taken off between the runs, so a held device drifts by nothing in no time
    assert payloads(path)[:100].tobytes() == payloads(whole)[:100].tobytes()
    assert audit(path).verdict == "passive"


@pytest.mark.parametrize("duration", [0.0, -1.0, float("nan"), float("inf")])
def test_duration_out_of_range_is_refused_and_zero_force_sent(duration: float) -> None:
    device = ScriptedDevice(still)
    with fast("point_mass", device) as bridge, pytest.raises(HapticBridgeError, match="duration"):
        bridge.run(duration)
    assert device.is_closed
    assert (device.writes[-1] == 0).all()


def test_caller_can_stop(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    summary = recorded(
        path, "point_mass", on_tick=lambda bridge, tick: bridge.stop() if tick == 30 else None
    )
    assert (summary.ticks, summary.stopped_by) == (31, "caller")
    assert read_recording(path).events[-1]["reason"] == "caller"


# --- coupling


def test_default_coupling_is_that_of_the_rule() -> None:
    expected = Coupling(
        stiffness=2400.0, damping=0.5, rotational_stiffness=2.4, rotational_damping=5e-4
    )
    for device in ("simulated", ScriptedDevice(still)):
        for name in ("stiffness", "damping", "rotational_stiffness", "rotational_damping"):
            coupling = fast("point_mass", device).coupling
            assert getattr(coupling, name) == pytest.approx(getattr(expected, name), rel=1e-12)


def test_default_coupling_follows_damping_rate_and_scales() -> None:
    # 80 % of 2 (b − b/4) / T = 1.2 b / T
    coupling = fast("point_mass", "simulated:damping=5", rate=500).coupling
    assert coupling.stiffness == pytest.approx(3000)
    assert coupling.damping == pytest.approx(1.25)
    scaled = fast("point_mass", "simulated", scale=2.0)
    assert scaled.coupling.stiffness == pytest.approx(600)
    with scaled as bridge:
        assert bridge.run(0.01).is_certified is True


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rate": 0.0}, "rate"),
        ({"rate": float("nan")}, "rate"),
        ({"scale": 0.0}, "scale"),
        ({"scale": -1.0}, "scale"),
        ({"force_scale": float("inf")}, "force_scale"),
        ({"axes": np.diag([1, 1, -1])}, "axes"),
        ({"axes": np.ones(3)}, "axes"),
        ({"substeps": 0}, "substeps"),
        ({"method": "explicit_or_so"}, "method"),
    ],
)
def test_options_out_of_range_are_refused_by_name(options: dict[str, Any], message: str) -> None:
    device = ScriptedDevice(still)
    with pytest.raises(HapticBridgeError, match=message), fast("point_mass", device, **options):
        pass
    assert not [wrench for wrench in device.writes if wrench.any()]


def test_substeps_keep_the_wrench_law_and_pass_the_audit(tmp_path: Path, motion: str) -> None:
    path = tmp_path / "run.mcap"
    summary = recorded(path, "peg_in_hole", motion, substeps=4)
    report = audit(path)
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")
    assert summary.ticks == 201


# --- inputs of the scene


@pytest.fixture
def inputs_scene(tmp_path: Path) -> Path:
    path = tmp_path / "inputs.xml"
    path.write_text(INPUTS)
    return path


SCRIPT: dict[int, dict[str, Any]] = {
    10: {"ctrl": {"lift": 1.0}},
    20: {"joint_force": {"arm": -0.5, "tool": [0, 0, 0.1, 0, 0, 1e-4]}},
    30: {"body_wrench": {"arm": [0, 0, 0.3, 0, 0, 0]}, "ctrl": {"lift": [0.2]}},
    40: {"mocap": {"plate": [0.2, 0, -0.03]}},
    50: {"mocap": {"plate": [0.2, 0.001, -0.035, 0.9999, 0, 0.0141, 0]}},
    60: {"body_wrench": {"arm": np.zeros(6)}},
}


def test_inputs_act_are_recorded_and_repeat_bit_for_bit(inputs_scene: Path, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"

    def play(bridge: Bridge, tick: int) -> None:
        if tick in SCRIPT:
            bridge.set_input(**SCRIPT[tick])

    recorded(path, inputs_scene, ScriptedDevice(sway), duration=0.1, on_tick=play)
    recording = read_recording(path)
    inputs = [event for event in recording.events if event["event"] == "input"]
    assert [event["tick"] for event in inputs] == list(SCRIPT)
    ticks = recording.ticks
    # the coupling's own share is taken out of the sum of all actuators: rounding is left
    assert np.abs(ticks["actuator_work"][:10]).max() < 1e-15
    assert abs(ticks["actuator_work"][10]) > 1e-9
    assert (ticks["external_work"][:20] == 0).all()
    assert ticks["external_work"][20] != 0
    report = audit(path)
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")


@pytest.mark.parametrize(
    ("inputs", "message"),
    [
        ({"ctrl": {"lft": 1.0}}, "'lift'"),
        ({"ctrl": {"coupling_force_x": 1.0}}, "'lift'"),
        ({"ctrl": {"lift": [1.0, 2.0]}}, "1 finite"),
        ({"ctrl": {"lift": float("nan")}}, "1 finite"),
        ({"mocap": {"handle": [0, 0, 0]}}, "'plate'"),
        ({"mocap": {"arm": [0, 0, 0]}}, "'plate'"),
        ({"mocap": {"plate": [0, 0]}}, "3 or 7"),
        ({"mocap": {"plate": [0, 0, 0, 2, 0, 0, 0]}}, "norm 2"),
        ({"joint_force": {"hinge": 1.0}}, "'arm', 'tool'"),
        ({"joint_force": {"tool": [1.0]}}, "6 finite"),
        ({"joint_force": {"arm": float("inf")}}, "1 finite"),
        ({"body_wrench": {"handle": [0] * 6}}, "'arm', 'plate', 'tool'"),
        ({"body_wrench": {"world": [0] * 6}}, "'arm', 'plate', 'tool'"),
        ({"body_wrench": {"arm": [0] * 5}}, "6 finite"),
    ],
)
def test_bad_inputs_are_refused_and_change_nothing(
    inputs_scene: Path, inputs: dict[str, Any], message: str
) -> None:
    with fast(inputs_scene, ScriptedDevice(still)) as bridge:
        with pytest.raises(SceneError, match=message):
            bridge.set_input(**inputs)
        bridge.run(0.01)
        assert bridge.ledger.actuator_work == bridge.ledger.external_work == 0


# --- what stops a run


def test_pose_that_is_not_finite_trips_with_zero_force_last(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    device = ScriptedDevice(lambda k: (np.nan, 0, 0, 1, 0, 0, 0) if k == 700 else sway(k))
    with pytest.raises(SafetyTrip, match="tick 700: the device's pose") as caught:
        recorded(path, "point_mass", device)
    assert np.linalg.norm(device.writes[699]) > 0.01
    assert all((wrench == 0).all() for wrench in device.writes[700:])
    assert device.is_closed
    records = caught.value.records
    assert records["tick"].tolist() == list(range(700))
    recording = read_recording(path)
    assert not recording.is_cut and recording.digest == recording.computed_digest
    assert [event["event"] for event in recording.events] == ["start", "trip", "stop"]
    assert recording.events[1]["tick"] == 700
    assert audit(path).verdict == "passive"


@pytest.mark.parametrize("quaternion", [(0, 0, 0, 0), (np.inf, 0, 0, 0), (0.1, 0, 0, 0)])
def test_quaternion_that_is_no_rotation_trips(quaternion: tuple[float, ...]) -> None:
    device = ScriptedDevice(lambda k: (0, 0, 0, *quaternion) if k == 5 else REST)
    with fast("point_mass", device) as bridge, pytest.raises(SafetyTrip, match="tick 5"):
        bridge.run(0.1)
    assert (device.writes[-1] == 0).all()


def test_last_second_of_records_comes_with_a_trip() -> None:
    device = ScriptedDevice(lambda k: (np.nan if k == 1500 else 0, 0, 0, 1, 0, 0, 0))
    with fast("point_mass", device) as bridge, pytest.raises(SafetyTrip) as caught:
        bridge.run(2.0)
    assert caught.value.records["tick"].tolist() == list(range(500, 1500))


def failing(message: str, tick: int, pose: Callable[[int], Any] = sway) -> Callable[[int], Any]:
    def pose_or_fail(k: int) -> Any:
        if k == tick:
            raise DeviceError(message)
        return pose(k)

    return pose_or_fail


def test_device_that_fails_to_read_gets_zero_force_and_the_recording_is_whole(
    tmp_path: Path,
) -> None:
    path = tmp_path / "run.mcap"
    device = ScriptedDevice(failing("unplugged", 60))
    with pytest.raises(DeviceError, match="unplugged"):
        recorded(path, "point_mass", device)
    assert (device.writes[-1] == 0).all()
    assert device.is_closed
    recording = read_recording(path)
    assert not recording.is_cut
    assert recording.events[-1]["reason"] == "DeviceError: unplugged"
    assert (audit(path).verdict, len(recording.ticks)) == ("passive", 60)


def test_device_that_fails_to_write_is_closed_and_the_recording_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"

    def fail(count: int) -> None:
        if count > 60:
            raise DeviceError("unplugged")

    device = ScriptedDevice(sway, on_write=fail)
    with pytest.raises(DeviceError, match="unplugged"):
        recorded(path, "point_mass", device)
    assert len(device.writes) > 61  # zero force was tried after the failure
    assert (device.writes[-1] == 0).all()
    assert device.is_closed
    recording = read_recording(path)
    assert not recording.is_cut
    assert recording.events[-1]["event"] == "stop"
    assert "unplugged" in recording.events[-1]["reason"]
    assert audit(path).verdict == "passive"


def test_error_of_the_users_own_code_stops_the_run_the_same_way(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    device = ScriptedDevice(sway)

    def fail(_bridge: Bridge, tick: int) -> None:
        if tick == 40:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        recorded(path, "point_mass", device, on_tick=fail)
    assert (device.writes[-1] == 0).all()
    assert not read_recording(path).is_cut
    assert audit(path).ticks == 40


# --- time


def test_overruns_are_flagged_counted_and_pass_the_audit(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    clock = SlowClock({0: 2, 50: 1, 51: 7})
    summary = recorded(path, "virtual_wall", clock=clock, duration=0.1)
    assert (summary.overruns, summary.skipped) == (3, 10)
    ticks = read_recording(path).ticks
    flagged = np.flatnonzero(ticks["flags"] & TickFlag.OVERRUN)
    assert flagged.tolist() == [0, 50, 51]
    assert ticks["deadline_ns"][-1] == 110_000_000
    assert audit(path).verdict == "passive"
    assert read_recording(path).events[-1]["overruns"] == 3
    assert read_recording(path).events[-1]["skipped"] == 10


def test_full_ring_drops_rows_in_real_time_and_the_audit_calls_the_gap(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "run.mcap"
    monkeypatch.setattr(stream_module, "RING_SECONDS", 0.064)
    rings: list[Ring] = []
    shared = Ring.shared

    def kept(capacity: int) -> Ring:
        rings.append(shared(capacity))
        return rings[-1]

    monkeypatch.setattr(Ring, "shared", kept)
    device = ScriptedDevice(sway)
    with Bridge("point_mass", device, recording=path, clock=SlowClock({})) as bridge:
        recorder = bridge._stream.recorder
        assert isinstance(recorder, Recorder)
        pid = recorder._process.pid
        os.kill(pid, signal.SIGSTOP)

        def resume(tick: int) -> None:
            if tick == 100:
                os.kill(pid, signal.SIGCONT)
                limit = time.monotonic() + PATIENCE
                while rings[0].pending():
                    assert time.monotonic() < limit

        summary = bridge.run(0.15, resume)
    assert summary.dropped == 36
    ticks = read_recording(path).ticks
    assert ticks["tick"].tolist() == [*range(64), *range(100, 150)]
    flagged = np.flatnonzero(ticks["flags"] & TickFlag.DROPPED_BEFORE)
    assert ticks["tick"][flagged].tolist() == [100]
    report = audit(path)
    assert report.verdict == "invalid"
    assert "63 is followed by 100" in report.reason


def test_full_ring_loses_nothing_in_simulated_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stream_module, "RING_SECONDS", 0.008)
    summary = recorded(tmp_path / "run.mcap", "point_mass", duration=0.3)
    assert summary.dropped == 0
    assert audit(tmp_path / "run.mcap").ticks == 300


# --- what is left behind


def test_no_shared_memory_is_left_whatever_happens(tmp_path: Path) -> None:
    def segments() -> set[str]:
        return {ring.name for ring in made if ring.name and Path(ring.name).exists()}

    made: list[Ring] = []
    shared = Ring.shared
    with pytest.MonkeyPatch.context() as patch:

        def kept(capacity: int) -> Ring:
            made.append(shared(capacity))
            return made[-1]

        patch.setattr(Ring, "shared", kept)
        recorded(tmp_path / "run.mcap", "point_mass", duration=0.01)
        assert len(made) == 1
        assert not segments()
        device = ScriptedDevice(still)
        with pytest.raises(HapticBridgeError, match="does not exist"):
            recorded(tmp_path / "no" / "run.mcap", "point_mass", device, duration=0.01)
        assert device.is_closed
        assert not segments()


def test_recording_is_closed_although_the_device_cannot_be(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"

    def fail() -> None:
        raise DeviceError("stuck")

    device = ScriptedDevice(sway, on_close=fail)
    with pytest.raises(DeviceError, match="stuck"):
        recorded(path, "point_mass", device, duration=0.05)
    assert not read_recording(path).is_cut


def test_summary_has_the_peaks_and_energies_of_the_records(motion: str) -> None:
    with fast("peg_in_hole", motion) as bridge:
        summary = bridge.run()
        rows = bridge.latest_records(1000)
    wrench = rows["wrench_on_tool"]
    assert summary.peak_force == pytest.approx(np.linalg.norm(wrench[:, :3], axis=1).max())
    assert summary.peak_torque == pytest.approx(np.linalg.norm(wrench[:, 3:], axis=1).max())
    for name in ("kinetic", "potential", "coupling_work", "environment_energy", "device_energy"):
        assert summary.energies[name] == rows[name][-1]
    assert summary.is_certified is None


def test_open_device_and_spec_are_the_same_to_a_bridge(motion: str) -> None:
    with fast("point_mass", motion) as by_spec, fast("point_mass", open_device(motion)) as by_hand:
        by_spec.run()
        by_hand.run()
        a, b = by_spec.latest_records(500), by_hand.latest_records(500)
    assert a.dtype == TICK_DTYPE
    assert a.tobytes() == b.tobytes()


# --- misuse, and what must not be taken silently


def test_axes_written_with_six_digits_are_a_rotation_to_the_last_one(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    c = 0.707107
    summary = recorded(path, "point_mass", axes=[c, -c, 0, c, c, 0, 0, 0, 1], duration=2.0)
    assert summary.environment == "strict"
    assert audit(path).verdict == "passive"
    axes = np.array(json.loads(read_recording(path).meta["axes"])).reshape(3, 3)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-15)


@pytest.mark.parametrize(
    "axes",
    [[1, 0, 0, 0, 1, 0, 0, 0, -1], [1, 0.1, 0, 0, 1, 0, 0, 0, 1], [1, 0, 0], "xyz", [np.nan] * 9],
    ids=["mirror", "shear", "too few", "text", "nan"],
)
def test_axes_that_are_no_rotation_are_refused(axes: Any) -> None:
    with pytest.raises(HapticBridgeError, match="right-handed rotation"):
        fast(axes=axes)


def test_limits_beyond_the_devices_own_are_refused_unless_nobody_feels_them(motion: str) -> None:
    with pytest.raises(DeviceError, match="is 11 N; the device 'simulated' bears 10 N"):
        fast(limits=Limits(force=11, torque=0.5))
    with pytest.raises(DeviceError, match="torque limit"):
        fast(limits=Limits(force=10, torque=0.6))
    fast(device=motion, limits=Limits(force=1000, torque=100))


def test_second_run_raises_the_force_from_zero_again_and_is_simulated_again(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    # it moves also between the runs, where no force acts and so no work is done
    device = ScriptedDevice(
        lambda tick: (0.0125 * (tick > 10) + 5e-5 * np.sin(0.5 * tick), 0, 0, 1, 0, 0, 0)
    )
    with fast("virtual_wall", device, recording=path, coupling=None) as bridge:
        bridge.run(0.6)
        bridge.run(0.6)
    rows = read_recording(path).ticks
    before, first = np.linalg.norm(rows["wrench_on_device"][[599, 600]], axis=1)
    assert before > 1.0
    ramping = np.flatnonzero(rows["flags"] & TickFlag.RAMPING)
    assert ramping.tolist() == [*range(500), *range(600, 1100)]
    assert first == pytest.approx(before / 501, rel=0.1)
    report = audit(path)
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")
    assert report.events["resume"] == 1


def test_run_after_the_motion_ended_returns_at_once(motion: str) -> None:
    with fast("point_mass", motion) as bridge:
        bridge.run(9.0)
        assert bridge.run().ticks == 9000


def test_bridge_that_is_not_open_does_not_run_and_none_opens_twice() -> None:
    bridge = fast()
    with pytest.raises(HapticBridgeError, match="not open"):
        bridge.run(0.1)
    with bridge:
        bridge.run(0.01)
    with pytest.raises(HapticBridgeError, match="not open"):
        bridge.run(0.1)
    with pytest.raises(HapticBridgeError, match="entered once"), bridge:
        pass


def test_two_bridges_cannot_move_the_tool_of_one_scene() -> None:
    scene = load_scene("point_mass")
    with fast(scene), pytest.raises(SceneError, match="in use"), fast(scene):
        pass
    with fast(scene) as bridge:
        bridge.run(0.01)


@pytest.mark.parametrize("substeps", [2.5, 101])
def test_substeps_are_a_whole_number_within_reason(substeps: Any) -> None:
    with pytest.raises(HapticBridgeError, match="substeps"), fast(substeps=substeps):
        pass


@pytest.mark.parametrize("substeps", [1, 2, 8])
def test_a_free_mass_is_strict_with_substeps_too(substeps: int) -> None:
    """The mean over the substeps does on the handle the work that the single wrenches did."""

    def shake(tick: int) -> tuple[float, ...]:
        t = 1e-3 * tick
        x = 3e-3 * np.sin(2 * np.pi * 60 * t) + 2e-3 * np.sin(2 * np.pi * 97 * t)
        return (x, 0, 0, 1, 0, 0, 0)

    device = ScriptedDevice(shake)
    with fast("point_mass", device, substeps=substeps) as bridge:
        assert bridge.run(1.0).environment == "strict"


def test_a_stop_ends_a_run_whose_recorder_stalls(tmp_path: Path) -> None:
    with fast("point_mass", recording=tmp_path / "run.mcap") as bridge:
        recorder = bridge._stream.recorder
        assert isinstance(recorder, Recorder)
        pid = recorder._process.pid
        os.kill(pid, signal.SIGSTOP)
        timer = threading.Timer(1.0, bridge.stop)
        timer.start()
        try:
            summary = bridge.run(1000.0)
        finally:
            timer.cancel()
            os.kill(pid, signal.SIGCONT)
    assert summary.stopped_by == "caller"
    assert summary.ticks < 100_000


@pytest.mark.parametrize(("distance", "is_refused"), [(0.0041, False), (0.0042, True)])
def test_absolute_start_that_would_pull_beyond_the_limit_is_refused(
    distance: float, is_refused: bool
) -> None:
    """At 2400 N/m the device's 10 N are reached 4.17 mm from the grip."""
    device = ScriptedDevice(lambda _tick: (distance, 0, 0, 1, 0, 0, 0))
    bridge = fast("point_mass", device, absolute=True)
    if not is_refused:
        with bridge:
            bridge.run(0.01)
        return
    with pytest.raises(DeviceError, match="puts the handle"), bridge:
        pass
    assert device.is_closed
