"""``hapticbridge bound``: the damping that a coupling needs, and what would help a device."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest
from cli_cases import Called, facts_of

from hapticbridge.cli import zwidth
from hapticbridge.device.simulated.device import SimulatedDevice
from hapticbridge.theory.bounds import NEEDED_SHARE


def test_a_device_at_its_bound_reads_as_true_and_its_limits_agree(call: Called) -> None:
    asked = "bound --stiffness 2229.35 --damping 0 --device-damping 1.11468"
    code, out, _ = call(*asked.split())
    told = " ".join(out.split())
    assert code == 0
    has, needs = re.findall(r"device damping (\S+) >= (\S+) N s/m: passive in any hand", told)[0]
    assert float(has) >= float(needs) > 1.1146
    assert "needs the larger of KT/2 and B: any K up to 2229.36 N/m beside any B up to" in told
    least = ("--stiffness", 2229, "--damping", 1.1146, "--device-damping", 1.11468)
    assert call("bound", *least)[0] == 0


@pytest.mark.parametrize(
    ("stiffness", "damping", "ways"),
    [(2400.0, 3.0, 1), (5000.0, 1.0, 2), (5000.0, 3.0, 1)],  # frozen in words: sessions/bound.txt
)
def test_each_piece_of_advice_leaves_15_percent_in_reserve(
    stiffness: float, damping: float, ways: int, call: Called
) -> None:
    asked = f"bound --stiffness {stiffness:g} --damping {damping:g} --device-damping 2"
    code, out, _ = call(*asked.split())
    advice = " ".join(out.split()).split("not passive in any hand ")[1]
    changes = advice.split(", or ")[:-1]
    assert (code, len(changes)) == (1, ways)
    for change in changes:
        values = {"damping": damping, "stiffness": stiffness, "rate": 1000.0}
        found = dict(re.findall(r"(damping|stiffness|rate) to ([0-9.]+)", change))
        if "stiffness" in found and "rate" in found:  # the one or the other
            del found["rate"]
        values |= {name: float(number) for name, number in found.items()}
        command = "bound " + " ".join(f"--{name} {value}" for name, value in values.items())
        for share, expected in ((1.0, 0), (0.99, 1)):
            reserved = NEEDED_SHARE * 2 * share
            assert call(*f"{command} --device-damping {reserved}".split())[0] == expected


@pytest.mark.parametrize(("device", "code", "holds"), [("", 0, None), ("0.9", 1, False)])
def test_the_json_is_null_where_none_suffices(
    device: str, code: int, holds: bool | None, call: Called
) -> None:
    more = f" --device-damping {device}" if device else ""
    ended, facts = facts_of(call, *f"bound --stiffness 2000 --damping 1{more}".split())
    assert (ended, facts["holds"]) == (code, holds)
    assert facts["largest_stiffness"] == (0 if device else None)  # B alone is too much
    assert facts["frequency_hz"] is None  # without damper it is every frequency
    coupling, names = facts["coupling"], ("requested", "law", "effective")
    assert [coupling[name]["damping"] for name in names] == [1.0, 0.0, 1.0]
    assert facts["method"] == "lossless"
    endless = [way["name"] for way in facts["alternatives"] if way["needed"] is None]
    assert endless == ["B_law = B, Tustin's damper"]


@pytest.mark.parametrize(
    "command",
    [
        "zwidth --damping 1e-30 --mass 1e30 --rate 1",
        "zwidth --damping 2 --friction 1e30 --resolution 1e-30",
        "zwidth --damping 2 --delay 0.003 --filter-time 1e25",
        "bound --stiffness 1e24 --damping 1e30 --device-damping 1e-30",
        "bound --stiffness 1e-20 --damping 1e30 --device-damping 1e30",
    ],
)
def test_numbers_at_the_ends_of_the_range_give_valid_json(command: str, call: Called) -> None:
    code, facts = facts_of(call, *command.split())
    assert code in {0, 1} and facts


def test_a_picture_is_written(tmp_path: Path, call: Called) -> None:
    picture = tmp_path / "out.png"
    code, _, err = call("bound", "--stiffness", "2000", "--damping", "1", "--plot", picture)
    assert (code, f"wrote {picture}" in err) == (0, True)
    assert picture.stat().st_size > 10_000


BORNE = "next: hapticbridge run SCENE --stiffness 2400 --damping 1.7 --device simulated"


@pytest.mark.parametrize(
    ("sheet", "code", "words"),
    [
        ({}, 0, BORNE),
        ({"damping": 1.0}, 1, "take a device with 2 N s/m"),
        ({"damping": 0.0}, 1, "translation: device damping 0 < 1.7 N s/m"),
        ({"damping": 9.0, "delay": 1e-3}, 0, "with its delay of 1 ms"),
        ({"delay": 1e-3}, 1, "translation: device damping 2 < "),
        ({"delay": None}, 0, "its delay is unknown; without one, device damping"),
        ({"rate": 500.0}, 1, "lower the stiffness to 1700 N/m, or take a device with 2.824 N s/m"),
        ({"damping": None}, 2, "its damping is unknown; 'hapticbridge identify' measures it"),
    ],
)
def test_a_device_brings_its_damping_its_delay_and_its_rate(
    sheet: dict[str, float | None],
    code: int,
    words: str,
    call: Called,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    opened = SimulatedDevice()
    opened.info = replace(opened.info, **sheet)  # type: ignore[arg-type] # by the test
    monkeypatch.setattr(zwidth, "open_device", lambda _spec, notify: opened)
    command = ("bound", "--stiffness", 2400, "--damping", 1.7, "--device", "simulated")
    ended, out, err = call(*command)
    assert ended == code
    assert words in " ".join((out + err).split())
    assert "a delay of the device is not in it" not in out
    if "rate" in sheet:  # at a rate that the user chose it is judged there
        chosen = " ".join(call(*command, "--rate", 1000)[1].split())
        assert "device damping 2 < 5.09412 N s/m with one sample in 2 ticks" in chosen
    if code < 2:
        ended, facts = facts_of(call, *command)
        assert (ended, facts["holds"]) == (code, code == 0)
        assert facts["device"]["delay"] == sheet.get("delay", 0.0)
        assert facts["device"]["damping"] == sheet.get("damping", 2.0)


@pytest.mark.parametrize(
    ("device", "reason"),
    [
        ("mouse", "no force moves it along x, y or z, so it needs no damping"),
        ("simulated --device-damping 2", "leave --device-damping out"),
    ],
)
def test_a_device_without_a_bound_is_refused(device: str, reason: str, call: Called) -> None:
    code, _, err = call(*f"bound --stiffness 2400 --device {device}".split())
    assert code == 2
    assert reason in err


def test_a_device_whose_steps_shake_it_is_passive_but_for_them(
    call: Called, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = SimulatedDevice()
    opened.info = replace(opened.info, resolution=5e-5, friction=0.0)
    monkeypatch.setattr(zwidth, "open_device", lambda _spec, notify: opened)
    command = ("bound", "--stiffness", 2400, "--damping", 1.7, "--device", "simulated")
    code, out, _ = call(*command)
    assert code == 1
    assert "passive in any hand but for its encoder's steps" in " ".join(out.split())
    assert "without friction no coupling is free of swings by steps" in " ".join(out.split())
    assert "next:" not in out
    opened.info = replace(opened.info, friction=1.0)
    assert call(*command)[0] == 0


OWN_LOOP = "--loop-rate 1e4 --loop-delay 1e-5"


@pytest.mark.parametrize(
    ("numbers", "stiffness", "words"),
    [
        ("--device-damping 2", 2400.0, "if its friction holds the encoder's steps: --friction"),
        (
            "--device-damping 2 --friction 0.01 --resolution 1e-5",
            1200.0,
            "friction 10 mN >= 8.5 mN",
        ),
        ("--device-damping 2 --resolution 0", 2400.0, "passive in any hand method lossless"),
        (
            f"--device-damping 2 --friction 0.1 --resolution 1e-5 {OWN_LOOP}",
            17000.0,
            "for its step",
        ),
        (f"--device-damping 2 {OWN_LOOP}", 26153.8, "not judged are the encoder's steps"),
        ("--device simulated:damping=1", 1200.0, "device damping 1 >= 0.85 N s/m: passive in any"),
        ("--device simulated:delay=2", 1307.9, "its delay is unknown; without one"),
    ],
)
def test_without_a_stiffness_it_is_the_one_that_a_run_chooses(
    numbers: str, stiffness: float, words: str, call: Called
) -> None:
    code, out, _ = call(*f"bound {numbers}".split())
    told = " ".join(out.split())
    assert code == 0
    assert told.startswith("as 'hapticbridge run' chooses it: K = ")
    assert words in told
    assert ("encoder's steps" in told) is ("--resolution" not in numbers and "sim" not in numbers)
    requested = facts_of(call, *f"bound {numbers}".split())[1]["coupling"]["requested"]
    assert requested["stiffness"] == pytest.approx(stiffness, rel=1e-4)


def test_the_steps_of_a_stated_encoder_are_judged(call: Called) -> None:
    command = "bound --stiffness 2000 --damping 1.5 --device-damping 2 --resolution 1e-5 --friction"
    assert call(*command.split(), 0.02)[0] == 0
    code, out, _ = call(*command.split(), 0.01)
    assert code == 1
    assert "passive in any hand but for its encoder's steps" in " ".join(out.split())


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ("", "bound needs --stiffness, or --device or --device-damping without --damping"),
        ("--device-damping 2 --damping 1", "bound needs --stiffness, or --device or"),
        ("--device simulated --friction 1", "--friction and --resolution go with --device-damping"),
        ("--stiffness 1 --resolution 1e-5", "--friction and --resolution go with --device-damping"),
    ],
)
def test_what_it_cannot_choose_or_judge_is_refused(options: str, reason: str, call: Called) -> None:
    code, _, err = call(*f"bound {options}".split())
    assert (code, reason in err) == (2, True)


def test_its_help_has_the_exit_code_of_what_is_not_judged(call: Called) -> None:
    told = " ".join(call("bound", "--help")[1].split())
    assert "0 if it does, or if it cannot be judged because the device's delay is unknown" in told


def test_the_z_width_names_the_command_for_a_loop_on_the_board(call: Called) -> None:
    told = call("zwidth", "--damping", 2)[1]
    [command] = re.findall(r"bears more: 'hapticbridge (bound .*)'", " ".join(told.split()))
    code, facts = facts_of(call, *command.replace("HZ", "1e4").replace("SECONDS", "1e-5").split())
    assert (code, facts["coupling"]["requested"]["stiffness"] > 20_000.0) == (0, True)
