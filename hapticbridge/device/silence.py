"""How long device and program may hear nothing of each other before either takes it for the end."""

from __future__ import annotations

SILENCE = 0.05
"""In s: fifty samples at 1 kHz. Shorter would take an ordinary kernel's stalls for a lost device,
longer would leave the last force on the motors for longer."""


SHORTEST_WATCHDOG, WATCHDOG_PERIODS = 0.02, 10
"""The watchdog asked for is ten periods of the loop, but not less than 20 ms: an ordinary kernel
stalls a loop for some ms now and then, and a force that drops out each time would rattle."""


class SilenceWatch:
    """Tells a device that has fallen silent from a loop that was away.

    A device is silent once it has given nothing new for ``SILENCE``, asked all the while. Where the
    loop itself has not read for so much longer than its period, nobody asked: the count begins
    anew.

    Args:
        now: Time in s on the link's clock, at the device's first sample.
        period: The loop's in s; 0 where it is far below ``SILENCE``.

    Attributes:
        silence: Time in s since the device gave something new.
    """

    def __init__(self, now: float, period: float = 0.0) -> None:
        self._heard = self._read = now
        self._period = period
        self.silence = 0.0

    def is_silent(self, now: float, *, is_new: bool) -> bool:
        """Notes a reading; returns whether the device has been silent for too long.

        Args:
            now: Time in s on the same clock.
            is_new: Whether this reading brought something new.
        """
        was_away = self.was_away(now)
        self._read = now
        if is_new or was_away:
            self._heard = now
        self.silence = now - self._heard
        return self.silence > SILENCE

    def was_away(self, now: float) -> bool:
        """Returns whether the loop has not read for so long that nobody asked the device.

        What a device that answers questions has said since is then as old as the last question: a
        loop that goes by it finds the hand where it was, and two ticks later somewhere else.

        Args:
            now: Time in s on the same clock, before the reading is noted.
        """
        return now - self._read > SILENCE + self._period


def watchdog_time(period: float) -> float:
    """Returns for how long in s a device should go on with a force that is not renewed.

    Args:
        period: The loop's in s.
    """
    return max(SHORTEST_WATCHDOG, WATCHDOG_PERIODS * period)
