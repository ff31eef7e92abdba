"""Faults of sizes and shapes: units, filled holes, a distant grip, a small device."""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.check.case import SceneUnderCheck
from hapticbridge.check.inventory import VISUAL, geom_uses
from hapticbridge.scene.fault import Fault, length, number
from hapticbridge.scene.first_faults import tool_extent
from hapticbridge.scene.handle import LET_GO
from hapticbridge.scene.physics import (
    mesh_of,
)
from hapticbridge.scene.source_map import Place

DEEPEST_DENT = 0.02
"""Depth of a mesh's dent below its convex hull, relative to the mesh's largest extent, without
unit. Rounding of vertices and facets stays far below it."""


FARTHEST_GRIP = 1.0
"""Distance from the grip to the tool's centre of mass, relative to the tool's largest extent,
without unit. A grip on the tool itself is at most at 1."""


_AT_ONCE = 1000  # triangles per block; about 100 MB with a hull of 10 000 facets


_MIN_EXTENT = 1e-3  # m; a grip nearer than this counts as on the tool

_NO_TURN = 1e-9
"""Angular acceleration in rad/s² by a push of 1 N that is rounding. A ton at 1 m makes 1e-3."""


def mesh_faults(case: SceneUnderCheck) -> Iterator[Fault]:
    """Yields colliding meshes that are not convex; MuJoCo collides their hulls."""
    model, uses = case.model, geom_uses(case.model)
    reported = set()
    for geom in range(model.ngeom):
        mesh = int(model.geom_dataid[geom])
        is_mesh = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH
        if not is_mesh or uses[geom] == VISUAL or mesh in reported:
            continue
        reported.add(mesh)
        vertices, faces = mesh_of(model, mesh)
        dent, filled = dent_of(vertices, faces)
        if dent <= DEEPEST_DENT * float(np.ptp(vertices, axis=0).max()):
            continue
        place = case.places.find("geom", geom)
        mesh_place = case.places.find("mesh", mesh)
        more = f" and {number(1e6 * filled)} cm³ of air are filled" if filled > 0 else ""
        yield Fault(
            "mesh not convex",
            place,
            f"{place.element} collides with {mesh_place.element} ({mesh_place.file}:"
            f"{mesh_place.line}), which is not convex: MuJoCo takes its hull, in which parts of "
            f"its surface lie {length(dent)} deep or deeper{more}",
            'contype="0" conaffinity="0", and convex pieces or primitives that collide instead',
        )


def dent_of(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> tuple[float, float]:
    """Returns a lower bound of a mesh's depth in its convex hull, and the volume of its dents.

    Args:
        vertices: Shape (n, 3), in m.
        faces: Shape (m, 3).

    Returns:
        Largest distance in m from a triangle's centre to the nearest face of the hull, and volume
        of the hull minus that of the mesh in m³. A cup 15 mm deep with a floor of 5 mm is 5 mm from
        the face below it. The volume is 0 for a surface that is not closed.
    """
    from scipy import spatial  # noqa: PLC0415 - for meshes alone; it is slow to import

    try:
        hull = spatial.ConvexHull(vertices)
    except (spatial.QhullError, ValueError):  # a flat mesh; MuJoCo gives it no volume either
        return 0.0, 0.0
    triangles = vertices[faces]
    dent = 0.0
    for centres in np.array_split(triangles.mean(axis=1), len(faces) // _AT_ONCE + 1):
        inside = -(centres @ hull.equations[:, :3].T + hull.equations[:, 3])
        dent = max(dent, float(inside.min(axis=1).max(initial=0.0)))
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    is_closed = np.all(np.unique(edges, axis=0, return_counts=True)[1] == 2)
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    volume = abs(float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum())) / 6.0
    return dent, float(hull.volume) - volume if is_closed else 0.0


def grip_faults(case: SceneUnderCheck) -> Iterator[Fault]:
    """Yields a grip that is held, or far from the tool."""
    model, scene = case.model, case.scene
    scene.reset()
    site = model.site(scene.grip).id
    for clause in scene.held:
        yield Fault("held grip", case.places.find("site", site), clause, LET_GO)
    tool_bodies, body = case.tool_bodies, int(model.site_bodyid[site])
    mass = model.body_mass[tool_bodies]
    size = float(np.linalg.norm(tool_extent(case)))
    if not mass.sum() > 0 or not size or tool_bodies[list(case.refused)].any():
        return  # it has no centre, and another fault says so, or no geom to be far from
    centre = mass @ scene.data.xipos[tool_bodies] / mass.sum()
    grip = scene.data.site_xpos[site]
    distance = float(np.linalg.norm(grip - centre))
    extent = max(size, _MIN_EXTENT)
    if distance <= FARTHEST_GRIP * extent or not _is_turned_by_pushes(model, scene.data, site):
        return
    rotation = scene.data.xmat[body].reshape(3, 3)
    offset = np.round(rotation.T @ (centre - scene.data.xpos[body]), 6) + 0.0  # no -0
    local = " ".join(f"{v:.4g}" for v in offset)
    place = case.places.find("site", site)
    yield Fault(
        "far grip",
        place,
        f"{place.element}, the grip, is {length(distance)} from the tool's centre of mass, "
        f"and the tool is {length(extent)} large: every push turns it about a point in the "
        "air",
        f'pos="{local}" (the centre of mass)',
    )


def _is_turned_by_pushes(model: mujoco.MjModel, data: mujoco.MjData, site: int) -> bool:
    """Returns True if a force of 1 N at a site turns a body that could move without turning.

    A body that cannot, such as a lever, turns about its hinges and not about a point in the air.
    """
    moved, turned, pushed = np.zeros((3, 3, model.nv))
    mujoco.mj_jacSite(model, data, moved, turned, site)
    mujoco.mj_solveM(model, data, pushed, moved)
    rank = np.linalg.matrix_rank
    is_lever = rank(np.vstack([moved, turned])) == rank(turned)
    return not is_lever and bool(np.abs(pushed @ turned.T).max() > _NO_TURN)


def workspace_faults(case: SceneUnderCheck) -> Iterator[Fault]:
    """Yields a motion that the device does not reach."""
    extent = float(np.ptp(case.motion.table[:, 1:4], axis=0).max()) / case.scale
    if extent <= case.workspace:
        return
    scale = case.scale * extent / case.workspace
    yield Fault(
        "workspace",
        Place(case.motion_name, 0, "the motion"),
        f"{case.motion_name} moves the handle by {length(extent * case.scale)}, which is "
        f"{length(extent)} of the device at scale {case.scale:g}; it reaches "
        f"{length(case.workspace)}",
        f"a smaller scene, or run it with --scale {np.ceil(100 * scale) / 100:g}",
    )
