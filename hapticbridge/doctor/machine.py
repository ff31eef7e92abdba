"""Properties of the machine that decide a loop's lateness."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from pathlib import Path

from hapticbridge.device.discovery import blind_spots, plugged_devices
from hapticbridge.realtime import Grant
from hapticbridge.realtime.remedies import CAPABILITIES, LASTING, SHELL

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
        return Finding(
            name, False, "there is one core: loop and recorder share it", "provide at least two"
        )
    sentence = f"{count} cores, {busy:.1f} processes wanted to run in the last minute"
    if busy > count:
        return Finding(name, False, f"{sentence}: more than there are cores", "end other programs")
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
        sentence, _, remedy = unseen[0].partition(": ")
        return Finding(name, False, sentence, remedy.strip("'"))
    if not plugged:
        return Finding(name, None, "no haptic device is plugged in")
    return Finding(name, True, f"may be opened: {', '.join(map(str, plugged))}")
