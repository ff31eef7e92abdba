"""Reports to and from a HID device through hidapi, with bounded waits."""

from __future__ import annotations

import threading
import time
from collections import deque
from typing import Protocol

from hapticbridge.device.plugged import Plugged
from hapticbridge.device.transport.hex_log import HexLog
from hapticbridge.device.transport.hid_requests import HidRequests, is_taken
from hapticbridge.device.transport.hid_search import HidApi, HidHandle, hid_api
from hapticbridge.errors import DeviceError, DeviceLost

LONGEST_REPORT = 256
"""Largest report in bytes. Full-speed reports have at most 64; a longer one would be truncated and
fail its check."""

QUEUE = 63
"""Number of reports that Linux keeps per open device (HIDRAW_BUFFER_SIZE, a ring with one free
place). When it is full, Linux drops new reports, so a full queue holds old ones. It is also the
most that is taken at once, so that a fast device cannot block the loop."""

FRESH_MS = 2
"""Longest wait in ms for a new report after a full queue. At 1 kHz one comes within 1 ms."""

LONGEST_WRITE = 0.05
"""Longest time in s for a device to accept a report. A full-speed device is polled every
millisecond, so after 50 polls it never will; Linux gives up only after 5 s."""


class Link(Protocol):
    """Report transport of a device; ``HidLink`` is the real one."""

    def take(self) -> list[bytes]:
        """Returns the received reports without waiting."""

    def wait(self, timeout_ms: int) -> bytes:
        """Returns the next report, or an empty one after the timeout."""

    def write(self, report: bytes) -> None:
        """Sends a report, starting with its number."""

    def close(self) -> None:
        """Releases the device."""


class HidLink:
    """An open HID device: newest reports without waiting, and reports to it.

    All waits are bounded. hidapi's ``write`` returns when the device has accepted the report: up to
    a millisecond later on full speed, and 5 s later from a hung device. An overlapped link
    therefore passes each report to a thread, which sends the newest.

    Args:
        handle: The open device.
        name: Name of the device in messages.
        is_overlapped: True to send reports from a thread; otherwise ``write`` is hidapi's own.
        log: Log of the transferred bytes.
        slots: Number of kinds of report, >= 1; of each kind only the newest is sent.

    Attributes:
        requests: Requests that wait for the device's answer.
    """

    def __init__(
        self,
        handle: HidHandle,
        name: str,
        *,
        is_overlapped: bool = True,
        log: HexLog | None = None,
        slots: int = 1,
    ) -> None:
        self._handle = handle
        self._name = name
        self._log = log or HexLog("")
        self.requests = HidRequests(handle, self._log)
        self._is_open = True
        self._lost = ""
        # one slot per kind of report, each with the newest only; slots take turns
        self._outgoing: list[deque[bytes]] = [deque(maxlen=1) for _ in range(slots)]
        self._wake, self._is_idle = threading.Event(), threading.Event()
        self._is_idle.set()
        self._busy_since = 0.0
        self._writer: threading.Thread | None = None
        handle.set_nonblocking(1)
        if is_overlapped:
            self._writer = threading.Thread(target=self._send_newest, name="hid", daemon=True)
            self._writer.start()

    @classmethod
    def open(
        cls,
        plugged: Plugged,
        api: HidApi | None = None,
        *,
        is_overlapped: bool = True,
        log: HexLog | None = None,
        slots: int = 1,
    ) -> HidLink:
        """Opens a device that was found.

        Raises:
            DeviceError: The device cannot be opened; the message names reason and remedy.
        """
        module = hid_api() if api is None else api
        if plugged.problem is not None or module is None:
            raise DeviceError(f"{plugged}: {plugged.problem or 'hidapi is not installed'}")
        handle = module.device()
        try:
            handle.open_path(plugged.path.encode())
        except (OSError, ValueError):
            raise DeviceError(
                f"{plugged} at {plugged.path} cannot be opened; it may be in use by another "
                "program or just unplugged"
            ) from None
        return cls(handle, str(plugged), is_overlapped=is_overlapped, log=log, slots=slots)

    def take(self) -> list[bytes]:
        """Returns the reports since the last call, oldest first, without waiting.

        After a long pause the kernel's queue is full of old reports. Only then does the call wait
        for a new one, up to ``FRESH_MS``.
        """
        reports: list[bytes] = []
        while len(reports) < QUEUE and (report := self._read(0)):
            reports.append(report)
        if len(reports) == QUEUE and (report := self._read(FRESH_MS)):
            reports.append(report)
        return reports

    def wait(self, timeout_ms: int) -> bytes:
        """Returns the next report; empty after ``timeout_ms``, >= 1."""
        return self._read(timeout_ms)

    def write(self, report: bytes, slot: int = 0) -> None:
        """Sends a report, its number first; if overlapped, it replaces an unsent one in its slot.

        Raises:
            DeviceLost: The device is gone, or accepted no report for ``LONGEST_WRITE``.
        """
        if self._lost or not self._is_open:
            raise DeviceLost(self._lost or f"{self._name} is closed")
        if self._writer is None:
            if not self._is_sent(report):
                raise DeviceLost(
                    f"{self._name} did not accept a report; unplug it and plug it in again"
                )
            return
        if not self._is_idle.is_set() and time.monotonic() - self._busy_since > LONGEST_WRITE:
            self._lost = f"{self._name} accepts no reports any more; unplug it and plug it in again"
            raise DeviceLost(self._lost)
        self._outgoing[slot].append(report)
        self._wake.set()

    def send(self, report: bytes) -> None:
        """Sends a report before it returns, and discards unsent ones, for the set-up."""
        for waiting in self._outgoing:
            waiting.clear()
        if self._lost or not self._is_idle.wait(LONGEST_WRITE) or not self._is_sent(report):
            raise DeviceLost(
                self._lost
                or f"{self._name} did not accept a report; unplug it and plug it in again"
            )

    def close(self) -> None:
        """Sends the remaining reports, for at most ``LONGEST_WRITE``, and releases the device."""
        if not self._is_open:
            return
        self._is_open = False
        if self._writer is not None:
            self._wake.set()
            self._writer.join(LONGEST_WRITE)
        if self._writer is None or not self._writer.is_alive():
            self._handle.close()  # not while the writer is inside hidapi, which uses this memory
        self._log.close()

    def _read(self, timeout_ms: int) -> bytes:
        if self._lost or not self._is_open:
            raise DeviceLost(self._lost or f"{self._name} is closed")
        try:
            report = bytes(self._handle.read(LONGEST_REPORT, timeout_ms))
        except (OSError, ValueError):
            self._lost = f"{self._name} is gone: unplugged, or switched off"
            raise DeviceLost(self._lost) from None
        if report and self._log.is_on:
            self._log.add("<", report)
        return report

    def _is_sent(self, report: bytes) -> bool:
        return is_taken(self._handle.write, report, self._log)

    def _send_newest(self) -> None:
        """Sends reports in the writer's thread until the link is closed or the device lost."""
        while True:
            self._wake.wait()
            self._wake.clear()
            while any(self._outgoing):
                for waiting in self._outgoing:
                    if not self._is_newest_sent(waiting):
                        self._lost = f"{self._name} is gone: it did not accept a report"
                        return
            if not self._is_open:
                return

    def _is_newest_sent(self, waiting: deque[bytes]) -> bool:
        """Sends the waiting report of a slot, if any; returns whether that succeeded."""
        self._busy_since = time.monotonic()
        self._is_idle.clear()
        try:
            return self._is_sent(waiting.popleft())
        except IndexError:
            return True  # no report waits, or it was just replaced
        finally:
            self._is_idle.set()
