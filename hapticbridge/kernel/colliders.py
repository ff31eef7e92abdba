"""Functions of the bridge in MuJoCo's table of collision functions.

A contact law at the level of velocities needs two things: gaps that change continuously with the
pose, and normals that are the gradients of these gaps. MuJoCo's own functions give both for
spheres, planes, and capsules on boxes. These pairs are replaced here:

- Two boxes: MuJoCo drops points from step to step (``box_contact``).
- A capsule on a mesh, a cylinder on a box or a mesh: normal and face are right, but the lowest
  point of the round shape is missing, so gaps are up to 0.13 mm too large. The nearest point that
  was found is moved to the support point p of the round shape along the normal n,

      p = c + sgn(n·u) l u + r n              capsule
      p = c + sgn(n·u) l u + r m              cylinder

  with centre c, axis u, half-length l, radius r, and m the direction of n across the axis.
- A mesh on a mesh or a box: all points take the normal of one of the two faces, up to 84 mrad off
  the face that is touched, and the lowest corner may be missing. Of the normals that come into
  question the one with the largest gap between the bodies' support points is right. The points'
  gaps are taken along it, and the nearest is moved to the lowest corner.

A point is moved only onto the other body's face.

The table ``mjCOLLISIONFUNC`` is one for the whole process. The functions act on models with the bit
``EXACT_POINTS`` in ``opt.enableflags``, which MuJoCo does not use; copies of a model and its binary
form keep it. For all other models they call MuJoCo's functions. They have no state of their own, so
threads may step models together.

Not corrected, as measured at a margin of 0.15 mm: a round shape that lies along a face and sticks
out beside it, 18 mrad and 54 µm at an axis tilted by 37 mrad; corners of meshes across an edge,
with which a peg sank 0.4 mm; ellipsoids, within 1 µm.
"""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Any

import mujoco
import numpy as np

from hapticbridge.errors import SceneError
from hapticbridge.kernel.box_contact import (
    MAX_POINTS,
    POINT,
    Numbers,
    box_points,
    placed,
    turned,
    turned_back,
)
from hapticbridge.kernel.jit import callback, compiled, external
from hapticbridge.kernel.mujoco_c import floats, ints, library_path, pointer_at, singles, struct_of

EXACT_POINTS = 1 << 30
"""Bit of ``opt.enableflags`` that selects these functions."""

_MODEL, _DATA = struct_of("mjModel"), struct_of("mjData")
_FLAGS = _MODEL.opt.offset + struct_of("mjOption").enableflags.offset
_TYPES, _SIZES = _MODEL.geom_type.offset, _MODEL.geom_size.offset
_MESHES, _VERTICES, _NORMALS = (
    _MODEL.geom_dataid.offset,
    _MODEL.mesh_vert.offset,
    _MODEL.mesh_polynormal.offset,
)
_FIRST_VERTEX, _VERTEX_COUNT = _MODEL.mesh_vertadr.offset, _MODEL.mesh_vertnum.offset
_CORNER, _CORNERS = _MODEL.mesh_polyvertadr.offset, _MODEL.mesh_polyvert.offset
_FIRST_FACE, _FACE_COUNT = _MODEL.mesh_polyadr.offset, _MODEL.mesh_polynum.offset
_PLACES, _TURNS = _DATA.geom_xpos.offset, _DATA.geom_xmat.offset

_CAPSULE = int(mujoco.mjtGeom.mjGEOM_CAPSULE)
_CYLINDER = int(mujoco.mjtGeom.mjGEOM_CYLINDER)
_BOX, _MESH = int(mujoco.mjtGeom.mjGEOM_BOX), int(mujoco.mjtGeom.mjGEOM_MESH)

MAX_VERTICES = 128
"""Largest number of vertices or faces of a mesh whose points are corrected. The time grows with it:
about 0.1 µs for 8 vertices, 1 µs for 100."""

ALIGNED = 0.98
"""Cosine of the angle between the normal that was found and that of a face, above which the face is
tried: 0.2 rad."""

ROUNDING = 1e-9
"""Difference of gaps in m that counts as rounding; meshes have vertices of single precision."""

BESIDE = 1e-6
"""Length in m by which a vertex may lie beside a face and still be on it: single precision."""

_SIGNATURE = "int32(intp, intp, intp, int32, int32, float64)"
_mjc_box_box: Any = external("mjc_BoxBox", _SIGNATURE)
_mjc_convex: Any = external("mjc_Convex", _SIGNATURE)

C_TYPES = ("i64", "i64", "i64", "i32", "i32", "double")
"""Arguments of ``mjfCollision``: model, data, points, two geoms, margin."""


@compiled
def _shape(model: int, data: int, geom: int) -> tuple[Numbers, Numbers, Numbers]:
    """Returns position, axes by rows and sizes of a geom."""
    return (
        floats(pointer_at(data + _PLACES) + 24 * geom, 3),
        floats(pointer_at(data + _TURNS) + 72 * geom, 9),
        floats(pointer_at(model + _SIZES) + 24 * geom, 3),
    )


@compiled
def box_box(model: int, data: int, contacts: int, first: int, second: int, margin: float) -> int:
    """Finds the contact points of two boxes, as an ``mjfCollision`` (addresses as integers).

    Returns:
        The number of points, written to ``contacts``.
    """
    if not ints(model + _FLAGS, 1)[0] & EXACT_POINTS:
        return int(_mjc_box_box(model, data, contacts, first, second, margin))
    points = floats(contacts, POINT * MAX_POINTS)
    return box_points(points, _shape(model, data, first), _shape(model, data, second), margin)


@compiled
def round_flat(model: int, data: int, contacts: int, first: int, second: int, margin: float) -> int:
    """Finds the contact points of a capsule or cylinder with a box or mesh, as ``box_box``."""
    count = int(_mjc_convex(model, data, contacts, first, second, margin)) + 0  # 64 bits
    if count == 0 or not ints(model + _FLAGS, 1)[0] & EXACT_POINTS:
        return count
    points = floats(contacts, POINT * count)
    lowest = 0
    for k in range(1, count):
        if points[POINT * k] < points[POINT * lowest]:
            lowest = k
    at = POINT * lowest
    x, y, z = points[at + 4], points[at + 5], points[at + 6]
    # the face's plane: n·q of the point that was found, on the face
    plane = x * points[at + 1] + y * points[at + 2] + z * points[at + 3] + 0.5 * points[at]
    place, turn, size = _shape(model, data, first)
    ux, uy, uz = turn[2], turn[5], turn[8]
    along = x * ux + y * uy + z * uz
    half = np.copysign(size[1], along)
    mx, my, mz = x, y, z
    if ints(pointer_at(model + _TYPES) + 4 * first, 1)[0] == _CYLINDER:
        mx, my, mz = x - along * ux, y - along * uy, z - along * uz
        across = np.sqrt(mx * mx + my * my + mz * mz)
        if across < 1e-9:  # the cap lies flat, and every point of its rim is as low
            return count
        mx, my, mz = mx / across, my / across, mz / across
    px = place[0] + half * ux + size[0] * mx
    py = place[1] + half * uy + size[0] * my
    pz = place[2] + half * uz + size[0] * mz
    gap = plane - (x * px + y * py + z * pz)
    if gap < points[at] - ROUNDING:
        # a round shape that lies along the face may have its lowest point beside it
        flat, shape = _flat(model, second), _shape(model, data, second)
        if _is_inside(model, second, flat, shape, (px + gap * x, py + gap * y, pz + gap * z)):
            _move_nearest(points, count, gap, (px, py, pz), (x, y, z))
    return count


@compiled
def _move_nearest(points: Numbers, count: int, gap: float, p: Any, n: Any) -> None:
    """Moves the nearest point to p on the first geom, with its gap in m and the normal n."""
    nearest, least = 0, np.inf
    for k in range(count):
        one = POINT * k
        x, y, z = points[one + 1] - p[0], points[one + 2] - p[1], points[one + 3] - p[2]
        distance = x * x + y * y + z * z
        if distance < least:
            nearest, least = one, distance
    points[nearest] = gap
    for i in range(3):
        points[nearest + 1 + i] = p[i] + 0.5 * gap * n[i]
        points[nearest + 4 + i] = n[i]


@compiled
def _flat(model: int, geom: int) -> tuple[int, int, int, int]:
    """Returns the vertices of a mesh and their number, the normals of its faces and their number.

    They are addresses; a box has 0 for each.
    """
    if ints(pointer_at(model + _TYPES) + 4 * geom, 1)[0] == _BOX:
        return 0, 0, 0, 0
    mesh = ints(pointer_at(model + _MESHES) + 4 * geom, 1)[0]
    vertices = pointer_at(model + _VERTICES)
    vertices += 12 * ints(pointer_at(model + _FIRST_VERTEX) + 4 * mesh, 1)[0]
    faces = pointer_at(model + _NORMALS)
    faces += 24 * ints(pointer_at(model + _FIRST_FACE) + 4 * mesh, 1)[0]
    return (
        vertices,
        ints(pointer_at(model + _VERTEX_COUNT) + 4 * mesh, 1)[0],
        faces,
        ints(pointer_at(model + _FACE_COUNT) + 4 * mesh, 1)[0],
    )


@compiled
def _farthest(numbers: Any, count: int, n: Any) -> int:
    """Returns the address of the vector with the largest component along n."""
    best, far = 0, -np.inf
    for k in range(0, 3 * count, 3):
        one = n[0] * numbers[k] + n[1] * numbers[k + 1] + n[2] * numbers[k + 2]
        if one > far:
            best, far = k, one
    return best


@compiled
def _support(flat: Any, shape: Any, n: Any) -> tuple[float, float, float, float]:
    """Returns the largest n·v of a box's or mesh's vertices v, and v, in the world."""
    (vertices, count, _, _), (place, turn, size) = flat, shape
    u, v, w = turned_back(turn, n)
    if vertices == 0:
        x, y, z = np.copysign(size[0], u), np.copysign(size[1], v), np.copysign(size[2], w)
    else:
        numbers = singles(vertices, 3 * count)
        k = _farthest(numbers, count, (u, v, w))
        x, y, z = float(numbers[k]), float(numbers[k + 1]), float(numbers[k + 2])
    px, py, pz = placed(place, turn, x, y, z)
    return n[0] * px + n[1] * py + n[2] * pz, px, py, pz


@compiled
def _face_along(flat: Any, shape: Any, n: Any) -> tuple[float, float, float]:
    """Returns the normal, in the world, of the face of a box or mesh that is closest to n."""
    (_, _, faces, count), (_, turn, _) = flat, shape
    u, v, w = turned_back(turn, n)
    x, y, z = 0.0, 0.0, 0.0
    if faces == 0:
        if abs(u) >= abs(v) and abs(u) >= abs(w):
            x = np.copysign(1.0, u)
        elif abs(v) >= abs(w):
            y = np.copysign(1.0, v)
        else:
            z = np.copysign(1.0, w)
    else:
        numbers = floats(faces, 3 * count)
        k = _farthest(numbers, count, (u, v, w))
        x, y, z = numbers[k], numbers[k + 1], numbers[k + 2]
    return turned(turn, x, y, z)


@compiled
def flat_flat(model: int, data: int, contacts: int, first: int, second: int, margin: float) -> int:
    """Finds the contact points of a box or mesh with a mesh, as ``box_box``."""
    count = int(_mjc_convex(model, data, contacts, first, second, margin)) + 0  # 64 bits
    if count == 0 or not ints(model + _FLAGS, 1)[0] & EXACT_POINTS:
        return count
    one, other = _flat(model, first), _flat(model, second)
    if max(one[1], other[1], one[3], other[3]) > MAX_VERTICES:
        return count
    a, b = _shape(model, data, first), _shape(model, data, second)
    points = floats(contacts, POINT * count)
    found = points[4], points[5], points[6]
    # the normal with the largest gap of the two bodies: as found, or of either body's face
    x, y, z = _face_along(other, b, (-found[0], -found[1], -found[2]))
    normals = found, _face_along(one, a, found), (-x, -y, -z)
    n, choice, largest = found, 0, -np.inf
    for k in range(3):
        m = normals[k]
        if m[0] * found[0] + m[1] * found[1] + m[2] * found[2] < ALIGNED:
            continue
        gap = -_support(other, b, (-m[0], -m[1], -m[2]))[0] - _support(one, a, m)[0]
        if gap > largest + ROUNDING:
            n, choice, largest = m, k, gap
    top, px, py, pz = _support(one, a, n)
    minus_bottom, qx, qy, qz = _support(other, b, (-n[0], -n[1], -n[2]))
    lowest = np.inf
    for k in range(count):
        at = POINT * k
        if choice > 0:
            half = 0.5 * points[at] if choice == 1 else -0.5 * points[at]
            along = n[0] * points[at + 1] + n[1] * points[at + 2] + n[2] * points[at + 3]
            along += half * (n[0] * points[at + 4] + n[1] * points[at + 5] + n[2] * points[at + 6])
            gap = along - top if choice == 1 else -minus_bottom - along
            for i in range(3):
                # from the middle to the body with the vertex, and half the new gap back
                surface = points[at + 1 + i] + half * points[at + 4 + i]
                points[at + 1 + i] = surface + (-0.5 if choice == 1 else 0.5) * gap * n[i]
                points[at + 4 + i] = n[i]
            points[at] = gap
        lowest = min(lowest, points[at])
    if choice == 0 or largest >= lowest - ROUNDING:
        return count
    # the lowest vertex is on the other body's face, unless it lies beside it
    if choice == 1:
        px, py, pz = qx - largest * n[0], qy - largest * n[1], qz - largest * n[2]
        is_on_face = _is_inside(model, first, one, a, (px, py, pz))
    else:
        q = px + largest * n[0], py + largest * n[1], pz + largest * n[2]
        is_on_face = _is_inside(model, second, other, b, q)
    if is_on_face:
        _move_nearest(points, count, largest, (px, py, pz), n)
    return count


@compiled
def _is_inside(model: int, geom: int, flat: Any, shape: Any, p: Any) -> bool:
    """Returns True if a point in the world is in a box or mesh, or beside it by rounding."""
    (vertices, _, faces, count), (place, turn, size) = flat, shape
    u, v, w = turned_back(turn, (p[0] - place[0], p[1] - place[1], p[2] - place[2]))
    if faces == 0:
        return bool(max(abs(u) - size[0], abs(v) - size[1], abs(w) - size[2]) < BESIDE)
    mesh = ints(pointer_at(model + _MESHES) + 4 * geom, 1)[0]
    first = ints(pointer_at(model + _FIRST_FACE) + 4 * mesh, 1)[0]
    corner = ints(pointer_at(model + _CORNER) + 4 * first, count)
    corners = pointer_at(model + _CORNERS)
    normals = floats(faces, 3 * count)
    for k in range(count):
        on_face = singles(vertices + 12 * ints(corners + 4 * corner[k], 1)[0], 3)
        gap = normals[3 * k] * (u - on_face[0]) + normals[3 * k + 1] * (v - on_face[1])
        if gap + normals[3 * k + 2] * (w - on_face[2]) >= BESIDE:
            return False
    return True


# The table, and the models that use these functions


def _replacement(first: int, second: int) -> Any:
    """Returns the function that takes a pair's place in the table."""
    if first == second == _BOX:
        return box_box
    return round_flat if first in (_CAPSULE, _CYLINDER) else flat_flat


_PAIRS = (
    (_BOX, _BOX),
    (_CAPSULE, _MESH),
    (_CYLINDER, _BOX),
    (_CYLINDER, _MESH),
    (_BOX, _MESH),
    (_MESH, _MESH),
)


@cache
def _install(first: int, second: int) -> None:
    """Puts the function of a pair into MuJoCo's table, once in a process."""
    library = ctypes.CDLL(str(library_path()))
    kinds = int(mujoco.mjtGeom.mjNGEOMTYPES)
    table = (ctypes.c_void_p * kinds**2).in_dll(library, "mjCOLLISIONFUNC")
    stock = library.mjc_BoxBox if first == second == _BOX else library.mjc_Convex
    if table[kinds * first + second] != ctypes.cast(stock, ctypes.c_void_p).value:
        raise SceneError(
            "another program has replaced MuJoCo's collision functions in this process; run "
            "without it, or choose contact 'scene'"
        )
    table[kinds * first + second] = _address(_replacement(first, second))


@cache
def _address(function: Any) -> int:
    return callback(function, *C_TYPES)


def install(model: mujoco.MjModel) -> None:
    """Puts the functions that a model's shapes need into MuJoCo's table.

    Raises:
        SceneError: Another program has put a function of its own into the table.
    """
    counts = np.bincount(model.geom_type, minlength=int(mujoco.mjtGeom.mjNGEOMTYPES))
    for first, second in _PAIRS:
        if counts[first] and counts[second] > (first == second):
            _install(first, second)


def use_exact_points(model: mujoco.MjModel, *, is_used: bool = True) -> None:
    """Selects these functions or MuJoCo's for a model, in all its data.

    Raises:
        SceneError: As ``install``.
    """
    if is_used:
        install(model)
        model.opt.enableflags |= EXACT_POINTS
    else:
        model.opt.enableflags &= ~EXACT_POINTS


def bind_colliders(model: mujoco.MjModel) -> bool:
    """Installs the functions if a model uses them, as a model from a recording may.

    Returns:
        True if the model uses them.

    Raises:
        SceneError: As ``install``.
    """
    is_used = bool(model.opt.enableflags & EXACT_POINTS)
    if is_used:
        install(model)
    return is_used
