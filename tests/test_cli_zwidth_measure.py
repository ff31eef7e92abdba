"""``hapticbridge zwidth --measure``: walls tried on a device."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from hapticbridge.cli import main
from hapticbridge.device import SimulatedDevice

FREE = "simulated:hand=none,resolution=1e-6"


def test_what_is_measured_meets_the_line_of_a_device_that_nobody_holds(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = tmp_path / "width.svg"
    assert main(["zwidth", "--measure", FREE, "--plot", str(picture), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    line = next(line for line in facts["lines"] if line["name"] == "stable without a hand")
    for limit in facts["measured"]:
        # the line is given at points; between them it is nearly straight
        near = min(range(101), key=lambda i: abs(facts["damping"][i] - limit["damping"]))
        assert limit["borne"] == pytest.approx(line["stiffness"][near], rel=0.05)
        assert limit["borne"] < limit["not_borne"] < 1.03 * limit["borne"]
    first = facts["measured"][0]
    assert first["borne"] == pytest.approx(2.0 * 2.0 / 1e-3, rel=0.05)  # 2 b / T
    assert "measured" in picture.read_text(encoding="utf-8")


def test_a_device_of_less_damping_than_was_said_is_found_out(
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = ["zwidth", "--damping", "2", "--measure", "simulated:hand=none,damping=1"]
    assert main(words) == 0
    assert "it bears less than theory allows" in capsys.readouterr().out
    assert main(["zwidth", "--measure", "simulated:hand=none,damping=1"]) == 0
    assert "bears less" not in capsys.readouterr().out


def test_a_device_is_closed_whatever_was_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    closed = []

    def close(self: SimulatedDevice) -> None:
        closed.append(self)

    monkeypatch.setattr(SimulatedDevice, "close", close)
    assert main(["zwidth", "--measure", FREE, "--axis", "q"]) == 2
    assert main(["zwidth", "--measure", FREE, "--damping", "nan"]) == 2
    assert len(closed) == 2
