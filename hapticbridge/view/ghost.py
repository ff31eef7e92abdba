"""The coupling as it is drawn: a ghost where the handle is, a spring, an arrow for the force.

Handle and tool are rarely farther apart than a few tenths of a millimetre, which no picture shows.
So the ghost is a shell around the tool, where it would be if nothing stretched the coupling, and
the spring goes from it towards the tool, but several times as far: on the side to which the hand is
pulled, outside of the tool that would hide it. The page says how many times. Where the stretch can
be seen, it goes from handle to tool.
"""

from __future__ import annotations

import mujoco
import numpy as np
import viser
from numpy.typing import ArrayLike, NDArray

from hapticbridge.film_process import force_colour
from hapticbridge.view.geometry import POINTS, Surfaces, coil, enlargement, shell
from hapticbridge.view.sight import Sight

Array = NDArray[np.float64]

FARTHEST = 0.25
"""Of the scene's extent: how long the spring is drawn at the longest stretch so far."""

LONGEST_ARROW = 0.5
"""Of the scene's extent, without unit: how long the arrow of the largest force is drawn."""

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
