"""Small disks and limits of the system: one sentence before the force, or a whole recording."""

from __future__ import annotations

import functools
import os
import resource
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import hapticbridge as hb
from hapticbridge.cli.main import MEMORY_PER_PROCESSOR, MIN_MEMORY, main

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="these limits are Linux's")

PROGRAM = (sys.executable, "-m", "hapticbridge")
NEEDED = MIN_MEMORY + MEMORY_PER_PROCESSOR * (os.cpu_count() or 1)


def run_under(
    limit: int, value: int, record: Path, *before: str
) -> subprocess.CompletedProcess[str]:
    """Runs the bridge for 0.2 s under a limit of the system, recorded."""
    options = ("--fast", "--duration", "0.2", "--record", str(record), "--overwrite")
    return subprocess.run(
        [*before, *PROGRAM, "run", "point_mass", *options],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
        preexec_fn=lambda: resource.setrlimit(limit, (value, value)),
    )


def check_end(done: subprocess.CompletedProcess[str], record: Path) -> bool:
    """Checks a run that ended well, or with one sentence; returns True if it ended well."""
    assert "Traceback" not in done.stderr, done.stderr
    if done.returncode == 0:
        assert hb.audit(record).verdict == "passive"
        return True
    assert done.returncode == 2, done.stderr
    errors = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1, done.stderr
    return False


@pytest.mark.parametrize("size", [NEEDED // 16, NEEDED - 1, NEEDED])
def test_too_little_memory_is_one_sentence(tmp_path: Path, size: int) -> None:
    record = tmp_path / "run.mcap"
    done = run_under(resource.RLIMIT_AS, size, record)
    assert check_end(done, record) == (size >= NEEDED)
    assert ("'ulimit -v' allows" in done.stderr) == (size < NEEDED)


@pytest.mark.parametrize("count", [5, 7, 9, 12, 64])
def test_too_few_files_are_one_sentence(tmp_path: Path, count: int) -> None:
    record = tmp_path / "run.mcap"
    done = run_under(resource.RLIMIT_NOFILE, count, record)
    if not check_end(done, record):
        assert count < 64
        assert "'ulimit -n' allows" in done.stderr


@pytest.mark.parametrize("size", [0, 4_000_000, 20_000_000])
def test_too_small_files_are_one_sentence(tmp_path: Path, size: int) -> None:
    record = tmp_path / "run.mcap"
    done = run_under(resource.RLIMIT_FSIZE, size, record)
    assert check_end(done, record) == (size > 5_000_000)
    assert size > 5_000_000 or "'ulimit -f' allows" in done.stderr


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "run.mcap"
    with hb.Bridge("point_mass", clock=hb.SimulatedClock(), recording=path) as bridge:
        bridge.run(duration=3.0)
    return path


FORMATS = {
    "csv": ".csv", "parquet": ".parquet", "hdf5": ".h5", "rerun": ".rrd", "lerobot": "",
    "robomimic": "",
}  # fmt: skip


@pytest.fixture(scope="module")
def largest_file(recording: Path) -> Callable[[str], int]:
    """Returns the size in bytes of the largest file of an export, by its format."""

    @functools.cache
    def of(form: str) -> int:
        whole = recording.with_name(f"whole-{form}{FORMATS[form]}")
        assert main(["export", str(recording), "--format", form, "--out", str(whole)]) == 0
        files = [each for each in (whole, *whole.rglob("*")) if each.is_file()]
        return max(each.stat().st_size for each in files)

    return of


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("share", [0.01, 0.5, 0.995])
def test_an_export_that_has_no_room_is_one_sentence_and_leaves_nothing(
    recording: Path,
    largest_file: Callable[[str], int],
    tmp_path: Path,
    form: str,
    share: float,
) -> None:
    size, part = int(share * largest_file(form)), tmp_path / f"part{FORMATS[form]}"
    done = subprocess.run(
        [*PROGRAM, "export", str(recording), "--format", form, "--out", str(part)],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size)),
    )
    assert "Traceback" not in done.stderr, done.stderr
    errors = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert (done.returncode, len(errors)) == (2, 1), done.stderr
    assert "File too large" in done.stderr
    assert list(tmp_path.iterdir()) == []


def other_user(number: int) -> tuple[str, ...]:
    """Returns a command that runs another as a user whom the limit on processes binds.

    Each number is a user of its own: two tests at once would count each other's processes.
    """
    if os.geteuid() != 0:
        return ()
    if shutil.which("setpriv") is None:
        pytest.skip("needs setpriv")
    rights = "+dac_override,+dac_read_search,+fowner"
    user = f"--reuid={60_000 + number}"
    # so that access() heeds the rights, and the machine code on disk is used
    heeded = "--securebits=+no_setuid_fixup"
    return ("setpriv", user, heeded, f"--inh-caps={rights}", f"--ambient-caps={rights}")


@pytest.mark.parametrize("count", [1, 2, 5, 10, 14, 4095])
def test_too_few_processes_are_one_sentence(tmp_path: Path, count: int) -> None:
    record = tmp_path / "run.mcap"
    done = run_under(resource.RLIMIT_NPROC, count, record, *other_user(count))
    if not check_end(done, record):
        assert count < 30, done.stderr
        assert "'ulimit -u' allows" in done.stderr


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    place = tmp_path / "disk"
    place.mkdir()
    yield place
    subprocess.run(["umount", place], check=False, capture_output=True)


@pytest.mark.parametrize("size", [200, 4000, 4300, 4500, 6000])
def test_a_small_disk_is_refused_or_holds_a_whole_recording(disk: Path, size: int) -> None:
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size}k", "none", str(disk)]
    if subprocess.run(mount, check=False, capture_output=True).returncode:
        pytest.skip("needs the right to mount")
    record = disk / "run.mcap"
    words = ["run", "peg_in_hole", "--fast", "--duration", "10", "--record", str(record)]
    code = main(words)
    if not record.exists():
        assert (code, size < 4300) == (2, True)
        assert list(disk.iterdir()) == []
        return
    assert size > 4200
    assert code in (0, 2)
    recording = hb.read_recording(record)
    assert (recording.is_cut, recording.problems) == (False, ())
    assert len(recording.ticks) > 100
    assert hb.audit(record).verdict == "passive"


def test_the_refusal_of_a_small_disk_has_the_sizes(
    disk: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mount = ["mount", "-t", "tmpfs", "-o", "size=1000k", "none", str(disk)]
    if subprocess.run(mount, check=False, capture_output=True).returncode:
        pytest.skip("needs the right to mount")
    words = ["run", "point_mass", "--fast", "--duration", "1", "--record", str(disk / "run.mcap")]
    assert main(words) == 2
    error = " ".join(capsys.readouterr().err.split())
    assert "it needs 4.2 MB from the start, and its disk has 1.02 MB free" in error
