"""A part of the walk through the paper: equation, explanation, curves, checks."""

from __future__ import annotations

from dataclasses import dataclass

from matplotlib.figure import Figure

from hapticbridge.study.paper.check import Check


@dataclass(frozen=True, slots=True)
class Curve:
    """A figure with its place and its caption.

    Attributes:
        name: Name of its file, without ending.
        caption: What it shows, one or two sentences.
        figure: The drawing.
    """

    name: str
    caption: str
    figure: Figure


@dataclass(frozen=True, slots=True)
class Table:
    """Numbers side by side.

    Attributes:
        head: One heading per column, with unit.
        rows: Cells as they are shown.
    """

    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """What the page says about one equation, or a few that belong together.

    Formulas and paragraphs are HTML of the package's own; nothing of a user's may enter them.

    Attributes:
        equation: Their numbers in the paper, ``(15), (16)``; empty for what the paper only names.
        title: What they are about.
        formulas: The equations, one line each.
        paragraphs: What they mean and how they are checked here.
        curves: Figures.
        checks: Numbers by two routes.
        table: Numbers side by side, if any.
    """

    equation: str
    title: str
    formulas: tuple[str, ...]
    paragraphs: tuple[str, ...]
    curves: tuple[Curve, ...]
    checks: tuple[Check, ...]
    table: Table | None = None
