"""Public names that are imported on demand are all there, and what they were; and nothing more."""

from __future__ import annotations

import sys

import pytest

import hapticbridge as hb
import hapticbridge.audit.verdict
from hapticbridge.lazy import lazy_exports


@pytest.mark.parametrize("name", ["hapticbridge", "hapticbridge.audit"])
def test_every_public_name_is_there(name: str) -> None:
    package = sys.modules[name]
    assert set(dir(package)) == set(package.__all__) >= {"AuditReport", "audit"}
    for each in package.__all__:
        assert getattr(package, each) is not None
    assert hb.theory is sys.modules["hapticbridge.theory"]


def test_audit_is_the_function_although_a_package_has_its_name() -> None:
    assert callable(hb.audit)
    assert hb.audit is hapticbridge.audit
    with pytest.raises(hb.RecordingError, match="No such file"):
        hb.audit("missing.mcap")


def test_a_module_of_the_package_is_found_and_a_wrong_name_is_not() -> None:
    find, names, public = lazy_exports("hapticbridge")
    assert find("device") is sys.modules["hapticbridge.device"]
    assert find("Device") is sys.modules["hapticbridge.device"].Device
    assert names() == public == dir(hb)
    for wrong in ("Motoin", "motion", "__wrapped__"):
        with pytest.raises(AttributeError, match=f"'hapticbridge' has no attribute '{wrong}'"):
            find(wrong)
    assert not hasattr(hb, "Brigde")
