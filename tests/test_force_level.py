"""One force level on both ports: no hand gets energy out, and the level holds inside a step."""

from __future__ import annotations

import pytest
from adversary import UNPAID, Attack

from hapticbridge.kernel.codes import OK

ATTACKS = 300


@pytest.mark.parametrize("start", range(0, ATTACKS, 50))
def test_no_hand_gets_energy_out(start: int) -> None:
    for seed in range(start, start + 50):
        attack = Attack.at_random(seed)
        energy, _, code = attack.run()
        assert code == OK
        assert energy <= UNPAID, attack


def test_no_hand_gets_energy_out_of_late_samples() -> None:
    for seed in range(1000, 1060):
        attack = Attack.at_random(seed, late=3.0)
        energy, _, _ = attack.run()
        assert energy <= UNPAID, attack


def test_hands_saturate_the_coupling() -> None:
    saturated = sum(Attack.at_random(seed).run(500)[1] for seed in range(20))
    assert saturated > 2000


def test_a_limit_on_the_device_alone_is_seen_to_fail() -> None:
    worst = max(
        Attack.at_random(
            seed, scene=scene, kind=1, presses=False, tunes=False, is_limited_alone=True
        ).run(ticks)[0]
        for seed, scene, ticks in ((52, "point_mass", 8000), (68, "peg_in_hole", 2000))
    )
    assert worst > 0.05
