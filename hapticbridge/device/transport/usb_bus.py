"""Devices on the USB bus, from sysfs."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from hapticbridge.device.plugged import Family, Plugged

BUS = Path("/sys/bus/usb/devices")
"""Folder in which Linux lists USB devices; absent without USB and on other systems."""

NODES = Path("/dev/bus/usb")
"""Folder of the nodes that libusb opens: a folder per bus, a node per device."""


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


def on_the_bus(bus: Path | None = None) -> list[OnTheBus]:
    """Lists the devices on the USB bus, in the order of their bus positions; empty without a bus.

    This requires neither libusb nor a permission. A device unplugged meanwhile is left out.
    """
    folder = BUS if bus is None else bus
    found = []
    try:
        entries = sorted(folder.iterdir())
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


def members(
    family: Family, devices: Iterable[OnTheBus], problem: Callable[[OnTheBus], str | None]
) -> list[Plugged]:
    """Returns the devices of a family; ``problem`` returns why one cannot be opened, or None."""
    return [
        Plugged(
            family=family.name,
            name=device.name or model,
            serial=device.serial,
            path=str(device.node),
            vendor=device.vendor,
            product=device.product,
            transport=family.transport,
            problem=problem(device),
        )
        for device in devices
        if (model := family.model(device.vendor, device.product)) is not None
    ]


def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8", errors="replace").strip()


def _text_or_nothing(path: Path) -> str:
    try:
        return _text(path)
    except OSError:
        return ""
