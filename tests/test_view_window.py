"""Window of a run: the requests that it answers, and the commands that it takes."""

from __future__ import annotations

import io
import json
import os
import subprocess
import threading
import types

import pytest

from hapticbridge.errors import HapticBridgeError
from hapticbridge.run.commands import Command, Couple, Stop, Switch, line_of
from hapticbridge.view.window import Address, Window

pytest.importorskip("viser", reason="needs the extra 'view'")

from waiting import PATIENCE

# viser's threads and sockets end with the process
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")


@pytest.mark.parametrize(
    ("host", "origin", "reason"),
    [
        ("127.0.0.1:8080", None, ""),
        ("localhost:8080", "http://localhost:8080", ""),
        ("[::1]:8080", "http://[::1]:8080", ""),
        ("evil.example:8080", None, "not the host"),
        ("127.0.0.1.evil.example", None, "not the host"),
        ("", None, "not the host"),
        ("[::1", None, "not the host"),
        ("x; script-src * @localhost", None, "not the host"),
        ("127.0.0.1:8080", "http://evil.example", "another page"),
        ("127.0.0.1:8080", "http://127.0.0.1:9999", "another page"),
        ("127.0.0.1:8080", "https://127.0.0.1:8080", "another page"),
        ("127.0.0.1:8080", "null", "another page"),
    ],
)
def test_only_requests_of_its_own_page_are_answered(
    host: str, origin: str | None, reason: str
) -> None:
    headers = {"Host": host} | ({} if origin is None else {"Origin": origin})
    address = Address(8080)
    said = address.refusal(f"/?token={address.token}", headers)
    assert (reason in said) if reason else said == ""


@pytest.mark.parametrize("way", ["query", "cookie"])
def test_token_opens_and_nothing_else_does(way: str) -> None:
    address = Address()
    assert len(address.token) >= 32
    assert address.token != Address().token
    assert address.token not in repr(address)

    def refusal(token: str) -> str:
        headers = {"host": "127.0.0.1:80"}
        if way == "cookie":
            return address.refusal("/", headers | {"cookie": f"a=b; hapticbridge_80={token}"})
        return address.refusal(f"/x?a=b&token={token}", headers)

    assert refusal(address.token) == ""
    shown = f"/?token={address.token}", {"host": "127.0.0.1:80", "Upgrade": "websocket"}
    assert "token" in address.refusal(*shown)
    for wrong in ("", address.token[:-1], address.token.swapcase(), "ü", "\udcff", "€"):
        assert "token" in refusal(wrong)
    assert "token" in address.refusal("/", {"host": "localhost"})
    assert "token" in address.refusal("//[", {"host": "localhost"})  # not a path


SWITCH = line_of(Switch(force=False))


class SayingProcess:
    """A view's process that serves its page and says something; it keeps what it is told."""

    def __init__(self, said: bytes) -> None:
        self.is_heard, self.is_told = threading.Event(), threading.Event()
        self.returncode: int | None = None
        lines = [b'{"url": "u"}\n', *said.splitlines(keepends=True)]
        self.stdout = types.SimpleNamespace(readline=self.readline, close=lambda: None)
        self.stdin = types.SimpleNamespace(
            write=self.write, flush=lambda: None, close=self.is_told.set
        )
        self.said, self.told = io.BytesIO(b"".join(lines)), b""

    def readline(self, limit: int = -1) -> bytes:
        line = self.said.readline(limit)
        if not line.endswith(b"\n"):  # the end, or a line that is too long
            self.is_heard.set()
        return line

    def write(self, piece: bytes) -> None:
        self.told += piece

    def wait(self, _timeout: float) -> None:
        """Ends when it is told no more."""
        self.is_told.wait(PATIENCE)
        self.returncode = 0


@pytest.mark.parametrize(
    ("said", "heard", "refused"),
    [
        (line_of(Stop()), [Stop()], 0),
        (SWITCH + line_of(Couple(900.0, 0.5)), [Switch(force=False), Couple(900.0, 0.5)], 0),
        (b'{"command": "stop", "force": 99}\n' + SWITCH, [Switch(force=False)], 1),
        (b'{"command": "couple", "stiffness": 1e999, "damping": 0}\n', [], 1),
        (b'{"command": "couple", "stiffness": NaN, "damping": 0}\n', [], 1),
        (b'{"command": "couple", "stiffness": true, "damping": 0}\n', [], 1),
        (b'{"command": "switch", "force": 1}\n', [], 1),
        (b'{"command": "exec"}\n[]\n\xff\n\n', [], 4),
        (b"x" * 100_000 + b"\n" + SWITCH, [], 0),  # longer than a command: deaf from then on
        (b"", [], 0),
    ],
)
def test_a_run_hears_commands_and_nothing_else(
    said: bytes, heard: list[Command], refused: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hapticbridge.view.window.INTERVAL", 0.0)
    process = SayingProcess(said)
    monkeypatch.setattr(subprocess, "Popen", lambda *_, **__: process)
    window, commands = Window(Address(0)), list[Command]()
    window.on_command = commands.append
    window.start("ring", "snapshot", {}, ())
    process.is_heard.wait(PATIENCE)
    window.close()
    assert commands == heard
    job, *answers = [json.loads(line) for line in process.told.splitlines()]
    assert job["ring"] == "ring"
    assert [answer["event"] for answer in answers] == ["refused"] * refused


def test_a_page_that_is_never_served_is_waited_for_a_limited_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("hapticbridge.view.window.START_PATIENCE", 0.2)
    monkeypatch.setattr("hapticbridge.view.window._BOOTSTRAP", "import time; time.sleep(60)")
    window = Window(Address(0))
    with pytest.raises(HapticBridgeError, match=r"served nothing within 0\.2 s"):
        window.start("ring", "snapshot", {}, ())
    assert window.process_id is not None
    with pytest.raises(ProcessLookupError):
        os.kill(window.process_id, 0)
