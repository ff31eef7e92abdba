"""Reports to and from a HID device through hidapi, with bounded waits."""

from __future__ import annotations

import importlib
import re
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeAlias

from hapticbridge.device.base import calling_on_error
from hapticbridge.device.driver import (
    Driver,
    FoundDevice,
    access_problem,
    is_refused,
    select_device,
)
from hapticbridge.device.transport.trace import HexLog
from hapticbridge.device.transport.usb import members, on_the_bus
from hapticbridge.errors import DeviceError, DeviceLost

# Connected HID devices, from hidapi and the kernel

NO_NODE = (
    "the kernel gives it no hidraw node; load its driver (for 046d: 'sudo modprobe hid_logitech') "
    "and plug it in again"
)
NO_HIDAPI = "hidapi cannot be loaded; 'pip install hidapi' installs it"

CLASS = Path("/sys/class/hidraw")
"""Folder in which Linux shows HID devices to all users; absent on other systems."""

CONTROLLERS = frozenset({(0x01, 0x04), (0x01, 0x05), (0x0F, 0x01)})
"""Usage page and usage of joysticks, game pads and physical interface devices. A driver without a
list of products inspects only these; others, such as keyboards, are not opened."""

_INTERVAL, _UNITS = re.compile(r"(\d+)(ms|us)"), {"ms": 1e-3, "us": 1e-6}


HidApi: TypeAlias = Any
"""hidapi's module, which has no types; tests replace it by a model. ``enumerate`` lists the
connected collections, ``device`` returns a handle that is not open yet."""

HidHandle: TypeAlias = Any
"""An open device of hidapi. The first byte of a report is its number, 0 if reports have none."""


def hid_api() -> HidApi | None:
    """Returns hidapi's module, or None if it is not installed or cannot be loaded.

    On Linux it is ``hidraw``. The wheel's ``hid`` uses a bundled libusb of 2016. That scans the bus
    once at import, detaches the kernel's driver, and is three times slower.
    """
    for name in ("hidraw", "hid") if sys.platform == "linux" else ("hid",):
        try:
            return importlib.import_module(name)
        except (ImportError, OSError):
            continue
    return None


def find(driver: Driver, api: HidApi | None = None) -> list[FoundDevice]:
    """Lists the driver's connected devices, with the reason if one cannot be opened.

    Without a substitute of hidapi, ``api``, the USB bus is searched too, for devices without a
    hidraw node, and for all of them without hidapi.
    """
    module = hid_api() if api is None else api
    found: dict[str, FoundDevice] = {}
    for entry in module.enumerate() if module is not None else ():
        vendor, product = int(entry["vendor_id"]), int(entry["product_id"])
        usage = entry.get("usage_page"), entry.get("usage")
        raw = entry["path"]
        path = raw.decode(errors="replace") if isinstance(raw, bytes) else str(raw)
        # hidapi lists a node once per top-level collection
        if path in found or driver.usage not in (None, usage):
            continue
        model = driver.model(vendor, product)
        if driver.usage is not None:
            model = model or driver.about  # the collection is the protocol's, whatever the vendor
        elif driver.recognises is not None:
            is_of_class = usage in CONTROLLERS and driver.recognises(
                report_descriptor(path, module)
            )
            model = driver.about if is_of_class else None
        if model is None:
            continue
        is_node = api is None and path.startswith("/")
        found[path] = FoundDevice(
            driver=driver.name,
            name=entry.get("product_string") or model,
            serial=entry.get("serial_number") or "",
            path=path,
            vendor=vendor,
            product=product,
            transport="hid",
            problem=access_problem(path) if is_node else None,
            lacks_permission=is_node and is_refused(path),
        )
    if api is not None:
        return list(found.values())
    unlisted = (d for d in on_the_bus() if module is None or not d.has_hidraw)
    problem = NO_NODE if module is not None else NO_HIDAPI
    return [*found.values(), *members(driver, unlisted, problem)]


def report_descriptor(path: str, api: HidApi | None) -> bytes:
    """Returns a device's report descriptor, empty if it is not available.

    Linux shows it to all users in sysfs, so nothing is opened there.
    """
    try:
        return (CLASS / Path(path).name / "device/report_descriptor").read_bytes()
    except OSError:
        pass
    if api is None:
        return b""
    handle = api.device()
    try:
        handle.open_path(path.encode())
    except (OSError, ValueError):
        return b""
    try:
        return descriptor_of(handle)
    finally:
        handle.close()


def descriptor_of(handle: HidHandle) -> bytes:
    """Returns the report descriptor of an open device, empty if hidapi does not provide it."""
    try:
        return bytes(handle.get_report_descriptor())
    except (OSError, ValueError, AttributeError):  # hidapi before 0.14 has no such call
        return b""


def polling(path: str) -> tuple[float | None, float | None]:
    """Returns the polling intervals in s for reports from and to a hidraw node; None if unknown."""
    found: dict[str, float] = {}
    try:
        for endpoint in sorted((CLASS / Path(path).name / "device/..").glob("ep_*")):
            direction = (endpoint / "direction").read_text().strip()
            interval = (endpoint / "interval").read_text().strip()
            if (match := _INTERVAL.fullmatch(interval)) is not None:
                found[direction] = int(match[1]) * _UNITS[match[2]]
    except (OSError, ValueError):
        pass  # the device was just unplugged
    return found.get("in"), found.get("out")


# Requests to a HID device outside the loop


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


MAX_REPORT = 256
"""Largest report in bytes. Full-speed reports have at most 64; a longer one would be truncated and
fail its check."""

QUEUE = 63
"""Number of reports that Linux keeps per open device (HIDRAW_BUFFER_SIZE, a ring with one free
place). When it is full, Linux drops new reports, so a full queue holds old ones. It is also the
most that is taken at once, so that a fast device cannot block the loop."""

FRESH_MS = 2
"""Longest wait in ms for a new report after a full queue. At 1 kHz one comes within 1 ms."""

MAX_WRITE = 0.05
"""Longest time in s for a device to accept a report. A full-speed device is polled every
millisecond, so after 50 polls it never will; Linux gives up only after 5 s."""


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
        plugged: FoundDevice,
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
            DeviceLost: The device is gone, or accepted no report for ``MAX_WRITE``.
        """
        if self._lost or not self._is_open:
            raise DeviceLost(self._lost or f"{self._name} is closed")
        if self._writer is None:
            if not self._is_sent(report):
                raise DeviceLost(
                    f"{self._name} did not accept a report; unplug it and plug it in again"
                )
            return
        if not self._is_idle.is_set() and time.monotonic() - self._busy_since > MAX_WRITE:
            self._lost = f"{self._name} accepts no reports any more; unplug it and plug it in again"
            raise DeviceLost(self._lost)
        self._outgoing[slot].append(report)
        self._wake.set()

    def send(self, report: bytes) -> None:
        """Sends a report before it returns, and discards unsent ones, for the set-up."""
        for waiting in self._outgoing:
            waiting.clear()
        if self._lost or not self._is_idle.wait(MAX_WRITE) or not self._is_sent(report):
            raise DeviceLost(
                self._lost
                or f"{self._name} did not accept a report; unplug it and plug it in again"
            )

    def close(self) -> None:
        """Sends the remaining reports, for at most ``MAX_WRITE``, and releases the device."""
        if not self._is_open:
            return
        self._is_open = False
        if self._writer is not None:
            self._wake.set()
            self._writer.join(MAX_WRITE)
        if self._writer is None or not self._writer.is_alive():
            self._handle.close()  # not while the writer is inside hidapi, which uses this memory
        self._log.close()

    def _read(self, timeout_ms: int) -> bytes:
        if self._lost or not self._is_open:
            raise DeviceLost(self._lost or f"{self._name} is closed")
        try:
            report = bytes(self._handle.read(MAX_REPORT, timeout_ms))
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


@contextmanager
def opened(
    driver: Driver,
    options: Mapping[str, object],
    api: HidApi | None,
    *,
    is_overlapped: bool = True,
    slots: int = 1,
) -> Iterator[tuple[FoundDevice, HidLink]]:
    """Opens a device by the options ``serial`` and ``log``; closes it if the block fails.

    With a substitute of hidapi, ``api``, reports are sent without a thread.

    Raises:
        DeviceError: No device is found, or it cannot be opened.
    """
    plugged = select_device(driver, find(driver, api), options.get("serial"))
    is_overlapped = is_overlapped and api is None
    log = HexLog.from_options(options)
    link = HidLink.open(plugged, api, is_overlapped=is_overlapped, log=log, slots=slots)
    with calling_on_error(link.close):
        yield plugged, link
