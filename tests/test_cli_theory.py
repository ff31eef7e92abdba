"""``hapticbridge zwidth`` and ``hapticbridge bound`` as a user meets them."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path
from typing import Any

import pytest

from hapticbridge.cli import main

ZWIDTH = "zwidth --damping 2 --mass 0.1 --friction 0.05 --resolution 1e-5 --rate 1000"
BOUND = "bound --stiffness 2000 --damping 1 --rate 1000"


class Told:
    """What one call of the command line said."""

    def __init__(self, command: str, capsys: pytest.CaptureFixture[str]) -> None:
        self.code = main(shlex.split(command))
        self.out, self.err = capsys.readouterr()
        self.words = " ".join(self.out.split())

    def json(self) -> Any:
        """Returns what was printed, which must be JSON without inf and nan."""
        return json.loads(self.out, parse_constant=pytest.fail)


def test_next_command_of_zwidth_runs_and_is_certified(capsys: pytest.CaptureFixture[str]) -> None:
    command = Told(f"{ZWIDTH} --rate 2000 --delay 1 --json", capsys).json()["next"]
    assert "--rate 2000" in command
    command = command.replace("SCENE", "point_mass").removeprefix("hapticbridge ")
    told = Told(f"{command} --fast --duration 0.05 --json", capsys)
    assert told.code == 0
    assert told.json()["is_certified"] is True


@pytest.mark.parametrize("command", [ZWIDTH, "bound --stiffness 2000 --device-damping 2"])
def test_next_command_is_rendered_as_it_is_asked_for(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    run = Told(command, capsys).out.split("next: hapticbridge ")[1].replace("SCENE", "point_mass")
    told = Told(f"{run.strip()} --fast --duration 0.05", capsys)
    assert told.code == 0
    assert "warning" not in told.err
    asked = run.split("--damping ")[1].strip()
    assert f"B = {asked} N s/m felt" in told.out


def test_zwidth_as_json_holds_the_whole_region(capsys: pytest.CaptureFixture[str]) -> None:
    facts = Told(f"{ZWIDTH} --json", capsys).json()
    assert facts["corner"]["stiffness"] == pytest.approx(2400, rel=1e-12)
    assert facts["corner"]["limited_by"] == "passive for any hand"
    lengths = {len(line["stiffness"]) for line in facts["lines"]}
    assert lengths == {len(facts["damping"])} == {len(facts["limit"])}
    assert [line["required"] for line in facts["lines"]] == [True, True, True]


@pytest.mark.parametrize(
    ("coupling", "needed", "changes"),
    [
        # B' = B − K T/2 > 0: K T/2 + B' = B, whatever K and the rate are
        ("--stiffness 2400 --damping 3", "3", ["lower the damping to 2 N s/m, or"]),
        # B' = 0: K T/2, whatever B is
        (
            "--stiffness 5000 --damping 1",
            "2.5",
            ["lower the stiffness to 4000 N/m, or", "raise the rate to 1250 Hz, or"],
        ),
        (
            "--stiffness 5000 --damping 3",
            "3",
            [
                "lower the damping to 2 N s/m, and lower the stiffness to 4000 N/m or raise the "
                "rate to 1250 Hz, or"
            ],
        ),
    ],
)
def test_bound_judges_a_device_and_says_what_helps(
    coupling: str, needed: str, changes: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    told = Told(f"bound {coupling} --device-damping 2", capsys)
    assert told.code == 1
    changes = [*changes, f"take a device with {needed} N s/m"]
    assert f"not passive in any hand {' '.join(changes)}" in told.words
    # each piece of advice is right, and only just
    rate = 1000.0
    for change in changes[:-1]:
        stiffness, damping = (float(word) for word in coupling.split()[1::2])
        if found := re.search(r"damping to ([0-9.]+)", change):
            damping = float(found[1])
        if found := re.search(r"stiffness to ([0-9.]+)", change):
            stiffness = float(found[1])
        elif found := re.search(r"rate to ([0-9.]+)", change):
            rate = float(found[1])
        for share, code in ((1.0, 0), (0.99, 1)):
            command = f"bound --stiffness {stiffness} --damping {damping} --rate {rate}"
            assert Told(f"{command} --device-damping {2 * share}", capsys).code == code


@pytest.mark.parametrize(("device", "code", "holds"), [("", 0, None), ("0.9", 1, False)])
def test_bound_as_json_is_valid_and_null_where_none_suffices(
    device: str, code: int, holds: bool | None, capsys: pytest.CaptureFixture[str]
) -> None:
    told = Told(f"{BOUND} --json" + (f" --device-damping {device}" if device else ""), capsys)
    facts = told.json()
    assert told.code == code
    assert facts["holds"] is holds
    assert facts["largest_stiffness"] == (0 if device else None)  # B alone is too much
    assert facts["frequency_hz"] is None  # without damper it is every frequency
    assert (facts["method"], facts["used_damping"]) == ("lossless", 0.0)
    assert [way["needed"] is None for way in facts["alternatives"]] == [
        *(False, False, False, False, False, True, False, True, False)
    ]


@pytest.mark.parametrize("command", [ZWIDTH, f"{BOUND} --device-damping 2"])
def test_picture_is_written_where_it_is_wanted(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    told = Told(f"{command} --plot {tmp_path}/out.png", capsys)
    assert told.code == 0
    assert f"wrote {tmp_path}/out.png" in told.err
    assert (tmp_path / "out.png").stat().st_size > 10_000


def test_bound_of_a_plain_spring_names_no_frequency(capsys: pytest.CaptureFixture[str]) -> None:
    facts = Told("bound --stiffness 2000 --json", capsys).json()
    assert facts["frequency_hz"] is None
    assert facts["alternatives"][5] == {
        "name": "B' = B, Tustin's damper", "needed": 1.0, "frequency_hz": None
    }  # fmt: skip


@pytest.mark.parametrize(
    "command",
    [
        "zwidth --damping 1e-30 --mass 1e30 --rate 1",
        "zwidth --damping 2 --friction 1e30 --resolution 1e-30",
        "zwidth --damping 2 --delay 3 --filter-time 1e25",
        "bound --stiffness 1e24 --damping 1e30 --device-damping 1e-30",
        "bound --stiffness 1e-20 --damping 1e30 --device-damping 1e30",
    ],
)
def test_numbers_at_the_ends_of_the_range_give_valid_json(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    told = Told(f"{command} --json", capsys)
    assert told.code in {0, 1}
    assert told.json()
