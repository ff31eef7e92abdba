"""A small HID device that answers with what it was sent."""

from __future__ import annotations

from emulated.hid_device import HidDevice

VENDOR = 0x1209
"""pid.codes; its products 0001 to 0010 are for tests."""


class EchoHid(HidDevice):
    """A HID device without report numbers: 64 bytes come back, the feature report is kept."""

    vendor, product = VENDOR, 0x0002
    manufacturer, product_name = "hapticbridge", "report echo"
    # vendor page 0xFF42, usage 1: 64 bytes in, 64 out, 8 in the feature report
    report_descriptor = bytes.fromhex(
        "0642ff 0901 a101 7508 1500 26ff00 9540 0901 8102 9540 0902 9102 9508 0903 b102 c0"
    )

    def __init__(self, serial: str = "E2") -> None:
        super().__init__()
        self.serial = serial
        self.kept = bytes(8)

    def output(self, report: bytes, now: float) -> None:
        self.push(report[:64].ljust(64, b"\0"))

    def set_feature(self, report: bytes, now: float) -> None:
        self.kept = report[-8:]

    def feature(self, number: int, now: float) -> bytes | None:
        return self.kept
