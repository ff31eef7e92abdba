"""Recorded motion as a device, and recorded times as a clock."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hapticbridge.clock import SimulatedClock
from hapticbridge.device import DeviceInfo, Motion
from hapticbridge.device.trajectory.driver import ReplayDevice, TrajectoryDevice
from hapticbridge.tick import SAMPLE_DTYPE, TickFlag

_STALE = int(TickFlag.STALE_SAMPLE)


class RecordedClock:
    """Clock that replays the times of a recording.

    Its device reports reading and writing.
    """

    name = SimulatedClock.name
    is_lossless = True

    def __init__(self, ticks: NDArray[np.void], period: float) -> None:
        deadline = ticks["deadline_ns"]
        late = (ticks["flags"] & int(TickFlag.OVERRUN)) != 0
        between = np.diff(deadline, prepend=0) // round(1e9 * period) - 1
        skipped = np.where(late, np.maximum(between, 1), 0)
        columns = deadline, ticks["wake_ns"], skipped, ticks["read_ns"], ticks["write_ns"]
        self._rows = list(zip(*(column.tolist() for column in columns), strict=True))
        self._tick, self._now = -1, 0

    def start(self, period_ns: int) -> None:
        """Does nothing; the times are recorded."""

    def wait(self) -> tuple[int, int, int]:
        """Advances to the next recorded tick; see ``Clock.wait``."""
        self._tick = min(self._tick + 1, len(self._rows) - 1)
        deadline, self._now, skipped, *_ = self._rows[self._tick]
        return deadline, self._now, skipped

    def now(self) -> int:
        """Returns the recorded time of the latest action."""
        return self._now

    def note_read(self) -> None:
        """Notes that the device was read."""
        self._now = self._rows[self._tick][3]

    def note_written(self) -> None:
        """Notes that the wrench was sent."""
        if self._tick >= 0:
            self._now = self._rows[self._tick][4]


class Outside:
    """Recorded buttons and stale samples, resampled to another rate.

    ``period`` is the recorded period in s.
    """

    def __init__(self, ticks: NDArray[np.void], period: float) -> None:
        self._pressed, self._period = ticks["buttons"].copy(), period
        self._stale = ticks["flags"] & _STALE
        self._rows: Iterator[int] = iter(())

    def start(self, period: float) -> None:
        """Starts at the first tick of a loop with this period in s."""
        share, last = period / self._period, len(self._pressed) - 1

        def rows() -> Iterator[int]:
            tick = 0
            while True:
                yield min(int(tick * share + 1e-9), last)  # a period in decimals is rounded
                tick += 1

        self._rows = rows()

    def read(self, sample: NDArray[np.void]) -> int:
        """Puts the next tick's buttons into a sample; after the last tick they stay.

        Returns:
            ``STALE_SAMPLE`` for a stale sample, else 0.
        """
        row = next(self._rows)
        sample["buttons"] = self._pressed[row]
        return int(self._stale[row])


class RecordedMotion(ReplayDevice):
    """Device that replays the recorded samples, one per tick.

    The motion is prescribed at any force, which is exact but no hand: it presses as deep into a
    stiffer wall as into the recorded one. The data sheet is the recorded device's, so that guard
    and controller act as with it. With recorded times and unchanged settings, the run equals the
    recorded one in every bit. At least two rows are needed; ``start`` is the device pose (7,)
    before them.

    Raises:
        DeviceError: See ``ReplayDevice``.
    """

    def __init__(
        self,
        ticks: NDArray[np.void],
        clock: RecordedClock,
        period: float,
        start: tuple[float, ...],
        info: DeviceInfo,
    ) -> None:
        super().__init__(ticks, period)
        self.info = _replay_info(info, self.info)
        self._clock, self._before = clock, start
        self._news = iter((ticks["flags"] & _STALE).tolist())

    def start(self, period: float) -> NDArray[np.void]:
        """Implements ``Device.start``."""
        return placed(super().start(period), self._before)

    def read(self, sample: NDArray[np.void]) -> int:
        """Implements ``Device.read``."""
        super().read(sample)
        self._clock.note_read()
        return next(self._news, 0)

    def write(self, wrench: NDArray[np.float64]) -> None:
        """Ignores the wrench; the motion is prescribed."""
        self._clock.note_written()


class ResampledMotion(TrajectoryDevice):
    """Device that replays the recorded motion at another rate.

    Positions are interpolated linearly, orientations by slerp. At least two rows are needed;
    ``start`` is the device pose (7,) before them, ``period`` the recorded period in s.
    """

    def __init__(
        self, ticks: NDArray[np.void], period: float, start: tuple[float, ...], info: DeviceInfo
    ) -> None:
        times = period * np.arange(len(ticks))
        super().__init__(Motion(times, ticks["device_position"], ticks["device_quaternion"]))
        self.info = _replay_info(info, self.info)
        self._before, self._last = start, b""
        self._outside = Outside(ticks, period)

    def start(self, period: float) -> NDArray[np.void]:
        """Implements ``Device.start``."""
        self._outside.start(period)
        return placed(super().start(period), self._before)

    def read(self, sample: NDArray[np.void]) -> int:
        """Implements ``Device.read``."""
        before = self._last
        super().read(sample)
        self._last = sample[["position", "quaternion"]].tobytes()
        flags = self._outside.read(sample)
        return flags if self._last == before else 0  # a changed pose is a new sample


def placed(sample: NDArray[np.void], pose: tuple[float, ...]) -> NDArray[np.void]:
    """Returns a sample at a pose (7,), with the buttons of another sample."""
    there = np.zeros(1, SAMPLE_DTYPE)
    there["buttons"] = sample["buttons"]
    there["position"][0], there["quaternion"][0] = pose[:3], pose[3:]
    return there


def _replay_info(info: DeviceInfo, own: DeviceInfo) -> DeviceInfo:
    """Returns the recorded data sheet without motors, with the duration of the replay."""
    return replace(info, is_real=False, duration=own.duration)
