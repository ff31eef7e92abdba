"""Pictures and films of a recorded run, drawn without a display by the first renderer that works.

A child process draws (``confinement``): a driver of graphics that crashes ends the child alone.
It is a fresh interpreter, because MuJoCo chooses its renderer when it is imported, and no driver
works in the fork of a process that has drawn.
"""

from __future__ import annotations

import importlib.util
import io
import os
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from hapticbridge.arguments import check_fields, option
from hapticbridge.audit.recorded_scene import load_machine_code, machine_code_for, seconds_for
from hapticbridge.confinement import MEMORY, Confined, ForeignSceneError, Fresh, Work, Worker
from hapticbridge.errors import HapticBridgeError, RecordingError
from hapticbridge.files import check_regular, check_target, install_command, writing
from hapticbridge.kernel import jit
from hapticbridge.kernel.codes import added_actuators
from hapticbridge.kernel.record import TICK_DTYPE, Timeline
from hapticbridge.recording import RecordingFile, open_recording
from hapticbridge.replay.stage import (
    Camera,
    Frame,
    Stage,
    film_ticks,
    sensor_names,
    write_animation,
    write_film,
)
from hapticbridge.run.description import parameters_of

RENDERERS = ("egl", "osmesa")
"""Renderers without a display: EGL with a graphics card or Mesa, OSMesa on the processor alone."""

ENDINGS = (".mp4", ".gif", ".png")
"""Endings of the files that ``draw`` writes: a film, one that every page shows, a picture."""

MAX_PIXELS = 4096
"""Longest side of a picture in pixels. Drivers refuse much larger ones."""

_NONE_WORKS = (
    "neither EGL nor OSMesa works here, so nothing can be drawn off-screen; on Debian: apt install "
    "libegl1 libgl1-mesa-dri, or libosmesa6"
)

FREE_CAMERA = "free"
"""Name by which states are seen from the free camera, as the scene's file sets it."""

GRAPHICS = (
    *("/sys", "/etc/glvnd", "/etc/egl", "/etc/OpenCL", "/etc/drirc", "/etc/fonts", "/etc/passwd"),
    *("/dev/dri", "/dev/nvidiactl", "/dev/nvidia0", "/dev/nvidia-uvm", "/dev/nvidia-modeset"),
)
"""Files and folders that drivers of graphics read besides programs."""

FRAME_TIME, PIXEL_TIME = 2.0, 1e-5
"""Processor time in s that a frame may take, and beyond it per pixel. Without a graphics card a
frame of 800 x 600 takes 0.3 s; a scene of millions of triangles takes all."""

Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Shot:
    """Time, camera and size of a picture or a film.

    Attributes:
        at: Time of a picture in s from the start of the run. By default 'hapticbridge render' takes
            that of the largest force; None is the last tick.
        start: Start of a film in s of the run.
        stop: End of a film in s of the run; by default the run's end.
        speed: Speed of a film: 0.1 shows a second of the run in ten.
        camera: A camera of the scene, by name; by default the free one, as the scene's file sets
            it.
        width: Width in pixels, even.
        height: Height in pixels, even.
        fps: Frames per second of a film.

    Raises:
        HapticBridgeError: A value is out of range.
    """

    at: float | None = option(None, unit="s", least=0.0)
    start: float = option(0.0, unit="s", least=0.0)
    stop: float | None = option(None, unit="s", least=0.0)
    speed: float = option(1.0, least=0.001, most=1000.0)
    camera: str | None = None
    width: int = option(800, unit="pixels", least=16, most=MAX_PIXELS)
    height: int = option(600, unit="pixels", least=16, most=MAX_PIXELS)
    fps: int = option(30, least=1, most=120)

    def __post_init__(self) -> None:
        check_fields(self)
        for name, side in (("width", self.width), ("height", self.height)):
            if side % 2:
                raise HapticBridgeError(f"{name} is {side} pixels; films need an even number")
        if self.stop is not None and self.stop <= self.start:
            raise HapticBridgeError(f"stop is {self.stop:g} s, not after {self.start:g} s")

    @property
    def is_of_film(self) -> bool:
        """True if a value is set that applies to films only."""
        is_timed = bool(self.start) or self.stop is not None or self.speed != 1.0
        return is_timed or self.fps != USUAL_SHOT.fps


USUAL_SHOT = Shot()
"""Shot without choices of the user."""


def draw(
    recording: str | Path,
    out: str | Path,
    shot: Shot | None = None,
    progress: Progress | None = None,
    *,
    in_process: bool = False,
) -> str:
    """Draws a recording into a file.

    The run is simulated again, which gives the poses of all bodies. If writing fails or is
    interrupted, an existing file is left unchanged and no partial file remains.

    Args:
        recording: The file.
        out: ``.png`` for one picture, ``.mp4`` or ``.gif`` for a film as long as the run; an
            existing file is replaced.
        shot: Time, camera and size; the last tick at 800 × 600 by default.
        progress: Called with the finished and all frames.
        in_process: True sets no limits on memory, time and files, for recordings of a known origin.

    Returns:
        The renderer that drew it.

    Raises:
        HapticBridgeError: No renderer works here, the file's ending is unknown, or an ``.mp4`` is
            requested without the extra 'view'.
        RecordingError: The recording cannot be drawn, or the file not written.
        ForeignSceneError: Its scene crashed MuJoCo, or takes too much memory or time.
    """
    shot, target = shot or Shot(), Path(out)
    _check_target(target, shot)
    opened = open_recording(recording, 0)
    with (
        writing(target, RecordingError),
        tempfile.TemporaryDirectory(
            prefix=".drawing-", dir=target.absolute().parent, ignore_cleanup_errors=True
        ) as folder,
    ):
        drawn = Path(folder) / f"drawn{target.suffix.lower()}"
        child = _Child(opened, shot, progress, drawn, in_process)
        renderer, reason = child.drawn_with_any(partial(_draw, opened.path, drawn, shot))
        if reason:
            raise RecordingError(f"cannot write '{target}': {reason}")
        drawn.replace(target)
    return renderer


def states(recording: Path, shot: Shot, progress: Progress | None = None) -> dict[str, Any]:
    """Returns states of a run simulated again, ``shot.fps`` per second, from a confined process.

    Args:
        recording: The file.
        shot: Frames per second, and the camera and size of pictures; no pictures without a camera.
        progress: Called with the finished and all frames.

    Returns:
        ``rows`` (records, (n,)), ``qpos`` (n, nq), ``qvel`` (n, nv), ``ctrl`` (n, nu), ``sensors``,
        ``names`` of positions, ``controls`` of ``ctrl``, ``sensor_names``, ``kinds`` (MuJoCo's
        types of joints, actuators and sensors), ``odd_readings`` as of ``SensorValues``, and with a
        camera ``pictures``, a PNG each.

    Raises:
        HapticBridgeError: As ``draw``.
    """
    opened = open_recording(recording, 0)
    child, work = _Child(opened, shot, progress), partial(_states, opened.path, shot)
    found = child.result(work) if shot.camera is None else child.drawn_with_any(work)[1]
    return {**found, "rows": np.frombuffer(found["rows"], TICK_DTYPE)}


class SensorValues(NamedTuple):
    """Readings of a scene's sensors in each tick of a run, as MuJoCo's step computed them.

    Positions and velocities are those at the start of the tick, forces those that act in it.

    Attributes:
        names: Name of each number (k,).
        ticks: Number of each tick (n,), increasing.
        values: The readings (n, k), in MuJoCo's units.
        odd: Names of those numbers that the file alone would not give, by the reason: ``coupled``
            and ``early``, as of ``Stage.odd_readings``.
    """

    names: tuple[str, ...]
    ticks: NDArray[np.int64]
    values: NDArray[np.float64]
    odd: dict[str, list[str]]


def sensors(recording: Path) -> SensorValues:
    """Returns the readings of the scene's own sensors, from a confined process.

    Raises:
        HapticBridgeError: The scene has none, or as ``draw``.
    """
    opened = open_recording(recording, 0)
    found = _Child(opened, Shot(), None).result(partial(_sensors, opened.path))
    names = tuple(found["names"])
    if not names:
        raise HapticBridgeError(f"the scene of '{recording}' has no sensors")
    ticks = np.frombuffer(found["ticks"], np.int64)
    values = np.frombuffer(found["values"]).reshape(len(ticks), -1)
    return SensorValues(names, ticks, values, found["odd"])


def still(recording: str | Path, shot: Shot, *, in_process: bool = False) -> bytes:
    """Returns a picture of a recording as PNG.

    Raises:
        HapticBridgeError: As ``draw``.
    """
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "still.png"
        draw(recording, file, shot, in_process=in_process)
        return file.read_bytes()


def _check_target(target: Path, shot: Shot) -> None:
    ending = target.suffix.lower()
    if ending not in ENDINGS:
        raise HapticBridgeError(
            f"'{target}' is neither a picture nor a film; endings: {', '.join(ENDINGS)}"
        )
    check_target(target, HapticBridgeError)
    check_regular(target, HapticBridgeError)
    if ending != ".png" and shot.at is not None:
        raise HapticBridgeError("a time goes with a picture (.png); a film has start and stop")
    if ending == ".png" and shot.is_of_film:
        raise HapticBridgeError(
            "start, stop, speed and fps go with a film (.mp4, .gif); a picture has a time"
        )
    if ending == ".mp4" and importlib.util.find_spec("imageio_ffmpeg") is None:
        raise HapticBridgeError(
            f"an .mp4 needs the extra 'view': {install_command('view')}; a .gif needs nothing"
        )


class _Child:
    """Child process that simulates a recording again, with the limits of a shot.

    Args:
        recording: The recording.
        shot: Time, camera and size.
        progress: Called with the finished and all frames.
        out: File that the child may write; None for none.
        is_trusted: True sets no limits.
    """

    def __init__(
        self,
        recording: RecordingFile,
        shot: Shot,
        progress: Progress | None,
        out: Path | None = None,
        is_trusted: bool = False,
    ) -> None:
        self._what, self._progress = f"the scene of '{recording.path}'", progress
        self._is_limited, self._is_ready = not is_trusted, False
        parameters = parameters_of(recording.meta)
        self._code = machine_code_for(recording, parameters)
        seconds = seconds_for(recording, parameters)
        pixels = shot.width * shot.height
        frames = 1.0
        if out is None or out.suffix != ".png":
            length = Timeline(recording.blocks(), parameters.period).duration
            span = (length if shot.stop is None else shot.stop) - shot.start
            frames = max(1.0, min(span, length) * shot.fps / shot.speed)
        devices = [path for path in GRAPHICS if path.startswith("/dev")]
        self._bounds: dict[str, Any] = {
            "seconds": seconds + frames * (FRAME_TIME + PIXEL_TIME * pixels),
            "reads": (recording.path.absolute(), jit.cache_folder(), *GRAPHICS),
            "writes": (*([] if out is None else [out.parent]), *devices),
            "memory": MEMORY + 64 * pixels,
        }

    def drawn_with_any(self, work: Work) -> tuple[str, Any]:
        """Does work with the renderer of MUJOCO_GL, or the first that works.

        Returns:
            The renderer's name, and the result.
        """
        requested = os.environ.get("MUJOCO_GL")
        for renderer in [requested] if requested else RENDERERS:
            try:
                return renderer, self.result(work, renderer)
            except ForeignSceneError:
                if self._is_ready:
                    raise
        if requested:
            others = " or ".join(each for each in RENDERERS if each != requested)
            raise HapticBridgeError(f"MUJOCO_GL={requested} does not work here; try {others}")
        raise HapticBridgeError(_NONE_WORKS)

    def result(self, work: Work, renderer: str | None = None) -> Any:
        """Does work, which draws with a renderer if there is one; returns its result."""
        environment = {**os.environ, "MUJOCO_GL": renderer or "disable"}
        # settings of another renderer
        environment.pop("PYOPENGL_PLATFORM", None)
        prepare = partial(_load, renderer, self._code)
        fresh = Fresh(environment, prepare, self._is_limited)
        work = partial(_ready, work)
        with Confined(work, self._what, fresh=fresh, **self._bounds) as child:
            return child.result(self._hear)

    def _hear(self, news: object) -> None:
        self._is_ready = True  # the renderer works
        match news:
            case [int(done), int(total)] if self._progress is not None:
                self._progress(done, total)


# Work of the child


def _load(renderer: str | None, code: tuple[str, str, str]) -> None:
    """Loads the renderer, if the work draws, and machine code."""
    if renderer is not None:
        from mujoco.rendering.classic.gl_context import GLContext  # noqa: PLC0415 - if it draws

        context = GLContext(16, 16)
        if renderer not in RENDERERS:  # GLFW makes one without a display, too, in which none draws
            context.make_current()
            mujoco.MjrContext(mujoco.MjSpec().compile(), mujoco.mjtFontScale.mjFONTSCALE_50).free()
        context.free()
    load_machine_code(*code)


def _ready(work: Work, worker: Worker) -> object:
    """Tells that the renderer works, and does the work."""
    worker.tell(None)
    return work(worker)


def _draw(path: Path, out: Path, shot: Shot, worker: Worker) -> str:
    """Draws a picture or a film into a file; returns why it cannot be written, or an empty text."""
    stage = Stage(open_recording(path, 0), worker.allow_run)
    camera = Camera(stage, (shot.width, shot.height), shot.camera)
    if out.suffix == ".png":
        tick = stage.recording.count - 1 if shot.at is None else stage.tick_at(shot.at)
        picture = Image.fromarray(camera.frame(tick))
        try:
            picture.save(out, optimize=True)
        except OSError as error:
            return error.strerror or str(error)
        return ""
    ticks = list(film_ticks(stage, shot.fps, shot.start, shot.stop, shot.speed))

    def frames() -> Iterator[Frame]:
        for number, tick in enumerate(ticks, start=1):
            yield camera.frame(tick)
            worker.tell([number, len(ticks)])

    if out.suffix == ".gif":
        return write_animation(out, frames(), shot.fps)
    write_film(str(out), frames(), (shot.width, shot.height), shot.fps)
    return ""


def _states(path: Path, shot: Shot, worker: Worker) -> dict[str, Any]:
    """Returns what ``states`` does, with the bytes of ``rows``."""
    stage = Stage(open_recording(path, 0), worker.allow_run)
    camera = None
    if shot.camera is not None:
        name = None if shot.camera == FREE_CAMERA else shot.camera
        camera = Camera(stage, (shot.width, shot.height), name, has_forces=False)
    model = stage.model
    controls = _control_names(model)
    ticks = list(film_ticks(stage, shot.fps))
    rows, seen, pictures, readings = [], [], [], []
    for number, tick in enumerate(ticks, start=1):
        stage.show(tick)
        data = stage.data
        rows.append(stage.row.tobytes())
        seen.append((data.qpos.copy(), data.qvel.copy(), data.ctrl[list(controls)].copy()))
        readings.append(data.sensordata.copy())
        if camera is not None:
            buffer = io.BytesIO()
            Image.fromarray(camera.frame(tick)).save(buffer, "PNG")
            pictures.append(buffer.getvalue())
        worker.tell([number, len(ticks)])
    qpos, qvel, ctrl = (np.array(each) for each in zip(*seen, strict=True))
    names = [
        f"{model.joint(joint).name or joint}{f'_{k}' if size > 1 else ''}"
        for joint in range(model.njnt)
        for size in [_POSITIONS[int(model.jnt_type[joint])]]
        for k in range(size)
    ]
    added = added_actuators(model)
    own = [each for each in range(len(model.actuator_trntype)) if each not in added]
    kinds = [
        model.jnt_type,
        *(model.actuator_trntype[own], model.actuator_gaintype[own], model.actuator_biastype[own]),
        model.sensor_type,
    ]
    return {
        "rows": b"".join(rows),
        "kinds": [each.tolist() for each in kinds],
        "qpos": qpos,
        "qvel": qvel,
        "ctrl": ctrl,
        "sensors": np.array(readings),
        "sensor_names": sensor_names(model),
        "odd_readings": stage.odd_readings(),
        "names": names,
        "controls": list(controls.values()),
        "pictures": pictures,
    }


def _control_names(model: mujoco.MjModel) -> dict[int, str]:
    """Returns the name of each control of the scene's own actuators, by its place in ``ctrl``.

    An actuator with several controls has its name followed by ``_0``, ``_1`` and so on.
    """
    ours, names = added_actuators(model), dict[int, str]()
    for actuator in range(model.nactuator):
        name, count = model.actuator(actuator).name or actuator, model.actuator_ctrlnum[actuator]
        for k in range(0 if actuator in ours else count):
            place = int(model.actuator_ctrladr[actuator]) + k
            names[place] = f"{name}_{k}" if count > 1 else f"{name}"
    return names


def _sensors(path: Path, worker: Worker) -> dict[str, Any]:
    """Returns what ``sensors`` does, as bytes."""
    stage = Stage(open_recording(path, 0), worker.allow_run)
    ticks, values, names = [], [], sensor_names(stage.model)
    for row in range(stage.recording.count if names else 0):
        stage.show(row)
        ticks.append(int(stage.row["tick"][0]))
        values.append(stage.data.sensordata.tobytes())
    return {
        "names": names,
        "ticks": np.array(ticks).tobytes(),
        "values": b"".join(values),
        "odd": stage.odd_readings(),
    }


_POSITIONS = {
    int(mujoco.mjtJoint.mjJNT_FREE): 7,
    int(mujoco.mjtJoint.mjJNT_BALL): 4,
    int(mujoco.mjtJoint.mjJNT_SLIDE): 1,
    int(mujoco.mjtJoint.mjJNT_HINGE): 1,
}
"""Numbers in ``qpos`` by joint type."""
