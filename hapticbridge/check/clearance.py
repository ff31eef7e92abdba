"""How much room the tool has between opposite walls, found along a motion."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

FARTHEST = 2e-3
"""Distance in m beyond which two geoms are no part of a clearance: fits are tenths of that, and
what is farther away is another place in the scene."""

OPPOSITE = -0.95
"""Cosine between the directions towards two walls from which they count as opposite: 18 degrees."""

_WITHOUT_DISTANCE = [int(mujoco.mjtGeom.mjGEOM_HFIELD), int(mujoco.mjtGeom.mjGEOM_SDF)]

_NO_DIRECTION = 1e-9  # m; two points nearer than this have no direction between them


def clearances(
    model: mujoco.MjModel,
    pairs: list[tuple[int, int]],
    is_tool: NDArray[np.bool_],
    postures: NDArray[np.float64],
) -> dict[tuple[int, int], float]:
    """Returns the room per side that the tool has towards geoms that it lies between, in m.

    Between two geoms in opposite directions the tool can move by the sum of its distances from
    them, half of it to each side. Of all postures the one with the largest sum counts, because a
    tilted tool has less; of all opposite geoms the nearest.

    Args:
        model: The compiled scene.
        pairs: Geoms that may collide, one of the tool at least.
        is_tool: Per geom, whether it is of the tool.
        postures: ``qpos`` of each posture, shape (n, nq).

    Returns:
        By pair; pairs that are no part of a clearance are left out.
    """
    data, segment = mujoco.MjData(model), np.zeros(6)
    known = ~np.isin(model.geom_type, _WITHOUT_DISTANCE)
    candidates = np.array([p for p in pairs if known[list(p)].all()], np.int64).reshape(-1, 2)
    rooms: dict[tuple[tuple[int, int], tuple[int, int]], float] = {}
    for posture in postures:
        data.qpos[:] = posture
        mujoco.mj_kinematics(model, data)
        near: list[tuple[tuple[int, int], float, NDArray[np.float64]]] = []
        for first, second in candidates[_may_be_near(model, data, candidates)].tolist():
            distance = mujoco.mj_geomDistance(model, data, first, second, FARTHEST, segment)
            direction = segment[3:] - segment[:3]
            length = float(np.linalg.norm(direction))
            if distance >= FARTHEST or length < _NO_DIRECTION:
                continue
            away = direction / length * np.sign(distance) * (1 if is_tool[first] else -1)
            near.append(((first, second), distance, away))
        for k, (pair, distance, away) in enumerate(near):
            for other, there, towards in near[:k]:
                if float(away @ towards) < OPPOSITE:
                    both = (pair, other)
                    rooms[both] = max(rooms.get(both, 0.0), 0.5 * (distance + there))
    found: dict[tuple[int, int], float] = {}
    for both, room in rooms.items():
        for pair in both:
            if room > 0.0:
                found[pair] = min(found.get(pair, np.inf), room)
    return found


def _may_be_near(
    model: mujoco.MjModel, data: mujoco.MjData, pairs: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """Tells by their bounding spheres which pairs may be within ``FARTHEST``."""
    first, second = pairs.T
    reach = np.where(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE, np.inf, model.geom_rbound)
    apart = np.linalg.norm(data.geom_xpos[first] - data.geom_xpos[second], axis=1)
    return np.asarray(apart <= reach[first] + reach[second] + FARTHEST, dtype=bool)
