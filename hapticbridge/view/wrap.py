"""Where a texture lies on a shape: MuJoCo's own rule, shape by shape.

u and v count a texture's widths and heights from its upper left corner, to the right and down; they
are multiplied by the material's ``texrepeat``, and with ``texuniform`` by the first two half sizes
of the geom, too. With p a point in the geom's frame and q = p / half sizes:

    plane        u = ½(1 + q_x), v = ½(1 − q_y)
    box          likewise on each side, by the two axes along it
    sphere, ellipsoid      u = atan2(q_y, q_x)/2π, v = arccos(q_z)/π
    cylinder     side: u as a sphere's, v = ½(1 − q_z); ends: u = ½(1 + q_x), v = ½(1 + q_y)
    capsule      side likewise; ends: u as a sphere's, v = 2/π times the angle to the axis, so that
                 the picture is there three times
    mesh         as it brings along; else u = ½(q_x − 1), v = −½(q_y + 1), so also a height field, a
                 signed distance field and, in m, a plane without end

A cube texture is seen from the middle of the geom in the direction q, on a mesh or a field in the
direction p (``texuniform``: p, on a mesh or a field p times the half sizes in m). Each
triangle takes the side that its middle sees: exact on a box, off by less than a triangle at the
edges of the cube elsewhere.

All of it was read off what MuJoCo 4 renders; its documentation does not say it.
"""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

SIDES = 6
"""Of a cube texture, one below the other: +x −x +y −y +z −z."""

_EDGE = 2e-3
"""How near the edge of its side a triangle may look, as a share of it; beyond is another side."""

# the axis that a side faces, and which axes run along the picture, to the right and down (OpenGL
# 2.1 specification, table 3.19)
_CUBE = (
    (0, 1.0, (2, -1.0), (1, -1.0)),
    (0, -1.0, (2, 1.0), (1, -1.0)),
    (1, 1.0, (0, 1.0), (2, 1.0)),
    (1, -1.0, (0, 1.0), (2, -1.0)),
    (2, 1.0, (0, 1.0), (1, -1.0)),
    (2, -1.0, (0, -1.0), (1, -1.0)),
)

_AS_IT_IS = (
    int(mujoco.mjtGeom.mjGEOM_MESH),
    int(mujoco.mjtGeom.mjGEOM_SDF),
    int(mujoco.mjtGeom.mjGEOM_HFIELD),
)
"""Kinds of geoms that bring their size along, where others are one shape that is scaled."""

_BOX = ((1, 2), (0, 2), (0, 1))
"""The axes along a box's side, by the axis that it faces."""

Array = NDArray[np.float64]


def flat_places(model: mujoco.MjModel, geom: int, triangles: Array) -> Array:
    """Returns where the corners of triangles lie on a 2D texture.

    Args:
        model: The scene.
        geom: Index of a geom with a material.
        triangles: Of it, in its frame, (m, 3, 3) in m.

    Returns:
        u and v, (m, 3, 2).
    """
    kind, size = mujoco.mjtGeom(int(model.geom_type[geom])), half_sizes(model, geom)
    material = int(model.geom_matid[geom])
    repeat = np.asarray(model.mat_texrepeat[material], dtype=np.float64)
    is_endless = kind == mujoco.mjtGeom.mjGEOM_PLANE and not size[:2].all()
    is_by_length = bool(model.mat_texuniform[material])
    if int(kind) in _AS_IT_IS or is_endless:
        mesh = int(model.geom_dataid[geom])
        if kind == mujoco.mjtGeom.mjGEOM_MESH and model.mesh_texcoordadr[mesh] >= 0:
            return (repeat * size[:2] if is_by_length else repeat) * _brought_along(model, mesh)
        scale = repeat if is_by_length or is_endless else repeat / size[:2]
        return np.asarray(0.5 * scale * (1.0, -1.0) * triangles[..., :2] - 0.5)
    if is_by_length:
        repeat = repeat * size[:2]
    if kind == mujoco.mjtGeom.mjGEOM_PLANE:
        size = np.maximum(size, 1.0)  # it has no height
        size[:2] = model.geom_size[geom][:2]
    return repeat * _once(kind, triangles / size)


def around_places(model: mujoco.MjModel, geom: int, triangles: Array) -> Array:
    """Returns where the corners of triangles lie on a cube texture; see ``flat_places``."""
    material = int(model.geom_matid[geom])
    size = np.maximum(half_sizes(model, geom), 1e-15)
    seen = triangles if int(model.geom_type[geom]) in _AS_IT_IS else triangles / size
    if model.mat_texuniform[material]:
        seen = seen * size
    middle = seen.mean(axis=1)
    axis = np.abs(middle).argmax(axis=1)
    places = np.zeros((len(seen), 3, 2))
    for number, (facing, sign, right, down) in enumerate(_CUBE):
        mine = (axis == facing) & (np.sign(middle[:, facing]) == sign)
        depth = np.maximum(np.abs(seen[mine][..., facing]), 1e-15)
        for column, (along, way) in enumerate((right, down)):
            place = 0.5 + 0.5 * way * seen[mine][..., along] / depth
            places[mine, :, column] = np.clip(place, _EDGE, 1.0 - _EDGE)
        places[mine, :, 1] = (places[mine, :, 1] + number) / SIDES
    return places


def half_sizes(model: mujoco.MjModel, geom: int) -> Array:
    """Returns a geom's half sizes in m, (3,); 0 where a plane has no end."""
    kind, size = int(model.geom_type[geom]), np.array(model.geom_size[geom], dtype=np.float64)
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return np.full(3, size[0])
    if kind in (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER):
        return np.array([size[0], size[0], size[1]])
    return size


def _brought_along(model: mujoco.MjModel, mesh: int) -> Array:
    first, count = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
    start, number = int(model.mesh_texcoordadr[mesh]), int(model.mesh_texcoordnum[mesh])
    faces = model.mesh_facetexcoord[first : first + count]
    return np.asarray(model.mesh_texcoord[start : start + number][faces], dtype=np.float64)


def _once(kind: mujoco.mjtGeom, q: Array) -> Array:
    """Returns places for a picture that is there once."""
    across = np.cross(q[:, 1] - q[:, 0], q[:, 2] - q[:, 0])
    faces = np.abs(across).argmax(axis=1)
    if kind in (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_BOX):
        along = np.array(_BOX)[faces]
        u, v = (np.take_along_axis(q, along[:, None, column, None], axis=2) for column in (0, 1))
        return np.concatenate([0.5 * (1.0 + u), 0.5 * (1.0 - v)], axis=2)
    turn = _turns(q)
    if kind in (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_ELLIPSOID):
        return np.stack([turn, np.arccos(np.clip(q[..., 2], -1.0, 1.0)) / np.pi], axis=2)
    side = np.stack([turn, 0.5 * (1.0 - q[..., 2])], axis=2)
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        is_end = np.abs(across[:, 2]) > 0.5 * np.linalg.norm(across, axis=1)
        end = 0.5 * (1.0 + q[..., :2])
    else:
        middle = q[..., 2].mean(axis=1)
        is_end = np.abs(middle) > 1.0
        # the angle to the axis, from how far a corner is from it; the lower end counts on from 1
        angle = np.arcsin(np.clip(np.linalg.norm(q[..., :2], axis=2), 0.0, 1.0)) * 2.0 / np.pi
        end = np.stack([turn, np.where(middle[:, None] > 0, angle, 1.0 - angle)], axis=2)
    return np.where(is_end[:, None, None], end, side)


def _turns(q: Array) -> Array:
    """Returns how far around the axis corners are, in turns, without a jump in any triangle."""
    turn = np.arctan2(q[..., 1], q[..., 0]) / (2.0 * np.pi) % 1.0
    is_pole = np.hypot(q[..., 0], q[..., 1]) < 1e-6
    turn = np.where(
        (turn.max(axis=1) - turn.min(axis=1) > 0.5)[:, None] & (turn < 0.5), turn + 1.0, turn
    )
    others = np.where(is_pole, 0.0, turn).sum(axis=1) / np.maximum((~is_pole).sum(axis=1), 1)
    return np.where(is_pole, others[:, None], turn)
