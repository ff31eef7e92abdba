"""Programs that are compiled ahead of the first run."""

from __future__ import annotations

import gc
from pathlib import Path
from typing import Any

import pytest

from hapticbridge import audit
from hapticbridge.cli import main
from hapticbridge.kernel import jit, machine_code
from hapticbridge.run.programs import programs


def test_the_first_run_and_its_audit_load_what_was_compiled_ahead(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for each in gc.get_objects():
        if type(each) is jit.Compiled:
            monkeypatch.setattr(each, "_direct", {})
    found, read = set[str](), machine_code.read

    def noted(path: Path) -> Any:
        found.add(path.name)
        return read(path)

    monkeypatch.setattr(machine_code, "read", noted)
    recording = tmp_path / "a.mcap"
    assert (
        main(["run", "point_mass", "--fast", "--duration", "0.01", "--record", str(recording)]) == 0
    )
    audit(recording)
    names = {each.function.file_name(each.arguments, each.c_types) for each in programs()}
    # the point mass has no boxes; the code of the simulated device may be loaded already
    needless = "box_box", "flat_flat", "round_flat", "next_sample"
    assert {name for name in names if not name.startswith(needless)} <= found
