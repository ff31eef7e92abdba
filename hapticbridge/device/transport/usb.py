"""Packets to and from a USB device through libusb, with bounded waits."""

from __future__ import annotations

import array
import atexit
import errno
import sys
import threading
import time
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import libusb_package
import usb.backend.libusb1
import usb.backend.libusb1 as pyusb
import usb.core
import usb.util

from hapticbridge.device.driver import (
    Driver,
    FoundDevice,
    access_problem,
    is_refused,
    permission_problem,
)
from hapticbridge.device.transport.trace import HexLog
from hapticbridge.errors import DeviceError, DeviceLost

# Devices on the USB bus, from sysfs

BUS = Path("/sys/bus/usb/devices")
"""Folder in which Linux lists USB devices; absent without USB and on other systems."""

NODES = Path("/dev/bus/usb")
"""Folder of the nodes that libusb opens: a folder per bus, a node per device."""

NOT_SUPPORTED = NotImplementedError
"""Error with which pyusb reports LIBUSB_ERROR_NOT_SUPPORTED: the system has no driver for the
device through which libusb could open it, or none to detach from it."""


@dataclass(frozen=True, slots=True)
class OnTheBus:
    """One device on the USB bus.

    Attributes:
        vendor: Vendor id, 16 bits.
        product: Product id, 16 bits.
        name: Product string, empty if it has none.
        serial: Serial number, empty if it has none.
        node: Node that libusb opens.
        has_hidraw: True if any of its interfaces has a hidraw node.
    """

    vendor: int
    product: int
    name: str
    serial: str
    node: Path
    has_hidraw: bool


def on_the_bus() -> list[OnTheBus]:
    """Lists the devices on the USB bus, in the order of their bus positions; empty without a bus.

    This requires neither libusb nor a permission. A device unplugged meanwhile is left out.
    """
    found = []
    try:
        entries = sorted(BUS.iterdir())
    except OSError:
        return []
    for entry in entries:
        try:
            numbers = [
                int(_text(entry / name), base)
                for name, base in (("idVendor", 16), ("idProduct", 16), ("busnum", 10))
            ]
            device = int(_text(entry / "devnum"))
        except (OSError, ValueError):
            continue  # an interface, or a device that was just unplugged
        vendor, product, number = numbers
        found.append(
            OnTheBus(
                vendor=vendor,
                product=product,
                name=_text_or_nothing(entry / "product"),
                serial=_text_or_nothing(entry / "serial"),
                node=NODES / f"{number:03d}" / f"{device:03d}",
                has_hidraw=any(entry.glob("*/*/hidraw/hidraw*")),
            )
        )
    return found


def members(driver: Driver, devices: Iterable[OnTheBus], problem: str | None) -> list[FoundDevice]:
    """Returns the devices of a driver; ``problem`` says why none can be opened, if none can."""
    return [
        FoundDevice(
            driver=driver.name,
            name=device.name or model,
            serial=device.serial,
            path=str(device.node),
            vendor=device.vendor,
            product=device.product,
            transport=driver.transport,
            problem=problem or access_problem(str(device.node)),
            lacks_permission=problem is None and is_refused(str(device.node)),
        )
        for device in devices
        if (model := driver.model(device.vendor, device.product)) is not None
    ]


def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8", errors="replace").strip()


def _text_or_nothing(path: Path) -> str:
    try:
        return _text(path)
    except OSError:
        return ""


# libusb context with a safe order of release


class _Users:
    """Counter of the users of a context; the last one ends it."""

    def __init__(self) -> None:
        self.count = 1  # the context itself
        self.end: Any = None

    def release(self) -> None:
        self.count -= 1
        if not self.count:
            self.end()


class _Device(pyusb._Device):  # type: ignore[misc] # pyusb has no types
    def __init__(self, device: Any, users: _Users) -> None:
        self._users = users
        users.count += 1
        super().__init__(device)

    def _finalize_object(self) -> None:
        super()._finalize_object()
        self._users.release()


class _Devices(pyusb._DevIterator):  # type: ignore[misc] # pyusb has no types
    def __init__(self, context: Any, users: _Users) -> None:
        self._users = users
        users.count += 1
        super().__init__(context)

    def __iter__(self) -> Iterator[_Device]:
        for index in range(self.num_devs):
            yield _Device(self.dev_list[index], self._users)

    def _finalize_object(self) -> None:
        super()._finalize_object()
        self._users.release()


class UsbContext(pyusb._LibUSB):  # type: ignore[misc] # pyusb has no types
    """pyusb's backend with a libusb context that ends after all of its devices.

    pyusb lets each of its objects free its own resources. If a context and its devices belong to a
    cycle (for example an exception with its frames), Python finalizes them in any order. Closing a
    device after ``libusb_exit`` would access freed memory.

    Args:
        library: libusb, as loaded by pyusb.

    Raises:
        usb.core.USBError: libusb cannot be initialised.
    """

    def __init__(self, library: Any) -> None:
        super().__init__(library)
        self._users = _Users()
        context = self.ctx
        self._users.end = lambda: library.libusb_exit(context)

    def _finalize_object(self) -> None:
        if hasattr(self, "_users"):  # absent if the context could not be created
            self._users.release()

    def enumerate_devices(self) -> _Devices:
        """Lists the connected devices."""
        return _Devices(self.ctx, self._users)

    def open_device(self, device: Any) -> Any:
        """Opens a device; the context lives at least until it is closed."""
        handle = super().open_device(device)
        self._users.count += 1
        return handle

    def close_device(self, handle: Any) -> None:
        """Closes a device."""
        super().close_device(handle)
        self._users.release()


# Connected USB devices, from libusb and the kernel


def libusb() -> Any:
    """Returns a new libusb context for pyusb, or None without libusb or USB.

    The context is new, because an old one misses devices that are plugged in later if udev does not
    run. The system's libusb is preferred to that of ``libusb-package``.
    """
    module = usb.backend.libusb1
    for find_library in (None, libusb_package.find_library):
        try:
            if module.get_backend(find_library=find_library) is not None:
                # pyusb itself cannot create a second context
                return UsbContext(module._lib)
        except (usb.core.USBError, OSError):
            continue
    return None


def find(driver: Driver, backend: Any = None) -> list[FoundDevice]:
    """Lists the driver's connected devices, with the reason if one cannot be opened.

    On Linux the kernel's list is used, because opening a device would disturb a running loop. On
    other systems libusb is used. Devices are in the order of their bus positions.
    """
    problem = None
    if backend is None and libusb() is None:
        problem = "libusb cannot be loaded; reinstall the package 'libusb-package'"
    listed = [] if backend is not None else members(driver, on_the_bus(), problem)
    source = libusb() if backend is None and not listed else backend
    return listed if source is None else [_described(driver, d) for d in devices_of(driver, source)]


def devices_of(driver: Driver, backend: Any) -> list[Any]:
    """Returns pyusb's devices of a driver, in the order of their bus positions."""
    try:
        devices: Iterable[Any] = usb.core.find(find_all=True, backend=backend)
        known = [d for d in devices if driver.model(d.idVendor, d.idProduct) is not None]
    except (usb.core.USBError, NOT_SUPPORTED):  # libusb cannot list them
        return []
    return sorted(known, key=node_of)


def node_of(device: Any) -> str:
    """Returns the Linux node of pyusb's device, which distinguishes two of one model."""
    return str(NODES / f"{device.bus or 0:03d}" / f"{device.address or 0:03d}")


def _described(driver: Driver, device: Any) -> FoundDevice:
    node, is_denied, texts = node_of(device), False, ["", ""]
    try:
        device.get_active_configuration()  # opens the device; get_string would hide the error
        texts = [
            usb.util.get_string(device, index) or "" if index else ""
            for index in (device.iProduct, device.iSerialNumber)
        ]
    except usb.core.USBError as error:
        is_denied = error.errno == errno.EACCES
    except (ValueError, NOT_SUPPORTED):
        pass  # the device has no texts, or libusb cannot open it here
    finally:
        usb.util.dispose_resources(device)
    return FoundDevice(
        driver=driver.name,
        name=texts[0] or driver.model(device.idVendor, device.idProduct) or driver.name,
        serial=texts[1],
        path=node,
        vendor=device.idVendor,
        product=device.idProduct,
        transport="usb",
        lacks_permission=is_denied,
    )


PACKET = 64
"""Bytes per bulk packet on full speed. Each read requests one packet, so that it ends with it."""

MAX_PACKETS = 1024
"""Largest number of packets kept for ``take``. An FTDI bridge sends one per millisecond without a
request, and between runs they are not taken. Without a bound they would fill 0.4 GB per hour."""

READ_MS = 100
"""Longest wait of the reader thread for one packet in ms, which bounds the wait of ``close``."""

WRITE_MS = 1
"""Longest wait in ms for a device to accept a packet in the loop: the smallest of libusb, and the
length of a full-speed frame, within which a working device accepts it."""

CONTROL_MS = 1000
"""Longest wait in ms for a control request, before the loop begins."""

TO_VENDOR = 0x40
"""bmRequestType of a vendor request to the device, without data."""

SWITCH_INTERVAL = 50e-6
"""Time in s after which the reader thread gets the interpreter from a busy thread, such as the loop
while it spins to its deadline. Python's default of 5 ms would cost five samples."""


class UsbLink:
    """A claimed USB device with one bulk endpoint in each direction.

    A thread keeps one read pending and queues the packets unchanged. It detects an unplugged device
    at once; the next ``take``, ``wait`` or ``write`` reports it.

    Args:
        device: pyusb's device, with its first interface claimed.
        name: Name of the device in messages.
        read_from: Address of the endpoint to the host.
        write_to: Address of the endpoint to the device.
        log: Log of the transferred bytes.
    """

    def __init__(
        self, device: Any, name: str, *, read_from: int, write_to: int, log: HexLog | None = None
    ) -> None:
        self._device, self._name = device, name
        self._read_from, self._write_to = read_from, write_to
        self._log = log or HexLog("")
        self._packets: deque[bytes] = deque(maxlen=MAX_PACKETS)
        self._arrived = threading.Event()
        self._lost = ""
        self._is_open = True
        _prompt_threads(+1)
        self._reader = threading.Thread(target=self._read_always, name="usb", daemon=True)
        self._reader.start()
        atexit.register(self.close)  # a thread inside libusb must not outlive the interpreter

    @classmethod
    def open(
        cls,
        plugged: FoundDevice,
        driver: Driver,
        *,
        read_from: int,
        write_to: int,
        backend: Any = None,
        log: HexLog | None = None,
    ) -> UsbLink:
        """Opens a device that was found, and claims its first interface.

        Raises:
            DeviceError: The device cannot be opened; the message names reason and remedy.
        """
        source = libusb() if backend is None else backend
        if plugged.problem is not None or source is None:
            raise DeviceError(f"{plugged}: {plugged.problem or 'libusb cannot be loaded'}")
        for device in devices_of(driver, source):
            if node_of(device) == plugged.path:
                break
        else:
            raise DeviceError(f"{plugged} has just been unplugged; plug it in again")
        try:
            _claim(device)
        except (usb.core.USBError, NOT_SUPPORTED) as error:
            usb.util.dispose_resources(device)
            number = getattr(error, "errno", None)
            reason = {
                errno.EACCES: permission_problem(plugged.path),
                errno.EBUSY: "another program has it; close that program",
                errno.ENODEV: "it has just been unplugged; plug it in again",
            }.get(number or 0, f"{error}; unplug it and plug it in again")
            raise DeviceError(f"{plugged} cannot be opened: {reason}") from None
        return cls(device, str(plugged), read_from=read_from, write_to=write_to, log=log)

    def now(self) -> float:
        """Returns the time of a monotonic clock in s."""
        return time.monotonic()

    def control(self, request: int, value: int) -> None:
        """Sends a vendor request (bRequest, wValue) without data."""
        self._require()
        if self._log.is_on:
            self._log.add(">", b"control %02x %04x" % (request, value))
        try:
            self._device.ctrl_transfer(TO_VENDOR, request, value, 0, None, CONTROL_MS)
        except usb.core.USBError as error:
            raise self._failed(error) from None

    def write(self, packet: array.array[int], timeout_ms: int = WRITE_MS) -> bool:
        """Sends an array of bytes without a copy; returns False if it was not accepted in time."""
        if self._lost or not self._is_open:
            self._require()
        try:
            self._device.write(self._write_to, packet, timeout_ms)
        except usb.core.USBTimeoutError:
            return False
        except usb.core.USBError as error:
            raise self._failed(error) from None
        if self._log.is_on:
            self._log.add(">", packet.tobytes())
        return True

    def take(self) -> list[bytes]:
        """Returns the packets since the last call, oldest first, without waiting.

        Packets of a lost device are returned before DeviceLost is raised.
        """
        packets = self._packets
        if not packets or not self._is_open:
            self._require()
        self._arrived.clear()
        return [packets.popleft() for _ in range(len(packets))]

    def wait(self, timeout: float) -> None:
        """Returns as soon as a packet is available, at the latest after ``timeout`` s."""
        if not self._packets:
            self._arrived.wait(timeout)

    def close(self) -> None:
        """Ends the reader and releases the device; may be called more than once."""
        if not self._is_open:
            return
        self._is_open = False
        atexit.unregister(self.close)
        self._reader.join(2e-3 * READ_MS)
        if not self._reader.is_alive():  # not while the reader is inside libusb, using this memory
            usb.util.dispose_resources(self._device)
        _prompt_threads(-1)
        self._log.close()

    def _require(self) -> None:
        if self._lost or not self._is_open:
            raise DeviceLost(self._lost or f"{self._name} is closed")

    def _failed(self, error: Any) -> DeviceLost:
        if not self._lost:
            self._lost = {
                errno.ENODEV: f"{self._name} is gone: unplugged, or switched off",
                errno.EPIPE: f"{self._name} has halted its endpoint: unplug it and plug it in "
                "again",
            }.get(error.errno or 0, f"{self._name} fails: {error}")
        return DeviceLost(self._lost)

    def _read_always(self) -> None:
        """Reads in the reader's thread until the link is closed or the device lost."""
        while self._is_open:
            try:
                packet = self._device.read(self._read_from, PACKET, READ_MS).tobytes()
            except usb.core.USBTimeoutError:
                continue
            except usb.core.USBError as error:
                if self._is_open:
                    self._failed(error)
                self._arrived.set()
                return
            if self._log.is_on:
                self._log.add("<", packet)
            self._packets.append(packet)
            self._arrived.set()


_prompt = {"links": 0, "usual": 0.0}


def _prompt_threads(change: int) -> None:
    """Shortens the thread switch interval while any link is open; restores it after the last."""
    if _prompt["links"] == 0:
        _prompt["usual"] = sys.getswitchinterval()
    _prompt["links"] += change
    usual = _prompt["usual"]
    sys.setswitchinterval(min(SWITCH_INTERVAL, usual) if _prompt["links"] else usual)


def _claim(device: Any) -> None:
    """Claims the device's first interface, and detaches the kernel's driver from it."""
    try:
        if device.is_kernel_driver_active(0):
            device.detach_kernel_driver(0)
    except NOT_SUPPORTED:
        pass  # the system has no drivers to detach
    try:
        device.get_active_configuration()
    except usb.core.USBError as error:
        if error.errno in (errno.EACCES, errno.ENODEV):
            raise
        device.set_configuration()
    usb.util.claim_interface(device, 0)
