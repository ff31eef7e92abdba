"""Primitive shapes fitted to a mesh."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

Array = NDArray[np.float64]

_GEOM = mujoco.mjtGeom


@dataclass(frozen=True, slots=True, eq=False)
class Primitive:
    """A geometric shape of MuJoCo.

    Attributes:
        kind: Box, cylinder, capsule or sphere. Ellipsoids are not tried, because their contacts
            cost as much as a mesh's.
        size: MuJoCo's three sizes, in m.
        position: Centre, in m.
        axes: Rotation whose columns are the shape's axes.
        error: Largest distance of a point from the surface divided by the points' radius, plus the
            relative volume difference to the points' hull; without unit.
    """

    kind: mujoco.mjtGeom
    size: Array
    position: Array
    axes: Array
    error: float


def best_primitive(points: Array, frames: Iterable[Array]) -> Primitive:
    """Returns the best of the primitives that just contain some points.

    MuJoCo's own fit uses the axes of inertia, which are arbitrary for a square bar: its box comes
    out turned by 45 degrees. Here the caller provides the frames.

    Args:
        points: Points in m, shape (n, 3), not all in one plane.
        frames: Rotations whose columns are the axes to try.
    """
    volume = float(ConvexHull(points).volume)
    radius = float(np.linalg.norm(points - points.mean(axis=0), axis=1).max())
    return min(
        (
            Primitive(kind, size, position, axes, _error(kind, size, local, volume, radius))
            for kind, size, position, axes, local in _candidates(points, frames)
        ),
        key=lambda each: each.error,
    )


def _candidates(
    points: Array, frames: Iterable[Array]
) -> Iterator[tuple[mujoco.mjtGeom, Array, Array, Array, Array]]:
    for frame in frames:
        for axis in range(3):
            axes = np.roll(frame, 2 - axis, axis=1)  # the chosen axis becomes the third
            local = points @ axes
            low, high = local.min(axis=0), local.max(axis=0)
            centre, half = 0.5 * (low + high), 0.5 * (high - low)
            position, local = axes @ centre, local - centre
            round_radius = float(np.linalg.norm(local[:, :2], axis=1).max())
            length = float(max(half[2] - round_radius, 0.0))
            if axis == 2:
                ball = float(np.linalg.norm(local, axis=1).max())
                yield _GEOM.mjGEOM_BOX, half, position, axes, local
                yield _GEOM.mjGEOM_SPHERE, np.array([ball, 0, 0]), position, axes, local
            yield _GEOM.mjGEOM_CYLINDER, np.array([round_radius, half[2], 0]), position, axes, local
            if length > 0.0:
                size = np.array([round_radius, length, 0])
                yield _GEOM.mjGEOM_CAPSULE, size, position, axes, local


def _error(kind: mujoco.mjtGeom, size: Array, local: Array, volume: float, radius: float) -> float:
    outside = np.abs(signed_distance(kind, size, local)).max()
    return float(outside / radius + abs(_volume(kind, size) / volume - 1.0))


def signed_distance(kind: mujoco.mjtGeom, size: Array, points: Array) -> Array:
    """Returns the distance of points from a primitive's surface, in m; negative inside.

    ``size`` holds MuJoCo's sizes in m; points are in the primitive's frame, in m, shape (n, 3).
    """
    if kind in (_GEOM.mjGEOM_SPHERE, _GEOM.mjGEOM_CAPSULE):
        length = size[1] if kind == _GEOM.mjGEOM_CAPSULE else 0.0
        along = np.clip(points[:, 2], -length, length)
        core = np.stack([np.zeros_like(along), np.zeros_like(along), along], axis=1)
        return np.asarray(np.linalg.norm(points - core, axis=1) - size[0])
    if kind == _GEOM.mjGEOM_CYLINDER:
        radial = np.linalg.norm(points[:, :2], axis=1) - size[0]
        beyond = np.stack([radial, np.abs(points[:, 2]) - size[1]], axis=1)
    else:
        beyond = np.abs(points) - size
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
    return np.asarray(outside + np.minimum(beyond.max(axis=1), 0.0))


def _volume(kind: mujoco.mjtGeom, size: Array) -> float:
    if kind == _GEOM.mjGEOM_BOX:
        return float(8.0 * size.prod())
    radius, half = float(size[0]), float(size[1])
    if kind == _GEOM.mjGEOM_CYLINDER:
        return 2.0 * math.pi * radius**2 * half
    ball = 4.0 / 3.0 * math.pi * radius**3
    return ball + (2.0 * math.pi * radius**2 * half if kind == _GEOM.mjGEOM_CAPSULE else 0.0)
