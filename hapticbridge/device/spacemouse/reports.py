"""Input reports of a SpaceMouse."""

from __future__ import annotations

import struct
from typing import NamedTuple

FULL_SCALE = 350
"""Counts at full deflection of the puck (spacenavd, 2025). Slightly larger counts can come and are
clamped."""

MOST_BUTTON_BYTES = 6
"""Bytes of buttons that are read. A SpaceMouse Enterprise has 31 buttons; 48 bits fit into a
record's integer."""

LED_ON, LED_OFF = bytes([4, 1]), bytes([4, 0])
"""Output report 4: the light in the base."""

_TRANSLATION, _ROTATION, _BUTTONS = 1, 2, 3
"""Numbers of the input reports."""
_THREE, _SIX = struct.Struct("<3h"), struct.Struct("<6h")


class Deflection(NamedTuple):
    """Deflection of the puck along or about some of its axes.

    The maker's axes: x to the right, y towards the user, z down; rotations about them.

    Attributes:
        first: Index of the first axis in (x, y, z, rx, ry, rz): 0, or 3 for rotations alone.
        counts: 3 or 6 signed numbers.
    """

    first: int
    counts: tuple[int, ...]


class Buttons(NamedTuple):
    """Pressed buttons.

    Attributes:
        bits: One bit per button; the assignment differs between models.
    """

    bits: int


def decoded(report: bytes) -> Deflection | Buttons | None:
    """Decodes one report, its number first; None for an unknown report.

    Report 1 is the translation; with 13 bytes (wireless models, the receiver, newer firmware) it
    holds translation and rotation. Report 2 is the rotation of older wired models, which send both
    in pairs. The layouts are distinguished by length, because one product was sold with both.
    """
    if len(report) < 2:
        return None
    number = report[0]
    if number == _BUTTONS:
        return Buttons(int.from_bytes(report[1 : 1 + MOST_BUTTON_BYTES], "little"))
    if number == _TRANSLATION and len(report) >= 1 + _SIX.size:
        return Deflection(0, _SIX.unpack_from(report, 1))
    if number in (_TRANSLATION, _ROTATION) and len(report) >= 1 + _THREE.size:
        return Deflection(3 * (number - 1), _THREE.unpack_from(report, 1))
    return None


def share(count: int, dead_band: float) -> float:
    """Returns a reported count as a share of full scale, −1 to 1, 0 within the dead band d.

        sign(c) · max(0, |c| − d)/(1 − d),    c = count/350 clamped to ±1,    0 <= d < 1

    It is continuous at the edge of the dead band.
    """
    size = min(abs(count) / FULL_SCALE, 1.0)
    if size <= dead_band:
        return 0.0
    return (size - dead_band) / (1.0 - dead_band) * (1.0 if count > 0 else -1.0)
