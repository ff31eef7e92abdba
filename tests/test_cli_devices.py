from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
from cli_cases import Called

from hapticbridge.cli import devices as command
from hapticbridge.device import hid_search, usb_bus, usb_search
from hapticbridge.device.families import FAMILIES, RULES_FILE, plugged_devices, udev_rules
from hapticbridge.device.plugged import Family, Plugged


def plug(
    bus: Path,
    place: str,
    usb_id: str,
    *,
    name: str = "",
    serial: str = "",
    hidraw: bool = False,
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


def test_devices_never_fails_on_a_machine_without_usb(
    call: Called, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(usb_bus, "BUS", tmp_path / "no" / "bus")
    monkeypatch.setattr(usb_search, "libusb", lambda: None)
    monkeypatch.setattr(hid_search, "hid_api", lambda: None)
    code, out, err = call("devices")
    assert (code, err) == (0, "")
    for family in FAMILIES:
        assert f"{family.name}: {family.about}" in out
    assert "none; 'simulated' and 'trajectory:FILE' need none" in out
    assert "hidapi cannot be loaded, so HID devices are not seen" in out


def test_devices_runs_on_this_machine_whatever_it_has(call: Called) -> None:
    code, out, _ = call("devices", "--json")
    facts = json.loads(out)
    assert code == 0
    assert [family["name"] for family in facts["supported"]] == [f.name for f in FAMILIES]
    assert facts["plugged"] == json.loads(json.dumps([vars_of(d) for d in plugged_devices()]))


def vars_of(device: Plugged) -> dict[str, object]:
    return {name: getattr(device, name) for name in Plugged.__dataclass_fields__}


def test_a_spacenavigator_without_a_node_is_listed_with_the_module_it_wants(
    call: Called, bus: Path
) -> None:
    plug(bus, "1-1", "046d:c626", name="SpaceNavigator")
    plug(bus, "1-10", "16c0:0486", name="Teensyduino RawHID", serial="77", hidraw=True)
    plug(bus, "1-1000", "256f:c654", name="CadMouse")
    code, out, _ = call("devices")
    assert code == 0
    assert "spacemouse: SpaceNavigator (046d:c626) at /dev/bus/usb/001/003" in out
    assert "'sudo modprobe hid_logitech'" in out
    assert "CadMouse" not in out
    assert "Teensyduino RawHID" not in out  # it has a node: hidapi lists it, where it is there


def listed(problem: str | None, serial: str = "") -> Plugged:
    return Plugged(
        family="rawhid", name="[red]Te\x1bensy", serial=serial, path="/dev/hidraw0", vendor=0x16C0,
        product=0x0486, transport="hid", problem=problem,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("plugged", "words"),
    [
        ([listed(None)], "next: hapticbridge run peg_in_hole --device rawhid\n"),
        ([listed(None, "A"), listed(None, "B")], "--device rawhid:serial=A\n"),
        (
            [listed("no permission")],
            "  not usable: no permission\nnext: hapticbridge devices",
        ),
    ],
)
def test_it_says_what_to_do_next(
    call: Called, monkeypatch: pytest.MonkeyPatch, plugged: list[Plugged], words: str
) -> None:
    monkeypatch.setattr(command, "plugged_devices", lambda: plugged)
    code, out, _ = call("devices")
    assert code == 0
    assert words in out
    assert f"rawhid: {plugged[0]}".replace("\x1b", "�") in out


def test_the_rules_name_every_product_once_and_sort_before_the_seat(call: Called) -> None:
    code, out, _ = call("devices", "--udev-rules")
    assert (code, out) == (0, udev_rules())
    rules = [line for line in out.splitlines() if line and not line.startswith("#")]
    assert len(rules) == len(set(rules)) == sum(len(family.ids) for family in FAMILIES)
    assert all(rule.endswith('TAG+="uaccess"') for rule in rules)
    for family in FAMILIES:
        for usb_id in family.ids:
            if family.transport == "hid":
                match = f'SUBSYSTEM=="hidraw", KERNELS=="*:{str(usb_id).upper()}.*"'
            else:
                vendor, product = str(usb_id).split(":")
                match = f'ATTR{{idVendor}}=="{vendor}", ATTR{{idProduct}}=="{product}"'
            assert sum(match in rule for rule in rules) == 1
    assert Path(RULES_FILE).name < "73-seat-late.rules"
    assert RULES_FILE in out


def test_a_usb_device_is_listed_by_the_kernels_word_where_libusb_is_missing(bus: Path) -> None:
    plug(bus, "1-1", "0403:cb48", name="FALCON HAPTIC", serial="FT000001")
    (device,) = plugged_devices()
    assert (device.family, device.name, device.serial) == ("falcon", "FALCON HAPTIC", "FT000001")
    assert device.problem is not None
    assert "libusb cannot be loaded" in device.problem


def test_the_bus_is_read_without_opening_anything(
    bus: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plug(bus, "1-1", "16c0:0486", name="RawHID", serial="77", hidraw=True)
    plug(bus, "1-22", "046d:c626")
    (bus / "1-3").mkdir()
    (bus / "1-3" / "idVendor").write_text("zz\n")
    first, second = usb_bus.on_the_bus()
    assert (first.vendor, first.product) == (0x16C0, 0x486)
    assert (first.name, first.serial) == ("RawHID", "77")
    assert (first.has_hidraw, second.has_hidraw, second.name) == (True, False, "")
    assert str(second.node) == "/dev/bus/usb/001/004"
    for answer in (True, False):
        monkeypatch.setattr(os, "access", lambda path, mode, answer=answer: answer)
        assert first.is_permitted is answer


@pytest.mark.parametrize("family", FAMILIES, ids=lambda family: family.name)
def test_running_on_a_device_that_is_not_there_is_one_sentence_that_helps(
    call: Called, family: Family, bus: Path
) -> None:
    code, out, err = call("run", "peg_in_hole", "--device", family.name)
    assert (code, out) == (2, "")
    assert err.count("\n") == 1
    assert err.startswith(f"error: no device '{family.name}' is plugged in (looked for ")
    assert "'hapticbridge devices' lists what is, and what permission is missing" in err
