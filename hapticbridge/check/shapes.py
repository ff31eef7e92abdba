"""Simplifications of shapes: fewer hull corners, primitives, no visual geoms."""

from __future__ import annotations

from pathlib import PurePath

import mujoco
import numpy as np

from hapticbridge.check.draft import Draft, model_of
from hapticbridge.check.frames import IDENTITY, matrix_of, quaternion_of
from hapticbridge.check.primitive import Primitive, best_primitive
from hapticbridge.check.simplifications import PICTURE, Simplification, collides, paired_geoms

HULL_CORNERS = (64, 32, 16, 8)
"""Numbers of corners to which convex hulls are limited in turn."""


def shape_simplifications() -> list[Simplification]:
    """Returns simplifications of shapes; masses and inertias stay as compiled."""
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
    left.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    left.discard_visual()  # keeps geoms that sensors, tendons and other elements refer to
    kept = {geom.name for geom in left.geoms}
    dropped = [geom for geom in spec.geoms if geom.name not in kept]
    _keep_inertia(spec, {geom.parent.name for geom in dropped})
    for geom in dropped:
        spec.delete(geom)
    return bool(dropped)


def _hull(count: int) -> Simplification:
    def limit(draft: Draft) -> bool:
        spec = draft.spec
        corners = _hull_corners(spec)
        meshes = [mesh for mesh in spec.meshes if corners.get(_name(mesh), 0) > count]
        changed = {_name(mesh) for mesh in meshes}
        _keep_inertia(spec, {geom.parent.name for geom in spec.geoms if geom.meshname in changed})
        for mesh in meshes:
            mesh.maxhullvert = count
        return bool(meshes)

    return Simplification(
        f"hulls of {count}", f"meshes that collide keep {count} corners of their hull", limit
    )


def _hull_corners(spec: mujoco.MjSpec) -> dict[str, int]:
    meshes = {geom.meshname for geom in _mesh_geoms(spec)}
    if not meshes:
        return {}
    model = model_of(spec)
    adr = {name: int(model.mesh_graphadr[model.mesh(name).id]) for name in meshes}
    # a graph begins with its number of corners
    return {name: int(model.mesh_graph[start]) for name, start in adr.items() if start >= 0}


def _mesh_geoms(spec: mujoco.MjSpec) -> list[mujoco.MjsGeom]:
    paired = paired_geoms(spec)
    return [
        geom
        for geom in spec.geoms
        if geom.type == mujoco.mjtGeom.mjGEOM_MESH and (collides(geom) or geom.name in paired)
    ]


def _name(mesh: mujoco.MjsMesh) -> str:
    """Returns a mesh's name; an unnamed mesh has the name of its file."""
    return str(mesh.name or PurePath(str(mesh.file).replace("\\", "/")).stem)


def _fit_primitives(draft: Draft) -> bool:
    spec = draft.spec
    names = [geom.name for geom in _mesh_geoms(spec)]
    if not names:
        return False
    _keep_inertia(spec, {spec.geom(name).parent.name for name in names})
    model = model_of(spec)
    fits = {name: _fit(model, name) for name in names}
    for name in names:
        geom = spec.geom(name)
        geom.type, geom.size = fits[name].kind, fits[name].size
        _remove_mesh(spec, geom)
        geom.pos, geom.quat = np.zeros(3), IDENTITY
        geom.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    for mesh in [mesh for mesh in spec.meshes if not _is_used(spec, mesh)]:
        spec.delete(mesh)
    # the pose of a geom written in a frame is relative to that frame
    frames = model_of(spec)
    for name in names:
        geom, at = spec.geom(name), frames.geom(name).id
        turn = matrix_of(frames.geom_quat[at])
        geom.pos = turn.T @ (fits[name].position - frames.geom_pos[at])
        geom.quat = quaternion_of(turn.T @ fits[name].axes)
    return True


def _remove_mesh(spec: mujoco.MjSpec, geom: mujoco.MjsGeom) -> None:
    """Removes the mesh from a geom and from its classes, which would restore it in a file."""
    geom.meshname = ""
    for default in (geom.classname, spec.default):
        if default is not None:
            default.geom.meshname = ""


def _is_used(spec: mujoco.MjSpec, mesh: mujoco.MjsMesh) -> bool:
    return any(geom.meshname == _name(mesh) for geom in spec.geoms)


def _fit(model: mujoco.MjModel, name: str) -> Primitive:
    """Fits a mesh geom in its body's frame, along the mesh's own axes and its axes of inertia."""
    geom = model.geom(name).id
    mesh = int(model.geom_dataid[geom])
    start, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
    inertia = matrix_of(model.geom_quat[geom])
    points = np.asarray(model.mesh_vert[start : start + count], np.float64) @ inertia.T
    own = inertia @ matrix_of(model.mesh_quat[mesh]).T
    return best_primitive(points + model.geom_pos[geom], (own, inertia))


def _keep_inertia(spec: mujoco.MjSpec, bodies: set[str]) -> None:
    """Writes down the compiled inertia of bodies that take it from their geoms.

    MuJoCo's ``adopt_inertial`` refuses a scene whose geoms overrule written inertias.
    """
    compiler, model = spec.compiler, model_of(spec)
    is_forced = compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    if is_forced or compiler.settotalmass > 0:  # overruled or scaled together
        bodies = {body.name for body in spec.bodies}
        compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    unwritten = mujoco.MjSpec().worldbody.add_body()
    for body in spec.bodies:
        at = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, body.name)
        if body.name not in bodies or at <= 0 or not model.body_mass[at]:
            continue
        body.explicitinertial, body.mass = True, model.body_mass[at]
        body.ipos, body.iquat = model.body_ipos[at], model.body_iquat[at]
        body.inertia, body.fullinertia = model.body_inertia[at], unwritten.fullinertia
        body.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
