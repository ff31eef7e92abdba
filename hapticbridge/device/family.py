"""What kinds of hardware the project drives, and what of it is plugged in: two plain records."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from hapticbridge.device.base import Device
from hapticbridge.errors import DeviceError, choices

Notify = Callable[[str], None]
"""Takes a sentence for the user while a device is opened or started: a prompt, how far it is."""

RULES_COMMAND = "hapticbridge devices --udev-rules"
"""What prints the udev rules; sentences about a missing permission name it."""


def ignore_message(_sentence: str) -> None:
    """Says nothing: where a script opens a device, nobody may be reading."""


@dataclass(frozen=True, slots=True)
class UsbId:
    """A vendor's and product's number on the USB bus, and what is sold under it.

    Attributes:
        vendor: 16 bits.
        product: 16 bits.
        model: The maker's name for it.
    """

    vendor: int
    product: int
    model: str

    def __str__(self) -> str:
        return f"{self.vendor:04x}:{self.product:04x}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Driver:
    """Devices that one codec drives: an entry in the list of what is supported.

    Attributes:
        name: What ``open_device`` knows it by.
        about: What it is, in a few words.
        ids: Every product of the family, none where it is a class.
        transport: ``hid`` (hidapi), ``usb`` (pyusb), ``service`` (a program of the maker's that
            runs beside us) or ``library`` (one of the maker's that is loaded).
        axes: Which axes it has, in words, because it may differ from unit to unit.
        force: What force it can show, in words.
        rate: How often it reports, in words.
        on_stall: What becomes of its force while this machine stands still, in words; empty where
            it gives none. Nothing in this program can act then: only what runs in the device.
        options: Names that ``open`` understands.
        open: Finds the device and opens it; takes the options and whom to tell.
        usage: Usage page and usage of the HID collection that speaks the protocol, where a product
            has several; None where any will do.
        find: Lists what is plugged in, where neither hidapi nor pyusb can tell.
        medium: Says in a sentence whether the service or library is there, likewise.
        sought: What is looked for, in words, where numbers on the USB bus do not say it.
        recognises: Tells from a HID report descriptor whether a device is one of them, for a family
            that is a class and has no list of products; None for all others.
    """

    name: str
    about: str
    ids: tuple[UsbId, ...]
    transport: Literal["hid", "usb", "service", "library"]
    axes: str
    force: str
    rate: str
    options: tuple[str, ...]
    open: Callable[[Mapping[str, object], Notify], Device]
    on_stall: str = ""
    usage: tuple[int, int] | None = None
    find: Callable[[], list[FoundDevice]] | None = None
    medium: Callable[[], str] | None = None
    sought: str = ""
    recognises: Callable[[bytes], bool] | None = None

    def model(self, vendor: int, product: int) -> str | None:
        """Returns the model that has these numbers, or None if it is none of the family."""
        for usb_id in self.ids:
            if (usb_id.vendor, usb_id.product) == (vendor, product):
                return usb_id.model
        return None


@dataclass(frozen=True, slots=True, kw_only=True)
class FoundDevice:
    """A device that is plugged in.

    Attributes:
        family: The family's name.
        name: What the device calls itself, else the model's name; printable, and so is the serial.
        serial: Its serial number, empty where it has none or does not tell.
        path: Where it is opened: a device node.
        vendor: Its numbers on the USB bus; 0 where whoever lists it does not tell.
        product: Likewise.
        transport: As the family's.
        problem: Why it cannot be opened, and what to do, in one sentence; None where it can.
    """

    family: str
    name: str
    serial: str
    path: str
    vendor: int
    product: int
    transport: str
    problem: str | None

    def __post_init__(self) -> None:
        for field in ("name", "serial"):
            object.__setattr__(self, field, printable(getattr(self, field)))

    def __str__(self) -> str:
        numbers = f"{self.vendor:04x}:{self.product:04x}" if self.vendor else ""
        facts = ", ".join(filter(None, (numbers, f"serial {self.serial}" if self.serial else "")))
        return f"{self.name} ({facts})" if facts else self.name


def printable(text: str) -> str:
    """Returns text that a device sent, without codes that a terminal would obey."""
    return "".join(letter if letter.isprintable() else "�" for letter in text).strip()


def permission_problem(path: str) -> str:
    """Says that a node may not be opened, and how to get that permission."""
    return (
        f"no permission to open {path}; '{RULES_COMMAND}' prints the rule that grants it to "
        "whoever sits at the machine"
    )


def access_problem(path: str) -> str | None:
    """Says why this user cannot open a node that the kernel has told of; None where nothing."""
    if os.access(path, os.R_OK | os.W_OK):
        return None
    if not Path(path).exists():
        return f"there is no {path} yet, or none in this container; try again in a second"
    return permission_problem(path)


def select_device(
    family: Driver, plugged: Sequence[FoundDevice], serial: object = None
) -> FoundDevice:
    """Returns the device to open.

    Args:
        family: What was looked for.
        plugged: What of it is plugged in.
        serial: The serial number, or path, that the user asked for; None: there must be just one.

    Raises:
        DeviceError: None is plugged in, or not that one, or several and none was asked for, or it
            may not be opened; says what to do.
    """
    if not plugged:
        vendors = ", ".join(sorted({f"{usb_id.vendor:04x}" for usb_id in family.ids}))
        looked = f"{len(family.ids)} products of {vendors}"
        if len(family.ids) == 1:
            looked = str(family.ids[0])
        elif family.recognises is not None:
            looked = "any product, by what it says it can do"
        looked = family.sought or looked
        raise DeviceError(
            f"no device '{family.name}' is plugged in (looked for {looked}); 'hapticbridge "
            "devices' lists what is, and what permission is missing"
        )
    names = choices(device.serial or device.path for device in plugged)
    if serial is None:
        if len(plugged) > 1:
            raise DeviceError(
                f"{len(plugged)} devices '{family.name}' are plugged in; choose one with "
                f"serial=, one of {names}"
            )
        device = plugged[0]
    else:
        wanted = [d for d in plugged if str(serial) in (d.serial, d.path)]
        if not wanted:
            raise DeviceError(
                f"no device '{family.name}' has serial '{serial}'; plugged in: {names}"
            )
        device = wanted[0]
    if device.problem is not None:
        raise DeviceError(f"{device}: {device.problem}")
    return device
