"""Every scene in twenty random hands of 3 cm and 45 degrees for 5 s: finite, passive, in bounds."""

from __future__ import annotations

import numpy as np
import pytest
from random_hands import random_motion, shaken

import hapticbridge as hb
from hapticbridge.study.closed_loop import ClosedLoop
from hapticbridge.tick import TickFlag

FORCE_LIMIT = 10.0  # N, of the default simulated device; a hand turned by 45 degrees twists harder

HANDS = [
    ("point_mass", {}, 0.0),
    ("virtual_wall", {}, 0.0),
    ("planar_peg", {}, 0.0),
    ("planar_peg", {}, -0.045),
    ("planar_peg", {"length": 0.04}, -0.025),
    ("planar_peg", {"length": 0.2}, -0.185),
    ("peg_in_hole", {}, 0.0),
    ("peg_in_hole", {}, -0.045),
    ("round_peg", {}, 0.0),
    ("round_peg", {}, -0.045),
    ("pliers", {}, 0.0),
    ("lock", {}, 0.0),
    ("screwdriver", {}, -0.002),
    ("hex_key", {}, -0.002),
]
"""Scene, parameters, and by how much the hand goes up in m before it is random: into the hole,
or to press a tool that starts seated."""


@pytest.mark.parametrize(("name", "values", "first"), HANDS, ids=str)
def test_twenty_random_hands_leave_it_finite_and_passive_below_the_force_limit(
    name: str, values: dict[str, float], first: float
) -> None:
    loop = ClosedLoop(hb.load_scene(name, "grip", **values))
    contacts = 0
    for seed in range(20):
        outcome = shaken(loop, random_motion(seed, first=first))
        assert outcome.ticks == 5000
        assert outcome.fault is None, f"seed {seed}: {outcome}"
        assert outcome.peak_force < FORCE_LIMIT
        for field, limit in (("wrench_on_tool", 1e3), ("tool_position", 1.0)):
            assert np.abs(outcome.records[field]).max() < limit
        assert not any(warning.number for warning in loop.scene.data.warning)
        contacts += int(np.count_nonzero(outcome.records["flags"] & TickFlag.CONTACT))
    # it met something again and again, or was never free of it
    least = 0 if name == "point_mass" else 20 * (1500 if first else 100)
    assert contacts >= least
