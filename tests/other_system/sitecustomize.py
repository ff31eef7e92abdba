"""Makes a Python of Linux look like one of macOS or Windows to the modules of hapticbridge.

Python runs this file at its start if its folder is on ``PYTHONPATH``, so the children of a process
look alike. ``OTHER_SYSTEM`` is ``darwin`` or ``win32``. The standard library and other packages
keep what Linux has: they have their own ways on the other systems, which are not tested here.
"""

import builtins
import importlib
import os
import sys
from typing import Any

SYSTEM = os.environ.get("OTHER_SYSTEM", "")

LACKS = {
    "darwin": {
        "modules": ("evdev", "pyudev"),
        "os": (
            "sched_", "SCHED_", "memfd_create", "MFD_", "eventfd", "EFD_", "O_PATH", "O_TMPFILE",
            "copy_file_range", "splice", "SPLICE_", "pidfd_open", "posix_fallocate",
            "posix_fadvise", "setns", "unshare", "CLONE_", "getrandom", "sendfile",
        ),
        "signal": ("sigtimedwait", "sigwaitinfo", "pidfd_send_signal", "SIGRT", "SIGPOLL"),
        "resource": ("RLIMIT_RTPRIO", "prlimit"),
        "time": ("CLOCK_BOOTTIME", "CLOCK_TAI"),
        "select": ("epoll", "EPOLL"),
    },
}  # fmt: skip
LACKS["win32"] = {
    "modules": (
        *LACKS["darwin"]["modules"], "fcntl", "grp", "pty", "pwd", "resource", "syslog", "termios",
        "tty",
    ),
    "os": (
        *LACKS["darwin"]["os"], "fork", "forkpty", "getuid", "geteuid", "getgid", "getegid",
        "getgroups", "fchmod", "fchown", "chown", "mkfifo", "mknod", "killpg", "nice",
        "getpriority", "setpriority", "setsid", "getpgid",
        "WNOHANG", "wait3", "wait4", "uname", "O_NONBLOCK", "O_CLOEXEC", "O_NOFOLLOW",
        "O_DIRECTORY", "O_NOCTTY", "O_SYNC", "statvfs", "sysconf", "openpty",
        *(() if sys.version_info >= (3, 12) else ("set_blocking", "get_blocking")),
    ),
    "signal": (
        *LACKS["darwin"]["signal"], "SIGHUP", "SIGQUIT", "SIGTSTP", "SIGKILL", "SIGSTOP",
        "SIGALRM", "SIGXCPU", "SIGPROF", "SIGPIPE", "SIGUSR1", "SIGUSR2", "SIGCHLD", "SIGWINCH",
        "setitimer", "alarm", "ITIMER_", "pthread_", "SIG_BLOCK", "SIG_UNBLOCK", "SIG_SETMASK",
        "sigwait", "sigpending", "siginterrupt", "pause",
    ),
    "time": (*LACKS["darwin"]["time"], "clock_gettime", "clock_getres", "CLOCK_", "pthread_"),
    "select": (*LACKS["darwin"]["select"], "poll", "POLL"),
}  # fmt: skip
"""Modules, and beginnings of names in modules, that Linux has and the other system has not."""


COMPILER = "hapticbridge.kernel.jit"
"""Module that sees Linux: elsewhere numba compiles all for minutes (``test_machine_code``)."""


class Seen:
    """A module as it is on the other system: names that it has not are not found."""

    __slots__ = ("_lacking", "_module")

    def __init__(self, name: str, lacking: tuple[str, ...]) -> None:
        object.__setattr__(self, "_module", importlib.import_module(name))
        object.__setattr__(self, "_lacking", lacking)

    def __getattr__(self, name: str) -> Any:
        module: Any = object.__getattribute__(self, "_module")
        lacking: tuple[str, ...] = object.__getattribute__(self, "_lacking")
        if name == "platform" and module is sys:
            return SYSTEM
        if name == "open" and module is os:
            return opened
        if name.startswith(lacking):
            raise AttributeError(f"'{module.__name__}' of {SYSTEM} has no '{name}'")
        return getattr(module, name)

    def __setattr__(self, name: str, value: object) -> None:
        setattr(object.__getattribute__(self, "_module"), name, value)


def opened(path: Any, *arguments: Any, **named: Any) -> int:
    """Opens a file as ``os.open`` does; there is no folder of shared memory."""
    if os.fspath(path).startswith("/dev/shm"):
        raise FileNotFoundError(2, "No such file or directory", path)
    return os.open(path, *arguments, **named)


def cross() -> None:
    """Gives modules of hapticbridge the modules of the other system from now on."""
    lacking = LACKS[SYSTEM]
    absent = lacking.pop("modules")
    seen = {name: Seen(name, names) for name, names in {"sys": ("\0",), **lacking}.items()}
    usual = builtins.__import__

    def imported(*arguments: Any, **named: Any) -> Any:
        names = ("name", "globals", "locals", "fromlist", "level")
        given = {**dict(zip(names, arguments, strict=False)), **named}
        importer = (given.get("globals") or {}).get("__name__") or ""
        is_ours = importer.startswith("hapticbridge") and importer != COMPILER
        if not given.get("level") and is_ours:
            if given["name"] in absent:
                raise ModuleNotFoundError(f"{SYSTEM} has no module '{given['name']}'")
            if given["name"] in seen:
                return seen[given["name"]]
        return usual(*arguments, **named)

    builtins.__import__ = imported


if SYSTEM:
    cross()
