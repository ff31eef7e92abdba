"""Simpler shapes: fewer corners of a mesh, a primitive in its place, nothing that is only seen."""

from __future__ import annotations

from pathlib import PurePath

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.check.draft import Draft
from hapticbridge.check.simplifications import PICTURE, Simplification, collides, paired_geoms

HULL_CORNERS = (64, 32, 16, 8)
"""Corners that a convex hull keeps at most, as tried."""

_GEOM = mujoco.mjtGeom
PRIMITIVES = (_GEOM.mjGEOM_BOX, _GEOM.mjGEOM_CYLINDER, _GEOM.mjGEOM_CAPSULE, _GEOM.mjGEOM_SPHERE)
"""What a mesh may become. An ellipsoid is left out: its contacts cost as much as a mesh's."""


def shape_simplifications() -> list[Simplification]:
    """Returns what may be left out of shapes; masses and inertias stay as they were compiled."""
    return [
        Simplification(
            "nothing only seen",
            "geoms that do not collide are left out; their mass stays",
            _drop_visual_geoms,
            loses=PICTURE,
        ),
        *(_hull(count) for count in HULL_CORNERS),
        Simplification(
            "primitives",
            "each mesh that collides becomes the primitive that fits it best",
            _fit_primitives,
        ),
    ]


def _drop_visual_geoms(draft: Draft) -> bool:
    spec = draft.spec
    left = spec.copy()
    left.discard_visual()  # knows what sensors, tendons and the like refer to
    kept = {geom.name for geom in left.geoms}
    dropped = [geom for geom in spec.geoms if geom.name not in kept]
    _keep_inertia(spec, {geom.parent.name for geom in dropped})
    for geom in dropped:
        spec.delete(geom)
    return bool(dropped)


def _hull(count: int) -> Simplification:
    def limit(draft: Draft) -> bool:
        spec = draft.spec
        corners = _hull_corners(draft)
        meshes = [mesh for mesh in spec.meshes if corners.get(_name(mesh), 0) > count]
        changed = {_name(mesh) for mesh in meshes}
        _keep_inertia(
            spec, {geom.parent.name for geom in spec.geoms if geom.meshname in changed}
        )
        for mesh in meshes:
            mesh.maxhullvert = count
        return bool(meshes)

    return Simplification(
        f"hulls of {count}", f"meshes that collide keep {count} corners of their hull", limit
    )


def _hull_corners(draft: Draft) -> dict[str, int]:
    """Returns how many corners the hulls of the colliding meshes have."""
    meshes = {geom.meshname for geom in _mesh_geoms(draft.spec)}
    if not meshes:
        return {}
    model = draft.compiled().model
    adr = {name: int(model.mesh_graphadr[model.mesh(name).id]) for name in meshes}
    # a graph begins with its number of corners
    return {name: int(model.mesh_graph[start]) for name, start in adr.items() if start >= 0}


def _mesh_geoms(spec: mujoco.MjSpec) -> list[mujoco.MjsGeom]:
    paired = paired_geoms(spec)
    return [
        geom
        for geom in spec.geoms
        if geom.type == _GEOM.mjGEOM_MESH and (collides(geom) or geom.name in paired)
    ]


def _name(mesh: mujoco.MjsMesh) -> str:
    """A mesh without a name is called as its file is."""
    return str(mesh.name or PurePath(str(mesh.file).replace("\\", "/")).stem)


def _fit_primitives(draft: Draft) -> bool:
    spec = draft.spec
    names = [geom.name for geom in _mesh_geoms(spec)]
    if not names:
        return False
    _keep_inertia(spec, {spec.geom(name).parent.name for name in names})
    model = draft.compiled().model
    corners = {name: _corners(model, name) for name in names}
    best = dict.fromkeys(names, (np.inf, PRIMITIVES[0]))
    for kind in PRIMITIVES:
        trial = draft.copy()
        for name in names:
            trial.spec.geom(name).type = kind
        fitted = trial.compiled().model
        for name in names:
            error = float(np.abs(_outside(fitted, name, kind, corners[name])).max())
            best[name] = min(best[name], (error, kind), key=lambda pair: pair[0])
    for name, (_, kind) in best.items():
        spec.geom(name).type = kind
    return True


def _corners(model: mujoco.MjModel, name: str) -> NDArray[np.float64]:
    """Returns the vertices of a mesh geom in its body's frame, in m."""
    geom = model.geom(name).id
    mesh = int(model.geom_dataid[geom])
    start, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
    vertices = np.asarray(model.mesh_vert[start : start + count], dtype=np.float64)
    return vertices @ _matrix(model.geom_quat[geom]).T + model.geom_pos[geom]


def _matrix(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)


def _outside(
    model: mujoco.MjModel, name: str, kind: mujoco.mjtGeom, points: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Returns how far points lie outside a primitive's surface, in m; negative inside."""
    geom = model.geom(name).id
    size = model.geom_size[geom]
    local = (points - model.geom_pos[geom]) @ _matrix(model.geom_quat[geom])
    if kind == _GEOM.mjGEOM_SPHERE:
        return np.asarray(np.linalg.norm(local, axis=1) - size[0])
    if kind == _GEOM.mjGEOM_CAPSULE:
        local[:, 2] -= np.clip(local[:, 2], -size[1], size[1])
        return np.asarray(np.linalg.norm(local, axis=1) - size[0])
    if kind == _GEOM.mjGEOM_CYLINDER:
        radial = np.linalg.norm(local[:, :2], axis=1) - size[0]
        beyond = np.stack([radial, np.abs(local[:, 2]) - size[1]], axis=1)
    else:
        beyond = np.abs(local) - size
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
    return np.asarray(outside + np.minimum(beyond.max(axis=1), 0.0))


def _keep_inertia(spec: mujoco.MjSpec, bodies: set[str]) -> None:
    """Writes down the inertia that some bodies have from their geoms."""
    compiler = spec.compiler
    if compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE:
        for body in spec.bodies:  # what stands there is overruled; what is adopted must not be
            body.explicitinertial = False
        compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    if compiler.settotalmass > 0:  # all are scaled together, so all must keep their proportion
        bodies = {body.name for body in spec.bodies}
    for body in spec.bodies:
        if body.name in bodies and body.parent is not None and body.name != "world":
            spec.adopt_inertial(body)
