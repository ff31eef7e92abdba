"""The whole bridge, its audit and ``identify`` on every emulated device, in virtual time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import device_benches as benches
import numpy as np
import pytest
from device_benches import NEWTONS, PERIOD, opened_rawhid
from emulated.dhd_stub import OMEGA3, SIGMA7, Stub
from emulated.handle import planar_hand
from emulated.hd_stub import HdStub
from emulated.hid_seam import DrivingClock, HidSeam
from emulated.pid_model import PidStick
from emulated.rawhid_model import RawHid
from emulated.spacemouse_model import SpaceMouse
from numpy.typing import NDArray

import hapticbridge as hb
from hapticbridge.clock import Clock
from hapticbridge.demand.guard import Limits
from hapticbridge.device import Device, Motion, SimulatedDevice, device_for
from hapticbridge.device.driver import ignore_message
from hapticbridge.device.pid import device as sheet
from hapticbridge.device.pid.device import open_pid
from hapticbridge.device.profile import read_profile
from hapticbridge.device.spacemouse import open_spacemouse
from hapticbridge.errors import DeviceError, SafetyTrip
from hapticbridge.identify import identify
from hapticbridge.identify.identify import measured_profile
from hapticbridge.kernel.record import TickFlag
from hapticbridge.run.options import Workspace
from hapticbridge.scene import load_scene, scene_path

WIDE = 0.12
OWN_PATH = scene_path("peg_in_hole").with_suffix(".csv")


@dataclass
class Rig:
    """A device, opened, in a hand that puts the peg into the hole.

    Attributes:
        device: The driver.
        clock: Time, of device and bridge.
        model: What is emulated.
        bus: What it is plugged into.
        force: Returns what the hand feels.
        later: Lets that many seconds go by for the model.
        scene: What is run, and how.
    """

    device: Device
    clock: Clock
    model: Any
    bus: Any
    force: Callable[[], Any]
    later: Callable[[float], object]
    scene: dict[str, Any] = field(default_factory=lambda: {"scene": "peg_in_hole"})

    def run(self, recording: Path, seconds: float, **options: Any) -> hb.Summary:
        given = {**self.scene, "clock": self.clock, "recording": recording}
        scene = given.pop("scene")
        with hb.Bridge(scene, self.device, **given) as bridge:
            return bridge.run(seconds, **options)


def falcon() -> Rig:
    hand = device_for(load_scene("peg_in_hole"), "simulated:mass=0.4,damping=2")
    assert isinstance(hand, SimulatedDevice)
    bench = benches.FalconBench(hand)
    device = bench.opened(damping=2.0)
    clock, later = bench.clock(2e-4), lambda s: bench.time.until(bench.time.now + s)
    return Rig(device, clock, bench.model, bench, lambda: bench.model.motors, later)


def rawhid(model: RawHid | None = None) -> Rig:
    mine = SimulatedDevice(path=OWN_PATH, friction=0.05)
    device, model, seam = opened_rawhid(model or RawHid(mine))
    later = lambda s: model.advance(seam.now + s)  # noqa: E731
    return Rig(device, DrivingClock(seam), model, seam, lambda: model.wrench, later)


def stick(name: str = "usual", model: PidStick | None = None) -> Rig:
    moved = SimulatedDevice(mass=0.25, damping=4.0, friction=0.05, path=planar_hand("planar_peg"))
    model = model or PidStick(moved, benches.LAYOUTS[name], newtons=NEWTONS, travel=WIDE)
    device, model, seam = benches.opened_stick(model, damping=4.0, mass=0.25, travel=WIDE)
    # the scene lies in x and z, the stick in x and y
    axes = [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]
    scene = {"scene": "planar_peg", "workspace": Workspace(axes=axes)}
    later = lambda s: model.advance(seam.now + s)  # noqa: E731
    return Rig(device, DrivingClock(seam), model, seam, model.force, later, scene)


def haply() -> Rig:
    hand = SimulatedDevice(path=OWN_PATH, mass=0.2, damping=2.0, friction=0.05)
    bench = benches.HaplyBench(hand, resolution=1e-5)
    device = bench.opened(damping=2.0)
    (inverse,) = bench.service.devices.values()
    later = lambda s: bench.time.advance(bench.time.now + s)  # noqa: E731
    # this hand moves at once, so that a force that rises slowly would leave the peg beside the hole
    scene = {"scene": "peg_in_hole", "limits": Limits(ramp=0.0)}
    force = lambda: inverse.force  # noqa: E731
    return Rig(device, DrivingClock(bench.time), bench.service, bench, force, later, scene)


def force_dimension(kind: int = OMEGA3) -> Rig:
    places = np.array([[0, 0, 0], [0, 0, 0], [0, 0, -43], [4, 0, -43], [4, 0, -43]])
    stub = Stub(kind, Motion([0.0, 0.3, 2.5, 3.0, 4.0], 1e-3 * places))
    stub.call("mechanics", 0.25, 1.5, 0.05, 1e-5)
    stub.call("hand", 300.0, 6.0, 0.3)
    device = stub.opened(numbers={"damping": 1.5, "rotational_damping": 4e-3})
    stub.begin = stub.now
    later = lambda s: stub.advance(stub.now + s)  # noqa: E731
    return Rig(device, DrivingClock(stub), stub, stub, stub.force, later)


def touch() -> Rig:
    places = np.array([[0, 0, 0], [0, 0, 0], [0, 0, -43], [4, 0, -43], [4, 0, -43]])
    stub = HdStub(Motion([0.0, 0.3, 2.5, 3.0, 4.0], 1e-3 * places))
    stub.call("mechanics", 0.1, 1.5, 0.05, 1e-5)
    stub.call("hand", 300.0, 6.0, 0.3)
    device = stub.opened(numbers={"damping": 1.5})
    stub.begin = stub.now
    later = lambda s: stub.advance(stub.now + s)  # noqa: E731
    return Rig(device, DrivingClock(stub), stub, stub, stub.force, later)


RIGS: dict[str, tuple[Callable[[], Rig], str]] = {
    "falcon": (falcon, "with its delay of 2 ms"),
    # its own period and 1 ms each way on the bus
    "rawhid": (rawhid, "its delay of"),
    "haply": (haply, "its delay of"),
    "omega.3": (force_dimension, "its delay of"),
    "sigma.7": (lambda: force_dimension(SIGMA7), "its delay of"),
    # up to a servo tick each way
    "touch": (touch, "its delay of"),
    # what the firmware adds in delay nobody says
    "stick": (stick, "without delay, which is unknown"),
    "odd stick": (lambda: stick("odd"), "without delay, which is unknown"),
}
"""Makers of devices, and what their condition says of their delay."""


def rows(recording: Path) -> NDArray[np.void]:
    return hb.read_recording(recording).ticks


@pytest.mark.parametrize("name", RIGS)
def test_the_peg_goes_in_behind_it_and_is_audited_passive(name: str, tmp_path: Path) -> None:
    make, condition = RIGS[name]
    rig, recording = make(), tmp_path / "run.mcap"
    seconds = 2.5 if name == "falcon" else 4.0  # emulated bit by bit, it is the slowest
    summary = rig.run(recording, seconds)
    report, ticks = hb.audit(recording), rows(recording)
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit"), report.reason
    is_proved = "its delay" in condition and not rig.device.info.sensed
    assert report.certified is (True if is_proved else None)
    assert condition in report.conditions[0]
    assert summary.ticks == len(ticks) == 1000 * seconds
    assert (ticks["flags"] & int(TickFlag.CONTACT)).any()
    assert summary.peak_force > 0.05
    assert name not in {"haply", "omega.3", "sigma.7"} or ticks["tool_position"][-1, 2] < 0.0
    assert not np.any(rig.force())


def unplug(rig: Rig) -> None:
    rig.bus.unplug(rig.model)


def answers(words: str) -> Callable[[Rig], None]:
    return lambda rig: rig.model.spoil.update({rig.model.messages + 1: words})


@pytest.mark.parametrize(
    ("name", "fault", "words"),
    [
        ("falcon", lambda rig: setattr(rig.bus.time, "is_plugged", False), "unplugged"),
        ("rawhid", unplug, "tick 150: .* is gone: unplugged"),
        ("rawhid", lambda rig: setattr(rig.model, "motion", (np.nan,) * 12), "not finite"),
        ("stick", unplug, "tick 150: .* is gone: unplugged"),
        ("haply", lambda rig: setattr(rig.bus.link, "is_dropped", True), "closed|dropped"),
        ("haply", answers("{"), "not a JSON object"),
        ("haply", answers('{"inverse3":[]}'), "does not list it"),
        ("omega.3", lambda rig: rig.model.call("fail", 1), "gone or failed"),
        ("omega.3", lambda rig: rig.model.call("spoil", np.nan), "reports an impossible position"),
    ],
)
def test_whatever_breaks_trips_and_every_row_is_kept(
    name: str, fault: Callable[[Rig], None], words: str, tmp_path: Path
) -> None:
    rig, recording = RIGS[name][0](), tmp_path / "run.mcap"
    with pytest.raises(SafetyTrip, match=words) as trip:
        rig.run(recording, 1.0, on_tick=lambda tick: fault(rig) if tick == 150 else None)
    ticks, kept = rows(recording), hb.read_recording(recording)
    assert not kept.is_cut
    assert 149 <= len(ticks) <= 152
    np.testing.assert_array_equal(ticks["tick"], np.arange(len(ticks)))
    assert [event["event"] for event in kept.events].count("trip") == 1
    assert np.isfinite(trip.value.records["device_position"]).all()
    if name != "falcon":  # without a bus there is no power
        rig.later(0.5)  # a device that gets no force any more has none
        assert not np.any(rig.force())


def test_what_was_felt_was_recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    felt, original = [], RawHid.output

    def output(self: RawHid, report: bytes, now: float) -> None:
        original(self, report, now)
        felt.append(self.wrench.copy())

    monkeypatch.setattr(RawHid, "output", output)
    rawhid().run(tmp_path / "rawhid.mcap", 0.1)
    sent = rows(tmp_path / "rawhid.mcap")["wrench_on_device"]
    first = len(felt) - len(sent) - 3  # after: zero twice, motors off
    np.testing.assert_allclose(felt[first : first + len(sent)], sent, rtol=1e-6, atol=1e-30)
    rig = haply()
    rig.run(tmp_path / "haply.mcap", 0.1)
    sent, got = rows(tmp_path / "haply.mcap")["wrench_on_device"][:, :3], np.array(rig.model.forces)
    # zero forces of the end come after the last tick's
    assert any(np.array_equal(got[-len(sent) - k : -k], sent) for k in range(1, 6))


def test_a_paddle_of_one_axis_runs_a_scene_and_its_other_axes_stay(tmp_path: Path) -> None:
    rig = rawhid(benches.paddle())
    summary = rig.run(tmp_path / "run.mcap", 0.5)
    ticks = rows(tmp_path / "run.mcap")
    assert np.ptp(ticks["device_position"][:, 0]) > 1e-4
    assert not ticks["device_position"][:, 1:].any()
    assert (ticks["device_quaternion"] == (1.0, 0.0, 0.0, 0.0)).all()
    steps = ticks["device_position"][:, 0] / rig.model.claims.resolution
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-3)
    # b = 0.8 N s/m is enough, and it does not turn; how late it is it does not say
    (condition,) = summary.conditions
    assert "if it answers without delay, which is unknown" in condition
    assert summary.is_certified is None


def test_two_effects_cost_no_more_reports_than_one_with_a_direction(tmp_path: Path) -> None:
    rig = stick()
    rig.run(tmp_path / "run.mcap", 4.0)
    force = rows(tmp_path / "run.mcap")["wrench_on_device"][:, :2]
    full = 32767 / NEWTONS
    two = np.count_nonzero(np.diff(np.rint(full * force), axis=0)) / len(force)
    size = np.rint(full * np.hypot(*force.T))
    angle = np.rint(100 * np.degrees(np.arctan2(force[:, 1], force[:, 0])))
    one = (np.count_nonzero(np.diff(size)) + np.count_nonzero(np.diff(angle))) / len(force)
    assert two < 0.95 * one  # 1.44 and 1.62
    # restarts and the start are all that comes on top
    assert rig.model.outputs / len(force) < two + 0.06


def test_a_device_in_a_hand_refuses_a_clock_that_runs_ahead_of_it() -> None:
    devices = opened_rawhid()[0], open_spacemouse({}, ignore_message, HidSeam(SpaceMouse()))
    for device in devices:
        with pytest.raises(DeviceError, match=r"moves in real time, .* leave out --fast"):
            hb.Bridge("peg_in_hole", device, clock=hb.SimulatedClock())
    assert [device.info.is_real for device in devices] == [True, False]


REAL = sorted(set(benches.DRIVERS) - {"simulated"})


@pytest.mark.parametrize("driver", REAL)
def test_identify_finds_what_is_behind_a_driver(driver: str) -> None:
    seed = REAL.index(driver) % 2
    true = benches.mechanics(seed)
    fit = benches.identified(driver, seed, "xy"[seed], 6.0)
    for name, tolerance in (("mass", 0.05), ("damping", 0.05), ("friction", 0.1)):
        assert getattr(fit, name).value == pytest.approx(true[name], rel=tolerance)
    # as the drivers say: a Falcon's answer is one tick old, and the next is asked a tick later
    ticks = {"falcon": 2, "haply": 1}.get(driver)
    if ticks is not None:
        assert fit.delay.value == pytest.approx(ticks * PERIOD, abs=0.4 * PERIOD)
        assert fit.delay.half_width < 0.8 * PERIOD


def test_identify_finds_inertia_and_damping_of_a_wrist() -> None:
    stub = Stub(SIGMA7)
    result = identify(stub.opened(), DrivingClock(stub), period=PERIOD, axes=("rz",), duration=4.0)
    fit = result.fits["rz"]
    assert fit.mass.value == pytest.approx(2e-4, rel=0.05)
    assert fit.damping.value == pytest.approx(4e-3, rel=0.05)


def test_identified_scale_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assumed 10 N and 0.1 m: all that is measured is off by the same factors as the force."""
    monkeypatch.setattr(sheet, "profile_of", lambda device, serial, model: None)
    moved = SimulatedDevice(hand=None, mass=0.3, damping=2.0)
    seam = HidSeam(PidStick(moved, newtons=NEWTONS, travel=benches.TRAVEL))
    device = open_pid({}, ignore_message, seam)
    result = identify(device, DrivingClock(seam), period=PERIOD, axes=("x",), duration=5.0)
    device.close()
    # N per m, and per m/s, in the assumed units of both
    factor = (sheet.ASSUMED_NEWTONS / NEWTONS) / (sheet.ASSUMED_TRAVEL / benches.TRAVEL)
    assert result.fits["x"].damping.value == pytest.approx(factor * 2.0, rel=0.05)
    told_of: Any = {"device": "pid", "serial": "P1", "date": "today", "duration": 5.0}
    profile = measured_profile(result, workspace=device.workspace, **told_of)
    file = tmp_path / "pid-P1.toml"
    file.write_text(profile.to_toml())
    told: list[str] = []
    again = open_pid({"profile": str(file)}, told.append, HidSeam(PidStick()))
    assert (again.info.force_limit, again.workspace) == (device.info.force_limit, device.workspace)
    assert not told
    info = read_profile(file).fill(again.info)
    assert info.damping == pytest.approx(result.fits["x"].damping.least)
