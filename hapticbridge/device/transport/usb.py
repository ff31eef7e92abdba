"""Bytes to and from a USB device through libusb: always one read under way, no wait unbounded."""

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
"""Bytes per bulk packet on full speed. Reads ask for one packet each, so that they end with it."""

MOST_PACKETS = 1024
"""Packets kept for ``take``, the newest. An FTDI bridge sends one a millisecond though nobody asks,
and between two runs nobody takes them: without a bound they would be 0.4 GB after an hour."""

READ_MS = 100
"""Longest wait of the reader thread for one packet, in ms: how long ``close`` may have to wait."""

WRITE_MS = 1
"""Longest wait in ms for a device to take a packet in the loop; the least that libusb knows. A full
speed frame is as long, and a device that is well takes a packet within it."""

CONTROL_MS = 1000
"""Longest wait in ms for a control request, before the loop begins."""

TO_VENDOR = 0x40
"""bmRequestType of a vendor's request to the device, without data."""

SWITCH_INTERVAL = 50e-6
"""In s: after how long the reader thread gets the interpreter from a thread that does not let go,
as the loop while it spins to its deadline. Python's default of 5 ms would cost five samples."""


class UsbLink:
    """A claimed USB device with one bulk endpoint each way.

    A thread keeps one read under way and queues what comes, packet by packet and as it is; it
    notices an unplugged device at once, and the next ``take``, ``wait`` or ``write`` says so.

    Args:
        device: pyusb's device, with its first interface claimed.
        name: What errors call it.
        read_from: Address of the endpoint towards the host.
        write_to: Address of the other.
        log: Keeps what goes over the wire.
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
            DeviceError: It cannot be opened; says why and what to do.
        """
        source = libusb() if backend is None else backend
        if plugged.problem is not None or source is None:
            raise DeviceError(f"{plugged}: {plugged.problem or 'libusb cannot be loaded'}")
        for device in devices_of(family, source):
            if node_of(device) == plugged.path:
                break
        else:
            raise DeviceError(f"{plugged} has just been unplugged")
        try:
            _claim(device)
        # the second is how pyusb says LIBUSB_ERROR_NOT_SUPPORTED: no driver lets it be opened
        except (usb.core.USBError, NotImplementedError) as error:
            usb.util.dispose_resources(device)
            number = getattr(error, "errno", None)
            reason = {
                errno.EACCES: permission_problem(plugged.path),
                errno.EBUSY: "another program has it",
                errno.ENODEV: "it has just been unplugged",
            }.get(number or 0, f"{error}; unplug it and plug it in again")
            raise DeviceError(f"{plugged} cannot be opened: {reason}") from None
        return cls(device, str(plugged), read_from=read_from, write_to=write_to, log=log)

    def now(self) -> float:
        """Returns the time in s of a clock that only grows."""
        return time.monotonic()

    def control(self, request: int, value: int) -> None:
        """Sends a vendor's request without data.

        Args:
            request: bRequest.
            value: wValue.

        Raises:
            DeviceLost: The device is gone, or refuses it.
        """
        self._require()
        if self._log.is_on:
            self._log.add(">", b"control %02x %04x" % (request, value))
        try:
            self._device.ctrl_transfer(TO_VENDOR, request, value, 0, None, CONTROL_MS)
        except usb.core.USBError as error:
            raise self._failed(error) from None

    def write(self, packet: array.array[int], timeout_ms: int = WRITE_MS) -> bool:
        """Sends a packet; returns False where the device did not take it in time.

        Args:
            packet: Of bytes; an array is not copied.
            timeout_ms: Longest wait in ms, >= 1.

        Raises:
            DeviceLost: The device is gone, or refuses it.
        """
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
        """Returns the packets that came since the last call, oldest first, without waiting.

        Raises:
            DeviceLost: The device is gone; packets that came before are returned first.
        """
        packets = self._packets
        if not packets or not self._is_open:
            self._require()
        self._arrived.clear()
        return [packets.popleft() for _ in range(len(packets))]

    def wait(self, timeout: float) -> None:
        """Returns as soon as a packet is there, at the latest after ``timeout`` s."""
        if not self._packets:
            self._arrived.wait(timeout)

    def close(self) -> None:
        """Ends the reader and lets the device go; may be called more than once."""
        if not self._is_open:
            return
        self._is_open = False
        atexit.unregister(self.close)
        self._reader.join(2e-3 * READ_MS)
        if not self._reader.is_alive():  # else it is still inside libusb with what this would free
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
                errno.EPIPE: f"{self._name} refuses to go on (endpoint halted): unplug it and plug "
                "it in again",
            }.get(error.errno or 0, f"{self._name} fails: {error}")
        return DeviceLost(self._lost)

    def _read_always(self) -> None:
        """Runs in the reader's thread until the link is closed or the device lost."""
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
    """Makes threads change promptly while any link is open, and as before after the last one."""
    if _prompt["links"] == 0:
        _prompt["usual"] = sys.getswitchinterval()
    _prompt["links"] += change
    usual = _prompt["usual"]
    sys.setswitchinterval(min(SWITCH_INTERVAL, usual) if _prompt["links"] else usual)


def _claim(device: Any) -> None:
    """Takes the device's first interface, from the kernel's driver if one has it."""
    try:
        if device.is_kernel_driver_active(0):
            device.detach_kernel_driver(0)
    except NotImplementedError:
        pass  # as pyusb says that this system has no drivers to detach
    try:
        device.get_active_configuration()
    except usb.core.USBError as error:
        if error.errno in (errno.EACCES, errno.ENODEV):
            raise
        device.set_configuration()
    usb.util.claim_interface(device, 0)
