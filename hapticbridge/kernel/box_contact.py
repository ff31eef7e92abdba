"""Contact of two boxes by vertices on faces and edges across edges.

MuJoCo's own function for two boxes drops points from step to step. This one returns every pair of
features that can touch next, each with a gap and the gap's gradient as its normal:

    vertex p of one box, face of the other    g = n·p − s          (s: half-size along n)
    vertex, edge or vertex                    g = |p − c|          (c: closest point)
    edge a, edge b                            g = n·(b − a), n = ±(u × v)/|u × v|

A pair counts only if its normal lies in the normal cones of both features, within ``CONE``: all of
one box is then on one side of the point and all of the other box on the other side. That is the
condition for a face of the boxes' Minkowski difference. A vertex below a face takes the face of
least depth that meets it; a vertex past the middle of a thin plate therefore leaves the way that it
came. A pair deeper than twice the boxes' depth of penetration does not count. Gaps change
continuously with the pose, and no pair appears that is already deep.

References:
    Gottschalk, S.: Collision queries using oriented bounding boxes, PhD thesis, UNC 2000.
    Gregorius, D.: The separating axis test between convex polyhedra, GDC 2013.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticbridge.kernel.jit import compiled, stack_floats
from hapticbridge.kernel.mujoco_c import floats
from hapticbridge.kernel.rigid_contact import MARGIN

CONE = 0.02
"""Angle in rad by which a normal may lie outside a feature's normal cone. Faces that lie on each
other within this angle keep all their points, so a point is known before the faces are parallel. A
larger angle adds points that do not touch soon, each a row of the solver. Bodies with a margin
that their speed widens by m (``contact_margins.follow_speed``) turn by up to m/r in a step, r being
the radius of the smaller one, and count within that angle, up to ``WIDEST``."""

WIDEST = 0.5
"""Largest angle in rad of a normal beside its feature's cone. Beyond it every face would count. A
box that turns by more in a step may be first seen in penetration."""

PARALLEL = 1e-4
"""Sine of the angle of two edges below which their crossing is not used, without unit. Along the
shorter of the boxes' longest edges, of length l, such edges part by l ``PARALLEL``. That is how far
a vertex may lie beside a face and still rest on it: 10 µm for boxes of 0.1 m."""

TIE = 1e-6
"""Largest depth in m that a point may have beyond twice the boxes' own depth. It keeps all points
of faces that rest on each other. Small boxes have l ``PARALLEL`` instead."""

NEAR = 5e-5
"""Largest distance in m below which two points with about equal normals count as one; the deeper
stays. Boxes thinner than 1 mm have ``NEARNESS`` of their smallest half-size instead."""

NEARNESS = 0.1
"""Share of a box's smallest half-size below which its points count as one, without unit."""

ALIKE = 0.9999
"""Cosine of the angle of two normals above which they count as equal, without unit."""

MAX_POINTS = 8
"""Largest number of points of a pair; MuJoCo stops with an error at more. Two faces on each other
have at most 8 in common. Of more points those with the smallest gaps stay."""

POINT = 10
"""Numbers of an ``mjPreContact``: gap, position, normal, tangent."""

# Scratch memory of a pair: rotation between the boxes by rows, its transpose, then the two centres
# and half-sizes, each in the frame of the other box or its own.
_R, _BACK, _T, _U, _A, _B, _SCRATCH = 0, 9, 18, 21, 24, 27, 30

_scratch = stack_floats(_SCRATCH)
_normals = stack_floats(9 * 6)

Numbers = NDArray[np.float64]
Limits = tuple[float, float, float, float, float]
"""Smallest and largest gap in m, angle of the normal cones in rad, length in m by which a vertex
may lie beside a face, and distance in m below which points count as one."""


@compiled
def _add(points: Numbers, count: int, gap: float, p: Any, n: Any, near: float) -> int:
    """Adds a point with position p and normal n in the world; returns the number of points.

    Points within a distance ``near`` in m of it, with about its normal, count as one.
    """
    at, worst = -1, gap
    for k in range(count):
        one = POINT * k
        x, y, z = points[one + 1] - p[0], points[one + 2] - p[1], points[one + 3] - p[2]
        if x * x + y * y + z * z < near * near:
            alike = points[one + 4] * n[0] + points[one + 5] * n[1] + points[one + 6] * n[2]
            if alike > ALIKE:
                if gap >= points[one]:
                    return count
                _write(points, one, gap, p, n)
                return count
        if points[one] > worst:
            at, worst = one, points[one]
    if count < MAX_POINTS:
        _write(points, POINT * count, gap, p, n)
        return count + 1
    if at >= 0:
        _write(points, at, gap, p, n)
    return count


@compiled
def _write(points: Numbers, at: int, gap: float, p: Any, n: Any) -> None:
    points[at] = gap
    for i in range(3):
        points[at + 1 + i] = p[i]
        points[at + 4 + i] = n[i]
        points[at + 7 + i] = 0.0  # MuJoCo chooses the tangent


@compiled
def turned(turn: Numbers, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Returns a vector of a frame with the given axes (by rows of the world's) in the world."""
    return (
        turn[0] * x + turn[1] * y + turn[2] * z,
        turn[3] * x + turn[4] * y + turn[5] * z,
        turn[6] * x + turn[7] * y + turn[8] * z,
    )


@compiled
def turned_back(turn: Numbers, v: Any) -> tuple[float, float, float]:
    """Returns a vector of the world in the frame with the given axes, the inverse of ``turned``."""
    return (
        turn[0] * v[0] + turn[3] * v[1] + turn[6] * v[2],
        turn[1] * v[0] + turn[4] * v[1] + turn[7] * v[2],
        turn[2] * v[0] + turn[5] * v[1] + turn[8] * v[2],
    )


@compiled
def placed(place: Numbers, turn: Numbers, x: float, y: float, z: float) -> Any:
    """Returns a point of a frame in the world."""
    p = turned(turn, x, y, z)
    return place[0] + p[0], place[1] + p[1], place[2] + p[2]


@compiled
def _vertices(
    points: Numbers,
    count: int,
    boxes: tuple[Numbers, Numbers, Numbers, Numbers],
    frame: tuple[Numbers, Numbers, float],
    limits: Limits,
) -> int:
    """Adds the vertices of a box that are near another one.

    Args:
        points: Points found so far.
        count: Their number.
        boxes: Axes of the vertices' box in the other's frame by rows, its centre there in m, and
            the half-sizes of the other box and of the vertices' box in m.
        frame: Position and axes of the other box in the world, and the sign of the normal.
        limits: As ``Limits``.

    Returns:
        The new number of points.
    """
    (r, t, s, o), (place, turn, sign), (least, margin, cone, beside, near) = boxes, frame, limits
    for corner in range(8):
        c0 = 1.0 if corner & 1 else -1.0
        c1 = 1.0 if corner & 2 else -1.0
        c2 = 1.0 if corner & 4 else -1.0
        x, y, z = c0 * o[0], c1 * o[1], c2 * o[2]
        px = t[0] + r[0] * x + r[1] * y + r[2] * z
        fx = abs(px) - s[0]
        if fx >= margin:
            continue
        py = t[1] + r[3] * x + r[4] * y + r[5] * z
        fy = abs(py) - s[1]
        if fy >= margin:
            continue
        pz = t[2] + r[6] * x + r[7] * y + r[8] * z
        fz = abs(pz) - s[2]
        if fz >= margin:
            continue
        if (fx > 0.0) + (fy > 0.0) + (fz > 0.0) >= 2:
            # beside an edge or a vertex: the closest point, if the vertex's cone has the normal
            ex = np.copysign(max(fx, 0.0), px)
            ey = np.copysign(max(fy, 0.0), py)
            ez = np.copysign(max(fz, 0.0), pz)
            if _inward(r, (c0, c1, c2), (ex, ey, ez)) <= 0.0:
                gap = np.sqrt(ex * ex + ey * ey + ez * ez)
                if gap < margin:
                    p = placed(place, turn, px - 0.5 * ex, py - 0.5 * ey, pz - 0.5 * ez)
                    up = sign / gap
                    n = turned(turn, up * ex, up * ey, up * ez)
                    count = _add(points, count, gap, p, n, near)
                continue
        face, side, gap = _face(r, (c0, c1, c2), (px, py, pz), (fx, fy, fz), (least, cone, beside))
        if gap >= least and gap < margin:
            half = 0.5 * gap * side
            p = placed(
                place,
                turn,
                px - (half if face == 0 else 0.0),
                py - (half if face == 1 else 0.0),
                pz - (half if face == 2 else 0.0),
            )
            up = sign * side
            n = (up * turn[face], up * turn[3 + face], up * turn[6 + face])
            count = _add(points, count, gap, p, n, near)
    return count


@compiled
def _inward(r: Numbers, corner: Any, n: Any) -> float:
    """Returns the largest component against n of the edges that leave a vertex of a box.

    The box, with axes r (by rows) and the vertex at the signs ``corner``, lies on the side of n of
    a plane through the vertex if the result is 0 or less.
    """
    largest: float = max(
        corner[0] * (r[0] * n[0] + r[3] * n[1] + r[6] * n[2]),
        corner[1] * (r[1] * n[0] + r[4] * n[1] + r[7] * n[2]),
        corner[2] * (r[2] * n[0] + r[5] * n[1] + r[8] * n[2]),
    )
    return largest


@compiled
def _face(r: Numbers, corner: Any, p: Any, f: Any, limits: Any) -> tuple[int, float, float]:
    """Returns the face that a vertex is on: axis, side (±1), and gap in m, −inf without a face.

    It is the face of largest gap, that is of least depth, whose normal is in the vertex's cone.

    Args:
        r: Axes of the vertex's box by rows.
        corner: Signs of the vertex.
        p: The vertex.
        f: Its gaps to the nearer face along each axis, in m.
        limits: Smallest gap in m at which a far face counts, the angle of the cone in rad, and the
            length in m by which the vertex may lie beside a face.
    """
    least, cone, lateral = limits
    gap, face, side = -np.inf, 0, 1.0
    for i in range(3):
        if i == 0:
            q, near, beside = p[0], f[0], max(f[1], f[2])
        elif i == 1:
            q, near, beside = p[1], f[1], max(f[0], f[2])
        else:
            q, near, beside = p[2], f[2], max(f[0], f[1])
        if beside > lateral:
            continue
        up = 1.0 if q >= 0.0 else -1.0
        c0, c1, c2 = corner[0] * r[3 * i], corner[1] * r[3 * i + 1], corner[2] * r[3 * i + 2]
        if near > gap and max(up * c0, up * c1, up * c2) <= cone:
            gap, face, side = near, i, up
        # the far face, by which a vertex leaves that is past the middle of a thin plate
        far = near - 2.0 * abs(q)
        if far > gap and far >= least and min(up * c0, up * c1, up * c2) >= -cone:
            gap, face, side = far, i, -up
    return face, side, gap


@compiled
def _separation(s: Numbers, normals: Numbers) -> float:
    """Returns the largest gap of two boxes along the 15 axes that can separate them, in m.

    It is a lower bound of the distance; below 0 it is minus the depth of penetration.

    Args:
        s: Scratch memory of the pair.
        normals: Place for each pair of axes: components of n = ±(e_i × v_j), from the first box to
            the second, along the next two axes of the first and of the second box; 1/|e_i × v_j|²;
            and the gap along n in m, −inf for parallel axes.
    """
    r, back, t, u = s[_R : _R + 9], s[_BACK : _BACK + 9], s[_T : _T + 3], s[_U : _U + 3]
    a, b = s[_A : _A + 3], s[_B : _B + 3]
    largest = -np.inf
    for i in range(3):
        q = 3 * i
        reach = abs(r[q]) * b[0] + abs(r[q + 1]) * b[1] + abs(r[q + 2]) * b[2]
        largest = max(largest, abs(t[i]) - a[i] - reach)
        reach = abs(back[q]) * a[0] + abs(back[q + 1]) * a[1] + abs(back[q + 2]) * a[2]
        largest = max(largest, abs(u[i]) - b[i] - reach)
    for i in range(3):
        k, m = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            o, q, one = (j + 1) % 3, (j + 2) % 3, 6 * (3 * i + j)
            nk, nm = -r[3 * m + j], r[3 * k + j]
            square = nk * nk + nm * nm
            normals[one + 5] = -np.inf
            if square < PARALLEL * PARALLEL:
                continue
            scale = np.copysign(1.0 / np.sqrt(square), nk * t[k] + nm * t[m])
            nk *= scale
            nm *= scale
            no = nk * r[3 * k + o] + nm * r[3 * m + o]
            nq = nk * r[3 * k + q] + nm * r[3 * m + q]
            gap = nk * t[k] + nm * t[m]
            gap -= abs(nk) * a[k] + abs(nm) * a[m] + abs(no) * b[o] + abs(nq) * b[q]
            normals[one], normals[one + 1], normals[one + 2], normals[one + 3] = nk, nm, no, nq
            normals[one + 4], normals[one + 5] = 1.0 / square, gap
            largest = max(largest, gap)
    return largest


@compiled
def _edges(
    points: Numbers,
    s: Numbers,
    normals: Numbers,
    frame: tuple[Numbers, Numbers],
    limits: Limits,
) -> int:
    """Adds the crossings of edges of two boxes.

    Args:
        points: Place for the points.
        s: Scratch memory of the pair.
        normals: Normals of the pairs of axes, from ``_separation``.
        frame: Position and axes of the first box in the world.
        limits: As ``Limits``.

    Returns:
        The number of points.
    """
    (place, turn), (least, margin, cone, _, near) = frame, limits
    r, t, a, b = s[_R : _R + 9], s[_T : _T + 3], s[_A : _A + 3], s[_B : _B + 3]
    count = 0
    for pair in range(9):
        one, i, j = 6 * pair, pair // 3, pair % 3
        nk, nm, no, nq = normals[one], normals[one + 1], normals[one + 2], normals[one + 3]
        inverse, gap = normals[one + 4], normals[one + 5]
        k, m, o, q = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
        # with a component within the cone's tolerance, the edges on both sides count
        wide = (abs(nk) <= cone) | (abs(nm) <= cone) << 1
        wide |= (abs(no) <= cone) << 2 | (abs(nq) <= cone) << 3
        if gap == -np.inf or (wide == 0 and gap < least):
            continue
        for other in range(16):
            if other & ~wide:
                continue
            ak = np.copysign(a[k], -nk if other & 1 else nk)
            am = np.copysign(a[m], -nm if other & 2 else nm)
            bo = np.copysign(b[o], no if other & 4 else -no)
            bq = np.copysign(b[q], nq if other & 8 else -nq)
            # from the middle of the first edge to the middle of the second
            xk = t[k] + bo * r[3 * k + o] + bq * r[3 * k + q] - ak
            xm = t[m] + bo * r[3 * m + o] + bq * r[3 * m + q] - am
            gap = nk * xk + nm * xm
            if not (gap >= least and gap < margin):
                continue
            xi = t[i] + bo * r[3 * i + o] + bq * r[3 * i + q]
            cosine = r[3 * i + j]
            along = xi * cosine + xk * r[3 * k + j] + xm * r[3 * m + j]
            u = (xi - cosine * along) * inverse
            if abs(u) > a[i] or abs(cosine * xi - along) * inverse > b[j]:
                continue
            pk, pm = ak + 0.5 * gap * nk, am + 0.5 * gap * nm
            if i == 0:
                p, n = placed(place, turn, u, pk, pm), turned(turn, 0.0, nk, nm)
            elif i == 1:
                p, n = placed(place, turn, pm, u, pk), turned(turn, nm, 0.0, nk)
            else:
                p, n = placed(place, turn, pk, pm, u), turned(turn, nk, nm, 0.0)
            count = _add(points, count, gap, p, n, near)
    return count


@compiled
def box_points(
    points: Numbers, one: tuple[Numbers, Numbers, Numbers], other: Any, margin: float
) -> int:
    """Finds the contact points of two boxes.

    Args:
        points: Place for ``MAX_POINTS`` of 10 numbers: the gap in m, the position half-way, the
            normal from the first box to the second, and zeros.
        one: Position, axes by rows (9 numbers) and half-sizes of the first box.
        other: Those of the second box.
        margin: Gap in m below which points count.

    Returns:
        The number of points.
    """
    (place1, turn1, a), (place2, turn2, b) = one, other
    s = floats(_scratch(), _SCRATCH)
    x, y, z = place2[0] - place1[0], place2[1] - place1[1], place2[2] - place1[2]
    for i in range(3):
        for j in range(3):
            dot = turn1[i] * turn2[j] + turn1[3 + i] * turn2[3 + j] + turn1[6 + i] * turn2[6 + j]
            s[_R + 3 * i + j] = s[_BACK + 3 * j + i] = dot
        s[_T + i] = turn1[i] * x + turn1[3 + i] * y + turn1[6 + i] * z
        s[_U + i] = -(turn2[i] * x + turn2[3 + i] * y + turn2[6 + i] * z)
        s[_A + i], s[_B + i] = a[i], b[i]
    normals = floats(_normals(), 9 * 6)
    largest = _separation(s, normals)
    if largest >= margin:
        return 0
    square = min(a[0] ** 2 + a[1] ** 2 + a[2] ** 2, b[0] ** 2 + b[1] ** 2 + b[2] ** 2)
    cone = min(max(CONE, (margin - 2.0 * MARGIN) / np.sqrt(square)), WIDEST)
    beside = 2.0 * PARALLEL * min(max(a[0], a[1], a[2]), max(b[0], b[1], b[2]))
    near = min(NEAR, NEARNESS * min(a[0], a[1], a[2], b[0], b[1], b[2]))
    limits = (min(2.0 * largest, 0.0) - min(TIE, beside), margin, cone, beside, near)
    count = _edges(points, s, normals, (place1, turn1), limits)
    first = (s[_R : _R + 9], s[_T : _T + 3], a, b)
    second = (s[_BACK : _BACK + 9], s[_U : _U + 3], b, a)
    count = _vertices(points, count, first, (place1, turn1, 1.0), limits)
    return _vertices(points, count, second, (place2, turn2, -1.0), limits)
