"""The bodies of a MuJoCo scene as triangles, with their colours."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
import trimesh
from numpy.typing import NDArray

SHOWN_GROUPS = 3
"""Geoms of the groups below are shown, as MuJoCo does: the others are for collision alone."""

PLANE_SIDE = 4.0
"""Times the scene's extent: how large a plane without end is drawn."""

_GREY = np.array([0.5, 0.5, 0.5, 1.0])


@dataclass(frozen=True, slots=True)
class Prop:
    """A geom that can be drawn.

    Attributes:
        body: Index of the body that it moves with.
        place: In the body's frame, (3,) in m.
        turn: Likewise, a quaternion (4,).
        corners: Shape (n, 3) in m.
        faces: Indices into them, (m, 3).
        colour: Red, green, blue, 0 to 255.
        opacity: 0 to 1.
    """

    body: int
    place: NDArray[np.float64]
    turn: NDArray[np.float64]
    corners: NDArray[np.float32]
    faces: NDArray[np.uint32]
    colour: tuple[int, int, int]
    opacity: float


def props_of(model: mujoco.MjModel) -> list[Prop]:
    """Returns what is seen of a scene; height fields and signed distance fields are left out."""
    props = []
    for geom in range(model.ngeom):
        shape = _shape(model, geom)
        colour = _colour(model, geom)
        if shape is None or model.geom_group[geom] >= SHOWN_GROUPS or colour[3] == 0.0:
            continue
        red, green, blue = (round(255 * float(part)) for part in colour[:3])
        props.append(
            Prop(
                body=int(model.geom_bodyid[geom]),
                place=model.geom_pos[geom].copy(),
                turn=model.geom_quat[geom].copy(),
                corners=np.asarray(shape[0], dtype=np.float32),
                faces=np.asarray(shape[1], dtype=np.uint32),
                colour=(red, green, blue),
                opacity=float(colour[3]),
            )
        )
    return props


def _colour(model: mujoco.MjModel, geom: int) -> NDArray[np.float64]:
    own, material = model.geom_rgba[geom], int(model.geom_matid[geom])
    is_own = material < 0 or not np.allclose(own, _GREY)
    return np.asarray(own if is_own else model.mat_rgba[material], dtype=np.float64)


def _shape(
    model: mujoco.MjModel, geom: int
) -> tuple[NDArray[np.float64], NDArray[np.int64]] | None:
    kind, size = mujoco.mjtGeom(int(model.geom_type[geom])), model.geom_size[geom]
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = int(model.geom_dataid[geom])
        first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
        start, faces = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
        return model.mesh_vert[first : first + count], model.mesh_face[start : start + faces]
    if kind == mujoco.mjtGeom.mjGEOM_PLANE:
        side = PLANE_SIDE * model.stat.extent
        x, y = (size[axis] or 0.5 * side for axis in (0, 1))
        return np.array([[x, y, 0], [-x, y, 0], [-x, -y, 0], [x, -y, 0]]), np.array(
            [[0, 1, 2], [0, 2, 3]]
        )
    made = _primitive(kind, size)
    return None if made is None else (np.asarray(made.vertices), np.asarray(made.faces))


def _primitive(kind: mujoco.mjtGeom, size: NDArray[np.float64]) -> trimesh.Trimesh | None:
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return trimesh.creation.box(extents=2 * size)
    if kind in (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_ELLIPSOID):
        ball = trimesh.creation.icosphere(subdivisions=3)
        ball.apply_scale(size if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID else size[0])
        return ball
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        capsule = trimesh.creation.capsule(height=2 * size[1], radius=size[0], count=(16, 16))
        capsule.apply_translation(-capsule.bounds.mean(axis=0))
        return capsule
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return trimesh.creation.cylinder(radius=size[0], height=2 * size[1], sections=32)
    return None
