"""Taps on a wall with and without pulses, beside a wall of ten times the stiffness.

A device of 0.2 kg with its hand and b = 4 N s/m taps a wall with a tool of 0.1 kg; the hand holds
its speed with 6 N s/m. Each line has the largest acceleration of the handle in the first 5 ms, and
the error of its amplitude spectrum from 20 to 500 Hz over that time, relative to the wall of ten
times the stiffness. Everything is deterministic.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
from kernel_runs import T
from tapping import DAMPING, onset, spectral_error, stiff_onset, tapping

from hapticbridge import Coupling
from hapticbridge.demand.pulse import PULSES

SPEEDS, STIFFNESSES, SHARES, GAP = (0.1, 0.2, 0.3, 0.4), (1000.0, 2000.0), (0.5, 1.0), 0.06
"""Speeds in m/s, stiffnesses in N/m, shares of a blow's energy, and way to the wall in m."""


def add_options(_parser: argparse.ArgumentParser) -> None:
    """Adds none."""


def measure(_arguments: argparse.Namespace) -> dict[str, Any]:
    """Prints the table and returns its rows."""
    rows = []
    for stiffness in STIFFNESSES:
        coupling = Coupling(stiffness, 0.0, 1.0, 0.0)
        spare = DAMPING - 0.5 * stiffness * T
        for speed in SPEEDS:
            target = stiff_onset(coupling, speed, GAP)
            print(f"{stiffness:g} N/m, {speed:g} m/s: target {np.abs(target).max():.1f} m/s²")
            cases = [("none", 0.0, 0.0, 0.01)]
            cases += [(name, share, *PULSES[name]) for name in PULSES for share in SHARES]
            for name, share, frequency, decay in cases:
                taps = tapping(
                    (0,),
                    coupling,
                    GAP,
                    impact_pulses=share,
                    pulse_frequency=frequency,
                    pulse_decay=decay,
                    pulse_damping=spare if share else 0.0,
                )
                found = onset(taps, speed, GAP)
                peak, error = float(np.abs(found).max()), spectral_error(found, target)
                largest = float(np.abs(taps.ticks["pulse"]).max())
                print(
                    f"  {name:7}{share:4.1f}: {peak:5.1f} m/s², error {error:.2f}, "
                    f"pulse {largest:.2f} N"
                )
                rows.append(
                    {
                        "stiffness": stiffness,
                        "speed": speed,
                        "pulse": name,
                        "share": share,
                        "peak": peak,
                        "target": float(np.abs(target).max()),
                        "error": error,
                        "largest_pulse": largest,
                    }
                )
    return {"taps": rows}
