"""Emulated devices as pyusb sees them, and the motion of the handle behind them."""

from __future__ import annotations

import math
import threading

import numpy as np
import pytest
import usb.core
import usb.util
from emulated.echo import VENDOR, EchoHid, EchoUsb
from emulated.handle import STEP, Handle
from emulated.pyusb_backend import PyusbBackend

from hapticbridge.device import SimulatedDevice


def _echo(backend: PyusbBackend) -> usb.core.Device:
    return usb.core.find(idVendor=VENDOR, idProduct=EchoUsb.product, backend=backend)


def test_pyusb_reads_an_emulated_devices_descriptors_and_what_was_written_to_it() -> None:
    device = _echo(PyusbBackend(EchoUsb(), EchoHid()))
    texts = (device.manufacturer, device.product, device.serial_number)
    assert texts == ("hapticbridge", "bulk echo", "E1")
    assert [one.bEndpointAddress for one in device[0][(0, 0)]] == [0x81, 0x02]
    device.set_configuration()
    assert device.write(0x02, b"there and back") == 14
    assert bytes(device.read(0x81, 64, 100)) == b"there and back"
    assert bytes(device.ctrl_transfer(0xC0, 7, 0x1234, 0, 2)) == b"\x34\x12"


def test_a_read_waits_for_another_threads_write() -> None:
    device = _echo(PyusbBackend(EchoUsb()))
    device.set_configuration()
    answers: list[bytes] = []
    reader = threading.Thread(target=lambda: answers.append(bytes(device.read(0x81, 64, 5000))))
    reader.start()
    device.write(0x02, b"late")
    reader.join()
    assert answers == [b"late"]


def test_silence_refusal_and_unplugging_are_the_errors_that_linux_gives() -> None:
    model = EchoUsb()
    backend = PyusbBackend(model)
    device = _echo(backend)
    device.set_configuration()
    with pytest.raises(usb.core.USBTimeoutError):
        device.read(0x81, 64, 1)
    with pytest.raises(usb.core.USBError) as refused:
        device.ctrl_transfer(0x40, 99, 0, 0, None)
    model.halted.add(0x81)
    with pytest.raises(usb.core.USBError) as halted:
        device.read(0x81, 64, 100)
    device.clear_halt(0x81)
    device.write(0x02, b"again")
    assert bytes(device.read(0x81, 64, 100)) == b"again"
    backend.unplug(model)
    with pytest.raises(usb.core.USBError) as gone:
        device.write(0x02, b"?")
    assert [error.value.errno for error in (refused, halted, gone)] == [32, 32, 19]
    assert _echo(backend) is None


def test_a_hid_devices_feature_report_passes_through_control_requests() -> None:
    device = usb.core.find(idVendor=VENDOR, backend=PyusbBackend(EchoHid()))
    device.ctrl_transfer(0x21, 9, 0x0300, 0, b"feature!")
    assert bytes(device.ctrl_transfer(0xA1, 1, 0x0300, 0, 8)) == b"feature!"
    descriptor = bytes(device.ctrl_transfer(0x81, 6, 0x2200, 0, 255))
    assert descriptor == EchoHid.report_descriptor


def test_a_pushed_handle_moves_as_mass_and_damping_say() -> None:
    mass, damping, force = 0.2, 1.5, 2.0
    handle = Handle(SimulatedDevice(mass=mass, damping=damping, hand=None))
    handle.advance(100.0)
    handle.force[0] = force
    for k in range(1, 101):
        handle.advance(100.0 + k * 1e-3)
    rate, time = damping / mass, 0.1
    expected = force / damping * (time - (1.0 - math.exp(-rate * time)) / rate)
    np.testing.assert_allclose(handle.pose()[0], [expected, 0.0, 0.0], rtol=1e-9)
    speed = force / damping * (1.0 - math.exp(-rate * time))
    assert handle.velocity()[0] == pytest.approx(speed, rel=1e-9)


def test_a_handle_does_not_care_how_often_it_is_told_the_time() -> None:
    often, seldom = (Handle(SimulatedDevice(damping=1.0)) for _ in range(2))
    for handle in (often, seldom):
        handle.advance(0.0)
        handle.force[:] = [1.0, 0.0, -0.5, 0.0, 0.02, 0.0]
    for k in range(1, 801):
        often.advance(k * STEP)
    seldom.advance(0.1)
    assert often.pose()[0].tobytes() == seldom.pose()[0].tobytes()
    assert often.pose()[1].tobytes() == seldom.pose()[1].tobytes()
    seldom.advance(0.05)
    assert often.pose()[0].tobytes() == seldom.pose()[0].tobytes()
