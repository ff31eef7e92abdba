"""``name=value,name=value``: what a user types after a device's name and a colon."""

from __future__ import annotations

from collections.abc import Iterable

from hapticbridge.errors import DeviceError, choices

FILES = ("path",)
"""Options that take all that comes after them: the file's name, commas too."""

TEXTS = ("hand", "serial", "firmware", "log", "profile", "reverse", "service", "library")
"""Options that are text up to the next comma; a serial number may have leading zeros."""

WHOLE = ("delay",)
"""Options that are whole numbers; all others are numbers."""


def parsed(device: str, text: str, valid: Iterable[str]) -> dict[str, object]:
    """Reads what stands after a device's name.

    Args:
        device: The name.
        text: Options, separated by commas; may be empty.
        valid: Options that the device has.

    Raises:
        DeviceError: A part is no ``name=value``, a name is there twice or unknown, or a value is no
            number.
    """
    names = tuple(valid)
    values: dict[str, object] = {}
    while text:
        name, equals, text = text.partition("=")
        name = name.strip()
        if not equals:
            raise DeviceError(f"'{name}' is no option; options are written name=value")
        if name in values:
            raise DeviceError(f"{name} is there twice")
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
    """Refuses an option that a device does not have, by its name.

    Raises:
        DeviceError: Names the first one, and those that there are.
    """
    names = tuple(valid)
    unknown = [name for name in options if name not in names]
    if unknown:
        raise DeviceError(
            f"unknown option '{unknown[0]}' of the {device} device; there are {choices(names)}"
        )
