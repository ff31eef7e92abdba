"""Lazy public names of a package (PEP 562)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from importlib.util import find_spec


def lazy_exports(
    package: str, places: Mapping[str, str], present: tuple[str, ...]
) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    """Returns a package's ``__getattr__``, ``__dir__`` and ``__all__`` with lazy imports.

    Importing everything takes seconds. A part of the package, such as the recorder's process, does
    not wait for the rest. The command line handles Ctrl-C and a bad environment before the rest is
    imported, so neither ends in a traceback. Modules directly below the package are found too.

    Args:
        package: Full name of the package.
        places: Module of each public name; a module's own name maps to the module.
        present: Public names that are already imported.
    """
    names = sorted({*places, *present})

    def find(name: str) -> object:
        place = places.get(name, f"{package}.{name}")
        if name not in places and (name.startswith("__") or find_spec(place) is None):
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module = import_module(place)
        return module if place == f"{package}.{name}" else getattr(module, name)

    return find, lambda: names, names
