"""Motion for a check: the scene's own hand path, a file of poses, or a recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hapticbridge.device import Motion, TrajectoryDevice, read_motion
from hapticbridge.errors import DeviceError
from hapticbridge.recording import read_recording
from hapticbridge.scene import Scene
from hapticbridge.tick import SAMPLE_DTYPE

RECORDING = ".mcap"


def motion_for(scene: Scene, path: str | Path | None = None) -> Motion | None:
    """Returns the handle's motion relative to its first pose.

    ``path`` is a CSV file (``t,x,y,z[,qw,qx,qy,qz]``) or a recording; None takes ``NAME.csv``
    beside the scene.

    Returns:
        The motion; None if no file was named and none lies beside the scene.

    Raises:
        DeviceError: The file is not a motion.
        RecordingError: The file is not a recording.
    """
    if path is None:
        beside = scene.path.with_suffix(".csv")
        return read_motion(beside).relative() if beside.is_file() else None
    if Path(path).suffix != RECORDING:
        return read_motion(path).relative()
    recording = read_recording(path)
    ticks = recording.ticks
    try:
        period = float(recording.meta["period_s"])
    except (KeyError, ValueError):
        raise DeviceError(f"{path}: the recording's metadata lack its period (period_s)") from None
    # the handle's pose already includes scale and axes; the device's does not
    return Motion(
        ticks["tick"] * period, ticks["handle_position"], ticks["handle_quaternion"]
    ).relative()


def samples_of(motion: Motion, period: float) -> NDArray[np.void]:
    """Samples the motion as the loop would, one ``SAMPLE_DTYPE`` per period T in s.

    Raises:
        DeviceError: The period is not finite and > 0.
    """
    device = TrajectoryDevice(motion)
    sample = device.start(period)
    samples = np.zeros(int(motion.duration / period) + 1, SAMPLE_DTYPE)
    for k in range(samples.size):
        device.read(sample)
        samples[k] = sample[0]
    return samples
