"""Runs that tell nothing are refused with the reason; what misbehaves gets no more force."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from hapticbridge.clock import SimulatedClock
from hapticbridge.device import Hand, Motion, SimulatedDevice
from hapticbridge.errors import DeviceError, DeviceLost, IdentificationError
from hapticbridge.identify import identify

PERIOD = 1e-3
STILL = Motion([0.0, 100.0], np.zeros((2, 3)))


class Wrapped:
    """A simulated device whose samples or wrenches something changes on the way."""

    def __init__(
        self,
        device: SimulatedDevice,
        on_read: Callable[[NDArray[np.void], int], int] = lambda _sample, _tick: 0,
        on_write: Callable[[NDArray[np.float64]], NDArray[np.float64]] = lambda wrench: wrench,
    ) -> None:
        self.info, self._device = device.info, device
        self._on_read, self._on_write, self._tick = on_read, on_write, 0
        self.last = np.ones(6)

    def start(self, period: float) -> NDArray[np.void]:
        return self._device.start(period)

    def read(self, sample: NDArray[np.void]) -> int:
        self._device.read(sample)
        self._tick += 1
        return self._on_read(sample, self._tick)

    def write(self, wrench: NDArray[np.float64]) -> None:
        self.last = wrench.copy()
        self._device.write(self._on_write(wrench))

    def close(self) -> None:
        self._device.close()


def free(**changes: Any) -> SimulatedDevice:
    return SimulatedDevice(hand=None, **{"mass": 0.3, "damping": 3.0, "resolution": 1e-5} | changes)


def refused(device: SimulatedDevice | Wrapped, words: str, **options: Any) -> None:
    with pytest.raises(IdentificationError) as error:
        identify(device, SimulatedClock(), period=PERIOD, axes=("x",), duration=6.0, **options)
    assert words in str(error.value), str(error.value)


@pytest.mark.parametrize("stiffness", [10.0, 135.0, 800.0])
def test_a_hand_that_holds_still_is_felt_as_a_spring(stiffness: float) -> None:
    held = SimulatedDevice(resolution=1e-5, hand=Hand(stiffness=stiffness), path=STILL)
    with pytest.raises(IdentificationError, match="axis x: a spring of ") as error:
        identify(held, SimulatedClock(), period=PERIOD, axes=("x",), duration=6.0)
    told = float(str(error.value).split("a spring of ")[1].split()[0])
    assert told == pytest.approx(stiffness, rel=0.02)


def test_a_hand_that_moves_is_told_from_a_device() -> None:
    refused(SimulatedDevice(resolution=1e-5), "were not commanded: let go of it")


@pytest.mark.parametrize(("most", "words"), [(0.5, "did not act: the motor saturates"), (0.3, "")])
def test_a_motor_at_its_end_is_noticed(most: float, words: str) -> None:
    def clipped(wrench: NDArray[np.float64]) -> NDArray[np.float64]:
        size = float(np.linalg.norm(wrench[:3]))
        return wrench * min(1.0, most / size) if size > 0.0 else wrench

    refused(Wrapped(free(), on_write=clipped), words or "its motor may be saturated")
    identify(Wrapped(free(), on_write=lambda w: w), SimulatedClock(), period=PERIOD, axes=("x",))


def test_friction_that_the_force_cannot_break_is_too_little_motion() -> None:
    refused(free(friction=6.0), "it never moved long enough in one direction")


def test_steps_as_large_as_the_travel_are_too_little_motion() -> None:
    refused(free(resolution=5e-3), "axis x:")


def test_a_device_that_runs_away_gets_no_more_force() -> None:
    device = Wrapped(free(), on_write=lambda wrench: -wrench)
    refused(device, "let go of it, support its weight, or allow more travel")
    assert (device.last == 0.0).all()


def test_a_jump_and_a_pose_that_is_none_get_no_more_force() -> None:
    def jump(sample: NDArray[np.void], tick: int) -> int:
        sample["position"][0, 1] += 0.02 if tick == 900 else 0.0
        return 0

    def broken(sample: NDArray[np.void], tick: int) -> int:
        if tick == 900:
            sample["position"][0, 2] = np.nan
        return 0

    for spoil, words in ((jump, "jumped by 20 mm"), (broken, "not finite or not a rotation")):
        device = Wrapped(free(), on_read=spoil)
        refused(device, words)
        assert (device.last == 0.0).all()


def test_a_device_that_is_unplugged_says_so() -> None:
    def gone(_: NDArray[np.void], tick: int) -> int:
        if tick == 500:
            raise DeviceLost("unplugged")
        return 0

    device = Wrapped(free(), on_read=gone)
    with pytest.raises(DeviceError, match="unplugged"):
        identify(device, SimulatedClock(), period=PERIOD, axes=("x",))
    assert (device.last == 0.0).all()


def test_what_no_force_moves_is_not_identified() -> None:
    from hapticbridge.device import TrajectoryDevice

    with pytest.raises(IdentificationError, match="does not react to force"):
        identify(TrajectoryDevice(STILL), SimulatedClock(), period=PERIOD)
