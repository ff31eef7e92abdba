"""The commands that grant what the system refused."""

from __future__ import annotations

import errno
import os
import sys
from pathlib import Path

PRIORITY = 80
"""Priority under SCHED_FIFO, 1 to 99. The kernel's own interrupt threads run at 50, and the clock's
wake-up must not wait for them; 99 belongs to the kernel's migration and watchdog threads."""

SHELL = f"sudo prlimit --pid $$ --rtprio={PRIORITY} --memlock=unlimited"
"""For a shell and what is started from it, until it ends."""

LASTING = (
    f"in /etc/security/limits.d/99-realtime.conf the lines '@haptics - rtprio {PRIORITY}' and "
    "'@haptics - memlock unlimited', then 'sudo groupadd -f haptics', "
    "'sudo usermod -aG haptics $USER', and log in again"
)
"""For a group of users, for good; ``ulimit -r`` and ``ulimit -l`` then show the new limits."""

CAPABILITIES = f"sudo setcap cap_sys_nice,cap_ipc_lock+ep {Path(sys.executable).resolve()}"
"""For whoever starts this interpreter, behind whatever link; who may is then anybody."""

CONTAINER = f"docker run --cap-add=SYS_NICE --cap-add=IPC_LOCK --ulimit rtprio={PRIORITY} …"
"""For a container, whose administrator has no more rights than it was given."""


CORES = (
    "a control group that holds it: 'docker run --cpuset-cpus=…', or 'AllowedCPUs=…' in the "
    "systemd unit that this was started from"
)
"""For a core that is there but not among those of the process's control group."""

FILTER = (
    "docker run --cap-add=SYS_NICE …; outside a container start it where no filter of system calls "
    "(seccomp, systemd's SystemCallFilter=) keeps sched_setaffinity back"
)
"""For a process that may not say where it runs: by itself Linux lets every one."""


def way_to_pin(core: int, reason: int | None) -> str:
    """Returns what gives the loop a core that was refused.

    Args:
        core: Its number.
        reason: ``errno`` of the refusal; None where the number is none.
    """
    if not 0 <= core < (os.cpu_count() or 1):
        return f"choose a core from 0 to {(os.cpu_count() or 1) - 1}"
    return CORES if reason == errno.EINVAL else FILTER


def is_administrator() -> bool:
    """Tells whether this process has the administrator's number, whatever that is worth here."""
    return hasattr(os, "geteuid") and os.geteuid() == 0


def way_to_grant() -> str:
    """Returns the shortest command for whoever runs this process."""
    return CONTAINER if is_administrator() else SHELL
