"""Draws scenes with the renderer that ``MUJOCO_GL`` names; ``render_scenes`` finds and sets one.

Each scene is drawn as its file says: free camera (``statistic``, ``visual/global``), lights and
materials, at the second of its hand path that its custom number ``picture`` names, or at the start.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from hapticbridge import Bridge, Grasp, HapticBridgeError, SimulatedClock, load_scene
from hapticbridge.kernel.codes import Grip
from hapticbridge.run.hands import GripAxis
from hapticbridge.scene import Scene, custom_numbers, custom_text, scene_names, scene_path

ROOT = Path(__file__).resolve().parents[1]

WIDTH, HEIGHT = 640, 400
"""Size of a scene's picture, in pixels."""

COLUMNS, GALLERY_WIDTH, GAP, LABEL = 4, 800, 6, 22
"""Layout of the picture of all scenes: pictures in a row; width, space between and height of a
name, in pixels."""


def advance(scene: Scene) -> None:
    """Moves a scene along its hands' paths to the moment of its picture."""
    path, moment = scene.path.with_suffix(".csv"), custom_numbers(scene.model, "picture")
    if not moment:
        return
    device: str | list[Grasp] = f"trajectory:{path}"
    if joint := custom_text(scene.model, "grip_axis"):
        device = [Grasp(scene.grip, grip_axis=GripAxis(joint))]
    elif scene.other_grips:
        device = [Grasp(grip) for grip in (scene.grip, *scene.other_grips)]
    elif not path.is_file():
        return
    with Bridge(scene, device, clock=SimulatedClock()) as bridge:
        bridge.run(duration=moment[0])


def picture(name: str) -> Image.Image:
    """Returns the picture of a scene.

    Raises:
        HapticBridgeError: There is no such scene, or it cannot be loaded or run.
    """
    scene = load_scene(name)
    if joint := custom_text(scene.model, "grip_axis"):
        scene = load_scene(name, (scene.grip, str(Grip(joint, "joint"))))
    advance(scene)
    model, data = scene.model, scene.data
    mujoco.mj_forward(model, data)
    camera, shown = mujoco.MjvCamera(), mujoco.MjvOption()
    mujoco.mjv_defaultFreeCamera(model, camera)
    shown.sitegroup[:] = 0  # grip and handle are points in the model, not parts of the tool
    model.vis.global_.offwidth, model.vis.global_.offheight = WIDTH, HEIGHT
    with mujoco.Renderer(model, HEIGHT, WIDTH) as renderer:
        renderer.update_scene(data, camera, shown)
        return Image.fromarray(np.asarray(renderer.render(), dtype=np.uint8))


def gallery(pictures: dict[str, Image.Image]) -> Image.Image:
    """Returns all pictures in a grid, each above its name, in 256 colours."""
    width = (GALLERY_WIDTH - GAP * (COLUMNS - 1)) // COLUMNS
    height = round(width * HEIGHT / WIDTH)
    rows = -(-len(pictures) // COLUMNS)
    page = Image.new("RGB", (GALLERY_WIDTH, rows * (height + LABEL)), "white")
    font, pen = ImageFont.load_default(14), ImageDraw.Draw(page)
    for index, (name, image) in enumerate(pictures.items()):
        left, top = index % COLUMNS * (width + GAP), index // COLUMNS * (height + LABEL)
        page.paste(image.resize((width, height), Image.Resampling.LANCZOS), (left, top))
        pen.text((left + width // 2, top + height + 2), name, "black", font, anchor="ma")
    return page.quantize(256, kmeans=10, dither=Image.Dither.FLOYDSTEINBERG)


def main() -> int:
    """Draws and writes; returns the exit code, 2 for a scene or a folder that does not exist."""
    parser = argparse.ArgumentParser(prog="render_scenes", description="Draw scenes off-screen.")
    parser.add_argument("scenes", nargs="*", metavar="NAME", help="scenes; none named: all")
    parser.add_argument("--out", type=Path, help="folder for NAME.png (default: beside each scene)")
    parser.add_argument(
        "--gallery",
        type=Path,
        help="one picture of them all (default where no scene is named and no --out is given: "
        "hapticbridge/guide/scenes.png)",
    )
    asked = parser.parse_args()
    pictures = {}
    try:
        for name in asked.scenes or scene_names():
            pictures[name] = picture(name)
            folder = asked.out or scene_path(name).parent
            pictures[name].save(folder / f"{Path(name).stem}.png", optimize=True)
        target = asked.gallery
        if target is None and not asked.scenes and not asked.out:
            target = ROOT / "hapticbridge" / "guide" / "scenes.png"
        if target is not None:
            gallery(pictures).save(target, optimize=True)
    except (HapticBridgeError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"drawn with {os.environ['MUJOCO_GL']}: {', '.join(pictures)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
