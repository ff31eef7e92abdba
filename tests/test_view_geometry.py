"""Shapes on the page: where MuJoCo has them, and the ghost, the spring and the arrow."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from view_cases import Canvas

pytest.importorskip("viser", reason="needs the extra 'view'")


from hapticbridge.view.geometry import (
    MAX_TIMES,
    SHELL,
    Prop,
    Scenery,
    Tendons,
    enlargement,
    props_of,
    shell,
)
from hapticbridge.view.page import MAX_ARROW, Ghost, Held

Array = NDArray[np.float64]


FIELD = """<mujoco>
  <asset><hfield name="hills" nrow="{rows}" ncol="{columns}" size="0.3 0.2 0.1 0.05"/></asset>
  <worldbody><geom type="hfield" hfield="hills" pos="0.5 -0.2 0.1" euler="0 0 30"/></worldbody>
</mujoco>"""


PULLED = """<mujoco>
  <worldbody>
    <site name="a" pos="0 0 1"/>
    <geom name="wheel" type="cylinder" size="0.1 0.1" pos="0.3 0 0.8" euler="90 0 0"/>
    <body pos="0.6 0 0.5">
      <joint name="lift" type="slide" axis="0 0 1"/>
      <geom size="0.05"/>
      <site name="b"/>
    </body>
  </worldbody>
  <tendon>
    <spatial name="hidden" width="0.01" group="3"><site site="a"/><site site="b"/></spatial>
    <spatial name="straight" width="0.02" rgba="1 0 0 1"><site site="a"/><site site="b"/></spatial>
    <fixed name="nowhere"><joint joint="lift" coef="1"/></fixed>
    <spatial name="around"><site site="a"/><geom geom="wheel"/><site site="b"/></spatial>
    <spatial name="in two" width="0.01">
      <site site="a"/><site site="b"/><pulley divisor="2"/><site site="b"/><site site="a"/>
    </spatial>
  </tendon>
</mujoco>"""


def hills(rows: int, columns: int) -> tuple[mujoco.MjModel, Prop]:
    """A field without any symmetry, and what is drawn of it."""
    model = mujoco.MjModel.from_xml_string(FIELD.format(rows=rows, columns=columns))
    model.hfield_data[:] = np.random.default_rng(4).uniform(size=rows * columns)
    [prop] = props_of(model)
    return model, prop


def world(prop: Prop) -> Array:
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, prop.turn)
    return np.asarray(prop.mesh.triangles @ turn.reshape(3, 3).T + prop.place)


@pytest.mark.parametrize(("rows", "columns"), [(2, 2), (3, 7), (8, 5)])
def test_a_height_field_is_drawn_with_its_heights(rows: int, columns: int) -> None:
    model, prop = hills(rows, columns)
    corners = world(prop)
    # on a ray down from above each sample the field is where MuJoCo's ray meets it
    data, down = mujoco.MjData(model), np.array([0.0, 0.0, -1.0])
    mujoco.mj_forward(model, data)
    for corner in np.unique(corners.reshape(-1, 3), axis=0)[:: 1 + rows // 8]:
        inside = 0.999 * (corner - prop.place) + prop.place
        start = np.array([*inside[:2], 1.0])
        far = mujoco.mj_ray(model, data, start, down, None, 1, -1, np.zeros(1, np.int32))
        if corner[2] > prop.place[2]:
            assert 1.0 - far == pytest.approx(corner[2], abs=2e-3)
    half = prop.mesh.triangles.reshape(-1, 3)
    np.testing.assert_allclose(half.max(axis=0)[:2], (0.3, 0.2))
    np.testing.assert_allclose(half.min(axis=0), (-0.3, -0.2, -0.05))


def test_tendons_run_where_mujoco_measures_them() -> None:
    model = mujoco.MjModel.from_xml_string(PULLED)
    data, tendons = mujoco.MjData(model), Tendons(model)
    np.testing.assert_allclose(tendons.widths, 2 * model.tendon_width[[1, 3, 4]])
    np.testing.assert_allclose(tendons.colours[0], (1, 0, 0, 1))
    for lift in (0.0, -0.05):
        data.qpos[0] = lift
        mujoco.mj_kinematics(model, data)
        straight, around, halves = (np.array(each, float) for each in tendons.pieces(data))
        ends = np.array([[0, 0, 1], [0.6, 0, 0.5 + lift]])
        np.testing.assert_allclose(straight, ends[None], atol=1e-6)
        np.testing.assert_allclose(halves, np.stack([ends, ends[::-1]]), atol=1e-6)
        # joined, from site to site, along the wheel and never inside of it
        np.testing.assert_allclose(around[1:, 0], around[:-1, 1], atol=1e-6)
        np.testing.assert_allclose(np.stack([around[0, 0], around[-1, 1]]), ends, atol=1e-6)
        from_axis = np.hypot(around[..., 0] - 0.3, around[..., 2] - 0.8)
        assert from_axis.min() == pytest.approx(0.1, abs=2e-3)
        mujoco.mj_forward(model, data)
        length = np.linalg.norm(around[:, 1] - around[:, 0], axis=1).sum()
        assert length == pytest.approx(data.ten_length[model.tendon("around").id], rel=2e-3)


def test_every_shape_is_drawn_at_its_size() -> None:
    asset = """<asset>
        <texture name="t" type="2d" builtin="checker" width="8" height="8"
          rgb1="1 0 0" rgb2="0 0 1"/>
        <material name="checker" texture="t" rgba="1 1 0.5 0.5"/>
      </asset>"""
    shapes = {
        "box": ("0.1 0.2 0.3", (0.1, 0.2, 0.3)),
        "sphere": ("0.1", (0.1, 0.1, 0.1)),
        "ellipsoid": ("0.1 0.2 0.3", (0.1, 0.2, 0.3)),
        "capsule": ("0.1 0.2", (0.1, 0.1, 0.3)),
        "cylinder": ("0.1 0.2", (0.1, 0.1, 0.2)),
        "plane": ("0.1 0.2 1", (0.1, 0.2, 0.0)),
    }
    geoms = "".join(
        f'<geom type="{kind}" size="{size}" rgba="1 0 0 0.5"/>'
        for kind, (size, _) in shapes.items()
    )
    hidden = '<geom size="1" group="3"/><geom size="1" rgba="1 1 1 0"/>'
    textured = '<geom size="1" material="checker"/>'
    text = f"<mujoco>{asset}<worldbody>{geoms}{hidden}{textured}</worldbody></mujoco>"
    *props, checkered = props_of(mujoco.MjModel.from_xml_string(text))
    np.testing.assert_allclose(checkered.colour, (0.5, 0, 0.25, 0.5), atol=3e-3)  # the mean
    assert len(props) == len(shapes)
    for prop, (_, half) in zip(props, shapes.values(), strict=True):
        corners = prop.mesh.triangles.reshape(-1, 3)
        np.testing.assert_allclose(corners.max(axis=0), half, rtol=0.02, atol=1e-9)
        np.testing.assert_allclose(corners.min(axis=0), np.negative(half), rtol=0.02, atol=1e-9)
        np.testing.assert_allclose(prop.colour, (1, 0, 0, 0.5))


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


@pytest.mark.parametrize("stretch", [1e-4, 0.4])
def test_spring_and_arrow_point_to_where_the_hand_is_pulled(stretch: float) -> None:
    canvas: Any = Canvas()
    ghost = Ghost(canvas, Scenery.from_model(mujoco.MjModel.from_xml_string(TOOL), "grip"))
    force = np.array([0.0, 0.0, 5.0])
    # pushed down, the tool is above
    seen = Held(
        handle=np.array([0.0, 0.0, -stretch]),
        handle_turn=np.array([1.0, 0.0, 0.0, 0.0]),
        grip=np.zeros(3),
        hand_force=force,
        tool_force=-force / 0.3,
    )
    ghost.show(seen, 10.0, 20.0)
    line = canvas.__dict__["/coupling"].points
    start, end = line[0, 0], line[-1, 1]
    np.testing.assert_allclose(canvas.__dict__["/handle"].position, seen.handle)
    if stretch == 0.4:  # which can be seen: from handle to tool
        assert ghost.times == 1
        np.testing.assert_allclose(start, seen.handle, atol=1e-6)
        np.testing.assert_allclose(end, seen.grip, atol=1e-6)
    else:
        assert ghost.times == MAX_TIMES
        # out of the box, which is turned by 20 degrees, on its side of 0.06 m or at its end
        out = min((0.06 + SHELL) / np.sin(np.radians(20)), 0.2 + SHELL + 0.05)
        assert 0.1 < start[2] - seen.handle[2] <= out
        np.testing.assert_allclose(end - start, (0, 0, ghost.times * stretch), atol=1e-6)
    tail, tip = canvas.__dict__["/force on the hand"].points[0]
    np.testing.assert_allclose(tail, end, atol=1e-6)
    np.testing.assert_allclose(tip - tail, (0, 0, 0.5 * MAX_ARROW), atol=1e-6)


@given(st.floats(1e-9, 10.0), st.floats(0.0, 10.0))
def test_a_stretch_is_drawn_as_long_as_there_is_room_in_round_numbers(
    room: float, stretch: float
) -> None:
    times = enlargement(room, stretch)
    assert str(times).rstrip("0") in {"1", "2", "5"}
    assert times <= MAX_TIMES
    assert times == 1 or times * stretch <= room * (1 + 1e-6)
    assert times == MAX_TIMES or 2.5 * times * stretch > room * (1 - 1e-6)
