"""A tool shown between the steps of a slower scene: no hand gets energy, and it is where it is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from adversary import UNPAID, Attack
from kernel_runs import T, unlimited
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.demand.methods import method_named, prepare
from hapticbridge.device import AXES, DEFAULT_HAND, DeviceInfo
from hapticbridge.errors import HapticBridgeError
from hapticbridge.kernel.codes import OK
from hapticbridge.kernel.record import SAMPLE_DTYPE, TICK_DTYPE, TickFlag
from hapticbridge.kernel.state import BoundKernel
from hapticbridge.kernel.tick import after_step, before_step, take_result, whole_tick
from hapticbridge.run.options import steady_rotational_stiffness
from hapticbridge.scene import load_scene

LAW = Coupling(800.0, 0.5, 0.8, 5e-4)

CREDIT = 10.0**2 / (2.0 * LAW.stiffness), 0.5**2 / (2.0 * LAW.rotational_stiffness)
"""Energies in J of the springs at the levels of ``Loop``, 10 N and 0.5 N m."""


def attack(seed: int, ticks: int, *, pays: bool = True) -> float:
    """Returns the most energy in J that a hand got out of a scene of so many ticks a step."""
    drawn = Attack.at_random(seed, scene_ticks=ticks, pays=pays)
    energy, _, code = drawn.run()
    assert code == OK
    return energy


@pytest.mark.parametrize("ticks", [2, 5, 10, 20])
def test_no_hand_gets_energy_out_of_a_slower_scene(ticks: int) -> None:
    for seed in range(40):
        assert attack(seed, ticks) <= UNPAID, (seed, ticks)


def test_results_that_nobody_pays_for_are_seen_to_give_energy() -> None:
    assert any(attack(seed, 20, pays=False) > 0.1 for seed in range(60))


def rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values**2)))


class Loop:
    """The ticks of a loop in front of a slower scene, or of one that steps in every tick (0)."""

    def __init__(
        self, scene: str | Path, ticks: int, law: Coupling = LAW, substeps: int = 1, **values: Any
    ) -> None:
        self.ticks, self.scene = ticks, load_scene(scene, **values)
        method = method_named("lossless" if substeps == 1 else "implicit").with_contact(None)
        prepare(self.scene, law, max(ticks, 1) * T, substeps, method, warns=False)
        self.scene.set_gains(*method.gains(law, max(ticks, 1) * T / substeps))
        self.scene.reset()
        self.parameters = parameters = unlimited(
            self.scene,
            law,
            T,
            substeps,
            scheme=method.scheme,
            scene_ticks=ticks,
            force_limit=10.0,
            torque_limit=0.5,
        )
        model, data = self.scene.model, self.scene.data
        self.fast = self.slow = BoundKernel(model, data, parameters)
        if ticks:
            self.slow = BoundKernel(model, data, parameters.of_scene, self.fast)
        self.given, self.count = np.zeros(1, SAMPLE_DTYPE), 0

    def tick(self, sample: NDArray[np.void]) -> NDArray[np.void]:
        """Runs a tick with a device sample; returns its record, as a view."""
        state, row = self.fast.state, self.fast.row
        if not self.ticks:
            assert whole_tick(state, sample, row, T)
            return row
        assert before_step(state, sample, row, 0, T) == OK
        if self.count % self.ticks == 0:
            if self.count:
                period = self.ticks * T
                assert whole_tick(self.slow.state, self.given, self.slow.row, period)
            take_result(state, self.slow.state, self.given)
        assert after_step(state, row, 0) == OK
        self.count += 1
        return row

    def run(self, motion: NDArray[np.float64]) -> NDArray[np.void]:
        """Returns the records of a motion of the handle from the start, (n, 3) in m."""
        rows, sample = np.zeros(len(motion), TICK_DTYPE), np.zeros(1, SAMPLE_DTYPE)
        sample["quaternion"][0, 0] = 1.0
        for k, position in enumerate(motion):
            sample["position"] = position
            rows[k] = self.tick(sample)[0]
        return rows


def stroke(length: float, rate: float, count: int = 2000) -> NDArray[np.float64]:
    """A stroke to and fro along x, at rest at its ends."""
    motion = np.zeros((count, 3))
    motion[:, 0] = 0.5 * length * (1.0 - np.cos(2.0 * np.pi * rate * T * np.arange(count)))
    return motion


@pytest.mark.parametrize(("ticks", "share"), [(2, 0.06), (5, 0.2), (10, 0.7)])
def test_a_free_tool_is_shown_where_the_fast_scene_has_it(ticks: int, share: float) -> None:
    motion = stroke(0.05, 1.0)
    exact, shown = (Loop("point_mass", n).run(motion) for n in (0, ticks))
    off = shown["wrench_on_tool"][:, 0] - exact["wrench_on_tool"][:, 0]
    assert rms(off) < share * rms(exact["wrench_on_tool"][:, 0])
    way = np.abs(shown["tool_position"] - exact["tool_position"]).max()
    assert way < 2e-5 * ticks


def test_a_pose_held_until_the_next_result_is_farther_off() -> None:
    motion, errors = stroke(0.05, 1.0), []
    exact = Loop("point_mass", 0).run(motion)["wrench_on_tool"][:, 0]
    for is_foreseen in (True, False):
        loop = Loop("point_mass", 10)
        if not is_foreseen:
            loop.fast.state["shown"]["scene_period"] = 1e9  # the velocities are then zero
        errors.append(rms(loop.run(motion)["wrench_on_tool"][:, 0] - exact))
    assert errors[0] < 0.2 * errors[1]


def test_a_tap_on_a_wall_is_felt_at_once() -> None:
    motion = stroke(0.03, 2.0, 500)
    exact = Loop("virtual_wall", 0).run(motion)["wrench_on_tool"][:, 0]
    errors = []
    for has_planes in (True, False):
        loop = Loop("virtual_wall", 10)
        if not has_planes:  # no geom is the tool's
            nothing = np.zeros(loop.scene.model.ngeom, np.int32)
            loop.fast.state["mj"]["geom_is_tool"] = nothing.ctypes.data
            loop.slow.state["mj"]["geom_is_tool"] = nothing.ctypes.data
        force = loop.run(motion)["wrench_on_tool"][:, 0]
        errors.append(rms(force - exact))
    assert np.abs(exact).max() > 2.0
    assert errors[0] < 0.5 * errors[1]


def tap(speed: float, to: float) -> NDArray[np.float64]:
    """A motion from 10 cm before the start to beyond it, along x in m, at a speed in m/s."""
    back = -0.1 * np.minimum(np.arange(600) / 400.0, 1.0)
    forth = np.minimum(-0.1 + speed * T * np.arange(900), to)
    motion = np.zeros((1500, 3))
    motion[:, 0] = np.concatenate([back, forth])
    return motion


@pytest.mark.parametrize("speed", [0.2, 1.0])
@pytest.mark.parametrize(("ticks", "substeps"), [(10, 1), (10, 4), (20, 1), (50, 1)])
def test_a_wall_stops_a_fast_tool_between_the_steps_of_a_slow_scene(
    speed: float, ticks: int, substeps: int
) -> None:
    """The wall of ``virtual_wall`` is 1 cm away; the tool has 50 g."""
    law = Coupling(0.8 * 0.05 / (ticks * T) ** 2, 0.5, 0.8, 5e-4)
    rows = Loop("virtual_wall", ticks, law, substeps).run(tap(speed, 0.015))
    assert rows["tool_position"][:, 0].max() < 0.01005
    assert rows["wrench_on_tool"][-1, 0] == pytest.approx(0.005 * law.stiffness, rel=0.01)


def test_the_nearest_of_many_surfaces_stop_the_tool(tmp_path: Path) -> None:
    """The wall, the last geom, is behind 18 of which each is seen, but passed by."""
    beside = "".join(
        f'<geom size="0.002" pos="0 {y:.3f} {z:.3f}"/>'
        for y in (-0.02, 0.02)
        for z in np.linspace(-0.016, 0.016, 9)
    )
    scene = tmp_path / "passage.xml"
    scene.write_text(
        '<mujoco><option gravity="0 0 0"/><worldbody><body name="tool"><freejoint/>'
        '<geom size="0.01" mass="0.05"/><site name="grip"/></body>'
        f'{beside}<geom type="box" size="0.01 0.1 0.1" pos="0.03 0 0"/></worldbody></mujoco>'
    )
    law = Coupling(100.0, 0.5, 0.8, 5e-4)
    rows = Loop(scene, 20, law).run(tap(0.2, 0.015))
    assert rows["tool_position"][:, 0].max() < 0.01005


def shake(ticks: int, rotational_stiffness: float) -> float:
    """Range in N m of the torque on a turned hand, long after it was let go at 0.05 rad.

    It is the usual hand on the usual device, 1.1e-3 kg m², on an axis of its own.
    """
    law = Coupling(50.0, 0.5, rotational_stiffness, 5e-4)
    loop, sample = Loop("point_mass", ticks, law), np.zeros(1, SAMPLE_DTYPE)
    hand, angle, speed, torques = DEFAULT_HAND, 0.05, 0.0, [0.0]
    inertia, damping = hand.rotational_inertia + 1e-4, hand.rotational_damping + 2e-3
    for _ in range(1500):
        resistance = inertia + T * damping + T * T * hand.rotational_stiffness
        push = torques[-1] - hand.rotational_stiffness * angle
        speed = (inertia * speed + T * push) / resistance
        angle += T * speed
        sample["quaternion"] = np.cos(0.5 * angle), 0.0, 0.0, np.sin(0.5 * angle)
        torques.append(-float(loop.tick(sample)["wrench_on_tool"][0, 5]))
    return float(np.ptp(torques[-200:]))


@pytest.mark.parametrize("ticks", [10, 20])
def test_a_turned_tool_is_steady_up_to_twice_the_usual_stiffness(ticks: int) -> None:
    info = DeviceInfo(
        name="usual", axes=AXES, force_limit=10.0, torque_limit=0.5, rotational_inertia=1e-4
    )
    most = steady_rotational_stiffness(info, ticks * T, 1.0, 1.0)
    assert most == pytest.approx(0.4 * 1.1e-3 / (ticks * T) ** 2)
    assert shake(ticks, 2.0 * most) < 2e-4
    assert shake(ticks, 4.0 * most) > 5e-4


def energy_given(rows: NDArray[np.void]) -> NDArray[np.float64]:
    """P of each tick by the definition, for forces below their level, without a damper."""
    handle, tool = rows["handle_position"], rows["tool_position"]
    before = np.concatenate([[tool[0]], tool[:-1]])
    stored = [0.5 * LAW.stiffness * np.sum((handle - x) ** 2, axis=1) for x in (before, tool)]
    step = tool - before
    elastic = LAW.stiffness * (handle - tool)
    damped = np.sum((rows["wrench_on_tool"][:, :3] - elastic) * step, axis=1)
    return np.asarray(stored[0] - stored[1] + damped)


def test_the_tool_moves_only_as_far_as_the_hand_has_paid() -> None:
    loop = Loop("point_mass", 20)
    rng = np.random.default_rng(3)
    speed, shaken = np.zeros(3), np.zeros((3000, 3))
    for k in range(1, len(shaken)):  # wanders
        speed = 0.98 * speed + 0.01 * rng.standard_normal(3)
        shaken[k] = shaken[k - 1] + T * speed
    rows = loop.run(shaken)
    tank, work = rows["scene_tank"], energy_given(rows)[1:]
    assert not (rows["flags"] & int(TickFlag.FORCE_LIMITED)).any()
    assert loop.fast.state["shown"]["held_back"][0] > 10
    assert tank.min() < 0.0 < tank.max()  # loans, and energy on the way
    is_new = np.diff(rows["scene_step"]) > 0
    assert is_new.sum() == 149
    cap = 2.0 * sum(CREDIT) + loop.fast.state["shown"]["passing"][0]
    moved = np.minimum(tank[:-1] + work, cap)
    assert tank[1:][~is_new] == pytest.approx(moved[~is_new], abs=1e-9)
    assert (tank[1:] >= np.minimum(tank[1:] - work, 0.0) - 1e-9).all()
    assert loop.fast.state["energy"]["first_unstrict"][0] == -1
    assert loop.slow.state["energy"]["first_unstrict"][0] == -1


def given_handle(loop: Loop) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns position and quaternion of the handle that the scene is given now."""
    loop.fast.state["shown"]["waits"] = 0
    take_result(loop.fast.state, loop.slow.state, loop.given)
    return loop.given["position"][0].copy(), loop.given["quaternion"][0].copy()


def test_the_handle_is_drawn_near_while_a_loan_is_out() -> None:
    loop = Loop("point_mass", 10)
    loop.run(stroke(0.05, 2.0, 60))
    fast = loop.fast.state
    stretch = fast["pose"]["handle_position"][0] - fast["shown"]["newest"][0, :3]
    energy = 0.5 * LAW.stiffness * float(stretch @ stretch)
    for lent, share in ((-energy, 1.0), (-0.25 * energy, 0.5), (0.0, 0.0), (1.0, 0.0)):
        fast["shown"]["tank"] = -sum(CREDIT) - lent
        position, _ = given_handle(loop)
        newest = fast["shown"]["newest"][0, :3]
        assert position - newest == pytest.approx(share * stretch, abs=1e-9), lent


def test_the_scene_is_given_the_whole_handle_up_to_both_levels() -> None:
    """The springs may hold what they hold at their levels, 62.5 mJ and 156 mJ."""
    loop = Loop("point_mass", 10)
    loop.run(np.zeros((20, 3)))
    pose = loop.fast.state["pose"]
    angle = 0.99 * 0.5 / LAW.rotational_stiffness
    turned = [np.cos(0.5 * angle), 0.0, np.sin(0.5 * angle), 0.0]
    pose["handle_position"][0] = loop.fast.state["shown"]["newest"][0, :3]
    pose["handle_position"][0, 0] += 0.99 * 10.0 / LAW.stiffness
    pose["handle_quaternion"][0] = turned
    position, quaternion = given_handle(loop)
    assert position == pytest.approx(pose["handle_position"][0], abs=1e-12)
    assert quaternion == pytest.approx(turned, abs=1e-12)


def test_the_credit_follows_a_change_of_the_coupling() -> None:
    """A softer spring holds more at the level; the scene gets the force that the hand feels."""
    loop = Loop("point_mass", 10)
    loop.run(np.zeros((20, 3)))
    soft = replace(LAW, stiffness=0.25 * LAW.stiffness)
    method = method_named("lossless")
    goal = replace(loop.parameters, coupling=soft)
    loop.fast.tune(goal, method.gains(soft, 10 * T), 1)
    loop.run(np.zeros((20, 3)))
    pose = loop.fast.state["pose"]
    pose["handle_position"][0] = loop.fast.state["shown"]["newest"][0, :3]
    pose["handle_position"][0, 0] += 0.99 * 10.0 / soft.stiffness
    position, _ = given_handle(loop)
    assert position == pytest.approx(pose["handle_position"][0], abs=1e-12)


def test_the_verdict_forgives_what_the_scene_was_lent_and_no_more() -> None:
    """Energy that the cap discarded was given by the hand, so as much was not lent."""
    loop = Loop("point_mass", 20)
    rows = loop.run(stroke(0.12, 6.0, 1500))
    energy, shown = loop.fast.state["energy"], loop.fast.state["shown"]
    given, taken = energy["coupling_work"][0], loop.slow.state["energy"]["coupling_work"][0]
    assert shown["scene_work"][0] == taken
    stored = rows["kinetic"] + rows["potential"] - energy["start_energy"][0]
    created = stored - rows["coupling_work"] - rows["actuator_work"] - rows["external_work"]
    discarded = given - taken - shown["tank"][0]
    assert discarded > 1e-3  # the cap was reached
    forgiven = created - rows["environment_energy"]
    lent = np.maximum(-rows["scene_tank"], 0.0)
    assert lent.max() > 0.0
    # each forgiven joule was taken by the scene and not given by the hand
    k = int(np.argmax(lent))
    assert (forgiven <= lent + 1e-12).all()
    loop_work = rows["coupling_work"]
    is_new = np.diff(rows["scene_step"], prepend=0) > 0
    lost = np.where(is_new, 0.0, np.diff(loop_work - rows["scene_tank"], prepend=0.0))
    exact = np.maximum(-(rows["scene_tank"] + np.cumsum(lost)), 0.0)
    assert forgiven == pytest.approx(exact, abs=1e-9), k


def test_a_slower_scene_needs_a_method_that_solves_its_coupling() -> None:
    parameters = Loop("point_mass", 10).parameters
    assert parameters.scene_period == pytest.approx(10 * T)
    assert parameters.of_scene.period == parameters.scene_period
    assert parameters.of_scene.scene_ticks == 0
    refused: tuple[tuple[dict[str, Any], str], ...] = (
        ({"scheme": 2}, "needs one of the schemes 'IMPLICIT', 'MIDPOINT'"),
        ({"scene_ticks": 1}, "once in 1 ticks; it must be 2 to 1000"),
        ({"scene_ticks": 1001}, "it must be 2 to 1000"),
    )
    for changes, words in refused:
        with pytest.raises(HapticBridgeError, match=words):
            replace(parameters, **changes)
