"""A hand whose task lies in x and z, laid down into the plane of a stick, which has x and y."""

from __future__ import annotations

import numpy as np

from hapticbridge.device import Motion, read_motion
from hapticbridge.scene import scene_path


def planar_hand(scene: str) -> Motion:
    """Returns the path that comes with a scene, its z along the stick's y, without its turns."""
    table = read_motion(scene_path(scene).with_suffix(".csv")).table
    return Motion(table[:, 0], np.column_stack([table[:, 1], table[:, 3], 0.0 * table[:, 0]]))
