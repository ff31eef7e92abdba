"""The two constant-force effects by which a stick is pushed, and how they end by themselves."""

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
"""Degrees from north, clockwise, that the force of the x and y effect comes from: a positive one
pushes to the right, and away from the user. The standard's words; never tried on a real stick."""

LOADS, LOAD_MS = 60, 1
"""How often a device is asked what became of an effect, as often as Linux does, and how long is
waited in between, in ms."""

RESTART, LIFE = 0.02, 5
"""An effect is started anew every 20 ms and would end by itself after five times that: a host that
has died lets go within 0.1 s, and four restarts may be lost on the way."""

RESTART_REPORTS = 5
"""On a slow bus restarts come no oftener than every five reports per effect, so that they take at
most a fifth of it."""

SLOWEST_INTERVAL = 8e-3
"""In s, where the interval is unknown: old sticks take 125 reports a second."""


class Effects:
    """Creates an effect per axis, streams their forces, and keeps them alive.

    Args:
        link: Reports to the device, open.
        name: What errors call it.
        reports: Its reports.
        interval: Time in s that a report to it takes, None where unknown.

    Raises:
        DeviceError: The device has no room for two effects, or refuses them.
        DeviceLost: It is gone.
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
        """Gives the effects their direction and their life, and starts them without force.

        Args:
            period: The loop's, in s.
        """
        self._every, self._ticks = max(int(self._restart / period), 1), 0
        reports = self._reports
        # never shorter than a restart comes: a slow loop would drop its force between two ticks
        life = max(self.life, min(LIFE * period, reports.longest()))
        for index, angle, magnitude, start in zip(
            self._indices, ANGLES, self._magnitudes, self._starts, strict=True
        ):
            self._send(reports.set_effect(index, angle, life))
            self._send(magnitude.report(0))
            self._send(start)
        self._sent = [0] * len(ANGLES)

    def push(self, shares: Sequence[float]) -> None:
        """Sends the forces that have changed, and restarts the effects when it is time.

        Args:
            shares: Of full scale per axis, finite; beyond -1 to 1 it is full scale.
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
        """Returns what takes the force away, the effects too, and switches the motors off."""
        reports = self._reports
        said: list[bytes | None] = []
        for index, magnitude in zip(self._indices, self._magnitudes, strict=True):
            said += [magnitude.report(0), reports.operate(index, STOP)]
        said.append(reports.control(STOP_ALL))
        said += [reports.free(index) for index in self._indices]
        said.append(reports.control(DISABLE))
        return tuple(report for report in said if report is not None)

    def close(self) -> None:
        """Sends the ``farewell``."""
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
                f"{self._name} plays {most} effect at a time; two are needed, one for each axis"
            )

    def _created(self) -> int:
        """Creates an effect in the device; returns its index."""
        requests = self._link.requests
        if not requests.set_feature(self._reports.create()):
            raise DeviceError(f"{self._name} refuses to create a constant force")
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
