"""The page: the scene in three dimensions, curves beside it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
import viser
from numpy.typing import NDArray

from hapticbridge.felt import coupling_sentences, is_always_held
from hapticbridge.film.stage import LONGEST_ARROW, force_colour
from hapticbridge.kernel.state import RunParameters
from hapticbridge.rendering import method_named
from hapticbridge.view.props import props_of
from hapticbridge.view.sight import Sight
from hapticbridge.view.trace import PLOTS

Array = NDArray[np.float64]

COLOURS = ("#1a5fb4", "#b3261e", "#2e7d32", "#e66100")

_HAND = (230, 97, 0)
_CONTACT = (77, 208, 225)


class Page:
    """Draws instants of one run on viser's page.

    Args:
        server: Where.
        model: The run's scene.
        parameters: Of the run.
        facts: Scene and method, as recorded.
        reference: The force in N that is drawn longest and reddest, > 0.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        model: mujoco.MjModel,
        parameters: RunParameters,
        facts: dict[str, str],
        reference: float,
    ) -> None:
        self._server, self.reference = server, reference
        self._extent = float(model.stat.extent)
        self._build_scene(model)
        server.gui.set_panel_label(f"hapticbridge: {facts.get('scene', '')}")
        self._words = server.gui.add_markdown(_told(model, parameters, facts))
        self.status = server.gui.add_markdown("waiting for the first tick")
        self._plots = []
        for title, names in PLOTS:
            series: list[dict[str, Any]] = [{"label": "s"}]
            series += [
                {"label": name, "stroke": colour, "width": 1.5}
                for name, colour in zip(names, COLOURS, strict=False)
            ]
            nothing = tuple(np.zeros(2) for _ in series)
            self._plots.append(
                server.gui.add_uplot(
                    nothing,
                    tuple(series),
                    title=title,
                    height=150,
                    scales={"x": {"time": False}},
                    legend={"show": len(names) > 1},
                )
            )

    def show(self, sight: Sight) -> None:
        """Draws an instant."""
        strength = float(np.linalg.norm(sight.force))
        with self._server.atomic():
            for body, frame in self._bodies.items():
                place, turn = sight.places[body], sight.turns[body]
                if not np.array_equal(frame.position, place):
                    frame.position = place
                if not np.array_equal(frame.wxyz, turn):
                    frame.wxyz = turn
            self._handle.position = sight.handle
            self._spring.points = np.array([[sight.grip, sight.handle]], dtype=np.float32)
            colour = np.round(255 * force_colour(strength, self.reference)).astype(np.uint8)
            self._spring.colors = np.broadcast_to(colour, (1, 2, 3)).copy()
            reach = LONGEST_ARROW * self._extent / max(self.reference, strength)
            tip = sight.handle - reach * sight.force
            self._arrow.points = np.array([[sight.handle, tip]], dtype=np.float32)
            self._arrow.visible = strength > 1e-3 * self.reference
            self._show_contacts(sight, reach)

    def plot(self, time: Array, lines: Sequence[Array]) -> None:
        """Draws the curves.

        Args:
            time: In s, (n,), n >= 2.
            lines: One per line of ``PLOTS``, (n,) each, in its unit.
        """
        rest = iter(lines)
        for handle, (_, names) in zip(self._plots, PLOTS, strict=True):
            handle.data = (time, *(next(rest) for _ in names))

    def _build_scene(self, model: mujoco.MjModel) -> None:
        scene, extent = self._server.scene, self._extent
        scene.set_up_direction("+z")
        self._bodies = {
            body: scene.add_frame(f"/body{body}", show_axes=False) for body in range(model.nbody)
        }
        for index, prop in enumerate(props_of(model)):
            scene.add_mesh_simple(
                f"/body{prop.body}/geom{index}",
                prop.corners,
                prop.faces,
                color=prop.colour,
                opacity=None if prop.opacity == 1.0 else prop.opacity,
                position=prop.place,
                wxyz=prop.turn,
                flat_shading=True,
                side="double",
            )
        self._handle = scene.add_icosphere(
            "/handle", radius=0.02 * extent, color=(26, 95, 180), opacity=0.45
        )
        nothing = np.zeros((1, 2, 3), dtype=np.float32)
        self._spring = scene.add_line_segments(
            "/coupling", nothing, (0, 0, 0), thickness=0.012 * extent
        )
        thin = {
            "shaft_radius": 0.006 * extent,
            "head_radius": 0.016 * extent,
            "head_length": 0.04 * extent,
        }
        self._arrow = scene.add_arrows("/force in the hand", nothing, _HAND, **thin)
        self._pushes = scene.add_arrows("/contact forces", nothing, _CONTACT, **thin, visible=False)
        self._contacts = scene.add_point_cloud(
            "/contacts",
            np.zeros((1, 3), dtype=np.float32),
            _CONTACT,
            point_size=0.015 * extent,
            point_shape="circle",
            visible=False,
        )
        centre, away = np.array(model.stat.center), 1.25 * extent
        self._server.initial_camera.look_at = tuple(centre)
        self._server.initial_camera.position = tuple(centre + away * np.array([0.7, -0.8, 0.6]))
        self._server.initial_camera.near = 0.01 * extent

    def _show_contacts(self, sight: Sight, reach: float) -> None:
        touches = bool(len(sight.contact_places))
        self._contacts.visible = self._pushes.visible = touches
        if touches:
            places = sight.contact_places.astype(np.float32)
            self._contacts.points = places
            tips = places + reach * sight.contact_forces
            self._pushes.points = np.stack([places, tips], axis=1).astype(np.float32)


def _told(model: mujoco.MjModel, parameters: RunParameters, facts: dict[str, str]) -> str:
    method = method_named(facts.get("method", ""))
    sentences = coupling_sentences(
        parameters.coupling,
        method,
        parameters.period,
        parameters.substeps,
        is_always_held=is_always_held(model, parameters.grip),
    )
    lines = [f"Method **{method.name}**, {1 / parameters.period:g} Hz", *sentences]
    lines.append("Orange: force in the hand. Spring: pale at rest, red at the largest force.")
    return "  \n".join(lines)
