"""Public names that are imported when somebody asks for them (PEP 562).

Importing everything takes seconds. Who needs a part of the package, as the recorder's process does,
does not wait for the rest; and the command line is in charge before the rest is imported, so that
Ctrl-C and a bad environment are answered in a word and not with Python's traceback.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from importlib.util import find_spec


def lazy_exports(
    package: str, places: Mapping[str, str], present: tuple[str, ...]
) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    """Returns what a package takes for its ``__getattr__``, ``__dir__`` and ``__all__``.

    Modules directly below the package are found too, as if they had been imported with it.

    Args:
        package: Its full name.
        places: The module that each public name comes from; a module's own name is the module.
        present: Public names that are there from the start.
    """
    names = sorted({*places, *present})

    def find(name: str) -> object:
        place = places.get(name, f"{package}.{name}")
        if name not in places and (name.startswith("__") or find_spec(place) is None):
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module = import_module(place)
        return module if place == f"{package}.{name}" else getattr(module, name)

    return find, lambda: names, names
