"""Honest hands that the watch for a late force must leave alone."""

from __future__ import annotations

import numpy as np

import hapticbridge as hb
from hapticbridge.device import DEFAULT_HAND, Hand, Motion, SimulatedDevice
from hapticbridge.record import TickFlag

GRIPS = {
    "fingers": Hand(mass=0.05, damping=2.0, stiffness=30.0),
    "arm": DEFAULT_HAND,
    "firm": Hand(stiffness=1000.0, damping=20.0, rotational_stiffness=3.0),
}
"""Grips from two fingers to an arm that holds hard."""

LIFTED = {
    "planar_peg": -0.045,
    "peg_in_hole": -0.045,
    "round_peg": -0.045,
    "screwdriver": -0.002,
    "hex_key": -0.002,
}
"""By how much a hand goes up in m before it is random: into the hole, onto the screw."""


def taps(frequency: float, amplitude: float, duration: float = 3.0) -> Motion:
    """Returns a hand that taps on the face of ``virtual_wall``, in Hz and m."""
    times = np.arange(0.0, duration + 0.005, 0.002)
    swing = amplitude * np.sin(2 * np.pi * frequency * times) * np.minimum(times, 1.0)
    along = 0.010 * np.minimum(times / 0.3, 1.0) + swing
    return Motion(times, [(x, 0.0, 0.0) for x in along])


FAST_SCENES = {
    "virtual_wall": ((0.010, 0.0, 0.0), (1.0, 0.0, 0.0)),
    "drawer": ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)),
    "hammer": ((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "peg_in_hole": ((0.0, 0.0, -0.045), (1.0, 0.5, 0.0)),
    "bench_pliers": ((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "ratchet": ((0.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
    "point_mass": ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)),
    "open_wrench": ((0.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
    "planar_peg": ((0.0, 0.0, -0.045), (1.0, 0.0, 0.0)),
}
"""Where a fast hand shakes a scene, in m, and along which direction."""

VERY_FIRM = Hand(
    mass=0.4, stiffness=3000.0, damping=40.0, rotational_stiffness=5.0, rotational_damping=0.05
)


def shakes(name: str, frequency: float, amplitude: float, duration: float = 3.0) -> Motion:
    """Returns a hand that shakes a scene of ``FAST_SCENES``, in Hz and m."""
    base, direction = (np.array(vector) for vector in FAST_SCENES[name])
    times = np.arange(0.0, duration + 0.005, 0.001)
    swing = amplitude * np.sin(2 * np.pi * frequency * times) * np.minimum(times / 0.5, 1.0)
    return Motion(times, np.minimum(times / 0.4, 1.0)[:, None] * base + swing[:, None] * direction)


def alarms(name: str, motion: Motion | None, grip: Hand | None) -> int:
    """Runs a hand on a scene; returns the alarms of the watch as flags, 0 for none."""
    return watch_flags(name, motion, grip) & int(TickFlag.SWINGING | TickFlag.RUNS_AWAY)


def watch_flags(name: str, motion: Motion | None, grip: Hand | None) -> int:
    """Runs a hand on a scene; returns all flags of the run.

    Without a motion the scene's own path is followed, by the hand that it asks for.
    """
    device = "simulated" if motion is None else SimulatedDevice(path=motion, hand=grip)
    with hb.Bridge(name, device, clock=hb.SimulatedClock()) as bridge:
        summary = bridge.run(None if motion is None else motion.duration)
        flags = bridge.latest_records(summary.ticks)["flags"]
    return int(np.bitwise_or.reduce(flags))
