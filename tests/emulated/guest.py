"""A User-Mode Linux as a place to run commands: a real kernel that is an ordinary process.

The guest sees the host's files, read-only, so the same interpreter and packages run there.
"""

from __future__ import annotations

import contextlib
import os
import shlex
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import platformdirs

CHECKOUT = Path(__file__).resolve().parents[2]
_MEMORY_MIB = 2048
"""Taken from this machine as the guest uses it. 1 GiB holds what the checks need, but not the
compiler beside it, where the host has not compiled ahead."""

PATIENCE = 150.0
"""Time in s of this machine: a guest that prints nothing for so long is stopped, where it is to
print something. The longest check takes a tenth of it on a machine that does nothing else."""

_LOOK = 0.2
"""Time in s between two looks at what the guest prints."""

_KILLED = 128 + 9  # exit status of a command that the kernel killed, as a shell tells it

_PIDFF = b"Force feedback for USB HID PID devices"
"""Words of hid-pidff, which the file of a kernel with it holds."""

NO_PIDFF = "this kernel has no hid-pidff (CONFIG_HID_PID)"

NO_KERNEL = "no User-Mode Linux kernel: scripts/build_uml builds one, or HAPTICBRIDGE_UML names one"


def kernel() -> Path | None:
    """Returns the guest's kernel, None where there is none.

    ``HAPTICBRIDGE_UML`` names it, or none by naming what is no program; else it is looked for in
    the cache folder to which ``scripts/build_uml`` builds, and in a folder shared by checkouts.
    """
    named = os.environ.get("HAPTICBRIDGE_UML")
    built = Path(platformdirs.user_cache_dir("hapticbridge", appauthor=False)) / "uml/linux"
    shared = CHECKOUT.parent / "shared/usblab/uml/min/linux"
    places = [Path(named)] if named else [built, shared]
    return next((place for place in places if os.access(place, os.X_OK)), None)


def has_pidff() -> bool:
    """Tells whether the guest's kernel has Linux's own driver for force feedback."""
    program = kernel()
    return program is not None and _PIDFF in program.read_bytes()


@dataclass(frozen=True)
class GuestRun:
    """End of a command in the guest.

    Attributes:
        status: Its exit status; None where the guest ended before it, or took too long.
        output: What it printed, and what the guest's kernel said where there is no status, or where
            that kernel killed the command.
        seconds: Of this machine's time, boot included.
        console: What the guest's kernel said, and why it was stopped if it was.
    """

    status: int | None
    output: str
    seconds: float
    console: str = ""

    def __str__(self) -> str:
        """Tells all of it: for whoever must find out what went wrong in there."""
        ending = "without a status" if self.status is None else f"with status {self.status}"
        said = [f"ended {ending} after {self.seconds:.1f} s of this machine's time; it printed:"]
        said.append(self.output.strip() or "nothing")
        if self.console.strip() not in self.output:
            said.append(f"and its kernel said:\n{self.console.strip()}")
        return "\n".join(said)


def run_in_guest(
    command: Sequence[str],
    folder: Path,
    *,
    environment: Mapping[str, str],
    timeout: float = 120.0,
    patience: float | None = None,
) -> GuestRun:
    """Runs a command as the only job of a freshly booted guest.

    Time is virtual: it passes only while everything in the guest waits, so that nothing depends on
    this machine's speed. It passes by 256 ns with each reading of the clock too, or who waits for
    it by reading would wait for ever. The guest writes to this machine's folder of compiled code.

    Args:
        command: The command and its arguments.
        folder: An existing folder, ``/run/job`` in the guest: what it writes there stays.
        environment: Variables for the command.
        timeout: In s of this machine's time.
        patience: Likewise: for how long it may print nothing; None: for as long as it likes.
    """
    program = kernel()
    if program is None:
        raise RuntimeError(NO_KERNEL)
    exports = [f"export {name}={shlex.quote(text)}" for name, text in environment.items()]
    (folder / "command").write_text("\n".join([*exports, shlex.join(command)]) + "\n")
    (folder / "status").unlink(missing_ok=True)
    root = "root=/dev/root rootfstype=hostfs rootflags=/ ro quiet con=null con0=null,fd:1 ssl=null"
    job = [f"job={folder}", f"compiled={_compiled_code()}"]
    init = f"init={CHECKOUT / 'tests/uml/init'}"
    virtual_time = "time-travel=inf-cpu"
    arguments = [str(program), f"mem={_MEMORY_MIB}M", *root.split(), init, *job, virtual_time]
    start = time.monotonic()
    # a group of its own: the guest's programs are processes of the host, and end with it
    guest = subprocess.Popen(
        arguments,
        env={"PATH": os.environ["PATH"], "HOME": str(folder), "TMPDIR": _memory_folder()},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        start_new_session=True,
    )
    output, status = folder / "output", folder / "status"
    console = _console(guest, output, timeout, patience)
    seconds = time.monotonic() - start
    said = output.read_text(errors="replace") if output.is_file() else ""
    if not status.is_file():
        return GuestRun(None, said + console, seconds, console)
    code = int(status.read_text())
    return GuestRun(code, said + console if code == _KILLED else said, seconds, console)


def _console(
    guest: subprocess.Popen[str], output: Path, timeout: float, patience: float | None
) -> str:
    """Waits for a guest's end, or brings it about; returns what its kernel said, or why."""
    start = heard = time.monotonic()
    size, reason = 0, ""
    while True:
        try:
            return guest.communicate(timeout=_LOOK)[0] + reason
        except subprocess.TimeoutExpired:
            now = time.monotonic()
        printed = output.stat().st_size if output.is_file() else 0
        if printed != size:
            size, heard = printed, now
        if now - start > timeout:
            reason = f"the guest was stopped after {timeout:g} s"
        elif patience is not None and now - heard > patience:
            reason = f"the guest was stopped: it had printed nothing for {patience:g} s"
        if reason:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(guest.pid, signal.SIGKILL)


def python_environment() -> dict[str, str]:
    """Returns the variables with which this project's Python runs in a guest."""
    return {
        "HOME": "/run/job",
        "TMPDIR": "/dev/shm",
        "PYTHONPATH": f"{CHECKOUT}:{CHECKOUT / 'tests'}",
        "PYTHONDONTWRITEBYTECODE": "1",
        "PYTHONHASHSEED": "0",
        # numba uses a cache only where it may write; the guest may write to this one
        "NUMBA_CACHE_DIR": "/run/compiled",
    }


def _compiled_code() -> Path:
    """Returns the folder of the host's compiled functions, made if missing."""
    named = os.environ.get("NUMBA_CACHE_DIR")
    folder = Path(named or platformdirs.user_cache_dir("hapticbridge", appauthor=False))
    folder.mkdir(parents=True, exist_ok=True)
    return folder.resolve()


def _memory_folder() -> str:
    """Returns where the guest's memory can lie: shared memory, where there is enough of it."""
    shared = Path("/dev/shm")
    if shared.is_dir() and shutil.disk_usage(shared).free > _MEMORY_MIB * 2**20:
        return str(shared)
    return tempfile.gettempdir()
