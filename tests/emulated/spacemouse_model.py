"""A SpaceMouse in either layout, with a puck that somebody pushes."""

from __future__ import annotations

import struct
from collections.abc import Callable

from emulated.hid_device import HidDevice

REPORT_PERIOD = 0.008
"""Period in s while the puck is deflected: 125 Hz."""

Push = Callable[[float], tuple[float, ...]]
"""Deflection of the six axes at a time in s, -1 to 1 each."""


def _axes(number: int, usages: range) -> bytes:
    """Returns the report descriptor's part for one input report of signed 16-bit axes."""
    return (
        bytes((0xA1, 0x00, 0x85, number))
        + bytes((0x16,)) + struct.pack("<h", -350) + bytes((0x26,)) + struct.pack("<h", 350)
        + b"".join(bytes((0x09, usage)) for usage in usages)
        + bytes((0x75, 16, 0x95, len(usages), 0x81, 0x02, 0xC0))
    )  # fmt: skip


_BUTTONS_AND_LIGHT = bytes.fromhex(
    "a102 8503 0501 0509 1901 2910 1500 2501 7501 9510 8102 c0"
    "a102 8504 0508 094b 1500 2501 9501 7501 9102 9501 7507 9103 c0"
)
_MULTI_AXIS = bytes.fromhex("0501 0908 a101")


class SpaceMouse(HidDevice):
    """Reports while it is deflected, once more at rest, then nothing.

    Args:
        push: How the puck is deflected over time; None: it is left alone.
        has_long_reports: All six axes in report 1 (wireless and newer), else report 1 and 2.
    """

    manufacturer = "3Dconnexion"
    packet_size = 16

    def __init__(
        self, push: Push | None = None, *, has_long_reports: bool = False, serial: str = ""
    ) -> None:
        super().__init__()
        self.vendor, self.product = (0x256F, 0xC635) if has_long_reports else (0x046D, 0xC626)
        self.product_name = "SpaceMouse Compact" if has_long_reports else "SpaceNavigator"
        self.serial = serial
        axes = (
            _axes(1, range(0x30, 0x36))
            if has_long_reports
            else _axes(1, range(0x30, 0x33)) + _axes(2, range(0x33, 0x36))
        )
        self.report_descriptor = _MULTI_AXIS + axes + _BUTTONS_AND_LIGHT + b"\xc0"
        self.is_lit = False
        self._has_long_reports = has_long_reports
        self._push = push
        self._due: float | None = None
        self._was_deflected = False

    def advance(self, now: float) -> None:
        if self._due is None:
            self._due = now + REPORT_PERIOD
        while self._due <= now + 1e-9:
            self._report(self._due)
            self._due += REPORT_PERIOD

    def next_time(self, now: float) -> float | None:
        return self._due

    def press(self, bits: int) -> None:
        """Reports which buttons are down."""
        self.push(struct.pack("<BH", 3, bits))

    def deflect(self, *counts: int) -> None:
        """Reports a deflection in counts, once."""
        if self._has_long_reports:
            self.push(struct.pack("<B6h", 1, *counts))
        else:
            self.push(struct.pack("<B3h", 1, *counts[:3]))
            self.push(struct.pack("<B3h", 2, *counts[3:]))

    def output(self, report: bytes, now: float) -> None:
        if report[:1] == b"\x04":
            self.is_lit = bool(report[1] & 1)

    def _report(self, when: float) -> None:
        counts = tuple(round(350 * d) for d in self._push(when)) if self._push else (0,) * 6
        if any(counts) or self._was_deflected:
            self.deflect(*counts)
        self._was_deflected = any(counts)
