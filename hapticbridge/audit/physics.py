"""Comparison of records with their second computation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit.balance import Balance
from hapticbridge.audit.structure import TOLERANCE, Fault
from hapticbridge.audit.watched import has_flag
from hapticbridge.tick import UNITS, TickFlag

CONTROLLED_TOLERANCE = 1e-5
"""Relative tolerance while the passivity controller acts. It divides a small debt by a squared
small velocity, which costs five digits. The re-simulation checks the rest."""


def physics_fault(ticks: NDArray[np.void], balance: Balance) -> Fault | None:
    """Returns the earliest disagreement between records and their second computation, or None."""
    start = int(ticks["tick"][0])
    vectors = (
        ("handle_position", balance.handle_position, "m", "device pose and scale"),
        ("wrench_on_tool", balance.wrench_on_tool, "N or N m", "coupling law and poses"),
        ("wrench_on_device", balance.wrench_on_device, "N or N m", "wrench on the tool and limits"),
    )
    faults = []
    for name, expected, unit, by in vectors:
        difference = np.abs(ticks[name] - expected).max(axis=1)
        allowed = TOLERANCE * (1 + np.abs(expected).max(axis=1))
        if name == "wrench_on_device":
            is_active = has_flag(ticks, TickFlag.CONTROLLER_ACTIVE)
            allowed = np.where(is_active, allowed * CONTROLLED_TOLERANCE / TOLERANCE, allowed)
        faults.append(_first(name, start, difference, allowed, unit, by))
    faults.append(
        _first(
            "handle_quaternion",
            start,
            balance.handle_turn,
            np.full(len(ticks), TOLERANCE),
            "rad",
            "device pose",
        )
    )
    energies = (
        ("coupling_work", balance.coupling_work, balance.throughput),
        ("device_energy", balance.device_energy, balance.device_throughput),
        ("environment_energy", balance.environment_energy, balance.throughput),
    )
    for name, joules, throughput in energies:
        difference = np.abs(ticks[name] - joules)
        scale = throughput + np.abs(ticks["potential"])
        faults.append(
            _first(
                name,
                start,
                difference,
                TOLERANCE * (1 + scale),
                "J",
                "recorded poses and wrenches",
            )
        )
    is_off = (ticks["flags"] & int(TickFlag.CONTROLLER_ACTIVE)) == 0
    for kind, name in enumerate(("injected_damping", "injected_rotational_damping")):
        unit = UNITS[name]
        damping = np.where(is_off, np.abs(ticks[name]), 0.0)
        faults.append(_first(name, start, damping, np.zeros(len(ticks)), unit, "flags"))
        expected = balance.injected_damping[:, kind]
        allowed = CONTROLLED_TOLERANCE * (1 + np.abs(expected))
        wrong = np.abs(ticks[name] - expected)
        faults.append(_first(name, start, wrong, allowed, unit, "poses and energies"))
    found = [fault for fault in faults if fault is not None]
    return min(found, key=lambda fault: fault.tick or 0) if found else None


def _first(
    name: str,
    start: int,
    difference: NDArray[np.float64],
    allowed: NDArray[np.float64],
    unit: str,
    by: str,
) -> Fault | None:
    wrong = ~(difference <= allowed)  # True also for NaN from an overflow
    if not wrong.any():
        return None
    at = int(np.argmax(wrong))
    tick, amount = start + at, float(difference[at])
    return Fault(
        f"{name} of tick {tick} is {amount:.3g} {unit} off what {by} give",
        tick,
        name,
        amount if unit == "J" else 0.0,
    )
