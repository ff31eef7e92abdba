"""Scene of a recording, compiled again from its attached sources."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory

from hapticbridge.errors import HapticBridgeError, RecordingError
from hapticbridge.files import read_json
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.recording import RecordingFile
from hapticbridge.rendering import check_prepared, prepare
from hapticbridge.run_description import SOURCE_PREFIX, method_of, model_digest, requested_of
from hapticbridge.scene import Scene, load_scene, scene_parameters


def unpack_scene(recording: RecordingFile, folder: Path) -> Path:
    """Writes a recording's scene files to a folder; returns the main file.

    The folder is created if missing; nothing is written outside it.

    Raises:
        RecordingError: The recording carries no scene, or files that cannot be written there.
    """
    main: Path | None = None
    for name, data in recording.attachments.items():
        if not name.startswith(SOURCE_PREFIX):
            continue
        inner = PurePosixPath(name.removeprefix(SOURCE_PREFIX))
        # a foreign recording must not write outside the folder
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
        raise RecordingError(f"{recording.path} carries no scene, so it cannot be simulated again")
    return main


def recorded_values(meta: Mapping[str, str]) -> dict[str, float]:
    """Returns the values of the scene's parameters in a recorded run.

    Raises:
        RecordingError: They are not numbers by name.
    """
    try:
        values = dict(read_json(meta.get("scene_parameters", "{}")))
        return {str(name): float(value) for name, value in values.items()}
    except (ValueError, TypeError, OverflowError) as error:
        raise RecordingError(f"metadata 'scene_parameters' are not numbers: {error}") from None


def load_unpacked(main: Path, grip: str, values: Mapping[str, float]) -> Scene:
    """Loads an unpacked scene with these values of its parameters.

    Raises:
        SceneError: A value is out of range, or the scene cannot be loaded.
    """
    defaults = {each.name: each.default for each in scene_parameters(main)}
    # a default that is set may differ from the file's number in its last digit
    changed = {name: value for name, value in values.items() if defaults.get(name) != value}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # reported during the recorded run
        return load_scene(main, grip, as_is=False, **changed)


def compile_recorded(recording: RecordingFile, parameters: RunParameters) -> Scene:
    """Compiles the attached sources, and prepares the scene for the recorded method.

    Raises:
        RecordingError: The recording carries no scene, or it cannot be compiled or prepared.
    """
    folder = ""
    try:
        with TemporaryDirectory(prefix="hapticbridge-") as folder:
            main = unpack_scene(recording, Path(folder))
            scene = load_unpacked(main, parameters.grip, recorded_values(recording.meta))
            requested, method = requested_of(recording.meta), method_of(recording.meta)
            steps = parameters.period, parameters.substeps
            prepare(scene, requested, *steps, method, warns=False)
            check_prepared(scene.model, parameters, method)
    except RecordingError:
        raise
    except HapticBridgeError as error:
        reason = str(error).replace(f"{folder}/", "")
        raise RecordingError(f"the attached scene does not fit the metadata: {reason}") from None
    return scene


def is_as_recorded(scene: Scene, recording: RecordingFile) -> bool:
    """Returns True if a prepared scene is the recorded one in every bit."""
    return model_digest(scene.model) == recording.meta.get("scene_sha256")
