"""Writes the convex meshes of the scenes: the ``vertex`` of each mesh in ``models/NAME/NAME.xml``.

    python scripts/make_meshes.py [DIR]

DIR is the folder that holds one folder per scene, by default the repository's ``models/``. What
cannot be a box, a cylinder or a ball is a convex mesh of a few corners, and they follow from the
sizes below, in m, in the axes of the geom that uses the mesh. MuJoCo takes the hull of the corners,
so there are no faces. Sources of the sizes stand in the scenes' files.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]
Point: TypeAlias = tuple[float, float, float]
Row: TypeAlias = list[Point]


def round_peg_sector() -> list[Row]:
    """A twelfth of a round hole: x from the wall outwards, y along it, z up from the mouth.

    It is as wide as a sector 11 mm from the hole's axis, so that the hole stays closed while the
    sectors move apart to 1 mm of clearance.
    """
    radius, tangent = 0.011, np.tan(np.pi / 12)
    depth, chamfer, thickness = 0.040, 0.001, 0.020
    places = [
        (0.0, -depth),
        (0.0, -chamfer),
        (chamfer, 0.0),
        (thickness, 0.0),
        (thickness, -depth),
    ]
    return [[(x, side * (radius + x) * tangent, z) for side in (-1, 1)] for x, z in places]


def hex_key_sector() -> list[Row]:
    """A sixth of a socket head: a wall of the socket, its chamfer, and the head behind them."""
    wall, chamfer, depth = 0.0101 / 2, 0.0005, 0.006
    head, bevel = 0.018 / 2, 0.0005
    tangent = np.tan(np.pi / 6)
    inside = [
        (x, side * x * tangent, z)
        for x, z in ((wall, -depth), (wall, -chamfer), (wall + chamfer, 0.0))
        for side in (-1, 1)
    ]
    angles = np.radians([-30, -15, 0, 15, 30])
    return [
        inside,
        *(arc(radius, angles, z) for radius, z in
          ((head, -depth), (head, -bevel), (head - bevel, 0.0))),
    ]  # fmt: skip


ARM, HEAD_RADIUS, TOP_RADIUS = 0.0024 / 2, 0.006, 0.0046
RECESS, RIM = 0.0031, 0.0012
"""Sizes of the M6 cross-recessed head: half an arm's width; radius below the rim and on top; depth
of the recess, and of the rim's edge below the top."""


def quarter() -> list[Row]:
    """A quarter of a pan head between two arms of its recess: bottom, rim, top."""
    rows = []
    for radius, z in ((HEAD_RADIUS, -RECESS), (HEAD_RADIUS, -RIM), (TOP_RADIUS, 0.0)):
        beside = np.arcsin(ARM / radius)
        angles = np.linspace(beside, np.pi / 2 - beside, 4)
        rows.append([(ARM, ARM, z), *arc(radius, angles, z)])
    return rows


def arm_end() -> list[Row]:
    """The part that closes an arm of the recess; its wall leans outwards by 26.6 degrees."""
    bottom, top = 0.0019, 0.00345
    outer, upper = (np.sqrt(radius**2 - ARM**2) for radius in (HEAD_RADIUS, TOP_RADIUS))
    profile = [(top, 0.0), (bottom, -RECESS), (outer, -RECESS), (outer, -RIM), (upper, 0.0)]
    return [[(x, y, z) for x, z in profile] for y in (-ARM, ARM)]


def wings() -> list[Row]:
    """Two opposite wings of the screwdriver's tip, which are only drawn: 2.2 mm thick."""
    half = 0.0011
    levels = ((0.0016, -0.0031), (0.0033, -0.0001), (0.0039, 0.0025), (0.0026, 0.0045))
    return [[(x, y, z) for x in (-long, long) for y in (-half, half)] for long, z in levels]


def lock_plug() -> list[Row]:
    """The plug on the side of its slot that meets the drivers: a disc cut off at the slot's wall.

    It ends 125 degrees from the top, below the lowest driver's way. 26 facets lie within 5 µm of
    the round.
    """
    radius, wall, last = 0.0127 / 2, 0.0015, np.radians(125)
    angles = np.linspace(np.arcsin(wall / radius), last, 27)
    outline = [(-radius * np.sin(angle), radius * np.cos(angle)) for angle in angles]
    outline.append((-wall, outline[-1][1]))
    points = [[(x, y, z) for y, z in outline] for x in (-0.017, -0.003)]
    return [row[i : i + 4] for row in points for i in range(0, len(row), 4)]


def arc(radius: float, angles: Array, z: float) -> Row:
    """Returns points on a circle about the z axis."""
    return [(radius * np.cos(angle), radius * np.sin(angle), z) for angle in angles]


MESHES: dict[tuple[str, str], Callable[[], list[Row]]] = {
    ("round_peg", "sector"): round_peg_sector,
    ("hex_key", "sector"): hex_key_sector,
    ("screwdriver", "quarter"): quarter,
    ("screwdriver", "arm_end"): arm_end,
    ("screwdriver", "wings"): wings,
    ("lock", "plug"): lock_plug,
}
"""Function that makes each mesh, by scene and name."""


def vertices(rows: Iterable[Row]) -> str:
    """Returns the corners as MJCF writes them, to a hundredth of a micrometre."""
    lines = (
        "    ".join(" ".join(f"{round(float(v), 8) + 0.0:.8g}" for v in point) for point in row)
        for row in rows
    )
    return "".join(f"\n      {line}" for line in lines)


def main(arguments: list[str] | None = None) -> int:
    """Writes all meshes; returns the exit code (2 if a scene or one of its meshes is missing)."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument(
        "directory",
        type=Path,
        nargs="?",
        default=Path(__file__).resolve().parent.parent / "models",
        help="folder that holds one folder per scene (default: the repository's models/)",
    )
    directory: Path = parser.parse_args(arguments).directory
    for (scene, mesh), make in MESHES.items():
        file = directory / scene / f"{scene}.xml"
        try:
            text = file.read_text(encoding="utf-8")
        except (OSError, ValueError) as error:
            print(f"cannot read '{file}': {error}", file=sys.stderr)
            return 2
        before, *after = re.split(rf'(?<=<mesh name="{mesh}" vertex=")[^"]*', text)
        if len(after) != 1:
            print(f"'{file}' must have one mesh '{mesh}'; it has {len(after)}", file=sys.stderr)
            return 2
        file.write_text(before + vertices(make()) + after[0], encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
