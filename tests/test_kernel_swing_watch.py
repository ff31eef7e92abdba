"""The watch for a late or reversed force: false alarms of honest hands, words, audit."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from faults.catalogue import FINGERS
from model_runs import LOOP_SCENES
from numpy.typing import NDArray
from own_attacks import PINNED
from own_device import Drive, OwnDevice
from random_hands import random_motion
from swing_cases import (
    GRIPS,
    VERY_FIRM,
    BetweenStops,
    alarms,
    bunched,
    shakes,
    taps,
)

import hapticbridge as hb
from hapticbridge.audit import audit
from hapticbridge.demand.guard import Limits
from hapticbridge.device import (
    AXES,
    DEFAULT_HAND,
    DeviceInfo,
    Hand,
    Motion,
    SimulatedDevice,
    TrajectoryDevice,
)
from hapticbridge.kernel.record import TickFlag
from hapticbridge.recording.recorder_process import RunState


@pytest.mark.parametrize("name", LOOP_SCENES)
def test_random_hands_are_no_alarm(name: str) -> None:
    for seed, grip in enumerate(GRIPS.values()):
        assert not alarms(name, random_motion(seed + 9), grip)


@pytest.mark.parametrize("grip", GRIPS)
@pytest.mark.parametrize("amplitude", [2e-3, 5e-3, 1e-2])
def test_taps_of_8_hz_are_no_alarm(amplitude: float, grip: str) -> None:
    assert not alarms("virtual_wall", taps(8.0, amplitude), GRIPS[grip])


@pytest.mark.parametrize(
    ("name", "frequency", "amplitude"),
    [
        ("drawer", 3.0, 0.03),
        ("hammer", 5.0, 0.012),
        ("hammer", 8.0, 0.03),
        ("point_mass", 8.0, 0.03),
        ("peg_in_hole", 8.0, 0.03),
    ],
)
def test_firm_hands_that_shake_a_scene_are_no_alarm(
    name: str, frequency: float, amplitude: float
) -> None:
    """Two times the force limit, and as much work as a late force would do."""
    for grip in (GRIPS["firm"], VERY_FIRM):
        assert not alarms(name, shakes(name, frequency, amplitude), grip)


@pytest.mark.parametrize(
    ("name", "grip"),
    [("drawer", "arm"), ("peg_in_hole", "arm"), ("bench_pliers", "firm"), ("hammer", "firm")],
)
def test_a_shaken_device_2_ms_late_is_no_alarm(name: str, grip: str) -> None:
    """For 12 ms the answer to the force in the drawer shows a delay of 2.5 ms."""
    device = SimulatedDevice(path=shakes(name, 8.0, 0.03), hand=GRIPS[grip], delay=2)
    assert device.info.delay is None
    with hb.Bridge(name, device, clock=hb.SimulatedClock()) as bridge:
        summary = bridge.run(3.0)
    assert not summary.timekeeping.alarm


@pytest.mark.parametrize(
    ("delay", "name", "grip", "motion"),
    [
        (3, "point_mass", "firm", (8.0, 0.03)),
        (5, "virtual_wall", "arm", (3.0, 0.03)),
        (5, "hammer", "arm", (3.0, 0.03)),
    ],
)
def test_a_late_device_is_no_alarm_if_it_states_its_delay(
    delay: int, name: str, grip: str, motion: tuple[float, float]
) -> None:
    device = SimulatedDevice(path=shakes(name, *motion), hand=GRIPS[grip], delay=delay)
    for stated, is_alarm in ((1e-3 * delay, False), (0.0, True)):
        device.info = replace(device.info, delay=stated)
        with hb.Bridge(name, device, clock=hb.SimulatedClock()) as bridge:
            summary = bridge.run(3.0)
        assert bool(summary.timekeeping.alarm) is is_alarm


@pytest.mark.parametrize("name", ["hammer", "virtual_wall", "ratchet", "peg_in_hole"])
def test_a_scenes_own_task_is_no_alarm(name: str) -> None:
    assert not alarms(name, None, None)


def test_a_probe_lowers_the_force_for_a_moment_and_is_no_alarm(tmp_path: Path) -> None:
    """A firm hand that taps a wall at 8 Hz is suspicious, and acquitted."""
    path = tmp_path / "run.mcap"
    device = SimulatedDevice(path=taps(8.0, 5e-3), hand=GRIPS["firm"])
    with hb.Bridge("virtual_wall", device, clock=hb.SimulatedClock(), recording=path) as bridge:
        summary = bridge.run(3.0)
    assert summary.is_certified
    assert not summary.certification.reason
    ticks = hb.read_recording(path).ticks
    is_probed = (ticks["flags"] & int(TickFlag.PROBED)) != 0
    begins = 1 + np.flatnonzero(np.diff(is_probed.astype(int)) == 1)
    assert 1 <= len(begins) <= 3
    share = ticks["lever"]
    assert share[is_probed].min() == 0.25
    assert (share[begins - 1] == 1.0).all()
    assert (share[begins + 200] == 1.0).all()  # 0.15 s and two fades
    report = audit(path)
    assert report.verdict == summary.verdict
    assert report.resimulation == "bit for bit"


@pytest.mark.parametrize("limit", [2.0, 10.0])
@pytest.mark.parametrize("step", [2e-4, 4e-3])
def test_steps_of_an_encoder_are_an_alarm_if_the_force_swings_by_half_its_limit(
    step: float, limit: float
) -> None:
    """2400 N/m make 0.5 N of 0.2 mm and 9.6 N of 4 mm."""
    device = SimulatedDevice(path=taps(2.0, 1e-2, 1.0), hand=DEFAULT_HAND, resolution=step)
    limits = Limits(force=limit, torque=0.5)
    with hb.Bridge("virtual_wall", device, clock=hb.SimulatedClock(), limits=limits) as bridge:
        assert bridge.setup.coupling.stiffness == 2400.0
        summary = bridge.run(1.0)
    assert ("in coarse steps" in summary.certification.reason) == (step == 4e-3)


def test_motion_that_lost_samples_hide_is_no_coarse_step() -> None:
    """A sample in five is new: fast motion arrives in steps of 6 mm, and none is a finding."""
    device = SimulatedDevice(path=shakes("virtual_wall", 8.0, 0.03), hand=GRIPS["firm"])
    inner, ticks = device.read, iter(range(1000))

    def read(sample: NDArray[np.void]) -> int:
        last = sample[0].copy()
        inner(sample)
        if next(ticks) % 5 == 0:
            return 0
        sample[0] = last
        return int(TickFlag.STALE_SAMPLE)

    device.read = read  # type: ignore[method-assign]
    with hb.Bridge("virtual_wall", device, clock=hb.SimulatedClock()) as bridge:
        summary = bridge.run(1.0)
        moved = np.diff(bridge.latest_records(1000)["device_position"][:, 0])
    assert np.abs(moved).max() > 4e-3
    assert not summary.timekeeping.alarm


class LateDevice:
    """A simulated device whose motors act 10 ticks after they are told."""

    def __init__(self) -> None:
        path = Motion([0.0, 0.2, 0.9, 9.0], [(x, 0.0, 0.0) for x in (0.0, 0.0, 0.181, 0.181)])
        self.inner = SimulatedDevice(path=path, hand=FINGERS, delay=10)
        self.info = replace(self.inner.info, delay=0.0)  # a data sheet that is wrong
        self.start, self.read = self.inner.start, self.inner.read
        self.write, self.close = self.inner.write, self.inner.close


def pressed(path: Path, *, is_watched: bool) -> hb.Summary:
    limits = Limits(force=10.0, torque=0.5)
    bridge = hb.Bridge(
        "virtual_wall", LateDevice(), clock=hb.SimulatedClock(), recording=path, limits=limits
    )
    if not is_watched:
        guard = replace(bridge.setup.guard, swing_energy=np.inf, runaway_speed=np.inf)
        bridge.setup = replace(bridge.setup, guard=guard)
    with bridge:
        return bridge.run(1.5)


SHAKER = """<mujoco><compiler angle="radian"/>
<option timestep="0.001" integrator="discrete" cone="elliptic" gravity="0 0 0"/>
<worldbody><body name="tool"><joint name="x" type="slide" axis="1 0 0"/>
  <geom type="sphere" size="0.01" mass="0.05"/><site name="grip"/></body></worldbody>
<actuator><motor name="shaker" joint="x"/></actuator></mujoco>
"""
"""A tool of 50 g on a motor; with the default coupling it swings at 35 Hz."""


class Swung(OwnDevice):
    """A device in a hand that meters ``rise``: the most energy in J that the hand regained.

    A hand that starts with energy may lose more of it than a swing gives.
    """

    lowest = rise = 0.0

    def read(self, sample: NDArray[np.void]) -> int:
        code = super().read(sample)
        self.lowest = min(self.lowest, self.got)
        self.rise = max(self.rise, self.got - self.lowest)
        return code


def slammed(path: Path, delay: int) -> tuple[hb.Summary, float]:
    """Throws 20 g at a wall, by a device that states no delay; returns its run and J regained."""
    device = Swung(
        (100.0, 0.5),
        late=lambda _: delay,
        mass=0.02,
        start=(-0.035, 0.0),
        is_delay_measured=True,
    )
    with hb.Bridge("virtual_wall", device, clock=hb.SimulatedClock(), recording=path) as bridge:
        summary = bridge.run(4.0)
    return summary, device.rise


def test_a_light_hand_that_slams_on_a_device_1_ms_late_is_found(tmp_path: Path) -> None:
    """The force swung between 10 and -10 N at 60 Hz for ever, at a phase like that of no delay."""
    path = tmp_path / "run.mcap"
    summary, joules = slammed(path, 1)
    assert joules <= 0.1  # it swings back from the wall by 6 mJ in time
    assert summary.is_certified is False
    report = audit(path)
    assert report.certified is False
    assert "the device swung: it answered late" in report.reason
    assert report.resimulation == "bit for bit"
    force = hb.read_recording(path).ticks["wrench_on_device"][:, 0]
    assert np.abs(force[:1200]).max() >= 5.0
    assert force[-500:].std() <= 0.3


STIFF_HANDS = [
    (0.062, 53_207.0, 0.447, 1),
    (0.025, 9281.0, 0.313, 2),
    (0.015, 9281.0, 0.313, 2),
    (0.05, 25_000.0, 0.3, 2),
    (0.0383, 8907.0, 0.056, 2),
    (0.0071, 1751.0, 0.018, 2),
    (0.0125, 2775.0, 0.003, 2),
]
"""Mass in kg, stiffness in N/m and damping in N s/m, and delay in ms of hands that swing at 98 to
172 Hz for ever and take up to 4 W."""


@pytest.mark.parametrize("stiff", STIFF_HANDS)
def test_a_stiff_hand_on_a_late_device_is_found(stiff: tuple[float, float, float, int]) -> None:
    mass, stiffness, damping, delay = stiff
    for late, stated in ((delay, 0), (0, 0), (delay, delay)):
        device = Swung(
            (stiffness, damping),
            late=lambda _, ticks=late: ticks,  # type: ignore[misc]
            mass=mass,
            start=(-0.0105, 0.0),
            delay=1e-3 * stated,
            is_delay_measured=True,
        )
        with hb.Bridge("virtual_wall", device, clock=hb.SimulatedClock()) as bridge:
            summary = bridge.run(3.0)
        assert summary.is_certified is (late == stated)
        if late == stated:
            assert device.gained < 1e-6
        else:
            assert 0.1 < device.rise <= 2.0  # 6.3 to 8.4 J where blocks were judged


@pytest.mark.parametrize(
    ("hand", "push", "delay"),
    [
        ((0.028, 3.2, 11.5), 4.9, 2),
        ((0.0088, 2.7, 5.3), 3.8, 2),
        ((0.010, 0.9, 85.0), 5.0, 1),
        ((0.025, 1.0, 0.5), 2.5, 1),
        ((0.050, 0.5, 18.0), 2.5, 1),
        ((0.050, 0.05, 350.0), 2.5, 2),
    ],
)
def test_a_hand_that_is_pushed_on_by_late_forces_is_found_and_rests(
    hand: tuple[float, float, float], push: float, delay: int
) -> None:
    """It swings at 34 to 73 Hz with 1.5 to 2.5 N for ever, and takes up to 0.6 W; no wall would."""
    mass, damping, stiffness = hand
    held = Hand(mass=mass - 0.005, damping=damping, stiffness=stiffness)
    path = Motion([0.0, 1.0, 99.0], [(x, 0.0, 0.0) for x in (0.0, *2 * (push / stiffness,))])
    forces = []
    for ticks in (delay, 0):
        device = SimulatedDevice(mass=0.005, hand=held, path=path, delay=ticks)
        device.info = replace(device.info, delay=0.0)
        with hb.Bridge("virtual_wall", device, clock=hb.SimulatedClock()) as bridge:
            summary = bridge.run(6.0)
            forces.append(bridge.latest_records(1000)["wrench_on_device"][:, 0].std())
        assert summary.is_certified is (ticks == 0)
    assert max(forces) <= 0.3


@pytest.mark.parametrize(
    ("hand", "push", "tremor", "stiffness"),
    [
        ((0.0300, 2.0, 20.0), 4.0, 0.0, 3400.0),
        ((0.0260, 2.77, 5.0), 4.3, 0.0, 3400.0),
        ((0.0280, 3.2, 11.5), 4.9, 3.0, None),
    ],
)
def test_a_stiff_wall_or_a_tremor_hides_no_late_force(
    hand: tuple[float, float, float], push: float, tremor: float, stiffness: float | None
) -> None:
    """0.1 to 0.2 W went on for ever, certified. The tremor has 8 Hz; ``tremor`` is in N."""
    mass, damping, spring = hand
    held = Hand(mass=mass - 0.005, damping=damping, stiffness=spring)
    times = np.arange(0.0, 7.0, 1e-3)
    swing = tremor / abs(spring + 16j * np.pi * damping) * np.sin(16 * np.pi * times)
    along = np.minimum(times, 1.0) * (push / spring + swing)
    path = Motion(times, [(x, 0.0, 0.0) for x in along])
    coupling = None if stiffness is None else {"stiffness": stiffness}
    for delay in (1 if tremor == 0.0 else 2, 0):
        device = SimulatedDevice(mass=0.005, hand=held, path=path, delay=delay)
        device.info = replace(device.info, delay=0.0)
        with hb.Bridge("virtual_wall", device, coupling, clock=hb.SimulatedClock()) as bridge:
            summary = bridge.run(5.0)
            ticks = bridge.latest_records(1000)
        speed = np.diff(ticks["device_position"][:, 0])[2:] / 1e-3
        acted = ticks["wrench_on_device"][2 - delay : 999 - delay, 0]
        assert summary.is_certified is (delay == 0)
        assert np.mean(acted * speed - 2.0 * speed**2) <= 0.003


@pytest.mark.parametrize(
    ("stop", "mass", "hand", "shaking"),
    [
        ((0.0035, 29650.0, 2.9), 0.069, (1084.0, 5.4), (0.0165, 7.7)),
        ((0.0023, 14900.0, 3.0), 0.069, (622.0, 2.1), (0.0090, 7.6)),
        ((0.0047, 14100.0, 13.0), 0.061, (543.0, 2.4), (0.0150, 5.9)),
    ],
)
def test_a_hand_that_shakes_a_device_against_its_stops_is_no_alarm(
    stop: tuple[float, float, float],
    mass: float,
    hand: tuple[float, float],
    shaking: tuple[float, float],
) -> None:
    """The damping burns at each blow, and no force has given the speed."""
    device = BetweenStops(stop, mass, hand, shaking)
    with hb.Bridge("virtual_wall", device, clock=hb.SimulatedClock()) as bridge:
        summary = bridge.run(4.0)
    assert summary.is_certified


def test_a_light_hand_is_no_alarm_if_the_force_comes_in_time(tmp_path: Path) -> None:
    summary, joules = slammed(tmp_path / "run.mcap", 0)
    assert summary.is_certified
    assert joules <= 0.01  # what the wall stored


@pytest.mark.parametrize("frequency", [35.0, 50.0])
def test_a_motor_that_shakes_the_tool_is_no_alarm(tmp_path: Path, frequency: float) -> None:
    """It swings the force by 3 N and more, and gives the hand what it burns."""
    scene = tmp_path / "shaker.xml"
    scene.write_text(SHAKER)
    device = SimulatedDevice(path=Motion([0.0, 1.5], [(0.0, 0.0, 0.0)] * 2), hand=DEFAULT_HAND)
    limits = Limits(force=10.0, torque=0.5, energy=10.0)
    with hb.Bridge(scene, device, clock=hb.SimulatedClock(), limits=limits) as bridge:
        summary = bridge.run(
            1.5,
            lambda tick: bridge.set_input(
                ctrl={"shaker": 8.0 * math.sin(2e-3 * math.pi * frequency * tick)}
            ),
        )
        force = bridge.latest_records(500)["wrench_on_device"][:, 0]
    assert force.std() >= 3.0
    assert not summary.timekeeping.alarm


def sways(amplitude: float, duration: float) -> Motion:
    """Returns a hand that goes about in a plane, in m and s, and so into ``virtual_wall``."""
    times = np.arange(0.0, duration + 0.005, 0.002)
    x, y = np.sin(5.0 * times), 1.0 - np.cos(4.0 * times)
    rise = amplitude * np.clip(times - 1.0, 0.0, 1.0)
    return Motion(times, np.stack([rise * x, rise * y, 0.0 * times], axis=1))


@pytest.mark.parametrize(("delay", "most"), [(10, 2), (20, 2), (20, 4)])
def test_a_late_device_is_found_if_its_samples_come_in_bunches(delay: int, most: int) -> None:
    motion = sways(0.03, 8.0)
    device = SimulatedDevice(path=motion, mass=0.15, damping=1.2, force_limit=6.0)
    found, joules = bunched("virtual_wall", motion, device, delay, most, begin=2000)
    assert found & TickFlag.SWINGING
    assert joules <= 0.3  # 0.7 J and 2.9 J where a block ended between two samples


@pytest.mark.parametrize("grip", GRIPS)
@pytest.mark.parametrize("most", [2, 5])
def test_samples_in_bunches_alone_are_no_alarm(most: int, grip: str) -> None:
    motion = taps(8.0, 4e-3)
    device = SimulatedDevice(path=motion, hand=GRIPS[grip])
    found, joules = bunched("virtual_wall", motion, device, 0, most)
    assert found == 0
    assert joules <= 1e-6


def test_summary_and_audit_say_what_the_watch_did(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    summary = pressed(path, is_watched=True)
    sentence = summary.certification.reason
    assert sentence.startswith("the force was")
    assert summary.is_certified is False
    report = audit(path)
    assert sentence in report.reason
    assert report.certified is False
    assert report.exit_code == 1
    assert report.verdict != "invalid"
    assert report.resimulation == "bit for bit"
    ticks = hb.read_recording(path).ticks
    is_on = (ticks["flags"] & int(TickFlag.SWINGING | TickFlag.RUNS_AWAY)) != 0
    first = int(np.argmax(is_on))
    assert is_on[first:].all()
    assert (np.diff(ticks["lever"][first:]) <= 0.0).all()
    assert ticks["lever"][-1] <= 0.5


def test_without_the_watch_nothing_is_said(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    assert not pressed(path, is_watched=False).timekeeping.fault
    assert "the force was" not in audit(path).reason


ZIGZAG = Motion(np.arange(0.0, 2.0, 0.1), [(0.02 + 0.02 * (k % 2), 0.0, 0.0) for k in range(20)])
"""A motion in the wall to and fro at 0.2 m/s, whose speed jumps."""


@pytest.mark.parametrize("is_prescribed", [True, False])
def test_motion_that_no_force_changes_is_an_alarm_only_if_its_device_claims_a_hand(
    is_prescribed: bool,
) -> None:
    """Prescribed motion cannot swing through the force; a hand so strong does not exist."""
    device = TrajectoryDevice(ZIGZAG)
    device.info = (
        replace(device.info, force_limit=10.0)
        if is_prescribed
        else DeviceInfo(name="hand", axes=AXES[:3], damping=2.0, force_limit=10.0, is_real=False)
    )
    with hb.Bridge("virtual_wall", device, clock=hb.SimulatedClock()) as bridge:
        bridge.run(1.0)
        flags = int(np.bitwise_or.reduce(bridge.latest_records(1000)["flags"]))
    is_alarm = flags & int(TickFlag.SWINGING | TickFlag.RUNS_AWAY) != 0
    assert is_alarm != is_prescribed


def test_a_silence_of_the_device_is_named_in_summary_audit_and_live_line(tmp_path: Path) -> None:
    device, path = SimulatedDevice(), tmp_path / "run.mcap"
    inner, ticks = device.read, iter(range(10000))

    def read(sample: NDArray[np.void]) -> int:
        if 300 <= next(ticks) < 800:
            return int(TickFlag.STALE_SAMPLE)
        return inner(sample)

    device.read = read  # type: ignore[method-assign]
    with hb.Bridge("point_mass", device, clock=hb.SimulatedClock(), recording=path) as bridge:
        summary = bridge.run(1.2)
    words = "the device gave no new sample for 500 ms (at 0.3 s)"
    assert words in str(summary)
    assert words in audit(path).reason
    state, rows = RunState(), hb.read_recording(path).ticks
    state.add(rows[:700])
    assert "NO NEW SAMPLE for 0.4 s" in str(state)
    state.add(rows[700:])
    assert "once no new sample for 0.5 s" in str(state)


@pytest.mark.parametrize("delay", [2, 0])
def test_a_torque_that_slams_on_a_late_device_is_found(delay: int) -> None:
    """It swings a grip of 5.6e-6 kg m² with 0.5 W for ever."""
    drive = Drive(twist=0.2, inertia=5.6e-6, spring=2.12, damper=2.3e-5)
    own: dict[str, Any] = {"rotational_damping": 2e-3, "torque_limit": 0.5, "start": (0.0, 0.0)}
    device = OwnDevice((2000.0, 5.0), late=lambda _: delay, drive=drive, **own)
    scene = hb.load_scene(mujoco.MjSpec.from_string(PINNED))
    with hb.Bridge(scene, device, clock=hb.SimulatedClock()) as bridge:
        summary = bridge.run(4.0)
    assert summary.is_certified is (delay == 0)
    assert device.gained <= (0.3 if delay else 1e-6)
