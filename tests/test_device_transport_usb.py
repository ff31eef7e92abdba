"""The link over pyusb, with pyusb real and an emulated device in place of libusb; its context."""

from __future__ import annotations

import array
import errno
import itertools
import sys
import time
from collections.abc import Callable, Iterator
from ctypes import c_void_p
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import usb.backend.libusb1 as pyusb
import usb.core
from emulated.falcon_model import FalconModel
from emulated.handle import Handle
from emulated.pyusb_backend import PyusbBackend

from hapticbridge.device import SimulatedDevice
from hapticbridge.device.driver import FoundDevice, ignore_message, select_device
from hapticbridge.device.falcon.device import DRIVER, FalconDevice, open_falcon
from hapticbridge.device.falcon.protocol import READ_FROM, SIZE, WRITE_TO, encode, enter_run_mode
from hapticbridge.device.transport.trace import HexLog
from hapticbridge.device.transport.usb import UsbContext, UsbLink, find, libusb
from hapticbridge.errors import DeviceError, DeviceLost
from hapticbridge.kernel.record import SAMPLE_DTYPE

LONGEST = 5.0  # s, far beyond what anything here takes, for waits that end by themselves


def falcon(serial: str = "FT000001") -> FalconModel:
    return FalconModel(Handle(SimulatedDevice(mass=0.4, damping=2.0)), serial=serial)


def question() -> array.array[int]:
    packet = array.array("B", bytes(SIZE))
    encode(np.zeros(3, np.int64), 0, np.frombuffer(packet, np.uint8))
    return packet


class Host(PyusbBackend):
    """A host on which calls can be made to fail as libusb's do."""

    fails: dict[str, int]

    def __init__(self, *devices: FalconModel) -> None:
        super().__init__(*devices)
        self.fails = {}
        self.detached = 0
        self.is_bound = False

    def _may_fail(self, call: str) -> None:
        if call in self.fails:
            raise usb.core.USBError("as told", -1, self.fails[call])

    def open_device(self, device: Any) -> Any:
        self._may_fail("open")
        return super().open_device(device)

    def claim_interface(self, handle: Any, interface: int) -> None:
        self._may_fail("claim")
        super().claim_interface(handle, interface)

    def is_kernel_driver_active(self, handle: Any, interface: int) -> bool:
        return self.is_bound

    def detach_kernel_driver(self, handle: Any, interface: int) -> None:
        self.detached += 1

    def bulk_write(self, *arguments: Any) -> int:
        if self.fails.get("write") == errno.ETIMEDOUT:
            raise usb.core.USBTimeoutError("as told", -7, errno.ETIMEDOUT)
        self._may_fail("write")
        return super().bulk_write(*arguments)


Open = Callable[..., UsbLink]


@pytest.fixture(name="opened")
def _opened() -> Iterator[Open]:
    links = []

    def opened(host: Host, log: Path | None = None) -> UsbLink:
        (plugged,) = find(DRIVER, host)
        link = UsbLink.open(
            plugged, DRIVER, read_from=READ_FROM, write_to=WRITE_TO, backend=host, log=HexLog(log)
        )
        links.append(link)
        return link

    yield opened
    for link in links:
        link.close()


def lost(link: UsbLink) -> str:
    """Takes until the device is lost; returns what is said then."""
    end = time.monotonic() + LONGEST
    with pytest.raises(DeviceLost) as error:
        while time.monotonic() < end:
            link.wait(0.01)
            link.take()
    return str(error.value)


def test_what_is_plugged_in_is_found_with_name_serial_and_place() -> None:
    libusb()
    other = falcon()
    other.product = 0x6001  # any serial adapter
    assert find(DRIVER, PyusbBackend()) == find(DRIVER, Host(other)) == []
    first, second = find(DRIVER, Host(falcon("A1"), falcon("B2")))
    assert (first.name, first.serial, first.path) == ("FALCON HAPTIC", "A1", "/dev/bus/usb/001/001")
    assert (second.serial, second.path) == ("B2", "/dev/bus/usb/001/002")
    assert (first.vendor, first.product, first.problem) == (0x0403, 0xCB48, None)


def test_a_device_that_may_not_be_opened_is_listed_with_its_remedy() -> None:
    host = Host(falcon())
    host.fails["open"] = errno.EACCES
    (plugged,) = find(DRIVER, host)
    assert plugged.problem is not None
    assert "no permission to open /dev/bus/usb/001/001" in plugged.problem
    with pytest.raises(DeviceError, match="no permission to open"):
        open_falcon({}, ignore_message, host)


@pytest.mark.parametrize(
    ("number", "words"),
    [
        (errno.EBUSY, "cannot be opened: another program has it"),
        (errno.EACCES, "cannot be opened: no permission"),
        (errno.ENODEV, "cannot be opened: it has just been unplugged"),
        (errno.EIO, "cannot be opened: .*unplug it and plug it in again"),
    ],
)
def test_why_a_device_cannot_be_claimed_is_said(opened: Open, number: int, words: str) -> None:
    host = Host(falcon())
    host.fails["claim"] = number
    with pytest.raises(DeviceError, match=words):
        opened(host)


def test_the_kernels_driver_is_sent_away() -> None:
    host = Host(falcon())
    host.is_bound = True
    open_falcon({}, ignore_message, host).close()
    assert host.detached == 1


def test_of_two_the_serial_number_chooses() -> None:
    host = Host(falcon("A1"), falcon("B2"))
    with pytest.raises(DeviceError, match=r"2 devices 'falcon' are plugged in; .* 'A1', 'B2'"):
        open_falcon({}, ignore_message, host)
    with pytest.raises(DeviceError, match="'falcon' has serial 'C3'"):
        open_falcon({"serial": "C3"}, ignore_message, host)
    open_falcon({"serial": "B2"}, ignore_message, host).close()


def test_interfaces_that_share_a_serial_number_are_chosen_by_their_paths() -> None:
    first, second, other = (
        FoundDevice(
            driver="it", name="", serial=serial, path=f"/dev/hidraw{number}", transport="hid"
        )
        for number, serial in ((2, "A1"), (3, "A1"), (4, "B2"))
    )
    plugged, paths = [first, second, other], "one of '/dev/hidraw2', '/dev/hidraw3'"
    for serial, words in ((None, f"{paths}, 'B2'$"), ("A1", f"{paths}$")):
        with pytest.raises(DeviceError, match=f"choose one with serial=, {words}"):
            select_device(DRIVER, plugged, serial)
    assert select_device(DRIVER, plugged, "/dev/hidraw3") == second
    assert select_device(DRIVER, plugged, "B2") == other


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"damping": -1.0}, "damping is -1.0 N s/m; it must be finite and >= 0"),
        ({"mass": 0.0}, "mass is 0.0 kg; it must be finite and > 0"),
        ({"firmware": "/no/such/file"}, "firmware = '/no/such/file': cannot be read"),
        ({}, "no device 'falcon' is plugged in .*0403:cb48.*hapticbridge devices"),
    ],
)
def test_a_bad_option_is_refused_before_opening(options: dict[str, object], words: str) -> None:
    with pytest.raises(DeviceError, match=words):
        open_falcon(options, ignore_message, Host())


def test_packets_come_whole_and_as_they_are(opened: Open) -> None:
    link = opened(Host(falcon()))
    for request, value in ((9, 1), (3, 2)):
        link.control(request, value)
    link.take()
    assert link.write(question())
    end = time.monotonic() + LONGEST
    packets: list[bytes] = []
    answer = b""  # in one packet or two: the bridge sends what it has every millisecond
    while time.monotonic() < end and len(answer) < SIZE:
        link.wait(0.1)
        packets += link.take()
        answer = b"".join(p[2:] for p in packets)
    assert all(p[:2] == b"\x01\x60" for p in packets)
    assert len(answer) == SIZE
    assert answer[:1] + answer[-1:] == b"<>"


def test_packets_not_taken_are_bounded(opened: Open, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hapticbridge.device.transport.usb.MAX_PACKETS", 3)
    link = opened(Host(falcon()))
    enter_run_mode(link)
    taken, end = link.take(), time.monotonic() + LONGEST
    while not taken and time.monotonic() < end:
        time.sleep(0.1)  # the bridge reports its status every millisecond
        taken = link.take()
    assert 0 < len(taken) <= 3


def test_an_unplugged_device_is_lost_for_reading_and_writing(opened: Open) -> None:
    model = falcon()
    host = Host(model)
    link = opened(host)
    host.unplug(model)
    assert lost(link).startswith("FALCON HAPTIC (0403:cb48, serial FT000001) is gone: unplugged")
    with pytest.raises(DeviceLost, match="is gone"):
        link.write(question())
    with pytest.raises(DeviceLost, match="is gone"):
        link.control(9, 1)


def test_a_halted_endpoint_is_said_to_be_one(opened: Open) -> None:
    model = falcon()
    link = opened(Host(model))
    model.halted |= {READ_FROM}
    assert "has halted its endpoint" in lost(link)


def test_a_write_that_is_not_taken_in_time_is_no_loss_and_one_that_fails_is(opened: Open) -> None:
    host = Host(falcon())
    link = opened(host)
    host.fails["write"] = errno.ETIMEDOUT
    assert link.write(question()) is False
    del host.fails["write"]
    assert link.write(question()) is True
    host.fails["write"] = errno.EIO
    with pytest.raises(DeviceLost, match=r"fails: .*as told"):
        link.write(question())


def test_closing_twice_is_allowed_and_puts_the_interpreter_back(opened: Open) -> None:
    before = 5e-3  # Python's own
    sys.setswitchinterval(before)
    link, other = opened(Host(falcon())), opened(Host(falcon()))
    assert sys.getswitchinterval() <= 50e-6
    link.close()
    link.close()
    assert sys.getswitchinterval() <= 50e-6  # the other's
    other.close()
    assert sys.getswitchinterval() == pytest.approx(before)
    with pytest.raises(DeviceLost, match="is closed"):
        link.take()


def test_the_log_holds_every_byte_and_is_written_at_the_end(opened: Open, tmp_path: Path) -> None:
    path = tmp_path / "bytes.txt"
    link = opened(Host(falcon()), path)
    link.write(question())
    assert path.read_text() == ""
    link.close()
    assert f"> {question().tobytes().hex(' ')}" in path.read_text()


def test_a_falcon_runs_over_threads_on_the_wall_clock() -> None:
    model = falcon()
    device = open_falcon({"damping": 1.5}, ignore_message, Host(model))
    assert isinstance(device, FalconDevice)
    assert device.info.rate is not None
    sample, fresh = device.start(1e-3), 0
    end = time.monotonic() + LONGEST
    model.buttons = 5
    while fresh < 20 and time.monotonic() < end:
        fresh += device.read(sample) == 0
        device.write(np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
        time.sleep(1e-3)
    assert fresh == 20
    assert sample["buttons"][0] == 5
    assert sample.dtype == SAMPLE_DTYPE
    device.close()
    assert model.motors == (0, 0, 0)


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
def test_context_ends_last(order: tuple[int, ...], monkeypatch: pytest.MonkeyPatch) -> None:
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
