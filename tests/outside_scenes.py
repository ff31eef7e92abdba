"""Scenes from outside models/ that a user might bring: MJCF, assets and hand motions as files."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import hapticbridge as hb
from hapticbridge.scene import load_scene

FREE_TOOL = """<body name="tool">
  <freejoint name="tool"/>
  <geom name="ball" size="0.01" mass="0.1"/>
  <site name="grip"/>
</body>"""

CONTACT = 'condim="3" friction="0.3 0 0" solref="0.002 1" solimp="0.9 0.95 0.001"'
OPTION = (
    '<option timestep="0.001" integrator="discrete" cone="elliptic" gravity="{gravity}">'
    '<flag diagexact="enable"/></option>'
)

BALL_JOINT_TOOL = f"""<mujoco model="pointer">
  {OPTION.format(gravity="0 0 -9.81")}
  <worldbody>
    <body name="shaft" pos="0 0 0.2">
      <joint name="ball" type="ball" damping="1e-3"/>
      <geom type="capsule" fromto="0 0 0 0.15 0 0" size="0.006" mass="0.08"/>
      <body name="beak" pos="0.15 0 0">
        <joint name="elbow" axis="0 1 0" range="-120 120" damping="1e-3"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.08" size="0.005" mass="0.04"/>
        <site name="tip" pos="0 0 -0.08" euler="0 30 0"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
"""Two links on a ball joint and a hinge: the tip can go anywhere in a ball of 0.23 m."""
SHOULDER = np.array([0.0, 0.0, 0.2])

PIN_STIFFNESS, PIN_PRELOAD, PIN_DEPTH = 150.0, 0.6, 0.008
SPRING_PIN = f"""<mujoco model="probe_and_pin">
  {OPTION.format(gravity="0 0 0")}
  <worldbody>
    <geom name="block" type="box" size="0.03 0.03 0.01" pos="0 0 -0.05" {CONTACT}/>
    <body name="pin" pos="0 0 -0.01">
      <joint name="pin" type="slide" axis="0 0 1" stiffness="{PIN_STIFFNESS}"
             springref="{PIN_PRELOAD / PIN_STIFFNESS}" damping="0.8" limited="true"
             range="-{PIN_DEPTH} 0" solreflimit="0.002 1" solimplimit="0.9 0.95 0.001"/>
      <geom name="pin" type="cylinder" size="0.004 0.01" mass="0.02" {CONTACT}/>
    </body>
    <body name="probe" pos="0 0 0.025">
      <freejoint/>
      <geom name="foot" type="sphere" size="0.005" pos="0 0 -0.015" mass="0.04" {CONTACT}/>
      <geom name="stem" type="capsule" fromto="0 0 -0.01 0 0 0.02" size="0.003" mass="0.02"
            contype="0" conaffinity="0"/>
      <site name="stylus"/>
    </body>
  </worldbody>
  <sensor><jointpos name="pin" joint="pin"/></sensor>
</mujoco>
"""
"""A free probe above a pin that a preloaded spring holds at its upper stop."""
PIN_GAP = 0.005

DRAWER_FRICTION, DRAWER_LENGTH = 1.2, 0.12
DRAWER = f"""<mujoco model="drawer">
  {OPTION.format(gravity="0 0 -9.81")}
  <default>
    <default class="wood"><geom type="box" {CONTACT}/></default>
  </default>
  <worldbody>
    <geom name="cabinet" class="wood" size="0.15 0.2 0.01" pos="0 0 -0.06"/>
    <body name="drawer">
      <joint name="rail" type="slide" axis="1 0 0" range="0 {DRAWER_LENGTH}"
             frictionloss="{DRAWER_FRICTION}" solreffriction="0.002 1"
             solreflimit="0.002 1" solimplimit="0.9 0.95 0.001"/>
      <geom class="wood" size="0.1 0.15 0.03" mass="0.4" contype="0" conaffinity="0"/>
      <geom name="knob" type="sphere" size="0.012" pos="0.11 0.05 0" mass="0.02"/>
      <site name="knob" pos="0.11 0.05 0"/>
    </body>
  </worldbody>
</mujoco>
"""
"""A drawer with dry friction and two stops, gripped at a knob off its centre of mass."""


def scene_file(folder: Path, text: str | bytes, name: str = "scene.xml") -> Path:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


def mjcf(*sections: str, body: str = FREE_TOOL, world: str = "") -> str:
    """Returns a scene: sections, then a world of the tool and whatever else there is."""
    return f"<mujoco>{''.join(sections)}<worldbody>{body}{world}</worldbody></mujoco>"


def hand_file(folder: Path, stops: list[tuple[float, tuple[float, float, float]]]) -> Path:
    """Writes a hand that moves from rest to rest through (seconds, offset in m)."""
    file = folder / "hand.csv"
    file.write_text(hand_rows(stops), encoding="utf-8")
    return file


def hand_rows(stops: Sequence[tuple[float, tuple[float, float, float]]]) -> str:
    """A hand that moves from rest to rest through (seconds, offset in m), 100 rows/s."""
    rows = [np.zeros(4)]
    for seconds, offset in stops:
        s = np.linspace(0.0, 1.0, round(seconds * 100) + 1)[1:, None]
        start, time = rows[-1][1:], rows[-1][0]
        path = start + s**3 * (10 - 15 * s + 6 * s**2) * (np.array(offset) - start)
        rows.extend(np.hstack([time + s * seconds, path]))
    return "t,x,y,z\n" + "".join(",".join(f"{v:.9f}" for v in row) + "\n" for row in rows)


def tetrahedron(side: float) -> tuple[np.ndarray, list[tuple[int, int, int]]]:
    vertices = side * np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], dtype="<f4")
    return vertices, [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]


def obj_bytes(side: float = 0.01) -> bytes:
    vertices, faces = tetrahedron(side)
    lines = [f"v {x:.6g} {y:.6g} {z:.6g}" for x, y, z in vertices]
    lines += ["f " + " ".join(str(i + 1) for i in face) for face in faces]
    return ("\n".join(lines) + "\n").encode()


def stl_bytes(side: float = 0.01) -> bytes:
    vertices, faces = tetrahedron(side)
    triangles = (bytes(12) + vertices[list(face)].tobytes() + bytes(2) for face in faces)
    return bytes(80) + struct.pack("<I", len(faces)) + b"".join(triangles)


def png_bytes(red: int = 200) -> bytes:
    """A grey-scale ramp of 4 x 4 pixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        check = struct.pack(">I", zlib.crc32(kind + data))
        return struct.pack(">I", len(data)) + kind + data + check

    header = struct.pack(">IIBBBBB", 4, 4, 8, 2, 0, 0, 0)
    pixels = b"".join(b"\0" + bytes((red, 40 * row, 60)) * 4 for row in range(4))
    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(pixels)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body


HINGE_TOOL = """<body name="arm"><joint name="elbow" {joint}/>
<geom name="arm" size="0.01" mass="0.1"/><site name="grip" pos="0.1 0 0"/></body>"""


def refusal(path: str | Path, grip: str = "grip", *, as_is: bool = False) -> str:
    """Loads what must be refused; returns the message, which is one line."""
    with pytest.raises(hb.SceneError) as caught:
        load_scene(path, grip, as_is=as_is)
    message = str(caught.value)
    assert "\n" not in message
    assert "Error" not in message.split("'", maxsplit=1)[0]
    assert len(message) < 400
    return message


def refusal_of(folder: Path, text: str | bytes, grip: str = "grip") -> str:
    return refusal(scene_file(folder, text), grip)


GRIPPED = FREE_TOOL.replace(
    '<site name="grip"/>', '<site name="grip" pos=".01 0 0" quat="1 0 0 0"/>'
)


def ticks(path: Path, hand: Path, count: int = 200) -> NDArray[np.void]:
    with hb.Bridge(load_scene(path), f"trajectory:{hand}", clock=hb.SimulatedClock()) as bridge:
        bridge.run(duration=count / 1000)
        return bridge.latest_records(count)


RICH = """<mujoco model="rich">
  <compiler angle="degree" autolimits="true"/>
  <default><default class="servo"><position kp="40" kv="1" ctrlrange="-1 1"/></default></default>
  <worldbody>
    <body name="tool" pos="0 0 .5"><freejoint/><geom size=".02" mass=".2"/>
      <site name="grip"/><site name="eye" pos=".02 0 0"/></body>
    <body name="puck" mocap="true" pos="1 1 1"><geom size=".01"/></body>
    <body name="cart" pos="2 0 0"><joint name="rail" type="slide" axis="1 0 0" range="-1 1"/>
      <geom size=".05" mass="1"/><site name="hook"/></body>
    <body name="gate" pos="3 0 0"><joint name="hinge" range="-90 90"/><geom size=".05" mass="1"/>
      <site name="latch" pos="0 .1 0"/></body>
    <body name="puck2" mocap="true" pos="-1 0 0"/>
  </worldbody>
  <tendon><spatial name="cord" stiffness="3"><site site="hook"/><site site="latch"/></spatial>
  <fixed name="mix"><joint joint="rail" coef="2"/></fixed></tendon>
  <equality><connect name="chain" body1="cart" body2="gate" anchor="0 0 0" active="false"/>
    <joint name="gear" joint1="rail" joint2="hinge" polycoef="0 2 0 0 0"/></equality>
  <actuator><position class="servo" name="drive" joint="rail"/><motor name="torque" joint="hinge"/>
    <general name="winch" tendon="cord" dyntype="filter" dynprm=".1"/></actuator>
  <sensor><jointpos name="where" joint="rail"/><force name="push" site="hook"/>
    <tendonpos name="length" tendon="cord"/></sensor>
  <custom><numeric name="n" data="1 2 3"/><text name="about" data="a rich scene"/></custom>
  <contact><exclude body1="cart" body2="gate"/></contact>
  <keyframe>
    <key name="away" qpos="5 0 0 1 0 0 0 .3 .2" ctrl=".1 .2 .3" mpos="9 9 9 8 8 8"/>
    <key name="home" time="2" qpos="0 0 1 1 0 0 0 .2 .1" qvel="0 0 0 0 0 0 .5 0" ctrl=".4 .5 .6"
         act=".7" mpos="1 2 3 4 5 6" mquat="0 1 0 0 0 0 1 0"/>
  </keyframe>
</mujoco>"""
