"""SpaceMouse pucks behind the real driver, in virtual time."""

from __future__ import annotations

import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from emulated.hid_device import HidDevice
from emulated.hid_seam import DrivingClock, HidSeam
from emulated.spacemouse_model import SpaceMouse
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import hapticbridge as hb
from hapticbridge.device import spacemouse as driver
from hapticbridge.device.driver import ignore_message
from hapticbridge.device.spacemouse import SpaceMouseDevice, decoded, open_spacemouse
from hapticbridge.errors import DeviceError
from hapticbridge.kernel.record import SAMPLE_DTYPE

PERIOD = 1e-3
counts = st.integers(-32768, 32767)


def opened(
    model: SpaceMouse | None = None, **options: Any
) -> tuple[SpaceMouseDevice, SpaceMouse, HidSeam]:
    model = model or SpaceMouse()
    seam = HidSeam(model)
    return open_spacemouse(options, ignore_message, seam), model, seam


def run(device: SpaceMouseDevice, seam: HidSeam, ticks: int) -> Any:
    sample = np.zeros(1, SAMPLE_DTYPE)
    for _ in range(ticks):
        seam.advance(seam.now + PERIOD)
        assert device.read(sample) == 0
    return sample[0]


@given(st.tuples(*[counts] * 6))
def test_length_tells_the_layouts_apart(values: tuple[int, ...]) -> None:
    assert decoded(struct.pack("<B6h", 1, *values)) == driver.Deflection(0, values)
    assert decoded(struct.pack("<B3h", 1, *values[:3])) == driver.Deflection(0, values[:3])
    assert decoded(struct.pack("<B3h", 2, *values[3:])) == driver.Deflection(3, values[3:])


@given(st.binary(max_size=80))
def test_arbitrary_bytes_are_read_without_a_crash(data: bytes) -> None:
    news = decoded(data)
    assert news is None or data[0] in (1, 2, 3)
    if isinstance(news, driver.Deflection):
        assert all(abs(driver.deflection(count, 0.05)) <= 1.0 for count in news.counts)
    elif isinstance(news, driver.Buttons):
        assert 0 <= news.bits < 2**48


@pytest.mark.parametrize(
    ("report", "bits"),
    [("0302", 2), ("030200", 2), ("0300004001", 0x01400000), ("03" + "ff" * 9, 2**48 - 1)],
)
def test_buttons_are_a_little_endian_bitmap_of_any_length(report: str, bits: int) -> None:
    assert decoded(bytes.fromhex(report)) == driver.Buttons(bits)


@given(st.integers(-40000, 40000), st.floats(0.0, 0.9))
def test_deflection_beyond_the_dead_band_is_linear_odd_and_clamped(count: int, band: float) -> None:
    value = driver.deflection(count, band)
    assert driver.deflection(-count, band) == -value
    assert value * count >= 0.0
    if abs(count) >= 350:
        assert abs(value) == 1.0
    elif abs(count) <= 350 * band:
        assert value == 0.0
    else:  # the slope that leads from 0 at the band's edge to 1 at full scale
        assert abs(value) == pytest.approx((abs(count) - 350 * band) / (350 - 350 * band))


AXES = [
    # deflection of the maker's axis, direction of the handle: y away from the user, z up
    ((350, 0, 0, 0, 0, 0), (1, 0, 0), (0, 0, 0)),
    ((0, 350, 0, 0, 0, 0), (0, -1, 0), (0, 0, 0)),
    ((0, 0, 350, 0, 0, 0), (0, 0, -1), (0, 0, 0)),
    ((0, 0, 0, 350, 0, 0), (0, 0, 0), (1, 0, 0)),
    ((0, 0, 0, 0, 350, 0), (0, 0, 0), (0, -1, 0)),
    ((0, 0, 0, 0, 0, -350), (0, 0, 0), (0, 0, 1)),
]


Three = tuple[int, int, int]


@pytest.mark.parametrize("is_long", [False, True])
@pytest.mark.parametrize(("push", "way", "turn"), AXES)
def test_deflection_is_speed(push: Any, way: Three, turn: Three, is_long: bool) -> None:
    device, model, seam = opened(SpaceMouse(has_long_reports=is_long), speed=0.1, turn=0.5)
    device.start(PERIOD)
    model.deflect(*push)
    sample = run(device, seam, 401)  # the first read only takes the deflection
    np.testing.assert_allclose(sample["position"], 0.4 * 0.1 * np.array(way), atol=1e-12)
    x, y, z, w = Rotation.from_rotvec(0.4 * 0.5 * np.array(turn)).as_quat(canonical=True)
    np.testing.assert_allclose(sample["quaternion"], (w, x, y, z), atol=1e-12)


def test_turns_about_changing_axes_are_composed_in_the_frame_of_the_base() -> None:
    device, model, seam = opened(turn=2.0, dead_band=0.0)
    device.start(PERIOD)
    expected, rng = Rotation.identity(), np.random.default_rng(5)
    for _ in range(200):
        push = rng.integers(-350, 351, 3)
        model.deflect(0, 0, 0, *(int(count) for count in push))
        sample = run(device, seam, 1)  # takes the rate, and turns by that of the tick before
        x, y, z, w = expected.as_quat(canonical=True)
        np.testing.assert_allclose(sample["quaternion"], (w, x, y, z), atol=1e-12)
        expected = Rotation.from_rotvec(PERIOD * 2.0 * push / 350.0 * (1, -1, -1)) * expected


def test_a_pushed_puck_covers_the_integral_of_its_speed() -> None:
    """A half sine of deflection with no dead band: speed x time x 2/pi, to the report's 8 ms."""

    def push(when: float) -> tuple[float, ...]:
        deflection = math.sin(math.pi * when) if 0.0 < when < 1.0 else 0.0
        return (deflection, 0.0, 0.0, 0.0, 0.0, 0.0)

    device, _, seam = opened(SpaceMouse(push), speed=0.1, dead_band=0.0)
    device.start(PERIOD)
    sample = run(device, seam, 1200)
    assert sample["position"][0] == pytest.approx(0.1 * 2.0 / math.pi, rel=0.005)
    # at rest it is silent, for as long as it likes, and nothing moves
    before = sample.copy()
    assert run(device, seam, 5000).tobytes() == before.tobytes()


def test_a_puck_that_falls_silent_while_deflected_stops_the_handle() -> None:
    device, model, seam = opened(speed=0.1)
    device.start(PERIOD)
    model.deflect(350, 0, 0, 0, 0, 0)
    sample = run(device, seam, 3000)
    assert sample["position"][0] == pytest.approx(0.1 * driver.HELD, abs=2e-4)


def test_buttons_and_light() -> None:
    device, model, seam = opened()
    assert not model.is_lit
    device.start(PERIOD)
    assert model.is_lit
    model.press(2)
    assert run(device, seam, 1)["buttons"] == 2
    model.press(0)
    assert run(device, seam, 1)["buttons"] == 0
    device.close()
    device.close()
    assert not model.is_lit


def test_a_model_without_a_light_works_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(self: HidDevice, report: bytes, now: float) -> None:
        raise OSError

    monkeypatch.setattr(SpaceMouse, "output", refuse)
    device, _, seam = opened()
    device.start(PERIOD)
    run(device, seam, 3)
    device.close()


def test_starting_again_goes_back_to_the_origin() -> None:
    device, model, seam = opened()
    for _ in range(2):
        start = device.start(PERIOD)[0]
        assert (start["position"].any(), start["quaternion"][0]) == (False, 1.0)
        model.deflect(350, 350, 350, 350, 350, 350)
        assert run(device, seam, 50)["position"].all()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"speed": 0.0}, "speed is 0.0 m/s; it must be finite and > 0"),
        ({"turn": -1.0}, "turn is -1.0"),
        ({"dead_band": 1.0}, "dead_band is 1.0; it must be below 1"),
        ({"dead_band": -0.1}, "dead_band is -0.1"),
        ({"serial": "7"}, "no device 'spacemouse' has serial '7'"),
    ],
)
def test_options_out_of_range_are_refused(options: dict[str, Any], words: str) -> None:
    with pytest.raises(DeviceError, match=words):
        opened(**options)


CADMOUSE = (0xC650, 0xC651, *range(0xC654, 0xC659), 0xC664, 0xC665, 0xC668)


def test_flat_mice_of_the_same_maker_are_not_taken_for_one() -> None:
    products = {(usb_id.vendor, usb_id.product) for usb_id in driver.DRIVER.ids}
    assert len(products) == len(driver.DRIVER.ids) == 22
    assert not products & {(0x256F, product) for product in CADMOUSE}
    assert {(0x046D, 0xC626), (0x256F, 0xC635), (0x256F, 0xC652)} <= products


def wiggle(when: float) -> tuple[float, ...]:
    return (0.0, 0.0, 0.6 * math.sin(3.0 * when), 0.0, 0.0, 0.2)


@pytest.mark.parametrize("has_long_reports", [False, True])
def test_the_bridge_runs_on_it_without_force(tmp_path: Path, has_long_reports: bool) -> None:
    device, _, seam = opened(SpaceMouse(wiggle, has_long_reports=has_long_reports))
    recording = tmp_path / "run.mcap"
    with hb.Bridge("peg_in_hole", device, clock=DrivingClock(seam), recording=recording) as bridge:
        summary = bridge.run(1.0)
    assert (summary.verdict, summary.is_certified, summary.conditions) == ("passive", None, ())
    report = hb.audit(recording)
    assert (report.verdict, report.certified, report.port) == ("passive", None, "")
    assert np.ptp(hb.read_recording(recording).ticks["device_position"][:, 2]) > 0.001
