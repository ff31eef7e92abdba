"""A libusb context ends last, in whatever order what belongs to it goes."""

from __future__ import annotations

import itertools
from ctypes import c_void_p
from typing import Any

import pytest
import usb.backend.libusb1 as pyusb

from hapticbridge.device.transport.usb import UsbContext


class Library:
    """libusb as far as a context, its list and its devices call it; notes what is called."""

    def __init__(self) -> None:
        self.calls: list[str] = []

    def libusb_init(self, context: Any) -> int:
        return 0

    def libusb_get_device_list(self, context: Any, where: Any) -> int:
        self.devices = (c_void_p * 2)(1, 2)
        where._obj.contents = c_void_p.from_buffer(self.devices)
        return 2

    def libusb_ref_device(self, device: Any) -> Any:
        return device

    def __getattr__(self, name: str) -> Any:
        return lambda *_: self.calls.append(name)


@pytest.mark.parametrize("order", list(itertools.permutations(range(4))))
def test_a_context_ends_after_all_that_belongs_to_it(
    order: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    library = Library()
    monkeypatch.setattr(pyusb, "_lib", library)
    context = UsbContext(library)
    listed = context.enumerate_devices()
    things = [context, listed, *listed]
    for which in order:
        assert "libusb_exit" not in library.calls
        things[which].finalize()
    assert library.calls[-1] == "libusb_exit"
    assert library.calls.count("libusb_exit") == 1
    assert library.calls.count("libusb_unref_device") == 2
