"""The bench itself: the echo devices behind real hidapi, libusb and, in Linux, a real kernel."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

import hidraw
import pytest
import usb.core
import usb.util
from emulated.echo import VENDOR, EchoHid, EchoUsb
from emulated.emulator_process import EmulatorProcess

from hapticbridge.device.transport.usb import libusb
from usb_tiers.benches import wait_for
from usb_tiers.conftest import IS_TIME_VIRTUAL, Plug

Echo = tuple[EmulatorProcess, Any]
Record = Callable[[str, object], None]

ROUND_TRIPS = 1000


def _found() -> Any:
    """Returns the bulk echo, None where it is not seen, through a context that looks anew."""
    return usb.core.find(idVendor=VENDOR, idProduct=EchoUsb.product, backend=libusb())


@pytest.fixture
def echo(plug_usb: Plug) -> Iterator[Echo]:
    """A plugged-in bulk echo: the model, and what pyusb makes of it."""
    model = plug_usb(EchoUsb)
    device = wait_for(_found)
    device.set_configuration()
    yield model, device
    usb.util.dispose_resources(device)


def _opened(serial: str) -> Any:
    """Returns the report echo; None where it is not there yet, or its node is not."""
    for one in hidraw.enumerate(VENDOR, EchoHid.product):
        if one["serial_number"] == serial:
            device = hidraw.device()
            with suppress(OSError):  # the kernel lists a device a moment before it makes its node
                device.open_path(one["path"])
                return device
    return None


def _hid(serial: str = "E2") -> Any:
    return wait_for(lambda: _opened(serial))


def _measure(trip: Callable[[int], None], record: Record) -> None:
    """Makes many round trips, and says how many there are in a second where time is real."""
    start = time.perf_counter()
    for i in range(ROUND_TRIPS):
        trip(i)
    if not IS_TIME_VIRTUAL:
        record("round trips/s", round(ROUND_TRIPS / (time.perf_counter() - start)))


def test_bulk_bytes_come_back_through_libusb(echo: Echo, record_property: Record) -> None:
    _, device = echo
    assert device.serial_number == "E1"
    assert bytes(device.ctrl_transfer(0xC0, 7, 0x1234, 0, 2)) == b"\x34\x12"

    def trip(i: int) -> None:
        sent = i.to_bytes(4, "little")
        device.write(0x02, sent)
        assert bytes(device.read(0x81, 64, 1000)) == sent

    _measure(trip, record_property)


def test_a_halted_endpoint_is_a_pipe_error_until_it_is_cleared(echo: Echo) -> None:
    model, device = echo
    model.set("halted", {0x81})
    with pytest.raises(usb.core.USBError) as halted:
        device.read(0x81, 64, 1000)
    assert halted.value.errno == 32
    device.clear_halt(0x81)
    device.write(0x02, b"again")
    assert bytes(device.read(0x81, 64, 1000)) == b"again"


def test_a_read_in_wait_ends_when_the_device_is_pulled_out(echo: Echo) -> None:
    model, device = echo
    model.unplug(after=0.05)
    with pytest.raises(usb.core.USBError) as gone:
        device.read(0x81, 64, 5000)
    assert gone.value.errno == 19
    wait_for(lambda: _found() is None)


def test_reports_come_back_through_hidraw(plug_hid: Plug, record_property: Record) -> None:
    plug_hid(EchoHid)
    device = _hid()
    device.send_feature_report(b"\0feature!")
    assert bytes(device.get_feature_report(0, 9)) == b"\0feature!"

    def trip(i: int) -> None:
        sent = i.to_bytes(64, "little")
        assert device.write(b"\0" + sent) == 65
        assert bytes(device.read(64, 1000)) == sent

    _measure(trip, record_property)
    device.close()


def test_two_devices_of_one_kind_are_told_apart_by_serial(plug_hid: Plug) -> None:
    for serial in ("left", "right"):
        plug_hid(lambda serial=serial: EchoHid(serial))  # type: ignore[misc]
    devices = {serial: _hid(serial) for serial in ("left", "right")}
    for serial, device in devices.items():
        device.write(b"\0" + serial.encode().ljust(64, b"\0"))
    for serial, device in devices.items():
        assert bytes(device.read(64, 1000)).rstrip(b"\0").decode() == serial
        device.close()


def test_hidraw_notices_a_pulled_device_and_one_plugged_in_again(plug_hid: Plug) -> None:
    model = plug_hid(EchoHid)
    device = _hid()
    model.unplug(after=0.05)
    with pytest.raises(OSError, match="read"):
        device.read(64, 5000)
    device.close()
    wait_for(lambda: not hidraw.enumerate(VENDOR, EchoHid.product))
    plug_hid(EchoHid)
    again = _hid()
    again.write(b"\0" + bytes(64))
    assert len(again.read(64, 1000)) == 64
    again.close()
