"""Every scene in twenty random hands of 3 cm and 45 degrees for 5 s: finite, passive, in bounds."""

from __future__ import annotations

import numpy as np
import pytest
from random_hands import T, random_motion, shaken

import hapticbridge as hb
from hapticbridge.device import Motion, SimulatedDevice
from hapticbridge.lab.closed_loop import ClosedLoop, LoopOutcome
from hapticbridge.record import TickFlag
from hapticbridge.scene import Parameter, scene_parameters, scene_path

FORCE_LIMIT, TORQUE_LIMIT = 10.0, 0.5  # N and N m, of the default simulated device

HANDS: list[tuple[str, dict[str, float], float, int]] = [
    ("point_mass", {}, 0.0, 0),
    ("virtual_wall", {}, 0.0, 2000),
    ("planar_peg", {}, 0.0, 2000),
    ("planar_peg", {}, -0.045, 30000),
    ("planar_peg", {"length": 0.04}, -0.025, 30000),
    ("planar_peg", {"length": 0.2}, -0.185, 30000),
    ("peg_in_hole", {}, 0.0, 2000),
    ("peg_in_hole", {}, -0.045, 30000),
    ("round_peg", {}, 0.0, 2000),
    ("round_peg", {}, -0.045, 30000),
    ("drawer", {}, 0.0, 500),  # its friction holds it most times
    ("hammer", {}, 0.0, 1000),
    ("open_wrench", {}, 0.0, 30000),
    ("ratchet", {}, 0.0, 30000),
    ("pliers", {}, 0.0, 2000),
    ("lock", {}, 0.0, 2000),
    ("screwdriver", {}, -0.002, 30000),
    ("hex_key", {}, -0.002, 30000),
]
"""Scene, parameters, by how much the hand goes up in m before it is random (into the hole, or to
press a tool that starts seated), and how many ticks of the twenty runs there is a contact at least:
otherwise nothing was tried."""

IN_USE = {"lock", "pliers"}
"""Scenes whose parameters are tried in random hands that use the tool: test_pliers_and_lock."""

PARAMETERS = [
    (name, parameter)
    for name in sorted({hand[0] for hand in HANDS} - IN_USE)
    for parameter in scene_parameters(scene_path(name))
]


def run_of(loop: ClosedLoop, seed: int, first: float) -> LoopOutcome:
    """Shakes a scene and checks what holds for every scene in every hand."""
    outcome = shaken(loop, random_motion(seed, first=first))
    assert outcome.ticks == 5000
    assert outcome.environment in {"strict", "within slack"}, f"seed {seed}: {outcome}"
    assert outcome.fault is None, f"seed {seed}: {outcome}"
    assert outcome.peak_force < FORCE_LIMIT
    for field, limit in (("wrench_on_tool", 1e3), ("tool_position", 1.0)):
        assert np.abs(outcome.records[field]).max() < limit
    assert not any(warning.number for warning in loop.scene.data.warning)
    return outcome


def norms(wrenches: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the norms of the forces and of the torques."""
    return np.linalg.norm(wrenches[:, :3], axis=1), np.linalg.norm(wrenches[:, 3:], axis=1)


@pytest.mark.parametrize(("name", "values", "first", "least"), HANDS, ids=str)
def test_twenty_random_hands_leave_it_finite_and_passive_and_the_device_within_its_limits(
    name: str, values: dict[str, float], first: float, least: int
) -> None:
    loop = ClosedLoop(hb.load_scene(name, "grip", **values))
    contacts, strongest, worst = 0, -1.0, 0
    for seed in range(20):
        records = run_of(loop, seed, first).records
        contacts += int(np.count_nonzero(records["flags"] & TickFlag.CONTACT))
        twist = float(norms(records["wrench_on_tool"])[1].max())
        if twist > strongest:
            strongest, worst = twist, seed
    assert contacts >= least
    # a hand that turns by 45 degrees twists some grips by more than the device can: it saturates
    sent, flags = within_limits(name, values, random_motion(worst, first=first))
    is_saturated = bool((flags & TickFlag.FORCE_LIMITED).any())
    assert is_saturated == (strongest > 1.02 * TORQUE_LIMIT), strongest
    if is_saturated:
        assert norms(sent)[1].max() == pytest.approx(TORQUE_LIMIT, rel=1e-9)


def within_limits(
    name: str, values: dict[str, float], motion: Motion
) -> tuple[np.ndarray, np.ndarray]:
    """Runs the bridge as its user does; returns what it sent, shape (n, 6), and its flags."""
    device = SimulatedDevice(path=motion)
    with hb.Bridge(
        hb.load_scene(name, "grip", **values), device, clock=hb.SimulatedClock()
    ) as bridge:
        summary = bridge.run(duration=motion.duration)
        rows = bridge.latest_records(round(motion.duration / T))
    assert summary.verdict == "passive"
    sent, flags = rows["wrench_on_device"], rows["flags"]
    force, torque = norms(sent)
    assert force.max() <= FORCE_LIMIT * (1 + 1e-12)
    assert torque.max() <= TORQUE_LIMIT * (1 + 1e-12)
    # the flag is up where, and only where, the coupling asked for more
    asked = norms(rows["wrench_on_tool"])
    is_beyond = (asked[0] > FORCE_LIMIT) | (asked[1] > TORQUE_LIMIT)
    assert np.array_equal((flags & TickFlag.FORCE_LIMITED) != 0, is_beyond)
    # and where it did not, after the ramp, the device got what the coupling said
    is_whole = ~is_beyond & ((flags & TickFlag.RAMPING) == 0)
    assert np.array_equal(sent[is_whole], -rows["wrench_on_tool"][is_whole])
    return sent, flags


@pytest.mark.parametrize(
    ("name", "parameter"), PARAMETERS, ids=[f"{name} {p.name}" for name, p in PARAMETERS]
)
def test_both_ends_of_a_parameter_are_passive_in_random_hands(
    name: str, parameter: Parameter
) -> None:
    for value in (parameter.minimum, parameter.maximum):
        loop = ClosedLoop(hb.load_scene(name, "grip", **{parameter.name: value}))
        for seed in range(2):
            run_of(loop, seed, 0.0)
