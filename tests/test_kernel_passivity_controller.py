"""The energy account of both ports and the controller that keeps it balanced."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from audit_cases import ScriptedDevice, recorded
from bridge_runs import fast
from faults.catalogue import HEAVY, NO_TRIPS, UNWATCHED, stiff
from faults.rig import CAUSE, Outcome, Rig
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from test_bridge_commands import FLOOR

from hapticbridge.audit import audit
from hapticbridge.audit.replay import Resimulator
from hapticbridge.coupling import Coupling
from hapticbridge.demand.guard import DEVICE_LIMITS, guard_parameters_for, limits_for
from hapticbridge.device import SimulatedDevice
from hapticbridge.kernel.parameters import DAMPER, ENVIRONMENT
from hapticbridge.kernel.passivity_controller import observe_energy
from hapticbridge.kernel.record import CLOCK_FIELDS, TICK_DTYPE, TickFlag
from hapticbridge.kernel.state import STATE_DTYPE
from hapticbridge.recording import open_recording, read_recording
from hapticbridge.run.bridge import Bridge
from hapticbridge.run.description import parameters_of
from hapticbridge.theory.sampled_loop import WorstHand

T = 1e-3
WORST = WorstHand(2.0, np.pi / T, T)
ACTIVE = int(TickFlag.CONTROLLER_ACTIVE)


def knocked(folder: Path, factor: float, hand: WorstHand | None, controller: str) -> Outcome:
    rig = Rig(folder)
    stiff(factor, hand, controller)(rig)
    rig.guard |= NO_TRIPS | UNWATCHED
    return rig.run(CAUSE)


def check_again(outcome: Outcome, folder: Path) -> None:
    """The two other routes agree: all that the audit minds is that the trips were taken out."""
    assert outcome.report.reason.startswith("guard parameter 'speed' is 'inf'")
    recording = open_recording(folder / "run.mcap")
    again = Resimulator(recording, parameters_of(recording.meta))
    for ticks in recording.blocks():
        simulated = again.add(ticks)
        for name in {*(TICK_DTYPE.names or ())} - {*CLOCK_FIELDS, "flags"}:
            np.testing.assert_array_equal(simulated[name], ticks[name], err_msg=name)


def largest(outcome: Outcome, after: int) -> float:
    return float(outcome.forces[CAUSE + after : CAUSE + after + 40].max())


@pytest.mark.parametrize("hand", [None, WORST], ids=["free", "worst hand"])
def test_a_wall_of_one_and_a_half_times_the_limit_swings_without_and_decays_with(
    tmp_path: Path, hand: WorstHand | None
) -> None:
    without = knocked(tmp_path, 1.5, hand, "off")
    assert largest(without, 950) > 0.7 * largest(without, 50) > 1.0
    with_it = knocked(tmp_path, 1.5, hand, "damper")
    assert largest(with_it, 950) < 0.05 * largest(without, 950)
    assert not (without.flags & ACTIVE).any()
    check_again(with_it, tmp_path)
    ticks = read_recording(tmp_path / "run.mcap").ticks
    assert 0.5 < ticks["injected_damping"].max() <= 2.0  # min(b, m/T)


def twisted(folder: Path, controller: str) -> Outcome:
    """As ``knocked``, about an axis: K_r is 1.5 times 2 b_r/T, knocked with 0.1 N m for 5 ms."""
    rig = Rig(folder)
    stiff(0.1, None, controller)(rig)
    inertia = '<inertial pos="0 0 0" mass="1000" diaginertia="1000 1000 1000"/>'
    rig.scene = folder / "heavy.xml"
    rig.scene.write_text(HEAVY.replace("<freejoint/>", f"<freejoint/>{inertia}"))
    rig.coupling = Coupling(400.0, 0.0, 1.5 * 2 * 2e-3 / T, 0.0)
    rig.guard |= NO_TRIPS | UNWATCHED

    def refuse(tick: int, wrench: NDArray[np.float64]) -> None:
        if CAUSE <= tick < CAUSE + 5:
            wrench[4] += 0.1

    rig.device.refuse = refuse
    return rig.run(CAUSE)


def test_about_an_axis_too_a_wall_beyond_the_limit_swings_without_and_decays_with(
    tmp_path: Path,
) -> None:
    late = slice(CAUSE + 900, CAUSE + 990)
    without = twisted(tmp_path, "off").torques
    assert without[late].max() > 0.7 * without[CAUSE + 50 : CAUSE + 90].max() > 0.02
    with_it = twisted(tmp_path, "damper")
    assert with_it.torques[late].max() < 0.1 * without[late].max()
    assert (with_it.flags & ACTIVE).any()
    check_again(with_it, tmp_path)
    ticks = read_recording(tmp_path / "run.mcap").ticks
    assert not ticks["injected_damping"].any()
    assert 0.0 < ticks["injected_rotational_damping"].max() <= 2e-3  # the device's own, N m s/rad


def test_at_ten_times_the_limit_a_free_device_is_calmed(tmp_path: Path) -> None:
    outcome = knocked(tmp_path, 10.0, None, "damper")
    assert largest(outcome, 950) < 0.1
    assert outcome.energy < 0.02
    check_again(outcome, tmp_path)


@pytest.mark.parametrize("scene", ["peg_in_hole", "hammer"])
def test_on_a_certified_device_the_controller_is_idle(tmp_path: Path, scene: str) -> None:
    rows = []
    for controller in ("damper", None, "off"):
        path = tmp_path / f"{controller}.mcap"
        summary = recorded(path, scene, duration=2.0, controller=controller)
        assert summary.is_certified
        rows.append(read_recording(path).ticks)
    for name in set(TICK_DTYPE.names or ()) - set(CLOCK_FIELDS):
        np.testing.assert_array_equal(rows[0][name], rows[2][name], err_msg=name)
        np.testing.assert_array_equal(rows[1][name], rows[2][name], err_msg=name)


def shaken(folder: Path, controller: str | None) -> Outcome:
    """A light tool in a method that creates energy, on a device that bears the coupling."""
    rig = Rig(folder, duration=3.0)
    rig.scene = folder / "light.xml"
    rig.scene.write_text(HEAVY.replace("1000", "0.05"))
    times = np.arange(0.0, 9.0, 0.01)
    along = 0.02 * np.sin(6 * np.pi * times) * np.minimum(times, 1.0)
    rig.points = tuple(zip(times.tolist(), along.tolist(), strict=True))
    rig.coupling = Coupling(2000.0, 0.5, 1.0, 5e-4)
    rig.options = {"method": "implicitfast", "i_know": True, "controller": controller}
    return rig.run(CAUSE)


def test_what_the_environment_creates_beyond_the_slack_is_kept_from_a_certified_device(
    tmp_path: Path,
) -> None:
    without = shaken(tmp_path, "off")
    margin = without.report.damping_margin
    assert margin is not None
    assert margin > 0.0  # the device bears the coupling
    assert without.report.certified is False  # but not the energy that the scene created
    assert without.report.environment == "active"
    assert without.energy > 1e-3
    with_it = shaken(tmp_path, None)
    assert with_it.energy < 0.3 * without.energy
    rows = read_recording(tmp_path / "run.mcap").ticks
    acts = rows["injected_damping"] > 0
    assert acts.any()
    assert ((rows["flags"] & ACTIVE) != 0).tolist() == acts.tolist()
    excess = rows["environment_energy"] - slack_of(rows, 2000.0 + 0.5 / T, 1.0 + 5e-4 / T)
    assert (excess[:-1][acts[1:]] > 0).all()  # and nowhere else
    # two other routes: the audit's arrays, and the kernel again
    assert with_it.report.verdict == "active", with_it.report.reason
    assert with_it.report.port == "environment"
    assert with_it.report.resimulation == "bit for bit"


def rubbed_then_shaken(tick: int) -> tuple[float, ...]:
    """Pressed on the floor by 4 mm and rubbed there for 1 s, then shaken in the air."""
    t = T * tick
    height = -0.014 * min(t / 0.2, 1.0) + 0.03 * min(max(t - 1.0, 0.0) / 0.2, 1.0)
    along = 0.02 * math.sin(6 * math.pi * t) * min(max(t - 0.2, 0.0), 1.0)
    return (along, 0, height, 1, 0, 0, 0)


def test_what_an_environment_burnt_does_not_pay_for_all_that_it_creates_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hapticbridge.demand.guard.ENERGY_CREDIT", 1e-4)
    scene, path = tmp_path / "floor.xml", tmp_path / "run.mcap"
    scene.write_text(FLOOR)
    device, coupling = ScriptedDevice(rubbed_then_shaken), Coupling(2000.0, 0.5, 1.0, 5e-4)
    recorded(path, scene, device, coupling, method="implicitfast", controller=None, duration=2.5)
    rows, report = read_recording(path).ticks, audit(path)
    excess = rows["environment_energy"] - slack_of(rows, 2000.0 + 0.5 / T, 1.0 + 5e-4 / T)
    acts = rows["injected_damping"] > 0
    assert (excess[:-1][acts[1:]] < -0.01).any()  # since the start more was burnt than created
    # the audit's arrays and the kernel again say the same
    assert report.verdict != "invalid", report.reason
    assert report.resimulation == "bit for bit"


def slack_of(rows: NDArray[np.void], linear: float, angular: float) -> NDArray[np.float64]:
    """Returns Σ ½‖δx‖²_{K+B/T} + ½‖δφ‖²; the tool starts at the first row's pose."""
    moved = np.diff(rows["tool_position"], axis=0, prepend=rows["tool_position"][:1])
    turned = Rotation.from_quat(rows["tool_quaternion"], scalar_first=True)
    turns = (turned[1:] * turned[:-1].inv()).as_rotvec()
    squares = 0.5 * linear * np.sum(moved**2, axis=1)
    squares[1:] += 0.5 * angular * np.sum(turns**2, axis=1)
    return np.cumsum(squares)


def test_a_device_with_too_little_damping_is_credited_with_half_of_it() -> None:
    info = SimulatedDevice().info
    limits = limits_for(info, DEVICE_LIMITS)
    enough = guard_parameters_for(info, limits, T, needed=(2.0, 2e-3))
    assert (enough.assumed_damping, enough.assumed_rotational_damping) == (2.0, 2e-3)
    short = guard_parameters_for(info, limits, T, needed=(2.1, 1e-3))
    assert (short.assumed_damping, short.assumed_rotational_damping) == (1.0, 2e-3)
    assert (enough.controller, short.controller) == (ENVIRONMENT, DAMPER)
    light = guard_parameters_for(SimulatedDevice(mass=1e-3).info, limits, T)
    assert light.max_damping == pytest.approx(1.0)  # m/T, below b
    assert light.max_rotational_damping == 2e-3  # b, below I/T
    slight = guard_parameters_for(SimulatedDevice(rotational_inertia=1e-6).info, limits, T)
    assert slight.max_rotational_damping == pytest.approx(1e-3)
    assert slight.max_damping == 2.0


@pytest.mark.parametrize("is_turning", [False, True])
def test_a_device_that_does_not_turn_is_not_damped_for_the_rounding_of_its_turn(
    tmp_path: Path, is_turning: bool
) -> None:
    """Most orientations times their own inverse are 1e-17 off none: a speed, divided by which."""
    angles = np.array([0.3, 0.5, -0.7])

    def tilted(tick: int) -> tuple[float, ...]:
        turn = Rotation.from_rotvec(angles * (1.0 + 1e-4 * tick * is_turning)).as_quat()
        return (0, 0, 0, turn[3], *turn[:3])

    def owing(bridge: Bridge, _: int) -> None:
        observer = bridge.session.kernel.bound.state["observer"]
        observer["observed_energy"] = observer["axis_energy"] = 1e-3

    path, device = tmp_path / "run.mcap", ScriptedDevice(tilted, damping=0.5)
    with fast("point_mass", device, recording=path, controller="damper") as bridge:
        bridge.run(0.1, lambda k: owing(bridge, k))
    injected = read_recording(path).ticks["injected_rotational_damping"][1:]
    assert (injected > 0).all() == is_turning
    assert injected.any() == is_turning


def moving_state() -> np.ndarray:
    """Returns a state in its second tick, with a credit limit of 50 mJ."""
    state = np.zeros(1, STATE_DTYPE)
    run = state["run"]
    run["period"], run["scale"], run["force_scale"], state["loop"]["tick"] = T, 1.0, 1.0, 1
    state["observer"]["energy_credit_limit"] = 0.05
    return state


@pytest.mark.parametrize("axis", range(6))
def test_an_hour_of_dissipation_pays_for_no_more_than_the_surplus(axis: int) -> None:
    state = moving_state()
    observer = state["observer"]
    state["loop"]["wrench_on_device"][0, axis] = -2.0

    def move(by: float) -> None:
        motion = np.zeros(6)
        motion[axis] = by
        x, y, z, rx, ry, rz = motion.tolist()
        observe_energy(state[0], (x, y, z), (rx, ry, rz), T)

    for _ in range(1000):
        move(1e-3)  # the hand pushes in 2 mJ each time
    expected = np.zeros(6)
    expected[axis] = -0.05
    assert observer["observed_energy"][0] == -0.05
    assert observer["axis_energy"][0].tolist() == expected.tolist()
    assert observer["net_device_energy"][0] == pytest.approx(-2.0)
    for _ in range(30):
        move(-1e-3)
    assert observer["observed_energy"][0] == pytest.approx(0.01)
    assert observer["axis_energy"][0, axis] == pytest.approx(0.01)


def test_an_hour_in_a_dissipating_scene_pays_for_no_more_than_the_surplus_either() -> None:
    state = moving_state()
    observer = state["observer"]
    nothing = (0.0, 0.0, 0.0)
    for burnt in (1.0, 2.0, 3.0):
        state["energy"]["environment_energy"] = -burnt
        observe_energy(state[0], nothing, nothing, T)
    assert observer["created_energy"][0] == -0.05
    state["energy"]["environment_energy"] += 0.06
    state["energy"]["slack"] += 0.002
    observe_energy(state[0], nothing, nothing, T)
    assert observer["created_energy"][0] == pytest.approx(0.008)
