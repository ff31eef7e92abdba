"""The bodies of a MuJoCo scene as triangles, with their materials."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image

from hapticbridge.view.skin import Skin, is_around, skin_of
from hapticbridge.view.terrain import stride_of, terrain

SHOWN_GROUPS = 3
"""Geoms of the groups below are shown, as MuJoCo does: the others are for collision alone."""

PLANE_SIDE = 4.0
"""Times the scene's extent: how large a plane without end is drawn."""

LEAST_TRIANGLES = 2000
"""Of a geom with a cube texture, each of whose triangles shows but one of the cube's sides."""

CREASE = 40.0
"""In degrees: triangles that meet at more than that show an edge; at less, a round surface."""

_CREASE_COSINE = float(np.cos(np.radians(CREASE)))


@dataclass(frozen=True, slots=True)
class Prop:
    """A geom that can be drawn.

    Attributes:
        body: Index of the body that it moves with.
        place: In the body's frame, (3,) in m.
        turn: Likewise, a quaternion (4,).
        triangles: Shape (m, 3, 3) in m.
        normals: Of their corners, (m, 3, 3).
        skin: How it looks.
    """

    body: int
    place: NDArray[np.float64]
    turn: NDArray[np.float64]
    triangles: NDArray[np.float64]
    normals: NDArray[np.float64]
    skin: Skin

    def glb(self) -> bytes:
        """Returns it as a file that browsers draw (binary glTF)."""
        skin, has_glass = self.skin, self.skin.opacity < 1.0
        uv = skin.places.reshape(-1, 2) * (1.0, -1.0) + (0.0, 1.0)  # trimesh counts v upwards
        material = trimesh.visual.material.PBRMaterial(
            baseColorTexture=Image.fromarray(skin.image),
            roughnessFactor=skin.roughness,
            metallicFactor=skin.metallic,
            doubleSided=True,
            alphaMode="BLEND" if has_glass else "OPAQUE",
        )
        mesh = trimesh.Trimesh(
            vertices=self.triangles.reshape(-1, 3),
            faces=np.arange(3 * len(self.triangles)).reshape(-1, 3),
            vertex_normals=self.normals.reshape(-1, 3),
            visual=trimesh.visual.TextureVisuals(uv=uv, material=material),
            process=False,
        )
        return bytes(mesh.export(file_type="glb", include_normals=True))


def props_of(model: mujoco.MjModel) -> list[Prop]:
    """Returns the geoms that are seen of a scene."""
    props = []
    for geom in range(model.ngeom):
        if model.geom_group[geom] >= SHOWN_GROUPS:
            continue
        shape = _shape(model, geom)
        corners, faces = np.asarray(shape[0], np.float64), np.asarray(shape[1], np.int64)
        triangles = corners[faces]
        normals = _normals(faces, triangles)
        if is_around(model, geom):
            while len(triangles) < LEAST_TRIANGLES:
                triangles, normals = _quartered(triangles), _quartered(normals)
        skin = skin_of(model, geom, triangles)
        if skin.opacity == 0.0:
            continue
        props.append(
            Prop(
                body=int(model.geom_bodyid[geom]),
                place=model.geom_pos[geom].copy(),
                turn=model.geom_quat[geom].copy(),
                triangles=triangles,
                normals=normals,
                skin=skin,
            )
        )
    return props


def _quartered(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns four triangles for each, (4 m, 3, 3)."""
    middles = 0.5 * (corners + np.roll(corners, -1, axis=1))
    parts = [np.stack([corners[:, n], middles[:, n], middles[:, n - 1]], axis=1) for n in range(3)]
    return np.concatenate([*parts, middles])


def _normals(faces: NDArray[np.int64], triangles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the normals of the triangles' corners: of the surface there, but at edges."""
    across = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    flat = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-30)
    # every pair of triangles' corners that are at the same place
    at = faces.ravel()
    order, counts = np.argsort(at, kind="stable"), np.bincount(at)
    many = counts[at]
    one = np.repeat(np.arange(len(at)), many)
    number = np.arange(len(one)) - np.repeat(np.cumsum(many) - many, many)
    other = order[(np.cumsum(counts) - counts)[at[one]] + number]
    is_round = np.einsum("ij,ij->i", flat[one // 3], flat[other // 3]) > _CREASE_COSINE
    summed = np.zeros((len(at), 3))
    np.add.at(summed, one[is_round], across[other[is_round] // 3])
    length = np.linalg.norm(summed, axis=1, keepdims=True)
    return np.asarray(summed / np.maximum(length, 1e-30)).reshape(triangles.shape)


def _shape(model: mujoco.MjModel, geom: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    kind, size = mujoco.mjtGeom(int(model.geom_type[geom])), model.geom_size[geom]
    if kind == mujoco.mjtGeom.mjGEOM_HFIELD:
        field = int(model.geom_dataid[geom])
        corners = terrain(model, field, stride_of(model, field)).reshape(-1, 3)
        # every triangle by itself: the tool feels its facets, too
        return corners, np.arange(len(corners)).reshape(-1, 3)
    if kind in (mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtGeom.mjGEOM_SDF):
        # a signed distance field's is what MuJoCo found where the distance is 0
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
    return np.asarray(made.vertices), np.asarray(made.faces)


def _primitive(kind: mujoco.mjtGeom, size: NDArray[np.float64]) -> trimesh.Trimesh:
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return trimesh.creation.box(extents=2 * size)
    if kind in (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_ELLIPSOID):
        ball = trimesh.creation.icosphere(subdivisions=3)
        ball.apply_scale(size if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID else size[0])
        return ball
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        capsule = trimesh.creation.capsule(height=2 * size[1], radius=size[0], count=(32, 32))
        capsule.apply_translation(-capsule.bounds.mean(axis=0))
        return capsule
    return trimesh.creation.cylinder(radius=size[0], height=2 * size[1], sections=32)
