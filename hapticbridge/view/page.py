"""The page: the scene in three dimensions, curves beside it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
import viser
from numpy.typing import NDArray

from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.rendering import method_named
from hapticbridge.summary import coupling_sentences, is_always_held
from hapticbridge.view.geometry import NOT_DRAWN, Tendons, props_of
from hapticbridge.view.ghost import LONGEST_ARROW, Ghost, linear
from hapticbridge.view.sight import Sight
from hapticbridge.view.trace import PLOTS

Array = NDArray[np.float64]

COLOURS = ("#1a5fb4", "#b3261e", "#2e7d32", "#e66100")

_SMALL = {"font": "11px sans-serif", "ticks": {"size": 4}, "gap": 2}
_AXES: tuple[dict[str, Any], ...] = ({"size": 22, **_SMALL}, {"size": 52, **_SMALL})

_COLOURS_MEAN = (
    "Blue ghost: the handle. Spring: the coupling, {length}, pale at rest, red at the largest "
    "force. Orange arrow: the force on the hand, the longest is {longest} N. Turquoise: contacts "
    "and their forces, the longest is {strongest} N."
)

_CONTACT = (77, 208, 225)
"""Colour of contacts, red, green and blue of 255."""


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
        self._extent, self._strongest = float(model.stat.extent), 0.0
        self._build_scene(model)
        self._ghost = Ghost(server.scene, model, parameters.grip)
        server.gui.set_panel_label(f"hapticbridge: {facts.get('scene', '')}")
        self.status = server.gui.add_markdown("waiting for the first tick")
        self._told = _told(model, parameters, facts)
        self._plots: list[viser.GuiUplotHandle] = []

    def add_curves(self) -> None:
        """Adds the curves and what the colours mean, below what is there."""
        gui = self._server.gui
        self._words = gui.add_markdown("")
        self._explain()
        for title, names in PLOTS:
            series: list[dict[str, Any]] = [{"label": "time (s)"}]
            series += [
                {"label": name, "stroke": colour, "width": 1.5}
                for name, colour in zip(names, COLOURS, strict=False)
            ]
            nothing = tuple(np.zeros(2) for _ in series)
            self._plots.append(
                gui.add_uplot(
                    nothing,
                    tuple(series),
                    title=f"{title} over time (s)",
                    height=122,
                    padding=(8, 8, 0, 0),
                    scales={"x": {"time": False}},
                    axes=_AXES,
                    legend={"show": len(names) > 1},
                )
            )
        gui.add_markdown(self._told)

    def allow(self, sights: Sequence[Sight]) -> None:
        """Makes room for what is known to come."""
        for sight in sights:
            self._ghost.allow(float(np.linalg.norm(sight.handle - sight.grip)))
            self._strongest = max(self._strongest, _strongest(sight))

    def _explain(self) -> None:
        times = self._ghost.times
        said = _COLOURS_MEAN.format(
            length=f"{times} times as long as it is" if times > 1 else "as long as it is",
            longest=f"{self.reference:.2g}",
            strongest=f"{max(self._strongest, self.reference):.2g}",
        )
        if self._words.content != said:
            self._words.content = said

    def show(self, sight: Sight) -> None:
        """Draws an instant."""
        with self._server.atomic():
            for body, frame in self._bodies.items():
                place, turn = sight.places[body], sight.turns[body]
                if not np.array_equal(frame.position, place):
                    frame.position = place
                if not np.array_equal(frame.wxyz, turn):
                    frame.wxyz = turn
            for line, pieces in zip(self._tendons, sight.tendons, strict=True):
                line.visible = bool(len(pieces))
                if line.visible and not np.array_equal(line.points, pieces):
                    line.points = pieces
            self._ghost.show(sight, self.reference)
            self._show_contacts(sight)
        if self._plots:
            self._explain()

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
            red, green, blue = np.round(255.0 * prop.colour[:3]).astype(int).tolist()
            scene.add_mesh_simple(
                f"/body{prop.body}/geom{index}",
                np.asarray(prop.mesh.vertices),
                np.asarray(prop.mesh.faces),
                color=(red, green, blue),
                opacity=float(prop.colour[3]) if prop.colour[3] < 1.0 else None,
                side="double",
                position=prop.place,
                wxyz=prop.turn,
            )
        nothing = np.zeros((1, 2, 3), dtype=np.float32)
        tendons = Tendons(model)
        self._tendons = [
            scene.add_line_segments(
                f"/tendon{index}", nothing, linear(255.0 * colour[:3]), thickness=width
            )
            for index, (width, colour) in enumerate(
                zip(tendons.widths.tolist(), tendons.colours, strict=True)
            )
        ]
        thin = {
            "shaft_radius": 0.006 * extent,
            "head_radius": 0.016 * extent,
            "head_length": 0.04 * extent,
        }
        self._pushes = scene.add_arrows(
            "/contact forces", nothing, linear(_CONTACT), **thin, visible=False
        )
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

    def _show_contacts(self, sight: Sight) -> None:
        self._strongest = max(self._strongest, self.reference, _strongest(sight))
        reach = LONGEST_ARROW * self._extent / self._strongest
        touches = bool(len(sight.contact_places))
        self._contacts.visible = self._pushes.visible = touches
        if touches:
            places = sight.contact_places.astype(np.float32)
            self._contacts.points = places
            tips = places + reach * sight.contact_forces
            self._pushes.points = np.stack([places, tips], axis=1).astype(np.float32)


def _strongest(sight: Sight) -> float:
    """Returns the largest force of an instant; a lever's contacts carry far more than the hand."""
    contacts = np.linalg.norm(sight.contact_forces, axis=1)
    return float(max(np.linalg.norm(sight.force), contacts.max(initial=0.0)))


def _told(model: mujoco.MjModel, parameters: RunParameters, facts: dict[str, str]) -> str:
    method = method_named(facts.get("method", ""))
    sentences = coupling_sentences(
        parameters.coupling,
        method,
        parameters.period,
        parameters.substeps,
        is_always_held=is_always_held(model, parameters.grip),
    )
    lines = [f"Method **{method.name}**, {1 / parameters.period:g} Hz", *sentences, NOT_DRAWN]
    return "  \n".join(lines)
