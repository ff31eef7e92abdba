"""Reports to and from a HID device through hidapi: bounded waits, and one seam for tests."""

from __future__ import annotations

import importlib
import os
import sys
import threading
import time
from collections import deque
from collections.abc import Sequence
from typing import Any, Protocol, cast

from hapticbridge.device.hex_log import HexLog
from hapticbridge.device.plugged import Family, Plugged, permission_problem
from hapticbridge.device.usb_bus import on_the_bus
from hapticbridge.errors import DeviceError, DeviceLost

LONGEST_REPORT = 256
"""In bytes. Full-speed reports have at most 64; a longer one would be cut, and its check fail."""

MOST_REPORTS = 64
"""Reports taken at once: what Linux keeps per open device (HIDRAW_BUFFER_SIZE). Without a limit
a device that sends faster than they are read would hold the loop."""

LONGEST_WRITE = 0.05
"""In s. A full-speed device is asked every millisecond, so a report that is not taken in 50 of them
never will be; Linux gives up only after 5 s."""


class HidHandle(Protocol):
    """An open device, as cython-hidapi offers it: the seam at which tests put a model."""

    def open_path(self, path: bytes) -> None:
        """Opens the device; OSError where it cannot."""

    def set_nonblocking(self, enable: int) -> int:
        """Makes ``read`` without a time return at once."""

    def read(self, max_length: int, timeout_ms: int = 0) -> Sequence[int]:
        """Returns one report, or nothing; waits at most ``timeout_ms``."""

    def write(self, data: bytes) -> int:
        """Sends one report; its first byte is its number, 0 where reports have none."""

    def send_feature_report(self, data: bytes) -> int:
        """Sets a feature report; likewise."""

    def get_feature_report(self, report_num: int, max_length: int) -> Sequence[int]:
        """Asks for a feature report."""

    def close(self) -> None:
        """Closes the device."""


class HidApi(Protocol):
    """hidapi's module: what is plugged in, and a handle to open."""

    def enumerate(self, vendor_id: int = 0, product_id: int = 0) -> list[dict[str, Any]]:
        """Lists the HID collections that are plugged in."""

    def device(self) -> HidHandle:
        """Returns a handle that is not open yet."""


def hid_api() -> HidApi | None:
    """Returns hidapi's module, or None where it is not installed or cannot be loaded.

    On Linux it is ``hidraw``. The wheel's ``hid`` goes through a bundled libusb of 2016, which
    scans the bus once at import, takes the device from the kernel's driver, and is three times
    slower.
    """
    for name in ("hidraw", "hid") if sys.platform == "linux" else ("hid",):
        try:
            return cast("HidApi", importlib.import_module(name))
        except (ImportError, OSError):
            continue
    return None


def find(family: Family, api: HidApi | None = None) -> list[Plugged]:
    """Lists the family's devices that are plugged in, with what keeps each from being opened.

    Args:
        family: What to look for.
        api: hidapi or what stands for it; None takes the real one. Only then the USB bus is asked
            too, for devices that the kernel gave no hidraw node.

    Returns:
        One entry per device, none where hidapi is missing.
    """
    module = hid_api() if api is None else api
    found: dict[str, Plugged] = {}
    for entry in module.enumerate() if module is not None else ():
        vendor, product = int(entry["vendor_id"]), int(entry["product_id"])
        model = family.model(vendor, product)
        usage = entry.get("usage_page"), entry.get("usage")
        if model is None or family.usage not in (None, usage):
            continue
        raw = entry["path"]
        path = raw.decode(errors="replace") if isinstance(raw, bytes) else str(raw)
        is_closed = api is None and path.startswith("/") and not os.access(path, os.R_OK | os.W_OK)
        # hidapi names one node once per top-level collection
        found.setdefault(
            path,
            Plugged(
                family=family.name,
                name=entry.get("product_string") or model,
                serial=entry.get("serial_number") or "",
                path=path,
                vendor=vendor,
                product=product,
                transport="hid",
                problem=permission_problem(path) if is_closed else None,
            ),
        )
    return [*found.values(), *(_without_node(family) if api is None else [])]


def _without_node(family: Family) -> list[Plugged]:
    """Lists the family's devices on the USB bus that have no hidraw node at all."""
    return [
        Plugged(
            family=family.name,
            name=device.name or model,
            serial=device.serial,
            path=str(device.node),
            vendor=device.vendor,
            product=device.product,
            transport="hid",
            problem="the kernel gives it no hidraw node; load its driver (for 046d: "
            "'sudo modprobe hid_logitech') and plug it in again",
        )
        for device in on_the_bus()
        if not device.has_hidraw
        and (model := family.model(device.vendor, device.product)) is not None
    ]


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
    """

    def __init__(
        self,
        handle: HidHandle,
        name: str,
        *,
        is_overlapped: bool = True,
        log: HexLog | None = None,
    ) -> None:
        self._handle = handle
        self._name = name
        self._log = log or HexLog("")
        self._is_open = True
        self._lost = ""
        self._outgoing: deque[bytes] = deque(maxlen=1)  # the newest wins
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
        return cls(handle, str(plugged), is_overlapped=is_overlapped, log=log)

    def take(self) -> list[bytes]:
        """Returns the reports that have come since the last call, oldest first, without waiting.

        Raises:
            DeviceLost: The device is gone.
        """
        reports: list[bytes] = []
        while len(reports) < MOST_REPORTS and (report := self._read(0)):
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

    def write(self, report: bytes) -> None:
        """Sends a report; overlapped, it replaces one that has not been sent yet.

        Args:
            report: Its number first, 0 where the device's reports have none.

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
        self._outgoing.append(report)
        self._wake.set()

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
        if self._log.is_on:
            self._log.add(">", report)
        try:
            return self._handle.write(report) >= 0
        except (OSError, ValueError):
            return False

    def _send_newest(self) -> None:
        """Runs in the writer's thread until the link is closed or the device lost."""
        while True:
            self._wake.wait()
            self._wake.clear()
            while self._outgoing:
                self._busy_since = time.monotonic()
                self._is_idle.clear()
                if not self._is_sent(self._outgoing.popleft()):
                    self._lost = f"{self._name} is gone: it took no report"
                    return
                self._is_idle.set()
            if not self._is_open:
                return
