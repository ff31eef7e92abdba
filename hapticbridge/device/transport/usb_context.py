"""libusb context with a safe order of release."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import usb.backend.libusb1 as pyusb


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
