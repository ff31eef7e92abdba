"""Commands and devices without what only Linux has: a stand-in for macOS and Windows.

The modules of hapticbridge see ``os``, ``signal``, ``time`` and ``select`` as they are there
(``other_system/sitecustomize.py``), in the children too. No real macOS or Windows is behind it.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

TESTS = Path(__file__).parent
SYSTEMS = ("darwin", "win32")

EMULATED = """
from device_benches import opened_rawhid
from emulated.hid_seam import DrivingClock, HidSeam
from emulated.rawhid_model import RawHid
from emulated.spacemouse_model import SpaceMouse

import hapticbridge as hb
import hapticbridge.view.page
from hapticbridge.device import SimulatedDevice
from hapticbridge.device.driver import ignore_message
from hapticbridge.device.mouse import MouseDevice
from hapticbridge.device.spacemouse import open_spacemouse

device, _, seam = opened_rawhid(RawHid(SimulatedDevice()))
with hb.Bridge("point_mass", device, clock=DrivingClock(seam), recording="rawhid.mcap") as bridge:
    print(bridge.run(0.2).ticks)
bus = HidSeam(SpaceMouse(lambda when: (0.5, 0.0, 0.0, 0.0, 0.0, 0.0)))
for name, device in (("spacemouse", open_spacemouse({}, ignore_message, bus)), ("mouse", MouseDevice())):
    with hb.Bridge("point_mass", device, clock=DrivingClock(bus), recording=f"{name}.mcap") as bridge:
        print(bridge.run(0.1).ticks)
print(*(hb.audit(f"{name}.mcap").verdict for name in ("rawhid", "spacemouse", "mouse")))
"""  # noqa: E501

PROBE = """
code = compile("import os, sys, time\\nfound = [sys.platform, hasattr(os, 'memfd_create')]", "p", "exec")
for name in ("hapticbridge.probe", "another"):
    names = {"__name__": name}
    exec(code, names)
    print(*names["found"])
try:
    exec("import fcntl", {"__name__": "hapticbridge.probe"})
    print("there")
except ModuleNotFoundError as error:
    print(error)
"""  # noqa: E501


def done(system: str, folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    paths = os.pathsep.join(map(str, (TESTS / "other_system", TESTS)))
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env={
            **os.environ,
            "OTHER_SYSTEM": system,
            "PYTHONPATH": paths,
            "TMPDIR": str(folder),  # shared memory is there, as on these systems
        },
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.parametrize("system", SYSTEMS)
def test_the_stand_in_takes_away_what_only_linux_has(system: str, tmp_path: Path) -> None:
    lines = done(system, tmp_path, "-c", PROBE).stdout.splitlines()
    fcntl = "there" if system == "darwin" else "win32 has no module 'fcntl'"
    assert lines == [f"{system} False", "linux True", fcntl]


COMMANDS = """
import json
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO

from hapticbridge.cli import main

told = {}
for words in LINES:
    out, err = StringIO(), StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        try:
            code = main(words.split())
        except SystemExit as end:
            code = end.code
    told[words] = code, out.getvalue(), err.getvalue()
print(json.dumps(told))
"""


# Windows lacks more than macOS, whose run is in the test below
def test_a_run_is_recorded_audited_compared_exported_and_shown(tmp_path: Path) -> None:
    lines = (
        "run point_mass --fast --duration 0.2 --record a.mcap",
        "run point_mass --duration 0.2 --record b.mcap",
        "audit a.mcap --report a.html",
        "compare a.mcap a.mcap",
        "export a.mcap --format csv",
        "view a.mcap --save page.html",
        "check point_mass",
        "devices --json",
        "doctor --duration 1 --json",
    )
    found = done("win32", tmp_path, "-c", COMMANDS.replace("LINES", repr(lines)))
    assert found.returncode == 0, found.stderr
    assert "Traceback" not in found.stderr
    told = json.loads(found.stdout)
    # a busy machine may miss deadlines of the second, and its doctor finds what is missing
    most = {lines[1]: 1, lines[-1]: 1}
    for words, (code, out, err) in told.items():
        assert 0 <= code <= most.get(words, 0), f"{words}: {out}{err}"
        assert "Traceback" not in err
    assert {"a.mcap", "b.mcap", "a.html", "a.csv", "page.html"} <= {
        each.name for each in tmp_path.iterdir()
    }
    assert {each["name"] for each in json.loads(told["devices --json"][1])["supported"]} >= {
        "rawhid",
        "mouse",
    }
    assert "Linux" in told["doctor --duration 1 --json"][1]


@pytest.mark.parametrize("system", SYSTEMS)
def test_raw_hid_spacemouse_and_mouse_run_a_scene(system: str, tmp_path: Path) -> None:
    found = done(system, tmp_path, "-c", EMULATED)
    assert found.stdout.split() == ["200", "100", "100", *["passive"] * 3], found.stderr
