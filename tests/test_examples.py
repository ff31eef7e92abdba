"""Every example runs by itself in an empty folder, and says what it found."""

from __future__ import annotations

import ast
import os
import runpy
import subprocess
import sys
import traceback
import warnings
from pathlib import Path

import pytest

from hapticbridge.cli.guide import page

SCRIPTS = Path(__file__).parents[1] / "scripts"
EXAMPLES = sorted((SCRIPTS / "examples").glob("*.py"))

SAID = {
    "batch_audit": "passive      0.15",
    "change_coupling": "passive (strict)",
    "custom_device": "strict",
    "device_over_a_socket": "strict",
    "first_run": "passive bit for bit",
    "key_moves_motor": "strict",
    "own_mujoco_loop": "passive",
    "own_ros_topics": "N, passive",
    "own_map": "implicitfast  K = 4000 N/m, 0.05 kg: active",
    "plot_with_pandas": "of the time in contact",
    "scene_in_python": "strict",
    "sweep_on_dask": "0.1 mm, friction 0.4:",
    "what_if": "closed loop  passive (strict)",
}
"""A part of what each example prints."""


POOLS = {"batch_audit", "own_map", "sweep_on_dask"}
"""Examples that start processes, which begin with their file. They run as a user starts them."""


INTERFACES = runpy.run_path(str(SCRIPTS / "interfaces"))["INTERFACES"]
ELSEWHERE = {interface.example for interface in INTERFACES} - SAID.keys()
"""Examples with a package that has an environment of its own: ``scripts/interfaces`` runs them."""


@pytest.mark.parametrize(
    "path", [path for path in EXAMPLES if path.stem in SAID], ids=lambda path: path.stem
)
def test_an_example_runs_by_itself(path: Path, tmp_path: Path) -> None:
    run = started if path.stem in POOLS or sys.platform == "win32" else forked
    code, out, err = run(path, tmp_path)
    assert code == 0, err
    assert SAID[path.stem] in out
    assert "Traceback" not in err


def started(path: Path, folder: Path) -> tuple[int, str, str]:
    """Runs a program; returns its exit code, and what it printed."""
    done = subprocess.run(
        [sys.executable, path],
        cwd=folder,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )
    return done.returncode, done.stdout, done.stderr


def forked(path: Path, folder: Path) -> tuple[int, str, str]:
    """The same in a fork of this process, which has imported what takes a second to import."""
    out, err = folder / "stdout", folder / "stderr"
    if (child := os.fork()) == 0:
        code = 1
        try:
            for number, file in ((1, out), (2, err)):
                os.dup2(os.open(file, os.O_CREAT | os.O_WRONLY), number)
            os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
            sys.stdin, sys.stdout, sys.stderr = (
                os.fdopen(number, mode, closefd=False) for number, mode in enumerate("rww")
            )
            os.chdir(folder)
            warnings.resetwarnings()
            runpy.run_path(str(path), run_name="__main__")
            code = 0
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)
    status = os.waitpid(child, 0)[1]
    return os.waitstatus_to_exitcode(status), out.read_text(), err.read_text()


def test_every_example_is_short_and_in_the_guide() -> None:
    assert {path.stem for path in EXAMPLES} == SAID.keys() | ELSEWHERE
    listed = page("examples")
    for path in EXAMPLES:
        text = path.read_text(encoding="utf-8")
        assert len(text.splitlines()) <= 70, path.stem
        summary = (ast.get_docstring(ast.parse(text)) or "").partition("\n")[0]
        assert f"| `{path.name}` | {summary.rstrip('.')} |" in listed
