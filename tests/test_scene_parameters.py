"""Parameters of scenes: what they set, what they refuse, and that a recording knows them."""

from __future__ import annotations

import json
import math
import tomllib
from pathlib import Path

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import hapticbridge as hb
from hapticbridge import scene as scenes
from hapticbridge.audit.recorded_scene import compile_recorded, is_as_recorded
from hapticbridge.cli import main
from hapticbridge.kernel.mujoco_c import copy_of
from hapticbridge.run.description import model_digest
from hapticbridge.scene import load_scene, scene_path

PARAMETERS = [
    (name, p) for name in scenes.scene_names() for p in scenes.scene_parameters(scene_path(name))
]
each_parameter = pytest.mark.parametrize(
    ("name", "parameter"), PARAMETERS, ids=[f"{name} {p.name}" for name, p in PARAMETERS]
)

SCENE = """<mujoco>
  <option integrator="discrete" cone="elliptic"><flag diagexact="enable"/></option>
  <default><geom solref="0.002 1" solimp="0.9 0.95 0.001"/></default>
  <worldbody>
    <geom name="wall_0" type="box" size="0.01 0.1 0.1" pos="0.05 0 0"/>
    <geom name="wall_1" type="box" size="0.01 0.1 0.1" pos="0.05 0 0.3"/>
    <body name="tool">
      <joint name="slide" type="slide" axis="1 0 0" stiffness="20"/>
      <geom name="tool" size="0.01" mass="0.1"/>
      <site name="grip"/>
    </body>
  </worldbody>
  <keyframe><key name="home" qpos="0.001"/></keyframe>
</mujoco>"""

TABLE = """[parameters.{name}]
unit = "m"
default = {default}
minimum = 0.01
maximum = 0.1
about = "a number"
sets = [{sets}]
"""
WALLS = '{ kind = "geom", name = "wall_*", field = "pos", index = 0, offset = 0.03 }'


def table(sets: str = WALLS, name: str = "gap", default: str = "0.02") -> str:
    return TABLE.format(sets=sets, name=name, default=default)


def scene_with(folder: Path, text: str) -> Path:
    path = folder / "bench.xml"
    path.write_text(SCENE, encoding="utf-8")
    path.with_suffix(".toml").write_text(text, encoding="utf-8")
    return path


def refusal(path: str | Path, **values: float) -> str:
    with pytest.raises(hb.SceneError) as caught:
        load_scene(path, "grip", as_is=False, **values)
    message = str(caught.value)
    assert "\n" not in message
    return message


# --- what is set ----------------------------------------------------------------------------------


def test_every_element_that_fits_follows_the_value_and_nothing_else_changes(tmp_path: Path) -> None:
    path = scene_with(tmp_path, table())
    plain, moved = load_scene(path).model, load_scene(path, gap=0.07).model
    for wall in ("wall_0", "wall_1"):
        assert moved.geom(wall).pos[0] == pytest.approx(0.1, abs=1e-15)
        moved.geom(wall).pos[0] = plain.geom(wall).pos[0]
    different = [
        field
        for field in dir(plain)
        if isinstance(getattr(plain, field, None), np.ndarray)
        and not np.array_equal(getattr(plain, field), getattr(moved, field), equal_nan=True)
    ]
    # MuJoCo's boxes around the world's geoms follow the walls
    assert set(different) <= {"bvh_aabb"}


@settings(max_examples=20)
@given(st.floats(0.01, 0.1))
def test_number_is_a_line_of_value(tmp_path_factory: pytest.TempPathFactory, value: float) -> None:
    sets = (
        '{ kind = "joint", name = "slide", field = "stiffness", index = 0, factor = 1000.0 }, '
        '{ kind = "key", name = "home", field = "qpos", index = 0, offset = 0.003, factor = -0.1 },'
        '{ kind = "geom", name = "tool", field = "mass", offset = 0.3, factor = -10.0 }'
    )
    path = scene_with(tmp_path_factory.mktemp("scene"), table(sets))
    value = min(value, 0.0299)  # beyond, the tool would have no mass left
    model = load_scene(path, gap=value).model
    assert model.joint("slide").stiffness[0] == pytest.approx(1000.0 * value, rel=1e-12)
    assert model.key("home").qpos[0] == pytest.approx(0.003 - 0.1 * value, rel=1e-12)
    assert model.body("tool").mass[0] == pytest.approx(0.3 - 10.0 * value, rel=1e-9)


SLIDE = '{ kind = "joint", name = "slide", field = "stiffness", index = 0'


@pytest.mark.parametrize(
    ("values", "stiffness"),
    [({}, 20.0), ({"gap": 0.1}, 90.0), ({"less": 0.01}, 40.0), ({"gap": 0.1, "less": 0.01}, 110.0)],
)
def test_numbers_add_up(tmp_path: Path, values: dict[str, float], stiffness: float) -> None:
    more = table(SLIDE + ", factor = 1000.0 }", default="0.03")
    less = table(SLIDE + ", offset = 20, factor = -1000.0 }", name="less", default="0.03")
    path = scene_with(tmp_path, more + less)
    scene = load_scene(path, "grip", as_is=False, **values)
    assert scene.model.joint("slide").stiffness[0] == pytest.approx(stiffness, rel=1e-12)
    assert scene.parameters == {"gap": 0.03, "less": 0.03} | values


FIELDS = (
    "geom_pos", "geom_size", "geom_friction", "body_pos", "body_mass", "body_inertia", "mesh_vert",
    "dof_frictionloss", "jnt_stiffness",
)  # fmt: skip


@each_parameter
def test_a_shipped_default_gives_the_scene_of_the_file(
    name: str, parameter: scenes.Parameter
) -> None:
    plain, asked = (
        load_scene(name),
        load_scene(name, None, as_is=False, **{parameter.name: parameter.default}),
    )
    assert plain.parameters == asked.parameters
    for field in FIELDS:
        expected = pytest.approx(getattr(plain.model, field), rel=1e-9, abs=1e-12)
        assert getattr(asked.model, field) == expected


@each_parameter
def test_both_ends_of_a_shipped_range_load_and_differ(
    name: str, parameter: scenes.Parameter
) -> None:
    low = load_scene(name, None, as_is=False, **{parameter.name: parameter.minimum})
    high = load_scene(name, None, as_is=False, **{parameter.name: parameter.maximum})
    assert low.parameters[parameter.name] == parameter.minimum
    assert model_digest(low.model) != model_digest(high.model)
    assert parameter.about
    assert parameter.unit in {"", "m", "N", "N m", "N s/m", "kg", "N/m", "N m/rad", "rad", "s"}


@pytest.mark.parametrize("clearance", [0.05e-3, 1e-3])
@pytest.mark.parametrize("name", ["peg_in_hole", "planar_peg"])
def test_clearance_is_left_on_each_side_of_a_hole(name: str, clearance: float) -> None:
    scene = load_scene(name, clearance=clearance, friction=0.17)
    model, data = scene.model, scene.data
    walls = {"east": (0, 1), "west": (0, -1)}
    if name == "peg_in_hole":
        walls |= {"north": (1, 1), "south": (1, -1)}
        # the two between reach from face to face: no slot in the corners
        north, east = model.geom("hole_north"), model.geom("hole_east")
        assert north.size[0] == pytest.approx(0.01 + clearance, abs=1e-12)
        assert east.size[1] == pytest.approx(north.pos[1] + north.size[1], abs=1e-12)
    for wall, (axis, side) in walls.items():
        geom = model.geom(f"hole_{wall}")
        face = side * geom.pos[axis] - geom.size[axis]
        assert face - 0.01 == pytest.approx(clearance, abs=1e-12)
    # 2 µm into the east wall, and deep in the hole
    data.qpos[0] = clearance + 2e-6
    data.qpos[2 if name == "peg_in_hole" else 1] = 0.0 if name == "peg_in_hole" else -0.04
    mujoco.mj_forward(model, data)
    assert [contact.friction[0] for contact in data.contact] == pytest.approx([0.17] * data.ncon)
    assert data.ncon > 0


@pytest.mark.parametrize("length", [0.04, 0.06, 0.11, 0.2])
def test_hole_of_the_planar_peg_is_20_mm_less_deep_than_the_peg_is_long(length: float) -> None:
    model = load_scene("planar_peg", length=length).model
    peg, wall, bottom = (model.geom(n) for n in ("peg", "hole_east", "hole_bottom"))
    assert 2 * peg.size[2] == pytest.approx(length, abs=1e-12)
    assert model.body("peg").mass[0] == pytest.approx(0.1)
    # it starts 10 mm above the mouth, with the grip in its middle
    assert model.body("peg").pos[2] - peg.size[2] == pytest.approx(0.01, abs=1e-12)
    assert wall.pos[2] + wall.size[2] == pytest.approx(0.0, abs=1e-12)
    floor = bottom.pos[2] + bottom.size[2]
    assert floor == pytest.approx(0.02 - length, abs=1e-12)
    assert wall.pos[2] - wall.size[2] == pytest.approx(floor, abs=1e-12)
    assert model.geom("bench").pos[2] == pytest.approx(bottom.pos[2] - bottom.size[2], abs=1e-12)


# --- what is refused ------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [0.0, 4e-6, 1.01e-3, -1e-4, math.nan, math.inf])
def test_a_value_out_of_range_is_told_the_range_and_all_there_is(value: float) -> None:
    message = refusal("peg_in_hole", clearance=value)
    assert f"'clearance' of scene 'peg_in_hole' is {value!r}" in message
    assert "5e-06 to 0.001 m" in message
    assert "friction (0 to 1, default 0.42)" in message
    for wrong in (True, "1e-4", None, [1e-4]):
        assert "must be a number" in refusal("peg_in_hole", clearance=wrong)  # type: ignore[arg-type]


def test_an_unknown_name_is_told_what_exists(tmp_path: Path) -> None:
    message = refusal("peg_in_hole", clearence=1e-4)
    assert "no parameter 'clearence'" in message
    assert "clearance (5e-06 to 0.001 m, default 0.0002)" in message
    path = scene_with(tmp_path, "")
    assert refusal(path, mass=1.0).startswith("scene 'bench' has no parameters, so 'mass' cannot")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[parameters", "cannot read"),
        ("parameters = 3", "table"),
        (table() + "colour = 3", "keys"),
        (table().replace('unit = "m"', ""), "keys"),
        (table(default="0.2"), "minimum <= default <= maximum"),
        (table(default="nan"), "finite"),
        (table(default="true"), "finite"),
        (table(name="grip"), "grip"),
        (table(name="'a gap'"), "Python argument"),
        (table(sets=""), "sets nothing"),
        (table(WALLS.replace("geom", "gear")), "kind must be one of"),
        (table(WALLS.replace("offset", "ofset")), "at most index, offset and factor"),
        (table(WALLS.replace("index = 0", "index = -1")), "index a whole number"),
        (table(WALLS.replace("0.03", "inf")), "finite"),
        (table(WALLS.replace("wall_*", "door")), "it has: 'tool', 'wall_0', 'wall_1'"),
        (table(WALLS.replace('"pos"', '"poss"')), "not a number of the scene"),
        (table(WALLS.replace("index = 0", "index = 3")), "not a number of the scene"),
        (table(WALLS.replace("index = 0, ", "")), "not a number of the scene"),
        (table(WALLS.replace("0.03", "0.031")), "to 0.051 by default"),
        (table(f"{WALLS}, {WALLS}"), "sets pos[0] of geom 'wall_0' twice"),
        (table() + table(name="other"), "'gap' and 'other' together set pos[0] of geom 'wall_0'"),
        (table() + table(name="other"), "to 0.1 by default, where the scene's file has 0.05"),
    ],
)
def test_unfit_parameters_are_refused(tmp_path: Path, text: str, words: str) -> None:
    path = scene_with(tmp_path, text)
    message = refusal(path)
    assert words in message
    assert refusal(path, gap=0.02)


OVERRIDDEN = """<mujoco>
  <asset><mesh name="part" vertex="0 0 0 .02 0 0 0 .02 0 0 0 .02"/></asset>
  <worldbody>
    <geom name="rod" type="capsule" fromto=".1 0 .1 .2 0 .1" size="0.01"/>
    <geom name="tilted" type="box" size=".1 .1 .01" euler="0 20 0"/>
    <geom name="turned" type="box" size=".1 .1 .01" pos="1 0 0" quat="0.02 0 0 0"/>
    <body name="tool"><freejoint/><inertial pos="0 0 0" mass="0.3" diaginertia="1 1 1"/>
      <geom name="tool" size=".02" mass="0.02"/><site name="grip"/></body>
    <body name="lid"><joint name="hinge" damping="0.02" springdamper="0.1 1"/>
      <geom name="lid" type="mesh" mesh="part"/></body>
  </worldbody>
</mujoco>"""


@pytest.mark.parametrize(
    ("kind", "name", "field", "now"),
    [
        ("geom", "tool", "mass", 0.02),
        ("body", "lid", "mass", 0.0),
        ("geom", "rod", "size[1]", 0.0),
        ("geom", "lid", "size[0]", 0.0),
        ("geom", "tilted", "quat[2]", 0.0),
        ("joint", "hinge", "damping[0]", 0.02),
    ],
)
def test_a_number_that_something_else_determines_is_refused_when_it_is_set(
    tmp_path: Path, kind: str, name: str, field: str, now: float
) -> None:
    scene = tmp_path / "scene.xml"
    scene.write_text(OVERRIDDEN)
    bare, _, index = field.rstrip("]").partition("[")
    at = f", index = {index}" if index else ""
    sets = f'{{ kind = "{kind}", name = "{name}", field = "{bare}"{at}, offset = {now - 0.02} }}'
    rod = '{ kind = "geom", name = "rod", field = "size", index = 0, offset = -0.01 }'
    (tmp_path / "scene.toml").write_text(table(f"{sets}, {rod}"))
    words = (
        f"parameter 'gap' sets {field} of {kind} '{name}' to {now + 0.03:g}, which changes nothing"
    )
    with pytest.raises(hb.HapticBridgeError) as refused:
        load_scene(scene, gap=0.05)
    assert str(refused.value).startswith(words)
    assert load_scene(scene, gap=0.02).parameters == {"gap": 0.02}


def test_numbers_that_change_something_only_together_are_set(tmp_path: Path) -> None:
    """A quaternion is normalized: a new w alone, with x = 0, would change nothing."""
    scene = tmp_path / "scene.xml"
    scene.write_text(OVERRIDDEN)
    turned = '{{ kind = "geom", name = "turned", field = "quat", index = {}, offset = {} }}'
    (tmp_path / "scene.toml").write_text(table(f"{turned.format(0, 0)}, {turned.format(1, -0.02)}"))
    quat = load_scene(scene, gap=0.05).model.geom("turned").quat
    assert quat == pytest.approx(np.array([0.05, 0.03, 0.0, 0.0]) / math.hypot(0.05, 0.03))


def test_a_number_that_mujoco_refuses_is_told_by_mujoco(tmp_path: Path) -> None:
    scene = tmp_path / "scene.xml"
    scene.write_text(OVERRIDDEN)
    sets = '{ kind = "geom", name = "rod", field = "pos", index = 0, offset = -0.02 }'
    (tmp_path / "scene.toml").write_text(table(sets))
    with pytest.raises(hb.HapticBridgeError, match="both pos and fromto defined in geom"):
        load_scene(scene, gap=0.05)


def test_a_toml_file_of_somebody_else_is_passed_over(tmp_path: Path) -> None:
    path = scene_with(tmp_path, '[tool.poetry]\nname = "bench"')
    assert load_scene(path).parameters == {}


# --- the command line and the recording -----------------------------------------------------------


def test_words_become_values_and_a_name_comes_once() -> None:
    assert scenes.settings_from(["a=1e-4", "b=-2"]) == {"a": 1e-4, "b": -2.0}
    with pytest.raises(hb.SceneError, match="twice"):
        scenes.settings_from(["a=1", "a=1"])
    for word in ("", "gap", "gap=", "=1", "gap=wide", "grip=1", "gap=1=2"):
        with pytest.raises(hb.SceneError, match="a parameter of the scene and a number"):
            scenes.settings_from([word])


def test_values_are_recorded_and_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "run.mcap"
    words = ["--set", "clearance=0.1e-3", "--set", "friction=0.3", "--fast", "--duration", "4.8"]
    assert main(["run", "peg_in_hole", *words, "--record", str(file)]) == 0
    recording = hb.read_recording(file)
    used = json.loads(recording.meta["scene_parameters"])
    assert used == {"clearance": 0.1e-3, "friction": 0.3, "mass": 0.1}
    report = hb.audit(file)
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")
    # the walls of the recorded model stand where the clearance puts them, and the peg felt them
    scene = compile_recorded(recording)
    assert is_as_recorded(scene, recording)
    assert scene.model.geom("hole_east").pos[0] == pytest.approx(0.0201, abs=1e-12)
    capsys.readouterr()


def test_every_file_of_parameters_in_models_belongs_to_a_scene() -> None:
    folder = scene_path("peg_in_hole").parents[1]
    files = list(folder.glob("*/*.toml"))
    assert {path.stem for path in files} >= {"peg_in_hole", "planar_peg", "round_peg"}
    for path in files:
        assert path.stem == path.parent.name
        assert set(tomllib.loads(path.read_text(encoding="utf-8"))) == {"parameters"}


def test_the_effect_of_a_pattern_is_tried_on_a_few_of_its_elements(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each trial compiles the scene, and a bowl has some two hundred beads with three joints."""
    trials = list[mujoco.MjSpec]()

    def counted(spec: mujoco.MjSpec) -> mujoco.MjSpec:
        trials.append(spec)
        return copy_of(spec)

    monkeypatch.setattr("hapticbridge.scene.parameters.copy_of", counted)
    scene = load_scene("beads", mass=0.001, drag=0.01)
    assert scene.model.nv > 600
    assert len(trials) < 20
