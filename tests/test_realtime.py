"""Requests to the system: given back, never refused in silence. Nothing grows in a tick."""

from __future__ import annotations

import ctypes
import errno
import gc
import os
import resource
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from audit_cases import ScriptedDevice
from bridge_runs import fast, sway

from hapticbridge.clock import RealClock, SimulatedClock
from hapticbridge.demand.methods import prepare
from hapticbridge.errors import HapticBridgeError, SceneError
from hapticbridge.lab.methods import METHODS
from hapticbridge.realtime import (
    Grant,
    check_pace,
    lateness_of,
    memory_at_rest,
    real_time,
    wants_real_time,
    warn_of_refusals,
)
from hapticbridge.realtime import realtime as asked
from hapticbridge.realtime import realtime as pace
from hapticbridge.realtime.realtime import BESIDE_THE_STEP, CONTAINER, PRIORITY, SHELL, rate_for
from hapticbridge.recording import read_recording
from hapticbridge.run.bridge import Bridge
from hapticbridge.scene import load_scene
from hapticbridge.view.window import Address, Window

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="real time is Linux's")


GET_TIMER_SLACK = 30  # Linux's PR_GET_TIMERSLACK


class Library:
    """Stands in for the C library: locks no memory, but notes what was asked."""

    def __init__(self, *refused: int) -> None:
        self.refused = refused
        self.asked: list[int] = []
        self.slack = 50_000

    def mlockall(self, flags: int) -> int:
        self.asked.append(flags)
        ctypes.set_errno(12)
        return -1 if flags in self.refused else 0

    def munlockall(self) -> int:
        self.asked.append(0)
        return 0

    def prctl(self, option: int, value: int, *_rest: int) -> int:
        if option == GET_TIMER_SLACK:
            return self.slack
        self.slack = value
        return 0


@pytest.fixture
def library(monkeypatch: pytest.MonkeyPatch) -> Library:
    fake = Library()
    real = ctypes.CDLL
    monkeypatch.setattr(
        ctypes,
        "CDLL",
        lambda name, *more, **options: real(name, *more, **options) if name else fake,
    )
    return fake


@pytest.fixture
def refusing(monkeypatch: pytest.MonkeyPatch, library: Library) -> Library:
    """A system that grants nothing that it can refuse, to an ordinary user."""

    def refuse(*_arguments: Any) -> None:
        raise PermissionError(1, "Operation not permitted")

    library.refused = 1, 3
    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    return library


def named(grants: tuple[Grant, ...], name: str) -> Grant:
    return next(grant for grant in grants if grant.name == name)


def facts() -> tuple[Any, ...]:
    """Everything that is changed while the loop runs."""
    library = ctypes.CDLL(None)
    slack = library.prctl(GET_TIMER_SLACK, 0, 0, 0, 0)
    policy, priority = os.sched_getscheduler(0), os.sched_getparam(0).sched_priority
    return policy, priority, os.sched_getaffinity(0), slack, gc.isenabled(), gc.get_freeze_count()


def test_everything_is_given_back_also_after_an_error(library: Library) -> None:
    before = facts()
    with pytest.raises(KeyError), memory_at_rest() as grants:
        assert all(grant.is_granted for grant in grants)
        assert not gc.isenabled()
        assert gc.get_freeze_count() > 0
        assert library.asked[-1] != 0
        raise KeyError
    assert library.asked[-1] == 0
    assert facts() == before
    with pytest.raises(KeyError), real_time():
        assert facts() != before
        raise KeyError
    assert facts() == before


def test_a_collector_that_the_user_stopped_or_froze_stays_so(library: Library) -> None:
    gc.disable()
    gc.freeze()
    try:
        with memory_at_rest():
            pass
        assert not gc.isenabled()
        assert gc.get_freeze_count() > 0
    finally:
        gc.enable()
        gc.unfreeze()


def test_granted_is_what_the_system_says_too() -> None:
    with real_time() as grants:
        policy = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK
        assert named(grants, "scheduling").is_granted == (policy == os.SCHED_FIFO)
        assert named(grants, "core").is_granted
        assert len(os.sched_getaffinity(0)) == 1
        assert named(grants, "timer").is_granted
        # a real-time thread has no slack at all, and newer kernels say so
        assert ctypes.CDLL(None).prctl(GET_TIMER_SLACK, 0, 0, 0, 0) in (0, asked.TIMER_SLACK_NS)


def test_processes_started_meanwhile_are_ordinary_ones() -> None:
    with real_time():
        ask = [sys.executable, "-S", "-c", "import os; print(os.sched_getscheduler(0))"]
        policy = subprocess.run(ask, capture_output=True, text=True, check=True).stdout
    assert int(policy) == os.SCHED_OTHER


@pytest.mark.parametrize(("user", "remedy"), [(1000, SHELL), (0, CONTAINER)])
def test_refusal_is_said_with_its_remedy(
    refusing: Library, monkeypatch: pytest.MonkeyPatch, user: int, remedy: str
) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: user)
    with memory_at_rest() as memory, real_time() as grants:
        for grant in (named(memory, "memory"), named(grants, "scheduling")):
            assert not grant.is_granted
            assert grant.remedy == remedy
            assert "ulimit" in grant.sentence
    assert "--rtprio=80" in SHELL
    assert "--memlock" in SHELL


@pytest.mark.parametrize("limit", [10, PRIORITY, 99])
def test_a_lower_limit_on_priority_is_used(monkeypatch: pytest.MonkeyPatch, limit: int) -> None:
    got: list[int] = []

    def schedule(_process: int, policy: int, parameter: Any) -> None:
        if policy & os.SCHED_FIFO and parameter.sched_priority > limit:
            raise PermissionError(1, "Operation not permitted")
        got.append(parameter.sched_priority)

    monkeypatch.setattr(os, "sched_setscheduler", schedule)
    monkeypatch.setattr(resource, "getrlimit", lambda _which: (limit, limit))
    with real_time() as grants:
        assert named(grants, "scheduling").is_granted
        assert got == [min(limit, PRIORITY)]
        said = named(grants, "scheduling").sentence
        assert ("the limit 'ulimit -r' allows no more" in said) == (limit < PRIORITY)


@pytest.mark.parametrize(
    ("limit", "flags"), [(resource.RLIM_INFINITY, 3), (1 << 50, 1), (1 << 23, 3)]
)
def test_memory_to_come_is_locked_if_unlimited(
    library: Library, monkeypatch: pytest.MonkeyPatch, limit: int, flags: int
) -> None:
    """This process has more than 8 MB already: if it may lock that, the limit does not bind it."""
    monkeypatch.setattr(resource, "getrlimit", lambda _which: (limit, limit))
    with memory_at_rest() as grants:
        pass
    assert library.asked == [flags, 0]
    assert ("later allocations are not" in named(grants, "memory").sentence) == (flags == 1)


def test_an_isolated_core_is_taken_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    chosen: list[Any] = []
    monkeypatch.setattr(asked, "ISOLATED", tmp_path / "isolated")
    monkeypatch.setattr(os, "sched_getaffinity", lambda _process: {0, 1, 2})
    monkeypatch.setattr(os, "sched_setaffinity", lambda _process, cores: chosen.append(cores))
    with real_time():
        assert chosen == [{2}]
    (tmp_path / "isolated").write_text("4,6-7\n")
    chosen.clear()
    with real_time() as grants:
        assert chosen == [{4}]
    assert "isolated core 4" in named(grants, "core").sentence


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (errno.EINVAL, ("--cpuset-cpus=", "AllowedCPUs=")),
        (errno.EPERM, ("--cap-add=SYS_NICE", "sched_setaffinity")),
        (None, ()),
    ],
)
def test_a_refused_core_is_told_with_remedy(
    monkeypatch: pytest.MonkeyPatch, code: int | None, words: tuple[str, ...]
) -> None:
    def refuse(_process: int, _cores: set[int]) -> None:
        if code is not None:
            raise OSError(code, os.strerror(code))

    monkeypatch.setattr(os, "sched_setaffinity", refuse)
    with real_time() as grants:
        core = named(grants, "core")
    assert core.is_granted == (code is None)
    assert bool(core.remedy) == (code is not None)
    for word in words:
        assert word in core.remedy
    if code is not None:
        assert os.strerror(code) in core.sentence
        with pytest.warns(UserWarning, match=rf"core \d+ .*to grant it: .*{words[0]}"):
            warn_of_refusals((core,))


@pytest.mark.parametrize(
    ("asked_for", "clock", "is_real", "is_wanted"),
    [
        (None, RealClock, True, True),
        (None, RealClock, False, False),
        (None, SimulatedClock, False, False),
        (False, RealClock, True, False),
        (True, RealClock, False, True),
    ],
)
def test_who_wants_real_time(asked_for: Any, clock: Any, is_real: bool, is_wanted: bool) -> None:
    assert wants_real_time(asked_for, clock(), is_real=is_real) == is_wanted
    with pytest.raises(HapticBridgeError, match="simulated clock"):
        wants_real_time(True, SimulatedClock(), is_real=False)


def test_a_run_without_permission_says_so_and_records_it(refusing: Library, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Bridge("point_mass", ScriptedDevice(sway), realtime=True, recording=path) as bridge:
        with pytest.warns(UserWarning, match="real time") as warned:
            bridge.run(0.02)
        bridge.run(0.02)
    assert sum("SCHED_FIFO was refused" in str(item.message) for item in warned) == 1
    assert sum("memory could not be locked" in str(item.message) for item in warned) == 1
    noted = read_recording(path).events
    assert [event["time_ns"] for event in noted[:2]] == [0, 0]  # before time began
    events = [event for event in noted if event["event"] == "real_time"]
    assert len(events) == 2
    assert "refused" in str(events[0]["scheduling"])
    assert "frozen" in str(events[0]["collector"])


class Heap(ctypes.Structure):
    """Answer of ``mallinfo2`` of the C library, in bytes where it is not a count."""

    _fields_ = (
        *((name, ctypes.c_size_t) for name in ("arena", "ordblks", "smblks", "hblks", "hblkhd")),
        *((name, ctypes.c_size_t) for name in ("usmblks", "fsmblks", "uordblks")),
        *((name, ctypes.c_size_t) for name in ("fordblks", "keepcost")),
    )


def heap_reader() -> Callable[[], int]:
    """Returns what tells how many bytes MuJoCo and the kernel hold: Python counts only its own."""
    tell = getattr(ctypes.CDLL(None), "mallinfo2", None)
    if tell is None:
        return lambda: 0
    tell.restype = Heap

    def held() -> int:
        heap = tell()
        return int(heap.hblkhd + heap.uordblks)

    return held


@pytest.mark.parametrize(("pipelined", "controller"), [(False, "off"), (True, "damper")])
@pytest.mark.parametrize("watched", ["by nobody", "by the recorder", "by recorder and viewer"])
def test_ticks_allocate_none(
    tmp_path: Path, pipelined: bool, controller: str, watched: str
) -> None:
    """Python's own numbers come and go; a tick that keeps one more object would show 10 000."""
    watchers: dict[str, Any] = {}
    if "recorder" in watched:
        watchers["recording"] = tmp_path / "run.mcap"
    if "viewer" in watched:
        pytest.importorskip("viser", reason="needs the extra 'view'")
        watchers["observer"] = Window(Address(0))
    blocks, held = np.zeros(2, dtype=np.int64), np.zeros(2, dtype=np.int64)
    read_heap = heap_reader()

    def count(tick: int) -> None:
        if tick in (2000, 12_000):
            held[tick // 12_000] = read_heap()
            blocks[tick // 12_000] = sys.getallocatedblocks()

    with fast(
        "peg_in_hole", "simulated", pipelined=pipelined, controller=controller, **watchers
    ) as bridge:
        read_heap()
        gc.collect()
        gc.disable()
        try:
            bridge.run(12.001, count)
        finally:
            gc.enable()
    assert blocks[0] > 0
    assert abs(blocks[1] - blocks[0]) < 100  # threads beside the loop hold some
    assert abs(held[1] - held[0]) < 10_000


def test_percentiles_are_latenesses_that_were_seen() -> None:
    late = lateness_of(np.arange(1, 1001) * 1000, 7)
    assert (late.ticks, late.missed) == (1000, 7)
    assert late.median == pytest.approx(500e-6)
    assert late.p99 == pytest.approx(990e-6)
    assert late.p999 == pytest.approx(999e-6)
    assert late.worst == pytest.approx(1e-3)
    assert lateness_of([-50], 0).worst == 0.0
    with pytest.raises(HapticBridgeError, match="no tick"):
        lateness_of([], 0)


def test_a_scene_too_slow_is_refused_for_a_real_device_and_warned_of_for_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """No step fits into a microsecond, every one of a point mass into a second."""
    scene, method = load_scene("point_mass"), METHODS["implicit"]
    with fast(scene, method="implicit") as bridge:
        coupling = bridge.setup.coupling
    prepare(scene, coupling, 1e-3, 1, method)
    state = ("qpos", "time", "qacc_warmstart")
    start = [np.copy(getattr(scene.data, name)) for name in state]
    with pytest.raises(SceneError, match=r"could hold about \S+ Hz"):
        check_pace(scene, method, 1e-9, 1, is_real=True)
    with pytest.warns(UserWarning, match=r"could hold about \S+ Hz"):
        check_pace(scene, method, 1e-9, 1, is_real=False)
    check_pace(scene, method, 1.0, 1, is_real=True)
    for name, before in zip(state, start, strict=True):
        np.testing.assert_array_equal(before, getattr(scene.data, name))
    # before the device is held
    device = ScriptedDevice(sway)
    device.info = replace(device.info, is_real=True)
    started: list[float] = []
    monkeypatch.setattr(device, "start", started.append)
    with pytest.raises(SceneError, match="could hold"):
        Bridge("point_mass", device, rate=1e6, scene_rate=1e6, realtime=False).__enter__()
    assert not started


@pytest.mark.parametrize(("needed", "held"), [(6e-3, "130 Hz"), (1.04e-3, "770 Hz")])
def test_offered_rate_leaves_a_fifth_of_the_period_and_is_a_plain_number(
    monkeypatch: pytest.MonkeyPatch, needed: float, held: str
) -> None:
    assert (needed + BESIDE_THE_STEP) * rate_for(needed) == pytest.approx(0.8)
    monkeypatch.setattr(pace, "step_time", lambda *_: needed)
    with pytest.raises(SceneError, match=f"needs .* ms .* could hold about {held}: "):
        check_pace(load_scene("point_mass"), METHODS["implicit"], 1e-3, 1, is_real=True)
