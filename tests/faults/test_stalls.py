"""A machine that stands still with a hand on the device: what the hand is given, and when.

Nothing in this program can act meanwhile; the device holds its last force. So the claim is about
what comes after: with the guard nothing is added, without it energy that no hand had put in.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest

from faults.catalogue import passing
from faults.rig import CAUSE, PERIOD, PRESS, Rig
from hapticbridge.bridge import Bridge
from hapticbridge.errors import SafetyTrip
from hapticbridge.guard import USUAL_ENERGY, Limits

START = CAUSE * PERIOD

AWAY = ((*PRESS[:3], (START - 0.1, 0.0804), (START + 0.4, -0.0696), (9.0, -0.0696))), 0.2
"""A hand that had pressed on the wall takes itself away at 0.3 m/s; a stall of 0.2 s."""

INTO = (
    ((0.0, 0.0), (START - 0.1, 0.005), (START + 0.08, 0.023), (START + 0.31, 0.0), (9.0, 0.0)),
    0.06,
)
"""A hand goes into the wall at 0.1 m/s during a stall of 60 ms, and back again."""

Case = tuple[tuple[tuple[float, float], ...], float]


def given(folder: Path, case: Case, *, is_guarded: bool) -> tuple[float, float, bool]:
    """Returns what the hand was given in the stall, what after it, in J, and whether it tripped."""
    rig, has_tripped = Rig(folder), False
    rig.points, stall = case
    rig.device.corrupt = passing(rig, CAUSE, stall)
    limits = Limits(force=10.0, torque=0.5, ramp=0.2)
    bridge = Bridge("virtual_wall", rig.device, clock=rig.clock, limits=limits)
    if not is_guarded:
        guard = replace(bridge.setup.guard, longest_stall=math.inf, energy=math.inf)
        bridge.setup = replace(bridge.setup, guard=guard)
    with bridge:
        try:
            bridge.run(START + 0.4)
        except SafetyTrip:
            has_tripped = True
    energy = rig.device.to_the_hand
    begin, end = CAUSE + 1, CAUSE + 1 + round(stall / PERIOD)
    return energy[end] - energy[begin], max(energy[end:]) - energy[end], has_tripped


def test_a_hand_that_leaves_in_a_stall_is_given_all_of_it_before_the_loop_wakes(
    tmp_path: Path,
) -> None:
    during, after, has_tripped = given(tmp_path, AWAY, is_guarded=True)
    assert during > 3 * USUAL_ENERGY  # 4 N held over 40 mm: only the device could end it
    assert after == pytest.approx(0.0, abs=1e-6)
    assert has_tripped
    same, more, _ = given(tmp_path, AWAY, is_guarded=False)
    assert same == during
    assert more > 0.01


def test_a_hand_that_enters_a_wall_in_a_stall_is_not_given_what_it_never_put_in(
    tmp_path: Path,
) -> None:
    during, after, has_tripped = given(tmp_path, INTO, is_guarded=True)
    assert during < 0.0
    assert after < 2e-3  # of its own: it goes on by a millimetre, and comes back
    assert not has_tripped
    _, more, _ = given(tmp_path, INTO, is_guarded=False)
    assert more > 0.03
