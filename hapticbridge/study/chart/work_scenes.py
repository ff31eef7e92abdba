"""Scenes that grow in one way at a time: bodies, contacts, triangles, and bodies that rest."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hapticbridge.errors import StudyError
from hapticbridge.scene import Scene
from hapticbridge.study.maps.rigs import scene_of

SPACING = 0.05
"""Between the bodies of a scene in m: none touches its neighbour."""

FOOT = 2e-3
"""Radius in m of the balls that a plate stands on, one contact each."""

BALL = 0.01
"""Radius in m of a ball, and half the edge of a box."""

MOST = 200_000
"""Triangles at most: more take MuJoCo minutes to compile."""

_FRAME = """
<mujoco model="{name}">
  <option gravity="0 0 {gravity}" cone="elliptic"><flag diagexact="enable"/></option>
  <default>
    <geom solref="0.002 1" solimp="0.9 0.95 0.001 0.5 2" friction="0.4 0 0" condim="3"/>
  </default>
  {assets}
  <worldbody>
    {bodies}
  </worldbody>
</mujoco>"""


@dataclass(frozen=True, slots=True)
class Family:
    """Scenes that differ in one count.

    Attributes:
        name: In tables.
        unit: What is counted.
        about: What the scenes are, in a sentence.
        sizes: The counts.
        build: Returns the scene of a count.
    """

    name: str
    unit: str
    about: str
    sizes: tuple[int, ...]
    build: Callable[[int], Scene]


def floating(count: int) -> Scene:
    """Returns ``count`` free balls, the tool among them, that touch nothing."""
    return _scene("bodies", _tool_ball() + _others(count - 1, _ball), gravity=0.0)


def plate(count: int) -> Scene:
    """Returns a tool that stands on ``count`` feet, as near to a square as they divide."""
    _check(count, 100_000)
    # a full rectangle: a body that stands on one side of itself would tilt
    rows = max(n for n in range(1, int(count**0.5) + 1) if count % n == 0)
    columns = count // rows
    feet = "".join(
        f'<geom type="sphere" size="{FOOT}" mass="0" pos="{x} {y} 0"/>'
        for x in 3 * FOOT * (np.arange(columns) - (columns - 1) / 2)
        for y in 3 * FOOT * (np.arange(rows) - (rows - 1) / 2)
    )
    tool = (
        f'<body name="tool" pos="0 0 {FOOT}"><freejoint/>'
        f'<inertial pos="0 0 0" mass="0.1" diaginertia="1e-4 1e-4 1e-4"/>{feet}'
        '<site name="grip"/></body>'
    )
    return _scene("contacts", _FLOOR + tool)


def mesh_ball(count: int) -> Scene:
    """Returns a tool that is a convex mesh of about ``count`` triangles on a box."""
    _check(count, MOST)
    points = " ".join(f"{value:.6g}" for value in (BALL * sphere(count // 2 + 2)).ravel())
    assets = f'<asset><mesh name="ball" vertex="{points}"/></asset>'
    tool = (
        f'<body name="tool" pos="0 0 {BALL}"><freejoint/>'
        '<geom type="mesh" mesh="ball" mass="0.1"/><site name="grip"/></body>'
    )
    floor = '<geom type="box" size="1 1 0.1" pos="0 0 -0.1"/>'
    return _scene("triangles", floor + tool, assets=assets)


def resting(count: int) -> Scene:
    """Returns a free tool beside ``count`` boxes that rest on the floor, four contacts each."""
    return _scene("resting", _FLOOR + _tool_ball(0.3) + _others(count, _box))


def sphere(count: int) -> NDArray[np.float64]:
    """Returns points spread evenly on the unit sphere (Fibonacci's lattice), shape (count, 3).

    Their convex hull has 2 count − 4 triangles.
    """
    index = np.arange(count) + 0.5
    height, angle = 1 - 2 * index / count, np.pi * (1 + 5**0.5) * index
    ring = np.sqrt(1 - height**2)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=-1)


FAMILIES = (
    Family(
        "bodies",
        "free bodies",
        "free balls that touch nothing",
        (1, 2, 5, 10, 20, 50, 100, 200),
        floating,
    ),
    Family(
        "contacts",
        "contacts",
        "one body that stands on many feet",
        (1, 3, 10, 30, 100, 200, 500),
        plate,
    ),
    Family(
        "triangles",
        "triangles",
        "a ball that is a convex mesh, on a box",
        (12, 100, 1000, 10_000, 100_000),
        mesh_ball,
    ),
    Family(
        "resting",
        "boxes at rest",
        "on the floor, four contacts each",
        (1, 3, 10, 30, 100),
        resting,
    ),
)

_FLOOR = '<geom name="floor" type="plane" size="20 20 1"/>'


def _scene(name: str, bodies: str, *, gravity: float = -9.81, assets: str = "") -> Scene:
    return scene_of(_FRAME.format(name=name, gravity=gravity, assets=assets, bodies=bodies))


def _tool_ball(height: float = 0.0) -> str:
    return (
        f'<body name="tool" pos="0 0 {height}" gravcomp="1"><freejoint/>'
        f'<geom type="sphere" size="{BALL}" mass="0.1"/><site name="grip"/></body>'
    )


def _others(count: int, body: Callable[[float, float], str]) -> str:
    _check(count + 1, 10_000)
    side = int(np.ceil(np.sqrt(max(count, 1))))
    return "".join(body(SPACING * (1 + i % side), SPACING * (1 + i // side)) for i in range(count))


def _ball(x: float, y: float) -> str:
    return (
        f'<body pos="{x} {y} 0"><freejoint/><geom type="sphere" size="{BALL}" mass="0.1"/></body>'
    )


def _box(x: float, y: float) -> str:
    return (
        f'<body pos="{x} {y} {BALL}"><freejoint/>'
        f'<geom type="box" size="{BALL} {BALL} {BALL}" mass="0.1"/></body>'
    )


def _check(count: int, most: int) -> None:
    if not 1 <= count <= most:
        raise StudyError(f"a scene of {count} is asked for; it must be 1 to {most}")
