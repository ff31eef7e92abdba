"""A libusb context that ends after what belongs to it, in whatever order Python lets go of them.

pyusb lets each of its objects free what it holds. Where a context and its devices go together as
part of a cycle (an exception with its frames is one), Python finalizes them in any order, and to
unreference a device or to close it after ``libusb_exit`` is an access to freed memory.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import usb.backend.libusb1 as pyusb


class _Users:
    """Counts what needs a context; the last one ends it."""

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


class _Devices(pyusb._DevIterator):  # type: ignore[misc] # likewise
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


class UsbContext(pyusb._LibUSB):  # type: ignore[misc] # likewise
    """pyusb's backend, with a context of its own.

    Args:
        library: libusb, as pyusb has loaded it.

    Raises:
        usb.core.USBError: libusb cannot begin.
    """

    def __init__(self, library: Any) -> None:
        super().__init__(library)
        self._users = _Users()
        context = self.ctx
        self._users.end = lambda: library.libusb_exit(context)

    def _finalize_object(self) -> None:
        if hasattr(self, "_users"):  # else there is no context
            self._users.release()

    def enumerate_devices(self) -> _Devices:
        """Lists what is plugged in."""
        return _Devices(self.ctx, self._users)

    def open_device(self, device: Any) -> Any:
        """Opens a device; the context lives until it is closed."""
        handle = super().open_device(device)
        self._users.count += 1
        return handle

    def close_device(self, handle: Any) -> None:
        """Closes a device."""
        super().close_device(handle)
        self._users.release()
