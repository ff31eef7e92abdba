"""The coupling as it is drawn: a ghost where the handle is, a spring, an arrow for the force.

Handle and tool are rarely farther apart than a few tenths of a millimetre, which no picture shows.
So the ghost is a shell around the tool, where it would be if nothing stretched the coupling, and
the spring goes from it towards the tool, but several times as far: on the side to which the hand is
pulled, outside of the tool that would hide it. The page says how many times. Where the stretch can
be seen, it goes from handle to tool.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np
import trimesh
import viser
from numpy.typing import ArrayLike, NDArray

from hapticbridge.film_process import force_colour
from hapticbridge.view.props import props_of
from hapticbridge.view.sight import Sight

Array = NDArray[np.float64]

FARTHEST = 0.25
"""Of the scene's extent: how long the spring is drawn at the longest stretch so far."""

LONGEST_ARROW = 0.5
"""Of the scene's extent, without unit: how long the arrow of the largest force is drawn."""

MOST_TIMES = 500
"""Largest enlargement of the stretch; beyond, noise would shake the spring."""

SHELL = 0.012
"""Of the scene's extent: how far the shell is from the tool. Nearer it flickers, farther it looks
like another tool."""

TURNS, POINTS = 8, 64
"""Of the spring."""

_BLUE, _HAND = (26, 95, 180), (230, 97, 0)


class Ghost:
    """Handle, spring and the force in the hand.

    Args:
        scene: Where.
        model: The run's.
        grip: Name of the site on the tool.

    Attributes:
        times: How many times as long as the coupling is stretched the spring is drawn.
    """

    def __init__(self, scene: viser.SceneApi, model: mujoco.MjModel, grip: str) -> None:
        self._extent = extent = float(model.stat.extent)
        self._shell = shell(model, grip)
        self._longest, self.times = 0.0, 1
        self._handle = scene.add_frame("/handle", show_axes=False)
        faces = np.asarray(self._shell.faces)
        corners = np.asarray(self._shell.vertices)
        self._surfaces = Surfaces(corners[faces])
        scene.add_mesh_simple("/handle/shell", corners, faces, color=_BLUE, opacity=0.3)
        nothing = np.zeros((POINTS, 2, 3), dtype=np.float32)
        self._spring = scene.add_line_segments(
            "/coupling", nothing, (0, 0, 0), thickness=0.012 * extent
        )
        self._arrow = scene.add_arrows(
            "/force in the hand",
            nothing[:1],
            linear(_HAND),
            shaft_radius=0.01 * extent,
            head_radius=0.025 * extent,
            head_length=0.06 * extent,
        )

    def allow(self, stretch: float) -> None:
        """Makes room for a distance between handle and tool, in m."""
        self._longest = max(self._longest, stretch)
        self.times = enlargement(FARTHEST * self._extent, self._longest)

    def show(self, sight: Sight, reference: float) -> None:
        """Draws an instant.

        Args:
            sight: The instant.
            reference: The force in N that is drawn longest and reddest, > 0.
        """
        strength = float(np.linalg.norm(sight.force))
        way = sight.grip - sight.handle
        stretch = float(np.linalg.norm(way))
        self.allow(stretch)
        self._handle.position, self._handle.wxyz = sight.handle, sight.handle_turn
        colour = linear(255.0 * force_colour(strength, reference))
        # it begins outside of what the hand holds, unless it truly ends at the tool
        start = sight.handle
        if self.times > 1 and stretch > 0.0:
            turn = np.zeros(9)
            mujoco.mju_quat2Mat(turn, sight.handle_turn)
            along = way / stretch
            aside = self._surfaces.way_out(turn.reshape(3, 3).T @ along)
            start = start + aside * along
        end = start + self.times * way
        self._spring.points = coil(start, end, 0.02 * self._extent).astype(np.float32)
        self._spring.colors = np.full((POINTS, 2, 3), colour, dtype=np.uint8)
        self._arrow.visible = strength > 1e-3 * reference
        if self._arrow.visible:
            reach = LONGEST_ARROW * self._extent / max(reference, strength)
            points = np.array([[end, end - reach * sight.force]])
            self._arrow.points = points.astype(np.float32)


def linear(colour: ArrayLike) -> tuple[int, int, int]:
    """Returns a colour as viser wants it for lines and arrows, which it draws lighter than it is.

    It takes their numbers, 0 to 255, for shares of light and not for sRGB.
    """
    share = np.asarray(colour, dtype=np.float64) / 255.0
    light = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    red, green, blue = np.round(255.0 * light).astype(int).tolist()
    return red, green, blue


def shell(model: mujoco.MjModel, grip: str) -> trimesh.Trimesh:
    """Returns a shell around a tool, in the frame of its grip in m.

    Args:
        model: The scene.
        grip: Name of a site on the tool; where nothing is seen of the tool it is a small ball.
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
        own = np.zeros(9)
        mujoco.mju_quat2Mat(own, prop.turn)
        local = prop.triangles @ own.reshape(3, 3).T + prop.place
        world = local @ data.xmat[prop.body].reshape(3, 3).T + data.xpos[prop.body]
        corners = ((world - place) @ turn).reshape(-1, 3)
        part = trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3))
        part.merge_vertices(merge_norm=True, merge_tex=True)
        part.vertices = part.vertices + away * part.vertex_normals
        parts.append(part)
    if not parts:
        return trimesh.creation.icosphere(subdivisions=2, radius=2.0 * away)
    return trimesh.util.concatenate(parts)


class Surfaces:
    """Surfaces around the origin, and how far it is out of them.

    Args:
        triangles: Of the surfaces, (m, 3, 3) in m.

    References:
        Möller & Trumbore, "Fast, minimum storage ray–triangle intersection", 1997; their triple
        products are turned so that all but the direction is known beforehand.
    """

    def __init__(self, triangles: Array) -> None:
        first, second = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
        back = -triangles[:, 0]
        other = np.cross(back, first)
        # what each gives along a direction: the volume, and it times u and v
        self._products = np.stack([np.cross(second, first), np.cross(second, back), other])
        self._far = np.einsum("ij,ij->i", second, other)

    def way_out(self, along: Array) -> float:
        """Returns how far it is from the origin to the last surface in a direction, in m, or 0.

        Args:
            along: A unit vector.
        """
        volume, u, v = self._products @ along
        volume[np.abs(volume) < 1e-30] = np.nan  # edge on or without area: nothing meets it
        u, v, far = u / volume, v / volume, self._far / volume
        is_hit = (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1.0 + 1e-9) & (far > 0.0)
        return float(far[is_hit].max(initial=0.0))


def enlargement(room: float, stretch: float) -> int:
    """Returns how many times a stretch may be drawn: 1, 2, 5, 10 and so on.

    Args:
        room: How long it may be drawn, in m, > 0.
        stretch: How long it is, in m, >= 0.
    """
    times = room / max(stretch, room / MOST_TIMES)
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
