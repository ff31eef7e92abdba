"""Every example runs by itself in an empty folder, and says what it found."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

from hapticbridge.cli.guide import page

EXAMPLES = sorted((Path(__file__).parents[1] / "scripts" / "examples").glob("*.py"))

SAID = {
    "batch_audit": "passive      0.15",
    "change_coupling": "passive (strict)",
    "custom_device": "strict",
    "device_over_a_socket": "strict",
    "first_run": "passive bit for bit",
    "key_moves_motor": "strict",
    "own_map": "implicitfast  K = 4000 N/m, 0.05 kg: active",
    "plot_with_pandas": "of the time in contact",
    "scene_in_python": "strict",
    "sweep_on_dask": "0.1 mm, friction 0.4:",
    "what_if": "closed loop  passive (strict)",
}
"""A part of what each example prints."""


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_runs_by_itself(path: Path, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, path],
        cwd=tmp_path,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert SAID[path.stem] in done.stdout
    assert "Traceback" not in done.stderr


def test_every_example_is_short_and_in_the_guide() -> None:
    assert {path.stem for path in EXAMPLES} == set(SAID)
    listed = page("examples")
    for path in EXAMPLES:
        text = path.read_text(encoding="utf-8")
        assert len(text.splitlines()) <= 70, path.stem
        summary = (ast.get_docstring(ast.parse(text)) or "").partition("\n")[0]
        assert f"| `{path.name}` | {summary.rstrip('.')} |" in listed
