"""``scripts/run`` ends by naming the report, however the run ended."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
from pathlib import Path

import pytest
from waiting import until

ROOT = Path(__file__).parents[1]

STAND_IN = """#!/bin/sh
echo "$1" >> calls
case $1 in
run) while [ $# -gt 1 ]; do [ "$1" = --record ] && made=$2; shift; done
    [ -z "$MAKES" ] || : > "$made"
    trap 'exit 0' INT
    [ -z "$WAITS" ] || { : > waiting; while :; do sleep 0.1; done; }
    exit "$RAN" ;;
audit) echo "wrote ${7:-$6}"; exit "$JUDGED" ;;
esac
"""


def tree(folder: Path) -> Path:
    """Makes a tree in which the script finds a stand-in for the command, already installed."""
    (folder / "scripts").mkdir()
    (folder / ".venv" / "bin").mkdir(parents=True)
    shutil.copy(ROOT / "scripts" / "run", folder / "scripts")
    for name, text in (("scripts/setup", "#!/bin/sh\n"), (".venv/bin/hapticbridge", STAND_IN)):
        (folder / name).write_text(text)
        (folder / name).chmod(0o755)
    return folder / "scripts" / "run"


def environment(
    *, ran: int, judged: int, makes: bool = True, waits: bool = False
) -> dict[str, str]:
    said = {"MAKES": "1" * makes, "RAN": str(ran), "JUDGED": str(judged), "WAITS": "1" * waits}
    return {**os.environ, **said}


@pytest.mark.parametrize(
    ("ran", "judged", "code"), [(0, 0, 0), (0, 1, 1), (1, 0, 1), (3, 1, 3), (3, 0, 3), (2, 0, 2)]
)
def test_the_report_is_named_last_however_the_run_ended(
    ran: int, judged: int, code: int, tmp_path: Path
) -> None:
    done = subprocess.run(
        [tree(tmp_path)],
        env=environment(ran=ran, judged=judged, makes=ran != 2),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == code
    if ran == 2:  # what could not be run is not audited
        assert (tmp_path / "calls").read_text() == "run\n"
        return
    assert done.stdout.splitlines()[-1].startswith("wrote runs/")
    assert done.stdout.endswith("/run.html\n")


def test_after_an_interrupt_the_report_is_written_all_the_same(tmp_path: Path) -> None:
    script = tree(tmp_path)
    process = subprocess.Popen(
        [script],
        env=environment(ran=0, judged=0, waits=True),
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,  # a group of its own, as a terminal's foreground has
    )
    until((tmp_path / "waiting").exists)
    os.killpg(process.pid, signal.SIGINT)
    told, _ = process.communicate(timeout=60)
    assert process.returncode == 0
    assert told.endswith("/run.html\n")
