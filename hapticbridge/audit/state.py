"""Audit state carried from one block of records to the next."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.recording import RecordingFile
from hapticbridge.run_description import STARTS, meta_start

Array = NDArray[np.float64]

SUMS = (
    "coupling_work",
    "throughput",
    "device_energy",
    "device_throughput",
    "slack",
    "delayed_device_energy",
    "device_dissipation",
    "tank_ceiling",
)
"""Names of the cumulative energies."""


@dataclass(frozen=True, slots=True)
class AuditState:
    """State of the audit after the previous tick.

    Attributes:
        row: Record of the previous tick, (1,). Before the first tick it holds the poses at the
            start and zeros.
        since_sample: Time in s that the device has been without a new sample.
        rise_ticks: Ticks in which the share of the wrench rises from 0 to 1.
        start_energy: Kinetic plus potential energy before the first tick, in J.
        sums: Cumulative energies in J, by the names of ``SUMS``.
    """

    row: NDArray[np.void]
    since_sample: float
    rise_ticks: float
    start_energy: float
    sums: dict[str, float]

    @classmethod
    def at_start(cls, recording: RecordingFile, parameters: RunParameters) -> AuditState:
        """Returns the state before the first tick.

        Raises:
            RecordingError: The metadata lack the start of the energy balance.
        """
        starts = {name: np.array(meta_start(recording.meta, name)) for name in STARTS}
        row = np.zeros(1, recording.record)
        poses = {
            "device": np.array(parameters.device_start),
            "handle": starts["handle_start"],
            "tool": starts["tool_start"],
        }
        for body, pose in poses.items():
            row[f"{body}_position"], row[f"{body}_quaternion"] = pose[:3], pose[3:]
        return cls(
            row=row,
            since_sample=0.0,
            rise_ticks=float(parameters.ramp_ticks),
            start_energy=float(starts["start_kinetic"][0] + starts["start_potential"][0]),
            sums=dict.fromkeys(SUMS, 0.0),
        )
