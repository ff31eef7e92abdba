"""Home-made devices that speak the open protocol of ``rawhid.md``: 1 to 6 axes, 64-byte frames."""

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
    """A device that streams its state and obeys the newest force frame.

    The device sends a state frame at its own rate, without being asked; ``read`` takes the newest
    that has come. Of frames lost on the way the newest one still is right, so they are counted and
    nothing else; a frame with a wrong CRC is dropped and counted; a number that is not finite, a
    fault that the device reports, or a clock that runs backwards (it has restarted, and may count
    its pose from another place) ends the run.

    Args:
        link: Reports to and from the device, open.
        name: What errors call it.
        changes: Numbers of the data sheet that go before what the device says of itself.
        now: Returns the time in s of a clock that only grows.

    Attributes:
        info: Its data sheet.
        last_word: Says zero to it should this process die; None where no other process can.
        states: The newest state, and how many were lost or damaged on the way.

    Raises:
        DeviceError: It does not speak the protocol, another version of it, or its data sheet is
            incomplete or out of range.
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
        """Waits for a state frame that is newer than this call.

        Args:
            period: The loop's period in s, finite and > 0.

        Returns:
            The pose before the first tick, shape (1,), ``SAMPLE_DTYPE``.

        Raises:
            DeviceError: The period is not, the device sends nothing, must be homed first, or
                reports a fault.
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
            raise DeviceError(f"{self._name} sends no state frames")
        if states.newest.status & Status.NOT_READY:
            raise DeviceError(
                f"{self._name} does not know its pose yet: home or calibrate it, as its builder "
                "says, and start again"
            )
        self._refuse_fault(states.newest)
        self._fill(states.newest)
        self._watch = SilenceWatch(self._now(), period)
        return self._sample.copy()

    def read(self, sample: NDArray[np.void]) -> int:
        """Reports the newest pose that has come; waits for none.

        Args:
            sample: Shape (1,), ``SAMPLE_DTYPE``, filled in place.

        Returns:
            0, or ``STALE_SAMPLE`` where no valid frame has come since the last read.

        Raises:
            DeviceLost: The device is gone, or silent for longer than ``SILENCE``.
            DeviceError: It has not been started, has restarted, reports a fault, or a number that
                is not finite.
        """
        states = self.states
        if states.newest is None:
            raise DeviceError(f"{self._name} is read before it was started")
        is_new = False
        for report in self._link.take():
            is_new |= states.takes(report)
        if not self._has_begun:  # between the start and the loop nobody took what was sent
            self._has_begun, states.lost = True, 0
        if self._watch.is_silent(self._now(), is_new=is_new):
            silence = 1e3 * self._watch.silence
            raise DeviceLost(f"{self._name} has sent nothing for {silence:.0f} ms")
        if not is_new:
            sample[0] = self._sample[0]
            return int(TickFlag.STALE_SAMPLE)
        self._refuse_fault(states.newest)
        self._fill(states.newest)
        sample[0] = self._sample[0]
        return 0

    def write(self, wrench: NDArray[np.float64]) -> None:
        """Commands a wrench, on the axes that the device has.

        Args:
            wrench: Shape (6,): force in N, torque in N m, on the device, in the device's frame.

        Raises:
            DeviceLost: The device is gone.
            DeviceError: The wrench is not finite.
        """
        values = (wrench * self._mask).tolist()
        if not all(abs(value) < LARGEST for value in values):
            raise DeviceError(f"{self._name}: a wrench that is not finite was not sent")
        self._send(force_frame(self._next(), values, self._watchdog_ms))

    def close(self) -> None:
        """Switches the motors off and lets the device go."""
        if not self._is_open:
            return
        self._is_open = False
        try:
            self._send(force_frame(self._next(), NO_WRENCH, 1, is_enabled=False))
        except DeviceLost:
            pass  # its own watchdog does it
        finally:
            self._link.close()
            if self.last_word is not None:
                self.last_word.close()

    @property
    def velocity(self) -> NDArray[np.float64]:
        """Velocity in m/s and angular velocity in rad/s as last reported, shape (6,); 0 before."""
        state = self.states.newest
        numbers = (0.0,) * 12 if state is None else state.numbers
        moving: NDArray[np.float64] = np.array(numbers[6:]) * self._mask
        return moving

    @property
    def on_the_way(self) -> int:
        """How many force frames the device had not obeyed yet when it sent its newest state."""
        state = self.states.newest
        return 0 if state is None else (self._sequence - state.echo) & 0xFFFF

    def _refuse_fault(self, state: State) -> None:
        if state.status & (Status.FAULT | Status.NOT_READY):
            what = "a fault of its own" if state.status & Status.FAULT else "that its pose was lost"
            raise DeviceError(
                f"{self._name} reports {what} (status 0x{state.status:02x}) and gives no force"
            )

    def _fill(self, state: State) -> None:
        """Makes a sample of a state; axes that the device lacks stay where they are."""
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
        self._link.write(b"\0" + frame)  # reports without a number: hidapi wants a 0 in front
