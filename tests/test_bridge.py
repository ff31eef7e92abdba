"""A run: repeatable, as long as asked for, with the coupling that the device bears."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from audit_cases import COUPLING, TAP, ScriptedDevice, recorded
from bridge_runs import fast, still
from numpy.typing import NDArray

import hapticbridge as hb
from hapticbridge.audit import audit
from hapticbridge.clock import SimulatedClock
from hapticbridge.demand.guard import Limits
from hapticbridge.device import SimulatedDevice
from hapticbridge.errors import DeviceError, HapticBridgeError, SafetyTrip, SceneError
from hapticbridge.kernel.record import CLOCK_FIELDS
from hapticbridge.recording import read_recording
from hapticbridge.run.bridge import Bridge
from hapticbridge.run.commands import Couple, Switch
from hapticbridge.run.options import Workspace
from hapticbridge.scene import load_scene


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
    limits = Limits(force=10.0, torque=0.5, ramp=0.0)  # while it rises the handle follows in part
    recorded(first, "virtual_wall", "simulated", duration=0.4, limits=limits)
    recorded(second, "virtual_wall", f"trajectory:{first}", limits=limits)
    a, b = payloads(first), payloads(second)
    for name in ("device_position", "device_quaternion", "tool_position", "wrench_on_tool"):
        assert (a[name] == b[name]).all()


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


def test_a_stop_that_is_said_before_a_run_ends_it_before_its_first_tick(tmp_path: Path) -> None:
    path, device = tmp_path / "run.mcap", ScriptedDevice(still)
    with fast("point_mass", device, recording=path) as bridge:
        bridge.stop("page")
        first = bridge.run(0.02)
        assert (first.ticks, first.stopped_by) == (0, "page")
        second = bridge.run(0.02)  # one stop ends one run
        assert (second.ticks, second.stopped_by) == (20, "duration")
        bridge.stop()
        bridge.stop_on_signal("SIGTERM")
        third = bridge.run(0.02)
        assert (third.ticks, third.stopped_by) == (20, "signal")
    stop = read_recording(path).events[-1]
    assert (stop["tick"], stop["reason"], stop["signal"]) == (20, "signal", "SIGTERM")
    assert not np.any(device.writes)


def test_a_stop_in_a_run_that_fails_is_not_for_the_next_one() -> None:
    def fail(tick: int) -> None:
        if tick == 5:
            bridge.stop()
            raise ZeroDivisionError

    with fast("point_mass", ScriptedDevice(still)) as bridge:
        with pytest.raises(ZeroDivisionError):
            bridge.run(0.02, fail)
        summary = bridge.run(0.02)
    assert (summary.ticks, summary.stopped_by) == (25, "duration")


def test_method_by_itself_is_lossless_or_implicit_with_substeps() -> None:
    assert fast("point_mass").setup.method.name == "lossless"
    halved = fast("point_mass", substeps=2)
    assert halved.setup.method.name == "implicit"
    with halved as bridge:
        assert bridge.run(0.01).is_certified is True


def test_default_coupling_follows_damping_rate_and_scales() -> None:
    # 80 % of 2 (b − b/4) / T = 1.2 b / T
    bridge = fast("point_mass", "simulated:damping=5", rate=500)
    assert bridge.setup.coupling.stiffness == pytest.approx(3000)
    assert bridge.setup.law.damping == pytest.approx(1.25)
    scaled = fast("point_mass", "simulated", workspace=Workspace(scale=2.0))
    assert scaled.setup.coupling.stiffness == pytest.approx(600)
    with scaled as bridge:
        assert bridge.run(0.01).is_certified is True


def test_summary_has_the_peaks_and_energies_of_the_records(motion: str) -> None:
    with fast("peg_in_hole", motion) as bridge:
        summary = bridge.run()
        rows = bridge.latest_records(1000)
    for port, name in (("peak", "wrench_on_device"), ("peak_tool", "wrench_on_tool")):
        for kind, part in (("force", slice(0, 3)), ("torque", slice(3, 6))):
            largest = np.linalg.norm(rows[name][:, part], axis=1).max()
            assert getattr(summary, f"{port}_{kind}") == pytest.approx(largest)
    for name in ("kinetic", "potential", "coupling_work", "environment_energy", "device_energy"):
        assert summary.energies[name] == rows[name][-1]
    assert summary.is_certified is None


def test_limits_beyond_the_devices_own_are_refused_unless_nobody_feels_them(motion: str) -> None:
    for limits in (Limits(force=11, torque=0.5), Limits(force=10, torque=0.6)):
        with pytest.raises(DeviceError, match=r"limit is .*; device 'simulated' allows at most"):
            fast(limits=limits)
        fast(device=motion, limits=limits)


def test_second_run_raises_the_force_from_zero_again_and_is_simulated_again(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    # it moves also between the runs, where no force acts and so no work is done
    device = ScriptedDevice(
        lambda k: (0.00125 * np.clip(k - 10, 0, 10) + 5e-5 * np.sin(0.5 * k), 0, 0, 1, 0, 0, 0)
    )
    limits = Limits(force=10.0, torque=0.5, ramp=0.1)
    with fast("virtual_wall", device, recording=path, limits=limits) as bridge:
        bridge.run(0.6)
        bridge.run(0.6)
    rows = read_recording(path).ticks
    rise = np.minimum(np.arange(1, 601) / 101, 1.0)
    np.testing.assert_allclose(rows["lever"], [*rise, *rise], atol=1e-12)
    before, first = np.linalg.norm(rows["wrench_on_tool"][[599, 600]], axis=1)
    assert first == pytest.approx(before, rel=0.1)
    report = audit(path)
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")
    assert report.events["resume"] == 1


def test_run_after_the_motion_ended_returns_at_once(motion: str) -> None:
    with fast("point_mass", motion) as bridge:
        bridge.run(9.0)
        assert bridge.run().ticks == 9000


def test_a_bridge_is_opened_once_and_says_so_where_it_is_not_open() -> None:
    bridge = fast()
    message = r"the bridge is not open; open it with 'with Bridge\(...\)' first"
    calls: tuple[Callable[[], object], ...] = (
        lambda: bridge.run(0.1),
        lambda: bridge.command(Switch(force=False)),
        bridge.summary,
    )
    for call in calls:
        with pytest.raises(HapticBridgeError, match=message):
            call()
    with bridge:
        bridge.command(Couple(1000.0, 0.5))
        bridge.run(0.01)
    for call in calls[:2]:
        with pytest.raises(HapticBridgeError, match=message):
            call()
    with pytest.raises(HapticBridgeError, match="opened once"), bridge:
        pass


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("stiffness", "gain of the coupling: write coupling={'stiffness': …}"),
        ("reach", "belongs to the option limits: write it in hb.Limits"),
        ("scale", "belongs to the option workspace"),
        ("grip", "belongs to the scene: write hb.load_scene(…, grip=…)"),
        ("speed", "no option 'speed'; it has 'clutch', "),
    ],
)
def test_a_keyword_that_is_no_option_is_refused_in_a_sentence(name: str, message: str) -> None:
    with pytest.raises(HapticBridgeError, match=re.escape(message)):
        hb.Bridge("point_mass", **{name: 3})  # type: ignore[arg-type]


def test_what_is_no_scene_device_or_clock_is_refused_in_a_sentence() -> None:
    with pytest.raises(DeviceError, match=r"device is None, which has no DeviceInfo as info; it"):
        Bridge("point_mass", None)  # type: ignore[arg-type]
    with pytest.raises(DeviceError, match=r"device is .*, which is a class, and no object of it; "):
        Bridge("point_mass", SimulatedDevice)  # type: ignore[arg-type]
    lame = SimpleNamespace(info=SimulatedDevice().info, start=len, read=len)
    with pytest.raises(DeviceError, match=r"device is .*, which lacks write, close; it must be"):
        Bridge("point_mass", lame)
    with pytest.raises(HapticBridgeError, match=r"clock is the class .*; .*: SimulatedClock\(\)"):
        Bridge("point_mass", clock=SimulatedClock)  # type: ignore[arg-type]
    for source in (None, 5):
        with pytest.raises(SceneError, match=rf"scene is {source}; it must be an MJCF file"):
            load_scene(source)


class Failing(ScriptedDevice):
    """A device of a stranger, whose calls raise errors of their own."""

    def __init__(self, call: str) -> None:
        super().__init__(still)
        self.call, self.count = call, 0

    def read(self, sample: NDArray[np.void]) -> int:
        self.count += 1
        if self.call == "read" and self.count > 5:
            raise OSError("cable out")
        if self.call == "none" and self.count > 5:
            return None  # type: ignore[return-value]
        return super().read(sample)

    def write(self, wrench: NDArray[np.float64]) -> None:
        if self.call == "write" and self.count > 5:
            raise KeyError("motor")
        super().write(wrench)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        ("read", "read failed with OSError: cable out"),
        ("write", "write failed with KeyError"),
        ("none", "read returned None; it must be 0 for a new sample"),
    ],
)
def test_any_error_of_a_strangers_device_is_a_trip(call: str, message: str) -> None:
    device = Failing(call)
    with (
        Bridge("point_mass", device, COUPLING, clock=SimulatedClock()) as bridge,
        pytest.raises(SafetyTrip, match=message),
    ):
        bridge.run(duration=0.1)
    assert not np.any(device.writes[-1])
