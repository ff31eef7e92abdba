"""Flags of the command line: made from the fields of the options, with their text and default."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import MISSING, Field, fields, is_dataclass
from typing import Any, Literal, get_args, get_origin

import pytest
from cli_cases import Called, one_sentence

from hapticbridge.arguments import check_fields, members, rule_of, types_of
from hapticbridge.cli.flags import Flag, built, flags_of, texts_of, values_of
from hapticbridge.cli.main import COMMANDS, command_class
from hapticbridge.cli.run import Run
from hapticbridge.coupling import Coupling
from hapticbridge.demand.guard import Limits
from hapticbridge.run.hands import Grasp, GripAxis
from hapticbridge.run.options import BridgeOptions, Workspace

OPTION_CLASSES: tuple[Any, ...] = BridgeOptions, Workspace, Limits, Coupling, Grasp, GripAxis

WITHOUT_FLAG = {
    ("Grasp", "coupling"): "the gains of the command are those of every hand",
    ("Grasp", "workspace"): "scale and axes of the command are those of every hand",
    ("Grasp", "limits"): "the limits of the command are those of every hand",
    ("Grasp", "clutch"): "--clutch is the button of every device",
    ("Grasp", "dead_man"): "--dead-man is the button of every device",
    ("Grasp", "grip_axis"): "its joint and scale have flags",
    ("GripAxis", "coupling"): "the fingers take the stiffest that is safe",
}
"""Fields of options that no flag of ``run`` sets by itself, each with the reason."""


def option_fields() -> Iterator[tuple[Any, Field[Any]]]:
    for kind in OPTION_CLASSES:
        for each in fields(kind):
            is_inner = is_dataclass(types_of(kind)[each.name])
            reason = rule_of(each).no_flag or WITHOUT_FLAG.get((kind.__name__, each.name))
            if not is_inner and not reason:
                yield kind, each


FIELDS = list(option_fields())


def flag_of(kind: Any, each: Field[Any]) -> Flag:
    """Returns the flag of ``run`` that is made from a field."""
    of_field = (kind, each.name)
    [flag] = [
        flag
        for flag in flags_of(Run)
        if of_field in ((flag.owner, flag.path[-1]), flag.rule.source)
    ]
    return flag


OF_THEIR_OWN = {
    "axes": "0 -1 0 1 0 0 0 0 1",
    "scene_rate": "500",
    "impact_pulses": "0.5",
    "pulse": "250,8",
}
"""Values of flags by the last part of their path, where the type and rule do not tell one."""


NEEDED = {"pulse": ("--impact-pulses", "1")}
"""Words without which a flag is refused, by the name of its field."""


def text_for(flag: Flag) -> list[str]:
    """Returns words for a value of a flag's type that its rule admits."""
    kinds = flag.of_tuple[:1] or members(flag.kind)
    if get_origin(kinds[0]) is Literal:
        return [get_args(kinds[0])[0]]
    if (own := OF_THEIR_OWN.get(flag.path[-1])) is not None:
        return own.split()
    if int in kinds or float in kinds:
        rule = flag.rule
        return [f"{rule.least:g}" if not rule.is_open and math.isfinite(rule.least) else "0.5"]
    return ["lossless" if flag.path[-1] == "method" else "tool"]


def field_id(value: Any) -> str:
    return str(getattr(value, "__name__", getattr(value, "name", "")))


@pytest.mark.parametrize(("kind", "each"), FIELDS, ids=field_id)
def test_a_field_of_the_options_has_a_flag_with_its_text_and_default(
    kind: Any, each: Field[Any]
) -> None:
    flag, text = flag_of(kind, each), texts_of(kind)[each.name]
    assert text and flag.text().startswith(text.replace("``", "'"))
    assert flag.rule.unit == rule_of(each).unit and flag.rule.valid() == rule_of(each).valid()
    if kind is not Coupling and each.default is not MISSING and flag.default is not MISSING:
        assert flag.default == each.default


@pytest.mark.parametrize(("kind", "each"), FIELDS, ids=field_id)
def test_a_flag_reaches_its_field(kind: Any, each: Field[Any]) -> None:
    flag = flag_of(kind, each)
    for word, value in flag.words.items():
        words = [] if flag.count == 0 else text_for(flag)
        needed = NEEDED.get(each.name, ())
        made = built(Run, values_of(Run, "run", ["peg_in_hole", *needed, word, *words]))
        for name in flag.path:
            made = made[name] if isinstance(made, dict) else getattr(made, name)
        assert made == value if flag.count == 0 else made != each.default
        assert words == [] or [str(made), repr(made)] != [str(each.default), repr(each.default)]


def test_a_reason_stands_for_no_field_that_is_gone() -> None:
    known = {(kind.__name__, each.name) for kind in OPTION_CLASSES for each in fields(kind)}
    assert set(WITHOUT_FLAG) <= known


def test_without_flags_the_defaults_are_those_of_the_classes() -> None:
    made = built(Run, values_of(Run, "run", ["peg_in_hole"]))
    assert (made.options, made.coupling) == (BridgeOptions(), {})
    assert (made.grip, made.device) == ("grip", Grasp("grip").device)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_flag_has_a_text_and_its_page_fits_the_terminal(call: Called, name: str) -> None:
    flags = list(flags_of(command_class(name)))
    assert all(flag.text() for flag in flags)
    words = [word for flag in flags for word in flag.words]
    assert len(set(words)) == len(words)
    for option in ("--help", "--help-all"):
        code, out, err = call(name, option)
        assert (code, err) == (0, "")
        lines = [line for line in out.splitlines() if not line.startswith("    hapticbridge ")]
        assert max(map(len, lines)) < 80
        assert option == "--help-all" or len(lines) <= SCREEN
    assert all(word in out for word in words)


SCREEN = 50
"""Lines of a terminal on half a screen of today."""


def test_a_page_has_usage_summary_example_and_a_line_for_each_option(call: Called) -> None:
    assert call("compare", "--help")[1].splitlines() == [
        "usage: hapticbridge compare A B [OPTIONS]",
        "",
        "Find the first tick and field where two runs differ.",
        "",
        "Ticks are compared bit by bit, without the times of the clock; runs at",
        "different rates where their ticks coincide. Exit code 0 if both are the same",
        "run, 1 if not.",
        "",
        "Example:",
        "    hapticbridge compare before.mcap after.mcap",
        "",
        "  A                     A recording.",
        "  B                     Another one.",
        "  --json                Print the comparison as JSON.",
    ]


def test_a_long_help_has_two_parts(call: Called) -> None:
    code, out, _ = call("run", "--help")
    assert code == 0
    assert "--record PATH" in out and "--clutch" not in out
    more = re.search(r"(\d+) more options, and more on these: hapticbridge run --help-all", out)
    assert more is not None
    every = call("run", "--help-all")[1]
    assert "--record PATH" in every and "--clutch INT" in every and "more options" not in every
    flags = [set(re.findall(r"^  (--[a-z-]+)", text, flags=re.MULTILINE)) for text in (out, every)]
    assert flags[0] < flags[1]
    assert len(flags[1]) - len(flags[0]) == int(more[1])


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("run", "'run' needs SCENE: hapticbridge run SCENE [OPTIONS]"),
        ("run a b", "'run' has no place for 'b': hapticbridge run SCENE [OPTIONS]"),
        ("run a --rat 5", "'run' has no option '--rat'; did you mean '--rate'?"),
        ("run a --zzz", "'run' has no option '--zzz'; 'hapticbridge run --help' lists them"),
        ("run a --rate", "--rate needs a value: --rate NUMBER"),
        ("run a --rate x", "--rate is 'x'; it must be a number in Hz"),
        ("run a --clutch 1.5", "--clutch is '1.5'; it must be a whole number"),
        ("run a --contact x", "--contact is 'x'; it must be one of 'rigid', 'scene'"),
        (
            "run a --scene-rate x",
            "--scene-rate is 'x'; it must be a number in Hz, or one of 'auto'",
        ),
        ("run a --fast=1", "--fast takes no value"),
        ("run a --axes 1 0 0", "--axes takes 9 values, not 3"),
        ("doctor --duration 0", "duration is 0.0 s; it must be 1 to 3600"),
        ("export x.mcap", "'export' needs --format NAME: hapticbridge export --format NAME FILE …"),
    ],
)
def test_a_wrong_word_is_refused_in_one_sentence(call: Called, words: str, sentence: str) -> None:
    code, out, err = call(*words.split())
    assert (code, out) == (2, "")
    assert one_sentence(err).startswith(f"error: {sentence}")


def test_words_after_two_dashes_are_no_flags() -> None:
    assert values_of(Run, "run", ["--fast", "--", "--odd"]) == {
        ("fast",): True,
        ("scene",): "--odd",
    }
    repeated = values_of(Run, "run", ["--set", "a=1", "peg", "--set=b=-2", "--ramp", "-1e-3"])
    assert repeated[("settings",)] == ("a=1", "b=-2")
    assert repeated["options", "limits", "ramp"] == -1e-3


@pytest.mark.parametrize("name", COMMANDS)
def test_the_defaults_of_a_command_are_valid(name: str) -> None:
    command = command_class(name)
    required = [flag for flag in flags_of(command) if flag.default is MISSING]
    values: dict[tuple[str, ...], Any] = {
        flag.path: flag.value(text_for(flag)) for flag in required if len(flag.path) == 1
    }
    check_fields(built(command, values))


@pytest.mark.parametrize("text", ["\u0663", "\uff13", "1_0"])
@pytest.mark.parametrize(
    "words",
    [
        ("run", "point_mass", "--duration", "{}"),
        ("run", "point_mass", "--device", "simulated:damping={}"),
        ("run", "point_mass", "--device", "simulated:delay={}"),
        ("run", "point_mass", "--impact-pulses", "1", "--pulse", "{},20"),
        ("run", "peg_in_hole", "--set", "clearance={}"),
        ("run", "point_mass", "--grip", "mass@0,{},0"),
        ("export", "run.mcap", "--format", "lerobot", "--fps", "{}"),
    ],
)
def test_a_number_is_written_in_plain_notation(
    call: Called, words: tuple[str, ...], text: str
) -> None:
    """Python reads these as 3, Arabic and full-width, and 10."""
    code, _, told = call(*(word.format(text) for word in words))
    assert (code, text in told) == (2, True)
