"""The architecture as the README states it: imports go one way."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "hapticbridge"

ORDER = (
    (
        "errors",
        "extras",
        "arguments",
        "jit",
        "tick",
        "pose",
        "clock",
        "signals",
        "picture",
        "jsonable",
        "quantity",
        "on_demand",
        "whole_file",
    ),
    ("coupling", "kernel", "mechanics", "passivity", "sweep"),
    ("scene",),
    ("rendering",),
    ("ledger", "inputs", "device"),
    ("guard", "recording", "certificate", "felt"),
    ("provenance", "summary", "workspace", "realtime"),
    ("commands",),
    ("arrangement", "opened", "commanded", "bridge", "audit", "identify", "compare", "export"),
    ("report", "film", "view", "theory_plots", "check", "doctor"),
    ("whatif",),  # runs the bridge and asks the audit, which must not know of either
    ("lab",),
    ("cli",),
)
RANK = {name: rank for rank, names in enumerate(ORDER) for name in names}

# devices are opened by name, and one of them is a recording; the import stands in the function
LAZY = {("device", "recording")}

FILES = [path for path in PACKAGE.rglob("*.py") if path.parent != PACKAGE or path.stem[0] != "_"]


def concept(path: Path) -> str:
    """Returns the module or package directly below hapticbridge that a file belongs to."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imports_of(path: Path) -> set[str]:
    """Returns the other concepts that a file imports."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    modules = [node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    mine = {module.split(".")[1] for module in modules if module.startswith("hapticbridge.")}
    return mine - {concept(path)} - {other for here, other in LAZY if here == concept(path)}


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_go_one_way(path: Path) -> None:
    for other in imports_of(path):
        assert RANK[other] <= RANK[concept(path)], f"{other} stands to the right of {path.name}"


def test_concepts_do_not_import_each_other_in_a_circle() -> None:
    edges: dict[str, set[str]] = {}
    for path in FILES:
        edges.setdefault(concept(path), set()).update(imports_of(path))

    def visit(name: str, trail: tuple[str, ...]) -> None:
        assert name not in trail, " imports ".join((*trail, name))
        for other in edges[name]:
            visit(other, (*trail, name))

    for name in edges:
        visit(name, ())


def test_the_audit_never_imports_the_bridge() -> None:
    for path in (PACKAGE / "audit").glob("*.py"):
        assert "bridge" not in imports_of(path)


def test_the_core_never_imports_the_lab() -> None:
    """Studies stand outside; only commands that are studies import them."""
    importers = {str(path.relative_to(PACKAGE)) for path in FILES if "lab" in imports_of(path)}
    assert importers <= {"cli/chart.py", "cli/stability.py"}


def test_a_method_that_exists_only_to_be_compared_is_found_by_its_name() -> None:
    named = (
        "import sys; from hapticbridge.rendering import METHODS, method_named\n"
        "assert list(METHODS) == ['implicit', 'compensated', 'lossless']\n"
        "assert not [name for name in sys.modules if name.startswith('hapticbridge.lab')]\n"
        "assert method_named('explicit:rk4').integrator == 'RK4' and len(METHODS) == 10\n"
    )
    subprocess.run([sys.executable, "-c", named], check=True)


def test_every_concept_has_its_place() -> None:
    assert {concept(path) for path in FILES} == set(RANK)


GUIDES = [
    path.parent
    for path in PACKAGE.rglob("__init__.py")
    if path.parent.name != "engines"  # its table names engines
]


@pytest.mark.parametrize("folder", GUIDES, ids=lambda folder: str(folder.relative_to(PACKAGE)))
def test_a_package_sends_its_reader_to_modules_that_exist(folder: Path) -> None:
    guide = ast.get_docstring(ast.parse((folder / "__init__.py").read_text(encoding="utf-8"))) or ""
    assert guide
    for name in re.findall(r"``([a-z_.0-9]+)``", guide):
        place = folder.joinpath(*name.split("."))
        assert place.is_dir() or place.with_suffix(".py").is_file(), name
