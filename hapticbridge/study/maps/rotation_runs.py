"""What the map ``rotation`` runs: a handle that spins, at an angle, or turns suddenly."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from hapticbridge.study.maps.spinning_tool import coupling_of, speed_of_cut, spin, sudden
from hapticbridge.study.maps.stability_map import Point

SOFT, HARD = 2.0, 20.0
"""K_r in N m/rad: that of the simulated device, and one ten times stiffer."""

METHODS_SHOWN = ("implicit", "compensated", "lossless", "implicitfast", "explicit", "weld")

SPEED = (0.0, 200.0)
ANGLE = (0.0, 3.1)
"""Ranges in rad/s and rad: the angle ends short of the cut."""

SLOWEST = 2.0
"""In rad/s, where the lines over the logarithm of the speed begin."""

LINES = (
    ("implicit", 0.0),
    ("implicit", SOFT),
    ("implicit", HARD),
    ("compensated", SOFT),
    ("lossless", SOFT),
    ("implicitfast", SOFT),
    ("explicit", SOFT),
)
"""Method and K_r in N m/rad of what is drawn over the speed; with 0 the coupling is one of
translation alone."""


def points(count: int) -> Sequence[Point]:
    """Returns a grid of speed and angle for each method, and lines over the speed."""
    side = max(2, round((0.85 * count / len(METHODS_SHOWN)) ** 0.5))
    many = max(4, round(0.15 * count / (len(LINES) + len(METHODS_SHOWN))))
    cells = [
        _point("cell", method, SOFT, speed, angle)
        for method in METHODS_SHOWN
        for angle in np.linspace(*ANGLE, side)
        for speed in np.linspace(*SPEED, side)
    ]
    lines = [
        _point("line", method, stiffness, speed)
        for method, stiffness in LINES
        for speed in np.geomspace(SLOWEST, SPEED[1], many)
    ]
    cuts = [
        _point("cut", method, SOFT, speed)
        for method in METHODS_SHOWN
        for speed in np.linspace(SLOWEST, SPEED[1], many)
    ]
    return [*cells, *lines, *cuts, _point("limit", "implicit", SOFT, 0.0)]


def _point(what: str, method: str, stiffness: float, speed: float, angle: float = 0.0) -> Point:
    return {
        "what": what,
        "method": method,
        "rotational_stiffness": float(stiffness),
        "speed": float(speed),
        "angle": float(angle),
    }


def evaluate(point: Point) -> Mapping[str, float | int | str]:
    """Spins a handle for 1 s, or searches for the speed at which the angle passes π.

    In a ``cell`` or on a ``line`` the tool spins with the handle from the start, in a ``cut`` it is
    at rest.
    """
    method, stiffness = str(point["method"]), float(point["rotational_stiffness"])
    if point["what"] == "limit":
        return {"limit": speed_of_cut(method, stiffness)}
    speed, angle = float(point["speed"]), float(point["angle"])
    coupling = coupling_of(stiffness)
    if point["what"] == "cut":
        found = sudden(method, stiffness, speed)
    else:
        found = spin(method, coupling, speed, angle=angle)
    return {
        "ticks": found.ticks,
        "environment": found.environment,
        "created": found.created,
        "slack_share": found.slack_share,
        "first_active": found.first_active,
        "largest_angle": found.largest_angle,
        "crossed": found.crossed,
        "torque_jump": found.torque_jump,
    }
