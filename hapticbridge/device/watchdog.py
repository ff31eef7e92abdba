"""How long device and program may hear nothing of each other before either takes it for the end."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from typing import IO, cast

# A process of its own that says zero to a device when the bridge can no longer.
#
# A bridge that is killed (SIGKILL), or whose interpreter crashes, runs no line of its own any
# more. A child that holds a second handle to the same device node sees its end of a pipe close,
# or that it has another parent, and then writes the reports it was given. It is possible where
# two processes may hold one device: hidraw. USB interfaces belong to the one that claimed them;
# there the device's own watchdog is all there is.

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


class ForceOffGuardian:
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


def guard_device_node(path: str, *reports: bytes) -> ForceOffGuardian | None:
    """Returns a ``ForceOffGuardian`` where two processes may hold the node; None elsewhere.

    The device's own watchdog is there in any case, or its effects end by themselves.

    Args:
        path: The device node.
        reports: What takes the force away, each with its number first.
    """
    if not path.startswith("/dev/hidraw"):
        return None
    try:
        return ForceOffGuardian(path, *reports)
    except OSError:
        return None


SILENCE = 0.05
"""In s: fifty samples at 1 kHz. Shorter would take an ordinary kernel's stalls for a lost device,
longer would leave the last force on the motors for longer."""


SHORTEST_WATCHDOG, WATCHDOG_PERIODS = 0.02, 10
"""The watchdog asked for is ten periods of the loop, but not less than 20 ms: an ordinary kernel
stalls a loop for some ms now and then, and a force that drops out each time would rattle."""


class SilenceDetector:
    """Tells a device that has fallen silent from a loop that was away.

    A device is silent once it has given nothing new for ``SILENCE``, asked all the while. Where the
    loop itself has not read for so much longer than its period, nobody asked: the count begins
    anew.

    Args:
        now: Time in s on the link's clock, at the device's first sample.
        period: The loop's in s; 0 where it is far below ``SILENCE``.

    Attributes:
        silence: Time in s since the device gave something new.
    """

    def __init__(self, now: float, period: float = 0.0) -> None:
        self._heard = self._read = now
        self._period = period
        self.silence = 0.0

    def is_silent(self, now: float, *, is_new: bool) -> bool:
        """Notes a reading; returns whether the device has been silent for too long.

        Args:
            now: Time in s on the same clock.
            is_new: Whether this reading brought something new.
        """
        was_away = self.was_away(now)
        self._read = now
        if is_new or was_away:
            self._heard = now
        self.silence = now - self._heard
        return self.silence > SILENCE

    def was_away(self, now: float) -> bool:
        """Returns whether the loop has not read for so long that nobody asked the device.

        What a device that answers questions has said since is then as old as the last question: a
        loop that goes by it finds the hand where it was, and two ticks later somewhere else.

        Args:
            now: Time in s on the same clock, before the reading is noted.
        """
        return now - self._read > SILENCE + self._period


def watchdog_time(period: float) -> float:
    """Returns for how long in s a device should go on with a force that is not renewed.

    Args:
        period: The loop's in s.
    """
    return max(SHORTEST_WATCHDOG, WATCHDOG_PERIODS * period)
