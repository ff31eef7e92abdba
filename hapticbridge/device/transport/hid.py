"""Reports to and from a HID device through hidapi: bounded waits, and one seam for tests."""

from __future__ import annotations

import importlib
import re
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol, cast

from hapticbridge.device.family import Driver, FoundDevice, access_problem
from hapticbridge.device.transport.trace import HexLog
from hapticbridge.device.transport.usb import members, on_the_bus
from hapticbridge.errors import DeviceError, DeviceLost

# hidapi, and the HID devices that it and the kernel say are plugged in.

NO_NODE = (
    "the kernel gives it no hidraw node; load its driver (for 046d: 'sudo modprobe hid_logitech') "
    "and plug it in again"
)
NO_HIDAPI = "hidapi cannot be loaded; 'pip install hidapi' brings it"

CLASS = Path("/sys/class/hidraw")
"""Where Linux shows HID devices to everybody; absent on other systems."""

CONTROLLERS = frozenset({(0x01, 0x04), (0x01, 0x05), (0x0F, 0x01)})
"""Usage page and usage of joysticks, game pads and physical interface devices: what a family that
has no list of products looks at more closely. Others (keyboards!) are not opened to be asked."""

_INTERVAL, _UNITS = re.compile(r"(\d+)(ms|us)"), {"ms": 1e-3, "us": 1e-6}


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

    def get_input_report(self, report_num: int, max_length: int) -> Sequence[int]:
        """Asks for an input report."""

    def get_report_descriptor(self) -> Sequence[int]:
        """Returns the device's report descriptor."""

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


def find(family: Driver, api: HidApi | None = None) -> list[FoundDevice]:
    """Lists the family's devices that are plugged in, with what keeps each from being opened.

    Args:
        family: What to look for.
        api: hidapi or what stands for it; None takes the real one. Only then the USB bus is asked
            too, for devices without a hidraw node, and for all of them where hidapi is missing.

    Returns:
        One entry per device.
    """
    module = hid_api() if api is None else api
    found: dict[str, FoundDevice] = {}
    for entry in module.enumerate() if module is not None else ():
        vendor, product = int(entry["vendor_id"]), int(entry["product_id"])
        usage = entry.get("usage_page"), entry.get("usage")
        raw = entry["path"]
        path = raw.decode(errors="replace") if isinstance(raw, bytes) else str(raw)
        # hidapi names one node once per top-level collection
        if path in found or family.usage not in (None, usage):
            continue
        if family.recognises is None:
            model = family.model(vendor, product)
        elif usage in CONTROLLERS and family.recognises(report_descriptor(path, module)):
            model = family.about
        else:
            model = None
        if model is None:
            continue
        is_node = api is None and path.startswith("/")
        found[path] = FoundDevice(
            family=family.name,
            name=entry.get("product_string") or model,
            serial=entry.get("serial_number") or "",
            path=path,
            vendor=vendor,
            product=product,
            transport="hid",
            problem=access_problem(path) if is_node else None,
        )
    if api is not None:
        return list(found.values())
    unlisted = (d for d in on_the_bus() if module is None or not d.has_hidraw)
    problem = NO_NODE if module is not None else NO_HIDAPI
    return [*found.values(), *members(family, unlisted, lambda _: problem)]


def report_descriptor(path: str, api: HidApi | None) -> bytes:
    """Returns a device's report descriptor, empty where nobody tells.

    Linux shows it to everybody in sysfs, so nothing is opened there.
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
    """Returns the report descriptor of an open device, empty where hidapi does not tell."""
    try:
        return bytes(handle.get_report_descriptor())
    except (OSError, ValueError, AttributeError):  # hidapi before 0.14 has no such call
        return b""


def polling(path: str) -> tuple[float | None, float | None]:
    """Returns how often the host asks a device for a report and offers it one, in s each.

    Args:
        path: A hidraw node.

    Returns:
        None where the kernel does not say, and for a device without that endpoint.
    """
    found: dict[str, float] = {}
    try:
        for endpoint in sorted((CLASS / Path(path).name / "device/..").glob("ep_*")):
            direction = (endpoint / "direction").read_text().strip()
            interval = (endpoint / "interval").read_text().strip()
            if (told := _INTERVAL.fullmatch(interval)) is not None:
                found[direction] = int(told[1]) * _UNITS[told[2]]
    except (OSError, ValueError):
        pass  # it was just unplugged
    return found.get("in"), found.get("out")


# What a HID device is asked outside the loop: feature reports, and its own description.


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
        plugged: FoundDevice,
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
