"""A scene's source files and its compiled model."""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import subprocess
import sys
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from audit_cases import recorded
from cli_cases import Called
from hypothesis import given
from hypothesis import strategies as st
from outside_scenes import RICH, mjcf, obj_bytes, png_bytes, scene_file, stl_bytes

import hapticbridge as hb
from hapticbridge.audit import audit
from hapticbridge.errors import SceneError, SceneWarning
from hapticbridge.run.commands import Couple
from hapticbridge.run.description import model_digest
from hapticbridge.scene import load_scene
from hapticbridge.scene.load import plain_model, read_scene
from hapticbridge.scene.source import read_elements

MESHED = """<body name="tool"><freejoint/><geom type="mesh" mesh="m" mass=".1"/>
<site name="grip"/></body>"""


MESH = '<asset><mesh name="m" file="{}"/></asset>'


PART = "<mujocoinclude>{}</mujocoinclude>"
STRIP = "<compiler meshdir='m' strippath='true'/>"
LOW = "<option gravity='0 0 -3'/>"


Layout = dict[str, str | bytes]


URDF = """<robot name="r">
  <mujoco><compiler strippath="false"/></mujoco>
  <link name="base"/>
  <joint name="hinge" type="continuous"><parent link="base"/><child link="arm"/></joint>
  <link name="arm">
    <inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><mesh filename="meshes/a.obj"/></geometry></collision>
  </link>
</robot>"""


LAYOUTS: dict[str, Layout] = {
    "mesh beside": {"main.xml": mjcf(MESH.format("a.stl"), body=MESHED), "a.stl": stl_bytes()},
    "obj and meshdir": {
        "main.xml": mjcf("<compiler meshdir='m'/>", MESH.format("a.obj"), body=MESHED),
        "m/a.obj": obj_bytes(),
    },
    "assetdir for mesh, texture and height field": {
        "main.xml": mjcf(
            "<compiler assetdir='assets'/><asset><texture name='t' type='2d' file='t.png'/>"
            "<hfield name='h' file='h.png' size='1 1 .1 .1'/></asset>" + MESH.format("a.obj"),
            body=MESHED,
            world="<geom type='hfield' hfield='h' pos='0 0 -2'/>",
        ),
        "assets/a.obj": obj_bytes(),
        "assets/t.png": png_bytes(),
        "assets/h.png": png_bytes(90),
    },
    "texturedir and faces of a cube": {
        "main.xml": mjcf(
            "<compiler texturedir='t' meshdir='m'/>",
            "<asset><texture name='c' type='cube' fileright='r.png' fileleft='l.png' "
            "fileup='r.png' filedown='d.png' filefront='r.png' fileback='b.png'/></asset>",
        ),
        **{f"t/{name}.png": png_bytes(number) for number, name in enumerate("rldb")},
    },
    "strippath": {
        "main.xml": mjcf(STRIP, MESH.format("/home/somebody/cad/a.stl"), body=MESHED),
        "m/a.stl": stl_bytes(),
    },
    "nested includes, relative to the main file or to their own": {
        "main.xml": mjcf("<include file='parts/one.xml'/>", body=MESHED),
        "parts/one.xml": PART.format("<include file='deep/two.xml'/>"),
        "parts/deep/two.xml": PART.format("<include file='common.xml'/>" + MESH.format("a.stl")),
        "common.xml": PART.format(LOW),
        "parts/deep/a.stl": stl_bytes(),
    },
    "compiler in one include, mesh in another": {
        "main.xml": mjcf("<include file='mesh.xml'/><include file='inc/c.xml'/>", body=MESHED),
        "mesh.xml": PART.format(MESH.format("a.stl")),
        "inc/c.xml": PART.format("<compiler meshdir='geometry'/>"),
        "geometry/a.stl": stl_bytes(),
        "a.stl": stl_bytes(0.5),
    },
    "attached model with assets of its own": {
        "main.xml": mjcf(
            "<compiler meshdir='mine'/>",
            "<asset><model name='g' file='gripper/g.xml'/><mesh name='m' file='a.stl'/></asset>",
            body=MESHED,
            world="<frame pos='1 0 0'><attach model='g' body='finger' prefix='g_'/></frame>",
        ),
        "mine/a.stl": stl_bytes(),
        "gripper/g.xml": "<mujoco><compiler meshdir='meshes'/><include file='more.xml'/>"
        "<worldbody><body name='finger'><joint/><geom type='mesh' mesh='f' mass='1'/></body>"
        "</worldbody></mujoco>",
        "gripper/more.xml": PART.format("<asset><mesh name='f' file='f.obj'/></asset>"),
        "gripper/meshes/f.obj": obj_bytes(0.02),
    },
    "assets above the scene's folder": {
        "scenes/main.xml": mjcf(
            MESH.format("../shared/a.stl"), "<include file='../common.xml'/>", body=MESHED
        ),
        "shared/a.stl": stl_bytes(),
        "common.xml": PART.format(LOW),
    },
    "out of its folder and back": {
        "scenes/main.xml": mjcf(MESH.format("../scenes/meshes/a.stl"), body=MESHED),
        "scenes/meshes/a.stl": stl_bytes(),
    },
    "comments and names that only MuJoCo's parser accepts": {
        "main.xml": "<!-- a -- b <include file='gone.xml'/> -->\n"
        + mjcf(MESH.format("R&D.stl"), "<include file='a&amp;b.xml'/>", body=MESHED),
        "R&D.stl": stl_bytes(),
        "a&b.xml": PART.format(LOW),
    },
    "spaces, other letters, byte-order mark and declaration": {
        "Zähne und Löcher/main.xml": b"\xef\xbb\xbf<?xml version='1.0'?><!-- first -->"
        + mjcf(MESH.format("größe 1.stl"), body=MESHED).encode(),
        "Zähne und Löcher/größe 1.stl": stl_bytes(),
    },
    "backslashes": {"main.xml": mjcf(MESH.format("m\\a.stl"), body=MESHED), "m/a.stl": stl_bytes()},
    "attached robot in URDF": {
        "main.xml": mjcf(
            "<asset><model name='r' file='robot/r.urdf'/></asset>",
            world="<frame pos='1 0 0'><attach model='r' body='arm' prefix='r_'/></frame>",
        ),
        "robot/r.urdf": URDF,
        "robot/meshes/a.obj": obj_bytes(),
    },
    "soft body from a mesh": {
        "main.xml": mjcf(
            "<compiler meshdir='m'/>",
            world="<body name='b' pos='0 0 1'><flexcomp name='f' type='mesh' file='a.obj' dim='2' "
            "mass='.1' radius='.001'><edge equality='true'/></flexcomp></body>",
        ),
        "m/a.obj": obj_bytes(0.1),
    },
}


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS.keys())
def test_sources_are_every_file_and_rebuild_the_same_model(tmp_path: Path, layout: Layout) -> None:
    for name, content in layout.items():
        scene_file(tmp_path / "original", content, name)
    main = next(name for name in layout if name.endswith("main.xml"))
    # a decoy that nobody names
    scene_file(tmp_path / "original", stl_bytes(0.3), "unused.stl")
    scene = load_scene(tmp_path / "original" / main)
    sources = {source.name: source.data for source in scene.sources}
    assert Path(scene.sources[0].name).name == "main.xml"
    expected = {n: c.encode() if isinstance(c, str) else c for n, c in layout.items()}
    expected = {n: c.replace(b"/home/somebody/cad/", b"") for n, c in expected.items()}
    if "geometry/a.stl" in layout:
        del expected["a.stl"]  # hidden by meshdir
    inner = "Zähne und Löcher/" if main.startswith("Z") else ""
    assert sources == {name.removeprefix(inner): data for name, data in expected.items()}
    for name, data in sources.items():
        scene_file(tmp_path / "rebuilt1" / inner, data, name)
    again = load_scene(tmp_path / "rebuilt1" / inner / scene.sources[0].name)
    assert model_digest(again.model) == model_digest(scene.model)


def test_relative_path_works_everywhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, content in LAYOUTS["assets above the scene's folder"].items():
        scene_file(tmp_path, content, name)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    scene = load_scene(os.path.join("..", "scenes", "main.xml"))  # noqa: PTH118 - as typed
    assert [s.name for s in scene.sources] == ["scenes/main.xml", "shared/a.stl", "common.xml"]


@given(st.binary(max_size=300))
def test_any_bytes_can_be_looked_through_for_elements(data: bytes) -> None:
    for element in read_elements(b"<a x='1'/>\n" + data + b'\n<!-- \n --><b y="2">'):
        assert element.line >= 1


def test_elements_are_read_with_their_lines_and_values() -> None:
    text = b"<a>\n<!-- <x/>\n -- --><b p='1' q = \"a &amp; &lt;b>\"/>\n\n<c:d\n r='2'></c:d></a>"
    found = [(e.tag, e.attributes, e.line) for e in read_elements(text)]
    assert found == [("a", {}, 1), ("b", {"p": "1", "q": "a & <b>"}, 3), ("c:d", {"r": "2"}, 5)]


def test_digest_does_not_depend_on_the_folder(tmp_path: Path) -> None:
    digests = []
    for folder in (tmp_path / "a", tmp_path / "elsewhere" / "b"):
        for name, content in LAYOUTS["obj and meshdir"].items():
            scene_file(folder, content, name)
        digests.append(model_digest(load_scene(folder / "main.xml").model))
    assert digests[0] == digests[1]
    path = scene_file(tmp_path, RICH)
    assert model_digest(load_scene(path).model) == model_digest(load_scene(path).model)


def test_digest_changes_with_every_number_of_a_model_but_the_names_of_its_files(
    tmp_path: Path,
) -> None:
    for name, content in LAYOUTS["obj and meshdir"].items():
        scene_file(tmp_path, content, name)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "main.xml"))
    seen = {model_digest(model)}
    fields = [each for each in dir(model) if not each.startswith("_")]
    arrays = [each for each in fields if isinstance(getattr(model, each), np.ndarray)]
    for field in arrays:
        values = getattr(model, field)
        if not values.size or not values.flags.writeable:
            continue
        kept, values.flat[0] = values.flat[0].copy(), not values.flat[0]
        is_seen = model_digest(model) in seen
        assert is_seen == field.endswith("_pathadr"), field
        values.flat[0] = kept
    model.opt.o_margin = 0.5
    assert model_digest(model) not in seen


@pytest.mark.parametrize("compiler", ["", "<compiler meshdir='meshes'/>"])
@pytest.mark.parametrize("name", ["set/main.xml", "./set/main.xml", "../{}/set/main.xml"])
def test_a_parts_own_files_are_found_whatever_path_names_the_scene(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, compiler: str
) -> None:
    part = compiler + MESH.format("meshes/a.stl")  # relative to the part, as PyMJCF reads it
    scene_file(tmp_path, mjcf("<include file='parts/arm.xml'/>", body=MESHED), "set/main.xml")
    scene_file(tmp_path, PART.format(part), "set/parts/arm.xml")
    scene_file(tmp_path, stl_bytes(), "set/parts/meshes/a.stl")
    monkeypatch.chdir(tmp_path)
    assert load_scene(name.format(tmp_path.name)).model.nmesh == 1


OUTSIDE: Layout = {
    "scenes/main.xml": mjcf(
        "<!-- as <mesh file='/gone/old.stl'/> and <include file='../../../../far.xml'/> were -->",
        "<compiler meshdir='{0}/kept/meshes' texturedir='{0}/kept/looks'/>",
        "<include file='{0}/kept/parts/common.xml'/>",
        "<asset><model name='r' file='{0}/kept/robot/r.xml'/><hfield name='h' "
        "file='{0}/kept/meshes/h.png' size='1 1 1 1'/><texture name='t' type='cube' "
        "fileright='{0}/kept/looks/t.png' fileleft='t.png'/></asset>",
        MESH.format("a.stl"),
        body=MESHED,
        world="<frame pos='1 0 0'><attach model='r' body='arm' prefix='r_'/></frame>",
    ),
    "kept/meshes/a.stl": stl_bytes(),
    "kept/meshes/h.png": png_bytes(),
    "kept/looks/t.png": png_bytes(),
    "kept/parts/common.xml": PART.format(LOW),
    "kept/robot/r.xml": "<mujoco><asset><mesh name='m' file='{0}/kept/robot/deep/m.obj'/></asset>"
    "<worldbody><body name='arm'><joint/><geom type='mesh' mesh='m' mass='1'/></body></worldbody>"
    "</mujoco>",
    "kept/robot/deep/m.obj": obj_bytes(),
}
"""Names as programs write them that know only absolute paths, and names that lead nowhere."""


STEPPED: Layout = {
    "scenes/main.xml": mjcf(
        "<compiler meshdir='meshes' texturedir='looks'/>",
        "<asset><hfield name='h' file='../heights/h.png' size='1 1 1 1'/>"
        "<texture name='t' type='cube' file='../heights/h.png'/></asset>",
        MESH.format("../parts/a.stl"),
        body=MESHED,
    ),
    "scenes/meshes/b.stl": stl_bytes(),
    "scenes/parts/a.stl": stl_bytes(),
    "scenes/heights/h.png": png_bytes(),
    "scenes/looks/t.png": png_bytes(),
}
"""Names with a step out of a folder of assets that stay in the folder of the scene."""


@pytest.mark.parametrize("start", ["a file", "a relative name", "a specification"])
@pytest.mark.parametrize("layout", [OUTSIDE, STEPPED], ids=["outside", "stepped"])
def test_names_that_lead_out_of_a_folder_are_recorded_as_names_in_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, layout: Layout, start: str
) -> None:
    folder = tmp_path / "user"
    for name, content in layout.items():
        text = content.format(folder) if isinstance(content, str) else content
        scene_file(folder, text, name)
    monkeypatch.chdir(folder)
    path = folder / "scenes/main.xml"
    scene = load_scene(
        mujoco.MjSpec.from_file(str(path))
        if start == "a specification"
        else path.relative_to(folder)
        if start == "a relative name"
        else path
    )
    recording = tmp_path / "run.mcap"
    recorded(recording, scene, duration=0.1)
    for source in scene.sources:
        assert str(tmp_path).encode() not in source.data, source.name
    shutil.rmtree(folder)
    report = audit(recording)
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")


def _heavier(model: mujoco.MjModel) -> None:
    model.body("tool").mass = 0.2


def _with_other_friction(model: mujoco.MjModel) -> None:
    model.opt.impratio = 3.0  # replaced by the run, and recorded as a change to the file


@pytest.mark.parametrize("change", [_heavier, _with_other_friction])
def test_a_run_whose_recording_could_not_be_audited_says_so_at_its_start(
    tmp_path: Path, change: Callable[[mujoco.MjModel], None]
) -> None:
    scene = load_scene(scene_file(tmp_path, mjcf()))
    change(scene.model)
    with pytest.warns(UserWarning, match="the recording could not be audited: "):
        recorded(tmp_path / "run.mcap", scene, duration=0.1)
    assert audit(tmp_path / "run.mcap").verdict == "invalid"


def _doubled_gravity(model: mujoco.MjModel) -> None:
    model.opt.gravity[2] *= 2.0


def _heavier_by_half(model: mujoco.MjModel) -> None:
    model.body("tool").mass *= 1.5


def _stronger_motor(model: mujoco.MjModel) -> None:
    model.actuator("m").gainprm[0] = 2.0


TURNED = """<body pos="1 0 0"><joint name="j"/><geom size=".1" mass="1"/></body>"""
MOTOR = '<actuator><motor name="m" joint="j" ctrlrange="0 .1"/></actuator>'


@pytest.mark.parametrize(
    ("change", "fields"),
    [
        (_doubled_gravity, "opt.gravity"),
        (_heavier_by_half, "body_mass"),
        (_stronger_motor, "actuator_gainprm"),
    ],
)
@pytest.mark.parametrize("method", ["implicit", "lossless"])
def test_a_model_changed_in_mid_run_is_named_by_the_summary_as_by_the_audit(
    tmp_path: Path, change: Callable[[mujoco.MjModel], None], fields: str, method: str
) -> None:
    scene = load_scene(scene_file(tmp_path, mjcf(MOTOR, world=TURNED)))
    path, options = tmp_path / "run.mcap", hb.BridgeOptions(method=method)
    with hb.Bridge(
        scene, "simulated", clock=hb.SimulatedClock(), recording=path, options=options
    ) as bridge:
        bridge.set_input(ctrl={"m": 0.1})
        bridge.command(Couple(stiffness=300.0, damping=0.6))
        summary = bridge.run(0.05)
        assert summary.changed == ""
        assert "set_input" not in str(summary)
        change(scene.model)
        summary = bridge.run(0.1)
    words = f"{fields} of the scene was changed during the run other than by set_input"
    assert (summary.changed, summary.verdict) == (words, "unverified")
    assert f"unverified: {words}: no recording can repeat that" in str(summary)
    report = audit(path)
    assert report.verdict == "invalid"
    assert report.sentence.endswith(f": {words}")
    assert "recording was changed" not in report.sentence


def _pushed(bridge: hb.Bridge) -> None:
    bridge.scene.data.qvel[-1] = 1.0


def _driven(bridge: hb.Bridge) -> None:
    bridge.scene.data.ctrl[0] = 0.1


def _pulled(bridge: hb.Bridge) -> None:
    bridge.scene.data.xfrc_applied[1, 2] = 1.0


def _as_it_should_be(bridge: hb.Bridge) -> None:
    bridge.set_input(ctrl={"m": 0.1})
    bridge.scene.data.mocap_pos.fill(0.3)  # of the bridge's own handle, which it places itself


WRITES = {
    "data.qvel": _pushed,
    "data.ctrl": _driven,
    "data.xfrc_applied": _pulled,
    "": _as_it_should_be,
}
"""Writes of a program by the field that is changed past the recording."""


@pytest.mark.parametrize("is_between", [False, True])
@pytest.mark.parametrize("fields", WRITES)
@pytest.mark.parametrize("options", [{}, {"scene_rate": 250.0}])
def test_a_state_written_in_mid_run_is_named_by_the_summary_as_by_the_audit(
    tmp_path: Path, fields: str, options: dict[str, Any], *, is_between: bool
) -> None:
    scene = load_scene(scene_file(tmp_path, mjcf(MOTOR, world=TURNED)))
    path, write = tmp_path / "run.mcap", WRITES[fields]
    with hb.Bridge(
        scene, "simulated", clock=hb.SimulatedClock(), recording=path, **options
    ) as bridge:
        bridge.run(0.05, lambda _: None)
        if is_between:
            write(bridge)
        summary = bridge.run(0.1, lambda tick: None if is_between or tick != 60 else write(bridge))
    report = audit(path)
    words = f"{fields} of the scene was changed during the run other than by set_input"
    assert summary.changed == (words if fields else "")
    assert (summary.verdict, report.verdict) == (
        ("unverified", "invalid") if fields else ("passive", "passive")
    )
    assert report.sentence.endswith(f": {words}") or not fields


def test_a_trip_behind_a_written_state_is_told_of_the_write_and_of_no_other_cause(
    call: Called, tmp_path: Path
) -> None:
    path = tmp_path / "run.mcap"
    with hb.Bridge("point_mass", clock=hb.SimulatedClock(), recording=path) as bridge:

        def push(tick: int) -> None:
            if tick > 200:
                bridge.scene.data.qvel[0] = 0.6

        with pytest.raises(hb.SafetyTrip) as caught:
            bridge.run(0.6, push)
    words = "data.qvel of the scene was changed during the run other than by set_input, and no"
    (told,) = caught.value.__notes__
    assert told.startswith(words)
    _, out, _ = call("audit", path)
    assert f"what to change: {words}" in out
    assert "itself created" not in out


def test_a_scene_painted_in_mid_run_is_the_recorded_one(tmp_path: Path) -> None:
    scene, path = load_scene("point_mass"), tmp_path / "run.mcap"
    with hb.Bridge(scene, clock=hb.SimulatedClock(), recording=path) as bridge:
        bridge.run(0.05, lambda _: scene.model.geom_rgba.fill(0.5))
        assert (bridge.summary().changed, bridge.summary().verdict) == ("", "passive")
    assert audit(path).resimulation == "bit for bit"


def test_a_state_that_a_run_leaves_for_its_start_is_told(tmp_path: Path) -> None:
    scene = load_scene(scene_file(tmp_path, mjcf()))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        recorded(tmp_path / "run.mcap", scene, duration=0.1)
        recorded(tmp_path / "again.mcap", scene, duration=0.1)
    scene.reset()
    scene.data.qpos[2] += 0.01
    with pytest.warns(SceneWarning, match=r"data.qpos is not that of .*'home'"):
        recorded(tmp_path / "moved.mcap", scene, duration=0.1)


@pytest.mark.parametrize("most", [1e6, 1e8])
def test_a_scene_that_is_too_large_for_a_confined_audit_is_said_to_need_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, most: float
) -> None:
    monkeypatch.setattr("hapticbridge.run.unpacked.LARGE", most)
    text = mjcf('<asset><texture name="t" builtin="flat" width="1024" height="1024"/></asset>')
    scene = load_scene(scene_file(tmp_path, text))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        recorded(tmp_path / "run.mcap", scene, duration=0.1)
    assert any("--in-process" in str(each.message) for each in said) == (most == 1e6)


@pytest.mark.parametrize("place", ["TemporaryDirectory", "Path.write_bytes"])
def test_no_room_for_the_copy_is_said_and_the_run_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(f"hapticbridge.run.unpacked.{place}", full)
    with pytest.warns(UserWarning, match="can be audited was not tried: .*No space left on device"):
        recorded(tmp_path / "run.mcap", load_scene("point_mass"), duration=0.1)
    monkeypatch.undo()
    assert audit(tmp_path / "run.mcap").resimulation == "bit for bit"


@pytest.mark.parametrize("name", ["peg_in_hole", "bench_pliers", "screwdriver"])
def test_a_run_whose_recording_can_be_audited_says_nothing(tmp_path: Path, name: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        recorded(tmp_path / "run.mcap", load_scene(name), duration=0.1)
    assert audit(tmp_path / "run.mcap").resimulation == "bit for bit"


def test_a_zipped_scene_with_a_mesh_is_audited(tmp_path: Path) -> None:
    path = tmp_path / "scene.mjz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("scene.xml", mjcf(MESH.format("a.stl"), body=MESHED))
        archive.writestr("a.stl", stl_bytes())
    recorded(tmp_path / "run.mcap", load_scene(path), duration=0.1)
    assert audit(tmp_path / "run.mcap").resimulation == "bit for bit"


def built_spec() -> mujoco.MjSpec:
    """A tool with numbers of more digits than MuJoCo writes, and a mesh that is in no file."""
    spec = mujoco.MjSpec()
    spec.modelname = "built"
    spec.assets = {"part.obj": obj_bytes()}
    spec.add_mesh(name="part", file="part.obj")
    tool = spec.worldbody.add_body(name="tool")
    tool.add_freejoint()
    tool.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="part", mass=0.1234567890123)
    tool.add_site(name="grip")
    return spec


def test_a_specification_runs_as_it_is_written_and_is_left_alone() -> None:
    spec = built_spec()
    scene = load_scene(spec)
    assert (scene.name, scene.model.body("tool").mass[0]) == ("built", 0.123457)
    assert not spec.actuators and spec.body("tool") is not None
    with pytest.raises(SceneError, match="a specification has no parameters, and 'clearance'"):
        load_scene(spec, clearance=1e-4)


def test_sources_of_a_specification_are_its_written_form_and_its_assets() -> None:
    scene = load_scene(built_spec())
    files = {source.name: source.data for source in scene.sources}
    assert list(files) == ["built.xml", "part.obj"]
    assert files["part.obj"] == obj_bytes()
    again = mujoco.MjSpec.from_string(files["built.xml"].decode(), assets=files).compile()
    assert again.body("tool").mass[0] == pytest.approx(0.1234567890123, rel=1e-5)


@pytest.mark.parametrize("is_explicit", [True, False])
@pytest.mark.parametrize("inertia", ["inertia", "fullinertia"])
def test_an_inertia_that_a_program_set_is_kept(inertia: str, *, is_explicit: bool) -> None:
    """Also beside geoms where it is explicit, as MuJoCo takes it."""
    spec = built_spec()
    values = (4e-3, 5e-3, 6e-3) if inertia == "inertia" else (4e-3, 5e-3, 6e-3, 1e-4, 0.0, 0.0)
    for name, geoms in (("bare", 0), ("with a geom", 1)):
        load = spec.body("tool").add_body(name=name, pos=[0.0, 0.0, 0.1])
        load.mass, load.explicitinertial = 1.5, is_explicit
        setattr(load, inertia, values)
        for _ in range(geoms):
            load.add_geom(size=[0.02, 0.0, 0.0], mass=0.1)
    own, model = spec.copy().compile(), load_scene(spec).model
    count = own.nbody
    assert own.body_mass.sum() == pytest.approx(0.12346 + 1.5 + (1.5 if is_explicit else 0.1), 1e-4)
    for field in ("body_mass", "body_inertia", "body_ipos", "body_iquat"):
        expected = pytest.approx(getattr(own, field), rel=1e-4, abs=1e-7)
        assert getattr(model, field)[:count] == expected, field


def test_a_specification_with_a_number_that_no_file_holds_is_refused() -> None:
    for place, value in (("key_qpos[0, 2]", np.nan), ("body_pos[1, 2]", np.inf)):
        spec = built_spec()
        if place.startswith("key"):
            spec.add_key(name="home", qpos=[0.0, 0.0, value, 1.0, 0.0, 0.0, 0.0])
        else:
            spec.body("tool").pos = [0.0, 0.0, value]
        with pytest.raises(SceneError) as refused:
            load_scene(spec)
        assert str(refused.value).startswith(f"{place} of the specification is {value}")
    spec = built_spec()
    spec.geoms[0].friction = [np.nan, 1.0, 1.0]
    with pytest.raises(SceneError, match=r"^geom_friction\[0, 0\] of the specification is nan"):
        load_scene(spec)
    spec = built_spec()
    spec.add_key(name="home", qpos=[0.0, 0.0, 0.5, 1.0, 0.0, 0.0, 0.0])
    assert load_scene(spec).data.qpos[2] == 0.5


def test_sources_of_a_specification_from_a_file_have_the_files_assets(tmp_path: Path) -> None:
    (tmp_path / "part.obj").write_bytes(obj_bytes())
    path = scene_file(tmp_path, mjcf(MESH.format("part.obj"), MESHED))
    scene = load_scene(mujoco.MjSpec.from_file(str(path)))
    assert [source.name for source in scene.sources][1:] == ["part.obj"]


def test_a_run_of_a_specification_is_simulated_again_bit_for_bit(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    recorded(path, load_scene(built_spec()), duration=0.1)
    report = audit(path)
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")


@pytest.mark.parametrize(
    ("folder", "file", "held"),
    [
        ("sub", "part.obj", "part.obj"),
        ("sub", "part.obj", "sub/part.obj"),
        ("sub", "inner/part.obj", "inner/part.obj"),
        ("", "inner/part.obj", "PART.obj"),
        ("../up", "part.obj", "part.obj"),
        ("/anywhere", "part.obj", "part.obj"),
        ("", "../part.obj", "../part.obj"),
        ("", "/anywhere/part.obj", "/anywhere/part.obj"),
        ("sub", r"C:\anywhere\part.obj", "part.obj"),
        (r"C:\anywhere", "part.obj", "part.obj"),
    ],
)
def test_an_asset_in_memory_is_recorded_where_its_element_names_it(
    folder: str, file: str, held: str, tmp_path: Path
) -> None:
    spec = mujoco.MjSpec.from_string(
        mjcf(f"<compiler meshdir='{folder}'/>", MESH.format(file), body=MESHED),
        assets={held: obj_bytes(), "spare.obj": b""},
    )
    path = tmp_path / "run.mcap"
    recorded(path, scene := load_scene(spec), duration=0.02)
    assert audit(path).resimulation == "bit for bit"
    assert len(scene.sources) == 2


@pytest.mark.parametrize("held", ["part.obj", "sub/part.obj", "elsewhere/part.obj"])
@pytest.mark.parametrize("folder", ["", "sub"])
def test_an_asset_in_memory_comes_before_a_file(folder: str, held: str, tmp_path: Path) -> None:
    scene_file(tmp_path, obj_bytes(0.02), f"{folder or '.'}/part.obj")
    text = mjcf(f"<compiler meshdir='{folder}'/>", MESH.format("part.obj"), body=MESHED)
    with contextlib.chdir(tmp_path):
        spec = mujoco.MjSpec.from_string(text, assets={held: obj_bytes(0.01)})
        ours, own = load_scene(spec).model, spec.copy().compile()
    assert ours.mesh_pos[0] == pytest.approx(own.mesh_pos[0], rel=1e-5)
    assert own.mesh_pos[0] == pytest.approx(0.01 / 4.0, rel=1e-5)


def test_assets_whose_names_end_alike_are_told_apart_or_refused() -> None:
    part = "<mesh name='{0}' file='{0}/part.obj'/>"
    geoms = "".join(f"<geom type='mesh' mesh='{name}' mass='1'/>" for name in ("a", "b"))
    body = f"<body name='tool'><freejoint/>{geoms}<site name='grip'/></body>"
    text = mjcf(f"<asset>{part.format('a')}{part.format('b')}</asset>", body=body)
    assets = {"a/part.obj": obj_bytes(), "b/part.obj": obj_bytes(0.02)}
    model = load_scene(mujoco.MjSpec.from_string(text, assets=assets)).model
    assert model.mesh_pos[1] == pytest.approx(2.0 * model.mesh_pos[0])
    outer = {f"/{name}": data for name, data in assets.items()}
    spec = mujoco.MjSpec.from_string(text.replace("file='", "file='/"), assets=outer)
    with pytest.raises(SceneError, match=r"Error opening file 'part\.obj'"):
        load_scene(spec)


@pytest.mark.parametrize("name", ["a\\b", "x" * 300, "部" * 100])
def test_a_name_that_no_file_can_have_does_not_keep_a_run_from_its_audit(
    name: str, tmp_path: Path
) -> None:
    spec = built_spec()
    spec.modelname = name
    path = tmp_path / "run.mcap"
    recorded(path, load_scene(spec), duration=0.02)
    assert audit(path).resimulation == "bit for bit"


# Warnings of MuJoCo as it reads

LIGHT = """<mujoco><option gravity="0 0 -1.62"/><worldbody><body name="b"><geom size=".1"/></body>
</worldbody></mujoco>"""
ATTACHING = """<mujoco><asset><model name="part" file="part.xml"/></asset><worldbody>
<body name="tool"><freejoint/><geom size=".02"/><attach model="part" body="b" prefix="p_"/></body>
</worldbody></mujoco>"""


def test_an_option_that_a_part_loses_is_told_with_both_values(tmp_path: Path) -> None:
    (tmp_path / "part.xml").write_text(LIGHT)
    (tmp_path / "scene.xml").write_text(ATTACHING)
    lost = "parent has 0 0 -9.81 .default., child has 0 0 -1.62, keeping parent value"
    with pytest.warns(UserWarning, match=f"^MuJoCo: Attach conflict .*; gravity: {lost}$"):
        scene = load_scene(tmp_path / "scene.xml", grip="tool")
    assert scene.model.opt.gravity[2] == -9.81


def test_a_part_that_loses_nothing_is_not_told(tmp_path: Path) -> None:
    (tmp_path / "part.xml").write_text(LIGHT.replace("-1.62", "-9.81"))
    (tmp_path / "scene.xml").write_text(ATTACHING)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_scene(tmp_path / "scene.xml", grip="tool")


def test_a_composite_is_told_with_what_makes_it_now(tmp_path: Path) -> None:
    composite = '<composite type="grid" count="3 3 1" spacing=".1"/>'
    path = scene_file(tmp_path, mjcf(body=composite))
    with pytest.raises(SceneError, match=r"'composite', line \d+\): MuJoCo has none any more; <fl"):
        read_scene(path)


# What MuJoCo loses as it copies

DANGLING = {
    "<actuator><motor joint='none'/></actuator>": "unknown transmission target 'none'",
    "<equality><weld body1='none'/></equality>": "unknown element 'none' in equality constraint",
    "<contact><exclude body1='tool' body2='none'/></contact>": "body 'none' not found in bodypair",
    "<contact><pair geom1='tip' geom2='none'/></contact>": "geom 'none' not found in collision",
    "<sensor><jointpos joint='none'/></sensor>": "unrecognized name 'none' of sensorized object",
    "<tendon><fixed name='t'><joint joint='none' coef='1'/></fixed></tendon>": "joint 'none' not",
    "<custom><tuple name='u'><element objtype='body' objname='none'/></tuple></custom>": "'none'",
}
TIPPED = "<body name='tool'><freejoint/><geom name='tip' size='.02'/><site name='grip'/></body>"


@pytest.mark.parametrize("section", DANGLING)
def test_an_element_that_names_what_the_scene_lacks_is_refused_and_not_dropped(
    section: str, tmp_path: Path
) -> None:
    path = scene_file(tmp_path, mjcf(section, body=TIPPED))
    for source in (path, mujoco.MjSpec.from_file(str(path))):
        with pytest.raises(SceneError, match=f"^cannot compile scene .*{DANGLING[section]}"):
            load_scene(source)
    with pytest.raises(SceneError, match=DANGLING[section]):
        plain_model(read_scene(path))
    path.write_text(path.read_text().replace("none", "other"))
    others = "<body name='other'><joint name='other'/><geom name='other' size='.1'/></body>"
    path.write_text(path.read_text().replace("</worldbody>", others + "</worldbody>"))
    assert load_scene(path).model.nbody > 2


def test_a_part_with_a_keyframe_that_is_attached_twice_is_refused(tmp_path: Path) -> None:
    """The command is a process of its own: a null copy would end this one."""
    arm = "<body name='arm'><joint axis='0 0 1'/><geom size='.02' pos='.1 0 0'/></body>"
    base = "<body name='base'><freejoint/><geom size='.1'/>{}</body>"
    held = base.format("<attach model='a' body='arm' prefix='a/'/>")
    both = "".join(f"<attach model='b' body='base' prefix='{n}/'/>" for n in (1, 2))
    part = "<asset><model name='{0}' file='{0}.xml'/></asset>"
    keyed = mjcf("<keyframe><key name='home' qpos='0'/></keyframe>", body=arm)
    scene_file(tmp_path, keyed, "a.xml")
    scene_file(tmp_path, mjcf(part.format("a"), body=held), "b.xml")
    path = scene_file(tmp_path, mjcf(part.format("b"), body=both))
    command = [sys.executable, "-m", "hapticbridge", "check", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].endswith("repeated name 'a/home' in key")


# Bounds on what a scene may name and take


def special(folder: Path, kind: str) -> Path:
    """Returns a name that leads to something else than a file of the scene."""
    path = folder / "part"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as made, contextlib.chdir(folder):
            made.bind("part")
    elif kind == "device":
        path.symlink_to("/dev/zero")
    else:
        (folder.parent / "secret").write_bytes(stl_bytes())
        path.symlink_to(folder.parent / "secret")
    return path


NAMING = {
    "mesh": mjcf(MESH.format("part"), body=MESHED),
    "texture": mjcf("<asset><texture name='t' type='2d' file='part'/></asset>"),
    "include": mjcf("<include file='part'/>"),
}


@pytest.mark.parametrize("element", NAMING)
@pytest.mark.parametrize("kind", ["pipe", "socket", "device", "link"])
def test_what_is_no_file_of_the_scene_is_refused_by_name_before_it_is_opened(
    element: str, kind: str, tmp_path: Path
) -> None:
    folder = tmp_path / "scene"
    folder.mkdir()
    special(folder, kind)
    (folder / "main.xml").write_text(NAMING[element], encoding="utf-8")
    with pytest.raises(SceneError, match=rf"names the {kind} '.*/part'"):
        load_scene(folder / "main.xml")


def test_a_name_that_is_not_text_is_refused_in_a_sentence(tmp_path: Path) -> None:
    path = Path(os.fsdecode(os.fsencode(tmp_path) + b"/n\xff.xml"))
    path.write_text(mjcf(MESHED.replace('type="mesh" mesh="m"', 'size="0.01"')))
    with pytest.raises(SceneError, match="MuJoCo needs a name in UTF-8"):
        load_scene(path)
    load_scene(path.rename(tmp_path / "n.xml"))


def test_a_locale_without_utf_8_is_the_reason_why_a_name_cannot_be_read(tmp_path: Path) -> None:
    path = scene_file(tmp_path, mjcf()).rename(tmp_path / "bäll.xml")
    command = [sys.executable, "-m", "hapticbridge", "check", str(path)]
    environment = {**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    done = subprocess.run(command, env=environment, capture_output=True, check=False)
    assert done.returncode == 2
    assert b"Python reads names as ascii here; set PYTHONUTF8=1" in done.stderr


def test_links_within_a_scene_and_its_repository_are_followed(tmp_path: Path) -> None:
    scene = tmp_path / "repository" / "scenes" / "peg"
    scene.mkdir(parents=True)
    (scene / "main.xml").write_text(NAMING["mesh"], encoding="utf-8")
    (tmp_path / "repository" / "peg.stl").write_bytes(stl_bytes())
    (scene / "part").symlink_to(tmp_path / "repository" / "peg.stl")
    with pytest.raises(SceneError, match="names the link"):
        load_scene(scene / "main.xml")
    (tmp_path / "repository" / ".git").mkdir()
    with pytest.raises(SceneError, match=r"[Uu]nknown|extension|decode|load"):
        load_scene(scene / "main.xml")  # a mesh needs an ending


GRID = '<replicate count="60" offset="0 0 1">'


@pytest.mark.parametrize("command", ["run", "check", "scenes"])
def test_a_scene_that_compiles_too_long_or_takes_too_much_ends_in_a_sentence(
    command: str, tmp_path: Path
) -> None:
    nest = f"{3 * GRID}<geom size='.1'/>{3 * '</replicate>'}"
    (tmp_path / "long.xml").write_text(mjcf(world=nest))
    texture = '<texture name="t" builtin="flat" width="30000" height="30000"/>'
    (tmp_path / "large.xml").write_text(mjcf(f"<asset>{texture}</asset>"))
    program = (
        "import sys; from hapticbridge import confinement\n"
        "from hapticbridge.cli.main import main\n"
        "confinement.PATIENCE_HERE = float(sys.argv.pop())\n"
        "confinement.machine_memory = lambda: 1 << 30\n"
        "sys.exit(main())\n"
    )
    for name, patience, words in (
        ("long", 0.5, "takes more than 0.5 s to compile"),
        ("large", 60.0, "memory"),
    ):
        options = ["--fast", "--duration", "0.1"] if command == "run" else []
        done = subprocess.run(
            [
                *(sys.executable, "-c", program, command),
                *(str(tmp_path / f"{name}.xml"), *options, str(patience)),
            ],
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
        assert (done.returncode, "Traceback" in done.stderr) == (2, False), done.stderr
        assert words in " ".join(done.stderr.split())


def attached_spec(folder: Path) -> mujoco.MjSpec:
    """Returns a scene with two parts from folders of their own, whose meshes have one name."""
    for name, size in (("main", 1.0), ("left", 2.0), ("right", 3.0)):
        (folder / name / "meshes").mkdir(parents=True)
        (folder / name / "meshes" / "part.obj").write_bytes(obj_bytes(size))
        (folder / name / f"{name}.xml").write_text(
            f"<mujoco model='{name}'><compiler meshdir='meshes'/>"
            "<asset><mesh name='part' file='part.obj'/></asset><worldbody>"
            f"<body name='{name}'><geom type='mesh' mesh='part'/><site name='grip'/></body>"
            "</worldbody></mujoco>"
        )
    whole, *parts = (
        mujoco.MjSpec.from_file(str(folder / name / f"{name}.xml"))
        for name in ("main", "left", "right")
    )
    for place, part in enumerate(parts):
        frame = whole.worldbody.add_frame(pos=[0, 0, 1 + place])
        whole.attach(part, prefix=f"{part.modelname}_", frame=frame)
        whole.body(f"{part.modelname}_{part.modelname}").add_freejoint()
    return whole


def test_parts_of_a_specification_keep_the_assets_of_their_own_folders(tmp_path: Path) -> None:
    whole = attached_spec(tmp_path)
    scene, own = load_scene(whole, grip="left_grip"), whole.copy().compile()
    assert [mesh.file for mesh in whole.meshes] == ["part.obj"] * 3  # left alone
    assert np.array_equal(scene.model.mesh_vert, own.mesh_vert)
    assert len({mesh.tobytes() for mesh in np.split(own.mesh_vert, 3)}) == 3
    names = [source.name.partition("/")[2] for source in scene.sources]
    assert names[0] == "main/main.xml"  # in the folder above, so that it may climb out of two
    assert set(names[1:]) == {f"{name}/meshes/part.obj" for name in ("main", "left", "right")}
    file = tmp_path / "run.mcap"
    recorded(file, scene, duration=0.05)
    assert audit(file).resimulation == "bit for bit"


def test_a_specification_that_mujoco_writes_wrongly_is_told_so() -> None:
    """It compiles, but its file names the default class of the part and its own alike."""
    text = """<mujoco><default><default class="steel"><geom density="{}"/></default></default>
        <worldbody><body name="tool"><freejoint/><geom class="steel" size=".1"/><site name="grip"/>
        </body></worldbody></mujoco>"""
    whole = mujoco.MjSpec.from_string(text.format(8000).replace("tool", "base").replace("grip", ""))
    part = mujoco.MjSpec.from_string(text.format(7000))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # MuJoCo's own, of an empty prefix
        whole.worldbody.add_frame().attach_body(part.body("tool"), "", "")
        assert whole.copy().compile().nbody == 3
        with pytest.raises(SceneError, match=r"repeated default class name.* attach the part with"):
            load_scene(whole)
