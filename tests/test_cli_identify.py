"""``hapticbridge identify`` from the command line."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from hapticbridge.cli import main, terminal
from hapticbridge.cli.identify import coupling_of_run
from hapticbridge.clock import SimulatedClock
from hapticbridge.demand.certificate import default_coupling
from hapticbridge.device import DeviceInfo, open_device
from hapticbridge.device.profile import read_profile
from hapticbridge.identify import Estimate, identify
from hapticbridge.identify.identify import delay_of, measured_profile

FREE = "simulated:hand=none,damping=1.5,friction=0.1,resolution=2e-5"


def test_it_prints_draws_and_saves_what_it_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    profile, fit, width = (tmp_path / name for name in ("p.toml", "fit.png", "width.svg"))
    words = ["identify", FREE, "--axes", "x", "rx", "--save", str(profile)]
    assert main([*words, "--plot", str(fit), "--zwidth", str(width)]) == 0
    told = capsys.readouterr().out
    assert "resolution 20 µm" in told
    assert "a hand that only damps cannot be distinguished from it" in " ".join(told.split())
    assert "speed squared" not in told
    assert "the largest safe stiffness is 29" in told  # 2 b / T at the lower end of b
    assert fit.read_bytes().startswith(b"\x89PNG") and "<svg" in width.read_text(encoding="utf-8")
    found = read_profile(profile)
    damping = found.quantities["damping"]
    assert "a hand that only damps cannot be distinguished from it" in damping.source
    assert damping.value == pytest.approx(1.5, rel=0.01)
    assert damping.interval is not None and damping.interval[0] < 1.5 < damping.interval[1]
    assert found.quantities["rotational_damping"].value == pytest.approx(2e-3, rel=0.01)


@pytest.mark.parametrize("delay", [0, 2])
def test_it_recommends_the_coupling_that_a_run_takes_with_its_profile(
    delay: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    device, path = f"{FREE},delay={delay}", tmp_path / "p.toml"
    words = ["identify", device, "--axes", "x", "--duration", "5", "--save", str(path), "--json"]
    assert main(words) == 0
    told = json.loads(capsys.readouterr().out)["coupling"]["requested"]["stiffness"]
    info = replace(open_device(device).info, damping=None, mass=None, friction=None, delay=None)
    sheet = read_profile(path).fill(info)
    assert sheet.delay == pytest.approx(1e-3 * delay, abs=1e-12)
    assert told == default_coupling(sheet, 1e-3).stiffness


def test_it_says_what_a_class_states_and_as_how_many_ticks_a_delay_counts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "p.toml"
    words = ["--axes", "x", "--duration", "5", "--save", str(path)]
    assert main(["identify", f"{FREE},delay=3", *words]) == 0
    told = " ".join(capsys.readouterr().out.split())
    unknown = replace(open_device(FREE).info, damping=None, mass=None, friction=None, delay=None)
    sheet = read_profile(path).fill(unknown)
    assert f"DeviceInfo(mass={sheet.mass:.6g}, damping={sheet.damping:.6g}, rotational" in told
    assert "delay=0.003, is_delay_measured=True); the delay counts as 3 ticks" in told
    # pasted into a class, it gives the advised coupling
    [numbers] = re.findall(r"in a class of your own: DeviceInfo\((.*?)\);", told)
    stated = eval(f"dict({numbers})")
    pasted = DeviceInfo(name="own", axes=("x",), force_limit=1.0, **stated)
    advised = re.findall(r"--stiffness ([0-9.]+) --damping ([0-9.]+)", told)[0]
    coupling = default_coupling(pasted, 1e-3)
    assert (coupling.stiffness, coupling.damping) == pytest.approx(
        tuple(map(float, advised)), rel=2e-5
    )
    assert pasted.resolution == 2e-5
    # behind a delay a damper lowers what a wall asks of the device, so that K may be larger
    at_rest, with_damper = re.findall(r"([0-9.]+) N/m at B_law = ", told)
    assert float(with_damper) > 1.2 * float(at_rest)
    assert main(["identify", FREE, *words]) == 0
    told, notes = capsys.readouterr()
    assert "the delay counts as 0 ticks" in told
    assert told.count("N/m at B_law = ") == 1
    assert f"the profile that was there is now {path}.old" in " ".join(notes.split())
    assert read_profile(path).fill(unknown).delay == 0.0
    former = path.with_name("p.toml.old").rename(tmp_path / "former.toml")
    assert read_profile(former).quantities["delay"].value == pytest.approx(3e-3)


def test_the_hand_of_a_simulated_device_lets_go(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--axes", "x", "--duration", "5"]
    assert main(["identify", "simulated:damping=3", *words]) == 0
    assert "the simulated hand lets go of the device" in capsys.readouterr().err
    assert main(["identify", "simulated:damping=3,hand_mass=0.5", *words]) == 2
    assert "let go of it" in capsys.readouterr().err


def test_what_was_measured_before_gives_way_to_a_new_measurement() -> None:
    device = open_device(f"{FREE},delay=5")
    result = identify(device, SimulatedClock(), period=1e-3, axes=("x",), duration=5.0)
    profile = measured_profile(result, device="d", serial="", date="2026-01-01", duration=5.0)
    before = replace(result, info=replace(result.info, delay=1e-3))
    now = replace(result, info=replace(result.info, delay=None))
    assert coupling_of_run(before, profile) == coupling_of_run(now, profile)
    requested = coupling_of_run(now, profile).requested
    assert requested is not None
    assert requested.stiffness < 1.6 * 0.85 * 1.5 / 6e-3  # no coupling bears more behind 5 ms


@pytest.mark.parametrize(
    ("value", "half_width", "told"),
    [(1.001, 0.1, 1.0), (0.03, 0.05, 0.0), (-0.02, 0.01, 0.0), (1.2, 0.1, 1.2), (2.97, 0.04, 3.0)],
)
def test_a_delay_is_whole_ticks_where_the_interval_has_them(
    value: float, half_width: float, told: float
) -> None:
    assert delay_of(Estimate(1e-3 * value, 1e-3 * half_width), 1e-3) == pytest.approx(1e-3 * told)


def test_progress_is_printed_in_plain_lines_without_a_terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(terminal, "REPRINT", 0.0)
    assert main(["identify", FREE, "--axes", "x", "--duration", "5", "--json"]) == 0
    assert "identifying: axis x  50 %\n" in capsys.readouterr().err


def test_a_profile_that_cannot_be_written_costs_no_measurement(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    place = str(tmp_path / "file" / "p.toml")
    assert main(["identify", FREE, "--axes", "x", "--duration", "5", "--save", place]) == 2
    told = capsys.readouterr()
    assert "resolution 20 µm" in told.out
    assert "cannot write" in told.err and "Traceback" not in told.err


def test_as_json_it_tells_the_same(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["identify", FREE, "--axes", "y", "--duration", "5", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["axes"]["y"]["damping"]["value"] == pytest.approx(1.5, rel=0.02)
    assert facts["largest_stiffness"] == pytest.approx(3000, rel=0.03)
    assert facts["profile"] is None
    assert "only damps" in facts["assumed"]
    estimate = facts["axes"]["y"]["damping"]
    assert estimate["half_width"] > 0.0 and estimate["below"] >= 0.0


@pytest.mark.parametrize(
    ("device", "axis", "told"),
    [
        (FREE, "rx", "none of x, y, z was measured"),
        ("simulated:hand=none,damping=0", "x", "damping may be zero"),
    ],
)
def test_a_z_width_that_is_not_known_is_not_drawn_and_it_says_why(
    device: str, axis: str, told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without x, y or z it once said that the damping may be zero, and drew nothing, silently."""
    width = tmp_path / "width.png"
    words = ["identify", device, "--axes", axis, "--duration", "2", "--zwidth", str(width)]
    assert main(words) == 0
    captured = capsys.readouterr()
    assert told in captured.out and told in " ".join(captured.err.split())
    assert "not measured: " in captured.out
    assert not width.exists()
