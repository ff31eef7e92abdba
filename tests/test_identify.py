"""Identification of devices whose numbers are known, and refusals of runs that tell nothing."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from hapticbridge.clock import SimulatedClock
from hapticbridge.device import Hand, Motion, SimulatedDevice, TrajectoryDevice
from hapticbridge.errors import DeviceError, DeviceLost, IdentificationError
from hapticbridge.identify import AxisFit, Estimate, Identification, fit_axis, identify
from hapticbridge.identify.fit import noise_of
from hapticbridge.identify.identify import duration_at, measured_profile, step_of
from hapticbridge.kernel.record import TickFlag

PERIOD = 1e-3
TURNING = ("rotational_inertia", "rotational_damping")


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


def fitted(device: SimulatedDevice, period: float = PERIOD, seconds: float = 6.0) -> AxisFit:
    found = identify(device, SimulatedClock(), period=period, axes=("x",), duration=seconds)
    return found.fits["x"]


@pytest.mark.parametrize("seed", range(1000, 1010))
def test_random_devices_are_measured_to_a_part_of_what_is_asked(seed: int) -> None:
    true = known(seed)
    result = measured(true, ("y", "rz"), 12.0)
    fit, turn = result.fits["y"], result.fits["rz"]
    for found, inertia, damping in ((fit, "mass", "damping"), (turn, *TURNING)):
        assert found.mass.value == pytest.approx(true[inertia], rel=0.01)
        assert found.damping.value == pytest.approx(true[damping], rel=0.02)
    assert fit.friction.value == pytest.approx(true["friction"], rel=0.03, abs=2e-3)
    assert fit.delay.value == pytest.approx(PERIOD * true["delay"], abs=0.3 * PERIOD)
    assert result.resolution == pytest.approx(true["resolution"], rel=1e-9)


def test_the_stated_interval_holds_the_true_value_nine_times_in_ten() -> None:
    held = {"mass": 0, "damping": 0, "friction": 0, "delay": 0}
    width = []
    for seed in range(40):
        true = known(seed)
        fit = measured(true, ("x",), 5.0).fits["x"]
        for name in held:
            value = PERIOD * true[name] if name == "delay" else true[name]
            estimate = getattr(fit, name)
            held[name] += estimate.least <= value <= estimate.most
        width.append(fit.damping.half_width / true["damping"])
    assert min(held.values()) >= 36, held
    assert np.median(width) < 0.03  # an interval that holds everything says nothing


def test_a_device_of_another_integrator_is_measured_as_well() -> None:
    """SciPy's Runge–Kutta moves the device instead of our own exact recursion."""
    mass, damping, offset, period = 0.3, 1.2, 0.4, 2e-3
    time = period * np.arange(4000)
    force = 1.5 * np.sin(2 * np.pi * 1.3 * time) + 0.8 * np.sin(2 * np.pi * 4.1 * time)
    position = np.zeros(len(time))
    state = np.zeros(2)
    for k in range(len(time) - 1):
        law = lambda _, s, f=force[k]: (s[1], (f - offset - damping * s[1]) / mass)  # noqa: E731
        state = solve_ivp(law, (0.0, period), state, rtol=1e-10, atol=1e-13).y[:, -1]
        position[k + 1] = state[0]
    fit = fit_axis(position, force, period)
    assert fit.mass.value == pytest.approx(mass, rel=1e-3)
    assert fit.damping.value == pytest.approx(damping, rel=2e-3)
    assert fit.offset.value == pytest.approx(offset, rel=2e-3)
    assert fit.friction.value == pytest.approx(0.0, abs=2e-3)


def test_a_long_delay_is_measured_and_one_beyond_the_search_is_refused() -> None:
    def delay_of(ticks: int) -> float:
        device = SimulatedDevice(hand=None, damping=1.5, friction=0.1, delay=ticks)
        return fitted(device).delay.value

    assert delay_of(30) == pytest.approx(0.03, abs=5e-4)
    for ticks in (45, 60):
        with pytest.raises(IdentificationError, match="answers 40 ms late or later"):
            delay_of(ticks)


def test_half_a_period_of_delay_is_found_although_no_tick_is_that_long() -> None:
    fine = SimulatedDevice(hand=None, mass=0.2, damping=1.0, delay=1)
    sample = fine.start(0.5 * PERIOD)
    tones = np.random.default_rng(3).uniform(-1.0, 1.0, 6)
    time = PERIOD * np.arange(8000)
    force = np.sin(2 * np.pi * np.outer(time, np.geomspace(0.8, 11.0, 6)) + tones) @ np.full(6, 0.3)
    position = np.empty(len(time))
    for k, value in enumerate(force):
        for half in range(2):
            fine.read(sample)
            if half == 0:
                position[k] = sample["position"][0, 0]
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
def test_a_weight_or_cable_is_not_taken_for_mass(weight: float, spring: float, mass: float) -> None:
    """A weight was once taken for a saturated motor, and a cable made the mass too small."""
    fit = fitted(Pulled(weight, spring, mass=mass, damping=0.6), seconds=5.0)
    assert fit.mass.least <= mass <= fit.mass.most
    assert fit.mass.half_width < 0.02 * mass
    # a spring that is felt a tick late takes kT/2 of the damping
    assert fit.damping.value == pytest.approx(0.6, abs=2 * spring * PERIOD + 0.005)
    assert fit.spring.value == pytest.approx(spring, rel=0.1, abs=0.1)


@pytest.mark.parametrize("period", [2.5e-4, 1e-3, 2e-3, 4e-3])
@pytest.mark.parametrize("mass", [0.1, 0.3])
def test_no_damping_is_not_taken_for_a_little(mass: float, period: float) -> None:
    device = SimulatedDevice(hand=None, mass=mass, damping=0.0)
    damping = fitted(device, period, 4.0).damping
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
    limits: Any = {"travel": (0.01, 0.2), "duration": 8.0}
    for seed in range(6):
        device = SimulatedDevice(hand=None, **known(seed))  # type: ignore[arg-type]
        result = identify(device, SimulatedClock(), period=PERIOD, axes=("z",), **limits)
        run = result.runs["z"]
        assert np.nanmax(np.abs(run.position)) < 2.5 * 0.01
        assert np.abs(run.force).max() <= 0.5 * device.info.force_limit + 1e-12
        assert (device.stepper[0]["written"][0] == 0.0).all()


def test_the_step_of_a_position_is_exact_and_one_without_steps_has_none() -> None:
    walk = np.cumsum(np.random.default_rng(1).integers(-3, 4, 3000))
    for step in (1e-6, 3.3e-5, 1e-4):
        assert step_of(np.asarray(step * walk + 0.1, np.float64)) == pytest.approx(step, rel=1e-9)
    assert step_of(np.sin(np.linspace(0.0, 30.0, 4000))) == 0.0
    assert step_of(np.array([np.nan, 1.0, 1.0])) == 0.0


@pytest.mark.parametrize(
    ("estimate", "told"),
    [
        (Estimate(4.6e-10, 6e-4), "0 ± 0.0006"),
        (Estimate(-2e-10, 6e-4), "0 ± 0.0006"),
        (Estimate(1.98765, 0.008), "1.988 ± 0.008"),
        (Estimate(0.25, 0.0), "0.25 ± 0"),
        (Estimate(1.5, 0.01, 0.04), "1.5 +0.01 −0.05"),
        # its interval excludes zero, also as it is told
        (Estimate(2.4, 1.6), "2.4 ± 1.6"),
        (Estimate(-2.4, 1.6), "-2.4 ± 1.6"),
        (Estimate(2.4, 0.1, 2.2), "2.4 +0.1 −2"),
        (Estimate(0.9, 1.6), "1 ± 2"),
    ],
)
def test_an_estimate_tells_no_digits_that_mean_nothing(estimate: Estimate, told: str) -> None:
    assert estimate.as_text() == told


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


@pytest.mark.parametrize(
    ("mass", "damping", "friction", "drag"),
    [(0.1, 0.5, 0.0, 0.5), (0.3, 1.5, 0.1, 5.0), (0.8, 2.0, 0.2, 20.0), (0.1, 0.5, 0.0, 20.0)],
)
def test_drag_is_not_damping(mass: float, damping: float, friction: float, drag: float) -> None:
    """Without a column of its own it made b up to six times too large, or was called a hand."""
    device = Dragged(drag, mass=mass, damping=damping, friction=friction, resolution=1e-5)
    fit = fitted(device)
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
    fit = fitted(device)
    assert fit.drag_speed > 0.05
    least = 2.0 - 3.0 * fit.drag_speed
    assert fit.damping.least <= least <= fit.damping.most
    assert fit.damping.value == pytest.approx(least, rel=0.05)
    assert fit.drag.value == pytest.approx(-3.0, rel=0.1)


def test_a_drag_too_small_to_be_seen_lowers_the_lower_end() -> None:
    numbers = {"mass": 0.5, "damping": 1.0, "friction": 0.3, "resolution": 3e-5}
    fit = fitted(Dragged(0.8, **numbers))
    assert not fit.drag.is_seen
    assert fit.damping.value - fit.damping.half_width > 1.0  # the straight line alone is too sure
    assert fit.damping.least <= 1.0 <= fit.damping.most


@pytest.mark.parametrize("noise", [1e-5, 3e-5])
def test_a_position_that_trembles_is_measured_through_it(noise: float) -> None:
    """Steps back were once taken for turns of the motion, and refused without saying so."""
    device = Dragged(noise=noise, mass=0.3, damping=1.5, friction=0.1, resolution=1e-5)
    fit = fitted(device, seconds=10.0)
    assert fit.mass.least <= 0.3 <= fit.mass.most
    assert fit.damping.least <= 1.5 <= fit.damping.most
    assert fit.damping.value == pytest.approx(1.5, rel=0.03)
    assert fit.friction.value == pytest.approx(0.1, rel=0.05)


def test_a_position_that_trembles_more_than_it_moves_is_refused_with_that_reason() -> None:
    device = Dragged(noise=5e-4, mass=0.8, damping=2.0, friction=0.2)
    with pytest.raises(IdentificationError, match=r"axis x: its position has a noise of 0\.0005"):
        fitted(device)


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
def test_loop_slow_moves_device_as_slowly(rate: float, mass: float, friction: float) -> None:
    """At 125 Hz and below the windows were longer than the swings, and all was refused."""
    period = 1.0 / rate
    assert duration_at(period) == pytest.approx(12.0 * period / 3e-3)
    numbers = {"mass": mass, "damping": 1.0, "friction": friction, "resolution": 2e-5}
    device = SimulatedDevice(hand=None, **numbers)  # type: ignore[arg-type]
    fit = fitted(device, period, duration_at(period))
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


def test_an_interval_may_reach_farther_down_and_tells_what_is_seen() -> None:
    assert Estimate(1.5, 0.01, 0.04).least == pytest.approx(1.45)
    assert Estimate(1.5, 0.01, 0.04).most == pytest.approx(1.51)
    assert Estimate(0.02, 0.01).is_seen and Estimate(-0.02, 0.01).is_seen
    assert not Estimate(0.02, 0.03).is_seen and not Estimate(-0.02, 0.03).is_seen


OnRead = Callable[[NDArray[np.void], int], int]
OnWrite = Callable[[NDArray[np.float64]], NDArray[np.float64]]


class Wrapped:
    """A simulated device whose samples or wrenches something changes on the way."""

    def __init__(
        self, device: SimulatedDevice, on_read: OnRead = lambda *_: 0, on_write: OnWrite = np.copy
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


def refused(device: SimulatedDevice | Wrapped, words: str) -> str:
    with pytest.raises(IdentificationError, match=words) as error:
        identify(device, SimulatedClock(), period=PERIOD, axes=("x",), duration=6.0)
    return str(error.value)


def test_a_device_that_falls_silent_is_not_pushed_on() -> None:
    def silent(_: NDArray[np.void], tick: int) -> int:
        return int(TickFlag.STALE_SAMPLE) if tick > 500 else 0

    device = Wrapped(free(), silent)
    refused(device, "no new sample for 51 ms while it pushed along x; check its link")
    assert not device.last.any()


@pytest.mark.parametrize("stiffness", [10.0, 135.0, 800.0])
def test_a_hand_that_holds_still_is_felt_as_a_spring(stiffness: float) -> None:
    held = SimulatedDevice(resolution=1e-5, hand=Hand(stiffness=stiffness), path=STILL)
    told = refused(held, "axis x: a spring of ").split("a spring of ")[1].split()[0]
    assert float(told) == pytest.approx(stiffness, rel=0.02)


@pytest.mark.parametrize(("most", "words"), [(0.5, "did not act: the motor saturates"), (0.3, "")])
def test_a_motor_at_its_end_is_noticed(most: float, words: str) -> None:
    def clipped(wrench: NDArray[np.float64]) -> NDArray[np.float64]:
        size = float(np.linalg.norm(wrench[:3]))
        return wrench * min(1.0, most / size) if size > 0.0 else wrench

    refused(Wrapped(free(), on_write=clipped), words or "its motor may be saturated")
    identify(Wrapped(free(), on_write=lambda w: w), SimulatedClock(), period=PERIOD, axes=("x",))


def test_what_hardly_moves_or_moves_by_itself_is_refused() -> None:
    refused(free(friction=4.9), "it never moved long enough in one direction")
    refused(free(friction=6.0), "position did not change under up to 5 N; move the handle by hand")
    refused(free(resolution=5e-3), "axis x:")
    refused(SimulatedDevice(resolution=1e-5), "were not commanded: let go of it")


@pytest.mark.parametrize("seconds", [0.5, 3.0, 4.0])
def test_a_position_that_stops_changing_is_named_with_its_time(seconds: float) -> None:
    last = np.zeros(3)

    def stuck(sample: NDArray[np.void], tick: int) -> int:
        if tick * PERIOD <= seconds:
            last[:] = sample["position"][0]
        sample["position"][0] = last
        return 0

    told = refused(Wrapped(free(), stuck), "axis x: its position stopped changing after")
    assert float(told.split("changing after ")[1].split()[0]) == pytest.approx(seconds, abs=0.05)


class LateClock(SimulatedClock):
    """Clock whose every hundredth tick is read three periods late."""

    waits = 0

    def wait(self) -> tuple[int, int, int]:
        deadline, wake, skipped = super().wait()
        self.waits += 1
        return deadline, wake + 3 * round(1e9 * PERIOD) * (self.waits % 100 == 0), skipped


def test_a_loop_that_was_late_itself_is_named_beside_the_device() -> None:
    moved_by_hand = SimulatedDevice(resolution=1e-5)
    with pytest.raises(IdentificationError, match="were not commanded") as error:
        identify(moved_by_hand, LateClock(), period=PERIOD, axes=("x",), duration=6.0)
    assert "the loop itself was late: one tick in a thousand took" in str(error.value)
    assert "was late" not in refused(moved_by_hand, "were not commanded")


def jump(sample: NDArray[np.void]) -> None:
    sample["position"][0, 1] += 0.02


def broken(sample: NDArray[np.void]) -> None:
    sample["position"][0, 2] = np.nan


def gone(_: NDArray[np.void]) -> None:
    raise DeviceLost("unplugged")


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (None, "a reversed one runs away"),
        (jump, "jumped by 20 mm"),
        (broken, "not finite or not a rotation"),
        (gone, "unplugged"),
    ],
)
def test_what_goes_wrong_is_said_and_gets_no_more_force(spoil: Any, words: str) -> None:
    if spoil is None:
        device = Wrapped(free(), on_write=lambda wrench: -wrench)
    else:
        device = Wrapped(free(), lambda sample, tick: (tick == 900 and spoil(sample)) or 0)
    with pytest.raises((IdentificationError, DeviceError), match=words):
        identify(device, SimulatedClock(), period=PERIOD, axes=("x",), duration=6.0)
    assert (device.last == 0.0).all()


def test_what_no_force_moves_is_not_identified() -> None:
    with pytest.raises(IdentificationError, match="does not react to force"):
        identify(TrajectoryDevice(STILL), SimulatedClock(), period=PERIOD)
