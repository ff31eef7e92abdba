"""The bridge's interface to the view: its address, and the process that shows the run."""

from __future__ import annotations

import contextlib
import hmac
import importlib.util
import json
import re
import secrets
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from http.cookies import CookieError, SimpleCookie
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import IO, cast
from urllib.parse import parse_qs, urlsplit

from hapticbridge.arguments import check_fields, option
from hapticbridge.device.mouse import Pose, drag_of_line
from hapticbridge.errors import CommandError, HapticBridgeError
from hapticbridge.files import install_command
from hapticbridge.recording import Attachment
from hapticbridge.run.commands import INTERVAL, MAX_LINE, Command, command_of
from hapticbridge.signals import deferring_stops

HOST = "127.0.0.1"
"""Host name on which pages are served. Other machines reach it through an SSH tunnel alone."""

PATIENCE = 2.0
"""Longest wait in s for the process to end. The run is over by then, and the force is zero."""

START_PATIENCE = 60.0
"""Longest wait in s for the page to be served. The process imports for some seconds, and longer on
a busy machine; a shorter wait would refuse a page there."""

HAND_INTERVAL = 0.02
"""Shortest time in s between two poses of the hand. A pose costs the loop a single store; 50 a
second are more than a browser sends while its hand is dragged."""

_LOOPBACK = re.compile(r"(127\.0\.0\.1|localhost|\[::1\])(:[0-9]{1,5})?")

_BOOTSTRAP = """
import sys
sys.path.insert(0, sys.argv[1])
from hapticbridge.view.process import run
run()
"""


@dataclass(frozen=True, slots=True)
class Address:
    """The port of a page on this machine, and the token that admits a visitor.

    Other users of the machine reach the port, too; without the token they are refused. The address
    carries it once: the browser is sent on without it, and keeps a cookie. A browser also sends
    requests that a foreign page made it send. Those carry that page's Origin or, where a name was
    bound anew to this machine, a foreign Host; both are refused. From another machine,
    ``ssh -L 8080:localhost:8080 MACHINE`` leads to the page.

    Attributes:
        port: Port on this machine, where only the printed address gets in; 0 takes any free port.
            From another machine: ssh -L 8080:localhost:8080 MACHINE, then open the printed address.
        token: Secret of the page; random unless it is given.

    Raises:
        HapticBridgeError: The port is out of range.
    """

    port: int = option(8080, least=0, most=65535)
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24), repr=False)

    def __post_init__(self) -> None:
        check_fields(self)

    def url(self, port: int) -> str:
        """Returns the address to open in a browser, for the port that was found free."""
        return f"http://{HOST}:{port}/?token={self.token}"

    def refusal(self, path: str, headers: Mapping[str, str]) -> str:
        """Returns the reason why a request is refused, or an empty text.

        Args:
            path: Path of the request with its query.
            headers: Headers of the request; names in any case.
        """
        lower = {name.lower(): value for name, value in headers.items()}
        host = lower.get("host", "")
        if not _LOOPBACK.fullmatch(host):
            return "this is not the host of this page"
        origin = lower.get("origin")
        if origin is not None and origin != f"http://{host}":
            return "a request made by another page is refused"
        is_shown = self.is_in_query(path) and "upgrade" not in lower  # a socket has the cookie
        if not (is_shown or self._is_in_cookie(host, lower.get("cookie", ""))):
            return "the token is missing or wrong; open the address that hapticbridge printed"
        return ""

    def is_in_query(self, path: str) -> bool:
        """Returns whether a request's path carries the token."""
        try:
            shown = parse_qs(urlsplit(path).query).get("token", [""])[0]
        except ValueError:  # not a path
            return False
        return _are_equal(shown, self.token)

    def cookie(self, host: str) -> str:
        """Returns the cookie that keeps the token for a page at a host and port."""
        return f"{_cookie_name(host)}={self.token}; Path=/; HttpOnly; SameSite=Strict"

    def _is_in_cookie(self, host: str, cookie: str) -> bool:
        try:
            jar = SimpleCookie(cookie)
        except CookieError:
            return False
        name = _cookie_name(host)
        return name in jar and _are_equal(jar[name].value, self.token)


def _cookie_name(host: str) -> str:
    # browsers share cookies between ports; two pages must not overwrite each other's
    return f"hapticbridge_{host.rpartition(':')[2]}"


def _are_equal(shown: str, token: str) -> bool:
    return hmac.compare_digest(shown.encode(errors="surrogateescape"), token.encode())


def check_view() -> None:
    """Checks that the extra 'view' is installed.

    Raises:
        HapticBridgeError: The extra 'view' is not installed.
    """
    if importlib.util.find_spec("viser") is None:
        raise HapticBridgeError(f"a page needs the extra 'view': {install_command('view')}")


class Window:
    """The process of the live view; an ``RingObserver`` of a bridge.

    The loop never waits for it: positions and records are read from shared memory, and events leave
    through a thread of their own.

    Args:
        address: Port and token of the page.

    Attributes:
        address: Port and token of the page.
        on_hand: Called from a thread with each pose, in the device's frame, to which the hand on
            the page is dragged, and the bits of held buttons; None: the page has no hand.
        on_command: Called from a thread with each command of the page. It raises a
            ``CommandError`` to refuse one, and the page then shows the reason.
        url: Address to open in a browser, once the page is served.

    Raises:
        HapticBridgeError: The extra 'view' is not installed.
    """

    def __init__(self, address: Address) -> None:
        check_view()
        self.address = address
        self._outbox: SimpleQueue[bytes | None] = SimpleQueue()
        self._answers: SimpleQueue[dict[str, object]] = SimpleQueue()
        self._process: subprocess.Popen[bytes] | None = None
        self.url = ""
        self.on_command: Callable[[Command], None] | None = None
        self.on_hand: Callable[[Pose, int], None] | None = None

    def start(
        self,
        ring: str,
        snapshot: str,
        metadata: Mapping[str, str],
        attachments: Sequence[Attachment],
    ) -> None:
        """Starts the process and waits until it serves the page, at most ``START_PATIENCE``.

        Raises:
            HapticBridgeError: The page cannot be served, or the time is over.
        """
        files = {each.name: each.data for each in attachments}
        job = {
            "ring": ring,
            "snapshot": snapshot,
            "metadata": dict(metadata),
            "attachments": [[name, len(data)] for name, data in files.items()],
            "port": self.address.port,
            "token": self.address.token,
            "has_hand": self.on_hand is not None,
        }
        package = str(Path(__file__).resolve().parents[2])
        with deferring_stops():  # an interrupted caller would not have the process to end it
            self._process = subprocess.Popen(
                # -P: a file in the user's working folder must not replace a module
                [sys.executable, "-P", "-c", _BOOTSTRAP, package],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C reaches the bridge alone
            )
        for piece in (json.dumps(job).encode() + b"\n", *files.values()):
            self._outbox.put(piece)
        threading.Thread(target=self._send, daemon=True).start()
        threading.Thread(target=self._listen, daemon=True).start()
        try:
            answer = self._answers.get(timeout=START_PATIENCE)
        except Empty:
            answer = {"error": f"its process served nothing within {START_PATIENCE:g} s"}
        if "url" not in answer:
            self.close()
            reason = answer.get("error", "its process ended before it served anything")
            raise HapticBridgeError(f"the view cannot be shown: {reason}")
        self.url = str(answer["url"])

    def event(self, event: Mapping[str, object]) -> None:
        """Sends an event to the process; never waits and never raises."""
        self._outbox.put(json.dumps(event).encode() + b"\n")

    def close(self) -> None:
        """Ends the process; one that shows nothing yet at once."""
        self._outbox.put(None)
        if self._process is None:
            return
        if not self.url:
            self._process.kill()
        try:
            self._process.wait(PATIENCE)
        except subprocess.TimeoutExpired:  # it hangs, or was stopped
            self._process.kill()
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(PATIENCE)
        if self._process.returncode is not None:  # else a thread is inside its stream
            for stream in (self._process.stdin, self._process.stdout):
                with contextlib.suppress(OSError):
                    cast(IO[bytes], stream).close()

    @property
    def process_id(self) -> int | None:
        """Number of the process; None before it is started."""
        return None if self._process is None else self._process.pid

    def _listen(self) -> None:
        process = self._process
        stream = cast(IO[bytes], process and process.stdout)
        with contextlib.suppress(OSError, ValueError):
            self._answers.put(json.loads(stream.readline() or b"{}"))
            while line := stream.readline(MAX_LINE + 1):
                if not line.endswith(b"\n"):
                    return  # longer than any command, so not from the process that was started
                if self.on_hand is not None and (drag := drag_of_line(line)) is not None:
                    self.on_hand(*drag)
                    time.sleep(HAND_INTERVAL)
                    continue
                try:
                    command = command_of(line)
                    if self.on_command is not None:
                        self.on_command(command)
                except CommandError as error:
                    self.event({"event": "refused", "reason": str(error)})
                # the loop shares the interpreter's lock with this thread: a flood must not occupy
                # it
                time.sleep(INTERVAL)

    def _send(self) -> None:
        process = self._process
        stream = cast(IO[bytes], process and process.stdin)
        # a dead process receives nothing; the queue then grows by an event now and then
        with contextlib.suppress(OSError, ValueError):
            while (piece := self._outbox.get()) is not None:
                stream.write(piece)
                stream.flush()
            stream.close()
