"""A scene under check: source, compiled model, motion, observation."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.check.observe import MAX_WORK, Observation, observe
from hapticbridge.clock import SimulatedClock
from hapticbridge.coupling import Coupling
from hapticbridge.demand.certificate import default_coupling
from hapticbridge.demand.methods import RIGID, default_method, prepare
from hapticbridge.demand.pulse import Tap
from hapticbridge.demand.rehearsal import RunPoint
from hapticbridge.device import DeviceInfo, Motion, SimulatedDevice, TrajectoryDevice
from hapticbridge.device.base import checked_number
from hapticbridge.device.motion_file import motion_in, read_motion, read_recorded
from hapticbridge.device.trajectory import DEFAULT_SECONDS, lissajous
from hapticbridge.errors import HapticBridgeError, SceneError
from hapticbridge.kernel.mujoco_c import quiet
from hapticbridge.kernel.record import SAMPLE_DTYPE
from hapticbridge.run.options import BridgeOptions, RunSetup, Workspace
from hapticbridge.scene import Scene, SceneSource, compile_scene
from hapticbridge.scene.fault import CompiledScene
from hapticbridge.scene.source_map import Places
from hapticbridge.scene.treatment import SceneChange

# Motion for a check: the scene's own hand path, a file of poses, or a recording


def motion_for(scene: Scene, path: str | Path | None = None) -> Motion | None:
    """Returns the handle's motion relative to its first pose.

    ``path`` is a CSV file (``t,x,y,z[,qw,qx,qy,qz]``), a recording or a bag of poses; None takes
    ``NAME.csv`` beside the scene.

    Returns:
        The motion; None if no file was named and none lies beside the scene.

    Raises:
        DeviceError: The file is not a motion, or a damaged recording.
        RecordingError: The file is not a recording.
    """
    if path is None:
        beside = scene.path.with_suffix(".csv")
        return read_motion(beside).relative() if beside.is_file() else None
    found = motion_in(str(path))
    if isinstance(found, Motion):
        return found.relative()
    ticks, period = read_recorded(found)
    # the handle's pose already includes scale and axes; the device's does not
    return Motion(
        ticks["tick"] * period, ticks["handle_position"], ticks["handle_quaternion"]
    ).relative()


def samples_of(motion: Motion, period: float) -> NDArray[np.void]:
    """Samples the motion as the loop would, one ``SAMPLE_DTYPE`` per period T in s.

    Of a long motion it takes as many as an observation sees at most (``MAX_WORK``).

    Raises:
        DeviceError: The period is not finite and > 0.
    """
    device = TrajectoryDevice(motion)
    sample = device.start(period)
    samples = np.zeros(int(min(motion.duration / period, MAX_WORK)) + 1, SAMPLE_DTYPE)
    for k in range(samples.size):
        device.read(sample)
        samples[k] = sample[0]
    return samples


DEFAULT_PERIOD = 1e-3
"""Tick period T in s. It is the default of ``hapticbridge run``."""

MAX_WORKSPACE = 0.4
"""Default edge in m of the cube that a device reaches. Makers of table-top devices state 0.1 m
(Novint Falcon) to 0.4 m (Force Dimension delta.3), so a motion beyond it fits none of them. The
simulated device has no walls."""


_DEFAULT_STEP = 0.01  # s; the motion's fastest part has 0.41 Hz
_REFUSED = re.compile(
    r"(?:mass and inertia of|inertia must satisfy).*?(?:element '(?P<name>[^']*)', )?id (?P<id>\d+)"
)
STAND_IN_MASS, STAND_IN_INERTIA = 0.01, 1e-6
"""Mass in kg and inertia in kg m² that replace an inertia refused by MuJoCo: those of a thing on a
fingertip."""


@dataclass(frozen=True, slots=True, eq=False)
class SceneUnderCheck(CompiledScene):
    """A scene under check: a compiled scene, and a motion that it was led through.

    Attributes:
        info: Data sheet of the device.
        coupling: Requested K and B.
        period: T in s.
        scale: Handle motion per device motion, without unit.
        motion: Motion of the handle.
        motion_name: Description of the motion's origin.
        samples: The motion, one sample per tick.
        refused: MuJoCo's message by the id of each body whose inertia it refuses; a stand-in
            replaces it.
        workspace: Edge in m of the cube that the device reaches.
        has_chosen_period: True if the user chose the period.
        observation: Result of the motion; None if the motion did not finish.
        motion_fault: Reason why the motion did not finish.
        contact: Contact of the run that the scene is checked for: ``rigid``, the default of a run,
            or ``scene``, MuJoCo's own.
        differences: Differences of the run from the file, those by its contacts too.
    """

    info: DeviceInfo
    coupling: Coupling
    period: float
    scale: float
    motion: Motion
    motion_name: str
    samples: NDArray[np.void]
    refused: dict[int, str]
    workspace: float
    has_chosen_period: bool
    observation: Observation | None = None
    motion_fault: str = ""
    contact: Literal["rigid", "scene"] = "rigid"
    differences: tuple[SceneChange, ...] = ()

    @property
    def is_rigid(self) -> bool:
        """True if contacts, limits and equality constraints are rigid in the run."""
        return self.contact == RIGID

    @property
    def setting(self) -> RunPoint:
        """Coupling, period and contact of the run."""
        return RunPoint(self.coupling, self.period, contact=self.contact)

    @property
    def tap(self) -> Tap | None:
        """Tap of the tool in a run with pulses of blows; None if it can have none."""
        if not self.is_rigid:
            return None
        setup = self._setup(self.scene, impact_pulses=1.0)
        return setup.tap()

    def _setup(self, scene: Scene, impact_pulses: float = 0.0) -> RunSetup:
        """Returns the setup of a run of the scene on the simulated device."""
        options = BridgeOptions(
            rate=1.0 / self.period,
            contact=self.contact,
            workspace=Workspace(scale=self.scale, force_scale=self.scale),
            impact_pulses=impact_pulses,
        ).for_scene(scene.model)
        clock = SimulatedClock()
        return RunSetup.resolve(scene, self.info, self.coupling, options, clock, is_recorded=False)

    def carried_weight(self) -> tuple[SceneChange, ...]:
        """Returns the change of a run whose device cannot hold the tool; empty if it can."""
        with suppress(HapticBridgeError):  # of a scene that a run refuses
            scene = compile_scene(self.source, self.scene.grip, warns=False, checks_start=False)
            setup = self._setup(scene)
            prepare(
                scene, setup.coupling, setup.scene_period, setup.substeps, setup.method, warns=False
            )
            setup.holding(self.samples[:1], None)
            return tuple(each for each in scene.differences if each.subject == "weight")
        return ()

    @property
    def law(self) -> Coupling:
        """Coupling that the default method's law uses."""
        return default_method().law_coupling(self.coupling, self.period)


@dataclass(frozen=True, slots=True, kw_only=True)
class IntendedUse:
    """Device and run for which a scene is checked.

    Attributes:
        coupling: Requested K and B; None takes the default of the simulated device.
        period: T in s; None takes ``DEFAULT_PERIOD``.
        scale: Handle motion per device motion.
        workspace: Edge in m of the cube that the device reaches, > 0.
        contact: Contact of the run: ``rigid``, its default, or ``scene``, MuJoCo's own.
    """

    coupling: Coupling | None = None
    period: float | None = None
    scale: float = 1.0
    workspace: float = MAX_WORKSPACE
    contact: Literal["rigid", "scene"] = "rigid"


DEFAULT_USE = IntendedUse()
"""Default run on the largest table-top device."""


def open_case(
    source: SceneSource,
    grip: str = "grip",
    use: IntendedUse = DEFAULT_USE,
    *,
    motion: str | Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> SceneUnderCheck:
    """Compiles a scene and leads it through its motion.

    Args:
        source: Scene from ``read_scene``; it is not changed.
        grip: Name of the site on the tool.
        use: Device and run for which the scene is checked.
        motion: CSV file or recording. None takes ``NAME.csv`` beside the scene, or else the default
            hand motion of ``hapticbridge run``.
        progress: Called with the number of ticks done and the total.

    Raises:
        SceneError: The scene does not compile or cannot be coupled to a device. A refused inertia
            or a bad start does not raise.
        DeviceError: The motion cannot be read, or the period, scale or workspace is out of range.
        RecordingError: The recording cannot be read.
    """
    checked_number("workspace", use.workspace, "m", is_positive=True)
    period = DEFAULT_PERIOD if use.period is None else use.period
    info = SimulatedDevice().info
    coupling = use.coupling or default_coupling(info, period, use.scale, use.scale)
    setting = RunPoint(coupling, period, contact=use.contact)
    scene, refused = _compile(source, grip)
    chosen = motion_for(scene, motion)
    name = str(motion) if motion is not None else scene.path.with_suffix(".csv").name
    if chosen is None:
        chosen, name = (
            _default_motion(),
            "the default hand motion: slow, 1 cm along and 0.1 rad about each axis",
        )
    samples = samples_of(chosen, period)
    scene.set_timestep(period)
    observation, fault = None, ""
    try:
        with quiet():
            observation = observe(scene, samples, setting, progress)
        samples = samples[: observation.force.size]
        if samples.size <= chosen.duration / period:
            name += f"; the first {samples.size * period:.3g} s of it alone"
    except (SceneError, mujoco.FatalError) as error:
        fault = " ".join(str(error).split())
    finally:
        scene.set_contact(is_rigid=use.contact == RIGID)
        differences = scene.differences
        scene.set_contact(is_rigid=False)  # the file's own settings are what the rules examine
    return SceneUnderCheck(
        source=source,
        scene=scene,
        places=Places(source, scene.model),
        info=info,
        coupling=coupling,
        period=period,
        scale=use.scale,
        motion=chosen,
        motion_name=name,
        samples=samples,
        refused=refused,
        workspace=use.workspace,
        has_chosen_period=use.period is not None,
        observation=observation,
        motion_fault=fault,
        contact=use.contact,
        differences=differences,
    )


def refused_body(error: SceneError) -> str | int | None:
    """Returns the name of the body whose inertia MuJoCo refuses, or its number if it has no name.

    None if a compilation failed for another reason. Fusing bodies changes their numbers.
    """
    found = _REFUSED.search(str(error))
    return found and (found["name"] or int(found["id"]))


def _compile(source: SceneSource, grip: str) -> tuple[Scene, dict[int, str]]:
    """Compiles with a stand-in for each inertia that MuJoCo refuses, so other checks can run.

    Bodies are then not fused, as a refused one may have no joint. Where that or another fault ends
    it, the first refusal is raised.
    """
    refused: dict[str | int, str] = {}
    first: SceneError | None = None
    while True:
        try:
            scene = compile_scene(source, grip, warns=False, checks_start=False)
            return scene, {int(scene.model.body(key).id): text for key, text in refused.items()}
        except SceneError as error:
            first = first or error
            if (key := refused_body(error)) is None or key in refused:
                raise first from None
            refused[key] = str(error)
        spec = source.spec.copy()
        spec.compiler.fusestatic = False
        body = spec.body(key) if isinstance(key, str) else spec.bodies[key]
        body.explicitinertial, body.mass = True, STAND_IN_MASS
        body.inertia, body.fullinertia = np.full(3, STAND_IN_INERTIA), np.full(6, np.nan)
        body.ipos = np.nan_to_num(body.ipos)  # MuJoCo would take the body's own position for it
        source = replace(source, spec=spec)


def _default_motion() -> Motion:
    times = np.arange(0.0, DEFAULT_SECONDS + _DEFAULT_STEP, _DEFAULT_STEP)
    poses = [lissajous(float(time)) for time in times]
    return Motion(times, [pose[0] for pose in poses], [pose[1] for pose in poses])
