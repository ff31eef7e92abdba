"""Faults that need a bridge in a process of its own: one that hangs, one stopped at its start."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from waiting import PATIENCE, is_alive

BRIDGE = """
import gc, os, re, signal, sys, time
sys.path.insert(0, sys.argv[1])
import numpy as np
from emulated.hid_seam import HidSeam
from emulated.rawhid_model import Claims, RawHid
from hapticbridge.run.bridge import Bridge
from hapticbridge.device.driver import ignore_message
from hapticbridge.device.rawhid.device import open_rawhid
from hapticbridge.device.rawhid.protocol import force_frame
from hapticbridge.device.watchdog import ForceOffGuardian
from hapticbridge.demand.guard import Limits

node = os.open(sys.argv[2], os.O_WRONLY)
is_stuck = []

class Node(RawHid):  # its node, which two processes write to, is a pipe
    def output(self, report, now):
        if report[2] == 0x46:
            os.write(node, bytes(1) + report)
        super().output(report, now)

def now():
    while is_stuck:
        time.sleep(1.0)
    seam.advance(time.monotonic() - begun)
    return seam.now

model, begun = Node(None, Claims(rate=2000.0)), time.monotonic()
seam = HidSeam(model)
model.motion = (0.0,) * 12
device = open_rawhid({}, ignore_message, seam, now)
off = force_frame(0, (0.0,) * 6, 1, is_enabled=False)
device.last_word = ForceOffGuardian(sys.argv[2], bytes(1) + off)

def act(tick):
    model.motion = (min(2e-5 * tick, 0.02), *(0.0,) * 11)  # 10 mm into the wall
    if tick == 1200:
        DEED

limits = Limits(force=10.0, torque=0.5, ramp=0.2, energy=np.inf)
try:
    with Bridge("virtual_wall", device, limits=limits, realtime=False) as bridge:
        gc.disable()  # as a run in real time: a collection takes 0.1 s on a busy machine
        bridge.run(10.0, act)
except Exception as error:
    print(error, flush=True)
"""
"""A bridge on a home-made device, pressed on a wall, which hangs in its 1200th tick."""


@dataclass(frozen=True)
class Hang:
    """A way for a bridge to hang with force on.

    Attributes:
        name: In a few words.
        deed: What it does, in Python.
        wakes: True if a signal (SIGCONT) ends it.
    """

    name: str
    deed: str
    wakes: bool = False


HANGS = (
    Hang("bridge stopped (SIGSTOP)", "os.kill(os.getpid(), signal.SIGSTOP)", wakes=True),
    Hang("device call never returns", "is_stuck.append(True)"),
    Hang("endless loop in C", "re.match('(a+)+$', 64 * 'a' + 'b')"),
)
"""The third keeps the interpreter's lock."""


@dataclass(frozen=True)
class HangOutcome:
    """Outcome of a hang.

    Attributes:
        zero_after: Time in s from the last frame with force to the guardian's first without.
        has_force_after: True if a frame with force came after that one.
        says: What the bridge printed once it woke up.
        status: Its exit status.
    """

    zero_after: float
    has_force_after: bool
    says: str
    status: int


def _has_force(frame: bytes) -> bool:
    """Returns whether a report of the node, with its leading 0, switches motors on."""
    return bool(frame[4] & 1) and any(frame[9:33])


def _frames(node: int, patience: float) -> list[bytes]:
    """Returns the frames that came; waits for the first one."""
    size = 65
    select.select([node], [], [], patience)
    try:
        data = os.read(node, 1000 * size)
    except BlockingIOError:
        return []
    return [data[i : i + size] for i in range(0, len(data), size)]


def hang(fault: Hang, folder: Path) -> HangOutcome:
    """Lets a bridge hang, and reads its device's node meanwhile."""
    path = folder / "node"
    os.mkfifo(path)
    node = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    command = [sys.executable, "-c", BRIDGE.replace("DEED", fault.deed)]
    tests = str(Path(__file__).parents[1])
    process = subprocess.Popen(
        [*command, tests, str(path)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    limit, forced = time.monotonic() + PATIENCE, 0.0
    zero, after = 0.0, []
    try:
        while not zero and time.monotonic() < limit:
            for frame in _frames(node, 0.01):
                if _has_force(frame):
                    forced = time.monotonic()
                elif forced and not frame[4] & 1:  # a zero of the bridge has motors on
                    zero = time.monotonic()
        if fault.wakes:
            process.send_signal(signal.SIGCONT)
        else:
            process.kill()
        while process.poll() is None and time.monotonic() < limit:
            after += _frames(node, 0.01)
        after += _frames(node, 0.0)
        says, _ = process.communicate(timeout=PATIENCE)
    finally:
        process.kill()
        process.wait(PATIENCE)
        os.close(node)
    assert zero, f"the force stayed on: {says}"
    return HangOutcome(zero - forced, any(map(_has_force, after)), says, process.returncode)


STOPS = {
    "SIGINT": (130, "interrupted"),
    "SIGTERM": (143, "stopped by SIGTERM"),
    "SIGHUP": (129, "stopped by SIGHUP"),
}
"""Exit code and sentence of a signal that comes before the first tick."""


@dataclass(frozen=True)
class StopOutcome:
    """Outcome of a signal during start-up.

    Attributes:
        status: Exit status.
        says: Last line on standard error.
        has_file: True if a recording is left.
        orphans: Child processes that outlived the bridge.
    """

    status: int
    says: str
    has_file: bool
    orphans: list[int]


def stop_at_start(name: str, seconds: float, folder: Path) -> StopOutcome:
    """Sends a signal to ``hapticbridge run`` some seconds after it began to catch signals."""
    path, number = folder / "run.mcap", int(signal.Signals[name])
    command = [sys.executable, "-m", "hapticbridge", "run", "virtual_wall", "--record", str(path)]
    process = subprocess.Popen(
        [*command, "--fast"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    limit = time.monotonic() + PATIENCE
    try:
        # Python itself catches SIGINT from its own start on, the command all signals
        while not _catches(process.pid, signal.SIGHUP) and time.monotonic() < limit:
            time.sleep(1e-3)
        time.sleep(seconds)
        started = children(process.pid)
        process.send_signal(number)
        _, says = process.communicate(timeout=PATIENCE)
    finally:
        process.kill()
        process.wait(PATIENCE)
    while any(map(is_alive, started)) and time.monotonic() < limit:
        time.sleep(1e-3)
    orphans = [child for child in started if is_alive(child)]
    return StopOutcome(process.returncode, says.splitlines()[-1], path.exists(), orphans)


def _catches(pid: int, number: int) -> bool:
    """Returns whether a process has a handler for a signal."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    caught = int(next(line for line in lines if line.startswith("SigCgt")).split()[1], 16)
    return bool(caught >> (number - 1) & 1)


def children(pid: int) -> list[int]:
    """Returns the child processes of a process."""
    tasks = Path(f"/proc/{pid}/task").glob("*/children")
    return [int(child) for task in tasks for child in task.read_text().split()]
