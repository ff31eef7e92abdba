"""Constant-force effects of a stick."""

from __future__ import annotations

from collections.abc import Sequence

from hapticbridge.device.pid.reports import (
    DISABLE,
    ENABLE,
    FULL,
    LOADED,
    RESET,
    START,
    STOP,
    STOP_ALL,
    PidReports,
)
from hapticbridge.device.transport.hid import HidLink
from hapticbridge.errors import DeviceError

ANGLES = (270.0, 180.0)
"""Origins of the forces of the x and y effect in degrees clockwise from north, as the standard
defines it. A positive force pushes to the right and away from the user. Not verified on
hardware."""

LOADS, LOAD_MS = 60, 1
"""Number of queries for the result of a created effect (as in Linux), and the pause between them in
ms."""

RESTART, LIFE = 0.02, 5
"""Time in s between restarts of an effect, and its duration in restarts. If the host dies, the
force ends within 0.1 s. Four restarts in a row may be lost without a gap in the force."""

RESTART_REPORTS = 5
"""Smallest number of reports per effect between restarts on a slow bus, so that restarts take at
most a fifth of it."""

SLOWEST_INTERVAL = 8e-3
"""Assumed time per report in s if it is unknown: old sticks accept 125 reports a second."""


class Effects:
    """One constant-force effect per axis, with streamed force and limited duration.

    Args:
        link: Open link to the device.
        name: Name of the device in messages.
        reports: Its reports.
        interval: Time in s per report to the device, None if unknown.

    Raises:
        DeviceError: The device has no room for two effects, or refuses them.
        DeviceLost: The device is gone.
    """

    def __init__(
        self, link: HidLink, name: str, reports: PidReports, interval: float | None
    ) -> None:
        self._link, self._name, self._reports = link, name, reports
        count = len(ANGLES)
        slowest = RESTART_REPORTS * count * (interval or SLOWEST_INTERVAL)
        self._restart = max(RESTART, slowest)
        self.life = min(LIFE * self._restart, reports.longest())
        self._restart = min(self._restart, self.life / LIFE)
        self._require_room(count)
        for usage in (RESET, STOP_ALL, ENABLE):
            self._send(reports.control(usage))
        self._send(reports.full_gain())
        self._indices = [self._created() for _ in ANGLES]
        self._magnitudes = [reports.magnitude(index) for index in self._indices]
        self._starts = [reports.operate(index, START) for index in self._indices]
        self._sent: list[int | None] = [None] * count
        self._ticks = self._every = 0

    def start(self, period: float) -> None:
        """Sets direction and duration of the effects and starts them without force."""
        self._every, self._ticks = max(int(self._restart / period), 1), 0
        reports = self._reports
        # at least LIFE periods: a slow loop would otherwise lose its force between two ticks
        life = max(self.life, min(LIFE * period, reports.longest()))
        for index, angle, magnitude, start in zip(
            self._indices, ANGLES, self._magnitudes, self._starts, strict=True
        ):
            self._send(reports.set_effect(index, angle, life))
            self._send(magnitude.report(0))
            self._send(start)
        self._sent = [0] * len(ANGLES)

    def push(self, shares: Sequence[float]) -> None:
        """Sends changed forces, and restarts the effects when due.

        Shares of full scale per axis must be finite and are clipped to [-1, 1].
        """
        self._ticks += 1
        is_due = self._ticks >= self._every
        for axis, share in enumerate(shares):
            magnitude = self._magnitudes[axis]
            counts = round(min(max(share, -1.0), 1.0) * magnitude.full)
            # sent again with a restart, in case the one before was lost
            if is_due or counts != self._sent[axis]:
                self._link.write(magnitude.report(counts), axis)
                self._sent[axis] = counts
        if is_due:
            self._ticks = 0
            for axis, start in enumerate(self._starts):
                self._link.write(start, len(ANGLES) + axis)

    def farewell(self) -> tuple[bytes, ...]:
        """Returns the reports that end the force, free the effects and disable the motors."""
        reports = self._reports
        last_reports: list[bytes | None] = []
        for index, magnitude in zip(self._indices, self._magnitudes, strict=True):
            last_reports += [magnitude.report(0), reports.operate(index, STOP)]
        last_reports.append(reports.control(STOP_ALL))
        last_reports += [reports.free(index) for index in self._indices]
        last_reports.append(reports.control(DISABLE))
        return tuple(report for report in last_reports if report is not None)

    def close(self) -> None:
        """Sends the reports of ``farewell``."""
        for report in self.farewell():
            self._send(report)

    def _send(self, report: bytes | None) -> None:
        if report is not None:
            self._link.send(report)

    def _require_room(self, count: int) -> None:
        pool = self._reports.pool
        answer = self._link.requests.feature(*pool) if pool is not None else b""
        most = self._reports.most_effects(answer) if answer else None
        if most is not None and most < count:
            raise DeviceError(
                f"{self._name} plays {most} effect at a time; two are needed, one per axis"
            )

    def _created(self) -> int:
        """Creates an effect in the device; returns its index."""
        requests = self._link.requests
        if not requests.set_feature(self._reports.create()):
            raise DeviceError(
                f"{self._name} refuses to create a constant force; unplug it and plug it in again"
            )
        for _ in range(LOADS):
            answer = requests.feature(*self._reports.load)
            status, index = self._reports.loaded(answer) if answer else (None, 0)
            if status == LOADED and index > 0:
                return index
            if status == FULL:
                raise DeviceError(
                    f"{self._name} has no room for another effect; unplug it and plug it in again, "
                    "or close the game that uses it"
                )
            self._link.wait(LOAD_MS)
        raise DeviceError(f"{self._name} does not create the constant force that it offers")
