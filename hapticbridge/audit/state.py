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
    "stored_in_coupling",
    "commanded",
)
"""Names of the cumulative energies."""


@dataclass(frozen=True, slots=True)
class AuditState:
    """State of the audit after the previous tick.

    Attributes:
        row: Record of the previous tick, (1,). Before the first tick it holds the poses at the
            start and zeros.
        since_sample: Time in s that the device has been without a new sample.
        share: Share of the wrench that ramp and fade transmitted.
        ramp_ticks: Length of the newest ramp in ticks.
        anchors: Device pose and handle pose (7,) at the last anchoring.
        start_energy: Kinetic plus potential energy before the first tick, in J.
        sums: Cumulative energies in J, by the names of ``SUMS``.
    """

    row: NDArray[np.void]
    since_sample: float
    share: float
    ramp_ticks: float
    anchors: tuple[Array, Array]
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
            share=0.0,
            ramp_ticks=float(parameters.ramp_ticks),
            anchors=(np.array(parameters.device_origin), np.array(parameters.handle_origin)),
            start_energy=float(starts["start_kinetic"][0] + starts["start_potential"][0]),
            sums=dict.fromkeys(SUMS, 0.0),
        )
