"""Force-feedback sticks behind the real driver, in virtual time."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from device_benches import LAYOUTS, NEWTONS, PERIOD, SCALE, TRAVEL, read
from device_benches import opened_stick as opened
from emulated.hid_seam import HidSeam
from emulated.pid_model import PidStick

from hapticbridge.device.driver import ignore_message
from hapticbridge.device.pid import device as sheet
from hapticbridge.device.pid.device import LIFE, RESTART, PidDevice, open_pid
from hapticbridge.device.profile import Profile, Quantity
from hapticbridge.device.transport.hid import HidLink, find
from hapticbridge.errors import DeviceError
from hapticbridge.kernel.record import SAMPLE_DTYPE, TickFlag

STALE = int(TickFlag.STALE_SAMPLE)


def wrench(x: float, y: float) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    return np.array([x, y, 9.0, 9.0, 9.0, 9.0])


def started(model: PidStick, **options: object) -> tuple[PidDevice, PidStick, HidSeam]:
    device, model, seam = opened(model, **options)
    device.start(PERIOD)
    return device, model, seam


@pytest.fixture(autouse=True)
def _no_profiles(monkeypatch: pytest.MonkeyPatch) -> None:
    """The user may have profiles of their own."""
    monkeypatch.setattr(sheet, "profile_of", lambda device, serial, model: None)


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_force_comes_out_as_asked_on_the_axis_that_was_asked(name: str) -> None:
    """A positive y is away from the user, the standard's Y is towards them."""
    device, model, _ = started(PidStick(layout=LAYOUTS[name]))
    for x, y in ((1.0, 0.0), (0.0, 1.0), (-2.5, 0.5), (NEWTONS, -NEWTONS), (0.0, 0.0)):
        device.write(wrench(x, y))
        assert model.force() == pytest.approx((x, -y), abs=NEWTONS / 1000)
    device.write(wrench(100.0, -100.0))
    assert model.force() == pytest.approx((NEWTONS, NEWTONS))


def test_a_reversed_axis_pushes_the_other_way() -> None:
    for reverse, signs in (("x", (-1, 1)), ("y", (1, -1)), ("xy", (-1, -1)), ("", (1, 1))):
        device, model, _ = started(PidStick(), reverse=reverse)
        device.write(wrench(1.0, 1.0))
        assert model.force() == pytest.approx((signs[0], -signs[1]), abs=1e-3)


@pytest.mark.parametrize("name", LAYOUTS)
def test_the_pose_is_the_deflection_times_the_travel(name: str) -> None:
    device, model, seam = started(PidStick(layout=LAYOUTS[name], buttons=0b10011))
    step = device.info.resolution or 0.0
    for place in ((0.0, 0.0), (0.5, -0.25), (1.0, 1.0), (-1.0, -1.0), (3.0, 0.1)):
        model.place = place
        flag, sample = read(device, seam)
        held = np.clip(place, -1.0, 1.0)
        expected = 0.5 * TRAVEL * held * [1.0, -1.0]
        np.testing.assert_allclose(sample["position"], [*expected, 0.0], atol=0.51 * step)
        assert (flag, sample["buttons"]) == (0, 0b10011)
        assert sample["quaternion"].tolist() == [1.0, 0.0, 0.0, 0.0]
    part = LAYOUTS[name]["state"].part("x")
    assert step == pytest.approx(TRAVEL / (part.high - part.low))


def test_a_stick_that_streams_is_stale_without_a_report_and_one_that_does_not_is_at_rest() -> None:
    for is_chatty, flag in ((True, STALE), (False, 0)):
        model = PidStick(is_chatty=is_chatty)
        device, model, seam = started(model)
        model.place = (0.5, 0.0)
        assert read(device, seam)[0] == 0
        sample = np.zeros(1, SAMPLE_DTYPE)
        assert device.read(sample) == flag
        assert sample["position"][0, 0] == pytest.approx(0.25 * TRAVEL, rel=1e-4)


def test_a_stick_that_says_nothing_at_rest_is_asked_where_it_stands() -> None:
    model = PidStick(is_chatty=False)
    model.place = (-0.5, 0.25)
    device, model, seam = opened(model)
    seam.advance(0.1)
    while model.take_report():
        pass
    sample = device.start(PERIOD)
    place = [-0.25 * TRAVEL, -0.125 * TRAVEL, 0.0]
    np.testing.assert_allclose(sample["position"][0], place, rtol=1e-4)

    class Mute(PidStick):
        def input_report(self, number: int, now: float) -> bytes | None:
            return None

    device, _, _ = opened(Mute(is_chatty=False))
    with pytest.raises(DeviceError, match="does not report its position; move it and start again"):
        device.start(PERIOD)


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_host_that_dies_lets_go_of_the_stick(name: str) -> None:
    device, model, seam = started(PidStick(layout=LAYOUTS[name]))
    life = LIFE * 10 * 8e-3  # the interval is unknown here: that of an old stick
    for _ in range(1000):  # as long as the loop lives, the force does
        read(device, seam)
        device.write(wrench(1.0, 1.0))
        assert math.hypot(*model.force()) > 1.3
    seam.advance(seam.now + life + 1e-3)
    assert model.force() == (0.0, 0.0)
    # and comes back when the loop does, within one restart
    for _ in range(round(life / LIFE / PERIOD) + 1):
        device.write(wrench(1.0, 1.0))
    assert math.hypot(*model.force()) > 1.3


def test_the_faster_the_bus_the_shorter_the_life() -> None:
    for interval, restart in ((1e-3, RESTART), (2e-3, RESTART), (8e-3, 0.08)):
        model = PidStick()
        seam, scale = HidSeam(model), sheet.Scale(NEWTONS, TRAVEL, np.ones(2))
        seam.advance(0.0)
        (plugged,) = find(sheet.DRIVER, seam)
        link = HidLink.open(plugged, seam, is_overlapped=False, slots=sheet.SLOTS)
        device = PidDevice(link, "fast", scale=scale, intervals=(1e-3, interval))
        device.start(PERIOD)
        assert [e.duration for e in model.effects.values()] == pytest.approx([LIFE * restart] * 2)
        assert device.info.rate == pytest.approx(1.0 / (2 * interval))


def test_only_what_has_changed_is_sent_and_restarts_are_few() -> None:
    device, model, _seam = started(PidStick())
    before = model.outputs
    for _ in range(10):
        device.write(wrench(1.0, 0.0))
    assert model.outputs - before == 1
    device.write(wrench(1.0, 0.5))
    assert model.outputs - before == 2
    device.write(wrench(0.5, 0.0))
    assert model.outputs - before == 4
    before = model.outputs
    for k in range(1000):
        device.write(wrench(1.0 + 1e-3 * (k % 2), 0.0))
    restarts = 1000 // 80
    assert model.outputs - before == 1000 + restarts * 3


def test_closing_stops_and_frees_the_effects_and_switches_the_motors_off() -> None:
    device, model, _ = started(PidStick())
    device.write(wrench(1.0, 1.0))
    assert model.is_enabled
    assert len(model.effects) == 2
    device.close()
    device.close()
    assert not model.is_enabled
    assert not model.effects
    assert model.force() == (0.0, 0.0)


def test_another_process_holds_what_takes_the_force_away(monkeypatch: pytest.MonkeyPatch) -> None:
    held: list[tuple[Any, ...]] = []
    monkeypatch.setattr(sheet, "guard_device_node", lambda *given: held.append(given))
    device, model, seam = started(PidStick())
    device.leave_last_word("/dev/hidraw7")
    device.write(wrench(1.0, 1.0))
    assert model.force() != (0.0, 0.0)
    ((path, *reports),) = held
    assert path == "/dev/hidraw7"
    for report in reports:  # the bridge is dead by now
        model.output(report, seam.now)
    assert (model.force(), model.is_enabled, model.effects) == ((0.0, 0.0), False, {})


def test_a_stick_whose_node_cannot_be_opened_twice_ends_its_effects_by_itself() -> None:
    device, *_ = started(PidStick())
    for path in ("/dev/hidraw_of_nobody", "1-4:1.0"):
        device.leave_last_word(path)
        assert device.last_word is None
    device.close()


def test_what_another_program_left_in_the_stick_is_cleared() -> None:
    model = PidStick(room=2)
    first, _, _ = started(model)
    first.write(wrench(1.0, 1.0))  # and dies
    second, model, _ = started(model)
    assert len(model.effects) == 2
    assert model.force() == (0.0, 0.0)
    second.write(wrench(0.5, 0.0))
    assert model.force() == pytest.approx((0.5, 0.0), abs=1e-3)


class Refusing(PidStick):
    def set_feature(self, report: bytes, now: float) -> None:
        super().set_feature(b"\xff", now)


@pytest.mark.parametrize(
    ("model", "words"),
    [
        (PidStick(room=1, most=10), "has no room for another effect; unplug it"),
        (PidStick(room=1), "plays 1 effect at a time; two are needed, one per axis"),
        (Refusing(), "refuses to create a constant force"),
    ],
)
def test_a_stick_that_does_not_create_two_effects_is_refused(model: PidStick, words: str) -> None:
    with pytest.raises(DeviceError, match=words):
        opened(model)
    erring = PidStick()
    erring.error = True
    with pytest.raises(DeviceError, match="does not create the constant force that it offers"):
        opened(erring)


def test_what_nobody_says_is_assumed_aloud_and_leaves_the_bound_unjudged() -> None:
    told: list[str] = []
    seam = HidSeam(PidStick())
    info = open_pid({}, told.append, seam).info
    assert (info.force_limit, info.damping, info.mass, info.delay) == (10.0, None, None, None)
    (sentence,) = told
    assert "10 N at full scale and a travel of 100 mm are assumed" in sentence
    assert "newtons= and travel= state it" in sentence
    told.clear()
    known = open_pid({**SCALE, "damping": 1.5, "mass": 0.3, "friction": 0.2}, told.append, seam)
    assert (known.info.force_limit, known.info.damping, known.info.friction) == (NEWTONS, 1.5, 0.2)
    assert not told


def test_a_profile_says_the_scale_of_its_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    room = Quantity((0.05, 0.05, 0.05), "a ruler")
    quantities = {"force_limit": Quantity(7.0, "a gauge"), "workspace": room}
    profile = Profile("stick", "pid", "P1", None, "", quantities)
    asked: list[tuple[str, str, str]] = []

    def profile_of(device: str, serial: str, model: str) -> Profile:
        asked.append((device, serial, model))
        return profile

    monkeypatch.setattr(sheet, "profile_of", profile_of)
    model = PidStick()
    model.place = (1.0, 0.0)
    device = open_pid({"damping": 1.0, "newtons": 7.0}, ignore_message, HidSeam(model))
    assert asked == [("pid", "P1", device.info.name)]
    assert device.info.force_limit == 7.0
    assert device.start(PERIOD)["position"][0, 0] == pytest.approx(0.025)
    with pytest.raises(DeviceError, match=r"newtons = 3\.0: .* was measured with 7, .* leave out"):
        open_pid({"newtons": 3.0}, ignore_message, HidSeam(model))
    with pytest.raises(DeviceError, match=r"travel = 0\.1: .* was measured with 0\.05"):
        open_pid({"travel": 0.1}, ignore_message, HidSeam(model))
    other = open_pid({"newtons": 3.0, "profile": "none"}, ignore_message, HidSeam(model))
    assert other.info.force_limit == 3.0


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"damping": 1.0}, r"damping is in newtons and metres, .* state newtons= and travel= too"),
        ({"newtons": 2.0, "mass": 1.0}, r"mass is in newtons and metres, .* state travel= too"),
        ({**SCALE, "damping": -1.0}, r"damping is -1\.0"),
        ({"newtons": 0.0}, r"newtons is 0\.0 N; it must be finite and > 0"),
        ({"travel": math.nan}, "travel is nan m; it must be finite and > 0"),
        ({"reverse": "z"}, "reverse is 'z'; it must be 'x', 'y' or 'xy'"),
    ],
)
def test_options_that_cannot_be_are_refused(options: dict[str, object], words: str) -> None:
    with pytest.raises(DeviceError, match=words):
        open_pid(options, ignore_message, HidSeam(PidStick()))
