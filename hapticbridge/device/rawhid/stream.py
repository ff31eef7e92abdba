"""The state frames of a raw HID device as they come: the newest, and what was lost on the way."""

from __future__ import annotations

from hapticbridge.device.rawhid.frame import LARGEST, State, decoded
from hapticbridge.errors import DeviceError

_HALF_A_TURN = 0x80000000
"""Of the device's clock, in µs: a step forwards by more is taken for one backwards."""


class StateStream:
    """Takes reports one by one and counts.

    Args:
        name: What errors call the device.

    Attributes:
        newest: The state that came last; None before the first.
        lost: State frames that never came, by their sequence.
        damaged: Reports that were no valid frame.
        repeated: State frames that came twice.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self.newest: State | None = None
        self.lost = self.damaged = self.repeated = 0

    def takes(self, report: bytes) -> bool:
        """Takes a report; returns whether it was a state frame that is newer than the last one.

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
                    f"{self._name} has restarted in mid-run; its pose may count from elsewhere"
                )
            self.lost += (state.sequence - last.sequence - 1) & 0xFFFF
        if not state.is_finite or max(map(abs, state.numbers)) > LARGEST:
            raise DeviceError(f"{self._name} reports a number that is not finite")
        return True
