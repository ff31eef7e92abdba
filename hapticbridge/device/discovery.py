"""Supported hardware that is plugged in, and the udev rules that let a user open it."""

from __future__ import annotations

from importlib.util import find_spec
from typing import NamedTuple

from hapticbridge.device.driver import Driver, FoundDevice, UsbId
from hapticbridge.device.registry import all_drivers, broken_drivers
from hapticbridge.device.transport import hid as hid_search
from hapticbridge.device.transport import usb as usb_search
from hapticbridge.errors import DeviceError

RULES_FILE = "/etc/udev/rules.d/70-hapticbridge.rules"
"""Path of the udev rules. The number must be below 73: ``73-seat-late.rules`` turns the tag
``uaccess`` into a permission, and rules are read in the order of their names."""


def plugged_devices() -> list[FoundDevice]:
    """Lists every connected device of every driver; empty without USB."""
    return [device for driver in all_drivers() for device in plugged_of(driver)]


def plugged_of(driver: Driver) -> list[FoundDevice]:
    """Lists a driver's connected devices, with the reason if one cannot be opened."""
    if driver.find is not None:
        try:
            return driver.find()
        except DeviceError:  # of another package; broken_drivers() has the reason
            return []
    if driver.transport == "hid":
        return hid_search.find(driver)
    return usb_search.find(driver)


class BlindSpot(NamedTuple):
    """Reason why devices cannot be detected at all, and the command that helps."""

    sentence: str
    command: str = ""

    def __str__(self) -> str:
        return f"{self.sentence}: '{self.command}'" if self.command else self.sentence


def blind_spots() -> list[BlindSpot]:
    """Returns the reasons why devices cannot be detected at all."""
    spots = []
    if hid_search.hid_api() is None:
        loss = "hidapi cannot be loaded, so HID devices are not seen"
        spots.append(BlindSpot(loss, "pip install hidapi"))
    if usb_search.libusb() is None:
        loss = "libusb cannot be loaded, so USB devices cannot be opened"
        spots.append(BlindSpot(loss, "pip install libusb-package"))
    if find_spec("serial") is None:
        loss = "pyserial cannot be loaded, so serial ports are not seen"
        spots.append(BlindSpot(loss, "pip install pyserial"))
    return [*spots, *map(BlindSpot, broken_drivers())]


_USB_DEVICE = 'SUBSYSTEM=="usb", ENV{DEVTYPE}=="usb_device"'
_INPUT = 'SUBSYSTEM=="input", KERNEL=="event*"'
_TTY = 'SUBSYSTEM=="tty"'
_NO_MODEM = 'ENV{ID_MM_DEVICE_IGNORE}="1"'  # a modem's manager must not write to it


def udev_rules() -> str:
    """Returns the udev rules that let a local user open these devices.

    A HID device is matched by its kernel name, ``BUS:VENDOR:PRODUCT.NUMBER``. It exists over
    Bluetooth too, where there is no USB parent. A rule cannot read a device's capabilities, so a
    driver that finds devices of any vendor gets one rule per connected device.
    """
    lines = [
        "# Lets the user at the machine's own seat open haptic devices. Written by",
        "# 'hapticbridge devices --udev-rules'. Its number must stay below 73: 73-seat-late.rules",
        "# turns the tag into a permission. To install it:",
        f"#   hapticbridge devices --udev-rules | sudo tee {RULES_FILE}",
        "#   sudo udevadm control --reload && sudo udevadm trigger",
    ]
    for driver in all_drivers():
        if driver.transport in ("service", "library", "view") and not (driver.ids or driver.vendor):
            continue  # no node to open: a program has it
        lines += ["", f"# {driver.name}: {driver.about}"]
        if driver.vendor is not None:
            match = f'{_USB_DEVICE}, ATTR{{idVendor}}=="{driver.vendor:04x}"'
            if driver.subsystem == "tty":
                match = f'{_TTY}, ATTRS{{idVendor}}=="{driver.vendor:04x}", {_NO_MODEM}'
            lines.append(f'{match}, TAG+="uaccess"')
            continue
        if driver.transport == "evdev":  # the kernel counts wheels among the joysticks
            lines.append(f'{_INPUT}, ENV{{ID_INPUT_JOYSTICK}}=="1", TAG+="uaccess"')
            continue
        ids = driver.ids
        if driver.usage is not None or driver.recognises is not None or not ids:
            listed = {(one.vendor, one.product) for one in ids}
            found = _ids_plugged_in(driver)
            ids += tuple(one for one in found if (one.vendor, one.product) not in listed)
        if not ids:
            lines.append("# none is connected: plug it in, and write these rules again")
        for usb_id in ids:
            vendor, product = f"{usb_id.vendor:04x}", f"{usb_id.product:04x}"
            if driver.transport == "hid":
                kernels = f"*:{vendor}:{product}.*".upper()
                match = f'SUBSYSTEM=="hidraw", KERNELS=="{kernels}"'
            elif driver.transport == "serial":
                match = (
                    f'{_TTY}, ATTRS{{idVendor}}=="{vendor}", ATTRS{{idProduct}}=="{product}", '
                    f"{_NO_MODEM}"
                )
            else:
                match = (
                    f'{_USB_DEVICE}, ATTR{{idVendor}}=="{vendor}", ATTR{{idProduct}}=="{product}"'
                )
            lines += [f"# {usb_id.model}", f'{match}, TAG+="uaccess"']
    return "\n".join(lines) + "\n"


def _ids_plugged_in(driver: Driver) -> tuple[UsbId, ...]:
    """Returns the connected products of a driver, each once."""
    found = {(one.vendor, one.product): one.name for one in plugged_of(driver)}
    return tuple(UsbId(*numbers, name) for numbers, name in sorted(found.items()))
