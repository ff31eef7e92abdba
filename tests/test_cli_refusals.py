"""Bad input and wrong usage are one sentence and exit code 2."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from cli_cases import Called

from hapticbridge.audit import audit

BAD_RUNS: list[tuple[tuple[object, ...], str]] = [
    (("nowhere",), "'peg_in_hole'"),
    (("point_mass", "--device", "nothing"), "'simulated'"),
    (("point_mass", "--device", "trajectory:missing.csv"), "missing.csv"),
    (("point_mass", "--device", "simulated:frction=1"), "'friction'"),
    (("point_mass", "--method", "magic"), "'implicit'"),
    (("point_mass", "--grip", "handle_of_door"), "'grip'"),
    (("point_mass", "--rate", 0), "rate"),
    (("point_mass", "--rate", "nan"), "rate"),
    (("point_mass", "--rate", -5), "rate"),
    (("point_mass", "--rate", "inf"), "rate"),
    (("point_mass", "--rate", 1e300), "rate"),
    (("point_mass", "--rate", 1e-12), "rate"),
    (("point_mass", "--duration", "nan"), "duration"),
    (("point_mass", "--duration", 0), "duration"),
    (("point_mass", "--duration", -1), "duration"),
    (("point_mass", "--stiffness", -5), "stiffness"),
    (("point_mass", "--stiffness", 0), "stiffness"),
    (("point_mass", "--stiffness", "nan"), "stiffness"),
    (("point_mass", "--damping", -1), "damping"),
    (("point_mass", "--rotational-stiffness", -1), "rotational_stiffness"),
    (("point_mass", "--axes", 1, 0, 0, 0, 1, 0, 0, 0, 2), "axes"),
    (("point_mass", "--axes", 1, 0, 0, 0, 1, 0, 0, 0, -1), "axes"),
    (("point_mass", "--force-limit", 0), "force limit"),
    (("point_mass", "--torque-limit", "nan"), "torque limit"),
    (("point_mass", "--substeps", 0), "substeps"),
    (("point_mass", "--scale", 0), "scale"),
    (("point_mass", "--scale", -1), "scale"),
    (("point_mass", "--force-scale", 0), "force_scale"),
    (("point_mass", "--ramp", -1), "ramp"),
    (("point_mass", "--ramp", 1e300), "ramp"),
    (("point_mass", "--realtime"), "exclude each other"),
    (("point_mass", "--record", "no/such/folder/run.mcap"), "folder"),
]


def one_sentence(err: str) -> str:
    """Returns the error's line, after holding it against what an error may look like."""
    assert "Traceback" not in err
    lines = [line for line in err.splitlines() if line.startswith("error:")]
    assert len(lines) == 1, err
    return lines[0]


@pytest.mark.parametrize(("arguments", "message"), BAD_RUNS)
def test_bad_run_is_refused_in_one_sentence(
    arguments: tuple[object, ...],
    message: str,
    call: Called,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    duration = () if "--duration" in arguments else ("--duration", 0.01)
    code, out, err = call("run", *arguments, "--fast", *duration)
    assert (code, out) == (2, "")
    assert message in one_sentence(err)
    assert not list(tmp_path.iterdir())


def test_existing_recording_is_kept_unless_overwriting_is_asked_for(
    call: Called, tmp_path: Path
) -> None:
    path = tmp_path / "run.mcap"
    path.write_text("precious")
    command = ("run", "point_mass", "--fast", "--duration", 0.01, "--record", path)
    code, _, err = call(*command)
    assert code == 2
    assert "--overwrite" in one_sentence(err)
    assert path.read_text() == "precious"
    assert call(*command, "--duration", "nan", "--overwrite")[0] == 2
    assert path.read_text() == "precious"
    assert call(*command, "--overwrite")[0] == 0
    assert audit(path).verdict == "passive"


def test_a_name_that_is_too_long_for_the_system_is_refused(call: Called) -> None:
    for command in (("run", "point_mass", "--fast", "--record"), ("repair", "x.mcap")):
        code, _, err = call(*command, "x" * 300 + ".mcap")
        assert code == 2
        one_sentence(err)


def test_results_that_nobody_has_room_for_are_one_sentence() -> None:
    command = [sys.executable, "-m", "hapticbridge", "bound", "--stiffness", "100"]
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 2
    assert one_sentence(done.stderr) == "error: cannot write: No space left on device"


@pytest.mark.parametrize("kind", ["folder", "empty", "text", "missing"])
def test_what_is_no_recording_is_refused_in_one_sentence(
    kind: str, call: Called, tmp_path: Path
) -> None:
    path = tmp_path / "[red]what.mcap"
    if kind == "folder":
        path.mkdir()
    elif kind != "missing":
        path.write_text("" if kind == "empty" else "hello")
    for command in (("audit", path), ("repair", path, tmp_path / "out.mcap")):
        code, out, err = call(*command)
        assert (code, out) == (2, "")
        assert "[red]what.mcap" in one_sentence(err)


def test_file_without_permission_is_refused(
    call: Called, run_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(self: Path, *_mode: object, **_options: object) -> bytes:
        raise PermissionError(13, os.strerror(13))

    monkeypatch.setattr(Path, "open", refuse)  # root may read everything
    code, _, err = call("audit", run_file)
    assert code == 2
    assert "Permission denied" in one_sentence(err)


@pytest.mark.parametrize("name", ["x.foo", "x", "no/x.png", "folder", "x.png/"])
def test_picture_with_a_bad_name_is_refused(
    name: str, call: Called, run_file: Path, tmp_path: Path
) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "x.png").mkdir()
    code, _, err = call("audit", run_file, "--plot", f"{tmp_path}/{name}")
    assert code == 2
    one_sentence(err)


def test_report_into_a_missing_folder_is_refused(
    call: Called, run_file: Path, tmp_path: Path
) -> None:
    code, _, err = call("audit", run_file, "--report", tmp_path / "no" / "x.html")
    assert code == 2
    assert "x.html" in one_sentence(err)


def test_picture_of_several_recordings_is_refused(call: Called, run_file: Path) -> None:
    code, _, err = call("audit", run_file, run_file, "--plot", "x.png")
    assert code == 2
    assert "one recording" in one_sentence(err)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("run", "point_mass", "--overwrite"), "--overwrite goes with --record"),
        (("run", "point_mass", "--port", 8080), "--port without --view"),
        (("run", "point_mass", "--port", 0), "--port without --view"),
        (("check", "point_mass", "--budget", 1.0), "--budget goes with --lean"),
        (("check", "point_mass", "--lean", "--overwrite"), "--overwrite goes with --write"),
        (("zwidth", "--damping", 2, "--axis", "x"), "--axis goes with --measure"),
        (("devices", "--udev-rules", "--json"), "leave --json out"),
        (("audit", "x", "--jobs", 2, "--scheduler", "tcp://x"), "exclude each other"),
    ],
)
def test_an_option_that_would_have_no_effect_is_refused(
    arguments: tuple[object, ...], message: str, call: Called
) -> None:
    code, out, err = call(*arguments)
    assert (code, out) == (2, "")
    assert message in one_sentence(err)


def test_jobs_for_one_recording_are_said_to_have_no_effect(call: Called, run_file: Path) -> None:
    """Not refused: a pattern that the shell resolves may fit one file today, and many tomorrow."""
    code, out, err = call("audit", run_file, "--jobs", 2)
    assert (code, "passive" in out) == (0, True)
    assert "--jobs and --scheduler are for several recordings" in err
    assert "--jobs" not in call("audit", run_file)[2]


@pytest.mark.parametrize(
    "arguments",
    [(), ("frobnicate",), ("run",), ("run", "point_mass", "--bogus"), ("audit", "x", "--bogus")],
)
def test_wrong_usage_is_exit_code_2_without_a_traceback(
    arguments: tuple[str, ...], call: Called
) -> None:
    code, out, err = call(*arguments)
    assert (code, out) == (2, "")
    assert err and "Traceback" not in err


def test_help_into_a_reader_that_went_away_ends_without_a_traceback() -> None:
    command = [sys.executable, "-m", "hapticbridge", "--help"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdout is not None
    process.stdout.close()
    _, told = process.communicate(timeout=120)
    assert process.returncode == 1
    assert told == b""
