"""A scene under check: as its files say, as it runs, and what it did in a motion."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.certificate import default_coupling
from hapticbridge.check.motion import motion_for, samples_of
from hapticbridge.check.observation import Observation, observe, quiet
from hapticbridge.check.places import Places
from hapticbridge.coupling import Coupling
from hapticbridge.device import DeviceInfo, Motion, SimulatedDevice
from hapticbridge.device.trajectory.motion import lissajous
from hapticbridge.errors import DeviceError, SceneError
from hapticbridge.rendering import default_method
from hapticbridge.scene import Scene, SceneSource, compile_scene

DEFAULT_PERIOD = 1e-3
"""T in s of ``hapticbridge run`` by itself."""

LARGEST_WORKSPACE = 0.4
"""Edge in m of the cube that a device reaches where nobody says: the makers of table-top devices
state from 0.1 m (Novint Falcon) to 0.4 m (Force Dimension delta.3), so what does not fit in here
fits none of them. The simulated device has no walls."""

DEFAULT_SECONDS = 5.0
"""How long the default hand motion is followed, in s: it has its full size after 2 s."""

_DEFAULT_STEP = 0.01  # s; the motion's fastest part has 0.41 Hz
_REFUSED = re.compile(r"(mass and inertia of|inertia must satisfy).*?, id (\d+)")
STAND_IN_MASS, STAND_IN_INERTIA = 0.01, 1e-6
"""In kg and kg m²: of something that a finger carries, for a body whose own MuJoCo refuses."""


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """A scene under check.

    Attributes:
        source: The scene as its files say.
        scene: The scene as it runs, with handle and coupling.
        places: Where things are written.
        info: Data sheet of the device that it is checked for.
        coupling: K and B that should be felt.
        period: T in s.
        scale: Handle motion per device motion, without unit.
        motion: Of the handle.
        motion_name: Whose motion it is, in words.
        samples: The motion, one sample per tick.
        refused: Bodies whose inertia MuJoCo refuses, with what it says; something stands in for it.
        workspace: Edge of the cube in m that the device reaches.
        is_rate_given: Whether somebody asked for this period, and not the default.
        observation: What the motion showed; None where it did not end.
        motion_fault: Why it did not end.
    """

    source: SceneSource
    scene: Scene
    places: Places
    info: DeviceInfo
    coupling: Coupling
    period: float
    scale: float
    motion: Motion
    motion_name: str
    samples: NDArray[np.void]
    refused: dict[int, str]
    workspace: float
    is_rate_given: bool
    observation: Observation | None = None
    motion_fault: str = ""

    @property
    def model(self) -> mujoco.MjModel:
        """The compiled scene, with the handle and the time step that it runs at."""
        return self.scene.model

    @property
    def used(self) -> Coupling:
        """The coupling whose law gives the wrench, in the method that a bridge takes by itself."""
        return default_method().used(self.coupling, self.period)


def open_case(
    source: SceneSource,
    grip: str = "grip",
    *,
    coupling: Coupling | None = None,
    period: float | None = None,
    scale: float = 1.0,
    workspace: float = LARGEST_WORKSPACE,
    motion: str | Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Case:
    """Compiles a scene and leads it through its motion.

    Args:
        source: What ``read_scene`` returned; it stays as it is.
        grip: Name of the site on the tool.
        coupling: K and B that should be felt; None takes the default of the simulated device.
        period: T in s; None takes ``DEFAULT_PERIOD``.
        scale: Handle motion per device motion.
        workspace: Edge of the cube that the device reaches, in m, > 0.
        motion: A CSV file or a recording; None takes ``NAME.csv`` beside the scene, or else the
            hand motion that ``hapticbridge run`` would make.
        progress: Called with ticks done and to do.

    Raises:
        SceneError: The scene cannot be compiled or put behind a device for another reason than an
            inertia or its start.
        DeviceError: The motion cannot be read, or the period or scale is out of range.
        RecordingError: Likewise.
    """
    if not math.isfinite(workspace) or workspace <= 0:
        raise DeviceError(f"workspace is {workspace!r} m; it must be finite and > 0")
    is_rate_given, period = period is not None, DEFAULT_PERIOD if period is None else period
    info = SimulatedDevice().info
    coupling = coupling or default_coupling(info, period, scale, scale)
    scene, refused = _compiled(source, grip)
    chosen = motion_for(scene, motion)
    name = str(motion) if motion is not None else scene.path.with_suffix(".csv").name
    if chosen is None:
        chosen, name = _default_motion(), "the default hand motion: slow, 1 cm about each axis"
    samples = samples_of(chosen, period)
    places = Places(source, scene.model)
    case = Case(
        source=source,
        scene=scene,
        places=places,
        info=info,
        coupling=coupling,
        period=period,
        scale=scale,
        motion=chosen,
        motion_name=name,
        samples=samples,
        refused=refused,
        workspace=workspace,
        is_rate_given=is_rate_given,
    )
    scene.set_timestep(period)
    try:
        with quiet():
            seen = observe(scene, samples, coupling, period, progress)
        return replace(case, observation=seen)
    except (SceneError, mujoco.FatalError) as error:
        return replace(case, motion_fault=" ".join(str(error).split()))


def _compiled(source: SceneSource, grip: str) -> tuple[Scene, dict[int, str]]:
    """Compiles with a stand-in for every inertia that MuJoCo refuses, so that the rest is seen."""
    refused: dict[int, str] = {}
    while True:
        try:
            return compile_scene(source, grip, warns=False, checks_start=False), refused
        except SceneError as error:
            found = _REFUSED.search(str(error))
            if found is None or (body_id := int(found[2])) in refused:
                raise
            refused[body_id] = str(error)
        spec = source.spec.copy()
        for each in refused:
            body = spec.bodies[each]
            body.explicitinertial, body.mass = True, STAND_IN_MASS
            body.inertia, body.fullinertia = np.full(3, STAND_IN_INERTIA), np.full(6, np.nan)
        source = replace(source, spec=spec)


def _default_motion() -> Motion:
    times = np.arange(0.0, DEFAULT_SECONDS + _DEFAULT_STEP, _DEFAULT_STEP)
    poses = [lissajous(float(time)) for time in times]
    return Motion(times, [pose[0] for pose in poses], [pose[1] for pose in poses])
