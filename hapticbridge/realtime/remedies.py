"""Commands that grant refused requests."""

from __future__ import annotations

import errno
import os
import sys
from pathlib import Path

PRIORITY = 80
"""Priority under SCHED_FIFO, 1 to 99. The kernel's interrupt threads run at 50, and the clock's
wake-up must not wait for them; 99 is used by the kernel's migration and watchdog threads."""

SHELL = f"sudo prlimit --pid $$ --rtprio={PRIORITY} --memlock=unlimited"
"""Command for one shell and the programs started from it, until it ends."""

LASTING = (
    f"in /etc/security/limits.d/99-realtime.conf the lines '@haptics - rtprio {PRIORITY}' and "
    "'@haptics - memlock unlimited', then 'sudo groupadd -f haptics', "
    "'sudo usermod -aG haptics $USER', and log in again"
)
"""Steps for a group of users, permanently; ``ulimit -r`` and ``ulimit -l`` then show the new
limits."""

CAPABILITIES = f"sudo setcap cap_sys_nice,cap_ipc_lock+ep {Path(sys.executable).resolve()}"
"""Grants the capabilities to this Python executable, and so to every user who may run it."""

CONTAINER = f"docker run --cap-add=SYS_NICE --cap-add=IPC_LOCK --ulimit rtprio={PRIORITY} …"
"""Command for a container; its administrator has only the rights given at the start."""


CORES = (
    "a control group that holds it: 'docker run --cpuset-cpus=…', or 'AllowedCPUs=…' in the "
    "systemd unit that this was started from"
)
"""Remedy for a core outside the process's control group."""

FILTER = (
    "docker run --cap-add=SYS_NICE …; outside a container start it where no filter of system calls "
    "(seccomp, systemd's SystemCallFilter=) keeps sched_setaffinity back"
)
"""Remedy for a process whose system call filter refuses pinning; Linux itself allows it."""


def way_to_pin(core: int, reason: int | None) -> str:
    """Returns the remedy for a refused core.

    ``reason`` is the ``errno`` of the refusal; None if the number is out of range.
    """
    if not 0 <= core < (os.cpu_count() or 1):
        return f"choose a core from 0 to {(os.cpu_count() or 1) - 1}"
    return CORES if reason == errno.EINVAL else FILTER


def is_administrator() -> bool:
    """Returns True if the process runs as root, even if root has few rights here."""
    return hasattr(os, "geteuid") and os.geteuid() == 0


def way_to_grant() -> str:
    """Returns the shortest command that grants real time to this process."""
    return CONTAINER if is_administrator() else SHELL
