"""The view as the bridge sees it: a process that is told what happens, and may ask for little."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from queue import SimpleQueue
from typing import IO, cast

from hapticbridge.commands import Command, command_of
from hapticbridge.commands.command import LONGEST_LINE
from hapticbridge.commands.execution import INTERVAL
from hapticbridge.errors import CommandError, HapticBridgeError
from hapticbridge.recording import Attachment
from hapticbridge.view.address import Address

BY = "view"
"""Who gave a command of the page, as the recording says."""

PATIENCE = 2.0
"""In s: how long the process may take to end; the run is over by then, and no force is left."""

_BOOTSTRAP = """
import sys
sys.path.insert(0, sys.argv[1])
from hapticbridge.view.process import run
run()
"""


def check_view() -> None:
    """Checks that a page can be served, before anything is started for it.

    Raises:
        HapticBridgeError: The extra 'view' is not installed.
    """
    if importlib.util.find_spec("viser") is None:
        raise HapticBridgeError("a page needs the extra 'view': pip install 'hapticbridge[view]'")


class Window:
    """Starts the process of the live view; an ``RingObserver`` of a bridge.

    Whatever becomes of it, the loop goes on: records are read from the ring without a word to the
    bridge, and events leave through a thread of their own.

    Args:
        address: Where the page is served.

    Attributes:
        address: Likewise.
        on_command: Called from a thread with what somebody asks for on the page; raises a
            ``CommandError`` where it is refused, and the page then says why. Whatever else its
            process may say is no command.
        url: What to open in a browser, once it is shown.

    Raises:
        HapticBridgeError: The extra 'view' is not installed.
    """

    def __init__(self, address: Address) -> None:
        check_view()
        self.address = address
        self._outbox: SimpleQueue[bytes | None] = SimpleQueue()
        self._process: subprocess.Popen[bytes] | None = None
        self.url = ""
        self.on_command: Callable[[Command], None] | None = None

    def start(
        self,
        ring: str,
        snapshot: str,
        metadata: Mapping[str, str],
        attachments: Sequence[Attachment],
    ) -> None:
        """Starts the process and waits until the page is there.

        Raises:
            HapticBridgeError: The page cannot be served.
        """
        files = {item.name: item.data for item in attachments}
        job = {
            "ring": ring,
            "snapshot": snapshot,
            "metadata": dict(metadata),
            "attachments": [[name, len(data)] for name, data in files.items()],
            "host": self.address.host,
            "port": self.address.port,
            "token": self.address.token,
        }
        package = str(Path(__file__).resolve().parents[2])
        self._process = subprocess.Popen(
            # -P: a file in the user's working folder must not stand in for a module
            [sys.executable, "-P", "-c", _BOOTSTRAP, package],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C reaches the bridge alone
        )
        for piece in (json.dumps(job).encode() + b"\n", *files.values()):
            self._outbox.put(piece)
        threading.Thread(target=self._send, daemon=True).start()
        answer = json.loads(cast(IO[bytes], self._process.stdout).readline() or b"{}")
        if "url" not in answer:
            self.close()
            reason = answer.get("error", "its process ended before it served anything")
            raise HapticBridgeError(f"the view cannot be shown: {reason}")
        self.url = str(answer["url"])
        threading.Thread(target=self._listen, daemon=True).start()

    def event(self, event: Mapping[str, object]) -> None:
        """Tells the process what happened; never waits and never raises."""
        self._outbox.put(json.dumps(event).encode() + b"\n")

    def close(self) -> None:
        """Ends the process."""
        self._outbox.put(None)
        if self._process is not None:
            # its input ends, and it tells its page so
            try:
                self._process.wait(PATIENCE)
            except subprocess.TimeoutExpired:  # it hangs, or was stopped: that it cannot refuse
                self._process.kill()
                self._process.wait()
            for stream in (self._process.stdin, self._process.stdout):
                with contextlib.suppress(OSError):
                    cast(IO[bytes], stream).close()

    @property
    def process_id(self) -> int | None:
        """Of the process; None before it is started."""
        return None if self._process is None else self._process.pid

    def _listen(self) -> None:
        process = self._process
        stream = cast(IO[bytes], process and process.stdout)
        with contextlib.suppress(OSError, ValueError):
            while line := stream.readline(LONGEST_LINE + 1):
                if not line.endswith(b"\n"):
                    return  # longer than any command: this is not our page's process any more
                try:
                    command = command_of(line)
                    if self.on_command is not None:
                        self.on_command(command)
                except CommandError as error:
                    self.event({"event": "refused", "reason": str(error)})
                # the loop shares the interpreter's lock with this thread: a flood must not take it
                time.sleep(INTERVAL)

    def _send(self) -> None:
        process = self._process
        stream = cast(IO[bytes], process and process.stdin)
        # a process that died is told no more; the queue then grows by an event now and then
        with contextlib.suppress(OSError, ValueError):
            while (piece := self._outbox.get()) is not None:
                stream.write(piece)
                stream.flush()
            stream.close()
