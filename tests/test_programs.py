"""Programs that are compiled ahead of the first run."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from hapticbridge.run.programs import programs

NOTED = """
import sys
from hapticbridge import audit
from hapticbridge.cli import main
from hapticbridge.kernel import machine_code

read = machine_code.read

def noted(path):
    print(path.name, file=sys.stderr)
    return read(path)

machine_code.read = noted
assert main(["run", "point_mass", "--fast", "--duration", "0.01", "--record", sys.argv[1]]) == 0
audit(sys.argv[1], in_process=True)
"""
"""Program that runs and audits a scene, and prints the machine code that it asks for."""


def test_the_first_run_and_its_audit_load_what_was_compiled_ahead(tmp_path: Path) -> None:
    command = [sys.executable, "-c", NOTED, str(tmp_path / "a.mcap")]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=300.0, check=True)
    names = {each.function.file_name(each.arguments, each.c_types) for each in programs()}
    # the point mass has no boxes, and its device takes the handle from where it is and has no loop
    needless = "box_box", "flat_flat", "round_flat", "stretch_at", "shown_to_device"
    asked = {line for line in ended.stderr.splitlines() if line.endswith(".o")}
    assert {name for name in names if not name.startswith(needless)} <= asked
