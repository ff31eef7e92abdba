"""What ``identify`` says of devices whose numbers are known."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from hapticbridge.clock import SimulatedClock
from hapticbridge.device import SimulatedDevice
from hapticbridge.identify import Estimate, Identification, fit_axis, identify
from hapticbridge.identify.identify import step_of
from hapticbridge.record import TickFlag

PERIOD = 1e-3


def known(seed: int) -> dict[str, float]:
    """Returns the numbers of a random device, from a light stylus to a heavy arm."""
    rng = np.random.default_rng(seed)
    mass, damping, resolution = (
        float(np.exp(rng.uniform(np.log(least), np.log(most))))
        for least, most in ((0.05, 1.0), (0.2, 5.0), (1e-6, 1e-4))
    )
    return {
        "mass": mass,
        "damping": damping,
        "rotational_inertia": 1e-3 * mass,
        "rotational_damping": 1e-3 * damping,
        "friction": float(rng.uniform(0.02, 0.4)) if seed % 2 else 0.0,
        "resolution": resolution,
        "delay": int(rng.integers(0, 4)),
    }


def measured(numbers: dict[str, float], axes: tuple[str, ...], duration: float) -> Identification:
    device = SimulatedDevice(hand=None, **numbers)  # type: ignore[arg-type]
    return identify(device, SimulatedClock(), period=PERIOD, axes=axes, duration=duration)


@pytest.mark.parametrize("seed", range(20))
def test_random_devices_are_measured_to_a_part_of_what_is_asked(seed: int) -> None:
    true = known(1000 + seed)
    result = measured(true, ("y", "rz"), 12.0)
    fit, turn = result.fits["y"], result.fits["rz"]
    assert fit.mass.value == pytest.approx(true["mass"], rel=0.01)
    assert fit.damping.value == pytest.approx(true["damping"], rel=0.02)
    assert fit.friction.value == pytest.approx(true["friction"], rel=0.03, abs=2e-3)
    assert fit.delay.value == pytest.approx(PERIOD * true["delay"], abs=0.3 * PERIOD)
    assert turn.mass.value == pytest.approx(true["rotational_inertia"], rel=0.01)
    assert turn.damping.value == pytest.approx(true["rotational_damping"], rel=0.02)
    assert result.resolution == pytest.approx(true["resolution"], rel=1e-9)


@pytest.mark.parametrize("group", range(4))
def test_the_stated_interval_holds_the_true_value_nine_times_in_ten(group: int) -> None:
    held = {"mass": 0, "damping": 0, "friction": 0, "delay": 0}
    width = []
    for seed in range(50 * group, 50 * group + 50):
        true = known(seed)
        fit = measured(true, ("x",), 5.0).fits["x"]
        for name in held:
            value = PERIOD * true[name] if name == "delay" else true[name]
            estimate = getattr(fit, name)
            held[name] += estimate.least <= value <= estimate.most
        width.append(fit.damping.half_width / true["damping"])
    assert min(held.values()) >= 45, held
    assert np.median(width) < 0.03  # an interval that holds everything says nothing


def test_a_device_of_another_integrator_is_measured_as_well() -> None:
    """SciPy's Runge–Kutta moves the device instead of our own exact recursion."""
    mass, damping, offset, period = 0.3, 1.2, 0.4, 2e-3
    time = period * np.arange(4000)
    force = 1.5 * np.sin(2 * np.pi * 1.3 * time) + 0.8 * np.sin(2 * np.pi * 4.1 * time)
    position = np.zeros(len(time))
    state = np.zeros(2)
    for k in range(len(time) - 1):
        solution = solve_ivp(
            lambda _, s, f=force[k]: (s[1], (f - offset - damping * s[1]) / mass),
            (0.0, period),
            state,
            rtol=1e-10,
            atol=1e-13,
        )
        state = solution.y[:, -1]
        position[k + 1] = state[0]
    fit = fit_axis(position, force, period)
    assert fit.mass.value == pytest.approx(mass, rel=1e-3)
    assert fit.damping.value == pytest.approx(damping, rel=2e-3)
    assert fit.offset.value == pytest.approx(offset, rel=2e-3)
    assert fit.friction.value == pytest.approx(0.0, abs=2e-3)


def test_half_a_period_of_delay_is_found_although_no_tick_is_that_long() -> None:
    fine = SimulatedDevice(hand=None, mass=0.2, damping=1.0, delay=1)
    fine.start(0.5 * PERIOD)
    rng = np.random.default_rng(3)
    tones = rng.uniform(-1.0, 1.0, 6)
    frequencies = np.geomspace(0.8, 11.0, 6)
    time = PERIOD * np.arange(8000)
    force = np.sin(2 * np.pi * np.outer(time, frequencies) + tones) @ np.full(6, 0.3)
    position = np.empty(len(time))
    sample = np.zeros(1, fine.start(0.5 * PERIOD).dtype)
    for k, value in enumerate(force):
        fine.read(sample)
        position[k] = sample["position"][0, 0]
        fine.write(np.array([value, 0, 0, 0, 0, 0]))
        fine.read(sample)
        fine.write(np.array([value, 0, 0, 0, 0, 0]))
    fit = fit_axis(position, force, PERIOD)
    assert fit.delay.value == pytest.approx(0.5 * PERIOD, abs=0.03 * PERIOD)


class Pulled(SimulatedDevice):
    """Something else than the motor pulls at x: a weight of 1 N, or a cable of k N/m."""

    def __init__(self, weight: float, spring: float, **numbers: float) -> None:
        super().__init__(hand=None, **numbers)  # type: ignore[arg-type]
        self.weight, self.spring, self.x = weight, spring, 0.0

    def read(self, sample: NDArray[np.void]) -> int:
        flag = super().read(sample)
        self.x = float(sample["position"][0, 0])
        return flag

    def write(self, wrench: NDArray[np.float64]) -> None:
        pulled = wrench.copy()
        pulled[0] += self.weight - self.spring * self.x
        super().write(pulled)


@pytest.mark.parametrize(("weight", "spring"), [(1.0, 0.0), (-1.0, 0.0), (0.0, 0.9)])
@pytest.mark.parametrize("mass", [0.06, 0.25])
def test_a_weight_or_a_weak_cable_is_neither_refused_nor_taken_for_mass(
    weight: float, spring: float, mass: float
) -> None:
    """A weight was once taken for a saturated motor, and a cable made the mass too small."""
    device = Pulled(weight, spring, mass=mass, damping=0.6)
    result = identify(device, SimulatedClock(), period=PERIOD, axes=("x",), duration=5.0)
    fit = result.fits["x"]
    assert fit.mass.least <= mass <= fit.mass.most
    assert fit.mass.half_width < 0.02 * mass
    # a spring that is felt a tick late takes kT/2 of the damping
    assert fit.damping.value == pytest.approx(0.6, abs=2 * spring * PERIOD + 0.005)
    assert fit.spring.value == pytest.approx(spring, rel=0.1, abs=0.1)


@pytest.mark.parametrize("period", [2.5e-4, 1e-3, 2e-3, 4e-3])
@pytest.mark.parametrize("mass", [0.1, 0.3])
def test_no_damping_is_not_taken_for_a_little(mass: float, period: float) -> None:
    device = SimulatedDevice(hand=None, mass=mass, damping=0.0)
    result = identify(device, SimulatedClock(), period=period, axes=("x",), duration=4.0)
    damping = result.fits["x"].damping
    assert damping.least <= 0.0 <= damping.most
    assert damping.half_width < 0.02


def test_samples_that_do_not_come_are_left_out_and_not_taken_for_rest() -> None:
    true = known(3) | {"delay": 0}

    class Slow(SimulatedDevice):
        ticks = 0

        def read(self, sample: NDArray[np.void]) -> int:
            before = sample.copy()
            super().read(sample)
            self.ticks += 1
            if self.ticks % 97:
                return 0
            sample[:] = before
            return int(TickFlag.STALE_SAMPLE)

    device = Slow(hand=None, **true)  # type: ignore[arg-type]
    result = identify(device, SimulatedClock(), period=PERIOD, axes=("x",))
    assert result.runs["x"].stale == pytest.approx(1 / 97, rel=0.02)
    fit = result.fits["x"]
    # only windows that fit between two gaps are left, of less than a tenth of a second
    assert fit.mass.value == pytest.approx(true["mass"], rel=0.02)
    assert fit.damping.value == pytest.approx(true["damping"], rel=0.04)
    assert fit.damping.least <= true["damping"] <= fit.damping.most


def test_the_run_stays_within_its_travel_and_force_and_ends_without_force() -> None:
    for seed in range(6):
        device = SimulatedDevice(hand=None, **known(seed))  # type: ignore[arg-type]
        result = identify(
            device, SimulatedClock(), period=PERIOD, axes=("z",), travel=(0.01, 0.2), duration=8.0
        )
        run = result.runs["z"]
        assert np.nanmax(np.abs(run.position)) < 2.5 * 0.01
        assert np.abs(run.force).max() <= 0.5 * device.info.force_limit + 1e-12
        assert (device.stepper[0]["written"][0] == 0.0).all()


@pytest.mark.parametrize("step", [1e-6, 3.3e-5, 1e-4])
def test_the_step_of_a_position_is_exact(step: float) -> None:
    rng = np.random.default_rng(1)
    walk = np.cumsum(rng.integers(-3, 4, 3000))
    assert step_of(np.asarray(step * walk + 0.1, np.float64)) == pytest.approx(step, rel=1e-9)


def test_a_position_without_steps_has_none() -> None:
    assert step_of(np.sin(np.linspace(0.0, 30.0, 4000))) == 0.0
    assert step_of(np.array([np.nan, 1.0, 1.0])) == 0.0


@pytest.mark.parametrize(
    ("estimate", "told"),
    [
        (Estimate(4.6e-10, 6e-4), "0 ± 0.0006"),
        (Estimate(-2e-10, 6e-4), "0 ± 0.0006"),
        (Estimate(1.98765, 0.008), "1.988 ± 0.008"),
        (Estimate(0.25, 0.0), "0.25 ± 0"),
    ],
)
def test_an_estimate_tells_no_digits_that_mean_nothing(estimate: Estimate, told: str) -> None:
    assert estimate.told() == told
