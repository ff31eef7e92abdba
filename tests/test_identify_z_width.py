"""The stiffest wall found by trying, against the one that theory predicts."""

from __future__ import annotations

import numpy as np
import pytest

from hapticbridge.clock import SimulatedClock
from hapticbridge.device import SimulatedDevice
from hapticbridge.identify.z_width import MeasuredLimit, WallBench
from hapticbridge.theory.sampled_loop import WorstHand
from hapticbridge.theory.z_width import free_device_stiffness

PERIOD = 1e-3


def clocked(device: SimulatedDevice) -> SimulatedClock:
    """Starts a device and its time."""
    device.start(PERIOD)
    clock = SimulatedClock()
    clock.start(round(PERIOD * 1e9))
    return clock


def limit_of(device: SimulatedDevice, damping: float, most: float = 1e6) -> MeasuredLimit:
    return WallBench(device, clocked(device), PERIOD, force=5.0).limit(damping, 200.0, most)


@pytest.mark.parametrize("seed", range(6))
def test_a_free_device_bears_what_its_closed_loop_predicts(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mass = float(np.exp(rng.uniform(np.log(0.05), np.log(1.0))))
    damping = float(np.exp(rng.uniform(np.log(0.3), np.log(4.0))))
    delay = int(rng.integers(0, 3))
    coupling = float(rng.uniform(0.0, 0.5)) * damping
    device = SimulatedDevice(mass=mass, damping=damping, hand=None, delay=delay, resolution=1e-7)
    predicted = free_device_stiffness(damping, PERIOD, mass, coupling, delay=delay)
    assert limit_of(device, coupling).stiffness == pytest.approx(float(predicted), rel=0.03)


@pytest.mark.parametrize("coupling", [0.0, 0.5, 1.2])
def test_in_the_worst_hand_it_bears_the_bound_of_colgate_and_schenkel(coupling: float) -> None:
    """At Nyquist the hand is the device's damper alone: K = 2 (b − B)/T."""
    device = SimulatedDevice(damping=2.0, hand=WorstHand(2.0, np.pi / PERIOD, PERIOD))
    bound = 2.0 * (2.0 - coupling) / PERIOD
    assert limit_of(device, coupling).stiffness == pytest.approx(bound, rel=0.05)


def test_a_wall_just_below_the_limit_dies_down_and_one_just_above_grows() -> None:
    device = SimulatedDevice(hand=None)
    found = limit_of(device, 0.5)
    assert found.not_borne is not None and found.not_borne < 1.03 * found.borne
    assert all(trial.is_borne == (trial.growth < 1.0) for trial in found.trials)
    assert min(t.stiffness for t in found.trials if not t.is_borne) == found.not_borne


def test_a_wall_far_too_stiff_stays_within_the_force_and_ends_without() -> None:
    device = SimulatedDevice(hand=None)
    trial = WallBench(device, clocked(device), PERIOD, force=3.0).try_wall(1e5, 0.0)
    assert not trial.is_borne
    assert trial.peak <= 3.0
    assert trial.energy > 0.0  # the wall fed the device, which is what makes it grow
    assert (device.stepper[0]["written"][0] == 0.0).all()


def test_what_bears_nothing_or_everything_says_so() -> None:
    """Without a wall a free device bears B < m/T · (something near 2): far above, nothing."""
    assert limit_of(SimulatedDevice(mass=0.05, damping=0.5, hand=None), 200.0).borne == 0.0
    found = limit_of(SimulatedDevice(hand=None, damping=50.0), 0.0, most=1000.0)
    assert (found.borne, found.not_borne, found.stiffness) == (1000.0, None, 1000.0)
