"""A scene from outside models/ in which nothing is wrong, and what can be planted in it."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from outside_scenes import hand_rows

from hapticbridge.check.case import IntendedUse, SceneUnderCheck, open_case
from hapticbridge.check.findings import find_faults
from hapticbridge.scene import read_scene, scene_path
from hapticbridge.scene.fault import Fault

MAIN = """<mujoco model="bench">
  <compiler angle="radian" meshdir="meshes"/>
  <option timestep="0.001" integrator="discrete" solver="Newton" iterations="100" cone="elliptic">
    <flag diagexact="enable"/>
  </option>
  <default>
    <geom condim="3" friction="0.3 0 0" solref="0.002 1" solimp="0.9 0.95 0.001"/>
  </default>
  <asset>
    <mesh name="wedge" file="wedge.obj"/>
  </asset>
  <worldbody>
    <geom name="floor" type="box" size="0.2 0.2 0.01" pos="0 0 -0.01"/>
    <geom name="stop" type="mesh" mesh="wedge" pos="0.06 0 0"/>
    <body name="tool" pos="0 0 0.03" gravcomp="1">
      <freejoint name="tool"/>
      <geom name="shaft" type="box" size="0.01 0.01 0.02" mass="0.5"/>
      <geom name="cap" type="sphere" size="0.008" pos="0 0 0.03" mass="0"
        contype="0" conaffinity="0"/>
      <site name="grip"/>
    </body>
  </worldbody>
  <include file="parts.xml"/>
  <!-- keys -->
</mujoco>
"""

PARTS = """<mujoco>
  <worldbody>
    <body name="button" pos="-0.06 0 0.03">
      <joint name="button" type="slide" axis="0 0 1" range="-0.01 0" limited="true" stiffness="100"
        damping="1" solreflimit="0.002 1" solimplimit="0.9 0.95 0.001"/>
      <geom name="button" type="cylinder" size="0.01 0.005" mass="0.05"/>
    </body>
    <body name="slider" pos="-0.1 0.1 0.05" gravcomp="1">
      <joint name="slider" type="slide" axis="1 0 0" frictionloss="1"
        solreffriction="0.002 1" solimpfriction="0.999 0.999 0.001"/>
      <geom type="box" size="0.01 0.01 0.01" mass="0.1"/>
    </body>
    <body name="block" pos="0.1 0.1 0.02">
      <freejoint name="block"/>
      <geom name="block" type="box" size="0.02 0.02 0.02" mass="0.2"/>
    </body>
  </worldbody>
  <equality>
    <joint name="link" joint1="slider" joint2="button"
      active="false" solref="0.002 1" solimp="0.9 0.95 0.001"/>
  </equality>
</mujoco>
"""

START = "0 0 0.03 1 0 0 0  0  0  0.1 0.1 0.02 1 0 0 0"
STOPS = [(0.3, (0, 0, -0.012)), (0.2, (0, 0, 0.01)), (0.3, (-0.06, 0, 0.02)),
         (0.2, (-0.06, 0, 0.012)), (0.2, (-0.06, 0, 0.02))]  # fmt: skip
"""The hand: onto the floor, up, over to the button, onto it, and off."""


@dataclass(frozen=True)
class Plant:
    """A fault: what it is called, what is written instead of what, and at which words it is named.

    ``at`` is a word of the line that must be named, ``None`` for the line that was changed.
    """

    kind: str
    old: str
    new: str
    at: str | None = None
    file: str = "bench.xml"


SMALL = 'size="0.01 0.01 0.01"'
FIRM, FRICTION = 'solreffriction="0.002 1"', 'solimpfriction="0.999 0.999 0.001"'

PLANTS = (
    Plant("time step", 'timestep="0.001"', 'timestep="0.002"'),
    Plant("solver iterations", 'iterations="100"', 'iterations="1"'),
    Plant("pyramidal cone", 'cone="elliptic"', 'cone="pyramidal"'),
    Plant("keyframe", "<!-- keys -->", f'<keyframe><key name="start" qpos="{START}"/></keyframe>'),
    Plant("heavy tool", 'pos="0 0 0.03" gravcomp="1"', 'pos="0 0 0.03"'),
    Plant("far grip", '<site name="grip"/>', '<site name="grip" pos="0 0 0.2"/>'),
    Plant("visual geom with mass", ' pos="0 0 0.03" mass="0"', ' pos="0 0 0.03"', at='name="cap"'),
    Plant("default contact", 'name="floor"', 'name="floor" priority="1" solref="0.02 1"'),
    Plant("not passive", 'name="stop"', 'name="stop" priority="2" solref="-100000 -10"'),
    Plant("mesh not convex", 'file="wedge.obj"', 'file="cup.obj"', at='name="stop"'),
    *(
        Plant(kind, old, new, at, "parts.xml")
        for kind, old, new, at in (
            ("density of water", f'{SMALL} mass="0.1"', SMALL, None),
            ("margin", 'type="cylinder"', 'type="cylinder" margin="0.001"', None),
            ("starts in contact", "0.1 0.1 0.02", "0.1 0.1 0.0195", 'geom name="block"'),
            ("missing inertia", ' mass="0.2"', ' mass="0"', 'body name="block"'),
            ("mass ratio", ' mass="0.05"', ' mass="0.00005"', 'body name="button"'),
            ("soft limit", 'mit="0.002 1"', 'mit="0.02 1"', 'joint name="button"'),
            ("creeping friction", f"{FIRM} {FRICTION}", "", 'joint name="slider"'),
            ("soft equality", 'active="false" solref="0.002 1"', 'active="true"', 'name="link"'),
        )
    ),
)
"""Each alone is found alone; all together are all found."""


def convex_obj() -> str:
    """A wedge: 20 mm long, 20 mm wide, 20 mm high."""
    corners = [(0, -1, 0), (2, -1, 0), (2, -1, 2), (0, 1, 0), (2, 1, 0), (2, 1, 2)]
    faces = [(1, 2, 3), (4, 6, 5), (1, 4, 5), (1, 5, 2), (2, 5, 6), (2, 6, 3), (3, 6, 4), (3, 4, 1)]
    return _obj(0.01 * np.array(corners, dtype=float), faces)


CUP_DEPTH, CUP_ROOM = 0.015, 0.016 * 0.016 * 0.015


def cup_obj() -> str:
    """A square cup: 20 mm wide and high, with walls of 2 mm and a hole of 16 x 16 x 15 mm."""
    outer = [(x, y, z) for z in (0, 20) for x, y in ((-10, -10), (10, -10), (10, 10), (-10, 10))]
    inner = [(x, y, z) for z in (5, 20) for x, y in ((-8, -8), (8, -8), (8, 8), (-8, 8))]
    faces = []

    def quad(a: int, b: int, c: int, d: int) -> None:
        faces.extend([(a, b, c), (a, c, d)])

    quad(4, 3, 2, 1)
    for k in range(4):
        n = (k + 1) % 4
        quad(1 + k, 1 + n, 5 + n, 5 + k)
        quad(9 + n, 9 + k, 13 + k, 13 + n)
        quad(5 + k, 5 + n, 13 + n, 13 + k)
    quad(9, 10, 11, 12)
    return _obj(0.001 * np.array(outer + inner, dtype=float), faces)


def _obj(vertices: np.ndarray, faces: list[tuple[int, int, int]]) -> str:
    lines = [f"v {x:.6g} {y:.6g} {z:.6g}" for x, y, z in vertices]
    lines += [f"f {a} {b} {c}" for a, b, c in faces]
    return "\n".join(lines) + "\n"


def bench(folder: Path, *plants: Plant) -> Path:
    """Writes the scene with faults planted in it; returns its main file."""
    texts = {"bench.xml": MAIN, "parts.xml": PARTS}
    for plant in plants:
        assert plant.old in texts[plant.file], plant
        texts[plant.file] = texts[plant.file].replace(plant.old, plant.new, 1)
    (folder / "meshes").mkdir(parents=True)
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    (folder / "meshes" / "wedge.obj").write_text(convex_obj(), encoding="utf-8")
    (folder / "meshes" / "cup.obj").write_text(cup_obj(), encoding="utf-8")
    (folder / "bench.csv").write_text(hand_rows(STOPS), encoding="utf-8")
    return folder / "bench.xml"


def line_of(plant: Plant, scene: Path) -> tuple[str, int]:
    """Returns file and line at which a planted fault must be named."""
    words = (plant.at or plant.new).strip()
    for file in dict.fromkeys((plant.file, "bench.xml", "parts.xml")):
        text = (scene.parent / file).read_text(encoding="utf-8")
        if words in text:
            return file, text[: text.index(words)].count("\n") + 1
    raise AssertionError(plant)


GOOD_OPTION = (
    '<option timestep="0.001" integrator="discrete" cone="elliptic" gravity="0 0 0">'
    '<flag diagexact="enable"/></option>'
)
GOOD_CONTACT = '<default><geom solref="0.002 1" solimp="0.9 0.95 0.001"/></default>'

KEY = f'<key name="home" qpos="{START}"/>'


def case_of(scene: Path, motion: Path | None = None, **options: Any) -> SceneUnderCheck:
    return open_case(read_scene(scene), use=IntendedUse(**options), motion=motion)


@functools.cache
def shipped_case(name: str) -> SceneUnderCheck:
    """Returns a shipped scene, observed once for all tests that look at it."""
    return case_of(scene_path(name))


def faults_of(scene: Path, motion: Path | None = None, **options: Any) -> tuple[Fault, ...]:
    return find_faults(case_of(scene, motion, **options))


def kinds(faults: tuple[Fault, ...]) -> set[str]:
    return {fault.kind for fault in faults}


def written(folder: Path, text: str, motion: str = "") -> Path:
    path = folder / "scene.xml"
    path.write_text(text, encoding="utf-8")
    if motion:
        path.with_suffix(".csv").write_text(motion, encoding="utf-8")
    return path


def peg_with(folder: Path, solref: str) -> Path:
    source = scene_path("peg_in_hole")
    for file in source.parent.iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    path = folder / source.name
    path.write_text(source.read_text(encoding="utf-8").replace('"0.002 1"', f'"{solref}"'))
    return path


LEAPING = """<body name="pelvis" quat=".7071 .7071 0 0"><site name="a" pos="-.0655 .0138 -.0605"/>
<geom name="brim" type="cylinder" size=".0549 .05" pos="-.071 -.065 -.0756"
  quat=".8743 .1938 .0376 .4434"/>
<body name="tool" pos="-.046 -.068 -.067"><joint type="slide" axis="1 0 0" damping="10"/>
  <joint type="slide" axis="0 1 0" damping="10"/><joint type="slide" axis="0 0 1" damping="10"/>
  <geom size=".01" mass=".1" contype="0" conaffinity="0"/><site name="grip"/>
  <site name="b" pos=".002 -.054 .0057"/></body></body>"""
"""A tool whose cord from site a to b leaves the brim at once."""

TWO_SIDED = """<site name="a" pos="0 0 -.06"/><site name="side" pos=".05 0 0"/>
<geom name="brim" size=".03" contype="0" conaffinity="0"/>
<body name="tool" pos="-.001 0 .06"><joint name="x" type="slide" axis="1 0 0" damping=".5"/>
  <geom size=".01" mass=".1" contype="0" conaffinity="0"/><site name="grip"/><site name="b"/></body>
"""
"""A tool whose cord from site a to b is equally long on either side of the brim where x is 1 mm."""
