"""Watchdog timeouts between host and device."""

from __future__ import annotations

SILENCE = 0.05
"""Time without a new sample after which a device counts as lost, in s: fifty samples at 1 kHz. At a
shorter time, stalls of an ordinary kernel would look like a lost device. At a longer one, the last
force would stay on the motors for longer."""


SHORTEST_WATCHDOG, WATCHDOG_PERIODS = 0.02, 10
"""Shortest watchdog of a device in s, and watchdog in periods of the loop; the longer time is
requested. An ordinary kernel stalls a loop for some ms now and then. A force that drops out each
time would rattle."""


class SilenceWatch:
    """Detector of a silent device that ignores pauses of the loop.

    A device is silent if it sends nothing new for ``SILENCE`` although it is read. If the loop
    itself pauses for longer than its period plus ``SILENCE``, the count restarts.

    Args:
        now: Time in s on the link's clock, at the device's first sample.
        period: The loop's period in s; 0 if it is far below ``SILENCE``.

    Attributes:
        silence: Time in s since the last new sample.
    """

    def __init__(self, now: float, period: float = 0.0) -> None:
        self._heard = self._read = now
        self._period = period
        self.silence = 0.0

    def is_silent(self, now: float, *, is_new: bool) -> bool:
        """Records a reading at the time ``now`` in s; returns whether the silence is too long."""
        was_away = self.was_away(now)
        self._read = now
        if is_new or was_away:
            self._heard = now
        self.silence = now - self._heard
        return self.silence > SILENCE

    def was_away(self, now: float) -> bool:
        """Returns whether the loop has paused without reading the device, before ``is_silent``.

        A device that replies to requests then holds an answer as old as its last request. Used by
        the loop, it would place the hand at its old position, and elsewhere two ticks later.
        """
        return now - self._read > SILENCE + self._period


def watchdog_time(period: float) -> float:
    """Returns the time in s for which a device should hold a force, for a loop's period in s."""
    return max(SHORTEST_WATCHDOG, WATCHDOG_PERIODS * period)
