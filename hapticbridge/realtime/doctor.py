"""Fitness of this machine for the loop: measurement, findings and verdict."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hapticbridge.arguments import Arguments
from hapticbridge.clock import RealClock, period_of
from hapticbridge.confinement import means
from hapticbridge.device.discovery import blind_spots, plugged_devices
from hapticbridge.device.watchdog import MIN_WATCHDOG
from hapticbridge.errors import HapticBridgeError, choices
from hapticbridge.realtime import (
    Grant,
    Lateness,
    current_priority,
    lateness_of,
    memory_at_rest,
    real_time,
    stolen_time,
)
from hapticbridge.realtime.realtime import CAPABILITIES, LASTING, SHELL

# Baseline of a C program, ``cyclictest``

INSTALL = "sudo apt install rt-tests"
_MAX_US = 50_000
"""Width of the histogram in µs; later wake-ups count as the maximum."""

_TRIAL_NS = 1_000_000
"""Period in ns of the single wake-up that tests if the program runs."""

_PATIENCE = 5.0
"""Time in s, beyond twice the expected duration, after which a run is aborted."""

_BAR = re.compile(r"^(\d{6,}) (\d+)", re.MULTILINE)
_MAXIMUM = re.compile(r"^# Max Latencies: (\d+)", re.MULTILINE)
_OVERFLOWS = re.compile(r"^# Histogram Overflows: (\d+)", re.MULTILINE)


def lateness_above_baseline(period_ns: int, late_ns: NDArray[np.int64]) -> Lateness:
    """Returns the statistics of a run; each whole period of lateness is a skipped deadline."""
    return lateness_of(late_ns, int((late_ns // period_ns).sum()))


def is_there() -> bool:
    """Returns True if the program is installed."""
    return shutil.which("cyclictest") is not None


def refusal(priority: int, *, locks_memory: bool) -> str:
    """Returns the reason why the program cannot run here; empty if it can.

    It is part of the kernel developers' real-time tests (Debian: ``apt install rt-tests``).
    ``priority`` is 0 if SCHED_FIFO was refused.
    """
    if not is_there():
        return "it is not installed"
    if priority <= 0:
        return "it needs SCHED_FIFO, which was refused"
    answer = run(_TRIAL_NS, 1, priority, locks_memory=locks_memory)
    return answer if isinstance(answer, str) else ""


def run(
    period_ns: int, ticks: int, priority: int, *, locks_memory: bool, core: int | None = None
) -> NDArray[np.int64] | str:
    """Runs one thread at the loop's priority; returns the lateness of each tick in ns.

    The program takes whole µs and skips missed deadlines. Without ``core`` the thread may move.

    Returns:
        The lateness, or the reason of a failure in words.
    """
    period_us = max(round(period_ns * 1e-3), 1)
    command = ["cyclictest", "--quiet", f"--priority={priority}", f"--interval={period_us}"]
    command += [f"--loops={ticks}", f"--histogram={_MAX_US}"]
    command += ["--mlockall"] if locks_memory else []
    command += [] if core is None else [f"--affinity={core}"]
    try:
        done = subprocess.run(
            command,
            capture_output=True,
            text=True,
            timeout=_PATIENCE + 2e-9 * period_ns * ticks,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return f"it did not finish at {1e9 / period_ns:g} Hz"
    except OSError as error:
        return f"it cannot be started ({error.strerror})"
    late = parsed(done.stdout) if done.returncode == 0 else None
    if late is None:
        output = (done.stderr or done.stdout).strip().splitlines() or [f"status {done.returncode}"]
        return f"it failed: {output[-1].strip()}"
    return late


def parsed(text: str) -> NDArray[np.int64] | None:
    """Parses the histogram of ``cyclictest --histogram``; returns None if there is none."""
    bars = [(int(late), int(count)) for late, count in _BAR.findall(text)]
    late = [np.full(count, 1000 * us, dtype=np.int64) for us, count in bars]
    maximum, overflows = _MAXIMUM.search(text), _OVERFLOWS.search(text)
    if maximum and overflows:
        late.append(np.full(int(overflows[1]), 1000 * int(maximum[1]), dtype=np.int64))
    joined = np.concatenate(late) if late else np.zeros(0, dtype=np.int64)
    return joined if joined.size else None


# Properties of the machine that decide a loop's lateness

STOLEN_SHARE = 1e-3
"""Share of the measured time that a virtual machine's host may take, without unit. A millisecond
per second is one tick per second at 1 kHz."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One finding.

    Attributes:
        name: Subject.
        is_good: True if it helps, False if it hinders, None if it is unknown or has no effect.
        sentence: State and consequence.
        remedy: Command or advice; empty if none is needed.
    """

    name: str
    is_good: bool | None
    sentence: str
    remedy: str = ""


@dataclass(frozen=True, slots=True)
class System:
    """Roots of the kernel's file systems.

    Attributes:
        sys: Root of sysfs.
        proc: Root of procfs.
    """

    sys: Path = Path("/sys")
    proc: Path = Path("/proc")

    def text(self, path: Path) -> str | None:
        """Returns the content of a kernel file; None if it is missing or unreadable."""
        try:
            return path.read_text(encoding="utf-8", errors="replace").strip()
        except OSError:
            return None


def findings(
    system: System, grants: tuple[Grant, ...], stolen: float = 0.0, duration: float = 1.0
) -> tuple[Finding, ...]:
    """Inspects the machine; properties that the system does not show become findings too.

    ``stolen`` is the time in s that the host took from all cores during ``duration`` s.
    """
    return (
        *(Finding(g.name, g.is_granted, g.sentence, g.remedy) for g in grants),
        *_lasting_ways(grants),
        _throttling(system),
        _preemption(system),
        _governor(system),
        _cores(),
        _host(system, stolen, duration),
        _usb(),
        _confinement(),
    )


def _lasting_ways(grants: tuple[Grant, ...]) -> tuple[Finding, ...]:
    """Returns permanent ways to grant requests that a command grants to one shell only."""
    if all(grant.remedy != SHELL for grant in grants):
        return ()
    return (
        Finding(
            "for good",
            None,
            "that command lasts as long as its shell; permissions can also be granted permanently",
            f"{LASTING}; or for this interpreter alone: {CAPABILITIES}",
        ),
    )


def _throttling(system: System) -> Finding:
    """Checks the share of each second after which the kernel stops real-time threads."""
    name = "throttling"
    budget = system.text(system.proc / "sys/kernel/sched_rt_runtime_us")
    whole = system.text(system.proc / "sys/kernel/sched_rt_period_us")
    if budget is None or whole is None:
        return Finding(name, None, "the share of real-time threads is not visible here")
    if int(budget) < 0:
        return Finding(name, True, "real-time threads are never stopped by the kernel")
    share = int(budget) / max(int(whole), 1)
    return Finding(
        name,
        share >= 0.9,
        f"a real-time thread is stopped after {share:.0%} of a second of work; the loop "
        "sleeps in each period, so it stays below that",
        "" if share >= 0.9 else "sudo sysctl kernel.sched_rt_runtime_us=950000",
    )


def _preemption(system: System) -> Finding:
    name = "preemption"
    if sys.platform != "linux":
        return Finding(name, None, f"real time is only supported on Linux, this is {sys.platform}")
    version = system.text(system.proc / "version") or ""
    if system.text(system.sys / "kernel/realtime") == "1" or "PREEMPT_RT" in version:
        return Finding(name, True, "the kernel is a real-time one (PREEMPT_RT)")
    if "PREEMPT_DYNAMIC" in version:
        return _dynamic_preemption(system)
    if "PREEMPT" in version:
        return Finding(name, True, "the kernel is preemptible (PREEMPT)")
    if not version:
        return Finding(name, None, "the kernel's preemption model is not visible here")
    return Finding(
        name,
        False,
        "the kernel finishes its own work before it lets the loop run (no PREEMPT in its version)",
        "install a kernel with PREEMPT_RT (Debian: linux-image-rt-amd64), or one with "
        "PREEMPT_DYNAMIC and 'preempt=full'",
    )


def _dynamic_preemption(system: System) -> Finding:
    chosen = _dynamic_model(system)
    if chosen == "full":
        return Finding("preemption", True, "the kernel is preemptible (PREEMPT_DYNAMIC: full)")
    shown = chosen or "its model is not visible here"
    return Finding(
        "preemption",
        None,
        f"the kernel can be preemptible (PREEMPT_DYNAMIC: {shown})",
        "add 'preempt=full' to the kernel's command line; a PREEMPT_RT kernel is better still",
    )


def _dynamic_model(system: System) -> str:
    """Returns the model in use, in brackets in ``none voluntary (full)``; empty if unknown."""
    text = system.text(system.sys / "kernel/debug/sched/preempt") or ""
    if "(" in text:
        return text.partition("(")[2].partition(")")[0]
    line = system.text(system.proc / "cmdline") or ""
    settings = [word.partition("=")[2] for word in line.split() if word.startswith("preempt=")]
    return settings[-1] if settings else ""


def _governor(system: System) -> Finding:
    """Checks the frequency governor; after a pause a slow core makes ticks long."""
    name = "frequency"
    files = sorted(system.sys.glob("devices/system/cpu/cpu[0-9]*/cpufreq/scaling_governor"))
    governors = {text for text in map(system.text, files) if text}
    if not governors:
        return Finding(
            name, None, "the processor's frequency is not governed here (a virtual machine?)"
        )
    if governors == {"performance"}:
        return Finding(name, True, "all cores run at full frequency (governor performance)")
    return Finding(
        name,
        False,
        f"idle cores lower their frequency (governor {', '.join(sorted(governors))}): ticks after "
        "a pause are longer",
        "sudo cpupower frequency-set -g performance",
    )


def _cores() -> Finding:
    name = "cores"
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    busy = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
    if not count or count < 2:
        shared = "loop, recorder and a scene beside the loop (--scene-rate) share it"
        return Finding(name, False, f"there is one core: {shared}", "provide at least two")
    sentence = f"{count} cores, {busy:.1f} processes wanted to run in the last minute"
    if busy > count:
        return Finding(name, False, f"{sentence}: more than there are cores", "end other programs")
    if busy > count - 1:
        beside = "none is free for a scene beside the loop (--scene-rate)"
        return Finding(name, None, f"{sentence}: {beside}", "end other programs")
    return Finding(name, True, sentence)


def _host(system: System, stolen: float, duration: float) -> Finding:
    name = "host"
    flags = system.text(system.proc / "cpuinfo")
    if flags is None:
        return Finding(name, None, "it is not visible here if this is a virtual machine")
    if " hypervisor" in flags:
        sentence = (
            "this is a virtual machine: its host may stop it for tens of milliseconds, and nothing "
            "inside it can prevent or foresee"
        )
        if stolen > 0.0:
            sentence += f"; during the measurement it took {stolen * 1e3:.0f} ms from the cores"
        is_bad = stolen > STOLEN_SHARE * duration
        return Finding(name, False if is_bad else None, sentence, "run on a physical machine")
    return Finding(name, True, "no virtual machine")


def _usb() -> Finding:
    name = "usb"
    unseen = blind_spots()
    plugged = plugged_devices()
    problems = [f"{device}: {device.problem}" for device in plugged if device.problem]
    if problems:
        return Finding(name, False, "; ".join(problems), "hapticbridge devices")
    if unseen:
        return Finding(name, False, *unseen[0])
    if not plugged:
        return Finding(name, None, "no haptic device is plugged in")
    return Finding(name, True, f"may be opened: {', '.join(map(str, plugged))}")


def _confinement() -> Finding:
    """Checks the means that confine a scene from someone else's recording."""
    name, found = "recordings from others", means()
    if not found:
        return Finding(name, None, "their scenes are simulated without limits on this system")
    limits = "their scenes run with limits on memory and time"
    missing = [each for each, works in found.items() if not works]
    if not missing:
        return Finding(name, True, f"{limits}, without network, and read only their own files")
    return Finding(
        name,
        None,
        f"{limits}, but this system lacks {choices(missing)}; the names of their files are checked",
        "Linux 5.13 or newer with Landlock, seccomp and user namespaces gives all of them",
    )


# Wake-up times of the bridge's clock and of a bare sleep loop


@dataclass(slots=True)
class Wakeups:
    """Wake-ups of one kind of loop, over several turns.

    Attributes:
        name: Name of the loop.
        late_ns: Lateness of each tick in ns, by turn.
        missed: Number of skipped deadlines.
    """

    name: str
    late_ns: list[NDArray[np.int64]] = field(default_factory=list)
    missed: int = 0

    def add(self, late_ns: NDArray[np.int64], missed: int) -> None:
        """Adds one turn."""
        self.late_ns.append(late_ns)
        self.missed += missed

    def lateness(self) -> Lateness:
        """Returns the statistics of all turns.

        Raises:
            HapticBridgeError: There was no turn.
        """
        return lateness_of(
            np.concatenate([np.zeros(0, dtype=np.int64), *self.late_ns]), self.missed
        )


def clock_turn(period_ns: int, ticks: int) -> tuple[NDArray[np.int64], int]:
    """Waits with the bridge's own clock, which sleeps and then spins.

    The number of ticks includes skipped deadlines.

    Returns:
        Lateness of each tick in ns, and number of skipped deadlines.
    """
    clock = RealClock()
    clock.start(period_ns)
    return _turn(clock.wait, ticks)


def bare_turn(period_ns: int, ticks: int) -> tuple[NDArray[np.int64], int]:
    """Waits with plain sleeps until each deadline; returns the same values as ``clock_turn``."""
    monotonic, sleep = time.monotonic_ns, time.sleep
    deadline = monotonic()

    def wait() -> tuple[int, int, int]:
        nonlocal deadline
        deadline += period_ns
        skipped = max((monotonic() - deadline) // period_ns, 0)
        deadline += skipped * period_ns
        left = deadline - monotonic()
        if left > 0:
            sleep(left * 1e-9)
        return deadline, monotonic(), skipped

    return _turn(wait, ticks)


def _turn(wait: Callable[[], tuple[int, int, int]], ticks: int) -> tuple[NDArray[np.int64], int]:
    late, count, missed = np.zeros(ticks, dtype=np.int64), 0, 0
    while count + missed < ticks:
        deadline, wake, skipped = wait()
        late[count] = wake - deadline
        count += 1
        missed += skipped
    return late[:count], missed


LATE_SHARE = 0.25
"""Allowed lateness of a tick as a share of the period, without unit. The default coupling uses 80 %
of the bound, so the hold may last T/0.8 = 1.25 T before the condition b >= KT/2 + B' fails."""

FEW_MISSED = 1e-4
"""Share of missed deadlines up to which the verdict is fair: one in 10 s at 1 kHz."""

SHORTEST, LONGEST = 1.0, 3600.0
"""Range of the duration in s. Percentiles of a shorter run mean nothing; an hour is the longest
wait."""

TURN = 1.0
"""Length of one turn in s. The loops take turns, so that a disturbance affects all of them."""

BASELINE = "cyclictest"


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """Result of a diagnosis.

    Attributes:
        rate: Rate in Hz.
        lateness: Lateness by loop: ``bridge``, ``bare sleep`` and, if it ran, ``cyclictest``.
        findings: Findings about the system.
        verdict: ``fit``, ``fair`` or ``unfit``.
        sentence: The verdict with reason and advice.
    """

    rate: float
    lateness: dict[str, Lateness]
    findings: tuple[Finding, ...]
    verdict: str
    sentence: str


def diagnose(
    rate: float = 1000.0,
    duration: float = 20.0,
    system: System | None = None,
    progress: Callable[[float, float], None] = lambda _done, _whole: None,
) -> Diagnosis:
    """Measures this machine.

    The duration in s, 1 to 3600, is shared by the loops. ``progress`` is called with the time done
    and the whole time, in s.

    Raises:
        HapticBridgeError: Rate or duration is out of range.
    """
    Arguments(HapticBridgeError).number("duration", duration, "s", least=SHORTEST, most=LONGEST)
    period_ns = round(period_of(rate) * 1e9)
    bridge, bare, baseline = Wakeups("bridge"), Wakeups("bare sleep"), Wakeups(BASELINE)
    machine = system or System()
    before = stolen_time(machine.proc)
    with memory_at_rest() as at_rest:
        with real_time():
            priority = current_priority()
        is_locked = all(grant.is_granted for grant in at_rest)
        refused = refusal(priority, locks_memory=is_locked)
        loops = [bridge, bare] + ([] if refused else [baseline])
        rounds = max(1, round(duration / (TURN * len(loops))))
        ticks = max(1, round(duration / (rounds * len(loops)) * 1e9 / period_ns))
        for turn in range(rounds):
            bare.add(*bare_turn(period_ns, ticks))
            with real_time() as granted:
                bridge.add(*clock_turn(period_ns, ticks))
            if not refused:
                late = run(period_ns, ticks, priority, locks_memory=is_locked)
                if isinstance(late, str):
                    refused = late  # no further attempt
                else:
                    baseline.add(late, lateness_above_baseline(period_ns, late).missed)
            progress(duration * (turn + 1) / rounds, duration)
    lateness = {loop.name: loop.lateness() for loop in loops if loop.late_ns}
    stolen = (stolen_time(machine.proc) or 0.0) - (before or 0.0)
    found = findings(machine, at_rest + granted, stolen, duration)
    found += (_baseline_finding("" if BASELINE in lateness else refused),)
    verdict, sentence = judged(lateness, found, rate)
    return Diagnosis(rate, lateness, found, verdict, sentence)


def _baseline_finding(refused: str) -> Finding:
    if not refused:
        return Finding("baseline", None, "cyclictest, a C program, ran in turns with the loop")
    return Finding(
        "baseline",
        None,
        f"no comparison with cyclictest, a C program: {refused}",
        "" if is_there() else INSTALL,
    )


def judged(
    lateness: dict[str, Lateness], findings: tuple[Finding, ...], rate: float
) -> tuple[str, str]:
    """Returns the verdict and its sentence.

    ``lateness_above_baseline`` holds at least ``bridge`` and ``bare sleep``.
    """
    bridge, period = lateness["bridge"], 1.0 / rate
    allowed = LATE_SHARE * period
    missed = bridge.missed / (bridge.ticks + bridge.missed)
    # earlier findings matter more; one remedy often serves two findings
    remedies = dict.fromkeys(f.remedy for f in findings if f.is_good is False and f.remedy)
    advice = "; ".join(list(remedies)[:2])
    held = f"{rate:g} Hz"
    numbers = f"99.9 % of ticks within {bridge.p999 * 1e6:.0f} µs, {bridge.missed} missed"
    if bridge.p999 <= allowed and bridge.missed == 0:
        rest = f"; better still: {advice}" if advice else "; no change is needed"
        return "fit", f"fit for {held}: {numbers}{rest}"
    if bridge.p99 <= allowed and missed <= FEW_MISSED:
        verdict, words = "fair", f"fair for {held}"
    else:
        verdict, words = "unfit", f"unfit for {held}"
    return verdict, f"{words}: {numbers}; {_cause(lateness, allowed, advice)}{_stall_words(bridge)}"


def _stall_words(bridge: Lateness) -> str:
    """Describes the effect of a long stall on the hand; empty if all were short."""
    if bridge.worst <= MIN_WATCHDOG:
        return ""
    return (
        f"; it stalled for {1e3 * bridge.worst:.0f} ms: meanwhile a device keeps applying its "
        "last force, unless it has a watchdog (see 'hapticbridge devices')"
    )


def _cause(lateness: dict[str, Lateness], allowed: float, advice: str) -> str:
    baseline = lateness.get(BASELINE)
    if baseline is not None and baseline.worst > allowed:
        stalls = (
            f"the machine itself stalls (a C program also woke up to {baseline.worst * 1e6:.0f} µs "
            "late)"
        )
        return f"{stalls}: {advice or 'use another machine, or a lower rate'}"
    if advice:
        return advice
    if lateness["bare sleep"].worst > allowed:
        return "a bare sleep loop was late too: use another machine, or a lower rate"
    return "the other loops were on time: report this as a fault of hapticbridge"
