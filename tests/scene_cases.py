"""Scenes as text, and what is refused in them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from outside_scenes import FREE_TOOL, scene_file

import hapticbridge as hb
from hapticbridge.scene import load_scene

HINGE_TOOL = """<body name="arm"><joint name="elbow" {joint}/>
<geom name="arm" size="0.01" mass="0.1"/><site name="grip" pos="0.1 0 0"/></body>"""


def refusal(path: str | Path, grip: str = "grip") -> str:
    """Loads what must be refused; returns the message, which is one line."""
    with pytest.raises(hb.SceneError) as caught:
        load_scene(path, grip)
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
    <joint name="gear" joint1="rail" joint2="hinge" polycoef="0 .1 0 0 0"/></equality>
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
