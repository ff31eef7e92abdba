"""Commands, and their wire format: one line of JSON each."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

from hapticbridge.arguments import Arguments, shown
from hapticbridge.errors import CommandError, choices
from hapticbridge.files import read_json

LONGEST_LINE = 250
"""Largest size of a line in bytes; the longest command has about 170."""

_ARGUMENTS = Arguments(CommandError)


@dataclass(frozen=True, slots=True)
class Couple:
    """Command that changes stiffness and damping of the coupling gradually.

    Attributes:
        stiffness: Requested K in N/m, finite and > 0.
        damping: Requested B in N s/m, finite and >= 0.
        rotational_stiffness: Requested K_r in N m/rad, finite and >= 0; None keeps it.
        rotational_damping: Requested B_r in N m s/rad, finite and >= 0; None keeps it. Both
            rotational gains are given or neither, because their bound is a joint one.

    Raises:
        CommandError: A value is out of range.
    """

    stiffness: float
    damping: float
    rotational_stiffness: float | None = None
    rotational_damping: float | None = None

    def __post_init__(self) -> None:
        _ARGUMENTS.number("stiffness", self.stiffness, "N/m", least=0.0, is_open=True)
        _ARGUMENTS.number("damping", self.damping, "N s/m", least=0.0)
        turning = self.rotational_stiffness, self.rotational_damping
        if turning == (None, None):
            return
        if turning[0] is None or turning[1] is None:
            raise CommandError("give rotational stiffness and damping together, or neither")
        _ARGUMENTS.number("rotational stiffness", turning[0], "N m/rad", least=0.0)
        _ARGUMENTS.number("rotational damping", turning[1], "N m s/rad", least=0.0)


@dataclass(frozen=True, slots=True)
class Switch:
    """Command that switches force or clutch; None keeps a switch as it is.

    Attributes:
        force: True enables force on the device.
        clutch: True lets the device move without the handle.

    Raises:
        CommandError: A value is neither true nor false.
    """

    force: bool | None = None
    clutch: bool | None = None

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if value is not None and not isinstance(value, bool):
                raise CommandError(f"{field.name} is {shown(value)}; it must be true or false")


@dataclass(frozen=True, slots=True)
class Reset:
    """Command that resets the scene; the force fades before and rises after."""


@dataclass(frozen=True, slots=True)
class Mark:
    """Command that marks a moment: an event ``mark`` in the recording; ``export`` can cut there."""


@dataclass(frozen=True, slots=True)
class Stop:
    """Command that ends the run."""


@dataclass(frozen=True, slots=True)
class Repeat:
    """Internal command that repeats recorded events; not accepted over the wire.

    Attributes:
        events: Events of ``execution.CHANGES`` in order, all applied before one tick.
    """

    events: tuple[Mapping[str, Any], ...]


@dataclass(frozen=True, slots=True)
class Hold:
    """Internal command that keeps the force off while a step of the scene does not end.

    Attributes:
        is_held: True keeps it off, False gives it back as the switches have it.
    """

    is_held: bool


Command = Couple | Switch | Reset | Mark | Stop

KINDS: dict[str, type[Command]] = {
    "couple": Couple,
    "switch": Switch,
    "reset": Reset,
    "mark": Mark,
    "stop": Stop,
}


def line_of(command: Command) -> bytes:
    """Returns a command as a line of JSON."""
    name = next(name for name, kind in KINDS.items() if isinstance(command, kind))
    return json.dumps({"command": name, **asdict(command)}).encode() + b"\n"


def command_of(line: bytes) -> Command:
    """Parses a line.

    Raises:
        CommandError: The line is too long, not a command, or has values that the command does not
            take.
    """
    if len(line) > LONGEST_LINE:
        raise CommandError(f"a command has at most {LONGEST_LINE} bytes")
    try:
        values: Any = read_json(line)
        name = values.pop("command")
        kind = KINDS[name]
    except (ValueError, KeyError, TypeError, AttributeError):
        raise CommandError(
            f"{shown(line)} is not a command; choose one of {choices(KINDS)}"
        ) from None
    try:
        return kind(**values)
    except TypeError:
        valid = choices(field.name for field in fields(kind)) or "nothing else"
        raise CommandError(f"command '{name}' takes {valid}, not {shown(values)}") from None
