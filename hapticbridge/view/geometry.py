"""Shapes that the page draws: bodies as triangles, tendons as lines, the coupling as a spring.

Bodies have one colour each. ``NOT_DRAWN`` lists the further elements of MuJoCo's own viewer.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import trimesh
from numpy.typing import NDArray

from hapticbridge.errors import RecordingError
from hapticbridge.run.summary import is_always_implicit
from hapticbridge.scene.physics import matrix_of, mesh_of

Array = NDArray[np.float64]

SHOWN_GROUPS = 3
"""Number of geom groups that are drawn, from 0. MuJoCo hides the others, which only collide."""

NOT_DRAWN = (
    f"Not drawn: textures, flexes, skins, sites, sensors' beams, and groups from {SHOWN_GROUPS} on."
)
"""Sentence on the page about elements that are not drawn."""

PLANE_SIDE = 4.0
"""Side of an infinite plane as a multiple of the scene's extent. A larger one costs nothing. Its
edge is the horizon of a camera that is moved far away."""

CREASE = math.radians(40.0)
"""Angle in rad between triangles beyond which their edge is drawn sharp. Below it a surface is
drawn round."""

MAX_SAMPLES = 200
"""Largest number of samples of a height field along a side that are drawn. 200 make 80 000
triangles, some 2 MB that a browser loads once. A finer field is drawn with every second, third …
sample."""

MAX_PIECES = 10_000
"""Largest number of straight pieces of all tendons, as in MuJoCo's own renderer. A tendon around a
pulley has about ten."""

MAX_TIMES = 500
"""Largest enlargement of the coupling's stretch. Beyond it noise would shake the spring."""

SHELL = 0.012
"""Distance of the ghost's surface from the tool, as a share of the scene's extent. Nearer it
flickers, farther it looks like another tool."""

TURNS, POINTS = 8, 64
"""Turns of the drawn spring, and number of straight pieces of its line."""

_GREY = np.array([0.5, 0.5, 0.5, 1.0])  # MuJoCo's default colour of a geom


@dataclass(frozen=True, slots=True)
class Prop:
    """A geom that can be drawn.

    Attributes:
        body: Index of its body.
        place: Position in the body's frame, (3,) in m.
        turn: Orientation in the body's frame, a quaternion (4,).
        mesh: Its surface in m, split at sharp edges.
        colour: Red, green, blue and opacity, 0 to 1, (4,).
    """

    body: int
    place: Array
    turn: Array
    mesh: trimesh.Trimesh
    colour: Array


def props_of(model: mujoco.MjModel) -> list[Prop]:
    """Returns the visible geoms of a scene."""
    props = []
    for geom in range(model.ngeom):
        colour = _colour(model, geom)
        if model.geom_group[geom] >= SHOWN_GROUPS or colour[3] == 0.0:
            continue
        corners, faces = _shape(model, geom)
        mesh = trimesh.Trimesh(np.asarray(corners, np.float64), faces, process=False)
        props.append(
            Prop(
                body=int(model.geom_bodyid[geom]),
                place=model.geom_pos[geom].copy(),
                turn=model.geom_quat[geom].copy(),
                mesh=trimesh.graph.smooth_shade(mesh, angle=CREASE),
                colour=colour,
            )
        )
    return props


def _colour(model: mujoco.MjModel, geom: int) -> Array:
    """Returns a geom's own colour, or its material's; for a texture the mean."""
    own, material = model.geom_rgba[geom], int(model.geom_matid[geom])
    is_own = material < 0 or not np.allclose(own, _GREY)
    colour = np.array(own if is_own else model.mat_rgba[material], dtype=np.float64)
    texture = -1 if material < 0 else int(model.mat_texid[material].max())
    if texture >= 0:
        channels, first = int(model.tex_nchannel[texture]), int(model.tex_adr[texture])
        size = int(model.tex_height[texture]) * int(model.tex_width[texture])
        texels = model.tex_data[first : first + size * channels].reshape(size, channels)
        colour[:3] *= texels[:, :3].mean(axis=0) / 255.0  # one channel is a grey image
    return colour


def _shape(model: mujoco.MjModel, geom: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    kind, size = mujoco.mjtGeom(int(model.geom_type[geom])), model.geom_size[geom]
    if kind == mujoco.mjtGeom.mjGEOM_HFIELD:
        field = int(model.geom_dataid[geom])
        corners = terrain(model, field).reshape(-1, 3)
        # separate triangles: the tool feels the facets
        return corners, np.arange(len(corners)).reshape(-1, 3)
    if kind in (mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtGeom.mjGEOM_SDF):
        # MuJoCo also has a mesh of a signed distance field, at its zero level
        return mesh_of(model, int(model.geom_dataid[geom]))
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


def terrain(model: mujoco.MjModel, field: int) -> Array:
    """Returns the surface of a height field, its four sides and its base.

    Sample (i, j) of the field, row by row, stands at

        x = r_x (2 j / (columns − 1) − 1),  y = r_y (2 i / (rows − 1) − 1),  z = r_z · sample

    so the first row has the smallest y. Each cell is cut from its first corner to the one across (i
    + 1, j + 1); the sides go down to the base at z = −r_b. r = (r_x, r_y, r_z, r_b) is the field's
    size in m.

    Args:
        model: The scene.
        field: Index of the height field.

    Returns:
        Triangles in the geom's frame, (m, 3, 3) in m, their outside where they turn
        counter-clockwise.
    """
    rows, columns = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
    stride = max(1, -(-(max(rows, columns) - 1) // (MAX_SAMPLES - 1)))
    first, size = int(model.hfield_adr[field]), model.hfield_size[field]
    data = model.hfield_data[first : first + rows * columns].reshape(rows, columns)
    ups, rights = (np.unique([*range(0, n, stride), n - 1]) for n in (rows, columns))
    x, y = np.meshgrid(
        size[0] * (2.0 * rights / (columns - 1) - 1.0), size[1] * (2.0 * ups / (rows - 1) - 1.0)
    )
    top = np.stack([x, y, size[2] * data[np.ix_(ups, rights)]], axis=2)
    base = np.stack([x, y, np.full_like(x, -size[3])], axis=2)
    # around the rim, counter-clockwise from above
    rims = [
        np.concatenate([side[0], side[1:, -1], side[-1, -2::-1], side[-2::-1, 0]])
        for side in (base, top)
    ]
    corners = base[[0, -1]][:, [0, -1]]
    parts = [_split(top), _split(np.stack(rims)), _split(corners)[:, ::-1]]
    return np.concatenate(parts)


def _split(grid: Array) -> Array:
    """Returns two triangles for each cell of a grid of points, (rows, columns, 3)."""
    low, right = grid[:-1, :-1], grid[:-1, 1:]
    up, across = grid[1:, :-1], grid[1:, 1:]
    pairs = np.stack([np.stack([low, right, across], 2), np.stack([low, across, up], 2)], 2)
    return np.ascontiguousarray(pairs.reshape(-1, 3, 3), dtype=np.float64)


class Tendons:
    """The spatial tendons of a scene in visible groups, with the paths that MuJoCo draws.

    Args:
        model: The scene.

    Attributes:
        widths: Diameter of each tendon in m, (n,).
        colours: Red, green, blue and opacity of each tendon, 0 to 1, (n, 4).
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model, self._shown = model, list[int]()
        self._scene: mujoco.MjvScene | None = None
        self.widths, self.colours = np.zeros(0), np.zeros((0, 4))
        if not model.ntendon:
            return
        self._scene = mujoco.MjvScene(model, MAX_PIECES)
        self._camera, self._option = mujoco.MjvCamera(), mujoco.MjvOption()
        # tendons alone, which takes microseconds
        option = self._option
        for groups in (option.geomgroup, option.sitegroup, option.flexgroup, option.skingroup):
            groups[:] = 0
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        drawn = {int(piece.objid): piece for piece in self._drawn(data)}
        self._shown = sorted(drawn)
        first = [drawn[tendon] for tendon in self._shown]
        self.widths = np.array([2.0 * piece.size[0] for piece in first])
        self.colours = np.array([piece.rgba for piece in first], np.float64).reshape(-1, 4)

    def pieces(self, data: mujoco.MjData) -> tuple[NDArray[np.float32], ...]:
        """Returns the straight pieces of each tendon, (m, 2, 3) in m.

        Args:
            data: State after ``mj_kinematics``; its tendons are computed here.
        """
        ends: dict[int, list[Array]] = {tendon: [] for tendon in self._shown}
        for piece in self._drawn(data) if self._shown else ():
            # a capsule along its third axis, from end to end
            half = piece.size[2] * piece.mat[:, 2]
            ends[int(piece.objid)].append(np.stack([piece.pos - half, piece.pos + half]))
        return tuple(np.array(each, np.float32).reshape(-1, 2, 3) for each in ends.values())

    def _drawn(self, data: mujoco.MjData) -> list[mujoco.MjvGeom]:
        """Returns the geoms that MuJoCo would draw for tendons."""
        assert self._scene is not None
        mujoco.mj_comPos(self._model, data)
        mujoco.mj_tendon(self._model, data)
        every = int(mujoco.mjtCatBit.mjCAT_ALL)
        mujoco.mjv_updateScene(
            self._model, data, self._option, None, self._camera, every, self._scene
        )
        kind = int(mujoco.mjtObj.mjOBJ_TENDON)
        return [geom for geom in self._scene.geoms[: self._scene.ngeom] if geom.objtype == kind]


def shell(model: mujoco.MjModel, grip: str) -> trimesh.Trimesh:
    """Returns a shell around a tool, in the frame of its grip in m.

    Args:
        model: The scene.
        grip: Name of a site on the tool. An invisible tool gives a small ball.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    site, away = model.site(grip), SHELL * float(model.stat.extent)
    place, turn = data.site(grip).xpos, data.site(grip).xmat.reshape(3, 3)
    tool = model.body_weldid[int(site.bodyid[0])]
    parts = []
    for prop in props_of(model):
        if model.body_weldid[prop.body] != tool:
            continue
        local = prop.mesh.vertices @ matrix_of(prop.turn).T + prop.place
        world = local @ data.xmat[prop.body].reshape(3, 3).T + data.xpos[prop.body]
        part = trimesh.Trimesh((world - place) @ turn, prop.mesh.faces)
        part.merge_vertices(merge_norm=True, merge_tex=True)
        part.vertices = part.vertices + away * part.vertex_normals
        parts.append(part)
    if not parts:
        return trimesh.creation.icosphere(subdivisions=2, radius=2.0 * away)
    return trimesh.util.concatenate(parts)


@dataclass(frozen=True, slots=True)
class Scenery:
    """All of a scene that a page draws, without MuJoCo's model.

    Attributes:
        bodies: Number of bodies.
        extent: Size of the scene in m.
        centre: Point in the middle, (3,) in m.
        props: Visible geoms.
        widths: Diameter of each visible tendon in m, (n,).
        colours: Colour of each visible tendon, 0 to 1, (n, 4).
        tools: Shell around the tool of each hand (``shell``).
        is_always_implicit: True if the method falls back in every tick
            (``summary.is_always_implicit``).
    """

    bodies: int
    extent: float
    centre: Array
    props: list[Prop]
    widths: Array
    colours: Array
    tools: tuple[trimesh.Trimesh, ...]
    is_always_implicit: bool

    @classmethod
    def from_model(cls, model: mujoco.MjModel, *grips: str) -> Scenery:
        """Returns what is drawn of a scene; grips are names of sites on the tools."""
        tendons = Tendons(model)
        return cls(
            bodies=int(model.nbody),
            extent=float(model.stat.extent),
            centre=np.array(model.stat.center, np.float64),
            props=props_of(model),
            widths=tendons.widths,
            colours=tendons.colours,
            tools=tuple(shell(model, grip) for grip in grips),
            is_always_implicit=is_always_implicit(model, grips[0]),
        )

    def parts(self) -> dict[str, Any]:
        """Returns numbers, texts and arrays from which ``from_parts`` makes an equal one."""
        names = ("bodies", "extent", "centre", "widths", "colours", "is_always_implicit")
        return {name: getattr(self, name) for name in names} | {
            "tools": [_surface(each) for each in self.tools],
            "props": [
                [each.body, each.place, each.turn, each.colour, *_surface(each.mesh)]
                for each in self.props
            ],
        }

    @classmethod
    def from_parts(cls, parts: Any) -> Scenery:
        """Returns a scenery from the numbers of a process that may have been taken over.

        Raises:
            RecordingError: They are no scenery.
        """
        try:
            bodies, count = int(parts["bodies"]), len(parts["widths"])
            props = [
                Prop(
                    body=range(bodies)[body],
                    place=checked(place, 3),
                    turn=checked(turn, 4),
                    mesh=_mesh(*surface),
                    colour=checked(colour, 4),
                )
                for body, place, turn, colour, *surface in parts["props"]
            ]
            first, *others = parts["tools"]  # one at least
            return cls(
                bodies=bodies,
                extent=float(checked(np.array(parts["extent"]))),
                centre=checked(parts["centre"], 3),
                props=props,
                widths=checked(parts["widths"], count),
                colours=checked(parts["colours"], count, 4),
                tools=tuple(_mesh(*each) for each in (first, *others)),
                is_always_implicit=bool(parts["is_always_implicit"]),
            )
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise RecordingError(f"the scene cannot be drawn: {error}") from None


def checked(array: Any, *shape: int | None) -> Array:
    """Returns finite numbers of a shape, in which None is any length.

    Raises:
        ValueError: They have another shape, or are not finite.
    """
    copied = np.array(array, np.float64)  # a copy, which viser may keep
    if len(shape) != copied.ndim or any(
        wanted not in (None, side) for wanted, side in zip(shape, copied.shape, strict=True)
    ):
        raise ValueError(f"numbers have the shape {copied.shape}, not {shape}")
    if not np.isfinite(copied).all():
        raise ValueError("a number is not finite")
    return copied


def _surface(mesh: trimesh.Trimesh) -> list[NDArray[Any]]:
    return [np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)]


def _mesh(corners: Any, faces: Any) -> trimesh.Trimesh:
    corners, faces = checked(corners, None, 3), checked(faces, None, 3).astype(np.int64)
    if faces.size and not (faces.min() >= 0 and faces.max() < len(corners)):
        raise ValueError("a triangle has no corner")
    return trimesh.Trimesh(corners, faces, process=False)


class Surfaces:
    """Triangles around the origin, and the distance to the last of them in a direction.

    Args:
        triangles: Corners, (m, 3, 3) in m.

    References:
        Möller & Trumbore, "Fast, minimum storage ray–triangle intersection", 1997; their triple
        products are rearranged so that all but the direction is precomputed.
    """

    def __init__(self, triangles: Array) -> None:
        first, second = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
        back = -triangles[:, 0]
        other = np.cross(back, first)
        # terms of each triangle along a direction: the volume, and its products with u and v
        self._products = np.stack([np.cross(second, first), np.cross(second, back), other])
        self._far = np.einsum("ij,ij->i", second, other)

    def way_out(self, along: Array) -> float:
        """Returns the distance in m from the origin to the last surface in a direction, or 0.

        Args:
            along: A unit vector.
        """
        volume, u, v = self._products @ along
        volume[np.abs(volume) < 1e-30] = np.nan  # edge on or without area: no intersection
        u, v, far = u / volume, v / volume, self._far / volume
        is_hit = (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1.0 + 1e-9) & (far > 0.0)
        return float(far[is_hit].max(initial=0.0))


def enlargement(room: float, stretch: float) -> int:
    """Returns the enlargement of a stretch that fits into a length: 1, 2, 5, 10 and so on.

    Args:
        room: Largest drawn length in m, > 0.
        stretch: True length in m, >= 0.
    """
    times = room / max(stretch, room / MAX_TIMES)
    if times < 2.0:
        return 1
    power = 10 ** math.floor(math.log10(times))
    return int(max(step * power for step in (1, 2, 5) if step * power <= times * (1 + 1e-9)))


def coil(start: Array, end: Array, radius: float) -> Array:
    """Returns the line of a spring as segments, (POINTS, 2, 3) in m; a short one is thin."""
    way = end - start
    length = float(np.linalg.norm(way))
    if length == 0.0:
        return np.broadcast_to(start, (POINTS, 2, 3)).copy()
    along = way / length
    across = np.cross(along, np.eye(3)[np.abs(along).argmin()])
    across /= np.linalg.norm(across)
    other = np.cross(along, across)
    share = np.linspace(0.0, 1.0, POINTS + 1)[:, None]
    # straight at both ends
    width = min(radius, 0.25 * length) * np.clip(8.0 * np.minimum(share, 1.0 - share), 0.0, 1.0)
    angle = 2.0 * np.pi * TURNS * share
    line = start + share * way + width * (np.cos(angle) * across + np.sin(angle) * other)
    return np.stack([line[:-1], line[1:]], axis=1)
