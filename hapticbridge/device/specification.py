"""Options of a device specification: ``name=value,name=value``."""

from __future__ import annotations

from collections.abc import Iterable

from hapticbridge.errors import DeviceError, choices

FILES = ("path",)
"""Options that take all remaining text as a file's name, commas included."""

TEXTS = ("hand", "serial", "firmware", "log", "profile", "reverse", "service", "library")
"""Options that are text up to the next comma; a serial number may have leading zeros."""

WHOLE = ("delay",)
"""Options that are whole numbers; all others are numbers."""


def parsed(device: str, text: str, valid: Iterable[str]) -> dict[str, object]:
    """Parses the options after a device's name, separated by commas.

    Raises:
        DeviceError: A part is not ``name=value``, a name occurs twice or is unknown, or a value is
            not a number.
    """
    names = tuple(valid)
    values: dict[str, object] = {}
    while text:
        name, equals, text = text.partition("=")
        name = name.strip()
        if not equals:
            raise DeviceError(f"'{name}' is not an option; write options as name=value")
        if name in values:
            raise DeviceError(f"option '{name}' is set twice; set it once")
        refuse_unknown(device, [name], names)
        if name in FILES:
            value, text = text, ""
        else:
            value, _, text = text.partition(",")
        values[name] = _value(name, value.strip())
    return values


def _value(name: str, text: str) -> object:
    if name in FILES or name in TEXTS:
        return text
    try:
        return int(text) if name in WHOLE else float(text)
    except ValueError:
        kind = "a whole number" if name in WHOLE else "a number"
        raise DeviceError(f"{name} = '{text}': must be {kind}") from None


def refuse_unknown(device: str, options: Iterable[str], valid: Iterable[str]) -> None:
    """Raises DeviceError for an unknown option; the message lists the valid ones."""
    names = tuple(valid)
    unknown = [name for name in options if name not in names]
    if unknown:
        raise DeviceError(
            f"unknown option '{unknown[0]}' of the {device} device; choose one of {choices(names)}"
        )
