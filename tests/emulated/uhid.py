"""An emulated HID device behind /dev/uhid: the kernel's HID core and hidraw are real."""

from __future__ import annotations

import errno
import os
import struct

from emulated.emulator_process import FrontEnd
from emulated.hid_device import FEATURE_REPORT, INPUT_REPORT, OUTPUT_REPORT, HidDevice
from emulated.usb_device import StallError

_DESTROY, _OPEN, _CLOSE, _OUTPUT = 1, 4, 5, 6
_GET_REPORT, _GET_REPORT_REPLY, _CREATE, _INPUT, _SET_REPORT, _SET_REPORT_REPLY = range(9, 15)
_EVENT_SIZE = 4380
_DATA_MAX = 4096
_BUS_USB = 3
_KINDS = {0: FEATURE_REPORT, 1: OUTPUT_REPORT, 2: INPUT_REPORT}
"""Kinds of report in uhid's numbering."""


class Uhid(FrontEnd):
    """A HID device made by a program, of bus type USB.

    Args:
        device: The model.
    """

    def __init__(self, device: HidDevice) -> None:
        self._device = device
        self._is_open, self._is_plugged = False, True
        # without report numbers the kernel puts a zero in their place, which no device ever sees
        self._blank = b"" if device.has_numbered_reports else b"\0"
        self._file = os.open("/dev/uhid", os.O_RDWR | os.O_CLOEXEC)
        name, serial = f"{device.manufacturer} {device.product_name}", device.serial.encode()
        descriptor = device.report_descriptor
        words = (_BUS_USB, device.vendor, device.product, device.release, 0)
        form, texts = f"<I128s64s64s2H4I{_DATA_MAX}s", (name.encode(), b"emulated", serial)
        event = struct.pack(form, _CREATE, *texts, len(descriptor), *words, descriptor)
        os.write(self._file, event)

    def files(self) -> list[int]:
        return [self._file] if self._is_plugged else []

    def serve(self, file: int, now: float) -> None:
        event = os.read(self._file, _EVENT_SIZE)
        kind = struct.unpack_from("<I", event)[0]
        if kind in (_OPEN, _CLOSE):
            self._is_open = kind == _OPEN
        elif kind == _OUTPUT:
            size, _ = struct.unpack_from("<HB", event, 4 + _DATA_MAX)
            self._device.advance(now)
            self._device.output(self._without_blank(event[4 : 4 + size]), now)
        elif kind == _GET_REPORT:
            token, number, report_kind = struct.unpack_from("<IBB", event, 4)
            self._get_report(token, number, report_kind, now)
        elif kind == _SET_REPORT:
            token, _, report_kind, size = struct.unpack_from("<IBBH", event, 4)
            self._set_report(token, report_kind, event[12 : 12 + size], now)

    def settle(self, now: float) -> float | None:
        due = self._device.poll(now)
        # as on USB, where the host asks only while somebody has the device open
        while self._is_open and (report := self._device.take_report()) is not None:
            os.write(self._file, struct.pack("<IH", _INPUT, len(report)) + report)
        return due

    def unplug(self) -> None:
        os.write(self._file, struct.pack("<I", _DESTROY))
        os.close(self._file)
        self._is_plugged = False

    def _without_blank(self, report: bytes) -> bytes:
        return report.removeprefix(self._blank) if self._blank else report

    def _get_report(self, token: int, number: int, kind: int, now: float) -> None:
        answer = None
        if _KINDS.get(kind) == FEATURE_REPORT:
            answer = self._device.feature(number, now)
        elif _KINDS.get(kind) == INPUT_REPORT:
            answer = self._device.input_report(number, now)
        data = b"" if answer is None else self._blank + answer
        error = errno.EIO if answer is None else 0
        head = struct.pack("<IIHH", _GET_REPORT_REPLY, token, error, len(data))
        os.write(self._file, head + data)

    def _set_report(self, token: int, kind: int, report: bytes, now: float) -> None:
        error = 0
        try:
            take = self._device.output if kind == 1 else self._device.set_feature
            take(self._without_blank(report), now)
        except StallError:
            error = errno.EIO
        os.write(self._file, struct.pack("<IIH", _SET_REPORT_REPLY, token, error))
