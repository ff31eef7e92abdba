"""Real-time requests of the loop, lateness of its ticks, and time of a scene's step.

The requests are undone when the loop ends. The kernel may pause an ordinary process, take its
memory pages away and move it between cores. Each request removes one of these causes of late ticks.
A refusal is reported with the command that grants it.
"""

from __future__ import annotations

import copy
import ctypes
import errno
import gc
import math
import os
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from hapticbridge.clock import Clock, RealClock
from hapticbridge.coupling import Coupling
from hapticbridge.demand.methods import Method, unguarded_parameters
from hapticbridge.errors import HapticBridgeError, SceneError
from hapticbridge.kernel.codes import OK
from hapticbridge.kernel.jit import direct
from hapticbridge.kernel.mujoco_c import quiet
from hapticbridge.kernel.parameters import MAX_SCENE_TICKS
from hapticbridge.kernel.record import SAMPLE_DTYPE
from hapticbridge.kernel.state import BoundKernel
from hapticbridge.kernel.tick import after_step, before_step
from hapticbridge.scene import Scene
from hapticbridge.units import format_number

# Time stolen by the host of a virtual machine

_STOLEN = 8
"""Column of the line ``cpu`` in ``/proc/stat``; column 0 is the line's name."""


def stolen_time(proc: Path = Path("/proc")) -> float | None:
    """Returns the time in s that the host took from all cores since the start.

    The resolution is one clock tick, usually 10 ms. Returns None if the kernel does not report it.
    """
    try:
        columns = (proc / "stat").read_text(encoding="utf-8").split("\n", 1)[0].split()
        return int(columns[_STOLEN]) / os.sysconf("SC_CLK_TCK")
    except (OSError, IndexError, ValueError, AttributeError):
        return None


# Statistics of a loop's lateness


@dataclass(frozen=True, slots=True)
class Lateness:
    """Lateness of the ticks of one loop; times in s.

    Attributes:
        ticks: Number of ticks that woke.
        missed: Number of deadlines without a tick.
        median: Median.
        p99: 99th percentile.
        p999: 99.9th percentile.
        worst: Maximum.
    """

    ticks: int
    missed: int
    median: float
    p99: float
    p999: float
    worst: float

    def sentence(self) -> str:
        """Formats the numbers in µs, in one line."""
        return (
            f"p50 {self.median * 1e6:.0f}, p99 {self.p99 * 1e6:.0f}, p99.9 {self.p999 * 1e6:.0f}, "
            f"max {self.worst * 1e6:.0f} µs, {self.missed} of {self.ticks + self.missed} missed"
        )


def lateness_of(late_ns: ArrayLike, missed: int) -> Lateness:
    """Returns the percentiles of times from deadline to wake-up.

    Times are in ns; 0 or less counts as on time.

    Raises:
        HapticBridgeError: There are no times.
    """
    late = np.maximum(np.asarray(late_ns, dtype=np.float64).ravel(), 0.0) * 1e-9
    if late.size == 0:
        raise HapticBridgeError("no tick woke, so there is no lateness; run it for longer")
    late.sort()
    # without interpolation, so each percentile is a measured lateness
    median, p99, p999 = (
        float(late[-(-late.size * thousandths // 1000) - 1]) for thousandths in (500, 990, 999)
    )
    return Lateness(
        ticks=int(late.size),
        missed=missed,
        median=median,
        p99=p99,
        p999=p999,
        worst=float(late[-1]),
    )


# Check that a scene's step fits into the period

STEPS, LONGEST = 50, 0.1
"""Largest number of timed steps, and time in s after which no further one starts. One interruption
does not move the median of so many, and the wait is not noticed."""

BESIDE_THE_STEP = 5e-6
"""Time in s of a tick outside MuJoCo's step. Device, wrench, ledger, guard and record take 3 to 4
µs on a 3 GHz core. A smaller value promises a rate that cannot be held."""

SPARE = 0.8
"""Share of the period that a tick may fill, without unit. Contacts cost more than the start does,
and a tick that fills its period misses the next deadline."""


def check_pace(
    scene: Scene, method: Method, period: float, substeps: int, *, is_real: bool
) -> None:
    """Refuses a scene that cannot hold the rate on a real device; warns on others.

    A missed deadline prolongs the hold, and the condition b > KT/2 + B' then needs more damping.
    The scene must be prepared; it is not changed.

    Raises:
        SceneError: The steps of a tick take longer than the period; the message names a possible
            rate.
    """
    needed = substeps * step_time(scene, method)
    if needed <= period:
        return
    held = format_number(rate_for(needed), 2)
    message = (
        f"scene '{scene.name}' needs {format_number(needed * 1e3, 3)} ms of MuJoCo a tick at its "
        f"start, the period is {format_number(period * 1e3, 3)} ms; it could hold about {held} "
        f"Hz: {'leave out --scene-rate' if method.can_be_slow else 'choose another --method'}, "
        "lower the rate, or find the cause with 'hapticbridge check'"
    )
    if is_real:
        raise SceneError(message)
    warnings.warn(message, stacklevel=2)


def warn_of_slow_motion(scene: Scene, method: Method, period: float, substeps: int) -> None:
    """Warns of a scene beside the loop whose ``substeps`` take longer than its own period in s."""
    needed = substeps * step_time(scene, method)
    if needed > period:
        warnings.warn(
            f"scene '{scene.name}' needs {format_number(needed * 1e3, 3)} ms for "
            f"{format_number(period * 1e3, 3)} ms of its time, so it runs in slow motion; it can "
            f"keep --scene-rate {format_number(SPARE / needed, 2)}",
            stacklevel=2,
        )


def rate_for(needed: float) -> float:
    """Returns the rate in Hz that ticks hold whose steps take ``needed`` s, > 0 and finite."""
    return SPARE / (needed + BESIDE_THE_STEP)


def scene_ticks_for(needed: float, period: float) -> int:
    """Returns the ticks between two results of a scene whose steps take ``needed`` s each time.

    0 if the loop can step the scene in every tick of ``period`` s. Else its thread fills ``SPARE``
    of its time.
    """
    if rate_for(needed) * period >= 1.0:
        return 0
    return min(max(math.ceil(needed / (SPARE * period)), 2), MAX_SCENE_TICKS)


def step_time(scene: Scene, method: Method) -> float:
    """Returns the median time in s of MuJoCo's step from the scene's state, measured on a copy."""
    data, step, now = copy.copy(scene.data), method.step, time.perf_counter_ns
    step(scene.model, data)  # not counted, because caches are cold
    times: list[int] = []
    begin = now()
    while len(times) < STEPS and (not times or now() - begin < LONGEST * 1e9):
        started = now()
        step(scene.model, data)
        times.append(now() - started)
    return float(np.median(times)) * 1e-9


CALM = 0.1
"""Share of the period below which a scene's step at its start is no matter; a stirred scene takes
up to 25 times as long, and one of a few bodies never a millisecond."""

STIRRED_STEPS, STIRRED_TIME = 100, 1.0
"""Steps of a rehearsal, and processor time in s after which it ends early."""

STIR = (0.02, 0.02, 0.05)
"""Way of the rehearsal's handle to both sides of the grip, and below it, in m."""

_STIR_COUPLING = Coupling(800.0, 1.0)


def busy_step_time(scene: Scene, method: Method, period: float) -> float:
    """Returns the time in s of nine of ten of a scene's steps while a hand stirs in it.

    A scene that steps within ``CALM`` of the period at its start is not stirred. Another one is
    driven for a second of its time, by steps of ten periods, and reset.

    Args:
        scene: The loaded scene.
        method: The rendering method, one that can be slow.
        period: T in s.
    """
    at_start = step_time(scene, method)
    if at_start < CALM * period:
        return at_start
    step = 10.0 * period
    parameters = unguarded_parameters(scene, _STIR_COUPLING, step, 1, method)
    bound, sample = BoundKernel(scene.model, scene.data, parameters), np.zeros(1, SAMPLE_DTYPE)
    sample["quaternion"][0, 0] = 1.0
    before = direct(before_step, bound.state, sample, bound.row, 0, 0.0)
    end = direct(after_step, bound.state, bound.row, 0)
    times = [at_start]
    with suppress(mujoco.FatalError), quiet():  # what diverges here is said when the run does
        for k in range(STIRRED_STEPS):
            angle = 2.0 * math.pi * k / STIRRED_STEPS
            shares = math.sin(3.0 * angle), math.sin(2.0 * angle), 0.5 * (math.cos(angle) - 1.0)
            sample["position"][0] = np.multiply(STIR, shares)
            began = time.thread_time()
            is_done = before(bound.state, sample, bound.row, 0, step) == OK
            if is_done:
                bound.step(scene.model, scene.data)
                is_done = end(bound.state, bound.row, 0) == OK
            times.append(time.thread_time() - began)
            if not is_done or sum(times) > STIRRED_TIME:
                break
    bound.release()
    scene.reset()
    return float(np.quantile(times, 0.9))


# Commands that grant refused requests

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


def is_administrator() -> bool:
    """Returns True if the process runs as root, even if root has few rights here."""
    return hasattr(os, "geteuid") and os.geteuid() == 0


def way_to_grant() -> str:
    """Returns the shortest command that grants real time to this process."""
    return CONTAINER if is_administrator() else SHELL


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


def wants_real_time(requested: bool | None, clock: Clock, *, is_real: bool) -> bool:
    """Decides if a run requests real time.

    ``requested`` is the user's choice; None requests it for a device with motors on a real clock.

    Raises:
        HapticBridgeError: Real time was requested with a clock that is not real.
    """
    if requested and clock.name != RealClock.name:
        raise HapticBridgeError(
            f"real time and a {clock.name} clock exclude each other; request only one of them"
        )
    return is_real and clock.name == RealClock.name if requested is None else requested


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
def real_time() -> Iterator[tuple[Grant, ...]]:
    """Requests real time for the calling thread; undone at the end.

    Threads and processes started meanwhile do not inherit the priority. It takes an isolated
    core, or else the last allowed one, because the first serves most interrupts.

    Yields:
        One result per request.
    """
    with ExitStack() as restore:
        # the priority comes last, so that no other request runs under it
        yield _timer(restore), _core(restore), _scheduling(restore)


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


def _core(restore: ExitStack) -> Grant:
    name = "core"
    if not hasattr(os, "sched_setaffinity"):
        return Grant(name, False, f"{sys.platform} pins no thread to a core; only Linux does")
    allowed, isolated = os.sched_getaffinity(0), _isolated_cores()
    chosen = loop_core()
    try:
        os.sched_setaffinity(0, {chosen})
    except OSError as error:
        sentence = f"the loop could not be pinned to core {chosen} ({error.strerror})"
        remedy = CORES if error.errno == errno.EINVAL else FILTER
        return Grant(name, False, f"{sentence}: migrations make ticks late", remedy)
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
