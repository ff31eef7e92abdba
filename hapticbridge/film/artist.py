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
from hapticbridge.film.stage import Stage

Frame = NDArray[np.uint8]

QUALITY = 7
"""Of a film, 0 to 10 as imageio-ffmpeg counts: at 7 the coupling's thin lines stay sharp."""


TOOL_ALPHA = 0.5
"""Of moving bodies: grip, handle and spring are inside the tool, and would not be seen through a
solid one; below 0.4 the tool itself is hard to see."""


class Camera:
    """MuJoCo's free camera on a stage, as the scene's file sets it.

    Args:
        stage: What is seen.
        width: Of a frame in pixels.
        height: Likewise.
    """

    def __init__(self, stage: Stage, width: int, height: int) -> None:
        self._stage = stage
        model = stage.model
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        self._camera, self._shown = mujoco.MjvCamera(), mujoco.MjvOption()
        mujoco.mjv_defaultFreeCamera(model, self._camera)
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


def film_ticks(stage: Stage, rate: float) -> Iterator[int]:
    """Yields the tick of each frame of a film that runs as fast as the run did."""
    for frame in range(max(1, int(stage.duration * rate))):
        yield stage.tick_at(frame / rate)


def _answer(**answer: object) -> None:
    print(json.dumps(answer), flush=True)


def _draw(job: dict[str, Any]) -> None:
    stage = Stage(job["recording"])
    last = stage.recording.count - 1
    tick = last if job["at"] is None else stage.tick_at(job["at"])
    camera = Camera(stage, job["width"], job["height"])
    out = Path(job["out"])
    try:
        if out.suffix.lower() == ".png":
            Image.fromarray(camera.frame(tick)).quantize(256).save(out, optimize=True)
        else:
            _film(stage, camera, job)
    except OSError as error:
        raise RecordingError(f"cannot write '{out}': {error.strerror or error}") from None


def _film(stage: Stage, camera: Camera, job: dict[str, Any]) -> None:
    import imageio_ffmpeg  # noqa: PLC0415 - of the extra 'view', which a picture does not need

    ticks = list(film_ticks(stage, job["fps"]))
    size = job["width"], job["height"]
    writer = imageio_ffmpeg.write_frames(
        job["out"], size, fps=job["fps"], quality=QUALITY, macro_block_size=2
    )
    writer.send(None)
    for number, tick in enumerate(ticks):
        writer.send(camera.frame(tick).tobytes())
        _answer(frame=number + 1, frames=len(ticks))
    writer.close()


def run() -> None:
    """Draws one job."""
    job = json.loads(sys.stdin.readline())
    try:
        _draw(job)
    except HapticBridgeError as error:
        _answer(error=str(error))
    else:
        _answer(done=True)
