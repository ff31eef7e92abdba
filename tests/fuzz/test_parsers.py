"""Any bytes end in a value or in one of the program's own errors, in every parser of foreign files.

``SEEDS`` are inputs that once broke a parser; they are tried before the random ones.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hapticbridge.confinement import unpacked
from hapticbridge.device import DeviceInfo, spacemouse
from hapticbridge.device.falcon.protocol import read_firmware
from hapticbridge.device.motion_file import read_motion
from hapticbridge.device.pid.reports import has_force_feedback
from hapticbridge.device.profile import read_profile
from hapticbridge.device.rawhid import protocol as rawhid
from hapticbridge.device.transport import websocket
from hapticbridge.device.transport.hid_descriptor import fields_of
from hapticbridge.errors import HapticBridgeError
from hapticbridge.kernel.parameters import GuardParameters
from hapticbridge.recording import read_recording
from hapticbridge.run.commands import command_of
from hapticbridge.run.request import request_of
from hapticbridge.scene import scene_parameters, settings_from
from hapticbridge.scene.source import read_elements, refuse_outside
from hapticbridge.view.window import Address
from hapticbridge.whatif import changes_from

SEEDS = (
    b"a=" + b"[" * 100_000,
    b"a=" + b"9" * 5000,
    b"\xff\xfe",
    b"<!--" * 75_000,
    b"<a " + b" " * 300_000,
    b"[" * 100_000,
    b"{}",
    b"",
)

WORDS = st.sampled_from(
    (
        *(b"[parameters.a]\n", b"unit='m'\n", b"default=", b"sets=[{kind='geom'}]\n", b"1e999"),
        *(b"<mujoco>", b"<mesh file='", b"/dev/zero", b"'/>", b"<!--", b"-->", b"&#47;"),
        *(b"\x05\x01\x09\x04", b"\xa1\x01", b"\x75\x10\x95\x06\x81\x02", b"\xc0", b"\x27\xff"),
        *(b"localhost:8080\n", b"http://localhost:8080", b"token=", b"/?token=", b"[::1]"),
        *(b'{"command":"', b'stop"', b'{"array of bytes":["<f8",', b"2,3]}", b"clearance=", b"1e"),
        *(b'{"damping":', b"null", b"NaN", b"}", b"t,x,y,z,qw,qx,qy,qz\n", b"0,", b"\n", b"\0"),
    )
)
TEXTS = st.lists(st.one_of(WORDS, st.binary(max_size=8)), max_size=20).map(b"".join)


def toml(data: bytes, folder: Path) -> None:
    (folder / "scene.toml").write_bytes(data)
    scene_parameters(folder / "scene.xml")


def profile(data: bytes, folder: Path) -> None:
    (folder / "profile.toml").write_bytes(data)
    read_profile(folder / "profile.toml")


def trajectory(data: bytes, folder: Path) -> None:
    (folder / "hand.csv").write_bytes(data)
    read_motion(folder / "hand.csv")


def recording(data: bytes, folder: Path) -> None:
    (folder / "run.mcap").write_bytes(data)
    read_recording(folder / "run.mcap")


def firmware(data: bytes, folder: Path) -> None:
    (folder / "nvent_firmware.bin").write_bytes(data)
    assert read_firmware(str(folder / "nvent_firmware.bin")) == data


def request(data: bytes, _: Path) -> None:
    """No request enters without the token, however its host, origin, cookie and path read."""
    token = "5" * 32
    path, *values = data.decode("latin-1").split("\n")
    names = ("Host", "Origin", "Cookie", "Host".lower())
    if token in data.decode("latin-1"):
        return
    assert Address(8080, token).refusal(path, dict(zip(names, values, strict=False)))


def answer(data: bytes, _: Path) -> None:
    """A damaged answer of a child process is a ValueError, which its reader takes for one."""
    half = len(data) // 2
    with suppress(ValueError, TypeError, RecursionError):
        unpacked(data[:half], data[half:])


def text_of(data: bytes) -> str:
    return data.decode(errors="replace")


PARSERS: dict[str, Callable[[bytes, Path], object]] = {
    "scene parameters": toml,
    "device profile": profile,
    "trajectory": trajectory,
    "recording": recording,
    "elements": lambda data, _: list(read_elements(data)),
    "file names": lambda data, _: refuse_outside(data, "main.xml"),
    "guard": lambda data, _: GuardParameters.from_json(text_of(data)),
    "device": lambda data, _: DeviceInfo.from_json(text_of(data)),
    "recorded request": lambda data, _: request_of({"request": text_of(data)}),
    "settings": lambda data, _: settings_from(text_of(data).split()),
    "changes": lambda data, _: changes_from(tuple(text_of(data).split())),
    "firmware": firmware,
    "report descriptor": lambda data, _: fields_of(data),
    "force feedback": lambda data, _: has_force_feedback(data),
    "raw frame": lambda data, _: rawhid.decoded(data),
    "report of a mouse": lambda data, _: spacemouse.decoded(data),
    "message of a server": lambda data, _: websocket.decoded(text_of(data), "it"),
    "command": lambda data, _: command_of(data),
    "request": request,
    "answer": answer,
}


def tried(parse: Callable[[bytes, Path], object], data: bytes, folder: Path) -> None:
    try:
        parse(data, folder)
    except HapticBridgeError as error:
        assert str(error)


@pytest.mark.parametrize("name", PARSERS)
@settings(
    max_examples=125,
    derandomize=True,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(data=TEXTS)
def test_any_text_is_read_or_refused(name: str, data: bytes, tmp_path: Path) -> None:
    tried(PARSERS[name], data, tmp_path)


@pytest.mark.parametrize("name", PARSERS)
@pytest.mark.parametrize("seed", SEEDS, ids=range(len(SEEDS)))
def test_what_once_broke_a_parser_is_read_or_refused(
    name: str, seed: bytes, tmp_path: Path
) -> None:
    tried(PARSERS[name], seed, tmp_path)
