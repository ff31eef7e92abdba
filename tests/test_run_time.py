"""One clock for curves, events, pictures and the slider, also where deadlines were missed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import report_runs
from audit_cases import ScriptedDevice, SlowClock, recorded

from hapticbridge.audit import audit
from hapticbridge.bridge import Bridge
from hapticbridge.commands import Couple
from hapticbridge.film_process import Stage
from hapticbridge.record import TICK_DTYPE
from hapticbridge.recording import Recording, Timeline, due_times, read_recording
from hapticbridge.report import telling_time
from hapticbridge.report.evidence import Evidence, draw_recording
from hapticbridge.report.plots import draw_motion

T = 1e-3
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


def test_curves_and_events_stand_on_the_same_clock(late: Recording) -> None:
    evidence = Evidence.of(late)
    assert evidence is not None
    assert len(late.ticks) == 100
    [change] = [event for event in late.events if event["event"] == "coupling"]
    tick, at = change["tick"], 1e-9 * change["time_ns"]
    assert tick >= CHANGED > 20  # counted in ticks it would stand 30 ms earlier
    assert evidence.time[tick - 1] <= at <= evidence.time[tick] + T
    stop = 1e-9 * late.events[-1]["time_ns"]
    assert evidence.time[-1] == pytest.approx(stop) == pytest.approx(0.131)
    for figure in (draw_motion(evidence), draw_recording(late)):
        drawn = figure.axes[0].lines[0].get_xdata()
        assert np.max(drawn) == pytest.approx(0.131)


def test_without_a_missed_deadline_a_tick_is_due_at_the_end_of_its_period() -> None:
    ticks = rows([1_000_000 * (k + 1) for k in range(5)])
    np.testing.assert_allclose(due_times(ticks, T), T * np.arange(1, 6))
    assert due_times(ticks[:0], T).shape == (0,)


@pytest.mark.parametrize("due", [[1, 5, 4], [3, 3, 4], [0, 1, 2], [-(2**63), 1, 2]])
def test_deadlines_that_cannot_be_are_not_drawn(due: list[int]) -> None:
    np.testing.assert_allclose(due_times(rows(due), T), (T, 2 * T, 3 * T))


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


def test_a_picture_stands_where_the_clock_says(late: Recording) -> None:
    stage = Stage(late.path)
    assert stage.duration == pytest.approx(0.131)
    assert [stage.tick_at(time) for time in (0.0, 0.020, 0.051, 0.131)] == [0, 19, 20, 99]
    assert stage.tick_at(0.049) == 20  # in the stall of 31 ms, nearer to its end
    assert stage.tick_at(0.022) == 19
    # the picture of a report is of the tick that it is asked for
    force = np.linalg.norm(late.ticks["wrench_on_tool"][:, :3], axis=1)
    assert stage.tick_at(telling_time(late, audit(late.path))) == int(np.argmax(force))


def test_the_slider_moves_on_the_clock(late: Recording, tmp_path: Path) -> None:
    pytest.importorskip("viser", reason="needs the extra 'view'")
    from hapticbridge.view.replay import Replay

    replay = Replay(late.path)
    assert [sight.time for sight in replay.sights] == pytest.approx([0.001, 0.02, 0.067, 0.1])
    time, _ = replay.trace.curves()
    np.testing.assert_allclose(time, [sight.time for sight in replay.sights])
