"""Reports to and from a HID device through hidapi: bounded waits, and one seam for tests."""

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
"""In bytes. Full-speed reports have at most 64; a longer one would be cut, and its check fail."""

QUEUE = 63
"""Reports that Linux keeps per open device (HIDRAW_BUFFER_SIZE, a ring with one free place). Of
those that come when it is full it drops the new ones, so a full queue is an old one. It is also the
most that is taken at once: a device that sends faster than it is read must not hold the loop."""

FRESH_MS = 2
"""In ms: how long a report is waited for after a full queue. At 1 kHz one comes within 1 ms."""

LONGEST_WRITE = 0.05
"""In s. A full-speed device is asked every millisecond, so a report that is not taken in 50 of them
never will be; Linux gives up only after 5 s."""


class Link(Protocol):
    """What a device needs of a transport: ``HidLink``, or what stands for it."""

    def take(self) -> list[bytes]:
        """Returns the reports that have come, without waiting."""

    def wait(self, timeout_ms: int) -> bytes:
        """Returns the next report, or nothing after that time."""

    def write(self, report: bytes) -> None:
        """Sends a report, its number first."""

    def close(self) -> None:
        """Lets the device go."""


class HidLink:
    """An open HID device: newest reports without waiting, and reports to it.

    Nothing here waits longer than it says. hidapi's ``write`` returns when the device has taken the
    report, up to a millisecond later on full speed, and 5 s later where the device has hung; so a
    link that is overlapped hands each report to a thread, which sends the newest one it has.

    Args:
        handle: The device, open.
        name: What errors call it.
        is_overlapped: Whether reports are sent by a thread. Without it ``write`` is hidapi's own.
        log: Keeps what goes over the wire.
        slots: How many kinds of report there are of which each newest one is to be sent, >= 1.

    Attributes:
        requests: Asks the device and sets its features, waiting for the answer.
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
        # in each the newest wins, and they take turns
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
            DeviceError: It cannot be opened; says why and what to do.
        """
        module = hid_api() if api is None else api
        if plugged.problem is not None or module is None:
            raise DeviceError(f"{plugged}: {plugged.problem or 'hidapi is not installed'}")
        handle = module.device()
        try:
            handle.open_path(plugged.path.encode())
        except (OSError, ValueError):
            raise DeviceError(
                f"{plugged} at {plugged.path} cannot be opened; it may be in use or just unplugged"
            ) from None
        return cls(handle, str(plugged), is_overlapped=is_overlapped, log=log, slots=slots)

    def take(self) -> list[bytes]:
        """Returns the reports that have come since the last call, oldest first, without waiting.

        Only after a pause so long that the kernel's queue is full, and all in it old, a new one is
        waited for, up to ``FRESH_MS``.

        Raises:
            DeviceLost: The device is gone.
        """
        reports: list[bytes] = []
        while len(reports) < QUEUE and (report := self._read(0)):
            reports.append(report)
        if len(reports) == QUEUE and (report := self._read(FRESH_MS)):
            reports.append(report)
        return reports

    def wait(self, timeout_ms: int) -> bytes:
        """Returns the next report; empty if none comes in time.

        Args:
            timeout_ms: Longest time to wait in ms, >= 1.

        Raises:
            DeviceLost: The device is gone.
        """
        return self._read(timeout_ms)

    def write(self, report: bytes, slot: int = 0) -> None:
        """Sends a report; overlapped, it replaces one of its slot that has not been sent yet.

        Args:
            report: Its number first, 0 where the device's reports have none.
            slot: Which kind of report it is.

        Raises:
            DeviceLost: The device is gone, or took no report for ``LONGEST_WRITE``.
        """
        if self._lost or not self._is_open:
            raise DeviceLost(self._lost or f"{self._name} is closed")
        if self._writer is None:
            if not self._is_sent(report):
                raise DeviceLost(f"{self._name} did not take a report")
            return
        if not self._is_idle.is_set() and time.monotonic() - self._busy_since > LONGEST_WRITE:
            self._lost = f"{self._name} takes no reports any more"
            raise DeviceLost(self._lost)
        self._outgoing[slot].append(report)
        self._wake.set()

    def send(self, report: bytes) -> None:
        """Sends a report before it returns, and drops what still waits to be sent: for set-up.

        Raises:
            DeviceLost: The device is gone, or takes no reports.
        """
        for waiting in self._outgoing:
            waiting.clear()
        if self._lost or not self._is_idle.wait(LONGEST_WRITE) or not self._is_sent(report):
            raise DeviceLost(self._lost or f"{self._name} did not take a report")

    def close(self) -> None:
        """Sends what is still to be sent, for at most ``LONGEST_WRITE``, and lets the device go."""
        if not self._is_open:
            return
        self._is_open = False
        if self._writer is not None:
            self._wake.set()
            self._writer.join(LONGEST_WRITE)
        if self._writer is None or not self._writer.is_alive():
            self._handle.close()  # else it is inside hidapi's write, which uses what this frees
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
        """Runs in the writer's thread until the link is closed or the device lost."""
        while True:
            self._wake.wait()
            self._wake.clear()
            while any(self._outgoing):
                for waiting in self._outgoing:
                    if not self._is_newest_sent(waiting):
                        self._lost = f"{self._name} is gone: it took no report"
                        return
            if not self._is_open:
                return

    def _is_newest_sent(self, waiting: deque[bytes]) -> bool:
        """Sends what waits in a slot, if anything; returns whether that went well."""
        self._busy_since = time.monotonic()
        self._is_idle.clear()
        try:
            return self._is_sent(waiting.popleft())
        except IndexError:
            return True  # nothing waits here, or it was just dropped
        finally:
            self._is_idle.set()
