"""Self-contained HTML pages."""

from __future__ import annotations

from pathlib import Path

from hapticbridge.errors import RecordingError
from hapticbridge.quantity import quantity
from hapticbridge.whole_file import whole_file

PAGES = (".html", ".htm")
"""Allowed extensions of a page; browsers show others as text."""


def check_page_name(path: Path) -> None:
    """Checks that a page can be written under a name, before anything is computed for it.

    Raises:
        RecordingError: The extension is not one of ``PAGES``, or the folder does not exist.
    """
    if path.suffix.lower() not in PAGES:
        raise RecordingError(f"the page '{path}' must end in {' or '.join(PAGES)}")
    if not path.absolute().parent.is_dir():
        raise RecordingError(f"cannot write '{path}': its folder does not exist")


def write_page(path: Path, template: str, **variables: object) -> None:
    """Writes a page; an existing file is replaced.

    ``template`` is a file in ``hapticbridge/templates``; ``variables`` are its variables.

    Raises:
        RecordingError: The page cannot be written, or not under this name.
    """
    check_page_name(path)
    from jinja2 import Environment, PackageLoader, select_autoescape  # noqa: PLC0415 - for pages

    environment = Environment(
        loader=PackageLoader("hapticbridge", "templates"), autoescape=select_autoescape()
    )
    environment.filters["quantity"] = quantity
    page = environment.get_template(template).render(variables)
    try:
        with whole_file(path) as draft:
            draft.write_text(page, encoding="utf-8")
    except OSError as error:
        raise RecordingError(f"cannot write '{path}': {error.strerror}") from None
