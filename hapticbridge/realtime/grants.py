"""Real-time requests of the loop, undone when it ends.

The kernel may pause an ordinary process, take its memory pages away and move it between cores. Each
request removes one of these causes of late ticks. A refusal is reported with the command that
grants it.
"""

from __future__ import annotations

import ctypes
import gc
import os
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from hapticbridge.clock import Clock, RealClock
from hapticbridge.errors import HapticBridgeError
from hapticbridge.realtime.remedies import PRIORITY, way_to_grant, way_to_pin

if sys.platform != "win32":
    import resource

_LOCK_PRESENT, _LOCK_FUTURE = 1, 2  # MCL_CURRENT, MCL_FUTURE
_SET_TIMER_SLACK, _GET_TIMER_SLACK = 29, 30  # prctl
TIMER_SLACK_NS = 1
"""Timer slack in ns: time by which the kernel may delay a wake-up to combine it with others.
Ordinary threads start with 50 000 ns, 5 % of a period of 1 ms."""

ISOLATED = Path("/sys/devices/system/cpu/isolated")


@dataclass(frozen=True, slots=True)
class Grant:
    """Result of one request.

    Attributes:
        name: ``scheduling``, ``memory``, ``core``, ``timer`` or ``collector``.
        is_granted: True if it is in force while the loop runs.
        sentence: The grant; or the refusal with reason and consequence.
        remedy: Command that grants it; empty if granted or impossible.
    """

    name: str
    is_granted: bool
    sentence: str
    remedy: str = ""


def wants_real_time(asked: bool | None, clock: Clock, *, is_real: bool) -> bool:
    """Decides if a run requests real time.

    ``asked`` is the user's choice; None requests it for a device with motors on a real clock.

    Raises:
        HapticBridgeError: Real time was requested with a clock that is not real.
    """
    if asked and clock.name != RealClock.name:
        raise HapticBridgeError(
            f"real time and a {clock.name} clock exclude each other; request only one of them"
        )
    return is_real and clock.name == RealClock.name if asked is None else asked


@contextmanager
def memory_at_rest() -> Iterator[tuple[Grant, ...]]:
    """Locks the process's memory and stops the garbage collector; undone at the end.

    It takes a third of a second, so call it before a hand holds the device.

    Yields:
        One result per request.
    """
    with ExitStack() as restore:
        yield _collector(restore), _memory(restore)


@contextmanager
def real_time(core: int | None = None) -> Iterator[tuple[Grant, ...]]:
    """Requests real time for the calling thread; undone at the end.

    Threads and processes started meanwhile do not inherit the priority. Without ``core`` it takes
    an isolated core, or else the last allowed one, because the first serves most interrupts.

    Yields:
        One result per request.
    """
    with ExitStack() as restore:
        # the priority comes last, so that no other request runs under it
        yield _timer(restore), _core(restore, core), _scheduling(restore)


def current_priority() -> int:
    """Returns the calling thread's priority under SCHED_FIFO, 1 to 99; 0 without one."""
    return os.sched_getparam(0).sched_priority if hasattr(os, "sched_getparam") else 0


def warn_of_refusals(grants: tuple[Grant, ...]) -> None:
    """Warns of each refused request, with the command that grants it."""
    for grant in grants:
        if not grant.is_granted:
            remedy = f"; to grant it: {grant.remedy}" if grant.remedy else ""
            warnings.warn(f"real time: {grant.sentence}{remedy}", stacklevel=3)


def shown_limit(limit: int, unit: int = 1) -> str:
    """Formats a limit of ``resource.getrlimit`` as ``ulimit`` shows it."""
    return "unlimited" if limit == resource.RLIM_INFINITY else str(limit // unit)


def _scheduling(restore: ExitStack) -> Grant:
    name = "scheduling"
    if not hasattr(os, "sched_setscheduler"):
        return Grant(name, False, f"{sys.platform} has no SCHED_FIFO; only Linux is supported")
    policy, parameter = os.sched_getscheduler(0), os.sched_getparam(0)
    limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    # a lower priority still helps: any real-time priority precedes all ordinary threads
    wanted = dict.fromkeys((PRIORITY, min(PRIORITY, limit)) if limit > 0 else (PRIORITY,))
    for priority in wanted:
        try:
            os.sched_setscheduler(
                0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority)
            )
        except OSError as error:
            reason = error.strerror
        else:
            restore.callback(os.sched_setscheduler, 0, policy, parameter)
            less = f", not {PRIORITY}: the limit 'ulimit -r' allows no more"
            return Grant(
                name, True, f"SCHED_FIFO at priority {priority}{less * (priority < PRIORITY)}"
            )
    return Grant(
        name,
        False,
        f"SCHED_FIFO was refused ({reason}; the limit 'ulimit -r' is {shown_limit(limit)}): any "
        "other busy process can make a tick late by milliseconds",
        way_to_grant(),
    )


def _memory(restore: ExitStack) -> Grant:
    name = "memory"
    if sys.platform != "linux":
        return Grant(name, False, f"memory is not locked on {sys.platform}; only Linux does it")
    library = ctypes.CDLL(None, use_errno=True)
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    # Under a limit, locking future memory would make an allocation beyond it fail during the run.
    # A process larger than the limit can lock only with CAP_IPC_LOCK, which lifts the limit.
    is_bound = limit != resource.RLIM_INFINITY and _mapped() <= limit
    whole = _LOCK_PRESENT | _LOCK_FUTURE
    for flags in (_LOCK_PRESENT,) if is_bound else (whole, _LOCK_PRESENT):
        if library.mlockall(flags) == 0:
            restore.callback(library.munlockall)
            shown = "all memory is locked"
            if flags != whole:
                shown = "the memory in use is locked, later allocations are not"
            if is_bound:
                shown += (
                    f": the limit 'ulimit -l' of {shown_limit(limit, 1024)} kB could make them fail"
                )
            return Grant(name, True, shown)
    reason = os.strerror(ctypes.get_errno())
    return Grant(
        name,
        False,
        f"memory could not be locked ({reason}; the limit 'ulimit -l' is "
        f"{shown_limit(limit, 1024)} kB): a page that the system removed makes a tick late",
        way_to_grant(),
    )


def _mapped() -> int:
    """Returns the size in bytes of the process's mapped memory, which is what would be locked."""
    pages = Path("/proc/self/statm").read_text(encoding="utf-8").split()[0]
    return int(pages) * resource.getpagesize()


def _timer(restore: ExitStack) -> Grant:
    name = "timer"
    if sys.platform != "linux":
        return Grant(name, False, f"the timer's slack cannot be set on {sys.platform}")
    library = ctypes.CDLL(None, use_errno=True)
    before = library.prctl(_GET_TIMER_SLACK, 0, 0, 0, 0)
    if before < 0 or library.prctl(_SET_TIMER_SLACK, TIMER_SLACK_NS, 0, 0, 0) != 0:
        reason = os.strerror(ctypes.get_errno())
        return Grant(
            name, False, f"the timer's slack of 50 µs stays ({reason}): wake-ups are that late"
        )
    restore.callback(library.prctl, _SET_TIMER_SLACK, before, 0, 0, 0)
    return Grant(name, True, f"timer slack {TIMER_SLACK_NS} ns instead of {before * 1e-3:g} µs")


def _core(restore: ExitStack, core: int | None) -> Grant:
    name = "core"
    if not hasattr(os, "sched_setaffinity"):
        return Grant(name, False, f"{sys.platform} pins no thread to a core; only Linux does")
    allowed, isolated = os.sched_getaffinity(0), _isolated_cores()
    chosen = loop_core() if core is None else core
    try:
        os.sched_setaffinity(0, {chosen})
    except (OSError, ValueError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or error
        sentence = (
            f"the loop could not be pinned to core {chosen} ({reason}): migrations make ticks late"
        )
        return Grant(name, False, sentence, way_to_pin(chosen, getattr(error, "errno", None)))
    restore.callback(os.sched_setaffinity, 0, allowed)
    kind = "isolated core" if chosen in isolated else "core"
    return Grant(name, True, f"pinned to {kind} {chosen} of {len(allowed | isolated)}")


def loop_core() -> int:
    """Returns the default core of a loop; on Linux only."""
    return min(_isolated_cores(), default=max(os.sched_getaffinity(0)))


def _isolated_cores() -> set[int]:
    """Returns the cores that the kernel keeps free of other work (``isolcpus``)."""
    try:
        text = ISOLATED.read_text(encoding="utf-8").strip()
    except OSError:
        return set()
    cores: set[int] = set()
    for part in filter(None, text.split(",")):
        first, _, last = part.partition("-")
        cores.update(range(int(first), int(last or first) + 1))
    return cores


def _collector(restore: ExitStack) -> Grant:
    """Stops Python's collector of reference cycles, which would pause the loop for milliseconds."""
    was_enabled, had_frozen = gc.isenabled(), gc.get_freeze_count() > 0
    gc.collect()
    gc.freeze()
    gc.disable()
    undo: list[Callable[[], None]] = [gc.enable] if was_enabled else []
    if not had_frozen:
        undo.append(gc.unfreeze)
    for call in undo:
        restore.callback(call)
    return Grant("collector", True, "the garbage collector is frozen")
