"""Public names that are imported at their first use (PEP 562).

Importing everything takes seconds. A process that needs one part, such as the recorder's, does not
import the rest.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Callable
from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path


def lazy_exports(
    package: str,
) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    """Returns ``__getattr__``, ``__dir__`` and ``__all__`` of a package, from its own source.

    Imports above its ``if TYPE_CHECKING:`` have happened. Those in the block are for the type
    checker, and happen here at the first use of their names. Modules directly below the package are
    found without an import.

    Args:
        package: Full name of the package.
    """
    source = Path(str(sys.modules[package].__file__)).read_text(encoding="utf-8")
    present: list[str] = []
    places: dict[str, tuple[str, str]] = {}
    for top in ast.parse(source).body:
        for node in top.body if isinstance(top, ast.If) else [top]:
            match node:
                case ast.ImportFrom(module=str(module), names=aliases) if node is not top:
                    places |= {alias.name: (module, alias.name) for alias in aliases}
                case ast.ImportFrom(names=aliases):
                    present += [alias.name for alias in aliases if alias.asname]
                case ast.FunctionDef(name=name):
                    present.append(name)
    names = sorted({*places, *present})

    def find(name: str) -> object:
        if name == "__version__":
            return version(package)
        place, attribute = places.get(name, (package, name))
        if name not in places and (name.startswith("__") or not find_spec(f"{package}.{name}")):
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        if place == package:
            return import_module(f"{package}.{attribute}")
        return getattr(import_module(place), attribute)

    return find, lambda: names, names
