"""Writes the walk: one page that needs nothing else, and its figures as files."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from jinja2 import Environment, PackageLoader, select_autoescape

from hapticbridge.errors import HapticBridgeError
from hapticbridge.plotting import inline_svg, write_picture
from hapticbridge.study.paper.check import Check
from hapticbridge.study.paper.section import Section

PAGE = "brown_colgate_1997.html"
"""Name of the page; the figures lie beside it as PNG."""


def number(value: float) -> str:
    """Formats a number of a check: six digits, ``∞`` for infinity, a real minus sign."""
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    return f"{value:.6g}".replace("-", "−")


def deviation(check: Check) -> str:
    """Formats a check's deviation with the tolerance that it is held against."""
    got = f"{check.deviation:.1e}" if check.deviation else "0"
    allowed = f"{check.tolerance:.0e}" if check.tolerance else "0"
    return f"{got} (≤ {allowed})".replace("-", "−")


def passed(sections: Sequence[Section]) -> bool:
    """Returns whether every check passed."""
    return all(check.has_passed for section in sections for check in section.checks)


def write_walk(sections: Sequence[Section], folder: Path) -> Path:
    """Writes the page and the figures.

    Args:
        sections: What to write, in the order of the page.
        folder: Where; it exists.

    Returns:
        The page's path.

    Raises:
        HapticBridgeError: A file cannot be written.
    """
    for section in sections:
        for curve in section.curves:
            write_picture(curve.figure, folder / f"{curve.name}.png")
            # the places just found serve the page too; finding them takes half of the drawing
            curve.figure.set_layout_engine("none")
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
    try:
        path.write_text(page, encoding="utf-8")
    except OSError as error:
        raise HapticBridgeError(f"cannot write '{path}': {error.strerror}") from None
    return path
