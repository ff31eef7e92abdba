"""Functions of the bridge in MuJoCo's table of collision functions.

A contact law that acts on velocities needs gaps that change continuously with the pose and normals
that are the gaps' gradients. MuJoCo's own functions keep this for spheres, planes, and capsules on
boxes. Two pairs are replaced here:

- Two boxes: MuJoCo drops points from step to step (``box_contact``).
- A capsule on a mesh, a cylinder on a box or a mesh: normal and face are right, but the lowest
  point of the round shape is missing, so gaps are up to 0.13 mm too large. The nearest point that
  was found is moved to the support point p of the round shape along the normal n,

      p = c + sgn(n·u) l u + r n              capsule
      p = c + sgn(n·u) l u + r m              cylinder

  with centre c, axis u, half-length l, radius r, and m the direction of n across the axis.

The table ``mjCOLLISIONFUNC`` is one for the whole process. The functions act on models with the bit
``EXACT_POINTS`` in ``opt.enableflags``, which MuJoCo does not use; copies of a model and its binary
form keep it. For all other models they call MuJoCo's functions. They have no state of their own, so
threads may step models together.

Not replaced, with the errors that were measured at a margin of 0.15 mm: meshes on meshes and on
boxes take the normal of either face (up to 84 mrad off, gaps 7 µm), and ellipsoids are within 1 µm.
"""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Any

import mujoco
import numpy as np

from hapticbridge.errors import SceneError
from hapticbridge.jit import callback, compiled, external
from hapticbridge.kernel.box_contact import MOST_POINTS, POINT, Numbers, box_points
from hapticbridge.kernel.mujoco_c import floats, ints, library_path, pointer_at, struct_of

EXACT_POINTS = 1 << 30
"""Bit of ``opt.enableflags`` that selects these functions."""

_MODEL, _DATA = struct_of("mjModel"), struct_of("mjData")
_FLAGS = _MODEL.opt.offset + struct_of("mjOption").enableflags.offset
_TYPES, _SIZES = _MODEL.geom_type.offset, _MODEL.geom_size.offset
_PLACES, _TURNS = _DATA.geom_xpos.offset, _DATA.geom_xmat.offset

_CAPSULE = int(mujoco.mjtGeom.mjGEOM_CAPSULE)
_CYLINDER = int(mujoco.mjtGeom.mjGEOM_CYLINDER)
_BOX, _MESH = int(mujoco.mjtGeom.mjGEOM_BOX), int(mujoco.mjtGeom.mjGEOM_MESH)

_SIGNATURE = "int32(intp, intp, intp, int32, int32, float64)"
_mjc_box_box: Any = external("mjc_BoxBox", _SIGNATURE)
_mjc_convex: Any = external("mjc_Convex", _SIGNATURE)

_C_TYPES = ("i64", "i64", "i64", "i32", "i32", "double")
"""Arguments of ``mjfCollision``: model, data, points, two geoms, margin."""


@compiled
def _placed(model: int, data: int, geom: int) -> tuple[Numbers, Numbers, Numbers]:
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
    points = floats(contacts, POINT * MOST_POINTS)
    return box_points(points, _placed(model, data, first), _placed(model, data, second), margin)


@compiled
def round_flat(model: int, data: int, contacts: int, first: int, second: int, margin: float) -> int:
    """Finds the contact points of a capsule or cylinder with a box or mesh, as ``box_box``."""
    count = int(_mjc_convex(model, data, contacts, first, second, margin))
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
    place, turn, size = _placed(model, data, first)
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
    if gap >= points[at]:
        return count
    nearest, least = 0, np.inf
    for k in range(count):
        one = POINT * k
        dx, dy, dz = points[one + 1] - px, points[one + 2] - py, points[one + 3] - pz
        distance = dx * dx + dy * dy + dz * dz
        if distance < least:
            nearest, least = POINT * k, distance
    points[nearest] = gap
    points[nearest + 1] = px + 0.5 * gap * x
    points[nearest + 2] = py + 0.5 * gap * y
    points[nearest + 3] = pz + 0.5 * gap * z
    points[nearest + 4], points[nearest + 5], points[nearest + 6] = x, y, z
    return count


# The table, and the models that use these functions


@cache
def install() -> None:
    """Puts the functions into MuJoCo's table, once in a process.

    Raises:
        SceneError: Another program has put a function of its own into the table.
    """
    library = ctypes.CDLL(str(library_path()))
    kinds = int(mujoco.mjtGeom.mjNGEOMTYPES)
    table = (ctypes.c_void_p * kinds**2).in_dll(library, "mjCOLLISIONFUNC")
    entries = {
        (_BOX, _BOX): (library.mjc_BoxBox, box_box),
        (_CAPSULE, _MESH): (library.mjc_Convex, round_flat),
        (_CYLINDER, _BOX): (library.mjc_Convex, round_flat),
        (_CYLINDER, _MESH): (library.mjc_Convex, round_flat),
    }
    for (first, second), (stock, _) in entries.items():
        if table[kinds * first + second] != ctypes.cast(stock, ctypes.c_void_p).value:
            raise SceneError(
                "another program has replaced MuJoCo's collision functions in this process; run "
                "without it, or choose contact 'scene'"
            )
    addresses = {each: callback(each, *_C_TYPES) for each in (box_box, round_flat)}
    for (first, second), (_, function) in entries.items():
        table[kinds * first + second] = addresses[function]


def use_exact_points(model: mujoco.MjModel, *, is_used: bool = True) -> None:
    """Selects these functions or MuJoCo's for a model, in all its data.

    Raises:
        SceneError: As ``install``.
    """
    if is_used:
        install()
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
        install()
    return is_used
