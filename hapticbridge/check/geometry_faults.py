"""Faults of sizes and shapes: units, filled holes, a distant grip, a small device."""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.check.case import (
    CompiledScene,
    Fault,
    SceneUnderCheck,
    length,
    number,
    weight,
)
from hapticbridge.check.inventory import VISUAL, geom_uses
from hapticbridge.check.source_map import Place
from hapticbridge.scene.physics import (
    mesh_of,
)

UNITS = "units"
"""Kind of the fault of a tool whose sizes or masses no hand could hold."""


LARGEST_TOOL, HEAVIEST_TOOL = 3.0, 50.0
"""Length in m and mass in kg above which no hand holds a tool, so that wrong units are
suspected."""


NARROWEST_RANGE = np.radians(np.pi)
"""Range of a hinge in rad up to which radians read as degrees are suspected: ±π/2 written so. A
hinge that truly turns less is rarely given limits."""


WIDEST_TURN = 8 * np.pi
"""Limit of a hinge in rad beyond which degrees read as radians are suspected: four turns to a side,
more than any hand makes."""


DEEPEST_DENT = 0.02
"""Depth of a mesh's dent below its convex hull, relative to the mesh's largest extent, without
unit. Rounding of vertices and facets stays far below it."""


FARTHEST_GRIP = 1.0
"""Distance from the grip to the tool's centre of mass, relative to the tool's largest extent,
without unit. A grip on the tool itself is at most at 1."""


_AT_ONCE = 1000  # triangles per block; about 100 MB with a hull of 10 000 facets


_SMALLEST_EXTENT = 1e-3  # m; a grip nearer than this counts as on the tool


def unit_faults(case: CompiledScene) -> Iterator[Fault]:
    """Yields a tool that no hand could hold: its units are probably wrong."""
    model = case.model
    tool_bodies = case.tool_bodies
    mass, extent = float(model.body_mass[tool_bodies].sum()), float(_tool_extent(case).max())
    found = []
    if extent > LARGEST_TOOL:
        found.append(f"is {length(extent)} long")
    if mass > HEAVIEST_TOOL:
        found.append(f"weighs {weight(mass)}")
    if not found:
        return
    meshes = [
        int(model.geom_dataid[geom])
        for geom in range(model.ngeom)
        if tool_bodies[model.geom_bodyid[geom]]
        and model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH
    ]
    body = int(model.body_rootid[model.site(case.scene.grip).bodyid[0]])
    place = case.places.mesh(meshes[0]) if meshes else case.places.body(body)
    change = 'scale="0.001 0.001 0.001"' if meshes else "its sizes and positions in m, kg"
    yield Fault(
        UNITS,
        place,
        f"the tool {' and '.join(found)}: are these millimetres or grams? MuJoCo counts in m and "
        "kg",
        change,
    )


def angle_faults(case: CompiledScene) -> Iterator[Fault]:
    """Yields ranges of hinges whose unit is not that of the compiler."""
    model, is_degree = case.model, bool(case.source.spec.compiler.degree)
    for joint in range(model.njnt):
        is_hinge = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE
        if not is_hinge or not model.jnt_limited[joint]:
            continue
        low, high = (float(limit) for limit in model.jnt_range[joint])
        place = case.places.joint(joint)
        if is_degree and high - low <= NARROWEST_RANGE:
            written = f"{number(np.degrees(low))} to {number(np.degrees(high))}"
            yield Fault(
                "angle unit",
                place,
                f"{place.element} turns from {written} degrees; are these radians?",
                '<compiler angle="radian"/> in <mujoco>',
            )
        elif not is_degree and max(abs(low), abs(high)) > WIDEST_TURN:
            yield Fault(
                "angle unit",
                place,
                f"{place.element} turns from {number(low)} to {number(high)} radians, which is "
                f"{number(max(abs(low), abs(high)) / (2 * np.pi))} turns; are these degrees?",
                'a range in radians, or <compiler angle="degree"/> in <mujoco>',
            )


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
        place = case.places.geom(geom)
        mesh_place = case.places.mesh(mesh)
        more = f" and {number(1e6 * filled)} cm³ of air are filled" if filled > 0 else ""
        yield Fault(
            "mesh not convex",
            place,
            f"{place.element} collides with {mesh_place.element} ({mesh_place.file}:"
            f"{mesh_place.line}), which is not convex: MuJoCo takes its hull, so that a dent or "
            f"hole {length(dent)} deep is closed{more}",
            'contype="0" conaffinity="0", and convex pieces or primitives that collide instead',
        )


def dent_of(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> tuple[float, float]:
    """Returns the depth of a mesh's dents below its convex hull, and the volume they hold.

    Args:
        vertices: Shape (n, 3), in m.
        faces: Shape (m, 3).

    Returns:
        Depth in m of the triangle centre that lies deepest inside the hull, and volume of the hull
        minus that of the mesh in m³. The volume is 0 for a surface that is not closed.
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
    """Yields a grip far from the tool."""
    model, scene = case.model, case.scene
    scene.reset()
    site = model.site(scene.grip).id
    tool_bodies, body = case.tool_bodies, int(model.site_bodyid[site])
    mass = model.body_mass[tool_bodies]
    if not mass.sum() > 0:  # it has no centre, and another fault says so
        return
    centre = mass @ scene.data.xipos[tool_bodies] / mass.sum()
    grip = scene.data.site_xpos[site]
    distance = float(np.linalg.norm(grip - centre))
    extent = max(float(np.linalg.norm(_tool_extent(case))), _SMALLEST_EXTENT)
    if distance <= FARTHEST_GRIP * extent:
        return
    rotation = scene.data.xmat[body].reshape(3, 3)
    offset = np.round(rotation.T @ (centre - scene.data.xpos[body]), 6) + 0.0  # no -0
    local = " ".join(f"{v:.4g}" for v in offset)
    place = case.places.site(site)
    yield Fault(
        "far grip",
        place,
        f"{place.element}, the grip, is {length(distance)} from the tool's centre of mass, "
        f"and the tool is {length(extent)} large: every push turns it about a point in the "
        "air",
        f'pos="{local}" (the centre of mass)',
    )


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


def _tool_extent(case: CompiledScene) -> NDArray[np.float64]:
    """Returns the edges in m of the axis-aligned box around the tool's geoms at the start."""
    model, scene = case.model, case.scene
    scene.reset()
    tool_bodies = case.tool_bodies
    corners = []
    for geom in range(model.ngeom):
        if (
            tool_bodies[model.geom_bodyid[geom]]
            and model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_PLANE
        ):
            centre, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
            rotation = scene.data.geom_xmat[geom].reshape(3, 3)
            middle = scene.data.geom_xpos[geom] + rotation @ centre
            reach = np.abs(rotation) @ half
            corners += [middle - reach, middle + reach]
    return np.ptp(corners, axis=0) if corners else np.zeros(3)
