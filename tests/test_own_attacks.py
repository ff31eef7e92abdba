"""Random and improved hands on whole bridges, counted by a ledger of their own."""

from __future__ import annotations

import pytest
from adversary import UNPAID
from own_attacks import KINDS, REFERENCES, attacked_on_device

SEEDS, STEPS = range(29, 33), 3
"""Hands of a test, and their improvements; ``scripts/attack`` takes as many as it is asked for."""


@pytest.mark.parametrize("kind", KINDS)
def test_no_hand_gets_energy_where_the_device_is_certified(kind: str) -> None:
    found = [attacked_on_device(kind, seed, STEPS) for seed in SEEDS]
    certified = [each for each in found if each.is_certified]
    assert len(certified) >= 2
    assert max(each.energy - each.blur for each in certified) <= UNPAID


@pytest.mark.parametrize(("kind", "seed"), [*zip(REFERENCES, (50, 43, 19), strict=True)])
def test_hands_get_energy_where_a_condition_is_broken(kind: str, seed: int) -> None:
    assert attacked_on_device(kind, seed).energy > 10 * UNPAID
