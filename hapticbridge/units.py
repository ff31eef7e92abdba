"""Numbers with units, as text and as HTML."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from html import escape

_PREFIXES = (
    (1e9, "G"),
    (1e6, "M"),
    (1e3, "k"),
    (1.0, ""),
    (1e-3, "m"),
    (1e-6, "µ"),
    (1e-9, "n"),
    (1e-12, "p"),
)


def format_si(value: float, unit: str) -> str:
    """Formats a number with an SI prefix and three digits: ``-3.41 mJ``, ``0 J``."""
    if value == 0:
        return f"0 {unit}"  # without the sign of -0.0
    if not math.isfinite(value):
        return f"{value:g} {unit}"
    rounded = float(f"{value:.3g}")  # 0.9996 J is 1 J and not 1e+03 mJ
    for factor, prefix in _PREFIXES:
        if abs(rounded) >= factor:
            return f"{rounded / factor:.3g} {prefix}{unit}"
    return f"{value:.2g} {unit}"


def format_number(value: float, digits: int = 4) -> str:
    """Formats a number with so many digits; a large one has no exponent: ``24000``, ``1e-05``."""
    return f"{float(f'{value:.{digits}g}'):.15g}"


def format_count(count: int, noun: str) -> str:
    """Formats a number of things, whose plural ends in s: ``1 pair``, ``2 pairs``."""
    return f"{count} {noun}{'s' * (count != 1)}"


def format_degrees(radians: float, digits: int = 3) -> str:
    """Formats an angle in degrees: ``140 deg``."""
    return f"{format_number(math.degrees(radians), digits)} deg"


def format_forces(hand: float | None, tool: float) -> str:
    """Names whose a force is: ``1.7 N on the hand, 5.67 N on the tool``.

    ``hand`` is None without a hand that feels it. Equal numbers are written once, as the hand's.
    """
    return format_wrenches(None if hand is None else (hand,), (tool,), ("N",))


def format_wrenches(
    hand: tuple[float, ...] | None, tool: tuple[float, ...], units: tuple[str, ...] = ("N", "N m")
) -> str:
    """Names whose the force and the torque are; as ``format_forces`` for both at once."""
    texts = [
        ", ".join(
            format_si(value if abs(value) >= ROUNDING else 0.0, unit)
            for value, unit in zip(values, units, strict=True)
        )
        for values in (hand, tool)
        if values is not None
    ]
    if hand is None:
        return f"{texts[0]} on the tool"
    if texts[0] == texts[1]:
        return f"{texts[0]} on the hand"
    return f"{texts[0]} on the hand; {texts[1]} on the tool"


def format_share(share: float) -> str:
    """Formats a share in percent; from ten times the whole on, only that it is more."""
    return f"{share:.0%}" if share < 10.0 else "more than 1000%"


def format_energy(joules: float) -> str:
    """Formats an energy; below 1 pJ is the rounding of the sums, which counts as 0."""
    return format_si(joules if abs(joules) >= ROUNDING else 0.0, "J")


def shown_energies(
    energies: Mapping[str, float], start_potential: float, credit: float = 0.0
) -> dict[str, float]:
    """Returns energies in J under the names that are printed.

    The potential has an arbitrary zero, so its change since the start of the run is shown. That of
    another program's scene is a tank for the tool, which began with the hand's credit in J. Nothing
    else is known of such a scene, so no energy of it is shown.
    """
    shown = {}
    for name, joules in energies.items():
        if credit and name == "potential":
            shown["tank"] = joules / start_potential * credit
        elif credit and name == "environment_energy":
            continue
        elif name == "potential":
            shown["potential change"] = joules - start_potential
        else:
            shown[name.replace("_", " ")] = joules
    return shown


def energy_rows(
    energies: Mapping[str, float], start_potential: float, credit: float = 0.0
) -> Iterator[tuple[str, str]]:
    """Yields name and text of each energy that is not exactly 0, as one without motors is."""
    for name, joules in shown_energies(energies, start_potential, credit).items():
        if joules:
            yield name, format_energy(joules)


ROUNDING = 1e-12
"""Energy in J, force in N and torque in N m below which a number is rounding and shown as 0."""


# In a notebook


def facts_html(title: str, rows: Iterable[tuple[str, str]], notes: Iterable[str] = ()) -> str:
    """Returns HTML of a title, a table of facts and notes; all of them are plain text."""
    cells = "".join(
        f"<tr><th style='text-align:left'>{escape(name)}</th>"
        f"<td style='text-align:left'>{escape(text)}</td></tr>"
        for name, text in rows
    )
    below = "".join(f"<div>{escape(note)}</div>" for note in notes)
    return f"<b>{escape(title)}</b><table>{cells}</table>{below}"
