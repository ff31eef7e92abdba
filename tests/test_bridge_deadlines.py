"""Missed deadlines: how long a run lasts, what its device bears, and the one clock of all pictures.

A device is pushed into a spring and comes out again in equal steps δ. The force that is held from
one sample to the next gives it ½Kδ² a step more than the spring's energy, and its damper burns
bδ²/t in the time t of a step: it is kicked where K/2 > b/t, the bound b > Kt/2 with the true t.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import report_runs
from audit_cases import ScriptedDevice, SlowClock, recorded
from bridge_runs import sway
from rendering_runs import WALL

from hapticbridge.audit import AuditReport, audit
from hapticbridge.demand.guard import Limits
from hapticbridge.kernel.record import TICK_DTYPE, Timeline, due_times
from hapticbridge.recording import Recording, read_recording
from hapticbridge.run.bridge import Bridge
from hapticbridge.run.commands import Couple
from hapticbridge.run.summary import Summary

MISSED = {0: 2, 50: 1, 51: 7, 120: 30}


@pytest.mark.parametrize("seconds", [0.1, 0.4])
def test_a_run_that_misses_deadlines_ends_when_the_clock_says(
    tmp_path: Path, seconds: float
) -> None:
    path = tmp_path / "run.mcap"
    clock = SlowClock(MISSED)
    summary = recorded(path, "point_mass", ScriptedDevice(sway), clock=clock, duration=seconds)
    asked = round(1000 * seconds)
    ticks = read_recording(path).ticks
    assert ticks["deadline_ns"][-1] == 1_000_000 * asked
    assert summary.ticks == len(ticks) == asked - summary.skipped
    assert summary.skipped == sum(missed for at, missed in MISSED.items() if at < len(ticks)) > 0
    assert summary.duration == pytest.approx(seconds)
    report = audit(path)
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")
    assert report.ticks == len(ticks)
    assert report.duration == pytest.approx(seconds)


@pytest.mark.parametrize(("stall", "ticks", "end"), [(49, 51, 0.1), (60, 51, 0.111)])
def test_a_stall_over_the_end_ends_the_run_with_the_tick_that_was_late(
    tmp_path: Path, stall: int, ticks: int, end: float
) -> None:
    path = tmp_path / "run.mcap"
    clock, device = SlowClock({50: stall}), ScriptedDevice(sway)
    summary = recorded(path, "point_mass", device, clock=clock, duration=0.1)
    assert (summary.ticks, summary.skipped) == (ticks, stall)
    assert summary.duration == pytest.approx(end)
    assert len(device.writes) == ticks + 2  # one zero at the end of the run, one on leaving
    assert not device.writes[-1].any()
    assert audit(path).verdict == "passive"


def test_a_second_run_lasts_as_long_as_it_is_asked_to(tmp_path: Path) -> None:
    path, clock = tmp_path / "run.mcap", SlowClock({20: 500, 30: 5})
    device = ScriptedDevice(sway)
    with Bridge("point_mass", device, clock=clock, recording=path) as bridge:
        first = bridge.run(0.1)
        assert first.ticks == 21
        assert first.duration == pytest.approx(0.521)
        assert bridge.run(0.1).duration == pytest.approx(0.621)
    assert audit(path).duration == pytest.approx(0.621)


def test_a_motion_that_ends_the_run_is_followed_to_its_end_however_long_it_takes(
    tmp_path: Path,
) -> None:
    """Its samples are what is asked for, one a tick; a time is not."""
    motion = tmp_path / "hand.csv"
    motion.write_text("t,x,y,z\n0,0,0,0\n0.2,0.01,0,0\n")
    with Bridge("point_mass", f"trajectory:{motion}", clock=SlowClock(MISSED)) as bridge:
        summary = bridge.run()
        assert (summary.ticks, summary.skipped) == (201, 40)
        assert bridge.latest_records(1)["device_position"][0, 0] == pytest.approx(0.01)
    with Bridge("point_mass", f"trajectory:{motion}", clock=SlowClock(MISSED)) as bridge:
        assert bridge.run(0.2).ticks == 160


T = 1e-3
B = 2.0
"""Damping of ``ScriptedDevice`` in N s/m."""
STEPS, STEP = 60, 2e-5
"""Number of steps into the spring and out of it, and their size in m."""

TOUCHING = WALL.replace('pos="0.07 0 0"', 'pos="0.02 0 0"')


def pushed(
    folder: Path, stiffness: float, clock: SlowClock, missed: int = 0
) -> tuple[Summary, AuditReport]:
    """Pushes a massless tool into a wall and out of it, and audits the recording."""
    scene, path = folder / "wall.xml", folder / "run.mcap"
    scene.write_text(TOUCHING)
    device = ScriptedDevice(
        lambda tick: (STEP * (STEPS - abs(tick - STEPS)), 0, 0, 1, 0, 0, 0), strength=100.0
    )
    with Bridge(
        scene,
        device,
        method="direct",
        contact_stiffness=stiffness,
        clock=clock,
        recording=path,
        limits=Limits(force=100.0, torque=5.0, ramp=0.0),
    ) as bridge:
        summary = bridge.run(2 * STEPS * T * (1 + missed))
    return summary, audit(path)


def check(summary: Summary, report: AuditReport, *, is_kicked: bool) -> None:
    assert report.resimulation == "bit for bit"
    assert summary.verdict == report.verdict == ("active" if is_kicked else "passive")
    if is_kicked:
        assert summary.fault == (report.tick, report.port)
        assert report.port == "device"


@pytest.mark.parametrize("missed", [0, 1, 5])
@pytest.mark.parametrize("excess", [0.95, 1.05])
def test_a_device_is_kicked_where_k_exceeds_2b_over_the_time_of_a_hold(
    tmp_path: Path, missed: int, excess: float
) -> None:
    stiffness = excess * 2 * B / ((1 + missed) * T)
    clock = SlowClock(dict.fromkeys(range(2 * STEPS), missed))
    summary, report = pushed(tmp_path, stiffness, clock, missed)
    assert summary.skipped == 2 * STEPS * missed
    check(summary, report, is_kicked=excess > 1)
    if excess > 1:
        # step by step: ½Kδ² from the hold, bδ²/t burnt; the first step takes an unknown time
        per_step = (0.5 * stiffness - B / ((1 + missed) * T)) * STEP**2
        first = 0.5 * stiffness * STEP**2
        assert report.joules <= first + 2 * STEPS * per_step


def test_ticks_late_within_their_period_burn_less_than_even_ones(tmp_path: Path) -> None:
    """Intervals of 1.8 T and 0.2 T: the long ones burn bδ²/(1.8 T), the short ones no more than T.

    On average (1/1.8 + 1)/2 = 0.78 of b/T, so K = 0.9 · 2b/T kicks, which it does not on time.
    """
    late = dict.fromkeys(range(2, 2 * STEPS, 2), 0.8)
    check(*pushed(tmp_path, 0.9 * 2 * B / T, SlowClock({})), is_kicked=False)
    check(*pushed(tmp_path, 0.9 * 2 * B / T, SlowClock({}, late)), is_kicked=True)
    check(*pushed(tmp_path, 0.74 * 2 * B / T, SlowClock({}, late)), is_kicked=False)


STALLS = {20: 30, 60: 1}
"""Deadlines missed before a tick, by the tick's number."""

CHANGED = 40
"""Tick in which a command changes the coupling."""


@pytest.fixture(scope="module")
def late(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """A run of 0.131 s of which two stalls took 31 ms."""
    path = tmp_path_factory.mktemp("late") / "late.mcap"

    def change(bridge: Bridge, tick: int) -> None:
        if tick == CHANGED:
            bridge.command(Couple(1000.0, 0.5))

    device = ScriptedDevice(report_runs.circling)
    recorded(path, "point_mass", device, duration=0.131, clock=SlowClock(STALLS), on_tick=change)
    return read_recording(path)


def rows(due: list[int]) -> np.ndarray[tuple[int], np.dtype[np.void]]:
    made = np.zeros(len(due), TICK_DTYPE)
    made["tick"], made["deadline_ns"] = np.arange(len(due)), due
    return made


@pytest.mark.parametrize(
    "due", [[1_000_000, 2_000_000, 3_000_000], [1, 5, 4], [3, 3, 4], [0, 1, 2], [-(2**63), 1, 2]]
)
def test_a_tick_is_due_at_the_end_of_its_period_also_where_deadlines_cannot_be(
    due: list[int],
) -> None:
    np.testing.assert_allclose(due_times(rows(due), T), (T, 2 * T, 3 * T))
    assert due_times(rows([]), T).shape == (0,)


def test_a_timeline_finds_the_tick_nearest_to_any_time(late: Recording) -> None:
    due = due_times(late.ticks, T)
    for size in (1, 7, 20, 100):
        blocks = [late.ticks[at : at + size] for at in range(0, len(late.ticks), size)]
        line = Timeline(blocks, T)
        assert line.duration == pytest.approx(0.131)
        for time in np.linspace(0.0, 0.131, 500):
            off = np.abs(due - time)
            assert off[line.row_at(float(time))] <= off.min() + 1e-9
    assert Timeline([], T).duration == 0.0
