"""Clearance of the tool between opposite walls."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

FARTHEST = 2e-3
"""Distance in m beyond which two geoms do not form a clearance. Fits are tenths of it; anything
farther away belongs to another part of the scene."""

OPPOSITE = -0.95
"""Cosine between the directions to two walls below which they count as opposite; 18 degrees from
straight."""

_WITHOUT_DISTANCE = [int(mujoco.mjtGeom.mjGEOM_HFIELD), int(mujoco.mjtGeom.mjGEOM_SDF)]

_NO_DIRECTION = 1e-9  # m; two points nearer than this have no direction between them


def clearances(
    model: mujoco.MjModel,
    pairs: list[tuple[int, int]],
    is_tool: NDArray[np.bool_],
    postures: NDArray[np.float64],
) -> dict[tuple[int, int], float]:
    """Returns the clearance per side between the tool and the geoms around it, in m.

    Between two geoms in opposite directions the tool can move by the sum of its distances from
    them; the clearance per side is half of it. Each pair of walls counts with its largest sum over
    all postures, because a tilted tool has less room. Each geom counts with its smallest clearance.

    Args:
        model: The compiled scene.
        pairs: Geoms that may collide; at least one of each pair belongs to the tool.
        is_tool: True for each geom of the tool.
        postures: ``qpos`` of each posture, shape (n, nq).

    Returns:
        Clearance by pair; pairs that form no clearance are absent.
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
    first, second = pairs.T
    reach = np.where(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE, np.inf, model.geom_rbound)
    apart = np.linalg.norm(data.geom_xpos[first] - data.geom_xpos[second], axis=1)
    return np.asarray(apart <= reach[first] + reach[second] + FARTHEST, dtype=bool)
