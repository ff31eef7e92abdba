"""What a HID device is asked outside the loop: feature reports, and its own description."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from hapticbridge.device.transport.hex_log import HexLog
from hapticbridge.device.transport.hid_search import HidHandle, descriptor_of


def is_taken(send: Callable[[bytes], int], report: bytes, log: HexLog) -> bool:
    """Hands a report to one of hidapi's calls; returns whether the device took it.

    Args:
        send: The call: ``write``, or ``send_feature_report``.
        report: Its number first, 0 where the device's reports have none.
        log: Keeps it.
    """
    if log.is_on:
        log.add(">", report)
    try:
        return send(report) >= 0
    except (OSError, ValueError):
        return False


class HidRequests:
    """Requests that wait for their answer, some ms on USB; nothing for a loop.

    A device that does not answer is no error here: the answer is empty.

    Args:
        handle: The device, open.
        log: Keeps what goes over the wire.
    """

    def __init__(self, handle: HidHandle, log: HexLog) -> None:
        self._handle, self._log = handle, log

    def set_feature(self, report: bytes) -> bool:
        """Sends a feature report, its number first; returns whether the device took it."""
        return is_taken(self._handle.send_feature_report, report, self._log)

    def feature(self, number: int, length: int) -> bytes:
        """Asks for a feature report; returns it, its number first, or nothing."""
        return self._answer(self._handle.get_feature_report, number, length)

    def input_report(self, number: int, length: int) -> bytes:
        """Asks for an input report instead of waiting for it; returns it likewise, or nothing."""
        return self._answer(self._handle.get_input_report, number, length)

    def report_descriptor(self) -> bytes:
        """Returns what the device says of its reports, or nothing."""
        return descriptor_of(self._handle)

    def _answer(self, ask: Callable[[int, int], Sequence[int]], number: int, length: int) -> bytes:
        try:
            report = bytes(ask(number, length))
        except (OSError, ValueError):
            return b""
        if report and self._log.is_on:
            self._log.add("<", report)
        return report
