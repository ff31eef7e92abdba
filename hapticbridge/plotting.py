"""Figures and picture files."""

from __future__ import annotations

import io
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hapticbridge.errors import HapticBridgeError
from hapticbridge.files import atomic_write, check_target, writing

if TYPE_CHECKING:
    from matplotlib.figure import Figure


ENDINGS = (".pdf", ".png", ".svg")
"""Extensions of picture files."""

DOTS_PER_INCH = 100
"""Resolution of a picture file in 1/inch: a figure 8 inches wide has 800 pixels. A larger one makes
larger files."""


def check_ending(path: Path | None) -> None:
    """Checks that a picture can be written to a file, before anything is computed for it.

    None, for no picture, passes.

    Raises:
        HapticBridgeError: The extension is not one of ``ENDINGS``, or no such file can be made.
    """
    if path is None:
        return
    if path.suffix.lower() not in ENDINGS:
        raise HapticBridgeError(
            f"the picture '{path}' must end in {', '.join(ENDINGS[:-1])} or {ENDINGS[-1]}"
        )
    check_target(path, HapticBridgeError)


def new_figure(width: float, height: float) -> Figure:
    """Returns an empty figure, sizes in inches, that needs no display."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415 - takes 0.5 s
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _save(figure: Figure, target: Path | io.StringIO, **options: Any) -> None:
    """Draws a figure into a file.

    Raises:
        HapticBridgeError: The user's settings have its texts set by LaTeX, which fails.
    """
    import matplotlib  # noqa: PLC0415 - takes 0.5 s

    try:
        _draw(figure, target, **options)
    except RuntimeError as error:
        if not matplotlib.rcParams["text.usetex"]:
            raise
        raise HapticBridgeError(
            f"the picture cannot be drawn with LaTeX ({str(error).splitlines()[0]}); set "
            f"text.usetex: False in '{matplotlib.matplotlib_fname()}'"
        ) from None


def _draw(figure: Figure, target: Path | io.StringIO, **options: Any) -> None:
    with warnings.catch_warnings():
        # characters missing in the font are drawn as boxes without a warning
        warnings.filterwarnings("ignore", message="Glyph", category=UserWarning)
        figure.savefig(target, **options)


def write_picture(figure: Figure, path: Path) -> None:
    """Writes a figure in the format of the file's extension.

    Raises:
        HapticBridgeError: The extension is no picture format, the file cannot be written, or LaTeX
            fails.
    """
    check_ending(path)
    with writing(path, HapticBridgeError), atomic_write(path) as draft:
        _save(figure, draft, dpi=DOTS_PER_INCH)


def inline_svg(figure: Figure) -> str:
    """Returns a figure as an ``<svg>`` element for a page."""
    buffer = io.StringIO()
    # a page needs none of matplotlib's metadata
    unwanted = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    _save(figure, buffer, format="svg", metadata=unwanted)
    text = buffer.getvalue()
    return text[text.index("<svg") :]
