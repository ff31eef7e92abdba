"""What one block of records hands to the next."""

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
"""What is summed over ticks."""


@dataclass(frozen=True, slots=True)
class Reached:
    """Where a recording has got to: what the balance of its next ticks begins with.

    Attributes:
        handle: Handle pose (7,) in the tick before.
        tool: Tool pose (7,).
        device: Device pose (7,).
        sent: Wrench that was sent to the device, (6,).
        start_energy: Kinetic plus potential energy before the first tick, in J.
        share: Of the wrench that the ramp let through.
        guarded: Where the guard has got to.
        sums: The cumulative energies so far, in J.
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
        """Returns what the first tick begins with.

        Args:
            parameters: The run's.
            handle: Handle pose (7,) before the first tick.
            tool: Tool pose (7,) before the first tick.
            start_energy: Kinetic plus potential energy before the first tick, in J.
        """
        device = np.array(parameters.device_start)
        guarded = Guarded.at_start(parameters, handle, tool, start_energy)
        sums = dict.fromkeys(SUMS, 0.0)
        return cls(handle, tool, device, np.zeros(6), start_energy, 0.0, sums, guarded)
