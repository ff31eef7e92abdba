"""Public names that are imported at their first use (PEP 562).

Importing everything takes seconds. A process that needs one part, such as the recorder's, does not
import the rest.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from importlib.util import find_spec


def lazy_exports(
    package: str, places: Mapping[str, str], present: tuple[str, ...]
) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    """Returns ``__getattr__``, ``__dir__`` and ``__all__`` of a package.

    Modules directly below the package are found without an entry.

    Args:
        package: Full name of the package.
        places: Module of each public name. A trailing colon stands for the module itself.
        present: Public names that exist from the start.
    """
    names = sorted({*places, *present})

    def find(name: str) -> object:
        place = places.get(name, f"{package}.{name}")
        if name not in places and (name.startswith("__") or find_spec(place) is None):
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module = import_module(place.removesuffix(":"))
        is_module = place.endswith(":") or place == f"{package}.{name}"
        return module if is_module else getattr(module, name)

    return find, lambda: names, names
