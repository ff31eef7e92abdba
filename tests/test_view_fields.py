"""Height fields, signed distance fields and tendons on the page: where MuJoCo has them."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("viser", reason="needs the extra 'view'")

from hapticbridge.kernel.names import HANDLE
from hapticbridge.view.absent import left_out
from hapticbridge.view.props import Prop, props_of
from hapticbridge.view.tendons import Tendons
from hapticbridge.view.terrain import MOST_SAMPLES, stride_of, terrain

Array = NDArray[np.float64]

RX, RY, RZ, BASE = 0.3, 0.2, 0.1, 0.05

FIELD = """<mujoco>
  <asset><hfield name="hills" nrow="{rows}" ncol="{columns}" size="0.3 0.2 0.1 0.05"/></asset>
  <worldbody><geom type="hfield" hfield="hills" pos="0.5 -0.2 0.1" euler="0 0 30"/></worldbody>
</mujoco>"""

TORUS = """<mujoco>
  <extension>
    <plugin plugin="mujoco.sdf.torus">
      <instance name="torus">
        <config key="radius1" value="0.35"/>
        <config key="radius2" value="0.15"/>
      </instance>
    </plugin>
  </extension>
  <asset><mesh name="torus"><plugin instance="torus"/></mesh></asset>
  <worldbody><geom type="sdf" mesh="torus"><plugin instance="torus"/></geom></worldbody>
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
    return np.asarray(prop.triangles @ turn.reshape(3, 3).T + prop.place)


def first_hit(corners: Array, point: Array, way: Array) -> float:
    """Returns how far the first of triangles is along a ray, or −1 as MuJoCo says for none."""
    edges = [corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]]
    systems = np.stack([*edges, np.broadcast_to(-way, edges[0].shape)], axis=2)
    is_met = np.abs(np.linalg.det(systems)) > 1e-12
    solved = np.linalg.solve(systems[is_met], (point - corners[is_met, 0])[..., None])
    u, v, far = solved[..., 0].T
    is_hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (far > 0)
    return float(far[is_hit].min()) if is_hit.any() else -1.0


@pytest.mark.parametrize(("rows", "columns"), [(2, 2), (3, 7), (8, 5)])
def test_a_ray_from_any_side_meets_the_field_where_mujocos_ray_does(
    rows: int, columns: int
) -> None:
    model, prop = hills(rows, columns)
    data, corners = mujoco.MjData(model), world(prop)
    mujoco.mj_forward(model, data)
    random, met = np.random.default_rng(5), 0
    for _ in range(200):
        point = prop.place + random.normal(size=3)
        way = prop.place + random.uniform(-0.25, 0.25, 3) - point
        way /= np.linalg.norm(way)
        theirs = mujoco.mj_ray(model, data, point, way, None, 1, -1, np.zeros(1, np.int32))
        assert first_hit(corners, point, way) == pytest.approx(theirs, abs=1e-6)
        met += theirs > 0
    assert met > 50


def test_every_sample_stands_at_its_row_and_column() -> None:
    model, prop = hills(3, 4)
    samples = model.hfield_data.reshape(3, 4)
    corners = {tuple(corner) for corner in np.round(prop.triangles.reshape(-1, 3), 6)}
    for row, y in enumerate((-RY, 0.0, RY)):
        for column, x in enumerate((-RX, -RX / 3, RX / 3, RX)):
            z = RZ * float(samples[row, column])
            assert tuple(np.round((x, y, z), 6)) in corners
    assert {corner[2] for corner in corners if corner[2] < 0} == {-BASE}


def test_a_field_is_closed_and_its_outside_is_outside() -> None:
    model, prop = hills(4, 6)
    one, two, three = np.moveaxis(prop.triangles, 1, 0)
    # of a closed surface the areas cancel, and the volume is that of the prisms under the samples
    np.testing.assert_allclose(np.cross(two - one, three - one).sum(axis=0), 0.0, atol=1e-12)
    volume = np.einsum("ij,ij->", one, np.cross(two, three)) / 6
    s = RZ * model.hfield_data.reshape(4, 6).astype(float)
    low, across = s[:-1, :-1] + s[1:, 1:], s[:-1, 1:] + s[1:, :-1]
    cell = 4 * RX * RY / 15
    assert volume == pytest.approx(cell * (low / 3 + across / 6 + BASE).sum(), rel=1e-6)


def test_the_facets_that_a_tool_feels_are_seen() -> None:
    _, prop = hills(6, 6)
    np.testing.assert_allclose(prop.normals, prop.normals[:, :1].repeat(3, axis=1), atol=1e-9)


def test_of_a_fine_field_samples_are_left_out_but_never_its_edge() -> None:
    assert stride_of(hills(MOST_SAMPLES, 5)[0], 0) == 1
    model, prop = hills(MOST_SAMPLES + 1, 5)
    assert stride_of(model, 0) == 2
    assert len(prop.triangles) < len(terrain(model, 0))
    corners = prop.triangles.reshape(-1, 3)
    np.testing.assert_allclose(corners.max(axis=0)[:2], (RX, RY))
    np.testing.assert_allclose(corners.min(axis=0), (-RX, -RY, -BASE))
    last = RZ * model.hfield_data.reshape(-1, 5)[-1]
    edge = {round(float(z), 6) for _, y, z in corners if y == RY}
    assert {round(float(z), 6) for z in last[[0, 2, 4]]} <= edge


def test_a_signed_distance_field_is_drawn_where_the_distance_is_zero() -> None:
    [prop] = props_of(mujoco.MjModel.from_xml_string(TORUS))
    x, y, z = prop.triangles.reshape(-1, 3).T
    off = np.hypot(np.hypot(x, y) - 0.35, z) - 0.15
    assert np.abs(off).max() < 2e-3  # MuJoCo's triangles are 5 mm
    one, two, three = np.moveaxis(prop.triangles, 1, 0)
    area = 0.5 * np.linalg.norm(np.cross(two - one, three - one), axis=1).sum()
    assert area == pytest.approx(4 * np.pi**2 * 0.35 * 0.15, rel=5e-3)


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


def test_a_scene_without_tendons_has_none() -> None:
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    assert Tendons(model).pieces(mujoco.MjData(model)) == ()


def words(inside: str, fields: str = "", sensors: str = "") -> list[str]:
    text = f"""<mujoco>
      <asset>{fields}</asset>
      <worldbody>
        <body name="handle" mocap="true"><site name="hapticbridge_handle"/></body>
        <body><freejoint/><geom size="0.1"/><site name="grip"/></body>
        {inside}
      </worldbody>
      <sensor>{sensors}</sensor>
    </mujoco>"""
    text = text.replace("hapticbridge_handle", HANDLE)
    return left_out(mujoco.MjModel.from_xml_string(text), "grip")


def test_what_is_not_drawn_is_said_and_nothing_else() -> None:
    hidden = '<site group="3"/><site rgba="1 1 1 0"/>'
    assert words(hidden) == []
    assert words('<site name="eye"/><site/>' + hidden) == ["Not drawn here: sites (2)"]
    beam = '<rangefinder site="eye"/>'
    found = words('<site name="eye" group="4"/>', sensors=beam)
    assert found == ["Not drawn here: the beams of rangefinders (1)"]
    cloth = (
        '<flexcomp name="cloth" type="grid" dim="2" count="3 3 1" spacing=".1 .1 .1" group="{}"/>'
    )
    assert words(cloth.format(0)) == ["Not drawn here: flexes (1)"]
    assert words(cloth.format(3)) == []


def test_a_field_that_is_drawn_coarser_than_it_is_says_so() -> None:
    for rows, told in ((MOST_SAMPLES, []), (MOST_SAMPLES + 1, ["one sample of 2 along a side"])):
        field = f'<hfield name="hills" nrow="{rows}" ncol="3" size="1 1 1 1"/>'
        found = words('<geom type="hfield" hfield="hills"/>', field)
        assert [word for word in told if word not in str(found)] == []
        assert len(found) == len(told)
