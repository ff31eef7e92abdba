"""Common base of the stability maps: points, evaluation, numbers, picture and sentences."""

from __future__ import annotations

import contextlib
import json
import math
import re
import tempfile
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import ArrayLike, NDArray

from hapticbridge.device import Hand, Motion
from hapticbridge.errors import StudyError
from hapticbridge.files import finite_or_null, prepared_folder, writing
from hapticbridge.lab.closed_loop import ClosedLoop
from hapticbridge.lab.maps.twins import ENDINGS, RecordedTwins, Twins
from hapticbridge.lab.methods import METHODS
from hapticbridge.plotting import write_picture
from hapticbridge.scene import Scene, load_scene
from hapticbridge.scene.load import scene_path
from hapticbridge.sweep import Table, Workers, check_format, sweep
from hapticbridge.theory.bounds import maximum_stiffness

Point = dict[str, float | int | str | bool]

MIN_POINTS, MAX_POINTS = 4, 1_000_000
"""Smallest and largest number of points of a map. Fewer form no grid. A million take hours to days
and a gigabyte."""


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of a map.

    Attributes:
        figure: The picture, legible at 800 pixels.
        paragraph: A few sentences with the numbers of the picture.
        boundary: Limits of the methods, measured beside predicted; for JSON.
    """

    figure: Figure
    paragraph: str
    boundary: Mapping[str, Any]


Sentences = Iterable[tuple[str, Mapping[str, Any]]]
"""Sentences with fields in braces, and the numbers that fill them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StabilityMap:
    """A map: its points, their evaluation, and the reading of the table.

    Attributes:
        name: Name at the command line.
        doc: Docstring of the map's module; ``about`` is its first line behind the colon.
        default_points: Approximate number of points by default.
        points: Returns approximately the requested number of points, in a fixed order.
        evaluate: Computes one point; at the top level of a module, so that other processes find it.
        summarize: Returns the numbers of a table: limits of the methods, measured beside predicted.
        draw: Draws a table and its numbers.
        sentences: States the numbers; see ``paragraph``.
        twins: Returns two runs that differ in one value: one fails, one holds.
    """

    name: str
    doc: str | None
    default_points: int
    points: Callable[[int], Sequence[Point]]
    evaluate: Callable[[Point], Mapping[str, float | int | str | bool]]
    summarize: Callable[[Table], Mapping[str, Any]]
    draw: Callable[[Table, Mapping[str, Any]], Figure]
    sentences: Callable[[Mapping[str, Any]], Sentences]
    twins: Callable[[], Twins]

    @classmethod
    def from_module(cls, module: Any) -> StabilityMap:
        """Returns the map that a module holds under the names of these attributes."""
        names = ("points", "evaluate", "summarize", "draw", "sentences", "twins")
        functions = {name: getattr(module, name) for name in names}
        return cls(
            name=module.__name__.rpartition(".")[2],
            doc=module.__doc__,
            default_points=module.DEFAULT_POINTS,
            **functions,
        )

    @property
    def about(self) -> str:
        """Subject of the map in one sentence."""
        return (self.doc or "").partition("\n")[0].partition(": ")[2].rstrip(".")

    def read(self, table: Table) -> Finding:
        """Reads the rows of points that were computed.

        Raises:
            StudyError: There is no such row.
        """
        if not len(table):
            raise StudyError(f"map '{self.name}': the table has no rows; there is nothing to read")
        if table.failed.all():
            raise StudyError(
                f"map '{self.name}': no point could be computed; first: {table['error'][0]}"
            )
        table = table.select(~table.failed)
        boundary = self.summarize(table)
        return Finding(self.draw(table, boundary), paragraph(self.sentences(boundary)), boundary)


def paragraph(sentences: Sentences) -> str:
    """Fills numbers into sentences; a sentence is left out if its number is missing."""
    facts = []
    for text, numbers in sentences:
        with contextlib.suppress(KeyError, TypeError):
            facts.append(text.format_map(numbers))
    return ". ".join(facts) + "."


@dataclass(frozen=True, slots=True)
class MapFiles:
    """Files and finding of a map.

    Attributes:
        picture: PNG.
        table: CSV or Parquet, one row per point.
        boundary: JSON: ``about``, ``paragraph``, ``points``, ``failed``, ``boundary``,
            ``twins``.
        finding: Figure, paragraph and limits.
        twins: Recordings of a run that fails and of its safe twin.
        failed: Number of points that could not be computed; their reasons are in the table.
    """

    picture: Path
    table: Path
    boundary: Path
    finding: Finding
    twins: RecordedTwins
    failed: int


def run_map(
    stability_map: StabilityMap,
    folder: Path,
    *,
    points: int | None = None,
    form: str = "csv",
    workers: Workers = None,
    progress: Callable[[int, int], None] | None = None,
) -> MapFiles:
    """Computes a map and writes its picture, table, boundary and the recordings of its twins.

    Results are kept in ``folder/NAME.parts``. After an interruption a new run of the map continues
    from there.

    Args:
        stability_map: The map.
        folder: Folder to write into; made if missing.
        points: Approximate number, 4 to 1 000 000; None for the map's own number.
        form: Format of the table: ``csv`` or ``parquet`` (needs the extra ``tables``).
        workers: As for ``sweep``.
        progress: Called with the points done and all points.

    Raises:
        StudyError: The folder, the workers or the number cannot be used, or every point failed.
        HapticBridgeError: A recording cannot be written.
    """
    if points is not None and not MIN_POINTS <= points <= MAX_POINTS:
        raise StudyError(
            f"points is {points}; a map needs {MIN_POINTS} or more, and {MAX_POINTS} at most"
        )
    name = stability_map.name
    check_format(form)
    files = {end: folder / f"{name}.{end}" for end in ("png", form, "json", *ENDINGS)}
    prepared_folder(folder, [path.name for path in files.values()])
    table = sweep(
        stability_map.evaluate,
        stability_map.points(points or stability_map.default_points),
        results=folder / f"{name}.parts",
        workers=workers,
        progress=progress,
    )
    table.write(files[form])  # the table first: computing it took the time
    failed = int(table.failed.sum())
    finding = stability_map.read(table)
    write_picture(finding.figure, files["png"])
    fails, safe = (files[ending] for ending in ENDINGS)
    twins = stability_map.twins().record((fails, safe))
    facts = {
        "map": name,
        "about": stability_map.about,
        "points": len(table),
        "failed": failed,
        "paragraph": finding.paragraph,
        "boundary": finding.boundary,
        "twins": twins.facts,
    }
    text = json.dumps(finite_or_null(facts), indent=2, allow_nan=False)
    with writing(files["json"], StudyError):
        files["json"].write_text(text + "\n", encoding="utf-8")
    return MapFiles(files["png"], files[form], files["json"], finding, twins, failed)


WIDTH = 1e-3
"""Relative width of a bracket, without unit, at which maps end a search: a tenth of a per cent. No
agreement below half of it is reported. Halving it costs one run more."""


@dataclass(frozen=True, slots=True)
class Bracket:
    """Bracket around a stability limit.

    Attributes:
        lower: Largest value that was stable; 0 if the lower end of the search was not.
        upper: Smallest value above it that was not; inf if the upper end of the search was
            stable.
    """

    lower: float
    upper: float

    @property
    def middle(self) -> float:
        """Geometric mean of the ends; it is within half the relative width of the limit."""
        if self.lower == 0 or math.isinf(self.upper):
            return self.lower if self.lower == 0 else self.upper
        return math.sqrt(self.lower * self.upper)


def largest_stable(
    is_stable: Callable[[float], bool], lower: float, upper: float, width: float = WIDTH
) -> Bracket:
    """Finds the limit of stability by bisection, even in the logarithm.

    Args:
        is_stable: Returns True for a stable value: stable below one limit and not above it. If
            stability changes more than once, one of the changes is found.
        lower: Lower end of the search, > 0.
        upper: Upper end, > lower. Ends that are independent of a prediction keep the search
            independent of it.
        width: Relative width at which the search ends, > 0.

    Returns:
        The bracket; ``Bracket(0, lower)`` if nothing was stable; ``Bracket(upper, inf)`` if all
            was.

    Raises:
        StudyError: An end or the width is out of range.
    """
    if not (0 < lower < upper < math.inf and 0 < width < math.inf):
        raise StudyError(
            f"a search from {lower!r} to {upper!r} with the width {width!r} is none; it needs "
            "0 < lower < upper and a width > 0"
        )
    if not is_stable(lower):
        return Bracket(0.0, lower)
    if is_stable(upper):
        return Bracket(upper, math.inf)
    while upper > lower * (1 + width):
        middle = math.sqrt(lower * upper)
        lower, upper = (middle, upper) if is_stable(middle) else (lower, middle)
    return Bracket(lower, upper)


def agreement(measured: ArrayLike, predicted: ArrayLike, width: float = WIDTH) -> float | None:
    """Returns the largest relative deviation, at least the resolution of the search.

    That is max(deviation, width/2), without unit; None where nothing can be compared.

    Args:
        measured: Middles of brackets, any shape.
        predicted: Predicted values, broadcastable with ``measured``.
        width: Relative width of the brackets.
    """
    ratio = np.asarray(measured, dtype=np.float64) / np.asarray(predicted, dtype=np.float64)
    known = np.abs(ratio[np.isfinite(ratio)] - 1)
    return max(float(known.max()), width / 2) if known.size else None


PERIOD = 1e-3
"""Period T in s of the runs of a map, unless it varies the period."""


def used_damping(name: str, stiffness: ArrayLike, damping: ArrayLike) -> NDArray[np.float64]:
    """Returns B' in N s/m, the damping of a method's law: max(B − a K T, 0).

    It is ``Method.law_coupling`` over arrays; the method's integration adds a K T again.

    Args:
        name: The method; a is its ``compensated_share``.
        stiffness: K in N/m.
        damping: Requested B in N s/m; broadcasts with K.
    """
    taken = METHODS[name].compensated_share * PERIOD * np.asarray(stiffness, dtype=np.float64)
    return np.asarray(np.maximum(np.asarray(damping, dtype=np.float64) - taken, 0.0))


def law_in_words(name: str, subscript: str = "") -> str:
    """Returns the damping of a method's law, as titles and legends name it.

    Args:
        name: The method.
        subscript: Subscript of K and B: empty, or ``_r`` in rotation.
    """
    lag = METHODS[name].compensated_share
    taken = {0.0: "", 0.5: f" − K{subscript} T/2"}.get(lag, f" − K{subscript} T")
    return f"B{subscript}′ = B{subscript}{taken}"


def needed_by_6(name: str, stiffness: ArrayLike, damping: ArrayLike) -> NDArray[np.float64]:
    """Returns the device damping in N s/m that (6) requires, K T/2 + B'."""
    spring = np.asarray(stiffness, dtype=np.float64) * PERIOD / 2
    return np.asarray(spring + used_damping(name, stiffness, damping))


def limit_by_6(name: str, device_damping: float, damping: ArrayLike) -> NDArray[np.float64]:
    """Returns the K in N/m at which K T/2 + B' = b, for B < b.

    That is 2 (b − B)/T for methods that use B as requested. For methods that subtract their own
    damping (compensated_share ½ or 1) the limit is 2b/T, because B' is 0 there.
    """
    spent = np.asarray(damping, dtype=np.float64) * (METHODS[name].compensated_share == 0.0)
    return np.asarray(maximum_stiffness(device_damping, PERIOD, spent))


METHOD_COLOURS = {name: f"C{place}" for place, name in enumerate(METHODS)}
"""Colour of each rendering method's lines."""

THEORY_COLOUR = "#1a5fb4"
"""Colour of computed curves that were not measured, unless they are black."""


STILL = Motion([0.0, 1.0], np.zeros((2, 3)))
"""Path of a hand that pulls towards its place."""


STEADY_HAND = Hand(
    mass=0.0,
    damping=0.0,
    stiffness=1.0,
    rotational_inertia=0.0,
    rotational_damping=0.0,
    rotational_stiffness=0.0,
)
"""Hand that presses with a steady force of 1 N per metre of its target's distance. A stiffer one
would add to the stiffness of a wall."""


def pressing(*forces: tuple[float, float]) -> Motion:
    """Returns the path of ``STEADY_HAND`` along x that presses with given forces.

    Args:
        forces: Time in s and force in N, from the start of the run; the force is linear in between
            and constant afterwards.
    """
    table = np.array([(0.0, 0.0), *forces])
    path = np.zeros((len(table), 3))
    path[:, 0] = table[:, 1] / STEADY_HAND.stiffness
    return Motion(table[:, 0], path)


def swinging(amplitude: float, frequency: float, duration: float, count: int) -> Motion:
    """Returns the path of a hand that swings along x and turns nothing: A (1 − cos 2πft).

    Args:
        amplitude: A in m; it goes 2A far and back.
        frequency: f in Hz.
        duration: Duration in s.
        count: Number of rows, evenly over the duration; between them the path is straight.
    """
    time = np.linspace(0.0, duration, count)
    path = np.zeros((count, 3))
    path[:, 0] = amplitude * (1 - np.cos(2 * np.pi * frequency * time))
    return Motion(time, path)


_of_this_thread = threading.local()


def scene_of(mjcf: str) -> Scene:
    """Loads a scene from MJCF text that refers to no other file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "rig.xml"
        path.write_text(mjcf, encoding="utf-8")
        return load_scene(path)


def free_body(mass: float, inertia: ArrayLike) -> str:
    """Returns the MJCF of a tool in free space: no gravity, no contact, held at its centre.

    Args:
        mass: Mass in kg.
        inertia: Principal moments about its centre in kg m², shape (3,).
    """
    moments = " ".join(map(repr, np.asarray(inertia, float).tolist()))
    return f"""
<mujoco>
  <option gravity="0 0 0"/>
  <worldbody>
    <body name="tool">
      <freejoint/>
      <inertial pos="0 0 0" mass="{mass!r}" diaginertia="{moments}"/>
      <geom type="sphere" size="0.01" mass="0" contype="0" conaffinity="0"/>
      <site name="grip"/>
    </body>
  </worldbody>
</mujoco>"""


def free_wall(mass: float) -> Scene:
    """Loads a wall without contact: a free body of a mass in kg that no hand moves."""
    return scene_of(free_body(mass, np.full(3, mass)))


def free_tool_and_wall() -> Scene:
    """Loads ``virtual_wall`` without its rail: a tool with six degrees of freedom."""
    text = scene_path("virtual_wall").read_text(encoding="utf-8")
    freed, count = re.subn(r"<joint [^>]*type=\"slide\"[^>]*/>", "<freejoint/>", text)
    assert count == 1, "virtual_wall has one slide joint"
    return scene_of(freed.replace('<key name="home" qpos="0"/>', '<key name="home"/>'))


def loop_in(
    scene: str | Callable[[], Scene],
    key: object = None,
    change: Callable[[mujoco.MjModel], None] | None = None,
) -> ClosedLoop:
    """Returns a closed loop on a scene, made once per thread.

    Args:
        scene: Name of a shipped scene, or a function that loads one.
        key: Key of this change; loops are kept by scene and key.
        change: Applied to the model before the first run; derived constants are then recomputed.
    """
    loops: dict[object, ClosedLoop] = _of_this_thread.__dict__.setdefault("loops", {})
    if (scene, key) not in loops:
        loop = ClosedLoop(load_scene(scene) if isinstance(scene, str) else scene())
        if change is not None:
            change(loop.scene.model)
            mujoco.mj_setConst(loop.scene.model, loop.scene.data)
        loops[scene, key] = loop
    return loops[scene, key]


def wall_loop(mass: float, scene: str | Callable[[], Scene] = "virtual_wall") -> ClosedLoop:
    """Returns a closed loop whose tool is a wall, too heavy for any hand to move.

    Args:
        mass: Mass of the tool in kg.
        scene: Scene as for ``loop_in``; its tool is called ``tool``.
    """
    return loop_in(scene, ("wall", mass), lambda model: set_tool_mass(model, "tool", mass))


def set_tool_mass(model: mujoco.MjModel, body: str, mass: float) -> None:
    """Sets the mass of a body and scales its inertia in proportion.

    The inertia per kg is rounded to single precision, so that a mass set before leaves no trace.
    The result of a point must not depend on earlier points, even in its last bit.

    Args:
        model: Changed in place; ``mj_setConst`` must follow.
        body: The tool's name.
        mass: Mass in kg.
    """
    body_id = model.body(body).id
    per_kg = model.body_inertia[body_id] / model.body_mass[body_id]
    model.body_inertia[body_id] = mass * per_kg.astype(np.float32).astype(np.float64)
    model.body_mass[body_id] = mass


VERDICTS = ("strict", "within slack", "active", "unstable")
"""Verdicts from safe to unsafe. The first three describe the environment; ``unstable`` describes
the loop."""

MISSING = "no point could be computed"
"""Text of a picture or a paragraph if every point of a group failed."""

COLOURS = ("#a8d5ba", "#f4e3a1", "#f0a868", "#c0504d")
"""Colours of the verdicts; lightness differs as well as hue."""


def verdict_numbers(is_stable: ArrayLike, environment: NDArray[np.object_]) -> NDArray[np.int64]:
    """Returns the index of each run's verdict in ``VERDICTS``."""
    numbers = np.array([VERDICTS.index(name) for name in environment], dtype=np.int64)
    return np.where(np.asarray(is_stable, dtype=bool), numbers, VERDICTS.index("unstable"))


def of_method(table: Table, what: str, name: str) -> Table:
    """Returns the rows of one kind of point and one method."""
    return table.select((table["what"] == what) & (table["method"] == name))


def panels(figure: Figure, count: int) -> list[Axes]:
    """Returns panels with shared axes in rows of three, such as one a method."""
    rows = -(-count // 3)
    all_panels = figure.subplots(rows, 3, sharex=True, sharey=True, squeeze=False).ravel()
    for spare in all_panels[count:]:
        spare.remove()
    return list(all_panels[:count])


FILLED = 6
"""Number of columns and of rows from which on a grid of runs is drawn as areas."""


def draw_verdicts(
    axes: Axes,
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    verdict: NDArray[np.int64],
    *,
    log_x: bool = False,
    log_y: bool = False,
) -> None:
    """Colours a grid of runs by verdict.

    Args:
        axes: Axes to draw into.
        x: Abscissa of each run, shape (n,); the runs fill a grid.
        y: Ordinate of each run, shape (n,).
        verdict: Numbers from ``verdict_numbers``.
        log_x: True if x is even in its logarithm.
        log_y: True if y is even in its logarithm.

    A grid of fewer than ``FILLED`` columns or rows is drawn as its points, because a filled area
    between them would claim what nothing measured. Without a run the axes state that no point could
    be computed.
    """
    if log_x:
        axes.set_xscale("log")
    if log_y:
        axes.set_yscale("log")
    if not len(x):
        say_missing(axes)
        return
    columns, rows = np.unique(x), np.unique(y)
    if min(columns.size, rows.size) < FILLED:
        colours = [COLOURS[each] for each in verdict]
        axes.scatter(x, y, c=colours, marker="s", s=70, edgecolors="black", clip_on=False, zorder=4)
        return
    cells = np.full((rows.size, columns.size), np.nan)
    cells[np.searchsorted(rows, y), np.searchsorted(columns, x)] = verdict
    axes.pcolormesh(
        _edges(columns, is_log=log_x),
        _edges(rows, is_log=log_y),
        cells,
        cmap=ListedColormap(COLOURS),
        vmin=-0.5,
        vmax=len(VERDICTS) - 0.5,
        rasterized=True,
    )


def say_missing(axes: Axes) -> None:
    """Writes into empty axes that every point of a group failed."""
    axes.text(0.5, 0.5, MISSING, ha="center", va="center", transform=axes.transAxes)


def _edges(centres: NDArray[np.float64], *, is_log: bool) -> NDArray[np.float64]:
    """Returns the borders between cells, and an equal distance outside the first and the last."""
    at = np.log(centres) if is_log else centres
    if at.size == 1:
        middle = np.array([at[0] - 0.5, at[0] + 0.5])
    else:
        inner = (at[1:] + at[:-1]) / 2
        middle = np.concatenate([[2 * at[0] - inner[0]], inner, [2 * at[-1] - inner[-1]]])
    return np.asarray(np.exp(middle) if is_log else middle)


def verdict_legend(
    figure: Figure, lines: Sequence[tuple[str, str, str]] = (), columns: int = 4
) -> None:
    """Names the colours, and the lines of theory, below a figure.

    Args:
        figure: A complete figure.
        lines: Label, colour and line style each; the styles ``o`` and ``s`` are white circles and
            squares.
        columns: Number of columns of the legend.
    """
    handles: list[object] = [
        Patch(facecolor=colour, label=name) for name, colour in zip(VERDICTS, COLOURS, strict=True)
    ]
    axes = figure.axes[0]
    for label, colour, style in lines:
        is_marker = style in ("o", "s")
        handles += axes.plot(
            [],
            [],
            color=colour,
            label=label,
            ls="" if is_marker else style,
            marker=style if is_marker else "",
            mfc="white",
        )
    figure.legend(
        handles=handles, loc="outside lower center", ncols=columns, fontsize="small", frameon=False
    )
