"""Runs in simulated time that tests of the bridge share."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hapticbridge.clock import SimulatedClock
from hapticbridge.run.bridge import Bridge
from hapticbridge.scene import Scene

REST = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


def still(_tick: int) -> tuple[float, ...]:
    return REST


def sway(tick: int) -> tuple[float, ...]:
    x, y, z, w = Rotation.from_rotvec([0, 0.2 * np.sin(0.01 * tick), 0]).as_quat()
    return (0.01 * np.sin(0.02 * tick), 0.004 * np.sin(0.03 * tick), 0, w, x, y, z)


def fast(
    scene: str | Path | Scene = "point_mass", device: Any = "simulated", **options: Any
) -> Bridge:
    return Bridge(scene, device, options.pop("coupling", None), clock=SimulatedClock(), **options)
