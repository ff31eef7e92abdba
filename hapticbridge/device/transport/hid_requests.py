"""Requests to a HID device outside the loop."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from hapticbridge.device.transport.hex_log import HexLog
from hapticbridge.device.transport.hid_search import HidHandle, descriptor_of


def is_taken(send: Callable[[bytes], int], report: bytes, log: HexLog) -> bool:
    """Sends a report, its number first, by a call of hidapi; returns whether it was accepted."""
    if log.is_on:
        log.add(">", report)
    try:
        return send(report) >= 0
    except (OSError, ValueError):
        return False


class HidRequests:
    """Requests that wait some ms for an answer on USB, so not for use in a loop.

    A device that does not answer raises no error; the answer is empty.

    Args:
        handle: The open device.
        log: Log of the transferred bytes.
    """

    def __init__(self, handle: HidHandle, log: HexLog) -> None:
        self._handle, self._log = handle, log

    def set_feature(self, report: bytes) -> bool:
        """Sends a feature report, its number first; returns whether the device accepted it."""
        return is_taken(self._handle.send_feature_report, report, self._log)

    def feature(self, number: int, length: int) -> bytes:
        """Requests a feature report; returns it with its number first, or an empty answer."""
        return self._answer(self._handle.get_feature_report, number, length)

    def input_report(self, number: int, length: int) -> bytes:
        """Requests an input report instead of waiting for one; returns it as ``feature`` does."""
        return self._answer(self._handle.get_input_report, number, length)

    def report_descriptor(self) -> bytes:
        """Returns the device's report descriptor, or an empty answer."""
        return descriptor_of(self._handle)

    def _answer(self, ask: Callable[[int, int], Sequence[int]], number: int, length: int) -> bytes:
        try:
            report = bytes(ask(number, length))
        except (OSError, ValueError):
            return b""
        if report and self._log.is_on:
            self._log.add("<", report)
        return report
