"""The hands of the map ``contact``: ones that tap, a recorded one, and random ones that push."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hapticbridge.device import Hand, Motion
from hapticbridge.device.trajectory import read_motion
from hapticbridge.scene import scene_path
from hapticbridge.study.maps.rigs import swinging

RECORDED = (3.5, 6.0)
"""Part of the recorded hand in s: into the hole and to the bottom, pressing to the sides."""


@cache
def tapping(frequency: float) -> Motion:
    """Returns the path of a hand that taps at a frequency in Hz.

    It wants to go 6 mm behind the wall's face.
    """
    return swinging(0.008, frequency, duration=1.0, count=301)


@cache
def random_taps(seed: int) -> tuple[Motion, Hand]:
    """Returns a random hand that taps: 1 to 6 Hz, 0 to 6 mm behind the wall's face, 1 s."""
    random = np.random.default_rng(seed)
    size, frequency = random.uniform(5e-3, 8e-3), random.uniform(1.0, 6.0)
    hand = Hand(stiffness=random.uniform(800, 3000), damping=random.uniform(5, 30))
    return swinging(size, frequency, duration=1.0, count=301), hand


@cache
def recorded() -> tuple[Motion, Hand]:
    """Returns the scene's recorded hand while it is in the hole, with the grip of a firm hand."""
    table = read_motion(scene_path("peg_in_hole").with_suffix(".csv")).table
    rows = (table[:, 0] >= RECORDED[0]) & (table[:, 0] <= RECORDED[1])
    path = Motion(table[rows, 0], table[rows, 1:4], table[rows, 4:]).relative()
    return path, Hand(
        stiffness=2000.0, damping=25.0, rotational_stiffness=5.0, rotational_damping=0.05
    )


@cache
def random_push(seed: int) -> tuple[Motion, Hand]:
    """Returns a random firm hand and its path.

    It wants to go up to 8 mm and 0.15 rad out of place, at 0.5 to 3 Hz.
    """
    random = np.random.default_rng(seed)
    time = np.linspace(0.0, 2.0, 81)

    def smooth(size: float) -> NDArray[np.float64]:
        frequency, phase = random.uniform(0.5, 3.0, 5), random.uniform(0, 2 * np.pi, 5)
        angle = 2 * np.pi * frequency[:, None] * time + phase[:, None]
        waves = random.normal(size=5) @ (np.sin(angle) - np.sin(phase)[:, None])
        return np.asarray(size * waves / np.abs(waves).max())

    position = np.column_stack([smooth(8e-3) for _ in range(3)])
    turn = Rotation.from_rotvec(np.column_stack([smooth(0.15), smooth(0.15), smooth(0.1)]))
    hand = Hand(
        mass=random.uniform(0.2, 0.8),
        stiffness=random.uniform(800, 3000),
        damping=random.uniform(5, 30),
        rotational_stiffness=random.uniform(1, 5),
        rotational_damping=random.uniform(0.01, 0.05),
    )
    return Motion(time, position, turn.as_quat(canonical=True)[:, [3, 0, 1, 2]]), hand
