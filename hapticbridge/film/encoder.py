"""Writes frames as a film, through the ffmpeg that imageio-ffmpeg brings."""

from __future__ import annotations

import contextlib
import subprocess
import tempfile
from types import TracebackType
from typing import IO, Self, cast

import numpy as np
from numpy.typing import NDArray

from hapticbridge.errors import HapticBridgeError

QUALITY = 15
"""Constant rate factor of H.264, 0 (best) to 51: at 15 the coupling's thin lines stay sharp."""


class Encoder:
    """A film that frames are added to; leaving it ends the film.

    Args:
        path: Where to; it ends in ``.mp4``.
        width: Of a frame in pixels, even.
        height: Likewise.
        fps: Frames per second.

    Raises:
        HapticBridgeError: There is no ffmpeg that starts; at the end: it could not write the film.
    """

    def __init__(self, path: str, width: int, height: int, fps: int) -> None:
        import imageio_ffmpeg  # noqa: PLC0415 - of the extra 'view', which a picture does not need

        frames = f"-f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {fps} -i -"
        film = f"-an -c:v libx264 -crf {QUALITY} -pix_fmt yuv420p -movflags +faststart"
        self._told: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the film
        try:
            command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", *frames.split()]
            self._process = subprocess.Popen(
                [*command, *film.split(), path], stdin=subprocess.PIPE, stderr=self._told
            )
        except (OSError, RuntimeError) as error:
            self._told.close()
            raise HapticBridgeError(
                f"no ffmpeg starts here, so there is no film: {error}; pip install imageio-ffmpeg "
                "brings one, IMAGEIO_FFMPEG_EXE names another"
            ) from None

    def add(self, frame: NDArray[np.uint8]) -> None:
        """Adds a frame, (height, width, 3).

        Raises:
            HapticBridgeError: ffmpeg has given up.
        """
        try:
            cast(IO[bytes], self._process.stdin).write(frame.tobytes())
        except OSError:
            self._end()

    def _end(self) -> None:
        """Waits for ffmpeg, and raises what it complained of."""
        with contextlib.suppress(OSError):  # it is gone, and has said why
            cast(IO[bytes], self._process.stdin).close()
        code = self._process.wait()
        self._told.seek(0)
        lines = self._told.read().decode(errors="replace").strip().splitlines()
        if code:
            raise HapticBridgeError(f"ffmpeg cannot write the film: {(lines or [str(code)])[-1]}")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        try:
            if error is None:
                self._end()
        finally:
            self._process.kill()
            self._process.wait()
            self._told.close()
