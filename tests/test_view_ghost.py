"""The ghost of the handle, the spring and the arrow: where they are, and that they are seen."""

from __future__ import annotations

import warnings
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("viser", reason="needs the extra 'view'")

import trimesh

from hapticbridge.view.ghost import (
    FARTHEST,
    LONGEST_ARROW,
    MOST_TIMES,
    SHELL,
    Ghost,
    Surfaces,
    coil,
    enlargement,
    linear,
    shell,
)
from hapticbridge.view.sight import Sight

TOOL = """<mujoco>
  <statistic extent="1"/>
  <worldbody>
    <geom type="plane" size="1 1 0.1"/>
    <body pos="0.3 0 0.5" euler="0 30 0">
      <freejoint/>
      <geom type="box" size="0.05 0.06 0.2"/>
      <body pos="0 0 0.25"><geom size="0.05"/></body>
      <geom type="box" size="0.9 0.9 0.9" group="3"/>
      <site name="grip" pos="0 0 0.1" euler="20 0 0"/>
    </body>
  </worldbody>
</mujoco>"""


class Stage:
    """Takes what is drawn."""

    def __getattr__(self, _: str) -> Any:
        return lambda name, *_, **__: self.__dict__.setdefault(name, SimpleNamespace())


def sight(handle: tuple[float, float, float], force: tuple[float, float, float]) -> Sight:
    one, nothing = np.array([1.0, 0, 0, 0]), np.zeros((0, 3))
    return Sight(
        time=0.0,
        places=nothing,
        turns=np.zeros((0, 4)),
        handle=np.array(handle),
        handle_turn=one,
        grip=np.zeros(3),
        force=np.array(force),
        contact_places=nothing,
        contact_forces=nothing,
    )


def test_the_ghost_is_all_of_the_tool_that_is_seen_and_a_little_larger() -> None:
    model = mujoco.MjModel.from_xml_string(TOOL)
    found = shell(model, "grip")
    # back from the grip's frame to the tool's
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.site_quat[0])
    corners = found.vertices @ turn.reshape(3, 3).T + model.site_pos[0]
    low, high = corners.min(axis=0), corners.max(axis=0)
    np.testing.assert_allclose(high[:2], (0.05, 0.06), atol=SHELL)
    assert (high[:2] > (0.05, 0.06)).all()
    assert high[2] == pytest.approx(0.3 + SHELL, abs=1e-3)
    assert low[2] == pytest.approx(-0.2 - SHELL / np.sqrt(3), abs=5e-3)


def test_a_tool_that_nobody_sees_has_a_ghost_all_the_same() -> None:
    bare = TOOL.replace('size="0.05 0.06 0.2"', 'size="0.05 0.06 0.2" group="3"')
    bare = bare.replace('<geom size="0.05"/>', '<geom size="0.05" group="3"/>')
    ball = shell(mujoco.MjModel.from_xml_string(bare), "grip")
    assert np.linalg.norm(ball.vertices, axis=1).max() == pytest.approx(2 * SHELL, rel=0.01)


@pytest.mark.parametrize("stretch", [1e-4, 0.4])
def test_spring_and_arrow_point_to_where_the_hand_is_pulled(stretch: float) -> None:
    stage: Any = Stage()
    ghost = Ghost(stage, mujoco.MjModel.from_xml_string(TOOL), "grip")
    seen = sight((0, 0, -stretch), (0, 0, -5.0))  # pushed down, the tool is above
    ghost.show(seen, 10.0)
    line = stage.__dict__["/coupling"].points
    start, end = line[0, 0], line[-1, 1]
    np.testing.assert_allclose(stage.__dict__["/handle"].position, seen.handle)
    if stretch == 0.4:  # which can be seen: from handle to tool
        assert ghost.times == 1
        np.testing.assert_allclose(start, seen.handle, atol=1e-6)
        np.testing.assert_allclose(end, seen.grip, atol=1e-6)
    else:
        assert ghost.times == MOST_TIMES
        # out of the box, which is turned by 20 degrees, on its side of 0.06 m or at its end
        out = min((0.06 + SHELL) / np.sin(np.radians(20)), 0.2 + SHELL + 0.05)
        assert 0.1 < start[2] - seen.handle[2] <= out
        np.testing.assert_allclose(end - start, (0, 0, ghost.times * stretch), atol=1e-6)
    tail, tip = stage.__dict__["/force in the hand"].points[0]
    np.testing.assert_allclose(tail, end, atol=1e-6)
    np.testing.assert_allclose(tip - tail, (0, 0, 0.5 * LONGEST_ARROW), atol=1e-6)


def test_the_spring_is_pale_at_rest_and_red_at_the_largest_force() -> None:
    stage: Any = Stage()
    ghost = Ghost(stage, mujoco.MjModel.from_xml_string(TOOL), "grip")
    found = []
    for strength in (0.0, 10.0):
        ghost.show(sight((0, 0, 1e-3), (0, 0, strength)), 10.0)
        found.append(stage.__dict__["/coupling"].colors[0, 0].tolist())
    (red, green, blue), (full_red, full_green, _) = found
    assert min(red, green, blue) > 100
    assert blue > red
    assert full_red > 3 * full_green


def test_the_way_out_is_to_the_last_surface() -> None:
    balls = [trimesh.creation.icosphere(subdivisions=4, radius=radius) for radius in (0.5, 1.0)]
    balls[1].apply_translation((0, 0, 3.0))
    triangles = np.concatenate([ball.triangles for ball in balls])
    both = Surfaces(triangles)
    assert both.way_out(np.array([0.0, 0, 1])) == pytest.approx(4.0, rel=1e-3)
    for along in ((1, 0, 0), (0, 0, -1), (0.6, 0.0, -0.8)):
        assert both.way_out(np.array(along, float)) == pytest.approx(0.5, rel=5e-3)
    assert Surfaces(balls[1].triangles).way_out(np.array([1.0, 0, 0])) == 0.0


def test_a_surface_seen_edge_on_or_without_area_is_not_in_the_way() -> None:
    edge_on = [[0.0, 0, 1], [0, 0, 2], [0, 1, 2]]
    no_area = [[0.0, 0, 1], [0, 0, 1], [1, 0, 1]]
    found = Surfaces(np.array([edge_on, no_area]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert found.way_out(np.array([0.0, 0, 1])) == 0.0


@given(st.floats(1e-9, 10.0), st.floats(0.0, 10.0))
def test_a_stretch_is_drawn_as_long_as_there_is_room_in_round_numbers(
    room: float, stretch: float
) -> None:
    times = enlargement(room, stretch)
    assert str(times).rstrip("0") in {"1", "2", "5"}
    assert times <= MOST_TIMES
    assert times == 1 or times * stretch <= room * (1 + 1e-6)
    assert times == MOST_TIMES or 2.5 * times * stretch > room * (1 - 1e-6)


def test_the_longest_stretch_so_far_decides() -> None:
    ghost = Ghost(Stage(), mujoco.MjModel.from_xml_string(TOOL), "grip")
    seen = []
    for stretch in (1e-3, FARTHEST / 20, 1e-3):
        ghost.allow(stretch)
        seen.append(ghost.times)
    assert seen == [200, 20, 20]


@given(st.tuples(*[st.floats(-1, 1)] * 6))
def test_a_spring_is_one_line_from_end_to_end(ends: tuple[float, ...]) -> None:
    start, end = np.array(ends[:3]), np.array(ends[3:])
    line = coil(start, end, 0.01)
    np.testing.assert_allclose(line[0, 0], start, atol=1e-9)
    np.testing.assert_allclose(line[-1, 1], end, atol=1e-9)
    np.testing.assert_allclose(line[1:, 0], line[:-1, 1])


def test_colours_of_lines_are_shares_of_light() -> None:
    # IEC 61966-2-1: half of the light is 188, a fifth 124
    assert linear((255, 0, 0)) == (255, 0, 0)
    assert linear((188, 124, 10)) == pytest.approx((128, 51, 1), abs=1)
