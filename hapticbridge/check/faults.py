"""What is wrong or risky in a scene: each fault with its place and the change that mends it."""

from __future__ import annotations

from dataclasses import dataclass

from hapticbridge.check.places import Place


@dataclass(frozen=True, slots=True)
class Fault:
    """One thing that is wrong.

    Attributes:
        kind: What it is called, the same for all of its kind.
        place: File, line and element.
        sentence: What is wrong, with its numbers.
        change: What to write there.
    """

    kind: str
    place: Place
    sentence: str
    change: str


def others(count: int) -> str:
    """Returns how many more there are, as the end of a list's first name."""
    return f" and {count} more" if count > 0 else ""
