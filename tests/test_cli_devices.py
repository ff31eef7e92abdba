"""``hapticbridge devices``: devices that are plugged in, access to them, and what helps."""

from __future__ import annotations

import json
import os
import re
import socket
from pathlib import Path

import pytest
from cli_cases import Called
from emulated.hid_seam import HidSeam
from emulated.pid_model import PidStick
from emulated.rawhid_model import RawHid

from hapticbridge import Bridge, SimulatedClock
from hapticbridge.cli import devices as command
from hapticbridge.device import force_dimension, haply
from hapticbridge.device.discovery import plugged_devices, udev_rules
from hapticbridge.device.driver import (
    RULES_COMMAND,
    Driver,
    FoundDevice,
    access_problem,
)
from hapticbridge.device.rawhid import serial
from hapticbridge.device.registry import all_drivers
from hapticbridge.device.touch import servo
from hapticbridge.device.transport import hid as hid_search
from hapticbridge.device.transport import usb as usb_bus
from hapticbridge.device.transport import usb as usb_search
from hapticbridge.errors import DeviceError


def plug(
    bus: Path, place: str, usb_id: str, *, name: str = "", serial: str = "", hidraw: bool = False
) -> None:
    """Writes what the kernel's sysfs shows of a device."""
    folder = bus / place
    folder.mkdir(parents=True)
    vendor, product = usb_id.split(":")
    facts = {"idVendor": vendor, "idProduct": product, "busnum": "1", "devnum": str(len(place))}
    for key, value in {**facts, "product": name, "serial": serial}.items():
        if value:
            (folder / key).write_text(value + "\n")
    if hidraw:
        node = folder / f"{place}:1.0" / f"0003:{vendor}:{product}.0001" / "hidraw" / "hidraw0"
        node.mkdir(parents=True)


@pytest.fixture(name="bus")
def _bus(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty USB bus, without hidapi and libusb seeing anything real."""
    bus = tmp_path / "devices"
    bus.mkdir()
    (bus / "1-0:1.0").mkdir()  # an interface: no device
    monkeypatch.setattr(usb_bus, "BUS", bus)
    monkeypatch.setattr(usb_search, "libusb", lambda: None)
    monkeypatch.setattr(hid_search, "hid_api", Nothing)
    return bus


class Nothing:
    def enumerate(self, vendor_id: int = 0, product_id: int = 0) -> list[dict[str, object]]:
        return []


def test_what_a_device_calls_itself_cannot_steer_a_terminal() -> None:
    plugged = FoundDevice(
        driver="rawhid",
        name="a\x1b[31mb\n",
        serial="\x071\u202e2",
        path="/dev/hidraw0",
        vendor=1,
        product=2,
        transport="hid",
        problem=None,
    )
    assert (plugged.name, plugged.serial) == ("a\ufffd[31mb\ufffd", "\ufffd1\ufffd2")


def test_a_spacenavigator_without_a_node_is_listed_with_the_module_it_wants(
    call: Called, bus: Path
) -> None:
    plug(bus, "1-1", "046d:c626", name="SpaceNavigator")
    plug(bus, "1-10", "16c0:0486", name="Teensyduino RawHID", serial="77", hidraw=True)
    plug(bus, "1-1000", "256f:c654", name="CadMouse")
    code, out, _ = call("devices")
    assert code == 0
    assert "not usable       SpaceNavigator (046d:c626) at /dev/bus/usb/001/003" in out
    assert "'sudo modprobe hid_logitech'" in out
    assert "CadMouse" not in out
    assert "Teensyduino RawHID" not in out  # it has a node: hidapi lists it, where it is there


def listed(problem: str | None, serial: str = "", *, is_refused: bool = False) -> FoundDevice:
    return FoundDevice(
        driver="rawhid", name="[red]Te\x1bensy", serial=serial, path="/dev/hidraw0", vendor=0x16C0,
        product=0x0486, transport="hid", problem=problem, lacks_permission=is_refused,
    )  # fmt: skip


def port(problem: str | None) -> FoundDevice:
    return FoundDevice(
        driver="serial", name="Arduino Uno", serial="A1", path="/dev/ttyACM0", vendor=0x2341,
        product=0x43, transport="serial", problem=problem,
    )  # fmt: skip


def mouse(problem: str | None) -> FoundDevice:
    return FoundDevice(
        driver="spacemouse", name="SpaceMouse", serial="", path="/dev/hidraw1", vendor=0x256F,
        product=0xC635, transport="hid", problem=problem,
    )  # fmt: skip


def test_serial_ports_and_boards_of_any_vendor_get_a_rule_each(
    bus: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seam = HidSeam(RawHid())
    seam.plugged[0].vendor, seam.plugged[0].product = 0x303A, 0x4004
    monkeypatch.setattr(hid_search, "hid_api", lambda: seam)
    monkeypatch.setattr(serial.SystemPorts, "found", lambda _: [port(None), port(None)])
    rules = [line for line in udev_rules().splitlines() if line.startswith("SUBSYSTEM")]
    assert rules.count(
        'SUBSYSTEM=="tty", ATTRS{idVendor}=="2341", ATTRS{idProduct}=="0043", '
        'ENV{ID_MM_DEVICE_IGNORE}="1", TAG+="uaccess"'
    ) == 1  # fmt: skip
    for numbers in ("16C0:0486", "303A:4004"):
        rule = f'SUBSYSTEM=="hidraw", KERNELS=="*:{numbers}.*", TAG+="uaccess"'
        assert rules.count(rule) == 1


@pytest.mark.parametrize(
    ("plugged", "words"),
    [
        ([listed(None)], "  next: hapticbridge identify rawhid, and let go of it\n"),
        (
            [listed(None, "A"), listed(None, "B")],
            "next: hapticbridge identify rawhid:serial=A, and",
        ),
        ([mouse(None)], "  next: hapticbridge run peg_in_hole --device spacemouse\n"),
        (
            [listed(None, is_refused=True)],
            "local users of the machine\n  next: hapticbridge devices",
        ),
        # no rule would help, and one of two can be used
        ([listed("no node"), listed(None, "B")], "next: hapticbridge identify rawhid:serial=B"),
        ([listed("no node")], "  not usable: no node\n"),
        ([listed("no node")], "\nnext: hapticbridge run peg_in_hole --device mouse\n"),
        ([], "\nnext: hapticbridge run peg_in_hole --device mouse\n"),
        ([port(None)], "next: hapticbridge identify serial:/dev/ttyACM0, and let go"),
        ([port(None), listed(None)], "identify rawhid, and let go of it\n"),
    ],
)
def test_it_says_what_to_do_next(
    call: Called, monkeypatch: pytest.MonkeyPatch, plugged: list[FoundDevice], words: str
) -> None:
    monkeypatch.setattr(command, "plugged_devices", lambda: plugged)
    code, out, _ = call("devices")
    assert code == 0
    assert words in out
    is_refused = any(RULES_COMMAND in (device.problem or "") for device in plugged)
    assert ("udevadm" in out) is is_refused
    assert ("--device mouse" in out) is not (is_refused or any(d.problem is None for d in plugged))
    rows = [line.split()[0] for line in out.splitlines() if line[0] != " "]
    first = [device.driver for device in plugged]
    assert rows[: len(first) + 4] == ["device", *first, "simulated", "trajectory", "mouse"]
    for device in plugged:
        assert f"{device} at {device.path}\n".replace("\x1b", "�") in out
    assert f"permissions on Linux: {RULES_COMMAND} | sudo tee /etc/udev/rules.d/70-" in out
    assert "to add one by name: hapticbridge guide device-package\n" in out
    for head in ("to build one: ", "; firmware: "):
        path = re.split(r"[;\n]", out.partition(head)[2])[0]
        assert Path(path).is_absolute()  # what a pip user has
        assert Path(path).exists()
    code, out, _ = call("devices", "--json")
    told = [device["next"] for device in json.loads(out)["plugged"]]
    assert [device.problem is None or RULES_COMMAND in device.problem for device in plugged] == [
        bool(command) for command in told
    ]


def test_a_usb_device_is_listed_by_the_kernels_word_where_libusb_is_missing(bus: Path) -> None:
    plug(bus, "1-1", "0403:cb48", name="FALCON HAPTIC", serial="FT000001")
    (device,) = plugged_devices()
    assert (device.driver, device.name, device.serial) == ("falcon", "FALCON HAPTIC", "FT000001")
    assert device.problem is not None
    assert "libusb cannot be loaded" in device.problem


def test_a_hid_device_is_listed_by_the_kernels_word_where_hidapi_is_missing(
    call: Called, bus: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plug(bus, "1-1", "16c0:0486", name="RawHID", serial="77", hidraw=True)
    assert plugged_devices() == []  # where hidapi is there, it lists what has a node
    monkeypatch.setattr(hid_search, "hid_api", lambda: None)
    (device,) = plugged_devices()
    assert (device.driver, device.serial) == ("rawhid", "77")
    code, _, err = call("run", "peg_in_hole", "--device", "rawhid")
    assert code == 2
    assert "hidapi cannot be loaded; 'pip install hidapi' installs it" in err


@pytest.mark.parametrize(
    ("is_there", "is_permitted", "words"),
    [
        (True, True, None),
        (True, False, "no permission to open"),
        (False, False, "no node "),  # as root, who may open all that there is
    ],
)
def test_a_node_that_is_not_there_yet_is_no_missing_permission(
    is_there: bool,
    is_permitted: bool,
    words: str | None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    node = tmp_path / "hidraw0"
    if is_there:
        node.touch()
    monkeypatch.setattr(os, "access", lambda path, mode: is_permitted)
    problem = access_problem(str(node))
    assert (problem or "").startswith(words or "")
    assert (problem is None) is (words is None)


def test_the_bus_is_read_without_opening_anything(bus: Path) -> None:
    plug(bus, "1-1", "16c0:0486", name="RawHID", serial="77", hidraw=True)
    plug(bus, "1-22", "046d:c626")
    (bus / "1-3").mkdir()
    (bus / "1-3" / "idVendor").write_text("zz\n")
    first, second = usb_bus.on_the_bus()
    assert (first.vendor, first.product) == (0x16C0, 0x486)
    assert (first.name, first.serial) == ("RawHID", "77")
    assert (first.has_hidraw, second.has_hidraw, second.name) == (True, False, "")
    assert str(second.node) == "/dev/bus/usb/001/004"


@pytest.mark.parametrize(
    "family", [f for f in all_drivers() if f.find is None], ids=lambda family: family.name
)
def test_running_on_a_device_that_is_not_there_is_one_sentence_that_helps(
    call: Called, family: Driver, bus: Path
) -> None:
    code, out, err = call("run", "peg_in_hole", "--device", family.name)
    assert (code, out) == (2, "")
    assert err.count("\n") == 1
    assert err.startswith(f"error: no device '{family.name}' is plugged in (looked for ")
    assert "'hapticbridge devices' lists connected devices and missing permissions" in err


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("haply", "the Inverse Service does not run: no answer at localhost:"),
        ("forcedimension", "the library '/no/such.so' cannot be loaded"),
        ("touch", "the library '/no/such.so' cannot be loaded"),
    ],
)
def test_what_stands_between_us_and_a_device_is_said_to_be_missing(
    call: Called, monkeypatch: pytest.MonkeyPatch, bus: Path, name: str, words: str
) -> None:
    for variable in (force_dimension.FILES.variable, servo.FILES.variable):
        monkeypatch.setenv(variable, "/no/such.so")
    with socket.socket() as unused:
        unused.bind(("localhost", 0))  # nobody listens there
        place = ("localhost", unused.getsockname()[1])
        monkeypatch.setattr(haply, "PLACE", place)
        monkeypatch.setattr(haply.medium, "__defaults__", (place,))
        monkeypatch.setattr(haply.find, "__defaults__", (place,))
        code, out, err = call("run", "peg_in_hole", "--device", name)
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert err.startswith(f"error: {words}")
        code, out, _ = call("devices")
        assert code == 0
        assert f"  {words}" in out
        code, out, _ = call("devices", "--json")
    told = {f["name"]: f["medium"] for f in json.loads(out)["supported"]}
    assert told[name].startswith(words)
    assert told["rawhid"] is None


def test_a_class_gets_a_rule_for_each_product_that_is_plugged_in(
    bus: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "# pid: " in udev_rules()
    assert "# none is connected: plug it in, and write these rules again" in udev_rules()
    seam = HidSeam(PidStick(serial="A"), PidStick(serial="B"), PidStick())
    seam.plugged[2].product = 0x4802
    monkeypatch.setattr(hid_search, "hid_api", lambda: seam)
    plugged = plugged_devices()
    assert [(one.driver, one.serial, one.product) for one in plugged] == [
        ("pid", "A", 0x4801),
        ("pid", "B", 0x4801),
        ("pid", "P1", 0x4802),
    ]
    rules = [line for line in udev_rules().splitlines() if "*:1209:" in line]
    assert rules == [
        f'SUBSYSTEM=="hidraw", KERNELS=="*:1209:480{n}.*", TAG+="uaccess"' for n in (1, 2)
    ]


def test_how_often_a_device_is_asked_is_read_where_the_kernel_shows_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hid_search, "CLASS", tmp_path / "class")
    interface = tmp_path / "1-1:1.0"
    hid = interface / "0003:1209:4801.0001"
    hid.mkdir(parents=True)
    (hid / "report_descriptor").write_bytes(b"\x05\x01")
    (tmp_path / "class/hidraw3").mkdir(parents=True)
    (tmp_path / "class/hidraw3/device").symlink_to(hid)
    assert hid_search.polling("/dev/hidraw3") == (None, None)
    for name, direction, interval in (("ep_81", "in", "8ms"), ("ep_01", "out", "125us")):
        (interface / name).mkdir()
        (interface / name / "direction").write_text(direction + "\n")
        (interface / name / "interval").write_text(interval + "\n")
    assert hid_search.polling("/dev/hidraw3") == pytest.approx((8e-3, 125e-6))
    assert hid_search.report_descriptor("/dev/hidraw3", None) == b"\x05\x01"
    assert hid_search.report_descriptor("/dev/hidraw4", None) == b""
    assert hid_search.polling("/dev/hidraw4") == (None, None)


@pytest.mark.parametrize("family", all_drivers(), ids=lambda family: family.name)
def test_hardware_and_fast_are_refused_together_before_anything_is_opened(
    call: Called, monkeypatch: pytest.MonkeyPatch, family: Driver
) -> None:
    def opened(*_: object, **__: object) -> None:
        raise AssertionError("it was opened first, and its user asked to home it")

    for module in ("hapticbridge.cli.run", "hapticbridge.run.options"):
        monkeypatch.setattr(f"{module}.device_for", opened)
    code, out, err = call("run", "point_mass", "--fast", "--device", f"{family.name}:serial=1")
    assert (code, out) == (2, "")
    assert "moves in real time" in err
    assert "leave out --fast" in err
    with pytest.raises(DeviceError, match=rf"the device '{family.name}' moves in real time"):
        Bridge("point_mass", family.name, clock=SimulatedClock())
    with pytest.raises(AssertionError, match="opened first"):
        call("run", "point_mass", "--device", family.name)
