"""A peg and hole that model far more than the hand can feel."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.scene import SceneSource, read_scene

GRID = 9

VISUALS = 40
ITERATIONS = 100


def over_modelled_peg(bulge: float = 1e-5) -> SceneSource:
    """Returns peg_in_hole with meshes for boxes, six contact dimensions and a solver at full tilt.

    Args:
        bulge: How far the middle of each face stands out, in m: it makes every vertex a corner of
            the convex hull.
    """
    source = read_scene("peg_in_hole")
    spec: Any = source.spec.copy()
    for geom in [geom for geom in spec.geoms if geom.contype]:
        vertices, faces = tessellated_box(geom.size, bulge)
        mesh = spec.add_mesh(name=f"{geom.name}_mesh")
        mesh.uservert, mesh.userface = vertices.ravel(), faces.ravel()
        geom.type, geom.meshname, geom.size = mujoco.mjtGeom.mjGEOM_MESH, mesh.name, np.zeros(3)
        geom.condim, geom.friction = 6, np.array([0.42, 1e-4, 1e-5])
    for k in range(VISUALS):
        owner = spec.body("peg") if k % 2 else spec.worldbody
        rivet = owner.add_geom(name=f"rivet_{k}", type=mujoco.mjtGeom.mjGEOM_SPHERE)
        rivet.size, rivet.pos = np.array([0.002, 0.0, 0.0]), np.array([1e-3 * k, 0.05, 0.0])
        rivet.contype = rivet.conaffinity = 0
        rivet.mass = 0.0
    spec.option.iterations, spec.option.tolerance = ITERATIONS, 0.0
    return replace(source, spec=spec)


def tessellated_box(
    half: NDArray[np.float64], bulge: float
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Returns vertices (n, 3) and triangles (``TRIANGLES``, 3) of a box with bulging faces."""
    steps = np.linspace(-1.0, 1.0, GRID + 1)
    u, v = np.meshgrid(steps, steps, indexing="ij")
    corner = np.arange((GRID + 1) ** 2).reshape(GRID + 1, GRID + 1)
    a, b, c, d = corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]
    quads = np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)
    vertices: list[NDArray[np.float64]] = []
    faces: list[NDArray[np.intp]] = []
    for axis in range(3):
        for side in (-1.0, 1.0):
            point = np.zeros((*u.shape, 3))
            point[..., (axis + 1) % 3], point[..., (axis + 2) % 3] = u, v
            point[..., axis] = side
            point *= half
            point[..., axis] += side * bulge * (1 - u**2) * (1 - v**2)
            faces.append((quads if side > 0 else quads[:, ::-1]) + len(faces) * u.size)
            vertices.append(point.reshape(-1, 3))
    unique, index = np.unique(np.round(np.vstack(vertices), 12), axis=0, return_inverse=True)
    return unique.astype(np.float64), index.reshape(-1)[np.vstack(faces)].astype(np.intp)
