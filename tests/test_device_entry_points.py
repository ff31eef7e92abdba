"""Devices of other packages: the guide's template as it stands, and packages that are broken."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from cli_cases import Called

import hapticbridge as hb
from hapticbridge.device import Device, open_device
from hapticbridge.device.discovery import blind_spots
from hapticbridge.device.driver import Notify
from hapticbridge.device.registry import all_drivers, driver_named, is_driver
from hapticbridge.errors import DeviceError
from hapticbridge.testing.device_contract import CONTRACT, Check

GUIDE = Path(hb.__file__).parent / "guide/device_package.md"


def blocks() -> dict[str, str]:
    """Returns the guide's files by name."""
    text = GUIDE.read_text(encoding="utf-8")
    return dict(re.findall(r"\n`([\w.]+)`[^\n]*:\n\n```\w+\n(.*?)```", text, re.DOTALL))


def install(folder: Path, points: str, **modules: str) -> None:
    """Writes a package as pip would have installed it."""
    info = folder / "hapticbridge_rail-0.1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: hapticbridge-rail\nVersion: 0.1.0")
    (info / "entry_points.txt").write_text(points)
    for name, text in modules.items():
        (folder / f"{name}.py").write_text(text)


@pytest.fixture(name="rail")
def _rail(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = blocks()
    table = files["pyproject.toml"].partition('[project.entry-points."hapticbridge.devices"]\n')[2]
    points = "[hapticbridge.devices]\n" + table.replace('"', "")
    install(tmp_path, points, hapticbridge_rail=files["hapticbridge_rail.py"])
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "hapticbridge_rail", raising=False)


def test_the_template_is_a_page_long() -> None:
    module = blocks()["hapticbridge_rail.py"]
    assert 40 <= len([line for line in module.splitlines() if line]) <= 60


@pytest.mark.usefixtures("rail")
@pytest.mark.parametrize("check", CONTRACT, ids=lambda check: check.__name__)
def test_the_template_fulfils_the_contract(check: Callable[[Device], None]) -> None:
    check(open_device("rail"))


@pytest.mark.parametrize("check", CONTRACT, ids=lambda check: check.__name__)
def test_the_class_of_the_guide_to_a_device_in_python_fulfils_the_contract(check: Check) -> None:
    text = (GUIDE.parent / "own_device.md").read_text(encoding="utf-8")
    [program] = re.findall(r"\n```python\n(.*?)\nwith hb.Bridge", text, re.DOTALL)
    names: dict[str, Any] = {}
    exec(program, names)
    check(names["Rail"](), clock=hb.SimulatedClock())


@pytest.mark.usefixtures("rail")
def test_the_template_is_listed_opened_and_run_by_its_name(call: Called) -> None:
    code, out, _ = call("devices")
    assert code == 0
    assert "a handle on a rail" in out
    assert open_device("rail:damping=3").info.damping == 3.0
    with pytest.raises(DeviceError, match="unknown option 'colour' of the rail device; choose"):
        open_device("rail:colour=red")
    with pytest.raises(
        DeviceError, match=r"unknown device 'ral'; did you mean 'rail'. choose one of .*'rail'"
    ):
        open_device("ral")
    names: dict[str, object] = {}
    exec(blocks()["test_rail.py"], names)
    assert "test_the_rail_fulfils_the_contract" in names


@pytest.mark.usefixtures("rail")
def test_a_device_of_a_package_runs_in_the_time_that_its_data_sheet_allows(
    call: Called, monkeypatch: pytest.MonkeyPatch
) -> None:
    code, out, err = call("run", "point_mass", "--device", "rail", "--fast", "--duration", "0.1")
    assert code == 0, err
    assert "passive, and certified" in out
    with hb.Bridge("point_mass", "rail", clock=hb.SimulatedClock()) as bridge:
        bridge.run(duration=0.1)
    module = sys.modules["hapticbridge_rail"]

    def open_real(options: Mapping[str, object], _notify: Notify) -> Device:
        device: Device = module.Rail(**options)
        device.info = replace(device.info, is_real=True)
        return device

    monkeypatch.setattr(module, "DRIVER", replace(module.DRIVER, open=open_real))
    code, _, err = call("run", "point_mass", "--device", "rail", "--fast", "--duration", "0.1")
    assert code == 2
    assert "the device 'rail' moves in real time" in err


@pytest.mark.usefixtures("rail")
def test_the_guides_command_runs_the_template(call: Called, tmp_path: Path) -> None:
    (line,) = re.findall(r"\nhapticbridge (run .*)\n", GUIDE.read_text(encoding="utf-8"))
    code, out, err = call(*line.replace("rail.mcap", str(tmp_path / "rail.mcap")).split())
    # in real time, which a busy machine may not keep
    assert code == 0 or (code == 1 and "did not keep its time" in out), err
    assert "next: hapticbridge audit" in out


PACKAGE = """
import numpy as np
from hapticbridge import SAMPLE_DTYPE, DeviceInfo
from hapticbridge.device.driver import Driver, FoundDevice

class Rail:
    info = DeviceInfo(name="rail", axes=("x",), force_limit=10.0, is_real=False)

    def start(self, period):
        sample = np.zeros(1, SAMPLE_DTYPE)
        sample["quaternion"][0, 0] = 1.0
        return {start}

    def read(self, sample):
        sample[0] = (0, 0, 0), (1, 0, 0, 0), 0
        return {read}

    def write(self, wrench):
        {write}

    def close(self):
        {close}

DRIVER = Driver(
    name="rail", about="", ids=(), transport="library", axes="", force="", rate="", options={{}},
    products="a rail", find=lambda: {find}, medium=lambda: {medium},
    open=lambda options, notify: {open},
)
"""
SOUND = {
    "start": "sample", "read": "0", "write": "pass", "close": "pass", "find": "[]", "medium": "''",
    "open": "Rail()",
}  # fmt: skip
OTHER = "[FoundDevice(driver='x', name='x', serial='', path='', transport='hid')]"


@pytest.mark.parametrize(
    ("command", "function", "body", "words"),
    [
        ("devices", "find", "1 / 0", "rail: find failed with ZeroDivisionError"),
        ("devices", "find", "None", "rail: find failed with TypeError"),
        ("devices", "find", OTHER, "it must list FoundDevice with the driver 'rail'"),
        ("devices", "medium", "1 / 0", "rail: medium failed with ZeroDivisionError"),
        ("run", "open", "1 / 0", "rail: open failed with ZeroDivisionError"),
        ("run", "open", "None", "open failed with TypeError: it must return a device, and what"),
        ("run", "start", "1 / 0", "device 'rail': start failed with ZeroDivisionError"),
        ("run", "start", "np.zeros(3)", "start returned array([0., 0., 0.]); it must be an array"),
        ("run", "close", "1 / 0", "device 'rail': close failed with ZeroDivisionError"),
        ("identify", "start", "1 / 0", "device 'rail': start failed with ZeroDivisionError"),
        ("identify", "read", "1 / 0", "device 'rail': read failed with ZeroDivisionError"),
        ("identify", "write", "1 / 0", "device 'rail': write failed with ZeroDivisionError"),
        ("identify", "close", "1 / 0", "device 'rail': close failed with ZeroDivisionError"),
    ],
)
def test_a_fault_of_another_packages_device_is_one_sentence(
    call: Called,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    command: str,
    function: str,
    body: str,
    words: str,
) -> None:
    text = PACKAGE.format(**{**SOUND, function: body})
    install(tmp_path, "[hapticbridge.devices]\nrail = faulty:DRIVER", faulty=text)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "faulty", raising=False)
    options = {
        "devices": [],
        "run": ["point_mass", "--device", "rail", "--duration", "0.01"],
        "identify": ["rail", "--duration", "2"],
    }
    code, out, err = call(command, *options[command])
    assert code == (0 if command == "devices" else 2)
    told = " ".join((out + err).split())
    assert words in told.replace("the device 'rail' of the package hapticbridge-rail", "rail")


@pytest.mark.parametrize(
    ("value", "module", "words"),
    [
        ("broken:DRIVER", "1 / 0", "cannot be imported: ZeroDivisionError: division by zero"),
        ("broken:DRIVER", "", "cannot be imported: AttributeError"),
        ("missing:DRIVER", "", "cannot be imported: ModuleNotFoundError"),
        ("broken:DRIVER", "raise SystemExit('bye')", "cannot be imported: SystemExit: bye"),
        ("broken:DRIVER", "DRIVER = 7", "names broken:DRIVER as the device 'rail'; it must be a"),
    ],
)
def test_a_broken_package_costs_its_own_device_only(
    call: Called,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    value: str,
    module: str,
    words: str,
) -> None:
    install(tmp_path, f"[hapticbridge.devices]\nrail = {value}\nmouse = {value}", broken=module)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "broken", raising=False)
    with pytest.raises(DeviceError, match=f"the .*hapticbridge-rail.*{words}"):
        open_device("rail")
    assert [driver.name for driver in all_drivers()].count("mouse") == 1
    assert [spot for spot in blind_spots() if words in spot.sentence]
    code, out, err = call("devices")
    assert code == 0
    assert words.partition(":")[0] in " ".join((out + err).split())
    assert open_device("mouse").info.name == "mouse"  # a name of ours is not replaced


def test_without_other_packages_there_are_our_own_names_alone() -> None:
    assert (driver_named("rail"), driver_named("simulated")) == (None, None)
    assert [is_driver(name) for name in ("falcon", "simulated", "rail", "")] == [True] + [False] * 3
