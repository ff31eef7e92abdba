"""Cause of an active run, and what the rules that find one share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from hapticbridge.demand.methods import Method

Kind = Literal[
    "method",
    "contact setting",
    "pump",
    "inputs",
    "delay",
    "rate",
    "damping",
    "quantisation",
    "unmetered work",
    "jumping tendon",
    "bottomless flex",
    "constraint",
    "solver",
    "unknown",
]

WINDOW = 0.2
"""Time in s before the moment that the rules inspect: about ten swings of an unstable coupling, and
too short for a hand to change its action."""

MOST = 0.5
"""Share above which a contribution counts as the main one, without unit."""

SAFE_METHOD = "use method 'lossless' or 'implicit'"
"""Remedy for a method with a hazard."""


@dataclass(frozen=True, slots=True)
class Cause:
    """Likely cause of an active run; not a proof.

    Attributes:
        kind: Name of the cause.
        evidence: Support for it, with numbers.
        remedy: Change that removes it.
    """

    kind: Kind
    evidence: str
    remedy: str


def method_cause(method: Method, where: str = "") -> Cause:
    """Returns a method with a hazard as the cause."""
    return Cause("method", f"{where}method '{method.name}': {method.hazard}", SAFE_METHOD)
