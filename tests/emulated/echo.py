"""Two small devices that answer with what they were sent: what the bench itself is tested with."""

from __future__ import annotations

from emulated.hid_device import HidDevice
from emulated.usb_device import BULK, Endpoint, Setup, StallError, UsbDevice

VENDOR = 0x1209
"""pid.codes; its products 0001 to 0010 are for tests."""


class EchoUsb(UsbDevice):
    """A vendor device: bulk bytes come back, and so does the value of vendor request 7."""

    vendor, product = VENDOR, 0x0001
    manufacturer, product_name, serial = "hapticbridge", "bulk echo", "E1"
    endpoints = (Endpoint(0x81, BULK), Endpoint(0x02, BULK))

    def __init__(self) -> None:
        super().__init__()
        self.unread = bytearray()

    def request(self, setup: Setup, data: bytes, now: float) -> bytes:
        if setup.request != 7:
            raise StallError
        return setup.value.to_bytes(2, "little")

    def accept(self, endpoint: int, data: bytes, now: float) -> None:
        self.unread += data

    def take(self, endpoint: int, length: int, now: float) -> bytes | None:
        if not self.unread:
            return None
        answer = bytes(self.unread[:length])
        del self.unread[:length]
        return answer


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
