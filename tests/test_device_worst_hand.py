"""The simulated device as the worst passive hand, against the theory's own loop."""

from __future__ import annotations

import numpy as np
import pytest

from hapticbridge.coupling import Coupling
from hapticbridge.device import Hand, SimulatedDevice
from hapticbridge.errors import DeviceError
from hapticbridge.record import SAMPLE_DTYPE
from hapticbridge.theory.sampled_loop import SampledLoop, WorstHand

T = 1e-3


def test_device_on_a_wall_is_the_theorys_loop_sample_by_sample() -> None:
    coupling = Coupling(3000, 0.7, 1.0, 0.0)
    loop = SampledLoop(coupling, T)
    hand = WorstHand(1.9, 900.0, T, complex(loop.response(900.0)))
    expected = loop.simulate(hand, 500)
    device, sample = SimulatedDevice(hand=hand), np.zeros(1, SAMPLE_DTYPE)
    device.start(T)
    device.displace(np.array([1e-3, 0, 0, 0, 0, 0]))
    before, wrench = 0.0, np.zeros(6)
    for k in range(500):
        device.read(sample)
        x = sample[0]["position"][0]
        wrench[0] = -(3000 * x + 0.7 / T * (x - before))
        before = x
        device.write(wrench)
        assert x == pytest.approx(expected.handle[k], rel=1e-9, abs=1e-15)
        assert -wrench[0] == pytest.approx(expected.force[k], rel=1e-9, abs=1e-9)


def test_rotation_has_a_line_of_its_own_or_stands_still() -> None:
    translation = WorstHand(2.0, np.pi / T, T)
    rotation = WorstHand(2e-3, np.pi / T, T)
    torque = np.array([0, 0, 0, 0, 0, 0.004])
    turned = []
    for second in (None, rotation):
        device, sample = (
            SimulatedDevice(hand=translation, rotational_hand=second),
            np.zeros(1, SAMPLE_DTYPE),
        )
        device.start(T)
        device.read(sample)
        device.write(torque)
        device.read(sample)
        turned.append(2 * np.arctan2(sample[0]["quaternion"][3], sample[0]["quaternion"][0]))
    # a damper alone turns by τ T/b
    assert turned == pytest.approx([0.0, 0.004 * T / 2e-3], abs=1e-15)


def test_worst_hand_of_another_period_is_refused() -> None:
    with pytest.raises(DeviceError, match=r"tuned to a period of 0\.001 s, the loop's is 0\.002 s"):
        SimulatedDevice(hand=WorstHand(2.0, 100.0, T)).start(2 * T)


def test_worst_hand_takes_no_friction_and_needs_no_mixture() -> None:
    with pytest.raises(DeviceError, match=r"friction = 0\.1 N"):
        SimulatedDevice(hand=WorstHand(2.0, 100.0, T), friction=0.1)
    with pytest.raises(DeviceError, match="rotational_hand"):
        SimulatedDevice(hand=Hand(), rotational_hand=WorstHand(2.0, 100.0, T))


def test_a_device_is_displaced_only_between_start_and_first_sample() -> None:
    device, sample = SimulatedDevice(hand=None), np.zeros(1, SAMPLE_DTYPE)
    knock = np.array([1e-3, 0, 0, 0, 0, 0.1])
    with pytest.raises(DeviceError, match="after its start"):
        device.displace(knock)
    device.start(T)
    device.displace(knock)
    device.read(sample)
    assert sample[0]["position"] == pytest.approx([1e-3, 0, 0], abs=1e-18)
    assert sample[0]["quaternion"] == pytest.approx([np.cos(0.05), 0, 0, np.sin(0.05)], abs=1e-15)
    with pytest.raises(DeviceError, match="before its first sample"):
        device.displace(knock)
