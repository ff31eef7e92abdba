"""A recorded run, taken apart so that a bridge can run it again with something changed."""

from __future__ import annotations

import hashlib
import json
import warnings
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from hapticbridge.certificate import needed_on_axes
from hapticbridge.device import DeviceInfo
from hapticbridge.errors import HapticBridgeError, RecordingError
from hapticbridge.guard import CONTROLLERS, Limits, guarding_for
from hapticbridge.kernel.state import RunParameters
from hapticbridge.provenance import SOURCE_PREFIX, compiled_model, parameters_of
from hapticbridge.recording import Recording
from hapticbridge.rendering import Method, method_named, prepare
from hapticbridge.scene import Scene, load_scene, scene_parameters
from hapticbridge.tick import TickFlag
from hapticbridge.whatif.changes import Settings

_NOWHERE = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class RecordedRun:
    """What a recording says about its run.

    Attributes:
        recording: It, with its ticks.
        parameters: Of the run.
        info: The device.
        settings: What may be changed.
        scene_file: The scene's file, written again from what the recording carries.
    """

    recording: Recording
    parameters: RunParameters
    info: DeviceInfo
    settings: Settings
    scene_file: Path

    @classmethod
    def of(cls, recording: Recording, folder: Path) -> RecordedRun:
        """Takes a recording apart.

        Args:
            recording: What was read.
            folder: Gets the scene's files.

        Raises:
            RecordingError: The recording does not tell its run, or carries no scene.
        """
        parameters = parameters_of(recording.meta)
        method = method_named(recording.meta["method"])
        step = parameters.period / parameters.substeps
        try:
            info = DeviceInfo.from_json(recording.meta.get("device", ""))
            values = dict(json.loads(recording.meta.get("scene_parameters", "{}")))
        except (HapticBridgeError, ValueError, TypeError) as error:
            raise RecordingError(f"the metadata do not describe a run: {error}") from None
        settings = Settings(
            # recorded is the law's damping; what was asked for is what should be felt
            coupling=method.rendered(parameters.coupling, step),
            method=method,
            rate=1.0 / parameters.period,
            substeps=parameters.substeps,
            scale=parameters.scale,
            force_scale=parameters.force_scale,
            contact_stiffness=parameters.contact_stiffness or None,
            scene={str(name): float(value) for name, value in values.items()},
            controller=_controller(info, parameters, method),
        )
        return cls(recording, parameters, info, settings, _write_scene(recording, folder))

    @property
    def is_absolute(self) -> bool:
        """Whether the device's poses were poses in the scene."""
        return self.parameters.device_origin == self.parameters.handle_origin == _NOWHERE

    @property
    def limits(self) -> Limits:
        """Of the run, times in s."""
        p, guarding = self.parameters, self.parameters.guarding
        return Limits(
            force=p.force_limit,
            torque=p.torque_limit,
            rise=p.force_limit * p.period / guarding.force_rise,  # 0 where it may step
            ramp=p.ramp_ticks * p.period,
            stretch=guarding.stretch / p.scale,
            angle=guarding.angle,
            energy=guarding.energy,
        )

    @property
    def clutch(self) -> int | None:
        """Number of the button, from 0, that let the device move without the handle."""
        return _button(self.parameters.guarding.clutch)

    @property
    def dead_man(self) -> int | None:
        """Number of the button that had to be held for any force."""
        return _button(self.parameters.guarding.dead_man)

    @property
    def start(self) -> tuple[float, ...]:
        """Device pose (7,) that the handle's counts from when the run begins.

        Where the device moved before the first tick, that re-seated the coupling: what it had moved
        until then is not to be seen in the scene.
        """
        first = self.recording.ticks[0]
        if not int(first["flags"]) & int(TickFlag.RESEATED):
            return self.parameters.device_start
        return (*first["device_position"].tolist(), *first["device_quaternion"].tolist())

    def scene(self, settings: Settings) -> Scene:
        """Loads the scene with the parameters of some settings.

        Raises:
            SceneError: A parameter is out of range, or the scene cannot be loaded.
        """
        defaults = {each.name: each.default for each in scene_parameters(self.scene_file)}
        # a default that is set may differ from the file's number in its last digit
        values = {n: v for n, v in settings.scene.items() if defaults.get(n) != v}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # told when it was recorded
            return load_scene(self.scene_file, self.parameters.grip, **values)

    def is_scene_as_recorded(self) -> bool:
        """Whether the attached sources give the very model that was recorded.

        They do not where a program changed the model after it was loaded.
        """
        scene, settings = self.scene(self.settings), self.settings
        prepare(scene, settings.coupling, 1.0 / settings.rate, settings.substeps, settings.method)
        found = hashlib.sha256(compiled_model(scene.model)).hexdigest()
        return found == self.recording.meta.get("scene_sha256")


def _controller(info: DeviceInfo, parameters: RunParameters, method: Method) -> str | None:
    """Returns the run's passivity controller; None if it is what a bridge chooses by itself."""
    p = parameters
    scales = p.scale, p.force_scale
    needed = needed_on_axes(info, p.coupling, p.period, *scales, p.laws, method)
    limits = Limits(force=p.force_limit, torque=p.torque_limit)
    usual = guarding_for(info, limits, p.period, needed=needed, scale=p.scale)
    if usual.controller == p.guarding.controller:
        return None
    return next(name for name, code in CONTROLLERS.items() if code == p.guarding.controller)


def _button(mask: int) -> int | None:
    return mask.bit_length() - 1 if mask else None


def _write_scene(recording: Recording, folder: Path) -> Path:
    """Writes the files of the scene that a recording carries; returns the main one."""
    main: Path | None = None
    for name, data in recording.attachments.items():
        if not name.startswith(SOURCE_PREFIX):
            continue
        inner = PurePosixPath(name.removeprefix(SOURCE_PREFIX))
        # a recording from elsewhere must not write beside the folder
        if inner.is_absolute() or ".." in inner.parts or "\\" in name or ":" in name:
            raise RecordingError(
                f"the attachment {name!r:.80} would lie outside the scene's folder"
            )
        path = folder / inner
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        except (OSError, ValueError) as error:
            raise RecordingError(
                f"the attachment {name!r:.80} cannot be unpacked: {error}"
            ) from None
        main = main or path
    if main is None:
        raise RecordingError(f"{recording.path} carries no scene: nothing can be simulated again")
    return main
