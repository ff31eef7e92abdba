"""Page of a run: the scene in three dimensions with the coupling, and curves beside it."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import mujoco
import numpy as np
import viser
from numpy.typing import ArrayLike, NDArray

from hapticbridge.demand.methods import RunCoupling
from hapticbridge.errors import RecordingError
from hapticbridge.files import printable
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.replay.blow import NewestBlow
from hapticbridge.replay.stage import MIN_REFERENCE, force_colour, is_held
from hapticbridge.run.description import method_of, requested_of
from hapticbridge.scene.physics import matrix_of
from hapticbridge.units import format_forces, format_si
from hapticbridge.view.geometry import (
    NOT_DRAWN,
    POINTS,
    Scenery,
    Surfaces,
    Tendons,
    checked,
    coil,
    enlargement,
)

Array = NDArray[np.float64]

PLOTS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("Force (N)", ("on the hand", "on the tool")),
    ("Energy per port (mJ)", ("coupling", "device", "environment")),
    ("Passivity margin (mJ)", ("allowed − created",)),
    ("Lateness of a tick (µs)", ("latest",)),
)
"""Title with unit of each plot, and the names of its lines."""

LINES = sum(len(names) for _, names in PLOTS)
"""Number of lines in all plots."""

COLOURS = ("#1a5fb4", "#b3261e", "#2e7d32", "#e66100")

_ROUNDING = 1e-9
"""Number in the unit of its plot below which it is rounding and drawn as 0."""

_SMALL = {"font": "11px sans-serif", "ticks": {"size": 4}, "gap": 2}
_AXES: tuple[dict[str, Any], ...] = ({"size": 22, **_SMALL}, {"size": 52, "space": 18, **_SMALL})

_COLOURS_MEAN = (
    "Blue ghost: the handle. Spring: the coupling, {length}, pale at rest, red at {pull} on the "
    "tool.{hand} Turquoise: contacts and their forces, the longest is {strongest}. Yellow: a blow "
    "of the tool."
)

_HAND_MEANS = " Orange arrow: the force on the hand, the longest is {longest}."

_CONTACT, _BLOW = (77, 208, 225), (250, 204, 26)
"""Colours of contacts and blows, red, green and blue of 255."""

FARTHEST = 0.25
"""Length of the spring at the longest stretch so far, as a share of the scene's extent."""

MAX_ARROW = 0.5
"""Length of the arrow of the largest force, as a share of the scene's extent."""

_BLUE, _HAND = (26, 95, 180), (230, 97, 0)


@dataclass(frozen=True, slots=True)
class Held:
    """Handle and forces of a hand at one instant, in world coordinates.

    Attributes:
        handle: Position of the handle, (3,) in m.
        handle_turn: Orientation of the handle, a quaternion (4,).
        grip: Position of the grip on the tool, (3,) in m.
        hand_force: Force of the device on the hand, (3,) in N; zero without a hand.
        tool_force: Force of the coupling on the tool, (3,) in N.
    """

    handle: Array
    handle_turn: Array
    grip: Array
    hand_force: Array
    tool_force: Array

    @classmethod
    def from_record(cls, row: NDArray[np.void], hand_force: Array) -> Held:
        """Returns what a record, one element of ``TICK_DTYPE``, says of a hand.

        ``hand_force`` is the force of the device on the hand in the world frame, (3,) in N.
        """
        return cls(
            handle=row["handle_position"][0].copy(),
            handle_turn=row["handle_quaternion"][0].copy(),
            grip=row["tool_position"][0].copy(),
            hand_force=hand_force.copy(),
            tool_force=row["wrench_on_tool"][0, :3].copy(),
        )


@dataclass(frozen=True, slots=True)
class Sight:
    """One instant of a run in world coordinates, ready to be drawn.

    Attributes:
        time: Time of the run's clock in s at which the tick was due.
        places: Positions of the bodies, (nbody, 3) in m.
        turns: Orientations of the bodies, quaternions (nbody, 4).
        contact_places: Positions of the contacts with a force, (n, 3) in m.
        contact_forces: Forces of the contacts, (n, 3) in N.
        tendons: Straight pieces of each visible tendon, (m, 2, 3) in m.
        hands: All hands with a handle in the scene, the first one first; a grip axis has none.
        blow: Newest blow of the tool so far; None before the first.
    """

    time: float
    places: Array
    turns: Array
    contact_places: Array
    contact_forces: Array
    tendons: tuple[NDArray[np.float32], ...]
    hands: tuple[Held, ...]
    blow: NewestBlow | None = None

    @classmethod
    def from_scene(
        cls,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        tendons: Tendons,
        contacts: Array,
        row: NDArray[np.void],
        hands: tuple[Held, ...],
    ) -> Sight:
        """Returns the instant of a scene.

        Args:
            model: The scene.
            data: Positions after the tick; the poses of bodies are computed here.
            tendons: Tendons of the scene.
            contacts: Position in m and force in N of each contact with a force, (n, 2, 3).
            row: Record of the tick, one element of ``TICK_DTYPE``.
            hands: Hands at the instant.
        """
        mujoco.mj_kinematics(model, data)
        return cls(
            time=1e-9 * float(row["deadline_ns"][0]),
            places=data.xpos.copy(),
            turns=data.xquat.copy(),
            contact_places=contacts[:, 0],
            contact_forces=contacts[:, 1],
            tendons=tendons.pieces(data),
            hands=hands,
        )

    def parts(self) -> list[Any]:
        """Returns numbers and arrays from which ``from_parts`` makes an equal one."""
        *own, hands, blow = [getattr(self, field.name) for field in fields(self)]
        held = [[getattr(each, field.name) for field in fields(each)] for each in hands]
        return [*own, held, None if blow is None else blow.parts()]

    @classmethod
    def from_parts(cls, parts: Any, bodies: int, tendons: int, hands: int = 1) -> Sight:
        """Returns an instant from the numbers of a process that may have been taken over.

        Raises:
            RecordingError: They are no instant of a scene of so many bodies, tendons and hands.
        """
        try:
            time, places, turns, where, forces, lines, held, blow = parts
            return cls(
                float(checked(np.array(time))),
                checked(places, bodies, 3),
                checked(turns, bodies, 4),
                checked(where, None, 3),
                checked(forces, len(where), 3),
                tuple(
                    checked(each, None, 2, 3).astype(np.float32)
                    for each, _ in zip(lines, range(tendons), strict=True)
                ),
                tuple(
                    Held(*(checked(own, n) for own, n in zip(each, (3, 4, 3, 3, 3), strict=True)))
                    for each, _ in zip(held, range(hands), strict=True)
                ),
                None if blow is None else NewestBlow.from_parts(checked(blow, 7)),
            )
        except (TypeError, ValueError) as error:
            raise RecordingError(f"an instant of the run cannot be drawn: {error}") from None


class Trace:
    """Curves of a run, thinned without losing a peak.

    Each call of ``add`` adds one point: the largest forces and lateness since the last call, and
    the present energies.

    Args:
        length: Number of points to keep, >= 2; None keeps all.
        is_held: True if a hand feels the force of the device.
    """

    def __init__(self, length: int | None = None, *, is_held: bool = True) -> None:
        self._is_held = is_held
        self._points: deque[tuple[float, ...]] = deque(maxlen=length)

    def add(self, rows: NDArray[np.void], slack: float) -> None:
        """Adds a point.

        Args:
            rows: Records since the last call, at least one.
            slack: Energy in J that the environment may have created so far; NaN if unknown.
        """
        last = rows[-1]
        if self._points and 1e-9 * float(last["deadline_ns"]) < self._points[-1][0]:
            self._points.clear()  # the run restarted
        created = float(last["environment_energy"])
        late = rows["wake_ns"] - rows["deadline_ns"]
        self._points.append(
            (
                1e-9 * float(last["deadline_ns"]),
                *(
                    float(np.linalg.norm(rows[wrench][:, :3], axis=1).max()) * is_shown
                    for wrench, is_shown in (
                        ("wrench_on_device", self._is_held),
                        ("wrench_on_tool", True),
                    )
                ),
                1e3 * float(last["coupling_work"]),
                1e3 * float(last["device_energy"]),
                1e3 * created,
                1e3 * (slack - created),
                1e-3 * float(late.max()),
            )
        )

    def __len__(self) -> int:
        return len(self._points)

    @property
    def newest(self) -> tuple[float, ...]:
        """The newest point."""
        return self._points[-1]

    def add_point(self, point: Any) -> None:
        """Adds the newest point of another trace.

        Raises:
            RecordingError: It is none.
        """
        try:
            self._points.append(tuple(np.array(point, np.float64).reshape(1 + LINES).tolist()))
        except (TypeError, ValueError) as error:
            raise RecordingError(f"the curves of the run cannot be drawn: {error}") from None

    def curves(self) -> tuple[Array, list[Array]]:
        """Returns times in s, and the lines of ``PLOTS`` in its units, newest last."""
        table = np.array(self._points, dtype=np.float64).reshape(len(self._points), 1 + LINES)
        return table[:, 0].copy(), [table[:, 1 + line].copy() for line in range(LINES)]


class Ghost:
    """Drawing of the coupling: a ghost at the handle, a spring, an arrow for the force.

    Handle and tool are rarely farther apart than a few tenths of a millimetre, which is invisible
    in a picture. The ghost is therefore a shell around the tool, at the tool's pose without
    stretch. The spring goes from its surface towards the tool, several times as long as the
    stretch; the page shows the factor. A visible stretch is drawn from handle to tool.

    Args:
        scene: viser's scene.
        scenery: The scene of the run.
        hand: Number of the hand among those with a handle.

    Attributes:
        times: Length of the drawn spring divided by the stretch.
    """

    def __init__(self, scene: viser.SceneApi, scenery: Scenery, hand: int = 0) -> None:
        self._extent = extent = scenery.extent
        self._shell = scenery.tools[hand]
        own = f" {hand + 1}" if hand else ""
        self._longest, self.times = 0.0, 1
        self._handle = scene.add_frame(f"/handle{own}", show_axes=False)
        faces = np.asarray(self._shell.faces)
        corners = np.asarray(self._shell.vertices)
        self._surfaces = Surfaces(corners[faces])
        scene.add_mesh_simple(f"/handle{own}/shell", corners, faces, color=_BLUE, opacity=0.3)
        nothing = np.zeros((POINTS, 2, 3), dtype=np.float32)
        self._spring = scene.add_line_segments(
            f"/coupling{own}", nothing, (0, 0, 0), thickness=0.012 * extent
        )
        self._arrow = scene.add_arrows(
            f"/force on the hand{own}",
            nothing[:1],
            linear(_HAND),
            shaft_radius=0.01 * extent,
            head_radius=0.025 * extent,
            head_length=0.06 * extent,
        )

    def allow(self, stretch: float) -> None:
        """Enlarges the scale for a distance between handle and tool, in m."""
        self._longest = max(self._longest, stretch)
        self.times = enlargement(FARTHEST * self._extent, self._longest)

    def show(self, held: Held, hand_reference: float, tool_reference: float) -> None:
        """Draws an instant.

        Args:
            held: The hand at that instant.
            hand_reference: The force on the hand in N that is drawn longest, > 0.
            tool_reference: The force on the tool in N at which the spring is reddest, > 0.
        """
        strength = float(np.linalg.norm(held.hand_force))
        way = held.grip - held.handle
        stretch = float(np.linalg.norm(way))
        self.allow(stretch)
        self._handle.position, self._handle.wxyz = held.handle, held.handle_turn
        colour = linear(
            255.0 * force_colour(float(np.linalg.norm(held.tool_force)), tool_reference)
        )
        # it begins on the ghost's surface, unless it truly ends at the tool
        start = held.handle
        if self.times > 1 and stretch > 0.0:
            along = way / stretch
            aside = self._surfaces.way_out(matrix_of(held.handle_turn).T @ along)
            start = start + aside * along
        end = start + self.times * way
        self._spring.points = coil(start, end, 0.02 * self._extent).astype(np.float32)
        self._spring.colors = np.full((POINTS, 2, 3), colour, dtype=np.uint8)
        self._arrow.visible = strength > 1e-3 * hand_reference
        if self._arrow.visible:
            reach = MAX_ARROW * self._extent / max(hand_reference, strength)
            points = np.array([[end, end + reach * held.hand_force]])
            self._arrow.points = points.astype(np.float32)


def linear(colour: ArrayLike) -> tuple[int, int, int]:
    """Returns a colour for viser's lines and arrows, corrected for viser drawing them too light.

    viser interprets their numbers, 0 to 255, as linear light and not as sRGB.
    """
    share = np.asarray(colour, dtype=np.float64) / 255.0
    light = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    red, green, blue = np.round(255.0 * light).astype(int).tolist()
    return red, green, blue


def quoted(text: object) -> str:
    """Writes a text that is not of this program for a page of viser, which reads Markdown.

    Names and reasons may come from a foreign scene. Between more backticks than it holds, a text
    is shown as it is: no markup, link, image or HTML in it counts.
    """
    line = printable(str(text))
    longest = max(map(len, re.findall("`+", line)), default=0)
    fence = "`" * (longest + 1)
    return f"{fence} {line} {fence}"


class Page:
    """Draws instants of one run on viser's page.

    Args:
        server: Server of the page.
        scenery: The run's scene.
        parameters: Parameters of the run.
        facts: Metadata of the run, as recorded.

    Attributes:
        hand_reference: The force on the hand in N that is drawn longest, > 0.
        tool_reference: The force on the tool in N at which the spring is reddest, > 0.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        scenery: Scenery,
        parameters: RunParameters,
        facts: dict[str, str],
    ) -> None:
        self._server, self._is_held = server, is_held(facts)
        self.hand_reference = self.tool_reference = MIN_REFERENCE
        self._extent, self._strongest = scenery.extent, 0.0
        self._build_scene(scenery)
        self._ghosts = [Ghost(server.scene, scenery, hand) for hand in range(len(scenery.tools))]
        server.gui.set_panel_label(printable(f"hapticbridge: {facts.get('scene', '')}"))
        self.status = server.gui.add_markdown("waiting for the first tick")
        self._caption = _caption(scenery, parameters, facts)
        self._plots: list[viser.GuiUplotHandle] = []

    def add_curves(self) -> None:
        """Adds the force's curve above the controls, and below them legend and other curves.

        All curves would be below the lower edge of a usual window.
        """
        gui = self._server.gui
        self._words = gui.add_markdown("")
        self._explain()
        for number, (title, names) in enumerate(PLOTS):
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
                    order=None if number else self.status.order + 0.5,
                )
            )
        gui.add_markdown(self._caption)

    def allow(self, sights: Sequence[Sight]) -> None:
        """Enlarges the scales for known later values."""
        for sight in sights:
            for ghost, held in zip(self._ghosts, sight.hands, strict=True):
                ghost.allow(float(np.linalg.norm(held.handle - held.grip)))
            self._strongest = max(self._strongest, _strongest(sight))

    def _explain(self) -> None:
        times = self._ghosts[0].times
        said = _COLOURS_MEAN.format(
            length=f"{times} times as long as it is" if times > 1 else "as long as it is",
            pull=format_si(self.tool_reference, "N"),
            hand=_HAND_MEANS.format(longest=format_si(self.hand_reference, "N"))
            if self._is_held
            else "",
            strongest=format_si(max(self._strongest, self.tool_reference), "N"),
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
            for ghost, held in zip(self._ghosts, sight.hands, strict=True):
                ghost.show(held, self.hand_reference, self.tool_reference)
            self._show_contacts(sight)
            self._show_blow(sight)
        if self._plots:
            self._explain()

    def facts(self, sight: Sight) -> str:
        """Names the forces of an instant, and the newest blow of the tool.

        The force on the tool is named where it differs from that on the hand. Of several hands,
        those of the first; the pictures show all.
        """
        held = sight.hands[0]
        hand = float(np.linalg.norm(held.hand_force)) if self._is_held else None
        forces = format_forces(hand, float(np.linalg.norm(held.tool_force)))
        return forces if sight.blow is None else f"{forces}; {sight.blow.words}"

    def plot(self, time: Array, lines: Sequence[Array]) -> None:
        """Draws the curves.

        Args:
            time: Times in s, (n,), n >= 2.
            lines: One per line of ``PLOTS``, (n,) each, in its unit.
        """
        # a run at rest is not drawn as noise over the full height
        rest = (np.where(np.abs(line) < _ROUNDING, 0.0, line) for line in lines)
        for handle, (_, names) in zip(self._plots, PLOTS, strict=True):
            handle.data = (time, *(next(rest) for _ in names))

    def _build_scene(self, scenery: Scenery) -> None:
        scene, extent = self._server.scene, self._extent
        scene.set_up_direction("+z")
        self._bodies = {
            body: scene.add_frame(f"/body{body}", show_axes=False) for body in range(scenery.bodies)
        }
        for index, prop in enumerate(scenery.props):
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
        self._tendons = [
            scene.add_line_segments(
                f"/tendon{index}", nothing, linear(255.0 * colour[:3]), thickness=width
            )
            for index, (width, colour) in enumerate(
                zip(scenery.widths.tolist(), scenery.colours, strict=True)
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
        self._blow = scene.add_icosphere("/blow", 0.03 * extent, _BLOW, opacity=0.8, visible=False)
        self._blow_words = scene.add_label("/blow/words", "", anchor="bottom-left")
        centre, away = scenery.centre, 1.25 * extent
        self._server.initial_camera.look_at = tuple(centre)
        self._server.initial_camera.position = tuple(centre + away * np.array([0.7, -0.8, 0.6]))
        self._server.initial_camera.near = 0.01 * extent

    def _show_contacts(self, sight: Sight) -> None:
        self._strongest = max(self._strongest, self.tool_reference, _strongest(sight))
        reach = MAX_ARROW * self._extent / self._strongest
        touches = bool(len(sight.contact_places))
        self._contacts.visible = self._pushes.visible = touches
        if touches:
            places = sight.contact_places.astype(np.float32)
            self._contacts.points = places
            tips = places + reach * sight.contact_forces
            self._pushes.points = np.stack([places, tips], axis=1).astype(np.float32)

    def _show_blow(self, sight: Sight) -> None:
        blow = sight.blow
        self._blow.visible = blow is not None and blow.is_marked(sight.time)
        if blow is not None and self._blow.visible:
            self._blow.position = blow.place
            if self._blow_words.text != blow.words:
                self._blow_words.text = blow.words


def _strongest(sight: Sight) -> float:
    """Returns the largest contact force; contacts at a lever carry far more than the hand."""
    return float(np.linalg.norm(sight.contact_forces, axis=1).max(initial=0.0))


def _caption(scenery: Scenery, parameters: RunParameters, facts: dict[str, str]) -> str:
    method = method_of(facts)
    coupling = RunCoupling.of(
        method,
        parameters.timestep,
        requested_of(facts),
        law=parameters.coupling,
        measured=parameters.effective,
        is_always_implicit=scenery.is_always_implicit,
    )
    head = f"Method **{method.name}**, {1 / parameters.period:g} Hz"
    lines = [head, *coupling.sentences(), NOT_DRAWN]
    return "  \n".join(lines)
