"""How long a device may give nothing new before it is taken for gone."""

from __future__ import annotations

SILENCE = 0.05
"""In s: fifty samples at 1 kHz. Shorter would take an ordinary kernel's stalls for a lost device,
longer would leave the last force on the motors for longer."""


class SilenceWatch:
    """Tells a device that has fallen silent from a loop that was away.

    A device is silent once it has given nothing new for ``SILENCE``, asked all the while. Where the
    loop itself has not read for so long, nobody asked: the count begins anew.

    Args:
        now: Time in s on the link's clock, at the device's first sample.
    """

    def __init__(self, now: float) -> None:
        self._heard = self._read = now

    def is_silent(self, now: float, *, is_new: bool) -> bool:
        """Notes a reading; returns whether the device has been silent for too long.

        Args:
            now: Time in s on the same clock.
            is_new: Whether this reading brought something new.
        """
        was_away = now - self._read > SILENCE
        self._read = now
        if is_new or was_away:
            self._heard = now
        return now - self._heard > SILENCE
