"""The commands, and how they are written on a wire: one line of JSON each."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

from hapticbridge.arguments import Arguments, shown
from hapticbridge.errors import CommandError, choices
from hapticbridge.jsonable import read_json

LONGEST_LINE = 250
"""Bytes of a line; the longest command has some 170."""

_ARGUMENTS = Arguments(CommandError)


@dataclass(frozen=True, slots=True)
class Couple:
    """Give the coupling another stiffness and damping, slowly.

    Attributes:
        stiffness: K in N/m that is to be felt, finite and > 0.
        damping: B in N s/m that is to be felt, finite and >= 0.
        rotational_stiffness: K_r in N m/rad likewise, finite and >= 0.
        rotational_damping: B_r in N m s/rad likewise. Both or neither, which leaves them as they
            are: a bound holds for the two together.

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
            raise CommandError("rotational stiffness and damping are asked for together")
        _ARGUMENTS.number("rotational stiffness", turning[0], "N m/rad", least=0.0)
        _ARGUMENTS.number("rotational damping", turning[1], "N m s/rad", least=0.0)


@dataclass(frozen=True, slots=True)
class Switch:
    """Turn the force off or on, or hold or let go the clutch; None leaves it as it is.

    Attributes:
        force: Whether the device is pushed at all.
        clutch: Whether the device moves without the handle.

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
    """Put the scene back to where the run started; the force fades before and rises after."""


@dataclass(frozen=True, slots=True)
class Mark:
    """Mark a moment: an event ``mark`` in the recording, which ``export`` can cut there."""


@dataclass(frozen=True, slots=True)
class Stop:
    """End the run."""


@dataclass(frozen=True, slots=True)
class Repeat:
    """Do what events of another run's recording did; not to be asked for over a wire.

    Attributes:
        events: Of ``change.CHANGES``, in their order; all are done before the same tick.
    """

    events: tuple[Mapping[str, Any], ...]


Command = Couple | Switch | Reset | Mark | Stop

KINDS: dict[str, type[Command]] = {
    "couple": Couple,
    "switch": Switch,
    "reset": Reset,
    "mark": Mark,
    "stop": Stop,
}


def line_of(command: Command) -> bytes:
    """Returns a command as a line."""
    name = next(name for name, kind in KINDS.items() if isinstance(command, kind))
    return json.dumps({"command": name, **asdict(command)}).encode() + b"\n"


def command_of(line: bytes) -> Command:
    """Reads a line.

    Raises:
        CommandError: It is too long, no command, or has other values than that command takes.
    """
    if len(line) > LONGEST_LINE:
        raise CommandError(f"a command has at most {LONGEST_LINE} bytes")
    try:
        said: Any = read_json(line)
        name = said.pop("command")
        kind = KINDS[name]
    except (ValueError, KeyError, TypeError, AttributeError):
        raise CommandError(f"{shown(line)} is no command; there are {choices(KINDS)}") from None
    try:
        return kind(**said)
    except TypeError:
        valid = choices(field.name for field in fields(kind)) or "nothing else"
        raise CommandError(f"command '{name}' takes {valid}, not {shown(said)}") from None
