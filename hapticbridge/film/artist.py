"""The process that draws: MuJoCo takes its renderer from the environment once, when it is imported.

``hapticbridge.film.studio`` starts it, tells it in one line of JSON what to draw, and reads one
answer per line: ``frame`` while a film is drawn, ``done``, or ``error`` with a sentence.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from hapticbridge.errors import HapticBridgeError, RecordingError
from hapticbridge.film.encoder import Encoder
from hapticbridge.film.stage import Stage

Frame = NDArray[np.uint8]

SHADOW = 2048
"""Of a side of the map that shadows are drawn from, in pixels, at most. Without a graphics card, on
two busy cores, MuJoCo's 4096 made 5.5 frames of 800 x 600 a second and this 8.5; less makes the
edges of shadows coarser."""

TOOL_ALPHA = 0.5
"""Of moving bodies: grip, handle and spring are inside the tool, and would not be seen through a
solid one; below 0.4 the tool itself is hard to see."""


class Camera:
    """MuJoCo's free camera on a stage, as the scene's file sets it.

    Args:
        stage: What is seen.
        width: Of a frame in pixels.
        height: Likewise.
        name: A camera of the scene to look through instead; None: the free one.

    Raises:
        RecordingError: The scene has no camera of that name.
    """

    def __init__(self, stage: Stage, width: int, height: int, name: str | None = None) -> None:
        self._stage = stage
        model = stage.model
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        self._camera, self._shown = mujoco.MjvCamera(), mujoco.MjvOption()
        mujoco.mjv_defaultFreeCamera(model, self._camera)
        if name is not None:
            self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
            self._camera.fixedcamid = _camera_id(model, name)
        shadows = model.vis.quality
        shadows.shadowsize = min(shadows.shadowsize, SHADOW)
        self._shown.sitegroup[:] = 0  # grip and handle are points for the computer
        flags = mujoco.mjtVisFlag
        model.vis.map.alpha = TOOL_ALPHA
        for flag in (flags.mjVIS_CONTACTPOINT, flags.mjVIS_CONTACTFORCE, flags.mjVIS_TRANSPARENT):
            self._shown.flags[flag] = True
        self.renderer = mujoco.Renderer(model, height, width)

    def frame(self, tick: int) -> Frame:
        """Returns the picture of a tick, (height, width, 3)."""
        self._stage.show(tick)
        self.renderer.update_scene(self._stage.data, self._camera, self._shown)
        self._stage.add_coupling(self.renderer.scene)
        return np.array(self.renderer.render(), dtype=np.uint8)

    def segments(self, tick: int) -> NDArray[np.int32]:
        """Returns which geom each pixel of a tick shows, (height, width); -1 for none.

        Decoration hides nothing: it is not drawn here.
        """
        self._stage.show(tick)
        self._shown.flags[:] = False
        self.renderer.update_scene(self._stage.data, self._camera, self._shown)
        self.renderer.enable_segmentation_rendering()
        found = np.array(self.renderer.render())
        self.renderer.disable_segmentation_rendering()
        is_geom = found[..., 1] == int(mujoco.mjtObj.mjOBJ_GEOM)
        return np.where(is_geom, found[..., 0], -1).astype(np.int32)


def _camera_id(model: mujoco.MjModel, name: str) -> int:
    names = [model.camera(index).name for index in range(model.ncam)]
    if name not in names:
        there = f"cameras: {', '.join(map(repr, filter(None, names)))}" if any(names) else "none"
        raise RecordingError(f"the scene has no camera '{name}'; it has {there}")
    return names.index(name)


def film_ticks(
    stage: Stage, rate: float, start: float = 0.0, stop: float | None = None, speed: float = 1.0
) -> Iterator[int]:
    """Yields the tick of each frame of a film.

    Args:
        stage: What is shown.
        rate: Frames per second.
        start: Where in the run the film begins, in s.
        stop: Where it ends; None: with the run.
        speed: How fast the run is shown, without unit; 1: as fast as it was.

    Raises:
        RecordingError: The run does not last so long.
    """
    end = stage.duration if stop is None else stop
    stage.tick_at(end), stage.tick_at(start)  # refused before the first frame
    for frame in range(max(1, int((end - start) / speed * rate))):
        yield stage.tick_at(start + frame * speed / rate)


def _answer(**answer: object) -> None:
    print(json.dumps(answer), flush=True)


def _draw(job: dict[str, Any]) -> None:
    stage = Stage(job["recording"])
    last = stage.recording.count - 1
    tick = last if job["at"] is None else stage.tick_at(job["at"])
    camera = Camera(stage, job["width"], job["height"], job["camera"])
    out = Path(job["out"])
    try:
        if out.suffix == ".png":
            # in 256 colours the sky would have steps, or what is thin another colour
            Image.fromarray(camera.frame(tick)).save(out, optimize=True)
        else:
            _film(stage, camera, job)
    except OSError as error:
        raise RecordingError(f"cannot write '{job['name']}': {error.strerror or error}") from None


def _film(stage: Stage, camera: Camera, job: dict[str, Any]) -> None:
    ticks = list(film_ticks(stage, job["fps"], job["start"], job["stop"], job["speed"]))
    with Encoder(job["out"], job["width"], job["height"], job["fps"]) as encoder:
        for number, tick in enumerate(ticks):
            encoder.add(camera.frame(tick))
            _answer(frame=number + 1, frames=len(ticks))


def run() -> None:
    """Draws one job."""
    job = json.loads(sys.stdin.readline())
    try:
        _draw(job)
    except HapticBridgeError as error:
        _answer(error=str(error))
    else:
        _answer(done=True)
