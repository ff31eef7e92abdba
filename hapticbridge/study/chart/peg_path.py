"""The handle's motion over the peg: into the hole, then pushed against it in several ways."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

HOME = np.array([0.0, 0.0, 0.04])
"""Where the peg's centre starts in m, 10 mm above the mouth."""

POSES: tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...] = (
    ((0.0, 0.0, 0.012), (0.0, 0.0, 0.0)),
    ((2e-3, 0.5e-3, 0.012), (0.0, 0.0, 0.02)),
    ((-1e-3, 1.5e-3, 0.010), (0.03, 0.06, 0.0)),
    ((0.5e-3, 0.0, -0.012), (0.0, -0.05, 0.0)),
)
"""Where the handle goes, in m and as a rotation vector in rad: in, against a wall, tilted against
two edges, onto the bottom. The last three are judged."""

RAMP, HOLD = 0.2, 0.4
"""Time in s to go to a pose and to stay there. The ramp is a minimum-jerk one, which leaves little
to ring; after the hold, with the damping of the chart, e⁻⁶ of it is left."""

DURATION = len(POSES) * (RAMP + HOLD)

JUDGED = tuple(range(1, len(POSES)))


def peg_path(times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns positions and quaternions of the handle, counted from ``HOME``."""
    stops = np.array([(*HOME, 0.0, 0.0, 0.0), *((*place, *turn) for place, turn in POSES)])
    stage = np.minimum((times / (RAMP + HOLD)).astype(int), len(POSES) - 1)
    share = np.clip((times - stage * (RAMP + HOLD)) / RAMP, 0.0, 1.0)
    smooth = share**3 * (10 - 15 * share + 6 * share**2)
    poses = stops[stage] + smooth[:, None] * (stops[stage + 1] - stops[stage])
    turns = Rotation.from_rotvec(poses[:, 3:]).as_quat(canonical=True)[:, [3, 0, 1, 2]]
    return poses[:, :3] - HOME, turns


def end_of_hold(index: int) -> float:
    """Returns the time in s at which the handle leaves a pose."""
    return (index + 1) * (RAMP + HOLD)
