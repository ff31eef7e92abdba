"""Virtual time for an emulated USB device: a link and a loop's clock that move it."""

from __future__ import annotations

import array

from emulated.usb_device import Setup, StallError, UsbDevice
from hapticbridge.errors import DeviceLost

LAST = 5e-6  # s that a call into the library takes: time never stands still for a driver that polls


class VirtualTime:
    """Time that passes only where somebody waits, with a device that lives in it."""

    def __init__(self, device: UsbDevice, read_from: int = 0x81) -> None:
        self.now = 0.0
        self.device = device
        self.packets: list[bytes] = []
        self.is_plugged = True
        self.is_halted = False
        self._read_from = read_from
        self._ask()

    def _ask(self) -> None:
        self.device.submit_read(self._read_from, 64, self._done)

    def _done(self, packet: bytes | None) -> None:
        if packet is None:
            self.is_halted = True
            return
        self.packets.append(packet)
        self._ask()

    def until(self, time: float, *, stops_at_packet: bool = False) -> None:
        """Moves on to a time, or to the first packet that comes."""
        while self.is_plugged:
            count = len(self.packets)
            due = self.device.poll(self.now)
            if stops_at_packet and (len(self.packets) > count or self.is_halted):
                return
            if due is None or due > time:
                break
            self.now = max(due, self.now + 1e-9)
        self.now = max(self.now, time)
        if self.is_plugged:
            self.device.poll(self.now)

    def advance(self, now: float) -> None:
        """Moves on to a time, as the benches name it."""
        self.until(now)


class VirtualLink:
    """Methods of ``UsbLink``, which a driver calls.

    Args:
        time: The device and its time.
        write_to: Endpoint that writes go to.
    """

    def __init__(self, time: VirtualTime, write_to: int = 0x02) -> None:
        self.time = time
        self.pace = 0.0  # s by which a take moves time, where no clock does
        self.is_closed = False
        self._write_to = write_to

    def now(self) -> float:
        return self.time.now

    def control(self, request: int, value: int) -> None:
        self._require()
        self.time.until(self.time.now + 1e-3)  # a request takes about a frame
        try:
            self.time.device.control(Setup(0x40, request, value, 0, 0), b"", self.time.now)
        except StallError:
            raise DeviceLost("refused") from None

    def write(self, packet: array.array[int], timeout_ms: int = 1) -> bool:
        self._require()
        self.time.until(self.time.now + LAST)
        try:
            self.time.device.write(self._write_to, packet.tobytes(), self.time.now)
        except StallError:
            raise DeviceLost("halted") from None
        return True

    def take(self) -> list[bytes]:
        if self.pace:
            self.time.until(self.time.now + self.pace)
        if not self.time.packets:
            self._require()
        packets, self.time.packets[:] = self.time.packets[:], []
        return packets

    def wait(self, timeout: float) -> None:
        if not self.time.packets and self.time.is_plugged:
            self.time.until(self.time.now + timeout, stops_at_packet=True)
        elif not self.time.packets:
            self.time.now += timeout

    def close(self) -> None:
        self.is_closed = True

    def _require(self) -> None:
        if not self.time.is_plugged:
            raise DeviceLost("gone: unplugged")
        if self.time.is_halted:
            raise DeviceLost("halted")


class VirtualClock:
    """A loop's clock in that time: waiting for a deadline moves the device up to it.

    Args:
        time: The time.
        drift: By how much the loop's second is longer than the device's, no unit.
    """

    name = "simulated"
    may_wait = True

    def __init__(self, time: VirtualTime, drift: float = 0.0) -> None:
        self._time, self._drift = time, drift
        self._period = self._deadline = 0
        self._origin = 0.0

    def start(self, period_ns: int) -> None:
        self._period = period_ns
        self._origin = self._time.now - self._deadline * 1e-9 * (1 + self._drift)

    def wait(self) -> tuple[int, int, int]:
        self._deadline += self._period
        self._time.until(self._origin + self._deadline * 1e-9 * (1 + self._drift))
        return self._deadline, self._deadline, 0

    def now(self) -> int:
        return self._deadline
