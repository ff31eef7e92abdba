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


def alarms(name: str, motion: Motion | None, grip: Hand | None) -> int:
    """Runs a hand on a scene; returns the flags of the watch, 0 for no alarm.

    Without a motion the scene's own path is followed, by the hand that it asks for.
    """
    device = "simulated" if motion is None else SimulatedDevice(path=motion, hand=grip)
    with hb.Bridge(name, device, clock=hb.SimulatedClock()) as bridge:
        summary = bridge.run(None if motion is None else motion.duration)
        flags = bridge.latest_records(summary.ticks)["flags"]
    return int(np.bitwise_or.reduce(flags)) & int(TickFlag.SWINGING | TickFlag.RUNS_AWAY)
