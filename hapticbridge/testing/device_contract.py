"""Contract of every device: checks that take a device and raise ``AssertionError``.

With pytest::

    import pytest

    from hapticbridge.device import open_device
    from hapticbridge.testing.device_contract import CONTRACT

    @pytest.mark.parametrize("check", CONTRACT, ids=lambda check: check.__name__)
    def test_my_device_fulfils_the_contract(check):
        check(open_device("mine"))

Each check takes a device of its own, starts it several times and closes it. The checks do not wait:
each ``read`` stands for a time one period after the one before. So put the device's driver on an
emulated unit that moves on by a period in each ``read``.

Warning:
    The checks command random forces of about 5 N and torques of 0.1 N m. Do not run them on a real
    device with motors.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from hapticbridge.device.base import Device, DeviceInfo
from hapticbridge.errors import DeviceError
from hapticbridge.record import SAMPLE_DTYPE

PERIOD, TICKS = 1e-3, 300
"""Period of the loop in s, and number of ticks in each run."""

_WRENCH = np.array([5.0] * 3 + [0.1] * 3)


def _run(device: Device, seed: int) -> NDArray[np.void]:
    """Returns the samples of a run with random wrenches."""
    wrenches = np.random.default_rng(seed).normal(size=(TICKS, 6)) * _WRENCH
    samples = np.zeros(TICKS, SAMPLE_DTYPE)
    device.start(PERIOD)
    for k in range(TICKS):
        device.read(samples[k : k + 1])
        device.write(wrenches[k])
    return samples


def _require(holds: object, claim: str) -> None:
    if not holds:
        raise AssertionError(claim)


def samples_are_finite_poses_with_unit_quaternions(device: Device) -> None:
    """Checks positions and quaternions (qw >= 0), and that the device moves at all."""
    samples = _run(device, 1)
    device.close()
    _require(np.isfinite(samples["position"]).all(), "a position is not finite")
    norms = np.linalg.norm(samples["quaternion"], axis=1)
    worst = float(norms[np.argmax(np.abs(norms - 1.0))])
    _require(abs(worst - 1.0) <= 1e-12, f"a quaternion has the norm {worst:.12g}")
    _require((samples["quaternion"][:, 0] >= 0.0).all(), "a quaternion has qw < 0; negate it")
    moved = np.ptp(samples["position" if device.info.moves else "quaternion"], axis=0).max()
    _require(moved > 0.0, f"the device did not move within {TICKS} ticks")


def a_read_overwrites_the_whole_sample(device: Device) -> None:
    """Checks that ``read`` writes every field, whatever the sample held."""
    clean, dirty = np.zeros(1, SAMPLE_DTYPE), np.full(1, -7, SAMPLE_DTYPE)
    device.start(PERIOD)
    device.read(clean)
    device.start(PERIOD)
    device.read(dirty)
    device.close()
    for name in SAMPLE_DTYPE.names or ():
        _require(
            clean[name].tobytes() == dirty[name].tobytes(), f"read() leaves '{name}' unwritten"
        )


def starting_again_repeats_the_run_to_the_bit(device: Device) -> None:
    """Checks that runs of a device without a real hand (``is_real`` false) are reproducible."""
    if not device.info.is_real:
        first = _run(device, 2)
        _run(device, 3)
        again = _run(device, 2)
        _require(again.tobytes() == first.tobytes(), "a second run differs; start() must reset all")
    device.close()


def force_moves_a_device_unless_its_motion_is_prescribed(device: Device) -> None:
    """Checks ``is_prescribed`` against the device's answer to different wrenches."""
    is_same = _run(device, 4).tobytes() == _run(device, 5).tobytes()
    device.close()
    prescribed, did = device.info.is_prescribed, "did not move" if is_same else "moved"
    _require(is_same == prescribed, f"is_prescribed is {prescribed}, but the wrench {did} it")


def the_data_sheet_survives_json(device: Device) -> None:
    """Checks that recordings can hold the data sheet."""
    text = device.info.to_json()
    _require(DeviceInfo.from_json(text) == device.info, "info is another after to_json, from_json")
    names = {field.name for field in dataclasses.fields(DeviceInfo)}
    _require(set(json.loads(text)) == names, "info has other fields than DeviceInfo")
    device.close()


def closing_twice_is_allowed(device: Device) -> None:
    """Checks that ``close`` may follow ``close``."""
    device.start(PERIOD)
    device.close()
    device.close()


def a_grip_axis_has_a_sample_and_a_wrench_of_its_own(device: Device) -> None:
    """Checks a device whose sheet has a grip axis: two samples and wrenches, or one of each."""
    if device.info.grip_axis is not None:
        _require(device.start(PERIOD).shape == (2,), "start() must return two samples")
        samples = np.full(2, -7, SAMPLE_DTYPE)
        device.read(samples)
        _require(
            np.abs(samples["position"][1, 1:]).max() != 7, "read() leaves 'position' unwritten"
        )
        _require(
            samples["quaternion"][1, 0] == 1.0, "the second sample's quaternion is not (1, 0, 0, 0)"
        )
        device.write(np.zeros((2, 6)))
        device.read(samples[:1])
        device.write(np.zeros(6))
    device.close()


def an_impossible_period_and_a_read_before_the_start_are_refused(device: Device) -> None:
    """Checks that misuse raises ``DeviceError`` with a reason."""
    _require_refusal(lambda: device.read(np.zeros(1, SAMPLE_DTYPE)), "start", "read before start()")
    for period in (0.0, -1e-3, math.nan, math.inf):
        _require_refusal(lambda: device.start(period), "period", f"start({period})")  # noqa: B023
    device.close()


def _require_refusal(call: Callable[[], object], word: str, what: str) -> None:
    try:
        call()
    except DeviceError as error:
        _require(word in str(error), f"{what}: the message '{error}' does not mention '{word}'")
        return
    raise AssertionError(f"{what} must raise DeviceError")


CONTRACT: tuple[Callable[[Device], None], ...] = (
    samples_are_finite_poses_with_unit_quaternions,
    a_read_overwrites_the_whole_sample,
    starting_again_repeats_the_run_to_the_bit,
    force_moves_a_device_unless_its_motion_is_prescribed,
    the_data_sheet_survives_json,
    closing_twice_is_allowed,
    a_grip_axis_has_a_sample_and_a_wrench_of_its_own,
    an_impossible_period_and_a_read_before_the_start_are_refused,
)
"""All checks."""
