"""Recorded twins of the maps: one fails, one holds, and they differ in the one named value."""

from __future__ import annotations

import itertools
import json
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from hapticbridge.audit import audit
from hapticbridge.cli import main
from hapticbridge.device import SimulatedDevice
from hapticbridge.lab.maps import MAPS
from hapticbridge.lab.maps.twins import ENDINGS, RecordedTwins
from hapticbridge.recording import Recording, read_recording
from hapticbridge.signals import StopSignal
from hapticbridge.units import format_energy

PORTS = {
    "coupling": "environment",
    "tool_mass": "environment",
    "geometry": "device",
    "contact": "environment",
    "rotation": "environment",
    "rate": "device",
    "device": "device",
    "restitution": "environment",
}
"""Port at fault in the run that fails, by map."""

DIFFERENCES: dict[str, dict[str, Any]] = {
    "coupling": {"method": ("implicitfast", "implicit")},
    "tool_mass": {"scene": [('mass="0.0045"', 'mass="0.01"')]},
    # the walls are twice as long as the peg
    "geometry": {"scene": [('0.05"', '0.02"'), ('0.05"', '0.02"'), ('0.025"/>', '0.01"/>')]},
    "contact": {"contact": ("scene", "rigid")},
    "rotation": {"method": ("explicit", "implicit")},
    "rate": {"period_s": ("0.005", "0.001")},
    "device": {"device": {"damping": (0.8, 1.2)}},
    "restitution": {"scene": [('0.1"', '1.0"')]},
}
"""Differences of both recordings' descriptions, by map."""

DERIVED = {"scene_sha256", "scene_changes", "guard", "started", "epoch_ns"}
"""Metadata that follow from the others: the model has the integrator of a method and the time step
of a rate, and the guard is off. The last two are the time of recording."""


@pytest.fixture(scope="module", params=MAPS)
def recorded(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[str, RecordedTwins]:
    """Returns a map's name and its recorded twins."""
    name, folder = str(request.param), tmp_path_factory.mktemp("twins")
    fails, safe = (folder / f"{name}.{ending}" for ending in ENDINGS)
    return name, MAPS[name].twins().record((fails, safe))


def differences(fails: Recording, safe: Recording) -> dict[str, Any]:
    """Returns the differing metadata of two recordings, and the differing words of their scenes."""
    names = {*fails.meta, *safe.meta} - DERIVED - {"request"}
    found: dict[str, Any] = {
        name: (fails.meta.get(name), safe.meta.get(name))
        for name in names
        if fails.meta.get(name) != safe.meta.get(name)
    }
    if "device" in found:
        sheets = [json.loads(text) for text in found["device"]]
        found["device"] = {
            name: tuple(sheet[name] for sheet in sheets)
            for name in sheets[0]
            if sheets[0][name] != sheets[1][name]
        }
    words = [each.attachments["scene/rig.xml"].decode().split() for each in (fails, safe)]
    changed = [pair for pair in zip(*words, strict=True) if pair[0] != pair[1]]
    return found | ({"scene": changed} if changed else {})


def test_one_twin_fails_at_its_port_and_the_other_one_holds(
    recorded: tuple[str, RecordedTwins],
) -> None:
    name, twins = recorded
    fails, safe = (audit(report.path) for report in twins.reports)
    assert (fails.verdict, fails.port, fails.exit_code) == ("active", PORTS[name], 1)
    assert (safe.verdict, safe.certified is False, safe.exit_code) == ("passive", False, 0)
    assert {fails.resimulation, safe.resimulation} == {"bit for bit"}
    assert f"{fails.words}, up to {format_energy(twins.excess)} beyond the bound" in twins.sentence
    assert twins.excess >= fails.joules > 0.0
    assert twins.sentence.endswith(f"all else equal: {safe.words}")
    assert max(report.path.stat().st_size for report in twins.reports) < 1e6


def test_twins_differ_in_the_named_value_alone(recorded: tuple[str, RecordedTwins]) -> None:
    name, twins = recorded
    fails, safe = (read_recording(report.path) for report in twins.reports)
    assert differences(fails, safe) == DIFFERENCES[name]


def test_the_command_writes_the_twins_and_names_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["stability", "restitution", "--points", "4", "--out", str(tmp_path)]
    picture = tmp_path / "mine.svg"
    assert main(["stability", "all", "--plot", str(picture)]) == 2
    assert "--plot is the picture of one map" in capsys.readouterr().err
    files = [f"restitution.{ending}" for ending in ENDINGS]
    (tmp_path / files[0]).write_text("old")
    assert main([*command, "--plot", str(picture)]) == 0
    assert "<svg" in picture.read_text(encoding="utf-8")
    printed = capsys.readouterr()
    sentence = json.loads((tmp_path / "restitution.json").read_text(encoding="utf-8"))["twins"][
        "sentence"
    ]
    assert sentence in " ".join(printed.out.split())
    assert f"{files[0]}, {files[1]}" in " ".join(printed.err.split())
    assert [main(["audit", str(tmp_path / file)]) for file in files] == [1, 0]
    capsys.readouterr()
    assert main([*command, "--json"]) == 0
    (facts,) = json.loads(capsys.readouterr().out)
    assert [facts["twins"][which]["file"] for which in ("fails", "safe")] == files
    (tmp_path / files[1]).unlink()
    (tmp_path / files[1]).mkdir()
    assert main(command) == 2
    assert files[1] in capsys.readouterr().err


def test_a_signal_ends_the_recording_of_twins_and_keeps_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read, count = SimulatedDevice.read, itertools.count()

    def read_until_stopped(device: SimulatedDevice, sample: NDArray[np.void]) -> int:
        if next(count) == 20:
            signal.raise_signal(signal.SIGTERM)
        return read(device, sample)

    monkeypatch.setattr(SimulatedDevice, "read", read_until_stopped)
    paths = tmp_path / "a.mcap", tmp_path / "b.mcap"
    paths[0].write_text("old")
    with pytest.raises(StopSignal) as stop:
        MAPS["restitution"].twins().record(paths)
    assert stop.value.number == signal.SIGTERM
    assert paths[0].read_text() == "old"
    assert list(tmp_path.iterdir()) == [paths[0]]
