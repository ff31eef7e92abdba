"""Descriptions of supported and connected devices."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from hapticbridge.device.base import Device
from hapticbridge.errors import DeviceError, choices

Notify = Callable[[str], None]
"""Receives a message for the user while a device is opened or started: an instruction or
progress."""

Options = Mapping[str, Callable[[str], Any]]
"""Options of a device by name, with the type of each value: ``float``, ``int``, ``str`` for text
up to the next comma (a serial number may have leading zeros), ``Path`` for all remaining text."""

RULES_COMMAND = "hapticbridge devices --udev-rules"
"""Command that prints the udev rules; messages about a missing permission name it."""


def ignore_message(_sentence: str) -> None:
    """Discards the message, for scripts without a reader."""


@dataclass(frozen=True, slots=True)
class UsbId:
    """USB vendor and product id, with the model's name.

    Attributes:
        vendor: Vendor id, 16 bits.
        product: Product id, 16 bits.
        model: The maker's name of the product.
    """

    vendor: int
    product: int
    model: str

    def __str__(self) -> str:
        return f"{self.vendor:04x}:{self.product:04x}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Driver:
    """Driver of a kind of device: an entry in the list of supported hardware.

    Attributes:
        name: Name in ``open_device``.
        about: Description, in a few words.
        ids: Every product of the driver; empty for a device class.
        transport: ``hid`` (hidapi), ``usb`` (pyusb), ``serial`` (pyserial), ``service`` (the
            maker's background program), ``library`` (the maker's library), ``evdev`` (Linux's input
            devices) or ``view`` (the page).
        axes: Axes in words, because they may differ between units.
        force: Available force, in words.
        rate: Rate of reports, in words.
        on_stall: Fate of the force while the host is stalled, in words; empty without force. The
            host cannot act then, only the device itself.
        has_guardian: True if on Linux a second process ends the force of a bridge that dies or
            hangs (``watchdog.ForceOffGuardian``); the device must allow two owners.
        options: Options of ``open``, with their types.
        open: Finds and opens the device; its arguments are the options and a receiver of messages.
        usage: Usage page and usage of the HID collection with the protocol, by which a device of
            any vendor is found; None if the ids alone tell it.
        find: Lists the connected devices if neither hidapi nor pyusb can.
        medium: Returns a sentence on whether the service or library is present.
        first: Option that a value without a name sets, as in ``serial:/dev/ttyACM0``; empty if
            every option is named.
        products: Description of the devices looked for, if USB ids do not describe them.
        document: File of this installation that says how to build the device; None if there is
            nothing to build.
        recognises: Recognises a device class by its HID report descriptor; None for drivers with a
            list of products.
        vendor: USB vendor whose products a library opens, known by id or not; the udev rule then
            names no product. None for drivers with a list of products.
        stated: Options that the user has to state, with a word in the place of each value, as the
            next command to type shows them; empty if there are none.
        subsystem: Kernel subsystem of the node that this library opens, ``usb`` or ``tty``.
    """

    name: str
    about: str
    ids: tuple[UsbId, ...]
    transport: Literal["hid", "usb", "serial", "service", "library", "evdev", "view"]
    axes: str
    force: str
    rate: str
    options: Options
    open: Callable[[Mapping[str, object], Notify], Device]
    on_stall: str = ""
    has_guardian: bool = False
    usage: tuple[int, int] | None = None
    find: Callable[[], list[FoundDevice]] | None = None
    medium: Callable[[], str] | None = None
    first: str = ""
    document: Path | None = None
    products: str = ""
    recognises: Callable[[bytes], bool] | None = None
    vendor: int | None = None
    stated: str = ""
    subsystem: Literal["usb", "tty"] = "usb"

    def model(self, vendor: int, product: int) -> str | None:
        """Returns the model with these ids, or None if it is not of the driver."""
        for usb_id in self.ids:
            if (usb_id.vendor, usb_id.product) == (vendor, product):
                return usb_id.model
        return None

    @property
    def is_felt(self) -> bool:
        """True if a device of this driver gives a force."""
        return bool(self.on_stall)


@dataclass(frozen=True, slots=True, kw_only=True)
class FoundDevice:
    """A connected device.

    Attributes:
        driver: Name of the driver.
        name: Name that the device reports, else the model's name; printable, as is the serial.
        serial: Serial number; empty if it has none or does not report it.
        path: Device node by which it is opened.
        transport: Transport of the driver.
        vendor: USB vendor id; 0 if unknown.
        product: USB product id; 0 if unknown.
        problem: Reason why it cannot be opened, with the remedy, in one sentence; None if it can.
        lacks_permission: True if this user may not open it, which is then its problem.
    """

    driver: str
    name: str
    serial: str
    path: str
    transport: str
    vendor: int = 0
    product: int = 0
    problem: str | None = None
    lacks_permission: bool = False

    def __post_init__(self) -> None:
        if self.lacks_permission:
            object.__setattr__(self, "problem", permission_problem(self.path))
        for field in ("name", "serial"):
            object.__setattr__(self, field, printable(getattr(self, field)))

    def __str__(self) -> str:
        numbers = f"{self.vendor:04x}:{self.product:04x}" if self.vendor else ""
        facts = ", ".join(filter(None, (numbers, f"serial {self.serial}" if self.serial else "")))
        return f"{self.name} ({facts})" if facts else self.name


def printable(text: str) -> str:
    """Returns a device's text without control codes for a terminal."""
    return "".join(letter if letter.isprintable() else "�" for letter in text).strip()


def permission_problem(path: str) -> str:
    """Returns a sentence about the missing permission to open a node, with the remedy."""
    return (
        f"no permission to open {path}; '{RULES_COMMAND}' prints the rule that grants it to "
        "local users of the machine"
    )


def is_refused(path: str) -> bool:
    """Returns True if this user may not open a node of the kernel that exists."""
    return Path(path).exists() and not os.access(path, os.R_OK | os.W_OK)


def access_problem(path: str) -> str | None:
    """Returns the reason why this user cannot open a node of the kernel; None if there is none."""
    if is_refused(path):
        return permission_problem(path)
    if not os.access(path, os.R_OK | os.W_OK):
        return f"no node {path} exists yet, or none in this container; try again in a second"
    return None


def selector(device: FoundDevice, plugged: Sequence[FoundDevice]) -> str:
    """Returns what the option ``serial`` names a device by: its path if it shares its number.

    The interfaces of one wireless receiver have one serial number.
    """
    is_shared = sum(each.serial == device.serial for each in plugged) > 1
    return device.path if is_shared or not device.serial else device.serial


def select_device(
    driver: Driver, plugged: Sequence[FoundDevice], serial: object = None
) -> FoundDevice:
    """Returns the device to open.

    Args:
        driver: The driver that was looked for.
        plugged: Its connected devices.
        serial: Serial number or path; None: exactly one device must be connected.

    Raises:
        DeviceError: No such device is connected, several are and none is selected, or it cannot be
            opened. The message names the remedy.
    """
    if not plugged:
        vendors = ", ".join(sorted({f"{usb_id.vendor:04x}" for usb_id in driver.ids}))
        description = f"{len(driver.ids)} products of {vendors}"
        if len(driver.ids) == 1:
            description = str(driver.ids[0])
        elif driver.recognises is not None:
            description = "any product, by the capabilities that it reports"
        description = driver.products or description
        raise DeviceError(
            f"no device '{driver.name}' is plugged in (looked for {description}); 'hapticbridge "
            "devices' lists connected devices and missing permissions"
        )
    names = choices(selector(device, plugged) for device in plugged)
    if serial is None:
        if len(plugged) > 1:
            raise DeviceError(
                f"{len(plugged)} devices '{driver.name}' are plugged in; choose one with "
                f"serial=, one of {names}"
            )
        device = plugged[0]
    else:
        matching = [d for d in plugged if str(serial) in (d.serial, d.path)]
        if not matching:
            raise DeviceError(
                f"no device '{driver.name}' has serial '{serial}'; plugged in: {names}"
            )
        if len(matching) > 1:
            paths = choices(each.path for each in matching)
            raise DeviceError(
                f"{len(matching)} devices '{driver.name}' have serial '{serial}'; choose one with "
                f"serial=, one of {paths}"
            )
        device = matching[0]
    if device.problem is not None:
        raise DeviceError(f"{device}: {device.problem}")
    return device
