"""What a family of real devices is, and one of them that is plugged in."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Transport = Literal["usb", "hid"]


@dataclass(frozen=True, slots=True)
class UsbId:
    """By what a model is known on the bus.

    Attributes:
        vendor: idVendor, 0 to 0xFFFF.
        product: idProduct, 0 to 0xFFFF.
        model: What people call it.
    """

    vendor: int
    product: int
    model: str


@dataclass(frozen=True, slots=True)
class Family:
    """Devices that one codec drives.

    Attributes:
        name: What ``open_device`` calls it.
        about: What it is, in a few words.
        ids: The models.
        transport: ``usb`` (libusb) or ``hid`` (hidapi).
        axes: Which of ``AXES`` it has.
        force: What it renders, in words with units.
        rate: How often it speaks, in words with units.
    """

    name: str
    about: str
    ids: tuple[UsbId, ...]
    transport: Transport
    axes: tuple[str, ...]
    force: str
    rate: str


@dataclass(frozen=True, slots=True)
class Plugged:
    """A device that is plugged in.

    Attributes:
        family: Name of its family.
        name: Its model.
        serial: Its serial number, empty where it has none or may not be read.
        path: Where it is: what the transport opens, and what tells two of them apart.
        vendor: idVendor.
        product: idProduct.
        transport: As in ``Family``.
        problem: Why it cannot be opened, in one sentence; None where nothing is known to hinder.
    """

    family: str
    name: str
    serial: str
    path: str
    vendor: int
    product: int
    transport: Transport
    problem: str | None = None
