"""One point of a stability map as a bridge runs it: recorded to a file, judged from the file."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import hapticbridge as hb
from hapticbridge.audit import AuditReport
from hapticbridge.device import SimulatedDevice, TrajectoryDevice
from hapticbridge.guard import Limits
from hapticbridge.kernel.parameters import UNGUARDED
from hapticbridge.scene import Scene

NEVER = 1e9
"""Force in N and torque in N m that no run reaches: a loop that diverges is to be seen doing so,
and not held by the guard. Give it to the device as its own limits."""


def recorded_and_audited(
    scene: Scene | str,
    device: SimulatedDevice | TrajectoryDevice,
    coupling: hb.Coupling,
    method: str,
    period: float,
    ticks: int,
    tmp_path: Path,
    *,
    knock: NDArray[np.float64] | None = None,
    name: str = "run",
) -> AuditReport:
    """Runs a bridge in simulated time into a recording, and returns the audit's verdict on it.

    Args:
        scene: A loaded scene, with its model changed as the map changes it, or a name.
        device: Its ``force_limit`` and ``torque_limit`` are those of the run.
        coupling: K and B.
        method: By its name.
        period: T in s.
        ticks: How many are run; a run that trips the guard ends before.
        tmp_path: Where the recording goes.
        knock: Displacement of a simulated device before the first tick, shape (6,), m and rad.
        name: Of the recording, without its ending.
    """
    path = tmp_path / f"{name}.mcap"

    def displace(tick: int) -> None:
        if tick == 0 and knock is not None and isinstance(device, SimulatedDevice):
            device.displace(knock)

    info = device.info
    bridge = hb.Bridge(
        scene,
        device,
        coupling,
        rate=1 / period,
        method=method,
        clock=hb.SimulatedClock(),
        limits=Limits(force=info.force_limit, torque=info.torque_limit, ramp=0.0),
        recording=path,
    )
    bridge.setup = replace(
        bridge.setup, guard=UNGUARDED
    )  # maps show what happens where nobody stops it
    # where the guard trips, the file holds what was before
    with bridge, suppress(hb.SafetyTrip):
        bridge.run(ticks * period, displace)
    return hb.audit(path)
