"""Colours with one meaning in every map: a method's, and theory's; verdicts have their own."""

from __future__ import annotations

from collections.abc import Mapping

METHOD_COLOURS: Mapping[str, str] = {
    "implicit": "#000000",
    "compensated": "#9aa3d6",
    "lossless": "#3a1fd1",
    "implicitfast": "#7b3294",
    "implicitfast:compensated": "#d684bd",
    "explicit": "#00868b",
    "explicit:implicitfast": "#5cc8d8",
    "explicit:rk4": "#7f7f7f",
    "weld": "#6b3f14",
    "direct": "#d6219c",
}
"""Colour of each rendering method's lines. None is near a verdict's (``verdicts.COLOURS``: green,
yellow, orange, red): red would say that a method is unstable."""

THEORY_COLOUR = "#1a5fb4"
"""Colour of what was computed and not measured, unless it is black."""
