"""Emulated HID devices: a report descriptor, reports in and out, feature reports."""

from __future__ import annotations

import struct
from collections import deque
from typing import ClassVar

from emulated.usb_device import INTERRUPT, Endpoint, Setup, StallError, UsbDevice

INPUT_REPORT, OUTPUT_REPORT, FEATURE_REPORT = 1, 2, 3
"""Kinds of report, as in a control request's value."""

_CLASS_TO_DEVICE, _CLASS_TO_HOST = 0x21, 0xA1
_GET_REPORT, _SET_REPORT, _SET_IDLE, _SET_PROTOCOL = 1, 9, 10, 11
_HID, _REPORT = 0x21, 0x22


class HidDevice(UsbDevice):
    """A HID device with one interrupt endpoint in and, unless it has none, one out.

    Reports carry their number in front where the descriptor numbers them. A front end that knows
    USB uses ``UsbDevice``'s calls; one that knows only HID uses ``poll``, ``take_report``,
    ``output``, ``set_feature`` and ``feature``.
    """

    interface_class = (3, 0, 0)
    report_descriptor: bytes
    endpoint_in: ClassVar[int] = 0x81
    endpoint_out: ClassVar[int | None] = 0x02
    packet_size: ClassVar[int] = 64
    interval: ClassVar[int] = 1
    queue_length: ClassVar[int] = 63
    """Reports kept for a host that does not ask; what comes then is lost, as with hidraw's queue
    (a ring of 64 places, one of them free)."""

    def __init__(self) -> None:
        super().__init__()
        addresses = [self.endpoint_in]
        if self.endpoint_out is not None:
            addresses.append(self.endpoint_out)
        self.endpoints = tuple(
            Endpoint(address, INTERRUPT, self.packet_size, self.interval) for address in addresses
        )
        self._reports: deque[bytes] = deque()

    # -- what a model adds -----------------------------------------------------------------------

    def output(self, report: bytes, now: float) -> None:
        """Takes an output report."""

    def set_feature(self, report: bytes, now: float) -> None:
        """Takes a feature report."""
        raise StallError

    def feature(self, number: int, now: float) -> bytes | None:
        """Returns a feature report, None where there is none of this number."""
        return None

    def input_report(self, number: int, now: float) -> bytes | None:
        """Returns an input report that the host asks for, None where there is none."""
        return None

    # -- reports towards the host ----------------------------------------------------------------

    def push(self, report: bytes) -> None:
        """Queues an input report for the host."""
        if len(self._reports) < self.queue_length:
            self._reports.append(bytes(report))

    def take_report(self) -> bytes | None:
        """Returns the oldest queued input report, None where there is none."""
        return self._reports.popleft() if self._reports else None

    @property
    def has_numbered_reports(self) -> bool:
        """True if the descriptor numbers the reports (item 0x85, report id)."""
        descriptor, place = self.report_descriptor, 0
        while place < len(descriptor):
            if descriptor[place] & 0xFC == 0x84:
                return True
            place += 1 + (0, 1, 2, 4)[descriptor[place] & 3]
        return False

    # -- HID in terms of USB ---------------------------------------------------------------------

    def _hid_descriptor(self) -> bytes:
        return struct.pack("<BBHBBBH", 9, _HID, 0x0111, 0, 1, _REPORT, len(self.report_descriptor))

    def interface_extra(self) -> bytes:
        return self._hid_descriptor()

    def class_descriptor(self, kind: int) -> bytes | None:
        return {_HID: self._hid_descriptor(), _REPORT: self.report_descriptor}.get(kind)

    def request(self, setup: Setup, data: bytes, now: float) -> bytes:
        kind, number = setup.value >> 8, setup.value & 0xFF
        key = (setup.request_type, setup.request)
        if key == (_CLASS_TO_DEVICE, _SET_REPORT) and kind == OUTPUT_REPORT:
            self.output(data, now)
        elif key == (_CLASS_TO_DEVICE, _SET_REPORT) and kind == FEATURE_REPORT:
            self.set_feature(data, now)
        elif key == (_CLASS_TO_HOST, _GET_REPORT) and kind == FEATURE_REPORT:
            answer = self.feature(number, now)
            if answer is None:
                raise StallError
            return answer
        elif key == (_CLASS_TO_HOST, _GET_REPORT) and kind == INPUT_REPORT:
            answer = self.input_report(number, now)
            if answer is None:
                raise StallError
            return answer
        elif key not in ((_CLASS_TO_DEVICE, _SET_IDLE), (_CLASS_TO_DEVICE, _SET_PROTOCOL)):
            raise StallError
        return b""

    def accept(self, endpoint: int, data: bytes, now: float) -> None:
        if endpoint != self.endpoint_out:
            raise StallError
        self.output(data, now)

    def take(self, endpoint: int, length: int, now: float) -> bytes | None:
        if endpoint != self.endpoint_in:
            return None
        report = self.take_report()
        return None if report is None else report[:length]
