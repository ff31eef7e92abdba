"""Resistance that is not proportional to speed, and what identify makes of its lower end."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from hapticbridge.clock import SimulatedClock
from hapticbridge.device import Hand, Motion, SimulatedDevice
from hapticbridge.errors import IdentificationError
from hapticbridge.identify import AxisFit, Estimate, identify
from hapticbridge.identify.fit import noise_of
from hapticbridge.identify.identify import duration_at
from hapticbridge.identify.profile import measured_profile

PERIOD = 1e-3
STILL = Motion([0.0, 100.0], np.zeros((2, 3)))


class Dragged(SimulatedDevice):
    """M x'' = F − b x' − b_2 x' |x'| − f_c sign(x'), by the midpoint rule in an eighth of a tick.

    The simulated device's own exact recursion knows no b_2, so it is not used.
    """

    def __init__(self, drag: float = 0.0, noise: float = 0.0, **numbers: float) -> None:
        super().__init__(hand=None, **numbers)  # type: ignore[arg-type]
        self.law = (numbers["mass"], numbers["damping"], drag, numbers.get("friction", 0.0))
        self.step, self.noise = numbers.get("resolution", 0.0), noise
        self.x = self.v = self.force = 0.0
        self.random = np.random.default_rng(1)
        self.has_begun = False

    def start(self, period: float, parts: int = 1) -> NDArray[np.void]:
        self.period = period
        return super().start(period, parts)

    def read(self, sample: NDArray[np.void]) -> int:
        if self.has_begun:
            for _ in range(8):
                self.move(self.period / 8)
        self.has_begun = True
        x = self.x + self.noise * self.random.standard_normal()
        sample["position"][0, 0] = self.step * round(x / self.step) if self.step else x
        sample["quaternion"][0] = (1.0, 0.0, 0.0, 0.0)
        return 0

    def move(self, h: float) -> None:
        mass, damping, drag, friction = self.law
        x, v, force = self.x, self.v, self.force
        if v == 0.0 and abs(force) <= friction:
            return
        sign = math.copysign(1.0, v if v != 0.0 else force)

        def acceleration(u: float) -> float:
            return (force - damping * u - drag * u * abs(u) - friction * sign) / mass

        after = v + h * acceleration(v + 0.5 * h * acceleration(v))
        stops = v != 0.0 and after * v < 0.0
        share = abs(v) / (abs(v) + abs(after)) if stops else 1.0
        after = 0.0 if stops else after
        self.x, self.v = x + 0.5 * share * h * (v + after), after

    def write(self, wrench: NDArray[np.float64]) -> None:
        self.force = float(wrench[0])


def measured(device: SimulatedDevice, period: float = PERIOD, seconds: float = 6.0) -> AxisFit:
    found = identify(device, SimulatedClock(), period=period, axes=("x",), duration=seconds)
    return found.fits["x"]


@pytest.mark.parametrize(
    ("mass", "damping", "friction", "drag"),
    [(0.1, 0.5, 0.0, 0.5), (0.3, 1.5, 0.1, 5.0), (0.8, 2.0, 0.2, 20.0), (0.1, 0.5, 0.0, 20.0)],
)
def test_drag_does_not_make_the_damping_of_small_speeds_too_large(
    mass: float, damping: float, friction: float, drag: float
) -> None:
    """Without a column of its own it made b up to six times too large, or was called a hand."""
    device = Dragged(drag, mass=mass, damping=damping, friction=friction, resolution=1e-5)
    fit = measured(device)
    assert fit.damping.least <= damping <= fit.damping.most
    assert fit.damping.value == pytest.approx(damping, rel=0.03)
    assert fit.drag.value == pytest.approx(drag, rel=0.05, abs=0.05)
    assert fit.mass.value == pytest.approx(mass, rel=0.01)
    assert fit.friction.value == pytest.approx(friction, abs=0.005)
    assert fit.drag_speed == 0.0
    speed = np.array([-0.1, 0.02, 0.1])
    law = damping * speed + drag * speed * np.abs(speed) + friction * np.sign(speed)
    assert fit.resistance(speed) == pytest.approx(law, rel=0.03, abs=0.003)


def test_where_resistance_falls_with_speed_the_least_damping_that_was_seen_is_told() -> None:
    device = Dragged(-3.0, mass=0.3, damping=2.0, friction=0.1, resolution=1e-5)
    fit = measured(device)
    assert fit.drag_speed > 0.05
    least = 2.0 - 3.0 * fit.drag_speed
    assert fit.damping.least <= least <= fit.damping.most
    assert fit.damping.value == pytest.approx(least, rel=0.05)
    assert fit.drag.value == pytest.approx(-3.0, rel=0.1)


def test_a_drag_too_small_to_be_seen_lowers_the_lower_end() -> None:
    numbers = {"mass": 0.5, "damping": 1.0, "friction": 0.3, "resolution": 3e-5}
    fit = measured(Dragged(0.8, **numbers))
    assert not fit.drag.is_seen
    assert fit.damping.value - fit.damping.half_width > 1.0  # the straight line alone is too sure
    assert fit.damping.least <= 1.0 <= fit.damping.most


@pytest.mark.parametrize("noise", [1e-5, 3e-5])
def test_a_position_that_trembles_is_measured_through_it(noise: float) -> None:
    """Steps back were once taken for turns of the motion, and refused without saying so."""
    device = Dragged(noise=noise, mass=0.3, damping=1.5, friction=0.1, resolution=1e-5)
    fit = measured(device, seconds=10.0)
    assert fit.mass.least <= 0.3 <= fit.mass.most
    assert fit.damping.least <= 1.5 <= fit.damping.most
    assert fit.damping.value == pytest.approx(1.5, rel=0.03)
    assert fit.friction.value == pytest.approx(0.1, rel=0.05)


def test_a_position_that_trembles_more_than_it_moves_is_refused_with_that_reason() -> None:
    device = Dragged(noise=5e-4, mass=0.8, damping=2.0, friction=0.2)
    with pytest.raises(IdentificationError, match=r"axis x: its position has a noise of 0\.0005"):
        measured(device)


def test_noise_is_told_from_motion_and_from_rounding() -> None:
    rng = np.random.default_rng(3)
    motion = 5e-3 * np.sin(2.0 * np.pi * 12.0 * PERIOD * np.arange(5000))
    trembling = motion + 2e-5 * rng.standard_normal(len(motion))
    assert noise_of(trembling, 0.0) == pytest.approx(2e-5, rel=0.05)
    trembling[::97] = np.nan
    assert noise_of(trembling, 0.0) == pytest.approx(2e-5, rel=0.05)
    assert noise_of(motion, 0.0) == 0.0
    assert noise_of(1e-5 * np.rint(motion / 1e-5), 1e-5) == 0.0
    assert noise_of(np.full(5, np.nan), 0.0) == 0.0


@pytest.mark.parametrize(("rate", "mass", "friction"), [(100, 0.1, 0.0), (62.5, 0.5, 0.2)])
def test_a_loop_that_is_slow_moves_the_device_as_slowly(
    rate: float, mass: float, friction: float
) -> None:
    """At 125 Hz and below the windows were longer than the swings, and all was refused."""
    period = 1.0 / rate
    assert duration_at(period) == pytest.approx(12.0 * period / 3e-3)
    numbers = {"mass": mass, "damping": 1.0, "friction": friction, "resolution": 2e-5}
    device = SimulatedDevice(hand=None, **numbers)  # type: ignore[arg-type]
    fit = measured(device, period, duration_at(period))
    assert fit.mass.least <= mass <= fit.mass.most
    assert fit.damping.least <= 1.0 <= fit.damping.most
    assert fit.mass.value == pytest.approx(mass, rel=0.02)
    assert fit.damping.value == pytest.approx(1.0, rel=0.05)


def test_a_hand_that_only_damps_is_told_to_be_beyond_what_can_be_seen() -> None:
    hand = Hand(mass=0.0, damping=1.0, stiffness=0.0)
    held = SimulatedDevice(mass=0.3, damping=1.5, resolution=1e-5, hand=hand, path=STILL)
    found = identify(held, SimulatedClock(), period=PERIOD, axes=("x",), duration=6.0)
    assert found.fits["x"].damping.value == pytest.approx(2.5, rel=0.02)  # nothing gives it away
    profile = measured_profile(found, device="d", serial="", date="2026-01-01", duration=6.0)
    for quantity in ("damping", "mass"):
        source = profile.quantities[quantity].source
        assert "a hand that only damps cannot be distinguished from it" in source


def test_an_interval_that_reaches_farther_down_says_so() -> None:
    assert Estimate(1.5, 0.01, 0.04).told() == "1.5 +0.01 −0.05"
    assert Estimate(1.5, 0.01, 0.04).least == pytest.approx(1.45)
    assert Estimate(1.5, 0.01, 0.04).most == pytest.approx(1.51)
    assert Estimate(0.02, 0.01).is_seen and Estimate(-0.02, 0.01).is_seen
    assert not Estimate(0.02, 0.03).is_seen and not Estimate(-0.02, 0.03).is_seen
