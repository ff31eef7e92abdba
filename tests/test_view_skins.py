"""Materials on the page: the picture that MuJoCo's own renderer shows, pixel by pixel."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from hapticbridge.film import RENDERERS

pytest.importorskip("viser", reason="needs the extra 'view'")

import trimesh

from hapticbridge.view.props import Prop, props_of

Array = NDArray[np.float64]

SIDE = 80
"""Pixels of a picture; it shows 0.3 m, from 5 m away."""

APART = np.array([0.7, 1.1, 1.3])
"""In m, from one geom to the next: none is before another from any side."""

VIEWS = {
    "above": ("0 0 5", "1 0 0 0 1 0"),
    "below": ("0 0 -5", "-1 0 0 0 1 0"),
    "east": ("5 0 0", "0 1 0 0 0 1"),
    "west": ("-5 0 0", "0 -1 0 0 0 1"),
    "north": ("0 5 0", "-1 0 0 0 0 1"),
    "south": ("0 -5 0", "1 0 0 0 0 1"),
    "aside": ("2.8 -2.9 2.8", "0.719 0.695 0 -0.393 0.407 0.825"),
}

SCENE = """<mujoco>
  <visual><headlight ambient="1 1 1" diffuse="0 0 0" specular="0 0 0"/></visual>
  <statistic extent="0.3" center="0 0 0"/>
  <visual><quality offsamples="0"/></visual>
  <asset>
    <texture name="flat" type="2d" file="flat.png"/>
    <texture name="cube" type="cube" file="cube.png" gridsize="6 1" gridlayout="RLUDFB"/>
    <hfield name="hills" nrow="5" ncol="4" size=".1 .05 .06 .03"
      elevation="0 1 2 0  3 5 4 1  2 6 5 3  0 1 4 2  1 0 2 1"/>
    <mesh name="wedge" vertex="0 0 0  .2 0 0  0 .2 0  0 0 .2  .2 .2 .1"/>
    <mesh name="own" vertex="-.1 -.1 0  .1 -.1 0  -.1 .1 0  .05 0 .1"
      texcoord="0 0 .9 0 0 .8 .5 .5" face="0 2 1  0 1 3  1 2 3  2 0 3"/>
    {materials}
  </asset>
  <worldbody>{geoms}</worldbody>
</mujoco>"""

SHAPES = {
    "plane": 'type="plane" size=".1 .05 .01"',
    "endless": 'type="plane" size="0 0 .01"',
    "box": 'type="box" size=".1 .05 .08"',
    "sphere": 'type="sphere" size=".1"',
    "ellipsoid": 'type="ellipsoid" size=".1 .05 .08"',
    "cylinder": 'type="cylinder" size=".08 .06"',
    "capsule": 'type="capsule" size=".06 .05"',
    "mesh": 'type="mesh" mesh="wedge"',
    "height field": 'type="hfield" hfield="hills"',
    "mesh with its own": 'type="mesh" mesh="own"',
}

MATERIALS = {
    "once": 'texture="flat"',
    "repeated": 'texture="flat" texrepeat="2 3" rgba="0.5 1 1 1"',
    "by length": 'texture="flat" texrepeat="10 5" texuniform="true"',
    "cube": 'texture="cube"',
    "cube by length": 'texture="cube" texuniform="true"',
}

CASES = [
    f"{shape}/{material}"
    for shape in SHAPES
    for material in MATERIALS
    if "cube" not in material or shape not in ("plane", "endless", "mesh with its own")
]

DRAW = """
import json, sys
import mujoco, numpy as np
job = json.load(sys.stdin)
assets = {name: bytes.fromhex(data) for name, data in job["assets"].items()}
found = {}
for text in job["scenes"]:
    model = mujoco.MjModel.from_xml_string(text, assets)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    renderer = mujoco.Renderer(model, job["side"], job["side"])
    for camera in range(model.ncam):
        renderer.update_scene(data, camera)
        found[model.camera(camera).name] = renderer.render()
    renderer.close()
np.savez(sys.argv[1], **found)
"""


def pictures() -> dict[str, bytes]:
    """A picture whose colours say where on it they are, without a step where it repeats; six."""
    place = 2.0 * np.pi * (np.arange(64) + 0.5) / 64
    u, v = np.meshgrid(place, place)
    flat = np.stack([np.cos(u), np.sin(u + v), np.cos(v)], axis=-1)
    sides = [np.stack([u / 4 - 1, v / 4 - 1, 0 * u + n / 5], axis=-1) for n in range(6)]
    found = {}
    for name, image in (("flat.png", flat), ("cube.png", np.concatenate(sides))):
        file = io.BytesIO()
        Image.fromarray(np.round(127.5 * (1.0 + image)).clip(0, 255).astype(np.uint8)).save(
            file, "PNG"
        )
        found[name] = file.getvalue()
    return found


def views(case: str) -> list[str]:
    shape, material = case.split("/")
    if shape in ("plane", "endless"):
        return ["above"]
    if "cube" in material:  # fine triangles, and each view takes a second
        return ["aside"] if shape != "box" else ["below", "aside"]
    return list(VIEWS) if shape == "box" else ["above", "below", "aside"]


def scene(cases: list[str]) -> str:
    """A scene with a geom for every case, and around each its cameras."""
    geoms, materials = "", ""
    for number, case in enumerate(cases):
        shape, material = case.split("/")
        at = number * APART
        materials += f'<material name="m{number}" {MATERIALS[material]}/>'
        geoms += f'<geom material="m{number}" pos="{at[0]} {at[1]} {at[2]}" {SHAPES[shape]}/>'
        for view in views(case):
            place, axes = VIEWS[view]
            x, y, z = at + np.array(place.split(), dtype=float)
            name = f"{case}/{view}"
            geoms += f'<camera name="{name}" pos="{x} {y} {z}" xyaxes="{axes}" fovy="3.4352"/>'
    return SCENE.format(materials=materials, geoms=geoms)


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> dict[str, NDArray[np.uint8]]:
    """What MuJoCo draws of every shape with every material, from every side."""
    target = tmp_path_factory.mktemp("drawn") / "drawn.npz"
    assets = {name: data.hex() for name, data in pictures().items()}
    endless = [case for case in CASES if case.startswith("endless")]  # before everything
    texts = [scene([case for case in CASES if case not in endless])]
    texts += [scene([case]) for case in endless]
    job = {"assets": assets, "side": SIDE, "scenes": texts}
    for renderer in RENDERERS:
        done = subprocess.run(
            [sys.executable, "-c", DRAW, str(target)],
            input=json.dumps(job),
            check=False,
            text=True,
            capture_output=True,
            env={**os.environ, "MUJOCO_GL": renderer},
        )
        if done.returncode == 0:
            return dict(np.load(target))
    pytest.skip("neither EGL nor OSMesa works here (Debian: apt install libosmesa6)")


def seen(prop: Prop, model: mujoco.MjModel, view: str) -> Array:
    """Returns the colours of a prop's file as a camera sees them, (SIDE, SIDE, 4); 0: nothing."""
    mesh = trimesh.load(io.BytesIO(prop.glb()), file_type="glb", force="mesh", process=False)
    image = np.asarray(mesh.visual.material.baseColorTexture.convert("RGBA"), dtype=float)
    camera = model.camera(view).id
    axes = np.zeros(9)
    mujoco.mju_quat2Mat(axes, model.cam_quat[camera])
    body = np.zeros(9)
    mujoco.mju_quat2Mat(body, prop.turn)
    world = mesh.triangles @ body.reshape(3, 3).T + prop.place
    local = (world - model.cam_pos[camera]) @ axes.reshape(3, 3)  # right, up, towards the camera
    half = np.tan(np.radians(model.cam_fovy[camera] / 2))
    flat = local[..., :2] / -local[..., 2:] / half  # −1 to 1
    uv = np.asarray(mesh.visual.uv)[mesh.faces]
    found, depth = np.zeros((SIDE, SIDE, 4)), np.full((SIDE, SIDE), np.inf)
    centres = (np.arange(SIDE) + 0.5) * 2 / SIDE - 1
    for corners, far, places in zip(flat, -local[..., 2], uv, strict=True):
        low, high = np.searchsorted(centres, corners.min(axis=0)), corners.max(axis=0)
        columns = np.arange(low[0], np.searchsorted(centres, high[0]))
        rows = np.arange(low[1], np.searchsorted(centres, high[1]))
        edges = np.array([corners[1] - corners[0], corners[2] - corners[0]]).T
        if not columns.size or not rows.size or abs(np.linalg.det(edges)) < 1e-12:
            continue
        x, y = np.meshgrid(centres[columns], centres[rows])
        shares = np.linalg.solve(edges, np.stack([x.ravel(), y.ravel()]) - corners[0][:, None])
        weights = np.vstack([1 - shares.sum(axis=0), shares])
        inside = (weights >= -1e-9).all(axis=0).reshape(x.shape)
        away = (far @ weights).reshape(x.shape)
        i, j = SIDE - 1 - rows[:, None], columns[None, :]
        nearer = inside & (away < depth[i, j])
        place = (weights.T @ places).reshape(*x.shape, 2)
        texel = np.floor(place % 1.0 * (image.shape[1], image.shape[0])).astype(int)
        texel = np.minimum(texel, (image.shape[1] - 1, image.shape[0] - 1))
        # trimesh counts v from the bottom
        colour = image[image.shape[0] - 1 - texel[..., 1], texel[..., 0]]
        depth[i, j] = np.where(nearer, away, depth[i, j])
        found[i, j] = np.where(nearer[..., None], colour, found[i, j])
    return found


@pytest.mark.parametrize("case", CASES)
def test_a_texture_lies_where_mujoco_lays_it(
    case: str, drawn: dict[str, NDArray[np.uint8]]
) -> None:
    model = mujoco.MjModel.from_xml_string(scene([case]), pictures())
    [prop] = props_of(model)
    for view in views(case):
        name = f"{case}/{view}"
        theirs, ours = drawn[name].astype(float), seen(prop, model, name)
        # MuJoCo draws black where nothing is
        both = (ours[..., 3] > 0) & (theirs.max(axis=2) > 0)
        assert both.sum() > 400, name
        off = np.abs(ours[..., :3] - theirs)[both].max(axis=1)
        # a pixel is a step of colour at the edges of a shape and of a cube's sides
        limit = 60 if "repeated" in case else 25
        share = float((off < limit).mean())
        assert share > 0.85, (name, share, float(np.median(off)))


def test_gloss_and_glass_are_the_materials() -> None:
    materials = {
        "chalk": 'specular="0" rgba="0.2 0.4 0.6 1"',
        "plain": "",
        "glossy": 'specular="1" shininess="1"',
        "metal": 'metallic="0.8" roughness="0.3"',
        "glass": 'rgba="1 1 1 0.25"',
        "none": 'rgba="1 1 1 0"',
    }
    text = "".join(f'<material name="{name}" {said}/>' for name, said in materials.items())
    geoms = "".join(f'<geom size="0.1" material="{name}"/>' for name in materials)
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><asset>{text}</asset><worldbody>{geoms}</worldbody></mujoco>"
    )
    chalk, plain, glossy, metal, glass = (prop for prop in props_of(model))  # what is not seen
    assert chalk.skin.roughness == 1.0 > plain.skin.roughness > glossy.skin.roughness
    assert glossy.skin.roughness == pytest.approx((2 / 130) ** 0.25)
    assert (metal.skin.roughness, metal.skin.metallic) == pytest.approx((0.3, 0.8))
    assert chalk.skin.image.tolist() == [[[51, 102, 153, 255]]]
    assert glass.skin.opacity == pytest.approx(64 / 255)
    for prop, mode in ((plain, "OPAQUE"), (glass, "BLEND")):
        mesh = trimesh.load(io.BytesIO(prop.glb()), file_type="glb", force="mesh")
        assert mesh.visual.material.alphaMode == mode


def test_round_surfaces_are_round_and_edges_are_sharp() -> None:
    geoms = '<geom type="sphere" size="0.1"/><geom type="box" size="0.1 0.1 0.1"/>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{geoms}</worldbody></mujoco>")
    ball, box = props_of(model)
    np.testing.assert_allclose(ball.normals, ball.triangles / 0.1, atol=0.02)
    along = np.abs(box.normals).max(axis=2)
    np.testing.assert_allclose(along, 1.0)  # each along one axis
