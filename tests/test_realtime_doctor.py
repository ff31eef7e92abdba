"""The doctor: what it finds on machines of every kind, what it measures, and what it concludes."""

from __future__ import annotations

import json
import os
import subprocess
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hapticbridge.cli import main
from hapticbridge.device.discovery import BlindSpot
from hapticbridge.device.driver import FoundDevice
from hapticbridge.errors import HapticBridgeError
from hapticbridge.realtime import Grant, Lateness, real_time, stolen_time
from hapticbridge.realtime import doctor as cyclictest
from hapticbridge.realtime import doctor as diagnosis
from hapticbridge.realtime import doctor as machine
from hapticbridge.realtime.doctor import Finding, System, bare_turn, diagnose, findings, judged
from hapticbridge.realtime.realtime import CONTAINER, SHELL

GRANTED = (Grant("scheduling", True, "SCHED_FIFO at priority 80"),)

DEBIAN = "Linux version 6.12.0 (gcc) #1 SMP {} Debian 6.12.0-1"


def system_with(folder: Path, files: dict[str, str]) -> System:
    for name, text in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text + "\n")
    return System(sys=folder / "sys", proc=folder / "proc")


def found(
    folder: Path, files: dict[str, str], grants: tuple[Grant, ...] = GRANTED
) -> dict[str, Finding]:
    return {item.name: item for item in findings(system_with(folder, files), grants)}


GOVERNOR = "sys/devices/system/cpu/cpu{}/cpufreq/scaling_governor"
DYNAMIC = {"proc/version": DEBIAN.format("PREEMPT_DYNAMIC")}
DEBUG, CMDLINE = "sys/kernel/debug/sched/preempt", "proc/cmdline"


def shares(budget: str) -> dict[str, str]:
    place = "proc/sys/kernel/sched_rt_{}_us"
    return {place.format("runtime"): budget, place.format("period"): "1000000"}


@pytest.mark.parametrize(
    ("name", "files", "is_good", "word"),
    [
        # a container that shows nothing of its machine is no error
        *((name, {}, None, "") for name in ("throttling", "preemption", "frequency", "host")),
        ("frequency", {GOVERNOR.format(k): "performance" for k in (0, 1)}, True, ""),
        ("frequency", {GOVERNOR.format(0): "performance", GOVERNOR.format(1): "powersave"}, False,
         "cpupower"),
        ("preemption", {"sys/kernel/realtime": "1"}, True, "PREEMPT_RT"),
        ("preemption", {"proc/version": DEBIAN.format("PREEMPT_RT")}, True, "PREEMPT_RT"),
        ("preemption", {"proc/version": DEBIAN.format("PREEMPT")}, True, "PREEMPT"),
        ("preemption", {"proc/version": DEBIAN.format("")}, False, "no PREEMPT"),
        ("preemption", DYNAMIC, None, "is not visible"),
        ("preemption", {**DYNAMIC, DEBUG: "none (voluntary) full"}, None, "voluntary"),
        ("preemption", {**DYNAMIC, CMDLINE: "root=/dev/sda1 preempt=full quiet"}, True, "full"),
        ("throttling", shares("-1"), True, ""),
        ("throttling", shares("950000"), True, ""),
        ("throttling", shares("100000"), False, ""),
        ("host", {"proc/cpuinfo": "flags\t\t: fpu vme"}, True, ""),
        ("host", {"proc/cpuinfo": "flags\t\t: fpu hypervisor"}, None, "this is a virtual machine"),
    ],
)  # fmt: skip
def test_what_a_machine_is_like_is_read(
    tmp_path: Path, name: str, files: dict[str, str], is_good: bool | None, word: str
) -> None:
    seen = found(tmp_path, files)[name]
    assert seen.is_good is is_good
    assert seen.sentence
    assert word in seen.sentence + seen.remedy
    assert name != "preemption" or not files or bool(seen.remedy) != bool(is_good)


@pytest.mark.parametrize(("stolen", "is_good"), [(0.0, None), (0.019, None), (0.021, False)])
def test_host_of_stolen_time_is_blamed(tmp_path: Path, stolen: float, is_good: bool | None) -> None:
    system = system_with(tmp_path, {"proc/cpuinfo": "flags\t\t: fpu hypervisor"})
    seen = {item.name: item for item in findings(system, GRANTED, stolen, 20.0)}["host"]
    assert seen.is_good is is_good
    assert ("it took" in seen.sentence) == (stolen > 0)
    assert "run on a physical machine" in seen.remedy


def test_what_the_host_took_is_read_from_the_kernel(tmp_path: Path) -> None:
    place = tmp_path / "stat"
    assert stolen_time(tmp_path) is None
    place.write_text("cpu  1 2 3 4 5 6 7 250 9 10\ncpu0 1 2 3 4 5 6 7 99 9 10\n")
    assert stolen_time(tmp_path) == pytest.approx(250 / os.sysconf("SC_CLK_TCK"))
    place.write_text("cpu  1 2 3\n")
    assert stolen_time(tmp_path) is None


def test_what_one_shell_may_is_also_said_for_good(tmp_path: Path) -> None:
    def refused(remedy: str) -> tuple[Grant, ...]:
        return (Grant("scheduling", False, "SCHED_FIFO was refused", remedy),)

    seen = found(tmp_path, {}, refused(SHELL))
    assert seen["scheduling"].remedy == SHELL
    for words in ("limits.d", "rtprio", "memlock", "setcap", "log in again"):
        assert words in seen["for good"].remedy
    assert "for good" not in found(tmp_path, {}, refused(CONTAINER))
    assert "for good" not in found(tmp_path, {})


def test_forbidden_devices_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    device = FoundDevice(
        driver="falcon", name="Falcon", serial="", path="/dev/bus/usb/001/004", vendor=0x0403,
        product=0xCB48, transport="usb", problem=None,
    )  # fmt: skip
    locked = replace(device, problem="no permission to open /dev/bus/usb/001/004")
    blind = [BlindSpot("hidapi cannot be loaded", "pip install")]
    for plugged, spots, is_good, word in (
        ([], [], None, ""),
        ([device], [], True, ""),
        ([device, locked], [], False, "no permission"),
        ([], blind, None, "pip install"),
    ):
        monkeypatch.setattr(machine, "plugged_devices", lambda plugged=plugged: plugged)
        monkeypatch.setattr(machine, "blind_spots", lambda spots=spots: spots)
        seen = found(tmp_path, {})["usb"]
        assert seen.is_good is is_good or spots
        assert word in seen.sentence + seen.remedy


def test_a_bare_loop_counts_what_it_slept_too_long(monkeypatch: pytest.MonkeyPatch) -> None:
    """Time stands still but for sleeps: 5 µs too long each, and once three periods."""
    now, sleeps = 10**9, 0

    def sleep(seconds: float) -> None:
        nonlocal now, sleeps
        sleeps += 1
        now += round(seconds * 1e9) + (3_000_000 if sleeps == 4 else 5_000)

    monkeypatch.setattr(time, "monotonic_ns", lambda: now)
    monkeypatch.setattr(time, "sleep", sleep)
    late, missed = bare_turn(1_000_000, 10)
    assert missed == 2
    assert late.size + missed == 10
    assert late[3] == 3_000_000
    assert late[4] == 0  # the deadline that was due just then
    assert np.all(np.delete(late, [3, 4]) == 5_000)


CYCLICTEST = """# /dev/cpu_dma_latency set to 0us
# Histogram
000000 000000
000017 000003
000250 000001
# Total: 000000004
# Min Latencies: 00017
# Avg Latencies: 00075
# Max Latencies: 61000
# Histogram Overflows: 00002
# Histogram Overflow at cycle number:
# Thread 0: 00001 00007
"""


def test_the_histogram_of_cyclictest_is_read_with_its_overflows() -> None:
    late = cyclictest.parsed(CYCLICTEST)
    assert late is not None
    assert sorted(late.tolist()) == [17_000] * 3 + [250_000] + [61_000_000] * 2
    assert cyclictest.parsed("FATAL: could not set scheduling") is None


def lateness(p99: float, p999: float, worst: float, missed: int = 0) -> Lateness:
    return Lateness(100_000 - missed, missed, 1e-7, p99, p999, worst)


@pytest.mark.parametrize(
    ("mine", "verdict"),
    [
        (lateness(1e-5, 2.4e-4, 9e-4), "fit"),
        (lateness(1e-5, 2.6e-4, 9e-4), "fair"),
        (lateness(1e-5, 1e-5, 9e-3, missed=10), "fair"),
        (lateness(1e-5, 1e-5, 9e-3, missed=11), "unfit"),
        (lateness(2.6e-4, 2.6e-4, 9e-4), "unfit"),
    ],
)
def test_the_verdict_allows_what_the_default_coupling_allows(mine: Lateness, verdict: str) -> None:
    """At 1 kHz a quarter of the period: 80 % of the bound bear T/0.8; one missed in 10 000."""
    loops = {"bridge": mine, "bare sleep": lateness(1e-4, 1e-4, 1e-4)}
    said, sentence = judged(loops, (), 1000.0)
    assert said == verdict
    assert sentence.startswith(f"{verdict} for 1000 Hz")


def test_the_verdict_says_whose_delays_they_are_and_what_to_do() -> None:
    late, good = lateness(5e-4, 5e-4, 5e-3), lateness(1e-5, 1e-5, 1e-5)
    mend = Finding("scheduling", False, "refused", "sudo prlimit")
    again = Finding("memory", False, "refused", "sudo prlimit")
    alone = {"bridge": late, "bare sleep": good}
    assert "fault of hapticbridge" in judged(alone, (), 1000.0)[1]
    assert judged(alone, (mend, again), 1000.0)[1].count("sudo prlimit") == 1
    assert "bare sleep loop" in judged(alone | {"bare sleep": late}, (), 1000.0)[1]
    assert "machine itself stalls" in judged(alone | {"cyclictest": late}, (mend,), 1000.0)[1]
    assert "no change is needed" in judged(alone | {"bridge": good}, (), 1000.0)[1]


@pytest.mark.parametrize(("worst", "is_told"), [(0.019, False), (0.021, True)])
def test_a_stall_beyond_a_watchdog_is_told(worst: float, is_told: bool) -> None:
    stalled = {name: lateness(1e-5, 1e-5, worst, missed=200) for name in ("bridge", "bare sleep")}
    sentence = judged(stalled, (), 1000.0)[1]
    assert (
        "stalled for 21 ms: meanwhile a device keeps applying its last force" in sentence
    ) == is_told
    assert ("'hapticbridge devices'" in sentence) == is_told


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int, int]]:
    """Turns that take no time: the bridge's loop is 10 µs late, the bare one 60 µs."""
    turns: list[tuple[str, int, int]] = []

    def turn(name: str, late: int) -> Any:
        def wait(period_ns: int, ticks: int) -> tuple[Any, int]:
            turns.append((name, period_ns, ticks))
            return np.full(ticks, late, dtype=np.int64), 0

        return wait

    monkeypatch.setattr(diagnosis, "clock_turn", turn("bridge", 10_000))
    monkeypatch.setattr(diagnosis, "bare_turn", turn("bare", 60_000))
    monkeypatch.setattr(cyclictest, "is_there", lambda: False)
    monkeypatch.setattr(diagnosis, "memory_at_rest", real_time)
    return turns


def test_the_loops_take_turns_and_share_the_time(quick: list[tuple[str, int, int]]) -> None:
    done: list[float] = []
    result = diagnose(2000.0, 6.0, progress=lambda at, _whole: done.append(at))
    assert [name for name, _, _ in quick] == ["bare", "bridge"] * 3
    assert {(period, ticks) for _, period, ticks in quick} == {(500_000, 2000)}
    assert done == [2.0, 4.0, 6.0]
    assert result.lateness["bridge"].ticks == 6000
    assert result.lateness["bridge"].p999 == pytest.approx(1e-5)
    assert result.verdict == "fit"


@pytest.mark.parametrize("output", [CYCLICTEST, "it failed: no reason"])
def test_cyclictest_takes_its_turns_where_it_is_and_may(
    quick: list[tuple[str, int, int]], monkeypatch: pytest.MonkeyPatch, output: str
) -> None:
    late = cyclictest.parsed(output)
    asked: list[tuple[Any, ...]] = []

    def turn(*given: Any, **_locks: bool) -> Any:
        asked.append(given)
        return output if late is None else late

    monkeypatch.setattr(cyclictest, "is_there", lambda: True)
    monkeypatch.setattr(cyclictest, "run", turn)
    monkeypatch.setattr(diagnosis, "current_priority", lambda: 40)
    result = diagnose(1000.0, 6.0)
    said = {finding.name: finding.sentence for finding in result.findings}["baseline"]
    if late is None:  # tried once, and the two others share the time
        assert "it failed: no reason" in said
        assert (len(asked), result.lateness["bridge"].ticks) == (1, 3000)
    else:
        assert result.lateness["cyclictest"].missed == 2 * 2 * 61
        assert asked[1:] == [(1_000_000, 1000, 40)] * 2
        assert result.lateness["bridge"].ticks == 2000


@pytest.mark.parametrize(
    ("is_there", "priority", "outcome", "words"),
    [
        (False, 80, CYCLICTEST, "not installed"),
        (True, 0, CYCLICTEST, "needs SCHED_FIFO, which was refused"),
        (True, 80, CYCLICTEST, ""),
        (True, 80, "Unable to change!\nMissing capabilities.\n", "it failed: Missing capabil"),
        (True, 80, subprocess.TimeoutExpired("cyclictest", 5.0), "did not finish"),
        (True, 80, FileNotFoundError(2, "No such file"), "cannot be started (No such file)"),
    ],
)
def test_cyclictests_refusal_is_told(
    monkeypatch: pytest.MonkeyPatch, is_there: bool, priority: int, outcome: Any, words: str
) -> None:
    def call(command: list[str], **_options: Any) -> Any:
        assert "--priority=80" in command and "--mlockall" not in command
        assert is_there and priority > 0
        if isinstance(outcome, Exception):
            raise outcome
        is_done = outcome is CYCLICTEST
        return subprocess.CompletedProcess(command, 1 - is_done, outcome * is_done, outcome)

    monkeypatch.setattr(subprocess, "run", call)
    monkeypatch.setattr(cyclictest, "is_there", lambda: is_there)
    said = cyclictest.refusal(priority, locks_memory=False)
    assert words in said
    assert bool(said) == bool(words)


def test_the_command_speaks_json_and_exits_1_where_the_machine_is_unfit(
    quick: list[tuple[str, int, int]],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    late = np.full(1000, 900_000, dtype=np.int64)
    monkeypatch.setattr(diagnosis, "clock_turn", lambda *_: (late, 0))
    assert main(["doctor", "--duration", "2", "--json"]) == 1
    facts = json.loads(capsys.readouterr().out)
    assert (facts["verdict"], facts["lateness"]["bridge"]["p99"]) == ("unfit", pytest.approx(9e-4))
    assert {finding["name"] for finding in facts["findings"]} >= {"scheduling", "usb", "frequency"}
    for numbers, word in (
        ((1000.0, 0.5), "duration"),
        ((1000.0, float("nan")), "duration"),
        ((0.0, 5.0), "rate"),
        ((2e6, 5.0), "rate"),
    ):
        with pytest.raises(HapticBridgeError, match=word):
            diagnose(*numbers)


def test_what_confines_a_strangers_scene_is_a_finding(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = "recordings from others"
    monkeypatch.setattr(machine, "means", lambda: {"rules on paths": True})
    assert found(tmp_path, {})[name].is_good is True
    monkeypatch.setattr(machine, "means", lambda: {"rules on paths": False, "a filter": True})
    item = found(tmp_path, {})[name]
    assert item.is_good is None and "lacks 'rules on paths'" in item.sentence
    assert "Landlock" in item.remedy
