"""Limits, friction and equalities that keep a tool behind a lossless coupling implicit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from kernel_runs import Array
from lossless_runs import T, led, scene_of

from hapticbridge.coupling import Coupling
from hapticbridge.record import TickFlag

ASKED = Coupling(2400.0, 3.0, 1.0, 0.003)
OUT_AND_BACK: Array = np.concatenate([np.linspace(0, 0.02, 300), np.linspace(0.02, 0, 300)])
"""In m along x, a tick each: at ``STOP`` after 150 ticks, and until 450."""
STOP = 0.01

SLIDER = """
<mujoco>
  <option gravity="0 0 0"/>
  <worldbody>
    <site name="anchor"/>
    <body name="tool"><joint name="rail" type="slide" axis="1 0 0" {joint}/>
      <geom size="0.002" mass="0.1" contype="0" conaffinity="0"/><site name="grip"/></body>
    <body name="other" pos="0 0.1 0"><joint name="second" type="slide" axis="1 0 0"/>
      <geom size="0.002" mass="0.1" contype="0" conaffinity="0"/></body>
  </worldbody>
  {more}
</mujoco>"""
TENDON = '<tendon><spatial {}><site site="anchor"/><site site="grip"/></spatial></tendon>'
EQUAL = '<equality><joint joint1="{}" polycoef="0 0.5 0 0 0"/></equality>'
STOPS = {
    "joint's limit": (f'limited="true" range="-1 {STOP}"', ""),
    "tendon's limit": ("", TENDON.format(f'limited="true" range="0 {STOP}"')),
}
HOLDS = {
    "friction in its joint": ('frictionloss="0.01"', ""),
    "friction in a tendon": ("", TENDON.format('frictionloss="0.01"')),
    "an equality of joints": ("", EQUAL.format('rail" joint2="second')),
    "a weld of bodies": ("", '<equality><weld body1="tool" body2="other"/></equality>'),
    "a connection of sites": (
        "",
        '<equality><connect site1="grip" site2="anchor" solref="0.1 1"/></equality>',
    ),
}
LETS_GO = {
    "nothing": ("", ""),
    "an equality of another joint": ("", EQUAL.format("second")),
    "a connection of another body": (
        "",
        '<equality><connect body1="other" anchor="0 0 0"/></equality>',
    ),
}


def lossless_ticks(scene: tuple[str, str], folder: Path) -> Array:
    """Leads the slider out and back; returns per tick whether it was lossless."""
    joint, more = scene
    path = np.zeros((OUT_AND_BACK.size, 3))
    path[:, 0] = OUT_AND_BACK
    rows, _ = led(
        scene_of(SLIDER.format(joint=joint, more=more), folder), "lossless", ASKED, path, T
    )
    return np.asarray((rows["flags"] & int(TickFlag.MIDPOINT)) != 0)


@pytest.mark.parametrize("stop", sorted(STOPS))
def test_tool_at_limit_is_implicit_and_lossless_before_and_after(stop: str, tmp_path: Path) -> None:
    is_free = lossless_ticks(STOPS[stop], tmp_path)
    assert is_free[5:140].all()
    assert not is_free[165:440].any()
    assert is_free[480:].all()


@pytest.mark.parametrize("hold", sorted(HOLDS))
def test_a_tool_that_is_always_held_is_never_lossless(hold: str, tmp_path: Path) -> None:
    assert not lossless_ticks(HOLDS[hold], tmp_path).any()


@pytest.mark.parametrize("other", sorted(LETS_GO))
def test_a_tool_that_nothing_holds_is_lossless_from_tick_two(other: str, tmp_path: Path) -> None:
    assert lossless_ticks(LETS_GO[other], tmp_path)[1:].all()


CLOTH = """
<mujoco>
  <option gravity="0 0 0"/>
  <worldbody>
    <flexcomp type="grid" count="3 3 1" spacing="0.03 0.03 0.03" radius="0.002" name="cloth"
      dim="2" mass="0.05"><contact selfcollide="none"/>
      <elasticity young="1e4" poisson="0.1" thickness="0.002" elastic2d="both"/>
      <pin id="0 2 6 8"/></flexcomp>
    <body pos="0.005 0.004 0.03"><joint type="slide" axis="0 0 1"/>
      <geom size="0.01" mass="0.1"/><site name="grip"/></body>
  </worldbody>
</mujoco>"""


def test_a_tool_on_a_cloth_is_held_by_it(tmp_path: Path) -> None:
    # a contact with a flex names no geom on that side, and has a gap of its own
    path = np.zeros((400, 3))
    path[:, 2] = -np.linspace(0.0, 0.025, 400)
    rows, _ = led(scene_of(CLOTH, tmp_path), "lossless", ASKED, path, T)
    touches = (rows["flags"] & int(TickFlag.CONTACT)) != 0
    is_free = (rows["flags"] & int(TickFlag.MIDPOINT)) != 0
    assert touches.any() and is_free.any()
    assert not (touches & is_free).any()
