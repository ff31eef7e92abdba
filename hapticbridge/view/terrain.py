"""Height fields as triangles, as MuJoCo collides with them and draws them."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MOST_SAMPLES = 200
"""Of a height field along a side that are drawn. At 200 it has 80 000 triangles, some 8 MB that a
browser loads once; of a finer one every so many samples are left out."""


def terrain(model: mujoco.MjModel, field: int, stride: int = 1) -> Array:
    """Returns the surface of a height field, its four sides and its base.

    Sample (i, j) of the field, row by row, stands at

        x = r_x (2 j / (columns − 1) − 1),  y = r_y (2 i / (rows − 1) − 1),  z = r_z · sample

    so the first row is the one of least y. Each cell is cut from its first corner to the one across
    (i + 1, j + 1); the sides go down to the base at z = −r_b. r = (r_x, r_y, r_z, r_b) is the
    field's size in m.

    Args:
        model: The scene.
        field: Index of the height field.
        stride: Of how many samples along a side one is drawn, >= 1; the last one always is.

    Returns:
        Triangles in the geom's frame, (m, 3, 3) in m, their outside where they turn
        counter-clockwise.
    """
    rows, columns = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
    first, size = int(model.hfield_adr[field]), model.hfield_size[field]
    data = model.hfield_data[first : first + rows * columns].reshape(rows, columns)
    ups, rights = (np.unique([*range(0, n, stride), n - 1]) for n in (rows, columns))
    x, y = np.meshgrid(
        size[0] * (2.0 * rights / (columns - 1) - 1.0), size[1] * (2.0 * ups / (rows - 1) - 1.0)
    )
    top = np.stack([x, y, size[2] * data[np.ix_(ups, rights)]], axis=2)
    base = np.stack([x, y, np.full_like(x, -size[3])], axis=2)
    # around the rim, counter-clockwise from above
    rims = [
        np.concatenate([side[0], side[1:, -1], side[-1, -2::-1], side[-2::-1, 0]])
        for side in (base, top)
    ]
    corners = base[[0, -1]][:, [0, -1]]
    parts = [_split(top), _split(np.stack(rims)), _split(corners)[:, ::-1]]
    return np.concatenate(parts)


def stride_of(model: mujoco.MjModel, field: int) -> int:
    """Returns of how many samples of a height field along a side one is drawn."""
    side = max(int(model.hfield_nrow[field]), int(model.hfield_ncol[field]))
    return max(1, -(-(side - 1) // (MOST_SAMPLES - 1)))


def _split(grid: Array) -> Array:
    """Returns two triangles for each cell of a grid of points, (rows, columns, 3)."""
    low, right = grid[:-1, :-1], grid[:-1, 1:]
    up, across = grid[1:, :-1], grid[1:, 1:]
    pairs = np.stack([np.stack([low, right, across], 2), np.stack([low, across, up], 2)], 2)
    return np.ascontiguousarray(pairs.reshape(-1, 3, 3), dtype=np.float64)
