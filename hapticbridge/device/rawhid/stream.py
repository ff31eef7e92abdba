"""State frames of a raw HID device."""

from __future__ import annotations

from hapticbridge.device.rawhid.frame import LARGEST, State, decoded
from hapticbridge.errors import DeviceError

_HALF_A_TURN = 0x80000000
"""Half the range of the device's clock in µs; a larger step forwards counts as a step backwards."""


class StateStream:
    """Decoder and counter of state frames.

    Args:
        name: Name of the device in messages.

    Attributes:
        newest: Newest state; None before the first.
        lost: Number of missing state frames, by their sequence.
        damaged: Number of reports that were not valid frames.
        repeated: Number of state frames that came twice.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self.newest: State | None = None
        self.lost = self.damaged = self.repeated = 0

    def takes(self, report: bytes) -> bool:
        """Decodes a report; returns whether it was a new state frame.

        Raises:
            DeviceError: The device has restarted, or a number is not finite.
        """
        state = decoded(report)
        if not isinstance(state, State):
            self.damaged += state is None
            return False
        last, self.newest = self.newest, state
        if last is not None:
            if state.sequence == last.sequence and state.time_us == last.time_us:
                self.repeated += 1
                return False
            if (state.time_us - last.time_us) & _HALF_A_TURN:
                raise DeviceError(
                    f"{self._name} has restarted during the run; its pose may have a new origin"
                )
            self.lost += (state.sequence - last.sequence - 1) & 0xFFFF
        if not state.is_finite or max(map(abs, state.numbers)) > LARGEST:
            raise DeviceError(f"{self._name} reports a number that is not finite")
        return True
