"""The commands that grant what the system refused."""

from __future__ import annotations

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


def is_administrator() -> bool:
    """Tells whether this process has the administrator's number, whatever that is worth here."""
    return hasattr(os, "geteuid") and os.geteuid() == 0


def way_to_grant() -> str:
    """Returns the shortest command for whoever runs this process."""
    return CONTAINER if is_administrator() else SHELL
