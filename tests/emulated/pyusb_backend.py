"""Emulated devices behind pyusb, in this process: pyusb and the driver are real, nothing below."""

from __future__ import annotations

import array
import errno
import struct
import threading
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import usb.backend
import usb.core

from emulated.usb_device import TO_HOST, Setup, StallError, UsbDevice

Buffer = array.array  # of bytes, as pyusb hands it over


_DEVICE = """bLength bDescriptorType bcdUSB bDeviceClass bDeviceSubClass bDeviceProtocol
    bMaxPacketSize0 idVendor idProduct bcdDevice iManufacturer iProduct iSerialNumber
    bNumConfigurations"""
_CONFIGURATION = """bLength bDescriptorType wTotalLength bNumInterfaces bConfigurationValue
    iConfiguration bmAttributes bMaxPower"""
_INTERFACE = """bLength bDescriptorType bInterfaceNumber bAlternateSetting bNumEndpoints
    bInterfaceClass bInterfaceSubClass bInterfaceProtocol iInterface"""
_ENDPOINT = "bLength bDescriptorType bEndpointAddress bmAttributes wMaxPacketSize bInterval"
"""Fields of descriptors in the order of their bytes, as the standard names them."""


def _named(names: str, layout: str, raw: bytes) -> SimpleNamespace:
    fields = dict(zip(names.split(), struct.unpack(layout, raw), strict=True))
    return SimpleNamespace(**fields, extra_descriptors=[])


class PyusbBackend(usb.backend.IBackend):  # type: ignore[misc]
    """A USB host with emulated devices plugged in, on the wall clock.

    Safe for a thread that reads while another writes, like libusb.

    Args:
        *devices: What is plugged in to begin with.
        now: The clock, in s.
    """

    def __init__(self, *devices: UsbDevice, now: Callable[[], float] = time.monotonic) -> None:
        self._devices = list(devices)
        self._now = now
        self._changed = threading.Condition(threading.RLock())

    def plug(self, device: UsbDevice) -> None:
        """Plugs a device in."""
        with self._changed:
            self._devices.append(device)

    def unplug(self, device: UsbDevice) -> None:
        """Pulls a device out: pending reads and all later calls fail as on Linux."""
        with self._changed:
            self._devices.remove(device)
            self._changed.notify_all()

    # -- what there is ---------------------------------------------------------------------------

    def enumerate_devices(self) -> Iterator[UsbDevice]:
        return iter(list(self._devices))

    def get_device_descriptor(self, device: UsbDevice) -> SimpleNamespace:
        found = _named(_DEVICE, "<2BH4B3H4B", device.device_descriptor())
        found.address = 1 + (self._devices.index(device) if device in self._devices else 0)
        found.bus, found.port_number, found.port_numbers, found.speed = 1, 1, (1,), device.speed
        return found

    def get_configuration_descriptor(self, device: UsbDevice, config: int) -> SimpleNamespace:
        if config:
            raise IndexError
        return _named(_CONFIGURATION, "<2BH5B", device.configuration_descriptor()[:9])

    def get_interface_descriptor(
        self, device: UsbDevice, interface: int, alternate: int, config: int
    ) -> SimpleNamespace:
        if interface or alternate or config:
            raise IndexError
        return _named(_INTERFACE, "<9B", device.configuration_descriptor()[9:18])

    def get_endpoint_descriptor(
        self, device: UsbDevice, endpoint: int, interface: int, alternate: int, config: int
    ) -> SimpleNamespace:
        found = _named(_ENDPOINT, "<4BHB", device.endpoints[endpoint].descriptor())
        found.bRefresh = found.bSynchAddress = 0
        return found

    # -- opening ---------------------------------------------------------------------------------

    def open_device(self, device: UsbDevice) -> UsbDevice:
        self._require(device)
        return device

    def close_device(self, handle: UsbDevice) -> None:
        pass

    def set_configuration(self, handle: UsbDevice, value: int) -> None:
        self._require(handle)

    def get_configuration(self, handle: UsbDevice) -> int:
        self._require(handle)
        return 1

    def set_interface_altsetting(self, handle: UsbDevice, interface: int, alternate: int) -> None:
        self._require(handle)

    def claim_interface(self, handle: UsbDevice, interface: int) -> None:
        self._require(handle)

    def release_interface(self, handle: UsbDevice, interface: int) -> None:
        pass

    def is_kernel_driver_active(self, handle: UsbDevice, interface: int) -> bool:
        return False

    def detach_kernel_driver(self, handle: UsbDevice, interface: int) -> None:
        pass

    def attach_kernel_driver(self, handle: UsbDevice, interface: int) -> None:
        pass

    # -- transfers -------------------------------------------------------------------------------

    def ctrl_transfer(
        self,
        handle: UsbDevice,
        request_type: int,
        request: int,
        value: int,
        index: int,
        data: Buffer[int],
        timeout: int,
    ) -> int:
        setup = Setup(request_type, request, value, index, len(data))
        with self._changed:
            self._require(handle)
            sent = b"" if request_type & TO_HOST else data.tobytes()
            try:
                answer = handle.control(setup, sent, self._now())
            except StallError:
                raise _halted() from None
            self._changed.notify_all()
        if not request_type & TO_HOST:
            return len(data)
        data[: len(answer)] = array.array("B", answer)
        return len(answer)

    def bulk_write(
        self, handle: UsbDevice, endpoint: int, interface: int, data: Buffer[int], timeout: int
    ) -> int:
        with self._changed:
            self._require(handle)
            try:
                handle.write(endpoint, data.tobytes(), self._now())
            except StallError:
                raise _halted() from None
            self._changed.notify_all()
        return len(data)

    def bulk_read(
        self, handle: UsbDevice, endpoint: int, interface: int, buffer: Buffer[int], timeout: int
    ) -> int:
        """Waits for the device's answer; a timeout of 0 ms waits for ever, as libusb's does."""
        answers: list[bytes | None] = []
        with self._changed:
            self._require(handle)
            end = self._now() + timeout / 1000.0 if timeout else None
            token = handle.submit_read(endpoint, len(buffer), answers.append)
            while True:
                due = handle.poll(self._now())
                if answers:
                    break
                if handle not in self._devices:
                    handle.cancel(token)
                    raise _gone()
                now = self._now()
                if end is not None and now >= end:
                    handle.cancel(token)
                    raise usb.core.USBTimeoutError("Operation timed out", -7, errno.ETIMEDOUT)
                times = [time for time in (due, end) if time is not None]
                # a model may ask to be polled at a time that is already there
                self._changed.wait(max(min(times) - now, 1e-6) if times else None)
        (answer,) = answers
        if answer is None:
            raise _halted()
        buffer[: len(answer)] = array.array("B", answer)
        return len(answer)

    intr_write = bulk_write
    intr_read = bulk_read

    def _require(self, device: UsbDevice) -> None:
        if device not in self._devices:
            raise _gone()


def _halted() -> Any:
    return usb.core.USBError("Pipe error", -9, errno.EPIPE)


def _gone() -> Any:
    return usb.core.USBError("No such device (it may have been disconnected)", -4, errno.ENODEV)
