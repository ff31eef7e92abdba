"""``scripts/leftovers`` names all that a command leaves."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "scripts" / "leftovers"

pytestmark = pytest.mark.skipif(
    shutil.which("git") is None or not Path("/proc").is_dir(), reason="needs git and Linux' /proc"
)


def left(command: str, folder: Path) -> tuple[int, str]:
    """Returns the exit code and standard error of a command in a checkout of its own."""
    checkout, home = folder / "checkout", folder / "home"
    (checkout / "scripts").mkdir(parents=True)
    home.mkdir()
    shutil.copy(SCRIPT, checkout / "scripts")
    for words in ("init --quiet", "add scripts"):
        subprocess.run(["git", *words.split()], cwd=checkout, check=True)
    environment = os.environ | {"HOME": str(home), "WATCHED": str(home), "TMPDIR": str(folder)}
    environment["PATIENCE"] = "1"
    done = subprocess.run(
        [checkout / "scripts" / "leftovers", "sh", "-c", command],
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        check=False,
    )
    return done.returncode, done.stderr


@pytest.mark.parametrize(
    "command",
    [
        'mkdir -p "$TMPDIR/a" "$HOME/.cache/b" __pycache__; touch MUJOCO_LOG.TXT',
        "true & wait",
        'touch "$HOME/a"; rm "$HOME/a"',
    ],
)
def test_what_pytest_and_caches_keep_and_what_is_taken_away_again_is_not_left(
    command: str, tmp_path: Path
) -> None:
    assert left(command, tmp_path) == (0, "")


@pytest.mark.parametrize(
    ("command", "named"),
    [
        ('touch "$HOME/profile.toml"', "/home/profile.toml"),
        ("touch run.mcap", "?? run.mcap"),
        ("echo >>scripts/leftovers", "AM scripts/leftovers"),
    ],
)
def test_a_file_that_is_left_fails_and_is_named(command: str, named: str, tmp_path: Path) -> None:
    code, says = left(command, tmp_path)
    assert code == 1 and named in says and len(says.splitlines()) in {2, 3}


def test_a_process_that_is_left_fails_and_is_named_with_its_command(tmp_path: Path) -> None:
    code, says = left("setsid sleep 300 >/dev/null 2>&1 &", tmp_path)
    _, process = says.splitlines()
    os.kill(int(process.split()[1].rstrip(":")), signal.SIGKILL)
    assert code == 1 and process.endswith("sleep 300 ")


def test_a_command_that_fails_keeps_its_exit_code(tmp_path: Path) -> None:
    assert left("exit 3", tmp_path) == (3, "")
