"""Pictures and films of a recorded run, drawn without a display by the first renderer that works.

MuJoCo reads its renderer from the environment once, when it is imported. Therefore a separate
process draws (``film_process``). It reads one job in a line of JSON and answers in lines of JSON.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, Any, cast

import numpy as np

from hapticbridge.arguments import Arguments
from hapticbridge.confinement import SHARE, ForeignSceneError, death
from hapticbridge.errors import HapticBridgeError, RecordingError
from hapticbridge.files import install_command

RENDERERS = ("egl", "osmesa")
"""Renderers without a display: EGL with a graphics card or Mesa, OSMesa on the processor alone."""

ENDINGS = (".mp4", ".png")
"""Endings of the files that ``draw`` writes: a film, a picture."""

PATIENCE = 120.0
"""Longest wait for a renderer in s. A machine that compiles the code first needs a minute."""

LONGEST_LINE = 1 << 16
"""Characters of an answer of the drawing process. A longer line is no answer, and would take this
process's memory."""

MAX_PIXELS = 4096
"""Longest side of a picture in pixels. Drivers refuse much larger ones."""

_RENDERER = """
from mujoco.rendering.classic.gl_context import GLContext
GLContext(16, 16).free()
"""
_BOOTSTRAP = """
print('{"ready": true}', flush=True)
import sys
sys.path.insert(0, sys.argv[1])
from hapticbridge.film_process import run
run()
"""
# the renderer first, so that a later failure is not mistaken for a renderer that fails

_NONE_WORKS = (
    "neither EGL nor OSMesa works here, so nothing can be drawn off-screen; on Debian: apt install "
    "libegl1 libgl1-mesa-dri, or libosmesa6"
)

STATES = ".npz"
"""Ending of a file of states: ``rows`` (records, (n,)), ``qpos`` (n, nq), ``qvel`` (n, nv),
``ctrl`` (n, nu), ``names`` of positions, ``controls`` of ``ctrl``, and with a camera ``pictures``
and ``ends``: all PNG in a row of bytes, and where each ends."""

FREE_CAMERA = "free"
"""Name by which states are seen from the free camera, as the scene's file sets it."""

Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Shot:
    """Time, camera and size of a picture or a film.

    Attributes:
        at: Time of a picture in s from the start of the run; None for the last tick.
        start: Time in the run at which a film begins, in s.
        stop: Time in the run at which a film ends, in s; None for the end of the run.
        speed: Speed of a film relative to the run, 0.001 to 1000: at 0.1 a second takes ten.
        camera: Name of a camera of the scene; None for the free one, as the scene's file sets it.
        width: Pixels, 16 to 4096 and even.
        height: Pixels, 16 to 4096 and even.
        fps: Frames per second of a film, 1 to 120.

    Raises:
        HapticBridgeError: A value is out of range.
    """

    at: float | None = None
    start: float = 0.0
    stop: float | None = None
    speed: float = 1.0
    camera: str | None = None
    width: int = 800
    height: int = 600
    fps: int = 30

    def __post_init__(self) -> None:
        check = Arguments(HapticBridgeError)
        for name in ("width", "height"):
            side = check.whole(name, getattr(self, name), least=16, most=MAX_PIXELS)
            if side % 2:
                raise HapticBridgeError(f"{name} is {side} pixels; films need an even number")
        check.whole("fps", self.fps, least=1, most=120)
        if self.at is not None:
            check.number("time", self.at, "s", least=0.0)
        check.number("start", self.start, "s", least=0.0)
        if self.stop is not None:
            check.number("stop", self.stop, "s", least=0.0)
            if self.stop <= self.start:
                raise HapticBridgeError(f"stop is {self.stop:g} s, not after {self.start:g} s")
        check.number("speed", self.speed, "", least=0.001, most=1000.0)

    @property
    def is_of_film(self) -> bool:
        """True if a value is set that applies to films only."""
        is_timed = bool(self.start) or self.stop is not None or self.speed != 1.0
        return is_timed or self.fps != Shot().fps


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
        out: ``.png`` for one picture, ``.mp4`` for a film as long as the run; an existing file is
            replaced.
        shot: Time, camera and size; the last tick at 800 × 600 by default.
        progress: Called with the finished and all frames.
        in_process: True sets no limits on memory, time and files, for recordings of a known origin.

    Returns:
        The renderer that drew it.

    Raises:
        HapticBridgeError: No renderer works here, the file's ending is unknown, or a film is
            requested without the extra 'view'.
        RecordingError: The recording cannot be drawn, or the file not written.
        ForeignSceneError: Its scene crashed MuJoCo, or takes too much memory or time.
    """
    shot, target = shot or Shot(), Path(out)
    _check_target(target, shot)
    job = {"recording": str(recording), "name": str(target), **asdict(shot)}
    job["in_process"] = in_process
    try:
        with tempfile.TemporaryDirectory(
            prefix=".drawing-", dir=target.absolute().parent, ignore_cleanup_errors=True
        ) as folder:
            drawn = Path(folder) / f"drawn{target.suffix.lower()}"
            renderer = _draw_with_any(job | {"out": str(drawn)}, progress)
            drawn.replace(target)
    except OSError as error:
        raise RecordingError(f"cannot write '{target}': {error.strerror or error}") from None
    return renderer


def _draw_with_any(job: dict[str, Any], progress: Progress | None) -> str:
    """Draws with the renderer of MUJOCO_GL, or the first that works; returns its name."""
    requested = os.environ.get("MUJOCO_GL")
    for renderer in [requested] if requested else RENDERERS:
        if _draw_with(renderer, job, progress):
            return renderer
    if requested:
        raise HapticBridgeError(f"MUJOCO_GL={requested} does not work here; try egl or osmesa")
    raise HapticBridgeError(_NONE_WORKS)


def states(recording: Path, shot: Shot, progress: Progress | None = None) -> dict[str, Any]:
    """Returns states of a run simulated again, ``shot.fps`` per second, in a confined process.

    Args:
        recording: The file.
        shot: Frames per second, and the camera and size of pictures; no pictures without a camera.
        progress: Called with the finished and all frames.

    Returns:
        Arrays by name, as ``STATES`` has them.

    Raises:
        HapticBridgeError: As ``draw``.
    """
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"states{STATES}"
        job = {"recording": str(recording), "name": str(file), "out": str(file)}
        job |= asdict(shot) | {"in_process": False}
        if shot.camera is None:
            _draw_with(None, job, progress)
        else:
            _draw_with_any(job, progress)
        with np.load(file, allow_pickle=False) as found:
            return dict(found)


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
    if not target.absolute().parent.is_dir():
        raise HapticBridgeError(f"cannot write '{target}': its folder does not exist")
    if target.exists() and not target.is_file():
        raise HapticBridgeError(f"cannot write '{target}': it exists and is not a file")
    if ending == ".mp4" and shot.at is not None:
        raise HapticBridgeError("a time goes with a picture (.png); a film has start and stop")
    if ending == ".png" and shot.is_of_film:
        raise HapticBridgeError(
            "start, stop, speed and fps go with a film (.mp4); a picture has a time"
        )
    if ending == ".mp4" and importlib.util.find_spec("imageio_ffmpeg") is None:
        raise HapticBridgeError(f"a film needs the extra 'view': {install_command('view')}")


def _draw_with(renderer: str | None, job: dict[str, Any], progress: Progress | None) -> bool:
    """Does a job in a separate process; returns False if its renderer does not work.

    ``renderer`` is None for a job that draws nothing.
    """
    package = str(Path(__file__).resolve().parents[1])
    # -P: a file in the user's working folder must not replace a module
    begin = "" if renderer is None else _RENDERER
    command = [sys.executable, "-P", "-c", begin + _BOOTSTRAP, package]
    environment = {**os.environ, "MUJOCO_GL": renderer or "disable"}
    # settings of another renderer, if this process tried one
    environment.pop("PYOPENGL_PLATFORM", None)
    process = subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env=environment,
        text=True,
        encoding="utf-8",
        errors="replace",
    )
    watch = _Watch(process)
    what = f"the scene of '{job['recording']}'"
    is_ready = False
    try:
        watch.allow(PATIENCE)
        print(json.dumps(job), file=cast(IO[str], process.stdin), flush=True)
        for answer in _answers(cast(IO[str], process.stdout)):
            if "ready" in answer:
                is_ready = True
            elif "seconds" in answer:
                watch.allow(PATIENCE + SHARE * answer["seconds"])
            elif "frame" in answer and progress is not None:
                progress(answer["frame"], answer["frames"])
            elif "error" in answer:
                raise RecordingError(answer["error"])
            elif "failure" in answer:
                raise ForeignSceneError(f"{what} {answer['failure']}")
            elif "done" in answer:
                return True
        status = process.wait(PATIENCE)  # its answers have ended
    except BrokenPipeError:
        return False  # the process ended before it read the job
    else:
        if is_ready:
            end = "takes too long to draw" if watch.is_over else death(status)
            raise ForeignSceneError(f"{what} {end}")
        return False
    finally:
        # not by ``with process``, which after a ``StopSignal`` waits until the drawing is done
        watch.cancel()
        process.kill()
        for stream in (process.stdin, process.stdout):
            with contextlib.suppress(OSError):
                cast(IO[str], stream).close()
        process.wait(PATIENCE)


class _Watch:
    """Time after which a process is killed."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process, self.is_over = process, False
        self._timer: threading.Timer | None = None

    def allow(self, seconds: float) -> None:
        self.cancel()
        self._timer = threading.Timer(min(seconds, threading.TIMEOUT_MAX), self._end)
        self._timer.daemon = True
        self._timer.start()

    def cancel(self) -> None:
        if self._timer is not None:
            self._timer.cancel()

    def _end(self) -> None:
        self.is_over = True
        self._process.kill()


def _answers(lines: IO[str]) -> Iterator[dict[str, Any]]:
    while line := lines.readline(LONGEST_LINE):
        answer = None
        if line.startswith("{"):  # drivers print, too
            with contextlib.suppress(ValueError, RecursionError):
                answer = json.loads(line)
        if isinstance(answer, dict):
            yield answer
