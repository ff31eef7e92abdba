"""Public names that are imported on demand are all there, and what they were; and nothing more."""

from __future__ import annotations

import ast
import sys
from pathlib import Path

import pytest

import hapticbridge as hb
import hapticbridge.audit.report
from hapticbridge.lazy import lazy_exports


def seen_by_the_type_checker(init: Path) -> set[str]:
    """Returns the names that a package's ``__init__`` re-exports, for the type checker and else."""
    tree = ast.parse(init.read_text(encoding="utf-8"))
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    names = {alias.name for node in imports for alias in node.names if alias.asname == alias.name}
    assigned = [node for node in ast.walk(tree) if isinstance(node, ast.Assign)]
    targets = [each for node in assigned for each in node.targets]
    return names | {each.id for each in targets if isinstance(each, ast.Name)}


@pytest.mark.parametrize("name", ["hapticbridge", "hapticbridge.audit"])
def test_what_the_type_checker_sees_is_what_there_is(name: str) -> None:
    package = sys.modules[name]
    seen = seen_by_the_type_checker(Path(str(package.__file__)))
    assert seen == set(dir(package))
    assert seen == set(package.__all__)
    for each in seen:
        assert getattr(package, each) is not None


def test_audit_is_the_function_although_a_package_has_its_name() -> None:
    assert callable(hb.audit)
    assert hb.audit is hapticbridge.audit
    with pytest.raises(hb.RecordingError, match="No such file"):
        hb.audit("missing.mcap")


def test_a_module_of_the_package_is_found_and_a_wrong_name_is_not() -> None:
    find, names, public = lazy_exports(
        "hapticbridge", {"Motion": "hapticbridge.device"}, ("audit",)
    )
    assert find("device") is sys.modules["hapticbridge.device"]
    assert find("Motion") is sys.modules["hapticbridge.device"].Motion
    assert names() == public == ["Motion", "audit"]
    for wrong in ("Motoin", "motion", "__wrapped__"):
        with pytest.raises(AttributeError, match=f"'hapticbridge' has no attribute '{wrong}'"):
            find(wrong)
    assert not hasattr(hb, "Brigde")
