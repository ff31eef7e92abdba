"""Home-made devices with the open protocol of ``rawhid.md``: 1 to 6 axes, 64-byte frames."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticbridge.device.data_sheet import AXES, checked_period
from hapticbridge.device.last_word import LastWord
from hapticbridge.device.rawhid.frame import (
    LARGEST,
    LONGEST_WATCHDOG_MS,
    State,
    Status,
    force_frame,
)
from hapticbridge.device.rawhid.sheet import asked, data_sheet, reports
from hapticbridge.device.rawhid.stream import StateStream
from hapticbridge.device.silence import SilenceWatch, watchdog_time
from hapticbridge.device.transport.hid import Link
from hapticbridge.errors import DeviceError, DeviceLost
from hapticbridge.pose import canonical, quaternion_exp
from hapticbridge.tick import SAMPLE_DTYPE, TickFlag

FIRST_STATE_MS = 1000
"""Longest wait in ms for the first state frame."""

NO_WRENCH = (0.0,) * 6


class RawHidDevice:
    """A device that streams its state and applies the newest force frame.

    The device sends state frames at its own rate; ``read`` returns the newest. Lost frames are
    counted only, because the newest remains valid. A frame with a wrong CRC is dropped and counted.
    The run ends on a non-finite number, a reported fault, or a clock that runs backwards. The last
    means a restart, after which the pose may have another origin.

    Args:
        link: Open link for its reports.
        name: Name of the device in messages.
        changes: Numbers of the data sheet that replace those of the device.
        now: Returns the time of a monotonic clock in s.

    Attributes:
        info: Its data sheet.
        last_word: Commands zero force if this process dies; None if no second process can.
        states: Newest state, and numbers of lost and damaged frames.

    Raises:
        DeviceError: The device has another protocol or version, or its data sheet is incomplete or
            out of range.
    """

    def __init__(
        self,
        link: Link,
        name: str,
        changes: Mapping[str, Any] | None = None,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self._link, self._name, self._now = link, name, now
        self._sequence = 0
        self.states = StateStream(name)
        self.info = data_sheet(name, *asked(link, name), dict(changes or {}))
        self._mask = np.array([float(axis in self.info.axes) for axis in AXES])
        self._sample = np.zeros(1, SAMPLE_DTYPE)
        self._watch = SilenceWatch(now())
        self._watchdog_ms = LONGEST_WATCHDOG_MS
        self._is_open, self._has_begun = True, False
        self.last_word: LastWord | None = None

    def start(self, period: float) -> NDArray[np.void]:
        """Waits for a state frame newer than this call.

        Raises:
            DeviceError: The period is not valid, or the device sends nothing, must be homed first,
                or reports a fault.
        """
        period = checked_period(period)
        self._watchdog_ms = min(math.ceil(1e3 * watchdog_time(period)), LONGEST_WATCHDOG_MS)
        self._has_begun = False
        self.states = states = StateStream(self._name)
        self._link.take()
        for report in reports(self._link, FIRST_STATE_MS):
            if states.takes(report):
                break
        if states.newest is None:
            raise DeviceError(
                f"{self._name} sends no state frames within {FIRST_STATE_MS} ms; check its firmware"
            )
        if states.newest.status & Status.NOT_READY:
            raise DeviceError(
                f"{self._name} has no valid pose yet: home or calibrate it as its builder "
                "describes, and start again"
            )
        self._refuse_fault(states.newest)
        self._fill(states.newest)
        self._watch = SilenceWatch(self._now(), period)
        return self._sample.copy()

    def read(self, sample: NDArray[np.void]) -> int:
        """Returns the newest pose without waiting.

        Raises:
            DeviceLost: The device is gone, or silent for longer than ``SILENCE``.
            DeviceError: The device was not started, has restarted, reports a fault, or sent a
                non-finite number.
        """
        states = self.states
        if states.newest is None:
            raise DeviceError(f"{self._name} is read before it was started; call start() first")
        is_new = False
        for report in self._link.take():
            is_new |= states.takes(report)
        if not self._has_begun:  # frames between the start and the loop do not count as lost
            self._has_begun, states.lost = True, 0
        if self._watch.is_silent(self._now(), is_new=is_new):
            silence = 1e3 * self._watch.silence
            raise DeviceLost(f"{self._name} has sent nothing for {silence:.0f} ms; check its cable")
        if not is_new:
            sample[0] = self._sample[0]
            return int(TickFlag.STALE_SAMPLE)
        self._refuse_fault(states.newest)
        self._fill(states.newest)
        sample[0] = self._sample[0]
        return 0

    def write(self, wrench: NDArray[np.float64]) -> None:
        """Commands a finite wrench on the axes that the device has."""
        values = (wrench * self._mask).tolist()
        if not all(abs(value) < LARGEST for value in values):
            raise DeviceError(f"{self._name}: a wrench that is not finite was not sent")
        self._send(force_frame(self._next(), values, self._watchdog_ms))

    def close(self) -> None:
        """Switches the motors off and releases the device."""
        if not self._is_open:
            return
        self._is_open = False
        try:
            self._send(force_frame(self._next(), NO_WRENCH, 1, is_enabled=False))
        except DeviceLost:
            pass  # the device's own watchdog ends the force
        finally:
            self._link.close()
            if self.last_word is not None:
                self.last_word.close()

    @property
    def velocity(self) -> NDArray[np.float64]:
        """Last reported velocity in m/s and angular velocity in rad/s, shape (6,); initially 0."""
        state = self.states.newest
        numbers = (0.0,) * 12 if state is None else state.numbers
        moving: NDArray[np.float64] = np.array(numbers[6:]) * self._mask
        return moving

    @property
    def on_the_way(self) -> int:
        """Number of force frames that the device had not yet applied at its newest state."""
        state = self.states.newest
        return 0 if state is None else (self._sequence - state.echo) & 0xFFFF

    def _refuse_fault(self, state: State) -> None:
        if state.status & (Status.FAULT | Status.NOT_READY):
            what = "a fault of its own" if state.status & Status.FAULT else "that its pose was lost"
            raise DeviceError(
                f"{self._name} reports {what} (status 0x{state.status:02x}) and gives no force; "
                "restart and home it"
            )

    def _fill(self, state: State) -> None:
        """Converts a state into a sample; axes that the device lacks do not move."""
        pose = self._mask * state.numbers[:6]
        sample = self._sample[0]
        sample["position"] = pose[:3]
        x, y, z = pose[3:].tolist()
        sample["quaternion"] = canonical(quaternion_exp((x, y, z)))
        sample["buttons"] = state.buttons

    def _next(self) -> int:
        self._sequence = (self._sequence + 1) & 0xFFFF
        return self._sequence

    def _send(self, frame: bytes) -> None:
        self._link.write(b"\0" + frame)  # hidapi requires a leading 0 for reports without a number
