"""Watchdogs between host and device: timeouts, and a process that ends the force."""

from __future__ import annotations

import contextlib
import math
import mmap
import os
import select
import subprocess
import sys
from typing import IO, cast

from hapticbridge.errors import DeviceError

# Guardian process that writes a zero-force report if the bridge process dies or hangs

_CHILD = """
import mmap, os, select, signal, sys, time
for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGTSTP", "SIGQUIT"):
    signal.signal(getattr(signal, name), signal.SIG_IGN)
device, page, bridge, pause = *map(int, sys.argv[1:4]), float(sys.argv[4])
reports = [bytes.fromhex(text) for text in sys.argv[5:]]
words = memoryview(mmap.mmap(page, 0)).cast("q")
seen = looks = 0
def end_force():
    for _ in range(3):
        for report in reports:
            try:
                os.write(device, report)
            except OSError:
                pass
        time.sleep(0.002)
os.write(1, b"r")
while not (is_told := select.select([0], [], [], pause)[0]) and os.getppid() == bridge:
    beat = words[0]
    looks = looks + 1 if beat == seen and beat else 0
    seen = beat
    if looks == words[1]:
        words[2] = beat
        end_force()
if not is_told or not os.read(0, 1):
    end_force()
"""
# three times, because a report of the dead bridge may still follow the first one

POLL = 0.01
"""Time in s between checks that the bridge is still the child's parent. A closed pipe is detected
at once, unless a process forked by the bridge holds it open; the force then lasts for this time.
Each check takes some microseconds on another core."""

START_PATIENCE, PATIENCE = 10.0, 2.0
"""Longest time in s for the child to start, which takes 50 ms, and to end, which takes 1 ms. It
ends later only while the device does not accept a report."""

HANG = 0.1
"""Time in s without a new command after which a loop counts as hung while force is on. Longer than
``SILENCE``, so that the device's own watchdog and its silence come first. At a shorter time, stalls
of an ordinary kernel would end runs; at a longer one the last force would stay on for longer."""

HANG_PERIODS = 3
"""Fewest periods of the loop in ``HANG``: at 10 Hz a command every 100 ms is in time."""


class ForceOffGuardian:
    """Child process that writes reports to a device node if this process dies or hangs.

    A bridge that is killed (SIGKILL), crashes, is stopped (SIGSTOP, a breakpoint) or never returns
    from a call runs no code of its own any more. The child holds a second handle to the device
    node. It writes the reports once it detects the closed pipe or a new parent, and if ``beat`` was
    not called for ``HANG`` while force was on. This requires a node that two processes can hold,
    such as hidraw or a serial port. A USB interface belongs to one process; there the device's own
    watchdog is the only protection.

    Beats are counted in checks of the child, not in time. A machine that is suspended, or frozen
    with all its processes, stops the checks too, and no force is ended by mistake. A loop that
    wakes up after the child ended its force must not switch it on again: ``beat`` then raises, and
    the run trips. A loop without force is never hung, however long it waits.

    Args:
        path: The device node; opened once more, for writing.
        reports: Reports to write, each starting with its number.

    Raises:
        OSError: The node cannot be opened again, or no process can be started.
    """

    def __init__(self, path: str, *reports: bytes) -> None:
        # number of the last command with force (0: none), checks until a hang, number at a hang
        page = os.memfd_create("hapticbridge-beat", os.MFD_CLOEXEC)
        try:
            os.ftruncate(page, mmap.PAGESIZE)
            self._words = memoryview(mmap.mmap(page, 0)).cast("q")
            self._number = 0
            self.expect(0.0)
            node = os.open(path, os.O_WRONLY | os.O_NOCTTY)
            arguments = str(node), str(page), str(os.getpid()), str(POLL)
            command = [sys.executable, "-I", "-S", "-c", _CHILD, *arguments]
            try:
                self._process = subprocess.Popen(
                    [*command, *(report.hex() for report in reports)],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    pass_fds=(node, page),
                    start_new_session=True,  # Ctrl-C ends the bridge, which then calls close
                    bufsize=0,
                )
            finally:
                os.close(node)
        finally:
            os.close(page)
        ready = cast(IO[bytes], self._process.stdout)
        if not select.select([ready], [], [], START_PATIENCE)[0] or not ready.read(1):
            self._process.kill()
            self.close()
            raise OSError("the guardian process does not start")

    def expect(self, period: float) -> None:
        """Starts a run with the loop's period in s; a hang before it is forgotten."""
        self._words[1] = math.ceil(max(HANG, HANG_PERIODS * period) / POLL)
        self._words[0] = self._words[2] = 0

    def beat(self, *, has_force: bool) -> None:
        """Notes a command before it is sent; a single store.

        Raises:
            DeviceError: The command has force, and the child ended the force since ``expect``.
        """
        if not has_force:
            self._words[0] = 0
            return
        self._words[0] = self._number = self._number + 1
        if self._words[2]:
            raise DeviceError(
                f"the loop sent nothing for {1e3 * POLL * self._words[1]:.0f} ms while force was "
                "on, and the guardian process has ended the force; 'hapticbridge doctor' finds "
                "what stalls a machine"
            )

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


_SHARED_NODES = "/dev/hidraw", "/dev/input/event", "/dev/tty", "/dev/pts/"
"""Beginnings of the nodes that two processes can hold: raw HID, input devices, serial ports,
pseudo-terminals."""


def guard_device_node(path: str, *reports: bytes) -> ForceOffGuardian | None:
    """Starts a guardian with these reports, or returns None if only one process may hold the node.

    It covers a bridge that dies and one that hangs.

    Without it, as on other systems than Linux, the device's own watchdog or the limited duration of
    its effects ends the force.
    """
    if sys.platform != "linux" or not path.startswith(_SHARED_NODES):
        return None
    try:
        return ForceOffGuardian(path, *reports)
    except OSError:
        return None


SILENCE = 0.05
"""Time without a new sample after which a device counts as lost, in s: fifty samples at 1 kHz. At a
shorter time, stalls of an ordinary kernel would look like a lost device. At a longer one, the last
force would stay on the motors for longer."""


MIN_WATCHDOG, WATCHDOG_PERIODS = 0.02, 10
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
    return max(MIN_WATCHDOG, WATCHDOG_PERIODS * period)
