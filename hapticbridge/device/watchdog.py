"""Watchdogs between host and device: timeouts, and a process that ends the force."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from typing import IO, cast

# Guardian process that writes a zero-force report if the bridge process dies

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
# three times, because a report of the dead bridge may still follow the first one

POLL = 0.01
"""Time in s between checks that the bridge is still the child's parent. A closed pipe is detected
at once, unless a process forked by the bridge holds it open; the force then lasts for this time.
Each check takes some microseconds on another core."""

PATIENCE = 5.0
"""Longest time in s for the child to end; it needs about a millisecond."""


class ForceOffGuardian:
    """Child process that writes reports to a device node if this process ends without ``close``.

    A bridge that is killed (SIGKILL) or crashes runs no code of its own any more. The child holds a
    second handle to the device node. It detects the closed pipe or a new parent, and then writes
    the reports. This requires a node that two processes can hold, such as hidraw. A USB interface
    belongs to one process; there the device's own watchdog is the only protection.

    Args:
        path: The device node; opened once more, for writing.
        reports: Reports to write, each starting with its number.

    Raises:
        OSError: The node cannot be opened again, or no process can be started.
    """

    def __init__(self, path: str, *reports: bytes) -> None:
        node = os.open(path, os.O_WRONLY | os.O_NOCTTY)
        arguments = str(node), str(os.getpid()), str(POLL)
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-I", "-S", "-c", _CHILD, *arguments, *(r.hex() for r in reports)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                pass_fds=(node,),
                start_new_session=True,  # Ctrl-C ends the bridge, which then calls close
                bufsize=0,
            )
        finally:
            os.close(node)
        cast(IO[bytes], self._process.stdout).read(1)  # the child now watches the pipe

    def close(self) -> None:
        """Ends the child without writing the reports; may be called more than once."""
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
    """Starts a guardian with these reports, or returns None if only one process may hold the node.

    Without it, the device's own watchdog or the limited duration of its effects ends the force.
    """
    if not path.startswith("/dev/hidraw"):
        return None
    try:
        return ForceOffGuardian(path, *reports)
    except OSError:
        return None


SILENCE = 0.05
"""Time without a new sample after which a device counts as lost, in s: fifty samples at 1 kHz. At a
shorter time, stalls of an ordinary kernel would look like a lost device. At a longer one, the last
force would stay on the motors for longer."""


SHORTEST_WATCHDOG, WATCHDOG_PERIODS = 0.02, 10
"""Shortest watchdog of a device in s, and watchdog in periods of the loop; the longer time is
requested. An ordinary kernel stalls a loop for some ms now and then. A force that drops out each
time would rattle."""


class SilenceDetector:
    """Detector of a silent device that ignores pauses of the loop.

    A device is silent if it sends nothing new for ``SILENCE`` although it is read. If the loop
    itself pauses for longer than its period plus ``SILENCE``, the count restarts.

    Args:
        now: Time in s on the link's clock, at the device's first sample.
        period: The loop's period in s; 0 if it is far below ``SILENCE``.

    Attributes:
        silence: Time in s since the last new sample.
    """

    def __init__(self, now: float, period: float = 0.0) -> None:
        self._heard = self._read = now
        self._period = period
        self.silence = 0.0

    def is_silent(self, now: float, *, is_new: bool) -> bool:
        """Records a reading at the time ``now`` in s; returns whether the silence is too long."""
        was_away = self.was_away(now)
        self._read = now
        if is_new or was_away:
            self._heard = now
        self.silence = now - self._heard
        return self.silence > SILENCE

    def was_away(self, now: float) -> bool:
        """Returns whether the loop has paused without reading the device, before ``is_silent``.

        A device that replies to requests then holds an answer as old as its last request. Used by
        the loop, it would place the hand at its old position, and elsewhere two ticks later.
        """
        return now - self._read > SILENCE + self._period


def watchdog_time(period: float) -> float:
    """Returns the time in s for which a device should hold a force, for a loop's period in s."""
    return max(SHORTEST_WATCHDOG, WATCHDOG_PERIODS * period)
