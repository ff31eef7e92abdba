"""A process of its own that says zero to a device when the bridge can no longer.

A bridge that is killed (SIGKILL), or whose interpreter crashes, runs no line of its own any more. A
child that holds a second handle to the same device node sees its end of a pipe close, or that it
has another parent, and then writes the reports it was given. It is possible where two processes may
hold one device: hidraw. USB interfaces belong to the one that claimed them; there the device's own
watchdog is all there is.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from typing import IO, cast

_CHILD = """
import os, select, signal, sys, time
for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGTSTP", "SIGQUIT"):
    signal.signal(getattr(signal, name), signal.SIG_IGN)
device, bridge, pause = int(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])
reports = [bytes.fromhex(text) for text in sys.argv[4:]]
os.write(1, b"r")
while not (is_told := select.select([0], [], [], pause)[0]) and os.getppid() == bridge:
    pass
if not is_told or not os.read(0, 1):
    for _ in range(3):
        for report in reports:
            try:
                os.write(device, report)
            except OSError:
                pass
        time.sleep(0.002)
"""
# three times, because a report of the dead bridge may still be on its way behind the first

POLL = 0.01
"""In s: how often the child looks whether the bridge is still its parent. The end of the pipe comes
at once, but not where a process that the bridge forked holds the pipe open after it; then the force
stays for so long. Each look takes some microseconds, on another core."""

PATIENCE = 5.0
"""In s: how long the child may take to end; it needs a millisecond."""


class LastWord:
    """Holds reports that are written to a device node if this process ends without ``close``.

    Args:
        path: The device node; opened once more, for writing.
        reports: What is written, each with its number first.

    Raises:
        OSError: The node cannot be opened again, or no process started.
    """

    def __init__(self, path: str, *reports: bytes) -> None:
        node = os.open(path, os.O_WRONLY | os.O_NOCTTY)
        given = str(node), str(os.getpid()), str(POLL)
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-I", "-S", "-c", _CHILD, *given, *(r.hex() for r in reports)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                pass_fds=(node,),
                start_new_session=True,  # Ctrl-C ends the bridge, which then says close
                bufsize=0,
            )
        finally:
            os.close(node)
        cast(IO[bytes], self._process.stdout).read(1)  # from here on it heeds the pipe

    def close(self) -> None:
        """Tells the child that nothing needs to be said; may be called more than once."""
        process = self._process
        if process.stdin is None or process.stdin.closed:
            return
        with contextlib.suppress(OSError):
            process.stdin.write(b"x")
        process.stdin.close()
        if process.stdout is not None:
            process.stdout.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(PATIENCE)


def last_word_at(path: str, *reports: bytes) -> LastWord | None:
    """Returns a ``LastWord`` where two processes may hold the node; None elsewhere.

    The device's own watchdog is there in any case, or its effects end by themselves.

    Args:
        path: The device node.
        reports: What takes the force away, each with its number first.
    """
    if not path.startswith("/dev/hidraw"):
        return None
    try:
        return LastWord(path, *reports)
    except OSError:
        return None
