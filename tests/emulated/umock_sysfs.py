"""The files by which Linux shows a USB device, written for libraries that read nothing else."""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from emulated.hid_device import HidDevice
from emulated.usb_device import FULL_SPEED, HIGH_SPEED, LOW_SPEED, UsbDevice

_SPEEDS = {LOW_SPEED: "1.5", FULL_SPEED: "12", HIGH_SPEED: "480"}
_USB_MAJOR, _HIDRAW_MAJOR = 189, 244
_ROOT_HUB = "sys/devices/pci0000:00/0000:00:14.0/usb1"
_LISTS = ("sys/bus/usb/devices", "sys/bus/hid/devices", "sys/class/hidraw", "sys/dev/char")


@dataclass(frozen=True)
class Nodes:
    """Files of a plugged-in device under the test bed's root.

    Attributes:
        folder: Its folder in sysfs.
        usb: Device node of usbfs, relative to the root.
        hidraw: Device node of hidraw, None unless it is a HID device.
    """

    folder: Path
    usb: str
    hidraw: str | None

    def all(self) -> list[str]:
        return [node for node in (self.usb, self.hidraw) if node is not None]


def make_test_bed(root: Path) -> None:
    """Makes the folders of a system with nothing plugged in."""
    for name in (*_LISTS, "dev/bus/usb", "dev/.node", "ioctl"):
        (root / name).mkdir(parents=True, exist_ok=True)


def add(root: Path, device: UsbDevice) -> Nodes:
    """Shows a device as the next one on bus 1."""
    number = 1
    while (root / "sys/bus/usb/devices" / f"1-{number}").is_symlink() or (
        root / f"dev/bus/usb/001/{number + 1:03d}"
    ).exists():
        number += 1
    name, address = f"1-{number}", number + 1
    folder = root / _ROOT_HUB / name
    minor = address - 1
    usb = f"dev/bus/usb/001/{address:03d}"
    _write(
        folder,
        {
            **dict.fromkeys(("busnum", "bConfigurationValue", "bNumConfigurations"), "1"),
            "devnum": f"{address}",
            "speed": _SPEEDS[device.speed],
            "bNumInterfaces": " 1",
            "idVendor": f"{device.vendor:04x}",
            "idProduct": f"{device.product:04x}",
            "bcdDevice": f"{device.release:04x}",
            "version": " 2.00",
            "bDeviceClass": "00",
            "devpath": f"{number}",
            "maxchild": "0",
            "dev": f"{_USB_MAJOR}:{minor}",
            "uevent": f"MAJOR={_USB_MAJOR}\nMINOR={minor}\nDEVNAME={usb.removeprefix('dev/')}\n"
            "DEVTYPE=usb_device\nDRIVER=usb\n"
            f"PRODUCT={device.vendor:x}/{device.product:x}/{device.release:x}\n"
            f"BUSNUM=001\nDEVNUM={address:03d}",
        },
    )
    texts = device.manufacturer, device.product_name, device.serial
    named = zip(("manufacturer", "product", "serial"), texts, strict=True)
    _write(folder, {key: text for key, text in named if text})
    descriptors = device.device_descriptor() + device.configuration_descriptor()
    (folder / "descriptors").write_bytes(descriptors)
    _link(folder / "subsystem", root / "sys/bus/usb")
    _link(root / "sys/bus/usb/devices" / name, folder)
    _link(root / f"sys/dev/char/{_USB_MAJOR}:{minor}", folder)
    _node(root, usb, f"{_USB_MAJOR}:{minor}")
    interface = folder / f"{name}:1.0"
    keys = ("Number", "Class", "SubClass", "Protocol")
    codes = (0, *device.interface_class)
    shown = {f"bInterface{key}": f"{code:02x}" for key, code in zip(keys, codes, strict=True)}
    shown |= {"bAlternateSetting": "00", "bNumEndpoints": f"{len(device.endpoints):02x}"}
    _write(interface, {**shown, "uevent": "DEVTYPE=usb_interface"})
    _link(interface / "subsystem", root / "sys/bus/usb")
    _link(root / f"sys/bus/usb/devices/{name}:1.0", interface)
    hidraw = _add_hidraw(root, interface, device, number) if isinstance(device, HidDevice) else None
    return Nodes(folder, usb, hidraw)


def remove(root: Path, nodes: Nodes) -> None:
    """Takes every trace of a device away."""
    for node in nodes.all():
        for path in (root / node, root / "ioctl" / node, _device_number(root, node)):
            path.unlink(missing_ok=True)
    shutil.rmtree(nodes.folder)
    for name in _LISTS:
        for link in (root / name).iterdir():
            if not link.exists():
                link.unlink()


def _add_hidraw(root: Path, interface: Path, device: HidDevice, number: int) -> str:
    minor = number - 1
    name = f"hidraw{minor}"
    hid = interface / f"0003:{device.vendor:04X}:{device.product:04X}.{number:04X}"
    event = (
        f"DRIVER=hid-generic\nHID_ID=0003:{device.vendor:08X}:{device.product:08X}\n"
        f"HID_NAME={device.manufacturer} {device.product_name}\n"
        f"HID_PHYS=usb-0000:00:14.0-{number}/input0\nHID_UNIQ={device.serial}"
    )
    _write(hid, {"uevent": event})
    (hid / "report_descriptor").write_bytes(device.report_descriptor)
    _link(hid / "subsystem", root / "sys/bus/hid")
    _link(root / "sys/bus/hid/devices" / hid.name, hid)
    raw = hid / "hidraw" / name
    event = f"MAJOR={_HIDRAW_MAJOR}\nMINOR={minor}\nDEVNAME={name}"
    _write(raw, {"uevent": event, "dev": f"{_HIDRAW_MAJOR}:{minor}"})
    _link(raw / "subsystem", root / "sys/class/hidraw")
    _link(raw / "device", hid)
    _link(root / "sys/class/hidraw" / name, raw)
    _link(root / f"sys/dev/char/{_HIDRAW_MAJOR}:{minor}", raw)
    _node(root, f"dev/{name}", f"{_HIDRAW_MAJOR}:{minor}")
    return f"dev/{name}"


def _write(folder: Path, texts: Mapping[str, str]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        (folder / name).write_text(text + "\n")


def _link(link: Path, target: Path) -> None:
    link.symlink_to(os.path.relpath(target, link.parent))


def _device_number(root: Path, node: str) -> Path:
    return root / "dev/.node" / node.removeprefix("dev/").replace("/", "_")


def _node(root: Path, node: str, number: str) -> None:
    """Makes a pipe in the place of a device node, so that a program can wait for it."""
    path = root / node
    path.parent.mkdir(parents=True, exist_ok=True)
    os.mkfifo(path)
    _device_number(root, node).symlink_to(number)
