"""The wheel driver against an emulated input device of Linux, in virtual time."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_cases import Called
from device_benches import PERIOD, read, ticks
from emulated.evdev_model import PATH, WheelModel
from emulated.hid_seam import DrivingClock

import hapticbridge as hb
from hapticbridge.device import SimulatedDevice
from hapticbridge.device.driver import ignore_message
from hapticbridge.device.wheel import device as wheel
from hapticbridge.device.wheel import evdev
from hapticbridge.device.wheel.device import WheelDevice, find, open_wheel
from hapticbridge.device.wheel.evdev import interval_of, range_of
from hapticbridge.errors import DeviceError, DeviceLost
from hapticbridge.identify import identify
from hapticbridge.identify.identify import measured_profile

SCALE: dict[str, object] = {"max_torque": 2.0, "range": 900.0}
TWIST = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.5])


def free() -> SimulatedDevice:
    return SimulatedDevice(hand=None, rotational_inertia=2e-2, rotational_damping=0.1)


def opened(model: WheelModel | None = None, **options: object) -> tuple[WheelDevice, WheelModel]:
    model = model or WheelModel(free())
    return open_wheel({**SCALE, **options}, ignore_message, model), model


def started(model: WheelModel | None = None, **options: object) -> tuple[WheelDevice, WheelModel]:
    device, model = opened(model, **options)
    device.start(PERIOD)
    return device, model


def test_a_wheel_turns_about_one_axis_and_obeys_a_torque_about_it() -> None:
    device, model = started()
    assert (device.info.name, device.info.axes) == ("Racing Wheel", ("rz",))
    assert (device.info.torque_limit, device.info.rate) == (2.0, 125.0)
    assert (device.info.mass, device.info.damping, device.info.delay) == (None, None, None)
    assert (model.autocenter, model.gain) == (0, 0xFFFF)
    assert ticks(device, model, 50, TWIST) == [0] * 50
    assert model.torque() == pytest.approx(0.5, rel=1e-4)
    _, sample = read(device, model)
    # J w' = t - c w from rest, over the time since the first torque
    rate, now = 0.1 / 2e-2, model.now - 1e-3
    expected = 0.5 / 0.1 * (now - (1 - math.exp(-rate * now)) / rate)
    angle = 2.0 * math.atan2(sample["quaternion"][3], sample["quaternion"][0])
    assert angle == pytest.approx(expected, rel=0.05)
    assert not sample["quaternion"][1:3].any()
    assert not sample["position"].any()
    device.close()
    device.close()
    assert (model.torque(), model.effects, model.files) == (0.0, {}, 0)


def test_full_level_is_the_stated_torque_and_more_is_cut_to_it() -> None:
    device, model = started(reverse=1.0)
    ticks(device, model, 3, 10.0 * TWIST)
    assert model.torque() == pytest.approx(-2.0)


def test_what_was_measured_with_one_strength_is_not_used_with_another(tmp_path: Path) -> None:
    device, model = opened(WheelModel(free(), counts=(0, 1 << 20)), rate=1000.0)
    result = identify(device, DrivingClock(model), period=PERIOD, axes=("rz",), duration=3.0)
    device.close()
    told: Any = {"device": "wheel", "serial": "", "date": "today", "duration": 3.0}
    file = tmp_path / "wheel.toml"
    file.write_text(measured_profile(result, **told).to_toml())
    named: dict[str, object] = {"range": 900.0, "profile": str(file)}
    assert open_wheel(named, ignore_message, model).info.torque_limit == 2.0
    with pytest.raises(DeviceError, match=r"measured with 2, and its damping holds for that only"):
        open_wheel({**named, "max_torque": 3.0}, ignore_message, model)
    other = {**named, "max_torque": 3.0, "profile": "none"}
    assert open_wheel(other, ignore_message, model).info.torque_limit == 3.0


def test_an_angle_beyond_half_a_turn_is_that_of_the_wheel() -> None:
    device, model = started()
    ticks(device, model, 3000, 3.0 * TWIST)
    assert model.angle() > 1.5 * math.pi
    _, sample = read(device, model)
    half = 0.5 * math.radians(900.0) * (model.count() / 65535.0 - 0.5)
    whole = np.array([math.cos(half), 0.0, 0.0, math.sin(half)])
    np.testing.assert_allclose(sample["quaternion"], whole * np.sign(whole[0]), atol=1e-12)
    assert sample["quaternion"][0] >= 0.0


def test_buttons_are_the_devices_own_in_order() -> None:
    model = WheelModel(free())
    model.buttons = {0x121, 30}  # a key of a keyboard is none
    device, _ = opened(model)
    assert device.info.buttons == 3
    assert device.start(PERIOD)["buttons"][0] == 0b10
    model.press(0x122, is_down=True)
    model.press(0x121, is_down=False)
    assert read(device, model)[1]["buttons"] == 0b100


class Guardian:
    """The second process, as the driver sees it."""

    def __init__(self) -> None:
        self.told: list[object] = []

    def expect(self, period: float) -> None:
        self.told.append(period)

    def beat(self, *, has_force: bool) -> None:
        self.told.append(has_force)

    def close(self) -> None:
        self.told.append("closed")


def test_a_second_process_is_told_of_every_torque_and_can_end_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model, guardian = WheelModel(free()), Guardian()
    guarded: list[Any] = []

    def guard(*words: object) -> Guardian:
        guarded.extend(words)
        return guardian

    monkeypatch.setattr(wheel, "Linux", lambda: model)
    monkeypatch.setattr(wheel, "guard_device_node", guard)
    device = open_wheel(SCALE)
    device.start(PERIOD)
    ticks(device, model, 2, TWIST)
    ticks(device, model, 1, np.zeros(6))
    ticks(device, model, 1, TWIST)
    assert guardian.told == [PERIOD, True, True, False, True]
    assert model.torque() != 0.0
    path, *reports = guarded
    assert path == PATH
    for report in reports:  # as the second process writes them
        model.write(40, report)
    assert (model.torque(), model.gain) == (0.0, 0)
    device.close()
    assert guardian.told[-1] == "closed"


def test_a_change_that_the_kernel_dropped_is_made_up_for_within_20_ms() -> None:
    device, model = started()
    ticks(device, model, 5, TWIST)
    (effect,) = model.effects.values()
    effect.level = 0
    ticks(device, model, 21, TWIST)
    assert model.torque() == pytest.approx(0.5, rel=1e-4)


def test_what_the_kernel_lost_in_a_long_pause_is_asked_for() -> None:
    device, model = started(WheelModel(free(), buttons={0x120}))
    ticks(device, model, 3, TWIST)
    model.press(0x120, is_down=False)
    model.advance(model.now + 0.3)  # more events than the kernel's queue holds
    _, sample = read(device, model)
    assert sample["buttons"] == 0
    half = 0.5 * math.radians(900.0) * (model.count() / 65535.0 - 0.5)
    assert sample["quaternion"][3] == pytest.approx(math.sin(half), abs=1e-12)


@pytest.mark.parametrize("when", range(1, 5))
def test_a_node_that_is_unplugged_while_it_is_opened_is_released(when: int) -> None:
    model, calls = WheelModel(free()), 0
    asked = model.ioctl

    def gone(*words: Any) -> None:
        nonlocal calls
        calls += 1
        model.is_plugged = calls < when
        asked(*words)

    model.ioctl = gone  # type: ignore[method-assign, assignment]
    assert find(model) == []
    assert model.files == 0


def test_a_torque_ends_with_a_loop_that_hangs_and_lives_on_while_it_runs() -> None:
    device, model = started()
    ticks(device, model, 500, TWIST)
    before = model.uploads
    for _ in range(200):
        model.advance(model.now + PERIOD)
        device.write(TWIST)
        assert model.torque() == pytest.approx(0.5, rel=1e-4)
    assert model.uploads - before <= 11  # an unchanged torque costs a write every 20 ms
    model.advance(model.now + 0.079)
    assert model.torque() != 0.0
    model.advance(model.now + 0.025)
    assert model.torque() == 0.0
    slow, model = opened()
    slow.start(0.05)
    slow.write(TWIST)
    model.advance(model.now + 0.24)
    assert model.torque() != 0.0
    model.advance(model.now + 0.02)
    assert model.torque() == 0.0


def test_an_unplugged_wheel_is_lost() -> None:
    device, model = started()
    model.is_plugged = False
    with pytest.raises(DeviceLost, match=f"{PATH} is gone: the device was unplugged"):
        read(device, model)
    with pytest.raises(DeviceLost, match="is gone"):
        device.write(TWIST)
    device.close()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"max_torque": None}, r"no driver reports its strength; state the torque at full level"),
        ({"range": None}, r"its driver does not report how far it turns; .*such as range=900"),
        ({"max_torque": 0.0}, "max_torque is 0.0 N m; it must be finite and > 0"),
        ({"range": 4000.0}, "range is 4000; it must be at most 3600 degrees"),
        ({"axis": "x"}, "axis is 'x'; it must be one of 'rx', 'ry', 'rz'"),
        ({"reverse": 2.0}, "reverse is 2.0; it must be 1"),
        ({"rotational_damping": -1.0}, "rotational_damping is -1.0"),
        ({"serial": "/dev/input/event0"}, "no device 'wheel' has serial '/dev/input/event0'"),
    ],
)
def test_bad_options_are_refused(options: dict[str, Any], words: str) -> None:
    model = WheelModel(free())
    given = {k: v for k, v in {**SCALE, **options}.items() if v is not None}
    with pytest.raises(DeviceError, match=words):
        open_wheel(given, ignore_message, model)
    assert model.files == 0


def test_a_gamepad_that_only_shakes_is_refused_with_the_reason() -> None:
    model = WheelModel(free(), can_push=False)
    (device,) = find(model)
    assert device.problem is not None
    assert "its motors shake and cannot push (rumble)" in device.problem
    with pytest.raises(DeviceError, match="a cue and no force; a wheel or a force-feedback stick"):
        open_wheel(SCALE, ignore_message, model)
    assert model.files == 0


def test_it_is_listed_and_what_may_not_be_opened_is_not() -> None:
    model = WheelModel(free())
    (device,) = find(model)
    assert (str(device), device.path) == ("Racing Wheel (046d:c24f)", PATH)
    assert device.problem is None
    model.allows = False
    assert find(model) == []
    with pytest.raises(DeviceError, match=r"is plugged in \(looked for an input device with a c"):
        open_wheel(SCALE, ignore_message, model)
    with pytest.raises(DeviceError, match=f"cannot open {PATH}: Permission denied"):
        evdev.open_node(model, PATH)


def test_rate_and_range_are_those_that_the_kernel_shows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evdev, "INPUT", tmp_path)
    hid = tmp_path / "usb/0003:046D:C24F.0001"
    (hid / "input/input5").mkdir(parents=True)
    (tmp_path / "event7").mkdir()
    (tmp_path / "event7/device").symlink_to(hid / "input/input5")
    (hid / "input/input5/device").symlink_to(hid)
    assert (interval_of(PATH), range_of(PATH)) == (None, None)
    for name, interval in (("ep_81", "2ms"), ("ep_01", "8ms")):
        (tmp_path / "usb" / name).mkdir()
        (tmp_path / "usb" / name / "interval").write_text(interval + "\n")
    (hid / "range").write_text("540\n")
    assert (interval_of(PATH), range_of(PATH)) == (8e-3, 540.0)
    device, model = opened(range=900.0)
    assert device.info.rate == pytest.approx(125.0)
    open_wheel({"max_torque": 2.0}, ignore_message, model)
    assert opened(rate=1000.0)[0].info.rate == 1000.0


HINGE = """
<mujoco>
  <option timestep="0.001" integrator="implicitfast" gravity="0 0 0"/>
  <worldbody>
    <geom type="box" size="0.02 0.02 0.05" pos="0.06 0.08 0"/>
    <body name="knob">
      <joint type="hinge" axis="0 0 1" damping="0.01"/>
      <geom type="capsule" fromto="0 0 0 0.1 0 0" size="0.01" mass="0.1"/>
      <site name="grip"/>
    </body>
  </worldbody>
</mujoco>
"""


def held(target: float) -> SimulatedDevice:
    """A wheel in a hand that turns it to an angle in rad and back."""
    times = [0.0, 0.2, 1.2, 2.0]
    angles = np.array([0.0, 0.0, target, target])
    zeros = np.zeros((4, 3))
    turned = np.column_stack([np.cos(angles / 2), *zeros[:, :2].T, np.sin(angles / 2)])
    return SimulatedDevice(
        rotational_inertia=2e-2, rotational_damping=0.1, path=hb.device.Motion(times, zeros, turned)
    )


def test_it_turns_a_hinge_against_a_stop_and_the_run_is_audited(tmp_path: Path) -> None:
    (tmp_path / "knob.xml").write_text(HINGE)
    scene = hb.load_scene(tmp_path / "knob.xml", grip="grip")
    device, model = opened(WheelModel(held(1.2)), rotational_damping=0.1, rate=1000.0)
    recording = tmp_path / "run.mcap"
    with hb.Bridge(scene, device, clock=DrivingClock(model), recording=recording) as bridge:
        summary = bridge.run(2.0)
    ticks_ = hb.read_recording(recording).ticks
    turned = 2.0 * np.arctan2(ticks_["tool_quaternion"][:, 3], ticks_["tool_quaternion"][:, 0])
    assert 0.3 < turned.max() < 0.9  # the stop holds it
    torque = ticks_["wrench_on_device"]
    assert not torque[:, :5].any()
    assert torque[:, 5].min() < -1e-3  # and it pushes back
    report = hb.audit(recording)
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")
    (condition,) = summary.conditions
    assert condition.startswith("rotation: ")
    assert "its delay is unknown; without one, device damping 0.1 >= " in condition


def test_identify_measures_its_inertia_and_damping() -> None:
    device, model = opened(WheelModel(free(), counts=(0, 1 << 20)), rate=1000.0)
    result = identify(device, DrivingClock(model), period=PERIOD, axes=("rz",), duration=6.0)
    device.close()
    fit = result.fits["rz"]
    assert fit.mass.value == pytest.approx(2e-2, rel=0.05)
    assert fit.damping.value == pytest.approx(0.1, rel=0.05)
    assert fit.damping.least <= 0.1 <= fit.damping.most


def test_a_run_names_what_is_missing(call: Called, monkeypatch: pytest.MonkeyPatch) -> None:
    model = WheelModel(free())
    monkeypatch.setattr(wheel, "Linux", lambda: model)
    code, _, err = call("run", "point_mass", "--device", "wheel")
    assert (code, err.count("\n")) == (2, 1)
    assert "state the torque at full level in N m with max_torque=" in err
    code, out, _ = call("devices")
    assert code == 0
    assert f"Racing Wheel (046d:c24f) at {PATH}" in out
    assert "identify wheel:max_torque=NM" in out
