"""A User-Mode Linux as a place to run commands: a real kernel that is an ordinary process.

The guest sees the host's files, read-only, so the same interpreter and packages run there.
"""

from __future__ import annotations

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
_MEMORY_MIB = 1024

NO_KERNEL = "no User-Mode Linux kernel: scripts/build_uml builds one, or HAPTICBRIDGE_UML names one"


def kernel() -> Path | None:
    """Returns the guest's kernel, None where there is none.

    ``HAPTICBRIDGE_UML`` names it, or none by naming what is no program; else it is looked for in
    the cache folder to which ``scripts/build_uml`` builds, and in a folder shared by checkouts.
    """
    named = os.environ.get("HAPTICBRIDGE_UML")
    places = (
        [Path(named)]
        if named
        else [
            Path(platformdirs.user_cache_dir("hapticbridge", appauthor=False)) / "uml/linux",
            CHECKOUT.parent / "shared/usblab/uml/min/linux",
        ]
    )
    return next((place for place in places if os.access(place, os.X_OK)), None)


@dataclass(frozen=True)
class GuestRun:
    """How a command in the guest ended.

    Attributes:
        status: Its exit status; None where the guest ended before it, or took too long.
        output: What it printed, or what the guest's kernel said where there is no status.
        seconds: Of this machine's time, boot included.
    """

    status: int | None
    output: str
    seconds: float


def run_in_guest(
    command: Sequence[str],
    folder: Path,
    *,
    environment: Mapping[str, str],
    is_virtual: bool,
    timeout: float = 120.0,
) -> GuestRun:
    """Runs a command as the only job of a freshly booted guest.

    Args:
        command: The command and its arguments.
        folder: An existing folder, ``/run/job`` in the guest: what it writes there stays.
        environment: Variables for the command.
        is_virtual: Time passes only while everything in the guest waits, so that nothing depends on
            this machine's speed.
        timeout: In s of this machine's time.
    """
    program = kernel()
    if program is None:
        raise RuntimeError(NO_KERNEL)
    exports = [f"export {name}={shlex.quote(text)}" for name, text in environment.items()]
    (folder / "command").write_text("\n".join([*exports, shlex.join(command)]) + "\n")
    (folder / "status").unlink(missing_ok=True)
    arguments = [
        str(program),
        f"mem={_MEMORY_MIB}M",
        "root=/dev/root",
        "rootfstype=hostfs",
        "rootflags=/",
        "ro",
        "quiet",
        "con=null",
        "con0=null,fd:1",
        "ssl=null",
        f"init={CHECKOUT / 'tests/uml/init'}",
        f"job={folder}",
        f"compiled={_compiled_code()}",
        *(["time-travel=inf-cpu"] if is_virtual else []),
    ]
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
    try:
        console, _ = guest.communicate(timeout=timeout)
    except subprocess.TimeoutExpired:
        os.killpg(guest.pid, signal.SIGKILL)
        guest.communicate()
        console = f"the guest was stopped after {timeout:g} s"
    seconds = time.monotonic() - start
    output, status = folder / "output", folder / "status"
    if not status.is_file():
        said = output.read_text(errors="replace") if output.is_file() else ""
        return GuestRun(None, said + console, seconds)
    return GuestRun(int(status.read_text()), output.read_text(errors="replace"), seconds)


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
