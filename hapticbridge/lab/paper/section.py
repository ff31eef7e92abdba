"""A part of the walk through the paper: equation, explanation, curves, checks."""

from __future__ import annotations

import inspect
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from jinja2 import Environment, PackageLoader, select_autoescape
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hapticbridge.errors import HapticBridgeError
from hapticbridge.files import writing
from hapticbridge.plotting import inline_svg, new_figure, write_picture

Relation = Literal["equals", "at most", "at least"]
"""Relation between the number that was got and the expected one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """A number of the paper, found by two routes.

    The routes share as little as possible; ``route`` describes both. A closed form and its sweep
    over frequency have only the coupling in common. A time-domain loop takes its worst hand from
    the theory, and finds the limit itself. If only a kept value is compared with the code,
    ``route`` states that.

    Attributes:
        equation: Number of the equation in the paper: ``(6)``; empty takes the section's.
        quantity: Name of the number.
        route: Origin of ``got``, against that of ``expected``.
        expected: Value from the equation.
        got: Value from the other route.
        tolerance: Largest deviation that passes, relative to ``expected``, or in the number's own
            unit where ``expected`` is 0.
        unit: Unit of both numbers.
        relation: ``equals``, or the kind of bound that ``expected`` is for ``got``.
    """

    quantity: str
    route: str
    expected: float
    got: float
    equation: str = ""
    tolerance: float = 1e-9
    unit: str = ""
    relation: Relation = "equals"

    @property
    def deviation(self) -> float:
        """Deviation to the wrong side, relative unless ``expected`` is 0; nan is kept."""
        if self.got == self.expected:  # the difference of two infinities is undefined
            return 0.0
        difference = self.got - self.expected
        if self.relation == "equals":
            difference = abs(difference)
        elif self.relation == "at least":
            difference = -difference
        if math.isfinite(self.expected) and self.expected != 0:
            difference /= abs(self.expected)
        return difference if not difference < 0 else 0.0

    @property
    def has_passed(self) -> bool:
        """True if the deviation is within the tolerance; never for nan."""
        return self.deviation <= self.tolerance


@dataclass(frozen=True, slots=True)
class Table:
    """Numbers side by side.

    Attributes:
        head: One heading per column, with unit.
        rows: Cells as text.
    """

    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """A section of the page: one equation, or a few that belong together.

    Formulas are the package's own HTML; text from a user must not enter them.

    Attributes:
        equation: Their numbers in the paper, ``(15), (16)``; empty for a subject without
            equation.
        title: Subject.
        formulas: The equations, one line each.
        paragraphs: Their meaning, and the method of the check.
        name: Name of the figure's file, without ending.
        caption: Content of the figure, in one or two sentences.
        figure: The drawing.
        checks: Numbers by two routes.
        table: Numbers side by side, if any.
    """

    equation: str
    title: str
    formulas: tuple[str, ...]
    paragraphs: tuple[str, ...]
    name: str
    caption: str
    figure: Figure
    checks: Sequence[Check]
    table: Table | None = None

    def __post_init__(self) -> None:
        named = [replace(check, equation=check.equation or self.equation) for check in self.checks]
        object.__setattr__(self, "checks", tuple(named))


def explained(doc: str | None, **numbers: float) -> tuple[str, ...]:
    """Returns the paragraphs below the summary of a section's docstring, numbers filled in."""
    _, *paragraphs = inspect.cleandoc(doc or "").split("\n\n")
    return tuple(" ".join(each.split()).format(**numbers) for each in paragraphs)


def panels(rows: int, *, height: float, columns: int = 1) -> tuple[Figure, tuple[Axes, ...]]:
    """Returns a figure 8 inches wide and its axes, row by row.

    Args:
        rows: Panels above each other.
        height: Height of the figure in inches.
        columns: Panels beside each other.
    """
    figure = new_figure(8, height)
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes in grid.flat:
        axes.grid(alpha=0.3)
    return figure, tuple(grid.flat)


PAGE = "brown_colgate_1997.html"
"""File name of the page; the figures lie beside it as PNG."""


def number(value: float) -> str:
    """Formats a number of a check: six digits, ``∞`` for infinity, a real minus sign."""
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    return f"{value:.6g}".replace("-", "−")


def deviation(check: Check) -> str:
    """Formats a check's deviation and its tolerance."""
    got = f"{check.deviation:.1e}" if check.deviation else "0"
    allowed = f"{check.tolerance:.0e}" if check.tolerance else "0"
    return f"{got} (≤ {allowed})".replace("-", "−")


def passed(sections: Sequence[Section]) -> bool:
    """Returns True if every check passed."""
    return all(check.has_passed for section in sections for check in section.checks)


def write_walk(sections: Sequence[Section], folder: Path) -> Path:
    """Writes the page and the figures.

    Args:
        sections: Sections in the order of the page.
        folder: Existing folder to write into.

    Returns:
        The page's path.

    Raises:
        HapticBridgeError: A file cannot be written.
    """
    for section in sections:
        write_picture(section.figure, folder / f"{section.name}.png")
        # the layout found here serves the page too; finding it takes half of the drawing
        section.figure.set_layout_engine("none")
    environment = Environment(
        loader=PackageLoader("hapticbridge", "templates"), autoescape=select_autoescape()
    )
    environment.filters["number"] = number
    environment.filters["deviation"] = deviation
    environment.filters["svg"] = inline_svg
    page = environment.get_template("paper.html").render(
        sections=sections,
        checks=[check for section in sections for check in section.checks],
        has_passed=passed(sections),
    )
    path = folder / PAGE
    with writing(path, HapticBridgeError):
        path.write_text(page, encoding="utf-8")
    return path
