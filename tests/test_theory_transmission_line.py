"""The wave line of the passivity theory, against its own samples and roots."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from hapticbridge.errors import CouplingError
from hapticbridge.theory.bounds import maximum_stiffness
from hapticbridge.theory.transfer import (
    Termination,
    transmission_line_spectrum,
    transmission_line_stiffness,
)

PERIOD = 1e-3


def felt(
    impedance: float, frequency: NDArray[np.float64], end: Termination, trip: int
) -> NDArray[np.complex128]:
    """Returns H of a line on a wall, from running its waves with z^k as the handle's motion."""
    z = np.exp(1j * frequency * PERIOD)
    wave_back = z ** -float(trip)  # a wall sends back all that comes: q_k = p_{k − trip}
    if end == "software":
        v = (1 - 1 / z) / PERIOD
        q = wave_back * impedance * v / (1 - wave_back)  # p = Z v + q
        return np.asarray(impedance * v + 2 * q)
    # the mean velocity of a hold is known at its end, one sample later: that sample is in the trip
    v = (z - 1) / PERIOD
    q = wave_back * impedance * v / (1 - wave_back)
    return np.asarray(2 * q)


@pytest.mark.parametrize("end", ["software", "device"])
@pytest.mark.parametrize("trip", [1, 2, 3, 5])
def test_spectrum_is_that_of_the_waves(end: Termination, trip: int) -> None:
    frequency = np.linspace(7.0, 0.999 * np.pi / PERIOD, 400)
    theta = frequency * PERIOD
    response = felt(1.7, frequency, end, trip)
    expected = PERIOD / 2 * np.real((1 - np.exp(-1j * theta)) * response) / (1 - np.cos(theta))
    spectrum = transmission_line_spectrum(
        1.7, PERIOD, frequency, terminated_by=end, round_trip=trip
    )
    assert spectrum == pytest.approx(expected, rel=1e-6, abs=1e-6)


def test_long_line_in_software_has_a_pole_that_no_damping_pays() -> None:
    theta = 2 * np.pi / 3
    spectrum = transmission_line_spectrum(
        1.0, PERIOD, theta / PERIOD, terminated_by="software", round_trip=3
    )
    assert spectrum == math.inf


@pytest.mark.parametrize("trip", [1, 2])
def test_static_stiffness_is_the_force_of_a_slow_push(trip: int) -> None:
    b = 2.0
    slow = float(np.abs(felt(b, np.array(1e-3), "device", trip)))
    stiffness = transmission_line_stiffness(b, PERIOD, round_trip=trip)
    assert stiffness == pytest.approx(slow, rel=1e-5)


def test_line_buys_no_stiffness() -> None:
    b = 2.0
    spring = maximum_stiffness(b, PERIOD)
    assert transmission_line_stiffness(b, PERIOD) == pytest.approx(spring / 2, rel=1e-12)
    assert transmission_line_stiffness(b, PERIOD, round_trip=1) == pytest.approx(spring, rel=1e-12)


@pytest.mark.parametrize(("b_share", "gains"), [(1.0, False), (0.9, True)])
def test_line_ended_by_the_device_counts_the_hands_work(b_share: float, gains: bool) -> None:
    # any motion of the hand, any tool end that only dissipates: here one that clips what returns
    impedance, generator = 1.5, np.random.default_rng(11)
    for _ in range(20):
        motion: NDArray[np.floating] = generator.normal(scale=1e-3, size=400).cumsum()
        if gains:
            motion = 1e-3 * np.sin(np.pi / 2 * np.arange(400))  # steadily, against a wall
        q, at_tool, work, least = 0.0, 0.0, 0.0, 0.0
        for change in np.diff(motion):
            v = change / PERIOD
            to_tool = impedance * v + q
            work += (2 * q + b_share * impedance * v) * v * PERIOD
            least = min(least, work)
            q, at_tool = at_tool, to_tool if gains else np.clip(to_tool, -0.3, 0.3)
        assert (least < -1e-6) == gains


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({"impedance": 0.0}, "impedance"),
        ({"impedance": math.nan}, "impedance"),
        ({"period": -1.0}, "period"),
        ({"frequency": 4000.0}, "half the sampling rate"),
        ({"round_trip": 0}, "round trip"),
    ],
)
def test_bad_arguments_are_refused_in_a_sentence(arguments: dict[str, float], named: str) -> None:
    valid = {"impedance": 1.0, "period": PERIOD, "frequency": 10.0}
    with pytest.raises(CouplingError, match=named):
        transmission_line_spectrum(**(valid | arguments))  # type: ignore[arg-type]
