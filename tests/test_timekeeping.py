"""Time is part of the verdict: what a run that was late, or sent its force late, is called."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from audit_cases import AnsweringDevice, ScriptedDevice, SlowClock, recorded, stroke
from bridge_runs import fast, still, sway
from cli_cases import Called
from numpy.typing import NDArray

from hapticbridge.audit import AuditReport, audit
from hapticbridge.check.cost import Cost, Growth, TimingStats
from hapticbridge.clock import SimulatedClock
from hapticbridge.coupling import Coupling
from hapticbridge.demand import timekeeping
from hapticbridge.demand.certificate import default_coupling, is_certified
from hapticbridge.demand.certification import Standing, certification_of
from hapticbridge.demand.guard import Limits
from hapticbridge.demand.loop_setting import fresh_share
from hapticbridge.device import DeviceInfo
from hapticbridge.errors import SafetyTrip
from hapticbridge.kernel.hand_energy import INSTANT, HandEnergy
from hapticbridge.kernel.record import TickFlag
from hapticbridge.recording import read_recording
from hapticbridge.run.bridge import Bridge
from hapticbridge.run.summary import Summary

T = 1e-3
B = 2.0
"""Damping of the device of ``ScriptedDevice`` in N s/m, as that of the default simulated one."""

# The damping that a delay needs


def damping_for_delay(stiffness: float, damping: float, share: float) -> float:
    """Returns the least b of the form in ``kernel.timing``, for T = 1 and a delay of this share."""
    most = 0.0
    for theta in np.geomspace(1e-3, np.pi, 200):
        back = np.exp(-1j * theta)
        law = stiffness / (1 - back) + damping
        force, moved, uneven, tool = (
            np.array(row, dtype=complex)
            for row in ([law, 0, -law], [1, 0, 0], [0, 1, 0], [0, 0, 1])
        )
        early = share * moved + uneven
        form = _product(force, tool) - _product(force * back, moved - early)
        form -= _product(force * back * back, early)
        kept, weights = [0, 1, 2], [1.0, 1.0]
        if share in (0, 1):  # the motion cannot be uneven
            kept, weights = [0, 2], [1.0]
        else:
            weights = [1.0, 1 / (share * (1 - share))]
        form = form[np.ix_(kept, kept)]
        rest = form[:-1, :-1] - form[:-1, -1:] @ form[-1:, :-1] / form[-1, -1]
        rest = rest / np.sqrt(np.outer(weights, weights))
        most = max(most, float(np.linalg.eigvalsh(rest)[-1]))
    return most


def _product(a: NDArray[np.complex128], b: NDArray[np.complex128]) -> NDArray[np.complex128]:
    return 0.5 * (np.outer(a.conj(), b) + np.outer(b.conj(), a))


@pytest.mark.parametrize("share", [0, 0.02, 0.1, 0.3, 0.5, 0.8, 1])
@pytest.mark.parametrize("damping", [0.0, 0.1, 0.42, 1.0, 5.0, 50.0])
def test_no_hand_and_no_scene_needs_more_for_a_delay_than_is_charged(
    damping: float, share: float
) -> None:
    needed = 1.0 + damping
    charged = needed + 3.0 / needed * share
    found = damping_for_delay(2.0, damping, share)
    assert found <= charged * (1 + 1e-6)
    if damping == 0.0:
        assert found == pytest.approx(charged, rel=1e-3)
        if share > 0:
            assert found > needed + 2 / needed * share  # the price of a wall alone is too low


# Runs


@dataclass(frozen=True)
class Case:
    """Times of a run.

    Attributes:
        stalls: Deadlines skipped before a tick.
        late: Shares of a period by which ticks begin late.
        sends: Share of a period from sample to force, by tick.
        coupling: Coupling; None for the default.
        seconds: Duration of the run.
    """

    stalls: Mapping[int, int]
    late: Mapping[int, float]
    sends: Callable[[int], float]
    coupling: Coupling | None = None
    seconds: float = 1.0


def at_once(_tick: int) -> float:
    return 0.0


STIFF = Coupling(3900.0, 1.95, 2.4, 1.7e-3)
"""K = 3900 N/m with B' = 0: it needs 1.95 of the device's 2 N s/m."""

IN_TIME = {
    "simulated": Case({}, {}, at_once),
    "one missed deadline": Case({200: 1}, {}, at_once),
    "one force half a period late": Case({}, {}, lambda tick: 0.5 * (tick == 200)),
    "force 5 % of a period after the sample": Case({}, {}, lambda _: 0.05),
    "5 % late in turn": Case({}, dict.fromkeys(range(0, 1000, 2), 0.05), at_once, STIFF),
    "30 % late in turn": Case({}, dict.fromkeys(range(0, 1000, 2), 0.3), at_once),
    "late by as much all the time": Case({}, dict.fromkeys(range(1000), 0.3), at_once, STIFF),
}
NOT_IN_TIME = {
    "82 % of the deadlines missed": Case(
        dict.fromkeys(range(0, 180), 4) | dict.fromkeys(range(0, 180, 5), 7), {}, at_once
    ),
    "force 80 % of a period after the sample": Case({}, {}, lambda _: 0.8),
    "force late in a tenth of the run": Case({}, {}, lambda tick: 0.95 * (365 < tick < 420)),
    "force 5 % of a period late at the bound": Case({}, {}, lambda _: 0.05, STIFF),
    "10 % late in turn at the bound": Case(
        {}, dict.fromkeys(range(0, 1000, 2), 0.1), at_once, STIFF
    ),
}


def felt(path: Path, case: Case) -> tuple[Summary, AuditReport]:
    clock = SlowClock(case.stalls, case.late)
    device = ScriptedDevice(stroke, on_write=lambda sent: clock.spend(case.sends(sent - 1)))
    coupling = case.coupling or default_coupling(device.info, T)
    summary = recorded(path, "virtual_wall", device, coupling, clock=clock, duration=case.seconds)
    return summary, audit(path)


@pytest.mark.parametrize("name", [*IN_TIME, *NOT_IN_TIME])
def test_a_run_is_certified_only_for_the_time_that_it_kept(tmp_path: Path, name: str) -> None:
    case = (IN_TIME | NOT_IN_TIME)[name]
    summary, report = felt(tmp_path / "run.mcap", case)
    kept, again = summary.timekeeping, report.timekeeping
    assert again is not None
    assert report.resimulation == "bit for bit"
    assert summary.is_certified is report.certified is kept.is_kept is (name in IN_TIME)
    assert report.exit_code == (name not in IN_TIME)
    # the second opinion agrees in every number
    assert again.delay_energy == pytest.approx(kept.delay_energy, rel=1e-6, abs=1e-15)
    assert again.mean_delay == pytest.approx(kept.mean_delay)
    assert again.mean_jitter == pytest.approx(kept.mean_jitter)
    assert (again.share, again.rate) == pytest.approx((kept.share, kept.rate))
    # without the time that the run really had, all of them would be certified
    assert summary.fault is None
    assert all(sentence.count(">=") == 1 for sentence in summary.conditions)
    if name in NOT_IN_TIME:
        assert timekeeping.NOT_KEPT in report.reason
        assert "--realtime" in kept.fault


def test_a_missed_deadline_is_said_with_the_share_of_the_time(tmp_path: Path) -> None:
    summary, report = felt(tmp_path / "run.mcap", IN_TIME["one missed deadline"])
    assert summary.timekeeping.clause == " while the run kept its time (99.9 % of it)"
    assert summary.timekeeping.words == "999 Hz, 99.9 % of the deadlines kept"
    assert "--realtime" in summary.timekeeping.hint
    facts = json.loads(report.to_json())["timekeeping"]
    assert facts["share"] == pytest.approx(0.999)
    assert facts["rate"] == pytest.approx(999.0)
    summary, _ = felt(tmp_path / "again.mcap", IN_TIME["simulated"])
    assert summary.timekeeping.clause == summary.timekeeping.hint == ""
    assert summary.timekeeping.remark == ""


def test_a_run_that_lost_nothing_has_all_of_its_samples() -> None:
    info = DeviceInfo(name="rail", axes=("x",), force_limit=10.0)
    for rate in (333, 1000, 1500, 4000):
        assert all(fresh_share(info, 1 / rate, n, n) == 1.0 for n in range(1, 5000))
    assert fresh_share(info, 1e-3, 900, 1000) == 0.9
    own = replace(info, rate=500.0)  # owes every second sample
    assert fresh_share(own, 1e-3, 500, 1000) == 1.0


def test_ticks_that_come_late_in_turn_are_said_and_count(tmp_path: Path) -> None:
    summary, report = felt(tmp_path / "run.mcap", IN_TIME["5 % late in turn"])
    kept = summary.timekeeping
    # half of the intervals are 50 µs too long, the others too short
    assert kept.mean_jitter == pytest.approx(25e-6, rel=1e-2)
    assert kept.conditions[0].needed == pytest.approx(1.95 * 1.025, rel=1e-3)
    words = "1000 Hz, 100 % of the deadlines kept, sample times vary by 25 µs"
    assert kept.words == kept.remark == words
    assert report.timekeeping is not None
    assert report.timekeeping.remark == words
    summary, _ = felt(tmp_path / "late.mcap", NOT_IN_TIME["10 % late in turn at the bound"])
    assert (
        "at 1000 Hz (sample times vary by 50 µs) it would need 2.05 N s/m"
        in summary.timekeeping.fault
    )
    summary, _ = felt(tmp_path / "force.mcap", IN_TIME["force 5 % of a period after the sample"])
    assert summary.timekeeping.remark.endswith("kept, forces follow 50 µs after the sample")
    assert summary.timekeeping.mean_jitter == 0.0


def test_a_run_at_a_fifth_of_its_rate_names_what_it_needed(tmp_path: Path) -> None:
    summary, _ = felt(tmp_path / "run.mcap", NOT_IN_TIME["82 % of the deadlines missed"])
    kept = summary.timekeeping
    assert kept.share == pytest.approx(0.18, abs=0.01)
    assert kept.rate == pytest.approx(1000 * kept.share)
    assert kept.conditions[0].needed == pytest.approx(1.7 / kept.share, rel=1e-3)
    assert is_certified(kept.conditions) is False
    assert kept.fault.startswith(f"the run did not keep its time: at {kept.rate:.4g} Hz")
    assert kept.fault.endswith(kept.conditions[0].remedy)


def test_short_delays_are_judged_by_what_they_gave(tmp_path: Path) -> None:
    summary, _ = felt(tmp_path / "run.mcap", NOT_IN_TIME["force late in a tenth of the run"])
    kept = summary.timekeeping
    assert is_certified(kept.conditions) is True  # on average the condition held
    assert kept.delay_energy > INSTANT
    assert "may have given the hand" in kept.fault
    clock = SlowClock({})
    case = NOT_IN_TIME["force late in a tenth of the run"]
    still = ScriptedDevice(
        lambda _: (0, 0, 0, 1, 0, 0, 0), on_write=lambda sent: clock.spend(case.sends(sent - 1))
    )
    summary = recorded(tmp_path / "still.mcap", "virtual_wall", still, clock=clock, duration=1.0)
    assert summary.is_certified is True  # a hand at rest was given nothing
    assert summary.timekeeping.delay_energy == 0.0


@pytest.mark.parametrize(("skipped", "share"), [(1, 1.0), (3, 1.0), (3, 0.0), (3, -0.2)])
def test_a_force_that_outlasts_its_spring_is_counted(
    tmp_path: Path, skipped: int, share: float
) -> None:
    # with share 0 the hand stands still in that moment, with -0.2 it presses on
    path, stalled = tmp_path / "run.mcap", 800

    def snatching(tick: int, force: float) -> float:
        if tick == stalled:  # late, and yields as fast as gets most out of it
            return share * force / (2.0 * 2.0) * (1 + skipped)
        return 0.05 if abs(force) < 8.0 and 0 < tick < stalled else 0.0

    device, clock = AnsweringDevice(snatching), SlowClock({stalled: skipped})
    summary = recorded(path, "virtual_wall", device, clock=clock, duration=1.0)
    ticks = read_recording(path).ticks
    moved, time = np.diff(ticks["device_position"][:, 0]), 1e-9 * np.diff(ticks["read_ns"])
    work = ticks["wrench_on_device"][:-1, 0] * moved - 2.0 * moved**2 / time
    got = float(np.max(np.cumsum(work)))
    assert (got > INSTANT) is (share == 1.0)
    kept, report = summary.timekeeping, audit(path)
    assert kept.delay_energy >= got if share == 1.0 else kept.delay_energy < INSTANT
    assert summary.is_certified is report.certified is (share < 1.0)
    assert report.exit_code == (share == 1.0)
    assert report.timekeeping is not None
    assert report.timekeeping.delay_energy == pytest.approx(kept.delay_energy, rel=1e-6)


def test_forces_that_follow_later_than_the_theory_takes_are_not_in_time(tmp_path: Path) -> None:
    summary, report = felt(tmp_path / "run.mcap", Case({}, {}, lambda _: 80.0, seconds=0.05))
    assert summary.timekeeping.is_kept is report.certified is False
    assert summary.timekeeping.mean_delay > 50 * T


def test_times_without_a_condition_are_told_and_not_judged(tmp_path: Path) -> None:
    device = ScriptedDevice(stroke, damping=None, rotational_damping=None)
    stalls = dict.fromkeys(range(100), 4)
    with Bridge("point_mass", device, Coupling(500.0, 0.5), clock=SlowClock(stalls)) as bridge:
        summary = bridge.run(0.5)
    assert summary.timekeeping.share == pytest.approx(0.2)
    assert summary.timekeeping.is_kept is None
    assert summary.is_certified is None


def test_a_device_that_never_bears_it_is_not_blamed_on_time(tmp_path: Path) -> None:
    weak = ScriptedDevice(stroke, damping=0.5)
    clock = SlowClock({200: 9})
    coupling = Coupling(2400.0, 0.5, 2.4, 5e-4)
    summary = recorded(
        tmp_path / "run.mcap", "point_mass", weak, coupling, clock=clock, duration=0.5
    )
    assert summary.is_certified is False
    assert summary.timekeeping.is_kept is None
    assert summary.timekeeping.fault == ""


# Command line


@pytest.mark.usefixtures("undrawn")
def test_run_and_audit_say_so_and_fail(
    call: Called, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "run.mcap"
    stalls = dict.fromkeys(range(100), 4)
    arguments = ("run", "point_mass", "--fast", "--duration", 0.5, "--record", path)
    monkeypatch.setattr("hapticbridge.cli.run.SimulatedClock", lambda: SlowClock(stalls))
    code, out, _ = call(*arguments)
    assert code == 1
    assert "device not certified: the run did not keep its time: at 200 Hz" in out
    assert "device certified" not in out
    assert "--realtime" in out
    page = tmp_path / "run.html"
    code, out, _ = call("audit", path, "--report", page)
    assert code == 1
    assert "device not certified: the run did not keep its time" in out
    assert "200 Hz, 20.0 % of the deadlines kept" in out
    assert "device certified" not in out
    text = page.read_text(encoding="utf-8")
    assert "the run did not keep its time" in text
    assert "bears this coupling" not in text
    code, out, _ = call("audit", path, "--json")
    facts = json.loads(out)[0]
    assert (code, facts["certified"], facts["timekeeping"]["is_kept"]) == (1, False, False)
    assert call("audit", tmp_path)[0] == 1

    monkeypatch.setattr("hapticbridge.cli.run.SimulatedClock", lambda: SlowClock({50: 2}))
    code, out, _ = call(*arguments, "--overwrite")
    assert code == 0
    assert "device certified while the run kept its time (99.6 % of it): b >=" in out
    assert "deadlines were missed, and after each the handle follows the hand in part" in out
    assert "--realtime requests the processor" in out
    code, out, _ = call("audit", path, "--report", page)
    assert code == 0
    assert "device certified while the run kept its time (99.6 % of it)" in out
    assert "while the run kept its time (99.6 % of it)" in page.read_text(encoding="utf-8")

    monkeypatch.setattr("hapticbridge.cli.run.SimulatedClock", SimulatedClock)
    code, out, _ = call(*arguments, "--overwrite")
    assert code == 0
    assert "device certified: b >=" in out
    assert "--realtime" not in out


def test_check_finds_a_rate_that_this_machine_cannot_hold(
    call: Called, monkeypatch: pytest.MonkeyPatch
) -> None:
    def slow(seconds: float) -> Cost:
        stats, growth = TimingStats(100, seconds, seconds), Growth((), None, None)
        return Cost(stats, stats, stats, {}, 0.5 / seconds, growth, growth)

    monkeypatch.setattr("hapticbridge.cli.check.measure_cost", lambda *_a, **_k: slow(2e-3))
    code, out, _ = call("check", "virtual_wall")
    assert code == 1
    assert "cannot hold 1000 Hz here" in out
    assert "--rate 250" in out
    assert "--scene-rate 250" in out
    monkeypatch.setattr("hapticbridge.cli.check.measure_cost", lambda *_a, **_k: slow(1e-5))
    code, out, _ = call("check", "virtual_wall")
    assert code == 0
    assert "cannot hold" not in out


def test_samples_that_are_not_new_count_as_missed_deadlines(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    device = ScriptedDevice(sway, is_stale=lambda tick: tick % 10 != 0)
    with fast("point_mass", device, recording=path) as bridge:
        summary = bridge.run(0.5)
    report = audit(path)
    for kept in (summary.timekeeping, report.timekeeping):
        assert kept is not None
        assert kept.share == 1.0
        assert kept.fresh == pytest.approx(0.1, abs=0.01)
        assert kept.is_kept is False
        assert "100 of the 1000 new samples per second that the loop reads" in kept.words
    assert report.exit_code == 1


def pressed(tick: int) -> tuple[float, ...]:
    """Returns the poses of a hand that goes 2 mm into a wall 1 cm away, in 0.8 s."""
    return (1.5e-5 * min(tick, 800), 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("damping", [2.0, None], ids=["not certified", "not judged"])
def test_a_device_slower_than_the_loop_feels_weak_and_gets_the_rate_that_mends_it(
    damping: float | None, tmp_path: Path, call: Called
) -> None:
    def run(path: Path, ticks_per_sample: int, **options: float) -> Summary:
        scale = 4 if options else 1
        device = ScriptedDevice(
            lambda tick: pressed(scale * tick),
            is_stale=lambda tick: tick % ticks_per_sample != 0,
            damping=damping,
        )
        coupling = Coupling(1500.0, 0.5)
        with fast("virtual_wall", device, recording=path, coupling=coupling, **options) as bridge:
            return bridge.run(1.0)

    slow, usual = run(tmp_path / "slow.mcap", 4), run(tmp_path / "usual.mcap", 1)
    mended = run(tmp_path / "mended.mcap", 1, rate=250.0)
    assert slow.peak_force < 0.1 * usual.peak_force
    assert mended.peak_force == pytest.approx(usual.peak_force, rel=0.1)
    words = "new samples at 250 Hz; in the ticks between them the handle slips"
    for name, summary in (("slow", slow), ("usual", usual), ("mended", mended)):
        _, out, _ = call("audit", tmp_path / f"{name}.mcap")
        for text in (str(summary), " ".join(out.split())):
            assert text.count(words) == text.count("try --rate 250 with") == (name == "slow")


PERIODS = 1000
"""Deadlines of the runs below."""


@pytest.mark.parametrize(
    ("ticks", "new", "silence", "rate"),
    [
        (1000, 250, 0.004, 250.0),  # every fourth tick
        (1000, 970, 0.002, 970.0),
        (1000, 995, 0.002, 0.0),
        (500, 250, 0.004, 0.0),  # the loop itself was slow
        (1000, 500, 0.5, 0.0),  # prompt, but for one silence
        (1000, 240, 0.06, 255.0),  # slow, and silent once
    ],
)
def test_who_was_slow_is_told_by_what_came(
    ticks: int, new: int, silence: float, rate: float
) -> None:
    with fast(
        "point_mass", ScriptedDevice(sway, damping=B), coupling=Coupling(3000.0, 0.4)
    ) as bridge:
        bridge.run(0.01)
        parameters, kept = bridge.session.parameters, bridge.summary().timekeeping
    times = timekeeping.RunTimes(
        ticks=ticks,
        fresh=new / PERIODS,
        new_samples=new,
        due=PERIODS,
        mean_delay=0.0,
        mean_jitter=0.0,
        delay_energy=0.0,
        is_realtime=True,
        silence=silence,
    )
    found = timekeeping.Timekeeping.from_times(times, parameters, kept.in_time)
    assert found.sample_rate == pytest.approx(rate, abs=1.0)
    assert bool(found.slowness) == (bool(rate) and found.is_kept is False)
    unfelt = [replace(each, is_felt=False) for each in kept.in_time]
    assert not timekeeping.Timekeeping.from_times(times, parameters, unfelt).slowness


def test_a_slow_device_that_bears_the_coupling_is_not_weakened_and_hears_nothing() -> None:
    peaks = []
    for every in (1, 4):
        device = ScriptedDevice(pressed, is_stale=lambda tick, n=every: tick % n != 0)  # type: ignore[misc]
        with fast("virtual_wall", device, coupling=Coupling(200.0, 0.3)) as bridge:
            summary = bridge.run(1.0)
        peaks.append(summary.peak_force)
        assert "the handle slips" not in str(summary)
        assert summary.is_certified
    assert peaks[1] == pytest.approx(peaks[0], rel=0.05)


def test_a_run_that_the_guard_stopped_is_not_certified(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with (
        fast("point_mass", ScriptedDevice(leap_at(200)), recording=path) as bridge,
        pytest.raises(SafetyTrip, match="jumped"),
    ):
        bridge.run(0.5)
    report = audit(path)
    assert report.certified is False
    assert report.exit_code == 1


def leap_at(leap: int) -> Callable[[int], tuple[float, ...]]:
    """Returns the poses of a device at rest that is 3 m away from a tick on."""
    return lambda tick: (0.0, 0.0, 3.0 if tick >= leap else 0.0, 1.0, 0.0, 0.0, 0.0)


def test_a_first_sample_far_from_the_start_is_refused() -> None:
    device = ScriptedDevice(leap_at(0))
    at_start, device.start = device.start, lambda period: at_home(at_start(period))  # type: ignore[method-assign]
    with fast("point_mass", device) as bridge, pytest.raises(SafetyTrip, match="jumped"):
        bridge.run(0.1)
    assert not np.any(device.writes)


def at_home(sample: NDArray[np.void]) -> NDArray[np.void]:
    sample["position"][0] = 0.0
    return sample


def kept_time() -> timekeeping.Timekeeping:
    """Returns the time that a short run in simulated time kept."""
    with Bridge("point_mass", "simulated", clock=SimulatedClock()) as bridge:
        return bridge.run(0.05).timekeeping


def test_a_force_that_the_watch_lowered_refutes_a_device_that_is_not_judged() -> None:
    device = ScriptedDevice(sway, damping=None)
    with fast("point_mass", device) as bridge:
        bridge.run(0.05)
        run, method, info = bridge.session.parameters, bridge.setup.method, bridge.setup.info
    times = timekeeping.RunTimes(
        ticks=50,
        fresh=1.0,
        new_samples=50,
        due=50,
        mean_delay=0.0,
        mean_jitter=0.0,
        delay_energy=0.0,
        is_realtime=False,
    )
    found = certification_of(info, run, method, times, HandEnergy())
    assert (found.verdict, found.standing) == (None, Standing.DAMPING_UNKNOWN)
    swung = replace(times, flags=int(TickFlag.SWINGING))
    found = certification_of(info, run, method, swung, HandEnergy())
    assert (found.verdict, found.standing) == (False, Standing.ALARM)


@pytest.mark.parametrize(("share", "told"), [(1.0, "slow motion"), (0.5, "deadlines were missed")])
def test_a_scene_is_slow_by_itself_only_beside_a_loop_in_time(share: float, told: str) -> None:
    slow = replace(kept_time(), scene_rate=500.0, scene_speed=0.5, share=share, is_kept=None)
    assert told in slow.hint


def test_a_silence_of_the_device_is_the_cause_and_not_the_clock() -> None:
    silent = replace(kept_time(), is_kept=False, silence=timekeeping.Silence(1.0, 2.0))
    assert "no new sample for 1 s (at 2.0 s), and the force faded; check its link" in silent.fault
    assert "doctor" not in silent.fault
    assert "doctor" in replace(silent, share=0.5).fault


def damping_for_ticks(stiffness: float, damping: float, share: float, ticks: int) -> float:
    """Returns the least b/m of the form in ``kernel.timing`` for a sample in m ticks, T = 1.

    ``share`` is t_d/(m T). The tool's motion in each of the ticks is free.
    """
    most, unit = 0.0, np.eye(2 + ticks, dtype=complex)
    moved, uneven, tool = unit[0], unit[1], unit[2:]
    for theta in np.geomspace(1e-3, np.pi, 100):
        back = np.exp(-1j * theta)
        stretched = [*(-tool[:-1]), moved - tool[-1]]
        spring = sum(stretched) / (1 - back) * back
        form = np.zeros((2 + ticks, 2 + ticks), complex)
        for change, step in zip(stretched, tool, strict=True):
            spring = spring + change
            force = stiffness * spring + damping * change
            form += _product(force, step)
        early = share * moved + uneven
        form -= _product(force * back, moved - early) + _product(force * back * back, early)
        rest = form[:2, :2] - form[:2, 2:] @ np.linalg.solve(form[2:, 2:], form[2:, :2])
        weights = np.array([1.0, 1.0 / (share * (1.0 - share))])
        rest = rest / np.sqrt(np.outer(weights, weights))
        most = max(most, float(np.linalg.eigvalsh(rest)[-1]))
    return most


@pytest.mark.parametrize("ticks", [1, 2, 4, 8])
@pytest.mark.parametrize("damping", [0.0, 0.1, 1.0, 5.0])
@pytest.mark.parametrize("share", [1e-6, 0.1, 0.5])
def test_a_sample_in_several_ticks_needs_no_more_than_is_charged(
    ticks: int, damping: float, share: float
) -> None:
    stiffness, needed = 2.0, 1.0 + damping
    kappa = (stiffness / 2.0) ** 2 / needed
    charged = needed + (ticks - 1) * kappa + 3.0 * ticks * kappa * share
    found = damping_for_ticks(stiffness, damping, share, ticks)
    assert found <= charged * (1.0 + 1e-6)
    if damping == 0.0:
        assert found == pytest.approx(charged, rel=1e-3)  # exact for a spring
        if ticks > 1:  # the charge for one tick is too small
            assert found > 1.9 * (needed + 3.0 * kappa * share)


def test_run_and_audit_charge_a_late_sample_for_each_of_its_ticks(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    clock = SlowClock({}, {})
    device = ScriptedDevice(
        stroke,
        is_stale=lambda tick: 400 < tick < 410,
        on_write=lambda _sent: clock.spend(0.3),
    )
    summary = recorded(path, "virtual_wall", device, STIFF, clock=clock, duration=0.5)
    report = audit(path)
    kept = report.timekeeping
    assert report.resimulation == "bit for bit"
    assert kept is not None
    assert summary.timekeeping.delay_energy > 0.0
    assert kept.delay_energy == pytest.approx(summary.timekeeping.delay_energy, rel=1e-6)


@pytest.mark.parametrize(("stall", "ends", "lost"), [(1, 0.71, 1.4e-5), (99, 5.0, 0.06)])
def test_the_handle_slips_until_a_late_tick_is_paid(
    tmp_path: Path, stall: int, ends: float, lost: float
) -> None:
    """The guide's numbers, of a free motion at 20 mm/s."""

    def pose(tick: int) -> list[float]:
        return [2e-5 * (tick + (stall if tick >= 700 else 0)), 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]

    device = ScriptedDevice(pose, damping=5.0)
    with Bridge(
        "point_mass", device, recording=tmp_path / "slip.mcap", clock=SlowClock({700: stall})
    ) as bridge:
        bridge.run(duration=6.0)
    ticks = read_recording(tmp_path / "slip.mcap").ticks
    slips = ticks["deadline_ns"][(ticks["flags"] & TickFlag.REANCHORED) != 0] * 1e-9
    assert slips[-1] == pytest.approx(ends, rel=0.1)
    moved = [np.ptp(ticks[name][1:, 0]) for name in ("device_position", "handle_position")]
    assert moved[0] - moved[1] == pytest.approx(lost, rel=0.3)


class WrappingDevice(AnsweringDevice):
    """A hand of 0.2 N behind an encoder of 10 bits and 5 µm, which wraps each 5.12 mm."""

    def __init__(self) -> None:
        super().__init__(lambda _, force: (0.2 + force) / 2.0, damping=2.0, delay=0.0)

    def read(self, sample: NDArray[np.void]) -> int:
        result = super().read(sample)
        sample["position"][0, 0] = (self._place + 2.56e-3) % 5.12e-3 - 2.56e-3
        return result


def test_a_device_that_jumps_is_not_put_down_to_the_scene(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    summary = recorded(path, "point_mass", WrappingDevice(), duration=2.0)
    ticks = read_recording(path).ticks
    far = [np.abs(np.diff(ticks[f"{part}_position"][:, 0])).max() for part in ("device", "tool")]
    assert far[0] > 5e-3 > 5 * far[1]
    assert summary.is_certified is False
    assert timekeeping.TOO_FAR in str(summary)
    assert "scene" not in timekeeping.TOO_FAR
    assert "check the device for jumps of its pose" in str(summary)


FLUNG = """
<mujoco>
  <option gravity="0 0 0"/>
  <worldbody>
    <body>
      <freejoint/>
      <geom size=".02" mass="1e-3"/>
      <site name="grip"/>
      <body pos="0 .4 .2">
        <joint name="wing" axis="1 0 0" damping=".007"/>
        <geom type="capsule" size=".02" fromto="0 0 0 0 2 0" mass="2e-6"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="wing"/></actuator>
  <keyframe><key name="home" ctrl="5"/></keyframe>
</mujoco>
"""
"""A tool of 1 g that a motor of 5 N m turns by up to 0.44 rad within a tick."""


@pytest.mark.parametrize(("substeps", "delay"), [(1, 0.0), (5, 0.0), (1, 1e-3)])
def test_a_flung_tool_is_no_matter_of_time_or_of_a_scene_that_creates(
    tmp_path: Path, substeps: int, delay: float
) -> None:
    scene, path = tmp_path / "flung.xml", tmp_path / "run.mcap"
    scene.write_text(FLUNG)
    late = ScriptedDevice(still, delay=delay, damping=2.0, rotational_damping=2e-3)
    device = late if delay else "simulated"
    summary = recorded(path, scene, device, duration=0.05, substeps=substeps, limits=Limits())
    assert read_recording(path).ticks["environment_energy"].max() < 0.0
    report = audit(path)
    assert report.timekeeping is not None
    kept = summary.timekeeping
    assert (kept.share, kept.fresh, kept.mean_delay, kept.mean_jitter) == (1.0, 1.0, 0.0, 0.0)
    assert 1e-3 < kept.delay_energy == pytest.approx(report.timekeeping.delay_energy, rel=1e-6)
    assert summary.is_certified is report.certified is False
    assert kept.cause == timekeeping.TOO_FAR
    for text in (str(summary), report.reason):
        assert timekeeping.TOO_FAR in text
        assert "less force of what pushes the tool" in text
        assert "time" not in text.partition(timekeeping.TOO_FAR)[2].partition(";")[0]
        assert "late" not in text
    # with a microsecond of lateness, as on any clock, it is one of the causes
    real = replace(kept, mean_jitter=1e-6).fault
    assert (
        "late samples and forces, or a tool that moved far from its handle within a tick," in real
    )
