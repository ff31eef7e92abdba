"""Packets to and from a USB device through libusb, with bounded waits."""

from __future__ import annotations

import array
import atexit
import errno
import sys
import threading
import time
from collections import deque
from typing import Any

import usb.core
import usb.util

from hapticbridge.device.plugged import Family, Plugged, permission_problem
from hapticbridge.device.transport.hex_log import HexLog
from hapticbridge.device.transport.usb_search import devices_of, libusb, node_of
from hapticbridge.errors import DeviceError, DeviceLost

PACKET = 64
"""Bytes per bulk packet on full speed. Each read requests one packet, so that it ends with it."""

MOST_PACKETS = 1024
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
        self._packets: deque[bytes] = deque(maxlen=MOST_PACKETS)
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
        plugged: Plugged,
        family: Family,
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
        for device in devices_of(family, source):
            if node_of(device) == plugged.path:
                break
        else:
            raise DeviceError(f"{plugged} has just been unplugged; plug it in again")
        try:
            _claim(device)
        # pyusb raises NotImplementedError for LIBUSB_ERROR_NOT_SUPPORTED: no suitable driver
        except (usb.core.USBError, NotImplementedError) as error:
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
    except NotImplementedError:
        pass  # pyusb's error on systems without drivers to detach
    try:
        device.get_active_configuration()
    except usb.core.USBError as error:
        if error.errno in (errno.EACCES, errno.ENODEV):
            raise
        device.set_configuration()
    usb.util.claim_interface(device, 0)
