"""hidapi, and the HID devices that it and the kernel say are plugged in."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Sequence
from typing import Any, Protocol, cast

from hapticbridge.device.plugged import Family, Plugged, permission_problem
from hapticbridge.device.usb_bus import on_the_bus


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
