"""Bad input and wrong usage are one sentence and exit code 2."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from cli_cases import Called

from hapticbridge.audit import audit
from hapticbridge.device.transport import usb

REFUSED = (
    ("run nowhere --fast --duration 0.01", "'peg_in_hole'"),
    ("run point_mass --device nothing --fast --duration 0.01", "'simulated'"),
    ("run point_mass --device trajectory:missing.csv --fast --duration 0.01", "missing.csv"),
    ("run point_mass --device simulated:frction=1 --fast --duration 0.01", "'friction'"),
    ("run point_mass --method magic --fast --duration 0.01", "'implicit'"),
    ("run point_mass --grip handle_of_door --fast --duration 0.01", "'grip'"),
    ("run point_mass --rate 0 --fast --duration 0.01", "rate"),
    ("run point_mass --rate nan --fast --duration 0.01", "rate"),
    ("run point_mass --rate -5 --fast --duration 0.01", "rate"),
    ("run point_mass --rate inf --fast --duration 0.01", "rate"),
    ("run point_mass --rate 1e+300 --fast --duration 0.01", "rate"),
    ("run point_mass --rate 1e-12 --fast --duration 0.01", "rate"),
    ("run point_mass --duration nan --fast", "duration"),
    ("run point_mass --duration 0 --fast", "duration"),
    ("run point_mass --duration -1 --fast", "duration"),
    ("run point_mass --stiffness -5 --fast --duration 0.01", "stiffness"),
    ("run point_mass --stiffness 0 --fast --duration 0.01", "stiffness"),
    ("run point_mass --stiffness nan --fast --duration 0.01", "stiffness"),
    ("run point_mass --damping -1 --fast --duration 0.01", "damping"),
    ("run point_mass --rotational-stiffness -1 --fast --duration 0.01", "rotational_stiffness"),
    ("run point_mass --axes 1 0 0 0 1 0 0 0 2 --fast --duration 0.01", "axes"),
    ("run point_mass --axes 1 0 0 0 1 0 0 0 -1 --fast --duration 0.01", "axes"),
    ("run point_mass --force-limit 0 --fast --duration 0.01", "force limit"),
    ("run point_mass --torque-limit nan --fast --duration 0.01", "torque limit"),
    ("run point_mass --substeps 0 --fast --duration 0.01", "substeps"),
    ("run point_mass --scale 0 --fast --duration 0.01", "scale"),
    ("run point_mass --scale -1 --fast --duration 0.01", "scale"),
    ("run point_mass --force-scale 0 --fast --duration 0.01", "force_scale"),
    ("run point_mass --ramp -1 --fast --duration 0.01", "ramp"),
    ("run point_mass --ramp 1e+300 --fast --duration 0.01", "ramp"),
    ("run point_mass --realtime --fast --duration 0.01", "exclude each other"),
    ("run point_mass --record no/such/folder/run.mcap --fast --duration 0.01", "folder"),
    ("run peg_in_hole --device falcon", "no device 'falcon' is plugged in"),
    (
        "run peg_in_hole --device falcon:damping=-1",
        "damping = -1.0: must be a finite number >= 0 N s/m",
    ),
    (
        "run peg_in_hole --device falcon:firmware=/no/image,damping=2",
        "firmware = '/no/image': cannot be read",
    ),
    (
        "run peg_in_hole --device falcon:colour=red",
        "unknown option 'colour' of the falcon device; choose one of 'damping'",
    ),
    ("check nowhere", "no scene is called 'nowhere'"),
    ("check peg_in_hole --grip handle_bar", "no site 'handle_bar'"),
    ("check peg_in_hole --motion none.csv", "none.csv"),
    ("check peg_in_hole --workspace -1", "workspace is -1.0 m"),
    ("check peg_in_hole --rate 0", "rate"),
    ("check peg_in_hole --stiffness nan", "stiffness"),
    ("check peg_in_hole --scale 0", "scale"),
    ("check peg_in_hole --plot check.txt", "must end in .pdf"),
    ("check peg_in_hole --set weight=1", "no parameter 'weight'"),
    ("identify simulated", "were not commanded: let go of it"),
    (
        "identify simulated:hand=none --axes q",
        "--axes q: the device has 'rx', 'ry', 'rz', 'x', 'y', 'z'",
    ),
    ("identify simulated:hand=none --travel nan", "--travel is nan m; it must be 0.0001 to 1"),
    ("identify simulated:hand=none --duration 0.5", "--duration is 0.5 s; it must be 2 to 600"),
    (
        "identify simulated:hand=none --force-share 1.5",
        "--force-share is 1.5; it must be 0.001 to 1",
    ),
    ("identify simulated:hand=none --plot fit.txt", "must end in .pdf"),
    (
        "identify simulated:hand=none --plot a.png --zwidth a.png",
        "--plot and --zwidth both name 'a.png'",
    ),
    ("identify no-such-device", "unknown device 'no-such-device'"),
    ("zwidth", "zwidth needs --damping, and it is missing"),
    (
        "zwidth --measure simulated:hand=none --axis rx",
        "--axis rx: the device moves by force along",
    ),
    ("zwidth --measure simulated:hand=none --delay 2", "leave --filter-time and --delay out"),
    ("zwidth --measure falcon", "no device 'falcon' is plugged in"),
    ("zwidth --damping 0", "device damping is 0 N s/m"),
    ("zwidth --damping nan", "device damping is nan"),
    ("zwidth --damping 2 --mass -1", "mass is -1 kg"),
    ("zwidth --damping 2 --delay -1", "delay is -1"),
    ("zwidth --damping 2 --rate 0", "rate is 0.0 Hz"),
    ("zwidth --damping 2 --plot x.gif", "must end in .pdf"),
    ("zwidth --damping 2 --delay 1000", "delay is 1000"),
    ("bound --stiffness -1", "stiffness is -1"),
    ("bound --stiffness inf", "stiffness is inf"),
    ("bound --stiffness 1 --rate nan", "rate is nan Hz"),
    ("bound --stiffness 1 --filter-time -1", "filter time is -1 s"),
    ("bound --stiffness 1 --device-damping 0", "device damping is 0 N s/m"),
    ("bound --stiffness 1 --plot x", "must end in .pdf"),
    ("zwidth --damping 1e300", "between 1e-30 and 1e+30"),
    ("zwidth --damping 1e30 --rate 1e6", "between 1e-30 and 1e+30"),
    ("zwidth --damping 1e-300", "between 1e-30 and 1e+30"),
    ("zwidth --damping 2 --mass 1e300", "between 1e-30 and 1e+30"),
    ("zwidth --damping 2 --friction 1e300 --resolution 1e-5", "between 1e-30 and 1e+30"),
    ("zwidth --damping 2 --filter-time 1e300", "between 1e-30 and 1e+30"),
    ("bound --stiffness 1e300", "between 1e-30 and 1e+30"),
    ("bound --stiffness 1e-300 --json", "between 1e-30 and 1e+30"),
    ("bound --stiffness 1 --damping 1e300", "between 1e-30 and 1e+30"),
    ("bound --stiffness 1 --filter-time 1e300", "between 1e-30 and 1e+30"),
    ("bound --stiffness 1 --device-damping 1e300 --json", "between 1e-30 and 1e+30"),
    ("run point_mass --overwrite", "--overwrite goes with --record"),
    ("run point_mass --port 8080", "--port without --view"),
    ("run point_mass --port 0", "--port without --view"),
    ("check point_mass --budget 1.0", "--budget goes with --lean"),
    ("check point_mass --lean --overwrite", "--overwrite goes with --write"),
    ("zwidth --damping 2 --axis x", "--axis goes with --measure"),
    ("devices --udev-rules --json", "leave --json out"),
    ("audit x --jobs 2 --scheduler tcp://x", "exclude each other"),
)
"""Calls and a part of the sentence on stderr."""


def one_sentence(err: str) -> str:
    """Returns the error's line, after holding it against what an error may look like."""
    assert "Traceback" not in err
    lines = [line for line in err.splitlines() if line.startswith("error:")]
    assert len(lines) == 1, err
    return lines[0]


@pytest.mark.parametrize(("command", "message"), REFUSED)
def test_a_call_is_refused_in_one_sentence_that_leaves_nothing_behind(
    command: str, message: str, call: Called, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(usb, "on_the_bus", list)
    monkeypatch.setattr(usb, "libusb", lambda: None)
    code, out, err = call(*command.split())
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
