"""Pulses of blows: paid for by what the blow burned, whatever the hand does."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from audit_cases import ScriptedDevice, recorded, verdict_of
from kernel_runs import T, load
from tapping import (
    COUPLING,
    DAMPING,
    GAP,
    SPARE,
    Tapping,
    onset,
    parameters_of,
    spectral_error,
    stiff_onset,
    tapping,
    towards,
    wall,
)
from view_cases import tapped_wall

from hapticbridge.audit import audit
from hapticbridge.coupling import Coupling
from hapticbridge.demand.guard import Limits
from hapticbridge.demand.methods import METHODS
from hapticbridge.demand.pulse import PULSES
from hapticbridge.device.simulated.device import SimulatedDevice
from hapticbridge.errors import HapticBridgeError
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.kernel.record import TickFlag
from hapticbridge.kernel.tick import whole_tick
from hapticbridge.recording import Recording, read_recording
from hapticbridge.run.bridge import Bridge
from hapticbridge.run.commands import Couple
from hapticbridge.run.hands import Grasp


def struck(taps: Tapping, speed: float, ticks: int = 40) -> Any:
    """Strikes the wall and goes on for some ticks; returns the records from the blow on."""
    while not taps.rows or taps.rows[-1]["blow_energy"] == 0.0:
        taps.tick(towards(speed))
    first = len(taps.rows) - 1
    for _ in range(ticks):
        taps.tick(towards(speed))
    return taps.ticks[first:]


# The pulse


@pytest.mark.parametrize("speed", [0.1, 0.2, 0.4])
def test_a_blow_starts_a_pulse_away_from_the_wall(speed: float) -> None:
    taps = tapping()
    rows = struck(taps, speed)
    pulses = rows["pulse"][:, 0]
    assert (pulses[0], rows["pulse"][:, 1:].any()) == (0.0, False)
    assert pulses[1:4].max() < 0.0  # the wall is at positive x
    assert rows["blow_energy"][rows["blow_energy"] > 0].sum() == pytest.approx(
        0.5 * 0.1 * rows["blow_speed"][0] ** 2, rel=0.5
    )
    # beside the coupling's force
    whole = rows["wrench_on_device"][:, 0]
    np.testing.assert_allclose(whole - pulses, -rows["wrench_on_tool"][:, 0], atol=1e-12)


def test_its_course_is_a_cosine_that_decays() -> None:
    frequency, decay = 100.0, 0.0125
    taps = tapping(pulse_frequency=frequency, pulse_decay=decay)
    rows = struck(taps, 0.1, 30)
    last = int(np.flatnonzero(rows["blow_energy"])[-1])
    pulses, j = rows["pulse"][last + 1 :, 0], np.arange(len(rows) - last - 1)
    course = np.exp(-j * T / decay) * np.cos(2 * np.pi * frequency * j * T)
    amplitude = taps.pulse["amplitude"]
    assert np.abs(pulses + amplitude * course)[:4].max() < 1e-9 * amplitude
    assert np.abs(pulses).max() <= amplitude * (1 + 1e-9)


def test_a_harder_blow_gives_a_stronger_pulse() -> None:
    sizes = [np.abs(struck(tapping(), speed)["pulse"]).max() for speed in (0.1, 0.2, 0.3)]
    assert sizes[0] < sizes[1] < sizes[2]


def test_without_the_option_no_number_changes_but_the_blow_is_noted_where_it_bounces() -> None:
    off = tapping(impact_pulses=0.0, pulse_damping=0.0)
    for _ in range(400):
        off.tick(towards(0.2))
    assert not off.ticks["pulse"].any()
    assert not off.ticks["pulse_account"].any()
    assert not off.ticks["blow_energy"].any()  # this wall does not bounce


def test_force_and_pulse_together_keep_the_limit() -> None:
    for limit in (0.5, 2.0, 10.0):
        taps = tapping(force_limit=limit)
        rows = struck(taps, 0.3)
        assert np.abs(rows["wrench_on_device"][:, :3]).max() <= limit * (1 + 1e-12)
        assert rows["pulse"].any()


@pytest.mark.parametrize("is_near", [True, False])
def test_force_and_pulse_together_keep_the_energy_limit(is_near: bool) -> None:
    limit, speed = 0.04, 15.0
    taps = tapping(guarding={"energy": limit, "full_speed": speed})
    struck(taps, 0.1, 1)
    observer = taps.kernel.state["observer"]
    for _ in range(3):
        if is_near:
            observer["net_device_energy"] = 0.9 * limit
        row = taps.tick(towards(0.0))
        force, got = abs(row["wrench_on_device"][0]), float(observer["guarded_energy"][0])
        assert got + T * force * speed <= 1.25 * limit
        assert (row["pulse"][0] == 0.0) == is_near
        assert not row["flags"] & TickFlag.CONTROLLER_ACTIVE


def test_a_missing_sample_ends_the_pulse() -> None:
    taps = tapping()
    struck(taps, 0.3, 3)
    assert taps.rows[-1]["pulse"][0] != 0.0
    assert taps.pulse["ended_by"] == 0
    assert taps.tick(towards(0.3), is_stale=True)["pulse"][0] == 0.0
    assert taps.pulse["ended_by"] == TickFlag.STALE_SAMPLE
    assert taps.tick(towards(0.3))["pulse"][0] == 0.0


def test_a_pulse_follows_the_lever_and_ends_with_it() -> None:
    taps = tapping(guarding={"clutch": 1, "fade_ticks": 4})
    struck(taps, 0.3, 3)
    taps.sample["buttons"] = 1
    for _ in range(6):
        row = taps.tick(towards(0.0))
        assert abs(row["pulse"][0]) <= row["lever"] * taps.pulse["amplitude"] * (1 + 1e-12)
    assert (row["lever"], row["pulse"][0]) == (0.0, 0.0)
    assert taps.pulse["ended_by"] == TickFlag.RAMPING
    taps.sample["buttons"] = 0
    for _ in range(6):
        assert taps.tick(towards(0.0))["pulse"][0] == 0.0


def test_a_pause_ends_the_pulse() -> None:
    taps = tapping()
    struck(taps, 0.3, 3)
    taps.kernel.resume()
    row = taps.tick(towards(0.0))
    assert row["pulse"][0] == 0.0
    assert taps.pulse["held"] == 0.0


@pytest.mark.parametrize("substeps", [1, 3])
@pytest.mark.parametrize("method", ["implicit", "compensated"])
def test_blows_in_each_substep_are_noted(method: str, substeps: int, tmp_path: Path) -> None:
    scene, path = tmp_path / "wall.xml", tmp_path / "run.mcap"
    scene.write_text(wall())
    motion = tmp_path / "tap.csv"
    motion.write_text("t,x,y,z,qw,qx,qy,qz\n0,0,0,0,1,0,0,0\n0.2,0.05,0,0,1,0,0,0\n")
    device = SimulatedDevice(damping=DAMPING, path=str(motion))
    limits = Limits(force=8.0, torque=0.5, ramp=0.0)
    how: dict[str, Any] = {"method": method, "substeps": substeps, "limits": limits}
    recorded(path, scene, device, Coupling(300.0, 0.5), duration=0.2, impact_pulses=1.0, **how)
    blows = read_recording(path).ticks
    speed = float(blows["blow_speed"].max())
    assert blows["blow_energy"].sum() == pytest.approx(0.5 * 0.1 * speed**2, rel=0.2)
    assert audit(path).resimulation == "bit for bit"


@pytest.mark.parametrize("pulse", ["steel", "rubber"])
def test_a_part_on_a_joint_gives_a_pulse_along_the_grip_s_own_way(
    pulse: str, tmp_path: Path
) -> None:
    path = tmp_path / "ratchet.mcap"
    recorded(path, "ratchet", duration=2.0, impact_pulses=1.0, pulse=pulse, limits=Limits())
    ticks, report = read_recording(path).ticks, audit(path)
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")
    clicks = np.flatnonzero(ticks["blow_energy"] > 1e-4)
    clicks = clicks[clicks > 100]
    assert len(clicks) >= 3
    for k in clicks:
        before, now, after = ticks["tool_position"][k - 1 : k + 2]
        first = ticks["pulse"][k + 1]
        # the handle turns about an axis through 0, to which no normal of the pawl is square
        along = np.cross([0.0, 0.0, 1.0], now) / np.linalg.norm(now)
        assert abs(first @ along) == pytest.approx(np.linalg.norm(first), rel=1e-4)
        assert first @ (after - 2.0 * now + before) > 0.0


def test_a_mocap_wall_that_strikes_the_tool_gives_a_blow_of_its_speed(tmp_path: Path) -> None:
    scene, path = tmp_path / "wall.xml", tmp_path / "run.mcap"
    geom = f'<geom type="box" size="0.02 0.2 0.2" pos="{GAP + 0.04} 0 0"/>'
    assert geom in wall()
    scene.write_text(wall().replace(geom, f'<body name="wall" mocap="true">{geom}</body>'))
    device = SimulatedDevice(damping=DAMPING)

    def move(bridge: Bridge, tick: int) -> None:
        bridge.set_input(mocap={"wall": (-0.5e-3 * max(tick - 20, 0), 0.0, 0.0)})

    coupling, limits = Coupling(300.0, 0.5), Limits(force=8.0, torque=0.5, ramp=0.0)
    how: dict[str, Any] = {"impact_pulses": 1.0, "limits": limits}
    recorded(path, scene, device, coupling, duration=0.065, on_tick=move, **how)
    ticks = read_recording(path).ticks
    assert ticks["blow_speed"].max() == pytest.approx(0.5, rel=0.05)
    assert audit(path).resimulation == "bit for bit"


# The account


def test_it_gets_the_share_of_what_the_blow_burned() -> None:
    for share in (0.25, 1.0):
        taps = tapping(impact_pulses=share)
        rows = struck(taps, 0.3)
        burned = -np.diff(taps.ticks["environment_energy"], prepend=0.0)
        blows = taps.ticks["blow_energy"]
        expected = share * np.minimum(blows, np.maximum(burned, 0.0)).sum()
        assert taps.pulse["taken"] == pytest.approx(expected, rel=1e-9)
        assert 0.0 < expected <= share * -rows["environment_energy"][-1]


def test_the_tank_of_rigid_contacts_does_not_get_it_too() -> None:
    taps = tapping()
    struck(taps, 0.1, 40)
    burned = -taps.rows[-1]["environment_energy"]
    cap = 0.5 * COUPLING.stiffness * 1e-6
    assert taps.rows[-1]["contact_tank"] == pytest.approx(
        min(burned - float(taps.pulse["taken"]), cap), abs=1e-12
    )


def test_less_spare_damping_makes_pulses_weaker() -> None:
    sizes = [np.abs(struck(tapping(pulse_damping=b), 0.2)["pulse"]).max() for b in (0.0, 0.5, 3.0)]
    assert 0.0 < sizes[0] < sizes[1] < sizes[2]


def flight(gain: float) -> Any:
    """Returns a hand that flees along each pulse, with so many times its force, and strikes."""

    def hand(row: Any, v: float) -> float:
        pulse = float(row["pulse"][0])
        return gain * pulse if pulse else DAMPING * 0.4 + 6.0 * (0.4 - v)

    return hand


@pytest.mark.parametrize("delays", [(0,), (1,), (0, 1, 2), (3,)])
@pytest.mark.parametrize("gain", [0.5, 2.0, 8.0])
@pytest.mark.parametrize("frequency", [0.0, 60.0, 250.0])
def test_no_hand_gets_more_than_it_put_in(
    delays: tuple[int, ...], gain: float, frequency: float
) -> None:
    d = max(delays)
    late = {"stated_delay": d * T}
    coupling = replace(COUPLING, stiffness=COUPLING.stiffness / (d + 1) ** 2)
    taps = tapping(delays, coupling, guarding=late, pulse_frequency=frequency)
    for _ in range(1500):
        taps.tick(flight(gain))
    assert taps.ticks["pulse"].any()
    assert np.count_nonzero(taps.ticks["blow_energy"]) >= 2
    assert taps.most <= 1e-9
    spent = float(taps.pulse["work"])
    assert (
        spent
        <= float(taps.pulse["taken"])
        + SPARE * np.sum(np.diff(taps.ticks["device_position"][:, 0]) ** 2) / T
    )
    assert taps.kernel.state["observer"]["max_unpaid_energy"][0] <= 1e-9


def taken_from_pulses(
    delay: float, frequency: float, spare: float, **told: Any
) -> tuple[float, float]:
    """Returns the most that a hand got from pulses beyond what blows paid, and all they paid, in J.

    The device changes its force ``delay`` periods after a sample, and states that or what is told.
    The hand holds it while no pulse acts, and moves it along each that does, at the speed that gets
    most.
    """
    coupling = replace(COUPLING, stiffness=COUPLING.stiffness / 4)
    told = told or {"guarding": {"stated_delay": delay * T}}
    changes = {"pulse_damping": spare} | told
    taps = tapping((0,), coupling, pulse_frequency=frequency, **changes)
    place = got = most = last = 0.0
    goal, parts = 0.0235, 20
    for _ in range(1500):
        taps.sample["position"][0, 0] = place
        assert whole_tick(taps.kernel.state, taps.sample, taps.kernel.row, T)
        newest = float(taps.kernel.row[0]["pulse"][0])
        for part in range(parts):
            pulse, v = (last if part < round(delay * parts) else newest), 0.0
            if pulse:
                v = (
                    float(np.clip(pulse / (2 * spare), -9.9, 9.9))
                    if spare
                    else 9.9 * np.sign(pulse)
                )
            elif not (last or newest):
                v = float(np.clip((goal - place) / T, -0.3, 0.3))
            got += (pulse * v - spare * v * v) * T / parts
            place += v * T / parts
        if abs(place - goal) < 1e-6:
            goal = 0.0235 if goal < 0.02 else 0.005
        last, most = newest, max(most, got - float(taps.pulse["taken"]))
    return most, float(taps.pulse["taken"])


@pytest.mark.parametrize("delay", [0.25, 0.5, 0.75, 1.0])
@pytest.mark.parametrize("spare", [0.0, 3.0])
def test_a_hand_that_follows_a_change_of_force_between_samples_gets_no_more(
    delay: float, spare: float
) -> None:
    most, earned = taken_from_pulses(delay, 500.0, spare)
    assert most <= 1e-9
    assert earned > 0.1


def test_the_time_that_a_real_device_waits_for_its_force_is_covered() -> None:
    most, earned = taken_from_pulses(0.5, 500.0, 0.0, pulse_lag=T)
    assert most <= 1e-9
    assert earned > 0.1
    assert taken_from_pulses(0.5, 500.0, 0.0, pulse_lag=0.0)[0] > 0.1


def test_a_device_without_samples_is_charged_for_the_pulse_that_it_holds() -> None:
    taps = tapping()
    struck(taps, 0.3, 3)
    pulse = abs(float(taps.rows[-1]["pulse"][0]))
    for _ in range(4):
        taps.tick(towards(0.0), is_stale=True)
        assert taps.pulse["held"] == pytest.approx(pulse, rel=1e-12)
    taps.tick(towards(0.0))
    taps.tick(towards(0.0))
    assert taps.pulse["held"] == 0.0


def test_what_pulses_took_counts_as_created() -> None:
    taps = tapping()
    struck(taps, 0.3)
    s = taps.kernel.state[0]
    created = float(s["energy"]["environment_energy"])
    taps.pulse["taken"] = 1.0 - created
    assert s["energy"]["first_unstrict"] < 0
    taps.tick(towards(0.0))
    assert s["energy"]["first_unstrict"] >= 0


def test_a_hand_would_get_more_from_pulses_that_nothing_pays_for() -> None:
    taps = tapping(pulse_frequency=0.0, pulse_decay=0.1)
    for _ in range(400):
        taps.kernel.state["impact"]["account"] = 1e3
        taps.tick(flight(0.5))
        if taps.most > 1e-3:
            return
    pytest.fail(f"it got {taps.most:g} J")


def test_motion_that_no_sample_shows_is_charged_at_its_most() -> None:
    taps = tapping()
    struck(taps, 0.3, 3)
    before, pulse = float(taps.pulse["account"]), abs(float(taps.rows[-1]["pulse"][0]))
    most = T * pulse**2 / (4 * SPARE)
    taps.tick(towards(0.0), is_stale=True)
    kept = math.exp(-T / 0.0167)
    assert taps.pulse["account"] == pytest.approx(kept * (before - most), rel=1e-9)


def test_a_late_tick_that_costs_more_than_was_kept_is_owed_by_the_springs() -> None:
    taps = tapping(pulse_frequency=0.0)
    rows = struck(taps, 0.3, 1)
    pulse = float(rows["pulse"][-1, 0])
    taps.position += 0.05 * np.sign(pulse)  # within 30 periods
    taps.sample["position"][0, 0] = taps.position
    before = float(taps.pulse["account"])
    assert whole_tick(taps.kernel.state, taps.sample, taps.kernel.row, 30 * T)
    most = min(30 * T * pulse**2 / (4 * SPARE), abs(pulse) * 0.05)
    assert most > before
    assert taps.pulse["account"] == 0.0
    assert float(taps.kernel.state["coupling"]["owed"][0, 0]) > 0.0


def test_a_changed_coupling_leaves_no_spare_damping() -> None:
    taps = tapping()
    goal = replace(taps_parameters(), coupling=Coupling(1000.0, 0.0, 1.0, 0.0))
    taps.kernel.tune(goal, METHODS["implicit"].gains(goal.coupling, T), 5)
    assert taps.pulse["spare"] == 0.0


def taps_parameters() -> RunParameters:
    return parameters_of(load(wall()))


# The onset, beside that of a wall of ten times the stiffness


@pytest.mark.parametrize("speed", [0.1, 0.2, 0.3, 0.4])
@pytest.mark.parametrize("name", ["wood", "rubber"])
def test_a_pulse_halves_the_error_of_a_tap_on_a_wall_of_1_kn_per_m(speed: float, name: str) -> None:
    coupling, gap = Coupling(1000.0, 0.0, 1.0, 0.0), 0.06
    target = stiff_onset(coupling, speed, gap)
    frequency, decay = PULSES[name]
    plain = tapping((0,), coupling, gap, impact_pulses=0.0, pulse_damping=0.0)
    crisp = tapping((0,), coupling, gap, pulse_frequency=frequency, pulse_decay=decay)
    without = spectral_error(onset(plain, speed, gap), target)
    assert without > 0.85
    assert spectral_error(onset(crisp, speed, gap), target) < 0.5 * without


# Options


@pytest.mark.parametrize(("is_real", "ticks"), [(True, 1), (False, 0)])
def test_a_pulse_may_act_a_tick_later_on_a_real_device(is_real: bool, ticks: int) -> None:
    device = ScriptedDevice(lambda _: (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0), is_real=is_real)
    setup = Bridge("virtual_wall", device, impact_pulses=1.0).setup
    assert setup.parameters(device.start(T), None).pulse_ticks == ticks


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"contact": "scene"}, r"impact-pulses is 0\.5, but contacts are the scene's own"),
        ({"scene_rate": 100.0}, "the scene steps in some ticks alone; pulses need all"),
        ({"rate": 500.0, "pulse": "300,5"}, "at most 250 Hz, half the rate"),
    ],
)
def test_runs_that_have_no_pulses_refuse_them_before_they_begin(
    options: dict[str, Any], message: str
) -> None:
    with pytest.raises(HapticBridgeError, match=message):
        Bridge("virtual_wall", SimulatedDevice(), impact_pulses=0.5, **options)


def test_several_hands_have_no_pulses() -> None:
    hands = [Grasp("wrench"), Grasp("bolt")]
    with pytest.raises(HapticBridgeError, match=r"impact-pulses is 0\.5, but several hands"):
        Bridge("nut_and_wrench", hands, impact_pulses=0.5)


# A recorded run


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    folder = tmp_path_factory.mktemp("pulse")
    return read_recording(tapped_wall(folder, controller=None, impact_pulses=0.5))


def test_a_recorded_run_is_strict_certified_and_audited_to_the_bit(run: Recording) -> None:
    report = audit(run.path)
    assert (report.verdict, report.environment) == ("passive", "strict")
    assert report.certified
    assert report.resimulation == "bit for bit"
    assert np.count_nonzero(run.ticks["blow_energy"]) >= 2
    assert np.abs(run.ticks["pulse"]).max() > 0.3


@pytest.mark.parametrize("case", ["late device", "changed coupling", "missing samples"])
def test_pulses_of_other_devices_are_audited_to_the_bit(tmp_path: Path, case: str) -> None:
    scene, path = tmp_path / "wall.xml", tmp_path / "run.mcap"
    scene.write_text(wall())

    def pose(tick: int) -> tuple[float, ...]:
        return (0.0125 * (1 - math.cos(0.03 * tick)), 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)

    sheet: dict[str, Any] = {"damping": DAMPING}
    if case == "late device":
        sheet["delay"] = 2 * T
    if case == "missing samples":
        sheet["is_stale"] = lambda tick: tick % 7 == 3
    device = ScriptedDevice(pose, **sheet)

    def note(bridge: Bridge, tick: int) -> None:
        if case == "changed coupling" and tick == 150:
            bridge.command(Couple(450.0, 0.2))

    recorded(
        path,
        scene,
        device,
        Coupling(500.0, 0.2, 1.0, 5e-4),
        duration=0.7,
        on_tick=note,
        impact_pulses=1.0,
        pulse="60,10",
        limits=Limits(force=8.0, torque=0.5),
    )
    ticks, report = read_recording(path).ticks, audit(path)
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit"), report.reason
    assert np.count_nonzero(ticks["pulse"][:, 0]) > 5


def test_forged_pulses_are_found_by_the_account_alone(run: Recording, tmp_path: Path) -> None:
    versions = {"versions": json.dumps({"mujoco": "3.0"})}  # nothing is simulated again
    for field, changed, factor in (
        ("pulse_account", ("pulse_account",), 1.01),
        ("pulse_account", ("blow_energy",), 0.5),
        ("wrench_on_device", ("pulse",), 0.5),
        ("pulse", ("pulse", "wrench_on_device"), 3.0),
    ):
        rows = run.ticks.copy()
        more = (factor - 1.0) * rows["pulse"]
        for name in changed:
            if name == "wrench_on_device":
                rows[name][:, :3] += more
            else:
                rows[name] *= factor
        report = verdict_of(run, tmp_path, ticks=rows, meta=versions)
        assert (report.verdict, report.port) == ("invalid", field)
