"""hidapi in this process: what ``HidLink`` takes for it, with emulated devices behind it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

from emulated.hid_device import HidDevice
from emulated.usb_device import StallError


class Timed(Protocol):
    """Emulated devices and the time in s that they are at."""

    now: float

    def advance(self, now: float) -> None:
        """Brings every device to a time; a time before the newest one changes nothing."""


class HidSeam:
    """The devices that are plugged in, and the time that they are at.

    Time stands still unless somebody moves it: ``advance``, or a read that waits.

    Attributes:
        now: In s.
    """

    def __init__(self, *devices: HidDevice) -> None:
        self.plugged = list(devices)
        self.now = 0.0

    def advance(self, now: float) -> None:
        """Brings every device to a time in s; a time before the newest one changes nothing."""
        self.now = max(self.now, now)
        for device in self.plugged:
            device.poll(self.now)

    def unplug(self, device: HidDevice) -> None:
        """Pulls the plug: from now on every call for it fails, as hidapi's do."""
        self.plugged.remove(device)

    def enumerate(self, vendor_id: int = 0, product_id: int = 0) -> list[dict[str, Any]]:
        return [
            {
                "path": f"seam{place}".encode(),
                "vendor_id": device.vendor,
                "product_id": device.product,
                "product_string": device.product_name,
                "serial_number": device.serial,
                "usage_page": int.from_bytes(device.report_descriptor[1:3], "little")
                if device.report_descriptor[0] == 0x06
                else device.report_descriptor[1],
                "usage": _usage(device.report_descriptor),
            }
            for place, device in enumerate(self.plugged)
            if vendor_id in (0, device.vendor) and product_id in (0, device.product)
        ]

    def device(self) -> _Handle:
        return _Handle(self)


class _Handle:
    """One open device."""

    def __init__(self, seam: HidSeam) -> None:
        self._seam = seam
        self._device: HidDevice | None = None

    def open_path(self, path: bytes) -> None:
        place = int(path.removeprefix(b"seam"))
        if place >= len(self._seam.plugged):
            raise OSError("open failed")
        self._device = self._seam.plugged[place]

    def set_nonblocking(self, enable: int) -> int:
        return 0

    def read(self, max_length: int, timeout_ms: int = 0) -> Sequence[int]:
        device = self._there("read error")
        report = device.take_report()
        end = self._seam.now + 1e-3 * timeout_ms
        while report is None and self._seam.now < end:
            self._seam.advance(min(self._seam.now + 125e-6, end))
            report = device.take_report()
        return list((report or b"")[:max_length])

    def write(self, data: bytes) -> int:
        try:
            device = self._there("")
        except OSError:
            return -1  # as cython-hidapi
        device.advance(self._seam.now)
        device.output(data if device.has_numbered_reports else data[1:], self._seam.now)
        return len(data)

    def send_feature_report(self, data: bytes) -> int:
        try:
            self._there("").set_feature(data, self._seam.now)
        except StallError:
            return -1
        return len(data)

    def get_feature_report(self, report_num: int, max_length: int) -> Sequence[int]:
        return list((self._there("").feature(report_num, self._seam.now) or b"")[:max_length])

    def get_input_report(self, report_num: int, max_length: int) -> Sequence[int]:
        answer = self._there("").input_report(report_num, self._seam.now)
        if answer is None:
            raise OSError("read error")
        return list(answer[:max_length])

    def get_report_descriptor(self) -> Sequence[int]:
        return list(self._there("").report_descriptor)

    def close(self) -> None:
        self._device = None

    def _there(self, words: str) -> HidDevice:
        if self._device is None:
            raise ValueError("not open")
        if self._device not in self._seam.plugged:
            raise OSError(words)
        return self._device


def _usage(descriptor: bytes) -> int:
    """Returns the first usage (item 0x09 of one byte, 0x0A of two) of a report descriptor."""
    place = 0
    while place < len(descriptor):
        size = (0, 1, 2, 4)[descriptor[place] & 3]
        if descriptor[place] & 0xFC == 0x08:
            return int.from_bytes(descriptor[place + 1 : place + 1 + size], "little")
        place += 1 + size
    return 0


class DrivingClock:
    """Virtual time that moves the emulated devices along: a loop on it is the same in every run.

    Ticks start when the seam's time says, so a device may have spoken before the first one.
    """

    name = "simulated"
    may_wait = True

    def __init__(self, seam: Timed) -> None:
        self._seam = seam
        self._period = self._now = self._origin = 0

    def start(self, period_ns: int) -> None:
        self._period = period_ns
        self._origin = round(1e9 * self._seam.now) - self._now

    def wait(self) -> tuple[int, int, int]:
        self._now += self._period
        self._seam.advance(1e-9 * (self._origin + self._now))
        return self._now, self._now, 0

    def now(self) -> int:
        return self._now
