"""Smooth random hands: what a scene is shaken with to see whether it stays finite and passive."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from hapticbridge.demand.certificate import default_coupling
from hapticbridge.demand.methods import default_method
from hapticbridge.device import Hand, Motion, SimulatedDevice
from hapticbridge.lab.closed_loop import ClosedLoop, LoopOutcome

T = 1e-3
REACH, ANGLE = 0.03, np.radians(45.0)
SINES, SLOWEST, FASTEST = 6, 0.2, 1.5  # per axis; Hz: what a hand does without thinking
FADE = 0.5  # s


HAND_RANGES = {
    "mass": (0.05, 2.0),
    "damping": (0.5, 50.0),
    "stiffness": (10.0, 2000.0),
    "rotational_inertia": (1e-4, 1e-2),
    "rotational_damping": (2e-3, 0.2),
    "rotational_stiffness": (0.1, 10.0),
}
"""Ranges of random hands in the units of ``Hand``: from two fingers that hardly hold to an arm that
grips hard, around the measured arm of the defaults. Every hand in them is passive."""


def random_hand(seed: int) -> Hand:
    """Returns a random passive hand that depends only on the seed.

    Every value is drawn independently, evenly in its logarithm, from its ``HAND_RANGES``.
    """
    generator = np.random.default_rng(seed)
    return Hand(
        **{
            name: float(np.exp(generator.uniform(np.log(least), np.log(most))))
            for name, (least, most) in HAND_RANGES.items()
        }
    )


def smooth(phase: np.ndarray) -> np.ndarray:
    s = np.clip(phase, 0.0, 1.0)
    return np.asarray(s**3 * (10 - 15 * s + 6 * s**2))


def random_motion(seed: int, duration: float = 5.0, first: float = 0.0) -> Motion:
    """Returns sums of sines that reach 3 cm and 45 degrees, after moving up by ``first`` m."""
    generator = np.random.default_rng(seed)
    times = np.arange(0.0, duration + 0.005, 0.01)
    frequency = generator.uniform(SLOWEST, FASTEST, (6, SINES, 1))
    phase = generator.uniform(0.0, 2 * np.pi, (6, SINES, 1))
    motion = np.sin(2 * np.pi * frequency * times + phase).sum(axis=1).T
    begin = 1.0 if first else 0.0
    motion = (motion - motion[0]) * smooth((times - begin) / FADE)[:, None]
    motion[:, :3] *= REACH / np.linalg.norm(motion[:, :3], axis=1).max()
    motion[:, 3:] *= ANGLE / np.linalg.norm(motion[:, 3:], axis=1).max()
    motion[:, 2] += first * smooth(times)
    turns = Rotation.from_rotvec(motion[:, 3:]).as_quat(scalar_first=True)
    return Motion(times, motion[:, :3], turns)


def shaken(loop: ClosedLoop, motion: Motion, hand: Hand | None = None) -> LoopOutcome:
    """Runs a scene in a hand that follows a motion, with the default coupling."""
    device = SimulatedDevice(path=motion, hand=hand or Hand())
    coupling = default_coupling(device.info, T, 1.0, 1.0)
    ticks = round(motion.duration / T)
    return loop.run(device, coupling, default_method(), ticks=ticks, keep_records=True)
