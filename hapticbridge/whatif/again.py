"""A recorded motion as a device, and recorded times as a clock.

The motion is followed whatever the changed bridge does. That is exact, and no hand: a stiffer wall
is pressed in as far as the softer one was. The data sheet stays that of the recorded device, so
that guard and controller do what they would do with it. Where nothing is changed, and with the
recorded times, such a run is the recorded one in every bit.
"""

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
    """The times of a recording, tick by tick; reading and writing are told by its device.

    Args:
        ticks: The recorded rows, ``TICK_DTYPE``.
        period: The recorded loop's in s.
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
        """Does nothing: the times are known."""

    def wait(self) -> tuple[int, int, int]:
        """Goes on to the next recorded tick; see ``Clock.wait``."""
        self._tick = min(self._tick + 1, len(self._rows) - 1)
        deadline, self._now, skipped, *_ = self._rows[self._tick]
        return deadline, self._now, skipped

    def now(self) -> int:
        """Returns the recorded time of what was done last."""
        return self._now

    def note_read(self) -> None:
        """Takes notice that the device was read."""
        self._now = self._rows[self._tick][3]

    def note_written(self) -> None:
        """Takes notice that the wrench was sent."""
        if self._tick >= 0:
            self._now = self._rows[self._tick][4]


class Outside:
    """Recorded buttons, and which samples were old, at the times of a loop of another rate.

    Args:
        ticks: The recorded rows, ``TICK_DTYPE``.
        period: The recorded loop's in s.
    """

    def __init__(self, ticks: NDArray[np.void], period: float) -> None:
        self._pressed, self._period = ticks["buttons"].copy(), period
        self._stale = ticks["flags"] & _STALE
        self._rows: Iterator[int] = iter(())

    def start(self, period: float) -> None:
        """Begins at the first tick of a loop of this period in s."""
        share, last = period / self._period, len(self._pressed) - 1

        def rows() -> Iterator[int]:
            tick = 0
            while True:
                yield min(int(tick * share + 1e-9), last)  # a period in decimals is rounded
                tick += 1

        self._rows = rows()

    def read(self, sample: NDArray[np.void]) -> int:
        """Puts the buttons of the next tick into a sample; after the last they stay as they are.

        Returns:
            ``STALE_SAMPLE`` where that sample was old, else 0.
        """
        row = next(self._rows)
        sample["buttons"] = self._pressed[row]
        return int(self._stale[row])


class RecordedMotion(ReplayDevice):
    """The recorded samples, one a tick, from where the device was before the first one.

    Args:
        ticks: The recorded rows, ``TICK_DTYPE``, at least two.
        clock: Of the run.
        period: The recorded loop's in s.
        start: Device pose (7,) before the first tick.
        info: The recorded device's.

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
        self.info = _unattended(info, self.info)
        self._clock, self._before = clock, start
        self._news = iter((ticks["flags"] & _STALE).tolist())

    def start(self, period: float) -> NDArray[np.void]:
        """See ``Device.start``."""
        return placed(super().start(period), self._before)

    def read(self, sample: NDArray[np.void]) -> int:
        """See ``Device.read``."""
        super().read(sample)
        self._clock.note_read()
        return next(self._news, 0)

    def write(self, wrench: NDArray[np.float64]) -> None:
        """Ignores the wrench: the motion is prescribed."""
        self._clock.note_written()


class ResampledMotion(TrajectoryDevice):
    """The recorded motion at another rate, linear between the samples and by slerp.

    Args:
        ticks: The recorded rows, ``TICK_DTYPE``, at least two.
        period: The recorded loop's in s.
        start: Device pose (7,) before the first tick.
        info: The recorded device's.
    """

    def __init__(
        self, ticks: NDArray[np.void], period: float, start: tuple[float, ...], info: DeviceInfo
    ) -> None:
        times = period * np.arange(len(ticks))
        super().__init__(Motion(times, ticks["device_position"], ticks["device_quaternion"]))
        self.info = _unattended(info, self.info)
        self._before, self._last = start, b""
        self._outside = Outside(ticks, period)

    def start(self, period: float) -> NDArray[np.void]:
        """See ``Device.start``."""
        self._outside.start(period)
        return placed(super().start(period), self._before)

    def read(self, sample: NDArray[np.void]) -> int:
        """See ``Device.read``."""
        before = self._last
        super().read(sample)
        self._last = sample[["position", "quaternion"]].tobytes()
        flags = self._outside.read(sample)
        return flags if self._last == before else 0  # what has moved is new


def placed(sample: NDArray[np.void], pose: tuple[float, ...]) -> NDArray[np.void]:
    """Returns a sample at a pose (7,), with the buttons of another."""
    there = np.zeros(1, SAMPLE_DTYPE)
    there["buttons"] = sample["buttons"]
    there["position"][0], there["quaternion"][0] = pose[:3], pose[3:]
    return there


def _unattended(info: DeviceInfo, own: DeviceInfo) -> DeviceInfo:
    """Returns the recorded data sheet, for a device that nobody holds and whose motion ends."""
    return replace(info, is_real=False, duration=own.duration)
