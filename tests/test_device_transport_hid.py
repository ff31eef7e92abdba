"""The link over hidapi on an emulated device, and its log."""

from __future__ import annotations

import importlib
import os
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from emulated.echo import EchoHid
from emulated.hid_seam import HidSeam
from emulated.spacemouse_model import SpaceMouse
from emulated.usb_device import StallError

from hapticbridge.device.driver import FoundDevice, UsbId
from hapticbridge.device.spacemouse import DRIVER
from hapticbridge.device.transport import hid as transport_hid
from hapticbridge.device.transport.hid import QUEUE, HidLink, find
from hapticbridge.device.transport.trace import VARIABLE, HexLog
from hapticbridge.errors import DeviceError, DeviceLost

ECHO = replace(DRIVER, name="echo", ids=(UsbId(EchoHid.vendor, EchoHid.product, "Echo"),))


def linked(device: EchoHid | None = None) -> tuple[HidLink, EchoHid, HidSeam]:
    device = device or EchoHid()
    seam = HidSeam(device)
    (plugged,) = find(ECHO, seam)
    return HidLink.open(plugged, seam, is_overlapped=False), device, seam


def test_reports_come_back_whole_and_in_order() -> None:
    link, _, _ = linked()
    for i in range(5):
        link.write(b"\0" + bytes([i]) * 64)
    assert link.take() == [bytes([i]) * 64 for i in range(5)]
    assert link.take() == []


def test_a_wait_ends_with_the_report_or_with_its_time() -> None:
    link, device, seam = linked()
    before = seam.now
    assert link.wait(3) == b""
    assert seam.now - before == pytest.approx(3e-3)
    device.push(b"x" * 64)
    assert link.wait(3) == b"x" * 64
    assert seam.now - before == pytest.approx(3e-3)


class Flood(EchoHid):
    def take_report(self) -> bytes | None:
        return bytes(64)


def test_a_device_that_floods_does_not_hold_the_loop() -> None:
    link, _, _ = linked(Flood())
    assert len(link.take()) == QUEUE + 1


def test_a_device_that_is_gone_is_lost_for_reads_waits_and_writes() -> None:
    for call in (HidLink.take, lambda link: link.wait(1), lambda link: link.write(b"\0")):
        link, device, seam = linked()
        seam.unplug(device)
        with pytest.raises(
            DeviceLost, match=r"report echo.* (is gone: unplugged|did not accept a)"
        ):
            call(link)
        link.close()
        link.close()


def test_a_closed_link_says_so_and_closes_twice() -> None:
    link, _, _ = linked()
    link.close()
    link.close()
    with pytest.raises(DeviceLost, match="is closed"):
        link.take()
    with pytest.raises(DeviceLost, match="is closed"):
        link.write(b"\0")


def test_what_cannot_be_opened_says_why() -> None:
    seam = HidSeam(EchoHid())
    (plugged,) = find(ECHO, seam)
    seam.plugged.clear()
    with pytest.raises(DeviceError, match="cannot be opened; it may be in use by another program"):
        HidLink.open(plugged, seam)


class Handle:
    """An open device whose writes take as long as the test lets them; nothing else answers."""

    def __init__(self) -> None:
        self.gate, self.entered = threading.Semaphore(0), threading.Semaphore(0)
        self.sent: list[bytes] = []
        self.result = 1
        self.is_closed = False

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return lambda *_: b"" if name.startswith(("read", "get")) else 0

    def write(self, data: bytes) -> int:
        self.entered.release()
        self.gate.acquire()
        self.sent.append(data)
        return self.result

    def close(self) -> None:
        self.is_closed = True


def slow(name: str = "slow", **options: Any) -> tuple[Any, HidLink]:
    handle: Any = Handle()
    return handle, HidLink(handle, name, **options)


def test_an_overlapped_write_does_not_wait_and_the_newest_report_wins() -> None:
    handle, link = slow()
    for i in range(4):
        link.write(bytes([i]))
        if i == 0:
            handle.entered.acquire()
    handle.gate.release(2)
    link.close()
    assert handle.sent == [b"\0", b"\x03"]
    assert handle.is_closed


def test_of_each_kind_the_newest_report_is_sent_and_kinds_take_turns() -> None:
    handle, link = slow(slots=2)
    link.write(b"a0")
    handle.entered.acquire()
    for report, slot in ((b"a1", 0), (b"b1", 1), (b"a2", 0), (b"b2", 1)):
        link.write(report, slot)
    handle.gate.release(3)
    link.close()
    assert handle.sent == [b"a0", b"b2", b"a2"]


def test_set_up_is_sent_at_once_and_what_waited_is_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transport_hid, "MAX_WRITE", 10.0)
    gates: list[threading.Semaphore] = []

    class Opened(threading.Event):
        def wait(self, timeout: float | None = None) -> bool:
            if timeout is not None:  # only now, when what waits has been dropped
                gates[0].release(10)
            return super().wait(timeout)

    monkeypatch.setattr(threading, "Event", Opened)
    handle, link = slow()
    gates.append(handle.gate)
    link.write(b"old")
    handle.entered.acquire()
    link.write(b"waits")
    link.send(b"set-up")
    assert handle.sent == [b"old", b"set-up"]
    handle.result = -1
    with pytest.raises(DeviceLost, match="slow did not accept a report"):
        link.send(b"set-up")
    link.close()


def test_requests_that_fail_have_an_empty_answer() -> None:
    class Refusing(EchoHid):
        def set_feature(self, report: bytes, now: float) -> None:
            raise StallError

    link, device, seam = linked()
    requests = link.requests
    assert requests.set_feature(b"\0feature!")
    assert requests.feature(0, 9) == b"feature!"
    assert requests.report_descriptor() == device.report_descriptor
    assert requests.input_report(0, 65) == b""
    assert not linked(Refusing())[0].requests.set_feature(b"\0x")
    seam.unplug(device)
    assert (requests.feature(0, 9), requests.report_descriptor()) == (b"", b"")


def test_a_device_that_takes_no_report_any_more_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transport_hid, "MAX_WRITE", 0.0)
    handle, link = slow("stuck")
    link.write(b"a")
    handle.entered.acquire()
    with pytest.raises(DeviceLost, match="stuck accepts no reports any more"):
        link.write(b"b")
    link.close()
    assert not handle.is_closed  # the thread is still inside hidapi, which uses what this frees
    handle.gate.release()


def test_a_failed_overlapped_write_is_told_by_the_next_call() -> None:
    handle, link = slow("gone")
    handle.result = -1
    handle.gate.release()
    link.write(b"a")
    end = time.monotonic() + 5.0
    with pytest.raises(DeviceLost, match="gone is gone: it did not accept a report"):
        while time.monotonic() < end:
            link.take()
    with pytest.raises(DeviceLost, match="gone is gone: it did not accept a report"):
        link.write(b"b")
    link.close()
    assert handle.is_closed


def test_closing_sends_the_last_report_first() -> None:
    handle, link = slow()
    handle.gate.release(10)
    link.write(b"zero force")
    link.close()
    assert handle.sent[-1] == b"zero force"


def test_log_holds_what_went_over_wire(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, str(tmp_path / "wire.log"))
    seam = HidSeam(EchoHid())
    (plugged,) = find(ECHO, seam)
    link = HidLink.open(plugged, seam, is_overlapped=False, log=HexLog())
    link.write(b"\0" + b"\x12" * 64)
    link.take()
    assert (tmp_path / "wire.log").read_text() == ""
    link.close()
    first, second = (tmp_path / "wire.log").read_text().splitlines()
    assert first.split(" ", 2)[1:] == [">", "00 " + " ".join(["12"] * 64)]
    assert second.split(" ", 2)[1:] == ["<", " ".join(["12"] * 64)]


def test_full_log_keeps_newest_and_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hapticbridge.device.transport.trace.MAX_LINES", 2)
    log = HexLog(tmp_path / "wire.log")
    for i in range(5):
        log.add(">", bytes([i]))
    log.close()
    lines = (tmp_path / "wire.log").read_text().splitlines()
    assert lines[0] == "# 3 transfers before these were not kept"
    assert [line[-2:] for line in lines[1:]] == ["03", "04"]


def test_unwritten_log_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(DeviceError, match=r"the log .* cannot be written: No such file"):
        HexLog(tmp_path / "no" / "wire.log")
    monkeypatch.delenv(VARIABLE, raising=False)
    off = HexLog()
    off.add("<", b"\0")
    off.close()
    assert not off.is_on


def test_find_lists_only_the_family_and_one_entry_per_node() -> None:
    seam = HidSeam(EchoHid("A"), SpaceMouse(), EchoHid("B"))
    assert [device.serial for device in find(ECHO, seam)] == ["A", "B"]
    entries = seam.enumerate()
    twice = type("Twice", (), {"enumerate": lambda self: [*entries, *entries]})()
    assert len(find(ECHO, twice)) == 2


class Listing:
    """hidapi as a module that lists one device at a path."""

    def __init__(self, path: str) -> None:
        self.path = path

    def enumerate(self, vendor_id: int = 0, product_id: int = 0) -> list[dict[str, object]]:
        ids = {"vendor_id": EchoHid.vendor, "product_id": EchoHid.product}
        words = {"product_string": None, "serial_number": None}
        return [{"path": self.path.encode(), **ids, **words, "usage_page": 1, "usage": 1}]


@pytest.mark.parametrize("is_permitted", [True, False])
def test_forbidden_node_is_listed_with_remedy(
    is_permitted: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    node = str(tmp_path / "hidraw3")
    Path(node).touch()
    monkeypatch.setattr(transport_hid, "hid_api", lambda: Listing(node))
    monkeypatch.setattr(os, "access", lambda path, mode: is_permitted)
    (device,) = find(ECHO)
    assert (device.name, device.serial, device.path) == ("Echo", "", node)
    assert (device.problem is None) == is_permitted
    if not is_permitted:
        remedy = f"no permission to open {node}; 'hapticbridge devices"
        assert str(device.problem).startswith(remedy)
        with pytest.raises(DeviceError, match="no permission to open"):
            HidLink.open(device)


NOWHERE = FoundDevice(
    driver="rawhid", name="none", serial="", path="/dev/hidraw99", vendor=1, product=2,
    transport="hid", problem=None,
)  # fmt: skip


def test_without_hidapi_nothing_is_found_or_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transport_hid, "hid_api", lambda: None)
    assert find(ECHO) == []
    with pytest.raises(DeviceError, match="hidapi is not installed"):
        HidLink.open(NOWHERE)


def test_hidapi_is_the_hidraw_module_where_there_is_one(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def load(name: str) -> object:
        asked.append(name)
        raise ImportError

    monkeypatch.setattr(importlib, "import_module", load)
    for platform, names in (("linux", ["hidraw", "hid"]), ("darwin", ["hid"])):
        asked.clear()
        monkeypatch.setattr(sys, "platform", platform)
        assert transport_hid.hid_api() is None
        assert asked == names


def test_a_read_through_the_real_module_of_a_node_that_is_not_there_is_refused() -> None:
    assert transport_hid.hid_api() is not None
    with pytest.raises(DeviceError, match="cannot be opened"):
        HidLink.open(NOWHERE)
