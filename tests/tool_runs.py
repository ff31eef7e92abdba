"""What is read off a run of a hand tool: blows of a hammer, the moment on a handle."""

from __future__ import annotations

import numpy as np
from model_runs import Array, Run


def windows_of_blows(run: Run) -> list[tuple[int, int]]:
    """The last tick before each impact on the nail, and the tick in which the nail has stopped."""
    depth = -run.joints[:, 0]
    starts = np.flatnonzero(run.touched["nail"][1:] & ~run.touched["nail"][:-1]).tolist()
    ends = [*starts[1:], len(depth) - 1]
    # it stops within 10 µm of where it stays until the next blow: beyond that it only creeps
    stops = [
        start + int(np.argmax(depth[start:end] > depth[end] - 1e-5))
        for start, end in zip(starts, ends, strict=True)
    ]
    return list(zip(starts, stops, strict=True))


def moment_about_axis(run: Run) -> Array:
    """Moment of the coupling's wrench about the world's z axis, in N m."""
    moment: Array = np.cross(run.tool, run.force)[:, 2] + run.torque[:, 2]
    return moment
