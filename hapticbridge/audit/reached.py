"""Audit state carried from one block of records to the next."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit.guarded import Guarded
from hapticbridge.kernel.parameters import RunParameters

Array = NDArray[np.float64]

SUMS = (
    "coupling_work",
    "throughput",
    "device_energy",
    "device_throughput",
    "slack",
    "given",
    "burnt",
    "kept",
    "commanded",
)
"""Names of the cumulative energies."""


@dataclass(frozen=True, slots=True)
class Reached:
    """State of the balance after the previous tick.

    Attributes:
        handle: Handle pose (7,).
        tool: Tool pose (7,).
        device: Device pose (7,).
        sent: Wrench sent to the device, (6,).
        start_energy: Kinetic, potential and elastic energy before the first tick, in J.
        share: Share of the wrench that ramp and fading transmitted.
        guarded: State of the guard.
        sums: Cumulative energies in J.
    """

    handle: Array
    tool: Array
    device: Array
    sent: Array
    start_energy: float
    share: float
    sums: dict[str, float]
    guarded: Guarded

    @classmethod
    def at_start(
        cls, parameters: RunParameters, handle: Array, tool: Array, start_energy: float
    ) -> Reached:
        """Returns the state before the first tick.

        ``start_energy`` is kinetic plus potential energy, in J.
        """
        device = np.array(parameters.device_start)
        guarded = Guarded.at_start(parameters, handle, tool, start_energy)
        sums = dict.fromkeys(SUMS, 0.0)
        return cls(handle, tool, device, np.zeros(6), start_energy, 0.0, sums, guarded)
