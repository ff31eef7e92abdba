"""Writes the scripted hand paths of the scenes: ``models/NAME/NAME.csv``, and of further hands.

    python scripts/make_hand_paths.py [DIR]

DIR is the folder that holds one folder per scene, by default the repository's ``models/``. Each
file has the columns ``t,x,y,z,qw,qx,qy,qz`` in s and m, one row each 10 ms for 8 s, starts at zero
and at the identity, and ends there at rest: position and orientation are meant relative to the
handle's start. The files depend on nothing but this script (no clock, no global random state).

A path is what a hand does when it reaches, holds and corrects:

- **Reaching** is a sum of minimum-jerk movements, each with its own start and duration; two that
  overlap blend into one curved movement without a stop (Flash & Hogan 1985; Flash & Henis 1991).
- **Wander** is the slow drift of a held hand: 0.3 to 2 Hz, 0.06 mm and 1.5 mrad (RMS per axis).
- **Tremor** is physiological tremor: 8 to 12 Hz, 0.02 mm and 0.3 mrad (RMS per axis), the order of
  magnitude that is reported for a steady, healthy hand.

Wander and tremor are sums of sines with random phases from a local seed, faded in and out.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]

ROW_INTERVAL = 0.01
"""Time between rows, in s. Readers interpolate linearly, so tremor needs ten rows a period."""

DURATION = 8.0
"""Length of every path, in s."""

FADE = 0.5
"""Wander and tremor grow over this time at the start and vanish over it at the end, in s."""

WANDER_BAND = (0.3, 2.0, 0.06e-3, 1.5e-3)
TREMOR_BAND = (8.0, 12.0, 0.02e-3, 0.3e-3)
"""Lowest and highest frequency in Hz, RMS of each position axis in m, of each angle in rad."""

SINES_PER_BAND = 8

SWING, TURN_ROUND = 0.2, 0.11
"""Duration of a blow's movement down, and start of the movement up within it, in s."""


@dataclass(frozen=True, slots=True)
class Reach:
    """One minimum-jerk movement.

    Attributes:
        start: Start in s.
        duration: Duration in s.
        millimetres: Change of the position in mm.
        degrees: Change of the rotation vector in degrees.
    """

    start: float
    duration: float
    millimetres: tuple[float, float, float] = (0.0, 0.0, 0.0)
    degrees: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class HandPath:
    """Recipe of one scene's path.

    Attributes:
        motion: Returns position in m and rotation vector in rad, shape (n, 6), at times in s.
        axes: Axes among x, y, z and the rotation vector's three components that the hand moves.
        seed: Seed of wander and tremor.
    """

    motion: Callable[[Array], Array]
    axes: tuple[int, int, int, int, int, int]
    seed: int


def minimum_jerk(phase: Array) -> Array:
    """Returns the minimum-jerk profile 10 s³ − 15 s⁴ + 6 s⁵, 0 before s = 0 and 1 after s = 1."""
    s = np.clip(phase, 0.0, 1.0)
    return s**3 * (10.0 - 15.0 * s + 6.0 * s**2)


def reaching(*reaches: Reach) -> Callable[[Array], Array]:
    """Returns the motion that is the sum of the movements (see ``HandPath.motion``)."""

    def motion(times: Array) -> Array:
        total = np.zeros((len(times), 6))
        for reach in reaches:
            change = np.array([*reach.millimetres, *reach.degrees])
            change *= np.array([1e-3] * 3 + [np.pi / 180.0] * 3)
            total += np.outer(minimum_jerk((times - reach.start) / reach.duration), change)
        return total

    return motion


def swinging(lever: float, *reaches: Reach) -> Callable[[Array], Array]:
    """Returns the motion of a handle that turns about an upright axis beside it.

    Args:
        lever: Distance from the axis to the handle's start along x, in m.
        reaches: Movements of the hand. The angle about z swings the position along, x points away
            from the axis, the rest stays unchanged.
    """
    turning = reaching(*reaches)

    def motion(times: Array) -> Array:
        total = turning(times)
        angle, radius = total[:, 5], lever + total[:, 0]
        total[:, 0] = radius * np.cos(angle) - lever
        total[:, 1] += radius * np.sin(angle)
        return total

    return motion


def blows(first: float, interval: float, depths: tuple[float, ...]) -> tuple[Reach, ...]:
    """Returns blows straight down, each from 30 mm above the start and back to there.

    Down and up overlap, so that the hand reverses at speed, as a wrist does when it strikes.

    Args:
        first: Start of the first swing in s.
        interval: Time from one swing to the next, in s.
        depths: Depths below the start that the hand would reach without reversal, in mm.
    """
    lift = 30.0
    reaches = [Reach(first - 0.6, 0.6, (0, 0, lift))]
    for k, depth in enumerate(depths):
        start = first + k * interval
        reaches.append(Reach(start, SWING, (0, 0, -lift - depth)))
        reaches.append(Reach(start + TURN_ROUND, SWING, (0, 0, lift + depth)))
    reaches.append(Reach(first + len(depths) * interval, 0.6, (0, 0, -lift)))
    return tuple(reaches)


def figure_eight(times: Array) -> Array:
    """Returns two rounds of a lying eight, 80 by 40 mm, turning by up to 40 and 25 degrees."""
    angle = 4.0 * np.pi * minimum_jerk((times - 0.3) / (DURATION - 0.6))
    zero = np.zeros_like(angle)
    millimetres = [40.0 * np.sin(angle), 20.0 * np.sin(2.0 * angle), 10.0 * np.sin(angle)]
    degrees = [25.0 * np.sin(2.0 * angle), zero, 40.0 * np.sin(angle)]
    return np.stack(
        [1e-3 * column for column in millimetres] + [np.radians(column) for column in degrees],
        axis=1,
    )


def unsteadiness(times: Array, seed: int) -> Array:
    """Returns wander and tremor, shape (n, 6), in m and rad; zero at both ends."""
    generator = np.random.default_rng(seed)
    total = np.zeros((len(times), 6))
    for lowest, highest, length, angle in (WANDER_BAND, TREMOR_BAND):
        # n sines of amplitude a have the RMS a sqrt(n / 2)
        amplitude = np.array([length] * 3 + [angle] * 3) * np.sqrt(2.0 / SINES_PER_BAND)
        for axis in range(6):
            frequencies = generator.uniform(lowest, highest, SINES_PER_BAND)
            phases = generator.uniform(0.0, 2.0 * np.pi, SINES_PER_BAND)
            sines = np.sin(2.0 * np.pi * np.outer(times, frequencies) + phases)
            total[:, axis] += amplitude[axis] * sines.sum(axis=1)
    fade = minimum_jerk(times / FADE) * minimum_jerk((DURATION - times) / FADE)
    return total * fade[:, np.newaxis]


def quaternions(rotation_vectors: Array) -> Array:
    """Returns the unit quaternions (w, x, y, z) of rotation vectors below π, shape (n, 4)."""
    half = 0.5 * np.linalg.norm(rotation_vectors, axis=1, keepdims=True)
    # numpy's sinc(x) is sin(πx)/(πx)
    return np.hstack([np.cos(half), 0.5 * np.sinc(half / np.pi) * rotation_vectors])


def table(path: HandPath) -> Array:
    """Returns the rows ``t, x, y, z, qw, qx, qy, qz`` of one path, shape (n, 8)."""
    times: Array = ROW_INTERVAL * np.arange(round(DURATION / ROW_INTERVAL) + 1, dtype=np.float64)
    pose = (path.motion(times) + unsteadiness(times, path.seed)) * np.array(path.axes)
    return np.column_stack([times, pose[:, :3], quaternions(pose[:, 3:])])


def write_csv(file: Path, rows: Array) -> None:
    """Writes one path: 10 nm and 2e-10 in a quaternion are far below any device's resolution."""
    # adding 0.0 turns a rounded −0 into 0
    lines = [
        f"{row[0]:.2f},"
        + ",".join(f"{np.round(value, 8) + 0.0:.8f}" for value in row[1:4])
        + ","
        + ",".join(f"{np.round(value, 10) + 0.0:.10f}" for value in row[4:])
        for row in rows
    ]
    file.write_text("\n".join(["t,x,y,z,qw,qx,qy,qz", *lines]) + "\n", encoding="utf-8")


PATHS = {
    # Touch the wall, which begins 10 mm away, press to 3 mm behind it (7 N at 2400 N/m), hold,
    # let go, then tap three times.
    "virtual_wall": HandPath(
        reaching(
            Reach(0.3, 1.0, (10.3, 0, 0)),
            Reach(1.4, 0.8, (2.7, 0, 0)),
            Reach(3.4, 0.8, (-8.0, 0, 0)),
            Reach(4.4, 0.3, (6.5, 0, 0)),
            Reach(4.75, 0.3, (-6.5, 0, 0)),
            Reach(5.2, 0.25, (6.8, 0, 0)),
            Reach(5.5, 0.25, (-6.8, 0, 0)),
            Reach(5.9, 0.2, (7.0, 0, 0)),
            Reach(6.15, 0.3, (-7.0, 0, 0)),
            Reach(6.7, 0.9, (-5.0, 0, 0)),
        ),
        axes=(1, 1, 1, 0, 0, 0),
        seed=1,
    ),
    "point_mass": HandPath(figure_eight, axes=(1, 1, 1, 1, 1, 1), seed=2),
    # The paths of the pegs: come down tilted and off centre, so that one corner of the peg's end is
    # the lowest and enters the hole whatever the error; push that corner against the hole's walls;
    # go down by 0.6 mm, no further: a peg of width w is wider across when it stands l deep and
    # tilted, by l²/2w, and would not straighten in a clearance below l²/4w; straighten; go down to
    # 3 mm above the bottom; push against a wall; wiggle; press on the bottom; withdraw.
    "planar_peg": HandPath(
        reaching(
            Reach(0.3, 1.0, (0.4, 0, -10.2), (0, 3.0, 0)),
            Reach(1.5, 0.6, (1.6, 0, 0)),
            Reach(2.1, 0.5, (0, 0, -0.6)),
            Reach(2.6, 0.7, (-1.8, 0, 0), (0, -3.0, 0)),
            Reach(3.3, 1.2, (-0.2, 0, -36.2)),
            Reach(4.6, 0.5, (2.4, 0, 0)),
            Reach(5.2, 0.4, (-4.4, 0, 0), (0, 2.5, 0)),
            Reach(5.5, 0.4, (3.4, 0, 0), (0, -5.0, 0)),
            Reach(5.8, 0.5, (-1.4, 0, 0), (0, 2.5, 0)),
            Reach(6.1, 0.5, (0, 0, -4.5)),
            Reach(6.7, 1.0, (0, 0, 51.5)),
        ),
        axes=(1, 0, 1, 0, 1, 0),
        seed=3,
    ),
    "peg_in_hole": HandPath(
        reaching(
            Reach(0.3, 1.0, (0.4, -0.3, -10.0), (-2.5, 2.5, 1.0)),
            Reach(1.5, 0.6, (1.6, 2.1, 0)),
            Reach(2.1, 0.5, (0, 0, -0.6)),
            Reach(2.6, 0.7, (-1.8, -1.6, 0), (2.5, -2.5, -1.0)),
            Reach(3.3, 1.2, (-0.2, -0.2, -36.8)),
            Reach(4.6, 0.5, (2.4, 0, 0)),
            Reach(5.2, 0.4, (-2.4, -2.0, 0), (2.0, 0, 0)),
            Reach(5.5, 0.4, (-1.5, 3.5, 0), (-2.0, 2.5, 2.0)),
            Reach(5.8, 0.5, (1.5, -1.5, 0), (0, -2.5, -2.0)),
            Reach(6.1, 0.5, (0, 0, -4.2)),
            Reach(6.7, 1.0, (0, 0, 51.6)),
        ),
        axes=(1, 1, 1, 1, 1, 1),
        seed=4,
    ),
    # As the square peg's, but it need not be turned to fit; it lands on the chamfer 0.7 mm off
    # centre and slides in along it, and the wiggle goes round the hole.
    "round_peg": HandPath(
        reaching(
            Reach(0.3, 1.2, (0.7, -0.3, -10.6), (-1.5, 2.0, 0)),
            Reach(1.7, 0.7, (0, 0, -1.9)),
            Reach(2.5, 0.7, (-0.7, 0.3, 0), (1.5, -2.0, 0)),
            Reach(3.3, 1.2, (0, 0, -34.5)),
            Reach(4.6, 0.5, (2.2, 0, 0), (0, 0, 10.0)),
            Reach(5.2, 0.4, (-2.2, -2.0, 0), (2.0, 0, 0)),
            Reach(5.5, 0.4, (-1.5, 3.5, 0), (-2.0, 2.5, 10.0)),
            Reach(5.8, 0.5, (1.5, -1.5, 0), (0, -2.5, -20.0)),
            Reach(6.1, 0.5, (0, 0, -4.6)),
            Reach(6.7, 1.0, (0, 0, 51.6)),
        ),
        axes=(1, 1, 1, 1, 1, 1),
        seed=5,
    ),
    # Press the closed drawer home, pull it open to 3.5 mm beyond the stop (8 N at K = 2400 N/m; a
    # hand of 2000 N/m still presses with 1 N there, after friction took 2.9 N),
    # hold, push it closed again.
    "drawer": HandPath(
        reaching(
            Reach(0.4, 0.6, (-4.5, 0, 0)),
            Reach(1.2, 0.8, (6.5, 0, 0)),
            Reach(2.0, 1.6, (201.5, 0, 0)),
            Reach(4.6, 1.8, (-208.0, 0, 0)),
            Reach(6.8, 0.8, (4.5, 0, 0)),
        ),
        axes=(1, 1, 1, 1, 1, 1),
        seed=5,
    ),
    # Lift the hammer, seven blows, each 1 mm deeper than the one before, and put it back.
    "hammer": HandPath(
        reaching(*blows(1.2, 0.8, (24.5, 25.55, 26.6, 27.65, 28.7, 29.75, 30.8))),
        axes=(1, 1, 1, 1, 1, 1),
        seed=6,
    ),
    # Twice: back over the teeth by 50 degrees, forward by 50 degrees with the gear.
    "ratchet": HandPath(
        swinging(
            0.1,
            Reach(0.4, 1.5, degrees=(0, 0, 50.0)),
            Reach(2.2, 1.5, degrees=(0, 0, -50.0)),
            Reach(4.1, 1.5, degrees=(0, 0, 50.0)),
            Reach(5.9, 1.5, degrees=(0, 0, -50.0)),
        ),
        axes=(1, 1, 1, 1, 1, 1),
        seed=7,
    ),
    # Turn the nut by a sixth of a turn, pull the wrench off, swing back, seat it on the next flats.
    "open_wrench": HandPath(
        swinging(
            0.1,
            Reach(0.3, 2.1, degrees=(0, 0, 62.0)),
            Reach(2.45, 0.4, degrees=(0, 0, -1.5)),
            Reach(2.8, 0.7, (24.0, 0, 0)),
            Reach(3.5, 1.6, degrees=(0, 0, -60.5)),
            Reach(5.6, 1.7, (-24.0, 0, 0)),
        ),
        axes=(1, 1, 0, 0, 0, 1),
        seed=8,
    ),
    # Close the pliers until the wire is just not touched, hold, crush it, hold, let go; close them
    # again, less far: they meet the wire later than before.
    "bench_pliers": HandPath(
        swinging(
            0.1,
            Reach(0.4, 1.2, degrees=(0, 0, -5.3)),
            Reach(2.2, 1.6, degrees=(0, 0, -4.2)),
            Reach(4.4, 1.1, degrees=(0, 0, 9.5)),
            Reach(5.6, 0.9, degrees=(0, 0, -8.5)),
            Reach(6.9, 0.9, degrees=(0, 0, 8.5)),
        ),
        axes=(1, 1, 1, 1, 1, 1),
        seed=9,
    ),
    # Push the key in past three pins, on to 1 mm beyond its shoulder (2.4 N), turn it by 92
    # degrees, hold it at the stop, turn it back, pull it out.
    "lock": HandPath(
        reaching(
            Reach(0.4, 2.2, (-17.0, 0, 0)),
            Reach(2.9, 1.4, degrees=(-92.0, 0, 0)),
            Reach(4.8, 1.2, degrees=(92.0, 0, 0)),
            Reach(6.1, 1.6, (17.0, 0, 0)),
        ),
        axes=(1, 1, 1, 1, 1, 1),
        seed=10,
    ),
    # Press the tip into the recess and turn by a quarter; lift it out, turn back, seat it on the
    # next arms; turn the second quarter, lift, turn back and seat it again.
    "screwdriver": HandPath(
        reaching(
            Reach(0.2, 0.5, (0, 0, -1.6)),
            Reach(0.6, 1.7, degrees=(0, 0, 93.1)),
            Reach(2.3, 0.3, degrees=(0, 0, -3.1)),
            Reach(2.5, 0.5, (0, 0, 6.6)),
            Reach(2.9, 1.1, degrees=(0, 0, -90.0)),
            Reach(3.9, 0.5, (0, 0, -6.4)),
            Reach(4.3, 1.6, degrees=(0, 0, 93.0)),
            Reach(5.9, 0.3, degrees=(0, 0, -3.0)),
            Reach(6.1, 0.5, (0, 0, 6.6)),
            Reach(6.5, 1.0, degrees=(0, 0, -90.0)),
            Reach(7.4, 0.5, (0, 0, -5.2)),
        ),
        axes=(1, 1, 1, 1, 1, 1),
        seed=9,
    ),
    # Turn the screw by a sixth of a turn; lift the key out bend first, or a soft hand would not get
    # it out before it swings back; seat it on the next flats; the same again.
    "hex_key": HandPath(
        swinging(
            0.06,
            Reach(0.2, 0.5, (0, 0, -1.0)),
            Reach(0.6, 1.7, degrees=(0, 0, 63.0)),
            Reach(2.3, 0.3, degrees=(-1.6, 2.7, -3.0)),
            Reach(2.5, 0.5, (0, 0, 9.0)),
            Reach(2.9, 1.1, degrees=(1.6, -2.7, -60.0)),
            Reach(3.9, 0.5, (0, 0, -8.7)),
            Reach(4.3, 1.6, degrees=(0, 0, 63.0)),
            Reach(5.9, 0.3, degrees=(-1.6, 2.7, -3.0)),
            Reach(6.1, 0.5, (0, 0, 9.0)),
            Reach(6.5, 1.0, degrees=(1.6, -2.7, -60.0)),
            Reach(7.4, 0.5, (0, 0, -8.3)),
        ),
        axes=(1, 1, 1, 1, 1, 1),
        seed=10,
    ),
    # Dip the stick into the beads, stir twice round the bowl, hold, lift it out.
    "beads": HandPath(
        reaching(
            Reach(0.5, 1.1, (0, 0, -45.0)),
            Reach(1.6, 0.6, (20.0, 0, 0)),
            *(
                Reach(2.0 + 0.45 * quarter, 0.9, (20.0 * x, 20.0 * y, 0))
                for quarter, (x, y) in enumerate(2 * ((-1, 1), (-1, -1), (1, -1), (1, 1)))
            ),
            Reach(6.1, 0.5, (-20.0, 0, 0)),
            Reach(6.7, 1.1, (0, 0, 45.0)),
        ),
        axes=(1, 1, 1, 1, 1, 1),
        seed=11,
    ),
    # Lift the pliers, hold them still while the fingers work, and put them back.
    "pliers": HandPath(
        reaching(
            Reach(0.1, 0.9, (0, 0, 15.0), degrees=(0, 8.0, 0)),
            Reach(7.0, 0.9, (0, 0, -15.0), degrees=(0, -8.0, 0)),
        ),
        axes=(1, 1, 1, 1, 1, 1),
        seed=12,
    ),
    # The fingers, along x: close until the wire is just not touched, hold, crush it, hold, let go;
    # close again, less far.
    "pliers/pliers_hinge": HandPath(
        reaching(
            Reach(1.0, 1.0, (11.0, 0, 0)),
            Reach(2.4, 1.4, (11.0, 0, 0)),
            Reach(4.4, 1.0, (-22.0, 0, 0)),
            Reach(5.5, 0.8, (19.0, 0, 0)),
            Reach(6.5, 0.8, (-19.0, 0, 0)),
        ),
        axes=(1, 0, 0, 0, 0, 0),
        seed=13,
    ),
    # Turn the nut, lift the spanner off, turn it back, put it on again; then once more.
    "nut_and_wrench/nut_and_wrench_wrench": HandPath(
        swinging(
            0.1,
            Reach(0.2, 1.4, degrees=(0, 0, 67.0)),
            Reach(1.7, 0.3, degrees=(0, 0, -7.0)),
            Reach(2.1, 0.5, (0, 0, 16.0)),
            Reach(2.6, 0.7, degrees=(0, 0, -60.0)),
            Reach(3.3, 0.5, (0, 0, -16.0)),
            Reach(3.9, 1.4, degrees=(0, 0, 67.0)),
            Reach(5.4, 0.3, degrees=(0, 0, -7.0)),
            Reach(5.8, 0.5, (0, 0, 16.0)),
            Reach(6.3, 0.8, degrees=(0, 0, -60.0)),
            Reach(7.1, 0.6, (0, 0, -16.0)),
        ),
        axes=(1, 1, 1, 1, 1, 1),
        seed=14,
    ),
    # Hold the bolt.
    "nut_and_wrench/nut_and_wrench_bolt": HandPath(
        reaching(Reach(0.0, 1.0)), axes=(1, 1, 1, 1, 1, 1), seed=15
    ),
    # Push the plug in, let it snap, pull it out.
    "plug_and_socket/plug_and_socket_plug": HandPath(
        reaching(
            Reach(0.4, 2.4, (0, 0, -21.0)),
            Reach(4.0, 2.4, (0, 0, 21.0)),
        ),
        axes=(1, 1, 1, 1, 1, 1),
        seed=16,
    ),
    # Bring the socket, hold it against the plug, take it away.
    "plug_and_socket/plug_and_socket_socket": HandPath(
        reaching(
            Reach(0.3, 2.4, (0, 0, 13.0)),
            Reach(4.2, 2.4, (0, 0, -13.0)),
        ),
        axes=(1, 1, 1, 1, 1, 1),
        seed=17,
    ),
}
"""The path of every scene, or as ``SCENE/FILE`` that of a further hand or of the fingers. Each
reaching motion adds up to zero, so that the hand ends where it began."""


def main(arguments: list[str] | None = None) -> int:
    """Writes all paths; returns the exit code (2 if a scene's folder does not exist)."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument(
        "directory",
        type=Path,
        nargs="?",
        default=Path(__file__).resolve().parent.parent / "models",
        help="folder that holds one folder per scene (default: the repository's models/)",
    )
    directory: Path = parser.parse_args(arguments).directory
    for name, path in PATHS.items():
        scene, _, file = name.rpartition("/")
        folder = directory / (scene or file)
        if not folder.is_dir():
            print(
                f"no folder '{folder}' for the scene's hand path; create it first", file=sys.stderr
            )
            return 2
        write_csv(folder / f"{file}.csv", table(path))
    return 0


if __name__ == "__main__":
    sys.exit(main())
