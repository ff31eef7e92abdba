"""``hapticbridge zwidth``: the region of a device by theory, and walls tried on one."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from cli_cases import Called, facts_of

from hapticbridge.device import SimulatedDevice
from hapticbridge.theory.bounds import minimum_damping, stiffest_late_coupling
from hapticbridge.theory.transfer import CouplingGrid

ZWIDTH = "zwidth --damping 2 --mass 0.1 --friction 0.05 --resolution 1e-5 --rate 1000"
FREE = "simulated:hand=none,resolution=1e-6"


@pytest.mark.parametrize(
    "command",
    [ZWIDTH, f"{ZWIDTH} --rate 2000 --delay 0.5e-3", "bound --stiffness 2000 --device-damping 2"],
)
def test_the_next_command_runs_certified_and_is_rendered_as_it_asks(
    command: str, call: Called
) -> None:
    _, out, _ = call(*command.split())
    following = out.split("next: hapticbridge ")[1].replace("SCENE", "point_mass")
    code, out, err = call(*f"{following.strip()} --fast --duration 0.05 --json".split())
    told, asked = json.loads(out), following.split("--damping ")[1].split()[0]
    assert (code, told["is_certified"], "warning" in err) == (0, True, False)
    for name in ("requested", "effective"):
        assert told["coupling"][name]["damping"] == pytest.approx(float(asked), rel=1e-3)


def test_the_json_holds_the_whole_region(call: Called) -> None:
    _, facts = facts_of(call, *ZWIDTH.split())
    for name, damping in (("requested", 1.7), ("law", 0.5), ("effective", 1.7)):
        coupling = facts["corner"][name]
        assert coupling["stiffness"] == pytest.approx(2400, rel=1e-12)
        assert coupling["damping"] == pytest.approx(damping, rel=1e-12)
    assert facts["corner"]["limited_by"] == "passive for any hand"
    lengths = {len(line["stiffness"]) for line in facts["lines"]}
    assert lengths == {len(facts["damping"])} == {len(facts["limit"])}
    assert [line["required"] for line in facts["lines"]] == [True, True, True]


def test_what_is_measured_meets_the_line_of_a_device_that_nobody_holds(
    tmp_path: Path, call: Called
) -> None:
    picture = tmp_path / "width.svg"
    _, facts = facts_of(call, "zwidth", "--measure", FREE, "--plot", picture)
    line = next(line for line in facts["lines"] if line["name"] == "stable without a hand")
    for limit in facts["measured"]:
        # the line is given at points; between them it is nearly straight
        near = min(range(101), key=lambda i: abs(facts["damping"][i] - limit["damping"]))
        assert limit["borne"] == pytest.approx(line["stiffness"][near], rel=0.05)
        assert limit["borne"] < limit["not_borne"] < 1.03 * limit["borne"]
    assert facts["measured"][0]["borne"] == pytest.approx(2.0 * 2.0 / 1e-3, rel=0.05)  # 2 b / T
    assert "measured" in picture.read_text(encoding="utf-8")


def test_a_device_of_less_damping_than_was_said_is_found_out(call: Called) -> None:
    for damping, is_told in (("--damping 2 ", True), ("", False)):
        code, out, _ = call(*f"zwidth {damping}--measure simulated:hand=none,damping=1".split())
        assert (code, "it bears less than theory allows" in out) == (0, is_told)
        following = out.split("next: ")[1].splitlines()[0]
        assert following.endswith(" --device simulated:hand=none,damping=1")


def test_a_device_is_closed_whatever_was_refused(
    call: Called, monkeypatch: pytest.MonkeyPatch
) -> None:
    closed: list[SimulatedDevice] = []

    def close(device: SimulatedDevice) -> None:
        closed.append(device)

    monkeypatch.setattr(SimulatedDevice, "close", close)
    code, _, err = call("zwidth", "--measure", "mouse")
    assert code == 2
    assert "no force moves this device along x, y or z, so it has no walls to try" in err
    for wrong in ("--axis q", "--damping 1e31"):
        assert call(*f"zwidth --measure {FREE} {wrong}".split())[0] == 2
    assert len(closed) == 2


def test_a_delay_is_told_as_the_ticks_that_it_counts(call: Called) -> None:
    assert "a delay of 140 µs counts as 1 tick\n" in call(*f"{ZWIDTH} --delay 0.00014".split())[2]
    assert "counts as" not in call(*ZWIDTH.split())[2]


@pytest.mark.parametrize("delay", [1e-3, 3e-3])
def test_the_coupling_to_use_behind_a_delay_holds_for_every_scene(
    delay: float, call: Called
) -> None:
    _, facts = facts_of(call, "zwidth", "--damping", 2, "--delay", delay)
    law = facts["corner"]["law"]
    best = stiffest_late_coupling(2.0, 1e-3, delay, 1)
    assert (law["stiffness"], law["damping"]) == pytest.approx(best)
    grid = CouplingGrid(law["stiffness"], law["damping"])
    needed = minimum_damping(grid, 1e-3, delay=delay / 1e-3)
    assert needed == pytest.approx(0.85 * 2.0)
    assert facts["corner"]["limited_by"] == "passive for any hand"
    # friction that does not hold the steps lowers both gains
    weak = "--friction", 0.005, "--resolution", 1e-5
    _, facts = facts_of(call, "zwidth", "--damping", 2, "--delay", delay, *weak)
    law = facts["corner"]["law"]
    assert law["stiffness"] * 1e-5 / 2 + law["damping"] * 1e-5 / 1e-3 <= 0.005
