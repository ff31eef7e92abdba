"""Contract of every device: checks that take a device and raise ``AssertionError``.

With pytest, for a device whose motion is computed::

    import pytest

    from hapticbridge.device import open_device
    from hapticbridge.testing.device_contract import CONTRACT

    @pytest.mark.parametrize("check", CONTRACT, ids=lambda check: check.__name__)
    def test_my_device_fulfils_the_contract(check):
        check(open_device("mine"))

Each check takes a device of its own, starts it several times and closes it. The reads are a period
apart in real time. A driver of hardware needs an emulated unit behind it, and the check needs to
see the unit's motors: ``check(device, force=unit.force)``. Without ``force`` a device that is not
real is read after ``close`` instead.

An emulated unit may have a time of its own that moves on by a period in each ``read``, and in each
call of ``force``. Then ``clock=SimulatedClock()`` leaves out the waiting. A device without motors
needs such a unit, because only there a second run can be equal to the first.

Warning:
    The checks command random forces of about 5 N and torques of 0.1 N m. Do not run them on a real
    device with motors.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import math
from collections.abc import Callable, Iterable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from hapticbridge.clock import Clock, RealClock
from hapticbridge.device.base import AXES, JUMP_MARGIN, Device, DeviceInfo
from hapticbridge.errors import DeviceError
from hapticbridge.kernel.record import SAMPLE_DTYPE, TickFlag
from hapticbridge.kernel.tick_guard import FARTHEST
from hapticbridge.units import format_number

PERIOD, TICKS = 1e-3, 300
"""Period of the loop in s, and number of ticks in each run."""

MAX_CALL, SLOW_SHARE = 0.5 * PERIOD, 0.1
"""Longest time in s of a call in the loop, and share of the calls that may exceed it, because the
machine stalls. A device that waits for its hardware exceeds it in most calls."""

SPEED_TICKS = 20
"""Number of ticks over which a speed is measured, so that a device at 125 Hz has new samples."""

MAX_END = 10
"""Number of ticks after ``close`` in which the force must be zero. They are half of the shortest
watchdog, so that a watchdog does not count as a zero force."""

_WRENCH = np.array([5.0] * 3 + [0.1] * 3)
_FLAGS = (0, int(TickFlag.STALE_SAMPLE))


class Check(Protocol):
    """Check of one clause."""

    __name__: str

    def __call__(
        self,
        device: Device,
        *,
        force: Callable[[], Iterable[float]] | None = None,
        clock: Clock | None = None,
    ) -> None:
        """Checks a device and closes it.

        Args:
            device: The device, not yet started.
            force: Returns what the motors of its emulated unit give now, in N and N m.
            clock: Paces the reads; a ``RealClock`` by default.

        Raises:
            AssertionError: It breaks the clause.
        """


@dataclasses.dataclass(frozen=True, slots=True)
class _Bench:
    """A device and what the checks need beside it, as ``Check`` names them."""

    device: Device
    force: Callable[[], Iterable[float]] | None
    clock: Clock

    @property
    def info(self) -> DeviceInfo:
        return self.device.info

    def start(self) -> NDArray[np.void]:
        sample = self.device.start(PERIOD)
        self.clock.start(round(1e9 * PERIOD))
        return sample

    def read(self, sample: NDArray[np.void]) -> None:
        """Reads at the next tick, and refuses an answer that is no flag."""
        self.clock.wait()
        flags = self.device.read(sample)
        _require(
            isinstance(flags, int | np.integer) and flags in _FLAGS,
            f"read() returned {flags!r}; it must be 0, or TickFlag.STALE_SAMPLE",
        )

    def run(self, seed: int) -> tuple[NDArray[np.void], NDArray[np.float64]]:
        """Returns the samples of a run with random wrenches, and the time in s of each."""
        wrenches = np.random.default_rng(seed).normal(size=(TICKS, 6)) * _WRENCH
        samples, times = np.zeros(TICKS, SAMPLE_DTYPE), np.zeros(TICKS)
        self.start()
        for k in range(TICKS):
            self.read(samples[k : k + 1])
            times[k] = 1e-9 * self.clock.now()
            self.device.write(wrenches[k])
        return samples, times


def _check(body: Callable[[_Bench], None]) -> Check:
    @functools.wraps(body)
    def check(
        device: Device,
        *,
        force: Callable[[], Iterable[float]] | None = None,
        clock: Clock | None = None,
    ) -> None:
        try:
            body(_Bench(device, force, RealClock() if clock is None else clock))
        finally:
            device.close()

    return check


def _require(holds: object, claim: str) -> None:
    if not holds:
        raise AssertionError(claim)


@_check
def no_call_of_the_loop_waits(bench: _Bench) -> None:
    """Checks that ``read`` and ``write`` return at once; on a simulated clock nothing is seen."""
    sample, slow = np.zeros(1, SAMPLE_DTYPE), {"read": 0, "write": 0}
    bench.start()
    for _ in range(TICKS):
        bench.clock.wait()
        times = [bench.clock.now()]
        bench.device.read(sample)
        times.append(bench.clock.now())
        bench.device.write(np.zeros(6))
        times.append(bench.clock.now())
        for name, before, after in zip(slow, times, times[1:], strict=False):
            slow[name] += 1e-9 * (after - before) > MAX_CALL
            _require(
                slow[name] <= SLOW_SHARE * TICKS,
                f"{name}() waits: more than {SLOW_SHARE:.0%} of the calls took over "
                f"{1e3 * MAX_CALL:g} ms; take what has arrived, and return",
            )


@_check
def samples_are_finite_poses_with_unit_quaternions(bench: _Bench) -> None:
    """Checks positions and quaternions (qw >= 0), and that the device moves at all."""
    samples, _ = bench.run(1)
    _require(np.isfinite(samples["position"]).all(), "a position is not finite")
    norms = np.linalg.norm(samples["quaternion"], axis=1)
    worst = float(norms[np.argmax(np.abs(norms - 1.0))])
    _require(abs(worst - 1.0) <= 1e-12, f"a quaternion has the norm {worst:.12g}")
    _require((samples["quaternion"][:, 0] >= 0.0).all(), "a quaternion has qw < 0; negate it")
    moved = np.ptp(samples["position" if bench.info.moves else "quaternion"], axis=0).max()
    _require(moved > 0.0, f"the device did not move within {TICKS} ticks")


@_check
def axes_that_the_device_lacks_stay_zero(bench: _Bench) -> None:
    """Checks the poses against ``axes`` and ``sensed`` of the data sheet."""
    samples, _ = bench.run(6)
    has = {*bench.info.axes, *bench.info.sensed}
    for i, axis in enumerate(AXES[:3]):
        farthest = np.abs(samples["position"][:, i]).max()
        _require(
            axis in has or farthest == 0.0,
            f"{axis} reaches {farthest:g} m, but the data sheet has no axis {axis}",
        )
    if len(has.intersection(AXES[3:])) > 1:
        return  # rotations about two axes make one about the third
    for axis, part in zip(AXES[3:], np.abs(samples["quaternion"][:, 1:]).max(axis=0), strict=True):
        _require(
            axis in has or part <= 1e-12,
            f"the quaternion turns about {axis}, but the data sheet has no axis {axis}",
        )


@_check
def positions_are_in_metres(bench: _Bench) -> None:
    """Checks place and speed against ``reach`` and ``speed_limit``, as the loop's guard does."""
    samples, times = bench.run(7)
    positions, info = samples["position"], bench.info
    farthest, reach = np.linalg.norm(positions, axis=1).max(), info.reach or FARTHEST
    _require(
        farthest <= reach * (1.0 + 1e-9),  # rounding on a stop
        f"a position is {format_number(farthest, 3)} m from the origin, farther than {reach:g} m: "
        "report metres, or state the reach",
    )
    ways = np.linalg.norm(positions[SPEED_TICKS:] - positions[:-SPEED_TICKS], axis=1)
    speed = float((ways / (times[SPEED_TICKS:] - times[:-SPEED_TICKS])).max())
    _require(
        speed <= JUMP_MARGIN * info.speed_limit or info.speed_limit == 0.0,
        f"the device moves at {format_number(speed, 3)} m/s, over {JUMP_MARGIN:g} times its "
        f"speed_limit of {info.speed_limit:g} m/s: report metres, or state its speed",
    )


@_check
def a_read_overwrites_the_whole_sample(bench: _Bench) -> None:
    """Checks that ``read`` writes every field, whatever the sample held."""
    marked = np.full(1, -7, SAMPLE_DTYPE)
    sample = marked.copy()
    bench.start()
    bench.read(sample)
    for name in SAMPLE_DTYPE.names or ():
        _require((sample[name] != marked[name]).all(), f"read() leaves '{name}' unwritten")


@_check
def starting_again_repeats_the_run_to_the_bit(bench: _Bench) -> None:
    """Checks that runs of a device without a real hand (``is_real`` false) are reproducible."""
    if not bench.info.is_real:
        first, _ = bench.run(2)
        bench.run(3)
        again, _ = bench.run(2)
        _require(again.tobytes() == first.tobytes(), "a second run differs; start() must reset all")


@_check
def force_moves_a_device_unless_its_motion_is_prescribed(bench: _Bench) -> None:
    """Checks ``is_prescribed`` against the device's answer to different wrenches."""
    is_same = bench.run(4)[0].tobytes() == bench.run(5)[0].tobytes()
    prescribed, did = bench.info.is_prescribed, "did not move" if is_same else "moved"
    _require(is_same == prescribed, f"is_prescribed is {prescribed}, but the wrench {did} it")


@_check
def the_data_sheet_survives_json(bench: _Bench) -> None:
    """Checks that recordings can hold the data sheet."""
    text = bench.info.to_json()
    _require(DeviceInfo.from_json(text) == bench.info, "info is another after to_json, from_json")
    names = {field.name for field in dataclasses.fields(DeviceInfo)}
    _require(set(json.loads(text)) == names, "info has other fields than DeviceInfo")


@_check
def closing_ends_the_force(bench: _Bench) -> None:
    """Checks that no force outlives ``close``, by the unit's motors or by the motion after it."""
    if bench.info.is_prescribed:
        return
    if bench.force is not None:
        _require_motors_off(bench, bench.force)
        return
    _require(
        not bench.info.is_real,
        "the motors of a real device must be seen: name them as check(device, force=unit.force)",
    )
    free = _end_of_run(bench, np.zeros(6), lambda: None)
    pushed = _end_of_run(bench, _WRENCH, bench.device.close)
    _require(pushed in (b"", free), "close() leaves the force on: write a zero force first")


def _require_motors_off(bench: _Bench, force: Callable[[], Iterable[float]]) -> None:
    sample = np.zeros(1, SAMPLE_DTYPE)
    bench.start()
    for _ in range(TICKS):
        bench.read(sample)
        bench.device.write(_WRENCH)
        if any(force()):
            break
    else:
        raise AssertionError("force= reports no force, although one was written")
    bench.device.close()
    for _ in range(MAX_END):
        bench.clock.wait()
        if not any(force()):
            return
    raise AssertionError("close() leaves the force on: write a zero force first")


def _end_of_run(bench: _Bench, wrench: NDArray[np.float64], close: Callable[[], None]) -> bytes:
    """Returns the motion after a wrench and ``close``; empty if it cannot be read any more."""
    samples = np.zeros(2 * SPEED_TICKS, SAMPLE_DTYPE)
    bench.start()
    for k in range(samples.size):
        try:
            bench.read(samples[k : k + 1])
        except DeviceError:
            return b""
        if k < SPEED_TICKS:
            bench.device.write(np.zeros(6))
        if k + 1 == SPEED_TICKS:
            bench.device.write(wrench)
            close()
    return samples.tobytes()


@_check
def closing_twice_is_allowed(bench: _Bench) -> None:
    """Checks that ``close`` may follow ``close``."""
    bench.start()
    bench.device.close()
    bench.device.close()


@_check
def a_grip_axis_has_a_sample_and_a_wrench_of_its_own(bench: _Bench) -> None:
    """Checks a device whose sheet has a grip axis: two samples and wrenches, or one of each."""
    if bench.info.grip_axis is None:
        return
    _require(bench.start().shape == (2,), "start() must return two samples")
    samples = np.full(2, -7, SAMPLE_DTYPE)
    bench.read(samples)
    _require(np.abs(samples["position"][1, 1:]).max() != 7, "read() leaves 'position' unwritten")
    _require(
        samples["quaternion"][1, 0] == 1.0, "the second sample's quaternion is not (1, 0, 0, 0)"
    )
    bench.device.write(np.zeros((2, 6)))
    bench.read(samples[:1])
    bench.device.write(np.zeros(6))


@_check
def an_impossible_period_and_a_read_before_the_start_are_refused(bench: _Bench) -> None:
    """Checks that misuse raises ``DeviceError`` with a reason."""
    device = bench.device
    _require_refusal(lambda: device.read(np.zeros(1, SAMPLE_DTYPE)), "start", "read before start()")
    for period in (0.0, -1e-3, math.nan, math.inf):
        _require_refusal(lambda: device.start(period), "period", f"start({period})")  # noqa: B023


def _require_refusal(call: Callable[[], object], word: str, what: str) -> None:
    try:
        call()
    except DeviceError as error:
        _require(word in str(error), f"{what}: the message '{error}' does not mention '{word}'")
        return
    raise AssertionError(f"{what} must raise DeviceError")


CONTRACT: tuple[Check, ...] = (
    no_call_of_the_loop_waits,
    samples_are_finite_poses_with_unit_quaternions,
    axes_that_the_device_lacks_stay_zero,
    positions_are_in_metres,
    a_read_overwrites_the_whole_sample,
    starting_again_repeats_the_run_to_the_bit,
    force_moves_a_device_unless_its_motion_is_prescribed,
    the_data_sheet_survives_json,
    closing_ends_the_force,
    closing_twice_is_allowed,
    a_grip_axis_has_a_sample_and_a_wrench_of_its_own,
    an_impossible_period_and_a_read_before_the_start_are_refused,
)
"""All checks."""
